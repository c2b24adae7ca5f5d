"""`afm-jax calibrate SWEEP`: frequency, quality factor and stiffness of the free cantilever."""

from pathlib import Path
from typing import Any

from afm_jax.cli.command import Output, later
from afm_jax.cli.session import Session
from afm_jax.plots.picture_style import save
from fitting.calibration.calibrate import calibrate
from fitting.calibration.sweep import read_sweep


def calibration(session: Session, *, sweep: Path, deflection: str, **options: Any) -> Output:
    """Return frequency, quality factor and stiffness of a free cantilever."""
    measured = read_sweep(sweep)
    with session.working(f"fitting {measured.points} points"):
        result = calibrate(measured, static=deflection == "static", **options)
    figure = later("fitting.calibration.picture:calibration_figure")
    files = {"calibration.png": lambda path: save(figure(result), path)}
    return Output.of(result, files=files, json_file="calibration.json")
