"""`afm-jax bench`: impacts and contacts per second, studies, sweeps and fits, next to SciPy.

What is measured is a list, `PARTS`: each part with the function that measures it and the tables that tell of it.
"""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import click
from rich.table import Table

from afm_jax.bench import collisions, dynamics, scenes
from afm_jax.bench.study import StudyTable
from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.columns import Cell, printed_table
from afm_jax.compilation_cache import available_cores
from afm_jax.studies import timing

Row = dict[str, Any]
AIMED_BATCH = 10_000


class Size(NamedTuple):
    """How much is measured: quickly or in full, on how many cores, and with which batches of the impact map.

    ``beside``: folder of another checkout, whose fits are timed, too.
    """

    quick: bool
    cores: int
    batches: Sequence[int]
    beside: Path | None = None


class Measured(NamedTuple):
    """Rows of a part, what was aimed at, and further keys of the JSON object.

    ``aims``: name, what was reached (None: not measured), and the largest allowed; of a rate the smallest.
    """

    rows: list[Row]
    aims: list[tuple[str, float | None, float]]
    told: Mapping[str, Any] = MappingProxyType({})


class Part(NamedTuple):
    """A part of the benchmark.

    Attributes:
        name: what --only calls it.
        key: of its rows in the JSON object.
        measure: gives the rows.
        table: how they are told.
        further: another printed table of them, its rows made of the part's.
    """

    name: str
    key: str
    measure: Callable[[Size], Measured]
    table: StudyTable
    further: Callable[[Sequence[Row]], Table] | None = None


def bench(session: Session, batches: tuple[int, ...], only: str | None, beside: Path | None, *, quick: bool) -> Output:
    """Measure all parts, or one."""
    if beside is not None and only not in {None, FITS.name}:
        raise click.UsageError(f"--beside is about fits: leave it out, or --only {only}")
    if beside is not None and not (beside / "afm_jax" / "__main__.py").is_file():
        raise click.UsageError(f"--beside: {beside} holds no checkout of afm-jax; name the folder above its afm_jax")
    size = Size(quick, available_cores(), batches, None if beside is None else beside.resolve())
    machine = machine_facts(size.cores)
    if (machine["load_before"] or 0.0) > 0.3 * size.cores:
        session.note(f"other programs are running (load {machine['load_before']:.1f}): times will be too long")
    payload: dict[str, Any] = {"rows": [], "contact_rows": [], "scene_rows": [], "aims": [], "machine": machine}
    printed, tables = [], {}
    with session.working("measuring"):
        for part in (part for part in PARTS if only in {None, part.name}):
            rows, aims, told = part.measure(size)
            payload |= {part.key: rows, **told}
            payload["aims"] += [aim_of(*aim) for aim in aims]
            printed += [part.table.printed(rows), *([] if part.further is None else [part.further(rows)])]
            tables |= part.table.written(rows)
    text = [*printed, *(aim_sentence(aim) for aim in payload["aims"])]
    return Output(payload=payload, text=text, tables=tables, json_file="bench.json")


def aim_of(name: str, reached: float | None, bound: float) -> dict[str, Any]:
    """Return an aim, what was reached (None: not measured) and whether that is enough; rates have a lower bound."""
    rate = "per second" in name
    met = None if reached is None else (reached >= bound if rate else reached <= bound)
    at_least, at_most = (bound, None) if rate else (None, bound)
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


def measure_map(size: Size) -> Measured:
    """Measure the impact map, on one core and on all."""
    sizes = list(size.batches) or ([1, 100] if size.quick else [1, 100, AIMED_BATCH, 100_000])
    common = {"batches": sizes, "impacts": 20, "repetitions": 2 if size.quick else 7}
    blocks = [] if size.quick else [250, 1000, 2000]
    alone = {**common, "blocks": blocks, "derivative_batch": 100 if size.quick else AIMED_BATCH}
    rows = timing.run_in_own_process("afm_jax.bench.impacts:one_core", alone, cores=1)["rows"]
    if size.cores > 1:
        rows += timing.run_in_own_process("afm_jax.bench.impacts:all_cores", common, cores=size.cores)["rows"]
    return Measured(rows, map_aims(rows))


def map_aims(rows: Sequence[Row]) -> list[tuple[str, float | None, float]]:
    """Return the aims of the impact map.

    One core, float64, the regular scene: impacts per second at batch 10,000, the error after 20 impacts, and the cost
    of derivatives in plain runs.
    """
    plain = next((row for row in rows if row["what"] == "next_impact iterated" and row["batch"] == AIMED_BATCH), {})
    ratios = {row["what"].split()[0]: row["ratio_to_plain"] for row in rows if "ratio_to_plain" in row}
    return [
        ("impacts per second, one core, batch 10000", plain.get("impacts_per_second"), 3e6),
        ("error after 20 impacts, us", plain.get("error_us"), 1e-11),
        ("one forward derivative, plain runs", ratios.get("forward"), 1.5),
        ("full reverse gradient, plain runs", ratios.get("reverse"), 4.0),
    ]


