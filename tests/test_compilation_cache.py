"""Compiled programs kept in the user's cache folder: by commands and sessions, only where nobody else can write."""

import json
from pathlib import Path

import pytest

from afm_jax.compilation_cache import make_private, processor_key
from tests.fresh_python import outputs, python

START = (
    "import os\nfrom afm_jax.cli.compilation import start_jax\nstart_jax(print if 'TOLD' in os.environ else len)\n"
    "import jax\njax.jit(lambda x: x + 1)(1.0)\n"
    "print(jax.config.read('jax_enable_x64'), jax.config.values['jax_compilation_cache_dir'])"
)
UNSET = {"JAX_COMPILATION_CACHE_DIR": None, "JAX_ENABLE_COMPILATION_CACHE": None}


def start(**environment: str) -> list[str]:
    """Return what a fresh program says of 64-bit floats and of the compilation cache's folder."""
    return python(START, **(UNSET | environment)).split(maxsplit=1)


def with_cache_in(folder: Path, **more: str) -> dict[str, str | None]:
    return {"XDG_CACHE_HOME": str(folder), **UNSET, **more}


@pytest.mark.slow
def test_the_users_own_cache_settings_stand_and_one_that_cannot_be_written_is_harmless(tmp_path: Path):
    own, other = tmp_path / "own", tmp_path / "other"
    assert start(XDG_CACHE_HOME=str(other), JAX_COMPILATION_CACHE_DIR=str(own)) == ["True", str(own)]
    assert start(XDG_CACHE_HOME=str(other), JAX_ENABLE_COMPILATION_CACHE="0") == ["True", "None"]
    assert not other.exists()
    other.touch()
    assert start(XDG_CACHE_HOME=str(other), HOME=str(other)) == ["True", "None"]


def test_no_folder_of_somebody_else_or_that_others_may_write_to_is_private(tmp_path: Path, monkeypatch):
    folder = tmp_path / "afm-jax"
    make_private(folder / "own")
    for mode in (0o777, 0o770, 0o1777):
        folder.chmod(mode)
        with pytest.raises(PermissionError, match="others may write to the folder") as error:
            make_private(folder / "own")
        assert error.value.filename == str(folder)
    folder.chmod(0o700)
    monkeypatch.setattr("os.geteuid", lambda: tmp_path.stat().st_uid + 1)
    with pytest.raises(PermissionError, match="belongs to another user"):
        make_private(folder / "own")


def test_compiled_programs_of_a_folder_that_others_may_write_to_are_not_read(tmp_path: Path):
    start(XDG_CACHE_HOME=str(tmp_path))
    (tmp_path / "afm-jax").chmod(0o777)
    *said, where = python(START, **with_cache_in(tmp_path, TOLD="1")).split("\n")
    assert where == "True None"
    mended = "others may write to the folder; `chmod go-w` mends it"
    assert said == [f"compiled programs: not kept ({tmp_path}/afm-jax: {mended})"]


def test_programs_are_kept_for_this_user_and_a_damaged_one_is_compiled_anew_once_and_said(tmp_path: Path):
    surroundings = with_cache_in(tmp_path, TOLD="1")
    assert python(START, **surroundings).count("rejected") == 0
    (entry,) = (tmp_path / "afm-jax").glob("*/jit__lambda*-cache")
    assert processor_key() in entry.parent.name
    # machine code that will be run: for this user alone
    assert {path.stat().st_mode & 0o777 for path in entry.parents[:2]} == {0o700}
    whole = entry.read_bytes()
    entry.write_bytes(whole[: len(whole) // 2])
    printed, complaints = outputs(START, surroundings)
    assert printed.count("jit__lambda was rejected and is compiled anew") == 1
    assert "Warning" not in complaints
    assert len(entry.read_bytes()) > len(whole) // 2
    assert python(START, **surroundings).count("rejected") == 0


@pytest.mark.slow
def test_a_python_session_shares_the_cache_of_the_commands_and_xla_is_silent(tmp_path: Path):
    # JAX is there before; the second session reads what the first has compiled, about which XLA complains on
    # processors with AVX-512
    code = (
        "import warnings\nwarnings.simplefilter('error')\nimport jax, afm_jax\nprint(afm_jax.use_cache())\n"
        "jax.jit(lambda x: jax.numpy.sin(x).sum())(jax.numpy.arange(9.0))\n"
        "print(afm_jax.use_cache() == afm_jax.use_cache(), jax.config.read('jax_enable_x64'))"
    )
    printed, said = [outputs(code, with_cache_in(tmp_path)) for _ in range(2)][-1]
    folder, same = printed.splitlines()
    assert (same, said) == ("True False", "")
    assert list(Path(folder).glob("jit_*"))
    assert start(XDG_CACHE_HOME=str(tmp_path))[1] == folder


def test_doctor_says_whether_the_cache_works(tmp_path: Path):
    doctor = "import sys\nsys.argv = ['afm-jax', 'doctor', '--json']\nfrom afm_jax.__main__ import run\nrun()"
    printed, said = outputs(doctor, with_cache_in(tmp_path))
    told = json.loads(printed)
    assert (told["cache"]["works"], told["float_bits"], said) == (True, 64, "")
    assert told["versions"]["jaxlib"] in told["cache"]["folder"]
