"""`afm-jax bench --only fits`: how long a fit takes from the shell, the first time and with a warm cache."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

FIT_COLUMNS = ("model", "rows", "first_s", "warm_s", "valid", "chi2", "degrees_of_freedom")
"""What `bench_fits.csv` tells of a fit."""
_MODELS = ("law", "law+delay", "viscous+delay", "contact")
_BOUNDS = {"law+delay": 10.0, "viscous+delay": 10.0, "contact": 60.0}


def fit_rows(*, quick: bool) -> tuple[list[dict[str, Any]], list[tuple[str, float | None, float]]]:
    """Time fits of a table of 100 rows; return what was measured, and the aims with their bounds in seconds."""
    from fitting.fit_benchmark import time_fits  # noqa: PLC0415

    rows = time_fits(("law",) if quick else _MODELS, rows=20 if quick else 100)
    found = {row["model"]: row["warm_s"] for row in rows}
    return rows, [
        (f"s, fit of 100 rows, {model}, warm cache", found.get(model), bound) for model, bound in _BOUNDS.items()
    ]


def fit_table(rows: Sequence[dict[str, Any]]) -> "Table":
    """Return the measurements as a table for the terminal."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="fits from the shell", title_justify="left")
    for name in ("model", "rows", "first time, s", "warm cache, s", "chi2/dof"):
        table.add_column(name, justify="left" if name == "model" else "right")
    for row in rows:
        goodness = f"{row['chi2']:.1f}/{row['degrees_of_freedom']}"
        table.add_row(row["model"], str(row["rows"]), f"{row['first_s']:.1f}", f"{row['warm_s']:.1f}", goodness)
    return table
