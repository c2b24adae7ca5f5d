"""Pictures of the paper's figures, its numbers marked.

2, 3 and 9: where orbits are stable, and their amplitudes. 4 and 5: the contact's forces. 6 and 7: its impact law, and
one impact in time. 8, 10 and 11: the Poincare section, and motions under a slowly rising offset.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from afm_jax.contact.junction import Phase
from afm_jax.dynamics.charts import OffsetAmplitudes
from afm_jax.paper.charts import FigureData, adhesion_limit_nm
from afm_jax.paper.contact_figures import FIT_RANGE, PAPER, SMALL_GAP_NM, ContactFigure
from afm_jax.paper.motion_figures import SECTION_POINTS, SHOWN, MotionFigure, Ramp, RampCourse
from afm_jax.plots.charts import draw_offset_amplitudes, draw_stability_chart
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure, save, with_zero_line
from afm_jax.scenefile import presets


def draw_figure(number: str, figure: FigureData | ContactFigure | MotionFigure, path: Path) -> None:
    """Draw a figure of the paper as a PNG file."""
    if isinstance(figure, ContactFigure):
        {"4": _forces, "5": _hysteresis, "6": _law, "7": _course}[number](figure, path)
    elif isinstance(figure, MotionFigure) and number == "8":
        _section(figure, path)
    elif isinstance(figure, MotionFigure):
        _ramps(number, figure, path)
    elif isinstance(figure.data, OffsetAmplitudes):
        draw_offset_amplitudes(figure.data, path, title=_AMPLITUDE_TITLE)
    else:
        draw_stability_chart(
            figure.data,
            path,
            title=_CHART_TITLES[number],
            compared_with=figure.compared_with,
            limit_nm=adhesion_limit_nm(figure.data.x_values) if number == "3" else None,
        )


_CHART_CONDITIONS = rf"$r$ = {presets.STABILITY_R:g}, $\sigma = {presets.STABILITY_OFFSET_NM:g}$ nm"
_CHART_TITLES = {
    "2": rf"Stable single-impact orbits (light), {_CHART_CONDITIONS}, $\epsilon$ = 0",
    "3": rf"Stable single-impact orbits with adhesion (light), {_CHART_CONDITIONS}, "
    rf"$\epsilon$ = {presets.ADHESION:g} $\mu$J/kg",
}
_AMPLITUDE_TITLE = (
    r"Amplitude of the stable (1,1) orbit, "
    rf"$\beta$ = {presets.OFFSET_SWEEP_AMPLITUDE_NM:g} nm, $\epsilon$ = {presets.ADHESION:g} $\mu$J/kg"
)


def _law(figure: ContactFigure, path: Path) -> None:
    """Draw figure 6 as a PNG file: the impact law with its fit above, the residuals of two fits below."""
    picture = new_figure(7.5, 7.0)
    axes, below = picture.subplots(2, 1, sharex=True, height_ratios=[2.0, 1.0])
    _laws(axes, figure)
    axes.set(xlim=(0.0, FIT_RANGE[1]), ylim=(0.0, FIT_RANGE[1]))
    label_axes(axes, x="", y=r"rebound speed  $u_{out}$ (nm/µs)")
    axes.grid(color=GRID, alpha=0.25)
    axes.legend(loc="upper left", fontsize=11, framealpha=1.0)
    axes.set_title("Impact law of the contact", fontsize=12, loc="left")
    capture = figure.numbers["capture_speed_nm_per_us"]
    _cutoff(axes, figure)
    _residuals(below, figure)
    for panel in (axes, below):
        panel.axvline(capture, color=DARK, linewidth=1.2, linestyle=":")
    save(picture, path)


def _laws(axes: Axes, figure: ContactFigure) -> None:
    columns, numbers = figure.columns, figure.numbers
    speed = columns["approach_speed_nm_per_us"]
    fitted = (
        rf"eq. 6: $r$ = {numbers['r']:.4f}, $\epsilon$ = {numbers['epsilon']:.0f} nm²/µs² "
        f"(paper: {PAPER['r']:g}, {PAPER['epsilon']:g})"
    )
    axes.plot(speed, speed, color=GRID, linewidth=1.2, label="no loss")
    axes.plot(speed, columns["rebound_speed_nm_per_us"], color="black", linewidth=2.4, label="contact model")
    axes.plot(speed, columns["law_nm_per_us"], "--", color=ACCENT, linewidth=1.6, label=fitted)


def _cutoff(axes: Axes, figure: ContactFigure) -> None:
    """Draw the law close to the cutoff larger."""
    capture = figure.numbers["capture_speed_nm_per_us"]
    inset = axes.inset_axes((0.60, 0.09, 0.37, 0.42))
    _laws(inset, figure)
    inset.axvline(capture, color=DARK, linewidth=1.2, linestyle=":")
    inset.annotate(
        f"capture below\n{capture:.2f} nm/µs\n(paper: {PAPER['capture_nm_per_us']:g})",
        (0.04, 0.95),
        xycoords="axes fraction",
        color=DARK,
        fontsize=9,
        va="top",
    )
    inset.set(xlim=(5.0, 25.0), ylim=(0.0, 25.0))
    inset.tick_params(labelsize=8)
    inset.grid(color=GRID, alpha=0.25)
    axes.indicate_inset_zoom(inset, edgecolor=DARK, linewidth=0.8)


def _residuals(axes: Axes, figure: ContactFigure) -> None:
    columns, numbers = figure.columns, figure.numbers
    speed, rebound = columns["approach_speed_nm_per_us"], columns["rebound_speed_nm_per_us"]
    fitted = (speed >= FIT_RANGE[0]) & (speed <= FIT_RANGE[1])
    linear = numbers["linear_loss"]
    share = 100.0 * numbers["worst_error_of_top_speed"]
    labels = {
        "law_nm_per_us": f"eq. 6: at worst {numbers['worst_error_nm_per_us']:.2f} nm/µs, "
        f"{share:.2f} % of the top speed",
        "linear_loss_nm_per_us": rf"$u_{{out}}^2 = u_{{in}}^2 - {linear['viscous_loss']:.2f}\,u_{{in}} - "
        rf"{linear['epsilon']:.0f}$: at worst {linear['worst_error_nm_per_us']:.2f} nm/µs",
    }
    for (name, label), colour, style in zip(labels.items(), (ACCENT, BLUE), ("--", "-"), strict=True):
        residual = columns[name][fitted] - rebound[fitted]
        axes.plot(speed[fitted], residual, style, color=colour, linewidth=1.8, label=label)
    with_zero_line(axes)
    axes.set_ylim(-0.29, 0.1)
    label_axes(axes, x=r"approach speed  $u_{in}$ (nm/µs)", y="fit $-$ model (nm/µs)")
    axes.legend(loc="lower right", fontsize=10, framealpha=1.0)


def _course(figure: ContactFigure, path: Path) -> None:
    """Draw figure 7 as a PNG file: the distance against time beside that of an instantaneous impact."""
    picture = new_figure(8.0, 5.8)
    axes = picture.subplots()
    columns, numbers = figure.columns, figure.numbers
    time, arrival, rebound = columns["time_us"], numbers["arrival_us"], numbers["rebound_speed_nm_per_us"]
    leaving = arrival + numbers["collision_delay_us"]
    first, end = time[0], time[-1]
    _phases(axes, time, columns["phase"])
    axes.plot(time, columns["gap_nm"], color="black", linewidth=2.2, label="distance of the tip")
    straight = [numbers["approach_speed_nm_per_us"] * (arrival - first), 0.0, rebound * (end - arrival)]
    axes.plot([first, arrival, end], straight, ":", color="black", linewidth=1.6, label="instantaneous impact")
    back = [0.0, rebound * (end - leaving)]
    axes.plot([leaving, end], back, "--", color=ACCENT, linewidth=1.2, label="straight path out, drawn back to 0")
    _times(axes, figure)
    with_zero_line(axes)
    axes.set(xlim=(first, end), ylim=(-2.9, 7.0))
    axes.set_yticks(range(8))
    label_axes(axes, x="time since the bridge formed (µs)", y="distance from the sample (nm)")
    # the order of the curves first; the V leaves no other place free
    axes.legend(loc="upper center", bbox_to_anchor=(0.47, 1.0), fontsize=10, framealpha=1.0)
    axes.set_title(f"One impact at {numbers['approach_speed_nm_per_us']:g} nm/µs", fontsize=12, loc="left")
    save(picture, path)


def _phases(axes: Axes, time: np.ndarray, phase: np.ndarray) -> None:
    """Shade the bridge and the junction."""
    wet, solid = (np.flatnonzero(phase == which) for which in (Phase.BRIDGE, Phase.JUNCTION))
    # of the free flight after contact the first point is where the bridge breaks
    ends = [float(time[place]) for place in (wet[0], solid[0], solid[-1], wet[-1] + 1)]
    for place, (colour, label) in enumerate(((BLUE, "liquid bridge"), (ACCENT, "solid junction"), (BLUE, None))):
        axes.axvspan(ends[place], ends[place + 1], color=colour, alpha=0.12, linewidth=0, label=label)


def _times(axes: Axes, figure: ContactFigure) -> None:
    """Draw lag, lead and delay as arrows below the sample's surface."""
    numbers = figure.numbers
    arrival, lag, lead = (numbers[name] for name in ("arrival_us", "lag_us", "lead_us"))
    delay = numbers["collision_delay_us"]
    arrows = (
        (-1.05, arrival, arrival + lag, f"lag {lag:.3f} µs (paper: {PAPER['lag_us']:g}): time in the junction"),
        (-1.75, arrival + lag, arrival + delay, f"lead {lead:.3f} µs (paper: {PAPER['lead_us']:g})"),
        (-2.45, arrival, arrival + delay, f"delay = lag $-$ lead = ${delay:.3f}$ µs"),
    )
    for height, start, stop, text in arrows:
        arrow = {"arrowstyle": "-|>", "color": ACCENT, "linewidth": 1.6, "shrinkA": 0.0, "shrinkB": 0.0}
        axes.annotate("", (stop, height), (start, height), arrowprops=arrow)
        axes.annotate(text, (arrival + lag + 0.015, height), color="black", va="center")
    for place, top in ((arrival, 0.0), (arrival + delay, 0.0), (arrival + lag, -0.8)):
        axes.plot([place, place], [-2.6, top], color=DARK, linewidth=0.8, linestyle=(0, (2, 2)))


