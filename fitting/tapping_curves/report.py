"""A tapping curve as a person reads it: text for the terminal, files for the drawer (HTML, JSON, CSV, PNG)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.strict_json import plain
from afm_jax.words import broken, bullets, interval, known, percent, text_table, with_error
from fitting.tapping_curves.branches import Height, Hysteresis
from fitting.tapping_curves.energy_curve import HEADLINE
from fitting.tapping_curves.energy_fit import EnergyFit
from fitting.tapping_curves.result import Tapping, origin_in_words
from fitting.tapping_curves.together import TappingTogether, together_lines

_EV_PER_AJ = 6.241509
_WIDTH = 150
_CHANGES = {
    "contact": "contact: the amplitude leaves the free one",
    "half": "half of the free amplitude is left",
    "branch": "from the attractive to the repulsive branch",
}


def tapping_summary(result: Tapping) -> str:
    """Return the result as text: verdict, energy, thresholds, speeds, law or what to record instead, notes."""
    lines = [f"Tapping curve {result.table.source}: {_counts(result)}", "", "VALID" if result.valid else "NOT VALID"]
    lines += [f"  - {reason}" for reason in result.reasons]
    lines += ["", f"Energy of a tap: {energy_in_words(result)}"]
    if result.functions is not None:
        lines += _along_lines(result)
    if result.fit is not None and result.described:
        lines += _energy_lines(result)
    lines += _threshold_lines(result)
    lines += _speed_lines(result)
    law = law_in_words(result)
    lines += ["", *(broken(law, _WIDTH) if result.law is None else [law])]
    lines += [piece for line in bullets("Assumed:", result.assumptions) for piece in broken(line, _WIDTH, "    ")]
    lines += [piece for line in bullets("Notes:", result.warnings) for piece in broken(line, _WIDTH, "    ")]
    return result.in_unit("\n".join(lines))


def _counts(result: Tapping) -> str:
    states = result.rows.state
    kinds = [(states.count(kind), kind) for kind in ("free", "attractive", "repulsive", "touching", "held")]
    return f"{len(states)} rows, " + ", ".join(f"{count} {kind}" for count, kind in kinds if count)


def energy_in_words(result: Tapping) -> str:
    """Return the energy of a tap in aJ and eV."""
    energy, largest, over_k = result.energy, result.largest, result.curve.over_spring_constant
    if energy["kind"] == "upper bound":
        high = energy["interval95"][1]
        return f"at most {high:.3g} aJ" + ("" if over_k else f", {_EV_PER_AJ * high:.3g} eV")
    if energy["value"] is None:
        if largest is None or result.why_not_functions:
            return "not known" if energy["kind"] != "several" else energy["reason"]
        value = with_error(largest["value"], largest["standard_error"])
        start = energy["reason"] + ";" if energy["kind"] == "several" else "changes along the curve,"
        return f"{start} at most {value} aJ, at {largest['amplitude_ratio']:.2f} of the free amplitude"
    low, high = energy["interval95"]
    value = with_error(energy["value"], energy["standard_error"])
    electronvolts = "" if over_k else f" {interval(_EV_PER_AJ * low, _EV_PER_AJ * high)} eV,"
    return f"{value} aJ (95 %: {interval(low, high)}),{electronvolts} if each takes the same"


def law_in_words(result: Tapping) -> str:
    """Return what became of the law, as a sentence."""
    if result.law is None:
        return f"No impact law: {result.reason}."
    from fitting.report.report import summary  # noqa: PLC0415

    return summary(result.law)


def branch_name(result: Tapping, number: int) -> str:
    """Return what a branch is called; its drive where there are several."""
    branch = result.branches[number]
    name = branch.name
    several = len({(b.drive_frequency_khz, b.free_amplitude_nm) for b in result.branches}) > 1
    return name + (f", {branch.drive_frequency_khz:g} kHz, {branch.free_amplitude_nm:.4g} nm" if several else "")


def along_cells(result: Tapping) -> list[list[str]]:
    """Return the energy of each branch at some amplitudes."""
    cells = []
    for i, branch in enumerate(result.branches):
        curve = branch.curve
        row = [branch_name(result, i), f"{curve.amplitude_ratio[0]:.2f} to {curve.amplitude_ratio[-1]:.2f}"]
        for ratio in HEADLINE:
            found = curve.at(ratio)
            row.append("-" if found is None else with_error(*found))
        top = int(np.argmax(curve.energy_aj))
        row.append(
            f"{with_error(float(curve.energy_aj[top]), float(curve.energy_error_aj[top]))} "
            f"at {curve.amplitude_ratio[top]:.2f}"
        )
        cells.append(row)
    return cells


ALONG_HEAD = ["energy (aJ) at A/A0 =", "measured", *(f"{ratio:g}" for ratio in HEADLINE), "largest"]


def _along_lines(result: Tapping) -> list[str]:
    fit = result.functions
    assert fit is not None  # noqa: S101
    lines = ["", *text_table(ALONG_HEAD, along_cells(result), words=(0,))]
    for one in result.turning_points:
        ratios, heights = one["amplitude_ratio"], one["height_nm"]
        lines.append(
            f"  {one['branch']}: attractive turns repulsive at A/A0 = {min(ratios):.3f} to {max(ratios):.3f}, "
            f"height {min(heights):.4g} to {max(heights):.4g} nm"
        )
    for (i, _), one in result.way_differences.items():
        lines.append(
            f"  retract less approach, {result.branches[i].side}: {with_error(one.energy_aj, one.standard_error)} aJ "
            f"at A/A0 = {one.amplitude_ratio:.2f}, where it is most in its errors"
        )
    head = ["instrument, fitted with the energy along the branches", "given", "fitted"]
    lines += ["", *text_table(head, _instrument_cells(fit), words=(0,))]
    probability = "" if fit.scale == 1.0 else f", errors of the rows times {fit.scale:.2f}"
    lines.append(
        f"  rows about it: chi2 {fit.rows_chi2:.1f} for {fit.rows_freedom:.0f} degrees of freedom{probability}"
    )
    return lines


def _energy_lines(result: Tapping) -> list[str]:
    plainly, epsilon = result.plain_energy, result.epsilon
    lines = ["", "One energy for all taps of a branch (assumed: each takes the same):"]
    if epsilon["value"] is not None:
        value = with_error(epsilon["value"], epsilon["standard_error"])
        of_mass = "" if result.curve.over_spring_constant else f", m = {result.mass_ng:.4g} ng"
        lines.append(f"  epsilon = 2 E/m = {value} nm^2/us^2" + of_mass)
    if plainly["mean"] is not None:
        scatter = known(plainly["standard_deviation"], ".2g")
        lines.append(
            f"  row by row, instrument as given: mean {plainly['mean']:.3g} aJ, scatter {scatter}, "
            f"systematic {plainly['systematic_error']:.2g}"
        )
    shares = sorted(result.energy.get("share_of_variance", {}).items(), key=lambda pair: -pair[1])
    words = [f"{origin_in_words(name)} {percent(share)}" for name, share in shares if share > 0.005]
    lines += [f"  its variance comes from {', '.join(words)}"] if words else []
    lines.append("")
    lines += text_table(["branch", "rows", "energy (aJ)", "95 %"], _group_cells(result), words=(0,))
    assert result.fit is not None  # noqa: S101
    lines += ["", *text_table(["instrument", "given", "fitted"], _instrument_cells(result.fit), words=(0,))]
    lines.append(
        f"  chi2/dof = {result.fit.chi2:.1f}/{result.fit.degrees_of_freedom}, probability {result.fit.p_value:.2g}"
    )
    return lines


def _group_cells(result: Tapping) -> list[list[str]]:
    fit = result.fit
    if fit is None or not result.described:
        return []
    counts = [int(np.sum(fit.used & (result.group_of_rows == i))) for i in range(len(result.groups))]
    cells = []
    for i, group in enumerate(result.groups):
        value, error, ends = result.constant(i)
        cells.append(
            [
                group.name,
                f"{counts[i]}",
                with_error(value, error),
                interval(*ends) if np.isfinite(ends).all() else "open",
            ]
        )
    return cells


def _instrument_cells(fit: EnergyFit | None) -> list[list[str]]:
    cells = []
    for one in () if fit is None else fit.nuisances:
        given = str(one.given) if np.isfinite(one.given.error) else "not known"
        cells.append([one.name.removesuffix("_0"), given, with_error(one.value, one.standard_error)])
    return cells


def _threshold_lines(result: Tapping) -> list[str]:
    if not result.hysteresis:
        return []
    return [
        "",
        *text_table(
            ["threshold (height in nm)", "approach", "retract", "later by", "between"],
            threshold_cells(result),
            words=(0, 4),
        ),
    ]


def threshold_cells(result: Tapping) -> list[list[str]]:
    """Return the thresholds in words, a row for each change."""
    several = len({(one.drive_frequency_khz, one.free_amplitude_nm) for one in result.hysteresis}) > 1
    return [
        [
            _CHANGES[one.change]
            + (f", {one.drive_frequency_khz:g} kHz, {one.free_amplitude_nm:.4g} nm" if several else ""),
            _height(one.approach),
            _height(one.retract),
            "-" if one.width_nm is None else with_error(*one.width_nm),
            _between(one),
        ]
        for one in result.hysteresis
    ]


def _height(found: Height | None) -> str:
    return "-" if found is None else with_error(*found)


def _between(found: Hysteresis) -> str:
    if found.energy_between_aj is None:
        return "-"
    return f"{with_error(*found.energy_between_aj)} aJ {found.energy_of}"


def _speed_lines(result: Tapping) -> list[str]:
    found = result.speeds
    if found is None:
        return []
    u = found.approach_speed_nm_per_us
    here = np.isfinite(u)
    if not here.any():
        return ["", "Impact speeds: in no row known to a quarter."]
    many = found.in_capture_speeds[here]
    lines = [
        "",
        (
            f"Impact speeds: {u[here].min():.3g} to {u[here].max():.3g} nm/us in {int(here.sum())} rows "
            f"({many.min():.2g} to {many.max():.2g} capture speeds), known to "
            f"{percent(float(np.median(found.approach_speed_error_nm_per_us[here] / u[here])))} in the median"
        ),
    ]
    for one in result.laws_of_energies:
        values = ", ".join(f"{name} {with_error(*pair)}" for name, pair in one.parameters.items())
        lines.append(
            f"  energy against speed: {one.formula} with {values}, chi2 {one.chi2:.1f} for {one.degrees_of_freedom} "
            "(errors of noise and speeds alone)"
        )
    return lines


def write_tapping(
    result: Tapping, folder: Path, write_table: Callable[[str, list[dict[str, Any]], tuple[str, ...]], None]
) -> list[Path]:
    """Write tapping.html, .txt, .json, .png and tapping_rows.csv, and the report of the law if there is one.

    Args:
        result: what was found.
        folder: an existing folder; files of these names are replaced.
        write_table: called with a file name, records and columns for the CSV file.

    Returns:
        The files written here (the tables are `write_table`'s).

    Raises:
        OSError: if a file cannot be written.
    """
    from afm_jax.whole_files import write_whole  # noqa: PLC0415
    from fitting.report.report import write_report, write_report_files  # noqa: PLC0415
    from fitting.tapping_curves.pictures import tapping_pictures  # noqa: PLC0415

    (curve, frames, *_), pictures = tapping_pictures(result)
    page = folder / "tapping.html"
    write_whole(page, tapping_page(result, pictures))
    data = {"format": "afm-jax tapping", "format_version": 1, **result.to_dict()}
    written = [
        page,
        *write_report_files(folder, "tapping", text=tapping_summary(result), data=data, picture=curve),
    ]
    frames_path = folder / "tapping_frames.png"
    write_whole(frames_path, frames)
    records = result.keyed(result.records())
    write_table("tapping_rows.csv", records, tuple(records[0]))
    law = [] if result.law is None else write_report(result.law, folder, write_table)
    return [*written, frames_path, *law]


def write_together(result: TappingTogether, folder: Path) -> list[Path]:
    """Write together.txt, .json and .png, what several curves of one lever say.

    Args:
        result: what was found.
        folder: an existing folder; files of these names are replaced.

    Returns:
        The files.

    Raises:
        OSError: if a file cannot be written.
    """
    from afm_jax.plots.picture_style import png_of  # noqa: PLC0415
    from fitting.report.report import write_report_files  # noqa: PLC0415
    from fitting.tapping_curves.pictures import together_figure  # noqa: PLC0415

    return write_report_files(
        folder,
        "together",
        text="\n".join(together_lines(result)),
        data={"format": "afm-jax tapping together", "format_version": 1, **result.to_dict()},
        picture=png_of(together_figure(result)),
    )


def tapping_page(result: Tapping, pictures: list[bytes]) -> str:
    """Return the result as one HTML page.

    Args:
        result: what was found.
        pictures: SVG files from `tapping_pictures`.
    """
    from fitting.report.sections import Table, page, pairs, pictures_of  # noqa: PLC0415

    shows = (
        (
            "Amplitude, phase and energy of a tap over the height of the sample. Lines: the energy along each branch "
            "with its 95 % band, dashed one energy for all taps where that explains the rows; open: excluded; "
            "grey: free."
        ),
        (
            "The same motion in two frames. Left, the lab: a shaken tip meets a sample at rest. Right, with its "
            "free motion taken away: the tip flies freely, and the sample moves up and down with the free amplitude."
        ),
        *(
            ["Energy of a tap against the tip's speed at the sample, with the lines of two impact laws through it."]
            if result.laws_of_energies
            else []
        ),
        "The impact law from the rows with fast impacts, with its 95 % band.",
    )[: len(pictures)]
    records = result.records()
    columns = [
        ("line", "line", "d"),
        ("way", "branch", ""),
        ("branch", "state", ""),
        ("height (nm)", "offset_nm", ".5g"),
        ("amplitude (nm)", "lockin_amplitude_nm", ".5g"),
        ("lag (°)", "phase_lag_deg", ".2f"),
        ("E (aJ)", "energy_aj", ".3g"),
        ("± noise", "energy_noise_aj", ".2g"),
        ("± shared", "energy_systematic_aj", ".2g"),
        ("E, fitted (aJ)", "energy_of_fit_aj", ".3g"),
        ("residual", "residual", "+.1f"),
        ("virial (aJ)", "virial_aj", ".3g"),
        ("u_in (nm/µs)", "approach_speed_nm_per_us", ".3g"),
        ("remarks", "note", ""),
    ]
    rows = [[_cell(record.get(key), form) for _, key, form in columns] for record in records]
    aside = {i for i, record in enumerate(records) if (record["note"] or "").startswith("excluded")}
    energy = result.energy
    shares = {origin_in_words(name): percent(share) for name, share in energy.get("share_of_variance", {}).items()}
    text = page(
        "tapping.html.jinja",
        result=result,
        title=f"Tapping curve {result.table.source}",
        energy=energy_in_words(result),
        law=f"No impact law: {result.reason}." if result.law is None else "The impact law is in fit.html.",
        plain_energy=result.plain_energy,
        along=Table(
            "Energy along the branches in aJ, by the amplitude over the free one", ALONG_HEAD, along_cells(result)
        ),
        groups=Table("One energy for each branch", ["branch", "rows", "energy (aJ)", "95 %"], _group_cells(result)),
        instrument=Table(
            "The instrument, fitted along within its errors",
            ["", "given", "fitted"],
            _instrument_cells(result.functions),
        ),
        shares=pairs("Where the variance of the energy comes from", ("", "share"), shares) if shares else None,
        thresholds=Table(
            "Heights of the sample over the rest position in nm",
            ["threshold", "approach", "retract", "later by", "between"],
            threshold_cells(result),
            words=("between",),
        )
        if result.hysteresis
        else None,
        pictures=pictures_of(pictures, shows),
        rows=Table(
            "Shaded: excluded",
            [name for name, _, _ in columns],
            rows,
            words=("way", "branch", "remarks"),
            marked=aside,
        ),
        inputs=pairs(
            "What the table says",
            ("", "value"),
            {name: value for name, value in plain(result.to_dict()["input"]).items() if not isinstance(value, list)},
        ),
        versions=pairs("Versions of what computed it", ("package", "version"), result.versions),
    )
    return result.in_unit(text)


def _cell(value: Any, form: str) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, str) else f"{value:{form}}"
