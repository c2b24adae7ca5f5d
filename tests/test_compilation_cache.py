"""Compiled programs kept in the user's cache folder: by commands and sessions, only where nobody else can write."""

import json
import os
import sys
from pathlib import Path

import pytest

from afm_jax.compilation_cache import make_private, processor_key, silence_xla, user_cache_folder
from tests.fresh_python import outputs, python

START = (
    "from afm_jax.cli.compilation import start_jax\nstart_jax(print if 'TOLD' in os.environ else len)\nimport jax\n"
    "jax.jit(lambda x: x + 1)(1.0)\n"
    "print(jax.config.read('jax_enable_x64'), jax.config.values['jax_compilation_cache_dir'])"
)
WITHOUT = {"JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE"}


def start(**environment: str) -> list[str]:
    """Return what a fresh program says of 64-bit floats and of the compilation cache's folder."""
    return python(f"import os\n{START}", **(dict.fromkeys(WITHOUT) | environment)).split(maxsplit=1)


@pytest.mark.skipif(sys.platform in {"win32", "darwin"}, reason="the cache folder is chosen by another variable")
def test_compiled_programs_are_kept_in_the_users_cache(tmp_path: Path):
    x64, folder = start(XDG_CACHE_HOME=str(tmp_path))
    assert x64 == "True"
    assert Path(folder).parent == tmp_path / "afm-jax"
    assert processor_key() in folder
    assert list(Path(folder).glob("jit_*"))
    # machine code that will be run: for this user alone
    assert {path.stat().st_mode & 0o777 for path in (Path(folder), Path(folder).parent)} == {0o700}


def test_the_users_own_cache_settings_stand(tmp_path: Path):
    own, other = tmp_path / "own", tmp_path / "other"
    assert start(XDG_CACHE_HOME=str(other), JAX_COMPILATION_CACHE_DIR=str(own)) == ["True", str(own)]
    assert start(XDG_CACHE_HOME=str(other), JAX_ENABLE_COMPILATION_CACHE="0") == ["True", "None"]
    assert not other.exists()


@pytest.mark.skipif(sys.platform in {"win32", "darwin"}, reason="the cache folder is chosen by another variable")
def test_cache_that_cannot_be_written_is_harmless(tmp_path: Path):
    (tmp_path / "file").touch()
    assert start(XDG_CACHE_HOME=str(tmp_path / "file")) == ["True", "None"]


@pytest.mark.skipif(sys.platform in {"win32", "darwin"}, reason="the cache folder is chosen by another variable")
def test_a_user_without_a_home_folder_keeps_nothing():
    # a user whom the system does not list, as in containers; and a HOME that means another folder wherever one is
    nobody = "from pathlib import Path\ndef home():\n    raise RuntimeError('no home')\nPath.home = home\n"
    ask = (
        "import afm_jax\nfrom afm_jax.compilation_cache import cache_folder\nprint(cache_folder(), afm_jax.use_cache())"
    )
    for before, home in ((nobody, None), ("", "relative")):
        variables = {"HOME": home, "XDG_CACHE_HOME": None, **dict.fromkeys(WITHOUT)}
        printed, said = outputs(before + ask, variables)
        assert printed == "None None"
        assert "not kept: there is no home folder: set HOME or XDG_CACHE_HOME" in said


