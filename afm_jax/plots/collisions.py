"""The pictures of collisions: rebound speed and delay against approach speed; the laws fitted to them, their errors."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.contact.collide import Collision, Collisions
from afm_jax.contact.law_of_contact import ContactDelay, ContactLaw, ContactLaws
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure
from afm_jax.results import known_columns
from afm_jax.words import counted


def collisions_figure(found: Collision | Collisions, title: str = "") -> Figure:
    """Return rebound speed, delay and losses of collisions over the approach speed; where tips are captured is shaded.

    Rebound speed, delay and losses are unknown where a tip does not leave.

    Args:
        found: collisions; where the capture speed is known the captured range ends there, else at the fastest
            captured tip.
        title: of the picture.
    """
    if isinstance(found, Collision):
        capture_speed_nm_per_us = None
        columns = {name: array.astype(float).ravel() for name, (array, _) in known_columns(found).items()}
    else:
        capture_speed_nm_per_us = found.capture_speed_nm_per_us
        columns = {name: np.array([row[name] for row in found.rows], float) for name in (*_DRAWN, *_LOSSES)}
    usable = np.flatnonzero(columns["approach_speed_nm_per_us"] > 0.0)
    usable = usable[np.argsort(columns["approach_speed_nm_per_us"][usable], kind="stable")]
    columns = {name: array[usable] for name, array in columns.items()}
    approach, rebound, delay, captured = (columns[name] for name in _DRAWN)
    figure = new_figure(8.0, 9.0)
    panels = figure.subplots(3, 1, sharex=True, height_ratios=(1.6, 1.0, 1.0))
    upper, middle, lower = panels
    end = 1.03 * max(np.max(approach, initial=0.0), np.finfo(float).tiny)
    upper.plot([0.0, end], [0.0, end], color=GRID, lw=1.2, ls="--", label=r"no loss, $u_{out} = u_{in}$")
    style = {"ls": "", "marker": ".", "ms": 5}
    upper.plot(approach, rebound, color=DARK, label="contact", **style)
    middle.plot(approach, delay, color=DARK, **style)
    for name, (label, colour) in _LOSSES.items():
        lower.plot(approach, columns[name], color=colour, label=label, **style)
    is_captured = captured == 1.0
    if is_captured.any():
        style = {"color": ACCENT, "ms": 7, "label": "captured", "clip_on": False}
        upper.plot(approach[is_captured], np.zeros(is_captured.sum()), "x", **style)
    held_below = capture_speed_nm_per_us or np.max(approach[is_captured], initial=0.0)
    for axes in panels:
        axes.axvspan(0.0, held_below, color=ACCENT, alpha=0.13, lw=0.0)
    upper.set(xlim=(0.0, end), ylim=(0.0, end))
    label_axes(upper, x="", y=r"rebound speed  $u_{out}$ (nm/µs)")
    label_axes(middle, x="", y="collision delay (µs)")
    label_axes(lower, x=r"approach speed  $u_{in}$ (nm/µs)", y="energy lost (aJ)")
    middle.axhline(0.0, color=GRID, lw=0.8)
    lower.margins(y=0.35)
    lower.set_ylim(bottom=0.0)
    for axes in panels:
        axes.grid(color=GRID, alpha=0.25)
    upper.legend(fontsize=10, loc="upper left")
    lower.legend(fontsize=10, loc="upper right", ncols=3)
    figure.suptitle(title or f"Collisions of {counted(usable.size, 'free tip')}", fontsize=12)
    return figure


_DRAWN = ("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "collision_delay_us", "captured")
_LOSSES = {
    "bridge_hysteresis_aj": ("liquid bridge", BLUE),
    "junction_hysteresis_aj": ("solid junction", ACCENT),
    "viscous_loss_aj": ("viscous", "#009E73"),
}


# Okabe and Ito's colours, distinguishable with every kind of colour vision.
_COLOURS = {"law": "#D55E00", "viscous": "#0072B2", "full": "#009E73"}
_NAMES = {"law": r"$r$, $\epsilon$", "viscous": r"$\epsilon$, $c$", "full": r"$r$, $\epsilon$, $c$"}


def contact_law_figure(law: ContactLaws) -> Figure:
    """Return the relative errors of the laws on the left, delay, lag, lead and delay law on the right."""
    figure = new_figure(11.0, 5.0)
    left, right = figure.subplots(1, 2)
    _draw_laws(left, law.formulas)
    _draw_delay(right, law.delay)
    return figure


def _draw_laws(axes: Axes, laws: Sequence[ContactLaw]) -> None:
    for law in laws:
        name, colour = _NAMES.get(law.model, law.model), _COLOURS.get(law.model, DARK)
        label = f"{name}: worst {100.0 * law.worst_relative_error:.2g} %"
        axes.plot(law.approach_speed_nm_per_us, 100.0 * law.relative_error, color=colour, lw=1.8, label=label)
    axes.axhline(0.0, color=GRID, lw=0.8)
    label_axes(axes, x=r"approach speed  $u_{in}$ (nm/µs)", y=r"$u_{fit}/u_{out} - 1$  (%)")
    axes.set_title(
        rf"$u_{{out}}^2 = r^2 u_{{in}}^2 - c\,u_{{in}} - \epsilon$, {laws[0].residuals} residuals", fontsize=11
    )
    axes.grid(color=GRID, alpha=0.25)
    axes.legend(fontsize=10)


def _draw_delay(axes: Axes, delay: ContactDelay) -> None:
    speed = delay.approach_speed_nm_per_us
    axes.plot(speed, delay.lag_us, color=_COLOURS["viscous"], lw=1.4, label="lag: in the solid junction")
    axes.plot(speed, -delay.lead_us, color=_COLOURS["law"], lw=1.4, label="- lead: outside it")
    axes.plot(speed, delay.delay_us, color=DARK, lw=2.0, label="delay = lag - lead")
    axes.plot(speed, delay.fitted_us, color=_COLOURS["full"], lw=1.6, ls="--", label="delay law")
    axes.axhline(0.0, color=GRID, lw=0.8)
    axes.set_xscale("log")
    ticks = [tick for tick in (5, 10, 20, 50, 100, 200, 500, 1000) if speed[0] <= tick <= speed[-1]]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    label_axes(axes, x=r"approach speed  $u_{in}$ (nm/µs)", y="time (µs)")
    values = ", ".join(f"{float(np.asarray(value)):.3g}" for value in (delay.delay.hertz, delay.delay.lead_nm))
    values += f", {float(delay.delay.offset_nm):.3g}"
    axes.set_title(rf"$a\,u^{{-1/5}} - b\,(1/w - 1/u) - d/u$  with  {values}", fontsize=11)
    axes.grid(color=GRID, alpha=0.25)
    axes.legend(fontsize=10)
