"""Amplitude-phase-distance curves out of instruments' files: one result, whatever the format, with the origin of each.

What a file calls its channels, which way its heights run, in which units and with which zero of the phase differs from
instrument to instrument. Here it becomes `offset_nm` (height of the sample over the cantilever's rest position, growing
towards the tip), `lockin_amplitude_nm`, `phase_lag_deg` (behind the drive) and a branch; remarks state the
assumptions, and a message about a missing quantity names the option that gives it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.checks import check_parameter, checked
from afm_jax.results import JudgedResult, public_result
from fitting.instruments.bins import binned, faults_of_order, usual_width, ways_of
from fitting.instruments.branch import JUMP, BranchLook, look_at
from fitting.instruments.columns import (
    ROLES,
    ColumnSource,
    channel_of,
    columns_to_paste,
    laid_out,
    needed_channel,
    parse_columns,
    turns_of,
)
from fitting.instruments.formats import read_recording
from fitting.instruments.lag import SENSE_OPTION, SENSES, PhaseReadings, sense_of_phase
from fitting.instruments.recording import (
    ASSUMED_RESONANCE,
    UNIT_OF,
    UNITS,
    Known,
    Recording,
    Segment,
    given_numbers,
    quantity_of,
    refuse_other_modes,
)
from fitting.parameters import USUAL_ERRORS
from fitting.tables.csv_text import TableError
from fitting.tables.table import ERROR_OF, AmplitudeTable, csv_of

FORMAT_VERSION = 1
OPTIONS = {key: unit for key, unit in UNIT_OF.items() if key not in {"free_phase_deg", "tip_calibration"}}
"""Numbers that the caller may give in place of the file's; each is an option of `afm-jax read` with dashes."""
_NEEDED = ("drive_frequency_khz", "free_frequency_khz", "free_amplitude_nm", "nm_per_volt")
_WANTED = ("quality_factor", "spring_constant_n_per_m")
"""What a table cannot do without, and what it asks for."""


