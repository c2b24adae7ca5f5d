"""`afm-jax bifurcation SCENE.toml --parameter P=a:b:n`: what motions come to along a parameter, ramped up and down."""

from typing import Any

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.fitted_law import as_drawn
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.dynamics.bands import verdict_probability
from afm_jax.dynamics.bifurcations import Ramps, bifurcation_diagram


def bifurcation(  # noqa: PLR0913
    session: Session,
    scene: NamedScene,
    *,
    parameter: str,
    both: bool,
    down: bool,
    impacts: int,
    ordinate: str,
    draws: int,
) -> Output:
    """Return what motions of a scene come to along a parameter, ramped up, down or both ways."""
    (swept,) = ranges_of(scene.name, scene.scene, [parameter], counted=True)
    how: dict[str, Any] = {"start": scene.start, "impacts": impacts}
    sweeps = []
    for upward in [True, False] if both else [not down]:
        direction = "up" if upward else "down"
        with session.working(f"sweeping {direction}", f"values {direction}") as report:
            drawn = as_drawn(scene.scene)
            sweeps.append(bifurcation_diagram(drawn, swept.path, swept.values, upward=upward, report=report, **how))
    if scene.unknowns is not None:
        with session.working("sweeping with drawn laws"):
            given = {**how, "draws": draws}
            probabilities = [
                verdict_probability(scene.scene, swept.path, sweep, scene.unknowns, **given) for sweep in sweeps
            ]
        sweeps = [sweep._replace(verdict_probability=each) for sweep, each in zip(sweeps, probabilities, strict=True)]
    if not all(sweep.complete for sweep in sweeps):
        session.note("some stretches were not followed to the end of a branch: sweep fewer values, or a smaller range")
    ramps = Ramps(swept.path, sweeps, impacts)
    return Output.of(ramps, files={"bifurcation.png": picture_of("dynamics:bifurcation_figure", ramps, ordinate)})
