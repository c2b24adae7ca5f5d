"""`afm-jax bench`: impacts per second, next to SciPy.

`afm-jax bench --only fits`: how long a fit takes from the shell, the first time and with a warm cache.

What `afm-jax bench` measures and tells of driven scenes.
"""

import os
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from afm_jax.cli.session import Session, write_json
from afm_jax.compilation_cache import available_cores
from afm_jax.words import known

if TYPE_CHECKING:
    from rich.table import Table


FIT_COLUMNS = (
    *("model", "rows", "first_s", "first_processor_s", "warm_s", "warm_processor_s"),
    *("valid", "chi2", "degrees_of_freedom"),
)
"""What `bench_fits.csv` tells of a fit."""
_BOUNDS = {
    "law": (12.0, 2.5),
    "law+delay": (20.0, 4.0),
    "viscous+delay": (20.0, 4.0),
    "tapping": (20.0, 4.0),
    "contact": (45.0, 10.0),
}
"""Seconds that a fit may take on two idle cores, with an empty and with a warm cache of programs."""


def fit_rows(*, quick: bool) -> tuple[list[dict[str, Any]], list[tuple[str, float | None, float]]]:
    """Time fits of tables of 100 rows; return what was measured, and the aims with their bounds in seconds."""
    from fitting.benchmark import time_fits  # noqa: PLC0415

    rows = time_fits(("law",) if quick else tuple(_BOUNDS), rows=20 if quick else 100)
    found = {} if quick else {row["model"]: row for row in rows}
    return rows, [
        (f"s, fit of 100 rows, {model}, {when}", found.get(model, {}).get(column), bound)
        for model, bounds in _BOUNDS.items()
        for when, column, bound in zip(("first time", "warm cache"), ("first_s", "warm_s"), bounds, strict=True)
    ]


def fit_table(rows: Sequence[dict[str, Any]]) -> "Table":
    """Return the measurements as a table for the terminal."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="fits from the shell", title_justify="left")
    for name in ("model", "rows", "first time, s", "processor s", "warm cache, s", "processor s", "chi2/dof"):
        table.add_column(name, justify="left" if name == "model" else "right")
    for row in rows:
        goodness = f"{row['chi2']:.1f}/{row['degrees_of_freedom']}"
        seconds = [f"{row[name]:.1f}" for name in FIT_COLUMNS if name.endswith("_s")]
        table.add_row(row["model"], str(row["rows"]), *seconds, goodness)
    return table


DYNAMICS = {"values": 10_000, "impacts": 2000, "side": 1000, "orders": 8, "grid": 1000, "by_scipy": 100}
DYNAMICS_QUICK = {"values": 20, "impacts": 200, "side": 20, "orders": 2, "grid": 20, "by_scipy": 10}
DYNAMICS_COLUMNS = ("what", "work", "seconds", "processor_seconds", "first_s", "beside", "beside_seconds", "ratio")
"""What `bench_dynamics.csv` tells of a measurement."""


def measure_dynamics(cores: int, *, quick: bool) -> tuple[list[dict[str, Any]], list[tuple[str, float | None, float]]]:
    """Measure charts, diagrams, exponents and basins; return the rows, and the aims with their bounds in seconds."""
    from afm_jax.bench.dynamics import aims as dynamics_aims  # noqa: PLC0415
    from afm_jax.bench.timing import run_in_own_process  # noqa: PLC0415

    task = "afm_jax.bench.dynamics:dynamics_rows"
    rows = run_in_own_process(task, DYNAMICS_QUICK if quick else DYNAMICS, cores=cores)["rows"]
    return rows, dynamics_aims(rows, whole=not quick)


def dynamics_table(rows: Sequence[dict[str, Any]]) -> "Table":
    """Return the measurements as a table for the terminal."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="charts, diagrams, exponents, basins; all cores", title_justify="left")
    for name in ("what", "work", "s", "processor s", "first time, s", "beside, s", "times as fast"):
        table.add_column(name, justify="left" if name in {"what", "work"} else "right")
    for row in rows:
        numbers = [known(row[name]) for name in ("seconds", "processor_seconds", "first_s", "beside_seconds", "ratio")]
        table.add_row(row["what"], row["work"], *numbers)
    return table


