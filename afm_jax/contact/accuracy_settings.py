"""How many steps and nodes a wanted accuracy needs; measured by `afm-jax accuracy collide`."""

from typing import NamedTuple


class Setting(NamedTuple):
    """The numbers of steps and nodes of one collision.

    `rule` is "steps" (Diffrax) or "collocation"; without dissipation `inward` and `outward` are nodes of a quadrature
    and `sweeps` does not matter.
    """

    rule: str
    inward: int
    outward: int
    junction_nodes: int
    sweeps: int = 0


SETTINGS = {
    "diffrax": {
        1e-5: Setting("steps", 1, 1, 8),
        1e-6: Setting("steps", 2, 2, 9),
        1e-9: Setting("steps", 3, 4, 12),
        1e-11: Setting("steps", 7, 8, 16),
    },
    "collocation": {
        1e-6: Setting("collocation", 6, 6, 9, sweeps=2),
        1e-9: Setting("collocation", 10, 10, 12, sweeps=3),
        1e-11: Setting("collocation", 13, 13, 16, sweeps=5),
    },
}
"""For each method the settings by the accuracy that they reach, in u_out (relative) and in the delay (us / 10).

Measured with the paper's contact from 1.1 times the capture speed to 200 nm/us.
"""

CAREFUL = Setting("steps", 256, 256, 40)
"""For impacts that the quick setting does not resolve: strong dissipation, or a turning point close to the junction."""


def setting_of(method: str, accuracy: float) -> Setting:
    """Return the cheapest setting of a method that reaches an accuracy.

    Raises:
        ValueError: if there is no such method, or none of its settings is as accurate.
    """
    if method not in SETTINGS:
        raise ValueError(f"`method` must be one of {', '.join(SETTINGS)}, but is {method!r}")
    reached = [level for level in SETTINGS[method] if level <= accuracy * (1.0 + 1e-9)]
    if not reached:
        raise ValueError(f"`accuracy` must be at least {min(SETTINGS[method]):g} with {method}, but is {accuracy!r}")
    return SETTINGS[method][max(reached)]
