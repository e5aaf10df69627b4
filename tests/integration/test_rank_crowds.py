"""`fgtrack rank` with several objects: a shipped tracker, a Python class and a program are judged by their tracks."""

import csv
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fgtrack.cli.main import app
from fgtrack.ranking.crowd_files import read_tracks, write_crowd
from fgtrack.ranking.crowd_result import CrowdResult
from fgtrack.ranking.crowds import CROWDS, CrowdProblem, Positions
from fgtrack.ranking.public import method, rank

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "rank.md").read_text(encoding="utf-8")

#: Each detection continues the nearest track within 15 m; no track ends before 3 s.
NEAREST = """
import numpy as np
class Nearest:
    def __init__(self, given):
        self.tracks, self.number = {}, 0
    def update(self, scan):
        for point in scan.points_m:
            near = [(np.hypot(*(point - at)), k) for k, (at, _) in self.tracks.items()]
            distance, track_id = min(near, default=(99.0, 0))
            if distance > 15.0:
                self.number = track_id = self.number + 1
            self.tracks[track_id] = point, scan.stamp_s
    def tracks_at(self, time_s):
        self.tracks = {k: (at, s) for k, (at, s) in self.tracks.items() if s > time_s - 3.0}
        return {k: at for k, (at, s) in self.tracks.items()}
"""
PROGRAM = """#!{python}
import csv, sys
newest, found = [], [("query", "track_id", "x_m", "y_m")]
for row in csv.DictReader(open(sys.argv[1])):
    if row["kind"] == "query":
        found += [(row["query"], k, *point) for k, point in enumerate(newest)]
        newest = []
    elif row["x_m"]:
        newest.append((row["x_m"], row["y_m"]))
csv.writer(open(sys.argv[2], "w")).writerows(found)
"""


def crowd_result(like: object, scenario: str = "oos-mtt") -> CrowdResult:
    (result,) = rank([like], [scenario], num_runs=2).results  # type: ignore[list-item]
    assert isinstance(result, CrowdResult)
    return result


def perfect(problem: CrowdProblem) -> tuple[Positions, ...]:
    return tuple({10 + k: at for k, at in known.items()} for known in problem.truth)


def judged(problem: CrowdProblem, positions: tuple[Positions, ...]) -> CrowdResult:
    return CrowdResult.of("own", problem.scenario, [problem], [positions], 0.0)


@pytest.fixture(scope="module")
def problem() -> CrowdProblem:
    return CROWDS["oos-mtt"].draw("oos-mtt", 1)


def test_true_tracks_have_no_error(problem: CrowdProblem) -> None:
    result = judged(problem, perfect(problem))
    assert np.abs(result.t_gospa_m).max() < 1e-9
    assert result.idf1.tolist() == [1.0]
    assert result.switches.tolist() == [0.0]


def test_exchanged_ids_a_missing_track_and_a_false_track_are_found(
    problem: CrowdProblem,
) -> None:
    half = len(problem.truth) // 2
    exchanged = tuple(
        known if n < half else {k + 100: at for k, at in known.items()}
        for n, known in enumerate(perfect(problem))
    )
    result = judged(problem, exchanged)
    assert result.switches[0] >= 1
    assert result.parts_m2[0, 3] > 0.0
    assert result.idf1[0] < 1.0
    without = tuple(dict(list(known.items())[1:]) for known in perfect(problem))
    assert judged(problem, without).parts_m2[0, 1] > 10.0
    with_false = tuple({**known, 1: np.zeros(2)} for known in perfect(problem))
    assert judged(problem, with_false).parts_m2[0, 2] == pytest.approx(50.0)


def test_a_shipped_tracker_takes_part() -> None:
    result = crowd_result("smoother-banded")
    assert result.idf1.min() > 0.7
    past, now = result.t_gospa_m[:, 1].mean(), result.error.mean()
    assert past < now  # the smoother corrects what it answered 1 s ago
    assert re.search(r"IDF1 0\.\d+; [\d.]+ switches a run", result.sentence)


