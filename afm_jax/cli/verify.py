"""`afm-jax verify`: the equations against automatic differentiation."""

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.studies.verify import verify


def verification(session: Session, **sizes: int) -> Output:
    """Return the comparisons of eqs. 5 to 8 with automatic differentiation."""
    with session.working("comparing"):
        return Output.of(verify(**sizes))
