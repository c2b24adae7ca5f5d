"""`afm-jax figures --only 2,3,4`: the paper's figures as PNG and CSV, and the paper's words about them checked."""

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from afm_jax.cli.main import NotValid
from afm_jax.cli.session import Session, prepare_folder, write_csv

if TYPE_CHECKING:
    from afm_jax.paper.charts import FigureData
    from afm_jax.paper.contact_figures import ContactFigure
    from afm_jax.paper.motion_figures import MotionFigure

_OF_THE_CONTACT = {"4": "forces", "5": "loading and unloading", "6": "impact law", "7": "one impact in time"}
_OF_MOTIONS = {"8": "Poincare section", "10": "rising offset below resonance", "11": "rising offset above resonance"}
_DEFAULT_FOLDER = Path("figures")
_SPOT_CHECKS = 60
_COARSE_SPOT_CHECKS = 20


def figures(session: Session, *, only: tuple[str, ...], coarse: bool, seed: int) -> None:
    """Draw figures of the paper and check its statements."""
    folder = session.out or _DEFAULT_FOLDER
    prepare_folder(folder)
    session.start_computing()
    from afm_jax.plots.paper import draw_figure  # noqa: PLC0415

    told = {}
    # each is written before the next is computed: who interrupts keeps what there is
    for number, figure in _computed(session, only, coarse=coarse, seed=seed):
        files = [f"figure{number}.png", f"figure{number}.csv"]
        draw_figure(number, figure, folder / files[0])
        write_csv(folder / files[1], figure.table(), tuple(figure.columns))
        told[number] = _payload(number, figure, files)
        for name in files:
            session.note(f"wrote {folder / name}")
    payload = [told[number] for number in only]
    valid = all(figure["valid"] for figure in payload)
    session.emit({"figures": payload, "folder": str(folder), "valid": valid}, *_text(payload))
    if not valid:
        wrong = [number for number in only if not told[number]["valid"]]
        raise NotValid(f"figure {', '.join(wrong)}: a statement or a spot check fails, see the output")


def _computed(
    session: Session, only: tuple[str, ...], *, coarse: bool, seed: int
) -> "Iterator[tuple[str, FigureData | ContactFigure | MotionFigure]]":
    """Give the figures' numbers and data, each when it is computed; its time goes to standard error."""
    from afm_jax.paper import charts as paper_figures  # noqa: PLC0415

    points = _COARSE_SPOT_CHECKS if coarse else _SPOT_CHECKS
    start = time.perf_counter()

    # One line a step, not a bar: it is as readable in a log as in a terminal.
    def report(what: str) -> None:
        session.note(f"{time.perf_counter() - start:5.1f} s  {what}")

    if "2" in only or "3" in only:
        without = paper_figures.figure2_chart(coarse=coarse, report=report)
        if "2" in only:
            report("figure 2: statements and spot checks")
            yield "2", paper_figures.figure2(without, seed=seed, points=points)
        if "3" in only:
            adhesive = paper_figures.figure3_chart(coarse=coarse, report=report)
            report("figure 3: statements and spot checks")
            yield "3", paper_figures.figure3(adhesive, without, seed=seed, points=points)
    for number in (each for each in only if each in _OF_THE_CONTACT):
        from afm_jax.paper.contact_figures import CONTACT_FIGURES  # noqa: PLC0415

        report(f"figure {number}: {_OF_THE_CONTACT[number]}")
        yield number, CONTACT_FIGURES[number]()
    for number in (each for each in only if each in _OF_MOTIONS):
        from afm_jax.paper.motion_figures import MOTION_FIGURES  # noqa: PLC0415

        report(f"figure {number}: {_OF_MOTIONS[number]}")
        tell = partial(lambda number, what: report(f"figure {number}: {what}"), number)
        yield number, MOTION_FIGURES[number](coarse=coarse, report=tell)
    if "9" in only:
        report("figure 9: amplitudes and spot checks")
        yield "9", paper_figures.figure9(coarse=coarse, seed=seed, points=points)


def _payload(number: str, figure: "FigureData | ContactFigure | MotionFigure", files: list[str]) -> dict[str, Any]:
    payload = {
        "figure": int(number),
        "files": files,
        **figure.numbers,
        "statements": [
            {"statement": each.statement, "holds": each.holds, **each.numbers} for each in figure.statements
        ],
        "valid": figure.valid,
    }
    checks = getattr(figure, "spot_checks", None)
    if checks is not None:
        from afm_jax.paper.charts import CLEARANCE_NM, STABILITY_MARGIN  # noqa: PLC0415

        payload["spot_checks"] = {
            "checked": checks.checked,
            "excluded": checks.excluded,
            "excluded_share": checks.excluded_share,
            "excluded_within": {"trace_margin": STABILITY_MARGIN, "clearance_nm": CLEARANCE_NM},
            "failures": checks.failures,
        }
    return payload


def _text(payload: list[dict[str, Any]]) -> list[str]:
    lines = []
    for figure in payload:
        lines.append(f"Figure {figure['figure']}: {', '.join(figure['files'])}")
        if "stable_share" in figure:
            lines.append(f"  stable share of the points: {figure['stable_share']:.3f}")
        lines += [
            f"  {'holds' if statement['holds'] else 'FAILS'}: {statement['statement']}"
            for statement in figure["statements"]
        ]
        checks = figure.get("spot_checks")
        if checks is None:
            continue
        counts = ", ".join(f"{count} {verdict}" for verdict, count in checks["checked"].items())
        lines.append(
            f"  spot checks by long iteration: {counts}; {len(checks['failures'])} failed, "
            f"{100.0 * checks['excluded_share']:.1f} % too close to a boundary to check"
        )
    return lines