SWEEPS = {"sizes": [10_000, 100_000, 1_000_000, 10_000_000], "points": 8_000_000, "processes": [1, 2, 4]}
SWEEPS_QUICK = {"sizes": [2000], "points": 0, "processes": []}
SWEEP_COLUMNS = (
    "what",
    "points",
    "processes",
    "devices",
    "seconds",
    "microseconds_per_point",
    "processor_microseconds_per_point",
    "peak_memory_mib",
)
"""What `bench_sweep.csv` tells of a measurement."""


def measure_sweeps(cores: int, *, quick: bool) -> tuple[list[dict[str, Any]], list[tuple[str, float | None, float]]]:
    """Measure sweeps over law scenes; return the rows, and the aims with their bounds."""
    from afm_jax.bench.sweeps import aims as sweep_aims  # noqa: PLC0415
    from afm_jax.bench.sweeps import sweep_rows  # noqa: PLC0415

    rows = sweep_rows(**(SWEEPS_QUICK if quick else SWEEPS), cores=cores)
    return rows, sweep_aims(rows)


def sweep_table(rows: Sequence[dict[str, Any]]) -> "Table":
    """Return the measurements as a table for the terminal."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="sweeps over law scenes, one order", title_justify="left")
    for name in ("what", "scenes", "processes", "devices", "s", "us/scene", "processor us/scene", "peak MiB"):
        table.add_column(name, justify="left" if name == "what" else "right")
    for row in rows:
        counts = [f"{row[name]:,}" for name in ("points", "processes", "devices")]
        table.add_row(row["what"], *counts, *(known(row[name]) for name in SWEEP_COLUMNS[4:]))
    return table


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
    from afm_jax.bench.scenes import aims  # noqa: PLC0415
    from afm_jax.bench.timing import run_in_own_process  # noqa: PLC0415

    task = "afm_jax.bench.scenes:scenes_one_core"
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


COLUMNS = (
    "what",
    "scene",
    "batch",
    "cores",
    "block",
    "impacts",
    "microseconds_per_impact",
    "median_microseconds_per_impact",
    "impacts_per_second",
    "compile_s",
    "error_us",
    "error_kind",
    "near_grazing",
    "ratio_to_plain",
    "derivative_relative_error",
)
"""What `bench.csv` tells of a measurement."""
AIMED_BATCH = 10_000
CONTACT = {"batch": AIMED_BATCH, "repetitions": 7, "many": 1_000_000, "scipy_speeds": [12.0, 30.0, 100.0]}
CONTACT_QUICK = {"batch": 100, "repetitions": 1, "many": 2000, "scipy_speeds": [30.0]}
CONTACT_COLUMNS = (
    "what",
    "batch",
    "microseconds_per_impact",
    "median_microseconds_per_impact",
    "compile_s",
    "rebound_error",
    "delay_error_us",
    "ratio_to_plain",
    "flops",
    "instructions",
    "memory_mib",
    "results_mib",
    "peak_process_mib",
    "evaluations_per_impact",
)
"""What `bench_contact.csv` tells of a measurement."""


def bench(session: Session, batches: tuple[int, ...], only: str | None, *, quick: bool) -> None:
    """Measure impacts per second, and fits."""
    cores = available_cores()
    machine = machine_facts(cores)
    if (machine["load_before"] or 0.0) > 0.3 * cores:
        session.note(f"other programs are running (load {machine['load_before']:.1f}): times will be too long")
    payload: dict[str, Any] = {"rows": [], "contact_rows": [], "scene_rows": [], "aims": [], "machine": machine}
    tables = []
    with session.working("measuring"):
        if only in {None, "map"}:
            payload["rows"] = map_rows(batches, cores, quick=quick)
            payload["aims"] += aims(payload["rows"])
            tables.append(bench_table(payload["rows"]))
            session.write_table("bench.csv", payload["rows"], COLUMNS)
        if only in {None, "contact"}:
            payload["contact_rows"], reached = contact_rows(quick=quick)
            payload["aims"] += reached
            tables.append(contact_table(payload["contact_rows"]))
            session.write_table("bench_contact.csv", payload["contact_rows"], CONTACT_COLUMNS)
        if only in {None, "scenes"}:
            scenes, reached = measure_scenes(quick=quick)
            payload |= scenes
            payload["aims"] += [aim_of(name, value, at_most=bound) for name, value, bound in reached]
            tables += scene_tables(payload["scene_rows"])
            session.write_table("bench_scenes.csv", payload["scene_rows"], SCENE_COLUMNS)
        if only in {None, "dynamics"}:
            payload["dynamics_rows"], reached = measure_dynamics(cores, quick=quick)
            payload["aims"] += [aim_of(name, value, at_most=bound) for name, value, bound in reached]
            tables.append(dynamics_table(payload["dynamics_rows"]))
            session.write_table("bench_dynamics.csv", payload["dynamics_rows"], DYNAMICS_COLUMNS)
        if only in {None, "sweep"}:
            payload["sweep_rows"], reached = measure_sweeps(cores, quick=quick)
            payload["aims"] += [aim_of(name, value, at_most=bound) for name, value, bound in reached]
            tables.append(sweep_table(payload["sweep_rows"]))
            session.write_table("bench_sweep.csv", payload["sweep_rows"], SWEEP_COLUMNS)
        if only in {None, "fits"}:
            payload["fit_rows"], reached = fit_rows(quick=quick)
            payload["aims"] += [aim_of(name, value, at_most=bound) for name, value, bound in reached]
            tables.append(fit_table(payload["fit_rows"]))
            session.write_table("bench_fits.csv", payload["fit_rows"], FIT_COLUMNS)
    if session.out is not None:
        write_json(session.out / "bench.json", payload)
        session.note(f"wrote {session.out / 'bench.json'}")
    session.emit(payload, *tables, *(aim_sentence(aim) for aim in payload["aims"]))


def map_rows(batches: Sequence[int], cores: int, *, quick: bool) -> list[dict[str, Any]]:
    """Measure the impact map, on one core and on all."""
    from afm_jax.bench.timing import run_in_own_process  # noqa: PLC0415

    sizes = list(batches) or ([1, 100] if quick else [1, 100, AIMED_BATCH, 100_000])
    common = {"batches": sizes, "impacts": 20, "repetitions": 2 if quick else 7}
    blocks = [] if quick else [250, 1000, 2000]
    alone = {**common, "blocks": blocks, "derivative_batch": 100 if quick else AIMED_BATCH}
    rows = run_in_own_process("afm_jax.bench.impacts:one_core", alone, cores=1)["rows"]
    if cores > 1:
        rows += run_in_own_process("afm_jax.bench.impacts:all_cores", common, cores=cores)["rows"]
    return rows


def contact_rows(*, quick: bool) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Measure collisions of free tips through the contact; return what was measured and the aims."""
    from afm_jax.bench.collisions import aims as contact_aims  # noqa: PLC0415
    from afm_jax.bench.timing import run_in_own_process  # noqa: PLC0415

    task = "afm_jax.bench.collisions:contact_one_core"
    rows = run_in_own_process(task, CONTACT_QUICK if quick else CONTACT, cores=1)["rows"]
    return rows, [aim_of(name, value, at_most=bound) for name, value, bound in contact_aims(rows)]


