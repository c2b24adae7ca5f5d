"""A command is a row: name, group, the function that it calls, and options besides those of the function.

The rows stand in `afm_jax/cli/commands.py`. Help and options come from the function's docstring and signature
(`options.py`), without JAX, so that help needs none. The function stands in a module that imports all that it needs at
its top: the runner starts JAX before it imports the module. The function gets the session (for progress and messages)
and the options by their names, and returns an `Output`, which the runner writes (None: the function has written all
itself):

    def basins(session: Session, scene: NamedScene, *, draws: Annotated[int, IntRange(2)] = 20) -> Output:
        with session.working("following starts", "starts") as report:
            result = basins_of_attraction(scene.scene, report=report)
        return Output.of(result, files={"basins.png": picture_of("dynamics:basins_figure", result)})

Of a result `as_json` is the JSON object, `sections` what is written in the terminal, `csv_columns` are the columns of
CSV files by the files' names, `reason` is why it is not valid.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from afm_jax.cli.ending import NotValid, is_inner
from afm_jax.cli.options import SCENE, described
from afm_jax.cli.session import Session, session_options, write_json
from afm_jax.columns import csv_columns
from afm_jax.compilation_cache import silence_xla
from afm_jax.whole_files import arguments_named, in_callers_words


@dataclass(frozen=True, kw_only=True)
class Output:
    """What a command hands out.

    Attributes:
        payload: the JSON object.
        text: what is printed without --json, as `Session.emit` takes it.
        impact_speeds: approach speeds of its impacts: the text's last line and `extrapolated` say whether the
            scene's law is known at them; None: they do not.
        tables: columns by their names for each CSV file of the --out folder, by its name.
        files: functions that write a file of the --out folder at a path each, by its name.
        json_file: name of the file of the --out folder that holds the JSON object; empty: none does.
        report: writes a report into a folder and returns the paths.
        not_valid: why the result is not valid, which makes the exit code 3; None: it is valid.
    """

    payload: Mapping[str, Any]
    text: Sequence[Any] = ()
    impact_speeds: Any = None
    tables: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    files: Mapping[str, Callable[[Path], object]] = field(default_factory=dict)
    json_file: str = ""
    report: Callable[..., Sequence[Path]] | None = None
    not_valid: str | None = None

    @classmethod
    def of(cls, result: Any, stem: str = "", **more: Any) -> "Output":
        """Return what is handed out of a result.

        Args:
            result: has `reason`, or `valid` and `reasons`, and where its impacts may be extrapolated
                `impact_speeds_nm_per_us`; `as_json`, `sections` and `csv_columns` know its kind.
            stem: what its picture and its JSON file are called; empty: it has none.
            **more: pictures, and what else the output has.
        """
        from afm_jax.saved import as_json  # noqa: PLC0415 (help needs no NumPy)

        reason, reasons = getattr(result, "reason", None), getattr(result, "reasons", None)
        told = {
            "payload": as_json(result) | ({"reason": reason} if hasattr(result, "reason") else {}),
            "text": [result],
            "tables": {} if more.keys() & {"tables", "report"} else csv_columns(result),
            "impact_speeds": getattr(result, "impact_speeds_nm_per_us", None),
            "not_valid": reason if reasons is None else next(iter(reasons), None),
        }
        if stem:
            save = later("afm_jax.plots.picture_style:save")
            told |= {"files": {f"{stem}.png": lambda path: save(result.plot(), path)}, "json_file": f"{stem}.json"}
        return cls(**told | more)


def later(function: str) -> Callable[..., Any]:
    """Return a function, "module:function", whose module is imported when it is called: pictures need matplotlib.

    A module that begins with a point is of this folder.
    """
    module, _, name = function.partition(":")

    def call(*arguments: Any, **options: Any) -> Any:
        return getattr(import_module(module, __package__), name)(*arguments, **options)

    return call


def picture_of(figure: str, *arguments: Any, **options: Any) -> Callable[[Path], None]:
    """Return a function that draws a figure of `afm_jax.plots`, "module:function" of some arguments, into a file."""

    def draw(path: Path) -> None:
        later("afm_jax.plots.picture_style:save")(later(f"afm_jax.plots.{figure}")(*arguments, **options), path)

    return draw


@dataclass(frozen=True)
class Command:
    """A command of `afm-jax`.

    Attributes:
        name: what is typed.
        group: the heading under which it is listed.
        runs: the function that is called, "module:function"; a module that begins with a point is of this folder.
        more: options besides those of the function: some, or a class that has them, named likewise (`described`).
        computes: whether JAX is started, before the function's module is imported.
        out_file: what the file is called that --out names, for a command that writes a single one; empty: a folder.
        apart: pairs of options that contradict each other, "one other".
        needs: pairs of options of which the first needs the second.
        one_of: an argument and an option, one of which is given, "argument option".
    """

    name: str
    group: str
    runs: str
    more: Sequence[click.Option | str] = ()
    computes: bool = True
    out_file: str = ""
    apart: Sequence[str] = ()
    needs: Sequence[str] = ()
    one_of: str = ""

    @property
    def summary(self) -> str:
        """The line of `afm-jax --help`."""
        return described(self.runs)[0].partition("\n\n")[0]

    def click_command(self) -> click.Command:
        """Return the command for click."""
        text, parameters = described(self.runs)
        more = [described(each)[1] if isinstance(each, str) else (each,) for each in self.more]
        parameters = [*parameters, *(option for options in more for option in options)]
        parameters += session_options(self.out_file)
        return click.Command(
            self.name, callback=partial(run_command, self), params=parameters, help=text.replace("\\b\n", "\b\n")
        )


def check_together(row: Command, parameters: Mapping[str, click.Parameter], options: Mapping[str, Any]) -> None:
    """Check that the options of a call fit together, before anything is computed.

    Raises:
        click.UsageError: if they do not; names them.
    """

    def spelled(pair: str) -> list[str]:
        chosen = [parameters[name] for name in pair.split()]
        return [each.opts[0] if isinstance(each, click.Option) else f"{each.metavar}".strip("[].") for each in chosen]

    def given(pair: str) -> list[bool]:
        return [options[name] not in (None, False, ()) for name in pair.split()]

    for pair in row.apart:
        if all(given(pair)):
            raise click.UsageError("{} and {} contradict each other: leave one of them out".format(*spelled(pair)))
    for pair in row.needs:
        if given(pair) == [True, False]:
            raise click.UsageError("{} needs {}: give it, too".format(*spelled(pair)))
    if row.one_of and sum(given(row.one_of)) != 1:
        raise click.UsageError("give {}, or {} for the bundled file, not both".format(*spelled(row.one_of)))


_ARGUMENT = re.compile(r"`(\w+)=([^`]*?)(?:, \1_error=([^`]*))?`")
_NAME = re.compile(r"`(\w+)`")
_QUOTES = re.compile(r'\\?"|&#34;')
"""Of a Python text, also within JSON and HTML."""


def in_options(text: str, options: Mapping[str, click.Option]) -> str:
    """Return a text of the library in a command's words: it names arguments, the command line has options.

    Args:
        text: names arguments as `name=value`, as `name=...` where the value does not matter, or, if it begins so, as
            `name`; what the command has no option for stays.
        options: of the command, by the arguments that they set.

    >>> order = click.Option(["--order"])
    >>> in_options("there is no orbit of order 2; try `order=1`", {"order": order})
    'there is no orbit of order 2; try --order 1'
    """

    def option(found: re.Match[str]) -> str:
        name, value, error = found.groups()
        if name not in options:
            return found[0]
        value = "" if value in {"...", "True"} else _QUOTES.sub("", value)
        value = value if error is None else f"'{value} +- {error}'"
        return f"{options[name].opts[0]} {value}".rstrip()

    first = _NAME.match(text)
    if first is not None and first[1] in options:
        text = _NAME.sub(lambda found: options[found[1]].opts[0] if found[1] in options else found[0], text)
    return _ARGUMENT.sub(option, text)


def run_command(row: Command, *, json: bool, out: Path | None, verbose: bool, **options: Any) -> None:
    """Run a command: start JAX, load the scene, call the function, hand out the result.

    All that it prints, writes and refuses names its options, not the library's arguments.

    Args:
        row: the command.
        json: as in `Session`, like the two that follow.
        out: the folder, or the file.
        verbose: whether to say what goes on behind.
        **options: of the command line, by their names.

    Raises:
        NotValid: if the result is not valid; it has been handed out then.
    """
    parameters = {str(each.name): each for each in click.get_current_context().command.params}
    check_together(row, parameters, {**options, "out": out})
    named = {name: each for name, each in parameters.items() if isinstance(each, click.Option)}
    with arguments_named(partial(in_options, options=named)), _naming(options):
        session = Session(json, out, verbose)
        silence_xla()
        if row.computes:
            session.start_computing()
        has_scene = SCENE in described(row.runs)[1]
        if has_scene:
            options["scene"] = later(".scenes:load_named")(options["scene"], options.pop("law", None))
        output = later(row.runs)(session, **options)
        if output is not None:
            hand_out(session, _with_scene(output, options) if has_scene else output)


def hand_out(session: Session, output: Output) -> None:
    """Write a result into the --out folder and to standard output.

    Raises:
        NotValid: if the result says that it is not valid.
    """
    if session.out is not None:
        writers = {output.json_file: partial(write_json, payload=output.payload)} if output.json_file else {}
        for name, columns in output.tables.items():
            session.write_columns(name, columns)
        for name, write in {**writers, **output.files}.items():
            write(session.out / name)
            session.note(f"wrote {session.out / name}")
        for path in () if output.report is None else output.report(session.out):
            session.note(f"wrote {path}")
    session.emit(output.payload, *output.text)
    if output.not_valid is not None:
        raise NotValid(in_callers_words(output.not_valid))


def _with_scene(output: Output, options: Mapping[str, Any]) -> Output:
    """Return a result that names its scene, and where its law is extrapolated."""
    scene = options["scene"]
    tables = later("afm_jax.scenefile.scenefile:scene_tables")(scene.scene)
    text = list(output.text)
    payload = {**output.payload, "scene": tables}
    if scene.unknowns is not None and "draws" in options:
        payload["draws"] = options["draws"]
    if output.impact_speeds is not None:
        extrapolation_of = later("afm_jax.impact.law:extrapolation_of")
        payload["extrapolated"] = extrapolation_of(scene.scene.interaction, output.impact_speeds)
        text.append(payload["extrapolated"])
    return replace(output, payload=payload, text=text)


@contextmanager
def _naming(options: Mapping[str, Any]) -> Iterator[None]:
    """Let messages about wrong values speak in the caller's words, and begin with the scene's name once it is read."""
    try:
        yield
    except ValueError as error:
        said, name = in_callers_words(str(error)), getattr(options.get("scene"), "name", "")
        if not said.startswith(name):
            said = f"{name}: {said}"
        if is_inner(error) or said == str(error):
            raise
        raise ValueError(said) from error
