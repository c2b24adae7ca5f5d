"""The options of every command about a contact: its parameters, the effects left out, the tip's mass."""

import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from afm_jax.cli.session import add_note
from afm_jax.cli.values import Finite, SceneName, option_of, scene_and_start
from afm_jax.contact.parameters import (
    CONTACT_PARAMETERS,
    CONTACT_RANGES,
    DEFAULTS,
    DRY_PARAMETERS,
    EFFECTS,
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
    spring_constant_n_per_m: float | None = None
    free_frequency_khz: float | None = None


_OF_THE_TIP = {
    "mass_ng": "Effective mass of the tip; the scene's, or 1.",
    "spring_constant_n_per_m": "Or its spring constant, whose mass is k/Omega^2.",
    "free_frequency_khz": "Of the cantilever, for --spring-constant-n-per-m; else the scene's.",
}


def with_contact_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the argument SCENE.toml and the options of a contact; it gets them as `contact_options`."""

    @functools.wraps(function)
    def command(*args: Any, scene: str | None, **options: Any) -> Any:
        parameters = {name: value for name in DEFAULTS if (value := options.pop(name)) is not None}
        left_out = tuple(name for name in (*REMOVABLE_EFFECTS, *REQUIRED_EFFECTS) if options.pop(f"no_{name}"))
        chosen = ContactOptions(scene, parameters, left_out, *(options.pop(name) for name in _OF_THE_TIP))
        return function(*args, contact_options=chosen, **options)

    # click lists options in the order of the decorators, the last one first
    for name in list(REQUIRED_EFFECTS)[::-1]:
        command = click.option(f"--no-{name}", is_flag=True, help="Not possible; says why.")(command)
    for name in REMOVABLE_EFFECTS[::-1]:
        command = click.option(f"--no-{name}", is_flag=True, help=f"Leave the {name} force out.")(command)
    for name, text in list(_OF_THE_TIP.items())[::-1]:
        command = click.option(option_of(name), type=Finite(), metavar="X", help=text)(command)
    for parameter in (*CONTACT_PARAMETERS, *DRY_PARAMETERS)[::-1]:
        source = "of a dry contact" if parameter in DRY_PARAMETERS else "paper"
        text = f"{parameter.meaning}; {source}: {parameter.default:g}."
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
    from afm_jax.scenefile.scenefile import MASS_ASSUMED  # noqa: PLC0415

    for name in options.left_out:
        if name in REQUIRED_EFFECTS:
            raise click.UsageError(f"--no-{name} is not possible: {REQUIRED_EFFECTS[name]}")
    for name, value in options.parameters.items():
        check_parameter(option_of(name), value, CONTACT_RANGES[name], optional=True)
    for name in _OF_THE_TIP:
        check_parameter(option_of(name), getattr(options, name), "positive", optional=True)
    effects, parameters, known = EFFECTS, {}, {}
    stated = options.mass_ng is not None or options.spring_constant_n_per_m is not None
    if options.scene is not None:
        effects, parameters, known = _of_scene(options.scene, stated=stated)
    effects = tuple(name for name in effects if name not in options.left_out)
    for name in options.parameters:
        missing = idle_without(name, effects)
        if missing:
            raise click.UsageError(f"{option_of(name)} changes nothing without the effect {' or '.join(missing)}")
    contact = make_contact(effects, {**parameters, **options.parameters})
    mass = _mass(options, known) if stated else known.get("mass_ng")
    if mass is None:
        mass = 1.0
        add_note(f"{MASS_ASSUMED} (--mass-ng).")
    numbers = {name: float(value) for name, value in contact_parameters(contact).items()}
    return ChosenContact(contact, mass, {"effects": list(contact.effects), **numbers})


def _mass(options: ContactOptions, known: Mapping[str, float]) -> float:
    """Return the mass that --mass-ng and --spring-constant-n-per-m say.

    Raises:
        click.UsageError: if the spring constant has no frequency.
        ValueError: if both are given and 2 % apart or more.
    """
    from afm_jax.apparatus.cantilever import mass_of  # noqa: PLC0415

    frequency = options.free_frequency_khz or known.get("frequency_khz")
    if options.spring_constant_n_per_m is not None and frequency is None:
        raise click.UsageError("--spring-constant-n-per-m says the mass with --free-frequency-khz alone; give it, too")
    return float(mass_of(frequency, options.mass_ng, options.spring_constant_n_per_m))


def _of_scene(path: str, *, stated: bool) -> tuple[tuple[str, ...], dict[str, float], dict[str, float]]:
    """Return effects, parameters, and mass and frequency of a scene file; ``stated``: the call says the mass."""
    from afm_jax.contact.contact import Contact  # noqa: PLC0415
    from afm_jax.scenefile.contact import contact_parameters  # noqa: PLC0415

    scene, _ = scene_and_start(path, notes=not stated)
    if not isinstance(scene.interaction, Contact):
        model = "none" if scene.interaction is None else "law"
        raise ValueError(f'{path}: [interaction] model: must be "contact" here, but is "{model}"')  # noqa: TRY004
    numbers = {name: float(value) for name, value in contact_parameters(scene.interaction).items()}
    known = {name: float(getattr(scene.cantilever, name)) for name in ("mass_ng", "frequency_khz")}
    return scene.interaction.effects, numbers, known
