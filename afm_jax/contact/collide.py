"""Collisions of free tips with a sample at rest: rebound speed, delay and losses for an approach speed (section IV).

Takes a contact, approach speeds in nm/us and a mass in ng; gives speeds in nm/us, delay and time in contact in us,
energies in aJ, gaps in nm and an outcome (eqs. 10 to 16).

One `collision` is the approach through the bridge, the junction, and the retraction. `collide` takes batches of speeds
and contacts, in few steps and again in many for the few tips that need it; `capture_speed` is the root of the energy at
the end; `collisions` makes a table of them.
"""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from afm_jax.checks import (
    as_parameter,
    check_parameter,
    check_scalar,
    checked,
    refuse_float32,
    require_float64,
)
from afm_jax.columns import CsvColumns, csv_columns, rows_of
from afm_jax.contact.bridge_leg import (
    Passage,
    approach_through_bridge,
    pull_at,
    retract_through_bridge,
    turn_in_bridge,
)
from afm_jax.contact.contact import Contact, bridge_of
from afm_jax.contact.driven import Driven, free_tip
from afm_jax.contact.junction import Junction, find_junction, require_junction
from afm_jax.contact.junction_leg import JunctionWay, pass_through_junction
from afm_jax.contact.settings import CAREFUL, Setting, setting_of
from afm_jax.outcomes import CollisionOutcome
from afm_jax.report import Cell, Section, sections, table_of
from afm_jax.results import ResultTuple, public_result
from afm_jax.saved import as_json
from afm_jax.solve.derivatives import by_tangents, implicit_root
from afm_jax.solve.lanes import LANES, compiled_quickly, filled, for_each_lane, map_in_blocks

_CAPTURE_POINTS = 64
"""Speeds of each search inside an interval for the capture speed."""
_MOST_SPENT = {"steps": 0.2, "collocation": 0.05}
"""Fraction of the energy that dissipation may take where few steps, or few iterations, are enough."""
_NEAR_CAPTURE = (-0.02, 0.2)
"""Kinetic energy at the end over that at the start: between these a tip is close to capture and needs many steps.

The upper bound is reached at about 1.1 times the capture speed.
"""

ONLY_FREE = ("rebound_speed_nm_per_us", "collision_delay_us", "time_in_contact_us", "time_in_junction_us")
# a captured tip stops before it has lost all of that
ONLY_FREE += ("bridge_hysteresis_aj", "junction_hysteresis_aj", "viscous_loss_aj")
"""Fields that only a tip which leaves again has."""


@public_result(outcome=CollisionOutcome, picture="afm_jax.plots.collisions:collisions_figure")
class Collision(ResultTuple):
    """What becomes of free tips that collide with a sample at rest: speeds, times and energies, arrays of one shape.

    Where the tip is captured, rebound speed, delay, time in contact and time in the junction are 0, and the hystereses
    and the viscous loss are not what it has lost, since it stops on the way: see `outcome`. Energies are in aJ.
    """

    approach_speed_nm_per_us: Float[Array, "..."]
    rebound_speed_nm_per_us: Float[Array, "..."]
    collision_delay_us: Float[Array, "..."]
    """Time between the crossings of gap 0 by the straight paths in and out."""
    captured: Bool[Array, "..."]
    outcome: Int[Array, "..."]
    """How the collision ended, the number of a `CollisionOutcome`."""
    time_in_contact_us: Float[Array, "..."]
    """Time from the formation of the bridge to its breaking."""
    time_in_junction_us: Float[Array, "..."]
    deepest_gap_nm: Float[Array, "..."]
    """Smallest gap, negative where the tip indents the sample."""
    bridge_hysteresis_aj: Float[Array, "..."]
    junction_hysteresis_aj: Float[Array, "..."]
    viscous_loss_aj: Float[Array, "..."]
    end_energy_aj: Float[Array, "..."]
    """Kinetic energy at the end, signed: for a captured tip minus what it lacks to leave; 0 at the capture speed."""

    def _unknown(self) -> dict[str, np.ndarray]:
        """Return by column which tips have no value there: a captured one does not leave, an unresolved one is lost."""
        outcome = np.asarray(self.outcome)
        lost = outcome > CollisionOutcome.CAPTURED_BY_JUNCTION
        stays = lost | np.asarray(self.captured)
        return {**dict.fromkeys(ONLY_FREE, stays), "deepest_gap_nm": lost, "end_energy_aj": lost}


