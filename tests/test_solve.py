"""Numerics without physics: lanes in blocks and again, roots, points of curves, quadrature, derivatives by rules."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from afm_jax.solve.arclength import EquationsAt, point_in_plane
from afm_jax.solve.derivatives import absent, by_tangents, halved, implicit_root, largest, recomputed
from afm_jax.solve.lanes import again_for, again_for_the_open, in_blocks, map_in_blocks, power_of_two
from afm_jax.solve.newton import newton
from afm_jax.solve.newton_rows import LinearisedRows, Newton, newton_rows
from afm_jax.solve.quadrature import gauss_nodes, mean_matrix, series_tail

VALUES = np.arange(1.0, 24.0)


@pytest.mark.parametrize(("count", "sizes"), [(1, {1}), (5, {8}), (16, {16}), (23, {16})])
def test_many_lanes_are_worked_on_in_blocks_of_one_size(count: int, sizes: set[int]):
    seen, told = [], []

    def work(lanes):
        seen.append(lanes["x"].shape[0])
        return {"sum": lanes["x"] + lanes["y"].sum(axis=1), "x64": jnp.asarray(1.0) * lanes["x"]}

    lanes = {"x": VALUES[:count], "y": np.ones((count, 3))}
    found = in_blocks(work, lanes, widths=(1, 8, 16), report=lambda done, of: told.append((done, of)))
    np.testing.assert_array_equal(found["sum"], VALUES[:count] + 3.0)
    assert found["x64"].dtype == np.float64
    assert set(seen) == sizes
    assert told == ([(23, 23)] if count == 23 else [])
    assert power_of_two(count) == {1: 1, 5: 8, 16: 16, 23: 32}[count]


@pytest.mark.parametrize("recompute", [False, True])
def test_blocks_inside_a_program_have_values_and_both_derivatives(recompute: bool):  # noqa: FBT001
    def total(values, block):
        lanes = (values, jnp.stack([values, values**2], axis=1))
        work = map_in_blocks(lambda one: (jnp.sin(one[0]), one[1] * 2.0), lanes, block=block, recompute=recompute)
        return jnp.sum(work[0] * work[1][:, 1])

    expected = np.sum(2.0 * VALUES**2 * np.sin(VALUES))
    slope = 4.0 * VALUES * np.sin(VALUES) + 2.0 * VALUES**2 * np.cos(VALUES)
    for block in (len(VALUES), 5):
        np.testing.assert_allclose(total(jnp.asarray(VALUES), block), expected, rtol=1e-14)
        np.testing.assert_allclose(jax.grad(total)(jnp.asarray(VALUES), block), slope, rtol=1e-13)


@pytest.mark.parametrize("block", [4, 100])
def test_only_lanes_in_need_are_computed_again(block: int):
    seen = []

    def square(value, shift):
        jax.debug.callback(lambda some: seen.append(np.asarray(some)), value)
        return value**2 + shift

    needed = jnp.asarray(VALUES % 3.0 == 0.0)
    before = jnp.full(len(VALUES), -1.0)
    found = jax.jit(lambda *given: again_for(square, needed, given, before, block=block))(VALUES, 10.0 * VALUES)
    expected = np.where(VALUES % 3.0 == 0.0, VALUES**2 + 10.0 * VALUES, -1.0)
    np.testing.assert_array_equal(found, expected)
    jax.effects_barrier()
    # seven lanes: what a block lacks is a copy of the last lane of all
    assert len(seen) == -(-7 // min(block, len(VALUES)))
    assert set(np.concatenate(seen)) <= {*VALUES[np.asarray(needed)], VALUES[-1]}
    values = jnp.asarray(VALUES)
    nobody = again_for(square, jnp.zeros(len(VALUES), bool), (values, values), before, block=block)
    np.testing.assert_array_equal(nobody, before)


def test_open_lanes_are_computed_again_whether_numbers_are_known_or_not():
    settled = VALUES < 20.0

    def careful(shared, values):
        return {"found": shared * values}

    quick = {"found": jnp.zeros(len(VALUES))}

    def both(factor):
        return again_for_the_open(careful, jnp.asarray(settled), (factor, jnp.asarray(VALUES)), quick)["found"]

    expected = np.where(settled, 0.0, 3.0 * VALUES)
    np.testing.assert_array_equal(both(jnp.asarray(3.0)), expected)
    np.testing.assert_array_equal(jax.jit(both)(jnp.asarray(3.0)), expected)
    assert jax.grad(lambda factor: jnp.sum(both(factor)))(jnp.asarray(3.0)) == pytest.approx(20.0 + 21.0 + 22.0 + 23.0)
    nothing = again_for_the_open(careful, jnp.ones(3, bool), (jnp.asarray(1.0), jnp.ones(3)), {"found": jnp.ones(3)})
    np.testing.assert_array_equal(nothing["found"], 1.0)


def coupled(x, p):
    """Return three equations with one root near (1, 0.1, 0.1) for p near (1.1, 2)."""
    return jnp.stack([x[0] ** 3 + x[1] - p[0], jnp.exp(x[1]) - x[0] * x[2] - 0.5 * p[1], x[2] * (1.0 + x[0]) - x[1]])


def pair(x, p):
    return jnp.stack([x[0] * x[1] - 0.5 * p[0], x[0] ** 2 + x[1] - p[1]])


EXACT = Newton(rounds=30, step_tolerance=1e-12, residual_tolerance=1e-13)


@pytest.mark.parametrize(("equations", "guess"), [(coupled, [1.0, 0.5, 0.5]), (pair, [1.3, 0.5])], ids=["three", "two"])
def test_newton_finds_scipys_root_with_the_derivatives_of_differences(equations, guess):
    @jax.jit
    def root(p):
        return newton(equations, jnp.asarray(guess), p, EXACT)

    def by_scipy(p):
        return optimize.root(lambda x: np.asarray(equations(x, p)), guess, tol=1e-14).x

    p, direction = jnp.asarray([1.2, 2.1]), jnp.asarray([0.6, -0.8])
    np.testing.assert_allclose(root(p).x, by_scipy(p), rtol=1e-12)
    difference = (by_scipy(p + 1e-5 * direction) - by_scipy(p - 1e-5 * direction)) / 2e-5
    np.testing.assert_allclose(jax.jvp(lambda p: root(p).x, (p,), (direction,))[1], difference, rtol=1e-7)
    np.testing.assert_allclose(jax.jacrev(lambda p: root(p).x)(p) @ direction, difference, rtol=1e-7)
    several = jnp.stack([p, p + 0.1, p - 0.1])
    alone = np.stack([root(each).x for each in several])
    np.testing.assert_allclose(jax.vmap(root)(several).x, alone, rtol=1e-14)


def test_slots_end_one_by_one_within_their_domain():
    def logarithm(x, p):
        return jnp.log(x) - p

    def roots(p, settings):
        def one(guess, p, where):
            return newton(logarithm, guess[None], p, settings, where=where)

        return jax.vmap(one)(jnp.asarray([5.0, 1.0, 0.1, 2.0]), p, jnp.asarray([True, True, True, False]))

    limited = EXACT._replace(damping=lambda x, step: jnp.maximum(step, -0.7 * x), unit=lambda x: x)
    p = jnp.asarray([0.0, 0.0, 1.5, -2.0])
    assert np.isinf(roots(p, limited).residual[:, 0]).tolist() == [False] * 3 + [True]
    np.testing.assert_allclose(roots(p, limited).x[:3, 0], np.exp([0.0, 0.0, 1.5]), rtol=1e-14)
    assert roots(p, limited).x[3, 0] == 2.0
    # x - x ln(x) < 0 from 5: the full step leaves the domain of the logarithm
    assert np.isnan(roots(p, EXACT).residual[0, 0])
    slopes = jax.jacobian(lambda p: roots(p, limited).x[:, 0])(p)
    np.testing.assert_allclose(slopes[:3, :3], np.diag(np.exp(p[:3])), rtol=1e-13)


def arctangents(seen=None):
    def linearised(x, rows):
        if seen is not None:
            seen.append(rows.tolist())
        residual = np.where(np.abs(x) < 50.0, np.arctan(x), np.nan)
        return LinearisedRows(residual, (1.0 / (1.0 + x**2))[:, :, None], [f"row {row}" for row in rows])

    return linearised


def test_rows_are_solved_each_on_its_own():
    seen, rows = [], np.array([[0.0], [1.0], [3.0], [60.0]])
    roots = newton_rows(arctangents(seen), rows, EXACT)
    assert roots.converged.tolist() == [True, True, False, False]
    np.testing.assert_allclose(roots.x[:2], 0.0, atol=1e-15)
    assert roots.details[:2] == ["row 0", "row 1"]
    # 60 has no value, 0 is a root, 3 flies away (3 -> -9.5 -> 124), 1 goes on alone
    assert seen[:3] == [[0, 1, 2, 3], [1, 2], [1, 2]]
    assert seen[3:] == [[1]] * (len(seen) - 3)
    # x^2 is small long before its root is near: each step halves the distance
    double = newton_rows(lambda x, _: LinearisedRows(x**2, (2.0 * x)[:, :, None]), np.ones((1, 1)), EXACT)
    assert not double.converged.any()
    assert double.x[0, 0] == pytest.approx(0.5**30, rel=1e-12)


def circle(point: np.ndarray) -> EquationsAt | None:
    """Return a circle of radius 2: it turns back in its last unknown at (0, 2)."""
    x, y = point
    return None if abs(x) > 3.0 else EquationsAt(np.array([x * x + y * y - 4.0]), np.array([[2.0 * x, 2.0 * y]]), x)


def test_a_curve_is_followed_round_its_fold():
    here, tangent = np.array([2.0, 0.0]), np.array([0.0, 1.0])
    length = 0.3
    turned = 0.0
    while turned < 2.0 * np.pi:
        step = point_in_plane(circle, here + length * tangent, tangent)
        assert step is not None
        assert step.x @ step.x == pytest.approx(4.0, rel=1e-14)
        # in the plane through the guess, at the angle whose tangent is length over radius
        assert (step.x - here) @ tangent == pytest.approx(length, rel=1e-13)
        np.testing.assert_allclose(step.tangent, np.array([-step.x[1], step.x[0]]) / 2.0, atol=1e-9)
        assert step.details == pytest.approx(step.x[0], abs=1e-9)
        turned += np.arcsin(length / 2.0)
        np.testing.assert_allclose(step.x, 2.0 * np.array([np.cos(turned), np.sin(turned)]), atol=1e-8)
        here, tangent = step.x, step.tangent


def test_the_largest_value_has_the_slope_of_one_of_them():
    values = jnp.asarray([1.0, 4.0, 2.0, 4.0])
    assert largest(values) == 4.0
    np.testing.assert_array_equal(jax.grad(largest)(values), [0.0, 1.0, 0.0, 0.0])


def waves(shared, lanes, power):
    found = {"wave": jnp.sin(shared * lanes) ** power, "sign": jnp.sign(lanes).astype(jnp.int32)}
    return found, jnp.ones(lanes.shape, bool)


@pytest.mark.parametrize("small", [True, False])
def test_derivatives_of_a_batch_are_found_forward_and_transposed(small: bool):  # noqa: FBT001
    shared, lanes = jnp.asarray(0.3), jnp.asarray([0.5, 2.0, -1.0])

    def wave(shared, lanes):
        return by_tangents(waves, shared, lanes, small=small, settings=(2,))["wave"]

    slope = 2.0 * np.sin(0.3 * lanes) * np.cos(0.3 * lanes)
    along = jax.jvp(wave, (shared, lanes), (jnp.asarray(1.0), jnp.asarray([1.0, 0.0, 2.0])))[1]
    np.testing.assert_allclose(along, slope * (lanes + 0.3 * np.array([1.0, 0.0, 2.0])), rtol=1e-14)
    backwards = jax.grad(lambda *given: jnp.sum(wave(*given) * jnp.arange(3.0)), argnums=(0, 1))(shared, lanes)
    np.testing.assert_allclose(backwards[0], np.sum(np.arange(3.0) * slope * lanes), rtol=1e-14)
    np.testing.assert_allclose(backwards[1], np.arange(3.0) * slope * 0.3, rtol=1e-14)
    # second derivatives, and examples side by side
    curvature = jax.vmap(jax.hessian(lambda shared: jnp.sum(wave(shared, lanes))))(jnp.asarray([0.3, 0.7]))
    expected = [np.sum(2.0 * lanes**2 * np.cos(2.0 * at * lanes)) for at in (0.3, 0.7)]
    np.testing.assert_allclose(curvature, expected, rtol=1e-13)


@pytest.mark.parametrize("how", [recomputed, lambda work: work])
def test_reverse_mode_computes_work_again_from_roots_and_arguments_alone(how):
    def one_root(square: jax.Array, _: None) -> tuple[jax.Array, None]:
        low = halved(lambda x: x * x < square, 0.0 * square, square + 1.0, rounds=60)[0]
        root = implicit_root(lambda x, square: x * x - square, low, square)
        return jnp.exp(jnp.log(jnp.tan(jnp.arctan(root)))), None

    value, pullback = jax.vjp(lambda square: jax.lax.scan(how(one_root), square, length=5)[0], jnp.asarray(3.0))
    np.testing.assert_allclose(value, 3.0 ** (1.0 / 32.0), rtol=1e-13)
    np.testing.assert_allclose(pullback(jnp.asarray(1.0))[0], 3.0 ** (1.0 / 32.0 - 1.0) / 32.0, rtol=1e-12)
    # what the forward pass leaves: the root and the argument of each step
    left = sum(np.size(leaf) for leaf in jax.tree.leaves(pullback) if jnp.issubdtype(leaf.dtype, jnp.floating))
    assert (left <= 11) == (how is recomputed)
    # the way back goes through the steps once, and searches nothing
    backwards = str(jax.make_jaxpr(pullback)(jnp.asarray(1.0)))
    assert [backwards.count(loop) for loop in ("scan[", "while[")] == [1, 0]


def test_an_absent_number_has_an_absent_derivative_where_it_is_asked_for():
    def both(x):
        return jnp.stack([absent(x), x**2])

    np.testing.assert_array_equal(both(jnp.asarray(3.0)), [np.nan, 9.0])
    np.testing.assert_array_equal(jax.jacfwd(both)(jnp.asarray(3.0)), [np.nan, 6.0])
    assert jax.grad(lambda x: both(x)[1])(jnp.asarray(3.0)) == 6.0
    assert np.isnan(jax.grad(lambda x: both(x)[0])(jnp.asarray(3.0)))


def test_an_interval_is_halved_down_to_rounding_in_either_direction():
    for low, high in ((1.0, 2.0), (2.0, 1.0)):
        ends = halved(lambda x, low=low: (x**2 < 2.0) == (low < 1.5), jnp.asarray(low), jnp.asarray(high), rounds=60)
        np.testing.assert_allclose(ends, np.sqrt(2.0), rtol=1e-15)


def test_quadrature_of_polynomials_is_exact():
    points, weights, cumulative = gauss_nodes(5)
    for degree in range(10):
        assert weights @ points**degree == pytest.approx(1.0 / (degree + 1.0), rel=1e-14)
    for degree in range(5):
        integral = points ** (degree + 1) / (degree + 1.0)
        np.testing.assert_allclose(cumulative @ points**degree, integral, rtol=1e-13, atol=1e-15)
        # (1/y^2) int_0^y t^n 2 t dt
        mean = 2.0 / (degree + 2.0) * np.append(points, 1.0) ** degree
        np.testing.assert_allclose(mean_matrix(5) @ points**degree, mean, rtol=1e-13, atol=1e-14)
    # P_4 of 2 x - 1 begins with 70 x^4
    assert float(series_tail(jnp.asarray(points**3))) == pytest.approx(1.0 / 20.0, rel=1e-13)
    assert float(series_tail(jnp.asarray(70.0 * points**4 - 140.0 * points**3))) == pytest.approx(1.0, rel=1e-12)
