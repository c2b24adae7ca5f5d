"""The closing condition of a single-impact orbit, one scalar equation for the approach speed, and all its roots.

Takes cantilever, platform, law and order N; gives coordinates (nm/us) and phases (rad) of all orbits.

Equation 9 asks for the impact phase. Read the other way round it has no poles and nothing special at resonance: for an
assumed approach speed u the law gives the rebound speed w and the delay tau, and the two conditions that the flight of
duration N T - tau ends where the next one begins are *linear* in a = cos(omega t_out), b = sin(omega t_out). Every root
of a^2 + b^2 = 1 is an orbit. Both signs of eq. 9's root are among them, and nothing else, because w > 0 throughout.

In place of u stands a coordinate of the impact in which the law is smooth up to capture (`Impact.speeds`). For a
formula without a delay the condition is a quartic in it, so that no root can be missed. Otherwise it is scanned: every
change of sign between neighbours of the scan is narrowed, and every pair of roots that it stepped over, seen by the
extremum between them. Where the impact lasts, speeds and delay need the phase: three passes alternate between the two,
close enough to find every orbit, and Newton's method closes the map itself from there (`follow_root`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever, Propagator
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.impact.lasting_impact import corrected, middle_of_contact, speeds_of_lasting_impact
from afm_jax.impact.law import Impact, ImpactLaw, Speeds
from afm_jax.solve.newton import newton
from afm_jax.solve.newton_rows import Newton
from afm_jax.solve.polynomial_roots import real_roots

NEAR_DOUBLE = 1e-3
"""Slope of the closing condition per relative change of speed below which a root counts as near-double (a fold)."""
_NEARBY = 1e-5
"""Distance from a root at which its slope is taken, as a fraction of its distance from capture."""
_REGULAR = 1e-12
"""Relative size below which a determinant is taken for the rounding of 0."""
_PASSES = 3
_CLOSE = 1e-10
"""Gaps, and the last step of Newton's method, that leave an error of the order of their square."""
_CLOSED = 1e-9
"""By how much a turn of the map may miss its start, in units of the drive: near a fold rounding leaves as much."""
_NEWTON = 6
"""Steps of Newton's method at most."""
_LONGEST_STEP = 0.3
"""Longest step of it: fraction of the distance from capture, and rad."""
_LEAVING = 0.4
"""Fraction of the drive's period that a leaving tip may take to lose its energy: beyond, no law of impacts holds."""
_REGULA_FALSI, _BEFORE_NEWTON = 20, 10
"""Steps towards a root of the scalar condition: to its last digit, and to where Newton's method goes on."""
_ZOOMS, _INNER = 4, 17
"""How often an extremum is looked at more closely, and at how many points each time."""
_SAME = 1e-7
"""Relative difference of approach speeds below which roots are one."""


class OrbitProblem(NamedTuple):
    """What single-impact orbits are orbits of; the order N is a floating-point number, so that it can be batched."""

    cantilever: Cantilever
    platform: Platform
    impact: Impact
    order: Float[Array, ""]


class ClosingSystem(NamedTuple):
    """The linear system for given speeds: a = cosine/determinant, b = sine/determinant of the phase just after impact.

    All three in units of the drive (lengths over beta, speeds over beta omega), numbers. ``regular`` is False where the
    flight returns every state (a whole number of free periods): the determinant is 0 then but for rounding.
    """

    cosine: Float[Array, ""]
    sine: Float[Array, ""]
    determinant: Float[Array, ""]
    regular: Bool[Array, ""]

    @property
    def phase(self) -> Float[Array, ""]:
        """The drive's phase in rad just after impact; 0 where it is not determined."""
        safe = jnp.where(self.regular, self.determinant, 1.0)
        cosine = jnp.where(self.regular, self.cosine / safe, 1.0)
        return jnp.arctan2(jnp.where(self.regular, self.sine / safe, 0.0), cosine)

    @property
    def residual(self) -> Float[Array, ""]:
        """a^2 + b^2 - 1 times the squared determinant, relative to the sum of its terms."""
        total = self.cosine**2 + self.sine**2 + self.determinant**2
        return (self.cosine**2 + self.sine**2 - self.determinant**2) / total


class Closure(NamedTuple):
    """The impact at a coordinate, and the linear system it leads to."""

    speeds: Speeds
    system: ClosingSystem


