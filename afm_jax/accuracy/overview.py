"""What each digit costs, in everything the package computes: achieved error against time, rivals beside.

Impacts, collisions, driven contacts, orbits and gradients; fits are measured in `fitting.benchmark`. Each function runs
in a process of its own on one core and returns rows in one form, so that one picture shows them all:

problem, method, setting, microseconds (of one impact, collision, contact, orbit or gradient), error, own (is the method
this package's?), reason (where there is no error); and `references`: of each problem what the error is, what it is
measured against, and how well that is known.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.optimize import root

from afm_jax.accuracy.collisions import adaptive_collisions, collide_accuracy, values_and_slopes
from afm_jax.accuracy.impacts import (
    COST,
    PRECISIONS,
    diffrax_impact,
    doubt_of_reference,
    event_contestant,
    integrator_contestant,
    map_contestant,
    slow_ones_first,
)
from afm_jax.apparatus.scene import Scene
from afm_jax.bench.collisions import COARSER_REFERENCE, REFERENCE, speeds_of
from afm_jax.bench.integrators import EVENT, title
from afm_jax.bench.problems import batch_run, bouncing_starts, regular_scene, settled_starts, single_contacts
from afm_jax.bench.scenes import DRIVE_AMPLITUDE_NM, HIGH_ORDER, contact_errors
from afm_jax.bench.scipy_contacts import contact_contestants, scipy_collision
from afm_jax.bench.scipy_impacts import scipy_impacts
from afm_jax.bench.study import RIVALS, Contestant, Row, measured, named, timed
from afm_jax.contact.collide import batch_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import find_junction
from afm_jax.contact.parameters import PAPER
from afm_jax.contact.settings import DRIVEN_SETTINGS, SETTINGS, DrivenSetting
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.scenefile.presets import contact_scene
from afm_jax.studies.timing import compiled_for, progress
from afm_jax.verify.fifty_digits import exact_orbit_state, mpmath_or_reason

Study = dict[str, Any]
_IN_TIME = (DrivenSetting(None, 12.0, 400), DrivenSetting(None, 9.0, 300))
"""References of driven contacts, all of the way in fine steps in time: the better one first."""
_SCIPYS_BEST = 1e-13
_MOST_NEWTON_STEPS = 12
_SLOPES = ("by_speed", "by_viscosity")


def overview_row(problem: str, method: str, setting: str, microseconds: float | None, error: float | None) -> Row:
    """Return a row; an error that is not finite is none."""
    known = error is not None and np.isfinite(error)
    return {
        "problem": problem,
        "method": method,
        "setting": setting,
        "microseconds": microseconds,
        "error": float(error) if known and error is not None else None,
        "own": not method.startswith(RIVALS),
    }


def _study(
    problem: str, rows: Iterable[Row], cost: tuple[str, str], error_of: str, reference: str, reference_error: float
) -> Study:
    """Return rows of the overview, from measured rows whose columns of time and error are named, and the reference."""
    time, error = cost
    overview = [
        overview_row(problem, row["method"], row["setting"], row.get(time), row.get(error))
        | {name: row[name] for name in ("reason",) if name in row}
        for row in rows
    ]
    told = {"error_of": error_of, "reference": reference, "reference_error": float(reference_error)}
    return {"rows": overview, "references": {problem: told}}


def impacts(
    *,
    root_tolerances_us: Sequence[float],
    tolerances: Sequence[float],
    integrators: Sequence[str],
    batch: int,
    impacts: int,
    repetitions: int,
) -> Study:
    """Measure the time of one impact of the regular scene (n = 1, beta = 2 nm, sigma = -1 nm, r = 0.5)."""
    case = regular_scene()
    starts = slow_ones_first(case, settled_starts(case.scene, batch), impacts, 1)

    def contestants() -> Iterator[Contestant]:
        for precision in PRECISIONS:
            yield map_contestant(case, starts, precision, root_tolerances_us, (impacts, 1, repetitions))
        for method in integrators:
            yield integrator_contestant(case, starts, method, tolerances, impacts)
        yield event_contestant(case, starts, tolerances, impacts, repetitions)

    rows = measured("accuracy: impacts", contestants(), unknown=COST)
    doubt = doubt_of_reference(case, starts, impacts)
    return _study("impacts", rows, COST, "impact time (us)", "50 digits", doubt)


def collisions(
    *,
    accuracies: Sequence[float],
    tolerances: Sequence[float],
    integrators: Sequence[str],
    speeds: Sequence[float],
    batch: int,
    repetitions: int,
) -> Study:
    """Measure the rebound speed of the paper's contact, and its derivatives by speed and viscosity."""
    found = collide_accuracy(
        tolerances=tolerances,
        solvers={"gap": [], "time": ["Dopri8"]},
        accuracies=accuracies,
        steps=[],
        batch=batch,
        repetitions=repetitions,
        integrators=(integrators, speeds),
    )
    for row in found["rows"]:
        if row["method"] == "Dopri8, adaptive":
            row["method"] = EVENT
        if row["precision"] != "float64":
            row["method"] += f", {row['precision']}"
    cost = ("microseconds_per_impact", "rebound_error")
    study = _study("collisions", found["rows"], cost, "rebound speed, relative", "quadrature", found["reference_error"])
    slopes = _gradients(accuracies, tolerances, integrators, speeds_of(batch), repetitions)
    return {"rows": study["rows"] + slopes["rows"], "references": study["references"] | slopes["references"]}


