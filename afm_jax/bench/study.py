"""Error against time: the methods that solve a problem, each with its settings, measured one after the other.

A method is one entry: a `Contestant` with a name, settings, and a function that measures one of them. This package's
methods and rivals (SciPy's and SUNDIALS' integrators, Diffrax with its Event) take part alike. `afm-jax accuracy` and
`afm-jax bench` make their rows of what `measured` gives.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from rich.table import Table

from afm_jax.columns import Cell, columns_of, printed_table
from afm_jax.studies.timing import Compiled, progress, time_compiled

Row = dict[str, Any]

RIVALS = ("SciPy", "SUNDIALS", "Diffrax", "NumPy")
"""How methods that are not this package's begin."""


class StudyTable(NamedTuple):
    """How measured rows are told: in a CSV file, and as a table in the terminal.

    Attributes:
        file: name of the CSV file.
        columns: keys of the rows that it has.
        title: of the printed table; what stands in braces is filled in.
        cells: headings of the printed table, and what stands below them.
    """

    file: str
    columns: tuple[str, ...]
    title: str
    cells: Mapping[str, Cell]

    def printed(self, rows: Sequence[Row], told: Mapping[str, Any] | None = None) -> Table:
        """Return the rows as a table to print, numbers with three digits; its title takes what it names from `told`."""
        return printed_table(self.title.format_map(told or {}), self.cells, rows, form=".3g")

    def written(self, rows: Sequence[Row]) -> dict[str, dict[str, list[Any]]]:
        """Return the columns of the CSV file by its name."""
        return {self.file: columns_of(rows, self.columns)}


class Contestant(NamedTuple):
    """A method that solves a problem.

    Attributes:
        method: its name; a rival's begins with its library's.
        settings: values of what is changed, by their names in tables.
        measure: from such a value the numbers of a row: time, error, time to compile.
        column: which column has the setting's value; empty: none.
        told: columns that all rows of it have.
    """

    method: str
    settings: Mapping[str, Any]
    measure: Callable[[Any], Row]
    column: str = ""
    told: Mapping[str, Any] = MappingProxyType({})


def measured(where: str, contestants: Iterable[Contestant], *, unknown: Sequence[str] = ()) -> Iterator[Row]:
    """Give a row for every contestant and setting: `method`, `setting`, and the numbers.

    Args:
        where: the study and the problem, for messages.
        contestants: who takes part; each is asked for when those before it are measured.
        unknown: columns that are None where a rival gives up or is not installed; `reason` says why.
    """
    for contestant in contestants:
        for setting, value in contestant.settings.items():
            progress(f"{where}, {contestant.method}, {setting}")
            row = {"method": contestant.method, "setting": setting, **contestant.told}
            if contestant.column:
                row[contestant.column] = value
            try:
                yield row | contestant.measure(value)
            except (ValueError, ModuleNotFoundError) as failure:
                if not contestant.method.startswith(RIVALS):
                    raise
                yield row | dict.fromkeys(unknown) | {"reason": str(failure)}


def named(what: str, values: Sequence[float], unit: str = "") -> dict[str, float]:
    """Return values by names for tables.

    >>> named("tolerance", [1e-6, 1e-3])
    {'tolerance 1e-06': 1e-06, 'tolerance 0.001': 0.001}
    """
    return {f"{what} {value:g}{unit}": value for value in values}


def timed(compiled: Compiled, *arguments: Any, repetitions: int, events: int) -> tuple[Row, Any]:
    """Return what a compiled call takes for each of its events (impacts, contacts), in us, and what it computed."""
    timing, result = time_compiled(compiled, *arguments, repetitions=repetitions)
    row = {
        "microseconds_per_impact": 1e6 * timing.best_s / events,
        "median_microseconds_per_impact": 1e6 * timing.median_s / events,
        "compile_s": timing.compile_s,
    }
    return row, result
