"""Sweeps killed at random times and resumed until they are done: nothing is lost, and the bytes are those of one run.

python -m tests.kills --times 50
"""

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.sweep_numbers import contents

ROOT = Path(__file__).parent.parent
_SWEEP = """
scene = "figure2"
chunk = 1000
[record]
what = "orbits"
orders = [1, 2]
[[axes]]
parameter = "platform.amplitude_nm"
linear = [1, 8, 100]
[[axes]]
parameter = "platform.reduced_frequency"
linear = [0.4, 4.4, 1000]
"""


def command(place: Path, folder: str) -> list[str]:
    """Return the command line of a sweep."""
    sweep = place / "sweep.toml"
    sweep.write_text(_SWEEP)
    arguments = ["sweep", str(sweep), "--out", str(place / folder), "--workers", "1", "--json"]
    return [sys.executable, "-m", "afm_jax", *arguments]


def chunks_done(folder: Path) -> int:
    """Return how many chunks of a sweep's folder are marked as computed, without looking into them."""
    return sum(path.suffix == "" and path.is_file() for path in folder.glob("sweep.zarr/computed/c/**/*"))


def survive(line: list[str], folder: Path, times: int, longest_s: float, chance: random.Random) -> list[int]:
    """Kill a sweep some times, then let it end; return how many chunks each run computed.

    Raises:
        AssertionError: if a chunk that was done was lost or computed again.
    """
    done = [0]
    for _ in range(times):
        with subprocess.Popen(line, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            time.sleep(chance.uniform(0.0, longest_s))
            process.kill()
        done.append(chunks_done(folder))
        assert done[-1] >= done[-2], "a chunk was lost"
    told = json.loads(subprocess.run(line, cwd=ROOT, capture_output=True, check=True).stdout)
    assert told["chunks_kept"] == done[-1], f"{done[-1]} chunks were done, but {told['chunks_kept']} were kept"
    return [*np.diff(done).tolist(), told["chunks_computed"]]


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(2)))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        place, began = Path(scratch), time.monotonic()
        subprocess.run(command(place, "whole"), cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        longest_s = time.monotonic() - began
        chance = random.Random(options.seed)  # noqa: S311
        counts = survive(command(place, "killed"), place / "killed", options.times, longest_s, chance)
        same = contents(place / "whole") == contents(place / "killed")
    sys.stdout.write(f"seed {options.seed}: {options.times} kills; chunks of each run: {counts}; same bytes: {same}\n")
    sys.exit(0 if same else 1)


if __name__ == "__main__":
    main()
