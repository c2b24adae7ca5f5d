"""Amplitude-phase-distance curves out of instruments' files: one result, whatever the format, with the origin of each.

What a file calls its channels, which way its heights run, in which units and with which zero of the phase differs from
instrument to instrument. Here it becomes `offset_nm` (height of the sample over the cantilever's rest position, growing
towards the tip), `lockin_amplitude_nm`, `phase_lag_deg` (behind the drive) and a branch; remarks state the
assumptions, and a message about a missing quantity names the option that gives it.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.checks import checked
from afm_jax.results import JudgedResult, public_result
from afm_jax.strict_json import plain
from afm_jax.words import printable
from fitting.instruments.bins import binned, error_of, faults_of_order, usual_width, ways_of
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
_NEEDED = ("drive_frequency_khz", "free_frequency_khz", "free_amplitude_nm", "nm_per_volt")
_WANTED = ("quality_factor", "spring_constant_n_per_m")
"""What a table cannot do without, and what it asks for."""
_NO_AMPLITUDE = "There is no lock-in amplitude"


@public_result()
@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredCurve(JudgedResult):
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
        path: neaSNOM text, WSxM curves, Asylum .ibw, NanoSurf .nid, Nanonis .dat, or separated text.
        curve: which curve of the file, from 1.
        options: as of `read_curves`.

    Raises:
        TableError: as `read_curves`, or if the file has no such curve.
    """
    curves = read_curves(path, **options)
    if not 1 <= curve <= len(curves):
        raise TableError(f"{path}: there is no curve {curve}; the file holds {len(curves)}")
    return curves[curve - 1]


@checked
def read_curves(
    path: str | Path,
    *,
    columns: str = "",
    drive: Literal["base", "force"] | None = None,
    phase_sense: Literal["lag", "lead"] | None = None,
    bin_nm: float | None = None,
    **numbers: Any,
) -> list[MeasuredCurve]:
    """Read every curve of an instrument's file.

    Args:
        path: the file; its format is recognised by its content.
        columns: which channel becomes which column, as `parse_columns` takes it, where names and units do not tell;
            `offset_nm=1/2` where approach and retract are two channels.
        drive: "base" (dither piezo) or "force" (photothermal, magnetic); None: "base" is assumed, with a note.
        phase_sense: "lag" of a phase that grows as the tip lags more, "lead" of its opposite; None: determined from the
            curve if possible. A factor of the phase in `columns` says that it is a lag then.
        bin_nm: width of the bins of height in the table of a curve, 0 to merge equal heights only; None: rows as they
            are, or where heights repeat or are not in order bins of five rows or a 200th of a branch.
        numbers: what the file does not say, or says wrongly: the keys of `OPTIONS`, each a number or a pair with its
            standard error; `nm_per_volt="slope"` takes the sensitivity from the curve's own slope.

    Raises:
        TableError: one line: the file is damaged, holds no such curve, or a channel is missing.
        ValueError: if an option is impossible.
    """
    if bin_nm is not None and not 0.0 <= bin_nm < np.inf:
        raise ValueError(f"`bin_nm` must be finite and not below 0, but is {bin_nm!r}")
    of_slope = {"nm_per_volt": None} if numbers.get("nm_per_volt") == "slope" else {}
    given = given_numbers(numbers | of_slope, OPTIONS, any_sign=("offset_origin_nm",))
    wanted = parse_columns(columns)
    recording = read_recording(path)
    _refuse_others(recording)
    stated = any(segment.branch for segment in recording.segments)
    recording = laid_out(recording, wanted)
    known = recording.known | {"drive": Known(drive or "base", "", "option `drive=...`" if drive else _ASSUMED_BASE)}
    known |= given
    if "drive_frequency_khz" not in known and "free_frequency_khz" in known:
        # lock-ins are tuned to the resonance before a curve is taken
        known["drive_frequency_khz"] = replace(known["free_frequency_khz"], origin=ASSUMED_RESONANCE, error=None)
    numbered = groupby(recording.segments, key=lambda segment: segment.curve)
    joined = [curve for _, segments in numbered for curve in _joined(recording, list(segments), wanted)]
    if any(curve.amplitude is not None for curve in joined):
        _refuse_modes(recording)
    said = {role for role, source in wanted.items() if source.factor is not None}
    sense = phase_sense or ("lag" if "phase_lag_deg" in said else "")
    curves = []
    for number, one in enumerate(joined, start=1):
        curve = replace(one, curve=number, curves=len(joined), known=dict(known))
        if "offset_nm" not in said and _running_away(curve):
            curve = replace(curve, offset_nm=-curve.offset_nm, notes=(*curve.notes, _TURNED))
        if not stated and not any(_as_named(curve)):
            curve = replace(curve, branch=np.where(curve.branch == "approach", "retract", "approach"))
        curves.append(_binning(_judged(curve, of_slope=bool(of_slope), stated_sense=sense), bin_nm))
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
    if any(name.startswith("Frequency") for name in recording.channels):
        raise TableError(f"{recording.source}: holds a resonance sweep, not a curve; `afm-jax calibrate` fits it")


