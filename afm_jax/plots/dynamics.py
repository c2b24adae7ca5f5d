"""Pictures of what motions come to: orbits, exponents, bifurcation diagrams, charts of orbits, basins."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from afm_jax.dynamics.basins import Basins
from afm_jax.dynamics.bifurcations import Sweep
from afm_jax.dynamics.charts import StabilityChart
from afm_jax.dynamics.exponents import Lyapunov
from afm_jax.dynamics.impact_orbits import ManyImpactOrbits
from afm_jax.impact.orbits import SingleImpactOrbits
from afm_jax.plots.picture_style import (
    ACCENT,
    BLUE,
    DARK,
    GRID,
    cell_edges,
    label_axes,
    new_figure,
    save,
    with_zero_line,
)
from afm_jax.results import unit_of, words_of

KINDS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#8c6bb1", "#a6761d", "#999999")
"""Colours that stand apart for every kind of colour vision (Okabe and Ito's, and three more)."""
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


def orbits_figure(orbits: SingleImpactOrbits) -> Figure:
    """Return the picture of single-impact orbits, of one scene or of many: where they hit, and how high they go."""
    names = ("phase_rad", "velocity_after_nm_per_us", "approach_speed_nm_per_us", "peak_amplitude_nm")
    columns = [np.asarray(getattr(orbits, name), float).ravel() for name in names]
    kinds = [np.asarray(getattr(orbits, name)).ravel() for name in ("exists", "admissible", "stable")]
    return _orbits([part[:, None] for part in columns[:3]], columns[3], *kinds)


def many_orbits_figure(orbits: ManyImpactOrbits) -> Figure:
    """Return the picture of orbits of several impacts: where each hits, in their order, and how high it goes."""
    names = ("phase_rad", "velocity_after_nm_per_us", "approach_speed_nm_per_us", "peak_amplitude_nm")
    *impacts, peak = (np.asarray(getattr(orbits.reading, name), float) for name in names)
    return _orbits(impacts, peak, np.isfinite(peak), np.asarray(orbits.reading.admissible), np.asarray(orbits.stable))


def _orbits(
    impacts: Sequence[Float[np.ndarray, "orbits impacts"]],
    peak: Float[np.ndarray, " orbits"],
    exists: Bool[np.ndarray, " orbits"],
    admissible: Bool[np.ndarray, " orbits"],
    stable: Bool[np.ndarray, " orbits"],
) -> Figure:
    """Return the picture of orbits.

    Args:
        impacts: drive phase in rad, velocity after and approach speed in nm/us of every impact.
        peak: their largest heights in nm.
        exists: which of them are orbits at all; the others are left out.
        admissible: they stay above the sample.
        stable: they last.
    """
    figure = new_figure(10.0, 4.8)
    left, right = figure.subplots(1, 2)
    kinds = {
        "stable": (admissible & stable, {"marker": "o", "color": DARK}),
        "unstable": (admissible & ~stable, {"marker": "o", "color": BLUE, "markerfacecolor": "white"}),
        "not admissible": (~admissible, {"marker": "x", "color": ACCENT}),
    }
    phase, velocity, approach = impacts
    exists = exists & np.isfinite(peak) & np.isfinite(phase).all(axis=1) & np.isfinite(velocity).all(axis=1)
    for label, (which, style) in kinds.items():
        chosen = np.flatnonzero(exists & which)
        size = 8.0 if chosen.size <= _FEW else 3.0
        for number, one in enumerate(chosen):
            own = {**style, "ms": size, "label": label if number == 0 else None}
            left.plot(np.degrees(phase[one]), velocity[one], ls=":", lw=0.8, **own)
            right.plot(np.max(approach[one], initial=-np.inf), peak[one], ls="", **own)
    left.set(xlim=(0.0, 360.0), xticks=range(0, 361, 90))
    for axes in (left, right):
        # one orbit alone would have an axis of its own rounding
        axes.update_datalim([(0.0, 0.0)], updatex=axes is right)
        axes.autoscale_view(scalex=axes is right)
    label_axes(left, x="drive phase just after the impact (deg)", y=r"velocity after it (nm/$\mu$s)")
    label_axes(right, x=r"approach speed, of the hardest impact (nm/$\mu$s)", y="peak amplitude (nm)")
    for axes in (left, right):
        axes.grid(color=GRID, alpha=0.25)
    handles, labels = left.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=11, frameon=False)
    else:
        left.set_title("no orbit", fontsize=12)
    return figure


_FEW = 100
"""Orbits up to which marks are large."""


def draw_exponents(
    path: str,
    values: Float[np.ndarray, " values"],
    exponents: Float[np.ndarray, "values 2"],
    target: Path,
    band: Float[np.ndarray, "values 2"] | None = None,
) -> None:
    """Write the picture of exponents against a parameter, whose path is given, as PNG, PDF or SVG; see `_exponents`."""
    save(_exponents(label_of(path), values, exponents, band), target)


