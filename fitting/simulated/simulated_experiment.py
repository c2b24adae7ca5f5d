"""Simulated experiments: an amplitude table as an instrument would read it off the full scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.contact import Contact
from afm_jax.impact.law import ImpactLaw
from afm_jax.motion.simulate import DEFAULT_ACCURACY
from afm_jax.parameters import require_float64
from fitting.simulated.simulated_motion import Drives, Report, steady_rows
from fitting.table import AmplitudeTable

PIECES = 40
"""Most pieces of a hundred response periods that a motion may take to settle."""


@dataclass(frozen=True, kw_only=True)
class SimulatedExperiment:
    """A simulated amplitude table, and what was behind it.

    Attributes:
        table: with noise, as an instrument gives it.
        exact: the same rows and errors without noise.
        left_out: a sentence for every drive that is not in the table: no steady (1, N) orbit, and why.
    """

    table: AmplitudeTable
    exact: AmplitudeTable
    left_out: tuple[str, ...]


def drives_of(rows: Sequence[tuple[int, float, float, float]]) -> Drives:
    """Return drives from rows of order, frequency in kHz, amplitude in nm and offset in nm."""
    columns = np.array(rows, float).reshape(-1, 4).T
    return Drives(columns[0].astype(np.int64), *columns[1:])


def simulate_experiment(  # noqa: PLR0913
    interaction: Contact | ImpactLaw,
    cantilever: Cantilever,
    drives: Drives,
    *,
    noise: float = 0.01,
    phase_noise_deg: float | None = None,
    seed: int = 0,
    quality_factor_error: float | None = None,
    accuracy: float = DEFAULT_ACCURACY,
    pieces: int = PIECES,
    remarks: tuple[str, ...] = (),
    report: Report = lambda _: None,
) -> SimulatedExperiment:
    """Return the amplitudes that an experiment on a scene would read, with noise.

    Every drive is simulated in time until it repeats to 1e-6, and observed over one response period.

    Args:
        interaction: a contact, or a law with or without a collision delay.
        cantilever: the cantilever; its Q enters the table as the known value.
        drives: what is driven, see `drives_of`.
        noise: standard error of peak and lock-in amplitude as a share of each, drawn independently.
        phase_noise_deg: standard error of the phase in degrees; None: the table has no phase.
        seed: of the noise.
        quality_factor_error: uncertainty of Q that the table states; None: none.
        accuracy: of each contact, as for `simulate`.
        pieces: most pieces of a hundred response periods that a motion may take to settle.
        remarks: comments for the table.
        report: told how far it is.

    Returns:
        The table with and without noise, and what was left out.

    Raises:
        ValueError: if the noise is not between 0 and 1, an order is no positive integer, the contact has no junction,
            or no drive has a steady (1, N) orbit.
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the contact, law or cantilever was built.
    """
    require_float64(interaction, cantilever)
    _check(drives, noise, phase_noise_deg)
    found = steady_rows(interaction, cantilever, drives, accuracy=accuracy, pieces=pieces, report=report)
    kept = found.rows
    left_out = tuple(
        f"order {drives.order[i]}, {drives.frequency_khz[i]:g} kHz, {drives.amplitude_nm[i]:g} nm, "
        f"offset {drives.offset_nm[i]:g} nm: {reason}"
        for i, reason in sorted(found.reasons.items())
    )
    if found.reading is None:
        raise ValueError(f"no drive has a steady single-impact orbit (the first: {left_out[0]})")
    peak, lockin, degrees = found.reading
    phase = None if phase_noise_deg is None else degrees
    known = cantilever.quality_factor
    exact = AmplitudeTable(
        order=drives.order[kept],
        drive_frequency_khz=drives.frequency_khz[kept],
        drive_amplitude_nm=drives.amplitude_nm[kept],
        offset_nm=drives.offset_nm[kept],
        free_frequency_khz=float(cantilever.frequency_khz),
        quality_factor=None if known is None else float(known),
        quality_factor_error=quality_factor_error,
        mass_ng=float(cantilever.mass_ng),
        peak_amplitude_nm=peak,
        peak_amplitude_error_nm=noise * peak,
        lockin_amplitude_nm=lockin,
        lockin_amplitude_error_nm=noise * lockin,
        phase_deg=phase,
        phase_error_deg=None if phase is None else np.full(phase.shape, phase_noise_deg),
        remarks=remarks,
    )
    # drawn for every drive, so that one that is left out does not change the noise of the others
    draws = np.random.default_rng(seed).normal(size=(3, len(drives.order)))[:, kept]
    return SimulatedExperiment(table=with_noise(exact, draws), exact=exact, left_out=left_out)


def with_noise(exact: AmplitudeTable, draws: Float[np.ndarray, "3 rows"]) -> AmplitudeTable:
    """Return a table with its errors times standard normal draws added, rounded to six digits as an instrument prints.

    Args:
        exact: noise-free amplitudes with their errors.
        draws: of peak, lock-in amplitude and phase.

    Raises:
        ValueError: if the table has no amplitude of one kind.
    """
    columns = {}
    for name, error, draw in (
        ("peak_amplitude_nm", "peak_amplitude_error_nm", draws[0]),
        ("lockin_amplitude_nm", "lockin_amplitude_error_nm", draws[1]),
    ):
        value, spread = getattr(exact, name), getattr(exact, error)
        if value is None:
            raise ValueError(f"{exact.source}: the table has no {name}; noise is added to peak and lock-in amplitude")
        columns[name] = _rounded(value + spread * draw)
        columns[error] = _rounded(spread)
    if exact.phase_deg is not None:
        measured = exact.phase_deg + np.asarray(exact.phase_error_deg) * draws[2]
        columns["phase_deg"] = np.round(measured % (360.0 / exact.order), 6)
    return replace(exact, **columns)


def _rounded(values: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    return np.array([float(f"{value:.6g}") for value in values])


def _check(drives: Drives, noise: float, phase_noise_deg: float | None) -> None:
    if not 0.0 < noise < 1.0:
        raise ValueError(f"`noise` must be between 0 and 1, but is {noise!r}; write 0.01 for 1 %")
    if phase_noise_deg is not None and not 0.0 < phase_noise_deg < 90.0:
        raise ValueError(f"`phase_noise_deg` must be between 0 and 90, but is {phase_noise_deg!r}")
    if not len(drives.order) or np.any(np.asarray(drives.order) < 1):
        raise ValueError("`drives` must hold at least one drive, and orders of 1 or more")
    if np.any(np.asarray(drives.frequency_khz) <= 0.0) or np.any(np.asarray(drives.amplitude_nm) <= 0.0):
        raise ValueError("`drives` must have positive frequencies and amplitudes")
