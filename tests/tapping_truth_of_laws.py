"""Tapping curves of impact laws in closed form: amplitude, lag, energy of a tap, virial; no code under test.

The tip's motion less the free one flies freely between impacts on a sample that moves with the free amplitude. For an
approach speed u the law gives the rebound speed w; flight and law then fix cosine and sine of the phase of the impact
linearly, and u is where their squares add up to one. The impulse m (u + w) once a period is the force: its first
harmonic gives the reading, m (u^2 - w^2)/2 the energy.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from fitting.tables.table import AmplitudeTable

RAD_PER_US = 2e-3 * np.pi


class Tip(NamedTuple):
    """A cantilever, its drive and its free amplitude."""

    free_nm: float = 40.0
    ratio: float = 1.0
    quality: float = 200.0
    stiffness: float = 5.4
    frequency_khz: float = 90.0
    drive: str = "force"

    @property
    def gamma(self) -> complex:
        """Dynamic stiffness over k at the drive's frequency."""
        return 1.0 - self.ratio**2 + 1j * self.ratio / self.quality

    @property
    def free_reading(self) -> tuple[float, float]:
        """Amplitude and lag that the free tip shows."""
        if self.drive == "force":
            return self.free_nm, float(np.degrees(np.angle(self.gamma)))
        shown = 1.0 - self.gamma
        return self.free_nm * abs(shown), float(np.degrees(np.angle(self.gamma) - np.angle(shown)))


class Truth(NamedTuple):
    """What a curve is, row by row."""

    height_nm: np.ndarray
    amplitude_nm: np.ndarray
    lag_deg: np.ndarray
    energy_aj: np.ndarray
    virial_aj: np.ndarray

    def at(self, column: str, ratio: np.ndarray, free: float) -> np.ndarray:
        """Return a column at amplitudes, of the free one."""
        order = np.argsort(self.amplitude_nm)
        return np.interp(ratio, self.amplitude_nm[order] / free, getattr(self, column)[order])


def truth_of(tip: Tip, height: np.ndarray, amplitude: np.ndarray, lag: np.ndarray, energy: np.ndarray) -> Truth:
    """Return what is read of a tip that moves with an amplitude and a lag behind a force, and its virial.

    A base that shakes moves the tip as a force on it does; what is read is the deflection, D = Z + gamma A0.
    """
    z = -amplitude * np.exp(-1j * (np.radians(lag) - np.angle(tip.gamma)))
    virial = 0.5 * tip.stiffness * np.real(tip.gamma * (z + tip.free_nm) * np.conj(z))
    seen = z if tip.drive == "force" else z + tip.gamma * tip.free_nm
    lag = np.degrees(np.angle(tip.gamma) - np.angle(-seen)) % 360.0
    return Truth(height, np.abs(seen), lag, energy, virial)


def curve_of_law(tip: Tip, heights_nm: np.ndarray, rebound: Callable[[np.ndarray], np.ndarray]) -> Truth:
    """Return the curve of a law: the fastest impact a period whose flight stays above the sample; rows without go."""
    free, own = tip.free_nm, RAD_PER_US * tip.frequency_khz
    mass, omega = tip.stiffness / own**2, own * tip.ratio
    period, decay = 2.0 * np.pi / omega, own / (2.0 * tip.quality)
    ring = np.sqrt(own**2 - decay**2)

    def flown(time: Any) -> tuple[Any, Any, Any, Any]:
        c, s = np.exp(-decay * time) * np.cos(ring * time), np.exp(-decay * time) * np.sin(ring * time)
        return c + decay / ring * s, s / ring, -(own**2) / ring * s, c - decay / ring * s

    a, b, c, d = flown(period)
    matrix = np.array([[free * (1.0 - a), free * omega * b], [-free * c, free * omega * (d - 1.0)]])

    def phase(u: Any, height: float) -> np.ndarray:
        w = rebound(u)
        return np.linalg.solve(matrix, np.stack([(a - 1.0) * height + b * w, c * height + d * w + u]))

    def off(u: Any, height: float) -> Any:
        return np.sum(phase(u, height) ** 2, axis=0) - 1.0

    speeds = np.geomspace(1e-3, 4.0 * free * omega, 600)
    time = np.linspace(0.0, period, 400)[1:-1]
    p, q, _, _ = flown(time)
    rows = []
    for height in heights_nm.tolist():
        signs = np.sign(off(speeds, height))
        for i in np.flatnonzero(signs[:-1] * signs[1:] < 0.0)[::-1]:
            u: Any = brentq(off, speeds[i], speeds[i + 1], args=(height,), xtol=1e-14, rtol=np.float64(1e-14))
            cosine, sine = phase(u, height)
            angle, w = np.arctan2(sine, cosine), float(rebound(u))
            gap = p * (height + free * cosine) + q * (w - free * omega * sine) - height
            if np.min(gap - free * np.cos(omega * time + angle)) < -1e-6 * free:
                continue
            force = 2.0 * mass * (u + w) / period * np.exp(-1j * angle)
            z = -free + force / (tip.stiffness * tip.gamma)
            seen = z if tip.drive == "force" else z + tip.gamma * free
            lag = np.degrees(np.angle(tip.gamma) - np.angle(-seen)) % 360.0
            rows.append((height, abs(seen), lag, 0.5 * mass * (u**2 - w**2), 0.5 * np.real(force * np.conj(z))))
            break
    return Truth(*np.array(rows).T)


