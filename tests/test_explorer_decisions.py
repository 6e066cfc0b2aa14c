"""The decision kit's mathematics, by hand."""

import time

import numpy as np
import pytest

from sb3_momba.envs.preferences import simplex_lattice
from sb3_momba.explorer.decisions import (
    Bound,
    exchange_rates,
    find_alternatives,
    leave_one_out_errors,
    local_error,
    predict_returns,
    rank_for_bound,
)
from sb3_momba.explorer.prediction import front_predictor, share_close
from sb3_momba.pareto.evaluation import ParetoFront

TWO = np.array([[0.0, 1.0], [0.25, 0.75], [0.5, 0.5], [1.0, 0.0]])


def test_between_two_preferences_returns_are_linear():
    returns = np.array([[0.0, 10.0], [4.0, 8.0], [6.0, 6.0], [10.0, 0.0]])
    wanted = np.array([[0.125, 0.875], [0.5, 0.5], [0.75, 0.25], [1.0, 0.0]])
    np.testing.assert_allclose(predict_returns(wanted, TWO, returns), [[2, 9], [6, 6], [8, 3], [10, 0]])


@pytest.mark.parametrize("n_objectives", [2, 3, 5, 10], ids="{} objectives".format)
def test_linear_fronts_are_predicted_exactly(n_objectives):
    rng = np.random.default_rng(0)
    preferences = simplex_lattice(n_objectives, 4 if n_objectives < 5 else 2)
    slopes = rng.normal(size=(n_objectives, n_objectives))
    wanted = rng.dirichlet(np.ones(n_objectives), size=10)
    np.testing.assert_allclose(predict_returns(wanted, preferences, preferences @ slopes), wanted @ slopes, atol=1e-6)


def test_three_objectives_are_interpolated_in_the_triangle_around():
    """w = (1/2, 1/4, 1/4) lies in the middle of (1, 0, 0) and (0, 1/2, 1/2); beside these there is (0, 1, 0) and (0, 0, 1)."""
    preferences = np.array([[1, 0, 0], [0, 0.5, 0.5], [0, 1, 0], [0, 0, 1.0]])
    returns = np.array([[8.0], [2.0], [100.0], [200.0]])
    np.testing.assert_allclose(predict_returns(np.array([[0.5, 0.25, 0.25]]), preferences, returns), [[5.0]])


def test_three_objectives_are_predicted_in_time():
    """Under 100 ms with an error: the median of 20, as this machine may be busy."""
    preferences = simplex_lattice(3, 12)
    front = ParetoFront(preferences, preferences[:, None], preferences[:, None], np.ones((len(preferences), 1), dtype=np.int64))
    predictor, seconds = front_predictor(front), []
    for wanted in np.random.default_rng(0).dirichlet(np.ones(3), size=(20, 1)):
        start = time.perf_counter()
        predictor.predict(wanted), predictor.error_at(wanted)
        seconds.append(time.perf_counter() - start)
    assert np.median(seconds) < 0.1


def test_outside_of_the_evaluated_preferences_the_nearest_one_speaks():
    inner, returns = np.array([[0.3, 0.7], [0.6, 0.4]]), np.array([[1.0], [2.0]])
    np.testing.assert_array_equal(predict_returns(np.array([[0.0, 1.0], [1.0, 0.0]]), inner, returns), [[1.0], [2.0]])
    triangle = np.array([[0.6, 0.2, 0.2], [0.2, 0.6, 0.2], [0.2, 0.2, 0.6]])
    np.testing.assert_array_equal(predict_returns(np.eye(3)[:1], triangle, np.array([[1.0], [2.0], [3.0]])), [[1.0]])


def test_leave_one_out_by_hand():
    """0.25 between 0 and 0.5 -> 3 instead of 4; 0.5 between 0.25 and 1 -> 4 + 6/3 = 6; the ends have no neighbours."""
    errors = leave_one_out_errors(TWO, np.array([[0.0], [4.0], [6.0], [10.0]]))
    np.testing.assert_allclose(errors, [[np.nan], [-1.0], [0.0], [np.nan]])
    assert np.isnan(leave_one_out_errors(np.array([[0.5, 0.5]]), np.array([[1.0, 2.0]]))).all()


def test_a_local_error_is_the_root_mean_square_of_the_nearest():
    preferences = np.stack([np.linspace(0, 1, 6), np.linspace(1, 0, 6)], axis=1)
    errors = np.array([[np.nan], [3.0], [-1.0], [1.0], [1.0], [np.nan]])
    np.testing.assert_allclose(local_error(np.array([[0.1, 0.9]]), preferences, errors), [[np.sqrt(12 / 4)]])
    assert np.isnan(local_error(TWO, TWO, np.full((4, 2), np.nan))).all()


