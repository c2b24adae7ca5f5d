"""Maps: energy of a tap and virial in every pixel of an image of amplitude and phase, with their errors.

Pixels are rows of `energies`. The free tip must be recorded with the image: nothing else tells the zero of the phase,
on which every energy hangs.
"""

import enum
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from afm_jax.checks import checked
from afm_jax.results import Result, public_result, words_of
from afm_jax.strict_json import plain
from fitting.instruments.images import AmplitudeAndPhase, read_images
from fitting.instruments.lag import free_lag_deg
from fitting.instruments.recording import ASSUMED_RESONANCE, Known, given_numbers
from fitting.parameters import USUAL_ERRORS
from fitting.tables.csv_text import TableError
from fitting.tapping_curves.curve import HARMONICS_FACTOR, Given, Instrument, TappingCurve
from fitting.tapping_curves.energy import energies, noise_of, virial_noise_of

_BEYOND = 3.0
"""Standard errors beyond which a pixel is out of range."""
_BAND = 1.96
"""Standard errors of half a band of 95 %."""
_USUAL = USUAL_ERRORS | {"free_amplitude_nm": 0.005}
"""Relative standard errors of what is given without one."""
_USUAL_ZERO_DEG = 0.2
"""Standard error of the free tip's phase where it is given without one."""
_NEAR_DEG, _READS_DEG = 20.0, 2.0
"""How near to the opposite of its lag the free tip must read for a phase that leads to be the likelier one; how near to
its lag for the instrument to have no zero of its own."""
_BLOCK = 1 << 16
"""Pixels that are computed at once, for the memory."""
_UNITS = {
    "free_frequency_khz": "kHz",
    "drive_frequency_khz": "kHz",
    "quality_factor": "",
    "spring_constant_n_per_m": "N/m",
    "free_amplitude_nm": "nm",
    "free_phase_deg": "deg",
    "nm_per_volt": "nm/V",
    "tip_calibration": "",
}
_NEEDED = {"free_frequency_khz": "KHZ", "quality_factor": "Q", "free_amplitude_nm": "NM", "free_phase_deg": "DEGREES"}
ARRAYS = ("energy", "energy_error", "virial", "virial_error")


class PixelState(enum.IntEnum):
    """What became of a pixel."""

    USED = 0
    AMPLITUDE_ABOVE_FREE = 1
    ENERGY_BELOW_ZERO = 2
    NOT_MEASURED = 3


