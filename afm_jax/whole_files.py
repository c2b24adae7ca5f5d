"""Files that appear whole or not at all, as every command writes them, and files read whole, up to a size."""

import errno
import os
import secrets
from pathlib import Path

LARGEST_BYTES = 1 << 30
"""Of what is read: a device or a pipe without end would fill the memory."""


def read_whole(path: str | os.PathLike[str]) -> bytes:
    """Return what a file, a device or a pipe holds.

    Raises:
        OSError: if it cannot be read, or holds too much.
    """
    with Path(path).open("rb") as file:
        data = file.read(LARGEST_BYTES + 1)
    if len(data) > LARGEST_BYTES:
        raise OSError(errno.EFBIG, f"it holds more than {LARGEST_BYTES:,} bytes", os.fspath(path))
    return data


def write_whole(path: str | os.PathLike[str], content: str | bytes, *, synced: bool = True) -> None:
    """Write a file whole or not at all: beside its place, and then there in one step; one that was there is replaced.

    A device or a pipe is written to as it is.

    Args:
        path: of the file.
        content: bytes, or a text to be encoded as UTF-8; what no encoding has, as in names of files, is escaped.
        synced: whether it must outlast a power cut, too, which takes the disk's time.

    Raises:
        OSError: naming the file, if it cannot be written; what was there before is still there.
    """
    place = Path(path)
    data = content if isinstance(content, bytes) else content.encode("utf-8", errors="backslashreplace")
    # through links: the file that is meant is replaced, not the link to it
    target = Path(os.path.realpath(place))
    try:
        if target.exists() and not target.is_file():
            target.write_bytes(data)
            return
        fresh = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
        try:
            with fresh.open("xb") as file:
                file.write(data)
                if synced:
                    file.flush()
                    os.fsync(file.fileno())
            fresh.replace(target)
        except BaseException:
            fresh.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OSError(error.errno, f"cannot be written ({error.strerror})", str(place)) from error
