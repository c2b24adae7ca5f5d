"""`tapping`: what a tapping curve says of a tap, and where its drive allows it of the impact law."""

from dataclasses import replace
from typing import Any

import numpy as np

from afm_jax.checks import checked, in_float64
from afm_jax.units import RAD_PER_US_PER_KHZ
from afm_jax.version import version_of
from afm_jax.words import printable
from fitting.instruments.curve import zero_of_free_rows
from fitting.instruments.lag import PhaseReadings, sense_of_phase, turned
from fitting.parameters import USUAL_ERRORS
from fitting.tables.csv_text import TableError
from fitting.tables.table import AmplitudeTable
from fitting.tapping_curves.along import energies_along
from fitting.tapping_curves.branches import (
    FEWEST_ROWS,
    changes,
    free_rows,
    hardly_touching_rows,
    held_rows,
    repulsive_rows,
    smooth_stretches,
    ways,
)
from fitting.tapping_curves.curve import (
    Given,
    Mask,
    Rows,
    TappingCurve,
    lag_of_free_tip,
    motion_of,
    part_of,
    phase_readings,
)
from fitting.tapping_curves.energy import largest_energies, noise_of
from fitting.tapping_curves.lever import FEWEST_FREE_ROWS, Lever
from fitting.tapping_curves.measured import CurveLike, measured
from fitting.tapping_curves.one_energy import one_energy
from fitting.tapping_curves.result import Tapping, TapRows
from fitting.tapping_curves.speeds import speeds

LAW_MODEL = "viscous+delay"
_ORIGIN_NM = 0.3
"""What the height's origin is uncertain by where the table does not say."""


@checked
@in_float64
def tapping(
    source: CurveLike,
    *,
    curve: int | None = None,
    noise: float | None = None,
    law: bool = True,
    model: str = LAW_MODEL,
    scale_errors: bool = False,
    **reading: Any,
) -> Tapping:
    """Return the energy of a tap along a tapping curve, its branches and hysteresis, and the law if rows allow it.

    Args:
        source: a table with `drive` "force" or "base" (see `read_table`), a curve from `read_curve`, or the path of a
            table or of an instrument's file.
        curve: only this curve of an instrument's file, from 1.
        noise: relative error of amplitudes without one in a table's file (0.01 stands for 1 %).
        law: whether to fit the impact law where the rows allow it (that imports JAX and compiles for half a minute).
        model: of the law, as for `fit`.
        scale_errors: multiply the errors of the rows where these scatter more, instead of refusing their energy.
        reading: how an instrument's file is read, as `read_curves` takes it: `nm_per_volt=42`,
            `spring_constant_n_per_m="44 +- 4"`, `drive="force"`. Of a table free_frequency_khz, quality_factor,
            spring_constant_n_per_m and phase_sense replace its own.

    Raises:
        TableError: if the table is none of a driven cantilever, something is missing that no energy can do without,
            the free tip's lag is none that frequency and Q allow, or the file's curve must not be used.
    """
    read = measured([source], curve=curve, noise=noise, **reading)
    if len(read.tables) + len(read.refused) > 1:
        raise TableError(
            f"{source}: holds several curves; choose one, `curve=1`, or analyse all as curves of one lever by "
            "`fitting.tapping_together`"
        )
    for one in read.refused:
        raise TableError(f"{one['file']}: refused curve {one['curve']}; {one['reason']}")
    (table,) = read.tables.values()
    result = energies_of_table(table, scale_errors=scale_errors)
    return with_law(result, model) if law and result.law_allowed else result


