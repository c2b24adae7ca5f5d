"""Which channels of a file become which columns of a table, where names, units and layout do not tell."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from fitting.instruments.recording import UNITS, Recording, Segment, quantity_of, unit_named
from fitting.tables.csv_text import NUMBER, TableError

ROLES = {
    "offset_nm": (("length",), ("offset.*", "z-axis sensor", "zsnsr", "z", "z rel", "z-axis", "height.*", "lvdt")),
    "lockin_amplitude_nm": (
        ("length", "voltage"),
        ("lockin_amplitude.*", "m1a", r"amp(litude)?(_\w+)?", r"amp(litude)?\b.*"),
    ),
    "phase_lag_deg": (("angle",), ("phase_lag.*", "m1p", "phase?(_.*)?", r"phase\b.*")),
    "deflection_nm": (("length", "voltage", "force"), ("defl.*", "normal force")),
}
"""What a channel can be: the quantities it may measure, and the names it goes by, likeliest first (no case)."""


@dataclass(frozen=True)
class ColumnSource:
    """Where a column of the table comes from.

    Attributes:
        channel: of the file; `OUT/BACK` where approach and retract stand in two channels.
        unit: if the file's is wrong or missing.
        factor: that the numbers are multiplied by; None: not said.
    """

    channel: str
    unit: str = ""
    factor: float | None = None


def parse_columns(text: str) -> dict[str, ColumnSource]:
    """Return a column map: `column=CHANNEL[:UNIT][:FACTOR]`, separated by commas; CHANNEL may be `OUT/BACK`.

    >>> parse_columns("offset_nm=1/2:um:-1,lockin_amplitude_nm=Amp:0.5")["offset_nm"]
    ColumnSource(channel='1/2', unit='um', factor=-1.0)

    Raises:
        ValueError: if a part is none, with an example.
    """
    found = {}
    for part in text.split(","):
        column, sign, source = (piece.strip() for piece in part.partition("="))
        channel, *rest = (piece.strip() for piece in source.split(":"))
        units = [unit_named(piece) for piece in rest if not NUMBER.fullmatch(piece)]
        factors = [float(piece) for piece in rest if NUMBER.fullmatch(piece)]
        if not sign or not channel or len(units) > 1 or len(factors) > 1 or 0.0 in factors:
            raise ValueError(f"'{part.strip()}' is no COLUMN=CHANNEL[:UNIT][:FACTOR]; write offset_nm=Z:um:-1")
        if column not in ROLES:
            raise ValueError(f"there is no column `{column}`; it is one of {', '.join(ROLES)}")
        if column in found:
            raise ValueError(f"the column `{column}` is there twice; approach and retract are {column}=OUT/BACK")
        if units and quantity_of(units[0]) not in ROLES[column][0]:
            known = ", ".join(unit for unit, (what, _) in UNITS.items() if what in ROLES[column][0])
            raise ValueError(f"`{units[0]}` is no unit of {column}; write one of {known}")
        found[column] = ColumnSource(channel, units[0] if units else "", factors[0] if factors else None)
    return found


def checked_unit(unit: str, role: str, channel: str, source: str) -> str:
    """Return the unit of a channel for a column.

    Raises:
        TableError: if the column has none such.
    """
    if quantity_of(unit) not in ROLES[role][0]:
        usual = "deg" if role == "phase_lag_deg" else "nm"
        raise TableError(
            f"{source}: the channel {channel} has the unit {unit!r}, which is none of {role}; say "
            f'`columns="{role}={channel}:{usual}"`'
        )
    return unit


_EIGHT = 8
"""Columns of a curve in the usual export without a head: height, deflection, amplitude, phase, each out and back."""
_EXAMPLE = "offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V,phase_lag_deg=7/8:deg"


def laid_out(recording: Recording, wanted: Mapping[str, ColumnSource]) -> Recording:
    """Return a recording whose curves are parted into approach and retract.

    Channels that are named `OUT/BACK` become two segments. A file without a head that repeats their columns (16
    columns where eight are a curve) holds several curves side by side. A segment of no stated branch whose height
    turns more than once holds several curves one after another.

    Raises:
        TableError: if one of two channels is not there, or some columns have two channels and others one.
    """
    found = {role: _pair(recording, source.channel) for role, source in wanted.items()}
    pairs = {role: pair for role, pair in found.items() if pair is not None}
    if not pairs:
        return _parted(recording, wanted)
    single = next((role for role in wanted if role not in pairs), None)
    if single is not None:
        raise TableError(
            f"{recording.source}: {single}={wanted[single].channel} has one channel where other columns have OUT/BACK; "
            f"write two for each, as {_EXAMPLE}"
        )
    names = recording.channels
    segments = []
    for segment in recording.segments:
        for step in _side_by_side(recording, [name for pair in pairs.values() for name in pair]):
            for way, branch in enumerate(("approach", "retract")):
                columns = {
                    wanted[role].channel: segment.channels[names[names.index(pair[way]) + step]]
                    for role, pair in pairs.items()
                }
                segments.append(Segment(len(segments) // 2 + 1, branch, _ended(columns)))
    empty = next((s for s in segments if not np.size(next(iter(s.channels.values())))), None)
    if empty is not None:
        raise TableError(f"{recording.source}, curve {empty.curve}: the {empty.branch} holds no numbers")
    of_pair = {wanted[role].channel: pair[0] for role, pair in pairs.items()}
    units = {**recording.units, **{name: recording.units.get(first, "") for name, first in of_pair.items()}}
    away = tuple(name for name, first in of_pair.items() if first in recording.away)
    return replace(recording, segments=tuple(segments), units=units, away=away)


def example_of_columns(recording: Recording) -> str:
    """Return what to write for channels without names: an example of eight columns where that may be meant."""
    unnamed = recording.channels == [str(k + 1) for k in range(len(recording.channels))]
    if unnamed and len(recording.channels) % _EIGHT == 0:
        return f'say `columns="{_EXAMPLE}"` (approach/retract)'
    return 'say `columns="offset_nm=CHANNEL:UNIT"`'


def _pair(recording: Recording, channel: str) -> tuple[str, str] | None:
    """Return the two channels of a source `OUT/BACK`, None of a single one.

    Raises:
        TableError: if one of the two is not there.
    """
    out, sign, back = (piece.strip() for piece in channel.partition("/"))
    names = recording.channels
    if channel in names or not sign:
        return None
    missing = next((name for name in (out, back) if name not in names), None)
    if missing is not None:
        raise TableError(f"{recording.source}: there is no channel `{missing}`; it has {', '.join(names)}")
    return out, back


def _side_by_side(recording: Recording, used: list[str]) -> list[int]:
    """Return by how many columns each curve of a file without a head is further right than the first."""
    names = recording.channels
    width = len(names)
    if names != [str(k + 1) for k in range(width)]:
        return [0]
    last = max(names.index(name) for name in used) + 1
    sizes = [_EIGHT] if last <= _EIGHT and width % _EIGHT == 0 else [n for n in range(last, width) if width % n == 0]
    if not sizes:
        return [0]
    steps = list(range(0, width, sizes[0]))
    columns = recording.segments[0].channels
    heights = [columns[names[names.index(used[0]) + step]] for step in steps]
    first = heights[0][np.isfinite(heights[0])]
    spans = [np.ptp(h[np.isfinite(h)]) if np.isfinite(h).any() else 0.0 for h in heights]
    alike = first.size and all(0.1 * spans[0] < span < 10.0 * spans[0] for span in spans)
    return steps if alike else [0]


def _ended(columns: dict[str, Float[np.ndarray, " rows"]]) -> dict[str, Float[np.ndarray, " kept"]]:
    """Return columns without the rows at their end that hold nothing, or zeros alone: padding of a shorter way."""
    there = np.any([np.isfinite(numbers) & (numbers != 0.0) for numbers in columns.values()], axis=0)
    rows = int(np.flatnonzero(there)[-1]) + 1 if there.any() else 0
    return {name: numbers[:rows] for name, numbers in columns.items()}


_TURN = 0.3
"""Of the range of heights: what a height goes back by where the sample turns."""
_LEAST_RUN = 8
"""Rows between two turns on the average, below which heights jump to and fro and are no ramps."""


def turns_of(height: Float[np.ndarray, " rows"]) -> list[int]:
    """Return the rows at which a height turns for good, the first of each new direction; none where it jumps about."""
    least = _TURN * float(np.ptp(height)) if len(height) else 0.0
    turns: list[int] = []
    rising, extreme = 0, 0
    low = high = 0
    for row, value in enumerate(height.tolist()):
        low, high = (row if value < height[low] else low), (row if value > height[high] else high)
        if not rising:
            rising = 1 if value - height[low] > least else -1 if height[high] - value > least else 0
            extreme = row
        elif rising * (value - height[extreme]) > 0.0:
            extreme = row
        elif rising * (height[extreme] - value) > least:
            turns.append(extreme + 1)
            rising, extreme = -rising, row
    return turns if len(height) >= _LEAST_RUN * (len(turns) + 1) else []


def _parted(recording: Recording, wanted: Mapping[str, ColumnSource]) -> Recording:
    """Return a recording without padding, the curves of a height that goes to and fro as curves of their own."""
    whole = tuple(replace(segment, channels=_ended(segment.channels)) for segment in recording.segments)
    if all(np.size(next(iter(segment.channels.values()))) for segment in whole):
        recording = replace(recording, segments=whole)
    if any(segment.branch for segment in recording.segments):
        return recording
    patterns = ROLES["offset_nm"][1]
    heights = [name for name in recording.channels if any(re.fullmatch(p, name, re.IGNORECASE) for p in patterns)]
    height = wanted["offset_nm"].channel if "offset_nm" in wanted else next(iter(heights), "")
    parts: list[dict[str, Float[np.ndarray, " rows"]]] = []
    for segment in recording.segments:
        numbers = segment.channels.get(height)
        turns = turns_of(numbers) if numbers is not None and np.isfinite(numbers).all() else []
        # a curve is an approach and a retract
        ends = [0, *turns[1::2], len(next(iter(segment.channels.values())))]
        parts += [
            {name: numbers[first:last] for name, numbers in segment.channels.items()} for first, last in pairwise(ends)
        ]
    if len(parts) == len(recording.segments):
        return recording
    return replace(recording, segments=tuple(Segment(k + 1, "", part) for k, part in enumerate(parts)))
