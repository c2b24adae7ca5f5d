"""What `tapping` found, row by row, as one energy, as thresholds and as a law, with everything that went into it."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Int

from afm_jax.results import Result, public_result
from afm_jax.strict_json import plain
from afm_jax.units import RAD_PER_US_PER_KHZ
from fitting.tables.table import AmplitudeTable
from fitting.tapping_curves.branches import Hysteresis
from fitting.tapping_curves.constant_energy import ConstantEnergy
from fitting.tapping_curves.curve import Rows, TappingCurve

if TYPE_CHECKING:
    from fitting.fits.result import FitResult

_BADLY = 1e-3
"""Probability of chi2 below which noise does not explain the rows."""
_WORST = 10.0
"""chi2 per degree of freedom from which one energy is no description."""
_BRACKET = 0.5
"""Relative standard error from which a number is only a bracket."""
_ORIGINS = {
    "noise": "noise",
    "free_frequency_khz": "free frequency",
    "quality_factor": "Q",
    "spring_constant_n_per_m": "spring constant",
    "tip_calibration": "calibration",
    "phase_zero_deg": "zero of phase",
    "free_amplitude": "free amplitude",
    "harmonics_factor": "harmonics",
    "harmonics": "harmonics",
}


def origin_in_words(name: str) -> str:
    """Return what an error comes from."""
    return _ORIGINS.get(name, name)


@dataclass(frozen=True)
class EnergyGroup:
    """Rows that share an energy: of one drive and one branch."""

    drive_frequency_khz: float
    free_amplitude_nm: float
    repulsive: bool

    @property
    def name(self) -> str:
        """What it is called."""
        branch = "repulsive" if self.repulsive else "attractive"
        return f"{branch}, {self.drive_frequency_khz:g} kHz, free amplitude {self.free_amplitude_nm:.4g} nm"


@dataclass(frozen=True, kw_only=True)
class TapRows:
    """A curve's rows, as they come in the table; NaN where something is not known.

    Attributes:
        state: "free", "attractive", "repulsive", "held", or "touching" where there is no phase.
        lag_departure_deg: lag less that of the free tip.
        energy_aj: of a tap, with the instrument as given.
        energy_noise_aj: its standard error from the row's own noise.
        energy_errors_aj: by how much it moves with one standard error of what all rows share, by name.
        energy_of_fit_aj: with the instrument as fitted.
        virial_aj: mean of force times height, of the first harmonic; negative: repulsive on the whole.
        largest_energy_aj: the most that a tap can take at this amplitude, whatever the phase.
        used: whether it is in the fit of one energy.
        note: why not; or what it is for.
    """

    state: tuple[str, ...]
    lag_departure_deg: Rows
    energy_aj: Rows
    energy_noise_aj: Rows
    energy_errors_aj: dict[str, Rows]
    energy_of_fit_aj: Rows
    virial_aj: Rows
    largest_energy_aj: Rows
    used: Bool[np.ndarray, " rows"]
    note: tuple[str, ...]

    @property
    def free(self) -> Bool[np.ndarray, " rows"]:
        """Rows of the free tip."""
        return np.array([state == "free" for state in self.state])

    @property
    def energy_systematic_aj(self) -> Rows:
        """Standard error of each energy from what all rows share."""
        return np.sqrt(np.sum(np.square(list(self.energy_errors_aj.values())), axis=0))


@dataclass(frozen=True, kw_only=True)
class MeasuredSpeeds:
    """Speeds of the impacts; NaN where they are not known to a quarter.

    Attributes:
        approach_speed_nm_per_us: u_in.
        approach_speed_error_nm_per_us: from noise, calibration and the origin of the heights.
        rebound_speed_nm_per_us: u_out.
        contact_us: time of contact.
        pull: speed that lever and drive give the tip in that time, over u_in.
        in_capture_speeds: u_in in units of sqrt(2 E/m).
        fast: rows whose impact a law describes.
        why_not: why there are too few of them for a law, and what to record instead.
    """

    approach_speed_nm_per_us: Rows
    approach_speed_error_nm_per_us: Rows
    rebound_speed_nm_per_us: Rows
    contact_us: Rows
    pull: Rows
    in_capture_speeds: Rows
    fast: Bool[np.ndarray, " rows"]
    why_not: str


@public_result(picture="fitting.tapping_curves.pictures:curve_figure")
@dataclass(frozen=True, kw_only=True)
class Tapping(Result):
    """The outcome of `tapping`.

    Attributes:
        table: what was read.
        curve: its rows with an amplitude, and what is known of the instrument.
        rows: point by point.
        groups: the rows that share an energy.
        fit: one energy for each group, the instrument free within its errors; None without a phase or rows.
        bound_aj: what a tap takes at most, where only the amplitude was recorded; else None.
        hysteresis: thresholds on the way in and back.
        speeds: of the impacts; None where there is no energy.
        law: the fit of the impact law, or None.
        versions: of the packages that computed it.
    """

    table: AmplitudeTable
    curve: TappingCurve
    rows: TapRows
    groups: tuple[EnergyGroup, ...]
    fit: ConstantEnergy | None
    bound_aj: float | None
    hysteresis: tuple[Hysteresis, ...]
    speeds: MeasuredSpeeds | None
    law: "FitResult | None" = None
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def mass_ng(self) -> float:
        """Effective mass, from spring constant and free frequency."""
        omega = RAD_PER_US_PER_KHZ * self.curve.free_frequency_khz.value
        return self.curve.spring_constant_n_per_m.value / omega**2

    @property
    def group_of_rows(self) -> Int[np.ndarray, " rows"]:
        """Of every row the number of the group with its drive and branch, -1 where there is none."""
        found = np.full(self.curve.rows, -1)
        for i, group in enumerate(self.groups):
            here = (self.curve.drive_frequency_khz == group.drive_frequency_khz) & (
                self.curve.free_amplitude_nm == group.free_amplitude_nm
            )
            branch = "repulsive" if group.repulsive else "attractive"
            found[here & (np.array(self.rows.state) == branch)] = i
        return found

    @property
    def chief(self) -> list[int]:
        """Numbers of the groups that the energy of a tap is taken from: the repulsive ones, if there are any."""
        repulsive = [i for i, group in enumerate(self.groups) if group.repulsive]
        return repulsive or list(range(len(self.groups)))

    @property
    def stretch(self) -> float:
        """What errors are multiplied by because the rows scatter more than their noise."""
        if self.fit is None or not self.fit.degrees_of_freedom or not self.fit.p_value < _BADLY:
            return 1.0
        return float(np.sqrt(self.fit.chi2 / self.fit.degrees_of_freedom))

    @property
    def energy(self) -> dict[str, Any]:
        """The energy of a tap: `value`, `standard_error`, `interval95` in aJ, `kind`, and where they come from."""
        if self.fit is None:
            bound = None if self.bound_aj is None else (0.0, self.bound_aj)
            kind = "none" if bound is None else "upper bound"
            return {"value": None, "standard_error": None, "interval95": bound, "kind": kind}
        if not self.described:
            return {"value": None, "standard_error": None, "interval95": self._bracket(), "kind": "bracket"}
        chosen = self.chief
        covariance = self.fit.covariance[np.ix_(chosen, chosen)]
        weights = np.linalg.pinv(covariance).sum(axis=0)
        weights = weights / weights.sum() if len(chosen) > 1 else np.ones(1)
        value = float(weights @ self.fit.energy_aj[chosen])
        error = float(np.sqrt(weights @ covariance @ weights)) * self.stretch
        interval = self.fit.interval95_aj[chosen[0]] if len(chosen) == 1 else value + 1.96 * np.array([-error, error])
        if len(chosen) == 1:
            interval = value + self.stretch * (interval - value)
        interval = np.maximum(interval, 0.0) if value > 0.0 else interval
        budget = {name: float(weights**2 @ part[chosen]) for name, part in self.fit.budget.items()}
        total = sum(budget.values()) or 1.0
        return {
            "value": value,
            "standard_error": error,
            "interval95": interval,
            "kind": "bracket" if not error < _BRACKET * value else "fit",
            "share_of_variance": {name: part / total for name, part in budget.items()},
        }

    @property
    def described(self) -> bool:
        """Whether one energy a branch describes the rows, however badly."""
        return self.fit is not None and not self.fit.chi2 > _WORST * max(self.fit.degrees_of_freedom, 1)

    def _bracket(self) -> tuple[float, float]:
        """Return what the energies of single rows, with all their errors, and the bound of each leave open, in aJ."""
        rows = self.rows
        used = rows.used & np.isfinite(rows.energy_aj)
        error = 1.96 * np.hypot(rows.energy_noise_aj, rows.energy_systematic_aj)[used]
        low = np.maximum(rows.energy_aj[used] - error, 0.0)
        return float(low.min()), float(np.minimum(rows.energy_aj[used] + error, rows.largest_energy_aj[used]).max())

    @property
    def plain_energy(self) -> dict[str, Any]:
        """Mean and scatter of the energies row by row, of the rows used, the instrument as given, in aJ."""
        chosen = self.rows.used & np.isin(self.group_of_rows, self.chief)
        if not chosen.any():
            return {"mean": None, "standard_deviation": None, "systematic_error": None}
        values = self.rows.energy_aj[chosen]
        return {
            "mean": float(values.mean()),
            "standard_deviation": float(values.std(ddof=1)) if chosen.sum() > 1 else None,
            "systematic_error": float(self.rows.energy_systematic_aj[chosen].mean()),
        }

    @property
    def epsilon(self) -> dict[str, Any]:
        """2 E/m in nm^2/us^2: what a tap takes, as the impact law counts it."""
        energy, factor = self.energy, 2.0 / self.mass_ng
        scaled = {name: None if energy[name] is None else energy[name] * factor for name in ("value", "standard_error")}
        return scaled | {
            "interval95": None if energy["interval95"] is None else [end * factor for end in energy["interval95"]]
        }

    @property
    def law_allowed(self) -> bool:
        """Whether enough rows have impacts that a law describes."""
        return self.speeds is not None and not self.speeds.why_not

    @property
    def reason(self) -> str | None:
        """Why there is no law, and what to record instead; None where there is one."""
        if self.law is not None:
            return None if self.law.valid else f"the fit of the law is not valid: {self.law.reasons[0]}"
        if not self.curve.has_phase:
            return "no phase was recorded; record it with the amplitude, and drive 3 to 10 % above resonance"
        if self.speeds is None:
            return "no branch has enough rows for an energy; record more heights in contact"
        return self.speeds.why_not or "not fitted"

    @property
    def reasons(self) -> list[str]:
        """What makes the energy no measurement."""
        if self.fit is None:
            if self.bound_aj is not None:
                return ["without a phase the curve gives no more than an upper bound of the energy of a tap"]
            return ["no branch has enough rows in contact for an energy of a tap"]
        found, energy = [], self.energy
        if not self.described:
            low, high = energy["interval95"]
            found.append(
                f"one energy a branch does not describe the rows (chi2 {self.fit.chi2:.0f} for "
                f"{self.fit.degrees_of_freedom} degrees of freedom): only a bracket, {low:.2g} to {high:.2g} aJ"
            )
        elif not energy["value"] > 0.0:
            found.append("the energy of a tap is not positive: frequency, Q or the zero of the phase is wrong")
        elif energy["kind"] == "bracket":
            chief = max(energy["share_of_variance"], key=lambda name: energy["share_of_variance"][name])
            low, high = energy["interval95"]
            found.append(
                f"the energy of a tap is only bracketed, {low:.2g} to {high:.2g} aJ; most of that is "
                f"{origin_in_words(chief)}"
            )
        return found

    @property
    def valid(self) -> bool:
        """Whether the energy of a tap is determined."""
        return not self.reasons

    @property
    def warnings(self) -> list[str]:
        """What a reader should know besides."""
        found = []
        if self.fit is not None and self.described:
            if self.stretch > 1.0:
                found.append(
                    f"the rows scatter {self.stretch:.2g} times more than their noise: errors are multiplied by that"
                )
            found += [
                f"{origin_in_words(n.key)} ends {pull:+.1f} standard errors from what was given "
                f"({n.given} to {n.value:.6g})"
                for n in self.fit.nuisances
                if abs(pull := (n.value - n.given.value) / n.given.error) > 2.0
            ]
            if not self.fit.free.any() and self.curve.phase_zero_deg is None:
                found.append(
                    "no row of the free tip fixes the zero of the phase: it is fitted, and the energy hangs on it"
                )
        aside = self.set_aside
        if aside:
            found.append(f"{len(aside)} of {self.curve.rows} rows are set aside, each by name in the rows")
        return found

    @property
    def assumptions(self) -> list[str]:
        """What the numbers take for granted."""
        curve = self.curve
        found = [
            (
                f"free frequency {curve.free_frequency_khz} kHz, Q {curve.quality_factor}, "
                f"spring constant {curve.spring_constant_n_per_m} N/m, calibration {curve.tip_calibration}"
            ),
            "the drive stays as it is along the curve, and each tap of a branch takes the same energy",
        ]
        if curve.has_phase:
            free = self.fit is not None and bool(self.fit.free.any())
            zero = (
                "the zero of the phase from the free rows"
                if free
                else f"zero of phase {curve.phase_zero_deg or 'fitted'}"
            )
            found.append(f"lag behind {'the base' if curve.drive == 'base' else 'the force on the tip'}, {zero}")
        if not curve.harmonic_amplitudes_nm:
            found.append("harmonics were not measured: those of one brief impact a period, to 10 %")
        exact = [
            name
            for name, given in (
                ("the free frequency", curve.free_frequency_khz),
                ("Q", curve.quality_factor),
                ("the spring constant", curve.spring_constant_n_per_m),
                ("the calibration", curve.tip_calibration),
            )
            if not given.error
        ]
        if exact:
            found.append(f"taken as exact, for want of an error: {', '.join(exact)}")
        return found

    @property
    def set_aside(self) -> list[dict[str, Any]]:
        """The rows that touch the sample and are not in the fit of one energy: line, height and why."""
        return [
            {"line": int(self.curve.lines[i]), "offset_nm": float(self.curve.offset_nm[i]), "reason": note}
            for i, note in enumerate(self.rows.note)
            if note.startswith("set aside")
        ]

    def records(self) -> list[dict[str, Any]]:
        """Return a mapping per row; what is not known is None."""
        curve, rows = self.curve, self.rows
        columns: dict[str, Any] = {
            "line": curve.lines,
            "drive_frequency_khz": curve.drive_frequency_khz,
            "free_amplitude_nm": curve.free_amplitude_nm,
            "branch": ["retract" if back else "approach" for back in curve.retract],
            "state": rows.state,
            "offset_nm": curve.offset_nm,
            "lockin_amplitude_nm": curve.amplitude_nm,
            "phase_lag_deg": curve.lag_deg,
            "lag_departure_deg": rows.lag_departure_deg,
            "energy_aj": rows.energy_aj,
            "energy_noise_aj": rows.energy_noise_aj,
            "energy_systematic_aj": rows.energy_systematic_aj,
        }
        columns |= {f"energy_error_of_{name}_aj": part for name, part in rows.energy_errors_aj.items()}
        columns |= {
            "energy_of_fit_aj": rows.energy_of_fit_aj,
            "residual": np.full(curve.rows, np.nan) if self.fit is None else self.fit.residual,
            "virial_aj": rows.virial_aj,
            "largest_energy_aj": rows.largest_energy_aj,
        }
        if self.speeds is not None:
            columns |= {name: part for name, part in vars(self.speeds).items() if isinstance(part, np.ndarray)}
        columns |= {"used": rows.used, "note": rows.note}
        flat = {name: plain(column) for name, column in columns.items()}
        return [{name: column[i] for name, column in flat.items()} for i in range(curve.rows)]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain lists, numbers and strings; what is not known is None."""
        fit = self.fit
        groups = (
            []
            if fit is None
            else [
                {
                    **vars(group),
                    "energy_aj": fit.energy_aj[i],
                    "standard_error_aj": fit.standard_error_aj[i] * self.stretch,
                    "interval95_aj": fit.interval95_aj[i],
                    "rows": int(np.sum(fit.used & (self.group_of_rows == i))),
                }
                for i, group in enumerate(self.groups)
            ]
        )
        return plain(
            {
                "valid": self.valid,
                "reasons": self.reasons,
                "warnings": self.warnings,
                "energy_per_tap_aj": self.energy,
                "plain_energy_aj": self.plain_energy,
                "epsilon_nm2_per_us2": self.epsilon,
                "assumptions": self.assumptions,
                "branches": groups,
                "chi2": None if fit is None else fit.chi2,
                "degrees_of_freedom": None if fit is None else fit.degrees_of_freedom,
                "p_value": None if fit is None else fit.p_value,
                "nuisances": {}
                if fit is None
                else {
                    n.name: {
                        "given": n.given.value,
                        "given_error": n.given.error,
                        "value": n.value,
                        "standard_error": n.standard_error,
                    }
                    for n in fit.nuisances
                },
                "hysteresis": [
                    {
                        **vars(one),
                        "approach": _height(one.approach),
                        "retract": _height(one.retract),
                        "width_nm": one.width_nm,
                    }
                    for one in self.hysteresis
                ],
                "law": None if self.law is None else self.law.to_dict()["law"],
                "reason": self.reason,
                "fit": None if self.law is None else self.law.to_dict(),
                "rows": self.records(),
                "set_aside": self.set_aside,
                "input": {name: value for name, value in vars(self.table).items() if value is not None},
                "versions": self.versions,
            }
        )


def _height(found: Any) -> dict[str, float] | None:
    return None if found is None else found._asdict()
