"""Two sessions over a simulated link: bandwidth, delay, jitter, stalls, clocks that differ; no sockets, no waiting."""

import heapq
import itertools
import random

from instant_ic.bridge.commands import COMMANDS
from instant_ic.bridge.host_flow import Channel, Item
from instant_ic.bridge.host_session import Arrived, LinkTimes, PeerMemory, Session, Side
from instant_ic.bridge.host_topics import TopicRule

DIGEST = "0011223344556677"
STRING = "std_msgs/msg/String"
MS = 1_000_000


class SimulatedClocks:
    """Clocks of one host: ``mono`` and ``wall`` are what they are ahead of the simulation's time."""

    def __init__(self, world, mono_ns=0, wall_ns=0):
        self.world, self.mono_ahead, self.wall_ahead = world, mono_ns, wall_ns

    def mono_ns(self):
        return self.world.now + self.mono_ahead

    def wall_ns(self):
        return self.world.now + self.wall_ahead

    def epoch_ns(self):
        return self.wall_ahead - self.mono_ahead


class Way:
    """One direction: first in, first out, ``rate`` bytes a second, then ``delay_ns`` and up to ``jitter_ns`` more."""

    def __init__(self, delay_ns=0, rate=float("inf"), jitter_ns=0, seed=1):
        self.delay_ns, self.rate, self.jitter_ns = delay_ns, rate, jitter_ns
        self.random = random.Random(seed)
        self.free_ns = self.last_ns = self.stalled_until = 0

    def arrival(self, now, size):
        begin = max(now, self.free_ns, self.stalled_until)
        self.free_ns = begin + int(size / self.rate * 1e9)
        jitter = int(self.random.random() * self.jitter_ns)
        self.last_ns = max(self.last_ns, self.free_ns + self.delay_ns + jitter)
        return self.last_ns


class World:
    """A robot (listens) and a station (connects)."""

    def __init__(self, to_station=(), to_robot=(), down=None, up=None, station_ahead_ns=0, mono_ahead_ns=0, times=None):
        self.now = 1_000_000_000
        self.ways = {"robot": down or Way(), "station": up or Way()}
        self.clocks = {
            "robot": SimulatedClocks(self, 0, 1_700_000_000_000_000_000),
            "station": SimulatedClocks(self, mono_ahead_ns, 1_700_000_000_000_000_000 + station_ahead_ns),
        }
        self.rules = {"robot": {r.topic: r for r in to_station}, "station": {r.topic: r for r in to_robot}}
        self.memories = {"robot": PeerMemory(), "station": PeerMemory()}
        self.times = times or LinkTimes()
        self.numbers = itertools.count(1)
        self.channels = {}
        self.items = []
        self.orders = itertools.count()
        self.connect()

    def connect(self, not_wanted=()):
        self.flying = []
        self.events = {"robot": [], "station": []}
        self.sessions = {}
        for name, connecting, imports in (("robot", False, "station"), ("station", True, "robot")):
            wanted = {topic: rule for topic, rule in self.rules[imports].items() if topic not in not_wanted}
            side = Side(name, f"{name}-1", wanted, lambda type_name: DIGEST)
            self.sessions[name] = Session(side, connecting, self.memories[name], self.clocks[name], self.times)
        self.sessions["robot"].drives = True

    def publish(self, who, topic, payload, latched=False, queued=False, origin="node", publish_ns=None, kind=None):
        channel = self.channels.get((topic, origin))
        if channel is None:
            qos = "latched" if latched else "reliable" if queued else "sensor"
            rule = self.rules[who].get(topic, TopicRule(topic))
            kind = kind or COMMANDS.get(topic, STRING)
            channel = Channel(next(self.numbers), rule, origin, kind, DIGEST, qos, latched, queued)
            self.channels[topic, origin] = channel
        channel.sequence += 1
        stamp = self.clocks[who].wall_ns() if publish_ns is None else publish_ns
        item = Item(payload, stamp, self.clocks[who].mono_ns(), channel.sequence)
        self.items.append(item)
        self.sessions[who].offer(channel, item)

    def run(self, seconds, step_ns=MS, each=None):
        """Goes on in steps; ``each(now_ns)`` may publish."""
        end = self.now + int(seconds * 1e9)
        while self.now < end:
            self.now += step_ns
            if each is not None:
                each(self.now)
            for _ in range(3):
                self.exchange()

    def exchange(self):
        while self.flying and self.flying[0][0] <= self.now:
            _, _, receiver, data = heapq.heappop(self.flying)
            for event in self.sessions[receiver].receive(data):
                self.events[receiver].append((self.now, event))
        for sender, receiver in (("robot", "station"), ("station", "robot")):
            session = self.sessions[sender]
            self.events[sender] += [(self.now, event) for event in session.check()]
            for data in session.outgoing():
                heapq.heappush(
                    self.flying, (self.ways[sender].arrival(self.now, len(data)), next(self.orders), receiver, data)
                )

    def arrived(self, who, topic=None):
        """(time, Arrived) of a host."""
        return [
            (now, event)
            for now, event in self.events[who]
            if isinstance(event, Arrived) and topic in (None, event.announce.topic)
        ]
