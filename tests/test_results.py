"""Every public result says itself, is drawn, becomes a table, comes back from its file; no class can be forgotten."""

import collections.abc
import dataclasses
import enum
import inspect
import json
import math
import types
import typing
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import afm_jax as afm
import fitting
from afm_jax import report, results, saved
from afm_jax.impact.map import NextImpact
from afm_jax.motion.record import ContactKind, Contacts, State
from afm_jax.scenefile.parameter_paths import ParameterRange
from fitting.infer.comparison import Comparison
from tests.fit_tables import EXAMPLE, example_fit
from tests.fresh_python import python
from tests.html_pages import read_page
from tests.lockin_traces import noisy_bounce
from tests.strict_reading import strictly

PARAMETERS = {"BaseDrive", "Cantilever", "CollisionDelay", "Contact", "ForceDrive", "ImpactLaw", "Platform", "Scene"}
PARAMETERS |= {"ParameterRange", "TabulatedLaw", "Tone"}
"""What a simulation is made of, and scene files hold; and what a parameter goes through."""
ROOT = Path(__file__).parent.parent
DRAWN_BELOW = {"Comparison", "Continuation", "Design", "FitResult", "Inversion", "LockinResult"}
DRAWN_BELOW |= {"StabilityChart"}
DRAWN_ELSEWHERE = {"Basins", "ContactDelay", "BifurcationDiagram", "Lyapunov", "Tapping", "TappingMap"}
"""What is drawn in its own way, from parts that belong together: these are made by computations."""
SIZES = {"rows": 7, "points": 5, "p": 2, "columns": 3, "orders": 2, "scenes": 21}


def is_record_class(kind: Any) -> bool:
    return inspect.isclass(kind) and (dataclasses.is_dataclass(kind) or hasattr(kind, "_fields"))


def public_results() -> dict[str, Any]:
    """Return every class of records that the packages export, or that one of their functions returns."""
    public = [getattr(package, name) for package in (afm, fitting) for name in dir(package)]
    returned = [inspect.get_annotations(each).get("return") for each in public if inspect.isfunction(each)]
    records: list[Any] = [kind for kind in [*public, *returned] if is_record_class(kind)]
    return {kind.__name__: kind for kind in records if kind.__name__ not in PARAMETERS}


RESULTS = public_results()
SOME: Any = State
"""Its fields are arrays; some tests have numbers and NumPy's arrays there."""


def made(kind: Any, draw: np.random.Generator) -> Any:
    """Return a record of a class with random numbers of the shapes that its annotations tell, some of them NaN."""
    hints = results._annotations(kind)
    names = kind._fields if hasattr(kind, "_fields") else [field.name for field in dataclasses.fields(kind)]
    return saved._built(kind, {name: of_hint(hints[name], draw) for name in names})


