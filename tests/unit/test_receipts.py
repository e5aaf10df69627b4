"""Single receipts that another clock wrote are left out and counted; long pauses stay."""

import pytest
from support.tracking import ms

from fgtrack.core.types import Detection, DetectionList, EgoState, TruthState
from fgtrack.inputs.receipts import WRONG_RECEIPT, sorted_out, with_right_receipts

START_NS = 1_700_000_000 * 10**9
HOUR_NS = 3600 * 10**9


def kept(receipts_ns):
    """The receipts that are right, and those that are wrong."""
    decided = list(sorted_out(receipts_ns, lambda each: each))
    return (
        [each for each, is_wrong in decided if not is_wrong],
        [each for each, is_wrong in decided if is_wrong],
    )


def every_100_ms(count, start_ns=START_NS):
    return [start_ns + ms(100.0 * k) for k in range(count)]


@pytest.mark.parametrize("count", [50, 400, 5000])
@pytest.mark.parametrize("wrong_ns", [0, 5 * 10**9, START_NS - 30 * HOUR_NS])
@pytest.mark.parametrize("num_wrong", [1, 4])
def test_receipts_of_another_clock_at_the_start_are_wrong(count, wrong_ns, num_wrong):
    wrong = [wrong_ns + k for k in range(num_wrong)]
    right = every_100_ms(count)
    assert kept([*wrong, *right]) == (right, wrong)


@pytest.mark.parametrize("wrong_ns", [0, START_NS + HOUR_NS + ms(60_000.0), 1 << 62])
@pytest.mark.parametrize("number", [30, 299, 300])
def test_a_single_wrong_receipt_in_the_middle_or_at_the_end(wrong_ns, number):
    right = every_100_ms(300)
    given = [*right[:number], wrong_ns, *right[number:]]
    assert kept(given) == (right, [wrong_ns])


def test_two_wrong_receipts_with_different_times():
    right = every_100_ms(300)
    given = [*right[:100], 0, 1 << 61, *right[100:200], 7, *right[200:]]
    assert kept(given) == (right, [0, 1 << 61, 7])


@pytest.mark.parametrize("parts", [(300, 300), (300, 60), (60, 300), (3, 4), (1, 1)])
def test_a_long_pause_is_right(parts):
    first, second = parts
    given = [
        *every_100_ms(first),
        *every_100_ms(second, START_NS + 5 * HOUR_NS),
    ]
    assert kept(given) == (given, [])


def test_a_pause_below_an_hour_is_right():
    given = [START_NS, START_NS + HOUR_NS, START_NS + 2 * HOUR_NS]
    assert kept(given) == (given, [])


def test_the_receipt_zero_before_simulated_times_is_wrong():
    right = every_100_ms(60, 100 * 10**9)
    assert kept([0, 0, *right]) == (right, [0, 0])
    from_zero = every_100_ms(60, 0)
    assert kept(from_zero) == (from_zero, [])


def test_truth_has_no_receipt_that_counts(tmp_path):
    truth = TruthState(0, 0, 1, x_m=0.0, y_m=0.0)
    egos = [
        EgoState(t, t, x_m=0.0, y_m=0.0, yaw_rad=0.0, speed_mps=1.0)
        for t in every_100_ms(200)
    ]
    given = [*egos[:5], truth, *egos[5:150], truth, *egos[150:]]
    assert list(with_right_receipts(tmp_path, given)) == given


@pytest.mark.parametrize("far_ns", [11 * 10**9, 2 * HOUR_NS])
@pytest.mark.parametrize("number", [1, 4, 150])
def test_truth_keeps_its_index_beside_a_receipt_that_is_far(far_ns, number):
    zeros = [(0, "ego")] * number
    given = [*zeros, (far_ns, "ego"), (None, "truth"), (far_ns, "ego"), (None, "truth")]
    decided = list(sorted_out(given, lambda each: each[0]))
    assert sorted(is_wrong for each, is_wrong in decided if each[1] == "truth") == [
        False,
        False,
    ]
    assert [each for each, _ in decided] == given


def test_left_out_detections_are_counted_in_the_next_list_of_their_sensor(
    tmp_path, caplog
):
    objects = (Detection(1.0, 2.0), Detection(3.0, 4.0))
    lists = [
        DetectionList(name, t, t, objects, "map")
        for t in every_100_ms(100)
        for name in ("radar", "lidar")
    ]
    lists[0] = DetectionList("radar", START_NS, 0, objects, "map")
    read = list(with_right_receipts(tmp_path, lists))
    assert len(read) == 199
    assert [each.left_out for each in read if each.left_out] == [(WRONG_RECEIPT,) * 2]
    assert next(each for each in read if each.left_out).sensor == "radar"
    assert "receipts that do not fit the others: 1 of radar" in caplog.text
