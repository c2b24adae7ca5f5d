"""Basins of attraction: the motion on which each start ends.

Takes a scene and a grid of starts (phase in rad, rebound speed in nm/us); gives the number of the attractor of each,
and the attractors (map: eqs. 2 to 6).

A sample of starts is followed for long; the motions that it reaches are the attractors. Then every start is followed
until it is at a point of an orbit, is held, or flies away, and drops out; the rest is followed further and sorted like
the sample. Distances are in drive phase (rad) and velocity over beta omega.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.checks import checked
from afm_jax.columns import CsvColumns, csv_columns
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.many_tips import Tips, recorded
from afm_jax.dynamics.starts import evenly_spread, sample_driven, tips_at
from afm_jax.dynamics.verdicts import WHY_UNRESOLVED, MotionKind, kinds_of, motions_of
from afm_jax.motion.start import rebound_of_leaving
from afm_jax.report import Section, sections
from afm_jax.results import ResultTuple, public_result
from afm_jax.saved import as_json
from afm_jax.solve.lanes import WIDTHS, Report, in_blocks
from afm_jax.units import within_turn

_LONG = 1000
"""Impacts after which the motions of a sample are distinguished."""


class Attractor(NamedTuple):
    """What starts come to.

    ``phase_rad``, in [0, 2 pi), and ``velocity_nm_per_us``: of an orbit, just after each of its impacts; else empty.
    ``approach_speed_nm_per_us``: of its impacts, or of the last ones that were seen of an irregular motion.
    ``rebound_speed_nm_per_us``: of an orbit's impacts, off the platform.
    """

    name: str
    kind: int
    """A `MotionKind`."""
    impacts: int
    periods: int
    phase_rad: Float[np.ndarray, " impacts"]
    velocity_nm_per_us: Float[np.ndarray, " impacts"]
    approach_speed_nm_per_us: Float[np.ndarray, " seen"]
    rebound_speed_nm_per_us: Float[np.ndarray, " impacts"] = np.zeros(0)


@public_result(picture="afm_jax.plots.dynamics:basins_figure")
class Basins(ResultTuple):
    """The motions (attractors) on which the starts of a grid of drive phases and rebound speeds end.

    Attributes:
        phase_rad: drive phase of the columns' starts.
        rebound_speed_nm_per_us: speed off the platform of the rows' starts; of a scene with a contact at the gap where
            that ends.
        attractors: the motions, by falling share of the starts.
        attractor: the number of each start's attractor, (rows, columns).
        share: fraction of the starts that ends on each attractor.
        share_error: standard errors of the shares, as of random starts.
        share_interval95: of each attractor the interval that holds 95 % of its shares for drawn laws; None: none drawn.
    """

    phase_rad: Float[np.ndarray, " columns"]
    rebound_speed_nm_per_us: Float[np.ndarray, " rows"]
    attractors: list[Attractor]
    attractor: Int[np.ndarray, "rows columns"]
    share: Float[np.ndarray, " attractors"]
    share_error: Float[np.ndarray, " attractors"]
    share_interval95: Float[np.ndarray, "attractors 2"] | None = None

    @property
    def reason(self) -> str | None:
        """Why the shares are not valid: some starts could not be followed; None where all were."""
        lost = np.array([attractor.kind == MotionKind.UNRESOLVED for attractor in self.attractors])
        unresolved = 100.0 * self.share[lost].sum()
        why = f"{unresolved:.3g} % of the starts could not be followed: they come {WHY_UNRESOLVED}"
        return why if unresolved else None

    @property
    def impact_speeds_nm_per_us(self) -> Float[np.ndarray, " impacts"]:
        """Approach speeds of the attractors' impacts."""
        return np.concatenate([attractor.approach_speed_nm_per_us for attractor in self.attractors])


@as_json.register
def _(result: Basins) -> dict[str, Any]:
    attractors = [
        {
            "name": attractor.name,
            "impacts": attractor.impacts,
            "periods": attractor.periods,
            "share": share,
            "share_error": error,
            "phase_rad": attractor.phase_rad,
            "velocity_after_nm_per_us": attractor.velocity_nm_per_us,
        }
        for attractor, share, error in zip(result.attractors, result.share, result.share_error, strict=True)
    ]
    if result.share_interval95 is not None:
        for attractor, ends in zip(attractors, result.share_interval95.tolist(), strict=True):
            attractor["share_interval95"] = ends
    return {"starts": result.attractor.size, "attractors": attractors}


