"""Recordings and logs can be read by their owner alone: folders 0700, files 0600, under any umask."""

import errno
import os
import stat
from pathlib import Path

import pytest

from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.recorder import Recorder
from instant_ic.bag.recording import BagRecorderConfig
from instant_ic.bag.recover import recover
from instant_ic.bag.writer import BagWriter
from instant_ic.bridge.host_keys import KeyStore
from instant_ic.launch.node_log import NodeLog
from instant_ic.msg import Bool, serialize
from instant_ic.util import private

PAYLOAD = serialize(Bool(data=True))


@pytest.fixture(params=[0o022, 0o000, 0o077, 0o777], ids=lambda umask: f"umask{umask:04o}", autouse=True)
def umask(request):
    before = os.umask(request.param)
    yield
    os.umask(before)


def assert_private(top: Path) -> None:
    """Everything from ``top`` down; there must be a file in it."""
    found = [top, *top.rglob("*")]
    assert any(path.is_file() for path in found)
    modes = {str(path): stat.S_IMODE(path.stat().st_mode) for path in found}
    assert modes == {str(path): 0o700 if path.is_dir() else 0o600 for path in found}


def write(path: Path, **options: int) -> Path:
    with BagWriter(path, **options) as writer:
        for number in range(1, 4):
            writer.write("/robot/estop", "std_msgs/msg/Bool", PAYLOAD, number * 1_000_000_000)
    return path


def recorder(path: Path, options: BagRecorderConfig | None = None) -> Recorder:
    return Recorder(path, TopicChoice(), lambda topic, take: pytest.fail("nothing to subscribe to"), None, options)


def test_a_bag_and_the_folders_made_for_it_are_private(tmp_path):
    write(tmp_path / "runs" / "recordings" / "drive")
    assert_private(tmp_path / "runs")


def test_what_the_recorder_writes_is_private(tmp_path):
    made = recorder(tmp_path / "runs" / "drive")
    made.take("/robot/estop", "std_msgs/msg/Bool", PAYLOAD, 1_000_000_000)
    made.close()
    assert_private(tmp_path / "runs")


def test_what_the_record_button_writes_is_private(tmp_path):
    made = recorder(tmp_path / "recordings", BagRecorderConfig(snapshot=True))
    made.record("lift")
    made.close()
    assert_private(tmp_path / "recordings")


def test_snapshots_are_private(tmp_path):
    kept = recorder(tmp_path / "snapshots", BagRecorderConfig(snapshot=True, snapshot_seconds=60.0))
    kept.take("/robot/estop", "std_msgs/msg/Bool", PAYLOAD, 1_000_000_000)
    kept.snapshot("estop")
    kept.close()
    assert_private(tmp_path / "snapshots")


def test_recovered_bags_are_private(tmp_path):
    source = write(tmp_path / "drive")
    recover(source, tmp_path / "recovered")
    for bag in (source, tmp_path / "recovered"):
        assert_private(bag)


def test_an_existing_folder_keeps_its_mode_and_the_files_in_it_are_private(tmp_path):
    folder = tmp_path / "shared"
    folder.mkdir()
    folder.chmod(0o755)
    recorder(folder, BagRecorderConfig(snapshot=True, snapshot_seconds=60.0)).close()
    write(folder / "drive")
    assert stat.S_IMODE(folder.stat().st_mode) == 0o755
    assert_private(folder / "drive")


def test_log_files_of_the_launcher_are_private_and_so_are_those_of_an_older_version(tmp_path):
    folder = tmp_path / "log"
    NodeLog(folder / "early.log", pytest.fail).write(b"line\n")
    old = folder / "old.log"
    old.write_text("before\n")
    log = NodeLog(old, pytest.fail)  # becomes old.log.1
    log.write(b"line\n")
    log.close()
    old.chmod(0o644)
    log.write(b"again\n")
    log.close()
    (folder / "old.log.1").chmod(0o600)
    assert old.read_bytes() == b"line\nagain\n"
    assert_private(folder)


def test_the_keys_of_the_bridge_are_private(tmp_path):
    KeyStore(tmp_path / "keys").create("robot")
    assert_private(tmp_path / "keys")


def test_a_symbolic_link_is_not_followed(tmp_path):
    target = tmp_path / "precious"
    target.write_text("precious")
    (tmp_path / "link").symlink_to(target)
    with pytest.raises(OSError) as caught:
        private.open_file(tmp_path / "link", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    assert caught.value.errno == errno.ELOOP
    assert target.read_text() == "precious"


def test_a_file_system_without_modes_takes_a_recording_and_warns(tmp_path, monkeypatch, caplog):
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    os.umask(0o477)  # the file is made without the owner's right to read, as if its file system had given its own mode
    monkeypatch.setattr(os, "fchmod", refuse)
    os.close(private.open_file(tmp_path / "drive.mcap", os.O_WRONLY | os.O_CREAT))
    assert "drive.mcap cannot be hidden from other users (mode 0600): Operation not permitted" in caplog.text
