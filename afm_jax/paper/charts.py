"""The data of the paper's figures 2, 3 and 9, with what the paper says of them checked on the data.

The verdicts on single-impact orbits, which come from eq. 9 and the linearised map, are compared with long iterations of
the impact map, which know neither: a stable orbit must draw a disturbed tip back, an unstable one must let it go, and
where there is no stable orbit no start may settle on one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int

from afm_jax.apparatus.scene import Scene
from afm_jax.dynamics.charts import (
    AMPLITUDE_COLUMNS,
    TABLE_COLUMNS,
    OffsetAmplitudes,
    OrbitVerdicts,
    StabilityChart,
    batch_of_scenes,
    offset_amplitudes,
    share_above,
    stability_chart,
)
from afm_jax.impact.map import next_impact
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.outcomes import Outcome
from afm_jax.scenefile import presets
from afm_jax.units import RAD_PER_US_PER_KHZ

LOW_DRIVE_NM = 1.0
"""Drive amplitudes below |sigma|: where the tails are, and where adhesion takes orbits away."""


@dataclass(frozen=True)
class Statement:
    """A statement of the paper, whether the data bear it out, and the numbers that say so."""

    statement: str
    holds: bool
    numbers: dict[str, object]


@dataclass(frozen=True)
class PaperFigure:
    """One figure of the paper.

    Attributes:
        columns: the table, by column name; of equal lengths.
        numbers: key numbers of the figure.
        statements: what the paper says of it, checked.
    """

    columns: Mapping[str, Float[np.ndarray, " rows"]]
    numbers: dict[str, Any]
    statements: list[Statement]

    @property
    def valid(self) -> bool:
        """Whether every statement holds."""
        return all(statement.holds for statement in self.statements)

    def table(self) -> list[dict[str, float]]:
        """Return the rows of the table."""
        names = list(self.columns)
        return [dict(zip(names, row, strict=True)) for row in zip(*self.columns.values(), strict=True)]


def complete_orders(chart: StabilityChart) -> list[int]:
    """Return the orders whose tongue lies within the chart with half an order to spare."""
    return [n for n in range(1, chart.orders + 1) if n + 0.5 < chart.x_values[-1]]


def tongues_at_resonance(chart: StabilityChart) -> Statement:
    """Figures 2 and 3: at the highest drive amplitude the orders are stable around omega = 2 N Omega."""
    edges, inside = {}, []
    for order in complete_orders(chart):
        row = chart.x_values[chart.tongue(order)[-1]]
        edges[order] = [float(row.min()), float(row.max())] if len(row) else None
        inside.append(len(row) > 0 and row.min() < order < row.max() and row.max() - row.min() < 1.0)
    return Statement(
        "tongues of stable orbits lie around omega = 2 N Omega",
        bool(inside) and all(inside),
        {"drive_amplitude_nm": float(chart.y_values[-1]), "reduced_frequency_of_order": edges},
    )


def tail_shift(chart: StabilityChart, order: int) -> float:
    """Return how far in n a tongue's middle at its low-drive end lies from its middle at the highest drive amplitude.

    The low-drive end: the lowest tenth (in rows) of the tongue, islands of longer flights left out.
    """
    rows, columns = np.nonzero(chart.tongue(order))
    if not len(rows):
        return float("nan")
    frequency = chart.x_values[columns]
    low = rows <= rows.min() + 0.1 * (rows.max() - rows.min())
    return float(frequency[low].mean() - frequency[rows == rows.max()].mean())


def tails_lean(negative: StabilityChart, positive: StabilityChart) -> Statement:
    """Figure 2: the tails lean to lower frequency for a negative offset, to higher frequency for a positive one."""
    down = {order: tail_shift(negative, order) for order in complete_orders(negative)}
    up = {order: tail_shift(positive, order) for order in complete_orders(positive)[:-1]}
    return Statement(
        "tails lean to lower frequency for negative offset, to higher for positive offset",
        bool(down) and bool(up) and all(shift < 0 for shift in down.values()) and all(s > 0 for s in up.values()),
        {"shift_at_negative_offset": down, "shift_at_positive_offset": up},
    )


def adhesion_limit_nm(reduced_frequency: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the drive amplitude below which adhesion leaves no orbit: beta omega = sqrt((1 - r^2) epsilon)/2r.

    On an undamped (1, N) orbit V = -V', so that v_p = (u_in - u_out)/2, and eq. 6 lets this be no smaller.
    """
    r = presets.STABILITY_R
    top_speed = np.sqrt((1.0 - r**2) * presets.ADHESION) / (2.0 * r)
    return top_speed / (RAD_PER_US_PER_KHZ * 2.0 * presets.FREE_FREQUENCY_KHZ * reduced_frequency)


