"""The data of the paper's figures 4 to 7, on the contact of section IV, with what it says of them checked."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.contact.collide import capture_speed, collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.forces.capillary import Capillary
from afm_jax.contact.forces.core_repulsion import CoreRepulsion
from afm_jax.contact.forces.structural import Structural
from afm_jax.contact.junction import find_junction
from afm_jax.contact.law_of_contact import closest_law
from afm_jax.contact.time_course import TimeCourse, time_course
from afm_jax.impact.law import ImpactLaw
from afm_jax.study.contact_statements import (
    PAPER,
    course_statements,
    force_statements,
    hysteresis_statements,
    law_statements,
)
from afm_jax.study.figure_statements import Statement

FIT_RANGE = (12.0, 150.0)
SLOW_SPEED = 15.0
"""Approach speed of figure 7, in nm/us."""

Columns = dict[str, Float[np.ndarray, " points"]]


@dataclass(frozen=True)
class ContactFigure:
    """One figure: columns of equal length, key numbers, statements.

    Attributes:
        columns: the table, by column name.
        numbers: key numbers of the figure.
        statements: what the paper says of it, checked.
        course: the time course, for figure 7.
    """

    columns: Columns
    numbers: dict[str, Any]
    statements: list[Statement]
    course: TimeCourse | None = field(default=None)

    @property
    def valid(self) -> bool:
        """Whether every statement holds."""
        return all(statement.holds for statement in self.statements)

    def table(self) -> list[dict[str, float]]:
        """Return the rows of the table."""
        names = list(self.columns)
        return [dict(zip(names, row, strict=True)) for row in zip(*self.columns.values(), strict=True)]


def figure4() -> ContactFigure:
    """Return the static forces of the liquid bridge over the gap."""
    contact = Contact.paper()
    gap = np.concatenate([np.linspace(0.09, 0.4, 150, endpoint=False), np.linspace(0.4, 4.5, 250)])
    terms = {"capillary": Capillary(), "structural": Structural(), "core": CoreRepulsion()}
    forces = {f"{name}_nn": np.asarray(term(gap)) for name, term in terms.items()}
    total = sum(forces.values(), start=np.zeros_like(gap))
    statements = force_statements(contact)
    least = total.argmin()
    numbers: dict[str, Any] = {
        "largest_attraction_nn": float(total[least]),
        "largest_attraction_gap_nm": float(gap[least]),
        "repulsive_below_nm": statements[0].numbers["repulsive_below_nm"],
        "bridge_forms_nm": float(contact.bridge_forms_nm),
        "viscous_share_of_static_force": _viscous_share(contact),
    }
    return ContactFigure({"gap_nm": gap, **forces, "sum_nn": total}, numbers, statements)


def _viscous_share(contact: Contact) -> dict[str, float]:
    """Return the viscous over the static force of the slow impact of figure 7, at its speed far from the sample."""
    on = float(find_junction(contact).forms_gap_nm)
    gaps = {"bridge_forms": float(contact.bridge_forms_nm), "1 nm": 1.0, "junction_forms": on}
    return {
        name: abs(float(contact.forces(gap, -SLOW_SPEED) / contact.forces(gap)) - 1.0) for name, gap in gaps.items()
    }


def figure5() -> ContactFigure:
    """Return the loading and unloading curve, way in and way out."""
    contact = Contact.paper()
    junction = find_junction(contact)
    on, off = float(junction.forms_gap_nm), float(junction.breaks_gap_nm)
    forms, breaks = float(contact.bridge_forms_nm), float(contact.bridge_breaks_nm)
    way_in, way_out = np.geomspace(forms, on, 200), np.geomspace(off, breaks, 200)
    pressed = np.linspace(on, -0.6, 100)
    # points crowd at the fold, where the slope is infinite
    pulled = off - (off + 0.6) * np.linspace(1.0, 0.0, 200) ** 2

    def solid(gap: Float[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
        return np.asarray(contact.junction.force(junction.shift_nm - gap))

    gaps = [way_in, pressed, pulled, way_out]
    forces = [np.asarray(contact.forces(way_in)), solid(pressed), solid(pulled), np.asarray(contact.forces(way_out))]
    leg = np.repeat(np.arange(4.0), [part.size for part in gaps])
    numbers: dict[str, Any] = {
        "bridge_forms_nm": forms,
        "bridge_breaks_nm": breaks,
        "forms_gap_nm": on,
        "breaks_gap_nm": off,
        "force_at_snap_on_nn": float(junction.force_nn),
        "stiffness_at_snap_on_nn_per_nm": float(junction.stiffness_nn_per_nm),
        "hysteresis_aj": float(junction.hysteresis_aj),
        "bridge_hysteresis_aj": float(junction.bridge_hysteresis_aj),
        "junction_hysteresis_aj": float(junction.junction_hysteresis_aj),
    }
    columns = {"leg": leg, "gap_nm": np.concatenate(gaps), "force_nn": np.concatenate(forces)}
    statements = hysteresis_statements(contact, junction, columns["gap_nm"], columns["force_nn"])
    return ContactFigure(columns, numbers, statements)


def figure6() -> ContactFigure:
    """Return the impact law of the contact, its fit by eq. 6, and a fit with a loss linear in speed."""
    contact = Contact.paper()
    capture = float(capture_speed(contact))
    speeds = np.concatenate([np.linspace(0.5, capture, 20), capture + np.geomspace(1e-3, 150.0 - capture, 260)])
    rebound = np.asarray(collide(contact, speeds).rebound_speed_nm_per_us)
    even = np.linspace(*FIT_RANGE, 512)
    simulated = np.asarray(collide(contact, even).rebound_speed_nm_per_us)
    eq6, _ = closest_law(even, simulated, "law", "absolute")
    linear, _ = closest_law(even, simulated, "viscous", "absolute")

    def worst(law: ImpactLaw) -> float:
        return float(np.max(np.abs(np.asarray(law.rebound_speed(even)) - simulated)))

    error = worst(eq6)
    numbers: dict[str, Any] = {
        "capture_speed_nm_per_us": capture,
        "r": float(eq6.r),
        "epsilon": float(eq6.epsilon),
        "adhesive_energy_aj": 0.5 * float(eq6.epsilon),
        "fitted_between_nm_per_us": list(FIT_RANGE),
        "worst_error_nm_per_us": error,
        "worst_error_of_top_speed": error / FIT_RANGE[1],
        "worst_error_of_top_speed_with_the_papers_parameters": worst(ImpactLaw(PAPER["r"], PAPER["epsilon"]))
        / FIT_RANGE[1],
        "linear_loss": {
            "epsilon": float(linear.epsilon),
            "viscous_loss": float(linear.viscous_loss),
            "worst_error_nm_per_us": worst(linear),
        },
    }
    columns = {
        "approach_speed_nm_per_us": speeds,
        "rebound_speed_nm_per_us": rebound,
        "law_nm_per_us": np.asarray(eq6.rebound_speed(speeds)),
        "linear_loss_nm_per_us": np.asarray(linear.rebound_speed(speeds)),
    }
    return ContactFigure(columns, numbers, law_statements(numbers))


def figure7() -> ContactFigure:
    """Return the time course of a slow impact, and the path of an instantaneous one."""
    contact = Contact.paper()
    course = time_course(contact, SLOW_SPEED)
    result = collide(contact, SLOW_SPEED)
    rebound, delay = float(result.rebound_speed_nm_per_us), float(result.collision_delay_us)
    arrival = (
        float(contact.bridge_forms_nm) / SLOW_SPEED
    )  # of the straight path in at gap 0; the course's time is 0 where the bridge forms
    lag = float(result.time_in_junction_us)
    instantaneous = np.where(
        course.time_us < arrival, SLOW_SPEED * (arrival - course.time_us), rebound * (course.time_us - arrival)
    )
    numbers: dict[str, Any] = {
        "approach_speed_nm_per_us": SLOW_SPEED,
        "rebound_speed_nm_per_us": rebound,
        "arrival_us": arrival,
        "lag_us": lag,
        "lead_us": lag - delay,
        "collision_delay_us": delay,
    }
    columns = {
        "time_us": course.time_us,
        "gap_nm": course.gap_nm,
        "velocity_nm_per_us": course.velocity_nm_per_us,
        "phase": course.phase.astype(float),
        "force_nn": course.force_nn,
        "instantaneous_gap_nm": instantaneous,
    }
    return ContactFigure(columns, numbers, course_statements(lag, delay), course)


CONTACT_FIGURES = {"4": figure4, "5": figure5, "6": figure6, "7": figure7}
"""How each figure is made."""
