"""Charts, bifurcation diagrams, exponents and basins on all cores, and the same work with NumPy and SciPy beside them.

SciPy does a small part of the same work, each impact by `solve_ivp` with events, and is told for the whole of it.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from afm_jax.apparatus.scene import Scene
from afm_jax.bench.problems import chaotic_scene
from afm_jax.bench.scipy_impacts import scipy_impacts
from afm_jax.dynamics.basins import basins_of_attraction
from afm_jax.dynamics.bifurcations import bifurcation_diagram
from afm_jax.dynamics.charts import stability_chart
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.scenefile.parameter_paths import scene_batch, scene_family
from afm_jax.studies.timing import progress, time_calls

Row = dict[str, Any]

FREQUENCY, AMPLITUDE = "platform.reduced_frequency", "platform.amplitude_nm"
_RANGE = (1.1, 1.7)
_TOLERANCE = 1e-10
_START_SPEED = 10.0
"""Rebound speed in nm/us of SciPy's motion."""
_TYPICAL_IMPACTS = 100
"""Of a start until it has arrived, with SciPy: about what it takes until the sample of starts has settled."""
_SEEN = 256


def dynamics_rows(*, values: int, impacts: int, side: int, orders: int, grid: int, by_scipy: int) -> dict:
    """Measure everything; to be run in a process of its own, on all cores.

    Args:
        values: of the parameter, for bifurcation diagram and exponents.
        impacts: at each of them.
        side: points of the chart along each axis.
        orders: of the chart.
        grid: starts of the basins along each axis.
        by_scipy: how many impacts SciPy follows.

    Returns:
        `rows` with what, work, seconds (best of two), processor_seconds (of it), first_s (with compilation), beside,
        beside_seconds (told for the whole work) and ratio.
    """
    scene = chaotic_scene().scene
    family = scene_family(scene, FREQUENCY)
    line = np.linspace(*_RANGE, values)
    progress("bench: dynamics, SciPy")
    each = _seconds_of_an_impact(family(1.5), by_scipy)
    chart = {
        "x_values": np.linspace(0.4, 4.4, side),
        "y_values": np.linspace(0.1, 10.0, side),
        "last_order": orders,
    }
    plane = scene_family(scene, FREQUENCY, AMPLITUDE)
    points = [(n, beta, order) for n in chart["x_values"][::37] for beta in chart["y_values"][::41] for order in (1, 2)]
    scipy = f"SciPy DOP853 with events, tolerance {_TOLERANCE:g}"
    rows = [
        _row(
            "chart",
            f"{side} x {side} points, {orders} orders",
            lambda: stability_chart(plane, **chart),
            "NumPy, a quartic's roots and the flight, point by point",
            side**2 * orders * _seconds_of_a_point(plane, points[: 4 * by_scipy]),
        ),
        _row(
            "bifurcation diagram",
            f"{values} values, {impacts} impacts each, ramped up",
            lambda: bifurcation_diagram(scene, FREQUENCY, line, impacts=impacts),
            scipy,
            values * impacts * each,
        ),
        _row(
            "Lyapunov exponents",
            f"{values} values, {impacts} impacts each, 500 before",
            lambda: lyapunov_spectrum(scene_batch(scene, {FREQUENCY: line}), impacts=impacts),
            f"{scipy}, with two neighbours",
            3.0 * values * (impacts + 500) * each,
        ),
        _row(
            "basins",
            f"{grid} x {grid} starts",
            lambda: basins_of_attraction(family(1.57), columns=grid, rows=grid),
            f"{scipy}, {_TYPICAL_IMPACTS} impacts a start",
            grid**2 * _TYPICAL_IMPACTS * each,
        ),
    ]
    return {"rows": rows}


