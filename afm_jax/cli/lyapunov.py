"""`afm-jax lyapunov SCENE.toml`: the Lyapunov exponents of a motion, or of one for each value of a parameter."""

from typing import Annotated

from click import IntRange

from afm_jax.cli.command import Output
from afm_jax.cli.scenes import NamedScene, ranges_of
from afm_jax.cli.session import Session
from afm_jax.dynamics.bands import drawn_exponents
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.motion.start import start_of
from afm_jax.scenefile.parameter_paths import scene_batch


def lyapunov(
    session: Session,
    scene: NamedScene,
    *,
    impacts: Annotated[int, IntRange(20)] = 2000,
    transient: Annotated[int, IntRange(0)] = 500,
    parameter: Annotated[str | None, "P=a:b:n"] = None,
    draws: Annotated[int, IntRange(2)] = 20,
) -> Output:
    """Compute Lyapunov exponents by QR of the impact map's exact Jacobians; for contacts, of the simulation's.

    Exponents of a motion that has reached an orbit are the logarithms of its multipliers. A tip that rests on the
    platform forgets its start: its exponents are minus infinity, null in JSON. The motion begins at the file's [start];
    without one on a stable single-impact orbit of the order nearest to resonance, else leaving the sample upward. A
    motion that stays on an unstable orbit is undecided. With --law the larger exponent has a band, whose motions do not
    use [start]. With --out lyapunov.csv, and with --parameter a picture. Exit code 3 if every motion ends before enough
    impacts.

    Args:
        session: for progress.
        scene: the scene.
        impacts: impacts to average over.
        transient: impacts before these.
        parameter: a parameter of the scene file and its values, one motion each.
        draws: laws drawn from the fit for the bands.
    """
    ranges = ranges_of(scene, [parameter] if parameter else [], counted=True)
    values = {swept.path: swept.values for swept in ranges}
    motions = scene_batch(scene.scene, values) if values else scene.scene
    start = None if scene.start is None else start_of(motions, scene.start)
    lengths = {"impacts": impacts, "transient": transient}
    band = None
    with session.working("following the motion (the first run compiles for some seconds)", "motions") as report:
        result = lyapunov_spectrum(motions, start, **lengths, report=report)
        if scene.unknowns is not None:
            band = drawn_exponents(scene.scene, values, scene.unknowns, draws=draws, **lengths)
    if not ranges:
        return Output.of(result._replace(larger_interval95=None if band is None else band[0]))
    result = result._replace(along=ranges[0], larger_interval95=band)
    return Output.of(result, "lyapunov")
