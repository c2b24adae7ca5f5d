"""Maps: energy of a tap and virial in every pixel of an image of amplitude and phase, with their errors.

At one drive energy and virial are quadratic forms of the reading and the free motion: with A the amplitude, A0 the free
one and d how far the lag is behind that of the free tip,

    E = e0 A0^2 + e1 A^2 + A A0 (e2 cos d + e3 sin d),

the virial likewise. The coefficients are those of `energies`, found from a few rows; an image of a million pixels is
then a sum of four terms, and so is what it changes by with every number of the instrument.
"""

import enum
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from afm_jax.checks import checked
from afm_jax.results import Result, public_result
from afm_jax.strict_json import plain
from fitting.instruments.images import AmplitudeAndPhase, read_images
from fitting.instruments.lag import free_lag_deg, sense_of
from fitting.instruments.recording import ASSUMED_RESONANCE, Known, given_numbers
from fitting.parameters import USUAL_ERRORS
from fitting.tables.csv_text import TableError
from fitting.tapping_curves.curve import HARMONICS_FACTOR, Given, Instrument, TappingCurve
from fitting.tapping_curves.energy import energies

_BEYOND = 3.0
"""Standard errors beyond which a pixel is out of range."""
_USUAL = USUAL_ERRORS | {"free_amplitude_nm": 0.005}
"""Relative standard errors of what is given without one."""
_USUAL_ZERO_DEG = (0.2, 1.0)
"""Standard error of the free tip's phase where it is given without one, and where it is not given."""


class PixelState(enum.IntEnum):
    """What became of a pixel."""

    USED = 0
    AMPLITUDE_ABOVE_FREE = 1
    ENERGY_BELOW_ZERO = 2
    NOT_MEASURED = 3


@public_result(picture="fitting.tapping_curves.map_pictures:map_figure", state=PixelState)
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
        virial_common_error: standard error of the virial that all pixels have in common, at the median pixel.
        common: parts of `energy_common_error` by what they come from, with their signs.
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
    size_m: tuple[float, float] | None = None
    known: dict[str, Known] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def valid(self) -> bool:
        """Whether at least half of the pixels that were measured are in range."""
        counts = self.counts
        return counts["used"] > 0 and 2 * counts["used"] >= self.state.size - counts["not measured"]

    @property
    def reasons(self) -> list[str]:
        """Why it is not valid, empty if it is."""
        if self.valid:
            return []
        masked = {name: count for name, count in self.counts.items() if count and name != "used"}
        said = ", ".join(f"{count} {name}" for name, count in masked.items())
        why = "free amplitude, its phase, quality factor or units do not belong to this image"
        return [f"only {self.counts['used']} of {self.state.size} pixels are in range ({said}): {why}"]

    @property
    def counts(self) -> dict[str, int]:
        """How many pixels are in each state, by its name in words."""
        numbers = np.bincount(self.state.ravel(), minlength=len(PixelState)).tolist()
        return {state.name.lower().replace("_", " "): numbers[state] for state in PixelState}

    def median(self, name: str) -> float | None:
        """Return the median of an array over the pixels in range, None without any."""
        array = getattr(self, name)[self.state == PixelState.USED]
        return float(np.median(array)) if array.size else None

    def to_dict(self) -> dict[str, Any]:
        """Return all but the arrays, and of these the median and the ends of 95 % of the pixels."""
        used = self.state == PixelState.USED
        arrays = {}
        for name in ("energy", "energy_error", "virial", "virial_error"):
            values = getattr(self, name)[used]
            low, middle, high = np.percentile(values, (2.5, 50.0, 97.5)).tolist() if values.size else (None,) * 3
            arrays[name] = {"median": middle, "percentile_2_5": low, "percentile_97_5": high}
        own = {
            "valid": self.valid,
            "reasons": self.reasons,
            "source": self.source,
            "drive": self.drive,
            "unit": self.unit,
            "pixels": {"rows": self.state.shape[0], "columns": self.state.shape[1], **self.counts},
            **arrays,
            "energy_common_error": self.energy_common_error if used.any() else None,
            "virial_common_error": self.virial_common_error if used.any() else None,
            "common": self.common if used.any() else {},
            "size_m": self.size_m,
            "known": {key: vars(one) for key, one in self.known.items()},
            "notes": self.notes,
        }
        return plain(own)


