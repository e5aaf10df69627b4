"""How well are twenty cars in two lanes that cross each other tracked, beside Stone Soup's JPDA?

    python experiments/association/crossings.py -o out/crossings

The scenario. Two lanes of ten cars, 8 m apart, 3.5 m between the lanes, change sides every 4 s while one lane overtakes
the other by 2 m/s; each car wavers by 2 m. A RADAR (1 m, 62 ms late in the mean) and a LiDAR (0.3 m, 151 ms) at 10 Hz
detect a car with probability 0.7; 30 % of the detections are clutter, uniform on the road. All trackers have the same
motion model (constant velocity, white-noise acceleration), noise, detection probability, clutter density, prior of the
velocity and gate. Stone Soup gets every list at its stamp, in order: nothing is late for it. Its settings were chosen
on other seeds, as was `association.joint_from`.
"""

import csv
import datetime
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack import (
    NS_PER_S,
    Config,
    Detection,
    DetectionList,
    FloatArray,
    Message,
    TruthState,
    nanoseconds,
)
from fgtrack.evaluation import Scenes, clear, gospa
from fgtrack.sim import LIDAR_DELAY, RADAR_DELAY, draw_delays

START_NS = 1_790_000_000 * NS_PER_S
CARS_PER_LANE, HEADWAY_M, LANE_M = 10, 8.0, 3.5
SPEEDS_MPS = 20.0, 22.0
CHANGE_S = 4.0
WAVER_M, WAVER_S = 2.0, (6.0, 10.0)
BESIDE_M = 6.0  # width of the road with clutter, to either side of its middle
PERIOD_S = 0.1
DETECTED, CLUTTER_SHARE = 0.7, 0.3
DENSITY_M2PS3 = 1.0
PRIOR_MPS = 30.0
SETTLED_S = 2.0  # not evaluated
CUT_OFF_M = 3.0
SENSORS = {"radar": (1.0, 0.05, RADAR_DELAY), "lidar": (0.3, 0.0, LIDAR_DELAY)}
"""Standard deviation of a position, time of the first scan, delay."""


class Scene:
    """The motion of the cars of one seed, and what the sensors detect."""

    def __init__(self, seed: int, duration_s: float) -> None:
        rng = np.random.default_rng(seed)
        lanes = np.repeat([0, 1], CARS_PER_LANE)
        self._first_m = np.tile(np.arange(CARS_PER_LANE) * HEADWAY_M, 2) + rng.uniform(
            -3.0, 3.0, len(lanes)
        )
        self._first_m[lanes == 1] -= 0.5 * duration_s * (SPEEDS_MPS[1] - SPEEDS_MPS[0])
        self._speed_mps, self._side = (
            np.array(SPEEDS_MPS)[lanes],
            np.where(lanes == 0, 1.0, -1.0),
        )
        self._waver_s, self._phase = (
            rng.uniform(*WAVER_S, len(lanes)),
            rng.uniform(0.0, math.tau, len(lanes)),
        )
        self.duration_s, self.lists = duration_s, list[DetectionList]()
        for name, (std_m, first_s, delay) in SENSORS.items():
            times_s = np.arange(first_s, duration_s, PERIOD_S)
            delays_s = draw_delays(delay, rng, times_s)
            for time_s, delay_s in zip(
                times_s.tolist(), delays_s.tolist(), strict=True
            ):
                stamp_ns = START_NS + nanoseconds(time_s)
                points = tuple(
                    Detection(x_m=x, y_m=y)
                    for x, y in self._seen_m(time_s, std_m, rng).tolist()
                )
                self.lists.append(
                    DetectionList(
                        name, stamp_ns, stamp_ns + nanoseconds(delay_s), points, "map"
                    )
                )

    def cars_m(self, time_s: float) -> FloatArray:
        """Return the true positions, shape (cars, 2)."""
        waver_m = WAVER_M * np.sin(math.tau * time_s / self._waver_s + self._phase)
        along_m = self._first_m + self._speed_mps * time_s + waver_m
        across_m = self._side * 0.5 * LANE_M * math.cos(math.pi * time_s / CHANGE_S)
        return np.stack([along_m, across_m], axis=-1)

    def area_m2(self, time_s: float) -> float:
        """Return the area of the road with clutter."""
        return float(np.ptp(self.cars_m(time_s)[:, 0]) + 20.0) * 2.0 * BESIDE_M

    def messages(self) -> Iterator[Message]:
        """Yield lists and truth in the order of their receipt."""
        truth = list[Message]()
        for k in range(round(self.duration_s / 0.05) + 1):
            stamp_ns = START_NS + nanoseconds(0.05 * k)
            for number, (x_m, y_m) in enumerate(self.cars_m(0.05 * k).tolist()):
                truth.append(TruthState(stamp_ns, stamp_ns, number, x_m, y_m))
        yield from sorted([*self.lists, *truth], key=lambda each: each.receipt_ns)

    def _seen_m(
        self, time_s: float, std_m: float, rng: np.random.Generator
    ) -> FloatArray:
        cars_m = self.cars_m(time_s)
        seen_m = (cars_m + std_m * rng.standard_normal(cars_m.shape))[
            rng.random(len(cars_m)) < DETECTED
        ]
        count = rng.poisson(
            len(cars_m) * DETECTED * CLUTTER_SHARE / (1.0 - CLUTTER_SHARE)
        )
        low_m, high_m = cars_m[:, 0].min() - 10.0, cars_m[:, 0].max() + 10.0
        clutter_m = rng.uniform([low_m, -BESIDE_M], [high_m, BESIDE_M], (count, 2))
        return np.asarray(rng.permutation(np.concatenate([seen_m, clutter_m])))


