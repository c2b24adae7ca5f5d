"""A map as a person reads it: sections, and the files of --out, arrays for NumPy, Gwyddion and Zarr among them."""

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from afm_jax.plots.picture_style import png_of, svg_of
from afm_jax.strict_json import strict_json
from afm_jax.whole_files import whole_folder, write_whole
from fitting.instruments.gwyddion import images_as_bytes
from fitting.report.sections import Bullets, Report, ReportSection, Table, Text, page_of, pictures_of, text_of
from fitting.tapping_curves.map_pictures import map_figure
from fitting.tapping_curves.maps import TappingMap

ARRAYS = ("energy", "energy_error", "virial", "virial_error", "state")


def map_summary(result: TappingMap) -> str:
    """Return a map as text: pixels, median energy and virial with the two kinds of errors, what was assumed."""
    return text_of(map_report(result))


def map_report(result: TappingMap) -> Report:
    """Return a map as sections: median energy and virial with the two kinds of errors, what is known, notes."""
    counts, unit = result.counts, result.unit
    rows, columns = result.state.shape
    masked = [f"{count} {name}" for name, count in counts.items() if count and name != "used"]
    sections = []
    if counts["used"]:
        numbers = result.to_dict()
        head = ["", f"2.5 % ({unit})", "median", "97.5 %", "error of a pixel", "error of all in common"]
        cells = [
            [
                name,
                *(f"{numbers[key][end]:.3g}" for end in ("percentile_2_5", "median", "percentile_97_5")),
                f"{numbers[f'{key}_error']['median']:.2g}",
                f"{numbers[f'{key}_common_error']:.2g}",
            ]
            for name, key in (("energy of a tap", "energy"), ("virial", "virial"))
        ]
        parts = [f"{name.replace('_', ' ')} {value:+.2g}" for name, value in result.common.items()]
        common = f"The common error of the energy comes of ({unit}, one standard error each): {', '.join(parts)}."
        table = Table("95 of 100 pixels lie between the first and the third number", head, cells)
        sections = [ReportSection("Energy and virial", [table], "Energy"), ReportSection("Errors", [Text(common)])]
    known = [
        [key, f"{one.value:.7g}" if not isinstance(one.value, str) else one.value, one.unit, one.origin]
        for key, one in result.known.items()
    ]
    head = ["known", "value", "unit", "from"]
    sections.append(ReportSection("What is known", [Table("Of the instrument", head, known, words=head[2:])], "Known"))
    if result.notes:
        sections.append(ReportSection("Notes", [Bullets(result.notes, "Notes:")], "Notes"))
    return Report(
        title=f"Map {result.source}: {rows} x {columns} pixels, {counts['used']} used, "
        + (f"masked: {', '.join(masked)}" if masked else "none masked"),
        valid=result.valid,
        verdict="VALID" if result.valid else "NOT VALID",
        reasons=result.reasons,
        sections=sections,
    )


def write_map(result: TappingMap, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Write page, picture, JSON, text and the arrays in the formats wanted, and return their paths.

    Args:
        result: the map.
        folder: that is there already.
        formats: of "npz", "gwy" and "zarr".
    """
    payload = {"format": "afm-jax tapping-map", "format_version": 1, **result.to_dict()}
    report, figure = map_report(result), map_figure(result)
    # the SVG file has the layout of the PNG drawn before
    picture = png_of(figure)
    shows = "Energy and virial over the image, pixels out of range in grey; below, how often each value comes."
    seen = ReportSection("Picture", pictures_of([svg_of(figure)], [shows]), "Picture")
    contents: dict[str, str | bytes] = {
        "map.html": page_of(replace(report, sections=[seen, *report.sections])),
        "map.png": picture,
        "map.json": strict_json(payload) + "\n",
        "map.txt": text_of(report) + "\n",
    }
    if "npz" in formats:
        packed = io.BytesIO()
        np.savez(packed, **{name: getattr(result, name) for name in ARRAYS}, unit=np.array(result.unit))
        contents["map.npz"] = packed.getvalue()
    if "gwy" in formats:
        contents["map.gwy"] = _gwyddion(result)
    written = []
    for name, content in contents.items():
        write_whole(folder / name, content, within=folder)
        written.append(folder / name)
    if "zarr" in formats:
        _write_zarr(result, folder / "map.zarr")
        written.append(folder / "map.zarr")
    return written


def _gwyddion(result: TappingMap) -> bytes:
    """Return the map as a Gwyddion file, in J or m^2."""
    unit, size = "J" if result.unit == "aJ" else "m^2", 1e-18
    titles = {"energy": "Energy of a tap", "energy_error": "Error of the energy"}
    titles |= {"virial": "Virial", "virial_error": "Error of the virial"}
    images = {title: (getattr(result, name) * size, unit) for name, title in titles.items()}
    rows, columns = result.state.shape
    if result.size_m is None:
        return images_as_bytes(images, (float(rows), float(columns)), "")
    return images_as_bytes(images, result.size_m, "m")


def _write_zarr(result: TappingMap, path: Path) -> None:
    import zarr  # noqa: PLC0415

    with whole_folder(path) as fresh:
        group = zarr.open_group(str(fresh), mode="w")
        for name in ARRAYS:
            array = group.create_array(name, data=getattr(result, name), dimension_names=("rows", "columns"))
            array.attrs["units"] = "" if name == "state" else result.unit
        group.attrs["source"], group.attrs["unit"] = result.source, result.unit
        group.attrs["energy_common_error"] = result.energy_common_error
