"""What a program calls in place of `sonarrec run` and `sonarrec evaluate`."""
