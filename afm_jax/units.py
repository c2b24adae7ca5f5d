"""The unit system, and the unit suffixes that names carry: the only place with powers of ten.

Inside the program everything is in nm, us, ng and what follows from them coherently, so that no formula needs a
conversion factor:

========================  ==========  ==========================  ===================
quantity                  unit        quantity                    unit
========================  ==========  ==========================  ===================
length                    nm          force                       nN
time                      us          stiffness, surface tension  nN/nm = N/m
mass                      ng          energy                      aJ
speed                     nm/us       epsilon = 2 delta/m         nm^2/us^2 = uJ/kg
angular frequency         rad/us      elastic modulus             nN/nm^2 = GPa
========================  ==========  ==========================  ===================
"""

import math
from typing import Any

TWO_SIDED_95 = 1.959963984540054
"""Half width of a 95 % interval in standard errors, where errors are normal."""

RAD_PER_US_PER_KHZ = 2.0 * math.pi * 1e-3
"""Angular frequency in rad/us of a frequency of 1 kHz."""

EV_PER_AJ = 1.0 / 0.1602176634
"""Electron volts in an attojoule (exact in SI)."""

GAS_CONSTANT_J_PER_MOL_K = 8.31446261815324
"""Molar gas constant in J/(mol K), exact in the SI."""

NM_PER_CM3_PER_M2 = 1e3
"""Length in nm of 1 cm^3 spread over 1 m^2."""

NN_US_PER_NM2_PER_PA_S = 1e-3
"""Viscosity of 1 Pa s in nN us/nm^2."""

AJ_NM6_PER_J_M6 = 1e72
"""Core constant of 1 J m^6 in aJ nm^6."""


SAME_MASS = 0.02
"""Share by which a stated mass must be closer than to k/Omega^2 of a stated spring constant."""


def effective_mass_ng(spring_constant_n_per_m: Any, free_frequency_khz: Any) -> Any:
    """Return the effective mass k/Omega^2 in ng of a cantilever, of numbers and arrays of any kind.

    >>> round(effective_mass_ng(5.4, 90.0), 2)
    16.89
    """
    return spring_constant_n_per_m / (RAD_PER_US_PER_KHZ * free_frequency_khz) ** 2


def contradicting_mass(mass_ng: float, spring_constant_n_per_m: float, free_frequency_khz: float) -> str | None:
    """Return what is wrong where a mass is not that of a spring constant, 2 % or more apart; None where they agree."""
    mass = effective_mass_ng(spring_constant_n_per_m, free_frequency_khz)
    if abs(mass_ng - mass) < SAME_MASS * mass:
        return None
    return (
        f"mass_ng = {mass_ng:g} and spring_constant_n_per_m = {spring_constant_n_per_m:g} contradict each other: "
        f"k/(2 pi f0)^2 is {mass:.4g} ng; correct or remove one of them"
    )


def within_turn(angle: Any, turn: Any) -> Any:
    """Return an angle within [0, turn), of numbers and arrays of any kind; -1e-17 is at 0, not at a whole turn.

    >>> within_turn(-90.0, 360.0), within_turn(-1e-17, 360.0)
    (270.0, 0.0)
    """
    return angle % turn % turn


UNITS = {
    "nm_per_us": "nm/us",
    "nm2_per_us2": "nm^2/us^2",
    "nm2_per_us": "nm^2/us",
    "cm3_per_mol": "cm^3/mol",
    "j_per_m2": "J/m^2",
    "n_per_m": "N/m",
    "per_us": "1/us",
    "j_m6": "J m^6",
    "pa_s": "Pa s",
    "gpa": "GPa",
    "nm": "nm",
    "us": "us",
    "khz": "kHz",
    "mhz": "MHz",
    "deg": "degrees",
    "rad": "rad",
    "aj": "aJ",
    "nn": "nN",
    "ng": "ng",
    "ev": "eV",
    "k": "K",
}
"""Units by the end of a field's name."""


def unit_of(name: str) -> str:
    """Return the unit that a field's name ends with; empty for a number.

    >>> unit_of("rebound_speed_nm_per_us"), unit_of("peak_amplitude_error_nm"), unit_of("stable")
    ('nm/us', 'nm', '')
    """
    return UNITS.get(_ending(name), "")


def words_of(name: str) -> str:
    """Return a field's name in words, without its unit.

    >>> words_of("rebound_speed_nm_per_us")
    'rebound speed'
    """
    return name.removesuffix(f"_{_ending(name)}").replace("_", " ")


def _ending(name: str) -> str:
    return next((end for end in UNITS if name.endswith(f"_{end}")), "")