def clutter_per_m2(scene: Scene) -> float:
    """Return the mean density of clutter, which all trackers are given."""
    count = 2 * CARS_PER_LANE * DETECTED * CLUTTER_SHARE / (1.0 - CLUTTER_SHARE)
    return count / float(
        np.mean(
            [scene.area_m2(time_s) for time_s in np.arange(0.0, scene.duration_s, 1.0)]
        )
    )


class Scores(NamedTuple):
    """Scores of one run."""

    gospa_m: float
    localisation_m2: float
    missed_m2: float
    false_m2: float
    switches: int
    rows: int


def scores(ticks: Scenes) -> Scores:
    """Return the scores of the ticks after `SETTLED_S`."""
    squares_m2, counts = gospa(ticks, CUT_OFF_M), clear(ticks, CUT_OFF_M)
    parts = (
        float(squares_m2[name].mean())
        for name in ("localisation_m2", "missed_m2", "false_m2")
    )
    return Scores(
        float(np.sqrt(squares_m2["total_m2"]).mean()),
        *parts,
        int(counts["id_switches"]),
        len(ticks.track_ids),
    )


def configuration(scene: Scene, estimator: str, joint_from: int | None) -> Config:
    """Return the configuration of fgtrack."""
    sensor = {
        "detection_probability": DETECTED,
        "clutter_per_m2": clutter_per_m2(scene),
    }
    sensors = {
        name: {"std": {"x_m": std_m, "y_m": std_m}, **sensor}
        for name, (std_m, _, _) in SENSORS.items()
    }
    settings = {
        "estimator": estimator,
        "sensors": sensors,
        "clock.node_hz": 1.0 / PERIOD_S,
        "motion": {
            "kind": "cv",
            "std_per_s": {"velocity": 10.0 * math.sqrt(DENSITY_M2PS3)},
        },
        "birth": {
            "kind": "measured",
            "ego_speed_factor": 0.0,
            "speed_std_mps": PRIOR_MPS,
        },
        "association": {"kind": "mahalanobis", "joint_from": joint_from},
        "evaluation.gate_m": CUT_OFF_M,
    }
    return Config().replace(settings)


def by_fgtrack(scene: Scene, estimator: str, joint_from: int | None) -> Scenes:
    """Return the published tracks of fgtrack beside the truth."""
    run = fgtrack.replay(scene.messages(), configuration(scene, estimator, joint_from))
    tracks, rows = (
        run.tracks[run.tracks["status"] != "tentative"],
        dict[int, list[tuple[int, float, float]]](),
    )
    for now_ns, *row in zip(
        *(tracks[name] for name in ("now_ns", "track_id", "x_m", "y_m")), strict=True
    ):
        rows.setdefault(round((now_ns - START_NS) / NS_PER_S / PERIOD_S), []).append(
            tuple(row)
        )
    return beside_truth(
        scene, [(tick * PERIOD_S, rows.get(tick, [])) for tick in evaluated(scene)]
    )


def evaluated(scene: Scene) -> range:
    """Return the numbers of the evaluated ticks, `PERIOD_S` apart."""
    return range(round(SETTLED_S / PERIOD_S), round(scene.duration_s / PERIOD_S))


EPOCH = datetime.datetime(2020, 1, 1)


