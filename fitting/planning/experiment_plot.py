"""The picture of a design: errors against the number of points, and what each drive would add."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from afm_jax.plots.picture_style import ACCENT, BLUE, GRID, label_axes, new_figure
from fitting.planning.experiment_belief import size_of
from fitting.planning.experiment_result import Design

_COLOURS = (ACCENT, BLUE, "#009E73", "#CC79A7", "#D55E00", "#56B4E9")
_MAP = "viridis_r"
_INVALID = "#B00020"
_SMALL = 9
_MOST_ORDERS = 6
_DASHES = ("--", ":", "-.")
_UNKNOWN_PERCENT = 2e3


def design_figure(result: Design) -> Figure:
    """Return the figure: forecast errors on the left, a map of the gain per order (the first six) on the right."""
    orders = np.unique(result.candidates.drives.order)[:_MOST_ORDERS]
    figure = new_figure(12.0, 5.6)
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(1.0, 1.4)), dtype=object)
    _draw_errors(left.subplots(), result)
    rows = 1 if len(orders) == 1 else 2
    panels = right.subplots(rows, -(-len(orders) // rows), squeeze=False).ravel()
    gain = result.gain[np.isfinite(result.gain)]
    scale = Normalize(0.0, float(gain.max()) if gain.size and gain.max() > 0.0 else 1.0)
    for axes, order in zip(panels, orders, strict=False):
        _draw_map(axes, result, int(order), scale)
    for axes in panels[len(orders) :]:
        axes.set_axis_off()
    right.colorbar(ScalarMappable(scale, _MAP), ax=list(panels), shrink=0.8).set_label("gain of one more measurement")
    title = f"{len(result.chosen)} points for {', '.join(result.interest)} ({result.belief.problem.model})"
    figure.suptitle(title if result.valid else f"NOT VALID: {title}", color="black" if result.valid else _INVALID)
    return figure


def _draw_errors(axes: Axes, result: Design) -> None:
    """Draw every parameter's standard error, relative to its size, against the number of points."""
    count = np.arange(len(result.errors))
    colours, dashes = iter(_COLOURS * len(result.interest)), iter(_DASHES * len(result.errors.T))
    for parameter, value, errors in zip(
        result.belief.problem.parameters, result.belief.values.tolist(), result.errors.T, strict=True
    ):
        share = 100.0 * np.where(np.isfinite(errors), errors, np.nan) / size_of(parameter, value)
        if not np.isfinite(share).any():
            continue
        label = "1 - r" if parameter.name == "r" else parameter.name
        if parameter.name in result.interest:
            axes.plot(count, share, "o-", color=next(colours), lw=2.0, ms=5, label=label, zorder=3)
        else:
            axes.plot(count, share, linestyle=next(dashes), marker=".", color=GRID, lw=1.2, label=label)
    axes.set_yscale("log")
    # beyond that a parameter is as good as unknown
    axes.set_ylim(top=min(axes.get_ylim()[1], _UNKNOWN_PERCENT))
    axes.grid(color=GRID, alpha=0.25)
    label_axes(axes, x="points measured", y="expected standard error (%)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=_SMALL, loc="best")


def _draw_map(axes: Axes, result: Design, order: int, scale: Normalize) -> None:
    """Draw the gain over frequency and drive amplitude, the best of the offsets, with the chosen points."""
    drives, usable = result.candidates.drives, result.candidates.usable
    here = drives.order == order
    places = np.stack([drives.frequency_khz, drives.amplitude_nm], axis=1)
    open_places = {tuple(place) for place in places[here & usable].tolist()}
    lost = [place for place in places[here & ~usable].tolist() if tuple(place) not in open_places]
    axes.plot(*np.array(lost).reshape(-1, 2).T, "x", color=GRID, ms=3)
    # the highest gain is drawn last
    rows = np.flatnonzero(here & usable)
    rows = rows[np.argsort(result.gain[rows], kind="stable")]
    axes.scatter(*places[rows].T, c=result.gain[rows], cmap=_MAP, norm=scale, s=26, marker="s", linewidths=0)
    numbers: dict[tuple[float, float], list[str]] = {}
    for number, row in enumerate(result.chosen.tolist(), start=1):
        if drives.order[row] == order:
            x, y = places[row].tolist()
            numbers.setdefault((x, y), []).append(str(number))
    for place, labels in numbers.items():
        axes.plot(*place, "o", ms=11, mfc="none", mec=ACCENT, mew=1.5)
        axes.annotate(",".join(labels), place, (5, 6), textcoords="offset points", fontsize=8, color=ACCENT)
    axes.set_title(f"order {order}", fontsize=_SMALL)
    label_axes(axes, x="drive (kHz)", y="drive (nm)")
    axes.xaxis.label.set_fontsize(_SMALL)
    axes.yaxis.label.set_fontsize(_SMALL)
    axes.tick_params(labelsize=8)
    axes.margins(0.08, 0.15)