class _ImageReadings(NamedTuple):
    """Amplitude and free amplitude in nm, degrees behind the free tip, and the standard errors of a pixel."""

    amplitude_nm: Float[np.ndarray, "rows columns"]
    free_amplitude_nm: float | Float[np.ndarray, "rows columns"]
    behind_deg: Float[np.ndarray, "rows columns"]
    amplitude_error_nm: float
    phase_error_deg: float


class _Forms(NamedTuple):
    """Coefficients of A0^2, A^2, A A0 cos d and A A0 sin d."""

    energy: Float[np.ndarray, " four"]
    virial: Float[np.ndarray, " four"]


@checked
def tapping_map(
    images: AmplitudeAndPhase | str | Path | tuple[np.ndarray, np.ndarray],
    *,
    drive: Literal["base", "force"] = "base",
    amplitude_error_nm: float | None = None,
    phase_error_deg: float | None = None,
    **given: Any,
) -> TappingMap:
    """Return energy and virial of a tap in every pixel of an image of amplitude and phase.

    Args:
        images: from `read_images`, a file for it, or the arrays of amplitude in nm and phase in degrees.
        drive: what shakes the cantilever.
        amplitude_error_nm: standard error of every pixel's amplitude; else from the roughness along its lines.
        phase_error_deg: of every pixel's phase; else likewise.
        given: instead of the file's, each a number or a pair with its standard error: free_frequency_khz,
            quality_factor, spring_constant_n_per_m (left out: energies over it, in nm^2), free_amplitude_nm,
            free_phase_deg (what the instrument reads with the tip free), drive_frequency_khz (left out: on resonance),
            nm_per_volt, tip_calibration.

    Raises:
        TableError: if the images do not fit, or something is missing that no energy can do without.
        TypeError: if an argument is of another kind.
    """
    if isinstance(images, tuple):
        arrays = [np.asarray(array, dtype=float) for array in images]
        if len(arrays) != 2 or arrays[0].shape != arrays[1].shape or arrays[0].ndim != 2:
            raise TableError("amplitude and phase must be two arrays (rows, columns) of one shape")
        images = AmplitudeAndPhase("arrays", arrays[0], "nm", arrays[1])
    elif not isinstance(images, AmplitudeAndPhase):
        images = read_images(images)
    notes = list(images.notes)
    known = _known(images, given, notes)
    amplitude, free = _in_nm(images, known)
    ratio = _value(known, "drive_frequency_khz") / _value(known, "free_frequency_khz")
    free_lag = float(free_lag_deg(drive, ratio, _value(known, "quality_factor")))
    behind = _behind_free(images, known, free_lag, notes)
    errors = (
        _roughness(amplitude) if amplitude_error_nm is None else amplitude_error_nm,
        _roughness(behind) if phase_error_deg is None else phase_error_deg,
    )
    if amplitude_error_nm is None or phase_error_deg is None:
        notes.append(
            f"Noise: {errors[0]:.3g} nm and {errors[1]:.3g} degrees a pixel, from the roughness along the lines "
            "(`amplitude_error_nm=...`, `phase_error_deg=...`)."
        )
    return _mapped(images, drive, known, _ImageReadings(amplitude, free, behind, *errors), notes)


