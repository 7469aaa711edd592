"""Absurd safety values are refused by every check, with what was meant; protection that is off warns permanently."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from base_line import NodeBench
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.base.config import RoboclawConfig
from instant_ic.bus import OK, WARN, ParameterError
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.bus.node_files import node_class
from instant_ic.config import params
from instant_ic.config.ranges import Plausible
from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.launch import read_launch_file
from instant_ic.launch.parameters import check_parameters

ABSURD = [
    ("arbiter", "footprint.length_m:=0.001", r"footprint.length_m must lie in 0.1..3 \(got 0.001\); did you mean 0.1"),
    ("arbiter", "footprint.width_m:=500", "did you mean 0.5?"),
    ("arbiter", "limits.max_linear_m_s:=50", r"must lie in 0.02..3 \(got 50\); did you mean 0.5\?"),
    ("arbiter", "timeouts.scan:=300", r"timeouts.scan must lie in 0.05..2 \(got 300\); did you mean 0.3\?"),
    ("arbiter", "collision_monitor.approach.min_points:=20", r"did you mean 2\?"),
    ("arbiter", "collision_monitor.blind_radius_m:=450", r"did you mean 0.45\?"),
    ("arbiter", "pose_trust.stop:=1.0", "pose_trust.stop must lie in"),
    ("crawler_base", "limits.hard_decel_m_s2:=0.01", "hard_decel_m_s2 must lie in"),
    ("crawler_base", "command_timeout_s:=250", r"did you mean 0.25\?"),
    ("crawler_base", "geometry.track_width:=400", r"did you mean 0.4\?"),
    ("crawler_base", "roboclaw.retries:=1000", "retries must lie in"),
    ("virtual_robot", "state_timeout_s:=1e6", "state_timeout_s must lie in"),
    ("navigator", "costmap_timeout_s:=10", r"did you mean 1\?"),
    ("vlp16_driver", "scan.min_height:=1", r"did you mean 0.1\?"),
    ("vlp16_driver", "lidar_mount.xyz:=[0, 0, 60]", r"xyz\[2\] must lie in -5..5 \(got 60\); did you mean 0.6\?"),
    ("theta_camera", "theta.latency_s:=200", "theta.latency_s must lie in"),
    ("console", "server.drive.watchdog_s:=250", r"did you mean 0.25\?"),
]


def configured(node: str, *words: str) -> Any:
    return params.configure(node_class(node).config_class(), dict(map(params.parse_override, words)))[0]


@pytest.mark.parametrize(("node", "word", "text"), ABSURD, ids=[f"{node} {word}" for node, word, _ in ABSURD])
def test_an_absurd_value_is_refused_and_the_error_says_what_may_be_meant(node: str, word: str, text: str) -> None:
    with pytest.raises(ParameterError, match=text):
        configured(node, word)


COMBINED = [
    (("limits.max_linear_m_s:=3", "limits.max_linear_accel_m_s2:=0.5"), "must stop the robot from max_linear_m_s"),
    (
        ("limits.max_linear_m_s:=1.5", "limits.max_linear_accel_m_s2:=2", "timeouts.scan:=1"),
        "timeouts.scan must be at most 0.67 s",
    ),
    (("limits.max_angular_rad_s:=6", "limits.max_angular_accel_rad_s2:=0.2"), "must stop .* within half a turn"),
    (("limits.max_linear_m_s:=2",), "time_before_collision must be at least 2.5 s, to brake"),
    (
        (
            "limits.max_linear_m_s:=2",
            "costmap.obstacle_max_range:=1",
            "collision_monitor.approach.time_before_collision:=3",
        ),
        "must stop the robot within 1 m",
    ),
    (("collision_monitor.stop.enabled:=false",), "collision_monitor.stop: protection is off"),
    (
        ("costmap.points.obstacle_min_range:=2", "costmap.points.obstacle_max_range:=1"),
        "obstacle_min_range must be below obstacle_max_range",
    ),
    (("costmap.points.enabled:=false",), r"costmap\.points\.enabled: protection is off"),
    (("collision_monitor.blind_radius_m:=0",), r"collision_monitor\.blind_radius_m: protection is off"),
    (("collision_monitor.memory_range_m:=0",), r"collision_monitor\.memory_range_m: protection is off"),
    (
        ("collision_monitor.stop.enabled:=false", "collision_monitor.approach.enabled:=false"),
        "collision_monitor.stop, collision_monitor.approach: protection is off, .* or set unprotected: true",
    ),
]


@pytest.mark.parametrize(("words", "text"), COMBINED)
def test_values_that_do_not_go_together_are_refused(words: tuple[str, ...], text: str) -> None:
    with pytest.raises(ParameterError, match=text):
        configured("arbiter", *words)


def test_the_bases_time_outs_are_below_the_controllers_watchdog() -> None:
    for word in ("command_timeout_s:=0.4", "roboclaw.reply_timeout_s:=0.4"):
        with pytest.raises(ParameterError, match=r"must be at most roboclaw\.watchdog_s = 0\.3 s"):
            configured("crawler_base", word)


@pytest.mark.parametrize("size", [(0.2, 0.15, 0.2, 0.5, 0.3), (0.6, 0.5, 0.5, 1.0, 0.8), (2.0, 1.5, 3.0, 3.0, 4.0)])
def test_small_and_large_robots_pass(size: tuple[float, ...]) -> None:
    names = ("footprint.length_m", "footprint.width_m", "limits.max_linear_m_s", "limits.max_angular_rad_s")
    shared = [f"{name}:={value}" for name, value in zip((*names, "limits.max_linear_accel_m_s2"), size, strict=True)]
    configured("arbiter", *shared)
    configured("navigator", *shared)
    configured("virtual_robot", *shared)
    configured("crawler_base", *shared[2:])


@given(st.floats() | st.integers())
def test_a_guess_is_a_value_that_passes(value: float) -> None:
    bounds = Plausible(0.05, 3)
    if value not in bounds and (guess := bounds.refusal(value).partition("did you mean ")[2]):
        assert float(guess.rstrip("?")) in bounds


def test_protection_that_is_off_warns_as_long_as_it_is_off() -> None:
    off = replace(ArbiterConfig().collision_monitor.stop, enabled=False)
    monitor = replace(ArbiterConfig().collision_monitor, stop=off)
    with LockstepBus() as bus:
        arbiter = bus.add(node_class("arbiter"), ArbiterConfig(collision_monitor=monitor, unprotected=True))
        for _ in range(3):
            bus.advance(2.0)
            level, text = state_of(arbiter, "protection")
            assert level == WARN and "Protection is off (collision_monitor.stop)" in text
        arbiter.parameters.set({"collision_monitor.stop.enabled": True})
        assert state_of(arbiter, "protection")[0] == OK
        arbiter.parameters.set({"collision_monitor.stop.enabled": False})
        assert state_of(arbiter, "protection")[0] == WARN
    with LockstepBus() as bus:
        arbiter = bus.add(node_class("arbiter"), ArbiterConfig())
        with pytest.raises(ParameterError, match="protection is off"):
            arbiter.parameters.set({"collision_monitor.stop.enabled": False})
        with pytest.raises(ParameterError, match=r"did you mean 0.3\?"):
            arbiter.parameters.set({"timeouts.scan": 300})


def test_a_base_that_obeys_anybody_warns_and_needs_a_word() -> None:
    for word in ('command_source:=""', "accept_unstamped:=true"):
        with pytest.raises(ParameterError, match="protection is off, so commands of any node or of any age"):
            configured("crawler_base", word)
    bench = NodeBench(command_source="", unprotected=True)
    bench.run(1.0)
    assert bench.diagnosis("protection")[0] == WARN


def test_a_base_without_a_stop_button_warns() -> None:
    bench = NodeBench(roboclaw=RoboclawConfig(port="memory", estop_pin=""))
    bench.run(1.0)
    level, text = bench.diagnosis("button")
    assert level == WARN and "No stop button" in text


def state_of(node: Any, name: str) -> tuple[int, str]:
    return node.diagnoses()[name][:2]


STACK = """launch:
- node: {{exec: arbiter, param: [{{from: arbiter.yaml}}]}}
- node: {{exec: crawler_base, param: [{{from: base.yaml}}]}}
- node: {{exec: console}}
- node: {{exec: vlp16_driver}}
"""
TOGETHER = [
    (
        "limits: {max_linear_m_s: 0.4}",
        "rate_hz: 30.0",
        "node crawler_base: limits.max_linear_m_s is 0.5, but 0.4 in",
    ),
    ("footprint: {width_m: 0.3}", "rate_hz: 30.0", "geometry.track_width must be within footprint.width_m 0.3"),
    ("rate_hz: 5", "rate_hz: 30.0", "crawler_base: command_timeout_s must span 2 messages of arbiter: 0.4 s"),
    ("collision_monitor: {blind_radius_m: 0.3}", "rate_hz: 30.0", "vlp16_driver: decoder.min_range must be at most"),
    (
        "timeouts: {stop_after_s: 1.0}",
        "rate_hz: 30.0",
        "node console: server.drive.stop_after_s must be at most the arbiter's timeouts.stop_after_s = 1.0 s",
    ),
    ("timeouts: {command: 0.05}", "rate_hz: 30.0", "timeouts.command must span 2 messages of console"),
]


@pytest.mark.parametrize(("arbiter", "base", "text"), TOGETHER)
def test_nodes_that_drive_one_robot_agree(tmp_path: Path, arbiter: str, base: str, text: str) -> None:
    (tmp_path / "arbiter.yaml").write_text(f"arbiter:\n  ros__parameters:\n    {arbiter}\n")
    (tmp_path / "base.yaml").write_text(f"crawler_base:\n  ros__parameters:\n    {base}\n")
    (tmp_path / "stack.yaml").write_text(STACK.format())
    found = check_parameters(read_launch_file(tmp_path / "stack.yaml").nodes)
    assert any(text in problem for problem in found), found


DOORS = (
    ("console", "server.access.simulated"),
    ("foxglove_bridge", "simulated"),
    ("zenoh_gateway", "insecure_loopback_commands"),
)


@pytest.mark.parametrize(("node", "key"), DOORS)
def test_fault_a_door_that_is_open_as_for_a_simulator_drives_a_real_base(tmp_path: Path, node: str, key: str) -> None:
    open_door = f"- node: {{exec: {node}, param: [{{name: {key}, value: true}}]}}"
    for port, refused in (("/dev/ttyACM0", True), ("/run/user/1000/instant_ic/dev/roboclaw", False)):
        base = f"- node: {{exec: crawler_base, param: [{{name: roboclaw.port, value: {port}}}]}}"
        (tmp_path / "stack.yaml").write_text(f"launch:\n{base}\n{open_door}\n")
        found = check_parameters(read_launch_file(tmp_path / "stack.yaml").nodes)
        assert any(f"{key} is true, but crawler_base drives {port}" in problem for problem in found) == refused, found


def test_a_gateway_without_tls_beside_a_real_base_needs_a_word(tmp_path: Path) -> None:
    words = "{name: insecure_loopback_commands, value: true}, {name: unprotected, value: true}"
    text = f"launch:\n- node: {{exec: crawler_base}}\n- node: {{exec: zenoh_gateway, param: [{words}]}}\n"
    (tmp_path / "stack.yaml").write_text(text)
    assert not check_parameters(read_launch_file(tmp_path / "stack.yaml").nodes)


@pytest.mark.parametrize("order", [("true", "false"), ("false", "true")])
def test_fault_only_the_last_of_two_nodes_of_one_kind_is_compared(tmp_path: Path, order: tuple[str, str]) -> None:
    consoles = "".join(
        f"- node: {{exec: console, name: console{index}, param: [{{name: server.access.simulated, value: {value}}}]}}\n"
        for index, value in enumerate(order)
    )
    (tmp_path / "stack.yaml").write_text(f"launch:\n- node: {{exec: crawler_base}}\n{consoles}")
    found = check_parameters(read_launch_file(tmp_path / "stack.yaml").nodes)
    assert len(found) == 1 and f"stack.yaml:{3 + order.index('true')}: node console: server.access" in found[0], found


def test_overriding_one_value_of_a_polygon_keeps_its_others() -> None:
    slowdown = configured("arbiter", "collision_monitor.slowdown.slowdown_ratio:=0.5").collision_monitor.slowdown
    assert (slowdown.slowdown_ratio, slowdown.enabled, slowdown.padding_m) == (0.5, True, 0.10)
