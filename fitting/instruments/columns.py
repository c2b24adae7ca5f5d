"""Which channels of a file become which columns of a table, where names, units and layout do not tell."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from fitting.instruments.recording import UNITS, WAY, Recording, quantity_of, two_ways, unit_named
from fitting.tables.csv_text import NUMBER, TableError

ROLES = {
    "offset_nm": (
        ("length",),
        ("offset.*", "calc_ramp.*", "z-axis sensor", "zsnsr", "z", "z rel", "z-axis", "height.*", "lvdt"),
    ),
    "lockin_amplitude_nm": (
        ("length", "voltage"),
        ("lockin_amplitude.*", "m1a", r"amp(litude)?(_\w+)?", r"(lock-?in[_ ])?amp(?![a-z]*[ _]?2).*"),
    ),
    "phase_lag_deg": (
        ("angle",),
        ("phase_lag.*", "m1p", "phase?(_.*)?", r"(lock-?in[_ ])?pha(?![a-z]*[ _]?2).*"),
    ),
}
"""What a channel can be: the quantities it may measure, and the names it goes by, likeliest first (no case); channels
of a second mode, Amplitude2 and Phase2, are none."""


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
    for part in filter(None, text.split(",")):
        match = _PART.fullmatch(part.strip())
        if match is None or float(match["factor"] or 1.0) == 0.0:
            raise ValueError(f"'{part.strip()}' is no COLUMN=CHANNEL[:UNIT][:FACTOR]; write offset_nm=Z:um:-1")
        column, unit = match["column"], unit_named(match["unit"] or "")
        if column not in ROLES:
            raise ValueError(f"there is no column `{column}`; it is one of {', '.join(ROLES)}")
        if column in found:
            raise ValueError(f"the column `{column}` is there twice; approach and retract are {column}=OUT/BACK")
        if unit and quantity_of(unit) not in ROLES[column][0]:
            known = ", ".join(unit for unit, (what, _) in UNITS.items() if what in ROLES[column][0])
            raise ValueError(f"`{unit}` is no unit of {column}; write one of {known}")
        found[column] = ColumnSource(match["channel"], unit, float(match["factor"]) if match["factor"] else None)
    return found


_PART = re.compile(
    rf"(?P<column>[^=]*?)\s*=\s*(?P<channel>[^:]+?)\s*(:\s*(?P<unit>(?!{NUMBER.pattern}\s*$)[^:]+?)\s*)?"
    rf"(:\s*(?P<factor>{NUMBER.pattern}))?",
    re.ASCII,
)


def channel_of(recording: Recording, role: str, wanted: Mapping[str, ColumnSource]) -> ColumnSource | None:
    """Return the channel that becomes a column, with its unit; None where neither the caller nor its name tells it.

    Args:
        recording: the file.
        role: the column, a key of `ROLES`.
        wanted: channels that the caller names, by column; a number counts them.

    Raises:
        TableError: if there is no channel of a name, or its unit is none of the column.
    """
    (quantities, patterns), names, source = ROLES[role], recording.channels, wanted.get(role)
    if source is None:
        taken = {_numbered(other.channel, names) for other in wanted.values()}
        free = [name for name in names if name not in taken]
        ranked = [n for pattern in patterns for n in free if re.fullmatch(pattern, n, re.IGNORECASE | re.DOTALL)]
        suited = [n for n in ranked if quantity_of(recording.units.get(n, "")) in quantities]
        suited += [n for n in ranked if not recording.units.get(n)]
        if not suited:
            return None
        source = ColumnSource(suited[0])
    channel = _existing(source.channel, recording)
    unit = source.unit or recording.units.get(channel) or usual_unit(role)
    if quantity_of(unit) not in quantities:
        raise TableError(
            f"{recording.source}: the channel {channel} has the unit {unit!r}, which is none of {role}; say "
            f'`columns="{role}={channel}:{usual_unit(role)}"`'
        )
    return ColumnSource(channel, unit, source.factor)


def needed_channel(
    recording: Recording, role: str, wanted: Mapping[str, ColumnSource], roles: Iterable[str] = tuple(ROLES)
) -> ColumnSource:
    """Return the channel that becomes a column, as `channel_of`.

    Args:
        recording: the file.
        role: the column.
        wanted: channels that the caller names, by column.
        roles: the columns that the error asks for.

    Raises:
        TableError: if nothing tells which one, or as `channel_of`.
    """
    source = channel_of(recording, role, wanted)
    if source is None:
        listed, paste = ", ".join(recording.channels), columns_to_paste(recording, roles)
        raise TableError(f"{recording.source}: no {role} among the channels {listed}; {paste}")
    return source


def usual_unit(role: str) -> str:
    """Return the unit of a channel that says none."""
    return "deg" if role == "phase_lag_deg" else "nm"


def _numbered(channel: str, names: list[str]) -> str:
    """Return the channel that is meant: of that name, of the pair of ways that the name is of, else of that number."""
    of_pair = WAY.sub("", channel.partition("/")[0].strip()) if WAY.search(channel) else ""
    counted = dict(zip(map(str, range(1, len(names) + 1)), names, strict=True))
    return next((name for name in (channel, of_pair, counted.get(channel)) if name in names), channel)


def _existing(channel: str, recording: Recording) -> str:
    """Return the channel that is meant, which must be there."""
    found, names = _numbered(channel, recording.channels), recording.channels
    if found not in names:
        there = f"it has {', '.join(names)}; {columns_to_paste(recording)}"
        raise TableError(f"{recording.source}: there is no channel `{found}`; {there}")
    return found


_EXAMPLE = "offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V,phase_lag_deg=7/8:deg"
"""For the usual export without a head: height, deflection, amplitude, phase, each out and back."""


def laid_out(recording: Recording, wanted: Mapping[str, ColumnSource]) -> Recording:
    """Return a recording in which channels that are named `OUT/BACK` are two segments, an approach and a retract.

    Raises:
        TableError: if one of two channels is not there, or some columns have two channels and others one.
    """
    names = recording.channels
    pairs = {
        one.channel: [_existing(name.strip(), recording) for name in one.channel.split("/", 1)]
        for one in wanted.values()
        if "/" in one.channel and _numbered(one.channel, names) not in names
    }
    if not pairs:
        return recording
    single = next((f"{role}={one.channel}" for role, one in wanted.items() if one.channel not in pairs), None)
    if single is not None:
        raise TableError(
            f"{recording.source}: {single} has one channel where other columns have OUT/BACK; "
            f"write two for each, as {_EXAMPLE}"
        )
    units = {name: recording.units.get(pair[0], "") for name, pair in pairs.items()}
    return replace(recording, segments=two_ways(recording.segments, pairs), units=units)


def columns_to_paste(recording: Recording, roles: Iterable[str] = tuple(ROLES)) -> str:
    """Return what to write for channels whose names do not tell what they are, made from the file's own channels."""
    names = recording.channels
    if names == [str(k + 1) for k in range(8)]:
        return f'say `columns="{_EXAMPLE}"` (approach/retract)'
    told = {role: channel_of(recording, role, {}) for role in roles}
    others = iter([name for name in names if name not in {one.channel for one in told.values() if one is not None}])
    parts = []
    for role, one in told.items():
        channel = next(others, "") if one is None else one.channel
        unit = recording.units.get(channel, "")
        unit = unit if quantity_of(unit) in ROLES[role][0] else usual_unit(role)
        parts += [f"{role}={channel}:{unit}"] if channel else []
    return f'say `columns="{",".join(parts)}"`'


def turns_of(height: Float[np.ndarray, " rows"]) -> list[int]:
    """Return the rows at which a height turns for good, the first of each new direction; none where it jumps about."""
    # a sample that turns goes back by 0.3 of the range of heights
    least = 0.3 * float(np.ptp(height)) if len(height) else 0.0
    turns: list[int] = []
    rising, low, high = 0, 0, 0
    for row, value in enumerate(height.tolist()):
        low = row if value < height[low] else low
        high = row if value > height[high] else high
        if rising <= 0 and value - height[low] > least:
            turns += [low + 1] if rising else []
            rising, high = 1, row
        elif rising >= 0 and height[high] - value > least:
            turns += [high + 1] if rising else []
            rising, low = -1, row
    # with fewer than 8 rows between two turns heights jump to and fro, and are no ramps
    return turns if len(height) >= 8 * (len(turns) + 1) else []
