"""Diagnoses of a node's topics: what has grown lately is a warning, with its cause; a total since the start is none."""

from local_bus import numbered, wait_for

from instant_ic.bus import ERROR, OK, WARN, Node
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.flow_report import START_UP_S, FlowReport
from instant_ic.bus.transport import PublisherStats, Stats

S = 10**9


class Topic:
    """A topic's counts, and what a node that started at 100 s reports of them."""

    def __init__(self):
        self.stats, self.sent = Stats(), PublisherStats()
        self.report = FlowReport(100 * S)

    def at(self, second):
        """Level and text of the input, at a time after the start."""
        found = list(self.report.input("/x", self.stats, {}, int((100 + second) * S)))
        return (found[0].level, found[0].text) if found else None

    def output_at(self, second):
        found = list(self.report.output("/y", self.sent, int((100 + second) * S)))
        return (found[0].level, found[0].text) if found else None


def test_fault_losses_of_the_start_up_are_a_warning_for_the_whole_drive():
    topic = Topic()
    assert topic.at(1) is None
    topic.stats.lose("vlp16_driver", 12)  # while the node loads its network
    assert topic.at(2)[0] == OK
    topic.stats.lose("vlp16_driver", 5)
    assert [topic.at(second)[0] for second in (START_UP_S - 0.5, START_UP_S + 0.5, 60, 3600)] == [OK] * 4
    (diagnosis,) = topic.report.input("/x", topic.stats, {"rate_hz": 9.9}, 3700 * S)
    assert diagnosis.name == "input /x" and diagnosis.text == "nothing lost in the last 10 s"
    assert diagnosis.values == {
        "lost": 17, "lost from vlp16_driver": 17, "refused": 0, "overwritten": 0, "rate_hz": 9.9,
    }  # fmt: skip


def test_a_loss_during_the_drive_is_a_warning_with_its_cause_until_it_has_not_grown_for_10_s():
    topic = Topic()
    topic.stats.lose("vlp16_driver", 17)
    assert topic.at(10)[0] == OK
    topic.stats.lose("vlp16_driver", 3)
    cause = "this node or the machine is too slow, see ic top"
    assert topic.at(100) == (WARN, f"in the last 10 s messages lost (3 of vlp16_driver): {cause}")
    topic.stats.lose("grid_slam", 1)
    assert "(1 of grid_slam, 3 of vlp16_driver)" in topic.at(109)[1]
    assert "(1 of grid_slam)" in topic.at(111)[1]
    assert topic.at(120)[0] == OK


def test_refused_and_overwritten_messages_are_an_error_with_the_cause_while_they_come():
    topic = Topic()
    topic.stats.rejected, topic.stats.rejected_why = 2, "node a sends std_msgs/msg/Bool, std_msgs/msg/String expected"
    level, text = topic.at(20)
    assert level == ERROR and text.endswith(f"2 messages refused: {topic.stats.rejected_why}")
    assert topic.at(31)[0] == OK
    topic.stats.overwritten = 1
    level, text = topic.at(40)
    assert level == ERROR and "1 messages overwritten in use" in text and "refused" not in text
    assert topic.at(51)[0] == OK


class Once(Node[None]):
    """Fails at its first message."""

    def setup(self):
        self.broken = True
        self.subscribe_received("/x", self.on_message)

    def on_message(self, _):
        if self.broken:
            raise ValueError("the first one")


def test_an_exception_of_the_start_up_is_no_error_once_the_callback_has_worked_for_10_s(bus, monkeypatch):
    node, out = Once(None, bus.node("reader"), SystemClock(), "reader"), bus.publisher()
    node.start()
    wait_for(lambda: out.subscriber_count == 1)

    def send():
        out.send(numbered(1))
        wait_for(node.spin_once)

    send()
    (name,) = node.diagnoses()
    assert node.diagnoses()[name][:2] == (ERROR, "ValueError: the first one")
    node.broken = False
    send()
    assert node.diagnostics.worst[0] == ERROR  # it has worked only now
    monkeypatch.setattr("instant_ic.bus.callbacks.RECENT_S", 0.0)
    send()
    assert node.diagnoses()[name] == (OK, "no exception in the last 0 s", {"faults": 1})
