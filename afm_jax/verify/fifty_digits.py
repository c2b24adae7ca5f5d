"""The equations with 50 digits in mpmath, an arbitrary-precision library that is not ours.

Nothing here uses the package's physics. The float64 numbers of a state are taken as exact; an impact is the exact root
of eq. 3 next to a float64 guess (the search for the *first* root is not repeated), found by Newton's method, and eqs. 5
to 8 are evaluated there. `ExactMap` iterates closed-form flight and eq. 6, to measure impact times against, for scenes
without collision delay and ramp. Units as everywhere: nm, us, nm/us, rad/us.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from afm_jax.apparatus.scene import Scene
from afm_jax.impact.law import formula_of

DIGITS = 50
_GUARD_DIGITS = 15  # lost on the way, mostly where the closing velocity is small
Number = Any  # mpmath makes its types at run time


class System(NamedTuple):
    """A scene's constants at 50 digits; ``delay``: (hertz, lead, offset) or None."""

    Omega: Number
    gamma: Number
    Omega_d: Number
    beta: Number
    omega: Number
    sigma: Number
    r: Number
    epsilon: Number
    c: Number
    delay: tuple[Number, Number, Number] | None


def mpmath_or_reason() -> tuple[Any, str | None]:
    """Return mpmath's context, or None and the reason why there is none."""
    try:
        from mpmath import mp  # noqa: PLC0415
    except ModuleNotFoundError:
        return None, "mpmath is not installed; add it with: pip install 'afm-jax[verify]'"
    return mp, None


def exact_impact(mp: Any, row: dict[str, Any], start: tuple[float, float], guess_us: float) -> dict[str, Any]:
    """Return one impact and its derivatives, computed with 50 digits and rounded to float64.

    "arrival": its time in us; "eq. 5", "eq. 7", "eqs. 5+7": shape (2, 2); "eq. 6": u_out and its four slopes.

    Args:
        mp: mpmath's context.
        row: a scene's plain numbers.
        start: time in us and lab velocity just after the last impact in nm/us.
        guess_us: arrival time, right to float64.
    """
    with mp.workdps(DIGITS + _GUARD_DIGITS):
        system = system_of(mp, row)
        t1, velocity = mp.mpf(start[0]), mp.mpf(start[1])
        arrival = _arrival(mp, system, (t1, velocity), mp.mpf(guess_us), tolerance=mp.mpf(10) ** -DIGITS)
        flight, before = flight_matrix(mp, system, (t1, velocity), arrival)
        law = law_matrix(mp, system, arrival, before)
        approach = platform(mp, system, arrival)[1] - before
        matrices = {"eq. 5": flight, "eq. 7": law, "eqs. 5+7": law * flight}
        rounded = {name: _floats(matrix) for name, matrix in matrices.items()}
        return {"arrival": float(arrival), "eq. 6": _rebound(mp, system, approach), **rounded}


def exact_trace(mp: Any, row: dict[str, Any], order: int, guess: tuple[float, float]) -> float:
    """Return T of eq. 8 on the exact (1, N) orbit next to a guessed phase in rad and V' in nm/us.

    The orbit, without damping, viscous loss and delay, solves A Omega sin h = V' cos h, h = Omega T/2 (the flight that
    comes back to its height), and eq. 6 with V = -V'.
    """
    with mp.workdps(DIGITS + _GUARD_DIGITS):
        s = system_of(mp, row)
        return float(_eq8_trace(mp, s, _orbit_state(mp, s, order, guess), 2 * s.Omega * order * mp.pi / s.omega))


def exact_orbit_state(mp: Any, scene: Scene, order: int, guess: tuple[float, float]) -> tuple[Number, Number]:
    """Return the phase in rad and V' in nm/us of the exact (1, N) orbit of a scene; see `exact_trace`."""
    with mp.workdps(DIGITS + _GUARD_DIGITS):
        return _orbit_state(mp, system_of(mp, _plain_row(scene)), order, guess)


