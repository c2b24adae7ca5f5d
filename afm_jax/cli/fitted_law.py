"""`--law FILE`: a scene with the law of a file, and what the file says of the law's errors."""

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
        metavar="FILE",
        help="A fit's fit.json or law.csv, a law.json of `collide --make-law`, or a CSV of measured speeds: its law in "
        "place of the scene's, its errors as bands.",
    )(function)


def with_law_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options --law and --draws."""
    draws = click.option(
        "--draws", type=click.IntRange(2), default=20, show_default=True, help="Laws drawn from the fit for the bands."
    )
    return with_law_option(draws(function))


def with_fitted_law(scene: "Scene", path: Path | None) -> "tuple[Scene, UncertainParameters | None]":
    """Return a scene with the law of a file in place of its own, and what is uncertain of it with its covariance.

    Without a file it is the scene itself, of which nothing is uncertain; so it is of a law whose file tells no errors.
    Of a fit that tells its law by parameters alone it is the formula with these.

    The quality factor is that of the fit where it was fitted along. What the fit found of its instrument (calibrations,
    origin of offsets) belongs to the table, not to the scene; its uncertainty is in the covariance.

    Args:
        scene: whose cantilever and drives are kept.
        path: a file of a law (`afm_jax.load_law`), if there is one.

    Raises:
        ValueError: if the file is no valid fit of a law, or the fit does not say how sure its parameters are.
    """
    if path is None:
        return scene, None
    if not _is_of_parameters(path):
        return _with_table(scene, path)
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


def _is_of_parameters(path: Path) -> bool:
    """Say whether a file is a fit that tells its law by parameters alone, or nothing that is known."""
    import json  # noqa: PLC0415

    from afm_jax.whole_files import read_whole  # noqa: PLC0415

    if path.is_dir():
        # of a report
        return False
    try:
        text = read_whole(path).decode("utf-8-sig")
        found = json.loads(text)
    except OSError:
        return True
    except (ValueError, RecursionError):
        return path.suffix == ".json"
    if not isinstance(found, dict) or found.get("format") == "afm-jax law":
        return not isinstance(found, dict)
    law = found.get("law")
    return not (isinstance(law, dict) and isinstance(law.get("numbers"), dict) and found.get("valid"))


def _with_table(scene: "Scene", path: Path) -> "tuple[Scene, UncertainParameters | None]":
    """Return a scene with the table of a law's file, and the unknowns of its errors."""
    import json  # noqa: PLC0415

    import equinox as eqx  # noqa: PLC0415
    import jax.numpy as jnp  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    from afm_jax.apparatus.scene import check_mass  # noqa: PLC0415
    from afm_jax.dynamics.bands import UncertainParameters  # noqa: PLC0415
    from afm_jax.scenefile.law_files import load_law  # noqa: PLC0415
    from afm_jax.scenefile.parameter_paths import UNKNOWN  # noqa: PLC0415

    law = load_law(path)
    try:
        check_mass(law, scene.cantilever)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    made = eqx.tree_at(lambda parts: parts.interaction, scene, law, is_leaf=lambda part: part is None)
    paths = [f"{UNKNOWN}{number}" for number in range(1, law.unknowns + 1)]
    values, errors = [0.0] * law.unknowns, [1.0] * law.unknowns
    # the instrument's quality factor is the fit's where that has found it
    found = json.loads(path.read_text("utf-8-sig")) if path.suffix == ".json" else {}
    quality = found.get("parameters", {}).get("quality_factor") if isinstance(found.get("parameters"), dict) else None
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


def extrapolation_of(scene: "Scene", speeds: Any) -> str | None:
    """Return a sentence on approach speeds outside those that a scene's law is known for; None where there are none.

    Args:
        scene: any.
        speeds: approach speeds in nm/us that count, of any shape; NaN: none.
    """
    import numpy as np  # noqa: PLC0415

    from afm_jax.impact.law import TabulatedLaw  # noqa: PLC0415

    law = scene.interaction
    if not isinstance(law, TabulatedLaw):
        return None
    known = np.asarray(speeds, float)
    outside = known[np.isfinite(known) & np.asarray(law.extrapolated(known))]
    if not outside.size:
        return None
    low, high = float(law.slowest_nm_per_us), float(law.fastest_nm_per_us)
    ends = f"{outside.min():.4g}" if outside.size == 1 else f"{outside.min():.4g} to {outside.max():.4g}"
    return (
        f"Extrapolated: the law is known from {low:.4g} to {high:.4g} nm/us, but {outside.size} of {known.size} "
        f"impacts come at {ends} nm/us."
    )
