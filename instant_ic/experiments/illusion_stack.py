"""The stack of ``ic evaluate teleop``, with a film of the page: what it shows of the virtual space, and the truth.

Beside the virtual space of the stack, a second one gets the same keyframes with the simulator's true depth. Both render
the same views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus.lockstep import Record
from instant_ic.experiments.illusion_page import PageView, Screen, compose, place_on_screen
from instant_ic.experiments.illusion_truth import Passage, Score, score, without
from instant_ic.experiments.teleop import photograph
from instant_ic.experiments.teleop_stack import SimulatedStack, StackConfig
from instant_ic.experiments.teleop_worlds import Course, Obstacle
from instant_ic.geometry.poses import pose2_from_matrix, pose_matrix
from instant_ic.msg import deserialize, image_array, matrix_from_pose
from instant_ic.sim.render import EquirectRenderer, Frame
from instant_ic.vspace import VirtualSpace
from instant_ic.vspace.jobs import EncodedView, ViewOrder, decode_panorama
from instant_ic.vspace.view import View

if TYPE_CHECKING:
    from instant_ic.sim.world import World

FloatArray: TypeAlias = NDArray[np.float64]

LIVE, TRUE_DEPTH, TRUE_FILL = "live", "with_true_depth", "with_true_depth_and_fill"
TRUE_VIEW = "with_true_view"
"""The simulator's image and depth instead of the rendered view: what the page itself loses."""
WEBGL, WEBGL_TRUE_DEPTH = "webgl", "webgl_with_true_depth"
"""What a page with WebGL shows: it renders the layers itself, at the shown pose, with the screen's pixels and without
the dissolve between keyframes. Not modelled: its paler guesses, and the tolerance of its triangles."""
SOURCES = (LIVE, TRUE_DEPTH, TRUE_FILL, TRUE_VIEW, WEBGL, WEBGL_TRUE_DEPTH)
FRAME_S = 0.3
"""Simulated seconds between two compared frames: every third view. The page shows up to 60 frames a second."""
VIEW_AGE_S = 0.15
"""Age of the shown view's pose: rendering and transport take about 0.1 s, and views come ten times a second."""
TRUE_SIGMA = 0.01
"""Relative sigma of the true depth: it is sampled once per pixel."""


@dataclass(frozen=True)
class IllusionFrame:
    """One frame of the page.

    Attributes:
        episode, time_s: which frame, in simulated seconds.
        blend: 1 where the view is shown alone, less while it dissolves into the camera's image or out of it.
        distance_m: position behind the near face of the obstacle that is passed, negative before it; None without any.
        with_obstacle: whether the truth is the world with the obstacle.
        scores: of each source against that truth.
        psnr_with_db, psnr_without_db: of the live frame against the world with the obstacle and without; the second is
            None without an obstacle.
        unseen_share: of each source's view.
        expected_psnr_db: what the virtual space expects of the live view.
    """

    episode: int
    time_s: float
    blend: float
    distance_m: float | None
    with_obstacle: bool
    scores: dict[str, Score]
    psnr_with_db: float
    psnr_without_db: float | None
    unseen_share: dict[str, float]
    expected_psnr_db: float


@dataclass(frozen=True)
class _Taken:
    """A view of all sources on its way to the screen."""

    due_s: float
    views: dict[str, PageView]
    unseen: dict[str, float]
    expected_psnr_db: float
    world_from_map: FloatArray


