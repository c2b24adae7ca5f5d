"""What hard use broke once: full disks, closed streams, hostile names, interrupts, numbers out of all proportion."""

import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from afm_jax.studies.sweep import STORE
from afm_jax.whole_files import read_whole, write_whole
from tests.fresh_python import outputs
from tests.fuzz import fuzz_files, fuzz_orbits
from tests.test_imports import LIBRARY, ROOT
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


def test_nothing_writes_files_another_way():
    other = re.compile(r"\.write_text\(|\.write_bytes\(|\.savefig\((?!buffer)|open\([^)]*[\"']w|\.to_(csv|zarr|json)\(")
    # into new folders that `whole_folder` then puts in their place
    new = re.compile(r"open_group\(str\((fresh|path)\)")
    found = {str(path) for path in LIBRARY if other.search(new.sub("", (ROOT / path).read_text(encoding="utf-8")))}
    # the writer itself, and a standard error that is closed
    assert found == {"afm_jax/whole_files.py", "afm_jax/cli/main.py"}


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


def test_a_table_named_by_the_user_may_be_a_link_but_no_numbered_one(tmp_path):
    (tmp_path / "link.csv").symlink_to(tmp_path / "meant.csv")
    assert run("read", *CALLS["read"], "--out", tmp_path / "link.csv").exit_code == 0
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "meant.csv").read_text(encoding="utf-8").startswith("#")
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "curve.csv").symlink_to(tmp_path / "other.csv")
    refused = run("read", *CALLS["read"], "--out", tmp_path / "tables")
    assert (refused.exit_code, (tmp_path / "other.csv").exists()) == (2, False)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names")
def test_a_pipe_is_read_until_its_writer_leaves(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)

    def write() -> None:
        with pipe.open("wb") as file:
            for part in parts:
                file.write(part)
                file.flush()
                time.sleep(0.1)

    parts = [b"a" * 300_000, b"b", b"c" * 100_000]
    writer = threading.Thread(target=write)
    writer.start()
    assert read_whole(pipe) == b"".join(parts)
    writer.join()


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


COMMAND = """
import atexit, os, signal, sys, time
from afm_jax.cli.command import Command
from afm_jax.cli.main import COMMANDS, main
# a job in the background of a shell is born deaf
signal.signal(signal.SIGINT, signal.default_int_handler)
{}
import tests.trial_commands
tests.trial_commands.body = command
COMMANDS["rough"] = Command("rough", "Check", "tests.trial_commands:trial", computes=False)
sys.argv[1:] = ["rough"]
main()
"""
"""A program with one more command."""
DEAF = """
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
"""
LEAVING = """
# as of JAX's threads, which still compute while the interpreter is taken down
atexit.register(lambda: os.kill(os.getpid(), signal.SIGSEGV))
def command(session):
    print("whole")
    raise KeyboardInterrupt
"""
IMPORTING = """
def command(session):
    try:
        import taken_for_a_fault
    except BaseException:
        # as NumPy does, which then tries another way
        raise RecursionError
"""


def test_an_interrupted_program_leaves_before_its_threads_can_crash_it():
    printed, said = outputs(COMMAND.format(LEAVING), {}, codes=(130,))
    assert (printed, said.strip()) == ("whole", "afm-jax: interrupted")


def test_an_interrupt_while_packages_are_imported_is_one_line(tmp_path: Path):
    (tmp_path / "taken_for_a_fault.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nx = 1\n")
    there = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    assert outputs(COMMAND.format(IMPORTING), there, codes=(130,)) == ("", "afm-jax: interrupted\n")


def test_an_interrupt_that_is_swallowed_ends_the_program_all_the_same():
    call = [sys.executable, "-c", COMMAND.format(DEAF)]
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
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="no list of a process's children")
def test_an_interrupt_from_the_terminal_ends_measurements_in_processes_of_their_own_without_a_word():
    # as a terminal does, to the whole group; started so that interrupts are heard even from the background
    # not by an import, in which an interrupt ends the program at once
    code = (
        "import runpy, signal, sys\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "sys.argv = ['afm-jax', 'accuracy', 'map']\nrunpy.run_module('afm_jax', run_name='__main__')"
    )
    call, deadline = [sys.executable, "-c", code], time.monotonic() + 100.0
    with subprocess.Popen(call, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        while not (child := children.read_text(encoding="ascii").split()[:1]) and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(6.0)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in said
    assert said.splitlines()[-1] == "afm-jax: interrupted"
    # gone, or dead and waiting for whoever collects what is left over
    place, deadline = Path(f"/proc/{child[0]}/stat"), time.monotonic() + 10.0
    while place.exists() and place.read_text().rsplit(")", 1)[1].split()[0] != "Z" and time.monotonic() < deadline:
        time.sleep(0.05)
    assert time.monotonic() < deadline


@pytest.mark.slow
def test_a_little_random_work_finds_nothing():
    fuzz_orbits(256, 3)
    fuzz_files(200, 3)
