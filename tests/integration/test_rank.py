"""`fgtrack rank`: exact methods are named exact, other methods depart, and methods of others are taken in each form."""

import json
import math
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from fgtrack.cli.main import app
from fgtrack.core.errors import CallError
from fgtrack.ranking.files import read_states, write_exact, write_problem
from fgtrack.ranking.judge import judge, permuted
from fgtrack.ranking.methods import Answers, Shipped
from fgtrack.ranking.problem import LAGS_S, Arrival, Problem
from fgtrack.ranking.public import MethodLike, method
from fgtrack.ranking.public import rank as ranked
from fgtrack.ranking.ranks import positive
from fgtrack.ranking.result import EXACT, Ranking, Result
from fgtrack.ranking.scenarios import SCENARIOS, draw

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "rank.md").read_text(encoding="utf-8")
ADAPTER, IN_PYTHON = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
(SHELL,) = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)

#: A Kalman filter that sorts all known measurements by their stamps.
SORTED = """
import numpy as np
def at(given, known, time_s):
    x, P, now = given.mean, given.covariance, 0.0
    q = given.parameters["velocity_density_m2ps3"]
    for each in [*sorted(known, key=lambda each: each.stamp_s), None]:
        dt = (time_s if each is None else each.stamp_s) - now
        if each is not None and each.stamp_s > time_s:
            continue
        F = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
        Q = q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        x, P, now = F @ x, F @ P @ F.T + Q, now + dt
        if each is not None:
            R = each.stds["x_m"] ** 2 * np.eye(2)
            H = np.eye(2, 4)
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            x = x + K @ (np.array([each.values["x_m"], each.values["y_m"]]) - H @ x)
            P = P - K @ H @ P
    return x, P
"""
FUSE = """
def fuse(given, observations, queries):
    return [at(given, observations[:known], time_s) for known, time_s in queries]
"""
SHORT = """
class One:
    def __init__(self, given): pass
    def update(self, observation): pass
    def state_at(self, time_s): return [1.0]
"""


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def program(path: Path, text: str) -> Path:
    written(path, text).chmod(0o755)
    return path


def rank(like: MethodLike, scenario: str = "linear", num_runs: int = 2) -> Result:
    (result,) = ranked([like], [scenario], num_runs=num_runs).results
    return result


@pytest.mark.parametrize("scenario", ["linear", "late-by-3", "bursts", "copies"])
def test_exact_methods_are_named_exact(scenario: str) -> None:
    result = rank("smoother-banded", scenario)
    assert result.deviations.max() < EXACT
    assert result.order < EXACT
    assert (
        "present estimate is exact; the estimate 0.3 s ago is exact; the estimate 1 s"
        in result.sentence
    )
    assert "the order of arrival does not matter" in result.sentence


def test_a_filter_is_exact_now_and_not_in_the_past() -> None:
    result = rank("ekf-replay")
    assert result.deviations[:, 0].max() < EXACT
    assert result.deviations[:, 1:].min() > 0.5


def test_late_data_that_count_as_present_are_named() -> None:
    result = rank("as-current", num_runs=3)
    assert result.deviation > 1.0
    assert result.order > 1.0
    assert "another order of arrival changes an estimate" in result.sentence


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["range-bearing", "doppler", "ctrv"])
def test_nonlinear_scenarios_rank_an_iterated_smoother_near_the_exact_estimate(
    scenario: str,
) -> None:
    assert np.nanmax(rank("smoother-batch", scenario).deviations) < 0.2


def test_a_filter_is_near_the_exact_estimate_of_a_nonlinear_scenario() -> None:
    result = rank("ekf-replay", "range-bearing")
    assert EXACT < result.deviation < 0.2


def test_the_adapter_of_the_page_runs_and_departs(tmp_path: Path) -> None:
    path = written(tmp_path / "at_arrival.py", ADAPTER)
    result = rank(path)
    assert result.problem is None
    assert result.deviation > 1.0


