"""The surface that a free tip sees: the platform, less what the other drives make of the tip without it.

Takes a scene; gives s as a `Surface` (position in nm, velocity in nm/us at a time in us) and p (`surface_of`).

Under a force f(t) and a base motion z_b(t) a free tip has the steady response p(t) = Re sum H(omega) a exp(i(omega t +
phi)), a = f/m + Omega^2 z_b, H = 1/(Omega^2 - omega^2 + i omega Omega/Q). What is left of it, y = z - p, flies freely,
and the gap is y - s with the surface s = z_p - p: offset, ramp and cosines once more. So whatever drives a scene,
every integrator sees a free cantilever over a moving surface.
"""

from collections.abc import Iterable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.drives import SAME_FREQUENCY, BaseDrive, ForceDrive, Tone, Wave
from afm_jax.apparatus.platform import MovingSurface, Platform
from afm_jax.apparatus.scene import Scene, require_one_frequency
from afm_jax.apparatus.trigonometry import sine_cosine
from afm_jax.checks import as_argument, as_parameter, is_traced, readable
from afm_jax.units import RAD_PER_US_PER_KHZ, within_turn

_AT_RESONANCE = 1e-9
"""Relative distance from the free frequency below which an undamped cantilever has no steady response."""


class Surface(MovingSurface):
    """A surface at offset + rate t + a sum of waves.

    Args:
        offset_nm: mean height at time 0.
        offset_rate_nm_per_us: slow ramp of the offset.
        tones: the waves.
    """

    offset_nm: Float[Array, "..."] = eqx.field(converter=as_parameter)
    offset_rate_nm_per_us: Float[Array, "..."] = eqx.field(converter=as_parameter)
    tones: tuple[Wave, ...]

    __repr__ = readable

    @property
    def waves(self) -> tuple[Wave, ...]:
        """The waves."""
        return self.tones


def surface_of(scene: Scene) -> tuple[Platform | Surface, Surface | None]:
    """Return the surface that a scene's tip sees, and the tip's steady response to the drives of base and tip.

    Without such drives the surface is the platform itself. Called outside `jit`, it leaves out cosines whose amplitude
    is 0.

    Args:
        scene: any scene.

    Returns:
        The surface s that the freely moving y = z - p sees: D = y - s; and p, or None where there is no base and no
        force.

    Raises:
        ValueError: if an undamped cantilever is driven at its free frequency, where there is no steady response.
    """
    if scene.base is None and scene.force is None:
        return scene.platform, None
    platform, cantilever = scene.platform, scene.cantilever
    # an acceleration in nm/us^2 for 1 nm of the base and 1 nN
    pushes = cantilever.angular_frequency**2, 1.0 / cantilever.mass_ng
    response: list[Wave] = []
    for name, drive, push in zip(("base", "force"), (scene.base, scene.force), pushes, strict=True):
        if drive is not None:
            check_steady_response(cantilever, drive.tones, name)
            moving = (tone for tone in drive.tones if not _is_known_zero(tone.amplitude))
            response += [_response(cantilever, tone.wave, push) for tone in moving]
    motion = [wave for wave in platform.waves if not (_is_known_zero(wave.cosine) and _is_known_zero(wave.sine))]
    waves = (*motion, *(-wave for wave in response))
    surface = Surface(platform.offset_nm, platform.offset_rate_nm_per_us, waves)
    still = jnp.zeros_like(platform.offset_nm)
    return surface, Surface(still, still, tuple(response))


class FreeFrame(NamedTuple):
    """A periodic scene as a freely moving tip sees it, its clock set to where the surface is highest.

    Waves count in this clock.
    """

    platform: Platform
    """The surface: offset, ramp and one cosine."""
    phase_rad: Float[Array, "..."]
    """Phase omega t of the scene's own clock when this one shows 0."""
    response: Wave | None
    """The tip's steady response, which is missing from the free motion; None without base and force."""
    base: Wave | None
    """The base's motion, against which the deflection counts; None where there is none."""
    drive_phase_rad: Float[Array, "..."]
    """Phase of the base's cosine, else of the force's, else of the platform's, in this clock."""
    periodic: Bool[Array, "..."]
    """Whether everything that moves has one frequency."""


