"""At which state should a late detection be matched?

    python experiments/association/association.py -o out/association

The scenario. Six objects drawn from the motion model of the paper set out side by side at 30 m/s, 1 m apart and up to
4 m ahead or behind: closer than cars, so that wrong matches are frequent enough to compare. A RADAR (1 m, 10 Hz)
reports at once, a LiDAR (0.3 m) late; both see an object in nine scans of ten. A late detection is matched with the
state of every track

- `prior`: at the stamp, from what was measured before it (`ekf-replay`),
- `smoothed`: at the stamp, from everything fused (`smoother`),
- `moved back`: at the present, moved back to the stamp by the motion model, noise left out (`ekf-replay`),
- `present`: at the present, as it is (`ekf-replay`),

by Mahalanobis distance, or within 5 m (`fgtrack.tracking.association`).

First with every track on its object: what is fused is what truly belongs together, and the matches are only counted.
All variants judge the same detections, so their differences are paired. Then as a tracker would, where a wrong match is
fused, at its own stamp in every variant: a track is on the object that most of its last five detections came from; a
match is wrong where the detection came from another one; a switch is a change of the object that a track is on. There
are neither births nor deaths.
"""

import csv
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.figure import Figure

from fgtrack import (
    CTRV,
    NS_PER_S,
    FloatArray,
    IntArray,
    Measurement,
    Start,
    StatesAt,
    TrackBank,
    initial_state,
    measurement_model,
    nanoseconds,
    seconds,
)
from fgtrack.config import GatedEuclidean, GatedMahalanobis
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.estimation.registry import estimator_bank
from fgtrack.show import PALETTE, log_axis, save, styled
from fgtrack.sim import draw_states
from fgtrack.tracking.association import Association
from fgtrack.tracking.preprocess import Candidates, Group

START_NS = 1_790_000_000 * NS_PER_S
MOTION = CTRV()
POSITION = measurement_model(("x_m", "y_m"), MOTION)
KINDS: dict[str, Association] = {
    "mahalanobis": GatedMahalanobis(gate_probability=0.999),
    "within 5 m": GatedEuclidean(),
}
NUM_OBJECTS = 6
SPACING_M, AHEAD_M, SPEED_MPS, YAW_RAD = 1.0, 4.0, 30.0, 0.4
RADAR_STD_M, RADAR_PERIOD_S = 1.0, 0.1
LIDAR_STD_M, LIDAR_PHASE_S = 0.3, 0.05
DETECTED = 0.9
SETTLED_S = 1.0  # not judged
REMEMBERED = 5
LAG_S = 1.5
#: Delay and period of the LiDAR in s.
SETTINGS = (
    (0.0, 0.4),
    (0.1, 0.4),
    (0.2, 0.4),
    (0.4, 0.4),
    (0.2, 0.1),
    (0.2, 0.2),
    (0.2, 0.8),
)
TRACKED = ((0.2, 0.1), (0.2, 0.4))


@dataclass(frozen=True)
class Scan:
    """What one sensor saw at one stamp."""

    late: bool
    stamp_ns: int
    receipt_ns: int
    sources: IntArray
    """Objects that the detections came from, shape (d,)."""
    positions_m: FloatArray
    """Shape (d, 2)."""

    @property
    def settled(self) -> bool:
        """Whether the tracks have settled before."""
        return self.stamp_ns >= START_NS + nanoseconds(SETTLED_S)

    @property
    def judged(self) -> bool:
        """Whether what becomes of the detections counts."""
        return self.late and self.settled

    def candidates(self) -> Candidates:
        """For the association."""
        count = len(self.positions_m)
        R = np.tile(
            (LIDAR_STD_M if self.late else RADAR_STD_M) ** 2 * np.eye(2), (count, 1, 1)
        )
        stack = Measurement(self.stamp_ns, POSITION, self.positions_m, R)
        lines = np.column_stack([self.positions_m, np.full(count, np.nan)])
        return Candidates(
            list(range(count)), {}, lines, [Group(np.arange(count), stack, R, None)]
        )