def _refuse_modes(recording: Recording) -> None:
    """Check that a file with amplitudes, where it says in which mode it was recorded, says tapping.

    Raises:
        TableError: with the name of the mode, or of the channel that tells it.
    """
    refuse_other_modes(recording.settings, recording.source)
    channel = next((name for name in recording.channels if _OTHER_CHANNELS.fullmatch(name)), None)
    if channel is not None:
        raise TableError(
            f"{recording.source}: holds a channel {channel!r}, which is none of amplitude modulation (tapping) of one "
            "mode; its amplitude and phase do not give the energy of a tap"
        )


def _joined(recording: Recording, segments: list[Segment], wanted: Mapping[str, ColumnSource]) -> list[MeasuredCurve]:
    """Return the curves in segments of one number, in the table's quantities.

    Where no branch is stated the heights tell it, and an approach and a retract are a curve.
    """
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
    missing = next((role for role in ("lockin_amplitude_nm", "phase_lag_deg") if role not in sources), "")
    ask = f'; if one of the channels {others} is: `columns="{missing}=CHANNEL:UNIT"`' if others else ""
    if missing:
        notes.append(f"{_NO_PHASE if missing == 'phase_lag_deg' else _NO_AMPLITUDE}{ask}.")
    ways = [(segment.branch, _converted(recording, segment, sources)) for segment in segments]
    size, (branch, columns) = len(ways), ways[0]
    if not branch:
        offset, size, ways = columns["offset_nm"], 2, []
        if len(offset) >= _FEWEST and np.median(np.abs(np.diff(offset))) >= _JUMPS * np.ptp(offset):
            notes.append(_MIXED)
        for first, last in pairwise([0, *turns_of(offset), len(offset)]):
            branch = "approach" if offset[last - 1] >= offset[first] else "retract"
            ways.append((branch, {role: numbers[first:last] for role, numbers in columns.items()}))
    scales = {"length": "nm", "voltage": "V", "force": "nN"}
    units = {role: scales.get(quantity_of(source.unit), "") for role, source in sources.items()}
    curves = []
    for some in (ways[first : first + size] for first in range(0, len(ways), size)):
        columns = {role: np.concatenate([parts[role] for _, parts in some]) for role in sources}
        branches = [np.full(len(parts["offset_nm"]), name) for name, parts in some]
        amplitude, phase = columns.get("lockin_amplitude_nm"), columns.get("phase_lag_deg")
        inverted = amplitude is not None and amplitude[np.argmax(np.abs(amplitude))] < 0.0
        curve = MeasuredCurve(
            source=recording.source,
            format=recording.format,
            curve=len(curves) + 1,
            curves=len(ways) // size,
            branch=np.concatenate(branches),
            offset_nm=columns["offset_nm"],
            amplitude=-amplitude if amplitude is not None and inverted else amplitude,
            amplitude_unit=units.get("lockin_amplitude_nm", "nm"),
            phase_lag_deg=None if phase is None else np.unwrap(phase, period=360.0),
            deflection=columns.get("deflection_nm"),
            deflection_unit=units.get("deflection_nm", "nm"),
            free=np.zeros(len(columns["offset_nm"]), dtype=bool),
            notes=(*notes, *([_INVERTED] if inverted else [])),
        )
        curves.append(curve)
    return curves


