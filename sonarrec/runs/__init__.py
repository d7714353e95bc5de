"""Logs through the recogniser and onto disk: one, or many at once. All parallelism is here."""
