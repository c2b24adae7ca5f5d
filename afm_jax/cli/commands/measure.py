"""Commands that read data of instruments, fit them, and plan what to measure next."""

from pathlib import Path
from typing import Any

import click

from afm_jax.cli.command import Command, Options
from afm_jax.cli.fit_options import Constraint, Fixed, Names, check_fit
from afm_jax.cli.options import NOISE, QUALITY_FACTOR, flag
from afm_jax.cli.session import Session
from afm_jax.cli.values import Finite, Numbers, Orders, Share, ValueAndError, option_of
from fitting.parameters import (
    CONTACT_DEFAULT,
    DELAY_LAW,
    LAW_NAMES,
    LAWS,
    MODELS,
    NUISANCE_NAMES,
    PARAMETERS,
    PRIOR_NUISANCES,
)


def _number(name: str, unit: str, text: str) -> Any:
    """Return the option of a number with its error."""
    short = ("--spring-constant",) if name.startswith("spring") else ()
    return click.option(f"--{name}", *short, type=ValueAndError(), metavar=unit, help=text)


CALIBRATE = Command(
    name="calibrate",
    runs="afm_jax.cli.calibrate:calibration",
    help="""Fit frequency and quality factor to a frequency scan of the free resonance, or to a thermal spectrum.

    SWEEP is Nanonis text, or columns frequency_khz (or frequency_hz), amplitude_nm (or amplitude, any unit) and, where
    known, phase_deg, amplitude_error_nm (or amplitude_error). A thermal spectrum (NanoSurf .nid, or
    asd_nm_per_sqrt_hz or psd_nm2_per_hz) gives the spring constant, too, by equipartition; with the lever's size also
    by Sader's method. Comments `# averages = 1000`, `# temperature_k = 296` and so on stand for options. frequency_khz
    is the undamped natural frequency, not that of the maximum. With --out calibration.json, .png and
    calibration_points.csv. Exit code 3 if the result is not valid: no resonance, at the edge, not explained by the
    model, or a scale of the deflection that another spring constant contradicts.
    """,
    options=(
        click.argument("sweep", metavar="SWEEP", type=click.Path(path_type=Path)),
        click.option(
            "--averages",
            type=Finite(positive=True),
            metavar="N",
            help="Spectra that a thermal spectrum is the mean of.",
        ),
        _number("length-um", "UM", "Length of a rectangular lever, '225 +- 2' with its error: Sader's method."),
        _number("width-um", "UM", "Its width."),
        _number("temperature-k", "K", "Of lever and air [default: the file's, 296 +- 3]."),
        click.option(
            "--deflection",
            type=click.Choice(["static", "mode"]),
            default="static",
            help="How a thermal spectrum got its nm: by the slope of a force curve (static InvOLS), or for the mode "
            "itself.",
        ),
        click.option(
            "--scale-error",
            type=Share("a relative error"),
            metavar="SHARE",
            help="Relative error of the deflection's scale (its sensitivity), of which k has twice as much "
            "[default: 5 %].",
        ),
    ),
    computes=False,
)


def _check_lists(_: Session, options: Options) -> None:
    """Check that places are said once."""
    if options["offsets_nm"] is not None and options["heights"] is not None:
        raise click.UsageError("--offsets-nm and --heights both say where the sample can be; give one")


