"""An impact oscillator in units of its own: natural frequency 1, mass 1.

Takes omega, zeta, r, gap and force of x'' + 2 zeta x' + x = f cos(omega t), without units; gives a scene in us, nm and
ng whose numbers are these.
"""

from jaxtyping import ArrayLike

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.apparatus.scene import Scene
from afm_jax.checks import check_parameter
from afm_jax.impact.law import ImpactLaw
from afm_jax.units import RAD_PER_US_PER_KHZ


def dimensionless_scene(
    omega: ArrayLike, damping_ratio: float | None, r: ArrayLike, gap: ArrayLike, force: ArrayLike = 1.0
) -> Scene:
    """Return the scene of x'' + 2 zeta x' + x = f cos(omega t) with a rigid stop at x = -gap: x' becomes -r x' there.

    One microsecond is the unit of time, a nanometre that of length, and the mass is 1 ng, so that a natural frequency
    of 1 rad/us makes the spring constant 1 N/m, and a force of 1 nN the force 1. Results are numbers in these units: a
    speed of 0.8 nm/us is 0.8. With a stop above, at x = +gap, everything happens half a period of the force later, with
    x of the other sign: speeds and amplitudes are the same.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> from afm_jax import dimensionless_scene, single_impact_orbits
    >>> orbits = single_impact_orbits(dimensionless_scene(1.0, 0.05, 0.8, gap=1.0, force=0.5), 1)
    >>> float(orbits.approach_speed_nm_per_us[orbits.stable][0])  # doctest: +ELLIPSIS
    0.8370160...

    Args:
        omega: frequency of the force over the natural one.
        damping_ratio: zeta, below 1; None or 0: no damping.
        r: coefficient of restitution, speed after an impact over that before.
        gap: distance of the stop from where the mass rests; negative: the spring presses the mass onto it.
        force: amplitude f.

    Raises:
        ValueError: if omega is not positive, the force negative, the damping ratio below 0 or not below 1, r not
            between 0 and 1, or the gap not finite.
    """
    check_parameter("omega", omega, "positive")
    check_parameter("force", force, "not negative")
    if damping_ratio is not None and not 0.0 <= damping_ratio < 1.0:
        raise ValueError(f"`damping_ratio` must be at least 0 and below 1, but is {damping_ratio:g}")
    natural_khz = 1.0 / RAD_PER_US_PER_KHZ
    quality_factor = 0.5 / damping_ratio if damping_ratio else None
    return Scene(
        Cantilever(natural_khz, quality_factor, mass_ng=1.0),
        Platform(offset_nm=-1.0 * gap),
        ImpactLaw(r=r),
        force=ForceDrive(force, omega * natural_khz),
    )
