"""Stages 1 to 3 over the frames of one log: fan images in, estimates out."""
