"""Kinds of files that hold recordings, and what is read from each."""
