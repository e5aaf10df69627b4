"""The noise of a sensor's components by the scatter of its detections."""

import math

import numpy as np
import pytest

from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.meaning.assumed import assumed, source_of
from fgtrack.meaning.scattered_noise import scattered_noise
from fgtrack.meaning.tracklets import points_of

_PERIOD_S = 0.1
_STARTS = ((10.0, -60.0, 0.0, 2.5), (60.0, 20.0, -1.8, 0.0), (30.0, 5.0, 0.3, -0.4))


def _lists(measure, lists=400):
    """Yield an ego at rest, and lists of three cars; `measure` gives the detection of a position and a velocity."""
    for number in range(lists):
        stamp_s = number * _PERIOD_S
        stamp_ns = round(1e9 * stamp_s)
        yield EgoState(stamp_ns, stamp_ns, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        cars = [
            measure(x_m + vx * stamp_s, y_m + vy * stamp_s, vx, vy)
            for x_m, y_m, vx, vy in _STARTS
        ]
        yield DetectionList("sensor", stamp_ns, stamp_ns + 1, cars, frame="ego")


def _noise_of(measure, lists=400):
    points, _ = points_of(_lists(measure, lists))
    return scattered_noise(points["sensor"])


def _is_in_interval(found, true):
    return abs(found.noise.std - true) <= found.half_width * found.noise.std


@pytest.mark.parametrize("seed", range(3))
def test_the_intervals_contain_the_noise_of_ranges_bearings_and_range_rates(seed):
    rng = np.random.default_rng(seed)

    def measure(x_m, y_m, vx_mps, vy_mps):
        range_m = math.hypot(x_m, y_m)
        return Detection(
            range_m=range_m + 0.3 * rng.normal(),
            bearing_rad=math.atan2(y_m, x_m) + 0.01 * rng.normal(),
            range_rate_mps=(x_m * vx_mps + y_m * vy_mps) / range_m + 0.2 * rng.normal(),
        )

    found = _noise_of(measure)
    true = {"range_m": 0.3, "bearing_rad": 0.01, "range_rate_mps": 0.2}
    assert found.keys() == true.keys()
    for name, std in true.items():
        assert found[name].half_width < 0.15
        # An interval of 95 % is missed now and then; none is missed by half of it.
        assert abs(found[name].noise.std / std - 1.0) < 1.5 * found[name].half_width


def test_noise_that_grows_with_the_range_grows_along_the_sight_alone():
    rng = np.random.default_rng(1)

    def measure(x_m, y_m, *_):
        range_m = math.hypot(x_m, y_m)
        scale = 1.0 + 0.03 * rng.normal()
        across_m = 0.2 * rng.normal()
        return Detection(
            x_m=scale * x_m - across_m * y_m / range_m,
            y_m=scale * y_m + across_m * x_m / range_m,
        )

    found = _noise_of(measure)
    along, across = found["x_m"].noise, found["y_m"].noise
    assert along.at(50.0) == pytest.approx(1.5, rel=0.2)
    assert along.at(15.0) == pytest.approx(0.45, rel=0.4)
    assert across.growth == 0.0
    assert across.std == pytest.approx(0.2, rel=0.15)


def test_errors_that_are_correlated_over_some_lists_count():
    rng = np.random.default_rng(2)
    errors = np.zeros((3, 2))
    number = 0

    def measure(x_m, y_m, *_):
        nonlocal number
        car = number % 3
        number += 1
        # Two thirds of the error stay until the next list; the standard deviation is 0.5 m.
        errors[car] = 0.67 * errors[car] + 0.5 * math.sqrt(1 - 0.67**2) * rng.normal(
            size=2
        )
        return Detection(x_m=x_m + errors[car][0], y_m=y_m + errors[car][1])

    found = _noise_of(measure, 800)
    assert found["x_m"].noise.std == pytest.approx(0.5, rel=0.25)
    assert found["y_m"].noise.std == pytest.approx(0.5, rel=0.25)


def test_few_detections_show_no_noise():
    assert _noise_of(lambda x_m, y_m, *_: Detection(x_m=x_m, y_m=y_m), 20) == {}


def _draft(measure):
    return assumed(Config(), source_of(lambda: _lists(measure)))


def test_a_draft_has_the_noise_of_the_scatter_and_its_interval():
    rng = np.random.default_rng(3)

    def measure(x_m, y_m, *_):
        return Detection(
            range_m=math.hypot(x_m, y_m) + 0.25 * rng.normal(),
            bearing_rad=math.atan2(y_m, x_m) + 0.004 * rng.normal(),
        )

    draft = _draft(measure)
    std = draft.config.sensors["sensor"].std
    assert std["range_m"] == pytest.approx(0.25, rel=0.15)
    assert std["bearing_rad"] == pytest.approx(0.004, rel=0.15)
    (line,) = [each for each in draft.lines() if "standard deviations" in each]
    assert "scatter of" in line
    assert "range_m +- " in line


def test_exact_positions_have_a_tenth_of_the_usual_noise():
    draft = _draft(lambda x_m, y_m, *_: Detection(x_m=x_m, y_m=y_m))
    assert draft.config.sensors["sensor"].std == {"x_m": 0.1, "y_m": 0.1}


def test_boxes_of_a_lone_sensor_keep_the_usual_noise():
    rng = np.random.default_rng(4)

    def measure(x_m, y_m, *_):
        return Detection(
            x_m=x_m + 0.05 * rng.normal(),
            y_m=y_m + 0.05 * rng.normal(),
            length_m=4.0,
            width_m=1.8,
        )

    assert _draft(measure).config.sensors["sensor"].std == {"x_m": 0.3, "y_m": 0.3}


@pytest.mark.parametrize(
    ("speed_mps", "expected_mps"), [(30.0, 30.0), (3.0, 15.0), (69.0, 69.0)]
)
def test_new_tracks_are_expected_to_be_as_fast_as_the_objects(speed_mps, expected_mps):
    rng = np.random.default_rng(5)

    def lists():
        for number in range(400):
            stamp_s = number * _PERIOD_S
            stamp_ns = round(1e9 * stamp_s)
            # The ego drives at 10 m/s; a car appears every 2 s, and stays for 3 s.
            yield EgoState(stamp_ns, stamp_ns, 10.0 * stamp_s, 0, 0, 10.0, 0, 0)
            ages_s = stamp_s % 2.0, stamp_s % 2.0 + 2.0
            cars = [
                Detection(
                    x_m=(speed_mps - 10.0) * age_s - 50.0 + 0.1 * rng.normal(),
                    y_m=4.0 + 0.1 * rng.normal(),
                )
                for age_s in ages_s
                if age_s < 3.0 and age_s <= stamp_s
            ]
            yield DetectionList("sensor", stamp_ns, stamp_ns + 1, cars, frame="ego")

    draft = assumed(Config(), source_of(lists))
    assert draft.config.birth.speed_std_mps == pytest.approx(expected_mps, rel=0.06)


def test_few_objects_show_no_speed():
    draft = _draft(lambda x_m, y_m, *_: Detection(x_m=x_m, y_m=y_m))
    assert draft.config.birth == Config().birth
