"""The law of a fit as a function of its unknowns: rebound speed and delay over the approach speed, with derivatives.

A formula times a smooth function (`FormulaLaw`), or a contact (`ContactLawModel`, in `fitting.predict.contact`): both
give w^2 and the delay without its leads, T, at any speed, and the table that orbits are computed from.

    w^2 = u^2 - [(1 - r^2) u^2 + c sqrt(u^2 + q) + epsilon] exp(L(ln u))
    T = a u^(-1/5) - d/u - P(ln u)/u,    tau = T - b (1/w - 1/u) + f (1/w^2 - 1/u^2)

L and P are Gaussian processes, whose values are unknowns with priors N(0, 1); q and f too have priors of a width
that full contacts say. The unknowns of losses are 1 - r^2, c and ln epsilon (epsilon itself where impacts are
instantaneous, for there it may vanish); of the delay ln a, b and d.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from afm_jax.impact.law import BRIDGE_NM, ImpactLaw
from afm_jax.impact.law_table import EXCESS, LawTable, table_of
from fitting.parameters import DELAY_SHAPE, LOSS_SHAPE

LOSS_SPEED_SQUARED = 110.0, 60.0
"""q in nm^2/us^2 of a tip of 1 ng and its standard error: free fits of contacts' laws give 96 to 125, a wet one 234."""
_SQUARE_PER_LEAD, _LEAST_SQUARE = 2.0, 2.0
"""f over the lead b in nm/us, and its standard error; the least that this is, in nm^2/us."""
_FASTEST, _SLOWEST = 1e5, 1e-3
"""Speeds in nm/us between which the capture speed is looked for."""


class Process(NamedTuple):
    """A smooth function of ln u of the loss, as a share of it, and one of the path that the delay stands for.

    Attributes:
        share: standard deviation of the first.
        path_nm: that of the second.
        length: correlation length in ln u.
        apart: distance of the knots.
    """

    share: float
    path_nm: float
    length: float
    apart: float


SMOOTH = Process(0.07, 0.03, 0.8, 0.4)
"""What laws of a few numbers lack: measured on full contacts."""


def of_short_range(share: float) -> Process:
    """Return the process that takes in bumps of a share of the loss."""
    return Process(share, 0.1 * share, 0.25, 0.15)


class LawAt(NamedTuple):
    """A law at n speeds: w^2 in nm^2/us^2, T in us, and their derivatives by the k unknowns of the law."""

    square: Float[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]
    square_slope: Float[np.ndarray, "n k"]
    time_slope: Float[np.ndarray, "n k"]


