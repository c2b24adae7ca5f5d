"""What `afm-jax bench` measures and tells of driven scenes."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from afm_jax.words import known

if TYPE_CHECKING:
    from rich.table import Table

PERIODS = {"1.01": 30, "5.277": 150}
"""Drive periods of the batches by reduced frequency: about 30 contacts of a tip in both."""
SCENES = {
    "batch": 1000,
    "periods": PERIODS,
    "rows": 64,
    "repetitions": 5,
    "long_periods": 1000,
    "scipy_contacts": 8,
}
SCENES_QUICK = {
    "batch": 20,
    "periods": {"5.277": 30},
    "rows": 16,
    "repetitions": 1,
    "long_periods": 0,
    "scipy_contacts": 2,
    "accuracies": [1e-6],
}
_PARTS = ("straight", "turning")
_ERRORS = ("rebound_error", "time_error_us")
SCENE_COLUMNS = (
    "what",
    "scene",
    "batch",
    "periods",
    "contacts",
    "microseconds_per_contact",
    "median_microseconds_per_contact",
    "seconds",
    "compile_s",
    "turning_share",
    "held_share",
    "failed",
    "different",
    *(f"{part}_{error}_{share}" for part in _PARTS for error in _ERRORS for share in ("median", "99", "worst")),
    "evaluations_per_contact",
)
"""What `bench_scenes.csv` tells of a measurement."""


def measure_scenes(*, quick: bool) -> tuple[dict[str, Any], list[tuple[str, float | None, float]]]:
    """Measure driven scenes; return what the command tells of them, and the aims: name, reached, largest allowed."""
    from afm_jax.study.own_process import run_in_own_process  # noqa: PLC0415
    from afm_jax.study.scene_benchmark import aims  # noqa: PLC0415

    task = "afm_jax.study.scene_benchmark:scenes_one_core"
    found = run_in_own_process(task, SCENES_QUICK if quick else SCENES, cores=1)
    told = {
        "scene_rows": found["rows"],
        "scene_reference_error": found["reference_error"],
        "scene_reference_error_us": found["reference_error_us"],
    }
    return told, aims(found["rows"])


def scene_tables(rows: Sequence[Mapping[str, Any]]) -> list["Table"]:
    """Return the measurements of driven scenes as two tables: times, and errors of one contact each."""
    from rich.table import Table  # noqa: PLC0415

    times = Table(title="Time of a driven contact, the flight to it included; one core")
    for heading in ("what", "scene"):
        times.add_column(heading)
    for heading in ("batch", "periods", "contacts", "us/contact", "seconds", "compile s", "turning", "held", "failed"):
        times.add_column(heading, justify="right")
    for row in rows:
        shares = [known(row.get(name), ".1%") for name in ("turning_share", "held_share")]
        numbers = [known(row.get(name)) for name in ("microseconds_per_contact", "seconds", "compile_s")]
        counts = [str(row.get(name, "-")) for name in ("batch", "periods", "contacts")]
        times.add_row(row["what"], row["scene"], *counts, *numbers, *shares, str(row.get("failed", "-")))
    errors = Table(title="Error of one contact, from the same arrival: median, 99 %, worst")
    for heading in ("what", "scene", "contacts"):
        errors.add_column(heading)
    for heading in ("rebound (relative)", "departure time us", "ends otherwise"):
        errors.add_column(heading, justify="right")
    for row in rows:
        for part in _PARTS:
            cells = [_spread(row, f"{part}_{error}") for error in _ERRORS]
            if any(cells):
                errors.add_row(row["what"], row["scene"], part, *cells, str(row.get("different", "-")))
    return [times, errors]


def _spread(row: Mapping[str, Any], name: str) -> str:
    values = [row.get(f"{name}_{share}") for share in ("median", "99", "worst")]
    return "  ".join(f"{value:.1e}" for value in values if value is not None)
