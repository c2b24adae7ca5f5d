"""What hard use broke once: full disks, closed streams, hostile names, interrupts, numbers out of all proportion."""

import contextlib
import itertools
import os
import signal
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from afm_jax.studies.sweep import STORE
from afm_jax.whole_files import write_whole
from tests.fuzz import fuzz_files, fuzz_orbits
from tests.test_imports import ROOT
from tests.writing_commands import CALLS, prepare, unchecked

LAW = "[cantilever]\nfrequency_khz = 90\nquality_factor = 40\n[platform]\namplitude_nm = {}\nreduced_frequency = {}\n"
LAW += "[interaction]\nmodel = 'law'\nr = 0.95\nepsilon = 60\n"


def run(*arguments: object):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "fit.txt"
    write_whole(path, "first\n")
    write_whole(path, "sécond\n")
    assert path.read_bytes() == "sécond\n".encode()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"cannot be written \(No space left on device\).*fit\.txt"):
        write_whole(path, "third\n")
    assert path.read_bytes() == "sécond\n".encode()
    assert [file.name for file in tmp_path.iterdir()] == ["fit.txt"]


def test_new_files_have_the_modes_of_others_and_only_links_named_by_the_user_are_followed(tmp_path):
    path, link, other = tmp_path / "a", tmp_path / "link", tmp_path / "other"
    write_whole(path, b"a")
    other.touch()
    assert path.stat().st_mode == other.stat().st_mode
    link.symlink_to(path)
    with pytest.raises(OSError, match=r"is a link, which is not followed; delete it or choose another folder.*/link"):
        write_whole(link, b"c")
    assert path.read_bytes() == b"a"
    write_whole(link, b"b", named_by_user=True)
    assert (link.is_symlink(), path.read_bytes()) == (True, b"b")


def shell(arguments: str) -> subprocess.CompletedProcess[str]:
    """Return what the program did in a shell."""
    call = f"exec {sys.executable} -m afm_jax {arguments}"
    return subprocess.run(call, shell=True, cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S602


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_device_and_a_full_standard_output_are_named(tmp_path):
    with pytest.raises(OSError, match="/dev/full"):
        write_whole("/dev/full", "x", named_by_user=True)
    (tmp_path / "curve.csv").write_text("offset_nm,lockin_amplitude_nm\n1,2\n2,3\n", encoding="utf-8")
    full = "afm-jax: standard output: cannot be written (No space left on device)\n"
    for arguments, said in (
        (f"read {tmp_path}/curve.csv >/dev/full", full),
        ("fit --help >/dev/full", full),
        ("--version >/dev/full", full),
        ("--version >&-", "afm-jax: standard output is closed; send it to a file or to /dev/null instead\n"),
    ):
        done = shell(arguments)
        assert (done.returncode, done.stderr) == (2, said)
    silent = shell("--version 2>&-")
    assert (silent.returncode, silent.stdout[:8]) == (0, "afm-jax ")


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_files_of_commands_are_checked_for_links_first(tmp_path, call):
    prepare(tmp_path)
    code, said, written, loose = unchecked(call, tmp_path)
    assert code in (0, 3), said
    assert written
    assert loose == []
    # a link in place of each file, and of each folder that holds some; those in a sweep's have tests of their own
    for place in {name.partition("/")[0] for name in written} - {STORE}:
        whole = tmp_path / f"out of {call}" / place
        kept = whole.with_name("kept")
        whole.rename(kept)
        whole.symlink_to(tmp_path / "letter")
        code, said, *_ = unchecked(call, tmp_path)
        assert (code, "is a link, which is not followed" in said, (tmp_path / "letter").exists()) == (2, True, False)
        whole.unlink()
        kept.rename(whole)


BAD_NUMBERS = ("nan", "inf", "-inf", "1e400", "1:nan:2", "0:inf:1", "r=nan", "40 +- nan", "r=1+-inf", "1:1e400")


def test_no_option_takes_numbers_that_are_none():
    """Every option of every command: what compares with no limit, and what has none."""
    seen, root = 0, click.Context(main)
    commands = [main.get_command(root, name) for name in main.list_commands(root)]
    options = [(one, option) for one in commands if one for option in one.params if isinstance(option, click.Option)]
    for (command, option), bad in itertools.product(options, BAD_NUMBERS):
        with contextlib.suppress(click.BadParameter):
            value = option.type.convert(bad, option, click.Context(command))
            numbers = [part for part in np.ravel(np.array(value, dtype=object)) if isinstance(part, float)]
            assert np.all(np.isfinite(numbers)), (command.name, option.opts, bad)
            seen += 1
    assert seen > 100


def test_no_message_quotes_a_name_of_any_length_or_what_commands_the_terminal(tmp_path):
    name, path = "k" * 200_000, tmp_path / "scene.toml"
    path.write_text(LAW.format(4, 1.01), encoding="utf-8")
    calls = [("bifurcation", path, "--parameter", f"{name}=1:2:3"), (name,), ("fit", name), ("fit", f"--{name}")]
    for number, text in enumerate((f"{name} = 1\n", f"[{name}]\na = 1\n", f"[{name} b]\n")):
        long = tmp_path / f"{number}.toml"
        long.write_text(LAW.format(4, 1.01) + text, encoding="utf-8")
        calls.append(("orbits", long, "--order", "1"))
    for call in calls:
        said = run(*call)
        assert (said.exit_code, len(said.stderr) < 1000) == (2, True)
    path = tmp_path / "a\x1b[31m\x07b.csv"
    path.write_text("order\n1\n", encoding="utf-8")
    for command in ("fit", "lockin"):
        result = run(command, path)
        assert (result.exit_code, "\x1b" in result.output) == (2, False)
        assert "a\\x1b[31m\\x07b.csv" in result.stderr
    assert "\x1b" not in run("fit", tmp_path / "none\x1b.csv").output


DEAF = """
import signal, sys, time
import tests.trial_commands
from afm_jax.cli.command import Command
from afm_jax.cli.main import COMMANDS, main
# a job in the background of a shell is born deaf
signal.signal(signal.SIGINT, signal.default_int_handler)
class Lost:
    def __del__(self):
        raise KeyboardInterrupt
def command(session):
    ready = False
    while True:
        try:
            if not ready:
                ready = True
                print("ready", flush=True)
            time.sleep(0.02)
        except KeyboardInterrupt:
            # as in the callbacks of a garbage collection: nobody hears it
            Lost()
tests.trial_commands.body = command
COMMANDS["rough"] = Command("rough", "Check", "tests.trial_commands:trial", computes=False)
sys.argv[1:] = ["rough"]
main()
"""
"""A program with one more command."""


def test_an_interrupt_that_is_swallowed_ends_the_program_all_the_same():
    call = [sys.executable, "-c", DEAF]
    with subprocess.Popen(call, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        try:
            _, said = process.communicate(timeout=20)
        finally:
            process.kill()
    assert (process.returncode, said) == (130, "afm-jax: interrupted\n")


@pytest.mark.slow
def test_a_little_random_work_finds_nothing():
    fuzz_orbits(256, 3)
    fuzz_files(200, 3)
