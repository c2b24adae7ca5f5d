"""What the errors of a scene's parameters make of what motions come to: the same for draws of the parameters."""

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.dynamics.bands import UncertainParameters
from afm_jax.dynamics.basins import Basins, basins_of_attraction
from afm_jax.dynamics.bifurcations import Sweep, bifurcation_diagram
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.scenefile.parameter_paths import scene_batch, scene_family

_BETWEEN = (0.025, 0.975)
_STARTS = 100
"""Starts along each axis of the basins of a draw, at most."""


def drawn_exponents(
    scene: Scene,
    given: Mapping[str, Float[np.ndarray, " values"]],
    known: UncertainParameters,
    *,
    draws: int,
    impacts: int,
    transient: int,
) -> Float[np.ndarray, "values 2"]:
    """Return between what 95 % of the larger exponents per impact of drawn scenes lie; NaN where they are unknown.

    Args:
        scene: the scene.
        given: values of a parameter by its path, or nothing.
        known: what is drawn.
        draws: how many.
        impacts: of `lyapunov_spectrum`.
        transient: of the same.
    """
    for path in given:
        known = known.without(path)
    drawn = known.possible_draws(draws)
    count = len(next(iter(given.values()), np.zeros(1)))
    columns = {path: np.repeat(values, draws) for path, values in given.items()}
    columns |= {path: np.tile(column, count) for path, column in zip(known.paths, drawn.T, strict=True)}
    found = lyapunov_spectrum(scene_batch(scene, columns), impacts=impacts, transient=transient)
    larger = found.exponents_per_impact[:, 0].reshape(count, draws)
    return np.stack([np.quantile(larger, share, axis=1, method="nearest") for share in _BETWEEN], axis=1)


def verdict_probability(
    scene: Scene, parameter: str, sweep: Sweep, known: UncertainParameters, *, draws: int, impacts: int
) -> Float[np.ndarray, " values"]:
    """Return the share of drawn scenes whose sweep comes to the same verdict, at each value.

    Args:
        scene: the scene.
        parameter: that is swept.
        sweep: of the scene.
        known: what is drawn.
        draws: how many.
        impacts: at each value.
    """
    names, same = np.array(sweep.verdicts.names()), np.zeros(len(sweep.values))
    for one in _drawn(scene, known.without(parameter), draws):
        other = bifurcation_diagram(one, parameter, sweep.values, upward=sweep.upward, impacts=impacts)
        same += names == np.array(other.verdicts.names())
    return same / draws


def drawn_shares(
    scene: Scene, basins: Basins, known: UncertainParameters, *, draws: int
) -> Float[np.ndarray, "attractors 2"]:
    """Return between what 95 % of the shares of each attractor lie in drawn scenes, matched by their names.

    Args:
        scene: the scene.
        basins: of the scene.
        known: what is drawn.
        draws: how many.
    """
    speed = basins.rebound_speed_nm_per_us
    half = 0.5 * (speed[1] - speed[0])
    rows, columns = (min(count, _STARTS) for count in basins.attractor.shape)
    ends = max(float(speed[0] - half), 0.0), float(speed[-1] + half)
    shares = np.zeros((draws, len(basins.attractors)))
    for number, one in enumerate(_drawn(scene, known, draws)):
        other = basins_of_attraction(one, columns=columns, rows=rows, speeds_nm_per_us=ends)
        there = {attractor.name: share for attractor, share in zip(other.attractors, other.share, strict=True)}
        shares[number] = [there.get(attractor.name, 0.0) for attractor in basins.attractors]
    return np.quantile(shares, _BETWEEN, axis=0).T


def _drawn(scene: Scene, known: UncertainParameters, draws: int) -> Iterator[Scene]:
    family = scene_family(scene, *known.paths)
    for values in known.possible_draws(draws):
        yield family(*values)
