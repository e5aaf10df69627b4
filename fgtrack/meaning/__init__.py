"""Meaning of a recording's numbers: names give hypotheses, tests decide, assumptions complete the settings."""
