"""What a resolved contact does to the tip at an impact, as series over the approach speed, computed once by `collide`.

`TabulatedImpact` holds collisions of a free tip: Chebyshev series of the loss u_in^2 - u_out^2 and the time in contact.
`PulledImpact` holds taps of a bent lever, whose pull turns the tip as much as the sample does: series over speed and
pull. Both are an `Impact`, so that orbits and the prediction of a table's rows take them in place of a law; the series
are made in `contact/law_of_contact.py` and `contact/bent_lever.py`.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.impact.law import Impact, Speeds

_WRITTEN_OUT = 3
"""Steps of a series that are one round of a loop."""
_ROUNDING = 1e-12
NEAREST = 1.01
"""Approach speed in terms of the capture speed from which on a table's error is known."""


class Middle(NamedTuple):
    """Acceleration g of the tip relative to the platform at mid contact, in nm/us^2, and its time derivatives.

    ``change``, ``bend``, ``twist``: the first, second and third derivative.
    """

    acceleration: Float[Array, ""]
    change: Float[Array, ""]
    bend: Float[Array, ""] | float = 0.0
    twist: Float[Array, ""] | float = 0.0


class TabulatedImpact(Impact):
    """The loss u_in^2 - u_out^2 and the time in contact of free collisions as series; the coordinate is u_in.

    Both are smooth functions of the rebound speed down to 0, and so of v = sqrt(u_in^2 - capture^2): Chebyshev series
    in asinh(v/scale), which is v itself at capture and its logarithm far from it. The delay is the time in contact less
    what the straight paths take, outer/u_out + inner/u_in, and so as singular at capture as it is.

    Attributes:
        loss: coefficients of the loss in nm^2/us^2, shape (terms,).
        time: coefficients of the time in contact in us, shape (terms,).
        capture: speed in nm/us at which the tip is captured.
        scale: v in nm/us from which on the variable is a logarithm.
        end: asinh(v/scale) where the table ends; beyond, loss and delay are held.
        inner_nm: gap at which contact begins.
        outer_nm: gap at which contact ends.
        hertz: Hertz time at 1 nm/us, in us (nm/us)^0.2: that of the table's end, where nothing else is left.
        early_nm: lead b in nm of the delay formula that is closest to the delay.
        raised_nm: half the offset d in nm that is left then.
        length_nm: gap in nm at which the bridge breaks.
        loss_error: estimated error of the series for the loss, in nm^2/us^2.
        speed_error: estimated error of the approach speeds that it goes through, as a share.
        time_error: estimated error of the time in us.
    """

    loss: Float[Array, " terms"]
    time: Float[Array, " terms"]
    capture: Float[Array, ""]
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
    def lowest(self) -> Float[Array, ""]:
        """Speed in nm/us at which the tip is captured."""
        return self.capture

    @property
    def lead(self) -> Float[Array, ""]:
        """Length b in nm of the lead b (1/u_out - 1/u_in) of the delay formula closest to the delay."""
        return self.early_nm

    @property
    def raised(self) -> Float[Array, ""]:
        """Height in nm of the solid's surface over gap 0: half the offset of the delay formula closest to the delay."""
        return self.raised_nm

    @property
    def length(self) -> Float[Array, ""]:
        """Gap in nm at which the bridge breaks: over this length a leaving tip keeps its energy."""
        return self.length_nm

    @property
    def highest(self) -> Float[Array, ""]:
        """Approach speed in nm/us where the table ends."""
        return jnp.sqrt(self.lowest**2 + (self.scale * jnp.sinh(self.end)) ** 2)

    def hertz_time(self, approach_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the time in us that a Hertz contact as stiff as the table's end takes at a speed in nm/us."""
        return self.hertz * approach_speed**-0.2

    def speeds(self, coordinate: Float[Array, "..."]) -> Speeds:
        """Return approach and rebound speed in nm/us and the delay in us at the coordinate, the approach speed."""
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
        columns = ("terms", "low", "high")
        return replace(self, **{name: jnp.einsum("kp,pk...->k...", weights, getattr(self, name)) for name in columns})

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
"""Fraction of a table's pulls by which a pull may lie outside them."""
_PEAKED = 1.65
"""Depth of a tap over its mean depth: between those of a parabola and of a triangle."""
_NOWHERE_US = 1e3
"""Added to the delay where the table has no tap, so that no orbit closes there, in us."""


def polynomials(place: Float[Array, "..."], count: int) -> Float[Array, "... count"]:
    """Return Chebyshev's polynomials of the degrees 0 to count - 1 at places, held in [-1, 1]."""
    place = jnp.clip(place, -1.0, 1.0)

    def step(two_degrees, _):
        last, before = two_degrees
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


class PulledImpact(Impact):
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
    def lowest(self) -> Float[Array, ""]:
        """Approach speed in nm/us below which there are no taps: half the capture speed of a free tip."""
        return 0.5 * self.free.lowest

    @property
    def reach(self) -> Float[Array, ""]:
        """Distance in nm/us from the lowest speed over which adhesion counts: the capture speed of a free tip."""
        return self.free.lowest

    @property
    def lead(self) -> Float[Array, ""]:
        """Lead in nm that the delay contains: 0, because the time counts the way through the bridge."""
        return jnp.zeros_like(self.plane_nm)

    @property
    def raised(self) -> Float[Array, ""]:
        """Height in nm of the solid over the plane that the delay tells: 0, because the depth below it is tabulated."""
        return jnp.zeros_like(self.plane_nm)

    @property
    def length(self) -> Float[Array, ""]:
        """Gap in nm at which the bridge of a free tip breaks."""
        return self.free.length

    def hertz_time(self, approach_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the time in us that a Hertz contact of a free tip takes at a speed in nm/us."""
        return self.free.hertz_time(approach_speed)

    def speeds(self, coordinate: Float[Array, "..."]) -> Speeds:
        """Return speeds and time of a tap under a middling pull, or of the next that there is."""
        return self._nearest_tap(coordinate, jnp.sqrt(self.taps.pulls[0, 1] * self.taps.pulls[1, 1]))[0].speeds

    def tap(self, approach_speed: Float[Array, ""], pull: Float[Array, ""]) -> Tap:
        """Return a tap; one that does not exist has a time that no orbit has."""
        tap, exists = self._nearest_tap(approach_speed, pull)
        never = jnp.where(exists, 0.0, _NOWHERE_US * (1.0 + approach_speed))
        return tap._replace(speeds=tap.speeds._replace(delay=tap.speeds.delay + never))

    def during(self, approach_speed: Float[Array, ""], middle: Middle, cantilever: Cantilever) -> Tap:
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

        def evaluate(_, state):
            """Return the tap of a speed with its slope, and the speed that it says the mean one is."""
            speed = state[0]
            tap, slope = jax.jvp(lambda u: self.tap(u, pull), (speed,), (jnp.ones_like(speed),))
            mean = jnp.maximum(square + 0.5 * gained(tap), (0.1 * approach_speed) ** 2)
            return jnp.sqrt(mean), speed, tap, slope

        # a loop, because the program is compiled for every use of it
        nothing = Tap(Speeds(*(jnp.zeros_like(square),) * 3), *(jnp.zeros_like(square),) * 4)
        _, speed, tap, slope = lax.fori_loop(0, 2, evaluate, (approach_speed, approach_speed, nothing, nothing))
        mean = speed**2
        half, steep = 0.5 * tap.speeds.delay, 0.5 * slope.speeds.delay
        longer = -middle.bend * half**3 * (steep / 3.0 - half * (pull * steep - 1.0) / (12.0 * speed))
        longer = jnp.clip(longer, -0.2 * half, 0.2 * half)
        deepest = _PEAKED * tap.area / tap.speeds.delay
        left = tap.speeds.rebound**2 - mean + square + gained(tap)
        rebound = jnp.sqrt(jnp.maximum(left, (0.1 * tap.speeds.rebound) ** 2))
        area = tap.area + deepest * longer - 0.1 * middle.bend * half**5
        return tap._replace(speeds=Speeds(approach_speed, rebound, tap.speeds.delay + longer), area=area)

    def _nearest_tap(self, approach_speed: Float[Array, ""], pull: Float[Array, ""]) -> tuple[Tap, Bool[Array, ""]]:
        """Return a tap, or the next that there is, and whether it exists."""
        square = approach_speed**2
        taps = self.taps.at(pull)
        is_light, *is_hard = taps.holds(square, pull)
        parts = jnp.einsum("kn,knc->kc", polynomials(taps.place(square), taps.terms.shape[1]), taps.terms)
        loss, time, *others = jnp.where(is_hard[0], parts[1], jnp.where(is_hard[1], parts[2], parts[0]))
        rebound = jnp.sqrt(jnp.maximum(square - loss, 1e-6))
        return Tap(Speeds(approach_speed, rebound, time), *others), is_hard[0] | is_hard[1] | is_light


def chebyshev_sum(coefficients: Float[Array, " terms"], place: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the Chebyshev series at places in [-1, 1] by Clenshaw's recurrence."""

    def step(sums, coefficient):
        ahead, further = sums
        return (coefficient + 2.0 * place * ahead - further, ahead), None

    nothing = jnp.zeros_like(place)
    (ahead, further), _ = lax.scan(step, (nothing, nothing), coefficients[:0:-1], unroll=_WRITTEN_OUT)
    return coefficients[0] + place * ahead - further
