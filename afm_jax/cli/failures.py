"""How a command ends: exit codes, and one line on standard error for whatever went wrong.

0: done. 1: nobody reads the output any more (closed pipe). 2: the call or the data are wrong. 3: ran, but the result
is not valid. 130: interrupted.
"""

from collections.abc import Callable

import click

_OWN_PACKAGES = ("afm_jax", "fitting")


class NotValid(Exception):  # noqa: N818
    """The command ran and has printed its output, but the result is not valid; the message says why."""


def exit_code_of(run: Callable[[], object]) -> int:
    """Run a command line and return its exit code, after one line on standard error if it failed.

    Args:
        run: the command line without arguments; what it returns matters only if it is an exit code.

    Raises:
        Exception: what the user cannot mend, a mistake in this program, passes through with its traceback.
    """
    try:
        code = run()
    except (NotValid, click.Abort, click.ClickException, ModuleNotFoundError, OSError, ValueError) as error:
        line, code = _verdict(error)
        if not line:
            raise
        click.echo(f"afm-jax: {' '.join(line.split())}", err=True)
    return code if isinstance(code, int) else 0


def _verdict(error: Exception) -> tuple[str, int]:
    """Return what to say of a failure and the exit code; nothing where it is no fault of the user."""
    match error:
        case NotValid():
            return f"not valid: {error}", 3
        case click.Abort():
            return "interrupted", 130
        case click.ClickException():
            return _called_wrongly(error), 2
        case ModuleNotFoundError():
            return _missing_package(error), 2
        case OSError():
            where = f"{error.filename}: " if error.filename else ""
            return f"{where}{error.strerror or error}", 2
        case _:
            # ValueError, thus also TableError, SceneError and the checks of the objects: the data are wrong
            return str(error) or type(error).__name__, 2


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