def _known(images: AmplitudeAndPhase, given: dict[str, Any], notes: list[str]) -> dict[str, Known]:
    """Return what is known of the instrument: as given, else of the file's header.

    Raises:
        TableError: if something is missing.
    """
    units = {
        "free_frequency_khz": "kHz",
        "drive_frequency_khz": "kHz",
        "quality_factor": "",
        "spring_constant_n_per_m": "N/m",
        "free_amplitude_nm": "nm",
        "free_phase_deg": "deg",
        "nm_per_volt": "nm/V",
        "tip_calibration": "",
    }
    known = {key: one for key, one in images.known.items() if key in units}
    known |= given_numbers(given, units, any_sign=("free_phase_deg",))
    if "drive_frequency_khz" not in known and "free_frequency_khz" in known:
        known["drive_frequency_khz"] = Known(known["free_frequency_khz"].value, "kHz", ASSUMED_RESONANCE)
        notes.append(f"Drive frequency: {ASSUMED_RESONANCE}.")
    needed = {"free_frequency_khz": "KHZ", "quality_factor": "Q"}
    if images.free_amplitude is None:
        needed["free_amplitude_nm"] = "NM"
    if images.amplitude_unit == "V":
        needed["nm_per_volt"] = "NM"
    missing = [f"`{key}={unit}`" for key, unit in needed.items() if key not in known]
    if missing:
        raise TableError(f"{images.source}: the file does not say all that an energy needs; give {' '.join(missing)}")
    if "spring_constant_n_per_m" not in known:
        known["spring_constant_n_per_m"] = Known(1.0, "N/m", "not known: energies are over it, in nm^2")
        notes.append("The spring constant is not known: energies and virials are over it, in nm^2 (1 aJ over 1 N/m).")
    known.setdefault("tip_calibration", Known(1.0, "", "assumed"))
    return known


def _value(known: dict[str, Known], key: str) -> float:
    return float(known[key].value)


def _in_nm(
    images: AmplitudeAndPhase, known: dict[str, Known]
) -> tuple[Float[np.ndarray, "rows columns"], float | Float[np.ndarray, "rows columns"]]:
    """Return amplitude and free amplitude in nm."""
    scale = _value(known, "nm_per_volt") if images.amplitude_unit == "V" else 1.0
    amplitude = images.amplitude * scale
    if "free_amplitude_nm" in known and not known["free_amplitude_nm"].origin.startswith(("note", "header")):
        return amplitude, _value(known, "free_amplitude_nm")
    if images.free_amplitude is not None:
        return amplitude, images.free_amplitude * scale
    return amplitude, _value(known, "free_amplitude_nm")


def _behind_free(
    images: AmplitudeAndPhase, known: dict[str, Known], free_lag: float, notes: list[str]
) -> Float[np.ndarray, "rows columns"]:
    """Return how far each pixel lags behind the free tip, in degrees."""
    if images.free_phase_deg is not None:
        sense = sense_of(float(np.nanmedian(images.free_phase_deg)), free_lag)
        notes += [sense.note] if sense.note else []
        return sense.sign * (images.phase_deg - images.free_phase_deg)
    if "free_phase_deg" in known:
        reading = _value(known, "free_phase_deg")
    else:
        middle = np.nanmedian(images.phase_deg)
        reading = -free_lag if -180.0 < middle < 0.0 else free_lag
        notes.append(
            f"Phase: the free tip is taken to read {reading:.1f} +- {_USUAL_ZERO_DEG[1]:g} deg; else "
            "`free_phase_deg=...`."
        )
        origin = f"assumed: the free tip reads {'the opposite of ' if reading < 0.0 else ''}its lag"
        known["free_phase_deg"] = Known(reading, "deg", origin, _USUAL_ZERO_DEG[1])
    sense = sense_of(reading, free_lag)
    notes += [sense.note] if sense.note else []
    return sense.sign * (images.phase_deg - reading)


def _roughness(image: Float[np.ndarray, "rows columns"]) -> float:
    """Return the noise of a pixel: the spread of second differences along the lines, robust against edges."""
    second = image[:, :-2] - 2.0 * image[:, 1:-1] + image[:, 2:]
    second = second[np.isfinite(second)]
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0)) if second.size else 0.0


_TRIALS = 24


