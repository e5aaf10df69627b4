"""Ideas of other trackers, each as an option: what does it gain, beside the same tracker without it?

    python experiments/rivals/rivals.py -o out/rivals --kitti KITTI --jobs 2

Every contestant sees the same recordings with the same start, noise, robustness and association, and is compared with
the one before the slash in its name, or with `EKF`, seed by seed or sequence by sequence.
"""

import csv
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple

import joblib
import numpy as np
import typer

import fgtrack
from fgtrack import Detection, DetectionList, Message, read_scenario
from fgtrack.evaluation import EvaluatedRun, average, paired

Settings = Mapping[str, Any]  # Any: values of a configuration

EKF, SMOOTHER, IMM = "ekf-replay", "smoother-banded", "imm-replay"
"""The banded smoother gives what `smoother` gives, faster."""

CTRA = {"motion.kind": "ctra", "motion.std_per_s.accel": 3.0}
#: What the tables do not need.
QUIET = {"smoother.lagged_s": [], "smoother.final": False, "ego.uncertainty": "none"}
#: Without errors that are correlated in time, of which the IMM knows nothing.
WHITE = {"sensors.pointrcnn_car.correlation": None, "sensors.rrc_car.correlation": None}


def curvature(std_radpm: float) -> dict[str, float]:
    """The curvature of the map's line at the detections of both sensors."""
    return {
        f"sensors.{name}.curvature_from_map_std_radpm": std_radpm
        for name in ("lidar_cluster", "radar")
    }


class Contestant(NamedTuple):
    """A tracker with an option."""

    estimator: str
    settings: Settings = MappingProxyType({})
    against: str = "EKF"


MODELS = {
    "EKF": Contestant(EKF),
    "EKF, CTRA": Contestant(EKF, CTRA),
    "IMM of CTRV and CTRA": Contestant(IMM),
    "smoother": Contestant(SMOOTHER),
    "smoother, CTRA": Contestant(SMOOTHER, CTRA, "smoother"),
}
CURVED = {
    "EKF, curvature 0.001": Contestant(EKF, curvature(1e-3)),
    "EKF, curvature 0.003": Contestant(EKF, curvature(3e-3)),
    "smoother, curvature 0.001": Contestant(SMOOTHER, curvature(1e-3), "smoother"),
}
#: The filters alone, where a smoother says the same of the present.
FILTERS = {
    name: one for name, one in {**MODELS, **CURVED}.items() if one.estimator != SMOOTHER
}
FILTERS_CURVED = {
    name: one for name, one in FILTERS.items() if name == "EKF" or "curvature" in name
}
DOPPLER = {"range_m": 0.8, "bearing_rad": 0.01, "range_rate_mps": 0.2}
SPREADING = {"range_m": 0.3, "bearing_rad": 0.01}
SPREAD_ON_AVERAGE = {"x_m": 0.3, "y_m": 0.35}
"""A bearing error of 0.01 rad at the distances of the default scenario."""


@dataclass(frozen=True)
class Scene:
    """Recordings, and who takes part."""

    scenario: str
    config: str
    contestants: Mapping[str, Contestant]
    sensors: Mapping[str, Mapping[str, Any]] | None = None
    """What is changed of the scenario's sensors, by name."""
    settings: Settings | None = None
    straightened: float = 0.0
    """Share by which the tracker's map says too little of the curvature."""


