"""Reading the impact law off measured vibration amplitudes.

Names are imported when they are first used: `import fitting` is cheap and does not start JAX.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afm_jax.contact.law_of_contact import ContactDelay, ContactLaw, fit_delay, fit_law
    from fitting.calibration import calibrate
    from fitting.comparison import Comparison, compare
    from fitting.experiment import design
    from fitting.gradients import AmplitudeGradients, amplitude_gradients
    from fitting.inverse.inversion_result import Inversion
    from fitting.inversion import invert
    from fitting.law_fit import fit
    from fitting.planning.experiment_belief import Belief, believe
    from fitting.planning.experiment_drives import drive_grid
    from fitting.planning.experiment_result import Design
    from fitting.resonance.calibration_result import Calibration
    from fitting.resonance.resonance_sweep import ResonanceSweep, read_sweep
    from fitting.result import FitResult
    from fitting.sampling.parametric_bootstrap import Bootstrap, bootstrap
    from fitting.sampling.posterior_of_fit import posterior
    from fitting.sampling.posterior_result import Posterior
    from fitting.simulated.simulated_experiment import SimulatedExperiment, simulate_experiment
    from fitting.table import AmplitudeTable, TableError, read_table, write_table
    from fitting.traces.lockin_analysis import lockin
    from fitting.traces.lockin_result import LockinResult
    from fitting.traces.lockin_trace import Trace, read_trace
else:
    from afm_jax.lazy_names import import_name

    _HOMES = {
        "AmplitudeGradients": "fitting.gradients",
        "AmplitudeTable": "fitting.table",
        "Belief": "fitting.planning.experiment_belief",
        "Bootstrap": "fitting.sampling.parametric_bootstrap",
        "Calibration": "fitting.resonance.calibration_result",
        "Comparison": "fitting.comparison",
        "ContactDelay": "afm_jax.contact.law_of_contact",
        "ContactLaw": "afm_jax.contact.law_of_contact",
        "Design": "fitting.planning.experiment_result",
        "FitResult": "fitting.result",
        "LockinResult": "fitting.traces.lockin_result",
        "Posterior": "fitting.sampling.posterior_result",
        "ResonanceSweep": "fitting.resonance.resonance_sweep",
        "Inversion": "fitting.inverse.inversion_result",
        "SimulatedExperiment": "fitting.simulated.simulated_experiment",
        "TableError": "fitting.table",
        "Trace": "fitting.traces.lockin_trace",
        "amplitude_gradients": "fitting.gradients",
        "believe": "fitting.planning.experiment_belief",
        "bootstrap": "fitting.sampling.parametric_bootstrap",
        "calibrate": "fitting.calibration",
        "compare": "fitting.comparison",
        "design": "fitting.experiment",
        "drive_grid": "fitting.planning.experiment_drives",
        "fit": "fitting.law_fit",
        "fit_delay": "afm_jax.contact.law_of_contact",
        "fit_law": "afm_jax.contact.law_of_contact",
        "lockin": "fitting.traces.lockin_analysis",
        "invert": "fitting.inversion",
        "posterior": "fitting.sampling.posterior_of_fit",
        "read_sweep": "fitting.resonance.resonance_sweep",
        "read_table": "fitting.table",
        "read_trace": "fitting.traces.lockin_trace",
        "simulate_experiment": "fitting.simulated.simulated_experiment",
        "write_table": "fitting.table",
    }

    def __getattr__(name):
        return import_name(__name__, _HOMES, name)

    def __dir__():
        return sorted({*globals(), *__all__})


__all__ = [
    "AmplitudeGradients",
    "AmplitudeTable",
    "Belief",
    "Bootstrap",
    "Calibration",
    "Comparison",
    "ContactDelay",
    "ContactLaw",
    "Design",
    "FitResult",
    "Inversion",
    "LockinResult",
    "Posterior",
    "ResonanceSweep",
    "SimulatedExperiment",
    "TableError",
    "Trace",
    "amplitude_gradients",
    "believe",
    "bootstrap",
    "calibrate",
    "compare",
    "design",
    "drive_grid",
    "fit",
    "fit_delay",
    "fit_law",
    "invert",
    "lockin",
    "posterior",
    "read_sweep",
    "read_table",
    "read_trace",
    "simulate_experiment",
    "write_table",
]