_LEADER = {"arrowstyle": "-", "color": DARK, "linewidth": 0.8}


def _forces(figure: ContactFigure, path: Path) -> None:
    picture = new_figure(7.5, 5.2)
    axes = picture.subplots()
    columns, numbers = figure.columns, figure.numbers
    gap = columns["gap_nm"]
    for name, (style, equation) in _FORCES.items():
        label = f"{name} (eq. {equation})"
        axes.plot(gap, columns[f"{name}_nn"], style, color=BLUE, linewidth=1.8, label=label)
    axes.plot(gap, columns["sum_nn"], color="black", linewidth=2.2, label="sum")
    axes.axvspan(0.0, SMALL_GAP_NM, color=ACCENT, alpha=0.10, linewidth=0)
    axes.annotate(
        f"stiff below about {SMALL_GAP_NM:g} nm,\nrepulsive below {numbers['repulsive_below_nm']:.3f} nm",
        (SMALL_GAP_NM, 64.0),
        (0.55, 64.0),
        color=DARK,
        va="center",
        arrowprops=_LEADER,
    )
    forms = numbers["bridge_forms_nm"]
    axes.axvline(forms, color=DARK, linewidth=1.2, linestyle=(0, (1, 2)))
    axes.annotate(f"bridge forms\nat {forms:g} nm", (forms + 0.06, 64.0), color=DARK, va="center")
    with_zero_line(axes)
    axes.set(xlim=(0.0, 4.5), ylim=(-100.0, 80.0))
    label_axes(axes, x="gap $D$ (nm)", y="force (nN)")
    axes.legend(loc="lower right", fontsize=11, framealpha=1.0)
    axes.set_title("Static forces of the liquid bridge", fontsize=12, loc="left")
    save(picture, path)


