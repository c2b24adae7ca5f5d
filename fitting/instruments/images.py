"""Images of amplitude and phase out of instruments' files, or grids of tapping curves as images at one amplitude."""

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.scenefile.tables import printable
from fitting.instruments.columns import ROLES, ColumnSource, parse_columns
from fitting.instruments.curve import read_curves
from fitting.instruments.formats import igor_wave, nanosurf_sets
from fitting.instruments.gwyddion import MAGIC, read_objects
from fitting.instruments.recording import UNITS, Known, damaged_as_one_line, unit_named
from fitting.tables.csv_text import TableError, read_bytes

_NAMES = {"lockin_amplitude_nm": r"(lockin[_ ])?amp.*", "phase_lag_deg": r"pha.*"}
"""What channels of amplitude and phase are called (no case)."""
_UNITS = {"lockin_amplitude_nm": "nm", "phase_lag_deg": "deg"}


@dataclass(frozen=True, eq=False)
class Images:
    """The images of a file.

    Attributes:
        source: path as it was given.
        channels: arrays (rows, columns) by channel; with curves in every pixel (rows, columns, points).
        units: of every channel, a key of `UNITS` or as the file spells it; empty: the file does not say.
        known: what the header says.
        size_m: height and width, None where the file does not say.
    """

    source: str
    channels: dict[str, np.ndarray]
    units: Mapping[str, str]
    known: dict[str, Known] = field(default_factory=dict)
    size_m: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class AmplitudeAndPhase:
    """Amplitude and phase of every pixel.

    Attributes:
        source: of the file.
        amplitude: in `amplitude_unit`, shape (rows, columns).
        amplitude_unit: "nm" or "V".
        phase_deg: as the instrument counts it.
        free_amplitude: of the free tip in every pixel, in the same unit, where curves tell it.
        free_phase_deg: of the free tip in every pixel, where curves tell it.
        known: what the header says.
        size_m: height and width, or None.
        notes: which channels were taken, and what was assumed.
    """

    source: str
    amplitude: Float[np.ndarray, "rows columns"]
    amplitude_unit: str
    phase_deg: Float[np.ndarray, "rows columns"]
    free_amplitude: Float[np.ndarray, "rows columns"] | None = None
    free_phase_deg: Float[np.ndarray, "rows columns"] | None = None
    known: dict[str, Known] = field(default_factory=dict)
    size_m: tuple[float, float] | None = None
    notes: tuple[str, ...] = ()


_LEAST_RATIO = 0.05
"""Amplitude, of the free one, below which the sample holds the tip."""


def read_images(
    path: str | Path,
    phase_path: str | Path | None = None,
    *,
    columns: str | Mapping[str, ColumnSource] = "",
    grid: tuple[int, int] | None = None,
    ratio: float = 0.9,
) -> AmplitudeAndPhase:
    """Return amplitude and phase of every pixel of an image, or of a grid of curves at one amplitude.

    Args:
        path: Asylum .ibw, Gwyddion .gwy, NanoSurf .nid, NumPy .npz or .npy, or text of numbers (one channel).
        phase_path: file of the phase, where amplitude and phase are two.
        columns: which channel is which, as for `read_curves`.
        grid: rows and columns of a file of curves, one a pixel, in the order of the file.
        ratio: amplitude over that of the free tip at which each pixel's curve is read, at least 0.05 and below 1.

    Raises:
        TableError: one line: the file is damaged, of no known format, or has no such channel.
        ValueError: if the ratio is none.
    """
    if not _LEAST_RATIO <= ratio < 1.0:
        raise ValueError(f"`ratio` must be at least {_LEAST_RATIO} and below 1, but is {ratio!r}")
    wanted = parse_columns(columns) if isinstance(columns, str) and columns else dict(columns or {})
    if grid is not None:
        return _of_file_of_curves(path, wanted, grid, ratio)
    images = _images(path)
    if phase_path is not None:
        images = _two_files(images, _images(phase_path))
    taken = {role: _channel(images, role, wanted) for role in _NAMES}
    notes = [f"Channels: {', '.join(f'{role} is {name!r} in {unit}' for role, (name, unit, _) in taken.items())}."]
    numbers = {}
    for role, (name, unit, factor) in taken.items():
        size = UNITS[unit][1]
        numbers[role] = np.asarray(images.channels[name], dtype=float) * (factor * size)
    amplitude, phase = numbers["lockin_amplitude_nm"], numbers["phase_lag_deg"]
    if amplitude.shape != phase.shape:
        raise TableError(
            f"{images.source}: the amplitude has {_shape(amplitude)} pixels, the phase {_shape(phase)}; they must be "
            "of one size"
        )
    read: dict[str, Any] = {"amplitude": amplitude, "phase_deg": phase}
    if amplitude.ndim == 3:
        read = _at_ratio(_heights(images, amplitude.shape), amplitude, phase, ratio)
        notes.append(_note_of_curves(ratio, read["amplitude"]))
    return AmplitudeAndPhase(
        source=images.source,
        amplitude_unit="V" if UNITS[taken["lockin_amplitude_nm"][1]][0] == "voltage" else "nm",
        known=images.known,
        size_m=images.size_m,
        notes=tuple(notes),
        **read,
    )


