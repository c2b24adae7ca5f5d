"""How fast the motion of a tip in contact changes: the inverse of a step of the way in time."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from afm_jax.contact.forces import jkr
from afm_jax.motion.driven import Driven, Place

_SHARE = 0.4
"""Share of the gap where the junction forms: there the core's force varies in a fraction of the gap, 1 - this."""
_FROM_REST = 0.5


def bridge_pace(driven: Driven, place: Place, acceleration: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the pace of a tip in the bridge in 1/us.

    The root of the local stiffness over the mass, the speed over the distance in which the forces change, the root of
    the acceleration over it, and the frequencies of cantilever and drive, in squares.

    Args:
        driven: the equation of motion.
        place: where the tip is.
        acceleration: of the gap there, in nm/us^2.
    """
    nearest = driven.junction.forms_gap_nm
    gap = jnp.maximum(place.x, 0.3 * nearest)
    stiffness = jnp.abs(driven.bridge.stiffness(gap)) * driven.inverse_mass
    distance = jnp.maximum(gap - _SHARE * nearest, 0.3 * nearest)
    moving = (place.gap_rate / distance) ** 2 + _FROM_REST * jnp.abs(acceleration) / distance
    return jnp.sqrt(stiffness + moving + _drive_pace(driven) ** 2)


def junction_pace(driven: Driven, place: Place) -> Float[Array, "..."]:
    """Return the pace of a tip in the junction per unit of fictitious time, from the same three."""
    s = place.x
    cube = s**3
    curvature = s * s * (cube * (36.0 * cube - 42.0 * jkr.SLOPE) + 12.0)
    # where the curvature vanishes, at s = 1.196, its terms still tell how fast it comes back
    bent = jnp.maximum(jnp.abs(curvature), 0.3 * s * s * (36.0 * cube * cube + 12.0))
    elastic = bent * driven.load_scale_nn * driven.inverse_mass / driven.depth_scale_nm
    passing = 3.0 * place.gap_rate / (driven.depth_scale_nm * s)
    return 0.8 * jnp.sqrt(elastic + passing**2 + (_drive_pace(driven) * jkr.depth_slope(s)) ** 2)


def _drive_pace(driven: Driven) -> Array:
    return driven.cantilever.angular_frequency + driven.surface.fastest_angular_frequency
