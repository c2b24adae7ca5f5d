"""Pictures of what motions come to: orbits, exponents, bifurcation diagrams, charts of orbits, basins."""

import re
from typing import Any

import numpy as np
from jaxtyping import Bool
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from afm_jax.dynamics.basins import Basins
from afm_jax.dynamics.bifurcations import BifurcationDiagram, Ramps
from afm_jax.dynamics.charts import StabilityChart
from afm_jax.dynamics.exponents import Lyapunov
from afm_jax.dynamics.impact_orbits import ManyImpactOrbits
from afm_jax.dynamics.orbit_tables import OrbitTable
from afm_jax.dynamics.verdicts import MotionKind
from afm_jax.impact.orbits import SingleImpactOrbits
from afm_jax.plots.picture_style import (
    ACCENT,
    BLUE,
    DARK,
    GRID,
    SKY,
    cell_edges,
    label_axes,
    legend_once,
    new_panels,
)
from afm_jax.units import unit_of, words_of

KINDS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#8c6bb1", "#a6761d", "#999999")
"""Colours that stand apart for every kind of colour vision (Okabe and Ito's, and three more)."""
_ABOVE: dict[str, Any] = {"loc": "outside upper center", "ncols": 3, "fontsize": 11, "frameon": False}
"""The place of a figure's legend."""
_LABELS = {
    "platform.reduced_frequency": r"reduced drive frequency  $n = \omega/2\Omega$",
    "platform.amplitude_nm": r"drive amplitude  $\beta$ (nm)",
    "platform.offset_nm": r"tip-sample offset  $\sigma$ (nm)",
    "platform.frequency_khz": "drive frequency (kHz)",
    "cantilever.quality_factor": "quality factor  $Q$",
    "interaction.r": "coefficient of restitution  $r$",
    "interaction.epsilon": r"adhesion loss  $\epsilon$ (nm$^2$/$\mu$s$^2$)",
    "interaction.viscous_loss": r"viscous loss (nm/$\mu$s)",
}


def label_of(path: str) -> str:
    """Return what an axis says of a parameter, with its unit.

    >>> label_of("force.free_amplitude_nm"), label_of("interaction.adhesion_energy_j_per_m2")
    ('force free amplitude (nm)', 'adhesion energy (J/m$^2$)')
    """
    if path in _LABELS:
        return _LABELS[path]
    *tables, key = path.split(".")
    words, unit = words_of(key), unit_of(key).replace("us", r"$\mu$s")
    words = " ".join([*(table for table in tables[-1:] if table not in ("platform", "interaction")), words])
    unit = re.sub(r"\^(\d)", r"$^\1$", unit)
    return f"{words} ({unit})" if unit else words


def orbits_figure(orbits: SingleImpactOrbits | ManyImpactOrbits | OrbitTable) -> Figure:
    """Return the picture of orbits, of one scene or of many: where they hit, in their order, and how high they go."""
    orbits = orbits.orbits if isinstance(orbits, OrbitTable) else orbits
    reading = orbits.reading if isinstance(orbits, ManyImpactOrbits) else orbits
    peak = np.asarray(reading.peak_amplitude_nm, float).ravel()
    phase, velocity, approach = (
        np.asarray(getattr(reading, name), float).reshape(peak.size, -1 if peak.size else 1)
        for name in ("phase_rad", "velocity_after_nm_per_us", "approach_speed_nm_per_us")
    )
    admissible, stable = np.asarray(reading.admissible).ravel(), np.asarray(orbits.stable).ravel()
    figure, (impacts, heights) = new_panels(7.5, 8.0, 2)
    kinds = {
        "stable": (admissible & stable, {"marker": "o", "color": DARK}),
        "unstable": (admissible & ~stable, {"marker": "o", "color": BLUE, "markerfacecolor": "white"}),
        "not admissible": (~admissible, {"marker": "x", "color": ACCENT}),
    }
    # slots without an orbit hold NaN
    exists = np.isfinite(peak) & np.isfinite(phase).all(axis=1) & np.isfinite(velocity).all(axis=1)
    for label, (which, style) in kinds.items():
        chosen = np.flatnonzero(exists & which)
        size = 8.0 if chosen.size <= _FEW else 3.0
        own = {**style, "ms": size, "label": label}
        # a line an orbit
        impacts.plot(np.degrees(phase[chosen]).T, velocity[chosen].T, ls=":", lw=0.8, **own)
        heights.plot(np.max(approach[chosen], axis=1, initial=-np.inf), peak[chosen], ls="", **own)
    impacts.set(xlim=(0.0, 360.0), xticks=range(0, 361, 90))
    # one orbit alone would have an axis of its own rounding
    impacts.set_ylim(bottom=min(0.0, impacts.get_ylim()[0]))
    heights.set(xlim=(0.0, None), ylim=(0.0, None))
    label_axes(impacts, x="drive phase just after the impact (deg)", y=r"velocity after it (nm/$\mu$s)")
    label_axes(heights, x=r"approach speed, of the hardest impact (nm/$\mu$s)", y="peak amplitude (nm)")
    legend_once(impacts, figure, **_ABOVE)
    if not impacts.lines:
        impacts.set_title("no orbit", fontsize=12)
    return figure


