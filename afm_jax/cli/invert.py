"""`afm-jax invert TABLE.csv`: speeds and delay of every impact from amplitude and phase, without any law."""

from pathlib import Path
from typing import Annotated

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.tables import example_path
from afm_jax.cli.values import QualityFactor, Share
from fitting.inversion.invert import invert
from fitting.tables.table import as_table


def inversion(
    session: Session,
    table: Annotated[Path | None, "[TABLE.csv]"] = None,
    *,
    noise: Annotated[float | None, Share("a relative error")] = None,
    quality_factor: QualityFactor | None = None,
    example: bool = False,  # noqa: ARG001 (the row says that it stands for a table)
) -> Output:
    """Read approach speed, rebound speed and collision delay off amplitude and phase, row by row, without any law.

    The table is that of `afm-jax fit` with phase_deg and phase_error_deg. Straight lines are then fitted to the losses
    u_in^2 - u_out^2, over (1, u_in) for a viscous loss and over (1, u_in^2) for a restitution. Rows without a result
    are listed with the reason. With --out invert.csv, .json and .png. Exit code 3 if the rows determine no line, or no
    line explains them.

    Args:
        session: for progress.
        table: the file.
        noise: relative error of amplitudes for which the table states none, such as 1%.
        quality_factor: instead of the table's; '40 +- 2', or none: no air damping.
        example: invert the bundled table instead of a file.
    """
    measured = as_table(table or example_path(), noise=noise, quality_factor=quality_factor)
    with session.working(f"inverting {measured.rows} rows (the first run compiles for some seconds)"):
        result = invert(measured)
    return Output.of(result, "invert")
