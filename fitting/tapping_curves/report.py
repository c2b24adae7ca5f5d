"""A tapping curve, and several of one lever, as a person reads them."""

from collections.abc import Sequence

import numpy as np

from afm_jax.columns import CsvColumns, columns_of, csv_columns
from afm_jax.report import Bullets, Picture, Section, Table, sections
from afm_jax.units import EV_PER_AJ, TWO_SIDED_95
from afm_jax.words import interval, percent, with_error
from fitting.tapping_curves.along import HEADLINE, differences_of_ways, interpolated, said_of
from fitting.tapping_curves.branches import CurveBranch, Hysteresis
from fitting.tapping_curves.result import Tapping
from fitting.tapping_curves.together import TappingTogether

_CHANGES = {
    "contact": "contact: the amplitude leaves the free one",
    "half": "half of the free amplitude is left",
    "branch": "from the attractive to the repulsive branch",
}


@sections.register
def _(taps: Tapping) -> list[Section]:
    states = taps.rows.state
    kinds = [(states.count(kind), kind) for kind in ("free", "attractive", "repulsive", "touching", "held")]
    counts = ", ".join(f"{count} {kind}" for count, kind in kinds if count)
    shows = (
        "Amplitude, phase and energy of a tap over the height of the sample. Lines: the energy along each branch with "
        "its 95 % band, dashed one energy for all taps where that explains the rows; open: excluded; grey: free."
    )
    title = f"Tapping curve {taps.table.source}: {len(states)} rows, {counts}"
    return [
        Section(title, [f"  {line}" for line in energy_in_words(taps)]),
        Section("Picture", [Picture("fitting.tapping_curves.pictures:curve_figure", shows)]),
        *_along_the_branches(taps),
        _one_energy(taps),
        _thresholds(taps),
        _speeds(taps),
        Section("Impact law", [str(taps.law) if taps.law else f"No impact law: {taps.reason}."]),
        Section("What the numbers assume", [Bullets(taps.assumptions, "Assumed:")]),
    ]


@csv_columns.register
def _(taps: Tapping) -> CsvColumns:
    return {"tapping_rows.csv": columns_of(taps.in_unit(taps.records()))}


def energy_in_words(taps: Tapping) -> list[str]:
    """Return the energy of a tap in aJ and eV at 0.8 of the free amplitude if measured there, and the largest."""
    top, over_k = taps.largest, taps.curve.over_spring_constant
    if taps.bound_aj is not None:
        electronvolts = "" if over_k else f", {EV_PER_AJ * taps.bound_aj:.3g} eV"
        return [f"Energy of a tap: at most {taps.bound_aj:.3g} aJ{electronvolts}"]
    if top is None or not (taps.valid or "only bracketed" in taps.why_not_functions):
        return ["Energy of a tap: not known"]
    # the first line gives the energy at 0.8 of the free amplitude
    quoted = [one for one in taps.energies_at if one["amplitude_ratio"] == 0.8]
    places = [(max(quoted, key=lambda one: one["energy_aj"]), "interval95_aj", "Energy of a tap")] if quoted else []
    places.append((top, "interval95", "Largest energy of a tap" if quoted else "Energy of a tap, where it is largest"))
    lines = []
    for at, band, what in places:
        low, high = at[band]
        where = f"at {at['amplitude_ratio']:.2f} of the free amplitude, {taps.branches[at['branch']].name}"
        electronvolts = "" if over_k else f", {interval(EV_PER_AJ * low, EV_PER_AJ * high)} eV"
        lines.append(f"{what}: {_band_in_words(low, high)} aJ {where} (95 %: {interval(low, high)} aJ{electronvolts})")
    return lines


def _band_in_words(low: float, high: float) -> str:
    """Return a band of 95 % as what it is: a value with its standard error, a bracket, an upper bound, or unknown."""
    if np.isnan(low):
        return "-"
    said = said_of(low, high)
    if said == "measured":
        return with_error(0.5 * (low + high), 0.5 * (high - low) / TWO_SIDED_95)
    return interval(low, high) if said == "bracket" else f"< {high:.3g}"


def _along_the_branches(taps: Tapping) -> list[Section]:
    """Return the energy of each branch at some amplitudes, and what is known of the instrument."""
    functions = taps.functions
    if not taps.branches:
        return []
    head = ["energy (aJ) at A/A0 =", "measured", *(f"{ratio:g}" for ratio in HEADLINE), "largest"]
    cells = []
    for branch in taps.branches:
        ratio = branch.curve.amplitude_ratio
        top = float(ratio[np.argmax(branch.curve.energy_aj)])
        *at, largest = (_band_in_words(*band) for band in branch.curve.at([*HEADLINE, top]).T.tolist())
        name = branch.name + _of_drive(branch, taps.branches)
        cells.append([name, f"{ratio[0]:.2f} to {ratio[-1]:.2f}", *at, f"{largest} at {top:.2f}"])
    lines = [
        f"  retract less approach, {taps.branches[one['approach']].side}: "
        f"{with_error(one['energy_aj'], one['standard_error'])} aJ at A/A0 = {one['amplitude_ratio']:.2f}, where the "
        "difference is largest in units of its error"
        for one in differences_of_ways(functions)
    ]
    energy = Table(
        "Energy of a tap by the amplitude over the free one: value and standard error where measured, else the band of "
        "95 %",
        head,
        cells,
    )
    scaled = "" if functions.scale == 1.0 else f", errors of the rows times {functions.scale:.2f}"
    chi2 = f"chi2 {functions.rows_chi2:.1f} for {functions.rows_freedom:.0f} degrees of freedom{scaled}"
    known = [
        [
            one.name,
            str(one.given) if np.isfinite(one.given.error) else "not known",
            with_error(one.value, one.standard_error),
        ]
        for one in functions.nuisances
    ]
    caption = "The instrument as stated, and fitted to its free rows"
    instrument = Table(caption, ["instrument, from statements and free rows", "given", "fitted"], known)
    return [
        Section("Energy along the branches", [energy, *lines]),
        Section("Instrument", [instrument, f"  rows about smooth energies: {chi2}"]),
    ]


