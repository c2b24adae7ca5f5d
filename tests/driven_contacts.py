"""Random contacts of driven tips: what `simulate` makes of them, beside SciPy.

`python -m tests.driven_contacts --tips 256` measures at which share of them `accuracy=` of `simulate` holds.
"""

import argparse
import sys
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import DOP853

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.contact.collide import capture_speed
from afm_jax.contact.contact import Contact
from afm_jax.motion.record import State
from afm_jax.motion.simulate import simulate
from tests.reference_contact_forces import ContactParameters
from tests.reference_driven_contact import DrivenContact, follow
from tests.reference_driven_motion import Motion

SPAN_US = 12.0
EACH = 16
"""Tips of one contact."""
NAMES = ("relative_humidity", "adhesion_energy_j_per_m2", "viscosity_pa_s", "modulus_gpa")


class Closer(DOP853):
    """Steps judged 30 times as severely as SciPy's smallest tolerance allows: of some 1e-15."""

    def _estimate_error_norm(self, K, h, scale):
        return 30.0 * super()._estimate_error_norm(K, h, scale)


class Tips(NamedTuple):
    """Columns of one row a tip; `start` is just before the bridge forms, gap closing."""

    contact: dict[str, Any]
    quality: np.ndarray
    amplitude: np.ndarray
    drive_khz: np.ndarray
    time: np.ndarray
    rate: np.ndarray


def random_tips(count: int, seed: int) -> Tips:
    """Return tips that come from 1 + 1e-7 to 20 times the capture speed of a free tip on."""
    draw = np.random.default_rng(seed)
    kinds = -(-count // EACH)

    def between(low: float, high: float, n: int = count) -> np.ndarray:
        return np.exp(draw.uniform(np.log(low), np.log(high), n))

    ranges = ((0.2, 0.8), (0.15, 0.6), (1e-4, 1e-2), (30.0, 300.0))
    kind = {name: between(*ends, kinds) for name, ends in zip(NAMES, ranges, strict=True)}
    bound = np.asarray(jax.jit(jax.vmap(lambda values: capture_speed(Contact.paper(**values))))(kind))
    place = np.arange(count) // EACH
    drive = between(0.5, 6.0) * 180.0
    return Tips(
        {name: column[place] for name, column in kind.items()},
        between(15.0, 300.0),
        between(0.5, 6.0),
        drive,
        draw.uniform(0.0, 1e3, count) / drive,
        -bound[place] * (1.0 + between(1e-7, 20.0)),
    )


def _one(tip: Tips, accuracy: float) -> Any:
    platform = Platform(tip.amplitude, tip.drive_khz)
    scene = Scene(Cantilever(90.0, tip.quality), platform, Contact.paper(**tip.contact))
    height, speed = platform.position_and_velocity(tip.time)
    start = State(*map(jnp.asarray, (tip.time, height + 3.6, speed + tip.rate)))
    found = simulate(scene, start, SPAN_US, max_contacts=1, accuracy=accuracy)
    rows = found.contacts
    return rows.kind[0], rows.departure_time_us[0], rows.rebound_speed_nm_per_us[0], found.outcome


@partial(jax.jit, static_argnums=1)
def through(tips: Tips, accuracy: float) -> Any:
    """Return of each tip the kind of its first contact, departure in us, rebound speed, and the outcome."""
    return jax.vmap(lambda tip: _one(tip, accuracy))(tips)


def exact(tips: Tips) -> tuple[np.ndarray, np.ndarray]:
    """Return departure in us and rebound speed of each tip from SciPy; NaN where it does not leave in time.

    Contacts left slowly, and those that turn in the bridge, magnify errors: SciPy's method at the tolerance 1e-12 is up
    to 6e-10 off, at 1e-13 a tenth of it.
    """
    ends = []
    for tip in range(tips.time.size):
        values: Any = {name: float(column[tip]) for name, column in tips.contact.items()}
        system = DrivenContact(
            amplitude_nm=float(tips.amplitude[tip]),
            drive_frequency_khz=float(tips.drive_khz[tip]),
            quality_factor=float(tips.quality[tip]),
            contact=ContactParameters(**values),
        )
        time, rate = float(tips.time[tip]), float(tips.rate[tip])
        base, speed, _ = Motion(system).platform(time)
        ends_us = time + SPAN_US
        course = follow(system, time, base + 3.6, speed + rate, until_us=ends_us, contacts=1, rtol=3e-14, method=Closer)
        first = course.contacts[0] if course.contacts else None
        ends.append((np.nan, np.nan) if first is None else (first.departure_time_us, first.rebound_speed_nm_per_us))
    departure, rebound = np.array(ends).T
    return departure, rebound


def how_far_off(found: Any, right: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return how far each tip is off that leaves: relative of the rebound speed, or ten times its time in us.

    Infinite where one leaves and the other does not.
    """
    departure, rebound = right
    leaves, mine = np.isfinite(departure), np.asarray(found[0]) == 1
    speed = np.abs(np.asarray(found[2]) / rebound - 1.0)
    time = 10.0 * np.abs(np.asarray(found[1]) - departure)
    return np.where(leaves & mine, np.fmax(speed, time), np.where(leaves == mine, 0.0, np.inf))


def main() -> None:
    """Print the share at which each level holds."""
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tips", type=int, default=256)
    options = parser.parse_args()
    tips = random_tips(options.tips, 11)
    right = exact(tips)
    leaves = np.isfinite(right[0])
    sys.stdout.write(f"{leaves.sum()} of {leaves.size} leave within {SPAN_US:g} us\n")
    for level in (1e-3, 1e-6, 1e-9, 1e-11):
        found = jax.tree.map(np.asarray, through(jax.tree.map(jnp.asarray, tips), level))
        off = how_far_off(found, right)
        held, many = np.mean(off <= level), np.quantile(off, [0.5, 0.9, 0.99])
        sys.stdout.write(f"{level:g}: holds for {held:.4f}; half, nine tenths, 99 % are within {many}\n")


if __name__ == "__main__":
    main()
