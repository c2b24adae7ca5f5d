"""What every force, the sum of several, and every elastic contact have in common.

Takes gaps in nm; gives forces in nN, stiffnesses in nN/nm, potentials in aJ, damping in nN us/nm.

A force is a function of the gap D between tip and sample in nm and of its rate in nm/us; attraction is negative. A
static force does not depend on the rate and has a potential; a dissipative one is -damping(D) dD/dt and has none.

The load of an elastic contact as a function of its depth is not smooth where it forms or breaks. Both are polynomials
of a root s (of the contact radius for JKR, of the depth for Hertz and DMT), and the contact breaks at the fold, where
the depth's slope by s vanishes. With the work, the integral of the load over the depth, the energy of a tip is a
polynomial too.
"""

import abc
import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.checks import as_argument, check_parameter, readable
from afm_jax.contact.parameters import CONTACT_RANGES
from afm_jax.solve.derivatives import slope_of


class Parameters(eqx.Module):
    """Fields with the name of a contact's parameter, in full or without the effect's name in front, have its range.

    Values are checked while they are concrete (`afm_jax.contact.parameters` has the ranges).
    """

    __repr__ = readable

    def __check_init__(self):
        self.check_ranges()

    def check_ranges(self) -> None:
        """Check every field that has a range; a class with further checks calls it first.

        Raises:
            ValueError: if a value is outside its range.
        """
        for field in dataclasses.fields(self):
            for name in (field.name, f"{type(self).__name__.lower()}_{field.name}"):
                if name in CONTACT_RANGES:
                    check_parameter(field.name, getattr(self, field.name), CONTACT_RANGES[name])


