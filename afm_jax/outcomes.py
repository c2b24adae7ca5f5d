"""How things end, in words: enumerations with a sentence each, and rules by which a result is judged.

Results carry outcomes as integers per row, so that they pass through ``jit`` and ``vmap``;
``Outcome(int(result.outcome)).sentence`` says it in words. A verdict is a list of rules: `judge` returns the sentences
of those that apply to what was found.
"""

import enum
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar


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
    """How one step of the impact map ended; the `sentence` of a member says what happened."""

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
    """How the collision of a free tip with a contact ended; the `sentence` of a member says what happened."""

    REBOUND = 0, "The tip formed the junction, broke it and left."
    TURNED_IN_BRIDGE = 1, "The bridge turned the tip round before the junction formed; it left."
    CAPTURED_BY_BRIDGE = (
        2,
        "The tip came too slowly to leave again: the liquid bridge holds it, or a dry contact's attraction.",
    )
    CAPTURED_BY_JUNCTION = 3, "The tip came too slowly to leave again: the solid junction holds it."
    NO_JUNCTION = 4, "With these parameters no junction forms: force and stiffness are equal nowhere."
    INVALID_START = 5, "The approach speed is not a positive finite number."
    UNRESOLVED = 6, "The integration did not resolve this impact: its dissipation is too strong for the steps taken."


E = TypeVar("E")


@dataclass(frozen=True)
class Rule(Generic[E]):
    """A sentence that is said of a result where something is the case.

    Attributes:
        when: the cases of it that a result's evidence shows, a sentence for each; or one case in words, "" if it is not
            the case; or whether it is the case at all.
        sentence: what is said, with `{e.name}` for what the evidence has, and `{case}` for one of the cases; or a
            function of evidence and case.
    """

    when: Callable[[E], Iterable[Any] | bool]
    sentence: str | Callable[[E, Any], str]

    def said_of(self, evidence: E) -> list[str]:
        """Return what the rule says of a result: a sentence for each case."""
        cases, sentence = self.when(evidence), self.sentence
        each = cases if isinstance(cases, Iterable) and not isinstance(cases, str) else [cases] * bool(cases)
        if isinstance(sentence, str):
            return [sentence.format(e=evidence, case=case) for case in each]
        return [sentence(evidence, case) for case in each]


Rules = Sequence[Rule[E] | tuple[Rule[E], ...]]
"""Rules in the order in which they speak; of those in brackets the first that applies speaks alone."""


def judge(rules: Rules[E], evidence: E) -> list[str]:
    """Return the sentences of the rules that apply.

    >>> hot = Rule(lambda kelvin: kelvin > 373.0, "{e:g} K: water boils.")
    >>> warm = Rule(lambda kelvin: kelvin > 300.0, "It is warm.")
    >>> judge([(hot, warm)], 400.0), judge([hot, warm], 400.0)
    (['400 K: water boils.'], ['400 K: water boils.', 'It is warm.'])
    """
    sentences = []
    for rule in rules:
        group = (rule,) if isinstance(rule, Rule) else rule
        sentences += next((said for said in (member.said_of(evidence) for member in group) if said), [])
    return sentences
