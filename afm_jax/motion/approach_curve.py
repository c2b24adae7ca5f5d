"""An approach curve: amplitude and lag of a driven tip against the sample's height, approach and retract.

Takes a driven scene and heights in nm; gives amplitudes in nm, phase lags in degrees, energies in aJ and an outcome for
each height (the lock-in integral of `observe`).

At each height the whole scene is followed in time until it repeats. From there the sample moves to the next height, by
so little in a drive period that the motion follows: an approach keeps its branch as far as it goes, and hysteresis
shows. A tip that is captured on the way, as laws with adhesion capture slow ones, begins anew at the height after.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from afm_jax.apparatus.drives import BaseDrive, ForceDrive
from afm_jax.apparatus.scene import Scene, drive_of, require_one_frequency
from afm_jax.apparatus.surface import drive_per_free_height, force_per_height, surface_of
from afm_jax.checks import check_count, checked, require_float64
from afm_jax.columns import CsvColumns, csv_columns, rows_of
from afm_jax.contact.junction import ContactPhase
from afm_jax.motion.follow import LongRun, follow_long
from afm_jax.motion.observe import Observables, observe
from afm_jax.motion.record import Simulation, State, to_gap
from afm_jax.motion.settle import felt_nm, is_stuck, settled
from afm_jax.motion.simulate import DEFAULT_ACCURACY
from afm_jax.motion.start import state
from afm_jax.motion.trajectory import DensePath
from afm_jax.outcomes import OutcomeInWords
from afm_jax.report import Section, sections, table_of
from afm_jax.results import ResultTuple, public_result
from afm_jax.saved import as_json

TOLERANCE = 1e-6
"""What may remain to the steady motion, relative: a hundredth of the phase errors of good instruments."""
_STRICTER = 1e-9
"""The same for a motion of several drive periods: one of a single period that turns as it dies away passes for such."""
_FEWEST_PERIODS = 2000
_RINGING = 20.0
"""Drive periods, in units of Q, that a height is given at most: a transient of a free tip has e^-63 left of it."""
_TIMES = 513
"""Times of a response period among which the tip is highest."""
_MOVED = 5e-4
"""How far the sample moves in a drive period, of the free tip's height."""
_CLEARANCE_NM = 1.0
"""Between sample and free tip where the motion begins, beyond where the sample is felt."""


class CurveOutcome(OutcomeInWords):
    """What came of the motion at one height."""

    TAPS = 0, "The tip taps once in every drive period."
    FREE = 1, "The tip does not meet the sample."
    OTHER_ORBIT = 2, "The motion repeats, but not with one contact in every drive period."
    NOT_SETTLED = 3, "The motion did not settle in the time it was given; amplitude and lag are means of its end."
    CAPTURED = 4, "The sample captured the tip; at the next height it begins anew, swinging as it last did."
    BROKE_OFF = 5, "The simulation broke off; at the next height the tip begins anew, swinging as it last did."


class Motion(NamedTuple):
    """A motion to go on from: the tip at the top of its swing over a sample at a height in nm."""

    height_nm: float
    state: State
    lost: bool = False
    """Whether it did not get to the next height: then it begins there at once, the sample being put there."""


class HeightReading(NamedTuple):
    """What is read at one height; NaN and 0 where there is nothing to read."""

    outcome: CurveOutcome
    reason: str
    amplitude_nm: float = math.nan
    phase_lag_deg: float = math.nan
    dissipated_in_contact_aj: float = math.nan
    virial_aj: float = math.nan
    contacts: int = 0
    periods: int = 0


