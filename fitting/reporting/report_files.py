"""The three files of every report: the summary as text, everything as JSON, the picture."""

import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure


def write_report_files(folder: Path, name: str, *, text: str, data: dict[str, Any], picture: Figure) -> list[Path]:
    """Write name.txt, name.json and name.png into a folder and return their paths.

    Args:
        folder: an existing folder; files of these names are replaced.
        name: of the files.
        text: the summary.
        data: everything, as JSON has it.
        picture: the figure.

    Raises:
        OSError: if a file cannot be written.
    """
    paths = [folder / f"{name}.{ending}" for ending in ("txt", "json", "png")]
    paths[0].write_text(text + "\n", encoding="utf-8")
    paths[1].write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    picture.savefig(paths[2], dpi=150)
    return paths
