"""A fit as one HTML file: the verdict and the law on the first screen, everything else below.

The file needs nothing besides itself: pictures are inside, there are no scripts, and its content security policy
forbids a browser to load anything.
"""

from fitting.reporting.report_extras import Comparison, Sampled
from fitting.reporting.report_html_elements import Markup, bullets, element, picture, section, table
from fitting.reporting.report_html_inputs import convergence_section, input_section, settings_section
from fitting.reporting.report_html_opening import opening
from fitting.reporting.report_html_samples import comparison_section, sampled_section
from fitting.reporting.report_html_style import STYLE
from fitting.reporting.report_html_tables import correlation_section, parameter_section, rows_section
from fitting.reporting.report_law_points import law_points
from fitting.reporting.report_plot import has_delay, law_figure, rows_figure, speed_figure
from fitting.result import FitResult

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def fit_page(
    result: FitResult,
    *,
    comparison: Comparison | None = None,
    bootstrap: Sampled | None = None,
    posterior: Sampled | None = None,
) -> str:
    """Return the page; it is well-formed XML too.

    Args:
        result: the fit.
        comparison: other models of the same table, or None.
        bootstrap: intervals from synthetic data sets, or None.
        posterior: credible intervals, or None.
    """
    names = list(result.parameters)
    sections = [
        _notes_section(result),
        _pictures_section(result),
        parameter_section(result),
        correlation_section(result),
        *([comparison_section(comparison)] if comparison is not None else []),
        *([sampled_section("Bootstrap", bootstrap, names)] if bootstrap is not None else []),
        *([sampled_section("Posterior", posterior, names)] if posterior is not None else []),
        rows_section(result),
        convergence_section(result),
        input_section(result.table),
        settings_section(result),
    ]
    title = f"Impact law of {result.table.source}"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", f"{'VALID' if result.valid else 'NOT VALID'}: {title}"),
        element("style", Markup(STYLE)),
    )
    body = element("body", element("main", element("h1", title), opening(result, comparison), *sections))
    return f"<!DOCTYPE html>\n{element('html', head, Markup(body), lang='en')}\n"


def _notes_section(result: FitResult) -> Markup:
    notes = bullets(result.warnings) if result.warnings else element("p", "None.")
    return section("What to know besides", notes, name="notes")


def _pictures_section(result: FitResult) -> Markup:
    rows = "Amplitudes of each row, measured and predicted; below, how far apart they are in standard errors."
    law = "Rebound speed and energy lost over the approach speed, with their 95 % bands."
    if has_delay(result):
        law = "Rebound speed, energy lost and collision delay over the approach speed, with their 95 % bands."
    if not result.valid:
        law += " Not a measurement: see the verdict."
    speed = (
        "What is left of each amplitude over the approach speed, in standard errors: a wrong law leaves a curve here."
    )
    return section(
        "Pictures",
        picture(rows_figure(result), shows=rows),
        picture(law_figure(result), shows=law),
        _law_table(result),
        picture(speed_figure(result), shows=speed),
        name="pictures",
    )


def _law_table(result: FitResult) -> Markup:
    points = law_points(result)
    if not (result.valid and points):
        return Markup()
    head = [Markup("u<sub>in</sub> (nm/µs)"), Markup("u<sub>out</sub> (nm/µs)"), "95 % band", "energy lost (%)"]
    if has_delay(result):
        head += ["delay τ (ns)", "95 % band"]
    return table("The law at round speeds among the measured ones", head, points)