class Force(Parameters):
    """A force between tip and sample in nN; `a + b` is the sum of two."""

    @abc.abstractmethod
    def __call__(self, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Return the force on the tip in nN at a gap in nm that changes at a rate in nm/us; attraction is negative."""

    def __add__(self, other: "Force") -> "ForceSum":
        """Return the sum of two forces, in one flat list of terms."""
        if not isinstance(other, Force):
            return NotImplemented
        return ForceSum((*terms_of(self), *terms_of(other)))


class StaticForce(Force):
    """A force that depends on the gap alone and conserves energy."""

    @abc.abstractmethod
    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return what the parameters contribute to `potential_of`: computed once for many gaps."""

    @staticmethod
    @abc.abstractmethod
    def potential_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the potential energy in aJ from the coefficients, at a gap in nm."""

    def potential(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return the potential energy in aJ at a gap in nm; the force is minus its slope."""
        return self.potential_of(self.coefficients(), as_argument(gap_nm))

    def __call__(self, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Return the force in nN at a gap in nm, minus the slope of the potential; the rate does not matter."""
        del gap_rate_nm_per_us
        return -slope_of(self.potential, as_argument(gap_nm))

    def stiffness(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return -dF/dD in nN/nm at a gap in nm."""
        return -slope_of(self, as_argument(gap_nm))


class DissipativeForce(Force):
    """A force opposed to the motion, -damping(D) dD/dt."""

    @abc.abstractmethod
    def coefficients(self) -> tuple[Float[Array, "..."], ...]:
        """Return what the parameters contribute to `damping_of`: computed once for many gaps."""

    @staticmethod
    @abc.abstractmethod
    def damping_of(coefficients: tuple[Float[Array, "..."], ...], gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the damping in nN us/nm from the coefficients, at a gap in nm."""

    def damping(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return the damping in nN us/nm at a gap in nm."""
        return self.damping_of(self.coefficients(), as_argument(gap_nm))

    def __call__(self, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Return the force on the tip in nN: -damping(D) dD/dt."""
        return -self.damping(gap_nm) * gap_rate_nm_per_us


class ForceSum(Force):
    """The sum of several forces, without a bracket in it: `(a + b) + c` and `a + (b + c)` are the same sum.

    Args:
        terms: the forces.
    """

    terms: tuple[Force, ...]

    def __call__(self, gap_nm: ArrayLike, gap_rate_nm_per_us: ArrayLike = 0.0) -> Float[Array, "..."]:
        """Return the sum in nN at a gap in nm that changes at a rate in nm/us."""
        gap = as_argument(gap_nm)
        return sum((term(gap, gap_rate_nm_per_us) for term in self.terms), start=jnp.zeros_like(gap))

    def potential(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return the potential of the static forces in aJ at a gap in nm."""
        return self._total("potential", StaticForce, gap_nm)

    def stiffness(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return -dF/dD of the static forces in nN/nm at a gap in nm."""
        return self._total("stiffness", StaticForce, gap_nm)

    def damping(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return the damping of the dissipative forces in nN us/nm at a gap in nm."""
        return self._total("damping", DissipativeForce, gap_nm)

    def _total(self, what: str, kind: type[Force], gap_nm: ArrayLike) -> Float[Array, "..."]:
        gap = as_argument(gap_nm)
        parts = (getattr(term, what)(gap) for term in self.terms if isinstance(term, kind))
        return sum(parts, start=jnp.zeros_like(gap))


def terms_of(force: Force) -> tuple[Force, ...]:
    """Return the terms of a sum, or a single force as the only one."""
    return force.terms if isinstance(force, ForceSum) else (force,)


Terms = Sequence[tuple[int, float | Float[Array, "..."]]]
"""A polynomial of s: pairs of degree and factor."""


class ElasticCurve(eqx.Module):
    """An elastic contact in normalised variables: load and depth in units of the two scales, both functions of s."""

    load_scale_nn: Float[Array, "..."]
    depth_scale_nm: Float[Array, "..."]

    fold: ClassVar[float]
    """s where the contact breaks: the smallest one of a contact."""
    reversible: ClassVar[bool]
    """Whether the contact forms where it breaks, so that the way out is the way in, backwards."""

    @abc.abstractmethod
    def load(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the normalised load at s; repulsion is positive."""

    @abc.abstractmethod
    def depth(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the normalised depth at s; it grows into the sample."""

    @abc.abstractmethod
    def depth_slope(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the derivative of the normalised depth by s; 0 at the fold."""

    @abc.abstractmethod
    def work(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the normalised potential, the integral of the load over the depth from s = 0."""

    @abc.abstractmethod
    def root_of_depth(self, normalised_depth: ArrayLike) -> Float[Array, "..."]:
        """Return s of the branch that is stable under a pull; below the depth of the fold that of the fold."""

    @property
    @abc.abstractmethod
    def terms(self) -> tuple[Terms, Terms]:
        """Work and depth as polynomials of s."""

    @property
    @abc.abstractmethod
    def unloaded(self) -> Float[Array, "..."]:
        """S without load, where the work is least: beyond it the work is convex."""

    @abc.abstractmethod
    def beyond(self, work: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return an s that is not smaller than the one at which the work has a value."""

    @abc.abstractmethod
    def width(self, energy: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the distance in s from the fold over which a tip of a normalised kinetic energy there is slow."""

    @abc.abstractmethod
    def bend(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the size of the derivative of load times depth slope by s, bounded from below where it vanishes."""

    @abc.abstractmethod
    def reach(self, s: Float[Array, "..."], energy: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the distance in s over which the load changes, for a normalised kinetic energy at s."""

    @property
    def energy_scale_aj(self) -> Float[Array, "..."]:
        """The unit of work and energies, load scale times depth scale, in aJ."""
        return self.load_scale_nn * self.depth_scale_nm

    def force(self, depth_nm: ArrayLike) -> Float[Array, "..."]:
        """Return the force on the tip in nN at a depth in nm; repulsion is positive."""
        return self.load_scale_nn * self.load(self.root_of_depth(as_argument(depth_nm) / self.depth_scale_nm))

    def mean_slopes(
        self, first: Float[Array, "..."], second: Float[Array, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the mean slopes by s of work and depth between two roots, without the cancellation of differences."""
        nothing = jnp.zeros_like(second)
        means = _mean_powers(max(degree for terms in self.terms for degree, _ in terms), first, second)
        work, depth = (sum((factor * means[k - 1] for k, factor in terms), start=nothing) for terms in self.terms)
        return work, depth


def _mean_powers(highest: int, first: Float[Array, "..."], second: Float[Array, "..."]) -> list[Float[Array, "..."]]:
    """Return (a^n - b^n)/(a - b) = sum of a^k b^(n-1-k) for n = 1 to the highest degree, each from the one before."""
    means, power = [jnp.ones_like(second)], jnp.ones_like(second)
    for _ in range(highest - 1):
        power = power * second
        means.append(means[-1] * first + power)
    return means
