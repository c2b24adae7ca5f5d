"""A tapping curve of a cantilever with three modes: the energy of a tap against the quadrature of the tip's force.

Newton's equation of three modes of a beam in time, no code under test. Modes have the tip's mass in common, frequencies
1, 6.27 and 17.55, and dampings of the same width; an elastic sphere with a viscous loss (DMT) acts on the sum of them.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting

FREQUENCY_KHZ, QUALITY, STIFFNESS, FREE_NM = 300.0, 100.0, 40.0, 20.0
MODES = (1.0, 6.267, 17.547)
"""Frequencies over the first one of a clamped beam."""
MODULUS_GPA, LOSS, RADIUS_NM = 0.5, 4e-3, 10.0
STEPS, SETTLING, SEEN = 600, 400, 20
COLUMNS = (
    *("drive_frequency_khz", "free_amplitude_nm", "offset_nm", "lockin_amplitude_nm", "lockin_amplitude_error_nm"),
    *("phase_lag_deg", "phase_lag_error_deg"),
)
HEIGHTS = -FREE_NM * np.concatenate([[1.05, 1.02], np.linspace(0.98, 0.55, 46)])


def simulated() -> tuple[np.ndarray, np.ndarray]:
    """Return complex amplitude of the tip (time as exp(i omega t)) and the energy of a tap in aJ at every height."""
    omega = 2e-3 * np.pi * FREQUENCY_KHZ
    own = omega * jnp.asarray(MODES)[:, None]
    mass, push, step = STIFFNESS / omega**2, STIFFNESS * FREE_NM / QUALITY, 2.0 * np.pi / omega / STEPS

    def force(z, v):
        depth = jnp.maximum(HEIGHTS - z, 0.0)
        elastic = 4.0 / 3.0 * MODULUS_GPA * jnp.sqrt(RADIUS_NM) * depth**1.5
        return elastic - LOSS * RADIUS_NM**1.5 * jnp.sqrt(depth) * v

    def rate(phase, q, v):
        total = push * jnp.cos(phase) + force(q.sum(0), v.sum(0))
        return v, total / mass - own**2 * q - omega / QUALITY * v

    def advance(carry, k):
        q, v, lost, read = carry
        phase, half = 2.0 * jnp.pi * k / STEPS, jnp.pi / STEPS
        a = rate(phase, q, v)
        b = rate(phase + half, q + 0.5 * step * a[0], v + 0.5 * step * a[1])
        c = rate(phase + half, q + 0.5 * step * b[0], v + 0.5 * step * b[1])
        d = rate(phase + 2.0 * half, q + step * c[0], v + step * c[1])
        lost = lost - step * force(q.sum(0), v.sum(0)) * v.sum(0)
        read = read + 2.0 / STEPS * q.sum(0) * jnp.stack([jnp.cos(phase), -jnp.sin(phase)])[:, None]
        q = q + step / 6.0 * (a[0] + 2.0 * b[0] + 2.0 * c[0] + d[0])
        v = v + step / 6.0 * (a[1] + 2.0 * b[1] + 2.0 * c[1] + d[1])
        return (q, v, lost, read), None

    @jax.jit
    def periods(q, v):
        nothing = jnp.zeros(HEIGHTS.size)
        start = (q, v, nothing, jnp.stack([nothing, nothing]))
        return jax.lax.scan(advance, start, jnp.arange(1.0 * SEEN * STEPS))[0]

    # the free first mode lags by a quarter turn
    q = jnp.zeros((3, HEIGHTS.size))
    v = q.at[0].set(FREE_NM * omega)
    for _ in range(SETTLING // SEEN):
        q, v, *_ = periods(q, v)
    _, _, lost, read = periods(q, v)
    real, imaginary = np.asarray(read) / SEEN
    return real + 1j * imaginary, np.asarray(lost) / SEEN


@pytest.mark.slow
def test_energy_of_three_modes_is_that_of_the_quadrature(tmp_path: Path):
    tip, energy = simulated()
    lines = [
        "# drive = force",
        f"# free_frequency_khz = {FREQUENCY_KHZ} +- 0.001",
        f"# quality_factor = {QUALITY} +- 0.2",
        f"# spring_constant_n_per_m = {STIFFNESS}",
        ",".join(COLUMNS),
    ]
    for height, amplitude in zip(HEIGHTS, tip, strict=True):
        size, lag = abs(amplitude), -np.degrees(np.angle(amplitude))
        lines.append(f"{FREQUENCY_KHZ},{FREE_NM},{height},{size},{0.001 * size},{lag},0.05")
    path = tmp_path / "three_modes.csv"
    path.write_text("\n".join(lines) + "\n")
    result = fitting.tapping(path)
    assert result.valid
    assert {at["amplitude_ratio"] for at in result.energies_at} >= {0.9, 0.8}
    for at in result.energies_at:
        there = np.interp(-at["amplitude_ratio"], -np.abs(tip) / FREE_NM, energy)
        assert at["energy_aj"] == pytest.approx(there, abs=at["standard_error_aj"])
        assert at["energy_aj"] == pytest.approx(there, rel=0.03)
