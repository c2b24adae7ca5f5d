"""Every malformed file and wrong call of the corpus ends in its own line: file, place, what is wrong; exit code 2."""

import os
import time
from pathlib import Path

import pytest

from tests.malformed import corpus, line_of, run, write_sound_files

BASES, CASES = corpus()


def test_the_corpus_is_large_and_no_file_is_there_twice():
    assert len(CASES) >= 700
    assert len({tuple(sorted((key, str(part)) for key, part in case.items())) for case in CASES}) == len(CASES)
    assert {case["of"] for case in CASES} == set(BASES)


# contacts are traced before their junction is looked for
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "contact")) for name in BASES])
def test_one_clear_line(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    # a sweep tells JAX to use all cores
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))
    write_sound_files()
    for case in CASES:
        if case["of"] != name:
            continue
        begin = time.process_time()
        result = run(BASES[name], case)
        line = line_of(result)
        assert line == f"afm-jax: {case['says']}\n", case
        assert (result.exit_code, result.stdout) == (2, ""), case
        # the file, or what the call asks of it
        assert "new" not in case or any(word in line for word in (BASES[name]["file"], *case["call"].split()[2:])), case
        assert line[:-1].isprintable(), case
        assert time.process_time() - begin < 30.0, case