@pytest.mark.parametrize(
    ("system", "variables", "expected"),
    [
        ("linux", {"XDG_CACHE_HOME": "/somewhere"}, "/somewhere/afm-jax"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, "HOME/.cache/afm-jax"),
        ("darwin", {"XDG_CACHE_HOME": "/somewhere"}, "HOME/Library/Caches/afm-jax"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/afm-jax/cache"),
    ],
)
def test_cache_folder_follows_the_platform(
    monkeypatch: pytest.MonkeyPatch, system: str, variables: dict[str, str], expected: str
):
    monkeypatch.setattr(sys, "platform", system)
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert user_cache_folder() == Path(expected.replace("HOME", str(Path.home())))


linux = pytest.mark.skipif(sys.platform in {"win32", "darwin"}, reason="the cache folder is chosen by another variable")


@linux
@pytest.mark.parametrize("mode", [0o777, 0o770, 0o1777])
def test_no_folder_that_others_may_write_to_is_private(tmp_path: Path, mode: int):
    (tmp_path / "afm-jax").mkdir()
    (tmp_path / "afm-jax").chmod(mode)
    with pytest.raises(PermissionError, match="others may write to the folder") as error:
        make_private(tmp_path / "afm-jax" / "own")
    assert error.value.filename == str(tmp_path / "afm-jax")


@linux
def test_a_folder_that_others_may_write_to_is_not_used(tmp_path: Path):
    (tmp_path / "afm-jax").mkdir()
    (tmp_path / "afm-jax").chmod(0o777)
    *said, where = python(
        f"import os\n{START}", TOLD="1", XDG_CACHE_HOME=str(tmp_path), **dict.fromkeys(WITHOUT)
    ).split("\n")
    assert where == "True None"
    assert said == [
        f"compiled programs: not kept ({tmp_path}/afm-jax: others may write to the folder; `chmod go-w` mends it)"
    ]
    assert not list((tmp_path / "afm-jax").glob("*/*"))


def test_a_folder_of_somebody_else_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make_private(tmp_path / "cache" / "own")
    monkeypatch.setattr("os.geteuid", lambda: tmp_path.stat().st_uid + 1)
    with pytest.raises(PermissionError, match="belongs to another user") as error:
        make_private(tmp_path / "cache" / "own")
    assert error.value.filename == str(tmp_path / "cache")


@linux
def test_traced_programs_of_a_folder_that_others_may_write_to_are_not_read(tmp_path: Path):
    surroundings = {"XDG_CACHE_HOME": str(tmp_path), **dict.fromkeys(WITHOUT)}
    folder = Path(python(f"import os\n{START}", **surroundings).split()[1])
    (folder / "traced").mkdir()
    (folder / "traced").chmod(0o777)
    code = "import sys\nsys.argv = ['afm-jax', 'fit', 'none.csv', '--verbose']\nfrom afm_jax.__main__ import run\nrun()"
    _, said = outputs(code, surroundings, (2,))
    assert f"traced programs are not kept: {folder}/traced: others may write to the folder" in said


@linux
def test_a_damaged_entry_is_compiled_anew_once_and_said(tmp_path: Path):
    code = f"import os\n{START}"
    surroundings = {"XDG_CACHE_HOME": str(tmp_path), "TOLD": "1", **dict.fromkeys(WITHOUT)}
    assert python(code, **surroundings).count("rejected") == 0
    (entry,) = (tmp_path / "afm-jax").glob("*/jit__lambda*-cache")
    whole = entry.read_bytes()
    entry.write_bytes(whole[: len(whole) // 2])
    printed, complaints = outputs(code, surroundings)
    assert printed.count("jit__lambda was rejected and is compiled anew") == 1
    assert "Warning" not in complaints
    assert len(entry.read_bytes()) > len(whole) // 2
    assert python(code, **surroundings).count("rejected") == 0


@linux
def test_a_python_session_shares_the_cache_of_the_commands(tmp_path: Path):
    code = (
        "import warnings\nwarnings.simplefilter('error')\n"
        "import afm_jax\nprint(afm_jax.use_cache())\nimport jax\njax.jit(lambda x: x + 1)(1.0)\n"
        "print(afm_jax.use_cache() == afm_jax.use_cache(), jax.config.read('jax_enable_x64'))"
    )
    folder, same = python(code, XDG_CACHE_HOME=str(tmp_path), **dict.fromkeys(WITHOUT)).splitlines()
    assert same == "True False"
    assert list(Path(folder).glob("jit_*"))
    assert start(XDG_CACHE_HOME=str(tmp_path))[1] == folder
    (tmp_path / "afm-jax").chmod(0o777)
    code = "import warnings\nwarnings.simplefilter('always')\nimport afm_jax\nprint(afm_jax.use_cache())"
    printed, said = outputs(code, {"XDG_CACHE_HOME": str(tmp_path), **dict.fromkeys(WITHOUT)})
    assert printed == "None"
    assert "compiled programs are not kept" in said


@pytest.mark.parametrize(("before", "after"), [(None, "3"), ("1", "3"), ("0", "0"), ("2", "2")])
def test_messages_of_xla_are_what_the_user_asked_for(monkeypatch: pytest.MonkeyPatch, before: str | None, after: str):
    # 1 is what JAX sets where nobody has asked for anything
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL", raising=False)
    if before is not None:
        monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", before)
    silence_xla()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == after


@linux
def test_xla_is_silent_in_a_session_that_has_imported_jax_before(tmp_path: Path):
    # the second session reads what the first has compiled, about which XLA complains on processors with AVX-512
    code = (
        "import jax, afm_jax\nafm_jax.use_cache()\n"
        "print(jax.jit(lambda x: jax.numpy.sin(x).sum())(jax.numpy.arange(9.0)))"
    )
    for _ in range(2):
        _, said = outputs(code, {"XDG_CACHE_HOME": str(tmp_path), **dict.fromkeys(WITHOUT)})
        assert said == ""
    (entry,) = (tmp_path / "afm-jax").glob("*/jit__lambda*-cache")
    assert entry.exists()


DOCTOR = (
    "import sys\nsys.argv = ['afm-jax', 'doctor', '--json', *sys.argv[1:]]\nfrom afm_jax.__main__ import run\nrun()"
)


@linux
def test_doctor_says_whether_the_cache_works(tmp_path: Path):
    surroundings = {"XDG_CACHE_HOME": str(tmp_path), **dict.fromkeys(WITHOUT)}
    printed, said = outputs(DOCTOR, surroundings)
    told = json.loads(printed)
    assert (told["format"], told["format_version"]) == ("afm-jax doctor", 1)
    assert told["cache"]["works"] is True
    assert told["cache"]["first_s"] > 0.0
    assert told["float_bits"] == 64
    assert told["versions"]["jaxlib"] in told["cache"]["folder"]
    assert told["microseconds_per_impact"] > 0.0
    assert said == ""
    (tmp_path / "afm-jax").chmod(0o777)
    printed, said = outputs(DOCTOR, surroundings, (3,))
    assert json.loads(printed)["cache"]["works"] is False
    assert "others may write to the folder" in said
