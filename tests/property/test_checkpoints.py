"""A checkpoint is all that changes in a tracker: whoever goes on from it gets the same ticks."""

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.traffic import Ticks, bits, gone_on, traffic

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.state import Stateful, copied, from_bytes, to_bytes
from fgtrack.core.types import DetectionList, TickReport
from fgtrack.estimation.registry import ESTIMATORS, list_estimators
from fgtrack.pipeline.live import Tracker

#: Settings under which other parts of the tracker have a state.
SETTINGS: dict[str, dict[str, object]] = {
    "counts": {},
    "existence": {"lifecycle": {"kind": "existence"}},
    "mahalanobis": {"association": {"kind": "mahalanobis"}},
    "existence and mahalanobis": {
        "lifecycle": {"kind": "existence", "weigh_births": True},
        "association": {"kind": "mahalanobis", "joint_from": 3},
    },
    "lists that wait": {"ego.wait_s": 0.1},
    "positions of the ego": {"ego.position_time_s": 5.0},
}


def tracker_of(estimator: str, settings: str = "counts") -> Tracker:
    return Tracker("smoother", estimator=estimator, set=SETTINGS[settings])


def largest_distance(ones: Sequence[TickReport], others: Sequence[TickReport]) -> float:
    """Largest difference of two runs with the same tracks, in standard deviations."""
    largest = 0.0
    for one, other in zip(ones, others, strict=True):
        assert [each.track_id for each in one.tracks] == [
            each.track_id for each in other.tracks
        ]
        assert [each.disposition for each in one.updates] == [
            each.disposition for each in other.updates
        ]
        for a, b in zip(one.tracks, other.tracks, strict=True):
            stds = np.sqrt(np.diag(a.state.covariance))
            off = np.abs(a.state.mean - b.state.mean) / np.where(stds > 0, stds, 1.0)
            largest = max(largest, float(off.max()))
    return largest


def random_split(name: str) -> tuple[Ticks, Ticks]:
    seed = sum(name.encode())
    first = int(np.random.default_rng(seed).integers(20, 35))
    ticks = traffic(seed, first + 9)
    return ticks[:first], ticks[first:]


FAST = [name for name in list_estimators() if not name.startswith("smoother-batch")]


@pytest.mark.parametrize("name", FAST)
def test_a_restored_tracker_goes_on_with_the_same_bits_as_often_as_wanted(
    name: str, tmp_path: Path
) -> None:
    before, after = random_split(name)
    tracker = tracker_of(name)
    gone_on(tracker, before)
    checkpoint = tracker.checkpoint()
    tracker.save(tmp_path / "tracker")
    expected = gone_on(tracker, after)
    assert sum(len(each.tracks) for each in expected) > 9
    tracker.restore(checkpoint)
    assert bits(gone_on(tracker, after)) == bits(expected)
    tracker.restore(checkpoint)  # as it was, though a tracker has gone on from it
    assert bits(gone_on(tracker, after[:4])) == bits(expected[:4])
    loaded = Tracker.load(tmp_path / "tracker")
    assert bits(gone_on(loaded, after)) == bits(expected)


@pytest.mark.slow
def test_the_window_of_the_batch_smoother_goes_on_from_its_estimates() -> None:
    before, _ = random_split("smoother-batch")
    tracker = tracker_of("smoother-batch")
    gone_on(tracker, before[:14])
    checkpoint = tracker.checkpoint()
    expected = gone_on(tracker, before[14:20])
    tracker.restore(checkpoint)
    again = gone_on(tracker, before[14:20])
    assert sum(len(each.tracks) for each in expected) > 6
    assert largest_distance(expected, again) < 1e-6


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("name", ["ekf-replay", "ekf-backward-forward"])
def test_every_part_of_a_tracker_is_in_its_checkpoint(
    name: str, settings: str, tmp_path: Path
) -> None:
    before, after = random_split(settings)
    tracker = tracker_of(name, settings)
    gone_on(tracker, before)
    tracker.save(tmp_path / "tracker")
    expected = bits(gone_on(tracker, after))
    assert bits(gone_on(Tracker.load(tmp_path / "tracker"), after)) == expected


def test_an_exception_after_a_checkpoint_changes_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before, after = random_split("exception")
    tracker = tracker_of("smoother-banded")
    gone_on(tracker, before)
    checkpoint = tracker.checkpoint()
    expected = bits(gone_on(tracker, after))
    tracker.restore(checkpoint)

    def broken(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tracker._tracker._update, "fuse", broken)
        with pytest.raises(KeyboardInterrupt):
            gone_on(tracker, after)
    tracker.restore(checkpoint)
    assert bits(gone_on(tracker, after)) == expected


@pytest.mark.parametrize("name", ["ekf-replay", "smoother-banded", "imm-replay"])
def test_a_tick_changes_nothing_that_is_not_in_the_state(name: str) -> None:
    before, after = random_split(name)
    tracker = tracker_of(name, "existence and mahalanobis")
    gone_on(tracker, before)
    fixed = dict(fixed_attributes(tracker._tracker))
    gone_on(tracker, after)
    changed = [
        key for key, value in fixed_attributes(tracker._tracker) if fixed[key] != value
    ]
    assert changed == []


