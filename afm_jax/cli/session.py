"""What every command shares: `--json`, `--out`, `--verbose`, messages on standard error, and how computing starts.

>>> import click
>>> from afm_jax.cli.session import Session, with_session
>>> @click.command()
... @with_session
... def command(session: Session) -> None:
...     session.start_computing()  # only then import JAX and what needs it
...     session.emit({"answer": 42}, "The answer is 42.")

The `--out` folder: made and tried out before the computation, and the tables in it.
"""

import csv
import functools
import io
import math
import os
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.compilation_cache import cache_folder, make_private, silence_xla
from afm_jax.strict_json import strict_json
from afm_jax.whole_files import write_whole
from afm_jax.words import lines_at_most, shown, text_table

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


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Write rows as CSV; numbers with all their digits, true and false in words, what is unknown as an empty cell."""
    _write_rows(path, columns, ([_cell(row.get(column)) for column in columns] for row in rows))


def _write_rows(path: Path, head: Iterable[str], rows: Iterable[Iterable[Any]], comments: Iterable[str] = ()) -> None:
    text = io.StringIO()
    text.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    write_whole(path, text.getvalue())


def _cell(value: Any) -> Any:
    plain = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(plain, bool):
        return "true" if plain else "false"
    if plain is None or (isinstance(plain, float) and not math.isfinite(plain)):
        return ""
    return plain


def _cells(column: Any) -> Any:
    """Return the cells of a column, many at a time."""
    if not hasattr(column, "dtype") or column.dtype.kind not in "fb":
        return (_cell(value) for value in column)
    if column.dtype.kind == "b":
        return ("true" if value else "false" for value in column.tolist())
    return (value if math.isfinite(value) else "" for value in column.tolist())


_SECONDS_BETWEEN_NOTES = 2.0


def labelled(payload: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result with what it is, `format` and `format_version`, first; one that says so itself as it is."""
    if "format" in payload:
        return dict(payload)
    return {"format": f"afm-jax {click.get_current_context().info_name}", "format_version": 1, **payload}


def write_json(path: Path, payload: Mapping[str, Any]) -> None:
    """Write a result as a JSON file, whole or not at all."""
    write_whole(path, strict_json(labelled(payload)) + "\n")


