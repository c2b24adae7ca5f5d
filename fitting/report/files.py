"""The files of a report: text, JSON, picture and page."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from afm_jax.plots.picture_style import png_of, svg_of
from afm_jax.whole_files import write_whole
from fitting.report.sections import Report, ReportSection, page_of, pictures_of, text_of


def write_with_picture(
    folder: Path,
    name: str,
    report: Report,
    figure: Figure,
    shows: str,
    data: dict[str, Any],
    *,
    link: str | None = None,
) -> list[Path]:
    """Write name.html, name.txt, name.json and name.png of a report with one picture and return their paths.

    Args:
        folder: an existing folder; files of these names are replaced.
        name: of the files.
        report: what text and page show.
        figure: the picture.
        shows: what is to be seen in it.
        data: everything, as JSON has it.
        link: name of the picture's own section among the links of the page; None: it stands above all sections.

    Raises:
        OSError: if a file cannot be written.
    """
    # the SVG file has the layout of the PNG drawn before
    picture = png_of(figure)
    pictures = pictures_of([svg_of(figure)], [shows])
    if link is not None:
        report, pictures = replace(report, sections=[ReportSection("Picture", pictures, link), *report.sections]), []
    page = page_of(report, pictures)
    return write_report_files(folder, name, text=text_of(report), data=data, picture=picture, page=page)


def write_report_files(
    folder: Path, name: str, *, text: str, data: dict[str, Any], picture: bytes, page: str | None = None
) -> list[Path]:
    """Write name.txt, name.json, name.png and, if there is a page, name.html into a folder and return their paths.

    Args:
        folder: an existing folder; files of these names are replaced.
        name: of the files.
        text: the summary.
        data: everything, as JSON has it.
        picture: a PNG file.
        page: an HTML file.

    Raises:
        OSError: if a file cannot be written.
    """
    paths = [folder / f"{name}.{ending}" for ending in ("txt", "json", "png")]
    write_whole(paths[0], text + "\n")
    write_whole(paths[1], json.dumps(data, indent=1, allow_nan=False) + "\n")
    write_whole(paths[2], picture)
    if page is None:
        return paths
    write_whole(folder / f"{name}.html", page)
    return [folder / f"{name}.html", *paths]