def _forms(drive: str, frequency: float, instrument: Instrument, spring: float, calibration: float) -> _Forms:
    """Return the coefficients of energy and virial, from `energies` of a few rows with a free amplitude of 1 nm."""
    random = np.random.default_rng(0)
    amplitude, behind = random.uniform(0.2, 1.0, _TRIALS), random.uniform(-60.0, 60.0, _TRIALS)
    ones, zeros = np.ones(_TRIALS), np.zeros(_TRIALS)
    lag = free_lag_deg(drive, frequency / instrument.free_frequency_khz, instrument.quality_factor)
    curve = TappingCurve(
        source="",
        drive="base" if drive == "base" else "force",
        offset_nm=zeros,
        amplitude_nm=amplitude,
        amplitude_error_nm=zeros,
        lag_deg=lag + behind,
        lag_error_deg=zeros,
        free_amplitude_nm=ones,
        drive_frequency_khz=frequency * ones,
        retract=zeros > 0.0,
        free_frequency_khz=Given(instrument.free_frequency_khz),
        quality_factor=Given(instrument.quality_factor),
        spring_constant_n_per_m=Given(spring),
        tip_calibration=Given(calibration),
        lines=np.arange(_TRIALS),
    )
    found = energies(curve, instrument)
    angle = np.deg2rad(behind)
    basis = np.stack([ones, amplitude**2, amplitude * np.cos(angle), amplitude * np.sin(angle)], axis=1)
    solved = np.linalg.lstsq(basis, np.stack([found.energy_aj, found.virial_aj], axis=1), rcond=None)[0]
    return _Forms(solved[:, 0], solved[:, 1])


class _Pixels(NamedTuple):
    """Energy or virial of every pixel.

    Attributes:
        values: of the pixels.
        errors: standard error of each pixel, its own.
        common: by how much each changes with one standard error of what all pixels share, by its name.
    """

    values: Float[np.ndarray, "rows columns"]
    errors: Float[np.ndarray, "rows columns"]
    common: dict[str, Float[np.ndarray, "rows columns"]]


def _pixels(
    form: Float[np.ndarray, " four"],
    changes: dict[str, Float[np.ndarray, " four"]],
    readings: _ImageReadings,
    known: dict[str, Known],
) -> _Pixels:
    """Return energy or virial of every pixel.

    Args:
        form: its coefficients.
        changes: of the coefficients with one standard error of each number of the instrument.
        readings: of the image.
        known: of the instrument.
    """
    amplitude, free, behind, *errors = readings
    zero = known.get("free_phase_deg", Known(0.0, "deg", "", _USUAL_ZERO_DEG[0])).error or _USUAL_ZERO_DEG[0]
    angle = np.deg2rad(behind)
    across, along = amplitude * free * np.cos(angle), amplitude * free * np.sin(angle)
    basis = (np.square(free), amplitude**2, across, along)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_amplitude = 2.0 * form[1] * amplitude + (form[2] * across + form[3] * along) / amplitude
    by_lag = (form[3] * across - form[2] * along) * (np.pi / 180.0)
    by_free = 2.0 * form[0] * basis[0] + _sum(form[2:], basis[2:])
    common = {"free_amplitude": _error(known, "free_amplitude_nm") * by_free, "free_phase": -zero * by_lag}
    common |= {source: _sum(change, basis) for source, change in changes.items()}
    return _Pixels(_sum(form, basis), np.hypot(by_amplitude * errors[0], by_lag * errors[1]), common)


def _states(readings: _ImageReadings, energy: _Pixels) -> Int[np.ndarray, "rows columns"]:
    """Return what became of each pixel, a `PixelState`."""
    amplitude, free = readings.amplitude_nm, readings.free_amplitude_nm
    state = np.zeros(amplitude.shape, dtype=np.int8)
    total = np.sqrt(energy.errors**2 + sum(part**2 for part in energy.common.values()))
    with np.errstate(invalid="ignore"):
        state[energy.values < -_BEYOND * total] = PixelState.ENERGY_BELOW_ZERO
        state[amplitude > free + _BEYOND * readings.amplitude_error_nm] = PixelState.AMPLITUDE_ABOVE_FREE
    state[~(np.isfinite(energy.values) & (amplitude > 0.0))] = PixelState.NOT_MEASURED
    return state