class LawModel(ABC):
    """What a fit asks of its law; `theta` are the values of its unknowns, in the order of `names`.

    Attributes:
        own: the parameters that are fitted, by their names in reports; their unknowns come first.
        names: all unknowns; those that are not of `own` have priors N(0, 1).
        lasting: impacts take time.
        length_nm: length over which a leaving tip keeps its energy.
    """

    own: tuple[str, ...]
    names: Any
    lasting: bool
    length_nm: Any

    @abstractmethod
    def value_of(self, name: str, unknown: Any) -> Any:
        """Return a parameter's value for its unknown."""

    @abstractmethod
    def unknown_of(self, name: str, value: Any) -> Any:
        """Return the unknown for a parameter's value."""

    @abstractmethod
    def slope_of(self, name: str, unknown: float) -> float:
        """Return d value/d unknown of a parameter."""

    @abstractmethod
    def values(self, theta: Float[np.ndarray, " k"]) -> dict[str, float]:
        """Return the parameters by name."""

    @abstractmethod
    def at(self, theta: Float[np.ndarray, " k"], u: Float[np.ndarray, " n"]) -> LawAt:
        """Return the law at approach speeds in nm/us."""

    @abstractmethod
    def coefficients(self, theta: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " 4"], Float[np.ndarray, "4 k"]]:
        """Return a, b, d and f of the delay, and their derivatives by the unknowns."""

    @abstractmethod
    def capture(self, theta: Float[np.ndarray, " k"]) -> float:
        """Return the capture speed in nm/us."""

    @abstractmethod
    def table(self, theta: Float[np.ndarray, " k"]) -> LawTable | ImpactLaw:
        """Return what orbits are computed from: the table, or where impacts are instantaneous the formula."""

    def misses_accuracy(
        self, theta: Float[np.ndarray, " k"], approach: Float[np.ndarray, " rows"]
    ) -> Bool[np.ndarray, " rows"]:
        """Say at which approach speeds in nm/us a law that is computed misses its accuracy."""
        del theta
        return np.zeros(approach.shape, bool)

    def capture_slope(self, theta: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Return the derivatives of the capture speed by the unknowns: where w^2 vanishes."""
        ends = self.capture(theta) * np.array([1.0 - 1e-5, 1.0, 1.0 + 1e-5])
        edge = self.at(theta, ends)
        return -edge.square_slope[1] * (ends[2] - ends[0]) / (edge.square[2] - edge.square[0])


@dataclass(frozen=True)
class FormulaLaw(LawModel):
    """A formula, with smooth functions beside it or without.

    Attributes:
        own: the formula's parameters that are unknown, by their names in reports.
        fixed: values of others of them; what is in neither is lossless.
        mass_ng: of the tip: what a bridge does to speeds goes with its inverse square root.
        speeds: slowest and fastest approach in nm/us that the smooth functions reach to; None: there are none.
        processes: the smooth functions.
        lasting: impacts take time; if not, there are no delay and no smooth functions.
    """

    own: tuple[str, ...]
    fixed: Mapping[str, float] = field(default_factory=dict)
    mass_ng: float = 1.0
    speeds: tuple[float, float] | None = None
    processes: tuple[Process, ...] = ()
    lasting: bool = True
    length_nm: float = BRIDGE_NM

    def value_of(self, name: str, unknown: Any) -> Any:
        """Return a parameter's value for its unknown, NumPy's or JAX's."""
        if name == "r":
            return (1.0 - unknown) ** 0.5
        return np.exp(unknown) if self._logarithmic(name) else unknown

    def unknown_of(self, name: str, value: Any) -> Any:
        """Return the unknown for a parameter's value."""
        if name == "r":
            return 1.0 - value**2
        return np.log(value) if self._logarithmic(name) else value

    def slope_of(self, name: str, unknown: float) -> float:
        """Return d value/d unknown of a parameter."""
        if name == "r":
            return -0.5 / self.value_of(name, min(unknown, _MOST_LOST))
        return self.value_of(name, unknown) if self._logarithmic(name) else 1.0

    def _logarithmic(self, name: str) -> bool:
        return self.lasting and name in ("epsilon", "delay_hertz")

    def beside(self, speeds: tuple[float, float], *processes: Process) -> "FormulaLaw":
        """Return the formula with smooth functions between speeds in nm/us."""
        return replace(self, speeds=(0.5 * speeds[0], 1.2 * speeds[1]), processes=processes)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The unknowns: of the formula, then with priors N(0, 1) the shapes and the values of the smooth functions."""
        if not self.processes:
            return self.own
        shapes = [LOSS_SHAPE] if "viscous_loss" in (*self.own, *self.fixed) else []
        shapes += [DELAY_SHAPE] if "delay_lead_nm" in (*self.own, *self.fixed) else []
        count = sum(knots.size for knots, _ in self._roots)
        smooth = [f"{kind}_{i}" for kind in ("loss", "path") for i in range(count)]
        return (*self.own, *shapes, *smooth)

    @cached_property
    def _roots(self) -> list[tuple[Float[np.ndarray, " knots"], Float[np.ndarray, "knots knots"]]]:
        """Knots in ln u of each process, and the Cholesky factor of their correlations."""
        assert self.speeds is not None  # noqa: S101
        low, high = np.log(self.speeds)
        roots = []
        for process in self.processes:
            knots = low + process.apart * np.arange(int(np.ceil((high - low) / process.apart)) + 1)
            related = np.exp(-0.5 * ((knots[:, None] - knots) / process.length) ** 2)
            roots.append((knots, np.linalg.cholesky(related + 1e-8 * np.eye(knots.size))))
        return roots

    def _smooth(self, u: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
        """Return what the smooth functions' values do to the logarithm of the loss, and to the path in nm."""
        shapes, place = [], np.log(u)
        for process, (knots, root) in zip(self.processes, self._roots, strict=True):
            related = np.exp(-0.5 * ((knots[:, None] - place) / process.length) ** 2)
            shapes.append(np.linalg.solve(root, related).T)
        of_loss = [process.share * shape for process, shape in zip(self.processes, shapes, strict=True)]
        of_path = [process.path_nm * shape for process, shape in zip(self.processes, shapes, strict=True)]
        return np.concatenate(of_loss, axis=1), np.concatenate(of_path, axis=1)

    def _place(self, name: str) -> int | None:
        return self.names.index(name) if name in self.names else None

    def values(self, theta: Float[np.ndarray, " k"]) -> dict[str, float]:
        """Return the formula's parameters by name, and q and f where they are unknown."""
        known = dict(zip(self.names, theta.tolist(), strict=True))
        values = {"r": 1.0, "epsilon": 0.0, "viscous_loss": 0.0} | dict(self.fixed)
        for name in self.own:
            values[name] = float(self.value_of(name, min(known[name], _MOST_LOST) if name == "r" else known[name]))
        q, width = LOSS_SPEED_SQUARED
        values[LOSS_SHAPE] = values[DELAY_SHAPE] = 0.0
        if self.processes:
            values[LOSS_SHAPE] = q / self.mass_ng * float(np.exp(width / q * known.get(LOSS_SHAPE, 0.0)))
            mean, width = self._lead_square(values)
            values[DELAY_SHAPE] = mean + width * known.get(DELAY_SHAPE, 0.0)
        return values

    def _lead_square(self, values: Mapping[str, float]) -> tuple[float, float]:
        """Return mean and width of the prior of f in nm^2/us."""
        slower = self.mass_ng**-0.5
        mean = slower * _SQUARE_PER_LEAD * values.get("delay_lead_nm", 0.0)
        return mean, max(abs(mean), slower * _LEAST_SQUARE)

    def at(self, theta: Float[np.ndarray, " k"], u: Float[np.ndarray, " n"]) -> LawAt:
        """Return the law at approach speeds in nm/us."""
        values, count = self.values(theta), len(self.names)
        square_slope, time_slope = np.zeros((u.size, count)), np.zeros((u.size, count))
        raised = np.sqrt(u**2 + values[LOSS_SHAPE])
        loss = (1.0 - values["r"] ** 2) * u**2 + values["viscous_loss"] * raised + values["epsilon"]
        path = np.zeros_like(u)
        grown = np.ones_like(u)
        if self.processes:
            of_loss, of_path = self._smooth(u)
            first = self.names.index("loss_0")
            middle = first + of_loss.shape[1]
            grown = np.exp(np.clip(of_loss @ theta[first:middle], -3.0, 3.0))
            path = of_path @ theta[middle:]
            square_slope[:, first:middle] = -(loss * grown)[:, None] * of_loss
            time_slope[:, middle:] = -of_path / u[:, None]
        hertz, offset = values.get("delay_hertz", 0.0), values.get("delay_offset_nm", 0.0)
        columns = {
            "r": -(u**2), "viscous_loss": -raised,
            "epsilon": np.full_like(u, -values["epsilon"] if self.lasting else -1.0),
            LOSS_SHAPE: -values["viscous_loss"] * 0.5 * values[LOSS_SHAPE] / raised * _Q_WIDTH,
        }  # fmt: skip
        for name, column in columns.items():
            place = self._place(name)
            if place is not None:
                square_slope[:, place] = column * grown
        for name, column in {"delay_hertz": hertz * u**-0.2, "delay_offset_nm": -1.0 / u}.items():
            place = self._place(name)
            if place is not None:
                time_slope[:, place] = column
        return LawAt(u**2 - loss * grown, hertz * u**-0.2 - (offset + path) / u, square_slope, time_slope)

    def coefficients(self, theta: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " 4"], Float[np.ndarray, "4 k"]]:
        """Return a, b, d and f of the delay, and their derivatives by the unknowns."""
        values, slope = self.values(theta), np.zeros((4, len(self.names)))
        found = [values.get(name, 0.0) for name in ("delay_hertz", "delay_lead_nm", "delay_offset_nm", DELAY_SHAPE)]
        changes = {"delay_hertz": found[0], "delay_lead_nm": 1.0, "delay_offset_nm": 1.0}
        for row, (name, change) in enumerate(changes.items()):
            place = self._place(name)
            if place is not None:
                slope[row, place] = change
        shape, lead = self._place(DELAY_SHAPE), self._place("delay_lead_nm")
        if shape is not None:
            mean, width = self._lead_square(values)
            slope[3, shape] = width
            if lead is not None:
                rate = self.mass_ng**-0.5 * _SQUARE_PER_LEAD
                slope[3, lead] = rate + (np.sign(mean) * rate * theta[shape] if width == abs(mean) else 0.0)
        return np.array(found), slope

    def capture(self, theta: Float[np.ndarray, " k"]) -> float:
        """Return the speed in nm/us up to which the tip is captured: the fastest root of w^2."""
        grid = np.geomspace(_SLOWEST, _FASTEST, 400)
        stays = np.flatnonzero(self.at(theta, grid).square <= 0.0)
        if not stays.size or stays[-1] == grid.size - 1:
            return float(grid[0] if not stays.size else grid[-1])
        low, high = grid[stays[-1]], grid[stays[-1] + 1]
        while high - low > 1e-13 * high:
            grid = np.linspace(low, high, 33)
            # in the last digit the end may be a root itself
            leaves = int(np.append(np.flatnonzero(self.at(theta, grid).square > 0.0), grid.size - 1)[0])
            low, high = grid[max(leaves - 1, 0)], grid[leaves]
        return float(high)

    def table(self, theta: Float[np.ndarray, " k"]) -> LawTable | ImpactLaw:
        """Return the table, or where impacts are instantaneous the formula."""
        if not self.lasting:
            values = self.values(theta)
            return jax.tree.unflatten(_structure(), [np.asarray(values[name]) for name in _INSTANTANEOUS])
        capture = self.capture(theta)
        found = self.at(theta, np.hypot(capture, EXCESS))
        kept = self.values(theta)["r"] ** 2
        return table_of(capture, found.square, found.time, self.coefficients(theta)[0], self.length_nm, kept)


_INSTANTANEOUS = ("r", "epsilon", "viscous_loss")


@cache
def _structure() -> Any:
    """Return how the numbers of an impact law lie in it: to make one anew takes a millisecond."""
    return jax.tree.structure(ImpactLaw(1.0, 1.0, 1.0))


_Q_WIDTH = LOSS_SPEED_SQUARED[1] / LOSS_SPEED_SQUARED[0]
_MOST_LOST = 1.0 - 1e-4
"""1 - r^2 at most."""
