"""`afm-jax accuracy SCENE.toml`: error against time of one scene's settings, and of simpler models of it."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from afm_jax.accuracy.scenes import ladder_duration
from afm_jax.apparatus.scene import Scene
from afm_jax.bench.study import StudyTable
from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.cli.values import scene_and_start
from afm_jax.contact.collide import capture_speed
from afm_jax.contact.contact import Contact
from afm_jax.contact.law_of_contact import fit_delay, fit_law
from afm_jax.motion.record import ContactKind, MotionOutcome, Simulation, State
from afm_jax.motion.simulate import simulate
from afm_jax.motion.start import start_of
from afm_jax.studies import timing

SETTINGS = StudyTable(
    "accuracy.csv",
    ("way", "setting", "microseconds_per_contact", "arrival_error_us", "peak_error_nm", "compile_s"),
    "Error after {contacts} contacts against the time of one (one core, one tip)",
    {
        "way": "way",
        "setting": "setting",
        "us/contact": "microseconds_per_contact",
        "arrival error us": "arrival_error_us",
        "peak error nm": "peak_error_nm",
        "compile s": "compile_s",
    },
)
LADDER = StudyTable(
    "ladder.csv",
    ("model", "peak_nm", "lowest_peak_nm", "model_error", "seconds", "contacts", "reason"),
    "The same amplitude from simpler models: error against the {model_reference}",
    {
        "model": "model",
        "peak nm": "peak_nm:.5g",
        "lowest peak nm": "lowest_peak_nm:.5g",
        "error": "model_error:.2%",
        "seconds": "seconds",
        "contacts": "contacts:d",
    },
)
CONTACT = {"accuracies": [1e-6, 1e-9], "quick": [2, 8], "careful": [2.0, 4.0, 6.0, 8.0], "repetitions": 5}
CONTACT_QUICK = {"accuracies": [1e-6], "quick": [], "careful": [3.0, 5.0], "repetitions": 1}
LAW = {"tolerances": [1e-1, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13, 1e-14], "repetitions": 5}
LAW_QUICK = {"tolerances": [1e-2, 1e-6, 1e-10, 1e-14], "repetitions": 1}
_WIDER = 1.1
"""The law is fitted from the slowest to the fastest approach of the scene, wider by this factor at each end."""
_ABOVE_CAPTURE = 1.02


def scene_study(session: Session, name: str, contacts: int, *, quick: bool) -> Output:
    """Return the accuracy study of a scene file or a preset."""
    scene, start = scene_to_study(name)
    resolved = isinstance(scene.interaction, Contact)
    common = {"scene": name, "start": [float(part) for part in start]}
    with session.working("measuring (programs are compiled for every setting)"):
        duration = ladder_duration(scene)
        law = fitted_law(scene, followed(scene, start, duration, contacts)) if resolved else None
        task = "contact_accuracy" if resolved else "law_accuracy"
        settings = (CONTACT_QUICK if quick else CONTACT) if resolved else (LAW_QUICK if quick else LAW)
        result = timing.run_in_own_process(
            f"afm_jax.accuracy.scenes:{task}", {**common, **settings, "contacts": contacts}, cores=1
        )
        rungs = {**common, "law": law, "duration_us": duration, "repetitions": settings["repetitions"]}
        result |= timing.run_in_own_process("afm_jax.accuracy.scenes:fidelity_ladder", rungs, cores=1)
    return Output(
        payload={**result, "scene": name, "law": law},
        text=[
            SETTINGS.printed(result["rows"], result),
            reference_sentence(result),
            LADDER.printed(result["ladder"], result),
            *(f"{row['model']}: {row['reason']}" for row in result["ladder"] if row.get("reason")),
        ],
        tables=SETTINGS.written(result["rows"]) | LADDER.written(result["ladder"]),
        files={"accuracy.png": picture_of("accuracy:scene_accuracy_figure", result)},
        json_file="accuracy.json",
    )


def scene_to_study(name: str) -> tuple[Scene, State]:
    """Return the scene of a file or a preset, and where its motion begins.

    Raises:
        ValueError: if the tip never meets anything, or the file is wrong.
    """
    scene, told = scene_and_start(name)
    if scene.interaction is None:
        raise ValueError(f"{name}: the cantilever is free: its motion is a closed form and has no contacts to measure")
    return scene, start_of(scene, told)


def followed(scene: Scene, start: State, duration_us: float, contacts: int) -> Simulation:
    """Return the scene's motion, from which the range of its approach speeds is taken.

    Raises:
        ValueError: if the tip leaves fewer contacts than are to be compared.
    """
    found = simulate(scene, start, duration_us)
    left = int(np.sum(np.asarray(found.contacts.kind) == ContactKind.IMPACT))
    if left < contacts:
        raise ValueError(
            f"the tip leaves {left} contacts in {duration_us:.4g} us, but {contacts} are to be compared: lower "
            f"--contacts, or start elsewhere ({MotionOutcome(int(found.outcome)).sentence})"
        )
    return found


def fitted_law(scene: Scene, found: Simulation) -> dict[str, float]:
    """Return the paper's law with delay, fitted to the scene's contact over the scene's own range of speeds."""
    mass = float(scene.cantilever.mass_ng)
    left = np.asarray(found.contacts.kind) == ContactKind.IMPACT
    speeds = np.asarray(found.contacts.approach_speed_nm_per_us)[left]
    lowest = _ABOVE_CAPTURE * float(capture_speed(scene.interaction, mass))
    low = max(float(speeds.min()) / _WIDER, lowest)
    high = max(float(speeds.max()), low) * _WIDER
    law = fit_law(scene.interaction, speed_range=(low, high), mass_ng=mass)
    delay = fit_delay(scene.interaction, speed_range=(low, high), mass_ng=mass).delay
    return {
        "r": law.r,
        "epsilon": law.epsilon,
        "viscous_loss": law.viscous_loss,
        **{name: float(getattr(delay, name)) for name in ("hertz", "lead_nm", "offset_nm")},
        "lowest_speed_nm_per_us": low,
        "highest_speed_nm_per_us": high,
    }


def reference_sentence(result: Mapping[str, Any]) -> str:
    """Say what the errors are measured against, and how good that is."""
    peak = result["reference_error_nm"]
    heights = "" if peak is None else f" and {peak:.1e} nm"
    return (
        f"Reference: {result['reference']}; it differs from the second finest by {result['reference_error_us']:.1e} us"
        f"{heights}. Contact {result['contacts']} arrives at {result['arrival_us']:.9g} us."
    )
