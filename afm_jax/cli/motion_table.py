"""The output of `afm-jax simulate`: the JSON object, a summary in lines, contacts and the tip as columns.

Takes a simulation and its observables; gives `MotionTable`, whose keys and columns end in their units (nm, nm/us, us,
nN, aJ, degrees). The formulas are in `observe`.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from afm_jax.apparatus.scene import drive_of
from afm_jax.columns import CsvColumns, csv_columns
from afm_jax.contact.junction import ContactPhase
from afm_jax.impact.law import extrapolation_of
from afm_jax.motion.follow import LongRun
from afm_jax.motion.observe import OBSERVABLES, Observables, why_absent
from afm_jax.motion.record import ContactKind, MotionOutcome
from afm_jax.motion.trajectory import DensePath
from afm_jax.report import Section, sections
from afm_jax.results import ResultTuple, known_columns, public_result
from afm_jax.saved import as_json
from afm_jax.words import counted

_WHOLE_PERIODS = 50
"""Drive periods up to which the whole simulation goes into trajectory.csv."""
_POINTS = 2001
"""Rows of trajectory.csv at equal steps of time."""
_MOST_NODES = 100_000
"""Rows of trajectory.csv within contacts, from which on only every second, third, ... is kept."""


@public_result()
class MotionTable(ResultTuple):
    """A scene that was followed, and what an instrument reads of it."""

    run: LongRun
    seen: Observables
    dense: DensePath
    """The tip at any time."""
    settings: Mapping[str, Any]

    @property
    def reason(self) -> str | None:
        """Why the simulation broke off; None where it did not."""
        return self.run.simulation.broke_off

    @property
    def extrapolated(self) -> str | None:
        """Which impacts come outside the speeds that the law is known for; None where none does."""
        speeds = self.run.simulation.contacts.approach_speed_nm_per_us
        return extrapolation_of(self.dense.scene.interaction, speeds)


@as_json.register
def _(result: MotionTable) -> dict[str, Any]:
    # without the scene; what is null has its reason beside it
    simulation, verdict, seen = result.run.simulation, result.run.verdict, result.seen
    extrapolated, reasons = result.extrapolated, why_absent(result.dense.scene, seen)
    if extrapolated is None:
        reasons["extrapolated"] = "No impact is faster or slower than the law is known for."
    if verdict.periods is None:
        reasons["order"] = reasons["contacts_per_response"] = verdict.reason
    if verdict.remaining is None:
        reasons["remaining_distance"] = "the tip is held" if verdict.stuck else verdict.reason
    deflection = seen.deflection_harmonics
    return {
        "impacts": int(simulation.count),
        "stuck": verdict.stuck,
        "settled": verdict.settled,
        "order": verdict.periods,
        "contacts_per_response": verdict.contacts,
        "settled_reason": verdict.reason,
        "remaining_distance": verdict.remaining,
        **{name: getattr(seen, name) for name in OBSERVABLES},
        "drive_frequency_khz": seen.drive_frequency_khz,
        "response_frequency_khz": seen.response_frequency_khz,
        "harmonics": [harmonic._asdict() for harmonic in seen.harmonics],
        "deflection_harmonics": deflection and [harmonic._asdict() for harmonic in deflection],
        "window": {**seen.window._asdict(), "contacts": seen.contacts},
        "null_reasons": reasons,
        "start": simulation.start._asdict(),
        "final": simulation.final._asdict() | {"phase": ContactPhase(int(simulation.phase)).name.lower()},
        "outcome": MotionOutcome(int(simulation.outcome)).sentence,
        "valid": result.reason is None,
        "settings": dict(result.settings),
        "extrapolated": extrapolated,
    }


@sections.register
def _(result: MotionTable) -> list[Section]:
    simulation, seen, verdict, window = result.run.simulation, result.seen, result.run.verdict, result.seen.window
    begin = simulation.start
    final = simulation.final
    phase = ContactPhase(int(simulation.phase)).name.lower()
    times, mean = f"{float(begin.time_us):.6g} to {float(final.time_us):.6g}", ""
    reading = ["Less than a response period: no means, energies, amplitudes and phases; follow the motion longer."]
    if window.responses:
        mean, reading = f"mean height {seen.mean_height_nm:.6g} nm, ", _over_a_response(seen)
    position = f"{float(final.position_nm):.6g} nm"
    velocity = f"{float(final.velocity_nm_per_us):.6g} nm/us"
    read = f"{window.from_us:.6g} to {window.to_us:.6g}"
    parts = [
        f"{'Settled' if verdict.settled else 'Not settled'}: {verdict.reason}.",
        f"Peak amplitude {seen.peak_amplitude_nm:.6g} nm, {mean}from {read} us.",
        *reading,
        f"At the end: {position}, {velocity}, {phase}{'; the sample holds the tip' if verdict.stuck else ''}.",
        result.extrapolated,
    ]
    return [Section(f"{counted(int(simulation.count), 'contact')} from {times} us.", parts)]


@csv_columns.register
def _(result: MotionTable) -> CsvColumns:
    """Return a row a contact, and the tip, dense in contacts: of a short simulation as a whole, else over the window.

    The window is that of the observables.
    """
    simulation, window = result.run.simulation, result.seen.window
    begin, end = float(simulation.start.time_us), float(simulation.final.time_us)
    if end - begin > _WHOLE_PERIODS * drive_of(result.dense.scene).period_us:
        begin, end = window.from_us, window.to_us
    inner, _ = result.dense.nodes(begin, end)
    # a tip that is held rings through the whole stretch
    inner = inner[:: math.ceil((inner.size + 1) / _MOST_NODES)]
    tip = result.dense.at(np.union1d(np.linspace(begin, end, _POINTS), inner))._asdict()
    tip["phase"] = [ContactPhase(phase).name.lower() for phase in tip["phase"].tolist()]
    contacts = {
        name.removeprefix("contacts_").removeprefix("detail_"): column[: int(simulation.count)].tolist()
        for name, (column, _) in known_columns(simulation).items()
        if name.startswith("contacts_")
    }
    contacts["kind"] = [ContactKind(kind).name.lower() for kind in contacts["kind"]]
    return {"contacts.csv": contacts, "trajectory.csv": tip}


def _frequency(seen: Observables, multiple: int) -> str:
    """Return the name of a multiple of the response frequency, with its value."""
    names = {1: "the response frequency", seen.window.periods: "the drive's frequency"}
    khz = f"{multiple * seen.response_frequency_khz:.6g} kHz"
    return f"{names.get(multiple, f'{multiple} times the response frequency')} ({khz})"


def _over_a_response(seen: Observables) -> list[str]:
    """Return the lines of what is read over whole response periods."""
    order = seen.window.periods
    read = {order: (seen.drive_lockin_amplitude_nm, seen.drive_lockin_phase_deg)}
    read[1] = seen.lockin_amplitude_nm, seen.lockin_phase_deg
    read |= {each.multiple: (each.amplitude_nm, each.phase_deg) for each in seen.harmonics}
    lines = [f"At {_frequency(seen, k)}: {size:.6g} nm, {phase:.6g} deg." for k, (size, phase) in read.items()]
    if seen.peak_deflection_nm is not None:
        at = {
            order: (seen.deflection_drive_lockin_amplitude_nm, seen.deflection_drive_lockin_phase_deg),
            1: (seen.deflection_lockin_amplitude_nm, seen.deflection_lockin_phase_deg),
        }
        also = (f"at {_frequency(seen, k)} {size:.6g} nm, {phase:.6g} deg" for k, (size, phase) in at.items())
        lines.append(f"Against the moving base: peak deflection {seen.peak_deflection_nm:.6g} nm; {'; '.join(also)}.")
    if seen.phase_lag_deg is not None:
        what = "height behind the force" if seen.peak_deflection_nm is None else "deflection behind the base"
        lines.append(f"Phase lag of the {what} at the drive's frequency: {seen.phase_lag_deg:.6g} deg.")
    if seen.peak_force_nn is not None:
        lines.append(
            f"In contact for {seen.time_in_contact_us:.4g} us of a response period "
            f"({100.0 * seen.contact_share:.3g} %); forces from {seen.most_attractive_force_nn:.4g} to "
            f"{seen.peak_force_nn:.4g} nN."
        )
    lines.append(
        f"Energy of a drive period: {seen.given_by_drives_aj:.5g} aJ supplied; "
        f"{seen.dissipated_in_air_aj:.5g} lost in air, {seen.dissipated_in_contact_aj:.5g} in the sample."
    )
    return lines
