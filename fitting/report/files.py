"""The files of a report: text, JSON, picture and page."""

import json
from pathlib import Path
from typing import Any

from afm_jax.whole_files import write_whole


def write_report_files(
    folder: Path, name: str, *, text: str, data: dict[str, Any], picture: bytes, page: str
) -> list[Path]:
    """Write name.html, name.txt, name.json and name.png into a folder and return their paths.

    Args:
        folder: an existing folder; files of these names are replaced.
        name: of the files.
        text: the summary.
        data: everything, as JSON has it.
        picture: a PNG file.
        page: an HTML file.

    Raises:
        OSError: if a file cannot be written.
    """
    paths = [folder / f"{name}.{ending}" for ending in ("txt", "json", "png")]
    write_whole(paths[0], text + "\n")
    write_whole(paths[1], json.dumps(data, indent=1, allow_nan=False) + "\n")
    write_whole(paths[2], picture)
    write_whole(folder / f"{name}.html", page)
    return [folder / f"{name}.html", *paths]
