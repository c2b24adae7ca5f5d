"""Amplitude-phase-distance curves out of instruments' files: one result, whatever the format, with the origin of each.

What a file calls its channels, which way its heights run, in which units and with which zero of the phase differs from
instrument to instrument. Here it becomes `offset_nm` (height of the sample over the cantilever's rest position, growing
towards the tip), `lockin_amplitude_nm`, `phase_lag_deg` (behind the drive) and a branch; what was assumed on the way is
said, what is missing is asked for by the option that gives it.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.checks import checked
from afm_jax.results import Result, public_result
from afm_jax.scenefile.tables import printable
from afm_jax.strict_json import plain
from fitting.instruments.bins import Binned, binned, faults_of_order, usual_width
from fitting.instruments.branch import JUMP, BranchLook, look_at
from fitting.instruments.columns import (
    ROLES,
    ColumnSource,
    checked_unit,
    example_of_columns,
    laid_out,
    parse_columns,
    turns_of,
)
from fitting.instruments.formats import read_recording
from fitting.instruments.lag import SENSE_OPTION, SENSES, PhaseReadings, free_lag_deg, sense_of_phase
from fitting.instruments.recording import (
    ASSUMED_RESONANCE,
    UNITS,
    Known,
    Recording,
    Segment,
    given_numbers,
    quantity_of,
    refuse_other_modes,
)
from fitting.parameters import USUAL_ERRORS
from fitting.tables.csv_text import TableError, setting_line

FORMAT_VERSION = 1
OPTIONS = {
    "drive_frequency_khz": "kHz",
    "free_frequency_khz": "kHz",
    "quality_factor": "",
    "spring_constant_n_per_m": "N/m",
    "free_amplitude_nm": "nm",
    "nm_per_volt": "nm/V",
    "offset_origin_nm": "nm",
    "amplitude_error_nm": "nm",
    "phase_error_deg": "deg",
}
"""Numbers that the caller may give in place of the file's; each is an option of `afm-jax read` with dashes."""
_NEEDED = {
    "drive_frequency_khz": "KHZ",
    "free_frequency_khz": "KHZ",
    "free_amplitude_nm": "NM",
    "nm_per_volt": 'NM_PER_V|"slope"',
}
_NO_AMPLITUDE = "There is no lock-in amplitude"
_WANTED = {"quality_factor": "Q", "spring_constant_n_per_m": "N_PER_M"}


