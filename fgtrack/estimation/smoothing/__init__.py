"""Sliding windows of states at the stamps of the measurements, smoothed together."""
