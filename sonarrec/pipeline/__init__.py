"""One log through the recogniser and onto disk."""
