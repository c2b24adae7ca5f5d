"""Readings of traces as a person reads them: text for the terminal, files for the drawer (JSON, CSV, PNG)."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from afm_jax.words import with_error
from fitting.table import AmplitudeTable, write_table
from fitting.traces.lockin_result import FORMAT_VERSION, LockinResult


def lockin_payload(results: Sequence[LockinResult], table_fault: str | None) -> dict[str, Any]:
    """Return the JSON object of a call.

    Args:
        results: of all traces.
        table_fault: why there is no amplitude table; None if there is one.
    """
    return {
        "format": "afm-jax lockin",
        "format_version": FORMAT_VERSION,
        "traces": [result.to_dict() for result in results],
        "steady": sum(result.steady for result in results),
        "table_reason": table_fault,
    }


def lockin_summary(result: LockinResult) -> str:
    """Return one reading as text: verdict first, then the values, then notes."""
    trace = result.trace
    size = f"{trace.samples} samples, {1.0 / trace.step_us:.6g} MHz, {trace.drive_periods:.5g} drive periods"
    lines = [
        f"{trace.source}: {'STEADY' if result.steady else 'FLAGGED'}: {result.verdict}",
        f"  {size} of {trace.drive_frequency_khz:.7g} kHz, noise {result.noise_nm:.3g} nm a sample",
    ]
    if result.peak_amplitude_nm is not None:
        values = (
            ("peak amplitude", result.peak_amplitude_nm, result.peak_amplitude_error_nm, "nm"),
            ("lock-in amplitude", result.lockin_amplitude_nm, result.lockin_amplitude_error_nm, "nm"),
            ("phase", result.phase_deg, result.phase_error_deg, f"degrees, modulo {360.0 / (result.order or 1):g}"),
        )
        lines += [f"  {name:<18}{with_error(value, error)} {unit}" for name, value, error, unit in values]
    if result.free_frequency_khz is not None and result.free_frequency_origin == "trace":
        frequency = f"{result.free_frequency_khz:.4g} kHz"
        lines.append(f"  {'free frequency':<18}{frequency} (from the bending at the top, for counting impacts only)")
    return "\n".join([*lines, *(f"  - {warning}" for warning in result.warnings)])


def write_lockin(
    results: Sequence[LockinResult], folder: Path, table: AmplitudeTable | None, table_fault: str | None
) -> list[Path]:
    """Write lockin.json, a picture of every trace and, if there is a table, amplitudes.csv into a folder.

    Args:
        results: of all traces.
        folder: an existing folder; files of these names are replaced.
        table: of the steady ones, or None.
        table_fault: why there is none.

    Returns:
        The files.

    Raises:
        OSError: if a file cannot be written.
    """
    from fitting.traces.lockin_plot import draw_lockin  # noqa: PLC0415

    data = folder / "lockin.json"
    text = json.dumps(lockin_payload(results, table_fault), indent=1, allow_nan=False)
    data.write_text(text + "\n", encoding="utf-8")
    written = [data]
    for name, result in zip(_picture_names(results), results, strict=True):
        draw_lockin(result, folder / name)
        written.append(folder / name)
    if table is not None:
        write_table(table, folder / "amplitudes.csv")
        written.append(folder / "amplitudes.csv")
    return written


def _picture_names(results: Sequence[LockinResult]) -> list[str]:
    """Return a file name for each trace; traces of the same name in different folders are numbered."""
    names: list[str] = []
    for result in results:
        stem = Path(result.trace.source).stem or "trace"
        name, number = f"lockin_{stem}.png", 2
        while name in names:
            name, number = f"lockin_{stem}_{number}.png", number + 1
        names.append(name)
    return names
