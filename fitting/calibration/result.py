"""What a calibration found, and everything that went into it."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.least_squares import IMPROBABLE
from afm_jax.results import Result, public_result
from afm_jax.strict_json import plain
from afm_jax.words import decimals, with_error
from fitting.calibration.sweep import ResonanceSweep
from fitting.fits.intervals import Convergence

FORMAT_VERSION = 1
"""Version of the JSON layout; raised when a key changes its meaning or goes."""


@dataclass(frozen=True)
class CalibratedValue:
    """A quantity that a calibration determines, with its standard error and interval.

    Attributes:
        value: in the unit of the quantity's name.
        standard_error: Wald's; None where the model does not explain the sweep or the sweep does not determine it.
        interval95: profile-likelihood interval; an end is None where it is open.
        interval_reason: why an end is open; None if none is.
    """

    value: float
    standard_error: float | None
    interval95: tuple[float | None, float | None]
    interval_reason: str | None


@dataclass(frozen=True)
class Alternative:
    """A fit of the frequency scan, with its errors unchanged, in front of another background."""

    background: str
    frequency_khz: float
    quality_factor: float
    quality_factor_error: float | None
    chi2: float
    degrees_of_freedom: int
    aic: float
    residual_autocorrelation: float


@dataclass(frozen=True)
class PointErrors:
    """The standard errors that the points were given.

    Attributes:
        origin: "file", "noise" (a share of the largest amplitude), "averages" (of a spectrum's periodograms) or
            "estimated" (chosen such that chi2/dof = 1).
        scale: factor on the errors of the file or of the noise that makes chi2/dof = 1; None if not asked for.
        amplitude: typical (median) standard error of an amplitude, in the sweep's unit.
        frequency_jitter_hz: error of the drive's frequency that explains misfit along the curve; None if not estimated.
    """

    origin: str
    scale: float | None
    amplitude: float
    frequency_jitter_hz: float | None


@dataclass(frozen=True)
class Curves:
    """The sweep beside the fit, all of shape (points,); `phase...` None for a sweep without phase.

    Misfits are fit - measured, in the sweep's unit and in degrees.
    """

    amplitude: Float[np.ndarray, " points"]
    amplitude_misfit: Float[np.ndarray, " points"]
    phase_deg: Float[np.ndarray, " points"] | None
    phase_misfit_deg: Float[np.ndarray, " points"] | None


@public_result(picture="fitting.calibration.report:calibration_figure")
@dataclass(frozen=True)
class Calibration(Result):
    """Frequency and quality factor of a free cantilever: what `calibrate` returns, named like the keys of its JSON.

    Attributes:
        frequency_khz: undamped natural frequency Omega/2 pi.
        quality_factor: Q in m z'' + (m Omega/Q) z' + k z = F cos(omega t).
        peak_frequency_khz: where the response without background is largest; None for Q below 1/sqrt(2).
        peak_amplitude: the response without background at the natural frequency, in the sweep's unit.
        mean_square: of a thermal spectrum, <x^2> of the resonance in nm^2, with a Wald interval of its logarithm; None
            where there is none or its errors are not known.
        correlation: of frequency and quality factor; None where their errors are not known.
        model: "phase", "amplitude" or "power", what was fitted.
        background: the background's name.
        background_values: the linear parameters, in units of the largest amplitude.
        phase_reversed: the phase rises through the resonance and was taken with the opposite sign.
        chi2: sum of squared normalised residuals.
        degrees_of_freedom: numbers measured less parameters.
        p_value: probability of a larger chi2 if the model is right; NaN where the errors come from the fit itself.
        errors: where the standard errors come from.
        residual_autocorrelation: of neighbouring points' residuals.
        residual_repeat: after how many points the residuals repeat, with their correlation; None if they do not.
        runs_excess: signs' runs of the amplitude's residuals, in standard deviations from what chance gives.
        convergence: what the checks of the minimum found.
        alternatives: the other backgrounds.
        curves: fit and residuals, point by point.
        valid: whether to trust it; `reasons` say why not.
        reasons: what makes the result invalid.
        warnings: what a reader should know besides.
        sweep: what was fitted.
        versions: of the packages that computed it.
    """

    frequency_khz: CalibratedValue
    quality_factor: CalibratedValue
    peak_frequency_khz: float | None
    peak_amplitude: float
    mean_square: CalibratedValue | None
    correlation: float | None
    model: str
    background: str
    background_values: dict[str, float]
    phase_reversed: bool
    chi2: float
    degrees_of_freedom: int
    p_value: float
    errors: PointErrors
    residual_autocorrelation: float
    residual_repeat: tuple[int, float] | None
    runs_excess: float
    convergence: Convergence
    alternatives: list[Alternative]
    curves: Curves
    valid: bool
    reasons: list[str]
    warnings: list[str]
    sweep: ResonanceSweep
    versions: dict[str, str]

    @property
    def explained(self) -> bool:
        """Whether the model explains the points, as far as their errors are known."""
        return not self.p_value < IMPROBABLE

    @property
    def table_comments(self) -> list[str]:
        """The comment lines that carry the calibration into an amplitude table.

        Raises:
            ValueError: if the calibration is not valid.
        """
        error = self.quality_factor.standard_error
        if not self.valid or error is None:
            raise ValueError(f"{self.sweep.source}: the calibration is not valid; its values must not enter a table")
        frequency_error = self.frequency_khz.standard_error or 0.0
        # three digits of the error: it enters every amplitude of a table
        places = max(decimals(0.1 * frequency_error, unknown=12), 3)
        return [
            f"# free_frequency_khz = {self.frequency_khz.value:.{places}f}",
            f"# quality_factor = {with_error(self.quality_factor.value, error)}",
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain lists, numbers and strings; what is not known is None."""
        own = {name: value for name, value in vars(self).items() if name not in {"sweep", "convergence"}}
        for name in ("frequency_khz", "quality_factor", "errors", "curves"):
            own[name] = asdict(own[name])
        own["alternatives"] = [asdict(other) for other in self.alternatives]
        own["mean_square"] = None if self.mean_square is None else asdict(self.mean_square)
        own["convergence"] = asdict(self.convergence)
        own["table_comments"] = self.table_comments if self.valid else []
        own["instrument"] = self.sweep.instrument
        own["input"] = vars(self.sweep)
        return {"format": "afm-jax calibrate", "format_version": FORMAT_VERSION} | plain(own)
