"""What each digit costs, in everything the package computes: achieved error against time, rivals beside.

Impacts, collisions, driven contacts, orbits and gradients; fits are measured in `fitting.benchmark`. Each function runs
in a process of its own on one core and returns rows in one form, so that one picture shows them all:

problem, method, setting, microseconds (of one impact, collision, contact, orbit or gradient), error, own (is the method
this package's?), reason (where there is no error); and `references`: of each problem what the error is, what it is
measured against, and how well that is known.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array
from scipy.optimize import root

from afm_jax.accuracy.collisions import adaptive_collisions, collide_accuracy, values_and_slopes
from afm_jax.accuracy.impacts import doubt_of_reference, integrator_row, map_rows, slow_ones_first
from afm_jax.apparatus.scene import Scene
from afm_jax.bench.collisions import COARSER_REFERENCE, REFERENCE, speeds_of
from afm_jax.bench.impacts import sequence_errors
from afm_jax.bench.integrators import EVENT, title
from afm_jax.bench.problems import (
    BenchmarkScene,
    Starts,
    batch_run,
    bouncing_starts,
    regular_scene,
    settled_starts,
    single_contacts,
)
from afm_jax.bench.scenes import DRIVE_AMPLITUDE_NM, HIGH_ORDER, contact_errors
from afm_jax.bench.scipy_contacts import scipy_collision, scipy_rows
from afm_jax.bench.scipy_impacts import scipy_impacts
from afm_jax.bench.timing import compiled_for, progress, time_compiled
from afm_jax.contact.collide import batch_of
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import find_junction
from afm_jax.contact.parameters import PAPER
from afm_jax.contact.settings import DRIVEN_SETTINGS, SETTINGS, DrivenSetting
from afm_jax.impact.law import impact_law_of
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.scenefile.presets import contact_scene
from afm_jax.verify.fifty_digits import exact_orbit_state, mpmath_or_reason

Row = dict[str, Any]
Study = dict[str, Any]
_LONGEST_PERIODS = 10.0
_IN_TIME = (DrivenSetting(None, 12.0, 400), DrivenSetting(None, 9.0, 300))
"""References of driven contacts, all of the way in fine steps in time: the better one first."""
_SCIPYS_BEST = 1e-13
_MOST_NEWTON_STEPS = 12


def overview_row(problem: str, method: str, setting: str, microseconds: float | None, error: float | None) -> Row:
    """Return a row; an error that is not finite is none."""
    known = error is not None and np.isfinite(error)
    return {
        "problem": problem,
        "method": method,
        "setting": setting,
        "microseconds": microseconds,
        "error": float(error) if known and error is not None else None,
        "own": not method.startswith(("SciPy", "SUNDIALS", "Diffrax", "NumPy")),
    }


def _study(problem: str, rows: Sequence[Row], error_of: str, reference: str, reference_error: float) -> Study:
    told = {"error_of": error_of, "reference": reference, "reference_error": float(reference_error)}
    return {"rows": list(rows), "references": {problem: told}}


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
    rows = []
    for precision in ("float64", "float32"):
        progress(f"accuracy: impacts, {precision}")
        for row in map_rows(case, starts, precision, root_tolerances_us, (impacts, 1, repetitions)):
            setting = f"root tolerance {row['tolerance']:g} us"
            rows.append(
                overview_row("impacts", row["method"], setting, row["microseconds_per_impact"], row["error_us"])
            )
    for method, tolerance in product(integrators, tolerances):
        progress(f"accuracy: impacts, {title(method)}, {tolerance:g}")
        row = integrator_row(case, starts, tolerance, impacts, method)
        cells = (title(method), f"tolerance {tolerance:g}", row["microseconds_per_impact"], row["error_us"])
        rows.append(overview_row("impacts", *cells) | _reason(row))
    rows += _diffrax_impacts(case, starts, tolerances, impacts, repetitions)
    return _study("impacts", rows, "impact time (us)", "50 digits", doubt_of_reference(case, starts, impacts))


def _reason(row: Mapping[str, Any]) -> Row:
    return {"reason": row["reason"]} if "reason" in row else {}


def _diffrax_impacts(
    case: BenchmarkScene, starts: Starts, tolerances: Sequence[float], impacts: int, repetitions: int
) -> Iterator[Row]:
    """Measure Diffrax's own events, restarted after each impact: what a user of Diffrax would write."""
    one = _diffrax_impact(case.scene)

    def run(time: Array, velocity: Array, tolerance: Array) -> Array:
        def step(state: Array, _: None) -> tuple[Array, Array]:
            after = one(state, tolerance)
            return after, after

        return jax.lax.scan(step, jnp.stack([time, velocity]), None, length=impacts)[1]

    first = (starts.time_us[0], starts.velocity_nm_per_us[0])
    compiled = compiled_for(run, *first, jnp.asarray(tolerances[0]))
    single = BenchmarkScene(case.name, case.scene, chaotic=True)
    for tolerance in tolerances:
        progress(f"accuracy: impacts, {EVENT}, {tolerance:g}")
        timing, found = time_compiled(compiled, *first, jnp.asarray(tolerance), repetitions=repetitions)
        states = np.vstack([[float(part) for part in first], np.asarray(found)])
        error = float(np.max(sequence_errors(single, states)))
        yield overview_row("impacts", EVENT, f"tolerance {tolerance:g}", 1e6 * timing.best_s / impacts, error)


