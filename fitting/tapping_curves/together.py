"""Several tapping curves of one lever: one instrument for all, and how curves scatter beside their errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.checks import checked, in_float64
from afm_jax.results import JudgedResult, public_result
from afm_jax.saved import as_json
from afm_jax.solve.least_squares import IMPROBABLE
from afm_jax.strict_json import plain
from afm_jax.units import TWO_SIDED_95
from fitting.tables.csv_text import TableError
from fitting.tapping_curves.along import TappingBranch, energies_along
from fitting.tapping_curves.branches import CurveBranch, smooth_stretches
from fitting.tapping_curves.lever import COMMON, Lever, Nuisance
from fitting.tapping_curves.measured import CurveLike, measured
from fitting.tapping_curves.result import Tapping, nuisances_as_dict
from fitting.tapping_curves.tapping import energies_of_table
from fitting.tapping_curves.verdict import ORIGINS


@dataclass(frozen=True, eq=False)
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


@public_result(picture="fitting.tapping_curves.pictures:together_figure", home="fitting.tapping_curves.report")
@dataclass(frozen=True, kw_only=True)
class TappingTogether(JudgedResult):
    """Energies of a tap from several curves of one lever: what `tapping_together` returns.

    Attributes:
        curves: the result of each curve, with the instrument of all.
        lever: the curves that have an energy, and their instrument; None where fewer than two have one.
        scatter: how the energies of each branch scatter from curve to curve.
        refused: file, number and reason of curves that must not be used.
    """

    curves: tuple[Tapping, ...]
    lever: Lever | None
    scatter: tuple[CurveScatter, ...]
    refused: tuple[dict[str, Any], ...] = ()

    @property
    def common_nuisances(self) -> tuple[Nuisance, ...]:
        """What is known of the instrument that all curves have in common."""
        return () if self.lever is None else self.lever.nuisances(0)[: len(COMMON)]

    @property
    def agreement_p_value(self) -> float | None:
        """Probability of a larger disagreement among statements and free rows of one instrument; None if unknown."""
        if self.lever is None or not self.lever.minimum.degrees_of_freedom:
            return None
        return self.lever.minimum.p_value

    @property
    def reasons(self) -> list[str]:
        """What makes it no measurement."""
        found = [f"{one['file']}: refused curve {one['curve']}; {one['reason']}" for one in self.refused]
        found += [f"{one.table.source}: {one.reasons[0]}" for one in self.curves if not one.valid]
        probable = self.agreement_p_value
        if probable is not None and probable < IMPROBABLE:
            found.append(
                f"the curves disagree on the instrument that they have in common (probability {probable:.1g}): is it "
                "one lever, and was its drive left alone between them?"
            )
        return found

    def in_unit(self, said: Any) -> Any:
        """Return a text or mappings about energies in aJ with the unit that they have, that of the first curve."""
        return self.curves[0].in_unit(said) if self.curves else said


@as_json.register
def _(whole: TappingTogether) -> dict[str, Any]:
    # each curve's own is in `curves`
    told = {
        "format": "afm-jax tapping together",
        "format_version": 1,
        "valid": whole.valid,
        "reasons": whole.reasons,
        "curves": [one.table.source for one in whole.curves],
        "common_nuisances": nuisances_as_dict(whole.common_nuisances),
        "agreement_p_value": whole.agreement_p_value,
        "branches": [{**vars(one), "branch": one.way} for one in whole.scatter],
    }
    return whole.in_unit(plain(told))


@checked
@in_float64
def tapping_together(
    sources: CurveLike | Sequence[CurveLike],
    *,
    curve: int | None = None,
    noise: float | None = None,
    scale_errors: bool = False,
    **reading: Any,
) -> TappingTogether:
    """Return the energies of several curves of one lever, frequency and Q fitted to all of them.

    Args:
        sources: curves, each as for `tapping`, or one file that holds several; the same is stated of the lever in all.
        curve: as for `tapping`, like all that follow.
        noise: of amplitudes.
        scale_errors: of rows.
        reading: of instruments' files.

    Raises:
        TableError: if something else is stated of the lever in one of them, or as `tapping`.
    """
    several: Any = sources if isinstance(sources, list | tuple) else [sources]
    read = measured(several, curve=curve, noise=noise, **reading)
    results = [energies_of_table(table, scale_errors=scale_errors) for table in read.tables.values()]
    return together(results, read.refused)


def together(curves: Sequence[Tapping], refused: Sequence[dict[str, Any]] = ()) -> TappingTogether:
    """Return curves that were analysed one by one with one instrument for all of them.

    Raises:
        TableError: if not the same is stated of their lever.
    """
    _check_lever(curves)
    chosen = [i for i, one in enumerate(curves) if one.branches]
    if len(chosen) < 2:
        return TappingTogether(curves=tuple(curves), lever=None, scatter=(), refused=tuple(refused))
    moved = list(curves)
    lever = Lever([curves[i].curve for i in chosen], [curves[i].rows.free for i in chosen])
    states = [np.array(curves[i].rows.state) for i in chosen]
    repulsive = [state == "repulsive" for state in states]
    touching = [np.isin(state, ["attractive", "repulsive"]) for state in states]
    stretches = list(map(smooth_stretches, lever.curves, touching, repulsive))
    for i, functions in zip(chosen, energies_along(lever, stretches, repulsive), strict=True):
        rows = replace(curves[i].rows, energy_aj=functions.energies.energy_aj)
        moved[i] = replace(curves[i], functions=functions, rows=rows)
    return TappingTogether(curves=tuple(moved), lever=lever, scatter=_scatters(moved), refused=tuple(refused))


def _check_lever(curves: Sequence[Tapping]) -> None:
    """Refuse curves in which not the same is stated of the lever.

    Raises:
        TableError: naming the first that differs.
    """
    for one in curves[1:]:
        for name in ("free_frequency_khz", "quality_factor", "spring_constant_n_per_m", "drive"):
            first, other = getattr(curves[0].curve, name), getattr(one.curve, name)
            if first != other:
                said = f"states the {ORIGINS.get(name, name)} as {other}, {curves[0].table.source} as {first}"
                raise TableError(
                    f"{one.table.source}: {said}; several curves must be of one lever: state the same in all, or "
                    "analyse them one by one"
                )


def _scatters(curves: Sequence[Tapping]) -> tuple[CurveScatter, ...]:
    """Return the scatter of each branch that two curves have."""
    kinds: list[list[tuple[Tapping, TappingBranch]]] = []
    for curve in curves:
        for branch in curve.branches:
            members = next((found for found in kinds if _alike(found[0][1], branch)), [])
            if not members:
                kinds.append(members)
            members.append((curve, branch))
    return tuple(scatter for members in kinds if (scatter := _scatter(members)) is not None)


def _alike(one: TappingBranch, other: TappingBranch) -> bool:
    """Say whether two branches are compared: of one frequency, way and side, and one free amplitude to 3 %."""
    apart = abs(one.free_amplitude_nm - other.free_amplitude_nm)
    return (one.drive_frequency_khz, one.name) == (other.drive_frequency_khz, other.name) and (
        apart < 0.03 * one.free_amplitude_nm
    )


def _scatter(members: list[tuple[Tapping, TappingBranch]]) -> CurveScatter | None:
    """Return mean, scatter and errors of a branch over the amplitudes that half of the curves have, and two."""
    first, fewest = members[0][1], max(2, (len(members) + 1) // 2)
    if len(members) < 2:
        return None
    ends = [branch.curve.amplitude_ratio[[0, -1]] for _, branch in members]
    ratio = np.linspace(np.min(ends), np.max(ends), 41)
    columns = np.array([_parts_at(ratio, one, branch) for one, branch in members])
    enough = np.isfinite(columns[:, 0]).sum(axis=0) >= fewest
    ratio, (energy, estimate, own, shared) = ratio[enough], np.moveaxis(columns[:, :, enough], 1, 0)
    if not len(ratio):
        return None
    return CurveScatter(
        first.drive_frequency_khz,
        float(np.mean([b.free_amplitude_nm for _, b in members])),
        first.retract,
        first.repulsive,
        curves=len(members),
        amplitude_ratio=ratio,
        energy_aj=np.nanmean(energy, axis=0),
        energy_scatter_aj=np.nanstd(estimate, axis=0, ddof=1),
        energy_own_error_aj=np.sqrt(np.nanmean(own, axis=0)),
        energy_common_error_aj=np.sqrt(np.nanmean(shared, axis=0)),
    )


def _parts_at(ratio: np.ndarray, one: Tapping, branch: TappingBranch) -> Float[np.ndarray, "4 points"]:
    """Return the middle of the band, the estimate, its own variance and that by what all curves have in common.

    The curve's own is what its errors leave open if what all have in common were known. NaN where not measured.
    """
    curve = branch.curve
    covariance = one.functions.lever.minimum.covariance
    common = len(COMMON)
    gain = np.linalg.solve(covariance[:common, :common], covariance[:common])
    estimate, noise, by = curve.estimates_at(ratio)
    own = np.maximum(np.einsum("nu,uv,nv->n", by, covariance - gain.T @ covariance[:common], by), 0.0) + noise**2
    low, high = curve.at(ratio)
    error = 0.5 * (high - low) / TWO_SIDED_95
    return np.stack([0.5 * (low + high), estimate, own, np.maximum(error**2 - own, 0.0)])