class Opponent(NamedTuple):
    """Settings of Stone Soup, chosen on other seeds than those of the table."""

    given: bool = False
    """True if it has a track of every car from the start, which never ends, and starts no others."""
    min_points: int = 6
    """Detections after which a track is published."""
    forget_s: float = 0.3
    """Time after which a track ends that was more probably missed than detected."""
    claim: float = 0.1
    """Detections that belong to a track with at least this probability start none."""


def by_stone_soup(scene: Scene, settings: Opponent) -> Scenes:
    """Return the tracks of Stone Soup beside the truth, all lists given in order and without delay."""
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.dataassociator.probability import JPDAwithEHM2
    from stonesoup.deleter.time import UpdateTimeDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import MultiMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import (
        CombinedLinearGaussianTransitionModel,
        ConstantVelocity,
    )
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection as Seen
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.types.update import GaussianStateUpdate
    from stonesoup.updater.kalman import KalmanUpdater

    class Near(PDAHypothesiser):
        """Hypotheses of the detections nearby alone: no other passes the gate."""

        def hypothesise(self, track, detections, timestamp, **kwargs):
            state = self.predictor.predict(track, timestamp=timestamp)
            reach_m = 4.0 * math.sqrt(
                max(state.covar[0, 0], state.covar[2, 2]) + SENSORS["radar"][0] ** 2
            )
            x_m, y_m = float(state.state_vector[0]), float(state.state_vector[2])
            near = [
                each
                for each in detections
                if math.hypot(each.xy_m[0] - x_m, each.xy_m[1] - y_m) < reach_m
            ]
            return super().hypothesise(track, near, timestamp, **kwargs)

    class Remembering(CombinedLinearGaussianTransitionModel):
        """The same matrices, computed once for each interval."""

        def matrix(self, **kwargs):
            return known(
                ("F", kwargs["time_interval"]),
                lambda: super(Remembering, self).matrix(**kwargs),
            )

        def covar(self, **kwargs):
            return known(
                ("Q", kwargs["time_interval"]),
                lambda: super(Remembering, self).covar(**kwargs),
            )

    matrices: dict[tuple[str, object], object] = {}

    def known(key, make):
        if key not in matrices:
            matrices[key] = make()
        return matrices[key]

    predictor, updater = (
        KalmanPredictor(Remembering([ConstantVelocity(DENSITY_M2PS3)] * 2)),
        KalmanUpdater(None),
    )
    models = {
        name: LinearGaussian(4, (0, 2), std_m**2 * np.eye(2))
        for name, (std_m, _, _) in SENSORS.items()
    }
    jpda = JPDAwithEHM2(
        Near(predictor, updater, clutter_per_m2(scene), DETECTED, 0.999)
    )
    initiator = MultiMeasurementInitiator(
        GaussianState([[0.0]] * 4, np.diag([0.0, PRIOR_MPS**2, 0.0, PRIOR_MPS**2])),
        UpdateTimeDeleter(datetime.timedelta(seconds=settings.forget_s)),
        GNNWith2DAssignment(
            DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=3.7)
        ),
        updater,
        min_points=settings.min_points,
    )
    tracks: list[Track] = []
    if settings.given:
        before_m, first_m = scene.cars_m(-0.01), scene.cars_m(0.0)
        for (x, y), (vx, vy) in zip(first_m, (first_m - before_m) / 0.01, strict=True):
            state = GaussianState(
                [[x], [vx], [y], [vy]], np.diag([0.1, 1.0, 0.1, 1.0]), timestamp=EPOCH
            )
            tracks.append(Track([state]))
    seen_at, ticks = dict[str, float](), []
    lists, position = sorted(scene.lists, key=lambda each: each.stamp_ns), 0
    numbers: dict[str, int] = {}
    for tick in evaluated(scene):
        now_s = tick * PERIOD_S
        while position < len(lists) and lists[
            position
        ].stamp_ns <= START_NS + nanoseconds(now_s):
            now, position = lists[position], position + 1
            time_s = (now.stamp_ns - START_NS) / NS_PER_S
            stamp, own = EPOCH + datetime.timedelta(seconds=time_s), models[now.sensor]
            seen, claimed = set(), set()
            for each in now.objects:
                seen.add(
                    Seen(
                        [[each.x_m], [each.y_m]], timestamp=stamp, measurement_model=own
                    )
                )
            for each in seen:
                each.xy_m = each.state_vector[:, 0].astype(float)
            hypotheses = jpda.associate(set(tracks), seen, stamp) if tracks else {}
            for track, several in hypotheses.items():
                weights = np.array([float(each.probability) for each in several])
                states = [
                    updater.update(each) if each else each.prediction
                    for each in several
                ]
                claimed |= {
                    each.measurement
                    for each, w in zip(several, weights, strict=True)
                    if each and w >= settings.claim
                }
                if weights[[bool(each) for each in several]].sum() >= 0.5:
                    seen_at[track.id] = time_s
                means = np.array(
                    [
                        np.asarray(state.state_vector, dtype=float)[:, 0]
                        for state in states
                    ]
                )
                P = np.einsum(
                    "i,ijk",
                    weights,
                    [np.asarray(state.covar, dtype=float) for state in states],
                )
                spread = means - weights @ means
                P += np.einsum("i,ij,ik", weights, spread, spread)
                track.append(
                    GaussianStateUpdate((weights @ means)[:, None], P, several, stamp)
                )
            if settings.given:
                continue
            kept: list[Track] = []
            for track in tracks:
                if time_s - seen_at[track.id] <= settings.forget_s:
                    kept.append(track)
            born = initiator.initiate(seen - claimed, stamp)
            seen_at |= {track.id: time_s for track in born}
            tracks = [
                *kept,
                *sorted(born, key=lambda track: float(track.state_vector[0])),
            ]
        rows = []
        for track in tracks:
            state = predictor.predict(
                track, timestamp=EPOCH + datetime.timedelta(seconds=now_s)
            )
            number = numbers.setdefault(track.id, len(numbers))
            rows.append(
                (number, float(state.state_vector[0]), float(state.state_vector[2]))
            )
        ticks.append((now_s, rows))
    return beside_truth(scene, ticks)


