"""Measurements in processes of their own."""

import os

import pytest

from afm_jax.compilation_cache import available_cores
from afm_jax.scenefile.scenefile import load_scene
from afm_jax.studies.timing import run_in_own_process


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system cannot pin a process")
def test_one_core_really_is_one():
    assert run_in_own_process(available_cores) == 1


def test_what_a_measurement_refuses_is_said_in_its_own_words():
    with pytest.raises(ValueError, match=r"^nowhere: there is no such file or preset"):
        run_in_own_process(load_scene, path="nowhere")


def test_a_process_that_fails_is_an_error():
    with pytest.raises(RuntimeError, match="terminated abruptly"):
        run_in_own_process(os._exit, status=1)
