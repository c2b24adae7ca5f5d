"""The pictures of collisions: rebound speed and delay against approach speed; the laws fitted to them, their errors."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.contact.collide import Collision
from afm_jax.contact.law_of_contact import ContactDelay, ContactLaw
from afm_jax.plots.picture_style import ACCENT, DARK, GRID, label_axes, new_figure, save
from afm_jax.results import known_columns
from afm_jax.words import counted


def draw_collisions(
    rows: Sequence[Mapping[str, Any]], capture_speed_nm_per_us: float | None, path: Path, *, title: str
) -> None:
    """Write the picture of collisions as a PNG file.

    Args:
        rows: of `afm_jax.contact.collide.Collisions`.
        capture_speed_nm_per_us: drawn as a line; None: there is none.
        path: PNG file.
        title: of the picture.
    """
    approach, rebound, delay = (np.array([row[name] for row in rows], dtype=float) for name in _DRAWN)
    captured = np.array([bool(row["captured"]) for row in rows])
    save(_collisions(approach, rebound, delay, captured, capture_speed_nm_per_us, title), path)


def collisions_figure(found: Collision) -> Figure:
    """Return the picture of collisions that `afm-jax collide` draws, too."""
    columns = {name: array.ravel() for name, (array, _) in known_columns(found).items()}
    title = f"Collisions of {counted(columns['captured'].size, 'free tip')}"
    approach, rebound, delay = (columns[name] for name in _DRAWN)
    return _collisions(approach, rebound, delay, columns["captured"], None, title)


_DRAWN = ("approach_speed_nm_per_us", "rebound_speed_nm_per_us", "collision_delay_us")


def _collisions(
    approach: Float[np.ndarray, " tips"],
    rebound: Float[np.ndarray, " tips"],
    delay: Float[np.ndarray, " tips"],
    captured: Bool[np.ndarray, " tips"],
    capture_speed_nm_per_us: float | None,
    title: str,
) -> Figure:
    """Return rebound speed above and delay below, with u_out = u_in, the capture speed, and captured tips on the axis.

    Rebound speed and delay are NaN where a tip has none; tips with speeds of their own are joined by lines.
    """
    usable = np.isfinite(approach) & (approach > 0.0)
    approach, rebound, delay, captured = (part[usable] for part in (approach, rebound, delay, captured))
    ranking = np.argsort(approach, kind="stable")
    approach, rebound, delay, captured = (part[ranking] for part in (approach, rebound, delay, captured))
    figure = new_figure(8.0, 7.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    ends = np.array([0.0, 1.03 * max(np.max(approach, initial=0.0), np.finfo(float).tiny)])
    upper.plot(ends, ends, color=GRID, lw=1.2, ls="--", label=r"no loss, $u_{out} = u_{in}$")
    joined = bool(np.all(np.diff(approach) > 0.0))
    style = {"color": DARK, "lw": 1.4, "ls": "-" if joined else "", "ms": 4}
    style["marker"] = "o" if len(approach) <= 60 or not joined else ""
    upper.plot(approach, rebound, label="contact", **style)
    lower.plot(approach, delay, **style)
    lower.axhline(0.0, color=GRID, lw=0.8)
    if captured.any():
        style = {"color": ACCENT, "ms": 7, "label": "captured", "clip_on": False}
        upper.plot(approach[captured], np.zeros(captured.sum()), "x", **style)
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
    return figure


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
    _draw_laws(left, laws)
    _draw_delay(right, delay)
    save(figure, path)


def law_figure(law: ContactLaw) -> Figure:
    """Return the picture of a law's relative errors, the left half of what `afm-jax collide --make-law` draws."""
    figure = new_figure(6.0, 5.0)
    _draw_laws(figure.subplots(), [law])
    return figure


def delay_figure(delay: ContactDelay) -> Figure:
    """Return the picture of a delay and its law, the right half of what `afm-jax collide --make-law` draws."""
    figure = new_figure(6.0, 5.0)
    _draw_delay(figure.subplots(), delay)
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