_FORCES = {"capillary": ("--", 10), "structural": ("-.", 13), "core": (":", 14)}


def _hysteresis(figure: ContactFigure, path: Path) -> None:
    picture = new_figure(8.0, 5.8)
    axes = picture.subplots()
    gap, force, leg = (figure.columns[name] for name in ("gap_nm", "force_nn", "leg"))
    numbers = figure.numbers
    forms, breaks = numbers["bridge_forms_nm"], numbers["bridge_breaks_nm"]
    # closed along the dry gap between the breaking and the forming of the bridge, where the force is 0
    axes.fill(np.append(gap, [breaks, forms]), np.append(force, [0.0, 0.0]), color=BLUE, alpha=0.12, linewidth=0)
    _ways(axes, figure)
    for place in (forms, breaks):
        axes.plot([place, place], [0.0, force[np.argmin(np.abs(gap - place))]], ":", color=DARK, linewidth=1.4)
    for place, text in ((forms, "forms"), (breaks, "breaks")):
        axes.annotate(f"bridge {text}\nat {place:g} nm", (place, 3.0), color=DARK, ha="center")
    snap_off = int(np.flatnonzero(leg == 2)[-1])
    off = numbers["breaks_gap_nm"]
    axes.plot([off, off], [force[snap_off], force[snap_off + 1]], ":", color=DARK, linewidth=1.4)
    axes.plot(off, force[snap_off], "o", color="black", markersize=5)
    axes.annotate(
        f"JKR instability at {off:.3f} nm", (off, force[snap_off]), (0.85, -97.0), color=DARK, arrowprops=_LEADER
    )
    axes.annotate(
        f"hysteresis (shaded) {numbers['hysteresis_aj']:.2f} aJ (paper: {PAPER['hysteresis_aj']:g} aJ)\n"
        f"bridge {numbers['bridge_hysteresis_aj']:.2f} aJ + junction {numbers['junction_hysteresis_aj']:.2f} aJ",
        (1.6, -72.0),
        color="black",
    )
    with_zero_line(axes)
    axes.set(xlim=(-0.3, 5.4), ylim=(-150.0, 85.0))
    label_axes(axes, x="gap $D$ (nm)", y="static force (nN)")
    axes.legend(loc="lower right", fontsize=11)
    axes.set_title("Loading and unloading", fontsize=12, loc="left")
    _snap_on(axes, figure)
    save(picture, path)


