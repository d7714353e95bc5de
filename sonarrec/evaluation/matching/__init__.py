"""Which truth goes with which results, and which claim lies on which landmark."""
