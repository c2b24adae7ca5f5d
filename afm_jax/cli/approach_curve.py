"""`afm-jax simulate SCENE --heights FROM:TO:COUNT`: an approach curve, as a table that `afm-jax tapping` reads."""

from functools import partial
from typing import Any

import numpy as np

from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.scenes import NamedScene
from afm_jax.cli.session import Session
from afm_jax.columns import rows_of
from afm_jax.motion.approach_curve import ApproachCurve, CurveOutcome, approach_curve
from afm_jax.report import Cell, table_of
from fitting.simulated.experiment import table_of_curve
from fitting.tables.table import write_table

NOISE, PHASE_NOISE_DEG = 0.003, 0.2
"""Errors of curve.csv, relative and in degrees, where none are asked for."""

_CELLS: dict[str, Cell] = {
    "height\n(nm)": "height_nm",
    "": "direction",
    "amplitude\n(nm)": "amplitude_nm",
    "lag\n(degrees)": "phase_lag_deg:.5g",
    "lost to the\nsample (aJ)": "dissipated_in_contact_aj:.4g",
    "outcome": "outcome",
}


def approach(
    session: Session,
    scene: NamedScene,
    heights: tuple[float, ...],
    settings: dict[str, Any],
    errors: dict[str, Any],
) -> Output:
    """Return the approach curve of a scene.

    Args:
        session: for progress.
        scene: the scene of the call.
        heights: of the sample in nm, gone through and back again.
        settings: of `afm_jax.approach_curve`.
        errors: of `fitting.table_of_curve`.
    """
    with session.working("following heights (the first run compiles for some seconds)", "heights") as report:
        curve = approach_curve(scene.scene, heights, report=report, **settings)
    points = _points(curve)
    counted = {kind: int(np.count_nonzero(curve.outcome == kind)) for kind in CurveOutcome}
    repeats = sum(counted[kind] for kind in (CurveOutcome.TAPS, CurveOutcome.FREE, CurveOutcome.OTHER_ORBIT))
    free_tip = (
        f"Free tip, driven by a {curve.drive} at {curve.drive_frequency_khz:.6g} kHz: "
        f"{curve.free_amplitude_nm:.6g} nm, {curve.free_phase_lag_deg:.5g} degrees."
    )
    return Output(
        payload={
            **{name: getattr(curve, name) for name in _OF_FREE_TIP},
            **points,
            "valid": repeats > 0,
            "settings": settings | errors,
        },
        text=[
            table_of(_CELLS, rows_of(points)),
            free_tip,
            *(f"{count} of {len(curve.reasons)}: {kind.sentence}" for kind, count in counted.items() if count),
        ],
        tables={"curve_points.csv": points},
        files={
            "curve.csv": partial(write_table, table_of_curve(curve, **errors)),
            "curve.png": picture_of("approach_curve:approach_curve_figure", curve),
        }
        if repeats
        else {},
        json_file="curve.json",
        not_valid=None if repeats else "the tip settles at no height",
    )


_OF_FREE_TIP = ("drive", "drive_frequency_khz", "free_amplitude_nm", "free_phase_lag_deg")


def _points(curve: ApproachCurve) -> dict[str, Any]:
    """Return the columns of curve_points.csv, a row a height."""
    names = ("height_nm", "amplitude_nm", "phase_lag_deg", "dissipated_in_contact_aj", "virial_aj")
    told = curve.periods > 0
    return {
        **{name: getattr(curve, name) for name in names},
        "direction": np.where(curve.retract, "retract", "approach").tolist(),
        **{name: list(np.where(told, getattr(curve, name), None)) for name in ("contacts", "periods")},
        "outcome": [CurveOutcome(kind).name.lower() for kind in curve.outcome.tolist()],
        "reason": list(curve.reasons),
    }
