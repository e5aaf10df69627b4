"""Presentation of runs: figures, the HTML report, and files for Foxglove, RViz and maps."""