def _row(what: str, work: str, run: Callable[[], Any], beside: str, beside_seconds: float) -> Row:
    progress(f"bench: {what}, {work}")
    calls = time_calls(run, repetitions=2)
    return {
        "what": what,
        "work": work,
        "seconds": calls.best_s,
        "processor_seconds": calls.best_processor_s,
        "first_s": calls.first_s,
        "beside": beside,
        "beside_seconds": beside_seconds,
        "ratio": beside_seconds / calls.best_s,
    }


def _seconds_of_an_impact(scene: Scene, impacts: int) -> float:
    start = float(scene.platform.period_us) * 0.75
    velocity = float(scene.platform.velocity(start)) + _START_SPEED
    return scipy_impacts(scene, (start, velocity), impacts, tolerance=_TOLERANCE).seconds / impacts


def _seconds_of_a_point(plane: Callable[..., Scene], points: list[tuple[float, float, int]]) -> float:
    scenes = [(plane(n, beta), order) for n, beta, order in points]
    constants = [
        (
            float(scene.cantilever.angular_frequency),
            float(scene.platform.angular_frequency),
            float(scene.platform.amplitude_nm),
            float(scene.platform.offset_nm),
            float(scene.interaction.r),
            order,
        )
        for scene, order in scenes
    ]
    began = time.perf_counter()
    for each in constants:
        orbits_by_numpy(*each)
    return (time.perf_counter() - began) / len(constants)


def orbits_by_numpy(
    Omega: float, omega: float, beta: float, sigma: float, r: float, order: int
) -> list[tuple[float, bool, bool]]:
    """Return the (1, N) orbits of an undamped law without adhesion: approach speed, admissible, stable (eqs. 5 to 9).

    From the closed flight V' = -V = (1 + r) u/2 and v_p = (1 - r) u/2, with cos and sin of the phase over u.
    """
    duration = 2.0 * np.pi * order / omega
    sine, cosine = np.sin(0.5 * Omega * duration), np.cos(0.5 * Omega * duration)
    # beta sin(phase) = -v_p/omega, and z_p sin(Omega T/2) = V' cos(Omega T/2)/Omega
    b = -0.5 * (1.0 - r) / (beta * omega)
    a1, a0 = 0.5 * (1.0 + r) * cosine / (Omega * beta * sine), -sigma / beta
    found = []
    for u in np.roots([a1**2 + b**2, 2.0 * a1 * a0, a0**2 - 1.0]):
        if abs(u.imag) > 1e-12 or u.real <= 0.0:
            continue
        speed = float(u.real)
        phase = np.arctan2(b * speed, a1 * speed + a0)
        after, height = 0.5 * (1.0 + r) * speed, sigma + beta * np.cos(phase)
        flown = np.linspace(0.0, duration, _SEEN)[1:-1]
        path = height * np.cos(Omega * flown) + after / Omega * np.sin(Omega * flown)
        above = path - sigma - beta * np.cos(phase + omega * flown)
        turn, moving = Omega * duration, 0.5 * (1.0 - r) * speed
        # eq. 8 with r^2 (V - v_p)/(V' - v_p) = -r
        bracket = -moving + moving * np.cos(turn) + (after - moving * np.cos(turn)) * r
        bracket += beta * omega**2 / Omega * np.cos(phase) * np.sin(turn) * (-r - 1.0)
        trace = 1.0 + bracket / (moving + after)
        found.append((speed, bool(above.min() > 0.0), bool(abs(trace) < 1.0 + r**2)))
    return found


def aims(rows: list[Row], *, whole: bool) -> list[tuple[str, float | None, float]]:
    """Return what was aimed at: name, reached (None if not measured), largest allowed.

    Args:
        rows: the measurements.
        whole: whether they are those of the stated sizes.
    """
    reached = {row["what"]: row["seconds"] for row in rows} if whole else {}
    wanted = {"chart": 20.0, "bifurcation diagram": 10.0, "Lyapunov exponents": 20.0, "basins": 30.0}
    return [(f"s, {what}, two cores", reached.get(what), bound) for what, bound in wanted.items()]
