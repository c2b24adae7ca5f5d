"""A designed experiment: which points to measure next, and how well the parameters will then be known."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from afm_jax.results import Result, public_result
from afm_jax.strict_json import plain
from afm_jax.units import TWO_SIDED_95
from fitting.experiments.candidates import LEFT_OUT, Candidates
from fitting.experiments.prior import Prior
from fitting.parameters import Parameter
from fitting.simulated.experiment import Drives

FORMAT_VERSION = 1
"""Version of the JSON layout; raised when a key changes its meaning or goes."""


@dataclass(frozen=True)
class Forecast:
    """How well a parameter is known at some point of the experiment.

    Attributes:
        value: as prior.
        unit: of value and error; empty for a number.
        standard_error: from the Fisher information, everything else unknown too; None: not determined.
        interval95: value -+ 1.96 standard errors, within what the parameter can be; ends are None if not determined.
        reason: why there is no error; None if there is one.
    """

    value: float
    unit: str
    standard_error: float | None
    interval95: tuple[float | None, float | None]
    reason: str | None


@public_result(picture="fitting.experiments.report:design_figure", rows="points")
@dataclass(frozen=True, eq=False)
class Design(Result):
    """The drives to measure next and the errors to expect: what `design` returns, named like the keys of its JSON.

    Attributes:
        prior: what the design rests on.
        interest: names of the parameters that are to be known well.
        criterion: "D" or "A".
        noise: standard error of an amplitude relative to it.
        candidates: every drive that was looked at.
        chosen: numbers of the points among the candidates, the most useful first.
        errors: standard error of every parameter so far and after each point, as a fit will state it, shape
            (points + 1, p); infinite where not determined.
        gain: what one more measurement at each candidate would add to the criterion after the chosen ones (D: to the
            log of the determinant; A: share by which the sum of variances falls), shape (rows,); NaN where left out.
        valid: there is something to measure, and it determines the parameters of interest.
        reasons: what makes the design invalid.
        warnings: what a reader should know besides.
        settings: every option.
        versions: of the packages that computed it.
    """

    prior: Prior
    interest: tuple[str, ...]
    criterion: str
    noise: float
    candidates: Candidates
    chosen: Int[np.ndarray, " points"]
    errors: Float[np.ndarray, "steps p"]
    gain: Float[np.ndarray, " rows"]
    valid: bool
    reasons: list[str]
    warnings: list[str]
    settings: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def drives(self) -> Drives:
        """What to drive, the most useful first; `fitting.simulate_experiment` takes them."""
        return Drives(*(column[self.chosen] for column in self.candidates.drives))

    @property
    def measured_so_far(self) -> dict[str, Forecast]:
        """How well every parameter is known now."""
        return self._forecasts(self.errors[0])

    @property
    def expected(self) -> dict[str, Forecast]:
        """How well every parameter will be known once the points are measured."""
        return self._forecasts(self.errors[-1])

    @property
    def tapping(self) -> bool:
        """Whether the cantilever is driven itself, not the sample."""
        return self.prior.problem.tapping

    def points(self) -> list[dict[str, Any]]:
        """Return the points as mappings: the drive, what is expected to be read, and the errors once it is."""
        names = self.prior.problem.names
        return [
            self.candidate(int(row)) | {"standard_errors": {n: _finite(e) for n, e in zip(names, errors, strict=True)}}
            for row, errors in zip(self.chosen, self.errors[1:].tolist(), strict=True)
        ]

    def candidate(self, row: int) -> dict[str, Any]:
        """Return a candidate as a mapping: the drive and what is expected to be read."""
        drives, found = self.candidates.drives, self.candidates
        answer = {
            "order": int(drives.order[row]),
            "drive_frequency_khz": float(drives.frequency_khz[row]),
            f"{'free' if self.tapping else 'drive'}_amplitude_nm": float(drives.amplitude_nm[row]),
            "offset_nm": float(drives.offset_nm[row]),
        }
        readings = ("peak_amplitude", "nm"), ("lockin_amplitude", "nm"), ("phase_lag", "deg")
        for (name, unit), value, error in zip(readings, found.amplitude_nm[row], found.error_nm[row], strict=False):
            if np.isfinite(error):
                answer[f"expected_{name}_{unit}"] = float(value) % 360.0 if unit == "deg" else float(value)
                answer[f"expected_{name}_error_{unit}"] = float(error)
        answer["expected_approach_speed_nm_per_us"] = float(found.approach_speed_nm_per_us[row])
        return answer

    def all_candidates(self) -> list[dict[str, Any]]:
        """Return every drive that was looked at, with why it is left out, or the gain of one more point there."""
        found, place = self.candidates, {row: i + 1 for i, row in enumerate(self.chosen.tolist())}
        answer = []
        for row, why_not in enumerate(found.why_not):
            record = self.candidate(row)
            if not found.amplitude_nm[row, 1] > 0.0:
                record = {name: value for name, value in record.items() if not name.startswith("expected")}
            gain = _finite(float(self.gain[row]))
            answer.append(record | {"chosen": place.get(row), "gain": gain, "left_out": LEFT_OUT.get(why_not)})
        return answer

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain lists, numbers and strings; what is not known is None."""
        prior = self.prior
        return {
            "format": "afm-jax design",
            "format_version": FORMAT_VERSION,
            "drive": prior.problem.drive,
            "model": prior.problem.model,
            "valid": self.valid,
            "reasons": self.reasons,
            "warnings": self.warnings,
            "interest": list(self.interest),
            "criterion": self.criterion,
            "noise": self.noise,
            "points": self.points(),
            "expected": {name: plain(asdict(forecast)) for name, forecast in self.expected.items()},
            "measured_so_far": {name: plain(asdict(forecast)) for name, forecast in self.measured_so_far.items()},
            "candidates": int(self.candidates.usable.sum()),
            "left_out": self.candidates.left_out,
            "prior": {
                "source": prior.source,
                "values": dict(zip(prior.problem.names, prior.values.tolist(), strict=True)),
                "fixed": prior.fixed,
                "free_frequency_khz": prior.free_frequency_khz,
                "quality_factor": prior.quality_factor,
                "mass_ng": prior.mass_ng,
                "rows_measured": len(prior.measured),
            },
            "settings": self.settings,
            "versions": self.versions,
        }

    def _forecasts(self, errors: Float[np.ndarray, " p"]) -> dict[str, Forecast]:
        columns = zip(self.prior.problem.parameters, self.prior.values.tolist(), errors.tolist(), strict=True)
        return {parameter.name: _forecast(parameter, value, error) for parameter, value, error in columns}


def _forecast(parameter: Parameter, value: float, error: float) -> Forecast:
    if not np.isfinite(error):
        return Forecast(value, parameter.unit, None, (None, None), "the measurements do not determine it")
    half = TWO_SIDED_95 * error
    interval = max(value - half, parameter.lowest), min(value + half, parameter.highest)
    return Forecast(value, parameter.unit, error, interval, None)


def _finite(number: float) -> float | None:
    return number if np.isfinite(number) else None
