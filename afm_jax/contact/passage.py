"""The way through the liquid bridge, with the gap as independent variable.

Between its outer and its inner end the bridge is crossed monotonically, so that the gap D can replace time. With
x = ln D and the energy G = m w^2/2 + U(D), w the speed, the static forces leave the equation and only the small
dissipation is integrated: dG/dx = +-D damping(D) w, and dt/dx = -+D/w (in, out). Where the tip is slow at the outer
end, x = x_outer + b - y^2 takes the square root out of w; b is the distance of the turning point a slow tip would have
beyond that end, at most 1. Along the way y = y_start +- p, and both ways read alike:

    dG/dp = -2 y D damping(D) w,    dt/dp = 2 y D / w.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from afm_jax.contact.bridge import Bridge

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


class Way(NamedTuple):
    """A way through the bridge; made by `way_between`."""

    bridge: Bridge
    twice_inverse_mass: Float[Array, "..."]
    total_aj: Float[Array, "..."]
    """Energy at the start, kinetic and potential."""
    end_potential_aj: Float[Array, "..."]
    start_y: Float[Array, "..."]
    sense: float
    """+1 on the way in, -1 on the way out: y = start_y + sense p."""
    scale_nm: Float[Array, "..."]
    """Gap at y = 0."""
    length: Float[Array, "..."]
    """The range of p."""

    @property
    def inward(self) -> bool:
        """Whether the tip approaches."""
        return self.sense > 0.0

    def place(self, p: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return y and the gap at p."""
        y = self.start_y + self.sense * p
        return y, self.scale_nm * jnp.exp(-y * y)

    def available_aj(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the kinetic energy at a gap if nothing had been dissipated."""
        return self.total_aj - self.bridge.potential(gap)

    def rates(
        self, y: Float[Array, "..."], gap: Float[Array, "..."], kinetic: Float[Array, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the rates at which energy is dissipated and time passes, per unit of p; 0 where the tip is stopped."""
        moving = kinetic > 0.0
        speed = jnp.sqrt(jnp.where(moving, kinetic * self.twice_inverse_mass, 1.0))
        path = 2.0 * y * gap
        drag = path * self.bridge.damping(gap) * speed if not self.bridge.conserves else jnp.zeros_like(path)
        return jnp.where(moving, drag, 0.0), jnp.where(moving, path / speed, 0.0)

    def end(self, dissipated: Float[Array, "..."], time: Float[Array, "..."]) -> Passage:
        """Return the passage that dissipates so much and takes so long."""
        return Passage(self.total_aj - self.end_potential_aj - dissipated, time, dissipated)


def way_through(
    bridge: Bridge,
    mass_ng: Float[Array, "..."],
    gaps_nm: tuple[Float[Array, "..."], Float[Array, "..."]],
    start_energy_aj: Float[Array, "..."],
    margin: Float[Array, "..."],
    *,
    inward: bool,
) -> Way:
    """Return a way through the bridge.

    Args:
        bridge: the bridge.
        mass_ng: the tip's mass in ng.
        gaps_nm: the outer and the inner gap, whatever the direction.
        start_energy_aj: kinetic energy at the start.
        margin: b, how far beyond the outer end the speed would vanish, in ln D.
        inward: whether the tip goes from the outer to the inner gap.
    """
    outer, inner = gaps_nm
    at_outer, at_inner = jnp.sqrt(margin), jnp.sqrt(margin + jnp.log(outer / inner))
    potentials = bridge.potential(outer), bridge.potential(inner)
    start, end = potentials if inward else potentials[::-1]
    return Way(
        bridge=bridge,
        twice_inverse_mass=2.0 / mass_ng,
        total_aj=start_energy_aj + start,
        end_potential_aj=end,
        start_y=at_outer if inward else at_inner,
        sense=1.0 if inward else -1.0,
        scale_nm=outer * jnp.exp(margin),
        length=at_inner - at_outer,
    )


def margin_of(energy: Float[Array, "..."], pull: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return b for a kinetic energy at the outer end: energy over pull times gap there, between 0 and 1."""
    near = energy < pull
    return jnp.where(near, jnp.maximum(energy, _NEAREST * pull) / jnp.where(near, pull, 1.0), 1.0)
