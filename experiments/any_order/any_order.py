"""What does it gain to take decisions back: in the present, some time ago, and in the final tracks?

    python experiments/any_order/any_order.py -o out/any_order --seeds 10 --jobs 2 \
        --oos-mtt OOS_MTT --kitti KITTI --autoferry AUTOFERRY --airport LEBL

Twelve cars in clutter are seen by a LiDAR and a RADAR. The lists arrive in order, or with delays. The four
folders are those of the recordings (docs/recordings.md); a scene without its folder is left out.
`outputs.csv` has the scores of each output, `runs.csv` the shares of states that are as in order.
"""

import csv
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import dense_scene
import numpy as np
import typer
from joblib import Parallel, delayed
from outputs import final_states, outputs, scores, share

import fgtrack
from fgtrack import Config, DetectionList, Message, TruthState, open_input
from fgtrack.evaluation import evaluation_settings, revision_metrics
from fgtrack.sim import ConstantDelay, SensorDelays, redelay

IN_ORDER = "in order"
ONCE, REVISED, ONE, WAITING = (
    "decided once",
    "revised",
    "revised, one hypothesis",
    "reorder-buffer",
)
METHODS: Mapping[str, Mapping[str, object]] = {
    ONCE: {"association": {"kind": "mahalanobis"}},
    REVISED: {"association": {"kind": "hypotheses"}},
    ONE: {"association": {"kind": "hypotheses", "most": 1}},
    WAITING: {"association": {"kind": "mahalanobis"}, "estimator": "reorder-buffer"},
}
"""Settings of each method."""
DENSE_DELAYS_S: Mapping[str, Mapping[str, float]] = {
    IN_ORDER: {"lidar": 0.0, "radar": 0.0},
    "of the paper": {"lidar": 0.151, "radar": 0.062},
    "LiDAR 0.5 s": {"lidar": 0.5, "radar": 0.062},
    "LiDAR 1 s": {"lidar": 1.0, "radar": 0.062},
}
"""Delays of the sensors in the dense scene, by label."""
KITTI_DELAY_S, AUTOFERRY_DELAY_S, AIRPORT_DELAY_S = 0.3, 1.0, 2.0
AIRPORT_S = 120.0
STATIONS = {
    7: {"latitude_deg": 41.29561833, "longitude_deg": 2.095114167},
    107: {"latitude_deg": 41.29706278, "longitude_deg": 2.07844722},
}


class Scene(NamedTuple):
    """A stream in one arrangement of delays, and the tracker of its recording."""

    name: str
    part: str
    """Seed or recording."""
    delays: str
    messages: Sequence[Message]
    config: Config


class OutputRow(NamedTuple):
    """Scores of one output of one run: a row of `outputs.csv`."""

    scene: str
    part: str
    delays: str
    method: str
    output: str
    mota: float
    switches: int
    rmse_m: float
    t_gospa_m: float


class RunRow(NamedTuple):
    """Agreement of one run with the run in order, and what it has taken back: a row of `runs.csv`."""

    scene: str
    part: str
    delays: str
    method: str
    as_in_order: float
    """Share of all final states in order that the run has too, confirmed or not; NaN for a filter."""
    confirmed_as_in_order: float
    """Share of the final states of confirmed tracks."""
    revised_share: float
    """Share of the detections whose track was changed."""
    moved_share: float
    """Share of the published states that moved outside of their 95 % ellipse."""
    withdrawn_share: float
    """Share of the published states that were withdrawn."""


Rows = tuple[list[OutputRow], list[RunRow]]


def dense_scenes(seed: int) -> Iterator[Scene]:
    """Yield the dense scene in each arrangement of delays, in order first."""
    config = dense_scene.configuration()
    for delays, delays_s in DENSE_DELAYS_S.items():
        own = dense_scene.messages(seed, delays_s)
        yield Scene("dense", str(seed), delays, own, config)