def _gradients(
    accuracies: Sequence[float],
    tolerances: Sequence[float],
    integrators: Sequence[str],
    speeds: Array,
    repetitions: int,
) -> Study:
    """Measure d u_out/d ln u_in and d u_out/d ln(viscosity), together: autodiff, and differences."""
    exact, coarser = (
        jax.jit(lambda at, one=one: values_and_slopes(lambda c, s: batch_of(c, 1.0, s, one), at))(speeds)
        for one in (REFERENCE, COARSER_REFERENCE)
    )

    def contestants() -> Iterator[Contestant]:
        for method, settings in SETTINGS.items():
            levels = [accuracy for accuracy in settings if accuracy in accuracies]
            yield _autodiff(method, levels, speeds, exact, repetitions)
        yield _autodiff_of_events(tolerances, speeds, exact, repetitions)
        for method in integrators:
            yield _central_differences(method, tolerances, speeds, exact)

    cost = ("microseconds_per_impact", "slope_error")
    rows = measured("accuracy: gradients", contestants(), unknown=cost)
    doubt, reference = _slope_error(coarser, exact), "derivatives of the quadrature"
    return _study("gradients", rows, cost, "slopes of the rebound speed, relative", reference, doubt)


def _autodiff(
    method: str, accuracies: Sequence[float], speeds: Array, exact: Mapping[str, Any], repetitions: int
) -> Contestant:
    def measure(accuracy: float) -> Row:
        setting = SETTINGS[method][accuracy]

        def run(at: Array) -> dict[str, Array]:
            return values_and_slopes(lambda contact, some: batch_of(contact, 1.0, some, setting), at)

        row, slopes = timed(compiled_for(run, speeds), speeds, repetitions=repetitions, events=speeds.size)
        return row | {"slope_error": _slope_error(slopes, exact)}

    return Contestant(f"collide, {method}, autodiff", named("accuracy", accuracies), measure)


def _autodiff_of_events(
    tolerances: Sequence[float], speeds: Array, exact: Mapping[str, Any], repetitions: int
) -> Contestant:
    contact, run_in_time = Contact.paper(), adaptive_collisions("time", "Dopri8")
    junction = find_junction(contact)

    def by_events(junction: Any, at: Array, tolerance: Array) -> dict[str, Array]:
        return values_and_slopes(lambda contact, some: run_in_time(contact, junction, some, tolerance), at)

    compiled = compiled_for(by_events, junction, speeds, jnp.asarray(tolerances[0]))

    def measure(tolerance: float) -> Row:
        arguments = (junction, speeds, jnp.asarray(tolerance))
        row, slopes = timed(compiled, *arguments, repetitions=repetitions, events=speeds.size)
        return row | {"slope_error": _slope_error(slopes, exact)}

    return Contestant(f"{EVENT}, autodiff", named("tolerance", tolerances), measure)