def exponents_figure(found: Lyapunov) -> Figure:
    """Return the picture of the exponents of one motion, or of many in their order."""
    exponents = np.asarray(found.exponents_per_impact, float).reshape(-1, 2)
    return _exponents("number of the motion", np.arange(1.0, len(exponents) + 1.0), exponents)


def _exponents(
    label: str,
    values: Float[np.ndarray, " values"],
    exponents: Float[np.ndarray, "values 2"],
    band: Float[np.ndarray, "values 2"] | None = None,
) -> Figure:
    """Return both Lyapunov exponents per impact in a row; where they are minus infinity there is a tick below.

    Args:
        label: what the values are.
        values: of the parameter.
        exponents: per impact.
        band: within which 95 % of the larger one's draws lie.
    """
    figure = new_figure(9.0, 4.8)
    axes: Axes = figure.subplots()
    size = 8.0 if len(values) < 10 else max(0.5, min(3.0, 3000.0 / len(values)))
    if band is not None:
        finite = np.where(np.isfinite(band), band, np.nan)
        axes.fill_between(values, finite[:, 0], finite[:, 1], color=ACCENT, alpha=0.25, linewidth=0.0)
    axes.plot(values, exponents[:, 1], ".", ms=size, color=BLUE, label="smaller exponent", rasterized=True)
    axes.plot(values, exponents[:, 0], ".", ms=size, color=ACCENT, label="larger exponent", rasterized=True)
    finite = exponents[np.isfinite(exponents)]
    low = float(np.quantile(finite, 0.01)) - 0.3 if finite.size else -1.0
    high = float(finite.max()) + 0.2 if finite.size else 1.0
    gone = np.isneginf(exponents[:, 0])
    if gone.any():
        axes.plot(values[gone], np.full(gone.sum(), low), ".", color=DARK, ms=size, label="the tip rests or sticks")
    margin = 0.5 if len(values) == 1 else 0.0
    axes.set(xlim=(values[0] - margin, values[-1] + margin), ylim=(low - 0.1, high))
    with_zero_line(axes)
    axes.axhline(0.0, color=GRID, linewidth=1.2)
    label_axes(axes, x=label, y="Lyapunov exponent per impact")
    legend = figure.legend(loc="outside upper center", ncols=3, fontsize=11, frameon=False)
    for handle in legend.get_lines():
        handle.set_markersize(10.0)
    return figure


def draw_bifurcations(
    path: str,
    sweeps: Sequence[Sweep],
    target: Path,
    probabilities: Sequence[Float[np.ndarray, " values"]] | None = None,
) -> None:
    """Write a bifurcation diagram over a parameter, whose path is given, as PNG, PDF or SVG; see `_bifurcations`."""
    save(_bifurcations(label_of(path), sweeps, probabilities), target)


def bifurcation_figure(sweep: Sweep) -> Figure:
    """Return the bifurcation diagram of one sweep, as `afm-jax bifurcation` draws it."""
    return _bifurcations("parameter", [sweep])


def _bifurcations(
    label: str,
    sweeps: Sequence[Sweep],
    probabilities: Sequence[Float[np.ndarray, " values"]] | None = None,
) -> Figure:
    """Return a bifurcation diagram: height at impact, and the tip's height whenever the drive's phase is 0.

    Args:
        label: what the values are.
        sweeps: up, down or both; where both are, the one down lies over the one up.
        probabilities: of each sweep's verdicts; where one is below 95 % there is a grey ground.
    """
    figure = new_figure(9.0, 8.0)
    panels = figure.subplots(2, 1, sharex=True)
    for sweep in sweeps:
        colour, word = (BLUE, "swept up") if sweep.upward else (ACCENT, "swept down")
        parts = (sweep.height_nm, sweep.strobe_height_nm)
        for axes, part in zip(panels, parts, strict=True):
            there = np.isfinite(part)
            at = np.repeat(sweep.values, there.sum(axis=1))
            size = float(np.interp(len(sweep.values), [30, 100, 500, 1500], [6.0, 3.0, 3.0, 1.0]))
            style = {"ms": size, "alpha": 0.5, "rasterized": True}
            axes.plot(at, part[there], ".", color=colour, mew=0.0, label=word, **style)
    for sweep, sure in zip(sweeps, probabilities or (), strict=False):
        for axes in panels:
            ground = axes.get_xaxis_transform()
            axes.fill_between(sweep.values, 0.0, 1.0, where=sure < 0.95, color=GRID, alpha=0.3, lw=0, transform=ground)
    label_axes(panels[0], x="", y="height at impact (nm)")
    label_axes(panels[1], x=label, y="height at drive phase 0 (nm)")
    # also where the tip is stuck and there is nothing to draw
    ends = [end for sweep in sweeps for end in (sweep.values.min(), sweep.values.max())]
    margin = 0.5 * (max(ends) - min(ends)) / len(sweeps[0].values)
    panels[0].set_xlim(min(ends) - margin, max(ends) + margin)
    for axes in panels:
        axes.grid(color=GRID, alpha=0.25)
    handles, labels = panels[0].get_legend_handles_labels()
    legend = figure.legend(handles, labels, loc="outside upper center", ncols=2, fontsize=11, frameon=False)
    for handle in legend.get_lines():
        handle.set(markersize=10.0, alpha=1.0)
    return figure


