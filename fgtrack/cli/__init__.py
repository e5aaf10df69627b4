"""The command line: one small module for each kind of command; only this package prints and exits."""

import gc
import os

# This must be set before NumPy is imported. The matrices are small, so several BLAS threads only wait for each other,
# and a sweep already has a process for each core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Imports create half a million objects that stay. A search for cycles after every 700 takes a fifth of the start.
gc.set_threshold(100_000)
