"""The contact reference against published numbers, SciPy, quadrature and closed forms."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

from tests.reference_contact import (
    ContactParameters,
    capture_difference,
    capture_speed,
    collision,
    constants,
    differences,
    junction,
    mp,
    own_error,
)
from tests.reference_contact_forces import (
    fold,
    jkr_depth,
    jkr_depth_slope,
    jkr_force,
    jkr_potential,
    jkr_stiffness,
    static_force,
    static_forces,
    static_potentials,
    static_slope,
    viscous_force,
)

PAPER = ContactParameters()
SOFT = ContactParameters(modulus_gpa=1)  # its junction reaches beyond the bridge
INVISCID = ContactParameters(effects=("capillary", "structural", "core", "jkr"))


# Rebound speed (nm/us) and delay (us) by an independent program, to the digits it printed.
PUBLISHED = {
    12: (4.8899, -0.5148),
    15: (10.1805, -0.0999),
    20: (16.6251, 0.0167),
    30: (27.7774, 0.0650),
    40: (38.2958, 0.0750),
    60: (58.7902, 0.0778),
    100: (99.1735, 0.0746),
    200: (199.4561, 0.0674),
}


@pytest.mark.parametrize("speed", PUBLISHED)
def test_collisions_come_out_as_published(speed: int):
    result = collision(PAPER, speed, digits=20)
    # half a unit of the last digit printed, and a hair for rounded halves
    assert [float(x) for x in result[1:3]] == pytest.approx(PUBLISHED[speed], rel=0, abs=5.1e-5)


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


def test_junction_touches_the_bridge_with_equal_force_and_stiffness():
    for parameters in (PAPER, SOFT, ContactParameters(effects=("capillary", "core", "jkr"))):
        solid = junction(parameters, digits=30)
        with mp.workdps(45):
            k = constants(parameters)
            gap, s = solid.snap_on_gap_nm, solid.snap_on_s
            assert s > fold()
            assert abs(static_force(k, gap) / jkr_force(k, s) - 1) < mp.mpf("1e-30")
            assert abs(-static_slope(k, gap) / jkr_stiffness(k, s) - 1) < mp.mpf("1e-30")
            assert abs(solid.shift_nm - jkr_depth(k, s) - gap) < mp.mpf("1e-30")


def test_potentials_and_slopes_are_those_of_the_forces():
    with mp.workdps(25):
        k = constants(PAPER)
        low, high = mp.mpf("0.3"), mp.mpf("2.2")
        for name, potential in static_potentials(k, low).items():
            work = mp.quad(lambda gap, name=name: static_forces(k, gap)[name], [low, 1, high])
            assert abs(potential - static_potentials(k, high)[name] - work) < mp.mpf("1e-20")
        work = mp.quad(lambda s: jkr_force(k, s) * jkr_depth_slope(k, s), [fold(), 2])
        assert abs(jkr_potential(k, mp.mpf(2)) - jkr_potential(k, fold()) - work) < mp.mpf("1e-20")
        # numerical differentiation loses some digits
        assert abs(mp.diff(lambda gap: static_force(k, gap), low) / static_slope(k, low) - 1) < mp.mpf("1e-18")
        stiffness = mp.diff(lambda s: jkr_force(k, s), 2) / mp.diff(lambda s: jkr_depth(k, s), 2)
        assert abs(stiffness / jkr_stiffness(k, mp.mpf(2)) - 1) < mp.mpf("1e-18")


def static_force_in_floats(gap: Any) -> Any:
    """Return the bridge's static force in nN for the paper's values, written out once more."""
    kelvin = 1e9 * 0.0728 * 18.0795e-6 / (8.31446261815324 * 293.15) / np.log(2.0)
    radius = 100 * np.sqrt(1 - (1 - 2 * kelvin / 100) ** 2)
    structural = 24 * np.exp(1 - gap / 0.6) * (1 - np.exp(-(radius**2) / 120))
    return structural - 4 * np.pi * 7.28 / (1 + gap / (2 * kelvin)) + 1e-4 / (180 * gap**8)


LOAD = 30 * np.pi * np.array([1, 0, 0, -np.sqrt(6), 0, 0, 0])  # P(s), powers of s from the highest
DEPTH = (0.09 * np.pi**2 / 100) ** (1 / 3) * np.array([1, 0, 0, -2 * np.sqrt(6) / 3, 0])  # delta(s)


def scipy_collision(speed: float) -> tuple[float, float]:
    """Return rebound speed and delay by DOP853, phase by phase."""

    def in_bridge(_: float, state: Any) -> list[float]:
        return [state[1], static_force_in_floats(state[0]) - 1.5e-2 * np.pi * 1.005 * state[1] / state[0]]

    # In the junction the state is (s, D', t) against a variable that stretches time by d delta/ds: regular at the fold.
    def in_junction(_: float, state: Any) -> list[float]:
        slope = float(np.polyval(np.polyder(DEPTH), state[0]))
        return [-state[1], float(np.polyval(LOAD, state[0])) * slope, slope]

    def mismatch(unknown: Any) -> list[float]:
        gap, s = unknown
        slope = static_force_in_floats(gap + 1e-30j).imag / 1e-30
        stiffness = np.polyval(np.polyder(LOAD), s) / np.polyval(np.polyder(DEPTH), s)
        return [float(static_force_in_floats(gap) - np.polyval(LOAD, s)), float(slope + stiffness)]

    on, s_on = (float(x) for x in root(mismatch, [0.12, 1.3], tol=1e-13).x)
    s_off = 6 ** (-1 / 6)
    off = on + float(np.polyval(DEPTH, s_on) - np.polyval(DEPTH, s_off))
    first = until(in_bridge, [3.5, -speed], lambda _, state: state[0] - on, -1)
    second = until(in_junction, [s_on, first[1], 0.0], lambda _, state: state[0] - s_off, -1)
    third = until(in_bridge, [off, second[1]], lambda _, state: state[0] - 4.7, 1)
    return third[1], first[-1] + second[2] + third[-1] - 3.5 / speed - 4.7 / third[1]


def until(rates: Any, start: list[float], event: Any, direction: int) -> list[float]:
    """Return the state, and the time behind it, where an event ends the motion."""
    event.terminal, event.direction = True, direction
    run = solve_ivp(rates, (0.0, 50.0), start, method="DOP853", rtol=1e-12, atol=1e-13, events=event, max_step=0.01)
    assert len(run.t_events[0])
    return [*run.y_events[0][0], float(run.t_events[0][0])]


@pytest.mark.parametrize("speed", [15, 60])
def test_collisions_agree_with_scipy(speed: int):
    rebound, delay = scipy_collision(speed)
    result = collision(PAPER, speed, digits=20)
    # DOP853 at rtol 1e-12 leaves some 1e-11; its events, found by interpolation, less
    assert rebound == pytest.approx(float(result.rebound_speed_nm_per_us), rel=1e-9)
    assert delay == pytest.approx(float(result.delay_us), rel=0, abs=1e-9)


@pytest.mark.parametrize("parameters", [PAPER, SOFT, INVISCID, ContactParameters(mass_ng="0.3", tip_radius_nm=20)])
@pytest.mark.parametrize("speed", [45, 150])
def test_energy_ledger_closes(parameters: ContactParameters, speed: int):
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


@pytest.mark.slow
def test_own_error_is_below_the_digits_asked_for():
    for parameters, speed in ((PAPER, 15), (SOFT, 40)):
        assert max(own_error(parameters, speed, digits=25)) < mp.mpf("1e-25")
    coarse, fine = collision(PAPER, 12, digits=15), collision(PAPER, 12, digits=32)
    assert 0 < abs(coarse.delay_us - fine.delay_us) < mp.mpf("1e-15")


@pytest.mark.slow
def test_differences_obey_the_scaling_of_time():
    # Slowing time by x takes mass to x^2 m, viscosity to x eta and speeds to u/x: Euler's identity for both results.
    speed = 15
    result = collision(PAPER, speed, digits=25)
    by = {n: differences(PAPER, speed, n, digits=25) for n in ("mass_ng", "viscosity_pa_s", "approach_speed")}
    limits = {n: capture_difference(PAPER, n, digits=25) for n in ("mass_ng", "viscosity_pa_s")}
    with mp.workdps(25):
        eta = mp.mpf(PAPER.viscosity_pa_s)
        # central differences with relative step 1e-8 leave 1e-16 of the third derivative
        for column, power, known in ((0, -1, result.rebound_speed_nm_per_us), (1, 1, result.delay_us)):
            change = (
                2 * by["mass_ng"][column] + eta * by["viscosity_pa_s"][column] - speed * by["approach_speed"][column]
            )
            assert abs(change - power * known) < mp.mpf("1e-12")
        change = 2 * limits["mass_ng"] + eta * limits["viscosity_pa_s"]
        assert abs(change + capture_speed(PAPER, digits=25)) < mp.mpf("1e-12")


def test_impossible_contacts_are_refused():
    with pytest.raises(ValueError, match="no tangency"):
        junction(ContactParameters(adhesion_energy_j_per_m2=0.05))
    with pytest.raises(ValueError, match="without core"):
        junction(ContactParameters(effects=("capillary", "jkr")))
    with pytest.raises(ValueError, match="Kelvin radius"):
        ContactParameters(relative_humidity=0.9947)
    with pytest.raises(ValueError, match="effects must be among"):
        ContactParameters(effects=("capilary",))
    with pytest.raises(ValueError, match="turns round"):
        collision(ContactParameters(effects=("structural", "core", "jkr")), 0.5, digits=15)
