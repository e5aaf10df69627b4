"""How close does every estimator come to the bound of what has arrived, over the delay of the better sensor?

    python experiments/bounds/bounds.py -o out/bounds

The scenario. A poor sensor measures every 50 ms and its detections come at once; a good one measures every 100 ms, half
way between two of the others, and is late by a constant delay. Twice: `cv`, linear, both measure positions; `ctrv`,
with the noise of the paper, where the poor sensor measures the speed too. The object is drawn from the motion model,
its first state from the prior, so model and truth agree. The present state is judged every 70 ms, which meets all
phases of both sensors, from 3 s on: after that the prior is forgotten. All estimators and delays see the same draws.

The bounds are those of `fgtrack.evaluation.bounds` at the same times: the mean of those along the drawn trajectories
and, as `posterior`, the one with the mean inside. What holds measurements back (`delayed-horizon`, `reorder-buffer`)
does so for the delay, the best choice.
"""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack import (
    CTRV,
    CV,
    NS_PER_S,
    CallError,
    Estimator,
    FloatArray,
    IntArray,
    Measurement,
    MotionModel,
    ScheduledMeasurement,
    Start,
    bounds,
    bounds_along,
    estimator,
    initial_state,
    list_estimators,
    measurement_model,
    nanoseconds,
    seconds,
)
from fgtrack.show import GREY, WRONG, save, style_of, styled
from fgtrack.sim import draw_states

START_NS = 1_790_000_000 * NS_PER_S
POOR_PERIOD_S, GOOD_PERIOD_S, GOOD_PHASE_S = 0.05, 0.1, 0.025
SETTLED_S, NOW_PERIOD_S = 3.0, 0.07
DELAYS_S = (0.0, 0.05, 0.1, 0.2, 0.3)
#: Of the lines of the figure; above 25 ms the good sensor is overtaken by the poor one.
LINE_DELAYS_S = (
    0.0,
    0.0125,
    0.025,
    0.0255,
    0.0375,
    0.05,
    0.075,
    0.1,
    0.15,
    0.2,
    0.25,
    0.3,
)
LAG_S = 1.0
PRIOR = Start(
    stamp_ns=START_NS,
    position_std_m=0.3,
    yaw_rad=0.4,
    yaw_std_rad=0.1,
    speed_mps=30.0,
    speed_std_mps=2.0,
    yaw_rate_radps=0.05,
    yaw_rate_std_radps=0.1,
)
BOUNDS = ("in time", "arrived", "dropped", "posterior, arrived")
EXACT = ("ekf-replay", "smoother")
DRAWN = ("ekf-replay", "smoother", "larsen", "rewind-forget", "delayed-horizon", "drop")
MARKERS = "osv^DP"
DODGE_S = 0.003  # between the markers of two estimators


@dataclass(frozen=True)
class World:
    """A motion model, and the standard deviations of what the two sensors measure of it."""

    motion: MotionModel
    good_std: dict[str, float]
    poor_std: dict[str, float]
    shown_m: tuple[float, float]
    """Range of the figure."""


WORLDS = {
    "cv": World(
        CV(5.0), {"x_m": 0.3, "y_m": 0.3}, {"x_m": 1.0, "y_m": 1.0}, (0.25, 0.9)
    ),
    "ctrv": World(
        CTRV(),
        {"x_m": 0.3, "y_m": 0.3},
        {"x_m": 1.0, "y_m": 1.0, "speed_mps": 0.2},
        (0.15, 0.55),
    ),
}


def starts(motion: MotionModel, delay_s: float) -> dict[str, Callable[[], Estimator]]:
    """The estimators by name."""
    options = {
        "smoother": {"final": False},
        "delayed-horizon": {"horizon_s": delay_s},
        "reorder-buffer": {"hold_s": delay_s},
    }
    return {
        name: lambda name=name: estimator(
            name, motion, PRIOR, lag_s=LAG_S, **options.get(name, {})
        )
        for name in ("ekf-replay", "smoother", *list_estimators("fgtrack.oosm"))
    }


