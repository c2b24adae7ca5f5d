"""An impact that lasts: what the platform's motion and the air do to a law and a delay while the tip is in contact.

A law and a delay are those of a free tip on a sample at rest. On a moving sample, in air, with a spring, small
corrections follow from the time courses of a Hertz contact and of a leaving tip, without a parameter of their own. With
the Hertz time tau = a u^(-1/5), the tip's acceleration g relative to the platform at mid contact and its change j,
G = g tau/u and J = j tau^2/u:

    platform and spring   u_out^2 += (0.4247 J - 0.157 G J + 0.027 J^2) u^2
    air damping           u_out^2 -= (10/9) (Omega/Q) tau u^2
    duration              tau_d += (-0.1274 G - 0.0213 J - 0.0234 G^2 + 0.0267 G J) tau
    lead                  a tip that leaves keeps its energy over a length, which acceleration makes it pass sooner

The numbers are those of the Hertz contact, d'' = (-d)^(3/2) + g + j t for the gap d, fitted over |G|, |J| < 0.35. They
bring amplitudes from 0.2-0.7 % to about 0.01 % of those of the full contact, to 1 % at twice the capture speed.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.impact.jacobian import LawWithSlopes
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.orbit_closure import Speeds, capture_coordinate, speeds_at

HERTZ = np.array([0.4247, -0.157, 0.027])
"""Gain of the squared speed, over u^2, by J, G J and J^2."""
LONGER = np.array([-0.1274, -0.0213, -0.0234, 0.0267])
"""Lengthening of the contact, over tau, by G, J, G^2 and G J."""
AIR = 10.0 / 9.0
"""Twice the integral of the squared speed over a Hertz contact, over tau u^2."""
INDENTATION = 0.2123
"""Time integral of the indentation of a Hertz contact, over tau^2 u."""
BRIDGE_NM = 4.7
"""Length in nm over which a leaving tip keeps its energy, where nothing says it: the paper's bridge."""
USUAL_LEAD = 1.3
"""Lead b of a tip that keeps its energy over a length, over that length: what comes closest for eight contacts."""

NEAREST = 1.01
"""Approach speed in terms of the capture speed from which on a table's error is known."""


@runtime_checkable
class LastingImpact(LawWithSlopes, Protocol):
    """A law and a delay, as functions of one coordinate that grows with the approach speed."""

    @property
    def lowest(self) -> Float[Array, ""]:
        """Coordinate at which the tip is captured, in nm/us."""
        ...

    @property
    def reach(self) -> Float[Array, ""]:
        """Distance from the lowest coordinate over which the law changes its character, in nm/us."""
        ...

    @property
    def lead(self) -> Float[Array, ""]:
        """Length b in nm of the lead b (1/u_out - 1/u_in) that the delay contains."""
        ...

    @property
    def length(self) -> Float[Array, ""]:
        """Length in nm over which a leaving tip keeps its energy: the gap at which the bridge breaks."""
        ...

    def hertz_time(self, approach_speed: Float[Array, ""]) -> Float[Array, ""]:
        """Return the time tau in us that a Hertz contact of the same stiffness would take."""
        ...

    def speeds(self, coordinate: Float[Array, ""]) -> Speeds:
        """Return approach and rebound speed and the delay at a coordinate."""
        ...


