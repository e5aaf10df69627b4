"""Columns of the arrays of `fgtrack.tracking.decisions.nodes.Nodes`."""

EXISTED, BELIEVED, ALIVE, OWN, HAZARD_HZ, FIRST_X_M, FIRST_Y_M = range(7)
"""Columns of `Nodes.probabilities`."""
NUM_PROBABILITIES = 7

ROOT, HITS, SENSOR, COUNT, MISSES, IS_CONFIRMED, HAS_TRAVELLED, COASTS = range(8)
"""Columns of `Nodes.numbers`."""
NUM_NUMBERS = 8
