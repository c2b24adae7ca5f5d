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


class CollisionOutcome(enum.IntEnum):
    """How the collision of a free tip with a contact ended."""

    REBOUND = 0
    TURNED_IN_BRIDGE = 1
    CAPTURED_BY_BRIDGE = 2
    CAPTURED_BY_JUNCTION = 3
    NO_JUNCTION = 4
    INVALID_START = 5
    UNRESOLVED = 6

    @property
    def sentence(self) -> str:
        """What happened, in words."""
        return _COLLISION_SENTENCES[self]


_COLLISION_SENTENCES = {
    CollisionOutcome.REBOUND: "The tip formed the junction, broke it and left.",
    CollisionOutcome.TURNED_IN_BRIDGE: "The bridge turned the tip round before the junction formed; it left.",
    CollisionOutcome.CAPTURED_BY_BRIDGE: (
        "The tip came too slowly to leave again: the liquid bridge holds it, or a dry contact's attraction."
    ),
    CollisionOutcome.CAPTURED_BY_JUNCTION: "The tip came too slowly to leave again: the solid junction holds it.",
    CollisionOutcome.NO_JUNCTION: "With these parameters no junction forms: force and stiffness are equal nowhere.",
    CollisionOutcome.INVALID_START: "The approach speed is not a positive finite number.",
    CollisionOutcome.UNRESOLVED: (
        "The integration did not resolve this impact: its dissipation is too strong for the steps taken."
    ),
}
