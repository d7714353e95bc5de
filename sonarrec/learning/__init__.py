"""The appearance model of stage 3, learned from recordings whose truth is known."""
