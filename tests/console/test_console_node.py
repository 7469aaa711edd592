"""The console node in lockstep: what goes to the page, and what comes from it to the bus."""

import dataclasses
import math

import numpy as np
import pytest

from instant_ic.bus.lockstep import LockstepBus
from instant_ic.cli.message_input import build
from instant_ic.console import FrameKind, Look, ViewConfig
from instant_ic.console.config import ConsoleConfig
from instant_ic.console.layers import PageLayer, PageLayers
from instant_ic.control.robot_lease import RELEASED
from instant_ic.geometry.poses import matrix_from_quaternion, pose_matrix
from instant_ic.msg import (
    ControlState,
    NodeStatus,
    RenderedView,
    VspaceStatus,
    compressed_image_message,
    grid_message,
    header,
    matrix_from_pose,
    message_type,
    odometry_message,
    path_message,
    pose_message,
    pose_stamped,
    stamp_ns,
    transform_message,
    twist_values,
)
from instant_ic.vspace.layer_mesh import LayerMesh
from nodes.console import ConsoleNode

START = 1_000_000_000
MS = 1_000_000


class FakeServer:
    """Keeps what the node sends, in place of sockets."""

    plain_http = False

    def __init__(self, clock):
        self.clock = clock
        self.texts, self.frames, self.shown = {}, [], None
        self.drawn, self.layers = None, []

    def now_ms(self):
        return self.clock.now_ns() / 1e6 + 5000.0

    def publish(self, kind, message):
        self.texts[kind] = message

    def send_frame(self, kind, header, payload):
        self.frames.append((kind, header, payload))

    def send_layers(self, layers):
        self.layers.append(layers)

    def drawn_ms(self):
        return self.drawn

    def needs_views(self):
        return self.drawn is None

    def show(self, *kinds):
        self.shown = kinds

    def follow_robot(self, holder, estop=False):
        self.robot = holder, estop

    def stop(self):
        pass


@pytest.fixture
def setup():
    with LockstepBus(START) as bus:
        node = bus.add(ConsoleNode, ConsoleConfig(view=ViewConfig(virtual_rate_hz=10)), page=FakeServer(bus.clock))
        yield bus, node, node.feed.server


def control(bus, mode, **values):
    """A ControlState of now."""
    shown = int(mode in (ControlState.VIRTUAL, ControlState.RETURNING))
    blank = build("ControlState", {"header": "auto", "mode": int(mode), "shown": shown}, bus.clock.now_ns())
    return dataclasses.replace(blank, **values)


def publish_tree(bus, x=1.0, y=2.0, yaw=math.pi / 2):
    """map → odom → base_link → camera."""
    now = bus.clock.now_ns()
    moving = [
        transform_message(pose_matrix(x=x), "map", "odom", now),
        transform_message(pose_matrix(y=y, yaw=yaw), "odom", "base_link", now),
    ]
    mount = [transform_message(pose_matrix(z=1.5), "base_link", "camera", now)]

    tf = message_type("TFMessage")
    bus.publish("/tf", tf(moving))
    bus.publish("/tf_static", tf(mount), latched=True)


def vspace_status(state):
    return build("VspaceStatus", {"state": int(state), "psnr_db": 27.5}, 0)


def view_message(bus, request_id, fov=1.8):
    return RenderedView(
        header=header("map", bus.clock.now_ns()),
        request_id=request_id,
        keyframe_id=1,
        pose=pose_message(pose_matrix(1, 2, 1.5, 0, 0, 0.3)),
        fov_rad=fov,
        width=320,
        height=180,
        confidence=0.9,
        render_ms=math.nan,
        image=compressed_image_message(b"VIEW", "map", bus.clock.now_ns()),
    )


def test_plain_http_on_a_network_address_is_a_fault_on_the_page(setup):
    _, node, server = setup
    node.feed.send_health()
    assert "network" not in [fault["name"] for fault in server.texts["health"]["faults"]]
    server.plain_http = True
    node.feed.send_health()
    (fault,) = [fault for fault in server.texts["health"]["faults"] if fault["name"] == "network"]
    assert fault["level"] == "warn" and "Plain HTTP" in fault["text"]


def test_command_and_emergency_stop_go_to_the_bus(setup):
    bus, node, _ = setup
    node.on_drive(0.3, -0.2)
    message = bus.last("/operator/cmd_vel")
    assert twist_values(message) == (0.3, -0.2)
    assert message.header.stamp.sec == 1
    assert bus.messages("/operator/estop") == []  # a restarted console must not release a stop
    node.on_estop(True)
    assert bus.last("/operator/estop").data is True
    node.on_estop(False)
    assert bus.last("/operator/estop").data is False