DESIGN = Command(
    name="design",
    runs="afm_jax.cli.design:planned",
    help="""Choose the drives to measure next, and forecast how well the law will then be known.

    Say what is known: the cantilever (--free-frequency-khz, --quality-factor '40 +- 2') and the law (--r,
    --epsilon, ...), or a fit of what was measured so far (--fit); and what can be driven: every combination of
    orders, frequencies, amplitudes and offsets is a candidate; with --drive force or base (the cantilever is driven
    itself, amplitude and lag are read) of frequencies, free amplitudes and heights. LISTs are numbers and ranges, 1,2,5
    or 170:190:1. With --out design.csv, .json and .png. Exit code 3 if no drive can be planned with, or the points do
    not determine the law.
    """,
    options=(
        click.option(
            "--orders",
            type=Orders(),
            metavar="LIST",
            help="Drive periods an impact; else 1-4, or 1 where the tip is driven.",
        ),
        click.option(
            "--detuning",
            type=Numbers(),
            metavar="LIST",
            help="Drive frequencies as multiples of each order's resonance 2 N f0, else 0.97:1.05:0.01; or of f0 "
            "where the tip is driven, else 1.02:1.1:0.02.",
        ),
        click.option(
            "--drive-nm",
            type=Numbers(),
            metavar="LIST",
            help="Drive amplitudes, else 2,4,7,10; or free ones, else 40,80.",
        ),
        click.option("--offsets-nm", type=Numbers(positive=False), metavar="LIST", help="Offsets; else -1,0,1."),
        click.option(
            "--heights",
            type=Numbers(positive=False),
            metavar="LIST",
            help="Where the tip is driven, in place of offsets: distances of the sample as shares of each free "
            "amplitude; else 0.1:0.9:0.1.",
        ),
        click.option("--largest-nm", type=Finite(), metavar="X", help="Peak amplitude that the instrument takes."),
        click.option("--points", type=click.IntRange(1, 200), default=8, help="How many to choose."),
        click.option(
            "--for", "interest", metavar="NAMES", help="Parameters to be known well, as r,epsilon; else the law's."
        ),
        click.option(
            "--noise",
            type=Share("a relative error"),
            default="1%",
            metavar="SHARE",
            help="Relative error of an amplitude.",
        ),
        click.option("--phase-noise-deg", type=Finite(), default=0.2, metavar="X", help="Error of a lag, tip driven."),
        click.option(
            "--amplitudes",
            type=click.Choice(("both", "peak", "lockin")),
            default="both",
            help="What is read of a point.",
        ),
        click.option(
            "--uncertainty",
            type=Share("a relative error"),
            default="10%",
            metavar="SHARE",
            help="How far the law may be off where no fit says.",
        ),
        click.option(
            "--fit",
            type=click.Path(path_type=Path),
            metavar="JSON",
            help="A fit to add to, as `afm-jax fit --json` writes it, or its folder.",
        ),
        click.option("--model", type=click.Choice(MODELS), help="What will be fitted; else law+delay, or the fit's."),
        click.option("--mass-ng", type=Finite(), metavar="X", help="Effective mass of the tip."),
        click.option(
            "--drive",
            type=click.Choice(("sample", "force", "base")),
            help="What is driven: the sample, or the cantilever itself; else the sample.",
        ),
        *(
            click.option(
                option_of(name),
                type=Finite(),
                metavar="X",
                help=f"{', '.join(filter(None, (PARAMETERS[name].meaning, PARAMETERS[name].unit)))}; else the paper's.",
            )
            for name in LAW_NAMES
        ),
        *(
            click.option(
                option_of(nuisance.name),
                type=ValueAndError(none=nuisance.name == "quality_factor"),
                metavar="X",
                help=f"{nuisance.meaning}, 'VALUE +- ERROR'.",
            )
            for nuisance in PRIOR_NUISANCES
        ),
    ),
    check=_check_lists,
)


