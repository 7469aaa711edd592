"""Names and texts of bags, nodes and logs that try to control the terminal: none reaches it raw."""

import io
import json
import logging
import re

import pytest
from rich.console import Console

from instant_ic.bag import BagWriter
from instant_ic.bus import SENSOR
from instant_ic.bus.process import SafeFormatter
from instant_ic.cli.logs import LogLine
from instant_ic.cli.main import main
from instant_ic.cli.top import table
from instant_ic.launch.node_table import NodeRow, TopicRow
from instant_ic.launch.screen import StackScreen, StackView
from instant_ic.msg import Bool, message_type, serialize

EVIL = "\x1b]0;owned\x07\x1b[2J\x1bc\x9b31m\rgone"
RAW = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
S = 1_000_000_000


@pytest.fixture
def bag(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.set_custom("instant_ic.lost", json.dumps({f"/x{EVIL}": 2}))
        writer.set_custom("instant_ic.lost_by", json.dumps({f"/x{EVIL}": {EVIL: 2}}))
        text = bytes(serialize(message_type("String")(data=EVIL)))
        writer.write("/operator/bookmark", "std_msgs/msg/String", text, 2 * S, SENSOR)
        writer.write(f"/x{EVIL}", "std_msgs/msg/Bool", bytes(serialize(Bool(data=True))), S, SENSOR)
    return str(tmp_path / "bag")


@pytest.mark.parametrize(
    "words",
    [
        ("bag", "info", "BAG"),
        ("bag", "diff", "BAG", "BAG"),
        ("topic", "info", f"/x{EVIL}"),
        ("node", "info", EVIL),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_fault_escapes_of_a_bag_or_a_name_control_the_terminal(bag, words, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(tmp_path / "r"))
    main([bag if word == "BAG" else word for word in words])
    out, err = capsys.readouterr()
    assert out + err
    assert RAW.findall(out + err) == []


def test_passwords_of_addresses_that_a_command_prints_are_masked(capsys, tmp_path):
    file = tmp_path / "camera.yaml"
    url = "{name: url, value: 'rtsp://me:secret@10.0.0.7/live'}"
    file.write_text(f"launch:\n- node: {{exec: theta_camera, param: [{url}]}}\n")
    status = main(["launch", str(file), "--check"])
    out, err = capsys.readouterr()
    assert status != 0 and "set password_file" in out + err
    assert "secret" not in out + err


def test_a_log_line_shows_escapes_and_hides_passwords():
    record = logging.LogRecord("x", logging.ERROR, "", 1, "peer %s of %s", (EVIL, "rtsp://me:secret@h/"), None)
    text = SafeFormatter("%(message)s").format(record)
    assert RAW.findall(text) == [] and "secret" not in text and r"\x1b]0;owned" in text
    for colour in (False, True):
        line = LogLine("", "ERROR", f"n{EVIL}", f"{EVIL} rtsp://me:secret@h/").show(colour)
        assert "secret" not in line
        assert RAW.findall(re.sub(r"\x1b\[[\d;]*m", "", line)) == []


def test_the_launchers_screen_and_top_show_escapes_of_nodes():
    out = io.StringIO()
    console = Console(file=out, width=400, force_terminal=False)
    screen = StackScreen(["slam"], live=False, console=console, verbose=True)
    screen.node_line("slam", f"{EVIL} rtsp://me:secret@h/")
    screen.event(EVIL)
    row = NodeRow("slam", "running", EVIL, outputs=[TopicRow(EVIL, 1.0, 0.1)])
    console.print(screen.table(StackView((row,))))
    console.print(table([row], "cpu"))
    assert RAW.findall(out.getvalue()) == [] and "secret" not in out.getvalue()
    assert out.getvalue().count("owned") == 6
