"""Every out-of-sequence method on one scenario: error and consistency over the lag of one late measurement.

    python experiments/ladder/ladder.py -o out/ladder

The scenario. An object moves by the linear model CV with white noise acceleration of density 5 m^2/s^3. Its first state
is drawn from the prior: position N(0, (1 m)^2), velocity N(0, (10 m/s)^2) on each axis. Its position is measured every
0.1 s, 40 times, with standard deviation 1 m on each axis and without delay: after that the prior is forgotten, and the
velocity is about 11 m/s. One more measurement, with 0.3 m, was made half way between two of those stamps and arrives
just after the 40th: at lag l between the steps 40 - l and 41 - l, so (l - 1/2) 0.1 s late. The state at the 40th stamp
is judged then. All methods see the same draws.

The two axes are independent and alike, so a run counts as two samples of one axis: RMSE is the error of x or y, and
NEES that of one axis' position and velocity, 2 on average where the covariance is right.

`REFERENCE` holds what an earlier implementation gave in 400 runs of one axis. It says neither how the first state was
drawn, nor how many steps came before, nor where in its interval the late stamp lay. Half way is the one choice tried
that gives all its rows: a quarter of the interval earlier or later, as-current at lag 1 is a third off. The number of
steps and the first velocity matter to as-current alone. Its covariance intersection took the least trace over weights
from 0.01 to 0.99; here they go from 0 to 1, which changes less than 1 %.
"""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from fgtrack import (
    CV,
    CallError,
    Estimator,
    FloatArray,
    Measurement,
    Start,
    UpdateStatus,
    estimator,
    estimator_claims,
    list_estimators,
    measurement_model,
    nanoseconds,
)
from fgtrack.show import WRONG, log_axis, save, styled, styles
from fgtrack.sim import draw_states

MOTION = CV(velocity_density_m2ps3=5.0)
POSITION = measurement_model(("x_m", "y_m"), MOTION)
NUM_STEPS = 40
STEP_S = 0.1
STD_M = 1.0
LATE_STD_M = 0.3
SPEED_STD_MPS = 10.0
LAG_S = 10.0  # the window, longer than a run
LAGS = (1, 2, 3, 5, 7, 10)
MAX_RMSE_M, MAX_ANEES = 2.0, 30.0  # of the figure
PRIOR = Start(
    stamp_ns=0,
    yaw_rad=None,
    yaw_std_rad=0.0,
    speed_mps=0.0,
    speed_std_mps=SPEED_STD_MPS,
    yaw_rate_std_radps=0.0,
    accel_std_mps2=0.0,
)

#: What each method is exact for, by name; plug-ins of the group `fgtrack.oosm` included.
METHODS: dict[str, str] = {
    name: estimator_claims(name).exact
    for name in ("ekf-replay", *list_estimators("fgtrack.oosm"))
}

REFERENCE_RUNS = 400
REFERENCE_LAGS = (1, 3, 10)
#: RMSE in m and average NEES at those lags.
REFERENCE: dict[str, tuple[tuple[float, float], ...]] = {
    "ekf-replay": ((0.286, 2.03), (0.399, 1.88), (0.536, 1.90)),
    "rts": ((0.286, 2.03), (0.399, 1.88), (0.536, 1.90)),
    "zlz": ((0.286, 2.03), (0.399, 1.88), (0.536, 1.90)),
    "asd": ((0.286, 2.03), (0.399, 1.88), (0.536, 1.90)),
    "al1": ((0.286, 2.03), (0.399, 1.90), (0.538, 2.05)),
    "fpfd": ((0.286, 2.03), (0.399, 1.90), (0.538, 2.05)),
    "bl1": ((0.286, 2.03), (0.399, 1.90), (0.536, 1.98)),
    "c": ((0.286, 2.03), (0.405, 2.31), (0.545, 18.9)),
    "larsen": ((0.359, 1.96), (0.469, 1.93), (0.536, 1.94)),
    "ci": ((0.302, 2.04), (0.554, 1.99), (0.536, 1.91)),
    "rewind-forget": ((0.302, 2.05), (0.518, 2.01), (1.729, 1.90)),
    "drop": ((0.542, 1.98), (0.560, 2.01), (0.536, 1.92)),
    "as-current": ((0.530, 5.1), (2.19, 69.0), (8.05, 929.0)),
}


def delay_s(lag: int) -> float:
    """How long before the last step the late measurement was made."""
    return (lag - 0.5) * STEP_S


def starts(lag: int) -> dict[str, Callable[[], Estimator]]:
    """The estimators at `lag`; those that hold measurements back do so for as long as the late one needs."""
    held = {
        "delayed-horizon": {"horizon_s": delay_s(lag)},
        "reorder-buffer": {"hold_s": delay_s(lag)},
    }
    return {
        name: lambda name=name: estimator(
            name, MOTION, PRIOR, lag_s=LAG_S, **held.get(name, {})
        )
        for name in METHODS
    }


