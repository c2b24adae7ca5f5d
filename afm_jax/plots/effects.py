"""The picture of a scene's effects: what leaving each out changes, beside the time that the scene without it takes."""

import numpy as np
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, label_axes, new_panels
from afm_jax.studies.effects import EffectStudy

_LEAST = 1e-6
"""Relative changes below are drawn as this."""
_BARS = (("peak amplitude", "peak_amplitude", DARK, -0.17), ("lock-in amplitude", "lockin_amplitude", BLUE, 0.17))


def effects_figure(study: EffectStudy) -> Figure:
    """Return two bars of change and one of time for every effect; the wanted accuracy and the full scene are lines."""
    reports = study.effects
    rows = np.arange(len(reports))
    figure, (changes, times) = new_panels(7.0, 2.0 + 1.1 * max(len(reports), 2), 2, sharey=True)
    for label, name, colour, shift in _BARS:
        # not a number where nothing steady is left: no bar
        sizes = np.abs(np.array([getattr(report.change, name) for report in reports], float))
        changes.barh(rows + shift, np.maximum(sizes, _LEAST), height=0.3, color=colour, label=label)
    changes.axvline(study.accuracy, color=ACCENT, lw=1.2, ls="--", label=f"wanted, {100.0 * study.accuracy:g} %")
    changes.set_yticks(rows, [report.name.replace("_", " ") for report in reports])
    changes.set(xscale="log", xlim=(_LEAST, None), ylim=(len(reports) - 0.4, -0.6))
    for row, report in enumerate(reports):
        if report.change.peak_amplitude is None:
            words = "required" if report.required else "no steady motion without it"
            changes.text(0.02, row, words, transform=changes.get_yaxis_transform(), va="center", fontsize=10)
    label_axes(changes, x="relative change (size)", y="")
    times.barh(rows, [report.time_us_per_period or 0.0 for report in reports], height=0.6, color=DARK)
    if study.full.time_us_per_period is not None:
        times.axvline(study.full.time_us_per_period, color=ACCENT, lw=1.2, ls=":", label="full scene")
    label_axes(times, x="time without it (µs/drive period)", y="")
    figure.legend(loc="outside lower center", ncols=4, fontsize=10)
    figure.suptitle("Leaving out one effect", fontsize=12)
    return figure
