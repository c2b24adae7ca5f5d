"""Tapping curves of a contact with a viscous bridge: the full scene in time, energies from the ledger of the motion.

    python -m tests.tapping_truth_of_contacts

makes those that are missing in `tests/tapping_tables` (a minute or two each). A bridge of a more viscous liquid than
water takes more of a faster tip, so that the energy of a tap changes along the curve.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from tests.tapping_truth_of_laws import Tip, Truth, truth_of

FOLDER = Path(__file__).with_name("tapping_tables")
VISCOSITIES = (100.0, 400.0)
"""Of the bridge, over that of the paper's water."""
RATIOS = (1.0, 1.02)
HEIGHTS_NM = tuple((-40.0 * np.linspace(0.96, 0.15, 32)).tolist())


def path_of(viscosity: float, ratio: float) -> Path:
    """Return where the curve of a contact is kept."""
    return FOLDER / f"viscous_{viscosity:g}_{ratio:g}.csv"


def curve_of_contact(viscosity: float, ratio: float, drive: str, rows: int = 100) -> tuple[Tip, Truth]:
    """Return the cantilever of a curve and what it does in contact, simulated where the curve is not kept.

    Args:
        viscosity: of the bridge, over that of the paper's water.
        ratio: drive over free frequency.
        drive: "force" or "base".
        rows: heights, between those simulated by a spline.
    """
    path = path_of(viscosity, ratio)
    if not path.exists():
        _simulate(path, viscosity, ratio)
    kept = np.loadtxt(path, delimiter=",", skiprows=1)
    height = np.linspace(kept[0, 0], kept[-1, 0], rows)
    amplitude, lag, energy = CubicSpline(kept[:, 0], kept[:, 1:])(height).T
    tip = Tip(ratio=ratio, drive=drive)
    return tip, truth_of(tip, height, amplitude, lag, energy)


def _simulate(path: Path, viscosity: float, ratio: float) -> None:
    from afm_jax.contact.contact import Contact  # noqa: PLC0415
    from afm_jax.contact.parameters import PAPER  # noqa: PLC0415
    from fitting.examples.make_tapping import TIP_RADIUS_NM, steady_curve  # noqa: PLC0415

    contact = Contact.paper(tip_radius_nm=TIP_RADIUS_NM, viscosity_pa_s=viscosity * PAPER["viscosity_pa_s"])
    curve = steady_curve(HEIGHTS_NM, ratio, contact)
    columns = np.column_stack([HEIGHTS_NM, curve.amplitude_nm, curve.phase_lag_deg, curve.dissipated_in_contact_aj])
    np.savetxt(path, columns, delimiter=",", fmt="%.9g", header="height_nm,amplitude_nm,lag_deg,energy_aj", comments="")


def main() -> None:
    """Make every curve that is missing."""
    import jax  # noqa: PLC0415

    argparse.ArgumentParser(description=__doc__).parse_args()
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003
    for viscosity in VISCOSITIES:
        for ratio in RATIOS:
            curve_of_contact(viscosity, ratio, "force")


if __name__ == "__main__":
    main()
