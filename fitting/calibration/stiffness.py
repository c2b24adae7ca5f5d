"""Spring constant and sensitivity: equipartition, Sader's method, the slope of a force curve; what each is worth.

Equipartition: k = 0.971 kT/<x^2> for the first mode of a rectangular lever, x the displacement of its end (Butt and
Jaschke 1995). A detector of slopes, calibrated by pressing the lever against a hard sample (static InvOLS), sees the
free mode 1.09 times too small, so that k = 0.971/1.09^2 kT/<d^2> = 0.817 kT/<d^2>.

Sader's method (Sader, Chon, Mulvaney 1999), rectangular levers: k = 0.1906 rho b^2 L Q Im Gamma(Re) omega^2, Re = rho
omega b^2/4 eta, with the hydrodynamic function Gamma of Sader 1998. It does not need the scale of the deflection.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Complex, Float
from scipy.special import kv, stdtrit

from afm_jax.checks import checked
from afm_jax.results import Result, public_result
from afm_jax.strict_json import plain
from fitting.calibration.result import CalibratedValue, Calibration
from fitting.instruments.curve import MeasuredCurve
from fitting.tables.csv_text import TableError

BOLTZMANN = 1.380649e-23
MODE_FACTOR, STATIC_TO_MODE = 0.971, 1.09
"""Share of kT that the first mode of a rectangular lever holds at its end; its slope against a pressed lever's."""
_SADER_FACTOR = 0.1906
_95 = 1.959964
AIR_K = (296.0, 3.0)
"""Temperature of lever and air where none is given."""
SCALE_ERROR = 0.05
"""Relative standard error of the deflection's scale where none is given: force curves repeat it to some per cent."""
_SIZES = "; --length-um and --width-um give k by Sader's method, which needs no such scale"
_REAL = (
    (0.91324, -0.48274, 0.46842, -0.12886, 0.044055, -0.0035117, 0.00069085),
    (1.0, -0.56964, 0.48690, -0.13444, 0.045155, -0.0035862, 0.00069085),
)
_IMAGINARY = (
    (-0.024134, -0.029256, 0.016294, -0.00010961, 0.000064577, -0.000044510),
    (1.0, -0.59702, 0.55182, -0.18357, 0.079156, -0.014369, 0.0028361),
)


@public_result()
@dataclass(frozen=True)
class Stiffness(Result):
    """A spring constant in N/m or a sensitivity in nm/V, its errors and the assumptions that it rests on.

    Attributes:
        method: "equipartition", "Sader" or "slope".
        value: the spring constant in N/m, for "slope" the sensitivity in nm/V, with its errors.
        assumed: the assumptions, a sentence each.

    It is a calibration only if it has a standard error.
    """

    method: str
    value: CalibratedValue
    assumed: tuple[str, ...]


def hydrodynamic_function(reynolds: Float[np.ndarray, "..."]) -> Complex[np.ndarray, "..."]:
    """Return Gamma of a rectangular lever: that of a circular cylinder times Sader's correction.

    Args:
        reynolds: rho omega b^2/4 eta, 1e-6 to 1e4.
    """
    root = np.sqrt(1j * np.asarray(reynolds, dtype=complex))
    cylinder = 1.0 + 4j * kv(1, -1j * root) / (root * kv(0, -1j * root))
    place = np.log10(reynolds)
    real, imaginary = (
        np.polyval(over[::-1], place) / np.polyval(under[::-1], place) for over, under in (_REAL, _IMAGINARY)
    )
    return np.asarray((real + 1j * imaginary) * cylinder)


def air_at(temperature_k: float, pressure_pa: float = 101325.0) -> tuple[float, float]:
    """Return density (kg/m^3) and viscosity (Pa s, Sutherland's formula) of dry air.

    >>> [round(1e6 * x) / 1e6 for x in air_at(293.15)]
    [1.204118, 1.8e-05]
    """
    return pressure_pa / (287.05 * temperature_k), 1.458e-6 * temperature_k**1.5 / (temperature_k + 110.4)


