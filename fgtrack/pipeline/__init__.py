"""From a configuration and an input to a run: replay, live tracking and sweeps."""
