"""What the errors of a scene's parameters make of its orbits: special points and branches with their errors.

A special point obeys G(x, p; a) = 0, the closing conditions and its test function, for parameters a that are known up
to a covariance C. By the implicit function theorem it moves by d(x, p)/da = -(dG/d(x, p))^-1 dG/da, and the parameter
where it lies has the variance (dp/da) C (dp/da)^T.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from afm_jax.dynamics.closed_loops import BLOCK, Equations, Frame, equations_at, loop_at
from afm_jax.dynamics.continuation import Continuation
from afm_jax.dynamics.impact_loop import closing_gaps, highest_point
from afm_jax.dynamics.special_points import OrbitBranch, SpecialPoint
from afm_jax.solve.lanes import in_blocks

_NEVER_NEGATIVE = ("interaction.epsilon", "interaction.viscous_loss", "cantilever.quality_factor")


class UncertainParameters(NamedTuple):
    """Parameters of a scene that are known with errors, by their paths; values and covariance in the file's units."""

    paths: tuple[str, ...]
    values: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]

    def without(self, path: str) -> "UncertainParameters":
        """Return the others, with the path's own value taken as given: it is the one that is varied."""
        keep = np.array([own != path for own in self.paths])
        paths = tuple(own for own in self.paths if own != path)
        return UncertainParameters(paths, self.values[keep], self.covariance[np.ix_(keep, keep)])

    def possible_draws(self, number: int, seed: int = 0) -> Float[np.ndarray, "draws parameters"]:
        """Return draws that can be: the coefficient of restitution at most 1, nothing else below 0.

        Raises:
            ValueError: if hardly any can be.
        """
        drawn = self.draws(50 * number, seed)
        good = np.ones(len(drawn), bool)
        for path, column in zip(self.paths, drawn.T, strict=True):
            good &= (column > 0.0) & (column <= 1.0) if path == "interaction.r" else True
            good &= column >= 0.0 if path in _NEVER_NEGATIVE else True
        if good.sum() < number:
            raise ValueError("the law's errors are so wide that hardly any draw is a law: there are no bands")
        return drawn[good][:number]

    def draws(self, number: int, seed: int = 0) -> Float[np.ndarray, "draws parameters"]:
        """Return values drawn from the normal distribution of this covariance; of no parameters empty rows."""
        if not self.paths:
            return np.zeros((number, 0))
        return np.random.default_rng(seed).multivariate_normal(self.values, self.covariance, size=number)


def special_errors(found: Continuation, known: UncertainParameters) -> Float[np.ndarray, " special"]:
    """Return the standard error of the parameter at each special point.

    Args:
        found: of the scene with the known parameters' values.
        known: those parameters; if the one that was followed is among them, its own error does not count.
    """
    known = known.without(found.range.path)
    return np.array([_error(_sensitivity(found, point, known), known) for point in found.special])


def amplitude_errors(
    found: Continuation, branch: OrbitBranch, known: UncertainParameters
) -> Float[np.ndarray, " points"]:
    """Return the standard error of the peak amplitude in nm at each point of a branch, the parameter held.

    It grows without bound towards a fold, where the orbit of a held parameter ceases to exist.
    """
    known = known.without(found.range.path)
    frame, equations = _wide(found, known, None)
    share = (branch.parameter - found.range.low) / (found.range.high - found.range.low)
    points = np.column_stack([branch.unknowns, share, np.tile(known.values, (len(share), 1))])
    slope = in_blocks(lambda block: _amplitude_slopes(frame, block, equations), points, block=BLOCK, widths=())
    return np.sqrt(np.einsum("ni,ij,nj->n", slope, known.covariance, slope))


def _wide(found: Continuation, known: UncertainParameters, test: int | None) -> tuple[Frame, Equations]:
    """Return the same problem with the known parameters behind the followed one, each as it is."""
    zero, one = jnp.zeros(len(known.paths)), jnp.ones(len(known.paths))
    low, width = found.frame.low[:1], found.frame.width[:1]
    frame = found.frame._replace(low=jnp.concatenate([low, zero]), width=jnp.concatenate([width, one]))
    return frame, found.equations._replace(paths=(found.range.path, *known.paths), kind=test)


def _problem(
    found: Continuation, point: SpecialPoint, known: UncertainParameters
) -> tuple[Frame, Equations, Float[np.ndarray, " n"]]:
    frame, equations = _wide(found, known, point.test)
    share = (point.parameter - found.range.low) / (found.range.high - found.range.low)
    return frame, equations, np.concatenate([point.unknowns, [share], known.values])


def _sensitivity(found: Continuation, point: SpecialPoint, known: UncertainParameters) -> Float[np.ndarray, " p"]:
    """Return dp/da."""
    frame, equations, start = _problem(found, point, known)
    slope = np.asarray(_slopes_by_known(frame, jnp.asarray(start), equations))[-1]
    return slope * (found.range.high - found.range.low)


def _error(slope: np.ndarray, known: UncertainParameters) -> float:
    return float(np.sqrt(slope @ known.covariance @ slope))


@partial(jax.jit, static_argnames=("equations",))
def _slopes_by_known(frame: Frame, point: Array, equations: Equations) -> Float[Array, "n known"]:
    slopes = jax.jacfwd(lambda all_: equations_at(all_, frame, equations))(point)
    own = slopes.shape[0]
    return -jnp.linalg.solve(slopes[:, :own], slopes[:, own:])


@partial(jax.jit, static_argnames=("equations",))
def _amplitude_slopes(frame: Frame, points: Array, equations: Equations) -> Float[Array, "points known"]:
    known = len(equations.paths) - 1

    def one(point):
        count = point.shape[0] - 1 - known
        shares = point[count:]

        def at(unknowns, values):
            loop = loop_at(jnp.concatenate([shares[:1], values]), frame, equations)
            gaps = closing_gaps(unknowns, frame.scale, loop)
            return gaps, highest_point(unknowns, frame.scale, loop, equations.samples)

        (by_own, by_known), (top_by_own, top_by_known) = jax.jacfwd(at, argnums=(0, 1))(point[:count], shares[1:])
        return top_by_known - top_by_own @ jnp.linalg.solve(by_own, by_known)

    return jax.vmap(one)(points)