@pytest.mark.parametrize("scenario", ["race", "dense"])
def test_a_shipped_tracker_keeps_the_identities_of_cars(scenario: str) -> None:
    problem = CROWDS[scenario].draw(scenario, 1)
    first = problem.cut_after(len(problem.scans) // 4)
    found = method("ekf-replay").tracks(first)
    result = CrowdResult.of("ekf-replay", scenario, [first], [found.positions], 0.0)
    assert result.idf1[0] > 0.8
    assert result.switches[0] <= 1


def test_a_class_in_a_python_file_takes_part(tmp_path: Path) -> None:
    path = tmp_path / "nearest.py"
    path.write_text(NEAREST, encoding="utf-8")
    result = crowd_result(path)
    assert result.problem is None
    assert result.parts_m2[:, 2].min() > 10.0  # clutter starts tracks


@pytest.mark.skipif(sys.platform == "win32", reason="an executable script")
def test_a_program_takes_part(tmp_path: Path) -> None:
    path = tmp_path / "newest.py3"
    path.write_text(PROGRAM.format(python=sys.executable), encoding="utf-8")
    path.chmod(0o755)
    result = crowd_result(path)
    assert result.problem is None
    assert result.idf1.max() < 0.5  # detections have no identities


#: The tracks of a query are the detections that are nearest in time in the whole file.
NEAREST_IN_TIME = """#!{python}
import csv, sys
rows = list(csv.DictReader(open(sys.argv[1])))
seen = [row for row in rows if row["x_m"]]
states = csv.writer(open(sys.argv[2], "w"))
states.writerow(("query", "track_id", "x_m", "y_m"))
for query in rows:
    if query["kind"] == "query":
        wanted = float(query["stamp_s"])
        apart = [abs(float(row["stamp_s"]) - wanted) for row in seen]
        nearest = min(apart)
        for k, row in enumerate(seen):
            if apart[k] == nearest:
                states.writerow((query["query"], k, row["x_m"], row["y_m"]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="an executable script")
def test_a_program_that_takes_the_nearest_scan_of_the_file_is_not_causal(
    tmp_path: Path,
) -> None:
    path = tmp_path / "nearest"
    path.write_text(NEAREST_IN_TIME.format(python=sys.executable), encoding="utf-8")
    path.chmod(0o755)
    assert "no result: not causal: the answer for" in crowd_result(path).sentence


def test_a_problem_that_is_cut_off_keeps_its_longest_delay(
    problem: CrowdProblem,
) -> None:
    assert problem.cut_after(2).cut_after(1).max_delay_s == problem.max_delay_s


def test_methods_of_one_object_take_no_part(tmp_path: Path) -> None:
    result = crowd_result(lambda given, observations, queries: [])
    assert result.sentence == "oos-mtt: takes no part: it has no tracks_at"


def test_tracks_of_a_program_are_read_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "states.csv"
    path.write_text("query,track_id,x_m,y_m\n1,7,1.5,2\n", encoding="utf-8")
    empty, known = read_tracks(path, 2)
    assert empty == {}
    assert {k: at.tolist() for k, at in known.items()} == {7: [1.5, 2.0]}
    for rows, fault in (
        ("2,7,1,2\n", "line 2: query 2: there are queries 0 to 1"),
        ("0,7,1,2\n0,7,3,4\n", "line 3: track 7 is twice in query 0"),
        ("0,7,nan,2\n", "line 2: x_m: 'nan' is not a finite number"),
        ("0,1.5,1,2\n", "line 2: track_id: '1.5' is not a whole number"),
    ):
        path.write_text("query,track_id,x_m,y_m\n" + rows, encoding="utf-8")
        with pytest.raises(ValueError, match=re.escape(fault)):
            read_tracks(path, 2)
    path.write_text("0,7,1,2\n", encoding="utf-8")
    with pytest.raises(KeyError, match="query"):
        read_tracks(path, 2)


def test_files_hold_all_scans_and_queries(
    problem: CrowdProblem, tmp_path: Path
) -> None:
    with write_crowd(tmp_path, problem).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    detections = [row for row in rows if row["x_m"]]
    assert len(detections) == sum(len(scan.points_m) for scan in problem.scans)
    assert sum(row["kind"] == "query" for row in rows) == len(problem.queries)
    known = json.loads((tmp_path / "problem.json").read_text(encoding="utf-8"))
    assert known["sensors"]["sensor"]["detection_probability"] == 0.9


def test_the_command_ranks_trackers_and_exports_the_truth(tmp_path: Path) -> None:
    words = ["rank", "drop", "--scenario", "oos-mtt", "--scenario", "late-by-1"]
    words += [
        "--runs",
        "2",
        "-o",
        str(tmp_path / "out"),
        "--export",
        str(tmp_path / "files"),
    ]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    both = (tmp_path / "out/ranking.tex").read_text(encoding="utf-8")
    assert "T-GOSPA" in both
    assert "deviation" in both
    assert "T-GOSPA" in (tmp_path / "out/drop.md").read_text(encoding="utf-8")
    header = (tmp_path / "files/oos-mtt/truth.csv").read_text().splitlines()[0]
    assert header == "query,object_id,x_m,y_m"
    for path in (tmp_path / "files").rglob("*.csv"):
        assert b"\r" not in path.read_bytes()  # awk would read it into the last column


def test_the_page_lists_every_scenario_of_several_objects() -> None:
    for name, crowd in CROWDS.items():
        assert f"| `{name}` | {crowd.about} |" in PAGE
