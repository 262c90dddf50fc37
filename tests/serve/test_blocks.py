"""Blocks of windows over a stream of unknown length."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bathyscope_serve.blocks import Block, cut_blocks


def stream(*shots: int, every: int = 1) -> list[tuple[int, bool, bool]]:
    """Numbered items; each shot's first one is marked, and every n-th of a shot is a key."""
    places = [place for shot in shots for place in range(shot)]
    return [(number, place == 0, place % every == 0) for number, place in enumerate(places)]


def windows(blocks: list[Block[int]]) -> list[tuple[int, ...]]:
    return [tuple(block.items[place] for place in window) for block in blocks for window in block.windows]


def test_where_all_are_keys_windows_are_of_neighbours_and_the_last_is_moved_back_until_it_is_full() -> None:
    assert windows(list(cut_blocks(stream(11), 5, 2))) == [(0, 1, 2, 3, 4), (3, 4, 5, 6, 7), (6, 7, 8, 9, 10)]
    last = list(cut_blocks(stream(9), 5, 2))[-1]
    assert (last.items, last.shared) == ((4, 5, 6, 7, 8), 4)


def test_no_window_spans_a_cut() -> None:
    blocks = list(cut_blocks(stream(6, 1, 2), 5, 2))
    assert windows(blocks) == [(0, 1, 2, 3, 4), (1, 2, 3, 4, 5), (6,), (7, 8)]
    assert [block.shared for block in blocks] == [0, 4, 0, 0]


def test_keys_fill_the_first_window_of_a_block_and_the_frames_between_them_the_others() -> None:
    """Keys every third frame, windows of 5: the second block begins with the last two keys of the first."""
    first, second = list(cut_blocks(stream(22, every=3), 5, 2))[:2]
    assert windows([first]) == [(0, 3, 6, 9, 12), (0, 1, 5, 10, 12), (0, 2, 7, 11, 12), (0, 4, 6, 8, 12)]
    assert second.items == (9, 12, *range(13, 22))
    assert windows([second])[0] == (9, 12, 15, 18, 21)
    assert all(window[0] == 12 and window[-1] == 21 for window in windows([second])[1:])
    assert first.items[first.kept] == 9


def test_the_same_items_in_order() -> None:
    block = next(iter(cut_blocks(stream(13, every=3), 5, 2)))
    assert list(block.in_order(5, 2)) == [(0, 1, 2, 3, 4), (3, 4, 5, 6, 7), (6, 7, 8, 9, 10), (8, 9, 10, 11, 12)]


@given(st.lists(st.integers(1, 60), min_size=1, max_size=4), st.integers(2, 9), st.data())
def test_every_item_is_seen_and_windows_hang_together(shots: list[int], length: int, data: st.DataObject) -> None:
    overlap = data.draw(st.integers(1, length - 1))
    keys = data.draw(st.lists(st.booleans(), min_size=sum(shots), max_size=sum(shots)))
    marked = [(item, begins, key) for (item, begins, _), key in zip(stream(*shots), keys, strict=True)]
    starts = np.cumsum([0, *shots])
    known: set[int] = set()
    fresh: list[int] = []
    for block in cut_blocks(marked, length, overlap):
        shot = int(np.searchsorted(starts, block.items[-1], "right")) - 1
        known = known if block.shared else set()
        assert set(block.items[: block.shared]) <= known
        assert block.shared >= min(overlap, len(known))
        fresh += block.items[block.shared :]
        for number, window in enumerate(windows([block])):
            assert list(window) == sorted(set(window))
            assert starts[shot] <= window[0]
            assert window[-1] < starts[shot + 1]
            assert len(window) == min(length, shots[shot]) or number
            assert len(window) <= length
            assert number == 0 or len(known & set(window)) >= 2
            known |= set(window)
        assert known >= set(block.items)
    assert fresh == list(range(sum(shots)))
