"""The picture of an accuracy study: time against achieved error, of the value and of its gradient."""

from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, label_axes, new_panels
from afm_jax.studies.accuracy import AccuracyStudy

_SMALLEST = 1e-17
"""Errors below this are 0 but for rounding; they are drawn here."""
_STYLES = {"afm-jax": (BLUE, "o", ""), "Diffrax Dopri8": (DARK, "s", "-"), "SciPy DOP853": (ACCENT, "^", "-")}


def accuracy_figure(study: AccuracyStudy) -> Figure:
    """Return two panels, value and gradient: a line a rival, a point a setting; smaller errors to the right.

    Errors of 1 and more are left out: no more than that they are wrong is known.
    """
    figure, panels = new_panels(7.0, 8.5, 2)
    known = [row for row in study.rows if row["error"] is not None and row["error"] < 1.0]
    doubts = {"value": study.reference_error, "gradient": study.reference_gradient_error}
    for axes, (kind, doubt) in zip(panels, doubts.items(), strict=True):
        for method, (colour, marker, line) in _STYLES.items():
            chosen = [row for row in known if (row["of"], row["method"]) == (kind, method)]
            places = [(max(row["error"], _SMALLEST), row["microseconds"]) for row in chosen]
            if places:
                axes.plot(*zip(*sorted(places), strict=True), color=colour, marker=marker, ls=line, label=method)
        if doubt > _SMALLEST:
            axes.axvline(doubt, color=DARK, linestyle=":", label="error of the reference")
        axes.set(xscale="log", yscale="log", title=kind)
        axes.invert_xaxis()
        label_axes(
            axes,
            x=f"error of the {'' if kind == 'value' else 'gradient of the '}{study.value_of}",
            y="time (µs), one core",
        )
    panels[0].legend(frameon=False)
    return figure
