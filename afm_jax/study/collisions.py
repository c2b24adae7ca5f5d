"""A table of collisions: what becomes of free tips of many speeds, with the capture speed and the junction beside."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from afm_jax.contact.collide import capture_speed, collide_in_blocks
from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import find_junction
from afm_jax.outcome import CollisionOutcome
from afm_jax.parameters import require_float64

_POINTS = 20
_TOP_SPEED = 200.0
_ONLY_FREE = ("rebound_speed_nm_per_us", "collision_delay_us", "time_in_contact_us", "time_in_junction_us")
# a captured tip stops before it has lost all of that
_ONLY_FREE += ("bridge_hysteresis_aj", "junction_hysteresis_aj", "viscous_loss_aj")


class Collisions(NamedTuple):
    """Collisions row by row.

    Attributes:
        rows: one dict a tip, the fields of `Collision` as numbers, None where there is none; `outcome` a sentence and
            `outcome_name` a word or two.
        capture_speed_nm_per_us: None where it is not a number.
        capture_speed_reason: a sentence where it is None or 0, else None.
        junction: where it forms and breaks, and its hysteresis.
        unresolved: the sentences of collisions without a valid result.
    """

    rows: list[dict[str, Any]]
    capture_speed_nm_per_us: float | None
    capture_speed_reason: str | None
    junction: dict[str, float]
    unresolved: list[str]


def collisions(
    contact: Contact,
    speeds: Sequence[float] | None = None,
    mass_ng: float = 1.0,
    *,
    accuracy: float = 1e-9,
    method: str = "diffrax",
) -> Collisions:
    """Return what becomes of free tips.

    Args:
        contact: the contact, of numbers.
        speeds: approach speeds in nm/us; None: twenty from 1.1 times the capture speed to 200 nm/us or ten times it.
        mass_ng: the tip's mass in ng.
        accuracy: as in `collide`.
        method: as in `collide`.

    Raises:
        RuntimeError: if JAX does not compute in 64 bits, or did not when the contact was built.
        ValueError: if the contact has no junction, or a setting is not possible.
    """
    require_float64(contact)
    capture = float(capture_speed(contact, mass_ng))
    chosen = default_speeds(capture) if speeds is None else np.asarray(speeds, dtype=float)
    junction = _junction(contact)
    rows = _rows(collide_in_blocks(contact, chosen, mass_ng, accuracy=accuracy, method=method))
    numbers = {name: float(getattr(junction, name)) for name in (*junction._fields, "hysteresis_aj")}
    invalid = [row["outcome"] for row in rows if row["captured"] is None]
    return Collisions(
        rows=rows,
        capture_speed_nm_per_us=capture if math.isfinite(capture) else None,
        capture_speed_reason=_reason(capture),
        junction={name: value for name, value in numbers.items() if name not in ("exists", "forms_root")},
        unresolved=invalid,
    )


def default_speeds(capture_speed_nm_per_us: float) -> Float[np.ndarray, " n"]:
    """Return twenty speeds in nm/us, denser near the capture speed, with four digits each."""
    known = 0.0 < capture_speed_nm_per_us < math.inf
    low = 1.1 * capture_speed_nm_per_us if known else 10.0
    speeds = np.geomspace(low, max(_TOP_SPEED, 10.0 * low), _POINTS)
    return np.array([float(f"{speed:.4g}") for speed in speeds])


_junction = eqx.filter_jit(find_junction)


def _rows(found: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    columns = {name: part.tolist() for name, part in found.items()}
    rows = []
    for values in zip(*columns.values(), strict=True):
        row = dict(zip(columns, values, strict=True))
        outcome = CollisionOutcome(row["outcome"])
        row |= {"outcome": outcome.sentence, "outcome_name": outcome.name.lower().replace("_", " ")}
        if outcome > CollisionOutcome.CAPTURED_BY_JUNCTION:
            row |= {name: None for name in columns if name not in ("approach_speed_nm_per_us", "outcome")}
        elif row["captured"]:
            row |= dict.fromkeys(_ONLY_FREE)
        rows.append(row)
    return rows


def _reason(capture_speed_nm_per_us: float) -> str | None:
    """Say why there is no capture speed, if there is none."""
    if capture_speed_nm_per_us == 0.0:
        return "No tip is captured, however slow: the contact gives back what it takes."
    if math.isinf(capture_speed_nm_per_us):
        return "There is no capture speed: tips of every speed that was tried are captured."
    return None