@jax.jit
def closure(coordinate: Float[Array, ""], problem: OrbitProblem) -> Closure:
    """Return the linear system for the phase of the orbit whose impact has a coordinate.

    Rows: z_in = p11 z_out + p12 V_out and V_in = p21 z_out + p22 V_out, with z_out = sigma + beta a,
    V_out = w - beta omega b, z_in = sigma + beta (a C + b S), V_in = -u - beta omega (b C - a S); C, S of omega tau.
    """
    cantilever, platform, impact, order = problem
    free = impact.speeds(coordinate)
    if not impact.delayed:
        flight = _returning_flight(cantilever, order * platform.period_us)
        top_speed = platform.top_speed_nm_per_us
        cosine, sine = _instantaneous(free.approach / top_speed, free.rebound / top_speed, 1.0, flight, platform)
        return Closure(free, ClosingSystem(cosine, sine, flight.closing, flight.regular(platform)))
    if not impact.lasts:
        return Closure(free, _delayed(free, problem))

    def correct(_, speeds: Speeds) -> Speeds:
        system = _delayed(speeds, problem)
        # the direction of the phase, whether or not this is an orbit already
        cosine, sine = system.cosine * system.determinant, system.sine * system.determinant
        somewhere = (cosine != 0.0) | (sine != 0.0)
        phase = jnp.arctan2(sine, jnp.where(somewhere, cosine, 1.0))
        middle = middle_of_contact(cantilever, platform, phase / platform.angular_frequency - 0.5 * speeds.delay)
        return corrected(free, middle, cantilever, impact)

    # a loop, because the program is compiled for every use of it
    speeds = lax.fori_loop(0, _PASSES, correct, free)
    return Closure(speeds, _delayed(speeds, problem))


@jax.jit
def closing_residual(coordinate: Float[Array, ""], problem: OrbitProblem) -> Float[Array, ""]:
    """Return a^2 + b^2 - 1 times the squared determinant, relative to the sum of its terms: 0 on an orbit."""
    return closure(coordinate, problem).system.residual


class OrbitPlace(NamedTuple):
    """An orbit: the coordinate of its impact in nm/us, and the drive's phase in rad when the tip arrives."""

    coordinate: Float[Array, ""]
    phase: Float[Array, ""]


def place_of(coordinate: Float[Array, ""], speeds: Speeds, system: ClosingSystem, problem: OrbitProblem) -> OrbitPlace:
    """Return where an orbit is, given the closure at its coordinate; about, where the impact lasts."""
    return OrbitPlace(coordinate, system.phase - problem.platform.angular_frequency * speeds.delay)


def speeds_at_place(place: OrbitPlace, problem: OrbitProblem) -> Speeds:
    """Return what the impact is at a place: that of the map."""
    cantilever, platform, impact, _ = problem
    return speeds_of_lasting_impact(
        impact.speeds(place.coordinate), impact, place.phase / platform.angular_frequency, cantilever, platform
    )


@jax.jit
def map_gaps(unknowns: Float[Array, " 2"], problem: OrbitProblem) -> Float[Array, " 2"]:
    """Return by how much one turn of the map misses its start: height over beta, velocity over beta omega.

    Args:
        unknowns: coordinate and phase of the impact.
        problem: what orbits are of.
    """
    cantilever, platform, _, order = problem
    place = OrbitPlace(*unknowns)
    arrival = place.phase / platform.angular_frequency
    speeds = speeds_at_place(place, problem)
    height, speed = platform.position_and_velocity(arrival + speeds.delay)
    flight = cantilever.propagator(order * platform.period_us - speeds.delay)
    position, velocity = flight(height, speed + speeds.rebound)
    height, speed = platform.position_and_velocity(arrival)
    missing = (velocity - speed + speeds.approach) / platform.top_speed_nm_per_us
    return jnp.stack([(position - height) / platform.amplitude_nm, missing])


class FollowedRoot(NamedTuple):
    """An orbit close to a coordinate.

    ``closes``: whether there is one; ``near_fold``: see `NEAR_DOUBLE`.
    """

    place: OrbitPlace
    closes: Bool[Array, ""]
    near_fold: Bool[Array, ""]