class Scene:
    """A drawn pack and what is seen of it, in order of receipt."""

    def __init__(
        self,
        delay_s: float,
        period_s: float,
        duration_s: float,
        rng: np.random.Generator,
    ) -> None:
        self.priors = [_prior(place, rng) for place in range(NUM_OBJECTS)]
        radar_ns = _grid(RADAR_PERIOD_S, RADAR_PERIOD_S, duration_s)
        lidar_ns = _grid(LIDAR_PHASE_S, period_s, duration_s)
        receipts_ns = lidar_ns + nanoseconds(delay_s)
        self._stamps_ns = np.unique([START_NS, *radar_ns, *lidar_ns, *receipts_ns])
        self._states = _drawn(self.priors, self._stamps_ns, rng)
        scans = [
            self._scan(False, stamp_ns, stamp_ns, rng) for stamp_ns in radar_ns.tolist()
        ]
        for stamp_ns, receipt_ns in zip(
            lidar_ns.tolist(), receipts_ns.tolist(), strict=True
        ):
            scans.append(self._scan(True, stamp_ns, receipt_ns, rng))
        self.scans = sorted(scans, key=lambda scan: scan.receipt_ns)

    def truth_m(self, stamp_ns: int) -> FloatArray:
        """True positions of all objects, shape (NUM_OBJECTS, 2)."""
        return self._states[np.searchsorted(self._stamps_ns, stamp_ns), :, :2]

    def _scan(
        self, late: bool, stamp_ns: int, receipt_ns: int, rng: np.random.Generator
    ) -> Scan:
        noise_m = rng.standard_normal((NUM_OBJECTS, 2)) * (
            LIDAR_STD_M if late else RADAR_STD_M
        )
        seen = np.flatnonzero(rng.random(NUM_OBJECTS) < DETECTED)
        return Scan(
            late, stamp_ns, receipt_ns, seen, (self.truth_m(stamp_ns) + noise_m)[seen]
        )


def _grid(first_s: float, period_s: float, last_s: float) -> IntArray:
    count = int((last_s - first_s) / period_s + 1e-9) + 1
    return START_NS + np.array(
        [nanoseconds(first_s + i * period_s) for i in range(count)]
    )


def _prior(place: int, rng: np.random.Generator) -> Start:
    """Side by side, `SPACING_M` apart, each up to `AHEAD_M` ahead or behind."""
    along_m, across_m = rng.uniform(-AHEAD_M, AHEAD_M), place * SPACING_M
    c, s = np.cos(YAW_RAD), np.sin(YAW_RAD)
    position_m = np.array([c * along_m - s * across_m, s * along_m + c * across_m])
    return Start(
        stamp_ns=START_NS,
        position_m=position_m,
        position_std_m=0.3,
        yaw_rad=YAW_RAD,
        yaw_std_rad=0.03,
        speed_mps=SPEED_MPS,
        speed_std_mps=1.0,
        yaw_rate_std_radps=0.03,
    )


def _drawn(
    priors: Sequence[Start], stamps_ns: IntArray, rng: np.random.Generator
) -> FloatArray:
    """States of all objects, shape (s, objects, n)."""
    starts = [initial_state(MOTION, prior) for prior in priors]
    states = [np.array([rng.multivariate_normal(*start) for start in starts])]
    for step_ns in np.diff(stamps_ns).tolist():
        states.append(draw_states(MOTION, states[-1], seconds(step_ns), rng))
    return np.array(states)


def replaying() -> TrackBank:
    """The bank of `ekf-replay`."""
    return ObjectBank(MOTION, lambda prior: ReplayEkf(MOTION, prior, LAG_S), LAG_S)


def smoothing() -> TrackBank:
    """The bank of `smoother`."""
    return estimator_bank("smoother", MOTION, LAG_S, {})


def at_stamp(bank: TrackBank, stamp_ns: int) -> StatesAt:
    """The bank's own answer."""
    return bank.states_at(stamp_ns)