def _diffrax_impact(scene: Scene) -> Callable[[Array, Array], Array]:
    """Return the function from time and velocity after an impact, and a tolerance, to those after the next."""
    law, cantilever, platform = impact_law_of(scene), scene.cantilever, scene.platform
    period = platform.period_us

    def motion(time: Any, state: Any, args: Any) -> Any:
        del time, args
        return state[1], cantilever.acceleration(*state)

    def gap(t: Any, y: Any, args: Any, **extra: Any) -> Any:
        del args, extra
        return y[0] - platform.position(t)

    def one(start: Array, tolerance: Array) -> Array:
        time, velocity = start
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(motion),
            diffrax.Dopri8(),
            time,
            time + _LONGEST_PERIODS * period,
            None,
            (platform.position(time), velocity),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance, dtmax=period / 3.0),
            # downwards alone: it leaves with a gap of 0
            event=diffrax.Event(gap, optimistix.Newton(1e-14, 1e-14), direction=False),
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        assert solution.ts is not None  # noqa: S101 (for the type checker: the end is saved)
        assert solution.ys is not None  # noqa: S101
        arrival, before = solution.ts[-1], solution.ys[1][-1]
        speed = platform.velocity(arrival)
        return jnp.stack([arrival, speed + law.rebound_speed(speed - before)])

    return one


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
    rows = []
    for row in found["rows"]:
        method = EVENT if row["method"] == "Dopri8, adaptive" else str(row["method"])
        if row["precision"] != "float64":
            method = f"{method}, {row['precision']}"
        cells = (row["setting"], row["microseconds_per_impact"], row["rebound_error"])
        rows.append(overview_row("collisions", method, *cells) | _reason(row))
    study = _study("collisions", rows, "rebound speed, relative", "quadrature", found["reference_error"])
    slopes = _gradients(accuracies, tolerances, integrators, speeds_of(batch), repetitions)
    return {"rows": study["rows"] + slopes["rows"], "references": study["references"] | slopes["references"]}


