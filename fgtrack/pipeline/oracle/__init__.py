"""The oracle of `fgtrack verify`: motion, measurements and estimates anew, with NumPy and SciPy.

It imports nothing else of fgtrack (import-linter checks it): an equation that is broken there stays whole here.
"""