def _ways(axes: Axes, figure: ContactFigure) -> None:
    """Draw loading wide and unloading narrow, so that both show where they coincide."""
    gap, force, leg = (figure.columns[name] for name in ("gap_nm", "force_nn", "leg"))
    for legs, colour, width, label in (((0, 1), BLUE, 4.5, "loading"), ((2, 3), ACCENT, 1.6, "unloading")):
        for part in legs:
            chosen = leg == part
            name = label if part == legs[0] else None
            axes.plot(gap[chosen], force[chosen], color=colour, linewidth=width, label=name)


def _snap_on(axes: Axes, figure: ContactFigure) -> None:
    """Draw the surroundings of the junction's formation larger: there the curves touch, and nothing jumps."""
    numbers = figure.numbers
    place, height = numbers["forms_gap_nm"], numbers["force_at_snap_on_nn"]
    inset = axes.inset_axes((0.19, 0.685, 0.33, 0.295))
    _ways(inset, figure)
    inset.plot(place, height, "o", color="black", markersize=5)
    inset.annotate(
        f"junction forms\nat {place:.4f} nm\n(paper: {PAPER['forms_gap_nm']:g} nm)",
        (place, height),
        (0.142, -4.0),
        color=DARK,
        fontsize=9,
        va="center",
        arrowprops=_LEADER,
    )
    inset.set(xlim=(0.09, 0.2), ylim=(-50.0, 10.0))
    inset.tick_params(labelsize=8)
    inset.grid(color=GRID, alpha=0.25)
    axes.indicate_inset_zoom(inset, edgecolor=DARK, linewidth=0.8)


