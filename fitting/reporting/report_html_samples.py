"""What stands beside a fit, as tables: other models of the same amplitudes, a bootstrap, a posterior."""

from collections.abc import Mapping, Sequence
from typing import Any

from fitting.reporting.report_extras import Comparison, Sampled
from fitting.reporting.report_html_elements import Markup, element, section, table
from fitting.reporting.report_html_inputs import in_words

_COLUMNS = {
    "model": "model",
    "chi2": "chi2",
    "degrees_of_freedom": "dof",
    "aic": "AIC",
    "bic": "BIC",
    "delta_aic": "AIC above the best",
    "law_change": "change of the law",
}
_ENDS = 2
_LONGEST = 12
"""Lists longer than that are samples, not findings."""


def comparison_section(comparison: Comparison) -> Markup:
    """Return the models side by side, with what that says."""
    others = dict.fromkeys(name for row in comparison.rows for name in row if name not in _COLUMNS)
    names = [*(name for name in _COLUMNS if any(name in row for row in comparison.rows)), *others]
    rows = [[in_words(row.get(name)) for name in names] for row in comparison.rows]
    body = table("Models of the same amplitudes", [_COLUMNS.get(name, name) for name in names], rows)
    return section("Comparison of models", element("p", comparison.verdict), body, name="comparison")


def sampled_section(title: str, sampled: Sampled, parameters: Sequence[str]) -> Markup:
    """Return what a bootstrap or a posterior found: a row for each parameter, and everything else by name.

    Args:
        title: the section's heading.
        sampled: what was found.
        parameters: the fit's parameters; a mapping with these keys is a column.
    """
    said = sampled.to_dict()
    found = {name: value for name, value in _flat(said, parameters).items() if value is not None and not _long(value)}
    columns = {name: value for name, value in found.items() if _by_parameter(value, parameters)}
    others = {name: value for name, value in found.items() if name not in columns}
    parts = []
    if said.get("converged") is False:
        parts.append(element("p", element("strong", "Not converged: do not use these numbers.")))
    if columns:
        rows = [[name, *(_cell(column.get(name)) for column in columns.values())] for name in parameters]
        parts.append(table("By parameter", ["parameter", *map(_title, columns)], rows))
    if others:
        rows = [[_title(name), in_words(value)] for name, value in others.items()]
        parts.append(table("Besides", ["", "value"], rows, words=("value",)))
    return section(title, *parts, name=title.lower())


def _title(name: str) -> str:
    return name.removeprefix("parameters ").replace("interval95", "95 % interval").replace("_", " ")


def _cell(value: Any) -> str:
    """Return a value, or an interval as '0.9 to 0.99'."""
    if isinstance(value, (list, tuple)) and len(value) == _ENDS:
        return " to ".join(in_words(end) for end in value)
    return "-" if value is None else in_words(value)


def _flat(found: Mapping[str, Any], parameters: Sequence[str], before: str = "") -> dict[str, Any]:
    """Return what was found with the names of nested mappings joined, down to mappings by parameter."""
    flat = {}
    for name, value in found.items():
        if isinstance(value, Mapping) and value and not _by_parameter(value, parameters):
            flat |= _flat(value, parameters, f"{before}{name} ")
        elif _by_parameter(value, parameters) and all(isinstance(item, Mapping) for item in value.values()):
            inner = dict.fromkeys(key for item in value.values() for key in item)
            flat |= {f"{before}{name} {key}": {p: item.get(key) for p, item in value.items()} for key in inner}
        else:
            flat[f"{before}{name}"] = value
    return flat


def _by_parameter(value: Any, parameters: Sequence[str]) -> bool:
    return isinstance(value, Mapping) and bool(value) and set(value) <= set(parameters)


def _long(value: Any) -> bool:
    """Say whether a value holds more numbers than one reads."""
    if isinstance(value, Mapping):
        return any(_long(item) for item in value.values())
    return isinstance(value, (list, tuple)) and (
        len(value) > _LONGEST or any(isinstance(v, (list, tuple)) for v in value)
    )
