"""`afm-jax collide [SCENE.toml] --make-law`: the impact law that a contact amounts to, as a table and in formulas."""

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from afm_jax.cli.command import Output, columns_of, later
from afm_jax.cli.contact_options import ContactOptions, chosen_contact
from afm_jax.cli.session import Session
from afm_jax.contact.law_of_contact import FREE, ContactDelay, ContactLaw, fit_delay, fit_law
from afm_jax.contact.law_of_contact import make_law as table_of
from afm_jax.scenefile.law_files import save_law, save_law_csv

draw_contact_law = later("afm_jax.plots.collisions:draw_contact_law")

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


def make_law(
    session: Session,
    contact_options: ContactOptions,
    *,
    speed_range: tuple[float, float] | None,
    delay_range: tuple[float, float] | None,
    residuals: str,
    points: int,
) -> Output:
    """Return the law that a contact amounts to: a table, and the formulas that are closest to it.

    Three formulas of the rebound speed, at uniform speeds: the paper's (r and epsilon), a viscous one (epsilon and a
    loss linear in speed), and all three. Beside them the collision delay, its lag and lead, and its formula.
    """
    contact, mass, description = chosen_contact(contact_options)
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
            "law_delay.csv": columns_of(_delay_rows(delay), DELAY_COLUMNS),
        },
        files={
            "law.json": lambda path: save_law(law, path),
            "law.csv": lambda path: save_law_csv(law, path),
            "law.png": lambda path: draw_contact_law(laws, delay, path),
        },
        json_file="collide.json",
        not_valid=f"the fit of {', '.join(lost)} did not converge; try another --speed-range" if lost else None,
    )


def delay_payload(delay: ContactDelay) -> dict[str, Any]:
    """Return the delay law, its errors, and delay, lag and lead at a few speeds."""
    shown = _thinned(delay)
    return {
        "hertz": delay.delay.hertz,
        "lead_nm": delay.delay.lead_nm,
        "offset_nm": delay.delay.offset_nm,
        "rms_us": delay.rms_us,
        "worst_us": delay.worst_us,
        "speed_range_nm_per_us": delay.speed_range,
        **{name: [row[name] for row in shown] for name in DELAY_COLUMNS},
    }


def law_columns(laws: Sequence[ContactLaw]) -> dict[str, Any]:
    """Return contact and laws speed by speed as columns."""
    return {
        "approach_speed_nm_per_us": laws[0].approach_speed_nm_per_us,
        "rebound_speed_nm_per_us": laws[0].rebound_speed_nm_per_us,
        **{f"{law.model}_speed_nm_per_us": law.fitted_speed_nm_per_us for law in laws},
        **{f"{law.model}_relative_error": law.relative_error for law in laws},
    }


def _delay_rows(delay: ContactDelay) -> list[dict[str, float]]:
    lists = [getattr(delay, name).tolist() for name in DELAY_COLUMNS]
    return [dict(zip(DELAY_COLUMNS, row, strict=True)) for row in zip(*lists, strict=True)]


def _thinned(delay: ContactDelay) -> list[dict[str, float]]:
    """Return a few rows, first and last among them."""
    rows = _delay_rows(delay)
    return [rows[round(place * (len(rows) - 1) / (_SHOWN - 1))] for place in range(_SHOWN)]


def law_table(laws: Sequence[ContactLaw]) -> Table:
    """Return the laws as a table to print."""
    low, high = laws[0].speed_range
    title = f"u_out^2 = r^2 u_in^2 - c u_in - epsilon from {low:.5g} to {high:.5g} nm/us, {laws[0].residuals} residuals"
    table = Table(title=title, title_justify="left")
    table.add_column("law")
    headings = (("r", ""), ("epsilon", "nm^2/us^2"), ("c", "nm/us"), ("worst error", "%"), ("rms error", "%"))
    headings += (("worst error", "nm/us"), ("of top speed", "%"), ("capture speed", "nm/us"))
    for name, unit in headings:
        table.add_column(f"{name}\n{unit}", justify="right")
    for law in laws:
        errors = (100.0 * law.worst_relative_error, 100.0 * law.rms_relative_error, law.worst_error_nm_per_us)
        shares = (100.0 * law.worst_share_of_top_speed, law.capture_speed_nm_per_us)
        numbers = (f"{number:.3g}" for number in errors)
        table.add_row(
            law.model,
            f"{law.r:.5f}",
            f"{law.epsilon:.5g}",
            f"{law.viscous_loss:.3g}",
            *numbers,
            f"{shares[0]:.2g}",
            f"{shares[1]:.5g}",
        )
    return table


def law_sentences(laws: Sequence[ContactLaw]) -> list[str]:
    """Return what is said below the laws."""
    return [
        f"Capture speed of the contact: {laws[0].contact_capture_speed_nm_per_us:.6g} nm/us.",
        "law: the paper's eq. 6; viscous: r = 1 and a loss c linear in speed; full: all three.",
    ]


def delay_table(delay: ContactDelay) -> Table:
    """Return the delay at a few speeds as a table to print."""
    table = Table(title="Collision delay = lag - lead", title_justify="left")
    for name in ("approach\nnm/us", "rebound\nnm/us", "delay\nus", "lag\nus", "lead\nus", "delay law\nus"):
        table.add_column(name, justify="right")
    for row in _thinned(delay):
        speeds, times = list(row.values())[:2], list(row.values())[2:]
        table.add_row(*(f"{value:.5g}" for value in speeds), *(f"{value:.4f}" for value in times))
    return table


def delay_sentences(delay: ContactDelay) -> list[str]:
    """Return what is said below the delays."""
    law, (low, high) = delay.delay, delay.speed_range
    values = ", ".join(f"{name} {float(getattr(law, name)):.4g}" for name in ("hertz", "lead_nm", "offset_nm"))
    errors = f"rms error {delay.rms_us:.2g} us, worst {delay.worst_us:.2g} us"
    return [
        "lag: time in the solid junction; lead: what straight paths to gap 0 would take longer outside it.",
        f"Delay law: {values}; {errors}, from {low:.4g} to {high:.4g} nm/us.",
    ]
