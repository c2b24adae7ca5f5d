"""Models compared on one table: information criteria, and wrong calls."""

import pytest

from fitting.infer.comparison import compare
from tests.fit_tables import law, table

__all__ = ["law", "table"]
MODELS = ("law", "restitution", "viscous")


@pytest.fixture(scope="module")
def compared(table):
    return compare(table, MODELS)


@pytest.mark.slow
def test_models_are_compared_by_their_information(compared):
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
    assert "decides for law: a restitution with adhesion" in compared.verdict


def test_a_wrong_call_is_no_failed_rival(table):
    with pytest.raises(ValueError, match="at least two different models"):
        compare(table, ("law", "law"))
    with pytest.raises(ValueError, match="the constraint on 'rr' is on no parameter"):
        compare(table, ("law", "viscous"), constraints={"rr": (1.0, 0.1)})
