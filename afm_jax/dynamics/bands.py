"""Errors of orbits, exponents, verdicts and basins that follow from the errors of a scene's parameters.

A special point obeys G(x, p; a) = 0, the closing conditions and its test function, for parameters a that are known up
to a covariance C. By the implicit function theorem it moves by d(x, p)/da = -(dG/d(x, p))^-1 dG/da, and the parameter
where it lies has the variance (dp/da) C (dp/da)^T. What motions come to is no smooth function of a: it is computed
again for parameters drawn from the normal distribution with covariance C.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.dynamics.basins import Basins, basins_of_attraction
from afm_jax.dynamics.bifurcations import BifurcationDiagram, bifurcation_diagram
from afm_jax.dynamics.continuation import Continuation
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.dynamics.impact_loop import highest_point
from afm_jax.dynamics.impact_orbits import BLOCK, LawLoops
from afm_jax.dynamics.special_points import OrbitBranch
from afm_jax.scenefile.parameter_paths import scene_batch, scene_family
from afm_jax.solve.lanes import in_blocks

_BETWEEN = (0.025, 0.975)
"""Quantiles between which 95 % of the draws lie."""


class UncertainParameters(NamedTuple):
    """Parameters of a scene that are known with errors, by their paths; values and covariance in the file's units."""

    paths: tuple[str, ...]
    values: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]

    def without(self, path: str) -> "UncertainParameters":
        """Return the parameters without the one of a path, which is varied and has no error of its own."""
        kept = [number for number, other in enumerate(self.paths) if other != path]
        paths = tuple(self.paths[number] for number in kept)
        return UncertainParameters(paths, self.values[kept], self.covariance[np.ix_(kept, kept)])

    def possible_draws(self, number: int) -> Float[np.ndarray, "draws parameters"]:
        """Return draws from the normal distribution that are physical: r in (0, 1], nothing else below 0.

        Raises:
            ValueError: if hardly any can be.
        """
        drawn = np.zeros((50 * number, 0))
        if self.paths:
            drawn = np.random.default_rng(0).multivariate_normal(self.values, self.covariance, size=50 * number)
        good = np.ones(len(drawn), bool)
        for path, column in zip(self.paths, drawn.T, strict=True):
            if path == "interaction.r":
                good &= (column > 0.0) & (column <= 1.0)
            if path in ("interaction.epsilon", "interaction.viscous_loss", "cantilever.quality_factor"):
                good &= column >= 0.0
        if good.sum() < number:
            raise ValueError("the law's errors are so wide that hardly any draw is a law: there are no bands")
        return drawn[good][:number]

    def scenes(self, scene: Scene, number: int) -> Iterator[Scene]:
        """Give a scene with drawn parameters, so many times."""
        family = scene_family(scene, *self.paths)
        for values in self.possible_draws(number):
            yield family(*values)


def special_errors(continuation: Continuation, uncertain: UncertainParameters) -> Float[np.ndarray, " special"]:
    """Return the standard error of the parameter at each special point.

    Args:
        continuation: of the scene with the values of the uncertain parameters.
        uncertain: parameters; if the one that was followed is among them, its own error does not count.
    """
    uncertain = uncertain.without(continuation.range.path)
    width, errors = continuation.range.high - continuation.range.low, []
    for point in continuation.special:
        at = jnp.asarray(np.append(point.point, uncertain.values))
        by_uncertain, _ = _slopes_at(_with_uncertain(continuation, uncertain, point.test), at)
        slope = width * np.asarray(by_uncertain)[-1]
        errors.append(np.sqrt(slope @ uncertain.covariance @ slope))
    return np.array(errors)


def amplitude_errors(
    continuation: Continuation, branch: OrbitBranch, uncertain: UncertainParameters
) -> Float[np.ndarray, " points"]:
    """Return the standard error of the peak amplitude in nm at each point of a branch, its own parameter held.

    It grows without bound towards a fold, where the orbit of a held parameter ceases to exist.
    """
    uncertain = uncertain.without(continuation.range.path)
    family = _with_uncertain(continuation, uncertain, None)
    points = np.column_stack([branch.points, np.tile(uncertain.values, (len(branch.points), 1))])
    slope = in_blocks(lambda block: _amplitude_slopes(family, block), points, widths=(BLOCK,))
    return np.sqrt(np.einsum("ni,ij,nj->n", slope, uncertain.covariance, slope))


def _with_uncertain(continuation: Continuation, uncertain: UncertainParameters, test: int | None) -> LawLoops:
    """Return the loops of a continuation with the uncertain parameters behind the followed one."""
    family: Any = continuation.family
    zero, unit = jnp.zeros(len(uncertain.paths)), jnp.ones(len(uncertain.paths))
    low, width = jnp.concatenate([family.low[:1], zero]), jnp.concatenate([family.width[:1], unit])
    return replace(family, low=low, width=width, paths=(continuation.range.path, *uncertain.paths), test=test)


