"""Wrong formulas, one edit each, with the tests that must notice: a sign, a factor, a term, a branch."""

from typing import NamedTuple

APPARATUS = "tests/test_apparatus.py::"
FIRST = "tests/test_first_impact.py::"
MAP = "tests/test_poincare.py::"
ORBITS = "tests/test_orbits.py::test_orbits_are_those_of_the_reference"

FLIGHT = f"{APPARATUS}test_free_flight_is_that_of_dop853"
PLATFORM = f"{APPARATUS}test_platform_velocity_and_acceleration_are_derivatives"
GRAZING = f"{FIRST}test_no_grazing_impact_missed_in_a_few_hundred_flights"
IMPACTS = f"{MAP}test_ten_impacts_in_a_row_agree_with_fifty_digits[delayed]"
LAW = "tests/test_law.py::test_law_agrees_with_fifty_digits"
JACOBIAN = "tests/test_jacobian.py::test_written_and_automatic_jacobians_have_twelve_digits[start0-delayed]"
ORBIT = f"{ORBITS}[damped]"
DELAYED_ORBIT = f"{ORBITS}[delayed]"
FORWARD = "tests/test_forward.py"
LASTING = "tests/test_lasting_impact.py::"
LASTING_ORBITS = "tests/test_lasting_orbits.py::"
INTERVALS = "tests/test_profile_intervals.py"
FORCES = "tests/test_forces.py::"
FORMULAS = f"{FORCES}test_forces_of_the_paper_are_their_formulas_in_mpmath"
JUNCTION = "tests/test_junction.py::test_numbers_of_the_paper_to_five_digits"
COLLIDE = "tests/test_collide.py::"
COLLISIONS = f"{COLLIDE}test_default_accuracy_is_reached_from_11_times_the_capture_speed[diffrax]"
COLLOCATION = f"{COLLIDE}test_default_accuracy_is_reached_from_11_times_the_capture_speed[collocation]"


class Mutation(NamedTuple):
    """An edit: `before` becomes `after` once in `file`, and `test` must fail."""

    file: str
    before: str
    after: str
    test: str


