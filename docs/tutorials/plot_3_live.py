"""
Tutorial 3_live
==========================

Replay a recording and draw something of one's own.
"""

import fgtrack

print(fgtrack.__version__)
