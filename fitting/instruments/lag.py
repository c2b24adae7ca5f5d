"""The lag of the tip behind its drive, out of a phase with an instrument's own sign and zero.

Some instruments store the lag, others its negative, others either of them less the free tip's. Read with the wrong sign
a curve has other energies: with Delta how far a row lags behind the free tip, a its amplitude over the free one, and
gamma = 1 - s^2 + i s/Q, a force on the tip that shakes the cantilever gives in each period, over pi k A0^2,

    e = Im(gamma (a exp(i Delta) - a^2)) = a ((s/Q) (cos Delta - a) + (1 - s^2) sin Delta)

to the sample, so that the sign matters off resonance and hardly on it. What decides is physics: no tap gives energy
away, so that the sign with which many would is the wrong one. On resonance the order of the branches may decide, for
attraction reaches farther than repulsion. A statement of the caller (`phase_sense`) stands above both.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from afm_jax.words import printable
from fitting.tables.csv_text import TableError

Numbers = float | Float[np.ndarray, "..."]
Rows = Float[np.ndarray, " rows"]
SENSES = {"lag": 1.0, "lead": -1.0}
"""What a phase may be stated to be, and the sign with which it becomes a lag."""
LEAST_RATIO = 0.1
"""Of the free amplitude: below it the sample holds the tip, and the phase is that of anything."""
_SURE = 4.0
"""Standard errors below zero from which an energy is impossible."""
_FEWEST, _SHARE = 3, 0.05
"""Rows from which energies below zero speak against a sign, and share of the taps from which against both."""
_NEAR_DEG = 20.0
"""How near to a lag of the opposite sign the free tip's phase must be to be taken for one, on resonance."""


def free_lag_deg(drive: str, frequency_ratio: Numbers, quality_factor: Numbers) -> Float[np.ndarray, "..."]:
    """Return the lag of the free tip behind its drive in degrees: of its height (force) or of the deflection (base).

    With gamma = 1 - s^2 + i s/Q the height lags by arg gamma, the deflection behind the base by arg gamma - arg(1 -
    gamma).

    >>> [round(float(free_lag_deg(drive, 1.0, 200.0)), 2) for drive in ("force", "base")]
    [90.0, 90.29]
    """
    gamma = 1.0 - frequency_ratio**2 + 1j * frequency_ratio / quality_factor
    lag = np.angle(gamma) - (np.angle(1.0 - gamma) if drive == "base" else 0.0)
    return np.asarray(np.rad2deg(lag))


def turned(degrees: Numbers) -> Float[np.ndarray, "..."]:
    """Return angles between -180 and 180 degrees."""
    return np.asarray((degrees + 180.0) % 360.0 - 180.0)


