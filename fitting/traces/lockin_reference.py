"""When the platform is highest: the phase that a trace's response is compared with."""

from typing import NamedTuple

import numpy as np

from fitting.traces.lockin_trace import TableError, Trace

_LEAST_SHARE = 0.5
"""Of the reference's variance that must lie at the drive frequency."""
_SLIP_DEG = 20.0
"""Change of its phase between first and second half of the trace from which the drive frequency is wrong."""


class Reference(NamedTuple):
    """The platform z_p = offset + beta cos(omega t + psi).

    Attributes:
        origin: "column", "drive_phase_deg" or "time zero".
        phase_deg: psi.
        phase_error_deg: from the noise of the column; 0 otherwise.
        amplitude_nm: beta: given, or the platform column's; None where not known.
        offset_nm: given, or the platform column's; None where not known.
    """

    origin: str
    phase_deg: float
    phase_error_deg: float
    amplitude_nm: float | None
    offset_nm: float | None


def find_reference(trace: Trace) -> Reference:
    """Return the platform's phase: from the option or comment, else from the column, else that of time 0.

    Args:
        trace: with or without a reference column.

    Raises:
        TableError: if the column holds no wave of the drive frequency.
    """
    settings = trace.settings
    amplitude, offset, phase, error = settings.drive_amplitude_nm, settings.offset_nm, None, 0.0
    if trace.platform is not None:
        mean, value, error = _wave(trace)
        phase = float(np.degrees(np.angle(value)))
        if trace.platform_in_nm:
            amplitude = abs(value) if amplitude is None else amplitude
            offset = mean if offset is None else offset
    if settings.drive_phase_deg is not None:
        return Reference("drive_phase_deg", settings.drive_phase_deg, 0.0, amplitude, offset)
    if phase is not None:
        return Reference("column", phase, error, amplitude, offset)
    return Reference("time zero", 0.0, 0.0, amplitude, offset)


def _wave(trace: Trace) -> tuple[float, complex, float]:
    """Return mean, complex amplitude and phase error (in degrees) of the reference column."""
    signal = np.asarray(trace.platform)
    angle = 2.0 * np.pi * trace.time_us / trace.drive_period_us
    values, left = _fitted(signal, angle)
    spread = float(np.sum((signal - signal.mean()) ** 2))
    if spread == 0.0 or float(np.sum(left**2)) > (1.0 - _LEAST_SHARE) * spread:
        raise TableError(
            f"{trace.source}: the reference column holds no wave of {trace.drive_frequency_khz:g} kHz; correct "
            "drive_frequency_khz or the sampling rate, or remove the column"
        )
    half = len(signal) // 2
    first, second = (_fitted(signal[part], angle[part])[0] for part in (slice(half), slice(half, None)))
    slip = float(np.degrees(np.angle(complex(second[1], -second[2]) / complex(first[1], -first[2]))))
    if abs(slip) > _SLIP_DEG:
        seen = trace.drive_frequency_khz + slip / 360.0 / (half * trace.step_us) * 1e3
        raise TableError(
            f"{trace.source}: the reference column slips by {slip:.3g} degrees over half the trace; it has "
            f"{seen:.7g} kHz, but drive_frequency_khz is {trace.drive_frequency_khz:g}"
        )
    value = complex(values[1], -values[2])
    noise = float(np.sqrt(np.sum(left**2) / (len(signal) - 3)))
    return float(values[0]), value, float(np.degrees(noise * np.sqrt(2.0 / len(signal)) / abs(value)))


def _fitted(signal: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    design = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    values = np.linalg.lstsq(design, signal, rcond=None)[0]
    return values, signal - design @ values
