"""Loops that Python has written out in a traced program: chains of one step, one after the other.

A step that uses its predecessor m times makes m^n ways through n of them. A loop of the program (`lax.fori_loop`,
`scan`) holds the step once; written out, a compiler that follows operands without remembering where it has been takes
all the ways.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax

MOST = 3
"""So many steps may be written out."""
_INLINED = {"pjit", "jit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "checkpoint", "remat2"}


class Chain(NamedTuple):
    """Steps written out by one line of Python."""

    line: str
    steps: int
    ways: int
    """Through all of them."""


class _Operation(NamedTuple):
    """An operation of straight-line code: from which place in Python, of which earlier operations."""

    key: tuple[Any, ...]
    line: str
    operands: tuple[int, ...]


def written_out(function: Callable[..., Any], *arguments: Any) -> list[Chain]:
    """Return the chains of more than `MOST` steps with more ways through them than steps, the longest of each line.

    Of functions, not of their derivatives: there, operations forget the places in Python that they come from.
    """
    found: dict[str, Chain] = {}
    for body in _bodies(jax.make_jaxpr(function)(*arguments).jaxpr):
        for chain in _chains(body):
            found[chain.line] = max(chain, found.get(chain.line, chain), key=lambda one: one.steps)
    return sorted(found.values())


def _chains(body: list[_Operation]) -> Iterator[Chain]:
    places = defaultdict(list)
    for number, operation in enumerate(body):
        places[operation.key].append(number)
    for numbers in places.values():
        if len(numbers) <= MOST:
            continue
        own, reached = set(numbers), {}
        for number in range(numbers[0], numbers[-1] + 1):
            steps = max((reached[k][0] for k in body[number].operands if k in reached), default=0)
            ways = sum(reached[k][1] for k in body[number].operands if k in reached)
            if number in own:
                reached[number] = steps + 1, max(ways, 1)
            elif steps:
                reached[number] = steps, ways
        steps, ways = max(reached[number] for number in numbers)
        if steps > MOST and ways > steps:
            yield Chain(body[numbers[0]].line, steps, ways)


def _bodies(jaxpr: Any) -> Iterator[list[_Operation]]:
    """Return the straight-line pieces of a program: its own, and those of its loops and branches."""
    body: list[_Operation] = []
    inner: list[Any] = []
    _flatten(jaxpr, (), {}, body, inner)
    yield body
    for part in inner:
        yield from _bodies(part)


def _flatten(
    jaxpr: Any, stack: tuple[Any, ...], made: dict[Any, int], body: list[_Operation], inner: list[Any]
) -> None:
    """Append a program's operations to a body; calls are written in place, loops and branches kept for later."""
    for number, equation in enumerate(jaxpr.eqns):
        traceback = equation.source_info.traceback
        place = (number,) if traceback is None else tuple(zip(*traceback.raw_frames(), strict=True))
        key = (*stack, equation.primitive.name, place)
        parts = [part for value in equation.params.values() for part in _programs(value)]
        if equation.primitive.name in _INLINED and parts:
            part = parts[0]
            given = equation.invars[len(equation.invars) - len(part.invars) :]
            own = {new: made[old] for new, old in zip(part.invars, given, strict=True) if _is_made(old, made)}
            _flatten(part, (key,), own, body, inner)
            made |= {
                out: own[end] for out, end in zip(equation.outvars, part.outvars, strict=True) if _is_made(end, own)
            }
            continue
        inner.extend(parts)
        operands = tuple(made[value] for value in equation.invars if _is_made(value, made))
        made |= dict.fromkeys(equation.outvars, len(body))
        body.append(_Operation(key, _line_of(traceback), operands))


def _programs(value: Any) -> list[Any]:
    """Return the programs that a parameter of an operation holds."""
    parts = value if isinstance(value, tuple | list) else [value]
    return [getattr(part, "jaxpr", part) for part in parts if hasattr(getattr(part, "jaxpr", part), "eqns")]


def _is_made(value: Any, made: dict[Any, int]) -> bool:
    # a literal has a value instead
    return not hasattr(value, "val") and value in made


def _line_of(traceback: Any) -> str:
    """Return the innermost place in a file that is not a library's."""
    for frame in () if traceback is None else traceback.frames:
        if "site-packages" not in frame.file_name:
            return f"{frame.file_name}:{frame.line_num}"
    return ""
