"""A lock-in: what of a deflection in time is at the drive's frequency over N, N = 1 to 8, and over twice the order.

    a exp(i phi) = 2/T times the integral of z exp(-i omega t/N) dt over T, a whole number of periods,

so that z has the part a cos(omega t/N + phi), t = 0 when the platform is highest. T holds whole periods of the order
asked for, too: the other lines of a motion of that order then cancel. T is cut into blocks; their scatter is the error.
"""

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Int

from afm_jax.checks import check_parameter, checked
from afm_jax.columns import CsvColumns, csv_columns, rows_of
from afm_jax.report import Cell, Section, sections, table_of
from afm_jax.results import JudgedResult, ResultTuple, public_result
from afm_jax.saved import as_json
from afm_jax.units import within_turn
from afm_jax.words import printable
from fitting.tables.csv_text import Column, FileSetting, Form, TableError, read_columns

Samples = Float[np.ndarray, " samples"]
HIGHEST_ORDER = 8
"""Subharmonics that are read: the paper's proposal; higher ones are hardly ever seen."""
SHARE = 0.02
"""Of the amplitude at the order asked for: what another order, or the scatter of the blocks, may have at most."""
_BLOCKS = 12
_LEAST_PERIODS = 4
_LEAST_SAMPLES = 4.0
"""Samples per drive period."""
_SILENT_NM = 1e-9
_SEEN = 4.0
"""Standard errors from which an amplitude stands out of the noise."""


@public_result()
class Trace(ResultTuple):
    """A deflection in time, as a file has it.

    Attributes:
        time_us: of the samples, in us, shape (samples,).
        deflection_nm: height of the tip, in nm; the zero does not matter.
        drive_frequency_khz: of the platform, or None where the file does not say it.
    """

    time_us: Samples
    deflection_nm: Samples
    drive_frequency_khz: float | None


@public_result(picture="fitting.traces.picture:lockin_figure")
@dataclass(frozen=True, eq=False, kw_only=True)
class LockinResult(JudgedResult):
    """What `lockin` reads, named like the columns of an amplitude table.

    Attributes:
        drive_frequency_khz: omega/2 pi.
        order: N that was asked for.
        response_periods: whole periods of order N that were read.
        lockin_amplitude_nm: amplitude a at the drive's frequency over N.
        lockin_amplitude_error_nm: its standard error, from the scatter of the blocks and the sampling.
        phase_deg: phi, modulo 360/N.
        phase_error_deg: its standard error.
        scatter: root mean square by which the blocks differ, as a share of the amplitude.
        orders: 1 to 8, and twice the order asked for, shape (lines,).
        amplitudes_nm: at the drive's frequency over each order; NaN where the trace is too short for it.
        amplitude_errors_nm: their standard errors, NaN where there is one block only.
        phases_deg: their phases, modulo 360 over the order.
        largest_share: what the amplitude at another order may be of that at the order asked for: 2 %, or what few
            samples a period make of the harmonics.
        reasons: why the trace is not periodic at the order asked for; a sentence each.
        warnings: what a reader should know besides.
    """

    drive_frequency_khz: float
    order: int
    response_periods: int
    lockin_amplitude_nm: float
    lockin_amplitude_error_nm: float
    phase_deg: float
    phase_error_deg: float
    scatter: float
    orders: Int[np.ndarray, " lines"]
    amplitudes_nm: Float[np.ndarray, " lines"]
    amplitude_errors_nm: Float[np.ndarray, " lines"]
    phases_deg: Float[np.ndarray, " lines"]
    largest_share: float
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@as_json.register
def _(read: LockinResult) -> dict[str, Any]:
    return {"format": "afm-jax lockin", "format_version": 2, "valid": read.valid} | vars(read)


@csv_columns.register
def _(read: LockinResult) -> CsvColumns:
    names = ("orders", "amplitudes_nm", "amplitude_errors_nm", "phases_deg")
    columns = ("order", "lockin_amplitude_nm", "lockin_amplitude_error_nm", "phase_deg")
    return {"lockin.csv": {column: getattr(read, name) for column, name in zip(columns, names, strict=True)}}


@sections.register
def _(read: LockinResult) -> list[Section]:
    cells: dict[str, Cell] = {
        "drive /": "order:d",
        "amplitude\nnm": "lockin_amplitude_nm",
        "+-": "lockin_amplitude_error_nm:.2g",
        "phase\ndegrees": "phase_deg:.2f",
    }
    title = f"Order {read.order} of {read.drive_frequency_khz:g} kHz, {read.response_periods} periods"
    return [
        Section(title, []),
        Section("Amplitudes", [table_of(cells, rows_of(csv_columns(read)["lockin.csv"]))]),
    ]


