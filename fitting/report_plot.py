"""The picture of a fit: measured and predicted amplitudes, residuals, and the law with its band."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitting.report import interval_in_words
from fitting.result import FitResult

# Okabe and Ito's colours, distinguishable with every kind of colour vision.
_COLOURS = ("#0072B2", "#D55E00")
_KINDS = ("peak", "lock-in")
_SMALL = 8


def fit_figure(result: FitResult) -> Figure:
    """Return the figure: amplitudes and residuals row by row on the left, the impact law on the right."""
    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    axes = figure.subplot_mosaic(
        [["amplitudes", "law"], ["residuals", "losses"]], width_ratios=(1.5, 1.0), height_ratios=(1.7, 1.0)
    )
    axes["residuals"].sharex(axes["amplitudes"])
    axes["losses"].sharex(axes["law"])
    _draw_amplitudes(axes["amplitudes"], result)
    _draw_residuals(axes["residuals"], result)
    _draw_law(axes["law"], result)
    _draw_losses(axes["losses"], result)
    title = f"Impact law from {result.table.rows} rows, model {result.model}, chi²/dof = "
    title += f"{result.chi2:.4g}/{result.degrees_of_freedom}"
    colour = "black" if result.valid else "#B00020"
    figure.suptitle(title if result.valid else f"NOT VALID    {title}", color=colour, fontsize=12)
    return figure


def _row_axis(result: FitResult) -> tuple[np.ndarray, list[int]]:
    """Return positions of the rows, sorted by order, frequency and drive, and where a new order begins."""
    table = result.table
    ranking = np.lexsort((table.drive_amplitude_nm, table.drive_frequency_khz, table.order))
    orders = table.order[ranking]
    return ranking, [int(i) for i in np.flatnonzero(np.diff(orders)) + 1]


def _draw_amplitudes(axes: Axes, result: FitResult) -> None:
    ranking, breaks = _row_axis(result)
    places = np.arange(len(ranking))
    for kind in range(2):
        measured = result.rows.measured_nm[ranking, kind]
        if not np.isfinite(measured).any():
            continue
        predicted = result.rows.predicted_nm[ranking, kind]
        axes.plot(places, measured, "o", ms=4, mfc="none", color=_COLOURS[kind], label=f"{_KINDS[kind]}, measured")
        axes.plot(places, predicted, "_", ms=8, mew=1.6, color=_COLOURS[kind], label=f"{_KINDS[kind]}, predicted")
    missing = np.flatnonzero(result.rows.orbits[ranking] == 0).tolist()
    for place in missing:
        axes.axvline(place, color="#B00020", lw=0.8, ls=":", label="no stable orbit" if place == missing[0] else None)
    _mark_orders(axes, result.table.order[ranking], breaks)
    axes.set_yscale("log")
    # Room for the legend below the smallest amplitude.
    axes.set_ylim(bottom=0.35 * np.nanmin(result.rows.measured_nm))
    axes.set_ylabel("amplitude (nm)")
    axes.tick_params(labelbottom=False)
    axes.legend(fontsize=_SMALL, ncols=2, loc="lower right")


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
            fontsize=_SMALL,
        )


def _draw_residuals(axes: Axes, result: FitResult) -> None:
    ranking, breaks = _row_axis(result)
    places = np.arange(len(ranking))
    axes.axhspan(-2, 2, color="0.92", zorder=0)
    axes.axhline(0, color="0.5", lw=0.8)
    for kind in range(2):
        axes.plot(places, result.rows.residual[ranking, kind], "o", ms=3, color=_COLOURS[kind])
    for place in breaks:
        axes.axvline(place - 0.5, color="0.7", lw=0.8)
    axes.set_ylabel("(predicted - measured)/error")
    axes.set_xlabel("row (by order N, drive frequency, drive amplitude)")


def _draw_law(axes: Axes, result: FitResult) -> None:
    law = result.law
    axes.fill_between(
        law.approach_speed_nm_per_us,
        law.rebound_low_nm_per_us,
        law.rebound_high_nm_per_us,
        color=_COLOURS[0],
        alpha=0.3,
        lw=0,
        label="95 % band" if result.valid else None,
    )
    axes.plot(law.approach_speed_nm_per_us, law.rebound_speed_nm_per_us, color=_COLOURS[0], label="fitted law")
    axes.plot(law.approach_speed_nm_per_us, law.approach_speed_nm_per_us, color="0.6", ls="--", lw=0.9, label="no loss")
    reached = result.rows.approach_speed_nm_per_us
    axes.plot(reached, np.zeros_like(reached), "|", color="black", ms=8, label="rows' approach speeds")
    axes.set_ylabel("rebound speed (nm/µs)")
    axes.set_ylim(bottom=0)
    axes.tick_params(labelbottom=False)
    axes.legend(fontsize=_SMALL, loc="upper left", title=_law_title(result), title_fontsize=_SMALL)


def _law_title(result: FitResult) -> str:
    if not result.valid:
        return "not a measurement of the law"
    return "\n".join(f"{name}: {interval_in_words(p)} {p.unit}".rstrip() for name, p in result.parameters.items())


def _draw_losses(axes: Axes, result: FitResult) -> None:
    """Draw the share of its energy that the tip loses, where the laws differ visibly."""
    law = result.law
    speed = law.approach_speed_nm_per_us
    lost, least, most = (
        100.0 * (1.0 - (column / speed) ** 2)
        for column in (law.rebound_speed_nm_per_us, law.rebound_high_nm_per_us, law.rebound_low_nm_per_us)
    )
    axes.fill_between(speed, least, most, color=_COLOURS[0], alpha=0.3, lw=0)
    axes.plot(speed, lost, color=_COLOURS[0])
    axes.set_xlabel("approach speed (nm/µs)")
    axes.set_ylabel("energy lost (%)")
    axes.set_ylim(0, 1.15 * np.max(np.where(np.isfinite(most), most, lost)))
