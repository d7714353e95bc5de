"""The reader of stage 3, adapted to recordings whose truth is known."""
