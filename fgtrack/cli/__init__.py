"""The command line: thin modules, one for each kind of command; the only part that prints and exits."""

import gc
import os

# Before numpy is loaded. The matrices here are small: more threads of BLAS only wait for each other, and a sweep has a
# process per core already.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Loading makes half a million objects that stay: to look for cycles after every 700 is a fifth of the start.
gc.set_threshold(100_000)