def _orbit_state(mp: Any, s: System, order: int, guess: tuple[float, float]) -> tuple[Number, Number]:
    half = s.Omega * order * mp.pi / s.omega

    def closes(phase: Number, after: Number) -> Number:
        return (s.sigma + s.beta * mp.cos(phase)) * s.Omega * mp.sin(half) - after * mp.cos(half)

    def rebounds(phase: Number, after: Number) -> Number:
        speed = -s.beta * s.omega * mp.sin(phase)
        return (after - speed) ** 2 - s.r**2 * (after + speed) ** 2 + s.epsilon

    start = mp.mpf(guess[0]), mp.mpf(guess[1])
    phase, after = mp.findroot([closes, rebounds], start, tol=mp.mpf(10) ** (-2 * DIGITS))
    return phase, after


def _eq8_trace(mp: Any, s: System, orbit: tuple[Number, Number], turn: Number) -> Number:
    phase, after = orbit
    swing = s.beta * s.omega * mp.sin(phase)
    C, S = mp.cos(turn), mp.sin(turn)
    ratio = (-after + swing) / (after + swing)
    bracket = swing - swing * C - (after + swing * C) * s.r**2 * ratio
    bracket += s.beta * s.omega**2 / s.Omega * mp.cos(phase) * S * (s.r**2 * ratio - 1)
    return 1 + bracket / (after - swing)


def system_of(mp: Any, row: dict[str, Any]) -> System:
    """Return a scene's constants from its plain numbers, at the working precision."""
    turn = 2 * mp.pi / 1000
    Omega = turn * mp.mpf(row["frequency_khz"])
    quality = row["quality_factor"]
    gamma = mp.mpf(0) if quality is None else Omega / (2 * mp.mpf(quality))
    return System(
        Omega=Omega,
        gamma=gamma,
        Omega_d=mp.sqrt(Omega**2 - gamma**2),
        beta=mp.mpf(row["amplitude_nm"]),
        omega=turn * mp.mpf(row["drive_frequency_khz"]),
        sigma=mp.mpf(row["offset_nm"]),
        r=mp.mpf(row["r"]),
        epsilon=mp.mpf(row["epsilon"]),
        c=mp.mpf(row["viscous_loss"]),
        delay=None if row["delay"] is None else tuple(mp.mpf(part) for part in row["delay"]),
    )


def platform(mp: Any, s: System, t: Number) -> tuple[Number, Number, Number]:
    """Return z_p, v_p and a_p."""
    swing = s.beta * mp.cos(s.omega * t)
    return s.sigma + swing, -s.beta * s.omega * mp.sin(s.omega * t), -(s.omega**2) * swing


def propagator(mp: Any, s: System, t: Number) -> tuple[Number, Number, Number, Number]:
    """Return p11, p12, p21, p22 of the free flight."""
    shrink = mp.exp(-s.gamma * t)
    cosine, sine = shrink * mp.cos(s.Omega_d * t), shrink * mp.sin(s.Omega_d * t) / s.Omega_d
    return cosine + s.gamma * sine, sine, -(s.Omega**2) * sine, cosine - s.gamma * sine


def _arrival(mp: Any, s: System, start: tuple[Number, Number], guess: Number, *, tolerance: Number) -> Number:
    """Return the root of eq. 3 next to a guess by Newton's method, which doubles its digits at each step; else NaN."""
    t1, velocity = start
    height = platform(mp, s, t1)[0]
    t = guess
    for _ in range(12):
        p11, p12, p21, p22 = propagator(mp, s, t - t1)
        position, speed, _ = platform(mp, s, t)
        step = (p11 * height + p12 * velocity - position) / (p21 * height + p22 * velocity - speed)
        t -= step
        if abs(step) < tolerance:
            return t
    return mp.nan


