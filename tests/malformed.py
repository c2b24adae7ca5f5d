"""Malformed files and wrong calls, and the one line that each must end in: `tests/malformed.jsonl`, a line a case.

`{"base": NAME, "file": ..., "text": ...}` is a sound file of a format. `{"of": NAME, "call": ..., "old": ..., "new":
..., "says": ...}` is one with the first `old` replaced (all of them where it is a separator; the whole file without
`old`; `new` as bytes of Latin-1 where `"bytes": true`), the command, and what it says after `afm-jax: `, where
COMMANDS stands for the list of all commands. Without `new` the file stays sound and the call is wrong. All sound files
lie in the folder where commands run.

`python -m tests.malformed` writes the messages anew; read the difference before you keep it.
"""

import json
import os
import shlex
import tempfile
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from afm_jax.cli.main import COMMANDS
from afm_jax.cli.main import main as afm_jax

CORPUS = Path(__file__).with_suffix(".jsonl")
TABLE = Path(__file__).parent.parent / "fitting" / "examples" / "amplitudes_law.csv"
_SEPARATORS = (",", "\n")


def corpus() -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
    """Return the sound files by name, and the malformed ones."""
    lines = [json.loads(line) for line in CORPUS.read_text(encoding="utf-8").splitlines()]
    return {line["base"]: line for line in lines if "base" in line}, [line for line in lines if "of" in line]


def content(base: dict[str, Any], case: dict[str, Any]) -> bytes:
    """Return the bytes of a malformed file, or of the sound one that a wrong call is about."""
    if "new" not in case:
        return base["text"].encode()
    new, old = case["new"] * case.get("times", 1), case.get("old")
    if old is not None:
        assert old in base["text"], case
        new = base["text"].replace(old, new, -1 if old in _SEPARATORS else 1)
    return new.encode("latin-1" if case.get("bytes") else "utf-8")


def write_sound_files() -> None:
    """Write the sound file of every format into the working directory."""
    for base in corpus()[0].values():
        Path(base["file"]).write_text(base["text"], encoding="utf-8")


def run(base: dict[str, Any], case: dict[str, Any]) -> Result:
    """Run the command on the malformed file, in the working directory."""
    Path(base["file"]).write_bytes(content(base, case))
    words = {"FILE": base["file"], "TABLE": str(TABLE)}
    return CliRunner().invoke(
        afm_jax, [words.get(word, word) for word in shlex.split(case["call"])], prog_name="afm-jax"
    )


def line_of(result: Result) -> str:
    """Return what a command said on standard error, folders and the list of commands by one word each."""
    said = result.stderr.replace(", ".join(sorted(COMMANDS)), "COMMANDS")
    return said.replace(str(TABLE), "TABLE").replace(str(Path.cwd()), "HERE")


def main() -> None:
    """Write the corpus with the messages that the program gives."""
    bases, cases = corpus()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        write_sound_files()
        for case in cases:
            case["says"] = line_of(run(bases[case["of"]], case)).strip().removeprefix("afm-jax: ")
    lines = [json.dumps(line, ensure_ascii=False) for line in (*bases.values(), *cases)]
    CORPUS.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