@jax.jit
def follow_root(near: Float[Array, ""], problem: OrbitProblem, wanted: Bool[Array, ""]) -> FollowedRoot:
    """Return where an orbit close to a coordinate is, and whether there is one, without derivatives.

    Where the impact lasts Newton's method closes the map. With x(Y) the solution (a, b) of the linear system, the gaps
    are its matrix times (cos, sin) - x, so that the slope of the closing condition on an orbit, d|x|^2/dY/2, is the
    determinant of the gaps' slopes over that of the matrix.

    Args:
        near: coordinate of the impact, close to that of the orbit; of an impact that does not last, that of the orbit.
        problem: what orbits are of.
        wanted: whether the orbit is asked for; if not, no step of Newton's method is made.
    """
    problem = lax.stop_gradient(problem)

    def longest(unknowns: Array) -> Array:
        return jnp.stack([unknowns[0] - problem.impact.lowest, jnp.ones_like(unknowns[1])])

    def damped(unknowns: Array, step: Array) -> Array:
        most = _LONGEST_STEP * longest(unknowns)
        return jnp.clip(step, -most, most)

    speeds, system = closure(near, problem)
    if not problem.impact.lasts:
        return FollowedRoot(place_of(near, speeds, system, problem), wanted & system.regular, near_fold(near, problem))
    settings = Newton(_NEWTON, step_tolerance=_CLOSE, residual_tolerance=_CLOSE, unit=longest, damping=damped)
    place = jnp.stack(place_of(near, speeds, system, problem))
    root = newton(map_gaps, place, problem, settings, where=wanted)
    (a, b), (c, d) = root.slopes
    return FollowedRoot(
        place=OrbitPlace(*root.x),
        closes=system.regular & jnp.all(jnp.abs(root.residual) < _CLOSED),
        near_fold=jnp.abs((a * d - b * c) * root.x[0]) < NEAR_DOUBLE * jnp.abs(system.determinant),
    )


def near_fold(coordinate: Float[Array, ""], problem: OrbitProblem) -> Bool[Array, ""]:
    """Say whether a root of the scalar condition is near-double: see `NEAR_DOUBLE`."""
    # a difference, right to nine digits: the derivative's program is twice as large; not beyond capture
    step = _NEARBY * (coordinate - problem.impact.lowest)
    ends = coordinate + step * jnp.array([-1.0, 1.0])
    low, high = jax.vmap(closing_residual, in_axes=(0, None))(ends, problem)
    return jnp.abs((high - low) * coordinate) < 2.0 * step * NEAR_DOUBLE


def instantaneous_quartic(problem: OrbitProblem) -> Float[Array, " 5"]:
    """Return Y^2 (cosine^2 + sine^2 - determinant^2) without a delay: a quartic in Y/(beta omega)."""
    cantilever, platform, law, order = problem
    assert isinstance(law, ImpactLaw)  # the formula alone makes a quartic  # noqa: S101
    flight = _returning_flight(cantilever, order * platform.period_us)
    top_speed = platform.top_speed_nm_per_us
    square = (law.epsilon + (law.viscous_loss / (2.0 * law.r)) ** 2) / top_speed**2
    middle, half = law.viscous_loss / (2.0 * law.r**2) / top_speed, 0.5 / law.r
    # Y times u, Y times w and Y itself, in powers of Y.
    approach = jnp.array([half, middle, half * square])
    rebound = jnp.array([0.5, 0.0, -0.5 * square])
    cosine, sine = _instantaneous(approach, rebound, jnp.array([0.0, 1.0, 0.0]), flight, platform)
    quartic = _squared(cosine) + _squared(sine)
    return quartic.at[2].add(-(flight.closing**2))


class _ReturningFlight(NamedTuple):
    """The flights that come back to the height they left, up to a common factor.

    ``rest`` is that height in us, ``after`` and ``before`` the velocities at the start and at the end (numbers).
    """

    rest: Float[Array, ""]
    after: Float[Array, ""]
    before: Float[Array, ""]

    @property
    def closing(self) -> Float[Array, ""]:
        """By how much the velocity changes between end and start: what the impact has to supply."""
        return self.after - self.before

    def regular(self, platform: Platform) -> Bool[Array, ""]:
        """Say whether the impact supplies anything beyond rounding."""
        size = jnp.abs(self.after) + jnp.abs(self.before) + jnp.abs(self.rest) * platform.angular_frequency
        return jnp.abs(self.closing) > _REGULAR * size


