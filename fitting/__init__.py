"""Reading the impact law off measured vibration amplitudes.

Names are imported when they are first used: `import fitting` is cheap and does not start JAX.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fitting.calibration import calibrate
    from fitting.calibration_result import Calibration
    from fitting.contact_delay import ContactDelay, fit_delay
    from fitting.contact_law import ContactLaw, fit_law
    from fitting.law_fit import fit
    from fitting.resonance_sweep import ResonanceSweep, read_sweep
    from fitting.result import FitResult
    from fitting.table import AmplitudeTable, TableError, read_table, write_table
else:
    from afm_jax.lazy_names import import_name

    _HOMES = {
        "AmplitudeTable": "fitting.table",
        "Calibration": "fitting.calibration_result",
        "ContactDelay": "fitting.contact_delay",
        "ContactLaw": "fitting.contact_law",
        "FitResult": "fitting.result",
        "ResonanceSweep": "fitting.resonance_sweep",
        "TableError": "fitting.table",
        "calibrate": "fitting.calibration",
        "fit": "fitting.law_fit",
        "fit_delay": "fitting.contact_delay",
        "fit_law": "fitting.contact_law",
        "read_sweep": "fitting.resonance_sweep",
        "read_table": "fitting.table",
        "write_table": "fitting.table",
    }

    def __getattr__(name):
        return import_name(__name__, _HOMES, name)

    def __dir__():
        return sorted({*globals(), *__all__})


__all__ = [
    "AmplitudeTable",
    "Calibration",
    "ContactDelay",
    "ContactLaw",
    "FitResult",
    "ResonanceSweep",
    "TableError",
    "calibrate",
    "fit",
    "fit_delay",
    "fit_law",
    "read_sweep",
    "read_table",
    "write_table",
]
