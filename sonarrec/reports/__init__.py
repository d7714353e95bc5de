"""A recording and its results as one self-contained HTML page."""
