"""`afm-jax collide [SCENE.toml] --speeds 12,15,20`: free tips through the contact."""

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

import click
from click import IntRange

from afm_jax.cli.command import Output, later, picture_of
from afm_jax.cli.session import Session, add_note
from afm_jax.cli.values import Ends, Numbers, Positive, option_of
from afm_jax.contact.collide import collisions
from afm_jax.contact.contact import Contact
from afm_jax.contact.parameters import DEFAULTS, EFFECTS, idle_without
from afm_jax.saved import as_json
from afm_jax.scenefile.contact import contact_parameters, make_contact
from afm_jax.scenefile.law_files import save_law, save_law_csv
from afm_jax.scenefile.scenefile import MASS_ASSUMED, read_scene

contact_laws = later("afm_jax.contact.law_of_contact:contact_laws")


def collide(
    session: Session,
    scene: Annotated[str | None, "[SCENE.toml|PRESET]"] = None,
    *,
    speeds: Annotated[tuple[float, ...] | None, Numbers(), "LIST"] = None,
    accuracy: Positive = 1e-9,
    make_law: bool = False,
    speed_range: Annotated[tuple[float, float] | None, Ends(), "LOW:HIGH"] = None,
    points: Annotated[int | None, IntRange(10, 100_000)] = None,
    **contact: Any,
) -> Output:
    """Let free tips collide with a sample at rest, through liquid bridge and solid junction.

    The contact is the paper's, or that of SCENE.toml, changed by the options. The output gives the capture speed, and
    for every speed the rebound speed, the collision delay, whether the tip is captured, times, deepest gap, and where
    the energy went. With --out collide.csv, collide.json and collide.png. Captured tips are a result, even if all are;
    exit code 3 if the integration does not resolve a collision. --make-law computes the impact law of the contact.

    Args:
        session: for progress.
        scene: a file, or a preset's name.
        speeds: approach speeds in nm/us: 12,15,20 or start:stop:step as 12:200:10 (with the stop where it fits), or
            both. Left out: 20 speeds from 1.1 times the capture speed to 200.
        accuracy: wanted relative accuracy of the rebound speed.
        make_law: compute the impact law of the contact instead of a table of collisions: with --out law.json and
            law.csv, which scene files and --law read, and the formulas closest to it.
        speed_range: with --make-law: approach speeds of the formulas in nm/us. Left out: 1.5 times the capture speed to
            250.
        points: with --make-law: number of speeds that formulas are fitted to; else 512.
        **contact: what is changed of the contact.
    """
    chosen, mass, description = chosen_contact(scene, contact)
    told = {"contact": description, "mass_ng": mass}
    if make_law:
        with session.working("fitting (the first run compiles for some seconds)"):
            laws = contact_laws(chosen, speed_range=speed_range, mass_ng=mass, points=points or 512)
        use = f'In a scene file: [interaction] model = "law", file = "{session.out}/law.json"; or --law.'
        return Output.of(
            laws,
            payload=as_json(laws) | told,
            text=[laws, use if session.out else None],
            files={"law.json": partial(save_law, laws.law), "law.csv": partial(save_law_csv, laws.law)},
            json_file="collide.json",
        )
    with session.working("colliding (the first run compiles for some seconds)"):
        result = collisions(chosen, speeds, mass, accuracy=accuracy)
    settings = {"accuracy": accuracy, "default_speeds": speeds is None}
    title = f"Collisions of a free tip of {mass:g} ng: {', '.join(description['effects'])}"
    return Output.of(
        result,
        payload=as_json(result) | told | {"settings": settings},
        files={"collide.png": picture_of("collisions:collisions_figure", result, title)},
        json_file="collide.json",
    )


def chosen_contact(scene: str | None, options: Mapping[str, Any]) -> tuple[Contact, float, dict[str, Any]]:
    """Return the contact of a scene, or the paper's, changed by the options; the tip's mass in ng; and its description.

    Args:
        scene: a file, or a preset's name.
        options: what a call says of the contact (`CONTACT_OPTIONS`).

    Raises:
        click.UsageError: if an effect that is needed is left out, or a parameter is given of one that is absent.
        ValueError: if a value is impossible, the scene has no contact, or the contact no junction.
    """
    changed = {name: options[name] for name in DEFAULTS if options[name] is not None}
    mass = options["mass_ng"]
    effects, parameters = EFFECTS, {}
    if scene is not None:
        found, _, assumed = read_scene(scene)
        add_note(*(assumed if mass is None else ()))
        if not isinstance(found.interaction, Contact):
            model = "none" if found.interaction is None else "law"
            raise ValueError(f'{scene}: [interaction] model: must be "contact" here, but is "{model}"')
        effects, parameters = found.interaction.effects, _numbers_of(found.interaction)
        mass = float(found.cantilever.mass_ng) if mass is None else mass
    effects = tuple(name for name in effects if not options.get(f"no_{name}"))
    for name in changed:
        missing = idle_without(name, effects)
        if missing:
            raise click.UsageError(f"{option_of(name)} changes nothing without the effect {' or '.join(missing)}")
    contact = make_contact(effects, {**parameters, **changed})
    if mass is None:
        mass = 1.0
        add_note(f"{MASS_ASSUMED} (--mass-ng).")
    return contact, mass, {"effects": list(contact.effects), **_numbers_of(contact)}


def _numbers_of(contact: Contact) -> dict[str, float]:
    return {name: float(value) for name, value in contact_parameters(contact).items()}