@pytest.mark.parametrize(
    "scenario",
    [pytest.param("range-bearing", marks=pytest.mark.slow), "doppler"],
)
def test_an_innovation_of_an_observation_is_that_of_the_extended_filter(
    scenario: str,
) -> None:
    class Sorted:
        def __init__(self, given: Any) -> None:
            self.given, self.known = given, []  # type: ignore[var-annotated]

        def update(self, observation: Any) -> None:
            self.known.append(observation)

        def state_at(self, time_s: float) -> Any:
            x, P, now_s = self.given.mean, self.given.covariance, 0.0
            for each in sorted(self.known, key=lambda each: each.stamp_s):
                if each.stamp_s <= time_s:
                    F, Q = self.given.transition(each.stamp_s - now_s)
                    x, P, now_s = F @ x, F @ P @ F.T + Q, each.stamp_s
                    y, H = each.innovation(x)
                    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + each.R)
                    x, P = x + K @ y, P - K @ H @ P
            F, Q = self.given.transition(time_s - now_s)
            return F @ x, F @ P @ F.T + Q

    found, shipped = rank(Sorted, scenario), rank("ekf-replay", scenario)
    np.testing.assert_allclose(found.deviations, shipped.deviations, atol=1e-9)


def test_the_adapter_of_the_page_is_short() -> None:
    code = [line for line in ADAPTER.splitlines() if line.strip()]
    assert len(code) <= 15