_NO_PHASE = "There is no phase, so that the energy of a tap has an upper bound only"
_INVERTED = "Sign: the amplitude is negative (an inverted channel), and its sign was reversed."
_FEWEST, _JUMPS = 20, 0.05
"""Rows, and median step of the heights, of their range, from which they are no ramp."""
_MIXED = (
    "Direction: heights jump to and fro, so that approach and retract cannot be distinguished: all rows are one "
    "branch; else give a column branch."
)


def _source(
    recording: Recording, segment: Segment, role: str, wanted: Mapping[str, ColumnSource], notes: list[str]
) -> ColumnSource | None:
    """Return the channel that becomes a column, with its unit; notes say what was assumed."""
    names, (quantities, patterns), source = list(segment.channels), ROLES[role], wanted.get(role)
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
        notes.append(f'Unit: {source.channel} has none; {usual} is assumed; else `columns="{role}=NAME:UNIT"`.')
    return replace(source, unit=checked_unit(unit or usual, role, source.channel, recording.source))


def _converted(
    recording: Recording, segment: Segment, sources: Mapping[str, ColumnSource]
) -> dict[str, Float[np.ndarray, " rows"]]:
    """Return the columns of a segment in the table's units, without padding at the end.

    Raises:
        TableError: if a channel is not there, or a number is none, or impossible.
    """
    where = f"{recording.source}, curve {segment.curve}"
    missing = next((one.channel for one in sources.values() if one.channel not in segment.channels), None)
    if missing is not None:
        raise TableError(f"{where}: the {segment.branch} has no channel {missing}")
    raw = {role: segment.channels[source.channel] for role, source in sources.items()}
    # rows at the end that hold nothing, or zeros alone, are the padding of a shorter way
    held = np.flatnonzero(np.any([np.isfinite(numbers) & (numbers != 0.0) for numbers in raw.values()], axis=0))
    columns = {}
    for role, source in sources.items():
        with np.errstate(over="ignore", invalid="ignore"):
            numbers = raw[role] * (UNITS[source.unit][1] * (source.factor or 1.0))
        columns[role] = numbers[: held[-1] + 1] if held.size else numbers
        bad = np.flatnonzero(~(np.abs(columns[role]) < 1e9))
        if bad.size:
            what = "beyond 1e9; give its unit" if np.isfinite(raw[role][bad[0]]) else "not a number; remove the row"
            raise TableError(
                f"{where}, row {bad[0] + 1}, channel {source.channel}: is {what}, or export the file again"
            )
    return columns


_AWAY = 0.95
"""Amplitude far from the sample over that near to it below which heights run the other way."""


