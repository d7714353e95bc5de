"""Many logs in one call: processes side by side, what became of each, a cluster."""
