"""Methods of every result: print itself, be drawn, become a table, be saved, be reported.

The decorator `public_result` gives it to named tuples, dataclasses and modules of equinox alike, from their fields
alone: units are the ends of the fields' names, dimensions those of the annotations. Batches, traced values and shapes
can be printed, too.
"""

import base64
import enum
import importlib
import math
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self, TypeVar, dataclass_transform, get_args

import numpy as np

from afm_jax.checks import in_float64, is_array
from afm_jax.columns import csv_columns, csv_text
from afm_jax.report import at_home, lines_of, page_of, pictures_of, sections, text_of
from afm_jax.saved import fields_of, is_record, save, saved
from afm_jax.strict_json import strict_json
from afm_jax.units import unit_of
from afm_jax.whole_files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame
    from xarray import Dataset

Kind = TypeVar("Kind", bound=type)


class Result:
    """The methods that `public_result` gives; what a named tuple has instead of this base: see `ResultTuple`."""

    _picture: ClassVar[str]
    _home: ClassVar[str]
    _words: ClassVar[dict[str, type[enum.IntEnum]]]

    def __repr__(self) -> str:
        (fields,) = sections.dispatch(object)(self)
        return "\n".join(lines_of(fields.title, *fields.parts))

    def __str__(self) -> str:
        return text_of(self)

    def _repr_html_(self) -> str:
        return page_of(self, template="page.body.jinja")

    def plot(self, path: str | Path | None = None, **options: Any) -> "Figure":
        """Return the picture of this result, a matplotlib figure; write it, PNG, PDF or SVG, if a path is given.

        Args:
            path: of the file; None: none is written.
            options: of the picture, such as `ordinate` of a bifurcation diagram.
        """
        figure = self._drawn(self._picture, **options)
        style = importlib.import_module("afm_jax.plots.picture_style")
        # a figure without pyplot is shown by a notebook only if it says how
        figure._repr_png_ = lambda: style.png_of(figure)
        if path is not None:
            style.save(figure, Path(path), named_by_user=True)
        return figure

    def _drawn(self, function: str, **options: Any) -> Any:
        module, _, name = function.partition(":")
        return getattr(importlib.import_module(module), name)(self, **options)

    def report(self, folder: str | Path, name: str = "", more: Sequence[Any] = ()) -> list[Path]:
        """Write this result into a folder: a page (HTML), its text, JSON, picture and CSV files; return their paths.

        Args:
            folder: made if it is not there; files of the same names are replaced.
            name: of the files; else that of its kind, such as fit.html.
            more: results whose sections follow on the page and in the text.
        """
        folder, results, data = Path(folder), (self, *more), saved(self)
        folder.mkdir(parents=True, exist_ok=True)
        name = name or data["format"].rpartition(" ")[2]
        style = importlib.import_module("afm_jax.plots.picture_style")
        figures = {function: self._drawn(function) for function in pictures_of(self) or [self._picture]}
        # SVG files have the layout of the PNG drawn before
        pixels = np.concatenate([style.pixels_of(figure, _DPI) for figure in figures.values()])
        drawn = {key: base64.b64encode(style.svg_of(figure)).decode() for key, figure in figures.items()}
        tables = csv_columns(self) or {f"{name}.csv": _columns_of_one_shape(self)[1]}
        contents: dict[str, str | bytes] = {
            f"{name}.html": page_of(*results, drawn=drawn),
            f"{name}.txt": text_of(*results) + "\n",
            f"{name}.png": style.png_of_pixels(pixels, _DPI),
            f"{name}.json": strict_json(data) + "\n",
            **{file: csv_text(columns) for file, columns in tables.items()},
        }
        for file, content in contents.items():
            write_whole(folder / file, content)
        return [folder / file for file in contents]

    def to_pandas(self) -> "DataFrame":
        """Return a result as a table of pandas; rows without a result are left out, numbers without a value NaN."""
        pandas = _needed("pandas")
        for columns in csv_columns(at_home(self)).values():
            return pandas.DataFrame(dict(columns))
        shape, columns = _columns_of_one_shape(self)
        table = pandas.DataFrame(columns)
        table.attrs = {name: value for name, value in fields_of(self) if isinstance(value, str | bool | int | float)}
        if len(shape) > 1:
            table.index = pandas.MultiIndex.from_product([range(size) for size in shape])
        return table[known_rows(self, shape).ravel()] if shape else table

    def to_xarray(self) -> "Dataset":
        """Return the arrays of a result as a data set of xarray, with their units; texts are its attributes."""
        xarray = _needed("xarray")
        sizes: dict[str, int] = {}
        variables = {}
        for name, (array, dimensions) in known_columns(self).items():
            names: list[str] = []
            for dimension, size in zip(dimensions, array.shape, strict=True):
                free = dimension not in names and sizes.setdefault(dimension, size) == size
                names.append(dimension if free else f"{name}_{dimension}_{len(names)}")
            # xarray keeps a name for a dimension's own coordinate
            own = f"{name}_value" if name in names and array.ndim > 1 else name
            variables[own] = (names, array, {"units": unit_of(name)} if unit_of(name) else {})
        attributes = {name: value for name, value in fields_of(self) if isinstance(value, str)}
        return xarray.Dataset(variables, attrs={"result": type(self).__name__} | attributes)

    def save(self, path: str | Path) -> None:
        """Write this result as a JSON file, whole or not at all; `afm_jax.load` gives it back."""
        save(self, path)


