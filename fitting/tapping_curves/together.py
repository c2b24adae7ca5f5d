"""Several tapping curves of one lever: what they have in common fitted to all, and how curves scatter beside errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.checks import checked
from afm_jax.least_squares import IMPROBABLE
from afm_jax.results import Result, public_result
from afm_jax.strict_json import plain
from fitting.tables.csv_text import TableError
from fitting.tables.table import TableLike, as_table
from fitting.tapping_curves.branches import CurveBranch
from fitting.tapping_curves.energy_curve import TappingBranch, branches_of, within
from fitting.tapping_curves.energy_fit import Common, fitted_together
from fitting.tapping_curves.result import Tapping, nuisances_as_dict
from fitting.tapping_curves.tapping import tapping

_SAME = 0.03
"""Relative difference of free amplitudes up to which branches of several curves are compared."""
_POINTS = 41


@dataclass(frozen=True, kw_only=True, eq=False)
class CurveScatter(CurveBranch):
    """A branch in several curves: mean energy, and its scatter from curve to curve beside what errors explain.

    Attributes:
        curves: number of curves that have it.
        amplitude_ratio: where at least half of them, and two, were measured.
        energy_aj: mean over the curves there.
        energy_scatter_aj: standard deviation from curve to curve.
        energy_own_error_aj: standard error of one curve but for what all have in common (root mean square).
        energy_common_error_aj: standard error that all have in common.
    """

    curves: int
    amplitude_ratio: Float[np.ndarray, " points"]
    energy_aj: Float[np.ndarray, " points"]
    energy_scatter_aj: Float[np.ndarray, " points"]
    energy_own_error_aj: Float[np.ndarray, " points"]
    energy_common_error_aj: Float[np.ndarray, " points"]

    def at(self, ratio: float) -> tuple[float, ...] | None:
        """Return mean, scatter, own and common error at an amplitude, of the free one; None where not measured."""
        columns = (self.energy_aj, self.energy_scatter_aj, self.energy_own_error_aj, self.energy_common_error_aj)
        return within(ratio, self.amplitude_ratio, *columns)


@public_result(picture="fitting.tapping_curves.pictures:together_figure")
@dataclass(frozen=True, kw_only=True)
class TappingTogether(Result):
    """Energies of a tap from several curves of one lever: what `tapping_together` returns.

    Attributes:
        curves: the result of each curve, with the nuisances fitted to all.
        common: the nuisances that all curves have in common; None where fewer than two have an energy.
        scatter: how the energies of each branch scatter from curve to curve.
    """

    curves: tuple[Tapping, ...]
    common: Common | None
    scatter: tuple[CurveScatter, ...]

    @property
    def reasons(self) -> list[str]:
        """What makes it no measurement."""
        found = [f"{one.table.source}: {one.reasons[0]}" for one in self.curves if not one.valid]
        if self.common is not None and self.common.p_value < IMPROBABLE:
            found.append(
                "the curves disagree on the instrument that they have in common (probability "
                f"{self.common.p_value:.1g}): is it one lever, and was its drive left alone between them?"
            )
        return found

    @property
    def valid(self) -> bool:
        """Whether every curve is, and they agree on what they have in common."""
        return not self.reasons

    def to_dict(self) -> dict[str, Any]:
        """Return what all curves say together as plain lists, numbers and strings; each curve's own is in `curves`."""
        first = next((one.functions for one in self.curves if one.functions is not None), None)
        names = () if self.common is None else self.common.names
        payload = plain(
            {
                "valid": self.valid,
                "reasons": self.reasons,
                "curves": [one.table.source for one in self.curves],
                "common_nuisances": {}
                if first is None
                else nuisances_as_dict(tuple(one for one in first.nuisances if one.name in names)),
                "agreement_p_value": None if self.common is None else self.common.p_value,
                "branches": [{**vars(one), "branch": one.way} for one in self.scatter],
            }
        )
        return self.curves[0].keyed(payload) if self.curves else payload


@checked
def tapping_together(tables: Sequence[TableLike], *, scale_errors: bool = False) -> TappingTogether:
    """Return the energies of several curves of one lever, frequency and Q fitted to all of them.

    Args:
        tables: of the curves, each as for `tapping`; the same is stated of the lever in all of them.
        scale_errors: as for `tapping`.

    Raises:
        TableError: if something else is stated of the lever in one of them, or as `tapping`.
    """
    return together([tapping(table, law=False, scale_errors=scale_errors) for table in map(as_table, tables)])