def _shape(array: np.ndarray) -> str:
    return " x ".join(str(side) for side in array.shape)


def _two_files(first: Images, second: Images) -> Images:
    """Return the amplitude of one file and the phase of another as one; of files with names only those named so."""
    name = next((n for n in first.channels if re.fullmatch(_NAMES["lockin_amplitude_nm"], n, re.IGNORECASE)), "")
    amplitude = name or next(iter(first.channels))
    name = next((n for n in second.channels if re.fullmatch(_NAMES["phase_lag_deg"], n, re.IGNORECASE)), "")
    phase = name or next(iter(second.channels))
    channels = {"amplitude": first.channels[amplitude], "phase": second.channels[phase]}
    units = {"amplitude": first.units.get(amplitude, ""), "phase": second.units.get(phase, "")}
    return replace(first, source=f"{first.source} and {second.source}", channels=channels, units=units)


def _channel(images: Images, role: str, wanted: Mapping[str, ColumnSource]) -> tuple[str, str, float]:
    """Return the channel of a role, its unit and a factor.

    Raises:
        TableError: if there is none, or its unit is none of the role.
    """
    source = wanted.get(role)
    names = list(images.channels)
    listed = ", ".join(names)
    if source is not None and source.channel not in names:
        raise TableError(f"{images.source}: there is no channel `{source.channel}` for {role}; it has {listed}")
    if source is None:
        name = next((name for name in names if re.fullmatch(_NAMES[role], name, re.IGNORECASE)), None)
        if name is None:
            raise TableError(
                f"{images.source}: none of the images {listed} is called {role.split('_')[-2]}; say "
                f'`columns="{role}=CHANNEL:{_UNITS[role]}"`, or give amplitude and phase as two files'
            )
        source = ColumnSource(name)
    unit = source.unit or images.units.get(source.channel, "") or _UNITS[role]
    if UNITS.get(unit, ("",))[0] not in ROLES[role][0]:
        raise TableError(
            f"{images.source}: the channel {source.channel} has the unit {unit!r}, which is none of {role}; say "
            f'`columns="{role}={source.channel}:{_UNITS[role]}"`'
        )
    return source.channel, unit, 1.0 if source.factor is None else source.factor


# ---- formats


def _images(path: str | Path) -> Images:
    name = printable(str(path))
    data = read_bytes(path, "one file")
    head = data[:16]
    with damaged_as_one_line(name):
        if head.startswith(MAGIC):
            return _of_gwyddion(data, name)
        if head.startswith((b"PK", b"\x93NUMPY")):
            return _of_numpy(data, name)
        if head.startswith(b"[DataSet]"):
            return _of_nanosurf(data, name)
        if head[:2] in {b"\x05\x00", b"\x00\x05", b"\x02\x00", b"\x00\x02"}:
            return _of_igor(data, name)
        return _of_text(data, name)


def _of_gwyddion(data: bytes, name: str) -> Images:
    content = read_objects(data, name)
    channels: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    size = None
    for key, value in sorted(content.items()):
        number = re.fullmatch(r"/(\d+)/data", key)
        if number and "xres" in value:
            title = printable(str(content.get(f"{key}/title", f"image {number[1]}")))
            channels[title] = np.asarray(value["data"]).reshape(int(value["yres"]), int(value["xres"]))
            units[title] = unit_named(str(value.get("si_unit_z", {}).get("unitstr", "")))
            size = size or (float(value["yreal"]), float(value["xreal"]))
    if not channels:
        raise TableError(f"{name}: holds no image; a graph of a curve is for `afm-jax tapping`")
    return Images(name, channels, units, size_m=size)