def moved_back(bank: TrackBank, stamp_ns: int) -> StatesAt:
    """The present states, moved to `stamp_ns` as if there were no process noise."""
    now = bank.states_at(bank.present_ns)
    back_s = seconds(stamp_ns - bank.present_ns)
    F = MOTION.jacobian(now.means, back_s)
    return StatesAt(
        now.track_ids, MOTION.predict(now.means, back_s), F @ now.covariances @ F.mT
    )


def present(bank: TrackBank, _: int) -> StatesAt:
    """The present states as they are."""
    return bank.states_at(bank.present_ns)


#: Bank and states to match with, by variant.
VARIANTS: dict[
    str, tuple[Callable[[], TrackBank], Callable[[TrackBank, int], StatesAt]]
] = {
    "prior": (replaying, at_stamp),
    "smoothed": (smoothing, at_stamp),
    "moved back": (replaying, moved_back),
    "present": (replaying, present),
}


@dataclass
class Matches:
    """What became of the late detections of one run."""

    right: int = 0
    wrong: int = 0
    refused: int = 0

    def share(self, count: int) -> float:
        """Of all detections."""
        return count / (self.right + self.wrong + self.refused)


@dataclass
class Judged:
    """One run in which every track stays on its object."""

    matches: dict[tuple[str, str], Matches]
    """By variant and kind of association."""
    offset_m2: dict[str, float]
    """By variant: mean squared distance, from its object, of the state that is matched with."""


def judged(scene: Scene) -> Judged:
    """What each variant would match, where what is fused is right."""
    banks = {start: start() for start, _ in VARIANTS.values()}
    matches = {(variant, kind): Matches() for variant in VARIANTS for kind in KINDS}
    offsets_m2: dict[str, list[float]] = {variant: [] for variant in VARIANTS}
    for bank in banks.values():
        for track_id, prior in enumerate(scene.priors):
            bank.birth(track_id, prior)
    for scan in scene.scans:
        candidates = scan.candidates()
        for bank in banks.values():
            bank.advance(scan.receipt_ns)
        if scan.judged:
            for variant, (start, states_for) in VARIANTS.items():
                states = states_for(banks[start], scan.stamp_ns)
                gaps_m = states.means[:, :2] - scene.truth_m(scan.stamp_ns)
                offsets_m2[variant] += np.vecdot(gaps_m, gaps_m).tolist()
                for kind, associate in KINDS.items():
                    assignment, counts = (
                        associate(candidates, states),
                        matches[variant, kind],
                    )
                    right = sum(
                        scan.sources[i] == states.track_ids[j]
                        for i, j in assignment.pairs
                    )
                    counts.right += int(right)
                    counts.wrong += len(assignment.pairs) - int(right)
                    counts.refused += len(assignment.new)
        for bank in banks.values():
            bank.update(
                scan.stamp_ns,
                scan.sources.tolist(),
                [candidate.measurement for candidate in candidates],
            )
    return Judged(
        matches,
        {variant: float(np.mean(values)) for variant, values in offsets_m2.items()},
    )


def merged(settings: Sequence[Judged]) -> Judged:
    """Several settings of one run, taken together."""
    keys = settings[0].matches
    parts = {key: [one.matches[key] for one in settings] for key in keys}
    return Judged(
        {
            key: Matches(
                *(sum(counts) for counts in zip(*map(astuple, parts[key]), strict=True))
            )
            for key in keys
        },
        {
            variant: float(np.mean([one.offset_m2[variant] for one in settings]))
            for variant in VARIANTS
        },
    )


@dataclass
class Followed:
    """One run of a tracker that fuses what it matches."""

    matches: Matches = field(default_factory=Matches)
    switches: int = 0
    squared_m2: list[float] = field(default_factory=list)
    """Squared distances of the present positions from the object that the track is on."""


