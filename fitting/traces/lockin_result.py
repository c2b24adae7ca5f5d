"""What a lock-in reads of a trace, and everything a table of amplitudes needs of it."""

import math
from dataclasses import dataclass
from typing import Any

from fitting.traces.lockin_fold import Fold
from fitting.traces.lockin_order import OrderSearch
from fitting.traces.lockin_trace import Trace
from fitting.traces.lockin_verdict import TraceKind

FORMAT_VERSION = 1
"""Version of the JSON layout; raised when a key changes its meaning or goes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LockinResult:
    """The reading of one trace; attributes are named like the keys of its JSON. Errors are standard errors.

    Attributes:
        steady: whether it is a steady orbit with one impact in a response period.
        kind: what it is.
        verdict: the same in words.
        order: N, drive periods in a response period; None where nothing repeats.
        impacts_per_period: m; None where it is not known.
        peak_amplitude_nm: largest height above the rest position; None where nothing repeats.
        peak_amplitude_error_nm: from noise and sampling.
        lockin_amplitude_nm: 2/T |integral of z exp(-i omega t/N)| over whole response periods.
        lockin_amplitude_error_nm: from noise and sampling.
        phase_deg: phi in z ~ a cos(omega t/N + phi), modulo 360/N, t = 0 when the platform is highest.
        phase_error_deg: from the noise of deflection and reference.
        phase_reference: "column", "drive_phase_deg" or "time zero" (taken as when the platform is highest).
        noise_nm: standard deviation of one sample.
        sampling_error_nm: part of the lock-in amplitude's error that more samples per period would remove.
        scatter: how much response periods differ beyond noise, of the deflection's standard deviation.
        response_periods: that were evaluated.
        free_frequency_khz: given, or read off the bending at the top.
        free_frequency_origin: "given" or "trace".
        drive_amplitude_nm: given, or the platform column's; None where not known.
        offset_nm: given, or the platform column's; None where not known.
        warnings: what a reader should know besides.
        trace: what was read.
        folded: the last whole response periods.
        search: of the order.
    """

    steady: bool
    kind: TraceKind
    verdict: str
    order: int | None
    impacts_per_period: int | None
    peak_amplitude_nm: float | None
    peak_amplitude_error_nm: float | None
    lockin_amplitude_nm: float | None
    lockin_amplitude_error_nm: float | None
    phase_deg: float | None
    phase_error_deg: float | None
    phase_reference: str
    noise_nm: float
    sampling_error_nm: float
    scatter: float
    response_periods: int
    free_frequency_khz: float | None
    free_frequency_origin: str | None
    drive_amplitude_nm: float | None
    offset_nm: float | None
    warnings: list[str]
    trace: Trace
    folded: Fold
    search: OrderSearch

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the samples as plain lists, numbers and strings; what is not known is None."""
        trace, settings = self.trace, self.trace.settings
        own = {name: value for name, value in vars(self).items() if name not in {"trace", "folded", "search"}}
        own |= {
            "kind": str(self.kind),
            "drive_frequency_khz": trace.drive_frequency_khz,
            "quality_factor": settings.quality_factor,
            "samples": trace.samples,
            "sampling_rate_mhz": 1.0 / trace.step_us,
            "drive_periods": trace.drive_periods,
            "prediction_misfit_nm": self.search.misfit_nm.tolist(),
            "remarks": list(trace.remarks),
        }
        plain = {name: None if isinstance(v, float) and not math.isfinite(v) else v for name, v in own.items()}
        return {"source": trace.source} | plain