class Case:
    """Drawn objects, what is measured of them, and the times at which they are judged."""

    def __init__(
        self, world: World, runs: int, duration_s: float, rng: np.random.Generator
    ) -> None:
        self.world = world
        self.good_ns = grid_ns(GOOD_PHASE_S, GOOD_PERIOD_S, duration_s)
        self.poor_ns = grid_ns(POOR_PERIOD_S, POOR_PERIOD_S, duration_s)
        self.now_ns = grid_ns(SETTLED_S, NOW_PERIOD_S, duration_s)
        self._stamps_ns = np.unique(
            [START_NS, *self.good_ns, *self.poor_ns, *self.now_ns]
        )
        self._states = chains(world.motion, self._stamps_ns, runs, rng)
        self.good = self._measured(self.good_ns, world.good_std, rng)
        self.poor = self._measured(self.poor_ns, world.poor_std, rng)

    def truth(self, stamps_ns: IntArray) -> FloatArray:
        """True states, shape (runs, s, n)."""
        return self._states[:, np.searchsorted(self._stamps_ns, stamps_ns)]

    def _measured(
        self, stamps_ns: IntArray, std: dict[str, float], rng: np.random.Generator
    ) -> FloatArray:
        """What a sensor measures, shape (runs, s, k)."""
        exact = measurement_model(tuple(std), self.world.motion).predict(
            self.truth(stamps_ns)
        )
        return exact + np.array(list(std.values())) * rng.standard_normal(exact.shape)

    def planned(self, delay_s: float) -> list[tuple[ScheduledMeasurement, FloatArray]]:
        """Every measurement with its values in all runs, shape (runs, k), in order of receipt."""
        found = []
        for stamps_ns, std, late_s, z in (
            (self.good_ns, self.world.good_std, delay_s, self.good),
            (self.poor_ns, self.world.poor_std, 0.0, self.poor),
        ):
            model = measurement_model(tuple(std), self.world.motion)
            R = np.diag(np.array(list(std.values())) ** 2)
            for i, stamp_ns in enumerate(stamps_ns.tolist()):
                found.append(
                    (
                        ScheduledMeasurement(
                            stamp_ns, stamp_ns + nanoseconds(late_s), model, R
                        ),
                        z[:, i],
                    )
                )
        return sorted(found, key=lambda item: item[0].receipt_ns)


def grid_ns(first_s: float, period_s: float, last_s: float) -> IntArray:
    """Stamps every `period_s`."""
    count = int((last_s - first_s) / period_s + 1e-9) + 1
    return START_NS + np.array(
        [nanoseconds(first_s + i * period_s) for i in range(count)]
    )


def chains(
    motion: MotionModel, stamps_ns: IntArray, runs: int, rng: np.random.Generator
) -> FloatArray:
    """States of objects that move as `motion` says, shape (runs, s, n)."""
    mean, covariance = initial_state(motion, PRIOR)
    states = [
        mean
        + rng.standard_normal((runs, motion.dim)) @ np.linalg.cholesky(covariance).T
    ]
    for step_ns in np.diff(stamps_ns).tolist():
        states.append(draw_states(motion, states[-1], seconds(step_ns), rng))
    return np.stack(states, axis=1)


def squared_errors(
    case: Case, start: Callable[[], Estimator], delay_s: float
) -> FloatArray:
    """Squared error of the present position, averaged over the times, of every run; shape (runs,), in m^2."""
    planned = case.planned(delay_s)
    truth = case.truth(case.now_ns)
    found = np.zeros(len(truth))
    for run in range(len(truth)):
        estimator, place = start(), 0
        for i, now_ns in enumerate(case.now_ns.tolist()):
            while place < len(planned) and planned[place][0].receipt_ns <= now_ns:
                item, z = planned[place]
                estimator.advance(item.receipt_ns)
                estimator.update(Measurement(item.stamp_ns, item.model, z[run], item.R))
                place += 1
            estimator.advance(now_ns)
            offset = estimator.state_at(now_ns).mean[:2] - truth[run, i, :2]
            found[run] += float(offset @ offset) / len(case.now_ns)
    return found


def mean_bounds(case: Case, delay_s: float) -> dict[str, float]:
    """Bounds of the mean squared position error in m^2, by name of `BOUNDS`."""
    planned = [item for item, _ in case.planned(delay_s)]
    _, covariance = initial_state(case.world.motion, PRIOR)
    about = (
        case.world.motion,
        START_NS,
        covariance,
        planned,
        case.truth,
        case.now_ns.tolist(),
    )
    found = (*bounds_along(*about), bounds(*about).arrived)
    traces = [np.trace(one[:, :2, :2], axis1=1, axis2=2).mean() for one in found]
    return dict(zip(BOUNDS, map(float, traces), strict=True))