@checked
def lockin(
    time_us: Samples | str | os.PathLike[str],
    deflection_nm: Samples | None = None,
    drive_frequency_khz: float | None = None,
    order: int = 1,
) -> LockinResult:
    """Read amplitude and phase of a deflection at the drive's frequency over an order, and at the orders beside it.

    Args:
        time_us: of the samples, in us, rising in nearly equal steps; 0 when the platform is highest. Or a file for
            `read_trace`, which has the deflection, too.
        deflection_nm: height of the tip, in nm; the zero does not matter.
        drive_frequency_khz: of the platform; of a file its own, if it is not given.
        order: N, drive periods in a period of the response, 1 to 8.

    Returns:
        Amplitudes, phases, errors and a verdict; see `LockinResult`.

    Raises:
        TableError: if the trace is too short or has gaps.
        ValueError: if the order or the frequency is impossible.
    """
    source = ""
    if isinstance(time_us, str | os.PathLike):
        source = f"{printable(os.fspath(time_us))}: "
        time_us, deflection_nm, stated = read_trace(Path(time_us))
        drive_frequency_khz = stated if drive_frequency_khz is None else drive_frequency_khz
    if drive_frequency_khz is None:
        mend = "give `drive_frequency_khz=...` or '# drive_frequency_khz = 180'"
        raise TableError(f"{source}the drive frequency is missing; {mend}")
    if not 1 <= order <= HIGHEST_ORDER:
        raise ValueError(f"`order` must be 1 to {HIGHEST_ORDER}, but is {order}")
    check_parameter("drive_frequency_khz", drive_frequency_khz, "positive")
    period = 1e3 / drive_frequency_khz
    time, height = (np.asarray(column, dtype=np.float64) for column in (time_us, deflection_nm))
    wrong = _fault(time, height, period, order)
    if wrong:
        raise TableError(f"{source}{wrong}")
    orders = np.array(sorted({*range(1, HIGHEST_ORDER + 1), 2 * order}))
    asked = int(np.searchsorted(orders, order))
    blocks = [_blocks(time, height, period, int(n), order) for n in orders]
    values, errors, angle_errors = (np.array(column) for column in zip(*map(_line, blocks), strict=True))
    size, sampling = np.abs(values), _sampling_error(time, order * period)
    phases = within_turn(np.angle(values, deg=True), 360.0 / orders)
    found = LockinResult(
        drive_frequency_khz=drive_frequency_khz,
        order=order,
        response_periods=_whole(time, order * period),
        lockin_amplitude_nm=float(size[asked]),
        lockin_amplitude_error_nm=math.hypot(errors[asked], sampling * size[asked]),
        phase_deg=float(phases[asked]),
        phase_error_deg=math.degrees(math.hypot(angle_errors[asked], sampling)),
        scatter=float(np.std(blocks[asked]) / max(size[asked], 1e-300)),
        orders=orders,
        amplitudes_nm=size,
        amplitude_errors_nm=errors,
        phases_deg=phases,
        # the first harmonic that sampling turns into a slow line; the k-th of a bounce is 3/(4 k^2)
        largest_share=max(SHARE, 0.75 / (order * (period / float(np.median(np.diff(time))) - 1.0)) ** 2),
    )
    warnings = ["The phase assumes that the platform is highest at time 0."]
    unseen = ", ".join(str(n) for n in orders[np.isnan(size)])
    if unseen:
        warnings.append(f"The trace is too short to see the drive's frequency over {unseen}.")
    if sampling > SHARE / 10.0:
        warnings.append(f"Few phases are sampled (error {sampling:.1%}): sample faster, or not in step with the drive.")
    why = _why_not_periodic(found)
    reasons = () if why is None else (f"not periodic at order {order}: {why}",)
    return replace(found, reasons=reasons, warnings=tuple(warnings))


def _whole(time: Samples, period_us: float) -> int:
    """Return how many whole periods a trace holds."""
    return int((time[-1] - time[0]) / period_us + 1e-9)


def _blocks(time: Samples, height: Samples, period: float, n: int, order: int) -> Complex[np.ndarray, " blocks"]:
    """Return 2/T times the integral of z exp(-i omega t/n) over each of at most twelve blocks; none if too short.

    Blocks hold equally many whole periods of both orders, the last ones of the trace.

    Args:
        time: of the samples, in us.
        height: z.
        period: of the drive, in us.
        n: the line is at the drive's frequency over n.
        order: of the motion, whose other lines are to cancel.
    """
    both = math.lcm(n, order) * period
    length = math.ceil(_whole(time, both) / _BLOCKS) * both
    count = _whole(time, length) if length else 0
    wave = (height - height.mean()) * np.exp(-2j * np.pi * time / (n * period))
    edges = np.maximum(time[-1] - length * np.arange(count, -1, -1), time[0])
    # trapezia: up to the sample before an edge, and from there to the edge
    until = np.concatenate([[0.0], np.cumsum(0.5 * (wave[1:] + wave[:-1]) * np.diff(time))])
    before = np.minimum(np.searchsorted(time, edges, side="right") - 1, len(time) - 2)
    at_edge = np.interp(edges, time, wave)
    return 2.0 / (length or 1.0) * np.diff(until[before] + 0.5 * (wave[before] + at_edge) * (edges - time[before]))


