"""Direct inversion: amplitude and phase of each row give the speeds of its impact and the collision delay, no law."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import check_mass
from afm_jax.checks import checked, require_float64
from afm_jax.impact.law import ImpactLaw, Law, TabulatedLaw
from afm_jax.solve.lanes import filled
from afm_jax.version import version_of
from fitting.inversion.flight import Inverted, MeasuredRow, invert_rows
from fitting.inversion.regression import Laws, distance_from, regressed_laws
from fitting.inversion.result import (
    Inversion,
    InvertedRows,
    Rebound,
    on_resonance,
    read_on_resonance,
)
from fitting.inversion.verdict import InversionEvidence, contradictory, judge_inversion
from fitting.tables.csv_text import TableError
from fitting.tables.table import AmplitudeTable, TableLike, as_table, check_quality_factor

_BLOCK = 64
"""Rows come filled up to a multiple of this, so that one program serves most tables."""
_PACKAGES = ("afm-jax", "jax", "numpy")


class _Instrument(NamedTuple):
    """What all rows share."""

    free_frequency_khz: float
    quality_factor: float | None
    tip_calibration: float = 1.0
    drive_calibration: float = 1.0
    offset_origin_nm: float = 0.0
    phase_zero_deg: float = 0.0


class _Shared(NamedTuple):
    """An instrument, and others each one standard error of one quantity away."""

    instrument: _Instrument
    moved: dict[str, _Instrument]


@checked
def invert(
    table: TableLike,
    *,
    frequency_error_khz: float | None = None,
    truth: ImpactLaw | TabulatedLaw | None = None,
    law: ImpactLaw | TabulatedLaw | None = None,
) -> Inversion:
    """Return approach speed, rebound speed and collision delay of every row with a phase, and the laws they follow.

    A row's amplitude and phase fix the flight between two impacts; no impact law is assumed. What the platform's
    motion and the air do during the contact is taken back by parameter-free corrections (`inversion.flight`), so that
    the speeds are those of a free tip on a sample at rest. Rows on resonance are also read as the paper proposes.

    Args:
        table: from `read_table`; a table without phases must have rows on resonance.
        frequency_error_khz: standard error of the free frequency; None: the table's, exactly known if it has none.
        truth: the law if it is known, as of `law`: what the reading on resonance is compared with.
        law: of a fit, from `load_law`, or any other, to be set beside the rows.

    Returns:
        Rows with errors, regressed laws and a verdict; see `Inversion`.

    Raises:
        TableError: if the table has no phase and no row on resonance, or does not say its quality factor, or the law
            is known at other speeds only.
        ValueError: if the frequency's error is not positive, or the law is that of a tip of another mass.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    table = as_table(table)
    check_quality_factor(table)
    require_float64()
    if frequency_error_khz is not None and not 0.0 < frequency_error_khz < table.free_frequency_khz:
        raise ValueError(f"`frequency_error_khz` must be positive, but is {frequency_error_khz!r}")
    if table.tapping:
        raise TableError(
            f"{table.source}: the {'cantilever' if table.drive == 'base' else 'tip'} is driven here, not the sample; "
            "`afm-jax tapping` reads energy and impact speeds off such rows without a law, `afm-jax fit` fits a law"
        )
    for known_law in (truth, law):
        if known_law is not None and table.mass_ng is not None:
            check_mass(known_law, Cantilever(table.free_frequency_khz, None, table.mass_ng))
    frequency_error_khz = table.free_frequency_error_khz if frequency_error_khz is None else frequency_error_khz
    with_phase = _with_phase(table)
    if not with_phase.any() and not on_resonance(table).any():
        raise TableError(
            f"{table.source}: no row has a phase, and none is on resonance (2 N times the free frequency), where the "
            "phase could be assumed; add the columns phase_deg and phase_error_deg, or use `afm-jax fit`"
        )
    rows = _inverted_rows(table, _shared(table, frequency_error_khz))
    laws = regressed_laws(rows)
    known, reference = _reference(truth, laws)
    resonance = read_on_resonance(table, law=known, reference=reference)
    distance = None if law is None else distance_from(law, table, laws.rows, resonance)
    reasons, warnings = judge_inversion(InversionEvidence(table, with_phase, laws, law, distance))
    return Inversion(
        table=table,
        rows=laws.rows,
        approach_speed_nm_per_us=laws.speeds,
        laws=laws.laws,
        delay=laws.delay,
        preferred=laws.preferred,
        verdict=laws.verdict,
        resonance=resonance,
        beside=law,
        distance=distance,
        valid=not reasons,
        reasons=reasons,
        warnings=warnings,
        versions={name: version_of(name) for name in _PACKAGES},
    )


def _with_phase(table: AmplitudeTable) -> np.ndarray:
    """Return which rows have a phase and an amplitude."""
    known = np.isfinite(_numbers(table)[1])
    return known[:, 2] & known[:, :2].any(axis=1)


