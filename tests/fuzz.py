"""Random work for the package: `python -m tests.fuzz --flights 1000000 --orbits 100000 --scenes 10000 --files 10000`.

Seeded. Looked for are impacts that brute force finds and the search does not, numbers that are none without an outcome
that says so, files that end in anything but a result or one clear line, and anything that hangs.
"""

import argparse
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.cli.ending import is_inner
from afm_jax.impact.law import CollisionDelay, ImpactLaw
from afm_jax.impact.map import next_impact
from afm_jax.impact.orbits import single_impact_orbits
from afm_jax.motion.record import ContactKind, MotionOutcome, State
from afm_jax.motion.simulate import simulate
from afm_jax.outcomes import Outcome
from afm_jax.scenefile.law_files import load_law
from afm_jax.scenefile.scenefile import read_scene, read_toml
from afm_jax.studies.sweep import axes_of
from fitting.calibration.sweep import read_resonance
from fitting.experiments.prior import read_prior
from fitting.instruments.curve import read_curves
from fitting.tables.table import read_table
from fitting.tapping_curves.tapping import tapping
from fitting.traces.lockin import Trace, lockin, read_trace
from tests.flight_families import FAMILIES
from tests.malformed import corpus
from tests.test_first_impact import compare_with_brute_force

LONGEST_S = 60
"""Of the processor, for a batch; a file, or the slowest of its tips, takes a tenth of a second."""
LANES = 256
Random = np.random.Generator


