"""The law at approach speeds with its errors, formulas of laws, and the formula that is closest to a law."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from afm_jax.solve.least_squares import Sum, levenberg_marquardt
from afm_jax.units import TWO_SIDED_95


class LawWithErrors(NamedTuple):
    """Rebound speeds in nm/us and delays in us, capture speed, and how they change with unknowns of unit variance."""

    law: Float[np.ndarray, "2 n"]
    factor: Float[np.ndarray, "2 n m"]
    capture: float
    capture_factor: Float[np.ndarray, " m"]


AtSpeeds = Callable[[Float[np.ndarray, " n"]], LawWithErrors]
"""A law with its errors, of approach speeds in nm/us."""


LAW_POINTS, _FEWEST_POINTS = 121, 4


def points_of_law(
    law: AtSpeeds, approach_speeds: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, " points"], LawWithErrors]:
    """Return a law from 0.8 times the slowest to 1.2 times the fastest approach in nm/us, and beyond its capture.

    Args:
        law: with its errors.
        approach_speeds: of the rows, NaN where a row has none.
    """
    slow, fast = speed_range(approach_speeds)
    speeds = np.geomspace(0.8 * slow, 1.2 * fast, LAW_POINTS)
    points = law(speeds)
    if np.count_nonzero(points.law[0] > 0.0) < _FEWEST_POINTS:
        # a law that captures nearly all of these tips
        speeds = np.geomspace(0.8 * slow, 3.0 * max(points.capture, fast), LAW_POINTS)
        points = law(speeds)
    return speeds, points


def speed_range(approach_speeds: Float[np.ndarray, " rows"]) -> tuple[float, float]:
    """Return slowest and fastest of the known speeds; 1.25 and 83 nm/us where there is none."""
    known = approach_speeds[np.isfinite(approach_speeds)]
    return (float(known.min()), float(known.max())) if known.size else (1.25, 250.0 / 3.0)


def containing(one: LawWithErrors, other: LawWithErrors) -> LawWithErrors:
    """Return a law with errors so large that its 95 % band holds that of another law too."""

    def widened(value, factor, far, spread):
        """Return a factor that reaches as far as the other one's."""
        own, theirs = np.linalg.norm(factor, axis=-1), np.linalg.norm(spread, axis=-1)
        wanted = np.abs(far - value) / TWO_SIDED_95 + theirs
        grown = np.where(own > 0.0, np.maximum(wanted / np.where(own > 0.0, own, 1.0), 1.0), 1.0)
        return factor * grown[..., None]

    return one._replace(
        factor=widened(one.law, one.factor, other.law, other.factor),
        capture_factor=widened(one.capture, one.capture_factor, other.capture, other.capture_factor),
    )


def square_by_formula(values: Mapping[str, float], speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return u_out^2 of the formula of a law's parameters at approach speeds in nm/us; not positive: captured."""
    square = (values.get("r", 1.0) * speeds) ** 2 - values.get("viscous_loss", 0.0) * speeds
    return square - values.get("epsilon", 0.0)


def rebound_by_formula(values: Mapping[str, float], speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return u_out of the formula of a law's parameters at approach speeds in nm/us; 0 where the tip is captured."""
    return np.sqrt(np.maximum(square_by_formula(values, speeds), 0.0))


DELAY_TERMS: Mapping[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "delay_hertz": lambda u, w: u**-0.2,  # noqa: ARG005
    "delay_lead_nm": lambda u, w: 1.0 / u - 1.0 / w,
    "delay_offset_nm": lambda u, w: -1.0 / u,  # noqa: ARG005
}
"""What the parameters of a delay stand before, by approach and rebound speed in nm/us."""


def delay_by_formula(
    values: Mapping[str, float], speeds: Float[np.ndarray, " n"], rebound: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return the delay in us of the formula of a law's parameters at approach and rebound speeds in nm/us."""
    return np.sum([values.get(name, 0.0) * term(speeds, rebound) for name, term in DELAY_TERMS.items()], axis=0)


_POWERS = {"r": 2, "viscous_loss": 1, "epsilon": 0}
"""Powers of the speed: u_in^2 - u_out^2 = (1 - r^2) u^2 + c u + epsilon, each term a loss."""


def closest_loss(
    family: Sequence[str],
    speeds: Float[np.ndarray, " n"],
    rebound: Float[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
    known: Mapping[str, float],
) -> dict[str, float]:
    """Return the parameters of the formula closest to a law, as u_out is to be close; no loss is negative.

    Least squares in u_out, from those in u_out^2, which is linear in the terms of the loss. Where the formula captures
    the rebound speed is 0, however far beyond its capture speed that lies.

    Args:
        family: of r, viscous_loss and epsilon those that are looked for.
        speeds: approach speeds in nm/us.
        rebound: of the law, all positive.
        weight: of each.
        known: values of others of them.
    """
    if not family:
        return {}
    columns = np.stack([speeds ** _POWERS[name] for name in family], axis=1)
    lossless = square_by_formula({name: value for name, value in known.items() if name not in family}, speeds)

    def evaluate(terms: Float[np.ndarray, " k"]) -> Sum:
        square = lossless - columns @ terms
        leaves = square > 0.0
        w = np.sqrt(np.where(leaves, square, 1.0))
        residual = weight * (np.where(leaves, w, 0.0) - rebound)
        return Sum(float(residual @ residual), residual, np.where(leaves, -0.5 * weight / w, 0.0)[:, None] * columns)

    steep = 0.5 * weight / rebound
    slope = steep[:, None] * columns
    scale, ends = np.linalg.norm(slope, axis=0), np.tile([0.0, np.inf], (len(family), 1))
    start = bounded(steep * (rebound**2 - lossless), slope / scale, ends) / scale
    terms = levenberg_marquardt(evaluate, start, settled=0.0, most=_STEPS, lowest=0.0).place
    found = zip(family, terms.tolist(), strict=True)
    return {name: max(1.0 - term, 0.0) ** 0.5 if name == "r" else term for name, term in found}


_STEPS = 50
"""Steps to the closest formula at most, which goes to the last digit."""


def root_of(covariance: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    """Return a matrix whose product with its transpose is the covariance; NaN where that is not finite."""
    if not np.all(np.isfinite(covariance)):
        return np.full_like(covariance, np.nan)
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    safe = np.where(error > 0.0, error, 1.0)
    variance, axes = np.linalg.eigh(covariance / np.outer(safe, safe))
    return error[:, None] * axes * np.sqrt(np.maximum(variance, 0.0))


def bounded(
    residual: Float[np.ndarray, " n"], slope: Float[np.ndarray, "n k"], ends: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, " k"]:
    """Return the solution of least squares between bounds: what would leave its range is held at the end.

    Args:
        residual: where all values are 0.
        slope: its derivatives.
        ends: lowest and highest value of each.
    """
    values, moving = np.zeros(len(ends)), np.ones(len(ends), dtype=bool)
    for _ in range(len(ends)):
        held = residual + slope[:, ~moving] @ values[~moving]
        values[moving] = np.linalg.lstsq(slope[:, moving], -held, rcond=None)[0]
        out = moving & ((values < ends[:, 0]) | (values > ends[:, 1]))
        if not out.any():
            break
        values[out] = np.clip(values, ends[:, 0], ends[:, 1])[out]
        moving &= ~out
    return values
