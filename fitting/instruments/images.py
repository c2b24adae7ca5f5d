"""Amplitude and phase of every pixel, out of arrays and the files of images that instruments write.

Asylum's .ibw is read by igor2 (`pip install 'afm-jax[instruments]'`), every other format by gwyddionpy, which runs
Gwyddion's own readers on the file (`pip install 'afm-jax[gwyddion]'`). NumPy's arrays and text of numbers need nothing.
"""

import io
import re
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.whole_files import LARGEST_BYTES
from afm_jax.words import printable
from fitting.instruments.columns import ColumnSource, checked_unit, parse_columns
from fitting.instruments.formats import igor_wave, is_igor
from fitting.instruments.recording import (
    UNITS,
    Known,
    damaged_as_one_line,
    known_from,
    number_in,
    package_for,
    refuse_other_modes,
    unit_named,
)
from fitting.tables.csv_text import TableError, read_bytes

_ROLES = {
    "lockin_amplitude_nm": (r"(lock-?in[_ ])?amp(?![a-z]* ?2).*", "nm"),
    "phase_lag_deg": (r"(lock-?in[_ ])?pha(?![a-z]* ?2).*", "deg"),
}
"""What channels of amplitude and phase are called (no case; those of a second mode are Amplitude2 and Phase2), and the
unit of one that says none."""
_ROWS_OF_NUMBERS = re.compile(rb"(\xef\xbb\xbf)?(#[^\n]*\n|\s)*([-+.\d]|nan\b)", re.IGNORECASE)
"""How text of numbers begins, below comments."""
_PATIENCE_S = 60.0
"""That Gwyddion's program may take for a file; an image takes it less than a second."""


class AmplitudeAndPhase(NamedTuple):
    """Amplitude and phase of every pixel.

    Attributes:
        source: of the file.
        amplitude: in nm or V, shape (rows, columns).
        in_volts: whether it is in V.
        phase_deg: as the instrument counts it.
        sense: 1 or -1 where a factor of the phase states that it lags or leads, else 0.
        known: what the file says.
        size_m: height and width, or None.
        note: which channels were taken.
    """

    source: str
    amplitude: Float[np.ndarray, "rows columns"]
    in_volts: bool
    phase_deg: Float[np.ndarray, "rows columns"]
    sense: float
    known: dict[str, Known]
    size_m: tuple[float, float] | None
    note: str


class _Images(NamedTuple):
    """The images of a file: numbers and unit of each channel, settings in the file's words, what of them is known."""

    channels: dict[str, tuple[np.ndarray, str]]
    settings: Mapping[str, str] = {}
    known: Mapping[str, Known] = {}
    size_m: tuple[float, float] | None = None


def read_images(
    path: str | Path | tuple[np.ndarray, np.ndarray], phase_path: str | Path | None = None, *, columns: str = ""
) -> AmplitudeAndPhase:
    """Return amplitude and phase of every pixel of an image.

    Args:
        path: NumPy .npz or .npy, text of numbers (one channel), Asylum .ibw or any format that Gwyddion reads; or the
            arrays of amplitude in nm and phase in degrees, the channels `amplitude` and `phase`.
        phase_path: file of the phase, where amplitude and phase are two.
        columns: which channel is which, as for `read_curves`; a factor of the phase, 1 or -1, says that it lags or
            leads.

    Raises:
        TableError: one line: the file is damaged, of no known format or of another mode, has no such channel, or the
            package that reads it is missing.
    """
    if isinstance(path, tuple):
        name, images = "arrays", _Images({"amplitude": (path[0], "nm"), "phase": (path[1], "deg")})
    else:
        name, images = printable(str(path)), _images(path)
    if phase_path is not None:
        second = _images(phase_path)
        name = f"{name} and {printable(str(phase_path))}"
        # a file that is said to hold a role does, whatever its channel is called
        first, other = (
            one.channels[_named(one, role) or next(iter(one.channels))]
            for role, one in zip(_ROLES, (images, second), strict=True)
        )
        channels = {"amplitude": first, "phase": other}
        images = images._replace(channels=channels, settings={**second.settings, **images.settings})
    refuse_other_modes(images.settings, name)
    wanted = parse_columns(columns)
    taken = {role: _channel(images, role, wanted.get(role), name) for role in _ROLES}
    amplitude, phase = (
        np.asarray(images.channels[one.channel][0], dtype=float) * (abs(one.factor or 1.0) * UNITS[one.unit][1])
        for one in taken.values()
    )
    if amplitude.shape != phase.shape or amplitude.ndim != 2:
        one, other = (" x ".join(map(str, image.shape)) for image in (amplitude, phase))
        raise TableError(f"{name}: the amplitude has {one} pixels, the phase {other}; they must be rows of one size")
    return AmplitudeAndPhase(
        source=name,
        amplitude=amplitude,
        in_volts=UNITS[taken["lockin_amplitude_nm"].unit][0] == "voltage",
        phase_deg=phase,
        sense=float(np.sign(taken["phase_lag_deg"].factor or 0.0)),
        known=dict(images.known),
        size_m=images.size_m,
        note=f"Channels: {', '.join(f'{r} is {s.channel!r} in {s.unit}' for r, s in taken.items())}.",
    )


