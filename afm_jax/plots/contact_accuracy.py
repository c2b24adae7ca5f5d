"""The picture of the accuracy study of collisions: time of an impact against its achieved error."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from afm_jax.plots.picture_style import GRID, label_axes, new_figure

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