_FEW = 100
"""Orbits up to which marks are large."""


def exponents_figure(found: Lyapunov) -> Figure:
    """Return both Lyapunov exponents per impact, of one motion or of many: chaos is what lies above the line at 0.

    Where the tip rests they are minus infinity: such motions have a tick on the lower edge. The ground is coloured
    where 95 % of the larger exponents of drawn laws lie.
    """
    exponents = np.asarray(found.exponents_per_impact, float).reshape(-1, 2)
    values = np.arange(1.0, len(exponents) + 1.0) if found.along is None else found.along.values
    figure, axes = new_panels(9.0, 4.8)
    size = 8.0 if len(values) < 10 else max(0.8, min(3.0, 3000.0 / len(values)))
    if found.larger_interval95 is not None:
        finite = np.where(np.isfinite(found.larger_interval95), found.larger_interval95, np.nan).reshape(-1, 2)
        axes.fill_between(values, finite[:, 0], finite[:, 1], color=ACCENT, alpha=0.25, linewidth=0.0)
    # of many motions both are equal: the smaller one shows around the larger one
    axes.plot(
        values, exponents[:, 1], ".", ms=2.5 * size, color=SKY, mew=0.0, label="smaller exponent", rasterized=True
    )
    axes.plot(values, exponents[:, 0], ".", ms=size, color=ACCENT, mew=0.0, label="larger exponent", rasterized=True)
    finite = exponents[np.isfinite(exponents)]
    low, high = (float(np.quantile(finite, 0.01)), float(finite.max())) if finite.size else (-1.0, 1.0)
    gone = np.isneginf(exponents[:, 0])
    if gone.any():
        style = {"color": DARK, "ms": 9.0, "clip_on": False, "rasterized": True}
        label = r"the tip rests: both are $-\infty$"
        axes.plot(values[gone], np.full(gone.sum(), low - 0.3), "|", label=label, **style)
    margin = 0.5 if len(values) == 1 else 0.0
    axes.set(xlim=(values[0] - margin, values[-1] + margin), ylim=(low - 0.3, high + 0.2))
    axes.axhline(0.0, color="black", linewidth=1.0)
    x = "number of the motion" if found.along is None else label_of(found.along.path)
    label_axes(axes, x=x, y="Lyapunov exponent per impact")
    legend_once(axes, figure, **_ABOVE)
    return figure