@public_result()
@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredCurve(Result):
    """One curve of a file, approach and retract together; the arrays have the shape (rows,).

    Attributes:
        source: path of the file.
        format: of the file.
        curve: which of the file's curves, from 1.
        curves: how many the file holds.
        branch: "approach" or "retract" of each row.
        offset_nm: height of the sample over the rest position; relative if there is no `offset_origin_nm` in `known`.
        amplitude: lock-in amplitude in `amplitude_unit`, or None.
        amplitude_unit: "nm", or "V" where the sensitivity is not known.
        phase_lag_deg: lag behind the drive, or None.
        deflection: mean deflection in `deflection_unit`, or None.
        deflection_unit: "nm", "V" or "nN".
        free: rows of the free tip.
        bin_nm: width of the bins of height that a table of it has (0: equal heights are merged), None: rows as read.
        slope: change of the amplitude per nm of height in contact, in `amplitude_unit`, and its error; or None.
        known: what is known of the measurement, with unit and origin.
        missing: options that would give what a table needs.
        notes: what was assumed, and traps.
        reasons: why the curve must not be used; empty if it may.
    """

    source: str
    format: str
    curve: int
    curves: int
    branch: np.ndarray
    offset_nm: Float[np.ndarray, " rows"]
    amplitude: Float[np.ndarray, " rows"] | None = None
    amplitude_unit: str = "nm"
    phase_lag_deg: Float[np.ndarray, " rows"] | None = None
    deflection: Float[np.ndarray, " rows"] | None = None
    deflection_unit: str = "nm"
    free: Bool[np.ndarray, " rows"]
    bin_nm: float | None = None
    slope: tuple[float, float] | None = None
    known: dict[str, Known] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()

    @property
    def valid(self) -> bool:
        """Whether the curve may be used."""
        return not self.reasons

    def number(self, key: str) -> float | None:
        """Return a known number, None where it is not known."""
        found = self.known.get(key)
        return None if found is None or isinstance(found.value, str) else found.value

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain lists, numbers and strings; what is not known is None."""
        own = {name: value for name, value in vars(self).items() if name != "known"}
        return plain(own | {"valid": self.valid, "known": {key: vars(one) for key, one in self.known.items()}})


@checked
def read_curve(path: str | Path, *, curve: int = 1, **options: Any) -> MeasuredCurve:
    """Read one curve of an instrument's file.

    Args:
        path: neaSNOM text, WSxM curves, Asylum .ibw, NanoSurf .nid, Nanonis .dat, Gwyddion .gwy, or separated text.
        curve: which curve of the file, from 1.
        options: as of `read_curves`.

    Raises:
        TableError: as `read_curves`, or if the file has no such curve.
    """
    curves = read_curves(path, **options)
    found = next((one for one in curves if one.curve == curve), None)
    if found is None:
        raise TableError(f"{path}: there is no curve {curve}; the file holds {', '.join(str(c.curve) for c in curves)}")
    return found


@checked
def read_curves(
    path: str | Path,
    *,
    columns: str | Mapping[str, ColumnSource] = "",
    drive: str | None = None,
    phase_sense: str | None = None,
    bin_nm: float | None = None,
    **numbers: Any,
) -> list[MeasuredCurve]:
    """Read every curve of an instrument's file.

    Args:
        path: the file; its format is recognised by its content.
        columns: which channel becomes which column, as `parse_columns` takes it or returns it, where names and units
            do not tell; `offset_nm=1/2` where approach and retract are two channels.
        drive: "base" (dither piezo) or "force" (photothermal, magnetic); None: taken as "base", and said.
        phase_sense: "lag" of a phase that grows as the tip lags more, "lead" of its opposite; None: told by the curve
            where it can. A factor of the phase in `columns` says that it is a lag then.
        bin_nm: width of the bins of height in the table of a curve, 0 to merge equal heights only; None: rows as they
            are, or where heights repeat or are not in order bins of five rows or a 200th of a branch.
        numbers: what the file does not say, or says wrongly: the keys of `OPTIONS`, each a number or a pair with its
            standard error; `nm_per_volt="slope"` takes the sensitivity from the curve's own slope.

    Raises:
        TableError: one line: the file is damaged, holds no such curve, or a channel is missing.
        ValueError: if an option is impossible.
    """
    if drive not in {None, "base", "force"}:
        raise ValueError(f"`drive` must be base or force, but is {drive!r}")
    if phase_sense not in {None, *SENSES}:
        raise ValueError(f"`phase_sense` must be {' or '.join(SENSES)}, but is {phase_sense!r}")
    if bin_nm is not None and not 0.0 <= bin_nm < np.inf:
        raise ValueError(f"`bin_nm` must be finite and not below 0, but is {bin_nm!r}")
    of_slope = numbers.get("nm_per_volt") == "slope"
    given = given_numbers(
        numbers | ({"nm_per_volt": None} if of_slope else {}), OPTIONS, any_sign=("offset_origin_nm",)
    )
    wanted = parse_columns(columns) if isinstance(columns, str) and columns else dict(columns or {})
    recording = read_recording(path)
    _refuse_others(recording)
    stated = any(segment.branch for segment in recording.segments)
    recording = laid_out(recording, wanted)
    known = dict(recording.known)
    known["drive"] = Known(drive, "", "option `drive=...`") if drive else Known("base", "", _ASSUMED_BASE)
    known |= given
    if "drive_frequency_khz" not in known and "free_frequency_khz" in known:
        # lock-ins are tuned to the resonance before a curve is taken
        free = known["free_frequency_khz"]
        known["drive_frequency_khz"] = Known(free.value, "kHz", ASSUMED_RESONANCE)
    numbered: dict[int, list[Segment]] = {}
    for segment in recording.segments:
        numbered.setdefault(segment.curve, []).append(segment)
    curves = []
    for segments in numbered.values():
        curve = _joined(recording, segments, wanted, known, len(numbered))
        if curve.amplitude is not None:
            _check_mode(recording)
        said = {role for role, source in wanted.items() if source.factor is not None}
        if "offset_nm" not in said and _runs_away(curve):
            curve = replace(curve, offset_nm=-curve.offset_nm, notes=(*curve.notes, _TURNED))
        curve = curve if stated else _renamed(curve)
        sense = phase_sense or ("lag" if "phase_lag_deg" in said else "")
        judged = _judged(curve, of_slope=of_slope, stated_sense=sense)
        curves.append(_binning(judged, bin_nm))
    return curves


_ASSUMED_BASE = 'assumed: shaken at its base by a piezo; `drive="force"` for a photothermal or magnetic drive'


_OTHER_CHANNELS = re.compile(
    r"(amp(litude)?|pha?(se?)?)[ _-]*2\b.*|.*\b(lateral|torsion\w*|friction|pfm|piezo\w*|second (eigen)?mode)\b.*",
    re.IGNORECASE,
)
"""Channels of modes in which amplitude and phase are not those of one flexural mode that taps."""


def _refuse_others(recording: Recording) -> None:
    kinds = set(map(quantity_of, recording.units.values()))
    if {"spectrum", "voltage spectrum"} & kinds:
        raise TableError(f"{recording.source}: holds a thermal spectrum, not a curve; `afm-jax calibrate` fits it")
    if any(name.startswith(("Frequency Shift", "Frequency")) for name in recording.channels):
        raise TableError(f"{recording.source}: holds a resonance sweep, not a curve; `afm-jax calibrate` fits it")


def _check_mode(recording: Recording) -> None:
    """Check that a file with amplitudes, where it says in which mode it was recorded, says tapping.

    Raises:
        TableError: with the name of the mode, or of the channel that tells it.
    """
    refuse_other_modes(recording.settings, recording.source)
    channel = next((name for name in recording.channels if _OTHER_CHANNELS.fullmatch(name)), None)
    if channel is not None:
        raise TableError(
            f"{recording.source}: holds a channel {channel!r}, which is none of amplitude modulation (tapping) of one "
            "mode; its amplitude and phase tell no energy of a tap"
        )


def _joined(
    recording: Recording,
    segments: list[Segment],
    wanted: Mapping[str, ColumnSource],
    known: dict[str, Known],
    curves: int,
) -> MeasuredCurve:
    """Return the segments of one curve as one, in the table's quantities."""
    notes = list(recording.remarks)
    found = {role: _source(recording, segments[0], role, wanted, notes) for role in ROLES}
    sources = {role: source for role, source in found.items() if source is not None}
    if "offset_nm" not in sources:
        channels = ", ".join(recording.channels)
        raise TableError(
            f"{recording.source}: no height among the channels {channels}; {example_of_columns(recording)}"
        )
    taken = {source.channel for source in sources.values()}
    others = ", ".join(name for name in segments[0].channels if name not in taken)
    if "lockin_amplitude_nm" not in sources:
        ask = f'; if one of the channels {others} is: `columns="lockin_amplitude_nm=CHANNEL:UNIT"`' if others else ""
        notes.append(f"{_NO_AMPLITUDE}{ask}.")
    elif "phase_lag_deg" not in sources:
        ask = f'; if one of the channels {others} is one: `columns="phase_lag_deg=CHANNEL:UNIT"`' if others else ""
        notes.append(f"There is no phase, so that the energy of a tap has an upper bound only{ask}.")
    parts = {
        role: [_converted(recording, segment, source, role) for segment in segments] for role, source in sources.items()
    }
    branches: list[str] = []
    for segment, offset in zip(segments, parts["offset_nm"], strict=True):
        branches += _branches(segment.branch, offset)
        notes += _mixed_note(segment.branch, offset)
    lags = parts.get("phase_lag_deg", [])
    # each was unwrapped from its own first row
    lags[1:] = [lag - 360.0 * np.round((np.median(lag) - np.median(lags[0])) / 360.0) for lag in lags[1:]]
    columns = {role: np.concatenate(numbers) for role, numbers in parts.items()}
    amplitude = columns.get("lockin_amplitude_nm")
    if amplitude is not None and amplitude[np.argmax(np.abs(amplitude))] < 0.0:
        amplitude = -amplitude
        notes.append("Sign: the amplitude is negative (an inverted channel) and was taken with the opposite sign.")
    scales = {"length": "nm", "voltage": "V", "force": "nN"}
    units = {role: scales.get(quantity_of(source.unit), "") for role, source in sources.items()}
    return MeasuredCurve(
        source=recording.source,
        format=recording.format,
        curve=segments[0].curve,
        curves=curves,
        branch=np.array(branches),
        offset_nm=columns["offset_nm"],
        amplitude=amplitude,
        amplitude_unit=units.get("lockin_amplitude_nm", "nm"),
        phase_lag_deg=columns.get("phase_lag_deg"),
        deflection=columns.get("deflection_nm"),
        deflection_unit=units.get("deflection_nm", "nm"),
        free=np.zeros(len(branches), dtype=bool),
        known=dict(known),
        notes=tuple(notes),
    )


