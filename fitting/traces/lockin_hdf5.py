"""A time trace in an HDF5 file: the data sets are named like the columns of a CSV trace, settings are attributes."""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from fitting.tables.csv_text import Faults, quoted
from fitting.traces.lockin_csv import ATTRIBUTES, ParsedTrace, wanted_columns
from fitting.traces.lockin_settings import settings_of_attributes

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""The first bytes of every HDF5 file without a user block."""


def parse_hdf5(path: Path, group: str | None, faults: Faults) -> ParsedTrace:
    """Read the data sets deflection_nm, time_us, platform_nm or drive of a file or of one of its groups.

    Attributes of the file, the group and the deflection give the settings, the last of them first.

    Args:
        path: the file.
        group: which of the file's groups; None is the file itself.
        faults: where faults are noted; with any, the result is not to be used.

    Raises:
        TableError: if the package h5py is missing, the file is damaged, or a data set is missing or no column.
    """
    h5py = _h5py(faults)
    try:
        with h5py.File(path, "r") as file:
            return _read(h5py, file, group, faults)
    except OSError as error:
        faults.add(f"cannot be read as HDF5 ({' '.join(str(error).split())}); save it again")
        faults.raise_any()
        raise


def _h5py(faults: Faults) -> Any:
    """Return the optional package, which has no annotations that could be checked where it is not installed."""
    try:
        return import_module("h5py")
    except ModuleNotFoundError:
        faults.add("is an HDF5 file, which needs the package h5py; install it with: pip install h5py, or save as CSV")
        faults.raise_any()
        raise


def _read(h5py: Any, file: Any, group: str | None, faults: Faults) -> ParsedTrace:
    place = file if group is None else file.get(group)
    if not isinstance(place, h5py.Group):
        groups = _groups_with_deflection(h5py, file)
        faults.add(
            f"there is no group {quoted(str(group))}; those with deflection_nm are {', '.join(groups) or 'none'}"
        )
        faults.raise_any()
    names = [name for name, item in place.items() if isinstance(item, h5py.Dataset)]
    inner = _groups_with_deflection(h5py, place)
    if not any(ATTRIBUTES.get(name) == "deflection_nm" for name in names) and inner:
        choice = f" (there are {', '.join(inner)})" if inner[1:] else ""
        faults.add(f"there is no data set deflection_nm here; name its group: --group {inner[0]}{choice}")
        faults.raise_any()
    wanted = wanted_columns(names, faults)
    faults.raise_any()
    columns = {ATTRIBUTES[name]: _column(name, place[name], faults) for name in wanted}
    faults.raise_any()
    attributes = dict(file.attrs) | dict(place.attrs)
    for name in wanted:
        if ATTRIBUTES[name] == "deflection_nm":
            attributes |= dict(place[name].attrs)
    return ParsedTrace(columns, settings_of_attributes(attributes, faults), "platform_nm" in wanted)


def _groups_with_deflection(h5py: Any, place: Any) -> list[str]:
    """Return the names, from the file on, of all groups below a place that hold a deflection."""
    found: list[str] = []

    def visit(_: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and ATTRIBUTES.get(item.name.rsplit("/", 1)[1]) == "deflection_nm":
            found.append(item.parent.name.strip("/"))

    place.visititems(visit)
    return [name for name in dict.fromkeys(found) if name]


def _column(name: str, dataset: Any, faults: Faults) -> np.ndarray:
    if dataset.ndim != 1 or dataset.dtype.kind not in "fiu":
        faults.add(
            f"the data set has shape {dataset.shape} and type {dataset.dtype}; give one row of numbers", column=name
        )
        return np.zeros(0)
    return np.asarray(dataset[...], dtype=np.float64)
