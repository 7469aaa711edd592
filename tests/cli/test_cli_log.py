"""``ic log``: files of the launcher, levels."""

import select
import subprocess
import sys
from datetime import datetime

from cli_helpers import talking

from instant_ic.cli.logs import GrowingLog, LogFolder, parse

LOST = "2026-03-04 10:00:00.000 ERROR   nav: lost\n"


def test_lines_and_traces():
    text = (
        "a library says hello\n"
        "2026-03-04 11:59:58.250 INFO    arbiter: running\n"
        "2026-03-04 11:59:59.500 ERROR   arbiter: tick: ValueError: no\n"
        "Traceback (most recent call last):\n"
        '  File "x.py", line 3\n'
        "2026-03-04 11:59:59.900 WARNING instant_ic.bus: 3: lost\n"
    )
    lines = parse(text, "arbiter")
    assert [(line.stamp[11:], line.level, line.node) for line in lines] == [
        ("11:59:58.250", "INFO", "arbiter"),  # what comes before the first time is as old as that
        ("11:59:58.250", "INFO", "arbiter"),
        ("11:59:59.500", "ERROR", "arbiter"),
        ("11:59:59.900", "WARNING", "instant_ic.bus"),
    ]
    assert lines[2].text.count("\n") == 2 and lines[3].text == "3: lost"
    assert [line.at_least("WARNING") for line in lines] == [False, False, True, True]
    assert lines[1].show(colour=False) == "2026-03-04 11:59:58.250 INFO    arbiter: running"
    start = "\x1b[2m2026-03-04 11:59:59.500\x1b[0m \x1b[31mERROR  \x1b[0m \x1b[1marbiter"
    assert lines[2].show(colour=True).startswith(start)


def test_file_that_grows_is_cut_in_a_line_and_is_replaced(tmp_path):
    path = tmp_path / "arbiter.log"
    file = GrowingLog(path)
    assert file.new_lines() == []
    path.write_text("2026-03-04 10:00:00.000 INFO    arbiter: one\n2026-03-04 10:00:00.100 INFO    arb")
    assert [line.text for line in file.new_lines()] == ["one"]
    with path.open("a") as out:
        out.write("iter: two\n")
    assert [line.text for line in file.new_lines()] == ["two"]
    path.rename(tmp_path / "arbiter.log.1")
    path.write_text("2026-03-04 10:00:01.000 INFO    arbiter: new start\n")
    assert [line.text for line in file.new_lines()] == ["new start"]


def test_files_are_merged_by_time(tmp_path):
    (tmp_path / "a.log").write_text("2026-03-04 10:00:00.000 INFO    a: 1\n2026-03-04 10:00:02.000 INFO    a: 3\n")
    (tmp_path / "b.log").write_text("2026-03-04 10:00:01.000 INFO    b: 2\n")
    assert [line.text for line in LogFolder(tmp_path).new_lines()] == ["1", "2", "3"]
    assert [line.text for line in LogFolder(tmp_path, ["b"]).new_lines()] == ["2"]


def test_verb_reads_files(ic, tmp_path, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(tmp_path))
    (tmp_path / "log").mkdir()
    now = datetime.now().strftime("%Y-%m-%d %H:%M:%S.000")
    lines = [f"{now} INFO    nav: {i}\n" for i in range(40)] + [f"{now} ERROR   nav: bad\nTrace\n"]
    (tmp_path / "log" / "nav.log").write_text("".join(lines))
    out = ic("log")[1].splitlines()
    assert len(out) == 31 and out[0].endswith("nav: 11") and out[-2:] == [f"{now} ERROR   nav: bad", "Trace"]
    assert ic("log", "nav", "-n", "2")[1].count("\n") == 3
    assert ic("log", "-l", "error")[1].splitlines() == [f"{now} ERROR   nav: bad", "Trace"]
    assert ic("log", "-l", "loud")[0] == 2 and ic("log", "-l", "WARN")[1].splitlines()[-1] == "Trace"
    status, _, error = ic("log", "nva")
    assert status == 1 and "did you mean 'nav'?" in error


def test_follow_shows_what_a_node_writes_and_levels_are_set(ic, tmp_path_factory, monkeypatch):
    run_dir = tmp_path_factory.mktemp("r")
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(run_dir))
    with talking(run_dir):
        assert ic("log", "level", "talker")[1] == "info\n" and ic("log", "level", "talker", "DEBUG")[1] == "debug\n"
        assert ic("log", "level", "talker", "loud")[0] == 1 and ic("log", "level")[0] == 2
    (run_dir / "log" / "nav.log").write_text("")
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "instant_ic.cli.main", "log", "-f", "-n", "0"], stdout=subprocess.PIPE, text=True
    )
    try:
        with (run_dir / "log" / "nav.log").open("a", buffering=1) as file:
            while not select.select([process.stdout], [], [], 0.1)[0]:
                file.write(LOST)
        assert process.stdout.readline() == LOST
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
