"""An impact that lasts: what the platform's motion, the spring and the air do to the tip while it is in contact.

Takes speeds in nm/us and delay in us of a free tip, cantilever and surface; gives those of the lasting impact.

A law tells rebound speed w and delay of a free tip that arrives with speed u at a sample at rest. On a moving platform,
in air, the contact is that of Hertz with a pull. With the Hertz time tau = a u^(-1/5), the indentation x, and the
acceleration g + j t that spring, air and platform give the tip relative to the platform (positive: away from the
sample, t from mid contact, j called `change`),

    x'' = -c x^(3/2) - g - j t,   x = 0 and x' = u at first touch;   kappa = g tau/u,  J = j tau^2/u,

c the contact's stiffness over the mass, which tau tells.

A constant pull is exact: the contact takes F(kappa) tau and the integral of its indentation is H(kappa) u tau^2 (scaled
to x'' = -x^(3/2) - kappa/3.2181 with x'(0) = 1, they are 3.2181 F and 3.2181^2 H). All else counts to first order:

    energy      w^2 grows by 2 H J u^2, the work of j t along the path (by parts, j times the integral of x),
                and by -(10/9) (F - 1.2 kappa H) (Omega/Q) tau u^2 in the air: the mean squared speed, by the virial;
                between solid and gap 0 flights lose (Omega/Q) d (u + w) of that already; a bridge, which makes the tip
                faster, costs 1.74 (Omega/Q) b (u - w) more, and the solid twice the fraction of its depth below
    duration    grows by (F - 1 - 0.0393 (Omega tau)^2) tau: the spring, weak beside the contact, stiffens it
    depth       the integral of the indentation is H (1 - 0.0836 (Omega tau)^2) u tau^2; a lock-in at nu counts what
                happens away from mid contact less, by 0.0232 (nu tau)^2. The bridge, whose lead is b (1/w - 1/u), keeps
                the tip below its straight paths, by 0.30 l times the lead, and lets it meet the solid faster, which
                deepens H u tau^2 by the fraction 0.81 (b/l) (1 - w^2/u^2)
    lead        a leaving tip keeps its energy over a length l, and b (1/w - 1/u) of the delay stands for that; under
                g it passes l in another time, and the delay grows by (b/(1.3 l)) (lag(u) - lag(w)), where
                lag(v) = 2 l/(v + sqrt(v^2 + 2 g l)) - l/v

A delay with an offset d is that of a surface d/2 above gap 0: the pull acts on the way there, and the tip is less deep
below gap 0 by as much. Mid contact is half a delay after the arrival, so that delay and pull are found in a few passes.
The corrections have no parameter of their own. Terms of higher order in J, which is below 0.03 as a rule, are left out;
amplitudes of orbits over a driven platform are within about 0.01 % of those of the full contact, within 1 % at twice
the capture speed.

`speeds_of_impact` is what map, orbits, simulation and fits ask, for any impact and the time of its arrival;
`delay_before` reads an impact backwards from its end. At the end of the file stand the impacts of a resolved contact,
which orbits and predictions take in place of a law: collisions of a free tip (`TabulatedImpact`), as Chebyshev series.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import Surface
from afm_jax.apparatus.trigonometry import horner
from afm_jax.impact.law import HertzContact, Impact, Law, Speeds, read_backwards

PASSES = 4
"""Passes from the delay to mid contact and back."""
USUAL_LEAD = 1.3
"""Lead b of a tip that keeps its energy over a length, over that length: what comes closest for eight contacts."""


class Middle(NamedTuple):
    """Acceleration g of the tip relative to the platform at mid contact, in nm/us^2, and its time derivative.

    g is positive away from the sample. ``change`` (j of the equations): its derivative, in nm/us^3.
    """

    acceleration: Float[Array, ""]
    change: Float[Array, ""]


def speeds_of_impact(
    impact: Impact,
    approach_speed: Float[Array, ""],
    arrival_us: Float[Array, ""],
    cantilever: Cantilever,
    surface: Platform | Surface,
) -> Speeds:
    """Return rebound speed (nm/us) and delay (us) of an impact on the moving surface: for map, orbits, simulation, fit.

    Both are 0 for a captured tip.

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
    safe = Speeds(*(jnp.where(leaves, speed, usual) for speed, usual in zip(free, (1.0, 1.0, 0.0), strict=True)))
    _, rebound, delay = speeds_of_lasting_impact(safe, impact, arrival_us, cantilever, surface)
    return Speeds(approach_speed, jnp.where(leaves, rebound, 0.0), jnp.where(leaves, delay, 0.0))