def aims(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the stated aims with what was reached; None where it was not measured.

    One core, float64, the regular scene: impacts per second at batch 10,000, the error after 20 impacts, and the cost
    of derivatives in plain runs.
    """
    plain = next((row for row in rows if row["what"] == "next_impact iterated" and row["batch"] == AIMED_BATCH), {})
    ratios = {row["what"].split()[0]: row["ratio_to_plain"] for row in rows if "ratio_to_plain" in row}
    return [
        aim_of("impacts per second, one core, batch 10000", plain.get("impacts_per_second"), at_least=3e6),
        aim_of("error after 20 impacts, us", plain.get("error_us"), at_most=1e-11),
        aim_of("one forward derivative, plain runs", ratios.get("forward"), at_most=1.5),
        aim_of("full reverse gradient, plain runs", ratios.get("reverse"), at_most=4.0),
    ]


def aim_of(
    name: str, reached: float | None, *, at_least: float | None = None, at_most: float | None = None
) -> dict[str, Any]:
    """Return an aim, what was reached (None: not measured) and whether that is enough."""
    met = None
    if reached is not None:
        met = (at_least is None or reached >= at_least) and (at_most is None or reached <= at_most)
    return {"aim": name, "at_least": at_least, "at_most": at_most, "reached": reached, "met": met}


def aim_sentence(aim: dict[str, Any]) -> str:
    """Say what was aimed at, what was reached, and whether that is enough."""
    bound = f"at least {aim['at_least']:g}" if aim["at_least"] is not None else f"at most {aim['at_most']:g}"
    if aim["reached"] is None:
        return f"{aim['aim']}: {bound} wanted, not measured in this run"
    return f"{aim['aim']}: {bound} wanted, {aim['reached']:.3g} reached{'' if aim['met'] else ', not met'}"


def machine_facts(cores: int) -> dict[str, Any]:
    """Return what a reader needs to know of the machine and the programs; no names, no folders."""
    packages = {name: version(name) for name in ("jax", "numpy", "scipy")}
    return {
        "cores": cores,
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "architecture": platform.machine(),
        "system": platform.system(),
        "python": platform.python_version(),
        **packages,
    }


def bench_table(rows: Sequence[dict[str, Any]]) -> "Table":
    """Return the measurements as a table."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="Time of an impact: best of several repetitions, compilation apart")
    table.add_column("what")
    table.add_column("scene")
    for heading in ("batch", "cores", "us/impact", "median", "impacts/s", "compile s", "ratio"):
        table.add_column(heading, justify="right")
    table.add_column("error us")
    for row in rows:
        ratio, compile_s = row.get("ratio_to_plain"), row["compile_s"]
        table.add_row(
            row["what"],
            row["scene"],
            f"{row['batch']:,}",
            str(row["cores"]),
            f"{row['microseconds_per_impact']:.3g}",
            f"{row['median_microseconds_per_impact']:.3g}",
            f"{row['impacts_per_second']:,.0f}",
            known(compile_s, ".1f"),
            known(ratio, ".2f"),
            _error_cell(row),
        )
    return table


def _error_cell(row: dict[str, Any]) -> str:
    if "error_us" in row:
        return f"{row['error_us']:.1e} {row['error_kind']}"
    slope = row.get("derivative_relative_error")
    return "-" if slope is None else f"derivative: {slope:.1e} relative"


def contact_table(rows: Sequence[dict[str, Any]]) -> "Table":
    """Return the contact's measurements as a table."""
    from rich.table import Table  # noqa: PLC0415

    table = Table(title="Time of a collision through the contact, 12 to 200 nm/us, one core")
    table.add_column("what")
    headings = (
        "batch",
        "us/impact",
        "compile s",
        "u_out error",
        "delay error us",
        "ratio",
        "operations",
        "scratch MiB",
    )
    for heading in headings:
        table.add_column(heading, justify="right")
    names = ("compile_s", "rebound_error", "delay_error_us", "ratio_to_plain", "instructions", "memory_mib")
    for row in rows:
        cells = [known(row.get(name)) for name in names]
        table.add_row(row["what"], f"{row['batch']:,}", f"{row['microseconds_per_impact']:.3g}", *cells)
    return table
