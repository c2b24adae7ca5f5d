"""Synthetic measurements: the amplitude table that an instrument would give of a full scene.

Every row of the table to be is a periodic motion of the full scene: Newton's method finds where a response period that
is simulated in time ends as it began.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.apparatus.surface import detected, height_of_free_deflection
from afm_jax.checks import check_count, check_parameter, checked, require_float64
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import approximate_law
from afm_jax.impact.law import ImpactLaw
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.approach_curve import ApproachCurve, CurveOutcome
from afm_jax.motion.observe import MotionWindow
from afm_jax.motion.periodic import close_periods, ends_in_flight
from afm_jax.motion.record import Simulation, State
from afm_jax.motion.simulate import simulate
from afm_jax.motion.trajectory import DensePath
from afm_jax.results import Result, ResultTuple, public_result
from afm_jax.solve.lanes import in_blocks
from fitting.tables.table import DRIVES, AmplitudeTable

US_PER_MS = 1e3
BATCH = 16
"""Rows simulated side by side: one program serves all tables, and its last row keeps few others waiting."""
_CONTACTS = 8
"""Room for contacts in a response period: motions with more than one are no single-impact orbits."""


@public_result()
class Drives(ResultTuple):
    """Orders, frequencies, amplitudes and offsets of the drives of an experiment, one entry a row."""

    order: Int[np.ndarray, " rows"]
    """N, drive periods per impact."""
    frequency_khz: Float[np.ndarray, " rows"]
    amplitude_nm: Float[np.ndarray, " rows"]
    """Amplitude of the sample; of the free tip (of its deflection, if the base is driven) where that is driven."""
    offset_nm: Float[np.ndarray, " rows"]


Follow = Callable[[np.ndarray, np.ndarray], Simulation]
"""Of starts of shape (3, n) and the numbers of their rows: the simulations, a response period each."""
Readings = tuple[float, float, float]
"""Peak and lock-in amplitude in nm, and the lock-in's phase in [0, 360/N) degrees."""


def steady_rows(
    interaction: Contact | ImpactLaw, cantilever: Cantilever, drives: Drives
) -> tuple[dict[int, Readings], dict[int, str]]:
    """Return what is observed of the drives whose motion is the (1, N) orbit asked for, and why others have none.

    Both by the number of the drive. Every row starts in the middle of the flight of the stable orbit that the law with
    delay closest to the contact predicts, the fastest if there are several. If it predicts none at all, as on
    resonance, where the lever turns the tip round, they start as taps that cost nothing.

    Args:
        interaction: a contact, or a law with or without a collision delay.
        cantilever: the cantilever.
        drives: what is driven.

    Raises:
        ValueError: if the contact has no junction.
        RuntimeError: if JAX is not set to 64-bit floats.
    """
    law = interaction if isinstance(interaction, ImpactLaw) else approximate_law(interaction, float(cantilever.mass_ng))
    if law is None:
        return {}, dict.fromkeys(range(len(drives.order)), "the contact captures tips of every speed")
    follow = _follower(interaction, cantilever, drives)
    starts, predicted = _starts(law, cantilever, drives)
    if not predicted.any():
        starts, predicted = _starts_on_resonance(drives)
    no_orbit = "the law closest to the contact has no stable single-impact orbit there"
    reasons = dict.fromkeys(np.flatnonzero(~predicted).tolist(), no_orbit)
    waiting = np.flatnonzero(predicted)
    if not waiting.size:
        return {}, reasons
    orbits = close_periods(
        lambda starts, rows: ends_in_flight(follow(starts, rows)),
        starts[:, waiting],
        waiting,
        angular_frequency=float(cantilever.angular_frequency),
    )
    # multipliers are known to 1e-4
    stable = orbits.closed & (orbits.contraction < 0.9999)
    motions = follow(np.where(stable, orbits.starts, starts[:, waiting]), waiting)
    steady: dict[int, Readings] = {}
    for lane, row in enumerate(waiting.tolist()):
        if not stable[lane] or motions.count[lane] != 1:
            reasons[row] = "no stable orbit of one contact in a response period lies near the closest law's"
            continue
        motion = jax.tree.map(lambda part, lane=lane: part[lane], motions)
        scene = Scene(cantilever, _platform(drives, row), interaction)
        steady[row] = _readings(scene, motion, float(orbits.starts[0, lane]), int(drives.order[row]))
    return steady, dict(sorted(reasons.items()))