def fuzz_flights(count: int, seed: int) -> None:
    """Compare first impacts with brute force, family by family."""
    block = min(2000, max(1, count // len(FAMILIES)))
    done = 0
    while done < count:
        for family in FAMILIES:
            compare_with_brute_force(seed + done, block, family)
            done += block


def _delayed(seed: int, number: int) -> bool:
    """Say whether a batch has laws with a delay: every other one, in slices too."""
    return bool((seed // LANES + number) % 2)


def _law_scenes(random: Random, *, delayed: bool) -> Scene:
    """Return a batch of law scenes over all that can be asked for."""
    frequency = 10.0 ** random.uniform(0.5, 3.0, LANES)
    cantilever = Cantilever(frequency, 10.0 ** random.uniform(-0.2, 7.0, LANES), np.ones(LANES))
    amplitude = 10.0 ** random.uniform(-3.0, 6.0, LANES)
    resonant = 2.0 * frequency * random.choice([0.5, 1.0, 1.0 + 1e-12, 1.01, 5.277, 50.0, 0.01], LANES)
    offset = amplitude * random.choice([0.0, 1.0, -1.0, 0.3, -5.0, 20.0], LANES)
    platform = Platform(amplitude, resonant, offset, np.zeros(LANES))
    top = np.asarray(platform.top_speed_nm_per_us)
    r, epsilon = random.choice([1e-3, 0.3, 0.9, 0.998, 1.0], LANES), random.choice([0.0, 1e-6, 0.1, 10.0], LANES)
    delay = None
    if delayed:
        hertz, lead, offset = random.uniform(0.0, 0.3, LANES), random.uniform(0.0, 6.0, LANES), np.zeros(LANES)
        delay = CollisionDelay(hertz, lead, offset, corrections=False)
    law = ImpactLaw(r, epsilon * top**2, random.choice([0.0, 0.01, 1.0], LANES) * top, delay)
    return Scene(cantilever, platform, law)


@jax.jit
@jax.vmap
def _orbits_and_returns(scene: Scene, order: Any) -> tuple[Any, Any]:
    found = single_impact_orbits(scene, order)
    start = found.phase_rad / scene.platform.angular_frequency
    safe = jnp.where(found.exists, found.velocity_after_nm_per_us, 1.0)
    back = jax.vmap(lambda time, velocity: next_impact(scene, time, velocity))(
        jnp.where(found.exists, start, 0.0), safe
    )
    return found, (back.time_us - start, back.outcome)


def fuzz_orbits(count: int, seed: int) -> None:
    """Look for orbits with numbers that are none, and for admissible ones that the map does not come back to."""
    random = np.random.default_rng(seed)
    for number in range(-(-count // LANES)):
        scenes = _law_scenes(random, delayed=_delayed(seed, number))
        order = random.integers(1, 8, LANES).astype(float)
        found, (returned, outcome) = jax.tree.map(np.asarray, _orbits_and_returns(scenes, order))
        exists = found.exists
        for name in ("phase_rad", "velocity_after_nm_per_us", "approach_speed_nm_per_us", "trace", "peak_amplitude_nm"):
            numbers = np.asarray(getattr(found, name))
            bad = exists & ~np.isfinite(numbers)
            assert not bad.any(), f"orbits, seed {seed}, batch {number}: {name} is none in {np.argwhere(bad)[:3]}"
        steady = exists & found.admissible & found.stable & ~found.near_double
        # at the edge of capture a delay, lead/u_out, makes 1e5 times as much of the last digits of a start
        steady &= found.rebound_speed_nm_per_us > 1e-5 * found.approach_speed_nm_per_us
        period = (order * np.asarray(scenes.platform.period_us))[:, None]
        apart = np.abs(returned / period - 1.0)
        lost = steady & ((outcome != Outcome.IMPACT) | (apart > 1e-6))
        assert not lost.any(), f"orbits, seed {seed}, batch {number}: no way back in {np.argwhere(lost)[:3]}"


def fuzz_scenes(count: int, seed: int) -> None:
    """Look for motions with numbers that are none, contacts out of order, and ends that nothing explains."""
    random = np.random.default_rng(seed)

    def one(scene: Scene, time_us: Any, gap: Any, rate: Any) -> Any:
        height, speed = scene.platform.position_and_velocity(time_us)
        duration = 20.0 * scene.platform.period_us
        return simulate(scene, State(time_us, height + gap, speed + rate), duration, max_contacts=64)

    batch = jax.jit(jax.vmap(one))
    for number in range(-(-count // LANES)):
        scenes = _law_scenes(random, delayed=_delayed(seed, number))
        size = np.asarray(scenes.platform.amplitude_nm)
        gap = random.choice([0.0, 1e-12, 0.1, 3.0], LANES) * size
        rate = random.choice([0.0, 1e-9, 1.0, -1.0, 5.0], LANES) * np.asarray(scenes.platform.top_speed_nm_per_us)
        motion = jax.tree.map(np.asarray, batch(scenes, random.uniform(0.0, 50.0, LANES), gap, rate))
        said = motion.outcome <= MotionOutcome.CONTACT_LIMIT
        for name in ("position_nm", "velocity_nm_per_us", "time_us"):
            bad = said & ~np.isfinite(getattr(motion.final, name))
            assert not bad.any(), f"scenes, seed {seed}, batch {number}: {name} is none in {np.flatnonzero(bad)[:3]}"
        rows = motion.contacts
        used = rows.kind != ContactKind.NONE
        assert np.isfinite(rows.arrival_time_us[used]).all(), f"scenes, seed {seed}, batch {number}: an arrival is none"
        assert (rows.approach_speed_nm_per_us[used] >= 0.0).all(), f"scenes, seed {seed}, batch {number}: it moves away"
        if not _delayed(seed, number):
            ordered = np.diff(np.where(used, rows.arrival_time_us, np.finfo(float).max), axis=1)
            assert not (ordered[used[:, 1:]] < 0.0).any(), f"scenes, seed {seed}, batch {number}: not in order"


PIECES = ("", ",", "\n", "#", "=", "nan", "inf", "1e999", "-1", "0", "1e308", "9" * 40, '"', "\x00", "\x1b[2J", "é")
PIECES += ("\ufeff", "[platform]", "true", "order", "drive_frequency_khz", " ", "\t", ";", "+-", "1,2", "0x1", "1_0")
PIECES += ("'", "\r", "\\")


def spoiled(text: str, random: Random) -> bytes:
    """Return a file with some things changed, doubled, cut off or thrown in."""
    for _ in range(random.integers(1, 5)):
        place = int(random.integers(0, len(text) + 1))
        end = min(len(text), place + int(random.choice([0, 1, 2, 5, 30])))
        match random.integers(0, 4):
            case 0:
                text = text[:place] + str(random.choice(PIECES)) + text[end:]
            case 1:
                text = text[:end] + text[place:]
            case 2:
                text = text[:place]
            case _:
                lines = text.split("\n")
                where = int(random.integers(0, len(lines)))
                lines.insert(int(random.integers(0, len(lines))), lines[where])
                text = "\n".join(lines)
    data = text.encode("utf-8", errors="surrogatepass")
    if random.random() < 0.1 and data:
        place = int(random.integers(0, len(data)))
        data = data[:place] + bytes([random.integers(0, 256)]) + data[place + 1 :]
    return data


def _lockin(trace: Trace) -> Any:
    return lockin(trace.time_us, trace.deflection_nm, trace.drive_frequency_khz or 180.0, 1)


READERS: dict[str, Callable[[Path], Any]] = {
    "table": read_table,
    "tap": lambda path: tapping(read_table(path), law=False),
    "scene": read_scene,
    "contact": read_scene,
    "sweep": lambda path: axes_of(read_toml(str(path)).get("axes", ())),
    "trace": lambda path: _lockin(read_trace(path)),
    "spectrum": read_resonance,
    "psd": read_resonance,
    "curve": read_curves,
    "nanonis": read_curves,
    "law": lambda path: (read_prior(path), load_law(path)),
    "speeds": load_law,
}
"""What reads a sound file of the corpus of malformed ones."""
READERS |= dict.fromkeys(("lawscene", "law scene", "drive scene", "contact scene"), READERS["scene"])
READERS |= {"long trace": READERS["trace"], "nanonis spectrum": READERS["spectrum"]}


def fuzz_files(count: int, seed: int) -> None:
    """Look for spoiled files that end in anything but a result or one clear line."""
    random, bases = np.random.default_rng(seed), corpus()[0]
    assert bases.keys() == READERS.keys()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            base = tuple(bases.values())[number % len(bases)]
            path, read = Path(folder) / base["file"], READERS[base["base"]]
            path.write_bytes(spoiled(base["text"], random))
            where = f"files, seed {seed}, number {number}"
            try:
                with warnings.catch_warnings():
                    # what NumPy says on standard error is not for users
                    warnings.simplefilter("error")
                    read(path)
            except Exception as error:
                if not isinstance(error, ValueError) or is_inner(error) or not str(error).isprintable():
                    raise AssertionError(f"{where}: {error!r}\n{path.read_bytes()!r}") from error


# what does a kind of work, how much of it is done unless another amount is asked for, and how much takes a few seconds
WORK = {
    "flights": (fuzz_flights, 1_000_000, 2000),
    "orbits": (fuzz_orbits, 100_000, LANES),
    "scenes": (fuzz_scenes, 10_000, LANES),
    "files": (fuzz_files, 20_000, 20),
}


def main() -> None:
    """Run what the command line asks for."""
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    parser = argparse.ArgumentParser(description="Random work, seeded.")
    for name, (_, count, _) in WORK.items():
        parser.add_argument(f"--{name}", type=int, default=count)
    parser.add_argument("--seed", type=int, default=0)
    asked = vars(parser.parse_args())
    for name, (work, _, most) in WORK.items():
        begin = time.monotonic()
        slowest = 0.0
        # in slices, so that one that hangs is told from many
        for first in range(0, asked[name], most):
            # not while the two programs of a kind of work are compiled
            signal.setitimer(signal.ITIMER_PROF, LONGEST_S if first > most else 0.0)
            start = time.monotonic()
            work(min(most, asked[name] - first), asked["seed"] + first)
            slowest = max(slowest, time.monotonic() - start)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        sys.stdout.write(
            f"{asked[name]} {name}: nothing found in {time.monotonic() - begin:.0f} s, a batch in {slowest:.0f}\n"
        )


if __name__ == "__main__":
    main()
