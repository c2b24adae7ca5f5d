"""The picture of collisions: rebound speed and collision delay against approach speed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.plots.picture_style import ACCENT, DARK, GRID, label_axes, new_figure, save


def draw_collisions(
    rows: Sequence[Mapping[str, Any]], capture_speed_nm_per_us: float | None, path: Path, *, title: str
) -> None:
    """Draw rebound speed above and delay below, with u_out = u_in, the capture speed, and captured tips on the axis.

    Args:
        rows: of `afm_jax.contact.collide.Collisions`.
        capture_speed_nm_per_us: drawn as a line; None: there is none.
        path: PNG file.
        title: of the picture.
    """
    approach, rebound, delay = (
        np.array([row[name] for row in rows], dtype=float)
        for name in ("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "collision_delay_us")
    )
    ranking = np.argsort(approach, kind="stable")
    approach, rebound, delay = approach[ranking], rebound[ranking], delay[ranking]
    captured = approach[[bool(rows[index]["captured"]) for index in ranking]]
    figure = new_figure(8.0, 7.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    ends = np.array([0.0, 1.03 * approach[-1]])
    upper.plot(ends, ends, color=GRID, lw=1.2, ls="--", label=r"no loss, $u_{out} = u_{in}$")
    style = {"color": DARK, "lw": 1.4, "marker": "o" if len(approach) <= 60 else "", "ms": 4}
    upper.plot(approach, rebound, label="contact", **style)
    lower.plot(approach, delay, **style)
    lower.axhline(0.0, color=GRID, lw=0.8)
    if captured.size:
        upper.plot(captured, np.zeros_like(captured), "x", color=ACCENT, ms=7, label="captured", clip_on=False)
    if capture_speed_nm_per_us:
        for axes in (upper, lower):
            axes.axvline(capture_speed_nm_per_us, color=ACCENT, lw=1.2, ls=":")
        upper.plot([], [], color=ACCENT, lw=1.2, ls=":", label=f"capture speed, {capture_speed_nm_per_us:.4g} nm/µs")
    upper.set(xlim=ends, ylim=(0.0, ends[1]))
    label_axes(upper, x="", y=r"rebound speed  $u_{out}$ (nm/µs)")
    label_axes(lower, x=r"approach speed  $u_{in}$ (nm/µs)", y="collision delay (µs)")
    for axes in (upper, lower):
        axes.grid(color=GRID, alpha=0.25)
    upper.legend(fontsize=10, loc="lower right")
    figure.suptitle(title, fontsize=12)
    save(figure, path)
