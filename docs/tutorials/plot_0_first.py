"""
A plot of one's own
===================

xx
"""
import fgtrack
print(fgtrack.__version__)
