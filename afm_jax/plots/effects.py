"""The picture of a scene's effects: what leaving each out changes, beside what it saves."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from afm_jax.effects.effect_table import EffectTable
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_figure

_LEAST = 1e-6
"""Relative changes below are drawn as this."""


def effects_figure(table: EffectTable) -> Figure:
    """Return a bar of change and one of cost for every effect; a wanted accuracy is a line."""
    told = table.to_dict()
    effects, full, accuracy = told["effects"], told["full"], told["accuracy"]
    figure = new_figure(11.0, 2.0 + 0.55 * max(len(effects), 2))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.6, 1.0))
    _draw_changes(left, effects, accuracy)
    _draw_costs(right, effects, full)
    rows = np.arange(len(effects))
    left.set_yticks(rows, [effect["name"].replace("_", " ") for effect in effects])
    left.set_ylim(len(effects) - 0.4, -0.6)
    figure.suptitle("Leaving out one effect", fontsize=12)
    return figure


def _draw_changes(axes: Axes, effects: Sequence[Mapping[str, Any]], accuracy: float | None) -> None:
    for row, effect in enumerate(effects):
        change, lockin = effect["change"]["peak_amplitude"], effect["change"]["lockin_amplitude"]
        for value, place, colour in ((change, row - 0.17, DARK), (lockin, row + 0.17, BLUE)):
            if value is not None:
                axes.barh(place, max(abs(value), _LEAST), left=0.0, height=0.3, color=colour)
        if change is None:
            words = "required" if effect["required"] else "no steady motion without it"
            axes.text(0.02, row, words, transform=axes.get_yaxis_transform(), va="center", fontsize=10)
    axes.set_xscale("log")
    values = [
        abs(effect["change"][name] or 0.0) for effect in effects for name in ("peak_amplitude", "lockin_amplitude")
    ]
    axes.set_xlim(_LEAST, 3.0 * max([*values, 0.1]))
    if accuracy is not None:
        axes.axvline(accuracy, color=ACCENT, lw=1.2, ls="--", label=f"wanted, {100.0 * accuracy:g} %")
    bars = [Patch(color=DARK, label="peak amplitude"), Patch(color=BLUE, label="lock-in amplitude")]
    handles = [*bars, *axes.get_legend_handles_labels()[0]]
    axes.grid(axis="x", color=GRID, alpha=0.25)
    label_axes(axes, x="relative change (size)", y="")
    axes.figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=10)


def _draw_costs(axes: Axes, effects: Sequence[Mapping[str, Any]], full: Mapping[str, Any]) -> None:
    for row, effect in enumerate(effects):
        if effect["time_us_per_period"] is not None:
            axes.barh(row, effect["time_us_per_period"], height=0.6, color=DARK)
    if full["time_us_per_period"] is not None:
        axes.axvline(full["time_us_per_period"], color=ACCENT, lw=1.2, ls=":")
        axes.text(
            full["time_us_per_period"],
            1.01,
            "full scene",
            transform=axes.get_xaxis_transform(),
            ha="center",
            fontsize=10,
        )
    axes.margins(x=0.15)
    axes.grid(axis="x", color=GRID, alpha=0.25)
    label_axes(axes, x="processor time without it (µs/drive period)", y="")
