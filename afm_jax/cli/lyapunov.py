"""`afm-jax lyapunov SCENE.toml`: the Lyapunov exponents of a motion, or of one for each value of a parameter."""

from typing import Any

import jax
import numpy as np

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.dynamics.bands import drawn_exponents
from afm_jax.dynamics.exponents import CHAOTIC_ERRORS, Lyapunov, exponent_verdicts, lyapunov_spectrum
from afm_jax.motion.start import start_of
from afm_jax.scenefile.parameter_paths import scene_batch
from afm_jax.scenefile.scenefile import scene_tables
from afm_jax.words import with_error

_TOLD = (
    "exponents_per_us",
    "exponents_per_impact",
    "exponents_per_us_error",
    "exponents_per_impact_error",
    "mean_log_determinant",
    "impacts",
    "near_grazing",
    "rested",
)
"""What is told of a motion: attributes of `Lyapunov`."""


def lyapunov(
    session: Session,
    scene: NamedScene,
    *,
    impacts: int,
    transient: int,
    parameter: str | None,
    draws: int,
    picture: str,
) -> Output:
    """Return the Lyapunov exponents of a scene's motion, or of those along a parameter."""
    ranges = ranges_of(scene.name, scene.scene, [parameter] if parameter else [], counted=True)
    values = {swept.path: swept.values for swept in ranges}
    motions = scene_batch(scene.scene, values) if values else scene.scene
    start = None if scene.start is None else start_of(motions, scene.start)
    lengths = {"impacts": impacts, "transient": transient}
    band = None
    with session.working("following the motion (the first run compiles for some seconds)", "motions") as report:
        result = lyapunov_spectrum(motions, start, **lengths, report=report)
        if scene.unknowns is not None:
            band = drawn_exponents(scene.scene, values, scene.unknowns, draws=draws, **lengths)
    # without a parameter a batch of one motion
    many = result if values else jax.tree.map(lambda array: np.asarray(array)[None], result)
    verdicts = exponent_verdicts(many)
    payload = _payload(result, verdicts if values else verdicts[0])
    payload |= {"scene": scene_tables(scene.scene), "reason": _why_none(many, verdicts)}
    if band is not None:
        payload |= {"draws": draws, "exponent_per_impact_interval95": band if values else band[0]}
    files = {}
    if values:
        ((path, along),) = values.items()
        payload |= {"parameter": path, "values": along}
        text = [_summary(many, str(ranges[0]))]
        files[f"lyapunov.{picture}"] = picture_of("dynamics:exponents_figure", many, path, along, band)
    else:
        text = _text(result, verdicts[0])
        if band is not None:
            text.append("the larger per impact: {:.6g} to {:.6g} in 95 % of the draws".format(*band[0]))
    return Output(
        payload=payload,
        text=text,
        impact_speeds=result.approach_speed_nm_per_us,
        tables={"lyapunov.csv": {**values, **_columns(many, verdicts, band)}},
        files=files,
        not_valid=payload["reason"],
    )


def _why_none(spectrum: Lyapunov, verdicts: list[str]) -> str | None:
    """Return why there are no exponents at all; None where there are some."""
    if not np.isnan(spectrum.exponents_per_impact[:, 0]).all():
        return None
    words = "; ".join(dict.fromkeys(verdicts))
    most = "at most " if len(verdicts) > 1 else ""
    return f"{words}; there were {most}{int(spectrum.impacts.max())} impacts to average over"


def _payload(spectrum: Lyapunov, verdict: Any) -> dict[str, Any]:
    return {
        **{name: getattr(spectrum, name) for name in _TOLD},
        "orbit": {"impacts": spectrum.verdicts.impacts, "periods": spectrum.verdicts.periods},
        "verdict": verdict,
    }


def _columns(spectrum: Lyapunov, verdicts: list[str], band: np.ndarray | None) -> dict[str, Any]:
    columns = {
        "exponent_per_impact": spectrum.exponents_per_impact[:, 0],
        "second_exponent_per_impact": spectrum.exponents_per_impact[:, 1],
        "exponent_per_impact_error": spectrum.exponents_per_impact_error[:, 0],
        "exponent_per_us": spectrum.exponents_per_us[:, 0],
        "second_exponent_per_us": spectrum.exponents_per_us[:, 1],
        "impacts": spectrum.impacts,
        "near_grazing": spectrum.near_grazing,
        "rested": spectrum.rested,
        "verdict": verdicts,
    }
    if band is not None:
        columns |= {"exponent_per_impact_low": band[:, 0], "exponent_per_impact_high": band[:, 1]}
    return columns


def _text(spectrum: Lyapunov, verdict: str) -> list[str]:
    def pair(values: np.ndarray, errors: np.ndarray) -> str:
        pairs = zip(values, errors, strict=True)
        return ", ".join(with_error(value, error) if error > 0.0 else f"{value:.6g}" for value, error in pairs)

    lines = [
        f"Lyapunov exponents per impact: {pair(spectrum.exponents_per_impact, spectrum.exponents_per_impact_error)}",
        f"                       per us: {pair(spectrum.exponents_per_us, spectrum.exponents_per_us_error)}",
        f"{int(spectrum.impacts)} impacts; {verdict}",
    ]
    if spectrum.near_grazing:
        lines.append(
            f"{int(spectrum.near_grazing)} impacts are near grazing, where the map's slopes grow without bound"
        )
    return lines


def _summary(spectrum: Lyapunov, what: str) -> str:
    larger, error = spectrum.exponents_per_impact[:, 0], spectrum.exponents_per_impact_error[:, 0]
    positive = int(np.sum(np.isfinite(larger) & (larger > CHAOTIC_ERRORS * error)))
    return (
        f"{what}: the larger exponent is positive at {positive} values, negative or undecided at "
        f"{int(np.sum(~np.isnan(larger))) - positive}, unknown at {int(np.sum(np.isnan(larger)))}"
    )
