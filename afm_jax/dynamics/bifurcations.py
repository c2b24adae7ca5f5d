"""Bifurcation diagrams: the motions on which a tip settles while a parameter is ramped up, and down.

Takes a scene and values of a parameter in its unit; gives phases in rad, speeds in nm/us and m, N at each value (map:
eqs. 2 to 6).

A ramp carries the drive phase and the rebound speed of the tip from value to value, so that hysteresis shows; it is a
long sequence. Many lanes compute it at once, each a stretch of neighbouring values that it ramps from its own start.
Every lane goes on into the stretches behind it, as long as its motion differs from the one that is there already. Where
the motion is regular, the result is that of one tip ramped along all values. A tip that the platform holds, or that
flies away, begins anew at the next value, at the given start or where there is motion (`bouncing_tips`).
"""

from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.checks import checked
from afm_jax.columns import CsvColumns, csv_columns
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.many_tips import Tips
from afm_jax.dynamics.starts import batch_and_tips, sample_driven
from afm_jax.dynamics.verdicts import RECORDED, MotionKind, Motions, Verdicts, motions_of
from afm_jax.motion.start import gap_of_departure, start_of
from afm_jax.outcomes import Outcome
from afm_jax.report import Section, sections
from afm_jax.results import ResultTuple, public_result
from afm_jax.saved import as_json
from afm_jax.scenefile.parameter_paths import parse_range, scene_batch
from afm_jax.solve.lanes import LANES, WIDTHS, Report
from afm_jax.units import within_turn


@public_result(picture="afm_jax.plots.dynamics:bifurcation_figure")
class BifurcationDiagram(ResultTuple):
    """What motions come to along a parameter that is ramped one way, arrays of one row a value, by rising value.

    Attributes:
        values: of the parameter, ascending.
        upward: whether the parameter rises from value to value.
        verdicts: what the motion has come to at each value.
        phase_rad: drive phase, in [0, 2 pi), at the end of each of the last impacts, (values, impacts); NaN where there
            was none. Of an orbit of m impacts the last m.
        approach_nm_per_us: approach speeds of these impacts.
        velocity_after_nm_per_us: velocities of the tip in the lab after these impacts.
        height_nm: heights of the platform when the tip arrives.
        verdict_probability: at each value the fraction of drawn laws with this verdict; None: no laws were drawn.
    """

    values: Float[np.ndarray, " values"]
    upward: bool
    verdicts: Verdicts
    phase_rad: Float[np.ndarray, "values impacts"]
    approach_nm_per_us: Float[np.ndarray, "values impacts"]
    velocity_after_nm_per_us: Float[np.ndarray, "values impacts"]
    height_nm: Float[np.ndarray, "values impacts"]
    verdict_probability: Float[np.ndarray, " values"] | None = None

    @property
    def direction(self) -> str:
        """Whether the parameter rises or falls, in a word."""
        return "up" if self.upward else "down"


@as_json.register
def _(ramp: BifurcationDiagram) -> dict[str, Any]:
    return _probability(ramp) | {
        "direction": ramp.direction,
        "values": ramp.values,
        "verdicts": ramp.verdicts.names(),
        "impacts": ramp.verdicts.impacts,
        "periods": ramp.verdicts.periods,
        "phase_rad": [row[np.isfinite(row)] for row in ramp.phase_rad],
        "platform_height_nm": [row[np.isfinite(row)] for row in ramp.height_nm],
    }


def _probability(ramp: BifurcationDiagram) -> dict[str, np.ndarray]:
    probability = ramp.verdict_probability
    return {} if probability is None else {"verdict_probability": probability}


@sections.register
def _(ramp: BifurcationDiagram) -> list[Section]:
    # the commonest kinds of motion
    counts = Counter(ramp.verdicts.names()).most_common()
    words = [f"{name} at {count}" for name, count in counts[:6]]
    others = sum(count for _, count in counts[6:])
    words += [f"others at {others}"] if others else []
    return [Section("", [f"ramped {ramp.direction}: {', '.join(words)}"])]


@csv_columns.register
def _(ramp: BifurcationDiagram, parameter: str = "value") -> CsvColumns:
    # a row a value, and an impact
    verdicts = {"verdict": np.array(ramp.verdicts.names())}
    impacts = {
        "phase_rad": ramp.phase_rad,
        "approach_speed_nm_per_us": ramp.approach_nm_per_us,
        "velocity_after_nm_per_us": ramp.velocity_after_nm_per_us,
        "platform_height_nm": ramp.height_nm,
    }
    files = {
        "bifurcation.csv": (verdicts | _probability(ramp), np.ones(len(ramp.values), bool)),
        "impacts.csv": (impacts, np.isfinite(ramp.phase_rad)),
    }
    return {
        file: {
            "direction": np.full(there.sum(), ramp.direction),
            parameter: np.repeat(ramp.values, there.reshape(len(ramp.values), -1).sum(axis=1)),
            **{name: array[there] for name, array in arrays.items()},
        }
        for file, (arrays, there) in files.items()
    }


