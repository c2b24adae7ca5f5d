"""`afm-jax chart SCENE.toml --x P=a:b:n --y P=a:b:n --orders 8`: which single-impact orbits there are, over a plane."""

from dataclasses import replace
from typing import Annotated

from click import IntRange

from afm_jax.cli.command import Output
from afm_jax.cli.scenes import NamedScene, ranges_of, refuse_other_than_law
from afm_jax.cli.session import Session
from afm_jax.dynamics.charts import stability_chart, stable_probability

_MOST_POINTS = 4_000_000


def chart(
    session: Session,
    scene: NamedScene,
    *,
    x: Annotated[str, "P=a:b:n"],
    y: Annotated[str, "P=a:b:n"],
    orders: Annotated[int, IntRange(1, 100)] = 8,
    draws: Annotated[int, IntRange(2)] = 20,
) -> Output:
    """Chart the single-impact orbits that exist, are stable and coexist, over two parameters of a scene.

    The output says for every point and order whether an orbit is admissible and whether one is stable. For the stable
    one (the highest, if there are several) it gives the peak amplitude and the size of the larger multiplier. With
    --law also the fraction of the fit's draws in which an orbit is stable. With --out chart.csv and a picture. Exit
    code 3 if there is no admissible orbit at all.

    Args:
        session: for progress.
        scene: the scene.
        x: a parameter of the scene file: the chart's columns.
        y: a second one: the chart's rows.
        orders: highest order N.
        draws: laws drawn from the fit for the bands.
    """
    refuse_other_than_law(scene)
    across, up = ranges_of(scene, [x, y], counted=True)
    if len(across.values) * len(up.values) > _MOST_POINTS:
        raise ValueError(f"{across} and {up} are more than {_MOST_POINTS} points: chart fewer")
    with session.working("searching for orbits (the first run compiles for some seconds)", "points") as report:
        result = stability_chart(scene.scene, x_values=across, y_values=up, last_order=orders, report=report)
        if scene.unknowns is not None:
            probability = stable_probability(scene.scene, result, scene.unknowns, (across.path, up.path), draws=draws)
            result = replace(result, probability=probability)
    return Output.of(result, "chart")