@sections.register
def _(result: Basins) -> list[Section]:
    speeds = result.rebound_speed_nm_per_us
    box = f"{len(result.phase_rad)} drive phases of a period x {len(speeds)} rebound speeds"
    starts = f"Starts: {box} from {speeds[0]:.4g} to {speeds[-1]:.4g} nm/us (`speeds_nm_per_us=...` chooses others)"
    lines = []
    for number, attractor in enumerate(result.attractors):
        share, error = 100.0 * result.share[number], 100.0 * result.share_error[number]
        lines.append(f"{attractor.name}: {share:.4g} +- {error:.2g} % of the starts")
        if result.share_interval95 is not None:
            low, high = 100.0 * result.share_interval95[number]
            lines[-1] += f"; {low:.4g} to {high:.4g} % in 95 % of the draws"
    if any(attractor.kind == MotionKind.IRREGULAR for attractor in result.attractors):
        lines.append(
            f"irregular: nothing repeated within {_LONG} impacts; with a high quality factor the motion may still "
            "be settling (`afm-jax lyapunov --transient` follows one start for longer)"
        )
    return [Section("", [starts, *lines])]


@csv_columns.register
def _(result: Basins) -> CsvColumns:
    # a row a start
    names = np.array([attractor.name for attractor in result.attractors])
    phase, speed = np.meshgrid(result.phase_rad, result.rebound_speed_nm_per_us)
    columns = {"phase_rad": phase, "rebound_speed_nm_per_us": speed, "attractor": names[result.attractor]}
    return {"basins.csv": {name: column.ravel() for name, column in columns.items()}}


@checked
def basins_of_attraction(
    scene: Scene,
    *,
    columns: int = 300,
    rows: int = 300,
    speeds_nm_per_us: tuple[float, float] | None = None,
    report: Report | None = None,
) -> Basins:
    """Return the motion on which each start of a grid of drive phases and rebound speeds ends.

    Args:
        scene: one scene with a law or a contact, driven with one frequency.
        columns: phases, over the whole drive period.
        rows: rebound speeds.
        speeds_nm_per_us: their range; None: from 0 to four times the platform's top speed, or the capture speed.
        report: called with how many of how many starts have arrived.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the scene was built.
        ValueError: if the scene does not repeat with one drive period, or there is no such grid.
    """
    seen = sample_driven(scene)
    scene, ahead = seen.scenes, float(seen.frame.phase_rad)
    if scene.platform.frequency_khz.ndim or columns < 2 or rows < 2:
        raise ValueError("basins are those of one scene, on a grid of 2 x 2 starts or more")
    if speeds_nm_per_us is None:
        speeds_nm_per_us = 0.0, 4.0 * float(rebound_of_leaving(scene))
    low, high = speeds_nm_per_us
    if not 0.0 <= low < high:
        raise ValueError(f"`speeds_nm_per_us` must rise from 0 or more, but is {speeds_nm_per_us}")
    phase = 2.0 * np.pi * (np.arange(columns) + 0.5) / columns
    speed = low + (high - low) * (np.arange(rows) + 0.5) / rows
    finder = _Finder(scene)
    grid = np.meshgrid((phase - ahead) % (2.0 * np.pi), speed)
    starts = finder.tips(*(part.ravel() for part in grid))
    if isinstance(scene.interaction, Contact):
        label = finder.told_apart(starts, report)
    else:
        # a sample, whose motions are told apart
        across, up = evenly_spread(512).T
        finder.told_apart(finder.tips(2.0 * np.pi * across, low + (high - low) * up))
        label = finder.arrived(starts, report)
    count = np.bincount(label, minlength=len(finder.attractors))
    rank = np.argsort(-count, kind="stable")
    label, order = np.argsort(rank)[label].reshape(rows, columns), rank[count[rank] > 0]
    share = count[order] / label.size

    def in_lab(attractor: Attractor) -> Attractor:
        time, velocity = attractor.phase_rad / finder.omega, attractor.velocity_nm_per_us
        return attractor._replace(
            phase_rad=within_turn(attractor.phase_rad + ahead, 2.0 * np.pi),
            velocity_nm_per_us=velocity + np.asarray(seen.response(time)[1]),
            rebound_speed_nm_per_us=velocity - np.asarray(_velocity(scene.platform, time)),
        )

    return Basins(
        phase_rad=phase,
        rebound_speed_nm_per_us=speed,
        attractors=_with_names([in_lab(finder.attractors[number]) for number in order]),
        attractor=label,
        share=share,
        share_error=np.sqrt(share * (1.0 - share) / label.size),
    )


_velocity = jax.jit(Platform.velocity)
"""Compiled: all of a formula in one program."""


