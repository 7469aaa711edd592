"""One photo's depth made plausible: level floor and ceiling, upright walls."""

import math

import numpy as np
import pytest

from instant_ic.depth.tidy import continued, plane_below, tidy

H, W = 64, 128
FLOOR, CEILING, HALF = 1.2, 1.5, 2.5  # metres from the camera to floor and ceiling, and to the walls ahead and aside


def _angles():
    elevation = math.pi / 2 - (np.arange(H) + 0.5) * math.pi / H
    azimuth = math.pi - (np.arange(W) + 0.5) * 2 * math.pi / W
    return np.meshgrid(elevation, azimuth, indexing="ij")


def _room() -> np.ndarray:
    """Radial depth of a square room, each pixel by hand: the nearest of walls, floor and ceiling."""
    elevation, azimuth = _angles()
    wall = HALF / np.maximum(np.abs(np.cos(azimuth)), np.abs(np.sin(azimuth))) / np.cos(elevation)
    with np.errstate(divide="ignore"):
        floor = np.where(elevation < 0, FLOOR / np.maximum(-np.sin(elevation), 1e-9), np.inf)
        ceiling = np.where(elevation > 0, CEILING / np.maximum(np.sin(elevation), 1e-9), np.inf)
    return np.minimum(np.minimum(wall, floor), ceiling).astype(np.float32)


def _bent(depth: np.ndarray) -> np.ndarray:
    """As a network sees it: bent by up to 6 %."""
    elevation, azimuth = _angles()
    return (depth * (1 + 0.06 * np.sin(5 * azimuth) * np.cos(7 * elevation))).astype(np.float32)


def _error(depth: np.ndarray) -> np.ndarray:
    return np.abs(depth / _room() - 1)


def test_floor_and_ceiling_become_level():
    room = tidy(_bent(_room()), height=H)
    assert room.floor_m == pytest.approx(FLOOR, rel=0.03) and room.ceiling_m == pytest.approx(CEILING, rel=0.03)
    assert room.scale == 1
    elevation, _ = _angles()
    for rows, raw_least in ((elevation < -math.radians(40), 0.02), (elevation > math.radians(45), 0.02)):
        height = (room.depth_m * np.sin(elevation))[rows]
        assert height.std() < 0.002 * abs(height.mean())
        assert (_bent(_room()) * np.sin(elevation))[rows].std() > raw_least * abs(height.mean())
    assert _error(room.depth_m).mean() < 0.75 * _error(_bent(_room())).mean()


def test_a_room_that_is_right_stays_so():
    room = tidy(_room(), height=H)
    assert np.median(_error(room.depth_m)) < 0.005 and _error(room.depth_m).mean() < 0.02


def test_a_known_camera_height_scales_everything():
    room = tidy(0.5 * _room(), camera_height_m=FLOOR, height=H)
    assert room.floor_m == FLOOR and room.scale == pytest.approx(2, rel=0.03)
    assert room.ceiling_m == pytest.approx(CEILING, rel=0.05)
    assert np.median(_error(room.depth_m)) < 0.04


def test_a_table_stays_a_table():
    depth, (elevation, azimuth) = _room(), _angles()
    table = (elevation < -math.radians(20)) & (elevation > -math.radians(50)) & (np.abs(azimuth) < 0.5)
    depth[table] = 0.45 / np.sin(-elevation[table])  # its top is 0.45 m under the camera
    tidied = tidy(depth, height=H).depth_m
    inside = table & np.roll(table, 4, 0) & np.roll(table, -4, 0) & np.roll(table, 4, 1) & np.roll(table, -4, 1)
    height = tidied[inside] * np.sin(-elevation[inside])
    assert np.median(np.abs(height - 0.45)) < 0.03


def test_stairs_down_are_not_filled_up_but_nothing_else_lies_under_the_floor():
    depth, (elevation, azimuth) = _room(), _angles()
    spike = (elevation < -math.radians(70)) & (np.abs(azimuth) < 0.4)
    depth[spike] *= 3  # the foot of the stand, as the network sees it
    tidied = tidy(depth, height=H).depth_m
    assert (tidied * np.sin(-elevation)).max() < FLOOR * 1.01