FIT = Command(
    name="fit",
    runs="afm_jax.cli.fit:fit",
    help="""Fit the impact law to a table of vibration amplitudes, or one law to several tables.

    The table is a CSV file: comment lines `# free_frequency_khz = 90`, `# quality_factor = 40 +- 1`, and columns
    order, drive_frequency_khz, drive_amplitude_nm, offset_nm, peak_amplitude_nm and/or lockin_amplitude_nm, each
    with its ..._error_nm; a column no_orbit marks by 1 drives on which the tip settled on nothing; phase_deg
    counts too. With a line `# drive = force` (or base) it is a tapping curve: drive_frequency_khz, free_amplitude_nm,
    offset_nm, lockin_amplitude_nm and phase_lag_deg. Several tables have one law, each nuisances of its own or shared
    ones, and the report says how far each is from the others (its deviation). With --out the report: fit.html, fit.txt,
    fit.json, fit.png, fit_rows.csv, law.csv. Exit code 3 if the result is not valid: not converged, not explained by
    the model, or a parameter not identified.
    """,
    options=(
        click.argument("tables", metavar="[TABLE.csv]...", nargs=-1, type=click.Path(path_type=Path)),
        click.option(
            "--model",
            default="law",
            type=click.Choice(MODELS),
            help="; ".join(f"{name}: {law.meaning}" for name, law in LAWS.items())
            + f"; each with {DELAY_LAW.meaning} (+delay); contact: physical parameters through the resolved contact, "
            "of tapping curves on resonance too.",
        ),
        NOISE,
        QUALITY_FACTOR,
        flag("--scale-errors", "Take the errors as relative: scale them, by 3 at most, until chi2/dof is 1."),
        flag("--robust", "Leave outliers out, one row in ten at most."),
        click.option(
            "--free",
            type=Names(),
            metavar="NAME,...",
            help="The parameters that are fitted, if not all that are not fixed; of a contact, if left out, "
            f"{','.join(CONTACT_DEFAULT)}.",
        ),
        click.option(
            "--fix", "fixed", type=Fixed(), multiple=True, metavar="NAME=VALUE", help="Hold a parameter at a value."
        ),
        click.option(
            "--constrain",
            "constraints",
            type=Constraint(),
            multiple=True,
            metavar="NAME=VALUE+-ERROR",
            help=f"What is known beforehand: {', '.join(NUISANCE_NAMES)}, or a parameter of the model; "
            "of a contact also one that is held, at the value then.",
        ),
        click.option(
            "--no", "left_out", type=Names(), metavar="EFFECT,...", help="contact: effects that it does not have."
        ),
        flag("--compare", "Fit the rival models too and say what the table can tell.", into="comparing"),
        flag(
            "--posterior",
            "Credible intervals, too, by the no-U-turn sampler (extra `nuts`); where impacts last, of a Gaussian "
            "around the fit.",
        ),
        click.option("--seed", type=click.IntRange(min=0), default=0, help="Seed of the random numbers."),
        click.option(
            "--share",
            type=Names(),
            metavar="NAME,...",
            help="Of several tables: nuisances (of --constrain) that all have in common, or all; left out, each has "
            "its own.",
        ),
        flag("--example", "Fit the bundled table instead of a file."),
    ),
    check=check_fit,
)


def _check_table(_: Session, options: Options) -> None:
    """Check that there is a table, or the example alone."""
    if options["example"] == (options["table"] is not None):
        raise click.UsageError("give a table to invert, `afm-jax invert TABLE.csv`, or --example for the bundled one")


INVERT = Command(
    name="invert",
    runs="afm_jax.cli.invert:inversion",
    help="""Read approach speed, rebound speed and collision delay off amplitude and phase, row by row, without any law.

    The table is that of `afm-jax fit` with phase_deg and phase_error_deg. The losses u_in^2 - u_out^2 are then set on
    straight lines over (1, u_in), a viscous loss, and (1, u_in^2), a restitution. Rows that give nothing are named,
    with the reason. With --out invert.csv, .json and .png. Exit code 3 if the rows determine no line, or none
    explains them.
    """,
    options=(
        click.argument("table", metavar="[TABLE.csv]", required=False, type=click.Path(path_type=Path)),
        NOISE,
        QUALITY_FACTOR,
        flag("--example", "Invert the bundled table instead of a file."),
    ),
    check=_check_table,
)

LOCKIN = Command(
    name="lockin",
    runs="afm_jax.cli.lockin:lockin_of_trace",
    help="""Read amplitude and phase of a deflection in time at the drive's frequency over N, and over 1 to 8 besides.

    TRACE is text with the columns time_us (or time_ms, time_s) and deflection_nm (the tip's height), separated by
    commas, tabs, semicolons or spaces. The phase takes time 0 as when the platform is highest.
    Amplitudes are integrals over whole periods, errors the scatter of up to twelve parts of the trace. Exit code 3 if
    the trace is not periodic at order N: the scatter, or the amplitude at another order, is above 2 % of that at N.
    With --out lockin.csv, .json and .png.
    """,
    options=(
        click.argument("trace", metavar="TRACE", type=click.Path(path_type=Path)),
        click.option(
            "--drive-frequency-khz", type=Finite(positive=True), metavar="KHZ", help="Of the platform; else the file's."
        ),
        click.option(
            "--order", type=click.IntRange(1, 8), default=1, help="Drive periods in a period of the response."
        ),
    ),
    computes=False,
)

