"""`afm-jax invert TABLE.csv`: speeds and delay of every impact from amplitude and phase, without any law."""

from functools import partial
from pathlib import Path

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import example_path, tables_with
from afm_jax.scenefile.law_files import load_law
from fitting.inversion.invert import invert
from fitting.inversion.report import inversion_summary, write_inversion


def inversion(  # noqa: PLR0913
    session: Session,
    *,
    table: Path | None,
    noise: float | None,
    quality_factor: tuple[float, float | None] | None,
    frequency_error_khz: float | None,
    truth: Path | None,
    law: Path | None,
    example: bool,
) -> Output:
    """Return the inversion of a table, or of the bundled one, beside a law that is known or that was fitted."""
    (measured,) = tables_with([example_path() if example or table is None else table], noise, quality_factor)
    true_law, fitted_law = (None if path is None else load_law(path) for path in (truth, law))
    with session.working(f"inverting {measured.rows} rows (the first run compiles for some seconds)"):
        result = invert(measured, frequency_error_khz=frequency_error_khz, truth=true_law, law=fitted_law)
    return Output.of_report(result, partial(inversion_summary, result), partial(write_inversion, result))
