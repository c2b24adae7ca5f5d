"""What every elastic contact of tip and sample has in common: its load and its depth, as functions of one root s.

The load as a function of the depth is not smooth where the contact forms or breaks. Both are polynomials of a root s
(of the contact radius for JKR, of the depth for Hertz and DMT), and the contact breaks at the fold, where the depth's
slope by s vanishes. With the work, the integral of the load over the depth, the energy of a tip is a polynomial too.
"""

import abc
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.checks import as_argument

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
        """Return s of the branch that is stable when pulled; below the depth of the fold that of the fold."""

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
        work, depth = (sum(factor * _mean_power(k, first, second) for k, factor in terms) for terms in self.terms)
        return work, depth


def _mean_power(degree: int, first: Float[Array, "..."], second: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return (a^n - b^n)/(a - b) as the sum of a^k b^(n-1-k)."""
    total, power = jnp.ones_like(second), jnp.ones_like(second)
    for _ in range(degree - 1):
        power = power * second
        total = total * first + power
    return total