_LEVER = (
    ("drive-frequency-khz", "KHZ", "Frequency of the drive; where nothing says it, the free frequency."),
    ("free-frequency-khz", "KHZ", "Natural frequency of the free cantilever, '90 +- 0.01' with its error."),
    ("quality-factor", "Q", "Its quality factor, '200 +- 5' with its error."),
    (
        "spring-constant-n-per-m",
        "N_PER_M",
        "Its modal spring constant (1.03 times the static one), '5.4 +- 0.5'; else energies are over it, in nm^2.",
    ),
)
_READING_NUMBERS = (
    *_LEVER,
    ("free-amplitude-nm", "NM", "Amplitude of the free tip; else the median of the rows far from the sample."),
    ("offset-origin-nm", "NM", "Height (growing towards the tip) at which the sample is at the tip's rest position."),
    ("amplitude-error-nm", "NM", "Standard error of every amplitude; else the scatter of the free rows."),
    ("phase-error-deg", "DEGREES", "Standard error of every phase; else the scatter of the free rows."),
)


class NmPerVolt(ValueAndError):  # noqa: N818 (no exception)
    """A value with its error, or the word `slope`."""

    def read(self, text: str) -> Any:
        """Return the value and its error, or the word."""
        return text if text == "slope" else super().read(text)


_PHASE_SENSE = click.option(
    "--phase-sense",
    type=click.Choice(["lag", "lead"]),
    help="Whether the phase grows as the tip lags behind its drive more (lag), or falls (lead); else the readings "
    "decide where they can.",
)
READING = (
    click.option(
        "--columns",
        metavar="COLUMN=CHANNEL[:UNIT][:FACTOR],...",
        default="",
        show_default=False,
        help="Which channel becomes which column (offset_nm, lockin_amplitude_nm, phase_lag_deg, deflection_nm), as "
        "offset_nm=Z:um,lockin_amplitude_nm=Amp:V; without a head channels are numbers, and with approach and "
        "retract in two of them OUT/BACK: offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V,phase_lag_deg=7/8.",
    ),
    click.option(
        "--drive",
        type=click.Choice(["base", "force"]),
        help="What drives the tip: a piezo at its base (assumed without this option), or a force (photothermal, "
        "magnetic).",
    ),
    _PHASE_SENSE,
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
        help="Width of the bins of height whose means and scatter are the rows (0: equal heights only); else bins "
        "of five rows where heights repeat or are not in order.",
    ),
    *(_number(*row) for row in _READING_NUMBERS),
)
"""How an instrument's file becomes rows of a table: `read`, and `tapping` of such a file."""
READING_OPTIONS = (
    "columns",
    "drive",
    "phase_sense",
    "nm_per_volt",
    "bin_nm",
    *(name.replace("-", "_") for name, _, _ in _READING_NUMBERS),
)
"""Names of the arguments that `READING` adds, as `read_curves` takes them."""

READ = Command(
    name="read",
    runs="afm_jax.cli.read:curves_of_a_file",
    help="""Read amplitude and phase against height out of an instrument's file.

    FILE is neaSNOM text, WSxM curves, an Asylum .ibw ramp, a NanoSurf .nid, Nanonis .dat or Gwyddion .gwy file, or text
    separated by tabs, semicolons, commas or blanks, with a head or without (--columns). Says what was found, where each
    number comes from, what was assumed and what is missing. With --out the table for `afm-jax tapping` and `afm-jax
    fit`; of a file of several curves one table each, TABLE_1.csv and so on. Repeated and unordered heights become bins.
    Curves that must not be used (a free amplitude that jumps) are refused by name, and the exit code is 3. Package
    extra for .ibw and .gwy: `pip install 'afm-jax[instruments]'`.
    """,
    options=(
        click.argument("file", metavar="FILE", type=click.Path(path_type=Path)),
        click.option("--curve", type=click.IntRange(1), metavar="N", help="Only this curve of the file."),
        *READING,
    ),
    computes=False,
    out_file="TABLE.csv",
)


def _check_curves(_: Session, options: Options) -> None:
    """Check that there are curves, or the example alone."""
    if options["example"] == bool(options["curve_files"]):
        raise click.UsageError("give a curve, `afm-jax tapping CURVE`, or --example for a simulated raw file")


