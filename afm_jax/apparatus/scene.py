"""A scene: a cantilever, a moving platform, what happens when they meet, and what drives the tip besides."""

from typing import Any

import equinox as eqx

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.excitation import BaseDrive, ForceDrive
from afm_jax.apparatus.platform import Platform
from afm_jax.parameters import readable


class Scene(eqx.Module):
    """A container, nothing more: its parts are traced parameters, its structure says what is simulated.

    Args:
        cantilever: the tip and its spring.
        platform: the moving sample.
        interaction: an `ImpactLaw`, with or without a collision delay, or a `Contact`; None: the tip never meets the
            sample.
        base: a motion of the cantilever's base; None: it rests.
        force: a force on the tip; None: there is none.
    """

    cantilever: Cantilever
    platform: Platform
    interaction: Any = None  # the modules of the interactions import this one, not the other way round
    base: BaseDrive | None = None
    force: ForceDrive | None = None

    __repr__ = readable


def require_sample_drive(scene: Scene, *, second_frequency: bool = False) -> None:
    """Check that nothing drives a scene but its platform, for what knows nothing else.

    Args:
        scene: the scene.
        second_frequency: whether the platform may have a second frequency.

    Raises:
        ValueError: if there is another drive; says which.
    """
    if scene.base is not None:
        drive = "`base`, a motion of the cantilever's base"
    elif scene.force is not None:
        drive = "`force`, a force on the tip"
    elif scene.platform.second is not None and not second_frequency:
        drive = "`platform.second`, a second frequency of the platform"
    else:
        return
    known = "the platform's motion" if second_frequency else "one cosine of the platform"
    raise ValueError(f"the scene has {drive}, but only {known} is allowed here: leave it out, or simulate the scene")