_SLOPES = ("by_speed", "by_viscosity")


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
    rows = []
    for method, settings in SETTINGS.items():
        for accuracy in (level for level in settings if level in accuracies):
            progress(f"accuracy: gradients, collide, {method}, {accuracy:g}")

            def run(at: Array, setting: Any = settings[accuracy]) -> dict[str, Array]:
                return values_and_slopes(lambda contact, some: batch_of(contact, 1.0, some, setting), at)

            timing, slopes = time_compiled(compiled_for(run, speeds), speeds, repetitions=repetitions)
            cells = (f"accuracy {accuracy:g}", 1e6 * timing.best_s / speeds.size, _slope_error(slopes, exact))
            rows.append(overview_row("gradients", f"collide, {method}, autodiff", *cells))
    contact, run_in_time = Contact.paper(), adaptive_collisions("time", "Dopri8")
    junction = find_junction(contact)

    def by_events(junction: Any, at: Array, tolerance: Array) -> dict[str, Array]:
        return values_and_slopes(lambda contact, some: run_in_time(contact, junction, some, tolerance), at)

    compiled = compiled_for(by_events, junction, speeds, jnp.asarray(tolerances[0]))
    for tolerance in tolerances:
        progress(f"accuracy: gradients, {EVENT}, {tolerance:g}")
        timing, slopes = time_compiled(compiled, junction, speeds, jnp.asarray(tolerance), repetitions=repetitions)
        cells = (f"tolerance {tolerance:g}", 1e6 * timing.best_s / speeds.size, _slope_error(slopes, exact))
        rows.append(overview_row("gradients", f"{EVENT}, autodiff", *cells))
    places = np.unique(np.linspace(0, speeds.size - 1, 3).astype(int))
    expected = {name: np.asarray(exact[name])[places] for name in _SLOPES}
    for method, tolerance in product(integrators, tolerances):
        progress(f"accuracy: gradients, {title(method)}, {tolerance:g}")
        name = f"{title(method)}, central differences"
        try:
            runs = [_differences(float(speeds[place]), method, tolerance) for place in places]
        except (ValueError, ModuleNotFoundError) as failure:
            rows.append(
                overview_row("gradients", name, f"tolerance {tolerance:g}", None, None) | {"reason": str(failure)}
            )
            continue
        slopes = {key: np.array([run[key] for run in runs]) for key in _SLOPES}
        cells = (1e6 * float(np.mean([run["seconds"] for run in runs])), _slope_error(slopes, expected))
        rows.append(overview_row("gradients", name, f"tolerance {tolerance:g}", *cells))
    own = _slope_error(coarser, exact)
    return _study("gradients", rows, "slopes of the rebound speed, relative", "derivatives of the quadrature", own)


def _slope_error(found: Mapping[str, Any], exact: Mapping[str, Any]) -> float:
    return max(float(np.max(np.abs(np.asarray(found[name]) / np.asarray(exact[name]) - 1.0))) for name in _SLOPES)


def _differences(speed: float, method: str, tolerance: float) -> dict[str, float]:
    """Return slopes by central differences; the step balances its own error with the tolerance's."""
    step = tolerance ** (1.0 / 3.0)

    def at(factors: tuple[float, float]) -> Any:
        contact = Contact.paper(viscosity_pa_s=PAPER["viscosity_pa_s"] * factors[1])
        return scipy_collision(contact, speed * factors[0], method=method, rtol=tolerance)

    found = {"seconds": 0.0}
    for place, name in enumerate(_SLOPES):
        up, down = (at((1.0 + sign, 1.0) if place == 0 else (1.0, 1.0 + sign)) for sign in (step, -step))
        found[name] = (up.rebound_speed_nm_per_us - down.rebound_speed_nm_per_us) / (2.0 * step)
        found["seconds"] += up.seconds + down.seconds
    return found


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
    rows = []
    for accuracy in (level for level in DRIVEN_SETTINGS if level in accuracies):
        progress(f"accuracy: driven contacts, {accuracy:g}")
        compiled = compiled_for(batch_run(DRIVEN_SETTINGS[accuracy], 2), *arguments)
        timing, found = time_compiled(compiled, *arguments, repetitions=repetitions)
        cells = (
            f"accuracy {accuracy:g}",
            1e6 * timing.best_s / batch,
            _worst(contact_errors(found, reference, single)),
        )
        rows.append(overview_row("driven contacts", "simulate", *cells))
    rivals = (*integrators, EVENT)
    for row in scipy_rows("n = 5.277", scene, reference, single, contacts, methods=rivals, tolerances=tolerances):
        method, setting = row["what"].split(" with events, the contact alone, rtol ")
        cells = (f"tolerance {setting}", row.get("microseconds_per_contact"), _worst(row))
        rows.append(overview_row("driven contacts", method, *cells) | _reason(row))
    # how far from coarser steps, and from another program: the larger one is said
    (beside,) = scipy_rows("n = 5.277", scene, reference, single, contacts, tolerances=(_SCIPYS_BEST,))
    doubt = max(_worst(contact_errors(coarser, reference, single)) or 0.0, _worst(beside) or 0.0)
    told = f"fine steps in time, beside SciPy DOP853 at {_SCIPYS_BEST:g}"
    return _study("driven contacts", rows, "rebound speed, relative", told, doubt)


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
    rows = []
    for count in (1, batch):
        progress(f"accuracy: orbits, {count} at once")
        scenes = jax.tree.map(lambda leaf, count=count: jnp.broadcast_to(leaf, (count, *leaf.shape)), scene)
        compiled = compiled_for(jax.vmap(lambda one: single_impact_orbits(one, 1)), scenes)
        timing, found = time_compiled(compiled, scenes, repetitions=repetitions)
        error = abs(float(mp.mpf(float(found.velocity_after_nm_per_us[0, chosen])) / exact[1] - 1))
        rows.append(
            overview_row("orbits", "single_impact_orbits", f"{count} at once", 1e6 * timing.best_s / count, error)
        )
    for method, tolerance in product(integrators, tolerances):
        progress(f"accuracy: orbits, {title(method)}, {tolerance:g}")
        rows.append(_shooting(scene, place, (method, tolerance), float(exact[1])))
    rows += _diffrax_shooting(scene, place, tolerances, float(exact[1]), repetitions)
    return _study("orbits", rows, "velocity after the impact, relative", "50 digits", 1e-40)


