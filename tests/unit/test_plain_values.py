"""Numbers of NumPy are taken as plain numbers, and whatever is no number has one clear reason, live and from files."""

import json
import math
from array import array
from dataclasses import fields, replace
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fgtrack
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.registry import ESTIMATORS, estimator
from fgtrack.inputs.source import open_input
from fgtrack.inputs.validation import InvalidMessageError, validated_message
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.pipeline.live import Tracker
from fgtrack.pipeline.message_checks import MOST_UNKNOWN, OTHERS

MS = 1_000_000
NOW_NS = 1_600_000_000_000_000_000
EGO = EgoState(NOW_NS, NOW_NS, 1.0, 2.0, 0.5, 3.0)
TRUTH = TruthState(NOW_NS, NOW_NS, 3, 1.0, 2.0, 0.5)
SEEN = Detection(x_m=10.0, y_m=2.0, stamp_ns=NOW_NS, object_id=4, score=0.5)
LIST = DetectionList("radar", NOW_NS, NOW_NS, (SEEN,), "map")

INTEGERS = [
    np.int8,
    np.uint8,
    np.int16,
    np.uint16,
    np.int32,
    np.uint32,
    np.int64,
    np.uint64,
    np.array,
    np.intp,
]
REALS = [
    np.float16,
    np.float32,
    np.float64,
    np.longdouble,
    np.int16,
    np.uint64,
    int,
    Fraction,
    np.array,
]
NO_INTEGERS = [
    True,
    np.True_,
    5.0,
    np.float64(5.0),
    "5",
    b"5",
    math.nan,
    2**63,
    np.uint64(2**63),
    [5],
    np.array([5]),
]
NO_NUMBERS = [
    True,
    np.False_,
    "5.0",
    1j,
    np.complex128(1.0),
    [1.0],
    np.array([1.0]),
    Decimal(5),
    {},
    10**400,
]


def plain_values(item: Any) -> list[tuple[str, type, Any]]:
    """Name, type and value of every field, and of every field of its objects."""
    own = [
        (each.name, type(getattr(item, each.name)), getattr(item, each.name))
        for each in fields(item)
    ]
    return own + [
        row for part in getattr(item, "objects", ()) for row in plain_values(part)
    ]


@pytest.mark.parametrize("make", INTEGERS, ids=lambda make: make.__name__)
def test_integers_of_other_types_are_plain_integers(make: Any) -> None:
    for message in (
        EGO,
        TRUTH,
        replace(LIST, objects=(replace(SEEN, stamp_ns=77, object_id=77),)),
    ):
        plain: Any = replace(message, stamp_ns=77, receipt_ns=77)
        given = replace(plain, stamp_ns=make(77), receipt_ns=make(77))
        if isinstance(given, DetectionList):
            given = replace(
                given, objects=(replace(SEEN, stamp_ns=make(77), object_id=make(77)),)
            )
        assert plain_values(validated_message(given)) == plain_values(plain)


@pytest.mark.parametrize("make", REALS, ids=lambda make: make.__name__)
def test_numbers_of_other_types_are_plain_floats(make: Any) -> None:
    ego = replace(EGO, x_m=make(6), speed_mps=make(6), in_pit=np.True_)
    assert plain_values(validated_message(ego)) == plain_values(
        replace(EGO, x_m=6.0, speed_mps=6.0, in_pit=True)
    )
    truth = replace(TRUTH, yaw_rad=make(6), ignored=np.False_)
    assert plain_values(validated_message(truth)) == plain_values(
        replace(TRUTH, yaw_rad=6.0, ignored=False)
    )
    seen = replace(
        LIST,
        sensor=np.str_("radar"),
        objects=(replace(SEEN, range_m=make(6), score=make(1)),),
    )
    expected = replace(LIST, objects=(replace(SEEN, range_m=6.0, score=1.0),))
    assert plain_values(validated_message(seen)) == plain_values(expected)


