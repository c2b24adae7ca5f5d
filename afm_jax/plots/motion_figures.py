"""Pictures of figures 8, 10 and 11: the Poincare section, and motions under a slowly rising offset."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, save, with_zero_line
from afm_jax.study.motion_figures import SECTION_POINTS, MotionFigure
from afm_jax.study.section_survey import SHOWN, Course
from afm_jax.study.slow_ramps import Ramp

_COLOURS = dict(zip(SHOWN, (BLUE, ACCENT, "black"), strict=True))


def draw_motion_figure(number: str, figure: MotionFigure, path: Path) -> None:
    """Draw figure 8, 10 or 11 as a PNG file."""
    if number == "8":
        _section(figure, path)
    else:
        _ramps(number, figure, path)


def _section(figure: MotionFigure, path: Path) -> None:
    picture = new_figure(10.0, 8.6)
    grid = picture.add_gridspec(2, 2, height_ratios=[1.5, 1.0], width_ratios=[1.7, 1.0])
    broad, band, peaks = (picture.add_subplot(place) for place in (grid[0, 0], grid[0, 1], grid[1, :]))
    _broadband(broad, figure)
    attractor = next(course for course in figure.courses if course.velocity_nm_per_us == SHOWN[-1])
    _band(band, attractor)
    for course in _shown(figure):
        colour = _COLOURS[course.velocity_nm_per_us]
        count = np.arange(course.motion.peak_height_nm.size)
        label = f"start at {course.velocity_nm_per_us:g} nm/µs"
        peaks.plot(count, course.motion.peak_height_nm, ".", color=colour, markersize=3.0, label=label)
        if course.periods is not None:
            peaks.axvline(course.broadband, color=colour, linewidth=1.0, linestyle=(0, (3, 2)))
    label_axes(peaks, x="impact", y="peak height (nm)")
    peaks.set_xlim(left=0)
    peaks.set_ylim(0.0, 1.28 * max(float(np.nanmax(course.motion.peak_height_nm)) for course in figure.courses))
    peaks.grid(color=GRID, alpha=0.25)
    peaks.legend(loc="upper right", fontsize=10, ncols=3, markerscale=3, framealpha=1.0)
    growth = (
        "" if figure.growth is None else f"; growth exponent {figure.growth.exponent[-1]:.2f} per impact until then"
    )
    peaks.set_title(
        f"Peak after each impact; dashed: from here on locked to the drive{growth}", fontsize=11, loc="left"
    )
    save(picture, path)


def _shown(figure: MotionFigure) -> list[Course]:
    return [course for course in figure.courses if course.velocity_nm_per_us in _COLOURS]


def _broadband(axes: Axes, figure: MotionFigure) -> None:
    """Draw the section of the broadband stretches, first those of two starts, up to the paper's 1000 points."""
    left = SECTION_POINTS
    for course in figure.courses[:2]:
        left -= _stretch(
            axes, course, left, _COLOURS[course.velocity_nm_per_us], f"{course.velocity_nm_per_us:g} nm/µs"
        )
    label: str | None = "other starts"
    for course in figure.courses[2:]:
        if left > 0:
            left -= _stretch(axes, course, left, GRID, label)
            label = None
    label_axes(axes, x="phase of the drive at departure (degrees)", y="departure velocity (nm/µs)")
    axes.set(xlim=(0.0, 360.0), xticks=range(0, 361, 60))
    with_zero_line(axes)
    axes.legend(loc="lower right", fontsize=10, markerscale=3, framealpha=1.0, title="start")
    axes.set_title(f"Broadband: {SECTION_POINTS - max(left, 0)} impacts before locking", fontsize=11, loc="left")


def _stretch(axes: Axes, course: Course, most: int, colour: str, label: str | None) -> int:
    count = min(course.broadband, max(most, 0))
    phase, velocity = course.motion.drive_phase_deg, course.motion.departure_velocity_nm_per_us
    behind = 1 if colour == GRID else 2
    axes.plot(phase[:count], velocity[:count], ".", color=colour, markersize=3.0, label=label, zorder=behind)
    return count


