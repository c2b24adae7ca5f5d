"""`afm-jax tapping CURVE`: the energy of a tap, thresholds and hysteresis, and where the drive allows it the law."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from afm_jax.cli.command import Output
from afm_jax.cli.commands.measure import READING_OPTIONS
from afm_jax.cli.session import Session, add_note, prepare_folder
from afm_jax.cli.values import option_of
from afm_jax.whole_files import check_plain
from fitting.examples.make_raw_curve import EXAMPLE, OPTIONS
from fitting.tables.table import AmplitudeTable, read_table
from fitting.tapping_curves.measured import MeasuredFile, is_table, read_measured
from fitting.tapping_curves.report import tapping_summary, together_summary, write_tapping, write_together
from fitting.tapping_curves.result import Tapping
from fitting.tapping_curves.tapping import tapping, with_law
from fitting.tapping_curves.together import TappingTogether, together


def energy_of_taps(
    session: Session,
    *,
    curve_files: tuple[Path, ...],
    no_law: bool,
    model: str,
    scale_errors: bool,
    example: bool,
    **options: Any,
) -> Output:
    """Return the energy of a tap along tapping curves, and the impact law where the drive allows it."""
    how = {"no_law": no_law, "scale_errors": scale_errors}
    if example:
        curve_file, options = _example(options)
        curve_files = (curve_file,)
    files = [_read(path, options) for path in curve_files]
    if len(files) > 1 or len(files[0].tables) != 1 or files[0].refused:
        return _together(session, curve_files, files, model, how)
    (table,) = files[0].tables.values()
    result = _analysed(session, table, model, **how)
    output = Output.of_report(result, partial(tapping_summary, result), partial(write_tapping, result))
    return output if result.valid else replace(output, not_valid=result.in_unit(result.reasons[0]))


def _read(path: Path, options: dict[str, Any]) -> MeasuredFile:
    """Return the curves of a file, a table or an instrument's, with what the call says of the instrument."""
    if is_table(path):
        _refuse_reading(path, options)
        return MeasuredFile({1: _given(read_table(path, noise=options["noise"]), options)}, {})
    file = read_measured(path, curve=options["curve"], **{name: options[name] for name in READING_OPTIONS})
    for note in file.notes:
        add_note(note)
    return file


def _analysed(session: Session, table: AmplitudeTable, model: str, *, no_law: bool, scale_errors: bool) -> Tapping:
    result = tapping(table, law=False, scale_errors=scale_errors)
    if no_law or not result.law_allowed:
        return result
    session.start_computing()
    with session.working("fitting the impact law (the first run compiles for half a minute)"):
        return with_law(result, model)


def _together(
    session: Session, paths: tuple[Path, ...], files: list[MeasuredFile], model: str, how: dict[str, bool]
) -> Output:
    """Return what is known of several curves of one lever, together and one by one."""
    tables = [(number, table) for file in files for number, table in file.tables.items()]
    whole = together([_analysed(session, table, model, **how) for _, table in tables]) if tables else None
    numbers = [number for number, _ in tables] if len(files) == 1 else range(1, len(tables) + 1)
    curves = {} if whole is None else dict(zip(numbers, whole.curves, strict=True))
    refused = [
        {"file": str(path), "curve": number, "reason": reason}
        for path, file in zip(paths, files, strict=True)
        for number, reason in file.refused.items()
    ]
    text = [lambda result=result: tapping_summary(result) + "\n" for result in curves.values()]
    text += [f"Curve {each['curve']} refused: {each['reason']}" for each in refused]
    if whole is not None and len(curves) > 1:
        text.append(together_summary(whole))
    valid = whole is not None and whole.valid and not refused
    payload = {
        "valid": valid,
        "curves": [{"curve": number, **result.to_dict()} for number, result in curves.items()],
        "together": None if whole is None else whole.to_dict(),
        "refused": refused,
    }
    return Output(
        payload=payload,
        text=text,
        report=partial(_write_curves, session, curves, whole),
        not_valid=None if valid else _why_not(paths, refused, curves, whole),
    )


def _write_curves(
    session: Session, curves: dict[int, Tapping], whole: TappingTogether | None, folder: Path, _: Any
) -> list[Path]:
    """Write a report of each curve into a folder of its own, and of all together if they scatter; return the paths."""
    written: list[Path] = []
    for number, result in curves.items():
        below = folder / f"curve_{number}"
        check_plain(below)
        prepare_folder(below)
        written += write_tapping(result, below, replace(session, out=below).write_table)
    if whole is not None and whole.scatter:
        written += write_together(whole, folder)
    return written


def _why_not(
    paths: tuple[Path, ...], refused: list[dict[str, Any]], curves: dict[int, Tapping], whole: TappingTogether | None
) -> str:
    why = [f"curve {each['curve']} refused" for each in refused]
    why += [f"curve {number}: {result.reasons[0]}" for number, result in curves.items() if not result.valid]
    why += [] if whole is None else [reason for reason in whole.reasons if "disagree" in reason]
    return f"{paths[0] if len(paths) == 1 else f'{len(paths)} files'}: {'; '.join(why)}"


def _example(options: dict[str, Any]) -> tuple[Path, dict[str, Any]]:
    """Return the bundled raw file, and the options with what is known of its instrument where they say nothing."""
    stated = {name: value for name, value in OPTIONS.items() if options[name] in {None, ""}}
    path = EXAMPLE.relative_to(Path.cwd()) if EXAMPLE.is_relative_to(Path.cwd()) else EXAMPLE
    # --spring-constant stands for --spring-constant-n-per-m
    words = " ".join(f"{option_of(name.removesuffix('_n_per_m'))} {_shown(value)}" for name, value in stated.items())
    add_note(f"The example is simulated; as if it were measured: afm-jax tapping {path} {words}")
    return path, options | stated


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else f"'{value[0]:g} +- {value[1]:g}'"


_OF_TABLES = {
    "free_frequency_khz": ("free_frequency_khz", "free_frequency_error_khz"),
    "quality_factor": ("quality_factor", "quality_factor_error"),
    "spring_constant_n_per_m": ("spring_constant_n_per_m", "spring_constant_error_n_per_m"),
}
"""What the command line may say in place of a table, and what a table calls value and error."""


def _refuse_reading(path: Path, options: dict[str, Any]) -> None:
    """Refuse options that say how to read an instrument's file where a table says it all.

    Raises:
        click.UsageError: naming the first of them.
    """
    for name in ("curve", *READING_OPTIONS):
        if name not in {*_OF_TABLES, "phase_sense"} and options[name] not in {None, ""}:
            raise click.UsageError(
                f"{option_of(name)} is for an instrument's file; {path} is a table, which says that itself"
            )


def _given(table: AmplitudeTable, options: dict[str, Any]) -> AmplitudeTable:
    """Return a table with what the call says of the instrument in place of its own."""
    stated = {
        name: number
        for option, value_and_error in _OF_TABLES.items()
        if options[option] is not None
        for name, number in zip(value_and_error, options[option], strict=True)
    }
    if options["phase_sense"] is not None:
        table = replace(table, phase_sense=options["phase_sense"])
    if stated and stated.get("spring_constant_n_per_m", table.spring_constant_n_per_m) is not None:
        # what spring constant and frequency make it
        stated["mass_ng"] = None
    return replace(table, **stated)
