"""Finds in which order a ping holds its samples, where nobody states it, by their resemblance."""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonarrec.records import ByteImage


def looks_beam_major(image: ByteImage) -> bool:
    """Whether samples that were taken to be range-major, (bins, beams), are beam-major instead.

    In range-major data the sample `beams` on is the next range bin of the same beam, in beam-major
    data the one `bins` on is the next beam at the same range: it resembles the first more than its
    own neighbours there do. Data that decide nothing are range-major, as most are, and so are as
    many bins as beams, where the two are the same sample.
    """
    bins, beams = image.shape
    samples = image.ravel()
    if bins == beams:
        return False
    by_range, by_beam = _resemblance(samples, beams), _resemblance(samples, bins)
    chance = max(0.03, 4 / math.sqrt(samples.size))  # three sigma, where there is only noise
    return by_beam < 1 - chance and by_beam < by_range


def _resemblance(samples: np.ndarray, lag: int) -> float:
    """Mean difference of samples `lag` apart over that of samples a little nearer and farther."""
    off = max(1, min(8, lag // 3))  # farther than a spot is wide
    at, near, far = (
        float(np.mean(cv2.absdiff(samples[k:], samples[:-k]))) for k in (lag, lag - off, lag + off)
    )
    return 2 * at / (near + far) if near + far else 1.0
