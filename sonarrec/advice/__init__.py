"""What may be wrong with a log, its geometry, its results and its truth.

Functions of what was read, run or scored; each yields `Advice`. Commands, and `api`, hand them to
the functions that read, run or score, which call them at the end and know nothing of them.

log        of_log, of_run: whether pictures and geometry fit, and what to check if nothing is seen
landmarks  of_landmarks: whether the IDs of a set are hard to distinguish
truth      of_truth, of_positions: what a gt.csv as a whole, and its positions, say of themselves
readings   of_claims: what claims tell of it: rows that mean something else, or that are lacking
results    of_results: all of the last two, of one log that is scored
rows       check_truth: what cannot be true of a gt.csv, row by row
"""
