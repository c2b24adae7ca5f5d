"""`afm-jax tapping-map IMAGE`: energy of a tap and virial in every pixel."""

from functools import partial
from pathlib import Path
from typing import Any

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from fitting.instruments.images import read_images
from fitting.tapping_curves.map_report import map_summary, write_map
from fitting.tapping_curves.maps import tapping_map


def map_of_an_image(
    session: Session,  # noqa: ARG001
    *,
    image: Path,
    phase_image: Path | None,
    formats: tuple[str, ...],
    columns: str,
    grid: tuple[int, int] | None,
    ratio: float,
    **options: Any,
) -> Output:
    """Return energy and virial of every pixel of an image, or of a grid of curves."""
    images = read_images(image, phase_image, columns=columns, grid=grid, ratio=ratio)
    result = tapping_map(images, **options)
    return Output.of_report(result, partial(map_summary, result), lambda folder, _: write_map(result, folder, formats))
