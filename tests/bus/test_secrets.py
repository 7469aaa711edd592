"""A password in an address: what a node shows of itself, to the registry, bags, viewers and the log, masks it."""

from dataclasses import dataclass

from local_bus import wait_for

from instant_ic.bus import RELIABLE, WARN, Node
from instant_ic.bus.clock import SystemClock
from instant_ic.config.parameter_info import parameter_infos
from instant_ic.config.params import flatten
from instant_ic.msg import deserialize

URL, SHOWN = "rtsp://me:secret@10.0.0.7/live", "rtsp://me:***@10.0.0.7/live"


@dataclass(frozen=True)
class StreamConfig:
    """Attributes:
    url: address of a stream.
    others: more of them.
    """

    url: str = URL
    others: tuple[str, ...] = (URL,)


def test_fault_the_password_of_an_address_goes_to_registry_bag_diagnostics_and_log(bus):
    node = Node[StreamConfig](StreamConfig(), bus.node("camera"), SystemClock(), "camera")
    reader = bus.reader("/rosout", RELIABLE, type_name="rcl_interfaces/msg/Log")
    node.start()
    shown = flatten(node.describe()["params"])
    assert (shown["url"], shown["others"]) == (SHOWN, (SHOWN,))
    infos = {info.name: info.value for info in parameter_infos(StreamConfig, StreamConfig())}
    assert infos == {"url": SHOWN, "others": [SHOWN]}
    node.diagnose("stream", WARN, f"{URL}: no frames")
    node.callbacks.fault("stream reader", ValueError(f"{URL} is gone"))
    assert "secret" not in str(node.diagnoses()) and SHOWN in str(node.diagnoses())
    wait_for(lambda: node.publishers[0].subscriber_count)
    node.log.warning("cannot open %s", URL)
    received = wait_for(reader.poll)
    logs = [deserialize(one.payload, one.type_name).msg for one in received]
    assert any(SHOWN in text for text in logs) and not any("secret" in text for text in logs)
    assert node.config.url == URL  # the node itself has it
