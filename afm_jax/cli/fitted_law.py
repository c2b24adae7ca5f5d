"""`--law fit.json`: a scene with the law that a fit found, and what the fit says of its errors."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from afm_jax.apparatus.scene import Scene
    from afm_jax.dynamics.bands import UncertainParameters


def with_law_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the option --law."""
    return click.option(
        "--law",
        type=click.Path(path_type=Path),
        metavar="JSON",
        help="A fit (fit.json of `afm-jax fit --out`): its law in place of the scene's, its errors as bands.",
    )(function)


def with_law_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options --law and --draws."""
    draws = click.option(
        "--draws", type=click.IntRange(2), default=20, show_default=True, help="Laws drawn from the fit for the bands."
    )
    return with_law_option(draws(function))


def with_fitted_law(scene: "Scene", path: Path | None) -> "tuple[Scene, UncertainParameters | None]":
    """Return a scene with the law of a fit in place of its own, and the fit's values with their covariance.

    Without a fit it is the scene itself, of which nothing is uncertain.

    It is that of the fit's parameters: of its model's formula that is closest to what was found.

    The quality factor is that of the fit where it was fitted along. What the fit found of its instrument (calibrations,
    origin of offsets) belongs to the table, not to the scene; its uncertainty is in the covariance.

    Args:
        scene: whose cantilever and drives are kept.
        path: the fit.json that `afm-jax fit --out` writes, if there is one.

    Raises:
        ValueError: if the file is no valid fit of a law, or the fit does not say how sure its parameters are.
    """
    if path is None:
        return scene, None
    import equinox as eqx  # noqa: PLC0415
    import jax.numpy as jnp  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    from afm_jax.dynamics.bands import UncertainParameters  # noqa: PLC0415
    from fitting.experiments.belief import read_belief  # noqa: PLC0415
    from fitting.parameters import DELAY, LAW  # noqa: PLC0415

    belief, payload = read_belief(path)
    if not payload["valid"]:
        raise ValueError(f"{path}: the fit is not valid, so that its law means nothing; give a valid one")
    problem, found = belief.problem, payload["parameters"]
    if problem.model == "contact":
        raise ValueError(f"{path}: is a fit of a contact, which has no law; fit --model viscous+delay")
    everything = jnp.asarray(belief.values)
    law = problem.law(everything, belief.fixed)
    # what else a fit may have belongs to its instrument
    paths = {"quality_factor": "cantilever.quality_factor"}
    paths |= {part.name: f"interaction.{part.name}" for part in LAW}
    paths |= {part.name: f"interaction.delay.{part.name.removeprefix('delay_')}" for part in DELAY}
    names = [name for name in problem.names if name in paths]
    unsure = [name for name in names if not found[name]["standard_error"]]
    if unsure:
        raise ValueError(f"{path}: the fit says no standard error of {', '.join(unsure)}; there are no bands without")
    if "quality_factor" in names and scene.cantilever.quality_factor is None:
        raise ValueError(f"{path}: has a quality_factor, but the scene's [cantilever] has none: give it there")
    places = [problem.names.index(name) for name in names]
    errors = np.array([found[name]["standard_error"] for name in names], float)
    correlations = np.array(payload["correlations"]["matrix"], float)[np.ix_(places, places)]
    covariance = correlations * np.outer(errors, errors)
    made = eqx.tree_at(lambda parts: parts.interaction, scene, law, is_leaf=lambda part: part is None)
    if "quality_factor" in names:
        made = eqx.tree_at(lambda parts: parts.cantilever, made, problem.cantilever(everything, scene.cantilever))
    known = UncertainParameters(tuple(paths[name] for name in names), belief.values[places], covariance)
    return made, known
