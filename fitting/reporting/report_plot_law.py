"""The law of a fit drawn: rebound speed, energy lost and collision delay over the approach speed, with bands."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import StrMethodFormatter

from fitting.reporting.report_plot_rows import COLOURS, SMALL, log_speed_axis
from fitting.result import FitResult

_MUCH = 5.0
"""How much the loss must change to be drawn on a logarithmic axis."""
_APPROACH = "approach speed (nm/µs)"


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
    speed = law.approach_speed_nm_per_us
    lost, least, most = (
        100.0 * (1.0 - (column / speed) ** 2)
        for column in (law.rebound_speed_nm_per_us, law.rebound_high_nm_per_us, law.rebound_low_nm_per_us)
    )
    axes.fill_between(speed, least, most, color=COLOURS[0], alpha=0.3, lw=0)
    axes.plot(speed, lost, color=COLOURS[0])
    _mark_speeds(axes, result)
    log_speed_axis(axes)
    axes.set_xlabel(_APPROACH)
    axes.set_ylabel("energy lost (%)")
    if lost.min() > 0.0 and lost.max() > _MUCH * lost.min():
        axes.set_yscale("log")
        axes.set_ylim(0.4 * lost.min(), 2.0 * lost.max())
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        return
    top = float(np.max(np.where(np.isfinite(most), most, lost)))
    axes.set_ylim(0, min(1.15 * top, 105.0) if top > 0.0 else 1.0)


def draw_delay(axes: Axes, result: FitResult) -> None:
    """Draw the collision delay, which is zero where impacts are instantaneous."""
    law = result.law
    speed = law.approach_speed_nm_per_us
    axes.axhline(0, color="0.6", ls="--", lw=0.9)
    axes.fill_between(speed, 1e3 * law.delay_low_us, 1e3 * law.delay_high_us, color=COLOURS[0], alpha=0.3, lw=0)
    axes.plot(speed, 1e3 * law.collision_delay_us, color=COLOURS[0])
    _mark_speeds(axes, result)
    log_speed_axis(axes)
    axes.set_xlabel(_APPROACH)
    axes.set_ylabel("collision delay (ns)")
    _frame_measured(axes, result)


def _mark_speeds(axes: Axes, result: FitResult, label: str | None = None) -> None:
    """Mark on the lower edge the speeds of the rows that were used."""
    reached = result.rows.approach_speed_nm_per_us[result.rows.used]
    reached = reached[np.isfinite(reached)]
    edge = axes.get_xaxis_transform()
    axes.plot(reached, np.full_like(reached, 0.02), "|", color="black", ms=6, mew=0.7, transform=edge, label=label)


def _frame_measured(axes: Axes, result: FitResult) -> None:
    """Let the measured speeds decide the height: below them the delay may fall steeply."""
    law, rows = result.law, result.rows
    reached = rows.approach_speed_nm_per_us[rows.used & np.isfinite(rows.approach_speed_nm_per_us)]
    if not reached.size:
        return
    inside = (law.approach_speed_nm_per_us >= reached.min()) & (law.approach_speed_nm_per_us <= reached.max())
    columns = np.concatenate(
        [column[inside] for column in (law.collision_delay_us, law.delay_low_us, law.delay_high_us)]
    )
    columns = 1e3 * columns[np.isfinite(columns)]
    if columns.size:
        low, high = min(float(columns.min()), 0.0), max(float(columns.max()), 0.0)
        margin = 0.12 * (high - low) or 1.0
        axes.set_ylim(low - margin, high + margin)
