"""The way through the liquid bridge, with the gap as independent variable.

Between its outer and its inner end the bridge is crossed monotonically, so that the gap D can replace time. With
x = ln D and the energy G = m w^2/2 + U(D), w the speed, the static forces leave the equation and only the small
dissipation is integrated: dG/dx = +-D damping(D) w, and dt/dx = -+D/w (in, out). Where the tip is slow at the outer end,
x = x_outer + b - y^2 takes the square root out of w; b is the distance of the turning point that a slow tip would have
beyond that end, at most 1. Along the way y = y_start + direction * p, both ways read alike:

    dG/dp = -2 y D damping(D) w,    dt/dp = 2 y D / w.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from afm_jax.contact.forces.force import ForceSum

_NEAREST = 1e-14
"""Lower bound of b: at 0 speed and square root would vanish together."""


class Passage(NamedTuple):
    """What a way through the bridge ends with."""

    energy_aj: Float[Array, "..."]
    """Kinetic energy at the end, signed: negative by what is missing where the tip does not get there."""
    time_us: Float[Array, "..."]
    """Time taken; meaningless where the energy is not positive."""
    dissipated_aj: Float[Array, "..."]
    """Energy that the dissipative forces took."""


class Way(eqx.Module):
    """A way through the bridge, from a kinetic energy at its start.

    Args:
        forces: the bridge's forces.
        mass_ng: the tip's mass in ng.
        outer_gap_nm: the end far from the sample.
        inner_gap_nm: the end close to it.
        start_energy_aj: kinetic energy at the start.
        margin: b, how far beyond the outer end the speed would vanish, in ln D.
        inward: whether the tip approaches.
    """

    forces: ForceSum
    mass_ng: Float[Array, "..."]
    outer_gap_nm: Float[Array, "..."]
    inner_gap_nm: Float[Array, "..."]
    start_energy_aj: Float[Array, "..."]
    margin: Float[Array, "..."]
    inward: bool = eqx.field(static=True)

    @property
    def span(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """y at the outer and at the inner end."""
        width = jnp.log(self.outer_gap_nm / self.inner_gap_nm)
        return jnp.sqrt(self.margin), jnp.sqrt(self.margin + width)

    @property
    def length(self) -> Float[Array, "..."]:
        """The range of p."""
        outer, inner = self.span
        return inner - outer

    @property
    def start_potential_aj(self) -> Float[Array, "..."]:
        """Potential at the start."""
        return self.forces.potential(self.outer_gap_nm if self.inward else self.inner_gap_nm)

    def place(self, p: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return y and the gap at p."""
        outer, inner = self.span
        y = outer + p if self.inward else inner - p
        return y, self.outer_gap_nm * jnp.exp(self.margin - y * y)

    def available_aj(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the kinetic energy at a gap if nothing had been dissipated."""
        return self.start_energy_aj + self.start_potential_aj - self.forces.potential(gap)

    def speed(self, kinetic: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the speed of a kinetic energy; 0 where it is not positive."""
        moving = kinetic > 0.0
        return jnp.where(moving, jnp.sqrt(jnp.where(moving, 2.0 * kinetic / self.mass_ng, 1.0)), 0.0)

    def rates(
        self, y: Float[Array, "..."], gap: Float[Array, "..."], kinetic: Float[Array, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the rates at which energy is dissipated and time passes, per unit of p."""
        moving = kinetic > 0.0
        speed = jnp.sqrt(jnp.where(moving, 2.0 * kinetic / self.mass_ng, 1.0))
        path = 2.0 * y * gap
        loss = jnp.where(moving, path * self.forces.damping(gap) * speed, 0.0)
        return loss, jnp.where(moving, path / speed, 0.0)

    def end(self, dissipated: Float[Array, "..."], time: Float[Array, "..."]) -> Passage:
        """Return the passage that dissipates so much and takes so long."""
        gap = self.inner_gap_nm if self.inward else self.outer_gap_nm
        return Passage(self.available_aj(gap) - dissipated, time, dissipated)


def margin_of(energy: Float[Array, "..."], forces: ForceSum, outer_gap_nm: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return b for a kinetic energy at the outer end: energy over (pull times gap), between 0 and 1."""
    pull = -forces.static(outer_gap_nm) * outer_gap_nm
    near = energy < pull
    return jnp.where(near, jnp.maximum(energy, _NEAREST * pull) / jnp.where(near, pull, 1.0), 1.0)
