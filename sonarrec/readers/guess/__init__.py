"""What is found out about a recording where nobody states it."""
