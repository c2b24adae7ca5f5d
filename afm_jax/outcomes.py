"""How a flight or the search for an orbit ended: an enumeration, and a sentence each.

Results carry these as integers per row, so that they pass through ``jit`` and ``vmap``;
``Outcome(int(result.outcome)).sentence`` says it in words.
"""

import enum


class OutcomeInWords(enum.IntEnum):
    """An enumeration of outcomes: a member is its number, and has a sentence."""

    sentence: str
    """What happened, in words."""

    def __new__(cls, number: int, sentence: str) -> "OutcomeInWords":  # noqa: PYI034 (checks at run time know no Self there)
        """Return a member from its number and its sentence."""
        member = int.__new__(cls, number)
        member._value_ = number
        member.sentence = sentence
        return member


class Outcome(OutcomeInWords):
    """How one step of the impact map ended."""

    IMPACT = 0, "The tip hit the platform and left it again."
    CAPTURED = 1, "The tip came too slowly to leave again: the platform captured it."
    NO_FURTHER_IMPACT = 2, "The flight never reaches the platform again."
    STEP_LIMIT = 3, "The search for the next impact ended at its step limit; raise max_steps."
    INVALID_START = 4, "The start is no flight: it is not finite, or not faster than the platform."
    DELAY_EXCEEDS_FLIGHT = (
        5,
        "Where the flight begins to count, after a negative collision delay, the tip is already inside the platform.",
    )
    NOT_REACHED = 6, "An earlier impact of this sequence was the last one."


class CollisionOutcome(OutcomeInWords):
    """How the collision of a free tip with a contact ended."""

    REBOUND = 0, "The tip formed the junction, broke it and left."
    TURNED_IN_BRIDGE = 1, "The bridge turned the tip round before the junction formed; it left."
    CAPTURED_BY_BRIDGE = 2, "The tip came too slowly to leave again: the liquid bridge holds it."
    CAPTURED_BY_JUNCTION = 3, "The tip came too slowly to leave again: the solid junction holds it."
    NO_JUNCTION = 4, "With these parameters no junction forms: force and stiffness are equal nowhere."
    INVALID_START = 5, "The approach speed is not a positive finite number."
    UNRESOLVED = 6, "The integration did not resolve this impact: its dissipation is too strong for the steps taken."
