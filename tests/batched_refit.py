"""Many synthetic tables of one fit, each fitted, and densities of its posterior: for studies of coverage and ranks.

The fitted law is the truth: readings scatter about the fitted ones by the rows' covariances, and what is known
beforehand of an unknown, a measurement as well, about the fitted unknown.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from fitting.infer.explain import Explained
from fitting.infer.instantaneous import Chi2
from fitting.infer.search import Followed, descend
from fitting.infer.unknowns import _FACTORS


def noise_of(explained: Explained, sets: int, random: np.random.Generator) -> Float[np.ndarray, "sets rows 3"]:
    """Return noise of readings with the rows' covariances, 0 where nothing counts."""
    # zero rows and columns are those of what does not count
    root = np.linalg.pinv(explained.weights.whitening)
    return np.einsum("nij,snj->sni", root, random.normal(size=(sets, *explained.weights.used.shape)))


def with_data(
    explained: Explained, read: Float[np.ndarray, "rows 3"], mean: Float[np.ndarray, " k"], *, sharper: float = 1.0
) -> Explained:
    """Return a fit, not at its minimum, whose table has other readings, with errors over a number."""
    model = replace(explained.model, data=replace(explained.model.data, read=read))
    # it is computed when it is asked for first, and kept
    vars(model)["prior"] = mean, explained.model.prior[1]
    weights = explained.weights._replace(whitening=sharper * explained.weights.whitening)
    return replace(explained, model=model, weights=weights)


def refitted(explained: Explained) -> Explained:
    """Return the minimum for a table's readings, from the fit of another one, by the same weights."""
    law: Any = explained.model.law
    if law.lasting:
        end = descend(explained.model, explained.end.theta, explained.end.orbits, explained.weights)
        return replace(explained, end=end)
    chi2 = Chi2(explained.model, explained.weights)
    return chi2.explained(chi2.descended(explained.end.theta))


def chi2_of(explained: Explained, theta: Float[np.ndarray, "draws k"]) -> Float[np.ndarray, " draws"]:
    """Return chi2 at unknowns; infinite where a row has lost its orbit."""
    law: Any = explained.model.law
    if law.lasting:
        rows = Followed(explained.model, explained.end.theta, explained.end.orbits, explained.weights, np.inf)
        return np.array([rows.sum(one).value for one in theta])
    chi2 = Chi2(explained.model, explained.weights)
    return np.array([np.sum(chi2.at(one)[1] ** 2) for one in theta])


def readings_of(explained: Explained, theta: Float[np.ndarray, "draws k"]) -> Float[np.ndarray, "draws rows 3"]:
    """Return what unknowns predict without noise; NaN of a row without an orbit where impacts last."""
    model = explained.model
    law: Any = model.law
    if law.lasting:
        found = [model.follow(one, explained.end.orbits.x) for one in theta]
        return np.array([np.where(one.closes[:, None], one.readings, np.nan) for one in found])
    chi2 = Chi2(model, explained.weights)
    return np.array([chi2.at(one)[0].orbits.readings for one in theta])


def unknowns_of(explained: Explained, values: Float[np.ndarray, "draws p"]) -> Float[np.ndarray, "draws p"]:
    """Return the unknowns of an instantaneous law and of the instrument for values of the printed parameters."""
    law: Any = explained.model.law
    own = [law.unknown_of(name, column) for name, column in zip(law.names, values.T, strict=False)]
    for quantity, column in zip(explained.model.instrument, values.T[len(own) :], strict=True):
        off = np.log(column / quantity.value) * quantity.value if quantity.kind in _FACTORS else column - quantity.value
        own.append(off / quantity.error)
    return np.stack(own, axis=1)
