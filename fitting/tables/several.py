"""Several tables that are fitted together, as reports and verdicts see them: their rows one after the other.

Where readings were repeated at one drive, their scatter is compared with what their errors say.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, Shaped

from afm_jax.solve.least_squares import chi2_tail
from fitting.tables.table import (
    MEASURED,
    AmplitudeTable,
    columns_of,
    drive_numbers,
    scatter_about_means,
)


@dataclass(frozen=True)
class SeveralTables:
    """Tables of one tip on one sample, with the methods of a single table for all their rows.

    Attributes:
        tables: at least two.

    Raises:
        ValueError: if tables are fewer, or what every table must have in common differs.
    """

    tables: tuple[AmplitudeTable, ...]

    def __post_init__(self):
        if len(self.tables) < 2:
            raise ValueError("a joint fit needs at least two tables")
        first, name = self.tables[0], self.labels[0]
        for table, label in zip(self.tables[1:], self.labels[1:], strict=True):
            for known in ("mass_ng", "quality_factor"):
                if (getattr(first, known) is None) != (getattr(table, known) is None):
                    without, having = (name, label) if getattr(first, known) is None else (label, name)
                    raise ValueError(f"{without} gives no {known}, but {having} does; correct one of them")
            mass, other = first.mass_ng, table.mass_ng
            if mass is not None and other is not None and abs(other / mass - 1.0) > _SAME_MASS:
                raise ValueError(
                    f"mass_ng is {mass:g} in {name} and {other:g} in {label}: tips of different mass share no law of "
                    "impacts; fit each by itself"
                )

    def check_different(self) -> None:
        """Check that no table is there twice: its readings would count twice.

        Raises:
            ValueError: if one is.
        """
        known: dict[tuple[bytes, ...], str] = {}
        for table, label in zip(self.tables, self.labels, strict=True):
            # noise alone makes no two measurements alike
            readings = tuple(np.array(getattr(table, name), dtype=float).tobytes() for name in _READINGS)
            other = known.setdefault(readings, label)
            if other is not label:
                raise ValueError(f"{label} holds the same readings as {other}; give each table once")

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """What each table is called: its file's name; its path and number where two files have one name."""
        names = [Path(table.source).name for table in self.tables]
        if len(set(names)) == len(names):
            return tuple(names)
        return tuple(f"{table.source} ({number})" for number, table in enumerate(self.tables, 1))

    @property
    def source(self) -> str:
        """The first table's name, and how many more there are."""
        return f"{self.labels[0]} and {len(self.labels) - 1} more"

    @cached_property
    def number(self) -> Int[np.ndarray, " rows"]:
        """Which table each row is of."""
        return np.repeat(np.arange(len(self.tables)), [table.rows for table in self.tables])

    @property
    def rows(self) -> int:
        """Number of rows of all tables."""
        return sum(table.rows for table in self.tables)

    @property
    def row_names(self) -> Shaped[np.ndarray, " rows"]:
        """The table and the line of it that each row stands in."""
        return np.array([f"{self.labels[i]}:{line}" for i, line in zip(self.number, self.lines, strict=True)])

    @property
    def tapping(self) -> bool:
        """Whether the cantilever itself is driven in every table."""
        return all(table.tapping for table in self.tables)

    @property
    def drive(self) -> str:
        """What is driven; the sample where that differs and it is in some."""
        return self.tables[0].drive if self.tapping else "sample"

    @property
    def mass_ng(self) -> float | None:
        """Effective mass of the tip; None: not known."""
        return self.tables[0].mass_ng

    def __getattr__(self, name: str) -> Any:
        """Return what each table has a number a row of, for all rows; 0 of `no_orbit` where a table has none."""
        if name not in _STACKED:
            raise AttributeError(name)
        columns = [getattr(table, name) for table in self.tables]
        return np.concatenate([np.zeros(self.tables[i].rows) if c is None else c for i, c in enumerate(columns)])


_STACKED = ("lines", "order", "drive_frequency_khz", "excitation_nm", "offset_nm", "no_orbit")
_READINGS = ("drive_frequency_khz", "excitation_nm", "offset_nm", "peak_amplitude_nm", "lockin_amplitude_nm")
"""What tells tables apart."""
_SAME_MASS = 0.01
"""Relative difference of masses that is none: they come of spring constants."""


def repeats_of(table: AmplitudeTable | SeveralTables) -> dict[str, int | float] | None:
    """Return how the readings of repeated drives scatter about their mean; None where no drive was repeated.

    Returns:
        How many `drives` were repeated, and the `rows` of these; `chi2`, the sum of squared deviations over the stated
        errors; `degrees_of_freedom`, readings less means; `error_ratio`, scatter over stated error, the root of their
        quotient; and the `p_value`, the probability of a larger chi2 if the errors are right.
    """
    drives, rows, freedom, chi2 = 0, 0, 0, 0.0
    for member in table.tables:
        columns = columns_of(member)
        count = np.bincount(drive_numbers(columns))
        drives, rows = drives + int((count > 1).sum()), rows + int(count[count > 1].sum())
        for column in MEASURED:
            if column.name in columns:
                _, more, squares = scatter_about_means(column, columns, columns[str(column.error)])
                freedom, chi2 = freedom + more, chi2 + squares
    if not freedom:
        return None
    return {
        "drives": drives,
        "rows": rows,
        "chi2": chi2,
        "degrees_of_freedom": freedom,
        "error_ratio": float(np.sqrt(chi2 / freedom)),
        "p_value": chi2_tail(chi2, freedom),
    }