def test_the_page_ranks_in_python(capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(IN_PYTHON, "rank.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "# drop" in printed
    assert "It departs most in late-by-3, by" in printed
    assert "measurements not fused" in printed


def test_a_table_holds_the_deviations_of_all_methods_the_exact_first() -> None:
    found = ranked(["drop", "ekf-replay"], ["late-by-3", "late-by-10"], num_runs=2)
    table = found.deviations()
    assert [record["method"] for record in table.records] == ["ekf-replay", "drop"]
    assert found.summary("ekf-replay") == (
        "the present estimate is exact in 2 of 2 scenarios of one object"
    )
    assert "ekf-replay" in table.to_latex()


def test_a_function_that_sorts_is_exact_now(tmp_path: Path) -> None:
    path = written(tmp_path / "sorted.py", SORTED + FUSE)
    result = rank(path)
    assert result.deviations[:, 0].max() < EXACT


@pytest.mark.parametrize(
    ("exact", "sabotage"),
    [
        ('each.stds["x_m"] ** 2', '1.21 * each.stds["x_m"] ** 2'),
        ("each.stamp_s", "each.receipt_s"),
        *(
            pytest.param(*texts, marks=pytest.mark.slow)
            for texts in (
                ("H = np.eye(2, 4)", "H = 1.1 * np.eye(2, 4)"),
                ("F @ P @ F.T + Q", "F @ P @ F.T + 0.9 * Q"),
                ("known, key", "known[-20:], key"),
            )
        ),
    ],
    ids=["noise", "stamped at arrival", "H", "motion", "forgetting"],
)
def test_a_sabotaged_copy_of_an_exact_method_is_named_by_its_deviation(
    tmp_path: Path, exact: str, sabotage: str
) -> None:
    text = SORTED + FUSE
    assert exact in text
    path = written(tmp_path / "copy.py", text.replace(exact, sabotage))
    result = rank(path)
    assert result.deviation > 1e-3
    assert re.search(
        r"present estimate departs by up to [0-9.e-]+ standard deviations",
        result.sentence,
    )


class Sabotaged(Shipped):
    """A shipped estimator that is given altered measurements."""

    def __init__(self, estimator: str, kind: str) -> None:
        super().__init__(estimator)
        self.estimator, self.kind = estimator, kind
        self.name = f"{estimator}, {kind}"

    def answers(self, problem: Problem) -> Answers:
        self.name, name = self.estimator, self.name
        arrivals = tuple(map(self.altered, problem.arrivals))
        found = super().answers(replace(problem, arrivals=arrivals))
        self.name = name
        return found

    def altered(self, arrival: Arrival) -> Arrival:
        one = arrival.measurement
        if self.kind == "noise":
            changed = replace(one, R=1.21 * one.R)
        elif self.kind == "H":  # z = 1.1 x + noise
            changed = replace(one, z=one.z / 1.1, R=one.R / 1.21)
        else:
            changed = replace(one, stamp_ns=arrival.receipt_ns)
        return replace(arrival, measurement=changed)


@pytest.mark.slow  # sixteen methods
def test_sabotaged_copies_of_all_exact_estimators_are_named() -> None:
    exact = ("smoother-banded", "ekf-replay", "ekf-rts", "asd")
    copies = [Sabotaged(n, k) for n in exact for k in ("noise", "H", "stamped")]
    found = judge([*map(Shipped, exact), *copies], ["linear"], 2, 1)
    for result in found.results:
        assert isinstance(result, Result)
        if result.method in exact:
            assert result.deviation < EXACT
            assert "the present estimate is exact" in result.sentence
        else:
            assert result.deviation > 0.01
            assert "the present estimate departs by up to" in result.sentence


NEAREST = """
def fuse(given, observations, queries):
    answers = []
    for known, time_s in queries:
        near = min(observations, key=lambda each: abs(each.stamp_s - time_s))
        answers.append((near.values["x_m"], near.values["y_m"], 0.0, 0.0))
    return answers
"""
#: The position that is nearest in time in the whole file.
NEAREST_PROGRAM = """#!{python}
import csv, sys
rows = list(csv.DictReader(open(sys.argv[1])))
states = csv.writer(open(sys.argv[2], "w"))
states.writerow(("x_m", "y_m", "vx_mps", "vy_mps"))
seen = [row for row in rows if row["kind"] == "measurement"]
for query in rows:
    if query["kind"] == "query":
        wanted = float(query["stamp_s"])
        near = min(seen, key=lambda row: abs(float(row["stamp_s"]) - wanted))
        states.writerow((near["x_m"], near["y_m"], 0.0, 0.0))
"""
#: A filter that is exact now. It is given all queries behind all measurements.
BEHIND = """#!{python}
import csv, sys
from types import SimpleNamespace
from pathlib import Path
import numpy as np
sys.path.insert(0, str(Path(__file__).parent))
import sorted_by_stamp
folder = Path(sys.argv[1]).parent
(prior,) = csv.DictReader(open(folder / "prior.csv"))
P = np.zeros((4, 4))
for i in range(4):
    for j in range(i, 4):
        P[i, j] = P[j, i] = float(prior[f"p_{{i}}_{{j}}"])
mean = np.array([float(prior[name]) for name in ("x_m", "y_m", "vx_mps", "vy_mps")])
given = SimpleNamespace(
    mean=mean, covariance=P, parameters={{"velocity_density_m2ps3": 2.0}}
)
rows = list(csv.DictReader(open(sys.argv[1])))
seen = [
    SimpleNamespace(
        stamp_s=float(row["stamp_s"]),
        values={{name: float(row[name]) for name in ("x_m", "y_m")}},
        stds={{"x_m": float(row["std_x_m"])}},
    )
    for row in rows
    if row["kind"] == "measurement"
]
states = csv.writer(open(sys.argv[2], "w"))
states.writerow(("x_m", "y_m", "vx_mps", "vy_mps"))
for row in rows:
    if row["kind"] == "query":
        states.writerow(sorted_by_stamp.at(given, seen, float(row["stamp_s"]))[0])
"""
WITH_POSITIONS = [
    name for name in SCENARIOS if name not in ("range-bearing", "doppler")
]


@pytest.mark.parametrize("scenario", WITH_POSITIONS)
def test_a_function_that_takes_the_nearest_position_of_the_file_is_not_causal(
    tmp_path: Path, scenario: str
) -> None:
    problem = rank(written(tmp_path / "nearest.py", NEAREST), scenario).problem
    assert problem is not None
    assert re.fullmatch(
        r"not causal: the answer for [0-9.]+ s, after \d+ arrivals, "
        "changes where later rows are missing, or from run to run",
        problem,
    )


@pytest.mark.parametrize("scenario", ["linear", "late-by-1", "late-by-10", "bursts"])
def test_a_function_that_uses_later_data_is_not_causal(
    tmp_path: Path, scenario: str
) -> None:
    text = SORTED + FUSE.replace("observations[:known]", "observations")
    result = rank(written(tmp_path / "future.py", text), scenario)
    assert "no result: not causal: the answer for" in result.sentence


@pytest.mark.skipif(sys.platform == "win32", reason="an executable script")
def test_a_program_that_uses_later_rows_is_not_causal(tmp_path: Path) -> None:
    written(tmp_path / "sorted_by_stamp.py", SORTED)
    for name, text in (("nearest", NEAREST_PROGRAM), ("behind", BEHIND)):
        path = program(tmp_path / name, text.format(python=sys.executable))
        result = rank(path, "late-by-10")
        assert "no result: not causal: the answer for" in result.sentence


@pytest.mark.parametrize("scenario", ["linear", "late-by-3", "copies", "doppler"])
def test_a_function_that_uses_what_is_known_is_causal(
    tmp_path: Path, scenario: str
) -> None:
    text = NEAREST.replace("min(observations,", "min(observations[:known],")
    text = text.replace('near.values["x_m"], near.values["y_m"]', "near.z[0], 0.0")
    assert rank(written(tmp_path / "known.py", text), scenario).problem is None


class Counting:
    """An exact method that counts the arrivals that it is given."""

    def __init__(self) -> None:
        self.exact, self.num_arrivals = method("smoother-banded"), 0

    def answers(self, problem: Problem) -> Answers:
        self.num_arrivals += len(problem.arrivals)
        return self.exact.answers(problem)


def test_the_check_for_later_data_costs_less_than_the_judged_runs(
    tmp_path: Path,
) -> None:
    path = written(tmp_path / "sorted.py", SORTED + FUSE)
    for scenario in SCENARIOS:
        one, problem = method(path), draw(scenario, 1)
        counting = Counting()
        one.answers = counting.answers  # type: ignore[method-assign]
        one.check_causality(problem)
        assert 3 < counting.num_arrivals / len(problem.arrivals) < 7


def test_a_method_that_is_not_made_for_a_scenario_takes_no_part() -> None:
    class Positions:
        def __init__(self, given: Any) -> None:
            self.transition = given.transition(0.1)

        def update(self, observation: Any) -> None: ...

        def state_at(self, time_s: float) -> None: ...

    result = rank(Positions, "ctrv")
    assert not result.takes_part
    assert "takes no part: no linear transition for ctrv" in result.sentence


def test_a_measurement_that_is_refused_is_counted(tmp_path: Path) -> None:
    text = SHORT.replace("pass\n    def state", "return False\n    def state")
    result = rank(written(tmp_path / "never.py", text.replace("[1.0]", "[1.0] * 4")))
    assert "measurements not fused (refused" in result.sentence


def test_a_class_of_several_is_named(tmp_path: Path) -> None:
    path = written(tmp_path / "two.py", SHORT + SHORT.replace("One", "Two"))
    with pytest.raises(CallError, match="holds One, Two: name one"):
        method(path)
    assert method(f"{path}:Two").name == "two.Two"
    with pytest.raises(CallError, match="Three: is no method: One, Two"):
        method(f"{path}:Three")


def test_without_the_offset_of_a_clock_no_method_is_exact() -> None:
    problem = draw("two-clocks", 1)
    offsets_ns = {
        each.sensor: each.measurement.stamp_ns - each.true_stamp_ns
        for each in problem.arrivals
    }
    assert offsets_ns == {"lidar": 0, "radar": 100_000_000}
    assert rank("smoother-banded", "two-clocks").deviation > 0.5


@pytest.mark.skipif(sys.platform == "win32", reason="a shell script")
def test_a_shell_program_is_ranked(tmp_path: Path) -> None:
    path = program(tmp_path / "last.sh", SHELL)
    result = rank(path)
    assert result.problem is None
    assert np.isnan(result.nees).all()
    assert result.rmse_m[:, 0].max() < 20.0


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("#!/bin/sh\necho no model >&2\nexit 3\n", "exit code 3: no model"),
        (
            "#!/bin/sh\n",
            "the program ended with exit code 0 but wrote no states.csv: its second",
        ),
        (
            "#!/bin/sh\nawk 'BEGIN { while (i++ < 15) print \"1,2,3,4\" }' > $2\n",
            "states.csv: column 'x_m' is missing; the first line must be the header",
        ),
        (
            "#!/bin/sh\nawk 'BEGIN { print \"x\"; while (i++ < 15) print 1 }' > $2\n",
            "states.csv: column 'x_m' is missing",
        ),
        ("#!/bin/none\n", "the interpreter in its first line (#!) does not exist"),
        ("nothing", "the first line of a script begins with #!"),
        (
            '#!/bin/sh\nawk \'BEGIN { print "x_m,y_m,vx_mps,vy_mps"; while (i++ < 15) print "1,2" }\' > $2\n',
            "line 2: vx_mps is missing",
        ),
        (
            "#!/bin/sh\necho x_m,y_m,vx_mps,vy_mps > $2\n",
            "15 rows are expected, one for each query, not 0",
        ),
    ],
)
def test_a_program_that_fails_has_one_clear_line(
    tmp_path: Path, text: str, fault: str
) -> None:
    result = rank(program(tmp_path / "p.sh", text))
    assert result.problem is not None
    assert fault in result.problem
    assert "\n" not in result.problem


