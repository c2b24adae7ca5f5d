"""The numbers of a law's formula: as many digits as it takes that the formula is the law.

Errors of correlated parameters are larger than those of the law: rounded to their own errors, the parameters could give
a curve outside the band.
"""

import numpy as np
from jaxtyping import Float

from fitting.report import value_digits
from fitting.reporting.report_band import band_width
from fitting.result import FitResult

SHARE_OF_BAND = 0.1
"""How far the rounded formula may be off, in half-widths of the 95 % band."""
_MOST_EXTRA = 8


def rounded_values(result: FitResult) -> dict[str, str]:
    """Return the parameters in digits; the formula with them is within a tenth of the band where the law was measured.

    Args:
        result: a fit of a law, not of a contact.
    """
    texts = {}
    for extra in range(_MOST_EXTRA):
        # a loss at its bound is 0 or 1, not 3e-15
        digits = {name: 0 if p.at_bound else value_digits(p) for name, p in result.parameters.items()}
        texts = {name: f"{p.value:.{digits[name] + extra}f}" for name, p in result.parameters.items()}
        if _close_enough(result, {name: float(text) for name, text in texts.items()}):
            break
    return texts


def _close_enough(result: FitResult, values: dict[str, float]) -> bool:
    law = result.law
    width = band_width(result)
    if width is None:
        return True
    speed = law.approach_speed_nm_per_us
    measured = (speed >= width.slowest_nm_per_us) & (speed <= width.fastest_nm_per_us)
    rebound, delay = formula(values, speed[measured])
    pairs = (
        (rebound, law.rebound_speed_nm_per_us[measured], law.rebound_high_nm_per_us[measured]),
        (delay, law.collision_delay_us[measured], law.delay_high_us[measured]),
    )
    return not any(np.any(np.abs(found - exact) > SHARE_OF_BAND * (high - exact)) for found, exact, high in pairs)


def formula(
    values: dict[str, float], approach_speed_nm_per_us: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return rebound speed in nm/us and delay in us as the formulas of the page say; zero where the tip is captured."""
    u = approach_speed_nm_per_us
    square = (values.get("r", 1.0) * u) ** 2 - values.get("viscous_loss", 0.0) * u - values.get("epsilon", 0.0)
    free = square > 0.0
    w = np.sqrt(np.where(free, square, 1.0))
    lead, offset = values.get("delay_lead_nm", 0.0), values.get("delay_offset_nm", 0.0)
    delay = values.get("delay_hertz", 0.0) * u**-0.2 - lead * (1.0 / w - 1.0 / u) - offset / u
    return np.where(free, w, 0.0), np.where(free, delay, 0.0)
