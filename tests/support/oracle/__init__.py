"""The oracle: motion, measurements and estimates once more, with NumPy and SciPy.

It imports nothing of fgtrack: an equation that is broken there stays whole here.
"""
