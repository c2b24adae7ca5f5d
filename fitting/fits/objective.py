"""The objective, chi2 of a table and a model, and its minimisation from several starts at once by Optax's L-BFGS.

Compilation is what a fit from the command line waits for, so one program alone contains the forward model: residuals
with their Jacobian for a handful of parameter sets at once (`forward.linearise`). The screening, the polish, the checks
and the profile intervals all drive it from outside.
"""

from dataclasses import KW_ONLY, dataclass, field, fields, replace
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from jaxtyping import Bool, Float, Int

from afm_jax.solve.lanes import compiled_quickly, filled
from fitting.forward import BATCH, Linearised, linearise
from fitting.models import Measurement, Problem
from fitting.parameters import is_of_one_table

SOFT = 5.0
"""Residual, in errors, beyond which the screening and the first polish count a row linearly (soft-l1)."""
ROBUST = 2.0
"""The same for a fit with robust loss."""
OUTLIER, MOST_OUTLIERS = 4.0, 0.1
"""Residual in errors from which a row is an outlier; and the share of rows that a robust fit may call so (one row it
always may): more are a wrong model, not mishaps."""
PLAIN = np.inf
"""The same for plain least squares: no residual gets there."""
ROUGH, FINE = 1e-2, 1e-10
"""Estimated distances to the minimum at which a soft and a plain polish stop."""
_MAX_STEPS = 60
_SEARCHES_KEPT = 4
_LBFGS = optax.lbfgs(learning_rate=1.0, linesearch=None, scale_init_precond=False)
_init, _update = (compiled_quickly(level=0)(jax.vmap(part)) for part in (_LBFGS.init, _LBFGS.update))


class Polished(NamedTuple):
    """Where the polish of each start ended: coordinates (starts, p), objective (starts,), and the steps taken."""

    coordinates: Float[np.ndarray, "starts p"]
    objective: Float[np.ndarray, " starts"]
    steps: int


def soft_square(residual: Float[np.ndarray, "..."], softness: float) -> Float[np.ndarray, "..."]:
    """Return 2 s^2 (sqrt(1 + x^2/s^2) - 1), which is x^2 for infinite s; written so that nothing cancels."""
    square = residual**2
    return 2.0 * square / (1.0 + np.sqrt(1.0 + square / softness**2))


def lowest(objective: Float[np.ndarray, " points"]) -> int:
    """Return where an objective is smallest; one that is not a number is larger than any other."""
    return int(np.argmin(np.where(np.isnan(objective), np.inf, objective)))


