"""Figures of runs and sweeps: `fgtrack.plot`. Drawn without pyplot: nothing is global."""
