"""`afm-jax calibrate SWEEP`: frequency, quality factor and stiffness of the free cantilever."""

from pathlib import Path
from typing import Any

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from fitting.calibration.calibrate import calibrate
from fitting.calibration.sweep import read_sweep


def calibration(session: Session, *, sweep: Path, deflection: str, **options: Any) -> Output:
    """Return frequency, quality factor and stiffness of a free cantilever."""
    measured = read_sweep(sweep)
    with session.working(f"fitting {measured.points} points"):
        result = calibrate(measured, static=deflection == "static", **options)
    return Output.of(result, "calibration")
