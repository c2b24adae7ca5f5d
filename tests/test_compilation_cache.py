"""The command line's start of JAX: 64-bit floats, and compiled programs kept in the user's cache folder."""

import sys
from pathlib import Path

import pytest

from afm_jax.cli import compilation
from tests.fresh_python import python

START = (
    "from afm_jax.cli.compilation import start_jax\nstart_jax()\nimport jax\n"
    "jax.jit(lambda x: x + 1)(1.0)\n"
    "print(jax.config.read('jax_enable_x64'), jax.config.values['jax_compilation_cache_dir'])"
)
WITHOUT = {"JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE"}


def start(**environment: str) -> list[str]:
    """Return what a fresh program says of 64-bit floats and of the compilation cache's folder."""
    code = f"import os\n[os.environ.pop(name, None) for name in {WITHOUT - set(environment)}]\n{START}"
    return python(code, **environment).split(maxsplit=1)


@pytest.mark.skipif(sys.platform in {"win32", "darwin"}, reason="the cache folder is chosen by another variable")
def test_compiled_programs_are_kept_in_the_users_cache(tmp_path: Path):
    x64, folder = start(XDG_CACHE_HOME=str(tmp_path))
    assert x64 == "True"
    assert Path(folder).parent == tmp_path / "afm-jax"
    assert compilation.processor_key() in folder
    assert list(Path(folder).glob("jit_*"))


def test_the_users_own_cache_settings_stand(tmp_path: Path):
    own, other = tmp_path / "own", tmp_path / "other"
    assert start(XDG_CACHE_HOME=str(other), JAX_COMPILATION_CACHE_DIR=str(own)) == ["True", str(own)]
    assert start(XDG_CACHE_HOME=str(other), JAX_ENABLE_COMPILATION_CACHE="0") == ["True", "None"]
    assert not other.exists()


@pytest.mark.skipif(sys.platform in {"win32", "darwin"}, reason="the cache folder is chosen by another variable")
def test_cache_that_cannot_be_written_is_harmless(tmp_path: Path):
    (tmp_path / "file").touch()
    assert start(XDG_CACHE_HOME=str(tmp_path / "file")) == ["True", "None"]


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
    assert compilation.user_cache_folder() == Path(expected.replace("HOME", str(Path.home())))