@public_result(picture="afm_jax.plots.dynamics:bifurcation_figure")
class Ramps(ResultTuple):
    """What `afm-jax bifurcation` tells: a parameter, by its path, that is ramped up, down or both ways."""

    parameter: str
    sweeps: list[BifurcationDiagram]
    impacts_each: int
    """Impacts at each value."""

    @property
    def reason(self) -> str | None:
        """Why the diagram is empty; None where a motion goes on somewhere."""
        if any(np.isfinite(sweep.phase_rad).any() for sweep in self.sweeps):
            return None
        return (
            "no motion went on at any value: the tip sticks or flies away; try a larger drive amplitude, or a [start]"
        )

    @property
    def impact_speeds_nm_per_us(self) -> Float[np.ndarray, " impacts"]:
        """Approach speeds of all impacts that were recorded."""
        return np.concatenate([sweep.approach_nm_per_us.ravel() for sweep in self.sweeps])


@as_json.register
def _(ramps: Ramps) -> dict[str, Any]:
    return ramps._asdict() | {"sweeps": [as_json(sweep) for sweep in ramps.sweeps]}


@sections.register
def _(ramps: Ramps) -> list[Section]:
    parts = [part for ramp in ramps.sweeps for part in sections(ramp)[0].parts]
    if any((sweep.verdicts.kind == MotionKind.IRREGULAR).any() for sweep in ramps.sweeps):
        parts.append(
            f"irregular: nothing repeated within the {ramps.impacts_each} impacts at a value; with a high quality "
            "factor the motion may still be settling (`impacts=...` gives it more)"
        )
    return [Section("", parts)]


@csv_columns.register
def _(ramps: Ramps) -> CsvColumns:
    # the directions one below the other
    each = [csv_columns(sweep, ramps.parameter) for sweep in ramps.sweeps]
    return {
        file: {name: np.concatenate([tables[file][name] for tables in each]) for name in columns}
        for file, columns in each[0].items()
    }


@checked
def bifurcation_diagram(
    scene: Scene,
    parameter: str,
    values: Float[np.ndarray, " values"] | None = None,
    *,
    start: tuple[float, float, float] | None = None,
    upward: bool = True,
    impacts: int = 2000,
    report: Report | None = None,
) -> BifurcationDiagram:
    """Return the last impacts of the motion at each value of a parameter, which is ramped up or down.

    Args:
        scene: a scene with a law or a contact, driven with one frequency.
        parameter: "platform.offset_nm=-2:2:400", its range and how many values, as in the command; or its path alone.
        values: of a path, ascending.
        start: where the tip begins, and anew where its motion has ended: as of `start_of`; None: on the stable
            single-impact orbit of the order nearest to resonance, else leaving the platform upward.
        upward: from the lowest value to the highest, or the other way round.
        impacts: at each value; the last of them are recorded.
        report: called with how many of how many values are done, in the first ramp.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        ValueError: if the scene lacks the parameter or does not repeat with one drive period, or values do not rise.
    """
    if values is None:
        parameter, values = (swept := parse_range(parameter, counted=True)).path, swept.values
    ordered = np.asarray(values, float)
    if ordered.ndim != 1 or len(ordered) < 1 or np.any(np.diff(ordered) <= 0.0):
        raise ValueError("`values` must be rising numbers, one at least")
    scenes = scene_batch(scene, {parameter: ordered if upward else ordered[::-1]})
    seen = sample_driven(scenes)
    if impacts < RECORDED:
        raise ValueError(f"`impacts` must be {RECORDED} or more, to tell orbits, but is {impacts}")
    begin = None if start is None else seen.start(start_of(scenes, start))
    fresh = jax.tree.map(np.asarray, batch_and_tips(seen.scenes, begin)[1])
    ramped = _ramped(jax.tree.map(np.asarray, seen.scenes), fresh, impacts, report)
    seen, platform, ramped = _rows_of((seen, scenes.platform, ramped), slice(None, None, 1 if upward else -1))
    record, verdicts = ramped.record, ramped.verdicts
    shown = _shown(verdicts)

    def known(part: Any) -> np.ndarray:
        return np.where(shown, part, np.nan)

    # in the lab the platform is another one than the frame's
    amplitude = np.asarray(platform.amplitude_nm)[:, None]
    offset = np.asarray(platform.offset_nm)[:, None]
    ahead = np.asarray(seen.frame.phase_rad)[:, None]
    omega = np.asarray(seen.scenes.platform.angular_frequency)[:, None]
    return BifurcationDiagram(
        values=ordered,
        upward=upward,
        verdicts=verdicts,
        phase_rad=known(within_turn(omega * record.departure_us + ahead, 2.0 * np.pi)),
        approach_nm_per_us=known(record.approach_nm_per_us),
        velocity_after_nm_per_us=known(record.velocity_after_nm_per_us + seen.response(record.departure_us)[1]),
        height_nm=known(offset + amplitude * np.cos(omega * record.arrival_us + ahead)),
    )