def arrivals(
    rng: np.random.Generator, lag: int
) -> tuple[list[Measurement], FloatArray]:
    """Measurements of one run in order of arrival, and the true last state."""
    x = np.concatenate([rng.standard_normal(2), SPEED_STD_MPS * rng.standard_normal(2)])
    stamps_s = {k * STEP_S: STD_M for k in range(1, NUM_STEPS + 1)}
    late_s = NUM_STEPS * STEP_S - delay_s(lag)
    now_s, measurements, late = 0.0, [], None
    for stamp_s, std_m in sorted((stamps_s | {late_s: LATE_STD_M}).items()):
        x = draw_states(MOTION, x, stamp_s - now_s, rng)
        z = x[:2] + std_m * rng.standard_normal(2)
        measurement = Measurement(
            nanoseconds(stamp_s), POSITION, z, std_m**2 * np.eye(2)
        )
        if stamp_s == late_s:
            late = measurement
        else:
            measurements.append(measurement)
        now_s = stamp_s
    assert late is not None
    return [*measurements, late], x


@dataclass(frozen=True, slots=True)
class Samples:
    """What a method gave at one lag, one entry per run and axis."""

    squared_m2: FloatArray
    """Squared error of the position."""
    nees: FloatArray
    """NEES of position and velocity."""
    fused_share: float
    """Share of the late measurements that were fused, and not refused."""

    @property
    def rmse_m(self) -> float:
        """Root of the mean squared error."""
        return float(np.sqrt(self.squared_m2.mean()))

    @property
    def anees(self) -> float:
        """Average NEES."""
        return float(self.nees.mean())

    def rmse_error_m(self, count: int) -> float:
        """Standard error of the RMSE of `count` such samples."""
        return float(self.squared_m2.std(ddof=1) / np.sqrt(count) / (2.0 * self.rmse_m))

    def anees_error(self, count: int) -> float:
        """Standard error of the average NEES of `count` such samples."""
        return float(self.nees.std(ddof=1) / np.sqrt(count))


def measured(lag: int, num_runs: int, seed: int) -> dict[str, Samples]:
    """Samples of every method at `lag`."""
    rng = np.random.default_rng([seed, lag])
    runs = [arrivals(rng, lag) for _ in range(num_runs)]
    found = {}
    for name, start in starts(lag).items():
        squared, nees, fused = [], [], []
        for measurements, truth in runs:
            estimator = start()
            statuses = [
                estimator.update(measurement).status for measurement in measurements
            ]
            fused.append(statuses[-1] is UpdateStatus.OUT_OF_SEQUENCE)
            state = estimator.state_at(nanoseconds(NUM_STEPS * STEP_S))
            error = state.mean - truth
            for axis in ([0, 2], [1, 3]):
                squared.append(error[axis[0]] ** 2)
                nees.append(
                    error[axis]
                    @ np.linalg.solve(state.covariance[np.ix_(axis, axis)], error[axis])
                )
        found[name] = Samples(np.array(squared), np.array(nees), sum(fused) / num_runs)
    return found