def _of_drive(one: CurveBranch | Hysteresis, others: Sequence[CurveBranch | Hysteresis]) -> str:
    """Return frequency and free amplitude as the end of a name, where others have different ones."""
    several = len({(other.drive_frequency_khz, other.free_amplitude_nm) for other in others}) > 1
    return f", {one.drive_frequency_khz:g} kHz, {one.free_amplitude_nm:.4g} nm" if several else ""


def _one_energy(taps: Tapping) -> Section:
    """Return the one energy of all taps of each branch, where that describes the rows."""
    fit, epsilon = taps.fit, taps.epsilon
    if fit is None or taps.why_not_constant:
        return Section("One energy for all taps", [])
    assumed = (
        "Assuming that every tap of a branch loses the same energy (the curve cannot test it along A sqrt(A0^2 - A^2)):"
    )
    cells = []
    for one in fit.groups:
        known = interval(*one.interval95_aj) if np.isfinite(one.error_aj) else "open"
        cells.append([one.name, f"{len(one.rows)}", with_error(one.energy_aj, one.error_aj), known])
    table = Table("One energy a branch", ["branch", "rows", "energy (aJ)", "95 %"], cells)
    least, pull = fit.minimum, fit.nuisances[0].pull
    chi2 = f"chi2/dof = {least.chi2:.1f}/{least.degrees_of_freedom}, probability {least.p_value:.2g}"
    lines = [f"  {chi2}, the free frequency {pull:+.1f} of its errors from what is given"]
    if epsilon["value"] is not None:
        scaled = with_error(epsilon["value"], epsilon["standard_error"])
        of_mass = "" if taps.curve.over_spring_constant else f", m = {taps.mass_ng:.4g} ng"
        lines.append(f"  epsilon = 2 E/m = {scaled} nm^2/us^2{of_mass}")
    return Section("One energy for all taps", [assumed, table, *lines])


def _thresholds(taps: Tapping) -> Section:
    """Return the heights at which the curve changes, a row for each change."""
    cells = []
    for one in taps.hysteresis:
        heights = (end and (end.offset_nm, end.standard_error) for end in (one.approach, one.retract))
        words = ["-" if found is None else with_error(*found) for found in (*heights, one.width_nm)]
        cells.append([_CHANGES[one.change] + _of_drive(one, taps.hysteresis), *words])
    head = ["threshold (height in nm)", "approach", "retract", "approach - retract"]
    table = Table("Heights of the sample over the tip's rest position", head, cells)
    return Section("Thresholds", [table])


def _speeds(taps: Tapping) -> Section:
    """Return the speeds of the impacts."""
    found, words = taps.speeds, ""
    if found is not None:
        here = np.isfinite(found.approach_speed_nm_per_us)
        u = found.approach_speed_nm_per_us[here]
        error = found.approach_speed_error_nm_per_us[here]
        words = "Impact speeds cannot be determined from this curve."
        if len(u):
            known = f"known to {percent(float(np.median(error / u)))} in the median"
            words = f"Impact speeds: {u.min():.3g} to {u.max():.3g} nm/us in {len(u)} rows, {known}"
    return Section("Speeds of the impacts", [words])


@csv_columns.register
def _(whole: TappingTogether) -> CsvColumns:
    each = whole.curves
    return {"together.csv": {"curve": [one.table.source for one in each], "valid": [one.valid for one in each]}}


@sections.register
def _(whole: TappingTogether) -> list[Section]:
    # mean and scatter of each branch, and the instrument
    cells = []
    for one in whole.scatter:
        columns = one.energy_aj, one.energy_scatter_aj, one.energy_own_error_aj, one.energy_common_error_aj
        for ratio in HEADLINE:
            mean, *errors = interpolated(ratio, one.amplitude_ratio, *columns)
            if np.isfinite(mean):
                numbers = f"{mean:.3g}", *(f"{error:.2g}" for error in errors)
                cells.append([one.name, f"{one.curves}", f"{ratio:g}", *numbers])
    head = ["energy of a tap (aJ)", "curves", "A/A0", "mean", "scatter between curves", "own error", "common error"]
    caption = "Mean energy over the curves, its scatter from curve to curve, and what errors explain of that"
    common = [
        f"  {one.name}: {with_error(one.value, one.standard_error)} ({one.given})" for one in whole.common_nuisances
    ]
    if whole.agreement_p_value is not None:
        common.append(f"  probability that curves of one instrument disagree more: {whole.agreement_p_value:.2g}")
    shows = (
        "Energy over the amplitude, each curve and their mean, with the scatter and the error that all have in common."
    )
    return [
        Section(f"{len(whole.curves)} curves of one lever", []),
        Section("Picture", [Picture("fitting.tapping_curves.pictures:together_figure", shows)]),
        Section("Branches", [Table(caption, head, cells)]),
        Section("What the curves have in common", common),
    ]
