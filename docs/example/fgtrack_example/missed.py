"""A metric."""

import numpy as np


def missed(scenes, gate_m):
    """Share of the objects in view that have no track nearer than the gate."""
    near = np.zeros_like(scenes.present)
    np.logical_or.at(near, scenes.tick_index, scenes.distances_m < gate_m)
    return {"share": (scenes.in_view & ~near).sum() / max(scenes.in_view.sum(), 1)}
