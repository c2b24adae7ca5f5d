"""`afm-jax verify`: the equations against automatic differentiation and against 50 digits."""

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.verify.checks import Verification, verify


def verification(session: Session, **sizes: int) -> Output:
    """Return the comparisons of eqs. 5 to 8 with automatic differentiation and with 50 digits."""
    with session.working("comparing"):
        checks = verify(**sizes)
    return Output.of(Verification(checks, **sizes))
