"""Sweeps killed at random times and resumed until they are done: nothing is lost, and the bytes are those of one run.

python -m tests.kills --times 50
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

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


def killed(line: list[str], folder: Path, enough: int, later_s: float) -> bool:
    """Start a program and kill it some time after it has done some more chunks; say whether it was not done before."""
    before = chunks_done(folder)
    with subprocess.Popen(line, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and chunks_done(folder) < before + enough:
            time.sleep(0.005)
        time.sleep(later_s)
        alive = process.poll() is None
        process.send_signal(signal.SIGKILL)
    return alive


def survive(line: list[str], folder: Path, *, times: int, chunks: int, seed: int) -> list[int]:
    """Kill a sweep some times, then let it end; return how many chunks each run computed.

    Raises:
        AssertionError: if a chunk that was done was lost or computed again.
    """
    chance = random.Random(seed)  # noqa: S311
    computed, done = [], 0
    for _ in range(times):
        # now and then before the first chunk, else after a share of those that are left
        enough = chance.choice([0, 1, max((chunks - done) // (times + 1), 1)])
        killed(line, folder, enough, chance.uniform(0.0, 0.2 if enough else 3.0))
        now = chunks_done(folder)
        assert now >= done, "a chunk was lost"
        computed.append(now - done)
        done = now
    last = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    assert last.returncode == 0, last.stderr
    told = json.loads(last.stdout)
    kept = told["chunks_kept"]
    assert kept == done, f"{done} chunks were done, but {kept} were kept"
    return [*computed, told["chunks_computed"]]


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(2)))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        subprocess.run(command(place, "whole"), cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        line = command(place, "killed")
        counts = survive(line, place / "killed", times=options.times, chunks=100, seed=options.seed)
        same = contents(place / "whole") == contents(place / "killed")
    sys.stdout.write(f"seed {options.seed}: {options.times} kills; chunks of each run: {counts}; same bytes: {same}\n")
    sys.exit(0 if same else 1)


if __name__ == "__main__":
    main()
