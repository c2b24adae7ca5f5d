"""`afm-jax`: the table of commands; each command's module is imported when it is called.

How a command ends: exit codes, and one line on standard error for whatever went wrong.

0: done. 1: the program failed, or nobody reads the output any more (closed pipe). 2: the call or the data are wrong.
3: ran, but the result is not valid. 130: interrupted.
"""

import contextlib
import difflib
import errno
import os
import signal
import socket
import sys
import threading
import types
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from afm_jax.scenefile.tables import cut_short
from afm_jax.words import shown

_OWN_PACKAGES = ("afm_jax", "fitting")
_NUMERICAL_PACKAGES = frozenset(
    {"blackjax", "diffrax", "equinox", "jax", "jaxlib", "lineax", "numpy", "optax", "optimistix", "scipy"}
)
_TRACEBACK = "AFM_JAX_TRACEBACK"
"""Environment variable that, if set, lets a failure of the program pass through with its traceback."""


_INTERRUPTED = 130


_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
"""How writing fails where there is no room."""


class NotValid(Exception):  # noqa: N818
    """The command ran and has printed its output, but the result is not valid; the message says why."""


_FORESEEN = (
    NotValid,
    click.Abort,
    click.ClickException,
    ModuleNotFoundError,
    OSError,
    ValueError,
    ArithmeticError,
    MemoryError,
    RuntimeError,
)


_LONGEST_WORD, _LONGEST_LINE = 300, 2000
"""Of a message, in letters."""


def exit_code_of(run: Callable[[], object]) -> int:
    """Run a command line and return its exit code, after one line on standard error if it failed.

    Args:
        run: the command line without arguments; what it returns matters only if it is an exit code.

    Raises:
        Exception: a mistake in this program that no one foresaw passes through with its traceback.
    """
    try:
        code = run()
    except _FORESEEN as error:
        line, code = _verdict(error)
        if not line or (code == 1 and os.environ.get(_TRACEBACK)):
            raise
        # what a file holds may be quoted, however long it is
        words = " ".join(cut_short(word, _LONGEST_WORD) for word in line.split())
        click.echo(shown(f"afm-jax: {cut_short(words, _LONGEST_LINE)}"), err=True)
    return code if isinstance(code, int) else 0


def _verdict(error: Exception) -> tuple[str, int]:
    """Return what to say of a failure and the exit code; nothing where it is no fault of the user."""
    match error:
        case NotValid():
            return f"not valid: {error}", 3
        case click.Abort():
            return "interrupted", _INTERRUPTED
        case click.ClickException():
            return _called_wrongly(error), 2
        case ModuleNotFoundError():
            return _missing_package(error), 2
        case OSError():
            return _refused_by_the_system(error), 2
        case _:
            return _wrong_values(error)


def _refused_by_the_system(error: OSError) -> str:
    if error.filename is None and error.errno in _FULL:
        # what writes files names them
        return f"standard output: cannot be written ({error.strerror})"
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}"


def _wrong_values(error: Exception) -> tuple[str, int]:
    """Return the same for values that were refused, by a check of the input or by what computes with them."""
    name = type(error).__name__
    if isinstance(error, ValueError) and not _is_inner(error):
        # thus also TableError, SceneError and the checks of the objects: the data are wrong
        return str(error) or name, 2
    what = f"{name}: {error}" if str(error) else name
    return f"the program failed, which is not the input's fault ({what}); {_TRACEBACK}=1 shows where", 1


def _is_inner(error: ValueError) -> bool:
    """Say whether a computation failed, not a check: NumPy calls a factorisation that fails a ValueError too."""
    if any(kind.__name__ == "LinAlgError" for kind in type(error).__mro__):
        return True
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    module = "" if place is None else str(place.tb_frame.f_globals.get("__name__", ""))
    return module.partition(".")[0] in _NUMERICAL_PACKAGES


def _called_wrongly(error: click.ClickException) -> str:
    message = error.format_message().rstrip(".")
    context = error.ctx if isinstance(error, click.UsageError) else None
    if isinstance(error, click.NoSuchOption):
        message = f"there is no option `{error.option_name}`"
        if error.possibilities:
            return f"{message}; did you mean `{error.possibilities[0]}`?"
    # the group's own messages say enough; those of a command are followed by where its options are explained
    return message if context is None or context.parent is None else f"{message} (see {context.command_path} --help)"


