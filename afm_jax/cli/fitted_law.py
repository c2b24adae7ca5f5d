"""`--law FILE`: a scene with the law of a file, and what the file says of the law's errors."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene, check_mass
from afm_jax.dynamics.bands import UncertainParameters
from afm_jax.impact.law import TabulatedLaw
from afm_jax.scenefile.law_files import law_and_fit
from afm_jax.scenefile.parameter_paths import UNKNOWN


def with_fitted_law(scene: Scene, path: Path | None) -> tuple[Scene, UncertainParameters | None]:
    """Return a scene with the law of a file in place of its own, and the unknowns of its errors.

    Without a file the scene is returned as it is, without unknowns; a law whose file has no errors adds none either.
    The quality factor is that of the fit if it was fitted along. The fitted instrument (calibrations, origin of
    offsets) belongs to the table, not to the scene; its uncertainty is part of the law's.

    Args:
        scene: whose cantilever and drives are kept.
        path: a file of a law (`afm_jax.load_law`), if there is one.

    Raises:
        ValueError: if the file holds no law that can be used, or that of a tip of another mass.
    """
    if path is None:
        return scene, None
    law, fit = law_and_fit(path)
    try:
        check_mass(law, scene.cantilever)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    made = eqx.tree_at(lambda parts: parts.interaction, scene, law, is_leaf=lambda part: part is None)
    paths = [f"{UNKNOWN}{number}" for number in range(1, law.unknowns + 1)]
    values, errors = [0.0] * law.unknowns, [1.0] * law.unknowns
    quality = fit.get("parameters", {}).get("quality_factor")
    if quality is not None:
        if scene.cantilever.quality_factor is None:
            raise ValueError(f"{path}: has a quality_factor, but the scene's [cantilever] has none: give it there")
        number = jnp.asarray(float(quality["value"]))
        made = eqx.tree_at(lambda parts: parts.cantilever.quality_factor, made, number)
        if quality["standard_error"]:
            paths.append("cantilever.quality_factor")
            values.append(float(quality["value"]))
            errors.append(float(quality["standard_error"]))
    if not law.unknowns:
        return made, None
    return made, UncertainParameters(tuple(paths), np.array(values), np.diag(np.array(errors) ** 2))


def as_drawn(scene: Scene) -> Scene:
    """Return a scene whose law has no errors, as drawn scenes have none: they then run in one compiled program."""
    law = scene.interaction
    if not isinstance(law, TabulatedLaw) or law.deviations is None:
        return scene
    return eqx.tree_at(lambda scene: scene.interaction.deviations, scene, None)
