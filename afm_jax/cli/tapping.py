"""`afm-jax tapping CURVE`: the energy of a tap, thresholds and hysteresis, and where the drive allows it the law."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.options import NOISE
from afm_jax.cli.read import READING_OPTIONS, with_reading
from afm_jax.cli.session import FIT_PROGRAMS, Session, add_note, prepare_folder, with_session
from afm_jax.cli.values import ValueAndError

if TYPE_CHECKING:
    from fitting.tables.table import AmplitudeTable
    from fitting.tapping_curves.measured import MeasuredFile
    from fitting.tapping_curves.result import Tapping


@click.command()
@click.argument("curve_files", metavar="[CURVE]...", nargs=-1, type=click.Path(path_type=Path))
@NOISE
@with_reading
@click.option("--tip-calibration", type=ValueAndError(), metavar="C", help="True over stated amplitude; '1 +- 0.02'.")
@click.option("--curve", type=click.IntRange(1), metavar="N", help="Only this curve of an instrument's file.")
@click.option("--model", default="viscous+delay", show_default=True, help="Of the law, as for `afm-jax fit`.")
@click.option("--example", is_flag=True, help="Analyse the bundled raw file, simulated with the defects of real ones.")
@click.option("--no-law", is_flag=True, help="Leave the impact law out: energy, thresholds and speeds only, at once.")
@click.option(
    "--scale-errors",
    is_flag=True,
    help="Multiply the rows' errors where they scatter more (up to three times), instead of refusing their energy.",
)
@with_session
def command(session: Session, curve_files: tuple[Path, ...], *, no_law: bool, model: str, **options: Any) -> None:
    """Read the energy of a tap off a tapping curve, and where the drive allows it the impact law.

    CURVE is a table of amplitude and phase against height (`# drive = force` or base, columns drive_frequency_khz,
    free_amplitude_nm, offset_nm, lockin_amplitude_nm, phase_lag_deg with their errors, retract), or an instrument's
    file, as for `afm-jax read`. Energy, thresholds and hysteresis, attractive or repulsive branch, impact speeds where
    they can be known; then the law from the rows with fast impacts, or why not and what to record instead. With --out
    the report: tapping.html, .txt, .json, .png and tapping_rows.csv, and that of the law. Several files, or a file of
    several curves, are taken as of one lever: frequency and Q are fitted to all, the scatter from curve to curve stands
    beside the errors, with --out in together.png; each curve has a folder of its own.
    Exit code 3 if the energy of a tap is not determined.
    """
    how = {"no_law": no_law, "scale_errors": options.pop("scale_errors")}
    if options.pop("example") == bool(curve_files):
        raise click.UsageError("give a curve, `afm-jax tapping CURVE`, or --example for a simulated raw file")
    if not curve_files:
        curve_file, options = _example(options)
        curve_files = (curve_file,)
    files = [_read(path, options) for path in curve_files]
    several = len(files) > 1 or len(files[0].tables) != 1 or bool(files[0].refused)
    if several:
        _finish_several(session, curve_files, files, model, how)
        return
    (table,) = files[0].tables.values()
    _finish(session, _analysed(session, table, model, **how))


def _read(path: Path, options: dict[str, Any]) -> "MeasuredFile":
    """Return the curves of a file, a table or an instrument's, with what the call says of the instrument."""
    from fitting.tables.table import read_table  # noqa: PLC0415
    from fitting.tapping_curves.measured import MeasuredFile, is_table, read_measured  # noqa: PLC0415

    if is_table(path):
        _refuse_reading(path, options)
        return MeasuredFile({1: _given(read_table(path, noise=options["noise"]), options)}, {}, {})
    file = read_measured(path, curve=options["curve"], **{name: options[name] for name in READING_OPTIONS})
    for note in file.notes:
        add_note(note)
    return replace(file, tables={number: _calibrated(table, options) for number, table in file.tables.items()})


def _analysed(session: Session, table: "AmplitudeTable", model: str, *, no_law: bool, scale_errors: bool) -> "Tapping":
    from fitting.tapping_curves.tapping import tapping, with_law  # noqa: PLC0415

    result = tapping(table, law=False, scale_errors=scale_errors)
    if no_law or not result.law_allowed:
        return result
    session.start_computing(*FIT_PROGRAMS)
    with session.working("fitting the impact law (the first run compiles for half a minute)"):
        return with_law(result, model)


def _finish(session: Session, result: "Tapping") -> None:
    """Print a result and write its report.

    Raises:
        NotValid: if the energy of a tap is not determined.
    """
    from fitting.tapping_curves.report import tapping_summary, write_tapping  # noqa: PLC0415

    session.emit(result.to_dict(), lambda: tapping_summary(result))
    if session.out is not None:
        for path in write_tapping(result, session.out, session.write_table):
            session.note(f"wrote {path}")
    if not result.valid:
        raise NotValid(result.in_unit(result.reasons[0]))


def _finish_several(
    session: Session, paths: tuple[Path, ...], files: "list[MeasuredFile]", model: str, how: dict[str, bool]
) -> None:
    """The same for several curves of one lever, together and one by one, with the hysteresis of all of them.

    Raises:
        NotValid: if the energy is not determined on every curve, they disagree, or a curve is refused.
    """
    from fitting.tapping_curves.report import tapping_summary, write_tapping, write_together  # noqa: PLC0415
    from fitting.tapping_curves.together import together, together_lines  # noqa: PLC0415

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
    session.emit(payload, *summaries, *text)
    if session.out is not None:
        for number, result in zip(numbers, results, strict=True):
            own = replace(session, out=session.out / f"curve_{number}")
            prepare_folder(session.out / f"curve_{number}", within=session.out)
            for written in write_tapping(result, session.out / f"curve_{number}", own.write_table):
                session.note(f"wrote {written}")
        if whole is not None and whole.scatter:
            for written in write_together(whole, session.out):
                session.note(f"wrote {written}")
    if not payload["valid"]:
        why = [f"curve {one['curve']} refused" for one in refused]
        why += [f"{name}: {result.reasons[0]}" for name, result in named.items() if not result.valid]
        why += [] if whole is None else [reason for reason in whole.reasons if "disagree" in reason]
        raise NotValid(f"{paths[0] if len(paths) == 1 else f'{len(paths)} files'}: {'; '.join(why)}")


def _example(options: dict[str, Any]) -> tuple[Path, dict[str, Any]]:
    """Return the bundled raw file, and the options with what is known of its instrument where they say nothing."""
    from fitting.examples.make_raw_curve import EXAMPLE, OPTIONS  # noqa: PLC0415

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


def _given(table: "AmplitudeTable", options: dict[str, Any]) -> "AmplitudeTable":
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


def _calibrated(table: "AmplitudeTable", options: dict[str, Any]) -> "AmplitudeTable":
    if options["tip_calibration"] is None:
        return table
    value, error = options["tip_calibration"]
    return replace(table, calibration=table.calibration | {"tip_calibration": (value, error or 0.0)})
