"""Methods of every result: print itself in a few lines, be drawn, become a table, be saved.

The decorator `public_result` gives it to named tuples, dataclasses and modules of equinox alike, from their fields
alone: units are the ends of the fields' names, dimensions those of the annotations. Batches, traced values and shapes
can be printed, too.
"""

import enum
import importlib
import io
import math
import types
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self, TypeVar, dataclass_transform, get_args

import numpy as np

from afm_jax.checks import in_float64, is_array
from afm_jax.saved import fields_of, is_abstract, is_record, save
from afm_jax.units import unit_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame
    from rich.table import Table
    from xarray import Dataset

Kind = TypeVar("Kind", bound=type)
MOST_LINES = 20
_WIDTH = 110
_UNBROKEN = 10_000
"""Columns of a text in which no line is broken."""
_SHOWN = 5


class Result:
    """The methods that `public_result` gives; what a named tuple has instead of this base: see `ResultTuple`."""

    _picture: ClassVar[str]
    _rows: ClassVar[str]
    _words: ClassVar[dict[str, type[enum.IntEnum]]]

    def __repr__(self) -> str:
        return text_of(self)

    def text(self) -> str:
        """Return what the command that computes this result prints; of a result without one its fields in 20 lines."""
        printed = getattr(self, "printed", None)
        return text_of(self) if printed is None else text_of_parts(printed())

    def plot(self, path: str | Path | None = None, **options: Any) -> "Figure":
        """Return the picture of this result, a matplotlib figure; write it, PNG, PDF or SVG, if a path is given.

        Args:
            path: of the file; None: none is written.
            options: of the picture, such as `ordinate` of a bifurcation diagram.
        """
        module, _, name = self._picture.partition(":")
        figure = getattr(importlib.import_module(module), name)(self, **options)
        style = importlib.import_module("afm_jax.plots.picture_style")
        # a figure without pyplot is shown by a notebook only if it says how
        figure._repr_png_ = lambda: style.png_of(figure)
        if path is not None:
            style.save(figure, Path(path), named_by_user=True)
        return figure

    def to_pandas(self) -> "DataFrame":
        """Return a result as a table of pandas; rows without a result are left out, numbers without a value NaN."""
        pandas = _needed("pandas")
        if self._rows:
            records: Any = getattr(self, self._rows)
            records = records() if callable(records) else records
            if isinstance(records, Mapping):
                plain = {name: dict(fields_of(each)) if is_record(each) else each for name, each in records.items()}
                return pandas.DataFrame.from_dict(plain, orient="index")
            return pandas.DataFrame(list(records))
        columns = {name: array for name, (array, _) in known_columns(self).items()}
        shapes = [array.shape for array in columns.values() if array.ndim]
        shape = max(shapes, key=lambda each: (shapes.count(each), math.prod(each)), default=())
        table = pandas.DataFrame({name: array.ravel() for name, array in columns.items() if array.shape == shape})
        table.attrs = {name: value for name, value in fields_of(self) if isinstance(value, str | bool | int | float)}
        if len(shape) > 1:
            table.index = pandas.MultiIndex.from_product([range(size) for size in shape])
        known = known_rows(self, shape).ravel()
        return table if known.all() else table[known]

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

    @property
    def verdict(self) -> str:
        """The first words of its text."""
        return "VALID" if self.valid else "NOT VALID"


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
    *, picture: str = "afm_jax.plots.results:figure_of", rows: str = "", **words: type[enum.IntEnum]
) -> Callable[[Kind], Kind]:
    """Return a decorator that makes a `Result` or `ResultTuple` a result.

    Args:
        picture: the function that draws it, "module:function"; as a rule its arrays against the first of them.
        rows: the method or attribute that gives its table as mappings; as a rule the arrays of one shape are columns.
        words: the enumeration of each field of integers that has one.
    """

    def decorate(kind: Kind) -> Kind:
        methods = {name: method for name, method in vars(Result).items() if callable(method)}
        if "to_dict" in vars(kind):
            methods["to_dict"] = vars(kind)["to_dict"]
        methods = {name: in_float64(method, loaded=True) for name, method in methods.items()}
        for name, value in {**methods, "_picture": picture, "_rows": rows, "_words": words}.items():
            setattr(kind, name, value)
        return kind

    return decorate