@checked
def equipartition(
    calibration: Calibration,
    *,
    temperature_k: tuple[float, float] | None = None,
    static: bool = True,
    scale_error: float = SCALE_ERROR,
    beside: Stiffness | None = None,
) -> Stiffness:
    """Return the spring constant from the thermal motion; without error if the deflection's scale proves to be wrong.

    Args:
        calibration: of a thermal spectrum in nm.
        temperature_k: of the lever, with its error; None: the file's, else 296 +- 3.
        static: the deflection was calibrated by the slope of a force curve (static InvOLS), not by the mode itself.
        scale_error: relative standard error of the deflection's scale; k has twice that.
        beside: the lever's spring constant by Sader's method; None: what the instrument says, if it does. Where that is
            another one, the scale was not calibrated.

    Raises:
        ValueError: if the scale's error is negative or not finite.
        TableError: if there is no valid thermal spectrum.
    """
    if not 0.0 <= scale_error < np.inf:
        raise ValueError(f"`scale_error` must be 0 or positive, but is {scale_error!r}; write 0.05 for 5 %")
    mean = calibration.mean_square
    if mean is None or mean.standard_error is None:
        raise TableError(f"{calibration.sweep.source}: gives no thermal motion; calibrate a thermal spectrum")
    temperature, error = temperature_k or (calibration.sweep.instrument.get("temperature_k", AIR_K[0]), AIR_K[1])
    factor = MODE_FACTOR / STATIC_TO_MODE**2 if static else MODE_FACTOR
    value = factor * BOLTZMANN * temperature / (1e-18 * mean.value)
    share = float(np.sqrt((mean.standard_error / mean.value) ** 2 + (error / temperature) ** 2 + 4.0 * scale_error**2))
    how = "by the slope of a force curve (static InvOLS)" if static else "for the mode itself"
    good = f"good to {100.0 * scale_error:g} % (--scale-error, 5 % unless given)"
    assumed = (
        f"The scale of the deflection is {good} and was calibrated {how}: factor {factor:.3f}.",
        "First flexural mode of a rectangular lever, the laser on its end.",
        f"The lever is at {temperature:.1f} +- {error:.1f} K.",
    )
    found = Stiffness("equipartition", _with_share(value, share), assumed)
    others = [found] if beside is None else [found, beside]
    note = disagreement(others, calibration.sweep.instrument.get("spring_constant_n_per_m"))
    return found if note is None else replace(found, value=CalibratedValue(value, None, (None, None), note))


@checked
def sader(
    calibration: Calibration,
    *,
    length_um: tuple[float, float],
    width_um: tuple[float, float],
    temperature_k: tuple[float, float] = AIR_K,
) -> Stiffness:
    """Return the spring constant of a rectangular lever from its size and how air damps it.

    Args:
        calibration: frequency and quality factor, in air.
        length_um: length of the lever and its standard error, in um.
        width_um: width of the lever and its standard error, in um; the thickness must be small beside it.
        temperature_k: temperature of the air, dry and at 1013 hPa, and its standard error, in K.
    """
    frequency, quality_factor = calibration.frequency_khz, calibration.quality_factor

    def stiffness(khz: float, quality: float, length: float, width: float, temperature: float) -> float:
        density, viscosity = air_at(temperature)
        omega, breadth = 2e3 * np.pi * khz, 1e-6 * width
        gamma = hydrodynamic_function(np.array(density * omega * breadth**2 / (4.0 * viscosity)))
        return float(_SADER_FACTOR * density * breadth**2 * 1e-6 * length * quality * np.imag(gamma) * omega**2)

    inputs = [(frequency.value, frequency.standard_error or 0.0), (quality_factor.value, quality_factor.standard_error)]
    inputs += [length_um, width_um, temperature_k]
    centre = [value for value, _ in inputs]
    value, square = stiffness(*centre), 0.0
    for place, (_, error) in enumerate(inputs):
        moved = list(centre)
        moved[place] += error or 0.0
        square += (stiffness(*moved) / value - 1.0) ** 2
    assumed = (
        "Rectangular lever, much longer than wide and than thick, in dry air of 1013 hPa; Q from air alone.",
        f"Length {length_um[0]:g} +- {length_um[1]:g} um, width {width_um[0]:g} +- {width_um[1]:g} um.",
        f"Air at {temperature_k[0]:g} K.",
        "The method itself is good to some 5 %, which is not in the interval.",
    )
    return Stiffness("Sader", _with_share(value, float(np.sqrt(square))), assumed)


