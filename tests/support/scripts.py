"""Scripts of `experiments` and `docs`, as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[2]
EXPERIMENTS = ROOT / "experiments"
LIVE = ROOT / "docs/live"


def load(name: str, script: str | None = None) -> ModuleType:
    """The module of `experiments/NAME/SCRIPT.py`, by default `NAME.py`."""
    return load_file(EXPERIMENTS / name / f"{script or name}.py", "experiment")


def load_file(path: Path, kind: str) -> ModuleType:
    """The module of a script, named after its kind and itself."""
    module_name = f"{kind}_{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module
