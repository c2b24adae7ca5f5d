"""Commands about the motions of a scene."""

from importlib import import_module
from pathlib import Path

import click

from afm_jax.cli.command import Command, Options
from afm_jax.cli.options import DRAWS, LAW, SCENE, flag, valued
from afm_jax.cli.session import Session
from afm_jax.cli.values import Course, Ends, Finite, Grid, Orders, Share

BASINS = Command(
    name="basins",
    runs="afm_jax.cli.basins:basins",
    help="""Find the motion on which each start of a scene ends.

    A start is a drive phase and a speed at which the tip leaves the platform, at most four times the platform's top
    speed unless --speeds says otherwise. Attractors are named (m,N), m impacts in N drive periods, chaotic (the larger
    Lyapunov exponent is positive), irregular, stuck or free. The output gives the fraction of the starts that end on
    each, with the errors of as many random starts. With --law fractions have a band from drawn laws. With --out
    basins.csv (a row a start), attractors.csv and a picture. Exit code 3 if starts could not be followed.
    """,
    options=(
        SCENE,
        valued("--grid", Grid(), "Drive phases x rebound speeds.", default="300x300"),
        valued(
            "--speeds", Ends(), "Range of the rebound speed, in nm/us.", into="speeds_nm_per_us", metavar="LOW:HIGH"
        ),
        LAW,
        DRAWS,
    ),
)

BIFURCATION = Command(
    name="bifurcation",
    runs="afm_jax.cli.bifurcation:bifurcation",
    help="""Ramp a parameter and record the motion on which the tip settles at each of its values.

    The tip is carried from value to value with its drive phase and rebound speed. It starts at the file's [start];
    without one on a stable single-impact orbit of the order nearest to resonance (of a contact: of the law closest to
    it), else leaving the sample upward. Where the sample held it or it flew away it starts again in the same way. The
    output gives the motion at each value, (m,N): m impacts in N drive periods, irregular, stuck or free; and its last
    impacts. With --out bifurcation.csv (one row per value), impacts.csv (one row per impact; each impact of an orbit
    once), strobe.csv (heights whenever the platform is highest) and a picture. With --law also the fraction of the
    fit's draws with the same motion. Exit code 3 if no motion went on anywhere.
    """,
    options=(
        SCENE,
        valued("--parameter", str, "A parameter of the scene file and its values.", metavar="P=a:b:n", required=True),
        flag("--both", "Ramp up and then down, so that hysteresis shows."),
        flag("--down", "Ramp down instead of up."),
        valued("--impacts", click.IntRange(200), "Impacts at every value.", default=2000),
        LAW,
        DRAWS,
    ),
)


CHART = Command(
    name="chart",
    runs="afm_jax.cli.chart:chart",
    help="""Chart the single-impact orbits that exist, are stable and coexist, over two parameters of a scene.

    The output says for every point and order whether an orbit is admissible and whether one is stable. For the stable
    one (the highest, if there are several) it gives the peak amplitude and the size of the larger multiplier. Orbits of
    a contact are closed by simulation, from those of the law closest to it: chart a thousand points, not a million. A
    point is unresolved where none closes. With --law also the fraction of the fit's draws in which an orbit is stable.
    With --out chart.csv and a picture. Exit code 3 if there is no admissible orbit at all.
    """,
    options=(
        SCENE,
        valued("--x", str, "A parameter of the scene file: the chart's columns.", metavar="P=a:b:n", required=True),
        valued("--y", str, "A second one: the chart's rows.", metavar="P=a:b:n", required=True),
        valued("--orders", click.IntRange(1, 100), "Highest order N.", default=8),
        LAW,
        DRAWS,
    ),
)

LYAPUNOV = Command(
    name="lyapunov",
    runs="afm_jax.cli.lyapunov:lyapunov",
    help="""Compute Lyapunov exponents by QR of the impact map's exact Jacobians; for contacts, of the simulation's.

    Exponents of a motion that has reached an orbit are the logarithms of its multipliers. A tip that rests on the
    platform forgets its start: its exponents are minus infinity, null in JSON. The motion begins at the file's [start];
    without one where `simulate` begins: on a single-impact orbit of the order nearest to resonance, or just beside it
    if it is unstable, else leaving the sample upward. With --parameter or --law it begins on a stable orbit or leaves
    the sample upward. An orbit is reported only if it is stable. With --law the larger exponent has a band, whose
    motions do not use [start]. With --out lyapunov.csv, and with --parameter a picture. Exit code 3 if every motion
    ends before enough impacts.
    """,
    options=(
        SCENE,
        valued("--impacts", click.IntRange(20), "Impacts to average over.", default=2000),
        valued("--transient", click.IntRange(0), "Impacts before these.", default=500),
        valued("--parameter", str, "A parameter of the scene file and its values, one motion each.", metavar="P=a:b:n"),
        LAW,
        DRAWS,
    ),
)


