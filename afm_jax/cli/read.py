"""`afm-jax read FILE`: tapping curves out of an instrument's file, as tables for `tapping` and `fit`."""

from pathlib import Path
from typing import Annotated, Any, Literal

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from afm_jax.cli.values import CurveNumber, Quantity, Sensitivity
from fitting.instruments.curve import read_curve, read_curves
from fitting.instruments.report import CurvesOfFile, write_tables


class LeverOptions:
    """What is said of lever, drive and phase, as `fitting.read_curves` and `fitting.tapping_map` take it.

    Attributes:
        phase_sense: whether the phase grows (lag) or falls (lead) as the tip lags further behind its drive; else the
            readings decide if they can.
        drive_frequency_khz: frequency of the drive; else that of the file, or the free frequency.
        free_frequency_khz: natural frequency of the free cantilever, '90 +- 0.01' with its error.
        quality_factor: its quality factor, '200 +- 5' with its error.
        spring_constant_n_per_m: its modal spring constant (1.03 times the static one), '5.4 +- 0.5'; if unknown,
            energies are divided by it, in nm^2.
        free_amplitude_nm: amplitude of the free tip, '13.4 +- 0.1'; of a curve else the median of the rows far from the
            sample.
    """

    phase_sense: Literal["lag", "lead"] | None = None
    drive_frequency_khz: Quantity | None = None
    free_frequency_khz: Quantity | None = None
    quality_factor: Quantity | None = None
    spring_constant_n_per_m: Annotated[Quantity | None, "--spring-constant"] = None
    free_amplitude_nm: Quantity | None = None


class ReadingOptions:
    """How an instrument's file becomes rows of a table, as `fitting.read_curves` takes it.

    Attributes:
        columns: the channel of each column (offset_nm, lockin_amplitude_nm, phase_lag_deg), as
            offset_nm=Z:um,lockin_amplitude_nm=Amp:V. Files without a head have numbered channels; approach and retract
            in two channels are APPROACH/RETRACT: offset_nm=1/2:nm,lockin_amplitude_nm=5/6:V,phase_lag_deg=7/8.
        drive: what drives the tip: a piezo at its base (assumed without this option), or a force (photothermal,
            magnetic).
        nm_per_volt: sensitivity of an amplitude in volts; `slope`: such that the amplitude falls by 1 nm per nm in
            contact.
        bin_nm: width of the bins of height whose means and scatter are the rows (0: equal heights only); else bins of
            five rows where heights repeat or are not in order.
        offset_origin_nm: height (growing towards the tip) at which the sample is at the tip's rest position.
    """

    columns: Annotated[str, "COLUMN=CHANNEL[:UNIT][:FACTOR],..."] = ""
    drive: Literal["base", "force"] | None = None
    nm_per_volt: Sensitivity | None = None
    bin_nm: float | None = None
    offset_origin_nm: Quantity | None = None


def curves_of_a_file(
    session: Session,  # noqa: ARG001
    file: Annotated[Path, "FILE"],
    *,
    curve: CurveNumber | None = None,
    **reading: Any,
) -> Output:
    """Read amplitude and phase against height out of an instrument's file.

    FILE is neaSNOM text, WSxM curves, an Asylum .ibw ramp, a NanoSurf .nid or Nanonis .dat file, or text separated by
    tabs, semicolons, commas or blanks, with a head or without (--columns). The output says where each number comes
    from, what was assumed and what is missing. With --out the table for `afm-jax tapping` and `afm-jax fit`; a file of
    several curves gives a table for each, TABLE_1.csv and so on. Repeated and unordered heights become bins. Curves
    that must not be used (a free amplitude that jumps) are refused by name, with exit code 3. Extra for .ibw: `pip
    install 'afm-jax[instruments]'`.

    Args:
        session: of the call.
        file: the file.
        curve: only this curve of the file.
        **reading: as `ReadingOptions` and `LeverOptions`.
    """
    curves = read_curves(file, **reading) if curve is None else [read_curve(file, curve=curve, **reading)]
    usable = any(each.valid for each in curves)
    return Output.of(CurvesOfFile(curves), report=lambda path: write_tables(curves, path) if usable else [])