@dataclass(eq=False)
class Objective:
    """The objective of a table and a model in optimiser coordinates, with its gradient, for up to `BATCH` sets.

    Attributes:
        measurement: what predictions are compared with.
        problem: the model.
        near: coordinates of the rows' orbits from which they are followed, the same for every set of values or each
            set's own; None: searched for.
        robust: let outliers count linearly, everywhere: residuals are then such that their squares add up to the soft
            objective.
        searched: what searches at single sets of values have found, for objectives of the same rows: the same set is
            asked for again and again.
    """

    measurement: Measurement
    problem: Problem
    _: KW_ONLY
    near: Float[np.ndarray, " rows"] | Float[np.ndarray, "sets rows"] | None = None
    robust: bool = False
    searched: dict[bytes, Linearised] = field(default_factory=dict)

    def _with(self, **changes: Any) -> "Objective":
        """Return an objective with some attributes changed; what was searched for is kept where the rows stay."""
        parts = {known.name: getattr(self, known.name) for known in fields(Objective)}
        return Objective(**(parts | changes))

    def following(self, values: Float[np.ndarray, " p"]) -> "Objective":
        """Return the objective with orbits followed from those at a set of values; only if impacts last."""
        near = self.following_each(values[None]).near
        return self if near is None else self._with(near=near[0])

    def following_each(self, values: Float[np.ndarray, "sets p"]) -> "Objective":
        """Return the objective for as many sets of values, each set's orbits followed from those at its values."""
        if not self.problem.lasting:
            return self
        found = self.searching().at_values(values).prediction
        return self._with(near=np.where(np.asarray(found.orbits) > 0, np.asarray(found.coordinate), np.nan))

    def searching(self) -> "Objective":
        """Return the objective with every orbit searched for."""
        return self._with(near=None)

    def with_rows(self, **columns: Any) -> "Objective":
        """Return the objective with some columns of its rows changed."""
        rows = self.measurement.rows._replace(**{name: np.asarray(column) for name, column in columns.items()})
        return self._with(measurement=self.measurement._replace(rows=rows), searched={})

    def of_rows(self, chosen: Int[np.ndarray, " chosen"] | Bool[np.ndarray, " rows"]) -> "Objective":
        """Return the objective of some of the rows, with their orbits followed if they were before."""
        rows = jax.tree.map(lambda column: np.asarray(column)[chosen], self.measurement.rows)
        near = None if self.near is None else np.asarray(self.near)[..., chosen]
        return self._with(measurement=self.measurement._replace(rows=rows), near=near, searched={})

    def by_instrument(self) -> list[tuple[Bool[np.ndarray, " rows"], "Objective"]]:
        """Return which rows are of each head and drive, and the objective of these; all of them of one table."""
        joint, table = self.measurement.joint, self.measurement.rows.table
        if joint is None or table is None:
            return [(np.ones(len(self.measurement.rows.order), dtype=bool), self)]
        heads = [
            (drive, float(head.frequency_khz), None if head.quality_factor is None else float(head.quality_factor))
            for drive, head in zip(joint.drives, joint.cantilevers, strict=True)
        ]
        parts = []
        for head in dict.fromkeys(heads):
            mine = np.array([other == head for other in heads])[table]
            part = self if mine.all() else self.of_rows(mine)
            measurement = part.measurement._replace(cantilever=joint.cantilevers[heads.index(head)])
            problem = replace(self.problem, drive=head[0])
            parts.append((mine, part._with(measurement=measurement, problem=problem)))  # noqa: SLF001
        return [part for part in parts if part[0].any()]

    def of_common_parameters(self) -> "Objective | None":
        """Return the objective with the nuisances held that one of several tables has to itself; None without such."""
        names, joint = self.problem.names, self.measurement.joint
        count = sum(not is_of_one_table(name) for name in names)
        if joint is None or count == len(names):
            return None
        value, error = np.asarray(self.measurement.constraint_value), np.asarray(self.measurement.constraint_error)
        own = joint.place >= count
        held = replace(joint, place=np.where(own, -1, joint.place), held=np.where(own, value[joint.place], joint.held))
        measurement = self.measurement._replace(
            constraint_value=value[:count], constraint_error=error[:count], joint=held
        )
        problem = replace(self.problem, names=names[:count])
        return self._with(measurement=measurement, problem=problem, near=None, searched={})

    def at_values(self, values: Float[np.ndarray, "sets p"]) -> Linearised:
        """Return the linearised model at parameter values, as NumPy arrays."""
        if self.near is None and len(values) == 1:
            return self._searched_at(values)
        return self._linearised(values)

    def _searched_at(self, values: Float[np.ndarray, "1 p"]) -> Linearised:
        """Return what a search at one set of values finds, or has found lately."""
        key = values.tobytes()
        if key not in self.searched:
            found = self._linearised(values)
            while len(self.searched) >= _SEARCHES_KEPT:
                del self.searched[next(iter(self.searched))]
            self.searched[key] = found
        return self.searched[key]

    def _linearised(self, values: Float[np.ndarray, "sets p"]) -> Linearised:
        parts = [
            linearise(values[i : i + BATCH], self.measurement, self.problem, self._near(slice(i, i + BATCH)))
            for i in range(0, len(values), BATCH)
        ]
        result: Linearised = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts) if parts[1:] else parts[0]
        if not self.robust:
            return result
        residual, slope = softened(np.asarray(result.residual))
        return result._replace(residual=residual, jacobian=np.asarray(result.jacobian) * slope[:, :, None])

    def _near(self, sets: slice) -> Float[np.ndarray, "..."] | None:
        """Return where the orbits of some of the sets are followed from."""
        return self.near[sets] if self.near is not None and self.near.ndim > 1 else self.near

    def amplitude_residuals(self, values: Float[np.ndarray, " p"]) -> Float[np.ndarray, "rows k"]:
        """Return the residuals of the readings at one set of values, as they are."""
        return self.misfit(self.at_values(values[None]))

    def misfit(self, linear: Linearised) -> Float[np.ndarray, "rows k"]:
        """Return the plain residuals of the readings that the first set of a linearised model predicts."""
        rows = self.measurement.rows
        apart = np.asarray(linear.prediction.amplitude_nm)[0] - np.asarray(rows.amplitude_nm)
        return np.where(np.asarray(rows.measured), apart / np.asarray(rows.error_nm), 0.0)

    def residual(self, values: Float[np.ndarray, "sets p"]) -> Float[np.ndarray, "sets n"]:
        """Return the residuals at parameter values."""
        return np.asarray(self.at_values(values).residual)

    def linearise(
        self, coordinates: Float[np.ndarray, "sets p"]
    ) -> tuple[Float[np.ndarray, "sets n"], Float[np.ndarray, "sets n p"]]:
        """Return residuals and their Jacobian by the coordinates."""
        values, slopes = self.problem.values_and_slopes(coordinates)
        result = self.at_values(values)
        return np.asarray(result.residual), np.asarray(result.jacobian) * slopes[:, None, :]

    def screen(self, values: Float[np.ndarray, "points p"]) -> Float[np.ndarray, " points"]:
        """Return the soft objective at every point of a grid of parameter values."""
        batches = [values[i : i + BATCH] for i in range(0, len(values), BATCH)]
        return np.concatenate([soft_square(self.residual(batch), SOFT).sum(axis=1) for batch in batches])

    def value_and_gradient(
        self, coordinates: Float[np.ndarray, "sets p"], softness: float
    ) -> tuple[Float[np.ndarray, " sets"], Float[np.ndarray, "sets p"]]:
        """Return the soft objective and its gradient by the coordinates."""
        residual, jacobian = self.linearise(coordinates)
        weight = 2.0 * residual / np.sqrt(1.0 + (residual / softness) ** 2)
        return soft_square(residual, softness).sum(axis=1), np.einsum("snp,sn->sp", jacobian, weight)

    def scale(self, coordinates: Float[np.ndarray, "sets p"]) -> Float[np.ndarray, "sets p p"]:
        """Return matrices whose columns are steps of about one standard error each (Gauss-Newton).

        A direction that changes nothing at this point gets at most a large step, not an infinite one; where the slopes
        are not finite, steps are coordinates.
        """
        _, jacobian = self.linearise(coordinates)
        fisher = np.einsum("snp,snq->spq", jacobian, jacobian)
        sound = np.isfinite(fisher).all(axis=(1, 2), keepdims=True)
        curvature, axes = np.linalg.eigh(np.where(sound, fisher, np.eye(fisher.shape[1])))
        largest = np.maximum(curvature[:, -1:], 1e-12)
        return axes / np.sqrt(np.maximum(curvature, 1e-8 * largest))[:, None, :]


