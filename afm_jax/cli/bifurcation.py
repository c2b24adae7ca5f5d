"""`afm-jax bifurcation SCENE.toml --parameter P=a:b:n`: what motions come to along a parameter, ramped up and down."""

from typing import Annotated, Any, Literal

from click import IntRange

from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.scenes import NamedScene, as_drawn, ranges_of
from afm_jax.cli.session import Session
from afm_jax.dynamics.bands import verdict_probability
from afm_jax.dynamics.bifurcations import Ramps, bifurcation_diagram


def bifurcation(  # noqa: PLR0913
    session: Session,
    scene: NamedScene,
    *,
    parameter: Annotated[str, "P=a:b:n"],
    both: bool = False,
    down: bool = False,
    impacts: Annotated[int, IntRange(200)] = 2000,
    ordinate: Literal["height", "phase", "impact_speed"] | None = None,
    draws: Annotated[int, IntRange(2)] = 20,
) -> Output:
    """Ramp a parameter and record the motion on which the tip settles at each of its values.

    The tip is carried from value to value with its drive phase and rebound speed. It starts at the file's [start];
    without one on a stable single-impact orbit of the order nearest to resonance (of a contact: of the law closest to
    it), else leaving the sample upward. Where the sample held it or it flew away it starts again in the same way. The
    output gives the motion at each value, (m,N): m impacts in N drive periods, irregular, stuck or free; and its last
    impacts. With --out bifurcation.csv (one row per value), impacts.csv (one row per impact; each impact of an orbit
    once) and a picture. With --law also the fraction of the
    fit's draws with the same motion. Exit code 3 if no motion went on anywhere.

    Args:
        session: for progress.
        scene: the scene.
        parameter: a parameter of the scene file and its values.
        both: ramp up and then down, so that hysteresis shows.
        down: ramp down instead of up.
        impacts: impacts at every value.
        ordinate: what the picture draws of an impact; else the height, over a sample at rest the impact speed.
        draws: laws drawn from the fit for the bands.
    """
    (swept,) = ranges_of(scene, [parameter], counted=True)
    how: dict[str, Any] = {"start": scene.start, "impacts": impacts}
    sweeps = []
    for upward in [True, False] if both else [not down]:
        direction = "up" if upward else "down"
        with session.working(f"sweeping {direction}", f"values {direction}") as report:
            drawn = as_drawn(scene.scene)
            sweeps.append(bifurcation_diagram(drawn, swept.path, swept.values, upward=upward, report=report, **how))
    if scene.unknowns is not None:
        with session.working("sweeping with drawn laws"):
            for number, sweep in enumerate(sweeps):
                share = verdict_probability(scene.scene, swept.path, sweep, scene.unknowns, draws=draws, **how)
                sweeps[number] = sweep._replace(verdict_probability=share)
    ramps = Ramps(swept.path, sweeps, impacts)
    return Output.of(ramps, files={"bifurcation.png": picture_of("dynamics:bifurcation_figure", ramps, ordinate)})
