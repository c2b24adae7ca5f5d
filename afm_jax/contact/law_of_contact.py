"""The law that a contact amounts to: rebound speed and delay of its free collisions, in parameters and in tables.

Takes a contact and a mass in ng; gives laws: rebound speed in nm/us and delay in us of an approach speed in nm/us
(eq. 6).

Five functions make a law of collisions: the formula closest to their rebound speeds (`law_of_contact`), the formula
closest to their delays (`delay_of_contact`), both roughly and at once where a guess will do (`approximate_law`), a
table for scenes and files (`make_law`), and a table with derivatives in every parameter, for fits of a contact
(`tabulated`).

The delay is what the straight paths in and out, extrapolated to gap 0, leave between them; the difference of two times:

    lag   the time that the tip spends in the solid junction: what its finite stiffness needs to turn the tip round;
    lead  what the straight paths take from the bridge's formation to gap 0 and from there to the end of contact, less
          the time that the tip needs for these ways outside the junction: it is drawn in, and on the way out still
          has the energy that hysteresis takes only later.

For the last table a collision is followed against time, from the speed with which the tip leaves to the one with which
it came: there is no capture that way, and the speed and the time in contact are smooth functions of the rebound speed
down to 0. The capture speed is where a rebound speed of 0 comes from.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from afm_jax.checks import checked, require_float64
from afm_jax.columns import CsvColumns, csv_columns
from afm_jax.contact.bridge_leg import collocate, margin_of, pull_at, way_through
from afm_jax.contact.collide import capture_speed, collide, collide_in_blocks
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import Driven, free_tip
from afm_jax.contact.junction import find_junction
from afm_jax.contact.junction_leg import pass_through_junction
from afm_jax.impact.lasting_impact import TabulatedImpact, polynomials, stretched
from afm_jax.impact.law import MOST_KNOTS, CollisionDelay, HertzContact, ImpactLaw, TabulatedLaw, closest_delay
from afm_jax.report import Cell, Section, sections, table_of
from afm_jax.results import Result, ResultTuple, public_result
from afm_jax.saved import as_json
from afm_jax.solve.derivatives import largest
from afm_jax.solve.lanes import compiled_quickly
from afm_jax.solve.least_squares import Sum, levenberg_marquardt

FREE = {"law": ("r", "epsilon"), "viscous": ("epsilon", "viscous_loss"), "full": ("r", "epsilon", "viscous_loss")}
"""For every model the parameters that are fitted; the others are r = 1 and no viscous loss."""
LAW_SPEEDS = 1.5, 250.0
"""The range of `law_of_contact` if none is given: from this multiple of the capture speed to this speed in nm/us."""
DELAY_SPEEDS = 1.37, 700.0
"""The range of `delay_of_contact` if none is given, likewise: for the paper's contact 15 to 700 nm/us."""
_NAMES = ("r", "epsilon", "viscous_loss")
_TOLERANCE, _SETTLED = 1e-28, 1e-18
"""Distances of the mean of the squares to its minimum to stop at, and to have settled."""

_NEAREST, _FASTEST = 0.2, 700.0
"""Where the table of `make_law` begins, as sqrt(u^2 - u_c^2) over the capture speed, and ends, in nm/us."""

TERMS = 32
"""Terms of the series: measured on random contacts, 24 leave errors of 1e-5, 40 gain nothing."""
FARTHEST = 400.0
"""Rebound speed where the table ends, in terms of the speed that hysteresis takes."""
SPEED_ERROR, DELAY_ERROR_US = 1e-7, 1e-6
"""Relative error of the rebound speed, and error of the delay, beyond which a table does not count."""


_Rule = tuple[int, int, int]
"""Gauss nodes and iterations of a way through the bridge, and Gauss nodes of the junction."""
_USUAL, _FINER = (13, 6, 16), (26, 12, 32)
_COMPARED = slice(0, None, 6)
"""The nodes at which the usual rule is compared with the finer one."""
_BARRIER_GAPS = 24
_LEAD_SPEEDS = np.geomspace(2.0, 30.0, 8)
_PLACES = 0.5 - 0.5 * np.cos(np.pi * np.arange(TERMS) / (TERMS - 1))


