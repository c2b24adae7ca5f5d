"""Commands that write into their `--out` folder in ways of their own, called cheaply, and what they did there."""

from pathlib import Path
from unittest import mock

import numpy as np
from click.testing import CliRunner

from afm_jax import whole_files
from afm_jax.cli.main import main

EXAMPLES = Path(__file__).parent.parent / "fitting" / "examples"
_APPROACH = str(EXAMPLES / "real" / "tapping_approach_neasnom.txt")
_SWEEP = 'scene = "figure2"\n[record]\nwhat = "orbits"\norders = [1]\n[[axes]]\n'
_SWEEP += 'parameter = "platform.amplitude_nm"\nlinear = [2, 4, 3]\n'
_CHART = ("figure2", "--x", "platform.reduced_frequency=0.9:1.1:3", "--y", "platform.amplitude_nm=2:4:3")
CALLS = {
    "chart": (*_CHART, "--orders", "1"),
    "lockin": ("trace.csv",),
    "orbits": ("figure2", "--order", "1"),
    "read": (_APPROACH, "--free-frequency-khz", "250", "--quality-factor", "400"),
    "simulate": ("figure2", "--periods", "30", "--samples", "uniform"),
    "sweep": ("sweep.toml",),
}
"""By the command and what tells its calls apart; files that they need are written by `prepare`."""


def prepare(folder: Path) -> None:
    """Write the files that calls name into a folder."""
    time = np.arange(0.0, 60.0 * 1000.0 / 180.0, 0.05)
    rows = np.stack([time, 3.0 * np.cos(2e-3 * np.pi * 180.0 * time)], 1)
    head = "# drive_frequency_khz = 180\ntime_us,deflection_nm"
    np.savetxt(folder / "trace.csv", rows, delimiter=",", header=head, comments="")
    (folder / "sweep.toml").write_text(_SWEEP, encoding="utf-8")


def unchecked(name: str, folder: Path) -> tuple[int, str, list[str], list[str]]:
    """Run a call in a folder made by `prepare`.

    Returns:
        The exit code, what was said on standard error, the files written into `--out`, and those of them that were
        not checked for links, below `--out`, before they were written.
    """
    out, looked = folder / f"out of {name}", set()
    check = whole_files.check_plain

    def noted(path: Path) -> None:
        check(path)
        looked.add(Path(path).absolute())

    words = [str(folder / word) if (folder / word).is_file() else word for word in CALLS[name]]
    with mock.patch.object(whole_files, "check_plain", noted):
        result = CliRunner().invoke(main, [name.partition(" ")[0], *words, "--out", str(out), "--json"])
    files = [path for path in sorted(out.rglob("*")) if path.is_file() and path.name != "lock"]
    bad = [path for path in files if not looked & {path, *path.parents}]
    return result.exit_code, result.stderr, [str(path.relative_to(out)) for path in files], [str(path) for path in bad]
