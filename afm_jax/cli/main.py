"""`afm-jax`: the commands in groups, and how their program is interrupted. `command.py` runs a command."""

import contextlib
import os
import signal
import socket
import sys
import threading
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from afm_jax.cli.commands import COMMANDS
from afm_jax.cli.ending import INTERRUPTED, exit_code_of
from afm_jax.words import nearest_name


def _check_streams() -> None:
    """Check that there is a standard output; messages to a standard error that is closed go nowhere.

    Raises:
        click.ClickException: if there is none.
    """
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 (as long as the program runs)
    if sys.stdout is None:
        raise click.ClickException("standard output is closed; send it to a file or to /dev/null instead")


_GRACE_S = 1.0
"""For the usual way out of an interrupt, before the program ends without it."""


def _end_when_interrupted() -> threading.Event:
    """Make sure that an interrupt ends the program; return the event to set when it ends by itself.

    Python raises an interrupt in the main thread, where native code can hold it for a long compilation, and callbacks
    of JAX's garbage collection can lose it. A thread receives the signal at once, whatever the main thread does. Files
    are written whole, so that nothing is left half done.
    """
    ended = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        return ended
    # a shell starts what runs in the background with interrupts ignored
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    heard, told = socket.socketpair()
    told.settimeout(0.0)
    signal.set_wakeup_fd(told.fileno(), warn_on_full_buffer=False)
    usual = sys.unraisablehook

    def unraisable(lost: Any) -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            usual(lost)

    sys.unraisablehook = unraisable

    def wait() -> None:
        while signal.SIGINT not in heard.recv(64):
            pass
        if not ended.wait(_GRACE_S):
            click.echo("afm-jax: interrupted", err=True)
            os._exit(INTERRUPTED)
        told.close()

    threading.Thread(target=wait, daemon=True).start()
    return ended


def _interrupt(number: int, frame: types.FrameType | None) -> None:
    """Raise an interrupt where it is understood; end the program where packages are being imported.

    NumPy and JAX take an interrupt of their own import for a fault of the installation, try another way, and crash.
    """
    children = sys.modules.get("multiprocessing.process")
    place = frame
    while place is not None:
        if place.f_code.co_filename.startswith("<frozen importlib") and not (children and children.active_children()):
            click.echo("afm-jax: interrupted", err=True)
            os._exit(INTERRUPTED)
        place = place.f_back
    signal.default_int_handler(number, frame)


class LazyGroup(click.Group):
    """A group that lists its commands from a table, and ends every failure with one line and an exit code."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names of all commands."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Return a command; None if there is none of this name."""
        return COMMANDS[cmd_name].click_command() if cmd_name in COMMANDS else None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the list of commands, a section a group."""
        groups = {row.group: [] for row in COMMANDS.values()}
        for _, row in sorted(COMMANDS.items()):
            groups[row.group].append((row.name, row.summary))
        for heading, rows in groups.items():
            with formatter.section(heading):
                formatter.write_dl(rows)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the first argument names; an unknown one is an error that names the nearest."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-") and not ctx.resilient_parsing:
            nearest = nearest_name(name, COMMANDS)
            advice = f"did you mean `{nearest}`?" if nearest else f"choose one of {', '.join(sorted(COMMANDS))}"
            raise click.UsageError(f"there is no command `{name}`; {advice}", ctx=ctx)
        return click.Group.resolve_command(self, ctx, args)

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,  # noqa: FBT001, FBT002
        **extra: Any,
    ) -> Any:
        """Run the command line; unless `standalone_mode` is off, end the program with its exit code."""

        def run() -> Any:
            if standalone_mode:
                _check_streams()
            return click.Group.main(self, args, prog_name, complete_var, standalone_mode=False, **extra)

        if not standalone_mode:
            return run()
        # a program that calls this one keeps its own signals
        ended = _end_when_interrupted() if args is None else threading.Event()
        code = exit_code_of(run)
        ended.set()
        if args is None and code == INTERRUPTED:
            # JAX's threads still compute: taking the interpreter down under them ends in a segmentation fault
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(AttributeError, OSError, ValueError):
                    stream.flush()
            os._exit(code)
        return sys.exit(code)


@click.group(
    cls=LazyGroup,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
    epilog="Exit codes: 0 done; 1 the program failed; 2 the call or the data are wrong; 3 ran, but the result is not "
    'valid. Completion of commands, options and files: eval "$(_AFM_JAX_COMPLETE=bash_source afm-jax)" in ~/.bashrc; '
    "zsh_source in ~/.zshrc; fish: _AFM_JAX_COMPLETE=fish_source afm-jax | source.",
)
@click.option("--version", is_flag=True, help="Show the version and exit.")
@click.pass_context
def main(ctx: click.Context, *, version: bool) -> None:
    """Intermittent-contact atomic force microscopy: impacts, orbits, and the impact law from amplitudes."""
    if version:
        from afm_jax.version import __version__  # noqa: PLC0415

        click.echo(f"afm-jax {__version__}")
        ctx.exit()
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
