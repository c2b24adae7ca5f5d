"""Adaptive Diffrax solves of the bridge crossing, in the gap and in time: contestants of the accuracy study.

In the gap the crossing's own equations (`afm_jax.contact.bridge_leg`) are solved with error control. In time gap and
rate are the state, the phase is frozen, and Diffrax's events end the crossing.
"""

from typing import Any

import diffrax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float

from afm_jax.contact.bridge_leg import Passage, Way, nothing_spent, way_rates

SOLVERS = {
    "Tsit5": diffrax.Tsit5,
    "Dopri5": diffrax.Dopri5,
    "Dopri8": diffrax.Dopri8,
    "Kvaerno5": diffrax.Kvaerno5,
}
_MAX_STEPS = 4096
_LONGEST_US = 4.0
"""Just above the capture speed a contact lasts 0.9 us; a tip that an inexact solver keeps would go on for ever."""


def pass_adaptively(way: Way, solver: str, tolerance: Float[Array, ""]) -> Passage:
    """Return the passage of one tip in the gap, with step sizes controlled to a tolerance."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda share, state, _: way_rates(way, share, state)),
        SOLVERS[solver](),
        0.0,
        1.0,
        None,
        nothing_spent(way),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        adjoint=diffrax.ForwardMode(),
        max_steps=_MAX_STEPS,
        throw=False,
    )
    assert solution.ys is not None  # noqa: S101 (for the type checker: the end is saved)
    return way.end(*(part[-1] for part in solution.ys))


def pass_in_time(way: Way, solver: str, tolerance: Float[Array, ""]) -> Passage:
    """Return the passage of one tip in time, ended by an event at the far threshold."""
    bridge, mass = way.tip.bridge, way.tip.mass_ng
    start, end = (way.along(jnp.full_like(way.total_aj, share)).gap_nm for share in (0.0, 1.0))

    def field(time: Any, state: Any, args: Any) -> Any:
        del time, args
        gap, rate = state
        safe = jnp.maximum(gap, 0.05)
        return rate, (bridge.force(safe) - bridge.damping(safe) * rate) / mass

    def reached(t: Any, y: Any, args: Any, **extra: Any) -> Any:
        del t, args, extra
        return way.sense * (y[0] - end)

    kinetic = way.total_aj - way.tip.potential(start)
    rate = -way.sense * jnp.sqrt(2.0 * jnp.maximum(kinetic, 1e-12) / mass)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        SOLVERS[solver](),
        0.0,
        _LONGEST_US,
        None,
        (start, rate),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        event=diffrax.Event(reached, optimistix.Newton(1e-12, 1e-12)),
        adjoint=diffrax.ForwardMode(),
        max_steps=_MAX_STEPS,
        throw=False,
    )
    assert solution.ys is not None  # noqa: S101 (for the type checker: the end is saved)
    assert solution.ts is not None  # noqa: S101
    left = 0.5 * mass * solution.ys[1][-1] ** 2
    return Passage(left, solution.ts[-1], way.total_aj - way.end_potential_aj - left)
