"""Wrong formulas, one edit each, with the tests that must notice: a sign, a factor, a term, a branch."""

import re
from typing import NamedTuple

_CHANGE = re.compile(r"\{(.*?) => (.*?)\}", re.DOTALL)

APPARATUS = "tests/test_apparatus.py::"
FIRST = "tests/test_first_impact.py::"
MAP = "tests/test_poincare.py::"
ORBITS = "tests/test_orbits.py::test_orbits_are_those_of_the_reference"

FLIGHT = f"{APPARATUS}test_free_flight_agrees_with_fifty_digits[7.3-40.0]"
PLATFORM = f"{APPARATUS}test_platform_velocity_and_acceleration_are_derivatives"
GRAZING = f"{FIRST}test_no_grazing_impact_missed_in_a_few_hundred_flights"
IMPACTS = f"{MAP}test_ten_impacts_in_a_row_agree_with_fifty_digits[delayed]"
LAW = "tests/test_law.py::test_law_agrees_with_fifty_digits"
JACOBIAN = "tests/test_jacobian.py::test_written_and_automatic_jacobians_have_twelve_digits[start0-delayed]"
ORBIT = f"{ORBITS}[damped]"
DELAYED_ORBIT = f"{ORBITS}[delayed]"
FORWARD = "tests/test_forward.py::"
LAWS = "tests/test_laws_of_fits.py::"
LASTING = "tests/test_lasting_impact.py::"
COURSE = f"{LASTING}test_depth_and_loss_by_the_air_are_those_of_the_course_through_bridge_and_solid"
LASTING_ORBITS = "tests/test_lasting_orbits.py::"
INTERVALS = "tests/test_profile_intervals.py"
FORCES = "tests/test_forces.py::"
FORMULAS = f"{FORCES}test_forces_of_the_paper_are_their_formulas_in_mpmath"
JUNCTION = "tests/test_junction.py::test_numbers_of_the_paper_to_five_digits"
OBSERVED = "tests/test_observables.py::"
RESPONSE = f"{OBSERVED}test_a_free_cantilever_responds_as_it_must"
LAW_MOTION = "tests/test_law_motion.py::"
COLLIDE = "tests/test_collide.py::"
COLLISIONS = f"{COLLIDE}test_default_accuracy_is_reached_from_11_times_the_capture_speed[diffrax]"
STEPS = "tests/test_simulate_contact.py::test_tenth_crossing_agrees_with_an_independent_integration"
SOLVE = "tests/test_solve.py::"
COLLOCATION = f"{COLLIDE}test_default_accuracy_is_reached_from_11_times_the_capture_speed[collocation]"


def before_and_after(edit: str) -> tuple[str, str]:
    """Return what an edit finds and what it makes of it; a change is marked {what stands there => what it becomes}."""
    before, after = (_CHANGE.sub(side, edit) for side in (r"\1", r"\2"))
    return before, after


class Mutation(NamedTuple):
    """An edit of text that stands once in the packages, and the test that must fail after it."""

    edit: str
    test: str


