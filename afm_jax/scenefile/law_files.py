"""Files that hold an impact law: a fit's, a contact's, or a table of speeds that somebody measured.

Takes a path; gives a `TabulatedLaw`: speeds in nm/us, delays in us, mass in ng (eq. 6 stands beside the table).

Three kinds, recognized by their content: the fit.json of a fit's report, the JSON that `save_law` writes, and a CSV
with a column of approach speeds, one of rebound speeds, and maybe one of delays, named as below. A tip that
is captured leaves at 0, or has a blank cell where a column `captured` says true (as of `collide --out`):

    # mass_ng = 1.2
    # origin = laser and lamp, March
    approach_speed_nm_per_us, rebound_speed_nm_per_us, rebound_speed_error_nm_per_us
    12.5, 5.9, 0.1
"""

import csv
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from afm_jax.checks import check_parameter, checked
from afm_jax.impact.law import TabulatedLaw, law_of_dict
from afm_jax.saved import FIT_FORMAT, as_json, why_no_fit
from afm_jax.scenefile.tables import SceneError, read_text
from afm_jax.strict_json import strict_json
from afm_jax.whole_files import write_whole
from afm_jax.words import printable

FORMAT, FORMAT_VERSION = "afm-jax law", 1
_APPROACH = "approach_speed_nm_per_us"
_REBOUND = "rebound_speed_nm_per_us"
_DELAY = "collision_delay_us"
_ERRORS = ("rebound_speed_error_nm_per_us", "collision_delay_error_us")
_COLUMNS = (_APPROACH, _REBOUND, _ERRORS[0], _DELAY, _ERRORS[1])
_BESIDES = ("rebound_low", "rebound_high", "delay_low", "delay_high", "captured", "outcome", "time_in_", "deepest_gap_")
_BESIDES += ("bridge_", "junction_", "viscous_loss_", "end_energy_")
"""How other columns begin: the band of a fit's law, which cannot be drawn from a table alone, and what collisions
are written with."""
_WRITTEN = (_APPROACH, _REBOUND, "rebound_low_nm_per_us", "rebound_high_nm_per_us")
_WRITTEN += (_DELAY, "delay_low_us", "delay_high_us")


@checked
def load_law(path: str | os.PathLike[str]) -> TabulatedLaw:
    """Read an impact law from a file: a fit's fit.json or law.csv, what `collide --make-law` wrote, or a measured CSV.

    Args:
        path: the file, or the folder of a report.

    Raises:
        ValueError: if it cannot be read, is none of these, is of an older version, or its speeds are no law; one line.
    """
    return law_and_fit(path)[0]


def law_and_fit(path: str | os.PathLike[str]) -> tuple[TabulatedLaw, Mapping[str, Any]]:
    """Return the law of a file, and where it is a fit's the whole object of its JSON, else nothing.

    Raises:
        ValueError: as `load_law`.
    """
    if Path(path).is_dir():
        # of a report
        path = next((Path(path) / name for name in ("law.json", "fit.json") if (Path(path) / name).exists()), path)
    text = read_text(path)
    try:
        if Path(path).suffix == ".json" or text.lstrip().startswith("{"):
            return _of_json(text)
        return _of_csv(text), {}
    except ValueError as error:
        raise SceneError(f"{printable(os.fspath(path))}: {error}") from error


@checked
def save_law(law: TabulatedLaw, path: str | os.PathLike[str]) -> None:
    """Write a law to a JSON file from which `load_law` returns an equal one, errors included.

    Raises:
        OSError: if the file cannot be written.
    """
    write_whole(path, strict_json({"format": FORMAT, "format_version": FORMAT_VERSION, **as_json(law)}) + "\n")


def save_law_csv(law: TabulatedLaw, path: str | os.PathLike[str]) -> None:
    """Write a law's table to a CSV that `load_law` reads: its columns with their units, mass and origin."""
    told = as_json(law)
    comments = [f"# {key} = {told[key]}" for key in ("mass_ng", "origin", "capture_speed_nm_per_us") if key in told]
    if told.get("corrections") is False:
        comments.append("# corrections = false")
    names = [name for name in _WRITTEN if name in told]
    rows = zip(*(told[name] for name in names), strict=True)
    lines = [",".join("" if number is None else repr(number) for number in row) for row in rows]
    write_whole(path, "\n".join([*comments, ",".join(names), *lines]) + "\n")


_GIVE = "give a fit.json of `afm-jax fit --out`, a law.json of `afm-jax collide --make-law` or a CSV of speeds"


