"""A posterior as a netCDF file in ArviZ's layout: a group each for draws, predictions, likelihoods and readings."""

import importlib
import importlib.util
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from afm_jax.checks import checked
from afm_jax.version import __version__
from afm_jax.whole_files import write_whole
from fitting.fits.result import FitResult
from fitting.sampling.draws import posterior_draws
from fitting.sampling.posterior_result import Posterior
from fitting.sampling.trust_pack import READINGS


def require_netcdf() -> Any:
    """Return xarray, which writes such files.

    Raises:
        ModuleNotFoundError: if it or h5netcdf is not installed.
    """
    for package in ("xarray", "h5netcdf"):
        if importlib.util.find_spec(package) is None:
            raise ModuleNotFoundError(
                f"a file for ArviZ needs the package {package}: pip install 'afm-jax[arviz]'", name=package
            )
    return importlib.import_module("xarray")


@checked
def write_inference_data(result: FitResult, found: Posterior, path: str | Path, *, seed: int = 0) -> None:
    """Write a posterior for ArviZ: `arviz.from_netcdf(path)` reads it.

    The groups are posterior, sample_stats, log_likelihood (of each row's readings together), posterior_predictive and
    observed_data; rows are named by their lines in the table's file.

    Args:
        result: from `fitting.fit`.
        found: its posterior, from `fitting.posterior`.
        path: of the file.
        seed: of draws from a grid, and of the replicated noise.

    Raises:
        ModuleNotFoundError: if xarray or h5netcdf is not installed (extra `arviz`).
        OSError: if the file cannot be written.
    """
    xarray = require_netcdf()
    believed = posterior_draws(result, found, seed=seed)
    lines, draw = result.table.lines[believed.rows], ("chain", "draw")
    steps = {name: np.arange(size) for name, size in zip(draw, believed.values.shape, strict=False)}
    predictive, observed, places = {}, {}, {}
    for kind, name in enumerate(READINGS[: believed.measured.shape[1]]):
        read = np.isfinite(believed.measured[:, kind])
        if read.any():
            place = f"{name}_line"
            places[place] = lines[read]
            predictive[name] = (*draw, place), believed.replicated[:, :, read, kind]
            observed[name] = place, believed.measured[read, kind]
    chains = {name: (draw, column) for name, column in believed.statistics.items()}
    groups = {
        "posterior": ({name: (draw, believed.values[..., i]) for i, name in enumerate(believed.names)}, steps),
        "sample_stats": (chains, steps),
        "log_likelihood": ({"readings": ((*draw, "line"), believed.log_likelihood)}, steps | {"line": lines}),
        "posterior_predictive": (predictive, steps | places),
        "observed_data": (observed, places),
    }
    about = {
        "inference_library": "afm-jax",
        "inference_library_version": __version__,
        "model": result.model,
        "table": result.table.source,
    }
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole.nc"
        for group, (variables, coordinates) in groups.items():
            data = xarray.Dataset(variables, coords=coordinates, attrs=about)
            data.to_netcdf(whole, group=group, mode="a" if whole.exists() else "w", engine="h5netcdf")
        write_whole(path, whole.read_bytes(), named_by_user=True)