def recorded_scenes(
    name: str, source: Path, config: Config, sensor: str, delay_s: float
) -> Iterator[Scene]:
    """Yield a recording with the lists of one sensor at their stamps, and late."""
    every = list(open_input(source, config.input).messages())
    for own_s in (0.0, delay_s):
        delays = {sensor: SensorDelays(ConstantDelay(own_s))}
        messages = list(redelay(every, delays, np.random.default_rng(0))[0])
        label = f"{sensor} {own_s:g} s" if own_s else IN_ORDER
        yield Scene(name, source.stem, label, messages, config)


def lagged(config: Config) -> Config:
    """Return `config` with the estimator and the lags of this experiment. Decisions are as old as the window."""
    smoother = replace(config.smoother, lagged_s=dense_scene.LAGS_S, ring_s=0.0)
    return replace(config, estimator="smoother-banded", smoother=smoother)


def airport_scenes(folder: Path) -> Iterator[Scene]:
    """Yield the first two minutes of an airport, with the RADAR at its stamps, and late. It has no truth."""
    config = lagged(
        Config.from_yaml("airport").replace({"input.asterix.stations": STATIONS})
    )
    for each in recorded_scenes("airport", folder, config, "smr", AIRPORT_DELAY_S):
        last_ns = min(one.stamp_ns for one in each.messages) + round(AIRPORT_S * 1e9)
        kept = [one for one in each.messages if one.stamp_ns < last_ns]
        yield each._replace(messages=kept)


def benchmark_scenes(path: Path) -> Iterator[Scene]:
    """Yield a scene of the benchmark in order, and with its late scans."""
    sys.path.append(str(Path(__file__).parents[1] / "oos_mtt"))
    from oos_mtt import configuration
    from scenes import nanoseconds, read_scene

    scene = read_scene(path)
    config = configuration("smoother-banded").replace(
        {"evaluation.gate_m": 10.0, "smoother.ring_s": 0.0}
    )
    truth = [
        TruthState(
            nanoseconds(scene.times_s[index]),
            nanoseconds(scene.times_s[index]),
            number,
            *map(float, point_m),
        )
        for number, trajectory in enumerate(scene.truth)
        for index, point_m in trajectory.items()
    ]
    for label, own in ((IN_ORDER, scene.in_order()), ("late scans", scene)):
        lists: list[Message] = [*own.messages(), *truth]
        lists.sort(key=lambda each: each.receipt_ns)
        name = path.name.partition(".")[0]
        yield Scene("oos_mtt", name, label, lists, config)


def settings(scene: Scene, method: str) -> Config:
    """Return the tracker of a method: the decisions of the recording's configuration, if it has them."""
    own = dict(METHODS[method])
    association = scene.config.association
    if dict(own["association"]) == {"kind": association.kind}:  # type: ignore[call-overload]
        del own["association"]
    config = scene.config
    if method == WAITING:
        longest_s = max(
            (each.receipt_ns - each.stamp_ns) / fgtrack.NS_PER_S
            for each in scene.messages
            if isinstance(each, DetectionList)
        )
        own["options"] = {WAITING: {"hold_s": max(longest_s, 0.01)}}
    return config.replace(own)


def judged(arrangements: Sequence[Scene], method: str) -> Rows:
    """Return the rows of one method on one scene in each arrangement, in order first."""
    expected: list[Mapping[int, np.ndarray]] = []
    of_outputs: list[OutputRow] = []
    of_runs: list[RunRow] = []
    for scene in arrangements:
        run = fgtrack.replay(scene.messages, settings(scene, method))
        head = scene.name, scene.part, scene.delays, method
        for name, output in outputs(run):
            of_outputs.append(OutputRow(*head, name, *scores(output)))
        states = [final_states(run), final_states(run, confirmed_only=True)]
        expected = expected or states
        of = revision_metrics(run, evaluation_settings(run))
        published = int((run.tables["tracks"]["status"] != "tentative").sum())
        shares = [share(*each) for each in zip(expected, states, strict=True)]
        withdrawn = of.withdrawn_states / max(published, 1)
        of_runs.append(
            RunRow(*head, *shares, of.revised_share, of.moved_share, withdrawn)
        )
    return of_outputs, of_runs


