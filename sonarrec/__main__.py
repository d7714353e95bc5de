"""The program: `sonarrec`, and `python -m sonarrec`."""

import atexit
import gc
import sys


def main() -> None:
    """Ctrl-C is one line also while the commands are loaded, which takes most of a short call."""
    gc.set_threshold(20_000)  # what is loaded, and frames, leave next to no garbage
    atexit.register(gc.freeze)  # nor need all be searched for it at the end
    try:
        from sonarrec.cli import main as program

        program()
    except KeyboardInterrupt:
        sys.stderr.write("sonarrec: stopped\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
