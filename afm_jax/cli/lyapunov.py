"""`afm-jax lyapunov SCENE.toml`: the Lyapunov exponents of a motion, or of one for each value of a parameter."""

from afm_jax.cli.command import NamedScene, Output, picture_of
from afm_jax.cli.session import Session
from afm_jax.cli.values import ranges_of
from afm_jax.dynamics.bands import drawn_exponents
from afm_jax.dynamics.exponents import lyapunov_spectrum
from afm_jax.motion.start import start_of
from afm_jax.scenefile.parameter_paths import scene_batch


def lyapunov(
    session: Session,
    scene: NamedScene,
    *,
    impacts: int,
    transient: int,
    parameter: str | None,
    draws: int,
) -> Output:
    """Return the Lyapunov exponents of a scene's motion, or of those along a parameter."""
    ranges = ranges_of(scene.name, scene.scene, [parameter] if parameter else [], counted=True)
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
    return Output.of(result, files={"lyapunov.png": picture_of("dynamics:exponents_figure", result)})