def _central_differences(
    method: str, tolerances: Sequence[float], speeds: Array, exact: Mapping[str, Any]
) -> Contestant:
    """Return an integrator whose slopes are differences; the step balances its own error with the tolerance's."""
    places = np.unique(np.linspace(0, speeds.size - 1, 3).astype(int))
    expected = {name: np.asarray(exact[name])[places] for name in _SLOPES}

    def slopes_at(speed: float, tolerance: float) -> dict[str, float]:
        step = tolerance ** (1.0 / 3.0)

        def at(factors: tuple[float, float]) -> Any:
            contact = Contact.paper(viscosity_pa_s=PAPER["viscosity_pa_s"] * factors[1])
            return scipy_collision(contact, speed * factors[0], method=method, rtol=tolerance)

        slopes = {"seconds": 0.0}
        for place, name in enumerate(_SLOPES):
            up, down = (at((1.0 + sign, 1.0) if place == 0 else (1.0, 1.0 + sign)) for sign in (step, -step))
            slopes[name] = (up.rebound_speed_nm_per_us - down.rebound_speed_nm_per_us) / (2.0 * step)
            slopes["seconds"] += up.seconds + down.seconds
        return slopes

    def measure(tolerance: float) -> Row:
        runs = [slopes_at(float(speeds[place]), tolerance) for place in places]
        slopes = {key: np.array([run[key] for run in runs]) for key in _SLOPES}
        seconds = float(np.mean([run["seconds"] for run in runs]))
        return {"microseconds_per_impact": 1e6 * seconds, "slope_error": _slope_error(slopes, expected)}

    return Contestant(f"{title(method)}, central differences", named("tolerance", tolerances), measure)


def _slope_error(found: Mapping[str, Any], exact: Mapping[str, Any]) -> float:
    return max(float(np.max(np.abs(np.asarray(found[name]) / np.asarray(exact[name]) - 1.0))) for name in _SLOPES)


def driven_contacts(
    *,
    accuracies: Sequence[float],
    tolerances: Sequence[float],
    integrators: Sequence[str],
    contacts: int,
    batch: int,
    repetitions: int,
) -> Study:
    """Measure contacts of bouncing tips one by one, from the same arrivals, at n = 5.277: some turn in the bridge."""
    scene = contact_scene(HIGH_ORDER, DRIVE_AMPLITUDE_NM, 0.0)
    finest = jax.jit(batch_run(DRIVEN_SETTINGS[min(DRIVEN_SETTINGS)], 30))
    duration = 20.0 * float(scene.platform.period_us)
    progress("accuracy: driven contacts, finding tips that keep bouncing")
    starts, _ = bouncing_starts(scene, finest, batch, duration)
    single = single_contacts(scene, finest(scene, starts, starts.time_us + duration), batch)
    arguments = (scene, single.starts, single.until_us)
    reference, coarser = (jax.jit(batch_run(setting, 2))(*arguments) for setting in _IN_TIME)

    def measure(accuracy: float) -> Row:
        compiled = compiled_for(batch_run(DRIVEN_SETTINGS[accuracy], 2), *arguments)
        row, found = timed(compiled, *arguments, repetitions=repetitions, events=batch)
        return {"microseconds_per_contact": row["microseconds_per_impact"], **contact_errors(found, reference, single)}

    levels = [level for level in DRIVEN_SETTINGS if level in accuracies]
    rivals = contact_contestants(
        scene, reference, single, contacts, methods=(*integrators, EVENT), tolerances=tolerances
    )
    cost = ("microseconds_per_contact", "error")
    contestants = [Contestant("simulate", named("accuracy", levels), measure), *rivals]
    rows = [row | {"error": _worst(row)} for row in measured("accuracy: driven contacts", contestants, unknown=cost)]
    # how far from coarser steps, and from another program: the larger one is said
    best = contact_contestants(scene, reference, single, contacts, tolerances=(_SCIPYS_BEST,))
    beside = (_worst(row) for row in measured("accuracy: driven contacts", best))
    doubt = max(error or 0.0 for error in (_worst(contact_errors(coarser, reference, single)), *beside))
    told = f"fine steps in time, beside SciPy DOP853 at {_SCIPYS_BEST:g}"
    return _study("driven contacts", rows, cost, "rebound speed, relative", told, doubt)


def _worst(errors: Mapping[str, Any]) -> float | None:
    """Return the larger of the errors of contacts that go straight through and those that turn."""
    known = [errors.get(f"{part}_rebound_error_worst") for part in ("straight", "turning")]
    return max((error for error in known if error is not None), default=None)