def bifurcation_figure(ramped: BifurcationDiagram | Ramps, ordinate: str | None = None) -> Figure:
    """Return a bifurcation diagram: what its impacts are like.

    Where the motion ended the ground has the ramp's colour; where a verdict's probability is below 95 % it is grey.

    Args:
        ramped: one ramp of a parameter, or up and down; where both are, the one down lies over the one up.
        ordinate: of the impacts: "height" of the platform, drive "phase" or "impact_speed" relative to the platform;
            None: the height, but the impact speed where the platform rests.

    Raises:
        ValueError: if there is no such ordinate.
    """
    sweeps, path = ([ramped], "") if isinstance(ramped, BifurcationDiagram) else (ramped.sweeps, ramped.parameter)
    if ordinate is None:
        rests = all(len(np.unique(row[np.isfinite(row)])) <= 1 for sweep in sweeps for row in sweep.height_nm)
        ordinate = "impact_speed" if rests else "height"
    if ordinate not in _ORDINATES:
        raise ValueError(f"`ordinate` must be one of {', '.join(_ORDINATES)}, but is {ordinate!r}")
    attribute, label = _ORDINATES[ordinate]
    figure, axes = new_panels(9.0, 4.8)
    for sweep in sweeps:
        colour, word = (BLUE, "ramped up") if sweep.upward else (ACCENT, "ramped down")
        size = float(np.interp(len(sweep.values), [30, 100, 500, 1500], [8.0, 5.0, 4.0, 1.0]))
        part = getattr(sweep, attribute)
        there = np.isfinite(part)
        at = np.repeat(sweep.values, there.sum(axis=1))
        axes.plot(at, part[there], ".", color=colour, mew=0.0, ms=size, alpha=0.5, label=word, rasterized=True)
        for kind, (what, hatch) in _ENDED.items():
            _shade(axes, sweep, sweep.verdicts.kind == kind, color=colour, hatch=hatch, label=f"{word}: {what}")
        if sweep.verdict_probability is not None:
            _shade(axes, sweep, sweep.verdict_probability < _SURE, color=GRID, label="verdict uncertain")
    label_axes(axes, x=label_of(path) if path else "parameter", y=label)
    # also where the tip is stuck and there is nothing to draw
    ends = [end for sweep in sweeps for end in (sweep.values.min(), sweep.values.max())]
    margin = 0.5 * (max(ends) - min(ends)) / len(sweeps[0].values)
    axes.set_xlim(min(ends) - margin, max(ends) + margin)
    legend_once(axes, figure, **_ABOVE | {"ncols": 2})
    return figure


_ORDINATES = {
    "height": ("height_nm", "height at impact (nm)"),
    "phase": ("phase_rad", "drive phase just after the impact (rad)"),
    "impact_speed": ("approach_nm_per_us", r"impact speed (nm/$\mu$s)"),
}
"""Attributes of a diagram that may be drawn against the parameter, and what the axis says."""
_SURE = 0.95
"""Share of drawn laws with a verdict from which on it counts as sure."""
_ENDED = {
    MotionKind.STUCK: ("the platform holds the tip", None),
    MotionKind.FREE: ("the tip does not meet the sample", "//"),
    MotionKind.UNRESOLVED: ("not followed to the end", "xx"),
}
"""What is said of motions without impacts to draw, and their ground."""


def _shade(axes: Axes, sweep: BifurcationDiagram, where: Bool[np.ndarray, " values"], **style: Any) -> None:
    """Give the ground of a panel a colour at some of a ramp's values."""
    edges = cell_edges(sweep.values)
    changes = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(int), [0]])))
    for begin, end in zip(changes[::2], changes[1::2], strict=True):
        axes.axvspan(float(edges[begin]), float(edges[end]), alpha=0.15, lw=0.0, **style)


