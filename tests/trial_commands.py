"""Commands of tests: they do what a test puts in place of `body`, or end in a bad way."""

from typing import Any

from afm_jax.cli.scenes import NamedScene


def body(*arguments: Any) -> Any:
    """Do nothing."""


def trial(session: Any) -> Any:
    """Try."""
    return body(session)


def trial_of_a_scene(session: Any, scene: NamedScene) -> Any:
    """Try."""
    return body(session, scene)
