"""`simulate` as one compiled program for all scenes of the same effects, with what it costs."""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.stages import Compiled

from afm_jax.apparatus.scene import Scene
from afm_jax.motion.record import Simulation, State
from afm_jax.motion.simulate import simulate

_ROWS = 1024
"""Contacts there is room for in one piece of a motion."""
_SHORTEST_REPETITION_S = 0.01
_REPETITIONS = 5


class Operations(NamedTuple):
    """How much a compiled program has to do, each of its loops counted once."""

    operations: float
    """Floating-point operations."""
    transcendentals: float
    """Those that are exponentials, logarithms, sines and the like."""


class Programs:
    """Compiled programs, one for every choice of effects; numbers can change without another compilation."""

    def __init__(self) -> None:
        """Begin without any program."""
        self._compiled: dict[Any, Compiled] = {}

    def run(self, scene: Scene, start: State, duration_us: float) -> Simulation:
        """Return a scene followed for a duration in us."""
        arguments = (scene, *_arrays(start, duration_us))
        return self._program(simulated, arguments)(*arguments)

    def run_with_tangent(
        self, scene: Scene, start: State, duration_us: float, scene_rate: Scene, start_rate: State
    ) -> tuple[Simulation, Simulation]:
        """Return a scene followed for a duration, and its derivative, to the same end, along a change of both."""
        arguments = (scene, *_arrays(start, duration_us), scene_rate, _arrays(start_rate, 0.0)[0])
        return self._program(simulated_with_tangent, arguments)(*arguments)

    def same(self, one: Scene, other: Scene) -> bool:
        """Say whether two scenes have one program: the same effects, whatever their numbers."""
        return jax.tree.structure(one) == jax.tree.structure(other)

    def operations(self, scene: Scene, start: State) -> Operations:
        """Return how much the compiled program of a scene has to do."""
        arguments = (scene, *_arrays(start, 1.0))
        counts = self._program(simulated, arguments).cost_analysis() or {}
        return Operations(float(counts.get("flops", 0.0)), float(counts.get("transcendentals", 0.0)))

    def time_us(self, scene: Scene, start: State, duration_us: float) -> float:
        """Return what following a scene takes of the process's own time, in us: the best of several runs."""
        arguments = (scene, *_arrays(start, duration_us))
        program = self._program(simulated, arguments)
        calls = 1 + int(_SHORTEST_REPETITION_S / max(_seconds(program, arguments, 1), 1e-6))
        return 1e6 * min(_seconds(program, arguments, calls) for _ in range(_REPETITIONS))

    def _program(self, function: Any, arguments: tuple[Any, ...]) -> Compiled:
        # equal where one compiled program serves both
        key = (function, jax.tree.structure(arguments), *(jnp.shape(leaf) for leaf in jax.tree.leaves(arguments)))
        if key not in self._compiled:
            self._compiled[key] = jax.jit(function).lower(*arguments).compile()
        return self._compiled[key]


def simulated(scene: Scene, start: State, duration_us: Any) -> Simulation:
    """Return a scene followed for a duration, all of it traced."""
    return simulate(scene, start, duration_us, max_contacts=_ROWS)


def simulated_with_tangent(
    scene: Scene, start: State, duration_us: Any, scene_rate: Scene, start_rate: State
) -> tuple[Simulation, Simulation]:
    """Return `simulated` and its derivative in forward mode, its end staying where it is; integers have zeros."""
    end = jnp.asarray(start.time_us) + duration_us

    def to_the_end(scene: Scene, start: State) -> Simulation:
        return simulated(scene, start, end - start.time_us)

    motion, rate = jax.jvp(to_the_end, (scene, start), (scene_rate, start_rate))
    # the tangents of integers carry no numbers
    real = jax.tree.map(
        lambda value, slope: slope if slope.dtype == value.dtype else jnp.zeros_like(value), motion, rate
    )
    return motion, real


def _arrays(start: State, duration_us: float) -> tuple[State, Any]:
    return State(*(jnp.asarray(part, float) for part in start)), jnp.asarray(duration_us, float)


def _seconds(program: Compiled, arguments: tuple[Any, ...], calls: int) -> float:
    began = time.process_time()
    for _ in range(calls):
        jax.block_until_ready(program(*arguments))
    return (time.process_time() - began) / calls
