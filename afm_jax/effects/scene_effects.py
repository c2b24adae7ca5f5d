"""The effects that a scene names: how strong each is, the scene without it, and the scene with it a little stronger."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.contact import Contact
from afm_jax.contact.forces.liquid import Capillary, Structural, Viscous
from afm_jax.contact.forces.solid import CoreRepulsion
from afm_jax.contact.parameters import REQUIRED_EFFECTS
from afm_jax.impact.law import ImpactLaw

Scaled = Callable[[Scene, Float[Array, ""]], Scene]


class SceneEffect(NamedTuple):
    """One effect of a scene."""

    name: str
    sentence: str
    strength: str
    """What its strength is called."""
    is_zero: bool
    """Whether its strength is zero, so that it is named in vain."""
    required: str | None
    """Why the scene cannot do without it; None: it can be left out."""
    without: Callable[[Scene], Scene]
    """The scene without it; nothing of it is left in the compiled program, unless it is a number of the impact law."""
    scaled: Scaled | None
    """The scene with its strength times 1 + s; None: no strength is known."""


def effects_in(scene: Scene) -> list[SceneEffect]:
    """Return all effects that a scene has: those of its interaction first, then the air, then how it is driven."""
    interaction = scene.interaction
    found: list[SceneEffect] = []
    if isinstance(interaction, Contact):
        found += [_force(interaction, place) for place in range(len(interaction.forces.terms))]
        found.append(_required("jkr", "solid junction (JKR)"))
    elif isinstance(interaction, ImpactLaw):
        found += _of_law(scene, interaction)
    if scene.cantilever.quality_factor is not None:
        found.append(_air(scene))
    return found + list(_of_drives(scene))


def _required(name: str, sentence: str) -> SceneEffect:
    return SceneEffect(name, sentence, "", is_zero=False, required=REQUIRED_EFFECTS[name], without=_same, scaled=None)


def _same(scene: Scene) -> Scene:
    return scene


def _leaf_effect(  # noqa: PLR0913
    scene: Scene,
    name: str,
    sentence: str,
    where: Callable[[Scene], Any],
    *,
    strength: str,
    left_out: Any,
    leaf: Callable[[Scene], Any] | None = None,
    required: str | None = None,
) -> SceneEffect:
    """Return an effect whose strength is one number of the scene.

    Args:
        scene: the scene.
        name: of the effect.
        sentence: what it is.
        where: the part of the scene that goes.
        strength: what the number is called.
        left_out: what takes the part's place.
        leaf: the number; None: the part is the number.
        required: why it cannot be left out.
    """
    number = where if leaf is None else leaf
    return SceneEffect(
        name,
        sentence,
        strength,
        is_zero=not bool(jnp.any(number(scene) != 0.0)),
        required=required,
        without=lambda scene: eqx.tree_at(where, scene, left_out, is_leaf=lambda part: part is None),
        scaled=lambda scene, s: eqx.tree_at(number, scene, number(scene) * (1.0 + s)),
    )


_FORCES: dict[type, tuple[str, str, str]] = {
    # the forces are proportional to these numbers; the capillary force to its own tip radius, which the others do not
    # share (the surface tension is in the Kelvin radius too)
    Capillary: ("capillary", "capillary attraction of the liquid bridge", "tip_radius_nm"),
    Structural: ("structural", "structural repulsion of the confined liquid", "amplitude_n_per_m"),
    Viscous: ("viscous", "viscous force of the liquid bridge", "viscosity_pa_s"),
}


def _force(contact: Contact, place: int) -> SceneEffect:
    """Return the effect of one force of a contact."""
    term = contact.forces.terms[place]
    if isinstance(term, CoreRepulsion):
        return _required("core", "core repulsion")

    def terms(scene: Scene) -> Any:
        return scene.interaction.forces.terms

    def without(scene: Scene) -> Scene:
        kept = tuple(other for other in terms(scene) if type(other) is not type(term))
        return eqx.tree_at(terms, scene, kept)

    if type(term) not in _FORCES:
        name = type(term).__name__
        return SceneEffect(name, f"force {name}", "", is_zero=False, required=None, without=without, scaled=None)
    name, sentence, strength = _FORCES[type(term)]

    def scaled(scene: Scene, s: Float[Array, ""]) -> Scene:
        return eqx.tree_at(
            lambda scene: [getattr(other, strength) for other in terms(scene) if type(other) is type(term)],
            scene,
            replace_fn=lambda number: number * (1.0 + s),
        )

    zero = not bool(jnp.any(getattr(term, strength) != 0.0))
    return SceneEffect(name, sentence, strength, is_zero=zero, required=None, without=without, scaled=scaled)


def _of_law(scene: Scene, law: ImpactLaw) -> Iterator[SceneEffect]:
    """Yield the effects of an impact law; its numbers cost nothing, they are in the formula anyway."""

    def restitution(scene: Scene, s: Float[Array, ""]) -> Scene:
        # the share of the energy that an impact takes, 1 - r^2, grows by the factor 1 + s
        return eqx.tree_at(_r, scene, jnp.sqrt(1.0 - (1.0 - _r(scene) ** 2) * (1.0 + s)))

    yield SceneEffect(
        "restitution",
        "loss in proportion to the energy, r below 1",
        "1 - r^2",
        is_zero=bool(law.r == 1.0),
        required=None,
        without=lambda scene: eqx.tree_at(_r, scene, jnp.ones_like(_r(scene))),
        scaled=restitution,
    )
    zero = jnp.zeros_like(law.r)
    yield _leaf_effect(
        scene,
        "adhesion",
        "loss by adhesion",
        lambda scene: scene.interaction.epsilon,
        strength="epsilon",
        left_out=zero,
    )
    yield _leaf_effect(
        scene,
        "viscous_loss",
        "loss in proportion to the speed",
        lambda scene: scene.interaction.viscous_loss,
        strength="viscous_loss",
        left_out=zero,
    )
    if law.delay is not None:
        yield _delay(scene)
    if law.lasts:
        yield _corrections(law)


def _r(scene: Scene) -> Any:
    return scene.interaction.r


def _delay(scene: Scene) -> SceneEffect:
    def parts(scene: Scene) -> list[Any]:
        return jax.tree.leaves(scene.interaction.delay)

    return SceneEffect(
        "delay",
        "collision delay",
        "hertz, lead_nm, offset_nm",
        is_zero=not any(bool(part != 0.0) for part in parts(scene)),
        required=None,
        without=lambda scene: eqx.tree_at(lambda scene: scene.interaction.delay, scene, None),
        scaled=lambda scene, s: eqx.tree_at(parts, scene, replace_fn=lambda number: number * (1.0 + s)),
    )


def _corrections(law: ImpactLaw) -> SceneEffect:
    def where(scene: Scene) -> Any:
        return scene.interaction.delay

    def without(scene: Scene) -> Scene:
        delay = where(scene)
        if delay is None:
            return scene
        return eqx.tree_at(where, scene, replace(delay, corrections=False))

    delay = law.delay
    assert delay is not None  # only a delay has corrections  # noqa: S101
    return SceneEffect(
        "delay_corrections",
        "what moving sample, spring and air change while an impact lasts",
        "",
        is_zero=bool(delay.hertz == 0.0) and not bool(delay.lead_nm > 0.0),
        required=None,
        without=without,
        scaled=None,
    )


def _air(scene: Scene) -> SceneEffect:
    def where(scene: Scene) -> Any:
        return scene.cantilever.quality_factor

    return SceneEffect(
        "air_damping",
        "air damping of the cantilever",
        "1/quality_factor",
        is_zero=bool(jnp.isinf(where(scene))),
        required=None,
        without=lambda scene: eqx.tree_at(where, scene, None),
        scaled=lambda scene, s: eqx.tree_at(where, scene, where(scene) / (1.0 + s)),
    )


_SECOND = "second frequency of the "


def _of_drives(scene: Scene) -> Iterator[SceneEffect]:
    """Yield the ramp, second frequencies, and the drives of base and tip."""
    if bool(scene.platform.offset_rate_nm_per_us != 0.0):
        rate = scene.platform.offset_rate_nm_per_us
        yield _leaf_effect(
            scene,
            "ramp",
            "slow ramp of the offset",
            lambda scene: scene.platform.offset_rate_nm_per_us,
            strength="offset_rate_nm_per_us",
            left_out=jnp.zeros_like(rate),
        )
    alone = "it is the only drive: without it nothing moves the tip" if _drives(scene) <= 1 else None
    for name, amplitude in (("platform", "amplitude_nm"), ("base", "amplitude_nm"), ("force", "amplitude_nn")):
        drive = getattr(scene, name)
        if drive is None:
            continue
        if drive.second is not None:
            yield _leaf_effect(
                scene,
                f"{name}_second_frequency" if name != "platform" else "second_frequency",
                f"{_SECOND}{name}",
                lambda scene, name=name: getattr(scene, name).second,
                strength=amplitude,
                left_out=None,
                leaf=lambda scene, name=name: getattr(scene, name).second.amplitude,
            )
        if name == "platform":
            continue
        only = bool(getattr(drive, amplitude) != 0.0)
        yield _leaf_effect(
            scene,
            f"{name}_drive",
            "motion of the cantilever's base" if name == "base" else "force on the tip",
            lambda scene, name=name: getattr(scene, name),
            strength=amplitude,
            left_out=None,
            leaf=lambda scene, name=name, amplitude=amplitude: getattr(getattr(scene, name), amplitude),
            required=alone if only else None,
        )


def _drives(scene: Scene) -> int:
    """Return how many of platform, base and force move."""
    parts = [scene.platform.amplitude_nm]
    parts += [] if scene.base is None else [scene.base.amplitude_nm]
    parts += [] if scene.force is None else [scene.force.amplitude_nn]
    return sum(bool(part != 0.0) for part in parts)
