"""Every command that writes into its `--out` folder, called as cheaply as it can be, and what it did there.

python -m tests.writing_commands [COMMAND...] tells for each which files it wrote, all of them checked for links first.
"""

import sys
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np
from click.testing import CliRunner

from afm_jax import whole_files
from afm_jax.cli.main import main

EXAMPLES = Path(__file__).parent.parent / "fitting" / "examples"
_REAL = EXAMPLES / "real"
_SWEEP = 'scene = "figure2"\n[record]\nwhat = "orbits"\norders = [1]\n[[axes]]\n'
_SWEEP += 'parameter = "platform.amplitude_nm"\nlinear = [2, 4, 3]\n'
_CHART = ("figure2", "--x", "platform.reduced_frequency=0.9:1.1:3", "--y", "platform.amplitude_nm=2:4:3")
_MAP = ("image.npz", "--free-frequency-khz", "90", "--quality-factor", "200", "--free-amplitude-nm", "10")
CALLS = {
    "accuracy": ("map", "--quick"),
    "basins": ("figure2", "--grid", "8x8"),
    "bench": ("--quick", "--only", "map"),
    "bifurcation": ("figure2", "--parameter", "platform.amplitude_nm=3:4:3", "--impacts", "200"),
    "calibrate": ("scan.csv",),
    "chart": (*_CHART, "--orders", "1"),
    "chart --zarr": (*_CHART, "--orders", "1", "--zarr"),
    "collide": ("--speeds", "20,30"),
    "continue": ("figure2", "--order", "1", "--parameter", "platform.amplitude_nm=3:4"),
    "design": ("--points", "2", "--orders", "1,2", "--free-frequency-khz", "90", "--quality-factor", "40"),
    "effects": ("figure8", "--accuracy", "10%", "--duration-us", "100", "--only", "viscous"),
    "fit": ("--example",),
    "fit --each": (str(EXAMPLES / "amplitudes_law.csv"), "--each", "--workers", "1"),
    "invert": ("--example",),
    "lockin": ("trace.csv",),
    "lyapunov": ("figure2", "--parameter", "platform.amplitude_nm=3:4:3", "--impacts", "100"),
    "orbits": ("figure2", "--order", "1"),
    "read": (str(_REAL / "tapping_approach_neasnom.txt"), "--free-frequency-khz", "250", "--quality-factor", "400"),
    "simulate": ("figure2", "--periods", "30", "--samples", "uniform"),
    "sweep": ("sweep.toml",),
    "tapping": (str(EXAMPLES / "tapping_resonance.csv"),),
    "tapping-map": (*_MAP, "--format", "npz", "--format", "gwy", "--format", "zarr"),
    "verify": (),
}
"""By the command and what tells its calls apart; files that they need are written by `prepare`."""


def prepare(folder: Path) -> None:
    """Write the files that calls name into a folder."""
    time = np.arange(0.0, 60.0 * 1000.0 / 180.0, 0.05)
    rows = np.stack([time, 3.0 * np.cos(2e-3 * np.pi * 180.0 * time)], 1)
    np.savetxt(folder / "trace.csv", rows, delimiter=",", header="time_us,deflection_nm", comments="")
    text = (folder / "trace.csv").read_text(encoding="utf-8")
    (folder / "trace.csv").write_text(f"# drive_frequency_khz = 180\n{text}", encoding="utf-8")
    np.savez(folder / "image.npz", amplitude=np.full((4, 5), 8.0), phase=np.full((4, 5), 70.0))
    (folder / "sweep.toml").write_text(_SWEEP, encoding="utf-8")
    frequency = np.linspace(85.0, 95.0, 41)
    response = 1.0 / np.hypot(1.0 - (frequency / 90.0) ** 2, frequency / 90.0 / 40.0)
    noise = 1.0 + 0.01 * np.random.default_rng(1).normal(size=41)
    rows = np.stack([frequency, response * noise], 1)
    np.savetxt(folder / "scan.csv", rows, delimiter=",", header="frequency_khz,amplitude_nm", comments="")


def unchecked(name: str, folder: Path) -> tuple[int, str, list[str], list[str]]:
    """Run a call in a folder made by `prepare`.

    Returns:
        The exit code, what was said on standard error, the files written into `--out`, and those of them that were
        not checked for links, below `--out`, before they were written.
    """
    out, looked = folder / f"out of {name}", set()
    check = whole_files.check_plain

    def noted(path: Path, **where: Path) -> None:
        check(path, **where)
        looked.add(Path(path).absolute())

    words = [str(folder / word) if (folder / word).is_file() else word for word in CALLS[name]]
    with mock.patch.object(whole_files, "check_plain", noted):
        result = CliRunner().invoke(main, [name.partition(" ")[0], *words, "--out", str(out), "--json"])
    files = [path for path in sorted(out.rglob("*")) if path.is_file() and path.name != "lock"]
    bad = [path for path in files if not looked & {path, *path.parents}]
    return result.exit_code, result.stderr, [str(path.relative_to(out)) for path in files], [str(path) for path in bad]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        prepare(Path(scratch))
        for call in sys.argv[1:] or CALLS:
            code, said, written, loose = unchecked(call, Path(scratch))
            last = said.strip().splitlines()[-1:] if code else []
            print(f"{call}: exit {code}, {len(written)} files, not checked: {loose} {' '.join(last)}", flush=True)