class LawImpact(eqx.Module):
    """An `ImpactLaw` as a lasting impact; its coordinate Y is that of `orbit_closure`."""

    law: ImpactLaw

    @property
    def lowest(self) -> Float[Array, ""]:
        """Y at which the tip is captured."""
        return capture_coordinate(self.law)

    @property
    def reach(self) -> Float[Array, ""]:
        """The same: adhesion counts up to twice the capture speed."""
        return capture_coordinate(self.law)

    @property
    def lead(self) -> Float[Array, ""]:
        """The delay's lead in nm."""
        return jnp.zeros_like(self.law.r) if self.law.delay is None else self.law.delay.lead_nm

    @property
    def length(self) -> Float[Array, ""]:
        """That of the paper's bridge."""
        return jnp.full_like(self.law.r, BRIDGE_NM)

    def hertz_time(self, approach_speed: Float[Array, ""]) -> Float[Array, ""]:
        """Return a u^(-1/5) of the delay."""
        hertz = jnp.zeros_like(self.law.r) if self.law.delay is None else self.law.delay.hertz
        return hertz * approach_speed**-0.2

    def speeds(self, coordinate: Float[Array, ""]) -> Speeds:
        """Return approach and rebound speed and the delay at Y."""
        return speeds_at(coordinate, self.law)

    def rebound_slope(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return d u_out/d u_in of the law."""
        return self.law.rebound_slope(approach_speed)

    def delay_slope(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return d tau/d u_in of the law."""
        return self.law.delay_slope(approach_speed)

    def collision_delay(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return the law's delay."""
        return self.law.collision_delay(approach_speed)


class TabulatedImpact(eqx.Module):
    """The loss u_in^2 - u_out^2 and the time in contact of free collisions as series; the coordinate is u_in.

    Both are smooth functions of the rebound speed down to 0, and so of v = sqrt(u_in^2 - lowest^2): Chebyshev series
    in asinh(v/scale), which is v itself at capture and its logarithm far from it. The delay is the time in contact less
    what the straight paths take, outer/u_out + inner/u_in, and so as singular at capture as it is.

    Attributes:
        loss: coefficients of the loss in nm^2/us^2, shape (terms,).
        time: coefficients of the time in contact in us, shape (terms,).
        lowest: speed in nm/us at which the tip is captured.
        scale: v in nm/us from which on the variable is a logarithm.
        end: asinh(v/scale) where the table ends; beyond, loss and delay are held.
        inner_nm: gap at which contact begins.
        outer_nm: gap at which contact ends.
        hertz: Hertz time at 1 nm/us, in us (nm/us)^0.2: that of the table's end, where nothing else is left.
        early_nm: lead b of the delay law that is closest to the delay.
        length_nm: gap at which the bridge breaks.
        loss_error: estimated error of the series for the loss, in nm^2/us^2.
        speed_error: estimated error of the approach speeds that it goes through, as a share.
        time_error: estimated error of the time in us.
    """

    loss: Float[Array, " terms"]
    time: Float[Array, " terms"]
    lowest: Float[Array, ""]
    scale: Float[Array, ""]
    end: Float[Array, ""]
    inner_nm: Float[Array, ""]
    outer_nm: Float[Array, ""]
    hertz: Float[Array, ""]
    early_nm: Float[Array, ""]
    length_nm: Float[Array, ""]
    loss_error: Float[Array, ""]
    speed_error: Float[Array, ""]
    time_error: Float[Array, ""]

    @property
    def reach(self) -> Float[Array, ""]:
        """The capture speed."""
        return self.lowest

    @property
    def highest(self) -> Float[Array, ""]:
        """Approach speed in nm/us where the table ends."""
        return jnp.sqrt(self.lowest**2 + (self.scale * jnp.sinh(self.end)) ** 2)

    def hertz_time(self, approach_speed: Float[Array, ""]) -> Float[Array, ""]:
        """Return the Hertz time at a speed."""
        return self.hertz * approach_speed**-0.2

    @property
    def lead(self) -> Float[Array, ""]:
        """The lead b that comes closest to the delay, in nm."""
        return self.early_nm

    @property
    def length(self) -> Float[Array, ""]:
        """Gap at which the bridge breaks."""
        return self.length_nm

    def speeds(self, coordinate: Float[Array, ""]) -> Speeds:
        """Return approach and rebound speed and the delay at u_in."""
        u = coordinate
        place = self._place(u)
        loss = chebyshev_sum(self.loss, place)
        inside = jnp.minimum(u, self.highest)
        straight = self.outer_nm / _rebound(inside, loss) + self.inner_nm / inside
        return Speeds(u, _rebound(u, loss), chebyshev_sum(self.time, place) - straight)

    def errors(self, approach_speed: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the estimated errors of the rebound speed, as a share of it, and of the delay in us.

        Infinite outside the table: up to 1 % above capture, and beyond its end.
        """
        w = self.speeds(approach_speed).rebound
        share = (0.5 * self.loss_error + self.speed_error * approach_speed**2) / w**2
        inside = (approach_speed > NEAREST * self.lowest) & (approach_speed <= self.highest)
        late = self.time_error + self.outer_nm * share / w
        return jnp.where(inside, share, jnp.inf), jnp.where(inside, late, jnp.inf)

    def rebound_slope(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return d u_out/d u_in."""
        return self._slopes(approach_speed).rebound

    def delay_slope(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return d tau/d u_in in us^2/nm."""
        return self._slopes(approach_speed).delay

    def collision_delay(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return the delay in us."""
        return self.speeds(jnp.asarray(approach_speed)).delay

    def _slopes(self, approach_speed: ArrayLike) -> Speeds:
        u = jnp.asarray(approach_speed)
        return jax.jvp(self.speeds, (u,), (jnp.ones_like(u),))[1]

    def _place(self, u: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return where a speed lies in the table, -1 to 1."""
        free = u > self.lowest
        square = jnp.where(free, u * u - self.lowest**2, 1.0)
        far = jnp.where(free, stretched(jnp.sqrt(square) / self.scale), 0.0)
        return jnp.minimum(2.0 * far / self.end - 1.0, 1.0)


def stretched(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return asinh(x) for x >= 0, to the rounding of 1; the library's own costs more."""
    return jnp.log(x + jnp.sqrt(x * x + 1.0))


def _rebound(u: Float[Array, "..."], loss: Float[Array, "..."]) -> Float[Array, "..."]:
    # a captured tip has a crawling rebound: far from any orbit that was measured
    return jnp.sqrt(jnp.maximum(u * u - loss, 1e-6))


class Middle(NamedTuple):
    """The tip relative to the platform at mid contact: acceleration g in nm/us^2 and its change j in nm/us^3."""

    acceleration: Float[Array, ""]
    change: Float[Array, ""]


def middle_of_contact(
    cantilever: Cantilever,
    platform: Platform,
    cosine: Float[Array, ""],
    sine: Float[Array, ""],
    delay: Float[Array, ""],
) -> Middle:
    """Return the accelerations half a delay before the end of contact.

    Args:
        cantilever: pulls at the tip by its spring and through the air.
        platform: moves.
        cosine: of the drive's phase at the end of contact.
        sine: of it.
        delay: time in contact in us.
    """
    omega, beta = platform.angular_frequency, platform.amplitude_nm
    turn = 0.5 * omega * delay
    c, s = jnp.cos(turn), jnp.sin(turn)
    cosine, sine = cosine * c + sine * s, sine * c - cosine * s
    height = platform.offset_nm + beta * cosine
    velocity, acceleration = -beta * omega * sine, -beta * omega**2 * cosine
    pull = -(cantilever.angular_frequency**2) * height - 2.0 * cantilever.decay_rate * velocity - acceleration
    return Middle(pull, -beta * omega**3 * sine)


def corrected(free: Speeds, middle: Middle, cantilever: Cantilever, impact: LastingImpact) -> Speeds:
    """Return rebound speed and delay on a moving platform.

    Args:
        free: speeds and delay of the free tip on a sample at rest.
        middle: accelerations at mid contact.
        cantilever: for the damping of the air.
        impact: for its Hertz time and its lead.
    """
    u, tau = free.approach, impact.hertz_time(free.approach)
    pull, change = middle.acceleration * tau / u, middle.change * tau**2 / u
    gained = HERTZ[0] * change + HERTZ[1] * pull * change + HERTZ[2] * change**2
    gained = gained - (2.0 * AIR) * cantilever.decay_rate * tau
    square = free.rebound**2 + gained * u**2
    rebound = jnp.sqrt(jnp.maximum(square, (0.1 * free.rebound) ** 2))
    longer = LONGER[0] * pull + LONGER[1] * change + LONGER[2] * pull**2 + LONGER[3] * pull * change
    held = _lag(free.rebound, impact.length, middle.acceleration) - _lag(u, impact.length, middle.acceleration)
    share = jnp.maximum(impact.lead, 0.0) / (USUAL_LEAD * impact.length)
    return Speeds(u, rebound, free.delay + longer * tau - share * held)


def _lag(speed: Float[Array, ""], length: Float[Array, ""], acceleration: Float[Array, ""]) -> Float[Array, ""]:
    """Return by how much a length takes longer at constant acceleration than without, in us."""
    square = speed**2 + 2.0 * acceleration * length
    end = jnp.sqrt(jnp.maximum(square, (0.1 * speed) ** 2))
    return 2.0 * length / (end + speed) - length / speed


def chebyshev_sum(coefficients: Float[Array, " terms"], place: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the Chebyshev series at places in [-1, 1] by Clenshaw's recurrence."""
    ahead, further = jnp.zeros_like(place), jnp.zeros_like(place)
    for k in range(coefficients.shape[0] - 1, 0, -1):
        ahead, further = coefficients[k] + 2.0 * place * ahead - further, ahead
    return coefficients[0] + place * ahead - further
