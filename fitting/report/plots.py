"""The pictures of a fit: measured and predicted amplitudes, residuals, and the law with its band."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from fitting.infer.comparison import Comparison
from fitting.infer.result import FitResult
from fitting.report.words import has_delay

# Okabe and Ito's colours, distinguishable with every kind of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73")
ALARM = "#B00020"
SMALL = 9
_WIDTH_INCHES = 6.4
"""Narrow enough that letters can still be read on a screen of 420 pixels."""
_KINDS = ("peak", "lock-in", "phase")
_EXCLUDED = "#999999"
_ROW_AXIS = "rows, by order N, drive frequency, amplitude and offset"
_HEIGHT = "height of the sample over the tip's rest position (nm)"
_APPROACH = "approach speed (nm/µs)"


def rows_figure(result: FitResult) -> Figure:
    """Return the figure of the rows: amplitudes above, residuals below; of a tapping curve the lag between them."""
    draw = [draw_amplitudes, draw_residuals]
    if result.table.tapping and result.rows.measured_phase_deg is not None:
        draw.insert(1, draw_lags)
    figure = Figure(figsize=(_WIDTH_INCHES, 1.2 + 2.6 * len(draw)), layout="constrained")
    panels = figure.subplots(len(draw), 1, sharex=True, height_ratios=(1.7, *([1.0] * (len(draw) - 1))))
    for panel, axes in zip(draw, panels, strict=True):
        panel(axes, result)
    named = [one for axes in panels for one in zip(*axes.get_legend_handles_labels(), strict=True)]
    figure.legend(*zip(*named, strict=True), fontsize=SMALL, ncols=3, loc="outside lower center")
    goodness = f"chi²/dof = {result.chi2:.4g}/{result.degrees_of_freedom}"
    title = f"Impact law from {result.table.rows} rows, model {result.model}, {goodness}"
    colour = "black" if result.valid else ALARM
    figure.suptitle(title if result.valid else f"NOT VALID    {title}", color=colour, fontsize=11)
    return figure


def law_figure(result: FitResult) -> Figure:
    """Return the figure of the law: rebound speed, its band, energy lost, and the delay where impacts last."""
    figure = Figure(figsize=(_WIDTH_INCHES, 5.6), layout="constrained")
    panels = {"law": draw_law, "losses": draw_losses}
    panels |= {"delay": draw_delay} if has_delay(result) else {}
    mosaic: list[Any] = [["law", "law"], ["losses", "delay" if has_delay(result) else "losses"]]
    for name, axes in figure.subplot_mosaic(mosaic).items():
        panels[name](axes, result)
    return figure


def speed_figure(result: FitResult) -> Figure:
    """Return the figure of the normalised residuals over the approach speed: what is left of a wrong law shows here."""
    figure = Figure(figsize=(_WIDTH_INCHES, 3.0), layout="constrained")
    axes, speed = figure.subplots(), result.rows.approach_speed_nm_per_us
    _draw_expected(axes)
    for kind, residual in enumerate(result.rows.residual.T):
        if np.isfinite(residual).any():
            axes.plot(speed, residual, "o", ms=3.5, color=COLOURS[kind], label=_KINDS[kind])
    if (np.isfinite(speed) & np.isfinite(result.rows.residual).any(axis=1)).any():
        log_speed_axis(axes)
        axes.legend(fontsize=SMALL, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)
    axes.set_ylabel("residual (errors)")
    axes.set_xlabel(_APPROACH)
    return figure


def models_figure(compared: Comparison) -> Figure:
    """Return the figure of a comparison: the law of the fit that it is about."""
    return law_figure(next(iter(compared.results.values())))


def draw_amplitudes(axes: Axes, result: FitResult) -> None:
    """Draw each row's measured amplitudes with their prediction; rows excluded or without an orbit are marked."""
    ranking, places = _row_axis(result)
    for kind in range(2):
        _draw_readings(axes, result, kind, result.rows.measured_nm[:, kind], result.rows.predicted_nm[:, kind])
    _mark_missing(axes, result, ranking, places)
    if not result.table.tapping:
        _mark_orders(axes, result, "N = {}")
        axes.set_yscale("log")
        _plain_numbers(axes.yaxis)
    axes.set_ylabel("amplitude (nm)")
    axes.tick_params(labelbottom=False)


def draw_lags(axes: Axes, result: FitResult) -> None:
    """Draw each row's measured lag with its prediction."""
    rows = result.rows
    if rows.measured_phase_deg is not None and rows.predicted_phase_deg is not None:
        _draw_readings(axes, result, 2, rows.measured_phase_deg, rows.predicted_phase_deg)
    axes.set_ylabel("lag (degrees)")


def _draw_readings(axes: Axes, result: FitResult, kind: int, measured: np.ndarray, predicted: np.ndarray) -> None:
    """Draw readings of a kind, if there are any, with their prediction."""
    ranking, places = _row_axis(result)
    aside = result.rows.set_aside[ranking]
    measured = measured[ranking]
    predicted = predicted[ranking]
    if not np.isfinite(measured).any():
        return
    fitted = np.where(aside, np.nan, measured)
    axes.plot(places, fitted, "o", ms=4, mfc="none", color=COLOURS[kind], label=f"{_KINDS[kind]}, measured")
    axes.plot(places, predicted, "_", ms=8, mew=1.6, color=COLOURS[kind], label=f"{_KINDS[kind]}, predicted")
    if (aside & np.isfinite(measured)).any():
        label = "measured, excluded"
        once = None if label in axes.get_legend_handles_labels()[1] else label
        axes.plot(places[aside], measured[aside], "x", ms=6, mew=1.4, color=_EXCLUDED, label=once)


