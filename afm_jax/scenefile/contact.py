"""The contact of a scene file: its parameters by name, what they may be, and the contact that they make.

Takes numbers with their units in the names (eqs. 10 to 15); gives a `Contact`, and back.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from afm_jax.checks import check_parameter
from afm_jax.contact.contact import FORCES, Contact, check_effects
from afm_jax.contact.junction import find_junction, require_junction
from afm_jax.contact.parameters import CONTACT_RANGES
from afm_jax.units import AJ_NM6_PER_J_M6


def make_contact(effects: Sequence[str], parameters: Mapping[str, float]) -> Contact:
    """Return the contact of chosen effects, with some of its parameters changed.

    Parameters of an effect that is left out are checked, and then have no meaning: an effect can be left out without
    rewriting the rest.

    Args:
        effects: names of `ALL_EFFECTS`.
        parameters: keyword arguments of `Contact.of`.

    Raises:
        ValueError: if an effect is unknown or a required one missing, a value outside its range, or the contact has no
            junction; says which and why.
    """
    for name, value in parameters.items():
        check_parameter(name, value, CONTACT_RANGES[name])
    contact = Contact.of(tuple(effects), **parameters)
    require_junction(contact, find_junction(contact).exists)
    return contact


def contact_parameters(contact: Contact) -> dict[str, Any]:
    """Return the parameters with which `Contact.of` makes a contact again, by name.

    Those of effects that it does not have are left out.

    Raises:
        ValueError: if it holds something that a scene file has no key for: another force, the same one twice, or
            different radii or liquids in its forces.
    """
    check_effects(contact.effects)
    values: dict[str, Any] = dict(vars(contact.junction))
    if contact.dry and contact.spans:
        values["range_nm"] = contact.bridge_forms_nm
    elif contact.spans:
        values |= {"bridge_forms_nm": contact.bridge_forms_nm, "bridge_breaks_nm": contact.bridge_breaks_nm}
    for term in contact.forces.terms:
        effect = next(name for name, kind in FORCES.items() if isinstance(term, kind))
        own = dict(vars(term))
        liquid = own.pop("liquid", None)
        for field, value in (own if liquid is None else own | vars(liquid)).items():
            name = field if field in CONTACT_RANGES else f"{effect}_{field}"
            if name == "core_constant_aj_nm6":
                # in 64 bits: 1e-78 has no place in 32
                name, value = "core_constant_j_m6", np.asarray(value, float) / AJ_NM6_PER_J_M6  # noqa: PLW2901
            if name in values and not np.array_equal(values[name], value):
                raise ValueError(f"a scene file has one `{name}`, but the contact's forces have different ones")
            values[name] = value
    return {name: values[name] for name in CONTACT_RANGES if name in values}