@public_result(picture="fitting.tapping_curves.map_report:map_figure", state=PixelState)
@dataclass(frozen=True, eq=False, kw_only=True)
class TappingMap(Result):
    """Energy and virial of a tap in every pixel, NaN where a pixel is out of range or nothing was measured.

    Attributes:
        source: path of the image's file, or where else it is from.
        drive: "force" on the tip, or its "base".
        unit: of energies and virials, "aJ", or "nm^2" where the spring constant is not known: energies over it.
        energy: energy that a tap takes, in `unit`.
        energy_error: standard errors of the energies from each pixel's own noise.
        virial: mean of force times height, positive where attraction prevails.
        virial_error: standard errors of the virials from each pixel's own noise.
        state: a `PixelState` for each pixel.
        energy_common_error: standard error of the energy that all pixels have in common, at the median energy.
        virial_common_error: standard error of the virial that all pixels have in common, at the median energy.
        common: parts of `energy_common_error` by what they come from, with their signs.
        reasons: why the energies must not be used; empty if they may.
        size_m: height and width of the image in m, or None.
        known: what was taken for the instrument, with where it comes from.
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
    def valid(self) -> bool:
        """Whether the energies may be used."""
        return not self.reasons

    @property
    def counts(self) -> dict[str, int]:
        """How many pixels are in each state, by its name in words."""
        return {state.name.lower().replace("_", " "): int(np.sum(self.state == state)) for state in PixelState}

    def to_dict(self) -> dict[str, Any]:
        """Return all but the arrays, and of these the median and the ends of 95 % of the pixels in range."""
        used = self.state == PixelState.USED
        ends = {"percentile_2_5": 2.5, "median": 50.0, "percentile_97_5": 97.5}
        arrays = {
            name: {end: np.percentile(getattr(self, name)[used], p) if used.any() else None for end, p in ends.items()}
            for name in ARRAYS
        }
        own = {name: value for name, value in vars(self).items() if name not in {*ARRAYS, "state"}}
        pixels = {"rows": used.shape[0], "columns": used.shape[1], **self.counts}
        known = {key: vars(one) for key, one in self.known.items()}
        return plain(own | arrays | {"valid": self.valid, "pixels": pixels, "known": known})


@checked
def tapping_map(
    images: AmplitudeAndPhase | str | Path | tuple[np.ndarray, np.ndarray],
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
        given: instead of the file's, each a number or a pair with its standard error: free_frequency_khz,
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
    known = _known(images, given, notes)
    value = {key: float(one.value) for key, one in known.items()} | {"harmonics_factor": HARMONICS_FACTOR.value}
    amplitude = images.amplitude * (value["nm_per_volt"] if images.in_volts else 1.0)
    behind = _half_turn(images.phase_deg - value["free_phase_deg"])
    measured = np.isfinite(amplitude) & (amplitude > 0.0) & np.isfinite(behind)
    if not measured.any():
        raise TableError(f"{images.source}: no pixel has both an amplitude above 0 and a phase")
    noise = [
        _roughness(amplitude, images.source) if amplitude_error_nm is None else amplitude_error_nm,
        _roughness(behind, images.source) if phase_error_deg is None else phase_error_deg,
    ]
    if amplitude_error_nm is None or phase_error_deg is None:
        notes.append(
            f"Noise: {noise[0]:.3g} nm and {noise[1]:.3g} degrees a pixel, from the roughness along the lines "
            "(`amplitude_error_nm=...`, `phase_error_deg=...`)."
        )
    stated = {"lag": 1.0, "lead": -1.0}.get(phase_sense or "", images.sense)
    senses = {
        sense: _taps(drive, value, _errors(known, value), amplitude[measured], sense * behind[measured], noise)
        for sense in ([stated] if stated else [1.0, -1.0])
    }
    taps, undecided = _sense(senses, value["free_phase_deg"], _free_lag(drive, value), notes)
    unit = "aJ" if _spring_is_known(known) else "nm^2"
    state = np.full(amplitude.shape, PixelState.NOT_MEASURED, dtype=np.int8)
    state[measured] = np.where(
        amplitude[measured] > value["free_amplitude_nm"] + _BEYOND * noise[0],
        PixelState.AMPLITUDE_ABOVE_FREE,
        np.where(taps.values[0] < -_BEYOND * taps.total_errors, PixelState.ENERGY_BELOW_ZERO, PixelState.USED),
    )
    arrays = np.full((4, *amplitude.shape), np.nan)
    arrays[:, measured] = np.stack([taps.values[0], taps.errors[0], taps.values[1], taps.errors[1]])
    arrays[:, state != PixelState.USED] = np.nan
    return TappingMap(
        source=images.source,
        drive=drive,
        unit=unit,
        **dict(zip(ARRAYS, arrays, strict=True)),
        state=state,
        energy_common_error=taps.common_error,
        virial_common_error=float(np.linalg.norm([change[1] for change in taps.common.values()])),
        common={name: change[0] for name, change in taps.common.items()},
        reasons=tuple(filter(None, [undecided, *_reasons(taps, state, unit)])),
        size_m=images.size_m,
        known=known,
        notes=tuple(notes),
    )


def _known(images: AmplitudeAndPhase, given: dict[str, Any], notes: list[str]) -> dict[str, Known]:
    """Return what is known of the instrument: as given, else as the file says it.

    Raises:
        TableError: if something is missing.
    """
    known = {key: one for key, one in images.known.items() if key in _UNITS}
    known |= given_numbers(given, _UNITS, any_sign=("free_phase_deg",))
    needed = _NEEDED | ({"nm_per_volt": "NM"} if images.in_volts else {})
    missing = " ".join(f"`{key}={unit}`" for key, unit in needed.items() if key not in known)
    if missing:
        free = "free_amplitude_nm" in missing or "free_phase_deg" in missing
        record = "; record amplitude and phase of the free tip, off the sample and at the same drive" if free else ""
        raise TableError(f"{images.source}: the file does not say all that an energy needs; give {missing}{record}")
    if "drive_frequency_khz" not in known:
        known["drive_frequency_khz"] = Known(known["free_frequency_khz"].value, "kHz", ASSUMED_RESONANCE)
        notes.append(f"Drive frequency: {ASSUMED_RESONANCE}.")
    if "spring_constant_n_per_m" not in known:
        known["spring_constant_n_per_m"] = Known(1.0, "N/m", "not known: energies are over it, in nm^2")
        notes.append("The spring constant is not known: energies and virials are over it, in nm^2 (1 aJ over 1 N/m).")
    known.setdefault("tip_calibration", Known(1.0, "", "assumed"))
    return known


def _spring_is_known(known: dict[str, Known]) -> bool:
    return not known["spring_constant_n_per_m"].origin.startswith("not known")


def _errors(known: dict[str, Known], value: dict[str, float]) -> dict[str, float]:
    """Return the standard errors of what all pixels have in common."""
    errors = {key: known[key].error or usual * value[key] for key, usual in _USUAL.items()}
    errors |= {"free_phase_deg": known["free_phase_deg"].error or _USUAL_ZERO_DEG}
    errors |= {"harmonics_factor": HARMONICS_FACTOR.error}
    if not _spring_is_known(known):
        del errors["spring_constant_n_per_m"]
    scale = known.get("nm_per_volt")
    if scale is not None and scale.error:
        # free amplitude and amplitudes go with it, as with the calibration
        errors["tip_calibration"] = float(np.hypot(errors["tip_calibration"], scale.error / float(scale.value)))
    return errors


def _half_turn(degrees: Any) -> Any:
    """Return angles between -180 and 180 degrees."""
    return (degrees + 180.0) % 360.0 - 180.0


def _free_lag(drive: str, value: dict[str, float]) -> float:
    """Return the lag of the free tip in degrees."""
    ratio = value["drive_frequency_khz"] / value["free_frequency_khz"]
    return float(free_lag_deg(drive, ratio, value["quality_factor"]))


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


class _Taps(NamedTuple):
    """Energies and virials of pixels for one sense of the phase.

    Attributes:
        values: energies and virials.
        errors: their standard errors from each pixel's own noise.
        median: place of the median energy.
        common: how energy and virial there change with one standard error of each number that all pixels share.
    """

    values: Float[np.ndarray, "2 pixels"]
    errors: Float[np.ndarray, "2 pixels"]
    median: int
    common: dict[str, list[float]]

    @property
    def energy(self) -> float:
        """The median energy."""
        return float(self.values[0, self.median])

    @property
    def common_error(self) -> float:
        """The standard error of the median energy that all pixels have in common."""
        return float(np.linalg.norm([change[0] for change in self.common.values()]))

    @property
    def total_errors(self) -> Float[np.ndarray, " pixels"]:
        """Standard errors of the energies, own noise and what all have in common together."""
        return np.hypot(self.errors[0], self.common_error)

    @property
    def possible(self) -> bool:
        """Whether the median energy is not below zero beyond its errors."""
        return self.energy + _BAND * self.common_error >= 0.0


def _taps(
    drive: Literal["base", "force"],
    value: dict[str, float],
    errors: dict[str, float],
    amplitude: Float[np.ndarray, " pixels"],
    behind: Float[np.ndarray, " pixels"],
    noise: list[float],
) -> _Taps:
    """Return what pixels mean that lag behind the free tip by so many degrees."""
    blocks = [slice(first, first + _BLOCK) for first in range(0, len(amplitude), _BLOCK)]
    parts = [_of_rows(drive, value, amplitude[block], behind[block], noise) for block in blocks]
    values, own = np.concatenate(parts, axis=2)
    median = int(np.argsort(values[0])[(len(amplitude) - 1) // 2])
    common = {}
    for name, error in errors.items():
        turned = behind[[median]] - (error if name == "free_phase_deg" else 0.0)
        changed = _of_rows(drive, value | {name: value[name] + error}, amplitude[[median]], turned, noise)
        common[name] = (changed[0, :, 0] - values[:, median]).tolist()
    return _Taps(values, own, median, common)


def _of_rows(
    drive: Literal["base", "force"],
    value: dict[str, float],
    amplitude: Float[np.ndarray, " pixels"],
    behind: Float[np.ndarray, " pixels"],
    noise: list[float],
) -> Float[np.ndarray, "2 2 pixels"]:
    """Return energies and virials of pixels and their errors from noise, as those of rows of a tapping curve."""
    ones, f0, q = np.ones(len(amplitude)), value["free_frequency_khz"], value["quality_factor"]
    curve = TappingCurve(
        source="",
        drive=drive,
        offset_nm=ones,
        amplitude_nm=amplitude,
        amplitude_error_nm=noise[0] * ones,
        lag_deg=_free_lag(drive, value) + behind,
        lag_error_deg=noise[1] * ones,
        free_amplitude_nm=value["free_amplitude_nm"] * ones,
        drive_frequency_khz=value["drive_frequency_khz"] * ones,
        retract=ones < 0.0,
        free_frequency_khz=Given(f0),
        quality_factor=Given(q),
        spring_constant_n_per_m=Given(value["spring_constant_n_per_m"]),
        tip_calibration=Given(value["tip_calibration"]),
        lines=np.arange(len(amplitude)),
    )
    found = energies(curve, Instrument(f0, q, harmonics_factor=value["harmonics_factor"]))
    return np.array([[found.energy_aj, found.virial_aj], [noise_of(curve, found), virial_noise_of(curve, found)]])


def _sense(senses: dict[float, _Taps], reading: float, lag: float, notes: list[str]) -> tuple[_Taps, str]:
    """Return the pixels in the sense of the phase, and why it is undecided.

    No sample gives energy: a sense that makes the median energy negative is wrong. Near resonance both make it about
    the same; one is assumed, and the other a part of the error. Elsewhere a free tip that reads its lag, or the
    opposite, decides.

    Args:
        senses: what the pixels mean where the phase lags (1) or leads (-1); one alone was stated.
        reading: of the free tip, in degrees.
        lag: of the free tip, in degrees.
        notes: get what was decided or assumed.
    """
    if len(senses) == 1:
        return next(iter(senses.values())), ""
    words = {1.0: "lags", -1.0: "leads"}
    off = {sense: abs(_half_turn(reading - sense * lag)) for sense in senses}
    likelier = -1.0 if off[-1.0] < _NEAR_DEG < off[1.0] else 1.0
    taps, other = senses[likelier], senses[-likelier]
    state = 'say `phase_sense="lag|lead"`'
    if taps.possible != other.possible:
        likelier = likelier if taps.possible else -likelier
        notes.append(f"Sense: the phase {words[likelier]}; the other way energies would be below zero.")
    elif abs(lag - 90.0) < _NEAR_DEG:
        notes.append(
            f"Sense: assumed: the phase {words[likelier]}. The energy hardly hangs on it, but the sign of the virial "
            f"does, attractive or repulsive; {state}."
        )
        return taps._replace(common=taps.common | {"sense_of_the_phase": [taps.energy - other.energy, 0.0]}), ""
    elif off[likelier] < _READS_DEG and off[-likelier] > 3.0 * _READS_DEG:
        notes.append(f"Sense: the phase {words[likelier]}; the free tip reads {reading:.1f} deg, its lag is {lag:.1f}.")
    elif taps.possible:
        both = f"{senses[1.0].energy:.3g} where it lags, {senses[-1.0].energy:.3g} where it leads"
        return taps, f"the sense of the phase is not known, and the median energy hangs on it ({both}); {state}"
    return senses[likelier], ""


def _reasons(taps: _Taps, state: Int[np.ndarray, "rows columns"], unit: str) -> list[str]:
    """Return why the energies must not be used."""
    used, above, below = (int(np.sum(state == one)) for one in list(PixelState)[:3])
    doubt = "free amplitude, its phase, quality factor or units do not belong to this image"
    total = float(taps.total_errors[taps.median])
    low, high = max(taps.energy - _BAND * total, 0.0), taps.energy + _BAND * total
    reasons = []
    if 2 * used < len(taps.errors[0]):
        why = f"{above} with an amplitude above the free one, {below} with an energy below zero"
        reasons.append(f"only {used} of {len(taps.errors[0])} pixels are in range ({why}): {doubt}")
    if not taps.possible:
        said = f"{taps.energy:.3g} +- {taps.common_error:.2g} {unit}"
        reasons.append(f"the median energy is below zero beyond its errors ({said}): {doubt}")
    elif _BAND * total > 0.5 * taps.energy:
        shares = {words_of(name): abs(change[0]) for name, change in taps.common.items()}
        shares["noise of a pixel"] = float(taps.errors[0, taps.median])
        largest = max(shares, key=lambda name: shares[name])
        reasons.append(
            f"the energy of a tap is only bracketed, {low:.2g} to {high:.2g} {unit} in the median pixel "
            f"({taps.energy:.3g} +- {total:.2g}); most of its error comes from {largest}"
        )
    return reasons