def test_the_seam_is_no_edge():
    bent = _bent(_room())
    turned = np.roll(tidy(np.roll(bent, W // 2, 1), height=H).depth_m, -W // 2, 1)
    assert np.abs(turned / tidy(bent, height=H).depth_m - 1).max() < 0.01


def test_what_is_unknown_stays_so_but_for_the_robot():
    depth = _room()
    depth[20:28, 10:30] = 0
    depth[-4:] = np.nan  # the stand
    tidied = tidy(depth, height=H).depth_m
    assert (tidied[21:27, 11:29] == 0).all() and np.isfinite(tidied).all()
    elevation, _ = _angles()
    np.testing.assert_allclose(tidied[-4:], FLOOR / np.sin(-elevation[-4:]), rtol=0.03)


def test_other_sizes_come_out_at_the_size_asked_for():
    assert tidy(_room(), height=128).depth_m.shape == (128, 256)
    large = tidy(_bent(_room()), height=128).depth_m
    assert np.median(_error(large[::2, ::2])) < 0.06


def test_no_plane_where_none_stands_out():
    rng = np.random.default_rng(0)
    down = np.full((H, 1), 0.5, np.float32)
    assert plane_below(rng.uniform(0.5, 60, (H, W)).astype(np.float32), down, np.ones(H, bool)) is None
    assert plane_below(np.zeros((H, W), np.float32), down, np.ones(H, bool)) is None
    level = plane_below(np.full((H, W), 3, np.float32), down, np.ones(H, bool))
    assert level == pytest.approx(1.5)


def test_values_go_on_from_the_last_sure_one_by_hand():
    values = np.array([[1, 10], [2, 20], [3, 30], [4, 40]], np.float32)
    sure = np.array([[1, 0], [0, 1], [1, 1], [0, 1]], bool)
    np.testing.assert_array_equal(continued(values, sure, upwards=False)[2:], [[3, 30], [3, 40]])
    np.testing.assert_array_equal(continued(values, sure, upwards=True)[:3], [[1, 20], [3, 20], [3, 30]])


@pytest.mark.parametrize(
    ("depth", "height", "words"),
    [
        (np.ones((4, 4), np.float32), None, "twice as wide"),
        (np.zeros((8, 16), np.float32), None, "nowhere known"),
        (np.full((8, 16), np.nan, np.float32), None, "nowhere known"),
        (_room(), 0.01, "0.05 to 10 m"),
        (np.random.default_rng(1).uniform(0.5, 60, (H, W)).astype(np.float32), 1.0, "no floor"),
    ],
)
def test_what_cannot_be_tidied_is_said(depth, height, words):
    with pytest.raises(ValueError, match=words):
        tidy(depth, height, H)


@pytest.mark.parametrize("words", [["--camera-height", "1.2"], ["--as-estimated"]])
def test_a_photo_without_depth_on_the_command_line(words, tmp_path, capsys, monkeypatch):
    import cv2

    from instant_ic.cli.commands import vspace
    from instant_ic.cli.main import main

    cv2.imwrite(str(tmp_path / "p.png"), np.full((H, W, 3), np.arange(W)[:, None], np.uint8))
    monkeypatch.setattr(vspace, "estimated_depth", lambda model, rgb: 0.5 * _room())
    out = str(tmp_path / "space")
    train = ["vspace", "train", str(tmp_path / "p.png"), "--iterations", "1", "--device", "cpu", "-o", out, *words]
    assert main(train) == 0
    said = capsys.readouterr().err
    assert ("floor 1.20 m under the camera, ceiling 1.5" in said and "scaled by 2.0" in said) == (
        words[0] != "--as-estimated"
    )
    assert main([*train, "--camera-height", "1.2", "--as-estimated"]) == 2
    assert "omit one of them" in capsys.readouterr().err
