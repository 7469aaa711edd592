"""Diagnoses of the LiDAR: packets, senders, the sensor's clock."""

from __future__ import annotations

from collections.abc import Iterator

from instant_ic.lidar.feed import PacketFeed
from instant_ic.lidar.flatscan import coverage
from instant_ic.lidar.packets import LASERS, PacketError, decode_position_packet
from instant_ic.lidar.stream import Revolution
from instant_ic.util.diagnosis import Diagnosis, Level
from instant_ic.util.repeats import RepeatWatch

_SILENT = {
    "topic": "no /lidar/packets for {silent_s:.1f} s. Check the bag player.",
    "pcap": "{where} has ended",
    "udp": "no packet on UDP {where} for {silent_s:.1f} s. Check that the sensor is on and sends to this host, that "
    "this host is in its network (factory: 192.168.1.201), that no firewall blocks it, and that "
    "net.ipv4.conf.*.rp_filter is 0.",
}
"""Messages to the operator when no packets arrive, by source."""
_LEAST_RETURNS = 0.01
"""Share of rays with a return below which the sensor counts as covered. The ground alone gives more."""
_LEAST_BLOCKED_DEG = 5.0
"""A smaller sector without blocks is not reported; two blocks at 1200 rpm take 1.6 degrees."""
_VIEW = "The sensor measures {view} degrees only, clockwise from ahead"
_UNSEEN = _VIEW + ". The robot does not see elsewhere: do not turn or reverse there."
_TOO_SMALL = (
    _VIEW
    + ", of the {wanted} that the driver expects. No scan: the robot has stopped. Set the sensor's field of view to 0 "
    "to 359 on its web page. If the rest may stay unseen, set vlp16_driver decoder.fov_start_deg and "
    "decoder.fov_end_deg."
)
_PPS = ("absent", "synchronising", "locked", "error")


class LidarReport:
    """Counters and diagnoses of losses, silence and doubtful senders.

    Attributes:
        skipped: revolutions that the node had no time for.
        partial: incomplete revolutions, which gave no scan.
        withheld: revolutions that could not be trusted.
        blind: True if the newest revolution measured almost nothing.
    """

    def __init__(self, feed: PacketFeed) -> None:
        self.skipped = self.partial = self.withheld = 0
        self.blind = False
        self._feed = feed
        self._repeats = RepeatWatch()
        self._reported = (0, 0, 0)
        self._covered = True
        self._partial_reported = 0

    def trusts(self, revolution: Revolution, steady_ns: int) -> bool:
        """Return whether a revolution may be published; copies and revolutions of a doubtful sender are withheld."""
        # Without a scan the robot stops. With a forged or an old scan it could drive into a wall.
        points = revolution.points
        new = self._repeats.is_new(*(points[name].tobytes() for name in ("x", "y", "z", "intensity")))
        trusted = self._feed.sources.doubt(steady_ns) is None and (new or len(points) == 0)
        self.withheld += not trusted
        return trusted

    def capture_restarts(self) -> None:
        """Accept the data of a capture again when it is played again."""
        self._repeats.forget()

    def covers(self, revolution: Revolution, min_coverage: float) -> bool:
        """Return whether a revolution gives a scan. An incomplete one counts as partial, and a blind one gives none."""
        # A half-blind scan would mislead map matching, and does not itself show the fault to other nodes.
        covered = coverage(revolution, self._feed.stream.config.blocked) >= min_coverage
        if covered or revolution.complete:
            self._covered = covered
        self.partial += not covered
        # Without returns, the way would seem free.
        self.blind = len(revolution.points) < _LEAST_RETURNS * LASERS * len(revolution.firing_azimuth)
        return covered and not self.blind

    def position(self, payload: bytes) -> Diagnosis:
        """Return a diagnosis of the sensor's clock from a position packet."""
        try:
            position = decode_position_packet(payload)
        except PacketError as error:
            return Diagnosis("position", Level.WARN, str(error))
        pps = _PPS[position.pps] if position.pps < len(_PPS) else str(position.pps)
        return Diagnosis("position", Level.OK, f"pulse per second {pps}", {"nmea": position.nmea})

    def source(self, steady_ns: int) -> Diagnosis:
        """Return a diagnosis of the sender: one sender, packets in order, each revolution a new one."""
        doubt, sources = self._feed.sources.doubt(steady_ns), self._feed.sources
        if doubt is None and self._repeats.copies and not self.blind:
            doubt = "the sensor repeats the same revolution. No scan: the robot has stopped. Restart the sensor."
        values = {"foreign": sources.foreign, "withheld": self.withheld}
        return Diagnosis("source", Level.ERROR if doubt else Level.OK, doubt or "one sender, in order", values)

    def check(self, steady_ns: int, silence_s: float, source: str, where: str) -> Iterator[Diagnosis]:
        """Yield the diagnoses of sender, view and packets since the last call.

        Args:
            steady_ns: steady time.
            silence_s: time without a packet that counts as an error.
            source: as in `Vlp16DriverConfig`.
            where: address or file of the source.
        """
        yield self.source(steady_ns)
        if self._feed.stream.counters.revolutions:
            yield self._view()
        stream, counters = self._feed.stream, self._feed.stream.counters
        losses = (counters.missing, counters.bad, self.skipped)
        new = [now - before for now, before in zip(losses, self._reported, strict=True)]
        self._reported = losses
        values = {
            "packets": counters.packets,
            "revolutions": counters.revolutions,
            "missing": counters.missing,
            "late": counters.late,
            "bad": counters.bad,
            "clock_resets": counters.clock_resets + stream.clock.resets,
            "revolutions_skipped": self.skipped,
            "revolutions_partial": self.partial,
        }
        silent_s = (steady_ns - self._feed.last_ns) * 1e-9
        level, text = Level.OK, "receiving packets"
        if silent_s > silence_s:
            level, text = Level.ERROR, _SILENT[source].format(where=where, silent_s=silent_s)
        elif not counters.packets:
            level, text = Level.WARN, "no packet yet"
        elif self.blind:
            level, text = (
                Level.ERROR,
                "the sensor measures almost nothing. No scan: the robot has stopped. Uncover the sensor.",
            )
        elif any(new):
            level = Level.WARN
            text = (
                f"in the last second {new[0]} packets missing, {new[1]} not from a VLP-16, {new[2]} revolutions skipped"
            )
            text += f" ({counters.bad_reason})" if new[1] else ""
        else:
            partial, self._partial_reported = self.partial - self._partial_reported, self.partial
            if partial:
                text += f"; {partial} incomplete revolutions gave no scan"
        yield Diagnosis("packets", level, text, values)

    def _view(self) -> Diagnosis:
        """Return a diagnosis of the field of view, which can explain a missing scan although all packets arrive."""
        stream = self._feed.stream
        blocked = stream.head.blocked
        if blocked is None or blocked.width < 100.0 * _LEAST_BLOCKED_DEG:
            return Diagnosis("view", Level.OK, "the sensor measures all around")
        view = f"{blocked.end / 100.0:.0f} to {blocked.start / 100.0:.0f}"
        if self._covered:
            return Diagnosis("view", Level.WARN, _UNSEEN.format(view=view))
        wanted = f"{stream.config.fov_start_deg:.0f} to {stream.config.fov_end_deg:.0f}"
        return Diagnosis("view", Level.ERROR, _TOO_SMALL.format(view=view, wanted=wanted))
