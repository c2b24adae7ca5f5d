"""Orbits followed through a parameter by pseudo-arclength, round folds, with the points where their nature changes.

Takes a scene and the range of a parameter in its unit; gives branches and special points: phases in rad, speeds in
nm/us, amplitudes in nm, multipliers (eqs. 8 and 9).

The unknowns of a closed loop, followed by the parameter as a fraction of its range, lie on a curve (`curves`). Orbits
are looked for at some values of the parameter, the curves through them are followed, and on these the special points
are located (`special_points`), which are followed through a second parameter in turn.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import RANGE_OF_ONE, Scene
from afm_jax.checks import checked, require_float64
from afm_jax.columns import CsvColumns, columns_of, csv_columns
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.contact_orbits import ContactLoops
from afm_jax.dynamics.curves import FollowedCurve, followed_both_ways, lies_on, root_on
from afm_jax.dynamics.impact_loop import CAPTURE, LoopFamily, driven_part
from afm_jax.dynamics.impact_orbits import IMPACT_COLUMNS, LawLoops, check_loop, orbit_facts
from afm_jax.dynamics.special_points import (
    OrbitBranch,
    SpecialCurve,
    SpecialPoint,
    special_curves,
    special_points_of,
)
from afm_jax.impact.law import impact_law_of
from afm_jax.report import Cell, Section, sections, table_of
from afm_jax.results import ResultTuple, public_result
from afm_jax.saved import as_json
from afm_jax.scenefile.parameter_paths import (
    ParameterRange,
    check_ranges,
    parameter_values,
    parse_range,
    scene_family,
)
from afm_jax.units import TWO_SIDED_95
from afm_jax.words import counted

_POINT_COLUMNS = (
    *("branch", "parameter", "phase_rad", "velocity_after_nm_per_us", "peak_amplitude_nm", "peak_amplitude_error_nm"),
    *("trace", "determinant", "stable", "admissible"),
)
_SPECIAL_COLUMNS = (
    *("kind", "parameter", "parameter_error", "interval95_low", "interval95_high", "branch"),
    *("peak_amplitude_nm", "admissible"),
)
_ENDS = {
    "range": "the end of the range",
    "capture": "capture (an impact comes too slowly to leave again)",
    "no_speed": "where an impact's speed vanishes (the tip grazes the sample, or rests on it)",
    "delay": "close to capture, where the law's delay is longer than half a drive period",
    "shorter": "where it becomes an orbit of fewer impacts",
    "closed": "where it began (it is closed)",
    "lost": "a point that it could not be followed beyond",
    "too long": "the most points that are followed",
}
"""In words why a branch ends."""


@public_result(picture="afm_jax.plots.branches:continuation_figure")
class Continuation(ResultTuple):
    """Orbits followed through a parameter, their special points, and curves of these in two parameters."""

    order: int
    impacts: int
    range: ParameterRange
    second: ParameterRange | None
    branches: tuple[OrbitBranch, ...]
    special: tuple[SpecialPoint, ...]
    curves: tuple[SpecialCurve, ...]
    family: LawLoops | ContactLoops
    amplitude_errors: tuple[Float[np.ndarray, " points"], ...] | None = None
    """Standard errors of the peak amplitude, in nm, of each branch."""
    special_errors: Float[np.ndarray, " special"] | None = None
    """Standard errors of the parameter at the special points."""

    @property
    def reason(self) -> str | None:
        """Why no point of the branches is an orbit that the tip flies; None where one is."""
        if any(branch.reading.admissible.any() for branch in self.branches):
            return None
        order, where = self.order, f"with {self.range}"
        what = f"orbit of {counted(self.impacts, 'impact')} in {order} drive periods"
        if self.impacts == 0:
            return f"the tip meets the sample at every value of {self.range}; try `impacts=1`"
        return f"no {what} was found {where}, but a search may miss some; try another order or range"

    @property
    def impact_speeds_nm_per_us(self) -> list[float]:
        """Approach speeds of all impacts of all points."""
        return [speed for branch in self.branches for speed in branch.reading.approach_speed_nm_per_us.ravel().tolist()]


def _point_rows(result: Continuation) -> list[dict[str, Any]]:
    """Return the points of the branches as plain numbers, the first impact's and all impacts of each."""
    rows = []
    for number, branch in enumerate(result.branches):
        for index, value in enumerate(branch.parameter.tolist()):
            row = {"branch": number, "parameter": value, **orbit_facts(branch.reading, index)}
            if result.amplitude_errors is not None:
                row["peak_amplitude_error_nm"] = float(result.amplitude_errors[number][index])
            rows.append(row)
    return rows


