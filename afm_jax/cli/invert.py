"""`afm-jax invert TABLE.csv`: speeds and delay of every impact from amplitude and phase, without any law."""

from pathlib import Path

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import example_path, tables_with
from fitting.inversion.invert import invert


def inversion(
    session: Session,
    *,
    table: Path | None,
    noise: float | None,
    quality_factor: tuple[float, float | None] | None,
    example: bool,
) -> Output:
    """Return the inversion of a table, or of the bundled one."""
    (measured,) = tables_with([example_path() if example or table is None else table], noise, quality_factor)
    with session.working(f"inverting {measured.rows} rows (the first run compiles for some seconds)"):
        result = invert(measured)
    return Output.of(result, "invert")
