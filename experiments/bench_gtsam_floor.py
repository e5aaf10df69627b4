"""Where the time of an update of `smoother` goes: what gtsam does, and what the tracker does around it.

    python experiments/bench_gtsam_floor.py

One object is tracked with the paper's sensors and delays (`bench_tracker.traffic`) and configs/smoother.yaml. The time
inside gtsam is the floor of any tracker that solves these windows by it. Processor time, median over the rounds.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import Annotated, Any
from unittest.mock import patch

import typer
from bench_tracker import traffic

from fgtrack.estimation.smoothing.gtsam import incremental
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import Tick
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import load

CONFIG = Path(__file__).parent.parent / "configs" / "smoother.yaml"
PARTS = {
    "making the factors": [(incremental.IncrementalSolver, "_changed_factors")],
    "iSAM2's update and the means": [(incremental._Graph, "solve")],
    "covariances": [(incremental.IncrementalSolver, "_covariance")],
}


@contextmanager
def timed(spent_ns: dict[str, int]) -> Iterator[None]:
    """Add the processor time of each part to `spent_ns`."""

    def around(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            before = time.process_time_ns()
            try:
                return function(*arguments)
            finally:
                spent_ns[name] += time.process_time_ns() - before

        return call

    with ExitStack() as stack:
        for name, functions in PARTS.items():
            for owner, function in functions:
                stack.enter_context(patch.object(owner, function, around(name, getattr(owner, function))))
        yield


def measure(ticks: Sequence[Tick]) -> dict[str, float]:
    """Microseconds of the parts per update of one object, and of the whole tracker."""
    spent_ns, num_updates = dict.fromkeys(PARTS, 0), 0
    tracker = build_tracker(load(Config, CONFIG, ["map.track=oval", "map.pit=oval"]))
    start_ns = time.process_time_ns()
    with timed(spent_ns):
        for tick in ticks:
            for message in tick.messages:
                tracker.receive(message)
            num_updates += len(tracker.tick(tick.now_ns).updates)
    whole_ns = time.process_time_ns() - start_ns
    inside_ns = sum(spent_ns.values())
    parts = {**spent_ns, "all that is asked of gtsam": inside_ns, "the whole tracker with one object": whole_ns}
    return {name: ns / 1e3 / num_updates for name, ns in parts.items()}


def main(
    rounds: Annotated[int, typer.Option(min=1)] = 5,
    num_ticks: Annotated[int, typer.Option(min=20, help="Of 50 per second.")] = 250,
) -> None:
    """Print the table."""
    ticks = traffic(1)[:num_ticks]
    measured = [measure(ticks) for _ in range(rounds)]
    print("| us per update | |\n| --- | --- |")
    for name in measured[0]:
        print(f"| {name} | {median(each[name] for each in measured):.0f} |")


if __name__ == "__main__":
    typer.run(main)
