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
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.compilation_cache import cache_folder, make_private, silence_xla
from afm_jax.strict_json import strict_json
from afm_jax.whole_files import check_plain, write_whole
from afm_jax.words import broken, lines_at_most, shown, text_table

if TYPE_CHECKING:
    from afm_jax.compilation_cache import Cache


FIT_PROGRAMS = tuple(
    f"fitting.forward:{name}" for name in ("impacts_of", "located", "linearise_pairs", "predict_pairs")
)
"""Jitted functions of a fit of the impact law whose traces are kept (see `Session.start_computing`)."""


def prepare_folder(folder: Path, *, within: Path | None = None) -> None:
    """Make a folder, with those above it, and check that a file can be written there.

    Args:
        folder: to be made.
        within: the user's own folder, below which no part may be a link.

    Raises:
        OSError: if it cannot be made or written to.
    """
    if within is not None:
        check_plain(folder, within=within)
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
    """Return a result with what it is, `format` and `format_version`, first, and with the call's notes (`add_note`)."""
    notes = _notes()
    told = {**payload, "notes": [*payload.get("notes", ()), *notes]} if notes else dict(payload)
    if "format" in payload:
        return told
    return {"format": f"afm-jax {click.get_current_context().info_name}", "format_version": 1, **told}


_NOTES = "afm_jax.notes"


def add_note(note: str) -> None:
    """Let the result of this call say a sentence: in its JSON under `notes`, in its text at the end."""
    context = click.get_current_context(silent=True)
    if context is not None and note not in context.meta.setdefault(_NOTES, []):
        context.meta[_NOTES].append(note)


def _notes() -> list[str]:
    context = click.get_current_context(silent=True)
    return [] if context is None else list(context.meta.get(_NOTES, ()))


def write_json(path: Path, payload: Mapping[str, Any]) -> None:
    """Write a result as a JSON file, whole or not at all."""
    write_whole(path, strict_json(labelled(payload)) + "\n")


_WIDTH_OF_A_PIPE = 10_000
"""Columns of text that nobody looks at in a terminal: no line is broken, no table turned."""


class _Wait:
    """Something being done, as the line that a terminal shows of it."""

    def __init__(self, what: str, parts: str, last_s: float | None) -> None:
        self.what, self.parts, self.last_s = what, parts, last_s
        self.begun = time.monotonic()
        self.first: tuple[float, int] | None = None
        self.done, self.total, self.rate, self.until = 0, 0, 0.0, math.inf

    def seconds(self) -> float:
        return time.monotonic() - self.begun

    def count(self, done: int, total: int) -> None:
        """Take note of how much is done; until the first call programs were compiled, which the rest need not be."""
        now = time.monotonic()
        since, before = self.first = self.first or (now, done)
        self.done, self.total = done, total
        self.rate = (done - before) / (now - since) if now > since else 0.0
        self.until = now + (total - done) / self.rate if self.rate > 0.0 else math.inf

    def counted(self, now: float) -> str:
        left = self.until - now
        return f"{self.done} of {self.total} {self.parts}" + (
            f", {_rate(self.rate)} a second, about {_duration(left)} left" if 0.0 < left < 1e6 else ""
        )

    def __rich__(self) -> Any:
        from rich.text import Text  # noqa: PLC0415

        return Text(shown(self.line()), overflow="ellipsis", no_wrap=True)

    def line(self) -> str:
        """Return what is known by now."""
        now = time.monotonic()
        known = self.what.partition(" (")[0]
        if self.first is not None:
            return f"{known}: {self.counted(now)}"
        if now - self.begun < _SECONDS_BETWEEN_NOTES:
            return self.what
        if self.last_s is None:
            return f"{self.what}: {_duration(now - self.begun)}"
        return f"{known}: {_duration(now - self.begun)}, last time {_duration(self.last_s)}"


_MOST_WAITS = 200


def _kept_waits() -> Path | None:
    """Return the file of how long waits took on this machine, beside the programs compiled for it, if any are kept."""
    folder = cache_folder()
    return folder / "waits.json" if folder is not None and folder.is_dir() else None


def _read_waits(path: Path) -> dict[str, float]:
    """Return the seconds that each wait took the last time; none where the file is missing or damaged."""
    try:
        return {name: float(seconds) for name, seconds in json.loads(path.read_text(encoding="utf-8")).items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return {}


def _keep_wait(path: Path, key: str, seconds: float) -> None:
    others = {name: value for name, value in _read_waits(path).items() if name != key}
    with suppress(OSError):
        write_whole(path, json.dumps(dict([*others.items(), (key, round(seconds, 1))][-_MOST_WAITS:])))


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

    @contextmanager
    def working(self, what: str, parts: str = "") -> Iterator[Callable[[int, int], None]]:
        """Tell on standard error what is being done, and from two seconds on how long it takes.

        A terminal shows for how long it has been going on and what it took the last time on this machine. What is
        counted is shown with the time that the rest takes: there, and where no terminal is as a line every two seconds.

        Args:
            what: is done; in brackets at its end what is told of a first run.
            parts: what is counted, by calls of what this gives: how many are done, of how many.
        """
        console = _console(stderr=True)
        command = click.get_current_context(silent=True)
        key = f"{command and command.info_name}: {what}"
        kept = _kept_waits() if console.is_terminal else None
        wait = _Wait(what, parts, None if kept is None else _read_waits(kept).get(key))
        if kept is None:
            last = time.monotonic()

            def report(done: int, total: int) -> None:
                nonlocal last
                wait.count(done, total)
                if time.monotonic() - last > _SECONDS_BETWEEN_NOTES:
                    last = time.monotonic()
                    self.note(wait.counted(last))

            yield report
            return
        with console.status(wait):
            yield wait.count
        if wait.seconds() > _SECONDS_BETWEEN_NOTES:
            _keep_wait(kept, key, wait.seconds())

    def emit(self, payload: Mapping[str, Any], *text: Any) -> None:
        """Write the result to standard output: the JSON object if asked for, else the text.

        Args:
            payload: the object; arrays become lists, NaN and infinity null.
            text: strings, rich tables, and functions that return a string, one below the other; None: nothing. In a
                terminal lines break between words, and tables that are too wide for it are turned.
        """
        if self.json:
            click.echo(strict_json(labelled(payload)))
            return
        console = _console(stderr=False)
        with lines_at_most(console.width):
            for part in (*text, *(f"Note: {note}" for note in _notes())):
                if part is None:
                    continue
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


def _rate(per_second: float) -> str:
    return f"{per_second:,.0f}" if per_second >= 10.0 else f"{per_second:.2g}"


def _counted(asked: int, read: int) -> str:
    return f"{read} compiled programs were read, {asked - read} were compiled"


def _broken(text: str, width: int) -> str:
    """Return a text whose lines break between words, below where they begin; words and numbers stay whole."""
    lines = []
    for line in text.split("\n"):
        indent = " " * (len(line) - len(line.lstrip()))
        indent += indent and "  "
        lines += [line] if len(line) <= width else broken(line, width, indent)
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
