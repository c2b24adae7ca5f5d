"""Maps: energy of a tap and virial in every pixel of an image of amplitude and phase, with their errors.

Pixels are rows of `energies`. The free tip must be recorded with the image: every energy depends on the zero of
the phase, which nothing else determines.
"""

import enum
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from afm_jax.checks import checked
from afm_jax.results import JudgedResult, public_result
from afm_jax.saved import as_json
from afm_jax.strict_json import plain
from afm_jax.units import TWO_SIDED_95, words_of
from fitting.instruments.images import AmplitudeAndPhase, read_images
from fitting.instruments.lag import free_lag_deg, sense_of_phase, turned
from fitting.instruments.recording import ASSUMED_RESONANCE, UNIT_OF, Known, given_numbers
from fitting.parameters import USUAL_ERRORS
from fitting.tables.csv_text import TableError
from fitting.tapping_curves.curve import HARMONICS_FACTOR, Given, Instrument, Rows, TappingCurve, phase_readings
from fitting.tapping_curves.energy import energies, noise_of

_BEYOND = 3.0
"""Standard errors beyond which a pixel is out of range."""
_USUAL = USUAL_ERRORS | {"free_amplitude_nm": 0.005}
"""Relative standard errors of what is given without one."""
_BLOCK = 1 << 16
"""Pixels that are computed at once: more of them leave the processor's cache, and take twice as long."""
_UNITS = {key: unit for key, unit in UNIT_OF.items() if key != "offset_origin_nm"}
_OVER_IT = "not known: energies are over it, in nm^2"
_NEEDED = {"free_frequency_khz": "KHZ", "quality_factor": "Q", "free_amplitude_nm": "NM", "free_phase_deg": "DEGREES"}
ARRAYS = ("energy", "energy_error", "virial", "virial_error")


class PixelState(enum.IntEnum):
    """What became of a pixel."""

    USED = 0
    AMPLITUDE_ABOVE_FREE = 1
    ENERGY_BELOW_ZERO = 2
    NOT_MEASURED = 3


@public_result(
    picture="fitting.tapping_curves.map_report:map_figure",
    home="fitting.tapping_curves.map_report",
    state=PixelState,
)
@dataclass(frozen=True, eq=False, kw_only=True)
class TappingMap(JudgedResult):
    """Energy and virial of a tap in every pixel, NaN where a pixel is out of range or nothing was measured.

    Attributes:
        source: path of the image's file, or where else it is from.
        drive: "force" on the tip, or its "base".
        unit: of energies and virials, "aJ", or "nm^2" where the spring constant is not known: energies over it.
        energy: energy lost in a tap, in `unit`.
        energy_error: standard errors of the energies from each pixel's own noise.
        virial: mean of force times height, positive where attraction prevails.
        virial_error: standard errors of the virials from each pixel's own noise.
        state: a `PixelState` for each pixel.
        energy_common_error: standard error of the energy that all pixels have in common, at the median energy.
        virial_common_error: standard error of the virial that all pixels have in common, at the median energy.
        common: parts of `energy_common_error` by what they come from, with their signs.
        reasons: why the energies must not be used; empty if they may.
        size_m: height and width of the image in m, or None.
        known: the assumed numbers of the instrument, with their origins.
        notes: what was assumed.
    """

    source: str
    drive: str
    unit: str
    energy: Float[np.ndarray, "rows columns"]
    energy_error: Float[np.ndarray, "rows columns"]
    virial: Float[np.ndarray, "rows columns"]
    virial_error: Float[np.ndarray, "rows columns"]
    state: Int[np.ndarray, "rows columns"]
    energy_common_error: float
    virial_common_error: float
    common: dict[str, float]
    reasons: tuple[str, ...] = ()
    size_m: tuple[float, float] | None = None
    known: dict[str, Known] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """How many pixels are in each state, by its name in words."""
        return {state.name.lower().replace("_", " "): int(np.sum(self.state == state)) for state in PixelState}


