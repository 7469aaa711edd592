"""Selections of panoramas from collections."""

import numpy as np

from instant_ic.training.dataset import Sample, Selection


def test_panoramas_of_collections_come_in_the_order_of_the_selection() -> None:
    first, second = (
        [Sample(np.zeros((1, 2, 3), np.uint8), np.ones((1, 2), np.float32), world + i) for i in range(4)]
        for world in (100, 200)
    )
    selection = Selection((first, np.array([3, 1])), (second, range(2)))
    assert [selection[i].world for i in range(len(selection))] == [103, 101, 200, 201]
    assert len(Selection()) == 0