def speeds_of_lasting_impact(
    free: Speeds,
    impact: Impact,
    arrival_us: Float[Array, ""],
    cantilever: Cantilever,
    surface: Platform | Surface,
) -> Speeds:
    """Return speeds (nm/us) and delay (us) of an impact that lasts, of a tip that leaves again.

    Mid contact is half a delay after the arrival, and the delay contains the corrections: each of a few passes between
    the two leaves a hundredth of the change or less.

    Args:
        free: speeds and delay of the free tip on a sample at rest.
        impact: lasting.
        arrival_us: when the free flight reaches the surface.
        cantilever: pulls at the tip by its spring and through the air.
        surface: moves.
    """

    def correct(_, speeds: Speeds) -> Speeds:
        middle = middle_of_contact(cantilever, surface, arrival_us + 0.5 * speeds.delay)
        return corrected(free, middle, cantilever, impact)

    # a loop, because the program is compiled for every use of it
    return lax.fori_loop(0, PASSES, correct, free)


def corrected(free: Speeds, middle: Middle, cantilever: Cantilever, impact: Impact) -> Speeds:
    """Return speeds (nm/us) and delay (us) of an impact that lasts, for the accelerations at its mid contact.

    Args:
        free: speeds and delay of the free tip on a sample at rest.
        middle: accelerations at mid contact.
        cantilever: its spring and its damping by the air.
        impact: for its Hertz time, lead and lengths.
    """
    u, w = free.approach, free.rebound
    pull, hertz = middle.acceleration, impact.hertz_contact
    raised, length, lead = hertz.raised_nm, hertz.length_nm, hertz.lead_nm
    # contact begins at the solid's surface, which the tip reaches from gap 0 under the pull
    at_surface = speed_over(u, raised, pull)
    tau = hertz.time(at_surface)
    _, deeper = in_bridge(hertz, u, w)
    gained, longer = gained_and_longer(at_surface, tau, middle, cantilever, deeper)
    # the air of the flights counts to gap 0, and in the bridge the tip is faster than there
    gained = gained + 4.0 * cantilever.decay_rate * (raised * (u + w) - IN_AIR * lead * (u - w))
    rebound = jnp.sqrt(jnp.maximum(w**2 + gained, (0.1 * w) ** 2))
    longer = longer + tau - hertz.time(u) - _lag(u, raised, pull) - _lag(w, raised, pull)
    # by how much later the tip passes the length over which it keeps its energy; of the lead that is its fraction
    later = _lag(w, length, pull) - _lag(u, length, pull)
    fraction = lead / (USUAL_LEAD * length)
    return Speeds(u, rebound, free.delay + longer - fraction * later)


def middle_of_contact(cantilever: Cantilever, surface: Platform | Surface, time_us: Float[Array, "..."]) -> Middle:
    """Return the acceleration of the tip relative to the surface at mid contact (nm/us^2), and its time derivative.

    Args:
        cantilever: pulls at the tip by its spring and through the air.
        surface: moves.
        time_us: mid contact, half a delay after the arrival.
    """
    motion, of_lever = surface.motion(time_us), cantilever.acceleration
    position, velocity, acceleration = motion.position, motion.velocity, motion.acceleration
    return Middle(of_lever(position, velocity) - acceleration, of_lever(velocity, acceleration) - motion.jerk)


AIR = 10.0 / 9.0
"""Twice the integral of the squared speed over a Hertz contact, over tau u^2."""
STIFFER = 3.9337034362e-02
"""Fraction by which a spring of its own frequency Omega shortens a Hertz contact, over (Omega tau)^2."""
SHALLOWER = 8.3576e-2
"""Fraction by which it reduces the integral of a Hertz contact's indentation, over (Omega tau)^2."""
SPREAD = 4.6448e-2
"""Mean square of the time from mid contact, weighted by a Hertz contact's indentation, over tau^2."""
BELOW, FASTER = 0.30, 0.81
"""Depth of the paths through a bridge below straight ones over l b (1/w - 1/u), and how much deeper a Hertz contact is
over (b/l) (1 - w^2/u^2): what comes closest for twenty contacts."""
IN_AIR = 0.87
"""Integral of the squared speed through a bridge less that of straight paths, over b (u - w): likewise."""


