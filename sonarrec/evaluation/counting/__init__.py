"""What is counted of each log, added up over logs, and how sure it is."""
