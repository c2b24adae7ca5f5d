"""Stable single-impact orbits of many scenes: their orders and peak amplitudes.

Takes a scene and ranges of two parameters in their units; gives orders N and amplitudes in nm (eqs. 8 and 9).

For every scene and every order N the roots of the closing condition are found; where there is one the orbit is read and
judged. A `StabilityChart` asks this in the plane of two parameters (figures 2 and 3: drive frequency and amplitude).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Shaped

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import FreeFrame
from afm_jax.checks import check_kind, checked
from afm_jax.columns import CsvColumns, csv_columns
from afm_jax.dynamics.bands import UncertainParameters
from afm_jax.dynamics.starts import SampleDriven, sample_driven
from afm_jax.impact.closure import OrbitPlace, OrbitProblem, find_roots
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.orbits import orbit_at, orbit_problem
from afm_jax.report import Section, sections
from afm_jax.results import Result, public_result
from afm_jax.saved import as_json
from afm_jax.scenefile.parameter_paths import ParameterRange, check_ranges, parse_range, scene_family
from afm_jax.solve.lanes import WIDTHS, Report, again_for, in_blocks


class OrbitVerdicts(NamedTuple):
    """What there is at each scene, one row an order, one column a scene (NumPy arrays).

    ``stable``: an orbit that is admissible and stable. ``admissible``: an admissible orbit, stable or not.
    ``peak_amplitude_nm``: of the stable one (the highest, if there are several); NaN where there is none.
    ``largest_multiplier``: how stable that one is: the size of the larger multiplier of the linearised map.
    ``approach_speed_nm_per_us``: of the stable one's impact.
    """

    stable: Bool[np.ndarray, "orders scenes"]
    admissible: Bool[np.ndarray, "orders scenes"]
    peak_amplitude_nm: Float[np.ndarray, "orders scenes"]
    largest_multiplier: Float[np.ndarray, "orders scenes"]
    approach_speed_nm_per_us: Float[np.ndarray, "orders scenes"]


def orbit_verdicts(scenes: Scene, orders: Sequence[int], *, report: Report | None = None) -> OrbitVerdicts:
    """Find the single-impact orbits of many scenes for a range of orders.

    Roots are searched for at all scenes; only where there is one its orbit is looked at.

    Args:
        scenes: a batch of scenes with a law: every parameter has shape (scenes,).
        orders: N.
        report: called with how many of how many scenes are done.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the scenes have no law.
    """
    seen = sample_driven(scenes)
    names = ("peak_amplitude_nm", "largest_multiplier", "approach_speed_nm_per_us")

    def work(part: SampleDriven) -> OrbitVerdicts:
        orbits = highest_orbits(part.scenes, part.frame, jnp.asarray(orders, float), names=names)
        stable, admissible = (orbits[name] > 0 for name in ("stable_orbits", "admissible_orbits"))
        return OrbitVerdicts(stable, admissible, **{name: orbits[name] for name in names})

    # few enough for the cache, many enough to fill the vector units
    return jax.tree.map(np.transpose, in_blocks(work, seen, widths=(*WIDTHS, 1024), report=report))


ORBIT_NUMBERS = (
    "peak_amplitude_nm",
    "lockin_amplitude_nm",
    "lockin_phase_deg",
    "approach_speed_nm_per_us",
    "phase_rad",
    "velocity_after_nm_per_us",
    "largest_multiplier",
)
"""Columns of a scene's highest stable orbit: attributes of `SingleImpactOrbits`, and the multiplier's size."""
DRIVEN_NUMBERS = ("drive_lockin_amplitude_nm", "drive_lockin_phase_deg", "phase_lag_deg")
"""Further columns of a scene that base or force drives."""


@partial(jax.jit, static_argnames=("names",))
def highest_orbits(
    scenes: Scene, frame: FreeFrame, orders: Float[Array, " orders"], *, names: tuple[str, ...] = ORBIT_NUMBERS
) -> dict[str, Shaped[Array, "lanes orders"]]:
    """Return of a block of scenes, for each order, how many orbits there are, and the highest stable one's numbers.

    Only the numbers that are asked for are computed.

    Args:
        scenes: a batch of scenes with a law.
        frame: of each scene, a batch.
        orders: N.
        names: some of `ORBIT_NUMBERS` and, where base or force drive, `DRIVEN_NUMBERS`.

    Returns:
        ``stable_orbits``, ``admissible_orbits``, and the numbers by their names, NaN where no orbit is stable.
    """

    def problem_of(scene: Scene, own_frame: FreeFrame, order: Array) -> OrbitProblem:
        return orbit_problem(scene.cantilever, own_frame.platform, impact_law_of(scene), order)

    def of_order(order: Array) -> dict[str, Array]:
        def orbit_of(place: OrbitPlace, row: Array) -> tuple[Array, Array, Array]:
            scene, own_frame = jax.tree.map(lambda leaf: leaf[row], (scenes, frame))
            orbit = orbit_at(
                place, jnp.ones((), bool), jnp.zeros((), bool), own_frame, problem_of(scene, own_frame, order)
            )
            half, determinant = 0.5 * jnp.abs(orbit.trace), orbit.determinant
            apart = half**2 - determinant
            # a pair on a circle has the root of the determinant for its size
            size = jnp.where(apart > 0.0, half + jnp.sqrt(jnp.abs(apart)), jnp.sqrt(jnp.abs(determinant)))
            wanted = [size if name == "largest_multiplier" else getattr(orbit, name) for name in names]
            numbers = jnp.stack([orbit.peak_amplitude_nm, *wanted])
            return orbit.admissible, orbit.admissible & orbit.stable, numbers

        roots = jax.vmap(lambda scene, own_frame: find_roots(problem_of(scene, own_frame, order)))(scenes, frame)
        count, slots = roots.found.shape
        places = jax.tree.map(lambda part: part.ravel(), roots.place)
        rows = jnp.arange(count * slots) // slots
        nothing = (jnp.zeros(count * slots, bool),) * 2 + (jnp.full((count * slots, len(names) + 1), jnp.nan),)
        there = frame.periodic & impact_law_of(scenes).leaves
        # few scenes have more than one orbit: blocks of roots are smaller than blocks of scenes
        few = max(count // 2, 1)
        is_orbit = roots.found.ravel() & jnp.repeat(there, slots)
        columns = again_for(jax.vmap(orbit_of), is_orbit, (places, rows), nothing, block=few)
        admissible, steady, numbers = (part.reshape(count, slots, *part.shape[1:]) for part in columns)
        highest = jnp.argmax(jnp.where(steady, numbers[..., 0], -jnp.inf), axis=1)
        chosen = jnp.take_along_axis(numbers, highest[:, None, None], axis=1)[:, 0]
        chosen = jnp.where(steady.any(axis=1)[:, None], chosen, jnp.nan)
        counts = {
            "stable_orbits": steady.sum(axis=1, dtype=jnp.int8),
            "admissible_orbits": admissible.sum(axis=1, dtype=jnp.int8),
        }
        return counts | {name: chosen[:, column] for column, name in enumerate(names, 1)}

    return jax.tree.map(jnp.transpose, lax.map(of_order, orders))


@public_result(picture="afm_jax.plots.dynamics:chart_figure")
@dataclass(frozen=True)
class StabilityChart(Result):
    """A chart of stable admissible single-impact orbits over two parameters.

    Attributes:
        x_values: of the columns, ascending; in the paper's figures n = omega/2 Omega.
        y_values: of the rows, ascending; in the paper's figures beta in nm.
        verdicts: orders 1, 2, ... by points; the points are the rows one after the other.
        x: the first parameter by its path, if it is a scene file's.
        y: the second.
        probability: fraction of drawn laws with a stable orbit, of each order and point; None: no laws were drawn.
    """

    x_values: Float[np.ndarray, " columns"]
    y_values: Float[np.ndarray, " rows"]
    verdicts: OrbitVerdicts
    x: ParameterRange | None = None
    y: ParameterRange | None = None
    probability: Float[np.ndarray, "orders points"] | None = None

    @property
    def orders(self) -> int:
        """Highest order that was looked for."""
        return len(self.verdicts.stable)

    @property
    def stable(self) -> Bool[np.ndarray, "orders rows columns"]:
        """Where an orbit of each order is stable and admissible."""
        return self._plane(self.verdicts.stable)

    @property
    def any_stable(self) -> Bool[np.ndarray, "rows columns"]:
        """Where an orbit of any order is stable and admissible."""
        return np.asarray(self.stable.any(axis=0))

    @property
    def lowest_stable_order(self) -> Int[np.ndarray, "rows columns"]:
        """The lowest order with a stable admissible orbit; 0 where there is none."""
        stable = self.stable
        return np.where(stable.any(axis=0), stable.argmax(axis=0) + 1, 0)

    def points(self) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """Return reduced frequency and drive amplitude of every point, in the order of the verdicts."""
        frequency, amplitude = np.meshgrid(self.x_values, self.y_values)
        return frequency.ravel(), amplitude.ravel()

    def tongue(self, order: int) -> Bool[np.ndarray, "rows columns"]:
        """Return where an orbit of this order is stable with a flight shorter than the tip's free period (n > N/2).

        Longer flights, past the platform without a touch, are possible too: islands apart from the tongue.
        """
        return self.stable[order - 1] & (self.x_values > 0.5 * order)

    @property
    def reason(self) -> str | None:
        """Why the chart is empty; None where an orbit is admissible."""
        if self.verdicts.admissible.any():
            return None
        return (
            f"no single-impact orbit of an order up to {self.orders} is admissible over {self.x} and {self.y}: "
            "try larger drive amplitudes, or more orders"
        )

    @property
    def impact_speeds_nm_per_us(self) -> Any:
        """Approach speeds of the orbits in the output."""
        return self.verdicts.approach_speed_nm_per_us

    def _plane(self, rows: np.ndarray) -> np.ndarray:
        return rows.reshape(len(rows), len(self.y_values), len(self.x_values))


@as_json.register
def _(chart: StabilityChart) -> dict[str, Any]:
    verdicts, axes = chart.verdicts, {"x": chart.x, "y": chart.y}
    told: dict[str, Any] = {
        axis: {"parameter": given.path, "low": given.low, "high": given.high, "number": given.number}
        for axis, given in axes.items()
        if given is not None
    }
    told |= {
        "orders": list(range(1, chart.orders + 1)),
        "points": verdicts.stable.shape[1],
        "admissible_share": verdicts.admissible.mean(axis=1),
        "stable_share": verdicts.stable.mean(axis=1),
        "any_stable_share": float(chart.any_stable.mean()),
        "several_stable_share": float((verdicts.stable.sum(axis=0) > 1).mean()),
    }
    if chart.probability is not None:
        told["uncertain_share"] = ((chart.probability > 0.0) & (chart.probability < 1.0)).mean(axis=1)
    return told


@sections.register
def _(chart: StabilityChart) -> list[Section]:
    told = as_json(chart)
    shares = zip(told["orders"], told["stable_share"], told["admissible_share"], strict=True)
    lines = [
        f"order {order}: stable at {100.0 * stable:.4g} % of the points, admissible at {100.0 * admissible:.4g} %"
        for order, stable, admissible in shares
    ]
    lines.append(f"several orders are stable at {100.0 * told['several_stable_share']:.4g} % of the points")
    return [Section("", lines)]


@csv_columns.register
def _(chart: StabilityChart) -> CsvColumns:
    x, y = ("x" if chart.x is None else chart.x.path, "y" if chart.y is None else chart.y.path)
    columns: dict[str, Any] = dict(zip((x, y), chart.points(), strict=True))
    columns["lowest_stable_order"] = chart.lowest_stable_order.ravel()
    names = ("admissible", "stable", "peak_amplitude_nm", "largest_multiplier")
    arrays = {name: getattr(chart.verdicts, name) for name in names} | {"stable_probability": chart.probability}
    for order in range(chart.orders):
        columns |= {f"{name}_{order + 1}": array[order] for name, array in arrays.items() if array is not None}
    return {"chart.csv": columns}


@checked
def stability_chart(
    scene_of: Scene | Callable[..., Scene],
    *,
    x_values: str | ParameterRange | Float[np.ndarray, " columns"],
    y_values: str | ParameterRange | Float[np.ndarray, " rows"],
    last_order: int,
    report: Report | None = None,
) -> StabilityChart:
    """Return which single-impact orbits exist, are stable and coexist over two parameters of a scene.

    Args:
        scene_of: one scene, whose parameters the values name; or the scene at two parameters' values, a function that
            allows `vmap`.
        x_values: of the first parameter, ascending, the chart's columns: "platform.reduced_frequency=0.4:4.4:1000" as
            in the command, of a function the values alone.
        y_values: of the second, likewise: its rows.
        last_order: highest order N that is looked for.
        report: called with how many of how many points are done.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if `scene_of` gives something else than a scene with a law.
        ValueError: if the scenes do not repeat with one drive period, the values do not rise, or there is no order to
            look for.
    """
    if last_order < 1:
        raise ValueError(f"`last_order` must be 1 or more, but is {last_order}")
    across, up = None, None
    if isinstance(scene_of, Scene):
        across, up = (
            parse_range(given if isinstance(given, ParameterRange) else str(given), counted=True)
            for given in (x_values, y_values)
        )
        check_ranges(scene_of, across, up)
        x_values, y_values = across.values, up.values
        scene_of = scene_family(scene_of, across.path, up.path)
    x, y = (np.asarray(values, float) for values in (x_values, y_values))
    for name, values in (("x_values", x), ("y_values", y)):
        if values.ndim != 1 or not values.size or not np.all(np.diff(values) > 0.0):
            raise ValueError(f"`{name}` must be rising numbers, one at least")
    columns = (column.ravel() for column in np.meshgrid(x, y))
    verdicts = orbit_verdicts(batch_of_scenes(scene_of, *columns), range(1, last_order + 1), report=report)
    return StabilityChart(x, y, verdicts, across, up)


def stable_probability(
    scene: Scene, chart: StabilityChart, uncertain: UncertainParameters, paths: tuple[str, str], *, draws: int
) -> Float[np.ndarray, "orders points"]:
    """Return the fraction of draws of uncertain parameters in which an orbit of each order is stable.

    Args:
        scene: that of the chart.
        chart: at whose points.
        uncertain: parameters that are drawn; a parameter of the chart counts as its axis says.
        paths: of the chart's parameters.
        draws: how many.
    """
    drawn = uncertain.without(paths[0]).without(paths[1]).scenes(scene, draws)
    values = {"x_values": chart.x_values, "y_values": chart.y_values, "last_order": chart.orders}
    charts = (stability_chart(scene_family(each, *paths), **values) for each in drawn)
    return sum((each.verdicts.stable for each in charts), np.zeros(chart.verdicts.stable.shape)) / draws


def batch_of_scenes(scene_of: Callable[..., Scene], *columns: np.ndarray) -> Scene:
    """Return one scene a row of some columns of arguments, as a batch."""
    # operation by operation, which JAX knows again: a program of a new function would be compiled at every call
    scenes = eqx.filter_vmap(scene_of)(*(jnp.asarray(column, float) for column in columns))
    check_kind("scene_of(...)", scenes, Scene)
    return scenes