def together(curves: Sequence[Tapping]) -> TappingTogether:
    """Return curves that were analysed one by one with what they have in common fitted to all of them.

    Raises:
        TableError: if not the same is stated of their lever.
    """
    _same_lever(curves)
    common = None
    moved = list(curves)
    chosen = [i for i, one in enumerate(curves) if one.functions is not None]
    if len(chosen) > 1:
        fits, common = fitted_together([one.functions for i in chosen if (one := curves[i]).functions is not None])
        for i, fit in zip(chosen, fits, strict=True):
            one = curves[i]
            repulsive = np.array(one.rows.state) == "repulsive"
            rows = replace(
                one.rows, energy_of_fit_aj=fit.energies_at.energy_aj, virial_of_fit_aj=fit.energies_at.virial_aj
            )
            branches = branches_of(one.curve, fit, repulsive)
            moved[i] = replace(one, functions=fit, branches=branches, rows=rows)
    single = [i for i in chosen if curves[i].fit is not None and curves[i].described]
    if len(single) > 1:
        fits, _ = fitted_together([one.fit for i in single if (one := curves[i]).fit is not None])
        for i, fit in zip(single, fits, strict=True):
            moved[i] = replace(moved[i], fit=fit)
    names = () if common is None else common.names
    return TappingTogether(curves=tuple(moved), common=common, scatter=_scatters(moved, names))


def _same_lever(curves: Sequence[Tapping]) -> None:
    """Refuse curves in which not the same is stated of the lever.

    Raises:
        TableError: naming the first that differs.
    """
    names = {
        "free_frequency_khz": "free frequency",
        "quality_factor": "Q",
        "spring_constant_n_per_m": "spring constant",
        "drive": "drive",
    }
    for one in curves[1:]:
        for name, words in names.items():
            first, other = getattr(curves[0].curve, name), getattr(one.curve, name)
            if first != other:
                raise TableError(
                    f"{one.table.source}: states the {words} as {other}, {curves[0].table.source} as {first}; several "
                    "curves are taken as of one lever: state the same in all, or analyse them one by one"
                )


def _scatters(curves: Sequence[Tapping], common: tuple[str, ...]) -> tuple[CurveScatter, ...]:
    """Return the scatter of each branch that two curves have."""
    kinds: list[tuple[TappingBranch, list[tuple[Tapping, TappingBranch]]]] = []
    for one in curves:
        for branch in one.branches:
            for first, members in kinds:
                if _alike(first, branch):
                    members.append((one, branch))
                    break
            else:
                kinds.append((branch, [(one, branch)]))
    return tuple(scatter for first, members in kinds if (scatter := _scatter(first, members, common)) is not None)


def _alike(one: TappingBranch, other: TappingBranch) -> bool:
    apart = abs(one.free_amplitude_nm - other.free_amplitude_nm)
    sides = [(b.drive_frequency_khz, b.retract, b.repulsive) for b in (one, other)]
    return sides[0] == sides[1] and apart < _SAME * one.free_amplitude_nm


def _scatter(
    first: TappingBranch, members: list[tuple[Tapping, TappingBranch]], common: tuple[str, ...]
) -> CurveScatter | None:
    """Return mean, scatter and errors of a branch over the amplitudes that half of the curves have, and two."""
    ends = [(b.curve.amplitude_ratio[0], b.curve.amplitude_ratio[-1]) for _, b in members]
    fewest = max(2, (len(members) + 1) // 2)
    if len(members) < 2:
        return None
    low, high = sorted(e[0] for e in ends)[fewest - 1], sorted((e[1] for e in ends), reverse=True)[fewest - 1]
    if not low < high:
        return None
    ratio = np.linspace(low, high, _POINTS)
    columns = np.array([_parts_at(ratio, one, branch, common) for one, branch in members])
    enough = np.isfinite(columns[:, 0]).sum(axis=0) >= fewest
    ratio, (energy, own, shared) = ratio[enough], np.moveaxis(columns[:, :, enough], 1, 0)
    if not len(ratio):
        return None
    return CurveScatter(
        drive_frequency_khz=first.drive_frequency_khz,
        free_amplitude_nm=float(np.mean([b.free_amplitude_nm for _, b in members])),
        retract=first.retract,
        repulsive=first.repulsive,
        curves=len(members),
        amplitude_ratio=ratio,
        energy_aj=np.nanmean(energy, axis=0),
        energy_scatter_aj=np.nanstd(energy, axis=0, ddof=1),
        energy_own_error_aj=np.sqrt(np.nanmean(own, axis=0)),
        energy_common_error_aj=np.sqrt(np.nanmean(shared, axis=0)),
    )


def _parts_at(
    ratio: Float[np.ndarray, " points"], one: Tapping, branch: TappingBranch, common: tuple[str, ...]
) -> Float[np.ndarray, "3 points"]:
    """Return energy, its own variance and that by what all curves have in common, NaN where not measured.

    The curve's own is what its errors leave open if what all have in common were known.
    """
    curve, fit = branch.curve, one.functions
    assert fit is not None  # noqa: S101
    slopes = curve.energy_by_instrument
    own = np.einsum("nu,uv,nv->n", slopes, fit.covariance_with(common), slopes)
    own = np.maximum(own, 0.0) + curve.energy_noise_aj**2
    rest = np.maximum(curve.energy_error_aj**2 - own, 0.0)
    parts = [np.interp(ratio, curve.amplitude_ratio, part, np.nan, np.nan) for part in (curve.energy_aj, own, rest)]
    return np.stack(parts)