@public_result(home="fitting.instruments.report")
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
        amplitude: lock-in amplitude in `amplitude_unit`.
        amplitude_unit: "nm", or "V" where the sensitivity is not known.
        phase_lag_deg: lag behind the drive, or None.
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
    amplitude: Float[np.ndarray, " rows"]
    amplitude_unit: str = "nm"
    phase_lag_deg: Float[np.ndarray, " rows"] | None = None
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
        numbers: what the file does not say, or says wrongly: the keys of `OPTIONS`, each a number, a pair with its
            standard error or a text such as '44 +- 4'; `nm_per_volt="slope"` takes the sensitivity from the curve's
            own slope.

    Raises:
        TableError: one line: the file is damaged, holds no such curve, or a channel is missing.
        ValueError: if an option is impossible.
    """
    check_parameter("bin_nm", bin_nm, "not negative", optional=True)
    of_slope = numbers.get("nm_per_volt") == "slope"
    given = given_numbers(numbers | ({"nm_per_volt": None} if of_slope else {}), OPTIONS)
    wanted = parse_columns(columns)
    recording = read_recording(path)
    if any(name.startswith("Frequency") for name in recording.channels):
        raise TableError(f"{recording.source}: holds a spectrum or a resonance sweep; `afm-jax calibrate` fits it")
    recording = laid_out(recording, wanted)
    refuse_other_modes(recording.settings, recording.source, recording.channels)
    known = recording.known | {"drive": Known(drive or "base", "", "option `drive=...`" if drive else _ASSUMED_BASE)}
    known |= given
    if "drive_frequency_khz" not in known and "free_frequency_khz" in known:
        # lock-ins are tuned to the resonance before a curve is taken
        known["drive_frequency_khz"] = replace(known["free_frequency_khz"], origin=ASSUMED_RESONANCE, error=None)
    notes = list(recording.remarks)
    sources = _sources(recording, wanted, notes)
    factor = wanted["phase_lag_deg"].factor if "phase_lag_deg" in wanted else None
    sense = phase_sense or ("" if factor is None else "lag")
    by_curve = groupby(_ways(recording, sources), key=lambda way: way[0])
    joined = [[way[1:] for way in ways] for _, ways in by_curve]
    curves = []
    for number, ways in enumerate(joined, start=1):
        curve = _joined(recording, ways, sources, notes, curve=number, curves=len(joined), known=dict(known))
        curves.append(_binning(_judged(curve, of_slope=of_slope, stated_sense=sense), bin_nm))
    return curves


_ASSUMED_BASE = 'assumed: shaken at its base by a piezo; `drive="force"` for a photothermal or magnetic drive'
_NO_PHASE = "There is no phase, so that the energy of a tap has an upper bound only"
_Columns = dict[str, np.ndarray]


def _sources(recording: Recording, wanted: Mapping[str, ColumnSource], notes: list[str]) -> dict[str, ColumnSource]:
    """Return the channels that become columns; notes say what was assumed and what is missing.

    Raises:
        TableError: if there is no height, or no amplitude.
    """
    sources = {}
    for role in ROLES:
        source = (channel_of if role == "phase_lag_deg" else needed_channel)(recording, role, wanted)
        if source is None:
            paste = f"; if another channel is, {columns_to_paste(recording)}"
            notes.append(f"{_NO_PHASE}{paste if len(recording.channels) > len(sources) else ''}.")
            continue
        channel = source.channel
        if not recording.units.get(channel) and not (role in wanted and wanted[role].unit):
            notes.append(f'Unit: {channel} has none; {source.unit} is assumed; else `columns="{role}={channel}:UNIT"`.')
        sources[role] = source
    return sources


def _ways(recording: Recording, sources: Mapping[str, ColumnSource]) -> Iterator[tuple[Any, str, _Columns]]:
    """Give which curve, branch (empty if it is not stated) and columns of every ramp.

    An approach and a retract, the one after the other, are a curve then. Heights that jump about are one branch.
    """
    for segment in recording.segments:
        columns = _converted(recording, segment, sources)
        offset = columns["offset_nm"]
        turns = [] if segment.branch else turns_of(offset)
        for number, (first, last) in enumerate(pairwise([0, *turns, len(offset)])):
            part = {role: numbers[first:last] for role, numbers in columns.items()}
            yield (segment.curve, number // 2), segment.branch, part


def _joined(
    recording: Recording,
    ways: list[tuple[str, _Columns]],
    sources: Mapping[str, ColumnSource],
    notes: list[str],
    **known: Any,
) -> MeasuredCurve:
    """Return approach and retract, the one after the other, as a curve whose heights grow towards the tip."""
    columns = {role: np.concatenate([parts[role] for _, parts in ways]) for role in sources}
    offset, amplitude, phase = columns["offset_nm"], columns["lockin_amplitude_nm"], columns.get("phase_lag_deg")
    said = list(notes)
    if amplitude[np.argmax(np.abs(amplitude))] < 0.0:
        amplitude = -amplitude
        said.append("Sign: the amplitude is negative (an inverted channel), and its sign was reversed.")
    rows = [len(parts["offset_nm"]) for _, parts in ways]
    ramps = [np.split(column, np.cumsum(rows)[:-1]) for column in (offset, amplitude, np.zeros(len(offset)))]
    touches = any(look_at(*ramp).slope for ramp in zip(*ramps, strict=True))
    by_height = amplitude[np.argsort(offset, kind="stable")]
    some = max(len(offset) // 20, 1)
    # the far end has less than 0.95 of the amplitude near the sample
    turn = -1.0 if not touches and np.median(by_height[:some]) < 0.95 * np.median(by_height[-some:]) else 1.0
    if turn < 0.0:
        lowest = "the amplitude falls where the heights are lowest"
        said.append(f"Direction: {lowest}: they grow away from the sample and were turned.")
    named = ["approach" if turn * (ramp[-1] - ramp[0]) >= 0.0 else "retract" for ramp in ramps[0]]
    return MeasuredCurve(
        source=recording.source,
        format=recording.format,
        branch=np.repeat([name or direction for (name, _), direction in zip(ways, named, strict=True)], rows),
        offset_nm=turn * offset,
        amplitude=amplitude,
        amplitude_unit="V" if quantity_of(sources["lockin_amplitude_nm"].unit) == "voltage" else "nm",
        phase_lag_deg=None if phase is None else np.unwrap(phase, period=360.0),
        free=np.zeros(len(amplitude), dtype=bool),
        notes=tuple(said),
        **known,
    )


def _converted(recording: Recording, segment: Segment, sources: Mapping[str, ColumnSource]) -> _Columns:
    """Return the columns of a segment in the table's units, without padding at the end.

    Raises:
        TableError: if a number is none, or impossible.
    """
    columns = {}
    with np.errstate(over="ignore", invalid="ignore"):
        for role, source in sources.items():
            columns[role] = segment.channels[source.channel] * (UNITS[source.unit][1] * (source.factor or 1.0))
    # rows at the end that hold nothing, or zeros alone, are the padding of a shorter way
    held = np.flatnonzero(np.any([~np.isnan(numbers) & (numbers != 0.0) for numbers in columns.values()], axis=0))
    rows = held[-1] + 1 if held.size else None
    for role, source in sources.items():
        bad = np.flatnonzero(~(np.abs(columns[role][:rows]) < 1e9))
        if bad.size:
            where = f"{recording.source}, curve {segment.curve}, row {bad[0] + 1}, channel {source.channel}"
            raise TableError(
                f"{where}: is no number below 1e9; give its unit, remove the row, or export the file again"
            )
    return {role: numbers[:rows] for role, numbers in columns.items()}


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
    known, looks, notes = curve.known, _looks(curve), list(curve.notes)
    slope = _mean_slope(looks) if of_slope else None
    if slope is not None:
        # with this scale the amplitude falls by 1 nm per nm in contact
        scale = 1.0 / abs(slope[0])
        found = [(branch, look.slope.offsets_nm) for branch, look in looks.items() if look.slope is not None]
        parts = " and ".join(f"{branch} from {at[0]:.2f} to {at[-1]:.2f} nm" for branch, at in found)
        how = f"measured: slope of the steepest settled part ({parts}), assumed to be 1 nm per nm (a hard sample)"
        known["nm_per_volt"] = Known(scale, f"nm/{curve.amplitude_unit}", how, scale * slope[1] / abs(slope[0]))
    if "nm_per_volt" in known and (slope is not None or curve.amplitude_unit == "V"):
        amplitude = curve.amplitude * float(known["nm_per_volt"].value)
        curve = replace(curve, amplitude=amplitude, amplitude_unit="nm")
        looks = _looks(curve)
    free = np.zeros(len(curve.offset_nm), dtype=bool)
    for branch, look in looks.items():
        free[np.flatnonzero(curve.branch == branch)[look.free]] = True
    curve = replace(curve, free=free, slope=_mean_slope(looks))
    reasons = tuple(_reasons(curve, looks))
    _add_levels(curve, looks)
    offset = curve.offset_nm - _add_origin(curve, looks)
    phase = _add_phase(curve, looks, stated_sense, notes)
    # in volts the sensitivity comes first
    needless = "free_amplitude_nm" if curve.amplitude_unit == "V" else "nm_per_volt"
    missing = tuple(key for key in (*_NEEDED, *_WANTED) if key not in {*known, needless})
    said = (*notes, *_scale_notes(curve))
    return replace(curve, offset_nm=offset, phase_lag_deg=phase, notes=said, missing=missing, reasons=reasons)


def _looks(curve: MeasuredCurve) -> dict[str, BranchLook]:
    looks = {}
    lag = np.zeros(len(curve.offset_nm)) if curve.phase_lag_deg is None else curve.phase_lag_deg
    for branch in dict.fromkeys(curve.branch.tolist()):
        here = curve.branch == branch
        looks[branch] = look_at(curve.offset_nm[here], curve.amplitude[here], lag[here])
    return looks


def _mean_slope(looks: Mapping[str, BranchLook]) -> tuple[float, float] | None:
    """Return the weighted mean of the branches' slopes, its error widened by what they differ beyond theirs."""
    slopes = np.array([look.slope[:3] for look in looks.values() if look.slope is not None])
    if not slopes.size:
        return None
    # rows that lie on a line exactly leave no error at all
    weights = np.maximum(slopes[:, 1], 1e-9 * np.abs(slopes[:, 0])) ** -2.0
    mean, bend = np.average(slopes[:, [0, 2]], axis=0, weights=weights).tolist()
    chi2 = float(np.sum(weights * (slopes[:, 0] - mean) ** 2))
    return mean, float(np.hypot(np.sqrt(max(chi2, 1.0) / weights.sum()), bend))