def flight_matrix(mp: Any, s: System, start: tuple[Number, Number], t2: Number) -> tuple[Number, Number]:
    """Return d(t2, V2)/d(t1, V1') by eq. 5 (undamped: as printed) and V2."""
    t1, velocity = start
    height, speed, _ = platform(mp, s, t1)
    p11, p12, p21, p22 = propagator(mp, s, t2 - t1)
    before = p21 * height + p22 * velocity
    if s.gamma == 0:
        return _eq5(mp, s, start, t2), before
    closing = before - platform(mp, s, t2)[1]
    pull = -(s.Omega**2) * (p11 * height + p12 * velocity) - 2 * s.gamma * before
    later, sooner = (before - p11 * speed) / closing, -p12 / closing
    return mp.matrix([[later, sooner], [p21 * speed + pull * (later - 1), p22 + pull * sooner]]), before


def _eq5(mp: Any, s: System, start: tuple[Number, Number], t2: Number) -> Number:
    t1, velocity = start
    C, S = mp.cos(s.Omega * (t2 - t1)), mp.sin(s.Omega * (t2 - t1))
    s1, s2 = mp.sin(s.omega * t1), mp.sin(s.omega * t2)
    A, B = platform(mp, s, t1)[0], velocity / s.Omega
    swing = s.beta * s.omega
    below = A * s.Omega * S - B * s.Omega * C - swing * s2
    pull = s.Omega * (A * C + B * S) / below
    return mp.matrix(
        [
            [(-swing * s1 * C + A * s.Omega * S - B * s.Omega * C) / below, S / s.Omega / below],
            [swing * s.Omega * s1 * S - s.Omega * pull * swing * (s2 - s1 * C), C - pull * S],
        ]
    )


def law_matrix(mp: Any, s: System, t2: Number, before: Number) -> Number:
    """Return d(t_out, V')/d(t2, V2) by eq. 7, with viscous loss and delay."""
    _, speed, pull = platform(mp, s, t2)
    u = speed - before
    w = mp.sqrt(s.r**2 * u**2 - s.c * u - s.epsilon)
    slope = (2 * s.r**2 * u - s.c) / (2 * w)
    delay, delay_slope = mp.mpf(0), mp.mpf(0)
    if s.delay is not None:
        hertz, lead, offset = s.delay
        delay = hertz * u ** (-mp.mpf(1) / 5) - lead * (1 / w - 1 / u) - offset / u
        delay_slope = -hertz * u ** (-mp.mpf(6) / 5) / 5 + lead * (slope / w**2 - 1 / u**2) + offset / u**2
    pull_out = platform(mp, s, t2 + delay)[2]
    stretch = 1 + delay_slope * pull
    return mp.matrix([[stretch, -delay_slope], [pull_out * stretch + slope * pull, -pull_out * delay_slope - slope]])


def _rebound(mp: Any, s: System, u: Number) -> NDArray[np.float64]:
    w = mp.sqrt(s.r**2 * u**2 - s.c * u - s.epsilon)
    slopes = [(2 * s.r**2 * u - s.c) / (2 * w), s.r * u**2 / w, -1 / (2 * w), -u / (2 * w)]
    return np.array([_real(value) for value in (w, *slopes)])


def _floats(matrix: Number) -> NDArray[np.float64]:
    return np.array([[_real(matrix[i, j]) for j in range(2)] for i in range(2)])


def _real(value: Number) -> float:
    """Return a float; NaN for a complex number, which is the root of eq. 6 of a tip that is captured after all."""
    return float("nan") if value.imag else float(value.real)


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
        time = _arrival(mp, s, state, guess, tolerance=mp.mpf(10) ** (5 - self._digits))
        _, _, p21, p22 = propagator(mp, s, time - t1)
        speed = platform(mp, s, time)[1]
        approach = speed - (p21 * height + p22 * velocity)
        return time, speed + mp.sqrt(s.r**2 * approach**2 - s.c * approach - s.epsilon)


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
    law = formula_of(scene)
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