def interval(values: Sequence[float]) -> str:
    """Return the mean, with half of its 95 % interval (t) if there are several values."""
    from scipy.stats import t

    known = np.array([each for each in values if np.isfinite(each)])
    if not len(known):
        return "-"
    mean = f"{known.mean():.3g}"
    if len(known) == 1:
        return mean
    half = t.ppf(0.975, len(known) - 1) * known.std(ddof=1) / np.sqrt(len(known))
    return f"{mean} ± {half:.2g}"


def table(
    rows: Iterable[OutputRow | RunRow], keys: Sequence[str], values: Sequence[str]
) -> list[str]:
    """Return the lines of a table: means over the parts of each scene."""
    found: dict[tuple[str, ...], list[OutputRow | RunRow]] = {}
    for row in rows:
        found.setdefault(tuple(getattr(row, key) for key in keys), []).append(row)
    lines = [f"| {' | '.join((*keys, *values))} |", "|---" * (len(keys) + len(values))]
    lines[1] += "|"
    for key, own in found.items():
        cells = [
            interval(
                [
                    (100.0 if "share" in name or "order" in name else 1.0)
                    * getattr(row, name)
                    for row in own
                ]
            )
            for name in values
        ]
        lines.append(f"| {' | '.join((*key, *cells))} |")
    return lines


def write(path: Path, rows: Sequence[OutputRow] | Sequence[RunRow]) -> None:
    """Write all rows as CSV."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(rows[0]._fields)
        writer.writerows(rows)


Folder = Annotated[Path | None, typer.Option(help="Folder of the recordings.")]


def main(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder.")] = Path("out"),
    seeds: Annotated[int, typer.Option(help="Number of dense scenes.")] = 10,
    jobs: Annotated[int, typer.Option(help="Number of processes.")] = 1,
    methods: Annotated[
        str, typer.Option(help="Methods, separated by semicolons.")
    ] = ";".join(METHODS),
    oos_mtt: Folder = None,
    kitti: Folder = None,
    autoferry: Folder = None,
    airport: Folder = None,
) -> None:
    """Print the means of all scores, and write `outputs.csv` and `runs.csv`."""
    groups = [list(dense_scenes(seed)) for seed in range(seeds)]
    if oos_mtt is not None:
        groups += [
            list(benchmark_scenes(each)) for each in sorted(oos_mtt.glob("scene*"))
        ]
    if kitti is not None:
        config = lagged(Config.from_yaml("kitti"))
        groups += [
            list(
                recorded_scenes(
                    f"KITTI {name}",
                    kitti / "oxts" / f"{name}.txt",
                    config,
                    "pointrcnn_car",
                    KITTI_DELAY_S,
                )
            )
            for name in ("0006", "0018")
        ]
    if autoferry is not None:
        config = lagged(Config.from_yaml("autoferry"))
        groups += [
            list(
                recorded_scenes(
                    f"Autoferry {number}",
                    autoferry / f"scenario{number}",
                    config,
                    "lidar",
                    AUTOFERRY_DELAY_S,
                )
            )
            for number in (3, 6)
        ]
    if airport is not None:
        groups.append(list(airport_scenes(airport)))
    tasks = [(group, method) for group in groups for method in methods.split(";")]
    found = Parallel(n_jobs=jobs, return_as="generator")(
        delayed(judged)(*task) for task in tasks
    )
    out.mkdir(parents=True, exist_ok=True)
    of_outputs: list[OutputRow] = []
    of_runs: list[RunRow] = []
    for outputs_of_task, runs_of_task in found:
        of_outputs += outputs_of_task
        of_runs += runs_of_task
        write(out / "outputs.csv", of_outputs)
        write(out / "runs.csv", of_runs)
    heads = ("scene", "delays", "method")
    typer.echo("\n".join(table(of_runs, heads, RunRow._fields[4:])))
    typer.echo("")
    typer.echo("\n".join(table(of_outputs, (*heads, "output"), OutputRow._fields[5:])))


if __name__ == "__main__":
    typer.run(main)
