"""The keys of a scene file, and what to advise where somebody wrote another one."""

import difflib

CONTACT_RANGES = {
    "relative_humidity": "between 0 and 1",
    "temperature_k": "positive",
    "surface_tension_n_per_m": "positive",
    "molar_volume_cm3_per_mol": "positive",
    "viscosity_pa_s": "not negative",
    "tip_radius_nm": "positive",
    "structural_amplitude_n_per_m": "not negative",
    "structural_decay_nm": "positive",
    "structural_offset_nm": "finite",
    "core_constant_j_m6": "positive",
    "adhesion_energy_j_per_m2": "positive",
    "modulus_gpa": "positive",
    "bridge_forms_nm": "positive",
    "bridge_breaks_nm": "positive",
}
"""The parameters of a contact, and which values `afm_jax.parameters.check_parameter` lets pass."""

KEYS = {
    "cantilever": ("frequency_khz", "quality_factor", "mass_ng"),
    "platform": ("amplitude_nm", "frequency_khz", "reduced_frequency", "offset_nm", "offset_rate_nm_per_us"),
    "interaction": ("model", "r", "epsilon", "viscous_loss", "delay"),
    "interaction.delay": ("hertz", "lead_nm", "offset_nm"),
    "start": ("phase_deg", "height_above_platform_nm", "velocity_nm_per_us"),
}
"""For every table of a scene file the keys it may have; those of the interaction are an impact law's."""

CONTACT_KEYS = ("model", "effects", *CONTACT_RANGES)
"""The keys of the interaction where its model is a contact."""

_UNITS = ("_nm_per_us", "_khz", "_n_per_m", "_nm", "_ng", "_deg")
_UNITS += ("_j_per_m2", "_cm3_per_mol", "_pa_s", "_j_m6", "_gpa", "_k")


def keys_of(table: str, model: str) -> tuple[str, ...]:
    """Return the keys that a table may have in a scene whose interaction is of a model, "law" or "contact"."""
    return CONTACT_KEYS if (table, model) == ("interaction", "contact") else KEYS[table]


def advise_key(table: str, key: str, model: str = "law") -> str:
    """Return what is wrong with a key that its table does not have, and the one to use instead.

    >>> advise_key("platform", "frequency_hz")
    'unknown key; use frequency_khz'
    >>> advise_key("cantilever", "frequency")
    'the unit is missing; use frequency_khz'
    >>> advise_key("platform", "quality_factor")
    'unknown key; it belongs in [cantilever]'
    >>> advise_key("interaction", "viscosity_pa_s", "law")
    'unknown key of a law; it belongs to model = "contact"'

    Args:
        table: a name of `KEYS`.
        key: what the file has there.
        model: of the scene's interaction, "law" or "contact".
    """
    keys = keys_of(table, model)
    allowed = {name.casefold(): name for name in keys}
    plain = key.casefold()
    if plain in allowed:
        return f"unknown key; use {allowed[plain]}"
    stems = {_stem(name): name for name in keys}
    if plain in stems:
        return f"the unit is missing; use {stems[plain]}"
    other = "contact" if model == "law" else "law"
    if table == "interaction" and plain in keys_of(table, other):
        return f'unknown key of a {model}; it belongs to model = "{other}"'
    owners = [f"[{name}]" for name, keys in KEYS.items() if plain in keys]
    if owners:
        return f"unknown key; it belongs in {' or '.join(owners)}"
    same_quantity = [stem for stem in stems if plain.startswith(f"{stem}_")]
    if same_quantity:
        return f"unknown key; use {stems[max(same_quantity, key=len)]}"
    nearest = difflib.get_close_matches(plain, allowed, n=1)
    return f"unknown key; use {nearest[0]}" if nearest else f"unknown key; use one of {', '.join(keys)}"


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
