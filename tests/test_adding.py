"""A force and a parameter of the delay are added to a copy as `notebooks/adding_a_force.md` says: few files each.

What one of its steps leaves to another file is looked for there.
"""

import shutil
from pathlib import Path

import pytest

from fitting.infer.unknowns import _MOVES
from fitting.parameters import DRIFT_NAMES, NUISANCE_NAMES
from fitting.tables.table import CALIBRATION, SETTINGS
from tests.fresh_python import python
from tests.mutations import before_and_after
from tests.test_scenefile import CANTILEVER, LAW, PLATFORM
from tests.test_scenefile import DELAY as DELAY_OF_SCENE

ROOT = Path(__file__).parent.parent
# by file: text that stands there, and in braces what becomes what, the first time
FORCE = {
    "afm_jax/contact/parameters.py": [
        '"viscous", { => "attraction", }"jkr")',
        """{ =>     ContactParameter(name="attraction_constant_aj", default=0.01, allowed="not negative",
        meaning="H of the attraction", fitted=(1e-4, 10.0), serves=("attraction",)),
}    ContactParameter(name="tip_radius_nm\"""",
    ],
    "afm_jax/contact/contact.py": [
        "import { => Attraction, }CoreRepulsion",
        '    "viscous": Viscous,\n{ =>     "attraction": Attraction,\n}',
    ],
    # like a force that is there
    "afm_jax/contact/forces/solid.py": ["{ => class Attraction(StaticForce):VAN DER WAALS\n\n\n}class VanDerWaals("],
}
DELAY = {
    "afm_jax/impact/law.py": [
        'True)\n{ =>     late_nm2_per_us: Float[Array, "..."] = eqx.field(converter=as_parameter, default=0.0)\n}',
        "(1.0 / w - 1.0 / u) - self.offset_nm / u{ =>  + self.late_nm2_per_us / u**2}",
    ],
    "afm_jax/scenefile/tables.py": ['"offset_nm", { => "late_nm2_per_us", }"corrections")'],
    "afm_jax/scenefile/scenefile.py": ["offset_nm = 0.726\n{ => late_nm2_per_us = 0\n}"],
    "fitting/parameters.py": [
        """        advice="measure at several offsets and drives",
    ),
{ =>     Parameter(name="delay_late_nm2_per_us", unit="nm^2/us", meaning="late",
        lowest=-1.0, highest=1.0, width=1.0, starts=(-0.5, 0.5)),
}""",
        '"delay_offset_nm": 0.726{ => , "delay_late_nm2_per_us": 0.0}',
        "- delay_offset_nm/u_in{ =>  + delay_late_nm2_per_us/u_in^2}",
    ],
    "fitting/infer/law.py": [
        '{ =>     "delay_late_nm2_per_us": lambda u, w: 1.0 / u**2,\n}    "delay_offset_nm": lambda'
    ],
}


def changed(folder: Path, edits: dict[str, list[str]]) -> None:
    """Make the edits in a copy of the two packages."""
    for package in ("afm_jax", "fitting"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name, marked in edits.items():
        text = (folder / name).read_text()
        body = text.partition("class VanDerWaals(StaticForce):")[2].replace("hamaker_", "attraction_")
        for edit in marked:
            old, new = before_and_after(edit)
            assert old in text, f"{name} has no {old!r}"
            text = text.replace(old, new.replace("VAN DER WAALS", body), 1)
        (folder / name).write_text(text)


def said(folder: Path, code: str) -> str:
    """Return what a program prints that has the packages of a folder."""
    start = f"import sys; sys.path.insert(0, {str(folder)!r})\nimport jax; jax.config.update('jax_enable_x64', True)\n"
    return python(start + code)


@pytest.mark.slow
def test_a_force_is_added_in_three_files_and_a_parameter_of_the_delay_in_five(tmp_path: Path):
    assert (len(FORCE), len(DELAY)) == (3, 5)
    changed(tmp_path, FORCE | DELAY)
    for name, line in (("old", ""), ("new", "late_nm2_per_us = 3\n")):
        (tmp_path / f"{name}.toml").write_text(CANTILEVER + PLATFORM + LAW + DELAY_OF_SCENE + line)
    code = (
        "from afm_jax import Contact, load_scene; from afm_jax.cli.main import main\n"
        "from fitting.parameters import CONTACT_NAMES, model_parameters\n"
        "less = Contact.paper(effects=('capillary', 'structural', 'core', 'viscous', 'jkr'))\n"
        "print(float(Contact.paper().forces(2.0) - less.forces(2.0)))\n"
        f"files = [{str(tmp_path)!r} + name for name in ('/old.toml', '/new.toml')]\n"
        "old, new = (load_scene(file).interaction.delay(50.0, 40.0) for file in files)\n"
        "print(float(new - old))\nprint(CONTACT_NAMES, model_parameters('law+delay'))\nmain(['collide', '--help'])"
    )
    force, later, fitted, *helped = said(tmp_path, code).splitlines()
    # -H R / (6 D^2)
    assert float(force) == pytest.approx(-0.01 * 100.0 / 24.0, rel=1e-9)
    assert float(later) == pytest.approx(3.0 / 50.0**2, rel=1e-9)
    assert all(f"'{name}'" in fitted for name in ("attraction_constant_aj", "delay_late_nm2_per_us"))
    assert "--attraction-constant-aj X" in " ".join(helped)


def test_a_quantity_of_the_instrument_is_in_every_list_of_them():
    for names, known, where in (
        (CALIBRATION, NUISANCE_NAMES, "NUISANCES of fitting/parameters.py"),
        (set(NUISANCE_NAMES), _MOVES, "_MOVES of fitting/infer/unknowns.py"),
        (set(NUISANCE_NAMES) - set(DRIFT_NAMES), SETTINGS, "SETTINGS of fitting/tables/table.py"),
    ):
        lacking = [name for name in names if name not in known]
        assert lacking == [], f"{where} lacks {lacking}: see notebooks/adding_a_force.md"
