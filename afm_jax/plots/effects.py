"""The picture of a scene's effects: what leaving each out changes, beside the time that the scene without it takes."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure
from afm_jax.studies.effects import EffectStudy

_LEAST = 1e-6
"""Relative changes below are drawn as this."""
_BARS = (("peak amplitude", "peak_amplitude", DARK, -0.17), ("lock-in amplitude", "lockin_amplitude", BLUE, 0.17))


def effects_figure(study: EffectStudy) -> Figure:
    """Return two bars of change and one of time for every effect; the wanted accuracy and the full scene are lines."""
    effects = study.to_dict()["effects"]
    rows = np.arange(len(effects))
    figure = new_figure(11.0, 2.0 + 0.55 * max(len(effects), 2))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.6, 1.0))
    _draw_changes(left, effects)
    left.axvline(study.accuracy, color=ACCENT, lw=1.2, ls="--", label=f"wanted, {100.0 * study.accuracy:g} %")
    left.set_yticks(rows, [effect["name"].replace("_", " ") for effect in effects])
    left.set_ylim(len(effects) - 0.4, -0.6)
    label_axes(left, x="relative change (size)", y="")
    right.barh(rows, [effect["time_us_per_period"] or 0.0 for effect in effects], height=0.6, color=DARK)
    if study.cost is not None:
        right.axvline(study.cost.time_us, color=ACCENT, lw=1.2, ls=":", label="full scene")
    label_axes(right, x="time without it (µs/drive period)", y="")
    for axes in (left, right):
        axes.grid(axis="x", color=GRID, alpha=0.25)
    figure.legend(loc="outside lower center", ncols=4, fontsize=10)
    figure.suptitle("Leaving out one effect", fontsize=12)
    return figure


def _draw_changes(axes: Axes, effects: list[dict[str, Any]]) -> None:
    largest = 0.1
    for label, name, colour, shift in _BARS:
        sizes = [abs(effect["change"][name] or 0.0) for effect in effects]
        known = [row for row, effect in enumerate(effects) if effect["change"][name] is not None]
        places = [row + shift for row in known]
        axes.barh(places, [max(sizes[row], _LEAST) for row in known], height=0.3, color=colour, label=label)
        largest = max(largest, *sizes)
    for row, effect in enumerate(effects):
        if effect["change"]["peak_amplitude"] is None:
            words = "required" if effect["required"] else "no steady motion without it"
            axes.text(0.02, row, words, transform=axes.get_yaxis_transform(), va="center", fontsize=10)
    axes.set_xscale("log")
    axes.set_xlim(_LEAST, 3.0 * largest)