_DPI = 190.0


class JudgedResult(Result):
    """A result that is valid unless there are reasons why not."""

    reasons: Any

    @property
    def valid(self) -> bool:
        """Whether to trust it; `reasons` say why not."""
        return not self.reasons

    @property
    def reason(self) -> str | None:
        """The first of the reasons; None if it is valid."""
        return next(iter(self.reasons), None)


if TYPE_CHECKING:

    @dataclass_transform(frozen_default=True)
    class ResultTuple(Result, tuple[Any, ...]):
        """A named tuple with the methods of `Result`, as type checkers see it: Python allows it no other base."""

        __slots__ = ()
        _fields: ClassVar[tuple[str, ...]]

        def _asdict(self) -> dict[str, Any]: ...
        def _replace(self, **values: Any) -> Self: ...

else:
    ResultTuple = NamedTuple


def public_result(
    *,
    picture: str = "afm_jax.plots.results:figure_of",
    home: str = "",
    **words: type[enum.IntEnum],
) -> Callable[[Kind], Kind]:
    """Return a decorator that makes a `Result` or `ResultTuple` a result.

    Args:
        picture: the function that draws it, "module:function"; as a rule its arrays against the first of them.
        home: the module that registers how it is shown; "": that of the class.
        words: the enumeration of each field of integers that has one.
    """

    def decorate(kind: Kind) -> Kind:
        methods = {name: method for name, method in vars(Result).items() if callable(method)}
        methods["report"] = vars(kind).get("report", Result.report)
        methods = {name: in_float64(method, loaded=True) for name, method in methods.items()}
        for name, value in {**methods, "_picture": picture, "_home": home, "_words": words}.items():
            setattr(kind, name, value)
        return kind

    return decorate


def columns_of(record: Any) -> dict[str, tuple[np.ndarray, tuple[str, ...]]]:
    """Return the numbers of a record, with the names of their dimensions; those of an inner record after its name."""
    found: dict[str, tuple[np.ndarray, tuple[str, ...]]] = {}
    for name, value in fields_of(record):
        if is_record(value):
            for inner, column in columns_of(value).items():
                found[f"{name}_{inner}"] = column
        elif is_array(value) or isinstance(value, bool | int | float):
            array = np.asarray(value)
            if array.dtype.kind in "biufc":
                found[name] = array, _dimensions(type(record), name, array.ndim)
    return found


def known_columns(record: Any) -> dict[str, tuple[np.ndarray, tuple[str, ...]]]:
    """Return `columns_of` a record, NaN wherever its `_unknown` says that a number stands for no value."""
    columns = columns_of(record)
    gaps_of = getattr(record, "_unknown", dict)
    for name, gaps in gaps_of().items():
        array, dimensions = columns[name]
        columns[name] = np.where(gaps, math.nan, array), dimensions
    return columns


def _columns_of_one_shape(record: Any) -> tuple[tuple[int, ...], dict[str, np.ndarray]]:
    """Return the shape that most arrays of a record have, and these as columns."""
    columns = {name: array for name, (array, _) in known_columns(record).items()}
    shapes = [array.shape for array in columns.values() if array.ndim]
    shape = max(shapes, key=lambda each: (shapes.count(each), math.prod(each)), default=())
    return shape, {name: array.ravel() for name, array in columns.items() if array.shape == shape}


def known_rows(record: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return which rows of a record's arrays of one shape are results: those that `_known_rows`, or `exists`, says."""
    rows_of = getattr(record, "_known_rows", lambda: getattr(record, "exists", True))
    told = np.asarray(rows_of())
    return np.broadcast_to(told, shape) if told.shape in ((), shape) and shape else np.ones(shape, bool)


def _needed(package: str) -> Any:
    """Return a package of an extra of the same name."""
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        hint = f"this needs the package {package}: pip install 'afm-jax[{package}]'"
        raise ModuleNotFoundError(hint, name=package) from error


def _dimensions(kind: type, name: str, count: int) -> tuple[str, ...]:
    """Return names of an array's dimensions: those of its annotation, where that has as many."""
    annotation = _annotations(kind).get(name)
    parts = get_args(annotation) if isinstance(annotation, types.UnionType) else (annotation,)
    for part in parts:
        words = getattr(part, "dim_str", "").split()
        if len(words) == count and all(word.isidentifier() or word.isdigit() for word in words):
            return tuple(word if word.isidentifier() else f"{name}_{word}" for word in words)
    return tuple(f"dim_{number}" for number in range(count))


def _annotations(kind: type) -> dict[str, Any]:
    return {name: hint for each in kind.__mro__[::-1] for name, hint in vars(each).get("__annotations__", {}).items()}
