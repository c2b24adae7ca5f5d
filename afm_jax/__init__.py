"""Intermittent-contact atomic force microscopy in JAX: the impact oscillator, its stability and its amplitudes.

Names are imported when they are first used: `import afm_jax` is cheap and does not start JAX.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afm_jax.apparatus.cantilever import Cantilever
    from afm_jax.apparatus.drives import BaseDrive, ForceDrive, Tone
    from afm_jax.apparatus.platform import Platform
    from afm_jax.apparatus.scene import Scene
    from afm_jax.compilation_cache import use_cache
    from afm_jax.contact.collide import Collision, capture_speed, collide
    from afm_jax.contact.contact import Contact
    from afm_jax.contact.junction import Junction, Phase, find_junction
    from afm_jax.contact.law_of_contact import make_law
    from afm_jax.contact.time_course import time_course
    from afm_jax.dynamics.basins import basins_of_attraction
    from afm_jax.dynamics.bifurcations import bifurcation_diagram
    from afm_jax.dynamics.charts import stability_chart
    from afm_jax.dynamics.contact_orbits import contact_orbits
    from afm_jax.dynamics.continuation import continue_orbits
    from afm_jax.dynamics.exponents import lyapunov_spectrum
    from afm_jax.dynamics.impact_orbits import many_impact_orbits
    from afm_jax.impact.jacobian import map_jacobian
    from afm_jax.impact.law import CollisionDelay, ImpactLaw, TabulatedLaw
    from afm_jax.impact.map import NextImpact, iterate_batch, iterate_map, next_impact
    from afm_jax.impact.orbits import SingleImpactOrbits, single_impact_orbits
    from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
    from afm_jax.motion.simulate import simulate
    from afm_jax.motion.trajectory import Trajectory, trajectory
    from afm_jax.outcomes import CollisionOutcome, Outcome
    from afm_jax.saved import load
    from afm_jax.scenefile.law_files import load_law, save_law
    from afm_jax.scenefile.parameter_paths import scene_family
    from afm_jax.scenefile.scenefile import load_scene, save_scene
    from afm_jax.scenefile.tables import SceneError
    from afm_jax.sweeps.sweep import sweep

    __version__: str
else:
    from afm_jax.lazy_names import import_name

    _HOMES = {
        "BaseDrive": "afm_jax.apparatus.drives",
        "Cantilever": "afm_jax.apparatus.cantilever",
        "Collision": "afm_jax.contact.collide",
        "CollisionDelay": "afm_jax.impact.law",
        "CollisionOutcome": "afm_jax.outcomes",
        "Contact": "afm_jax.contact.contact",
        "ContactKind": "afm_jax.motion.record",
        "ForceDrive": "afm_jax.apparatus.drives",
        "ImpactLaw": "afm_jax.impact.law",
        "TabulatedLaw": "afm_jax.impact.law",
        "Junction": "afm_jax.contact.junction",
        "MotionOutcome": "afm_jax.motion.record",
        "NextImpact": "afm_jax.impact.map",
        "Outcome": "afm_jax.outcomes",
        "Phase": "afm_jax.contact.junction",
        "Platform": "afm_jax.apparatus.platform",
        "Scene": "afm_jax.apparatus.scene",
        "SceneError": "afm_jax.scenefile.tables",
        "Simulation": "afm_jax.motion.record",
        "SingleImpactOrbits": "afm_jax.impact.orbits",
        "State": "afm_jax.motion.record",
        "Tone": "afm_jax.apparatus.drives",
        "Trajectory": "afm_jax.motion.trajectory",
        "__version__": "afm_jax.version",
        "basins_of_attraction": "afm_jax.dynamics.basins",
        "bifurcation_diagram": "afm_jax.dynamics.bifurcations",
        "capture_speed": "afm_jax.contact.collide",
        "collide": "afm_jax.contact.collide",
        "contact_orbits": "afm_jax.dynamics.contact_orbits",
        "continue_orbits": "afm_jax.dynamics.continuation",
        "find_junction": "afm_jax.contact.junction",
        "iterate_batch": "afm_jax.impact.map",
        "iterate_map": "afm_jax.impact.map",
        "load": "afm_jax.saved",
        "load_law": "afm_jax.scenefile.law_files",
        "load_scene": "afm_jax.scenefile.scenefile",
        "lyapunov_spectrum": "afm_jax.dynamics.exponents",
        "many_impact_orbits": "afm_jax.dynamics.impact_orbits",
        "make_law": "afm_jax.contact.law_of_contact",
        "map_jacobian": "afm_jax.impact.jacobian",
        "next_impact": "afm_jax.impact.map",
        "save_law": "afm_jax.scenefile.law_files",
        "save_scene": "afm_jax.scenefile.scenefile",
        "scene_family": "afm_jax.scenefile.parameter_paths",
        "simulate": "afm_jax.motion.simulate",
        "single_impact_orbits": "afm_jax.impact.orbits",
        "stability_chart": "afm_jax.dynamics.charts",
        "sweep": "afm_jax.sweeps.sweep",
        "time_course": "afm_jax.contact.time_course",
        "trajectory": "afm_jax.motion.trajectory",
        "use_cache": "afm_jax.compilation_cache",
    }

    def __getattr__(name):
        return import_name(__name__, _HOMES, name)

    def __dir__():
        return sorted({*globals(), *__all__})


__all__ = [
    "BaseDrive",
    "Cantilever",
    "Collision",
    "CollisionDelay",
    "CollisionOutcome",
    "Contact",
    "ContactKind",
    "ForceDrive",
    "ImpactLaw",
    "Junction",
    "MotionOutcome",
    "NextImpact",
    "Outcome",
    "Phase",
    "Platform",
    "Scene",
    "SceneError",
    "Simulation",
    "SingleImpactOrbits",
    "State",
    "TabulatedLaw",
    "Tone",
    "Trajectory",
    "__version__",
    "basins_of_attraction",
    "bifurcation_diagram",
    "capture_speed",
    "collide",
    "contact_orbits",
    "continue_orbits",
    "find_junction",
    "iterate_batch",
    "iterate_map",
    "load",
    "load_law",
    "load_scene",
    "lyapunov_spectrum",
    "make_law",
    "many_impact_orbits",
    "map_jacobian",
    "next_impact",
    "save_law",
    "save_scene",
    "scene_family",
    "simulate",
    "single_impact_orbits",
    "stability_chart",
    "sweep",
    "time_course",
    "trajectory",
    "use_cache",
]
