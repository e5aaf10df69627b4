"""Runs to look at: the HTML report, and files for Foxglove and RViz."""