def _running_away(curve: MeasuredCurve) -> tuple[float, float] | None:
    """Return the amplitudes farthest from the sample and nearest to it of a curve whose heights grow away from it.

    Its amplitude falls towards the lower end of the heights, and only there.
    """
    if curve.amplitude is None or any(look.slope is not None for look in _looks(curve).values()):
        return None
    amplitude = curve.amplitude[np.argsort(curve.offset_nm, kind="stable")]
    some = max(len(amplitude) // 20, 1)
    far, near = float(np.median(amplitude[:some])), float(np.median(amplitude[-some:]))
    return (far, near) if far < _AWAY * near else None


def _as_named(curve: MeasuredCurve) -> list[bool]:
    """Say of every branch whether its heights rise in an approach, or fall in a retract."""
    ways = ways_of(curve.offset_nm, curve.branch)
    return [bool(way[-1] >= way[0]) == (name == "approach") for name, way in ways.items()]


_TURNED = "Direction: the amplitude falls where the heights are lowest: they grow away from the sample and were turned."


def _binning(curve: MeasuredCurve, bin_nm: float | None) -> MeasuredCurve:
    """Return a curve with the width of its table's bins: as given, or the usual one where heights ask for bins."""
    repeated, back = faults_of_order(curve.offset_nm, curve.branch)
    if bin_nm is None and not repeated and not back:
        return curve
    width = usual_width(curve.offset_nm, curve.branch) if bin_nm is None else bin_nm
    why = f"{repeated} rows repeat a height and {back} step back" if repeated or back else "asked for"
    how = f"of {width:.3g} nm, with their scatter for an error" if width else "of equal height"
    note = f"Bins: {why}; the table has the means of bins {how} (`bin_nm=...`)."
    return replace(curve, bin_nm=width, notes=(*curve.notes, note))


def _judged(curve: MeasuredCurve, *, of_slope: bool, stated_sense: str) -> MeasuredCurve:
    """Return a curve with free rows, slope, origin and zero of the phase found, and everything doubtful named."""
    if curve.amplitude is None:
        return curve
    known, looks = dict(curve.known), _looks(curve)
    slope = _mean_slope(looks) if of_slope else None
    if slope is not None:
        known["nm_per_volt"] = _scale_of_slope(curve, slope, looks)
    if "nm_per_volt" in known and (slope is not None or curve.amplitude_unit == "V"):
        amplitude = curve.amplitude * float(known["nm_per_volt"].value)
        curve = replace(curve, amplitude=amplitude, amplitude_unit="nm")
        looks = _looks(curve)
    free = np.zeros(len(curve.offset_nm), dtype=bool)
    for branch, look in looks.items():
        free[np.flatnonzero(curve.branch == branch)[look.free]] = True
    curve = replace(curve, known=known, free=free, slope=_mean_slope(looks))
    curve = replace(curve, reasons=tuple(_reasons(curve, looks)))
    notes = list(curve.notes)
    _add_levels(curve, looks)
    offset = curve.offset_nm - _add_origin(curve, looks)
    phase = _add_phase(curve, looks, stated_sense, notes)
    # in volts the sensitivity comes first
    needless = "free_amplitude_nm" if curve.amplitude_unit == "V" else "nm_per_volt"
    missing = tuple(key for key in (*_NEEDED, *_WANTED) if key not in {*known, needless})
    notes += _scale_notes(curve)
    return replace(curve, offset_nm=offset, phase_lag_deg=phase, notes=tuple(notes), missing=missing)


def _looks(curve: MeasuredCurve) -> dict[str, BranchLook]:
    offset, amplitude, lag = curve.offset_nm, np.asarray(curve.amplitude), curve.phase_lag_deg
    rows = {branch: curve.branch == branch for branch in dict.fromkeys(curve.branch.tolist())}
    return {
        branch: look_at(offset[here], amplitude[here], None if lag is None else lag[here])
        for branch, here in rows.items()
    }


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
    scale, unit = 1.0 / abs(slope[0]), curve.amplitude_unit
    parts = [
        f"{look.slope.rows} rows of the {branch} from {look.slope.from_nm:.2f} to {look.slope.to_nm:.2f} nm"
        for branch, look in looks.items()
        if look.slope is not None
    ]
    how = f"slope of the steepest settled part ({' and '.join(parts)}), assumed to be 1 nm per nm (a hard sample)"
    return Known(scale, f"nm/{unit}", f"measured: {how}; unit {unit}", scale * slope[1] / abs(slope[0]))


def _reasons(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> list[str]:
    """Return why a curve must not be used: free amplitudes that jump, heights that run the wrong way."""
    unit, away = curve.amplitude_unit, _running_away(curve)
    jumps = [
        f"jumps from {look.jump[0]:.4g} to {look.jump[1]:.4g} {unit} within the {branch}"
        for branch, look in looks.items()
        if look.jump is not None
    ]
    levels = {branch: look.level for branch, look in looks.items()}
    if np.ptp(list(levels.values())) > JUMP * max(levels.values()):
        jumps.append("is " + " and ".join(f"{level:.4g} {unit} in the {branch}" for branch, level in levels.items()))
    reasons = [
        f"The free amplitude {jump}: the drive or the demodulation changed while the curve was recorded."
        for jump in jumps
    ]
    if away is not None:
        far, near = (f"{amplitude:.4g} {unit}" for amplitude in away)
        reasons.append(
            f"The amplitude is smaller far from the sample ({far}) than near it ({near}): the heights run the other "
            'way; turn them round with `columns="offset_nm=CHANNEL:-1"` (or drop that -1).'
        )
    reasons += [
        f"There is no flat free part in the {branch}: the amplitude still changes by {look.change:.1%} over the "
        "farthest quarter of the rows; record farther away, or give `free_amplitude_nm=...`."
        for branch, look in looks.items()
        if look.change is not None and "free_amplitude_nm" not in curve.known
    ]
    return reasons


def _add_levels(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> None:
    """Add the free amplitude and the errors of single rows to what is known, from the free ones."""
    level = float(np.mean([look.level for look in looks.values()]))
    noise = max((look.noise for look in looks.values() if look.noise > 0.0), default=0.0)
    scatter_of_rows = "measured: scatter of the free rows"
    if curve.amplitude_unit == "nm":
        if not any(look.jump for look in looks.values()):
            how, error = f"measured: median of {curve.free.sum()} free rows", max(v.level_error for v in looks.values())
            curve.known.setdefault("free_amplitude_nm", Known(level, "nm", how, float(error)))
        how = scatter_of_rows if noise else "assumed: 1 % of the free amplitude"
        curve.known.setdefault("amplitude_error_nm", Known(noise or 0.01 * level, "nm", how))
    if curve.phase_lag_deg is not None:
        ways = [curve.phase_lag_deg[curve.free & (curve.branch == branch)] for branch in looks]
        scatter = max(float(np.std(np.diff(way)) / np.sqrt(2.0)) if len(way) > 4 else 0.0 for way in ways)
        how = scatter_of_rows if scatter > 0.0 else "assumed: 1 degree"
        curve.known.setdefault("phase_error_deg", Known(scatter or 1.0, "deg", how))


def _add_origin(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> float:
    """Return the height of the tip's rest position if it can be determined, else 0; add it to what is known."""
    given, level = curve.known.get("offset_origin_nm"), curve.number("free_amplitude_nm")
    onsets = [look.onset_nm for branch, look in sorted(looks.items()) if look.onset_nm is not None]
    if given is not None:
        curve.known["offset_origin_nm"] = replace(given, error=given.error or _ASSUMED_ORIGIN_NM)
    elif onsets and level is not None and curve.amplitude_unit == "nm":
        how = "measured: where the amplitude begins to fall the free tip just touches (-free_amplitude_nm)"
        error = float(np.hypot(_ASSUMED_ORIGIN_NM, np.ptp(onsets)))
        curve.known["offset_origin_nm"] = Known(float(onsets[0] + level), "nm", f"{how}; error assumed", error)
    return curve.number("offset_origin_nm") or 0.0


_ASSUMED_ORIGIN_NM = 1.0
"""Error of an origin read off the curve: attraction moves the contact by about so much."""
_RADIANS_DEG = 30.0
"""How near to the free tip's lag its phase, read as radians, must be to be recognized as such."""


def _add_phase(
    curve: MeasuredCurve, looks: Mapping[str, BranchLook], stated: str, notes: list[str]
) -> Float[np.ndarray, " rows"] | None:
    """Return the phase with sign and zero such that free rows lag as frequency and Q say; add both to what is known.

    Raises:
        TableError: if the phases are radians.
    """
    phase, known = curve.phase_lag_deg, curve.known
    if phase is None:
        return None
    if stated:
        # as the curve keeps it, it is a lag
        known["phase_sense"] = Known("lag", "", f"option: the file's phase is a {stated}")
    if not {"drive_frequency_khz", "free_frequency_khz", "quality_factor"} <= set(known):
        if not stated:
            notes.append(f"Sign: a larger phase is assumed to be a larger lag; {SENSE_OPTION} states the sign.")
        notes.append("Zero: the phase has the instrument's own zero; free frequency and Q would determine it.")
        return SENSES.get(stated, 1.0) * phase
    readings = _phase_readings(curve, looks)
    lag, free = float(readings.free_lag_deg[0]), phase[curve.free]
    level, scatter = float(np.median(free)), float(np.std(free) / np.sqrt(len(free)))
    near = abs(np.rad2deg(abs(level)) - lag) < _RADIANS_DEG < lag
    if near and np.nanmax(np.abs(phase)) < 2.0 * np.pi and abs(np.rad2deg(level)) > 0.5 * lag:
        raise TableError(
            f"{printable(curve.source)}: the phase reads {level:.3g} where the tip is free and lags by {lag:.1f} "
            'degrees: it is in radians; say `columns="phase_lag_deg=CHANNEL:rad"`'
        )
    s, quality, either = readings.frequency_ratio[0], readings.quality_factor, np.array([1.0, -1.0])
    of_ratio = free_lag_deg(readings.drive, s * (1.0 + readings.frequency_error * either), quality)
    of_quality = free_lag_deg(readings.drive, s, quality * (1.0 + readings.quality_error * either))
    error = float(np.linalg.norm([max(scatter, 0.01), 0.5 * np.ptp(of_ratio), 0.5 * np.ptp(of_quality)]))
    how = f"measured: the free rows read {level:.2f} deg and are set to {lag:.2f}, what s and Q give"
    sense = sense_of_phase(readings, stated)
    known["phase_zero_deg"] = Known(sense.zero_deg, "deg", how, error)
    notes += [*sense.notes, *([f"Sign: {sense.reason}."] if sense.reason else [])]
    return sense.lag_deg(phase)


def _phase_readings(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> PhaseReadings:
    """Return what of a curve with known frequency and Q says which sense its phase has."""
    value = {key: float(one.value) for key, one in curve.known.items() if not isinstance(one.value, str)}
    given = [(key, curve.known[key].error) for key in ("free_frequency_khz", "quality_factor")]
    errors = [USUAL_ERRORS[key] if error is None else error / value[key] for key, error in given]
    ones = np.ones(len(curve.offset_nm))
    level = float(np.mean([look.level for look in looks.values()]))
    rows = [np.flatnonzero(curve.branch == branch) for branch in looks]
    return PhaseReadings(
        drive=str(curve.known["drive"].value),
        frequency_ratio=value["drive_frequency_khz"] / value["free_frequency_khz"] * ones,
        frequency_error=errors[0],
        quality_factor=value["quality_factor"],
        quality_error=errors[1],
        ratio=np.asarray(curve.amplitude) / level,
        ratio_error=value.get("amplitude_error_nm", 0.01 * level) / level * ones,
        phase_deg=np.asarray(curve.phase_lag_deg),
        phase_error_deg=value["phase_error_deg"] * ones,
        free=curve.free,
        ways=[way[np.argsort(curve.offset_nm[way], kind="stable")] for way in rows],
    )


def _scale_notes(curve: MeasuredCurve) -> list[str]:
    """Say what the slope in contact means for the scale of the amplitude."""
    scale = curve.known.get("nm_per_volt")
    if curve.slope is None or (scale is not None and scale.origin.startswith("measured")):
        return []
    slope, error, unit = abs(curve.slope[0]), curve.slope[1], curve.amplitude_unit
    falls = f"Gain: in contact the amplitude falls by {slope:.3g} +- {error:.1g} {unit} per nm"
    if unit == "V":
        return [f'{falls}; on a hard sample that is {1.0 / slope:.3g} nm/V (`nm_per_volt="slope"`).']
    if abs(slope - 1.0) <= max(0.1, 3.0 * error):
        return []
    named = {np.sqrt(0.5): ", as an rms amplitude would", 2.0: ", as a peak-to-peak amplitude would"}
    why = next((what for factor, what in named.items() if abs(slope / factor - 1.0) < 0.05), "")
    soft = ", or the sample is soft" if slope < 1.0 else ""
    return [f'{falls}, not by 1{why}: the scale of the amplitude is off by that{soft}; `nm_per_volt="slope"` sets it.']


def table_text(curve: MeasuredCurve) -> str:
    """Return a curve as a table of `afm-jax tapping` and `afm-jax fit`.

    Raises:
        TableError: if something is missing, naming the options that give it, or the curve must not be used.
    """
    if curve.amplitude is None:
        why = next((note for note in curve.notes if note.startswith(_NO_AMPLITUDE)), _NO_AMPLITUDE)
        raise TableError(f"{curve.source}, curve {curve.curve}: it gives no table. {why}")
    if curve.reasons:
        raise TableError(f"{curve.source}, curve {curve.curve}: {curve.reasons[0]}")
    needed = [key for key in curve.missing if key in _NEEDED]
    if needed:
        words = {key: unit.upper() for key, unit in OPTIONS.items()} | {"nm_per_volt": 'NM_PER_V|"slope"'}
        options = " ".join(f"`{key}={words[key]}`" for key in needed)
        raise TableError(f"{curve.source}: the file does not say {', '.join(needed)}; give {options}")
    rows, in_order = _rows(curve)
    drive: dict[str, Any] = {key: curve.number(key) for key in ("drive_frequency_khz", "free_amplitude_nm")}
    columns = drive | rows
    # an offset of the detector may take the amplitude of a tip that does not move below zero
    moving = rows["lockin_amplitude_nm"] > 0.0
    cells = [np.broadcast_to(column, moving.shape)[moving].tolist() for column in columns.values()]
    lines = [f"# drive = {curve.known['drive'].value}", *_setting_lines(curve)]
    if in_order:
        lines.append("# rows = in order of time")
    remarks = [f"read from {Path(curve.source).name} ({curve.format}), curve {curve.curve}", *curve.notes]
    zero = curve.known.get("phase_zero_deg")
    remarks += [] if zero is None or not zero.error else [zero_of_free_rows(zero.error)]
    if not moving.all():
        remarks.append(f"left out: {np.sum(~moving)} rows whose amplitude is not above zero")
    lines += [f"# {remark}" for remark in remarks]
    lines.append(",".join(columns))
    lines += [",".join(map(repr, row)) for row in zip(*cells, strict=True)]
    return "\n".join(lines) + "\n"


def zero_of_free_rows(error: float) -> str:
    """Return the remark that a zero of the phase with this error is that of the free rows, and no knowledge besides."""
    return f"phase_zero_deg +- {error!r} is that of the free rows, as frequency and Q leave it"


def _rows(curve: MeasuredCurve) -> tuple[dict[str, np.ndarray], bool]:
    """Return the rows of a curve's table, its bins or the rows as they were read, and if they are in order of time."""
    readings = {"lockin_amplitude_nm": np.asarray(curve.amplitude)}
    single = {"lockin_amplitude_nm": curve.known["amplitude_error_nm"]}
    if curve.phase_lag_deg is not None:
        readings["phase_lag_deg"], single["phase_lag_deg"] = curve.phase_lag_deg, curve.known["phase_error_deg"]
    width = curve.bin_nm or 0.0
    stated = {name: float(one.value) for name, one in single.items() if not width or one.origin.startswith("option")}
    rows, in_order = binned(curve.offset_nm, readings, curve.branch, curve.free, width, stated)
    number, branch = rows.pop("rows"), rows.pop("branch")
    for name, one in single.items():
        # rows without any scatter (a resolution that is coarser than the noise) have that of the free tip
        error = rows[error_of(name)]
        rows[error_of(name)] = np.where(error > 0.0, error, float(one.value) / np.sqrt(number))
    rows["retract"] = (branch == "retract").astype(int)
    return rows, in_order and (curve.bin_nm is not None or all(_as_named(curve)))


def _setting_lines(curve: MeasuredCurve) -> list[str]:
    """Return the comment lines that a table understands."""
    known = curve.known
    lever = [key for key in ("free_frequency_khz", *_WANTED) if key in known]
    zeros = [key for key in ("offset_origin_nm", "phase_zero_deg") if key in known and known[key].error]
    lines = [setting_line(key, known[key].value, known[key].error) for key in lever]
    lines += [setting_line(key, "0", known[key].error) for key in zeros]
    if curve.phase_lag_deg is not None:
        # the zero was set by the free rows: it says nothing of the sign
        lines.append(f"# phase_sense = {'lag' if 'phase_sense' in known else 'either'}")
    scale = known.get("nm_per_volt")
    if scale is not None and scale.error and not isinstance(scale.value, str):
        lines.append(setting_line("tip_calibration", "1", scale.error / scale.value))
    return lines
