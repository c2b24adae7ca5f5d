"""`afm-jax lyapunov SCENE.toml`: the Lyapunov exponents of a motion, or of one for each value of a parameter."""

from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.fitted_law import with_fitted_law, with_law_options
from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import SceneName, ranges_of, scene_and_start, with_picture
from afm_jax.words import with_error

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from afm_jax.apparatus.scene import Scene
    from afm_jax.dynamics.exponents import Lyapunov

COLUMNS = (
    "exponent_per_impact",
    "second_exponent_per_impact",
    "exponent_per_impact_error",
    "exponent_per_us",
    "second_exponent_per_us",
    "impacts",
    "near_grazing",
    "rested",
    "verdict",
)
BAND = ("exponent_per_impact_low", "exponent_per_impact_high")
"""With --law: between which 95 % of the draws lie."""


@click.command()
@click.argument("scene", metavar="SCENE.toml|PRESET", type=SceneName())
@click.option("--impacts", type=click.IntRange(20), default=2000, show_default=True, help="Impacts to average over.")
@click.option("--transient", type=click.IntRange(0), default=500, show_default=True, help="Impacts before.")
@click.option("--parameter", metavar="P=a:b:n", help="A parameter of the scene file and its values, one motion each.")
@with_law_options
@with_picture
@with_session
def command(  # noqa: PLR0913
    session: Session,
    *,
    scene: str,
    impacts: int,
    transient: int,
    parameter: str | None,
    law: "Path | None",
    draws: int,
    picture: str,
) -> None:
    """Compute Lyapunov exponents by QR of the impact map's exact Jacobians; a contact's come from its simulation.

    Of a motion that has come to an orbit they are the logarithms of its multipliers. A tip that rests on the platform
    forgets its start: its exponents are minus infinity, null in JSON. Begins at the file's [start]; without one on the
    stable single-impact orbit of the order nearest to resonance, if there is one, else leaving the platform upward.
    With --law there is a band for the larger one, begun without [start]. With --out lyapunov.csv, and with --parameter
    a picture. Exit code 3 where every motion ends before enough impacts.
    """
    session.start_computing()

    from afm_jax.dynamics.exponents import exponent_verdicts, lyapunov_spectrum  # noqa: PLC0415
    from afm_jax.dynamics.motion_bands import drawn_exponents  # noqa: PLC0415
    from afm_jax.motion.start import start_of  # noqa: PLC0415
    from afm_jax.scenefile.parameter_paths import scene_batch  # noqa: PLC0415
    from afm_jax.scenefile.scenefile import scene_tables  # noqa: PLC0415

    loaded, told = scene_and_start(scene)
    loaded, known = with_fitted_law(loaded, law)
    ranges = ranges_of(scene, loaded, [parameter] if parameter else [], counted=True)
    given = {one.path: one.values for one in ranges}
    try:
        motions = scene_batch(loaded, given) if given else loaded
        start = None if told is None else start_of(motions, told)
        with session.working("following the motion (the first run compiles for some seconds)", "motions") as report:
            found = lyapunov_spectrum(
                motions,
                start,
                impacts=impacts,
                transient=transient,
                report=report,
            )
            band = None
            if known is not None:
                band = drawn_exponents(loaded, given, known, draws=draws, impacts=impacts, transient=transient)
    except ValueError as error:
        raise ValueError(f"{scene}: {error}") from error
    many = found if given else _as_batch(found)
    verdicts = exponent_verdicts(many)
    rows = _rows(many, verdicts)
    columns = COLUMNS
    if band is not None:
        columns = (*COLUMNS, *BAND)
        rows = [row | dict(zip(BAND, pair, strict=True)) for row, pair in zip(rows, band.tolist(), strict=True)]
    if given:
        path = ranges[0].path
        rows = [{path: value} | row for value, row in zip(given[path].tolist(), rows, strict=True)]
        columns = (path, *columns)
    session.write_table("lyapunov.csv", rows, columns)
    if session.out is not None and given:
        from afm_jax.plots.dynamics import draw_exponents  # noqa: PLC0415

        target = session.out / f"lyapunov.{picture}"
        draw_exponents(ranges[0].path, given[ranges[0].path], many.exponents_per_impact, target, band)
        session.note(f"wrote {target}")
    payload = _payload(found, loaded, verdicts if given else verdicts[0]) | {"scene": scene_tables(loaded)}
    if band is not None:
        payload |= {"draws": draws, "exponent_per_impact_interval95": band if given else band[0]}
    reason = payload["reason"] = _why_none(many, verdicts)
    if given:
        payload |= {"parameter": ranges[0].path, "values": given[ranges[0].path]}
        session.emit(payload, _summary(many, str(ranges[0])), payload["extrapolated"])
    else:
        drawn = (
            [] if band is None else ["the larger per impact: {:.6g} to {:.6g} in 95 % of the draws".format(*band[0])]
        )
        session.emit(payload, *_text(found, verdicts[0]), *drawn, payload["extrapolated"])
    if reason is not None:
        raise NotValid(reason)