def followed(scene: Scene, variant: str) -> Followed:
    """One run of `variant`, matched by Mahalanobis distance."""
    start, states_for = VARIANTS[variant]
    bank, found = start(), Followed()
    for track_id, prior in enumerate(scene.priors):
        bank.birth(track_id, prior)
    recent = [deque([track_id], REMEMBERED) for track_id in range(NUM_OBJECTS)]
    on = list(range(NUM_OBJECTS))
    for scan in scene.scans:
        bank.advance(scan.receipt_ns)
        states = (
            states_for(bank, scan.stamp_ns)
            if scan.late
            else bank.states_at(scan.stamp_ns)
        )
        candidates = scan.candidates()
        assignment = KINDS["mahalanobis"](candidates, states)
        pairs = [
            (candidate, states.track_ids[track])
            for candidate, track in assignment.pairs
        ]
        measurements = [candidates[candidate].measurement for candidate, _ in pairs]
        bank.update(scan.stamp_ns, [track_id for _, track_id in pairs], measurements)
        for candidate, track_id in pairs:
            source = int(scan.sources[candidate])
            if scan.judged:
                found.matches.right += source == on[track_id]
                found.matches.wrong += source != on[track_id]
            recent[track_id].append(source)
            most, count = Counter(recent[track_id]).most_common(1)[0]
            if most != on[track_id] and count > REMEMBERED // 2:
                on[track_id] = most
                found.switches += scan.settled
        if scan.judged:
            found.matches.refused += len(assignment.new)
            gaps_m = (
                np.array([state.mean[:2] for state in bank.present()])
                - scene.truth_m(scan.receipt_ns)[on]
            )
            found.squared_m2 += np.vecdot(gaps_m, gaps_m).tolist()
    return found


def mean_error(values: Sequence[float]) -> tuple[float, float]:
    """Mean and its standard error."""
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


Row = dict[str, str | float]
JUDGED = (
    "delay_s",
    "period_s",
    "kind",
    "variant",
    "wrong",
    "wrong_error",
    "wrong_minus_prior",
)
JUDGED += ("wrong_minus_prior_error", "refused", "offset_m")
FOLLOWED = (
    "delay_s",
    "period_s",
    "variant",
    "wrong",
    "wrong_error",
    "refused",
    "switches",
    "switches_error",
)
FOLLOWED += ("rmse_m", "rmse_error_m")


def judged_rows(
    delay_s: float | str, period_s: float | str, found: Sequence[Judged]
) -> list[Row]:
    """A row for each variant and kind; beside the shares the paired difference to `prior`."""
    rows: list[Row] = []
    for variant, kind in found[0].matches:
        own = [one.matches[variant, kind] for one in found]
        wrong, wrong_error = mean_error([one.share(one.wrong) for one in own])
        prior = [
            one.share(one.wrong)
            for one in (each.matches["prior", kind] for each in found)
        ]
        change, change_error = mean_error(
            [
                one.share(one.wrong) - before
                for one, before in zip(own, prior, strict=True)
            ]
        )
        refused = float(np.mean([one.share(one.refused) for one in own]))
        offset_m = float(np.sqrt(np.mean([one.offset_m2[variant] for one in found])))
        shares = wrong, wrong_error, change, change_error, refused, offset_m
        rows.append(
            dict(zip(JUDGED, (delay_s, period_s, kind, variant, *shares), strict=True))
        )
    return rows


def followed_row(
    delay_s: float, period_s: float, variant: str, found: Sequence[Followed]
) -> Row:
    """Of all runs of one variant."""
    wrong, wrong_error = mean_error(
        [one.matches.share(one.matches.wrong) for one in found]
    )
    switches, switches_error = mean_error([one.switches for one in found])
    squared_m2, squared_error_m2 = mean_error(
        [float(np.mean(one.squared_m2)) for one in found]
    )
    rmse_m = float(np.sqrt(squared_m2))
    refused = float(np.mean([one.matches.share(one.matches.refused) for one in found]))
    errors = (
        wrong,
        wrong_error,
        refused,
        switches,
        switches_error,
        rmse_m,
        squared_error_m2 / (2.0 * rmse_m),
    )
    return dict(zip(FOLLOWED, (delay_s, period_s, variant, *errors), strict=True))


