"""`afm-jax effects SCENE.toml|PRESET`: what each effect of a scene changes and costs."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from afm_jax.cli.columns import TableColumn, columns_of, printed_table
from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.effects.study import Cost, EffectReport, EffectStudy, Reduction, periods_read, study_effects
from afm_jax.motion.start import default_start, start_of
from afm_jax.scenefile.scenefile import Start, as_in_file, save_scene, scene_tables
from afm_jax.units import RAD_PER_US_PER_KHZ
from afm_jax.words import counted, known

CHANGES = ("peak_amplitude", "lockin_amplitude", "lockin_phase_deg", "energy_per_impact")
"""What is compared; all but the phase relative to the full scene."""
COSTS = ("time_us_per_period", "operations", "transcendentals")
COLUMNS = (
    "name",
    "description",
    "strength",
    "required",
    "zero_strength",
    "needed",
    *(f"change_{name}" for name in CHANGES),
    *COSTS,
    *(f"saved_{name}" for name in COSTS),
    "reason",
)
"""The columns of effects.csv, and the keys of an effect in the JSON object but for the nested ones."""


def effects(
    session: Session,
    scene: NamedScene,
    *,
    accuracy: float,
    duration_us: float | None,
    only: str | None,
    write: Path | None,
) -> Output:
    """Return what each effect of a scene changes and costs; with ``write`` save the scene without the others."""
    with session.working(
        "simulating with and without each effect (every program compiles for some seconds)", "scenes"
    ) as report:
        start = scene.start or as_in_file(scene.scene, default_start(scene.scene))
        study = study_effects(
            scene.scene,
            start_of(scene.scene, start),
            duration_us=duration_us,
            accuracy=accuracy,
            only=None if only is None else [name.strip() for name in only.split(",")],
            report=report,
        )
    if write is not None and study.reduction is not None:
        save_scene(study.reduction.scene, write, start=start)
        session.note(f"wrote {write}")
    payload = payload_of(study, start, written=write)
    return Output(
        payload=payload,
        text=[_of_full(payload), _table(payload["effects"]), *_sentences(payload)],
        tables={"effects.csv": columns_of([_flat(effect) for effect in payload["effects"]], COLUMNS)},
        files={
            "effects.png": picture_of(
                "effects:effects_figure", payload["effects"], payload["full"], payload["accuracy"]
            )
        },
        json_file="effects.json",
    )


def payload_of(study: EffectStudy, start: Start, *, written: Path | None) -> dict[str, Any]:
    """Return the JSON object of a study."""
    reading, orbit = study.observed.reading, study.observed.orbit
    assert reading is not None  # a study has one  # noqa: S101
    left_out = () if study.reduction is None else study.reduction.left_out
    return {
        "scene": scene_tables(study.scene),
        "start": start._asdict(),
        "duration_us": study.view.duration_us,
        "compared": "steady orbits" if orbit is not None else "last fifth of the duration",
        "full": {
            **reading._asdict(),
            "lockin_frequency_khz": study.view.drive.angular_frequency
            / RAD_PER_US_PER_KHZ
            / periods_read(study.scene, orbit),
            "drive_periods": None if orbit is None else orbit.periods,
            "contraction": None if orbit is None else orbit.contraction,
            **_cost(study.cost),
        },
        "effects": [_effect(report, study.cost, left_out) for report in study.effects],
        **_reduction(study.reduction, written),
    }


def _effect(report: EffectReport, full: Cost, left_out: tuple[str, ...]) -> dict[str, Any]:
    effect = report.effect
    cost, whole = _cost(report.cost), _cost(full)
    return {
        "name": effect.name,
        "description": effect.sentence,
        "strength": effect.strength or None,
        "required": effect.required is not None,
        "zero_strength": effect.is_zero,
        "needed": effect.name not in left_out,
        "change": report.change._asdict(),
        "reason": report.reason,
        **cost,
        **{f"saved_{name}": _saved(whole[name], cost[name]) for name in COSTS},
    }


def _cost(cost: Cost | None) -> dict[str, float | None]:
    if cost is None:
        return dict.fromkeys(COSTS)
    return dict(zip(COSTS, (cost.time_us, *cost.program), strict=True))


def _saved(whole: float | None, cost: float | None) -> float | None:
    return None if whole is None or cost is None else whole - cost


def _reduction(reduction: Reduction | None, written: Path | None) -> dict[str, Any]:
    if reduction is None:
        return {"accuracy": None, "not_needed": [], "joint_change": None, "reduced": None}
    return {
        "accuracy": reduction.accuracy,
        "not_needed": list(reduction.left_out),
        "joint_change": reduction.change._asdict(),
        "reduced": {"scene": scene_tables(reduction.scene), "file": written, **_cost(reduction.cost)},
    }


def _flat(effect: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of effects.csv."""
    return {**effect, **{f"change_{name}": effect["change"][name] for name in CHANGES}}


