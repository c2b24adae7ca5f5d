"""The tangency: the paper's numbers, other parameters against mpmath, derivatives, and causes when there is none."""

from dataclasses import replace

import jax
import pytest

from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import explain_missing_junction, find_junction
from tests.reference_contact import ContactParameters, junction, mp

solve = jax.jit(find_junction)

FIELDS = {
    "forms_gap_nm": "snap_on_gap_nm",
    "shift_nm": "shift_nm",
    "breaks_gap_nm": "snap_off_gap_nm",
    "force_nn": "snap_on_force_nn",
    "stiffness_nn_per_nm": "snap_on_stiffness_n_per_m",
    "hysteresis_aj": "hysteresis_aj",
}


def test_hysteresis_of_bridge_and_junction_are_the_numbers_of_the_paper():
    found = solve(Contact.paper())
    # half of the last digit printed
    assert float(found.bridge_hysteresis_aj) == pytest.approx(30.25, abs=5e-3)
    assert float(found.junction_hysteresis_aj) == pytest.approx(25.50, abs=5e-3)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"modulus_gpa": 10.0},
        {"relative_humidity": 0.01},
        {"relative_humidity": 0.99},
        {"tip_radius_nm": 20.0},
        {"adhesion_energy_j_per_m2": 0.08},
        {"core_constant_j_m6": 1e-79},
        {"effects": ("capillary", "core", "jkr")},
    ],
    ids=str,
)
def test_other_parameters_agree_with_mpmath(changes):
    found, exact = solve(Contact.paper(**changes)), junction(ContactParameters(**changes))
    for ours, theirs in FIELDS.items():
        # the tangency is a simple root: a few digits below rounding; the hysteresis is a difference of potentials
        assert float(getattr(found, ours)) == pytest.approx(float(getattr(exact, theirs)), rel=2e-12)


@pytest.mark.parametrize("name", ["relative_humidity", "modulus_gpa"])
def test_derivatives_agree_with_high_precision_differences(name):
    base = ContactParameters()
    value = float(getattr(base, name))

    def numbers(x):
        found = find_junction(Contact.paper(**{name: x}))
        return (found.forms_gap_nm, found.shift_nm, found.breaks_gap_nm)

    forward, reverse = jax.jacfwd(numbers)(value), jax.jacrev(numbers)(value)
    with mp.workdps(40):
        step = mp.mpf(value) * mp.mpf("1e-10")
        above, below = (junction(replace(base, **{name: mp.mpf(value) + sign * step}), digits=30) for sign in (1, -1))
        for place, field in enumerate(("snap_on_gap_nm", "shift_nm", "snap_off_gap_nm")):
            exact = float((getattr(above, field) - getattr(below, field)) / (2 * step))
            assert float(forward[place]) == pytest.approx(exact, rel=1e-9)
            assert float(reverse[place]) == pytest.approx(float(forward[place]), rel=1e-12)


@pytest.mark.parametrize(
    ("contact", "said"),
    [
        (lambda: Contact.paper(adhesion_energy_j_per_m2=0.075), "adhesion_energy_j_per_m2"),
        (lambda: Contact(forces=Contact.paper().forces.terms[:2]), "core repulsion"),
        (lambda: Contact.paper(bridge_forms_nm=0.12), "0.12 nm, where the bridge forms"),
    ],
)
def test_without_tangency_the_cause_is_named(contact, said):
    made = contact()
    assert not bool(solve(made).exists)
    assert said in explain_missing_junction(made)
