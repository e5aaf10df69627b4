"""Recordings, streams and data sets in; streams, bags and run folders out."""