def energies_of_table(table: AmplitudeTable, *, scale_errors: bool = False) -> Tapping:
    """Return everything that `tapping` says of a table but the law.

    Raises:
        TableError: as `tapping`.
    """
    curve = with_sense_of_phase(curve_of(table), table.phase_sense)
    curve = _with_zero_of_free_rows(curve, table.remarks)
    if curve.phase.origin == "assumed":
        # energies of both signs differ as by a change of f0 that takes 1 - s^2 to its opposite
        frequency = curve.free_frequency_khz
        detuning = phase_readings(curve, np.zeros(curve.rows, bool)).detuning
        error = float(np.hypot(frequency.error, detuning * frequency.value))
        curve = replace(curve, free_frequency_khz=Given(frequency.value, error))
    free, held = free_rows(curve), held_rows(curve)
    lever = Lever([curve], [free])
    instrument = lever.instrument(0)
    touching = ~free & ~held & np.isfinite(curve.lag_deg)
    departure = turned(curve.lag_deg - lag_of_free_tip(curve, instrument))
    repulsive = ~free & repulsive_rows(curve, touching, departure)
    early = touching & hardly_touching_rows(motion_of(curve, instrument))
    early &= (touching & ~early).sum() >= FEWEST_ROWS
    stretches = smooth_stretches(curve, touching, repulsive)
    functions = energies_along(lever, [stretches], [repulsive])[0]
    alike = touching & ~early & ~functions.outliers, repulsive, functions.smooth
    fit, used = one_energy(lever, *alike), np.zeros(curve.rows, bool)
    if fit is not None:
        used = fit.used
        scale = np.sqrt(fit.minimum.chi2 / max(fit.minimum.degrees_of_freedom, 1))
        if scale_errors and scale > 1.0:
            fit = one_energy(lever, *alike, float(scale))
    silent = np.isnan(curve.lag_deg)
    alone = touching & ~used & ~np.isin(np.arange(curve.rows), np.concatenate([np.zeros(0, int), *stretches]))
    # why a row is not in the fit, or what it is for: the first that holds
    notes = {
        "free: fixes the zero of the phase" if curve.has_phase else "free": free,
        "excluded: the tip is held, a tenth of the free amplitude is left or less": held,
        "excluded: no phase, only a bound": silent,
        "not in the one energy: hardly touching yet, taps need not come every period": early,
        "excluded: its energy is more than 4 standard errors from the others'": functions.outliers,
        f"excluded: fewer than {FEWEST_ROWS} rows of this branch": alone,
    }
    states = {"free": free, "held": held, "touching": silent, "repulsive": repulsive}
    rows = TapRows(
        state=_named(states, "attractive"),
        energy_aj=functions.energies.energy_aj,
        energy_noise_aj=noise_of(curve, functions.energies)[0],
        virial_aj=functions.energies.virial_aj,
        largest_energy_aj=largest_energies(curve, instrument),
        used=used,
        note=_named(notes, ""),
    )
    return Tapping(
        table=table,
        curve=curve,
        rows=rows,
        fit=fit,
        functions=functions,
        scale_errors=scale_errors,
        bound_aj=None if curve.has_phase else _bound(curve, rows.largest_energy_aj[~free & ~held]),
        hysteresis=tuple(changes(curve, free=free, repulsive=repulsive)),
        speeds=None if fit is None else speeds(functions, used),
        versions={name: version_of(name) for name in ("afm-jax", "numpy", "scipy")},
    )


def _named(rows: dict[str, Mask], others: str) -> tuple[str, ...]:
    """Return of each row the name of the first rows that it is among."""
    return tuple(np.select(list(rows.values()), list(rows), others).tolist())


def _bound(curve: TappingCurve, largest_aj: Rows) -> float | None:
    """Return the bound that holds for every tap of rows with such largest energies, with 95 % for its errors."""
    quality = curve.quality_factor
    share = np.hypot(curve.relative_error, quality.error / quality.value)
    return float(np.max(largest_aj) * np.exp(1.645 * share)) if len(largest_aj) else None


def with_law(result: Tapping, model: str = LAW_MODEL) -> Tapping:
    """Return a result with the law fitted to its fast rows."""
    from fitting.infer.fit import fit  # noqa: PLC0415

    if result.speeds is None:
        return result
    curve, fast, table = result.curve, result.speeds.fast, result.table
    rows = part_of(table, np.isin(table.lines, curve.lines[fast]))
    # the zero of the phase, which free rows fixed that are left out; of several drives that of the first
    zero = next((one.value, one.standard_error) for one in result.functions.nuisances if one.kind == "phase_zero_deg")
    calibration = table.calibration | {"phase_zero_deg": zero}
    rows = replace(rows, phase_lag_deg=curve.lag_deg[fast], phase_sense="lag", calibration=calibration)
    return replace(result, law=fit(rows, model))


