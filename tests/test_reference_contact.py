"""The contact reference against published numbers, quadrature and closed forms."""

import pytest

from tests.reference_contact import (
    PUBLISHED,
    ContactParameters,
    capture_speed,
    collision,
    constants,
    junction,
    mp,
)
from tests.reference_contact_forces import (
    fold,
    jkr_depth_slope,
    jkr_force,
    static_force,
    viscous_force,
)

PAPER = ContactParameters()
SOFT = ContactParameters(modulus_gpa=1)  # its junction reaches beyond the bridge
INVISCID = ContactParameters(effects=("capillary", "structural", "core", "jkr"))


def test_collisions_come_out_as_published():
    for speed, published in PUBLISHED.items():
        result = collision(PAPER, speed, digits=20)
        # half a unit of the last digit printed, and a hair for rounded halves
        assert [float(x) for x in result[1:3]] == pytest.approx(published, rel=0, abs=5.1e-5)


def test_junction_and_capture_come_out_as_published():
    solid = junction(PAPER)
    # half a unit of the last digit printed
    assert float(solid.snap_on_gap_nm) == pytest.approx(0.12360, rel=0, abs=5e-6)
    assert float(solid.shift_nm) == pytest.approx(0.31603, rel=0, abs=5e-6)
    assert float(solid.snap_off_gap_nm) == pytest.approx(0.50420, rel=0, abs=5e-6)
    assert float(solid.snap_on_force_nn) == pytest.approx(-25.5, rel=0, abs=0.05)
    assert float(solid.snap_on_stiffness_n_per_m) == pytest.approx(692, rel=0, abs=0.5)
    assert float(solid.bridge_hysteresis_aj) == pytest.approx(30.25, rel=0, abs=5e-3)
    assert float(solid.junction_hysteresis_aj) == pytest.approx(25.50, rel=0, abs=5e-3)
    assert float(capture_speed(PAPER, digits=20)) == pytest.approx(10.93845, rel=0, abs=5e-6)
    assert float(junction(SOFT).snap_off_gap_nm) == pytest.approx(8.0, rel=0, abs=0.05)
    assert float(-viscous_force(constants(PAPER), mp.mpf(1), 1)) == pytest.approx(0.047360, rel=0, abs=5e-7)


@pytest.mark.parametrize("parameters", [SOFT, INVISCID, ContactParameters(mass_ng="0.3", tip_radius_nm=20)])
def test_energy_ledger_closes(parameters: ContactParameters):
    speed = 45
    result = collision(parameters, speed, digits=25)
    with mp.workdps(35):
        mass = mp.mpf(parameters.mass_ng)
        # The viscous loss was integrated by itself, not taken from the balance.
        spent = mass * mp.mpf(speed) ** 2 / 2 - result.viscous_loss_aj - mass * result.rebound_speed_nm_per_us**2 / 2
        hysteresis = result.bridge_hysteresis_aj + result.junction_hysteresis_aj
        assert abs(spent / hysteresis - 1) < mp.mpf("1e-25")
    assert not result.captured
    assert (result.viscous_loss_aj > 0) == ("viscous" in parameters.effects)


def test_without_viscosity_the_loss_is_the_area_of_the_hysteresis():
    with mp.workdps(30):
        k, solid = constants(INVISCID), junction(INVISCID, digits=30)
        # Both ways as the integral of F dD outwards, from s = 2 in the junction, where dD = -(d delta/ds) ds.
        way_in, way_out = (
            mp.quad(lambda s: jkr_force(k, s) * jkr_depth_slope(k, s), [end, 2]) for end in (solid.snap_on_s, fold())
        )
        way_in += mp.quad(lambda gap: static_force(k, gap), [solid.snap_on_gap_nm, 0.2, 0.5, 1, k.forms])
        way_out += mp.quad(lambda gap: static_force(k, gap), [solid.snap_off_gap_nm, 1, 2, k.breaks])
        loss = way_in - way_out  # in aJ, for a mass of 1 ng
        rebound = collision(INVISCID, 15, digits=25).rebound_speed_nm_per_us
        assert abs(rebound**2 - (225 - 2 * loss)) < mp.mpf("1e-20")  # quadrature at 30 digits
        assert abs(capture_speed(INVISCID, digits=25) ** 2 - 2 * loss) < mp.mpf("1e-20")


@pytest.mark.parametrize("parameters", [PAPER, SOFT])
def test_capture_speed_divides_the_collisions(parameters: ContactParameters):
    limit = capture_speed(parameters, digits=25)
    with mp.workdps(35):
        above, below = (
            collision(parameters, limit + shift, digits=25) for shift in (mp.mpf("1e-18"), mp.mpf("-1e-18"))
        )
        assert not above.captured
        assert below.captured
        assert mp.isnan(below.rebound_speed_nm_per_us)
        # Energy changes by about m u du = 1e-17 aJ and slightly more for the viscous loss; it meets at 0.
        assert 0 < above.end_energy_aj < mp.mpf("1e-16")
        assert -mp.mpf("1e-16") < below.end_energy_aj < 0
    slow = collision(parameters, 1, digits=15)  # ends in the junction
    assert slow.captured
    assert slow.end_energy_aj < -10
