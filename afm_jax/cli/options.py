"""Options that several commands have."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from afm_jax.cli.values import Share, ValueAndError


def flag(name: str, text: str, *, into: str | None = None) -> Callable[..., Any]:
    """Return an option without a value: its name, what help says of it, and the function's argument if not its name."""
    return click.option(*((name,) if into is None else (name, into)), is_flag=True, help=text)


def valued(name: str, kind: Any, text: str, *, into: str | None = None, **more: Any) -> Callable[..., Any]:
    """Return an option with a value of a kind: as `flag`, and what else click takes."""
    return click.option(*((name,) if into is None else (name, into)), type=kind, help=text, **more)


SCENE = click.argument("scene", metavar="SCENE.toml|PRESET", type=click.Path())
"""The scene that is loaded before the command's function is called, which gets it as a `NamedScene`."""
LAW = click.option(
    "--law",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A fit's fit.json or law.csv, a law.json of `collide --make-law`, or a CSV of measured speeds: its law in "
    "place of the scene's, its errors as bands.",
)
"""With `SCENE` it is loaded, too: the scene has its law then."""
DRAWS = valued("--draws", click.IntRange(2), "Laws drawn from the fit for the bands.", default=20)
NOISE = valued("--noise", Share("a relative error"), "Relative error of amplitudes without one, such as 1%.")
QUALITY_FACTOR = valued(
    "--quality-factor", ValueAndError(none=True), "Instead of the table's; '40 +- 2', or none: no air damping."
)
