"""Traced programs that outlive the process: found again, never the wrong one, and out of the way where none is kept."""

import re
import sys
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from afm_jax.cli import programs
from afm_jax.cli.programs import keep_programs
from afm_jax.impact.law import ImpactLaw
from tests.fresh_python import outputs

TRACED: list[float] = []


class Inner(eqx.Module):
    """A part of a result."""

    doubled: Array
    nothing: Array | None = None
    sure: bool = eqx.field(static=True, default=True)


class Outer(NamedTuple):
    """A result."""

    number: Array
    inner: Inner
    law: ImpactLaw
    pair: tuple[Array, Array]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "made_here", ModuleType("made_here"))
    TRACED.clear()
    (tmp_path / "kept").mkdir()
    return tmp_path / "kept"


def anew(folder: Path, said: list[str] | None = None) -> Any:
    """Return the program as the next process has it."""
    module: Any = sys.modules["made_here"]

    # a function of its own each time: JAX remembers what it has traced
    @partial(jax.jit, static_argnames="factor")
    def scaled_sum(pair, factor, values):
        TRACED.append(factor)
        law = jax.tree.map(lambda leaf: -factor * leaf, pair["law"])
        return Outer(factor * jnp.sum(values) + pair["law"].epsilon, Inner(2.0 * values), law, (values, -values))

    module.scaled_sum = scaled_sum
    said = [] if said is None else said
    keep_programs(["made_here:scaled_sum"], folder, said.append)
    return module.scaled_sum


def arguments(count: int = 3, epsilon: float = 0.0):
    return {"law": ImpactLaw(0.9, epsilon)}, 2.0, np.arange(1.0, count + 1.0)


def files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.program"))


def test_the_next_process_traces_nothing(folder):
    # twice the sum of 1, 2 and 3
    assert float(anew(folder)(*arguments()).number) == 12.0
    for _ in range(2):
        found = anew(folder)(*arguments(epsilon=5.0))
        assert isinstance(found.inner, Inner)
        np.testing.assert_array_equal(found.inner.doubled, [2.0, 4.0, 6.0])
        np.testing.assert_array_equal(found.pair[1], [-1.0, -2.0, -3.0])
        assert float(found.number) == 17.0
        # derivatives are laws that nobody could write
        assert float(found.law.r) == -1.8
        # what is no array of a result is kept, too
        assert (found.inner.sure, found.inner.nothing, found.law.delay) == (True, None, None)
    assert TRACED == [2.0]


def test_what_another_program_has_made_is_no_other_argument(folder):
    program, compiled = anew(folder), []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if event.endswith("backend_compile_duration") else None
    )
    try:
        pair, factor, values = arguments()
        made = program(pair, factor, values).pair[0]
        count = len(compiled)
        assert count > 0
        assert float(program(pair, factor, made).number) == 12.0
        assert len(compiled) == count
    finally:
        jax.monitoring.clear_event_listeners()


def test_another_shape_structure_or_static_argument_is_another_program(folder):
    program = anew(folder)
    pair, _, values = arguments()
    assert float(program(*arguments()).number) == 12.0
    assert float(program(*arguments(4)).number) == 20.0
    assert float(program(pair, 3.0, values).number) == 18.0
    assert float(program(pair, factor=3.0, values=values.reshape(1, 3)).number) == 18.0
    assert len(files(folder)) == 4
    # the same again, in another order
    assert float(anew(folder)(pair, 3.0, values).number) == 18.0
    assert float(anew(folder)(*arguments(4)).number) == 20.0
    assert len(TRACED) == 4


def test_programs_that_are_kept_already_are_not_kept_again(folder):
    # two functions of the same arguments, as of fits
    module: Any = sys.modules["made_here"]

    def doubled(x):
        return 2.0 * x

    def tripled(x):
        return 3.0 * x

    module.doubled, module.tripled = jax.jit(doubled), jax.jit(tripled)
    for _ in range(2):
        keep_programs(["made_here:doubled", "made_here:tripled"], folder, lambda _: None)
    assert float(module.doubled(np.ones(()))) == 2.0
    assert float(module.tripled(np.ones(()))) == 3.0
    assert [path.name.partition("-")[0] for path in files(folder)] == ["doubled", "tripled"]


