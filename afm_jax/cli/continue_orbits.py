"""`afm-jax continue SCENE.toml --order N --parameter P=a:b`: orbits followed through one parameter, or two."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from afm_jax.cli.columns import TableColumn, columns_of, printed_table
from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.orbits import IMPACT_COLUMNS, impact_rows, orbit_facts, refuse_other_than_law
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.bands import amplitude_errors, special_errors
from afm_jax.dynamics.continuation import Continuation, continue_orbits
from afm_jax.dynamics.special_points import OrbitBranch, SpecialCurve
from afm_jax.dynamics.sticking_orbits import follow_sticking
from afm_jax.units import TWO_SIDED_95
from afm_jax.words import counted

POINT_COLUMNS = (
    "branch",
    "parameter",
    "phase_rad",
    "velocity_after_nm_per_us",
    "peak_amplitude_nm",
    "peak_amplitude_error_nm",
    "trace",
    "determinant",
    "stable",
    "admissible",
)
SPECIAL_COLUMNS = (
    "kind",
    "parameter",
    "parameter_error",
    "interval95_low",
    "interval95_high",
    "branch",
    "peak_amplitude_nm",
    "admissible",
)
CURVE_COLUMNS = ("curve", "kind", "parameter", "second", "admissible")
_ENDS = {
    "range": "the end of the range",
    "capture": "capture: an impact comes too slowly to leave again",
    "no_speed": "where an impact's speed vanishes: the tip grazes the sample, or rests on it",
    "delay": "close to capture, where the law's delay is longer than half a drive period",
    "shorter": "where it becomes an orbit of fewer impacts",
    "closed": "where it began: it is closed",
    "held": "where the sample no longer lets the tip go",
    "rest_lost": "where the sample no longer holds the tip for a while",
    "grazing": "where a flight grazes the sample, and another motion follows",
    "lost": "a point that it could not be followed beyond",
    "too long": "the most points that are followed",
}


def follow(  # noqa: PLR0913
    session: Session,
    scene: NamedScene,
    *,
    order: int,
    impacts: int,
    parameter: str,
    second: str | None,
    sticking: bool,
    picture: str,
) -> Output:
    """Return the branches of orbits through a parameter, their special points, and these as curves in two."""
    if sticking or not isinstance(scene.scene.interaction, Contact):
        refuse_other_than_law(scene.scene, scene.name)
    given = [parameter, *([] if second is None else [second])]
    first, *others = ranges_of(scene.name, scene.scene, given, counted=False)
    with session.working("following orbits (the first run compiles for some seconds)", "values") as report:
        if sticking:
            followed = follow_sticking(scene.scene, order, first, report=report)
        else:
            followed = continue_orbits(scene.scene, order, first, impacts=impacts, second=others[0] if others else None)
    return _output(scene, followed, picture)


def _output(scene: NamedScene, followed: Continuation, picture: str) -> Output:
    unknowns = scene.unknowns
    bands = None if unknowns is None else [amplitude_errors(followed, branch, unknowns) for branch in followed.branches]
    errors = None if unknowns is None else special_errors(followed, unknowns)
    points = [
        row
        for number, branch in enumerate(followed.branches)
        for row in point_rows(number, branch, None if bands is None else bands[number])
    ]
    special = _special_rows(followed, errors)
    curves = [_curve(curve) for curve in followed.curves]
    reason = None if any(point["admissible"] for point in points) else _why_none(followed)
    payload = {
        "order": followed.order,
        "impacts": followed.impacts,
        "parameter": followed.range.path,
        "range": [followed.range.low, followed.range.high],
        "second": None if followed.second is None else followed.second.path,
        "points": points,
        "special": special,
        "curves": curves,
        "branches": [{"points": len(branch.parameter), "ends": list(branch.ends)} for branch in followed.branches],
        "sticking": followed.sticking,
        "law_parameters": None if unknowns is None else list(unknowns.paths),
        "reason": reason,
    }
    files = {f"branches.{picture}": picture_of("branches:continuation_figure", followed, bands=bands, errors=errors)}
    if followed.curves:
        files[f"curves.{picture}"] = picture_of("branches:curves_figure", followed)
    return Output(
        payload=payload,
        text=_text(followed, special, curves),
        impact_speeds=[impact["approach_speed_nm_per_us"] for point in points for impact in point["impacts"]],
        tables=_tables(followed, points, special, curves),
        files=files,
        not_valid=reason,
    )


def _special_rows(followed: Continuation, errors: Any) -> list[dict[str, Any]]:
    """Return the special points as plain mappings, with an interval where the law has errors."""
    rows = []
    for index, point in enumerate(followed.special):
        row = {
            "kind": point.kind,
            "parameter": point.parameter,
            "branch": point.branch,
            "peak_amplitude_nm": float(point.reading.peak_amplitude_nm),
            "admissible": point.admissible,
            "impacts": impact_rows(point.reading),
        }
        if errors is not None:
            half = TWO_SIDED_95 * float(errors[index])
            row["parameter_error"] = float(errors[index])
            row["interval95"] = [point.parameter - half, point.parameter + half]
        rows.append(row)
    return rows


def point_rows(number: int, branch: OrbitBranch, band: Any = None) -> list[dict[str, Any]]:
    """Return the points of a branch as plain mappings, with the first impact's numbers and all impacts."""
    rows = []
    for index, value in enumerate(branch.parameter.tolist()):
        row = {"branch": number, "parameter": value, **orbit_facts(branch.reading, index)}
        if band is not None:
            row["peak_amplitude_error_nm"] = float(band[index]) if np.isfinite(band[index]) else None
        rows.append(row)
    return rows


