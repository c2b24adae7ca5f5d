"""The file of an amplitude table, from bytes to text."""

from pathlib import Path

from fitting.tables.table_faults import TableError, printable


def read_text(path: str | Path) -> str:
    """Return the text of a UTF-8 file, with or without a byte order mark, with every line end as a newline.

    Args:
        path: the file.

    Raises:
        TableError: if there is no such file, it cannot be read or is not UTF-8 text.
    """
    name = printable(str(path))
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise TableError(f"{name}: there is no such file; check the path") from None
    except IsADirectoryError:
        raise TableError(f"{name}: is a folder; give the path of a CSV file") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise TableError(f"{name}: cannot be read ({reason}); check the path and its permissions") from error
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    try:
        text = data.decode("utf-8-sig")
        # UTF-16 of plain English is valid UTF-8 with a zero byte in front of every letter.
        start = text.find("\0")
    except UnicodeDecodeError as error:
        text, start = data[: error.start].decode("utf-8", errors="replace"), error.start
    if start >= 0:
        line = text.count("\n", 0, start) + 1
        raise TableError(f"{name}, line {line}: is not UTF-8 text; save the table as CSV with the encoding UTF-8")
    return text
