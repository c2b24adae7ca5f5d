"""The Poincare section of a motion: phase of the drive and velocity at every departure."""

from pathlib import Path

import numpy as np

from afm_jax.motion.poincare_section import poincare_section
from afm_jax.plots.motion_window import Look
from afm_jax.plots.picture_style import GRID, label_axes, new_figure, save, with_zero_line


def draw_section(look: Look, path: Path) -> None:
    """Draw the section as a PNG file, the order in time as a shade."""
    section = poincare_section(look.scene, look.simulation)
    picture = new_figure(7.5, 5.4)
    axes = picture.subplots()
    phase, velocity = section.drive_phase_deg, section.departure_velocity_nm_per_us
    size = 30 if phase.size < 100 else 8
    axes.plot(phase[-1], velocity[-1], "o", color="black", markersize=11, fillstyle="none", label="the last one")
    shades = axes.scatter(phase, velocity, c=np.arange(1, phase.size + 1), s=size, cmap="viridis_r", zorder=3)
    bar = picture.colorbar(shades, ax=axes)
    bar.set_label("contact", fontsize=11)
    label_axes(axes, x="phase of the drive at departure (degrees)", y="departure velocity (nm/µs)")
    axes.set(xlim=(0.0, 360.0), xticks=range(0, 361, 60))
    axes.grid(color=GRID, alpha=0.25)
    if velocity.min() < 0.0 < velocity.max():
        with_zero_line(axes)
    axes.legend(loc="best", fontsize=10, framealpha=1.0)
    axes.set_title(f"Poincaré section, {phase.size} departures", fontsize=12, loc="left")
    save(picture, path)