def low_orders_vanish(without: StabilityChart, adhesive: StabilityChart) -> Statement:
    """Figure 3: adhesion takes away the low orders at low drive, and little else; the charts share their grid."""
    low = without.y_values[:, None] < LOW_DRIVE_NM
    orders = complete_orders(without)
    lost, onset = {}, {}
    for order in orders:
        before, after = without.tongue(order), adhesive.tongue(order)
        lost[order] = float((before & ~after & low).sum() / max(1, (before & low).sum()))
        rows = np.nonzero(after.any(axis=1))[0]
        onset[order] = float(without.y_values[rows[0]]) if len(rows) else None
    shares = [lost[order] for order in orders]
    high = without.any_stable & (without.y_values[:, None] > 2.0 * LOW_DRIVE_NM)
    kept = float((high & adhesive.any_stable).sum() / max(1, high.sum()))
    forbidden = without.y_values[:, None] < adhesion_limit_nm(without.x_values)
    below = int((adhesive.any_stable & forbidden).sum())
    holds = bool(shares) and shares[0] > 0.9 and all(np.diff(shares) < 0) and below == 0 and kept > 0.9
    numbers = {
        "low_drive_below_nm": LOW_DRIVE_NM,
        "lost_share_at_low_drive_of_order": lost,
        "lowest_drive_amplitude_nm_of_order": onset,
        "kept_share_at_twice_low_drive": kept,
        "stable_points_below_limit": below,
    }
    return Statement("adhesion takes away the low orders at low drive, and little else", holds, numbers)


def amplitude_slope(amplitudes: OffsetAmplitudes, panel: int, *, falls: bool) -> Statement:
    """Figure 9: the amplitude falls (or rises) with the offset at offset 0, for every r with an orbit there."""
    rescaled, zero = amplitudes.rescaled_amplitude[panel], amplitudes.zero
    step = amplitudes.offset_nm[zero + 1] - amplitudes.offset_nm[zero - 1]
    slopes = (rescaled[:, zero + 1] - rescaled[:, zero - 1]) / step
    known = np.isfinite(slopes)
    steps = np.diff(rescaled, axis=1)
    steps = steps[np.isfinite(steps)]
    sign = -1.0 if falls else 1.0
    numbers = {
        "reduced_frequency": amplitudes.reduced_frequency[panel],
        "r_range": [float(amplitudes.r[known].min()), float(amplitudes.r[known].max())] if known.any() else None,
        "relative_slope_per_nm_range": [float(np.nanmin(slopes)), float(np.nanmax(slopes))] if known.any() else None,
        "share_of_all_steps_in_this_direction": float((sign * steps > 0.0).mean()) if len(steps) else None,
    }
    verb = "falls" if falls else "rises"
    holds = bool(known.any()) and bool(np.all(sign * slopes[known] > 0.0))
    text = f"the amplitude {verb} with the offset at n = {amplitudes.reduced_frequency[panel]:g}"
    return Statement(text, holds, numbers)


