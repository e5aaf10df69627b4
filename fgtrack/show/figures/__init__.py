"""Figures of runs and sweeps for `fgtrack.plot`. They do not use pyplot, so there is no global state."""
