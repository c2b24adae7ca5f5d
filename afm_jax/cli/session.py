"""What every command shares: `--json`, `--out`, `--verbose`, messages and progress, files, and how computing starts.

The `--out` folder is made and tried out before the computation.
"""

import functools
import math
import os
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.columns import csv_text
from afm_jax.strict_json import strict_json
from afm_jax.whole_files import in_callers_words, write_whole
from afm_jax.words import shown

if TYPE_CHECKING:
    from afm_jax.compilation_cache import Cache


def prepare_folder(folder: Path) -> None:
    """Make a folder, with those above it, and check that a file can be written there.

    Raises:
        OSError: if it cannot be made or written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass


def labelled(payload: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result with what it is, `format` and `format_version`, first, and with the call's notes (`add_note`)."""
    notes = _notes()
    told = {**payload, "notes": [*payload.get("notes", ()), *notes]} if notes else dict(payload)
    if "format" in payload:
        return told
    return {"format": f"afm-jax {click.get_current_context().info_name}", "format_version": 1, **told}


_NOTES = "afm_jax.notes"


def add_note(*notes: str) -> None:
    """Let the result of this call say sentences: in its JSON under `notes`, in its text at the end."""
    context = click.get_current_context(silent=True)
    if context is not None:
        said = context.meta.setdefault(_NOTES, [])
        said += [note for note in notes if note not in said]


def _notes() -> list[str]:
    context = click.get_current_context(silent=True)
    return [] if context is None else list(context.meta.get(_NOTES, ()))


def write_json(path: Path, payload: Mapping[str, Any]) -> None:
    """Write a result as a JSON file, whole or not at all."""
    write_whole(path, strict_json(labelled(payload)) + "\n")


WIDTH_OF_A_PIPE = 10_000
"""Columns of text that nobody looks at in a terminal: no line is broken, no table turned."""
_SECONDS_BETWEEN_NOTES = 2.0


@dataclass(frozen=True)
class Session:
    """One call of a command.

    Attributes:
        json: write one JSON object to standard output, and nothing else there.
        out: folder for tables and pictures, made already, or the file to write; None if none was asked for.
        verbose: say on standard error what goes on behind: the cache, what is compiled.
    """

    json: bool
    out: Path | None
    verbose: bool = False

    def start_computing(self) -> "Cache":
        """Start JAX with 64-bit floats and its compilation cache; call it before importing the physics."""
        from afm_jax.cli.compilation import count_programs, start_jax  # noqa: PLC0415

        cache = start_jax(self.tell)
        if self.verbose:
            counts = count_programs()
            click.get_current_context().call_on_close(
                lambda: self.tell(
                    f"{counts['read']} compiled programs were read, {counts['asked'] - counts['read']} were compiled"
                )
            )
        return cache

    def tell(self, message: str) -> None:
        """Write a message to standard error, if such messages were asked for."""
        if self.verbose:
            self.note(message)

    def note(self, message: str) -> None:
        """Write a message to standard error."""
        _console(stderr=True).print(shown(in_callers_words(message)), markup=False, highlight=False, soft_wrap=True)

    @contextmanager
    def working(self, what: str, parts: str = "") -> Iterator[Callable[[int, int], None]]:
        """Report work in progress on standard error, for as long as a block lasts.

        A terminal shows it with a clock, and counted work also with its rate and the remaining time; without a terminal
        a line with these is printed every two seconds. Rates are those since the first count: before it programs were
        compiled.

        Args:
            what: the work; in brackets at its end a remark about a first run.
            parts: what is counted, by calls of what this gives: how many are done, of how many.
        """
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn  # noqa: PLC0415
        from rich.table import Column  # noqa: PLC0415

        console = _console(stderr=True)
        words = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
        progress = Progress(
            SpinnerColumn(),
            TimeElapsedColumn(),
            words,
            console=console,
            disable=not console.is_terminal,
            transient=True,
            get_time=time.monotonic,
            speed_estimate_period=math.inf,
        )
        number = progress.add_task(shown(what), total=None)
        (task,) = progress.tasks
        last = time.monotonic()

        def report(done: int, total: int) -> None:
            nonlocal last
            progress.update(number, completed=done, total=total)
            told = f"{done} of {total} {parts}"
            if task.speed and task.time_remaining:
                rate = f"{task.speed:,.0f}" if task.speed >= 10.0 else f"{task.speed:.2g}"
                left = float(task.time_remaining)
                told += f", {rate} a second, about {f'{left:.0f} s' if left < 120.0 else f'{left / 60.0:.0f} min'} left"
            task.description = f"{shown(what.partition(' (')[0])}: {told}"
            if progress.disable and time.monotonic() - last > _SECONDS_BETWEEN_NOTES:
                last = time.monotonic()
                self.note(told)

        with progress:
            yield report

    def emit(self, payload: Mapping[str, Any], *text: Any) -> None:
        """Write the result to standard output: the JSON object if asked for, else the text.

        Args:
            payload: the object; arrays become lists, NaN and infinity null.
            text: results, parts of sections, and functions that return a string, one below the other; None: nothing. In
                a terminal lines break between words, and tables that are too wide for it are turned.
        """
        from afm_jax.report import lines_of  # noqa: PLC0415 (help needs no NumPy)

        if self.json:
            click.echo(in_callers_words(strict_json(labelled(payload))))
            return
        width = _console(stderr=False).width
        lines = lines_of(*(part() if callable(part) else part for part in text), width=width)
        for line in (*lines, *(f"Note: {note}" for note in _notes())):
            click.echo(_broken(shown(in_callers_words(line)), width))

    def write_columns(self, name: str, columns: Mapping[str, Any], comments: Iterable[str] = ()) -> None:
        """Write a table as CSV into the `--out` folder, if there is one, and say so.

        Args:
            name: file name.
            columns: lists or arrays of one length, in order; what is None or not finite stays empty.
            comments: lines above the table, each after a number sign.
        """
        if self.out is None:
            return
        write_whole(self.out / name, csv_text(columns, comments))
        self.note(f"wrote {self.out / name}")


