"""The impact law of a contact: r, epsilon and viscous loss fitted to simulated collisions.

The squared rebound speed is linear in 1 - r^2, epsilon and the viscous loss. Non-negative linear least squares with
the residuals' weights gives the start, SciPy's least squares the minimum of the residuals themselves.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult, least_squares, nnls

from afm_jax.contact.collide import capture_speed
from afm_jax.contact.contact import Contact
from afm_jax.impact.law import ImpactLaw
from afm_jax.parameters import require_float64
from afm_jax.study.collisions import collide_in_blocks

FREE = {"law": ("r", "epsilon"), "viscous": ("epsilon", "viscous_loss"), "full": ("r", "epsilon", "viscous_loss")}
"""For every model the parameters that are fitted; the others are r = 1 and no viscous loss."""
RESIDUALS = ("relative", "absolute")
LOWEST_SPEED, TOP_SPEED = 1.5, 250.0
"""The range if none is given: from this multiple of the capture speed to this speed in nm/us."""
_NAMES = ("r", "epsilon", "viscous_loss")
_TOLERANCE = 1e-14


@dataclass(frozen=True)
class ContactLaw:
    """A law fitted to a contact, and how far it is off.

    Attributes:
        model: a key of `FREE`.
        residuals: what was made small, "relative" (u_fit/u_out - 1) or "absolute" (u_fit - u_out).
        law: the fitted law, without a delay.
        converged: whether the search ended at a minimum.
        approach_speed_nm_per_us: the speeds, uniform over the range, shape (n,).
        rebound_speed_nm_per_us: of the contact.
        fitted_speed_nm_per_us: of the law.
        contact_capture_speed_nm_per_us: capture speed of the contact; the law has its own.
        mass_ng: of the tip.
    """

    model: str
    residuals: str
    law: ImpactLaw
    converged: bool
    approach_speed_nm_per_us: Float[np.ndarray, " n"]
    rebound_speed_nm_per_us: Float[np.ndarray, " n"]
    fitted_speed_nm_per_us: Float[np.ndarray, " n"]
    contact_capture_speed_nm_per_us: float
    mass_ng: float

    @property
    def r(self) -> float:
        """Coefficient of restitution."""
        return float(self.law.r)

    @property
    def epsilon(self) -> float:
        """Loss by adhesion in nm^2/us^2."""
        return float(self.law.epsilon)

    @property
    def viscous_loss(self) -> float:
        """Loss linear in speed, in nm/us."""
        return float(self.law.viscous_loss)

    @property
    def capture_speed_nm_per_us(self) -> float:
        """Capture speed of the law."""
        return float(self.law.capture_speed_nm_per_us)

    @property
    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest approach speed, in nm/us."""
        return float(self.approach_speed_nm_per_us[0]), float(self.approach_speed_nm_per_us[-1])

    @property
    def error_nm_per_us(self) -> Float[np.ndarray, " n"]:
        """Fitted less simulated rebound speed."""
        return self.fitted_speed_nm_per_us - self.rebound_speed_nm_per_us

    @property
    def relative_error(self) -> Float[np.ndarray, " n"]:
        """Error as a share of the rebound speed."""
        return self.error_nm_per_us / self.rebound_speed_nm_per_us

    @property
    def worst_relative_error(self) -> float:
        """Largest error as a share of the rebound speed."""
        return float(np.abs(self.relative_error).max())

    @property
    def worst_error_nm_per_us(self) -> float:
        """Largest error in nm/us."""
        return float(np.abs(self.error_nm_per_us).max())

    @property
    def worst_share_of_top_speed(self) -> float:
        """Largest error as a share of the highest approach speed."""
        return self.worst_error_nm_per_us / self.speed_range[1]

    @property
    def rms_relative_error(self) -> float:
        """Root of the mean square of the relative errors."""
        return float(np.sqrt(np.mean(self.relative_error**2)))

    @property
    def rms_error_nm_per_us(self) -> float:
        """Root of the mean square of the errors in nm/us."""
        return float(np.sqrt(np.mean(self.error_nm_per_us**2)))