@public_result()
@dataclass(frozen=True)
class ContactLaw(Result):
    """A law fitted to a contact, and how far it is off.

    Attributes:
        model: a key of `FREE`.
        law: the fitted law, without a delay.
        converged: whether the search ended at a minimum.
        approach_speed_nm_per_us: the speeds, uniform over the range, shape (n,).
        rebound_speed_nm_per_us: of the contact.
        fitted_speed_nm_per_us: of the law.
        contact_capture_speed_nm_per_us: capture speed of the contact; the law has its own.
        mass_ng: of the tip.
    """

    model: str
    law: ImpactLaw
    converged: bool
    approach_speed_nm_per_us: Float[np.ndarray, " n"]
    rebound_speed_nm_per_us: Float[np.ndarray, " n"]
    fitted_speed_nm_per_us: Float[np.ndarray, " n"]
    contact_capture_speed_nm_per_us: float
    mass_ng: float

    @property
    def r(self) -> float:
        """Coefficient of restitution."""
        return float(self.law.r)

    @property
    def epsilon(self) -> float:
        """Loss by adhesion in nm^2/us^2."""
        return float(self.law.epsilon)

    @property
    def viscous_loss(self) -> float:
        """Loss linear in speed, in nm/us."""
        return float(self.law.viscous_loss)

    @property
    def capture_speed_nm_per_us(self) -> float:
        """Capture speed of the law."""
        return float(self.law.capture_speed_nm_per_us)

    @property
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest approach speed, in nm/us."""
        return float(self.approach_speed_nm_per_us[0]), float(self.approach_speed_nm_per_us[-1])

    @property
    def relative_error(self) -> Float[np.ndarray, " n"]:
        """Fitted less simulated rebound speed, as a share of the simulated one."""
        return self.fitted_speed_nm_per_us / self.rebound_speed_nm_per_us - 1.0

    @property
    def worst_relative_error(self) -> float:
        """Largest of them in size."""
        return float(np.abs(self.relative_error).max())

    @property
    def rms_relative_error(self) -> float:
        """Root of the mean of their squares."""
        return float(np.sqrt(np.mean(self.relative_error**2)))


@checked
def law_of_contact(
    contact: Contact,
    *,
    speed_range: tuple[float, float] | None = None,
    model: str = "law",
    mass_ng: float = 1.0,
    points: int = 512,
) -> ContactLaw:
    """Return the impact law that is closest to a contact's rebound speeds, relative to them.

    Args:
        contact: the contact, of numbers.
        speed_range: lowest and highest approach speed in nm/us; None: from 1.5 times the capture speed to 250 nm/us.
        model: "law" (r and epsilon, eq. 6), "viscous" (epsilon and a loss linear in speed) or "full" (all three).
        mass_ng: the tip's mass in ng.
        points: number of speeds, uniform over the range.

    Raises:
        RuntimeError: if JAX does not compute in 64 bits, or did not when the contact was built.
        ValueError: if the contact has no junction, a tip of the range is captured, or there is no such model, range or
            number of points.

    >>> import jax
    >>> with jax.enable_x64(True):
    ...     law = law_of_contact(Contact.paper(), model="viscous")
    >>> round(law.epsilon, 1), round(law.viscous_loss, 1)
    (113.6, 0.5)
    """
    require_float64(contact)
    if model not in FREE:
        raise ValueError(f"`model` must be one of {', '.join(FREE)}, but is {model!r}")
    if points < len(FREE[model]):
        raise ValueError(f"`points` must be at least the number of parameters, {len(FREE[model])}, but is {points}")
    capture = float(capture_speed(contact, mass_ng))
    approach = np.linspace(*_range_above_capture(speed_range, capture, *LAW_SPEEDS), points)
    rebound = _rebounds(contact, approach, mass_ng).rebound_speed_nm_per_us
    law, converged = _closest_law(approach, rebound, model)
    return ContactLaw(
        model=model,
        law=law,
        converged=converged,
        approach_speed_nm_per_us=approach,
        rebound_speed_nm_per_us=rebound,
        fitted_speed_nm_per_us=np.asarray(law.rebound_speed(approach)),
        contact_capture_speed_nm_per_us=capture,
        mass_ng=mass_ng,
    )


@checked
def make_law(contact: Contact, *, mass_ng: float = 1.0, points: int = MOST_KNOTS) -> TabulatedLaw:
    """Return the impact law of a contact as a table of free tips' collisions; a scene takes it in the contact's place.

    Args:
        contact: the contact, of numbers.
        mass_ng: the tip's mass in ng.
        points: number of speeds, from 2 % above the capture speed to 700 nm/us.

    Raises:
        RuntimeError: if JAX does not compute in 64 bits, or did not when the contact was built.
        ValueError: if the contact has no junction, or captures tips of every speed.
    """
    require_float64(contact)
    capture = float(capture_speed(contact, mass_ng))
    if not capture < 0.5 * _FASTEST:
        raise ValueError("the contact captures tips of every speed that was tried: there is no law to make")
    # a contact that captures no tip still needs a positive speed
    beyond = np.geomspace(max(_NEAREST * capture, 1e-3 * _FASTEST), _FASTEST, points)
    leaving = _rebounds(contact, np.hypot(beyond, capture), mass_ng)
    approach = leaving.approach_speed_nm_per_us
    return TabulatedLaw(
        approach,
        # without any loss rounding may add to the speed
        np.minimum(leaving.rebound_speed_nm_per_us, approach),
        leaving.collision_delay_us,
        capture_speed_nm_per_us=capture,
        mass_ng=mass_ng,
        origin=f"contact: {', '.join(contact.effects)}",
    )


def _closest_law(
    approach: Float[np.ndarray, " n"], rebound: Float[np.ndarray, " n"], model: str
) -> tuple[ImpactLaw, bool]:
    """Return the law with the least sum of squared residuals u_fit/u_out - 1, and whether the search converged.

    Args:
        approach: u_in in nm/us.
        rebound: u_out in nm/us, positive.
        model: a key of `FREE`.
    """
    free = np.array([name in FREE[model] for name in _NAMES])
    # u_out^2 = u_in^2 - (1 - r^2) u_in^2 - epsilon - c u_in; the scales make the parameters of order one
    scales = np.array([1e-2, approach[0] ** 2, approach[0] * 1e-1])[free]
    losses = np.stack([approach**2, np.ones_like(approach), approach], axis=1)[:, free] * scales

    def evaluate(place: Float[np.ndarray, " p"]) -> Sum:
        # a law that captures a tip of the range has the smallest speed instead: far from any minimum
        fitted = np.sqrt(np.maximum(approach**2 - losses @ place, 1e-12))
        residual = fitted / rebound - 1.0
        return Sum(float(residual @ residual), residual, (-0.5 / (rebound * fitted))[:, None] * losses)

    # to first order the residual is that of the squares over 2 u_out
    linear = 0.5 / rebound**2
    guess = np.linalg.lstsq(losses * linear[:, None], (approach**2 - rebound**2) * linear, rcond=None)[0].clip(0.0)
    guess /= max(1.0, 1.01 * float(np.max(losses @ guess / approach**2)))
    minimum = levenberg_marquardt(evaluate, guess, settled=_TOLERANCE * len(rebound), most=100, lowest=0.0)
    values = np.zeros(3)
    values[free] = minimum.place * scales
    loss, epsilon, viscous_loss = values.tolist()
    law = ImpactLaw(r=math.sqrt(max(1.0 - loss, 1e-12)), epsilon=epsilon, viscous_loss=viscous_loss)
    return law, minimum.distance < _SETTLED * len(rebound)


def _rebounds(contact: Contact, speeds: Float[np.ndarray, " n"], mass_ng: float) -> Any:
    """Return the `Collision`, in NumPy arrays, of tips that all leave.

    Raises:
        ValueError: if one is captured, or not resolved.
    """
    tips = collide_in_blocks(contact, speeds, mass_ng)
    stays = np.flatnonzero(~(tips.rebound_speed_nm_per_us > 0.0))
    if stays.size:
        raise ValueError(
            f"`speed_range` must hold rebounding tips only, but the one of {speeds[stays[-1]]:.6g} nm/us does not leave"
        )
    return tips


def _range_above_capture(
    speed_range: tuple[float, float] | None, capture: float, lowest: float, top: float
) -> tuple[float, float]:
    """Return a range of approach speeds in nm/us, checked.

    Args:
        speed_range: lowest and highest speed; None: from `lowest` times the capture speed to `top`.
        capture: capture speed in nm/us.
        lowest: multiple of the capture speed.
        top: in nm/us.

    Raises:
        ValueError: if the range does not rise, or does not begin above the capture speed.
    """
    if math.isinf(capture):
        raise ValueError("the contact captures tips of every speed that was tried: there is no law to fit")
    # a contact that captures no tip still needs a positive speed
    low, high = (max(lowest * capture, 1e-3 * top), top) if speed_range is None else speed_range
    if not 0.0 < low < high < math.inf:
        advice = "" if speed_range else f" (the capture speed is {capture:.4g} nm/us); give a range"
        raise ValueError(f"`speed_range` must rise between two positive speeds, but is {low:.6g} to {high:.6g}{advice}")
    if low <= capture:
        raise ValueError(
            f"`speed_range` must begin above the capture speed of {capture:.6g} nm/us, but does at {low:g}"
        )
    return float(low), float(high)


@public_result()
@dataclass(frozen=True)
class ContactDelay(Result):
    """The delay of a contact against the approach speed, and the law fitted to it; times in us, shapes (n,).

    Attributes:
        delay: the fitted law.
        approach_speed_nm_per_us: the speeds, at equal ratios.
        rebound_speed_nm_per_us: of the contact.
        delay_us: of the contact, lag less lead.
        lag_us: time in the solid junction.
        lead_us: by how much the ways outside the junction are shorter in time than the straight paths to gap 0.
        fitted_us: delay of the law at the contact's speeds.
    """

    delay: CollisionDelay
    approach_speed_nm_per_us: Float[np.ndarray, " n"]
    rebound_speed_nm_per_us: Float[np.ndarray, " n"]
    delay_us: Float[np.ndarray, " n"]
    lag_us: Float[np.ndarray, " n"]
    lead_us: Float[np.ndarray, " n"]
    fitted_us: Float[np.ndarray, " n"]

    @property
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest approach speed, in nm/us."""
        return float(self.approach_speed_nm_per_us[0]), float(self.approach_speed_nm_per_us[-1])

    @property
    def rms_us(self) -> float:
        """Root of the mean square of the fit's errors."""
        return float(np.sqrt(np.mean((self.fitted_us - self.delay_us) ** 2)))

    @property
    def worst_us(self) -> float:
        """Largest error of the fit."""
        return float(np.abs(self.fitted_us - self.delay_us).max())


