"""The pictures of collisions: rebound speed and delay against approach speed; the laws fitted to them, their errors."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.contact.law_of_contact import ContactDelay, ContactLaw
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


# Okabe and Ito's colours, distinguishable with every kind of colour vision.
_COLOURS = {"law": "#D55E00", "viscous": "#0072B2", "full": "#009E73"}
_NAMES = {"law": r"$r$, $\epsilon$", "viscous": r"$\epsilon$, $c$", "full": r"$r$, $\epsilon$, $c$"}


def draw_contact_law(laws: Sequence[ContactLaw], delay: ContactDelay, path: Path) -> None:
    """Draw the relative errors of the laws on the left, delay, lag, lead and delay law on the right.

    Args:
        laws: at the same speeds.
        delay: of the same contact.
        path: PNG file.
    """
    figure = new_figure(11.0, 5.0)
    left, right = figure.subplots(1, 2)
    for law in laws:
        label = f"{_NAMES[law.model]}: worst {100.0 * law.worst_relative_error:.2g} %"
        error = 100.0 * law.relative_error
        left.plot(law.approach_speed_nm_per_us, error, color=_COLOURS[law.model], lw=1.8, label=label)
    left.axhline(0.0, color=GRID, lw=0.8)
    label_axes(left, x=r"approach speed  $u_{in}$ (nm/µs)", y=r"$u_{fit}/u_{out} - 1$  (%)")
    left.set_title(
        rf"$u_{{out}}^2 = r^2 u_{{in}}^2 - c\,u_{{in}} - \epsilon$, {laws[0].residuals} residuals", fontsize=11
    )
    speed = delay.approach_speed_nm_per_us
    right.plot(speed, delay.lag_us, color=_COLOURS["viscous"], lw=1.4, label="lag: in the solid junction")
    right.plot(speed, -delay.lead_us, color=_COLOURS["law"], lw=1.4, label="- lead: outside it")
    right.plot(speed, delay.delay_us, color=DARK, lw=2.0, label="delay = lag - lead")
    right.plot(speed, delay.fitted_us, color=_COLOURS["full"], lw=1.6, ls="--", label="delay law")
    right.axhline(0.0, color=GRID, lw=0.8)
    right.set_xscale("log")
    ticks = [tick for tick in (5, 10, 20, 50, 100, 200, 500, 1000) if speed[0] <= tick <= speed[-1]]
    right.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    right.set_xticks([], minor=True)
    label_axes(right, x=r"approach speed  $u_{in}$ (nm/µs)", y="time (µs)")
    values = ", ".join(f"{float(np.asarray(value)):.3g}" for value in (delay.delay.hertz, delay.delay.lead_nm))
    values += f", {float(delay.delay.offset_nm):.3g}"
    right.set_title(rf"$a\,u^{{-1/5}} - b\,(1/w - 1/u) - d/u$  with  {values}", fontsize=11)
    for axes in (left, right):
        axes.grid(color=GRID, alpha=0.25)
        axes.legend(fontsize=10)
    save(figure, path)
