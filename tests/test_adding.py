"""What a step of `notebooks/adding_a_force.md` leaves to another file is looked for there."""

from fitting.infer.unknowns import _MOVES
from fitting.parameters import DRIFT_NAMES, NUISANCE_NAMES
from fitting.tables.table import CALIBRATION, SETTINGS


def test_a_quantity_of_the_instrument_is_in_every_list_of_them():
    for names, known, where in (
        (CALIBRATION, NUISANCE_NAMES, "NUISANCES of fitting/parameters.py"),
        (set(NUISANCE_NAMES), _MOVES, "_MOVES of fitting/infer/unknowns.py"),
        (set(NUISANCE_NAMES) - set(DRIFT_NAMES), SETTINGS, "SETTINGS of fitting/tables/table.py"),
    ):
        lacking = [name for name in names if name not in known]
        assert lacking == [], f"{where} lacks {lacking}: see notebooks/adding_a_force.md"