def measure_contact(size: Size) -> Measured:
    """Measure collisions of free tips through the contact."""
    full = {"batch": AIMED_BATCH, "repetitions": 7, "many": 1_000_000, "scipy_speeds": [12.0, 30.0, 100.0]}
    small = {"batch": 100, "repetitions": 1, "many": 2000, "scipy_speeds": [30.0]}
    task = "afm_jax.bench.collisions:contact_one_core"
    rows = timing.run_in_own_process(task, small if size.quick else full, cores=1)["rows"]
    return Measured(rows, collisions.aims(rows))


_PERIODS = {"1.01": 30, "5.277": 150}
"""Drive periods of the batches by reduced frequency: about 30 contacts of a tip in both."""
_STRAIGHT_OR_TURNING = ("straight", "turning")
_ERRORS = ("rebound_error", "time_error_us")
_SHARES = ("median", "99", "worst")


def measure_scenes(size: Size) -> Measured:
    """Measure how long scenes driven in time take, with the error of each setting."""
    full = {"batch": 1000, "periods": _PERIODS, "rows": 64, "repetitions": 5, "long_periods": 1000, "scipy_contacts": 8}
    small = {"batch": 20, "periods": {"5.277": 30}, "rows": 16, "repetitions": 1, "long_periods": 0}
    small |= {"scipy_contacts": 2, "accuracies": [1e-6]}
    found = timing.run_in_own_process("afm_jax.bench.scenes:scenes_one_core", small if size.quick else full, cores=1)
    told = {f"scene_{name}": found[name] for name in ("reference_error", "reference_error_us")}
    return Measured(found["rows"], scenes.aims(found["rows"]), told)


def measure_dynamics(size: Size) -> Measured:
    """Measure charts, diagrams, exponents and basins."""
    full = {"values": 10_000, "impacts": 2000, "side": 1000, "orders": 8, "grid": 1000, "by_scipy": 100}
    small = {"values": 20, "impacts": 200, "side": 20, "orders": 2, "grid": 20, "by_scipy": 10}
    task = "afm_jax.bench.dynamics:dynamics_rows"
    rows = timing.run_in_own_process(task, small if size.quick else full, cores=size.cores)["rows"]
    return Measured(rows, dynamics.aims(rows, whole=not size.quick))


def measure_sweeps(size: Size) -> Measured:
    """Measure sweeps over law scenes."""
    full = {"sizes": [10_000, 100_000, 1_000_000, 10_000_000], "points": 8_000_000, "processes": [1, 2, 4]}
    small = {"sizes": [2000], "points": 0, "processes": []}
    from afm_jax.bench import sweeps  # noqa: PLC0415 (needs Zarr, which the other parts do not)

    rows = sweeps.sweep_rows(**(small if size.quick else full), cores=size.cores)
    return Measured(rows, sweeps.aims(rows))


_FIT_BOUNDS = {
    "law": (12.0, 2.5),
    "law+delay": (20.0, 4.0),
    "viscous+delay": (20.0, 4.0),
    "tapping": (20.0, 4.0),
    "contact": (45.0, 10.0),
}
"""Seconds that a fit may take on two idle cores, with an empty and with a warm cache of programs."""


def measure_fits(size: Size) -> Measured:
    """Time fits of tables of 100 rows, the first time and with a warm cache."""
    from fitting.benchmark import time_fits  # noqa: PLC0415 (`fitting` is imported by the command that needs it)

    models = ("law",) if size.quick else tuple(_FIT_BOUNDS)
    rows = time_fits(models, rows=20 if size.quick else 100, beside=size.beside)
    found = {} if size.quick else {row["model"]: row for row in rows}
    aims = [
        (f"s, fit of 100 rows, {model}, {when}", found.get(model, {}).get(column), bound)
        for model, bounds in _FIT_BOUNDS.items()
        for when, column, bound in zip(("first time", "warm cache"), ("first_s", "warm_s"), bounds, strict=True)
    ]
    return Measured(rows, aims)


def _map_error(row: Mapping[str, Any]) -> str:
    if "error_us" in row:
        return f"{row['error_us']:.1e} {row['error_kind']}"
    slope = row.get("derivative_relative_error")
    return "-" if slope is None else f"derivative: {slope:.1e} relative"


def _scene_errors(rows: Sequence[Row]) -> Table:
    """Return the errors of contacts that go straight through and of those that turn, a line each."""

    def spread(name: str) -> Callable[[Mapping[str, Any]], str]:
        def cell(row: Mapping[str, Any]) -> str:
            values = [row.get(f"{row['part']}_{name}_{share}") for share in _SHARES]
            return "  ".join(f"{value:.1e}" for value in values if value is not None)

        return cell

    cells: dict[str, Cell] = {
        "what": "what",
        "scene": "scene",
        "contacts": "part",
        "rebound (relative)": spread(_ERRORS[0]),
        "departure time us": spread(_ERRORS[1]),
        "ends otherwise": "different:d",
    }
    parts = [row | {"part": part} for row in rows for part in _STRAIGHT_OR_TURNING]
    parts = [row for row in parts if f"{row['part']}_{_ERRORS[0]}_worst" in row]
    return printed_table("Error of one contact, from the same arrival: median, 99 %, worst", cells, parts)