def chart_figure(chart: StabilityChart) -> Figure:
    """Return the picture of a chart: the lowest stable order, and how fast its orbit attracts; white: none is stable.

    Dashed: where the probability that an orbit of an order is stable is 2.5 or 97.5 %.
    """
    figure, (lowest_axes, attracts_axes) = new_panels(7.5, 9.5, 2, sharex=True, sharey=True)
    edges = cell_edges(chart.x_values), cell_edges(chart.y_values)
    lowest, stable = chart.lowest_stable_order, chart.stable
    orders = [order for order in range(1, chart.orders + 1) if (lowest == order).any()] or [1]
    colours = ListedColormap([KINDS[(order - 1) % len(KINDS)] for order in range(1, orders[-1] + 1)])
    norm = BoundaryNorm(np.arange(0.5, orders[-1] + 1.0), colours.N)
    shown = np.where(lowest > 0, lowest, np.nan)
    mesh = lowest_axes.pcolormesh(*edges, shown, cmap=colours, norm=norm, rasterized=True)
    bar = figure.colorbar(mesh, ax=lowest_axes, ticks=orders)
    bar.ax.set_yticklabels([f"(1,{order})" for order in orders])
    several = (stable.sum(axis=0) > 1).astype(float)
    known: list[Any] = [
        Patch(facecolor="white", edgecolor=DARK, label=f"no stable orbit of one impact, N up to {chart.orders}")
    ]
    if several.any() and not several.all():
        known.append(Line2D([], [], color="black", linewidth=1.0, label="within: several orders are stable"))
        lowest_axes.contour(chart.x_values, chart.y_values, several, levels=[0.5], colors="black", linewidths=0.6)
    lowest_axes.set_title("lowest stable order N", fontsize=12)
    for row in () if chart.probability is None else chart.probability.reshape(stable.shape):
        if row.min() < row.max():
            style = {"colors": DARK, "linewidths": 0.8, "linestyles": "dashed"}
            lowest_axes.contour(chart.x_values, chart.y_values, row, levels=[0.025, 0.975], **style)
    sizes = chart.verdicts.largest_multiplier.reshape(stable.shape)
    lowest_size = np.take_along_axis(sizes, np.maximum(lowest - 1, 0)[None], axis=0)[0]
    least = float(np.nanmin(lowest_size)) if np.isfinite(lowest_size).any() else 0.0
    # a wide tongue is damped alike throughout: the colours show how it loses its stability at the edges
    mesh = attracts_axes.pcolormesh(
        *edges, lowest_size, cmap="cividis", vmin=min(least, 0.99), vmax=1.0, rasterized=True
    )
    figure.colorbar(mesh, ax=attracts_axes, label="modulus of its larger multiplier; 1: stability is lost")
    attracts_axes.set_title("how fast its orbit attracts", fontsize=12)
    x = "first parameter" if chart.x is None else label_of(chart.x.path)
    y = "second parameter" if chart.y is None else label_of(chart.y.path)
    label_axes(lowest_axes, x="", y=y, grid=False)
    label_axes(attracts_axes, x=x, y=y, grid=False)
    figure.legend(handles=known, loc="outside lower center", ncols=2, fontsize=11, frameon=False)
    return figure


def basins_figure(basins: Basins) -> Figure:
    """Return a picture of the motion on which each start ends, with the impacts of the orbits.

    Orbits that are faster than all starts have a mark at the edge.
    """
    figure, axes = new_panels(8.4, 6.0)
    number = min(len(basins.attractors), len(KINDS))
    degrees = np.degrees(basins.phase_rad)
    edges = cell_edges(degrees), cell_edges(basins.rebound_speed_nm_per_us)
    shown = np.minimum(basins.attractor, number - 1)
    axes.pcolormesh(*edges, shown, cmap=ListedColormap(KINDS[:number]), vmin=-0.5, vmax=number - 0.5, rasterized=True)
    handles: list[Any] = [
        Patch(color=KINDS[index], label=f"{attractor.name}: {100.0 * share:.3g} % of the starts")
        for index, (attractor, share) in enumerate(zip(basins.attractors[:number], basins.share, strict=False))
    ]
    axes.set(xlim=edges[0][[0, -1]], ylim=edges[1][[0, -1]], xticks=range(0, 361, 90))
    top = edges[1][-1]
    style = {"color": "white", "markeredgecolor": "black", "ms": 11.0, "zorder": 5}
    for attractor in basins.attractors[:number]:
        for phase, speed in zip(np.degrees(attractor.phase_rad), attractor.rebound_speed_nm_per_us, strict=True):
            axes.plot(phase, min(speed, top), "o" if speed <= top else "^", clip_on=False, **style)
    handles += [Line2D([], [], ls="", marker="o", label="impacts of the orbits", **style)]
    label_axes(axes, x="drive phase at the start (deg)", y=r"rebound speed at the start (nm/$\mu$s)", grid=False)
    figure.legend(handles=handles, **_ABOVE)
    return figure