def _missing_package(error: ModuleNotFoundError) -> str:
    package = (error.name or "").partition(".")[0]
    if package in {"", *_OWN_PACKAGES}:
        return ""
    return f"the Python package `{package}` is missing; install it with: pip install {package}"


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
    """Make sure that an interrupt ends the program; return what tells that it ends by itself.

    Python raises an interrupt in the main thread, where native code can hold it for a long compilation, and callbacks
    of JAX's garbage collection can lose it. A thread is told of the signal at once, whatever the main thread does. What
    is written is written whole, so that nothing is left half done.
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
            os._exit(_INTERRUPTED)
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
            os._exit(_INTERRUPTED)
        place = place.f_back
    signal.default_int_handler(number, frame)


COMMANDS = {
    "accuracy": ("afm_jax.cli.accuracy", "Show error against time, and the cheapest setting for a wanted accuracy."),
    "basins": ("afm_jax.cli.basins", "Find which start of a scene ends where."),
    "bench": ("afm_jax.cli.bench", "Measure impacts per second, next to SciPy."),
    "bifurcation": ("afm_jax.cli.bifurcation", "Sweep a parameter and record what the tip comes to."),
    "calibrate": ("afm_jax.cli.calibrate", "Fit a resonance sweep or a thermal spectrum: frequency, Q, stiffness."),
    "chart": ("afm_jax.cli.chart", "Chart which single-impact orbits are stable over two parameters."),
    "collide": ("afm_jax.cli.collide", "Let free tips collide with the sample: rebound, delay, capture, energy."),
    "continue": ("afm_jax.cli.continue_orbits", "Follow orbits and their special points through parameters."),
    "design": ("afm_jax.cli.design", "Choose the drives to measure next, and forecast what they will determine."),
    "doctor": ("afm_jax.cli.doctor", "Say what is installed, how JAX computes, and whether its cache works."),
    "effects": ("afm_jax.cli.effects", "Say what each effect of a scene changes and costs, and which can be left out."),
    "figures": ("afm_jax.cli.figures", "Draw figures 2 to 11 of the paper, with its statements checked."),
    "fit": ("afm_jax.cli.fit", "Fit the impact law to a table of vibration amplitudes."),
    "invert": ("afm_jax.cli.invert", "Read speeds and delay of every impact off amplitude and phase, without a law."),
    "lockin": ("afm_jax.cli.lockin", "Read response order, amplitudes and phase off time traces of the deflection."),
    "lyapunov": ("afm_jax.cli.lyapunov", "Compute Lyapunov exponents of a motion, or along a parameter."),
    "orbits": ("afm_jax.cli.orbits", "Find the orbits of a scene, of one impact or more, and whether they are stable."),
    "read": ("afm_jax.cli.read", "Read tapping curves out of an instrument's file, as tables."),
    "simulate": ("afm_jax.cli.simulate", "Follow a scene in time: contacts, amplitudes, phases, energies."),
    "sweep": ("afm_jax.cli.sweep", "Compute many scenes, or fit many tables, over a grid of parameters; resumes."),
    "tapping": ("afm_jax.cli.tapping", "Read the energy of a tap, and the impact law, off a tapping curve."),
    "tapping-map": ("afm_jax.cli.tapping_map", "Read the energy of a tap off every pixel of an image."),
    "verify": ("afm_jax.cli.verify", "Compare eqs. 5 to 8 with automatic differentiation and with 50 digits."),
}
"""For every command the module whose `command` it is, and what the list of commands says of it."""


class LazyGroup(click.Group):
    """A group that lists its commands from a table, and ends every failure with one line and an exit code."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the names of all commands."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import a command; None if there is none of this name."""
        if cmd_name not in COMMANDS:
            return None
        module, _ = COMMANDS[cmd_name]
        return import_module(module).command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, COMMANDS[name][1]) for name in self.list_commands(ctx)])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the first argument names; an unknown one is an error that names the nearest."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-") and not ctx.resilient_parsing:
            nearest = difflib.get_close_matches(name, COMMANDS, n=1)
            advice = f"did you mean `{nearest[0]}`?" if nearest else f"choose one of {', '.join(sorted(COMMANDS))}"
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
        if args is None and code == _INTERRUPTED:
            # JAX's threads still compute: taking the interpreter down under them ends in a segmentation fault
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(AttributeError, OSError, ValueError):
                    stream.flush()
            os._exit(code)
        return sys.exit(code)


@click.group(
    cls=LazyGroup,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 done; 1 the program failed; 2 the call or the data are wrong; 3 ran, but the result is not "
    'valid. Completion of commands, options and presets: eval "$(_AFM_JAX_COMPLETE=bash_source afm-jax)" in ~/.bashrc; '
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
