"""sonarrec: recognise landmarks in recorded imaging-sonar logs."""

import os
from importlib.metadata import version

# OpenCV reads it when it is loaded: an image file whose header states more than 4096 x 4096 pixels
# is refused, before room is made for it.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**24))
# numpy's BLAS reads it when it is loaded: for products as small as ours more threads take half as
# much processor time again and save none.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = version("sonarrec")
