"""How many steps and nodes a wanted accuracy needs; measured by `afm-jax accuracy collide`."""

from typing import NamedTuple


class Setting(NamedTuple):
    """The numbers of steps and nodes of one collision; hashable, for it shapes the program.

    `rule` is "steps" (a Diffrax solver with fixed steps) or "collocation" (`sweeps` Picard sweeps at `inward` and
    `outward` Gauss nodes). Without dissipation both are one quadrature. `careful`: the short first pass of the way out
    takes as many steps as the way itself.
    """

    rule: str
    inward: int
    outward: int
    junction_nodes: int
    sweeps: int = 0
    solver: str = "Dopri8"
    careful: bool = False


SETTINGS = {
    "diffrax": {
        1e-5: Setting("steps", 2, 2, 8, solver="Dopri5"),
        1e-6: Setting("steps", 3, 3, 8, solver="Dopri5"),
        1e-9: Setting("steps", 3, 3, 12),
        1e-11: Setting("steps", 7, 8, 16),
    },
    "collocation": {
        1e-6: Setting("collocation", 6, 6, 8, sweeps=2),
        1e-9: Setting("collocation", 10, 10, 12, sweeps=3),
        1e-11: Setting("collocation", 13, 13, 16, sweeps=5),
    },
}
"""For each method the settings by the accuracy that they reach.

Accuracy a means an error of the rebound speed below a (relative) and of the delay below 10 a us, measured with the
paper's contact from 1.1 times the capture speed to 200 nm/us (`afm-jax accuracy collide`).
"""

CAREFUL = Setting("steps", 256, 256, 40, careful=True)
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