def _returning_flight(cantilever: Cantilever, duration: Float[Array, ""]) -> _ReturningFlight:
    """Return the flight of a duration in us, written so that nothing cancels near a whole number of free periods."""
    omega_d = cantilever.damped_angular_frequency
    half_sine, half_cosine = jnp.sin(0.5 * omega_d * duration), jnp.cos(0.5 * omega_d * duration)
    if cantilever.quality_factor is None:
        return _ReturningFlight(half_cosine / omega_d, half_sine, -half_sine)
    loss = -jnp.expm1(-cantilever.decay_rate * duration)
    sine, dip = 2.0 * half_sine * half_cosine, 2.0 * half_sine**2
    lag = cantilever.decay_rate / omega_d * sine
    kept = 1.0 - loss
    return _ReturningFlight(kept * sine / omega_d, loss + kept * (dip - lag), kept * (loss - dip - lag))


def _instantaneous(approach, rebound, one, flight: _ReturningFlight, platform: Platform):
    """Return cosine and sine of the linear system for speeds over beta omega (or their coefficients, `one` for 1).

    z_out = rest (u + w)/closing and v_p = (u after + w before)/closing on a returning flight.
    """
    height = flight.rest * platform.angular_frequency * (approach + rebound)
    offset = one * (platform.offset_nm / platform.amplitude_nm * flight.closing)
    return height - offset, -(approach * flight.after + rebound * flight.before)


def _delayed(speeds: Speeds, problem: OrbitProblem) -> ClosingSystem:
    """Solve both rows by Cramer's rule, every length over beta and every speed over beta omega."""
    cantilever, platform, _, order = problem
    p: Propagator = cantilever.propagator(order * platform.period_us - speeds.delay)
    turn = platform.angular_frequency * speeds.delay
    sin_turn, cos_turn = sine_cosine(turn)
    omega, top_speed = platform.angular_frequency, platform.top_speed_nm_per_us
    sigma = platform.offset_nm / platform.amplitude_nm
    approach, rebound = speeds.approach / top_speed, speeds.rebound / top_speed
    p12, p21 = p.position_per_velocity * omega, p.velocity_per_position / omega
    m11, m12 = cos_turn - p.position_per_position, sin_turn + p12
    m21, m22 = sin_turn - p21, p.velocity_per_velocity - cos_turn
    right1 = (p.position_per_position - 1.0) * sigma + p12 * rebound
    right2 = approach + p21 * sigma + p.velocity_per_velocity * rebound
    determinant = m11 * m22 - m12 * m21
    # Here the determinant is of second order in the distance to a whole number of free periods, its rounding of zeroth.
    return ClosingSystem(
        cosine=right1 * m22 - right2 * m12,
        sine=m11 * right2 - m21 * right1,
        determinant=determinant,
        regular=jnp.abs(determinant) > _REGULAR,
    )


def _squared(quadratic: Float[Array, " 3"]) -> Float[Array, " 5"]:
    """Return the square of a quadratic (jnp.polymul's convolution takes 50 times as long under vmap)."""
    a, b, c = quadratic
    return jnp.array([a * a, 2.0 * a * b, b * b + 2.0 * a * c, 2.0 * b * c, c * c])


class Scan(NamedTuple):
    """At how many coordinates the closing condition is evaluated, and how many roots there is room for."""

    points: int
    """Coordinates, at equal ratios of their distance from capture."""
    lowest: float
    """Distance from capture at which they begin, in terms of the drive's speed or the capture coordinate."""
    highest: float
    crossings: int
    """Changes of sign that are followed."""
    turns: int
    """Turning points without one that are searched for a pair of roots."""
    slots: int
    """Roots there is room for."""


FINE = Scan(8192, 1e-7, 1e5, crossings=16, turns=6, slots=16)
"""Some 680 points to the decade: for whoever asks for all orbits."""
COARSE = Scan(512, 1e-3, 1e4, crossings=6, turns=2, slots=10)
"""Some 70 to the decade: for fits, which search a hundred thousand times."""


class OrbitRoots(NamedTuple):
    """Roots of the closing condition, one a slot."""

    place: OrbitPlace
    found: Bool[Array, " slots"]
    """Which slots hold a root."""
    complete: Bool[Array, ""]
    """Whether there were no more roots than slots."""
    near_fold: Bool[Array, " slots"]
    """Which roots are near-double."""


def find_roots(problem: OrbitProblem, scan: Scan = FINE) -> OrbitRoots:
    """Return coordinate and phase of all orbits in a fixed number of slots, ascending in speed, without derivatives.

    Args:
        problem: what orbits are of.
        scan: how closely the condition is scanned where there is a delay; without one there are 4 slots.

    Returns:
        The roots; a slot without one has a coordinate that is harmless to compute with.
    """
    problem = lax.stop_gradient(problem)
    coordinate, wanted, complete = coordinates_of_roots(problem, scan)
    roots = jax.vmap(follow_root, in_axes=(0, None, 0))(coordinate, problem, wanted)
    found = first_seen(roots.place.coordinate, wanted & roots.closes)
    place = OrbitPlace(jnp.where(found, roots.place.coordinate, coordinate), roots.place.phase)
    return OrbitRoots(place, found, complete, found & roots.near_fold)


