"""Impact times with 50 digits, to measure errors against: the closed-form flight and eq. 6 iterated in mpmath.

The search for the *first* root is not repeated here: each impact is the exact root next to the computed one. Scenes
without collision delay and ramp.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import impact_law_of
from afm_jax.study.high_precision import DIGITS, System, mpmath_or_reason, platform, propagator, system_of

Number = Any  # mpmath makes its types at run time


class ExactMap:
    """One scene's impact map with 50 digits.

    Args:
        scene: a scene with plain numbers, an `ImpactLaw` without delay, no ramp.
        r_offset: added to r, as text so that no digit is lost; for derivatives by differences.
        digits: decimal digits to compute with.

    Raises:
        ModuleNotFoundError: if mpmath is not installed.
    """

    def __init__(self, scene: Scene, *, r_offset: str = "0", digits: int = DIGITS):  # noqa: D107
        mp, reason = mpmath_or_reason()
        if reason is not None:
            raise ModuleNotFoundError(reason, name="mpmath")
        self._mp = mp
        self._digits = digits
        with mp.workdps(digits):
            system = system_of(mp, _plain_row(scene))
            self._system: System = system._replace(r=system.r + mp.mpf(r_offset))

    def errors_one_by_one(self, starts: NDArray[np.float64], found: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the error of each impact time, every flight restarted from the computed state before it.

        Args:
            starts: time and velocity before each impact, shape (impacts, 2).
            found: computed impact times in us, shape (impacts,).

        Returns:
            Absolute errors in us, shape (impacts,); NaN where there is no exact root next to the computed time.
        """
        errors = []
        with self._mp.workdps(self._digits):
            for start, time in zip(starts, found, strict=True):
                exact = self._next(self._state(start), self._mp.mpf(float(time)))
                errors.append(abs(float(exact[0] - self._mp.mpf(float(time)))))
        return np.array(errors)

    def times_of_sequence(self, start: Sequence[float], guesses: NDArray[np.float64]) -> list[Number]:
        """Return the exact times of a sequence of impacts next to guessed ones, as mpmath numbers."""
        with self._mp.workdps(self._digits):
            state, times = self._state(start), []
            for guess in guesses:
                state = self._next(state, self._mp.mpf(float(guess)))
                times.append(state[0])
            return times

    def error_of_sequence(self, start: Sequence[float], found: NDArray[np.float64]) -> float:
        """Return the largest error in us of a whole sequence of impact times that starts at (time, velocity)."""
        with self._mp.workdps(self._digits):
            exact = self.times_of_sequence(start, found)
            return max(abs(float(t - self._mp.mpf(float(f)))) for t, f in zip(exact, found, strict=True))

    def _state(self, start: Sequence[float] | NDArray[np.float64]) -> tuple[Number, Number]:
        return self._mp.mpf(float(start[0])), self._mp.mpf(float(start[1]))

    def _next(self, state: tuple[Number, Number], guess: Number) -> tuple[Number, Number]:
        mp, s = self._mp, self._system
        t1, velocity = state
        height = platform(mp, s, t1)[0]
        t = guess
        for _ in range(12):
            p11, p12, p21, p22 = propagator(mp, s, t - t1)
            position, speed, _ = platform(mp, s, t)
            before = p21 * height + p22 * velocity
            step = (p11 * height + p12 * velocity - position) / (before - speed)
            t -= step
            if abs(step) < mp.mpf(10) ** (5 - self._digits):
                break
        else:
            return mp.nan, mp.nan
        _, _, p21, p22 = propagator(mp, s, t - t1)
        speed = platform(mp, s, t)[1]
        approach = speed - (p21 * height + p22 * velocity)
        return t, speed + mp.sqrt(s.r**2 * approach**2 - s.c * approach - s.epsilon)


def derivatives_by_r(scene: Scene, start: Sequence[float], guesses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return d(impact times)/dr in us by a central difference at 50 digits, right to about 30, shape (impacts,)."""
    step = "1e-15"
    up = ExactMap(scene, r_offset=step).times_of_sequence(start, guesses)
    down = ExactMap(scene, r_offset=f"-{step}").times_of_sequence(start, guesses)
    mp, _ = mpmath_or_reason()
    with mp.workdps(DIGITS):
        return np.array([float((high - low) / (2 * mp.mpf(step))) for high, low in zip(up, down, strict=True)])


def reference_error(scene: Scene, start: Sequence[float], guesses: NDArray[np.float64]) -> float:
    """Return the error in us of a sequence at 50 digits, by comparison with 70."""
    mp, _ = mpmath_or_reason()
    fifty, seventy = (ExactMap(scene, digits=n).times_of_sequence(start, guesses) for n in (DIGITS, 70))
    with mp.workdps(70):
        return max(abs(float(one - other)) for one, other in zip(fifty, seventy, strict=True))


def _plain_row(scene: Scene) -> dict[str, Any]:
    law = impact_law_of(scene)
    if law.delay is not None or float(scene.platform.offset_rate_nm_per_us) != 0.0:
        raise ValueError("the 50-digit map knows neither a collision delay nor a ramp of the offset")
    quality = scene.cantilever.quality_factor
    return {
        "frequency_khz": float(scene.cantilever.frequency_khz),
        "quality_factor": None if quality is None else float(quality),
        "amplitude_nm": float(scene.platform.amplitude_nm),
        "drive_frequency_khz": float(scene.platform.frequency_khz),
        "offset_nm": float(scene.platform.offset_nm),
        "r": float(law.r),
        "epsilon": float(law.epsilon),
        "viscous_loss": float(law.viscous_loss),
        "delay": None,
    }
