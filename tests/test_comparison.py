"""Models compared on one table: information criteria, and what becomes of a rival that cannot be fitted."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from afm_jax.cli.main import main
from fitting.infer import comparison
from fitting.infer.comparison import compare
from fitting.infer.fit import fit
from tests.fit_tables import EXAMPLE, table
from tests.strict_reading import strictly

__all__ = ["table"]
MODELS = ("law", "restitution", "viscous")


@pytest.fixture(scope="module")
def compared(table):
    return compare(table, MODELS)


@pytest.fixture(scope="module")
def fitted(table):
    """Return the fits of the models that stand, as `compare` takes them."""
    return {model: fit(table, model) for model in MODELS if model != "viscous"}


@pytest.mark.slow
def test_models_are_compared_by_their_information(compared):
    assert compared.failed == {}
    rows = {row["model"]: row for row in compared.rows}
    assert set(rows) == set(MODELS)
    for model, row in rows.items():
        count = len(compared.results[model].parameters)
        # 164 amplitudes and the constraint on Q
        assert row["degrees_of_freedom"] == 165 - count
        assert row["aic"] == pytest.approx(row["chi2"] + 2.0 * count)
    assert [row["aic"] for row in compared.rows] == sorted(row["aic"] for row in compared.rows)
    # the table is made of the law r = 0.95, epsilon = 200
    assert compared.rows[0]["model"] == "law"
    assert "tells plainly: law: a restitution with adhesion" in compared.verdict


@pytest.mark.slow
def test_a_rival_that_fails_is_reported_beside_those_that_stand(table, compared, fitted, monkeypatch):
    """Those that stand are known already, and not fitted again."""

    def fails(*_, **__):
        raise FloatingPointError

    monkeypatch.setattr(comparison, "fit", fails)
    found = compare(table, MODELS, known=fitted)
    assert found.failed == {"viscous": "FloatingPointError"}
    assert "The fit of viscous failed: FloatingPointError." in found.verdict
    without = [row for row in compared.rows if row["model"] != "viscous"]
    assert [row["model"] for row in found.rows] == [row["model"] for row in without]
    assert found.rows[0]["chi2"] == pytest.approx(without[0]["chi2"])


def test_a_model_alone_is_compared_with_nothing(table):
    found = compare(table, ("law", "viscous"), constraints={"r": (0.95, 0.01), "quality_factor": (40.0, 0.4)})
    assert list(found.results) == ["law"]
    assert "the constraint on 'r' is on no parameter" in found.failed["viscous"]
    assert found.verdict.startswith("There is nothing to compare law: a restitution with adhesion (r, epsilon) with.")


def test_a_wrong_call_is_no_failed_rival(table):
    with pytest.raises(ValueError, match="at least two different models"):
        compare(table, ("law", "law"))
    with pytest.raises(ValueError, match="the constraint on 'rr' is on no parameter"):
        compare(table, ("law", "viscous"), constraints={"rr": (1.0, 0.1)})


@pytest.mark.slow
def test_the_fit_stands_if_all_that_was_asked_for_besides_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def fail(*_, **__):
        raise OverflowError("math range error")

    # the command has imported the function by its name
    monkeypatch.setattr("afm_jax.cli.fit.compare", fail)
    done = CliRunner().invoke(main, ["fit", str(EXAMPLE), "--compare", "--json", "--out", str(tmp_path)])
    assert done.exit_code == 1
    assert strictly(done.stdout)["valid"] is True
    assert "OverflowError: math range error" in done.stderr.splitlines()[-1]
    assert (tmp_path / "fit.json").exists()


@pytest.mark.slow
@pytest.mark.long
def test_a_law_without_adhesion_is_a_rival_like_any_other(contact_table_path: Path):
    arguments = ["fit", str(contact_table_path), "--model", "restitution+delay", "--compare", "--json"]
    done = CliRunner().invoke(main, arguments)
    answer = strictly(done.stdout)
    assert done.exit_code == 3
    found = {row["model"]: row for row in answer["comparison"]["rows"]}
    assert set(found) == {"restitution+delay", "law+delay", "viscous+delay"}
    assert {model for model, row in found.items() if row["valid"]} == {"law+delay", "viscous+delay"}
    # the resolved contact, whose loss grows with speed and which holds slow tips: restitution alone is far off
    assert found["restitution+delay"]["largest_distance"] > 10.0 * found["viscous+delay"]["largest_distance"]
    assert answer["comparison"]["rows"][-1]["model"] == "restitution+delay"
    # a model has one chi2
    assert found["restitution+delay"]["chi2"] == answer["chi2"]
