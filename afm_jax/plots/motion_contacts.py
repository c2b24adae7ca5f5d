"""The contacts of a motion: the gap against time around the last ones, and the force against the gap."""

from pathlib import Path

import numpy as np

from afm_jax.contact.contact import Contact
from afm_jax.contact.junction import find_junction
from afm_jax.plots.motion_window import Look, shade_phases
from afm_jax.plots.picture_style import BLUE, DARK, GRID, label_axes, new_figure, save, with_zero_line

_PANELS = 3
_GAP_SHOWN_NM = 6.0
_CURVES = 3
_STROKES = ((GRID, 5.0), (BLUE, 3.2), ("black", 1.4))
"""Wide below narrow, so that loops that coincide all show."""
_SIDE = {"bridge breaks": "center", "bridge forms": "center", "junction breaks": "bottom", "junction forms": "top"}


def draw_gap(look: Look, path: Path) -> None:
    """Draw the gap around the last contacts as a PNG file, a panel each, with the gaps at which the phase changes."""
    rows = np.arange(look.arrival_us.size)[-_PANELS:]
    picture = new_figure(4.0 * len(rows) + 1.0, 4.4)
    panels = picture.subplots(1, len(rows), squeeze=False, sharey=True)[0]
    contact = look.scene.interaction
    marks = _marks(contact) if isinstance(contact, Contact) else {}
    top = 0.0
    for axes, row in zip(panels, rows, strict=True):
        begin, end = _around(look, int(row))
        part = look.between(begin, end)
        since = part._replace(time_us=part.time_us - look.arrival_us[row])
        axes.plot(since.time_us, since.gap_nm, color="black", linewidth=1.8)
        shade_phases(axes, since, contact)
        for gap in marks.values():
            axes.axhline(gap, color=DARK, linewidth=0.9, linestyle=(0, (1, 2)))
        with_zero_line(axes)
        axes.set_xlim(since.time_us[0], since.time_us[-1])
        label_axes(axes, x=f"time after {look.arrival_us[row]:.2f} µs (µs)", y="")
        axes.set_title(f"contact {row + 1} of {look.arrival_us.size}", fontsize=11, loc="left")
        top = max(top, float(since.gap_nm.max()))
    panels[0].set_ylabel("gap (nm)", fontsize=12)
    lowest = min(axes.get_ylim()[0] for axes in panels)
    panels[0].set_ylim(lowest, 1.35 * top)
    for name, gap in marks.items():
        panels[-1].annotate(f" {name}", (1.0, gap), xycoords=("axes fraction", "data"), va=_SIDE[name], fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    if handles:
        panels[0].legend(handles, labels, loc="upper center", fontsize=10, framealpha=1.0)
    save(picture, path)


def _around(look: Look, row: int) -> tuple[float, float]:
    """Return the times between which a contact is shown: from and to a gap of a few nm."""
    arrival, departure = look.arrival_us[row], look.departure_us[row]
    approach = max(float(np.asarray(look.contacts.approach_speed_nm_per_us)[look.used][row]), 1.0)
    lead = min(_GAP_SHOWN_NM / approach, 0.25 * look.drive.period_us)
    resolved = isinstance(look.scene.interaction, Contact)
    lead = 0.4 * lead if resolved else lead
    end = departure if np.isfinite(departure) else arrival + look.drive.period_us
    first, last = float(look.simulation.start.time_us), float(look.simulation.final.time_us)
    return max(first, min(arrival, end) - lead), min(last, max(arrival, end) + lead)


def _marks(contact: Contact) -> dict[str, float]:
    """Return the gaps at which the phase of a contact changes, the inner two only where they can be told apart."""
    junction = find_junction(contact)
    return {
        "bridge breaks": float(contact.bridge_breaks_nm),
        "bridge forms": float(contact.bridge_forms_nm),
        "junction breaks": float(junction.breaks_gap_nm),
        "junction forms": float(junction.forms_gap_nm),
    }


def draw_force_gap(look: Look, path: Path) -> None:
    """Draw the force against the gap through the last contacts as a PNG file: all of it, and the attractive part."""
    picture = new_figure(12.0, 5.0)
    whole, part = picture.subplots(1, 2, width_ratios=[1.0, 1.5])
    rows = np.arange(look.arrival_us.size)[-_CURVES:]
    least = 0.0
    for row, (colour, width) in zip(rows, _STROKES[-len(rows) :], strict=True):
        path_of_row = look.between(*_around(look, int(row)))
        lost = float(np.asarray(look.contacts.energy_lost_aj)[look.used][row])
        label = f"contact {row + 1}: {lost:.1f} aJ lost"
        least = min(least, float(path_of_row.force_nn.min()))
        for axes in (whole, part):
            axes.plot(path_of_row.gap_nm, path_of_row.force_nn, color=colour, linewidth=width, label=label)
    for name, gap in _marks(look.scene.interaction).items():
        part.axvline(gap, color=DARK, linewidth=0.9, linestyle=(0, (1, 2)))
        # two close lines have their names on their outer sides; left of where the junction forms the curve is high
        side, align = (-2, "right") if name.endswith("forms") else (2, "left")
        height, end = (0.03, "bottom") if name == "junction forms" else (0.97, "top")
        part.annotate(
            name,
            (gap, height),
            (side, 0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            rotation=90,
            ha=align,
            va=end,
            fontsize=9,
            color=DARK,
        )
    for axes in (whole, part):
        with_zero_line(axes)
        label_axes(axes, x="gap (nm)", y="force on the tip (nN)" if axes is whole else "")
    whole.set_xlim(right=_GAP_SHOWN_NM)
    part.set(xlim=(-0.6, _GAP_SHOWN_NM), ylim=(1.1 * least - 5.0, -0.6 * least + 5.0))
    part.legend(loc="lower right", fontsize=10, framealpha=1.0)
    whole.set_title("Force against gap", fontsize=12, loc="left")
    part.set_title("the attractive part, with its loops", fontsize=12, loc="left")
    save(picture, path)