class Coordinates(NamedTuple):
    """Roots of the scalar condition, close to those of the map: which slots hold one, and whether those are all.

    A slot without one has a coordinate that is harmless to compute with.
    """

    coordinate: Float[Array, " slots"]
    found: Bool[Array, " slots"]
    complete: Bool[Array, ""]


def coordinates_of_roots(problem: OrbitProblem, scan: Scan = FINE) -> Coordinates:
    """Return where orbits may be, from where `follow_root` finds them, without derivatives; arguments of `find_roots`.

    Without an amplitude, or over a ramp, there are none.
    """
    problem = lax.stop_gradient(problem)
    driven = (problem.platform.amplitude_nm > 0.0) & (problem.platform.offset_rate_nm_per_us == 0.0)
    # the closing condition is a quartic of the formula without a delay alone
    quartic = isinstance(problem.impact, ImpactLaw) and not problem.impact.delayed
    coordinate, found, complete = _quartic_roots(problem) if quartic else _scanned_roots(problem, scan)
    return Coordinates(jnp.where(found, coordinate, harmless_coordinate(problem)), found & driven, complete)


def first_seen(coordinate: Any, found: Any) -> Any:
    """Say which of the roots found are not those of an earlier slot: Newton's method may come to one from two brackets.

    Arrays of NumPy or JAX, of shape (..., slots).
    """
    same = abs(coordinate[..., :, None] - coordinate[..., None, :]) <= _SAME * coordinate[..., None, :]
    earlier = np.tri(coordinate.shape[-1], k=-1, dtype=bool)
    return found & ~(same & earlier & found[..., None, :]).any(axis=-1)


def harmless_coordinate(problem: OrbitProblem) -> Float[Array, ""]:
    """Return a coordinate for slots without a root: some speed well above capture, harmless to compute with."""
    return problem.impact.lowest + 2.0 * _scale(problem) + 2.0


def _quartic_roots(problem: OrbitProblem) -> Coordinates:
    """Solve (Y cosine)^2 + (Y sine)^2 = (Y determinant)^2, a quartic in Y over beta omega."""
    quartic = instantaneous_quartic(problem)
    scale = problem.platform.top_speed_nm_per_us
    low = problem.impact.lowest / scale
    # Cauchy's bound; a quartic without leading term (no loss at exact resonance) has a root at infinity, not here.
    top = jnp.max(jnp.abs(quartic))
    leading = jnp.maximum(jnp.abs(quartic[0]), 1e-15 * top)
    high = jnp.maximum(1.0 + top / jnp.where(leading > 0.0, leading, 1.0), 2.0 * low + 1.0)
    roots, found = real_roots(quartic, low, high)
    return Coordinates(roots * scale, found & (roots > low), jnp.array(True))  # noqa: FBT003


def _scale(problem: OrbitProblem) -> Float[Array, ""]:
    """Return the unit in nm/us of distances from capture: the drive's top speed, or where adhesion counts."""
    return jnp.maximum(problem.platform.top_speed_nm_per_us, problem.impact.lowest)


def _scanned_roots(problem: OrbitProblem, scan: Scan) -> Coordinates:
    """Scan the closing condition from just above capture to speeds that no orbit reaches; narrow every bracket."""
    grid = problem.impact.lowest + jnp.asarray(np.geomspace(scan.lowest, scan.highest, scan.points)) * _scale(problem)
    value, brief = (jax.vmap(of, in_axes=(0, None))(grid, problem) for of in (closing_residual, _brief))
    # changes of sign between impacts that are over soon
    below, above = value < 0.0, value >= 0.0  # neither where it is not a number
    crossing = (below[:-1] & above[1:] | above[:-1] & below[1:]) & brief[:-1] & brief[1:]
    # the fastest ones if there are too many: close to capture the law itself ends
    at = crossing.shape[0] - 1 - jnp.nonzero(crossing[::-1], size=scan.crossings, fill_value=0)[0][::-1]
    real = (jnp.arange(scan.crossings) < jnp.sum(crossing))[::-1]
    crossings = _Brackets(grid[at], grid[at + 1], value[at], value[at + 1], real)
    pairs = _pairs_of_roots(grid, value, brief, scan, problem)
    root, exists = _narrowed(jax.tree.map(lambda *parts: jnp.concatenate(parts), crossings, *pairs), problem)
    fastest = jnp.argsort(jnp.where(exists, -root, jnp.inf))[: scan.slots]
    order = fastest[jnp.argsort(jnp.where(exists[fastest], root[fastest], jnp.inf))]
    complete = (jnp.sum(crossing) <= scan.crossings) & (jnp.sum(exists) <= scan.slots)
    return Coordinates(root[order], exists[order], complete)