#: Not in `STATE`: copied by methods of their own, views, and what belongs to one tick.
OWN = {
    "_estimators",
    "_bank",
    "_graphs",
    "_read",
    "_seen",
    "_parts",
    "_association",
    "_update",
    "_starts",
    "_publication",
    "delays",
    "arrays",
    "seen",
}


def fixed_attributes(tracker: Any) -> Iterator[tuple[tuple[str, str], bytes]]:
    """Yield the attributes of all stateful objects that no tick changes, as bytes."""
    parts = tracker._parts
    owners = [tracker, parts.bank._bank, parts.bank, parts.ego, parts.inbox]
    owners += [parts.lifecycle, parts.objects, parts.facing, parts.failures]
    owners += parts.watermarks.delays.values()
    for owner in owners:
        if owner is None:
            continue
        owners += [each for each in vars(owner).values() if isinstance(each, Stateful)]
        for name, value in vars(owner).items():
            if name in (*owner.STATE, *OWN) or isinstance(value, Stateful):
                continue
            if isinstance(value, np.ndarray) and value.base is not None:
                continue
            try:
                yield (f"{type(owner).__name__} {id(owner)}", name), pickle.dumps(value)
            except (pickle.PicklingError, AttributeError, TypeError):
                continue


SCRIPT = """
import pickle, sys
sys.path.insert(0, sys.argv[1])
from support.traffic import bits, gone_on
from fgtrack.pipeline.live import Tracker
ticks = pickle.load(open(sys.argv[3], "rb"))
pickle.dump(bits(gone_on(Tracker.load(sys.argv[2]), ticks)), open(sys.argv[4], "wb"))
"""


@pytest.mark.long
def test_a_saved_tracker_goes_on_in_another_process(tmp_path: Path) -> None:
    before, after = random_split("process")
    lists = [
        each
        for _, messages in before
        for each in messages
        if isinstance(each, DetectionList)
    ]
    before[-1][1].append(lists[-1])  # a copy is recognised there as well
    after[0][1].append(lists[-1])
    tracker = tracker_of("ekf-replay")
    gone_on(tracker, before)
    tracker.save(tmp_path / "tracker")
    (tmp_path / "ticks").write_bytes(pickle.dumps(after))
    files = [str(tmp_path / name) for name in ("tracker", "ticks", "bits")]
    subprocess.run(
        [sys.executable, "-c", SCRIPT, str(Path(__file__).parents[1]), *files],
        check=True,
        env={**os.environ, "PYTHONHASHSEED": "7"},
    )
    expected = bits(gone_on(tracker, after))
    assert "duplicate" in str(expected)
    assert pickle.loads(Path(files[2]).read_bytes()) == expected


def test_a_checkpoint_of_another_configuration_is_refused() -> None:
    checkpoint = tracker_of("ekf-replay").checkpoint()
    with pytest.raises(CallError, match="another configuration"):
        tracker_of("imm-replay").restore(checkpoint)


def test_a_plug_in_without_a_state_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = ESTIMATORS.load("drop")

    class Mine:
        def __init__(self, *args: Any, **options: Any) -> None:
            self.inner = made(*args, **options)

        window_ns = property(lambda self: self.inner.window_ns)

        def __getattr__(self, name: str) -> Any:
            return getattr(self.inner, name)

    before, _ = random_split("plug-in")
    tracker = tracker_of("drop")
    bank = tracker._tracker._parts.bank._bank
    monkeypatch.setattr(bank, "_start", lambda start: Mine(bank._motion, start, 1.0))
    gone_on(tracker, before)
    with pytest.raises(CallError, match="Mine has no checkpoint"):
        tracker.checkpoint()


@pytest.mark.parametrize("data", [b"", b"nothing", b"fgtrack tracker 2\n broken"])
def test_a_file_that_is_no_saved_tracker_is_refused(
    data: bytes, tmp_path: Path
) -> None:
    (tmp_path / "file").write_bytes(data)
    with pytest.raises(DataError, match=r"not a tracker|cannot be read"):
        Tracker.load(tmp_path / "file")
    with pytest.raises(CallError, match="cannot be read"):
        Tracker.load(tmp_path / "missing")


def test_a_file_runs_no_code() -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return os.system, ("true",)

    with pytest.raises(DataError, match=r"posix\.system, which is not a state"):
        from_bytes(pickle.dumps(Evil()))


def test_a_copy_shares_nothing_that_can_change() -> None:
    value = {"a": [np.zeros(2), (np.ones(1), {3})], "b": 1.5}
    copy = copied(value)
    value["a"][0][:] = 7.0  # type: ignore[index]
    value["a"][1][1].add(4)  # type: ignore[index]
    assert copy["a"][0].tolist() == [0.0, 0.0]  # type: ignore[index]
    assert copy["a"][1][1] == {3}  # type: ignore[index]
    assert str(from_bytes(to_bytes(copy))) == str(copy)
