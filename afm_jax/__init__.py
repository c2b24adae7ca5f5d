"""Intermittent-contact atomic force microscopy in JAX: the impact oscillator, its stability and its amplitudes.

Names are listed in `__init__.pyi` and imported when they are first used: `import afm_jax` is cheap and does not
start JAX.
"""

from afm_jax.lazy_names import names_of_stub

__getattr__, __dir__, __all__ = names_of_stub(__name__, __file__)
