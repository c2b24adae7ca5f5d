"""What is wrong with an amplitude table: one error, one line, and a collector that keeps the first of many faults."""

from dataclasses import dataclass, field


class TableError(ValueError):
    """An amplitude table that cannot be used; the message is one line: what, where, how to mend it."""


@dataclass
class Faults:
    """Keeps the fault that comes first in the file and counts the others.

    Attributes:
        source: the table's name, as it begins every message.
        place: what a row's number is called, "line" for a file and "row" for a table in memory.
        count: how many faults were noted.
    """

    source: str
    place: str = "line"
    count: int = field(default=0, init=False)
    _first: tuple[int, str] | None = field(default=None, init=False)

    def add(self, message: str, *, line: int = 0, column: str | None = None) -> None:
        """Note a fault.

        Args:
            message: what is wrong and how to mend it, without the place.
            line: number of the line (or row) it is in; 0 stands for the table as a whole and comes first.
            column: name of the column it is in.
        """
        self.count += 1
        if self._first is not None and self._first[0] <= line:
            return
        place = printable(self.source)
        if line:
            place += f", {self.place} {line}"
        if column is not None:
            place += f", column {column}"
        self._first = (line, f"{place}: {message}")

    def raise_any(self) -> None:
        """Raise the first fault, if there is one.

        Raises:
            TableError: with the first fault and the number of the others.
        """
        if self._first is None:
            return
        message = self._first[1]
        if self.count > 1:
            message += f" (and {self.count - 1} more fault{'s' if self.count > 2 else ''})"
        raise TableError(message)


def printable(text: str) -> str:
    """Return a text that fits on one line of a message: escaped where it holds line breaks or control characters."""
    return text if text.isprintable() else repr(text)


def quoted(text: str) -> str:
    """Return a piece of the file for a message: in quotation marks, escaped, and cut after 40 characters."""
    return repr(text if len(text) <= 40 else text[:40] + "...")