def _of_numpy(data: bytes, name: str) -> Images:
    loaded = np.load(io.BytesIO(data), allow_pickle=False)
    arrays = dict(loaded) if hasattr(loaded, "files") else {"array": loaded}
    images = {
        printable(key): array for key, array in arrays.items() if array.ndim in {2, 3} and array.dtype.kind in "fiu"
    }
    if list(images) == ["array"] and images["array"].ndim == 3 and images["array"].shape[0] == 2:
        images = {"amplitude": images["array"][0], "phase": images["array"][1]}
    heights = {key: array for key, array in arrays.items() if array.ndim == 1 and array.size > 3}
    if not images:
        raise TableError(
            f"{name}: holds no array of two dimensions (rows, columns), nor of three (rows, columns, points of a curve)"
        )
    units = {key: _unit_of(key) for key in images}
    return Images(name, {**images, **heights} if any(a.ndim == 3 for a in images.values()) else images, units)


def _unit_of(key: str) -> str:
    ending = key.rpartition("_")[2].lower()
    return next((unit for unit in UNITS if unit.lower() == ending), "")


def _of_text(data: bytes, name: str) -> Images:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise TableError(
            f"{name}: is neither text of numbers nor a known format (.ibw, .gwy, .nid, .npz, .npy); export it as CSV"
        ) from None
    rows = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = next((sign for sign in "\t;," if rows and sign in rows[0]), None)
    try:
        image = np.loadtxt(rows, delimiter=separator, ndmin=2)
    except ValueError as error:
        raise TableError(
            f"{name}: an image is rows of numbers, as many in each ({printable(str(error))[:80]})"
        ) from None
    if image.size < 4:
        raise TableError(f"{name}: there are no rows of numbers")
    return Images(name, {Path(name).stem: image}, {Path(name).stem: ""})


def _of_igor(data: bytes, name: str) -> Images:
    numbers, labels, header, known = igor_wave(data, name)
    if numbers.ndim != 3 or len(labels) != numbers.shape[2]:
        raise TableError(
            f"{name}: holds an array of {numbers.ndim} dimensions, not images; a ramp is for `afm-jax tapping`"
        )
    # Igor counts columns first, and rows from below
    channels = {label: numbers[:, ::-1, k].T for k, label in enumerate(labels)}
    units = {label: "deg" if label.lower().startswith("pha") else "m" for label in labels}
    size = [header.get(key, "") for key in ("SlowScanSize", "FastScanSize")]
    try:
        sides = float(size[0]), float(size[1])
    except ValueError:
        sides = None
    return Images(name, channels, units, known, sides)


def _of_nanosurf(data: bytes, name: str) -> Images:
    channels: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    size = None
    sets, known = nanosurf_sets(data, name)
    for keys, lines in sets:
        if not keys.get("Frame", "").startswith("Scan"):
            continue
        title = keys["Dim2Name"] + ("" if keys["Frame"] == "Scan forward" else f" ({keys['Frame']})")
        channels[title] = np.stack([numbers for _, numbers in lines])
        units[title] = unit_named(keys["Dim2Unit"])
        sides = float(keys.get("Dim1Range", "nan")), float(keys.get("Dim0Range", "nan"))
        size = size or (sides if np.isfinite(sides).all() else None)
    if not channels:
        raise TableError(f"{name}: holds no image; a curve is for `afm-jax tapping`")
    return Images(name, channels, units, known, size)


# ---- grids of curves


