"""Both gateways follow the registry by this."""

import time

from live_nodes import Neighbour, wait_for

from instant_ic.bus import registry
from instant_ic.bus.registry import TopicWatch
from instant_ic.msg import Bool, String


def names(topics):
    return {t.topic: sorted((p.node, p.type_name) for p in t.publishers) for t in topics}


def test_it_tells_what_the_registry_tells_at_once_and_reads_it_seldom(tmp_path_factory, monkeypatch):
    run_dir = tmp_path_factory.mktemp("r")
    one, two = Neighbour(run_dir, "one"), Neighbour(run_dir, "two")
    try:
        watch = TopicWatch(run_dir)
        assert watch.topics() == []
        one.publisher("/a", String)
        assert names(watch.topics()) == {"/a": [("one", "std_msgs/msg/String")]}
        two.publisher("/a", Bool)
        assert names(watch.topics()) == {"/a": [("one", "std_msgs/msg/String"), ("two", "std_msgs/msg/Bool")]}
        two.node.drop(two.node.publishers[0])
        assert names(watch.topics()) == {"/a": [("one", "std_msgs/msg/String")]}
        time.sleep(0.1)  # a folder that just changed is read at every call
        watch.topics()
        monkeypatch.setattr(registry, "_FULL_LOOK_S", 1.0)
        looks = []
        real = registry._entries
        monkeypatch.setattr(registry, "_entries", lambda d: looks.append(d) or real(d))
        started = time.monotonic()
        folder = str(run_dir / "topics" / "a")
        wait_for(lambda: watch.topics() and looks.count(folder) == 2, "full looks though nothing changes")
        assert time.monotonic() - started > 0.5  # not at every call
    finally:
        one.close()
        two.close()
