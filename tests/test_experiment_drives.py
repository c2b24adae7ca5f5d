"""What can be driven: grids, and the lists of the command line."""

import click
import numpy as np
import pytest

from afm_jax.cli.values import Numbers, Orders, ValueAndError
from fitting import prior_of_values
from fitting.experiments.candidates import drive_grid


def test_detunings_are_about_each_orders_resonance_and_every_combination_is_there_once():
    drives = drive_grid(
        orders=(1, 3, 1), amplitudes_nm=(2, 4, 2.0), offsets_nm=(-1, 1), detunings=(0.97, 1.0), free_frequency_khz=90.0
    )
    found = sorted(zip(*(column.tolist() for column in drives), strict=True))
    # 2 N f0 times the detuning
    places = [(1, 174.6), (1, 180.0), (3, 523.8), (3, 540.0)]
    assert found == [(*place, drive, offset) for place in places for drive in (2.0, 4.0) for offset in (-1.0, 1.0)]


def test_lists_and_errors_are_read():
    for kind, text, value in (
        (Numbers(positive=False), "0.97:1:0.01", (0.97, 0.98, 0.99, 1.0)),
        (Numbers(positive=False), "170:190:8", (170.0, 178.0, 186.0)),
        (Orders(), "1-3, 2,7", (1, 2, 3, 7)),
        (ValueAndError(), "40+/-2", (40.0, 2.0)),
        (ValueAndError(), "40 ± 2", (40.0, 2.0)),
        (ValueAndError(), "40", (40.0, None)),
    ):
        assert kind.convert(text, None, None) == value


def test_wrong_ones_are_refused():
    wrong = {
        Numbers(positive=False): ["", "a", "1:2", "2:1:1", "1:2:0", "0:1:1e-9", "nan", "1,,2"],
        Numbers(): ["1,0"],
        Orders(): ["", "0", "-1", "1-", "3-1", "1.5", "1-2-3", "1000"],
        ValueAndError(): ["", "40 +- 0", "40 +- -1", "1 +- 2 +- 3", "x"],
    }
    for kind, text in ((kind, text) for kind, texts in wrong.items() for text in texts):
        with pytest.raises(click.BadParameter):
            kind.convert(text, None, None)


def test_a_frequency_is_believed_to_its_error_and_no_share_of_it():
    known = {"quality_factor": (200.0, 2.0), "free_frequency_khz": (90.0, 0.01)}
    prior = prior_of_values("law", free_frequency_khz=90.0, quality_factor=200.0, constraints=known, drive="base")
    drawn = prior.draws(200)[:, prior.problem.names.index("free_frequency_khz")]
    assert np.std(drawn) == pytest.approx(0.01, rel=0.5)


def test_what_is_assumed_of_the_papers_contact_goes_with_the_mass():
    light, heavy = (prior_of_values("viscous+delay", free_frequency_khz=90.0, mass_ng=mass) for mass in (1.0, 16.0))
    ratio = dict(zip(light.problem.names, heavy.values / light.values, strict=True))
    # a loss of squared speed is an energy over m; the Hertz time goes with m^(2/5)
    wanted = {"epsilon": 1.0 / 16.0, "viscous_loss": 1.0 / 16.0, "delay_hertz": 16.0**0.4, "delay_lead_nm": 1.0}
    assert {name: ratio[name] for name in wanted} == pytest.approx(wanted)
