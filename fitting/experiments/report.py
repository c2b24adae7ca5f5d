"""A design as a person reads it: text for the terminal, files to take to the instrument (JSON, CSV, PNG).

The picture shows errors against the number of points, and what each drive would add.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter
from matplotlib.transforms import ScaledTranslation

from afm_jax.plots.picture_style import ACCENT, BLUE, GRID, label_axes, new_figure
from afm_jax.whole_files import write_whole
from afm_jax.words import interval, known, value_alone
from fitting.experiments.candidates import LEFT_OUT
from fitting.experiments.prior import size_of
from fitting.experiments.result import Design, Forecast
from fitting.parameters import NUISANCE_NAMES
from fitting.report.sections import Bullets, Part, Report, ReportSection, Table, Text, text_of

_CANDIDATE_COLUMNS = ("chosen", "gain", "left_out")
_CRITERIA = {"D": "D-optimal: smallest joint confidence region of", "A": "A-optimal: smallest sum of variances of"}


def point_columns(result: Design) -> tuple[str, ...]:
    """Return the columns of design.csv: the drive, then what is expected."""
    read = (
        ("lockin_amplitude_{}nm", "phase_lag_{}deg")
        if result.tapping
        else ("peak_amplitude_{}nm", "lockin_amplitude_{}nm")
    )
    expected = [f"expected_{name.format(error)}" for name in read for error in ("", "error_")]
    return *_drive_columns(result), *expected, "expected_approach_speed_nm_per_us"


def _drive_columns(result: Design) -> tuple[str, ...]:
    return "order", "drive_frequency_khz", f"{'free' if result.tapping else 'drive'}_amplitude_nm", "offset_nm"


def design_summary(result: Design) -> str:
    """Return the design as text: verdict, the points, what they will determine, notes."""
    return text_of(design_report(result))


def design_report(result: Design) -> Report:
    """Return the design as sections: the points, what they will determine, the drives they were chosen from, notes."""
    prior, count = result.prior, int(result.candidates.usable.sum())
    left_out = [f"\n  {number} left out: {LEFT_OUT[name]}" for name, number in result.candidates.left_out.items()]
    planned = f"  {count} of {len(result.candidates.why_not)} drives can be planned with."
    forecast = [
        ReportSection("Points", _points(result), "Points"),
        ReportSection("Forecast", _forecast(result), "Forecast"),
    ]
    return Report(
        title=f"{len(result.chosen)} points to measure next, of {count} candidates "
        f"({prior.problem.model}, {prior.source})",
        about=[f"{_CRITERIA[result.criterion]} {', '.join(result.interest)}; {100.0 * result.noise:g} % noise"],
        valid=result.valid,
        verdict="VALID" if result.valid else "NOT VALID: do not follow this design.",
        reasons=result.reasons,
        sections=[
            *(forecast if len(result.chosen) else []),
            ReportSection("Candidates", [Text("".join([planned, *left_out]), "lines")], "Candidates"),
            *([ReportSection("Notes", [Bullets(result.warnings, "Notes:")], "Notes")] if result.warnings else []),
        ],
    )


def write_design(
    result: Design, folder: Path, write_table: Callable[[str, list[dict[str, Any]], tuple[str, ...]], None]
) -> list[Path]:
    """Write design.html, .txt, .json and .png, to_fill_in.csv, design.csv and candidates.csv into a folder.

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
    from fitting.report.files import write_with_picture  # noqa: PLC0415

    blank = folder / "to_fill_in.csv"
    report, figure = design_report(result), design_figure(result)
    shows = (
        "Expected errors over the number of points; what one more measurement at each drive adds, chosen ones circled."
    )
    written = write_with_picture(folder, "design", report, figure, shows, result.to_dict())
    write_whole(blank, table_to_fill_in(result))
    write_table("design.csv", result.points(), point_columns(result))
    write_table("candidates.csv", result.all_candidates(), (*point_columns(result), *_CANDIDATE_COLUMNS))
    return [*written, blank]


