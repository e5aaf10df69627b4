"""Motion, measurement, sensor and map models: every equation once."""
