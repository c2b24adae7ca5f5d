"""`afm-jax design`: which drives to measure next, and what they will determine."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import click

from afm_jax.cli.design_belief import BeliefOptions, believed, with_belief_options
from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Finite, Numbers, Orders, Share

_TAPPING = {"orders": "1", "detuning": "1.02:1.1:0.02", "drive_nm": "40,80", "heights": "0.1:0.9:0.1"}
_SAMPLE = {"orders": "1-4", "detuning": "0.97:1.05:0.01", "drive_nm": "2,4,7,10", "offsets_nm": "-1,0,1"}


@click.command()
@click.option(
    "--orders", type=Orders(), metavar="LIST", help="Drive periods an impact; else 1-4, or 1 where the tip is driven."
)
@click.option("--frequencies-khz", type=Numbers(), metavar="LIST", help="Drive frequencies, the same for every order.")
@click.option(
    "--detuning",
    type=Numbers(),
    metavar="LIST",
    help="Drive frequencies as multiples of each order's resonance 2 N f0, else 0.97:1.05:0.01; or of f0 where "
    "the tip is driven, else 1.02:1.1:0.02.",
)
@click.option(
    "--drive-nm", type=Numbers(), metavar="LIST", help="Drive amplitudes, else 2,4,7,10; or free ones, else 40,80."
)
@click.option("--offsets-nm", type=Numbers(positive=False), metavar="LIST", help="Offsets; else -1,0,1.")
@click.option(
    "--heights",
    type=Numbers(positive=False),
    metavar="LIST",
    help="Where the tip is driven, in place of offsets: distances of the sample as shares of each free amplitude; else "
    "0.1:0.9:0.1.",
)
@click.option("--largest-nm", type=Finite(), metavar="X", help="Peak amplitude that the instrument takes.")
@click.option("--points", type=click.IntRange(1, 200), default=8, show_default=True, help="How many to choose.")
@click.option("--for", "interest", metavar="NAMES", help="Parameters to be known well, as r,epsilon; else the law's.")
@click.option(
    "--criterion",
    type=click.Choice(("D", "A")),
    default="D",
    show_default=True,
    help="Smallest joint region, or sum of variances.",
)
@click.option(
    "--noise",
    type=Share("a relative error"),
    default="1%",
    show_default=True,
    metavar="SHARE",
    help="Relative error of an amplitude.",
)
@click.option(
    "--phase-noise-deg", type=Finite(), default=0.2, show_default=True, metavar="X", help="Error of a lag, tip driven."
)
@click.option(
    "--amplitudes",
    type=click.Choice(("both", "peak", "lockin")),
    default="both",
    show_default=True,
    help="What is read of a point.",
)
@click.option(
    "--uncertainty",
    type=Share("a relative error"),
    default="10%",
    show_default=True,
    metavar="SHARE",
    help="How far the law may be off where no fit says.",
)
@with_belief_options
@with_session
def command(  # noqa: PLR0913
    session: Session,
    *,
    belief_options: BeliefOptions,
    frequencies_khz: tuple[float, ...] | None,
    largest_nm: float | None,
    points: int,
    interest: str | None,
    criterion: str,
    noise: float,
    amplitudes: str,
    phase_noise_deg: float,
    **lists: tuple[int, ...] | tuple[float, ...] | None,
) -> None:
    """Choose the drives to measure next, and forecast how well the law will then be known.

    Say what is believed: the cantilever (--free-frequency-khz, --quality-factor '40 +- 2') and the law (--r,
    --epsilon, ...), or what was measured so far (--fit, --measured); and what can be driven: every combination of
    orders, frequencies, amplitudes and offsets is a candidate; with --drive force or base (the cantilever is driven
    itself, amplitude and lag are read) of frequencies, free amplitudes and heights. LISTs are numbers and ranges, 1,2,5
    or 170:190:1. With --out the report: design.csv, to_fill_in.csv (a table for `afm-jax fit`, readings left blank),
    candidates.csv, design.txt, .json, .png. Exit code 3 if no drive can be planned with, or the points do not determine
    the law.
    """
    if frequencies_khz is not None and lists["detuning"] is not None:
        raise click.UsageError("--frequencies-khz and --detuning both say what the drive frequency can be; give one")
    if lists["offsets_nm"] is not None and lists["heights"] is not None:
        raise click.UsageError("--offsets-nm and --heights both say where the sample can be; give one")
    session.start_computing()
    from fitting.experiments.candidates import drive_grid  # noqa: PLC0415
    from fitting.experiments.design import design  # noqa: PLC0415
    from fitting.experiments.report import design_summary, write_design  # noqa: PLC0415

    with session.working("forecasting (the first run compiles for some seconds)"):
        belief = believed(belief_options, noise)
        chosen = _with_defaults(lists, tapping=belief.problem.tapping)
        drives = drive_grid(
            orders=chosen["orders"],
            amplitudes_nm=chosen["drive_nm"],
            offsets_nm=chosen["offsets_nm"] or (0.0,),
            heights=chosen["heights"],
            frequencies_khz=frequencies_khz,
            detunings=chosen["detuning"] if frequencies_khz is None else None,
            free_frequency_khz=belief.free_frequency_khz,
            drive=belief.problem.drive,
        )
        names = None if interest is None else tuple(name.strip().replace("-", "_") for name in interest.split(","))
        result = design(
            belief,
            drives,
            points=points,
            noise=noise,
            interest=names,
            criterion=criterion,
            amplitudes=amplitudes,
            largest_nm=largest_nm,
            phase_noise_deg=phase_noise_deg,
        )
    session.emit(result.to_dict(), partial(design_summary, result))
    if session.out is not None:
        for path in write_design(result, session.out, session.write_table):
            session.note(f"wrote {path}")
    if not result.valid:
        raise NotValid(result.reasons[0])


def _with_defaults(lists: Mapping[str, tuple[int, ...] | tuple[float, ...] | None], *, tapping: bool) -> dict[str, Any]:
    """Return what can be driven, with the usual lists where none were given."""
    usual = dict(_TAPPING if tapping else _SAMPLE)
    if lists["offsets_nm"] is not None:
        usual.pop("heights", None)
    numbers, orders = Numbers(positive=False), Orders()
    found = {name: (orders if name == "orders" else numbers).convert(text, None, None) for name, text in usual.items()}
    return {name: given if given is not None else found.get(name) for name, given in lists.items()}
