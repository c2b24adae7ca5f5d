"""`afm-jax orbits SCENE.toml|PRESET --order N [--impacts m]`: the orbits of a scene."""

from afm_jax.apparatus.scene import Scene
from afm_jax.cli.command import NamedScene, Output, later
from afm_jax.cli.session import Session
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.contact_orbits import contact_orbits
from afm_jax.dynamics.impact_orbits import many_impact_orbits
from afm_jax.dynamics.orbit_tables import OrbitTable
from afm_jax.impact.law import Law
from afm_jax.impact.orbits import single_impact_orbits

save = later("afm_jax.plots.picture_style:save")


def orbits(session: Session, scene: NamedScene, *, order: int, impacts: int | None) -> Output:
    """Return the single-impact orbits of a scene; of a contact, or with ``impacts``, those of several impacts."""
    resolved = isinstance(scene.scene.interaction, Contact)
    if not resolved:
        refuse_other_than_law(scene.scene, scene.name)
    if impacts is None and not resolved:
        with session.working("searching for orbits"):
            of_scene = single_impact_orbits(scene.scene, order)
        if not bool(of_scene.complete):
            session.note("there are more orbits than could be listed; the slowest are shown")
        told = OrbitTable(scene.scene, order, of_scene)
    else:
        impacts = impacts or 1
        with session.working("searching for orbits (the first run compiles for some seconds)"):
            search = contact_orbits if resolved else many_impact_orbits
            of_scene = search(scene.scene, order, impacts)
        told = OrbitTable(scene.scene, order, of_scene, impacts)
    return Output.of(told, files={"orbits.png": lambda path: save(told.plot(), path)})


def refuse_other_than_law(scene: Scene, path: str) -> None:
    """Check that a scene's interaction is a law.

    Raises:
        ValueError: if not; says what gives one.
    """
    if isinstance(scene.interaction, Law):
        return
    absent = scene.interaction is None
    advice = (
        "a tip that meets nothing has none"
        if absent
        else f"`afm-jax collide {path} --make-law --out DIR` gives a contact's law"
    )
    raise ValueError(
        f'{path}: [interaction] model: must be "law" here, but is "{"none" if absent else "contact"}"; {advice}'
    )