@pytest.mark.skipif(sys.platform == "win32", reason="a shell script")
def test_a_program_that_is_not_made_for_a_scenario_takes_no_part(
    tmp_path: Path,
) -> None:
    text = '#!/bin/sh\ngrep -q \'"cv"\' "${1%/*}/problem.json" && exec LAST "$@"\n'
    text = text.replace("LAST", str(program(tmp_path / "last", SHELL)))
    path = program(tmp_path / "cv", text + "echo constant velocity only >&2\nexit 77\n")
    words = ["rank", str(path), "--scenario", "ctrv", "--scenario", "linear"]
    done = CliRunner().invoke(app, [*words, "--runs", "2"])
    assert done.exit_code == 0, done.output
    assert "takes no part: exit code 77: constant velocity only" in done.output
    assert "the present estimate departs" in done.output


@pytest.mark.skipif(sys.platform == "win32", reason="a shell script")
def test_a_program_that_never_ends_is_ended_with_its_children(tmp_path: Path) -> None:
    text = f"#!/bin/sh\nsleep 1000 &\necho $! > {tmp_path}/child\nwait\n"
    words = ["rank", str(program(tmp_path / "never", text)), "--scenario", "linear"]
    done = CliRunner().invoke(app, [*words, "--time-limit", "2"])
    assert done.exit_code != 0
    assert "no result: a run takes more than 2 s" in done.output
    child = int((tmp_path / "child").read_text())
    try:
        state = Path(f"/proc/{child}/stat").read_text().split()[2]
    except OSError:
        state = "gone"
    assert state in ("gone", "Z")


