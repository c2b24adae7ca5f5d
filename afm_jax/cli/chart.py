"""`afm-jax chart SCENE.toml --x P=a:b:n --y P=a:b:n --orders 8`: which single-impact orbits there are, over a plane."""

from dataclasses import replace

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.dynamics.charts import stability_chart, stable_probability
from afm_jax.scenefile.parameter_paths import scene_family

_MOST_POINTS = 4_000_000


def chart(session: Session, scene: NamedScene, *, x: str, y: str, orders: int, draws: int) -> Output:
    """Return which single-impact orbits are stable over a plane of two parameters of a scene."""
    across, up = ranges_of(scene.name, scene.scene, [x, y], counted=True)
    if len(across.values) * len(up.values) > _MOST_POINTS:
        raise ValueError(f"{across} and {up} are more than {_MOST_POINTS} points: chart fewer")
    paths, values = (across.path, up.path), {"x_values": across.values, "y_values": up.values}
    with session.working("searching for orbits (the first run compiles for some seconds)", "points") as report:
        found = stability_chart(scene_family(scene.scene, *paths), **values, last_order=orders, report=report)
        result = replace(found, x=across, y=up)
        if scene.unknowns is not None:
            probability = stable_probability(scene.scene, result, scene.unknowns, paths, draws=draws)
            result = replace(result, probability=probability)
    files = {"chart.png": picture_of("dynamics:chart_figure", result)}
    return Output.of(result, files=files)
