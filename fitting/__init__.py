"""Reading the impact law off measured vibration amplitudes.

Names are imported when they are first used: `import fitting` is cheap and does not start JAX.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fitting.law_fit import fit
    from fitting.result import FitResult
    from fitting.table import AmplitudeTable, TableError, read_table, write_table
else:
    from afm_jax.lazy_names import import_name

    _HOMES = {
        "AmplitudeTable": "fitting.table",
        "FitResult": "fitting.result",
        "TableError": "fitting.table",
        "fit": "fitting.law_fit",
        "read_table": "fitting.table",
        "write_table": "fitting.table",
    }

    def __getattr__(name):
        return import_name(__name__, _HOMES, name)

    def __dir__():
        return sorted({*globals(), *__all__})


__all__ = ["AmplitudeTable", "FitResult", "TableError", "fit", "read_table", "write_table"]
