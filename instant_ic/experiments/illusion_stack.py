"""The stack of ``ic evaluate teleop`` with a film of the page: its images of the virtual space, and the truth.

The page renders the layers of the virtual space itself, at the v-bot's present pose. Here the CPU renderer takes its
place. A second virtual space gets the same keyframes with the simulator's true depth. Both render the same views. Not
modelled: the paler colours of estimated surfaces, the dissolve and colour matching at a switch, and overlays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.adapters.nerf import decode_keyframe
from instant_ic.bus.lockstep import Record
from instant_ic.experiments.teleop_stack import SimulatedStack, StackConfig
from instant_ic.experiments.teleop_worlds import Course
from instant_ic.experiments.worlds import Obstacle, without
from instant_ic.geometry.image_quality import psnr_db, ssim
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import deserialize
from instant_ic.sim.render import EquirectRenderer
from instant_ic.vspace import VirtualSpace
from instant_ic.vspace.view import View

if TYPE_CHECKING:
    from instant_ic.sim.world import World

FloatArray: TypeAlias = NDArray[np.float64]
Image: TypeAlias = NDArray[np.uint8]

LIVE, TRUE_DEPTH = SOURCES = ("live", "with_true_depth")
FRAME_S = 0.3
"""Simulated seconds between two compared frames. The page shows up to 60 frames a second."""
WIDTH, HEIGHT, FOV_RAD = 640, 360, np.pi / 2
"""The page's window, pixels, and its horizontal field of view."""
TRUE_SIGMA = 0.01
"""Relative sigma of the true depth: it is sampled once per pixel."""
ASIDE_M = 0.8
"""An obstacle blocks the v-bot's way if its centre is at most this far from the v-bot's line, metres."""


@dataclass(frozen=True)
class Passage:
    """The v-bot's way through obstacles: a line from its position (2,) at the takeover, along a unit vector (2,).

    ``obstacles`` are the blocking ones, nearest first, each with the position of its near face along the line, metres.
    """

    start: FloatArray
    heading: FloatArray
    obstacles: tuple[tuple[float, Obstacle], ...]

    @classmethod
    def of(cls, pose: FloatArray, obstacles: Sequence[Obstacle]) -> Passage:
        """Return the passage that begins at pose (3,)."""
        start, heading = np.asarray(pose[:2], np.float64), np.array([math.cos(pose[2]), math.sin(pose[2])])
        left = np.array([-heading[1], heading[0]])
        ahead = []
        for one in obstacles:
            outline = one.corners() - start
            near, far = float((outline @ heading).min()), float((outline @ heading).max())
            if far > 0 and abs(float((outline @ left).mean())) < ASIDE_M:
                ahead.append((near, one))
        return cls(start, heading, tuple(sorted(ahead, key=lambda each: each[0])))

    def obstacle_at(self, place: FloatArray) -> tuple[float, Obstacle] | None:
        """Return how far a position (2,) lies behind the near face of the passed obstacle, and that obstacle.

        It is the last obstacle whose near face has been passed, or else the first one; None without obstacles.
        """
        if not self.obstacles:
            return None
        along = float((np.asarray(place) - self.start) @ self.heading)
        passed = [each for each in self.obstacles if each[0] <= along]
        near, obstacle = passed[-1] if passed else self.obstacles[0]
        return along - near, obstacle


@dataclass(frozen=True)
class Score:
    """PSNR in dB and SSIM of a shown image against the true one."""

    psnr_db: float
    ssim: float


@dataclass(frozen=True)
class IllusionFrame:
    """One frame of the page.

    Attributes:
        episode, time_s: episode and simulated seconds.
        distance_m: distance behind the near face of the passed obstacle, negative before it; None without obstacles.
        with_obstacle: True if the truth is the world with the obstacle.
        scores: score of each source against that truth.
        unseen_share: share of each source's view that no keyframe has seen.
        expected_psnr_db: PSNR that the virtual space estimates for the live view.
    """

    episode: int
    time_s: float
    distance_m: float | None
    with_obstacle: bool
    scores: dict[str, Score]
    unseen_share: dict[str, float]
    expected_psnr_db: float


