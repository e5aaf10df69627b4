"""Whatever an estimator or a motion model does, what is published is sound, the run goes on, and says what failed."""

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from fgtrack.config.reading import read_config
from fgtrack.config.settings import Config
from fgtrack.core.types import (
    Detection,
    DetectionList,
    EgoState,
    FloatArray,
    TrackState,
)
from fgtrack.estimation.base import Measurement, Start, UpdateResult, UpdateStatus
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.filters.initiation import DEFAULT
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.evaluation.diagnostics import diagnostics
from fgtrack.evaluation.tables.compare import compare
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.pipeline.replay import replay
from fgtrack.runs import Columns, Run, load_run

MS = 1_000_000
NOW_NS = 1_600_000_000_000_000_000
SETTINGS = ["merge.distance_m=3.0", "clock.node_hz=50.0", "smoother.lagged_s=[0.2]"]
LISTS = 60
NEAR_M, FAR_M, BETWEEN_M = 30.0, 60.0, 45.0
BUILT_IN = (
    "ekf-replay",
    "ekf-backward-forward",
    "smoother",
    "smoother-batch",
    "smoother-banded",
)


def messages() -> Iterator[EgoState | DetectionList]:
    """Two cars that stand still, seen every 50 ms from a standing ego; every fifth list is late."""
    for k in range(LISTS):
        at_ns = NOW_NS + 50 * MS * k
        yield EgoState(at_ns, at_ns + 5 * MS, 0.0, 0.0, 0.0, 0.0)
        stamp_ns = at_ns - 70 * MS * (k % 5 == 4)
        objects = [Detection(x_m=x_m, y_m=1.0) for x_m in (NEAR_M, FAR_M)]
        yield DetectionList("lidar_cluster", stamp_ns, at_ns + 40 * MS, objects)


class Sabotaged(ReplayEkf):
    """Of the far car it does something wrong after ten updates."""

    wrong: ClassVar[str] = ""
    healthy: ClassVar[int] = 10

    def __init__(
        self, motion: MotionModel, start: Start, lag_s: float, initiation: str = DEFAULT
    ) -> None:
        super().__init__(motion, start, lag_s, initiation)
        self._far = start.position_m[0] > BETWEEN_M
        self._updates = 0
        if self._is("start raises") and self._far:
            raise MemoryError("no room")

    def _is(self, what: str) -> bool:
        return (
            self.wrong == what
            and self._far
            and self._updates >= self.healthy * (what != "start raises")
        )

    @property
    def window_ns(self) -> tuple[int, int]:
        if self._is("window raises"):
            raise OverflowError("no window")
        return super().window_ns

    def advance(self, now_ns: int) -> None:
        if self._is("advance raises"):
            raise RuntimeError("no time")
        super().advance(now_ns)

    def update(self, measurement: Measurement) -> UpdateResult:
        self._updates += 1
        if self._is("update raises"):
            raise np.linalg.LinAlgError("singular")
        if self._is("update gives nothing"):
            return None  # type: ignore[return-value]
        if self._is("update fails"):
            return UpdateResult(UpdateStatus.FAILED)
        return super().update(measurement)

    def state_at(self, stamp_ns: int) -> TrackState:
        state = super().state_at(stamp_ns)
        if self._is("state raises"):
            raise ZeroDivisionError("no state")
        mean, covariance = STATES.get(self.wrong, lambda x, P: (x, P))(
            state.mean.copy(), state.covariance.copy()
        )
        return TrackState(stamp_ns, mean, covariance) if self._is(self.wrong) else state


def _put(values: FloatArray, place: Any, value: float) -> FloatArray:
    values[place] = value
    return values


States = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
STATES: dict[str, States] = {
    "mean is not a number": lambda x, P: (_put(x, 1, np.nan), P),
    "covariance is not a number": lambda x, P: (x, P * np.nan),
    "covariance is indefinite": lambda x, P: (
        x,
        _put(_put(P, (0, 1), 9.0), (1, 0), 9.0),
    ),
    "variance is negative": lambda x, P: (x, _put(P, (4, 4), -1.0)),
    "position is huge": lambda x, P: (_put(x, 0, 1e300), P),
    "state is short": lambda x, P: (x[:4], P[:4, :4]),
}
#: What each sabotage of the far car's estimator is counted as.
KINDS = {
    **dict.fromkeys(
        ["mean is not a number", "covariance is not a number", "position is huge"],
        Failure.NOT_FINITE,
    ),
    **dict.fromkeys(
        ["covariance is indefinite", "variance is negative"], Failure.NOT_DEFINITE
    ),
    **dict.fromkeys(
        ["state is short", "state raises", "window raises"], Failure.ESTIMATOR_RAISED
    ),
    **dict.fromkeys(
        ["advance raises", "update raises", "update gives nothing", "update fails"],
        Failure.UPDATE_FAILED,
    ),
    "start raises": Failure.BIRTH_FAILED,
}


@pytest.fixture
def sabotaged(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Config]:
    """The configuration of a plug-in estimator that does something wrong."""

    def configuration(wrong: str) -> Config:
        monkeypatch.setattr(Sabotaged, "wrong", wrong)
        entry = SimpleNamespace(
            dist=None, load=lambda: Sabotaged, group="fgtrack.estimators"
        )
        monkeypatch.setitem(ESTIMATORS._entries, "sabotaged", entry)
        return read_config("smoother", SETTINGS, estimator="sabotaged")

    return configuration


