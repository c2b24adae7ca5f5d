"""The forces of the contact between tip and sample (section IV) and their potentials, in mpmath.

Written from the equations alone and sharing nothing with the package. Units are the program's: nm, us, ng, nN, aJ,
nN/nm = N/m, nN/nm^2 = GPa. Forces are positive where they push the tip off the sample; F = -dV/dD.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import mpmath

# mpmath makes its functions at run time, where type checkers do not see them
mp: Any = mpmath.mp
# an mpmath number; in parameters also a float (its exact value) or a decimal string
Number = Any

DIGITS = 30
# lost on the way, so that the digits asked for are right in the result
GUARD_DIGITS = 10
# J/(mol K), exact in the SI
GAS_CONSTANT = "8.31446261815324"
EFFECTS = ("capillary", "structural", "core", "viscous", "jkr")


@dataclass(frozen=True, kw_only=True)
class ContactParameters:
    """One tip and one sample, with the paper's values as defaults.

    A float means exactly that float64 number; a string such as "0.3" means the decimal.
    """

    relative_humidity: Number = 0.5
    temperature_k: Number = 293.15
    surface_tension_n_per_m: Number = 0.0728
    molar_volume_cm3_per_mol: Number = 18.0795
    viscosity_pa_s: Number = 1.005e-3
    tip_radius_nm: Number = 100
    structural_amplitude_n_per_m: Number = 40
    structural_decay_nm: Number = 0.6
    structural_offset_nm: Number = 0.6
    core_constant_j_m6: Number = 1e-78
    adhesion_energy_j_per_m2: Number = 0.3
    modulus_gpa: Number = 100
    bridge_forms_nm: Number = 3.5
    bridge_breaks_nm: Number = 4.7
    mass_ng: Number = 1
    effects: tuple[str, ...] = EFFECTS


class Constants(NamedTuple):
    """The combinations in which the parameters enter; 0 where an effect is left out."""

    capillary: Number  # 4 pi R gamma, nN
    reach: Number  # 2 r_K, nm
    structural: Number  # structural force extrapolated to D = 0, nN
    decay: Number  # tau, nm
    core: Number  # B R/180, nN nm^8
    viscous: Number  # (3 pi/2) eta R^2, nN us
    junction_force: Number  # pi w R, nN
    junction_length: Number  # (pi^2 w^2 R/K^2)^(1/3), nm
    forms: Number
    breaks: Number
    mass: Number


def kelvin_radius(p: ContactParameters) -> Number:
    """Return r_K = |gamma V_m/(R_gas T ln(p/p_s))| in nm (eq. 11; the modulus is missing in print)."""
    # (N/m)(cm^3/mol)/(J/mol) = 1e-6 m = 1000 nm
    length = 1000 * mp.mpf(p.surface_tension_n_per_m) * mp.mpf(p.molar_volume_cm3_per_mol)
    length /= mp.mpf(GAS_CONSTANT) * mp.mpf(p.temperature_k)
    return abs(length / mp.log(mp.mpf(p.relative_humidity)))


def constants(p: ContactParameters) -> Constants:
    """Return the combinations of the parameters at the present precision."""
    radius = mp.mpf(p.tip_radius_nm)
    kelvin = kelvin_radius(p)
    decay = mp.mpf(p.structural_decay_nm)
    # effective radius a of eq. 13
    meniscus = radius * mp.sin(mp.acos(1 - 2 * kelvin / radius))
    structural = mp.mpf(p.structural_amplitude_n_per_m) * decay * mp.exp(mp.mpf(p.structural_offset_nm) / decay)
    structural *= 1 - mp.exp(-(meniscus**2) / (2 * radius * decay))
    # J m^6 = 1e18 aJ (1e9 nm)^6
    core = mp.mpf(p.core_constant_j_m6) * mp.mpf(10) ** 72
    adhesion = mp.pi * mp.mpf(p.adhesion_energy_j_per_m2)
    # Pa s = 1e-3 nN us/nm^2
    viscosity = mp.mpf(p.viscosity_pa_s) / 1000
    return Constants(
        capillary=4 * mp.pi * radius * mp.mpf(p.surface_tension_n_per_m) * ("capillary" in p.effects),
        reach=2 * kelvin,
        structural=structural * ("structural" in p.effects),
        decay=decay,
        core=core * radius / 180 * ("core" in p.effects),
        viscous=3 * mp.pi / 2 * viscosity * radius**2 * ("viscous" in p.effects),
        junction_force=adhesion * radius,
        junction_length=mp.cbrt(adhesion**2 * radius / mp.mpf(p.modulus_gpa) ** 2),
        forms=mp.mpf(p.bridge_forms_nm),
        breaks=mp.mpf(p.bridge_breaks_nm),
        mass=mp.mpf(p.mass_ng),
    )


def static_force(k: Constants, gap: Number) -> Number:
    """Return the sum of the static forces of the bridge in nN at a gap in nm (eqs. 10, 13, 14)."""
    return -k.capillary / (1 + gap / k.reach) + k.structural * mp.exp(-gap / k.decay) + k.core / gap**8


def static_slope(k: Constants, gap: Number) -> Number:
    """Return dF/dD of the static forces in nN/nm; minus the stiffness."""
    capillary = k.capillary / k.reach / (1 + gap / k.reach) ** 2
    return capillary - k.structural / k.decay * mp.exp(-gap / k.decay) - 8 * k.core / gap**9


def static_potential(k: Constants, gap: Number) -> Number:
    """Return the potential of the bridge in aJ; the capillary one is 0 at gap 0 (its work to infinity diverges)."""
    capillary = k.capillary * k.reach * mp.log(1 + gap / k.reach)
    return capillary + k.decay * k.structural * mp.exp(-gap / k.decay) + k.core / (7 * gap**7)


def viscous_force(k: Constants, gap: Number, gap_rate: Number) -> Number:
    """Return -(3 pi/2) eta R^2 Ddot/D in nN (eq. 12)."""
    return -k.viscous * gap_rate / gap


# The JKR curve (eq. 15) by s = sqrt(A), the root of the normalized contact radius.


def fold() -> Number:
    """Return s where the junction breaks under displacement control: dDelta/ds = 0, A = 6^(-1/3)."""
    return mp.mpf(6) ** (-mp.mpf(1) / 6)


def jkr_force(k: Constants, s: Number) -> Number:
    """Return the load P = pi w R (s^6 - sqrt(6) s^3) in nN."""
    return k.junction_force * (s**6 - mp.sqrt(6) * s**3)


def jkr_depth(k: Constants, s: Number) -> Number:
    """Return the penetration depth delta = delta_0 (s^4 - (2 sqrt(6)/3) s) in nm."""
    return k.junction_length * (s**4 - 2 * mp.sqrt(6) / 3 * s)


def jkr_depth_slope(k: Constants, s: Number) -> Number:
    """Return d delta/ds in nm."""
    return k.junction_length * (4 * s**3 - 2 * mp.sqrt(6) / 3)


def jkr_stiffness(k: Constants, s: Number) -> Number:
    """Return dP/d delta in nN/nm; infinite at the fold."""
    return k.junction_force * (6 * s**5 - 3 * mp.sqrt(6) * s**2) / jkr_depth_slope(k, s)


def jkr_potential(k: Constants, s: Number) -> Number:
    """Return the integral of P d delta from s = 0 in aJ: P_0 delta_0 (2 s^10/5 - (2 sqrt(6)/3) s^7 + s^4)."""
    return polynomial(jkr_potential_coefficients(k), s)


def jkr_potential_coefficients(k: Constants) -> list[Number]:
    """Return the potential as a polynomial in s, the lowest power first."""
    scale = k.junction_force * k.junction_length
    powers = {4: scale, 7: -2 * mp.sqrt(6) / 3 * scale, 10: 2 * scale / 5}
    return [powers.get(n, mp.mpf(0)) for n in range(11)]


def polynomial(coefficients: list[Number], x: Number) -> Number:
    """Return a polynomial, its coefficients from the lowest power, by Horner's rule."""
    total = mp.mpf(0)
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total


def derivative(coefficients: list[Number]) -> list[Number]:
    """Return the coefficients of a polynomial's derivative."""
    return [n * coefficient for n, coefficient in enumerate(coefficients)][1:]
