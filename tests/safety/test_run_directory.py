"""The run directory is this user's alone: what another user planted there is refused, never followed."""

import fcntl
import json
import os
import socket
import stat
import time
from pathlib import Path

import pytest

from instant_ic.bus import registry
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.qos import SENSOR
from instant_ic.bus.registry import RegistryError
from instant_ic.launch.rundir import stack_lock

STRANGER = 65533
as_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file to another user")


@pytest.fixture(params=[0o022, 0o000, 0o077, 0o777], ids=lambda umask: f"umask{umask:04o}")
def umask(request):
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


def test_run_directory_and_its_folders_are_0700_under_any_umask(tmp_path, umask):
    run_dir = registry.prepare(tmp_path / "above" / "run")
    assert {folder.name: mode(folder) for folder in run_dir.iterdir()} == dict.fromkeys(
        ("topics", "nodes", "dev", "log"), 0o700
    )
    assert mode(run_dir) == mode(run_dir.parent) == 0o700


def test_an_own_run_directory_that_others_could_read_is_closed(tmp_path):
    (tmp_path / "run" / "topics").mkdir(parents=True)
    for folder in (tmp_path / "run", tmp_path / "run" / "topics"):
        folder.chmod(0o777)
    run_dir = registry.prepare(tmp_path / "run")
    assert mode(run_dir) == mode(run_dir / "topics") == 0o700


@pytest.mark.parametrize("name", ["", "topics", "nodes", "dev", "log"])
def test_a_symbolic_link_as_run_directory_or_folder_in_it_is_refused_and_not_followed(tmp_path, name):
    target = tmp_path / "target"
    target.mkdir(mode=0o755)
    target.chmod(0o755)
    run_dir = tmp_path / "run"
    if name:
        run_dir.mkdir(mode=0o700)
    (run_dir / name).symlink_to(target)
    with pytest.raises(RegistryError, match=r"is a symbolic link: .*INSTANT_IC_RUN_DIR"):
        registry.prepare(run_dir)
    assert mode(target) == 0o755
    assert list(target.iterdir()) == []


def test_a_dangling_symbolic_link_as_run_directory_is_refused(tmp_path):
    (tmp_path / "run").symlink_to(tmp_path / "nowhere")
    with pytest.raises(RegistryError, match="symbolic link"):
        registry.prepare(tmp_path / "run")
    assert not (tmp_path / "nowhere").exists()


