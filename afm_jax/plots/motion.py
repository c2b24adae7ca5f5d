"""Pictures of a simulated motion: its course in time, its contacts, its Poincare section and its spectrum."""

from pathlib import Path

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.motion.record import Simulation
from afm_jax.plots.motion_contacts import draw_force_gap, draw_gap
from afm_jax.plots.motion_course import draw_course
from afm_jax.plots.motion_section import draw_section
from afm_jax.plots.motion_spectrum import draw_spectrum
from afm_jax.plots.motion_window import look_at


def draw_motion(scene: Scene, simulation: Simulation, folder: Path) -> list[Path]:
    """Draw what there is to see of a motion, as PNG files.

    Always the time course and the spectrum; with contacts the gap and the Poincare section, and of resolved contacts
    the force against the gap.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        folder: exists and can be written to.

    Returns:
        The files, in the order above.

    Raises:
        ValueError: if the simulation is a batch, or did not get beyond its start.
    """
    look = look_at(scene, simulation)
    drawings = {"time_course": draw_course, "spectrum": draw_spectrum}
    if look.touched:
        drawings |= {"gap": draw_gap}
        drawings |= {"poincare": draw_section} if look.left else {}
        drawings |= {"force_gap": draw_force_gap} if isinstance(scene.interaction, Contact) else {}
    files = []
    for name, draw in drawings.items():
        path = folder / f"{name}.png"
        draw(look, path)
        files.append(path)
    return files
