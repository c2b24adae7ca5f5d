"""A map as a person reads it: sections, its picture, and the files of --out, arrays for NumPy, Zarr and Gwyddion."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import label_axes, new_figure, png_of
from afm_jax.report import Bullets, Section, Table, sections
from afm_jax.saved import as_json
from afm_jax.strict_json import strict_json
from afm_jax.units import words_of
from afm_jax.whole_files import whole_folder, write_whole
from fitting.tapping_curves.maps import ARRAYS, PixelState, TappingMap

_MOST = 1024
"""Pixels a side of a picture."""


@sections.register
def _(image: TappingMap) -> list[Section]:
    counts, unit, numbers = image.counts, image.unit, as_json(image)
    rows, columns = image.state.shape
    masked = [f"{count} {name}" for name, count in counts.items() if count and name != "used"]
    head = ["", f"2.5 % ({unit})", "median", "97.5 %", "error of a pixel", "error of all in common"]
    cells = [
        [
            name,
            *(f"{numbers[key][end]:.3g}" for end in ("percentile_2_5", "median", "percentile_97_5")),
            f"{numbers[f'{key}_error']['median']:.2g}",
            f"{numbers[f'{key}_common_error']:.2g}",
        ]
        for name, key in (("energy of a tap", "energy"), ("virial", "virial"))
        if counts["used"]
    ]
    parts = ", ".join(f"{words_of(name)} {value:+.2g}" for name, value in image.common.items())
    common = f"The common error of the energy comes of ({unit}, one standard error each): {parts}."
    known = [[words_of(key), f"{one.value:.7g}", one.unit, one.origin] for key, one in image.known.items()]
    of_known = ["known", "value", "unit", "from"]
    table = Table("95 of 100 pixels lie between the first and the third number", head, cells)
    title = f"Map {image.source}: {rows} x {columns} pixels, {counts['used']} used"
    return [
        Section(f"{title}, masked: {', '.join(masked)}" if masked else f"{title}, none masked", []),
        Section("Energy and virial", [table]),
        Section("Errors", [common if cells else None]),
        Section("What is known", [Table("Of the instrument", of_known, known)]),
        Section("Assumptions", [Bullets(image.notes, "Notes:")]),
    ]


def map_figure(result: TappingMap) -> Figure:
    """Return energy and virial over the image with colour bars, pixels out of range in grey."""
    figure = new_figure(6.5, 9.5)
    used = result.state == PixelState.USED
    step = max(1, int(np.ceil(max(used.shape) / _MOST)))
    size = result.size_m
    extent = None if size is None else (0.0, 1e6 * size[1], 1e6 * size[0], 0.0)
    where = "um" if size is not None else "pixel"
    for axes, name, colours in zip(figure.subplots(2), ("energy", "virial"), ("viridis", "coolwarm"), strict=True):
        image = getattr(result, name)
        low, high = np.percentile(image[used], (0.5, 99.5)) if used.any() else (0.0, 1.0)
        if name == "virial":
            low, high = -max(abs(low), abs(high)), max(abs(low), abs(high))
        axes.set_facecolor("#d0d0d0")
        colour = {"cmap": colours, "vmin": low, "vmax": high, "interpolation": "nearest"}
        shown = axes.imshow(image[::step, ::step], extent=extent, **colour)
        figure.colorbar(shown, ax=axes, label=f"{name} ({result.unit})", shrink=0.8)
        label_axes(axes, x=f"x ({where})", y=f"y ({where})", grid=False)
    common = f"; common error at the median {result.energy_common_error:.2g} {result.unit}" if used.any() else ""
    figure.suptitle(f"Energy of a tap: {used.sum()} pixels, {(~used).sum()} masked (grey){common}", fontsize=11)
    return figure


def write_map(image: TappingMap, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Write picture, JSON, text and the arrays in the formats wanted, and return their paths.

    Args:
        image: the map.
        folder: that is there already.
        formats: of "npz", "gsf" and "zarr".
    """
    contents: dict[str, str | bytes] = {
        "map.png": png_of(map_figure(image)),
        "map.json": strict_json(as_json(image)) + "\n",
        "map.txt": f"{image}\n",
    }
    if "npz" in formats:
        packed = io.BytesIO()
        arrays = {name: getattr(image, name) for name in (*ARRAYS, "state")}
        np.savez(packed, allow_pickle=False, **arrays, unit=np.array(image.unit))
        contents["map.npz"] = packed.getvalue()
    if "gsf" in formats:
        contents |= {f"map_{name}.gsf": _simple_field(image, name) for name in ARRAYS}
    for name, content in contents.items():
        write_whole(folder / name, content)
    if "zarr" in formats:
        _write_zarr(image, folder / "map.zarr")
    return [folder / name for name in (*contents, *(["map.zarr"] if "zarr" in formats else []))]


def _simple_field(image: TappingMap, name: str) -> bytes:
    """Return an array as a file of Gwyddion's, a Gwyddion Simple Field, in J or m^2; NaN are masked there.

    After a head of lines, filled with NUL to a multiple of four bytes, stand numbers of 32 bits, little-endian, row by
    row (Gwyddion's user guide, "Gwyddion simple field files").
    """
    rows, columns = image.state.shape
    title, unit = name.replace("_", " "), "J" if image.unit == "aJ" else "m^2"
    lines = ["Gwyddion Simple Field 1.0", f"XRes = {columns}", f"YRes = {rows}", f"Title = {title}", f"ZUnits = {unit}"]
    if image.size_m is not None:
        lines += [f"XReal = {image.size_m[1]!r}", f"YReal = {image.size_m[0]!r}", "XYUnits = m"]
    head = "\n".join([*lines, ""]).encode()
    return head + b"\0" * (4 - len(head) % 4) + (1e-18 * getattr(image, name)).astype("<f4").tobytes()


def _write_zarr(image: TappingMap, path: Path) -> None:
    import zarr  # noqa: PLC0415

    with whole_folder(path) as fresh:
        group = zarr.open_group(str(fresh), mode="w")
        for name in (*ARRAYS, "state"):
            array = group.create_array(name, data=getattr(image, name), dimension_names=("rows", "columns"))
            array.attrs["units"] = "" if name == "state" else image.unit
        group.attrs["source"], group.attrs["unit"] = image.source, image.unit
        group.attrs["energy_common_error"] = image.energy_common_error
