"""The picture of an inversion: loss and delay of every row over its approach speed, with the lines."""

import numpy as np
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import ACCENT, BLUE, DARK, label_axes, new_figure
from fitting.inversion.invert import POWERS, Inversion


def inversion_figure(result: Inversion) -> Figure:
    """Return the figure: u_in^2 - u_out^2 with both lines above, the collision delay below."""
    figure = new_figure(7.0, 8.0)
    losses, delays = figure.subplots(2)
    u, w = result.approach_speed_nm_per_us, result.rebound_speed_nm_per_us
    slopes = np.stack([2.0 * u, -2.0 * w], axis=1)
    error = np.sqrt(np.einsum("ni,nij,nj->n", slopes, result.covariance[:, :2, :2], slopes))
    losses.errorbar(u, u**2 - w**2, error, fmt="o", ms=3.5, lw=0.8, color=DARK, label="rows")
    at = np.linspace(np.nanmin(u), np.nanmax(u), 100) if np.isfinite(u).any() else u
    for (law, line), colour in zip(result.lines.items(), (BLUE, ACCENT), strict=False):
        label = f"{law}, $\\chi^2$ {line.chi2:.1f}/{line.degrees_of_freedom}"
        losses.plot(at, line.epsilon + line.slope * at ** POWERS[law], color=colour, label=label)
    delays.errorbar(u, 1e3 * result.collision_delay_us, 1e3 * result.errors[:, 2], fmt="o", ms=3.5, lw=0.8, color=DARK)
    label_axes(losses, x="approach speed (nm/µs)", y="$u_{in}^2 - u_{out}^2$ (nm$^2$/µs$^2$)")
    label_axes(delays, x="approach speed (nm/µs)", y="collision delay (ns)")
    losses.legend()
    return figure
