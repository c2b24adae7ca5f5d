"""How motions end: on an (m, N) orbit, on no repetition, stuck, away from the sample.

Takes the times in us and velocities in nm/us of the last departures; gives m, N and a `Verdict` for each tip.
"""

import enum
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.many_tips import Record, Tips, follow
from afm_jax.motion.settle import LONGEST, ROUNDING, find_repetitions
from afm_jax.outcomes import Outcome
from afm_jax.solve.lanes import WIDTHS, Report, in_blocks


class MotionKind(enum.IntEnum):
    """What a motion has come to."""

    ORBIT = 0
    """It repeats: m impacts in N drive periods."""
    IRREGULAR = 1
    """It goes on and repeats nothing."""
    STUCK = 2
    """The platform holds the tip for good."""
    FREE = 3
    """The tip no longer meets the platform."""
    UNRESOLVED = 4
    """It could not be followed (`WHY_UNRESOLVED`)."""


WHY_UNRESOLVED = (
    "so close to capture that a law's delay puts the tip inside the platform, or further than a search for the next "
    "impact goes"
)


class Verdicts(NamedTuple):
    """What motions have come to, arrays of one lane a motion."""

    kind: Int[np.ndarray, " lanes"]
    """A `MotionKind`."""
    impacts: Int[np.ndarray, " lanes"]
    """m of an orbit, else 0."""
    periods: Int[np.ndarray, " lanes"]
    """N of an orbit, else 0."""
    remaining: Float[np.ndarray, " lanes"]
    """Estimated distance from the orbit, of the velocity scale or in rad; infinite without one."""

    def names(self) -> list[str]:
        """Return a word for each: "(2,3)", "irregular", "stuck", "free", "unresolved"."""
        words = [kind.name.lower() for kind in MotionKind]
        rows = zip(self.kind.tolist(), self.impacts.tolist(), self.periods.tolist(), strict=True)
        return [f"({m},{n})" if kind == MotionKind.ORBIT else words[kind] for kind, m, n in rows]


REPEATED = 2
"""Repetitions in each of the two blocks that are compared to tell an orbit."""
RECORDED = (2 * REPEATED + 1) * LONGEST
"""Impacts that are recorded to tell orbits of up to `LONGEST` impacts."""


def kinds_of(outcome: Int[np.ndarray, " lanes"]) -> Int[np.ndarray, " lanes"]:
    """Return the kinds of motions that ended with an `Outcome` each; irregular while they go on."""
    kinds = np.full(max(Outcome) + 1, MotionKind.UNRESOLVED)
    kinds[Outcome.IMPACT], kinds[Outcome.CAPTURED] = MotionKind.IRREGULAR, MotionKind.STUCK
    kinds[Outcome.NO_FURTHER_IMPACT] = MotionKind.FREE
    return kinds[outcome]


class Motions(NamedTuple):
    """What tips have come to, arrays of one lane a tip."""

    end: Tips
    record: Record
    """Of the last impacts."""
    verdicts: Verdicts


def motions_of(
    scenes: Scene,
    tips: Tips,
    impacts: int,
    *,
    widths: Sequence[int] = WIDTHS,
    report: Report | None = None,
) -> Motions:
    """Return what tips come to after some impacts.

    Args:
        scenes: of the tips, a batch.
        tips: at the beginning of a flight each.
        impacts: how many, those recorded included.
        widths: numbers of lanes that are followed together, as of `in_blocks`.
        report: called with how many of how many tips are done.
    """

    def work(lanes: tuple[Scene, Tips]) -> tuple[Tips, Record]:
        return follow(*lanes, skip=impacts - RECORDED, record=RECORDED, accuracy=1e-6)

    end, record = in_blocks(work, (scenes, tips), widths=widths, report=report)
    tolerance = 1e-4 if isinstance(scenes.interaction, Contact) else 1e-6
    period = np.asarray(jax.tree.map(jnp.asarray, scenes.platform).period_us)
    return Motions(end, record, verdicts_of(record, end.outcome, period, tolerance=tolerance))


def verdicts_of(
    record: Record, outcome: Int[np.ndarray, " lanes"], period_us: Float[np.ndarray, " lanes"], *, tolerance: float
) -> Verdicts:
    """Return what motions have come to.

    A tip that rests on the platform and is let go forgets what was before: two releases at one phase are an orbit.

    Args:
        record: their last impacts.
        outcome: of each, an `Outcome` as an integer.
        period_us: of the drive.
        tolerance: of the remaining distance from an orbit (`find_repetitions`).
    """
    kind = kinds_of(outcome)
    turns = record.turns(period_us)
    # resolved contacts, for which the tolerance is wide, repeat to no more than their accuracy
    rounding = max(ROUNDING, 1e-2 * tolerance)
    velocities = record.velocity_after_nm_per_us
    impacts, periods, remaining = find_repetitions(
        turns, velocities, tolerance=tolerance, repeated=REPEATED, rounding=rounding
    )
    for lane in np.flatnonzero((impacts == 0) & (kind == MotionKind.IRREGULAR) & (record.rested.sum(axis=1) > 1)):
        before, last = np.flatnonzero(record.rested[lane])[-2:]
        apart = turns[lane, last] - turns[lane, before]
        if round(apart) >= 1 and 2.0 * np.pi * abs(apart - round(apart)) < tolerance:
            impacts[lane], periods[lane], remaining[lane] = last - before, round(apart), 0.0
    orbit = (kind == MotionKind.IRREGULAR) & (impacts > 0)
    return Verdicts(
        np.where(orbit, MotionKind.ORBIT, kind),
        np.where(orbit, impacts, 0),
        np.where(orbit, periods, 0),
        np.where(orbit, remaining, np.inf),
    )