def curve_of(table: AmplitudeTable) -> TappingCurve:
    """Return a table's rows as a tapping curve.

    Raises:
        TableError: if it is a table of another drive, or Q is missing.
    """
    name = printable(table.source)
    if not table.tapping:
        raise TableError(
            f"{name}: is a table of a sample that moves; say '# drive = force' (or base) where the cantilever is "
            "driven, or use `afm-jax fit`"
        )
    ratio = table.drive_frequency_khz / table.free_frequency_khz
    if not 1.0 / _FARTHEST < ratio.min() <= ratio.max() < _FARTHEST:
        raise TableError(
            f"{name}: driven at {ratio.max():.3g} times the free frequency, as a higher mode is, or in another unit; "
            "energies are given only for a lever that is driven near its first resonance"
        )
    quality = np.nan_to_num(table.quality_factor or 0.0)
    if not quality:
        raise TableError(
            f"{name}: the quality factor is missing; give `quality_factor=200, quality_factor_error=2`, or the comment "
            "line '# quality_factor = 200 +- 2'"
        )
    if table.lockin_amplitude_nm is None or table.lockin_amplitude_error_nm is None:
        raise TableError(f"{name}: there is no lockin_amplitude_nm; the energy needs the lock-in's amplitude and phase")
    rows = np.isfinite(table.lockin_amplitude_nm)
    blank = np.full(table.rows, np.nan)
    lag, lag_error = (blank if part is None else part for part in (table.phase_lag_deg, table.phase_lag_error_deg))
    noise = table.lockin_amplitude_error_nm / table.lockin_amplitude_nm
    zero = table.calibration.get("phase_zero_deg")
    whole = TappingCurve(
        source=table.source,
        drive="base" if table.drive == "base" else "force",
        offset_nm=table.offset_nm,
        amplitude_nm=table.lockin_amplitude_nm,
        amplitude_error_nm=table.lockin_amplitude_error_nm,
        lag_deg=lag,
        lag_error_deg=lag_error,
        free_amplitude_nm=table.excitation_nm,
        free_amplitude_error=float(np.nanmedian(noise)),
        drive_frequency_khz=table.drive_frequency_khz,
        retract=np.zeros(table.rows, bool) if table.retract is None else table.retract == 1.0,
        **_lever_of(table, quality),
        phase_zero_deg=None if zero is None else Given(*zero),
        origin_error_nm=table.calibration.get("offset_origin_nm", (0.0, _ORIGIN_NM))[1],
        lines=np.asarray(table.lines),
        time=np.linspace(-0.5, 0.5, table.rows) if table.rows_in_order_of_time and table.rows > 1 else None,
    )
    return part_of(whole, rows)


def _lever_of(table: AmplitudeTable, quality_factor: float) -> dict[str, Any]:
    """Return what a table says of lever and calibration, with usual errors where it says none, as a curve's fields."""
    spring, mass = table.spring_constant_n_per_m, table.mass_ng
    if spring is None and mass is not None:
        spring = mass * (RAD_PER_US_PER_KHZ * table.free_frequency_khz) ** 2
    given = {
        "free_frequency_khz": (table.free_frequency_khz, table.free_frequency_error_khz),
        "quality_factor": (quality_factor, table.quality_factor_error),
        "spring_constant_n_per_m": (spring, table.spring_constant_error_n_per_m),
        "tip_calibration": table.calibration.get("tip_calibration", (1.0, None)),
    }
    usual = {
        name: Given(1.0 if value is None else value, error or USUAL_ERRORS[name] * (value or 0.0))
        for name, (value, error) in given.items()
    }
    assumed = tuple(name for name, (value, error) in given.items() if value is not None and not error)
    return {**usual, "over_spring_constant": spring is None, "assumed": assumed}


