"""How finely driven contacts are resolved for a wanted accuracy; measured by `afm-jax bench --only scenes`."""

from typing import NamedTuple


class QuickSetting(NamedTuple):
    """Numbers of Runge-Kutta steps of the quick way through a contact; hashable, for it shapes the program.

    Every bridge crossing takes `inward` or `outward` steps in the gap, the junction `pressing` steps in fictitious time
    and one in the velocity to its turning point, then `releasing` steps and one in s to the fold. Contacts whose
    embedded error estimate exceeds `tolerance` (relative, of energies and speeds) go the careful way in time.
    """

    inward: int
    pressing: int
    releasing: int
    outward: int
    tolerance: float
    solver: str = "Dopri8"
    junction_solver: str = "Dopri8"


class DrivenSetting(NamedTuple):
    """How driven contacts are resolved; hashable, for it shapes the program.

    `quick` is the way in the gap, or None to go through every contact in time; `fineness` the steps per unit of the
    local pace of the way in time; `trials` the trial steps that a tip in contact may take in one round.
    """

    quick: QuickSetting | None
    fineness: float
    trials: int


SETTINGS = {
    1e-6: DrivenSetting(QuickSetting(6, 4, 5, 6, 1e-4, "Dopri5"), 2.2, 60),
    1e-9: DrivenSetting(QuickSetting(5, 7, 9, 7, 1e-5), 5.0, 120),
}
"""Settings by the accuracy of one contact: relative of the rebound speed, a tenth of it in us of the times."""


def setting_of(accuracy: float) -> DrivenSetting:
    """Return the cheapest setting that reaches an accuracy.

    Raises:
        ValueError: if none does.
    """
    reached = [level for level in SETTINGS if level <= accuracy * (1.0 + 1e-9)]
    if not reached:
        raise ValueError(f"`accuracy` must be at least {min(SETTINGS):g}, but is {accuracy!r}")
    return SETTINGS[max(reached)]
