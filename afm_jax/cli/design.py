"""`afm-jax design`: which drives to measure next, and what they will determine."""

from functools import partial

import click

from afm_jax.cli.design_belief import BeliefOptions, believed, with_belief_options
from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, with_session
from afm_jax.cli.values import Numbers, Orders, Share


@click.command()
@click.option(
    "--orders", type=Orders(), default="1-4", show_default=True, metavar="LIST", help="Drive periods an impact."
)
@click.option("--frequencies-khz", type=Numbers(), metavar="LIST", help="Drive frequencies, the same for every order.")
@click.option(
    "--detuning",
    type=Numbers(),
    metavar="LIST",
    help="Drive frequencies as multiples of each order's resonance 2 N f0; else 0.97:1.05:0.01.",
)
@click.option(
    "--drive-nm", type=Numbers(), default="2,4,7,10", show_default=True, metavar="LIST", help="Drive amplitudes."
)
@click.option(
    "--offsets-nm", type=Numbers(positive=False), default="-1,0,1", show_default=True, metavar="LIST", help="Offsets."
)
@click.option("--largest-nm", type=float, metavar="X", help="Peak amplitude that the instrument takes.")
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
    orders: tuple[int, ...],
    frequencies_khz: tuple[float, ...] | None,
    detuning: tuple[float, ...] | None,
    drive_nm: tuple[float, ...],
    offsets_nm: tuple[float, ...],
    largest_nm: float | None,
    points: int,
    interest: str | None,
    criterion: str,
    noise: float,
    amplitudes: str,
) -> None:
    """Choose the drives to measure next, and forecast how well the law will then be known.

    Say what is believed: the cantilever (--free-frequency-khz, --quality-factor '40 +- 2') and the law (--r,
    --epsilon, ...), or what was measured so far (--fit, --measured); and what can be driven: every combination of
    orders, frequencies, amplitudes and offsets is a candidate. LISTs are numbers and ranges, 1,2,5 or 170:190:1. With
    --out the report: design.csv, to_fill_in.csv (a table for `afm-jax fit`, readings left blank), candidates.csv,
    design.txt, .json, .png. Exit code 3 if no drive can be planned with, or the points do not determine the law.
    """
    if frequencies_khz is not None and detuning is not None:
        raise click.UsageError("--frequencies-khz and --detuning both say what the drive frequency can be; give one")
    session.start_computing()
    from fitting.experiments.candidates import drive_grid  # noqa: PLC0415
    from fitting.experiments.design import design  # noqa: PLC0415
    from fitting.experiments.report import design_summary, write_design  # noqa: PLC0415

    with session.working("forecasting (the first run compiles for some seconds)"):
        belief = believed(belief_options, noise)
        detunings = (detuning or Numbers().convert("0.97:1.05:0.01", None, None)) if frequencies_khz is None else None
        drives = drive_grid(
            orders=orders,
            amplitudes_nm=drive_nm,
            offsets_nm=offsets_nm,
            frequencies_khz=frequencies_khz,
            detunings=detunings,
            free_frequency_khz=belief.free_frequency_khz,
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
        )
    session.emit(result.to_dict(), partial(design_summary, result))
    if session.out is not None:
        for path in write_design(result, session.out, session.write_table):
            session.note(f"wrote {path}")
    if not result.valid:
        raise NotValid(result.reasons[0])
