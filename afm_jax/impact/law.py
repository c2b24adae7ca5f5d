"""The impact law: how fast the tip leaves for how fast it came, and how late.

Takes approach speeds in nm/us, r, epsilon in nm^2/us^2 and c in nm/us, or columns of a table; gives rebound speeds in
nm/us and delays in us (eqs. 4 and 6).

A law is a function from the approach speed to the rebound speed and the collision delay, with a capture speed up to
which the tip stays. Two kinds: the formula of eq. 6 with the viscous loss that the liquid bridge adds (`ImpactLaw`),
u_out^2 = r^2 u_in^2 - c u_in - epsilon, and a table of speeds, measured, fitted or computed (`TabulatedLaw`). All
speeds are relative to the platform and positive.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.checks import as_argument, as_parameter, as_real, check_kind, check_parameter, is_traced, readable
from afm_jax.saved import as_json
from afm_jax.solve.derivatives import implicit_root, slope_of
from afm_jax.strict_json import plain

BRIDGE_NM = 4.7
"""Length in nm over which a leaving tip keeps its energy, where nothing says it: the paper's bridge."""


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


class HertzContact(NamedTuple):
    """What lasts of an impact: a Hertz contact on a surface near gap 0, with straight paths to it and from it.

    On it platform, spring and air act (`afm_jax.impact.lasting_impact`).
    """

    hertz: Float[Array, ""]
    """a, the contact time at 1 nm/us, in us (nm/us)^(1/5)."""
    lead_nm: Float[Array, ""]
    """b of the lead b (1/u_out - 1/u_in) that the delay contains."""
    raised_nm: Float[Array, ""]
    """Height of the solid's surface over gap 0, as the delay tells it: half its offset."""
    length_nm: Float[Array, ""]
    """Length over which a leaving tip keeps its energy: the gap at which the bridge breaks."""

    def time(self, approach_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the contact time tau = a u^(-1/5) in us for a speed in nm/us."""
        return self.hertz * approach_speed**-0.2


class Impact(eqx.Module):
    """What an impact does to a free tip on a sample at rest, as functions of one coordinate.

    The coordinate grows with the approach speed. An impact is a `Law`, or a resolved contact as series
    (`TabulatedImpact`). What platform, spring and air change while it lasts is in
    `afm_jax.impact.lasting_impact`.
    """

    @property
    @abstractmethod
    def lowest(self) -> Float[Array, "..."]:
        """Coordinate in nm/us at which the tip is captured."""

    @property
    @abstractmethod
    def hertz_contact(self) -> HertzContact:
        """The Hertz contact on which platform, spring and air act while the impact lasts."""

    @abstractmethod
    def speeds(self, coordinate: Float[Array, "..."]) -> Speeds:
        """Return approach and rebound speed in nm/us and the delay in us at a coordinate above `lowest`."""

    @property
    def delayed(self) -> bool:
        """Whether the next flight begins at another time than the last one ends; True of a resolved contact."""
        return True

    @property
    def lasts(self) -> bool:
        """Whether platform, spring and air act during the contact; True of a resolved contact."""
        return True

    def at_approach(self, approach_speed: Float[Array, "..."]) -> Speeds:
        """Return the speeds in nm/us and the delay in us at an approach speed, which is a contact's coordinate."""
        return self.speeds(approach_speed)


class Law(Impact):
    """What the tip does at an impact, as functions of the approach speed: of a free tip on a sample at rest.

    A formula (`ImpactLaw`) or a table (`TabulatedLaw`). A law of another kind says what is abstract here. Near capture
    speeds are singular functions of each other; orbits use a coordinate Y in which both are smooth.
    """

    @property
    @abstractmethod
    def delay(self) -> CollisionDelay | None:
        """The formula of the delay, with or without its corrections; None: instantaneous impacts."""

    @property
    @abstractmethod
    def capture_speed_nm_per_us(self) -> Float[Array, "..."]:
        """Approach speed up to which the tip is captured."""

    @property
    @abstractmethod
    def adheres(self) -> Bool[Array, "..."]:
        """Whether adhesion holds a captured tip; if not, it leaves when the platform falls away fast enough."""

    @property
    @abstractmethod
    def slow_restitution(self) -> Float[Array, "..."]:
        """Coefficient of restitution of the slowest impacts of a law without adhesion: what chatter dies out with."""

    @abstractmethod
    def coordinate(self, approach_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the coordinate Y in nm/us of an impact that comes at a speed in nm/us above capture."""

    @abstractmethod
    def at_approach(self, approach_speed: ArrayLike) -> Speeds:
        """Return the speeds in nm/us and the delay in us at an approach speed; 0 where the tip is captured."""

    @abstractmethod
    def approach_speed(self, rebound_speed: ArrayLike) -> Float[Array, "..."]:
        """Return the u_in in nm/us that leaves at u_out in nm/us: the law read backwards."""

    @property
    def delayed(self) -> bool:
        """Whether the next flight begins at another time than the last one ends."""
        return self.delay is not None

    @property
    def lasts(self) -> bool:
        """Whether platform, spring and air act during the contact: a delay, with its corrections."""
        return self.delay is not None and self.delay.corrections

    @property
    def hertz_contact(self) -> HertzContact:
        """The Hertz contact of the delay's formula, with the length of the paper's bridge."""
        length, none = jnp.full_like(self.lowest, BRIDGE_NM), jnp.zeros_like(self.lowest)
        if self.delay is None:
            return HertzContact(none, none, none, length)
        return HertzContact(self.delay.hertz, self.delay.lead_nm, 0.5 * self.delay.offset_nm, length)

    @property
    def leaves(self) -> Bool[Array, "..."]:
        """Whether any tip leaves, as fast ones do: if not, every impact is a capture."""
        return jnp.ones_like(self.lowest, bool)

    def captures(self, approach_speed: ArrayLike) -> Bool[Array, "..."]:
        """Say whether the tip stays at an approach speed in nm/us."""
        return self.rebound_speed(approach_speed) == 0.0

    def rebound_speed(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return u_out in nm/us for u_in in nm/us; 0 where the tip is captured."""
        return self.at_approach(approach_speed).rebound

    def collision_delay(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return the delay tau in us at an approach speed in nm/us; 0 without a delay or where captured."""
        return self.at_approach(approach_speed).delay

    def rebound_slope(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return d u_out/d u_in, a number; 0 where the tip is captured."""
        return slope_of(self.rebound_speed, as_argument(approach_speed))

    def delay_slope(self, approach_speed: ArrayLike) -> Float[Array, "..."]:
        """Return d tau/d u_in in us^2/nm; 0 without a delay or where captured."""
        return slope_of(self.collision_delay, as_argument(approach_speed))

    def extrapolated(self, approach_speed: ArrayLike) -> Bool[Array, "..."]:
        """Say whether an approach speed in nm/us is outside those that the law is known for: a formula's never is."""
        return jnp.zeros(jnp.shape(approach_speed), bool)


class ImpactLaw(Law):
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
    delay: CollisionDelay | None = None  # pyright: ignore[reportIncompatibleMethodOverride]

    __repr__ = readable

    def __check_init__(self):
        check_parameter("r", self.r, "in [0, 1]")
        check_parameter("epsilon", self.epsilon, "not negative")
        check_parameter("viscous_loss", self.viscous_loss, "not negative")
        check_kind("delay", self.delay, CollisionDelay | None)

    @property
    def adheres(self) -> Bool[Array, "..."]:
        """Whether epsilon is above 0: adhesion holds a captured tip."""
        return self.epsilon > 0.0

    @property
    def leaves(self) -> Bool[Array, "..."]:
        """Whether r is above 0: if not, every impact is a capture."""
        return self.r > 0.0

    @property
    def slow_restitution(self) -> Float[Array, "..."]:
        """The coefficient of restitution r, which the slowest impacts have."""
        return self.r

    @property
    def lowest(self) -> Float[Array, "..."]:
        """Coordinate q = sqrt(epsilon + c^2/4r^2) in nm/us at which the tip is captured."""
        square = self.epsilon + (self.viscous_loss / (2.0 * self.r)) ** 2
        positive = square > 0.0
        return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)

    @property
    def capture_speed_nm_per_us(self) -> Float[Array, "..."]:
        """Approach speed up to which the tip is captured: (c + sqrt(c^2 + 4 r^2 epsilon)) / 2 r^2, or infinite."""
        return self.approach_speed(jnp.zeros_like(self.r))

    def at_approach(self, approach_speed: ArrayLike) -> Speeds:
        """Return speeds in nm/us (eq. 6) and delay in us at an approach speed; 0 where the tip is captured."""
        u = as_argument(approach_speed)
        square = squared_rebound_speed(u, self.r, self.epsilon, self.viscous_loss)
        free = square > 0.0
        safe = jnp.sqrt(jnp.where(free, square, 1.0))
        rebound = jnp.where(free, safe, 0.0)
        if self.delay is None:
            return Speeds(u, rebound, jnp.zeros_like(u))
        return Speeds(u, rebound, jnp.where(free, self.delay(jnp.where(free, u, 1.0), safe), 0.0))

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

    def coordinate(self, approach_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the coordinate Y in nm/us of an impact that comes at a speed in nm/us above capture."""
        square = self.epsilon + (self.viscous_loss / (2.0 * self.r)) ** 2
        rebound = self.rebound_speed(approach_speed)
        return rebound + jnp.sqrt(jnp.maximum(rebound**2 + square, 1e-300))

    def speeds(self, coordinate: Float[Array, "..."]) -> Speeds:
        """Return the speeds and the delay at a coordinate Y > q in nm/us, in which the law is smooth up to capture.

        u = c/2r^2 + (Y + q^2/Y)/2r, w = (Y - q^2/Y)/2, q^2 = epsilon + c^2/4r^2.
        """
        square = self.epsilon + (self.viscous_loss / (2.0 * self.r)) ** 2
        middle = self.viscous_loss / (2.0 * self.r**2)
        # without a loss besides r the tip is captured at Y = 0, where the quotient is 0
        kept = square / jnp.where(coordinate == 0.0, 1.0, coordinate)
        approach = middle + (coordinate + kept) / (2.0 * self.r)
        rebound = 0.5 * (coordinate - kept)
        delay = jnp.zeros_like(approach) if self.delay is None else self.delay(approach, rebound)
        return Speeds(approach, rebound, delay)


MOST_KNOTS = 24
"""Knots of a table's splines: tables of more rows are smoothed by least squares, of fewer go through every row."""
_LEAST_ROWS = 4


class TabulatedLaw(Law):
    """An impact law as a table: approach speeds, the rebound speeds that they lead to, and the collision delays.

    Above the capture speed u_c, u_out^2 = (u^2 - u_c^2) (r^2 - c/(u + u_c)) exp(s): a formula of eq. 6 with the same
    capture speed, close to the table, times what is left, a natural cubic spline s over v/(v + V), v^2 = u^2 - u_c^2.
    That is smooth down to capture and positive for whatever s. The delay is that of a `CollisionDelay` and a spline of
    the same kind. Outside the table's speeds the splines go on as straight lines: `extrapolated` says where.

    A law that is known with errors has deviations: changes of its numbers, one for each of several independent unknowns
    of unit variance (`with_errors`), from which `sample` draws laws.

    Every number is traced, so that a law may be differentiated by them, and laws of as many rows share one compiled
    program. Each array's last axis is the spline's; batches of laws have axes in front of it.

    Args:
        approach_speed_nm_per_us: u_in, at least four, increasing, shape (rows,).
        rebound_speed_nm_per_us: u_out, not above u_in; 0: captured, for the slowest rows only.
        collision_delay_us: of every row, where captured ignored; None: instantaneous impacts.
        capture_speed_nm_per_us: u_c; None: extrapolated from the table.
        delay: the formula of the delay that the spline is added to, and whose corrections count; None: the closest one,
            with corrections.
        mass_ng: the mass of the tip that the table is of; None: not known.
        origin: what the table comes from, in words; it changes nothing.
        most_knots: knots of its splines: tables of more rows are smoothed by least squares.

    Raises:
        ValueError: if there are fewer than four rows that rebound, speeds do not increase, a rebound is faster than its
            approach, or a value is not finite.

    >>> import jax
    >>> with jax.enable_x64(True):
    ...     law = TabulatedLaw([12.0, 20.0, 50.0, 200.0], [4.69, 16.7, 48.7, 199.6])
    ...     print(round(float(law.rebound_speed(20.0)), 6), round(float(law.capture_speed_nm_per_us), 1))
    16.7 11.0
    """

    capture: Float[Array, "..."]
    r: Float[Array, "..."]
    viscous_loss: Float[Array, "..."]
    scale_nm_per_us: Float[Array, "..."]
    knots: Float[Array, "... knots"]
    loss_spline: Float[Array, "... numbers"]
    delay_spline: Float[Array, "... numbers"]
    slowest_nm_per_us: Float[Array, "..."]
    fastest_nm_per_us: Float[Array, "..."]
    origin: "Origin" = eqx.field(static=True)
    mass_ng: Float[Array, "..."] | None = None
    delay: CollisionDelay | None = None
    deviations: dict[str, Float[Array, "deviations ..."]] | None = None

    def __init__(  # noqa: PLR0913
        self,
        approach_speed_nm_per_us: ArrayLike | Sequence[float],
        rebound_speed_nm_per_us: ArrayLike | Sequence[float],
        collision_delay_us: ArrayLike | Sequence[float] | None = None,
        *,
        capture_speed_nm_per_us: ArrayLike | None = None,
        delay: CollisionDelay | None = None,
        mass_ng: ArrayLike | None = None,
        origin: str = "",
        most_knots: int = MOST_KNOTS,
    ):
        """Make a law of columns: see the class."""
        u, w, late, captured = _columns_of_law(approach_speed_nm_per_us, rebound_speed_nm_per_us, collision_delay_us)
        held = max(captured, default=0.0)
        check_parameter("mass_ng", mass_ng, "positive", optional=True)
        check_kind("delay", delay, CollisionDelay | None)
        if delay is not None and late is None:
            raise ValueError("`delay` needs the column `collision_delay_us`, which the table does not have")
        given, numpy = capture_speed_nm_per_us, _numpy_of(u, w, late, capture_speed_nm_per_us, delay)
        if given is None:
            capture = _capture_speed(u, w, held, numpy)
        else:
            check_parameter("capture_speed_nm_per_us", given, "not negative")
            capture = numpy.asarray(as_parameter(given))
            if not any(map(is_traced, (capture, u))) and not held <= float(capture) < float(u[0]):
                raise ValueError(
                    f"`capture_speed_nm_per_us` must lie below the slowest tip that leaves, {float(u[0]):g} nm/us"
                    + (f", and not below the fastest that is captured, {held:g} nm/us" if held else "")
                    + f", but is {float(capture):g}"
                )
        r, viscous_loss = _closest_formula(u, w, capture, numpy)
        scale = numpy.sqrt(u[0] * u[-1])
        place = _place(numpy.sqrt((u - capture) * (u + capture)), scale)
        count = min(place.shape[0], most_knots)
        # of more rows than knots every so many is one, first and last among them
        knots = place[np.round(np.linspace(0, place.shape[0] - 1, count)).astype(int)]
        if late is not None and delay is None:
            delay = closest_delay(u, w, late, numpy)
        self.capture, self.r, self.viscous_loss = map(jnp.asarray, (capture, r, viscous_loss))
        self.scale_nm_per_us, self.knots = jnp.asarray(scale), jnp.asarray(knots)
        self.delay = delay  # pyright: ignore[reportIncompatibleMethodOverride]
        self.loss_spline, self.delay_spline = map(jnp.asarray, _splines(u, w, late, capture, self, numpy))
        self.slowest_nm_per_us, self.fastest_nm_per_us = jnp.asarray(u[0]), jnp.asarray(u[-1])
        self.mass_ng = None if mass_ng is None else as_parameter(mass_ng)
        self.origin = Origin(origin)
        self.deviations = None

    @classmethod
    def with_errors(
        cls,
        approach_speed_nm_per_us: ArrayLike | Sequence[float],
        rebound_speed_nm_per_us: ArrayLike | Sequence[float],
        collision_delay_us: ArrayLike | Sequence[float] | None = None,
        *,
        rebound_changes: ArrayLike,
        delay_changes: ArrayLike | None = None,
        capture_changes: ArrayLike | None = None,
        **options: Any,
    ) -> "TabulatedLaw":
        """Return a law whose table is known with errors: a factor of the covariance of all its columns.

        Args:
            approach_speed_nm_per_us: u_in, shape (rows,).
            rebound_speed_nm_per_us: u_out.
            collision_delay_us: of every row; None: instantaneous impacts.
            rebound_changes: changes of u_out in nm/us, shape (unknowns, rows), by one standard deviation of each of
                several independent unknowns.
            delay_changes: such changes of the delay in us; None: it is known.
            capture_changes: such changes of a capture speed that is given, shape (unknowns,); None: an extrapolated one
                changes with the rebounds, a given one is known.
            options: `capture_speed_nm_per_us`, `delay`, `mass_ng` and `origin` of a law.

        Raises:
            ValueError: as of a law, or if shapes do not fit.
        """
        law = cls(approach_speed_nm_per_us, rebound_speed_nm_per_us, collision_delay_us, **options)
        u, w, late, captured = _columns_of_law(approach_speed_nm_per_us, rebound_speed_nm_per_us, collision_delay_us)
        by_rebound = np.asarray(rebound_changes, float)
        if by_rebound.ndim != 2 or by_rebound.shape[1] != len(captured) + len(u):
            raise ValueError(f"`rebound_changes` must have the shape (unknowns, rows), but has {by_rebound.shape}")
        by_rebound, nothing = by_rebound[:, len(captured) :], np.zeros((by_rebound.shape[0], 1))
        by_delay = nothing if delay_changes is None else np.asarray(delay_changes, float)[:, len(captured) :]
        by_capture = nothing[:, 0] if capture_changes is None else np.asarray(capture_changes, float)
        extrapolated = options.get("capture_speed_nm_per_us") is None
        capture = np.asarray(law.capture)

        def along(by_rebound: Any, by_delay: Any, by_capture: Any) -> dict[str, Any]:
            # no rebound, and no distance from capture, changes by more than 1 %
            relative = np.abs(np.append(by_rebound, by_capture)) / np.append(w, u[0] - capture)
            small, ends = _SMALL / np.maximum(1.0, 100.0 * _SMALL * np.max(relative)), []
            for side in (-small, small):
                rebound, held = w + side * by_rebound, capture + side * by_capture
                if extrapolated:
                    held = _capture_speed(u, rebound, 0.0, np)
                delayed = None if late is None else late + side * by_delay
                # the formula beside the table and the splines' knots stay as they are
                ends.append((held, *_splines(u, rebound, delayed, held, law, np)))
            names = ("capture", "loss_spline", *(("delay_spline",) if late is not None else ()))
            return {name: (end - start) / (2.0 * small) for name, start, end in zip(names, *ends, strict=False)}

        each = [along(*change) for change in zip(by_rebound, by_delay, by_capture, strict=True)]
        deviations = {name: jnp.asarray([one[name] for one in each]) for name in each[0]}
        return _replaced(law, deviations=deviations)

    def for_scene(self) -> "TabulatedLaw":
        """Return the law alone, without the other results of a fit: what scenes hold."""
        return self if type(self) is TabulatedLaw else _replaced(self)

    def moved(self, unknowns: ArrayLike) -> "TabulatedLaw":
        """Return the law for values of the unknowns of its errors, in standard deviations, shape (unknowns,)."""
        if self.deviations is None:
            return self
        steps = jnp.asarray(unknowns)
        changes = {name: jnp.tensordot(steps, change, axes=1) for name, change in self.deviations.items()}
        moved = {name: getattr(self, name) + change for name, change in changes.items()}
        # a loss so small that it is not sure to be one
        moved["capture"] = jnp.maximum(moved["capture"], 0.0)
        return _replaced(self, **moved, deviations=None)

    def sample(self, key: Array, n: int) -> "TabulatedLaw":
        """Return laws drawn from the errors of this one: one law whose every number has a first axis of length n.

        `jax.vmap` maps over them; `jax.tree.map(lambda leaf: leaf[i], laws)` is the one of a number.

        Args:
            key: a key of `jax.random`.
            n: how many.

        Raises:
            ValueError: if nothing is known of the law's errors.
        """
        if self.deviations is None:
            raise ValueError(
                "nothing is known of this law's errors: samples are of a fit's law, or of a table with errors"
            )
        return jax.vmap(self.moved)(jax.random.normal(key, (n, self.unknowns)))

    @property
    def unknowns(self) -> int:
        """How many independent unknowns its errors have; 0 where nothing is known of them."""
        return 0 if self.deviations is None else self.deviations["capture"].shape[-1 if self.capture.ndim else 0]

    def __repr__(self) -> str:
        """Return what the law is of, without its splines."""
        end = self.slowest_nm_per_us
        if not isinstance(end, Array | np.ndarray) or is_traced(end) or end.ndim:
            return "TabulatedLaw(...)"
        speeds = f"{float(self.slowest_nm_per_us):.6g} to {float(self.fastest_nm_per_us):.6g} nm/us"
        captured = f"captured at {float(self.capture_speed_nm_per_us):.6g}"
        return f"TabulatedLaw({speeds}, {captured}, delay={self.delay!r}, origin={self.origin.text!r})"

    @property
    def capture_speed_nm_per_us(self) -> Float[Array, "..."]:
        """Approach speed up to which the tip is captured: given, or extrapolated from the table."""
        return self.capture

    @property
    def epsilon(self) -> Float[Array, "..."]:
        """Loss by adhesion of the formula that the table is written beside, in nm^2/us^2."""
        return self.capture * (self.r**2 * self.capture - self.viscous_loss)

    @property
    def adheres(self) -> Bool[Array, "..."]:
        """Whether there is a capture speed: what takes a tip's last energy holds it."""
        return self.capture > 0.0

    @property
    def slow_restitution(self) -> Float[Array, "..."]:
        """u_out/u_in of the slowest impacts where nothing is captured, extrapolated."""
        return self.r * jnp.exp(0.5 * _spline(self.loss_spline, self.knots, jnp.zeros_like(self.r)))

    @property
    def lowest(self) -> Float[Array, "..."]:
        """Coordinate at which the tip is captured: the capture speed."""
        return self.capture

    def extrapolated(self, approach_speed: ArrayLike) -> Bool[Array, "..."]:
        """Say whether an approach speed in nm/us is outside the table's."""
        u = as_argument(approach_speed)
        return (u < self.slowest_nm_per_us) | (u > self.fastest_nm_per_us)

    def coordinate(self, approach_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return Y = u + sqrt(u^2 - u_c^2) in nm/us."""
        free = approach_speed > self.capture
        return approach_speed + jnp.where(free, self._beyond(jnp.where(free, approach_speed, jnp.inf)), 0.0)

    def speeds(self, coordinate: Float[Array, "..."]) -> Speeds:
        """Return speeds and delay at Y: u = (Y + u_c^2/Y)/2, v = (Y - u_c^2/Y)/2."""
        kept = self.capture**2 / jnp.where(coordinate == 0.0, 1.0, coordinate)
        return self.beyond_capture(0.5 * (coordinate + kept), 0.5 * (coordinate - kept))

    def _beyond(self, u: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return v = sqrt(u^2 - u_c^2) in nm/us."""
        return jnp.sqrt((u - self.capture) * (u + self.capture))

    def beyond_capture(self, u: Float[Array, "..."], v: Float[Array, "..."]) -> Speeds:
        """Return speeds and delay where u and v = sqrt(u^2 - u_c^2), in nm/us, are both known."""
        place = _place(v, self.scale_nm_per_us)
        rebound = v * jnp.sqrt(_formula(u, self.capture, self.r, self.viscous_loss))
        rebound = rebound * jnp.exp(0.5 * _spline(self.loss_spline, self.knots, place))
        if self.delay is None:
            return Speeds(u, rebound, jnp.zeros_like(rebound))
        return Speeds(u, rebound, self.delay(u, rebound) + _spline(self.delay_spline, self.knots, place))

    def at_approach(self, approach_speed: ArrayLike) -> Speeds:
        """Return the speeds in nm/us and the delay in us at an approach speed; 0 where the tip is captured."""
        u = as_argument(approach_speed)
        free = u > self.capture
        safe = jnp.where(free, u, self.capture + self.scale_nm_per_us)
        speeds = self.beyond_capture(safe, self._beyond(safe))
        return Speeds(u, jnp.where(free, speeds.rebound, 0.0), jnp.where(free, speeds.delay, 0.0))

    def approach_speed(self, rebound_speed: ArrayLike) -> Float[Array, "..."]:
        """Return the u_in in nm/us that leaves at u_out in nm/us; differentiable."""
        w = as_argument(rebound_speed)
        leaves = w > 0.0
        safe = jnp.where(leaves, w, 1.0)
        v, _ = lax.stop_gradient(read_backwards(self, safe))
        beyond = jnp.where(leaves, implicit_root(_rebound_misfit, v, (self, safe)), 0.0)
        square = beyond**2 + self.capture**2
        positive = square > 0.0
        return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


@jax.jit
def _at_knots(law: TabulatedLaw) -> Speeds:
    v = law.scale_nm_per_us * law.knots / (1.0 - law.knots)
    return law.beyond_capture(jnp.sqrt(v**2 + law.capture**2), v)


_SMALL = 1e-3
"""Part of an error over which a derivative is taken."""
_NUMBERS = ("capture", "r", "viscous_loss", "scale_nm_per_us", "knots", "loss_spline", "delay_spline")
_SPLINES = ("knots", "loss_spline", "delay_spline")


_OF_DELAY = ("hertz", "lead_nm", "offset_nm")


def _replaced(law: TabulatedLaw | None, **parts: Any) -> TabulatedLaw:
    """Return a law with other fields, or of all its fields, without the checks of a table."""
    made = object.__new__(TabulatedLaw)
    for field in dataclasses.fields(TabulatedLaw):
        value = parts[field.name] if field.name in parts else getattr(law, field.name)
        object.__setattr__(made, field.name, value)
    return made


@as_json.register
def _(law: TabulatedLaw) -> dict[str, Any]:
    """Return the law as numbers and lists, from which `law_of_dict` makes it again; what is absent is left out."""
    # a program for laws of however many unknowns
    found = _at_knots(_replaced(law, deviations=None))
    numbers = {name: getattr(law, name) for name in _NUMBERS}
    told: dict[str, Any] = {
        "approach_speed_nm_per_us": found.approach,
        "rebound_speed_nm_per_us": found.rebound,
        "capture_speed_nm_per_us": law.capture,
        "speed_range_nm_per_us": [law.slowest_nm_per_us, law.fastest_nm_per_us],
        "mass_ng": law.mass_ng,
        "origin": law.origin.text or None,
        "numbers": numbers,
        "deviations": law.deviations,
    }
    if law.delay is not None:
        told |= {"collision_delay_us": found.delay, "corrections": law.delay.corrections}
        numbers |= {name: getattr(law.delay, name) for name in _OF_DELAY}
    return {name: plain(value) for name, value in told.items() if value is not None}


def law_of_dict(told: Mapping[str, Any]) -> TabulatedLaw:
    """Return the law that `as_json` of one tells, number for number, or of a table with columns of these names.

    Raises:
        ValueError: if columns are missing or are no table of a law.
        LookupError: if one of its numbers is missing.
    """
    names = ("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "collision_delay_us")
    missing = [name for name in names[:2] if not isinstance(told.get(name), list | np.ndarray)]
    if missing:
        raise ValueError(f"the law lacks {' and '.join(missing)}")
    columns = [_told(name, told[name], (len(told[name]),)) for name in names if name in told]
    numbers, mass, origin = told.get("numbers"), told.get("mass_ng"), str(told.get("origin", ""))
    if not isinstance(numbers, Mapping):
        capture = told.get("capture_speed_nm_per_us")
        return TabulatedLaw(*columns, capture_speed_nm_per_us=capture, mass_ng=mass, origin=origin)
    _columns_of_law(*columns)
    check_parameter("mass_ng", mass, "positive", optional=True)
    knots = (np.size(numbers["knots"]),)
    spline = (knots[0] + 2,)
    shapes = {"knots": knots, "loss_spline": spline, "delay_spline": spline}
    deviations = told.get("deviations")
    if deviations is not None:
        count = len(deviations["capture"])
        deviations = {
            name: _told(f"deviations.{name}", deviations[name], (count, *shapes.get(name, ()))) for name in deviations
        }
    slowest, fastest = _told("speed_range_nm_per_us", told.get("speed_range_nm_per_us"), (2,))
    delay = None
    if "hertz" in numbers:
        values = (numbers[name] for name in _OF_DELAY)
        delay = CollisionDelay(*values, corrections=bool(told.get("corrections", True)))
    return _replaced(
        None,
        **{name: _told(name, numbers[name], shapes.get(name, ())) for name in _NUMBERS},
        slowest_nm_per_us=slowest,
        fastest_nm_per_us=fastest,
        origin=Origin(origin),
        mass_ng=None if mass is None else as_parameter(mass),
        delay=delay,
        deviations=deviations,
    )


def _told(name: str, number: Any, shape: tuple[int, ...]) -> Any:
    """Return a number of a law that a file tells, or an array of them.

    Raises:
        ValueError: if it is no number, not of that shape, or not finite.
    """
    try:
        found = np.asarray(number, float)
    except (OverflowError, TypeError, ValueError) as error:
        raise ValueError(f"`{name}` of the law must be numbers") from error
    if found.shape != shape or not np.isfinite(found).all():
        many = f"{' x '.join(map(str, shape))} finite numbers" if shape else "a finite number"
        raise ValueError(f"`{name}` of the law must be {many}")
    return jnp.asarray(found)


def axes_of_one(scene: Scene) -> Scene:
    """Return how many axes each number of a scene has if it is one scene: those of a law's table have their own."""
    axes = jax.tree.map(lambda _: 0, scene)
    law = scene.interaction
    if not isinstance(law, TabulatedLaw):
        return axes
    axes = eqx.tree_at(lambda scene: [getattr(scene.interaction, name) for name in _SPLINES], axes, [1] * len(_SPLINES))
    if law.deviations is None:
        return axes
    own = {name: 2 if name in _SPLINES else 1 for name in law.deviations}
    return eqx.tree_at(lambda scene: scene.interaction.deviations, axes, own)


_SECANTS = 6
"""Evaluations of a law to read it backwards."""


def read_backwards(
    law: Law, rebound: Float[Array, "..."], lasting: Callable[[Speeds, Array], Speeds] = lambda free, _: free
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return v = (Y - q^2/Y)/2 of the coordinate Y, and the delay, of the impact that leaves with a rebound speed.

    Secants in ln v, with which the logarithm of the rebound grows nearly in proportion.

    Args:
        law: its `lowest` coordinate is q.
        rebound: in nm/us, positive.
        lasting: takes speeds and delay of a free tip and the delay of the last round, returns those of the impact.
    """

    def improve(_: Any, state: tuple[Array, ...]) -> tuple[Array, ...]:
        place, before, missed, delay = state
        v = jnp.exp(place)
        speeds = lasting(law.speeds(v + jnp.sqrt(v * v + law.lowest**2)), delay)
        miss = jnp.log(speeds.rebound / rebound)
        apart = place - before
        slope = jnp.clip((miss - missed) / jnp.where(apart == 0.0, 1.0, apart), 0.5, 2.0)
        return place - miss / jnp.where(apart == 0.0, 1.0, slope), place, miss, speeds.delay

    begin = jnp.log(rebound)
    nothing = jnp.zeros_like(begin)
    place, _, _, delay = lax.fori_loop(0, _SECANTS, improve, (begin, begin, nothing, nothing))
    return jnp.exp(place), delay


def _rebound_misfit(beyond: Array, law_and_rebound: tuple[TabulatedLaw, Array]) -> Array:
    """Return by how much the rebound at v misses the wanted one, in nm/us."""
    law, rebound = law_and_rebound
    return law.beyond_capture(jnp.sqrt(beyond**2 + law.capture**2), beyond).rebound - rebound


@dataclasses.dataclass(frozen=True, eq=False)
class Origin:
    """What a law comes from, in words: static data of a module, all equal, so that no text compiles programs anew."""

    text: str = ""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Origin)

    def __hash__(self) -> int:
        return hash(Origin)


def _columns_of_law(approach: Any, rebound: Any, delay: Any = None) -> tuple[Any, Any, Any, list[float]]:
    """Return the columns of rows that leave, checked as far as their numbers are known, and the speeds captured.

    The columns are approach and rebound speed in nm/us and the delay in us; the captured rows are the slowest.

    Raises:
        ValueError: as `TabulatedLaw`.
    """
    u = _column("approach_speed_nm_per_us", approach)
    w = _column("rebound_speed_nm_per_us", rebound, len(u))
    late = None if delay is None else _column("collision_delay_us", delay, len(u))
    if len(u) < _LEAST_ROWS:
        raise ValueError(f"a table of a law needs at least four speeds, but has {len(u)}")
    if is_traced(u):
        return u, w, late, []
    fall = np.flatnonzero(np.diff(u) <= 0.0)
    if fall.size:
        first, second = u[fall[0]], u[fall[0] + 1]
        raise ValueError(
            f"`approach_speed_nm_per_us` must increase from row to row, but {second:g} follows {first:g} in row "
            f"{fall[0] + 2}"
        )
    if u[0] <= 0.0:
        raise ValueError(f"`approach_speed_nm_per_us` must be positive, but is {u[0]:g} in row 1")
    captured = 0 if is_traced(w) else _captured_rows(u, w)
    if len(u) - captured < _LEAST_ROWS:
        raise ValueError(f"a table of a law needs at least four speeds that leave, but has {len(u) - captured}")
    late = None if late is None else late[captured:]
    return u[captured:], w[captured:], late, u[:captured].tolist()


def _numpy_of(*values: Any) -> Any:
    """Return JAX's NumPy where a value is traced, else NumPy itself: what is computed once is not compiled."""
    return jnp if any(map(is_traced, jax.tree.leaves(values))) else np


def _column(name: str, values: Any, rows: int | None = None) -> Any:
    """Return a column of a table, NumPy's where its numbers are known: finite ones, as many as there are speeds.

    Raises:
        ValueError: if they are something else.
    """
    column = as_parameter(values)
    if not is_traced(column):
        column = as_real(name, column)
        if column.ndim != 1:
            raise ValueError(f"`{name}` must be a column of numbers, but has shape {column.shape}")
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size:
            raise ValueError(f"`{name}` must be finite numbers, but is {column[bad[0]]} in row {bad[0] + 1}")
    if rows is not None and column.shape != (rows,):
        raise ValueError(f"`{name}` must have a number for each of the {rows} speeds, but has {column.shape[0]}")
    return column


def _captured_rows(u: Float[np.ndarray, " n"], w: Float[np.ndarray, " n"]) -> int:
    """Return how many rows, the slowest, have no rebound; check those that have."""
    for bad, must in ((w < 0.0, "not be negative"), (w > u, "not be faster than the approach")):
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise ValueError(f"`rebound_speed_nm_per_us` must {must}, but is {w[row]:g} at {u[row]:g} in row {row + 1}")
    stays = np.flatnonzero(w == 0.0)
    if stays.size and stays[-1] != stays.size - 1:
        raise ValueError(f"`rebound_speed_nm_per_us` is 0 (captured) in row {stays[-1] + 1}, but slower tips leave")
    return stays.size


def _capture_speed(u: Any, w: Any, held: float, numpy: Any) -> Any:
    """Return the capture speed in nm/us that a table points to.

    That of u_out^2 = a u^2 - c u - b by linear least squares, slow rows counting most; with c = 0 where that is no law.
    No loss but that of capture at the slowest row is the most it can be.

    Args:
        u: approach speeds in nm/us.
        w: rebound speeds.
        held: the fastest approach that is captured, 0 without one.
        numpy: NumPy or JAX's.
    """
    low = u[0]
    ratio, one = (w / u) ** 2, numpy.ones_like(u)
    columns = [one, -low / u, -((low / u) ** 2)]
    weight = low / u

    def fitted(chosen: list[Any]) -> Any:
        return numpy.linalg.lstsq(numpy.stack(chosen, axis=1) * weight[:, None], ratio * weight, rcond=None)[0]

    a, c, b = fitted(columns)
    flat_a, flat_b = fitted(columns[::2])
    curved = (a > 0.0) & (b > -_NOTHING) & (c >= 0.0)
    a = numpy.where(curved, a, flat_a)
    c = numpy.where(curved, c, 0.0)
    b = numpy.where(curved, b, flat_b)
    there = (a > 0.0) & (c * c + 4.0 * a * b > 0.0) & (b > -_NOTHING)
    root = numpy.sqrt(numpy.where(there, c * c + 4.0 * a * numpy.maximum(b, _NOTHING), 1.0))
    found = low * numpy.where(
        there & ((c > _NOTHING) | (b > _NOTHING)), (c + root) / (2.0 * numpy.where(there, a, 1.0)), 0.0
    )
    most = numpy.maximum((u[0] - w[0]) * (u[0] + w[0]), 0.0)
    most = numpy.where(most > 0.0, numpy.sqrt(numpy.where(most > 0.0, most, 1.0)), 0.0)
    return numpy.clip(found, held, numpy.maximum(most, held))


_NOTHING = 1e-12
"""Share of the squared approach speed below which a loss by adhesion or viscosity is rounding."""


def _closest_formula(u: Any, w: Any, capture: Any, numpy: Any) -> tuple[Any, Any]:
    """Return r and c of the formula with a capture speed that is closest to a table, in relative squared speeds."""
    square = (u - capture) * (u + capture)
    columns = numpy.stack([numpy.ones_like(u), -1.0 / (u + capture)], axis=1)
    # relative to the rebound of the table
    weight = square / (w * w)
    kept, viscous = numpy.linalg.lstsq(columns * weight[:, None], numpy.ones_like(u), rcond=None)[0]
    # a loss that grows with the speed alone, and no more than all there is at capture
    good = (viscous > 0.0) & (kept > 0.0) & (viscous < 2.0 * kept * capture)
    alone = numpy.sum(weight) / numpy.sum(weight**2)
    return numpy.sqrt(numpy.where(good, kept, alone)), numpy.where(good, viscous, 0.0)


def _formula(u: Any, capture: Any, r: Any, viscous_loss: Any, numpy: Any = jnp) -> Any:
    """Return u_out^2/(u^2 - u_c^2) of a formula with the capture speed u_c: r^2 - c/(u + u_c)."""
    total = u + capture
    return r**2 - viscous_loss / numpy.where(total > 0.0, total, 1.0)


def _place(v: Any, scale: Any) -> Any:
    """Return the splines' variable v/(v + V), 0 at capture, 1 at infinite speed."""
    return v / (v + scale)


def _cubes(knots: Any, place: Any, numpy: Any = jnp) -> Any:
    return numpy.maximum(place[..., None] - knots, 0.0) ** 3


def _spline(spline: Float[Array, "... numbers"], knots: Float[Array, "... knots"], place: Array) -> Float[Array, "..."]:
    """Return a natural cubic spline: value and slope at the first knot, and the factors of (x - knot)_+^3."""
    bends = jnp.sum(spline[..., 2:] * _cubes(knots, place), axis=-1)
    return spline[..., 0] + spline[..., 1] * (place - knots[..., 0]) + bends


def _natural(knots: Any, numpy: Any) -> Any:
    """Return what makes a natural spline's numbers of its values at the knots, shape (numbers, knots)."""
    count = knots.shape[0]
    h = numpy.diff(knots)
    one = numpy.eye(count)
    steep = (one[1:] - one[:-1]) / h[:, None]
    # second derivatives, 0 at both ends
    inner = numpy.diag(2.0 * (h[:-1] + h[1:])) + numpy.diag(h[1:-1], 1) + numpy.diag(h[1:-1], -1)
    bend = numpy.pad(numpy.linalg.solve(inner, 6.0 * (steep[1:] - steep[:-1])), ((1, 1), (0, 0)))
    third = numpy.pad(numpy.diff(bend, axis=0) / h[:, None], ((1, 1), (0, 0)))
    first = steep[0] - h[0] * bend[1] / 6.0
    return numpy.concatenate([one[:1], first[None], numpy.diff(third, axis=0) / 6.0])


def _splines(u: Any, w: Any, late: Any, capture: Any, law: TabulatedLaw, numpy: Any) -> tuple[Any, Any]:
    """Return the natural splines of loss and delay through a table's rows, or of more rows than knots the closest ones.

    Args:
        u: approach speeds in nm/us.
        w: rebound speeds.
        late: delays in us; None: instantaneous impacts.
        capture: the capture speed.
        law: what the splines are written beside: its knots, scale of the speed, formula and delay.
        numpy: NumPy or JAX's.
    """
    numbers = law.knots, law.scale_nm_per_us, law.r, law.viscous_loss
    (knots, scale, r, viscous_loss), delay = map(numpy.asarray, numbers), law.delay
    square = (u - capture) * (u + capture)
    loss = numpy.log(w * w / (square * _formula(u, capture, r, viscous_loss, numpy)))
    left = numpy.zeros_like(loss)
    if late is not None and delay is not None:
        hertz, lead, offset = (numpy.asarray(getattr(delay, name)) for name in _OF_DELAY)
        left = late - (hertz * u**-0.2 - lead * (1.0 / w - 1.0 / u) - offset / u)
    place, numbers = _place(numpy.sqrt(square), scale), _natural(knots, numpy)
    shapes = [numpy.ones_like(place)[:, None], (place - knots[0])[:, None], _cubes(knots, place, numpy)]
    # by their values at the knots
    by_values = numpy.concatenate(shapes, axis=1) @ numbers
    values = numpy.stack([loss, left], axis=1)
    if place.shape == knots.shape:
        found = numbers @ numpy.linalg.solve(by_values, values)
    else:
        found = numbers @ numpy.linalg.lstsq(by_values, values, rcond=None)[0]
    return found[:, 0], found[:, 1]


def closest_delay(u: Any, w: Any, delay: Any, numpy: Any = jnp) -> CollisionDelay:
    """Return the delay formula closest to a table's delays in us, by linear least squares; speeds in nm/us."""
    columns = numpy.stack([u**-0.2, 1.0 / u - 1.0 / w, -1.0 / u], axis=1)
    hertz, lead, offset = numpy.linalg.lstsq(columns, delay, rcond=None)[0]
    # a Hertz time must be one: where the three tell none, alone
    good = hertz > 0.0
    alone = numpy.maximum(numpy.sum(columns[:, 0] * delay) / numpy.sum(columns[:, 0] ** 2), 0.0)
    return CollisionDelay(
        *(numpy.where(good, one, other) for one, other in ((hertz, alone), (lead, 0.0), (offset, 0.0)))
    )


def impact_law_of(scene: Scene) -> Law:
    """Return the scene's impact law: a formula or a table.

    Raises:
        TypeError: if the scene's interaction is something else.
    """
    if not isinstance(scene.interaction, Law):
        raise TypeError(
            "the impact map needs a scene whose interaction is a law, an ImpactLaw or a TabulatedLaw, not "
            f"{type(scene.interaction).__name__}"
        )
    return scene.interaction


def extrapolation_of(law: Any, speeds: Any) -> str | None:
    """Return a sentence on approach speeds outside those that a law is known for; None where there are none.

    Args:
        law: a law, or what else a scene's interaction may be.
        speeds: approach speeds in nm/us that count, of any shape; NaN: none.
    """
    if not isinstance(law, TabulatedLaw):
        return None
    known = np.asarray(speeds, float)
    known = known[np.isfinite(known)]
    outside = known[np.asarray(law.extrapolated(known))]
    if not outside.size:
        return None
    low, high = float(law.slowest_nm_per_us), float(law.fastest_nm_per_us)
    ends = " to ".join(dict.fromkeys(f"{end:.4g}" for end in (outside.min(), outside.max())))
    return (
        f"Extrapolated: the law is known from {low:.4g} to {high:.4g} nm/us, but {outside.size} of {known.size} "
        f"impacts come at {ends} nm/us."
    )