def table_to_fill_in(result: Design) -> str:
    """Return an amplitude table of the points, the measured columns empty."""
    prior, known = result.prior, result.prior.constraints
    lines = [f"# drive = {prior.problem.drive}"] if result.tapping else []
    if "free_frequency_khz" not in known:
        lines.append(f"# free_frequency_khz = {prior.free_frequency_khz!r}")
    if prior.mass_ng is not None:
        lines.append(f"# mass_ng = {prior.mass_ng!r}")
    if "quality_factor" not in known:
        lines.append(f"# quality_factor = {'none' if prior.quality_factor is None else repr(prior.quality_factor)}")
    instrument = [(name, *known[name]) for name in NUISANCE_NAMES if name in known]
    lines += [f"# {name} = {value!r} +- {error!r}" for name, value, error in instrument]
    read = [kind for kind in ("peak", "lockin") if result.settings["amplitudes"] in ("both", kind)]
    columns = [f"{kind}_amplitude_nm,{kind}_amplitude_error_nm" for kind in (["lockin"] if result.tapping else read)]
    columns += ["phase_lag_deg,phase_lag_error_deg"] if result.tapping else []
    drive = _drive_columns(result)
    lines.append(",".join([*drive, *columns]))
    cells = "," * (2 * len(columns))
    lines += [",".join(repr(point[name]) for name in drive) + cells for point in result.points()]
    return "\n".join(lines) + "\n"


def _points(result: Design) -> list[Part]:
    shown = result.interest[:4]
    read = ("lockin_amplitude_nm", "phase_lag_deg") if result.tapping else ("peak_amplitude_nm", "lockin_amplitude_nm")
    columns = ("lock-in nm", "lag deg") if result.tapping else ("peak nm", "lock-in nm")
    amplitude = _drive_columns(result)[2]
    head = ["N", "kHz", "free nm" if result.tapping else "nm", "offset", *columns, "u_in"]
    head += [f"+- {name}"[:15] for name in shown]
    rows = [
        [
            f"{point['order']}",
            f"{point['drive_frequency_khz']:.8g}",
            f"{point[amplitude]:.5g}",
            f"{point['offset_nm']:.4g}",
            *(_reading(point, name) for name in read),
            f"{point['expected_approach_speed_nm_per_us']:.1f}",
            *(known(point["standard_errors"][name], ".2g") for name in shown),
        ]
        for point in result.points()
    ]
    said = "  u_in in nm/us; +- columns: standard errors expected once this point and those above are measured"
    return [Table("What to measure next", head, rows, numbered=True), Text(said)]


def _forecast(result: Design) -> list[Part]:
    head = ["", "prior", "+- now", "+- then", "95 % interval then"]
    now, then = result.measured_so_far, result.expected
    rows = [
        [
            f"{'*' if name in result.interest else ' '} {name}",
            value_alone(then[name].value, then[name].standard_error, unknown=".6g"),
            known(now[name].standard_error, ".2g"),
            known(then[name].standard_error, ".2g"),
            _interval(then[name]),
        ]
        for name in result.prior.problem.names
    ]
    caption = "Standard errors before and after the points are measured"
    return [Table(caption, head, rows, words=head[-1:]), Text("  * what the points are chosen for")]


def _reading(point: dict[str, Any], name: str) -> str:
    value, (what, unit) = point.get(f"expected_{name}"), name.rsplit("_", 1)
    if value is None:
        return "-"
    digits = 1 if value >= 100.0 and unit == "nm" else 2
    return f"{value:.{digits}f} +- {point[f'expected_{what}_error_{unit}']:.{digits}f}"


def _interval(forecast: Forecast) -> str:
    low, high = forecast.interval95
    return "none" if low is None or high is None else f"{interval(low, high)} {forecast.unit}".rstrip()


_COLOURS = (ACCENT, BLUE, "#009E73", "#CC79A7", "#D55E00", "#56B4E9")
_MAP = "viridis_r"
_INVALID = "#B00020"
_SMALL = 9
_MOST_ORDERS = 6
_DASHES = ("--", ":", "-.")
_MARKS = ("o-", "s--", "D-.", "^:")
_OFFSET_POINTS = 5.5
"""Between the marks of two offsets at one drive."""
_UNKNOWN_PERCENT = 2e3
_FEW_DECADES = 100.0
"""Up to there an axis has room for the labels between its decades."""


