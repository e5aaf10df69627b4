"""
Tutorial 1_compare
==========================

Replay a recording and draw something of one's own.
"""

import fgtrack

print(fgtrack.__version__)
