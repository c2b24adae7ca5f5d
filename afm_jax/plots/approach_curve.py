"""Picture of an approach curve: amplitude and lag against the sample's height, approach and retract."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afm_jax.motion.approach_curve import ApproachCurve, CurveOutcome
from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, GRID, label_axes, new_panels

_OTHERS = {
    CurveOutcome.OTHER_ORBIT: ("D", "another orbit"),
    CurveOutcome.NOT_SETTLED: ("x", "not settled"),
    CurveOutcome.CAPTURED: ("v", "captured"),
    CurveOutcome.BROKE_OFF: ("P", "broke off"),
}
"""Marks of heights at which the tip neither taps once a period nor is free."""


def approach_curve_figure(curve: ApproachCurve) -> Figure:
    """Return amplitude above and lag below; where there are none of a steady tip a mark at the foot says why."""
    figure, (amplitude, lag) = new_panels(7.0, 6.4, 2, sharex=True)
    for axes, values, free in (
        (amplitude, curve.amplitude_nm, curve.free_amplitude_nm),
        (lag, curve.phase_lag_deg, curve.free_phase_lag_deg),
    ):
        axes.axhline(free, color=GRID, linewidth=1.2, label="free tip")
        _draw(axes, curve, values)
    what = "deflection" if curve.drive == "base" else "height"
    label_axes(amplitude, x="", y=f"amplitude of the {what} (nm)")
    label_axes(lag, x="height of the sample over the rest position (nm)", y=f"lag behind the {curve.drive} (degrees)")
    amplitude.legend(fontsize=10, frameon=False)
    return figure


def _draw(axes: Axes, curve: ApproachCurve, values: np.ndarray) -> None:
    steady = np.isin(curve.outcome, (CurveOutcome.TAPS, CurveOutcome.FREE))
    # the retract begins at the approach's last height
    turn = int(np.argmax(curve.retract)) if curve.retract.any() and not curve.retract[0] else 0
    for name, part, marker, colour in (
        ("approach", ~curve.retract, "o-", BLUE),
        ("retract", curve.retract | (np.arange(len(values)) == turn - 1), "s--", ACCENT),
    ):
        shown = np.where(steady, values, np.nan)[part]
        if np.isfinite(shown).any():
            axes.plot(curve.height_nm[part], shown, marker, ms=4, mfc="none", lw=1.4, color=colour, label=name)
    for kind, (marker, label) in _OTHERS.items():
        those = curve.outcome == kind
        if those.any():
            style: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "color": DARK, "mfc": "none", "ls": ""}
            axes.plot(curve.height_nm[those], np.full(those.sum(), 0.04), marker, ms=6, label=label, **style)
