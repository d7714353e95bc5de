"""What is drawn at random shows what it says."""

import numpy as np

from tests.studies.learning.examples import MOST_IDS, UNKNOWN, joined_examples
from tests.studies.learning.random_pictures import draw


def test_a_drawn_symbol_is_bright_where_it_is_said_to_be_lit() -> None:
    """Not in every picture, for silt and shadows lie over some; in nine of ten of those in which
    both are seen. Turned by a quarter, a symbol of one sector would be so in far fewer."""
    rng = np.random.default_rng(3)
    drawn = joined_examples([draw(rng) for _ in range(150)])
    symbol = drawn.brightness[:, :3].astype(float).mean(axis=1)
    known = (drawn.label < MOST_IDS) & (drawn.lit[:, 0] != UNKNOWN)
    assert known.sum() > 40
    steps = [
        symbol[n][drawn.lit[n] == 1].mean() - symbol[n][drawn.lit[n] == 0].mean()
        for n in np.flatnonzero(known)
    ]
    assert np.mean(np.array(steps) > 0) > 0.9
    for n in np.flatnonzero(known):  # it is the code of its ID, at some rotation, but for edges
        code = drawn.codes[n, drawn.label[n]].astype(int)
        turned = [np.abs(np.roll(code, step) - drawn.lit[n]).sum() for step in range(36)]
        assert min(turned) <= 12
