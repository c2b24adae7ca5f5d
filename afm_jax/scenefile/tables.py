"""The tables of a scene file: their keys and types are checked, and every error says file, table and key.

Takes what TOML holds; gives numbers in the units that the keys name.

Where somebody wrote a key that there is not, the message advises the one to use instead.
"""

import os
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, NoReturn, TypeVar

from afm_jax.checks import is_array
from afm_jax.whole_files import read_whole
from afm_jax.words import nearest_name, printable

_FREQUENCY = ("frequency_khz", "reduced_frequency")
_MOTION = ("amplitude_nm", *_FREQUENCY, "phase_deg")
_FORCE = ("amplitude_nn", *_FREQUENCY, "phase_deg")

KEYS = {
    "cantilever": ("frequency_khz", "quality_factor", "mass_ng", "spring_constant_n_per_m"),
    "platform": ("amplitude_nm", *_FREQUENCY, "offset_nm", "offset_rate_nm_per_us", "second"),
    "platform.second": _MOTION,
    "base": (*_MOTION, "free_amplitude_nm", "second"),
    "base.second": (*_MOTION, "free_amplitude_nm"),
    "force": (*_FORCE, "free_amplitude_nm", "second"),
    "force.second": (*_FORCE, "free_amplitude_nm"),
    "interaction": ("model", "r", "epsilon", "viscous_loss", "delay", "file", "table"),
    "interaction.delay": ("hertz", "lead_nm", "offset_nm", "corrections"),
    "start": ("phase_deg", "height_above_platform_nm", "velocity_nm_per_us"),
}
"""For every table of a scene file the keys it may have; those of the interaction are an impact law's."""

_KINDS = {"model": str, "effects": list, "delay": dict, "corrections": bool, "file": str, "table": dict, "second": dict}
"""Keys that hold something else than a number, and what."""

_EITHER = (_FREQUENCY, ("amplitude_nm", "free_amplitude_nm"), ("amplitude_nn", "free_amplitude_nm"))
"""Keys that say the same in two ways."""

TABLES = tuple(name for name in KEYS if "." not in name)
"""The tables at the top of a file."""

MODELS = ("law", "contact", "none")
"""The models of an interaction; "none": a free cantilever."""


def keys_of(table: str, model: str) -> tuple[str, ...]:
    """Return the keys that a table may have in a scene whose interaction is of one of the `MODELS`."""
    if table != "interaction" or model == "law":
        return KEYS[table]
    if model != "contact":
        return ("model",)
    # only here, so that scenes with a law do without the contact's modules
    from afm_jax.contact.parameters import DEFAULTS  # noqa: PLC0415

    return ("model", "effects", *DEFAULTS)


def advise_key(table: str, key: str, model: str = "law") -> str:
    """Return what is wrong with a key that its table does not have, and the one to use instead.

    >>> advise_key("platform", "frequency_hz")
    'unknown key; use frequency_khz'
    >>> advise_key("cantilever", "frequency")
    'unknown key; use frequency_khz'
    >>> advise_key("start", "speed")
    'unknown key; use one of phase_deg, height_above_platform_nm, velocity_nm_per_us'
    >>> advise_key("force", "amplitude_nm")
    'unknown key; use amplitude_nn'
    >>> advise_key("interaction", "viscosity_pa_s", "law")
    'unknown key of model = "law"; it belongs to model = "contact"'

    Args:
        table: a name of `KEYS`.
        key: what the file has there.
        model: of the scene's interaction, one of `MODELS`.
    """
    keys, plain = keys_of(table, model), key.casefold()
    others = [other for other in MODELS if other != model and plain in keys_of("interaction", other)]
    if table == "interaction" and others:
        return f'unknown key of model = "{model}"; it belongs to model = "{others[0]}"'
    nearest = next((name for name in keys if name.startswith(f"{plain}_")), None) or nearest_name(plain, keys)
    return f"unknown key; use {nearest or 'one of ' + ', '.join(keys)}"


