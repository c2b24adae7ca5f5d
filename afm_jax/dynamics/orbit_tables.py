"""The output of `afm-jax orbits`: orbits of one scene as rows of plain numbers and tables, and why there is none.

Takes orbits; gives keys and columns that end in their units (rad, nm, nm/us, us, degrees). The equations are in
`impact/orbits` (eq. 9) and `impact_orbits`.

An orbit of one impact is a row of `SingleImpactOrbits`; an orbit of several impacts lists all of them, the first
one's numbers besides (`orbit_facts`).
"""

from typing import Any

from afm_jax.apparatus.scene import Scene, drive_of
from afm_jax.columns import CsvColumns, columns_of, csv_columns, rows_of
from afm_jax.dynamics.impact_orbits import IMPACT_COLUMNS, ManyImpactOrbits, orbit_facts
from afm_jax.impact.orbits import SingleImpactOrbits
from afm_jax.report import Cell, Section, Table, sections, table_of
from afm_jax.results import ResultTuple, public_result
from afm_jax.saved import as_json
from afm_jax.words import counted

_IMPACT_CELLS: dict[str, Cell] = {
    "phase\nrad": "phase_rad",
    "velocity after\nnm/us": "velocity_after_nm_per_us",
    "approach\nnm/us": "approach_speed_nm_per_us",
    "rebound\nnm/us": "rebound_speed_nm_per_us",
    "delay\nus": "delay_us",
}


@public_result(picture="afm_jax.plots.dynamics:orbits_figure")
class OrbitTable(ResultTuple):
    """The orbits of one scene of order N: of a law's those of one impact, or with `impacts` those of several."""

    scene: Scene
    order: int
    orbits: SingleImpactOrbits | ManyImpactOrbits
    impacts: int | None = None

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The orbits that exist as plain numbers: by rising approach speed, or each with all its impacts."""
        if isinstance(self.orbits, ManyImpactOrbits):
            return [orbit_facts(self.orbits.reading, index) for index in range(len(self.orbits.stable))]
        rows = rows_of({name: getattr(self.orbits, name) for name in self.columns})
        return [row for row, exists in zip(rows, self.orbits.exists.tolist(), strict=True) if exists]

    @property
    def columns(self) -> list[str]:
        """What a row of an orbit says: attributes of orbits of such a scene; of several impacts the first's."""
        if self.impacts is not None:
            return [*IMPACT_COLUMNS, "peak_amplitude_nm", "trace", "determinant", "stable", "admissible"]
        numbers = {name for name, values in vars(self.orbits).items() if values is not None} - {"exists", "complete"}
        return [*IMPACT_COLUMNS, *sorted(numbers - {*IMPACT_COLUMNS})]

    @property
    def reason(self) -> str | None:
        """Why no orbit is admissible, and what to try; None where one is."""
        rows, scene, order = self.rows, self.scene, self.order
        if any(orbit["admissible"] for orbit in rows):
            return None
        if float(getattr(scene.interaction, "r", 1.0)) == 0.0:
            return "with r = 0 every impact is a capture and no orbit leaves; `afm-jax simulate` follows the tip"
        if self.impacts is not None:
            what = f"no orbit of {counted(self.impacts, 'impact')} in {counted(order, 'drive period')} was found"
            return f"{what}, but the search may miss some: `afm-jax simulate` shows what the tip comes to from a start"
        reduced = float(drive_of(scene).angular_frequency) / (2.0 * float(scene.cantilever.angular_frequency))
        nearest = max(1, round(reduced))
        what = f"there is no orbit of order {order}"
        if rows:
            what = f"in every orbit of order {order} the tip would have to pass through the platform"
        if nearest != order:
            return f"{what}; the drive is at {reduced:.4g} times twice the free frequency: try `order={nearest}`"
        return f"{what}; try a larger drive amplitude, another offset or a drive nearer to resonance"

    @property
    def impact_speeds_nm_per_us(self) -> list[float]:
        """Approach speed of each impact of each orbit."""
        return [impact["approach_speed_nm_per_us"] for orbit in self.rows for impact in orbit.get("impacts", [orbit])]


@as_json.register
def _(table: OrbitTable) -> dict[str, Any]:
    orbits = table.orbits
    several = isinstance(orbits, ManyImpactOrbits)
    more = {"impacts": table.impacts} if several else {"complete": orbits.complete}
    return {"order": table.order, "orbits": table.rows} | more


@sections.register
def _(table: OrbitTable) -> list[Section]:
    # where base or force drive with what is read at the drive's frequency
    rows, periods = table.rows, counted(table.order, "drive period")
    if table.impacts is not None:
        return [Section(f"Orbits with {counted(table.impacts, 'impact')} in {periods}", [_impacts_of(rows)])]
    cells: dict[str, Cell] = {**_IMPACT_CELLS, "peak\nnm": "peak_amplitude_nm"}
    if rows and "drive_lockin_amplitude_nm" in rows[0]:
        cells |= {"at drive\nnm": "drive_lockin_amplitude_nm", "at drive\ndeg": "drive_lockin_phase_deg"}
        if "peak_deflection_nm" in rows[0]:
            cells["deflection\nat drive nm"] = "deflection_drive_lockin_amplitude_nm"
        cells["lag\ndeg"] = "phase_lag_deg"
    else:
        cells |= {"lock-in\nnm": "lockin_amplitude_nm", "lock-in\ndeg": "lockin_phase_deg"}
    cells |= {"trace": "trace", "determinant": "determinant", "stable": "stable", "admissible": "admissible"}
    parts: list[Any] = [table_of(cells, rows)]
    if any(orbit["near_double"] for orbit in rows):
        parts.append("Two of them nearly coincide (a fold): derivatives there have no meaning.")
    return [Section(f"Orbits with one impact in {periods}", parts)]


def _impacts_of(orbits: list[dict[str, Any]]) -> Table:
    """Return orbits as a table, a line an impact."""
    rows = [{**orbit, **impact, "orbit": k} for k, orbit in enumerate(orbits) for impact in orbit["impacts"]]
    cells: dict[str, Cell] = {
        "orbit": "orbit:d",
        **_IMPACT_CELLS,
        "peak\nnm": "peak_amplitude_nm",
        "multipliers": lambda row: ", ".join(f"{complex(*z) if z[1] else z[0]:.4g}" for z in row["multipliers"]),
        "stable": "stable",
    }
    return table_of(cells, rows)


@csv_columns.register
def _(table: OrbitTable) -> CsvColumns:
    # a row an orbit; of several impacts also a row an impact
    orbits = table.rows
    if table.impacts is None:
        return {"orbits.csv": columns_of(orbits, table.columns)}
    impacts = [{"orbit": k, **impact} for k, orbit in enumerate(orbits) for impact in orbit["impacts"]]
    return {
        "orbits.csv": columns_of([{**orbit, **orbit["impacts"][0]} for orbit in orbits], table.columns),
        "impacts.csv": columns_of(impacts, ("orbit", *IMPACT_COLUMNS)),
    }