def _shown(verdicts: Verdicts) -> Bool[np.ndarray, "values impacts"]:
    """Return which of the recorded impacts are shown: of an orbit the last ones, each point once, else all."""
    return (verdicts.impacts[:, None] == 0) | (np.arange(RECORDED, 0, -1) <= verdicts.impacts[:, None])


def _ramped(scenes: Scene, fresh: Tips, impacts: int, report: Report | None) -> Motions:
    """Return what tips come to at all values.

    Args:
        scenes: at the values, in the order of the ramp.
        fresh: tips that begin there.
        impacts: at each value.
        report: called with how many of how many values are done.
    """
    count = len(fresh.time_us)
    # stretches at most that are ramped side by side: one block of tips
    numbers = starts = np.arange(0, count, -(-count // LANES))
    # few tips with laws, so that a lane that goes on alone does not wait for many
    widths = WIDTHS if isinstance(scenes.interaction, Contact) else (16,)
    step, ramped, begin = 0, None, _rows_of(fresh, starts)
    while True:
        rows = motions_of(_rows_of(scenes, numbers), begin, impacts, widths=widths)
        if ramped is None:
            # no motion is of the kind -1
            ramped = jax.tree.map(lambda part: np.full((count, *part.shape[1:]), -1, part.dtype), rows)
        new = ~_same(rows, _rows_of(ramped, numbers))
        for part, values in zip(jax.tree.leaves(ramped), jax.tree.leaves(rows), strict=True):
            part[numbers[new]] = values[new]
        numbers, step = numbers[new & (numbers + 1 < count)] + 1, step + 1
        if not numbers.size:
            return ramped
        if report is not None:
            report(min(step * len(starts), count), count)
        before, end = _rows_of((scenes, ramped.end), numbers - 1)
        begin = carried(before, *_rows_of((scenes, fresh), numbers), end)


@jax.jit
def carried(before: Scene, after: Scene, fresh: Tips, tips: Tips) -> Tips:
    """Return tips in other scenes at the same drive phase with the same rebound speed; ended ones begin anew.

    Args:
        before: the scenes they are in, a batch.
        after: the scenes they come to.
        fresh: tips that begin there.
        tips: the tips.
    """
    time = tips.time_us * (after.platform.period_us / before.platform.period_us)
    rebound = tips.velocity_nm_per_us - before.platform.velocity(tips.time_us)
    tips_there = tips._replace(
        time_us=time,
        periods=jnp.zeros_like(time),
        velocity_nm_per_us=after.platform.velocity(time) + rebound,
        gap_nm=gap_of_departure(after) if isinstance(after.interaction, Contact) else tips.gap_nm,
    )
    going = tips.outcome == Outcome.IMPACT
    return jax.tree.map(lambda old, new: jnp.where(going, old, new), tips_there, fresh)


def _rows_of(tree: Any, rows: Any) -> Any:
    return jax.tree.map(lambda part: part[rows], tree)


def _same(one: Motions, other: Motions) -> Bool[np.ndarray, " lanes"]:
    """Say which motions are the same: of one kind, and orbits through the same points."""
    a, b = one.verdicts, other.verdicts
    same = (a.kind == b.kind) & (a.impacts == b.impacts) & (a.periods == b.periods)
    speeds, others = (
        np.sort(np.where(_shown(each.verdicts), each.record.approach_nm_per_us, 0.0), axis=1) for each in (one, other)
    )
    # of the largest speed
    near = np.abs(speeds - others).max(axis=1) <= 1e-4 * np.maximum(others[:, -1], 1e-12)
    return same & (near | (a.kind != MotionKind.ORBIT))