class _Finder:
    """The attractors of one scene that are known so far, and how starts are matched with them.

    Points are drive phases in rad and velocities in nm/us just after an impact.
    """

    def __init__(self, scene: Scene):
        self.scene = scene
        self.attractors: list[Attractor] = []
        self.omega, self.top = float(scene.platform.angular_frequency), float(scene.platform.top_speed_nm_per_us)

    def scenes(self, count: int) -> Scene:
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), self.scene)

    def tips(self, phase: np.ndarray, speed: np.ndarray) -> Tips:
        """Return tips that leave at drive phases with rebound speeds."""
        scenes, time = self.scenes(len(phase)), phase / self.omega
        tips = tips_at(scenes, time, np.asarray(_velocity(self.scene.platform, time)) + speed)
        return jax.tree.map(np.asarray, tips)

    def _is_at(
        self, orbit: Attractor, phase: Float[np.ndarray, " points"], velocity: Float[np.ndarray, " points"]
    ) -> Bool[np.ndarray, " points"]:
        """Say which points are those of an orbit."""
        turn = (phase[:, None] - orbit.phase_rad + np.pi) % (2.0 * np.pi) - np.pi
        apart = np.hypot(turn, (velocity[:, None] - orbit.velocity_nm_per_us) / self.top).min(axis=1, initial=np.inf)
        # distance, of the velocity if that is larger, below which points are those of one orbit
        return apart < 1e-3 * np.maximum(1.0, np.abs(velocity) / self.top)

    def told_apart(self, tips: Tips, report: Report | None = None) -> Int[np.ndarray, " lanes"]:
        """Return the attractors of motions after a long time; new ones are added to those known."""
        count = len(tips.time_us)
        _, record, verdicts = motions_of(self.scenes(count), tips, _LONG, report=report)
        names, label = verdicts.names(), np.empty(count, int)
        for lane, m in enumerate(verdicts.impacts.tolist()):
            kind = int(verdicts.kind[lane]), m, int(verdicts.periods[lane])
            # of an orbit its points, each once
            last = slice(-m, None) if m else slice(0)
            phase = within_turn(self.omega * record.departure_us[lane, last], 2.0 * np.pi)
            velocity = record.velocity_after_nm_per_us[lane, last]
            approach = record.approach_nm_per_us[lane, -m:]
            motion = Attractor(names[lane], *kind, phase, velocity, approach[np.isfinite(approach)])
            label[lane] = self.number_of(motion)
        return label

    def number_of(self, motion: Attractor) -> int:
        """Return the number of the attractor that a motion has come to; one that is not known so far is added."""
        for number, attractor in enumerate(self.attractors):
            # the name says kind, m and N
            if attractor.name == motion.name and (
                not motion.impacts or self._is_at(attractor, motion.phase_rad[-1:], motion.velocity_nm_per_us[-1:])[0]
            ):
                return number
        self.attractors.append(motion)
        return len(self.attractors) - 1

    def pointless(self, kind: int) -> int:
        """Return the number of the attractor of a kind that has no points."""
        return self.number_of(Attractor(MotionKind(kind).name.lower(), kind, 0, 0, *[np.zeros(0)] * 3))

    def arrived(self, tips: Tips, report: Report | None) -> Int[np.ndarray, " lanes"]:
        """Return the attractor of every start, as soon as it has arrived."""
        count = len(tips.time_us)
        label, remaining = np.full(count, -1), np.arange(count)
        scenes = {width: self.scenes(width) for width in WIDTHS}
        # after so many impacts starts that have arrived drop out
        for impacts in (8, 8, 8, 8, 16, 16, 32, 64, 128, 256, 512):

            def work(some: Tips, impacts: int = impacts) -> Tips:
                return recorded(scenes[len(some.time_us)], some, impacts - 1, impacts=1)[0]

            tips = in_blocks(work, tips)
            arrival, kinds = np.full(remaining.size, -1), kinds_of(tips.outcome)
            for number, orbit in enumerate(self.attractors):
                arrival[self._is_at(orbit, self.omega * tips.time_us, tips.velocity_nm_per_us)] = number
            for kind in np.unique(kinds[kinds != MotionKind.IRREGULAR]).tolist():
                arrival[kinds == kind] = self.pointless(kind)
            label[remaining] = arrival
            going = arrival < 0
            remaining, tips = remaining[going], jax.tree.map(lambda part, going=going: part[going], tips)
            if report is not None:
                report(count - remaining.size, count)
            if not remaining.size:
                return label
        # more starts are not distinguished one by one in the end
        if remaining.size <= 20_000:
            label[remaining] = self.told_apart(tips)
        else:
            label[remaining] = self.pointless(int(MotionKind.IRREGULAR))
        return label


def _with_names(attractors: list[Attractor]) -> list[Attractor]:
    """Return attractors with distinct names: "(1,5) a" and "(1,5) b"."""
    names = [attractor.name for attractor in attractors]
    letters = {name: iter("abcdefghijklmnopqrstuvwxyz") for name in names if names.count(name) > 1}
    told_apart = [f"{name} {next(letters[name], '+')}" if name in letters else name for name in names]
    return [attractor._replace(name=name) for attractor, name in zip(attractors, told_apart, strict=True)]
