"""Intermittent-contact atomic force microscopy in JAX: the impact oscillator, its stability and its amplitudes.

Names are imported when they are first used: `import afm_jax` is cheap and does not start JAX.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afm_jax.apparatus.cantilever import Cantilever
    from afm_jax.apparatus.platform import Platform
    from afm_jax.apparatus.scene import Scene
    from afm_jax.impact.batch import iterate_batch
    from afm_jax.impact.jacobian import map_jacobian
    from afm_jax.impact.law import CollisionDelay, ImpactLaw
    from afm_jax.impact.orbits import SingleImpactOrbits, single_impact_orbits
    from afm_jax.impact.poincare import NextImpact, iterate_map, next_impact
    from afm_jax.outcome import Outcome
    from afm_jax.scenefile import SceneError, load_scene, save_scene

    __version__: str
else:
    from afm_jax.lazy_names import import_name

    _HOMES = {
        "Cantilever": "afm_jax.apparatus.cantilever",
        "CollisionDelay": "afm_jax.impact.law",
        "ImpactLaw": "afm_jax.impact.law",
        "NextImpact": "afm_jax.impact.poincare",
        "Outcome": "afm_jax.outcome",
        "Platform": "afm_jax.apparatus.platform",
        "Scene": "afm_jax.apparatus.scene",
        "SceneError": "afm_jax.scenefile",
        "SingleImpactOrbits": "afm_jax.impact.orbits",
        "__version__": "afm_jax.version",
        "iterate_batch": "afm_jax.impact.batch",
        "iterate_map": "afm_jax.impact.poincare",
        "load_scene": "afm_jax.scenefile",
        "map_jacobian": "afm_jax.impact.jacobian",
        "next_impact": "afm_jax.impact.poincare",
        "save_scene": "afm_jax.scenefile",
        "single_impact_orbits": "afm_jax.impact.orbits",
    }

    def __getattr__(name):
        return import_name(__name__, _HOMES, name)

    def __dir__():
        return sorted({*globals(), *__all__})


__all__ = [
    "Cantilever",
    "CollisionDelay",
    "ImpactLaw",
    "NextImpact",
    "Outcome",
    "Platform",
    "Scene",
    "SceneError",
    "SingleImpactOrbits",
    "__version__",
    "iterate_batch",
    "iterate_map",
    "load_scene",
    "map_jacobian",
    "next_impact",
    "save_scene",
    "single_impact_orbits",
]
