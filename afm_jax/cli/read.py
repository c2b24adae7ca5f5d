"""`afm-jax read FILE`: tapping curves out of an instrument's file, as tables for `tapping` and `fit`."""

from pathlib import Path
from typing import Any

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Finite, ValueAndError

_NUMBERS = (
    ("drive-frequency-khz", "KHZ", "Frequency of the drive; where nothing says it, the free frequency."),
    ("free-frequency-khz", "KHZ", "Natural frequency of the free cantilever, '90 +- 0.01' with its error."),
    ("quality-factor", "Q", "Its quality factor, '200 +- 5' with its error."),
    ("spring-constant-n-per-m", "N_PER_M", "Its modal spring constant (1.03 times the static one), '5.4 +- 0.5'."),
    ("free-amplitude-nm", "NM", "Amplitude of the free tip; else the median of the rows far from the sample."),
    ("offset-origin-nm", "NM", "Height (growing towards the tip) at which the sample is at the tip's rest position."),
    ("amplitude-error-nm", "NM", "Standard error of every amplitude; else the scatter of the free rows."),
    ("phase-error-deg", "DEGREES", "Standard error of every phase; else the scatter of the free rows."),
)


class NmPerVolt(ValueAndError):  # noqa: N818 (no exception)
    """A value with its error, or the word `slope`."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the value and its error, or the word."""
        return value if value == "slope" else super().convert(value, param, ctx)


def with_reading(function):
    """Add the options that say how an instrument's file becomes rows of a table."""
    for name, unit, text in reversed(_NUMBERS):
        short = ("--spring-constant",) if name.startswith("spring") else ()
        function = click.option(f"--{name}", *short, type=ValueAndError(), metavar=unit, help=text)(function)
    for option in reversed(_READING):
        function = option(function)
    return function


_READING = (
    click.option(
        "--columns",
        metavar="COLUMN=CHANNEL[:UNIT][:FACTOR],...",
        default="",
        help="Which channel becomes which column (offset_nm, lockin_amplitude_nm, phase_lag_deg, deflection_nm), as "
        "offset_nm=Z:um,lockin_amplitude_nm=Amp:V; without a head channels are numbers, and with approach and retract "
        "in two of them OUT/BACK: offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V,phase_lag_deg=7/8.",
    ),
    click.option(
        "--drive",
        type=click.Choice(["base", "force"]),
        help="What shakes the tip: a piezo at its base (assumed without this option), or a force (photothermal, "
        "magnetic).",
    ),
    click.option(
        "--nm-per-volt",
        type=NmPerVolt(),
        metavar="NM|slope",
        help="Sensitivity of an amplitude in volts; `slope`: such that the amplitude falls by 1 nm per nm in contact.",
    ),
    click.option(
        "--bin-nm",
        type=Finite(),
        metavar="NM",
        help="Width of the bins of height whose means and scatter are the rows (0: equal heights only); else bins of "
        "five rows where heights repeat or are not in order.",
    ),
)


READING_OPTIONS = ("columns", "drive", "nm_per_volt", "bin_nm", *(name.replace("-", "_") for name, _, _ in _NUMBERS))
"""Names of the arguments that `with_reading` adds, as `read_curves` takes them."""


@click.command()
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
@click.option("--curve", type=click.IntRange(1), metavar="N", help="Only this curve of the file.")
@with_reading
@with_session(out_file="TABLE.csv")
def command(session: Session, file: Path, curve: int | None, **options: Any) -> None:
    """Read amplitude and phase against height out of an instrument's file.

    FILE is neaSNOM text, WSxM curves, an Asylum .ibw ramp, a NanoSurf .nid, Nanonis .dat or Gwyddion .gwy file, or text
    separated by tabs, semicolons, commas or blanks, with a head or without (--columns). Says what was found, where each
    number comes from, what was assumed and what is missing. With --out the table for `afm-jax tapping` and `afm-jax
    fit`; of a file of several curves one table each, TABLE_1.csv and so on. Repeated and unordered heights become bins.
    Curves that must not be used (a free amplitude that jumps) are refused by name, and the exit code is 3. Package
    extra for .ibw: `pip install 'afm-jax[instruments]'`.
    """
    from fitting.instruments.curve import read_curve, read_curves  # noqa: PLC0415
    from fitting.instruments.report import curves_payload, curves_summary, write_tables  # noqa: PLC0415

    curves = read_curves(file, **options) if curve is None else [read_curve(file, curve=curve, **options)]
    # what is missing ends the command before anything is printed
    written = [] if session.out is None or not any(one.valid for one in curves) else write_tables(curves, session.out)
    session.emit(curves_payload(curves), lambda: curves_summary(curves))
    for path in written:
        session.note(f"wrote {path}")
    refused = [one for one in curves if not one.valid]
    if refused:
        numbers = ", ".join(str(one.curve) for one in refused)
        raise NotValid(f"{file}: refused curve {numbers}; {refused[0].reasons[0]}")