TAPPING = Command(
    name="tapping",
    runs="afm_jax.cli.tapping:energy_of_taps",
    help="""Read the energy of a tap off a tapping curve, and where the drive allows it the impact law.

    CURVE is a table of amplitude and phase against height (`# drive = force` or base, columns drive_frequency_khz,
    free_amplitude_nm, offset_nm, lockin_amplitude_nm, phase_lag_deg with their errors, retract), or an instrument's
    file, as for `afm-jax read`. Energy, thresholds and hysteresis, attractive or repulsive branch, impact speeds where
    they can be known; then the law from the rows with fast impacts, or why not and what to record instead. With --out
    the report: tapping.html, .txt, .json, .png and tapping_rows.csv, and that of the law. Several files, or a file of
    several curves, are taken as of one lever: frequency and Q are fitted to all, the scatter from curve to curve stands
    beside the errors, with --out in together.html, .txt, .json, .png; each curve has a folder of its own.
    Exit code 3 if the energy of a tap is not determined.
    """,
    options=(
        click.argument("curve_files", metavar="[CURVE]...", nargs=-1, type=click.Path(path_type=Path)),
        NOISE,
        *READING,
        click.option("--curve", type=click.IntRange(1), metavar="N", help="Only this curve of an instrument's file."),
        click.option("--model", default="viscous+delay", help="Of the law, as for `afm-jax fit`."),
        flag("--example", "Analyse the bundled raw file, simulated with the defects of real ones."),
        flag("--no-law", "Leave the impact law out: energy, thresholds and speeds only, at once."),
        flag(
            "--scale-errors",
            "Multiply the rows' errors where they scatter more (up to three times), instead of refusing their energy.",
        ),
    ),
    check=_check_curves,
    computes=False,
)


_IMAGE_NUMBERS = (
    *_LEVER,
    ("free-amplitude-nm", "NM", "Amplitude of the free tip, as the instrument reads it, '13.4 +- 0.1'."),
    ("free-phase-deg", "DEGREES", "Phase of the free tip, as the instrument reads it, '90 +- 0.05' [its error: 0.2]."),
    ("nm-per-volt", "NM", "Sensitivity of an amplitude in volts."),
    ("tip-calibration", "C", "True over stated amplitude; '1 +- 0.02'."),
)


TAPPING_MAP = Command(
    name="tapping-map",
    runs="afm_jax.cli.tapping_map:map_of_an_image",
    help="""Read the energy of a tap and the virial off every pixel of an image of amplitude and phase.

    IMAGE is a NumPy file (.npz with the arrays amplitude and phase, or .npy of the two), text of numbers with
    amplitude, PHASE_IMAGE then the phase, or an instrument's file with channels of both: Asylum .ibw and Gwyddion .gwy
    (`pip install 'afm-jax[instruments]'`), and all that Gwyddion reads (`pip install 'afm-jax[gwyddion]'`, which runs
    its program on the file). Needed are amplitude and phase of the free tip, at the same drive. Each pixel has its own
    error; what all have in common (spring constant, frequency, Q, calibration, free amplitude and phase) is said once.
    Pixels out of range (amplitude above the free one, energy below zero beyond its error) are masked and counted.
    With --out map.png, .json, .txt and the arrays. Exit code 3 if most pixels are out of range, the
    median energy is below zero or only bracketed, or the sense of the phase decides and is not known.
    """,
    options=(
        click.argument("image", metavar="IMAGE", type=click.Path(path_type=Path)),
        click.argument("phase_image", metavar="[PHASE_IMAGE]", required=False, type=click.Path(path_type=Path)),
        click.option(
            "--columns",
            metavar="COLUMN=CHANNEL[:UNIT][:FACTOR],...",
            default="",
            show_default=False,
            help="Which image is which, as lockin_amplitude_nm=Amplitude:V,phase_lag_deg=Phase.",
        ),
        click.option("--drive", type=click.Choice(["base", "force"]), default="base", help="What is driven."),
        _PHASE_SENSE,
        *(_number(*row) for row in _IMAGE_NUMBERS),
        click.option(
            "--amplitude-error-nm", type=Finite(positive=True), metavar="NM", help="Standard error of a pixel's."
        ),
        click.option(
            "--phase-error-deg", type=Finite(positive=True), metavar="DEGREES", help="Standard error of a pixel's."
        ),
        click.option(
            "--format",
            "formats",
            type=click.Choice(["npz", "gsf", "zarr"]),
            multiple=True,
            default=("npz",),
            help="Of the arrays written into --out (gsf: for Gwyddion); may be given several times.",
        ),
    ),
    computes=False,
)

COMMANDS = (CALIBRATE, DESIGN, FIT, INVERT, LOCKIN, READ, TAPPING, TAPPING_MAP)