def test_a_file_as_run_directory_is_refused(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(RegistryError, match="is not a folder"):
        registry.prepare(tmp_path / "run")


@as_root
@pytest.mark.parametrize("name", ["", "topics", "nodes", "dev", "log"])
def test_a_folder_of_another_user_is_refused(tmp_path, name):
    run_dir = tmp_path / "run"
    (run_dir / name).mkdir(parents=True)
    os.chown(run_dir / name, STRANGER, STRANGER)
    before = mode(run_dir / name)
    with pytest.raises(RegistryError, match=f"belongs to user {STRANGER}.*INSTANT_IC_RUN_DIR"):
        registry.prepare(run_dir)
    assert mode(run_dir / name) == before


@pytest.mark.parametrize(("above", "refused"), [(0o777, True), (0o1777, False), (0o755, False)])
def test_a_folder_above_that_others_can_write_to_is_refused_unless_it_is_sticky(tmp_path, above, refused):
    parent = tmp_path / "above"
    (parent / "between").mkdir(parents=True)
    parent.chmod(above)
    if not refused:
        registry.prepare(parent / "between" / "run")
        return
    with pytest.raises(RegistryError, match=r"other users can write to .*above \(mode 0777\).*chmod go-w"):
        registry.prepare(parent / "between" / "run")


@as_root
@pytest.mark.parametrize(("group", "refused"), [(STRANGER, True), (0, False)])
def test_a_folder_above_that_another_group_can_write_to_is_refused(tmp_path, group, refused):
    parent = tmp_path / "above"
    parent.mkdir()
    os.chown(parent, 0, group)
    parent.chmod(0o775)
    if refused:
        with pytest.raises(RegistryError, match="other users can write to"):
            registry.prepare(parent / "run")
    else:
        registry.prepare(parent / "run")


def test_a_symbolic_link_as_topic_folder_is_refused_by_publisher_and_subscriber(tmp_path):
    run_dir, target = registry.prepare(tmp_path / "run"), tmp_path / "target"
    target.mkdir()
    registry.topic_dir(run_dir, "/cmd_vel").symlink_to(target)
    with pytest.raises(RegistryError, match="symbolic link"):
        registry.claim_socket(run_dir, "/cmd_vel", "talker")
    transport = LocalTransport(run_dir, "listener", time.time_ns)
    try:
        with pytest.raises(RegistryError, match="symbolic link"):
            transport.subscribe("/cmd_vel", None, SENSOR, lambda: None)
    finally:
        transport.close()
    assert list(target.iterdir()) == []


def test_a_symbolic_link_as_lock_file_is_refused_and_its_target_untouched(tmp_path):
    run_dir, target = registry.prepare(tmp_path / "run"), tmp_path / "precious"
    target.write_text("precious")
    (run_dir / "launch.lock").symlink_to(target)
    (run_dir / "nodes" / "talker.lock").symlink_to(target)
    with pytest.raises(RegistryError, match=r"launch\.lock is a symbolic link"), stack_lock(run_dir, "sim.yaml"):
        pass
    with pytest.raises(RegistryError, match=r"talker\.lock is a symbolic link"):
        registry.Claim(run_dir / "nodes" / "talker", "node talker")
    with pytest.raises(RegistryError, match=r"talker\.lock is a symbolic link"):
        registry.sweep(run_dir)
    assert target.read_text() == "precious"


def test_a_symbolic_link_where_an_entry_is_written_is_not_followed(tmp_path):
    run_dir, target = registry.prepare(tmp_path / "run"), tmp_path / "precious"
    target.write_text("precious")
    claim = registry.Claim(run_dir / "nodes" / "talker", "node talker")
    (run_dir / "nodes" / f".talker.json.{os.getpid()}.part").symlink_to(target)
    with pytest.raises(RegistryError):
        claim.write({"name": "talker"})
    claim.release()
    assert target.read_text() == "precious"


@as_root
def test_an_entry_of_another_user_is_no_entry(tmp_path):
    run_dir = registry.prepare(tmp_path / "run")
    lock = run_dir / "nodes" / "arbiter.lock"
    lock.write_text("")
    entry = {"name": "arbiter", "executable": "m", "pid": 1, "started_ns": 0, "params": {}}
    lock.with_suffix(".json").write_text(json.dumps(entry))
    with lock.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert [node.name for node in registry.list_nodes(run_dir)] == ["arbiter"]
        os.chown(lock, STRANGER, STRANGER)
        assert registry.list_nodes(run_dir) == []
        with pytest.raises(RegistryError, match="is not a file of yours"):
            registry.Claim(lock.with_suffix(""), "node arbiter")


def test_a_symbolic_link_where_a_socket_goes_is_replaced_and_not_followed(tmp_path):
    run_dir, target = registry.prepare(tmp_path / "run"), tmp_path / "precious"
    target.write_text("precious")
    registry.own_folder(registry.topic_dir(run_dir, "/cmd_vel"))
    (registry.topic_dir(run_dir, "/cmd_vel") / "talker.sock").symlink_to(target)
    claim, path = registry.claim_socket(run_dir, "/cmd_vel", "talker")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
    assert stat.S_ISSOCK(path.lstat().st_mode)
    claim.release()
    assert target.read_text() == "precious"


def test_an_incomplete_entry_of_a_node_is_named_and_not_skipped(tmp_path):
    claim = registry.Claim(registry.prepare(tmp_path / "r") / "nodes" / "crawler_base", "node crawler_base")
    try:
        entry = {"name": "crawler_base", "pid": 7, "started_ns": 0, "params": {}}
        claim.write({**entry, "module": "of another version"})
        with pytest.raises(registry.RegistryError, match=r"node crawler_base \(pid 7\) is incomplete: stop that node"):
            registry.list_nodes(tmp_path / "r")
        claim.write({**entry, "executable": "crawler_base", "unknown": 1})
        assert [node.name for node in registry.list_nodes(tmp_path / "r")] == ["crawler_base"]
    finally:
        claim.release()
