"""The operator's picture: what goes with a rendered view to the page, and which view is asked for when."""

import cv2
import numpy as np

from instant_ic.vspace.view import View


def seen(confidence):
    confidence = np.asarray(confidence, np.float32)
    return View(np.zeros((*confidence.shape, 3), np.uint8), np.ones_like(confidence), confidence)


def test_the_mask_of_a_view_is_its_confidence_averaged_over_areas():
    confidence = np.ones((90, 128), np.float32)
    confidence[:, :64] = 0.0
    confidence[:2, 64:66] = 0.5  # one pixel of the mask
    mask = cv2.imdecode(np.frombuffer(seen(confidence).mask_png(width=64), np.uint8), cv2.IMREAD_UNCHANGED)
    assert mask.shape == (45, 64)
    assert (mask[:, :32] == 0).all()
    assert mask[0, 32] == 128  # 0.5 of 255, rounded to even
    assert (mask[1:, 32:] == 255).all()


def test_a_view_of_places_that_were_all_seen_has_no_mask():
    assert seen(np.ones((32, 32))).mask_png() == b""
    assert seen(np.full((32, 32), 0.99)).mask_png() != b""
