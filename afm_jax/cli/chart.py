"""`afm-jax chart SCENE.toml --x P=a:b:n --y P=a:b:n --orders 8`: which single-impact orbits there are, over a plane."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.dynamics.charts import StabilityChart, stability_chart, stable_probability
from afm_jax.scenefile.parameter_paths import ParameterRange, scene_family
from afm_jax.scenefile.scenefile import scene_tables
from afm_jax.whole_files import whole_folder

_MOST_POINTS = 4_000_000


def chart(  # noqa: PLR0913
    session: Session, scene: NamedScene, *, x: str, y: str, orders: int, zarr: bool, draws: int, picture: str
) -> Output:
    """Return which single-impact orbits are stable over a plane of two parameters of a scene."""
    across, up = ranges_of(scene.name, scene.scene, [x, y], counted=True)
    if len(across.values) * len(up.values) > _MOST_POINTS:
        raise ValueError(f"{across} and {up} are more than {_MOST_POINTS} points: chart fewer")
    probability = None
    with session.working("searching for orbits (the first run compiles for some seconds)", "points") as report:
        result = stability_chart(
            scene_family(scene.scene, across.path, up.path),
            x_values=across.values,
            y_values=up.values,
            last_order=orders,
            report=report,
        )
        if scene.unknowns is not None:
            paths = (across.path, up.path)
            probability = stable_probability(scene.scene, result, scene.unknowns, paths, draws=draws)
    payload = _payload(scene, result, across, up, probability, draws)
    arrays, speeds = _arrays(result, probability), result.verdicts.approach_speed_nm_per_us
    return Output(
        payload=payload,
        text=_lines(payload),
        impact_speeds=() if speeds is None else speeds,
        tables={} if zarr else {"chart.csv": _columns(result, across.path, up.path, arrays)},
        files={
            **({"chart.zarr": partial(_write_zarr, result, across.path, up.path, arrays)} if zarr else {}),
            f"chart.{picture}": picture_of("dynamics:chart_figure", result, across.path, up.path, probability),
        },
        not_valid=payload["reason"],
    )


def _payload(
    scene: NamedScene,
    result: StabilityChart,
    across: ParameterRange,
    up: ParameterRange,
    probability: np.ndarray | None,
    draws: int,
) -> dict[str, Any]:
    verdicts = result.verdicts
    several = verdicts.stable.sum(axis=0) > 1
    payload: dict[str, Any] = {
        "scene": scene_tables(scene.scene),
        **{
            axis: {"parameter": swept.path, "low": swept.low, "high": swept.high, "number": swept.number}
            for axis, swept in (("x", across), ("y", up))
        },
        "orders": list(range(1, result.orders + 1)),
        "points": int(several.size),
        "admissible_share": verdicts.admissible.mean(axis=1),
        "stable_share": verdicts.stable.mean(axis=1),
        "any_stable_share": float(verdicts.any_stable().mean()),
        "several_stable_share": float(several.mean()),
    }
    if verdicts.unresolved is not None:
        payload["unresolved_share"] = verdicts.unresolved.mean(axis=1)
    if probability is not None:
        payload["draws"] = draws
        payload["uncertain_share"] = ((probability > 0.0) & (probability < 1.0)).mean(axis=1)
    payload["reason"] = None
    if not verdicts.admissible.any():
        payload["reason"] = (
            f"no single-impact orbit of an order up to {result.orders} is admissible over {across} and {up}: "
            "try larger drive amplitudes, or more orders"
        )
    return payload


def _lines(payload: dict[str, Any]) -> list[str]:
    shares = zip(payload["orders"], payload["stable_share"], payload["admissible_share"], strict=True)
    return [
        *(
            f"order {order}: stable at {100.0 * stable:.4g} % of the points, admissible at {100.0 * admissible:.4g} %"
            for order, stable, admissible in shares
        ),
        f"several orders are stable at {100.0 * payload['several_stable_share']:.4g} % of the points",
    ]


def _arrays(result: StabilityChart, probability: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return what is written of every order and point, (orders, points)."""
    names = ("admissible", "stable", "peak_amplitude_nm", "largest_multiplier", "unresolved")
    arrays = {name: getattr(result.verdicts, name) for name in names}
    arrays["stable_probability"] = probability
    return {name: array for name, array in arrays.items() if array is not None}


def _columns(result: StabilityChart, x: str, y: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the columns of a table with a row a point."""
    across, up = result.points()
    columns: dict[str, Any] = {x: across, y: up, "lowest_stable_order": result.lowest_stable_order.ravel()}
    for order in range(result.orders):
        columns |= {f"{name}_{order + 1}": array[order] for name, array in arrays.items()}
    return columns


def _write_zarr(result: StabilityChart, x: str, y: str, arrays: dict[str, np.ndarray], path: Path) -> None:
    """Write arrays over orders, rows and columns as a Zarr store."""
    import zarr  # noqa: PLC0415 (an extra package, which --zarr alone needs)

    axes = {"order": np.arange(1, result.orders + 1), "y": result.y_values, "x": result.x_values}
    with whole_folder(path) as fresh:
        group = zarr.open_group(str(fresh), mode="w")
        for name, array in arrays.items():
            whole = array.reshape([len(values) for values in axes.values()])
            group.create_array(name, data=whole, dimension_names=tuple(axes))
        for name, values in axes.items():
            group.create_array(name, data=values, dimension_names=(name,))
        group.attrs["x"], group.attrs["y"] = x, y
