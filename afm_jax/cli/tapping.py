"""`afm-jax tapping CURVE`: the energy of a tap, thresholds and hysteresis, and where the drive allows it the law."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from afm_jax.cli.command import Output
from afm_jax.cli.commands.measure import READING_OPTIONS
from afm_jax.cli.session import FIT_PROGRAMS, Session, add_note, prepare_folder
from fitting.examples.make_raw_curve import EXAMPLE, OPTIONS
from fitting.tables.table import AmplitudeTable, read_table
from fitting.tapping_curves.measured import MeasuredFile, is_table, read_measured
from fitting.tapping_curves.report import tapping_summary, write_tapping, write_together
from fitting.tapping_curves.result import Tapping
from fitting.tapping_curves.tapping import tapping
from fitting.tapping_curves.together import TappingTogether, together, together_lines


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
    output = Output.of(result, partial(tapping_summary, result), partial(write_tapping, result))
    return output if result.valid else replace(output, not_valid=result.in_unit(result.reasons[0]))


def _read(path: Path, options: dict[str, Any]) -> MeasuredFile:
    """Return the curves of a file, a table or an instrument's, with what the call says of the instrument."""
    if is_table(path):
        _refuse_reading(path, options)
        return MeasuredFile({1: _given(read_table(path, noise=options["noise"]), options)}, {}, {})
    file = read_measured(path, curve=options["curve"], **{name: options[name] for name in READING_OPTIONS})
    for note in file.notes:
        add_note(note)
    return replace(file, tables={number: _calibrated(table, options) for number, table in file.tables.items()})


def _analysed(session: Session, table: AmplitudeTable, model: str, *, no_law: bool, scale_errors: bool) -> Tapping:
    result = tapping(table, law=False, scale_errors=scale_errors)
    if no_law or not result.law_allowed:
        return result
    session.start_computing(*FIT_PROGRAMS)
    from fitting.tapping_curves.tapping import with_law  # noqa: PLC0415

    with session.working("fitting the impact law (the first run compiles for half a minute)"):
        return with_law(result, model)


def _together(
    session: Session, paths: tuple[Path, ...], files: list[MeasuredFile], model: str, how: dict[str, bool]
) -> Output:
    """Return what is known of several curves of one lever, together and one by one, with the hysteresis of all."""
    places = [(i, number) for i, file in enumerate(files) for number in file.tables]
    tables = [files[i].tables[number] for i, number in places]
    whole = together([_analysed(session, table, model, **how) for table in tables]) if tables else None
    results = () if whole is None else whole.curves
    numbers = [number for _, number in places] if len(files) == 1 else list(range(1, len(places) + 1))
    named = {"curve " + str(number): result for number, result in zip(numbers, results, strict=True)}
    refused = [
        {"curve": number, "reason": reason} | ({} if len(files) == 1 else {"file": str(path)})
        for path, file in zip(paths, files, strict=True)
        for number, reason in file.refused.items()
    ]
    summaries = [lambda result=result: tapping_summary(result) + "\n" for result in results]
    text = [f"Curve {one['curve']} refused: {one['reason']}" for one in refused]
    width, widths = files[0].half_width_nm, files[0].half_widths_nm
    if len(files) == 1 and width is not None:
        each = ", ".join(f"{one:.2f}" for one in widths.values())
        text.append(
            f"Hysteresis at half of the free amplitude: {width[0]:.2f} nm, scatter {width[1]:.2f} nm over "
            f"{len(widths)} curves ({each}); it needs no calibration of the amplitude"
        )
    if whole is not None and len(results) > 1:
        text.append("\n".join(together_lines(whole)))
    payload = {
        "valid": whole is not None and whole.valid and not refused,
        "curves": [{"curve": number, **result.to_dict()} for number, result in zip(numbers, results, strict=True)],
        "together": None if whole is None else whole.to_dict(),
        "refused": refused,
        "half_width_nm": None if len(files) > 1 or width is None else {"mean": width[0], "scatter": width[1]},
        "half_widths_nm": [] if len(files) > 1 else [{"curve": n, "width_nm": one} for n, one in widths.items()],
    }
    return Output(
        payload=payload,
        text=[*summaries, *text],
        report=partial(_write_curves, session, dict(zip(numbers, results, strict=True)), whole),
        not_valid=None if payload["valid"] else _why_not(paths, refused, named, whole),
    )