def _shared(table: AmplitudeTable, frequency_error_khz: float | None) -> _Shared:
    known = {name: value for name, (value, _) in table.calibration.items()}
    errors = {name: error for name, (_, error) in table.calibration.items()}
    instrument = _Instrument(float(table.free_frequency_khz), table.quality_factor, **known)
    errors = {"quality_factor": table.quality_factor_error, "free_frequency_khz": frequency_error_khz} | errors
    moved = {
        name: instrument._replace(**{name: getattr(instrument, name) + error})
        for name, error in errors.items()
        if error
    }
    return _Shared(instrument, moved)


def _inverted_rows(table: AmplitudeTable, shared: _Shared) -> InvertedRows:
    with_phase = _with_phase(table)
    count = table.rows
    impact, covariance = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    moved, chi2 = np.full((count, 3, len(shared.moved)), np.nan), np.full(count, np.nan)
    note = ["" if there else "no phase with an amplitude: nothing to invert" for there in with_phase]
    chosen = np.flatnonzero(with_phase)
    if chosen.size:
        found = _at(table, chosen, shared.instrument)
        good = chosen[found.converged]
        impact[good] = np.stack(found.impact, axis=1)[found.converged]
        covariance[good] = found.covariance[found.converged]
        three = np.isfinite(_numbers(table)[1][chosen]).all(axis=1)
        chi2[chosen] = np.where(three & found.converged, found.chi2, np.nan)
        for k, instrument in enumerate(shared.moved.values()):
            other = _at(table, chosen, instrument)
            moved[good, :, k] = np.stack(other.impact, axis=1)[found.converged] - impact[good]
        for row in np.setdiff1d(chosen, good):
            note[row] = "no flight between two impacts has this amplitude and phase"
        for row in np.flatnonzero(contradictory(chi2)):
            note[row] = f"amplitudes and phase contradict each other (chi2 {chi2[row]:.3g} of one degree of freedom)"
    return InvertedRows(
        impact=impact,
        covariance=covariance,
        shared=moved,
        shared_names=tuple(shared.moved),
        chi2=chi2,
        regressed=np.asarray(np.isfinite(impact).all(axis=1) & np.isfinite(moved).all(axis=(1, 2))),
        note=tuple(note),
    )


def _numbers(table: AmplitudeTable) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows 3"]]:
    """Return peak, lock-in amplitude and phase, and their errors, infinite where nothing was measured."""
    blank = np.full(table.rows, np.nan)
    names = ("peak_amplitude_nm", "lockin_amplitude_nm", "phase_deg")
    errors = ("peak_amplitude_error_nm", "lockin_amplitude_error_nm", "phase_error_deg")
    value, error = (
        np.stack([blank if getattr(table, name) is None else getattr(table, name) for name in part], axis=1)
        for part in (names, errors)
    )
    there = np.isfinite(value) & np.isfinite(error)
    return np.where(there, value, 1.0), np.where(there, error, np.inf)


def _at(table: AmplitudeTable, chosen: np.ndarray, instrument: _Instrument) -> Inverted:
    """Return some rows inverted with an instrument."""
    value, error = _numbers(table)
    per_nm = np.array([instrument.tip_calibration, instrument.tip_calibration, 1.0])
    zero = np.array([0.0, 0.0, instrument.phase_zero_deg])
    fill = filled(chosen, -(-chosen.size // _BLOCK) * _BLOCK)
    # every field an array of the rows' shape, for `vmap`
    amplitude, frequency, offset = (
        instrument.drive_calibration * table.excitation_nm,
        table.drive_frequency_khz,
        instrument.offset_origin_nm + table.offset_nm,
    )
    drive = (jnp.asarray(part[fill]) for part in (amplitude, frequency, offset))
    platform = Platform(*drive, offset_rate_nm_per_us=jnp.zeros(fill.size))
    rows = MeasuredRow(
        platform,
        jnp.asarray(table.order[fill], float),
        jnp.asarray(((value - zero) / per_nm)[fill]),
        jnp.asarray((error / per_nm)[fill]),
    )
    cantilever = Cantilever(instrument.free_frequency_khz, instrument.quality_factor, table.mass_ng)
    return jax.tree.map(lambda part: np.asarray(part)[: chosen.size], invert_rows(rows, cantilever))


def _reference(truth: Law | None, laws: Laws) -> tuple[Rebound | None, str]:
    """Return what the reading on resonance is compared with, and its name."""
    if truth is not None:

        def rebound(speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
            known = ~np.asarray(truth.extrapolated(speeds) | truth.captures(speeds))
            return np.where(known, np.asarray(truth.rebound_speed(speeds)), np.nan)

        return rebound, "truth"
    best = laws.laws.get(laws.preferred or "viscous")
    if best is None:
        return None, "none"
    known = np.isfinite(best.curve)
    u, w = laws.speeds[known], best.curve[known]

    def regressed(speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        # the loss is all but linear in the speed, the rebound speed of slow tips is not
        square = speeds**2 - np.interp(speeds, u, u**2 - w**2)
        inside = (speeds >= u[0]) & (speeds <= u[-1])
        return np.sqrt(np.where(inside & (square > 0.0), square, np.nan))

    return regressed, "law"
