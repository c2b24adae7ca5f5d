"""The amplitude table that commands have as their example."""

from pathlib import Path

import fitting.examples


def example_path() -> Path:
    """Return where the bundled table of `--example` lies, the short way if that is below the working folder."""
    path = Path(fitting.examples.__path__[0]) / "amplitudes_law.csv"
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