@checked
def delay_of_contact(
    contact: Contact, *, speed_range: tuple[float, float] | None = None, mass_ng: float = 1.0, points: int = 512
) -> ContactDelay:
    """Return a contact's delay, and the delay law a u^(-1/5) - b (1/w - 1/u) - d/u that is closest to it.

    The law is linear in its parameters: plain linear least squares of the delay in us, with u and w, the approach and
    the rebound speed, of the contact. The speeds are at equal ratios, so that each doubling of the speed counts alike.

    Args:
        contact: the contact, of numbers.
        speed_range: lowest and highest approach speed in nm/us; None: from 1.37 times the capture speed to 700 nm/us.
        mass_ng: the tip's mass in ng.
        points: number of speeds, at least 3.

    Raises:
        RuntimeError: if JAX does not compute in 64 bits, or did not when the contact was built.
        ValueError: if the contact has no junction, a tip of the range is captured, or the range or the number of points
            is not possible.
    """
    require_float64(contact)
    if points < 3:
        raise ValueError(f"`points` must be at least the number of parameters, 3, but is {points}")
    ends = _range_above_capture(speed_range, float(capture_speed(contact, mass_ng)), *DELAY_SPEEDS)
    tips = _rebounds(contact, np.geomspace(*ends, points), mass_ng)
    approach, rebound = tips.approach_speed_nm_per_us, tips.rebound_speed_nm_per_us
    delay, lag = tips.collision_delay_us, tips.time_in_junction_us
    law = closest_delay(approach, rebound, delay, np)
    return ContactDelay(law, approach, rebound, delay, lag, lag - delay, np.asarray(law(approach, rebound)))


