"""Compiled programs of commands outlive the process."""

import re
import sys

import pytest

from tests.fresh_python import outputs

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
