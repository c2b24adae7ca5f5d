"""The lower bounds of pyproject.toml as constraints for pip, one exact version a line: `python -m tests.lower_bounds`.

`make oldest` installs them, extras included.
"""

import re
import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).parent.parent / "pyproject.toml"
_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(\[[\w,.-]+\])?>=(?P<lowest>[\d.]+)(,.*)?")


def lower_bounds(project: Path = PROJECT) -> dict[str, str]:
    """Return the lower bound of every package that a project, its extras included, asks for.

    Raises:
        ValueError: if a package has no lower bound, or two.
    """
    listed = tomllib.loads(project.read_text("utf-8"))["project"]
    lines = [*listed["dependencies"], *(line for lines in listed["optional-dependencies"].values() for line in lines)]
    found: dict[str, str] = {}
    for line in lines:
        if line.startswith(f"{listed['name']}["):
            continue
        parts = _REQUIREMENT.fullmatch(line)
        if parts is None or found.setdefault(parts["name"], parts["lowest"]) != parts["lowest"]:
            raise ValueError(f"{project.name}: a package must have one lower bound, but see {line!r}")
    return found


if __name__ == "__main__":
    sys.stdout.writelines(f"{name}=={lowest}\n" for name, lowest in lower_bounds().items())