def free_frame(scene: Scene) -> FreeFrame:
    """Return a scene as a freely moving tip sees it: over a platform, whatever drives it.

    Args:
        scene: any scene without second frequencies; its numbers may be traced.

    Raises:
        ValueError: if a part has a second frequency, or as `surface_of`.
    """
    require_one_frequency(scene)
    surface, response = surface_of(scene)
    if response is None or isinstance(surface, Platform):
        still = jnp.zeros_like(scene.platform.frequency_khz)
        return FreeFrame(scene.platform, still, None, None, still, still == 0.0)
    excitations = [part for part in (scene.base, scene.force) if part is not None]
    tones = [(scene.platform.amplitude_nm, scene.platform.frequency_khz)]
    tones += [(part.tones[0].amplitude, part.frequency_khz) for part in excitations]
    # the frequency of the first part that moves; where several do they must agree
    frequency = tones[-1][1]
    for amplitude, own in reversed(tones):
        frequency = jnp.where(amplitude > 0.0, own, frequency)
    periodic = jnp.ones_like(frequency, dtype=bool)
    for amplitude, own in tones:
        periodic = periodic & ((amplitude == 0.0) | (jnp.abs(own - frequency) <= SAME_FREQUENCY * frequency))
    omega = RAD_PER_US_PER_KHZ * frequency
    motion = _summed(surface.waves, omega)
    phase = _angle(motion.cosine, motion.sine)
    return FreeFrame(
        platform=Platform(motion.amplitude_nm, frequency, surface.offset_nm, surface.offset_rate_nm_per_us),
        phase_rad=phase,
        response=_later(_summed(response.waves, omega), phase),
        base=None if scene.base is None else _later(scene.base.tones[0].wave, phase),
        drive_phase_rad=excitations[0].tones[0].phase_rad + phase,
        periodic=periodic,
    )


def _summed(waves: Iterable[Wave], angular_frequency: Float[Array, "..."]) -> Wave:
    zero = jnp.zeros_like(angular_frequency)
    return sum(waves, start=Wave(zero, zero, angular_frequency))


def _later(wave: Wave, phase: Float[Array, "..."]) -> Wave:
    """Return a wave against a clock that shows 0 at a phase omega t of the wave's own."""
    sine, cosine = sine_cosine(phase)
    return Wave(
        wave.cosine * cosine + wave.sine * sine, wave.sine * cosine - wave.cosine * sine, wave.angular_frequency
    )


