"""The references of the tests: the physics in mpmath with 50 digits, independent of the package.

Parts: free flight, platform and law (`reference_flight`), the map and its derivative (`reference_map`), single-impact
orbits (`reference_orbits`); first impacts of many flights at once are in `brute_force`.
"""

from tests.reference_flight import (
    DIGITS,
    Parameters,
    capture_speed,
    constants,
    delay_us,
    free_flight,
    high_precision,
    platform_motion,
    propagator,
    rebound_slope,
    rebound_speed,
)
from tests.reference_map import (
    Impact,
    differenced_jacobian,
    flights_of,
    iterate,
    map_jacobian,
    next_impact,
)
from tests.reference_orbits import Orbit, orbits_by_phase, orbits_by_speed, single_impact_orbits

__all__ = [
    "DIGITS",
    "Impact",
    "Orbit",
    "Parameters",
    "capture_speed",
    "constants",
    "delay_us",
    "differenced_jacobian",
    "flights_of",
    "free_flight",
    "high_precision",
    "iterate",
    "map_jacobian",
    "next_impact",
    "orbits_by_phase",
    "orbits_by_speed",
    "platform_motion",
    "propagator",
    "rebound_slope",
    "rebound_speed",
    "single_impact_orbits",
]
