"""Amplitude tables as text, and the message that a faulty one is refused with."""

from pathlib import Path

import pytest

from fitting.tables.csv_text import TableError
from fitting.tables.table import read_table

KEY = "# free_frequency_khz = 90\n"
NAMES = "order,drive_frequency_khz,drive_amplitude_nm,offset_nm,peak_amplitude_nm,peak_amplitude_error_nm\n"
ROW = "1,180,4,0,163.3,1.63\n"


def message_of(path: str | Path, noise: float | None = None) -> str:
    """Return the message of the error without the path in front; it must be one line."""
    with pytest.raises(TableError) as caught:
        read_table(path, noise)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert message.isprintable()
    return message.removeprefix(str(path)).lstrip(",: ")


def fault_of(folder: Path, data: str | bytes, noise: float | None = None) -> str:
    path = folder / "table.csv"
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return message_of(path, noise)
