"""How a flight or the search for an orbit ended: an enumeration, and a sentence each.

Results carry these as integers per row, so that they pass through ``jit`` and ``vmap``;
``Outcome(int(result.outcome)).sentence`` says it in words.
"""

import enum


class Outcome(enum.IntEnum):
    """How one step of the impact map ended."""

    IMPACT = 0
    CAPTURED = 1
    NO_FURTHER_IMPACT = 2
    STEP_LIMIT = 3
    INVALID_START = 4
    DELAY_EXCEEDS_FLIGHT = 5
    NOT_REACHED = 6

    @property
    def sentence(self) -> str:
        """What happened, in words."""
        return _SENTENCES[self]


_SENTENCES = {
    Outcome.IMPACT: "The tip hit the platform and left it again.",
    Outcome.CAPTURED: "The tip came too slowly to leave again: the platform captured it.",
    Outcome.NO_FURTHER_IMPACT: "The flight never reaches the platform again.",
    Outcome.STEP_LIMIT: "The search for the next impact ended at its step limit; raise max_steps.",
    Outcome.INVALID_START: "The start is no flight: it is not finite, or not faster than the platform.",
    Outcome.DELAY_EXCEEDS_FLIGHT: (
        "Where the flight begins to count, after a negative collision delay, the tip is already inside the platform."
    ),
    Outcome.NOT_REACHED: "An earlier impact of this sequence was the last one.",
}