def test_a_command_names_the_page_that_drives_and_its_lease_is_given_back(setup):
    bus, node, _ = setup
    node.on_drive(0.3, 0.0)
    assert bus.last("/operator/cmd_vel").header.frame_id == node.server.drive.client
    node.on_released("page 1")
    assert bus.last("/operator/cmd_vel").header.frame_id == "page 1" + RELEASED
    assert twist_values(bus.last("/operator/cmd_vel")) == (0.0, 0.0)


def test_the_page_follows_the_robots_lease_and_emergency_stop(setup):
    bus, _, server = setup
    bus.publish("/ic/state", control(bus, ControlState.STOPPED, holder="console2/page 1", estop=True), latched=True)
    assert server.robot == ("console2/page 1", True)
    bus.advance(1.2)  # the arbiter is silent
    assert server.robot == (None, False)


def test_panorama_passes_as_it_came_with_the_cameras_heading_and_age(setup):
    bus, _, server = setup
    publish_tree(bus)
    stamp = bus.clock.now_ns()
    bus.advance(0.08)
    bus.publish("/camera/image/compressed", compressed_image_message(b"JPEG", "camera", stamp))
    kind, frame_header, payload = server.frames[-1]
    assert (kind, payload) == (FrameKind.PANORAMA, b"JPEG")
    assert frame_header["captured_ms"] == pytest.approx(server.now_ms() - 80.0)
    rotation = matrix_from_quaternion(frame_header["q"])[:3, :3]
    np.testing.assert_allclose(rotation[:, 0], [0, 1, 0], atol=1e-9)  # looks along the map's y


def test_state_tells_mode_poses_and_reason(setup):
    bus, _, server = setup
    publish_tree(bus)
    bus.publish("/ic/state", control(bus, ControlState.REAL, reason="why"), latched=True)
    bus.advance(0.06)
    state = server.texts["state"]
    assert (state["mode"], state["reason"]) == ("real", "why")
    assert state["robot"] == pytest.approx([1, 2, math.pi / 2], abs=1e-3)
    assert state["vbot"] is None
    assert server.shown == (FrameKind.PANORAMA,)


def test_silent_arbiter_is_no_mode(setup):
    bus, _, server = setup
    bus.publish("/ic/state", control(bus, ControlState.REAL), latched=True)
    bus.advance(0.5)
    assert server.texts["state"]["mode"] == "real"
    bus.advance(1.0)
    assert server.texts["state"]["mode"] == "none"


def test_virtual_mode_asks_for_the_view_from_the_vbot_where_the_operator_looks(setup):
    bus, node, server = setup
    publish_tree(bus)
    node.on_look(Look(yaw=-math.pi / 2, pitch=0.0, hfov=1.2, vfov=0.7))
    bus.publish("/ic/state", control(bus, ControlState.VIRTUAL), latched=True)
    vbot = odometry_message(pose_matrix(x=3.0, y=2.0, yaw=math.pi / 2), 0.3, 0.0, "map", "vbot", bus.clock.now_ns())
    bus.publish("/vbot/odom", vbot)
    bus.advance(0.06)
    request = bus.last("/view/request")
    map_from_camera = matrix_from_pose(request.pose)
    np.testing.assert_allclose(map_from_camera[:3, 3], [3, 2, 1.5], atol=1e-6)  # mount of /tf_static
    np.testing.assert_allclose(map_from_camera[:3, 0], [1, 0, 0], atol=1e-6)  # north, then 90° right: east
    assert request.fov_rad >= 1.2 * 1.15 - 1e-6
    assert server.shown == (FrameKind.VIEW,)
    assert server.texts["state"]["vbot"] == pytest.approx([3, 2, math.pi / 2], abs=1e-3)


def test_a_pose_that_is_no_number_costs_the_page_that_pose_alone(setup):
    bus, _, server = setup
    bad = build("Pose", {"position": {"x": math.nan}, "orientation": {"w": 1.0}}, 0)
    bus.publish("/ic/state", control(bus, ControlState.VIRTUAL, robot_pose=bad, vbot_pose=bad), latched=True)
    bus.publish("/ic/subgoal", build("PoseStamped", {"pose": {"orientation": {"w": math.nan}}}, 0))
    bus.advance(0.3)
    state = server.texts["state"]
    assert (state["mode"], state["robot"], state["vbot"]) == ("virtual", None, None)
    assert server.texts["plan"]["subgoal"] is None


