"""`afm-jax tapping CURVE`: the energy of a tap, thresholds and hysteresis, and where the drive allows it the law."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.read import READING_OPTIONS, with_reading
from afm_jax.cli.session import Session, add_note, prepare_folder, with_session
from afm_jax.cli.values import ValueAndError, with_noise

if TYPE_CHECKING:
    from fitting.tables.table import AmplitudeTable
    from fitting.tapping_curves.measured import MeasuredFile
    from fitting.tapping_curves.result import Tapping


@click.command()
@click.argument("curve_file", metavar="CURVE", required=False, type=click.Path(path_type=Path))
@with_noise
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
def command(session: Session, curve_file: Path | None, *, no_law: bool, model: str, **options: Any) -> None:
    """Read the energy of a tap off a tapping curve, and where the drive allows it the impact law.

    CURVE is a table of amplitude and phase against height (`# drive = force` or base, columns drive_frequency_khz,
    free_amplitude_nm, offset_nm, lockin_amplitude_nm, phase_lag_deg with their errors, retract), or an instrument's
    file, as for `afm-jax read`. Energy, thresholds and hysteresis, attractive or repulsive branch, impact speeds where
    they can be known; then the law from the rows with fast impacts, or why not and what to record instead. With --out
    the report: tapping.html, .txt, .json, .png and tapping_rows.csv, and that of the law; of a file of several curves
    in a folder each. Exit code 3 if the energy of a tap is not determined.
    """
    from fitting.tables.table import read_table  # noqa: PLC0415
    from fitting.tapping_curves.measured import is_table, read_measured  # noqa: PLC0415

    how = {"no_law": no_law, "scale_errors": options.pop("scale_errors")}
    if options.pop("example") == (curve_file is not None):
        raise click.UsageError("give a curve, `afm-jax tapping CURVE`, or --example for a simulated raw file")
    if curve_file is None:
        curve_file, options = _example(options)
    if is_table(curve_file):
        _refuse_reading(curve_file, options)
        result = _analysed(session, _given(read_table(curve_file, noise=options["noise"]), options), model, **how)
        _finish(session, result)
        return
    file = read_measured(curve_file, curve=options["curve"], **{name: options[name] for name in READING_OPTIONS})
    for note in file.notes:
        add_note(note)
    results = {
        number: _analysed(session, _calibrated(table, options), model, **how) for number, table in file.tables.items()
    }
    if len(results) == 1 and not file.refused:
        _finish(session, next(iter(results.values())))
        return
    _finish_several(session, curve_file, file, results)


def _analysed(session: Session, table: "AmplitudeTable", model: str, *, no_law: bool, scale_errors: bool) -> "Tapping":
    from fitting.tapping_curves.tapping import tapping, with_law  # noqa: PLC0415

    result = tapping(table, law=False, scale_errors=scale_errors)
    if no_law or not result.law_allowed:
        return result
    session.start_computing(*(f"fitting.forward:{name}" for name in ("impacts_of", "located", "linearise_pairs")))
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


def _finish_several(session: Session, path: Path, file: "MeasuredFile", results: "dict[int, Tapping]") -> None:
    """The same for the curves of one file, with the hysteresis of all of them.

    Raises:
        NotValid: if the energy is not determined on every curve, or a curve is refused.
    """
    from fitting.tapping_curves.report import tapping_summary, write_tapping  # noqa: PLC0415

    width = file.half_width_nm
    summaries = [lambda result=result: tapping_summary(result) + "\n" for result in results.values()]
    text = [f"Curve {number} refused: {reason}" for number, reason in file.refused.items()]
    if width is not None:
        each = ", ".join(f"{one:.2f}" for one in file.half_widths_nm.values())
        text.append(
            f"Hysteresis at half of the free amplitude: {width[0]:.2f} nm, scatter {width[1]:.2f} nm over "
            f"{len(file.half_widths_nm)} curves ({each}); it needs no calibration of the amplitude"
        )
    payload = {
        "valid": bool(results) and not file.refused and all(result.valid for result in results.values()),
        "curves": [{"curve": number, **result.to_dict()} for number, result in results.items()],
        "refused": [{"curve": number, "reason": reason} for number, reason in file.refused.items()],
        "half_width_nm": None if width is None else {"mean": width[0], "scatter": width[1]},
        "half_widths_nm": [{"curve": number, "width_nm": one} for number, one in file.half_widths_nm.items()],
    }
    session.emit(payload, *summaries, *text)
    if session.out is not None:
        for number, result in results.items():
            own = replace(session, out=session.out / f"curve_{number}")
            prepare_folder(session.out / f"curve_{number}", within=session.out)
            for written in write_tapping(result, session.out / f"curve_{number}", own.write_table):
                session.note(f"wrote {written}")
    if not payload["valid"]:
        named = [f"curve {number} refused" for number in file.refused]
        named += [f"curve {number}: {result.reasons[0]}" for number, result in results.items() if not result.valid]
        raise NotValid(f"{path}: {'; '.join(named)}")


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