def _platform(drives: Drives, rows: int | Int[np.ndarray, " n"]) -> Platform:
    chosen = (drives.amplitude_nm[rows], drives.frequency_khz[rows], drives.offset_nm[rows])
    # every field an array of the rows' shape, for `vmap`
    amplitude, frequency, offset = (jnp.asarray(part, float) for part in chosen)
    return Platform(amplitude, frequency, offset, jnp.zeros(np.shape(rows)))


def _starts(law: ImpactLaw, cantilever: Cantilever, drives: Drives) -> tuple[Float[np.ndarray, "3 rows"], np.ndarray]:
    """Return time, position and velocity halfway through the flight of the predicted orbits, and where there is one."""

    def one(platform, order):
        orbits = single_impact_orbits(Scene(cantilever, platform, law), order)
        steady = orbits.exists & orbits.admissible & orbits.stable
        slot = jnp.argmax(jnp.where(steady, orbits.approach_speed_nm_per_us, -jnp.inf))
        time = orbits.phase_rad[slot] / platform.angular_frequency
        half = 0.5 * (order * platform.period_us - orbits.delay_us[slot])
        place = cantilever.propagator(half)(platform.position(time), orbits.velocity_after_nm_per_us[slot])
        return jnp.stack([time + half, *place]), steady[slot]

    program = jax.jit(jax.vmap(one))
    rows = np.arange(len(drives.order))
    lanes = (_platform(drives, rows), drives.order.astype(float))
    starts, found = in_blocks(lambda some: program(*some), lanes, widths=(BATCH,))
    return np.array(starts.T), found


def _starts_on_resonance(drives: Drives) -> tuple[Float[np.ndarray, "3 rows"], np.ndarray]:
    """Return time, position and velocity of taps without loss on resonance, and which drives have one.

    Such a tip is far out where the free one is.
    """
    height, omega = -drives.offset_nm, 2e-3 * np.pi * drives.frequency_khz
    fraction = np.clip(height / drives.amplitude_nm, 0.0, 1.0)
    speed = omega * drives.amplitude_nm * np.sqrt(1.0 - fraction**2)
    starts = np.stack([np.arccos(-fraction) / omega, np.zeros_like(omega), -speed])
    return starts, (drives.order == 1) & (fraction > 0.0) & (fraction < 1.0)


def _follower(interaction: Contact | ImpactLaw, cantilever: Cantilever, drives: Drives) -> Follow:
    """Return the function that follows rows of the drives."""

    @jax.jit
    def program(interaction, cantilever, platforms, starts, durations):
        def one(platform, start, duration):
            scene = Scene(cantilever, platform, interaction)
            return simulate(scene, start, duration, max_contacts=_CONTACTS, max_rounds=4 * _CONTACTS + 400)

        return jax.vmap(one)(platforms, starts, durations)

    def follow(starts: np.ndarray, rows: np.ndarray) -> Simulation:
        durations = drives.order[rows] / drives.frequency_khz[rows] * US_PER_MS
        lanes = (_platform(drives, rows), State(*starts), durations)
        return in_blocks(lambda some: program(interaction, cantilever, *some), lanes, widths=(BATCH,))

    return follow


def _readings(scene: Scene, motion: Simulation, begin_us: float, order: int) -> Readings:
    """Return what is read of one response period."""
    end_us = begin_us + order * scene.platform.period_us
    height = MotionWindow(DensePath(scene, motion), begin_us, float(end_us), order).height
    return height.largest, height.at_response.amplitude_nm, height.at_response.phase_deg


@public_result()
@dataclass(frozen=True, kw_only=True)
class SimulatedExperiment(Result):
    """A simulated amplitude table, and what was behind it.

    Attributes:
        table: with noise, as an instrument gives it.
        exact: the table's rows and errors without noise.
        left_out: a sentence for every drive that is not in the table: no steady (1, N) orbit, and why.
    """

    table: AmplitudeTable
    exact: AmplitudeTable
    left_out: tuple[str, ...]


def drives_of(rows: Sequence[tuple[int, float, float, float]]) -> Drives:
    """Return drives from rows of order, frequency in kHz, amplitude in nm and offset in nm."""
    columns = np.array(rows, float).reshape(-1, 4).T
    return Drives(columns[0].astype(np.int64), *columns[1:])