@pytest.mark.parametrize("damage", [b"nonsense", b"", None])
def test_a_damaged_file_is_replaced_and_said(folder, damage):
    anew(folder)(*arguments())
    (path,) = files(folder)
    path.write_bytes(path.read_bytes()[:-1] if damage is None else damage)
    said: list[str] = []
    assert float(anew(folder, said)(*arguments()).number) == 12.0
    assert len(TRACED) == 2
    assert "traced and written" in said[0]
    assert float(anew(folder)(*arguments()).number) == 12.0
    assert len(TRACED) == 2


def test_a_file_that_cannot_be_written_costs_nothing_but_time(folder, monkeypatch):
    said: list[str] = []
    program = anew(folder, said)
    full = mock.Mock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr("afm_jax.cli.programs.write_whole", full)
    assert float(program(*arguments()).number) == 12.0
    assert said[0].endswith("cannot be written: No space left on device")


def test_other_sources_have_other_programs(folder, monkeypatch):
    source = folder.parent / "made_package" / "rooms" / "changed.py"
    source.parent.mkdir(parents=True)
    module = ModuleType("made_package")
    module.__file__ = str(source.parent.parent / "__init__.py")
    monkeypatch.setitem(sys.modules, "made_package", module)
    monkeypatch.setattr(programs, "_OURS", ("made_package",))
    for text, traced in (("1", 1), ("2", 2), ("2", 2), ("1", 2), ("3", 3)):
        source.write_text(text)
        # as the next process does
        programs._sources.cache_clear()
        anew(folder)(*arguments())
        assert len(TRACED) == traced
    programs._sources.cache_clear()


def test_inside_other_functions_it_is_the_function(folder):
    program = anew(folder)
    pair, factor, values = arguments()
    by_row = jax.vmap(lambda row: program(pair, factor, row).number)(np.stack([values, 2.0 * values]))
    np.testing.assert_array_equal(by_row, [12.0, 24.0])
    slope = jax.grad(lambda v: program(pair, factor, v).number)(jnp.asarray(values))
    np.testing.assert_array_equal(slope, np.full(3, 2.0))
    assert not files(folder)


COMMAND = "import sys\nsys.argv = ['afm-jax', *{}]\nfrom afm_jax.__main__ import run\nrun()"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform in {"win32", "darwin"}, reason="the cache folder is chosen by another variable")
def test_fits_find_their_programs_again_and_standard_error_holds_our_own_words_only(tmp_path):
    surroundings: dict[str, str | None] = {"XDG_CACHE_HOME": str(tmp_path), "TF_CPP_MIN_LOG_LEVEL": None}
    surroundings |= {"JAX_COMPILATION_CACHE_DIR": None, "JAX_ENABLE_COMPILATION_CACHE": None}
    fit = COMMAND.format(["fit", "--example", "--model", "law", "--json", "--verbose"])
    (first, _), (second, said_again) = (outputs(fit, surroundings) for _ in range(2))
    assert first == second
    # one line a program and processor with AVX-512 otherwise
    lines = said_again.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith(f"compiled programs: {tmp_path}")
    found = re.fullmatch(r"(?:afm-jax: )?(\d+) compiled programs were read, 0 were compiled", lines[1])
    assert found is not None
    # every operation outside a compiled program would be a program of its own, of 10 ms each: there were 78
    assert int(found[1]) <= 20
    # programs of a contact hold operations of a dialect that those of laws do without
    collide = COMMAND.format(["collide", "--speeds", "20,30", "--json"])
    assert outputs(collide, surroundings)[0] == outputs(collide, surroundings)[0]
