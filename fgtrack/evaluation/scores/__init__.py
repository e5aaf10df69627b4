"""Numbers of a run: its errors, their consistency, continuity, waiting, prediction, and scores over all objects."""
