"""`afm-jax chart SCENE.toml --x P=a:b:n --y P=a:b:n --orders 8`: which single-impact orbits there are, over a plane."""

from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.fitted_law import with_fitted_law, with_law_options
from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import SceneName, ranges_of, scene_and_start, with_picture
from afm_jax.whole_files import whole_folder

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from afm_jax.dynamics.charts import StabilityChart
    from afm_jax.scenefile.parameter_paths import ParameterRange

_MOST_POINTS = 4_000_000


@click.command()
@click.argument("scene", metavar="SCENE.toml|PRESET", type=SceneName())
@click.option("--x", metavar="P=a:b:n", required=True, help="A parameter of the scene file: the chart's columns.")
@click.option("--y", metavar="P=a:b:n", required=True, help="Another one: its rows.")
@click.option("--orders", type=click.IntRange(1, 100), default=8, show_default=True, help="Highest order N.")
@click.option(
    "--zarr", is_flag=True, help="Write the table as chart.zarr instead of chart.csv; needs the extra `zarr`."
)
@with_law_options
@with_picture
@with_session
def command(  # noqa: PLR0913
    session: Session,
    *,
    scene: str,
    x: str,
    y: str,
    orders: int,
    zarr: bool,
    law: "Path | None",
    draws: int,
    picture: str,
) -> None:
    """Chart over two parameters of a scene which single-impact orbits exist, are stable and coexist.

    Of every point and order: whether an orbit is admissible, whether one is stable, and of the stable one (the highest,
    if there are several) the peak amplitude and the size of the larger multiplier. A contact's orbits are closed by
    simulation from those of the law closest to it: chart a thousand points, not a million; where none closes the point
    is unresolved. With --law the share of the fit's draws in which an orbit is stable is told too. With --out a table
    (chart.csv or chart.zarr) and a picture. Exit code 3 if there is no admissible orbit at all.
    """
    if zarr:
        # said before the computation, not after it
        import zarr as _  # noqa: PLC0415
    session.start_computing()
    from afm_jax.dynamics.charts import stability_chart, stable_probability  # noqa: PLC0415
    from afm_jax.impact.law import extrapolation_of  # noqa: PLC0415
    from afm_jax.scenefile.parameter_paths import scene_family  # noqa: PLC0415
    from afm_jax.scenefile.scenefile import scene_tables  # noqa: PLC0415

    loaded, _ = scene_and_start(scene)
    loaded, known = with_fitted_law(loaded, law)
    across, up = ranges = ranges_of(scene, loaded, [x, y], counted=True)
    if len(across.values) * len(up.values) > _MOST_POINTS:
        raise ValueError(f"{across} and {up} are more than {_MOST_POINTS} points: chart fewer")
    try:
        with session.working("searching for orbits (the first run compiles for some seconds)", "points") as report:
            chart = stability_chart(
                scene_family(loaded, across.path, up.path),
                x_values=across.values,
                y_values=up.values,
                last_order=orders,
                report=report,
            )
            probability = None
            if known is not None:
                probability = stable_probability(loaded, chart, known, (across.path, up.path), draws=draws)
    except ValueError as error:
        raise ValueError(f"{scene}: {error}") from error
    if session.out is not None:
        _write(session, chart, across, up, probability, zarr=zarr)
        from afm_jax.plots.dynamics import draw_chart  # noqa: PLC0415

        target: Path = session.out / f"chart.{picture}"
        draw_chart(across.path, up.path, chart, target, probability)
        session.note(f"wrote {target}")
    verdicts = chart.verdicts
    several = verdicts.stable.sum(axis=0) > 1
    payload: dict[str, Any] = {
        "scene": scene_tables(loaded),
        "x": {"parameter": across.path, "low": across.low, "high": across.high, "number": across.number},
        "y": {"parameter": up.path, "low": up.low, "high": up.high, "number": up.number},
        "orders": list(range(1, orders + 1)),
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
    reason = None if verdicts.admissible.any() else _why_none(ranges, orders)
    lines = [
        f"order {order}: stable at {100.0 * stable:.4g} % of the points, admissible at {100.0 * admissible:.4g} %"
        for order, stable, admissible in zip(
            payload["orders"], payload["stable_share"], payload["admissible_share"], strict=True
        )
    ]
    lines.append(f"several orders are stable at {100.0 * payload['several_stable_share']:.4g} % of the points")
    beyond = extrapolation_of(loaded.interaction, verdicts.approach_speed_nm_per_us)
    session.emit(payload | {"extrapolated": beyond, "reason": reason}, *lines, beyond)
    if reason is not None:
        raise NotValid(reason)


def _why_none(ranges: "list[ParameterRange]", orders: int) -> str:
    return (
        f"no single-impact orbit of an order up to {orders} is admissible over {ranges[0]} and {ranges[1]}: "
        "try larger drive amplitudes, or more orders"
    )


def _write(
    session: Session,
    chart: "StabilityChart",
    across: "ParameterRange",
    up: "ParameterRange",
    probability: "np.ndarray | None",
    *,
    zarr: bool,
) -> None:
    """Write a row a point, or arrays over orders, rows and columns."""
    verdicts = chart.verdicts
    parts = {
        "admissible": verdicts.admissible,
        "stable": verdicts.stable,
        "peak_amplitude_nm": verdicts.peak_amplitude_nm,
        "largest_multiplier": verdicts.largest_multiplier,
    }
    if verdicts.unresolved is not None:
        parts["unresolved"] = verdicts.unresolved
    if probability is not None:
        parts["stable_probability"] = probability
    if zarr:
        import numpy as np  # noqa: PLC0415
        import zarr as store  # noqa: PLC0415

        assert session.out is not None  # asked before  # noqa: S101
        axes = {"order": np.arange(1, chart.orders + 1), "y": chart.y_values, "x": chart.x_values}
        with whole_folder(session.out / "chart.zarr") as fresh:
            group = store.open_group(str(fresh), mode="w")
            for name, part in parts.items():
                whole = part.reshape([len(values) for values in axes.values()])
                group.create_array(name, data=whole, dimension_names=tuple(axes))
            for name, values in axes.items():
                group.create_array(name, data=values, dimension_names=(name,))
            group.attrs["x"], group.attrs["y"] = across.path, up.path
        session.note(f"wrote {session.out / 'chart.zarr'}")
        return
    x, y = chart.points()
    columns: dict[str, Any] = {across.path: x, up.path: y, "lowest_stable_order": chart.lowest_stable_order.ravel()}
    for order in range(chart.orders):
        columns |= {f"{name}_{order + 1}": part[order] for name, part in parts.items()}
    session.write_columns("chart.csv", columns)
