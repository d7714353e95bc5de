"""Blueprint Subsea's Oculus sonars: pings as the sonar sends them, or in `.oculus` logs.

From the inside out: samples.py, what pings hold (the MCAP messages of the drivers hold the same);
pings.py, what each message means; framing.py, where messages begin and end in a file; log.py, the
file as a RawLog. All numbers are little-endian and packed. The layouts are known from free drivers
and readers; the maker has published no description.
"""