@public_result(picture="afm_jax.plots.approach_curve:approach_curve_figure", outcome=CurveOutcome)
class ApproachCurve(ResultTuple):
    """Amplitude and lag against the sample's height; NumPy arrays, a point a height, in the order they were followed.

    Under a moving base amplitude and lag are of the deflection, behind the base; else of the height, behind the force.
    """

    height_nm: Float[np.ndarray, " points"]
    """Height of the sample over the tip's rest position: negative below it."""
    retract: Bool[np.ndarray, " points"]
    """Whether the sample moved away to get here."""
    amplitude_nm: Float[np.ndarray, " points"]
    """Lock-in amplitude at the drive's frequency; NaN where nothing could be read."""
    phase_lag_deg: Float[np.ndarray, " points"]
    """Lag behind the drive, from 0 to 360; NaN where nothing could be read."""
    dissipated_in_contact_aj: Float[np.ndarray, " points"]
    """Energy lost to the sample in a drive period."""
    virial_aj: Float[np.ndarray, " points"]
    """Mean of force times height over a drive period; positive where attraction prevails."""
    contacts: Int[np.ndarray, " points"]
    """Contacts until the motion repeats; 0 also where it does not."""
    periods: Int[np.ndarray, " points"]
    """Drive periods until the motion repeats; 0 where it does not."""
    outcome: Int[np.ndarray, " points"]
    """What came of the motion at each point, numbers of `CurveOutcome`."""
    reasons: tuple[str, ...]
    """The outcome of each point in words, with its numbers."""
    scene: Scene
    """The scene, its sample at the height of its file."""
    drive: str
    """What is driven: "force" (on the tip) or "base"."""
    drive_frequency_khz: float
    free_amplitude_nm: float
    """Amplitude of the free tip, in closed form."""
    free_phase_lag_deg: float
    """Lag of the free tip behind the drive, in closed form."""

    @property
    def settles(self) -> bool:
        """Whether the motion repeats at a height."""
        return bool(np.isin(self.outcome, [CurveOutcome.TAPS, CurveOutcome.FREE, CurveOutcome.OTHER_ORBIT]).any())


@csv_columns.register
def _(curve: ApproachCurve) -> CsvColumns:
    # a row a height
    names = ("height_nm", "amplitude_nm", "phase_lag_deg", "dissipated_in_contact_aj", "virial_aj")
    repeats = curve.periods > 0
    points = {
        **{name: getattr(curve, name) for name in names},
        "direction": np.where(curve.retract, "retract", "approach").tolist(),
        **{name: list(np.where(repeats, getattr(curve, name), None)) for name in ("contacts", "periods")},
        "outcome": [CurveOutcome(kind).name.lower() for kind in curve.outcome.tolist()],
        "reason": list(curve.reasons),
    }
    return {"curve_points.csv": points}


@as_json.register
def _(curve: ApproachCurve) -> dict[str, Any]:
    free_tip = ("drive", "drive_frequency_khz", "free_amplitude_nm", "free_phase_lag_deg")
    told = {name: getattr(curve, name) for name in free_tip} | {"valid": curve.settles}
    return told | dict(csv_columns(curve)["curve_points.csv"])


@sections.register
def _(curve: ApproachCurve) -> list[Section]:
    cells = {
        "height\n(nm)": "height_nm",
        "": "direction",
        "amplitude\n(nm)": "amplitude_nm",
        "lag\n(degrees)": "phase_lag_deg:.5g",
        "lost to the\nsample (aJ)": "dissipated_in_contact_aj:.4g",
        "outcome": "outcome",
    }
    free_tip = (
        f"Free tip, driven by a {curve.drive} at {curve.drive_frequency_khz:.6g} kHz: "
        f"{curve.free_amplitude_nm:.6g} nm, {curve.free_phase_lag_deg:.5g} degrees."
    )
    counts = [(kind, int(np.count_nonzero(curve.outcome == kind))) for kind in CurveOutcome]
    said = [f"{count} of {len(curve.reasons)}: {kind.sentence}" for kind, count in counts if count]
    return [Section("", [table_of(cells, rows_of(csv_columns(curve)["curve_points.csv"])), free_tip, *said])]