def _with_share(value: float, share: float) -> CalibratedValue:
    ends = (value * float(np.exp(-_95 * share)), value * float(np.exp(_95 * share)))
    return CalibratedValue(value, value * share, ends, None)


@checked
def sensitivity(curves: Sequence[MeasuredCurve]) -> Stiffness:
    """Return the sensitivity in nm/V (InvOLS) from the slope of force curves on a hard sample.

    The slope is that of the upper half of the deflection in contact; its error the scatter over curves and branches
    (Student's interval), at least that of the straight lines.

    Args:
        curves: with a deflection in V.

    Raises:
        TableError: if there is no such deflection, or no contact.
    """
    slopes = []
    for curve in curves:
        if curve.deflection is None or curve.deflection_unit != "V":
            raise TableError(f"{curve.source}: holds no deflection in V, whose slope would give the sensitivity")
        slopes += [_slope(curve, branch) for branch in dict.fromkeys(curve.branch.tolist())]
    found = np.array([slope for slope in slopes if slope is not None])
    if not found.size:
        raise TableError(f"{curves[0].source}: the deflection rises nowhere: press the lever against a hard sample")
    values = 1.0 / found[:, 0]
    value, count = float(values.mean()), len(values)
    lines = float(np.max(found[:, 1] / found[:, 0]) * value)
    error = max(float(np.std(values, ddof=1) / np.sqrt(count)) if count > 1 else 0.0, lines / np.sqrt(count))
    wide = float(stdtrit(max(count - 1, 1), 0.975)) if count > 1 else _95
    spread = CalibratedValue(value, error, (value - wide * error, value + wide * error), None)
    assumed = (
        f"A hard sample: the deflection follows the piezo 1:1 ({count} slopes).",
        "The slope is of the end that is pressed (static InvOLS); a free mode is seen 1.09 times smaller.",
    )
    return Stiffness("slope", spread, assumed)


