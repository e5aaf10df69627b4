"""The simulated drives of experiments/mounts."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

_FILE = Path(__file__).resolve().parents[2] / "experiments/mounts/drives.py"


def drives() -> ModuleType:
    """Return the module of the experiment."""
    if "mount_drives" not in sys.modules:
        spec = importlib.util.spec_from_file_location("mount_drives", _FILE)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["mount_drives"] = module
        spec.loader.exec_module(module)
    return sys.modules["mount_drives"]
