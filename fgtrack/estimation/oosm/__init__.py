"""Out-of-sequence methods of the literature, each an `Estimator` of one object.

`k` is the newest step, `tau` the stamp of a late measurement, `m` the last step before it; the lag l = k - m is
counted in steps. The methods differ in their estimate of the state at tau; most end in `fuse_across`.
"""
