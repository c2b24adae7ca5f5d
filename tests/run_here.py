"""A measurement in the test's own process, where compiled programs are kept from one run of the tests to the next."""

import inspect
from collections.abc import Callable
from typing import Any


def run_here(task: Callable[..., Any], **settings: Any) -> Any:
    """Stand in for `afm_jax.studies.timing.run_in_own_process`."""
    return task(**settings)


def answered_with(result: Any) -> Callable[..., Any]:
    """Return a stand-in that has measured already; it sees that the function takes the settings."""

    def run(task: Callable[..., Any], **settings: Any) -> Any:
        _ = inspect.signature(task).bind(**settings)
        return result

    return run
