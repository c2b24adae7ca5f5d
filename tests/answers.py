"""What a command answers: its JSON, and that the files of `--out` hold it and can be opened."""

import csv
from pathlib import Path
from typing import Any

from click.testing import CliRunner
from matplotlib.image import imread

from afm_jax.cli.main import main
from tests.strict_reading import strictly


def answer(folder: Path, *arguments: object) -> dict[str, Any]:
    """Return the JSON object of a call that writes into a folder.

    The folder's own `*.json` holds what is printed, tables have a name for every cell, pictures are not blank.
    """
    result = CliRunner().invoke(main, [*map(str, arguments), "--json", "--out", str(folder)])
    assert result.exit_code == 0, result.stderr
    payload = strictly(result.stdout)
    kept = [strictly(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")]
    # a saved result holds what loading it needs besides
    assert not kept or any(one | payload == one for one in kept)
    for path in folder.glob("*.csv"):
        rows = table(path)
        assert rows, path
        assert all(None not in row and None not in row.values() for row in rows), path
    for path in folder.glob("*.png"):
        assert imread(path)[..., :3].std() > 0.02, path
    return payload


def table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file, without its comments."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))