def gained_and_longer(
    approach_speed: Float[Array, ""],
    tau: Float[Array, ""],
    middle: Middle,
    cantilever: Cantilever,
    deeper: Float[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return by how much squared speed (nm^2/us^2) and duration (us) of a Hertz contact grow under pull and air.

    Args:
        approach_speed: u in nm/us at the solid's surface.
        tau: Hertz time in us.
        middle: accelerations at mid contact.
        cantilever: its spring and its damping by the air.
        deeper: fraction by which a bridge lets the tip go deeper; its squared speed grows by twice that.
    """
    # without units: kappa and J of the equations
    kappa = middle.acceleration * tau / approach_speed
    change = middle.change * tau**2 / approach_speed
    lasts, deep = hertz_under_pull(kappa)
    air = AIR * (1.0 + 2.0 * deeper) * (lasts - 1.2 * jnp.clip(kappa, *PULLS) * deep)
    gained = 2.0 * (deep * change - air * cantilever.decay_rate * tau)
    return gained * approach_speed**2, (lasts - 1.0 - STIFFER * (cantilever.angular_frequency * tau) ** 2) * tau


def indentation(
    approach_speed: Float[Array, "..."],
    tau: Float[Array, "..."],
    middle: Middle,
    cantilever: Cantilever,
    nu: Float[Array, "..."] | float,
) -> Float[Array, "..."]:
    """Return the time integral in nm us of a Hertz contact's indentation, as a lock-in at nu counts it.

    H(kappa) (1 - 0.0836 (Omega tau)^2 - 0.0232 (nu tau)^2) u tau^2.

    Args:
        approach_speed: u in nm/us at the solid's surface.
        tau: Hertz time in us.
        middle: accelerations at mid contact.
        cantilever: its spring, of the angular frequency Omega.
        nu: angular frequency of the lock-in in rad/us.
    """
    _, deep = hertz_under_pull(middle.acceleration * tau / approach_speed)
    missed = (SHALLOWER * cantilever.angular_frequency**2 + 0.5 * SPREAD * nu**2) * tau**2
    return deep * (1.0 - missed) * approach_speed * tau**2


def depth_of_impact(
    impact: Impact,
    approach_speed: Float[Array, "..."],
    rebound_speed: Float[Array, "..."],
    middle: Middle,
    cantilever: Cantilever,
    nu: Float[Array, "..."] | float,
) -> Float[Array, "..."]:
    """Return the time integral of the tip's depth below gap 0, in nm us: what a lock-in reads beside the flights.

    Args:
        impact: lasting; for its Hertz time, the height of the solid over gap 0, and its bridge.
        approach_speed: u in nm/us at gap 0.
        rebound_speed: w in nm/us at gap 0.
        middle: accelerations at mid contact.
        cantilever: its spring stiffens the contact.
        nu: angular frequency of the lock-in in rad/us.
    """
    hertz = impact.hertz_contact
    raised = hertz.raised_nm
    at_surface = speed_over(approach_speed, raised, middle.acceleration)
    tau = hertz.time(at_surface)
    lasts, _ = hertz_under_pull(middle.acceleration * tau / at_surface)
    # the parabolas between the surface and gap 0 are of the flight
    beside = 2.0 * raised / (at_surface + approach_speed)
    flown = beside**2 * (at_surface + 2.0 * approach_speed) / 3.0
    drawn, deeper = in_bridge(hertz, approach_speed, rebound_speed)
    solid = (1.0 + deeper) * indentation(at_surface, tau, middle, cantilever, nu)
    return solid - raised * lasts * tau + flown + drawn


def in_bridge(
    hertz: HertzContact, approach_speed: Float[Array, "..."], rebound_speed: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return what a bridge pulls a tip below straight paths (nm us), and by which fraction it lets it go deeper.

    Args:
        hertz: for the lead and length of the bridge.
        approach_speed: u in nm/us.
        rebound_speed: w in nm/us.
    """
    lead, length = hertz.lead_nm, hertz.length_nm
    drawn = BELOW * length * lead * (1.0 / rebound_speed - 1.0 / approach_speed)
    return drawn, FASTER * lead / length * (1.0 - (rebound_speed / approach_speed) ** 2)


def _lag(speed: Float[Array, ""], length: Float[Array, ""], acceleration: Float[Array, ""]) -> Float[Array, ""]:
    """Return how much longer in us the tip takes for a length in nm at constant acceleration than at its speed."""
    return 2.0 * length / (speed_over(speed, length, acceleration) + speed) - length / speed


def speed_over(
    speed: Float[Array, "..."], length: Float[Array, "..."], acceleration: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the speed at the end of a length in nm at constant acceleration, in nm/us."""
    return jnp.sqrt(jnp.maximum(speed**2 + 2.0 * acceleration * length, (0.1 * speed) ** 2))


PULLS = (-3.0, 4.0)
"""Range of kappa in which F and H are right to 1e-6 of themselves; beyond, they are those of its ends."""
_LONGER = (
    4.0976707634e-08,
    -1.2882289826e-05,
    -2.1476223117e-04,
    -1.1441397979e-03,
    -1.1402203184e-02,
    -2.7643573360e-03,
    -1.2740091939e-01,
)
_DEEP = (
    4.3544972221e-06,
    -1.1934263418e-04,
    1.4521926732e-03,
    -9.9276086566e-03,
    4.5405563844e-02,
    -1.1340677163e-01,
    2.1233502306e-01,
)
_OVER = (
    1.4243711163e-05,
    1.2384808310e-04,
    3.7580487900e-03,
    -4.8109292354e-03,
    1.3651754937e-01,
    -1.6357497828e-01,
    1.0,
)
"""(F - 1)/kappa and H as quotients of polynomials in kappa, highest power first (`tests/reference_hertz.py`)."""


def hertz_under_pull(kappa: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return F and H of a Hertz contact under a constant pull: duration over tau, integral of depth over u tau^2."""
    kappa = jnp.clip(kappa, *PULLS)
    longer, deep, over = (horner(series, kappa) for series in (_LONGER, _DEEP, _OVER))
    return 1.0 + kappa * longer / over, deep / over


def crawls(impact: Impact, speeds: Speeds, cantilever: Cantilever) -> Bool[Array, "..."]:
    """Say whether a free tip rebounds so slowly that it stays in the bridge, as its delay tells.

    The delay takes the way out as straight from gap 0, before the tip is there: by b (1/u_out - 1/u_in), without limit
    towards capture. Over a quarter of the free period no flight is straight; a tip that would need it does not come out
    of the bridge before the spring and the platform decide.

    Args:
        impact: for its lead b.
        speeds: of the free tip on a sample at rest; the tip leaves.
        cantilever: for its period.
    """
    early = jnp.maximum(impact.hertz_contact.lead_nm, 0.0) * (speeds.approach - speeds.rebound)
    return early > 0.5 * jnp.pi / cantilever.angular_frequency * speeds.approach * speeds.rebound


def delay_before(
    law: Law,
    rebound_speed: Float[Array, ""],
    leaving_us: Float[Array, ""],
    cantilever: Cantilever,
    surface: Platform | Surface,
) -> Float[Array, ""]:
    """Return the delay in us of the impact that ended with a rebound speed: the impact read backwards; 0 if none ended.

    Args:
        law: the impact law, with a delay.
        rebound_speed: u_out in nm/us; where it is not positive no impact ended.
        leaving_us: end of the contact.
        cantilever: pulls at the tip by its spring and through the air.
        surface: moves.
    """
    leaves = rebound_speed > 0.0
    rebound = jnp.where(leaves, rebound_speed, 1.0)
    if not law.lasts:
        return jnp.where(leaves, law.collision_delay(law.approach_speed(rebound)), 0.0)

    def lasting(free: Speeds, delay: Float[Array, ""]) -> Speeds:
        middle = middle_of_contact(cantilever, surface, leaving_us - 0.5 * delay)
        return corrected(free, middle, cantilever, law)

    return jnp.where(leaves, read_backwards(law, rebound, lasting)[1], 0.0)


_WRITTEN_OUT = 3
"""Steps of a series that are one round of a loop."""
_ROUNDING = 1e-12
NEAREST = 1.01
"""Approach speed in terms of the capture speed from which on a table's error is known."""


class TabulatedImpact(Impact):
    """The loss u_in^2 - u_out^2 and the time in contact of free collisions as series; the coordinate is u_in.

    Both are smooth functions of the rebound speed down to 0, and so of v = sqrt(u_in^2 - capture^2): Chebyshev series
    in asinh(v/scale), which is v itself at capture and its logarithm far from it. The delay is the time in contact less
    what the straight paths take, outer/u_out + inner/u_in, and so as singular at capture as it is.

    It stands beside `LawTable` because a contact is followed back from rebound speeds, while knots of that table are
    approach speeds over a capture speed that is known only then: the series takes 32 collisions to any speed. The fit's
    spline through it is off by up to 9e-7 of the rebound speed and 1.4e-4 us of the delay, 1e-7 and 1e-6 us are
    promised here; 168 knots beside the whole lead outer (1/u_out - 1/u_in) would do, but have their values from here.

    Attributes:
        loss: coefficients of the loss in nm^2/us^2, shape (terms,).
        time: coefficients of the time in contact in us, shape (terms,).
        capture: speed in nm/us at which the tip is captured.
        scale: v in nm/us from which on the variable is a logarithm.
        end: asinh(v/scale) where the table ends; beyond, loss and delay are held.
        inner_nm: gap at which contact begins.
        outer_nm: gap at which contact ends.
        closest: the Hertz contact as stiff as the table's end, where nothing else is left, with the lead b of the delay
            formula that is closest to the delay, half the offset d that is left then, and the gap at which the bridge
            breaks.
        loss_error: estimated error of the series for the loss, in nm^2/us^2.
        speed_error: estimated error of the approach speeds that it goes through, relative to them.
        time_error: estimated error of the time in us.
    """

    loss: Float[Array, " terms"]
    time: Float[Array, " terms"]
    capture: Float[Array, ""]
    scale: Float[Array, ""]
    end: Float[Array, ""]
    inner_nm: Float[Array, ""]
    outer_nm: Float[Array, ""]
    closest: HertzContact
    loss_error: Float[Array, ""]
    speed_error: Float[Array, ""]
    time_error: Float[Array, ""]

    @property
    def lowest(self) -> Float[Array, ""]:
        """Speed in nm/us at which the tip is captured."""
        return self.capture

    @property
    def hertz_contact(self) -> HertzContact:
        """The closest Hertz contact."""
        return self.closest

    @property
    def highest(self) -> Float[Array, ""]:
        """Approach speed in nm/us where the table ends."""
        return jnp.sqrt(self.lowest**2 + (self.scale * jnp.sinh(self.end)) ** 2)

    def speeds(self, coordinate: Float[Array, "..."]) -> Speeds:
        """Return approach and rebound speed in nm/us and the delay in us at the coordinate, the approach speed."""
        u = coordinate
        place = self._place(u)
        loss = polynomials(place, self.loss.shape[0]) @ self.loss
        inside = jnp.minimum(u, self.highest)
        straight = self.outer_nm / _rebound(inside, loss) + self.inner_nm / inside
        return Speeds(u, _rebound(u, loss), polynomials(place, self.time.shape[0]) @ self.time - straight)

    def errors(self, approach_speed: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the estimated errors of the rebound speed, relative to it, and of the delay in us.

        Infinite outside the table: up to 1 % above capture, and beyond its end.
        """
        w = self.speeds(approach_speed).rebound
        relative = (0.5 * self.loss_error + self.speed_error * approach_speed**2) / w**2
        inside = (approach_speed > NEAREST * self.lowest) & (approach_speed <= (1.0 + _ROUNDING) * self.highest)
        late = self.time_error + self.outer_nm * relative / w
        return jnp.where(inside, relative, jnp.inf), jnp.where(inside, late, jnp.inf)

    def _place(self, u: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the series' variable for a speed, -1 at capture to 1 at the table's end."""
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


def polynomials(place: Float[Array, "..."], count: int) -> Float[Array, "... count"]:
    """Return Chebyshev's polynomials of the degrees 0 to count - 1 at places, held in [-1, 1]."""
    place = jnp.clip(place, -1.0, 1.0)

    def step(two_degrees, _):
        last, before = two_degrees
        return (2.0 * place * last - before, last), last

    first = jnp.ones_like(place)
    _, rest = lax.scan(step, (place, first), None, length=count - 1, unroll=_WRITTEN_OUT)
    return jnp.moveaxis(jnp.concatenate([first[None], rest]), 0, -1)
