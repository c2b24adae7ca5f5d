"""One table of a scene file: its keys and types are checked, and every error says file, table and key."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, NoReturn, TypeVar

from afm_jax.scenefile_keys import advise_key, keys_of

Built = TypeVar("Built")


class SceneError(ValueError):
    """A scene file that cannot be used; the message is one line: what, where, how to mend it."""


class SceneTable(NamedTuple):
    """A table as it was read.

    Attributes:
        source: the file's name, as it begins every message.
        name: the table's name, a key of `KEYS`.
        values: what it contains.
        model: of the scene's interaction, one of `MODELS`.
    """

    source: str
    name: str
    values: Mapping[str, Any]
    model: str = "law"

    def fail(self, message: str, key: str | None = None) -> NoReturn:
        """Raise a `SceneError` that names the file, this table and the key."""
        where = f"{printable(self.source)}: [{self.name}] "
        raise SceneError(f"{where}{message}" if key is None else f"{where}{printable(key)}: {message}")

    def check_keys(self) -> None:
        """Check that the table has no unknown keys.

        Raises:
            SceneError: at the first unknown key, with the one to use instead.
        """
        for key in self.values:
            if key not in keys_of(self.name, self.model):
                self.fail(advise_key(self.name, key, self.model), key)

    def numbers(self, *, required: tuple[str, ...] = (), optional: tuple[str, ...] = ()) -> dict[str, float]:
        """Return the numbers that the table has under these keys.

        Raises:
            SceneError: if a required one is missing or one is not a number.
        """
        for key in required:
            if key not in self.values:
                self.fail("missing; add it", key)
        return {key: self._number(key) for key in (*required, *optional) if key in self.values}

    def texts(self, key: str) -> list[str] | None:
        """Return the list of texts that the table has under a key; None if the key is left out.

        Raises:
            SceneError: if there is something else.
        """
        value = self.values.get(key)
        if value is None:
            return None
        if not isinstance(value, list):
            self.fail(f'must be a list of texts, ["..."], but is {in_words(value)}', key)
        for entry in value:
            if not isinstance(entry, str):
                self.fail(f"must be a list of texts, but one entry is {in_words(entry)}", key)
        return value

    def truth(self, key: str, *, usual: bool) -> bool:
        """Return whether the table has true under a key; the usual answer if the key is left out.

        Raises:
            SceneError: if there is something else than true or false.
        """
        value = self.values.get(key, usual)
        if not isinstance(value, bool):
            self.fail(f"must be true or false, but is {in_words(value)}", key)
        return value

    def build(self, kind: Callable[..., Built], *arguments: Any, **parameters: Any) -> Built:
        """Return `kind(*arguments, **parameters)`; what that finds wrong becomes an error of this table.

        Raises:
            SceneError: if it raises a ValueError.
        """
        try:
            return kind(*arguments, **parameters)
        except ValueError as error:
            self.fail(str(error))

    def _number(self, key: str) -> float:
        value = self.values[key]
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            self.fail(f"must be a number, but is {in_words(value)}", key)
        try:
            return float(value)
        except OverflowError:
            self.fail("is too large a number", key)


def in_words(value: Any) -> str:
    """Return what a value in a TOML file is, short enough for a message."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return f"the text {value!r}; leave out the quotes" if _looks_like_a_number(value) else "a text"
        case list():
            return "a list"
        case dict():
            return "a table"
        case int() | float():
            return "a number"
        case _:
            return "a date or time"


def printable(text: str) -> str:
    """Return a text that fits on one line of a message: escaped where it holds line breaks or control characters."""
    return text if text.isprintable() else repr(text)


def _looks_like_a_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return len(text) < 40
