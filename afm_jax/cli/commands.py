"""The commands, a row each; what they do stands in the functions that they name, with their help and their options."""

import click

from afm_jax.cli.command import Command
from afm_jax.cli.options import LAW
from afm_jax.cli.values import Finite, ValueAndError, option_of
from afm_jax.contact.parameters import CONTACT_PARAMETERS, DRY_PARAMETERS, REMOVABLE_EFFECTS
from fitting.parameters import LAW_NAMES, PARAMETERS, PRIOR_NUISANCES


def _number(name: str, text: str) -> click.Option:
    return click.Option([option_of(name)], type=Finite(), metavar="X", help=text)


CONTACT_OPTIONS = (
    *(_number(each.name, f"{each.meaning}; paper: {each.default:g}.") for each in CONTACT_PARAMETERS),
    *(_number(each.name, f"{each.meaning}; of a dry contact: {each.default:g}.") for each in DRY_PARAMETERS),
    _number("mass_ng", "Effective mass of the tip; the scene's, or 1."),
    *(click.Option([f"--no-{name}"], is_flag=True, help=f"Leave the {name} force out.") for name in REMOVABLE_EFFECTS),
)
"""What is changed of a scene's contact or of the paper's."""
_PRIOR_OPTIONS = (
    *(
        _number(
            name, f"{', '.join(filter(None, (PARAMETERS[name].meaning, PARAMETERS[name].unit)))}; else the paper's."
        )
        for name in LAW_NAMES
    ),
    *(
        click.Option(
            [option_of(each.name)],
            type=ValueAndError(**{"none": (None, None)} if each.name == "quality_factor" else {}),
            help=f"{each.meaning}, 'VALUE +- ERROR'.",
        )
        for each in PRIOR_NUISANCES
    ),
)
"""What is known of the law and of the instrument before anything is measured."""
_MEASURE = "Measure: read data, fit and plan"
_SIMULATE = "Simulate: motions, orbits, basins of a scene"
_CONTACT = "Contact: forces between tip and sample"
_CHECK = "Check: equations, accuracy, speed, installation"
_LEVER = ".read:LeverOptions"
_READING = ".read:ReadingOptions"
_IMAGING = ".tapping_map:ImagingOptions"

ROWS = (
    Command("calibrate", _MEASURE, ".calibrate:calibration", (".calibrate:CalibrationOptions",), computes=False),
    Command("design", _MEASURE, ".design:planned", _PRIOR_OPTIONS),
    Command("fit", _MEASURE, ".fit:fit", one_of="tables example"),
    Command("invert", _MEASURE, ".invert:inversion", one_of="table example"),
    Command("lockin", _MEASURE, ".lockin:lockin_of_trace", computes=False),
    Command("read", _MEASURE, ".read:curves_of_a_file", (_LEVER, _READING), computes=False, out_file="TABLE.csv"),
    Command("tapping", _MEASURE, ".tapping:energy_of_taps", (_LEVER, _READING), computes=False),
    Command("tapping-map", _MEASURE, ".tapping_map:map_of_an_image", (_LEVER, _IMAGING), computes=False),
    Command("basins", _SIMULATE, ".basins:basins", (LAW,)),
    Command("bifurcation", _SIMULATE, ".bifurcation:bifurcation", (LAW,)),
    Command("chart", _SIMULATE, ".chart:chart", (LAW,)),
    Command("continue", _SIMULATE, ".continue_orbits:follow", (LAW,)),
    Command("effects", _SIMULATE, ".effects:effects"),
    Command("lyapunov", _SIMULATE, ".lyapunov:lyapunov", (LAW,)),
    Command("orbits", _SIMULATE, ".orbits:orbits", (LAW,)),
    Command(
        "simulate",
        _SIMULATE,
        ".simulate:simulation",
        (LAW,),
        apart=("duration_us periods", "heights duration_us", "heights samples"),
        needs=("samples out", "noise heights", "phase_noise_deg heights"),
    ),
    Command("sweep", _SIMULATE, ".sweep:sweep", apart=("workers scheduler",), needs=("sweep out",)),
    Command(
        "collide",
        _CONTACT,
        ".collide:collide",
        CONTACT_OPTIONS,
        apart=("make_law speeds",),
        needs=("speed_range make_law", "points make_law"),
    ),
    Command("accuracy", _CHECK, ".accuracy:accuracy"),
    Command("doctor", _CHECK, ".doctor:doctor", computes=False),
    Command("verify", _CHECK, ".verify:verification"),
)
COMMANDS: dict[str, Command] = {row.name: row for row in ROWS}