@checked
def approach_curve(
    scene: Scene,
    heights_nm: Sequence[float] | Float[np.ndarray, " heights"],
    *,
    both_ways: bool = True,
    longest_periods: int | None = None,
    accuracy: float = DEFAULT_ACCURACY,
    report: Callable[[int, int], None] = lambda _done, _total: None,
) -> ApproachCurve:
    """Return amplitude and lag of a driven tip at a series of heights of the sample, each followed until it repeats.

    The first height begins with the steady motion of the free tip.

    Args:
        scene: with a force on the tip or a moving base, of one frequency, over a sample at rest.
        heights_nm: of the sample over the tip's rest position, in the order to be followed.
        both_ways: go back through the heights as well.
        longest_periods: drive periods after which a motion counts as not settling; None: 2000, and at least 20 Q.
        accuracy: of each contact, as for `simulate`.
        report: called after each height with how many of how many are done.

    Raises:
        ValueError: if nothing or more than the cantilever is driven, the sample moves, or there are no heights.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    require_float64(scene)
    drive = _only_drive(scene)
    course = np.asarray(heights_nm, float).ravel()
    if not course.size or not np.isfinite(course).all():
        raise ValueError("`heights_nm` must be finite numbers, at least one")
    if longest_periods is None:
        longest_periods = max(_FEWEST_PERIODS, math.ceil(_RINGING * float(scene.cantilever.quality_factor or 0.0)))
    check_count("longest_periods", longest_periods)
    if both_ways:
        course = np.concatenate([course, course[-2::-1]])
    motion, readings = _free_motion(scene, float(course[0])), []
    for height in course.tolist():
        reading, end = _at_height(scene, motion, height, longest_periods, accuracy)
        motion = motion._replace(lost=True) if end is None else Motion(height, end)
        readings.append(reading)
        report(len(readings), len(course))
    columns: dict[str, Any] = dict(zip(HeightReading._fields, map(np.array, zip(*readings, strict=True)), strict=True))
    columns["reasons"] = tuple(columns.pop("reason").tolist())
    ratio = drive.frequency_khz / scene.cantilever.frequency_khz
    gamma = complex(*map(float, force_per_height(ratio, scene.cantilever.quality_factor)))
    # the free tip where its height is real: the drive is gamma times that, the deflection against a base the rest
    free = _free_height_nm(scene) * (1.0 if scene.base is None else 1.0 - gamma)
    return ApproachCurve(
        height_nm=course,
        # the first height belongs to the way to the second
        retract=np.diff(course, prepend=2.0 * course[0] - course[:2][-1]) < 0.0,
        scene=scene,
        drive="force" if scene.base is None else "base",
        drive_frequency_khz=float(drive.frequency_khz),
        free_amplitude_nm=float(abs(free)),
        free_phase_lag_deg=float(np.degrees(np.angle(gamma) - np.angle(free)) % 360.0),
        **columns,
    )


def _only_drive(scene: Scene) -> BaseDrive | ForceDrive:
    """Return the drive of a scene's cantilever; there must be exactly one, with one frequency.

    Raises:
        ValueError: if not; says how to mend it.
    """
    need = "an approach curve is that of a cantilever driven over a sample at rest: "
    require_one_frequency(scene)
    if scene.base is not None and scene.force is not None:
        raise ValueError(f"{need}the scene has both [base] and [force]; leave one out")
    drive = scene.force if scene.base is None else scene.base
    if drive is None:
        raise ValueError(f"{need}give the scene a [force] or a [base] (here the sample drives the tip)")
    if float(scene.platform.amplitude_nm) != 0.0 or float(scene.platform.offset_rate_nm_per_us) != 0.0:
        raise ValueError(f"{need}set `platform.amplitude_nm` and `platform.offset_rate_nm_per_us` to 0")
    if not float(drive.tones[0].amplitude) > 0.0:
        raise ValueError(f"{need}the amplitude of its drive must be above 0")
    return drive


def _free_height_nm(scene: Scene) -> float:
    """Return the amplitude of the free tip's height."""
    drive: Any = scene.force or scene.base
    return float(drive.tones[0].amplitude / drive_per_free_height(scene.cantilever, drive.frequency_khz, type(drive)))


def _free_motion(scene: Scene, height_nm: float) -> Motion:
    """Return the free tip in its steady motion over a sample at a height, or as far up as does not touch it."""
    response: Any = surface_of(scene)[1]
    times = np.linspace(0.0, drive_of(scene).period_us, _TIMES)
    top = times[np.argmax(np.asarray(response.position_and_velocity(times)[0]))]
    start = state(top, *map(float, response.position_and_velocity(top)))
    return Motion(min(height_nm, -_free_height_nm(scene) - felt_nm(scene) - _CLEARANCE_NM), start)


