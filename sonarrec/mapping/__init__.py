"""Where the landmarks lie: passes of one landmark joined, and placed on the floor."""
