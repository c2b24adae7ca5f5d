"""`afm-jax orbits SCENE.toml|PRESET --order N [--impacts m]`: the orbits of a scene."""

from typing import Annotated

from click import IntRange

from afm_jax.cli.command import Output
from afm_jax.cli.scenes import NamedScene, refuse_other_than_law
from afm_jax.cli.session import Session
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.contact_orbits import contact_orbits
from afm_jax.dynamics.impact_orbits import many_impact_orbits
from afm_jax.dynamics.orbit_tables import OrbitTable
from afm_jax.impact.orbits import single_impact_orbits


def orbits(
    session: Session,
    scene: NamedScene,
    *,
    order: Annotated[int, IntRange(1, 1_000_000)],
    impacts: Annotated[int | None, IntRange(1, 1_000_000)] = None,
) -> Output:
    """Find all single-impact orbits of a scene with a law, or with --impacts orbits of several impacts.

    The output gives for every orbit impact phase and velocities, peak and lock-in amplitude of the height, whether it
    is stable, and whether it is admissible (its flight stays above the platform). If base or force drive, it also gives
    amplitude, phase and lag at the drive's frequency, and the deflection against a moving base. With --impacts it lists
    every impact, the hardest first. Orbits of a contact are listed in the same way: an impact lasts from the formation
    of the bridge to its rupture (of a dry contact: while its forces act); phase and velocity are those at rupture. The
    search may miss orbits of a contact, of a law with delay, and of several impacts. With --out orbits.csv and
    orbits.png. Exit code 3 if none is admissible.

    Args:
        session: for progress and messages.
        scene: the scene.
        order: drive periods between two impacts, a positive integer.
        impacts: impacts in these periods, found by a search from many starts; without it, all single-impact orbits.
    """
    resolved = isinstance(scene.scene.interaction, Contact)
    if not resolved:
        refuse_other_than_law(scene)
    if impacts is None and not resolved:
        with session.working("searching for orbits"):
            of_scene = single_impact_orbits(scene.scene, order)
        if not bool(of_scene.complete):
            session.note("there are more orbits than could be listed; the slowest are shown")
    else:
        impacts = impacts or 1
        with session.working("searching for orbits (the first run compiles for some seconds)"):
            search = contact_orbits if resolved else many_impact_orbits
            of_scene = search(scene.scene, order, impacts)
    return Output.of(OrbitTable(scene.scene, order, of_scene, impacts), "orbits")
