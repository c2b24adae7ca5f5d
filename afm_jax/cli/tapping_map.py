"""`afm-jax tapping-map IMAGE`: energy of a tap and virial in every pixel."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Finite, Share, ValueAndError

if TYPE_CHECKING:
    from fitting.tapping_curves.maps import TappingMap

_KNOWN = (
    ("free-frequency-khz", "KHZ", "Natural frequency of the free cantilever, '90 +- 0.01' with its error."),
    ("quality-factor", "Q", "Its quality factor, '200 +- 5' with its error."),
    (
        "spring-constant-n-per-m",
        "N_PER_M",
        "Its modal spring constant (1.03 times the static one), '5.4 +- 0.5'; else energies are over it, in nm^2.",
    ),
    ("free-amplitude-nm", "NM", "Amplitude of the free tip."),
    ("drive-frequency-khz", "KHZ", "Frequency of the drive; where nothing says it, the free frequency."),
    ("nm-per-volt", "NM", "Sensitivity of an amplitude in volts."),
    ("tip-calibration", "C", "True over stated amplitude; '1 +- 0.02'."),
)


class RowsAndColumns(click.ParamType):
    """Rows and columns, as 10x12."""

    name = "grid"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Return rows and columns.

        Raises:
            click.BadParameter: if it is no such pair.
        """
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", str(value))
        if match is None:
            self.fail(f"`{value}` is no ROWSxCOLUMNS; write 10x12", param, ctx)
        return int(match[1]), int(match[2])


def _with_known(function):
    for name, unit, text in reversed(_KNOWN):
        short = ("--spring-constant",) if name.startswith("spring") else ()
        function = click.option(f"--{name}", *short, type=ValueAndError(), metavar=unit, help=text)(function)
    return function


@click.command()
@click.argument("image", metavar="IMAGE", type=click.Path(path_type=Path))
@click.argument("phase_image", metavar="[PHASE_IMAGE]", required=False, type=click.Path(path_type=Path))
@click.option(
    "--columns",
    metavar="COLUMN=CHANNEL[:UNIT][:FACTOR],...",
    default="",
    help="Which image is which, as lockin_amplitude_nm=Amplitude:V,phase_lag_deg=Phase:-1.",
)
@click.option("--drive", type=click.Choice(["base", "force"]), default="base", show_default=True, help="What shakes.")
@_with_known
@click.option(
    "--free-phase-deg",
    type=Finite(),
    metavar="DEGREES",
    help="What the instrument reads with the tip free; else its lag.",
)
@click.option("--amplitude-error-nm", type=Finite(positive=True), metavar="NM", help="Standard error of a pixel's.")
@click.option("--phase-error-deg", type=Finite(positive=True), metavar="DEGREES", help="Standard error of a pixel's.")
@click.option(
    "--grid",
    type=RowsAndColumns(),
    metavar="ROWSxCOLUMNS",
    help="IMAGE is a file of curves, one a pixel, as for `read`.",
)
@click.option(
    "--at",
    "ratio",
    type=Share("a share"),
    default=0.9,
    show_default=True,
    metavar="RATIO",
    help="Of a grid of curves: amplitude over the free one at which each pixel is read.",
)
@click.option(
    "--format",
    "formats",
    type=click.Choice(["npz", "gwy", "zarr"]),
    multiple=True,
    default=("npz",),
    show_default=True,
    help="Of the arrays written into --out; may be given several times.",
)
@with_session
def command(session: Session, image: Path, phase_image: Path | None, **options: Any) -> None:
    """Read the energy of a tap and the virial off every pixel of an image of amplitude and phase.

    IMAGE is an Asylum .ibw, Gwyddion .gwy or NanoSurf .nid with channels of both, a NumPy file (.npz with the arrays
    amplitude and phase, or .npy of the two), or text of numbers with amplitude, PHASE_IMAGE then the phase; or a grid
    of curves: arrays (rows, columns, points) with their height_nm, or with --grid a file of curves. Each pixel has its
    own error; what all have in common (spring constant, frequency, Q, calibration, free amplitude and phase) is said
    once. Pixels out of range (amplitude above the free one, energy below zero beyond its error) are masked and counted.
    With --out the report: map.png, map.json, map.txt and the arrays. Exit code 3 if most pixels are out of range.
    """
    from fitting.instruments.images import read_images  # noqa: PLC0415
    from fitting.tapping_curves.map_report import map_summary, write_map  # noqa: PLC0415
    from fitting.tapping_curves.maps import tapping_map  # noqa: PLC0415

    formats = options.pop("formats")
    if "zarr" in formats:
        # asked before anything is computed
        import zarr as _  # noqa: F401, PLC0415
    reading = {name: options.pop(name) for name in ("columns", "grid", "ratio")}
    result: TappingMap = tapping_map(read_images(image, phase_image, **reading), **options)
    session.emit(result.to_dict(), lambda: map_summary(result))
    if session.out is not None:
        for path in write_map(result, session.out, formats):
            session.note(f"wrote {path}")
    if not result.valid:
        raise NotValid(result.reasons[0])