def run_of(config: Config, folder: Path) -> Run:
    """The run of these messages, which is complete."""
    [meta] = replay(messages, config, {config.estimator: folder / "run"})
    assert meta["broken_off"] is None
    return load_run(folder / "run")


def covariances(table: Columns) -> FloatArray:
    """Shape (rows, 5, 5)."""
    names = [name for name in table if name.startswith("p_") and "accel" not in name]
    P = np.zeros((table.num_rows, 5, 5))
    for name, (row, column) in zip(
        names, zip(*np.triu_indices(5), strict=True), strict=True
    ):
        P[:, row, column] = P[:, column, row] = table[name]
    return P


def check_published(run: Run) -> None:
    """Every state is finite, within bounds, and has a positive definite covariance; every detection has one outcome."""
    for table in (run.tables["tracks"], run.tables["smoothed"], run.tables["lagged"]):
        for name in ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps"):
            assert (np.abs(table[name]) < 1e5).all(), name
        np.linalg.cholesky(covariances(table))
    assert (
        run.tables["updates"].num_rows == run.meta["detections_received"] == 2 * LISTS
    )
    assert sum(run.meta["counts"]["lidar_cluster"].values()) == 2 * LISTS


def check_told(run: Run) -> Counter[str]:
    """What failed is counted in meta.json, and said by `diagnostics` and `compare`."""
    failed = Counter(
        {kind: count for kind, count in run.meta["failures"].items() if count}
    )
    assert list(run.meta["failures"]) == [kind.value for kind in Failure]
    [line] = [str(one) for one in diagnostics(run) if one.about == "estimator"]
    tables = compare({"run": run}).to_dict()
    for kind, count in failed.items():
        assert f"{count} {kind}" in line or kind == Failure.STEP_DAMPED
        assert tables["runs"]["run"]["failures"][kind] == count
    ended = run.meta["ended_by_failure"]
    assert len(ended) == min(failed[Failure.TRACK_ENDED], 100)
    for one in ended:
        mine = run.tables["tracks"]["track_id"] == one["track_id"]
        assert (run.tables["tracks"]["now_ns"][mine] <= one["now_ns"]).all()
    return failed


@pytest.mark.parametrize("wrong", KINDS)
def test_what_a_plug_in_estimator_does_wrong_is_not_published_and_counted(
    sabotaged: Callable[[str], Config], tmp_path: Path, wrong: str
) -> None:
    run = run_of(sabotaged(wrong), tmp_path)
    check_published(run)
    assert check_told(run)[KINDS[wrong]] > 0
    near = np.abs(run.tables["tracks"]["x_m"] - NEAR_M) < 3.0
    assert (
        run.tables["tracks"]["now_ns"][near][-1] == run.tables["timing"]["now_ns"][-1]
    )
    assert len(np.unique(run.tables["tracks"]["track_id"][near])) <= 4, (
        "the other car is hardly disturbed"
    )


def test_a_healthy_estimator_fails_nowhere(
    sabotaged: Callable[[str], Config], tmp_path: Path
) -> None:
    run = run_of(sabotaged("nothing"), tmp_path)
    assert set(run.meta["failures"].values()) == {0}
    assert run.meta["ended_by_failure"] == []
    assert not [one for one in diagnostics(run) if one.about == "estimator"]


class Rotten(CTRV):
    """Beyond 45 m something is wrong, from some time on."""

    wrong: ClassVar[str] = ""
    asked: ClassVar[int] = 0

    def _spoilt(
        self,
        what: str,
        x: FloatArray,
        dt_s: float | FloatArray,
        values: FloatArray,
        bad: float,
    ) -> FloatArray:
        if self.wrong != what:
            return values
        values = np.array(values, dtype=np.float64)
        type(self).asked += 1
        far = np.broadcast_to(
            np.asarray(x)[..., 0] > BETWEEN_M,
            np.broadcast_shapes(np.shape(x)[:-1], np.shape(dt_s)),
        )
        values[far] *= bad if self.asked > 100 else 1.0
        return values

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        moved = super().predict(x, dt_s)
        if self.wrong == "raises":
            type(self).asked += 1
            if self.asked > 100 and (np.asarray(x)[..., 0] > BETWEEN_M).any():
                raise ValueError("no way")
        return self._spoilt("steps to nowhere", x, dt_s, moved, np.nan)

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        return self._spoilt(
            "has no Jacobian", x, dt_s, super().jacobian(x, dt_s), np.nan
        )

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        Q = super().process_noise(x, dt_s)
        return self._spoilt("has negative noise", x, dt_s, Q, -1e3)

    def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Any:
        return MotionModel.transition(self, x, dt_s)


ROTTEN = ("raises", "steps to nowhere", "has no Jacobian", "has negative noise")


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("estimator", "wrong"), list(zip(cycle(BUILT_IN), ROTTEN * 2, strict=False))
)
def test_what_a_motion_model_does_wrong_is_not_published_and_counted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, estimator: str, wrong: str
) -> None:
    monkeypatch.setattr(Rotten, "wrong", wrong)
    monkeypatch.setattr(Rotten, "asked", 0)
    monkeypatch.setattr(Config, "motion_model", lambda self: Rotten())
    run = run_of(read_config("smoother", SETTINGS, estimator=estimator), tmp_path)
    check_published(run)
    check_told(run)