def polish(
    objective: Objective,
    starts: Float[np.ndarray, "starts p"],
    softness: float,
    *,
    settled: float,
    most: int = _MAX_STEPS,
) -> Polished:
    """Minimise from every start at once by optax's L-BFGS, steps halved until they descend (Armijo).

    Args:
        objective: what to minimise.
        starts: optimiser coordinates, at most `BATCH` of them.
        softness: residual in errors beyond which rows count linearly; `PLAIN` for least squares.
        settled: estimated distance of the objective to its minimum at which a start is done.
        most: steps at most.
    """
    scale = objective.scale(starts)

    def evaluate(z):
        """Return the objective and half its gradient in units of standard errors, where its Hessian is about 2."""
        value, gradient = objective.value_and_gradient(starts + np.einsum("spq,sq->sp", scale, z), softness)
        return value, np.einsum("spq,sp->sq", scale, gradient) / 2.0

    z = np.zeros_like(starts)
    value, gradient = evaluate(z)
    step, state = _lbfgs(gradient, None, z)
    step, share = _descending(step, gradient), np.ones(len(z))
    count = 0
    while count < most and np.any((_squared(gradient) > settled) & (share > 1e-9)):
        count += 1
        trial = z + share[:, None] * step
        new_value, new_gradient = evaluate(trial)
        accepted = new_value <= value + 2e-4 * share * np.einsum("sp,sp->s", gradient, step)
        kept = accepted[:, None]
        z, gradient = np.where(kept, trial, z), np.where(kept, new_gradient, gradient)
        value, share = np.where(accepted, new_value, value), np.where(accepted, 1.0, 0.5 * share)
        new_step, new_state = _lbfgs(gradient, state, z)
        state = _choose(accepted, new_state, state)
        step = np.where(kept, _descending(new_step, gradient), step)
    return Polished(starts + np.einsum("spq,sq->sp", scale, z), value, count)


