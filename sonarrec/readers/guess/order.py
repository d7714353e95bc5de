"""Finds in which order the samples of a ping are stored, by how they resemble each other."""

from __future__ import annotations

import math

import cv2
import numpy as np

from sonarrec.arrays import ByteImage


def looks_beam_major(image: ByteImage) -> bool:
    """Whether samples that were taken to be range-major, (bins, beams), are beam-major instead.

    In range-major data the sample `beams` places later is the next range bin of the same beam; in
    beam-major data the sample `bins` places later is the next beam at the same range. Such a sample
    resembles the first one more than the samples around it do. If this decides nothing, as with
    equal numbers of bins and beams, the data are taken to be range-major, as most are.
    """
    bins, beams = image.shape
    samples = image.ravel()
    if bins == beams:
        return False
    by_range, by_beam = _resemblance(samples, beams), _resemblance(samples, bins)
    chance = max(0.03, 4 / math.sqrt(samples.size))  # three sigma of pure noise
    return by_beam < 1 - chance and by_beam < by_range


def _resemblance(samples: np.ndarray, lag: int) -> float:
    """Mean difference of samples `lag` apart, divided by that of samples a little less or more
    apart: small if samples `lag` apart resemble each other."""
    off = max(1, min(8, lag // 3))  # farther than a spot is wide
    at, near, far = (
        float(np.mean(cv2.absdiff(samples[k:], samples[:-k]))) for k in (lag, lag - off, lag + off)
    )
    return 2 * at / (near + far) if near + far else 1.0
