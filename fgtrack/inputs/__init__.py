"""Inputs: recordings, streams and data sets are read; streams and bags are written."""
