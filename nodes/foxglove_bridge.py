"""Serves topics and parameters to Foxglove, to view; forwards unchanged bytes, only of subscribed topics."""

from __future__ import annotations

import threading
import time

from instant_ic.bridge.foxglove_server import FoxgloveBridgeConfig, FoxgloveError, FoxgloveServer
from instant_ic.bus import OK, WARN, Node, NodeError, main
from instant_ic.bus.registry import TopicWatch
from instant_ic.util.diagnosis import RecentCount
from instant_ic.util.paths import sign_in_file
from instant_ic.util.web_access import AccessError, is_loopback, offer_sign_in

_LOOK_S, _LEAST_S = 0.25, 0.02
REFUSED_S = 10.0  # time for which a refusal remains a warning


class FoxgloveBridgeNode(Node[FoxgloveBridgeConfig]):
    """Watches the registry and forwards subscribed topics."""

    name = "foxglove_bridge"
    server: FoxgloveServer | None = None

    def setup(self) -> None:
        config = self.config
        if self.run_dir is None:
            raise NodeError("the bridge needs the real bus: it cannot run in lockstep")
        self._watch = TopicWatch(self.run_dir)
        try:
            self.server = FoxgloveServer(self, self.run_dir, config)
        except FoxgloveError as error:
            raise NodeError(str(error)) from None
        address = f"ws://{config.host}:{self.server.port}"
        self.log.info("Foxglove: open %s", address)
        file = sign_in_file(self.run_dir, self.node_name)
        file.unlink(missing_ok=True)  # left by a bridge that was killed
        if self.server.token:
            try:
                offer_sign_in(f"{address}/?token={self.server.token}", file)
            except AccessError as error:
                raise NodeError(str(error)) from None
        local = is_loopback(config.host)
        if not self.server.token and not (config.simulated and local):
            text = f"anyone who reaches {config.host}:{self.server.port} can read everything, because sign_in is never"
            self.diagnose("access", WARN, text)
        elif not local:
            self.diagnose("access", WARN, "token and data go over the network unencrypted; use a tunnel (ssh -L)")
        self._refused = RecentCount(REFUSED_S)
        # Use a thread, because timers on simulated time may stand still while messages already arrive.
        self._look_thread = threading.Thread(target=self._look, name="discovery", daemon=True)
        self._look_thread.start()

    def _look(self) -> None:
        assert self.server is not None
        while not self.stopping:
            self.server.wake.wait(_LOOK_S)
            self.server.wake.clear()
            self.call_soon(self.reconcile)
            time.sleep(_LEAST_S)  # limits the cost of a viewer that connects and disconnects without end

    def reconcile(self) -> None:
        """Update the offered topics to the present topics and viewers."""
        server = self.server
        if server is None or self.stopping:
            return
        server.reconcile(self._watch.topics())
        counts = {"messages": server.count, "dropped": server.dropped}
        self.diagnose("topics", OK, f"{len(server.watched)} of {len(server.topics)} topics watched", **counts)
        if server.refused:
            lately = self._refused.rise(server.refused, time.monotonic_ns())
            text = f"refused: {server.refusal}" if lately else "nobody refused lately"
            self.diagnose("door", WARN if lately else OK, text, requests=server.refused)

    def teardown(self) -> None:
        if self.server is not None:
            self.server.wake.set()
            self._look_thread.join(2.0)
            self.server.close()
            if self.run_dir is not None:
                sign_in_file(self.run_dir, self.node_name).unlink(missing_ok=True)


if __name__ == "__main__":
    main(FoxgloveBridgeNode)
