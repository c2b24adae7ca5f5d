"""The liquid bridge as its crossings need it: potential and damping, with everything computed once that can be."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from afm_jax.contact.contact import Contact
from afm_jax.contact.forces.force import DissipativeForce, StaticForce


class Bridge(eqx.Module):
    """The forces of a bridge, reduced to their coefficients.

    A force's parameters enter thousands of evaluations of its potential; what depends on them alone is computed here.
    ``backwards``: time runs backwards, so that drag gives the energy that it takes.
    """

    static_kinds: tuple[type[StaticForce], ...] = eqx.field(static=True)
    static: tuple[tuple[Float[Array, "..."], ...], ...]
    dissipative_kinds: tuple[type[DissipativeForce], ...] = eqx.field(static=True)
    dissipative: tuple[tuple[Float[Array, "..."], ...], ...]
    backwards: bool = eqx.field(static=True, default=False)

    @property
    def conserves(self) -> bool:
        """Whether there is no dissipative force."""
        return not self.dissipative_kinds

    def potential(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the potential of all static forces in aJ at a gap in nm."""
        terms = zip(self.static_kinds, self.static, strict=True)
        return sum((kind.potential_of(parts, gap) for kind, parts in terms), start=jnp.zeros_like(gap))

    def force(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the force of all static forces in nN at a gap in nm."""
        return -jax.jvp(self.potential, (gap,), (jnp.ones_like(gap),))[1]

    def stiffness(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return -dF/dD of all static forces in nN/nm at a gap in nm."""
        return -jax.jvp(self.force, (gap,), (jnp.ones_like(gap),))[1]

    def damping(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the damping of all dissipative forces in nN us/nm at a gap in nm."""
        terms = zip(self.dissipative_kinds, self.dissipative, strict=True)
        total = sum((kind.damping_of(parts, gap) for kind, parts in terms), start=jnp.zeros_like(gap))
        return -total if self.backwards else total

    def reversed(self) -> "Bridge":
        """Return the bridge for a motion that is followed against time."""
        return replace(self, backwards=not self.backwards)


def bridge_of(contact: Contact) -> Bridge:
    """Return a contact's bridge.

    Raises:
        TypeError: if a force is neither static nor dissipative.
    """
    for term in contact.forces.terms:
        if not isinstance(term, StaticForce | DissipativeForce):
            raise TypeError(f"{type(term).__name__} must be a StaticForce or a DissipativeForce to be part of a bridge")
    static = [term for term in contact.forces.terms if isinstance(term, StaticForce)]
    dissipative = [term for term in contact.forces.terms if isinstance(term, DissipativeForce)]
    return Bridge(
        static_kinds=tuple(type(term) for term in static),
        static=tuple(term.coefficients() for term in static),
        dissipative_kinds=tuple(type(term) for term in dissipative),
        dissipative=tuple(term.coefficients() for term in dissipative),
    )
