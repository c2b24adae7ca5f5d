"""What impacts of a law add to a lock-in beyond flights and rests on the surface: the same as in `orbit_amplitude`.

In an impact that lasts the tip is below the surface by the indentation of a Hertz contact. A negative collision delay
lets a flight begin before the last one has ended: until then both are there, and the surface once too often.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import surface_of
from afm_jax.impact.lasting_impact import INDENTATION, LawImpact
from afm_jax.impact.law import ImpactLaw
from afm_jax.motion.frames import to_gap
from afm_jax.motion.record import ContactKind, Simulation, State

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def impact_integral(
    scene: Scene, simulation: Simulation, from_us: float, to_us: float, angular_frequency: float
) -> complex:
    """Return what is missing of int z exp(-i nu t) dt in nm us, for the impacts whose middle is in a window.

    Args:
        scene: the scene; anything but a law with a delay has nothing to add.
        simulation: of one scene.
        from_us: beginning of the window.
        to_us: its end.
        angular_frequency: nu in rad/us.
    """
    law, rows = scene.interaction, simulation.contacts
    if not isinstance(law, ImpactLaw) or law.delay is None:
        return 0j
    arrival, departure = np.asarray(rows.arrival_time_us), np.asarray(rows.departure_time_us)
    middle = 0.5 * (arrival + departure)
    here = np.flatnonzero((np.asarray(rows.kind) == ContactKind.IMPACT) & (middle >= from_us) & (middle < to_us))
    depth = indentation_of(law, np.asarray(rows.approach_speed_nm_per_us)[here])
    total = -np.sum(depth * np.exp(-1j * angular_frequency * middle[here]))
    early = here[departure[here] < arrival[here]]
    if not early.size:
        return complex(total)
    half = 0.5 * (arrival - departure)[early, None]
    times = departure[early, None] + half * (_NODES + 1.0)
    surface, response = surface_of(scene)
    state = State(
        *(
            jnp.asarray(part)[early]
            for part in (departure, rows.departure_position_nm, rows.departure_velocity_nm_per_us)
        )
    )
    gap, rate = to_gap(surface, response, state)
    height, speed = surface.position_and_velocity(state.time_us)
    flight = scene.cantilever.propagator(jnp.asarray(times) - state.time_us[:, None])
    position, _ = flight((gap + height)[:, None], (rate + speed)[:, None])
    gaps = np.asarray(position - surface.position(jnp.asarray(times)))
    return complex(total + np.sum(half * _WEIGHTS * gaps * np.exp(-1j * angular_frequency * times)))


def indentation_of(law: ImpactLaw, approach_speed: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return the time integral of the indentation in nm us at approach speeds in nm/us; 0 where nothing lasts."""
    if not law.lasts:
        return np.zeros(np.shape(approach_speed))
    tau = np.asarray(LawImpact(law).hertz_time(jnp.asarray(approach_speed)))
    return INDENTATION * approach_speed * tau**2
