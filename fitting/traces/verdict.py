"""Whether a trace is a steady single-impact orbit, and if not, what it is, in words."""

import enum
from typing import NamedTuple

import numpy as np

from fitting.traces.fold import Fold, OrderSearch
from fitting.traces.impacts import ImpactCount, Peak, Ringing, Steadiness
from fitting.traces.trace import TraceSettings

_BROADBAND = 0.03
"""Scatter beyond the noise, of the standard deviation, from which a motion does not repeat."""
_UNEXPLAINED = 0.5
"""Share of the standard deviation that the waveform may leave before nothing can be said to repeat."""
_DRIFT = 0.01
_SLOW = 0.7
"""Share of the scatter that a slow change explains where the motion drifts rather than being chaotic."""
_SINE = 0.05
"""Distortion, of the drive's line, below which a motion is a sine."""
_FOLLOWS = (0.5, 1.5)
"""Amplitude of a tip held by the sample, of the drive's."""
_SEEN = 5.0
_BELOW = 0.5
"""Height over depth below which a deflection is upside down: an undamped flight from a depth d rises to d again."""


class TraceKind(enum.StrEnum):
    """What a trace shows."""

    STEADY = "steady"
    PERIOD_MULTIPLIED = "period_multiplied"
    SEVERAL_IMPACTS = "several_impacts"
    NOT_COUNTED = "impacts_not_counted"
    NO_IMPACT = "no_impact"
    NOT_PERIODIC = "not_periodic"
    DRIFTING = "drifting"
    STUCK = "stuck"
    NO_RESPONSE = "no_response"
    RINGING = "ringing"
    OTHER_ORDER = "other_order"
    UPSIDE_DOWN = "upside_down"


class TraceVerdict(NamedTuple):
    """What a trace shows: its kind, and a sentence that says so."""

    kind: TraceKind
    sentence: str


class TraceEvidence(NamedTuple):
    """All that the verdict looks at; `impacts` is None where counting makes no sense."""

    settings: TraceSettings
    search: OrderSearch
    folded: Fold
    peak: Peak
    steadiness: Steadiness
    impacts: ImpactCount | None
    order: int | None
    ringing: Ringing | None = None


def judge(evidence: TraceEvidence) -> TraceVerdict:
    """Return what a trace shows: the first of the findings below that applies."""
    first = (_constant, _without_flight, _ringing, _not_repeating, _upside_down, _drifting)
    for finding in (*first, _not_counted, _not_one_impact, _of_other_order):
        verdict = finding(evidence)
        if verdict is not None:
            return verdict
    folded = evidence.folded
    what = f"a steady ({_impacts(evidence)},{folded.order}) orbit over {folded.cycles} response periods"
    return TraceVerdict(TraceKind.STEADY, what)


def is_flightless(folded: Fold, settings: TraceSettings) -> TraceVerdict | None:
    """Return the verdict on a trace without response or without free flights; None where there are flights.

    Args:
        folded: of any order at which the trace repeats.
        settings: of the trace.
    """
    lines = 2.0 * np.abs(folded.waveform.coefficients[1:])
    drive = folded.order - 1
    error = folded.noise_nm * np.sqrt(2.0 / len(folded.height))
    # the largest of K lines of noise is expected near sqrt(2 ln K) errors
    if lines.max() <= _SEEN * error * np.sqrt(1.0 + np.log(len(lines))):
        # numbers and units as in the JSON
        size = f"no line of the response exceeds {_SEEN * error:.3g} nm (noise {folded.noise_nm:.3g} nm a sample)"
        return TraceVerdict(TraceKind.NO_RESPONSE, f"no response at the drive frequency or its subharmonics: {size}")
    if drive >= len(lines):
        return None
    # only what stands out of the noise is distortion
    seen = np.where(lines > _SEEN * error, lines, 0.0)
    distortion = float(np.sqrt(np.sum(np.delete(seen, drive) ** 2))) / float(lines[drive])
    if len(lines) < 2 * folded.order or distortion > _SINE:
        return None
    amplitude, given = float(lines[drive]), settings.drive_amplitude_nm
    sine = f"a sine of {amplitude:.4g} nm at the drive frequency without impacts"
    if given is None:
        return TraceVerdict(
            TraceKind.STUCK, f"{sine}: the tip is held and moves with the platform, or nothing touches it"
        )
    if _FOLLOWS[0] * given <= amplitude <= _FOLLOWS[1] * given:
        return TraceVerdict(
            TraceKind.STUCK, f"{sine}, whose amplitude is {given:.4g} nm: the tip is stuck to the platform"
        )
    return TraceVerdict(TraceKind.NO_IMPACT, f"{sine}, whose amplitude is {given:.4g} nm: no free flight, no impact")


def _constant(evidence: TraceEvidence) -> TraceVerdict | None:
    if not evidence.folded.is_constant:
        return None
    height = float(evidence.folded.height[0])
    return TraceVerdict(TraceKind.NO_RESPONSE, f"no response: the deflection is {height:.4g} nm throughout")


