"""Public function of the ranking: methods by name, path or class."""

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from fgtrack.core.errors import CallError
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.ranking.judge import judge
from fgtrack.ranking.methods import TIME_LIMIT_S, Method, Program, Shipped
from fgtrack.ranking.python_file import PythonMethod, python_file, python_module
from fgtrack.ranking.result import Ranking
from fgtrack.ranking.scenarios import SCENARIOS

__all__ = ["Ranking", "rank"]

MethodLike = str | Path | Callable[..., Any]
"""Name of an estimator, path of a Python file or of a program, `MODULE:NAME`, class, or function."""


def rank(
    methods: Sequence[MethodLike],
    scenarios: Iterable[str] = tuple(SCENARIOS),
    *,
    num_runs: int = 10,
    seed: int = 1,
    time_limit_s: float = TIME_LIMIT_S,
) -> Ranking:
    """Return the results of all `methods` in all `scenarios`, with the same measurements for all.

    A method is the name of an estimator, the path of a Python file or of a program, a
    class with `update` and `state_at`, or a function `fuse`. A method that fails in a
    scenario has a result with the reason. A run of a program ends after `time_limit_s`.

    Raises `CallError` for an unknown method or scenario.
    """
    return judge(
        [method(each, time_limit_s) for each in methods], scenarios, num_runs, seed
    )


def method(like: MethodLike, time_limit_s: float = TIME_LIMIT_S) -> Method:
    """Return the method that `like` describes.

    `FILE.py:NAME` is a class or a function of a Python file, `MODULE:NAME` of an installed
    module. Raises `CallError` for anything else.
    """
    if not isinstance(like, str | Path):
        return PythonMethod(getattr(like, "__name__", "method"), like)
    text = str(like)
    file, _, name = text.rpartition(":")
    if file.endswith(".py") and Path(file).is_file():
        return python_file(Path(file), name)
    path = Path(text)
    if path.suffix == ".py" and path.is_file():
        return python_file(path)
    if path.is_file() and os.access(path, os.X_OK):
        return Program(path, time_limit_s)
    if path.is_file():
        raise CallError(
            f"{text}: is neither a Python file nor an executable program; "
            f"make a program executable: chmod +x {text}"
        )
    if path.suffix == ".py" or file.endswith(".py") or os.sep in text:
        raise CallError(f"{text}: there is no such file")
    if file:
        return python_module(file, name)
    return Shipped(ESTIMATORS.resolve(text))
