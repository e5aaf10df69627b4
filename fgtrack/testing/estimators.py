"""Promises of every estimator, in any order of arrival."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from fgtrack.estimation.registry import ESTIMATORS, EXACT, Claims, Factory
from fgtrack.models.motion import MotionModel
from fgtrack.testing.banks import gives_each_of_several_objects_what_it_gives_one_alone
from fgtrack.testing.promise import Draw, Promise, Subject, run_all
from fgtrack.testing.state_promises import (
    fuses_a_late_measurement_exactly,
    gives_the_dense_joint_posterior_in_any_order,
    gives_the_estimate_of_the_time_order_in_any_order,
    gives_the_posterior_of_a_nonlinear_model,
    is_the_kalman_filter_in_sequence,
    keeps_all_that_it_accepts_and_nothing_else,
    predicts_ahead_by_the_motion_model,
    reports_the_innovation_against_all_that_it_has_fused,
)
from fgtrack.testing.streams import (
    LAG_S,
    LINEAR,
    NONLINEAR,
    Stream,
    informative,
    one_late,
    regular,
    shuffled,
    with_outliers,
)
from fgtrack.testing.update_promises import (
    changes_no_input_and_no_output_later,
    counts_each_measurement_as_what_it_is,
    gives_symmetric_positive_definite_covariances,
    gives_the_same_bits_for_the_same_input,
    moves_only_the_window_with_the_clock,
    reports_what_is_too_old_and_stays_as_it_was,
    stays_as_it_was_after_a_failure_and_fuses_the_next,
)

_FIRST_LATE, _ONE_LAG = (
    "any lag, first late measurement",
    "one lag, first late measurement",
)


def _drawn(make: Callable[..., Stream], *what: MotionModel | int) -> tuple[Draw, ...]:
    return tuple(partial(make, each) for each in what)


_BOTH = (LINEAR, NONLINEAR)
_PROMISES = (
    Promise(
        is_the_kalman_filter_in_sequence,
        _drawn(regular, LINEAR),
        lambda claims: not claims.mixes,
    ),
    Promise(
        gives_the_dense_joint_posterior_in_any_order,
        _drawn(shuffled, LINEAR),
        lambda claims: claims.is_exact,
        repeats=True,
    ),
    Promise(
        keeps_all_that_it_accepts_and_nothing_else,
        (partial(shuffled, LINEAR, span_s=4.0 * LAG_S),),
        lambda claims: claims.is_exact,
        repeats=True,
    ),
    Promise(
        gives_the_estimate_of_the_time_order_in_any_order,
        _drawn(shuffled, NONLINEAR),
        lambda claims: claims.is_exact and claims.nonlinear != "never",
        repeats=True,
    ),
    Promise(
        fuses_a_late_measurement_exactly,
        _drawn(one_late, 1),
        lambda claims: claims.exact == _ONE_LAG,
    ),
    Promise(
        fuses_a_late_measurement_exactly,
        _drawn(one_late, 1, 2, 6),
        lambda claims: claims.exact == _FIRST_LATE,
    ),
    Promise(
        reports_the_innovation_against_all_that_it_has_fused,
        _drawn(shuffled, *_BOTH),
        lambda claims: claims.is_exact,
        repeats=True,
    ),
    Promise(counts_each_measurement_as_what_it_is, _drawn(shuffled, *_BOTH)),
    Promise(
        gives_symmetric_positive_definite_covariances,
        _drawn(shuffled, *_BOTH),
        repeats=True,
    ),
    Promise(gives_the_same_bits_for_the_same_input, _drawn(shuffled, *_BOTH)),
    Promise(changes_no_input_and_no_output_later, _drawn(shuffled, *_BOTH)),
    Promise(reports_what_is_too_old_and_stays_as_it_was, _drawn(regular, *_BOTH)),
    Promise(
        stays_as_it_was_after_a_failure_and_fuses_the_next, _drawn(regular, *_BOTH)
    ),
    Promise(moves_only_the_window_with_the_clock, _drawn(regular, *_BOTH)),
    Promise(
        predicts_ahead_by_the_motion_model,
        _drawn(regular, *_BOTH),
        lambda claims: not claims.mixes,
    ),
    Promise(
        gives_the_posterior_of_a_nonlinear_model,
        (informative, with_outliers),
        lambda claims: not claims.mixes,
    ),
    Promise(
        gives_each_of_several_objects_what_it_gives_one_alone, _drawn(regular, *_BOTH)
    ),
)


def check_estimator(
    factory: str | Factory,
    *,
    exact: bool | str | None = None,
    seed: int = 0,
    num_streams: int = 10,
    **options: Any,
) -> None:
    """Raise `BrokenPromiseError` unless an estimator keeps the contract, with the measurements that show it.

    Parameters
    ----------
    factory
        Name of a registered estimator, or a class or function `(motion, start, lag_s, **options) -> Estimator`. A
        factory with a true attribute `bank` is called as `(motion, lag_s, **options) -> TrackBank`.
    exact
        True requires the dense joint posterior of a linear model in any order of arrival; False does not. A text
        has the meaning of `Claims.exact`. None takes the claims of the factory.
    seed, num_streams
        Seed, and number of random streams for each promise about any order of arrival.
    options
        Keyword parameters of the factory.
    """
    checks = estimator_checks(
        factory, exact=exact, seed=seed, num_streams=num_streams, **options
    )
    run_all(_name(factory), checks)


def estimator_checks(
    factory: str | Factory,
    *,
    exact: bool | str | None = None,
    seed: int = 0,
    num_streams: int = 10,
    **options: Any,
) -> dict[str, Callable[[], None]]:
    """Return the checks of `check_estimator` by name of the promise, for `pytest.mark.parametrize`."""
    made = ESTIMATORS.load(factory) if isinstance(factory, str) else factory
    claims = Claims.of(made)
    if exact is not None:
        claims = replace(
            claims, exact=exact if isinstance(exact, str) else EXACT if exact else ""
        )
    subject = Subject(_name(factory), made, claims, options)
    promised = [promise for promise in _PROMISES if promise.applies(claims)]
    return {
        promise.name: partial(promise.run, subject, seed, num_streams)
        for promise in promised
    }


def _name(factory: str | Factory) -> str:
    return (
        factory
        if isinstance(factory, str)
        else getattr(factory, "__name__", repr(factory))
    )