MUTATIONS = {
    "decay rate without its 2": Mutation(
        "afm_jax/apparatus/cantilever.py",
        "self.angular_frequency / (2.0 * self.quality_factor)",
        "self.angular_frequency / self.quality_factor",
        FLIGHT,
    ),
    "damped velocity leans the wrong way": Mutation(
        "afm_jax/apparatus/cantilever.py", "decay * (cosine - lag)", "decay * (cosine + lag)", FLIGHT
    ),
    "damped frequency with 1/2Q^2": Mutation(
        "afm_jax/apparatus/cantilever.py", "1.0 - 0.25 / self", "1.0 - 0.5 / self", FLIGHT
    ),
    "platform velocity turned round": Mutation(
        "afm_jax/apparatus/platform.py",
        "- self.top_speed_nm_per_us * sine",
        "+ self.top_speed_nm_per_us * sine",
        PLATFORM,
    ),
    "platform acceleration without an omega": Mutation(
        "afm_jax/apparatus/platform.py",
        "-self.top_speed_nm_per_us * self.angular_frequency * cosine",
        "-self.top_speed_nm_per_us * cosine",
        PLATFORM,
    ),
    "cosine's sign in the wrong quadrants": Mutation(
        "afm_jax/apparatus/trigonometry.py",
        "(turn == 1.0) | (turn == 2.0)",
        "(turn == 2.0) | (turn == 3.0)",
        f"{APPARATUS}test_sine_and_cosine_are_right_to_the_last_digit",
    ),
    "viscous loss that gives": Mutation(
        "afm_jax/impact/law.py", "** 2 - viscous_loss * u - epsilon", "** 2 + viscous_loss * u - epsilon", LAW
    ),
    "slope of the law without its viscous part": Mutation(
        "afm_jax/impact/law.py", "(2.0 * self.r**2 * u - self.viscous_loss)", "(2.0 * self.r**2 * u)", LAW
    ),
    "lead of the delay as a sum": Mutation("afm_jax/impact/law.py", "(1.0 / w - 1.0 / u)", "(1.0 / w + 1.0 / u)", LAW),
    "capture speed with half its adhesion": Mutation(
        "afm_jax/impact/law.py", "4.0 * self.r**2 * square", "2.0 * self.r**2 * square", LAW
    ),
    "bound of the gap without the platform": Mutation(
        "afm_jax/impact/first_impact.py",
        "gap_bound=tip_bound + platform.largest_acceleration_nm_per_us2",
        "gap_bound=tip_bound",
        GRAZING,
    ),
    "safe step that is too long": Mutation(
        "afm_jax/impact/first_impact.py", "rate * rate + 2.0 * bound", "rate * rate + 0.5 * bound", GRAZING
    ),
    "platform that reaches less high": Mutation(
        "afm_jax/impact/first_impact.py",
        "rate * start + platform.reach_nm",
        "rate * start - platform.reach_nm",
        GRAZING,
    ),
    "search flies another curve": Mutation(
        "afm_jax/impact/first_impact.py",
        "velocity_sine=-(gamma * velocity + omega**2 * position)",
        "velocity_sine=-(omega**2 * position)",
        GRAZING,
    ),
    "tip leaves with the platform's velocity at arrival": Mutation(
        "afm_jax/impact/poincare.py",
        "scene.platform.velocity(leaving) +",
        "scene.platform.velocity(arrival) +",
        IMPACTS,
    ),
    "overlap of late instead of early starts": Mutation(
        "afm_jax/impact/poincare.py",
        "jnp.maximum(-delay, 0.0)",
        "jnp.maximum(delay, 0.0)",
        f"{MAP}test_every_end_of_a_flight_is_said",
    ),
    "rows after a capture look alive": Mutation(
        "afm_jax/impact/poincare.py",
        "jnp.where(flying, impact.outcome, Outcome.NOT_REACHED)",
        "impact.outcome",
        f"{MAP}test_after_a_capture_the_rows_say_so",
    ),
    "flight's Jacobian without the start's shift": Mutation(
        "afm_jax/impact/jacobian.py",
        "acceleration2 * (time_by_time - 1.0)",
        "acceleration2 * time_by_time",
        JACOBIAN,
    ),
    "impact's Jacobian with the delay turned round": Mutation(
        "afm_jax/impact/jacobian.py",
        "1.0 + delay_slope * acceleration_in",
        "1.0 - delay_slope * acceleration_in",
        JACOBIAN,
    ),
    "eq. 7 with a plus": Mutation(
        "afm_jax/impact/jacobian.py",
        "flight.c2 * (ratio - 1.0)",
        "flight.c2 * (ratio + 1.0)",
        "tests/test_jacobian.py::test_equation_7_without_adhesion_is_that_of_equation_1",
    ),
    "implicit derivative turned round": Mutation("afm_jax/impact/implicit.py", "-shift / ", "shift / ", JACOBIAN),
    "rebound speed with the capture term added": Mutation(
        "afm_jax/impact/orbit_closure.py", "[0.5, 0.0, -0.5 * square]", "[0.5, 0.0, 0.5 * square]", ORBIT
    ),
    "closing condition with the offset counted wrong": Mutation(
        "afm_jax/impact/orbit_closure.py",
        "(p.position_per_position - 1.0) * sigma",
        "(p.position_per_position + 1.0) * sigma",
        DELAYED_ORBIT,
    ),
    "determinant of the closing condition with a plus": Mutation(
        "afm_jax/impact/orbit_closure.py", "m11 * m22 - m12 * m21", "m11 * m22 + m12 * m21", DELAYED_ORBIT
    ),
    "orbits on a ramp": Mutation(
        "afm_jax/impact/orbit_search.py",
        "(problem.platform.amplitude_nm > 0.0) & (problem.platform.offset_rate_nm_per_us == 0.0)",
        "problem.platform.amplitude_nm > 0.0",
        "tests/test_orbits.py::test_a_ramp_has_no_orbit",
    ),
    "trace bound with 1 - D": Mutation(
        "afm_jax/impact/orbits.py", "jnp.abs(1.0 + determinant)", "jnp.abs(1.0 - determinant)", ORBIT
    ),
    "peak without damping": Mutation(
        "afm_jax/impact/orbit_amplitude.py", "fall = cantilever.decay_rate * flight.start_velocity + ", "fall = ", ORBIT
    ),
    "lock-in with half its amplitude": Mutation(
        "afm_jax/impact/orbit_amplitude.py", "2.0 / period", "1.0 / period", ORBIT
    ),
    "bracket that keeps the wrong half": Mutation(
        "afm_jax/impact/polynomial_roots.py",
        "(value > 0.0) == rising",
        "(value > 0.0) != rising",
        "tests/test_polynomial_roots.py::test_a_close_pair_is_told_apart",
    ),
    "air that drives a contact": Mutation(
        "afm_jax/impact/lasting_impact.py",
        "gained - (2.0 * AIR)",
        "gained + (2.0 * AIR)",
        f"{LASTING}test_air_takes_what_an_integrated_damped_contact_loses",
    ),
    "lead that a push lengthens": Mutation(
        "afm_jax/impact/lasting_impact.py",
        "longer - share",
        "longer + share",
        f"{LASTING}test_a_lead_is_covered_sooner_with_a_push",
    ),
    "close pairs of roots stepped over": Mutation(
        "afm_jax/impact/orbit_search.py",
        "(bottom * value[at + 1] < 0.0)",
        "(bottom * value[at + 1] > 0.0)",
        f"{LASTING_ORBITS}test_a_close_pair_is_found",
    ),
    "misfit as a sum": Mutation(
        "fitting/forward.py",
        "prediction.amplitude_nm - rows.amplitude_nm",
        "prediction.amplitude_nm + rows.amplitude_nm",
        FORWARD,
    ),
    "constraint of Q without its error": Mutation(
        "fitting/forward.py",
        "1.0 / np.asarray(measurement.constraint_error)",
        "1.0 / np.ones_like(measurement.constraint_error)",
        FORWARD,
    ),
    "intervals of 90 percent": Mutation(
        "fitting/intervals.py", "CHI2_95 = 3.841458820694124", "CHI2_95 = 2.705543454095404", INTERVALS
    ),
    "rise of chi2 from zero": Mutation("fitting/intervals.py", "above = value - chi2", "above = value", INTERVALS),
    "capillary twice as wide": Mutation(
        "afm_jax/contact/forces/capillary.py",
        "as_argument(gap_nm) / (2.0 * self",
        "as_argument(gap_nm) / (4.0 * self",
        FORMULAS,
    ),
    "structural share without its curvature": Mutation(
        "afm_jax/contact/forces/structural.py", "(1.0 - kelvin / self.tip_radius_nm)", "1.0", FORMULAS
    ),
    "core with 8 for 7 in its potential": Mutation(
        "afm_jax/contact/forces/core_repulsion.py", "tip_radius_nm / 1260.0", "tip_radius_nm / 1440.0", FORMULAS
    ),
    "viscous force with half its drag": Mutation(
        "afm_jax/contact/forces/viscous.py",
        "1.5 * jnp.pi * self",
        "0.75 * jnp.pi * self",
        f"{FORCES}test_viscous_force_of_water_is_the_number_of_the_unit_page",
    ),
    "JKR work without its last term": Mutation(
        "afm_jax/contact/forces/jkr.py", "(0.4 * cube - SLOPE) + 1.0)", "(0.4 * cube - SLOPE))", JUNCTION
    ),
    "junction at the JKR stiffness of half the load": Mutation(
        "afm_jax/contact/junction.py", "(6.0 * cube - 3.0 * math", "(6.0 * cube - 1.5 * math", JUNCTION
    ),
    "dissipation left out of the time": Mutation(
        "afm_jax/contact/passage_steps.py", "way.available_aj(gap) - state[0])", "way.available_aj(gap))", COLLISIONS
    ),
    "energy lost where it is gained": Mutation(
        "afm_jax/contact/passage.py",
        "- self.end_potential_aj - dissipated",
        "- self.end_potential_aj + dissipated",
        COLLISIONS,
    ),
    "collocation that sweeps from the end": Mutation(
        "afm_jax/contact/passage_collocation.py",
        "integrals[:, 0] = roots + 1.0",
        "integrals[:, 0] = 1.0 - roots",
        COLLOCATION,
    ),
    "time in the junction counted once": Mutation(
        "afm_jax/contact/junction_way.py", "pace * (2.0 * inside + outside)", "pace * (inside + outside)", COLLISIONS
    ),
    "delay counted from where the bridge forms, both ways": Mutation(
        "afm_jax/contact/collision.py",
        "approach_speed + ways.outer_gap_nm",
        "approach_speed + contact.bridge_forms_nm",
        COLLISIONS,
    ),
    "bridge that breaks where it formed": Mutation(
        "afm_jax/contact/collision.py",
        "outer = jnp.maximum(contact.bridge_breaks_nm, breaks)",
        "outer = jnp.maximum(contact.bridge_forms_nm, breaks)",
        COLLISIONS,
    ),
    "turning point on the wrong side of the well": Mutation(
        "afm_jax/contact/turned.py",
        "> jnp.argmin(potential)",
        "< jnp.argmin(potential)",
        "tests/test_collide_hard_cases.py::test_a_sharp_tip_turns_in_the_bridge[3.0]",
    ),
}
