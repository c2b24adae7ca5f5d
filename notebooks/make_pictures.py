"""Make the pictures of README and of the pages anew, by the commands that stand beside them: `make pictures`."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parent.parent
PAGES = ROOT / "notebooks" / "pages"
PICTURES = {
    "fit": "fit --example --out report",
    "invert": "invert --example --out report",
    "chart": "chart figure3 --x platform.reduced_frequency=0.4:4.4:300 --y platform.amplitude_nm=0.1:10:200"
    " --out chart",
    "branches": "continue scene.toml --order 1 --parameter platform.amplitude_nm=0.5:6 --out branches",
    "basins": "basins scene.toml --grid 100x100 --out basins",
    "tapping": "tapping fitting/examples/tapping_resonance.csv --out report",
    "tapping_frames": "tapping fitting/examples/tapping_resonance.csv --out report",
    "sweep": "sweep sweep.toml --out swept --plot",
    "collide": "collide --speeds 6:10:1,11:14:0.25,15:60:1 --out collide",
}
"""The command that writes each picture; scene and sweep are those of the pages."""


def main() -> None:
    """Run the commands in a folder of their own and keep their pictures; names in the call choose some."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "fitting").symlink_to(ROOT / "fitting")
        for name, page in (("scene.toml", "first_steps.md"), ("sweep.toml", "sweeps.md")):
            block = re.search(
                r"^```toml\n(.*?)^```", (PAGES / page).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
            )
            assert block is not None
            (folder / name).write_text(block.group(1), encoding="utf-8")
        for picture in sys.argv[1:] or [*PICTURES, "figure3"]:
            if picture == "figure3":
                subprocess.run([sys.executable, ROOT / "notebooks" / "figure3.py"], check=True)
                continue
            arguments = shlex.split(PICTURES[picture])
            print("afm-jax", *arguments)
            subprocess.run([sys.executable, "-m", "afm_jax", *arguments], cwd=folder, check=True)
            made = folder / arguments[arguments.index("--out") + 1] / f"{picture}.png"
            shutil.copy(made, PAGES / "pictures" / made.name)


if __name__ == "__main__":
    main()
