"""The work that is timed, by names that design and pages promise; a program of its own, run once for each tree.

It reads lines from standard input, a JSON array each, and answers each with a JSON object: `["prepare", row]` compiles
and runs the row once, `["run", row]` runs it again. The tree that it measures is the one on PYTHONPATH; a row that it
cannot run is answered with the reason. Nothing here imports from the tests: an older tree has others.
"""

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import afm_jax as afm

jax.config.update("jax_enable_x64", val=True)
# compile times are told, so none may come from an earlier run
jax.config.update("jax_enable_compilation_cache", val=False)

IMPACTS = 20
BLOCKS = {"cpu": 1000}
"""Tips that run together, as many as the cache of a processor holds; all of them elsewhere."""


class Work(NamedTuple):
    """What is timed: a call, and how many impacts, contacts or tips its time is divided by."""

    run: Callable[[], Any]
    events: int


def impact_map(tips: int, slopes: str = "") -> Work:
    """Return twenty impacts of tips around the orbit of figure 2; by slopes a derivative of the last ones, too."""
    scene = afm.Scene(afm.Cantilever(90.0), afm.Platform(2.0, 180.0, -1.0), afm.ImpactLaw(0.5))
    share = (jnp.arange(tips) + 0.5) / tips
    times, speeds = 5.0 * share, 20.0 + 40.0 * (share * 0.6180339887 * tips % 1.0)

    def one(scene: Any, start: Any) -> Any:
        def impact(state: Any, _: None) -> Any:
            found = afm.next_impact(scene, *state)
            return (found.time_us, found.velocity_after_nm_per_us), None

        return jax.lax.scan(impact, start, None, length=IMPACTS)[0]

    def last(scene: Any, starts: Any) -> Any:
        block = min(BLOCKS.get(jax.default_backend(), tips), tips)
        parts = jax.tree.map(lambda part: part.reshape(-1, block), starts)
        return jax.lax.map(jax.vmap(lambda start: one(scene, start)), parts)

    def total(scene: Any, starts: Any) -> Any:
        return sum(jnp.sum(part) for part in last(scene, starts))

    ones = jax.tree.map(jnp.ones_like, scene)
    functions = {
        "": last,
        "forward": lambda scene, starts: jax.jvp(lambda moved: last(moved, starts), (scene,), (ones,))[1],
        "reverse": jax.grad(total, argnums=(0, 1)),
    }
    program = jax.jit(functions[slopes])
    return Work(lambda: jax.block_until_ready(program(scene, (times, speeds))), tips * IMPACTS)


def collisions(tips: int, slopes: str = "", **how: Any) -> Work:
    """Return collisions through the paper's contact at 12 to 200 nm/us; by slopes a derivative as well."""
    contact, speeds = afm.Contact.paper(), jnp.linspace(12.0, 200.0, tips)

    def outputs(contact: Any, speeds: Any) -> Any:
        found = afm.collide(contact, speeds, **how)
        return found.rebound_speed_nm_per_us, found.collision_delay_us

    def total(contact: Any, speeds: Any) -> Any:
        return sum(jnp.sum(part) for part in outputs(contact, speeds))

    ones = jax.tree.map(jnp.ones_like, contact)
    functions = {
        "": outputs,
        "forward": lambda contact, speeds: jax.jvp(lambda moved: outputs(moved, speeds), (contact,), (ones,))[1],
        "reverse": jax.grad(total, argnums=(0, 1)),
    }
    # as users call it: a batch by itself, its derivatives compiled; slower than 13 nm/us slopes are large
    program = jax.jit(functions[slopes]) if slopes else outputs
    return Work(lambda: jax.block_until_ready(program(contact, speeds + (5.0 if slopes else 0.0))), tips)


def contact_scene(reduced: float) -> Any:
    """Return the paper's contact over a platform of 4 nm, Q = 40, 1 ng."""
    platform = afm.Platform(amplitude_nm=4.0, frequency_khz=180.0 * reduced)
    return afm.Scene(afm.Cantilever(90.0, 40.0, 1.0), platform, afm.Contact.paper())


