"""Scripts of `experiments`, as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def load(name: str, script: str | None = None) -> ModuleType:
    """The module of `experiments/NAME/SCRIPT.py`, by default `NAME.py`."""
    script = script or name
    module_name = f"experiment_{script}"
    spec = importlib.util.spec_from_file_location(module_name, EXPERIMENTS / name / f"{script}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # dataclasses look their module up there
    spec.loader.exec_module(module)
    return module
