"""Published examples with out-of-sequence measurements, with their parameters, against the exact joint estimate.

    python experiments/literature/literature.py -o out/literature

MATLAB: the example of `retrodict` and `retroCorrect` (Sensor Fusion and Tracking Toolbox). A 3D constant velocity
model, ten steps of 1 s; the ninth position arrives after the tenth. The process noise is an acceleration that is
constant over each step. The axes are independent, so x with y, and z with a copy of z, are two planar problems.

Stone Soup: the example "Kalman filter with Out-of-Sequence measurements". Seed 2000, 50 steps of 2 s, two sensors with
bearing and range, the second 5 s late. The example gives np.radians(3) and 20 as variances.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from fgtrack import (
    CV,
    NS_PER_S,
    FloatArray,
    Measurement,
    MotionModel,
    SensorPose,
    Start,
    estimator,
    measurement_model,
    nanoseconds,
)
from fgtrack.sim import draw_states

START_NS = 1_790_000_000 * NS_PER_S
LAG_S = 200.0
#: Initial state of MATLAB's example: x, vx, y, vy, z, vz.
MATLAB_STATE = (1.0, 0.4, 2.0, 0.3, 1.0, -0.2)
MATLAB_STEPS, MATLAB_STD = 10, 0.2
SOUP_STEPS, SOUP_STEP_S, SOUP_DELAY_S, SOUP_SEED = 50, 2.0, 5.0, 2000
SOUP_MOTION = CV(velocity_density_m2ps3=0.5)
SOUP_SENSORS = (SensorPose(x_m=-60.0), SensorPose(x_m=-150.0, y_m=60.0))
SOUP_R = np.diag([20.0, np.radians(3.0)])  # range, bearing


@dataclass(frozen=True)
class PiecewiseCv(CV):
    """Constant velocity whose acceleration is constant over each step; valid for whole steps."""

    std_mps2: float = MATLAB_STD

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.process_noise`: n steps of dt = 1 s, summed."""
        steps = np.rint(self.forward(dt_s)).astype(int)
        Q = np.zeros((*np.broadcast_shapes(steps.shape, x.shape[:-1]), 4, 4))
        for k in range(int(steps.max(initial=0))):
            # The acceleration of a step moves the position by t^2 / 2, and then by the gained speed.
            gain = np.zeros((4, 2))
            gain[:2] = (0.5 + k) * np.eye(2)
            gain[2:] = np.eye(2)
            Q += (k < steps)[..., None, None] * self.std_mps2**2 * (gain @ gain.T)
        return Q

    def transition(
        self, x: FloatArray, dt_s: float | FloatArray
    ) -> Any:  # Any: Transition is not public
        """See `MotionModel.transition`, with the process noise of this model."""
        return MotionModel.transition(self, x, dt_s)


@dataclass(frozen=True)
class Example:
    """A published example that was drawn."""

    motion: CV
    start: Start
    received: tuple[Measurement, ...]
    """In order of arrival."""
    truth: FloatArray
    """True last position, shape (2,)."""

    def exact(self) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the last state, given all measurements in the order of their stamps.

        A Kalman filter that is written here; it shares no code with the estimators. For bearings it is the extended
        filter of all methods.
        """
        x, P = prior_of(self.start)
        now_ns = self.start.stamp_ns
        for each in sorted(
            self.received, key=lambda item: (item.stamp_ns, item.content)
        ):
            dt_s = (each.stamp_ns - now_ns) / NS_PER_S
            F = np.eye(4)
            F[0, 2] = F[1, 3] = dt_s
            x, P = F @ x, F @ P @ F.T + self.motion.process_noise(x, dt_s)
            z, H = observed(each, x)
            S = H @ P @ H.T + each.R
            gain = np.linalg.solve(S, H @ P).T
            x, P = x + gain @ z, P - gain @ S @ gain.T
            now_ns = each.stamp_ns
        return x, P


def prior_of(start: Start) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of x, y, vx, vy at the start, as the estimators begin."""
    state = estimator("ekf-replay", CV(), start, lag_s=1.0).state_at(start.stamp_ns)
    return state.mean.copy(), state.covariance.copy()


