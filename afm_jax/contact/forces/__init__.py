"""The forces between tip and sample, one formula a file; `Capillary() + Structural()` acts as their sum."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afm_jax.contact.forces.force import DissipativeForce, ForceSum, StaticForce
    from afm_jax.contact.forces.jkr import Jkr
    from afm_jax.contact.forces.liquid import Capillary, Liquid, Structural, Viscous
    from afm_jax.contact.forces.solid import CoreRepulsion, VanDerWaals
else:
    from afm_jax.lazy_names import import_name

    _HOMES = {
        "Capillary": "afm_jax.contact.forces.liquid",
        "CoreRepulsion": "afm_jax.contact.forces.solid",
        "DissipativeForce": "afm_jax.contact.forces.force",
        "ForceSum": "afm_jax.contact.forces.force",
        "Jkr": "afm_jax.contact.forces.jkr",
        "Liquid": "afm_jax.contact.forces.liquid",
        "StaticForce": "afm_jax.contact.forces.force",
        "Structural": "afm_jax.contact.forces.liquid",
        "VanDerWaals": "afm_jax.contact.forces.solid",
        "Viscous": "afm_jax.contact.forces.liquid",
    }

    def __getattr__(name):
        return import_name(__name__, _HOMES, name)

    def __dir__():
        return sorted({*globals(), *__all__})


__all__ = [
    "Capillary",
    "CoreRepulsion",
    "DissipativeForce",
    "ForceSum",
    "Jkr",
    "Liquid",
    "StaticForce",
    "Structural",
    "VanDerWaals",
    "Viscous",
]