def _slope(curve: MeasuredCurve, branch: str) -> tuple[float, float] | None:
    """Return slope and error (V/nm) of the rows nearest to the sample, from half the deflection there upwards."""
    rows = np.flatnonzero(curve.branch == branch)
    order = rows[np.argsort(curve.offset_nm[rows], kind="stable")]
    height, volts = curve.offset_nm[order], np.asarray(curve.deflection)[order]
    free = float(np.median(volts[: max(len(volts) // 5, 1)]))
    volts = (volts - free) * np.sign(volts[-1] - free)
    low = np.flatnonzero(volts < 0.5 * volts[-1])
    touching = slice(int(low[-1]) + 1 if low.size else 0, None)
    if len(height[touching]) < 5:
        return None
    (slope, _), covariance = np.polyfit(height[touching] - height[-1], volts[touching], 1, cov=True)
    return (float(slope), float(np.sqrt(covariance[0, 0]))) if slope > 0.0 else None


def budget(calibration: Calibration | None, found: Sequence[Stiffness]) -> list[dict[str, Any]]:
    """Return what each calibrated number is worth: shares of the energy of a tap and of the law's parameters.

    On resonance the energy of a tap is pi k A (A0 sin(phi) - A)/Q: in proportion to k and to 1/Q, to first order
    independent of the frequency, and quadratic in the scale of the amplitude, which k from equipartition of the same
    deflection cancels. epsilon = 2 E/m has no k in it (m = k/omega^2 goes with it), and 1 - r^2 = 2 E/(m u^2) no scale.
    """
    rows = []
    if calibration is not None:
        air, drive = "the air's share of the loss", "first order vanishes on resonance"
        rows.append(_worth("quality_factor", calibration.quality_factor, (1.0, 1.0, 1.0), air))
        rows.append(_worth("frequency_khz", calibration.frequency_khz, (0.0, 0.0, 0.0), drive))
    for one in found:
        if one.method == "slope":
            worth, why = (2.0, 2.0, 0.0), "lengths squared; cancels with k from equipartition"
            rows.append(_worth("deflection_nm_per_volt", one.value, worth, why))
        else:
            why = "scales the energy, not the law"
            rows.append(_worth(f"spring_constant_n_per_m ({one.method})", one.value, (1.0, 0.0, 0.0), why))
    return rows


WORTH = ("energy_per_tap_share", "epsilon_share", "one_minus_r2_share")


def _worth(name: str, value: CalibratedValue, times: tuple[float, ...], why: str) -> dict[str, Any]:
    share = None if value.standard_error is None else value.standard_error / value.value
    worth = {key: None if share is None else factor * share for key, factor in zip(WORTH, times, strict=True)}
    return {"quantity": name, "share": share, **worth, "why": why}


def disagreement(found: Sequence[Stiffness], stated_n_per_m: float | None = None) -> str | None:
    """Return what a spring constant by equipartition says about the scale of the deflection; None if all agree.

    Args:
        found: spring constants of one lever.
        stated_n_per_m: what the instrument says, looked at where Sader's method was not used.
    """
    values = {one.method: one.value for one in found}
    if "equipartition" not in values:
        return None
    thermal, damped = values["equipartition"], values.get("Sader")
    wanted, share, condition, advice = stated_n_per_m, 0.1, "the instrument is right", _SIZES
    other = "the instrument"
    if damped is not None:
        wanted, share = damped.value, float(np.hypot((damped.standard_error or 0.0) / damped.value, 0.05))
        other, condition, advice = "Sader's method", "the lever's size is right", ""
    if wanted is None:
        return None
    apart = float(np.log(thermal.value / wanted))
    if abs(apart) < 1.96 * np.hypot((thermal.standard_error or 0.0) / thermal.value, share):
        return None
    return (
        f"Equipartition gives {thermal.value:.3g} N/m, {other} {wanted:.3g}: if {condition}, the deflection's nm are "
        f"{np.exp(-0.5 * apart):.3g} times the true ones (the sensitivity is wrong by this factor){advice}."
    )


def uncalibrated(found: Sequence[Stiffness]) -> str | None:
    """Return why none of the spring constants that were found is a calibration; None if one is."""
    why = doubts(found)
    return f"The spring constant is not calibrated. {why[0]}" if why and len(why) == len(found) else None


def doubts(found: Sequence[Stiffness]) -> list[str]:
    """Return why spring constants are no calibration, of those that are none."""
    return [one.value.interval_reason or "" for one in found if one.value.standard_error is None]


def stiffness_payload(calibration: Calibration, found: Sequence[Stiffness]) -> dict[str, Any]:
    """Return spring constants and budget as plain lists, numbers and strings."""
    named = {one.method.lower(): asdict(one.value) | {"assumed": list(one.assumed)} for one in found}
    found_out = {"note": next(iter(doubts(found)), None)}
    reason = uncalibrated(found)
    if reason is not None:
        found_out |= {"valid": False, "reasons": [*calibration.reasons, reason]}
    return plain({"spring_constant_n_per_m": named, "budget": budget(calibration, found)} | found_out)