def write_csv(ladder: dict[int, dict[str, Samples]], path: Path) -> None:
    """A row per method and lag, with standard errors."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "method",
                "lag",
                "rmse_m",
                "rmse_error_m",
                "anees",
                "anees_error",
                "fused_share",
            ]
        )
        for lag, methods in ladder.items():
            for name, s in methods.items():
                errors = s.rmse_error_m(len(s.nees)), s.anees_error(len(s.nees))
                numbers = s.rmse_m, errors[0], s.anees, errors[1], s.fused_share
                writer.writerow([name, lag, *(f"{number:.6g}" for number in numbers)])


def markdown(ladder: dict[int, dict[str, Samples]]) -> str:
    """RMSE / average NEES of every method at every lag, and how many standard errors the reference is away."""
    lines = [
        "| method | " + " | ".join(f"l = {lag}" for lag in ladder) + " | exact for |"
    ]
    lines.append("|---" * (len(ladder) + 2) + "|")
    for name in next(iter(ladder.values())):
        cells = [cell(name, lag, methods[name]) for lag, methods in ladder.items()]
        lines.append(
            f"| {name} | " + " | ".join(cells) + f" | {METHODS[name] or '-'} |"
        )
    return "\n".join(lines) + "\n"


def cell(name: str, lag: int, samples: Samples) -> str:
    """RMSE / average NEES, and in brackets the differences to the reference in standard errors of both.

    Where not all late measurements were fused, the share that was.
    """
    text = f"{samples.rmse_m:.3f} / {samples.anees:.3g}"
    if samples.fused_share < 1.0:
        text += f", {samples.fused_share:.0%} fused"
    if name not in REFERENCE or lag not in REFERENCE_LAGS:
        return text
    rmse, anees = deviations(name, lag, samples)
    return f"{text} ({rmse:+.1f} / {anees:+.1f})"


def deviations(name: str, lag: int, samples: Samples) -> tuple[float, float]:
    """Differences of RMSE and average NEES to the reference, in standard errors of the difference."""
    rmse_m, anees = REFERENCE[name][REFERENCE_LAGS.index(lag)]
    count = 1.0 / (1.0 / len(samples.nees) + 1.0 / REFERENCE_RUNS)
    return (
        (samples.rmse_m - rmse_m) / samples.rmse_error_m(count),
        (samples.anees - anees) / samples.anees_error(count),
    )


@styled
def draw(ladder: dict[int, dict[str, Samples]], path: Path) -> None:
    """RMSE and average NEES over the lag, one line for all methods that give the same.

    Lines become thinner from first to last, so that those below are seen.
    """
    figure = Figure(figsize=(11.0, 6.0))
    left, right = figure.subplots(1, 2)
    lags = list(ladder)
    groups = alike(ladder)
    for index, (names, its) in enumerate(
        zip(groups, styles([names[0] for names in groups]), strict=True)
    ):
        curves = [ladder[lag][names[0]] for lag in lags]
        rmse_m, anees = [s.rmse_m for s in curves], [s.anees for s in curves]
        label = ", ".join(names)
        if max(rmse_m) > MAX_RMSE_M or max(anees) > MAX_ANEES:
            label += (
                f"\n(leaves the plot: to {max(rmse_m):.1f} m, NEES {max(anees):.0f})"
            )
        width = 1.0 + 4.0 * (1.0 - index / len(groups))
        style = {"color": its.colour, "linestyle": its.line, "linewidth": width}
        left.plot(lags, rmse_m, label=label, **style)
        right.plot(lags, anees, **style)
    right.axhline(2.0, color=WRONG, linewidth=0.8, label="as sure as it should be")
    left.set_ylim(0.25, MAX_RMSE_M)
    right.set_ylim(1.5, MAX_ANEES)
    for axes, quantity in (
        (left, "position RMSE on one axis [m]"),
        (right, "average NEES (2 degrees of freedom)"),
    ):
        axes.set_yscale("log")
        log_axis(axes.yaxis)
        axes.xaxis.set_major_locator(FixedLocator(lags))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel("lag of the late measurement [steps of 0.1 s]")
        axes.set_ylabel(quantity)
    left.yaxis.set_major_locator(
        FixedLocator([0.25, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.5, 2.0])
    )
    figure.legend(loc="outside lower center", ncols=3, frameon=False, handlelength=3.5)
    save(figure, path)


def alike(ladder: dict[int, dict[str, Samples]]) -> list[list[str]]:
    """Methods in groups that agree to 1e-6 in every sample at every lag."""
    groups: list[list[str]] = []
    for name in next(iter(ladder.values())):
        for group in groups:
            if all(
                np.allclose(m[name].squared_m2, m[group[0]].squared_m2, rtol=1e-6)
                for m in ladder.values()
            ):
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def main(
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--out", help="Folder for ladder.csv, ladder.md and ladder.png."
        ),
    ] = Path("out/ladder"),
    runs: Annotated[
        int, typer.Option(help="Runs per lag; each counts as two samples of one axis.")
    ] = 400,
    seed: Annotated[int, typer.Option(help="Seed of the draws.")] = 1,
    lags: Annotated[str, typer.Option(help="Lags in steps, 1 to 40.")] = ",".join(
        map(str, LAGS)
    ),
) -> None:
    """Write the ladder as CSV, Markdown and figure, and print it."""
    ladder = {lag: measured(lag, runs, seed) for lag in parsed(lags)}
    out.mkdir(parents=True, exist_ok=True)
    write_csv(ladder, out / "ladder.csv")
    (out / "ladder.md").write_text(markdown(ladder))
    draw(ladder, out / "ladder.png")
    print(markdown(ladder), end="")


def parsed(lags: str) -> Sequence[int]:
    """Lags from a list like `1,3,10`. Raises `CallError` for anything else."""
    found = lags.split(",")
    if not all(lag.isdecimal() and 1 <= int(lag) <= NUM_STEPS for lag in found):
        raise CallError(
            f"--lags {lags}: give whole numbers from 1 to {NUM_STEPS}, as in 1,3,10"
        )
    return [int(lag) for lag in found]


if __name__ == "__main__":
    typer.run(main)
