"""Key files: text form, modes, mistakes, and the live list."""

import os
import stat
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.bridge.host_keys import AllowList, KeyFileError, KeyStore, Peer, key_text, parse_key

KEY = bytes(range(32))


@pytest.fixture
def store(tmp_path):
    return KeyStore(tmp_path / "keys")


@given(st.binary(min_size=32, max_size=32))
def test_key_as_text_and_back(key):
    text = key_text(key)
    assert parse_key(f" {text}\n") == key
    assert len(text) == 52 and text.replace("_", "").replace("-", "").isalnum()


@given(st.binary(min_size=32, max_size=32), st.integers(4, 51), st.sampled_from("AZaz09_-"))
def test_a_slip_in_one_letter_is_found(key, place, letter):
    text = key_text(key)
    if text[place] != letter:
        with pytest.raises(KeyFileError):
            parse_key(text[:place] + letter + text[place + 1 :])


@given(st.text(max_size=60))
def test_any_text_is_no_key(text):
    with pytest.raises(KeyFileError):
        parse_key(text)


def test_new_key_is_kept_secret(store):
    made = store.create("robot")
    assert store.identity() == made and len(made.secret_key) == 32 and made.public_key != made.secret_key
    assert stat.S_IMODE(store.identity_path.stat().st_mode) == 0o600
    assert stat.S_IMODE(store.folder.stat().st_mode) == 0o700
    with pytest.raises(KeyFileError, match="already exists"):
        store.create("robot")
    assert store.create("robot", force=True) != made


def test_secret_key_is_never_written_with_a_wider_mode(store, monkeypatch):
    seen = []
    replace = Path.replace

    def watch(source, target):
        seen.append(stat.S_IMODE(source.stat().st_mode))
        return replace(source, target)

    monkeypatch.setattr(Path, "replace", watch)
    before = os.umask(0)
    try:
        store.create("robot")
    finally:
        os.umask(before)
    assert seen == [0o600]
    assert [path.name for path in store.folder.iterdir()] == ["identity"]


def test_key_that_others_can_read_is_refused(store):
    store.create("robot")
    store.identity_path.chmod(0o640)
    with pytest.raises(KeyFileError, match="chmod 600"):
        store.identity()


def test_list_that_others_can_write_is_refused(store):
    store.allow(Peer("station", "driver", KEY))
    store.allowed_path.chmod(0o620)
    with pytest.raises(KeyFileError, match=r"written by others .*chmod 600"):
        store.peers()


def test_missing_and_damaged_identity(store):
    with pytest.raises(KeyFileError, match="ic keys new"):
        store.identity()
    store.create("robot")
    text = store.identity_path.read_text()
    for damaged in (text[:-10], "robot\n", "", text.replace("ick_", "ick", 1)):
        store.identity_path.write_text(damaged)
        with pytest.raises(KeyFileError, match="damaged"):
            store.identity()


def test_allow_list_by_command(store):
    assert store.peers() == []
    driver, viewer = Peer("station", "driver", KEY), Peer("tablet", "viewer", KEY[::-1])
    assert store.allow(driver) == "added"
    assert store.allow(driver) == "as before"
    assert store.allow(viewer) == "added"
    assert store.peers() == [driver, viewer] and store.peer("tablet") == viewer
    assert store.allow(Peer("station", "driver", bytes(32))) == "replaced"
    with pytest.raises(KeyFileError, match="already allowed as tablet"):
        store.allow(Peer("other", "driver", KEY[::-1]))
    with pytest.raises(KeyFileError, match=r"several hosts are allowed \(tablet, station\)"):
        store.peer()
    assert store.revoke("station").name == "station"
    assert store.peer() == viewer
    with pytest.raises(KeyFileError, match=r"has no host 'station' \(allowed: tablet\)"):
        store.revoke("station")
    assert stat.S_IMODE(store.allowed_path.stat().st_mode) == 0o600


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("station driver", r"allowed:3: expected NAME, driver or viewer, KEY"),
        (f"station boss {key_text(KEY)}", r"allowed:3: expected NAME"),
        ("station driver ick_xyz", r"allowed:3: 'ick_xyz' is not a key"),
        (f"2station driver {key_text(KEY)}", r"allowed:3: name '2station'"),
        (f"a driver {key_text(KEY)}", r"allowed:3: a is listed twice"),
        (f"b driver {key_text(bytes(32))}", r"allowed:3: b is listed twice.*as a"),
    ],
)
def test_mistakes_in_the_list_name_their_line(store, line, words):
    store.folder.mkdir()
    store.allowed_path.write_text(f"# mine\na driver {key_text(bytes(32))}  # the office\n{line}\n")
    with pytest.raises(KeyFileError, match=words):
        store.peers()


def test_two_commands_at_a_time_lose_nothing(store):
    keys = [bytes([index]) * 32 for index in range(16)]
    threads = [
        threading.Thread(target=store.allow, args=(Peer(f"host{index}", "driver", key),))
        for index, key in enumerate(keys)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert {peer.public_key for peer in store.peers()} == set(keys)


def test_live_list_follows_the_file(store):
    live = AllowList(store)
    assert live.refresh() is False and len(live) == 0
    store.allow(Peer("station", "driver", KEY))
    assert live.refresh() is True and live.get(KEY).name == "station"
    assert live.refresh() is False
    text = store.allowed_path.read_text()
    store.allowed_path.write_text(text + "half a li")
    assert live.refresh() is False and live.get(KEY) is not None and "allowed:3" in live.problem
    store.allowed_path.write_text(text)
    assert live.refresh() is False and live.problem == ""
    store.allowed_path.unlink()
    assert live.refresh() is True and live.get(KEY) is None