@checked
def simulate_experiment(  # noqa: PLR0913
    interaction: Contact | ImpactLaw,
    cantilever: Cantilever,
    drives: Drives,
    *,
    drive: str = "sample",
    noise: float = 0.01,
    phase_noise_deg: float | None = None,
    seed: int = 0,
    quality_factor_error: float | None = None,
    remarks: tuple[str, ...] = (),
) -> SimulatedExperiment:
    """Return the amplitudes that an experiment on a scene would read, with noise.

    Every drive is simulated in time over one response period, begun where it repeats to 1e-9, and observed over that.

    Args:
        interaction: a contact, or a law with or without a collision delay.
        cantilever: the cantilever; its Q enters the table as the known value.
        drives: how it is driven, see `drives_of`.
        drive: what is driven: "sample", "force" (on the tip) or "base"; of the latter two (order 1) the free amplitude,
            the lock-in amplitude and the lag are read. Simulated in the frame of the free tip, in which the sample
            moves.
        noise: standard error of peak and lock-in amplitude as a share of each, drawn independently.
        phase_noise_deg: standard error of the phase in degrees; None: the table has no phase.
        seed: of the noise.
        quality_factor_error: uncertainty of Q that the table states; None: none.
        remarks: comments for the table.

    Returns:
        The table with and without noise, and what was left out.

    Raises:
        ValueError: if the noise is not between 0 and 1, an order is no positive integer, the contact has no junction,
            or no drive has a steady (1, N) orbit.
        RuntimeError: if JAX is not set to 64-bit floats, or was not when the contact, law or cantilever was built.
    """
    require_float64(interaction, cantilever)
    _check(drives, drive, noise, phase_noise_deg)
    check_count("seed", seed, 0)
    ratio = drives.frequency_khz / float(cantilever.frequency_khz)
    moved = drives
    if drive == "base":
        height = height_of_free_deflection(drives.amplitude_nm, ratio, cantilever.quality_factor)
        moved = drives._replace(amplitude_nm=np.asarray(height))
    steady, reasons = steady_rows(interaction, cantilever, moved)
    left_out = tuple(
        f"order {drives.order[i]}, {drives.frequency_khz[i]:g} kHz, {drives.amplitude_nm[i]:g} nm, "
        f"offset {drives.offset_nm[i]:g} nm: {reason}"
        for i, reason in reasons.items()
    )
    if not steady:
        raise ValueError(f"no drive has a steady single-impact orbit (the first: {left_out[0]})")
    kept, (peak, lockin, degrees) = np.array([*steady]), np.array([*steady.values()]).T
    known = cantilever.quality_factor
    columns: dict[str, Any] = {f"{'drive' if drive == 'sample' else 'free'}_amplitude_nm": drives.amplitude_nm[kept]}
    if drive == "sample":
        columns |= {"peak_amplitude_nm": peak, "peak_amplitude_error_nm": noise * peak}
    else:
        seen = detected(lockin, degrees, moved.amplitude_nm[kept], ratio[kept], known, base=drive == "base")
        lockin, degrees = (np.asarray(part) for part in seen)
    if phase_noise_deg is not None:
        phase = "phase" if drive == "sample" else "phase_lag"
        columns |= {f"{phase}_deg": degrees, f"{phase}_error_deg": np.full(degrees.shape, phase_noise_deg)}
    exact = AmplitudeTable(
        drive=drive,
        order=drives.order[kept],
        drive_frequency_khz=drives.frequency_khz[kept],
        offset_nm=drives.offset_nm[kept],
        free_frequency_khz=float(cantilever.frequency_khz),
        quality_factor=None if known is None else float(known),
        quality_factor_error=quality_factor_error,
        mass_ng=float(cantilever.mass_ng),
        lockin_amplitude_nm=lockin,
        lockin_amplitude_error_nm=noise * lockin,
        remarks=remarks,
        **columns,
    )
    # drawn for every drive, so that one that is left out does not change the noise of the others
    draws = np.random.default_rng(seed).normal(size=(3, len(drives.order)))[:, kept]
    return SimulatedExperiment(table=with_noise(exact, draws), exact=exact, left_out=left_out)