def draw_chart(
    x: str,
    y: str,
    chart: StabilityChart,
    target: Path,
    probability: Float[np.ndarray, "orders points"] | None = None,
) -> None:
    """Write a chart of stable single-impact orbits over two parameters, whose paths are given, as PNG, PDF or SVG."""
    save(chart_figure(chart, label_of(x), label_of(y), probability), target)


def chart_figure(
    chart: StabilityChart,
    x: str = "first parameter",
    y: str = "second parameter",
    probability: Float[np.ndarray, "orders points"] | None = None,
) -> Figure:
    """Return a picture of a chart: the lowest stable order, and how stable its orbit is.

    Args:
        chart: the chart.
        x: what its columns are.
        y: what its rows are.
        probability: that an orbit of each order is stable; dashed where that of one is 2.5 or 97.5 %.
    """
    figure = new_figure(12.0, 5.2)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    edges = cell_edges(chart.x_values), cell_edges(chart.y_values)
    lowest, stable = chart.lowest_stable_order, chart.stable
    orders = [order for order in range(1, chart.orders + 1) if (lowest == order).any()] or [1]
    colours = ListedColormap([KINDS[(order - 1) % len(KINDS)] for order in range(1, orders[-1] + 1)])
    norm = BoundaryNorm(np.arange(0.5, orders[-1] + 1.0), colours.N)
    shown = np.where(lowest > 0, lowest, np.nan)
    mesh = left.pcolormesh(*edges, shown, cmap=colours, norm=norm, rasterized=True)
    bar = figure.colorbar(mesh, ax=left, ticks=orders)
    bar.ax.set_yticklabels([f"(1,{order})" for order in orders])
    several = (stable.sum(axis=0) > 1).astype(float)
    if several.any() and not several.all():
        left.contour(chart.x_values, chart.y_values, several, levels=[0.5], colors="black", linewidths=0.6)
    left.set_title("lowest stable order (black line: several coexist)", fontsize=12)
    for row in () if probability is None else probability.reshape(stable.shape):
        if row.min() < row.max():
            style = {"colors": DARK, "linewidths": 0.8, "linestyles": "dashed"}
            left.contour(chart.x_values, chart.y_values, row, levels=[0.025, 0.975], **style)
    sizes = chart.verdicts.largest_multiplier.reshape(stable.shape)
    lowest_size = np.take_along_axis(sizes, np.maximum(lowest - 1, 0)[None], axis=0)[0]
    mesh = right.pcolormesh(*edges, lowest_size, cmap="cividis", vmin=0.0, vmax=1.0, rasterized=True)
    figure.colorbar(mesh, ax=right, label="size of its larger multiplier")
    right.set_title("how stable", fontsize=12)
    label_axes(left, x=x, y=y)
    label_axes(right, x=x, y="")
    return figure


def draw_basins(basins: Basins, target: Path) -> None:
    """Write the picture of basins as PNG, PDF or SVG."""
    save(basins_figure(basins), target)


def basins_figure(basins: Basins) -> Figure:
    """Return a picture of which start ends where, and the points of the orbits."""
    figure = new_figure(8.4, 6.0)
    axes: Axes = figure.subplots()
    number = min(len(basins.attractors), len(KINDS))
    degrees = np.degrees(basins.phase_rad)
    edges = cell_edges(degrees), cell_edges(basins.rebound_speed_nm_per_us)
    shown = np.minimum(basins.attractor, number - 1)
    axes.pcolormesh(*edges, shown, cmap=ListedColormap(KINDS[:number]), vmin=-0.5, vmax=number - 0.5, rasterized=True)
    handles = [
        Patch(color=KINDS[index], label=f"{attractor.name}: {100.0 * share:.3g} %")
        for index, (attractor, share) in enumerate(zip(basins.attractors, basins.share, strict=True))
        if index < number
    ]
    axes.set(xlim=edges[0][[0, -1]], ylim=edges[1][[0, -1]], xticks=range(0, 361, 90))
    label_axes(axes, x="drive phase at the start (deg)", y=r"rebound speed at the start (nm/$\mu$s)")
    figure.legend(handles=handles, loc="outside upper center", ncols=4, fontsize=11, frameon=False)
    return figure