def _mapped(
    images: AmplitudeAndPhase,
    drive: str,
    known: dict[str, Known],
    readings: _ImageReadings,
    notes: list[str],
) -> TappingMap:
    """Return the map of readings."""
    frequency = _value(known, "drive_frequency_khz")
    instrument = Instrument(_value(known, "free_frequency_khz"), _value(known, "quality_factor"))
    spring, calibration = _value(known, "spring_constant_n_per_m"), _value(known, "tip_calibration")
    forms = _forms(drive, frequency, instrument, spring, calibration)
    sources = _sources(drive, frequency, instrument, spring, calibration, known, forms)
    energy, virial = (
        _pixels(form, {source: change[i] for source, change in sources.items()}, readings, known)
        for i, form in enumerate(forms)
    )
    state = _states(readings, energy)
    used = state == PixelState.USED
    pixel = _median_pixel(energy.values, used)
    at, at_virial = ({name: float(part[pixel]) for name, part in one.common.items()} for one in (energy, virial))
    return TappingMap(
        source=images.source,
        drive=drive,
        unit="nm^2" if known["spring_constant_n_per_m"].origin.startswith("not known") else "aJ",
        energy=np.where(used, energy.values, np.nan),
        energy_error=np.where(used, energy.errors, np.nan),
        virial=np.where(used, virial.values, np.nan),
        virial_error=np.where(used, virial.errors, np.nan),
        state=state,
        energy_common_error=float(np.linalg.norm(list(at.values()))),
        virial_common_error=float(np.linalg.norm(list(at_virial.values()))),
        common=at,
        size_m=images.size_m,
        known=known,
        notes=tuple(notes),
    )


def _sum(form: Float[np.ndarray, " some"], basis: tuple[Any, ...]) -> Any:
    return sum(float(factor) * part for factor, part in zip(form, basis, strict=True))


def _error(known: dict[str, Known], key: str) -> float:
    """Return the relative standard error of a number, the usual one where none is given."""
    one = known.get(key)
    return one.error / float(one.value) if one is not None and one.error else _USUAL[key]


def _sources(
    drive: str,
    frequency: float,
    instrument: Instrument,
    spring: float,
    calibration: float,
    known: dict[str, Known],
    forms: _Forms,
) -> dict[str, _Forms]:
    """Return how the forms change with one standard error of each number of the instrument."""

    def changed(**numbers: float) -> _Forms:
        other = _forms(drive, frequency, instrument._replace(**numbers), spring, calibration)
        return _Forms(*(new - old for new, old in zip(other, forms, strict=True)))

    frequency_error = _error(known, "free_frequency_khz") * instrument.free_frequency_khz
    quality_error = _error(known, "quality_factor") * instrument.quality_factor
    found = {
        "free_frequency": changed(free_frequency_khz=instrument.free_frequency_khz + frequency_error),
        "quality_factor": changed(quality_factor=instrument.quality_factor + quality_error),
        "harmonics": changed(harmonics_factor=HARMONICS_FACTOR.value + HARMONICS_FACTOR.error),
        "tip_calibration": _Forms(*(2.0 * _error(known, "tip_calibration") * form for form in forms)),
    }
    if not known["spring_constant_n_per_m"].origin.startswith("not known"):
        part = _error(known, "spring_constant_n_per_m")
        found["spring_constant"] = _Forms(*(part * form for form in forms))
    return found


def _median_pixel(values: Float[np.ndarray, "rows columns"], used: np.ndarray) -> tuple[int, int]:
    """Return the pixel in range whose value is the median, the first one without any."""
    places = np.flatnonzero(used.ravel())
    if not places.size:
        return 0, 0
    flat = values.ravel()[places]
    middle = places[np.argpartition(flat, len(flat) // 2)[len(flat) // 2]]
    return int(middle // values.shape[1]), int(middle % values.shape[1])
