"""The picture of laws fitted to a contact: their errors, and the collision delay with its law."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from afm_jax.contact.law_of_contact import ContactDelay, ContactLaw
from afm_jax.plots.picture_style import DARK, GRID, label_axes, new_figure, save

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
