"""Whether a trace is a steady single-impact orbit, and if not, what it is: the first finding of a list that applies."""

import enum
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.outcomes import Rule
from afm_jax.words import counted
from fitting.traces.fold import Fold, OrderSearch
from fitting.traces.impacts import ImpactCount, Ringing, Steadiness

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


class Finding(NamedTuple):
    """One thing that a trace may show: its kind, and when it does with which sentence, as a `Rule` has them."""

    kind: TraceKind
    when: Callable[["TraceEvidence"], Any]
    sentence: str | Callable[["TraceEvidence", Any], str]


@dataclass(frozen=True)
class Lines:
    """The lines of a folded trace at the drive's frequency, its fractions and multiples, and the noise beside them.

    Attributes:
        folded: of any order at which the trace repeats.
        drive_amplitude_nm: of the platform, None where it is not given.
    """

    folded: Fold
    drive_amplitude_nm: float | None

    @cached_property
    def heights_nm(self) -> Float[np.ndarray, " lines"]:
        """Amplitude of each line, the response frequency's first."""
        return 2.0 * np.abs(self.folded.waveform.coefficients[1:])

    @property
    def seen_nm(self) -> float:
        """Amplitude from which a line stands out of the noise."""
        return _SEEN * self.folded.noise_nm * float(np.sqrt(2.0 / len(self.folded.height)))

    @property
    def silent(self) -> bool:
        """Whether no line stands out; the largest of K lines of noise is expected near sqrt(2 ln K) errors."""
        return bool(self.heights_nm.max() <= self.seen_nm * np.sqrt(1.0 + np.log(len(self.heights_nm))))

    @property
    def amplitude_nm(self) -> float:
        """Amplitude at the drive's frequency."""
        return float(self.heights_nm[self.folded.order - 1])

    @property
    def sine(self) -> bool:
        """Whether the motion is a sine at the drive's frequency: the other lines that stand out are small."""
        order = self.folded.order
        if len(self.heights_nm) < 2 * order:
            return False
        others = np.delete(np.where(self.heights_nm > self.seen_nm, self.heights_nm, 0.0), order - 1)
        return bool(np.sqrt(np.sum(others**2)) <= _SINE * self.amplitude_nm)

    @property
    def flightless(self) -> bool:
        """Whether the trace is without response or without free flights."""
        return self.silent or self.sine


@dataclass(frozen=True)
class TraceEvidence:
    """All that the verdict looks at; `impacts` is None where counting makes no sense, `order` is the one asked for."""

    lines: Lines
    search: OrderSearch
    steadiness: Steadiness
    impacts: ImpactCount | None
    order: int | None
    ringing: Ringing | None = None

    @property
    def folded(self) -> Fold:
        """The last whole response periods."""
        return self.lines.folded

    @property
    def scattered(self) -> bool:
        """Whether response periods differ by more than noise: a sine, or nothing, fitted to them means nothing."""
        return self.steadiness.excess > _BROADBAND

    @property
    def left(self) -> float:
        """What the waveform leaves of the motion, of its standard deviation."""
        return self.folded.noise_nm / max(self.folded.spread_nm, 1e-300)

    @property
    def unrepeated(self) -> bool:
        """Whether nothing repeats: response periods differ, or neither waveform nor prediction explains the motion."""
        missed = float(self.search.misfit_nm[self.folded.order - 1]) / max(self.search.spread_nm, 1e-300)
        return self.scattered or not (self.left < _UNEXPLAINED or missed < _UNEXPLAINED)

    @property
    def drive_khz(self) -> float:
        """Frequency of the drive."""
        return 1e3 * self.folded.order / self.folded.period_us

    @property
    def seen_khz(self) -> float:
        """Frequency of the drive that would explain how the phase runs."""
        return self.drive_khz * (1.0 + (self.steadiness.phase_step_deg or 0.0) / 360.0)

    @property
    def longest(self) -> str:
        """Up to which period a repetition was looked for."""
        return f"no repetition within {counted(len(self.search.misfit_nm), 'drive period')}"

    @property
    def ends_nm(self) -> tuple[float, float]:
        """Between which heights nearly all samples lie."""
        low, high = np.percentile(self.folded.height, (1.0, 99.0)).tolist()
        return low, high

    @property
    def uncounted(self) -> str:
        """Why the impacts are not counted; empty where they are."""
        if self.impacts is None:
            return "the free frequency is not known"
        return "" if self.impacts.impacts is not None else str(self.impacts.reason)

    @property
    def count(self) -> int:
        """Impacts in a response period, 1 where they are not counted."""
        return 1 if self.impacts is None or self.impacts.impacts is None else self.impacts.impacts

    @property
    def multiple(self) -> str:
        """By what the period of the single-impact orbit is longer, in words."""
        return {2: "doubled", 3: "tripled"}.get(self.count, f"{self.count} times as long")


def judge_trace(evidence: TraceEvidence) -> TraceVerdict:
    """Return what a trace shows: the first of the findings that applies."""
    found = ((one.kind, Rule(one.when, one.sentence).said_of(evidence)) for one in FINDINGS)
    return next(TraceVerdict(kind, said[0]) for kind, said in found if said)


def _flightless(e: TraceEvidence) -> bool:
    return e.lines.sine and not e.lines.silent and not e.scattered


def _held(e: TraceEvidence) -> bool:
    """Say whether a sine is that of a tip which follows the platform."""
    given = e.lines.drive_amplitude_nm
    return given is None or _FOLLOWS[0] * given <= e.lines.amplitude_nm <= _FOLLOWS[1] * given


