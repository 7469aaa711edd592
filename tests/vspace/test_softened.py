"""A view as it is shown to people: what nobody has seen is blurred and paler."""

import numpy as np
import pytest

from instant_ic.vspace.view import View


def test_guesses_are_blurred_and_halfway_to_their_grey() -> None:
    """Red, of which 0.30 is grey: (1 + 0.3) / 2 and 0.3 / 2. Noise loses its detail; what was seen stays."""
    confidence = np.ones((96, 160), np.float32)
    confidence[:, :80] = 0
    rgb = np.zeros((96, 160, 3), np.uint8)
    rgb[..., 0] = 255
    shown = View(rgb, np.ones_like(confidence), confidence).softened()
    assert shown[40, 20] == pytest.approx([166, 38, 38], abs=1)
    assert (shown[:, 90:] == rgb[:, 90:]).all()
    noise = np.random.default_rng(0).integers(0, 256, rgb.shape).astype(np.uint8)
    shown = View(noise, np.ones_like(confidence), confidence).softened()
    assert np.abs(np.diff(shown[:, :64].astype(float), axis=1)).mean() < 4  # 85 before
    assert (shown[:, 90:] == noise[:, 90:]).all()


def test_a_view_of_places_that_were_all_seen_stays_as_it_is() -> None:
    rgb = np.zeros((32, 32, 3), np.uint8)
    assert View(rgb, np.ones((32, 32), np.float32), np.ones((32, 32), np.float32)).softened() is rgb