@public_result()
class ContactLaws(ResultTuple):
    """What `afm-jax collide --make-law` tells: the formulas closest to a contact, its delay, and its table."""

    formulas: list[ContactLaw]
    delay: ContactDelay
    law: TabulatedLaw

    @property
    def reason(self) -> str | None:
        """Which fits of a formula did not converge; None where all did."""
        lost = [law.model for law in self.formulas if not law.converged]
        return f"the fit of {', '.join(lost)} did not converge; try another speed range" if lost else None


@as_json.register
def _(laws: ContactLaws) -> dict[str, Any]:
    first, delay = laws.formulas[0], laws.delay
    return {
        "residuals": "relative",
        "speed_range_nm_per_us": first.speed_range,
        "points": len(first.approach_speed_nm_per_us),
        "models": [{name: getattr(law, name) for name in _MODEL_KEYS} for law in laws.formulas],
        "contact_capture_speed_nm_per_us": first.contact_capture_speed_nm_per_us,
        "delay": {
            **{name: getattr(delay.delay, name) for name in _DELAY_NUMBERS},
            "rms_us": delay.rms_us,
            "worst_us": delay.worst_us,
            "speed_range_nm_per_us": delay.speed_range,
        },
        "law": as_json(laws.law),
    }


@sections.register
def _(laws: ContactLaws) -> list[Section]:
    first, delay = laws.formulas[0], laws.delay
    formulas: dict[str, Cell] = {
        "law": "model",
        "r": "r:.5f",
        "epsilon\nnm^2/us^2": "epsilon:.5g",
        "c\nnm/us": "viscous_loss:.3g",
        "worst error\n%": lambda law: f"{100.0 * law.worst_relative_error:.3g}",
        "rms error\n%": lambda law: f"{100.0 * law.rms_relative_error:.3g}",
        "capture speed\nnm/us": "capture_speed_nm_per_us:.5g",
    }
    (low, high), (slow, fast) = first.speed_range, delay.speed_range
    formula = f"u_out^2 = r^2 u_in^2 - c u_in - epsilon from {low:.5g} to {high:.5g} nm/us"
    numbers = ", ".join(f"{name} {float(getattr(delay.delay, name)):.4g}" for name in _DELAY_NUMBERS)
    errors = f"rms error {delay.rms_us:.2g} us, worst {delay.worst_us:.2g} us"
    parts = [
        table_of(formulas, laws.formulas),
        f"Capture speed of the contact: {first.contact_capture_speed_nm_per_us:.6g} nm/us.",
        "law: the paper's eq. 6; viscous: r = 1 and a loss c linear in speed; full: all three.",
        "Delay law in us: hertz u_in^(-1/5) - lead_nm (1/u_out - 1/u_in) - offset_nm/u_in",
        f"with {numbers}; {errors}, from {slow:.4g} to {fast:.4g} nm/us.",
    ]
    return [Section(f"{formula}, relative residuals", parts)]


