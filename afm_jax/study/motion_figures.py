"""The data of the paper's figures 8, 10 and 11, motions of the contact model, with what it says of them checked."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax import presets
from afm_jax.study.figure_statements import Statement
from afm_jax.study.motion_statements import rise_statements, section_statements, sticking_statements
from afm_jax.study.section_survey import MORE, SHOWN, Course, Growth, survey, tangent_growth
from afm_jax.study.slow_ramps import Ramp, Report, slow_ramps

SECTION_POINTS = 1000
_FALL_RAMPS = ((1e-2, 5.0), (2e-3, 0.6))
"""Rate in nm/us and last offset in nm. A held tip costs a hundred times a bouncing one: the slow ramp ends soon."""
_RISE_RAMPS = ((1e-2, 2.0), (1e-3, 2.0))


@dataclass(frozen=True)
class MotionFigure:
    """One figure.

    Attributes:
        columns: the table, by column name, a row for every contact.
        numbers: key numbers.
        statements: what the paper says of it, checked.
        courses: the motions of figure 8.
        growth: of small distances in figure 8.
        ramps: the motions of figures 10 and 11.
    """

    columns: Mapping[str, Float[np.ndarray, " contacts"]]
    numbers: dict[str, Any]
    statements: list[Statement]
    courses: tuple[Course, ...] = ()
    growth: Growth | None = None
    ramps: tuple[Ramp, ...] = ()

    @property
    def valid(self) -> bool:
        """Whether every statement holds."""
        return all(statement.holds for statement in self.statements)

    def table(self) -> list[dict[str, float]]:
        """Return the rows of the table."""
        names = list(self.columns)
        return [dict(zip(names, row, strict=True)) for row in zip(*self.columns.values(), strict=True)]


def figure8(*, coarse: bool = False, report: Report = lambda _: None) -> MotionFigure:
    """Return the Poincare section: broadband stretches of several starts, and the (1,5) orbit in which they end.

    The paper shows a strange attractor; followed longer, the broadband motion turns out to be transient chaos. How many
    impacts it lasts is a matter of rounding.

    Args:
        coarse: leave out the growth of small distances.
        report: told how far it is.
    """
    courses = survey((*SHOWN, *MORE), report=report)
    growth = None
    if not coarse:
        report("growth of small distances")
        growth = tangent_growth(max(courses, key=lambda course: course.broadband))
    attractor = next(course for course in courses if course.velocity_nm_per_us == SHOWN[-1])
    statements = section_statements(courses, attractor, growth)
    numbers: dict[str, Any] = {
        "starts_nm_per_us": [course.velocity_nm_per_us for course in courses],
        "broadband_impacts": sum(course.broadband for course in courses),
    }
    return MotionFigure(_section_columns(courses), numbers, statements, tuple(courses), growth)


def figure10(*, coarse: bool = False, report: Report = lambda _: None) -> MotionFigure:
    """Return the motion below resonance under a rising offset.

    Args:
        coarse: the fastest ramp only.
        report: told how far it is.
    """
    settled, ramps = slow_ramps(presets.figure10_scene, _FALL_RAMPS[:1] if coarse else _FALL_RAMPS, report=report)
    return _ramp_figure(settled, ramps, sticking_statements(settled, ramps))


def figure11(*, coarse: bool = False, report: Report = lambda _: None) -> MotionFigure:
    """Return the motion above resonance under a rising offset.

    Args:
        coarse: no difference; the ramps are short.
        report: told how far it is.
    """
    del coarse
    settled, ramps = slow_ramps(presets.figure11_scene, _RISE_RAMPS, report=report)
    return _ramp_figure(settled, ramps, rise_statements(settled, ramps))


def _section_columns(courses: list[Course]) -> dict[str, Float[np.ndarray, " contacts"]]:
    def joined(of: Callable[[Course], np.ndarray]) -> np.ndarray:
        return np.concatenate([of(course) for course in courses])

    return {
        "start_velocity_nm_per_us": joined(
            lambda course: np.full(course.motion.departure_time_us.shape, course.velocity_nm_per_us)
        ),
        "contact": joined(lambda course: np.arange(course.motion.departure_time_us.size, dtype=float)),
        "locked": joined(
            lambda course: (np.arange(course.motion.departure_time_us.size) >= course.broadband).astype(float)
        ),
        "departure_time_us": joined(lambda course: course.motion.departure_time_us),
        "drive_phase_deg": joined(lambda course: course.motion.drive_phase_deg),
        "departure_velocity_nm_per_us": joined(lambda course: course.motion.departure_velocity_nm_per_us),
        "approach_speed_nm_per_us": joined(lambda course: course.motion.approach_speed_nm_per_us),
        "peak_height_nm": joined(lambda course: course.motion.peak_height_nm),
    }


def _ramp_figure(settled: float, ramps: list[Ramp], statements: list[Statement]) -> MotionFigure:
    def joined(of: Callable[[Ramp], np.ndarray]) -> np.ndarray:
        return np.concatenate([of(ramp) for ramp in ramps])

    columns = {
        "rate_nm_per_us": joined(lambda ramp: np.full(ramp.offset_nm.shape, ramp.rate_nm_per_us)),
        "departure_time_us": joined(lambda ramp: ramp.motion.departure_time_us),
        "offset_nm": joined(lambda ramp: ramp.offset_nm),
        "drive_phase_deg": joined(lambda ramp: ramp.motion.drive_phase_deg),
        "approach_speed_nm_per_us": joined(lambda ramp: ramp.motion.approach_speed_nm_per_us),
        "departure_velocity_nm_per_us": joined(lambda ramp: ramp.motion.departure_velocity_nm_per_us),
        "peak_height_nm": joined(lambda ramp: ramp.motion.peak_height_nm),
        "law_peak_height_nm": joined(lambda ramp: ramp.law_peak_nm),
    }
    numbers: dict[str, Any] = {
        "settled_peak_nm": settled,
        "rates_nm_per_us": [ramp.rate_nm_per_us for ramp in ramps],
    }
    return MotionFigure(columns, numbers, statements, ramps=tuple(ramps))


MOTION_FIGURES: dict[str, Callable[..., MotionFigure]] = {"8": figure8, "10": figure10, "11": figure11}
"""How each figure is made."""
