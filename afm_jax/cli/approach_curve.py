"""`afm-jax simulate SCENE --heights FROM:TO:COUNT`: an approach curve, as a table that `afm-jax tapping` reads."""

from functools import partial
from typing import Any

from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.scenes import NamedScene
from afm_jax.cli.session import Session
from afm_jax.motion.approach_curve import approach_curve
from afm_jax.saved import as_json
from fitting.simulated.experiment import table_of_curve
from fitting.tables.table import write_table

NOISE, PHASE_NOISE_DEG = 0.003, 0.2
"""Errors of curve.csv, relative and in degrees, where none are asked for."""


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
    files = {}
    if curve.settles:
        files["curve.csv"] = partial(write_table, table_of_curve(curve, **errors))
        files["curve.png"] = picture_of("approach_curve:approach_curve_figure", curve)
    return Output.of(
        curve,
        payload=as_json(curve) | {"settings": settings | errors},
        files=files,
        json_file="curve.json",
        not_valid=None if curve.settles else "the tip settles at no height",
    )
