"""Bins of height: curves whose heights repeat or are not in order, as rows that a table can hold.

A bin's row is the mean of the readings in it. Its error is their scatter about the line through the means, pooled with
that of the neighbouring bins, over the root of their number: in contact readings scatter more than those of the free
tip, because the height does.
"""

import numpy as np
from jaxtyping import Float, Int

Rows = Float[np.ndarray, " rows"]
Bins = Float[np.ndarray, " bins"]
Places = Int[np.ndarray, " rows"]
_ROWS = 5
"""Rows in a bin of the usual width, at least; as many are needed for a scatter of their own."""
_NEIGHBOURS = 4


def ways_of(offset_nm: Rows, branch: np.ndarray) -> dict[str, Float[np.ndarray, " some"]]:
    """Return the heights of each branch, in the order of the rows."""
    return {name: offset_nm[branch == name] for name in dict.fromkeys(branch.tolist())}


def faults_of_order(offset_nm: Rows, branch: np.ndarray) -> tuple[int, int]:
    """Return how many rows repeat a height of their branch, and how many step back against its direction."""
    ways = ways_of(offset_nm, branch).values()
    back = sum(int(np.sum(np.diff(way) * np.sign(way[-1] - way[0]) < 0.0)) for way in ways)
    return sum(len(way) - len(np.unique(way)) for way in ways), back


def usual_width(offset_nm: Rows, branch: np.ndarray) -> float:
    """Return the width in nm of bins for a curve whose heights repeat or are not in order.

    The width is that of five rows, or of a 200th of them; 0 (only rows of equal height are merged) for fewer than 100.
    """
    ways = [way for way in ways_of(offset_nm, branch).values() if len(way) >= 100]
    return max((float(np.ptp(way)) * max(_ROWS / len(way), 1.0 / 200) for way in ways), default=0.0)


def binned(
    offset_nm: Rows,
    readings: dict[str, Rows],
    branch: np.ndarray,
    width_nm: float,
    single: dict[str, float],
) -> tuple[dict[str, np.ndarray], bool]:
    """Return the rows of a table, a bin of height each, and whether they stand as they were passed.

    A row has the mean height `offset_nm`, every reading's mean and error, and `retract`, 1 or 0.

    Args:
        offset_nm: heights.
        readings: what was read there, by name.
        branch: "approach" or "retract" of each row.
        width_nm: of a bin; 0: rows of equal height are merged.
        single: standard error of a single reading, by name; what a row of equal heights has for an error, over the
            root of their number.
    """
    columns: dict[str, list[np.ndarray]] = {}
    in_order = True
    for name in dict.fromkeys(branch.tolist()):
        rows = np.flatnonzero(branch == name)
        rows = rows[np.argsort(offset_nm[rows], kind="stable")]
        height = offset_nm[rows]
        number = np.floor((height - height[0]) / width_nm) if width_nm > 0.0 else height
        _, place, counts = np.unique(number, return_inverse=True, return_counts=True)
        time = _means(place, rows.astype(float))
        spread = np.sqrt(np.maximum(_means(place, (rows - time[place]) ** 2.0), 0.0))
        # rows of a bin that are spread over more than a tenth of the branch are of several ramps
        in_order &= bool(np.median(spread) <= 0.1 * len(rows) + 1.0)
        found = {"offset_nm": _means(place, height), "retract": np.full(len(counts), float(name == "retract"))}
        for key, values in readings.items():
            means, error = _means(place, values[rows]), single[key] / np.sqrt(counts)
            if width_nm > 0.0:
                scatter = _scatter(height, values[rows], place) / np.sqrt(counts)
                # rows without any scatter (a resolution that is coarser than the noise) have that of the free tip
                error = np.where(scatter > 0.0, scatter, error)
            # `phase_lag_error_deg` of `phase_lag_deg`
            stem, _, unit = key.rpartition("_")
            found |= {key: means, f"{stem}_error_{unit}": error}
        for key, column in found.items():
            columns.setdefault(key, []).append(column[:: 1 if name == "approach" else -1])
    return {key: np.concatenate(parts) for key, parts in columns.items()}, in_order


def _means(place: Places, values: Rows) -> Bins:
    """Return the mean of the values in each place."""
    return np.bincount(place, values) / np.bincount(place)


def _scatter(height: Rows, values: Rows, place: Places) -> Bins:
    """Return the scatter of single readings about the line through the bins' means, in each bin and its neighbours."""
    line = np.interp(height, _means(place, height), _means(place, values))
    squares = np.bincount(place, (values - line) ** 2)
    window = np.ones(2 * _NEIGHBOURS + 1)
    pooled, freedom = (
        np.convolve(column, window)[_NEIGHBOURS:-_NEIGHBOURS] for column in (squares, np.bincount(place) - 1.0)
    )
    return np.sqrt(pooled / np.maximum(freedom, 1.0))
