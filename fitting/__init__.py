"""Reading the impact law off measured vibration amplitudes.

Names are imported when they are first used: `import fitting` is cheap and does not start JAX.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afm_jax.contact.law_of_contact import ContactDelay, ContactLaw, fit_delay, fit_law
    from afm_jax.saved import load
    from fitting.bulk import fit_each
    from fitting.calibration.calibrate import calibrate
    from fitting.calibration.result import Calibration
    from fitting.calibration.stiffness import Stiffness, equipartition, sader, sensitivity
    from fitting.calibration.sweep import ResonanceSweep, read_sweep
    from fitting.experiments.belief import Belief, believe
    from fitting.experiments.candidates import drive_grid
    from fitting.experiments.design import design
    from fitting.experiments.result import Design
    from fitting.fits.comparison import Comparison, compare
    from fitting.fits.fit import fit
    from fitting.fits.result import FitResult
    from fitting.forward import AmplitudeGradients, amplitude_gradients
    from fitting.instruments.curve import MeasuredCurve, read_curve, read_curves
    from fitting.inversion.invert import invert
    from fitting.inversion.result import Inversion
    from fitting.sampling.bootstrap import Bootstrap, bootstrap
    from fitting.sampling.inference_data import write_inference_data
    from fitting.sampling.posterior import posterior
    from fitting.sampling.posterior_result import Posterior
    from fitting.sampling.trust_pack import TrustPack, trust
    from fitting.simulated.experiment import SimulatedExperiment, simulate_experiment
    from fitting.tables.csv_text import TableError
    from fitting.tables.table import AmplitudeTable, read_table, write_table
    from fitting.tapping_curves.maps import TappingMap, tapping_map
    from fitting.tapping_curves.result import Tapping
    from fitting.tapping_curves.tapping import tapping
    from fitting.tapping_curves.together import TappingTogether, tapping_together
    from fitting.traces.lockin import LockinResult, lockin
    from fitting.traces.trace import Trace, read_trace
else:
    from afm_jax.lazy_names import import_name

    _HOMES = {
        "AmplitudeGradients": "fitting.forward",
        "AmplitudeTable": "fitting.tables.table",
        "Belief": "fitting.experiments.belief",
        "Bootstrap": "fitting.sampling.bootstrap",
        "Calibration": "fitting.calibration.result",
        "Comparison": "fitting.fits.comparison",
        "ContactDelay": "afm_jax.contact.law_of_contact",
        "ContactLaw": "afm_jax.contact.law_of_contact",
        "Design": "fitting.experiments.result",
        "FitResult": "fitting.fits.result",
        "LockinResult": "fitting.traces.lockin",
        "MeasuredCurve": "fitting.instruments.curve",
        "Posterior": "fitting.sampling.posterior_result",
        "ResonanceSweep": "fitting.calibration.sweep",
        "Inversion": "fitting.inversion.result",
        "SimulatedExperiment": "fitting.simulated.experiment",
        "Stiffness": "fitting.calibration.stiffness",
        "TableError": "fitting.tables.csv_text",
        "Tapping": "fitting.tapping_curves.result",
        "TappingMap": "fitting.tapping_curves.maps",
        "Trace": "fitting.traces.trace",
        "TrustPack": "fitting.sampling.trust_pack",
        "amplitude_gradients": "fitting.forward",
        "believe": "fitting.experiments.belief",
        "bootstrap": "fitting.sampling.bootstrap",
        "calibrate": "fitting.calibration.calibrate",
        "compare": "fitting.fits.comparison",
        "design": "fitting.experiments.design",
        "drive_grid": "fitting.experiments.candidates",
        "equipartition": "fitting.calibration.stiffness",
        "fit": "fitting.fits.fit",
        "fit_each": "fitting.bulk",
        "fit_delay": "afm_jax.contact.law_of_contact",
        "fit_law": "afm_jax.contact.law_of_contact",
        "load": "afm_jax.saved",
        "lockin": "fitting.traces.lockin",
        "invert": "fitting.inversion.invert",
        "posterior": "fitting.sampling.posterior",
        "read_curve": "fitting.instruments.curve",
        "read_curves": "fitting.instruments.curve",
        "read_sweep": "fitting.calibration.sweep",
        "read_table": "fitting.tables.table",
        "read_trace": "fitting.traces.trace",
        "sader": "fitting.calibration.stiffness",
        "sensitivity": "fitting.calibration.stiffness",
        "simulate_experiment": "fitting.simulated.experiment",
        "tapping": "fitting.tapping_curves.tapping",
        "tapping_map": "fitting.tapping_curves.maps",
        "TappingTogether": "fitting.tapping_curves.together",
        "tapping_together": "fitting.tapping_curves.together",
        "trust": "fitting.sampling.trust_pack",
        "write_inference_data": "fitting.sampling.inference_data",
        "write_table": "fitting.tables.table",
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
    "MeasuredCurve",
    "Posterior",
    "ResonanceSweep",
    "SimulatedExperiment",
    "Stiffness",
    "TableError",
    "Tapping",
    "TappingMap",
    "TappingTogether",
    "Trace",
    "TrustPack",
    "amplitude_gradients",
    "believe",
    "bootstrap",
    "calibrate",
    "compare",
    "design",
    "drive_grid",
    "equipartition",
    "fit",
    "fit_delay",
    "fit_each",
    "fit_law",
    "invert",
    "load",
    "lockin",
    "posterior",
    "read_curve",
    "read_curves",
    "read_sweep",
    "read_table",
    "read_trace",
    "sader",
    "sensitivity",
    "simulate_experiment",
    "tapping",
    "tapping_map",
    "tapping_together",
    "trust",
    "write_inference_data",
    "write_table",
]
