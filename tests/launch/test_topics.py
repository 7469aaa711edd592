"""The table of nominal rates and what is judged by it."""

import math
import re
from pathlib import Path

import pytest

from instant_ic.console.drive import DriveConfig
from instant_ic.launch.topics import TopicRate, expected_rate, topic_rates
from nodes.navigator import PRESENT_S

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("expected", "rate_hz", "age_s", "words"),
    [
        (TopicRate(10.0), 10.0, 0.1, ""),
        (TopicRate(10.0), 7.25, 0.1, "7.2 of 10 Hz"),
        (TopicRate(10.0), 10.0, 0.99, ""),
        (TopicRate(10.0), 3.0, 1.0, "stopped 1.0 s ago"),  # ten periods
        (TopicRate(0.5), 0.5, 19.9, ""),  # a period of 2 s
        (TopicRate(10.0), 0.0, math.inf, "no message yet"),
        (TopicRate(10.0, "driving"), 0.0, math.inf, ""),
        (TopicRate(10.0, "driving"), 0.0, 60.0, ""),
        (TopicRate(10.0, "driving"), 5.0, 0.2, "5.0 of 10 Hz"),
        (TopicRate(1.0, "a page is open"), 0.4, 2.5, "0.4 of 1 Hz"),
        (TopicRate(1.0, "a page is open"), 0.0, 3.5, ""),  # the page was closed
    ],
)
def test_fault(expected: TopicRate, rate_hz: float, age_s: float, words: str) -> None:
    assert expected.fault(rate_hz, age_s) == words


def test_namespace_of_the_sender_is_left_out() -> None:
    assert expected_rate("/scan") == TopicRate(10.0) == expected_rate("/left/scan")
    assert expected_rate("/leftscan") is None


def test_commands_of_an_operator_who_commands_nothing_are_not_too_slow() -> None:
    assert topic_rates()["/operator/cmd_vel"].freq_ok(DriveConfig().keep_alive_hz)
    assert topic_rates()["/nav/cmd_vel"].freq_ok(1.0 / PRESENT_S)


def test_every_topic_of_the_table_is_one_that_a_node_gives() -> None:
    reference = (ROOT / "docs" / "reference.md").read_text()
    given = set(re.findall(r"`(/[\w/]+)`", " ".join(re.findall(r"^Gives: .*$", reference, re.MULTILINE))))
    assert set(topic_rates()) - {"/heartbeat", "/diagnostics"} <= given