def test_a_view_from_a_pose_that_is_no_number_is_not_shown_and_the_next_one_is(setup):
    bus, _, server = setup
    publish_tree(bus)
    bus.publish("/ic/state", control(bus, ControlState.VIRTUAL), latched=True)
    bus.advance(0.06)
    good = view_message(bus, bus.last("/view/request").id)
    bad = build("Pose", {"position": {"x": math.nan}, "orientation": {"w": 1.0}}, 0)
    bus.publish("/vspace/view", dataclasses.replace(good, pose=bad))
    assert FrameKind.VIEW not in {kind for kind, _, _ in server.frames}
    bus.publish("/vspace/view", good)
    assert server.frames[-1][0] == FrameKind.VIEW


def test_only_one_request_is_outstanding_and_the_rate_follows_the_answers(setup):
    bus, _, server = setup
    publish_tree(bus)

    def ask(seconds, answer, speed=0.0):
        before = len(bus.messages("/view/request"))
        for step in range(round(seconds / 0.05)):
            bus.publish("/ic/state", control(bus, ControlState.VIRTUAL), latched=True)
            pose = pose_matrix(x=0.05 * step * speed)
            bus.publish("/vbot/odom", odometry_message(pose, speed, 0.0, "map", "vbot", bus.clock.now_ns()))
            bus.advance(0.05)
            if answer:
                bus.publish("/vspace/view", view_message(bus, bus.last("/view/request").id))
        return len(bus.messages("/view/request")) - before

    assert ask(1.0, answer=False) in (2, 3)  # one each 0.5 s, by the time-out
    ask(0.6, answer=True)
    assert ask(1.0, answer=True, speed=0.3) in (9, 10, 11)
    _, frame_header, payload = next(f for f in server.frames if f[0] is FrameKind.VIEW)
    assert payload == b"VIEW"
    assert frame_header["fov"] == pytest.approx(1.8)
    assert frame_header["p"] == pytest.approx([1, 2, 1.5])


def virtual_state(bus, **values):
    return control(bus, ControlState.VIRTUAL, **({"shown": ControlState.SHOWN_VIRTUAL} | values))


def test_a_step_of_the_vbot_is_shown_at_once(setup):
    bus, _, server = setup
    publish_tree(bus)
    bus.publish("/ic/state", virtual_state(bus), latched=True)
    bus.advance(0.06)  # between two timers
    bus.publish("/vbot/odom", odometry_message(pose_matrix(x=0.01), 0.2, 0.1, "map", "vbot", bus.clock.now_ns()))
    assert server.texts["state"]["vbot"][0] == pytest.approx(0.01)
    assert server.texts["state"]["twist"] == pytest.approx([0.2, 0.1])


def test_the_loss_of_the_driver_is_told_with_its_time_at_once(setup):
    bus, node, _ = setup
    publish_tree(bus)
    bus.advance(0.1)
    assert stamp_ns(bus.last("/view/shown").operator_lost) == 0
    node.on_operator(True)
    node.on_operator(False)
    lost_ns = bus.clock.now_ns()
    assert stamp_ns(bus.last("/view/shown").operator_lost) == lost_ns  # at once
    bus.advance(0.2)
    node.on_operator(True)
    bus.advance(0.1)
    assert stamp_ns(bus.last("/view/shown").operator_lost) == lost_ns  # and on, for whoever missed it
    assert stamp_ns(bus.last("/view/shown")) > lost_ns


def test_the_arbiter_hears_of_the_newest_view_where_it_was_rendered(setup):
    bus, _, _ = setup
    publish_tree(bus)
    bus.publish("/ic/state", virtual_state(bus), latched=True)
    bus.publish("/vbot/odom", odometry_message(pose_matrix(x=1.1, y=2.0), 0.2, 0.0, "map", "vbot", 0))
    bus.publish("/vspace/view", view_message(bus, 1))
    bus.advance(0.05)
    assert matrix_from_pose(bus.last("/view/shown").view_pose)[:3, 3] == pytest.approx([1, 2, 1.5])