def _of_file_of_curves(
    path: str | Path, wanted: Mapping[str, ColumnSource], grid: tuple[int, int], ratio: float
) -> AmplitudeAndPhase:
    curves = read_curves(path, columns=wanted)
    rows, columns = grid
    if len(curves) != rows * columns:
        raise TableError(
            f"{path}: holds {len(curves)} curves, not {rows} x {columns} = {rows * columns}; correct `grid=...`"
        )
    if any(curve.amplitude is None or curve.phase_lag_deg is None for curve in curves):
        raise TableError(f"{path}: the curves have no amplitude or no phase; say `columns=...`")
    values = []
    for curve in curves:
        approach = curve.branch == ("approach" if "approach" in curve.branch else "retract")
        values.append(
            _read_at(curve.offset_nm[approach], curve.amplitude[approach], curve.phase_lag_deg[approach], ratio)  # type: ignore[index]
        )
    maps = _maps(values, grid)
    return AmplitudeAndPhase(
        source=str(path),
        amplitude_unit=curves[0].amplitude_unit,
        known=curves[0].known,
        notes=(_note_of_curves(ratio, maps["amplitude"]),),
        **maps,
    )


def _heights(images: Images, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Return the heights of a grid's curves, of every pixel or of all."""
    names = [n for n in images.channels if re.fullmatch(r"(z|height|offset).*", n, re.IGNORECASE)]
    if not names:
        raise TableError(f"{images.source}: a grid of curves needs the array of their heights, as height_nm")
    height = np.asarray(images.channels[names[0]], dtype=float) * UNITS.get(_unit_of(names[0]), ("", 1.0))[1]
    if height.shape not in {shape, shape[2:]}:
        raise TableError(f"{images.source}: the heights have the shape {height.shape}, the amplitudes {shape}")
    return height


def _at_ratio(
    height: Float[np.ndarray, "..."],
    amplitude: Float[np.ndarray, "rows columns points"],
    phase: Float[np.ndarray, "rows columns points"],
    ratio: float,
) -> dict[str, Any]:
    """Return the arrays of `AmplitudeAndPhase` for a grid of curves."""
    rows, columns, _ = amplitude.shape
    height = np.broadcast_to(height, amplitude.shape)
    pixels = [(i, j) for i in range(rows) for j in range(columns)]
    return _maps([_read_at(height[at], amplitude[at], phase[at], ratio) for at in pixels], (rows, columns))


def _maps(values: list[tuple[float, float, float, float]], grid: tuple[int, int]) -> dict[str, Any]:
    columns = np.array(values).T.reshape(4, *grid)
    return dict(zip(("amplitude", "phase_deg", "free_amplitude", "free_phase_deg"), columns, strict=True))


def _note_of_curves(ratio: float, amplitude: Float[np.ndarray, "rows columns"]) -> str:
    missing = int(np.sum(~np.isfinite(amplitude)))
    of = f"; {missing} curves do not come there" if missing else ""
    return (
        f"Curves: each pixel is its curve at {ratio:g} of its own free amplitude, zero of the phase from its own free "
        f"rows{of} (`ratio=...`)."
    )


_FREE_SHARE = 4
_AROUND = 2


def _read_at(
    height: Float[np.ndarray, " points"],
    amplitude: Float[np.ndarray, " points"],
    phase: Float[np.ndarray, " points"],
    ratio: float,
) -> tuple[float, float, float, float]:
    """Return amplitude and phase of a curve where it falls to a share of the free amplitude for good, and the free."""
    nothing = (np.nan, np.nan, np.nan, np.nan)
    known = np.isfinite(height) & np.isfinite(amplitude) & np.isfinite(phase)
    if known.sum() < 2 * _FREE_SHARE:
        return nothing
    order = np.argsort(height[known], kind="stable")
    amplitude, phase = amplitude[known][order], phase[known][order]
    ends = len(order) // _FREE_SHARE
    if np.median(amplitude[:ends]) < np.median(amplitude[-ends:]):
        amplitude, phase = amplitude[::-1], phase[::-1]
    free, zero = float(np.median(amplitude[:ends])), float(np.median(phase[:ends]))
    above = np.flatnonzero(amplitude >= ratio * free)
    if not above.size or above[-1] + 1 == len(amplitude):
        return np.nan, np.nan, free, zero
    # the last rows above and the first below, by a straight line of the phase over the amplitude
    rows = slice(max(above[-1] - _AROUND, 0), above[-1] + 2 + _AROUND)
    near, lags = amplitude[rows], phase[rows]
    slope = np.polyfit(near - ratio * free, lags, 1) if np.ptp(near) > 0.0 else np.array([0.0, lags.mean()])
    return ratio * free, float(slope[1]), free, zero