def test_a_share_counts_rows_that_are_close_in_every_objective():
    measured = np.array([[100.0, -10.0], [100.0, -10.0], [100.0, -10.0], [0.0, 1.0]])
    predicted = np.array([[104.0, -10.4], [104.0, -10.6], [94.0, -10.0], [0.0, 1.0]])
    assert share_close(predicted, measured) == 0.5


def test_exchange_rates_are_the_slope_of_the_front():
    """On (10 w, 20 (1 - w)) one unit of the first objective is worth two of the second, and 1/2 the other way."""
    rates = exchange_rates(lambda w: w * [10.0, 20.0], np.array([0.4, 0.6]), np.array([10.0, 20.0]))
    nothing = [np.nan, np.nan]
    np.testing.assert_allclose(rates, [[nothing, [-1, 2.0]], [[0.5, -1], nothing]])


def test_three_objectives_have_a_trade_for_each_pair_and_what_it_does_to_the_third():
    """The third objective gains 4 for each weight of the first that is lost, whoever gets it."""
    slopes = np.array([[1.0, 0.0, -4.0], [0.0, 2.0, 0.0], [0.0, 0.0, 8.0]])
    rates = exchange_rates(lambda w: w @ slopes, np.full(3, 1 / 3), np.array([1.0, 2.0, 8.0]))
    expected = {(0, 1): [-1, 2, 4], (0, 2): [-1, 0, 12], (1, 0): [0.5, -1, -2], (1, 2): [0, -1, 4]}
    expected |= {(2, 0): [1 / 12, 0, -1], (2, 1): [0, 1 / 4, -1]}
    for pair, change in expected.items():
        np.testing.assert_allclose(rates[pair], change, atol=1e-12)
    assert np.isnan(rates[range(3), range(3)]).all()


def test_no_rate_where_nothing_is_traded():
    flat = exchange_rates(lambda w: np.ones((len(w), 2)), np.array([0.4, 0.6]), np.ones(2))
    both_fall = exchange_rates(lambda w: w[:, :1] * [1.0, 2.0], np.array([0.4, 0.6]), np.ones(2))
    at_the_end = exchange_rates(lambda w: w * [10.0, 20.0], np.array([1.0, 0.0]), np.array([10.0, 20.0]))
    assert np.isnan(flat).all()
    assert np.isnan(both_fall).all()
    np.testing.assert_allclose(at_the_end[[0, 1], [1, 0]], [[-1, 2.0], [0.5, -1]])  # The slope of the one side there is.


def test_a_bound_is_kept_with_the_most_of_the_rest():
    candidates = np.array([[0.0, 0.5, 0.5], [0.2, 0.4, 0.4], [0.6, 0.2, 0.2], [1.0, 0.0, 0.0]])
    returns = np.array([[0.0, 9.0, 9.0], [5.0, 6.0, 1.0], [6.0, 1.0, 6.0], [9.0, 0.0, 0.0]])
    bound = Bound(0, 5.0)
    assert rank_for_bound(bound, np.array([0.0, 0.9, 0.1]), candidates, returns).tolist() == [1, 2, 3]
    assert rank_for_bound(bound, np.array([0.0, 0.1, 0.9]), candidates, returns).tolist() == [2, 1, 3]
    # Without a weight on the others they count alike: 7, 7 and 0, and of equal ones the nearest is first.
    assert rank_for_bound(bound, np.array([1.0, 0.0, 0.0]), candidates, returns).tolist() == [2, 1, 3]
    assert rank_for_bound(Bound(0, 9.1), np.array([1.0, 0.0, 0.0]), candidates, returns).tolist() == []


def test_alternatives_return_alike_and_move_differently():
    returns = np.array([[1.0, 1.0], [1.1, 0.9], [1.1, 0.9], [5.0, 1.0]])
    behaviour = np.array([[0.0, 0.0, 7.0], [0.0, 0.2, 7.0], [2.0, 0.0, 7.0], [2.0, 4.0, 7.0]])
    found = find_alternatives(returns[0], behaviour[0], returns, behaviour, np.array([0.2, 0.2]))
    # Neither itself, nor its neighbour that moves all but alike, nor the one that returns more.
    assert [(one.index, one.feature) for one in found] == [(2, 0)]
    scaled = behaviour[:, :2] / behaviour[:, :2].std(axis=0)
    pairs = [np.sqrt(((scaled[i] - scaled[j]) ** 2).sum() / 3) for i in range(4) for j in range(i)]
    assert found[0].distance == pytest.approx(np.sqrt(scaled[2, 0] ** 2 / 3) / np.mean(pairs))