@dataclass(frozen=True, slots=True)
class Entry:
    """An estimator, or a bound, at one delay."""

    model: str
    delay_s: float
    name: str
    mse_m2: float
    error_m2: float
    """Standard error of `mse_m2`; 0 of a bound."""
    bound_m2: float
    """The bound of what has arrived."""
    paired_m2: tuple[float, float] = (0.0, 0.0)
    """Mean squared error above that of `ekf-replay` in the same runs, and its standard error."""

    @property
    def rmse_m(self) -> float:
        """Root of the mean squared error."""
        return float(np.sqrt(self.mse_m2))

    @property
    def rmse_error_m(self) -> float:
        """Standard error of `rmse_m`."""
        return self.error_m2 / (2.0 * self.rmse_m)

    @property
    def deviations(self) -> float:
        """Mean squared error above the bound in standard errors."""
        return (self.mse_m2 - self.bound_m2) / self.error_m2 if self.error_m2 else 0.0


def bound_entries(model: str, case: Case, delay_s: float) -> list[Entry]:
    """The bounds."""
    limits = mean_bounds(case, delay_s)
    return [
        Entry(model, delay_s, f"bound: {name}", limit, 0.0, limits["arrived"])
        for name, limit in limits.items()
    ]


def measured(
    model: str, case: Case, delay_s: float, names: Sequence[str]
) -> list[Entry]:
    """Bounds, then the estimators `names`."""
    found = bound_entries(model, case, delay_s)
    arrived_m2 = found[0].bound_m2
    makers = starts(case.world.motion, delay_s)
    squared_m2 = {
        name: squared_errors(case, makers[name], delay_s)
        for name in dict.fromkeys(("ekf-replay", *names))
    }
    for name in names:
        paired_m2 = with_error(squared_m2[name] - squared_m2["ekf-replay"])
        found.append(
            Entry(
                model,
                delay_s,
                name,
                *with_error(squared_m2[name]),
                arrived_m2,
                paired_m2,
            )
        )
    return found


def with_error(samples: FloatArray) -> tuple[float, float]:
    """Mean and its standard error."""
    return float(samples.mean()), float(samples.std(ddof=1) / np.sqrt(len(samples)))


