"""Tapping curves of a force between tip and sample, by Newton's equation in time; no code under test.

    python -m tests.tapping_truth_of_forces

makes those that are missing in `tests/tapping_tables` (three minutes for all). The force is van der Waals attraction
outside, larger as the tip leaves (that hysteresis takes energy far out), and inside an elastic sphere (DMT) with a
viscous loss. Energies come from the ledger of the motion, the integral of -F v over a period.
"""

import argparse
from itertools import product
from pathlib import Path

import numpy as np

from tests.tapping_truth_of_laws import RAD_PER_US, Tip, Truth, truth_of

FOLDER = Path(__file__).with_name("tapping_tables")
QUALITIES, RATIOS = (150.0, 400.0), (0.99, 1.0, 1.03, 1.05)
FREE_NM, STIFFNESS, FREQUENCY_KHZ = 20.0, 40.0, 300.0
HEIGHTS = 80
SAMPLES = {
    # nm, nN nm, hysteresis, GPa, nN us/nm^2
    "attractive": (0.2, 0.3, 0.3, 2.0, 2e-3),
    "repulsive": (0.2, 0.0, 0.0, 0.5, 4e-3),
}
"""Closest distance, strength of the attraction (H R/6), by what share it is larger on the way out, modulus, loss."""
_RADIUS_NM, _STEPS = 10.0, 500
_SETTLING, _SEEN = 12.0, 32
"""Decay times of the free cantilever that pass before a motion is read, and periods that are read."""


def path_of(sample: str, quality: float, ratio: float) -> Path:
    """Return where a curve is kept."""
    return FOLDER / f"forces_{sample}_{quality:g}_{ratio:g}.csv"


def curve_of_force(sample: str, quality: float, ratio: float, drive: str) -> tuple[Tip, Truth]:
    """Return the cantilever of a curve and what it does, row by row."""
    kept = np.loadtxt(path_of(sample, quality, ratio), delimiter=",", skiprows=1)
    height, amplitude, lag, energy = kept.T
    tip = Tip(FREE_NM, ratio, quality, STIFFNESS, FREQUENCY_KHZ, drive)
    return tip, truth_of(tip, height, amplitude, lag, energy)


def simulate(sample: str) -> None:
    """Follow the tip at all heights, quality factors and frequencies at once, and write what it settles on."""
    import jax  # noqa: PLC0415
    import jax.numpy as jnp  # noqa: PLC0415
    from jax import lax  # noqa: PLC0415

    closest, attraction, more, modulus, viscosity = SAMPLES[sample]
    heights = -FREE_NM * np.linspace(1.04, 0.2, HEIGHTS)
    cases = list(product(QUALITIES, RATIOS))
    quality, ratio, height = (
        jnp.asarray(column) for column in np.array([(q, s, h) for q, s in cases for h in heights]).T
    )
    own = RAD_PER_US * FREQUENCY_KHZ
    mass, omega = STIFFNESS / own**2, own * ratio
    gamma = 1.0 - ratio**2 + 1j * ratio / quality
    push = STIFFNESS * FREE_NM * jnp.abs(gamma)
    # lengths of the numbers of steps go with the slowest decay
    periods = int(_SETTLING * 2.0 * max(QUALITIES) / (2.0 * np.pi))
    step = 2.0 * np.pi / omega / _STEPS

    def force(z, v):
        gap = z - height
        pull = -attraction / jnp.maximum(gap, closest) ** 2 * jnp.where(v > 0.0, 1.0 + more, 1.0)
        depth = jnp.maximum(closest - gap, 0.0)
        return (
            pull
            + 4.0 / 3.0 * modulus * jnp.sqrt(_RADIUS_NM) * depth**1.5
            - viscosity * jnp.sqrt(_RADIUS_NM * depth) * v * _RADIUS_NM
        )

    def rate(phase, z, v):
        total = push * jnp.cos(phase) - STIFFNESS * z - mass * own / quality * v + force(z, v)
        return v, total / mass

    def advance(carry, k):
        z, v, lost, inside = carry
        phase = 2.0 * jnp.pi * k / _STEPS
        half, whole = jnp.pi / _STEPS, 2.0 * jnp.pi / _STEPS
        a = rate(phase, z, v)
        b = rate(phase + half, z + 0.5 * step * a[0], v + 0.5 * step * a[1])
        c = rate(phase + half, z + 0.5 * step * b[0], v + 0.5 * step * b[1])
        d = rate(phase + whole, z + step * c[0], v + step * c[1])
        lost = lost - step * force(z, v) * v
        inside = inside + z * jnp.exp(-1j * phase)
        z = z + step / 6.0 * (a[0] + 2.0 * b[0] + 2.0 * c[0] + d[0])
        v = v + step / 6.0 * (a[1] + 2.0 * b[1] + 2.0 * c[1] + d[1])
        return (z, v, lost, inside), None

    @jax.jit
    def period(carry):
        z, v = carry
        nothing = jnp.zeros_like(z)
        (z, v, lost, inside), _ = lax.scan(advance, (z, v, nothing, nothing + 0j), jnp.arange(_STEPS))
        return (z, v), lost, 2.0 * inside / _STEPS

    lag = jnp.angle(gamma)
    carry = FREE_NM * jnp.cos(-lag), -FREE_NM * omega * jnp.sin(-lag)
    for _ in range(periods):
        carry, _, _ = period(carry)
    lost, phasors = [], []
    for _ in range(_SEEN):
        carry, energy, phasor = period(carry)
        lost.append(np.asarray(energy))
        phasors.append(np.asarray(phasor))
    phasor, energy = np.mean(phasors, axis=0), np.mean(lost, axis=0)
    steady = np.std(np.abs(phasors), axis=0) < 2e-4 * FREE_NM
    columns = np.stack([np.asarray(height), np.abs(phasor), -np.degrees(np.angle(phasor)), energy], axis=1)
    for k, (q, s) in enumerate(cases):
        here = slice(k * HEIGHTS, (k + 1) * HEIGHTS)
        # rows on which the motion repeats, in front of the first that does not
        first = int(np.argmin(steady[here])) if not steady[here].all() else HEIGHTS
        np.savetxt(
            path_of(sample, q, s),
            columns[here][:first],
            delimiter=",",
            fmt="%.7g",
            header="height_nm,amplitude_nm,lag_deg,energy_aj",
            comments="",
        )


def main() -> None:
    """Make every curve that is missing."""
    import jax  # noqa: PLC0415

    argparse.ArgumentParser(description=__doc__).parse_args()
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    for sample in SAMPLES:
        if not all(path_of(sample, *case).exists() for case in product(QUALITIES, RATIOS)):
            simulate(sample)


if __name__ == "__main__":
    main()