def _angle(cosine: Float[Array, "..."], sine: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the angle of a point, with slope 0 at the origin."""
    moves = (cosine != 0.0) | (sine != 0.0)
    return jnp.where(moves, jnp.arctan2(sine, jnp.where(moves, cosine, 1.0)), 0.0)


def size_and_lag(
    along: Float[Array, "..."], across: Float[Array, "..."], drive_rad: Float[Array, "..."], order: ArrayLike = 1.0
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return amplitude and lag behind a drive, in degrees modulo 360/N, of a motion Re((x + i y) exp(i omega t/N)).

    Args:
        along: x, in nm.
        across: y.
        drive_rad: phase of the drive's cosine of omega t.
        order: N.
    """
    square = along**2 + across**2
    moves = square > 0.0
    size = jnp.where(moves, jnp.sqrt(jnp.where(moves, square, 1.0)), 0.0)
    lag = jnp.rad2deg(drive_rad / order - _angle(along, across))
    return size, within_turn(lag, 360.0 / as_argument(order))


def force_per_height(
    frequency_ratio: ArrayLike, quality_factor: ArrayLike | None
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return gamma = 1 - s^2 + i s/Q, real and imaginary part: the force over k that a steady height 1 needs.

    Args:
        frequency_ratio: s, the drive's frequency over the free one.
        quality_factor: Q; None: no air damping.
    """
    s = as_argument(frequency_ratio)
    return (1.0 - s) * (1.0 + s), jnp.zeros_like(s) if quality_factor is None else s / quality_factor


def height_of_free_deflection(
    deflection_nm: ArrayLike, frequency_ratio: ArrayLike, quality_factor: ArrayLike | None
) -> Float[Array, "..."]:
    """Return the amplitude of the height of a free tip on a moving base, |D| / |1 - gamma|, in nm.

    Args:
        deflection_nm: amplitude |D| of the deflection z - z_base of the free tip.
        frequency_ratio: s.
        quality_factor: Q.
    """
    real, imaginary = force_per_height(frequency_ratio, quality_factor)
    return as_argument(deflection_nm) / jnp.hypot(1.0 - real, imaginary)


def drive_per_free_height(
    cantilever: Cantilever, frequency_khz: ArrayLike, drive: type[BaseDrive | ForceDrive]
) -> Float[Array, "..."]:
    """Return what amplitude of a drive moves the free tip by an amplitude of 1 nm: nm of a base, nN of a force.

    Args:
        cantilever: the tip and its spring.
        frequency_khz: of the drive.
        drive: which of the two.
    """
    ratio = as_argument(frequency_khz) / cantilever.frequency_khz
    size = jnp.hypot(*force_per_height(ratio, cantilever.quality_factor))
    return cantilever.stiffness_n_per_m * size if issubclass(drive, ForceDrive) else size


def detected(
    amplitude_nm: ArrayLike,
    phase_deg: ArrayLike,
    free_amplitude_nm: ArrayLike,
    frequency_ratio: ArrayLike,
    quality_factor: ArrayLike | None,
    *,
    base: bool,
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return what a detector shows of a driven tip over a resting sample, from its motion in the free tip's frame.

    There the tip is driven by a platform sigma + A0 cos(omega t) and its lock-in value, W, is an orbit's of order 1.
    The free height is -A0, so that Z = W - A0 is the height, and the drive -gamma A0: a force over k, or the base's
    motion, against which the deflection is D = Z + gamma A0.

    Args:
        amplitude_nm: |W|.
        phase_deg: its phase; 0 where the platform of the frame is highest.
        free_amplitude_nm: A0, amplitude of the free tip's height (`height_of_free_deflection`).
        frequency_ratio: s, the drive's frequency over the free one.
        quality_factor: Q; None: no air damping.
        base: whether the base moves, and the deflection is detected; else a force drives, and the height is.

    Returns:
        Amplitude in nm, and by how much it lags behind force or base, in degrees from 0 to 360; arrays of any shape.
    """
    real, imaginary = force_per_height(frequency_ratio, quality_factor)
    moved = as_argument(amplitude_nm)
    free = as_argument(free_amplitude_nm)
    turn = jnp.deg2rad(as_argument(phase_deg))
    along, across = moved * jnp.cos(turn) - free, moved * jnp.sin(turn)
    if base:
        along, across = along + real * free, across + imaginary * free
    return size_and_lag(along, across, jnp.arctan2(-imaginary, -real))


def seen_freely(scene: Scene) -> tuple[Scene, Surface | None]:
    """Return a scene with `surface_of` in place of its platform and without base and force, and the steady response.

    For whatever follows flights over surfaces; velocities there lack the response's.
    """
    surface, response = surface_of(scene)
    if response is None:
        return scene, None
    parts = (surface, None, None)
    seen = eqx.tree_at(lambda s: (s.platform, s.base, s.force), scene, parts, is_leaf=lambda leaf: leaf is None)
    return seen, response


def check_steady_response(cantilever: Cantilever, tones: tuple[Tone, ...], name: str) -> None:
    """Check that a cantilever has a steady response to tones, as far as the numbers are known.

    Args:
        cantilever: the cantilever.
        tones: what pushes it.
        name: what the message calls the drive.

    Raises:
        ValueError: if it is not damped and a tone is within 1e-9 of its free frequency.
    """
    free, quality = cantilever.frequency_khz, cantilever.quality_factor
    for tone in tones:
        concrete = not any(is_traced(value) for value in (free, quality, tone.frequency_khz) if value is not None)
        if not concrete or _is_known_zero(tone.amplitude):
            continue
        undamped = quality is None or np.isinf(np.asarray(quality))
        distance = np.abs(np.asarray(tone.frequency_khz) - np.asarray(free))
        if np.any(undamped & (distance < _AT_RESONANCE * np.asarray(free))):
            raise ValueError(
                f"`{name}` drives an undamped cantilever at its free frequency, where the vibration grows without "
                "end: give a quality_factor, or drive it at another frequency"
            )


def _response(cantilever: Cantilever, wave: Wave, push: Float[Array, "..."]) -> Wave:
    """Return the steady response to a wave that pushes the tip with an acceleration, in nm/us^2 per amplitude.

    A wave is Re((c - i s) exp(i omega t)), and its response has the factor H = (d - i g)/(d^2 + g^2) with
    d = Omega^2 - omega^2 and g = omega Omega/Q.
    """
    Omega, omega = cantilever.angular_frequency, wave.angular_frequency
    # as a product: a difference of squares loses digits near resonance
    d, g = (Omega - omega) * (Omega + omega), 2.0 * cantilever.decay_rate * omega
    size = push / (d * d + g * g)
    return Wave(size * (d * wave.cosine - g * wave.sine), size * (g * wave.cosine + d * wave.sine), omega)


def _is_known_zero(amplitude: Float[Array, "..."]) -> bool:
    return not is_traced(amplitude) and not np.any(np.asarray(amplitude))
