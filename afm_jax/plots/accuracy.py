"""The picture of an accuracy study: time of an impact against its achieved error."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Okabe and Ito's colours, distinguishable with every kind of colour vision.
_STYLES = {
    "next_impact float64": ("#0072B2", "o"),
    "next_impact float32": ("#E69F00", "s"),
    "SciPy DOP853": ("#D55E00", "^"),
}


def accuracy_figure(rows: Sequence[Mapping[str, Any]], wanted_error_us: float) -> Figure:
    """Return the figure: one panel a scene, both axes logarithmic; numbers beside points are tolerances in us.

    Args:
        rows: of `afm_jax.study.accuracy.map_accuracy`.
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
