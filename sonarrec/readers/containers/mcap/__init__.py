"""MCAP recordings: what is in the file, which messages are images or poses, and their fields."""