def of_hint(hint: Any, draw: np.random.Generator) -> Any:  # noqa: PLR0911 (one return a kind of annotation)
    """Return a value for a field by its annotation; None stands for functions, and for what is named by a string."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if hasattr(hint, "dim_str"):
        return array_of(hint, draw)
    if isinstance(hint, types.UnionType):
        return of_hint(inner[0], draw)
    if origin is tuple:
        # as many texts as a curve has points
        kinds = [str] * SIZES["points"] if inner == (str, ...) else [each for each in inner if each is not Ellipsis]
        return tuple(of_hint(each, draw) for each in kinds)
    if origin is list:
        return [of_hint(inner[0], draw) for _ in range(3)]
    if origin in (dict, collections.abc.Mapping):
        return {name: of_hint(inner[1], draw) for name in ("one", "two")}
    if is_record_class(hint):
        # what computes the rest of itself from its fields cannot do so from random ones
        return None if hasattr(hint, "_by_init") else made(hint, draw)
    if inspect.isclass(hint) and issubclass(hint, enum.Enum):
        return next(iter(hint))
    number = [0.1, math.nan, math.inf][draw.integers(3)]
    simple = {bool: True, int: 3, float: number, str: 'words, with "signs"\nand lines', np.ndarray: draw.normal(size=5)}
    return simple.get(hint)


def array_of(hint: Any, draw: np.random.Generator) -> np.ndarray:
    words = hint.dim_str.split()
    shape = (4,) if "..." in words else tuple(int(word) if word.isdigit() else SIZES.get(word, 4) for word in words)
    kinds = " ".join(hint.dtypes)
    if "bool" in kinds:
        return draw.random(shape) < 0.5
    if "int" in kinds:
        return np.ones(shape, int)
    numbers = draw.normal(size=shape) * 10.0 ** draw.integers(-9, 9, shape)
    if "complex" in kinds:
        return numbers + 1j * numbers
    numbers.flat[0] = math.nan
    numbers.flat[-1] = -math.inf
    return numbers


def parts_of(value: Any) -> Any:
    """Return all that a record holds as lists and texts that can be compared: kinds, names, shapes, every last bit."""
    if saved.is_record(value):
        return [type(value), *((name, parts_of(part)) for name, part in saved.fields_of(value))]
    if isinstance(value, dict):
        return {name: parts_of(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [type(value), *map(parts_of, value)]
    if isinstance(value, np.ndarray | jax.Array):
        return [isinstance(value, np.ndarray), value.dtype, value.shape, repr(np.asarray(value).tolist())]
    # functions are not saved
    return repr(None if callable(value) else value.item() if isinstance(value, np.generic) else value)


@pytest.fixture(params=RESULTS)
def record(request: pytest.FixtureRequest) -> Any:
    """A record of each class of results."""
    return made(RESULTS[request.param], np.random.default_rng(4))


def test_a_result_says_itself_in_a_few_lines_and_becomes_a_data_set(record: Any):
    lines = repr(record).splitlines()
    assert lines[0] == f"{type(record).__name__}:"
    assert len(lines) <= report.MOST_LINES
    assert max(map(len, lines)) <= 160
    data = record.to_xarray()
    assert len(data) >= sum(isinstance(value, np.ndarray) for _, value in saved.fields_of(record))
    assert all(variable.attrs["units"] == results.unit_of(key) for key, variable in data.items() if variable.attrs)


def test_a_result_comes_back_from_its_file(record: Any, tmp_path: Path):
    path, name = tmp_path / "result.json", type(record).__name__
    if saved.as_json.dispatch(type(record)) is not saved.as_json.dispatch(object):
        # what its command writes is made from real results elsewhere
        payload = {"format": saved.FORMAT, "format_version": 1, **saved._record(record, name)}
        path.write_text(saved.strict_json(payload))
    else:
        record.save(path)
    assert strictly(path.read_text()).items() >= {"format": "afm-jax result", "format_version": 1, "type": name}.items()
    assert parts_of(afm.load(path)) == parts_of(record)


def test_no_class_of_results_is_forgotten():
    assert len(RESULTS) >= 30
    assert set(RESULTS) > {"Simulation", "Collision", "TimeCourse"} | DRAWN_BELOW | DRAWN_ELSEWHERE
    # type checkers see them
    assert all((Path(package.__path__[0]) / "py.typed").exists() for package in (afm, fitting))


def test_arrays_of_one_shape_are_columns_and_units_are_told():
    some = SOME(np.arange(3.0), np.zeros(3), np.ones(3))
    table = some.to_pandas()
    assert list(table.columns) == ["time_us", "position_nm", "velocity_nm_per_us"]
    assert table["velocity_nm_per_us"].tolist() == [1.0, 1.0, 1.0]
    assert SOME(*[np.zeros((2, 3))] * 3).to_pandas().index.nlevels == 2
    assert some.to_xarray()["velocity_nm_per_us"].units == "nm/us"


def test_outcomes_are_words_and_traced_values_and_shapes_can_be_told():
    zeros = jnp.zeros(3)
    many = NextImpact(zeros, zeros, zeros, zeros, jnp.array([0, 0, 1]), jnp.zeros(3, bool))
    assert "2 impact, 1 captured" in repr(many)
    told = []
    jax.jit(lambda x: told.append(repr(SOME(x, x, x))))(np.zeros((2, 3)))
    assert "float64[2,3]" in told[0]
    assert "float64[4]" in repr(jax.eval_shape(lambda: SOME(*(jnp.zeros(4),) * 3)))
    with pytest.raises(ValueError, match=r"State.time_us is traced: save a result outside `jit`"):
        jax.jit(lambda x: SOME(x, x, x).save("never.json"))(1.0)


def test_numbers_that_are_not_known_are_dashes():
    lines = repr(SOME(np.array([math.nan, math.nan, 1.5]), math.nan, np.full(9, math.nan))).splitlines()
    assert [line.split(None, 1)[1] for line in lines[1:]] == ["-, -, 1.5", "-", "(9) none known"]


def test_other_files_are_refused(tmp_path: Path):
    head = '{"format": "afm-jax result", "format_version":'
    for text, wrong in (
        ("{", "is no JSON"),
        ("{}", "is no saved result"),
        (head + ' 2, "type": "State", "fields": {}}', "update afm-jax"),
        (head + ' 1, "type": "Path", "fields": {}}', "no record called Path"),
        (head + ' 1, "type": "State", "fields": {"a": 1}}', "read here"),
    ):
        (tmp_path / "other.json").write_text(text)
        with pytest.raises(ValueError, match=wrong):
            fitting.load(tmp_path / "other.json")


def test_a_file_written_once_is_read_for_ever(tmp_path: Path):
    # the layout of version 1, written by hand: it must not change
    (tmp_path / "old.json").write_text(
        '{"format": "afm-jax result", "format_version": 1, "type": "State", "fields": {"time_us": 0.1, "position_nm": '
        '{"array": "float64", "shape": [2], "values": [null, "inf"]}, "velocity_nm_per_us": {"number": null}}}'
    )
    state = afm.load(tmp_path / "old.json")
    assert state.time_us == 0.1
    assert np.array_equal(state.position_nm, [math.nan, math.inf], equal_nan=True)
    assert math.isnan(state.velocity_nm_per_us)


def test_results_need_neither_pandas_nor_xarray_nor_matplotlib():
    code = (
        "import sys, jax; jax.config.update('jax_enable_x64', True)\n"
        "import afm_jax\nstate = afm_jax.State(0.0, 0.0, 0.0)\nrepr(state)\nstate.save('/dev/null')\n"
        "print({'pandas', 'xarray', 'matplotlib'} & set(sys.modules))\nsys.modules['xarray'] = None\n"
        "try:\n    state.to_xarray()\nexcept ModuleNotFoundError as error:\n    print(error)"
    )
    first, second = python(code).splitlines()
    assert first == "set()"
    assert "pip install 'afm-jax[xarray]'" in second


def test_a_table_of_pandas_is_an_amplitude_table_and_back():
    table: Any = fitting.read_table(EXAMPLE)
    frame = table.to_pandas()
    again = fitting.AmplitudeTable.from_dataframe(frame)
    for name in dict(saved.fields_of(table)).keys() - {"lines", "remarks"}:
        assert parts_of(getattr(again, name)) == parts_of(getattr(table, name)), name
    bare = frame.drop(columns="peak_amplitude_error_nm")
    bare.attrs = {}
    noisy = fitting.AmplitudeTable.from_dataframe(bare, noise=0.01, free_frequency_khz=90.0)
    assert noisy.peak_amplitude_error_nm == pytest.approx(0.01 * table.peak_amplitude_nm, rel=1e-15)
    with pytest.raises(fitting.TableError, match=r"free_frequency_khz is missing; give it in `frame.attrs`"):
        fitting.fit(bare)
    with pytest.raises(fitting.TableError, match="unknown column 'peak'"):
        fitting.AmplitudeTable.from_dataframe(frame.rename(columns={"peak_amplitude_nm": "peak"}))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers at random, some of them NaN
def test_every_result_of_numbers_is_a_table_and_a_picture_that_says_what_is_drawn(tmp_path: Path):
    for name in sorted(RESULTS.keys() - DRAWN_BELOW - DRAWN_ELSEWHERE):
        record = made(RESULTS[name], np.random.default_rng(6))
        assert record.to_pandas().size, name
        figure = record.plot(tmp_path / "picture.svg")
        assert any(axes.get_xlabel() for axes in figure.axes), name
        assert "<svg" in (tmp_path / "picture.svg").read_text(), name


@pytest.mark.slow
def test_results_of_computations_come_back_with_pictures(tmp_path: Path):
    scene = afm.Scene(afm.Cantilever(90.0, 40.0), afm.Platform(4.0, 180.0), afm.ImpactLaw(0.95, 60.0))
    plane = afm.scene_family(scene, "platform.reduced_frequency", "platform.amplitude_nm")
    prior = fitting.prior_of_values("law", free_frequency_khz=90.0, quality_factor=40.0)
    size = {"orders": (1,), "amplitudes_nm": (2.0, 4.0), "offsets_nm": (0.0,), "detunings": (0.98, 1.0)}
    fitted: Any = example_fit()
    row = {"model": "law", "chi2": 5.0, "degrees_of_freedom": 6, "valid": True}
    computed: list[Any] = [
        afm.single_impact_orbits(scene, 1),
        afm.stability_chart(plane, x_values=np.array([0.9, 1.0, 1.01]), y_values=np.array([3.0, 4.0]), last_order=1),
        afm.continue_orbits(scene, 1, ParameterRange("platform.amplitude_nm", 3.0, 4.5)),
        fitted,
        fitting.invert(fitting.read_table(EXAMPLE)),
        fitting.design(prior, fitting.drive_grid(**size, free_frequency_khz=90.0), points=2),
        Comparison([row | {"aic": 9.0, "delta_aic": 0.0}], "one only", {"law": fitted}),
        fitting.lockin(*noisy_bounce(1)[:2], 181.8, 1),
    ]
    assert {type(record).__name__ for record in computed} >= DRAWN_BELOW
    for record in computed:
        files = {path.suffix: path for path in record.report(tmp_path / type(record).__name__, "it")}
        again = fitting.load(files[".json"])
        assert parts_of(again) == parts_of(record), files
        assert repr(again) == repr(record).replace("a function", "none")
        assert files[".png"].stat().st_size > 5000
        assert str(record) in files[".txt"].read_text()
        assert any("svg+xml" in each.attrib["src"] for each in read_page(files[".html"].read_text()).iter("img"))
        assert len(record.to_pandas())
        assert len(files[".csv"].read_text().splitlines()) > 1
    payload = json.loads((tmp_path / "FitResult" / "it.json").read_text())
    assert payload["parameters"]["r"]["value"] == fitted.parameters["r"].value


def test_what_captured_tips_do_not_have_is_masked_in_tables_and_pictures(tmp_path: Path):
    # the second tip is captured, the last one never began
    fields: dict[str, Any] = {name: np.array([1.0, 0.0, 3.0, 0.0]) for name in afm.Collision._fields}
    fields["approach_speed_nm_per_us"] = np.array([40.0, 5.0, 20.0, -1.0])
    fields |= {"outcome": np.array([0, 2, 0, 5]), "captured": np.array([False, True, False, False])}
    found = afm.Collision(**fields)
    table, data = found.to_pandas(), found.to_xarray()
    for name in ("rebound_speed_nm_per_us", "viscous_loss_aj"):
        assert table[name].isna().tolist() == [False, True, False, True], name
        assert np.isnan(data[name].to_numpy()).tolist() == [False, True, False, True], name
    # a captured tip has been deep; one that never began has not
    assert table["deepest_gap_nm"].isna().tolist() == [False, False, False, True]
    upper, middle, lower = found.plot(tmp_path / "collide.png").axes
    drawn = {line.get_label(): np.asarray(line.get_xydata()) for line in upper.lines}
    assert drawn["captured"].tolist() == [[5.0, 0.0]]
    np.testing.assert_array_equal(drawn["contact"], [[5.0, np.nan], [20.0, 3.0], [40.0, 1.0]])
    for axes in (middle, lower):
        np.testing.assert_array_equal(axes.lines[0].get_ydata(), [np.nan, 3.0, 1.0])


def test_slots_without_an_orbit_are_in_no_table_and_no_picture(tmp_path: Path):
    numbers, there = np.array([math.nan, 1.0, math.nan, 2.0]), np.array([0, 1, 0, 1], bool)
    flags = {"exists": there, "admissible": there, "stable": there & (numbers < 2.0), "near_double": ~there & there}
    fields = {field.name: numbers for field in dataclasses.fields(afm.SingleImpactOrbits)} | flags
    orbits: Any = saved._built(afm.SingleImpactOrbits, fields | {"complete": np.array(1, bool)})
    assert orbits.to_pandas()["phase_rad"].to_dict() == {1: 1.0, 3: 2.0}
    left = orbits.plot(tmp_path / "orbits.png").axes[0]
    np.testing.assert_allclose([line.get_xydata()[0] for line in left.lines], [[57.29578, 1.0], [114.59156, 2.0]])


def test_rows_without_a_contact_are_in_no_table():
    kinds = jnp.array([ContactKind.IMPACT, ContactKind.HELD, ContactKind.NONE, ContactKind.NONE])
    columns: dict[str, Any] = dict.fromkeys(set(Contacts._fields) - {"detail"}, jnp.arange(4.0)) | {"kind": kinds}
    where, zero = State(*[jnp.zeros(())] * 3), jnp.array(0)
    found = afm.Simulation(where, Contacts(**columns), jnp.array(2), where, zero, zero)
    table = found.to_pandas()
    assert table["contacts_approach_speed_nm_per_us"].tolist() == [0.0, 1.0]
    assert table["contacts_rebound_speed_nm_per_us"].isna().tolist() == [False, True]
