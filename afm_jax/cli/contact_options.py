"""The options of every command about a contact: its parameters, the effects left out, the tip's mass."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from afm_jax.cli.options import flag
from afm_jax.cli.session import add_note
from afm_jax.cli.values import Finite, option_of, scene_and_start
from afm_jax.contact.parameters import (
    CONTACT_PARAMETERS,
    CONTACT_RANGES,
    DEFAULTS,
    DRY_PARAMETERS,
    EFFECTS,
    REMOVABLE_EFFECTS,
    idle_without,
)

if TYPE_CHECKING:
    from afm_jax.contact.contact import Contact


class ChosenContact(NamedTuple):
    """What the options come to: the contact, the tip's mass, and both as plain values for the output."""

    contact: "Contact"
    mass_ng: float
    description: dict[str, Any]


def _number(name: str, text: str) -> Callable[..., Any]:
    return click.option(option_of(name), type=Finite(), metavar="X", help=text)


CONTACT_OPTIONS = (
    click.argument("scene", metavar="[SCENE.toml|PRESET]", required=False, type=click.Path()),
    *(_number(each.name, f"{each.meaning}; paper: {each.default:g}.") for each in CONTACT_PARAMETERS),
    *(_number(each.name, f"{each.meaning}; of a dry contact: {each.default:g}.") for each in DRY_PARAMETERS),
    _number("mass_ng", "Effective mass of the tip; the scene's, or 1."),
    *(flag(f"--no-{name}", f"Leave the {name} force out.") for name in REMOVABLE_EFFECTS),
)
"""A scene, and what is changed of its contact or of the paper's: `chosen_contact` takes what the call says of them."""


def chosen_contact(options: Mapping[str, Any]) -> ChosenContact:
    """Return the contact of a scene, or the paper's, changed by the options.

    Args:
        options: what a call says of `CONTACT_OPTIONS`.

    Raises:
        click.UsageError: if an effect that is needed is left out, or a parameter is given of one that is absent.
        ValueError: if a value is impossible, the scene has no contact, or the contact no junction.
    """
    from afm_jax.checks import check_parameter  # noqa: PLC0415
    from afm_jax.scenefile.contact import contact_parameters, make_contact  # noqa: PLC0415
    from afm_jax.scenefile.scenefile import MASS_ASSUMED  # noqa: PLC0415

    changed = {name: options[name] for name in DEFAULTS if options[name] is not None}
    for name, value in changed.items():
        check_parameter(option_of(name), value, CONTACT_RANGES[name], optional=True)
    mass = options["mass_ng"]
    check_parameter("--mass-ng", mass, "positive", optional=True)
    effects, parameters, of_scene = EFFECTS, {}, None
    if options["scene"] is not None:
        effects, parameters, of_scene = _of_scene(options["scene"], notes=mass is None)
    effects = tuple(name for name in effects if not options.get(f"no_{name}"))
    for name in changed:
        missing = idle_without(name, effects)
        if missing:
            raise click.UsageError(f"{option_of(name)} changes nothing without the effect {' or '.join(missing)}")
    contact = make_contact(effects, {**parameters, **changed})
    mass = of_scene if mass is None else mass
    if mass is None:
        mass = 1.0
        add_note(f"{MASS_ASSUMED} (--mass-ng).")
    numbers = {name: float(value) for name, value in contact_parameters(contact).items()}
    return ChosenContact(contact, mass, {"effects": list(contact.effects), **numbers})


def _of_scene(path: str, *, notes: bool) -> tuple[tuple[str, ...], dict[str, float], float]:
    """Return effects, parameters and mass of a scene file; ``notes``: say what it leaves open."""
    from afm_jax.contact.contact import Contact  # noqa: PLC0415
    from afm_jax.scenefile.contact import contact_parameters  # noqa: PLC0415

    scene, _ = scene_and_start(path, notes=notes)
    if not isinstance(scene.interaction, Contact):
        model = "none" if scene.interaction is None else "law"
        raise ValueError(f'{path}: [interaction] model: must be "contact" here, but is "{model}"')  # noqa: TRY004
    numbers = {name: float(value) for name, value in contact_parameters(scene.interaction).items()}
    return scene.interaction.effects, numbers, float(scene.cantilever.mass_ng)
