"""Pictures of a simulated motion: its course in time, its contacts, its Poincare section and its spectrum."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.apparatus.scene import DrivePeriod, Scene, drive_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import ContactPhase, find_junction
from afm_jax.motion.observe import poincare_section
from afm_jax.motion.record import Simulation, contacts_of
from afm_jax.motion.settle import Settled, is_stuck, settled, slower_period_us, window_of
from afm_jax.motion.trajectory import DensePath, Trajectory
from afm_jax.plots.picture_style import (
    ACCENT,
    BLUE,
    DARK,
    GRID,
    label_axes,
    new_panels,
    save,
)

_CONTACTS_SHOWN = 6
_PERIODS_SHOWN = 6.0
"""Of the slower of drive and free vibration, where there are no contacts."""
_POINTS = 3000
_BESIDE_US = 1e-7
"""How far before and after a jump its two sides are looked at."""
_LONGEST_HELD = 4.0
"""Drive periods of a held tip that are shown: it is integrated step by step."""
_CURVES = 3
_GAP_SHOWN_NM = 6.0
_STROKES = ((GRID, 5.0), ("#56B4E9", 3.2), ("black", 1.4))
"""Wide below narrow, so that loops that coincide all show."""
_MARKS = {
    "bridge breaks": (BLUE, (0, (1, 2))),
    "bridge forms": (BLUE, "--"),
    "junction breaks": (ACCENT, (0, (1, 2))),
    "junction forms": (ACCENT, "--"),
}
"""Colour and line of the gaps at which the phase of a contact changes."""
_MOST_PERIODS = 60
"""Of the drive; each contact in them is integrated once more."""
_SAMPLES_PER_PERIOD = 32
_HIGHEST = 8.0
"""Multiples of the response frequency, or of the impacts' near twice the free one, that are shown at least."""
_DECADES = 1e-6


def draw_motion(
    scene: Scene,
    simulation: Simulation,
    folder: Path,
    *,
    verdict: Settled | None = None,
    dense: DensePath | None = None,
) -> list[Path]:
    """Draw what there is to see of a motion, as PNG files.

    Always the time course and the spectrum; with contacts the Poincare section, and of resolved contacts the force
    against the gap.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene, not of a batch.
        folder: exists and can be written to.
        verdict: what `settled` said, if it is known already.
        dense: the tip at any time, if that is at hand.

    Returns:
        The files, in the order above.

    Raises:
        ValueError: if the simulation is a batch, or did not get beyond its start.
    """
    look = look_at(scene, simulation, verdict=verdict, dense=dense)
    figures = {"time_course": course_figure, "spectrum": spectrum_figure}
    if np.isfinite(look.dense.contacts.departure_time_us).any():
        figures |= {"poincare": section_figure}
    if look.dense.contacts.kind.size and isinstance(scene.interaction, Contact):
        figures |= {"force_gap": force_gap_figure}
    files = []
    for name, figure in figures.items():
        files.append(folder / f"{name}.png")
        save(figure(look), files[-1])
    return files


class Responses(NamedTuple):
    """The last response periods of a motion, whole ones where it is long enough."""

    repeats: bool
    response_us: float
    """N drive periods; one where nothing repeats."""
    periods: int
    """Response periods in the stretch."""
    from_us: float
    to_us: float


