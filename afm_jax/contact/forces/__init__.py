"""The forces between tip and sample, one formula a file; `Capillary() + Structural()` acts as their sum."""

from afm_jax.lazy_names import names_of_stub

__getattr__, __dir__, __all__ = names_of_stub(__name__, __file__)