class PhaseReadings(NamedTuple):
    """Amplitudes and phases as read, of a curve or an image, and what is known of lever and drive; arrays (rows,).

    Attributes:
        drive: "force" or "base".
        frequency_ratio: s, drive over free frequency.
        frequency_error: relative standard error of s.
        quality_factor: Q.
        quality_error: relative standard error of Q.
        ratio: amplitude over that of the free tip.
        ratio_error: its standard error.
        phase_deg: as read; NaN where there is none.
        phase_error_deg: its standard error.
        free: rows of the free tip.
        ways: rows of one drive on one way, the farthest from the sample first; empty where heights are not known.
        zero: of the phase and its standard error, if that is known apart from the free tip.
    """

    drive: str
    frequency_ratio: Rows
    frequency_error: float
    quality_factor: float
    quality_error: float
    ratio: Rows
    ratio_error: Rows
    phase_deg: Rows
    phase_error_deg: Rows
    free: Bool[np.ndarray, " rows"]
    ways: Sequence[np.ndarray] = ()
    zero: tuple[float, float] | None = None

    @property
    def free_lag_deg(self) -> Rows:
        """What frequency and Q say that the free tip's lag is."""
        return free_lag_deg(self.drive, self.frequency_ratio, self.quality_factor)

    @property
    def disturbed(self) -> tuple["PhaseReadings", "PhaseReadings"]:
        """The readings with another frequency, and with another Q: by the standard error of each."""
        ratio, quality = self.frequency_ratio, self.quality_factor
        return (
            self._replace(frequency_ratio=ratio * (1.0 + self.frequency_error)),
            self._replace(quality_factor=quality * (1.0 + self.quality_error)),
        )

    @property
    def seen_free(self) -> Bool[np.ndarray, " rows"]:
        """Rows of the free tip that have a phase."""
        return self.free & np.isfinite(self.phase_deg)

    def zero_deg(self, sign: float) -> Rows:
        """Return what the phase reads where the lag is 0: of each frequency by its free rows, else by all of them."""
        off = self.phase_deg - sign * self.free_lag_deg
        zero = np.full(len(off), 0.0 if self.zero is None else self.zero[0])
        if self.seen_free.any():
            zero[:] = _mean_angle(off[self.seen_free])
        for s in np.unique(self.frequency_ratio[self.seen_free]):
            here = self.frequency_ratio == s
            zero[here] = _mean_angle(off[here & self.seen_free])
        return zero

    def behind_deg(self, sign: float) -> Rows:
        """Return how far each row lags behind the free tip, the phase taken with a sign."""
        return turned(sign * (self.phase_deg - self.zero_deg(sign)) - self.free_lag_deg)

    def energy(self, behind_deg: Rows) -> Rows:
        """Return the first harmonic's energy of a tap over pi k A0^2, of rows that lag so far behind the free tip.

        It is what the tap takes and what the air takes at the harmonics, so that it is above zero. Under a base the
        deflection is read, D = Z + gamma A0 = -A0 (1 - gamma) a exp(-i Delta).
        """
        s = self.frequency_ratio
        gamma = 1.0 - s**2 + 1j * s / self.quality_factor
        phasor = self.ratio * np.exp(1j * np.deg2rad(behind_deg))
        of_height = np.imag(gamma * (phasor - self.ratio**2))
        if self.drive != "base":
            return of_height
        of_base = np.imag((1.0 - gamma) * (1.0 - np.conj(phasor)))
        return np.abs(1.0 - gamma) ** 2 * of_height + np.abs(gamma) ** 2 * of_base

    def refuse_radians(self, source: str, mend: str) -> None:
        """Check that the phase is not in radians: read as such it would be the lag of the free tip to 30 degrees.

        Args:
            source: the file.
            mend: what to do.

        Raises:
            TableError: if it is.
        """
        level = float(np.median(self.phase_deg[self.seen_free]))
        lag = float(np.median(self.free_lag_deg[self.seen_free]))
        near = abs(np.rad2deg(abs(level)) - lag) < 30.0 < lag
        if near and np.nanmax(np.abs(self.phase_deg)) < 2.0 * np.pi and abs(np.rad2deg(level)) > 0.5 * lag:
            raise TableError(
                f"{printable(source)}: the phase reads {level:.3g} where the tip is free and lags by {lag:.1f} "
                f"degrees: it is in radians; {mend}"
            )

    @property
    def detuning(self) -> float:
        """The largest factor of a sin Delta in the energy, all that depends on the sign: 1 - s^2 under a force."""
        quarter = np.full(len(self.ratio), 90.0)
        return float(np.max(np.abs(self.energy(quarter) - self.energy(-quarter)) / (2.0 * self.ratio)))

    def giving_energy_away(self, sign: float) -> int:
        """Return how many rows have energies below zero beyond all errors, with a sign of a phase of known zero."""
        behind = self.behind_deg(sign)
        start = self.energy(behind)
        # phases may drift by half a degree along a curve
        lag_error = np.hypot(self.phase_error_deg, 0.5)
        if not self.seen_free.any() and self.zero is not None:
            lag_error = np.hypot(lag_error, self.zero[1])
        others = (self._replace(ratio=self.ratio + self.ratio_error), *self.disturbed)
        moved = [self.energy(behind + lag_error), *(other.energy(behind) for other in others)]
        error = np.linalg.norm(np.array(moved) - start, axis=0)
        with np.errstate(invalid="ignore"):
            return int(np.sum((start < -_SURE * error) & (self.ratio > LEAST_RATIO)))

    def sign_by_energy(self) -> float | None:
        """Return the sign with which taps lose energy where they would gain it with the other.

        0: with both signs many would; None: the energies do not tell.
        """
        taps = np.sum(np.isfinite(self.phase_deg) & (self.ratio > LEAST_RATIO) & ~self.free)
        against = {sign: self.giving_energy_away(sign) for sign in (1.0, -1.0)}
        for sign, count in against.items():
            # five times more rows contradict the other sign
            if against[-sign] >= _FEWEST and against[-sign] > 5.0 * count:
                return sign
        return 0.0 if min(against.values()) >= max(_FEWEST, _SHARE * float(taps)) else None

    def sign_by_order(self) -> float | None:
        """Return the sign with which the tip is attracted before it is repelled; None where no order shows.

        Attraction lags behind the free tip and reaches farther than repulsion: on each way that has both, the outer
        stretch of rows is the attractive one.
        """
        found = set()
        for way in self.ways:
            rows = way[(self.ratio[way] > LEAST_RATIO) & np.isfinite(self.phase_deg[way]) & ~self.free[way]]
            behind = self.behind_deg(1.0)[rows]
            # a row is on one side from a degree on, beyond errors
            clear = np.abs(behind) > np.maximum(_SURE * self.phase_error_deg[rows], 1.0)
            sides = np.sign(behind[clear])
            stretches = np.split(sides, np.flatnonzero(np.diff(sides)) + 1)
            long = [float(part[0]) for part in stretches if len(part) >= _FEWEST]
            # a stretch that is interrupted by a few rows is one
            order = [side for k, side in enumerate(long) if k == 0 or side != long[k - 1]]
            if len(order) == 2:
                found.add(order[0])
        return found.pop() if len(found) == 1 else None