_COLOURS = dict(zip(SHOWN, (BLUE, ACCENT, "black"), strict=True))


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


def _shown(figure: MotionFigure) -> list[RampCourse]:
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


def _stretch(axes: Axes, course: RampCourse, most: int, colour: str, label: str | None) -> int:
    count = min(course.broadband, max(most, 0))
    phase, velocity = course.motion.drive_phase_deg, course.motion.departure_velocity_nm_per_us
    behind = 1 if colour == GRID else 2
    axes.plot(phase[:count], velocity[:count], ".", color=colour, markersize=3.0, label=label, zorder=behind)
    return count


def _band(axes: Axes, course: RampCourse) -> None:
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
    above, below = picture.subplots(2, 1, sharex=True)
    shown = figure.ramps[0] if number == "10" else figure.ramps[-1]
    colours = dict(zip((ramp.rate_nm_per_us for ramp in figure.ramps), (BLUE, ACCENT), strict=False))
    _trajectory(above, shown, colours[shown.rate_nm_per_us])
    for ramp, colour, style in zip(figure.ramps, colours.values(), ("-", "--"), strict=False):
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


def _trajectory(axes: Axes, ramp: Ramp, colour: str) -> None:
    """Draw what the tip sweeps against the offset, from contact to peak; a tip that is held rides on the platform."""
    motion, platform = ramp.motion, ramp.motion.scene.platform
    offset = np.array([ramp.offset_at(0.0), ramp.offset_at(1.0)])
    first, rate = offset[0], offset[1] - offset[0]
    # hundreds of flights side by side would be no lines but moire
    time, height = motion.departure_time_us, motion.peak_height_nm
    touched = np.asarray(platform.position_and_velocity(jnp.asarray(time))[0])
    label = "tip, from its contacts to its peaks"
    axes.fill_between(first + rate * time, touched, height, color=colour, alpha=0.55, linewidth=0.0, label=label)
    reach = float(platform.amplitude_nm)
    ends = np.array([motion.begin_us, motion.end_us])
    middle = first + rate * ends
    axes.fill_between(middle, middle - reach, middle + reach, color=DARK, alpha=0.6, linewidth=0, label="platform")
    if motion.held_from_us is not None:
        held = first + rate * motion.held_from_us
        axes.annotate(
            "the sample holds the tip,\nwhich rides on the platform",
            (0.5 * (held + middle[1]), middle.mean() + reach),
            (0.5 * (held + middle[1]), 0.45 * float(np.nanmax(height))),
            ha="center",
            color=DARK,
            arrowprops={"arrowstyle": "-", "color": DARK, "linewidth": 0.8},
        )
    axes.grid(color=GRID, alpha=0.25)
    axes.set_xlim(middle[0], middle[1])
    label_axes(axes, x="", y="height (nm)")
    legend = axes.legend(
        loc="upper left" if motion.held_from_us is None else "upper right", fontsize=10, framealpha=1.0
    )
    for line in legend.get_lines():
        line.set_linewidth(2.0)