def orbits(*, tolerances: Sequence[float], integrators: Sequence[str], batch: int, repetitions: int) -> Study:
    """Measure the velocity of the stable (1, 1) orbit of the regular scene: closed form, and shooting."""
    mp, reason = mpmath_or_reason()
    if reason is not None:
        raise ValueError(reason)
    scene = regular_scene().scene
    found = jax.jit(single_impact_orbits)(scene, 1)
    chosen = int(np.argmax(np.asarray(found.stable & found.admissible & found.exists)))
    place = (float(found.phase_rad[chosen]), float(found.velocity_after_nm_per_us[chosen]))
    exact = exact_orbit_state(mp, scene, 1, place)

    def measure(count: int) -> Row:
        scenes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), scene)
        compiled = compiled_for(jax.vmap(lambda one: single_impact_orbits(one, 1)), scenes)
        row, closed = timed(compiled, scenes, repetitions=repetitions, events=count)
        error = abs(float(mp.mpf(float(closed.velocity_after_nm_per_us[0, chosen])) / exact[1] - 1))
        return row | {"error": error}

    def contestants() -> Iterator[Contestant]:
        yield Contestant("single_impact_orbits", {f"{count} at once": count for count in (1, batch)}, measure)
        for method in integrators:
            yield _shooting(scene, place, method, tolerances, float(exact[1]))
        yield _diffrax_shooting(scene, place, tolerances, float(exact[1]), repetitions)

    cost = ("microseconds_per_impact", "error")
    rows = measured("accuracy: orbits", contestants(), unknown=cost)
    return _study("orbits", rows, cost, "velocity after the impact, relative", "50 digits", 1e-40)


def _shooting(
    scene: Scene, place: tuple[float, float], method: str, tolerances: Sequence[float], exact: float
) -> Contestant:
    """Return SciPy's root of one flight and impact, from a start that is a few percent off."""
    start = _beside(scene, place)
    step = np.array([float(scene.platform.period_us), 0.0])

    def measure(tolerance: float) -> Row:
        spent = 0.0

        def leap(state: np.ndarray) -> np.ndarray:
            nonlocal spent
            run = scipy_impacts(scene, (float(state[0]), float(state[1])), 1, tolerance=tolerance, method=method)
            spent += run.seconds
            return run.states[1] - state - step

        closed = root(leap, start, tol=max(tolerance, 1e-14))
        return {"microseconds_per_impact": 1e6 * spent, "error": abs(closed.x[1] / exact - 1.0)}

    return Contestant(f"{title(method)}, shooting", named("tolerance", tolerances), measure)


def _beside(scene: Scene, place: tuple[float, float]) -> np.ndarray:
    """Return time and velocity of a start a few percent off an orbit's phase and velocity."""
    turn = 0.02 * float(scene.platform.period_us)
    return np.array([place[0] / float(scene.platform.angular_frequency) + turn, 1.05 * place[1]])


def _diffrax_shooting(
    scene: Scene, place: tuple[float, float], tolerances: Sequence[float], exact: float, repetitions: int
) -> Contestant:
    """Return Newton's method on Diffrax's flight with its event, derivatives by autodiff."""
    leap, period = diffrax_impact(scene), jnp.stack([scene.platform.period_us, jnp.zeros(())])

    def closed(start: Array, tolerance: Array) -> Array:
        def missed(state: Array) -> tuple[Array, Array]:
            gap = leap(state, tolerance) - state - period
            return gap, gap

        def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            count, at, _ = state
            slope, gap = jax.jacfwd(missed, has_aux=True)(at)
            move = -jnp.linalg.solve(slope, gap)
            return count + 1, at + move, jnp.max(jnp.abs(move / at))

        def goes_on(state: tuple[Array, Array, Array]) -> Array:
            return (state[0] < _MOST_NEWTON_STEPS) & (state[2] > jnp.maximum(tolerance, 1e-14))

        return jax.lax.while_loop(goes_on, step, (jnp.zeros((), int), start, jnp.ones(())))[1]

    start = jnp.asarray(_beside(scene, place))
    compiled = compiled_for(closed, start, jnp.asarray(tolerances[0]))

    def measure(tolerance: float) -> Row:
        row, found = timed(compiled, start, jnp.asarray(tolerance), repetitions=repetitions, events=1)
        return row | {"error": abs(float(found[1]) / exact - 1.0)}

    return Contestant(f"{EVENT}, shooting", named("tolerance", tolerances), measure)


def cheapest(rows: Sequence[Row], wanted: Sequence[float]) -> list[Row]:
    """Return, for each problem and wanted error, the fastest method of this package and the fastest of all others."""
    table = []
    for problem, error in product(dict.fromkeys(row["problem"] for row in rows), wanted):
        good = [row for row in rows if row["problem"] == problem and row["error"] is not None and row["error"] <= error]
        cells: Row = {"problem": problem, "wanted_error": error}
        for own, name in ((True, "own"), (False, "other")):
            best = min((row for row in good if row["own"] is own), key=lambda row: row["microseconds"], default=None)
            cells |= {
                name: None if best is None else f"{best['method']}, {best['setting']}",
                f"{name}_microseconds": None if best is None else best["microseconds"],
            }
        table.append(cells)
    return table