def _line(blocks: Complex[np.ndarray, " blocks"]) -> tuple[complex, float, float]:
    """Return the mean of blocks, and standard errors of its size and of its angle in rad; NaN of too few blocks."""
    if len(blocks) < 2:
        return complex(blocks[0]) if len(blocks) else np.nan, np.nan, np.nan
    mean = complex(blocks.mean())
    apart = blocks * np.exp(-1j * np.angle(mean))
    along, across = (float(np.std(part, ddof=1)) / math.sqrt(len(blocks)) for part in (apart.real, apart.imag))
    return mean, along, min(across / max(abs(mean), 1e-300), math.pi)


def _sampling_error(time: Samples, period: float) -> float:
    """Return by which share an amplitude may be wrong as few phases of the period are sampled.

    Sampled at M phases, the harmonics M - 1 and M + 1 look like the first; the k-th of a bounce is 3/(4 k^2) of it.
    """
    turns = np.sort(np.mod(time / period, 1.0))
    m = max(1.0 / max(float(np.max(np.diff(turns))), 1.0 - float(turns[-1] - turns[0])), 2.0)
    return 0.75 * (1.0 / (m - 1.0) ** 2 + 1.0 / (m + 1.0) ** 2)


def _fault(time: np.ndarray, height: np.ndarray, period: float, order: int) -> str:
    """Return what is wrong with times that do not rise in nearly equal steps, or are too few or too short."""
    if time.shape != height.shape or time.ndim != 1 or len(time) < 2 or not np.isfinite(time + height).all():
        return "the trace must be two or more finite numbers of time and as many of the deflection"
    steps = np.diff(time)
    typical = float(np.median(steps))
    worst = int(np.argmax(np.abs(steps - np.median(steps))))
    if steps.min() <= 0.0 or steps[worst] > 1.5 * typical:
        return (
            f"sample {worst + 2}, column time_us: the step is {steps[worst]:.6g} us, the usual one {typical:.6g} us; "
            "times must rise evenly: cut the trace where samples are missing"
        )
    if _LEAST_SAMPLES * typical > period:
        return f"there are {period / typical:.3g} samples in a drive period; sample {_LEAST_SAMPLES:g} or more"
    if _whole(time, order * period) < _LEAST_PERIODS:
        return (
            f"the trace spans {(time[-1] - time[0]) / period:.3g} drive periods, too short for {_LEAST_PERIODS} "
            f"periods of order {order}; record at least {_LEAST_PERIODS * order * period:.4g} us"
        )
    return ""


def _why_not_periodic(found: LockinResult) -> str | None:
    """Return why a motion is not periodic at the order asked for; None if it is."""
    order = found.order
    amplitude = found.lockin_amplitude_nm
    sizes = np.nan_to_num(found.amplitudes_nm)
    # errors of few blocks are uncertain: noise is alike at all lines
    noise = _SEEN * float(np.nanmax(found.amplitude_errors_nm))
    # lines of a motion of the order are at its divisors
    other, largest = int(np.argmax(np.where(order % found.orders == 0, -1.0, sizes))), int(np.argmax(sizes))
    if sizes[other] > max(found.largest_share * amplitude, noise, _SILENT_NM):
        n = found.orders[other]
        return (
            f"{sizes[other]:.3g} nm at the drive's frequency over {n}, beside {amplitude:.3g} nm over {order} (at most "
            f"{found.largest_share:.1%} of it); is it `order={n}`?"
        )
    if not amplitude > max(_SEEN * found.lockin_amplitude_error_nm, _SILENT_NM):
        return f"no response at the drive's frequency over it, {amplitude:.3g} nm are noise"
    if found.scatter > SHARE:
        return (
            f"parts of the trace differ by {found.scatter:.1%} (at most {SHARE:.0%}): it still settles, drifts, or "
            "never repeats, the drive frequency is wrong, or the noise is large; record longer, later"
        )
    n = found.orders[largest]
    return None if n == order else f"the response is larger at the drive's frequency over {n}: use `order={n}`"


TRACE = Form(
    (
        Column("time_us", kind="number", needed="time"),
        Column("time_ms", kind="number", meaning="time_us", needed="time", convert=lambda ms: 1e3 * ms),
        Column("time_s", kind="number", meaning="time_us", needed="time", convert=lambda s: 1e6 * s),
        Column("deflection_nm", kind="number", needed="deflection"),
        Column("position_nm", kind="number", meaning="deflection_nm", needed="deflection"),
    ),
    open=True,
)
SETTINGS = {"drive_frequency_khz": FileSetting("drive_frequency_khz", "180")}


@checked
def read_trace(path: str | Path) -> Trace:
    """Read a trace from text of two columns, time_us and deflection_nm; others are passed over.

    Cells are separated by commas, tabs, semicolons or spaces; a comment `# drive_frequency_khz = 180` may stand above.

    Args:
        path: the file.

    Raises:
        TableError: one line that names the first fault, its place, and how to mend it.
    """
    _, columns, settings = read_columns(path, TRACE, SETTINGS)
    frequency, _ = settings.get("drive_frequency_khz", (None, None))
    return Trace(columns["time_us"], columns["deflection_nm"], frequency)