_WIDTH_OF_A_PIPE = 10_000
"""Columns of text that nobody looks at in a terminal: no line is broken, no table turned."""


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

    def start_computing(self, *programs: str) -> "Cache":
        """Start JAX with 64-bit floats and its compilation cache; call it before importing the physics.

        Args:
            programs: jitted functions whose traces are kept as well, "module:function" (see `keep_programs`).
        """
        from afm_jax.cli.compilation import count_programs, start_jax  # noqa: PLC0415

        cache = start_jax(self.tell)
        if self.verbose:
            counts = count_programs()
            click.get_current_context().call_on_close(lambda: self.tell(_counted(**counts)))
        if programs and cache.folder is not None and cache.folder == cache_folder():
            from afm_jax.cli.programs import keep_programs  # noqa: PLC0415

            try:
                make_private(cache.folder / "traced")
                keep_programs(programs, cache.folder / "traced", self.tell)
            except OSError as error:
                self.tell(f"traced programs are not kept: {error.filename}: {error.strerror}")
        return cache

    def tell(self, message: str) -> None:
        """Write a message to standard error, if such messages were asked for."""
        if self.verbose:
            self.note(message)

    def note(self, message: str) -> None:
        """Write a message to standard error."""
        _console(stderr=True).print(shown(message), markup=False, highlight=False, soft_wrap=True)

    def progress(self, what: str) -> Callable[[int, int], None]:
        """Return what tells on standard error, every two seconds at most, what is done and how long the rest takes."""
        first = last = time.monotonic()

        def report(done: int, total: int) -> None:
            nonlocal last
            if time.monotonic() - last > _SECONDS_BETWEEN_NOTES:
                last = time.monotonic()
                left = (last - first) * (total - done) / done if done else math.inf
                self.note(f"{done} of {total} {what}" + (f", about {_duration(left)} left" if 0.0 < left < 1e6 else ""))

        return report

    def working(self, what: str) -> AbstractContextManager[object]:
        """Show on standard error what is being done, for as long as it takes, if that is a terminal."""
        return _console(stderr=True).status(shown(what))

    def emit(self, payload: Mapping[str, Any], *text: Any) -> None:
        """Write the result to standard output: the JSON object if asked for, else the text.

        Args:
            payload: the object; arrays become lists, NaN and infinity null.
            text: strings, rich tables, and functions that return a string, one below the other. In a terminal lines
                break between words, and tables that are too wide for it are turned.
        """
        try:
            self._print(payload, text)
        except OSError as error:
            # a pipe that nobody reads any more is no fault
            if isinstance(error, BrokenPipeError) or error.filename is not None:
                raise
            raise OSError(error.errno, f"cannot be written ({error.strerror})", "standard output") from error

    def _print(self, payload: Mapping[str, Any], text: tuple[Any, ...]) -> None:
        if self.json:
            click.echo(strict_json(labelled(payload)))
            return
        console = _console(stderr=False)
        with lines_at_most(console.width):
            for part in text:
                words = part if isinstance(part, str) else part() if callable(part) else _table_text(console, part)
                if isinstance(words, str):
                    words = _broken(shown(words), console.width)
                    console.print(words, markup=False, highlight=False, soft_wrap=True)
                else:
                    console.print(words)
        sys.stdout.flush()

    def write_table(self, name: str, rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
        """Write a table as CSV into the `--out` folder, if there is one, and say so.

        Args:
            name: file name, "orbits.csv".
            rows: a mapping from column to value each; what is missing, None or not finite stays empty.
            columns: the columns in order.
        """
        if self.out is not None:
            write_csv(self.out / name, rows, columns)
            self.note(f"wrote {self.out / name}")

    def write_columns(self, name: str, columns: Mapping[str, Any], comments: Iterable[str] = ()) -> None:
        """Write a long table as CSV into the `--out` folder, if there is one, and say so.

        Args:
            name: file name.
            columns: lists or arrays of one length, in order; what is not finite stays empty.
            comments: lines above the table, each after a number sign.
        """
        if self.out is None:
            return
        _write_rows(self.out / name, columns, zip(*map(_cells, columns.values()), strict=True), comments)
        self.note(f"wrote {self.out / name}")


def with_session(function: Callable[..., Any] | None = None, *, out_file: str = "") -> Any:
    """Give a command `--json`, `--out` and `--verbose`, and pass it a `Session` as first argument.

    Args:
        function: the command's function; None gives the decorator.
        out_file: what the file is called that `--out` names, for a command that writes a single one; empty: a folder.
    """
    if function is None:
        return functools.partial(with_session, out_file=out_file)

    @click.option("--json", "as_json", is_flag=True, help="Write one JSON object to standard output, nothing else.")
    @click.option(
        "--out",
        metavar=out_file or "DIR",
        type=click.Path(path_type=Path),
        callback=functools.partial(_prepared, is_file=bool(out_file)),
        help="Write this table." if out_file else "Write tables (CSV) and pictures (PNG) into this folder.",
    )
    @click.option("--verbose", is_flag=True, help="Say on standard error what is kept, read and compiled, and where.")
    @functools.wraps(function)
    def command(*args: Any, as_json: bool, out: Path | None, verbose: bool, **options: Any) -> Any:
        # before anything loads JAX: checks of options may
        silence_xla()
        return function(Session(as_json, out, verbose), *args, **options)

    return command


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


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"


def _counted(asked: int, read: int) -> str:
    return f"{read} compiled programs were read, {asked - read} were compiled"


def _broken(text: str, width: int) -> str:
    """Return a text whose lines break between words, below where they begin; words and numbers stay whole."""
    lines = []
    for line in text.split("\n"):
        indent = " " * (len(line) - len(line.lstrip()))
        indent += indent and "  "
        lines += (
            [line]
            if len(line) <= width
            else textwrap.wrap(
                line,
                width,
                subsequent_indent=indent,
                break_long_words=False,
                break_on_hyphens=False,
                replace_whitespace=False,
            )
        )
    return "\n".join(lines)


def _table_text(console: Any, table: Any) -> Any:
    """Return a table of rich; as the text of one that is turned, where the terminal is too narrow for it."""
    from rich.measure import Measurement  # noqa: PLC0415

    whole = console.options.update(width=_WIDTH_OF_A_PIPE, max_width=_WIDTH_OF_A_PIPE)
    if Measurement.get(console, whole, table).maximum <= console.width:
        return table
    head = [str(column.header).replace("\n", " ") for column in table.columns]
    rows = zip(*([str(cell) for cell in column.cells] for column in table.columns), strict=True)
    return "\n".join([*([str(table.title)] if table.title else []), *text_table(head, list(rows))])


def _console(*, stderr: bool) -> Any:
    from rich.console import Console  # noqa: PLC0415

    stream = sys.stderr if stderr else sys.stdout
    asked = os.environ.get("COLUMNS", "")
    width = int(asked) if asked.isdigit() and int(asked) else None
    return Console(stderr=stderr, width=width or (None if stream.isatty() else _WIDTH_OF_A_PIPE))