def _shooting(scene: Scene, place: tuple[float, float], how: tuple[str, float], exact: float) -> Row:
    """Close the orbit by SciPy's root of one flight and impact, from a start that is a few percent off."""
    method, tolerance = how
    period = float(scene.platform.period_us)
    spent = 0.0

    def leap(state: np.ndarray) -> np.ndarray:
        nonlocal spent
        run = scipy_impacts(scene, (float(state[0]), float(state[1])), 1, tolerance=tolerance, method=method)
        spent += run.seconds
        return run.states[1] - state - np.array([period, 0.0])

    start = _beside(scene, place)
    cells = ("orbits", f"{title(method)}, shooting", f"tolerance {tolerance:g}")
    try:
        found = root(leap, start, tol=max(tolerance, 1e-14))
    except (ValueError, ModuleNotFoundError) as failure:
        return overview_row(*cells, None, None) | {"reason": str(failure)}
    return overview_row(*cells, 1e6 * spent, abs(found.x[1] / exact - 1.0))


def _beside(scene: Scene, place: tuple[float, float]) -> np.ndarray:
    """Return time and velocity of a start a few percent off an orbit's phase and velocity."""
    turn = 0.02 * float(scene.platform.period_us)
    return np.array([place[0] / float(scene.platform.angular_frequency) + turn, 1.05 * place[1]])


def _diffrax_shooting(
    scene: Scene, place: tuple[float, float], tolerances: Sequence[float], exact: float, repetitions: int
) -> Iterator[Row]:
    """Close the orbit by Newton's method on Diffrax's flight with its event, derivatives by autodiff."""
    one, period = _diffrax_impact(scene), jnp.stack([scene.platform.period_us, jnp.zeros(())])

    def closed(start: Array, tolerance: Array) -> Array:
        def missed(state: Array) -> tuple[Array, Array]:
            gap = one(state, tolerance) - state - period
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
    for tolerance in tolerances:
        progress(f"accuracy: orbits, {EVENT}, {tolerance:g}")
        timing, found = time_compiled(compiled, start, jnp.asarray(tolerance), repetitions=repetitions)
        error = abs(float(found[1]) / exact - 1.0)
        yield overview_row("orbits", f"{EVENT}, shooting", f"tolerance {tolerance:g}", 1e6 * timing.best_s, error)


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
