"""Both gateways follow the registry by this."""

from live_nodes import Neighbour

from instant_ic.bus.registry import TopicWatch
from instant_ic.msg import Bool, String


def names(topics):
    return {t.topic: sorted((p.node, p.type_name) for p in t.publishers) for t in topics}


def test_it_tells_what_the_registry_tells_at_once_and_follows_changes(tmp_path_factory):
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
    finally:
        one.close()
        two.close()
