"""Estimates scored against ground truth."""
