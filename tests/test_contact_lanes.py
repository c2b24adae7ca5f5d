"""Work on the few lanes of a batch that need it: each ends where it would alone."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from afm_jax.solve.lanes import repeat_for


@pytest.mark.parametrize("block", [3, 64])
def test_the_few_get_what_each_would_alone(block):
    # halved until below the limit of its own: Collatz-like work of a very uneven number of passes
    def halved(value, limit):
        return jnp.where(value > limit, 0.5 * value, value)

    few = repeat_for(halved, lambda value, limit: value > limit, changed=0, passes=9, block=block)
    values, limit = jnp.linspace(0.5, 900.0, 40), jnp.asarray(1.0)
    together = jax.vmap(few, in_axes=(0, None))(values, limit)
    alone = jnp.stack([few(value, limit) for value in values])
    times = np.clip(np.ceil(np.log2(np.asarray(values))), 0, 9)
    # powers of two are exact
    np.testing.assert_array_equal(np.asarray(together), np.asarray(values) * 0.5**times)
    np.testing.assert_array_equal(np.asarray(alone), np.asarray(together))
    slopes = jax.vmap(partial(jax.jvp, few))((values, jnp.full_like(values, 1.0)), (jnp.ones(40), jnp.zeros(40)))[1]
    np.testing.assert_array_equal(np.asarray(slopes), 0.5**times)