def _why_none(found: "Lyapunov", verdicts: list[str]) -> str | None:
    """Return why there are no exponents at all; None where there are some."""
    import numpy as np  # noqa: PLC0415

    if not np.isnan(found.exponents_per_impact[:, 0]).all():
        return None
    words = "; ".join(dict.fromkeys(verdicts))
    most = "at most " if len(verdicts) > 1 else ""
    return f"{words}; there were {most}{int(found.impacts.max())} impacts to average over"


def _as_batch(found: "Lyapunov") -> "Lyapunov":
    import jax  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    return jax.tree.map(lambda part: np.asarray(part)[None], found)


def _payload(found: "Lyapunov", scene: "Scene", verdict: Any) -> dict[str, Any]:
    from afm_jax.impact.law import extrapolation_of  # noqa: PLC0415

    return {
        "exponents_per_us": found.exponents_per_us,
        "exponents_per_impact": found.exponents_per_impact,
        "exponents_per_us_error": found.exponents_per_us_error,
        "exponents_per_impact_error": found.exponents_per_impact_error,
        "mean_log_determinant": found.mean_log_determinant,
        "impacts": found.impacts,
        "near_grazing": found.near_grazing,
        "rested": found.rested,
        "orbit": {"impacts": found.verdicts.impacts, "periods": found.verdicts.periods},
        "verdict": verdict,
        "extrapolated": extrapolation_of(scene.interaction, found.approach_speed_nm_per_us),
    }


def _rows(found: "Lyapunov", verdicts: list[str]) -> list[dict[str, Any]]:
    columns = {
        "exponent_per_impact": found.exponents_per_impact[:, 0],
        "second_exponent_per_impact": found.exponents_per_impact[:, 1],
        "exponent_per_impact_error": found.exponents_per_impact_error[:, 0],
        "exponent_per_us": found.exponents_per_us[:, 0],
        "second_exponent_per_us": found.exponents_per_us[:, 1],
        "impacts": found.impacts,
        "near_grazing": found.near_grazing,
        "rested": found.rested,
        "verdict": verdicts,
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _text(found: "Lyapunov", verdict: str) -> list[str]:
    def pair(values: "np.ndarray", errors: "np.ndarray") -> str:
        found = zip(values, errors, strict=True)
        return ", ".join(with_error(value, error) if error > 0.0 else f"{value:.6g}" for value, error in found)

    lines = [
        f"Lyapunov exponents per impact: {pair(found.exponents_per_impact, found.exponents_per_impact_error)}",
        f"                       per us: {pair(found.exponents_per_us, found.exponents_per_us_error)}",
        f"{int(found.impacts)} impacts; {verdict}",
    ]
    if found.near_grazing:
        lines.append(f"{int(found.near_grazing)} impacts are near grazing, where the map's slopes grow without bound")
    return lines


def _summary(found: "Lyapunov", what: str) -> str:
    import numpy as np  # noqa: PLC0415

    larger, error = found.exponents_per_impact[:, 0], found.exponents_per_impact_error[:, 0]
    from afm_jax.dynamics.exponents import CHAOTIC_ERRORS  # noqa: PLC0415

    positive = int(np.sum(np.isfinite(larger) & (larger > CHAOTIC_ERRORS * error)))
    return (
        f"{what}: the larger exponent is positive at {positive} values, negative or undecided at "
        f"{int(np.sum(~np.isnan(larger))) - positive}, unknown at {int(np.sum(np.isnan(larger)))}"
    )