_FARTHEST = 2.0
"""Drive over free frequency, or the inverse, from which another mode is driven."""
_BEYOND_DEG = 20.0
"""How far beyond its range a lag must be to be refused: zero and noise may take it a little beyond."""
_OFF_DEG = 30.0
"""What the free tip's lag may be off by: zeros and frequencies are known better."""


def with_sense_of_phase(curve: TappingCurve, stated: str) -> TappingCurve:
    """Return a curve whose phases are lags, which of the free tip are those of frequency and Q up to a small zero.

    Args:
        curve: its phase as read.
        stated: sense of the phase, as in a table.

    Raises:
        TableError: if the phases are radians, or the zero that is stated is none of the free rows.
    """
    if not curve.has_phase:
        return curve
    readings = phase_readings(curve, free_rows(curve), ways(curve))
    zero = curve.phase_zero_deg
    # a zero that was set by the free tip says nothing of the sign
    sense = sense_of_phase(readings._replace(zero=None) if stated == "either" else readings, stated)
    lag, left = curve.lag_deg, sense.sign * sense.zero_deg
    off = float(turned(sense.zero_deg - (zero.value if zero else 0.0)))
    if abs(off) > _OFF_DEG:
        _check_zero(curve, readings, off)
        lag, left, zero = lag - sense.zero_deg, 0.0, None
    elif zero is not None:
        # of a phase that leads the zero turns, too
        zero = None if sense.assumed else Given(sense.sign * zero.value, zero.error)
    curve = replace(curve, lag_deg=sense.sign * lag, phase_zero_deg=zero, phase=sense)
    if not sense.reason:
        _check_range(curve, left)
    return curve


def _check_zero(curve: TappingCurve, readings: PhaseReadings, off: float) -> None:
    """Check a phase whose free rows are far from their lag, by as much as `off` degrees.

    Raises:
        TableError: if it is in radians, or not off by right angles though its zero is stated.
    """
    seen = readings.seen_free
    if not seen.any():
        return
    readings.refuse_radians(curve.source, "write degrees")
    if curve.phase_zero_deg is not None and abs(off - 90.0 * round(off / 90.0)) > _BEYOND_DEG:
        middle = float(np.median(curve.lag_deg[seen])) - curve.phase_zero_deg.value
        wanted = float(np.median(readings.free_lag_deg[seen]))
        raise TableError(
            f"{printable(curve.source)}: the free tip lags by {middle:.1f} degrees, by frequency and Q {wanted:.1f}: "
            "out of the range of '# phase_zero_deg'; leave that line out and the free rows set the zero, or mend the "
            "phase"
        )


def _with_zero_of_free_rows(curve: TappingCurve, remarks: tuple[str, ...]) -> TappingCurve:
    """Return a curve without the zero of the phase that its free rows have at the frequency and Q given.

    A table that was read from an instrument's file states it, and says so: taken for knowledge besides, it would count
    both twice.
    """
    stated, free = curve.phase_zero_deg, free_rows(curve) & np.isfinite(curve.lag_deg)
    read = stated is not None and free.sum() >= FEWEST_FREE_ROWS and zero_of_free_rows(stated.error) in remarks
    return replace(curve, phase_zero_deg=None) if read else curve


def _check_range(curve: TappingCurve, zero: float) -> None:
    """Check that no row under a force on the tip has a lag that would mean a tap that gains energy.

    Raises:
        TableError: naming the first row that lags by less than 0 or more than 180 degrees, by more than 20.
    """
    beyond = np.abs(turned(curve.lag_deg - zero - 90.0)) > 90.0 + _BEYOND_DEG
    beyond &= curve.amplitude_nm > 0.5 * curve.free_amplitude_nm
    if curve.drive == "force" and beyond.any():
        row = int(np.argmax(beyond))
        raise TableError(
            f"{printable(curve.source)}, line {curve.lines[row]}: lags by {curve.lag_deg[row]:.1f} degrees (free tip's "
            f"zero {zero:.1f}), outside 0 to 180, as {beyond.sum()} of {curve.rows} rows do: no tap that loses energy "
            "does; mend the phase or leave its cell blank"
        )
