"""What can be driven: the grid of drives among which an experiment is designed."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Shaped

from fitting.simulated.simulated_motion import Drives

MOST = 20_000
"""Drives that a design looks at: some minutes of computing."""
Numbers = Sequence[int | float] | Shaped[np.ndarray, " n"]


def drive_grid(
    *,
    orders: Numbers,
    amplitudes_nm: Numbers,
    offsets_nm: Numbers = (0.0,),
    frequencies_khz: Numbers | None = None,
    detunings: Numbers | None = None,
    free_frequency_khz: float | None = None,
) -> Drives:
    """Return every combination of what can be driven, each once.

    Args:
        orders: N, drive periods per impact.
        amplitudes_nm: of the platform.
        offsets_nm: mean heights of the platform above the tip's rest position.
        frequencies_khz: of the drive, the same for every order; or
        detunings: drive frequencies as multiples of each order's resonance 2 N f0, with
        free_frequency_khz: f0.

    Raises:
        ValueError: if a list is empty or a number impossible, not exactly one of both kinds of frequency is given, or
            there are too many combinations.
    """
    _check_list("orders", orders, positive=True)
    if any(order != int(order) for order in orders):
        raise ValueError(f"`orders` must hold whole numbers, but is {list(orders)}")
    _check_list("amplitudes_nm", amplitudes_nm, positive=True)
    _check_list("offsets_nm", offsets_nm, positive=False)
    if (frequencies_khz is None) == (detunings is None):
        raise ValueError("give either `frequencies_khz` or `detunings`, what the drive frequency can be")
    for name, numbers in (("frequencies_khz", frequencies_khz), ("detunings", detunings)):
        if numbers is not None:
            _check_list(name, numbers, positive=True)
    rows = [
        (order, frequency, amplitude, offset)
        for order in map(int, orders)
        for frequency in _frequencies(order, frequencies_khz, detunings, free_frequency_khz)
        for amplitude in amplitudes_nm
        for offset in offsets_nm
    ]
    rows = list(dict.fromkeys((order, *map(float, rest)) for order, *rest in rows))
    if len(rows) > MOST:
        raise ValueError(f"these are {len(rows)} drives, more than the {MOST} a design looks at; take coarser steps")
    columns = np.array(rows, float).T
    return Drives(columns[0].astype(np.int64), *columns[1:])


def same_drives(drives: Drives, others: Float[np.ndarray, "others 4"]) -> np.ndarray:
    """Say which drives are among others, given as rows of order, frequency, amplitude and offset."""
    known = {_key(row) for row in others.tolist()}
    return np.array([_key(row) in known for row in zip(*(column.tolist() for column in drives), strict=True)])


def _key(row: Sequence[int | float]) -> tuple[float, ...]:
    """Return a drive as rounding cannot change it: an instrument sets nothing to twelve digits."""
    return tuple(float(f"{number:.9g}") + 0.0 for number in row)


def _frequencies(
    order: int,
    frequencies_khz: Numbers | None,
    detunings: Numbers | None,
    free_frequency_khz: float | None,
) -> list[float]:
    if detunings is None:
        return [] if frequencies_khz is None else [float(frequency) for frequency in frequencies_khz]
    if free_frequency_khz is None:
        raise ValueError("`detunings` need `free_frequency_khz`, the cantilever's resonance")
    # Rounded to what an instrument is told: a thousandth of a hertz.
    return [round(2.0 * order * free_frequency_khz * detuning, 6) for detuning in detunings]


def _check_list(name: str, numbers: Numbers, *, positive: bool) -> None:
    if len(numbers) == 0:
        raise ValueError(f"`{name}` is empty; give at least one number")
    for number in numbers:
        if not np.isfinite(number) or (positive and number <= 0.0):
            raise ValueError(f"`{name}` must hold {'positive' if positive else 'finite'} numbers, but one is {number}")