@csv_columns.register
def _(laws: ContactLaws) -> CsvColumns:
    first = laws.formulas[0]
    models = {
        "approach_speed_nm_per_us": first.approach_speed_nm_per_us,
        "rebound_speed_nm_per_us": first.rebound_speed_nm_per_us,
        **{f"{law.model}_speed_nm_per_us": law.fitted_speed_nm_per_us for law in laws.formulas},
        **{f"{law.model}_relative_error": law.relative_error for law in laws.formulas},
    }
    delays = {name: value for name, value in vars(laws.delay).items() if name != "delay"}
    return {"law_models.csv": models, "law_delay.csv": delays}


_MODEL_KEYS = (
    *("model", "r", "epsilon", "viscous_loss", "worst_relative_error", "rms_relative_error"),
    *("capture_speed_nm_per_us", "converged"),
)
"""Columns of a formula: attributes of `ContactLaw`."""
_DELAY_NUMBERS = ("hertz", "lead_nm", "offset_nm")


def contact_laws(
    contact: Contact,
    *,
    speed_range: tuple[float, float] | None = None,
    mass_ng: float = 1.0,
    points: int = 512,
) -> ContactLaws:
    """Return the law that a contact amounts to: the table of it, and the formulas that are closest to it.

    Three formulas of the rebound speed, at uniform speeds: the paper's (r and epsilon), a viscous one (epsilon and a
    loss linear in speed), and all three. Beside them the collision delay, its lag and lead, and its formula.

    Args:
        contact: the contact, of numbers.
        speed_range: of `law_of_contact`.
        mass_ng: the tip's mass in ng.
        points: number of speeds.
    """
    how: dict[str, Any] = {"mass_ng": mass_ng, "points": points}
    formulas = [law_of_contact(contact, model=model, speed_range=speed_range, **how) for model in FREE]
    delay = delay_of_contact(contact, **how)
    return ContactLaws(formulas, delay, make_law(contact, mass_ng=mass_ng))