@as_json.register
def _(image: TappingMap) -> dict[str, Any]:
    # all but the arrays, and of these the median and the ends of 95 % of the pixels in range
    used = image.state == PixelState.USED
    ends = {"percentile_2_5": 2.5, "median": 50.0, "percentile_97_5": 97.5}
    arrays = {
        name: {end: np.percentile(getattr(image, name)[used], p) if used.any() else None for end, p in ends.items()}
        for name in ARRAYS
    }
    own = {name: value for name, value in vars(image).items() if name not in {*ARRAYS, "state"}}
    pixels = {"rows": used.shape[0], "columns": used.shape[1], **image.counts}
    known = {key: vars(one) for key, one in image.known.items()}
    head = {"format": "afm-jax tapping-map", "format_version": 1}
    return plain(head | own | arrays | {"valid": image.valid, "pixels": pixels, "known": known})


@checked
def tapping_map(
    images: AmplitudeAndPhase | str | Path | tuple[Any, Any],
    *,
    columns: str = "",
    drive: Literal["base", "force"] = "base",
    phase_sense: Literal["lag", "lead"] | None = None,
    amplitude_error_nm: float | None = None,
    phase_error_deg: float | None = None,
    **given: Any,
) -> TappingMap:
    """Return energy and virial of a tap in every pixel of an image of amplitude and phase.

    Args:
        images: a file for `read_images`, what that returned, or the arrays of amplitude in nm and phase in degrees.
        columns: which channel is which, as for `read_images`, where `images` does not come from there.
        drive: what shakes the cantilever.
        phase_sense: whether the phase grows as the tip lags more, or falls; None: the energies decide where they can.
        amplitude_error_nm: standard error of every pixel's amplitude; else from the roughness along its lines.
        phase_error_deg: of every pixel's phase; else likewise.
        given: instead of the file's, each a number, a pair with its standard error or '44 +- 4': free_frequency_khz,
            quality_factor, spring_constant_n_per_m (left out: energies over it, in nm^2), free_amplitude_nm and
            free_phase_deg (what the instrument reads with the tip free), drive_frequency_khz (left out: on resonance),
            nm_per_volt, tip_calibration.

    Raises:
        TableError: if the images do not fit, or something is missing that no energy can do without.
        TypeError: if an argument is of another kind.
    """
    if not isinstance(images, AmplitudeAndPhase):
        images = read_images(images, columns=columns)
    notes = [images.note]
    known = _known(images, given)
    common = _with_errors(known)
    amplitude = images.amplitude * (common["nm_per_volt"].value if images.in_volts else 1.0)
    measured = np.isfinite(amplitude) & (amplitude > 0.0) & np.isfinite(images.phase_deg)
    if not measured.any():
        raise TableError(f"{images.source}: no pixel has both an amplitude above 0 and a phase")
    behind = turned(images.phase_deg - common["free_phase_deg"].value)
    noise = (
        _roughness(amplitude, images.source) if amplitude_error_nm is None else amplitude_error_nm,
        _roughness(behind, images.source) if phase_error_deg is None else phase_error_deg,
    )
    if amplitude_error_nm is None or phase_error_deg is None:
        notes.append(
            f"Noise: {noise[0]:.3g} nm and {noise[1]:.3g} degrees a pixel, from the roughness along the lines "
            "(`amplitude_error_nm=...`, `phase_error_deg=...`)."
        )
    pixels = np.flatnonzero(measured)
    # 4096 pixels, evenly chosen, determine the sign of the phase, the free tip in front
    some = pixels[np.linspace(0, len(pixels) - 1, min(len(pixels), 4096)).astype(int)]
    free, free_phase = common["free_amplitude_nm"], common["free_phase_deg"]
    seen = map(np.append, (free.value, free_phase.value), (amplitude.ravel()[some], images.phase_deg.ravel()[some]))
    rows = _rows_of(drive, common, (noise[0], float(np.hypot(noise[1], free_phase.error))), *seen)
    readings = phase_readings(rows, np.arange(rows.rows) == 0)
    sense = sense_of_phase(readings, phase_sense or {1.0: "lag", -1.0: "lead"}.get(images.sense, ""))
    notes += sense.notes
    if sense.origin == "assumed":
        # energies of both signs differ as by a change of f0 that takes 1 - s^2 to its opposite
        f0, error = common["free_frequency_khz"]
        common["free_frequency_khz"] = Given(f0, error + readings.detuning * f0)

    def energies_of(chosen: np.ndarray, at: dict[str, Given]) -> Float[np.ndarray, "2 2 pixels"]:
        """Return energies and virials of pixels and their errors from noise."""
        f0, q = at["free_frequency_khz"].value, at["quality_factor"].value
        lag = sense.sign * turned(images.phase_deg.ravel()[chosen] - at["free_phase_deg"].value)
        lag += free_lag_deg(drive, at["drive_frequency_khz"].value / f0, q)
        curve = _rows_of(drive, at, noise, amplitude.ravel()[chosen], lag)
        found = energies(curve, Instrument(f0, q, harmonics_factor=at["harmonics_factor"].value))
        return np.array([(found.energy_aj, found.virial_aj), noise_of(curve, found)])

    blocks = [pixels[first : first + _BLOCK] for first in range(0, len(pixels), _BLOCK)]
    values, own = np.concatenate([energies_of(block, common) for block in blocks], axis=2)
    median = int(np.argsort(values[0])[(values.shape[1] - 1) // 2])
    changes = {
        name: energies_of(pixels[[median]], common | {name: Given(sum(one))})[0, :, 0] - values[:, median]
        for name, one in common.items()
        if one.error
    }
    energy_error, virial_error = np.linalg.norm(list(changes.values()), axis=0).tolist()
    inside, gains = PixelState.USED, values[0] < -_BEYOND * np.hypot(own[0], energy_error)
    above = amplitude[measured] > free.value + _BEYOND * noise[0]
    state = np.full(amplitude.shape, PixelState.NOT_MEASURED, dtype=np.int8)
    state[measured] = np.select([above, gains], [PixelState.AMPLITUDE_ABOVE_FREE, PixelState.ENERGY_BELOW_ZERO], inside)
    arrays = np.full((4, *amplitude.shape), np.nan)
    arrays[:, state == inside] = np.stack([values[0], own[0], values[1], own[1]])[:, state[measured] == inside]
    unit = "aJ" if common["spring_constant_n_per_m"].error else "nm^2"
    parts = {name: float(change[0]) for name, change in changes.items()}
    of_pixel = parts | {"noise_of_a_pixel": float(own[0, median])}
    why = _reasons(float(values[0, median]), energy_error, of_pixel, state, unit)
    return TappingMap(
        source=images.source,
        drive=drive,
        unit=unit,
        **dict(zip(ARRAYS, arrays, strict=True)),
        state=state,
        energy_common_error=energy_error,
        virial_common_error=virial_error,
        common=parts,
        reasons=(*filter(None, [sense.reason]), *why),
        size_m=images.size_m,
        known=known,
        notes=tuple(notes),
    )


def _known(images: AmplitudeAndPhase, given: dict[str, Any]) -> dict[str, Known]:
    """Return what is known of the instrument: as given, else as the file says it.

    Raises:
        TableError: if something is missing.
    """
    known = {key: one for key, one in images.known.items() if key in _UNITS}
    known |= given_numbers(given, _UNITS)
    needed = _NEEDED | ({"nm_per_volt": "NM"} if images.in_volts else {})
    missing = " ".join(f"`{key}={unit}`" for key, unit in needed.items() if key not in known)
    if missing:
        free = "free_amplitude_nm" in missing or "free_phase_deg" in missing
        record = "; record amplitude and phase of the free tip, off the sample and at the same drive" if free else ""
        raise TableError(f"{images.source}: the file does not say all that an energy needs; give {missing}{record}")
    assumed = {
        "drive_frequency_khz": Known(known["free_frequency_khz"].value, "kHz", ASSUMED_RESONANCE),
        "spring_constant_n_per_m": Known(1.0, "N/m", _OVER_IT),
        "tip_calibration": Known(1.0, "", "assumed"),
    }
    return known | {key: one for key, one in assumed.items() if key not in known}


def _with_errors(known: dict[str, Known]) -> dict[str, Given]:
    """Return what all pixels have in common, with usual errors where none is given; 0: it does not count."""
    common = {}
    for key, one in known.items():
        value = float(one.value)
        # a phase of the free tip is read to 0.2 degrees
        usual = 0.2 if key == "free_phase_deg" else _USUAL.get(key, 0.0) * abs(value)
        common[key] = Given(value, (one.error or usual) if usual and one.origin != _OVER_IT else 0.0)
    scale = known.get("nm_per_volt")
    if scale is not None and scale.error:
        # free amplitude and amplitudes go with it, as with the calibration
        value, error = common["tip_calibration"]
        common["tip_calibration"] = Given(value, float(np.hypot(error, scale.error / float(scale.value))))
    return common | {"harmonics_factor": HARMONICS_FACTOR}


def _roughness(image: Float[np.ndarray, "rows columns"], source: str) -> float:
    """Return the noise of a pixel: the spread of second differences along the lines, robust against edges.

    Raises:
        TableError: if no three pixels stand side by side.
    """
    second = image[:, :-2] - 2.0 * image[:, 1:-1] + image[:, 2:]
    second = second[np.isfinite(second)]
    if not second.size:
        numbers = "`amplitude_error_nm=NM` and `phase_error_deg=DEGREES`"
        raise TableError(f"{source}: no three pixels stand side by side to read the noise off; give {numbers}")
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0))