def beside_truth(
    scene: Scene, ticks: Sequence[tuple[float, Sequence[tuple[int, float, float]]]]
) -> Scenes:
    """Return `ticks`, times with id and position of each track, beside the truth."""
    gaps_m = []
    for now_s, rows in ticks:
        points_m = np.array([row[1:] for row in rows]).reshape(-1, 2)
        gaps_m.append(np.linalg.norm(points_m[:, None] - scene.cars_m(now_s), axis=-1))
    present = np.ones((len(ticks), 2 * CARS_PER_LANE), dtype=bool)
    index = np.repeat(np.arange(len(ticks)), [len(rows) for _, rows in ticks])
    ids = np.array([row[0] for _, rows in ticks for row in rows], dtype=np.int64)
    return Scenes.of(index, ids, np.concatenate(gaps_m), present, present)


TRACKERS = (
    "ekf-replay,ekf-replay joint,smoother-banded,smoother-banded joint,stone soup"
)
JOINT_FROM = 8


def by_name(name: str, seed: int, duration_s: float) -> Scores:
    """Return the scores of a tracker: an estimator, perhaps `joint`, or Stone Soup with or without given tracks."""
    scene = Scene(seed, duration_s)
    if name.startswith("stone soup"):
        return scores(by_stone_soup(scene, Opponent(given=name.endswith("given"))))
    estimator, _, joint = name.partition(" ")
    return scores(by_fgtrack(scene, estimator, JOINT_FROM if joint else None))


def main(
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for the table.")
    ] = Path("out/crossings"),
    runs: Annotated[int, typer.Option(help="Seeds.")] = 10,
    duration_s: Annotated[float, typer.Option(help="Of each run, above 2 s.")] = 12.0,
    trackers: Annotated[
        str, typer.Option(help=f"Some of {TRACKERS},stone soup given.")
    ] = TRACKERS,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 2,
) -> None:
    """Track every scene by every tracker, write crossings.csv and print means with their standard errors."""
    names, seeds = trackers.split(","), range(1, runs + 1)
    cases = [(name, seed) for seed in seeds for name in names]
    results = Parallel(jobs)(
        delayed(by_name)(name, seed, duration_s) for name, seed in cases
    )
    out.mkdir(parents=True, exist_ok=True)
    with (out / "crossings.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("tracker", "seed", *Scores._fields))
        writer.writerows(
            (*case, *row) for case, row in zip(cases, results, strict=True)
        )
    table = np.array(results).reshape(runs, len(names), -1)
    print("tracker:", ", ".join(Scores._fields), "(mean and standard error)")
    for k, name in enumerate(names):
        errors = table[:, k].std(axis=0, ddof=min(1, runs - 1)) / math.sqrt(runs)
        print(
            name,
            *(
                f"{mean:.2f}+-{error:.2f}"
                for mean, error in zip(table[:, k].mean(axis=0), errors, strict=True)
            ),
        )


if __name__ == "__main__":
    typer.run(main)
