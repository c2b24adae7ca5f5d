"""What a fit of the contact holds: how well that is known, and what its error does to law and delay."""

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.contact.parameters import CONTACT_PARAMETER, PAPER, idle_without
from fitting.parameters import PARAMETERS


class Held(NamedTuple):
    """A parameter that is held.

    Attributes:
        name: of the parameter.
        value: at which it is held.
        error: its standard error.
        assumed: nobody has said the error.
    """

    name: str
    value: float
    error: float
    assumed: bool


class HeldEffect(NamedTuple):
    """What one standard error of a held parameter does to the squared rebound speed and to the delay.

    In nm^2/us^2 and us, at logarithms of approach speeds in nm/us.
    """

    held: Held
    log_speed: Float[np.ndarray, " n"]
    square: Float[np.ndarray, " n"]
    late: Float[np.ndarray, " n"]

    def at(self, speeds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2 n"]:
        """Return both at approach speeds in nm/us."""
        place = np.log(speeds)
        return np.stack([np.interp(place, self.log_speed, part) for part in (self.square, self.late)])


def split_held(
    own: tuple[str, ...], fixed: Mapping[str, float] | None, constraints: Mapping[str, tuple[float, float]] | None
) -> tuple[dict[str, float], dict[str, tuple[float, float]], dict[str, float]]:
    """Return what a fit of the contact holds, what is known of what it fits, and what is known of what it holds.

    Args:
        own: the parameters that are fitted.
        fixed: values at which others are held.
        constraints: value and standard error of what is known of any.

    Returns:
        The values, those of the constraints among them; the other constraints; the standard errors that are said.

    Raises:
        ValueError: if a parameter is held at two values, or a constraint on one is impossible.
    """
    values, others, errors = dict(fixed or {}), {}, {}
    for name, (value, error) in (constraints or {}).items():
        if name not in CONTACT_PARAMETER or name in own:
            others[name] = (value, error)
            continue
        if not (np.isfinite(value) and 0.0 < error < np.inf):
            raise ValueError(
                f"the constraint on {name} must be a value and a positive error, but is {value} +- {error}"
            )
        if values.get(name, value) != value:
            raise ValueError(f"{name} is held at {values[name]:g} (`fixed`) and known as {value:g}: say one of the two")
        values[name], errors[name] = value, error
    return values, others, errors


def held_of(
    own: tuple[str, ...], effects: tuple[str, ...], fixed: Mapping[str, float], errors: Mapping[str, float]
) -> tuple[Held, ...]:
    """Return all parameters of a contact that are not fitted and mean something with its effects."""
    values = PAPER | dict(fixed)
    return tuple(
        Held(name, float(values[name]), errors.get(name, known.error_at(values[name])), name not in errors)
        for name, known in CONTACT_PARAMETER.items()
        if name not in own and not idle_without(name, effects)
    )


_POINTS, _NEAREST = 96, 1.1
"""Speeds at which the effects are computed, and the slowest of them in terms of the capture speed."""
_PARTS = (0.5, 0.1)
"""Parts of the standard error that a parameter is moved by to both sides; the smaller where no contact is left then."""
_NO_CONTACT = 1e5
"""Lowest speed in nm/us from which there is none."""


def effects_of_held(
    held: tuple[Held, ...],
    values: Mapping[str, float],
    effects: tuple[str, ...],
    mass_ng: float,
    speeds: tuple[float, float],
) -> tuple[HeldEffect, ...]:
    """Return what the errors of held parameters do to the law of a contact.

    Args:
        held: the parameters.
        values: of the contact's parameters, by name: what is not named is the paper's.
        effects: that the contact has.
        mass_ng: of the tip.
        speeds: slowest and fastest approach in nm/us.
    """
    u = np.geomspace(0.5 * speeds[0], 1.3 * speeds[1], _POINTS)
    here = PAPER | dict(values)
    sets = [here]
    for one in held:
        ends = PARAMETERS[one.name].lowest, PARAMETERS[one.name].highest
        for part in _PARTS:
            sets += [here | {one.name: float(np.clip(one.value + side * part * one.error, *ends))} for side in (-1, 1)]
    columns = {name: np.array([float(one[name]) for one in sets]) for name in PAPER}
    square, late, lowest = (np.asarray(part) for part in _varied(columns, np.asarray(mass_ng), u, effects))
    found = []
    for number, one in enumerate(held):
        for part in range(len(_PARTS)):
            low = 1 + 2 * (len(_PARTS) * number + part)
            pair = np.array([low, low + 1])
            moved = float(np.ptp(columns[one.name][pair]))
            sound = np.isfinite(square[pair]).all() and np.isfinite(late[pair]).all()
            if moved == 0.0 or not sound or lowest[pair].max() > _NO_CONTACT:
                continue
            there = u > _NEAREST * max(lowest[pair].max(), lowest[0])
            change = np.stack([square[low + 1] - square[low], late[low + 1] - late[low]]) * one.error / moved
            if there.sum() > 1:
                found.append(HeldEffect(one, np.log(u[there]), change[0, there], change[1, there]))
                break
    return tuple(found)


@partial(jax.jit, static_argnames="effects")
def _varied(
    parameters: dict[str, Float[Array, " k"]], mass_ng: Float[Array, ""], speeds: Float[Array, " n"], effects: tuple
) -> tuple[Float[Array, "k n"], Float[Array, "k n"], Float[Array, " k"]]:
    """Return squared rebound speeds, delays and capture speeds of several contacts."""

    def one(known):
        impact = tabulated(Contact.paper(effects=effects, **known), mass_ng)
        found = impact.speeds(speeds)
        return found.rebound**2, found.delay, impact.lowest

    return jax.vmap(one)(parameters)