CONTINUE = Command(
    name="continue",
    runs="afm_jax.cli.continue_orbits:follow",
    help="""Follow the (m, N) orbits of a scene through a parameter, round folds, by pseudo-arclength.

    Folds, period doublings, torus points, grazings and captures are located to rounding; with --second they are
    followed as curves in two parameters, with cusps and meetings. In a scene with a contact the simulation is closed
    instead of the map, and curves end where the orbit grazes or is captured. With --law every special point has a 95 %
    interval. With --out tables and pictures. Exit code 3 if there is no admissible orbit in the range.
    """,
    options=(
        SCENE,
        valued("--order", click.IntRange(1, 1_000_000), "Drive periods of the orbit.", required=True),
        valued("--impacts", click.IntRange(0, 64), "Impacts in these periods; 0: the free motion.", default=1),
        valued(
            "--parameter",
            str,
            "A parameter of the scene file and its range, such as platform.reduced_frequency=0.9:1.1.",
            metavar="P=A:B",
            required=True,
        ),
        valued("--second", str, "A second parameter: special points are followed as curves in both.", metavar="P=A:B"),
        LAW,
    ),
)


EFFECTS = Command(
    name="effects",
    runs="afm_jax.cli.effects:effects",
    help="""Say what each effect of a scene changes and costs.

    Each effect is left out in turn, and the steady motion is compared with that of the full scene: peak and lock-in
    amplitude, phase, energy lost per impact. All motions begin at the file's [start], or else at the scene's default
    one. Where nothing repeats (a ramp, several frequencies) the last fifth of the duration is compared. Costs are times
    to compute a drive period, the median of several runs. With --out effects.csv, effects.json, effects.png and
    reduced.toml: the scene, and its start, without the effects that the accuracy does not need.
    """,
    options=(
        SCENE,
        valued(
            "--accuracy",
            Share(),
            "Wanted accuracy of the amplitudes, 1% or 0.01; the output names the effects that it does not need.",
            default="1%",
        ),
        valued("--duration-us", Finite(positive=True), "Longest time to follow each scene, in us."),
        valued("--only", str, "The effects to study; else all.", metavar="NAME,..."),
    ),
)


ORBITS = Command(
    name="orbits",
    runs="afm_jax.cli.orbits:orbits",
    help="""Find all single-impact orbits of a scene with a law, or with --impacts orbits of several impacts.

    The output gives for every orbit impact phase and velocities, peak and lock-in amplitude of the height, whether it
    is stable, and whether it is admissible (its flight stays above the platform). If base or force drive, it also gives
    amplitude, phase and lag at the drive's frequency, and the deflection against a moving base. With --impacts it lists
    every impact, the hardest first. Orbits of a contact are listed in the same way: an impact lasts from the formation
    of the bridge to its rupture (of a dry contact: while its forces act); phase and velocity are those at rupture. The
    search may miss orbits of a contact, of a law with delay, and of several impacts. With --out orbits.csv and
    orbits.png. Exit code 3 if none is admissible.
    """,
    options=(
        SCENE,
        valued(
            "--order",
            click.IntRange(1, 1_000_000),
            "Drive periods between two impacts, a positive integer.",
            required=True,
        ),
        valued(
            "--impacts",
            click.IntRange(1, 1_000_000),
            "Impacts in these periods, found by a search from many starts; without it, all single-impact orbits.",
        ),
        LAW,
    ),
)


DEFAULT_PERIODS = 2000
"""Drive periods followed at most where no duration is given."""


def _check_simulation(session: Session, options: Options) -> None:
    """Check that there is one duration, and that a trace has a folder."""
    if options["duration_us"] is not None and options["periods"] is not None:
        raise click.UsageError("--duration-us and --periods say the same: give one of them")
    if options["samples"] and session.out is None:
        raise click.UsageError("--samples writes a trace: say into which folder by --out DIR")
    if options["heights"] is not None:
        if options["duration_us"] is not None or options["samples"]:
            raise click.UsageError(
                "--heights follows every height until it settles: leave out --duration-us, --samples"
            )
        return
    for option, name in (("--noise", "noise"), ("--phase-noise-deg", "phase_noise_deg")):
        if options[name] is not None:
            raise click.UsageError(f"{option} is that of an approach curve: give --heights, too")


