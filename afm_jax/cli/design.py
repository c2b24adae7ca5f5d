"""`afm-jax design`: which drives to measure next, and what they will determine."""

from collections.abc import Mapping
from functools import partial
from typing import Any

from afm_jax.cli.command import Output
from afm_jax.cli.design_prior import prior_of_options
from afm_jax.cli.session import Session
from afm_jax.cli.values import Numbers, Orders
from fitting.experiments.candidates import drive_grid
from fitting.experiments.design import design
from fitting.experiments.report import design_summary, write_design

_TAPPING = {"orders": "1", "detuning": "1.02:1.1:0.02", "drive_nm": "40,80", "heights": "0.1:0.9:0.1"}
_SAMPLE = {"orders": "1-4", "detuning": "0.97:1.05:0.01", "drive_nm": "2,4,7,10", "offsets_nm": "-1,0,1"}


def planned(  # noqa: PLR0913
    session: Session,
    *,
    frequencies_khz: tuple[float, ...] | None,
    largest_nm: float | None,
    points: int,
    interest: str | None,
    criterion: str,
    noise: float,
    amplitudes: str,
    phase_noise_deg: float,
    **options: Any,
) -> Output:
    """Return the drives to measure next, of all combinations of the lists, and what they will determine."""
    with session.working("forecasting (the first run compiles for some seconds)"):
        prior = prior_of_options(options)
        chosen = _with_defaults(options, tapping=prior.problem.tapping)
        drives = drive_grid(
            orders=chosen["orders"],
            amplitudes_nm=chosen["drive_nm"],
            offsets_nm=chosen["offsets_nm"] or (0.0,),
            heights=chosen["heights"],
            frequencies_khz=frequencies_khz,
            detunings=chosen["detuning"] if frequencies_khz is None else None,
            free_frequency_khz=prior.free_frequency_khz,
            drive=prior.problem.drive,
        )
        names = None if interest is None else tuple(name.strip().replace("-", "_") for name in interest.split(","))
        result = design(
            prior,
            drives,
            points=points,
            noise=noise,
            interest=names,
            criterion=criterion,
            amplitudes=amplitudes,
            largest_nm=largest_nm,
            phase_noise_deg=phase_noise_deg,
        )
    return Output.of_report(result, partial(design_summary, result), partial(write_design, result))


def _with_defaults(options: Mapping[str, Any], *, tapping: bool) -> dict[str, Any]:
    """Return what can be driven, with the usual lists where none were given."""
    usual = dict(_TAPPING if tapping else _SAMPLE)
    if options["offsets_nm"] is not None:
        usual.pop("heights", None)
    numbers, orders = Numbers(positive=False), Orders()
    found = {name: (orders if name == "orders" else numbers).convert(text, None, None) for name, text in usual.items()}
    return {name: found.get(name) if options[name] is None else options[name] for name in (*_SAMPLE, "heights")}
