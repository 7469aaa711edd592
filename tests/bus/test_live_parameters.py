"""What the nodes declare as live is there, and takes effect where it is used."""

import numpy as np
import pytest

from instant_ic.bus import ParameterError
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.bus.node_files import node_class
from instant_ic.config.parameter_info import is_live, parameter_infos
from instant_ic.msg import image_message
from instant_ic.util.paths import node_names

NODES = node_names()


@pytest.mark.parametrize("name", NODES)
def test_live_parameters_exist(name):
    cls = node_class(name)
    keys = [info.name for info in parameter_infos(cls.config_class())]
    for entry in cls.live_parameters:
        assert any(is_live(key, [entry]) for key in keys), f"{entry} is no parameter of {name}"


@pytest.fixture
def bus():
    with LockstepBus() as bus:
        yield bus


def test_arbiter(bus):
    node = bus.add(node_class("arbiter"))
    arbiter = node.arbiter
    node.parameters.set({"switch.yaw_deg": 12.0, "prediction.latency_s": 0.3, "timeouts.scan": 0.4})
    assert node.arbiter is arbiter  # its mode and history stay
    assert arbiter.config.switch.yaw_deg == 12.0 and arbiter.config.timeouts.scan == 0.4
    assert arbiter.predictor.config.latency_s == 0.3
    with pytest.raises(ParameterError, match=r"footprint\.length_m takes effect at start"):
        node.parameters.set({"footprint.length_m": 0.7})
    with pytest.raises(ParameterError, match=r"timeouts\.scan must lie in 0.05..2 \(got 60\)"):
        node.parameters.set({"timeouts.scan": 60})  # a watchdog is not switched off by a parameter


def test_virtual_robot_is_slower_at_once(bus):
    node = bus.add(node_class("virtual_robot"))
    node.parameters.set({"limits": {"max_linear_m_s": 0.1}, "state_timeout_s": 0.2})
    assert node.robot.limits.max_linear_m_s == 0.1 and node.state.max_age_s == 0.2
    node.robot.place(np.zeros(3), (5.0, 0.0))
    assert node.robot.velocity[0] == pytest.approx(0.1)


def test_navigator(bus):
    node = bus.add(node_class("navigator"))
    node.parameters.set({"replan_period_s": 0.4, "follower.desired_linear_vel": 0.2})
    assert node.navigator.replan_period_s == 0.4 and node.navigator.follower.config.desired_linear_vel == 0.2


def test_depth_scaler(bus):
    node = bus.add(node_class("depth_scaler"))
    node.parameters.set({"scaler.min_points": 400, "keyframes.distance_m": 1.5})
    assert node.chain.source.config.scaler.min_points == 400 and node.chain.selector.config.distance_m == 1.5


def test_grid_slam(bus):
    node = bus.add(node_class("grid_slam"))
    node.parameters.set({"odom_wait_s": 0.3})
    assert node.queue.config.odom_wait_s == 0.3


def test_depth_estimator_takes_fewer_pictures(bus):
    node = bus.add(node_class("depth_estimator"))
    seen = []
    node.worker.submit = seen.append
    for index in range(10):  # 10 Hz
        node.on_image(image_message(np.zeros((2, 2), np.float32), "32FC1", "camera", 10**9 + index * 10**8))
    assert len(seen) == 2  # 2 Hz: at 0 and at 0.5 s
    node.parameters.set({"max_rate_hz": 5.0})
    for index in range(10, 20):
        node.on_image(image_message(np.zeros((2, 2), np.float32), "32FC1", "camera", 10**9 + index * 10**8))
    assert len(seen) == 2 + 5
