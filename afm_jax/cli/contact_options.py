"""The options of every command about a contact: its parameters, the effects left out, the tip's mass."""

import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from afm_jax.cli.values import Finite, SceneName, option_of, scene_and_start
from afm_jax.contact.parameters import (
    CONTACT_PARAMETERS,
    CONTACT_RANGES,
    EFFECTS,
    PAPER,
    REMOVABLE_EFFECTS,
    REQUIRED_EFFECTS,
    idle_without,
)

if TYPE_CHECKING:
    from afm_jax.contact.contact import Contact


class ChosenContact(NamedTuple):
    """What the options come to: the contact, the tip's mass, and both as plain values for the output."""

    contact: "Contact"
    mass_ng: float
    description: dict[str, Any]


class ContactOptions(NamedTuple):
    """The options as they were given; None and False where they were not."""

    scene: str | None
    parameters: Mapping[str, float]
    left_out: tuple[str, ...]
    mass_ng: float | None


def with_contact_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the argument SCENE.toml and the options of a contact; it gets them as `contact_options`."""

    @functools.wraps(function)
    def command(*args: Any, scene: str | None, mass_ng: float | None, **options: Any) -> Any:
        parameters = {name: value for name in PAPER if (value := options.pop(name)) is not None}
        left_out = tuple(name for name in (*REMOVABLE_EFFECTS, *REQUIRED_EFFECTS) if options.pop(f"no_{name}"))
        chosen = ContactOptions(scene, parameters, left_out, mass_ng)
        return function(*args, contact_options=chosen, **options)

    # click lists options in the order of the decorators, the last one first
    for name in list(REQUIRED_EFFECTS)[::-1]:
        command = click.option(f"--no-{name}", is_flag=True, help="Not possible; says why.")(command)
    for name in REMOVABLE_EFFECTS[::-1]:
        command = click.option(f"--no-{name}", is_flag=True, help=f"Leave the {name} force out.")(command)
    mass = click.option("--mass-ng", type=Finite(), metavar="X", help="Effective mass of the tip; the scene's, or 1.")
    command = mass(command)
    for parameter in CONTACT_PARAMETERS[::-1]:
        text = f"{parameter.meaning}; paper: {parameter.default:g}."
        command = click.option(option_of(parameter.name), type=Finite(), metavar="X", help=text)(command)
    argument = click.argument("scene", metavar="[SCENE.toml|PRESET]", required=False, type=SceneName())
    return argument(command)


def chosen_contact(options: ContactOptions) -> ChosenContact:
    """Return the contact of a scene, or the paper's, changed by the options.

    Raises:
        click.UsageError: if an effect that is needed is left out, or a parameter is given of one that is absent.
        ValueError: if a value is impossible, the scene has no contact, or the contact no junction.
    """
    from afm_jax.checks import check_parameter  # noqa: PLC0415
    from afm_jax.scenefile.contact import contact_parameters, make_contact  # noqa: PLC0415

    for name in options.left_out:
        if name in REQUIRED_EFFECTS:
            raise click.UsageError(f"--no-{name} is not possible: {REQUIRED_EFFECTS[name]}")
    for name, value in options.parameters.items():
        check_parameter(option_of(name), value, CONTACT_RANGES[name], optional=True)
    check_parameter("--mass-ng", options.mass_ng, "positive", optional=True)
    effects, parameters, mass = EFFECTS, {}, 1.0
    if options.scene is not None:
        effects, parameters, mass = _of_scene(options.scene)
    effects = tuple(name for name in effects if name not in options.left_out)
    for name in options.parameters:
        missing = idle_without(name, effects)
        if missing:
            raise click.UsageError(f"{option_of(name)} changes nothing without the effect {' or '.join(missing)}")
    contact = make_contact(effects, {**parameters, **options.parameters})
    mass = mass if options.mass_ng is None else options.mass_ng
    numbers = {name: float(value) for name, value in contact_parameters(contact).items()}
    return ChosenContact(contact, mass, {"effects": list(contact.effects), **numbers})


def _of_scene(path: str) -> tuple[tuple[str, ...], dict[str, float], float]:
    """Return effects, parameters and mass of a scene file."""
    from afm_jax.contact.contact import Contact  # noqa: PLC0415
    from afm_jax.scenefile.contact import contact_parameters  # noqa: PLC0415

    scene, _ = scene_and_start(path)
    if not isinstance(scene.interaction, Contact):
        model = "none" if scene.interaction is None else "law"
        raise ValueError(f'{path}: [interaction] model: must be "contact" here, but is "{model}"')  # noqa: TRY004
    numbers = {name: float(value) for name, value in contact_parameters(scene.interaction).items()}
    return scene.interaction.effects, numbers, float(scene.cantilever.mass_ng)
