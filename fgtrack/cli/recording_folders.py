"""Several recordings in one command: jobs on cores or on a cluster, and tables over the recordings."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fgtrack.cli.show import progress, say, show
from fgtrack.config.reading import read_config
from fgtrack.config.settings import Config
from fgtrack.core.errors import DataError, FgtrackError
from fgtrack.core.output import check_no_overlap, write_file
from fgtrack.evaluation.tables import Tables
from fgtrack.evaluation.tables.recordings import read_errors, recording_tables
from fgtrack.evaluation.tables.seeds import read_sweep
from fgtrack.meaning.draft import drafted
from fgtrack.pipeline.recording_jobs import has_runs, recordings_plan
from fgtrack.pipeline.scored_sweep import score
from fgtrack.pipeline.sweep import ERROR_TABLE, PRODUCTS, Sweep, Work
from fgtrack.pipeline.sweep_plan import Job

SETTINGS = "settings.yaml"
_TABLES = ("recordings", "over_recordings", "differences_over_recordings")


@dataclass(frozen=True)
class Folder:
    """Recordings of one command, the folder of the results, and the processes."""

    recordings: Mapping[str, Path]
    """Paths of the recordings by the name of their subfolder."""
    out: Path
    jobs: int | None = None
    """Number of processes; None for one for each core."""
    dask: str | None = None
    """Address of a dask scheduler."""
    overwrite: bool = False
    """True repeats finished recordings."""

    def config_file(self, given: str | None) -> str | None:
        """Return the configuration file: `given`, or the settings of an earlier call, or None."""
        earlier = self.out / SETTINGS
        return str(earlier) if given is None and earlier.exists() else given

    def confirmed(self, config: Config, is_given: bool) -> Config:
        """Return the settings of all recordings.

        Without a configuration, they are drafted from the first recording that can be
        read, and written to `settings.yaml`.
        """
        if is_given:
            return config
        for name, path in self.recordings.items():
            try:
                draft = drafted(path, config)
            except FgtrackError:  # the job reports the error
                continue
            if not draft.config.used_sensors:
                continue
            head = f"Settings of all recordings, from {name}: change them and pass this file with -c."
            write_file(self.out / SETTINGS, draft.to_yaml([head]))
            for line in draft.lines():
                say(line)
            say(f"settings of all recordings, from {name}: {self.out / SETTINGS}")
            return read_config(str(self.out / SETTINGS))
        return config

    def run(
        self,
        config: Config,
        estimators: tuple[str, ...],
        work: Work,
        settings: Mapping[str, object],
        page: str,
    ) -> None:
        """Run a job for each recording, print its result and the tables over the recordings.

        `page` is the name of the result in the folder of a recording. Raises `DataError`
        at the end if a recording has an error or an open question.
        """
        for name in (*PRODUCTS, *(f"{table}.csv" for table in _TABLES), SETTINGS):
            check_no_overlap(self.out / name, self.recordings.values())
        plan = recordings_plan(self.recordings, config, estimators, self.out, settings)
        sweep = Sweep.open(plan, self.out, self.overwrite)
        for job in plan.jobs:
            if self.overwrite or not has_runs(job):
                sweep.done.pop(job.key, None)
        say(f"recordings: {len(plan.jobs)}; to do: {len(sweep.todo)}")
        with progress("recordings", len(sweep.todo)) as moved:
            result = sweep.run(
                score, jobs=self.jobs or -1, dask=self.dask, on_job=moved, work=work
            )
        problems = [_problem(sweep, job) for job in plan.jobs]
        for (name, _), problem in zip(self.recordings.items(), problems, strict=True):
            has_failed = problem is not None and problem.startswith(_ERROR)
            line = "no result" if has_failed else str(self.out / name / page)
            say(f"{name}: {line}{'' if problem is None else f' {problem}'}")
        if result.num_good:
            errors = read_errors(self.out / ERROR_TABLE)
            tables = recording_tables(read_sweep(self.out), errors)
            for name, table in tables.items():
                write_file(self.out / f"{name}.csv", table.to_csv())
            show(Tables(tables), None)
            say(f"\nall rows and metrics: {self.out / 'recordings.csv'}")
        failed = sum(problem is not None for problem in problems)
        if failed:
            raise DataError(
                f"{failed} of {len(plan.jobs)} recordings have an error or an open question"
            )


_ERROR = "error: "


def _problem(sweep: Sweep, job: Job) -> str | None:
    """Return the error or the open question of a job; None without either."""
    if job.recipe is None:
        return f"{_ERROR}{job.problem}"
    cells = sweep.done.get(job.key, ())
    errors = [f"{_ERROR}{cell.error}" for cell in cells if cell.error is not None]
    open_lines = [cell.problem for cell in cells if cell.problem is not None]
    return next(iter([*errors, *open_lines]), None)