@jax.jit
def _slopes_at(family: LawLoops, point: Float[Array, " n"]) -> tuple[Array, Array]:
    """Return how what is solved for moves with the uncertain parameters behind it, and how the peak amplitude does.

    All that stands before the uncertain parameters is solved for, but for a followed one that is held.
    """
    uncertain = len(family.paths) - 1

    def equations_and_peak(point: Array) -> tuple[Array, Array]:
        return family.equations(point), highest_point(*family.at(point), family.samples)

    by_point, peak_by_point = jax.jacfwd(equations_and_peak)(point)
    solved, behind = by_point.shape[0], point.shape[0] - uncertain
    by_uncertain = -jnp.linalg.solve(by_point[:, :solved], by_point[:, behind:])
    return by_uncertain, peak_by_point[behind:] + peak_by_point[:solved] @ by_uncertain


@jax.jit
def _amplitude_slopes(family: LawLoops, points: Float[Array, "points n"]) -> Float[Array, "points uncertain"]:
    return jax.vmap(lambda point: _slopes_at(family, point)[1])(points)


def drawn_exponents(
    scene: Scene,
    given: Mapping[str, Float[np.ndarray, " values"]],
    uncertain: UncertainParameters,
    *,
    draws: int,
    impacts: int,
    transient: int,
) -> Float[np.ndarray, "values 2"]:
    """Return the interval that holds 95 % of the larger exponents per impact of drawn scenes; NaN where unknown.

    Args:
        scene: the scene.
        given: values of a parameter by its path, or nothing.
        uncertain: what is drawn.
        draws: how many.
        impacts: of `lyapunov_spectrum`.
        transient: of `lyapunov_spectrum`.
    """
    for path in given:
        uncertain = uncertain.without(path)
    drawn = uncertain.possible_draws(draws)
    count = len(next(iter(given.values()), np.zeros(1)))
    columns = {path: np.repeat(values, draws) for path, values in given.items()}
    columns |= {path: np.tile(column, count) for path, column in zip(uncertain.paths, drawn.T, strict=True)}
    exponents = lyapunov_spectrum(scene_batch(scene, columns), impacts=impacts, transient=transient)
    larger = exponents.exponents_per_impact[:, 0].reshape(count, draws)
    return np.stack([np.quantile(larger, level, axis=1, method="nearest") for level in _BETWEEN], axis=1)


def verdict_probability(
    scene: Scene,
    parameter: str,
    sweep: BifurcationDiagram,
    uncertain: UncertainParameters,
    *,
    start: tuple[float, float, float] | None = None,
    draws: int,
    impacts: int,
) -> Float[np.ndarray, " values"]:
    """Return the fraction of drawn scenes whose sweep comes to the same verdict, at each value.

    Args:
        scene: the scene.
        parameter: that is swept.
        sweep: of the scene.
        uncertain: what is drawn.
        start: of the sweeps, as of `bifurcation_diagram`.
        draws: how many.
        impacts: at each value.
    """
    names, same = np.array(sweep.verdicts.names()), np.zeros(len(sweep.values))
    for drawn in uncertain.without(parameter).scenes(scene, draws):
        other = bifurcation_diagram(drawn, parameter, sweep.values, start=start, upward=sweep.upward, impacts=impacts)
        same += names == np.array(other.verdicts.names())
    return same / draws


def drawn_shares(
    scene: Scene, basins: Basins, uncertain: UncertainParameters, *, draws: int
) -> Float[np.ndarray, "attractors 2"]:
    """Return the interval that holds 95 % of the shares of each attractor in drawn scenes, matched by their names.

    Args:
        scene: the scene.
        basins: of the scene.
        uncertain: what is drawn.
        draws: how many.
    """
    speed = basins.rebound_speed_nm_per_us
    half = 0.5 * (speed[1] - speed[0])
    # so many starts along each axis are enough for a draw
    rows, columns = (min(count, 100) for count in basins.attractor.shape)
    ends = max(float(speed[0] - half), 0.0), float(speed[-1] + half)
    shares = np.zeros((draws, len(basins.attractors)))
    for number, drawn in enumerate(uncertain.scenes(scene, draws)):
        other = basins_of_attraction(drawn, columns=columns, rows=rows, speeds_nm_per_us=ends)
        there = {attractor.name: share for attractor, share in zip(other.attractors, other.share, strict=True)}
        shares[number] = [there.get(attractor.name, 0.0) for attractor in basins.attractors]
    return np.quantile(shares, _BETWEEN, axis=0).T
