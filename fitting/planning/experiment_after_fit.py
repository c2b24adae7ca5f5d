"""The belief that a fit leaves: its values, its covariance, and the drives that were measured."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from afm_jax.contact.contact import EFFECTS
from fitting.models import Problem
from fitting.parameters import PARAMETERS
from fitting.planning.experiment_belief import EXACT_QUALITY_FACTOR, UNCERTAINTY, Belief, checked_values
from fitting.result import FitResult


def belief_of_fit(result: FitResult | Mapping[str, Any], uncertainty: float = UNCERTAINTY) -> Belief:
    """Return the belief that a fit leaves: its values, its covariance, and the drives that it used.

    Args:
        result: from `fitting.fit`, or its JSON (`afm-jax fit --json`) as a mapping.
        uncertainty: how far values may be off, relative, where the fit does not say.

    Raises:
        ValueError: if the mapping is no fit, or its correlations are impossible.
    """
    payload = result.to_dict() if isinstance(result, FitResult) else result
    _check_payload(payload)
    found, table, settings = payload["parameters"], payload["input"], payload.get("settings") or {}
    problem = Problem(payload["model"], tuple(found), tuple(settings.get("effects") or EFFECTS))
    columns = ("order", "drive_frequency_khz", "drive_amplitude_nm", "offset_nm")
    notes = []
    if not payload["valid"]:
        reason = " ".join(payload.get("reasons") or ["no reason given."])
        notes.append(f"The fit that the design rests on is not valid: {reason}")
    if table.get("quality_factor") is not None and "quality_factor" not in found:
        notes.append(EXACT_QUALITY_FACTOR)
    return Belief(
        problem=problem,
        values=checked_values(problem, {name: entry["value"] for name, entry in found.items()}),
        information=_information(found, payload["correlations"]["matrix"]),
        free_frequency_khz=float(table["free_frequency_khz"]),
        quality_factor=table.get("quality_factor"),
        mass_ng=float(table.get("mass_ng", 1.0)),
        fixed=dict(settings.get("fixed") or {}),
        uncertainty=uncertainty,
        constraints={
            name: (float(entry["constraint"][0]), float(entry["constraint"][1]))
            for name, entry in found.items()
            if entry.get("constraint")
        },
        measured=np.array([table[name] for name in columns], float).T,
        source=f"fit of {table.get('source', 'a table')}",
        notes=tuple(notes),
    )


def _information(found: Mapping[str, Any], correlations: Sequence[Sequence[float | None]]) -> Float[np.ndarray, "p p"]:
    """Return the Fisher information of a fit: of what it determined, and the constraints on what it did not."""
    matrix = np.array([[np.nan if c is None else c for c in row] for row in correlations], float)
    error = np.array([np.nan if e["standard_error"] is None else e["standard_error"] for e in found.values()], float)
    known = np.isfinite(error) & np.isfinite(np.diag(matrix)) & (error > 0.0)
    information = np.zeros((len(error), len(error)))
    places = np.ix_(known, known)
    weight = np.where(known, 1.0 / np.where(known, error, 1.0), 0.0)
    if known.any() and (not np.all(np.isfinite(matrix[places])) or np.linalg.eigvalsh(matrix[places])[0] < 1e-14):
        raise ValueError("the saved fit's correlations contradict each other; fit the table again")
    # Errors far apart in size: invert the correlations, which have none.
    information[places] = np.linalg.inv(matrix[places]) * np.outer(weight, weight)[places] if known.any() else 0.0
    for i, entry in enumerate(found.values()):
        if not known[i] and entry.get("constraint"):
            information[i, i] = float(entry["constraint"][1]) ** -2.0
    return information


def _check_payload(payload: Mapping[str, Any]) -> None:
    if payload.get("format") != "afm-jax fit":
        raise ValueError("this is no saved fit; give the JSON that `afm-jax fit TABLE.csv --json` or --out writes")
    for key in ("model", "parameters", "correlations", "input", "valid"):
        if key not in payload:
            raise ValueError(f"the saved fit lacks {key!r}; write it again with `afm-jax fit TABLE.csv --json`")
    for name in payload["parameters"]:
        if name not in PARAMETERS:
            raise ValueError(f"the saved fit has the unknown parameter {name!r}; fit the table again")
