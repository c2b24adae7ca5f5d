"""The law of a resolved contact as a function of its parameters: those that are fitted, and those that are held.

What is held is an unknown like any other, with a prior as wide as its error: law, band and intervals contain it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import DELAY_ERROR_US, SPEED_ERROR, tabulated
from afm_jax.contact.parameters import EFFECTS, PAPER
from afm_jax.impact.lasting_impact import TabulatedImpact
from afm_jax.impact.law_table import EXCESS, LawTable, coordinate_of, table_of, weights_at
from afm_jax.solve.lanes import compiled_quickly
from fitting.models import Held
from fitting.parameters import PARAMETERS
from fitting.predict.law import LawAt, LawModel


@dataclass(frozen=True, eq=False)
class ContactLawModel(LawModel):
    """The law of a contact.

    Attributes:
        own: the parameters that are fitted: logarithms, but for those of any sign.
        fixed: values of others that are not the paper's.
        held: those that are not fitted, with their errors.
        effects: that the contact has.
        mass_ng: of the tip.
    """

    own: tuple[str, ...]
    fixed: Mapping[str, float]
    held: tuple[Held, ...] = ()
    effects: tuple[str, ...] = EFFECTS
    mass_ng: float = 1.0
    lasting: bool = True
    _kept: dict[bytes, Any] = field(default_factory=dict)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The unknowns: what is fitted, then what is held, in standard errors."""
        return (*self.own, *(f"held {one.name}" for one in self.held))

    @property
    def length_nm(self) -> float:
        """Length over which a leaving tip keeps its energy: the gap at which the bridge breaks."""
        return float((PAPER | dict(self.fixed))["bridge_breaks_nm"])

    def value_of(self, name: str, unknown: Any) -> Any:
        """Return a parameter's value for its unknown."""
        parameter = PARAMETERS[name]
        return parameter.reference + parameter.width * unknown if parameter.width else np.exp(unknown)

    def unknown_of(self, name: str, value: Any) -> Any:
        """Return the unknown for a parameter's value."""
        parameter = PARAMETERS[name]
        return (value - parameter.reference) / parameter.width if parameter.width else np.log(value)

    def slope_of(self, name: str, unknown: float) -> float:
        """Return d value/d unknown of a parameter."""
        return PARAMETERS[name].width or float(self.value_of(name, unknown))

    def values(self, theta: Float[np.ndarray, " k"]) -> dict[str, float]:
        """Return the parameters that are fitted, by name."""
        return {name: float(self.value_of(name, y)) for name, y in zip(self.own, theta.tolist(), strict=False)}

    def _evaluated(self, theta: Float[np.ndarray, " k"]) -> Any:
        """Return w^2, T and the coefficients of the law at the knots, and all derivatives; kept for a while."""
        key = theta.tobytes()
        if key not in self._kept:
            while len(self._kept) > 3:
                del self._kept[next(iter(self._kept))]
            linear = np.array([(PARAMETERS[name].reference, PARAMETERS[name].width) for name in self.own])
            ends = [(PARAMETERS[one.name].lowest, PARAMETERS[one.name].highest) for one in self.held]
            held = np.array([(one.value, one.error, *end) for one, end in zip(self.held, ends, strict=True)])
            names = self.own, tuple(one.name for one in self.held), tuple(self.effects)
            fixed = {name: np.asarray(float(value)) for name, value in self.fixed.items() if name not in names[1]}
            found = _law(theta, linear, held.reshape(-1, 4), fixed, np.asarray(self.mass_ng), names=names)
            self._kept[key] = jax.tree.map(np.asarray, found)
        return self._kept[key]

    def at(self, theta: Float[np.ndarray, " k"], u: Float[np.ndarray, " n"]) -> LawAt:
        """Return the law at approach speeds in nm/us: its table there, and what that changes by."""
        (square, time, found), (square_slope, time_slope, _) = self._evaluated(theta)
        weights = weights_at(coordinate_of(u, float(found[4])))
        excess = np.maximum(u**2 - found[4] ** 2, 0.0)
        return LawAt(
            excess - weights @ (EXCESS**2 - square), weights @ time, weights @ square_slope, weights @ time_slope
        )

    def coefficients(self, theta: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " 4"], Float[np.ndarray, "4 k"]]:
        """Return a, b, d and f of the delay, and their derivatives by the unknowns."""
        (_, _, found), (_, _, slope) = self._evaluated(theta)
        return found[:4], slope[:4]

    def capture(self, theta: Float[np.ndarray, " k"]) -> float:
        """Return the capture speed in nm/us."""
        return float(self._evaluated(theta)[0][2][4])

    def capture_slope(self, theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Return the derivatives of the capture speed by the unknowns."""
        return self._evaluated(theta)[1][2][4]

    def table(self, theta: Float[np.ndarray, " k"]) -> LawTable:
        """Return the table."""
        (square, time, found), _ = self._evaluated(theta)
        return table_of(float(found[4]), square, time, found[:4], self.length_nm)

    def misses_accuracy(
        self, theta: Float[np.ndarray, " k"], approach: Float[np.ndarray, " rows"]
    ) -> Bool[np.ndarray, " rows"]:
        """Say at which approach speeds in nm/us the contact's own table misses its accuracy; not at NaN."""
        known = {name: jnp.asarray(value) for name, value in (dict(self.fixed) | self.values(theta)).items()}
        impact = tabulated(Contact.paper(effects=self.effects, **known), jnp.asarray(self.mass_ng))
        speed, delay = (np.asarray(part) for part in _errors(impact, jnp.asarray(approach)))
        return np.isfinite(approach) & ~((speed <= SPEED_ERROR) & (delay <= DELAY_ERROR_US))


_errors = jax.jit(TabulatedImpact.errors)


@compiled_quickly(static_argnames="names", level=0)
def _law(
    theta: Float[Array, " k"],
    linear: Float[Array, "own 2"],
    held: Float[Array, "held 4"],
    fixed: dict[str, Float[Array, ""]],
    mass_ng: Float[Array, ""],
    *,
    names: tuple[tuple[str, ...], ...],
):
    """Return w^2 and T at the knots, a, b, d, f and the capture speed; and their derivatives, those of w^2 at a speed.

    ``linear``: reference and width of parameters of any sign (width 0: logarithms); ``held``: values, errors, ranges.
    """
    own, of_held, effects = names

    def columns(theta):
        mine, others = theta[: len(own)], theta[len(own) :]
        free = jnp.where(linear[:, 1] != 0.0, linear[:, 0] + linear[:, 1] * mine, jnp.exp(mine))
        stays = jnp.clip(held[:, 0] + held[:, 1] * others, held[:, 2], held[:, 3])
        known = dict(zip(own, free, strict=True)) | dict(zip(of_held, stays, strict=True))
        impact = tabulated(Contact.paper(effects=effects, **(fixed | known)), mass_ng)
        capture = impact.capture
        u = jnp.sqrt(jax.lax.stop_gradient(capture) ** 2 + jnp.asarray(EXCESS[1:]) ** 2)
        at = jax.vmap(impact.speeds)(u)
        closest = impact.closest
        time = at.delay + closest.lead_nm * (1.0 / at.rebound - 1.0 / u)
        found = jnp.stack([closest.hertz, closest.lead_nm, 2.0 * closest.raised_nm, 0.0 * capture, capture])
        square = at.rebound**2
        # even in the coordinate at capture, where only the derivative of w^2 does not vanish
        first = (4.0 * square[0] - square[1]) / 3.0
        first = first - jax.lax.stop_gradient(first)
        law = jnp.append(first, square), jnp.append((4.0 * time[0] - time[1]) / 3.0, time), found
        return law, law

    slopes, law = jax.jacfwd(columns, has_aux=True)(theta)
    return law, slopes