def _table(effects: Sequence[Mapping[str, Any]]) -> Table:
    """Return what the scene without each effect changes and costs, as a table to print."""

    def change(heading: str, name: str) -> TableColumn:
        return TableColumn(heading, lambda effect: _percent(effect["change"][name]), "")

    columns = [
        TableColumn("effect", "name", "", left=True),
        change("peak\nchange", "peak_amplitude"),
        change("lock-in\nchange", "lockin_amplitude"),
        TableColumn("phase\ndeg", lambda effect: effect["change"]["lockin_phase_deg"], ".3g"),
        change("loss/impact\nchange", "energy_per_impact"),
        TableColumn("time\nus/period", "time_us_per_period", ".4g"),
        TableColumn("saved", "saved_time_us_per_period", ".3g"),
        TableColumn("operations\nsaved", "saved_operations", ".0f"),
        TableColumn("", _remark, "", left=True),
    ]
    return printed_table("Without the effect", columns, effects)


def _of_full(payload: Mapping[str, Any]) -> str:
    full = payload["full"]
    motion = (
        f"steady orbit, {counted(full['impacts'], 'impact')} in {counted(full['drive_periods'], 'drive period')}"
        if full["drive_periods"] is not None
        else f"no steady orbit, {full['impacts']} impacts in the {payload['compared']}"
    )
    lost = full["energy_per_impact_aj"]
    lockin = f"lock-in at {full['lockin_frequency_khz']:.6g} kHz {full['lockin_amplitude_nm']:.5g} nm"
    return (
        f"Full scene: {motion}; peak {full['peak_amplitude_nm']:.5g} nm, {lockin} "
        f"at {full['lockin_phase_deg']:.4g} deg{f', {lost:.4g} aJ lost per impact' if lost is not None else ''}; "
        f"{known(full['time_us_per_period'], '.4g')} us of processor time per drive period, "
        f"{full['operations']:.0f} operations."
    )


def _remark(effect: Mapping[str, Any]) -> str:
    if effect["required"]:
        return "required"
    if effect["zero_strength"]:
        return "without effect: its strength is zero"
    if effect["change"]["peak_amplitude"] is None:
        return "no steady motion"
    return "" if effect["needed"] else "not needed"


def _sentences(payload: Mapping[str, Any]) -> Iterator[str]:
    for effect in payload["effects"]:
        if effect["reason"] is not None:
            yield f"{effect['name']}: {'' if effect['required'] else 'without it: '}{effect['reason']}."
    if payload["accuracy"] is None:
        return
    wanted, left_out = f"{100.0 * payload['accuracy']:g} %", payload["not_needed"]
    if not left_out:
        yield f"For amplitudes to {wanted} every effect that can be left out is needed."
        return
    joint = payload["joint_change"]
    yield (
        f"For amplitudes to {wanted} these are not needed: {', '.join(left_out)}. Without all of them the peak changes "
        f"by {_percent(joint['peak_amplitude'])}, the lock-in amplitude by {_percent(joint['lockin_amplitude'])}; "
        f"{known(payload['reduced']['time_us_per_period'], '.4g')} us per drive period."
    )


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:+z.3g} %"
