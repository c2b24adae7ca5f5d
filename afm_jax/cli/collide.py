"""`afm-jax collide [SCENE.toml] --speeds 12,15,20`: free tips through the contact."""

from typing import Any

from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.contact_options import chosen_contact
from afm_jax.cli.session import Session
from afm_jax.contact.collide import collisions
from afm_jax.contact.law_of_contact import contact_laws
from afm_jax.scenefile.law_files import save_law, save_law_csv


def collide(
    session: Session,
    *,
    speeds: tuple[float, ...] | None,
    accuracy: float,
    make_law: bool,
    **options: Any,
) -> Output:
    """Return the collisions of free tips with a contact; with ``make_law`` the law that the contact amounts to."""
    if make_law:
        return contact_as_law(session, **options)
    contact, mass, description = chosen_contact(options)
    with session.working("colliding (the first run compiles for some seconds)"):
        result = collisions(contact, speeds, mass, accuracy=accuracy)
    settings = {"accuracy": accuracy, "default_speeds": speeds is None}
    title = f"Collisions of a free tip of {mass:g} ng: {', '.join(description['effects'])}"
    return Output.of(
        result,
        payload=result.to_dict() | {"contact": description, "mass_ng": mass, "settings": settings},
        files={"collide.png": picture_of("collisions:collisions_figure", result, title)},
        json_file="collide.json",
    )


def contact_as_law(
    session: Session,
    *,
    speed_range: tuple[float, float] | None,
    points: int | None,
    **options: Any,
) -> Output:
    """Return the law that a contact amounts to: a table, and the formulas that are closest to it."""
    contact, mass, description = chosen_contact(options)
    with session.working("fitting (the first run compiles for some seconds)"):
        result = contact_laws(contact, speed_range=speed_range, mass_ng=mass, points=points or 512)
    text = result.printed()
    if session.out is not None:
        text.append(f'In a scene file: [interaction] model = "law", file = "{session.out / "law.json"}"; or --law.')
    return Output.of(
        result,
        payload=result.to_dict() | {"contact": description, "mass_ng": mass},
        text=text,
        files={
            "law.json": lambda path: save_law(result.law, path),
            "law.csv": lambda path: save_law_csv(result.law, path),
        },
        json_file="collide.json",
    )
