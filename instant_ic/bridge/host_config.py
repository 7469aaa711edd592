"""Parameters of the node ``host_bridge``."""

from __future__ import annotations

from dataclasses import dataclass, field

from instant_ic.bridge.host_link import HostLinkError, check_endpoint
from instant_ic.bridge.host_session import LinkTimes
from instant_ic.bridge.host_topics import parse_rules
from instant_ic.config.ranges import Positive, check_ranges


@dataclass(frozen=True)
class HostBridgeConfig:
    """Parameters.

    Attributes:
        listen: on the robot: address to listen on, tcp://0.0.0.0:7450.
        connect: at the station: address of the robot, tcp://ADDRESS:7450.
        peer: at the station: name of the robot among the allowed hosts; empty: the only allowed host.
        keys: key folder; empty: $XDG_CONFIG_HOME/instant_ic/keys.
        driver: on the robot: host that drives; empty: the first driver that connects, until it leaves.
        max_offset_ms: ms; clock offset between the hosts above which the bridge warns.
        to_station: topics that the robot sends, one per line (form: docs/bridge.md).
        to_robot: topics that a station sends; not /cmd_vel, which only the arbiter publishes.
    """

    listen: str = ""
    connect: str = ""
    peer: str = ""
    keys: str = ""
    driver: str = ""
    max_offset_ms: Positive = 50.0
    link: LinkTimes = field(default_factory=LinkTimes)
    to_station: tuple[str, ...] = ()
    to_robot: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_ranges(self)
        if bool(self.listen) == bool(self.connect):
            raise ValueError("one of listen (on the robot) and connect (at the station) must be given, not both")
        try:
            check_endpoint(self.listen or self.connect, listening=bool(self.listen))
        except HostLinkError as error:
            raise ValueError(f"{'listen' if self.listen else 'connect'}: {error}") from None
        for key in ("to_station", "to_robot"):
            try:
                parse_rules(getattr(self, key))
            except ValueError as error:
                raise ValueError(f"{key}: {error}") from None
        if not self.to_station and not self.to_robot:
            raise ValueError("to_station and to_robot are empty: give --params-file config/bridge.yaml")
