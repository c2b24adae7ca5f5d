"""A scene: a cantilever, a moving platform, and what happens when they meet."""

from typing import Any

import equinox as eqx

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.apparatus.platform import Platform
from afm_jax.parameters import readable


class Scene(eqx.Module):
    """A container, nothing more: its parts are traced parameters, its structure says what is simulated.

    Args:
        cantilever: the tip and its spring.
        platform: the moving sample.
        interaction: an `ImpactLaw`, with or without a collision delay.
    """

    cantilever: Cantilever
    platform: Platform
    interaction: Any  # the modules of the interactions import this one, not the other way round

    __repr__ = readable
