"""Documented safety defaults are those of the code; overriding one value of a group leaves its others as they are."""

import pytest

from instant_ic.bus.lockstep import LockstepBus
from instant_ic.config import params
from instant_ic.config.parameter_info import parameter_infos
from nodes.arbiter import ArbiterNode

CONFIG = ArbiterNode.config_class()
EXPECTED = {
    "collision_monitor.stop.action_type": "stop",
    "collision_monitor.slowdown.action_type": "slowdown",
    "collision_monitor.limit.action_type": "limit",
    "collision_monitor.limit.enabled": False,
    "collision_monitor.approach.action_type": "approach",
}


def test_described_defaults_of_the_collision_monitor_are_those_that_hold():
    described = {info.name: info.default for info in parameter_infos(CONFIG)}
    assert {key: described[key] for key in EXPECTED} == EXPECTED


def test_a_running_arbiter_describes_the_defaults_and_values_that_hold():
    node = LockstepBus().add(ArbiterNode)
    described = {info.name: info for info in node.parameters.infos()}
    assert {key: described[key].default for key in EXPECTED} == EXPECTED
    assert {key: described[key].value for key in EXPECTED} == EXPECTED


@pytest.mark.parametrize(
    ("word", "group", "action_type", "enabled"),
    [
        ("collision_monitor.stop.padding_m:=0.05", "stop", "stop", True),
        ("collision_monitor.slowdown.slowdown_ratio:=0.5", "slowdown", "slowdown", True),
        ("collision_monitor.limit.linear_limit:=0.2", "limit", "limit", False),
    ],
)
def test_overriding_one_value_of_a_polygon_keeps_its_action(word, group, action_type, enabled):
    key, value = params.parse_override(word)
    polygon = getattr(params.build(CONFIG, {key: value}).collision_monitor, group)
    assert (polygon.action_type, polygon.enabled) == (action_type, enabled)
