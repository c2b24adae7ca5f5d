"""Errors of orbits, exponents, verdicts and basins that follow from the errors of a scene's parameters.

Takes special points, diagrams or starts, and a fit's law or errors of parameters; gives standard errors and bands in
the units of what they are of.

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
from afm_jax.scenefile.parameter_paths import scene_batch, scene_family
from afm_jax.solve.lanes import in_blocks

_BETWEEN = (0.025, 0.975)
"""Quantiles between which 95 % of the draws lie."""


class UncertainParameters(NamedTuple):
    """Parameters of a scene that are known with errors, by their paths; values and covariance in the file's units."""

    paths: tuple[str, ...]
    values: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]

    def without(self, *varied: str) -> "UncertainParameters":
        """Return the parameters without those of some paths, which are varied and have no error of their own."""
        kept = [number for number, path in enumerate(self.paths) if path not in varied]
        paths = tuple(self.paths[number] for number in kept)
        return UncertainParameters(paths, self.values[kept], self.covariance[np.ix_(kept, kept)])

    def scenes(self, scene: Scene, number: int) -> Iterator[Scene]:
        """Give a scene with parameters drawn from the normal distribution, so many times.

        Draws are physical: r in (0, 1], losses and quality factor not below 0.

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
        family = scene_family(scene, *self.paths)
        for values in drawn[good][:number]:
            yield family(*values)


def with_errors(found: Continuation, uncertain: UncertainParameters) -> Continuation:
    """Return a continuation with the errors of its special points and of the peak amplitudes along its branches.

    Those of amplitudes hold for a parameter that is held: they grow without bound towards a fold, where the orbit of a
    held parameter ceases to exist.

    Args:
        found: of the scene with the values of the uncertain parameters.
        uncertain: parameters; if the one that was followed is among them, its own error does not count.
    """
    others = uncertain.without(found.range.path)
    family: Any = found.family
    zero, unit = jnp.zeros(len(others.paths)), jnp.ones(len(others.paths))
    low, width = jnp.concatenate([family.low[:1], zero]), jnp.concatenate([family.width[:1], unit])
    family = replace(family, low=low, width=width, paths=(found.range.path, *others.paths))

    def errors(slopes: Float[np.ndarray, "points uncertain"]) -> Float[np.ndarray, " points"]:
        return np.sqrt(np.einsum("ni,ij,nj->n", slopes, others.covariance, slopes))

    special = np.zeros((len(found.special), len(others.paths)))
    for number, point in enumerate(found.special):
        at = jnp.asarray(np.append(point.point, others.values))
        special[number] = float(family.width[0]) * _slopes_at(replace(family, test=point.test), at)[0][-1]
    slopes = jax.jit(jax.vmap(lambda point: _slopes_at(family, point)[1]))
    amplitudes = []
    for branch in found.branches:
        points = np.column_stack([branch.points, np.tile(others.values, (len(branch.points), 1))])
        amplitudes.append(errors(in_blocks(slopes, points, widths=(BLOCK,))))
    return found._replace(special_errors=errors(special), amplitude_errors=tuple(amplitudes))


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


def drawn_exponents(
    scene: Scene,
    given: Mapping[str, Float[np.ndarray, " values"]],
    uncertain: UncertainParameters,
    *,
    draws: int,
    **lengths: Any,
) -> Float[np.ndarray, "values 2"]:
    """Return the interval that holds 95 % of the larger exponents per impact of drawn scenes; NaN where unknown.

    Args:
        scene: the scene.
        given: values of a parameter by its path, or nothing.
        uncertain: what is drawn.
        draws: how many.
        lengths: `impacts` and `transient` of `lyapunov_spectrum`.
    """
    larger = []
    for drawn in uncertain.without(*given).scenes(scene, draws):
        motions = scene_batch(drawn, given) if given else drawn
        found = lyapunov_spectrum(motions, **lengths)
        larger.append(np.atleast_2d(found.exponents_per_impact)[:, 0])
    return np.quantile(larger, _BETWEEN, axis=0, method="nearest").T


def verdict_probability(
    scene: Scene, parameter: str, sweep: BifurcationDiagram, uncertain: UncertainParameters, *, draws: int, **how: Any
) -> Float[np.ndarray, " values"]:
    """Return the fraction of drawn scenes whose sweep comes to the same verdict, at each value.

    Args:
        scene: the scene.
        parameter: that is swept.
        sweep: of the scene.
        uncertain: what is drawn.
        draws: how many.
        how: `start` and `impacts` of `bifurcation_diagram`.
    """
    names, same = np.array(sweep.verdicts.names()), []
    for drawn in uncertain.without(parameter).scenes(scene, draws):
        other = bifurcation_diagram(drawn, parameter, sweep.values, upward=sweep.upward, **how)
        same.append(names == np.array(other.verdicts.names()))
    return np.mean(same, axis=0)


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
    shares = []
    for drawn in uncertain.scenes(scene, draws):
        other = basins_of_attraction(drawn, columns=columns, rows=rows, speeds_nm_per_us=ends)
        there = {attractor.name: share for attractor, share in zip(other.attractors, other.share, strict=True)}
        shares.append([there.get(attractor.name, 0.0) for attractor in basins.attractors])
    return np.quantile(shares, _BETWEEN, axis=0).T
