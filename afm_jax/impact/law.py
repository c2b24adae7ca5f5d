"""The impact law: how fast the tip leaves for how fast it came, and how late.

The squared rebound speed of eq. 6, with the viscous loss that the liquid bridge adds (linear in speed):
u_out^2 = r^2 u_in^2 - c u_in - epsilon. All speeds are relative to the platform and positive.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.checks import as_argument, as_parameter, check_kind, check_parameter, readable


def squared_rebound_speed(
    approach_speed: ArrayLike, r: ArrayLike, epsilon: ArrayLike, viscous_loss: ArrayLike
) -> Float[Array, "..."]:
    """Return r^2 u^2 - c u - epsilon in nm^2/us^2; the tip is captured where it is not positive (eq. 6)."""
    u = as_argument(approach_speed)
    return (as_argument(r) * u) ** 2 - viscous_loss * u - epsilon


class Speeds(NamedTuple):
    """Approach and rebound speed in nm/us, collision delay in us."""

    approach: Float[Array, "..."]
    rebound: Float[Array, "..."]
    delay: Float[Array, "..."]


class CollisionDelay(eqx.Module):
    """Time between the crossings of gap 0 by the extrapolated paths in and out: a u^(-1/5) - b (1/w - 1/u) - d/u.

    Args:
        hertz: a, the Hertz contact time at 1 nm/us, in us (nm/us)^(1/5).
        lead_nm: b, by which a slower way out arrives early, in nm.
        offset_nm: d, offset of the contact surface from gap 0 (twice), in nm.
        corrections: whether the moving platform, the spring and the air act on the tip while it is in contact
            (`afm_jax.impact.lasting_impact`); False: every impact is that of a free tip on a sample at rest.

    Raises:
        ValueError: if a value is not finite.
        TypeError: if `corrections` is no truth value.
    """

    hertz: Float[Array, "..."] = eqx.field(converter=as_parameter)
    lead_nm: Float[Array, "..."] = eqx.field(converter=as_parameter)
    offset_nm: Float[Array, "..."] = eqx.field(converter=as_parameter)
    corrections: bool = eqx.field(static=True, default=True)

    __repr__ = readable

    def __check_init__(self):
        if not isinstance(self.corrections, bool):
            raise TypeError(f"`corrections` must be True or False, but is {self.corrections!r}")
        check_parameter("hertz", self.hertz, "finite")
        check_parameter("lead_nm", self.lead_nm, "finite")
        check_parameter("offset_nm", self.offset_nm, "finite")

    def __call__(self, approach_speed: ArrayLike, rebound_speed: ArrayLike) -> Float[Array, "..."]:
        """Return the delay in us for approach and rebound speeds in nm/us; negative where the lead wins."""
        u, w = as_argument(approach_speed), as_argument(rebound_speed)
        return self.hertz * u**-0.2 - self.lead_nm * (1.0 / w - 1.0 / u) - self.offset_nm / u

    def slope(
        self, approach_speed: ArrayLike, rebound_speed: ArrayLike, rebound_slope: ArrayLike
    ) -> Float[Array, "..."]:
        """Return d tau/d u in us^2/nm along a law with slope dw/du, all at one approach speed."""
        u, w = as_argument(approach_speed), as_argument(rebound_speed)
        hertz = -0.2 * self.hertz * u**-1.2
        return hertz + self.lead_nm * (rebound_slope / w**2 - 1.0 / u**2) + self.offset_nm / u**2


class ImpactLaw(eqx.Module):
    """The impact law of eq. 6 with viscous loss and collision delay; eq. 1 is `epsilon=0`.

    Its methods tell the impact of a free tip on a sample at rest; a delay with corrections adds to it what happens
    while the impact lasts (`afm_jax.impact.lasting_impact`).

    Args:
        r: coefficient of restitution, in [0, 1]; at 0 every impact is a capture.
        epsilon: loss by adhesion, 2 delta/m in nm^2/us^2 (= uJ/kg), not negative.
        viscous_loss: loss linear in speed, in nm/us, not negative.
        delay: a `CollisionDelay`, or None for instantaneous impacts.

    Raises:
        ValueError: if a value is outside its range.

    >>> import jax
    >>> with jax.enable_x64(True):
    ...     print(round(float(ImpactLaw(r=0.9, epsilon=19.0).rebound_speed(10.0)), 6))
    7.874008
    """

    r: Float[Array, "..."] = eqx.field(converter=as_parameter)
    epsilon: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    viscous_loss: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)
    delay: CollisionDelay | None = None

    __repr__ = readable

    def __check_init__(self):
        check_parameter("r", self.r, "in [0, 1]")
        check_parameter("epsilon", self.epsilon, "not negative")
        check_parameter("viscous_loss", self.viscous_loss, "not negative")
        check_kind("delay", self.delay, CollisionDelay | None)

    def captures(self, approach_speed: ArrayLike) -> Bool[Array, "..."]:
        """Say whether the tip stays at an approach speed in nm/us: the root's argument is not positive."""
        return squared_rebound_speed(approach_speed, self.r, self.epsilon, self.viscous_loss) <= 0.0

    @property
    def lasts(self) -> bool:
        """Whether impacts last: a delay, with the corrections of what happens meanwhile."""
        return self.delay is not None and self.delay.corrections

    @property
    def capture_speed_nm_per_us(self) -> Float[Array, "..."]:
        """Approach speed up to which the tip is captured: (c + sqrt(c^2 + 4 r^2 epsilon)) / 2 r^2, or infinite."""
        return self.approach_speed(jnp.zeros_like(self.r))

    def rebound_speed(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return u_out in nm/us for u_in in nm/us (eq. 6); 0 where the tip is captured."""
        square = squared_rebound_speed(approach_speed, self.r, self.epsilon, self.viscous_loss)
        free = square > 0.0
        return jnp.where(free, jnp.sqrt(jnp.where(free, square, 1.0)), 0.0)

    def rebound_slope(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return d u_out/d u_in = (2 r^2 u_in - c)/(2 u_out); 0 where the tip is captured."""
        u = as_argument(approach_speed)
        rebound = self.rebound_speed(u)
        free = rebound > 0.0
        return jnp.where(free, (2.0 * self.r**2 * u - self.viscous_loss) / (2.0 * jnp.where(free, rebound, 1.0)), 0.0)

    def approach_speed(self, rebound_speed: ArrayLike) -> Float[Array, "..."]:
        """Return the u_in in nm/us that leaves at u_out: the law read backwards; infinite at r = 0."""
        w = as_argument(rebound_speed)
        square = w * w + self.epsilon
        # double where: the root's slope is infinite at c = epsilon = w = 0, where the answer is 0 all the same
        discriminant = self.viscous_loss**2 + 4.0 * self.r**2 * square
        positive = discriminant > 0.0
        root = jnp.where(positive, jnp.sqrt(jnp.where(positive, discriminant, 1.0)), 0.0)
        leaves = self.r > 0.0
        return jnp.where(leaves, (self.viscous_loss + root) / (2.0 * jnp.where(leaves, self.r, 1.0) ** 2), jnp.inf)

    def energy_lost(self, approach_speed: ArrayLike, mass_ng: ArrayLike = 1.0) -> Float[Array, "..."]:
        """Return the energy an impact takes in aJ, m (u_in^2 - u_out^2)/2; all of it where the tip is captured."""
        u = as_argument(approach_speed)
        return 0.5 * as_argument(mass_ng) * (u * u - self.rebound_speed(u) ** 2)

    def collision_delay(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return the delay tau in us at an approach speed in nm/us; 0 without a delay or where captured."""
        u = as_argument(approach_speed)
        if self.delay is None:
            return jnp.zeros_like(u)
        rebound = self.rebound_speed(u)
        free = rebound > 0.0
        return jnp.where(free, self.delay(jnp.where(free, u, 1.0), jnp.where(free, rebound, 1.0)), 0.0)

    def delay_slope(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return d tau/d u_in in us^2/nm; 0 without a delay or where captured."""
        u = as_argument(approach_speed)
        if self.delay is None:
            return jnp.zeros_like(u)
        rebound = self.rebound_speed(u)
        free = rebound > 0.0
        u, rebound = jnp.where(free, u, 1.0), jnp.where(free, rebound, 1.0)
        return jnp.where(free, self.delay.slope(u, rebound, self.rebound_slope(u)), 0.0)


def impact_law_of(scene: Scene) -> ImpactLaw:
    """Return the scene's impact law.

    Raises:
        TypeError: if the scene's interaction is something else.
    """
    if not isinstance(scene.interaction, ImpactLaw):
        raise TypeError(
            f"the impact map needs a scene whose interaction is an ImpactLaw, not {type(scene.interaction).__name__}"
        )
    return scene.interaction


def capture_coordinate(law: ImpactLaw) -> Float[Array, ""]:
    """Return q in nm/us: the coordinate Y of `speeds_at` at which the tip is captured."""
    square = law.epsilon + (law.viscous_loss / (2.0 * law.r)) ** 2
    positive = square > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def speeds_at(coordinate: Float[Array, ""], law: ImpactLaw) -> Speeds:
    """Return the speeds and the delay at a coordinate Y > q in nm/us, in which the law is smooth up to capture.

    u = c/2r^2 + (Y + q^2/Y)/2r, w = (Y - q^2/Y)/2, q^2 = epsilon + c^2/4r^2.
    """
    square = law.epsilon + (law.viscous_loss / (2.0 * law.r)) ** 2
    middle = law.viscous_loss / (2.0 * law.r**2)
    # without a loss besides r the tip is captured at Y = 0, where the quotient is 0
    kept = square / jnp.where(coordinate == 0.0, 1.0, coordinate)
    approach = middle + (coordinate + kept) / (2.0 * law.r)
    rebound = 0.5 * (coordinate - kept)
    delay = jnp.zeros_like(approach) if law.delay is None else law.delay(approach, rebound)
    return Speeds(approach, rebound, delay)
