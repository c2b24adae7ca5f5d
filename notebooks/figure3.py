"""Draw figure 3 of the paper, the picture of README and of the front page: `python notebooks/figure3.py`."""

from pathlib import Path

import jax
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import afm_jax as afm

PICTURE = Path(__file__).parent / "pages" / "pictures" / "figure3"
# Okabe and Ito's colours, told apart by colour-blind readers too
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
LAST = len(COLOURS)


def main() -> None:
    """Compute the chart over the paper's ranges and draw it, one colour an order, labelled in its tongue."""
    jax.config.update("jax_enable_x64", True)
    n, drive_nm = np.linspace(0.326, 6.476, 800), np.linspace(0.025, 2.975, 400)
    scene = afm.Scene(afm.Cantilever(90.0), afm.Platform(2.0, 180.0, -1.0), afm.ImpactLaw(r=0.5, epsilon=1.0))
    family = afm.scene_family(scene, "platform.reduced_frequency", "platform.amplitude_nm")
    chart = afm.stability_chart(family, x_values=n, y_values=drive_nm, last_order=14)
    order = np.where(chart.any_stable & (chart.lowest_stable_order <= LAST), chart.lowest_stable_order, np.nan)
    figure, ax = plt.subplots(figsize=(8.0, 3.4), layout="constrained")
    ax.pcolormesh(
        n, drive_nm, order, cmap=mpl.colors.ListedColormap(COLOURS), vmin=0.5, vmax=LAST + 0.5, rasterized=True
    )
    for number in range(1, LAST + 1):
        top = n[order[-1] == number]
        ax.text(top.mean(), 2.6, f"(1,{number})", ha="center", va="center", color="white", weight="bold", fontsize=11)
    ax.text(1.43, 2.05, "no stable orbit of one impact", rotation=90, ha="center", va="center", fontsize=8, color="0.3")
    ax.set(xlabel="drive frequency / twice the free frequency,  n = ω/2Ω", ylabel="drive amplitude (nm)")
    ax.set_xlim(n[0], n[-1])
    figure.savefig(PICTURE.with_suffix(".png"), dpi=160)
    with mpl.rc_context({"svg.hashsalt": "afm-jax"}):
        figure.savefig(PICTURE.with_suffix(".svg"), dpi=300, metadata={"Date": None})


if __name__ == "__main__":
    main()