MUTATIONS = {
    "decay rate without its 2": Mutation(
        "self.angular_frequency / {(2.0 * self.quality_factor) => self.quality_factor}", FLIGHT
    ),
    "damped velocity leans the wrong way": Mutation("decay * (cosine {- => +} lag)", FLIGHT),
    "damped frequency with 1/2Q^2": Mutation("1.0 - {0.25 => 0.5} / self", FLIGHT),
    "platform velocity turned round": Mutation("self.sine * omega * cosine {- => +} self.cosine", PLATFORM),
    "platform acceleration without an omega": Mutation(
        "acceleration - {square => wave.angular_frequency} * height", PLATFORM
    ),
    "cosine's sign in the wrong quadrants": Mutation(
        "(turn == {1.0 => 2.0}) | (turn == {2.0 => 3.0})",
        f"{APPARATUS}test_sine_and_cosine_are_right_to_the_last_digit",
    ),
    "viscous loss that gives": Mutation("** 2 {- => +} viscous_loss * u - epsilon", LAW),
    "lead of the delay as a sum": Mutation("self.lead_nm * (1.0 / w {- => +} 1.0 / u) - self.offset_nm / u\n", LAW),
    "capture speed with half its adhesion": Mutation("{4.0 => 2.0} * self.r**2 * square", LAW),
    "bound of the gap without the platform": Mutation(
        "gap_bound=tip_bound{ + platform.largest_acceleration_nm_per_us2 => }", GRAZING
    ),
    "safe step that is too long": Mutation("rate * rate + {2.0 => 0.5} * bound", GRAZING),
    "platform that reaches less high": Mutation("rate * start {+ => -} platform.reach_nm", GRAZING),
    "search flies another curve": Mutation("velocity_sine=-({gamma * velocity +  => }omega**2 * position)", GRAZING),
    "tip leaves with the platform's velocity at arrival": Mutation(
        "surface.velocity({leaving => arrival}) + speeds", IMPACTS
    ),
    "overlap of late instead of early starts": Mutation(
        "overlap = jnp.maximum({- => }delay, 0.0)", f"{MAP}test_every_end_of_a_flight_is_said"
    ),
    "rows after a capture look alive": Mutation(
        "{jnp.where(flies, impact.outcome, Outcome.NOT_REACHED) => impact.outcome}",
        f"{MAP}test_after_a_capture_the_rows_say_so",
    ),
    "flight's Jacobian without the start's shift": Mutation(
        "acceleration2 * {(time_by_time - 1.0) => time_by_time}", JACOBIAN
    ),
    "impact's Jacobian with the delay turned round": Mutation("1.0 {+ => -} delay_slope * acceleration_in", JACOBIAN),
    "eq. 7 with a plus": Mutation(
        "flight.c2 * (ratio {- => +} 1.0)",
        "tests/test_jacobian.py::test_equation_7_without_adhesion_is_that_of_equation_1",
    ),
    "implicit derivative turned round": Mutation("{- => }shift / ", JACOBIAN),
    "rebound speed with the capture term added": Mutation("[0.5, 0.0, {- => }0.5 * square]", ORBIT),
    "closing condition with the offset counted wrong": Mutation(
        "(p.position_per_position {- => +} 1.0) * sigma", DELAYED_ORBIT
    ),
    "determinant of the closing condition with a plus": Mutation("m11 * m22 {- => +} m12 * m21", DELAYED_ORBIT),
    "orbits on a ramp": Mutation(
        "(problem.platform.amplitude_nm > 0.0){ & (problem.platform.offset_rate_nm_per_us == 0.0) => }",
        "tests/test_orbits.py::test_a_ramp_has_no_orbit",
    ),
    "trace bound with 1 - D": Mutation("jnp.abs(1.0 {+ => -} determinant)", ORBIT),
    "peak without damping": Mutation("fall = {cantilever.decay_rate * flight.start_velocity +  => }", ORBIT),
    "lock-in with half its amplitude": Mutation("{2.0 => 1.0} / period * integral", ORBIT),
    "bracket that keeps the wrong half": Mutation(
        "(value > 0.0) {== => !=} rising", "tests/test_polynomial_roots.py::test_a_close_pair_is_told_apart"
    ),
    "air that drives a contact": Mutation(
        "deep * change {- => +} air", f"{LASTING}test_air_takes_what_an_integrated_damped_contact_loses"
    ),
    "straight paths through a bridge": Mutation("lasts * tau + flown{ + drawn => }", COURSE),
    "air counted twice between solid and gap 0": Mutation("raised * {(u + w) => (w - u)}", COURSE),
    "lead that a push lengthens": Mutation(
        "longer {- => +} fraction", f"{LASTING}test_a_lead_is_covered_sooner_with_a_push"
    ),
    "solid as high as the delay's whole offset": Mutation(
        "{0.5 *  => }self.delay.offset_nm, length", f"{LASTING}test_a_delay_with_an_offset_is_that_of_a_raised_surface"
    ),
    "close pairs of roots stepped over": Mutation(
        "bottom * sign {< => >} 0.0", f"{LASTING_ORBITS}test_a_close_pair_is_found"
    ),
    "misfit as a sum": Mutation(
        "seen.readings {- => +} data.read", f"{FORWARD}test_residuals_are_misfits_in_errors_and_the_constraint"
    ),
    "constraint of Q without its error": Mutation(
        "numpy.exp({self.error / self.value *  => }unknown)",
        f"{FORWARD}test_residuals_are_misfits_in_errors_and_the_constraint",
    ),
    "outliers softened in the wrong direction": Mutation(
        "slope = slope {- => +} part[:, :, None]",
        f"{FORWARD}test_jacobian_of_softened_residuals_is_that_of_differences[0.3]",
    ),
    "remainders of corrections turned round": Mutation(
        "= of_law {+ => -} by_local",
        f"{FORWARD}test_slopes_of_readings_are_those_of_orbits_that_are_searched_for_anew[sample]",
    ),
    "orbits that grow for nothing": Mutation(
        "residual = np.concatenate([(share[:, None] * white).ravel(), {over => 0.0 * over}, known])",
        "tests/test_lasting_fit.py::test_orbits_that_would_grow_cost_and_chi2_has_the_slope_of_its_gradient",
    ),
    "damped steps uphill": Mutation(
        "step[moving] = {- => }np.linalg.solve(normal",
        "tests/test_least_squares.py::test_a_search_alone_ends_where_scipys_does",
    ),
    "drag without its width": Mutation(
        "0.5 * values[LOSS_SHAPE] / raised{ * _Q_WIDTH => }",
        f"{LAWS}test_derivatives_of_formulas_are_those_of_differences[smooth]",
    ),
    "model error that shortens the delay's path twice": Mutation(
        "- (offset {+ => -} path) / u", f"{LAWS}test_derivatives_of_formulas_are_those_of_differences[smooth]"
    ),
    "intervals of 90 percent": Mutation("CHI2_95 = {3.841458820694124 => 2.705543454095404}", INTERVALS),
    "rise of chi2 from zero": Mutation(
        "fitted.profile(fitted.explained, place, y){ - end.chi2 => }",
        "tests/test_fit.py::test_profile_interval_ends_are_where_scipy_finds_chi2_risen_by_3_84",
    ),
    "profile that does not shorten its way": Mutation(
        "longest = {0.5 *  => }abs(part)",
        f"{INTERVALS}::test_a_profile_goes_along_a_bent_valley_where_a_straight_step_loses_an_orbit",
    ),
    "capillary twice as wide": Mutation("return self.pull_nn * length, {1.0 => 0.5} / length", FORMULAS),
    "structural share without its curvature": Mutation("{(1.0 - kelvin / self.tip_radius_nm) => 1.0}", FORMULAS),
    "core with 8 for 7 in its potential": Mutation("tip_radius_nm / {1260.0 => 1440.0}", FORMULAS),
    "viscous force with half its drag": Mutation(
        "{1.5 => 0.75} * jnp.pi * self", f"{FORCES}test_viscous_force_of_water_is_the_number_of_the_unit_page"
    ),
    "JKR work without its last term": Mutation("(0.4 * cube - SLOPE){ + 1.0 => })", JUNCTION),
    "junction at the JKR stiffness of half the load": Mutation("(6.0 * cube - {3.0 => 1.5} * math", JUNCTION),
    "dissipation left out of the time": Mutation("at.available_aj{ - spent_and_time[0] => })", COLLISIONS),
    "energy lost where it is gained": Mutation("- self.end_potential_aj {- => +} spent", COLLISIONS),
    "collocation that integrates from the end": Mutation("integrals[:, 0] = {roots + 1.0 => 1.0 - roots}", COLLOCATION),
    "time in the junction counted once": Mutation("{2.0 *  => }inside + rests", COLLISIONS),
    "dry contact as stiff as a flat of its radius": Mutation(
        "{jnp.sqrt(junction.tip_radius_nm) => junction.tip_radius_nm}",
        "tests/test_dry_contact.py::test_hertz_collision_time_is_the_closed_form[20.0]",
    ),
    "dry contact whose attraction pushes": Mutation(
        "root * root * (0.4 * root**3 {- => +} self.attraction)",
        "tests/test_dry_contact.py::test_collisions_are_those_of_an_independent_integration[changed0-False]",
    ),
    "delay counted from where the bridge forms, both ways": Mutation(
        "/ speed + {end.gap_nm => contact.bridge_forms_nm} / jnp.where(leaves", COLLISIONS
    ),
    "bridge that breaks where it formed": Mutation(
        "jnp.maximum(self.{breaks_nm => forms_nm}, self.junction", COLLISIONS
    ),
    "turning point on the wrong side of the well": Mutation(
        "{> => <} jnp.argmin(above)", "tests/hard_cases/test_collisions.py::test_a_sharp_tip_turns_in_the_bridge[3.0]"
    ),
    "air that takes half": Mutation("air = {2.0 *  => }float(cantilever.decay_rate)", RESPONSE),
    "lock-in of a motion with half its height": Mutation("{2.0 => 1.0} / motion.span_us * (complex", RESPONSE),
    "an approach that is taken to be over": Mutation(
        "rate / np.where(rate < 1.0, 1.0 {- => +} rate, 1.0)", f"{OBSERVED}test_a_slow_approach_has_not_arrived"
    ),
    "a transient that settles while it is large": Mutation(
        "if {not  => }transient <= tolerance", f"{OBSERVED}test_a_vibration_that_dies_away_settles_when_it_has"
    ),
    "a junction that breaks past the bridge": Mutation(
        "driven.breaks_nm, ContactPhase.{BRIDGE => DRY}, ContactPhase.DRY)", STEPS
    ),
    "push of the platform without its acceleration": Mutation(
        "return {self.surface.acceleration(time_us) -  => -}self.cantilever",
        "tests/hard_cases/test_rests.py::test_a_tip_captured_without_adhesion_is_let_go_too",
    ),
    "impacts that lose what they leave": Mutation(
        "(row.approach**2 {- => +} row.rebound**2)", f"{LAW_MOTION}test_the_ledger_of_energy_closes"
    ),
    "reduced frequency of the free one": Mutation(
        "{2.0 *  => }reduced * cantilever.frequency_khz",
        "tests/test_scenefile.py::test_reduced_frequency_counts_in_twice_the_free_frequency",
    ),
    "noise that falls with the amplitude": Mutation(
        "np.isnan(errors), noise {* => /} values", "tests/test_table.py::test_noise_stands_in_for_missing_errors_only"
    ),
    "lock-in of a trace with half its height": Mutation(
        "return {2.0 => 1.0} / (length or 1.0)", "tests/test_lockin.py::test_a_bounce_in_closed_form"
    ),
    "blocks without the other order's periods": Mutation(
        "both = {math.lcm(n, order) => n} * period",
        "tests/test_lockin.py::test_harmonics_of_a_motion_are_read_and_nothing_beside_them",
    ),
    "loss of a line as a sum": Mutation(
        "/ scale, u**2 {- => +} w**2", "tests/test_inversion_law.py::test_values_without_noise_are_exact"
    ),
    "inverted rebound with a gain for a loss": Mutation(
        "np.sqrt(np.maximum(u**2 {+ => -} place[:, 3], 1e-4))",
        "tests/test_inversion.py::test_one_amplitude_and_the_phase_suffice",
    ),
    "resonance damped at the natural frequency": Mutation(
        "damping = 1j * {frequency * natural => natural**2} / quality_factor",
        "tests/test_calibrate.py::test_a_sweep_without_noise_gives_its_parameters_back[3.0-True]",
    ),
    "thermal motion of half a line": Mutation(
        "area = float({0.5 => 0.25} * np.pi",
        "tests/test_thermal.py::test_the_area_gives_k_where_the_quality_factor_is_hardly_resolved",
    ),
    "Sader's stiffness without a frequency": Mutation(
        "np.imag(gamma) * omega{**2 => }",
        "tests/test_thermal.py::test_saders_stiffness_is_what_nanosurf_states_in_the_file",
    ),
    "posterior of twice the misfit": Mutation(
        "log_likelihood = {-0.5 => -1.0} * residual @ residual",
        "tests/test_posterior.py::test_the_samplers_density_is_that_of_another_programs_amplitudes",
    ),
    "nuisances that help": Mutation(
        "whole {- => +} np.linalg.slogdet",
        "tests/test_experiment_selection.py::test_points_come_in_the_order_of_their_use[matters1]",
    ),
    "period doubling at multiplier +1": Mutation(
        "1.0 {+ => -} trace {+ => -} determinant,", "tests/test_continuation.py::test_period_doubling_is_that_of_eq_8"
    ),
    "a loop one drive period too short": Mutation(
        "arrival[:1] + { => 0.5 * }loop.period_us",
        "tests/test_impact_orbits.py::test_orbits_repeat_when_they_are_flown",
    ),
    "sum of the exponents with the wrong sign": Mutation(
        "np.stack([growth, determinant {- => +} growth]",
        "tests/test_lyapunov.py::test_the_larger_exponent_is_the_growth_of_neighbouring_motions",
    ),
    "slow impacts' padding of peak and lock-in as if independent": Mutation(
        "{_TOGETHER + _APART * np.array([[1.0, -1.0], [-1.0, 1.0]]) => (_TOGETHER + _APART) * np.eye(2)}",
        "tests/test_discrepancy.py::test_peak_and_lockin_of_a_slow_row_share_the_error_of_the_picture",
    ),
    "slow impacts held back by half": Mutation(
        "drive_frequency_khz * length / {rebound => (2.0 * rebound)}",
        "tests/test_discrepancy.py::test_peak_and_lockin_of_a_slow_row_share_the_error_of_the_picture",
    ),
    "runs of residuals that the unknowns explain": Mutation(
        "apart = tried {- => +} basis @ (basis.T @ tried)",
        "tests/test_discrepancy.py::test_residuals_that_run_together_over_the_speed_are_seen",
    ),
    "closest formula of a law that is slower": Mutation(
        "weight * (np.where(leaves, w, 0.0) - {rebound => 0.99 * rebound})",
        "tests/test_discrepancy.py::test_the_parameters_are_those_of_the_closest_formula_and_as_unsure",
    ),
    "collisions beside capture in few steps": Mutation(
        "_NEAR_CAPTURE = ({-0.02, 0.2 => -0.0, 0.0})",
        "tests/test_accuracy_promise.py::test_every_level_holds_for_random_contacts[diffrax]",
    ),
    "Newton's step taken in full": Mutation(
        "step{ if self.damping is None else self.damping(x, step) => }",
        f"{SOLVE}test_slots_end_one_by_one_within_their_domain",
    ),
    "Newton's method content with a small residual or a small step": Mutation(
        "found = finite & {small & => (small |} np.all(sizes <= settings.step_tolerance, axis=1){ => )}",
        f"{SOLVE}test_rows_are_solved_each_on_its_own",
    ),
    "implicit derivative of a system turned round": Mutation(
        "return x, {- => }solved_columns(", f"{SOLVE}test_newton_finds_scipys_root_with_the_derivatives_of_differences"
    ),
    "a curve's plane through the origin": Mutation(
        "normal @ {(points[0] - guess) => points[0]}", f"{SOLVE}test_a_curve_is_followed_round_its_fold"
    ),
    "blocks that all begin with the first lane": Mutation(
        "filled(leaf[{first : first +  => :}width], width)",
        f"{SOLVE}test_many_lanes_are_worked_on_in_blocks_of_one_size[23-sizes3]",
    ),
    "blocks of a program that keep the wrong lanes": Mutation(
        "*part.shape[2:])[{:size => -size:}]",
        f"{SOLVE}test_blocks_inside_a_program_have_values_and_both_derivatives[False]",
    ),
    "the first of the lanes in need again and again": Mutation(
        "lax.dynamic_slice(order, ({ => 0 * }done,), (width,))", f"{SOLVE}test_only_lanes_in_need_are_computed_again[4]"
    ),
    "settled lanes computed again": Mutation(
        "np.flatnonzero({~ => }np.asarray(settled))",
        f"{SOLVE}test_open_lanes_are_computed_again_whether_numbers_are_known_or_not",
    ),
    "lanes in need worked on once too often": Mutation(
        "jnp.any(state[2]) & (state[0] {< => <=} self.passes)",
        "tests/test_contact_lanes.py::test_the_few_get_what_each_would_alone[3]",
    ),
    "a lane's own tangent taken off": Mutation(
        "total = total {+ => -} slopes[:, place] * along",
        f"{SOLVE}test_derivatives_of_a_batch_are_found_forward_and_transposed[True]",
    ),
    "an absent number that spreads": Mutation(
        "jnp.where(asked == 0.0, {0.0 => jnp.nan}, jnp.nan)",
        f"{SOLVE}test_an_absent_number_has_an_absent_derivative_where_it_is_asked_for",
    ),
    "the least for the largest": Mutation(
        "values[jnp.{argmax => argmin}(values)]", f"{SOLVE}test_the_largest_value_has_the_slope_of_one_of_them"
    ),
    "the half in which nothing changes": Mutation(
        "held = { => ~}holds(middle)", f"{SOLVE}test_an_interval_is_halved_down_to_rounding_in_either_direction"
    ),
    "Legendre series with the wrong weights": Mutation(
        "(np.arange(count)[:, None] + {0.5 => 1.0})", f"{SOLVE}test_quadrature_of_polynomials_is_exact"
    ),
}