def _of_json(text: str) -> tuple[TabulatedLaw, Mapping[str, Any]]:
    try:
        contents = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"line {getattr(error, 'lineno', 1)} is no JSON; {_GIVE}") from None
    kind = contents.get("format") if isinstance(contents, dict) else None
    if kind not in (FORMAT, FIT_FORMAT):
        raise ValueError(f"holds no law; {_GIVE}")
    mend = "write it anew with `afm-jax collide --make-law --out DIR`"
    if kind == FIT_FORMAT:
        wrong = why_no_fit(contents)
        if wrong is not None:
            raise ValueError(wrong)
        if not contents.get("valid"):
            raise ValueError("the fit is not valid, and neither is its law; give a valid one")
        mend = "fit again with `afm-jax fit TABLE --out DIR`"
    elif contents.get("format_version") != FORMAT_VERSION:
        raise ValueError(f"has format_version {contents.get('format_version')}, not {FORMAT_VERSION}; {mend}")
    try:
        fitted = kind == FIT_FORMAT
        return law_of_dict(contents["law"] if fitted else contents), contents if fitted else {}
    except (ArithmeticError, AttributeError, LookupError, TypeError) as error:
        # an entry of another kind than is written there
        raise ValueError(f"its law is damaged; {mend}") from error


def _of_csv(text: str) -> TabulatedLaw:
    rows = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    comments = [line.lstrip("# \t").partition("=") for _, line in rows if line.startswith("#")]
    settings = {key.strip(): value.strip() for key, equals, value in comments if equals}
    lines = [(number, line) for number, line in rows if not line.startswith("#")]
    if not lines:
        raise ValueError("is empty: a law needs a column of approach speeds and one of rebound speeds")
    delimiter = next((mark for mark in (",", ";", "\t") if mark in lines[0][1]), ",")
    names, *cells = (
        [cell.strip() for cell in row] for row in csv.reader((line for _, line in lines), delimiter=delimiter)
    )
    _check_columns(names)
    values: dict[str, list[float]] = {name: [] for name in _COLUMNS if name in names}
    for (number, _), row in zip(lines[1:], cells, strict=True):
        if len(row) != len(names):
            raise ValueError(f"line {number} has {len(row)} values for {len(names)} columns")
        cell = dict(zip(names, row, strict=True))
        stays = cell.get("captured", "").lower() == "true"
        for name, column in values.items():
            column.append(0.0 if stays and not cell[name] else _number(cell[name], f"line {number}: `{name}`"))
    return _law_of_columns({name: np.array(column) for name, column in values.items()}, settings)


def _law_of_columns(values: Mapping[str, np.ndarray], settings: Mapping[str, str]) -> TabulatedLaw:
    """Return the law of columns and of what the comments say of it."""
    options: dict[str, Any] = {"origin": settings.get("origin", "")}
    for key in ("mass_ng", "capture_speed_nm_per_us"):
        options[key] = _number(settings[key], f"`# {key}`") if key in settings else None
    corrections = settings.get("corrections", "true")
    if corrections not in ("true", "false"):
        raise ValueError(f"`# corrections` must be true or false, but is {corrections!r}")
    delay = values.get(_DELAY)
    # how a fit of instantaneous impacts writes its law
    delay = None if delay is not None and not delay.any() else delay
    columns = values[_APPROACH], values[_REBOUND], delay
    errors = [values.get(name, np.zeros(len(columns[0]))) for name in _ERRORS]
    for name, column in zip(_ERRORS, errors, strict=True):
        check_parameter(name, column, "not negative")
    if any(name in values for name in _ERRORS):
        # every reading has its own
        changes, rows = np.diag(np.concatenate(errors)), len(columns[0])
        options |= {"rebound_changes": changes[:, :rows], "delay_changes": None if delay is None else changes[:, rows:]}
        law = TabulatedLaw.with_errors(*columns, **options)
    else:
        law = TabulatedLaw(*columns, **options)
    if law.delay is None or corrections == "true":
        return law
    return eqx.tree_at(lambda law: law.delay, law, replace(law.delay, corrections=False))


def _check_columns(names: list[str]) -> None:
    """Check that a table has the columns that a law needs, each once, and no others than are known."""
    for name in names:
        if name not in _COLUMNS and not name.startswith(_BESIDES):
            raise ValueError(f"column {printable(name)} is none of a law's; it has {', '.join(_COLUMNS)}")
        if names.count(name) > 1:
            raise ValueError(f"has two columns {name}")
    for name in (_APPROACH, _REBOUND):
        if name not in names:
            raise ValueError(f"has no column {name}; it has {', '.join(names)}")


def _number(text: str, what: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{what} must be a number, but is {text!r}") from None