class FilmedStack(SimulatedStack):
    """A stack whose page is compared with the truth every ``FRAME_S``.

    Args:
        world: see ``SimulatedStack``.
        config: see ``SimulatedStack``.
        course: course that is driven, with its obstacles.
        episode: number of the episode.
        on_frame: called with each frame, its images by source, and the true image.
    """

    size = (WIDTH, HEIGHT)

    def __init__(
        self,
        world: World,
        config: StackConfig,
        course: Course,
        episode: int,
        on_frame: Callable[[IllusionFrame, dict[str, Image], Image], None],
    ) -> None:
        self._course, self._episode, self._emit = course, episode, on_frame
        self.space: VirtualSpace | None = None
        """Virtual space of the page, with the keyframes of the stack's own."""
        self._truth_space: VirtualSpace | None = None
        self._world_from_map = np.eye(4)
        self._next_frame_s = 0.0
        self._passage: Passage | None = None
        self._mode = ""
        self._renderers: dict[Obstacle, EquirectRenderer] = {}
        super().__init__(world, config)

    def on_record(self, record: Record) -> None:
        """Take a message that a node has published; give keyframes to both virtual spaces."""
        super().on_record(record)
        if record.topic == "/keyframe":
            message = deserialize(record.payload, record.type_name)
            if message.fit and self._keyframe_at is not None:
                self._take_keyframe(message, self._keyframe_at)

    def _take_keyframe(self, message: Any, true_pose: FloatArray) -> None:
        rgb, depth, map_from_camera, sigma = decode_keyframe(message)
        world_from_camera = pose_matrix(true_pose[0], true_pose[1], yaw=true_pose[2]) @ self._base_from_camera
        # A pose error of SLAM moves space and v-bot together; the operator cannot see it.
        self._world_from_map = world_from_camera @ np.linalg.inv(map_from_camera)
        if self.space is None or self._truth_space is None:
            self.space, self._truth_space = (VirtualSpace(self.nodes["nerf"].config.space) for _ in range(2))
        self.space.set_keyframe(rgb, depth, map_from_camera, sigma)
        height, width = depth.shape
        true_depth = self.simulation.renderer.render(world_from_camera, width, height).depth_m
        self._truth_space.set_keyframe(rgb, true_depth, map_from_camera, TRUE_SIGMA)

    @property
    def _base_from_camera(self) -> FloatArray:
        return pose_matrix(*self.simulation.config.camera_mount.pose)

    def step(self, operate: Callable[[], tuple[float, float]] | None = None) -> None:
        """Advance the stack; then compare a frame if one is due and the page shows the virtual space."""
        super().step(operate)
        mode = str(self.page.state.get("mode", ""))
        if mode == "entering" and self._mode not in ("entering", "virtual"):
            self._passage = Passage.of(self.vbot, self._course.obstacles)
        self._mode = mode
        if self.page.virtual and self.space is not None and self.time_s >= self._next_frame_s:
            self._next_frame_s = self.time_s + FRAME_S - 1e-9
            self._compare()

    def on_view(self, view: View, map_from_camera: FloatArray) -> None:
        """Take the live view of a frame, before it is compared."""

    def _compare(self) -> None:
        assert self.space is not None and self._truth_space is not None
        x, y, yaw = self.page.state.get("vbot") or self.page.state["robot"]
        map_from_shown = pose_matrix(x, y, yaw=yaw) @ self._base_from_camera
        world_from_shown = self._world_from_map @ map_from_shown
        renderer, distance_m, with_obstacle = self._truth_at(world_from_shown)
        truth = renderer.render_perspective(world_from_shown, *self.size, FOV_RAD)
        live, true_depth = (
            space.render(map_from_shown, *self.size, FOV_RAD) for space in (self.space, self._truth_space)
        )
        self.on_view(live, map_from_shown)
        views = {LIVE: live, TRUE_DEPTH: true_depth}
        images = {name: view.rgb for name, view in views.items()}
        frame = IllusionFrame(
            self._episode,
            self.time_s,
            distance_m,
            with_obstacle,
            {name: Score(psnr_db(image, truth.rgb), ssim(image, truth.rgb)) for name, image in images.items()},
            {name: view.unseen_share for name, view in views.items()},
            live.expected_psnr_db,
        )
        self._emit(frame, images, truth.rgb)

    def _truth_at(self, world_from_camera: FloatArray) -> tuple[EquirectRenderer, float | None, bool]:
        """Return the truth's renderer at a pose, the distance behind the near face, and whether it has the obstacle.

        Before the near face, the true image shows the obstacle. From there on the v-bot is inside or behind the
        obstacle, and the truth is the world without it.
        """
        found = None if self._passage is None else self._passage.obstacle_at(world_from_camera[:2, 3])
        if found is None:
            return self.simulation.renderer, None, True
        distance_m, obstacle = found
        if distance_m < 0:
            return self.simulation.renderer, distance_m, True
        if obstacle not in self._renderers:
            self._renderers[obstacle] = EquirectRenderer(without(self._course.world, obstacle))
        return self._renderers[obstacle], distance_m, False