@pytest.mark.parametrize("wrong", NO_INTEGERS, ids=repr)
@pytest.mark.parametrize("name", ["stamp_ns", "receipt_ns"])
def test_a_time_that_is_no_integer_has_one_clear_line(name: str, wrong: Any) -> None:
    for message in (EGO, TRUTH, LIST):
        with pytest.raises(
            InvalidMessageError, match=f"^{name}: a 64 bit integer expected, not "
        ) as error:
            validated_message(replace(message, **{name: wrong}))
        assert "\n" not in str(error.value)
    tracker = Tracker("open_space", estimator="ekf-replay")
    tracker.receive(replace(EGO, **{name: wrong}))
    tracker.receive(replace(LIST, **{name: wrong}))
    report = tracker.tick(NOW_NS)
    assert tracker.refused == {
        f"ego state: {name}: a 64 bit integer expected": 1,
        f"object list: {name}: a 64 bit integer expected": 1,
    }
    assert [row.disposition for row in report.updates] == ["invalid"]
    assert type(report.updates[0].stamp_ns) is int


@pytest.mark.parametrize("wrong", NO_NUMBERS, ids=lambda wrong: repr(wrong)[:20])
def test_a_value_that_is_no_number_has_one_clear_line(wrong: Any) -> None:
    for message in (
        replace(EGO, yaw_rad=wrong),
        replace(TRUTH, x_m=wrong),
        replace(LIST, objects=(Detection(wrong),)),
    ):
        with pytest.raises(
            InvalidMessageError, match=r"(^|: )\w+: a number expected, not "
        ):
            validated_message(message)
    tracker = Tracker("open_space", estimator="ekf-replay")
    tracker.receive(replace(EGO, yaw_rad=wrong))
    tracker.receive(replace(LIST, objects=(SEEN, replace(SEEN, speed_mps=wrong))))
    report = tracker.tick(NOW_NS)
    reasons = {
        "ego state: yaw_rad: a number expected": 1,
        "detection: speed_mps: a number expected": 1,
    }
    assert tracker.refused == reasons
    assert sorted(row.disposition for row in report.updates) == ["birth", "invalid"]


FORMS: dict[str, Any] = {
    "tuple": lambda P: tuple(P.ravel().tolist()),
    "list": lambda P: P.ravel().tolist(),
    "array": lambda P: P,
    "flat array": lambda P: P.ravel(),
    "rows": lambda P: P.tolist(),
    "rows of tuples": lambda P: tuple(map(tuple, P.tolist())),
    "rows of arrays": lambda P: list(P),
    "single precision": lambda P: P.astype(np.float32),
    "column-major": np.asfortranarray,
    "objects": lambda P: P.astype(object),
    "NumPy scalars": lambda P: tuple(P.ravel()),
    "array of Python": lambda P: array("d", P.ravel()),
}


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.replace(" ", "-"))
def test_a_covariance_may_have_any_form(form: str) -> None:
    P = np.diag([0.25, 0.5, 0.0078125, 0.125, 0.015625]) + 0.00390625 * (
        np.eye(5, k=1) + np.eye(5, k=-1)
    )
    ego, seen = (
        validated_message(replace(EGO, covariance=FORMS[form](P))),
        FORMS[form](P[:2, :2]),
    )
    assert isinstance(ego, EgoState)
    assert ego.covariance == tuple(P.ravel().tolist())
    rows = []
    for covariance in (seen, tuple(P[:2, :2].ravel().tolist())):
        tracker = Tracker(
            "open_space", estimator="ekf-replay", set={"ego.uncertainty": "independent"}
        )
        for ago in (2, 1, 0):
            at_ns = NOW_NS - ago * 10 * MS
            tracker.receive(
                replace(
                    EGO, stamp_ns=at_ns, receipt_ns=at_ns, covariance=FORMS[form](P)
                )
            )
        detection = Detection(x_m=10.0, y_m=2.0, covariance=covariance)
        tracker.receive(replace(LIST, objects=(detection,), frame="ego"))
        [track] = tracker.tick(NOW_NS).tracks
        rows.append(track.covariance)
        assert not tracker.refused
    np.testing.assert_array_equal(*rows)


