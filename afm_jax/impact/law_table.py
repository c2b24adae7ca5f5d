"""One table of a law: what an impact does to a free tip on a sample at rest, over a coordinate smooth through capture.

Takes w^2 in nm^2/us^2 and delays in us at the knots; gives speeds in nm/us and the delay in us at a coordinate, without
unit.

The coordinate s counts knots. With the capture speed u_c and v_k = 3 sinh(h k) nm/us at knot k, the approach speed is
u = sqrt(u_c^2 + v^2), so that an orbit keeps its coordinate while u_c moves. The rebound speed and the delay are

    w^2 = r^2 v^2 - M(s),    tau = T(s) - b (1/w - 1/u) + f (1/w^2 - 1/u^2),

r the restitution of fast impacts, so that eq. 6 is exact, M and T cubic splines in s, even at capture and natural at
the end: two vectors and a constant matrix. Formulas, contacts and measured laws all become such tables, so that what
follows orbits is one compiled program.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from afm_jax.impact.law import BRIDGE_NM, HertzContact, Impact, Speeds

AnyArray = Array | np.ndarray
"""JAX's within programs, NumPy's outside."""
KNOTS = 97
_SCALE, _FASTEST = 3.0, 2e4
"""Speed in nm/us from which knots stand at equal ratios, and speed v of the last one."""
_STEP = float(np.arcsinh(_FASTEST / _SCALE)) / (KNOTS - 1)
EXCESS = _SCALE * np.sinh(_STEP * np.arange(KNOTS))
"""v in nm/us at the knots."""
_SLOWEST = 1e-4
"""Square of the rebound speed in nm^2/us^2 at which a captured tip is held."""


def _slopes_of_values() -> Float[np.ndarray, "knots knots"]:
    """Return what makes slopes at the knots of values there: slope 0 at the first, second derivative 0 at the last."""
    left, right = np.zeros((KNOTS, KNOTS)), np.zeros((KNOTS, KNOTS))
    inner = np.arange(1, KNOTS - 1)
    for offset, weight, value in ((-1, 1.0, -3.0), (0, 4.0, 0.0), (1, 1.0, 3.0)):
        left[inner, inner + offset], right[inner, inner + offset] = weight, value
    left[0, 0] = 1.0
    left[-1, -2:], right[-1, -2:] = (1.0, 2.0), (-3.0, 3.0)
    return np.linalg.solve(left, right)


_SLOPES = _slopes_of_values()


def _cubic(x: Any) -> tuple[Any, ...]:
    """Return what a cubic at x between 0 and 1 weighs its value and slope at 0, and those at 1, with."""
    to_right = x * x * (3.0 - 2.0 * x)
    return 1.0 - to_right, x * (1.0 - x) ** 2, to_right, -x * x * (1.0 - x)


class LawTable(Impact):
    """What an impact does at a coordinate: see the module.

    Attributes:
        capture: u_c in nm/us.
        kept: r^2.
        loss: M in nm^2/us^2 at the knots, 0 at the first, and its slopes by the coordinate, shape (2, knots).
        time: T in us, likewise.
        hertz: Hertz time a at 1 nm/us, in us (nm/us)^0.2: what platform, spring and air act on.
        lead_nm: b, the lead of a slow way out.
        offset_nm: d, twice the height of the solid over gap 0.
        lead_square: f, in nm^2/us.
        length_nm: length over which a leaving tip keeps its energy.
    """

    capture: Float[AnyArray, "..."]
    kept: Float[AnyArray, "..."]
    loss: Float[AnyArray, "... 2 knots"]
    time: Float[AnyArray, "... 2 knots"]
    hertz: Float[AnyArray, "..."]
    lead_nm: Float[AnyArray, "..."]
    offset_nm: Float[AnyArray, "..."]
    lead_square: Float[AnyArray, "..."]
    length_nm: Float[AnyArray, "..."]

    @property
    def lowest(self) -> Float[Array, ""]:
        """Coordinate at which the tip is captured: 0."""
        return jnp.zeros_like(self.capture)

    @property
    def hertz_contact(self) -> HertzContact:
        """The Hertz contact on which platform, spring and air act while the impact lasts."""
        numbers = self.hertz, self.lead_nm, 0.5 * self.offset_nm, self.length_nm
        return HertzContact(*map(jnp.asarray, numbers))

    def speeds(self, coordinate: Float[Array, "..."]) -> Speeds:
        """Return approach and rebound speed in nm/us and the delay in us at a coordinate."""
        return self.speeds_with(coordinate, 0.0, 0.0)

    def speeds_with(self, coordinate: Float[Array, ""], square: ArrayLike, late: ArrayLike) -> Speeds:
        """Return the speeds with a change of w^2 in nm^2/us^2 and one of the delay in us."""
        excess = _SCALE * jnp.sinh(_STEP * coordinate)
        approach = jnp.sqrt(self.capture**2 + excess**2)
        left = jnp.clip(jnp.floor(lax.stop_gradient(coordinate)), 0, KNOTS - 2).astype(int)
        x = coordinate - left.astype(coordinate.dtype)
        ends = _cubic(x)

        def spline(numbers: Float[AnyArray, "2 knots"]) -> Float[Array, ""]:
            value, slope = numbers
            return ends[0] * value[left] + ends[1] * slope[left] + ends[2] * value[left + 1] + ends[3] * slope[left + 1]

        rebound = jnp.sqrt(jnp.maximum(self.kept * excess**2 - spline(self.loss) + square, _SLOWEST))
        lead, twice = 1.0 / rebound - 1.0 / approach, 1.0 / rebound**2 - 1.0 / approach**2
        return Speeds(approach, rebound, spline(self.time) + late - self.lead_nm * lead + self.lead_square * twice)


def coordinate_of(approach_speed: Float[np.ndarray, "..."], capture: float) -> Float[np.ndarray, "..."]:
    """Return the coordinate of approach speeds above capture, in nm/us."""
    return np.arcsinh(np.sqrt(np.maximum(approach_speed**2 - capture**2, 0.0)) / _SCALE) / _STEP


def weights_at(coordinate: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n knots"]:
    """Return what the splines of a table weigh the values at the knots with, at coordinates."""
    left = np.clip(np.floor(coordinate), 0, KNOTS - 2).astype(int)
    ends, values = _cubic((coordinate - left)[:, None]), np.eye(KNOTS)
    found = ends[0] * values[left] + ends[1] * _SLOPES[left]
    return found + ends[2] * values[left + 1] + ends[3] * _SLOPES[left + 1]


def table_of(
    capture: float,
    square: Float[np.ndarray, " knots"],
    time: Float[np.ndarray, " knots"],
    coefficients: Float[np.ndarray, " 4"],
    length_nm: float = BRIDGE_NM,
    kept: float = 1.0,
) -> LawTable:
    """Return the table through rebound speeds and delays at the knots.

    Args:
        capture: u_c in nm/us.
        square: w^2 in nm^2/us^2 at u = sqrt(u_c^2 + EXCESS^2); 0 at the first, whatever is given.
        time: the delay without its leads, T, in us.
        coefficients: a, b, d, f; see `LawTable`.
        length_nm: see there.
        kept: see there.
    """
    loss = kept * EXCESS**2 - square
    loss[0] = 0.0
    splines = [np.stack([values, _SLOPES @ values]) for values in (loss, time)]
    numbers = [np.asarray(float(number)) for number in (capture, kept, *coefficients, length_nm)]
    columns: Any = (*numbers[:2], *splines, *numbers[2:])
    return LawTable(*columns)
