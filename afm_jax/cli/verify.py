"""`afm-jax verify`: the equations against automatic differentiation."""

from typing import Annotated

from click import IntRange

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.studies.verify import verify


def verification(
    session: Session, *, states: Annotated[int, IntRange(1)] = 10_000, seed: Annotated[int, IntRange(0)] = 0
) -> Output:
    """Compare eqs. 5 to 8 with automatic differentiation, forward and reverse, at random scenes and starts.

    Equations are compared as printed; eq. 8 on single-impact orbits. Differences are relative to the sum of the
    magnitudes of a formula's terms. With --out verify.csv. Exit code 3 if one is too large.

    Args:
        session: for progress.
        states: random states of each kind.
        seed: seed of the random states.
    """
    with session.working("comparing"):
        return Output.of(verify(states=states, seed=seed))