def test_a_method_may_be_in_an_installed_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(tmp_path / "own_methods.py", ADAPTER)
    monkeypatch.syspath_prepend(tmp_path)
    assert method("own_methods:AtArrival").name == "own_methods.AtArrival"
    with pytest.raises(CallError, match="own_methods: has no class or function Other"):
        method("own_methods:Other")
    with pytest.raises(CallError, match="no_module: cannot be imported"):
        method("no_module:Other")


def test_a_class_without_given_is_told_to_take_it() -> None:
    class Bare:
        def update(self, observation: Any) -> None: ...

        def state_at(self, time_s: float) -> None: ...

    problem = rank(Bare).problem
    assert (
        problem == "Bare: define __init__(self, given): too many positional arguments"
    )


def test_a_file_may_hold_dataclasses(tmp_path: Path) -> None:
    head = "from __future__ import annotations\nfrom dataclasses import dataclass\n"
    node = "@dataclass\nclass Node:\n    x: float\n"
    path = written(tmp_path / "own.py", head + node + SORTED + FUSE)
    assert rank(path).deviations[:, 0].max() < EXACT


def test_an_error_of_a_method_has_its_line(tmp_path: Path) -> None:
    text = SHORT.replace("return [1.0]", "return {}['x']")
    result = rank(written(tmp_path / "own.py", text))
    assert result.problem == "own.py, line 5: KeyError: 'x'"
    typed: dict[str, Any] = {"__name__": "no_module"}  # as at a prompt
    exec(text, typed)
    assert rank(typed["One"]).problem == "KeyError: 'x'"


def test_a_file_without_a_method_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CallError, match="define a class with update"):
        method(written(tmp_path / "empty.py", "x = 1\n"))
    with pytest.raises(CallError, match="make a program executable: chmod"):
        method(written(tmp_path / "data.csv", "x\n"))
    for missing in ("./none", "none.py", "none.py:One"):
        with pytest.raises(CallError, match="there is no such file"):
            method(missing)
    with pytest.raises(CallError, match="ekf-replay"):
        method("ekf-repaly")


