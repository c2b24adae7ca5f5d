"""`python -m afm_jax`: the same as `afm-jax`."""

from afm_jax.cli.main import main

main(prog_name="afm-jax")
