"""A fit in words: how sure the law is, its formula with the digits that count, whether to trust it."""

import numpy as np

from afm_jax.words import decimals, interval, percent, value_alone
from fitting.infer.intervals import END_OF_RANGE, UNEXPLAINED
from fitting.infer.result import FitResult, FittedParameter, WithInterval
from fitting.infer.verdict import value_at_bound
from fitting.parameters import DELAY_LAW, LAWS, PARAMETERS

_EXACT = 1e-8
"""Relative distance below which two laws are the same."""


def known_in_words(known: WithInterval, unit: str = "") -> str:
    """Return '58.9 aJ (58.2 to 59.6)', the digits as the interval warrants them."""
    value, (low, high) = known.value, known.interval95
    tail = f" {unit}" if unit else ""
    if low is None or high is None:
        return f"{value:.4g}{tail}"
    digits = min(decimals(high - low, unknown=6), 8)
    return f"{value:.{digits}f}{tail} ({low:.{digits}f} to {high:.{digits}f})"


def losses_in_words(fit: FitResult) -> list[list[str]]:
    """Return the losses of an impact, row by row: the name, and the value with its 95 % interval.

    The energy at three speeds, delta of the printed epsilon, and the capture speed.
    """
    loss = fit.loss
    if loss is None:
        return []

    def both(in_aj: WithInterval | None, in_ev: WithInterval | None) -> str:
        pairs = (in_aj, "aJ"), (in_ev, "eV")
        return ", ".join(known_in_words(known, unit) for known, unit in pairs if known is not None)

    named = {f"energy lost at {one.approach_speed_nm_per_us:.3g} nm/us": one for one in loss.energies}
    rows = [[name, both(one.energy_aj, one.energy_ev)] for name, one in named.items() if one.energy_aj is not None]
    rows += [] if loss.energies_reason is None else [["energy lost", f"not known: {loss.energies_reason}"]]
    rows += [] if loss.delta_aj is None else [["delta = m epsilon/2", both(loss.delta_aj, loss.delta_ev)]]
    return [*rows, ["captured below (extrapolated)", known_in_words(loss.capture_speed_nm_per_us, "nm/us")]]


PULLS = "  Pull: how far a table's law is from that of the others, in standard deviations."


def formulas(fit: FitResult) -> list[str]:
    """Return the fitted law in formulas."""
    model = fit.model
    if model == "contact":
        return ["the law and the delay of the resolved contact (meniscus and JKR junction), by its parameters:"]
    law, lasting = LAWS[model.removesuffix("+delay")], model.endswith("+delay")
    return [one.formula for one in ([law, DELAY_LAW] if lasting else [law])]


def parting_in_words(fit: FitResult) -> str:
    """Return how far the formula and the law part; nothing where they are the same, or where there is no formula."""
    loss = fit.loss
    if loss is None or loss.formula_off is None or loss.formula_off_at_nm_per_us is None or loss.formula_off <= _EXACT:
        return ""
    return (
        "The law contains what its formula leaves out: the formula with these parameters deviates from it by at most "
        f"{percent(loss.formula_off)} of u_out, at {loss.formula_off_at_nm_per_us:.3g} nm/us."
    )


def held_in_words(fit: FitResult) -> str:
    """Return 'Held fixed: r = 0.998, epsilon = 120 nm^2/us^2'; nothing where nothing was."""
    fixed = fit.settings.get("fixed") or {}
    held = ", ".join(f"{name} = {value:g} {PARAMETERS[name].unit}".rstrip() for name, value in fixed.items())
    return f"Held fixed: {held}" if held else ""


def has_delay(fit: FitResult) -> bool:
    """Say whether the model's impacts last."""
    return bool(np.any(fit.law.collision_delay_us != 0.0))


def interval_in_words(parameter: FittedParameter, unit: str = "") -> str:
    """Return '0.9492 to 0.9508', 'below 0.000357; 0 is not excluded', or why there is no interval.

    Args:
        parameter: of a fit.
        unit: behind the numbers; "": it stands elsewhere.
    """
    (low, high), reason = parameter.interval95, parameter.interval_reason or ""
    behind = f"  {unit}" if unit else ""
    if low is not None and high is not None:
        return interval(low, high) + behind
    if high is not None:
        side, limit = "below", high
    elif low is not None:
        side, limit = "above", low
    else:
        # the verdict says why nothing is known
        return "none" if reason == UNEXPLAINED else f"none: {reason}"
    end = reason.partition(f"{END_OF_RANGE}, ")[2]
    # three digits of how far the limit is from the end of the range
    digits = decimals(0.1 * abs(limit - float(end or 0.0)))
    return f"{side} {limit:.{digits}f}{behind}; {f'{end} is not excluded' if end else reason}"


def value_in_words(parameter: FittedParameter) -> str:
    """Return the value with the digits that its error warrants, three where it has none; 0 or 1 of one at its bound."""
    if parameter.at_bound:
        return value_at_bound(parameter.value)
    return value_alone(parameter.value, parameter.standard_error)


def band_width(fit: FitResult) -> tuple[float, float, float, float] | None:
    """Return how well the band of a law knows the rebound speed over the speeds of the used rows; None without rows.

    The band is known at the law's points; between them it is interpolated, at the slowest and fastest row.

    Returns:
        Slowest and fastest approach in nm/us; the largest half-width of the 95 % band there, relative to the rebound
        speed, and the approach speed it is found at: NaN if there is no band.
    """
    reached = fit.rows.reached_nm_per_us
    if not reached.size:
        return None
    slowest, fastest, law = float(reached.min()), float(reached.max()), fit.law
    speeds = np.clip(law.approach_speed_nm_per_us, slowest, fastest)
    rebound, high = (
        np.interp(speeds, law.approach_speed_nm_per_us, column)
        for column in (law.rebound_speed_nm_per_us, law.rebound_high_nm_per_us)
    )
    # the lower edge is cut at zero, the upper one never
    known = np.isfinite(high) & (rebound > 0.0)
    if not known.any():
        return slowest, fastest, np.nan, np.nan
    share = (high[known] - rebound[known]) / rebound[known]
    worst = int(np.argmax(share))
    return slowest, fastest, float(share[worst]), float(speeds[known][worst])


def band_in_words(fit: FitResult) -> str:
    """Return how well the law is known over the measured speeds, or why that cannot be said; a sentence."""
    width = band_width(fit)
    if width is None:
        return "No row reached a steady orbit: the law was measured at no speed."
    slowest, fastest, worst, at = width
    where = f"Over the measured approach speeds, {slowest:.3g} to {fastest:.3g} nm/us,"
    if not np.isfinite(worst):
        cause = "the parameters' errors are not known" if fit.valid else "the fit is not valid"
        return f"{where} no band can be given: {cause}."
    return f"{where} the rebound speed is known to {percent(worst)} or better (95 % band, widest at {at:.3g} nm/us)."
