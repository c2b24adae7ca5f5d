"""`afm-jax calibrate SWEEP`: frequency, quality factor and stiffness of the free cantilever, sensitivity."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session, labelled
from afm_jax.strict_json import plain
from fitting.calibration.calibrate import calibrate
from fitting.calibration.report import calibration_report, slope_figure, slope_report, write_calibration
from fitting.calibration.result import Calibration
from fitting.calibration.stiffness import (
    AIR_K,
    Stiffness,
    budget,
    equipartition,
    sader,
    sensitivity,
    stiffness_payload,
)
from fitting.calibration.sweep import read_sweep, without_phase
from fitting.instruments.curve import read_curves
from fitting.report.files import write_with_picture
from fitting.report.sections import text_of


def calibration(session: Session, *, sweep: Path, slope: bool, amplitude_only: bool, **options: Any) -> Output:
    """Return frequency, quality factor and stiffness of a free cantilever; with ``slope`` the sensitivity."""
    if slope:
        return _sensitivity(sweep)
    measured = read_sweep(sweep)
    if amplitude_only:
        measured = without_phase(measured)
    with session.working(f"fitting {measured.points} points (the first run compiles for some seconds)"):
        fit_options = {name: options[name] for name in ("background", "noise", "scale_errors", "whole")}
        result = calibrate(measured, **fit_options)
    stiffnesses = _stiffnesses(result, options)
    payload = result.to_dict() | (stiffness_payload(result, stiffnesses) if stiffnesses else {})
    return Output(
        payload=payload,
        text=[lambda: text_of(calibration_report(result, stiffnesses))],
        report=lambda folder, write_table: write_calibration(result, folder, write_table, stiffnesses, payload),
        not_valid=payload["reasons"][0] if payload["reasons"] else None,
    )


def _stiffnesses(result: Calibration, options: dict[str, Any]) -> list[Stiffness]:
    """Return the spring constants that a calibration supports: equipartition, Sader's method, both or none."""
    if not result.valid:
        return []
    temperature = options["temperature_k"]
    warm = None if temperature is None else (temperature[0], temperature[1] or 0.0)
    stiffnesses = []
    if options["length_um"] is not None:
        sides = {key: (options[key][0], options[key][1] or 0.0) for key in ("length_um", "width_um")}
        stiffnesses.append(sader(result, **sides, temperature_k=warm or AIR_K))
    if result.mean_square is not None:
        scale = {} if options["scale_error"] is None else {"scale_error": options["scale_error"]}
        beside, static = next(iter(stiffnesses), None), options["deflection"] == "static"
        stiffnesses.insert(0, equipartition(result, temperature_k=warm, static=static, beside=beside, **scale))
    return stiffnesses


def _sensitivity(path: Path) -> Output:
    curves = read_curves(path)
    slope = sensitivity(curves)
    payload = {"deflection_nm_per_volt": asdict(slope.value), "assumed": slope.assumed, "valid": True}
    payload |= {"budget": budget(None, [slope])}
    report = slope_report(curves, slope)
    shows = "Deflection over the height of the sample; dashed, the sensitivity through the end of each curve."

    def write(folder: Path, _: Any) -> list[Path]:
        figure, data = slope_figure(curves, slope), plain(labelled(payload))
        return write_with_picture(folder, "calibration", report, figure, shows, data, link="Picture")

    return Output(payload=payload, text=[partial(text_of, report)], report=write)
