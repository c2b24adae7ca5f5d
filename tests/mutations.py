"""Wrong formulas, one edit each, with the tests that must notice: a sign, a factor, a term, a branch."""

import re
from typing import NamedTuple

_CHANGE = re.compile(r"\{(.*?) => (.*?)\}", re.DOTALL)


def before_and_after(edit: str) -> tuple[str, str]:
    """Return what an edit finds and what it makes of it; a change is marked {what stands there => what it becomes}."""
    before, after = (_CHANGE.sub(side, edit) for side in (r"\1", r"\2"))
    return before, after


class Mutation(NamedTuple):
    """An edit of text that stands once in the packages, and the test that must fail after it."""

    edit: str
    test: str


_EDITS = {
    "test_apparatus.py::test_free_flight_agrees_with_fifty_digits[7.3-40.0]": {
        "decay rate without its 2": "self.angular_frequency / {(2.0 * self.quality_factor) => self.quality_factor}",
        "damped velocity leans the wrong way": "decay * (cosine {- => +} lag)",
        "damped frequency with 1/2Q^2": "1.0 - {0.25 => 0.5} / self",
    },
    "test_surface.py::test_velocity_and_acceleration_are_derivatives": {
        "platform velocity turned round": "self.sine * omega * cosine {- => +} self.cosine",
        "platform acceleration without an omega": "acceleration - {square => wave.angular_frequency} * height",
    },
    "test_apparatus.py::test_sine_and_cosine_are_right_to_the_last_digit": {
        "cosine's sign in the wrong quadrants": "(turn == {1.0 => 2.0}) | (turn == {2.0 => 3.0})"
    },
    "test_law.py::test_law_agrees_with_fifty_digits": {
        "viscous loss that gives": "** 2 {- => +} viscous_loss * u - epsilon",
        "lead of the delay as a sum": "self.lead_nm * (1.0 / w {- => +} 1.0 / u) - self.offset_nm / u\n",
        "capture speed with half its adhesion": "{4.0 => 2.0} * self.r**2 * square",
    },
    "test_first_impact.py::test_no_first_impact_missed_against_brute_force": {
        "bound of the gap without the platform": "gap_bound=tip_bound{ + platform.largest_acceleration_nm_per_us2 => }",
        "safe step that is too long": "rate * rate + {2.0 => 0.5} * bound",
        "platform that reaches less high": "rate * start {+ => -} platform.reach_nm",
        "search flies another curve": "velocity_sine=-({gamma * velocity +  => }omega**2 * position)",
    },
    "test_poincare.py::test_ten_impacts_in_a_row_agree_with_fifty_digits[delayed]": {
        "tip leaves with the platform's velocity at arrival": "surface.velocity({leaving => arrival}) + speeds"
    },
    "test_poincare.py::test_every_end_of_a_flight_is_said": {
        "overlap of late instead of early starts": "overlap = jnp.maximum({- => }delay, 0.0)"
    },
    "test_solve.py::test_reverse_mode_computes_work_again_from_roots_and_arguments_alone[recomputed]": {
        "roots searched for again on the way back": "save_only_these_names({_FOUND => })"
    },
    "test_jacobian.py::test_written_and_automatic_jacobians_have_twelve_digits[start0-delayed]": {
        "flight's Jacobian without the start's shift": "acceleration2 * {(time_by_time - 1.0) => time_by_time}",
        "impact's Jacobian with the delay turned round": "1.0 {+ => -} delay_slope * acceleration_in",
        "implicit derivative turned round": "{- => }shift / ",
    },
    "test_verification.py::test_every_equation_is_compared_at_ten_thousand_states_and_passes": {
        "eq. 7 with a plus": "flight.c2 * (ratio {- => +} 1.0)"
    },
    "test_orbits.py::test_orbits_are_those_of_the_reference[damped]": {
        "rebound speed with the capture term added": "[0.5, 0.0, {- => }0.5 * square]",
        "trace bound with 1 - D": "jnp.abs(1.0 {+ => -} determinant)",
        "peak without damping": "fall = {cantilever.decay_rate * flight.start_velocity +  => }",
        "lock-in with half its amplitude": "{2.0 => 1.0} / period * integral",
    },
    "test_orbits.py::test_orbits_are_those_of_the_reference[delayed]": {
        "closing condition with the offset counted wrong": "(p.position_per_position {- => +} 1.0) * sigma",
        "determinant of the closing condition with a plus": "m11 * m22 {- => +} m12 * m21",
    },
    "test_polynomial_roots.py::test_a_close_pair_is_told_apart": {
        "bracket that keeps the wrong half": "(value > 0.0) {== => !=} rising"
    },
    "test_lasting_impact.py::test_depth_and_loss_by_the_air_are_those_of_the_course_through_bridge_and_solid": {
        "air that drives a contact": "deep * change {- => +} air",
        "straight paths through a bridge": "lasts * tau + flown{ + drawn => }",
        "air counted twice between solid and gap 0": "raised * {(u + w) => (w - u)}",
    },
    "test_lasting_impact.py::test_a_lead_is_covered_sooner_with_a_push": {
        "lead that a push lengthens": "longer {- => +} fraction"
    },
    "test_lasting_impact.py::test_a_delay_with_an_offset_is_that_of_a_raised_surface": {
        "solid as high as the delay's whole offset": "{0.5 *  => }self.delay.offset_nm, length"
    },
    "test_lasting_orbits.py::test_a_close_pair_is_found": {
        "close pairs of roots stepped over": "bottom * sign {< => >} 0.0"
    },
    "test_forward.py::test_residuals_are_misfits_in_errors_and_the_constraint": {
        "misfit as a sum": "seen.readings {- => +} data.read",
        "constraint of Q without its error": "numpy.exp({self.error / self.value *  => }unknown)",
    },
    "test_forward.py::test_jacobian_of_softened_residuals_is_that_of_differences[0.3]": {
        "outliers softened in the wrong direction": "slope = slope {- => +} part[:, :, None]"
    },
    "test_forward.py::test_slopes_of_readings_are_those_of_orbits_that_are_searched_for_anew[sample]": {
        "remainders of corrections turned round": "= of_law {+ => -} by_local"
    },
    "test_lasting_fit.py::test_orbits_that_would_grow_cost_and_chi2_has_the_slope_of_its_gradient": {
        "orbits that grow for nothing": "[(share[:, None] * white).ravel(), {over => 0.0 * over}, known]"
    },
    "test_least_squares.py::test_searches_end_where_scipys_do": {
        "damped steps uphill": "step[moving] = {- => }np.linalg.solve(normal"
    },
    "test_laws_of_fits.py::test_derivatives_of_formulas_are_those_of_differences[smooth]": {
        "drag without its width": "0.5 * values[LOSS_SHAPE] / raised{ * _Q_WIDTH => }",
        "model error that shortens the delay's path twice": "- (offset {+ => -} path) / u",
    },
    "test_profile_intervals.py": {"intervals of 90 percent": "CHI2_95 = {3.841458820694124 => 2.705543454095404}"},
    "test_fit.py::test_profile_interval_ends_are_where_scipy_finds_chi2_risen_by_3_84": {
        "rise of chi2 from zero": "fitted.profile(fitted.explained, place, y){ - end.chi2 => }"
    },
    "test_forces.py::test_forces_of_the_paper_are_their_formulas_in_mpmath": {
        "capillary twice as wide": "return self.pull_nn * length, {1.0 => 0.5} / length",
        "structural share without its curvature": "{(1.0 - kelvin / self.tip_radius_nm) => 1.0}",
        "core with 8 for 7 in its potential": "tip_radius_nm / {1260.0 => 1440.0}",
    },
    "test_forces.py::test_viscous_force_of_water_is_the_number_of_the_unit_page": {
        "viscous force with half its drag": "{1.5 => 0.75} * jnp.pi * self"
    },
    "test_junction.py::test_other_parameters_agree_with_mpmath": {
        "JKR work without its last term": "(0.4 * cube - SLOPE){ + 1.0 => })",
        "junction at the JKR stiffness of half the load": "(6.0 * cube - {3.0 => 1.5} * math",
    },
    "test_collide.py::test_default_accuracy_is_reached_from_11_times_the_capture_speed[diffrax]": {
        "dissipation left out of the time": "at.available_aj{ - spent_and_time[0] => })",
        "energy lost where it is gained": "- self.end_potential_aj {- => +} spent",
        "time in the junction counted once": "{2.0 *  => }inside + rests",
        "delay counted from where the bridge forms": "/ speed + {ends_nm => contact.bridge_forms_nm} / jnp.where(",
        "bridge that breaks where it formed": "jnp.maximum(self.{breaks_nm => forms_nm}, self.junction",
    },
    "test_collide.py::test_default_accuracy_is_reached_from_11_times_the_capture_speed[collocation]": {
        "collocation that integrates from the end": "integrals[:, 0] = {roots + 1.0 => 1.0 - roots}"
    },
    "test_dry_contact.py::test_hertz_collision_time_is_the_closed_form[20.0]": {
        "dry contact as stiff as a flat of its radius": "{jnp.sqrt(junction.tip_radius_nm) => junction.tip_radius_nm}"
    },
    "test_dry_contact.py::test_collisions_are_those_of_an_independent_integration[changed0-False]": {
        "dry contact whose attraction pushes": "root * root * (0.4 * root**3 {- => +} self.attraction)"
    },
    "hard_cases/test_collisions.py::test_a_sharp_tip_turns_in_the_bridge[3.0]": {
        "turning point on the wrong side of the well": "{> => <} jnp.argmin(above)"
    },
    "test_observables.py::test_a_free_cantilever_responds_as_it_must": {
        "air that takes half": "air = {2.0 *  => }float(cantilever.decay_rate)",
        "lock-in of a motion with half its height": "{2.0 => 1.0} / motion.span_us * (complex",
    },
    "test_observables.py::test_a_slow_approach_has_not_arrived": {
        "an approach that is taken to be over": "rate / np.where(rate < 1.0, 1.0 {- => +} rate, 1.0)"
    },
    "test_simulate_contact.py::test_tenth_crossing_agrees_with_an_independent_integration": {
        "a junction that breaks past the bridge": "driven.breaks_nm, ContactPhase.{BRIDGE => DRY}, ContactPhase.DRY)"
    },
    "hard_cases/test_rests.py::test_a_tip_captured_without_adhesion_is_let_go_too": {
        "push of the platform without its acceleration": "{self.surface.acceleration(time_us) -  => -}self.cantilever"
    },
    "test_law_motion.py::test_the_ledger_of_energy_closes": {
        "impacts that lose what they leave": "(row.approach**2 {- => +} row.rebound**2)"
    },
    "test_scenefile.py::test_reduced_frequency_counts_in_twice_the_free_frequency": {
        "reduced frequency of the free one": "{2.0 *  => }reduced * cantilever.frequency_khz"
    },
    "test_table.py::test_noise_stands_in_for_missing_errors_only": {
        "noise that falls with the amplitude": "np.isnan(errors), noise {* => /} values"
    },
    "test_lockin.py::test_a_bounce_in_closed_form": {
        "lock-in of a trace with half its height": "return {2.0 => 1.0} / (length or 1.0)"
    },
    "test_lockin.py::test_harmonics_of_a_motion_are_read_and_nothing_beside_them": {
        "blocks without the other order's periods": "both = {math.lcm(n, order) => n} * period"
    },
    "test_inversion_law.py::test_laws_agree_with_a_fit_of_every_point[viscous]": {
        "loss of a line as a sum": "u**power], axis=1), u**2 {- => +} w**2"
    },
    "test_inversion.py::test_one_amplitude_and_the_phase_suffice": {
        "inverted rebound with a gain for a loss": "np.sqrt(np.maximum(u**2 {+ => -} place[:, 3], 1e-4))"
    },
    "test_calibrate.py::test_a_sweep_without_noise_gives_its_parameters_back[3.0-True]": {
        "resonance damped at the natural frequency": "1j * {frequency * natural => natural**2} / quality_factor"
    },
    "test_thermal.py::test_the_area_gives_k_where_the_quality_factor_is_hardly_resolved": {
        "thermal motion of half a line": "area = float({0.5 => 0.25} * np.pi"
    },
    "test_thermal.py::test_the_real_spectrum_meets_the_vendors_numbers": {
        "Sader's stiffness without a frequency": "np.imag(gamma) * omega{**2 => }"
    },
    "test_posterior.py::test_the_samplers_density_is_that_of_another_programs_amplitudes": {
        "posterior of twice the misfit": "log_likelihood = {-0.5 => -1.0} * residual @ residual"
    },
    "test_experiment_selection.py::test_points_come_in_the_order_of_their_use[matters1]": {
        "nuisances that help": "whole {- => +} np.linalg.slogdet"
    },
    "test_continuation.py::test_period_doubling_is_that_of_eq_8": {
        "period doubling at multiplier +1": "1.0 {+ => -} trace {+ => -} determinant,"
    },
    "test_impact_orbits.py::test_orbits_repeat_when_they_are_flown": {
        "a loop one drive period too short": "arrival[:1] + { => 0.5 * }loop.period_us"
    },
    "test_lyapunov.py::test_the_larger_exponent_is_the_growth_of_neighbouring_motions": {
        "sum of the exponents with the wrong sign": "np.log(np.abs(determinants))) {- => +} growth], axis"
    },
    "test_discrepancy.py::test_peak_and_lockin_of_a_slow_row_share_the_error_of_the_picture": {
        "slow rows padded by their difference alone": "0.5 * ({_TOGETHER +  => }_APART",
        "slow impacts held back by half": "drive_frequency_khz * length / {rebound => (2.0 * rebound)}",
    },
    "test_discrepancy.py::test_residuals_that_run_together_over_the_speed_are_seen": {
        "runs of residuals that the unknowns explain": "apart = tried {- => +} basis @ (basis.T @ tried)"
    },
    "test_discrepancy.py::test_the_parameters_are_those_of_the_closest_formula_and_as_unsure": {
        "closest formula of a law that is slower": "weight * (np.where(leaves, w, 0.0) - {rebound => 0.99 * rebound})"
    },
    "test_accuracy_promise.py::test_every_level_holds_for_random_contacts[diffrax]": {
        "collisions beside capture in few steps": "_NEAR_CAPTURE = ({-0.02, 0.2 => -0.0, 0.0})"
    },
    "test_solve.py::test_newton_finds_scipys_root_with_the_derivatives_of_differences": {
        "implicit derivative of a system turned round": "return x, {- => }solved_columns("
    },
    "test_solve.py::test_quadrature_of_polynomials_is_exact": {
        "Legendre series with the wrong weights": "(np.arange(count)[:, None] + {0.5 => 1.0})"
    },
}
"""By the tests that must notice: names of mutations, and their edits."""
MUTATIONS = {name: Mutation(edit, f"tests/{test}") for test, edits in _EDITS.items() for name, edit in edits.items()}
