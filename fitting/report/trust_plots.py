"""The pictures of draws: parameters in pairs; of a trust pack also replicated readings, single rows and ranks."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from afm_jax.plots.picture_style import label_axes, new_figure, pixels_of, png_of_pixels, svg_of
from fitting.report.plots import COLOURS, DPI, SMALL
from fitting.sampling.bootstrap import Bootstrap
from fitting.sampling.posterior_result import Posterior
from fitting.sampling.trust_pack import MOVES_MUCH, TrustPack

_WIDTH_INCHES = 10.0
_READINGS = ("peak amplitude", "lock-in amplitude", "phase")
_BINS = 30
_MOST_NAMED = 14


def trust_pictures(pack: TrustPack) -> list[bytes]:
    """Return trust.png, and its parts as SVG: replicated readings, single rows, ranks, parameters in pairs."""
    figures = []
    for draw, height in _panels(pack):
        figure = Figure(figsize=(_WIDTH_INCHES, height), layout="constrained")
        draw(figure, pack)
        figures.append(figure)
    whole = np.concatenate([pixels_of(figure, DPI) for figure in figures])
    return [png_of_pixels(whole, DPI), *map(svg_of, figures)]


def trust_figure(pack: TrustPack) -> Figure:
    """Return all of them in one figure."""
    panels = _panels(pack)
    heights = [height for _, height in panels]
    figure = Figure(figsize=(_WIDTH_INCHES, sum(heights)), layout="constrained")
    parts = np.atleast_1d(np.asarray(figure.subfigures(len(panels), 1, height_ratios=heights)))
    for (draw, _), part in zip(panels, parts, strict=True):
        draw(part, pack)
    return figure


def bootstrap_figure(found: Bootstrap) -> Figure:
    """Return the figure of the fitted values of synthetic tables, one by one and in pairs."""
    return _corner_figure(found.names, found.samples)


def posterior_figure(found: Posterior) -> Figure:
    """Return the figure of a posterior: its density on a grid, or its samples one by one and in pairs."""
    if found.chains is not None:
        return _corner_figure(tuple(found.mean), found.chains.samples)
    figure = new_figure(7.0, 4.5)
    axes = figure.subplots()
    if found.grid is not None:
        grid, names = found.grid, [*found.grid.names, "density"]
        if len(grid.axes) == 1:
            axes.plot(grid.axes[0], grid.density, color=COLOURS[0])
        else:
            image = axes.pcolormesh(grid.axes[0], grid.axes[1], grid.density.T, cmap="Blues", rasterized=True)
            figure.colorbar(image, label="density")
        label_axes(axes, x=names[0], y=names[1])
        axes.locator_params(axis="x", nbins=6)
    return figure


def _corner_figure(names: Sequence[str], samples: Float[np.ndarray, "... p"]) -> Figure:
    size = min(0.8 + 1.5 * len(names), _WIDTH_INCHES)
    figure = Figure(figsize=(max(size, 4.0), size), layout="constrained")
    draw_corner(figure, names, samples)
    return figure


def _panels(pack: TrustPack):
    return [
        (draw_replicated, 0.6 + 2.0 * len(_kinds(pack))),
        (draw_rows, 4.2),
        (draw_ranks, 3.4),
        (
            lambda figure, pack: draw_corner(figure, pack.names, pack.draws),
            min(0.8 + 1.5 * len(pack.names), _WIDTH_INCHES),
        ),
    ]


def _kinds(pack: TrustPack) -> list[int]:
    """Return which readings there are."""
    return np.flatnonzero(np.isfinite(pack.predictive.measured).any(axis=0)).tolist()


def draw_replicated(figure: Figure | SubFigure, pack: TrustPack) -> None:
    """Draw readings and bands of replicated ones as deviations from the median, amplitudes in per cent."""
    kinds = _kinds(pack)
    low, less, middle, more, high = pack.predictive.quantiles
    place = np.arange(len(pack.lines))
    panels = np.atleast_1d(figure.subplots(len(kinds), 1, sharex=True))
    for axes, kind in zip(panels, kinds, strict=True):
        there = np.isfinite(pack.predictive.measured[:, kind])
        size = 1.0 if kind == 2 else 0.01 * np.abs(middle[:, kind])

        def apart(column, kind=kind, size=size, there=there):
            return ((column[:, kind] - middle[:, kind]) / size)[there]

        for ends, strength, name in (((low, high), 0.18, "95 %"), ((less, more), 0.35, "50 %")):
            below, above = apart(ends[0]), apart(ends[1])
            label = f"{name} of replicated readings"
            axes.bar(place[there], above - below, 0.9, below, color=COLOURS[kind], alpha=strength, lw=0, label=label)
        read = apart(pack.predictive.measured)
        outside = (read < apart(low)) | (read > apart(high))
        axes.plot(place[there], read, "o", ms=3, color="black", label="measured")
        axes.plot(place[there][outside], read[outside], "o", ms=6, mfc="none", color="black", label="outside 95 %")
        axes.set_ylabel(f"{_READINGS[kind]}\n({'degrees' if kind == 2 else '%'})")
        axes.axhline(0.0, color="0.5", lw=0.8)
    panels[0].legend(fontsize=SMALL, ncols=4, loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False)
    _name_lines(panels[-1], pack)


def draw_rows(figure: Figure | SubFigure, pack: TrustPack) -> None:
    """Draw how far each row moves the law, and how far the posterior without it is from the whole one."""
    above, below = figure.subplots(2, 1, sharex=True)
    place, influence = np.arange(len(pack.lines)), pack.influence
    moves = np.where(np.isfinite(influence.law_moves), influence.law_moves, np.nan)
    above.bar(place, moves, 0.8, color=COLOURS[0], label="from the slopes")
    above.plot(
        influence.checked, influence.law_moves_refitted, "D", ms=4, mfc="none", color=COLOURS[1], label="refitted"
    )
    above.axhline(MOVES_MUCH, color="0.5", lw=0.8, ls="--")
    above.set_ylim(0.0, 1.15 * max(np.nanmax(moves, initial=0.0), MOVES_MUCH))
    above.set_ylabel("law moves without\nthe row (errors)")
    above.legend(fontsize=SMALL, loc="upper right")
    below.plot(place, pack.loo.pareto_k, "o", ms=3.5, color=COLOURS[0])
    below.axhline(pack.loo.highest_k, color="0.5", lw=0.8, ls="--")
    below.set_ylabel("Pareto k of\nleave-one-out")
    _name_lines(below, pack)


def draw_ranks(figure: Figure | SubFigure, pack: TrustPack) -> None:
    """Draw how far the share of ranks below each level is from it, with the band that uniform ranks keep to."""
    ranks = pack.calibration
    level = np.linspace(0.0, 1.0, 201)
    half = ranks.band * np.sqrt(level * (1.0 - level) / len(ranks.ranks))
    panels = figure.subplots(1, 2, sharey=True)
    titles = ("posterior", "Gaussian of the standard errors")
    for axes, found, p, title in zip(
        panels, (ranks.ranks, ranks.gaussian_ranks), (ranks.p_value, ranks.gaussian_p_value), titles, strict=True
    ):
        axes.fill_between(level, -half, half, color="0.88", lw=0)
        for name, column in zip(ranks.quantities, found.T, strict=True):
            share = np.searchsorted(np.sort(column), level, side="right") / len(column)
            axes.plot(level, share - level, lw=1.0, label=name)
        axes.set_xlabel("rank of the true value", fontsize=9)
        axes.set_title(f"{title}: probability of such ranks {p:.2g}", fontsize=9)
    panels[0].set_ylabel("share of ranks below,\nless that of uniform ones")
    figure.legend(*panels[0].get_legend_handles_labels(), fontsize=SMALL, loc="outside right center")


def draw_corner(figure: Figure | SubFigure, names: Sequence[str], draws: Float[np.ndarray, "... p"]) -> None:
    """Draw parameters one by one and in pairs, with the 68 and 95 % contours of the pairs."""
    count = len(names)
    flat = draws.reshape(-1, count)
    panels = figure.subplots(count, count, squeeze=False, sharex="col")
    for i in range(count):
        for j in range(count):
            axes: Axes = panels[i, j]
            axes.tick_params(labelsize=6)
            axes.xaxis.get_offset_text().set_fontsize(6)
            axes.yaxis.get_offset_text().set_fontsize(6)
            axes.locator_params(nbins=3)
            if j > i:
                axes.set_visible(False)
                continue
            if i == j:
                axes.hist(flat[:, i], _BINS, color=COLOURS[0], alpha=0.5)
                axes.set_yticks([])
            else:
                axes.plot(flat[:, j], flat[:, i], ".", ms=1.2, alpha=0.4, color=COLOURS[0], rasterized=True)
                _ellipses(axes, flat[:, j], flat[:, i])
            if i == count - 1:
                axes.set_xlabel(_broken(names[j]), fontsize=7)
            if j == 0 and i > 0:
                axes.set_ylabel(_broken(names[i]), fontsize=7)
            elif j > 0:
                axes.set_yticklabels([])


def _ellipses(axes: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Draw where a Gaussian of the same mean and covariance holds 68 and 95 %."""
    root = np.linalg.cholesky(np.cov(x, y) + 1e-300 * np.eye(2))
    turn = np.linspace(0.0, 2.0 * np.pi, 101)
    for share in (0.68, 0.95):
        ring = np.sqrt(-2.0 * np.log1p(-share)) * root @ np.stack([np.cos(turn), np.sin(turn)])
        axes.plot(x.mean() + ring[0], y.mean() + ring[1], color=COLOURS[1], lw=0.8)


def _name_lines(axes: Axes, pack: TrustPack) -> None:
    step = max(-(-len(pack.lines) // _MOST_NAMED), 1)
    shown = np.arange(0, len(pack.lines), step)
    axes.set_xticks(shown, [str(line) for line in pack.lines[shown].tolist()])
    axes.set_xlabel("line of the table")


def _broken(name: str) -> str:
    """Return a name in lines of a panel's width."""
    lines = [""]
    for word in name.split("_"):
        lines = (
            [*lines, word]
            if lines[-1] and len(lines[-1]) + len(word) > 10
            else [*lines[:-1], f"{lines[-1]}_{word}".lstrip("_")]
        )
    return "\n".join(lines)
