"""The first screen: whether to believe the fit, the law as a formula with its numbers, and how sure it is."""

import numpy as np

from fitting.models import NUISANCE_NAMES
from fitting.report import interval_in_words, value_in_words
from fitting.reporting.report_band import band_in_words, band_width
from fitting.reporting.report_extras import Comparison
from fitting.reporting.report_formula import SHARE_OF_BAND, rounded_values
from fitting.reporting.report_html_elements import Markup, bullets, element, in_signs, table, together
from fitting.result import FitResult
from fitting.verdict import IMPROBABLE

_IN, _OUT = Markup("u<sub>in</sub>"), Markup("u<sub>out</sub>")
_SQUARE = Markup("<sup>2</sup>")
_MINUS = "\N{MINUS SIGN}"
_UNLIKELY = 0.05
_SYMBOLS = {"epsilon": "ε", "viscous_loss": "c", "delay_hertz": "a", "delay_lead_nm": "b", "delay_offset_nm": "d"}
_UNITS = together(["Speeds in nm/µs relative to the sample, both positive: approach ", _IN, ", rebound ", _OUT, "."])
_LINKS = (
    ("notes", "Notes"),
    ("pictures", "Pictures"),
    ("parameters", "Parameters"),
    ("rows", "Rows"),
    ("inputs", "Inputs"),
    ("settings", "Settings"),
)


def opening(result: FitResult, comparison: Comparison | None) -> Markup:
    """Return the first screen: verdict, law, how sure it is, whether to believe it, and links to the rest.

    Args:
        result: the fit.
        comparison: other models of the same table, or None; its verdict belongs here too.
    """
    verdict = element(
        "div",
        element("p", "VALID" if result.valid else "NOT VALID"),
        element("p", _belief(result)),
        bullets(result.reasons),
        class_=f"verdict {'good' if result.valid else 'bad'}",
    )
    sure = [element("p", f"{in_signs(band_in_words(result))} {goodness_in_words(result)}")]
    links = _LINKS
    if comparison is not None:
        sure.append(element("p", f"Against other models: {comparison.verdict}"))
        links += (("comparison", "Comparison of models"),)
    menu = element("nav", together((element("a", words, href=f"#{name}") for name, words in links), " "))
    return Markup(together([verdict, _law(result), *sure, menu], "\n") + "\n")


def goodness_in_words(result: FitResult) -> str:
    """Return chi2 with what its probability means."""
    goodness = f"chi2/dof = {result.chi2:.1f}/{result.degrees_of_freedom}"
    if result.degrees_of_freedom > 0:
        goodness += f" = {result.chi2 / result.degrees_of_freedom:.4g}"
    p = result.p_value
    if not np.isfinite(p):
        return f"{goodness}: whether the law fits cannot be judged by it, {_why_not_judged(result)}."
    if p < IMPROBABLE:
        chance = f"{p:.1g}" if p > 0.0 else "below 1e-300"
        return (
            f"{goodness}: the amplitudes lie much farther from the law than their errors allow (probability {chance})."
        )
    if p < _UNLIKELY:
        return f"{goodness}: rather large, by chance it would be so large in {100.0 * p:.2g} % of experiments."
    if p > 1.0 - IMPROBABLE:
        return f"{goodness}: improbably small, the stated errors look too large."
    return (
        f"{goodness}: the amplitudes scatter about the law as their errors say (by chance chi2 would be larger in "
        f"{100.0 * p:.2g} % of experiments)."
    )


def _why_not_judged(result: FitResult) -> str:
    if result.degrees_of_freedom <= 0:
        return "there are as many parameters as amplitudes"
    if result.settings.get("error_scale") is not None:
        return "the errors were scaled to make it 1"
    return "outliers count less in it"


def _belief(result: FitResult) -> str:
    if not result.valid:
        return "Do not take these numbers for a measurement of the law, because:"
    limited = any(parameter.at_bound or None in parameter.interval95 for parameter in result.parameters.values())
    determined = "determined or limited" if limited else "determined"
    explained = "the law explains the amplitudes within their errors"
    if result.settings.get("error_scale") is not None:
        explained = "the law explains the amplitudes within errors of a believable size"
    elif result.settings.get("robust") is not None:
        explained = "the law explains the amplitudes within their errors but for a few outliers"
    words = f"You can believe it: the fit converged, {explained}, and every parameter is {determined} by the data."
    width = band_width(result)
    if width is not None:
        words += (
            f" It was measured from {width.slowest_nm_per_us:.3g} to {width.fastest_nm_per_us:.3g} nm/µs; "
            "beyond, it is an extrapolation."
        )
    count = len(result.warnings)
    return words + (f" Read the {count} note{'s' if count > 1 else ''} below first." if count else "")


def _law(result: FitResult) -> Markup:
    """Return the law: with its numbers where they are a measurement, by its symbols where they are not."""
    if not result.valid:
        symbols = {name: _SYMBOLS.get(name, name) for name in result.parameters}
        return together([element("p", "What was tried:"), *_formulas(result.model, symbols)])
    own = {name: parameter for name, parameter in result.parameters.items() if name not in NUISANCE_NAMES}
    caption = "What the data say"
    if len(own) < len(result.parameters):
        caption += " (calibration and damping are fitted along, see Parameters)"
    rows = [[name, value_in_words(p), interval_in_words(p), in_signs(p.unit)] for name, p in own.items()]
    numbers = table(caption, ["parameter", "value", "95 % interval", "unit"], rows, words=("95 % interval", "unit"))
    if result.model == "contact":
        return together([*_formulas(result.model, {}), numbers], "\n")
    digits = f"The digits are those it takes to be within {100.0 * SHARE_OF_BAND:g} % of the band's half-width."
    return together([*_formulas(result.model, rounded_values(result)), element("p", digits), numbers], "\n")


def _formulas(model: str, numbers: dict[str, str]) -> list[Markup]:
    """Return a model's formulas with numbers, or symbols, in them."""
    if model == "contact":
        return [element("p", "The law and the delay of the resolved contact (meniscus and junction).")]
    lines = [element("p", _law_formula(model, numbers), class_="formula")]
    if not model.endswith("+delay"):
        return [*lines, element("p", _UNITS)]
    lines.append(element("p", _delay_formula(numbers), class_="formula"))
    return [*lines, element("p", together([_UNITS, " Delay τ in µs."]))]


def _law_formula(model: str, numbers: dict[str, str]) -> Markup:
    law = model.removesuffix("+delay")
    if law == "restitution":
        return together([_OUT, " = ", numbers["r"], " ", _IN])
    first = [_OUT, _SQUARE, " = "]
    if law == "law":
        first += ["(", numbers["r"], " ", _IN, ")", _SQUARE]
    else:
        first += [_IN, _SQUARE, *_minus(numbers["viscous_loss"]), " ", _IN]
    return together([*first, *_minus(numbers["epsilon"])])


def _delay_formula(numbers: dict[str, str]) -> Markup:
    slow = together([*_minus(numbers["delay_lead_nm"]), " (1/", _OUT, f" {_MINUS} 1/", _IN, ")"])
    offset = together([*_minus(numbers["delay_offset_nm"]), "/", _IN])
    root = Markup(f"<sup>{_MINUS}1/5</sup>")
    return together(["τ = ", numbers["delay_hertz"], " ", _IN, root, slow, offset])


def _minus(number: str) -> list[str]:
    """Return ' - 59.9' with a true minus sign, or ' + 0.4' for a negative number."""
    return [" + ", number.removeprefix("-")] if number.startswith("-") else [f" {_MINUS} ", number]
