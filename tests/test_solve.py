"""Numerics without physics: blocks of lanes, the hard few again, and points of curves of solutions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.solve.arclength import EquationsAt, point_in_plane
from afm_jax.solve.derivatives import largest
from afm_jax.solve.lanes import again_for, again_for_the_open, filled, in_blocks, map_in_blocks, power_of_two

VALUES = np.arange(1.0, 24.0)


def test_blocks_are_filled_up_with_the_last_row_and_few_sizes_serve_all():
    np.testing.assert_array_equal(filled(np.array([[1, 2], [3, 4]]), 4), [[1, 2], [3, 4], [3, 4], [3, 4]])
    assert [power_of_two(count) for count in (0, 1, 2, 3, 64, 65)] == [1, 1, 2, 4, 64, 128]
    assert power_of_two(3, least=16) == 16


@pytest.mark.parametrize(("count", "sizes"), [(1, {1}), (5, {8}), (16, {16}), (23, {16})])
def test_many_lanes_are_worked_on_in_blocks_of_one_size(count: int, sizes: set[int]):
    seen, told = [], []

    def work(lanes):
        seen.append(lanes["x"].shape[0])
        return {"sum": lanes["x"] + lanes["y"].sum(axis=1), "x64": jnp.asarray(1.0) * lanes["x"]}

    lanes = {"x": VALUES[:count], "y": np.ones((count, 3))}
    found = in_blocks(work, lanes, block=16, widths=(1, 8), report=lambda done, of: told.append((done, of)))
    np.testing.assert_array_equal(found["sum"], VALUES[:count] + 3.0)
    assert found["x64"].dtype == np.float64
    assert set(seen) == sizes
    assert told == ([(23, 23)] if count == 23 else [])


@pytest.mark.parametrize("recompute", [False, True])
def test_blocks_inside_a_program_have_values_and_both_derivatives(recompute: bool):  # noqa: FBT001
    def total(values, *, whole):
        lanes = (values, jnp.stack([values, values**2], axis=1))
        block = len(VALUES) if whole else 5
        first, second = map_in_blocks(
            lambda lane: (jnp.sin(lane[0]), lane[1] * 2.0), lanes, block=block, recompute=recompute
        )
        return jnp.sum(first * second[:, 1])

    expected = np.sum(2.0 * VALUES**2 * np.sin(VALUES))
    slope = 4.0 * VALUES * np.sin(VALUES) + 2.0 * VALUES**2 * np.cos(VALUES)
    for whole in (True, False):
        np.testing.assert_allclose(total(jnp.asarray(VALUES), whole=whole), expected, rtol=1e-14)
        np.testing.assert_allclose(jax.grad(total)(jnp.asarray(VALUES), whole=whole), slope, rtol=1e-13)


@pytest.mark.parametrize("block", [1, 4, 100])
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


def circle(point: np.ndarray) -> EquationsAt | None:
    """Return a circle of radius 2: it turns back in its last unknown at (0, 2)."""
    x, y = point
    return None if abs(x) > 3.0 else EquationsAt(np.array([x * x + y * y - 4.0]), np.array([[2.0 * x, 2.0 * y]]), x)


def test_a_curve_is_followed_round_its_fold():
    here, tangent = np.array([2.0, 0.0]), np.array([0.0, 1.0])
    length = 0.3
    turned = 0.0
    while turned < 2.0 * np.pi:
        found = point_in_plane(circle, here + length * tangent, tangent, arrived=1e-13, steps=12)
        assert found is not None
        assert found.point @ found.point == pytest.approx(4.0, rel=1e-14)
        # in the plane through the guess, at the angle whose tangent is length over radius
        assert (found.point - here) @ tangent == pytest.approx(length, rel=1e-13)
        turn = np.arcsin(length / 2.0)
        np.testing.assert_allclose(found.tangent, np.array([-found.point[1], found.point[0]]) / 2.0, atol=1e-14)
        assert found.facts == found.point[0]
        assert found.moved < 1e-13
        turned += turn
        np.testing.assert_allclose(found.point, 2.0 * np.array([np.cos(turned), np.sin(turned)]), atol=1e-12)
        here, tangent = found.point, found.tangent


def test_a_plane_without_a_point_of_the_curve_is_no_answer():
    aside = np.array([1.0, 0.0])
    assert point_in_plane(circle, np.array([3.5, 0.0]), aside, arrived=1e-13, steps=12) is None
    # Newton's method wanders where plane and circle do not meet: the move that is left says so
    missed = point_in_plane(circle, np.array([2.5, 0.1]), aside, arrived=1e-13, steps=12)
    assert missed is None or missed.moved > 1e-3
    # a normal along the equations' own gradient leaves the system singular
    flat = np.array([0.0, 1.0])
    assert point_in_plane(circle, np.array([0.0, 2.1]), flat, arrived=1e-13, steps=12) is None


def test_the_largest_value_has_the_slope_of_one_of_them():
    values = jnp.asarray([1.0, 4.0, 2.0, 4.0])
    assert largest(values) == 4.0
    np.testing.assert_array_equal(jax.grad(largest)(values), [0.0, 1.0, 0.0, 0.0])


@pytest.mark.slow
def test_slopes_of_a_contacts_table_do_not_hang_on_how_its_barrier_is_rounded():
    # the barrier is the largest of many energies: computed twice by an XLA told to hurry, none was the largest
    def table(humidity):
        return tabulated(Contact.paper(relative_humidity=humidity), jnp.asarray(1.0)).lowest

    def both(humidity):
        return jax.jvp(table, (humidity,), (jnp.asarray(1.0),))

    hurried = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}
    try:
        quick = jax.jit(both, compiler_options=hurried).lower(0.5).compile()
    except jax.errors.JaxRuntimeError:
        pytest.skip("this XLA does not know the options")
    for humidity in (0.499, 0.49975, 0.501):
        near = [float(quick(jnp.asarray(humidity + shift))[0]) for shift in (-1e-4, 1e-4)]
        assert float(quick(jnp.asarray(humidity))[1]) == pytest.approx((near[1] - near[0]) / 2e-4, rel=1e-5)
