"""The picture of collisions: rebound speed, delay and losses against approach speed."""

import numpy as np
from matplotlib.figure import Figure

from afm_jax.contact.collide import Collision, Collisions
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_panels
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
    tips, capture = (found, None) if isinstance(found, Collision) else found[:2]
    columns = {name: array.astype(float).ravel() for name, (array, _) in known_columns(tips).items()}
    usable = np.flatnonzero(columns["approach_speed_nm_per_us"] > 0.0)
    usable = usable[np.argsort(columns["approach_speed_nm_per_us"][usable], kind="stable")]
    columns = {name: array[usable] for name, array in columns.items()}
    approach, rebound, delay, captured = (columns[name] for name in _DRAWN)
    figure, panels = new_panels(8.0, 9.0, 3, sharex=True, height_ratios=(1.6, 1.0, 1.0))
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
    held_below = capture or np.max(approach[is_captured], initial=0.0)
    for axes in panels:
        axes.axvspan(0.0, held_below, color=ACCENT, alpha=0.13, lw=0.0)
    upper.set(xlim=(0.0, end), ylim=(0.0, end))
    label_axes(upper, x="", y=r"rebound speed  $u_{out}$ (nm/µs)")
    label_axes(middle, x="", y="collision delay (µs)")
    label_axes(lower, x=r"approach speed  $u_{in}$ (nm/µs)", y="energy lost (aJ)")
    middle.axhline(0.0, color=GRID, lw=0.8)
    lower.margins(y=0.35)
    lower.set_ylim(bottom=0.0)
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