def _source(
    recording: Recording, segment: Segment, role: str, wanted: Mapping[str, ColumnSource], notes: list[str]
) -> ColumnSource | None:
    """Return the channel that becomes a column, with its unit; notes say what was assumed."""
    names = list(segment.channels)
    quantities, patterns = ROLES[role]
    source = wanted.get(role)
    if source is not None and source.channel not in names:
        raise TableError(
            f"{recording.source}: there is no channel `{source.channel}` for {role}; it has {', '.join(names)}"
        )
    if source is None:
        taken = {other.channel for other in wanted.values()}
        ranked = [n for pattern in patterns for n in names if re.fullmatch(pattern, n, re.IGNORECASE | re.DOTALL)]
        units = {n: recording.units.get(n, "") for n in ranked if n not in taken}
        suited = [n for n, unit in units.items() if quantity_of(unit) in quantities]
        suited += [n for n, unit in units.items() if not unit]
        if not suited:
            return None
        away = role == "offset_nm" and suited[0] in recording.away
        source = ColumnSource(suited[0], "", -1.0 if away else 1.0)
        if away:
            notes.append(f"Sign: {suited[0]} grows away from the sample in this format; the offset is its negative.")
    unit, usual = source.unit or recording.units.get(source.channel, ""), "deg" if role == "phase_lag_deg" else "nm"
    if not unit:
        notes.append(f'Unit: {source.channel} has none and is taken in {usual}; else `columns="{role}=NAME:UNIT"`.')
    return replace(source, unit=checked_unit(unit or usual, role, source.channel, recording.source))


