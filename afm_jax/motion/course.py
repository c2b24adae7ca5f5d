"""A tip on its way from contact to contact, of a law or resolved: what is written down of it, and the loop it takes."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from afm_jax.motion.record import MotionOutcome

_EACH = 8
"""Rounds between two checks whether all tips of a batch have arrived at the end."""


class Course(NamedTuple):
    """A tip that is followed, and its contacts so far; scalars of one tip, but for the rows."""

    tip: Any
    """Where the next round begins: a tree of scalars."""
    rows: Float[Array, "rows columns"]
    contacts: Int[Array, ""]
    """Rows that are filled."""
    outcome: Int[Array, ""]
    """A `MotionOutcome`."""
    done: Bool[Array, ""]

    @classmethod
    def begun(cls, tip: Any, row: Any, outcome: Array, *, rows: int) -> "Course":
        """Return a tip at its start, with room for so many rows like a given one; a start with a fault is an end."""
        columns = as_vector(row)[0]
        none = jnp.zeros((), jnp.int32)
        return cls(
            tip, jnp.zeros((rows, *columns.shape), columns.dtype), none, outcome, outcome != MotionOutcome.FINISHED
        )

    def after(self, tip: Any, row: Any, ends: Array, outcome: Array, over: Array) -> "Course":
        """Return the course a round later; it ends as it was before a contact that has no room.

        Args:
            tip: where the next round begins.
            row: of the contact that the round ends.
            ends: whether it ends one.
            outcome: of the motion, if it is over.
            over: whether it is.
        """
        room = self.rows.shape[0]
        full = ends & (self.contacts >= room)
        outcome = jnp.where(full, MotionOutcome.CONTACT_LIMIT, outcome)
        place = jnp.where(ends, self.contacts, room)
        return Course(
            tip=where(full, self.tip, tip),
            rows=self.rows.at[place].set(as_vector(row)[0], mode="drop"),
            contacts=jnp.where(ends & ~full, self.contacts + 1, self.contacts),
            outcome=jnp.where(self.done, self.outcome, outcome).astype(jnp.int32),
            done=self.done | over | full,
        )


def follow_rounds(one_round: Callable[[Course], Course], course: Course, *, rounds: int, reverse: bool) -> Course:
    """Return a course after so many rounds, or as soon as it is done; in a batch all courses.

    Args:
        one_round: what a round makes of a course; one that is done stays as it is.
        course: at the start.
        rounds: at most, filled up to blocks of eight.
        reverse: make it differentiable in reverse mode: all rounds are run, in blocks that are recomputed backwards.
    """
    blocks = -(-rounds // _EACH)

    def block(course, _=None):
        return lax.scan(lambda state, _: (one_round(state), None), course, length=_EACH)

    if reverse:
        course, _ = lax.scan(jax.checkpoint(block), course, length=blocks)
    else:
        _, course = lax.while_loop(
            lambda state: ~state[1].done & (state[0] < blocks),
            lambda state: (state[0] + 1, block(state[1])[0]),
            (0, course),
        )
    outcome = jnp.where(course.done, course.outcome, MotionOutcome.STEP_LIMIT)
    return course._replace(outcome=outcome.astype(jnp.int32))


def where(condition: Array, new: Any, old: Any) -> Any:
    """Return a tree with the leaves of one where a condition holds, else those of another."""
    return jax.tree.map(partial(jnp.where, condition), new, old)


def as_vector(row: Any) -> tuple[Array, Any]:
    """Return a row, a tree of scalars, as one vector of floats, and the function that makes a row of it again."""
    return ravel_pytree(jax.tree.map(lambda part: part.astype(float), row))
