"""The picture of a map: energy and virial with colour bars, and how often each value comes."""

import numpy as np
from matplotlib.figure import Figure

from afm_jax.plots.picture_style import BLUE, DARK, label_axes, new_figure
from fitting.tapping_curves.maps import PixelState, TappingMap

_MOST = 1024
_BARS = 80


def map_figure(result: TappingMap) -> Figure:
    """Return energy and virial over the image with colour bars, pixels out of range in grey, and their histograms."""
    figure = new_figure(11.0, 8.0)
    axes = figure.subplots(2, 2, height_ratios=(2.0, 1.0))
    used = result.state == PixelState.USED
    step = max(1, int(np.ceil(max(used.shape) / _MOST)))
    size = result.size_m
    extent = None if size is None else (0.0, 1e6 * size[1], 1e6 * size[0], 0.0)
    where = "um" if size is not None else "pixel"
    for column, (name, colours) in enumerate((("energy", "viridis"), ("virial", "coolwarm"))):
        values = getattr(result, name)[used]
        low, high = np.percentile(values, (0.5, 99.5)) if values.size else (0.0, 1.0)
        if name == "virial":
            low, high = -max(abs(low), abs(high)), max(abs(low), abs(high))
        top, bottom = axes[0, column], axes[1, column]
        top.set_facecolor("#d0d0d0")
        image = top.imshow(
            getattr(result, name)[::step, ::step],
            cmap=colours,
            vmin=low,
            vmax=high,
            extent=extent,
            interpolation="nearest",
        )
        label = f"{'energy of a tap' if name == 'energy' else name} ({result.unit})"
        figure.colorbar(image, ax=top, label=label)
        label_axes(top, x=f"x ({where})", y=f"y ({where})")
        if values.size:
            bottom.hist(values, bins=_BARS, range=(low, high) if high > low else None, color=BLUE)
            bottom.axvline(float(np.median(values)), color=DARK)
        label_axes(bottom, x=label, y="pixels")
    masked = result.state.size - int(used.sum())
    common = f"common error at the median {result.energy_common_error:.2g} {result.unit}" if used.any() else ""
    figure.suptitle(f"{used.sum()} pixels, {masked} masked (grey); {common}", fontsize=11)
    return figure