def _ringing(evidence: TraceEvidence) -> TraceVerdict | None:
    found = evidence.ringing
    if found is None:
        return None
    fades = "without a decay" if np.isinf(found.quality_factor) else f"decaying with Q = {found.quality_factor:.3g}"
    what = f"a free vibration of {found.frequency_khz:.5g} kHz {fades}, beside the drive's frequency"
    return TraceVerdict(TraceKind.RINGING, f"{what}: the tip rings, nothing touches it")


def _without_flight(evidence: TraceEvidence) -> TraceVerdict | None:
    verdict = is_flightless(evidence.folded, evidence.settings)
    # a sine, or nothing, fitted to what does not repeat means nothing
    scattered = evidence.steadiness.excess > _BROADBAND
    return None if scattered else verdict


def _not_repeating(evidence: TraceEvidence) -> TraceVerdict | None:
    folded, periods, search = evidence.folded, evidence.steadiness, evidence.search
    left = folded.noise_nm / max(folded.spread_nm, 1e-300)
    missed = float(search.misfit_nm[folded.order - 1]) / max(search.spread_nm, 1e-300)
    coloured = periods.excess > _BROADBAND
    if not coloured and (left < _UNEXPLAINED or missed < _UNEXPLAINED):
        return None
    if periods.phase_step_deg is not None:
        frequency = 1e3 * folded.order / folded.period_us
        seen = frequency * (1.0 + periods.phase_step_deg / 360.0)
        instead = f"the drive frequency seems to be {seen:.7g} kHz, not {frequency:g} kHz (or the sampling rate is off)"
        runs = f"the phase runs by {periods.phase_step_deg:+.3g} degrees per response period"
        return TraceVerdict(TraceKind.DRIFTING, f"{runs}: {instead}")
    share = max(periods.excess, 0.0 if coloured else left)
    if coloured and periods.trend_share > _SLOW:
        return TraceVerdict(
            TraceKind.DRIFTING, f"a transient or a drift: the response changes by {share:.1%} over the trace"
        )
    longest = len(search.misfit_nm)
    what = f"no repetition within {longest} drive period{'s' if longest > 1 else ''}"
    if not coloured:
        return TraceVerdict(
            TraceKind.NOT_PERIODIC, f"{what}, or too much noise: {left:.0%} of the motion is not explained"
        )
    differ = f"response periods differ by {share:.1%} of the motion beyond the noise"
    return TraceVerdict(TraceKind.NOT_PERIODIC, f"chaotic, or of a longer period: {what}; {differ}")


def _upside_down(evidence: TraceEvidence) -> TraceVerdict | None:
    """Find a tip that is farther below its rest position than above: a sample from below lets it fly upward only."""
    low, high = np.percentile(evidence.folded.height, (1.0, 99.0))
    if low >= 0.0 or abs(high) > _BELOW * abs(low):
        return None
    what = f"the deflection lies between {low:.4g} and {high:.4g} nm, but a bouncing tip flies above its rest position"
    return TraceVerdict(TraceKind.UPSIDE_DOWN, f"{what}: multiply it by -1, or give what it reads at rest (--rest-nm)")


def _drifting(evidence: TraceEvidence) -> TraceVerdict | None:
    periods = evidence.steadiness
    if max(periods.lockin_drift, periods.peak_drift) <= _DRIFT:
        return None
    what = f"lock-in value by {periods.lockin_drift:.2%}, peak by {periods.peak_drift:.2%}"
    return TraceVerdict(
        TraceKind.DRIFTING, f"a transient or a drift: over the trace the {what} (steady below {_DRIFT:.0%})"
    )


def _of_other_order(evidence: TraceEvidence) -> TraceVerdict | None:
    order, wanted = evidence.folded.order, evidence.order
    if wanted is None or order == wanted:
        return None
    return TraceVerdict(TraceKind.OTHER_ORDER, f"repeats after {order} drive periods, not after {wanted} as asked for")


def _not_counted(evidence: TraceEvidence) -> TraceVerdict | None:
    order, count = evidence.folded.order, evidence.impacts
    # one drive period cannot hold a doubled one
    if order == 1 or (count is not None and count.impacts is not None):
        return None
    why = "the free frequency is not known" if count is None else str(count.reason)
    what = f"repeats after {order} drive periods, but whether with one impact cannot be said: {why}"
    return TraceVerdict(TraceKind.NOT_COUNTED, what)


def _not_one_impact(evidence: TraceEvidence) -> TraceVerdict | None:
    order, count = evidence.folded.order, evidence.impacts
    if count is None or count.impacts is None or count.impacts == 1:
        return None
    name = f"a ({count.impacts},{order}) orbit"
    if count.impacts == 0:
        return TraceVerdict(
            TraceKind.NO_IMPACT, f"repeats after {order} drive periods without a jump of the velocity: no impact"
        )
    if order % count.impacts == 0:
        single = order // count.impacts
        factor = {2: "doubled", 3: "tripled"}.get(count.impacts, f"{count.impacts} times as long")
        return TraceVerdict(TraceKind.PERIOD_MULTIPLIED, f"{name}: the period of a (1,{single}) orbit {factor}")
    return TraceVerdict(TraceKind.SEVERAL_IMPACTS, f"{name}: {count.impacts} impacts in {order} drive periods")


def _impacts(evidence: TraceEvidence) -> str:
    count = evidence.impacts
    return "1" if count is None or count.impacts is None else str(count.impacts)
