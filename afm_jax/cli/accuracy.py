"""`afm-jax accuracy`: error against time, of a value and of its gradient."""

from typing import Annotated

from click import IntRange

from afm_jax.cli.command import Output
from afm_jax.cli.scenes import load_named
from afm_jax.cli.session import Session
from afm_jax.studies import timing
from afm_jax.studies.accuracy import measured


def accuracy(
    session: Session,
    problem: Annotated[str, "[map|collide|SCENE.toml|PRESET]"] = "map",
    *,
    contacts: Annotated[int, IntRange(1, 10_000)] = 10,
    quick: bool = False,
) -> Output:
    """Show errors of a value and of its gradient against the time they take, beside SciPy and Diffrax.

    map: the time of the next impact, by start and velocity; errors are against the finest root tolerance. collide: the
    rebound speed of the paper's contact, by speed and viscosity; errors are against a quadrature converged to rounding.
    SCENE.toml (or a preset's name): the arrival of one of the first contacts, however the scene is driven, by the
    start's velocity; errors are against the finest setting. SciPy's DOP853 and Diffrax's Dopri8 follow the same
    equations phase by phase, each ended by an event. Some minutes. With --out accuracy.csv, accuracy.json and
    accuracy.png.

    Args:
        session: for progress.
        problem: what is measured.
        contacts: for a scene: number of the contact whose arrival is compared.
        quick: few and small measurements, to check that it works.
    """
    if problem not in ("map", "collide"):
        # what is wrong with a file is said at once, and what it leaves to be assumed
        load_named(problem)
    with session.working("measuring"):
        study = timing.run_in_own_process(measured, problem=problem, contacts=contacts, quick=quick)
    return Output.of(study, "accuracy")
