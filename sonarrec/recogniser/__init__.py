"""Stages 1 to 3 over the frames of one log: frames in, estimates out."""

import cv2

# Intel's routines in OpenCV round differently from its own, and differently on each processor.
cv2.ipp.setUseIPP(False)
