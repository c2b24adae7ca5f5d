"""What went into a fit: the table as it was read, the settings, the checks of the minimum, the versions."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from fitting.reporting.report_html_elements import Markup, breakable, bullets, element, section, table
from fitting.reporting.report_html_tables import MOST_ROWS, left_out
from fitting.result import FitResult
from fitting.table import AmplitudeTable
from fitting.tables.table_rows import COLUMN_NAMES


def input_section(measured: AmplitudeTable) -> Markup:
    """Return the table that was fitted: every comment, every row."""
    header = [
        ["source", measured.source],
        ["free_frequency_khz", f"{measured.free_frequency_khz:g}"],
        ["quality_factor", _quality_factor(measured)],
        ["mass_ng", f"{measured.mass_ng:g}"],
        *([name, f"{value:g} ± {error:g}"] for name, (value, error) in measured.calibration.items()),
    ]
    names = [name for name in COLUMN_NAMES if getattr(measured, name) is not None]
    columns = [measured.lines, *(getattr(measured, name) for name in names)]
    cells = (
        ["" if np.isnan(value) else f"{value:.15g}" for value in row[:MOST_ROWS]]
        for row in zip(*(column[:MOST_ROWS].tolist() for column in columns), strict=True)
    )
    remarks = [element("p", "Remarks in the file:"), bullets(measured.remarks)] if measured.remarks else []
    return section(
        "Inputs",
        table("What the table says of the instrument", ["", "value"], header, words=("value",)),
        *remarks,
        table("The table's rows; empty where nothing was measured", ["line", *map(breakable, names)], cells),
        left_out(measured.rows, "fit.json"),
        name="inputs",
    )


def _quality_factor(measured: AmplitudeTable) -> str:
    if measured.quality_factor is None:
        return "not given"
    error = measured.quality_factor_error
    return f"{measured.quality_factor:g}" + ("" if error is None else f" ± {error:g}")


def convergence_section(result: FitResult) -> Markup:
    """Return what the checks of the minimum found."""
    explained = {
        "converged": "gradient, curvature and distance are those of a minimum",
        "gradient": "largest slope of chi2, per standard error",
        "hessian_eigenvalues": "of chi2/2 in units of standard errors: about 1 each at a good minimum",
        "estimated_distance": "by how much chi2 lies above its minimum",
        "outward": "at a bound, chi2 falls towards the outside only",
    }
    rows = [[name, in_words(value), explained.get(name, "")] for name, value in asdict(result.convergence).items()]
    caption = "Checked whatever the optimiser says"
    return section("Minimum", table(caption, ["", "found", "meaning"], rows, words=("meaning",)), name="minimum")


def settings_section(result: FitResult) -> Markup:
    """Return every option of the fit and the versions of what computed it."""
    settings = [[name, in_words(value)] for name, value in result.settings.items()]
    versions = [[name, version] for name, version in result.versions.items()]
    return section(
        "Settings and versions",
        table("Options of the fit", ["option", "value"], settings, words=("value",)),
        table("Versions of what computed it", ["package", "version"], versions, words=("version",)),
        name="settings",
    )


def in_words(value: Any) -> str:
    """Return a plain value as text: numbers short, lists joined, mappings as 'name: value'."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {in_words(item)}" for name, item in value.items()) or "none"
    if isinstance(value, (list, tuple, np.ndarray)):
        return ", ".join(in_words(item) for item in value) or "none"
    return str(value)
