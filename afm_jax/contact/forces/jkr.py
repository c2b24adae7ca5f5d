"""The adhesive elastic contact of Johnson, Kendall and Roberts, in Maugis' normalised variables (eq. 15).

Takes w, R and K with their units in the names; gives loads, depths and works in these units, and the units in nN, nm
and aJ.

With s = sqrt(A), the root of the normalised contact radius, load and depth are polynomials:
P = s^6 - sqrt(6) s^3, Delta = s^4 - (2 sqrt(6)/3) s, in units of pi w R and of (pi^2 w^2 R / K^2)^(1/3). The contact
breaks under displacement control at the fold s = 6^(-1/6), where dP/dDelta is infinite; s itself stays smooth there.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from afm_jax.checks import as_argument, as_parameter
from afm_jax.contact.forces.force import ElasticCurve, Parameters, Terms
from afm_jax.contact.parameters import DEFAULTS

SLOPE = 2.0 * math.sqrt(6.0) / 3.0
"""The linear coefficient of the depth: Delta = s^4 - SLOPE s."""
FOLD = 6.0 ** (-1.0 / 6.0)
"""s at which the contact breaks under a pull: d Delta/ds = 0."""
FOLD_DEPTH = -3.0 * 6.0 ** (-2.0 / 3.0)
"""Delta at the fold."""


def root_of_load(normalised_load: ArrayLike) -> Float[Array, "..."]:
    """Return the s of the stable branch under load control, s^3 = (sqrt(6) + sqrt(6 + 4 P))/2, for P >= -3/2."""
    return jnp.cbrt(cube_of_load(normalised_load))


def cube_of_load(normalised_load: ArrayLike) -> Float[Array, "..."]:
    """Return s^3 of the stable branch under load control; at the pull-off load where P is below -3/2."""
    square = 6.0 + 4.0 * as_argument(normalised_load)
    held = square > 0.0
    return 0.5 * (math.sqrt(6.0) + jnp.where(held, jnp.sqrt(jnp.where(held, square, 1.0)), 0.0))


class JkrCurve(ElasticCurve):
    """The JKR contact in normalised variables: load in units of pi w R, depth in units of (pi^2 w^2 R / K^2)^(1/3)."""

    fold = FOLD
    reversible = False

    def load(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the normalised load s^6 - sqrt(6) s^3 (eq. 15)."""
        cube = as_argument(s) ** 3
        return cube * (cube - math.sqrt(6.0))

    def depth(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the normalised depth s^4 - (2 sqrt(6)/3) s (eq. 15)."""
        root = as_argument(s)
        return root * (root**3 - SLOPE)

    def depth_slope(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return d Delta/ds = 4 s^3 - 2 sqrt(6)/3; 0 at the fold."""
        return 4.0 * as_argument(s) ** 3 - SLOPE

    def work(self, s: ArrayLike) -> Float[Array, "..."]:
        """Return the normalised potential, the integral of P dDelta: (2/5) s^10 - (2 sqrt(6)/3) s^7 + s^4."""
        root = as_argument(s)
        cube = root**3
        return root * cube * (cube * (0.4 * cube - SLOPE) + 1.0)

    def root_of_depth(self, normalised_depth: ArrayLike) -> Float[Array, "..."]:
        """Return the s of the branch that is stable under a pull, for Delta >= -3 6^(-2/3); below it that of the fold.

        The quartic s^4 - q s - Delta = 0 is split into two quadratics by the positive root y of y^3 + Delta y = 1/3.
        """
        third = jnp.maximum(as_argument(normalised_depth), FOLD_DEPTH) / 3.0
        discriminant = 1.0 / 36.0 + third**3
        above = discriminant > 0.0
        large = jnp.cbrt(1.0 / 6.0 + jnp.where(above, jnp.sqrt(jnp.where(above, discriminant, 1.0)), 0.0))
        # y = large - small with large * small = Delta/3 and large^3 - small^3 = 1/3, without the cancellation
        small = third / large
        y = 1.0 / (3.0 * (large**2 + third + small**2))
        inner = SLOPE * jnp.sqrt(2.0 / y) - 2.0 * y
        inside = inner > 0.0
        return 0.5 * (jnp.sqrt(2.0 * y) + jnp.where(inside, jnp.sqrt(jnp.where(inside, inner, 1.0)), 0.0))

    @property
    def terms(self) -> tuple[Terms, Terms]:
        """Work and depth as polynomials of s."""
        return ((10, 0.4), (7, -SLOPE), (4, 1.0)), ((4, 1.0), (1, -SLOPE))

    @property
    def unloaded(self) -> Float[Array, "..."]:
        """S without load, 6^(1/6)."""
        return jnp.full_like(self.load_scale_nn, 6.0 ** (1.0 / 6.0))

    def beyond(self, work: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return an s that is not smaller than the one at which the work has a value."""
        far = (2.5 * jnp.maximum(work, 0.0)) ** 0.1
        return jnp.cbrt(far**3 + 3.4)

    def width(self, energy: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the distance from the fold at which the work has fallen by a normalised kinetic energy there."""
        # work(fold) - work(s) is _CURVATURE (s - fold)^2 to leading order
        return jnp.sqrt(jnp.maximum(energy, 1e-12) / _CURVATURE)

    def bend(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the derivative of load times depth slope by s; at s = 1.196, where it vanishes, 0.3 of its terms."""
        cube = s**3
        curvature = s * s * (cube * (36.0 * cube - 42.0 * SLOPE) + 12.0)
        return jnp.maximum(jnp.abs(curvature), 0.3 * s * s * (36.0 * cube * cube + 12.0))

    def reach(self, s: Float[Array, "..."], energy: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the distance in s over which the load changes: s itself, however fast the tip is."""
        del energy
        return s


# work' = P Delta' and Delta'(fold) = 0, so that work''(fold) = P(fold) Delta''(fold) = P(fold) 12 fold^2
_CURVATURE = -6.0 * (FOLD**6 - 6.0**0.5 * FOLD**3) * FOLD**2


class Jkr(Parameters):
    """The JKR contact of a sphere and a plane, eq. 15.

    Args:
        adhesion_energy_j_per_m2: Dupre's adhesion energy w in J/m^2 = nN/nm.
        modulus_gpa: reduced modulus K in GPa = nN/nm^2.
        tip_radius_nm: R in nm.

    Raises:
        ValueError: if a value is not positive.
    """

    adhesion_energy_j_per_m2: Float[Array, "..."] = eqx.field(
        converter=as_parameter, default=DEFAULTS["adhesion_energy_j_per_m2"]
    )
    modulus_gpa: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["modulus_gpa"])
    tip_radius_nm: Float[Array, "..."] = eqx.field(converter=as_parameter, default=DEFAULTS["tip_radius_nm"])

    @property
    def load_scale_nn(self) -> Float[Array, "..."]:
        """The unit of the load, pi w R, in nN; the contact bears 3/2 of it in tension."""
        return jnp.pi * self.adhesion_energy_j_per_m2 * self.tip_radius_nm

    @property
    def depth_scale_nm(self) -> Float[Array, "..."]:
        """The unit of the depth, (pi^2 w^2 R / K^2)^(1/3), in nm."""
        return jnp.cbrt(self.tip_radius_nm * (jnp.pi * self.adhesion_energy_j_per_m2 / self.modulus_gpa) ** 2)

    @property
    def curve(self) -> JkrCurve:
        """The contact in normalised variables."""
        return JkrCurve(self.load_scale_nn, self.depth_scale_nm)

    @property
    def energy_scale_aj(self) -> Float[Array, "..."]:
        """The unit of the energy, load times depth, in aJ."""
        return self.load_scale_nn * self.depth_scale_nm

    @property
    def pull_off_depth_nm(self) -> Float[Array, "..."]:
        """The depth, negative, at which the contact breaks under a pull, in nm."""
        return FOLD_DEPTH * self.depth_scale_nm

    def force(self, depth_nm: ArrayLike) -> Float[Array, "..."]:
        """Return the force on the tip in nN at a depth in nm, on the branch that is stable under a pull (eq. 15).

        The depth counts into the sample; below `pull_off_depth_nm` there is no contact and the value at the fold is
        returned.
        """
        return self.curve.force(depth_nm)

    def potential(self, depth_nm: ArrayLike) -> Float[Array, "..."]:
        """Return the potential energy in aJ at a depth in nm, 0 where the contact radius would vanish."""
        curve = self.curve
        return self.energy_scale_aj * curve.work(curve.root_of_depth(as_argument(depth_nm) / self.depth_scale_nm))
