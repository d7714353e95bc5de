"""What the studies measured, one TOML file a study, and RESULTS.md, put together from them.

A file holds tables, the command and the commit that made them, and a digest of what the program
then gave on the sample logs. `make results` makes these digests anew, writes them to now.toml, and
marks every table in RESULTS.md whose digest no longer holds: renaming makes nothing stale, a
change of results does. `words` in a file are written by hand and outlive the tables.
"""
