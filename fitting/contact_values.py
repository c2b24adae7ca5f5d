"""Values of contact parameters that a fit holds fixed, checked."""

import math

from fitting.models import CONTACT_NAMES
from fitting.parameters import PARAMETERS


def check_contact_values(model: str, fixed: dict[str, float] | None) -> None:
    """Check the values of contact parameters that are held fixed.

    Raises:
        ValueError: if the model has none, or a name or value is impossible.
    """
    if not fixed:
        return
    if model != "contact":
        raise ValueError(f"`fixed` gives values of contact parameters; the model {model!r} has none")
    for name, value in fixed.items():
        if name not in CONTACT_NAMES:
            raise ValueError(
                f"`fixed` must name parameters of the contact ({', '.join(CONTACT_NAMES)}), but one is {name!r}"
            )
        parameter = PARAMETERS[name]
        if not math.isfinite(value) or not parameter.lowest <= value <= parameter.highest:
            between = f"between {parameter.lowest:g} and {parameter.highest:g} {parameter.unit}".rstrip()
            raise ValueError(f"`fixed`: {name} must lie {between}, but is {value!r}")
