"""Transforms that a node receives and broadcasts."""

from __future__ import annotations

from typing import Any

from instant_ic.bus.diagnostics import ERROR
from instant_ic.bus.node_interface import NodeInterface
from instant_ic.bus.qos import LATCHED, RELIABLE
from instant_ic.bus.topics import Publisher
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.msg import MessageError, message_type, stamp_ns, transform_matrix, transform_message


class NodeTransforms:
    """The transforms of one node: a buffer of the received ones, and publishers of its own."""

    def __init__(self, node: NodeInterface) -> None:
        self._node = node
        self._buffer: TransformBuffer | None = None
        self._out: Publisher | None = None
        self._static_out: Publisher | None = None
        self._static: dict[str, Any] = {}

    @property
    def buffer(self) -> TransformBuffer:
        """The received transforms. The first use subscribes to ``/tf`` and ``/tf_static``."""
        if self._buffer is None:
            self._buffer = TransformBuffer()
            transforms = message_type("TFMessage")
            self._node.subscribe("/tf", transforms, lambda message: self._take(message, False), RELIABLE)
            self._node.subscribe("/tf_static", transforms, lambda message: self._take(message, True), LATCHED)
        return self._buffer

    def forget_moving(self) -> None:
        """Drop all transforms received on ``/tf``."""
        if self._buffer is not None:
            self._buffer.forget_moving()

    def broadcast(self, parent: str, child: str, parent_from_child: Matrix, stamp: int) -> None:
        """Publish one transform on ``/tf``; ``stamp`` is in nanoseconds."""
        transforms = message_type("TFMessage")
        if self._out is None:
            self._out = self._node.publisher("/tf", transforms, RELIABLE)
        self._out.publish(transforms([transform_message(parent_from_child, parent, child, stamp)]))

    def broadcast_static(self, parent: str, child: str, parent_from_child: Matrix) -> None:
        """Publish a fixed transform on ``/tf_static``, together with the node's other fixed transforms."""
        transforms = message_type("TFMessage")
        if self._static_out is None:
            self._static_out = self._node.publisher("/tf_static", transforms, LATCHED)
        now_ns = self._node.clock.now_ns()
        self._static[child] = transform_message(parent_from_child, parent, child, now_ns)
        self._static_out.publish(transforms(list(self._static.values())))

    def _take(self, message: Any, static: bool) -> None:
        for transform in message.transforms:
            try:
                self.buffer.set(
                    transform.header.frame_id,
                    transform.child_frame_id,
                    stamp_ns(transform),
                    transform_matrix(transform),
                    static,
                    self._node.clock.now_ns(),
                )
            except (TransformError, MessageError) as error:
                self._node.diagnose("tf", ERROR, str(error))
