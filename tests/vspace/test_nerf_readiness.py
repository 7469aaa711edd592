"""Expected PSNR of a view against its causes, by hand, and against the measured one."""

import dataclasses
import math

import numpy as np
import pytest

from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.nerf.field import Rays
from instant_ic.vspace.prior import prepare
from instant_ic.vspace.readiness import Texture, error_terms, expected_psnr_db
from tests import box_room

WARP = VirtualSpaceConfig(source="warp", device="cpu")


def wave(periods, height=128):
    azimuth = np.linspace(0, 2 * np.pi, 2 * height, endpoint=False)
    row = 127 + 100 * np.cos(periods * azimuth)
    return np.repeat(np.repeat(row[None, :, None], height, 0), 3, 2).astype(np.uint8)


def test_the_cost_of_a_shift_by_hand():
    # Colours 0.5 + A cos(k φ), turned by δ: the mean squared difference is A² (1 − cos(k δ)); variance A² / 2.
    texture, amplitude = Texture.of(wave(8)), 100 / 255
    for shift in (math.pi / 64, math.pi / 16):
        expected = amplitude**2 * (1 - math.cos(8 * shift))
        assert texture.cost(np.array([shift]))[0] == pytest.approx(expected, rel=0.03)
    assert texture.cost(np.zeros(1))[0] == 0
    assert texture.variance == pytest.approx(amplitude**2 / 2, rel=0.03)


def straight_ahead(x):
    return Rays(np.array([x, 0, 0], np.float32), np.array([[1, 0, 0]], np.float32), np.ones(1, np.float32), (1, 1))


def test_the_terms_by_hand():
    # The keyframe stands at the origin, everything at 4 m, sigma 0.1.
    prior = prepare(wave(8), np.full((64, 128), 4.0, np.float32), np.eye(4), 0.1, GeometryConfig(), 2048)
    texture = Texture.of(prior.rgb)
    ahead = np.array([3.0], np.float32), np.ones(1, np.float32)
    # Straight on nothing moves aside.
    assert error_terms(prior, texture, straight_ahead(1.0), *ahead) == (0, 0)
    # From 4 m aside of the surface, at a right angle to the keyframe's ray, it moves by sigma: 0.1 · 4 m seen from 4 m.
    aside = Rays(np.array([4, -4, 0], np.float32), np.array([[0, 1, 0]], np.float32), np.ones(1, np.float32), (1, 1))
    shift, unseen = error_terms(prior, texture, aside, np.array([4.0], np.float32), np.ones(1, np.float32))
    assert shift == pytest.approx(texture.cost(np.array([0.1]))[0], rel=1e-3)
    assert unseen == 0
    # A pixel's own sigma counts: 0.3 in the direction of (4, 0, 0), the image's centre.
    sigma = prior.sigma.copy()
    sigma[30:34, 62:66] = 0.3
    unsure = dataclasses.replace(prior, sigma=sigma)
    shift, _ = error_terms(unsure, texture, aside, np.array([4.0], np.float32), np.ones(1, np.float32))
    assert shift == pytest.approx(texture.cost(np.array([0.3]))[0], rel=1e-3)
    assert error_terms(prior, texture, aside, np.zeros(1, np.float32), np.zeros(1, np.float32)) == pytest.approx(
        (0, texture.variance)
    )


def test_what_the_field_draws_has_its_own_error():
    terms = (0.0, 0.0)
    alone = expected_psnr_db(terms, 20.0, 0.0)  # 20 dB are 0.01, to which the page adds 0.0006
    assert alone == pytest.approx(19.75, abs=0.05)
    assert alone < expected_psnr_db(terms, 20.0, 0.5) < expected_psnr_db(terms, math.nan, 1.0)


def test_expectation_follows_the_measured_psnr():
    camera = pose_matrix(x=-0.5, y=-0.3)
    picture = box_room.panorama(camera, 192)
    measured, expected = [], []
    wavy = 1 + np.sin(np.arange(384) * (2 * np.pi / 77))[None] * np.sin(np.arange(192) * (2 * np.pi / 60))[:, None]
    for sigma in (0.01, 0.1):
        space = VirtualSpace(WARP)
        space.set_keyframe(picture.rgb, picture.depth_m * (1 + 2 * sigma * (wavy - 1)), camera, sigma)
        for x, y, yaw in ((0.3, 0, 0), (0.9, 0.2, 0.8), (2.0, -0.8, 1.2)):
            pose = camera @ pose_matrix(x, y, yaw=yaw)
            view, truth = space.render(pose, 96, 54, 1.5), box_room.perspective(pose, 96, 54, 1.5)
            measured.append(-10 * math.log10(np.mean((view.rgb.astype(float) - truth.rgb) ** 2) / 255**2))
            expected.append(view.expected_psnr_db)
    assert np.corrcoef(measured, expected)[0, 1] > 0.8
    assert np.abs(np.array(measured) - expected).mean() < 4
