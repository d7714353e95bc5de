"""Runs many logs in one call: in parallel processes or on a cluster, with a table of outcomes."""
