"""How finely driven contacts are resolved for a wanted accuracy; measured by `afm-jax bench --only scenes`."""

from typing import NamedTuple


class QuickSetting(NamedTuple):
    """How finely the quick way through a contact is resolved; hashable, for it shapes the program.

    Every leg of the way has its number of Gauss nodes: `inward` through the bridge, `pressing` to the turning point of
    the junction, `releasing` from there to the fold, `outward` through the bridge. Each is computed in so many sweeps.
    Contacts whose last sweep still changes a kinetic energy by more than `tolerance` (relative), or whose last Legendre
    coefficients are more than `tail` (relative, of the durations), go the careful way in time.
    """

    inward: int
    pressing: int
    releasing: int
    outward: int
    tolerance: float
    sweeps: int = 10
    junction_sweeps: int = 6
    tail: float = 0.1


class DrivenSetting(NamedTuple):
    """How driven contacts are resolved; hashable, for it shapes the program.

    `quick` is the way leg by leg, or None to go through every contact in time; `fineness` the steps per unit of the
    local pace of the way in time; `trials` the trial steps that a tip in contact may take in one round; `method`
    "diffrax" takes the steps in time by Diffrax's solver.
    """

    quick: QuickSetting | None
    fineness: float
    trials: int
    method: str = "collocation"


SETTINGS = {
    1e-6: DrivenSetting(QuickSetting(12, 8, 10, 12, 1e-6, 6, 4, 3e-3), 2.4, 60),
    1e-9: DrivenSetting(QuickSetting(18, 13, 15, 16, 1e-9, 10, 7, 2e-4), 5.0, 120),
}
"""Settings by the accuracy of one contact: relative of the rebound speed, a tenth of it in us of the times."""


METHODS = ("collocation", "diffrax")
"""Ways through a contact: leg by leg with steps in time where that does not hold, or Diffrax's steps in time alone."""


def setting_of(accuracy: float, method: str = "collocation") -> DrivenSetting:
    """Return the cheapest setting of a method that reaches an accuracy.

    Raises:
        ValueError: if none does, or there is no such method.
    """
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, but is {method!r}")
    reached = [level for level in SETTINGS if level <= accuracy * (1.0 + 1e-9)]
    if not reached:
        raise ValueError(f"`accuracy` must be at least {min(SETTINGS):g}, but is {accuracy!r}")
    setting = SETTINGS[max(reached)]
    return setting if method == "collocation" else setting._replace(quick=None, method=method)