@checked
def collide(
    contact: Contact,
    approach_speed_nm_per_us: ArrayLike,
    mass_ng: ArrayLike = 1.0,
    *,
    accuracy: float = 1e-9,
    method: str = "diffrax",
) -> Collision:
    """Return what becomes of free tips that hit a sample at rest.

    Works under `jit`, `vmap`, `grad` and `jvp`, in every parameter of the contact. A million speeds are one call; under
    `vmap` the tips of all examples are one batch.

    Args:
        contact: the contact; its parameters are numbers, or arrays of the speeds' shape to differ from tip to tip.
        approach_speed_nm_per_us: speeds in nm/us, of any shape.
        mass_ng: the tip's mass in ng; a number, or an array of the speeds' shape.
        accuracy: wanted relative accuracy of the rebound speed, and a tenth of the delay's in us (relative where the
            delay is longer than 1 us); picks the cheapest setting that reaches it (`afm-jax accuracy collide` shows
            what each costs). Close to capture rounding of the speed itself is more: 1e-16 u_in^2/u_out^2.
        method: "diffrax" (Runge-Kutta steps in the gap) or "collocation".

    Returns:
        A `Collision` with arrays of the speeds' shape.

    Raises:
        RuntimeError: if the contact was built before JAX was set to the 64-bit floats that it now computes in.
        ValueError: if the contact has no junction, the mass is not positive, shapes do not fit, or there is no such
            method or accuracy. Speeds that are not positive and finite are outcomes, not errors.

    >>> import jax
    >>> with jax.enable_x64(True):
    ...     print(round(float(collide(Contact.paper(), 20.0).rebound_speed_nm_per_us), 4))
    16.6251
    """
    setting = setting_of(method, accuracy)
    refuse_float32(contact)
    check_parameter("mass_ng", mass_ng, "positive")
    speeds = as_parameter(approach_speed_nm_per_us)
    mass = jnp.asarray(mass_ng, speeds.dtype)
    for leaf in (*jax.tree.leaves(contact), mass):
        if leaf.ndim and leaf.shape != speeds.shape:
            raise ValueError(
                f"parameters must be numbers or have the speeds' shape {speeds.shape}, but one has {leaf.shape}"
            )
    # one axis of tips inside, the speeds' own shape outside
    contact, mass = jax.tree.map(lambda leaf: leaf.ravel() if leaf.ndim else leaf, (contact, mass))
    tips = contact, mass, speeds.ravel()
    result = by_tangents(_collided, *tips, small=speeds.size <= LANES, settings=(setting, CAREFUL))
    if not any(leaf.ndim for leaf in jax.tree.leaves(contact)):
        require_junction(contact, result.outcome != CollisionOutcome.NO_JUNCTION)
    return jax.tree.map(lambda part: part.reshape(speeds.shape), result)


