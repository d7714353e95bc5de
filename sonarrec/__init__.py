"""sonarrec: recognise landmarks in recorded imaging-sonar logs."""

from importlib.metadata import version

__version__ = version("sonarrec")
