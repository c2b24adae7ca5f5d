"""`afm-jax continue SCENE.toml --order N --parameter P=a:b`: orbits followed through one parameter, or two."""

from typing import Annotated

from click import IntRange

from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.scenes import NamedScene, ranges_of, refuse_other_than_law
from afm_jax.cli.session import Session
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.bands import with_errors
from afm_jax.dynamics.continuation import continue_orbits


def follow(
    session: Session,
    scene: NamedScene,
    *,
    order: Annotated[int, IntRange(1, 1_000_000)],
    impacts: Annotated[int, IntRange(0, 64)] = 1,
    parameter: Annotated[str, "P=A:B"],
    second: Annotated[str | None, "P=A:B"] = None,
) -> Output:
    """Follow the (m, N) orbits of a scene through a parameter, round folds, by pseudo-arclength.

    Folds, period doublings, grazings and captures are located to rounding; with --second they are followed as curves in
    two parameters. In a scene with a contact the simulation is closed instead of the map, and curves end where the
    orbit grazes or is captured. With --law every special point has a 95 % interval. With --out tables and pictures.
    Exit code 3 if there is no admissible orbit in the range.

    Args:
        session: for progress.
        scene: the scene.
        order: drive periods of the orbit.
        impacts: impacts in these periods; 0: the free motion.
        parameter: a parameter of the scene file and its range, such as platform.reduced_frequency=0.9:1.1.
        second: a second parameter: special points are followed as curves in both.
    """
    if not isinstance(scene.scene.interaction, Contact):
        refuse_other_than_law(scene)
    first, *others = ranges_of(scene, [parameter, *([second] if second else [])], counted=False)
    with session.working("following orbits (the first run compiles for some seconds)"):
        followed = continue_orbits(scene.scene, order, first, impacts=impacts, second=others[0] if others else None)
    if scene.unknowns is not None:
        followed = with_errors(followed, scene.unknowns)
    files = {"branches.png": picture_of("branches:continuation_figure", followed)}
    if followed.curves:
        files["curves.png"] = picture_of("branches:curves_figure", followed)
    return Output.of(followed, files=files)
