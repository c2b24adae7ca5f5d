"""`python -m tests.benchmarks`: time this tree, SciPy, and another tree beside it; write the table of the page.

Each tree works in processes of its own, one for what is called in Python (pinned to a core) and one for every command.
Runs of the two trees alternate, and the medians are told: what else the machine does meets both alike.
"""

import argparse
import contextlib
import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from tests.benchmarks.tasks import ROWS

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "notebooks" / "pages" / "benchmarks.md"
MARKS = "<!-- measured: make bench -->", "<!-- end -->"
_SCAN = "platform.reduced_frequency=1.1:1.7:1000"
_EXAMPLES = ROOT / "fitting" / "examples"
_CONTACT = str(_EXAMPLES / "amplitudes_contact.csv")
COMMANDS = {
    "chart, 300 x 300 points, 8 orders": (
        *("chart", "figure2", "--x", "platform.reduced_frequency=0.4:4.4:300"),
        *("--y", "platform.amplitude_nm=0.1:10:300"),
    ),
    "bifurcation, 1000 values, 2000 impacts each": ("bifurcation", "figure2", "--parameter", _SCAN),
    "lyapunov, 1000 values, 2000 impacts each": ("lyapunov", "figure2", "--parameter", _SCAN),
    "basins, 300 x 300 starts": ("basins", "figure2"),
    "fit, law": ("fit", str(_EXAMPLES / "amplitudes_law.csv"), "--model", "law"),
    "fit, law+delay": ("fit", _CONTACT, "--model", "law+delay"),
    "fit, viscous+delay": ("fit", _CONTACT, "--model", "viscous+delay"),
    "fit, contact": ("fit", _CONTACT, "--model", "contact"),
    "tapping, on resonance": ("tapping", str(_EXAMPLES / "tapping_resonance.csv")),
}
"""Commands with `--json`, by the names of their rows."""
Row = dict[str, Any]


def main() -> None:
    """Measure what the arguments ask for, print the table, and write the page if all of it was measured."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("--beside", type=Path, metavar="DIR", help="another checkout: its times, and the ratio to them")
    parser.add_argument("--card", action="store_true", help="also on the accelerator that JAX finds, batches undivided")
    parser.add_argument("--only", metavar="WORD", help="rows whose names contain this")
    parser.add_argument("--repeats", type=int, default=5, help="runs of each row, after a first one")
    options = parser.parse_args()
    trees = {"here": ROOT}
    if options.beside is not None:
        if not (options.beside / "afm_jax" / "__main__.py").is_file():
            parser.error(f"--beside: {options.beside} holds no checkout of afm-jax; name the folder above its afm_jax")
        trees["beside"] = options.beside.resolve()
    if options.card:
        trees["card"] = ROOT
    facts = machine(trees)
    commands = {label: tree for label, tree in trees.items() if label != "card"}
    others = [label for label in trees if label != "here"]
    rows: list[Row] = []
    for row in chain(python_rows(trees, options), command_rows(commands, options), rows_of_scipy(options)):
        rows.append(row)
        say(markdown([row], others)[-1])
    table = [facts, "", *markdown(rows, others)]
    sys.stdout.write("\n".join(table) + "\n")
    if options.only is None:
        begin, end = MARKS
        text = PAGE.read_text(encoding="utf-8")
        before, after = text[: text.index(begin) + len(begin)], text[text.index(end) :]
        PAGE.write_text("\n".join([before, "", *table, "", after]), encoding="utf-8")


def machine(trees: Mapping[str, Path]) -> str:
    """Return what a reader needs to know of the machine, the programs and the trees; no names, no folders."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    kind = platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        kind = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), kind)
    load = f", load {os.getloadavg()[0]:.1f} before" if hasattr(os, "getloadavg") else ""
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("jax", "numpy", "scipy"))
    commits = "; ".join(f"{label}: commit {_commit(tree)}" for label, tree in trees.items())
    return f"{cores} cores ({kind}{load}), Python {platform.python_version()}, {versions}; {commits}."


