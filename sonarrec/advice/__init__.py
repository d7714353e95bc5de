"""What may be wrong with a log, its geometry, its results and its truth.

Functions of what was read, run or scored; each yields `Advice`. Commands, and `api`, hand them to
the functions that read, run or score, which call them at the end and know nothing of them.
"""
