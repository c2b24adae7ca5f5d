"""Figures 10 and 11: a settled motion under a slowly rising offset, beside the orbits of the impact law."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.law_of_contact import law_of_contact
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.observe import Departures, departures
from afm_jax.motion.record import State
from afm_jax.motion.settle import follow_long
from afm_jax.motion.start import default_start

CONTACTS_OF_A_PIECE = 400
_SETTLING_PERIODS = 250.0
"""Drive periods at the first offset; hundreds of us, several decay times of a free vibration (141 us)."""


Report = Callable[[str], object]


class Ramp(NamedTuple):
    """A motion whose offset rises steadily."""

    rate_nm_per_us: float
    motion: Departures
    offset_nm: Float[np.ndarray, " contacts"]
    """Of the platform, at each departure."""
    law_peak_nm: Float[np.ndarray, " contacts"]
    """Peak height of the stable (1,1) orbit of the impact law with delay at these offsets; NaN where there is none."""

    def offset_at(self, time_us: float) -> float:
        """Return the offset in nm at a time."""
        platform = self.motion.scene.platform
        return float(platform.offset_nm + platform.offset_rate_nm_per_us * time_us)


def slow_ramps(
    scene_of: Callable[..., Scene], ramps: tuple[tuple[float, float], ...], *, report: Report = lambda _: None
) -> tuple[float, list[Ramp]]:
    """Settle a scene at its first offset, then raise the offset at several rates.

    Args:
        scene_of: the scene of an offset in nm and a rate in nm/us; without them at its first offset.
        ramps: rate in nm/us and last offset in nm of each.
        report: told how far it is.

    Returns:
        The settled peak height in nm at the first offset, and the ramps.
    """
    still = scene_of()
    period, first = float(still.platform.period_us), float(still.platform.offset_nm)
    begin = default_start(still)
    until = float(begin.time_us) + _SETTLING_PERIODS * period
    settled = _followed(still, begin, until, report, f"settling at {first:g} nm")
    # the drive does not change under a shift by whole periods
    time = float(settled.departure_time_us[-1])
    start = State(
        *(
            jnp.asarray(value)
            for value in (
                time % period,
                settled.departure_position_nm[-1],
                settled.departure_velocity_nm_per_us[-1],
            )
        )
    )
    found = []
    for rate, last in ramps:
        scene = scene_of(first - rate * float(start.time_us), rate)
        until = float(start.time_us) + (last - first) / rate
        motion = _followed(scene, start, until, report, f"ramp of {rate:g} nm/us")
        offset = first + rate * (motion.departure_time_us - float(start.time_us))
        found.append(Ramp(rate, motion, offset, law_peaks(still, offset)))
    return float(settled.peak_height_nm[np.isfinite(settled.peak_height_nm)][-1]), found


def _followed(scene: Scene, start: State, until_us: float, report: Report, what: str) -> Departures:
    """Return a motion followed to a time."""
    run = follow_long(
        scene,
        start,
        until_us - float(start.time_us),
        piece_contacts=CONTACTS_OF_A_PIECE,
        report=told_of_progress(report, what, until_us),
    )
    return departures(scene, run.simulation)


def told_of_progress(report: Report, what: str, until_us: float) -> Callable[[float, int], None]:
    """Return a report of time and contacts that says in words how far a motion is."""

    def told(time_us: float, contacts: int) -> None:
        _ = report(f"{what}: {contacts} contacts, {100.0 * min(1.0, time_us / until_us):.0f} % of the time")

    return told


def law_peaks(scene: Scene, offset_nm: Float[np.ndarray, " offsets"]) -> Float[np.ndarray, " offsets"]:
    """Return the peak heights of stable (1,1) orbits of the law with delay closest to a scene's contact.

    Args:
        scene: the scene.
        offset_nm: of the platform.
    """
    law = law_of_contact(scene.interaction, float(scene.cantilever.mass_ng))
    if law is None:
        return np.full(offset_nm.shape, np.nan)
    ideal = eqx.tree_at(lambda s: s.interaction, scene, law, is_leaf=lambda node: node is scene.interaction)

    @jax.jit
    @jax.vmap
    def peak(offset):
        orbits = single_impact_orbits(eqx.tree_at(lambda s: s.platform.offset_nm, ideal, offset), 1.0)
        good = orbits.exists & orbits.admissible & orbits.stable
        return jnp.max(jnp.where(good, orbits.peak_amplitude_nm, -jnp.inf))

    heights = np.asarray(peak(jnp.asarray(offset_nm)))
    return np.where(np.isfinite(heights), heights, np.nan)