def draw_residuals(axes: Axes, result: FitResult) -> None:
    """Draw the normalised residuals row by row."""
    ranking, places = _row_axis(result)
    _draw_expected(axes)
    for colour, residual in zip(COLOURS, result.rows.residual[ranking].T, strict=False):
        axes.plot(places, residual, "o", ms=3, color=colour)
    if not result.table.tapping:
        _mark_orders(axes, result)
    axes.set_ylabel("residual (errors)")
    axes.set_xlabel(_HEIGHT if result.table.tapping else _ROW_AXIS)


def log_speed_axis(axes: Axes) -> None:
    """Make an axis of speeds logarithmic, with plain numbers at it."""
    axes.set_xscale("log")
    _plain_numbers(axes.xaxis)


def _plain_numbers(axis: Axis) -> None:
    """Write 1, 2, 5, 10, ... at a logarithmic axis."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _draw_expected(axes: Axes) -> None:
    axes.axhspan(-2, 2, color="0.92", zorder=0)
    axes.axhline(0, color="0.5", lw=0.8)


def _row_axis(result: FitResult) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows in order and where each stands: side by side; those of a tapping curve at their height."""
    table = result.table
    if table.tapping:
        ranking = np.argsort(table.offset_nm, kind="stable")
        return ranking, table.offset_nm[ranking]
    ranking = np.lexsort((table.offset_nm, table.excitation_nm, table.drive_frequency_khz, table.order))
    return ranking, np.arange(len(ranking), dtype=float)


def _mark_missing(axes: Axes, result: FitResult, ranking: np.ndarray, places: np.ndarray) -> None:
    """Mark the rows for which the law has no stable orbit, and those that were seen without one."""
    seen = np.zeros(len(ranking), dtype=bool) if result.table.no_orbit is None else result.table.no_orbit[ranking] > 0
    missing = result.rows.orbits[ranking] == 0
    for rows, colour, label in (
        (missing & ~seen, ALARM, "no stable orbit predicted"),
        (seen & missing, _EXCLUDED, "no orbit, as predicted"),
        (seen & ~missing, "black", "no orbit seen, one predicted"),
    ):
        for count, place in enumerate(places[rows].tolist()):
            axes.axvline(place, color=colour, lw=0.8, ls=":", label=None if count else label)


def _mark_orders(axes: Axes, result: FitResult, name: str = "") -> None:
    """Separate the orders N by lines, with their names above the panel."""
    ranking, places = _row_axis(result)
    order = result.table.order[ranking]
    for number in np.unique(order):
        first, last = places[order == number][[0, -1]]
        axes.axvline(last + 0.5, color="0.7", lw=0.8)
        middle = 0.5 * (first + last), 1.02
        axes.annotate(name.format(number), middle, xycoords=("data", "axes fraction"), ha="center", fontsize=SMALL)


def draw_law(axes: Axes, result: FitResult) -> None:
    """Draw the rebound speed over the approach speed, with the speeds that the rows reached."""
    law = result.law
    speed = law.approach_speed_nm_per_us
    if np.isfinite(law.rebound_high_nm_per_us).any():
        low, high = law.rebound_low_nm_per_us, law.rebound_high_nm_per_us
        axes.fill_between(speed, low, high, color=COLOURS[0], alpha=0.3, lw=0, label="95 % band")
    name = "fitted law" if result.valid else "fit, not a measurement"
    axes.plot(speed, law.rebound_speed_nm_per_us, color=COLOURS[0], label=name)
    axes.plot(speed, speed, color="0.6", ls="--", lw=0.9, label="no loss")
    _mark_speeds(axes, result, label="rows' approach speeds")
    axes.set_ylabel("rebound speed (nm/µs)")
    axes.set_xlabel(_APPROACH)
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=SMALL, loc="upper left")


def draw_losses(axes: Axes, result: FitResult) -> None:
    """Draw the share of its energy that the tip loses, where the laws differ visibly."""
    law = result.law
    lost, least, most = (
        100.0 * (1.0 - (column / law.approach_speed_nm_per_us) ** 2)
        for column in (law.rebound_speed_nm_per_us, law.rebound_high_nm_per_us, law.rebound_low_nm_per_us)
    )
    _draw_with_band(axes, result, lost, least, most)
    axes.set_ylabel("energy lost (%)")
    top = float(np.max(np.where(np.isfinite(most), most, lost)))
    axes.set_ylim(0, min(1.15 * top, 105.0) if top > 0.0 else 1.0)


def draw_delay(axes: Axes, result: FitResult) -> None:
    """Draw the collision delay, which is zero where impacts are instantaneous."""
    law = result.law
    columns = 1e3 * np.stack([law.collision_delay_us, law.delay_low_us, law.delay_high_us])
    axes.axhline(0, color="0.6", ls="--", lw=0.9)
    _draw_with_band(axes, result, *columns)
    axes.set_ylabel("collision delay (ns)")


def _draw_with_band(axes: Axes, result: FitResult, value: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Draw what a law says over the approach speed, with its band and the speeds of the rows."""
    speed = result.law.approach_speed_nm_per_us
    axes.fill_between(speed, low, high, color=COLOURS[0], alpha=0.3, lw=0)
    axes.plot(speed, value, color=COLOURS[0])
    _mark_speeds(axes, result)
    log_speed_axis(axes)
    axes.set_xlabel(_APPROACH)


def _mark_speeds(axes: Axes, result: FitResult, label: str | None = None) -> None:
    """Mark on the lower edge the speeds of the rows that were used."""
    reached = result.rows.reached_nm_per_us
    edge = axes.get_xaxis_transform()
    axes.plot(reached, np.full_like(reached, 0.02), "|", color="black", ms=6, mew=0.7, transform=edge, label=label)