@pytest.mark.parametrize(
    ("answer", "fault"),
    [
        ([1.0], "a mean must be x, y, vx, vy, shape (4,); its shape is (1,)"),
        ((1.0, 2.0, 3.0, math.nan), "an answer is not finite"),
        ((np.zeros(4), np.eye(3)), "matrix, shape (4, 4); its shape is (3, 3)"),
        ("here", "could not convert string to float"),
        ({"x": 1.0}, "a mean must be x, y, vx, vy"),
    ],
)
def test_a_wrong_answer_is_named(answer: Any, fault: str) -> None:
    class Wrong:
        def __init__(self, given: Any) -> None: ...

        def update(self, observation: Any) -> None: ...

        def state_at(self, time_s: float) -> Any:
            return answer

    result = rank(Wrong)
    assert result.problem is not None
    assert fault in result.problem


def test_a_covariance_that_is_not_positive_definite_is_named() -> None:
    class Negative:
        def __init__(self, given: Any) -> None: ...

        def update(self, observation: Any) -> None: ...

        def state_at(self, time_s: float) -> Any:
            return np.zeros(4), np.diag([1.0, 1.0, 1.0, -1.0])

    result = rank(Negative)
    assert np.isnan(result.nees).all()
    assert "covariances that are not positive definite: 33" in result.sentence


def test_a_pair_may_be_a_list_and_a_mean_a_tuple() -> None:
    class Constant:
        def __init__(self, given: Any) -> None: ...

        def update(self, observation: Any) -> None: ...

        def state_at(self, time_s: float) -> Any:
            return [(1.0, 2.0, 3.0, 4.0), np.eye(4).tolist()]

    assert rank(Constant).problem is None


def answering(answers: Callable[[int], Any]) -> type:
    """Return a class whose answer number k is `answers(k)`."""

    class Answering:
        def __init__(self, given: Any) -> None:
            self.count = 0

        def update(self, observation: Any) -> None: ...

        def state_at(self, time_s: float) -> Any:
            self.count += 1
            return answers(self.count - 1)

    return Answering


def test_a_method_that_answers_nothing_has_no_rank_and_stands_last() -> None:
    none = answering(lambda number: None)
    found = ranked([none, "drop"], ["linear"], num_runs=3)
    records = found._table("linear").records
    assert [record["method"] for record in records] == ["drop", "Answering"]
    assert [record["rank"] for record in records] == [1, None]
    assert "there is no present estimate; there is no" in found.results[0].sentence


def test_missing_answers_are_counted_and_the_others_are_judged() -> None:
    far = answering(lambda number: None if number == 0 else np.zeros(4))
    found = ranked([far, "drop"], ["linear"], num_runs=3)
    result = found.results[0]
    assert isinstance(result, Result)
    count = int(result.answered[0, 1])
    assert f"3 of {count} present estimates are missing; the present" in result.sentence
    last = found._table("linear").records[1]
    assert last["rank"] is None
    assert last["error_m"] > 10.0
    assert last["error_1_m"] > 10.0
    assert last["deviation_0"] > 10.0


class FirstMissing(Shipped):
    """A shipped estimator without an answer to the first query."""

    def answers(self, problem: Problem) -> Answers:
        found = super().answers(problem)
        return replace(found, answers=(None, *found.answers[1:]))


def test_a_single_missing_answer_is_named() -> None:
    (result,) = judge([FirstMissing("ekf-replay")], ["linear"], 1, 1).results
    assert isinstance(result, Result)
    count = int(result.answered[0, 1])
    assert (
        f"linear: 1 of {count} present estimates is missing; the present estimate is exact"
        in result.sentence
    )
    found = Ranking((result,), 1)
    assert "exact in 0 of 1" in found.summary("ekf-replay")
    assert math.isnan(found.deviations().records[0]["linear"])


def test_what_a_function_does_not_fuse_is_not_known(tmp_path: Path) -> None:
    found = ranked([written(tmp_path / "f.py", SORTED + FUSE)], ["linear"], num_runs=2)
    assert found._table("linear").records[0]["refused"] is None
    assert "measurements not fused" not in found.results[0].sentence


