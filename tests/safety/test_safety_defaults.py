"""Documented safety defaults are those of the code; overriding one value of a group leaves its others as they are."""

from instant_ic.bus.lockstep import LockstepBus
from instant_ic.config import params
from instant_ic.config.parameter_info import parameter_infos
from nodes.arbiter import ArbiterNode

CONFIG = ArbiterNode.config_class()
EXPECTED = {
    "collision_monitor.stop.enabled": True,
    "collision_monitor.stop.padding_m": 0.02,
    "collision_monitor.slowdown.enabled": True,
    "collision_monitor.slowdown.padding_m": 0.10,
    "collision_monitor.approach.enabled": True,
    "collision_monitor.approach.padding_m": 0.04,
}


def test_defaults_of_the_collision_monitor_are_described_as_they_hold():
    node = LockstepBus().add(ArbiterNode)
    running = {info.name: info for info in node.parameters.infos()}
    described = {info.name: info.default for info in parameter_infos(CONFIG)}
    for key, value in EXPECTED.items():
        assert described[key] == running[key].default == running[key].value == value


def test_overriding_one_value_of_a_polygon_keeps_its_others():
    key, value = params.parse_override("collision_monitor.slowdown.slowdown_ratio:=0.5")
    slowdown = params.build(CONFIG, {key: value}).collision_monitor.slowdown
    assert (slowdown.slowdown_ratio, slowdown.enabled, slowdown.padding_m) == (0.5, True, 0.10)