def _converted(recording: Recording, segment: Segment, source: ColumnSource, role: str) -> Float[np.ndarray, " rows"]:
    numbers, where = segment.channels.get(source.channel), f"{recording.source}, curve {segment.curve}"
    if numbers is None:
        raise TableError(f"{where}: the {segment.branch} has no channel {source.channel}")
    bad = np.flatnonzero(~np.isfinite(numbers))
    if bad.size:
        raise TableError(
            f"{where}, row {bad[0] + 1}, channel {source.channel}: is not a number; remove the row, or export the file "
            "again"
        )
    with np.errstate(over="ignore"):
        scaled = numbers * (UNITS[source.unit][1] * (source.factor or 1.0))
    if not np.all(np.abs(scaled) < 1e9):
        raise TableError(
            f"{where}, channel {source.channel}: numbers beyond 1e9; the file is damaged, or its unit is another one: "
            f'`columns="{role}={source.channel}:UNIT"`'
        )
    return np.rad2deg(np.unwrap(np.deg2rad(scaled))) if role == "phase_lag_deg" else scaled


def _branches(branch: str, offset: Float[np.ndarray, " rows"]) -> list[str]:
    """Return the branch of every row: as the file says, else by the heights, towards the sample or away from it."""
    if branch:
        return [branch] * len(offset)
    names: list[str] = []
    for first, last in pairwise([0, *turns_of(offset), len(offset)]):
        names += ["approach" if offset[last - 1] >= offset[first] else "retract"] * (last - first)
    return names


_AWAY = 0.95
"""Amplitude far from the sample over that near to it below which heights run the other way."""


