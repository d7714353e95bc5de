"""Many logs in one call: a process for each, what became of them, a cluster."""
