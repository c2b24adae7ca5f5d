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

_FREQUENCY = ("frequency_khz", "reduced_frequency")
_MOTION = ("amplitude_nm", *_FREQUENCY, "phase_deg")
_FORCE = ("amplitude_nn", *_FREQUENCY, "phase_deg")

KEYS = {
    "cantilever": ("frequency_khz", "quality_factor", "mass_ng"),
    "platform": ("amplitude_nm", *_FREQUENCY, "offset_nm", "offset_rate_nm_per_us", "second"),
    "platform.second": _MOTION,
    "base": (*_MOTION, "second"),
    "base.second": _MOTION,
    "force": (*_FORCE, "second"),
    "force.second": _FORCE,
    "interaction": ("model", "r", "epsilon", "viscous_loss", "delay"),
    "interaction.delay": ("hertz", "lead_nm", "offset_nm", "corrections"),
    "start": ("phase_deg", "height_above_platform_nm", "velocity_nm_per_us"),
}
"""For every table of a scene file the keys it may have; those of the interaction are an impact law's."""

TABLES = tuple(name for name in KEYS if "." not in name)
"""The tables at the top of a file."""

INNER_TABLES = tuple(name for name in KEYS if "." in name)
"""The tables inside others."""

CONTACT_KEYS = ("model", "effects", *CONTACT_RANGES)
"""The keys of the interaction where its model is a contact."""

MODELS = ("law", "contact", "none")
"""The models of an interaction; "none": a free cantilever."""

_UNITS = ("_nm_per_us", "_khz", "_n_per_m", "_nm", "_nn", "_ng", "_deg")
_UNITS += ("_j_per_m2", "_cm3_per_mol", "_pa_s", "_j_m6", "_gpa", "_k")


def keys_of(table: str, model: str) -> tuple[str, ...]:
    """Return the keys that a table may have in a scene whose interaction is of one of the `MODELS`."""
    if table != "interaction" or model == "law":
        return KEYS[table]
    return CONTACT_KEYS if model == "contact" else ("model",)


def advise_key(table: str, key: str, model: str = "law") -> str:
    """Return what is wrong with a key that its table does not have, and the one to use instead.

    >>> advise_key("platform", "frequency_hz")
    'unknown key; use frequency_khz'
    >>> advise_key("cantilever", "frequency")
    'the unit is missing; use frequency_khz'
    >>> advise_key("platform", "quality_factor")
    'unknown key; it belongs in [cantilever]'
    >>> advise_key("force", "amplitude_nm")
    'unknown key; use amplitude_nn'
    >>> advise_key("interaction", "viscosity_pa_s", "law")
    'unknown key of a law; it belongs to model = "contact"'

    Args:
        table: a name of `KEYS`.
        key: what the file has there.
        model: of the scene's interaction, one of `MODELS`.
    """
    keys = keys_of(table, model)
    allowed = {name.casefold(): name for name in keys}
    plain = key.casefold()
    stems = {_stem(name): name for name in keys}
    if plain in stems and plain not in allowed:
        return f"the unit is missing; use {stems[plain]}"
    known = allowed.get(plain, stems.get(_stem(plain)))
    if known is not None:
        return f"unknown key; use {known}"
    others = [other for other in MODELS if other != model and plain in keys_of("interaction", other)]
    if table == "interaction" and others:
        whose = "a free cantilever" if model == "none" else f"a {model}"
        return f'unknown key of {whose}; it belongs to model = "{others[0]}"'
    owners = _owners(plain)
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
        tables = _owners(plain) or [f"[{table}]" for table in TABLES]
        return f"stands outside any table; write it below {' or '.join(tables)}"
    inner = [table.rpartition(".")[2] for table in INNER_TABLES]
    nearest = difflib.get_close_matches(plain, [*TABLES, *inner], n=1)
    if nearest:
        meant = [f"[{table}]" for table in KEYS if table.rpartition(".")[2] == nearest[0]]
        return f"unknown table; use {' or '.join(meant)}"
    return f"unknown table; use {', '.join(f'[{table}]' for table in TABLES)}"


def _owners(key: str) -> list[str]:
    """Return the tables that have a key, in brackets, but for second frequencies, which have the keys of the first."""
    return [f"[{table}]" for table, keys in KEYS.items() if key in keys and not table.endswith(".second")]


def _stem(name: str) -> str:
    """Return a key without its unit."""
    return next((name.removesuffix(unit) for unit in _UNITS if name.endswith(unit)), name)
