"""What a report can show beside a fit: a comparison of models, and samples of the parameters."""

from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Comparison(Protocol):
    """Several models fitted to the same table.

    `rows` has a mapping for each model: model, chi2, degrees_of_freedom, aic, bic, delta_aic, law_change, and whatever
    else; `verdict` says in words which one the data prefer.
    """

    @property
    def rows(self) -> list[dict[str, Any]]:
        """One mapping for each model."""
        ...

    @property
    def verdict(self) -> str:
        """What the comparison says, in words."""
        ...


@runtime_checkable
class Sampled(Protocol):
    """A bootstrap or a posterior: anything that says what it found as plain numbers, lists and mappings."""

    def to_dict(self) -> dict[str, Any]:
        """Return everything; what is a mapping by parameter becomes a table."""
        ...
