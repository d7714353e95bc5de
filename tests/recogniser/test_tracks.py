"""The table of tracks: rows begin and end in all columns at once."""

import numpy as np

from sonarrec.recogniser.tracks import Tracks


def test_rows_begin_and_end_in_all_columns_at_once():
    tracks = Tracks()
    tracks.declare(position=np.array([1.0, 2.0]), pool=list, picture=None)
    tracks.begin(3)
    tracks["position"][1] = 5.0
    for number, pool in zip(tracks["number"], tracks["pool"], strict=True):
        pool.append(number)  # each has its own
    before = tracks[tracks.in_view]
    tracks.keep(tracks["number"] != 1)
    new = tracks.begin(1)
    assert tracks["number"].tolist() == [2, 3, 4]
    assert tracks["position"][new].tolist() == [[1.0, 2.0]]
    assert tracks["position"][0].tolist() == [5.0, 5.0]
    assert tracks["pool"].tolist() == [[2], [3], []]
    assert tracks["picture"].tolist() == [None] * 3
    assert before["number"].tolist() == [1, 2, 3]


def test_numbers_are_not_used_again_after_all_tracks_have_ended():
    tracks = Tracks()
    tracks.begin(2)
    tracks.keep(np.zeros(2, bool))
    assert len(tracks) == 0
    tracks.begin(1)
    assert tracks["number"].tolist() == [3]


def test_remembered_tracks_are_not_in_view():
    tracks = Tracks()
    tracks.begin(3)
    tracks["remembered"][1] = True
    assert tracks["number"][tracks.in_view].tolist() == [1, 3]