def test_a_page_that_renders_by_itself_needs_no_views_and_the_arbiter_hears_how_old_its_state_is(setup):
    bus, _, server = setup
    publish_tree(bus)
    vbot = odometry_message(pose_matrix(x=1.1, y=2.0), 0.2, 0.0, "map", "vbot", 0)

    def drive(seconds, age_ms):
        asked = len(bus.messages("/view/request"))
        for _ in range(round(seconds / 0.05)):
            bus.publish("/ic/state", virtual_state(bus), latched=True)
            bus.publish("/vbot/odom", vbot)
            server.drawn = None if age_ms is None else server.now_ms() - age_ms
            bus.publish("/vspace/view", view_message(bus, 1))  # for another page
            bus.advance(0.05)
        return len(bus.messages("/view/request")) - asked, bus.last("/view/shown")

    requests, shown = drive(0.5, None)
    assert (requests > 0, shown.view_id) == (True, 1)
    drive(0.5, 30.0)
    requests, shown = drive(2.0, 30.0)
    assert requests in (1, 2, 3)  # small ones, once a second: the expected PSNR there is for the arbiter
    assert (bus.last("/view/request").width, bus.last("/view/request").height) == (64, 32)
    # 30 ms when the page said so; the reports come at each step of the v-bot and at 20 Hz.
    assert 0.03 <= shown.view_age_s <= 0.085
    assert shown.view_delay_s == 0.0
    assert matrix_from_pose(shown.view_pose)[:3, 3] == pytest.approx([1.1, 2.0, 1.5])  # the v-bot's camera now
    # The page shows nothing newer: it hangs, or its link is lost. No view, no driving.
    frozen, number = server.drawn, shown.view_id
    for _ in range(20):
        server.drawn = frozen
        bus.publish("/vbot/odom", vbot)
        bus.publish("/vspace/view", view_message(bus, 2))
        bus.advance(0.05)
    assert bus.last("/view/shown").view_age_s > 1.0
    assert bus.last("/view/shown").view_id == number
    requests, shown = drive(0.5, None)  # without WebGL from now on
    assert requests > 0
    assert (shown.view_id, shown.view_age_s < 0.1) == (1, True)


def test_views_that_are_only_judged_are_small_and_go_to_no_page(setup):
    bus, _, server = setup
    publish_tree(bus)
    for _ in range(60):
        server.drawn = server.now_ms()
        bus.publish("/vspace/status", vspace_status(VspaceStatus.READY), latched=True)
        bus.publish("/ic/state", control(bus, ControlState.REAL), latched=True)
        bus.advance(0.05)
        if bus.messages("/view/request"):
            bus.publish("/vspace/view", view_message(bus, bus.last("/view/request").id))
    assert len(bus.messages("/view/request")) in (3, 4)  # one a second
    assert max(int(request.width) for request in bus.messages("/view/request")) <= 96
    assert not [f for f in server.frames if f[0] is FrameKind.VIEW]
    assert bus.last("/view/shown").view_id != bus.last("/view/request").id


def test_layers_are_taken_while_there_is_a_page():
    with LockstepBus(START) as bus:
        node = bus.add(ConsoleNode, ConsoleConfig())
        for watched in (False, True, False):
            node.feed_page(watched)
            assert ("/vspace/layers" in [one.raw.topic for one in node.subscriptions]) is watched


def test_layers_that_no_page_could_render_are_a_fault_of_the_console(setup):
    _, node, server = setup
    mesh = LayerMesh(np.zeros((3, 2), np.uint16), np.ones(3, np.float32), np.array([[0, 1, 2]], np.uint32), (2, 4))
    version = PageLayers(1, (0.0, 0.0, 1.2), (PageLayer(b"JPEG", b"", mesh, np.eye(4)),))
    node.feed.take_layers(version)
    assert server.layers == [version]
    node.feed.take_layers(node.feed.layers_of(build("VspaceLayers", {"version": 1}, 0)))
    assert len(server.layers) == 1
    assert "Virtual space not shown: the layers contain no keyframe." in node.diagnoses()["layers"][1]


def test_map_is_sent_when_changed_and_at_most_twice_a_second(setup):
    bus, _, server = setup
    grid = np.zeros((10, 10), np.int8)
    for step in range(20):  # 2 s at 10 Hz, a new map each time
        grid[0, 0] = step
        bus.publish("/map", grid_message(grid, 0.1, (0, 0), "map", bus.clock.now_ns()), latched=True)
        bus.advance(0.1)
    sent = sum(kind is FrameKind.MAP for kind, _, _ in server.frames)
    assert 3 <= sent <= 5
    bus.advance(0.6)
    server.frames.clear()
    bus.publish("/map", grid_message(grid, 0.1, (0, 0), "map", bus.clock.now_ns()), latched=True)
    bus.advance(1.0)
    assert server.frames == []  # the same map again


