"""General-purpose integrators that stop at an event, all behind one call: SciPy's and SUNDIALS' CVODE."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Rates = Callable[[float, Any], Sequence[float]]
Event = Callable[[float, Any], float]

CVODE = {"CVODE Adams": "Adams", "CVODE BDF": "BDF"}
"""Methods of SUNDIALS by the names that `integrate_to_event` knows beside those of `solve_ivp`."""
EVENT = "Diffrax Dopri8 with Event"
"""Diffrax's own events, begun again after each; it needs JAX's rates and does not go through `integrate_to_event`."""
_MOST_STEPS = 100_000


class Integrator(NamedTuple):
    """A method that `solve_ivp` knows, or one of `CVODE`; relative and absolute tolerance, and the longest step."""

    method: str
    rtol: float
    atol: float
    max_step: float = np.inf


class Reached(NamedTuple):
    """Where an integration ended: which event, when, the state there, and evaluations of the rates."""

    event: int
    time: float
    state: NDArray[np.float64]
    evaluations: int


def title(method: str) -> str:
    """Return a method's name with the library that it is from."""
    if method == EVENT:
        return method
    return f"SUNDIALS {method}" if method in CVODE else f"SciPy {method}"


def integrate_to_event(
    rates: Rates,
    span: tuple[float, float],
    state: Sequence[float],
    events: Sequence[Event],
    integrator: Integrator,
    *,
    direction: float = 0.0,
) -> Reached:
    """Integrate until the first of some events.

    Args:
        rates: of time and state.
        span: from when to when at most.
        state: at the start.
        events: functions of time and state that an event is a zero of.
        integrator: how.
        direction: -1: only zeros that are met from above; 0: all.

    Raises:
        ValueError: if no event is met, or the integrator gives up.
        ModuleNotFoundError: if SUNDIALS is asked for and scikit-sundae is not installed.
    """
    if integrator.method in CVODE:
        return _cvode(rates, span, state, events, integrator, direction)
    for event in events:
        vars(event).update(terminal=True, direction=direction)
    # a trial step of a loose tolerance may go beyond all numbers; it is then rejected
    with np.errstate(all="ignore"):
        path = solve_ivp(rates, span, state, events=list(events), **integrator._asdict())
    if path.status != 1:
        raise ValueError(f"SciPy ended without an event: {path.message}")
    met = next(place for place, times in enumerate(path.t_events) if len(times))
    return Reached(met, float(path.t_events[met][0]), path.y_events[met][0], path.nfev)


def _cvode(
    rates: Rates,
    span: tuple[float, float],
    state: Sequence[float],
    events: Sequence[Event],
    integrator: Integrator,
    direction: float,
) -> Reached:
    try:
        from sksundae.cvode import CVODE as Solver  # noqa: N811, PLC0415
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "SUNDIALS is not installed; add it with: pip install 'afm-jax[sundials]'", name="sksundae"
        ) from None

    def right_side(time: float, at: Any, out: Any) -> None:
        out[:] = rates(time, at)

    def zeros(time: float, at: Any, out: Any) -> None:
        out[:] = [event(time, at) for event in events]

    vars(zeros).update(terminal=[1] * len(events), direction=[int(direction)] * len(events))
    solver = Solver(
        right_side,
        method=CVODE[integrator.method],
        rtol=integrator.rtol,
        atol=integrator.atol,
        max_step=integrator.max_step if np.isfinite(integrator.max_step) else 0.0,
        max_num_steps=_MOST_STEPS,
        eventsfn=zeros,
        num_events=len(events),
    )
    path = solver.solve(np.asarray(span, float), np.asarray(state, float))
    if path.status != 2:
        raise ValueError(f"SUNDIALS ended without an event: {path.message}")
    met = int(np.flatnonzero(path.i_events[0])[0])
    return Reached(met, float(path.t_events[0]), np.asarray(path.y_events[0]), path.nfev)