def approximate_law(contact: Contact, mass_ng: float) -> ImpactLaw | None:
    """Return the law u_out^2 = u_in^2 - c u_in - epsilon, with delay, of a contact; None if every tip is captured.

    Epsilon is the hysteresis, 2 E/m; c and the delay's three parameters are linear least squares to twelve collisions.

    Args:
        contact: the contact, of numbers.
        mass_ng: the tip's mass in ng.

    Raises:
        ValueError: if the contact has no junction.
    """
    slowest = float(capture_speed(contact, mass_ng))
    if not np.isfinite(slowest):
        return None
    low = max(1.4 * slowest, 5.0)
    # a guess needs no more digits
    result = collide(contact, np.geomspace(low, max(500.0, 4.0 * low), 12), mass_ng, accuracy=1e-6)
    u, w, delay = np.stack(result[:3])[:, np.asarray(result.rebound_speed_nm_per_us) > 0.0]
    if len(u) <= 3:
        return None
    epsilon = 2.0 * float(find_junction(contact).hysteresis_aj) / mass_ng
    # relative residuals of u_out^2, so that fast tips do not count alone
    lost = (u * u - w * w - epsilon) / u
    viscous = max(float(np.mean(lost)), 0.0)
    return ImpactLaw(1.0, max(epsilon, 0.0), viscous, closest_delay(u, w, delay, np))


@compiled_quickly()
def tabulated(contact: Contact, mass_ng: Float[Array, ""]) -> TabulatedImpact:
    """Return the table of a contact's free collisions, differentiable in every parameter.

    Without a junction, or where collisions cannot be followed back, the table is of nothing: its lowest speed is one
    that no orbit reaches.

    Args:
        contact: the contact, of numbers.
        mass_ng: the tip's mass in ng.
    """
    junction = find_junction(contact)
    tip = free_tip(contact, junction, mass_ng)
    outer = tip.ends_nm
    taken = jnp.maximum(junction.hysteresis_aj, 1e-6)
    drawn = tip.potential(outer) - tip.potential(junction.breaks_gap_nm)
    scale = jnp.sqrt(2.0 * jnp.maximum(drawn, 0.25 * taken) / mass_ng)
    highest = FARTHEST * jnp.sqrt(2.0 * taken / mass_ng)
    excess = scale * jnp.sinh(stretched(highest / scale) * jnp.asarray(_PLACES))
    # the root of 0 has no derivative
    left = 0.5 * mass_ng * excess**2 + _barrier(tip)

    def back(tip, energies, rule):
        return jax.vmap(lambda energy: _traced_back(tip, energy, rule))(energies)

    u, time = back(tip, left, _USUAL)
    finer_u, finer_time = lax.stop_gradient(back(*lax.stop_gradient((tip, left[_COMPARED])), _FINER))
    lowest = u[0]
    # through values at places that the loss has shifted a little
    far = stretched(jnp.sqrt(jnp.maximum(u[1:] ** 2 - lowest**2, 1e-12)) / scale)
    place = jnp.concatenate([-jnp.ones(1), 2.0 * far / far[-1] - 1.0])
    loss, time_terms = jnp.linalg.solve(
        polynomials(place, TERMS), jnp.stack([u * u - 2.0 * left / mass_ng, time], axis=1)
    ).T
    sound = junction.exists & jnp.all(jnp.diff(u) > 0.0) & jnp.all(jnp.isfinite(loss) & jnp.isfinite(time_terms))
    delay = time[-1] - outer / jnp.sqrt(2.0 * left[-1] / mass_ng) - contact.bridge_forms_nm / u[-1]
    table = TabulatedImpact(
        loss=loss,
        time=time_terms,
        capture=jnp.where(sound, lowest, 1e6),
        scale=scale,
        end=far[-1],
        inner_nm=contact.bridge_forms_nm,
        outer_nm=outer,
        closest=HertzContact(delay * u[-1] ** 0.2, jnp.zeros(()), jnp.zeros(()), contact.bridge_breaks_nm),
        loss_error=_tail(loss),
        speed_error=largest(jnp.abs(finer_u / u[_COMPARED] - 1.0)),
        time_error=_tail(time_terms) + largest(jnp.abs(finer_time - time[_COMPARED])),
    )
    lead, raised = _lead_and_height(table)
    return replace(table, closest=table.closest._replace(lead_nm=lead, raised_nm=raised))