SCENES: Mapping[str, Scene] = {
    "default": Scene("default", "smoother", FILTERS),
    "default, fitted noise": Scene("default", "tuned", {**MODELS, **CURVED}),
    "default, Doppler RADAR": Scene(
        "default",
        "tuned",
        {"EKF": MODELS["EKF"], "smoother": MODELS["smoother"], **CURVED},
        {"radar": {"std": DOPPLER}},
        {"sensors.radar.std": DOPPLER, "sensors.radar.mount": {"x_m": 3.0}},
    ),
    "race": Scene("race", "tuned", FILTERS),
    "default, curvature 20 % too small": Scene(
        "default", "tuned", FILTERS_CURVED, straightened=0.2
    ),
    "default, LiDAR worse with distance": Scene(
        "default",
        "tuned",
        {
            "EKF": Contestant(EKF, {"sensors.lidar_cluster.std": SPREAD_ON_AVERAGE}),
            "EKF, growth": Contestant(
                EKF, {"sensors.lidar_cluster.std_growth": {"y_m": 0.01}}
            ),
            "smoother": Contestant(
                SMOOTHER, {"sensors.lidar_cluster.std": SPREAD_ON_AVERAGE}
            ),
            "smoother, growth": Contestant(
                SMOOTHER,
                {"sensors.lidar_cluster.std_growth": {"y_m": 0.01}},
                "smoother",
            ),
        },
        {"lidar_cluster": {"std": SPREADING}},
        {"sensors.lidar_cluster.std": {"x_m": 0.3, "y_m": 0.03}},
    ),
}
#: On real cars; there is no map.
GROWTH = {"sensors.pointrcnn_car.std": {"x_m": 0.15, "y_m": 0.08, "yaw_rad": 0.06}}
GROWTH |= {"sensors.pointrcnn_car.std_growth": {"x_m": 0.007, "y_m": 0.003}}
KITTI = {
    **MODELS,
    "EKF, growth": Contestant(EKF, GROWTH),
    "smoother, growth": Contestant(SMOOTHER, GROWTH, "smoother"),
}
SEQUENCES = ("0004", "0006", "0008", "0010", "0018")


@dataclass(frozen=True)
class Result:
    """One run."""

    scene: str
    contestant: str
    recording: str
    position_m: float
    """RMSE, as the next two."""
    yaw_deg: float
    speed_mps: float
    nees: float
    """Mean of the position's, 2 if consistent."""
    arc_1s_m: float
    """Mean error of what the state predicts, one second ahead."""
    mota: float


def in_points(messages: Iterable[Message], sensor: str) -> Iterable[Message]:
    """Ranges and bearings of `sensor` as points of its own frame, as a list of objects has them."""
    for message in messages:
        if isinstance(message, DetectionList) and message.sensor == sensor:
            objects = []
            for one in message.objects:
                assert one.range_m is not None
                assert one.bearing_rad is not None
                x_m, y_m = (
                    one.range_m * np.cos(one.bearing_rad),
                    one.range_m * np.sin(one.bearing_rad),
                )
                objects.append(Detection(x_m=float(x_m), y_m=float(y_m)))
            message = replace(message, objects=objects)
        yield message


def straightened(share: float, folder: Path) -> str:
    """The built-in track, as a map that says too little of the curvature, or by its name."""
    if not share:
        return "oval"
    table = np.loadtxt("configs/maps/oval_track.csv", delimiter=";")
    table[:, -2] *= 1.0 - share
    np.savetxt(folder / "map.csv", table, delimiter=";")
    return str(folder / "map.csv")


def judged(scene: str, contestant: str, recording: str, run: fgtrack.Run) -> Result:
    """The numbers of a run."""
    one = EvaluatedRun(contestant, run)
    found = one.metrics
    assert found.truth is not None
    errors = found.truth.overall.errors
    return Result(
        scene,
        contestant,
        recording,
        errors["position_m"].rmse,
        float(np.rad2deg(errors["yaw_rad"].rmse)),
        errors["speed_mps"].rmse,
        found.consistency.position_nees.mean,
        found.predictions["arc"]["1s"].final_m.mean,
        100.0 * found.multi_object.clear["mota"] if found.multi_object else np.nan,
    )


def simulated(
    name: str, contestant: str, seed: int, duration_s: float | None
) -> Result:
    """One seed of a scene."""
    scene = SCENES[name]
    scenario = read_scenario(scene.scenario, duration_s=duration_s)
    changes = scene.sensors or {}
    sensors = tuple(
        replace(one, **changes.get(one.name, {})) for one in scenario.sensors
    )
    messages: Iterable[Message] = fgtrack.simulate(
        replace(scenario, sensors=sensors), seed=seed
    )
    if "range_m" in changes.get("lidar_cluster", {}).get("std", {}):
        messages = in_points(messages, "lidar_cluster")
    one = scene.contestants[contestant]
    settings = {
        **QUIET,
        "evaluation.multi_object": False,
        **(scene.settings or {}),
        **one.settings,
    }
    with tempfile.TemporaryDirectory() as folder:
        track = straightened(scene.straightened, Path(folder))
        run = fgtrack.replay(
            messages,
            scene.config,
            map=track,
            pit_map="oval",
            estimator=one.estimator,
            set=settings,
        )
        return judged(name, contestant, str(seed), run)


