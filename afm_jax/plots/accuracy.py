"""Pictures of accuracy studies: the time of an impact, of a collision or of a scene against its achieved error.

Both axes are logarithmic, one line a method and one point a setting. An error of 0 has no place there.
"""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure

Row = Mapping[str, Any]

_SMALLEST = 1e-17
"""Errors up to this are 0 but for rounding."""


def accuracy_figure(rows: Sequence[Row], wanted_error_us: float) -> Figure:
    """Return the errors of impact times: one panel a scene; numbers beside points are tolerances in us.

    Args:
        rows: of `afm_jax.accuracy.impacts.map_accuracy`.
        wanted_error_us: marked by a line.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = new_figure(4.4 * len(scenes), 4.6)
    panels = figure.subplots(1, len(scenes), sharey=True, squeeze=False)[0]
    for axes, scene in zip(panels, scenes, strict=True):
        for method, (colour, marker) in _IMPACTS.items():
            chosen = [row for row in rows if (row["scene"], row["method"]) == (scene, method) and row["error_us"]]
            places = _places(chosen, "error_us", "microseconds_per_impact")
            axes.plot(*_columns(places), marker=marker, ms=5, color=colour, lw=1.0, label=method)
            _name_tolerances(axes, chosen, places, colour)
        axes.axvline(wanted_error_us, color="0.5", ls=":", lw=1.2, label=f"wanted: {wanted_error_us:g} µs")
        axes.set_title(f"scene: {scene}")
        time = "time per impact (µs, one core)" if axes is panels[0] else ""
        _logarithmic(axes, x="largest error of an impact time (µs)", y=time)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


# Okabe and Ito's colours here and below, distinguishable with every kind of colour vision.
_IMPACTS = {
    "next_impact float64": ("#0072B2", "o"),
    "next_impact float32": ("#E69F00", "s"),
    "SciPy DOP853": ("#D55E00", "^"),
}


def _name_tolerances(axes: Axes, rows: Sequence[Row], places: Sequence[tuple[float, float]], colour: str) -> None:
    """Write the tolerance beside a point unless the last one named lies too close to it."""
    named = float("inf")
    for row, place in zip(rows, places, strict=True):
        if named / place[0] >= 30.0:
            named = place[0]
            _name(axes, f"{row['tolerance']:g}", place, colour, fontsize=7, ha="left", rotation=25)


def collide_accuracy_figure(rows: Sequence[Row]) -> Figure:
    """Return the errors of collisions: a panel for each kind of error, a line for each method, variable and precision.

    Errors above 1 (all of the rebound speed, a microsecond) are left out: no more than that they are wrong is known.
    """
    figure = new_figure(15.0, 5.8)
    panels = figure.subplots(1, len(_ERRORS), sharey=True)
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["variable"], row["precision"]), []).append(row)
    for axes, (column, label) in zip(panels, _ERRORS.items(), strict=True):
        for (method, variable, precision), chosen in groups.items():
            shown = [row for row in chosen if 0.0 < (row.get(column) or 0.0) <= 1.0]
            own = method.startswith("collide")
            style = ":" if variable == "time" else "--" if "fixed" in method else "-"
            places = _places(shown, column, "microseconds_per_impact")
            if places:
                axes.plot(
                    *_columns(places),
                    style,
                    marker="s" if precision == "float32" else "o",
                    markersize=7 if own else 4,
                    linewidth=2.0 if own else 1.2,
                    color=_COLLISIONS[method] if own else _COLLISIONS[method.split(",")[0]],
                    alpha=0.5 if precision == "float32" else 1.0,
                    label=f"{method}, in {'time' if variable == 'time' else 'the gap'}"
                    + (", float32" if precision == "float32" else ""),
                )
        axes.invert_xaxis()
        _logarithmic(axes, x=label, y="time of an impact (µs), one core" if axes is panels[0] else "")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", fontsize=9)
    return figure


_COLLISIONS = {
    "collide, diffrax": "#0072B2",
    "collide, collocation": "#009E73",
    "Tsit5": "#E69F00",
    "Dopri5": "#CC79A7",
    "Dopri8": "#000000",
    "Kvaerno5": "#999999",
    "SciPy DOP853": "#D55E00",
    "SciPy LSODA": "#8B3A00",
}
_ERRORS = {
    "rebound_error": "largest relative error of the rebound speed",
    "delay_error_us": "largest error of the delay (µs)",
    "slope_error": "largest relative error of its derivatives",
}


def scene_accuracy_figure(result: Mapping[str, Any]) -> Figure:
    """Return the errors of a scene: of the last arrival and of the peak for every setting, and the fidelity ladder.

    Args:
        result: of `contact_accuracy` or `law_accuracy`, with the `ladder` and `model_reference` of `fidelity_ladder`.
    """
    figure = new_figure(16.0, 5.4)
    first, second, third = figure.subplots(1, 3)
    contacts, rows = result["contacts"], result["rows"]
    for axes, column, own in (
        (first, "arrival_error_us", result["reference_error_us"]),
        (second, "peak_error_nm", result["reference_error_nm"]),
    ):
        for way in dict.fromkeys(row["way"] for row in rows):
            colour, marker = _WAYS[way]
            chosen = [row for row in rows if row["way"] == way and (row.get(column) or 0.0) > _SMALLEST]
            places = _places(chosen, column, "microseconds_per_contact")
            axes.plot(*_columns(places), marker, color=colour, label=way if places else None)
            _name_in_turns(axes, [row["setting"] for row in chosen], places, colour)
        _mark_reference(axes, own or 0.0)
        axes.margins(0.25)
    time = "time of a contact (us), one core, one tip"
    _logarithmic(first, x=f"error of the arrival of contact {contacts} (us)", y=time)
    _logarithmic(second, x="error of the largest height (nm)", y="")
    _ladder(third, result["ladder"])
    reference = f"error of the amplitude against the {result['model_reference']}\n(relative)"
    _logarithmic(third, x=reference, y="time (s)")
    figure.legend(*first.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


_WAYS = {"quick": (BLUE, "o"), "careful": (ACCENT, "s"), "map": (BLUE, "o")}


def _ladder(axes: Axes, ladder: Sequence[Row]) -> None:
    """Draw ever simpler models; the time of the last one, which is taken for true, is a line."""
    simpler = [row for row in ladder if (row.get("model_error") or 0.0) > _SMALLEST]
    places = _places(simpler, "model_error", "seconds")
    for row, place in zip(simpler, places, strict=True):
        axes.plot(*place, "D", color=BLUE if "delay" in row["model"] else ACCENT)
    _name_in_turns(axes, [row["model"] for row in simpler], places, DARK)
    true = ladder[-1]
    if true["seconds"] is not None:
        axes.axhline(true["seconds"], color=DARK, linestyle=":", linewidth=1.2)
        axes.text(0.02, true["seconds"], true["model"], transform=axes.get_yaxis_transform(), va="bottom", fontsize=9)
    axes.margins(0.35)


def overview_figure(rows: Sequence[Row], references: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Return what each digit costs: a panel a problem, error to the left smaller; our own methods are drawn thick.

    Args:
        rows: as `afm_jax.accuracy.overview` returns them.
        references: likewise; the error of a reference is a dotted line.
    """
    figure = new_figure(16.0, 11.0)
    panels = figure.subplots(2, -(-len(references) // 2), squeeze=False).ravel()
    for axes, (problem, told) in zip(panels, references.items(), strict=False):
        _overview_panel(axes, [row for row in rows if row["problem"] == problem])
        _mark_reference(axes, told["reference_error"])
        axes.set_title(problem)
        error = textwrap.fill(f"error of the {told['error_of'].replace('(us)', '(µs)')}", 48)
        _logarithmic(axes, x=error, y="time (µs), one core")
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2, frameon=False)
    for axes in panels[len(references) :]:
        axes.set_visible(False)
    return figure


def _overview_panel(axes: Axes, rows: Sequence[Row]) -> None:
    own = iter(_OWN)
    for method in dict.fromkeys(row["method"] for row in rows):
        # an error of 1 or more is no more than wrong; one of 0 is below rounding
        chosen = [
            row | {"error": max(row["error"], _SMALLEST)}
            for row in map(dict, rows)
            if row["method"] == method and row["error"] is not None and row["error"] < 1.0
        ]
        if not chosen:
            continue
        rival = next((style for name, style in _RIVALS.items() if method.startswith(name)), (DARK, "x"))
        colour, marker = next(own, _OWN[-1]) if chosen[0]["own"] else rival
        width, size = (2.2, 7) if chosen[0]["own"] else (1.1, 4)
        places = sorted(_places(chosen, "error", "microseconds"))
        axes.plot(*_columns(places), color=colour, marker=marker, lw=width, ms=size, label=method)


_RIVALS = {
    "SciPy DOP853": ("#D55E00", "^"),
    "SciPy LSODA": ("#CC79A7", "v"),
    "SciPy Radau": ("#8B3A00", "<"),
    "SUNDIALS CVODE Adams": ("#E69F00", ">"),
    "Diffrax": ("#000000", "s"),
    "SciPy least_squares, our": ("#D55E00", "^"),
    "SciPy least_squares, diff": ("#CC79A7", "v"),
}
_OWN = (("#0072B2", "o"), ("#009E73", "D"), ("#56B4E9", "o"))


def _places(rows: Iterable[Row], error: str, time: str) -> list[tuple[float, float]]:
    return [(row[error], row[time]) for row in rows]


def _columns(places: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [error for error, _ in places], [time for _, time in places]


def _logarithmic(axes: Axes, *, x: str, y: str) -> None:
    axes.set(xscale="log", yscale="log")
    axes.grid(color=GRID, alpha=0.25)
    label_axes(axes, x=x, y=y)


def _mark_reference(axes: Axes, error: float) -> None:
    if error > _SMALLEST:
        axes.axvline(error, color=DARK, linestyle=":", linewidth=1.2, label="error of the reference")


def _name_in_turns(axes: Axes, names: Sequence[str], places: Sequence[tuple[float, float]], colour: str) -> None:
    """Write names above and below points, in turns."""
    for number, (name, place) in enumerate(zip(names, places, strict=True)):
        _name(axes, name, place, colour, fontsize=8, ha="center", below=number % 2 == 1)


def _name(axes: Axes, text: str, place: tuple[float, float], colour: str, *, below: bool = False, **style: Any) -> None:
    offset, side = ((0, -8), "top") if below else ((0, 8), "bottom")
    axes.annotate(text, place, xytext=offset, textcoords="offset points", va=side, color=colour, **style)
