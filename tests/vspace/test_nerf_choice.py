"""Warp or field: gain and hysteresis by hand, and the choice of a space on its older keyframes."""

import math

import numpy as np
import pytest

from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import FieldConfig, SpaceState, TrainConfig, VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.choice import Choice, WarpTrial, gain_db
from instant_ic.vspace.config import ReadinessConfig
from tests import box_room

CONFIG = VirtualSpaceConfig(
    device="cpu",
    field=FieldConfig(log2_table=12, levels=4),
    train=TrainConfig(ray_columns=32, ray_rows=16, iterations=40),
    readiness=ReadinessConfig(plateau_iterations=10),
)


def flat(value, pixels=4):
    return np.full((pixels, 3), value, np.float32)


def test_the_gain_by_hand():
    # Errors of four pixels: the warp's 0.2² = 0.04; the third is not judged, the fourth not rendered by the field.
    judged = np.array([True, True, False, True])
    trial = WarpTrial.of(None, flat(0.5), judged, flat(0.7))
    assert trial.warp_error[:2] == pytest.approx(0.04) and math.isnan(trial.warp_error[2])
    colour = flat(0.5)
    colour[0], colour[2:] = 0.6, 0.0  # errors 0.01 and 0 where both count: 0.08 against 0.01 in sum
    rendering = colour, np.ones(4, np.float32), np.array([1, 1, 1, 0], np.float32)
    assert gain_db([trial], [rendering]) == pytest.approx(10 * math.log10(8), abs=1e-3)
    # A second image where the field is off by 0.3: 0.08 + 4 · 0.01 against 0.01 + 4 · 0.09.
    other = WarpTrial.of(None, flat(0.5), np.ones(4, bool), flat(0.6))
    off = flat(0.8), np.ones(4, np.float32), np.ones(4, np.float32)
    assert gain_db([trial, other], [rendering, off]) == pytest.approx(10 * math.log10(0.12 / 0.37), abs=1e-3)
    assert math.isnan(gain_db([], []))


def test_the_choice_has_hysteresis():
    choice = Choice(least_db=0.5)
    shown = []
    for gain in (-1.0, 0.4, 0.5, 0.1, 0.0, -0.1, 0.4, 0.6, math.nan):
        choice.take(gain)
        shown.append(choice.field)
    assert shown == [False, False, True, True, True, False, False, True, False]


@pytest.mark.parametrize(
    ("before", "gain", "spans_left", "hopeless"),
    [
        (math.nan, -5.0, 10, False),  # the first measurement says nothing about the rate
        (-3.0, -2.0, 3, False),  # 1 dB a span, three left: it would be 1 dB better
        (-3.0, -2.0, 1, True),
        (-1.0, -2.0, 10, True),  # it gets worse
        (0.0, 0.2, 0, False),  # not shown, but not worse either
    ],
)
def test_training_that_cannot_win_is_hopeless(before, gain, spans_left, hopeless):
    choice = Choice(least_db=0.5)
    choice.take(before, 100)
    choice.take(gain, spans_left)
    assert choice.hopeless is hopeless


def driven(count):
    space = VirtualSpace(CONFIG)
    for number in range(count):
        pose = pose_matrix(-0.8 + 0.4 * number, 0.1)
        image = box_room.panorama(pose, 96)
        space.set_keyframe(image.rgb, image.depth_m, pose, 0.02)
    return space


def test_without_an_older_keyframe_the_warp_is_shown_and_the_field_learns():
    space = driven(1)
    space.train(iterations=20)
    assert space.status.iterations == 20
    assert not space.status.shows_field and math.isnan(space.status.gain_db)


def test_a_field_that_loses_is_not_shown_and_stops():
    space = driven(3)
    assert len(space.trials) == 2
    assert space.status.gain_db < -3  # measured at once, untrained
    space.train()
    status = space.status
    assert not status.shows_field and status.gain_db < 0
    assert status.converged and status.state == SpaceState.READY


def test_a_field_that_wins_is_shown_until_it_loses(monkeypatch):
    space = driven(3)
    true, colours = (
        space.device.render_rays,
        {trial.rays.origin.tobytes(): trial.truth for trial in space.trials},
    )
    before = space.render(space.keyframe.map_from_camera, 48, 27, 1.5).rgb

    def render_rays(rays, panorama_share, depth_share):
        """The truth with an error of 1 % of full scale; a view elsewhere is white."""
        truth = colours.get(rays.origin.tobytes(), np.ones(rays.directions.shape, np.float32))
        return truth + np.float32(0.01), *true(rays, panorama_share, depth_share)[1:]

    with monkeypatch.context() as patch:
        patch.setattr(space.device, "render_rays", render_rays)
        space.train(iterations=10)
        assert space.status.shows_field and space.status.gain_db > 3
        assert space.render(space.keyframe.map_from_camera, 48, 27, 1.5).rgb.mean() > 240
    space.train(iterations=10)
    assert not space.status.shows_field
    assert np.array_equal(space.render(space.keyframe.map_from_camera, 48, 27, 1.5).rgb, before)


def test_what_is_shown_survives_saving(tmp_path):
    space = driven(3)
    space.choice.field = True
    space.save(tmp_path)
    loaded = VirtualSpace.load(tmp_path)
    assert loaded.status.shows_field
    views = [one.render(pose_matrix(0.3), 48, 27, 1.5).rgb for one in (space, loaded)]
    assert np.array_equal(*views)