def _curve(curve: SpecialCurve) -> dict[str, Any]:
    return {
        "kind": curve.kind,
        "parameter": curve.parameter.tolist(),
        "second": curve.second.tolist(),
        "admissible": curve.admissible.tolist(),
        "meetings": [meeting._asdict() for meeting in curve.meetings],
        "ends": list(curve.ends),
    }


def _tables(
    followed: Continuation,
    points: Sequence[Mapping[str, Any]],
    special: Sequence[Mapping[str, Any]],
    curves: Sequence[Mapping[str, Any]],
) -> dict[str, dict[str, Any]]:
    """Return the columns of the CSV files: points, their impacts if there are several, special points, curves."""
    tables = {"branches.csv": columns_of(points, POINT_COLUMNS)}
    if followed.impacts > 1:
        rows = [{"point": k, **impact} for k, point in enumerate(points) for impact in point["impacts"]]
        tables["impacts.csv"] = columns_of(rows, ("point", *IMPACT_COLUMNS))
    flat = [
        {**row, **dict(zip(("interval95_low", "interval95_high"), row.get("interval95", ()), strict=False))}
        for row in special
    ]
    tables["special.csv"] = columns_of(flat, SPECIAL_COLUMNS)
    if followed.second is not None:
        rows = [
            {"curve": k, "kind": curve["kind"], "parameter": p, "second": q, "admissible": flown}
            for k, curve in enumerate(curves)
            for p, q, flown in zip(curve["parameter"], curve["second"], curve["admissible"], strict=True)
        ]
        tables["curves.csv"] = columns_of(rows, CURVE_COLUMNS)
    return tables


def _why_none(followed: Continuation) -> str:
    order, where = followed.order, f"with {followed.range}"
    if followed.sticking:
        return f"no tip rests on the sample, is let go and rests again after {order} periods {where}"
    what = f"orbit of {counted(followed.impacts, 'impact')} in {order} drive periods"
    if followed.impacts == 0:
        return f"the tip meets the sample at every value of {followed.range}; try --impacts 1"
    if followed.rejected:
        return f"in every {what} {where} the tip would have to pass through the platform; try another order"
    return f"no {what} was found {where}; try another order or range"


def _text(followed: Continuation, special: list[dict[str, Any]], curves: list[dict[str, Any]]) -> list[str | Table]:
    kind = (
        f"Orbits with a rest, N = {followed.order},"
        if followed.sticking
        else f"({followed.impacts}, {followed.order}) orbits"
    )
    what = f"{kind} with {followed.range}"
    lines: list[str | Table] = [what if followed.branches else f"No {what}"]
    for number, branch in enumerate(followed.branches):
        low, high = branch.parameter.min(), branch.parameter.max()
        ends = " and ".join(dict.fromkeys(_ENDS[end] for end in branch.ends))
        lines.append(f"  branch {number}: {len(branch.parameter)} points from {low:.6g} to {high:.6g}; ends at {ends}")
    if special:
        columns = [
            TableColumn("kind", lambda row: row["kind"].replace("_", " "), "", left=True),
            TableColumn(followed.range.path, "parameter", ".9g"),
            TableColumn("95 % interval", _interval, ""),
            TableColumn("peak\nnm", "peak_amplitude_nm", ".5g"),
            TableColumn("branch", lambda row: str(row["branch"]), ""),
            TableColumn("admissible", "admissible", "yes", left=True),
        ]
        lines.append(printed_table("Special points", columns, special))
    for curve in curves:
        ends = [f"({p:.5g}, {q:.5g})" for p, q in zip(curve["parameter"], curve["second"], strict=True)]
        lines.append(f"  curve of {curve['kind'].replace('_', ' ')} from {ends[0]} to {ends[-1]}")
        lines += [
            f"    {meeting['kind'].replace('_', ' ')} at ({meeting['parameter']:.6g}, {meeting['second']:.6g})"
            for meeting in curve["meetings"]
        ]
    return lines


def _interval(row: Mapping[str, Any]) -> str:
    return "{:.5g} to {:.5g}".format(*row["interval95"]) if "interval95" in row else ""
