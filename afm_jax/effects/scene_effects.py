"""The effects that a scene names: how strong each one is, and the scene without it."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.contact.forces.dry import Dmt, Hertz
from afm_jax.contact.forces.jkr import Jkr
from afm_jax.contact.forces.liquid import Capillary, Structural, Viscous
from afm_jax.contact.forces.solid import CoreRepulsion, VanDerWaals
from afm_jax.contact.parameters import WHY_REQUIRED
from afm_jax.impact.law import ImpactLaw


class SceneEffect(NamedTuple):
    """One effect of a scene."""

    name: str
    sentence: str
    without: Callable[[Scene], Scene]
    """The scene without it; nothing of it is left in the compiled program, unless it is a number of the impact law."""
    strength: str = ""
    """What its strength is called; empty: it has no single number."""
    is_zero: bool = False
    """Whether its strength is zero, so that it is named in vain."""
    required: str | None = None
    """Why the scene cannot do without it; None: it can be left out."""


def effects_in(scene: Scene) -> list[SceneEffect]:
    """Return all effects that a scene has: those of its interaction first, then the air, then how it is driven."""
    interaction = scene.interaction
    effects: list[SceneEffect] = []
    if isinstance(interaction, Contact):
        effects += [_force(interaction, place) for place in range(len(interaction.forces.terms))]
        effects.append(_required(*_SOLIDS[type(interaction.junction)]))
    elif isinstance(interaction, ImpactLaw):
        effects += _of_law(interaction)
    if scene.cantilever.quality_factor is not None:
        effects.append(_air(scene))
    return effects + list(_of_drives(scene))


_SOLIDS: dict[type, tuple[str, str]] = {
    Jkr: ("jkr", "solid junction (JKR)"),
    Dmt: ("dmt", "solid contact (DMT)"),
    Hertz: ("hertz", "solid contact (Hertz)"),
}


def _required(name: str, sentence: str) -> SceneEffect:
    return SceneEffect(name, sentence, without=lambda scene: scene, required=WHY_REQUIRED[name])


def _replacing(part: Callable[[Scene], Any], left_out: Any) -> Callable[[Scene], Scene]:
    """Return the function that puts something in the place of a part of a scene, which may be None there."""
    return lambda scene: eqx.tree_at(part, scene, left_out, is_leaf=lambda leaf: leaf is None)


_FORCES: dict[type, tuple[str, str, str]] = {
    # the capillary force is proportional to its own tip radius, which the others do not share (the surface tension is
    # in the Kelvin radius too)
    Capillary: ("capillary", "capillary attraction of the liquid bridge", "tip_radius_nm"),
    Structural: ("structural", "structural repulsion of the confined liquid", "amplitude_n_per_m"),
    VanDerWaals: ("van_der_waals", "van der Waals attraction", "hamaker_constant_aj"),
    Viscous: ("viscous", "viscous force of the liquid bridge", "viscosity_pa_s"),
}


def _force(contact: Contact, place: int) -> SceneEffect:
    """Return the effect of one force of a contact."""
    force = contact.forces.terms[place]
    if isinstance(force, CoreRepulsion):
        return _required("core", "core repulsion")

    def terms(scene: Scene) -> Any:
        return scene.interaction.forces.terms

    def without(scene: Scene) -> Scene:
        return eqx.tree_at(terms, scene, tuple(other for other in terms(scene) if type(other) is not type(force)))

    if type(force) not in _FORCES:
        return SceneEffect(type(force).__name__, f"force {type(force).__name__}", without)
    name, sentence, strength = _FORCES[type(force)]
    return SceneEffect(name, sentence, without, strength, is_zero=_vanishes(getattr(force, strength)))


def _of_law(law: ImpactLaw) -> Iterator[SceneEffect]:
    """Yield the effects of an impact law; its numbers cost nothing, they are in the formula anyway."""
    for name, sentence, strength, field, neutral in (
        ("restitution", "loss in proportion to the energy, r below 1", "1 - r^2", "r", 1.0),
        ("adhesion", "loss by adhesion", "epsilon", "epsilon", 0.0),
        ("viscous_loss", "loss in proportion to the speed", "viscous_loss", "viscous_loss", 0.0),
    ):
        number = getattr(law, field)
        without = _replacing(
            lambda scene, field=field: getattr(scene.interaction, field), jnp.full_like(number, neutral)
        )
        yield SceneEffect(name, sentence, without, strength, is_zero=_vanishes(number - neutral))
    delay = law.delay
    if delay is None:
        return
    yield SceneEffect(
        "delay",
        "collision delay",
        _replacing(_delay, None),
        "hertz, lead_nm, offset_nm",
        is_zero=all(_vanishes(number) for number in jax.tree.leaves(delay)),
    )
    if law.lasts:
        yield SceneEffect(
            "delay_corrections",
            "what moving sample, spring and air change while an impact lasts",
            _without_corrections,
            is_zero=_vanishes(delay.hertz) and not bool(delay.lead_nm > 0.0),
        )


def _delay(scene: Scene) -> Any:
    return scene.interaction.delay


def _without_corrections(scene: Scene) -> Scene:
    if _delay(scene) is None:
        return scene
    return eqx.tree_at(_delay, scene, replace(_delay(scene), corrections=False))


def _air(scene: Scene) -> SceneEffect:
    def quality_factor(scene: Scene) -> Any:
        return scene.cantilever.quality_factor

    return SceneEffect(
        "air_damping",
        "air damping of the cantilever",
        _replacing(quality_factor, None),
        "1/quality_factor",
        is_zero=bool(jnp.isinf(quality_factor(scene))),
    )


def _of_drives(scene: Scene) -> Iterator[SceneEffect]:
    """Yield the ramp, second frequencies, and the drives of base and tip."""
    rate = scene.platform.offset_rate_nm_per_us
    if not _vanishes(rate):
        without = _replacing(lambda scene: scene.platform.offset_rate_nm_per_us, jnp.zeros_like(rate))
        yield SceneEffect("ramp", "slow ramp of the offset", without, "offset_rate_nm_per_us")
    parts = {"platform": "amplitude_nm", "base": "amplitude_nm", "force": "amplitude_nn"}
    driven = {name: getattr(scene, name) for name in parts if getattr(scene, name) is not None}
    moving = [name for name, drive in driven.items() if not _vanishes(getattr(drive, parts[name]))]
    for name, drive in driven.items():
        if drive.second is not None:
            yield SceneEffect(
                "second_frequency" if name == "platform" else f"{name}_second_frequency",
                f"second frequency of the {name}",
                _replacing(lambda scene, name=name: getattr(scene, name).second, None),
                parts[name],
                is_zero=_vanishes(drive.second.amplitude),
            )
        if name != "platform":
            alone = moving == [name]
            yield SceneEffect(
                f"{name}_drive",
                "motion of the cantilever's base" if name == "base" else "force on the tip",
                _replacing(lambda scene, name=name: getattr(scene, name), None),
                parts[name],
                is_zero=name not in moving,
                required="it is the only drive: without it nothing moves the tip" if alone else None,
            )


def _vanishes(number: Any) -> bool:
    return not bool(jnp.any(number != 0.0))