def write(rows: Sequence[Row], path: Path) -> str:
    """Write `rows` as CSV; gives the text."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(rows[0])
        writer.writerows(
            [v if isinstance(v, str) else f"{v:.4g}" for v in row.values()]
            for row in rows
        )
    return path.read_text()


@styled
def draw(rows: Sequence[Row], path: Path) -> None:
    """How far off the states are that are matched with, and the share of wrong matches over all late settings."""
    figure = Figure(figsize=(9.0, 3.9))
    left, right = figure.subplots(1, 2)
    for index, variant in enumerate(VARIANTS):
        for place, kind in enumerate(KINDS):
            own = [
                row for row in rows if row["kind"] == kind and row["variant"] == variant
            ]
            delays = [row for row in own if row["period_s"] == 0.4]
            if place == 0 and variant != "present":  # metres away
                look = {
                    "color": PALETTE[index],
                    "marker": "os^"[index],
                    "label": variant,
                    "linewidth": 3.0 - index,
                }
                left.plot(
                    [1e3 * row["delay_s"] for row in delays],
                    [row["offset_m"] for row in delays],
                    **look,
                )
            x, late = index + 0.4 * place, own[-1]
            fill = {"color": PALETTE[index], "alpha": 1.0 - 0.5 * place}
            right.bar(
                x,
                100.0 * late["wrong"],
                0.36,
                yerr=200.0 * late["wrong_error"],
                capsize=3.0,
                **fill,
            )
            if late["refused"] > 0.01:
                right.text(
                    x,
                    130.0 * late["wrong"],
                    f"{late['refused']:.0%}\nrefused",
                    ha="center",
                    fontsize=7,
                )
    left.set(
        xlabel="delay of the LiDAR [ms] (period 400 ms)",
        ylabel="RMS error of the state matched with [m]",
    )
    left.set_ylim(0.0, None)
    left.legend()
    right.set_xticks([index + 0.2 for index in range(len(VARIANTS))], list(VARIANTS))
    right.set_xlabel("matched by Mahalanobis distance (dark), within 5 m (light)")
    right.set(
        ylabel="late detections matched wrongly [%]", yscale="log", ylim=(0.5, 60.0)
    )
    log_axis(right.yaxis)
    save(figure, path)


def main(
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for tables and figure.")
    ] = Path("out/association"),
    runs: Annotated[int, typer.Option(help="Drawn packs for each setting.")] = 60,
    duration_s: Annotated[
        float, typer.Option(help="For how long each is followed, at least 2 s.")
    ] = 5.0,
    seed: Annotated[int, typer.Option(help="Seed of the draws.")] = 1,
) -> None:
    """Match late detections at every kind of state, write judged.csv, followed.csv and association.png."""
    judged_all, followed_all, late = [], [], []
    for delay_s, period_s in SETTINGS:
        scenes = [
            Scene(delay_s, period_s, duration_s, np.random.default_rng([seed, run]))
            for run in range(runs)
        ]
        found = [judged(scene) for scene in scenes]
        judged_all += judged_rows(delay_s, period_s, found)
        if delay_s > 0.0:
            late.append(found)
        if (delay_s, period_s) in TRACKED:
            for variant in VARIANTS:
                tracks = [followed(scene, variant) for scene in scenes]
                followed_all.append(followed_row(delay_s, period_s, variant, tracks))
    judged_all += judged_rows(
        "late", "all", [merged(run) for run in zip(*late, strict=True)]
    )
    out.mkdir(parents=True, exist_ok=True)
    print(write(judged_all, out / "judged.csv"))
    print(write(followed_all, out / "followed.csv"), end="")
    draw(judged_all, out / "association.png")


if __name__ == "__main__":
    typer.run(main)