def write_csv(entries: Sequence[Entry], path: Path) -> None:
    """A row for each entry."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "model",
                "delay_s",
                "name",
                "rmse_m",
                "rmse_error_m",
                "mse_over_bound",
                "deviations",
            ]
        )
        for e in entries:
            numbers = (
                e.delay_s,
                e.rmse_m,
                e.rmse_error_m,
                e.mse_m2 / e.bound_m2,
                e.deviations,
            )
            delay, *others = (f"{number:.6g}" for number in numbers)
            writer.writerow([e.model, delay, e.name, *others])


def markdown(entries: Sequence[Entry]) -> str:
    """RMSE of every entry over the delays, and in brackets how far above the bound in standard errors."""
    lines = []
    for model in dict.fromkeys(e.model for e in entries):
        own = [e for e in entries if e.model == model]
        delays = dict.fromkeys(e.delay_s for e in own)
        lines.append(
            f"| {model} | "
            + " | ".join(f"{1e3 * delay_s:g} ms" for delay_s in delays)
            + " |"
        )
        lines.append("|---" * (len(delays) + 1) + "|")
        for name in dict.fromkeys(e.name for e in own):
            cells = [
                f"{e.rmse_m:.3f}" + (f" ({e.deviations:+.1f})" if e.error_m2 else "")
                for e in own
                if e.name == name
            ]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


def summary(entries: Sequence[Entry]) -> str:
    """How far the exact methods are from the bound, and whether any estimator is better than they are."""
    lines = []
    for model in dict.fromkeys(e.model for e in entries):
        judged = [e for e in entries if e.error_m2 and e.model == model]
        exact = [e for e in judged if e.name in EXACT]
        if exact:
            ratios = ", ".join(
                f"{e.name} {1e3 * e.delay_s:g} ms {e.mse_m2 / e.bound_m2:.3f}"
                for e in exact
            )
            farthest = max((e.deviations for e in exact), key=abs)
            lines.append(
                f"{model}: mean squared error / bound: {ratios}; at most {farthest:+.1f} standard errors off"
            )
        others = [e for e in judged if e.name not in EXACT and e.delay_s > 0.0]
        if others:
            best = min(others, key=lambda e: e.paired_m2[0])
            change = best.paired_m2[0] / best.mse_m2
            error = best.paired_m2[1] / best.mse_m2
            lines.append(
                f"{model}: best of the others beside ekf-replay: {best.name} at {1e3 * best.delay_s:g} ms, "
                f"mean squared error {change:+.2%} (standard error {error:.2%})"
            )
    return "\n".join(lines)


@styled
def draw(entries: Sequence[Entry], lines: Sequence[Entry], path: Path) -> None:
    """RMSE over the delay, a panel for each motion model; the bounds are those of `lines`."""
    figure = Figure(figsize=(10.0, 5.2))
    models = list(dict.fromkeys(e.model for e in entries))
    panels = figure.subplots(1, len(models))
    for axes, model in zip(panels, models, strict=True):
        _draw_bounds(axes, [e for e in lines if e.model == model])
        _draw_estimators(
            axes, [e for e in entries if e.model == model], WORLDS[model].shown_m
        )
        axes.set_title(
            f"{model.upper()}, {'linear' if WORLDS[model].motion.linear else 'nonlinear'}"
        )
        axes.set_xlabel("delay of the good sensor [ms]")
        axes.set_ylabel("RMSE of the present position [m]")
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        frameon=False,
    )
    save(figure, path)


def _draw_bounds(axes: Axes, lines: Sequence[Entry]) -> None:
    styles = {
        "in time": {"color": GREY, "linestyle": ":", "label": "bound: all in time"},
        "arrived": {
            "color": WRONG,
            "linestyle": "-",
            "label": "bound: what has arrived",
        },
        "dropped": {
            "color": GREY,
            "linestyle": "--",
            "label": "bound: late data dropped",
        },
    }
    for name, its in styles.items():
        own = [e for e in lines if e.name == f"bound: {name}"]
        axes.plot(
            [1e3 * e.delay_s for e in own],
            [e.rmse_m for e in own],
            linewidth=1.5,
            **its,
        )


def _draw_estimators(
    axes: Axes, entries: Sequence[Entry], shown_m: tuple[float, float]
) -> None:
    """With bars of two standard errors; beside each other where they would hide each other."""
    for index, name in enumerate(DRAWN):
        own = [e for e in entries if e.name == name]
        if not own:
            continue  # not asked for
        delays_s = (
            np.array([e.delay_s for e in own]) + (index - len(DRAWN) // 2) * DODGE_S
        )
        its = {
            "color": style_of(name).colour,
            "marker": MARKERS[index],
            "markersize": 4.5,
            "linestyle": "",
            "capsize": 2.0,
        }
        bars_m = [2.0 * e.rmse_error_m for e in own]
        axes.errorbar(
            1e3 * delays_s, [e.rmse_m for e in own], bars_m, label=name, **its
        )
    axes.set_ylim(*shown_m)


def main(
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for tables and figure.")
    ] = Path("out/bounds"),
    runs: Annotated[int, typer.Option(help="Drawn objects.")] = 32,
    duration_s: Annotated[
        float, typer.Option(help="For how long each is followed, more than 3 s.")
    ] = 20.0,
    seed: Annotated[int, typer.Option(help="Seed of the draws.")] = 1,
    estimators: Annotated[
        str, typer.Option(help="Names with commas between; by default all.")
    ] = "",
) -> None:
    """Write the errors and their bounds as CSV, Markdown and figure, and print them."""
    known = starts(CV(), 0.0)
    names = estimators.split(",") if estimators else list(known)
    if unknown := set(names) - set(known):
        raise CallError(
            f"--estimators: {', '.join(sorted(unknown))} unknown, there are {', '.join(known)}"
        )
    entries, lines = [], []
    for place, (model, world) in enumerate(WORLDS.items()):
        case = Case(world, runs, duration_s, np.random.default_rng([seed, place]))
        for delay_s in DELAYS_S:
            entries += measured(model, case, delay_s, names)
        for delay_s in LINE_DELAYS_S:
            lines += bound_entries(model, case, delay_s)
    out.mkdir(parents=True, exist_ok=True)
    write_csv(entries, out / "bounds.csv")
    (out / "bounds.md").write_text(markdown(entries))
    draw(entries, lines, out / "bounds.png")
    print(markdown(entries) + summary(entries))


if __name__ == "__main__":
    typer.run(main)