def _at_height(
    scene: Scene, begin: Motion, height_nm: float, longest_periods: int, accuracy: float
) -> tuple[HeightReading, State | None]:
    """Return what is read at a height, and the tip at the top of its swing there; None where it does not fly any more.

    Args:
        scene: the scene, at any height.
        begin: where to come from.
        height_nm: of the sample over the rest position.
        longest_periods: drive periods after which the motion counts as not settling.
        accuracy: of each contact.
    """
    period_us = drive_of(scene).period_us
    start, here = begin.state, _with_sample(scene, height_nm, 0.0)
    clear = float(to_gap(*surface_of(here), start)[0]) > felt_nm(scene)
    if begin.height_nm != height_nm and not (begin.lost and clear):
        periods = math.ceil(abs(height_nm - begin.height_nm) / (_MOVED * _free_height_nm(scene)))
        rate = (height_nm - begin.height_nm) / (periods * period_us)
        moving = _with_sample(scene, begin.height_nm - rate * float(start.time_us), rate)
        on_the_way = follow_long(moving, start, periods * period_us, accuracy=accuracy)
        reading = _why_over(on_the_way)
        if reading is not None:
            return reading, None
        end_us = float(on_the_way.simulation.final.time_us)
        start = _top_of_swing(DensePath(moving, on_the_way.simulation), end_us - period_us, end_us, period_us)
        if start is None:
            return HeightReading(CurveOutcome.CAPTURED, "the sample holds the tip on the way there"), None

    def over(motion: Simulation) -> bool:
        if is_stuck(here, motion):
            return True
        verdict = settled(here, motion, tolerance=TOLERANCE)
        return verdict.settled and (verdict.periods == 1 or settled(here, motion, tolerance=_STRICTER).settled)

    run = follow_long(here, start, longest_periods * period_us, enough=over, accuracy=accuracy)
    reading = _why_over(run)
    if reading is not None:
        return reading, None
    verdict = settled(here, run.simulation, tolerance=TOLERANCE)
    dense = DensePath(here, run.simulation)
    seen = observe(here, run.simulation, verdict=verdict, dense=dense)
    top = _top_of_swing(dense, seen.window.from_us, seen.window.to_us, period_us)
    return _reading_of(seen, deflection=scene.base is not None), top


def _with_sample(scene: Scene, height_nm: float, rate: float) -> Scene:
    """Return a scene with its sample at a height at time 0 and a rate in nm/us."""
    place = jnp.asarray(height_nm), jnp.asarray(rate)
    return eqx.tree_at(lambda s: (s.platform.offset_nm, s.platform.offset_rate_nm_per_us), scene, place)


def _why_over(run: LongRun) -> HeightReading | None:
    """Return what to say of a motion that does not go on; None where it does."""
    if run.simulation.broke_off is not None:
        return HeightReading(CurveOutcome.BROKE_OFF, run.simulation.broke_off)
    return HeightReading(CurveOutcome.CAPTURED, run.verdict.reason) if run.verdict.stuck else None


def _top_of_swing(dense: DensePath, from_us: float, to_us: float, period_us: float) -> State | None:
    """Return the tip in flight where it is highest between two times, its time in the first drive period."""
    path = dense.at(np.linspace(from_us, to_us, _TIMES))
    heights = np.where(path.phase == ContactPhase.DRY, path.position_nm, -np.inf)
    top = int(np.argmax(heights))
    if not np.isfinite(heights[top]):
        return None
    return state(path.time_us[top] % period_us, path.position_nm[top], path.velocity_nm_per_us[top])


def _reading_of(seen: Observables, *, deflection: bool) -> HeightReading:
    """Return what is kept of the observables of a motion: of the deflection or of the height."""
    verdict = seen.settled
    outcomes: dict[tuple[int | None, int | None], CurveOutcome] = {(1, 1): CurveOutcome.TAPS, (0, 1): CurveOutcome.FREE}
    repeats = outcomes.get((verdict.contacts, verdict.periods), CurveOutcome.OTHER_ORBIT)
    amplitude = seen.deflection_drive_lockin_amplitude_nm if deflection else seen.drive_lockin_amplitude_nm
    assert amplitude is not None and seen.phase_lag_deg is not None  # the cantilever is driven  # noqa: S101, PT018
    return HeightReading(
        repeats if verdict.settled else CurveOutcome.NOT_SETTLED,
        verdict.reason,
        amplitude_nm=amplitude,
        phase_lag_deg=seen.phase_lag_deg,
        dissipated_in_contact_aj=seen.dissipated_in_contact_aj,
        virial_aj=seen.virial_aj,
        contacts=verdict.contacts or 0,
        periods=verdict.periods or 0,
    )