STABILITY_MARGIN = 0.01
"""Orbits with | |T| - |1 + D| | below this are left out: they come back, or leave, too slowly."""
CLEARANCE_NM = 1e-3
"""Orbits that pass the platform closer than this on their way are left out: the disturbed tip might touch it."""
DISTURBANCE = 1e-6
"""Relative change of the velocity, and change of the phase in rad, with which an iteration starts."""
_CHATTER = 1e-6
"""Approach speed in units of beta omega below which a tip counts as at rest on the platform."""
_MAX_STEPS = 500
_SAMPLES = 512
_LAST = 32
_STARTS = 4


@dataclass(frozen=True)
class SpotChecks:
    """How many random points agreed; counts by verdict ("stable", "unstable", "none").

    ``excluded``: too close to a boundary for an iteration to tell. ``failures``: index of scene and what was wrong.
    """

    checked: dict[str, int]
    excluded: dict[str, int]
    failures: list[dict[str, object]]

    @property
    def excluded_share(self) -> float:
        """Share of the drawn points that were too close to a boundary."""
        excluded = sum(self.excluded.values())
        return excluded / max(1, excluded + sum(self.checked.values()))


def spot_check(
    scenes_at: Callable[[Int[np.ndarray, " points"]], Scene],
    verdicts: OrbitVerdicts,
    *,
    seed: int,
    points: int,
    impacts: int = 3000,
) -> SpotChecks:
    """Check verdicts at random points by iterating the map.

    Args:
        scenes_at: the scenes with these numbers, as a batch.
        verdicts: the verdicts on all scenes, orders from 1 on.
        seed: of the random choice.
        points: how many points of each verdict are drawn (fewer if there are fewer).
        impacts: how long an iteration is.
    """
    generator = np.random.default_rng(seed)
    stable, admissible = verdicts.any_stable(), verdicts.any_admissible()
    checked, excluded, failures = {}, {}, []
    for verdict, where, orbits in (
        ("stable", stable, verdicts.stable),
        ("unstable", admissible & ~stable, verdicts.admissible),
    ):
        chosen = _draw(generator, where, points)
        clear, agrees = _orbit_checks(scenes_at, chosen, orbits, wanted=verdict == "stable", impacts=impacts)
        checked[verdict], excluded[verdict] = int(clear.sum()), int((~clear).sum())
        problem = "a disturbed orbit does not come back" if verdict == "stable" else "a disturbed orbit does not leave"
        failures += [{"scene": int(scene), "problem": problem} for scene in chosen[clear & ~agrees]]
    chosen = _draw(generator, ~stable, points)
    settled = _settled_order(scenes_at, chosen, generator, impacts=impacts)
    # Orders above those that were looked for are not what the verdict is about.
    wrong = (settled >= 1) & (settled <= len(verdicts.stable))
    checked["none"], excluded["none"] = len(chosen), 0
    for scene, order in zip(chosen[wrong], settled[wrong], strict=True):
        failures.append({"scene": int(scene), "problem": f"the motion settles on a (1,{int(order)}) orbit"})
    return SpotChecks(checked, excluded, failures)


def _draw(generator: np.random.Generator, where: np.ndarray, points: int) -> Int[np.ndarray, " points"]:
    numbers = np.flatnonzero(where)
    return generator.choice(numbers, size=min(points, len(numbers)), replace=False)


