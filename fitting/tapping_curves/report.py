"""A tapping curve as a person reads it: text for the terminal, files for the drawer (HTML, JSON, CSV, PNG)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.strict_json import plain
from afm_jax.words import bullets, interval, known, percent, text_table, with_error
from fitting.tapping_curves.branches import Height, Hysteresis
from fitting.tapping_curves.result import Tapping, origin_in_words

_EV_PER_AJ = 6.241509
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
    if result.fit is not None:
        lines += _energy_lines(result)
    lines += _threshold_lines(result)
    lines += _speed_lines(result)
    lines += ["", law_in_words(result)]
    lines += bullets("Assumed:", result.assumptions)
    lines += bullets("Notes:", result.warnings)
    return "\n".join(lines)


def _counts(result: Tapping) -> str:
    states = result.rows.state
    kinds = [(states.count(kind), kind) for kind in ("free", "attractive", "repulsive", "touching", "held")]
    return f"{len(states)} rows, " + ", ".join(f"{count} {kind}" for count, kind in kinds if count)


def energy_in_words(result: Tapping) -> str:
    """Return the energy of a tap in aJ and eV."""
    energy = result.energy
    if energy["kind"] == "none":
        return "not known"
    low, high = energy["interval95"]
    if energy["kind"] == "bracket" and energy["value"] is None:
        return f"between {low:.2g} and {high:.3g} aJ"
    if energy["value"] is None:
        return f"at most {high:.3g} aJ, {_EV_PER_AJ * high:.3g} eV"
    value = with_error(energy["value"], energy["standard_error"])
    electronvolts = interval(_EV_PER_AJ * low, _EV_PER_AJ * high)
    return f"{value} aJ (95 %: {interval(low, high)}), {electronvolts} eV"


def law_in_words(result: Tapping) -> str:
    """Return what became of the law, as a sentence."""
    if result.law is None:
        return f"No impact law: {result.reason}."
    from fitting.report.report import summary  # noqa: PLC0415

    return summary(result.law)


def _energy_lines(result: Tapping) -> list[str]:
    plainly, epsilon = result.plain_energy, result.epsilon
    lines = []
    if epsilon["value"] is not None:
        value = with_error(epsilon["value"], epsilon["standard_error"])
        lines.append(f"  epsilon = 2 E/m = {value} nm^2/us^2, m = {result.mass_ng:.4g} ng")
    if plainly["mean"] is not None:
        scatter = known(plainly["standard_deviation"], ".2g")
        lines.append(
            f"  row by row, instrument as given: mean {plainly['mean']:.3g} aJ, scatter {scatter}, "
            f"systematic {plainly['systematic_error']:.2g}"
        )
    shares = sorted(result.energy.get("share_of_variance", {}).items(), key=lambda pair: -pair[1])
    words = [f"{origin_in_words(name)} {percent(share)}" for name, share in shares if share > 0.005]
    lines += [f"  its variance comes from {', '.join(words)}"] if words else []
    if not result.described:
        return lines
    lines.append("")
    lines += text_table(["branch", "rows", "energy (aJ)", "95 %"], _group_cells(result), words=(0,))
    lines += ["", *text_table(["instrument", "given", "fitted"], _instrument_cells(result), words=(0,))]
    assert result.fit is not None  # noqa: S101
    lines.append(
        f"  chi2/dof = {result.fit.chi2:.1f}/{result.fit.degrees_of_freedom}, probability {result.fit.p_value:.2g}"
    )
    return lines


def _group_cells(result: Tapping) -> list[list[str]]:
    fit = result.fit
    if fit is None:
        return []
    counts = [int(np.sum(fit.used & (result.group_of_rows == i))) for i in range(len(result.groups))]
    return [
        [
            group.name,
            f"{counts[i]}",
            with_error(fit.energy_aj[i], fit.standard_error_aj[i] * result.stretch),
            interval(*fit.interval95_aj[i]) if np.isfinite(fit.interval95_aj[i]).all() else "open",
        ]
        for i, group in enumerate(result.groups)
    ]


def _instrument_cells(result: Tapping) -> list[list[str]]:
    if result.fit is None:
        return []
    cells = []
    for one in result.fit.nuisances:
        given = str(one.given) if np.isfinite(one.given.error) else "not known"
        cells.append([one.name.removesuffix("_0"), given, with_error(one.value, one.standard_error)])
    return cells


def _threshold_lines(result: Tapping) -> list[str]:
    if not result.hysteresis:
        return []
    return [
        "",
        *text_table(
            ["threshold (height in nm)", "way in", "way back", "later by", "between"],
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
    return [
        "",
        (
            f"Impact speeds: {u[here].min():.3g} to {u[here].max():.3g} nm/us in {int(here.sum())} rows "
            f"({many.min():.2g} to {many.max():.2g} capture speeds), known to "
            f"{percent(float(np.median(found.approach_speed_error_nm_per_us[here] / u[here])))} in the median"
        ),
    ]


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
    records = result.records()
    write_table("tapping_rows.csv", records, tuple(records[0]))
    law = [] if result.law is None else write_report(result.law, folder, write_table)
    return [*written, frames_path, *law]


def tapping_page(result: Tapping, pictures: list[bytes]) -> str:
    """Return the result as one HTML page.

    Args:
        result: what was found.
        pictures: SVG files from `tapping_pictures`.
    """
    from fitting.report.page import Table, page, pairs, pictures_of  # noqa: PLC0415

    shows = (
        (
            "Amplitude, phase and energy of a tap over the height of the sample. Lines: one energy a branch; "
            "open: set aside; grey: free."
        ),
        (
            "The same motion in two frames. Left, the lab: a shaken tip meets a sample at rest. Right, with its "
            "free motion taken away: the tip flies freely, and the sample moves up and down with the free amplitude."
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
    aside = {i for i, record in enumerate(records) if (record["note"] or "").startswith("set aside")}
    energy = result.energy
    shares = {origin_in_words(name): percent(share) for name, share in energy.get("share_of_variance", {}).items()}
    return page(
        "tapping.html.jinja",
        result=result,
        title=f"Tapping curve {result.table.source}",
        energy=energy_in_words(result),
        law=f"No impact law: {result.reason}." if result.law is None else "The impact law is in fit.html.",
        plain_energy=result.plain_energy,
        groups=Table("One energy for each branch", ["branch", "rows", "energy (aJ)", "95 %"], _group_cells(result)),
        instrument=Table(
            "The instrument, fitted along within its errors", ["", "given", "fitted"], _instrument_cells(result)
        ),
        shares=pairs("Where the variance of the energy comes from", ("", "share"), shares) if shares else None,
        thresholds=Table(
            "Heights of the sample over the rest position in nm",
            ["threshold", "way in", "way back", "later by", "between"],
            threshold_cells(result),
            words=("between",),
        )
        if result.hysteresis
        else None,
        pictures=pictures_of(pictures, shows),
        rows=Table(
            "Shaded: set aside",
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


def _cell(value: Any, form: str) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, str) else f"{value:{form}}"