def text_of(self: Any) -> str:
    """Return a result in at most 20 lines: a field each, arrays by their range, outcomes in words."""
    lines = _lines(self)
    widest = max((len(name) for name, _ in lines), default=0)
    return "\n".join([f"{type(self).__name__}:", *(f"  {name:<{widest}}  {text}" for name, text in lines)])


def text_of_parts(parts: "Iterable[str | Table | None]") -> str:
    """Return sentences and tables to print as one text; None says nothing."""
    from rich.console import Console  # noqa: PLC0415 (help is there without it)

    text = io.StringIO()
    console = Console(file=text, width=_UNBROKEN)
    for part in parts:
        if part is not None:
            is_text = isinstance(part, str)
            console.print(part, markup=not is_text, highlight=not is_text, soft_wrap=is_text)
    return text.getvalue().rstrip("\n")


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


def _lines(record: Any) -> list[tuple[str, str]]:
    """Return names and texts of a record's fields, as many as a text may have lines."""
    words = getattr(type(record), "_words", {})
    lines = [(name, _in_words(value, words.get(name))) for name, value in fields_of(record)]
    lines = [(name, text if len(text) <= _WIDTH else f"{text[: _WIDTH - 4]} ...") for name, text in lines]
    if len(lines) < MOST_LINES:
        return lines
    names = ", ".join(name for name, _ in lines[MOST_LINES - 2 :])
    return [*lines[: MOST_LINES - 2], ("and", names[:_WIDTH])]


def _in_words(value: Any, words: type[enum.IntEnum] | None = None) -> str:  # noqa: PLR0911 (one return a kind of value)
    if value is None:
        return "none"
    if is_abstract(value):
        return f"{value.dtype}[{','.join(map(str, value.shape))}]"
    if is_array(value) or isinstance(value, bool | int | float):
        return _numbers_in_words(np.asarray(value), words)
    if isinstance(value, str | Path):
        return " ".join(str(value).split()) or "''"
    if is_record(value):
        return f"{type(value).__name__}({', '.join(f'{name} {_in_words(item)}' for name, item in fields_of(value))})"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_in_words(item)}" for key, item in value.items()) or "nothing"
    if isinstance(value, list | tuple):
        more = [f"and {len(value) - _SHOWN} more"] * (len(value) > _SHOWN)
        return "; ".join([*map(_in_words, value[:_SHOWN]), *more]) or "nothing"
    return "a function" if callable(value) else type(value).__name__


def _numbers_in_words(array: np.ndarray, words: type[enum.IntEnum] | None) -> str:
    flat = array.ravel()
    shape = "" if array.ndim < 2 and flat.size <= _SHOWN else f"({', '.join(map(str, array.shape))}) "
    if words is not None:
        names = {int(each): each.name.lower().replace("_", " ") for each in words}
        if flat.size == 1:
            return getattr(words(flat[0]), "sentence", names[flat[0]]) if flat[0] in names else str(flat[0])
        return shape + ", ".join(f"{count} {names.get(n, n)}" for n, count in Counter(flat.tolist()).items())
    if flat.dtype.kind not in "biufc":
        return f"{shape}{flat.dtype}"
    if flat.size <= _SHOWN:
        # of several numbers those that are not known are dashes, as in tables
        unknown = "-" if flat.size > 1 else "not known"
        return shape + (", ".join(_one(each, unknown) for each in flat.tolist()) or "nothing")
    if flat.dtype.kind == "b":
        return f"{shape}{flat.sum()} of {flat.size} yes"
    size = np.abs(flat) if flat.dtype.kind == "c" else flat
    finite = size[np.isfinite(size)]
    ends = "none known" if not finite.size else f"{_one(finite.min().item())} to {_one(finite.max().item())}"
    unknown = flat.size - finite.size
    return f"{shape}{ends}" + (f", {unknown} not known" if unknown and finite.size else "")


def _one(value: Any, unknown: str = "not known") -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return unknown if value != value else f"{value:.6g}"  # noqa: PLR0124 (NaN alone is not itself)
