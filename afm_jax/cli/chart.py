"""`afm-jax chart SCENE.toml --x P=a:b:n --y P=a:b:n --orders 8`: which single-impact orbits there are, over a plane."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.dynamics.charts import StabilityChart, stability_chart, stable_probability
from afm_jax.scenefile.parameter_paths import scene_family
from afm_jax.whole_files import whole_folder

_MOST_POINTS = 4_000_000


def chart(  # noqa: PLR0913
    session: Session, scene: NamedScene, *, x: str, y: str, orders: int, zarr: bool, draws: int, picture: str
) -> Output:
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
    files = {f"chart.{picture}": picture_of("dynamics:chart_figure", result, *paths, result.probability)}
    if not zarr:
        return Output.of(result, files=files)
    return Output.of(result, tables={}, files={"chart.zarr": partial(_write_zarr, result, *paths), **files})


def _write_zarr(result: StabilityChart, x: str, y: str, path: Path) -> None:
    """Write arrays over orders, rows and columns as a Zarr store."""
    import zarr  # noqa: PLC0415 (an extra package, which --zarr alone needs)

    axes = {"order": np.arange(1, result.orders + 1), "y": result.y_values, "x": result.x_values}
    with whole_folder(path) as fresh:
        group = zarr.open_group(str(fresh), mode="w")
        for name, array in result.arrays().items():
            whole = array.reshape([len(values) for values in axes.values()])
            group.create_array(name, data=whole, dimension_names=tuple(axes))
        for name, values in axes.items():
            group.create_array(name, data=values, dimension_names=(name,))
        group.attrs["x"], group.attrs["y"] = x, y
