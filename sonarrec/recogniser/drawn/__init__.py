"""Drawn plates in place of discs: the same three stages, each in a file of its own.

Stage 1 finds bright figures of a plate's size, stage 2 follows them and fits the plate's pose, and
stage 3 compares the plate's picture, averaged along its track, with every drawing.
"""
