"""The energy of a tap off a tapping curve: closed forms, simulated truths, thresholds, what is refused, the command."""

import numpy as np
import pytest

from fitting.tapping_curves.curve import Given, Instrument, TappingCurve
from fitting.tapping_curves.energy import energies, lags_of, largest_energies

K, F0, Q = 5.4, 90.0, 200.0


def linear_curve(*, drive: str, s: float, damping: float, stiffness: float, free_nm: float = 40.0):
    """Return one row, the tip's amplitude and omega: a linear sample, its force -damping z' - stiffness z.

    The damping is in nN us/nm, the stiffness in nN/nm. Solved as m z'' + m Omega/Q (z' or lab) + k (z - z_b) = F + f.
    """
    omega, own = 2e-3 * np.pi * s * F0, 2e-3 * np.pi * F0
    mass = K / own**2
    free = K - mass * omega**2 + 1j * omega * mass * own / Q
    force = free_nm * free
    height = force / (free + stiffness + 1j * omega * damping)
    free_height = force / free
    if drive == "base":
        # the base's motion acts through the spring, the deflection is seen
        base = force / K
        seen, seen_free, reference = height - base, free_height - base, base
    else:
        seen, seen_free, reference = height, free_height, force
    one = np.ones(1)
    return (
        TappingCurve(
            source="linear",
            drive="base" if drive == "base" else "force",
            offset_nm=-20.0 * one,
            amplitude_nm=abs(seen) * one,
            amplitude_error_nm=0.1 * one,
            lag_deg=np.degrees(np.angle(reference / seen)) * one,
            lag_error_deg=0.2 * one,
            free_amplitude_nm=abs(seen_free) * one,
            drive_frequency_khz=s * F0 * one,
            retract=np.zeros(1, bool),
            free_frequency_khz=Given(F0),
            quality_factor=Given(Q),
            spring_constant_n_per_m=Given(K),
            harmonic_amplitudes_nm=dict.fromkeys(range(2, 41), 0.0 * one),
            lines=np.arange(1, 2),
        ),
        abs(height),
        omega,
    )


@pytest.mark.parametrize("drive", ["force", "base"])
@pytest.mark.parametrize("s", [0.98, 1.0, 1.03, 1.1])
def test_energy_and_virial_of_a_linear_sample_are_the_closed_forms(drive: str, s: float):
    curve, amplitude, omega = linear_curve(drive=drive, s=s, damping=0.02, stiffness=0.3)
    found = energies(curve, Instrument(F0, Q))
    # the damper takes pi c omega A^2 a period, the spring's virial is -k_s A^2/2; rounding only
    np.testing.assert_allclose(found.energy_aj, np.pi * 0.02 * omega * amplitude**2, rtol=1e-9)
    np.testing.assert_allclose(found.virial_aj, -0.15 * amplitude**2, rtol=1e-9)
    np.testing.assert_allclose(lags_of(curve, Instrument(F0, Q), found.energy_aj), curve.lag_deg, atol=0.05)
    assert largest_energies(curve, Instrument(F0, Q))[0] >= found.energy_aj[0]