@checked
def table_of_curve(
    curve: ApproachCurve, *, noise: float = 0.003, phase_noise_deg: float = 0.2, seed: int = 0
) -> AmplitudeTable:
    """Return an approach curve as an instrument gives it: with noise, as `tapping` reads it.

    Heights at which the tip neither taps once in a drive period nor is free have no amplitude (`no_orbit`).

    Args:
        curve: of `afm_jax.approach_curve`.
        noise: standard error of an amplitude relative to it.
        phase_noise_deg: standard error of a lag.
        seed: of the noise.

    Raises:
        ValueError: if the noise is not between 0 and 1, or that of the lag not between 0 and 90 degrees.
    """
    _check_noise(noise, phase_noise_deg)
    check_count("seed", seed, 0)
    cantilever, count = curve.scene.cantilever, len(curve.height_nm)
    told = np.isin(curve.outcome, (CurveOutcome.TAPS, CurveOutcome.FREE))
    amplitude = np.where(told, curve.amplitude_nm, np.nan)
    known = cantilever.quality_factor
    exact = AmplitudeTable(
        drive=curve.drive,
        drive_frequency_khz=np.full(count, curve.drive_frequency_khz),
        free_amplitude_nm=np.full(count, curve.free_amplitude_nm),
        offset_nm=curve.height_nm,
        lockin_amplitude_nm=amplitude,
        lockin_amplitude_error_nm=noise * amplitude,
        phase_lag_deg=np.where(told, curve.phase_lag_deg, np.nan),
        phase_lag_error_deg=np.where(told, phase_noise_deg, np.nan),
        retract=curve.retract.astype(float),
        no_orbit=(~told).astype(float),
        free_frequency_khz=float(cantilever.frequency_khz),
        quality_factor=None if known is None else float(known),
        mass_ng=float(cantilever.mass_ng),
        remarks=(f"simulated; noise of {100.0 * noise:g} % and {phase_noise_deg:g} degrees, seed {seed}",),
    )
    return with_noise(exact, np.random.default_rng(seed).normal(size=(3, count)))


def with_noise(exact: AmplitudeTable, draws: Float[np.ndarray, "3 rows"]) -> AmplitudeTable:
    """Return a table with its errors times standard normal draws added, rounded to six digits as an instrument prints.

    Args:
        exact: noise-free amplitudes with their errors.
        draws: of peak, lock-in amplitude and phase.
    """
    columns = {}
    for name, draw in zip(("peak_amplitude", "lockin_amplitude"), draws, strict=False):
        value, spread = getattr(exact, f"{name}_nm"), getattr(exact, f"{name}_error_nm")
        if value is not None:
            columns |= {f"{name}_nm": _rounded(value + spread * draw), f"{name}_error_nm": _rounded(spread)}
    phase, error = exact.phase_and_error_deg
    if phase is not None:
        measured = phase + np.asarray(error) * draws[2]
        columns["phase_lag_deg" if exact.tapping else "phase_deg"] = np.round(measured % (360.0 / exact.order), 6)
    return replace(exact, **columns)


def _rounded(values: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    return np.array([float(f"{value:.6g}") for value in values])


def check_drive(drive: str) -> None:
    """Check what is driven.

    Raises:
        ValueError: if it is neither the sample nor the cantilever.
    """
    if drive not in DRIVES:
        raise ValueError(f"`drive` must be one of {', '.join(DRIVES)}, but is {drive!r}")


def _check(drives: Drives, drive: str, noise: float, phase_noise_deg: float | None) -> None:
    check_drive(drive)
    if drive != "sample" and np.any(np.asarray(drives.order) != 1):
        raise ValueError(f"`drives` must have the order 1 where the {drive} is driven: that is what is read")
    _check_noise(noise, phase_noise_deg)
    if not len(drives.order) or np.any(np.asarray(drives.order) < 1):
        raise ValueError("`drives` must hold at least one drive, and orders of 1 or more")
    check_parameter("drives.frequency_khz", drives.frequency_khz, "positive")
    check_parameter("drives.amplitude_nm", drives.amplitude_nm, "positive")


def _check_noise(noise: float, phase_noise_deg: float | None) -> None:
    check_parameter("noise", noise, "between 0 and 1")
    if phase_noise_deg is not None and not 0.0 < phase_noise_deg < 90.0:
        raise ValueError(f"`phase_noise_deg` must be between 0 and 90, but is {phase_noise_deg!r}")
