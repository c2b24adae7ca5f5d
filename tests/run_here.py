"""A measurement in the test's own process, where compiled programs are kept from one run of the tests to the next."""

from collections.abc import Callable
from typing import Any


def run_here(task: Callable[..., Any], **settings: Any) -> Any:
    """Stand in for `afm_jax.studies.timing.run_in_own_process`."""
    return task(**settings)
