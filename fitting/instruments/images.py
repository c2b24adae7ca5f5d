"""Amplitude and phase of every pixel, out of arrays and the files of images that instruments write.

Asylum's .ibw is read by igor2 (`pip install 'afm-jax[instruments]'`), every other format by gwyddionpy, which runs
Gwyddion's own readers on the file (`pip install 'afm-jax[gwyddion]'`). NumPy's arrays need nothing.
"""

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.words import printable
from fitting.instruments.columns import needed_channel, parse_columns
from fitting.instruments.formats import IGOR, name_and_unit, parse_igor
from fitting.instruments.recording import (
    UNITS,
    Known,
    Recording,
    Segment,
    damaged_as_one_line,
    package_for,
    refuse_other_modes,
    unit_named,
)
from fitting.tables.csv_text import TableError, read_bytes

_ROLES = {"lockin_amplitude_nm": "amplitude", "phase_lag_deg": "phase"}
"""What is read of images, and what arrays of it are called."""
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


def read_images(path: str | Path | tuple[Any, Any], *, columns: str = "") -> AmplitudeAndPhase:
    """Return amplitude and phase of every pixel of an image.

    Args:
        path: NumPy .npz or .npy, Asylum .ibw or any format that Gwyddion reads; or the arrays of amplitude in nm and
            phase in degrees, the channels `amplitude` and `phase`.
        columns: which channel is which, as for `read_curves`; a factor of the phase, 1 or -1, says that it lags or
            leads.

    Raises:
        TableError: one line: the file is damaged, of no known format or of another mode, has no such channel, or the
            package that reads it is missing.
    """
    if isinstance(path, tuple):
        channels = dict(zip(_ROLES.values(), path, strict=True))
        images = Recording("arrays", "arrays", (Segment(1, "", channels),), {"amplitude": "nm", "phase": "deg"})
    else:
        images = _read(path)
    refuse_other_modes(images.settings, images.source)
    wanted = parse_columns(columns)
    taken = {role: needed_channel(images, role, wanted, _ROLES) for role in _ROLES}
    amplitude, phase = (
        np.asarray(images.segments[0].channels[one.channel], float) * (abs(one.factor or 1.0) * UNITS[one.unit][1])
        for one in taken.values()
    )
    if amplitude.shape != phase.shape or amplitude.ndim != 2:
        one, other = (" x ".join(map(str, image.shape)) for image in (amplitude, phase))
        raise TableError(
            f"{images.source}: the amplitude has {one} pixels, the phase {other}; they must be rows of one size"
        )
    return AmplitudeAndPhase(
        source=images.source,
        amplitude=amplitude,
        in_volts=UNITS[taken["lockin_amplitude_nm"].unit][0] == "voltage",
        phase_deg=phase,
        sense=float(np.sign(taken["phase_lag_deg"].factor or 0.0)),
        known=dict(images.known),
        size_m=images.size_m,
        note=f"Channels: {', '.join(f'{r} is {s.channel!r} in {s.unit}' for r, s in taken.items())}.",
    )


# ---- formats


def _read(path: str | Path) -> Recording:
    name, data = printable(str(path)), read_bytes(path, "one file")
    with damaged_as_one_line(name):
        if data.startswith((b"PK", b"\x93NUMPY")):
            loaded = np.load(io.BytesIO(data), allow_pickle=False)
            arrays = loaded if hasattr(loaded, "files") else dict(zip(_ROLES.values(), loaded, strict=False))
            arrays = {printable(key): array for key, array in arrays.items()}
            units = {key: name_and_unit(key)[1] for key in arrays}
            images = {key: image for key, image in arrays.items() if image.ndim == 2 and image.dtype.kind in "fiu"}
            if not images:
                raise TableError(f"{name}: holds no array of two dimensions (rows, columns)")
            return Recording("arrays", name, (Segment(1, "", images),), units)
        if data.startswith(IGOR):
            return parse_igor(data, name)
        return _of_others(Path(path), name)


def _of_others(path: Path, name: str) -> Recording:
    """Return what Gwyddion's program finds in a file of any other format, in a limited time."""
    package = package_for("gwyddionpy", "gwyddion", f"{name}: images of this format")
    try:
        # an absolute path cannot be taken for an option
        found = list(package.load(path.resolve(), timeout=_PATIENCE_S).channels.values())
    except package.GwyddionPyError as error:
        why = printable(str(error).rpartition("gwyconvert: ")[2].splitlines()[0])
        raise TableError(f"{name}: gwyddionpy does not read it ({why[:200]}); export it as .gwy") from None
    if not found:
        raise TableError(f"{name}: holds no image; a curve is for `afm-jax tapping`")
    # of a title the first
    channels = {printable(one.name): one.data for one in reversed(found)}
    units = {printable(one.name): unit_named(one.si_unit_z) for one in reversed(found)}
    settings = {str(key): str(value) for one in reversed(found) for key, value in one.meta.items()}
    size = float(found[0].yreal), float(found[0].xreal)
    segments = (Segment(1, "", dict(reversed(channels.items()))),)
    return Recording("Gwyddion", name, segments, units, settings=settings, size_m=size)
