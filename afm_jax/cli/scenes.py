"""Scenes of commands: what the argument SCENE names, with the law of `--law` in place of its own; their parameters."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.scene import Scene, check_mass
from afm_jax.cli.session import add_note
from afm_jax.dynamics.bands import UncertainParameters
from afm_jax.impact.law import Law, TabulatedLaw
from afm_jax.scenefile.law_files import law_and_fit
from afm_jax.scenefile.parameter_paths import UNKNOWN, ParameterRange, check_ranges, parse_range
from afm_jax.scenefile.scenefile import Start, read_scene


class NamedScene(NamedTuple):
    """The scene of a call: what the argument SCENE named, with the law of --law in place of its own.

    Attributes:
        name: as it was given, for messages.
        scene: the scene.
        start: the start that its file states, if it does.
        unknowns: what is uncertain of the law of --law, if its file tells errors.
    """

    name: str
    scene: Scene
    start: Start | None
    unknowns: UncertainParameters | None


def load_named(name: str, law: Path | None = None) -> NamedScene:
    """Return the scene that an argument names, with the law of a file in place of its own if there is one.

    Args:
        name: a path, or a preset's name; the result says what the file leaves to be assumed.
        law: a file of a law (`afm_jax.load_law`).
    """
    scene, start, assumed = read_scene(name)
    add_note(*assumed)
    scene, unknowns = (scene, None) if law is None else with_fitted_law(scene, law)
    return NamedScene(name, scene, start, unknowns)


def with_fitted_law(scene: Scene, path: Path) -> tuple[Scene, UncertainParameters | None]:
    """Return a scene with the law of a file in place of its own, and the unknowns of its errors if the file tells them.

    The quality factor is that of the fit where it was fitted along. What the fit found of its instrument (calibrations,
    origin of offsets) belongs to the table, not to the scene; its uncertainty is in the law's.

    Raises:
        ValueError: if the file holds no law that can be used, or that of a tip of another mass.
    """
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


def ranges_of(scene: NamedScene, texts: Sequence[str], *, counted: bool) -> list[ParameterRange]:
    """Return the ranges of a scene's parameters that options give.

    Args:
        scene: the scene.
        texts: PARAMETER=low:high:count, or without count.
        counted: whether with count.

    Raises:
        ValueError: if one is no range, or the scene lacks a parameter or cannot be at an end.
    """
    ranges = [parse_range(text, counted=counted) for text in texts]
    check_ranges(scene.scene, *ranges)
    return ranges


def refuse_other_than_law(scene: NamedScene) -> None:
    """Check that a scene's interaction is a law.

    Raises:
        ValueError: if not; says what gives one.
    """
    if isinstance(scene.scene.interaction, Law):
        return
    absent = scene.scene.interaction is None
    advice = (
        "a tip that meets nothing has none"
        if absent
        else f"`afm-jax collide {scene.name} --make-law --out DIR` gives a contact's law"
    )
    raise ValueError(f'[interaction] model: must be "law" here, but is "{"none" if absent else "contact"}"; {advice}')
