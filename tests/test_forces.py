"""Every force against its formula in mpmath, and its potential against the force."""

import itertools

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from afm_jax.contact.forces import Capillary, CoreRepulsion, Jkr, Liquid, Structural, VanDerWaals, Viscous
from afm_jax.contact.forces import jkr as jkr_formulas
from tests.reference_contact_forces import ContactParameters, constants, static_force, static_potential

GAPS = (0.11, 0.2, 0.7, 1.3, 3.1, 6.0)
STATIC = {"capillary": Capillary(), "structural": Structural(), "core": CoreRepulsion(), "van der Waals": VanDerWaals()}


@pytest.mark.parametrize("name", ["capillary", "structural", "core"])
@pytest.mark.parametrize("humidity", [0.01, 0.99])
def test_forces_of_the_paper_are_their_formulas_in_mpmath(name, humidity):
    liquid = Liquid(relative_humidity=humidity)
    force = CoreRepulsion() if name == "core" else type(STATIC[name])(liquid=liquid)
    reference = constants(ContactParameters(relative_humidity=humidity, effects=(name,)))
    for gap in GAPS:
        # a handful of rounded operations; r_K near saturation carries the logarithm's own 1/ln(p/p_s)
        assert float(force(gap)) == pytest.approx(float(static_force(reference, gap)), rel=3e-14)
    levels = [float(force.potential(gap)) for gap in GAPS]
    expected = [float(static_potential(reference, gap)) for gap in GAPS]
    # potentials are compared by differences: each side is free to choose its zero
    np.testing.assert_allclose(np.diff(levels), np.diff(expected), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", STATIC)
def test_force_and_stiffness_are_minus_slopes_of_potential_and_force(name):
    force = STATIC[name]
    for low, high in itertools.pairwise(GAPS):
        work = quad(lambda gap: float(force(gap)), low, high, epsabs=1e-12, epsrel=1e-11)[0]
        # quadrature of a float64 function
        assert float(force.potential(low) - force.potential(high)) == pytest.approx(work, rel=1e-9, abs=1e-12)
    for gap in GAPS:
        step = 1e-6 * gap
        slope = (float(force(gap + step)) - float(force(gap - step))) / (2.0 * step)
        # central differences of float64 values
        assert float(force.stiffness(gap)) == pytest.approx(-slope, rel=1e-7, abs=1e-7)


def test_van_der_waals_force_is_its_closed_form():
    # sphere and plane: H R/(6 D^2)
    assert float(VanDerWaals(hamaker_constant_aj=0.1, tip_radius_nm=60.0)(2.0)) == pytest.approx(-0.25, rel=1e-15)


def test_viscous_force_of_water_is_the_number_of_the_unit_page():
    # physics.md: 0.047360 nN (dD/dt in nm/us)/(D in nm)
    assert float(Viscous()(2.0, 3.0)) == pytest.approx(-0.047360 * 1.5, rel=1.1e-5)  # five digits are printed
    assert float(Viscous()(2.0, -3.0)) > 0.0


def test_kelvin_radius_is_054_nm_over_ln_2():
    assert float(Liquid().kelvin_radius_nm) == pytest.approx(0.54 / np.log(2.0), rel=1e-6)  # V_m has 6 digits


@given(st.floats(jkr_formulas.FOLD + 1e-6, 30.0))
def test_the_quartic_is_inverted_in_closed_form(s):
    with mpmath.workdps(40):
        exact = mpmath.mpf(s) ** 4 - 2 * mpmath.sqrt(6) / 3 * s
        back = float(Jkr().curve.root_of_depth(float(exact)))
    # near the fold the root is a square root of the depth: half of the digits
    assert back == pytest.approx(s, rel=4e-15 + 3e-16 / (s - jkr_formulas.FOLD))


def test_adhesionless_limit_of_jkr_is_hertz():
    soft = Jkr(adhesion_energy_j_per_m2=1e-9)
    # K sqrt(R) depth^(3/2); the first correction is (depth scale/depth)^(3/4)
    assert float(soft.force(2.0)) == pytest.approx(100.0 * 10.0 * 2.0**1.5, rel=1e-4)