@pytest.mark.parametrize(
    "wrong",
    [
        "1234",
        b"1234",
        {"x": 1.0},
        5.0,
        (0.1, 0.0, 0.0, "0.1"),
        [[0.1, 0.0], [0.0]],
        np.zeros((1, 4)),
        np.zeros((2, 2, 1)),
        np.array("x"),
        (0.1, 0.0, 0.0, True),
        np.eye(2) > 0.5,
        np.eye(2) + 0j,
    ],
    ids=lambda wrong: repr(wrong)[:25],
)
def test_what_is_no_covariance_has_one_clear_line(wrong: Any) -> None:
    with pytest.raises(
        InvalidMessageError,
        match=r"^radar: objects\[0\]: covariance: a list of numbers expected, not ",
    ):
        validated_message(replace(LIST, objects=(replace(SEEN, covariance=wrong),)))
    with pytest.raises(InvalidMessageError, match=r"^covariance: a list of "):
        validated_message(replace(EGO, covariance=wrong))
    tracker = Tracker("open_space", estimator="ekf-replay")
    tracker.receive(replace(EGO, covariance=wrong))
    tracker.receive(replace(LIST, objects=(SEEN, replace(SEEN, covariance=wrong))))
    report = tracker.tick(NOW_NS)
    assert sorted(row.disposition for row in report.updates) == ["birth", "invalid"]
    assert sum(tracker.refused.values()) == 2
    assert all("cannot be read" not in reason for reason in tracker.refused)


def stream(path: Path, *records: dict[str, Any]) -> Path:
    """A stream of these records."""
    header = {"type": "header", "format": "fgtrack-stream/1"}
    path.write_text("".join(json.dumps(record) + "\n" for record in (header, *records)))
    return path


@pytest.mark.parametrize("hole", [None, math.nan, math.inf, -math.inf], ids=str)
@pytest.mark.parametrize("at", [0, 1, 3])
def test_a_covariance_with_a_hole_is_invalid_live_and_from_a_file(
    tmp_path: Path, hole: float | None, at: int
) -> None:
    covariance: list[Any] = [0.1, 0.0, 0.0, 0.2]
    covariance[at] = hole
    times = {"stamp_ns": NOW_NS, "receipt_ns": NOW_NS}
    good = {"x_m": 40.0, "y_m": 2.0}
    record = {"type": "detections", "sensor": "radar", **times, "frame": "map"}
    path = stream(
        tmp_path / "a.jsonl",
        record | {"objects": [good, {**good, "x_m": 10.0, "covariance": covariance}]},
    )
    run = fgtrack.replay(path, "open_space", estimator="ekf-replay")
    assert sorted(run.tables["updates"]["disposition"]) == ["birth", "invalid"]
    assert run.meta["first_failure"] is None
    tracker = Tracker("open_space", estimator="ekf-replay")
    tracker.receive(
        replace(
            LIST,
            objects=(Detection(40.0, 2.0), Detection(10.0, 2.0, covariance=covariance)),
        )
    )
    tracker.tick(NOW_NS)
    assert tracker.counts == {"radar": {"birth": 1, "invalid": 1}}
    assert tracker.failures == {}


