"""What `tapping` found, row by row, as one energy, as thresholds and as a law, with everything that went into it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from afm_jax.outcomes import judge
from afm_jax.results import JudgedResult, public_result
from afm_jax.saved import as_json
from afm_jax.strict_json import plain
from afm_jax.units import TWO_SIDED_95, effective_mass_ng
from fitting.parameters import USUAL_ERRORS
from fitting.tables.table import AmplitudeTable
from fitting.tapping_curves.along import (
    HEADLINE,
    MEASURED,
    EnergyFunctions,
    TappingBranch,
    differences_of_ways,
    largest_of,
    said_of,
)
from fitting.tapping_curves.branches import Hysteresis, way_of
from fitting.tapping_curves.curve import Mask, Rows, TappingCurve
from fitting.tapping_curves.lever import Nuisance
from fitting.tapping_curves.one_energy import OneEnergy
from fitting.tapping_curves.speeds import MeasuredSpeeds
from fitting.tapping_curves.verdict import (
    ASSUMPTIONS,
    NO_CONSTANT,
    NO_FUNCTIONS,
    REASONS,
    WARNINGS,
)

if TYPE_CHECKING:
    from fitting.infer.result import FitResult


@dataclass(frozen=True, kw_only=True)
class TapRows:
    """A curve's rows, as they come in the table; NaN where something is not known.

    Attributes:
        state: "free", "attractive", "repulsive", "held", or "touching" where there is no phase.
        energy_aj: of a tap, with the instrument where statements and free rows put it.
        energy_noise_aj: its standard error from the row's own noise.
        virial_aj: mean of force times height, of the first harmonic; positive where attraction prevails, negative where
            repulsion does.
        largest_energy_aj: the most that a tap can take at this amplitude, whatever the phase.
        used: whether it is in the fit of one energy.
        note: why not; or what it is for.
    """

    state: tuple[str, ...]
    energy_aj: Rows
    energy_noise_aj: Rows
    virial_aj: Rows
    largest_energy_aj: Rows
    used: Mask
    note: tuple[str, ...]

    @property
    def free(self) -> Mask:
        """Rows of the free tip."""
        return np.array([state == "free" for state in self.state])


@public_result(picture="fitting.tapping_curves.pictures:curve_figure", home="fitting.tapping_curves.report")
@dataclass(frozen=True, kw_only=True)
class Tapping(JudgedResult):
    """Energy and virial of a tap along the branches of a tapping curve, and the impact law: what `tapping` returns.

    Attributes:
        table: what was read.
        curve: the table's rows with an amplitude, and what is known of the instrument.
        rows: state, energy and virial of each row of the table.
        fit: one energy for each drive and side, fitted with the instrument; None without a phase or rows.
        functions: the energy as a smooth function along each branch, the instrument cut off from it.
        scale_errors: whether errors are multiplied where the rows scatter more.
        bound_aj: upper bound of the energy lost in a tap, where only the amplitude was recorded; else None.
        hysteresis: changes of the motion that come at different heights on approach and retract.
        speeds: speeds of the impacts; None where there is no energy.
        law: the fit of the impact law, or None.
        versions: of the packages that computed it.
    """

    table: AmplitudeTable
    curve: TappingCurve
    rows: TapRows
    fit: OneEnergy | None
    functions: EnergyFunctions
    scale_errors: bool
    bound_aj: float | None
    hysteresis: tuple[Hysteresis, ...]
    speeds: MeasuredSpeeds | None
    law: "FitResult | None" = None
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def branches(self) -> tuple[TappingBranch, ...]:
        """Each with its energy and virial over the amplitude."""
        return self.functions.branches

    @property
    def mass_ng(self) -> float:
        """Effective mass, from spring constant and free frequency."""
        return effective_mass_ng(self.curve.spring_constant_n_per_m.value, self.curve.free_frequency_khz.value)

    @property
    def why_not_constant(self) -> str:
        """Why one energy for each branch does not explain the rows; empty where it does."""
        return next(iter(judge([NO_CONSTANT], self)), "")

    @property
    def why_not_functions(self) -> str:
        """Why the energy along the branches is not determined; empty where it is."""
        return next(iter(judge([NO_FUNCTIONS], self)), "")

    @property
    def reasons(self) -> list[str]:
        """What makes the energy no measurement: where it is largest along the branches it is not measured."""
        return [self.in_unit(reason) for reason in judge(REASONS, self)]

    @property
    def warnings(self) -> list[str]:
        """What a reader should also know."""
        return judge(WARNINGS, self)

    @property
    def assumptions(self) -> list[str]:
        """What the numbers assume."""
        return judge(ASSUMPTIONS, self)

    @property
    def energy(self) -> dict[str, Any]:
        """The energy if every tap loses the same: `value`, `standard_error`, `interval95` in aJ, `kind`, `reason`.

        It makes no curve valid: along a sqrt(1 - a^2) with a = A/A0 the curve cannot test the assumption. Where one
        energy does not explain the rows `value` is None and `reason` says why.
        """
        blank: dict[str, Any] = {"value": None, "standard_error": None, "interval95": None, "kind": "none"}
        if self.fit is None and self.bound_aj is not None:
            return blank | {"interval95": (0.0, self.bound_aj), "kind": "upper bound", "reason": ""}
        if self.fit is None or self.why_not_constant:
            return blank | {"reason": self.why_not_constant}
        groups = [one for one in self.fit.groups if one.repulsive] or list(self.fit.groups)
        if len(groups) > 1:
            each = "; ".join(f"{one.name}: {one.energy_aj:.3g} aJ" for one in groups)
            return blank | {"reason": f"each drive has its own: {each}"}
        value, error = groups[0].energy_aj, groups[0].error_aj
        if not value > 0.0:
            return blank | {"reason": "the energy of a tap is not positive: frequency, Q or the phase's zero is wrong"}
        return {
            "value": value,
            "standard_error": error,
            "interval95": np.maximum(groups[0].interval95_aj, 0.0),
            "kind": "bracket" if not error < MEASURED * value else "fit",
            "reason": "",
            "free_frequency_pull": self.fit.nuisances[0].pull,
        }

    @property
    def largest(self) -> dict[str, Any] | None:
        """Energy of a tap where it is largest along the branches, the middle of its band, and what is said of it."""
        if not self.branches:
            return None
        branch, point = largest_of(self.branches)
        ratio = float(self.branches[branch].curve.amplitude_ratio[point])
        return self._energy_at(branch, ratio, "value", "standard_error", "interval95")

    def _energy_at(self, branch: int, ratio: float, *names: str) -> dict[str, Any]:
        """Return a branch's energy at an amplitude, its error, its band, by these names, and what the band says."""
        low, high = self.branches[branch].curve.at(ratio).tolist()
        found = 0.5 * (low + high), 0.5 * (high - low) / TWO_SIDED_95, (low, high)
        energy = dict(zip(names, found, strict=True))
        said = said_of(low, high)
        return {**energy, "said": said, "branch": branch, "amplitude_ratio": ratio}

    @property
    def energies_at(self) -> list[dict[str, Any]]:
        """Energy of a tap at some amplitudes of each branch that has them, in aJ."""
        return [
            self._energy_at(i, ratio, "energy_aj", "standard_error_aj", "interval95_aj")
            for i, branch in enumerate(self.branches)
            for ratio in HEADLINE
            if np.isfinite(branch.curve.at(ratio)).all()
        ]

    def in_unit(self, said: Any) -> Any:
        """Return a text about energies in aJ, or mappings of such, with the unit that they have: nm^2 without k.

        Keys `..._aj` of mappings become `..._over_k_nm2`. Where the sign of the phase is assumed, attractive and
        repulsive may be exchanged, and are marked by `?`.
        """
        over_k = self.curve.over_spring_constant
        if isinstance(said, dict) and over_k:
            return {re.sub("_aj$", "_over_k_nm2", str(key)): self.in_unit(value) for key, value in said.items()}
        if isinstance(said, list) and over_k:
            return [self.in_unit(value) for value in said]
        if not isinstance(said, str):
            return said
        if self.curve.phase.assumed:
            said = re.sub(r"\b(attractive|repulsive)\b(?!\?)", r"\1?", said)
        return re.sub(r"\baJ\b(?! over)", "nm^2", said) if over_k else said

    @property
    def epsilon(self) -> dict[str, Any]:
        """2 E/m in nm^2/us^2: the energy lost in a tap, in the units of the impact law."""
        names, factor = ("value", "standard_error", "interval95"), 2.0 / self.mass_ng
        return {name: None if self.energy[name] is None else factor * np.array(self.energy[name]) for name in names}

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
    def set_aside(self) -> list[dict[str, Any]]:
        """The rows that touch the sample and are in no energy: line, height and why."""
        return [
            {"line": int(self.curve.lines[i]), "offset_nm": float(self.curve.offset_nm[i]), "reason": note}
            for i, note in enumerate(self.rows.note)
            if note.startswith("excluded")
        ]

    def records(self) -> list[dict[str, Any]]:
        """Return a mapping per row; what is not known is None."""
        curve = self.curve
        columns: dict[str, Any] = {
            "line": curve.lines,
            "drive_frequency_khz": curve.drive_frequency_khz,
            "free_amplitude_nm": curve.free_amplitude_nm,
            "branch": [way_of(back) for back in curve.retract],
            "offset_nm": curve.offset_nm,
            "lockin_amplitude_nm": curve.amplitude_nm,
            "phase_lag_deg": curve.lag_deg,
            **vars(self.rows),
            "residual": np.full(curve.rows, np.nan) if self.fit is None else self.fit.residual,
        }
        if self.speeds is not None:
            columns |= {name: part for name, part in vars(self.speeds).items() if isinstance(part, np.ndarray)}
        flat = {name: plain(column) for name, column in columns.items()}
        return [{name: column[i] for name, column in flat.items()} for i in range(curve.rows)]

    def report(self, folder: str | Path, name: str = "", more: Sequence[Any] = ()) -> list[Path]:
        """Write this curve into a folder as every result, and the report of its law; return the paths."""
        law = [] if self.law is None else self.law.report(folder)
        return [*super().report(folder, name, more), *law]


