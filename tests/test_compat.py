"""The table of `make compat`: what counts as refused, and a list of refusals that cannot rot."""

from tests.compat.__main__ import FILES, Refusal, judge, refusals, table


def results(**outcomes: str) -> dict[str, dict]:
    return {
        f"test_{name}.py::test[a-{name}]": {"outcome": outcome, "error": f"no {name}"} for name, outcome in outcomes.items()
    }


def test_a_failure_is_refused_only_with_the_error_that_is_meant():
    found = results(run="failed", spaces="failed", predict="passed")
    known = [Refusal(["test_run.py::test[a-*]"], "no run", "", [1]), Refusal(["test_spaces.py::*"], "no reason", "", [1])]
    assert judge(found, known) == ["test_spaces.py::test[a-spaces]: no spaces"]
    assert [result["outcome"] for result in found.values()] == ["refused", "failed", "passed"]
    lines = table(found).splitlines()
    assert lines[0] == "| File | passed | refused | failed | skipped |"
    assert lines[2:] == [
        "| test_run.py | 0 | 1 | 0 | 0 |",
        "| test_spaces.py | 0 | 0 | 1 | 0 |",
        "| test_predict.py | 1 | 0 | 0 | 0 |",
        "| all | 1 | 1 | 1 | 0 |",
    ]


def test_an_entry_of_the_list_that_does_not_hold_any_more_is_said():
    known = [Refusal(["test_run.py::test[a-run]", "test_gone.py::*"], "no run", "", [1])]
    assert judge(results(run="passed"), known) == [
        "refused.yml: test_run.py::test[a-run] passes, though it stands there",
        "refused.yml: no test is called test_gone.py::*",
    ]


def test_every_entry_of_the_list_has_a_reason_and_an_error():
    for refusal in refusals():
        assert refusal.reason
        assert refusal.error
        assert set(refusal.objectives) <= {1, 2}
        assert {pattern.split(".py::")[0].removeprefix("test_") for pattern in refusal.tests} <= set(FILES)