def collision(
    contact: Contact,
    junction: Junction,
    approach_speed: Float[Array, "..."],
    mass: Float[Array, "..."],
    setting: Setting,
) -> tuple[Collision, Bool[Array, "..."]]:
    """Return the collision of a free tip, and whether the setting resolves it.

    The tip approaches through the bridge, passes the junction, and retracts through the bridge, each from the kinetic
    energy that the part before leaves. A careful setting also follows tips that the bridge turns round before the
    junction forms.

    Args:
        contact: the contact.
        junction: of the contact.
        approach_speed: in nm/us; speeds that are not positive and finite have an outcome that says so.
        mass: in ng.
        setting: how finely.
    """
    valid = (approach_speed > 0.0) & jnp.isfinite(approach_speed)
    speed = jnp.where(valid, approach_speed, 1.0)
    tip, start_aj = free_tip(contact, junction, mass), 0.5 * mass * speed * speed
    approach = approach_through_bridge(tip, start_aj, setting)
    solid = pass_through_junction(tip, approach.energy_aj, setting.junction_nodes)
    retract = retract_through_bridge(tip, solid.energy_aj, setting)
    lacking = jnp.minimum(retract.energy_aj, jnp.minimum(solid.energy_aj, approach.energy_aj))
    sticks = (approach.energy_aj > 0.0) & ~(solid.energy_aj > 0.0)
    # kinetic, signed: positive where the tip leaves
    end_aj = jnp.where(lacking > 0.0, retract.energy_aj, lacking)
    lasts_us, in_junction_us = approach.time_us + solid.time_us + retract.time_us, solid.time_us
    dissipated_aj = approach.dissipated_aj + retract.dissipated_aj
    junction_aj = junction.junction_hysteresis_aj
    ends_nm, deepest_nm, leaves_as = tip.ends_nm, solid.deepest_gap_nm, CollisionOutcome.REBOUND
    stays_as = jnp.where(sticks, CollisionOutcome.CAPTURED_BY_JUNCTION, CollisionOutcome.CAPTURED_BY_BRIDGE)
    settled = jnp.ones_like(valid)
    if setting.careful and contact.spans:
        turn = for_each_lane(turn_in_bridge, tip, speed, approach.dissipated_aj)
        turns, none = turn.turns & (approach.energy_aj <= 0.0), jnp.zeros_like(turn.time_us)
        straight = end_aj, lasts_us, ends_nm, dissipated_aj, deepest_nm, in_junction_us, junction_aj
        turned = turn.energy_aj, turn.time_us, contact.bridge_breaks_nm, turn.dissipated_aj, turn.gap_nm, none, none
        end_aj, lasts_us, ends_nm, dissipated_aj, deepest_nm, in_junction_us, junction_aj = (
            jnp.where(turns, here, other) for here, other in zip(turned, straight, strict=True)
        )
        leaves_as = jnp.where(turns, CollisionOutcome.TURNED_IN_BRIDGE, leaves_as)
        stays_as = jnp.where(turns, CollisionOutcome.CAPTURED_BY_BRIDGE, stays_as)
        settled = turn.settled | ~turns
    if setting.careful:
        settled = settled & jnp.isfinite(end_aj) & jnp.isfinite(dissipated_aj)
    leaves = end_aj > 0.0
    outcome = jnp.where(leaves, leaves_as, stays_as)
    outcome = jnp.where(settled, outcome, CollisionOutcome.UNRESOLVED)
    outcome = jnp.where(junction.exists, outcome, CollisionOutcome.NO_JUNCTION)
    outcome = jnp.where(valid, outcome, CollisionOutcome.INVALID_START).astype(jnp.int32)
    rebound = jnp.where(leaves, jnp.sqrt(2.0 * jnp.where(leaves, end_aj, 1.0) / mass), 0.0)
    straight_us = contact.bridge_forms_nm / speed + ends_nm / jnp.where(leaves, rebound, 1.0)
    result = Collision(
        approach_speed_nm_per_us=speed,
        rebound_speed_nm_per_us=rebound,
        collision_delay_us=jnp.where(leaves, lasts_us - straight_us, 0.0),
        captured=~leaves,
        outcome=outcome,
        time_in_contact_us=jnp.where(leaves, lasts_us, 0.0),
        time_in_junction_us=jnp.where(leaves, in_junction_us, 0.0),
        deepest_gap_nm=deepest_nm,
        bridge_hysteresis_aj=junction.bridge_hysteresis_aj,
        junction_hysteresis_aj=junction_aj,
        viscous_loss_aj=dissipated_aj,
        end_energy_aj=end_aj,
    )
    # what has no result holds zeros
    ends = outcome <= CollisionOutcome.CAPTURED_BY_JUNCTION
    result = jax.tree.map(lambda part: jnp.where(ends, part, jnp.zeros_like(part)), result)
    resolved = _resolved(tip, start_aj, approach, solid, retract, setting) | ~valid | ~junction.exists
    return result._replace(approach_speed_nm_per_us=approach_speed, outcome=outcome), resolved


