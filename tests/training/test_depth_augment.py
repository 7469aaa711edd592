"""What augmentation does to pictures, and that it leaves picture and depth together."""

import cv2
import numpy as np
import pytest
import torch

from instant_ic.training.augment import (
    camera_colours,
    floor_reflection,
    jpeg,
    photograph,
    robot_body,
    to_brightness,
    turn_and_mirror,
    vignetting,
    without_lidar,
)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_turn_and_mirror_keep_picture_and_depth_together() -> None:
    depth = torch.arange(32.0).repeat(6, 4, 1)
    rgb = depth[:, None].repeat(1, 3, 1, 1)
    turned, distance = turn_and_mirror(seeded(), rgb, depth)
    assert torch.equal(turned[:, 0], distance)
    steps = torch.remainder(distance.diff(dim=-1), 32)
    assert set(steps.unique().tolist()) == {1.0, 31.0}  # some turned, some mirrored too
    assert all(sorted(row.tolist()) == list(range(32)) for row in distance[:, 0])


def test_photographs_stay_in_range_differ_and_repeat() -> None:
    rgb, depth = torch.full((8, 3, 32, 64), 0.5), torch.full((8, 32, 64), 2.0)
    got = photograph(rgb, depth, seeded())
    assert got.shape == rgb.shape and got.min() >= 0 and got.max() <= 1
    assert got.mean(dim=(1, 2, 3)).std() > 0.02
    assert torch.equal(got, photograph(rgb, depth, seeded()))
    assert not torch.equal(got, photograph(rgb, depth, seeded(1)))


def test_camera_colours_over_and_under_expose() -> None:
    means = camera_colours(torch.full((32, 3, 8, 8), 0.5), seeded()).mean(dim=(1, 2, 3))
    assert means.min() < 0.35 and means.max() > 0.65


def test_brightness_by_hand() -> None:
    rgb = torch.tensor([0.2, 0.4]).view(2, 1, 1, 1).expand(2, 3, 4, 8)
    got = to_brightness(rgb, 102.0)  # a mean of 0.4: twice as bright, and as it is
    assert torch.allclose(got, torch.tensor(0.4))
    assert torch.allclose(to_brightness(rgb, 255.0)[0], torch.tensor(0.5))  # 2.5 times is the most
    assert torch.equal(to_brightness(rgb, 0.0), rgb)


def test_vignetting_darkens_the_seam_of_the_lenses() -> None:
    rows = vignetting(torch.ones(16, 3, 32, 64), seeded())[:, 0, 15]
    assert torch.allclose(rows.max(dim=1).values, torch.ones(16), atol=1e-3)
    assert (rows.min(dim=1).values < 0.92).all()
    assert torch.allclose(rows, rows.roll(32, -1), atol=1e-5)  # both lenses alike


def test_robot_is_dark_and_only_below() -> None:
    got = robot_body(torch.ones(16, 3, 64, 128), seeded())
    assert torch.equal(got[:, :, :32], torch.ones(16, 3, 32, 128))
    assert (got[:, :, -1].mean(dim=(1, 2)) < 0.5).all()


def test_floor_shows_what_is_above_it_and_walls_do_not() -> None:
    height = 64
    elevation = np.pi / 2 - (np.arange(height) + 0.5) * np.pi / height
    floor_m = np.where(elevation < 0, 1.0 / np.maximum(-np.sin(elevation), 1e-3), np.inf)  # camera 1 m high
    wall_m = 3.0 / np.cos(elevation)
    depth = torch.from_numpy(np.minimum(floor_m, wall_m)).float()[None, :, None].expand(2, height, 2 * height)
    rgb = torch.zeros(2, 3, height, 2 * height)
    rgb[:, :, : height // 2] = 1.0  # white above, black below
    got = floor_reflection(rgb, depth, seeded())
    changed = (got != rgb).any(dim=(0, 1, 3)).numpy()
    is_floor = floor_m < 0.97 * wall_m
    assert changed[is_floor & (elevation > -1.2)].all()
    assert not changed[elevation > -0.25].any()  # the wall, down to the skirting at -18°


def test_jpeg_matches_a_real_one() -> None:
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (64, 128, 3), np.uint8), (0, 0), 3)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    flags = [cv2.IMWRITE_JPEG_QUALITY, 40, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    real = cv2.imdecode(cv2.imencode(".jpg", picture[..., ::-1], flags)[1], cv2.IMREAD_COLOR)[..., ::-1].astype(float)
    rgb = torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255
    got = jpeg(rgb, seeded(), (40.0, 40.0))[0].permute(1, 2, 0).numpy() * 255
    # Same kind and size of damage: nearer to the real one than that is to the picture. Its colour table is another.
    assert 0.5 < np.abs(got - picture).mean() / np.abs(real - picture).mean() < 2
    luma = np.array([0.299, 0.587, 0.114])
    assert np.abs((got - real) @ luma).mean() < 0.35 * np.abs((real - picture) @ luma).mean()


def test_jpeg_of_the_best_quality_is_nearly_the_picture() -> None:
    rgb = torch.rand(2, 3, 16, 32, generator=seeded())
    assert (jpeg(rgb, seeded(), (100.0, 100.0)) - rgb).abs().max() == pytest.approx(0, abs=0.03)


def test_a_prior_without_lidar_by_hand() -> None:
    prior = torch.zeros(1, 6, 1, 3)
    prior[0, :, 0] = torch.tensor([[2.0, 3.0, 0.0], [0.01, 0.1, 0.0], [1, 0, 0], [7, 8, 9], [4, 5, 6], [2.5, 0, 1.5]])
    alone = without_lidar(prior, 1.0, seeded())[0, :, 0]
    expected = torch.tensor([[2.5, 0.0, 1.5], [0.3, 0.0, 0.3], [0, 0, 0], [7, 8, 9], [4, 5, 6], [2.5, 0, 1.5]])
    assert torch.equal(alone, expected)
    assert torch.equal(without_lidar(prior, 0.0, seeded()), prior)
    many = without_lidar(prior.repeat(400, 1, 1, 1), 0.2, seeded())
    assert 50 < int((many[:, 2, 0, 0] == 0).sum()) < 110