def softened(
    residual: Float[np.ndarray, "sets n"],
) -> tuple[Float[np.ndarray, "sets n"], Float[np.ndarray, "sets n"]]:
    """Return residuals whose squares are the soft squares, and their slope by the plain ones."""
    root = np.sqrt(1.0 + (residual / ROBUST) ** 2)
    shrunk = np.sqrt(2.0 / (1.0 + root))
    return residual * shrunk, np.where(residual == 0.0, 1.0, 1.0 / (root * shrunk))


def _lbfgs(
    gradient: Float[np.ndarray, "sets p"], state: optax.OptState | None, z: Float[np.ndarray, "sets p"]
) -> tuple[Float[np.ndarray, "sets p"], optax.OptState]:
    """Return optax's L-BFGS step of every set and its new state; no state: the first step."""
    count = len(z)
    # always as many sets: one program
    z, gradient = filled(z, BATCH), filled(gradient, BATCH)
    # optax mixes integers of 32 and 64 bits, which strict promotion would refuse.
    with jax.numpy_dtype_promotion("standard"):
        before = jax.tree.map(np.asarray, _init(z)) if state is None else state
        step, after = jax.tree.map(np.asarray, _update(gradient, before, z))
    return step[:count], after


def warm_up_steps(count: int) -> None:
    """Compile the optimiser's step for a number of parameters, or read it from the cache."""
    z = np.zeros((BATCH, count))
    _lbfgs(z, None, z)


def _squared(gradient: Float[np.ndarray, "sets p"]) -> Float[np.ndarray, " sets"]:
    return np.einsum("sp,sp->s", gradient, gradient)


def _descending(
    step: Float[np.ndarray, "sets p"], gradient: Float[np.ndarray, "sets p"]
) -> Float[np.ndarray, "sets p"]:
    """Return L-BFGS steps, or the gradient's where one does not lead downhill; none longer than 30 errors."""
    downhill = np.einsum("sp,sp->s", step, gradient) < 0.0
    step = np.where(downhill[:, None], step, -gradient)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return step * np.minimum(1.0, 30.0 / np.maximum(length, 1e-300))


def _choose(accepted: Bool[np.ndarray, " sets"], new: optax.OptState, old: optax.OptState) -> optax.OptState:
    """Return the new optimiser state where a step was accepted, the old one elsewhere."""

    def one(new_leaf, old_leaf):
        chosen = filled(accepted, len(new_leaf))
        return np.where(chosen.reshape((-1,) + (1,) * (new_leaf.ndim - 1)), new_leaf, old_leaf)

    return jax.tree.map(one, new, old)