def _ringing_in_words(_: TraceEvidence, found: Ringing) -> str:
    fades = "without a decay" if np.isinf(found.quality_factor) else f"decaying with Q = {found.quality_factor:.3g}"
    what = f"a free vibration of {found.frequency_khz:.5g} kHz {fades}, beside the drive's frequency"
    return f"{what}: the tip rings, nothing touches it"


_SINE_IN_WORDS = "a sine of {e.lines.amplitude_nm:.4g} nm at the drive frequency without impacts"
_OF_PLATFORM = f"{_SINE_IN_WORDS}, whose amplitude is {{e.lines.drive_amplitude_nm:.4g}} nm"

FINDINGS = (
    Finding(
        TraceKind.NO_RESPONSE,
        lambda e: e.folded.is_constant,
        "no response: the deflection is {e.folded.height[0]:.4g} nm throughout",
    ),
    Finding(
        TraceKind.NO_RESPONSE,
        lambda e: e.lines.silent and not e.scattered,
        "no response at the drive frequency or its subharmonics: no line of the response exceeds "
        "{e.lines.seen_nm:.3g} nm (noise {e.folded.noise_nm:.3g} nm a sample)",
    ),
    Finding(
        TraceKind.STUCK,
        lambda e: _flightless(e) and e.lines.drive_amplitude_nm is None,
        f"{_SINE_IN_WORDS}: the tip is held and moves with the platform, or nothing touches it",
    ),
    Finding(
        TraceKind.STUCK,
        lambda e: _flightless(e) and _held(e),
        f"{_OF_PLATFORM}: the tip is stuck to the platform",
    ),
    Finding(TraceKind.NO_IMPACT, _flightless, f"{_OF_PLATFORM}: no free flight, no impact"),
    Finding(TraceKind.RINGING, lambda e: [] if e.ringing is None else [e.ringing], _ringing_in_words),
    Finding(
        TraceKind.DRIFTING,
        lambda e: e.unrepeated and e.steadiness.phase_step_deg is not None,
        "the phase runs by {e.steadiness.phase_step_deg:+.3g} degrees per response period: the drive frequency "
        "seems to be {e.seen_khz:.7g} kHz, not {e.drive_khz:g} kHz (or the sampling rate is off)",
    ),
    Finding(
        TraceKind.DRIFTING,
        lambda e: e.scattered and e.steadiness.trend_share > _SLOW,
        "a transient or a drift: the response changes by {e.steadiness.excess:.1%} over the trace",
    ),
    Finding(
        TraceKind.NOT_PERIODIC,
        lambda e: e.unrepeated and not e.scattered,
        "{e.longest}, or too much noise: {e.left:.0%} of the motion is not explained",
    ),
    Finding(
        TraceKind.NOT_PERIODIC,
        lambda e: e.scattered,
        "chaotic, or of a longer period: {e.longest}; response periods differ by {e.steadiness.excess:.1%} of the "
        "motion beyond the noise",
    ),
    Finding(
        # a sample from below lets the tip fly upward only
        TraceKind.UPSIDE_DOWN,
        lambda e: e.ends_nm[0] < 0.0 and abs(e.ends_nm[1]) <= _BELOW * abs(e.ends_nm[0]),
        "the deflection lies between {e.ends_nm[0]:.4g} and {e.ends_nm[1]:.4g} nm, but a bouncing tip flies above "
        "its rest position: multiply it by -1, or give what it reads at rest (`rest_nm=...`)",
    ),
    Finding(
        TraceKind.DRIFTING,
        lambda e: max(e.steadiness.lockin_drift, e.steadiness.peak_drift) > _DRIFT,
        "a transient or a drift: over the trace the lock-in value by {e.steadiness.lockin_drift:.2%}, peak by "
        f"{{e.steadiness.peak_drift:.2%}} (steady below {_DRIFT:.0%})",
    ),
    Finding(
        # one drive period cannot hold a doubled one
        TraceKind.NOT_COUNTED,
        lambda e: e.folded.order > 1 and bool(e.uncounted),
        "repeats after {e.folded.order} drive periods, but whether with one impact cannot be said: {e.uncounted}",
    ),
    Finding(
        TraceKind.NO_IMPACT,
        lambda e: e.count == 0,
        "repeats after {e.folded.order} drive periods without a jump of the velocity: no impact",
    ),
    Finding(
        TraceKind.PERIOD_MULTIPLIED,
        lambda e: [e.folded.order // e.count] if e.count > 1 and e.folded.order % e.count == 0 else [],
        "a ({e.count},{e.folded.order}) orbit: the period of a (1,{case}) orbit {e.multiple}",
    ),
    Finding(
        TraceKind.SEVERAL_IMPACTS,
        lambda e: e.count > 1,
        "a ({e.count},{e.folded.order}) orbit: {e.count} impacts in {e.folded.order} drive periods",
    ),
    Finding(
        TraceKind.OTHER_ORDER,
        lambda e: e.order not in {None, e.folded.order},
        "repeats after {e.folded.order} drive periods, not after {e.order} as asked for",
    ),
    Finding(
        TraceKind.STEADY,
        lambda _: True,
        "a steady ({e.count},{e.folded.order}) orbit over {e.folded.cycles} response periods",
    ),
)
"""What a trace may show, in the order in which it is looked for."""
