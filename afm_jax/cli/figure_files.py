"""A figure's files: its picture and its table."""

from pathlib import Path

from afm_jax.cli.session import write_csv
from afm_jax.dynamics import charts as offset_amplitude
from afm_jax.dynamics import charts as stability_regions
from afm_jax.dynamics.charts import OffsetAmplitudes
from afm_jax.paper.charts import FigureData, adhesion_limit_nm
from afm_jax.paper.contact_figures import ContactFigure
from afm_jax.paper.motion_figures import MotionFigure
from afm_jax.plots.charts import draw_offset_amplitudes, draw_stability_chart
from afm_jax.plots.paper import draw_contact_figure, draw_motion_figure
from afm_jax.scenefile import presets


def write_figure(number: str, figure: FigureData | ContactFigure | MotionFigure, folder: Path) -> list[str]:
    """Write a figure as PNG and CSV into a folder.

    Args:
        number: of the figure in the paper.
        figure: its data.
        folder: exists and can be written to.

    Returns:
        The names of the files.
    """
    picture, table = f"figure{number}.png", f"figure{number}.csv"
    if isinstance(figure, (ContactFigure, MotionFigure)):
        if isinstance(figure, MotionFigure):
            draw_motion_figure(number, figure, folder / picture)
        else:
            draw_contact_figure(number, figure, folder / picture)
        write_csv(folder / table, figure.table(), tuple(figure.columns))
        return [picture, table]
    data = figure.data
    if isinstance(data, OffsetAmplitudes):
        draw_offset_amplitudes(data, folder / picture, title=_AMPLITUDE_TITLE)
        columns = offset_amplitude.TABLE_COLUMNS
    else:
        draw_stability_chart(
            data,
            folder / picture,
            title=_CHART_TITLES[number],
            compared_with=figure.compared_with,
            limit_nm=adhesion_limit_nm(data.x_values) if number == "3" else None,
        )
        columns = stability_regions.TABLE_COLUMNS
    write_csv(folder / table, data.table(), columns)
    return [picture, table]


_CHART_CONDITIONS = rf"$r$ = {presets.STABILITY_R:g}, $\sigma = {presets.STABILITY_OFFSET_NM:g}$ nm"
_CHART_TITLES = {
    "2": rf"Stable single-impact orbits (light), {_CHART_CONDITIONS}, $\epsilon$ = 0",
    "3": rf"Stable single-impact orbits with adhesion (light), {_CHART_CONDITIONS}, "
    rf"$\epsilon$ = {presets.ADHESION:g} $\mu$J/kg",
}
_AMPLITUDE_TITLE = (
    r"Amplitude of the stable (1,1) orbit, "
    rf"$\beta$ = {presets.OFFSET_SWEEP_AMPLITUDE_NM:g} nm, $\epsilon$ = {presets.ADHESION:g} $\mu$J/kg"
)