def _resolved(
    tip: Driven,
    start_aj: Float[Array, "..."],
    approach: Passage,
    solid: JunctionWay,
    retract: Passage,
    setting: Setting,
) -> Bool[Array, "..."]:
    """Say whether few steps resolve a collision from a kinetic energy at the start.

    They do where dissipation is small against the energies along the way, no repulsion almost stops the tip inside the
    bridge, and it is not close to capture.
    """
    pull_in, calm_in = _pull_and_calm(tip, tip.forms_nm)
    _, calm_out = _pull_and_calm(tip, tip.ends_nm)
    least = jnp.minimum(start_aj + jnp.maximum(pull_in, 0.0), approach.energy_aj)
    spent = _MOST_SPENT[setting.rule]
    easy_in = (approach.dissipated_aj < spent * least) & (approach.energy_aj > 0.1 * start_aj) & calm_in
    easy_out = (retract.dissipated_aj < spent * solid.energy_aj) & calm_out
    # what is left of the energy at the end has the error of all of it: close to capture that is many times its own
    energy_left = jnp.where(solid.energy_aj > 0.0, retract.energy_aj, solid.energy_aj)
    clear = (energy_left > _NEAR_CAPTURE[1] * start_aj) | (energy_left < _NEAR_CAPTURE[0] * start_aj)
    return easy_in & clear & (easy_out | (solid.energy_aj <= 0.0))


def _pull_and_calm(tip: Driven, outer_nm: Float[Array, "..."]) -> tuple[Float[Array, "..."], Bool[Array, "..."]]:
    """Return the pull at an outer gap in aJ, and whether a slow tip's drag is small against it.

    Else the substitution of the gap does not hold.
    """
    pull = pull_at(tip, outer_nm)
    drag = tip.bridge.damping(outer_nm) * outer_nm * jnp.sqrt(2.0 * jnp.maximum(pull, 0.0) / tip.mass_ng)
    return pull, (pull <= 0.0) | (drag <= 0.1 * pull)


@checked
def capture_speed(contact: Contact, mass_ng: ArrayLike = 1.0) -> Float[Array, ""]:
    """Return the approach speed in nm/us at which the tip would come to rest where contact ends.

    It is the root of the kinetic energy that is left there, which is a smooth function of the approach speed with a
    sign; the largest root, if there are several. 0 if every tip leaves, infinite if none does up to a thousand times
    the speed that hysteresis alone would ask for. Differentiable in every parameter.

    Args:
        contact: the contact, of numbers.
        mass_ng: the tip's mass in ng.

    Raises:
        RuntimeError: if the contact was built before JAX was set to the 64-bit floats that it now computes in.
        ValueError: if the contact has no junction, or the mass is not positive.
    """
    refuse_float32(contact)
    check_parameter("mass_ng", mass_ng, "positive")
    check_scalar("mass_ng", mass_ng)
    speed, exists = _capture_speed(contact, as_parameter(mass_ng))
    require_junction(contact, exists)
    return speed


@compiled_quickly()
def _capture_speed(contact: Contact, mass: Float[Array, ""]) -> tuple[Array, Array]:
    """Return the capture speed in nm/us (0: every tip leaves, infinite: none does), and whether a junction exists."""
    junction = find_junction(contact)
    fixed = lax.stop_gradient((contact, junction, mass))
    # the search begins around sqrt(2 hysteresis / m); dissipation raises the root, a turn in the bridge lowers it
    taken = fixed[1].hysteresis_aj
    if contact.dry and contact.forces.terms:
        # drag alone captures a tip, on its way out of the well of the attraction
        bridge = bridge_of(fixed[0])
        taken = bridge.potential(fixed[0].bridge_forms_nm) - bridge.potential(fixed[1].forms_gap_nm)
    scale = jnp.log(jnp.sqrt(2.0 * jnp.maximum(taken, 1e-6) / fixed[2]))
    width = jnp.asarray([math.log(0.01), math.log(1e3)], scale.dtype)

    def narrow(ends, _):
        # one small program for all rounds: the first looks far and wide, each further one inside an interval
        points = ends[0] + (ends[1] - ends[0]) * jnp.linspace(0.0, 1.0, _CAPTURE_POINTS, dtype=scale.dtype)
        contact, junction, mass = fixed
        found, _ = collision(contact, junction, jnp.exp(points), mass, CAREFUL)
        captured = found.captured | (found.outcome == CollisionOutcome.UNRESOLVED)
        last = _CAPTURE_POINTS - 1 - jnp.argmax(captured[::-1])
        inside = jnp.stack([points[last], points[jnp.minimum(last + 1, _CAPTURE_POINTS - 1)]])
        return inside, (captured.any(), captured[-1])

    ends, (any_captured, fastest_captured) = lax.scan(narrow, scale + width, None, length=9)
    found = jnp.exp(ends[0])
    root = implicit_root(_end_energy, found, (contact, junction, mass))
    speed = jnp.where(fastest_captured[0], jnp.inf, root)
    return jnp.where(any_captured[0], speed, 0.0), junction.exists