def _named(images: _Images, role: str) -> str:
    """Return the first channel that is called as one of a role, "" without any."""
    return next((name for name in images.channels if re.fullmatch(_ROLES[role][0], name, re.IGNORECASE)), "")


def _channel(images: _Images, role: str, source: ColumnSource | None, name: str) -> ColumnSource:
    """Return the channel of a role with its unit.

    Raises:
        TableError: if there is none, or its unit is none of the role.
    """
    usual, listed = _ROLES[role][1], ", ".join(images.channels)
    source = source or ColumnSource(_named(images, role))
    if source.channel not in images.channels:
        what = f"there is no channel `{source.channel}`" if source.channel else "no channel has such a name"
        raise TableError(
            f'{name}: {what} for {role}, of {listed}; say `columns="{role}=CHANNEL:{usual}"`, or give amplitude and '
            "phase as two files"
        )
    unit = source.unit or images.channels[source.channel][1] or usual
    return ColumnSource(source.channel, checked_unit(unit, role, source.channel, name), source.factor)


# ---- formats


def _images(path: str | Path) -> _Images:
    name, data = printable(str(path)), read_bytes(path, "one file")
    with damaged_as_one_line(name):
        if data.startswith((b"PK", b"\x93NUMPY")):
            return _of_numpy(np.load(io.BytesIO(data), allow_pickle=False), name)
        if is_igor(data):
            return _of_igor(*igor_wave(data, name), name)
        if _ROWS_OF_NUMBERS.match(data):
            return _of_text(data.decode("utf-8-sig"), name)
        return _of_others(Path(path), name)


def _of_text(text: str, name: str) -> _Images:
    rows = re.sub("[\t;,]", " ", text).splitlines()
    return _Images({printable(Path(name).stem): (np.loadtxt(rows, ndmin=2), "")})


def _of_numpy(loaded: Any, name: str) -> _Images:
    arrays = dict(loaded) if hasattr(loaded, "files") else dict(zip(("amplitude", "phase"), loaded, strict=False))
    spelled = {unit.lower(): unit for unit in UNITS}
    channels = {
        printable(key): (array, spelled.get(key.rpartition("_")[2].lower(), ""))
        for key, array in arrays.items()
        if array.ndim == 2 and array.dtype.kind in "fiu"
    }
    if not channels:
        raise TableError(f"{name}: holds no array of two dimensions (rows, columns)")
    return _Images(channels)


def _of_igor(
    numbers: np.ndarray, labels: list[str], settings: dict[str, str], known: dict[str, Known], name: str
) -> _Images:
    if numbers.ndim != 3 or len(labels) != numbers.shape[2]:
        raise TableError(
            f"{name}: holds an array of {numbers.ndim} dimensions, not images; a ramp is for `afm-jax tapping`"
        )
    # Igor counts columns first, and rows from below
    units = ["deg" if re.fullmatch(_ROLES["phase_lag_deg"][0], label, re.IGNORECASE) else "m" for label in labels]
    channels = {label: (numbers[:, ::-1, k].T, units[k]) for k, label in enumerate(labels)}
    sides = [number_in(settings.get(key, "")) for key in ("SlowScanSize", "FastScanSize")]
    return _Images(channels, settings, known, None if None in sides else (sides[0][0], sides[1][0]))  # type: ignore[index]


def _of_others(path: Path, name: str) -> _Images:
    """Return what Gwyddion's program finds in a file of any other format; its time and its output are limited."""
    package = package_for("gwyddionpy", "gwyddion", f"{name}: images of this format")
    # not on Windows
    system = import_module("resource") if find_spec("resource") else None
    before = system.getrlimit(system.RLIMIT_FSIZE) if system else (0, 0)
    try:
        if system:
            lowest = min(limit for limit in (LARGEST_BYTES, *before) if limit >= 0)
            system.setrlimit(system.RLIMIT_FSIZE, (lowest, before[1]))
        # an absolute path cannot be taken for an option
        found = list(package.load(path.resolve(), timeout=_PATIENCE_S).channels.values())
    except package.GwyddionPyError as error:
        why = printable(str(error).rpartition("gwyconvert: ")[2].splitlines()[0])
        raise TableError(f"{name}: gwyddionpy does not read it ({why[:200]}); export it as .gwy") from None
    finally:
        if system:
            system.setrlimit(system.RLIMIT_FSIZE, before)
    channels: dict[str, tuple[np.ndarray, str]] = {}
    settings: dict[str, str] = {}
    for one in found:
        # of a title the first
        channels.setdefault(printable(one.name), (one.data, unit_named(one.si_unit_z)))
        settings = {str(key): str(value) for key, value in one.meta.items()} | settings
    if not channels:
        raise TableError(f"{name}: holds no image; a curve is for `afm-jax tapping`")
    return _Images(channels, settings, known_from(settings), (float(found[0].yreal), float(found[0].xreal)))