def _commit(tree: Path) -> str:
    done = subprocess.run(
        ["git", "-C", str(tree), "rev-parse", "--short=7", "HEAD"],  # noqa: S607
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip() or "unknown"


def python_rows(trees: Mapping[str, Path], options: argparse.Namespace) -> Iterator[Row]:
    """Give the rows of `tests.benchmarks.tasks`, in microseconds of an event."""
    names = [name for name in ROWS if options.only is None or options.only in name]
    with contextlib.ExitStack() as stack:
        workers = {label: stack.enter_context(_worker(label, tree)) for label, tree in trees.items()} if names else {}
        for name in names:
            say(name)
            first = {label: _ask(worker, "prepare", name) for label, worker in workers.items()}
            runs = {
                label: partial(_ask, workers[label], "run", name)
                for label, answer in first.items()
                if "missing" not in answer
            }
            for label in workers.keys() - runs.keys():
                say(f"left out of {label}: {first[label]['missing']}")
            unit, scale = ("s", 1.0) if name.startswith("one tip") else ("µs", 1e6)
            told = alternated(runs, options.repeats)
            medians = {label: scale * seconds / first[label]["events"] for label, seconds in told.items()}
            yield {"what": name, "unit": unit, "first": first.get("here", {}).get("seconds"), **medians}


def alternated(runs: Mapping[str, Callable[[], Row]], repeats: int) -> dict[str, float]:
    """Return the median seconds of each run; what else the machine does meets all alike."""
    seconds: dict[str, list[float]] = {label: [] for label in runs}
    for _ in range(repeats):
        for label, run in runs.items():
            seconds[label].append(run()["seconds"])
    return {label: statistics.median(each) for label, each in seconds.items()}


@contextlib.contextmanager
def _worker(label: str, tree: Path) -> Iterator[subprocess.Popen[str]]:
    """Give a process that does the work of a tree, on one core: how many JAX uses is settled when it is imported."""
    pinned = hasattr(os, "sched_setaffinity")
    allowed = os.sched_getaffinity(0) if pinned else set()
    if pinned:
        os.sched_setaffinity(0, {max(allowed)})
    try:
        worker = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("tasks.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=_environment(tree) | ({"JAX_PLATFORMS": ""} if label == "card" else {}),
        )
    finally:
        if pinned:
            os.sched_setaffinity(0, allowed)
    with worker:
        yield worker


def _environment(tree: Path) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    return kept | {"PYTHONPATH": str(tree), "JAX_PLATFORMS": "cpu"}


def _ask(worker: subprocess.Popen[str], *question: str) -> Row:
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write(json.dumps(question) + "\n")
    worker.stdin.flush()
    return json.loads(worker.stdout.readline())


def command_rows(trees: Mapping[str, Path], options: argparse.Namespace) -> Iterator[Row]:
    """Give commands from the shell in seconds: with an empty cache of programs, and with the one that this fills."""
    for name, command in COMMANDS.items():
        if options.only is not None and options.only not in name:
            continue
        say(name)
        with tempfile.TemporaryDirectory() as folder:
            calls = {label: partial(_command, command, tree, Path(folder) / label) for label, tree in trees.items()}
            first = {label: call()["seconds"] for label, call in calls.items()}
            there = {label: call for label, call in calls.items() if first[label] is not None}
            medians = alternated(there, min(options.repeats, 3))
        what = f"`afm-jax {command[0]}`: {name.partition(', ')[2]}"
        yield {"what": what, "unit": "s", "first": first["here"], **medians}


def _command(command: Sequence[str], tree: Path, cache: Path) -> Row:
    """Return the seconds of a command of a tree; None where it refuses the call."""
    cache.mkdir(exist_ok=True)
    began = time.perf_counter()
    # from a folder without sources, which Python would take first
    done = subprocess.run(
        [sys.executable, "-m", "afm_jax", *command, "--json"],
        env=_environment(tree) | {"XDG_CACHE_HOME": str(cache)},
        cwd=cache,
        capture_output=True,
        text=True,
        check=False,
    )
    seconds = time.perf_counter() - began
    if done.returncode not in {0, 3}:
        say(f"left out of {tree.name}: {done.stderr.strip().splitlines()[-1:]}")
    return {"seconds": seconds if done.returncode in {0, 3} else None}


def rows_of_scipy(options: argparse.Namespace) -> Iterator[Row]:
    """Give the rows of SciPy, which has no other tree."""
    if options.only is None or options.only == "SciPy":
        from tests.benchmarks.by_scipy import scipy_rows  # noqa: PLC0415 (the other rows do without)

        say("SciPy")
        for what, seconds in scipy_rows():
            yield {"what": what, "unit": "µs", "here": 1e6 * seconds}


def markdown(rows: Sequence[Row], others: Sequence[str]) -> list[str]:
    """Return the table, with a column and its ratio for each other label; what it cannot run has no ratio."""
    headings = ["what", "median", *(word for label in others for word in (label, "ratio")), "first time, s"]
    lines = [f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    for row in rows:
        cells = [row["what"], _cell(row, "here")]
        for label in others:
            cells += [_cell(row, label), f"{row['here'] / row[label]:.2g}" if "here" in row and label in row else ""]
        first = row.get("first")
        lines.append(f"| {' | '.join([*cells, '' if first is None else f'{first:.1f}'])} |")
    return lines


def _cell(row: Row, label: str) -> str:
    if label not in row:
        return ""
    value = row[label]
    return f"{value:.0f} {row['unit']}" if value >= 100.0 else f"{value:.2g} {row['unit']}"


def say(message: str) -> None:
    """Write a line to standard error."""
    sys.stderr.write(f"{message}\n")
    sys.stderr.flush()


if __name__ == "__main__":
    main()
