"""`afm-jax continue SCENE.toml --order N --parameter P=a:b`: orbits followed through one parameter, or two."""

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.orbits import refuse_other_than_law
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.contact.contact import Contact
from afm_jax.dynamics.bands import amplitude_errors, special_errors
from afm_jax.dynamics.continuation import continue_orbits


def follow(
    session: Session,
    scene: NamedScene,
    *,
    order: int,
    impacts: int,
    parameter: str,
    second: str | None,
) -> Output:
    """Return the branches of orbits through a parameter, their special points, and these as curves in two."""
    if not isinstance(scene.scene.interaction, Contact):
        refuse_other_than_law(scene.scene, scene.name)
    given = [parameter, *([] if second is None else [second])]
    first, *others = ranges_of(scene.name, scene.scene, given, counted=False)
    with session.working("following orbits (the first run compiles for some seconds)"):
        followed = continue_orbits(scene.scene, order, first, impacts=impacts, second=others[0] if others else None)
    uncertain = scene.unknowns
    if uncertain is not None:
        followed = followed._replace(
            law_parameters=uncertain.paths,
            amplitude_errors=tuple(amplitude_errors(followed, branch, uncertain) for branch in followed.branches),
            special_errors=special_errors(followed, uncertain),
        )
    files = {"branches.png": picture_of("branches:continuation_figure", followed)}
    if followed.curves:
        files["curves.png"] = picture_of("branches:curves_figure", followed)
    return Output.of(followed, files=files)
