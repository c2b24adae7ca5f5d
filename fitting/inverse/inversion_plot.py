"""The picture of a direct inversion: the loss and the delay point by point, over the laws regressed on them."""

from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, with_zero_line
from fitting.inverse.fitted_law import SavedLaw
from fitting.inverse.inversion_result import Inversion

_STYLES = {"viscous": (BLUE, "-", r"$\epsilon$, $c$"), "restitution": (ACCENT, "--", r"$r$, $\epsilon$")}
_NS_PER_US = 1e3
_INVALID = "#B00020"
_SMALL = 9


def inversion_figure(result: Inversion, *, fitted: SavedLaw | None = None) -> Figure:
    """Return the figure: loss u_in - u_out on the left, collision delay on the right, both against u_in.

    Args:
        result: the inversion; without any phase there is no delay to draw.
        fitted: a law that a fit found, drawn over the rows.
    """
    inverted = bool(result.rows.inverted.any())
    figure = new_figure(11.0 if inverted else 6.5, 5.0)
    axes = figure.subplots(1, 2 if inverted else 1, squeeze=False)[0]
    _draw_loss(axes[0], result, fitted)
    if inverted:
        _draw_delay(axes[1], result, fitted)
    title = result.verdict if inverted else "the paper's reading on resonance: phase assumed, bias "
    if not inverted:
        title += "not known" if result.resonance.reference == "none" else "in invert.txt"
    figure.suptitle(
        title if result.valid else f"NOT VALID: {title}", color="black" if result.valid else _INVALID, fontsize=10
    )
    return figure


def _draw_loss(axes: Axes, result: Inversion, fitted: SavedLaw | None) -> None:
    rows, speeds = result.rows, result.approach_speed_nm_per_us
    for name, law in result.laws.items():
        colour, dashes, symbols = _STYLES[name]
        label = f"{symbols}: $\\chi^2$ {law.chi2:.1f}/{law.degrees_of_freedom}"
        lost = speeds - law.curve
        axes.plot(speeds, lost, dashes, color=colour, lw=1.6, label=label)
        axes.fill_between(speeds, lost - law.curve_error, lost + law.curve_error, color=colour, alpha=0.15, lw=0)
    if fitted is not None:
        _curve_of_fit(axes, result, fitted, fitted.approach_speed_nm_per_us - fitted.rebound_speed_nm_per_us)
    c = rows.covariance
    error = np.sqrt(np.maximum(c[:, 0, 0] + c[:, 1, 1] - 2.0 * c[:, 0, 1], 0.0))
    _points(axes, result, rows.impact[:, 0] - rows.impact[:, 1], error)
    reading = result.resonance
    if len(reading.row):
        lost = reading.approach_speed_nm_per_us - reading.rebound_speed_nm_per_us
        axes.plot(reading.approach_speed_nm_per_us, lost, "x", ms=5, color=GRID, label="on resonance (paper)")
    _speed_axis(axes, r"loss  $u_{in} - u_{out}$ (nm/µs)", legend="upper left")
    axes.set_yscale("log")


def _curve_of_fit(axes: Axes, result: Inversion, fitted: SavedLaw, values: np.ndarray) -> None:
    """Draw what a fit found, over the speeds of the rows."""
    speeds = np.concatenate([result.rows.impact[:, 0], result.resonance.approach_speed_nm_per_us])
    known = np.isfinite(values) & (fitted.approach_speed_nm_per_us >= 0.9 * np.nanmin(speeds))
    known &= fitted.approach_speed_nm_per_us <= 1.1 * np.nanmax(speeds)
    curve = values[known]
    axes.plot(
        fitted.approach_speed_nm_per_us[known],
        curve,
        ":",
        color="black",
        lw=1.8,
        zorder=3,
        label=f"fit, {fitted.model}",
    )


def _draw_delay(axes: Axes, result: Inversion, fitted: SavedLaw | None) -> None:
    law, speeds = result.delay, result.approach_speed_nm_per_us
    if law is not None:
        curve, band = _NS_PER_US * law.curve, _NS_PER_US * law.curve_error
        label = f"delay law: $\\chi^2$ {law.chi2:.1f}/{law.degrees_of_freedom}"
        axes.plot(speeds, curve, color=BLUE, lw=1.6, label=label)
        axes.fill_between(speeds, curve - band, curve + band, color=BLUE, alpha=0.15, lw=0)
    if fitted is not None:
        _curve_of_fit(axes, result, fitted, _NS_PER_US * fitted.collision_delay_us)
    _points(axes, result, _NS_PER_US * result.rows.impact[:, 2], _NS_PER_US * result.rows.errors[:, 2])
    with_zero_line(axes)
    _speed_axis(axes, r"collision delay  $\tau$ (ns)", legend="lower right")


def _points(axes: Axes, result: Inversion, values: np.ndarray, errors: np.ndarray) -> None:
    rows = result.rows
    for chosen, face, label in (
        (rows.inverted & rows.regressed, DARK, "rows"),
        (rows.inverted & ~rows.regressed, "none", "rows set aside"),
    ):
        if chosen.any():
            axes.errorbar(
                rows.impact[chosen, 0],
                values[chosen],
                errors[chosen],
                fmt="o",
                ms=3.5,
                lw=0.8,
                color=DARK,
                mfc=face,
                label=label,
            )


def _speed_axis(axes: Axes, y: str, *, legend: Literal["upper left", "lower right"]) -> None:
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    ticks = [tick for tick in (5, 10, 20, 50, 100, 200, 500, 1000, 2000) if low <= tick <= high]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    label_axes(axes, x=r"approach speed  $u_{in}$ (nm/µs)", y=y)
    axes.grid(color=GRID, alpha=0.25)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=_SMALL, loc=legend)
