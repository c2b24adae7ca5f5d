"""`afm-jax calibrate SWEEP`: frequency, quality factor and stiffness of the free cantilever, sensitivity."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Share, ValueAndError

if TYPE_CHECKING:
    from fitting.calibration.result import Calibration
    from fitting.calibration.stiffness import Stiffness

BACKGROUNDS = ("none", "floor", "constant", "linear")


@click.command()
@click.argument("sweep", metavar="SWEEP", type=click.Path(path_type=Path))
@click.option(
    "--background",
    type=click.Choice(BACKGROUNDS),
    help="What is added to the response: with phase none, constant or linear; without none, floor or constant. "
    "Without this option constant, or what Akaike's criterion prefers clearly.",
)
@click.option("--amplitude-only", is_flag=True, help="Leave the phase of the sweep aside.")
@click.option(
    "--noise",
    type=Share("a relative error"),
    metavar="SHARE",
    help="Error of every point as a share of the largest amplitude.",
)
@click.option("--scale-errors", is_flag=True, help="Take given errors as relative: scale them until chi2/dof is 1.")
@click.option("--whole", is_flag=True, help="Fit all of a thermal spectrum, not what the model explains of it.")
@click.option("--length-um", type=ValueAndError(), metavar="UM", help="Length of a rectangular lever: Sader's method.")
@click.option("--width-um", type=ValueAndError(), metavar="UM", help="Its width, '40 +- 1' with its error.")
@click.option("--temperature-k", type=ValueAndError(), metavar="K", help="Of lever and air [default: the file's, 296].")
@click.option(
    "--deflection",
    type=click.Choice(["static", "mode"]),
    default="static",
    show_default=True,
    help="How a thermal spectrum got its nm: by the slope of a force curve (static InvOLS), or for the mode itself.",
)
@click.option(
    "--scale-error",
    type=Share("a relative error"),
    metavar="SHARE",
    help="Relative error of the deflection's scale (its sensitivity), of which k has twice as much [default: 5 %].",
)
@click.option("--slope", is_flag=True, help="SWEEP holds force curves: the sensitivity (nm/V) from their slope.")
@with_session
def command(session: Session, sweep: Path, *, slope: bool, amplitude_only: bool, **options: Any) -> None:
    """Fit frequency and quality factor to a free resonance sweep or a thermal spectrum.

    SWEEP is Nanonis text, or CSV with the columns frequency_khz (or frequency_hz), amplitude_nm (or amplitude, any
    unit) and, where known, phase_deg, amplitude_error_nm (or amplitude_error), phase_error_deg. Without errors and
    --noise the errors are estimated from the misfit. frequency_khz is the undamped natural frequency, not that of the
    maximum. A thermal spectrum (NanoSurf .nid, or CSV with asd_nm_per_sqrt_hz or psd_nm2_per_hz and a comment
    `# averages = 1000`) gives the spring constant besides, by equipartition and, with the lever's length and width, by
    Sader's method; --slope gives the sensitivity from force curves. With --out the report: calibration.txt, .json, .png
    and (without --slope) calibration_points.csv. Exit code 3 if the result is not valid: no resonance, at the edge, not
    converged, or not explained by the model.
    """
    if slope:
        _sensitivity(session, sweep)
        return
    session.start_computing()
    from fitting.calibration.calibrate import calibrate  # noqa: PLC0415
    from fitting.calibration.report import calibration_summary  # noqa: PLC0415
    from fitting.calibration.sweep import read_sweep, without_phase  # noqa: PLC0415

    measured = read_sweep(sweep)
    if amplitude_only:
        measured = without_phase(measured)
    with session.working(f"fitting {measured.points} points (the first run compiles for some seconds)"):
        fit_options = {name: options[name] for name in ("background", "noise", "scale_errors", "whole")}
        result = calibrate(measured, **fit_options)
    found = _stiffnesses(result, options)
    data, doubt = result.to_dict(), None
    if found:
        from fitting.calibration.stiffness import stiffness_payload, uncalibrated  # noqa: PLC0415

        data |= stiffness_payload(result, found)
        doubt = uncalibrated(found)

    def summary() -> str:
        text = calibration_summary(result, doubt)
        if not found:
            return text
        from fitting.calibration.stiffness import stiffness_lines  # noqa: PLC0415

        return "\n".join([text, "", "Spring constant:", *stiffness_lines(result, found)])

    session.emit(data, summary)
    if session.out is not None:
        from fitting.calibration.report import write_calibration  # noqa: PLC0415

        for path in write_calibration(result, session.out, session.write_table, summary(), data):
            session.note(f"wrote {path}")
    if data["reasons"]:
        raise NotValid(data["reasons"][0])


def _stiffnesses(result: "Calibration", options: dict[str, Any]) -> "list[Stiffness]":
    """Return the spring constants that a calibration supports: equipartition, Sader's method, both or none.

    Raises:
        click.UsageError: if the lever has only one of length and width.
    """
    from fitting.calibration.stiffness import AIR_K, equipartition, sader  # noqa: PLC0415

    given = {key: options[key] for key in ("length_um", "width_um") if options[key] is not None}
    if len(given) == 1:
        raise click.UsageError("Sader's method needs both --length-um and --width-um")
    temperature = options["temperature_k"]
    warm = None if temperature is None else (temperature[0], temperature[1] or 0.0)
    found = []
    if not result.valid:
        return found
    if given:
        sides = {key: (value, error or 0.0) for key, (value, error) in given.items()}
        found.append(sader(result, **sides, temperature_k=warm or AIR_K))
    if result.mean_square is not None:
        known = {} if options["scale_error"] is None else {"scale_error": options["scale_error"]}
        beside, static = next(iter(found), None), options["deflection"] == "static"
        found.insert(0, equipartition(result, temperature_k=warm, static=static, beside=beside, **known))
    return found


def _sensitivity(session: Session, path: Path) -> None:
    from dataclasses import asdict  # noqa: PLC0415

    from afm_jax.strict_json import plain  # noqa: PLC0415
    from fitting.calibration.stiffness import budget, sensitivity, stiffness_lines  # noqa: PLC0415
    from fitting.instruments.curve import read_curves  # noqa: PLC0415

    curves = read_curves(path)
    found = sensitivity(curves)
    data = {"deflection_nm_per_volt": asdict(found.value), "assumed": found.assumed, "valid": True}
    data |= {"budget": budget(None, [found])}
    text = "\n".join(stiffness_lines(None, [found]))
    session.emit(data, text)
    if session.out is not None:
        from afm_jax.plots.picture_style import png_of  # noqa: PLC0415
        from fitting.calibration.report import slope_figure  # noqa: PLC0415
        from fitting.report.report import write_report_files  # noqa: PLC0415

        picture = png_of(slope_figure(curves, found))
        for written in write_report_files(session.out, "calibration", text=text, data=plain(data), picture=picture):
            session.note(f"wrote {written}")