def advise_table(name: str, *, is_table: bool) -> str:
    """Return what is wrong with a name at the top of a file, which is none of its tables.

    >>> advise_table("cantilver", is_table=True)
    'unknown table; use [cantilever]'

    Args:
        name: what the file has there.
        is_table: whether it is a table there, or a key outside any table.
    """
    if not is_table:
        return "stands outside any table; write it below the [table] that it belongs to"
    nearest = nearest_name(name.casefold(), TABLES)
    return f"unknown table; use {', '.join(f'[{table}]' for table in ([nearest] if nearest else KEYS))}"


Built = TypeVar("Built")


class Start(NamedTuple):
    """Where a simulation begins: `phase_deg` of the drive, height above the platform, velocity in the lab."""

    phase_deg: float
    height_above_platform_nm: float
    velocity_nm_per_us: float


class SceneError(ValueError):
    """Raised where a scene file cannot be used; the message is one line: what, where, how to mend it."""


def read_text(source: str | os.PathLike[str]) -> str:
    """Return the text of a file that a scene is made of.

    Raises:
        SceneError: if there is no such file, it cannot be read or is not UTF-8 text.
    """
    where = printable(os.fspath(source))
    try:
        # a byte order mark, as some editors write, is no part of the text
        return read_whole(source).decode("utf-8-sig")
    except FileNotFoundError as error:
        raise SceneError(f"{where or 'an empty path'}: there is no such file") from error
    except OSError as error:
        raise SceneError(f"{where}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise SceneError(f"{where}: line {line} is not UTF-8 text; save the file as UTF-8") from error


class SceneTable(NamedTuple):
    """A table as it was read.

    Attributes:
        source: the file's name, as it begins every message.
        name: the table's name, a key of `KEYS`.
        values: what it contains.
    """

    source: str
    name: str
    values: Mapping[str, Any]

    def fail(self, message: str, key: str | None = None) -> NoReturn:
        """Raise a `SceneError` that names the file, this table and the key."""
        where = f"{printable(self.source)}: [{self.name}] "
        raise SceneError(f"{where}{message}" if key is None else f"{where}{printable(key)}: {message}")

    def check(self, model: str) -> None:
        """Check that the table has no unknown keys, none that contradict each other, and of each key what it holds.

        Args:
            model: of the scene's interaction, one of `MODELS`.

        Raises:
            SceneError: if not, at the first that is wrong.
        """
        for key, value in self.values.items():
            if key not in keys_of(self.name, model):
                self.fail(advise_key(self.name, key, model), key)
            kind = _KINDS.get(key, float)
            good = isinstance(value, kind) and (kind is not list or all(isinstance(each, str) for each in value))
            if kind is float:
                # arrays are those of a scene whose numbers are replaced, maybe by traced ones
                good = is_array(value) or (isinstance(value, int | float) and not isinstance(value, bool))
            if not good:
                must = "a list of texts" if kind is list else _WORDS[kind]
                self.fail(f"must be {must}, but is {in_words(value)}", key)
        for pair in _EITHER:
            if set(pair) <= set(self.values):
                self.fail(f"has both {' and '.join(pair)}; give one of them")

    def numbers(self, *required: str) -> dict[str, Any]:
        """Return all numbers that the table has, by their keys.

        Args:
            required: keys that must be there.

        Raises:
            SceneError: if a required one is missing.
        """
        for key in required:
            if key not in self.values:
                self.fail("missing; add it", key)
        # of a whole number beyond all floats its text is infinite, and refused by its name
        return {
            key: value if is_array(value) else float(str(value))
            for key, value in self.values.items()
            if key not in _KINDS
        }

    def build(self, kind: Callable[..., Built], *arguments: Any, **parameters: Any) -> Built:
        """Return `kind(*arguments, **parameters)`; what that finds wrong becomes an error of this table.

        Raises:
            SceneError: if it raises a ValueError.
        """
        try:
            return kind(*arguments, **parameters)
        except ValueError as error:
            self.fail(str(error))


_WORDS = {str: "a text", list: "a list", dict: "a table", bool: "true or false", int: "a number", float: "a number"}


def in_words(value: Any) -> str:
    """Return what a value in a TOML file is, short enough for a message."""
    return str(value).lower() if isinstance(value, bool) else _WORDS.get(type(value), "a date or time")