def _responses_shown(scene: Scene, simulation: Simulation, verdict: Settled, to_us: float) -> Responses:
    """Return the response periods that the spectrum is made of, of a tip that is held until `to_us`."""
    drive = drive_of(scene)
    repeats = verdict.settled and not verdict.stuck
    response = (verdict.periods or 1) * drive.period_us if repeats else drive.period_us
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    if repeats:
        last = window_of(scene, simulation, verdict).to_us
    elif verdict.stuck:
        last = to_us
    # only what has settled repeats: the last fifth at most
    room = (last - first) * (0.2 if repeats and verdict.contacts else 0.8)
    periods = int(np.clip(room / response, 1, max(1, _MOST_PERIODS // (verdict.periods or 1))))
    return Responses(repeats, response, periods, last - min(periods * response, last - first), last)


class Look(NamedTuple):
    """A simulation and the stretch of it that is shown."""

    dense: DensePath
    """The tip at any time."""
    drive: DrivePeriod
    responses: Responses
    """What the spectrum is made of."""
    from_us: float
    to_us: float
    path: Trajectory
    """Over the stretch, fine enough for its contacts."""

    @property
    def scene(self) -> Scene:
        """The scene that was simulated."""
        return self.dense.scene

    def between(self, from_us: float, to_us: float) -> Trajectory:
        """Return the part of the path between two times."""
        inside = (self.path.time_us >= from_us) & (self.path.time_us <= to_us)
        return Trajectory(*(column[inside] for column in self.path))


def look_at(
    scene: Scene, simulation: Simulation, *, verdict: Settled | None = None, dense: DensePath | None = None
) -> Look:
    """Return the last contacts of a motion, or its last periods, ready to be drawn.

    Args:
        scene: the scene that was simulated.
        simulation: of one scene.
        verdict: what `settled` said, if it is known already.
        dense: the tip at any time, if that is at hand.

    Raises:
        ValueError: if the simulation is a batch, or did not get beyond its start.
    """
    begin, end = _course_shown(scene, simulation)
    verdict = settled(scene, simulation) if verdict is None else verdict
    dense = DensePath(scene, simulation) if dense is None else dense
    rows, times = dense.contacts, np.linspace(begin, end, _POINTS)
    if rows.kind.size:
        # where the phase of contact changes the force jumps, and the velocity of a law
        jumps = [rows.arrival_time_us, rows.departure_time_us]
        if rows.detail is not None:
            jumps += [rows.detail.junction_forms_us, rows.detail.junction_breaks_us]
        edges = np.concatenate(jumps)
        edges = edges[(edges > begin + _BESIDE_US) & (edges < end - _BESIDE_US)]
        times = np.unique([*times, *dense.nodes(begin, end)[0], *edges - _BESIDE_US, *edges, *edges + _BESIDE_US])
    responses = _responses_shown(scene, simulation, verdict, end)
    return Look(dense, drive_of(scene), responses, begin, end, dense.at(times))


def _course_shown(scene: Scene, simulation: Simulation) -> tuple[float, float]:
    """Return beginning and end, in us, of the last contacts of a motion, or of its last periods."""
    if np.ndim(simulation.count):
        raise ValueError("a picture is of one simulation: pick one of the batch")
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    if not last > first:
        raise ValueError("the simulation did not get beyond its start: there is nothing to draw")
    rows, period = contacts_of(simulation), slower_period_us(scene)
    arrival, begin, end = rows.arrival_time_us, last - _PERIODS_SHOWN * period, last
    if arrival.size:
        if not np.isfinite(rows.departure_time_us[-1]):
            end = min(last, float(arrival[-1]) + _LONGEST_HELD * period)
        shown = float(arrival[-min(_CONTACTS_SHOWN, arrival.size)])
        begin = min(shown - 0.3 * period, end - 2.0 * period)
    return max(begin, first), end


def shade_phases(axes: Axes, path: Trajectory, contact: object) -> None:
    """Shade where the tip is in the bridge or in the junction, or held by the platform of a law."""
    joined = "solid junction" if isinstance(contact, Contact) else "held by the platform"
    for phase, colour, name in ((ContactPhase.BRIDGE, BLUE, "liquid bridge"), (ContactPhase.JUNCTION, ACCENT, joined)):
        inside = path.phase == phase
        if inside.any():
            style: dict[str, Any] = {"color": colour, "alpha": 0.18, "linewidth": 0, "label": name}
            axes.fill_between(path.time_us, 0, 1, where=inside, transform=axes.get_xaxis_transform(), **style)


def course_figure(look: Look) -> Figure:
    """Return the time course of the tip and of what drives it, with its contacts shaded."""
    picture, axes = new_panels(9.0, 4.6)
    time = look.path.time_us
    axes.plot(time, look.path.position_nm, color="black", linewidth=1.6, label="tip")
    if look.scene.interaction is not None:
        platform = np.asarray(look.scene.platform.position(time))
        axes.plot(time, platform, color=ACCENT, linewidth=1.4, label="platform")
    if look.scene.base is not None:
        base = np.asarray(look.scene.base.position_and_velocity(time)[0])
        axes.plot(time, base, "--", color=BLUE, linewidth=1.2, label="base")
    shade_phases(axes, look.path, look.scene.interaction)
    axes.axhline(0.0, color=GRID, linewidth=0.8)
    axes.set_xlim(look.from_us, look.to_us)
    # room for the legend above the curves
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.22 * (high - low))
    label_axes(axes, x="time (µs)", y="height (nm)")
    axes.legend(loc="upper right", fontsize=10, ncols=5, framealpha=1.0)
    count = len(look.dense.contacts.kind)
    what = f"The last contacts of {count}" if count else "Last periods"
    if is_stuck(look.scene, look.dense.simulation):
        what += ", the sample holds the tip"
    axes.set_title(what, fontsize=12, loc="left")
    return picture


def _around(look: Look, row: int) -> tuple[float, float]:
    """Return the times between which a contact is shown: from and to a gap of a few nm."""
    arrival = look.dense.contacts.arrival_time_us[row]
    departure = look.dense.contacts.departure_time_us[row]
    approach = max(float(look.dense.contacts.approach_speed_nm_per_us[row]), 1.0)
    lead = 0.4 * min(_GAP_SHOWN_NM / approach, 0.25 * look.drive.period_us)
    end = departure if np.isfinite(departure) else arrival + look.drive.period_us
    return min(arrival, end) - lead, max(arrival, end) + lead


def force_gap_figure(look: Look) -> Figure:
    """Return the force against the gap through the last contacts: all of it, and the attractive part."""
    picture, (whole, part) = new_panels(7.5, 9.0, 2, height_ratios=[1.0, 1.5])
    rows = np.arange(len(look.dense.contacts.kind))[-_CURVES:]
    least = 0.0
    for row, (colour, width) in zip(rows, _STROKES[-len(rows) :], strict=True):
        path_of_row = look.between(*_around(look, int(row)))
        lost = look.dense.contacts.energy_lost_aj[row]
        over = np.isfinite(look.dense.contacts.departure_time_us[row])
        label = f"contact {row + 1}: " + (f"{lost:.1f} aJ lost" if over else "not over")
        least = min(least, float(path_of_row.force_nn.min()))
        for axes in (whole, part):
            axes.plot(path_of_row.gap_nm, path_of_row.force_nn, color=colour, linewidth=width, label=label)
    contact, junction = look.scene.interaction, find_junction(look.scene.interaction)
    gaps = contact.bridge_breaks_nm, contact.bridge_forms_nm, junction.breaks_gap_nm, junction.forms_gap_nm
    for (name, (colour, dashes)), gap in zip(_MARKS.items(), gaps, strict=True):
        part.axvline(float(gap), color=colour, linewidth=1.0, linestyle=dashes, label=name)
    for axes in (whole, part):
        axes.axhline(0.0, color=GRID, linewidth=0.8)
        label_axes(axes, x="gap (nm)", y="force on the tip (nN)")
    whole.set_xlim(right=_GAP_SHOWN_NM)
    part.set(xlim=(-0.6, _GAP_SHOWN_NM), ylim=(1.1 * least - 5.0, -0.6 * least + 5.0))
    part.legend(loc="lower right", fontsize=10, framealpha=1.0)
    whole.set_title("Force against gap", fontsize=12, loc="left")
    part.set_title("the attractive part, with its loops", fontsize=12, loc="left")
    return picture


_LEAST_SHOWN = 0.02
"""Least height of the section's axis, either way, of the largest velocity."""


def section_figure(look: Look) -> Figure:
    """Return the Poincaré section, the order in time as a shade."""
    phase, rows = poincare_section(look.scene, look.dense.simulation)
    picture, axes = new_panels(7.5, 5.4)
    velocity = rows.departure_velocity_nm_per_us
    size = 30 if phase.size < 100 else 8
    axes.plot(phase[-1], velocity[-1], "o", color="black", markersize=11, fillstyle="none", label="the last one")
    shades = axes.scatter(phase, velocity, c=np.arange(1, phase.size + 1), s=size, cmap="viridis_r", zorder=3)
    picture.colorbar(shades, ax=axes, label="contact")
    label_axes(axes, x="phase of the drive at departure (degrees)", y="departure velocity (nm/µs)")
    axes.set(xlim=(0.0, 360.0), xticks=range(0, 361, 60))
    # what is left of a settled motion is rounding: the axis does not magnify it
    middle = 0.5 * float(velocity.max() + velocity.min())
    spread = 0.5 * float(velocity.max() - velocity.min())
    half = max(1.1 * spread, _LEAST_SHOWN * float(np.abs(velocity).max()))
    axes.set_ylim(middle - half, middle + half)
    axes.legend(loc="best", fontsize=10, framealpha=1.0)
    axes.set_title(f"Poincaré section, {phase.size} departures", fontsize=12, loc="left")
    return picture


def spectrum_of(look: Look) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """Return frequencies in kHz and amplitudes in nm of the waves that the deflection is made of.

    They are those of the last whole response periods, from equally spaced samples.

    The samples end with the last whole response period, so that a motion that repeats has lines without skirts; one
    that does not is weighted with a Hann window.

    Args:
        look: the motion.
    """
    shown = look.responses
    samples = shown.periods * _SAMPLES_PER_PERIOD * max(1, round(shown.response_us / look.drive.period_us))
    step = (shown.to_us - shown.from_us) / samples
    times = shown.from_us + step * np.arange(samples)
    deflection = look.dense.at(times).position_nm
    if look.scene.base is not None:
        deflection = deflection - np.asarray(look.scene.base.position_and_velocity(times)[0])
    weight = np.ones(samples) if shown.repeats else np.hanning(samples + 1)[:-1]
    # the window would smear the mean over the lowest lines
    mean = float(np.sum(weight * deflection) / weight.sum())
    amplitude = 2.0 * np.abs(np.fft.rfft((deflection - mean) * weight)) / weight.sum()
    amplitude[0] = abs(mean)
    return 1e3 * np.fft.rfftfreq(samples, step), amplitude


def spectrum_figure(look: Look) -> Figure:
    """Return the spectrum, with the drive, a second tone, the response and the free vibration marked."""
    (frequency, amplitude), repeats = spectrum_of(look), look.responses.repeats
    picture, axes = new_panels(9.0, 5.0)
    drive, response = 1e3 / look.drive.period_us, 1e3 / look.responses.response_us
    free, tones = float(look.scene.cantilever.frequency_khz), _further_tones_khz(look.scene, drive)
    right = max(_HIGHEST * min(response, 2.0 * free), 2.2 * drive, *(1.1 * tone for tone in tones))
    shown = (frequency > 0.0) & (frequency <= right)
    frequency, amplitude = frequency[shown], amplitude[shown]
    floor, top = max(float(amplitude.max()) * _DECADES, 1e-12), float(amplitude.max()) * 30.0
    if repeats:
        axes.vlines(frequency, floor, np.maximum(amplitude, floor), color="black", linewidth=1.2, zorder=3)
    else:
        axes.plot(frequency, np.maximum(amplitude, floor), color="black", linewidth=1.0, zorder=3)
    order = round(drive / response)
    marks: list[tuple[str, Any, dict[str, Any]]] = [
        ("drive and its harmonics", np.arange(drive, right, drive), {"color": ACCENT, "lw": 5.0, "alpha": 0.3}),
        (f"subharmonics, drive/{order}", np.arange(response, right, response), {"color": BLUE, "lw": 1.0, "ls": ":"}),
        ("second frequency", tones, {"color": "#009E73", "lw": 3.0, "ls": (0, (3, 1)), "alpha": 0.7}),
        ("free frequency", [free], {"color": DARK, "lw": 1.4, "ls": "--"}),
    ]
    for label, places, style in marks:
        if len(places) and (order > 1 or not label.startswith("sub")):
            axes.vlines(places, floor, top, label=label, **style)
    axes.set(xlim=(0.0, 1.02 * right), ylim=(floor, top), yscale="log")
    label_axes(axes, x="frequency (kHz)", y="amplitude (nm)")
    axes.legend(loc="upper right", fontsize=10, ncols=3, framealpha=1.0)
    periods = look.responses.periods
    kind = f"{periods} response periods" if repeats else f"{periods} drive periods, nothing repeats"
    axes.set_title(f"Spectrum of the deflection ({kind})", fontsize=12, loc="left")
    return picture


def _further_tones_khz(scene: Scene, drive_khz: float) -> list[float]:
    """Return the frequencies that drive a scene besides the drive's."""
    second = () if scene.platform.second is None else (scene.platform.second,)
    tones = (*second, *(tone for part in (scene.base, scene.force) if part is not None for tone in part.tones))
    frequencies = {float(tone.frequency_khz) for tone in tones if float(tone.amplitude) != 0.0}
    return sorted(one for one in frequencies if abs(one - drive_khz) > 1e-9 * drive_khz)