def test_intervals_of_errors_are_positive_and_need_three_runs() -> None:
    three = positive(np.array([0.1, 0.1, 2.0]))
    assert 0.0 < three.low < three.mean < three.high
    assert not positive(np.array([0.1, 2.0])).is_known
    assert positive(np.full(4, 0.5)).low == pytest.approx(0.5)
    text = str(ranked(["drop"], ["linear"], num_runs=2))
    assert "(- to -)" not in text
    assert " to " not in text.split("brackets")[0]


def test_a_covariance_is_not_called_wrong_where_the_estimate_is_exact() -> None:
    result = rank("ekf-replay", num_runs=3)
    wrong = replace(result, nees=np.array([9.0, 9.1, 9.2]))
    assert "covariance" not in wrong.sentence
    too_small = replace(wrong, covariance_deviation=0.1)
    assert "its covariance is too small: ANEES 9.1 instead of 4" in too_small.sentence


def test_two_methods_with_one_name_are_refused() -> None:
    with pytest.raises(CallError, match="2 methods are called drop"):
        ranked(["drop", "drop"], ["linear"])


def test_truth_and_exact_estimate_agree_with_the_exact_covariance() -> None:
    nees = []
    for seed in range(8):
        problem = draw("linear", seed)
        for query, answer in zip(problem.queries, problem.exact, strict=True):
            if query.lag_s == 0.0:
                error = answer.mean - problem.truth[query.stamp_ns]
                nees.append(error @ np.linalg.solve(answer.covariance, error))
    assert 2.5 < np.mean(nees) < 6.0


def test_a_problem_is_the_same_for_a_seed_and_keeps_all_arrivals_in_another_order() -> (
    None
):
    one, two = draw("copies", 3), draw("copies", 3)
    assert [each.key for each in one.arrivals] == [each.key for each in two.arrivals]
    other = permuted(one, np.random.default_rng(1))
    assert sorted(each.key for each in other.arrivals) == sorted(
        each.key for each in one.arrivals
    )
    assert len({each.key for each in one.arrivals}) < len(one.arrivals)
    assert {query.lag_s for query in other.queries} == set(LAGS_S)


def test_exported_files_hold_the_exact_states(tmp_path: Path) -> None:
    problem = draw("doppler", 2)
    path = write_problem(tmp_path, problem)
    write_exact(tmp_path, problem)
    found = read_states(tmp_path / "exact.csv", len(problem.queries))
    for answer, exact in zip(found, problem.exact, strict=True):
        assert answer is not None
        assert answer.covariance is not None
        assert exact.covariance is not None
        np.testing.assert_array_equal(answer.mean, exact.mean)
        np.testing.assert_allclose(answer.covariance, exact.covariance, atol=1e-15)
    (prior,) = read_states(tmp_path / "prior.csv", 1)
    assert prior is not None
    np.testing.assert_array_equal(prior.mean, problem.prior.mean)
    lines = path.read_text().splitlines()
    assert sum(line.startswith("query") for line in lines) == len(problem.queries)
    assert json.loads((tmp_path / "problem.json").read_text())["motion"] == "cv"


def test_the_command_prints_tables_and_writes_a_page_for_each_method(
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    words = ["rank", "ekf-replay", "drop", "--scenario", "late-by-10", "--runs", "3"]
    done = CliRunner().invoke(app, [*words, "-o", str(out)])
    assert done.exit_code == 0, done.output
    assert "the present estimate is exact" in done.output
    assert sorted(os.listdir(out)) == [
        "drop.md",
        "ekf-replay.md",
        "ranking.json",
        "ranking.md",
        "ranking.tex",
    ]
    assert "not fused" in (out / "drop.md").read_text()
    for name in ("ranking.md", "ranking.tex"):
        text = (out / name).read_text(encoding="utf-8")
        assert len(re.findall(r"[\d.]+ \([\d.]+ to [\d.]+\)", text)) == 2 * 2


def test_the_page_lists_every_scenario() -> None:
    for name, scenario in SCENARIOS.items():
        assert f"| `{name}` | {scenario.about} |" in PAGE
