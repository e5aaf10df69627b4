"""Scores of a run: errors, consistency, continuity, lagged states, predictions, multi-object metrics."""
