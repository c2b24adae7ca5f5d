"""The keys of a scene file, and what to advise where somebody wrote another one."""

import difflib

KEYS = {
    "cantilever": ("frequency_khz", "quality_factor", "mass_ng"),
    "platform": ("amplitude_nm", "frequency_khz", "reduced_frequency", "offset_nm", "offset_rate_nm_per_us"),
    "interaction": ("model", "r", "epsilon", "viscous_loss", "delay"),
    "interaction.delay": ("hertz", "lead_nm", "offset_nm"),
    "start": ("phase_deg", "height_above_platform_nm", "velocity_nm_per_us"),
}
"""For every table of a scene file the keys it may have."""

_UNITS = ("_nm_per_us", "_khz", "_nm", "_ng", "_deg")


def advise_key(table: str, key: str) -> str:
    """Return what is wrong with a key that its table does not have, and the one to use instead.

    >>> advise_key("platform", "frequency_hz")
    'unknown key; use frequency_khz'
    >>> advise_key("cantilever", "frequency")
    'the unit is missing; use frequency_khz'
    >>> advise_key("platform", "quality_factor")
    'unknown key; it belongs in [cantilever]'

    Args:
        table: a name of `KEYS`.
        key: what the file has there.
    """
    allowed = {name.casefold(): name for name in KEYS[table]}
    plain = key.casefold()
    if plain in allowed:
        return f"unknown key; use {allowed[plain]}"
    stems = {_stem(name): name for name in KEYS[table]}
    if plain in stems:
        return f"the unit is missing; use {stems[plain]}"
    owners = [f"[{name}]" for name, keys in KEYS.items() if plain in keys]
    if owners:
        return f"unknown key; it belongs in {' or '.join(owners)}"
    same_quantity = [stem for stem in stems if plain.startswith(f"{stem}_")]
    if same_quantity:
        return f"unknown key; use {stems[max(same_quantity, key=len)]}"
    nearest = difflib.get_close_matches(plain, allowed, n=1)
    return f"unknown key; use {nearest[0]}" if nearest else f"unknown key; use one of {', '.join(KEYS[table])}"


def advise_table(name: str, *, is_table: bool) -> str:
    """Return what is wrong with a name at the top of a file, which is none of its tables.

    >>> advise_table("cantilver", is_table=True)
    'unknown table; use [cantilever]'

    Args:
        name: what the file has there.
        is_table: whether it is a table there, or a key outside any table.
    """
    plain = name.casefold()
    if not is_table:
        owners = [f"[{table}]" for table, keys in KEYS.items() if plain in keys]
        tables = owners or [f"[{table}]" for table in KEYS]
        return f"stands outside any table; write it below {' or '.join(tables)}"
    tables = {table.rpartition(".")[2]: table for table in KEYS}
    nearest = difflib.get_close_matches(plain, tables, n=1)
    if nearest:
        return f"unknown table; use [{tables[nearest[0]]}]"
    return f"unknown table; use {', '.join(f'[{table}]' for table in KEYS)}"


def _stem(name: str) -> str:
    """Return a key without its unit."""
    return next((name.removesuffix(unit) for unit in _UNITS if name.endswith(unit)), name)
