"""The data of the paper's figures 4 to 7, on the contact of section IV, with its statements checked on them."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from afm_jax.contact.capture import capture_speed
from afm_jax.contact.collide import collide
from afm_jax.contact.contact import Contact
from afm_jax.contact.forces.capillary import Capillary
from afm_jax.contact.forces.core_repulsion import CoreRepulsion
from afm_jax.contact.forces.structural import Structural
from afm_jax.contact.junction import Junction, find_junction
from afm_jax.contact.time_course import TimeCourse, time_course
from afm_jax.study.figure_statements import Statement

PAPER = {"snap_on_nm": 0.124, "hysteresis_aj": 60.0, "capture_nm_per_us": 11.2, "r": 0.9981, "epsilon": 126.0}
"""What the paper states of section IV: gap of snap-on, total hysteresis, cutoff speed, fit of eq. 6."""
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
    numbers: dict[str, object]
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
    gap = np.concatenate([np.linspace(0.1, 0.4, 150, endpoint=False), np.linspace(0.4, 4.5, 250)])
    terms = {"capillary": Capillary(), "structural": Structural(), "core": CoreRepulsion()}
    forces = {f"{name}_nn": np.asarray(term(gap)) for name, term in terms.items()}
    total = sum(forces.values(), start=np.zeros_like(gap))
    stiffness = np.asarray(Contact.paper().forces.stiffness(np.array([0.1, 0.2, 0.4])))
    attractive = float(np.mean(total[gap < 3.5] < 0.0))
    statements = [
        Statement("the static force is attractive over most of its range", attractive > 0.9, {"share": attractive}),
        Statement(
            "at gaps below about 0.2 nm the bridge becomes repulsive and very stiff",
            bool(total[0] > 0.0 and stiffness[0] > 20.0 * stiffness[1] > 0.0),
            {"stiffness_nn_per_nm_at_0.1_0.2_0.4_nm": stiffness.tolist()},
        ),
    ]
    numbers: dict[str, object] = {"largest_attraction_nn": float(total.min()), "at_gap_nm": float(gap[total.argmin()])}
    return ContactFigure({"gap_nm": gap, **forces, "sum_nn": total}, numbers, statements)


def figure5() -> ContactFigure:
    """Return the loading and unloading curve, way in and way out."""
    contact = Contact.paper()
    junction = find_junction(contact)
    on, off = float(junction.forms_gap_nm), float(junction.breaks_gap_nm)
    way_in, way_out = np.geomspace(3.5, on, 200), np.geomspace(off, 4.7, 200)
    pressed = np.linspace(on, -0.6, 100)
    # points crowd at the fold, where the slope is infinite
    pulled = off - (off + 0.6) * np.linspace(1.0, 0.0, 200) ** 2

    def solid(gap: Float[np.ndarray, " points"]) -> Float[np.ndarray, " points"]:
        return np.asarray(contact.junction.force(junction.shift_nm - gap))

    gaps = [way_in, pressed, pulled, way_out]
    forces = [np.asarray(contact.forces(way_in)), solid(pressed), solid(pulled), np.asarray(contact.forces(way_out))]
    leg = np.repeat(np.arange(4.0), [part.size for part in gaps])
    numbers: dict[str, object] = {
        "forms_gap_nm": on,
        "breaks_gap_nm": off,
        "force_at_snap_on_nn": float(junction.force_nn),
        "stiffness_at_snap_on_nn_per_nm": float(junction.stiffness_nn_per_nm),
        "hysteresis_aj": float(junction.hysteresis_aj),
        "bridge_hysteresis_aj": float(junction.bridge_hysteresis_aj),
        "junction_hysteresis_aj": float(junction.junction_hysteresis_aj),
    }
    columns = {"leg": leg, "gap_nm": np.concatenate(gaps), "force_nn": np.concatenate(forces)}
    return ContactFigure(columns, numbers, _hysteresis_statements(contact, junction, columns))


def _hysteresis_statements(contact: Contact, junction: Junction, columns: Columns) -> list[Statement]:
    on = float(junction.forms_gap_nm)
    step = 1e-6
    solid = (contact.junction.force(junction.shift_nm - on), contact.junction.force(junction.shift_nm - on + step))
    jump = float(contact.forces(on) - solid[0])
    kink = float(contact.forces.stiffness(on)) - float(solid[1] - solid[0]) / step
    # the area between the ways by the trapezoidal rule; between 4.7 and 3.5 nm the gap is dry and the force 0
    area = float(np.trapezoid(columns["force_nn"], columns["gap_nm"]))
    hysteresis = float(junction.hysteresis_aj)
    return [
        Statement(
            "the junction snaps on at 0.124 nm, at a negative force",
            abs(on - PAPER["snap_on_nm"]) < 5e-4 and float(junction.force_nn) < 0.0,
            {"forms_gap_nm": on, "force_nn": float(junction.force_nn)},
        ),
        Statement(
            "force and stiffness do not jump there",
            abs(jump) < 1e-9 and abs(kink) < 1.0,
            {"jump_nn": jump, "stiffness_jump_nn_per_nm": kink},
        ),
        Statement(
            "the total hysteretic loss is 6e-17 J",
            abs(hysteresis - PAPER["hysteresis_aj"]) < 5.0 and abs(area + hysteresis) < 0.01 * hysteresis,
            {"hysteresis_aj": hysteresis, "area_of_the_curve_aj": -area},
        ),
    ]


def figure6() -> ContactFigure:
    """Return the impact law of the contact, its fit by eq. 6, and a fit with a loss linear in speed."""
    contact = Contact.paper()
    capture = float(capture_speed(contact))
    speeds = np.concatenate([np.linspace(0.5, capture, 20), capture + np.geomspace(1e-3, 150.0 - capture, 260)])
    rebound = np.asarray(collide(contact, speeds).rebound_speed_nm_per_us)
    even = np.linspace(*FIT_RANGE, 512)
    simulated = np.asarray(collide(contact, even).rebound_speed_nm_per_us)
    r, epsilon = _fitted(lambda p, u: p[0] ** 2 * u**2 - p[1], (0.998, 120.0), even, simulated)
    linear_epsilon, loss = _fitted(lambda p, u: u**2 - p[1] * u - p[0], (114.0, 0.5), even, simulated)
    paper_law = np.sqrt(np.maximum(r**2 * speeds**2 - epsilon, 0.0))
    linear_law = np.sqrt(np.maximum(speeds**2 - loss * speeds - linear_epsilon, 0.0))
    worst = float(np.max(np.abs(np.sqrt(r**2 * even**2 - epsilon) - simulated)))
    linear_worst = float(np.max(np.abs(np.sqrt(even**2 - loss * even - linear_epsilon) - simulated)))
    numbers: dict[str, object] = {
        "capture_speed_nm_per_us": capture,
        "r": r,
        "epsilon": epsilon,
        "worst_error_nm_per_us": worst,
        "worst_error_of_top_speed": worst / FIT_RANGE[1],
        "linear_loss": {"epsilon": linear_epsilon, "viscous_loss": loss, "worst_error_nm_per_us": linear_worst},
    }
    statements = [
        Statement(
            "the cutoff speed is 1.12e-2 m/s",
            abs(capture - PAPER["capture_nm_per_us"]) < 0.3,
            {"capture_speed_nm_per_us": capture},
        ),
        Statement(
            "eq. 6 with r = 0.9981 and epsilon = 1.26e-4 m^2/s^2 reproduces the law within 0.3 %",
            abs(r - PAPER["r"]) < 5e-4 and abs(epsilon - PAPER["epsilon"]) < 8.0 and worst < 0.003 * FIT_RANGE[1],
            {"r": r, "epsilon": epsilon, "worst_error_of_top_speed": worst / FIT_RANGE[1]},
        ),
    ]
    columns = {
        "approach_speed_nm_per_us": speeds,
        "rebound_speed_nm_per_us": rebound,
        "law_nm_per_us": paper_law,
        "linear_loss_nm_per_us": linear_law,
    }
    return ContactFigure(columns, numbers, statements)


def _fitted(
    square: Callable[[np.ndarray, np.ndarray], np.ndarray],
    start: tuple[float, float],
    speeds: np.ndarray,
    rebound: np.ndarray,
) -> tuple[float, float]:
    """Return two parameters of a squared rebound speed, by least squares of absolute residuals."""

    def residual(parameters: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum(square(parameters, speeds), 0.0)) - rebound

    found = least_squares(residual, start, x_scale=np.abs(start))
    return float(found.x[0]), float(found.x[1])


def figure7() -> ContactFigure:
    """Return the time course of a slow impact, and the path of an instantaneous one."""
    contact = Contact.paper()
    course = time_course(contact, SLOW_SPEED)
    result = collide(contact, SLOW_SPEED)
    rebound, delay = float(result.rebound_speed_nm_per_us), float(result.collision_delay_us)
    arrival = 3.5 / SLOW_SPEED  # of the straight path in at gap 0; the course's time is 0 where the bridge forms
    lag = float(result.time_in_junction_us)
    instantaneous = np.where(
        course.time_us < arrival, SLOW_SPEED * (arrival - course.time_us), rebound * (course.time_us - arrival)
    )
    numbers: dict[str, object] = {
        "approach_speed_nm_per_us": SLOW_SPEED,
        "rebound_speed_nm_per_us": rebound,
        "arrival_us": arrival,
        "lag_us": lag,
        "lead_us": lag - delay,
        "collision_delay_us": delay,
    }
    statements = [
        Statement("the time lag is 0.11 us", abs(lag - 0.11) < 0.01, {"lag_us": lag}),
        Statement("the time lead is 0.2 us", abs(lag - delay - 0.2) < 0.03, {"lead_us": lag - delay}),
        Statement("the tip leaves ahead of an instantaneous impact", delay < 0.0, {"collision_delay_us": delay}),
    ]
    columns = {
        "time_us": course.time_us,
        "gap_nm": course.gap_nm,
        "velocity_nm_per_us": course.velocity_nm_per_us,
        "phase": course.phase.astype(float),
        "force_nn": course.force_nn,
        "instantaneous_gap_nm": instantaneous,
    }
    return ContactFigure(columns, numbers, statements, course)


CONTACT_FIGURES = {"4": figure4, "5": figure5, "6": figure6, "7": figure7}
"""How each figure is made."""
