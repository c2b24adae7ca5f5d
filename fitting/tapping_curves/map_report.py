"""A map as text and as files: picture, numbers, arrays for NumPy, Gwyddion and Zarr."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from afm_jax.plots.picture_style import png_of
from afm_jax.strict_json import strict_json
from afm_jax.whole_files import whole_folder, write_whole
from afm_jax.words import bullets, text_table
from fitting.instruments.gwyddion import images_as_bytes
from fitting.tapping_curves.map_pictures import map_figure
from fitting.tapping_curves.maps import TappingMap

ARRAYS = ("energy", "energy_error", "virial", "virial_error", "state")


def map_summary(result: TappingMap) -> str:
    """Return a map in words: pixels, median energy and virial with the two kinds of errors, what was assumed."""
    counts, unit = result.counts, result.unit
    rows, columns = result.state.shape
    masked = [f"{count} {name}" for name, count in counts.items() if count and name != "used"]
    lines = [
        f"Map {result.source}: {rows} x {columns} pixels, {counts['used']} used, "
        + (f"masked: {', '.join(masked)}" if masked else "none masked"),
        "",
        "VALID" if result.valid else "NOT VALID",
        *(f"  - {reason}" for reason in result.reasons),
        "",
    ]
    if counts["used"]:
        numbers = result.to_dict()
        table = [
            [
                name,
                *(f"{numbers[key][end]:.3g}" for end in ("percentile_2_5", "median", "percentile_97_5")),
                f"{numbers[f'{key}_error']['median']:.2g}",
                f"{numbers[f'{key}_common_error']:.2g}",
            ]
            for name, key in (("energy of a tap", "energy"), ("virial", "virial"))
        ]
        lines += text_table(
            ["", f"2.5 % ({unit})", "median", "97.5 %", "error of a pixel", "error of all in common"], table
        )
        parts = [f"{name.replace('_', ' ')} {value:+.2g}" for name, value in result.common.items()]
        lines += ["", f"The common error of the energy comes of ({unit}, one standard error each): {', '.join(parts)}."]
    known = [
        [key, f"{one.value:.7g}" if not isinstance(one.value, str) else one.value, one.unit, one.origin]
        for key, one in result.known.items()
    ]
    lines += ["", *text_table(["known", "value", "unit", "from"], known, words=(0, 2, 3))]
    lines += bullets("Notes:", list(result.notes))
    return "\n".join(lines)


def write_map(result: TappingMap, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Write picture, JSON, text and the arrays in the formats wanted, and return their paths.

    Args:
        result: the map.
        folder: that is there already.
        formats: of "npz", "gwy" and "zarr".
    """
    payload = {"format": "afm-jax tapping-map", "format_version": 1, **result.to_dict()}
    contents: dict[str, str | bytes] = {
        "map.png": png_of(map_figure(result)),
        "map.json": strict_json(payload) + "\n",
        "map.txt": map_summary(result) + "\n",
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
