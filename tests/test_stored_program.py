"""Programs that outlive the process: found again, never the wrong one, and out of the way where nothing is kept."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.impact.law import ImpactLaw
from afm_jax.stored_program import StoredProgram, keep_programs
from tests.fresh_python import python

TRACED: list[float] = []


def scaled_sum(pair, factor, values):
    # runs only while it is traced
    TRACED.append(factor)
    return {"law": pair["law"], "number": factor * jnp.sum(values) + pair["law"].epsilon}


@pytest.fixture
def folder(tmp_path):
    keep_programs(tmp_path)
    TRACED.clear()
    yield tmp_path
    keep_programs(None)


def arguments(count: int = 3, epsilon: float = 0.0):
    return {"law": ImpactLaw(0.9, epsilon)}, 2.0, np.arange(1.0, count + 1.0)


def files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.program"))


def anew() -> StoredProgram:
    """Return the program as the next process has it."""
    return StoredProgram(scaled_sum, "factor")


@pytest.mark.usefixtures("folder")
def test_the_next_process_traces_nothing():
    # twice the sum of 1, 2 and 3
    assert float(anew()(*arguments())["number"]) == 12.0
    assert TRACED == [2.0]
    found = anew()(*arguments(epsilon=5.0))
    assert isinstance(found["law"], ImpactLaw)
    assert float(found["law"].r) == 0.9
    assert float(found["number"]) == 17.0
    assert TRACED == [2.0]


def test_another_shape_structure_or_static_argument_is_another_program(folder):
    program = anew()
    assert float(program(*arguments())["number"]) == 12.0
    assert float(program(*arguments(4))["number"]) == 20.0
    pair, _, values = arguments()
    assert float(program(pair, 3.0, values)["number"]) == 18.0
    assert float(program(pair, 3.0, values.reshape(1, 3))["number"]) == 18.0
    assert len(files(folder)) == 4
    # the same four again, in another order
    assert float(anew()(pair, 3.0, values)["number"]) == 18.0
    assert float(anew()(*arguments(4))["number"]) == 20.0
    assert len(TRACED) == 4


def test_a_damaged_file_is_traced_again(folder):
    anew()(*arguments())
    (path,) = files(folder)
    path.write_bytes(b"nonsense")
    assert float(anew()(*arguments())["number"]) == 12.0
    assert len(TRACED) == 2


def test_a_folder_that_cannot_be_written_costs_nothing_but_time(folder):
    keep_programs(folder / "file" / "below")
    (folder / "file").write_text("no folder")
    assert float(anew()(*arguments())["number"]) == 12.0
    assert not files(folder)


def test_other_sources_have_other_programs(folder, monkeypatch):
    anew()(*arguments())
    for version in "abcdefg":
        monkeypatch.setattr("afm_jax.stored_program._sources", lambda version=version: version)
        anew()(*arguments())
    assert len(TRACED) == 8
    # the oldest are forgotten
    assert len(list(folder.iterdir())) <= 5


def test_inside_other_functions_it_is_the_function(folder):
    program = anew()
    pair, factor, values = arguments()
    by_row = jax.vmap(lambda row: program(pair, factor, row)["number"])(np.stack([values, 2.0 * values]))
    np.testing.assert_array_equal(by_row, [12.0, 24.0])
    slope = jax.grad(lambda v: program(pair, factor, v)["number"])(jnp.asarray(values))
    np.testing.assert_array_equal(slope, np.full(3, 2.0))
    assert not files(folder)


def test_without_a_folder_nothing_is_written(folder):
    keep_programs(None)
    assert float(anew()(*arguments())["number"]) == 12.0
    assert not files(folder)


def test_a_function_that_calls_back_is_only_jitted(folder):
    def shown(values):
        return jax.pure_callback(np.cumsum, jax.ShapeDtypeStruct(values.shape, values.dtype), values)

    np.testing.assert_array_equal(StoredProgram(shown)(np.ones(3)), [1.0, 2.0, 3.0])
    assert not files(folder)


SOLVE = """
import os
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np
from afm_jax.stored_program import StoredProgram, keep_programs
jax.config.update("jax_enable_x64", True)
keep_programs(Path(os.environ["KEPT_IN"]))
def solved(matrix, right):
    print("traced")
    return jnp.linalg.solve(matrix, right)
print(StoredProgram(solved)(np.diag([1.0, 2.0, 4.0]), np.ones(3)).tolist())
"""


def test_a_new_process_finds_lapack_without_a_trace(tmp_path):
    first = python(SOLVE, KEPT_IN=str(tmp_path))
    assert first.splitlines() == ["traced", "[1.0, 0.5, 0.25]"]
    assert python(SOLVE, KEPT_IN=str(tmp_path)).splitlines() == ["[1.0, 0.5, 0.25]"]


class Doubled(eqx.Module):
    """Somebody's own class, whose sources are not looked at."""

    def __call__(self, values):
        """Return twice the values."""
        return 2.0 * values


def test_what_other_peoples_classes_compute_is_not_kept(folder):
    def applied(rule, values):
        return rule(values)

    np.testing.assert_array_equal(StoredProgram(applied)(Doubled(), np.ones(3)), [2.0, 2.0, 2.0])
    assert not files(folder)
