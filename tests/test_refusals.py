"""Wrong calls of the library that no file of the corpus (`tests.malformed`) can make: each is one clear line."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import afm_jax as afm
from afm_jax.impact.law import CollisionDelay, ImpactLaw, TabulatedLaw
from afm_jax.scenefile.parameter_paths import scene_family
from afm_jax.studies.sweep import sweep
from fitting import amplitude_gradients, delay_of_contact, fit, law_of_contact
from fitting.models import split_held
from fitting.simulated.experiment import drives_of, simulate_experiment
from tests.made_fits import made_table

LEVER, LAW = afm.Cantilever(90.0, 40.0), ImpactLaw(0.9)
SHARED = afm.Scene(LEVER, afm.Platform(4.0, 182.0), LAW, base=afm.BaseDrive(0.5, 182.0))
KHZ = "base.frequency_khz"
RANGE = np.array([180.0, 184.0])
FIRST, U, W = made_table(source="a.csv"), [10.0, 20.0, 30.0, 40.0], [9.0, 19.0, 29.0, 39.0]
DRIVE = drives_of([(1, 180.0, 2.0, 0.0)])


def with_second(**changes: Any) -> list[Any]:
    """Return two tables, the second one with other columns or comments."""
    return [FIRST, made_table(source="b.csv", **changes)]


CALLS: list[tuple[Callable[[], Any], str]] = [
    (lambda: afm.continue_orbits(SHARED, 1, f"{KHZ}=180:184"), "several frequencies, so .* moves one part's alone"),
    (lambda: afm.bifurcation_diagram(SHARED, KHZ, RANGE), "several frequencies, so .* moves one part's alone"),
    (lambda: sweep(SHARED, [{"parameter": KHZ, "list": [180.0]}], {"what": "lyapunov"}), "moves one part's alone"),
    (
        lambda: afm.stability_chart(
            scene_family(SHARED, KHZ, "interaction.r"), x_values=RANGE, y_values=RANGE, last_order=1
        ),
        "moves one part's alone",
    ),
    (lambda: fit(with_second(mass_ng=2.0)), "mass_ng is 1 in a.csv and 2 in b.csv: tips of different mass share no"),
    (lambda: fit(with_second()), "b.csv holds the same readings as a.csv; give each table once"),
    (lambda: fit(with_second(quality_factor=41.0), share=["quality_factor"]), r"a.csv says 40 \+- 0.4, and b.csv"),
    (lambda: fit(FIRST, constraints={"quality_factor": (np.nan, 0.1)}), "must be a value and a positive error"),
    (lambda: fit(FIRST, constraints={"viscous_loss": (1.0, 0.1)}), "is on no parameter: choose from r, epsilon, qua"),
    (lambda: split_held((), {"tip_radius_nm": 20.0}, {"tip_radius_nm": (30.0, 1.0)}), "is held at 20 .* known as 30"),
    (lambda: amplitude_gradients(FIRST, "law", {"r": 0.9}), "`values` lacks epsilon"),
    (lambda: delay_of_contact(afm.Contact.paper(), points=2), "must be at least the number of parameters, 3, but is 2"),
    (lambda: law_of_contact(afm.Contact.paper(viscosity_pa_s=1.0)), r"\(the capture speed is 270\.?\d* nm/us\)"),
    (lambda: simulate_experiment(LAW, LEVER, DRIVE, noise=1.5), "`noise` must be between 0 and 1"),
    (lambda: TabulatedLaw(U, W, delay=CollisionDelay(0.2, 5.0, 0.7)), "needs the column `collision_delay_us`"),
    (lambda: TabulatedLaw(U, W, capture_speed_nm_per_us=11.0), "below the slowest tip that leaves, 10 nm/us, but is"),
]


@pytest.mark.parametrize(("call", "said"), CALLS)
def test_what_cannot_be_is_said_in_one_line(call: Callable[[], Any], said: str):
    with pytest.raises(ValueError, match=said) as raised:
        call()
    assert "\n" not in str(raised.value)
