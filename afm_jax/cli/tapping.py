"""`afm-jax tapping CURVE`: the energy of a tap, thresholds and hysteresis, and where the drive allows it the law."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import click

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session, add_note, prepare_folder
from afm_jax.cli.values import CurveNumber, Share, option_of
from afm_jax.whole_files import check_plain
from fitting.examples.make_raw_curve import EXAMPLE, OPTIONS
from fitting.tables.table import AmplitudeTable, read_table
from fitting.tapping_curves.measured import MeasuredFile, is_table, read_measured
from fitting.tapping_curves.report import tapping_summary, together_summary, write_tapping, write_together
from fitting.tapping_curves.result import Tapping
from fitting.tapping_curves.tapping import tapping, with_law
from fitting.tapping_curves.together import together


def energy_of_taps(  # noqa: PLR0913
    session: Session,
    curve_files: Annotated[Sequence[Path], "[CURVE]..."],
    *,
    noise: Annotated[float | None, Share("a relative error")] = None,
    curve: CurveNumber | None = None,
    model: str = "viscous+delay",
    example: bool = False,
    no_law: bool = False,
    scale_errors: bool = False,
    **reading: Any,
) -> Output:
    """Determine the energy of a tap from a tapping curve, and above resonance the impact law.

    CURVE is a table of amplitude and phase against height (`# drive = force` or base, columns drive_frequency_khz,
    free_amplitude_nm, offset_nm, lockin_amplitude_nm, phase_lag_deg with their errors, retract), or an instrument's
    file, as for `afm-jax read`. The output gives the energy along the attractive and the repulsive branch, thresholds,
    hysteresis, and impact speeds if they can be determined; then the law from the rows with fast impacts, or why there
    is none and what to record instead. With --out the report: tapping.html, .txt, .json, .png and tapping_rows.csv, and
    that of the law. Several files, or several curves of a file, are assumed to be of one cantilever: frequency and Q
    are fitted to all of them, and the scatter from curve to curve stands beside the errors (with --out together.html,
    .txt, .json, .png, and a folder for each curve). Exit code 3 if the energy of a tap is not determined.

    Args:
        session: for progress and files.
        curve_files: files.
        noise: relative error of amplitudes for which the table states none, such as 1%.
        curve: only this curve of an instrument's file.
        model: model of the law, as for `afm-jax fit`.
        example: analyse the bundled raw file, simulated with the defects of real ones.
        no_law: do not fit the impact law: energy, thresholds and speeds only.
        scale_errors: multiply the rows' errors (by 3 at most) where rows scatter more, instead of refusing their
            energy.
        **reading: as `ReadingOptions`.
    """
    if example == bool(curve_files):
        raise click.UsageError("give a curve, `afm-jax tapping CURVE`, or --example for a simulated raw file")
    if example:
        path, reading = _example(reading)
        curve_files = (path,)

    def analysed(table: AmplitudeTable) -> Tapping:
        result = tapping(table, law=False, scale_errors=scale_errors)
        if no_law or not result.law_allowed:
            return result
        session.start_computing()
        with session.working("fitting the impact law (the first run compiles for half a minute)"):
            return with_law(result, model)

    files = [_read(path, noise, curve, reading) for path in curve_files]
    if len(files) > 1 or len(files[0].tables) != 1 or files[0].refused:
        return _together(session, curve_files, files, analysed)
    (table,) = files[0].tables.values()
    result = analysed(table)
    output = Output.of_report(result, partial(tapping_summary, result), partial(write_tapping, result))
    return output if result.valid else replace(output, not_valid=result.in_unit(result.reasons[0]))


def _read(path: Path, noise: float | None, curve: int | None, reading: dict[str, Any]) -> MeasuredFile:
    """Return the curves of a file, a table or an instrument's, with what the call says of the instrument.

    Raises:
        click.UsageError: if an option says how to read an instrument's file where a table says it all.
    """
    if is_table(path):
        for name, value in {"curve": curve, **reading}.items():
            if name not in {*_OF_TABLES, "phase_sense"} and value not in {None, ""}:
                raise click.UsageError(
                    f"{option_of(name)} is for an instrument's file; {path} is a table, which says that itself"
                )
        return MeasuredFile({1: _given(read_table(path, noise=noise), reading)}, {})
    file = read_measured(path, curve=curve, **reading)
    add_note(*file.notes)
    return file


def _together(
    session: Session,
    paths: Sequence[Path],
    files: list[MeasuredFile],
    analysed: Callable[[AmplitudeTable], Tapping],
) -> Output:
    """Return what is known of several curves of one lever, together and one by one."""
    tables = [(number, table) for file in files for number, table in file.tables.items()]
    whole = together([analysed(table) for _, table in tables]) if tables else None
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
    why = [f"curve {each['curve']} refused" for each in refused]
    why += [f"curve {number}: {result.reasons[0]}" for number, result in curves.items() if not result.valid]
    why += [] if whole is None else [reason for reason in whole.reasons if "disagree" in reason]
    named = f"{paths[0] if len(paths) == 1 else f'{len(paths)} files'}"

    def write(folder: Path, _: Any) -> list[Path]:
        """Write a report of each curve into a folder of its own, and of all together if they scatter."""
        written: list[Path] = []
        for number, result in curves.items():
            below = folder / f"curve_{number}"
            check_plain(below)
            prepare_folder(below)
            written += write_tapping(result, below, replace(session, out=below).write_table)
        return written + (write_together(whole, folder) if whole is not None and whole.scatter else [])

    return Output(
        payload={
            "valid": valid,
            "curves": [{"curve": number, **result.to_dict()} for number, result in curves.items()],
            "together": None if whole is None else whole.to_dict(),
            "refused": refused,
        },
        text=text,
        report=write,
        not_valid=None if valid else f"{named}: {'; '.join(why)}",
    )


def _example(reading: dict[str, Any]) -> tuple[Path, dict[str, Any]]:
    """Return the bundled raw file, and the options with what is known of its instrument where they say nothing."""
    stated = {name: value for name, value in OPTIONS.items() if reading[name] in {None, ""}}
    path = EXAMPLE.relative_to(Path.cwd()) if EXAMPLE.is_relative_to(Path.cwd()) else EXAMPLE
    # --spring-constant stands for --spring-constant-n-per-m
    words = [
        f"{option_of(name.removesuffix('_n_per_m'))} {value if isinstance(value, str) else _PAIR.format(*value)}"
        for name, value in stated.items()
    ]
    add_note(f"The example is simulated; as if it were measured: afm-jax tapping {path} {' '.join(words)}")
    return path, reading | stated


_PAIR = "'{:g} +- {:g}'"
_OF_TABLES = {
    "free_frequency_khz": ("free_frequency_khz", "free_frequency_error_khz"),
    "quality_factor": ("quality_factor", "quality_factor_error"),
    "spring_constant_n_per_m": ("spring_constant_n_per_m", "spring_constant_error_n_per_m"),
}
"""What the command line may say in place of a table, and what a table calls value and error."""


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
