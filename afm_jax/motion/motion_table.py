"""The output of `afm-jax simulate`: the JSON object, a summary in lines, contacts and the tip as columns."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from afm_jax.apparatus.scene import Scene
from afm_jax.contact.junction import Phase
from afm_jax.impact.law import extrapolation_of
from afm_jax.motion.follow import LongRun
from afm_jax.motion.observe import OBSERVABLES, Observables, why_absent
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation
from afm_jax.motion.settle import Window
from afm_jax.motion.trajectory import DensePath
from afm_jax.results import Result, known_columns

_WHOLE_PERIODS = 50
"""Drive periods up to which the whole simulation goes into trajectory.csv."""
_POINTS = 2001
"""Rows of trajectory.csv at equal steps of time."""
_MOST_NODES = 100_000
"""Rows of trajectory.csv within contacts, from which on only every second, third, ... is kept."""


class MotionTable(NamedTuple):
    """A scene that was followed, and what an instrument reads of it."""

    scene: Scene
    run: LongRun
    seen: Observables
    dense: DensePath
    """The tip over what is read and written of it."""
    settings: Mapping[str, Any]

    text = Result.text

    @property
    def reason(self) -> str | None:
        """Why the simulation broke off; None where it did not."""
        outcome = MotionOutcome(int(self.run.simulation.outcome))
        return None if outcome in (MotionOutcome.FINISHED, MotionOutcome.HELD) else outcome.sentence

    def _extrapolated(self) -> str | None:
        speeds = self.run.simulation.contacts.approach_speed_nm_per_us
        return extrapolation_of(self.scene.interaction, speeds)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of `afm-jax simulate`, without the scene; what is null has its reason beside it."""
        simulation, verdict, seen = self.run.simulation, self.run.verdict, self.seen
        outcome, final, deflection = MotionOutcome(int(simulation.outcome)), simulation.final, seen.deflection_harmonics
        extrapolated, reasons = self._extrapolated(), _reasons(self.scene, seen)
        if extrapolated is None:
            reasons["extrapolated"] = "No impact is faster or slower than the law is known for."
        return {
            "impacts": int(simulation.count),
            "stuck": verdict.stuck,
            "settled": verdict.settled,
            "order": verdict.periods,
            "contacts_per_response": verdict.contacts,
            "settled_reason": verdict.reason,
            "remaining_distance": verdict.remaining,
            **{observable.name: getattr(seen, observable.name) for observable in OBSERVABLES},
            "drive_frequency_khz": seen.drive_frequency_khz,
            "response_frequency_khz": seen.response_frequency_khz,
            "harmonics": [harmonic._asdict() for harmonic in seen.harmonics],
            "deflection_harmonics": deflection and [harmonic._asdict() for harmonic in deflection],
            "window": {**seen.window._asdict(), "contacts": seen.contacts},
            "null_reasons": reasons,
            "start": {name: float(value) for name, value in simulation.start._asdict().items()},
            "final": {
                **{name: float(value) for name, value in final._asdict().items()},
                "phase": Phase(int(simulation.phase)).name.lower(),
            },
            "outcome": outcome.sentence,
            "valid": self.reason is None,
            "settings": dict(self.settings),
            "extrapolated": extrapolated,
        }

    def printed(self) -> list[str | None]:
        """Return a short summary, a line each."""
        return [*lines_of(self.to_dict()), self._extrapolated()]

    def tables(self) -> dict[str, dict[str, Any]]:
        """Return the columns of contacts.csv, a row a contact, and of trajectory.csv, dense in contacts."""
        begin, end = stretch_written(self.run.simulation, self.seen.window)
        inner, _ = self.dense.nodes(begin, end)
        # a tip that is held rings through the whole stretch
        inner = inner[:: math.ceil((inner.size + 1) / _MOST_NODES)]
        tip = self.dense.at(np.union1d(np.linspace(begin, end, _POINTS), inner))._asdict()
        tip["phase"] = [Phase(phase).name.lower() for phase in tip["phase"].tolist()]
        return {"contacts.csv": _contact_columns(self.run.simulation), "trajectory.csv": tip}


def _reasons(scene: Scene, seen: Observables) -> dict[str, str]:
    """Return for every key that is null why."""
    reasons, verdict = why_absent(scene, seen), seen.settled
    if verdict.periods is None:
        reasons["order"] = reasons["contacts_per_response"] = verdict.reason
    if verdict.remaining is None:
        reasons["remaining_distance"] = "the tip is held" if verdict.stuck else verdict.reason
    return reasons


def _frequency(payload: Mapping[str, Any], multiple: int) -> str:
    """Return the name of a multiple of the response frequency, with its value."""
    order = payload["window"]["periods"]
    khz = f"{multiple * payload['drive_frequency_khz'] / order:.6g} kHz"
    if multiple == order:
        return f"the drive's frequency ({khz})"
    if multiple == 1:
        return f"the response frequency ({khz}, 1/{order} of the drive's)"
    if multiple % order == 0:
        return f"{multiple // order} times the drive's frequency ({khz})"
    return f"{multiple} times the response frequency ({khz}, {multiple}/{order} of the drive's)"