def design_figure(result: Design) -> Figure:
    """Return the figure: forecast errors on the left, on the right a map of the gain for each of the first six orders.

    Of a cantilever that is driven itself, for each frequency.
    """
    drives = result.candidates.drives
    each = drives.frequency_khz if result.tapping else drives.order
    orders = np.unique(each)[:_MOST_ORDERS]
    figure = new_figure(12.0, 5.6)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(1.0, 1.4)), dtype=object)
    _draw_errors(left.subplots(), result)
    rows = 1 if len(orders) == 1 else 2
    panels = right.subplots(rows, -(-len(orders) // rows), squeeze=False).ravel()
    gain = result.gain[np.isfinite(result.gain)]
    # a few points are worth much more than all others: the root of a root of the gain tells those apart too
    scale = PowerNorm(0.3, 0.0, float(gain.max()) if gain.size and gain.max() > 0.0 else 1.0)
    for axes, order in zip(panels, orders, strict=False):
        _draw_map(axes, result, each == order, scale)
        axes.set_title(f"{order:g} kHz" if result.tapping else f"order {order}", fontsize=_SMALL)
    for axes in panels[len(orders) :]:
        axes.set_axis_off()
    right.colorbar(ScalarMappable(scale, _MAP), ax=list(panels), shrink=0.8).set_label("gain of one more measurement")
    if not result.tapping:
        offsets = ", ".join(f"{offset:g}" for offset in np.unique(drives.offset_nm))
        right.supxlabel(f"at each drive from left to right: offsets {offsets} nm", fontsize=_SMALL)
    title = f"{len(result.chosen)} points for {', '.join(result.interest)} ({result.prior.problem.model})"
    figure.suptitle(title if result.valid else f"NOT VALID: {title}", color="black" if result.valid else _INVALID)
    return figure


def _draw_errors(axes: Axes, result: Design) -> None:
    """Draw every parameter's standard error, relative to its size, against the number of points."""
    count = np.arange(len(result.errors))
    colours, dashes = iter(_COLOURS * len(result.interest)), iter(_DASHES * len(result.errors.T))
    marks = iter(_MARKS * len(result.interest))
    for parameter, value, errors in zip(
        result.prior.problem.parameters, result.prior.values.tolist(), result.errors.T, strict=True
    ):
        share = 100.0 * np.where(np.isfinite(errors), errors, np.nan) / size_of(parameter, value)
        if not np.isfinite(share).any():
            continue
        label = "1 - r" if parameter.name == "r" else parameter.name
        if parameter.name in result.interest:
            axes.plot(count, share, next(marks), color=next(colours), lw=2.0, ms=5, label=label, zorder=3)
        else:
            axes.plot(count, share, linestyle=next(dashes), marker=".", color=GRID, lw=1.2, label=label)
    axes.set_yscale("log")
    # beyond that a parameter is as good as unknown
    axes.set_ylim(top=min(axes.get_ylim()[1], _UNKNOWN_PERCENT))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    low, high = axes.get_ylim()
    axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}") if high < _FEW_DECADES * low else NullFormatter())
    axes.grid(color=GRID, alpha=0.25, which="both")
    label_axes(axes, x="points measured", y="expected standard error (%)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=_SMALL, loc="best")


def _draw_map(axes: Axes, result: Design, here: Bool[np.ndarray, " rows"], scale: Normalize) -> None:
    """Draw the gain over frequency and drive amplitude, the offsets side by side, with the chosen points.

    Of a cantilever that is driven itself over height and free amplitude.
    """
    drives, usable = result.candidates.drives, result.candidates.usable
    across = drives.offset_nm if result.tapping else drives.frequency_khz
    beside = np.zeros(len(here)) if result.tapping else drives.offset_nm
    offsets = np.unique(beside)
    for number, offset in enumerate(offsets):
        shift = (number - 0.5 * (len(offsets) - 1)) * _OFFSET_POINTS
        moved = axes.transData + ScaledTranslation(shift / 72.0, 0.0, axes.figure.dpi_scale_trans)
        some = here & (beside == offset)
        lost, rows = np.flatnonzero(some & ~usable), np.flatnonzero(some & usable)
        axes.plot(across[lost], drives.amplitude_nm[lost], "x", color=GRID, ms=3, transform=moved)
        places = across[rows], drives.amplitude_nm[rows]
        marks = {"cmap": _MAP, "norm": scale, "s": 22, "marker": "s", "linewidths": 0, "transform": moved}
        axes.scatter(*places, c=result.gain[rows], **marks)
        for place, row in enumerate(result.chosen.tolist(), start=1):
            if some[row]:
                point = across[row], drives.amplitude_nm[row]
                axes.plot(*point, "o", ms=9, mfc="none", mec=ACCENT, mew=1.3, transform=moved)
                middle = (shift, 6 if place % 2 else -6)
                style = {"fontsize": 8, "color": ACCENT, "ha": "center", "va": "bottom" if place % 2 else "top"}
                axes.annotate(str(place), point, middle, textcoords="offset points", **style)
    axes.margins(0.1, 0.15)
    axes.update_datalim(np.stack([across[here], drives.amplitude_nm[here]], axis=1))
    axes.autoscale_view()
    tapping = result.tapping
    label_axes(
        axes, x="height of the sample (nm)" if tapping else "drive (kHz)", y="free (nm)" if tapping else "drive (nm)"
    )
    axes.xaxis.label.set_fontsize(_SMALL)
    axes.yaxis.label.set_fontsize(_SMALL)
    axes.tick_params(labelsize=8)
    axes.xaxis.set_major_locator(MaxNLocator(5))
