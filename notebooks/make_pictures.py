"""Make the pictures of README and of the pages anew, by the commands that stand beside them: `make pictures`.

Commands write PNG; the pages show the same figures as SVG. The picture of a fit is several figures and stays a PNG.
"""

import contextlib
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

from matplotlib.figure import Figure

from afm_jax.cli.main import main as run_command
from afm_jax.plots import picture_style

ROOT = Path(__file__).parent.parent
PAGES = ROOT / "notebooks" / "pages"
PICTURES = {
    "fit": "fit --example --out report",
    "invert": "invert --example --out report",
    "chart": "chart figure3 --x platform.reduced_frequency=0.4:4.4:300 --y platform.amplitude_nm=0.1:10:200"
    " --out chart",
    "branches": "continue scene.toml --order 1 --parameter platform.amplitude_nm=0.5:6 --out branches",
    "basins": "basins scene.toml --grid 100x100 --out basins",
    "bifurcation": "bifurcation figure2 --parameter platform.reduced_frequency=1.1:1.7:300 --both --out doublings",
    "lyapunov": "lyapunov figure2 --parameter platform.reduced_frequency=1.1:1.7:300 --out exponents",
    "accuracy": "accuracy map --out accuracy",
    "tapping": "tapping fitting/examples/tapping_resonance.csv --out report",
    "sweep": "sweep sweep.toml --out swept --plot",
    "collide": "collide --speeds 6:10:1,11:14:0.25,15:60:1 --out collide",
    "oscillator_bifurcation": "bifurcation oscillator.toml --parameter force.reduced_frequency=0.35:0.55:300 --both"
    " --ordinate impact_speed --out diagram",
}
"""The command that writes each picture, which has its last word as its name; files are those of the pages."""


def main() -> None:
    """Run the commands in a folder of their own and keep their pictures; names in the call choose some."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "fitting").symlink_to(ROOT / "fitting")
        pages = {"scene": "first_steps.md", "sweep": "sweeps.md", "oscillator": "oscillator.md"}
        for name, page in pages.items():
            block = re.search(
                r"^```toml\n(.*?)^```", (PAGES / page).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
            )
            assert block is not None
            (folder / f"{name}.toml").write_text(block.group(1), encoding="utf-8")
        for picture in sys.argv[1:] or [*PICTURES, "figure3"]:
            if picture == "figure3":
                subprocess.run([sys.executable, ROOT / "notebooks" / "figure3.py"], check=True)
                continue
            arguments = shlex.split(PICTURES[picture])
            print("afm-jax", *arguments)
            with contextlib.chdir(folder), kept_figures() as figures:
                run_command(arguments, standalone_mode=False)
            made = folder / arguments[arguments.index("--out") + 1] / f"{picture.rpartition('_')[2]}.png"
            figure = figures.get(made.read_bytes())
            if figure is None:
                shutil.copy(made, PAGES / "pictures" / made.name)
            else:
                (PAGES / "pictures" / f"{picture}.svg").write_bytes(picture_style.svg_of(figure))


@contextlib.contextmanager
def kept_figures() -> Iterator[dict[bytes, Figure]]:
    """Collect the figures that are drawn meanwhile, each under the bytes of the PNG file that shows it alone."""
    figures: dict[bytes, Figure] = {}
    pixels_of, png_of_pixels = picture_style.pixels_of, picture_style.png_of_pixels
    drawn: list[Figure] = []

    def pixels(figure: Figure, dpi: float) -> Any:
        drawn.append(figure)
        return pixels_of(figure, dpi)

    def png(image: Any, dpi: float) -> bytes:
        written = png_of_pixels(image, dpi)
        if len(drawn) == 1:
            figures[written] = drawn[0]
        drawn.clear()
        return written

    with (
        mock.patch.object(picture_style, "pixels_of", pixels),
        mock.patch.object(picture_style, "png_of_pixels", png),
    ):
        yield figures


if __name__ == "__main__":
    main()
