"""Pictures of accuracy studies: the time of an impact, of a collision or of a scene against its achieved error."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure

# Okabe and Ito's colours, distinguishable with every kind of colour vision.
_STYLES = {
    "next_impact float64": ("#0072B2", "o"),
    "next_impact float32": ("#E69F00", "s"),
    "SciPy DOP853": ("#D55E00", "^"),
}


def accuracy_figure(rows: Sequence[Mapping[str, Any]], wanted_error_us: float) -> Figure:
    """Return the figure: one panel a scene, both axes logarithmic; numbers beside points are tolerances in us.

    Args:
        rows: of `afm_jax.accuracy.impacts.map_accuracy`.
        wanted_error_us: marked by a line.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(4.4 * len(scenes), 4.6), layout="constrained")
    panels = figure.subplots(1, len(scenes), sharey=True, squeeze=False)[0]
    for axes, scene in zip(panels, scenes, strict=True):
        _draw_scene(axes, [row for row in rows if row["scene"] == scene])
        axes.axvline(wanted_error_us, color="0.5", ls=":", lw=1.2, label=f"wanted: {wanted_error_us:g} µs")
        axes.set_title(f"scene: {scene}")
        axes.set_xlabel("largest error of an impact time (µs)")
    panels[0].set_ylabel("time per impact (µs, one core)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _draw_scene(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for method, (colour, marker) in _STYLES.items():
        points = [row for row in rows if row["method"] == method and row["error_us"]]
        errors = [row["error_us"] for row in points]
        times = [row["microseconds_per_impact"] for row in points]
        axes.plot(errors, times, marker=marker, ms=5, color=colour, lw=1.0, label=method)
        _name_tolerances(axes, points, colour)
    axes.grid(which="major", alpha=0.3)


def _name_tolerances(axes: Axes, points: Sequence[Mapping[str, Any]], colour: str) -> None:
    """Write the tolerance beside a point unless the last one named lies too close to it."""
    named = float("inf")
    for row in points:
        if named / row["error_us"] < 30.0:
            continue
        named = row["error_us"]
        axes.annotate(
            f"{row['tolerance']:g}",
            (row["error_us"], row["microseconds_per_impact"]),
            xytext=(0, 6),
            textcoords="offset points",
            fontsize=7,
            color=colour,
            ha="left",
            rotation=25,
        )


# Okabe and Ito's colours, distinguishable with every kind of colour vision.
_COLOURS = {
    "collide, diffrax": "#0072B2",
    "collide, collocation": "#009E73",
    "Tsit5": "#E69F00",
    "Dopri5": "#CC79A7",
    "Dopri8": "#000000",
    "Kvaerno5": "#999999",
    "SciPy DOP853": "#D55E00",
    "SciPy LSODA": "#8B3A00",
}
_VARIABLES = {"gap": "the gap", "time": "time"}
_ERRORS = {
    "rebound_error": "largest relative error of the rebound speed",
    "delay_error_us": "largest error of the delay (µs)",
    "slope_error": "largest relative error of its derivatives",
}


def collide_accuracy_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Return the figure: a panel for each kind of error, a line for each method, variable and precision.

    Errors above 1 (all of the rebound speed, a microsecond) are left out: no more than that they are wrong is known.
    """
    figure = new_figure(15.0, 5.8)
    panels = figure.subplots(1, len(_ERRORS), sharey=True)
    groups = dict.fromkeys((row["method"], row["variable"], row["precision"]) for row in rows)
    for axes, (column, label) in zip(panels, _ERRORS.items(), strict=True):
        for method, variable, precision in groups:
            chosen = [
                row
                for row in rows
                if (row["method"], row["variable"], row["precision"]) == (method, variable, precision)
            ]
            points = [
                (row[column], row["microseconds_per_impact"]) for row in chosen if 0.0 < (row.get(column) or 0.0) <= 1.0
            ]
            if not points:
                continue
            colour = _COLOURS[method] if method in _COLOURS else _COLOURS[method.split(",")[0]]
            own = method.startswith("collide")
            style = ":" if variable == "time" else "--" if "fixed" in method else "-"
            axes.plot(
                *zip(*points, strict=True),
                style,
                marker="s" if precision == "float32" else "o",
                markersize=7 if own else 4,
                linewidth=2.0 if own else 1.2,
                color=colour,
                alpha=0.5 if precision == "float32" else 1.0,
                label=f"{method}, in {_VARIABLES[variable]}" + (", float32" if precision == "float32" else ""),
            )
        axes.set(xscale="log", yscale="log")
        axes.invert_xaxis()
        axes.grid(color=GRID, alpha=0.25)
        label_axes(axes, x=label, y="time of an impact (µs), one core" if axes is panels[0] else "")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=9)
    return figure


_WAYS = {"quick": (BLUE, "o"), "careful": (ACCENT, "s"), "map": (BLUE, "o")}
_SMALLEST = 1e-17
"""Errors of exactly 0 have no place on a logarithmic axis; they are left out."""


def scene_accuracy_figure(result: Mapping[str, Any]) -> Figure:
    """Return the figure: errors of the last arrival and of the peak for every setting, and the fidelity ladder.

    Args:
        result: of `contact_accuracy` or `law_accuracy`, with the `ladder` and `model_reference` of `fidelity_ladder`.
    """
    figure = new_figure(16.0, 5.4)
    first, second, third = figure.subplots(1, 3)
    contacts, rows = result["contacts"], result["rows"]
    _settings(first, rows, "arrival_error_us", result["reference_error_us"])
    label_axes(
        first, x=f"error of the arrival of contact {contacts} (us)", y="time of a contact (us), one core, one tip"
    )
    _settings(second, rows, "peak_error_nm", result["reference_error_nm"])
    label_axes(second, x="error of the largest height (nm)", y="")
    _ladder(third, result["ladder"])
    label_axes(third, x=f"error of the amplitude against the {result['model_reference']}\n(relative)", y="time (s)")
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _settings(axes: Axes, rows: Sequence[Mapping[str, Any]], column: str, own: float | None) -> None:
    axes.set(xscale="log", yscale="log")
    for way in dict.fromkeys(row["way"] for row in rows):
        points = [row for row in rows if row["way"] == way and (row.get(column) or 0.0) > _SMALLEST]
        colour, marker = _WAYS[way]
        at = [(row[column], row["microseconds_per_contact"]) for row in points]
        if at:
            axes.plot(*zip(*at, strict=True), marker, color=colour, label=way)
        for number, (row, place) in enumerate(zip(points, at, strict=True)):
            _name(axes, row["setting"], place, colour, above=number % 2 == 0)
    if own:
        axes.axvline(own, color=DARK, linestyle=":", linewidth=1.2, label="error of the reference")
    axes.margins(0.25)
    axes.grid(color=GRID, alpha=0.25)


def _ladder(axes: Axes, ladder: Sequence[Mapping[str, Any]]) -> None:
    axes.set(xscale="log", yscale="log")
    known = [row for row in ladder if (row.get("model_error") or 0.0) > _SMALLEST]
    for number, row in enumerate(known):
        place = (row["model_error"], row["seconds"])
        axes.plot(*place, "D", color=BLUE if "delay" in row["model"] else ACCENT)
        _name(axes, row["model"], place, DARK, above=number % 2 == 0)
    true = ladder[-1]
    if true["seconds"] is not None:
        axes.axhline(true["seconds"], color=DARK, linestyle=":", linewidth=1.2)
        axes.text(0.02, true["seconds"], true["model"], transform=axes.get_yaxis_transform(), va="bottom", fontsize=9)
    axes.margins(0.35)
    axes.grid(color=GRID, alpha=0.25)


def _name(axes: Axes, text: str, place: tuple[float, float], colour: str, *, above: bool) -> None:
    axes.annotate(
        text,
        place,
        xytext=(0, 8 if above else -8),
        textcoords="offset points",
        ha="center",
        va="bottom" if above else "top",
        fontsize=8,
        color=colour,
    )


_OVERVIEW = {
    "SciPy DOP853": ("#D55E00", "^"),
    "SciPy LSODA": ("#CC79A7", "v"),
    "SciPy Radau": ("#8B3A00", "<"),
    "SUNDIALS CVODE Adams": ("#E69F00", ">"),
    "Diffrax": ("#000000", "s"),
    "SciPy least_squares, our": ("#D55E00", "^"),
    "SciPy least_squares, diff": ("#CC79A7", "v"),
}
_OWN = (("#0072B2", "o"), ("#009E73", "D"), ("#56B4E9", "o"))


def overview_figure(rows: Sequence[Mapping[str, Any]], references: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Return the figure: a panel a problem, error to the left smaller; our own methods are drawn thick.

    Args:
        rows: as `afm_jax.accuracy.overview` returns them.
        references: likewise; the error of a reference is a dotted line.
    """
    figure = new_figure(16.0, 11.0)
    panels = figure.subplots(2, -(-len(references) // 2), squeeze=False).ravel()
    for axes, (problem, told) in zip(panels, references.items(), strict=False):
        _overview_panel(axes, [row for row in rows if row["problem"] == problem])
        if told["reference_error"] > _SMALLEST:
            axes.axvline(
                told["reference_error"], color=DARK, linestyle=":", linewidth=1.2, label="error of the reference"
            )
        axes.set_title(problem)
        label_axes(
            axes,
            x=textwrap.fill(f"error of the {told['error_of'].replace('(us)', '(µs)')}", 48),
            y="time (µs), one core",
        )
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2, frameon=False)
    for axes in panels[len(references) :]:
        axes.set_visible(False)
    return figure


def _overview_panel(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    axes.set(xscale="log", yscale="log")
    own = iter(_OWN)
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        # an error of 1 or more is no more than wrong; one of 0 is below rounding
        points = [
            (max(row["error"], _SMALLEST), row["microseconds"])
            for row in mine
            if row["error"] is not None and row["error"] < 1.0
        ]
        if not points:
            continue
        is_own = bool(mine[0]["own"])
        colour, marker = (
            next(own, _OWN[-1])
            if is_own
            else next((style for name, style in _OVERVIEW.items() if method.startswith(name)), (DARK, "x"))
        )
        width, size = (2.2, 7) if is_own else (1.1, 4)
        axes.plot(*zip(*sorted(points), strict=True), color=colour, marker=marker, lw=width, ms=size, label=method)
    axes.grid(color=GRID, alpha=0.25)
