"""Files that appear whole or not at all, as every command writes them, and files read whole, up to a size.

Texts are written in the caller's words: a command names its options where the library names arguments.

A folder of results may come from somebody else: what lies in it is never followed where it is a link, so that nothing
outside the folder is overwritten. Only a path that the user named as the one to write may be the user's own link.
"""

import errno
import io
import os
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

LARGEST_BYTES = 1 << 30
"""Of what is read: a device or a pipe without end would fill the memory."""
MOST_VALUES = LARGEST_BYTES // 8
"""Of what a file says that it holds, in all its columns: as many 64-bit numbers as there are such bytes."""


def read_whole(path: str | os.PathLike[str]) -> bytes:
    """Return what a file, a device or a pipe holds.

    Raises:
        OSError: if it cannot be read, or holds too much.
    """
    whole = bytearray()
    with io.FileIO(path) as file:
        while len(whole) <= LARGEST_BYTES and (part := file.read(min(_PART, LARGEST_BYTES + 1 - len(whole)))):
            whole += part
    if len(whole) > LARGEST_BYTES:
        raise OSError(errno.EFBIG, f"it holds more than {LARGEST_BYTES:,} bytes", os.fspath(path))
    return bytes(whole)


_PART = 1 << 20


def first_bytes(path: str | os.PathLike[str], count: int) -> bytes:
    """Return how a file begins; nothing of a device or a pipe, whose bytes can be read only once.

    Raises:
        OSError: if it cannot be read.
    """
    if not Path(path).is_file():
        return b""
    with Path(path).open("rb") as file:
        return file.read(count)


def check_plain(path: str | os.PathLike[str]) -> None:
    """Check that there is no link, device or pipe at a path; there may be nothing.

    Raises:
        OSError: that names it and how to mend it.
    """
    try:
        mode = Path(path).lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        what = "a link, which is not followed" if stat.S_ISLNK(mode) else "a device or a pipe, not a file"
        raise OSError(errno.EINVAL, f"is {what}; delete it or choose another folder", str(path))


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Give a new folder to be filled, which then takes the place of the one at a path, whole or not at all.

    Raises:
        OSError: if there is a link or a file at the path, or the folder cannot be made.
    """
    check_plain(path)
    fresh = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    fresh.mkdir()
    try:
        yield fresh
        if path.exists():
            shutil.rmtree(path)
        fresh.rename(path)
    except BaseException:
        shutil.rmtree(fresh, ignore_errors=True)
        raise


@contextmanager
def arguments_named(words: Callable[[str], str]) -> Iterator[None]:
    """Within this block all that is printed or written is passed through a function, which names arguments otherwise.

    >>> with arguments_named(lambda text: text.replace("`order=1`", "--order 1")):
    ...     in_callers_words("try `order=1`")
    'try --order 1'
    """
    before = _named.set(words)
    try:
        yield
    finally:
        _named.reset(before)


def in_callers_words(text: str) -> str:
    """Return a text as the caller reads it: a command names its options where the library names arguments."""
    words = _named.get()
    return text if words is None else words(text)


_named: ContextVar[Callable[[str], str] | None] = ContextVar("_named", default=None)


def write_whole(path: str | os.PathLike[str], content: str | bytes, *, named_by_user: bool = False) -> None:
    """Write a file whole or not at all: beside its place, and then there in one step; one that was there is replaced.

    Args:
        path: of the file.
        content: bytes, or a text, in the caller's words (`in_callers_words`), to be encoded as UTF-8; what no encoding
            has, as in names of files, is escaped.
        named_by_user: whether the user gave this very path: a link there is followed, a device or a pipe written to;
            else it must be none of these.

    Raises:
        OSError: naming the file, if it cannot be written; what was there before is still there.
    """
    place = Path(path)
    if isinstance(content, str):
        content = in_callers_words(content).encode("utf-8", errors="backslashreplace")
    # through links of the user: the file that is meant is replaced, not the link to it
    target = Path(os.path.realpath(place)) if named_by_user else place
    try:
        if not named_by_user:
            check_plain(place)
        elif target.exists() and not target.is_file():
            target.write_bytes(content)
            return
        fresh = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
        try:
            with fresh.open("xb") as file:
                file.write(content)
                # it must outlast a power cut, too
                file.flush()
                os.fsync(file.fileno())
            fresh.replace(target)
        except BaseException:
            fresh.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OSError(error.errno, f"cannot be written ({error.strerror})", str(place)) from error
