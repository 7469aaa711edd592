"""``ic keys``."""

import pytest

from instant_ic.bridge.host_keys import KeyStore
from instant_ic.cli.main import main


@pytest.fixture
def hosts(tmp_path, monkeypatch):
    """Runs ``ic keys`` as on one host or the other."""

    def run(host, *words):
        monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / host))
        return main(["keys", *words])

    run.store = lambda host: KeyStore(tmp_path / host / "instant_ic" / "keys")
    return run


def printed_command(text):
    """The words of the ``ic keys`` line that is to be copied to the other host."""
    (line,) = [line for line in text.splitlines() if line.startswith("  ic keys ")]
    return line.split()[2:]


def test_two_hosts_by_copied_lines(hosts, capsys):
    assert hosts("station", "new", "station") == 0
    for_robot = printed_command(capsys.readouterr().out)
    assert for_robot[:2] == ["allow", "station"]
    assert hosts("robot", *for_robot) == 0  # makes the robot's own key too
    for_station = printed_command(capsys.readouterr().out)
    assert hosts("station", *for_station) == 0
    station, robot = hosts.store("station"), hosts.store("robot")
    assert robot.peer("station").public_key == station.identity().public_key
    assert station.peer().public_key == robot.identity().public_key
    assert robot.peer("station").role == "driver"


def test_list_shows_keys_and_roles_but_no_secret(hosts, capsys):
    assert hosts("robot", "list") == 0
    assert "no key yet (ic keys new)" in capsys.readouterr().out
    hosts("robot", "new", "robot")
    hosts("tablet", "new", "tablet")
    words = printed_command(capsys.readouterr().out.split("key of tablet")[1])
    hosts("robot", *words, "--role", "viewer")
    capsys.readouterr()
    assert hosts("robot", "list") == 0
    out = capsys.readouterr().out
    secret = hosts.store("robot").identity_path.read_text().split()[2]
    assert "this host  robot" in out and "tablet" in out and "viewer" in out and words[2] in out
    assert secret not in out


def test_mistakes_are_told_in_a_line(hosts, capsys):
    assert hosts("robot", "revoke", "nobody") == 1
    assert "has no host 'nobody' (allowed: none)" in capsys.readouterr().err
    assert hosts("robot", "allow", "station", "ick_short") == 1
    assert "is not a key" in capsys.readouterr().err
    hosts("robot", "new", "robot")
    out = capsys.readouterr().out
    assert hosts("robot", "new", "robot") == 1
    assert "--force" in capsys.readouterr().err
    assert hosts("robot", *printed_command(out)) == 1
    assert "own key" in capsys.readouterr().err
    assert hosts("robot", "allow", "2 words", printed_command(out)[2]) == 1
    assert "not valid" in capsys.readouterr().err


def test_revoke_and_other_folder(hosts, capsys, tmp_path):
    folder = str(tmp_path / "elsewhere")
    hosts("station", "new", "station", "--dir", folder + "2")
    words = printed_command(capsys.readouterr().out)
    assert hosts("robot", *words, "--dir", folder) == 0
    assert hosts("robot", *words, "--dir", folder) == 0
    assert "as before" in capsys.readouterr().out
    assert hosts("robot", "revoke", "station", "--dir", folder) == 0
    assert "no longer allowed" in capsys.readouterr().out
    assert KeyStore(tmp_path / "elsewhere").peers() == []