@as_json.register
def _(taps: Tapping) -> dict[str, Any]:
    energy, law = taps.energy, None if taps.law is None else as_json(taps.law)
    payload = plain(
        {
            "format": "afm-jax tapping",
            "format_version": 1,
            "valid": taps.valid,
            "reasons": taps.reasons,
            "warnings": taps.warnings,
            "energy_per_tap_aj": None if energy["value"] is None and energy["interval95"] is None else energy,
            "energy_per_tap_reason": energy["reason"] or None,
            "largest_energy_aj": taps.largest,
            "energies_at": taps.energies_at,
            "way_differences": differences_of_ways(taps.functions),
            "epsilon_nm2_per_us2": taps.epsilon,
            "assumptions": taps.assumptions,
            "phase_sense": {**taps.curve.phase._asdict(), "assumed": taps.curve.phase.assumed},
            "assumed_errors": {name: USUAL_ERRORS[name] for name in taps.curve.assumed},
            "branches": [
                {
                    "drive_frequency_khz": branch.drive_frequency_khz,
                    "free_amplitude_nm": branch.free_amplitude_nm,
                    "branch": branch.way,
                    "repulsive": branch.repulsive,
                    "rows": len(branch.rows),
                    **_constant_of(taps, branch),
                    "curve": as_json(branch.curve),
                }
                for branch in taps.branches
            ],
            **_fits(taps),
            "hysteresis": [{**vars(one), "width_nm": one.width_nm} for one in taps.hysteresis],
            "law": None if law is None else law["law"],
            "reason": taps.reason,
            "fit": law,
            "rows": taps.records(),
            "set_aside": taps.set_aside,
            "versions": taps.versions,
            "input": {name: value for name, value in vars(taps.table).items() if value is not None},
        }
    )
    if not taps.curve.over_spring_constant:
        return payload
    why = "the spring constant is not known: energies are over it, in nm^2"
    return {**taps.in_unit(payload), "energy_per_tap_aj": None, "energy_per_tap_reason": why}


