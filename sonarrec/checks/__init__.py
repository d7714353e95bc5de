"""`sonarrec check`: the logs of a committed file, against their results on record."""
