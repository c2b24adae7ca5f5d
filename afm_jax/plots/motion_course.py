"""The time course of a motion: tip and platform over the last contacts, the peaks of all flights, the force."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from afm_jax.contact.contact import Contact
from afm_jax.motion.record import ContactKind
from afm_jax.plots.motion_window import Look, shade_phases
from afm_jax.plots.picture_style import ACCENT, BLUE, GRID, label_axes, new_figure, save, with_zero_line
from afm_jax.study.flight_peaks import peaks_between_contacts

_MANY = 12
"""Contacts from which on the peaks of all flights are shown besides."""


def draw_course(look: Look, path: Path) -> None:
    """Draw the time course as a PNG file."""
    overview = int(look.used.sum()) >= _MANY
    picture = new_figure(9.0, 7.0 if overview else 4.6)
    axes = picture.subplots(1 + overview, 1, squeeze=False)[:, 0]
    _course(axes[0], look)
    if overview:
        _peaks(axes[1], look)
    save(picture, path)


def _course(axes: Axes, look: Look) -> None:
    time = look.path.time_us
    axes.plot(time, look.path.position_nm, color="black", linewidth=1.6, label="tip")
    if look.scene.interaction is not None:
        platform = np.asarray(look.scene.platform.position(time))
        axes.plot(time, platform, color=ACCENT, linewidth=1.4, label="platform")
    if look.scene.base is not None:
        base = np.asarray(look.scene.base.position_and_velocity(time)[0])
        axes.plot(time, base, "--", color=BLUE, linewidth=1.2, label="base")
    shade_phases(axes, look.path, look.scene.interaction)
    with_zero_line(axes)
    axes.set_xlim(look.from_us, look.to_us)
    # room for the legend above the curves
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.22 * (high - low))
    label_axes(axes, x="time (µs)", y="height (nm)")
    axes.legend(loc="upper right", fontsize=10, ncols=5, framealpha=1.0)
    axes.set_title(_title(look), fontsize=12, loc="left")


def _title(look: Look) -> str:
    if not look.touched:
        what = "the tip never meets the sample" if look.scene.interaction is not None else "a free cantilever"
        return f"Last periods; {what}"
    held = bool(look.simulation.held) and not np.isfinite(look.departure_us[-1])
    return f"The last contacts of {int(look.used.sum())}" + (", the tip held in the last one" if held else "")


def _peaks(axes: Axes, look: Look) -> None:
    """Draw the peak after each contact over the whole motion, and mark the stretch above."""
    peaks = peaks_between_contacts(look.scene, look.simulation)
    kind = np.asarray(look.contacts.kind)[look.used]
    time = look.arrival_us[: peaks.size]
    left = kind[: peaks.size] != ContactKind.HELD
    axes.plot(time[left], peaks[left], ".", color=BLUE, markersize=4.0)
    axes.axvspan(look.from_us, look.to_us, color=GRID, alpha=0.4, linewidth=0, label="shown above")
    with_zero_line(axes)
    what = "contact" if isinstance(look.scene.interaction, Contact) else "impact"
    label_axes(axes, x="time (µs)", y=f"peak after each {what} (nm)")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.15 * (high - low))
    axes.legend(loc="upper right", fontsize=10, framealpha=1.0)
