"""Parameter sets for tests with the references."""

from typing import Any

from tests.reference_flight import Parameters

# the contact model's, physics.md
DELAY = (0.206, 5.64, 0.726)


def scene(reduced: float = 1.01, **changes: Any) -> Parameters:
    """Return the paper's tip over a platform driven at `reduced` times twice its free frequency."""
    values: dict[str, Any] = {
        "frequency_khz": 90.0,
        "quality_factor": 40.0,
        "amplitude_nm": 4.0,
        "offset_nm": -1.0,
        "r": 0.9981,
        "epsilon": 122.0,
    }
    return Parameters(drive_frequency_khz=180.0 * reduced, **(values | changes))


SCENES = {
    "paper": scene(quality_factor=None),
    "damped": scene(),
    "viscous": scene(r=1.0, viscous_loss=0.48),
    "delayed": scene(r=0.9999, viscous_loss=0.48, delay=DELAY),
}