def _rows_of(
    drive: Literal["base", "force"], at: dict[str, Given], noise: tuple[float, float], amplitude: Rows, lag: Rows
) -> TappingCurve:
    """Return pixels as the rows of a tapping curve."""
    ones, free = np.ones(len(amplitude)), at["free_amplitude_nm"]
    names = ("free_frequency_khz", "quality_factor", "spring_constant_n_per_m", "tip_calibration")
    lever: dict[str, Any] = {name: at[name] for name in names}
    return TappingCurve(
        source="",
        drive=drive,
        offset_nm=ones,
        amplitude_nm=amplitude,
        amplitude_error_nm=noise[0] * ones,
        lag_deg=lag,
        lag_error_deg=noise[1] * ones,
        free_amplitude_nm=free.value * ones,
        free_amplitude_error=free.error / free.value,
        drive_frequency_khz=at["drive_frequency_khz"].value * ones,
        retract=ones < 0.0,
        lines=np.arange(len(amplitude)),
        **lever,
    )


def _reasons(
    energy: float, common: float, parts: dict[str, float], state: Int[np.ndarray, "rows columns"], unit: str
) -> list[str]:
    """Return why the energies must not be used.

    Args:
        energy: of the median pixel.
        common: its standard error that all pixels have in common.
        parts: errors of that energy by what they come from.
        state: of all pixels.
        unit: of energies.
    """
    used, above, below = (int(np.sum(state == one)) for one in list(PixelState)[:3])
    doubt = "free amplitude, its phase, quality factor or units do not belong to this image"
    total, reasons = float(np.hypot(common, parts["noise_of_a_pixel"])), []
    low, high = max(energy - TWO_SIDED_95 * total, 0.0), energy + TWO_SIDED_95 * total
    if used < above + below:
        why = f"{above} with an amplitude above the free one, {below} with an energy below zero"
        reasons = [f"only {used} of {used + above + below} pixels are in range ({why}): {doubt}"]
    if energy + TWO_SIDED_95 * common < 0.0:
        beyond = f"{energy:.3g} +- {common:.2g} {unit}"
        reasons.append(f"the median energy is below zero beyond its errors ({beyond}): {doubt}")
    elif TWO_SIDED_95 * total > 0.5 * energy:
        most = max(parts, key=lambda name: abs(parts[name]))
        reasons.append(
            f"the energy of a tap is only bracketed, {low:.2g} to {high:.2g} {unit} in the median pixel "
            f"({energy:.3g} +- {total:.2g}); most of its error comes from {words_of(most)}"
        )
    return reasons