@pytest.mark.parametrize("hole", [None, math.nan])
def test_an_ego_covariance_with_a_hole_is_refused_where_it_is_used(
    tmp_path: Path, hole: float | None
) -> None:
    holed = (0.01, *[0.0] * 5, hole, *[0.0] * 18)
    for uncertainty, refused in ("independent", {"not a covariance": 30}), ("none", {}):
        tracker = Tracker(
            "open_space", estimator="ekf-replay", set={"ego.uncertainty": uncertainty}
        )
        for k in range(30):
            at_ns = NOW_NS + k * 50 * MS
            tracker.receive(
                replace(
                    EGO,
                    stamp_ns=at_ns,
                    receipt_ns=at_ns,
                    x_m=0.15 * k,
                    covariance=holed,
                )
            )
        tracker.tick(at_ns)
        assert tracker.refused == refused
        assert tracker.failures == {}


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"covariance": "1 0 0 1"}, "covariance: a list of numbers expected"),
        (
            {"covariance": [1.0, 0.0, 0.0, "1"]},
            "covariance: a list of numbers expected",
        ),
        ({"covariance": [[1.0, 0.0], [0.0]]}, "covariance: a list of numbers expected"),
        ({"x_m": "10"}, "x_m: a number expected"),
        ({"x_m": True}, "x_m: a number expected"),
        ({"stamp_ns": 1.5e18}, "stamp_ns: a 64 bit integer expected"),
        ({"stamp_ns": True}, "stamp_ns: a 64 bit integer expected"),
    ],
    ids=str,
)
def test_a_wrong_value_of_a_stream_names_its_line(
    tmp_path: Path, wrong: dict[str, Any], complaint: str
) -> None:
    times = {"stamp_ns": NOW_NS, "receipt_ns": NOW_NS}
    record = {
        "type": "detections",
        "sensor": "radar",
        **times,
        "objects": [{"x_m": 10.0, "y_m": 2.0, **wrong}],
    }
    path = stream(
        tmp_path / "a.jsonl",
        {"type": "ego", **times, "x_m": 0, "y_m": 0, "yaw_rad": 0, "speed_mps": 0},
        record,
    )
    with pytest.raises(
        DataError, match=rf"a\.jsonl:3: radar: objects\[0\]: {complaint}, not "
    ) as error:
        list(open_input(path).messages())
    assert str(error.value).isprintable()


def test_a_square_covariance_of_a_stream_is_read_as_a_flat_one(tmp_path: Path) -> None:
    times = {"stamp_ns": NOW_NS, "receipt_ns": NOW_NS}
    pose = {"type": "ego", **times, "x_m": 0, "y_m": 0, "yaw_rad": 0, "speed_mps": 0}
    [ego] = open_input(
        stream(tmp_path / "a.jsonl", {**pose, "covariance": np.eye(5).tolist()})
    ).messages()
    assert isinstance(ego, EgoState)
    assert ego.covariance == tuple(np.eye(5).ravel().tolist())


def drive(integer: Any, real: Any, num: int = 30) -> list[Message]:
    """A car ahead of a moving ego, with numbers of these types."""
    messages: list[Message] = []
    for k in range(num):
        at_ns = NOW_NS + 50 * MS * k
        messages.append(
            EgoState(
                integer(at_ns),
                integer(at_ns),
                real(0.5 * k),
                real(0.0),
                real(0.0),
                real(10.0),
            )
        )
        seen = [
            Detection(
                x_m=real(20.0 + 0.25 * (k % 3)), y_m=real(1.5), object_id=integer(7)
            )
        ]
        messages.append(
            DetectionList(
                "radar", integer(at_ns), integer(at_ns + 30 * MS), seen, frame="ego"
            )
        )
    return messages


@pytest.mark.parametrize(
    "integer", [np.int64, np.uint64, np.array], ids=lambda make: make.__name__
)
@pytest.mark.parametrize("name", ["ekf-replay", "smoother-banded"])
def test_stamps_of_other_types_give_the_same_bits_and_do_not_wrap(
    name: str, integer: Any
) -> None:
    found = []
    for make, real in ((int, float), (integer, np.float32)):
        tracker, rows = Tracker("open_space", estimator=name), list[bytes]()
        for message in drive(make, real):
            tracker.receive(message)  # type: ignore[arg-type]
            for track in tracker.tick(int(message.receipt_ns)).tracks:
                rows.append(track.state.mean.tobytes() + track.covariance.tobytes())
        found.append(
            (
                rows,
                tracker.refused,
                tracker.counts,
                tracker.lateness["radar"].delay_median_s,
            )
        )
        run = fgtrack.replay(drive(make, real), "open_space", estimator=name)
        found[-1] = (*found[-1], run.meta["digest"])
    assert found[0] == found[1]
    assert found[0][2] == {"radar": {"birth": 1, "in_sequence": 29}}