def recorded(kitti: Path, contestant: str, sequence: str) -> Result:
    """One sequence of KITTI."""
    one = KITTI[contestant]
    settings = {**QUIET, **WHITE, **one.settings}
    run = fgtrack.replay(
        kitti / "oxts" / f"{sequence}.txt",
        "kitti",
        estimator=one.estimator,
        set=settings,
    )
    return judged("KITTI", contestant, sequence, run)


def table(results: Sequence[Result], scene: str) -> str:
    """A row for each contestant: means with their intervals, and paired differences of the position and prediction."""
    contestants = KITTI if scene == "KITTI" else SCENES[scene].contestants
    header = [
        "contestant",
        "position RMSE [m]",
        "less that of",
        "yaw [deg]",
        "speed [m/s]",
        "NEES (2)",
    ]
    header += ["1 s ahead, on the arc [m]", "difference [m]"] + (
        ["MOTA [%]"] if scene == "KITTI" else []
    )
    lines = [header, ["---"] * len(header)]

    def of(name: str, field: str) -> list[float]:
        return [
            getattr(one, field)
            for one in results
            if (one.scene, one.contestant) == (scene, name)
        ]

    for name, one in contestants.items():
        itself = name == one.against
        line = [name, f"{average(of(name, 'position_m')):.3f}"]
        line.append(
            ""
            if itself
            else f"{one.against}: {paired(of(name, 'position_m'), of(one.against, 'position_m')):+.3f}"
        )
        line += [
            f"{average(of(name, field)).mean:.2f}"
            for field in ("yaw_deg", "speed_mps", "nees")
        ]
        line.append(f"{average(of(name, 'arc_1s_m')):.2f}")
        line.append(
            ""
            if itself
            else f"{paired(of(name, 'arc_1s_m'), of(one.against, 'arc_1s_m')):+.2f}"
        )
        if scene == "KITTI":
            line.append(f"{average(of(name, 'mota')).mean:.1f}")
        lines.append(line)
    return (
        f"{scene}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"
    )


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder of the tables.")] = Path(
        "out/rivals"
    ),
    scenes: Annotated[
        str, typer.Option(help="Simulated scenes, separated by semicolons.")
    ] = ";".join(SCENES),
    kitti: Annotated[
        Path | None, typer.Option(help="Folder of the KITTI tracking data set.")
    ] = None,
    sequences: Annotated[str, typer.Option(help="Sequences of KITTI.")] = ",".join(
        SEQUENCES
    ),
    seeds: Annotated[int, typer.Option(help="Seeds 1 to this.")] = 10,
    duration_s: Annotated[
        float | None, typer.Option(help="Length, in place of the scenario's.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Write runs.csv and tables.md."""
    out.mkdir(parents=True, exist_ok=True)
    names = [name for name in scenes.split(";") if name]
    tasks = [
        joblib.delayed(simulated)(scene, name, seed, duration_s)
        for scene in names
        for name in SCENES[scene].contestants
        for seed in range(1, seeds + 1)
    ]
    if kitti is not None:
        tasks += [
            joblib.delayed(recorded)(kitti, name, each)
            for name in KITTI
            for each in sequences.split(",")
        ]
        names.append("KITTI")
    results = joblib.Parallel(n_jobs=jobs)(tasks)
    with (out / "runs.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([each.name for each in fields(Result)])
        writer.writerows(astuple(one) for one in results)
    text = "\n".join(table(results, scene) for scene in names)
    (out / "tables.md").write_text(text)
    print(text)


if __name__ == "__main__":
    typer.run(main)
