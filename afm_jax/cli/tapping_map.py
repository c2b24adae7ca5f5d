"""`afm-jax tapping-map IMAGE`: energy of a tap and virial in every pixel."""

from pathlib import Path
from typing import Any

from afm_jax.cli.command import Output
from afm_jax.cli.session import Session
from fitting.instruments.images import read_images
from fitting.report.sections import text_of
from fitting.tapping_curves.map_report import map_report, write_map
from fitting.tapping_curves.maps import tapping_map


def map_of_an_image(
    session: Session,  # noqa: ARG001
    *,
    image: Path,
    phase_image: Path | None,
    formats: tuple[str, ...],
    columns: str,
    **options: Any,
) -> Output:
    """Return energy and virial of every pixel of an image."""
    result = tapping_map(read_images(image, phase_image, columns=columns), **options)
    return Output.of_report(
        result, lambda: text_of(map_report(result)), lambda folder, _: write_map(result, folder, formats)
    )