def _reasons(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> list[str]:
    """Return why a curve must not be used: free amplitudes that jump, or that are nowhere seen."""
    unit, jumps, slopes = curve.amplitude_unit, [], []
    for branch, look in looks.items():
        if look.jump is not None:
            jumps.append(f"jumps from {look.jump[0]:.4g} to {look.jump[1]:.4g} {unit} within the {branch}")
        if look.change is not None and "free_amplitude_nm" not in curve.known:
            slopes.append(
                f"There is no flat free part in the {branch}: the amplitude still changes by {look.change:.1%} over "
                "the farthest quarter of the rows; record farther away, or give `free_amplitude_nm=...`."
            )
    levels = [look.level for look in looks.values()]
    if np.ptp(levels) > JUMP * max(levels):
        jumps.append("is " + " and ".join(f"{look.level:.4g} {unit} in the {branch}" for branch, look in looks.items()))
    changed = "the drive or the demodulation changed while the curve was recorded"
    return [f"The free amplitude {jump}: {changed}." for jump in jumps] + slopes


def _add_levels(curve: MeasuredCurve, looks: Mapping[str, BranchLook]) -> None:
    """Add the free amplitude and the errors of single rows to what is known, from the free ones."""
    known, level = curve.known, float(np.mean([look.level for look in looks.values()]))
    noise = max((look.noise for look in looks.values() if look.noise > 0.0), default=0.0)
    measured = "measured: scatter of the free rows"
    if curve.amplitude_unit == "nm":
        how = f"measured: median of {curve.free.sum()} free rows"
        error = float(max(look.level_error for look in looks.values()))
        known.setdefault("free_amplitude_nm", Known(level, "nm", how, error))
        how = measured if noise else "assumed: 1 % of the free amplitude"
        known["amplitude_error_nm"] = Known(noise or 0.01 * level, "nm", how)
    if curve.phase_lag_deg is not None:
        ways = [curve.phase_lag_deg[curve.free & (curve.branch == branch)] for branch in looks]
        scatter = max(float(np.std(np.diff(way)) / np.sqrt(2.0)) if len(way) > 4 else 0.0 for way in ways)
        how = measured if scatter > 0.0 else "assumed: 1 degree"
        known["phase_error_deg"] = Known(scatter or 1.0, "deg", how)


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
    readings.refuse_radians(curve.source, 'say `columns="phase_lag_deg=CHANNEL:rad"`')
    lag, free = float(readings.free_lag_deg[0]), phase[curve.free]
    level, scatter = float(np.median(free)), float(np.std(free) / np.sqrt(len(free)))
    by_instrument = [float(other.free_lag_deg[0]) - lag for other in readings.disturbed]
    error = float(np.linalg.norm([max(scatter, 0.01), *by_instrument]))
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
        ratio=curve.amplitude / level,
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
    if unit == "nm" and abs(slope - 1.0) <= max(0.1, 3.0 * error):
        return []
    hard = "on a hard sample it falls by 1 nm (by 0.71 where it is an rms amplitude, by 2 from peak to peak)"
    falls = f"Gain: in contact the amplitude falls by {slope:.3g} +- {error:.1g} {unit} per nm"
    return [f'{falls}; {hard}: `nm_per_volt="slope"` sets the scale by that.']


def table_text(curve: MeasuredCurve) -> str:
    """Return a curve as a table of `afm-jax tapping` and `afm-jax fit`; errors as of `table_of`."""
    return csv_of(table_of(curve))


def table_of(curve: MeasuredCurve) -> AmplitudeTable:
    """Return a curve as an amplitude table.

    Raises:
        TableError: if something is missing, naming the options that give it, or the curve must not be used.
    """
    where, known = f"{curve.source}, curve {curve.curve}", curve.known
    if curve.reasons:
        raise TableError(f"{where}: {curve.reasons[0]}")
    needed = [key for key in curve.missing if key in _NEEDED]
    if needed:
        words = {key: unit.upper() for key, unit in OPTIONS.items()} | {"nm_per_volt": 'NM_PER_V|"slope"'}
        options = " ".join(f"`{key}={words[key]}`" for key in needed)
        raise TableError(f"{curve.source}: the file does not say {', '.join(needed)}; give {options}")
    rows, in_order = _rows(curve)
    # an offset of the detector may take the amplitude of a tip that does not move below zero
    moving = rows["lockin_amplitude_nm"] > 0.0
    rows |= {key: np.full(moving.shape, known[key].value) for key in ("drive_frequency_khz", "free_amplitude_nm")}
    remarks = [f"read from {Path(curve.source).name} ({curve.format}), curve {curve.curve}", *curve.notes]
    header: dict[str, Any] = {key: known[key].value for key in ("free_frequency_khz", *_WANTED) if key in known}
    header |= {ERROR_OF[key]: known[key].error for key in header}
    errors = {key: one.error for key, one in known.items() if one.error}
    calibration = {key: (0.0, errors[key]) for key in ("offset_origin_nm", "phase_zero_deg") if key in errors}
    if "nm_per_volt" in errors:
        calibration["tip_calibration"] = (1.0, errors["nm_per_volt"] / float(known["nm_per_volt"].value))
    if "phase_zero_deg" in errors:
        remarks.append(zero_of_free_rows(errors["phase_zero_deg"]))
    if curve.phase_lag_deg is not None:
        # the zero was set by the free rows: it says nothing of the sign
        header["phase_sense"] = "lag" if "phase_sense" in known else "either"
    if not moving.all():
        remarks.append(f"left out: {np.sum(~moving)} rows whose amplitude is not above zero")
    return AmplitudeTable(
        **{name: column[moving] for name, column in rows.items()},
        **header,
        drive=str(known["drive"].value),
        calibration=calibration,
        rows_in_order_of_time=in_order,
        source=curve.source,
        remarks=tuple(remarks),
    )


def zero_of_free_rows(error: float) -> str:
    """Return the remark that a zero of the phase with this error is that of the free rows, and no knowledge besides."""
    return f"phase_zero_deg +- {error!r} is that of the free rows, as frequency and Q leave it"


def _rows(curve: MeasuredCurve) -> tuple[dict[str, np.ndarray], bool]:
    """Return the rows of a curve's table, its bins or the rows as they were read, and if they are in order of time."""
    readings = {"lockin_amplitude_nm": curve.amplitude}
    if curve.phase_lag_deg is not None:
        readings["phase_lag_deg"] = curve.phase_lag_deg
    errors = {"lockin_amplitude_nm": "amplitude_error_nm", "phase_lag_deg": "phase_error_deg"}
    single = {name: float(curve.known[errors[name]].value) for name in readings}
    rows, in_order = binned(curve.offset_nm, readings, curve.branch, curve.bin_nm or 0.0, single)
    # of rows as they were read heights rise in an approach, and fall in a retract
    ways = ways_of(curve.offset_nm, curve.branch).items()
    as_named = all(bool(way[-1] >= way[0]) == (name == "approach") for name, way in ways)
    return rows, in_order and (curve.bin_nm is not None or as_named)