def observed(item: Measurement, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return innovation and Jacobian of a position, or of range and bearing."""
    if item.model.linear:
        return item.z - x[:2], np.eye(2, 4)
    dx, dy = x[0] - item.pose.x_m, x[1] - item.pose.y_m
    distance = np.hypot(dx, dy)
    innovation = item.z - np.array([distance, np.arctan2(dy, dx)])
    innovation[1] = np.angle(np.exp(1j * innovation[1]))
    H = np.zeros((2, 4))
    H[:, :2] = [[dx / distance, dy / distance], [-dy / distance**2, dx / distance**2]]
    return innovation, H


def matlab(rng: np.random.Generator, axes: tuple[int, int] = (0, 2)) -> Example:
    """Draw MATLAB's example for two of its axes, given by their indices in the state."""
    motion = PiecewiseCv()
    x = np.array([MATLAB_STATE[k] for k in axes] + [MATLAB_STATE[k + 1] for k in axes])
    model = measurement_model(("x_m", "y_m"), motion)
    measurements = []
    for step in range(MATLAB_STEPS):
        if step:
            a = MATLAB_STD * rng.standard_normal(2)
            x = np.concatenate([x[:2] + x[2:] + 0.5 * a, x[2:] + a])
        z = x[:2] + MATLAB_STD * rng.standard_normal(2)
        R = MATLAB_STD**2 * np.eye(2)
        measurements.append(Measurement(START_NS + step * NS_PER_S, model, z, R))
    first, *others = measurements
    start = Start(
        stamp_ns=START_NS,
        position_m=first.z,
        position_std_m=1.0,
        yaw_rad=0.0,
        yaw_std_rad=0.0,
        speed_mps=0.0,
        speed_std_mps=1.0,
    )
    ninth = others.pop(-2)
    return Example(motion, start, (*others, ninth), x[:2])


def stone_soup(rng: np.random.Generator) -> Example:
    """Draw Stone Soup's example; the late sensor keeps its true stamps."""
    model = measurement_model(("range_m", "bearing_rad"), SOUP_MOTION)
    x = np.array([0.0, 0.0, 1.0, 1.0])
    received = []
    for step in range(SOUP_STEPS):
        if step:
            x = draw_states(SOUP_MOTION, x, SOUP_STEP_S, rng)
        stamp_ns = START_NS + nanoseconds(step * SOUP_STEP_S)
        for pose, delay_s in zip(SOUP_SENSORS, (0.0, SOUP_DELAY_S), strict=True):
            z = model.predict(x, pose)
            z = z + np.sqrt(np.diag(SOUP_R)) * rng.standard_normal(2)
            item = Measurement(stamp_ns, model, z, SOUP_R, pose)
            received.append((stamp_ns + nanoseconds(delay_s), item))
    received.sort(key=lambda pair: pair[0])
    start = Start(
        stamp_ns=START_NS,
        position_m=(0.0, 0.0),
        position_std_m=1.0,
        yaw_rad=np.pi / 4.0,
        yaw_std_rad=1.0 / np.sqrt(2.0),
        speed_mps=np.sqrt(2.0),
        speed_std_mps=1.0,
    )
    return Example(SOUP_MOTION, start, tuple(item for _, item in received), x[:2])


def last_state(name: str, example: Example) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of the newest state of the estimator `name`."""
    one = estimator(name, example.motion, example.start, lag_s=LAG_S)
    for each in example.received:
        one.update(each)
    state = one.state_at(max(each.stamp_ns for each in example.received))
    return state.mean, state.covariance


def deviation(name: str, example: Example) -> float:
    """Return the largest difference from the exact state, in its standard deviations."""
    mean, P = example.exact()
    return float(
        np.abs((last_state(name, example)[0] - mean) / np.sqrt(P.diagonal())).max()
    )


METHODS = (
    "ekf-replay",
    "ekf-rts",
    "rts",
    "zlz",
    "asd",
    "a1",
    "b1",
    "al1",
    "c",
    "rewind-forget",
    "drop",
    "as-current",
)
EXAMPLES: dict[str, Callable[[np.random.Generator], Example]] = {
    "MATLAB, x and y": matlab,
    "MATLAB, z": lambda rng: matlab(rng, (4, 4)),
    "Stone Soup": stone_soup,
}


def table(runs: int) -> str:
    """Return a Markdown table: largest deviation from the exact estimate and RMSE of the last position."""
    lines = [
        "| method | "
        + " | ".join(f"{name}: deviation [sd] | RMSE [m]" for name in EXAMPLES)
        + " |",
        "|---" * (1 + 2 * len(EXAMPLES)) + "|",
    ]
    drawn = {
        name: [make(np.random.default_rng([SOUP_SEED, seed])) for seed in range(runs)]
        for name, make in EXAMPLES.items()
    }
    for method in METHODS:
        cells: list[str] = []
        for examples in drawn.values():
            errors = [last_state(method, one)[0][:2] - one.truth for one in examples]
            worst = max(deviation(method, one) for one in examples)
            rmse_m = np.sqrt(np.mean(np.square(errors)) * 2.0)
            cells += [f"{worst:.1e}", f"{rmse_m:.3f}"]
        lines.append(f"| `{method}` | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder of the table.")] = Path(
        "out/literature"
    ),
    runs: Annotated[int, typer.Option(help="Runs of each example.")] = 20,
) -> None:
    """Write table.md."""
    out.mkdir(parents=True, exist_ok=True)
    text = table(runs)
    (out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    typer.run(main)