def test_plan_comes_in_the_maps_frame(setup):
    bus, _, server = setup
    now = bus.clock.now_ns()
    bus.publish("/ic/state", control(bus, ControlState.VIRTUAL), latched=True)
    bus.publish("/ic/trajectory", path_message([[0, 0, 0], [1, 0, 0]], "map", now))
    bus.publish("/nav/path", path_message([[1, 0, 0], [1, 1, 0]], "map", now))
    bus.publish("/ic/subgoal", pose_stamped(pose_matrix(x=4, y=5, yaw=0.5), "map", now))
    bus.advance(0.21)
    plan = server.texts["plan"]
    assert plan["trajectory"] == [[0, 0], [1, 0]]
    assert plan["path"] == [[1, 0], [1, 1]]
    assert plan["subgoal"] == pytest.approx([4, 5, 0.5], abs=1e-3)
    bus.publish("/ic/state", control(bus, ControlState.REAL), latched=True)
    bus.advance(0.4)
    assert server.texts["plan"]["path"] == []
    assert server.texts["plan"]["subgoal"] is None


def diagnostics(level, name, text):

    status = message_type("DiagnosticStatus")(level=level, name=name, message=text, hardware_id="", values=[])
    return message_type("DiagnosticArray")(header=header("", 0), status=[status])


def test_faults_are_told_in_the_words_of_the_node_that_found_them(setup):
    bus, _, server = setup
    bus.publish("/diagnostics", diagnostics(1, "vlp16_driver: packets", "no packets for 2 s"))
    bus.publish("/diagnostics", diagnostics(2, "crawler_base: link", "no answer from /dev/ttyACM0"))
    bus.publish("/diagnostics", diagnostics(0, "nerf: state", "ready"))
    bus.advance(1.1)
    faults = server.texts["health"]["faults"]
    assert faults == [
        {"level": "error", "name": "crawler_base", "text": "no answer from /dev/ttyACM0"},
        {"level": "warn", "name": "vlp16_driver", "text": "no packets for 2 s"},
    ]
    bus.advance(4.0)
    assert server.texts["health"]["faults"] == []  # told no more, so it is over


def heartbeat(node, state, cpu_percent=0.0):
    return build("NodeStatus", {"node": node, "state": int(state), "cpu_percent": cpu_percent}, 0)


def test_health_lists_the_cpu_of_the_running_nodes(setup):
    bus, _, server = setup
    bus.publish("/heartbeat", heartbeat("nerf", NodeStatus.RUNNING, 21.26))
    bus.publish("/heartbeat", heartbeat("mine", NodeStatus.RUNNING))
    bus.publish("/heartbeat", heartbeat("strange", NodeStatus.RUNNING, math.nan))
    bus.publish("/heartbeat", heartbeat("bag_player", NodeStatus.STOPPING))
    bus.advance(1.1)
    nodes = {node["name"]: node for node in server.texts["health"]["nodes"]}
    assert nodes["nerf"] == {"name": "nerf", "cpu_percent": 21.3}
    assert "mine" in nodes and not {"bag_player", "strange"} & nodes.keys()


def test_dead_node_is_a_fault_and_one_that_ended_is_not(setup):
    bus, _, server = setup
    bus.publish("/heartbeat", heartbeat("grid_slam", NodeStatus.RUNNING))
    bus.publish("/heartbeat", heartbeat("bag_player", NodeStatus.STOPPING))
    bus.advance(5.0)
    assert server.texts["health"]["faults"] == [{"level": "error", "name": "grid_slam", "text": "does not answer"}]


def test_vspace_and_battery_are_told(setup):
    bus, _, server = setup
    bus.publish("/vspace/status", vspace_status(VspaceStatus.READY), latched=True)
    bus.publish("/battery", build("BatteryState", {"voltage": 24.5, "percentage": math.nan}, 0))
    bus.advance(1.1)
    health = server.texts["health"]
    assert health["vspace"]["state"] == "ready"
    assert health["vspace"]["psnr_db"] == pytest.approx(27.5)
    assert health["battery"] == {"voltage": 24.5, "percent": None}


def test_without_a_page_nothing_is_sent_or_requested(setup):
    bus, node, server = setup
    publish_tree(bus)
    bus.publish("/vspace/status", vspace_status(VspaceStatus.READY), latched=True)
    node.feed_page(False)
    for _ in range(20):
        bus.publish("/ic/state", control(bus, ControlState.REAL), latched=True)
        bus.publish("/camera/image/compressed", compressed_image_message(b"JPEG", "camera", bus.clock.now_ns()))
        bus.advance(0.1)
    assert not bus.messages("/view/shown") and not bus.messages("/view/request")
    assert "state" not in server.texts and "health" in server.texts
    assert server.frames[-1][0] is FrameKind.PANORAMA  # a new page, and the export, get the newest image
    node.on_operator(False)
    assert len(bus.messages("/view/shown")) == 1  # the loss of the driver is always reported
    node.feed_page(True)
    bus.advance(1.0)
    assert "state" in server.texts and len(bus.messages("/view/request")) == 1
    assert 20 <= len(bus.messages("/view/shown")) <= 22