def _band(axes: Axes, course: Course) -> None:
    """Draw the end of a motion, its order in time as a shade."""
    after = slice(course.broadband, None)
    phase, velocity = course.motion.drive_phase_deg[after], course.motion.departure_velocity_nm_per_us[after]
    axes.plot(phase, velocity, "-", color=GRID, linewidth=0.4)
    shades = axes.scatter(phase, velocity, c=np.arange(phase.size), s=8, cmap="viridis_r", zorder=3)
    bar = axes.figure.colorbar(shades, ax=axes, location="bottom", pad=0.02)
    bar.set_label("impacts since locking", fontsize=10)
    label_axes(axes, x="phase (degrees)", y="")
    axes.grid(color=GRID, alpha=0.25)
    order = "not locked" if course.periods is None else f"(1,{course.periods}) orbit"
    end = course.motion.peak_height_nm[np.isfinite(course.motion.peak_height_nm)][-1]
    axes.set_title(f"From {course.velocity_nm_per_us:g} nm/µs: {order}, {end:.1f} nm", fontsize=11, loc="left")


def _ramps(number: str, figure: MotionFigure, path: Path) -> None:
    picture = new_figure(8.5, 8.0)
    above, below = picture.subplots(2, 1, height_ratios=[1.0, 1.0])
    shown = figure.ramps[0] if number == "10" else figure.ramps[-1]
    _trajectory(above, shown)
    for ramp, colour, style in zip(figure.ramps, (BLUE, ACCENT), ("-", "--"), strict=False):
        label = f"peak, ramp of {ramp.rate_nm_per_us:g} nm/µs"
        below.plot(ramp.offset_nm, ramp.motion.peak_height_nm, style, color=colour, linewidth=1.8, label=label)
        held = ramp.motion.held_from_us
        if held is not None:
            where = ramp.offset_at(held)
            below.plot(where, 0.0, "v", color=colour, markersize=8, label=f"sticks at {where:.2f} nm", clip_on=False)
    slow = figure.ramps[-1]
    order = np.argsort(slow.offset_nm)
    label = "stable orbit of the impact law with delay"
    below.plot(
        slow.offset_nm[order], slow.law_peak_nm[order], "-", color="black", linewidth=3.0, alpha=0.35, label=label
    )
    label_axes(below, x=r"tip-sample offset $\sigma$ (nm)", y="peak height (nm)")
    below.grid(color=GRID, alpha=0.25)
    # room for the legend where the curves are high
    below.set_ylim(0.0, 100.0 if number == "10" else None)
    below.legend(loc="upper right" if number == "10" else "upper left", fontsize=10, framealpha=1.0)
    name = {"10": "below", "11": "above"}[number]
    platform = shown.motion.scene.platform
    n = float(platform.frequency_khz) / (2.0 * float(shown.motion.scene.cantilever.frequency_khz))
    above.set_title(
        rf"Rising offset {name} resonance: $n$ = {n:g}, $\beta$ = {float(platform.amplitude_nm):g} nm; "
        f"{shown.rate_nm_per_us:g} nm/µs",
        fontsize=12,
        loc="left",
    )
    save(picture, path)


def _trajectory(axes: Axes, ramp: Ramp) -> None:
    """Draw the tip against the offset; a tip that is held rides on the platform."""
    motion, platform = ramp.motion, ramp.motion.scene.platform
    time, height = motion.path()
    offset = np.array([ramp.offset_at(0.0), ramp.offset_at(1.0)])
    first, rate = offset[0], offset[1] - offset[0]
    axes.plot(first + rate * time, height, color=BLUE, linewidth=0.3, label="tip in flight")
    reach = float(platform.amplitude_nm)
    ends = np.array([motion.begin_us, motion.end_us])
    middle = first + rate * ends
    axes.fill_between(middle, middle - reach, middle + reach, color=ACCENT, alpha=0.45, linewidth=0, label="platform")
    if motion.held_from_us is not None:
        held = first + rate * motion.held_from_us
        axes.annotate(
            "the sample holds the tip,\nwhich rides on the platform",
            (0.5 * (held + middle[1]), middle.mean() + reach),
            (0.5 * (held + middle[1]), 0.45 * float(height.max())),
            ha="center",
            color=DARK,
            arrowprops={"arrowstyle": "-", "color": DARK, "linewidth": 0.8},
        )
    axes.grid(color=GRID, alpha=0.25)
    axes.set_xlim(middle[0], middle[1])
    label_axes(axes, x=r"tip-sample offset $\sigma$ (nm)", y="height (nm)")
    legend = axes.legend(
        loc="upper left" if motion.held_from_us is None else "upper right", fontsize=10, framealpha=1.0
    )
    for line in legend.get_lines():
        line.set_linewidth(2.0)
