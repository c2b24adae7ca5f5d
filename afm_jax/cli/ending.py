"""How a command ends: exit codes, and one line on standard error for whatever went wrong.

0: done. 1: the program failed, or nobody reads the output any more (closed pipe). 2: the call or the data are wrong.
3: ran, but the result is not valid. 130: interrupted.
"""

import errno
import os
from collections.abc import Callable

import click

from afm_jax.words import cut_short, shown

_OWN_PACKAGES = ("afm_jax", "fitting")
_NUMERICAL_PACKAGES = frozenset(
    {"blackjax", "diffrax", "equinox", "jax", "jaxlib", "lineax", "numpy", "optax", "optimistix", "scipy"}
)
_TRACEBACK = "AFM_JAX_TRACEBACK"
"""Environment variable that, if set, lets a failure of the program pass through with its traceback."""


INTERRUPTED = 130


_FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
"""How writing fails where there is no room."""


class NotValid(Exception):  # noqa: N818
    """The command ran and has printed its output, but the result is not valid; the message says why."""


_LONGEST_WORD, _LONGEST_LINE = 300, 2000
"""Letters of a message's words, and of the whole message, at most."""


def exit_code_of(run: Callable[[], object]) -> int:
    """Run a command line and return its exit code, after one line on standard error if it failed.

    Args:
        run: the command line without arguments; what it returns matters only if it is an exit code.

    Raises:
        Exception: a mistake in this program that no one foresaw passes through with its traceback.
    """
    try:
        code = run()
    except Exception as error:
        line, code = _verdict(error)
        if not line or (code == 1 and os.environ.get(_TRACEBACK)):
            raise
        # what a file holds may be quoted, however long it is
        words = " ".join(cut_short(word, _LONGEST_WORD) for word in line.split())
        click.echo(shown(f"afm-jax: {cut_short(words, _LONGEST_LINE)}"), err=True)
    return code if isinstance(code, int) else 0


def _verdict(error: Exception) -> tuple[str, int]:
    """Return what to say of a failure and the exit code; nothing where no one foresaw it."""
    match error:
        case NotValid():
            return f"not valid: {error}", 3
        case click.Abort():
            return "interrupted", INTERRUPTED
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
    """Return the message and the exit code for values refused by a check of the input or by what computes with them."""
    name = type(error).__name__
    if isinstance(error, ValueError) and not is_inner(error):
        # thus also TableError, SceneError and the checks of the objects: the data are wrong
        return str(error) or name, 2
    if not isinstance(error, ValueError | ArithmeticError | MemoryError | RuntimeError):
        return "", 1
    what = f"{name}: {error}" if str(error) else name
    return f"the program failed, which is not the input's fault ({what}); {_TRACEBACK}=1 shows where", 1


def is_inner(error: ValueError) -> bool:
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
    # the group's own messages say enough; those of a command are followed by where its options are explained
    return message if context is None or context.parent is None else f"{message} (see {context.command_path} --help)"


def _missing_package(error: ModuleNotFoundError) -> str:
    package = (error.name or "").partition(".")[0]
    if package in {"", *_OWN_PACKAGES}:
        return ""
    if "afm-jax[" in error.msg:
        # the extra is named
        return error.msg
    return f"the Python package `{package}` is missing; install it with: pip install {package}"