def _constant_of(taps: Tapping, branch: TappingBranch) -> dict[str, Any]:
    """Return whether one energy explains the rows of a branch, and which."""
    groups = () if taps.fit is None or taps.why_not_constant else taps.fit.groups
    one = next((one for one in groups if (one.drive, one.repulsive) == (branch.drive, branch.repulsive)), None)
    found = (None, None, None) if one is None else (one.energy_aj, one.error_aj, one.interval95_aj)
    names = ("energy_aj", "standard_error_aj", "interval95_aj")
    return {"constant": one is not None, **dict(zip(names, found, strict=True))}


def _fits(taps: Tapping) -> dict[str, Any]:
    """Return how well one energy and a smooth one describe the rows, and what they make of the instrument."""
    fit, functions = taps.fit, taps.functions
    smooth = {name: getattr(functions, name) for name in ("rows_chi2", "rows_freedom", "scale")}
    smooth |= {"valid": not taps.why_not_functions, "reason": taps.why_not_functions or None}
    smooth |= {"nuisances": nuisances_as_dict(functions.nuisances)}
    names = ("chi2", "degrees_of_freedom", "p_value")
    return {
        "functions": smooth if functions.branches else None,
        **{name: None if fit is None else getattr(fit.minimum, name) for name in names},
        "scale": None if fit is None else fit.scale,
        "nuisances_of_one_energy": nuisances_as_dict(fit.nuisances) if fit and not taps.why_not_constant else {},
    }


def nuisances_as_dict(nuisances: tuple[Nuisance, ...]) -> dict[str, Any]:
    """Return what is given and fitted of each, by name."""
    values = {n.name: (n.given.value, n.given.error, n.value, n.standard_error) for n in nuisances}
    names = ("given", "given_error", "value", "standard_error")
    return {name: dict(zip(names, numbers, strict=True)) for name, numbers in values.items()}