def _special_rows(result: Continuation) -> list[dict[str, Any]]:
    """Return the special points as plain numbers, with an interval where the law has errors."""
    rows = []
    for index, point in enumerate(result.special):
        row = {
            "kind": point.kind,
            "parameter": point.parameter,
            "branch": point.branch,
            "peak_amplitude_nm": float(point.reading.peak_amplitude_nm),
            "admissible": point.admissible,
        }
        if result.special_errors is not None:
            error = float(result.special_errors[index])
            low, high = point.parameter - TWO_SIDED_95 * error, point.parameter + TWO_SIDED_95 * error
            row |= {"parameter_error": error, "interval95": [low, high]}
        rows.append(row)
    return rows


@as_json.register
def _(result: Continuation) -> dict[str, Any]:
    return {
        "order": result.order,
        "impacts": result.impacts,
        "parameter": result.range.path,
        "range": [result.range.low, result.range.high],
        "second": None if result.second is None else result.second.path,
        "points": _point_rows(result),
        "special": _special_rows(result),
        "curves": [curve._asdict() for curve in result.curves],
        "branches": [{"points": len(branch.parameter), "ends": list(branch.ends)} for branch in result.branches],
    }


@sections.register
def _(result: Continuation) -> list[Section]:
    parts: list[Any] = []
    for number, branch in enumerate(result.branches):
        low, high = branch.parameter.min(), branch.parameter.max()
        ends = " and ".join(dict.fromkeys(_ENDS[end] for end in branch.ends))
        count = len(branch.parameter)
        parts.append(f"  branch {number}: {count} points between {low:.6g} and {high:.6g}; ends at {ends}")
    if result.special:
        cells: dict[str, Cell] = {
            "kind": lambda row: row["kind"].replace("_", " "),
            result.range.path: "parameter:.9g",
            "peak\nnm": "peak_amplitude_nm:.5g",
            "branch": "branch:d",
            "admissible": "admissible",
        }
        if result.special_errors is not None:
            cells["95 % interval"] = lambda row: "{:.5g} to {:.5g}".format(*row["interval95"])
        parts += ["Special points", table_of(cells, _special_rows(result))]
    for curve in result.curves:
        ends = [f"({curve.parameter[place]:.5g}, {curve.second[place]:.5g})" for place in (0, -1)]
        parts.append(f"  curve of {curve.kind.replace('_', ' ')} from {ends[0]} to {ends[1]}")
    kind = f"({result.impacts}, {result.order}) orbits"
    return [Section(f"{'' if result.branches else 'No '}{kind} with {result.range}", parts)]


@csv_columns.register
def _(result: Continuation) -> CsvColumns:
    # points, their impacts if there are several, special points, and curves
    points, special = _point_rows(result), _special_rows(result)
    tables = {"branches.csv": columns_of(points, _POINT_COLUMNS)}
    if result.impacts > 1:
        impacts = [{"point": k, **impact} for k, point in enumerate(points) for impact in point["impacts"]]
        tables["impacts.csv"] = columns_of(impacts, ("point", *IMPACT_COLUMNS))
    for row in special:
        row["interval95_low"], row["interval95_high"] = row.get("interval95", (None, None))
    tables["special.csv"] = columns_of(special, _SPECIAL_COLUMNS)
    if result.second is not None:
        curves = [
            {"curve": k, "kind": curve.kind, "parameter": p, "second": q, "admissible": flown}
            for k, curve in enumerate(result.curves)
            for p, q, flown in zip(curve.parameter, curve.second, curve.admissible, strict=True)
        ]
        tables["curves.csv"] = columns_of(curves, ("curve", "kind", "parameter", "second", "admissible"))
    return tables


