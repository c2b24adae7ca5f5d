"""Equation of motion of a tip in contact (eq. 16), in the gap and its rate, phase by phase.

Takes contact, cantilever and surface; gives the rates of a `ContactState`: nm, nm/us, us, aJ.

With D = y - s(t), y the free cantilever's coordinate and s the surface it moves over, eq. 16 reads
D'' = F(D, D')/m - Omega^2 D - (Omega/Q) D' + q(t), with q = -(s'' + (Omega/Q) s' + Omega^2 s) all that depends on time.
Within a phase everything is smooth. In the junction the root s of the elastic contact takes the place of the gap, and
fictitious time that of time, dt = (d Delta/ds) d theta: both stay smooth through the fold where the contact breaks.
A free tip is one without Omega and q; its program has neither.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.surface import Surface, Wave
from afm_jax.contact.contact import Bridge, Contact, bridge_of
from afm_jax.contact.forces.force import ElasticCurve
from afm_jax.contact.junction import ContactPhase, Junction, find_junction


class ContactState(NamedTuple):
    """Variables of a tip in contact, or their rates; arrays of the tips' shape."""

    x: Float[Array, "..."]
    """The gap D in nm in the bridge, s = sqrt(A) in the junction."""
    gap_rate: Float[Array, "..."]
    """dD/dt in nm/us."""
    time_us: Float[Array, "..."]
    viscous_loss_aj: Float[Array, "..."]
    """Energy that the dissipative forces have taken since the contact began."""


class Leg(NamedTuple):
    """A leg of the quick way through a driven contact: bridge or junction as a whole; arrays of the tips' shape."""

    state: ContactState
    """Where it ends."""
    deepest_gap_nm: Float[Array, "..."]
    holds: Bool[Array, "..."]
    """Whether the tip goes straight on and the leg's nodes and iterations are enough."""


class Drive(NamedTuple):
    """What acts on the gap beside the contact: spring, air, and the motion of the surface."""

    cantilever: Cantilever
    surface: Platform | Surface
    push: Surface
    """q(t) in nm/us^2, what the surface's motion does to the gap, as another motion: offset, ramp and waves."""


class Driven(NamedTuple):
    """A tip in contact, with everything computed once that does not depend on where it is."""

    bridge: Bridge
    junction: Junction
    mass_ng: Float[Array, "..."]
    inverse_mass: Float[Array, "..."]
    forms_nm: Float[Array, "..."]
    breaks_nm: Float[Array, "..."]
    solid: ElasticCurve
    """The junction's elastic contact."""
    drive: Drive | None
    """None: a free tip over a sample at rest."""

    @property
    def ends_nm(self) -> Float[Array, "..."]:
        """Gap at which contact ends: where the bridge breaks, or the junction where that outlives the bridge."""
        return jnp.maximum(self.breaks_nm, self.junction.breaks_gap_nm)

    @property
    def elastic_aj(self) -> Float[Array, "..."]:
        """Energy that the junction takes from where it forms to where it breaks."""
        work = self.solid.work
        return self.solid.energy_scale_aj * (work(self.solid.fold) - work(self.junction.forms_root))

    @property
    def driving(self) -> Drive:
        """What acts on a tip that is driven."""
        if self.drive is None:
            raise TypeError("a free tip has neither cantilever nor surface")
        return self.drive

    def acceleration(
        self, gap: Float[Array, "..."], rate: Float[Array, "..."], time_us: Float[Array, "..."], force: Array
    ):
        """Return D'' in nm/us^2 under a contact force in nN."""
        if self.drive is None:
            return force * self.inverse_mass
        return (
            force * self.inverse_mass
            + self.drive.cantilever.acceleration(gap, rate)
            + self.drive.push.position(time_us)
        )

    def potential(self, gap: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the potential energy in aJ at a gap in nm in the bridge, that of the spring included."""
        if self.drive is None:
            return self.bridge.potential(gap)
        return self.bridge.potential(gap) + 0.5 * self.drive.cantilever.stiffness_n_per_m * gap * gap

    def gap_of_root(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the gap in nm at s = sqrt(A)."""
        return self.junction.shift_nm - self.solid.depth_scale_nm * self.solid.depth(s)

    def gap(self, x: Float[Array, "..."], phase: Int[Array, "..."]) -> Float[Array, "..."]:
        """Return the gap in nm, from s in the junction."""
        return jnp.where(phase == ContactPhase.JUNCTION, self.gap_of_root(x), x)

    def rates(self, state: ContactState, solid: Bool[Array, "..."]) -> ContactState:
        """Return the rates of a state per unit of time (bridge) or of fictitious time (junction).

        Trial steps may leave the range of the bridge's forces: they are evaluated no nearer than a third of D_on.
        """
        in_bridge = self._bridge_rates(state, jnp.where(solid, self.forms_nm, state.x))
        in_junction = self._junction_rates(state, jnp.where(solid, state.x, 1.0))
        return jax.tree.map(partial(jnp.where, solid), in_junction, in_bridge)

    def _bridge_rates(self, state: ContactState, gap: Float[Array, "..."]) -> ContactState:
        near = jnp.maximum(gap, 0.3 * self.junction.forms_gap_nm)
        force = self.bridge.force(near)
        lost = jnp.zeros_like(gap)
        if not self.bridge.conserves:
            drag = self.bridge.damping(near) * state.gap_rate
            force, lost = force - drag, drag * state.gap_rate
        acceleration = self.acceleration(gap, state.gap_rate, state.time_us, force)
        return ContactState(state.gap_rate, acceleration, jnp.ones_like(gap), lost)

    def _junction_rates(self, state: ContactState, s: Float[Array, "..."]) -> ContactState:
        slope = self.solid.depth_slope(s)
        force = self.solid.load_scale_nn * self.solid.load(s)
        acceleration = self.acceleration(self.gap_of_root(s), state.gap_rate, state.time_us, force)
        return ContactState(-state.gap_rate / self.solid.depth_scale_nm, slope * acceleration, slope, jnp.zeros_like(s))


def driven_by(contact: Contact, cantilever: Cantilever, surface: Platform | Surface) -> Driven:
    """Return the equation of motion of a contact scene."""
    omega, friction = cantilever.angular_frequency, 2.0 * cantilever.decay_rate
    square = omega * omega
    # of c cos + s sin: -(z'' + 2 gamma z' + Omega^2 z)
    waves = tuple(
        Wave(
            (wave.angular_frequency**2 - square) * wave.cosine - friction * wave.angular_frequency * wave.sine,
            (wave.angular_frequency**2 - square) * wave.sine + friction * wave.angular_frequency * wave.cosine,
            wave.angular_frequency,
        )
        for wave in surface.waves
    )
    ramp = surface.offset_rate_nm_per_us
    push = Surface(-square * surface.offset_nm - friction * ramp, -square * ramp, waves)
    free = free_tip(contact, find_junction(contact), cantilever.mass_ng)
    return free._replace(drive=Drive(cantilever, surface, push))


def free_tip(contact: Contact, junction: Junction, mass_ng: Float[Array, "..."]) -> Driven:
    """Return the equation of motion of a free tip that meets a sample at rest."""
    return Driven(
        bridge=bridge_of(contact),
        junction=junction,
        mass_ng=mass_ng,
        inverse_mass=1.0 / mass_ng,
        forms_nm=contact.bridge_forms_nm,
        breaks_nm=contact.bridge_breaks_nm,
        solid=contact.solid,
        drive=None,
    )
