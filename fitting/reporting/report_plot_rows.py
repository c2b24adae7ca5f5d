"""The rows of a fit drawn: measured and predicted amplitudes, and what is left of them."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from fitting.result import FitResult

# Okabe and Ito's colours, distinguishable with every kind of colour vision.
COLOURS = ("#0072B2", "#D55E00")
ALARM = "#B00020"
SMALL = 8
_KINDS = ("peak", "lock-in")
_ASIDE = "#999999"
_ROW_AXIS = "row (by order N, drive frequency, drive amplitude)"


def draw_amplitudes(axes: Axes, result: FitResult) -> None:
    """Draw each row's measured amplitudes with their prediction; rows set aside or without an orbit are marked."""
    ranking, breaks = _row_axis(result)
    places = np.arange(len(ranking))
    aside = result.rows.set_aside[ranking]
    drawn = False
    for kind in range(2):
        measured = result.rows.measured_nm[ranking, kind]
        if not np.isfinite(measured).any():
            continue
        predicted = result.rows.predicted_nm[ranking, kind]
        fitted = np.where(aside, np.nan, measured)
        axes.plot(places, fitted, "o", ms=4, mfc="none", color=COLOURS[kind], label=f"{_KINDS[kind]}, measured")
        axes.plot(places, predicted, "_", ms=8, mew=1.6, color=COLOURS[kind], label=f"{_KINDS[kind]}, predicted")
        if (aside & np.isfinite(measured)).any():
            label = None if drawn else "measured, set aside"
            axes.plot(places[aside], measured[aside], "x", ms=6, mew=1.4, color=_ASIDE, label=label)
            drawn = True
    _mark_missing(axes, result, ranking)
    _mark_orders(axes, result.table.order[ranking], breaks)
    axes.set_yscale("log")
    axes.set_ylabel("amplitude (nm)")
    axes.tick_params(labelbottom=False)


def draw_residuals(axes: Axes, result: FitResult) -> None:
    """Draw the normalised residuals row by row."""
    ranking, breaks = _row_axis(result)
    places = np.arange(len(ranking))
    _draw_expected(axes)
    for kind in range(2):
        axes.plot(places, result.rows.residual[ranking, kind], "o", ms=3, color=COLOURS[kind])
    for place in breaks:
        axes.axvline(place - 0.5, color="0.7", lw=0.8)
    axes.set_ylabel("residual (errors)")
    axes.set_xlabel(_ROW_AXIS)


def draw_residuals_by_speed(axes: Axes, result: FitResult) -> None:
    """Draw the normalised residuals against the approach speed: what is left of a wrong law shows here."""
    _draw_expected(axes)
    speed = result.rows.approach_speed_nm_per_us
    for kind in range(2):
        residual = result.rows.residual[:, kind]
        if np.isfinite(residual).any():
            axes.plot(speed, residual, "o", ms=3.5, color=COLOURS[kind], label=_KINDS[kind])
    if (np.isfinite(speed) & np.isfinite(result.rows.residual).any(axis=1)).any():
        log_speed_axis(axes)
        axes.legend(fontsize=SMALL, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes.set_ylabel("residual (errors)")
    axes.set_xlabel("approach speed (nm/µs)")


def log_speed_axis(axes: Axes) -> None:
    """Make an axis of speeds logarithmic, with plain numbers at it."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _draw_expected(axes: Axes) -> None:
    axes.axhspan(-2, 2, color="0.92", zorder=0)
    axes.axhline(0, color="0.5", lw=0.8)


def _row_axis(result: FitResult) -> tuple[np.ndarray, list[int]]:
    """Return positions of the rows, sorted by order, frequency and drive, and where a new order begins."""
    table = result.table
    ranking = np.lexsort((table.drive_amplitude_nm, table.drive_frequency_khz, table.order))
    orders = table.order[ranking]
    return ranking, [int(i) for i in np.flatnonzero(np.diff(orders)) + 1]


def _mark_missing(axes: Axes, result: FitResult, ranking: np.ndarray) -> None:
    """Mark the rows for which the law has no stable orbit, and those that were seen without one."""
    seen = np.zeros(len(ranking), dtype=bool) if result.table.no_orbit is None else result.table.no_orbit[ranking] > 0
    missing = result.rows.orbits[ranking] == 0
    for rows, colour, label in (
        (missing & ~seen, ALARM, "no stable orbit predicted"),
        (seen & missing, _ASIDE, "no orbit, as predicted"),
        (seen & ~missing, "black", "no orbit seen, one predicted"),
    ):
        for count, place in enumerate(np.flatnonzero(rows).tolist()):
            axes.axvline(place, color=colour, lw=0.8, ls=":", label=None if count else label)


def _mark_orders(axes: Axes, orders: np.ndarray, breaks: list[int]) -> None:
    """Separate the orders N by lines and name them at the top."""
    for place in breaks:
        axes.axvline(place - 0.5, color="0.7", lw=0.8)
    for begin, end in zip([0, *breaks], [*breaks, len(orders)], strict=True):
        axes.annotate(
            f"N = {orders[begin]}",
            ((begin + end - 1) / 2, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=SMALL,
        )