def _traced_back(tip: Driven, leaving_aj: Float[Array, ""], rule: _Rule) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the approach speed in nm/us of a tip that leaves with an energy, and how long its contact lasts, in us.

    Retraction, junction and approach are followed against time, so that drag returns the energy that it took.
    """
    nodes, iterations, junction_nodes = rule
    tip = tip._replace(bridge=tip.bridge.reversed())
    forms, ends = tip.forms_nm, tip.ends_nm
    on, off = tip.junction.forms_gap_nm, tip.junction.breaks_gap_nm
    margin = margin_of(leaving_aj, pull_at(tip, ends))
    retract = way_through(tip, (ends, off), leaving_aj, margin, inward=True)
    out = collocate(retract, nodes, iterations).passage
    formed = out.energy_aj + tip.elastic_aj
    inside = pass_through_junction(tip, formed, junction_nodes)
    arriving = formed + tip.potential(on) - tip.potential(forms)
    margin = margin_of(jnp.maximum(arriving, 0.0), pull_at(tip, forms))
    approach = collocate(way_through(tip, (forms, on), formed, margin, inward=False), nodes, iterations).passage
    speed = jnp.sqrt(2.0 * jnp.maximum(approach.energy_aj, 1e-12) / tip.mass_ng)
    return speed, out.time_us + inside.time_us + approach.time_us


def _barrier(tip: Driven) -> Float[Array, ""]:
    """Return the energy in aJ that a tip must leave with to have passed every barrier: 0 if the end is the highest.

    Drag, which a barrier spares the tip, is left out: with a barrier the table begins a little above capture.
    """
    fraction = jnp.asarray(np.linspace(0.0, 1.0, _BARRIER_GAPS))
    on, off, ends = tip.junction.forms_gap_nm, tip.junction.breaks_gap_nm, tip.ends_nm
    out = tip.potential(off * (ends / off) ** fraction) - tip.potential(ends)
    # the junction's fold stands as high as the bridge where it breaks; what it takes, the tip had before
    inward = tip.potential(on * (tip.forms_nm / on) ** fraction) - tip.potential(on)
    before = inward - tip.elastic_aj + tip.potential(off) - tip.potential(ends)
    return jnp.maximum(jnp.maximum(largest(out), largest(before)), 0.0)


def _lead_and_height(table: TabulatedImpact) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return b of the delay law a u^(-1/5) - b (1/w - 1/u) - d/u closest from 2 to 30 times the capture speed.

    And half of d at the last of them, for the table's own a.
    """
    u, w, delay = jax.vmap(table.speeds)(table.lowest * jnp.asarray(_LEAD_SPEEDS))
    terms = jnp.stack([u**-0.2, 1.0 / u - 1.0 / w, -1.0 / u], axis=1)
    scale = jnp.sqrt(jnp.sum(terms**2, axis=0))
    terms = terms / scale
    lead = jnp.linalg.solve(terms.T @ terms, terms.T @ delay)[1] / scale[1]
    early = table.closest.time(u) - delay - lead * (1.0 / w - 1.0 / u)
    return lead, 0.5 * (u * early)[-1]


def _tail(terms: Float[Array, " terms"]) -> Float[Array, ""]:
    """Return what the last terms add at most, which is more than what is missing beyond them."""
    return jnp.sum(jnp.abs(terms[-3:]))
