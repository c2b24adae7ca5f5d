"""An impact that lasts: what the platform's motion and the air do to a law and a delay while the tip is in contact.

A law and a delay are those of a free tip on a sample at rest. On a moving sample, in air, with a spring, small
corrections follow from the time courses of a Hertz contact and of a leaving tip, without a parameter of their own. With
the Hertz time tau = a u^(-1/5), the pull g away from the sample (the tip's acceleration against the platform) at mid
contact and its change j, kappa = g tau/u and J = j tau^2/u:

    duration              tau_d += (F(kappa) - 1 - 0.0393 (Omega tau)^2) tau
    indentation           its integral over time is H(kappa) (1 - 0.0836 (Omega tau)^2) u tau^2
    platform and spring   u_out^2 += 2 H(kappa) J u^2
    air damping           u_out^2 -= (10/9) (F(kappa) - 1.2 kappa H(kappa)) (Omega/Q) tau u^2
    lead                  a tip that leaves keeps its energy over a length, which acceleration makes it pass sooner

A delay whose offset is d is that of a surface d/2 above gap 0: the pull acts on the way there, and the tip is less deep
below gap 0 by as much. A lock-in at nu counts what happens away from mid contact less: an indentation by
0.0232 (nu tau)^2.

F and H are those of a Hertz contact under a constant pull, x'' = -x^(3/2) - kappa/3.2181, x(0) = 0, x'(0) = 1, whose
duration is 3.2181 F and whose integral of x is 3.2181^2 H; the energy that air takes follows from both (virial). The
spring, weak beside the contact, stiffens it and shortens it by the second of the terms.
Higher orders in J, below 0.03 as a rule, count nothing. Orbits over a driven platform have amplitudes within about
0.01 % of those of the full contact, within 1 % at twice the capture speed.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import Surface
from afm_jax.impact.law import Law, Speeds, TabulatedLaw

PULLS = (-3.0, 4.0)
"""Range of kappa in which F and H are right to 1e-6 of themselves; beyond, they are held."""
_LONGER = (
    -1.2740091939e-01,
    -2.7643573360e-03,
    -1.1402203184e-02,
    -1.1441397979e-03,
    -2.1476223117e-04,
    -1.2882289826e-05,
    4.0976707634e-08,
)
_DEEP = (
    2.1233502306e-01,
    -1.1340677163e-01,
    4.5405563844e-02,
    -9.9276086566e-03,
    1.4521926732e-03,
    -1.1934263418e-04,
    4.3544972221e-06,
)
_OVER = (
    1.0,
    -1.6357497828e-01,
    1.3651754937e-01,
    -4.8109292354e-03,
    3.7580487900e-03,
    1.2384808310e-04,
    1.4243711163e-05,
)
"""(F - 1)/kappa and H as quotients of polynomials in kappa, lowest power first (`tests/reference_hertz.py`)."""
AIR = 10.0 / 9.0
"""Twice the integral of the squared speed over a Hertz contact, over tau u^2."""
STIFFER = 3.9337034362e-02
"""Share by which a spring of its own frequency Omega shortens a Hertz contact, over (Omega tau)^2."""
SHALLOWER = 8.3576e-2
"""The same of the integral of its indentation."""
SPREAD = 4.6448e-2
"""Mean square of the time from mid contact, weighted by a Hertz contact's indentation, over tau^2."""
USUAL_LEAD = 1.3
"""Lead b of a tip that keeps its energy over a length, over that length: what comes closest for eight contacts."""

PASSES = 4
"""From the delay to mid contact and back."""
_SECANTS = 6
"""The same for a law that is a table, whose inverse is found along with it."""
_ROUNDING = 1e-12
NEAREST = 1.01
"""Approach speed in terms of the capture speed from which on a table's error is known."""