def starts_above(scene: Any, tips: int, shift: float) -> Any:
    """Return starts 5 nm above the platform at its phase 270 degrees, upwards at 38 to 120 nm/us."""
    now = 0.75 * scene.platform.period_us
    share = (jnp.arange(tips) + 0.5 + shift * tips) / tips % 1.0
    height = scene.platform.position(now) + 5.0
    return afm.State(jnp.full(tips, now), jnp.full(tips, height), 38.0 + 82.0 * share)


def bouncing_tips(reduced: float, periods: int, accuracy: float, tips: int = 1000) -> Work:
    """Return contacts of tips that the sample does not hold at the end, as `simulate` follows a batch of them.

    Chaotic tips that are held at one accuracy are free at another: each has its own.
    """
    scene = contact_scene(reduced)
    duration = periods * float(scene.platform.period_us)

    def follow(starts: Any) -> Any:
        how = {"max_contacts": 64, "accuracy": accuracy}
        return jax.block_until_ready(jax.vmap(lambda start: afm.simulate(scene, start, duration, **how))(starts))

    kept: list[Any] = []
    for number in range(40):
        starts = starts_above(scene, tips, number * 0.6180339887)
        found = follow(starts)
        free = (np.asarray(found.outcome) == 0) & ~np.asarray(found.held)
        kept.append(np.stack([np.asarray(part)[free] for part in starts]))
        if sum(part.shape[1] for part in kept) >= tips:
            break
    chosen = afm.State(*(jnp.asarray(part) for part in np.concatenate(kept, axis=1)[:, :tips]))
    contacts = int(np.sum(np.asarray(follow(chosen).contacts.kind) == 1))
    return Work(lambda: follow(chosen), contacts)


def one_tip(reduced: float) -> Work:
    """Return a tip that is followed for a thousand drive periods; the time is that of all of it."""
    scene = contact_scene(reduced)
    start = afm.State(*(part[0] for part in starts_above(scene, 1, 0.0)))
    duration = 1000.0 * float(scene.platform.period_us)
    return Work(lambda: jax.block_until_ready(afm.simulate(scene, start, duration)), 1)


ROWS: dict[str, Callable[[], Work]] = {
    "map, one tip": partial(impact_map, 1),
    "map, 100 tips": partial(impact_map, 100),
    "map, 10,000 tips": partial(impact_map, 10_000),
    "map, 10,000 tips, forward derivative": partial(impact_map, 10_000, "forward"),
    "map, 10,000 tips, reverse gradient by all parameters and starts": partial(impact_map, 10_000, "reverse"),
    "map, 1,000,000 tips": partial(impact_map, 1_000_000),
    "map, 1,000,000 tips, forward derivative": partial(impact_map, 1_000_000, "forward"),
    "map, 1,000,000 tips, reverse gradient by all parameters and starts": partial(impact_map, 1_000_000, "reverse"),
    "collide, accuracy 1e-6": partial(collisions, 10_000, accuracy=1e-6),
    "collide, accuracy 1e-9 (default)": partial(collisions, 10_000),
    "collide, 1,000,000 speeds, accuracy 1e-9": partial(collisions, 1_000_000),
    "collide, collocation, accuracy 1e-9": partial(collisions, 10_000, method="collocation"),
    "collide, accuracy 1e-9, forward derivative": partial(collisions, 10_000, "forward"),
    "collide, accuracy 1e-9, reverse gradient by all parameters and speeds": partial(collisions, 10_000, "reverse"),
    **{
        f"bouncing tips, n = {n:g}, accuracy {accuracy:g}": partial(bouncing_tips, n, periods, accuracy)
        for n, periods in ((1.01, 30), (5.277, 150))
        for accuracy in (1e-6, 1e-9)
    },
    **{f"one tip, n = {n:g}, 1000 drive periods": partial(one_tip, n) for n in (1.01, 5.277)},
}


def main() -> None:
    """Answer the lines of standard input."""
    prepared: dict[str, Work] = {}
    for line in sys.stdin:
        verb, name = json.loads(line)
        answer: dict[str, Any] = {}
        try:
            began = time.perf_counter()
            if verb == "prepare":
                prepared[name] = ROWS[name]()
            prepared[name].run()
            answer = {"seconds": time.perf_counter() - began, "events": prepared[name].events}
        except (AttributeError, ImportError, NotImplementedError, RuntimeError, TypeError, ValueError) as failure:
            answer = {"missing": f"{type(failure).__name__}: {failure}"}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
