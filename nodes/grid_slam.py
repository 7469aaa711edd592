"""Grid SLAM: computes /map, /pose and the transform map→odom from /scan and wheel odometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from instant_ic import msg
from instant_ic.adapters import slam as slam_messages
from instant_ic.bus import LATCHED, RELIABLE, SENSOR, WARN, Node, NodeError, QoS, main
from instant_ic.geometry.transforms import TransformBuffer
from instant_ic.slam.config import GridSlamConfig
from instant_ic.slam.odometry import CorrectionLimiter
from instant_ic.slam.report import diagnoses
from instant_ic.slam.scan import FloatArray
from instant_ic.slam.scan_queue import QueuedScan, ScanError, ScanQueue
from instant_ic.slam.start import make_slam, warm_up

ODOMETRY_QUEUE = QoS("sensor", depth=100)
"""Long queue of odometry, because a scan is placed between two odometry messages."""
_POLL_S = 0.05  # period at which waiting scans are checked if no odometry arrives


class GridSlamNode(Node[GridSlamConfig]):
    name = "grid_slam"
    live_parameters = ("max_scan_age_s", "odom_wait_s")

    def setup(self) -> None:
        warm_up(self.config)
        self.commands = {"save": self.save}
        self.poll: Any = None  # timer while scans wait for odometry, which may have stopped
        self.worker = self.background(slam_messages.run_job, self.take_over)
        self.queue = ScanQueue(self.config)
        self.limiter = CorrectionLimiter()
        self.map_out = self.publisher("/map", msg.OccupancyGrid, qos=LATCHED)
        self.pose_out = self.publisher("/pose", msg.PoseWithCovarianceStamped, qos=SENSOR)
        self.integrity_out = self.publisher("/slam/integrity", msg.PoseIntegrity, qos=SENSOR)
        self.restart()
        # The laser's mount is fixed, so /tf, which carries a message per odometry, is not needed.
        self.mounts = TransformBuffer()
        self.subscribe("/tf_static", msg.TFMessage, lambda m: slam_messages.read_mounts(m, self.mounts), LATCHED)
        if self.config.use_wheel_odom:
            self.subscribe("/wheel/odom", msg.Odometry, self.on_odometry, qos=ODOMETRY_QUEUE)
        self.subscribe("/scan", msg.LaserScan, self.on_scan, qos=SENSOR)
        self.subscribe("/initialpose", msg.PoseWithCovarianceStamped, self.on_initial_pose, qos=RELIABLE)
        self.timer(self.config.map_period_s, self.publish_map)
        self.timer(1.0, self.watch)

    def watch(self) -> None:
        self.diagnose_all(self.queue.watch(self.clock.steady_ns()))

    def reconfigure(self, config: GridSlamConfig) -> None:
        super().reconfigure(config)
        self.queue.config = config

    def restart(self) -> None:
        config = self.config
        try:
            self.slam = make_slam(config, config.saved_map, config.mode == "localization")
        except ValueError as error:  # includes MapError
            raise NodeError(str(error)) from None
        self.published_version = 0
        self.placed_ns: int | None = None
        self.queue.restart()
        self.limiter.reset()

    def on_odometry(self, message: Any) -> None:
        if self.queue.add_odometry(msg.stamp_ns(message), msg.pose2_from_message(message)):
            self.place_ready()
        else:
            self.diagnose("odometry", WARN, "A message was dropped: it is not finite or not newer than the last")

    def on_scan(self, message: Any) -> None:
        now_ns = self.clock.now_ns()
        try:
            back_s = self.queue.check_stamp(msg.stamp_ns(message), now_ns)
            if back_s > 0:
                self.diagnose("time", WARN, f"Time went back by {back_s:.1f} s. A new map has been started")
                self.restart()
            scan, mount = slam_messages.read_scan(message, self.mounts)
            self.queue.add(scan, mount, now_ns, self.clock.steady_ns())
        except ScanError as error:
            self.queue.drop(str(error))
        self.diagnose_all(self.queue.state)
        self.place_ready()

    def place_ready(self) -> None:
        """Place the scans whose odometry has arrived or whose waiting time is over."""
        for queued, odometry in self.queue.ready(self.clock.now_ns()):
            self.place(queued, odometry)
        if self.queue.waiting and self.poll is None:
            self.poll = self.timer(_POLL_S, self.place_ready)
        elif self.poll is not None and not self.queue.waiting:
            self.poll.cancel()
            self.poll = None

    def place(self, queued: QueuedScan, odometry: FloatArray | None) -> None:
        """Process one scan and publish the result."""
        config, slam, stamp = self.config, self.slam, queued.scan.stamp_ns
        result = slam.process(queued.scan, odometry, queued.base_from_laser)
        self.diagnose_all(*diagnoses(slam, result, odometry is not None, config.use_wheel_odom))
        self.placed_ns = stamp
        self.integrity_out.publish(slam_messages.integrity_message(slam, result, stamp))
        for parent, child, matrix in slam_messages.transforms(slam, self.limiter, stamp, odometry is not None):
            self.transforms.broadcast(parent, child, matrix, stamp)
        if slam.in_map_frame:
            self.pose_out.publish(slam_messages.pose_message(result, stamp))
            if self.published_version == 0:
                self.publish_map()
        job = slam.background_job()
        if job is not None:
            self.worker.submit((slam, job))

    def take_over(self, result: slam_messages.JobResult) -> None:
        """Apply the worker's result, unless its map has been discarded since."""
        self.diagnose_all(result.diagnosis)
        if result.slam is self.slam:
            self.slam.take_over(result.outcome)

    def on_initial_pose(self, message: Any) -> None:
        """Set the robot's pose in the saved map by hand, for example with RViz's "2D pose estimate"."""
        try:
            self.slam.set_pose(slam_messages.read_initial_pose(message))
            self.limiter.reset()
        except ValueError as error:
            self.log.warning("/initialpose is not used: %s", error)

    def save(self, path: str) -> list[str]:
        """Write the map to ``path``, which has no suffix, and return the files. Raise MapError if that fails."""
        files = [str(file) for file in self.slam.save(Path(path))]
        self.log.info("saved: %s", ", ".join(files))
        return files

    def publish_map(self) -> None:
        """Publish the map if it has changed."""
        if self.placed_ns is not None and self.slam.map_version != self.published_version:
            self.published_version = self.slam.map_version
            self.map_out.publish(slam_messages.map_message(self.slam, self.placed_ns))


if __name__ == "__main__":
    main(GridSlamNode)
