"""The comment lines of an amplitude table: what `# key = value` says about the cantilever, and free remarks."""

from dataclasses import dataclass

from fitting.tables.csv_text import Faults, Setting, parse_setting, setting_in

# An overdamped cantilever does not vibrate.
LOWEST_QUALITY_FACTOR = 0.5
SETTINGS = {
    setting.key: setting
    for setting in (
        Setting("free_frequency_khz", "90", unit="kHz"),
        Setting("quality_factor", "40 (or 40 +- 2)", lowest=LOWEST_QUALITY_FACTOR, error="maybe"),
        Setting("mass_ng", unit="ng"),
        Setting("tip_calibration", "1 +- 0.02", error="always"),
        Setting("drive_calibration", "1 +- 0.02", error="always"),
        Setting("offset_origin_nm", "0 +- 0.3", lowest=float("-inf"), error="always"),
    )
}
CALIBRATION = tuple(key for key, setting in SETTINGS.items() if setting.error == "always")
"""Keys that must have an error: without one there is nothing uncertain about them."""


@dataclass(frozen=True)
class Header:
    """What the comment lines say; the names and units are those of ``AmplitudeTable``."""

    free_frequency_khz: float
    quality_factor: float | None
    quality_factor_error: float | None
    mass_ng: float
    calibration: dict[str, tuple[float, float]]
    remarks: tuple[str, ...]


def parse_comments(comments: list[tuple[int, str]], faults: Faults) -> Header:
    """Read the comment lines of a table.

    Args:
        comments: line number and text (without the number sign, stripped) of each.
        faults: where the faults are noted; with any, the result is not to be used.
    """
    numbers: dict[str, tuple[float, float | None]] = {}
    seen: dict[str, int] = {}
    remarks: list[str] = []
    for line, text in comments:
        setting = setting_in(text, SETTINGS)
        if setting is None:
            remarks.append(text)
        elif setting.key in seen:
            faults.add(f"{setting.key} was given in line {seen[setting.key]} already; remove one of the two", line=line)
        else:
            seen[setting.key] = line
            numbers[setting.key] = parse_setting(setting, text, line=line, faults=faults) or (float("nan"), None)
    if "free_frequency_khz" not in seen:
        example = SETTINGS["free_frequency_khz"].line
        faults.add(f"the free frequency is missing; add a line such as '{example}' above the column names")
    quality_factor, quality_factor_error = numbers.get("quality_factor", (None, None))
    return Header(
        free_frequency_khz=numbers.get("free_frequency_khz", (float("nan"), None))[0],
        quality_factor=quality_factor,
        quality_factor_error=quality_factor_error,
        mass_ng=numbers.get("mass_ng", (1.0, None))[0],
        calibration={key: (numbers[key][0], numbers[key][1] or 0.0) for key in CALIBRATION if key in numbers},
        remarks=tuple(remarks),
    )
