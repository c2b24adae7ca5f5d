"""What every force has in common, and the sum of several.

A force is a function of the gap D between tip and sample in nm and of its rate in nm/us; attraction is negative. A
static force does not depend on the rate and has a potential; a dissipative one is -damping(D) dD/dt and has none.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.checks import as_argument, readable


class Force(eqx.Module):
    """A force between tip and sample in nN; `a + b` is the sum of two."""

    __repr__ = readable

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

    def stiffness(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return -dF/dD in nN/nm at a gap in nm, by automatic differentiation of the force."""
        gap = as_argument(gap_nm)
        return -jax.jvp(self.__call__, (gap,), (jnp.ones_like(gap),))[1]


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

    @property
    def static(self) -> "ForceSum":
        """The static ones of the forces."""
        return ForceSum(tuple(term for term in self.terms if isinstance(term, StaticForce)))

    @property
    def dissipative(self) -> "ForceSum":
        """The dissipative ones of the forces."""
        return ForceSum(tuple(term for term in self.terms if isinstance(term, DissipativeForce)))

    def potential(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return the potential of the static forces in aJ at a gap in nm."""
        gap = as_argument(gap_nm)
        parts = (term.potential(gap) for term in self.terms if isinstance(term, StaticForce))
        return sum(parts, start=jnp.zeros_like(gap))

    def stiffness(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return -dF/dD of the static forces in nN/nm at a gap in nm."""
        gap = as_argument(gap_nm)
        parts = (term.stiffness(gap) for term in self.terms if isinstance(term, StaticForce))
        return sum(parts, start=jnp.zeros_like(gap))

    def damping(self, gap_nm: ArrayLike) -> Float[Array, "..."]:
        """Return the damping of the dissipative forces in nN us/nm at a gap in nm."""
        gap = as_argument(gap_nm)
        parts = (term.damping(gap) for term in self.terms if isinstance(term, DissipativeForce))
        return sum(parts, start=jnp.zeros_like(gap))


def terms_of(force: Force) -> tuple[Force, ...]:
    """Return the terms of a sum, or a single force as the only one."""
    return force.terms if isinstance(force, ForceSum) else (force,)
