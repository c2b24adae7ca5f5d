"""`afm-jax lockin TRACE...`: response order, amplitudes and phase from time traces of the deflection."""

from pathlib import Path

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Finite, FiniteOrNone

_SETTINGS = (
    ("sampling-rate-mhz", "MHz", "Samples per us; not needed with a column time_us."),
    ("drive-frequency-khz", "kHz", "Frequency of the platform."),
    ("drive-amplitude-nm", "nm", "Amplitude of the platform, for the table; else the column platform_nm tells it."),
    ("offset-nm", "nm", "Mean height of the platform above the tip's rest position, for the table."),
    (
        "drive-phase-deg",
        "DEGREES",
        "psi in platform = offset + beta cos(omega t + psi), t the trace's time [default: 0].",
    ),
    ("free-frequency-khz", "kHz", "Undamped natural frequency; else read off the trace, for counting impacts only."),
    ("quality-factor", "Q", "Quality factor of the cantilever; none: no air damping."),
    ("mass-ng", "ng", "Effective mass, for the table."),
    ("spring-constant-n-per-m", "N_PER_M", "Or the spring constant, which says the mass k/Omega^2."),
    ("rest-nm", "nm", "What the deflection reads at the tip's rest position [default: 0]."),
)


def _with_settings(function):
    """Add an option for every setting of a trace."""
    for name, unit, text in reversed(_SETTINGS):
        kind = FiniteOrNone() if name == "quality-factor" else Finite()
        function = click.option(f"--{name}", type=kind, metavar=unit, help=text)(function)
    return function


@click.command()
@click.argument("traces", metavar="TRACE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@_with_settings
@click.option("--order", type=click.IntRange(1, 16), metavar="N", help="Flag responses of another order than N.")
@click.option("--group", metavar="NAME", help="Group of an HDF5 file that holds the data sets.")
@with_session
def command(
    session: Session, traces: tuple[Path, ...], order: int | None, group: str | None, **settings: float | None
) -> None:
    """Turn time traces of the deflection into response order, amplitudes and phase.

    TRACE is CSV or HDF5 with the columns deflection_nm (the tip's height), time_us (or a sampling rate) and, as
    reference of the phase, platform_nm or drive. Every setting below may stand in the file instead, as a comment
    `# drive_frequency_khz = 180` or an HDF5 attribute; options hold for all traces. Orbits that are not steady with
    one impact are flagged: several impacts, period doubled, chaotic, drifting, ringing, stuck, no response. With --out
    a picture of every trace, lockin.json, and amplitudes.csv for `afm-jax fit` with the steady ones; traces of one
    drive give one row, their mean. Exit code 3 if a trace is flagged.
    """
    from fitting.tables.csv_text import TableError  # noqa: PLC0415
    from fitting.traces.lockin import (  # noqa: PLC0415
        lockin,
        table_of,
    )
    from fitting.traces.report import lockin_payload, lockin_summary, write_lockin  # noqa: PLC0415
    from fitting.traces.trace import read_trace  # noqa: PLC0415

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
    session.emit(lockin_payload(results, fault), *(lockin_summary(result) for result in results))
    if session.out is not None:
        for path in write_lockin(results, session.out, table, fault):
            session.note(f"wrote {path}")
        if fault is not None:
            session.note(f"no amplitudes.csv: {fault}")
    for remark in () if table is None else table.remarks[1:]:
        session.note(remark)
    flagged = [result for result in results if not result.steady]
    for result in flagged[1:]:
        session.note(f"flagged: {result.trace.source}: {result.verdict}")
    if flagged:
        raise NotValid(f"{flagged[0].trace.source}: {flagged[0].verdict}")