def session_options(out_file: str) -> list[click.Option]:
    """Return the options of every command, which are the attributes of its session.

    Args:
        out_file: what the file is called that `--out` names, for a command that writes a single one; empty: a folder.
    """
    return [
        click.Option(["--json"], is_flag=True, help="Write one JSON object to standard output, nothing else."),
        click.Option(
            ["--out"],
            metavar=out_file or "DIR",
            type=click.Path(path_type=Path),
            callback=functools.partial(_prepared, is_file=bool(out_file)),
            help="Write this table." if out_file else "Write tables (CSV) and pictures (PNG) into this folder.",
        ),
        click.Option(
            ["--verbose"], is_flag=True, help="Say on standard error what is kept, read and compiled, and where."
        ),
    ]


def _prepared(ctx: click.Context, parameter: click.Parameter, folder: Path | None, *, is_file: bool) -> Path | None:
    """Make the folder before anything is computed, so that no result is lost at the end."""
    if folder is None or ctx.resilient_parsing:
        return folder
    try:
        prepare_folder(folder.parent if is_file and folder.suffix else folder)
    except OSError as error:
        raise click.BadParameter(
            f"{folder}: cannot write there ({error.strerror}); choose another folder", ctx=ctx, param=parameter
        ) from error
    return folder


def _broken(text: str, width: int) -> str:
    """Return a text whose lines break between words, below where they begin; a value keeps its error beside it."""
    lines = []
    for line in text.replace(" +- ", "\0+-\0").split("\n"):
        indent = " " * (len(line) - len(line.lstrip()))
        hanging: dict[str, Any] = {"subsequent_indent": indent and f"{indent}  ", "break_long_words": False}
        lines += textwrap.wrap(line, width, **hanging, break_on_hyphens=False) if len(line) > width else [line]
    return "\n".join(lines).replace("\0", " ")


def _console(*, stderr: bool) -> Any:
    from rich.console import Console  # noqa: PLC0415

    stream = sys.stderr if stderr else sys.stdout
    asked = os.environ.get("COLUMNS", "")
    width = int(asked) if asked.isdigit() and int(asked) else None
    return Console(stderr=stderr, width=width or (None if stream.isatty() else WIDTH_OF_A_PIPE))