def test_messages_of_a_replay_are_named_by_their_number() -> None:
    messages = drive(int, float, 2)
    with pytest.raises(
        CallError, match=r"^recording: message 5: x_m: a number expected, not '1'"
    ):
        fgtrack.replay([*messages, replace(EGO, x_m="1")], "open_space")
    with pytest.raises(
        CallError, match=r"^recording: message 5: a dict is not a message"
    ):
        fgtrack.replay([*messages, {"type": "ego"}], "open_space")  # type: ignore[list-item]


@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_an_estimator_takes_stamps_of_numpy_and_names_others(name: str) -> None:
    found = []
    for make in (int, np.uint64):
        one = estimator(
            name,
            CTRV(),
            Start(stamp_ns=make(NOW_NS), yaw_rad=0.0, speed_mps=np.float32(5.0)),
        )
        for k in range(1, 5):
            one.advance(make(NOW_NS + k * 50 * MS))
            one.update(
                Measurement.of(
                    make(NOW_NS + k * 50 * MS - 20 * MS),
                    x_m=np.float64(0.3 * k),
                    y_m=0,
                    std=0.3,
                )
            )
        found.append(
            (one.window_ns, one.state_at(make(NOW_NS + 300 * MS)).mean.tobytes())
        )
    assert found[0] == found[1]
    for wrong in (True, "5", 5.0, 2**63, None):
        with pytest.raises(
            CallError, match=r"^stamp_ns: must be an integer of at most 4e\+18, is "
        ):
            one.state_at(wrong)  # type: ignore[arg-type]
        with pytest.raises(
            CallError, match=r"^now_ns: must be an integer of at most 4e\+18, is "
        ):
            one.advance(wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [True, "5", 5.0, 2**63, None], ids=repr)
def test_a_measurement_and_a_start_name_a_wrong_stamp(wrong: Any) -> None:
    with pytest.raises(CallError, match=r"^measurement: stamp_ns: must be an integer"):
        Measurement.of(wrong, x_m=1.0, y_m=1.0, std=1.0)
    with pytest.raises(CallError, match=r"^measurement: stamp_ns: must be an integer"):
        Measurement(
            wrong, measurement_model(("x_m", "y_m"), CTRV()), np.zeros(2), np.eye(2)
        )
    with pytest.raises(CallError, match=r"^Start: stamp_ns: must be an integer"):
        Start(stamp_ns=wrong)
    with pytest.raises(CallError, match=r"^measurement of x_m: "):
        Measurement.of(0, x_m=True, y_m=1.0, std=1.0)


@pytest.mark.parametrize("wrong", [True, np.True_, 5.0, "5"], ids=repr)
def test_a_tick_at_what_is_no_time_is_refused(wrong: Any) -> None:
    tracker = Tracker("open_space")
    for ask in (tracker.tick, tracker.tracks_at):
        with pytest.raises(CallError, match="must be integer nanoseconds since 1970"):
            ask(wrong)


def test_the_names_of_unknown_sensors_do_not_grow_without_bound() -> None:
    tracker = Tracker("open_space")
    for k in range(10 * MOST_UNKNOWN):
        tracker.receive(replace(LIST, sensor=f"sensor_{k}"))
    report = tracker.tick(NOW_NS)
    assert len(report.updates) == 10 * MOST_UNKNOWN
    assert len(tracker.counts) == len(tracker.refused) == MOST_UNKNOWN + 1
    assert tracker.counts[OTHERS] == {"invalid": 9 * MOST_UNKNOWN}
    assert tracker.refused[f"sensor {OTHERS!r} has no model"] == 9 * MOST_UNKNOWN
