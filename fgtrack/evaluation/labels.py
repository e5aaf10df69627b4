"""Names under which several runs are shown together."""

from collections import Counter
from collections.abc import Sequence

from fgtrack.core.errors import CallError
from fgtrack.io.run import Run


def labelled(runs: Sequence[Run]) -> dict[str, Run]:
    """Runs by a label of their own: the end of their path, as long as it must be to tell them apart.

    The estimator stands behind it where the path does not name it.

    Raises
    ------
    CallError
        The same run is given twice.
    """
    paths = [run.path.resolve() for run in runs]
    for path, count in Counter(paths).items():
        if count > 1:
            raise CallError(f"{path}: is given twice, name every run once")
    length = 1
    while len({path.parts[-length:] for path in paths}) < len(paths):
        length += 1
    labels = {}
    for run, path in zip(runs, paths, strict=True):
        estimator = str(run.meta.get("estimator", ""))
        label = "/".join(path.parts[-length:])
        labels[label if estimator in label else f"{label} ({estimator})"] = run
    return labels
