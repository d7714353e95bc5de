"""Counts per log, their sums over logs, and intervals and tests on them."""