def fit_law(
    contact: Contact,
    *,
    speed_range: tuple[float, float] | None = None,
    model: str = "law",
    residuals: str = "relative",
    mass_ng: float = 1.0,
    points: int = 512,
) -> ContactLaw:
    """Return the impact law that is closest to a contact's rebound speeds.

    Args:
        contact: the contact, of numbers.
        speed_range: lowest and highest approach speed in nm/us; None: from 1.5 times the capture speed to 250 nm/us.
        model: "law" (r and epsilon, eq. 6), "viscous" (epsilon and a loss linear in speed) or "full" (all three).
        residuals: "relative" or "absolute".
        mass_ng: the tip's mass in ng.
        points: number of speeds, uniform over the range.

    Raises:
        RuntimeError: if JAX does not compute in 64 bits, or did not when the contact was built.
        ValueError: if the contact has no junction, a tip of the range is captured, or there is no such model, range,
            number of points or kind of residuals.

    >>> import jax
    >>> with jax.enable_x64(True):
    ...     law = fit_law(Contact.paper(), model="viscous")
    >>> round(law.epsilon, 1), round(law.viscous_loss, 1)
    (113.6, 0.5)
    """
    require_float64(contact)
    if model not in FREE:
        raise ValueError(f"`model` must be one of {', '.join(FREE)}, but is {model!r}")
    if residuals not in RESIDUALS:
        raise ValueError(f"`residuals` must be one of {', '.join(RESIDUALS)}, but is {residuals!r}")
    if points < len(FREE[model]):
        raise ValueError(f"`points` must be at least the number of parameters, {len(FREE[model])}, but is {points}")
    capture = float(capture_speed(contact, mass_ng))
    low, high = range_above_capture(speed_range, capture, LOWEST_SPEED, TOP_SPEED)
    approach = np.linspace(low, high, points)
    rebound = rebounds(contact, approach, mass_ng)["rebound_speed_nm_per_us"]
    law, converged = closest_law(approach, rebound, model, residuals)
    return ContactLaw(
        model=model,
        residuals=residuals,
        law=law,
        converged=converged,
        approach_speed_nm_per_us=approach,
        rebound_speed_nm_per_us=rebound,
        fitted_speed_nm_per_us=np.asarray(law.rebound_speed(approach)),
        contact_capture_speed_nm_per_us=capture,
        mass_ng=mass_ng,
    )


def closest_law(
    approach: Float[np.ndarray, " n"], rebound: Float[np.ndarray, " n"], model: str, residuals: str
) -> tuple[ImpactLaw, bool]:
    """Return the law with the least sum of squared residuals, and whether the search converged.

    Args:
        approach: u_in in nm/us.
        rebound: u_out in nm/us, positive.
        model: a key of `FREE`.
        residuals: one of `RESIDUALS`.
    """
    free = np.array([name in FREE[model] for name in _NAMES])
    # u_out^2 = u_in^2 - (1 - r^2) u_in^2 - epsilon - c u_in; the scales make the parameters of order one
    scales = np.array([1e-2, approach[0] ** 2, approach[0] * 1e-1])[free]
    losses = np.stack([approach**2, np.ones_like(approach), approach], axis=1)[:, free] * scales
    weights = 1.0 / rebound if residuals == "relative" else np.ones_like(rebound)

    def fitted(parameters: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        # a law that captures a tip of the range has the smallest speed instead: far from any minimum
        return np.sqrt(np.maximum(approach**2 - losses @ parameters, 1e-12))

    def residual(parameters: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        return (fitted(parameters) - rebound) * weights

    def slopes(parameters: Float[np.ndarray, " p"]) -> Float[np.ndarray, "n p"]:
        return -0.5 * losses * (weights / fitted(parameters))[:, None]

    # to first order the residual is that of the squares over 2 u_out
    linear = weights / (2.0 * rebound)
    start, _ = nnls(losses * linear[:, None], (approach**2 - rebound**2) * linear)
    found: OptimizeResult = least_squares(
        residual,
        start,
        slopes,  # pyright: ignore[reportArgumentType]
        bounds=(0.0, np.inf),
        method="dogbox",
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
        gtol=1e-12,
    )
    values = np.zeros(3)
    values[free] = found.x * scales
    loss, epsilon, viscous_loss = values.tolist()
    return ImpactLaw(r=math.sqrt(max(1.0 - loss, 1e-12)), epsilon=epsilon, viscous_loss=viscous_loss), found.status > 0


def rebounds(contact: Contact, speeds: Float[np.ndarray, " n"], mass_ng: float) -> dict[str, np.ndarray]:
    """Return the fields of `Collision` for tips that all leave.

    Raises:
        ValueError: if one is captured, or not resolved.
    """
    found = collide_in_blocks(contact, speeds, mass_ng)
    stays = np.flatnonzero(~(found["rebound_speed_nm_per_us"] > 0.0))
    if stays.size:
        raise ValueError(
            f"`speed_range` must hold rebounding tips only, but the one of {speeds[stays[-1]]:.6g} nm/us does not leave"
        )
    return found


def range_above_capture(
    speed_range: tuple[float, float] | None, capture: float, lowest: float, top: float
) -> tuple[float, float]:
    """Return a range of approach speeds in nm/us, checked.

    Args:
        speed_range: lowest and highest speed; None: from `lowest` times the capture speed to `top`.
        capture: capture speed in nm/us.
        lowest: multiple of the capture speed.
        top: in nm/us.

    Raises:
        ValueError: if the range does not rise, or does not begin above the capture speed.
    """
    if math.isinf(capture):
        raise ValueError("the contact captures tips of every speed that was tried: there is no law to fit")
    # a contact that captures no tip still needs a positive speed
    low, high = (max(lowest * capture, 1e-3 * top), top) if speed_range is None else speed_range
    if not 0.0 < low < high < math.inf:
        advice = "" if speed_range else f" (the capture speed is {capture:.4g} nm/us); give a range"
        raise ValueError(f"`speed_range` must rise between two positive speeds, but is {low:.6g} to {high:.6g}{advice}")
    if low <= capture:
        raise ValueError(
            f"`speed_range` must begin above the capture speed of {capture:.6g} nm/us, but does at {low:g}"
        )
    return float(low), float(high)
