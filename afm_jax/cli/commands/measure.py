"""Commands that read data of instruments, fit them, and plan what to measure next."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from afm_jax.cli.command import Command, Options
from afm_jax.cli.fit_options import Constraint, Fixed, Names, check_fit
from afm_jax.cli.options import NOISE, QUALITY_FACTOR, flag, valued
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


def _numbers(names: Mapping[str, str]) -> list[Any]:
    """Return the options of numbers with their errors, whose names tell their units, from what help says of them."""
    short = {"spring_constant_n_per_m": ("--spring-constant",)}
    return [
        click.option(option_of(name), *short.get(name, ()), type=ValueAndError(), help=text)
        for name, text in names.items()
    ]


_OF_LEVER = {
    "length_um": "Length of a rectangular lever, '225 +- 2' with its error: Sader's method.",
    "width_um": "Its width.",
    "temperature_k": "Of lever and air [default: the file's, 296 +- 3].",
}
CALIBRATE = Command(
    name="calibrate",
    runs="afm_jax.cli.calibrate:calibration",
    help="""Fit frequency and quality factor to a frequency scan of the free resonance, or to a thermal spectrum.

    SWEEP is Nanonis text, or columns frequency_khz (or frequency_hz), amplitude_nm (or amplitude, any unit) and, where
    known, phase_deg, amplitude_error_nm (or amplitude_error). A thermal spectrum (NanoSurf .nid, or
    asd_nm_per_sqrt_hz or psd_nm2_per_hz) gives the spring constant, too, by equipartition; with the lever's size also
    by Sader's method. frequency_khz is the undamped natural frequency, not that of the maximum. With --out
    calibration.json, .png and calibration_points.csv. Exit code 3 if the result is not valid: no resonance, at the
    edge, not explained by the model, or a scale of the deflection that another spring constant contradicts.
    """,
    options=(
        click.argument("sweep", metavar="SWEEP", type=click.Path(path_type=Path)),
        valued("--averages", Finite(positive=True), "Spectra that a thermal spectrum is the mean of."),
        *_numbers(_OF_LEVER),
        valued(
            "--deflection",
            click.Choice(["static", "mode"]),
            "How a thermal spectrum got its nm: by the slope of a force curve (static InvOLS), or for the mode itself.",
            default="static",
        ),
        valued(
            "--scale-error",
            Share("a relative error"),
            "Relative error of the deflection's scale (its sensitivity); that of k is twice as large.",
            default="5%",
        ),
    ),
    computes=False,
)


DESIGN = Command(
    name="design",
    runs="afm_jax.cli.design:planned",
    help="""Choose the drives to measure next, and forecast how well the law will then be known.

    Give the cantilever (--free-frequency-khz, --quality-factor '40 +- 2') and the law (--r, --epsilon, ...), or a fit
    of what was measured so far (--fit). Candidates are all combinations of orders, frequencies, amplitudes and offsets;
    with --drive force or base (the cantilever is driven, amplitude and lag are read) all combinations of frequencies,
    free amplitudes and heights. LISTs are numbers and ranges, 1,2,5 or 170:190:1. With --out design.csv, .json and
    .png. Exit code 3 if no candidate can be used, or the points do not determine the law.
    """,
    options=(
        valued("--orders", Orders(), "Drive periods from impact to impact; else 1-4, or 1 where the tip is driven."),
        valued(
            "--detuning",
            Numbers(),
            "Drive frequencies as multiples of each order's resonance 2 N f0, else 0.97:1.05:0.01; or of f0 where the "
            "tip is driven, else 1.02:1.1:0.02.",
            into="detunings",
        ),
        valued(
            "--drive-nm",
            Numbers(),
            "Drive amplitudes, else 2,4,7,10; or free ones, else 40,80.",
            into="amplitudes_nm",
        ),
        valued("--offsets-nm", Numbers(positive=False), "Offsets; else -1,0,1."),
        valued(
            "--heights",
            Numbers(positive=False),
            "Where the tip is driven, in place of offsets: distances of the sample as shares of each free amplitude; "
            "else 0.1:0.9:0.1.",
        ),
        valued("--largest-nm", Finite(), "Largest peak amplitude that the instrument can measure."),
        valued("--points", click.IntRange(1, 200), "How many to choose.", default=8),
        valued("--for", Names(), "Parameters to determine, as r,epsilon; else the law's.", into="interest"),
        valued("--noise", Share("a relative error"), "Relative error of an amplitude.", default="1%"),
        valued("--phase-noise-deg", Finite(), "Error of a lag where the tip is driven.", default=0.2),
        valued("--amplitudes", click.Choice(("both", "peak", "lockin")), "The readings of a point.", default="both"),
        valued(
            "--uncertainty",
            Share("a relative error"),
            "Error of the law that is assumed where no fit gives one.",
            default="10%",
        ),
        valued(
            "--fit",
            click.Path(path_type=Path),
            "A fit to add to, as `afm-jax fit --json` writes it, or its folder.",
            metavar="JSON",
        ),
        valued("--model", click.Choice(MODELS), "What will be fitted; else law+delay, or the fit's."),
        valued("--mass-ng", Finite(), "Effective mass of the tip."),
        valued("--drive", click.Choice(("sample", "force", "base")), "What is driven; else the sample."),
        *(
            valued(
                option_of(name),
                Finite(),
                f"{', '.join(filter(None, (PARAMETERS[name].meaning, PARAMETERS[name].unit)))}; else the paper's.",
            )
            for name in LAW_NAMES
        ),
        *(
            valued(
                option_of(nuisance.name),
                ValueAndError(none=nuisance.name == "quality_factor"),
                f"{nuisance.meaning}, 'VALUE +- ERROR'.",
            )
            for nuisance in PRIOR_NUISANCES
        ),
    ),
)


FIT = Command(
    name="fit",
    runs="afm_jax.cli.fit:fit",
    help="""Fit the impact law to a table of vibration amplitudes, or one law to several tables.

    The table is a CSV file: comment lines `# free_frequency_khz = 90`, `# quality_factor = 40 +- 1`, and columns
    order, drive_frequency_khz, drive_amplitude_nm, offset_nm, peak_amplitude_nm and/or lockin_amplitude_nm, each
    with its ..._error_nm; a column no_orbit marks by 1 drives at which the tip did not settle; phase_deg
    is used if present. With a line `# drive = force` (or base) it is a tapping curve: drive_frequency_khz,
    free_amplitude_nm, offset_nm, lockin_amplitude_nm and phase_lag_deg. Several tables have one law; their nuisances
    are separate or shared (--share), and the report gives each table's pull: the distance between its law and that
    of the others, in standard deviations. With --out the report: fit.html, fit.txt,
    fit.json, fit.png, fit_rows.csv, law.csv. Exit code 3 if the result is not valid: not converged, not explained by
    the model, or a parameter not identified.
    """,
    options=(
        click.argument("tables", metavar="[TABLE.csv]...", nargs=-1, type=click.Path(path_type=Path)),
        valued(
            "--model",
            click.Choice(MODELS),
            "; ".join(f"{name}: {law.meaning}" for name, law in LAWS.items())
            + f"; each with {DELAY_LAW.meaning} (+delay); contact: physical parameters through the resolved contact, "
            "of tapping curves 3 to 10 % above resonance.",
            default="law",
        ),
        NOISE,
        QUALITY_FACTOR,
        flag("--scale-errors", "Treat the errors as relative: scale them, by 3 at most, until chi2/dof is 1."),
        flag("--robust", "Leave out outliers, at most one row in ten."),
        valued(
            "--free",
            Names(),
            f"The parameters to fit; else all that are not fixed, and of a contact {','.join(CONTACT_DEFAULT)}.",
        ),
        valued("--fix", Fixed(), "Hold a parameter at a value.", into="fixed", multiple=True, metavar="NAME=VALUE"),
        valued(
            "--constrain",
            Constraint(),
            f"A value known beforehand, with its error: of {', '.join(NUISANCE_NAMES)}, or of a parameter of the "
            "model; of a contact also of a parameter that is held at that value.",
            into="constraints",
            multiple=True,
            metavar="NAME=VALUE+-ERROR",
        ),
        valued("--no", Names(), "Of a contact: effects to leave out.", into="left_out"),
        flag("--compare", "Fit the rival models too and say which of them the table distinguishes.", into="comparing"),
        flag(
            "--posterior",
            "Also give credible intervals, by the no-U-turn sampler (extra `nuts`); where impacts last, from a "
            "Gaussian around the fit.",
        ),
        valued("--seed", click.IntRange(min=0), "Seed of the random numbers.", default=0),
        valued(
            "--share",
            Names(),
            "Of several tables: the nuisances (see --constrain) that they have in common, or all; else each table has "
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

    The table is that of `afm-jax fit` with phase_deg and phase_error_deg. Straight lines are then fitted to the losses
    u_in^2 - u_out^2, over (1, u_in) for a viscous loss and over (1, u_in^2) for a restitution. Rows without a result
    are listed with the reason. With --out invert.csv, .json and .png. Exit code 3 if the rows determine no line, or
    no line explains them.
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
    help="""Read amplitude and phase of a deflection in time at the drive's frequency over N, and over 1 to 8.

    TRACE is text with the columns time_us (or time_ms, time_s) and deflection_nm (the tip's height), separated by
    commas, tabs, semicolons or spaces. The phase assumes that the platform is highest at time 0.
    Amplitudes are integrals over whole periods, errors the scatter of up to twelve parts of the trace. Exit code 3 if
    the trace is not periodic at order N: the scatter, or the amplitude at another order, is above 2 % of that at N.
    With --out lockin.csv, .json and .png.
    """,
    options=(
        click.argument("trace", metavar="TRACE", type=click.Path(path_type=Path)),
        valued("--drive-frequency-khz", Finite(positive=True), "Of the platform; else the file's."),
        valued("--order", click.IntRange(1, 8), "Drive periods in a period of the response.", default=1),
    ),
    computes=False,
)

_LEVER = {
    "drive_frequency_khz": "Frequency of the drive; else that of the file, or the free frequency.",
    "free_frequency_khz": "Natural frequency of the free cantilever, '90 +- 0.01' with its error.",
    "quality_factor": "Its quality factor, '200 +- 5' with its error.",
    "spring_constant_n_per_m": "Its modal spring constant (1.03 times the static one), '5.4 +- 0.5'; if unknown, "
    "energies are divided by it, in nm^2.",
}
_READING_NUMBERS = _LEVER | {
    "free_amplitude_nm": "Amplitude of the free tip; else the median of the rows far from the sample.",
    "offset_origin_nm": "Height (growing towards the tip) at which the sample is at the tip's rest position.",
    "amplitude_error_nm": "Standard error of every amplitude; else the scatter of the free rows.",
    "phase_error_deg": "Standard error of every phase; else the scatter of the free rows.",
}


class NmPerVolt(ValueAndError):  # noqa: N818 (no exception)
    """A value with its error, or the word `slope`."""

    def read(self, text: str) -> Any:
        """Return the value and its error, or the word."""
        return text if text == "slope" else super().read(text)


_PHASE_SENSE = valued(
    "--phase-sense",
    click.Choice(["lag", "lead"]),
    "Whether the phase grows (lag) or falls (lead) as the tip lags further behind its drive; else the readings decide "
    "if they can.",
)


def _columns(text: str) -> Callable[..., Any]:
    """Return the option that says which channel is what."""
    return valued("--columns", str, text, metavar="COLUMN=CHANNEL[:UNIT][:FACTOR],...", default="", show_default=False)


READING = (
    _columns(
        "The channel of each column (offset_nm, lockin_amplitude_nm, phase_lag_deg, deflection_nm), as "
        "offset_nm=Z:um,lockin_amplitude_nm=Amp:V. Files without a head have numbered channels; approach and retract "
        "in two channels are APPROACH/RETRACT: offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V,phase_lag_deg=7/8."
    ),
    valued(
        "--drive",
        click.Choice(["base", "force"]),
        "What drives the tip: a piezo at its base (assumed without this option), or a force (photothermal, magnetic).",
    ),
    _PHASE_SENSE,
    valued(
        "--nm-per-volt",
        NmPerVolt(),
        "Sensitivity of an amplitude in volts; `slope`: such that the amplitude falls by 1 nm per nm in contact.",
        metavar="NM|slope",
    ),
    valued(
        "--bin-nm",
        Finite(),
        "Width of the bins of height whose means and scatter are the rows (0: equal heights only); else bins of five "
        "rows where heights repeat or are not in order.",
    ),
    *_numbers(_READING_NUMBERS),
)
"""How an instrument's file becomes rows of a table: `read`, and `tapping` of such a file."""
READING_OPTIONS = ("columns", "drive", "phase_sense", "nm_per_volt", "bin_nm", *_READING_NUMBERS)
"""Names of the arguments that `READING` adds, as `read_curves` takes them."""

READ = Command(
    name="read",
    runs="afm_jax.cli.read:curves_of_a_file",
    help="""Read amplitude and phase against height out of an instrument's file.

    FILE is neaSNOM text, WSxM curves, an Asylum .ibw ramp, a NanoSurf .nid or Nanonis .dat file, or text separated by
    tabs, semicolons, commas or blanks, with a head or without (--columns). The output says where each number comes
    from, what was assumed and what is missing. With --out the table for `afm-jax tapping` and `afm-jax fit`; a file of
    several curves gives a table for each, TABLE_1.csv and so on. Repeated and unordered heights become bins. Curves
    that must not be used (a free amplitude that jumps) are refused by name, with exit code 3. Extra for .ibw:
    `pip install 'afm-jax[instruments]'`.
    """,
    options=(
        click.argument("file", metavar="FILE", type=click.Path(path_type=Path)),
        valued("--curve", click.IntRange(1), "Only this curve of the file."),
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
    help="""Determine the energy of a tap from a tapping curve, and above resonance the impact law.

    CURVE is a table of amplitude and phase against height (`# drive = force` or base, columns drive_frequency_khz,
    free_amplitude_nm, offset_nm, lockin_amplitude_nm, phase_lag_deg with their errors, retract), or an instrument's
    file, as for `afm-jax read`. The output gives the energy along the attractive and the repulsive branch, thresholds,
    hysteresis, and impact speeds if they can be determined; then the law from the rows with fast impacts, or why there
    is none and what to record instead. With --out the report: tapping.html, .txt, .json, .png and tapping_rows.csv,
    and that of the law. Several files, or several curves of a file, are assumed to be of one lever: frequency and Q
    are fitted to all of them, and the scatter from curve to curve stands beside the errors (with --out together.html,
    .txt, .json, .png, and a folder for each curve). Exit code 3 if the energy of a tap is not determined.
    """,
    options=(
        click.argument("curve_files", metavar="[CURVE]...", nargs=-1, type=click.Path(path_type=Path)),
        NOISE,
        *READING,
        valued("--curve", click.IntRange(1), "Only this curve of an instrument's file."),
        valued("--model", str, "Model of the law, as for `afm-jax fit`.", default="viscous+delay"),
        flag("--example", "Analyse the bundled raw file, simulated with the defects of real ones."),
        flag("--no-law", "Do not fit the impact law: energy, thresholds and speeds only."),
        flag(
            "--scale-errors",
            "Multiply the rows' errors (by 3 at most) where rows scatter more, instead of refusing their energy.",
        ),
    ),
    check=_check_curves,
    computes=False,
)


_IMAGE_NUMBERS = _LEVER | {
    "free_amplitude_nm": "Amplitude of the free tip, as the instrument reads it, '13.4 +- 0.1'.",
    "free_phase_deg": "Phase of the free tip, as the instrument reads it, '90 +- 0.05' [its error: 0.2].",
    "nm_per_volt": "Sensitivity of an amplitude in volts.",
    "tip_calibration": "True over stated amplitude; '1 +- 0.02'.",
}


TAPPING_MAP = Command(
    name="tapping-map",
    runs="afm_jax.cli.tapping_map:map_of_an_image",
    help="""Determine the energy of a tap and the virial at every pixel of an image of amplitude and phase.

    IMAGE is a NumPy file (.npz with the arrays amplitude and phase, or .npy of the two), text of numbers with
    amplitude, PHASE_IMAGE then the phase, or an instrument's file with channels of both: Asylum .ibw
    (`pip install 'afm-jax[instruments]'`), and all that Gwyddion reads (`pip install 'afm-jax[gwyddion]'`, which runs
    its program on the file). Amplitude and phase of the free tip at the same drive are required. Each pixel has its own
    error; the common error (spring constant, frequency, Q, calibration, free amplitude and phase) is given once.
    Pixels out of range (amplitude above the free one, energy below zero beyond its error) are masked and counted.
    With --out map.png, .json, .txt and the arrays. Exit code 3 if most pixels are out of range, the
    median energy is below zero or only bracketed, or the unknown sense of the phase decides.
    """,
    options=(
        click.argument("image", metavar="IMAGE", type=click.Path(path_type=Path)),
        click.argument("phase_image", metavar="[PHASE_IMAGE]", required=False, type=click.Path(path_type=Path)),
        _columns("The image of each quantity, as lockin_amplitude_nm=Amplitude:V,phase_lag_deg=Phase."),
        valued("--drive", click.Choice(["base", "force"]), "What is driven.", default="base"),
        _PHASE_SENSE,
        *_numbers(_IMAGE_NUMBERS),
        valued("--amplitude-error-nm", Finite(positive=True), "Standard error of a pixel's amplitude."),
        valued("--phase-error-deg", Finite(positive=True), "Standard error of a pixel's phase."),
        valued(
            "--format",
            click.Choice(["npz", "gsf", "zarr"]),
            "Of the arrays written into --out (gsf: for Gwyddion); may be given several times.",
            into="formats",
            multiple=True,
            default=("npz",),
        ),
    ),
    computes=False,
)

COMMANDS = (CALIBRATE, DESIGN, FIT, INVERT, LOCKIN, READ, TAPPING, TAPPING_MAP)
