"""What `afm-jax effects` tells of a study: the JSON object, a table to print with its sentences, and the CSV file."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from rich.table import Table

from afm_jax.columns import Cell, columns_of, printed_table
from afm_jax.effects.study import Change, Cost, EffectReport, EffectStudy, periods_read
from afm_jax.results import Result
from afm_jax.scenefile.scenefile import scene_tables
from afm_jax.units import RAD_PER_US_PER_KHZ
from afm_jax.words import counted, known

_COSTS = ("time_us_per_period", "operations", "transcendentals")


@dataclass(frozen=True)
class EffectTable:
    """The effects of a scene, one a row."""

    study: EffectStudy

    text, plot = Result.text, Result.plot
    _picture = "afm_jax.plots.effects:effects_figure"

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of `afm-jax effects`."""
        return self._told

    @cached_property
    def _told(self) -> dict[str, Any]:
        study = self.study
        reading, orbit, reduction = study.observed.reading, study.observed.orbit, study.reduction
        assert reading is not None  # a study has one  # noqa: S101
        left_out = () if reduction is None else reduction.left_out
        frequency = study.view.drive.angular_frequency / RAD_PER_US_PER_KHZ
        told = {
            "duration_us": study.view.duration_us,
            "compared": "steady orbits" if orbit is not None else "last fifth of the duration",
            "full": {
                **reading._asdict(),
                "lockin_frequency_khz": frequency / periods_read(study.scene, orbit),
                "drive_periods": None if orbit is None else orbit.periods,
                "contraction": None if orbit is None else orbit.contraction,
                **_cost(study.cost),
            },
            "effects": [
                _effect(report, study.cost, needed=report.effect.name not in left_out) for report in study.effects
            ],
        }
        if reduction is None:
            return told | {"accuracy": None, "not_needed": [], "joint_change": None, "reduced": None}
        return told | {
            "accuracy": reduction.accuracy,
            "not_needed": list(left_out),
            "joint_change": reduction.change._asdict(),
            "reduced": {"scene": scene_tables(reduction.scene), "file": None, **_cost(reduction.cost)},
        }

    def printed(self) -> list[str | Table]:
        """Return what `afm-jax effects` prints: the full scene, a table of effects, and which are not needed."""
        told = self.to_dict()
        cells: dict[str, Cell] = {
            "effect": "name",
            "peak\nchange": lambda effect: _percent(effect["change"]["peak_amplitude"]),
            "lock-in\nchange": lambda effect: _percent(effect["change"]["lockin_amplitude"]),
            "phase\ndeg": lambda effect: known(effect["change"]["lockin_phase_deg"]),
            "loss/impact\nchange": lambda effect: _percent(effect["change"]["energy_per_impact"]),
            "time\nus/period": "time_us_per_period:.4g",
            "saved": _saved_time,
            "operations\nsaved": "saved_operations:.0f",
            "": _remark,
        }
        table = printed_table("Without the effect", cells, told["effects"])
        return [_of_full(told), table, *_sentences(told)]

    def tables(self) -> dict[str, dict[str, Any]]:
        """Return the columns of effects.csv, a row an effect."""
        rows = [
            {**effect, **{f"change_{name}": value for name, value in effect["change"].items()}}
            for effect in self.to_dict()["effects"]
        ]
        columns = (
            *("name", "description", "strength", "required", "zero_strength", "needed"),
            *(f"change_{name}" for name in Change._fields),
            *_COSTS,
            *(f"saved_{name}" for name in _COSTS),
            *("saved_time_scatter_us", "reason"),
        )
        return {"effects.csv": columns_of(rows, columns)}


def _effect(report: EffectReport, full: Cost, *, needed: bool) -> dict[str, Any]:
    """Return what is told of the effect; the cost of the full scene says what leaving it out saves."""
    effect, whole = report.effect, _cost(full)
    cost = _cost(report.cost)
    saved = {f"saved_{name}": _less(whole[name], spent) for name, spent in cost.items()}
    return {
        "name": effect.name,
        "description": effect.sentence,
        "strength": effect.strength or None,
        "required": effect.required is not None,
        "zero_strength": effect.is_zero,
        "needed": needed,
        "change": report.change._asdict(),
        "reason": report.reason,
        **cost,
        **saved,
        "saved_time_scatter_us": None if report.cost is None else math.hypot(full.scatter_us, report.cost.scatter_us),
    }


def _cost(cost: Cost | None) -> dict[str, float | None]:
    """Return a cost by the keys of the JSON object."""
    numbers = (None, None, None) if cost is None else (cost.time_us, *cost.program)
    return dict(zip(_COSTS, numbers, strict=True))


def _less(whole: float | None, part: float | None) -> float | None:
    return None if whole is None or part is None else whole - part


def _of_full(told: Mapping[str, Any]) -> str:
    full = told["full"]
    motion = (
        f"steady orbit, {counted(full['impacts'], 'impact')} in {counted(full['drive_periods'], 'drive period')}"
        if full["drive_periods"] is not None
        else f"no steady orbit, {full['impacts']} impacts in the {told['compared']}"
    )
    lost = full["energy_per_impact_aj"]
    lockin = f"lock-in at {full['lockin_frequency_khz']:.6g} kHz {full['lockin_amplitude_nm']:.5g} nm"
    return (
        f"Full scene: {motion}; peak {full['peak_amplitude_nm']:.5g} nm, {lockin} "
        f"at {full['lockin_phase_deg']:.4g} deg{f', {lost:.4g} aJ lost per impact' if lost is not None else ''}; "
        f"{known(full['time_us_per_period'], '.4g')} us of processor time per drive period, "
        f"{full['operations']:.0f} operations."
    )


def _saved_time(effect: Mapping[str, Any]) -> str:
    saved, scatter = effect["saved_time_us_per_period"], effect["saved_time_scatter_us"]
    return "within timing noise" if saved and abs(saved) <= scatter else known(saved)


def _remark(effect: Mapping[str, Any]) -> str:
    if effect["required"]:
        return "required"
    if effect["zero_strength"]:
        return "without effect: its strength is zero"
    if effect["change"]["peak_amplitude"] is None:
        return "no steady motion"
    return "" if effect["needed"] else "not needed"


def _sentences(told: Mapping[str, Any]) -> Iterator[str]:
    for effect in told["effects"]:
        if effect["reason"] is not None:
            yield f"{effect['name']}: {'' if effect['required'] else 'without it: '}{effect['reason']}."
    if told["accuracy"] is None:
        return
    wanted, left_out = f"{100.0 * told['accuracy']:g} %", told["not_needed"]
    if not left_out:
        yield f"For amplitudes to {wanted} every effect that can be left out is needed."
        return
    joint = told["joint_change"]
    yield (
        f"For amplitudes to {wanted} these are not needed: {', '.join(left_out)}. Without all of them the peak changes "
        f"by {_percent(joint['peak_amplitude'])}, the lock-in amplitude by {_percent(joint['lockin_amplitude'])}; "
        f"{known(told['reduced']['time_us_per_period'], '.4g')} us per drive period."
    )


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:+z.3g} %"
