"""What all tests share: 64-bit floats, strict promotion, and annotations that are checked at run time."""

import ctypes
import gc
import os
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import coverage
import hypothesis
import jax
import jaxtyping
import pytest

# Before the packages are imported for the first time: every annotated function checks its arguments and results.
jaxtyping.install_import_hook(["afm_jax", "fitting"], "beartype.beartype")

MOST_CHECKED = 20
"""Definitions of a function within another that are checked: each costs half a millisecond, whatever the function."""
_jaxtyped, _definitions = jaxtyping.jaxtyped, Counter()


def _checked(*, typechecker: Callable) -> Callable:
    """Return the decorator of the import hook, which functions that are defined over and over do not get."""

    def decorate(function: Callable) -> Callable:
        if "<locals>" in getattr(function, "__qualname__", ""):
            code = getattr(function, "__code__", function)
            _definitions[code] += 1
            if _definitions[code] > MOST_CHECKED:
                return function
        return _jaxtyped(function, typechecker=typechecker)

    return decorate


jaxtyping.jaxtyped = _checked

from afm_jax.compilation_cache import processor_key, silence_xla  # noqa: E402

jax.config.update("jax_enable_x64", True)  # noqa: FBT003
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Compilation is what a JAX test costs; a second run finds it done.
silence_xla()
jax.config.update(
    # machine code: a folder that is taken along to another kind of processor is not read there
    "jax_compilation_cache_dir",
    str(Path(__file__).parent.parent / ".pytest_cache" / f"jax-{processor_key()}"),
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)

# Tracing makes many short-lived objects beside the many that live as long as their programs: looking through all of
# these again and again costs more than it frees.
gc.set_threshold(50_000, 20, 50)

# The same examples on every run: a failure is then a change of the code. HYPOTHESIS_PROFILE=random rolls new ones.
hypothesis.settings.register_profile("repeatable", derandomize=True, database=None, print_blob=True, deadline=None)
hypothesis.settings.register_profile("random", print_blob=True)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write down the lines that a worker ran: one that is slow to leave (thousands of programs to free) is killed."""
    measured = coverage.Coverage.current()
    if measured is not None and hasattr(session.config, "workerinput"):
        measured.save()


MOST_BYTES = 4 * 2**30
"""Of memory that a worker holds when it begins a module; two workers and what they start must fit beside each other."""


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Forget compiled programs between modules once they fill the memory; the cache on disk has them still."""
    held = Path("/proc/self/statm")
    if nextitem is None or nextitem.path == item.path or not held.exists():
        return
    if int(held.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE") > MOST_BYTES:
        jax.clear_caches()
        gc.collect()
        with suppress(AttributeError):  # glibc alone keeps what was freed, and gives it back when asked
            ctypes.CDLL(None).malloc_trim(0)


SHARED_DATA = Path(__file__).parent.parent.parent / "shared" / "data"


@pytest.fixture(scope="session")
def contact_table_path() -> Path:
    """The amplitude table of an independent contact simulation; its tests are skipped where it is not at hand."""
    path = SHARED_DATA / "amplitudes_contact.csv"
    if not path.exists():
        pytest.skip("the contact table lies outside this checkout")
    return path