def _brief(coordinate: Float[Array, ""], problem: OrbitProblem) -> Bool[Array, ""]:
    """Say whether an impact is over soon: the lead grows without bound towards capture.

    One that lasts must end within half a drive period, and the tip have lost its energy by then.
    """
    period = problem.platform.period_us
    speeds = problem.impact.speeds(coordinate)
    if not problem.impact.lasts:
        return jnp.abs(speeds.delay) < period
    length = problem.impact.hertz_contact.length_nm
    return (jnp.abs(speeds.delay) < 0.5 * period) & (length / speeds.rebound < _LEAVING * period)


class _Brackets(NamedTuple):
    """Ends of intervals, the residuals at both, and which slots hold an interval."""

    left: Float[Array, " n"]
    right: Float[Array, " n"]
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    real: Bool[Array, " n"]


def _pairs_of_roots(
    grid: Float[Array, " points"],
    value: Float[Array, " points"],
    brief: Bool[Array, " points"],
    scan: Scan,
    problem: OrbitProblem,
) -> tuple[_Brackets, _Brackets]:
    """Return the brackets to the left and to the right of the extrema in which the scan stepped over a pair of roots.

    The extremum lies between three neighbours of one sign, the middle one closest to zero. Of points between them the
    one closest to zero, or furthest beyond, has its neighbours searched in turn.
    """
    size = jnp.abs(value)
    same = (value[:-2] * value[1:-1] > 0.0) & (value[1:-1] * value[2:] > 0.0)
    dip = same & (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]) & brief[1:-1]
    closest, at = lax.top_k(-jnp.where(dip, size[1:-1], jnp.inf), scan.turns)
    left, right, sign = grid[at], grid[at + 2], jnp.sign(value[at + 1])

    def closer(_: Any, found: tuple[Array, ...]) -> tuple[Array, ...]:
        points = jnp.linspace(found[0], found[1], _INNER, axis=1)
        values = jax.vmap(jax.vmap(closing_residual, in_axes=(0, None)), in_axes=(0, None))(points, problem)
        lowest = jnp.clip(jnp.argmin(values * sign[:, None], axis=1), 1, _INNER - 2)

        def taken(array: Array, shift: int = 0) -> Array:
            return jnp.take_along_axis(array, lowest[:, None] + shift, axis=1)[:, 0]

        return taken(points, -1), taken(points, 1), taken(points), taken(values)

    _, _, middle, bottom = lax.fori_loop(0, _ZOOMS, closer, (left, right, left, value[at]))
    across = jnp.isfinite(closest) & (bottom * sign < 0.0)
    return (
        _Brackets(left, middle, value[at], bottom, across),
        _Brackets(middle, right, bottom, value[at + 2], across),
    )


def _narrowed(brackets: _Brackets, problem: OrbitProblem) -> tuple[Array, Array]:
    """Return the root of every bracket, and which there are, by the Illinois method.

    The newer end stays, the other one loses weight.
    """
    real = brackets.real
    ends = (jnp.where(real, end, harmless_coordinate(problem)) for end in brackets[:2])
    values = (jnp.where(real, value, 0.0) for value in brackets[2:4])

    def narrow(_: Any, bracket: tuple[Array, ...]) -> tuple[Array, ...]:
        left, right, low, high = bracket
        gap = high - low
        x = jnp.where(gap == 0.0, left, (left * high - right * low) / jnp.where(gap == 0.0, 1.0, gap))
        value = jax.vmap(closing_residual, in_axes=(0, None))(x, problem)
        passed = value * low < 0.0
        return x, jnp.where(passed, left, right), value, jnp.where(passed, low, 0.5 * high)

    steps = _BEFORE_NEWTON if problem.impact.lasts else _REGULA_FALSI
    return lax.fori_loop(0, steps, narrow, (*ends, *values))[0], real