SIMULATE = Command(
    name="simulate",
    runs="afm_jax.cli.simulate:simulation",
    help="""Follow a scene in time: contacts, amplitudes, phases, forces, energies.

    SCENE.toml is a scene file, PRESET the name of one of the paper's scenes (figure2, figure8, ...). The tip starts at
    the file's [start]; without one on the single-impact orbit that the law with delay predicts, if there is one.
    Amplitudes are read over the last response period if the motion has settled, else over the last fifth of the time:
    at the drive's frequency, and at the response's, which is 1/N of it if the motion repeats after N drive periods.
    With --out contacts.csv, trajectory.csv, simulate.json and pictures. A tip that sticks, or does not settle, is a
    result; exit code 3 if the simulation broke off.

    With --heights the cantilever is driven by [force] or [base], and the sample moves through heights over its rest
    position and back. The output is amplitude and lag against height; at each height the motion is followed from the
    one before until it settles (--periods at most). With --out curve.csv, with noise, as `afm-jax tapping` reads it;
    curve_points.csv, without noise; curve.json and curve.png. Exit code 3 if the tip settles at no height.
    """,
    options=(
        SCENE,
        valued(
            "--heights",
            Course(),
            "Record an approach curve, both ways: heights of the sample in nm, negative below the rest position.",
            metavar="FROM:TO:COUNT",
        ),
        valued("--duration-us", Finite(positive=True), "Time to follow the scene, in us."),
        valued(
            "--periods",
            Finite(positive=True),
            "The same in periods of the drive. Without either the simulation ends when the motion has settled, or "
            f"after {DEFAULT_PERIODS} periods.",
        ),
        valued(
            "--harmonics",
            Orders("multiple"),
            "Multiples of the response frequency omega/N at which amplitude and phase are read; they are always read "
            "at the drive's.",
            default="1",
        ),
        valued(
            "--accuracy",
            Finite(positive=True),
            "Relative accuracy of the rebound speed of every resolved contact.",
            default=1e-9,
        ),
        valued(
            "--samples",
            click.Choice(["uniform"]),
            "Write trace.csv into --out, too: the deflection over the last response periods at equal steps of "
            "time, as `afm-jax lockin` reads it.",
        ),
        valued(
            "--noise", Share("a relative error"), "With --heights: noise of the amplitudes in curve.csv; else 0.3%."
        ),
        valued("--phase-noise-deg", Finite(positive=True), "With --heights: noise of the lags in curve.csv; else 0.2."),
        LAW,
    ),
    check=_check_simulation,
)


def _check_sweep(session: Session, options: Options) -> None:
    """Check where results go and that they can be written."""
    if options["workers"] is not None and options["scheduler"] is not None:
        raise click.UsageError("--scheduler has workers of its own: leave --workers out")
    if session.out is None:
        raise click.UsageError("--out is missing: name a folder for the results")
    import_module("xarray")
    import_module("zarr")


SWEEP = Command(
    name="sweep",
    runs="afm_jax.cli.sweep:sweep",
    help="""Compute many scenes over the grid of SWEEP.toml into DIR/sweep.zarr; after a fault, the same call continues.

    \b
    scene = "scene.toml"                  # or a preset
    accuracy = 1e-6                       # of resolved contacts; may be left out
    [record]
    what = "orbits"                       # simulation, collide, lyapunov
    orders = [1, 2]
    [[axes]]
    parameter = "platform.reduced_frequency"
    linear = [0.9, 1.1, 1000]             # or log = [low, high, count], or list = [...]
    [[axes]]
    random = { "interaction.r" = [0.9, 0.99], "interaction.epsilon" = { log = [1, 100] } }
    count = 500
    seed = 1

    `xarray.open_zarr` opens the results. Other workers give the same numbers except for last digits. Finished chunks
    are kept, whatever happens. Only one sweep at a time may write into a folder.
    """,
    options=(
        click.argument("sweep", metavar="SWEEP.toml", type=click.Path(path_type=Path)),
        valued(
            "--workers",
            click.IntRange(1, 1024),
            "Number of processes that share this machine's cores, by Dask; 1: this process alone.",
        ),
        valued("--scheduler", str, "A Dask scheduler whose workers do the work.", metavar="tcp://..."),
        flag("--plot", "Draw a sweep of one or two axes, sweep.png."),
        LAW,
    ),
    check=_check_sweep,
)

COMMANDS = (BASINS, BIFURCATION, CHART, CONTINUE, EFFECTS, LYAPUNOV, ORBITS, SIMULATE, SWEEP)
