"""Study of a recording in one call: advice, three estimators on the same data, comparison, figures and a report."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from fgtrack.advice.advise import Adviser
from fgtrack.advice.ledger import SUMMARY_S, summary
from fgtrack.advice.page import Advice
from fgtrack.advice.paired_replay import REPLAY, PairedReplay
from fgtrack.config.reading import ConfigLike, read_config
from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import validate
from fgtrack.core.errors import DataError
from fgtrack.core.output import (
    check_no_overlap,
    check_output,
    locked_folder,
    new_files,
    write_file,
)
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Message
from fgtrack.evaluation.diagnostics import USED, diagnostics, lifetimes_and_breaks
from fgtrack.evaluation.runs import EvaluatedRun, evaluated
from fgtrack.evaluation.tables import Tables, short
from fgtrack.evaluation.tables.compare import compare
from fgtrack.inputs.errors import UntilBreak
from fgtrack.meaning.assumption import Assumed
from fgtrack.meaning.draft import drafted
from fgtrack.noise.measurements import MeasurementRecorder
from fgtrack.pipeline.recording_jobs import scored
from fgtrack.pipeline.replay import replay
from fgtrack.pipeline.sweep import Cell, Score, failure
from fgtrack.pipeline.sweep_plan import Recipe
from fgtrack.runs import Run, check_run, load_run, write_metrics
from fgtrack.show.figures.close_up import CloseUp
from fgtrack.show.figures.late_detection import drawn_close_up
from fgtrack.show.figures.plot import drawn, planned
from fgtrack.show.figures.style import png
from fgtrack.show.report import ReportHead, write_report

__all__ = ["ESTIMATORS", "Study", "study"]

_PERCENT = 100.0
_MS = 1e3
# A finding of this weight without a setting must be corrected first.
_IMPORTANT = 60.0


def _recording(one: EvaluatedRun) -> str:
    updates = one.run.tables["updates"]
    now_ns = one.run.tables["timing"]["now_ns"]
    length_s = (int(now_ns[-1]) - int(now_ns[0])) / NS_PER_S if len(now_ns) else 0.0
    sensors = []
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = updates["sensor"] == sensor
        delays_s = (updates["receipt_ns"][mine] - updates["stamp_ns"][mine]) / NS_PER_S
        median_ms = _MS * float(np.median(delays_s))
        most_ms = _MS * float(delays_s.max())
        sensors.append(
            f"{sensor} ({len(delays_s)} detections, median delay {median_ms:.0f} ms, largest {most_ms:.0f} ms)"
        )
    late = _percent(np.isin(updates["disposition"], ("out_of_sequence",)))
    used = _percent(np.isin(updates["disposition"], USED))
    shares = f"{late} arrived after newer detections had been fused, {used} were used"
    return f"In {length_s:.0f} s detections came from {' and '.join(sensors) or 'no sensor'}; {shares}."


def _tracks(one: EvaluatedRun) -> str:
    truth = one.metrics.truth
    if truth is not None:
        overall = truth.overall
        share = _PERCENT * overall.tracked_share_in_view
        return (
            f"{one.label} tracks the objects for {share:.1f} % of their time in view: "
            f"{_several(overall.breaks, 'break')}, {_several(overall.id_switches, 'identity switch', 'es')}, "
            f"{_several(truth.false_tracks, 'false track')}."
        )
    lives_s, _ = lifetimes_and_breaks(one.run)
    lives = (
        f", half of them for {np.median(lives_s):.1f} s or longer"
        if len(lives_s)
        else ""
    )
    return f"{one.label} confirms {_several(len(lives_s), 'track')}{lives}."


def _to_do(first: EvaluatedRun, tables: Tables, advice: Advice | None) -> str:
    """Return the first recommendation of a study.

    A problem of the recording or its settings comes first, else the fastest of the most
    accurate estimators.
    """
    findings = () if advice is None else advice.findings
    found = [
        str(item)
        for item in findings
        if not item.settings and item.weight >= _IMPORTANT
    ]
    if found := found or [str(item) for item in diagnostics(first.run)]:
        return f"First: {found[0]}"
    ranked = [
        row
        for row in tables.tables["differences"].records
        if row["quantity"] == "position_rmse_m"
    ]
    best = {row["run"] for row in ranked if row["standing"] != "worse"}
    times = {
        row["run"]: row["time_per_tick_p50_s"]
        for row in tables.tables["tracking"].records
    }
    fastest = min(best or times, key=lambda run: (times[run], run))
    reason = "as accurate as the best" if best else "errors are unknown without truth"
    return f"Use {fastest} for the present state ({short(_MS * times[fastest])} ms per tick, {reason})."


def _percent(mask: Any) -> str:  # Any: an array of bool
    return f"{_PERCENT * float(np.mean(mask)):.0f} %" if len(mask) else "none"


def _several(count: int, what: str, ending: str = "s") -> str:
    return f"{count or 'no'} {what}{'' if count == 1 else ending}"


def study_job(key: str, recipe: Recipe, score: Score) -> tuple[str, tuple[Cell, ...]]:
    """Study the recording of `recipe` in its folder, and return `key` and a cell for each estimator.

    An exception becomes the error of a cell. The settings of the recipe are not
    changed by advice, so they are the same for all recordings.
    """
    try:
        found = study(
            recipe["recording"],
            recipe["folder"],
            validate(Config, recipe["config"], "config"),
            advice=False,
            overwrite=True,
        )
        cells = tuple(scored(run, score) for run in found.runs)
    except (Exception, SystemExit) as error:  # one failed study must not end the others
        return key, tuple(Cell(name, {}, {}, failure(error)) for name in ESTIMATORS)
    return key, tuple(replace(cell, problem=found.problem) for cell in cells)


ESTIMATORS = ("smoother", REPLAY, "ekf-backward-forward")
"""Estimators of a study."""
#: Finished share of the work at the start of each step.
_ADVICE = 0.02
_REPLAY = 0.3
_COMPARE = 0.85
_DRAW = 0.9
_DONE = 1.0
# Number of messages between two progress reports.
_MESSAGES = 1000
OnStep = Callable[[str, float], None]


@dataclass(frozen=True)
class Study:
    """Result of a study; `str` shows its summary, its assumptions and the paths of its files."""

    path: Path
    """Folder of `report.html`, `settings.yaml`, `runs/` and `figures/`."""
    summary: tuple[str, ...]
    """About five sentences: the recording, the tracks, the best estimator, the noise, a recommendation."""
    assumptions: tuple[str, ...] = field(repr=False)
    """Decisions and assumptions with their certainty and reasons; open questions come first."""
    advice: Advice | None = field(repr=False)
    """The advice; None if it was not requested, or nothing could be assessed."""
    runs: tuple[Run, ...] = field(repr=False)
    """Run of each estimator."""
    tables: Tables = field(repr=False)
    """Comparison of the runs."""
    broken: str | None
    """Reason why the recording could be read only in part, or None."""
    problem: str | None = None
    """Line on the questions that must be answered before all sensors are used, or None."""
    questions: tuple[str, ...] = field(default=(), repr=False)
    """Questions that the recording does not answer, a line each with the key to set."""

    @property
    def report(self) -> Path:
        """Path of the report, an HTML page."""
        return self.path / "report.html"

    @property
    def settings(self) -> Path:
        """Path of the configuration of the runs, with all assumptions and their reasons; edit it for another study."""
        return self.path / "settings.yaml"

    def __str__(self) -> str:
        lines = [*self.summary, *self.assumptions]
        return "\n".join(
            [*lines, f"settings: {self.settings}", f"report: {self.report}"]
        )


def study(
    recording: str | Path,
    out: str | Path,
    config: ConfigLike | None = None,
    *,
    map: str | Path | None = None,  # noqa: A002 - the name of the option
    pit_map: str | Path | None = None,
    set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    advice: bool = True,
    figures: Mapping[str, Figure] | None = None,
    overwrite: bool = False,
    on_step: OnStep = lambda text, share: None,
) -> Study:
    """Study a recording: advise, replay with three estimators, compare, draw and report into the folder `out`.

    `config`, `map`, `pit_map` and `set` are as in `fgtrack.replay`. With `advice`, the
    settings of `fgtrack.advise` are adopted. `figures` are additional figures by name.
    `overwrite` replaces a study in `out`. `on_step` is called with the name of each
    step and the finished share of the work.

    A recording without a configuration is drafted as by `fgtrack.draft`. A sensor whose
    question stays open is left out of the runs; `study.problem` names it.

    Raises `CallError` for an invalid configuration or `out`. Raises `DataError` if the
    recording cannot be read, or contains nothing to track.
    """
    out = Path(out)
    source_path = Path(recording)
    resolved = read_config(config, set, track_map=map, pit_map=pit_map)
    *runs, pictures, settings, page = outputs(out)
    folders = dict(zip(ESTIMATORS, runs, strict=True))
    config_file = str(config) if isinstance(config, (str, Path)) else None
    for path in outputs(out):
        check_no_overlap(path, [source_path, config_file])
    with locked_folder(out):
        for folder in folders.values():
            check_run(folder, overwrite)
        check_output(pictures, overwrite, Path.is_dir, "a folder")
        check_output(settings, overwrite)
        check_output(page, overwrite)
        on_step("reading", 0.0)
        draft = drafted(source_path, resolved)
        readable = UntilBreak(draft.source.messages())
        messages = list(readable)
        advised: Advice | None = None
        adviser = Adviser(
            str(source_path),
            messages,
            Assumed(draft.config),
            on_step=lambda text, share: on_step(
                f"advice, {text}", _ADVICE + (_REPLAY - _ADVICE) * share
            ),
            decisions=draft.decisions,
        )
        with suppress(DataError):  # the runs report the same problem
            advised = adviser.advice() if advice else None
        if advised is not None:  # settings from the advice are no assumptions
            changed = {one.key for one in advised.changes}
            kept = [one for one in draft.assumed.assumptions if one.key not in changed]
            draft = draft.with_assumed(Assumed(advised.config, tuple(kept)))
        head = [
            f"Settings of {source_path.name} (fgtrack study): change them and pass this file with -c."
        ]
        comments = [] if advised is None else advised.comments()
        write_file(settings, draft.to_yaml([*head, *comments]), overwrite)

        taken = count()

        def repeated() -> Iterator[Message]:
            for message in messages:
                if (number := next(taken)) % _MESSAGES == 0:
                    done = number / len(messages)
                    share = _REPLAY + (_COMPARE - _REPLAY) * done / len(ESTIMATORS)
                    on_step(f"replay, {ESTIMATORS[int(done)]}", share)
                yield message
            readable.raise_error()

        recorder = MeasurementRecorder(replace(draft.config, estimator=REPLAY))
        replay(
            repeated,
            draft.config,
            folders,
            origin=str(source_path),
            kind=draft.source.kind,
            overwrite=overwrite,
            observed={REPLAY: recorder},
        )
        on_step("compare", _COMPARE)
        every = evaluated([load_run(folder) for folder in folders.values()])
        tables = compare(*every)
        for folder, one in zip(runs, every, strict=True):
            write_metrics(folder, one.metrics.as_dict())
        with suppress(DataError):  # without a track there is no ledger
            replays = PairedReplay(
                recorder.bank,
                every[ESTIMATORS.index(REPLAY)].run,
                draft.config,
                SUMMARY_S,
            )
            tables = replace(
                tables, tables={**tables.tables, "ledger": summary(replays)}
            )
        lines = (
            _recording(every[0]),
            _tracks(every[0]),
            *tables.verdict,
            _to_do(every[0], tables, advised),
        )
        on_step("draw", _DRAW)
        close_up, late = drawn_close_up(every)
        # Figures of a single run are drawn for the first run only.
        others = tuple(f"_{one.label}" for one in every[1:])
        plans = (one for one in planned(every) if not one.name.endswith(others))
        images = [
            (name, png(one))
            for name, one in chain(close_up, drawn(plans), (figures or {}).items())
        ]
        with new_files(pictures, overwrite) as into:
            for name, image in images:
                (into / f"{name}.png").write_bytes(image)
        head_advice = () if advised is None else advised.sentences
        report_head = replace(
            head_at(late),
            sentences=lines,
            assumptions=draft.lines(),
            advice=head_advice,
        )
        write_report(every, tables, images, page, report_head, overwrite)
        on_step("done", _DONE)
    result = tuple(one.run for one in every)
    return Study(
        out,
        lines,
        tuple(draft.lines()),
        advised,
        result,
        tables,
        result[0].meta["broken_off"],
        draft.problem,
        draft.questions,
    )


def outputs(out: Path) -> list[Path]:
    """Return the paths that a study in `out` writes: runs, figures, settings, report."""
    names = (
        *(f"runs/{each}" for each in ESTIMATORS),
        "figures",
        "settings.yaml",
        "report.html",
    )
    return [out / name for name in names]


def head_at(late: CloseUp | DataError) -> ReportHead:
    """Return the head of a report that opens at a late detection, or gives the reason why it cannot."""
    if isinstance(late, DataError):
        return ReportHead(missing=(f"no close-up: {late}",))
    x_m, y_m = late.after.means[-1, :2].tolist()
    return ReportHead(moment=(late.now_ns, x_m, y_m))
