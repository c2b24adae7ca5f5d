"""`afm-jax read FILE`: tapping curves out of an instrument's file, as tables for `tapping` and `fit`."""

from functools import partial
from pathlib import Path
from typing import Any

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from fitting.instruments.curve import read_curve, read_curves
from fitting.instruments.report import curves_payload, curves_summary, write_tables


def curves_of_a_file(session: Session, *, file: Path, curve: int | None, **options: Any) -> Output:  # noqa: ARG001
    """Return the curves of an instrument's file, or one of them."""
    curves = read_curves(file, **options) if curve is None else [read_curve(file, curve=curve, **options)]
    refused = [each for each in curves if not each.valid]
    numbers = ", ".join(str(each.curve) for each in refused)
    return Output(
        payload=curves_payload(curves),
        text=[partial(curves_summary, curves)],
        report=lambda path, _: write_tables(curves, path) if len(refused) < len(curves) else [],
        not_valid=f"{file}: refused curve {numbers}; {refused[0].reasons[0]}" if refused else None,
    )
