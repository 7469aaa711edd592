"""A Zenoh router for a fleet on one machine and for tests; on a real site run zenohd, which is the same router."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from instant_ic.bridge.zenoh_session import ROUTER_DEFAULTS, ZenohError, load_config, open_zenoh
from instant_ic.bus import OK, Node, NodeError, main


@dataclass(frozen=True)
class ZenohRouterConfig:
    """Parameters.

    Attributes:
        listen: endpoints to listen on; empty uses those of the session file.
        session_file: Zenoh configuration (JSON5), a path or a file of config/; empty opens tcp/localhost:7447 to all.
    """

    listen: tuple[str, ...] = ()
    session_file: str = ""


class ZenohRouterNode(Node[ZenohRouterConfig]):
    """Holds the session; Zenoh does the rest."""

    name = "zenoh_router"
    session: Any = None

    def setup(self) -> None:
        try:
            config = load_config(self.config.session_file, (), self.config.listen, ROUTER_DEFAULTS)
            self.session = open_zenoh(config)
        except ZenohError as error:
            raise NodeError(str(error)) from None
        self.log.info("router %s", self.session.info.zid())
        self.timer(1.0, self.report)

    def report(self) -> None:
        info = self.session.info
        self.diagnose("link", OK, f"{len(info.peers_zid())} peers, {len(info.routers_zid())} other routers")

    def teardown(self) -> None:
        if self.session is not None:
            self.session.close()


if __name__ == "__main__":
    main(ZenohRouterNode)
