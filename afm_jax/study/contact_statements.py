"""What the paper says of figures 4 to 7, as numbers worked out from the computed data."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import root_scalar

from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import Junction
from afm_jax.study.figure_statements import Statement

PAPER = {
    "forms_gap_nm": 0.124,
    "hysteresis_aj": 60.0,
    "capture_nm_per_us": 11.2,
    "r": 0.9981,
    "epsilon": 126.0,
    "worst_share": 0.003,
    "lag_us": 0.11,
    "lead_us": 0.2,
}
"""What the paper states in section IV."""
SMALL_GAP_NM = 0.2
"""Where the paper says that the bridge begins to be stiff."""


def force_statements(contact: Contact) -> list[Statement]:
    """Figure 4: attractive over most of the range, repulsive and stiff close to the sample.

    "Repulsive at distances smaller than about 0.2 nm" is not said of the sum: that pulls down to 0.106 nm. It is its
    slope that turns there.
    """
    forms = float(contact.bridge_forms_nm)
    zero = float(root_scalar(lambda gap: float(contact.forces(gap)), bracket=(0.02, SMALL_GAP_NM)).root)
    attractive = 1.0 - zero / forms
    gaps = np.array([0.5, 1.0, 2.0, 3.0]) * SMALL_GAP_NM
    closest, edge, *farther = stiffness = np.asarray(contact.forces.stiffness(gaps)).tolist()
    return [
        Statement(
            "the static force is attractive over most of its range",
            attractive > 0.9,
            {"share_of_range": attractive, "repulsive_below_nm": zero},
        ),
        Statement(
            "the bridge's stiffness rises steeply below about 0.2 nm",
            bool(closest > 20.0 * edge and edge < 4.0 * max(farther)),
            {"gap_nm": gaps.tolist(), "stiffness_nn_per_nm": stiffness},
        ),
    ]


def hysteresis_statements(
    contact: Contact, junction: Junction, gap_nm: Float[np.ndarray, " points"], force_nn: Float[np.ndarray, " points"]
) -> list[Statement]:
    """Figure 5: where the junction forms, what jumps, and the energy lost.

    Args:
        contact: the contact.
        junction: its junction.
        gap_nm: of the whole curve, in and out.
        force_nn: along it.
    """
    on, step = float(junction.forms_gap_nm), 1e-6
    solid, nearer = (float(contact.junction.force(junction.shift_nm - gap)) for gap in (on, on - step))
    jump = float(contact.forces(on)) - solid
    kink = float(contact.forces.stiffness(on)) - (nearer - solid) / step
    # the area between the ways by the trapezoidal rule; between 4.7 and 3.5 nm the gap is dry and the force 0
    area = -float(np.trapezoid(force_nn, gap_nm))
    total, parts = float(junction.hysteresis_aj), (junction.bridge_hysteresis_aj, junction.junction_hysteresis_aj)
    jumps = force_jumps(contact, junction)
    return [
        Statement(
            "the junction forms at 0.124 nm, at a negative force",
            abs(on - PAPER["forms_gap_nm"]) < 5e-4 and float(junction.force_nn) < 0.0,
            {"forms_gap_nm": on, "force_nn": float(junction.force_nn)},
        ),
        Statement(
            "force and stiffness do not jump there",
            abs(jump) < 1e-9 and abs(kink) < 1e-3 * float(junction.stiffness_nn_per_nm),
            {"jump_nn": jump, "stiffness_jump_nn_per_nm": kink},
        ),
        Statement(
            "the force jumps where the bridge forms, where the junction breaks and where the bridge breaks",
            all(abs(size) > 1.0 for size in jumps.values()),
            {"jump_nn": jumps},
        ),
        Statement(
            "the total hysteretic loss is 6e-17 J, within 10 %",
            abs(total - PAPER["hysteresis_aj"]) < 0.1 * PAPER["hysteresis_aj"] and abs(area - total) < 0.001 * total,
            {"hysteresis_aj": total, "area_of_the_curve_aj": area},
        ),
        Statement(
            "both bridge and junction contribute to it",
            all(float(part) > 0.1 * total for part in parts),
            {"bridge_aj": float(parts[0]), "junction_aj": float(parts[1])},
        ),
    ]


def force_jumps(contact: Contact, junction: Junction) -> dict[str, float]:
    """Return the jumps of the static force in nN, in the direction of travel."""
    forms, breaks = float(contact.bridge_forms_nm), float(contact.bridge_breaks_nm)
    off = float(junction.breaks_gap_nm)
    before = float(contact.junction.force(junction.shift_nm - off))
    return {
        "bridge_forms": float(contact.forces(forms)),
        "junction_breaks": float(contact.forces(off)) - before,
        "bridge_breaks": -float(contact.forces(breaks)),
    }


def law_statements(numbers: Mapping[str, Any]) -> list[Statement]:
    """Figure 6: the cutoff, the fit of eq. 6, and the one that follows the law more closely.

    Args:
        numbers: of the figure.
    """
    capture, r, epsilon = (numbers[name] for name in ("capture_speed_nm_per_us", "r", "epsilon"))
    worst, linear = numbers["worst_error_nm_per_us"], numbers["linear_loss"]["worst_error_nm_per_us"]
    share = numbers["worst_error_of_top_speed"]
    return [
        Statement(
            "the cutoff speed is 1.12e-2 m/s, within 3 %",
            abs(capture - PAPER["capture_nm_per_us"]) < 0.03 * PAPER["capture_nm_per_us"],
            {"capture_speed_nm_per_us": capture},
        ),
        Statement(
            "eq. 6, fitted, reproduces the law within 0.3 % of the top speed",
            share < PAPER["worst_share"],
            {"worst_error_of_top_speed": share},
        ),
        Statement(
            "its parameters are r = 0.9981 and epsilon = 1.26e-4 m^2/s^2, 1 - r within 10 % and epsilon within 5 %",
            abs(r - PAPER["r"]) < 0.1 * (1.0 - PAPER["r"])
            and abs(epsilon - PAPER["epsilon"]) < 0.05 * PAPER["epsilon"],
            {"r": r, "epsilon": epsilon, "adhesive_energy_aj": numbers["adhesive_energy_aj"]},
        ),
        Statement(
            "a loss linear in speed (not in the paper) follows the law at least five times as closely",
            5.0 * linear < worst,
            {"worst_error_nm_per_us": {"eq. 6": worst, "linear loss": linear}},
        ),
    ]


def course_statements(lag_us: float, delay_us: float) -> list[Statement]:
    """Figure 7: lag, lead, and their difference, which needs no definition of either.

    Args:
        lag_us: time in the solid junction.
        delay_us: the collision delay.
    """
    lead, paper_delay = lag_us - delay_us, PAPER["lag_us"] - PAPER["lead_us"]
    return [
        Statement(
            "the tip spends the paper's lag of 0.11 us, within 10 %, in the solid junction",
            abs(lag_us - PAPER["lag_us"]) < 0.1 * PAPER["lag_us"],
            {"lag_us": lag_us},
        ),
        Statement(
            "what remains of the delay is the paper's lead of 0.2 us, within 10 %",
            abs(lead - PAPER["lead_us"]) < 0.1 * PAPER["lead_us"],
            {"lead_us": lead},
        ),
        Statement(
            "the tip leaves ahead of an instantaneous impact, by the paper's lead less its lag within 0.015 us",
            delay_us < 0.0 and abs(delay_us - paper_delay) < 0.015,
            {"collision_delay_us": delay_us, "paper_us": paper_delay},
        ),
    ]
