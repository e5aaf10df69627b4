"""Runs to look at: figures, the HTML report, and files for Foxglove, RViz and maps."""
