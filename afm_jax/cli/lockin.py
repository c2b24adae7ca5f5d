"""`afm-jax lockin TRACE...`: response order, amplitudes and phase from time traces of the deflection."""

from functools import partial
from pathlib import Path

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from fitting.tables.csv_text import TableError
from fitting.traces.lockin import lockin, table_of
from fitting.traces.report import lockin_payload, lockin_summary, write_lockin
from fitting.traces.trace import read_trace


def lockin_of_traces(
    session: Session, *, traces: tuple[Path, ...], order: int | None, group: str | None, **settings: float | None
) -> Output:
    """Return what a lock-in reads of each trace, and the table of those that are steady."""
    # all are read first: a fault in the last should not come after minutes of work on the others
    read = [read_trace(path, group=group, **settings) for path in traces]
    results = []
    for trace in read:
        with session.working(f"reading {trace.samples} samples of {trace.source}"):
            results.append(lockin(trace, order=order))
    table, fault = None, None
    try:
        table = table_of(results)
    except TableError as error:
        fault = str(error)
    flagged = [f"{result.trace.source}: {result.verdict}" for result in results if not result.steady]
    if session.out is not None and fault is not None:
        session.note(f"no amplitudes.csv: {fault}")
    for remark in () if table is None else table.remarks[1:]:
        session.note(remark)
    for verdict in flagged[1:]:
        session.note(f"flagged: {verdict}")
    return Output(
        payload=lockin_payload(results, fault),
        text=[partial(lockin_summary, result) for result in results],
        report=lambda folder, _: write_lockin(results, folder, table, fault),
        not_valid=flagged[0] if flagged else None,
    )
