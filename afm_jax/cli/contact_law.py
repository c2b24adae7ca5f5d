"""`afm-jax collide [SCENE.toml] --make-law`: the impact law that a contact amounts to, as a table and in formulas."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from afm_jax.cli.columns import TableColumn, printed_table
from afm_jax.cli.command import Output, picture_of
from afm_jax.cli.contact_options import chosen_contact
from afm_jax.cli.session import Session
from afm_jax.contact.law_of_contact import FREE, ContactDelay, ContactLaw, fit_delay, fit_law
from afm_jax.contact.law_of_contact import make_law as table_of
from afm_jax.scenefile.law_files import save_law, save_law_csv

MODEL_KEYS = (
    "model",
    "r",
    "epsilon",
    "viscous_loss",
    "worst_relative_error",
    "rms_relative_error",
    "worst_error_nm_per_us",
    "rms_error_nm_per_us",
    "worst_share_of_top_speed",
    "capture_speed_nm_per_us",
    "converged",
)
"""What is told of a model: attributes of `ContactLaw`."""
DELAY_COLUMNS = (
    "approach_speed_nm_per_us",
    "rebound_speed_nm_per_us",
    "delay_us",
    "lag_us",
    "lead_us",
    "fitted_us",
)
"""What is told of the delay at a speed: attributes of `ContactDelay`."""
_SHOWN = 9
"""Speeds at which the delay is told in JSON and text."""


def make_law(
    session: Session,
    *,
    speed_range: tuple[float, float] | None,
    delay_range: tuple[float, float] | None,
    residuals: str | None,
    points: int | None,
    **options: Any,
) -> Output:
    """Return the law that a contact amounts to: a table, and the formulas that are closest to it.

    Three formulas of the rebound speed, at uniform speeds: the paper's (r and epsilon), a viscous one (epsilon and a
    loss linear in speed), and all three. Beside them the collision delay, its lag and lead, and its formula.
    """
    residuals, points = residuals or "relative", points or 512
    contact, mass, description = chosen_contact(options)
    with session.working("fitting (the first run compiles for some seconds)"):
        laws = [
            fit_law(contact, speed_range=speed_range, model=model, residuals=residuals, mass_ng=mass, points=points)
            for model in FREE
        ]
        delay = fit_delay(contact, speed_range=delay_range, mass_ng=mass, points=points)
        law = table_of(contact, mass_ng=mass)
    payload = {
        "residuals": residuals,
        "speed_range_nm_per_us": laws[0].speed_range,
        "points": points,
        "models": [{name: getattr(law, name) for name in MODEL_KEYS} for law in laws],
        "contact_capture_speed_nm_per_us": laws[0].contact_capture_speed_nm_per_us,
        "delay": delay_payload(delay),
        "law": law.to_dict(),
        "contact": description,
        "mass_ng": mass,
    }
    text = [law_table(laws), *law_sentences(laws), "", delay_table(delay), *delay_sentences(delay)]
    if session.out is not None:
        text.append(f'In a scene file: [interaction] model = "law", file = "{session.out / "law.json"}"; or --law.')
    lost = [law.model for law in laws if not law.converged]
    return Output(
        payload=payload,
        text=text,
        tables={
            "law_models.csv": law_columns(laws),
            "law_delay.csv": {name: getattr(delay, name) for name in DELAY_COLUMNS},
        },
        files={
            "law.json": lambda path: save_law(law, path),
            "law.csv": lambda path: save_law_csv(law, path),
            "law.png": picture_of("collisions:contact_law_figure", laws, delay),
        },
        json_file="collide.json",
        not_valid=f"the fit of {', '.join(lost)} did not converge; try another --speed-range" if lost else None,
    )


def delay_payload(delay: ContactDelay) -> dict[str, Any]:
    """Return the delay law, its errors, and delay, lag and lead at a few speeds."""
    return {
        "hertz": delay.delay.hertz,
        "lead_nm": delay.delay.lead_nm,
        "offset_nm": delay.delay.offset_nm,
        "rms_us": delay.rms_us,
        "worst_us": delay.worst_us,
        "speed_range_nm_per_us": delay.speed_range,
        **_thinned(delay),
    }


def law_columns(laws: Sequence[ContactLaw]) -> dict[str, Any]:
    """Return contact and laws speed by speed as columns."""
    return {
        "approach_speed_nm_per_us": laws[0].approach_speed_nm_per_us,
        "rebound_speed_nm_per_us": laws[0].rebound_speed_nm_per_us,
        **{f"{law.model}_speed_nm_per_us": law.fitted_speed_nm_per_us for law in laws},
        **{f"{law.model}_relative_error": law.relative_error for law in laws},
    }


def _thinned(delay: ContactDelay) -> dict[str, list[float]]:
    """Return the delay at a few speeds as columns, first and last among them."""
    places = np.round(np.linspace(0, len(delay.delay_us) - 1, _SHOWN)).astype(int)
    return {name: getattr(delay, name)[places].tolist() for name in DELAY_COLUMNS}


def law_table(laws: Sequence[ContactLaw]) -> Table:
    """Return the laws as a table to print."""
    low, high = laws[0].speed_range
    title = f"u_out^2 = r^2 u_in^2 - c u_in - epsilon from {low:.5g} to {high:.5g} nm/us, {laws[0].residuals} residuals"
    columns = [
        TableColumn("law", lambda law: law.model, "", left=True),
        TableColumn("r\n", lambda law: law.r, ".5f"),
        TableColumn("epsilon\nnm^2/us^2", lambda law: law.epsilon, ".5g"),
        TableColumn("c\nnm/us", lambda law: law.viscous_loss, ".3g"),
        TableColumn("worst error\n%", lambda law: 100.0 * law.worst_relative_error, ".3g"),
        TableColumn("rms error\n%", lambda law: 100.0 * law.rms_relative_error, ".3g"),
        TableColumn("worst error\nnm/us", lambda law: law.worst_error_nm_per_us, ".3g"),
        TableColumn("of top speed\n%", lambda law: 100.0 * law.worst_share_of_top_speed, ".2g"),
        TableColumn("capture speed\nnm/us", lambda law: law.capture_speed_nm_per_us, ".5g"),
    ]
    return printed_table(title, columns, laws)


def law_sentences(laws: Sequence[ContactLaw]) -> list[str]:
    """Return what is said below the laws."""
    return [
        f"Capture speed of the contact: {laws[0].contact_capture_speed_nm_per_us:.6g} nm/us.",
        "law: the paper's eq. 6; viscous: r = 1 and a loss c linear in speed; full: all three.",
    ]


def delay_table(delay: ContactDelay) -> Table:
    """Return the delay at a few speeds as a table to print."""
    times = (("delay", "delay_us"), ("lag", "lag_us"), ("lead", "lead_us"), ("delay law", "fitted_us"))
    columns = [
        TableColumn("approach\nnm/us", "approach_speed_nm_per_us", ".5g"),
        TableColumn("rebound\nnm/us", "rebound_speed_nm_per_us", ".5g"),
        *(TableColumn(f"{heading}\nus", name, ".4f") for heading, name in times),
    ]
    shown = _thinned(delay)
    rows = [dict(zip(shown, values, strict=True)) for values in zip(*shown.values(), strict=True)]
    return printed_table("Collision delay = lag - lead", columns, rows)


def delay_sentences(delay: ContactDelay) -> list[str]:
    """Return what is said below the delays."""
    law, (low, high) = delay.delay, delay.speed_range
    values = ", ".join(f"{name} {float(getattr(law, name)):.4g}" for name in ("hertz", "lead_nm", "offset_nm"))
    errors = f"rms error {delay.rms_us:.2g} us, worst {delay.worst_us:.2g} us"
    return [
        "lag: time in the solid junction; lead: what straight paths to gap 0 would take longer outside it.",
        f"Delay law: {values}; {errors}, from {low:.4g} to {high:.4g} nm/us.",
    ]
