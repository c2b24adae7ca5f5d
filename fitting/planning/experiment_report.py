"""A design as a person reads it: text for the terminal, files to take to the instrument (JSON, CSV, PNG)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from afm_jax.words import bullets, interval, known, text_table, value_alone
from fitting.models import NUISANCE_NAMES
from fitting.planning.experiment_candidates import LEFT_OUT
from fitting.planning.experiment_result import Design, Forecast

POINT_COLUMNS = (
    "order",
    "drive_frequency_khz",
    "drive_amplitude_nm",
    "offset_nm",
    "expected_peak_amplitude_nm",
    "expected_peak_amplitude_error_nm",
    "expected_lockin_amplitude_nm",
    "expected_lockin_amplitude_error_nm",
    "expected_approach_speed_nm_per_us",
)
CANDIDATE_COLUMNS = (*POINT_COLUMNS, "chosen", "gain", "left_out")
_CRITERIA = {"D": "D-optimal: smallest joint confidence region of", "A": "A-optimal: smallest sum of variances of"}
Table = Callable[[str, list[dict[str, Any]], tuple[str, ...]], None]


def design_summary(result: Design) -> str:
    """Return the design as text: verdict, the points, what they will determine, notes."""
    belief, count = result.belief, int(result.candidates.usable.sum())
    lines = [
        f"{len(result.chosen)} points to measure next, of {count} candidates ({belief.problem.model}, {belief.source})",
        f"  {_CRITERIA[result.criterion]} {', '.join(result.interest)}; {100.0 * result.noise:g} % noise",
        "",
        "VALID" if result.valid else "NOT VALID: do not follow this design.",
        *(f"  - {reason}" for reason in result.reasons),
    ]
    if len(result.chosen):
        lines += ["", *_point_lines(result), "", *_forecast_lines(result)]
    left_out = [f"  {number} left out: {LEFT_OUT[name]}" for name, number in result.candidates.left_out.items()]
    lines += ["", f"  {count} of {len(result.candidates.why_not)} drives can be planned with.", *left_out]
    lines += bullets("Notes:", result.warnings)
    return "\n".join(lines)


def write_design(result: Design, folder: Path, write_table: Table) -> list[Path]:
    """Write design.txt, design.json, design.png, to_fill_in.csv, design.csv and candidates.csv into a folder.

    to_fill_in.csv is an amplitude table of the points whose measured columns are empty: with the readings in them,
    `afm-jax fit` takes it.

    Args:
        result: the design.
        folder: an existing folder; files of these names are replaced.
        write_table: called with a file name, records and columns for design.csv and candidates.csv.

    Returns:
        The files written here (the tables are `write_table`'s).

    Raises:
        OSError: if a file cannot be written.
    """
    from afm_jax.plots.picture_style import png_of  # noqa: PLC0415
    from fitting.planning.experiment_plot import design_figure  # noqa: PLC0415
    from fitting.reporting.report import write_report_files  # noqa: PLC0415

    blank = folder / "to_fill_in.csv"
    text, data, picture = design_summary(result), result.to_dict(), png_of(design_figure(result))
    written = write_report_files(folder, "design", text=text, data=data, picture=picture)
    blank.write_text(table_to_fill_in(result), encoding="utf-8", newline="\n")
    write_table("design.csv", result.points(), POINT_COLUMNS)
    write_table("candidates.csv", result.all_candidates(), CANDIDATE_COLUMNS)
    return [*written, blank]


def table_to_fill_in(result: Design) -> str:
    """Return an amplitude table of the points, the measured columns empty."""
    belief, known = result.belief, result.belief.constraints
    lines = [f"# free_frequency_khz = {belief.free_frequency_khz!r}", f"# mass_ng = {belief.mass_ng!r}"]
    if belief.quality_factor is not None and "quality_factor" not in known:
        lines.append(f"# quality_factor = {belief.quality_factor!r}")
    instrument = [(name, *known[name]) for name in NUISANCE_NAMES if name in known]
    lines += [f"# {name} = {value!r} +- {error!r}" for name, value, error in instrument]
    read = [kind for kind in ("peak", "lockin") if result.settings["amplitudes"] in ("both", kind)]
    columns = [f"{kind}_amplitude_nm,{kind}_amplitude_error_nm" for kind in read]
    lines.append(",".join([*POINT_COLUMNS[:4], *columns]))
    cells = "," * (2 * len(read))
    lines += [",".join(repr(point[name]) for name in POINT_COLUMNS[:4]) + cells for point in result.points()]
    return "\n".join(lines) + "\n"


def _point_lines(result: Design) -> list[str]:
    shown = result.interest[:4]
    head = ["N", "kHz", "nm", "offset", "peak nm", "lock-in nm", "u_in", *(f"+- {name}"[:15] for name in shown)]
    rows = [
        [
            f"{point['order']}",
            f"{point['drive_frequency_khz']:.8g}",
            f"{point['drive_amplitude_nm']:.5g}",
            f"{point['offset_nm']:.4g}",
            _reading(point, "peak"),
            _reading(point, "lockin"),
            f"{point['expected_approach_speed_nm_per_us']:.1f}",
            *(known(point["standard_errors"][name], ".2g") for name in shown),
        ]
        for point in result.points()
    ]
    return [
        *text_table(head, rows, words=()),
        "  u_in in nm/us; +- columns: standard errors expected once this point and those above are measured",
    ]


def _forecast_lines(result: Design) -> list[str]:
    head = ["", "believed", "+- now", "+- then", "95 % interval then"]
    now, then = result.measured_so_far, result.expected
    rows = [
        [
            f"{'*' if name in result.interest else ' '} {name}",
            value_alone(then[name].value, then[name].standard_error, unknown=".6g"),
            known(now[name].standard_error, ".2g"),
            known(then[name].standard_error, ".2g"),
            _interval(then[name]),
        ]
        for name in result.belief.problem.names
    ]
    return [*text_table(head, rows, words=(0, 4)), "  * what the points are chosen for"]


def _reading(point: dict[str, Any], kind: str) -> str:
    value = point.get(f"expected_{kind}_amplitude_nm")
    if value is None:
        return "-"
    return f"{value:.1f} +- {point[f'expected_{kind}_amplitude_error_nm']:.1f}"


def _interval(forecast: Forecast) -> str:
    low, high = forecast.interval95
    return "none" if low is None or high is None else f"{interval(low, high)} {forecast.unit}".rstrip()
