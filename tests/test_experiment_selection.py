"""Choosing points by their information: against exhaustive search and plain matrix algebra."""

import itertools

import numpy as np
import pytest

from fitting.experiments.candidates import standard_errors
from fitting.experiments.design import choose_points


def informations(design: np.ndarray) -> np.ndarray:
    """Return the information of each row of a linear model y = design @ parameters with unit errors."""
    return np.einsum("np,nq->npq", design, design)


def plain_score(information: np.ndarray, matters: np.ndarray) -> float:
    """Return the criterion from the covariance itself, without ridge: the other way round than the code."""
    return -float(np.log(np.linalg.det(np.linalg.inv(information)[np.ix_(matters, matters)])))


@pytest.mark.parametrize("matters", [(0, 1, 2), (0, 2), (1,)])
@pytest.mark.parametrize("seed", range(4))
def test_four_of_eleven_taken_one_after_another_are_nearly_the_best_choice(matters, seed):
    random = np.random.default_rng(seed)
    each = informations(random.normal(size=(11, 3)) * [1.0, 0.1, 5.0])
    prior = np.diag([0.0, 3.0, 0.0])
    mask = np.isin(np.arange(3), matters)
    chosen = choose_points(prior, each, 4, mask)
    assert len(set(chosen.tolist())) == 4
    best = max(plain_score(prior + each[list(some)].sum(axis=0), mask) for some in itertools.combinations(range(11), 4))
    # points are taken one after another: the best choice in most of these cases, the variance 1.1 % larger at worst
    assert plain_score(prior + each[chosen].sum(axis=0), mask) > best - 0.02


@pytest.mark.parametrize("matters", [(0, 1), (0,)])
def test_points_come_in_the_order_of_their_use(matters):
    each = informations(np.random.default_rng(5).normal(size=(30, 2)))
    prior, mask = np.eye(2), np.isin(np.arange(2), matters)
    chosen = choose_points(prior, each, 6, mask)
    for step in range(5):
        known = prior + each[chosen[:step]].sum(axis=0)
        gains = [plain_score(known + each[point], mask) for point in chosen[step:]]
        assert np.argmax(gains) == 0


def test_standard_errors_are_those_of_the_inverse():
    design = np.random.default_rng(7).normal(size=(9, 4)) * [1.0, 1e-6, 1e4, 1.0]
    information = design.T @ design
    wanted = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    # the units differ by ten orders: the plain inverse itself has lost some digits
    np.testing.assert_allclose(standard_errors(information), wanted, rtol=1e-6)


def test_what_is_not_determined_has_no_error_and_spoils_no_other():
    # the first two parameters act only as their sum
    design = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 2.0], [3.0, 3.0, 1.0]])
    errors = standard_errors(design.T @ design)
    assert np.isinf(errors[:2]).all()
    alone = np.linalg.inv(design[:, 1:].T @ design[:, 1:])
    np.testing.assert_allclose(errors[2], np.sqrt(alone[1, 1]), rtol=1e-9)
    assert np.isinf(standard_errors(np.diag([4.0, 0.0]))[1])