GRAPHITE = Tip(free_nm=13.4, quality=230.0, stiffness=44.0, frequency_khz=344.6)
SHARP = {"noise": 0.0015, "phase_noise_deg": 0.12}
"""Noise of its measured curves."""


def curve_like_graphite(rows: int = 150) -> Truth:
    """Return a curve through measured figures of graphite: the energy grows, the lag rises, then falls below 90."""
    ratio = np.linspace(0.985, 0.795, rows)
    places = np.array([0.78, 0.80, 0.86, 0.90, 0.912, 0.92, 0.94, 0.98, 1.0])
    energy = np.array([12.3, 12.0, 10.9, 9.3, np.nan, 7.6, 4.2, 1.6, 0.0])
    lost = np.pi * GRAPHITE.stiffness * GRAPHITE.free_nm**2 / GRAPHITE.quality
    # a lag of 90 degrees is where the energy is the most that a tap can take at this amplitude
    energy[4] = lost * places[4] * (1.0 - places[4])
    lag = np.degrees(np.arcsin(energy / (lost * places) + places))
    lag = PchipInterpolator(places, np.where(places < 0.912, lag, 180.0 - lag))(ratio)
    amplitude, n = ratio * GRAPHITE.free_nm, np.arange(2, 41)[:, None]
    z = -amplitude * np.exp(-1j * np.radians(lag - 90.0))
    over_k = 1j / GRAPHITE.quality * (z + GRAPHITE.free_nm)
    at_harmonics = n * np.abs(over_k) / np.abs(1.0 - n**2 + 1j * n / GRAPHITE.quality)
    taken = -np.pi * GRAPHITE.stiffness * np.imag(over_k * np.conj(z))
    taken -= np.pi * GRAPHITE.stiffness / GRAPHITE.quality * np.sum(at_harmonics**2, axis=0)
    return Truth(-amplitude, amplitude, lag, taken, 0.5 * GRAPHITE.stiffness * np.real(over_k * np.conj(z)))


def curve_of_energy(tip: Tip, ratio: np.ndarray, energy_aj: np.ndarray, repulsive: np.ndarray) -> Truth:
    """Return the curve on resonance of given energies over the amplitude: the lag balances them, harmonics too."""
    amplitude, lag, n = ratio * tip.free_nm, np.full(len(ratio), 90.0), np.arange(2, 41)[:, None]
    tap = np.pi * tip.stiffness
    for _ in range(60):
        z = -amplitude * np.exp(-1j * np.radians(lag - 90.0))
        force = 1j / tip.quality * (z + tip.free_nm)
        lost = tap / tip.quality * np.sum((n * np.abs(force) / np.abs(1.0 - n**2 + 1j * n / tip.quality)) ** 2, axis=0)
        sine = ((energy_aj + lost) / (tap * amplitude) + amplitude / tip.quality) / (tip.free_nm / tip.quality)
        lag = np.degrees(np.arcsin(np.minimum(sine, 1.0)))
        lag = np.where(repulsive, lag, 180.0 - lag)
    return truth_of(tip, -amplitude, amplitude, lag, energy_aj)


class Stated(NamedTuple):
    """Relative errors of what a table states, drawn from them, and its noise."""

    frequency: float = 1e-5
    quality: float = 0.01
    stiffness: float = 0.05
    noise: float = 0.003
    phase_noise_deg: float = 0.15


FREE_ROWS = 12
"""In front of the rows in contact."""


