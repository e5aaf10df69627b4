"""Sliding windows of all tracks, solved together by NumPy and LAPACK: no import of gtsam."""