@checked
def continue_orbits(
    scene: Scene,
    order: int,
    given: str | ParameterRange,
    *,
    impacts: int = 1,
    second: str | ParameterRange | None = None,
) -> Continuation:
    """Follow the (m, N) orbits of a scene through a parameter, and their special points through a second one.

    Orbits are looked for at the scene's own value, if that is in the range, and at 9 values in the range; every one
    that the map flies is followed both ways, through folds, to the ends of the range, to capture or until the curve
    closes. A flight that comes to pass through the surface (grazing) ends no curve: its points are not admissible.

    Args:
        scene: one scene with an `ImpactLaw` or a `Contact`, driven with one period. A contact's curves end where the
            orbit grazes and where it is captured.
        order: N, drive periods in which the orbit repeats.
        given: the parameter and its range, "platform.amplitude_nm=0.5:6" as in the command.
        impacts: m, impacts in them; 0: the motion of a tip that meets nothing.
        second: another parameter and its range, which holds the scene's own value; None: no curves are followed.

    Raises:
        RuntimeError: if JAX is not set to 64-bit floats.
        TypeError: if the tip meets nothing.
        ValueError: if the drive does not repeat, a parameter or a range is none of the scene's, or order and impacts
            are no numbers of impacts and periods.
    """
    require_float64(scene)
    given = parse_range(given, counted=False)
    second = None if second is None else parse_range(second, counted=False)
    ranges = (given,) if second is None else (given, second)
    driven_part(scene)  # refuses a scene whose motions cannot repeat
    _check(scene, order, impacts, ranges)
    if second is not None:
        value = parameter_values(scene)[second.path]
        if not second.low <= value <= second.high:
            raise ValueError(f"{second}: the range must hold the scene's own value, {value:g}, where the curves begin")
    kind = ContactLoops if isinstance(scene.interaction, Contact) else LawLoops
    family = kind.of(scene, order, ranges[:1])
    starts = _orbits_in_range(family, impacts, given)
    speed_unit = max((loop[impacts:].max() for _, loop in starts if impacts), default=1.0)
    family = replace(family, speed_unit=jnp.asarray(speed_unit))
    followed: list[FollowedCurve] = []
    for fraction, loop in starts:
        start = np.append(loop / family.units(impacts), fraction)
        if not any(lies_on(start, curve, family) for curve in followed):
            curve = followed_both_ways(start, family)
            if curve is not None:
                followed.append(curve)
    branches = tuple(_branch(curve, family) for curve in followed)
    special = tuple(
        point for number, curve in enumerate(followed) for point in special_points_of(curve, number, family)
    )
    curves = ()
    if second is not None:
        both = replace(kind.of(scene, order, ranges), speed_unit=family.speed_unit)
        curves = special_curves(special, both, second, parameter_values(scene)[second.path])
    return Continuation(order, impacts, given, second, branches, special, curves, family)


def _check(scene: Scene, order: int, impacts: int, ranges: Sequence[ParameterRange]) -> None:
    check_loop(order, impacts or 1)
    if not isinstance(scene.interaction, Contact):
        impact_law_of(scene)
    elif impacts == 0:
        raise ValueError("`impacts` must be 1 or more in a scene with a contact, but is 0")
    check_ranges(scene, *ranges)
    for given in ranges:
        if impacts and given.path == "interaction.r" and given.low == 0.0:
            raise ValueError(
                f"{given}: at r = 0 every impact is a capture and no orbit leaves; begin the range above 0"
            )
        for end in (given.low, given.high):
            try:
                driven_part(scene_family(scene, given.path)(end))
            except ValueError as problem:
                hint = f"; {RANGE_OF_ONE}" if "frequency" in given.path else ""
                raise ValueError(f"{given}: {problem}{hint}") from None


def _orbits_in_range(family: LoopFamily, impacts: int, given: ParameterRange) -> list[tuple[float, np.ndarray]]:
    """Return orbits at some values in the range: the fraction of the range, and the loop in rad and nm/us."""
    value, width = parameter_values(family.scene)[given.path], given.high - given.low
    few = impacts > 1 or isinstance(family, ContactLoops)
    tried = np.linspace(0.0, 1.0, (3 if few else 9) + 2)[1:-1]
    # the middle first
    fractions = tried[np.argsort(np.abs(tried - 0.5), kind="stable")].tolist()
    if given.low <= value <= given.high:
        fractions = [(value - given.low) / width, *fractions]
    if impacts == 0:
        return [(fractions[0], np.zeros(0))]
    found = ((fraction, family.found(np.array([given.low + width * fraction]), impacts)) for fraction in fractions)
    return [(fraction, loop) for fraction, loops in found for loop in loops]


def _branch(curve: FollowedCurve, family: LoopFamily) -> OrbitBranch:
    """Return the orbits along a curve; where an impact loses its speed the last point is just before."""
    points, ends = curve.points, list(curve.ends)
    for place in (0, -1):
        if ends[place] == "capture":
            leg = curve.legs[place]
            root = root_on(leg, CAPTURE, family)
            # of the last step's way to capture: there the orbit still exists
            last = None if root is None else leg.at(root[0] + 1e-6 * (1 + place - root[0]), family)
            points[place] = (leg.end if place == 0 else leg.begin).point if last is None else last.point
            if family.captures_nothing(points[place]):
                ends[place] = "no_speed"
    value = float(family.low[0]) + float(family.width[0]) * points[:, -1]
    return OrbitBranch(value, points, family.readings(points), (ends[0], ends[1]))