def error_implied(tip: Tip, truth: Truth, stated: Stated) -> np.ndarray:
    """Return the standard error of each row's energy by its own noise and by what is stated of the instrument, in aJ.

    By differences of the energy that amplitude and lag have at another instrument. Free rows set the zero of the lag
    and the free amplitude; what the air takes at the harmonics of a brief impact is known to a tenth.
    """
    free, lag = tip.free_reading
    departure, n = truth.lag_deg - lag, np.arange(2, 41)[:, None]

    def parts(at: Tip = tip, amplitude: Any = truth.amplitude_nm, turn: float = 0.0, factor: float = 1.0) -> tuple:
        shown = at.free_nm if at.drive == "force" else free / abs(1.0 - at.gamma)
        shown *= factor
        seen = -amplitude * np.exp(-1j * (np.radians(at.free_reading[1] + departure + turn) - np.angle(at.gamma)))
        z = seen if at.drive == "force" else seen - at.gamma * shown
        over_k = at.gamma * (z + shown)
        at_harmonics = n * np.abs(over_k) / np.abs(1.0 - (n * at.ratio) ** 2 + 1j * n * at.ratio / at.quality)
        lost = np.pi * at.stiffness * at.ratio / at.quality * np.sum(at_harmonics**2, axis=0)
        return -np.pi * at.stiffness * np.imag(over_k * np.conj(z)) - lost, lost

    energy, lost = parts()
    of_means = FREE_ROWS**-0.5
    changes = [
        parts(amplitude=truth.amplitude_nm * (1.0 + stated.noise))[0],
        parts(turn=stated.phase_noise_deg)[0],
        parts(tip._replace(ratio=tip.ratio / (1.0 + stated.frequency)))[0],
        parts(tip._replace(quality=tip.quality * (1.0 + stated.quality)))[0],
        parts(tip._replace(stiffness=tip.stiffness * (1.0 + stated.stiffness)))[0],
        parts(turn=of_means * stated.phase_noise_deg)[0],
        parts(factor=1.0 + of_means * stated.noise)[0],
        energy + 0.1 * lost,
    ]
    return np.linalg.norm([one - energy for one in changes], axis=0)


def table_of(
    tip: Tip,
    truth: Truth,
    stated: Stated,
    rng: np.random.Generator,
    *,
    free_rows: int = FREE_ROWS,
    back: Truth | None = None,
    phase_drift_deg: float = 0.0,
    amplitude_drift: float = 0.0,
    **also: Any,
) -> AmplitudeTable:
    """Return a curve as it would be measured: free rows in front, noise, an instrument off by its stated errors.

    Args:
        tip: the cantilever.
        truth: what it does in contact.
        stated: errors of the instrument and of the readings.
        rng: what they are drawn from.
        free_rows: how many there are.
        back: what it does as the sample goes again, its rows in the order of those before.
        phase_drift_deg: of the lag, from the first row to the last.
        amplitude_drift: of the amplitude, as a fraction.
        also: columns and comments of the table.
    """
    free, lag = tip.free_reading
    ahead = truth.height_nm.min() - tip.free_nm * np.linspace(0.5, 0.1, free_rows)

    def rows(way: Truth) -> list[np.ndarray]:
        at_first = (ahead, np.full(free_rows, free), np.full(free_rows, lag))
        return [np.concatenate(part) for part in zip(at_first, way[:3], strict=True)]

    columns = rows(truth)
    if back is not None:
        also = {"retract": np.repeat([0.0, 1.0], len(columns[0]))} | also
        columns = [np.concatenate([out, way[::-1]]) for out, way in zip(columns, rows(back), strict=True)]
    height, amplitude, lags = columns
    every, time = np.ones(len(height)), np.linspace(-0.5, 0.5, len(height))
    frequency, quality, stiffness = (
        value * (1.0 + error * rng.normal())
        for value, error in zip((tip.frequency_khz, tip.quality, tip.stiffness), stated[:3], strict=True)
    )
    read = amplitude * (1.0 + amplitude_drift * time) * (1.0 + stated.noise * rng.normal(size=len(height)))
    read_lag = lags + 3.0 + phase_drift_deg * time + stated.phase_noise_deg * rng.normal(size=len(height))
    own: dict[str, Any] = {
        "drive": tip.drive,
        "drive_frequency_khz": tip.ratio * tip.frequency_khz * every,
        "free_amplitude_nm": free * every,
        "offset_nm": height,
        "lockin_amplitude_nm": read,
        "lockin_amplitude_error_nm": stated.noise * amplitude,
        "phase_lag_deg": read_lag,
        "phase_lag_error_deg": stated.phase_noise_deg * every,
        "free_frequency_khz": frequency,
        "free_frequency_error_khz": stated.frequency * frequency,
        "quality_factor": quality,
        "quality_factor_error": stated.quality * quality,
        "spring_constant_n_per_m": stiffness,
        "spring_constant_error_n_per_m": stated.stiffness * stiffness,
        "calibration": {"tip_calibration": (1.0, 1e-6)},
        "phase_sense": "lag",
    }
    return AmplitudeTable(**(own | also))