def _far_and_near(curve: MeasuredCurve) -> tuple[float, float]:
    """Return the median amplitude of the twentieth of the rows that is farthest from the sample, and nearest to it."""
    amplitude = np.ones(1) if curve.amplitude is None else curve.amplitude[np.argsort(curve.offset_nm, kind="stable")]
    some = max(len(amplitude) // 20, 1)
    return float(np.median(amplitude[:some])), float(np.median(amplitude[-some:]))


def _runs_away(curve: MeasuredCurve) -> bool:
    """Say whether heights grow away from the sample: the amplitude falls towards their lower end, and only there."""
    far, near = _far_and_near(curve)
    return far < _AWAY * near and all(look.slope is None for look in _looks(curve).values())


def _renamed(curve: MeasuredCurve) -> MeasuredCurve:
    """Return a curve with approach and retract exchanged, where its heights fall in the one and rise in the other."""
    if any(_as_named(curve)):
        return curve
    return replace(curve, branch=np.where(curve.branch == "approach", "retract", "approach"))


def _as_named(curve: MeasuredCurve) -> list[bool]:
    """Say of every branch whether its heights rise in an approach, or fall in a retract."""
    heights = {name: curve.offset_nm[curve.branch == name] for name in dict.fromkeys(curve.branch.tolist())}
    return [bool(one[-1] >= one[0]) == (name == "approach") for name, one in heights.items()]


_TURNED = "Direction: the amplitude falls where the heights are lowest: they grow away from the sample and were turned."
_JUMPS = 0.05
"""Median step of the heights, of their range, from which they are no ramp."""


def _mixed_note(branch: str, offset: Float[np.ndarray, " rows"]) -> list[str]:
    """Return a sentence where heights jump about, so that nothing says which rows are approach and which retract."""
    if branch or len(offset) < 20 or np.median(np.abs(np.diff(offset))) < _JUMPS * np.ptp(offset):
        return []
    what = "approach and retract cannot be told apart: all rows are taken as one branch; else give a column branch"
    return [f"Direction: heights jump to and fro, so that {what}."]


def _binning(curve: MeasuredCurve, bin_nm: float | None) -> MeasuredCurve:
    """Return a curve with the width of its table's bins: as given, or the usual one where heights ask for bins."""
    repeated, back = faults_of_order(curve.offset_nm, curve.branch)
    width = usual_width(curve.offset_nm, curve.branch) if bin_nm is None else bin_nm
    if width is None:
        return curve
    why = f"{repeated} rows repeat a height and {back} step back" if repeated or back else "asked for"
    how = f"of {width:.3g} nm" if width else "of equal height"
    error = ", with their scatter for an error" if width else ""
    note = f"Bins: {why}; the table has the means of bins {how}{error} (`bin_nm=...`)."
    return replace(curve, bin_nm=width, notes=(*curve.notes, note))


_ASSUMED_ORIGIN_NM = 1.0
"""Error of an origin read off the curve: attraction moves the contact by about so much."""


def _judged(curve: MeasuredCurve, *, of_slope: bool, stated_sense: str) -> MeasuredCurve:
    """Return a curve with free rows, slope, origin and zero of the phase found, and everything doubtful named."""
    amplitude = curve.amplitude
    if amplitude is None:
        return curve
    scale = curve.known.get("nm_per_volt") if curve.amplitude_unit == "V" else None
    slope = _mean_slope(_looks(curve)) if of_slope else None
    if slope is not None:
        scale = _scale_of_slope(curve, slope, _looks(curve))
        curve = replace(curve, known=curve.known | {"nm_per_volt": scale})
    if scale is not None:
        curve = replace(curve, amplitude=amplitude * float(scale.value), amplitude_unit="nm")
    looks = _looks(curve)
    free = np.zeros(len(curve.offset_nm), dtype=bool)
    for branch, look in looks.items():
        free[np.flatnonzero(curve.branch == branch)[look.free]] = True
    curve = replace(curve, free=free, slope=_mean_slope(looks), reasons=tuple(_reasons(curve, looks)))
    curve = _with_origin(replace(curve, known=_with_levels(curve, looks)), looks)
    curve = _with_sense_of_phase(curve, looks, stated_sense)
    # in volts the sensitivity comes first
    there = {*curve.known, "free_amplitude_nm" if curve.amplitude_unit == "V" else "nm_per_volt"}
    missing = [key for key in (*_NEEDED, *_WANTED) if key not in there]
    notes = (*curve.notes, *_scale_notes(curve), *_phase_notes(curve, stated_sense))
    return replace(curve, notes=notes, missing=tuple(missing))


def _looks(curve: MeasuredCurve) -> dict[str, BranchLook]:
    if curve.amplitude is None:
        return {}
    looks, lag = {}, curve.phase_lag_deg
    for branch in dict.fromkeys(curve.branch.tolist()):
        mask = curve.branch == branch
        looks[branch] = look_at(curve.offset_nm[mask], curve.amplitude[mask], None if lag is None else lag[mask])
    return looks


_LEAST_ERROR = 1e-9
"""Of a slope, relative."""


def _mean_slope(looks: Mapping[str, BranchLook]) -> tuple[float, float] | None:
    """Return the weighted mean of the branches' slopes, its error widened by what they differ beyond theirs."""
    slopes = np.array([[look.slope.value, look.slope.error] for look in looks.values() if look.slope is not None])
    if not slopes.size:
        return None
    # rows that lie on a line exactly leave no error at all
    weights = np.maximum(slopes[:, 1], _LEAST_ERROR * np.abs(slopes[:, 0])) ** -2.0
    mean = float(np.sum(weights * slopes[:, 0]) / weights.sum())
    chi2 = float(np.sum(weights * (slopes[:, 0] - mean) ** 2))
    return mean, float(np.sqrt(max(chi2, 1.0) / weights.sum()))


def _scale_of_slope(curve: MeasuredCurve, slope: tuple[float, float], looks: Mapping[str, BranchLook]) -> Known:
    """Return the scale with which the amplitude falls by 1 nm per nm in contact."""
    scale, share = 1.0 / abs(slope[0]), slope[1] / abs(slope[0])
    parts = " and ".join(
        f"{look.slope.rows} rows of the {branch} from {look.slope.from_nm:.2f} to {look.slope.to_nm:.2f} nm"
        for branch, look in looks.items()
        if look.slope is not None
    )
    origin = (
        f"measured: slope of the steepest settled part ({parts}), taken as 1 nm per nm (a hard sample); unit "
        f"{curve.amplitude_unit}"
    )
    return Known(scale, f"nm/{curve.amplitude_unit}", origin, scale * share)


def _reasons(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> list[str]:
    """Return why a curve must not be used: free amplitudes that jump, heights that run the wrong way."""
    reasons, unit = [], curve.amplitude_unit
    for branch, look in looks.items():
        if look.jump is not None:
            low, high = look.jump
            reasons.append(
                f"The free amplitude jumps from {low:.4g} to {high:.4g} {unit} within the {branch}: the drive or the "
                "demodulation changed while the curve was taken."
            )
    levels = [look.level for look in looks.values()]
    if np.ptp(levels) > JUMP * max(levels):
        text = " and ".join(f"{look.level:.4g} {unit} in the {branch}" for branch, look in looks.items())
        reasons.append(f"The free amplitude is {text}: the drive or the demodulation changed between them.")
    far, near = _far_and_near(curve)
    if _runs_away(curve):
        reasons.append(
            f"The amplitude is smaller far from the sample ({far:.4g} {unit}) than near it ({near:.4g} {unit}): the "
            'heights run the other way; turn them round with `columns="offset_nm=CHANNEL:-1"` (or drop that -1).'
        )
    for branch, look in looks.items():
        if look.change is not None and "free_amplitude_nm" not in curve.known:
            reasons.append(
                f"There is no flat free part in the {branch}: the amplitude still changes by {look.change:.1%} over "
                "the farthest quarter of the rows; record farther away, or give `free_amplitude_nm=...`."
            )
    return reasons


def _with_levels(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> dict[str, Known]:
    """Return what is known with the free amplitude and the errors of single rows added, from the free ones."""
    found = dict(curve.known)
    level = float(np.mean([look.level for look in looks.values()]))
    if curve.amplitude_unit == "nm":
        if not any(look.jump for look in looks.values()):
            how, error = f"measured: median of {curve.free.sum()} free rows", max(v.level_error for v in looks.values())
            found.setdefault("free_amplitude_nm", Known(level, "nm", how, float(error)))
        noise = _noise(looks)
        how = "measured: scatter of the free rows" if noise else "assumed: 1 % of the free amplitude"
        found.setdefault("amplitude_error_nm", Known(noise or 0.01 * level, "nm", how))
    if curve.phase_lag_deg is not None:
        ways = [curve.phase_lag_deg[curve.free & (curve.branch == branch)] for branch in looks]
        scatter = max(float(np.std(np.diff(way)) / np.sqrt(2.0)) if len(way) > 4 else 0.0 for way in ways)
        how = "measured: scatter of the free rows" if scatter > 0.0 else "assumed: 1 degree"
        found.setdefault("phase_error_deg", Known(scatter or 1.0, "deg", how))
    return found


def _noise(looks: Mapping[str, BranchLook]) -> float:
    """Return the scatter of single amplitudes of the free tip, 0 where it is not known."""
    return max((look.noise for look in looks.values() if look.noise > 0.0), default=0.0)


def _with_origin(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> MeasuredCurve:
    """Return the curve with heights that count from the rest position of the tip, as far as that can be told."""
    given, level = curve.known.get("offset_origin_nm"), curve.number("free_amplitude_nm")
    onsets = [look.onset_nm for branch, look in sorted(looks.items()) if look.onset_nm is not None]
    if given is not None:
        origin = replace(given, error=given.error or _ASSUMED_ORIGIN_NM)
    elif onsets and level is not None and curve.amplitude_unit == "nm":
        how = "measured: where the amplitude begins to fall the free tip just touches (-free_amplitude_nm)"
        error = float(np.hypot(_ASSUMED_ORIGIN_NM, np.ptp(onsets)))
        origin = Known(float(onsets[0] + level), "nm", f"{how}; error assumed", error)
    else:
        return curve
    known = curve.known | {"offset_origin_nm": origin}
    return replace(curve, offset_nm=curve.offset_nm - float(origin.value), known=known)


_RADIANS_DEG = 30.0
"""How near to the free tip's lag its phase, taken for radians, must be to be told as such."""


def _with_sense_of_phase(curve: MeasuredCurve, looks: Mapping[str, BranchLook], stated: str) -> MeasuredCurve:
    """Return the curve with sign and zero of the phase such that free rows lag as frequency and Q say, where known.

    Raises:
        TableError: if the phases are radians.
    """
    phase, readings = curve.phase_lag_deg, _phase_readings(curve, looks)
    if phase is None:
        return curve
    # as the curve keeps it, it is a lag
    sense_known = Known("lag", "", f"option: the file's phase is a {stated}")
    known = curve.known | ({"phase_sense": sense_known} if stated else {})
    if readings is None or not curve.free.any():
        # frequency and Q, which tell the zero, are not known
        return replace(curve, phase_lag_deg=SENSES.get(stated, 1.0) * phase, known=known)
    lag, free = float(readings.free_lag_deg[0]), phase[curve.free]
    level, scatter = float(np.median(free)), float(np.std(free) / np.sqrt(len(free)))
    near = abs(np.rad2deg(abs(level)) - lag) < _RADIANS_DEG < lag
    if near and np.nanmax(np.abs(phase)) < 2.0 * np.pi and abs(np.rad2deg(level)) > 0.5 * lag:
        raise TableError(
            f"{printable(curve.source)}: the phase reads {level:.3g} where the tip is free and lags by {lag:.1f} "
            'degrees: it is in radians; say `columns="phase_lag_deg=CHANNEL:rad"`'
        )
    factors = np.array([1.0 + readings.frequency_error, 1.0 - readings.frequency_error])
    of_ratio = free_lag_deg(readings.drive, readings.frequency_ratio[0] * factors, readings.quality_factor)
    factors = np.array([1.0 + readings.quality_error, 1.0 - readings.quality_error])
    of_quality = free_lag_deg(readings.drive, readings.frequency_ratio[0], readings.quality_factor * factors)
    error = float(np.linalg.norm([max(scatter, 0.01), *(0.5 * np.ptp([of_ratio, of_quality], axis=1))]))
    how = f"measured: the free rows read {level:.2f} deg and are set to {lag:.2f}, what s and Q give"
    sense = sense_of_phase(readings, stated)
    known["phase_zero_deg"] = Known(sense.zero_deg, "deg", how, error)
    notes = (*curve.notes, *sense.notes, *((f"Sign: {sense.reason}.",) if sense.reason else ()))
    return replace(curve, phase_lag_deg=sense.lag_deg(phase), known=known, notes=notes)


def _phase_readings(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> PhaseReadings | None:
    """Return what of a curve says which sense its phase has; None where frequency or Q are not known."""
    drive, free, quality = (curve.number(k) for k in ("drive_frequency_khz", "free_frequency_khz", "quality_factor"))
    if curve.phase_lag_deg is None or curve.amplitude is None or drive is None or free is None or quality is None:
        return None
    known = [(key, curve.known[key]) for key in ("free_frequency_khz", "quality_factor")]
    errors = [USUAL_ERRORS[key] if one.error is None else one.error / float(one.value) for key, one in known]
    ones = np.ones(len(curve.offset_nm))
    level = float(np.mean([look.level for look in looks.values()]))
    here = [np.flatnonzero(curve.branch == branch) for branch in looks]
    return PhaseReadings(
        drive=str(curve.known["drive"].value),
        frequency_ratio=drive / free * ones,
        frequency_error=errors[0],
        quality_factor=quality,
        quality_error=errors[1],
        ratio=curve.amplitude / level,
        ratio_error=(_noise(looks) / level or 0.01) * ones,
        phase_deg=curve.phase_lag_deg,
        phase_error_deg=float(curve.known["phase_error_deg"].value) * ones,
        free=curve.free,
        ways=[rows[np.argsort(curve.offset_nm[rows], kind="stable")] for rows in here],
    )


def _scale_notes(curve: MeasuredCurve) -> list[str]:
    """Say what the slope in contact means for the scale of the amplitude."""
    if curve.slope is None or curve.known.get("nm_per_volt", Known(0.0, "", "")).origin.startswith("measured"):
        return []
    slope, error = abs(curve.slope[0]), curve.slope[1]
    shown = f"{slope:.3g} +- {error:.1g}"
    if curve.amplitude_unit == "V":
        hard = f'on a hard sample that is {1.0 / slope:.3g} nm/V (`nm_per_volt="slope"`)'
        return [f"Gain: in contact the amplitude falls by {shown} V per nm; {hard}."]
    for factor, what in ((np.sqrt(0.5), "an rms amplitude"), (2.0, "a peak-to-peak amplitude")):
        if abs(slope / factor - 1.0) < 0.05:
            mend = f'if it is one, `columns="lockin_amplitude_nm=CHANNEL:{1.0 / factor:.4g}"`'
            return [f"Gain: in contact the amplitude falls by {shown} nm per nm, as {what} would: {mend}."]
    if abs(slope - 1.0) > max(0.1, 3.0 * error):
        why = "the scale of the amplitude is off by that" + (", or the sample is soft" if slope < 1.0 else "")
        mend = '`nm_per_volt="slope"` sets it'
        return [f"Gain: in contact the amplitude falls by {shown} nm per nm, not by 1: {why}; {mend}."]
    return []


def _phase_notes(curve: MeasuredCurve, stated: str) -> list[str]:
    """Say what of the phase is not known."""
    if curve.phase_lag_deg is None or "phase_zero_deg" in curve.known:
        return []
    sign = [] if stated else [f"Sign: a larger phase is taken as a larger lag; {SENSE_OPTION} says which it is."]
    zero = "Zero: the phase counts from the instrument's own zero; free frequency and Q would fix it."
    return [*sign, zero]


def table_text(curve: MeasuredCurve) -> str:
    """Return a curve as a table of `afm-jax tapping` and `afm-jax fit`.

    Raises:
        TableError: if something is missing, naming the options that give it, or the curve must not be used.
    """
    if curve.amplitude is None:
        why = next((note for note in curve.notes if note.startswith(_NO_AMPLITUDE)), _NO_AMPLITUDE)
        raise TableError(f"{curve.source}, curve {curve.curve}: no table of this. {why}")
    if curve.reasons:
        raise TableError(f"{curve.source}, curve {curve.curve}: {curve.reasons[0]}")
    needed = [key for key in curve.missing if key in _NEEDED]
    if needed:
        options = " ".join(f"`{key}={_NEEDED[key]}`" for key in needed)
        raise TableError(f"{curve.source}: the file does not say {', '.join(needed)}; give {options}")
    rows = _rows(curve)
    columns: dict[str, Any] = {
        "drive_frequency_khz": curve.number("drive_frequency_khz"),
        "free_amplitude_nm": curve.number("free_amplitude_nm"),
        "offset_nm": rows.offset_nm,
        "lockin_amplitude_nm": rows.readings["amplitude"],
        "lockin_amplitude_error_nm": rows.errors["amplitude"],
        "phase_lag_deg": rows.readings.get("phase"),
        "phase_lag_error_deg": rows.errors.get("phase"),
        "retract": (rows.branch == "retract").astype(int),
    }
    # an offset of the detector may take the amplitude of a tip that does not move below zero
    moving = rows.readings["amplitude"] > 0.0
    present = {
        name: np.broadcast_to(column, moving.shape)[moving].tolist()
        for name, column in columns.items()
        if column is not None
    }
    lines = [f"# drive = {curve.known['drive'].value}", *_setting_lines(curve)]
    if rows.in_order_of_time:
        lines.append("# rows = in order of time")
    remarks = [f"read from {Path(curve.source).name} ({curve.format}), curve {curve.curve}", *curve.notes]
    zero = curve.known.get("phase_zero_deg")
    remarks += [] if zero is None or not zero.error else [zero_of_free_rows(zero.error)]
    if not moving.all():
        remarks.append(f"left out: {np.sum(~moving)} rows whose amplitude is not above zero")
    lines += [f"# {remark}" for remark in remarks]
    lines.append(",".join(present))
    lines += [",".join(map(repr, row)) for row in zip(*present.values(), strict=True)]
    return "\n".join(lines) + "\n"


def zero_of_free_rows(error: float) -> str:
    """Return the remark that a zero of the phase with this error is that of the free rows, and no knowledge besides."""
    return f"phase_zero_deg +- {error!r} is that of the free rows, as frequency and Q leave it"


def _rows(curve: MeasuredCurve) -> Binned:
    """Return the rows of a curve's table: its bins, or the rows as they were read."""
    keys = {"amplitude": "amplitude_error_nm", "phase": "phase_error_deg"}
    values = {"amplitude": curve.amplitude, "phase": curve.phase_lag_deg}
    readings = {name: column for name, column in values.items() if column is not None}
    single = {name: curve.known[keys[name]] for name in readings}
    errors = {name: float(one.value) for name, one in single.items()}
    if curve.bin_nm is None:
        count = np.ones(len(curve.offset_nm), dtype=int)
        rows = {name: np.full(len(count), error) for name, error in errors.items()}
        in_order = all(_as_named(curve)) and not any(faults_of_order(curve.offset_nm, curve.branch))
        return Binned(curve.offset_nm, readings, rows, count, curve.branch, in_order)
    stated = {name: errors[name] for name, one in single.items() if not curve.bin_nm or one.origin.startswith("option")}
    means = binned(curve.offset_nm, readings, curve.branch, curve.free, curve.bin_nm, stated)
    # rows without any scatter (a resolution that is coarser than the noise) have that of the free tip
    least = {
        name: np.where(error > 0.0, error, errors[name] / np.sqrt(means.rows)) for name, error in means.errors.items()
    }
    return means._replace(errors=least)


def _setting_lines(curve: MeasuredCurve) -> list[str]:
    """Return the comment lines that a table understands."""
    lever, zeros = ("free_frequency_khz", *_WANTED), ("offset_origin_nm", "phase_zero_deg")
    known = {key: curve.known[key] for key in (*lever, *zeros) if key in curve.known}
    lines = [setting_line(key, one.value, one.error) for key, one in known.items() if key in lever]
    lines += [setting_line(key, "0", one.error) for key, one in known.items() if key in zeros and one.error]
    if curve.phase_lag_deg is not None:
        # the zero was set by the free rows: it says nothing of the sign
        lines.append(f"# phase_sense = {'lag' if 'phase_sense' in curve.known else 'either'}")
    scale = curve.known.get("nm_per_volt")
    if scale is not None and scale.error and not isinstance(scale.value, str):
        lines.append(setting_line("tip_calibration", "1", scale.error / scale.value))
    return lines
