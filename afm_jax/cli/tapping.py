"""`afm-jax tapping CURVE`: the energy of a tap, thresholds and hysteresis, and where the drive allows it the law."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import click

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session, add_note
from afm_jax.cli.values import CurveNumber, Share, option_of
from afm_jax.saved import as_json
from afm_jax.whole_files import check_plain
from fitting.examples import RAW_CURVE, RAW_CURVE_OPTIONS
from fitting.tapping_curves.measured import measured
from fitting.tapping_curves.tapping import energies_of_table, with_law
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
        **reading: as `ReadingOptions` and `LeverOptions`.
    """
    if example == bool(curve_files):
        raise click.UsageError("give a curve, `afm-jax tapping CURVE`, or --example for a simulated raw file")
    if example:
        stated = {name: value for name, value in RAW_CURVE_OPTIONS.items() if reading[name] in {None, ""}}
        path = RAW_CURVE.relative_to(Path.cwd()) if RAW_CURVE.is_relative_to(Path.cwd()) else RAW_CURVE
        words = " ".join(f"{option_of(name)} '{value}'" for name, value in stated.items())
        add_note(f"The example is simulated; as if it were measured: afm-jax tapping {path} {words}")
        curve_files, reading = (path,), reading | stated
    read = measured(curve_files, curve=curve, noise=noise, **reading)
    add_note(*read.notes)
    results = [energies_of_table(table, scale_errors=scale_errors) for table in read.tables.values()]
    for number, result in enumerate(results):
        if result.law_allowed and not no_law:
            session.start_computing()
            with session.working("fitting the impact law (the first run compiles for half a minute)"):
                results[number] = with_law(result, model)
    if len(results) == 1 and not read.refused:
        (result,) = results
        return Output.of(result, report=result.report)
    whole = together(results, read.refused)
    curves = dict(zip(read.tables, whole.curves, strict=True))

    def write(folder: Path) -> list[Path]:
        """Write a report of each curve into a folder of its own, and of all together if they scatter."""
        written: list[Path] = []
        for number, result in curves.items():
            below = folder / f"curve_{number}"
            check_plain(below)
            written += result.report(below)
        return written + (whole.report(folder) if whole.scatter else [])

    return Output(
        payload={
            "valid": whole.valid,
            "curves": [{"curve": number, **as_json(result)} for number, result in curves.items()],
            "together": as_json(whole) if curves else None,
            "refused": read.refused,
        },
        text=[*curves.values(), whole],
        report=write,
        not_valid=None if whole.valid else "; ".join(whole.reasons),
    )