@runtime_checkable
class Impact(Protocol):
    """What an impact does to the tip, as functions of one coordinate that grows with the approach speed.

    Instantaneous, delayed, or lasting: delayed, with the corrections of what happens to the tip meanwhile.
    """

    @property
    def delayed(self) -> bool:
        """Whether the next flight begins at another time than the last one ends."""
        ...

    @property
    def lasts(self) -> bool:
        """Whether platform, spring and air act during the contact."""
        ...

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
    def raised(self) -> Float[Array, ""]:
        """Height in nm of the solid's surface over gap 0, as the delay tells it: half its offset."""
        ...

    @property
    def length(self) -> Float[Array, ""]:
        """Length in nm over which a leaving tip keeps its energy: the gap at which the bridge breaks."""
        ...

    def hertz_time(self, approach_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the time tau in us that a Hertz contact of the same stiffness would take."""
        ...

    def speeds(self, coordinate: Float[Array, ""]) -> Speeds:
        """Return speeds and delay at a coordinate, of a free tip on a sample at rest."""
        ...

    def at_approach(self, approach_speed: Float[Array, ""]) -> Speeds:
        """Return the same at an approach speed; a captured tip has no rebound and no delay."""
        ...


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
        raised_nm: half the offset d that is left then.
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
    raised_nm: Float[Array, ""]
    length_nm: Float[Array, ""]
    loss_error: Float[Array, ""]
    speed_error: Float[Array, ""]
    time_error: Float[Array, ""]

    @property
    def delayed(self) -> bool:
        """It takes time."""
        return True

    @property
    def lasts(self) -> bool:
        """And the tip is not alone meanwhile."""
        return True

    @property
    def reach(self) -> Float[Array, ""]:
        """The capture speed."""
        return self.lowest

    @property
    def highest(self) -> Float[Array, ""]:
        """Approach speed in nm/us where the table ends."""
        return jnp.sqrt(self.lowest**2 + (self.scale * jnp.sinh(self.end)) ** 2)

    def hertz_time(self, approach_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the Hertz time at a speed."""
        return self.hertz * approach_speed**-0.2

    @property
    def lead(self) -> Float[Array, ""]:
        """The lead b that comes closest to the delay, in nm."""
        return self.early_nm

    @property
    def raised(self) -> Float[Array, ""]:
        """Half the offset that comes closest to it."""
        return self.raised_nm

    @property
    def length(self) -> Float[Array, ""]:
        """Gap at which the bridge breaks."""
        return self.length_nm

    def speeds(self, coordinate: Float[Array, "..."]) -> Speeds:
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
        inside = (approach_speed > NEAREST * self.lowest) & (approach_speed <= (1.0 + _ROUNDING) * self.highest)
        late = self.time_error + self.outer_nm * share / w
        return jnp.where(inside, share, jnp.inf), jnp.where(inside, late, jnp.inf)

    def at_approach(self, approach_speed: Float[Array, ""]) -> Speeds:
        """Return what the table says of an approach speed."""
        return self.speeds(approach_speed)

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


class Taps(eqx.Module):
    """Taps as series over the speed with which they come, and over ln(g + more) of the pull g.

    Of three kinds: light, that the bridge turns round; hard; and hard under less pull than that, or pushed.

    Attributes:
        terms: coefficients of u_in^2 - u_out^2 and of the other numbers of `Tap`, shape (pulls, kinds, terms, 6).
        low: squared speed where they begin, coefficients of shape (pulls, kinds).
        high: where they end: the squared speed of light ones, of hard ones the variable.
        gaps: between which light ones turn, as a ratio.
        scale: speed of the hard ones' variable, in nm/us.
        pulls: weakest and strongest pull in nm/us^2, shape (2, kinds).
        more: what is added to pulls before their logarithms are taken, shape (kinds,).
    """

    terms: Float[Array, "..."]
    low: Float[Array, "..."]
    high: Float[Array, "..."]
    gaps: Float[Array, ""]
    scale: Float[Array, ""]
    pulls: Float[Array, "..."]
    more: Float[Array, "..."]

    def at(self, pull: Float[Array, ""]) -> "Taps":
        """Return the series over the speed alone, at a pull."""
        weakest, strongest = self.pulls
        held = jnp.clip(pull, weakest, strongest)
        first, last = weakest + self.more, strongest + self.more
        far = 2.0 * jnp.log((held + self.more) / first) / jnp.log(last / first) - 1.0
        weights = polynomials(far, self.low.shape[0])
        own = {name: jnp.einsum("kp,pk...->k...", weights, getattr(self, name)) for name in ("terms", "low", "high")}
        return replace(self, **own)

    def place(self, square: Float[Array, "..."]) -> Float[Array, " kinds"]:
        """Return where squared speeds, one or one a kind, lie in the series, -1 to 1; of a table at one pull."""
        # light ones by the gap where they turn, which is about linear in ln of what is left to the nearest
        square = jnp.broadcast_to(square, self.low.shape)
        left = jnp.clip((self.high[0] - square[0]) / (self.high[0] - self.low[0]), 0.0, 1.0)
        turned = 1.0 - 2.0 * jnp.log1p((self.gaps - 1.0) * left) / jnp.log(self.gaps)
        hard, low = square[1:], self.low[1:]
        beyond = hard > low
        v = jnp.sqrt(jnp.where(beyond, hard - low, 1.0)) / self.scale
        return jnp.append(turned, jnp.where(beyond, 2.0 * stretched(v) / self.high[1:] - 1.0, -1.0))

    def holds(self, square: Float[Array, ""], pull: Float[Array, ""]) -> Bool[Array, " kinds"]:
        """Say whether there are taps of each kind at a squared speed and a pull; of a table at that pull."""
        beside = _BESIDE * jnp.abs(self.pulls)
        first, end = self.pulls[0] - beside[0], self.pulls[1] + beside[1]
        # the two tables of hard ones meet where both are exact
        inside = (pull >= first.at[1].set(self.pulls[0, 1])) & (pull <= end.at[2].set(self.pulls[0, 1]))
        # next to the first hard tap the last light one holds
        last = jnp.where(self.low[1] < _NEXT * self.high[0], jnp.maximum(self.low[1], self.high[0]), self.high[0])
        end = jnp.append(square <= last, self.place(square)[1:] <= 1.0)
        return inside & (square >= self.low) & end


_NEXT = 1.02
"""Squared speed of the first hard tap over that of the last light one up to which there is none between."""
_BESIDE = 0.02
"""Share by which a pull may lie outside a table."""
_PEAKED = 1.65
"""Depth of a tap over its mean depth: between those of a parabola and of a triangle."""
_WRITTEN_OUT = 3
"""Steps of a series that are one round of a loop."""
_NOWHERE_US = 1e3
"""What the delay of a tap that does not exist is longer by, and more: no orbit has it."""


def polynomials(place: Float[Array, "..."], count: int) -> Float[Array, "... count"]:
    """Return Chebyshev's polynomials of the degrees 0 to count - 1 at places, held in [-1, 1]."""
    place = jnp.clip(place, -1.0, 1.0)

    def step(known, _):
        last, before = known
        return (2.0 * place * last - before, last), last

    first = jnp.ones_like(place)
    _, rest = lax.scan(step, (place, first), None, length=count - 1, unroll=_WRITTEN_OUT)
    return jnp.moveaxis(jnp.concatenate([first[None], rest]), 0, -1)


class Tap(NamedTuple):
    """What a tap does: speeds and time at the plane; time integrals of the depth below it and of the squared speed.

    ``late``: by how much the mean time of the depth is behind the middle of the tap, and ``spread``, in us^2, the mean
    square of that time.
    """

    speeds: Speeds
    area: Float[Array, "..."]
    action: Float[Array, "..."]
    late: Float[Array, "..."]
    spread: Float[Array, "..."]


class PulledImpact(eqx.Module):
    """Taps, light and hard, of a tip on a bent lever (`contact.bent_lever`); the coordinate is the speed at the plane.

    Attributes:
        taps: those under a pull.
        free: collisions of a free tip, at gap 0.
        plane_nm: gap of the plane, where the bridge breaks.
    """

    taps: Taps
    free: TabulatedImpact
    plane_nm: Float[Array, ""]

    @property
    def delayed(self) -> bool:
        """It takes time."""
        return True

    @property
    def lasts(self) -> bool:
        """And the tip is not alone meanwhile."""
        return True

    @property
    def lowest(self) -> Float[Array, ""]:
        """No tap comes slower."""
        return 0.5 * self.free.lowest

    @property
    def reach(self) -> Float[Array, ""]:
        """The capture speed of a free tip."""
        return self.free.lowest

    @property
    def lead(self) -> Float[Array, ""]:
        """None: the way through the bridge is part of the time."""
        return jnp.zeros_like(self.plane_nm)

    @property
    def raised(self) -> Float[Array, ""]:
        """None: the way below the plane is known."""
        return jnp.zeros_like(self.plane_nm)

    @property
    def length(self) -> Float[Array, ""]:
        """Gap at which the bridge breaks."""
        return self.free.length

    def hertz_time(self, approach_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the Hertz time at a speed."""
        return self.free.hertz_time(approach_speed)

    def speeds(self, coordinate: Float[Array, "..."]) -> Speeds:
        """Return speeds and time of a tap under a middling pull, or of the next that there is."""
        return self._found(coordinate, jnp.sqrt(self.taps.pulls[0, 1] * self.taps.pulls[1, 1]))[0].speeds

    def at_approach(self, approach_speed: Float[Array, ""]) -> Speeds:
        """Return the same."""
        return self.speeds(approach_speed)

    def tap(self, approach_speed: Float[Array, ""], pull: Float[Array, ""]) -> Tap:
        """Return a tap; one that does not exist has a time that no orbit has."""
        tap, exists = self._found(approach_speed, pull)
        never = jnp.where(exists, 0.0, _NOWHERE_US * (1.0 + approach_speed))
        return tap._replace(speeds=tap.speeds._replace(delay=tap.speeds.delay + never))

    def during(self, approach_speed: Float[Array, ""], middle: "Middle", cantilever: Cantilever) -> Tap:
        """Return a tap while the pull changes, in air.

        To first order what is odd about the middle of the tap, the air with it, makes the speeds differ, and leaves the
        rest as it is for the mean of their squares. What is even, bend t^2/2, shifts the ends: with h half the time,
        h' its slope by the speed and paths that move apart evenly outside the turn, the time grows by
        -bend h^3 (h'/3 - h (g h' - 1)/(12 u)), and the area by the depth times that, less bend h^5/10.
        """

        def gained(tap: Tap) -> Array:
            change = middle.change + 0.5 * middle.twist * tap.spread
            return 2.0 * (change * tap.area - 2.0 * cantilever.decay_rate * tap.action)

        pull, square = middle.acceleration, approach_speed**2

        def look(_, state):
            """Return the tap of a speed with its slope, and the speed that it says the mean one is."""
            speed = state[0]
            tap, slope = jax.jvp(lambda u: self.tap(u, pull), (speed,), (jnp.ones_like(speed),))
            mean = jnp.maximum(square + 0.5 * gained(tap), (0.1 * approach_speed) ** 2)
            return jnp.sqrt(mean), speed, tap, slope

        # a loop, because the program is compiled for every use of it
        nothing = Tap(Speeds(*(jnp.zeros_like(square),) * 3), *(jnp.zeros_like(square),) * 4)
        _, speed, tap, slope = lax.fori_loop(0, 2, look, (approach_speed, approach_speed, nothing, nothing))
        mean = speed**2
        half, steep = 0.5 * tap.speeds.delay, 0.5 * slope.speeds.delay
        longer = -middle.bend * half**3 * (steep / 3.0 - half * (pull * steep - 1.0) / (12.0 * speed))
        longer = jnp.clip(longer, -0.2 * half, 0.2 * half)
        deepest = _PEAKED * tap.area / tap.speeds.delay
        left = tap.speeds.rebound**2 - mean + square + gained(tap)
        rebound = jnp.sqrt(jnp.maximum(left, (0.1 * tap.speeds.rebound) ** 2))
        area = tap.area + deepest * longer - 0.1 * middle.bend * half**5
        return tap._replace(speeds=Speeds(approach_speed, rebound, tap.speeds.delay + longer), area=area)

    def _found(self, approach_speed: Float[Array, ""], pull: Float[Array, ""]) -> tuple[Tap, Bool[Array, ""]]:
        """Return a tap, or the next that there is, and whether it exists."""
        square = approach_speed**2
        taps = self.taps.at(pull)
        is_light, *is_hard = taps.holds(square, pull)
        parts = jnp.einsum("kn,knc->kc", polynomials(taps.place(square), taps.terms.shape[1]), taps.terms)
        loss, time, *others = jnp.where(is_hard[0], parts[1], jnp.where(is_hard[1], parts[2], parts[0]))
        rebound = jnp.sqrt(jnp.maximum(square - loss, 1e-6))
        return Tap(Speeds(approach_speed, rebound, time), *others), is_hard[0] | is_hard[1] | is_light


class Middle(NamedTuple):
    """The tip relative to the platform at mid contact: acceleration g in nm/us^2 and its first derivatives."""

    acceleration: Float[Array, ""]
    change: Float[Array, ""]
    bend: Float[Array, ""] | float = 0.0
    twist: Float[Array, ""] | float = 0.0


def middle_of_contact(cantilever: Cantilever, surface: Platform | Surface, time_us: Float[Array, "..."]) -> Middle:
    """Return the accelerations at mid contact.

    Args:
        cantilever: pulls at the tip by its spring and through the air.
        surface: moves.
        time_us: half a delay before the end of contact.
    """
    height, velocity = surface.position_and_velocity(time_us)
    acceleration = surface.acceleration(time_us)
    pull = cantilever.acceleration(height, velocity) - acceleration
    jerk, (snap, crackle) = _thrice(surface.jerk, time_us)
    pulled = cantilever.acceleration
    return Middle(
        pull, pulled(velocity, acceleration) - jerk, pulled(acceleration, jerk) - snap, pulled(jerk, snap) - crackle
    )


def _thrice(of: Callable[[Array], Array], at: Float[Array, "..."]) -> tuple[Array, tuple[Array, Array]]:
    """Return a function's value and its first two derivatives."""

    def twice(at):
        return jax.jvp(of, (at,), (jnp.ones_like(at),))

    (value, rate), (_, second) = jax.jvp(twice, (at,), (jnp.ones_like(at),))
    return value, (rate, second)


def hertz_under_pull(kappa: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return F and H of a Hertz contact under a constant pull: duration over tau, integral of depth over u tau^2."""
    kappa = jnp.clip(kappa, *PULLS)
    longer, deep, over = (_horner(series, kappa) for series in (_LONGER, _DEEP, _OVER))
    return 1.0 + kappa * longer / over, deep / over


def _horner(series: tuple[float, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    value = jnp.full_like(x, series[-1])
    for coefficient in series[-2::-1]:
        value = value * x + coefficient
    return value


def indentation(
    approach_speed: Float[Array, "..."],
    tau: Float[Array, "..."],
    middle: Middle,
    cantilever: Cantilever,
    nu: Float[Array, "..."] | float,
) -> Float[Array, "..."]:
    """Return the time integral of the indentation of a Hertz contact of a duration tau (us), in nm us.

    As a lock-in counts it that looks at an angular frequency nu in rad/us.
    """
    _, deep = hertz_under_pull(middle.acceleration * tau / approach_speed)
    missed = (SHALLOWER * cantilever.angular_frequency**2 + 0.5 * SPREAD * nu**2) * tau**2
    return deep * (1.0 - missed) * approach_speed * tau**2


def depth_of_impact(
    impact: Impact,
    approach_speed: Float[Array, "..."],
    middle: Middle,
    cantilever: Cantilever,
    nu: Float[Array, "..."] | float,
) -> Float[Array, "..."]:
    """Return the same of how deep the tip of an impact is below gap 0, beyond its flights to there and from there."""
    at_surface = speed_over(approach_speed, impact.raised, middle.acceleration)
    tau = impact.hertz_time(at_surface)
    lasts, _ = hertz_under_pull(middle.acceleration * tau / at_surface)
    # the parabolas between the surface and gap 0 are of the flight
    beside = 2.0 * impact.raised / (at_surface + approach_speed)
    flown = beside**2 * (at_surface + 2.0 * approach_speed) / 3.0
    return indentation(at_surface, tau, middle, cantilever, nu) - impact.raised * lasts * tau + flown


def gained_and_longer(
    approach_speed: Float[Array, ""], tau: Float[Array, ""], middle: Middle, cantilever: Cantilever
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return what a Hertz contact of a duration tau gains in squared speed, nm^2/us^2, and in duration, us."""
    pull, change = middle.acceleration * tau / approach_speed, middle.change * tau**2 / approach_speed
    lasts, deep = hertz_under_pull(pull)
    air = AIR * (lasts - 1.2 * jnp.clip(pull, *PULLS) * deep)
    gained = 2.0 * (deep * change - air * cantilever.decay_rate * tau)
    return gained * approach_speed**2, (lasts - 1.0 - STIFFER * (cantilever.angular_frequency * tau) ** 2) * tau


def corrected(free: Speeds, middle: Middle, cantilever: Cantilever, impact: Impact) -> Speeds:
    """Return rebound speed and delay on a moving platform.

    Args:
        free: speeds and delay of the free tip on a sample at rest.
        middle: accelerations at mid contact.
        cantilever: for the damping of the air.
        impact: for its Hertz time and its lead.
    """
    u, w = free.approach, free.rebound
    if isinstance(impact, PulledImpact):
        return impact.during(u, middle, cantilever).speeds
    pull, raised = middle.acceleration, impact.raised
    at_surface = speed_over(u, raised, pull)
    tau = impact.hertz_time(at_surface)
    gained, longer = gained_and_longer(at_surface, tau, middle, cantilever)
    rebound = jnp.sqrt(jnp.maximum(w**2 + gained, (0.1 * w) ** 2))
    longer = longer + tau - impact.hertz_time(u) - _lag(u, raised, pull) - _lag(w, raised, pull)
    held = _lag(w, impact.length, pull) - _lag(u, impact.length, pull)
    share = jnp.maximum(impact.lead, 0.0) / (USUAL_LEAD * impact.length)
    return Speeds(u, rebound, free.delay + longer - share * held)


def speeds_of_impact(
    impact: Impact,
    approach_speed: Float[Array, ""],
    arrival_us: Float[Array, ""],
    cantilever: Cantilever,
    surface: Platform | Surface,
) -> Speeds:
    """Return what an impact makes of a tip that arrives: the one answer of map, orbits, simulation and fit.

    Args:
        impact: instantaneous, delayed or lasting.
        approach_speed: u_in in nm/us, positive.
        arrival_us: when the free flight reaches the surface.
        cantilever: pulls at the tip meanwhile.
        surface: what it meets, moving.
    """
    free = impact.at_approach(approach_speed)
    if not impact.lasts:
        return free
    leaves = free.rebound > 0.0
    safe = Speeds(*(jnp.where(leaves, part, usual) for part, usual in zip(free, (1.0, 1.0, 0.0), strict=True)))
    found = lasting(safe, impact, arrival_us, cantilever, surface)
    return Speeds(approach_speed, *(jnp.where(leaves, part, 0.0) for part in found[1:]))


def crawls(impact: Impact, speeds: Speeds, cantilever: Cantilever) -> Bool[Array, "..."]:
    """Say whether a free tip's rebound is so slow that the tip stays: a bound on it that follows from the delay.

    The delay takes the way out as straight from gap 0, before the tip is there: by b (1/u_out - 1/u_in), without limit
    towards capture. Over a quarter of the free period no flight is straight; a tip that would need it does not come out
    of the bridge before the spring and the platform decide.

    Args:
        impact: for its lead b.
        speeds: of the free tip on a sample at rest; the tip leaves.
        cantilever: for its period.
    """
    early = jnp.maximum(impact.lead, 0.0) * (speeds.approach - speeds.rebound)
    return early > 0.5 * jnp.pi / cantilever.angular_frequency * speeds.approach * speeds.rebound


def lasting(
    free: Speeds,
    impact: Impact,
    arrival_us: Float[Array, ""],
    cantilever: Cantilever,
    surface: Platform | Surface,
) -> Speeds:
    """Return rebound speed and delay of an impact that lasts, from its arrival on.

    Mid contact is half a delay later, and the delay one that has its corrections: a few passes, each of which leaves a
    hundredth of the change or less.

    Args:
        free: speeds and delay of the free tip on a sample at rest; the tip leaves.
        impact: for its Hertz time and its lead.
        arrival_us: when the free flight reaches the surface.
        cantilever: pulls at the tip by its spring and through the air.
        surface: moves.
    """

    def correct(_, speeds: Speeds) -> Speeds:
        middle = middle_of_contact(cantilever, surface, arrival_us + 0.5 * speeds.delay)
        return corrected(free, middle, cantilever, impact)

    # a loop, because the program is compiled for every use of it
    return lax.fori_loop(0, PASSES, correct, free)


def delay_before(
    law: Law,
    rebound_speed: Float[Array, ""],
    leaving_us: Float[Array, ""],
    cantilever: Cantilever,
    surface: Platform | Surface,
) -> Float[Array, ""]:
    """Return the delay of the impact that a tip leaves with a rebound speed in nm/us: the map read backwards, in us.

    Arguments as above; ``leaving_us`` is the end of contact. A tip that does not leave has none.
    """
    leaves = rebound_speed > 0.0
    rebound = jnp.where(leaves, rebound_speed, 1.0)
    if isinstance(law, TabulatedLaw):
        return jnp.where(leaves, _delay_of_table(law, rebound, leaving_us, cantilever, surface), 0.0)

    def of_free(free_rebound: Float[Array, ""]) -> Speeds:
        approach = law.approach_speed(free_rebound)
        return Speeds(approach, free_rebound, law.collision_delay(approach))

    def improve(_, state: Speeds) -> Speeds:
        free = of_free(state.rebound)
        middle = middle_of_contact(cantilever, surface, leaving_us - 0.5 * state.delay)
        found = corrected(free, middle, cantilever, law)
        square = free.rebound**2 + rebound**2 - found.rebound**2
        return Speeds(free.approach, jnp.sqrt(jnp.maximum(square, (0.1 * rebound) ** 2)), found.delay)

    begin = of_free(rebound)
    found = lax.fori_loop(0, PASSES, improve, begin) if law.lasts else begin
    return jnp.where(leaves, found.delay, 0.0)


def _delay_of_table(
    law: TabulatedLaw,
    rebound: Float[Array, ""],
    leaving_us: Float[Array, ""],
    cantilever: Cantilever,
    surface: Platform | Surface,
) -> Float[Array, ""]:
    """Return `delay_before` of a law that is a table: by secants in ln v, one look at the table each."""

    def improve(_, state: tuple[Array, ...]) -> tuple[Array, ...]:
        place, before, missed, delay = state
        v = jnp.exp(place)
        found = law.beyond_capture(jnp.sqrt(v * v + law.capture**2), v)
        if law.lasts:
            middle = middle_of_contact(cantilever, surface, leaving_us - 0.5 * delay)
            found = corrected(found, middle, cantilever, law)
        miss = jnp.log(found.rebound / rebound)
        apart = place - before
        # about 1: the rebound is nearly in proportion to v
        slope = jnp.clip((miss - missed) / jnp.where(apart == 0.0, 1.0, apart), 0.5, 2.0)
        slope = jnp.where(apart == 0.0, 1.0, slope)
        return place - miss / slope, place, miss, found.delay

    begin = jnp.log(rebound / law.r)
    nothing = jnp.zeros_like(begin)
    return lax.fori_loop(0, _SECANTS, improve, (begin, begin, nothing, nothing))[-1]


def _lag(speed: Float[Array, ""], length: Float[Array, ""], acceleration: Float[Array, ""]) -> Float[Array, ""]:
    """Return by how much a length takes longer at constant acceleration than without, in us."""
    return 2.0 * length / (speed_over(speed, length, acceleration) + speed) - length / speed


def speed_over(
    speed: Float[Array, "..."], length: Float[Array, "..."], acceleration: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the speed at the end of a length in nm at constant acceleration, in nm/us."""
    return jnp.sqrt(jnp.maximum(speed**2 + 2.0 * acceleration * length, (0.1 * speed) ** 2))


def chebyshev_sum(coefficients: Float[Array, " terms"], place: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the Chebyshev series at places in [-1, 1] by Clenshaw's recurrence."""

    def step(sums, coefficient):
        ahead, further = sums
        return (coefficient + 2.0 * place * ahead - further, ahead), None

    nothing = jnp.zeros_like(place)
    (ahead, further), _ = lax.scan(step, (nothing, nothing), coefficients[:0:-1], unroll=_WRITTEN_OUT)
    return coefficients[0] + place * ahead - further
