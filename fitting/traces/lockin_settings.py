"""What a trace says about its measurement besides the samples: `# key = value` comments, HDF5 attributes, options."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fitting.tables.csv_text import Faults, Setting, fault_in_number, parse_setting, quoted, setting_in
from fitting.tables.table_comments import LOWEST_QUALITY_FACTOR

_ANY = float("-inf")
SETTINGS = {
    setting.key: setting
    for setting in (
        Setting("sampling_rate_mhz", "50"),
        Setting("drive_frequency_khz", "180"),
        Setting("drive_amplitude_nm"),
        Setting("offset_nm", lowest=_ANY),
        Setting("drive_phase_deg", lowest=_ANY),
        Setting("free_frequency_khz"),
        Setting("quality_factor", "40 (or 40 +- 2)", lowest=LOWEST_QUALITY_FACTOR, error="maybe"),
        Setting("quality_factor_error"),
        Setting("mass_ng"),
        Setting("rest_nm", lowest=_ANY),
    )
}


@dataclass(frozen=True, kw_only=True)
class TraceSettings:
    """The settings of a trace; None where nothing is known.

    Attributes:
        sampling_rate_mhz: samples per us.
        drive_frequency_khz: of the platform.
        drive_amplitude_nm: of the platform.
        offset_nm: mean height of the platform above the tip's rest position.
        drive_phase_deg: psi in z_p = offset + beta cos(omega t + psi), t the trace's own time.
        free_frequency_khz: undamped natural frequency of the cantilever.
        quality_factor: of the cantilever.
        quality_factor_error: its standard error.
        mass_ng: effective mass.
        rest_nm: what the deflection reads at the tip's rest position.
    """

    sampling_rate_mhz: float | None = None
    drive_frequency_khz: float | None = None
    drive_amplitude_nm: float | None = None
    offset_nm: float | None = None
    drive_phase_deg: float | None = None
    free_frequency_khz: float | None = None
    quality_factor: float | None = None
    quality_factor_error: float | None = None
    mass_ng: float | None = None
    rest_nm: float | None = None


def settings_of_comments(comments: list[tuple[int, str]], faults: Faults) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return the settings that comment lines make, and the other comments.

    Args:
        comments: line number and text (without the number sign, stripped) of each.
        faults: where a misspelt key, a value that is no number and a repeated key are noted.
    """
    found: dict[str, float] = {}
    remarks = []
    for line, text in comments:
        setting = setting_in(text, SETTINGS)
        if setting is None:
            remarks.append(text)
        elif setting.key in found:
            faults.add(f"{setting.key} is given a second time; remove one of the two", line=line)
        else:
            numbers = parse_setting(setting, text, line=line, faults=faults) or ()
            names = (setting.key, f"{setting.key}_error")
            found |= {name: number for name, number in zip(names, numbers, strict=False) if number is not None}
    return found, tuple(remarks)


def settings_of_attributes(attributes: Mapping[str, Any], faults: Faults) -> dict[str, float]:
    """Return the settings among the attributes of an HDF5 file; attributes of other names are left alone.

    Args:
        attributes: by name.
        faults: where a value that is no number is noted.
    """
    found = {}
    for name in SETTINGS:
        if name in attributes:
            try:
                found[name] = _checked(name, float(attributes[name]), faults)
            except (TypeError, ValueError):
                faults.add(f"the attribute {name} is {quoted(str(attributes[name]))}; it must be a number")
    return found


def joined_settings(found: Mapping[str, float], given: Mapping[str, float | None], faults: Faults) -> TraceSettings:
    """Return the settings of a trace: those given by the caller in front of those of the file.

    Args:
        found: what the file says.
        given: what the caller says; None leaves the file's.
        faults: where impossible values are noted.

    Raises:
        TypeError: if the caller names a setting that does not exist.
    """
    stated = {name: float(value) for name, value in given.items() if value is not None}
    for name, value in stated.items():
        if name not in SETTINGS:
            raise TypeError(f"there is no setting `{name}`; the settings are {', '.join(SETTINGS)}")
        _checked(name, value, faults)
    # the error of a quality factor belongs to the value that it was stated with
    if "quality_factor" in stated:
        found = {name: value for name, value in found.items() if name != "quality_factor_error"}
    return TraceSettings(**(dict(found) | stated))


def _checked(name: str, value: float, faults: Faults) -> float:
    fault = fault_in_number(SETTINGS[name], value)
    if fault is not None:
        faults.add(f"{name} {fault}")
    return value
