"""Stage 3: which landmark is it? The published measurement, and the appearance along the track."""
