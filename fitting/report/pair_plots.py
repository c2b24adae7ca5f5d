"""The picture of samples, of a bootstrap or a posterior: parameters one by one and in pairs."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fitting.report.plots import COLOURS
from fitting.sampling.bootstrap import Bootstrap
from fitting.sampling.posterior_result import Posterior

_WIDTH_INCHES = 10.0
_BINS = 30


def bootstrap_figure(found: Bootstrap) -> Figure:
    """Return the figure of the fitted values of synthetic tables, one by one and in pairs."""
    return pairs_figure(found.names, found.samples)


def posterior_figure(found: Posterior) -> Figure:
    """Return the figure of a posterior's samples, one by one and in pairs."""
    return pairs_figure(tuple(found.mean), found.chains.samples)


def pairs_figure(names: Sequence[str], samples: Float[np.ndarray, "... p"]) -> Figure:
    """Return the figure of parameters one by one and in pairs, with the 68 and 95 % contours of the pairs."""
    count = len(names)
    flat = samples.reshape(-1, count)
    size = min(0.8 + 1.5 * count, _WIDTH_INCHES)
    figure = Figure(figsize=(max(size, 4.0), size), layout="constrained")
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
    return figure


def _ellipses(axes: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Draw where a Gaussian of the same mean and covariance holds 68 and 95 %."""
    root = np.linalg.cholesky(np.cov(x, y) + 1e-300 * np.eye(2))
    turn = np.linspace(0.0, 2.0 * np.pi, 101)
    for share in (0.68, 0.95):
        ring = np.sqrt(-2.0 * np.log1p(-share)) * root @ np.stack([np.cos(turn), np.sin(turn)])
        axes.plot(x.mean() + ring[0], y.mean() + ring[1], color=COLOURS[1], lw=0.8)


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