MAP = Part(
    "map",
    "rows",
    measure_map,
    StudyTable(
        "bench.csv",
        (
            *("what", "scene", "batch", "cores", "block", "impacts", "microseconds_per_impact"),
            *("median_microseconds_per_impact", "impacts_per_second", "compile_s", "error_us", "error_kind"),
            *("near_grazing", "ratio_to_plain", "derivative_relative_error"),
        ),
        "Time of an impact: best of several repetitions, compilation apart",
        {
            "what": "what",
            "scene": "scene",
            "batch": "batch:,",
            "cores": "cores:d",
            "us/impact": "microseconds_per_impact",
            "median": "median_microseconds_per_impact",
            "impacts/s": "impacts_per_second:,.0f",
            "compile s": "compile_s:.1f",
            "ratio": "ratio_to_plain:.2f",
            "error us": _map_error,
        },
    ),
)
CONTACT = Part(
    "contact",
    "contact_rows",
    measure_contact,
    StudyTable(
        "bench_contact.csv",
        (
            *("what", "batch", "microseconds_per_impact", "median_microseconds_per_impact", "compile_s"),
            *("rebound_error", "delay_error_us", "ratio_to_plain", "flops", "instructions", "memory_mib"),
            *("results_mib", "peak_process_mib", "evaluations_per_impact"),
        ),
        "Time of a collision through the contact, 12 to 200 nm/us, one core",
        {
            "what": "what",
            "batch": "batch:,",
            "us/impact": "microseconds_per_impact",
            "compile s": "compile_s",
            "u_out error": "rebound_error",
            "delay error us": "delay_error_us",
            "ratio": "ratio_to_plain",
            "operations": "instructions",
            "scratch MiB": "memory_mib",
        },
    ),
)
SCENES = Part(
    "scenes",
    "scene_rows",
    measure_scenes,
    StudyTable(
        "bench_scenes.csv",
        (
            *("what", "scene", "batch", "periods", "contacts", "microseconds_per_contact"),
            *("median_microseconds_per_contact", "seconds", "compile_s", "turning_share", "held_share"),
            *("failed", "different"),
            *(f"{part}_{error}_{share}" for part in _STRAIGHT_OR_TURNING for error in _ERRORS for share in _SHARES),
            "evaluations_per_contact",
        ),
        "Time of a driven contact, the flight to it included; one core",
        {
            "what": "what",
            "scene": "scene",
            "batch": "batch:d",
            "periods": "periods:d",
            "contacts": "contacts:d",
            "us/contact": "microseconds_per_contact",
            "seconds": "seconds",
            "compile s": "compile_s",
            "turning": "turning_share:.1%",
            "held": "held_share:.1%",
            "failed": "failed:d",
        },
    ),
    _scene_errors,
)
DYNAMICS = Part(
    "dynamics",
    "dynamics_rows",
    measure_dynamics,
    StudyTable(
        "bench_dynamics.csv",
        ("what", "work", "seconds", "processor_seconds", "first_s", "beside", "beside_seconds", "ratio"),
        "charts, diagrams, exponents, basins; all cores",
        {
            "what": "what",
            "work": "work",
            "s": "seconds",
            "processor s": "processor_seconds",
            "first time, s": "first_s",
            "beside, s": "beside_seconds",
            "times as fast": "ratio",
        },
    ),
)
SWEEP = Part(
    "sweep",
    "sweep_rows",
    measure_sweeps,
    StudyTable(
        "bench_sweep.csv",
        (
            *("what", "points", "processes", "devices", "seconds", "microseconds_per_point"),
            *("processor_microseconds_per_point", "peak_memory_mib"),
        ),
        "sweeps over law scenes, one order",
        {
            "what": "what",
            "scenes": "points:,",
            "processes": "processes:d",
            "devices": "devices:d",
            "s": "seconds",
            "us/scene": "microseconds_per_point",
            "processor us/scene": "processor_microseconds_per_point",
            "peak MiB": "peak_memory_mib",
        },
    ),
)
FITS = Part(
    "fits",
    "fit_rows",
    measure_fits,
    StudyTable(
        "bench_fits.csv",
        (
            *("model", "rows", "first_s", "first_processor_s", "warm_s", "warm_processor_s"),
            *("valid", "chi2", "degrees_of_freedom"),
        ),
        "fits from the shell",
        {
            "model": "model",
            "rows": "rows:d",
            "first time, s": "first_s:.1f",
            "first time, processor s": "first_processor_s:.1f",
            "warm cache, s": "warm_s:.1f",
            "warm cache, processor s": "warm_processor_s:.1f",
            "chi2/dof": lambda row: f"{row['chi2']:.1f}/{row['degrees_of_freedom']}",
        },
    ),
)
PARTS = (MAP, CONTACT, SCENES, DYNAMICS, SWEEP, FITS)
