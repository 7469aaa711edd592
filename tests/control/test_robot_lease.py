"""The lease of the robot: who drives, and whom others must wait for."""

from instant_ic.control.robot_lease import Lease, Verdict, may_release_estop, sender_name

SECOND = 1_000_000_000


def test_one_sender_drives_until_it_was_silent_for_the_lease_and_the_robot_stands():
    lease = Lease(silent_s=2.0)
    assert lease.refusal("a", True, 0) is None
    lease.grant("a", 0)
    refused = lease.refusal("b", False, SECOND)
    assert refused is not None and refused.text == "b may not drive while a does"
    assert lease.holder == "a" and lease.holds("a", 2 * SECOND) and not lease.holds("a", 2 * SECOND + 1)
    refused = lease.refusal("b", False, 2 * SECOND + 1, stands=False)
    assert refused is not None and refused.text == "b may drive once the robot stands"
    assert lease.refusal("a", True, 2 * SECOND + 1, stands=False) is None  # the holder itself is back
    assert lease.refusal("b", False, 2 * SECOND + 1) is None


def test_controls_held_in_vain_must_be_let_go_and_the_refused_are_named():
    lease = Lease(silent_s=2.0)
    lease.grant("a", 0)
    assert lease.refusal("b", True, 0) is not None
    assert lease.diagnosis.text == "a drives; refused: b" and lease.diagnosis.level == 1
    assert not lease.held_in_vain(0)
    assert lease.release("a") and not lease.release("a") and lease.holder == ""
    assert lease.held_in_vain(2 * SECOND) and not lease.held_in_vain(3 * SECOND)
    refused = lease.refusal("b", True, SECOND)
    assert refused is not None and refused.verdict is Verdict.HELD
    assert lease.refusal("b", False, SECOND) is None
    assert lease.refusal("b", True, SECOND) is None
    assert lease.diagnosis.text == "nobody drives" and lease.diagnosis.level == 0


def test_only_the_holders_node_releases_the_emergency_stop():
    assert may_release_estop("console", "console/page 1") == ""
    assert "only console/page 1 may" in may_release_estop("host_bridge", "console/page 1")
    assert "only console2/page 1 may" in may_release_estop("console", "console2/page 1")
    assert "nobody drives" in may_release_estop("console", "")


def test_a_name_from_outside_stays_one_part_of_the_senders_name():
    assert sender_name("station", "console", "page 1") == "station/console/page 1"
    assert sender_name("station", "x/page 1\n") == "station/x_page 1_"
    assert sender_name("station", "x" * 1000) == "station/" + 64 * "x"