def _lockin_lines(payload: Mapping[str, Any]) -> list[str]:
    """Return what a lock-in reads of the height: at the drive's frequency, the response's, and those asked for."""
    order = payload["window"]["periods"]
    read = {each["multiple"]: (each["amplitude_nm"], each["phase_deg"]) for each in payload["harmonics"]}
    read[1] = payload["lockin_amplitude_nm"], payload["lockin_phase_deg"]
    read[order] = payload["drive_lockin_amplitude_nm"], payload["drive_lockin_phase_deg"]
    first = (order, 1) if payload["phase_lag_deg"] is not None else (1, order)
    return [
        f"At {_frequency(payload, multiple)}: {read[multiple][0]:.6g} nm, {read[multiple][1]:.6g} deg."
        for multiple in dict.fromkeys((*first, *read))
    ]


def _over_a_response(payload: Mapping[str, Any]) -> list[str]:
    """Return the lines of what is read over whole response periods."""
    lines, order = _lockin_lines(payload), payload["window"]["periods"]
    if payload["peak_deflection_nm"] is not None:
        at = {
            _frequency(payload, order): "deflection_drive_lockin",
            _frequency(payload, 1): "deflection_lockin",
        }
        read = (
            f"at {where} {payload[f'{key}_amplitude_nm']:.6g} nm, {payload[f'{key}_phase_deg']:.6g} deg"
            for where, key in at.items()
        )
        lines.append(
            f"Against the moving base: peak deflection {payload['peak_deflection_nm']:.6g} nm; {'; '.join(read)}."
        )
    if payload["phase_lag_deg"] is not None:
        what = (
            "the height behind the force" if payload["peak_deflection_nm"] is None else "the deflection behind the base"
        )
        lines.append(f"Phase lag of {what} at the drive's frequency: {payload['phase_lag_deg']:.6g} deg.")
    if payload["peak_force_nn"] is not None:
        lines.append(
            f"In contact for {payload['time_in_contact_us']:.4g} us of a response period "
            f"({100.0 * payload['contact_share']:.3g} %); forces from {payload['most_attractive_force_nn']:.4g} to "
            f"{payload['peak_force_nn']:.4g} nN."
        )
    lines.append(
        f"Energy of a drive period: {payload['given_by_drives_aj']:.5g} aJ supplied; "
        f"{payload['dissipated_in_air_aj']:.5g} lost in air, {payload['dissipated_in_contact_aj']:.5g} in the sample."
    )
    return lines


def lines_of(payload: Mapping[str, Any]) -> list[str]:
    """Return a short summary of a simulation, a line each."""
    final, window = payload["final"], payload["window"]
    head = "Settled" if payload["settled"] else "Not settled"
    plural = "" if payload["impacts"] == 1 else "s"
    lines = [
        f"{payload['impacts']} contact{plural} from {payload['start']['time_us']:.6g} to {final['time_us']:.6g} us.",
        f"{head}: {payload['settled_reason']}.",
    ]
    mean = f"mean height {payload['mean_height_nm']:.6g} nm, " if window["responses"] else ""
    lines.append(
        f"Peak amplitude {payload['peak_amplitude_nm']:.6g} nm, {mean}"
        f"from {window['from_us']:.6g} to {window['to_us']:.6g} us."
    )
    if window["responses"]:
        lines += _over_a_response(payload)
    else:
        lines.append(
            "Less than a response period: means, energies, amplitudes and phases would be of a part; "
            "follow the motion longer."
        )
    lines.append(
        f"At the end: {final['position_nm']:.6g} nm, {final['velocity_nm_per_us']:.6g} nm/us, {final['phase']}"
        f"{'; the sample holds the tip' if payload['stuck'] else ''}."
    )
    return lines


def _contact_columns(simulation: Simulation) -> dict[str, list[Any]]:
    """Return the columns of all contacts; times of what did not happen are NaN."""
    columns = {
        name.removeprefix("contacts_").removeprefix("detail_"): column[: int(simulation.count)].tolist()
        for name, (column, _) in known_columns(simulation).items()
        if name.startswith("contacts_")
    }
    return columns | {"kind": [ContactKind(kind).name.lower() for kind in columns["kind"]]}


def stretch_written(simulation: Simulation, window: Window) -> tuple[float, float]:
    """Return from when to when, in us, the tip is written down: a short simulation, else the window of observables."""
    first, last = float(simulation.start.time_us), float(simulation.final.time_us)
    period = (window.to_us - window.from_us) / max(window.periods * window.responses, 1)
    short = last - first <= _WHOLE_PERIODS * period
    return (first, last) if short else (window.from_us, window.to_us)