def _end_energy(
    approach_speed: Float[Array, ""], model: tuple[Contact, Junction, Float[Array, ""]]
) -> Float[Array, ""]:
    contact, junction, mass = model
    return collision(contact, junction, approach_speed, mass, CAREFUL)[0].end_energy_aj


def collide_in_blocks(
    contact: Contact, speeds: Float[np.ndarray, " n"], mass_ng: float = 1.0, **options: Any
) -> Collision:
    """Return the collisions of many speeds as NumPy arrays, filled up to whole blocks so that one program serves all.

    Args:
        contact: the contact, of numbers.
        speeds: approach speeds in nm/us.
        mass_ng: the tip's mass in ng.
        options: of `collide`.
    """
    result = collide(contact, filled(speeds, LANES * -(-len(speeds) // LANES)), mass_ng, **options)
    return jax.tree.map(lambda part: np.asarray(part)[: len(speeds)], result)


def batch_of(contact: Contact, mass_ng: ArrayLike, speeds: Float[Array, " tips"], setting: Setting) -> Collision:
    """Return a batch by one setting, without a second look at what its few steps do not resolve: for measurements."""
    return _quick(contact, jnp.asarray(mass_ng, speeds.dtype), speeds, setting)[0]


def _in_blocks(
    contact: Contact, mass: Float[Array, "..."], speeds: Float[Array, " tips"], setting: Setting
) -> tuple[Collision, Bool[Array, " tips"]]:
    """Return the collisions of a batch, and which of them the setting resolves; a careful one takes all as resolved."""
    varied, shared = eqx.partition((contact, mass), lambda leaf: leaf.ndim > 0)

    def block(lanes):
        contact, mass = eqx.combine(lanes[0], shared)
        return collision(contact, for_each_lane(find_junction, contact), lanes[1], mass, setting)

    return map_in_blocks(block, (varied, speeds), block=LANES, recompute=True)


_quick = jax.jit(_in_blocks, static_argnames="setting")
_careful = compiled_quickly(static_argnames="setting")(_in_blocks)


def _collided(contact: Contact, mass: Array, speeds: Array, setting: Setting) -> tuple[Collision, Bool[Array, " tips"]]:
    # few tips need many steps, many few: those are compiled for long runs
    return (_careful if setting.careful else _quick)(contact, mass, speeds, setting=setting)


@public_result(picture="afm_jax.plots.collisions:collisions_figure")
class Collisions(ResultTuple):
    """A table of collisions.

    Attributes:
        tips: in NumPy arrays of one axis.
        capture_speed_nm_per_us: None where it is not a number.
        junction: where it forms and breaks, and its hysteresis.
    """

    tips: Collision
    capture_speed_nm_per_us: float | None
    junction: dict[str, float]

    @property
    def columns(self) -> dict[str, list[Any]]:
        """The fields of the tips, None where there is no value; outcomes as sentences."""
        lost = self.tips.outcome > CollisionOutcome.CAPTURED_BY_JUNCTION
        gaps = self.tips._unknown() | {"captured": lost}  # noqa: SLF001
        told: dict[str, Any] = self.tips._asdict() | {
            "outcome": [CollisionOutcome(end).sentence for end in self.tips.outcome.tolist()]
        }
        return {name: list(np.where(gaps.get(name, False), None, part)) for name, part in told.items()}

    @property
    def reason(self) -> str | None:
        """Why not every collision has a result; None where all have."""
        columns = self.columns
        failed = [end for end, stays in zip(columns["outcome"], columns["captured"], strict=True) if stays is None]
        return f"{len(failed)} of {len(columns['outcome'])} collisions: {failed[0]}" if failed else None

    @property
    def capture_speed_reason(self) -> str | None:
        """Why there is no capture speed, or why it is 0; None where it is a speed."""
        if self.capture_speed_nm_per_us is None:
            return "There is no capture speed: tips of every speed that was tried are captured."
        none_captured = "No tip is captured, however slow: the contact dissipates no energy."
        return None if self.capture_speed_nm_per_us else none_captured


@as_json.register
def _(result: Collisions) -> dict[str, Any]:
    names = ("capture_speed_nm_per_us", "capture_speed_reason", "junction")
    return result.columns | {name: getattr(result, name) for name in names}


@sections.register
def _(result: Collisions) -> list[Section]:
    cells: dict[str, Cell] = {
        "approach\nnm/us": "approach_speed_nm_per_us",
        "rebound\nnm/us": "rebound_speed_nm_per_us",
        "delay\nus": "collision_delay_us",
        "in junction\nus": "time_in_junction_us",
        "deepest gap\nnm": "deepest_gap_nm",
        "bridge\naJ lost": "bridge_hysteresis_aj",
        "junction\naJ lost": "junction_hysteresis_aj",
        "viscous\naJ lost": "viscous_loss_aj",
        "outcome": "outcome_name",
    }
    names = [CollisionOutcome(end).name.lower().replace("_", " ") for end in result.tips.outcome.tolist()]
    columns = result.columns
    rows = rows_of(columns | {"outcome_name": names})
    parts: list[Any] = [table_of(cells, rows[:_MOST_PRINTED])]
    if len(rows) > _MOST_PRINTED:
        which = f"The first {_MOST_PRINTED} of {len(rows)} collisions"
        parts.append(f"{which}; the JSON object and collide.csv have all.")
    parts += sorted(set(columns["outcome"]))
    capture, junction = result.capture_speed_nm_per_us, result.junction
    if all(columns["captured"]):
        parts.append(f"All of these tips are captured{'; faster ones leave again' if capture else ''}.")
    parts.append(result.capture_speed_reason or f"Capture speed: {capture:.6g} nm/us.")
    parts.append(
        f"The junction forms at a gap of {junction['forms_gap_nm']:.4g} nm and breaks at "
        f"{junction['breaks_gap_nm']:.4g} nm; hysteresis dissipates {junction['hysteresis_aj']:.4g} aJ: "
        f"{junction['bridge_hysteresis_aj']:.4g} in the bridge, {junction['junction_hysteresis_aj']:.4g} in the "
        "junction."
    )
    return [Section("Collisions of a free tip with the sample at rest", parts)]


@csv_columns.register
def _(result: Collisions) -> CsvColumns:
    return {"collide.csv": result.columns}


_MOST_PRINTED = 40
"""Tips in the printed table at most."""


def collisions(
    contact: Contact, speeds: Sequence[float] | None = None, mass_ng: float = 1.0, *, accuracy: float = 1e-9
) -> Collisions:
    """Return a table of collisions of free tips with a sample at rest, with the capture speed and the junction.

    Args:
        contact: the contact, of numbers.
        speeds: approach speeds in nm/us; None: twenty from 1.1 times the capture speed to 200 nm/us or ten times it.
        mass_ng: the tip's mass in ng.
        accuracy: as in `collide`.

    Raises:
        RuntimeError: if JAX does not compute in 64 bits, or did not when the contact was built.
        ValueError: if the contact has no junction, or a setting is not possible.
    """
    require_float64(contact)
    capture = float(capture_speed(contact, mass_ng))
    chosen = default_speeds(capture) if speeds is None else np.asarray(speeds, dtype=float)
    junction = find_junction(contact)
    numbers = {name: float(getattr(junction, name)) for name in (*junction._fields, "hysteresis_aj")}
    return Collisions(
        tips=collide_in_blocks(contact, chosen, mass_ng, accuracy=accuracy),
        capture_speed_nm_per_us=capture if math.isfinite(capture) else None,
        junction={name: value for name, value in numbers.items() if name not in ("exists", "forms_root")},
    )


def default_speeds(capture_speed_nm_per_us: float) -> Float[np.ndarray, " n"]:
    """Return twenty speeds in nm/us, denser near the capture speed, with four digits each."""
    known = 0.0 < capture_speed_nm_per_us < math.inf
    low = 1.1 * capture_speed_nm_per_us if known else 10.0
    speeds = np.geomspace(low, max(200.0, 10.0 * low), 20)
    return np.array([float(f"{speed:.4g}") for speed in speeds])
