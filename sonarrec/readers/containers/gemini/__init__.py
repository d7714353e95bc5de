"""Tritech's Gemini sonars: the `.glf` logs of Genesis and of the maker's software kit.

From the inside out: pings.py, what a record means; archive.py, the records in a file, which is a
ZIP; log.py, the file as a RawLog. All numbers are little-endian and packed. The layout is known
from two free readers and a header file by the maker, who has published no description.
"""
