"""An effect that a contact does not name is absent from its program."""

import jax
import jax.numpy as jnp

from afm_jax.contact.collide import _quick
from afm_jax.contact.contact import Contact
from afm_jax.contact.parameters import EFFECTS
from afm_jax.contact.settings import SETTINGS

SETTING = SETTINGS["diffrax"][1e-9]


def operations(effects) -> tuple[float, float]:
    """Return the floating-point operations and the transcendental ones of the program of 64 tips, as XLA gets it."""
    contact = Contact.paper(effects=effects)
    cost = _quick.lower(contact, jnp.asarray(1.0), jnp.linspace(12.0, 200.0, 64), SETTING).cost_analysis() or {}
    return cost["flops"], cost["transcendentals"]


def test_an_absent_effect_is_absent_from_the_program():
    full = operations(EFFECTS)
    for missing in ("viscous", "structural", "capillary"):
        few = operations(tuple(name for name in EFFECTS if name != missing))
        assert few[0] < full[0]
        assert few[1] < full[1]


def test_a_static_contact_does_not_integrate():
    contact = Contact.paper(effects=("capillary", "structural", "core", "jkr"))
    speeds = jnp.linspace(12.0, 200.0, 8)

    def loops(made):
        return str(jax.make_jaxpr(lambda u: _quick(made, jnp.asarray(1.0), u, SETTING))(speeds)).count("scan[")

    # the junction's loops are left; Diffrax's, over steps and stages, and the turning root's became two sums over nodes
    assert loops(contact) == loops(Contact.paper()) - 3
