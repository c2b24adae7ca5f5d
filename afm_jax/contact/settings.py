"""How many nodes, iterations and steps an accuracy needs: of free collisions and of driven contacts.

Takes an accuracy, relative of the rebound speed; gives a hashable setting.

Measured by `afm-jax accuracy collide` and `python -m tests.driven_contacts`.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from afm_jax.solve.quadrature import series_tail

METHODS = ("collocation", "diffrax")
"""How contacts are integrated: by Picard's iterations over Gauss nodes, or in Runge-Kutta steps of Diffrax.

Free collisions take the steps in the gap; driven contacts, which may turn anywhere, take them in time.
"""


class Setting(NamedTuple):
    """The numbers of steps and nodes of one collision; hashable, for it shapes the program.

    `rule` is "steps" (a Diffrax solver with fixed steps) or "collocation" (so many of Picard's `iterations` at `inward`
    and `outward` Gauss nodes). Without dissipation both are one quadrature. `careful`: the short first pass of the way
    out takes as many steps as the way itself, and turning points in the bridge are looked for.
    """

    rule: str
    inward: int
    outward: int
    junction_nodes: int
    iterations: int = 0
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
        1e-6: Setting("collocation", 6, 6, 8, iterations=2),
        1e-9: Setting("collocation", 10, 10, 12, iterations=3),
        1e-11: Setting("collocation", 13, 13, 16, iterations=5),
    },
}
"""For each method the settings of free collisions by the accuracy that they reach.

Accuracy a means an error of the rebound speed below a (relative) and of the delay below 10 a us, measured with the
paper's contact from 1.1 times the capture speed to 200 nm/us (`afm-jax accuracy collide`). Slower tips are computed
with `CAREFUL`, which leaves what the rounding of their speeds does: 1e-16 over their distance from capture, relative.
"""

CAREFUL = Setting("steps", 256, 256, 40, careful=True)
"""For impacts that the quick setting does not resolve: strong dissipation, or a turning point close to the junction."""


def setting_of(method: str, accuracy: float) -> Setting:
    """Return the cheapest setting of free collisions by a method that reaches an accuracy.

    Raises:
        ValueError: if there is no such method, or none of its settings is as accurate.
    """
    if method not in SETTINGS:
        raise ValueError(f"`method` must be one of {', '.join(SETTINGS)}, but is {method!r}")
    return SETTINGS[method][_level(SETTINGS[method], accuracy, f" with {method}")]


class QuickSetting(NamedTuple):
    """How finely the quick way through a driven contact is resolved; hashable, for it shapes the program.

    Every leg of the way has its number of Gauss nodes: `inward` through the bridge, `pressing` to the turning point of
    the junction, `releasing` from there to the fold, `outward` through the bridge. Legs of the bridge take
    `iterations`, those of the junction `junction_iterations`. Contacts whose last iteration still changes a kinetic
    energy by more than `tolerance` (relative), or whose last Legendre coefficients are more than `tail` (relative, of
    the durations), go the careful way in time.
    """

    inward: int
    pressing: int
    releasing: int
    outward: int
    tolerance: float
    iterations: int = 10
    junction_iterations: int = 6
    tail: float = 0.1

    def suffices(
        self, change: Float[Array, "nodes ..."], pace: Float[Array, "nodes ..."], duration_us: Float[Array, "..."]
    ) -> Bool[Array, "..."]:
        """Say whether the iterations of a leg have settled, and its nodes are enough for the series of its pace.

        Args:
            change: relative change of the kinetic energies in the last iteration.
            pace: time per fraction of the leg, at the nodes.
            duration_us: of the leg.
        """
        settled = jnp.max(change, axis=0) < self.tolerance
        lasts = jnp.isfinite(duration_us) & (duration_us > 0.0)
        return settled & (series_tail(pace) < self.tail * duration_us) & lasts


class DrivenSetting(NamedTuple):
    """How driven contacts are resolved; hashable, for it shapes the program.

    `quick` is the way leg by leg, or None to go through every contact in time; `fineness` the steps per unit of the
    local time scale of the way in time; `trials` the trial steps that a tip in contact may take in one round. Contacts
    that magnify errors (left at less than one in `magnified` of their energy, after long or, with `turned`, without or
    with more than one junction) are computed again in finer steps, until two in a row agree within `agreement`; None:
    never.
    """

    quick: QuickSetting | None
    fineness: float
    trials: int
    agreement: float | None = None
    magnified: float = 1.0
    turned: bool = True


DRIVEN_SETTINGS = {
    1e-6: DrivenSetting(
        QuickSetting(12, 8, 10, 12, 1e-6, 6, 4, 3e-3), 2.8, 60, agreement=1e-6, magnified=8.0, turned=False
    ),
    1e-9: DrivenSetting(QuickSetting(18, 13, 15, 16, 1e-9, 10, 7, 1e-4), 5.5, 120, agreement=1e-9, magnified=4.0),
    1e-11: DrivenSetting(QuickSetting(22, 16, 18, 20, 1e-11, 12, 9, 1e-5), 10.0, 250, agreement=1e-11, magnified=2.0),
}
"""Settings by the accuracy of one driven contact: relative of the rebound speed, a tenth of it in us of the times."""


def driven_setting_of(accuracy: float, method: str = "collocation") -> DrivenSetting:
    """Return the cheapest setting of driven contacts by a method that reaches an accuracy.

    With "collocation" they go leg by leg, and in time where that does not hold; with "diffrax" in time throughout.

    Raises:
        ValueError: if none does, or there is no such method.
    """
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, but is {method!r}")
    setting = DRIVEN_SETTINGS[_level(DRIVEN_SETTINGS, accuracy)]
    return setting if method == "collocation" else setting._replace(quick=None)


def _level(settings: Mapping[float, Any], accuracy: float, by: str = "") -> float:
    """Return the coarsest accuracy of settings that is fine enough."""
    reached = [level for level in settings if level <= accuracy * (1.0 + 1e-9)]
    if not reached:
        raise ValueError(f"`accuracy` must be at least {min(settings):g}{by}, but is {accuracy!r}")
    return max(reached)