def _mean_angle(degrees: Rows) -> float:
    """Return the median of angles that may differ by whole turns."""
    first = float(degrees[0])
    return float(turned(first + np.median(turned(degrees - first))))


class PhaseSense(NamedTuple):
    """How a phase becomes a lag, lag = sign (phase - zero_deg), and how sign and zero are known.

    Attributes:
        sign: 1 of a lag, -1 of a phase that leads.
        zero_deg: what the phase reads where the lag is 0, in the median of the rows.
        origin: of the sign: "stated", "energy" or "order" (the curve decides), "assumed" (on resonance, where energies
            hardly depend on it) or "unknown".
        notes: sentences about sign and zero.
        reason: why no energy is known, naming what decides; empty where one is.
    """

    sign: float = 1.0
    zero_deg: float = 0.0
    origin: str = "stated"
    notes: tuple[str, ...] = ()
    reason: str = ""

    @property
    def assumed(self) -> bool:
        """Whether attractive and repulsive may be exchanged."""
        return self.origin in {"assumed", "unknown"}

    def lag_deg(self, phase_deg: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the lag of a phase."""
        return self.sign * (phase_deg - self.zero_deg)


AS_STATED = PhaseSense()
"""A phase that is a lag."""
SENSE_OPTION = '`phase_sense="lag|lead"`'
"""What says the sign; the command line writes it as its own option."""


def sense_of_phase(readings: PhaseReadings, stated: str = "") -> PhaseSense:
    """Return sign and zero of a phase: as stated, else as the readings decide, else assumed on resonance or unknown.

    Args:
        readings: amplitudes and phases, as read.
        stated: "lag" or "lead"; empty or "either": not known.
    """
    # the free tip, or a statement, determines the zero of the phase
    known_zero = bool(readings.seen_free.any()) or readings.zero is not None
    by_energy = readings.sign_by_energy() if known_zero else None
    # energies of all rows hardly depend on the sign
    # on resonance |1 - s^2| is at most half of 1/Q
    on_resonance = readings.detuning <= 0.5 / readings.quality_factor
    off = [abs(float(np.median(turned(readings.zero_deg(one))))) for one in (1.0, -1.0)]
    decided = {
        "stated": SENSES.get(stated),
        "energy": by_energy or None,
        "order": readings.sign_by_order() if on_resonance and known_zero else None,
        "assumed" if on_resonance else "unknown": -1.0 if off[1] < _NEAR_DEG < off[0] else 1.0,
    }
    # the first that decides
    origin, sign = next((name, sign) for name, sign in decided.items() if sign is not None)
    zero = float(np.median(readings.zero_deg(sign)))
    reason = ""
    if by_energy == 0.0:
        wrong = "frequency, Q, the drive (force or base) or the phase is wrong"
        reason = f"with either sign of the phase taps would gain energy: {wrong}"
    elif by_energy is not None and by_energy != sign:
        rows = readings.giving_energy_away(sign)
        reason = (
            f"the phase was stated to {'lag' if sign > 0.0 else 'lead'}, but then {rows} taps would gain energy, and "
            f"with the other sign they do not: {SENSE_OPTION}"
        )
    elif origin == "unknown":
        reason = (
            "off resonance energies depend on the sign of the phase, and the curve does not show whether it lags or "
            f"leads: say {SENSE_OPTION}"
        )
    return PhaseSense(sign, zero, origin, _notes(readings, sign, origin, zero), reason)


def _notes(readings: PhaseReadings, sign: float, origin: str, zero_deg: float) -> tuple[str, ...]:
    """Return the notes on a sign that is not stated, and not that of a lag, and on a zero that is quarter turns off."""
    free, reads, notes = readings.seen_free, "no row of the free tip has a phase", []
    if free.any():
        lag = float(np.median(readings.free_lag_deg[free]))
        reads = f"the free tip reads {turned(zero_deg + sign * lag):.1f} deg where its lag is {lag:.1f}"
    if origin in {"assumed", "unknown"}:
        taken = f"the phase {'leads' if sign < 0.0 else 'lags'}, which is assumed"
        both = "with the other sign energies are nearly the same, and attractive and repulsive are exchanged; "
        notes.append(f"Sign: {reads}: {taken}; {both if origin == 'assumed' else ''}say {SENSE_OPTION}.")
    elif sign < 0.0 and origin != "stated":
        by_order = "attraction reaches farther than repulsion"
        how = by_order if origin == "order" else "with the other sign taps would gain energy"
        notes.append(f"Sign: {reads}: the phase leads ({how}), and its sign was reversed.")
    quarters = 90 * round(zero_deg / 90.0)
    if quarters and abs(turned(zero_deg - quarters)) < _NEAR_DEG:
        notes.append(f"Zero: {reads}: the instrument's zero is {quarters:+d} degrees off; the free tip determines it.")
    return tuple(notes)