def _write_curves(
    session: Session, curves: dict[int, Tapping], whole: TappingTogether | None, folder: Path, _: Any
) -> list[Path]:
    """Write a report of each curve into a folder of its own, and of all together if they scatter; return the paths."""
    written: list[Path] = []
    for number, result in curves.items():
        own = replace(session, out=folder / f"curve_{number}")
        prepare_folder(folder / f"curve_{number}", within=folder)
        written += write_tapping(result, folder / f"curve_{number}", own.write_table)
    if whole is not None and whole.scatter:
        written += write_together(whole, folder)
    return written


def _why_not(
    paths: tuple[Path, ...], refused: list[dict[str, Any]], named: dict[str, Tapping], whole: TappingTogether | None
) -> str:
    why = [f"curve {one['curve']} refused" for one in refused]
    why += [f"{name}: {result.reasons[0]}" for name, result in named.items() if not result.valid]
    why += [] if whole is None else [reason for reason in whole.reasons if "disagree" in reason]
    return f"{paths[0] if len(paths) == 1 else f'{len(paths)} files'}: {'; '.join(why)}"


def _example(options: dict[str, Any]) -> tuple[Path, dict[str, Any]]:
    """Return the bundled raw file, and the options with what is known of its instrument where they say nothing."""
    stated = {name: value for name, value in OPTIONS.items() if options[name] in {None, ""}}
    path = EXAMPLE.relative_to(Path.cwd()) if EXAMPLE.is_relative_to(Path.cwd()) else EXAMPLE
    words = " ".join(f"{_OPTION_OF.get(name, f'--{name}')} {_shown(value)}" for name, value in stated.items())
    add_note(f"The example is simulated; as if it were measured: afm-jax tapping {path} {words}")
    return path, options | stated


_OPTION_OF = {
    "nm_per_volt": "--nm-per-volt",
    "spring_constant_n_per_m": "--spring-constant",
    "quality_factor": "--quality-factor",
    "free_frequency_khz": "--free-frequency-khz",
}


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else f"'{value[0]:g} +- {value[1]:g}'"


def _refuse_reading(path: Path, options: dict[str, Any]) -> None:
    """Refuse options that say how to read an instrument's file where a table says it all.

    Raises:
        click.UsageError: naming the first of them.
    """
    names = ("curve", *(name for name in READING_OPTIONS if name not in _OF_TABLES))
    given = next((name for name in names if options[name] not in {None, ""}), None)
    if given is not None:
        raise click.UsageError(
            f"--{given.replace('_', '-')} is for an instrument's file; {path} is a table, which says that itself"
        )


_OF_TABLES = ("free_frequency_khz", "quality_factor", "spring_constant_n_per_m")
"""What the command line may say in place of a table."""


def _given(table: AmplitudeTable, options: dict[str, Any]) -> AmplitudeTable:
    """Return a table with what the call says of the instrument in place of its own."""
    names = {
        "free_frequency_khz": ("free_frequency_khz", "free_frequency_error_khz"),
        "quality_factor": ("quality_factor", "quality_factor_error"),
        "spring_constant_n_per_m": ("spring_constant_n_per_m", "spring_constant_error_n_per_m"),
    }
    own = {
        name: number
        for option, pair in names.items()
        if options[option] is not None
        for name, number in zip(pair, options[option], strict=True)
    }
    if own and own.get("spring_constant_n_per_m", table.spring_constant_n_per_m) is not None:
        # what spring constant and frequency make it
        own["mass_ng"] = None
    return _calibrated(replace(table, **own) if own else table, options)


def _calibrated(table: AmplitudeTable, options: dict[str, Any]) -> AmplitudeTable:
    if options["tip_calibration"] is None:
        return table
    value, error = options["tip_calibration"]
    return replace(table, calibration=table.calibration | {"tip_calibration": (value, error or 0.0)})