def _orbit_checks(scenes_at, chosen, orbits, *, wanted: bool, impacts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which points are clear of boundaries, and at which the disturbed tip does what the verdict says."""
    if not len(chosen):
        return np.zeros(0, bool), np.zeros(0, bool)
    scenes = scenes_at(chosen)
    orders = jnp.asarray(orbits[:, chosen].argmax(axis=0) + 1.0)
    phase, velocity, margin, clearance = _orbit_at(scenes, orders, jnp.asarray(wanted))
    last, furthest = _disturbed(scenes, phase, velocity, impacts)
    clear = np.asarray((jnp.abs(margin) > STABILITY_MARGIN) & (clearance > CLEARANCE_NM))
    # Back: a thousandth of the disturbance is left. Gone: thirty times as far away, or not flying any more.
    return clear, np.asarray(last < 1e-3 * DISTURBANCE if wanted else furthest > 30.0 * DISTURBANCE)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), 0, None))
def _orbit_at(scene: Scene, order: Float[Array, ""], wanted: Array) -> tuple[Array, Array, Array, Array]:
    """Return phase, velocity, 1 + D - |T| and smallest gap in flight (nm) of the first orbit with a verdict."""
    orbits = single_impact_orbits(scene, order)
    slot = jnp.argmax(orbits.exists & orbits.admissible & (orbits.stable == wanted))
    phase, velocity = orbits.phase_rad[slot], orbits.velocity_after_nm_per_us[slot]
    margin = 1.0 + orbits.determinant[slot] - jnp.abs(orbits.trace[slot])
    start = phase / scene.platform.angular_frequency
    flown = jnp.linspace(0.0, 1.0, _SAMPLES) * order * scene.platform.period_us
    height, _ = jax.vmap(scene.cantilever.propagator)(flown)(scene.platform.position(start), velocity)
    gap = height - scene.platform.position(start + flown)
    minimum = (gap[1:-1] < gap[:-2]) & (gap[1:-1] < gap[2:])
    return phase, velocity, margin, jnp.min(jnp.where(minimum, gap[1:-1], jnp.inf))


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), 0, 0, None))
def _disturbed(scene: Scene, phase: Array, velocity: Array, impacts: int) -> tuple[Array, Array]:
    """Return distances from an orbit after a small disturbance: the largest of the last impacts, and of all."""
    omega = scene.platform.angular_frequency
    time, speed = _iterate(scene, (phase + DISTURBANCE) / omega, velocity * (1.0 + DISTURBANCE), impacts)
    turn = omega * time - phase
    distance = jnp.hypot(jnp.arctan2(jnp.sin(turn), jnp.cos(turn)), speed / velocity - 1.0)
    distance = jnp.where(jnp.isfinite(distance), distance, jnp.inf)
    return jnp.max(distance[-_LAST:]), jnp.max(distance)


def _settled_order(scenes_at, chosen, generator: np.random.Generator, *, impacts: int) -> Int[np.ndarray, " points"]:
    """Return the order of the (1, N) orbit on which one of several random starts settles; 0 if none does."""
    if not len(chosen):
        return np.zeros(0, int)
    scenes = scenes_at(np.repeat(chosen, _STARTS))
    phase = generator.uniform(0.0, 2.0 * np.pi, len(chosen) * _STARTS)
    speed = 10.0 ** generator.uniform(-1.0, 0.5, len(chosen) * _STARTS)
    orders = _settled(scenes, jnp.asarray(phase), jnp.asarray(speed), impacts)
    return np.asarray(orders).astype(int).reshape(len(chosen), _STARTS).max(axis=1)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), 0, 0, None))
def _settled(scene: Scene, phase: Array, speed: Array, impacts: int) -> Array:
    """Return the order of the orbit on which a motion is at its end; `speed`: off the platform, over beta omega."""
    start = phase / scene.platform.angular_frequency
    velocity = scene.platform.velocity(start) + speed * scene.platform.top_speed_nm_per_us
    time, after = _iterate(scene, start, velocity, impacts)
    periods = jnp.diff(time[-_LAST - 1 :]) / scene.platform.period_us
    last = after[-_LAST:]
    order = jnp.round(periods[-1])
    # False where the motion has ended: NaN is near to nothing.
    same = jnp.all(jnp.abs(periods - order) < 1e-7)
    steady = jnp.max(last) - jnp.min(last) < 1e-7 * jnp.abs(last[-1])
    return jnp.where(same & steady, order, 0.0)


def _iterate(scene: Scene, time: Array, velocity: Array, impacts: int) -> tuple[Array, Array]:
    """Return time and velocity after every impact; NaN from where the tip is captured or comes to rest by chatter.

    `iterate_map` follows chatter down to the rounding of the gap, where every hop costs as much as a hundred flights.
    """

    def one(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        impact = next_impact(scene, *state, max_steps=_MAX_STEPS)
        approach = scene.platform.velocity(impact.arrival_time_us) - impact.velocity_before_nm_per_us
        flies = (impact.outcome == Outcome.IMPACT) & (approach > _CHATTER * scene.platform.top_speed_nm_per_us)
        state = jnp.where(flies, impact.time_us, jnp.nan), jnp.where(flies, impact.velocity_after_nm_per_us, jnp.nan)
        return state, state

    _, rows = lax.scan(one, (time, velocity), length=impacts)
    return rows


LAST_ORDER = 14
_REDUCED_FREQUENCIES = (0.301, 6.501)
"""Off round numbers: where n is a fraction N/2k with small integers, the flight of a (1, N) orbit lasts k free periods
exactly, every state returns, and whether that is an orbit is a matter of rounding."""
_DRIVE_AMPLITUDES_NM = (0.0, 3.0)
_OFFSETS_NM = 1.0
_RESTITUTIONS = (50, 99)  # in hundredths
_COARSE = 4
_SPOT_IMPACTS = 2000


@dataclass(frozen=True)
class FigureData:
    """One figure: its data, and how well they stand.

    Attributes:
        data: the chart, or the amplitudes.
        numbers: key numbers of the figure.
        statements: what the paper says of it, checked.
        spot_checks: its verdicts against long iterations.
        compared_with: the chart without adhesion, for figure 3.
    """

    data: StabilityChart | OffsetAmplitudes
    numbers: dict[str, object]
    statements: list[Statement]
    spot_checks: SpotChecks
    compared_with: StabilityChart | None = None

    @property
    def valid(self) -> bool:
        """Whether every statement holds and every spot check agreed."""
        return all(statement.holds for statement in self.statements) and not self.spot_checks.failures

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the table's columns."""
        return AMPLITUDE_COLUMNS if isinstance(self.data, OffsetAmplitudes) else TABLE_COLUMNS

    def table(self) -> list[dict[str, object]]:
        """Return the rows of the table."""
        return self.data.table()


def chart_grid(*, coarse: bool) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, " rows"]]:
    """Return reduced frequencies and drive amplitudes (nm) of figures 2 and 3: the middles of cells."""
    stride = _COARSE if coarse else 1
    return _middles(*_REDUCED_FREQUENCIES, 496 // stride), _middles(*_DRIVE_AMPLITUDES_NM, 240 // stride)


def figure2_chart(*, coarse: bool, report: Callable[[str], object] = lambda _: None) -> StabilityChart:
    """Compute the chart of figure 2: no adhesion."""
    return _chart(presets.figure2_scene, "figure 2", coarse=coarse, report=report)


def figure3_chart(*, coarse: bool, report: Callable[[str], object] = lambda _: None) -> StabilityChart:
    """Compute the chart of figure 3: with adhesion."""
    return _chart(presets.figure3_scene, "figure 3", coarse=coarse, report=report)


def figure2(chart: StabilityChart, *, seed: int, points: int) -> FigureData:
    """Check figure 2: tongues at resonance, tails that follow the sign of the offset, verdicts by iteration.

    Args:
        chart: the chart of figure 2.
        seed: of the spot checks.
        points: spot checks of each verdict.
    """
    mirrored = _chart(_positive_offset_scene, "figure 2, positive offset", coarse=True)
    statements = [tongues_at_resonance(chart), tails_lean(chart, mirrored), _complete(chart)]
    return FigureData(chart, _chart_numbers(chart), statements, _check_chart(chart, seed, points))


def figure3(chart: StabilityChart, without: StabilityChart, *, seed: int, points: int) -> FigureData:
    """Check figure 3: tongues at resonance, low orders gone at low drive, verdicts by iteration.

    Args:
        chart: the chart of figure 3.
        without: that of figure 2, on the same grid.
        seed: of the spot checks.
        points: spot checks of each verdict.
    """
    statements = [tongues_at_resonance(chart), low_orders_vanish(without, chart), _complete(chart)]
    return FigureData(chart, _chart_numbers(chart), statements, _check_chart(chart, seed, points), without)


def figure9(*, coarse: bool, seed: int, points: int) -> FigureData:
    """Compute and check figure 9: amplitude against offset below and above resonance.

    Args:
        coarse: a quarter of the offsets only.
        seed: of the spot checks.
        points: spot checks of each verdict.
    """
    steps = 25 if coarse else 100
    low, high = _RESTITUTIONS
    amplitudes = offset_amplitudes(
        presets.figure9_scene,
        reduced_frequency=(presets.OFFSET_SWEEP_BELOW, presets.OFFSET_SWEEP_ABOVE),
        offset_nm=np.arange(-steps, steps + 1) * (_OFFSETS_NM / steps),
        r=np.arange(low, high + 1) / 100.0,
    )
    statements = [amplitude_slope(amplitudes, 0, falls=True), amplitude_slope(amplitudes, 1, falls=False)]
    peak = amplitudes.peak_amplitude_nm[:, :, amplitudes.zero]
    numbers: dict[str, object] = {
        "stable_share": float(np.mean(np.isfinite(amplitudes.peak_amplitude_nm))),
        "peak_amplitude_nm_at_zero_offset_and_highest_r": peak[:, -1].tolist(),
    }
    checks = _check(amplitudes.scene_of, amplitudes.points(), amplitudes.verdicts, seed, points)
    return FigureData(amplitudes, numbers, statements, checks)


def _chart(
    scene_of: Callable[..., Scene], name: str, *, coarse: bool, report: Callable[[str], object] = lambda _: None
) -> StabilityChart:
    told = 0

    def progress(done: int, total: int) -> None:
        nonlocal told
        if done - told >= 0.1 * total:
            told = done
            report(f"{name}: {done} of {total} points")

    frequency, amplitude = chart_grid(coarse=coarse)
    return stability_chart(scene_of, x_values=frequency, y_values=amplitude, last_order=LAST_ORDER, report=progress)


def _positive_offset_scene(reduced_frequency: ArrayLike, drive_amplitude_nm: ArrayLike) -> Scene:
    """Return figure 2's scene with the offset's sign turned round."""
    return presets.stability_scene(reduced_frequency, drive_amplitude_nm, -presets.STABILITY_OFFSET_NM, 0.0)


def _complete(chart: StabilityChart) -> Statement:
    """Say whether orders above the chart's would add anything."""
    share = share_above(chart, last_order=2 * LAST_ORDER, stride=_COARSE)
    numbers: dict[str, object] = {"share_of_points_added": share, "tried_up_to_order": 2 * LAST_ORDER}
    return Statement(f"orders above {LAST_ORDER} add less than 1e-4 of the points", share < 1e-4, numbers)


def _chart_numbers(chart: StabilityChart) -> dict[str, object]:
    stable = chart.stable
    return {
        "stable_share": chart.stable_share,
        "stable_share_of_order": {n + 1: float(share) for n, share in enumerate(stable.mean(axis=(1, 2)))},
        "share_with_several_orders": float((stable.sum(axis=0) > 1).mean()),
        "points": int(stable[0].size),
    }


def _check_chart(chart: StabilityChart, seed: int, points: int) -> SpotChecks:
    return _check(chart.scene_of, chart.points(), chart.verdicts, seed, points)


def _check(
    scene_of: Callable[..., Scene], columns: tuple[np.ndarray, ...], verdicts: OrbitVerdicts, seed: int, points: int
) -> SpotChecks:
    return spot_check(
        lambda chosen: batch_of_scenes(scene_of, *(column[chosen] for column in columns)),
        verdicts,
        seed=seed,
        points=points,
        impacts=_SPOT_IMPACTS,
    )


def _middles(low: float, high: float, cells: int) -> Float[np.ndarray, " cells"]:
    # Rounded: the table then shows 0.3125 and not 0.31249999999999994.
    return np.round(low + (np.arange(cells) + 0.5) * ((high - low) / cells), 12)