class FilmedStack(SimulatedStack):
    """Compares what the page shows of the virtual space with the truth, every ``FRAME_S``.

    ``on_frame`` is called with each frame, its images by source, and the true image.
    """

    def __init__(
        self,
        world: World,
        config: StackConfig,
        course: Course,
        episode: int,
        on_frame: Callable[[IllusionFrame, dict[str, NDArray[np.uint8]], NDArray[np.uint8]], None],
    ) -> None:
        self.screen = Screen()
        self._course, self._episode, self._emit = course, episode, on_frame
        self._truth_space: VirtualSpace | None = None
        self._page_space: VirtualSpace | None = None
        self._world_from_map = np.eye(4)
        self._taken: _Taken | None = None
        self._next_frame_s = 0.0
        self._blend = 0.0
        self._passage: Passage | None = None
        self._mode = ""
        self._renderers: dict[Obstacle, EquirectRenderer] = {}
        super().__init__(world, config)

    # -- keyframes and views

    def _on_record(self, record: Record) -> None:
        super()._on_record(record)
        if record.topic == "/keyframe":
            message = deserialize(record.payload, record.type_name)
            if message.fit and self._keyframe_at is not None:
                self._take_keyframe(message, self._keyframe_at)

    def _take_keyframe(self, message: Any, true_pose: FloatArray) -> None:
        """Give the second virtual space the keyframe with its true depth."""
        map_from_camera = matrix_from_pose(message.pose)
        world_from_camera = pose_matrix(true_pose[0], true_pose[1], yaw=true_pose[2]) @ self._base_from_camera
        # A pose error of SLAM moves space and v-bot together; the operator cannot see it.
        self._world_from_map = world_from_camera @ np.linalg.inv(map_from_camera)
        height, width = image_array(message.depth).shape
        depth = self.simulation.renderer.render(world_from_camera, width, height).depth_m
        if self._truth_space is None:
            self._truth_space = VirtualSpace(self.nodes["nerf"].config.space)
        rgb = decode_panorama(np.asarray(message.panorama.data, np.uint8))
        self._truth_space.set_keyframe(rgb, depth, map_from_camera, TRUE_SIGMA)

    @property
    def _base_from_camera(self) -> FloatArray:
        return pose_matrix(*self.simulation.config.camera_mount.pose)

    def on_frame(self, virtual: bool, header: dict[str, Any], payload: bytes) -> None:
        """Handle an image that arrives at the page; take a view if the next frame needs it."""
        super().on_frame(virtual, header, payload)
        # Only while the page shows the virtual space or may do so by the time the frame is composed.
        due = virtual and self._taken is None and self.time_s >= self._next_frame_s - 1e-9
        if not due or self.page.state.get("mode") not in ("entering", "virtual", "returning", "stopped"):
            return
        whole = self._whole_view(header)
        if whole is None or self._truth_space is None:
            return
        self._next_frame_s = self.time_s + FRAME_S - 1e-9
        self._taken = self._render(whole(), self._truth_space)

    def _render(self, live: EncodedView, truth_space: VirtualSpace) -> _Taken:
        order = live.order
        pose = np.asarray(order.pose(), np.float64)
        with_depth = truth_space.render(pose, order.width, order.height, order.fov_rad)
        true = self._true_view(order, pose)
        views = {LIVE: live.view, TRUE_DEPTH: with_depth, TRUE_FILL: _filled(with_depth, true), TRUE_VIEW: true}
        return _Taken(
            self.time_s + VIEW_AGE_S,
            {name: PageView.of(view, pose, order.fov_rad, order.jpeg_quality) for name, view in views.items()},
            {name: view.unseen_share for name, view in views.items()},
            live.view.expected_psnr_db,
            self._world_from_map,
        )

    def _true_view(self, order: ViewOrder, pose: FloatArray) -> View:
        world_from_camera = self._world_from_map @ pose
        renderer, _, _ = self._truth_at(world_from_camera)
        true = renderer.render_perspective(world_from_camera, order.width, order.height, order.fov_rad)
        return View(true.rgb, true.depth_m, np.ones_like(true.depth_m))

    # -- frames

    def step(self, operate: Callable[[], tuple[float, float]] | None = None) -> None:
        """As ``SimulatedStack.step``; then compose the page's image and compare it if a frame is due."""
        before = self.time_s
        super().step(operate)
        passed = self.time_s - before
        state, console = self.page.state, self.nodes["console"].config
        mode = str(state.get("mode", ""))
        if mode == "entering" and self._mode not in ("entering", "virtual"):
            self._passage = Passage.of(self.vbot, self._course.obstacles)
        self._mode = mode
        dissolve_s = console.dissolve_ms / 1e3
        change = passed / dissolve_s if dissolve_s > 0 else 1.0
        self._blend = min(max(self._blend + (change if self.page.virtual else -change), 0.0), 1.0)
        taken = self._taken
        if taken is not None and self.time_s >= taken.due_s - 1e-9:
            self._taken = None
            if self._blend > 0:
                self._compare(taken)

    def _compare(self, taken: _Taken) -> None:
        screen = self.screen
        map_from_vbot = self._vbot_in_map()
        map_from_shown = map_from_vbot.copy()
        map_from_shown[:3, 3] = taken.views[LIVE].map_from_camera[:3, 3]
        placed = {name: place_on_screen(view, screen, map_from_shown[:3, :3]) for name, view in taken.views.items()}
        world_from_shown = taken.world_from_map @ map_from_shown
        covered = self._blend == 1 and all(bool((inside == 1).all()) for _, inside in placed.values())
        camera = None if covered else self._camera_image(map_from_shown)
        images = {name: compose(*each, camera, self._blend) for name, each in placed.items()}
        by_page = self._webgl(map_from_shown)
        whole = np.ones((screen.height, screen.width), np.float32)
        for name, view in by_page.items():
            images[name] = compose(view.rgb * np.float32(1 / 255), whole, camera, self._blend)
        renderer, distance_m, with_obstacle = self._truth_at(world_from_shown)
        truths = {with_obstacle: self._true(renderer, world_from_shown)}
        if distance_m is not None:
            other = self.simulation.renderer if not with_obstacle else self._without(world_from_shown)
            truths[not with_obstacle] = self._true(other, world_from_shown)
        truth = truths[with_obstacle]
        frame = IllusionFrame(
            self._episode,
            self.time_s,
            self._blend,
            distance_m,
            with_obstacle,
            {name: score(image, truth, world_from_shown, screen.fov_rad) for name, image in images.items()},
            score(images[LIVE], truths[True], world_from_shown, screen.fov_rad, with_ssim=False).psnr_db,
            score(images[LIVE], truths[False], world_from_shown, screen.fov_rad, with_ssim=False).psnr_db
            if False in truths
            else None,
            {**taken.unseen, **{name: view.unseen_share for name, view in by_page.items()}},
            taken.expected_psnr_db,
        )
        self._emit(frame, images, truth.rgb)

    def _webgl(self, map_from_shown: FloatArray) -> dict[str, View]:
        """The views that a page renders from the layers."""
        live, screen = self.nodes["nerf"].work.space.shown, self.screen
        assert live is not None and self._truth_space is not None
        if self._page_space is None:
            self._page_space = VirtualSpace(self.nodes["nerf"].config.space)
        self._page_space.show(live)
        spaces = {WEBGL: self._page_space, WEBGL_TRUE_DEPTH: self._truth_space}
        return {
            name: space.render(map_from_shown, screen.width, screen.height, screen.fov_rad)
            for name, space in spaces.items()
        }

    def _vbot_in_map(self) -> FloatArray:
        x, y, yaw = self.page.state.get("vbot") or self.page.state["robot"]
        return pose_matrix(x, y, yaw=yaw)

    def _camera_image(self, map_from_shown: FloatArray) -> NDArray[np.uint8]:
        newest = self._newest.get(False)
        if newest is None:
            return np.zeros((self.screen.height, self.screen.width, 3), np.uint8)
        heading = float(pose2_from_matrix(self._world_from_map @ map_from_shown)[2])
        photo = replace(newest, heading=heading)
        return photograph(self, photo, self.screen.width, self.screen.height, self.screen.fov_rad)

    # -- truth

    def _true(self, renderer: EquirectRenderer, world_from_camera: FloatArray) -> Frame:
        screen = self.screen
        return renderer.render_perspective(world_from_camera, screen.width, screen.height, screen.fov_rad)

    def _truth_at(self, world_from_camera: FloatArray) -> tuple[EquirectRenderer, float | None, bool]:
        """Renderer of the truth at a pose, the distance behind the near face, and whether it has the obstacle.

        Before the near face the obstacle belongs to the image. From there on the v-bot is inside it or behind it, and
        the truth is the world without it.
        """
        found = None if self._passage is None else self._passage.obstacle_at(world_from_camera[:2, 3])
        if found is None:
            return self.simulation.renderer, None, True
        if found[0] < 0:
            return self.simulation.renderer, found[0], True
        return self._without(world_from_camera), found[0], False

    def _without(self, world_from_camera: FloatArray) -> EquirectRenderer:
        assert self._passage is not None
        found = self._passage.obstacle_at(world_from_camera[:2, 3])
        assert found is not None
        if found[1] not in self._renderers:
            self._renderers[found[1]] = EquirectRenderer(without(self._course.world, found[1]))
        return self._renderers[found[1]]


def _filled(view: View, true: View) -> View:
    """The view with true colours and depth where no keyframe has seen the place."""
    unseen = view.confidence == 0
    return replace(
        view,
        rgb=np.where(unseen[..., None], true.rgb, view.rgb),
        depth_m=np.where(unseen, true.depth_m, view.depth_m),
        confidence=np.where(unseen, np.float32(1), view.confidence),
    )
