"""The spring constant of a lever: by equipartition, and by Sader's method.

Equipartition: k = 0.971 kT/<x^2> for the first mode of a rectangular lever, x the displacement of its end (Butt and
Jaschke 1995). A detector of slopes, calibrated by pressing the lever against a hard sample (static InvOLS), sees the
free mode 1.09 times too small, so that k = 0.971/1.09^2 kT/<d^2> = 0.817 kT/<d^2>.
"""

import numpy as np
from jaxtyping import Complex, Float
from scipy.special import kv

from afm_jax.checks import checked

BOLTZMANN = 1.380649e-23
MODE_FACTOR, STATIC_TO_MODE = 0.971, 1.09
"""Share of kT that the first mode of a rectangular lever holds at its end; its slope against a pressed lever's."""
_REAL = (
    (0.91324, -0.48274, 0.46842, -0.12886, 0.044055, -0.0035117, 0.00069085),
    (1.0, -0.56964, 0.48690, -0.13444, 0.045155, -0.0035862, 0.00069085),
)
_IMAGINARY = (
    (-0.024134, -0.029256, 0.016294, -0.00010961, 0.000064577, -0.000044510),
    (1.0, -0.59702, 0.55182, -0.18357, 0.079156, -0.014369, 0.0028361),
)


def equipartition(mean_square_nm2: float, temperature_k: float, *, static: bool) -> float:
    """Return the spring constant in N/m from the thermal <x^2> of the first mode in nm^2.

    Args:
        mean_square_nm2: <x^2> as the detector shows it.
        temperature_k: of the lever.
        static: the deflection was calibrated by the slope of a force curve (static InvOLS), not by the mode itself.
    """
    factor = MODE_FACTOR / STATIC_TO_MODE**2 if static else MODE_FACTOR
    return factor * BOLTZMANN * temperature_k / (1e-18 * mean_square_nm2)


def hydrodynamic_function(reynolds: Float[np.ndarray, "..."]) -> Complex[np.ndarray, "..."]:
    """Return Gamma of a rectangular lever (Sader 1998): that of a circular cylinder times a correction.

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
def sader(
    frequency_khz: float, quality_factor: float, length_um: float, width_um: float, temperature_k: float = 296.0
) -> float:
    """Return the spring constant of a rectangular lever in N/m, from its size and how air damps it.

    k = 0.1906 rho b^2 L Q Im Gamma(Re) omega^2 with Re = rho omega b^2/4 eta (Sader, Chon, Mulvaney 1999). The scale of
    the deflection does not matter. The method itself is good to some 5 %.

    Args:
        frequency_khz: natural frequency in air.
        quality_factor: Q, by air alone.
        length_um: length of the lever L.
        width_um: width b; the thickness must be small beside it.
        temperature_k: of the air, dry and at 1013 hPa.
    """
    density, viscosity = air_at(temperature_k)
    omega, breadth = 2e3 * np.pi * frequency_khz, 1e-6 * width_um
    gamma = hydrodynamic_function(np.array(density * omega * breadth**2 / (4.0 * viscosity)))
    return float(0.1906 * density * breadth**2 * 1e-6 * length_um * quality_factor * np.imag(gamma) * omega**2)
