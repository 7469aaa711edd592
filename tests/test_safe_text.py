"""Control characters of strangers are shown, passwords and tokens are not."""

import io

import pytest

from instant_ic.util.safe_text import VisibleStream, direct, holds_password, masked, masked_values, visible


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("/scan\tä → 日本\n", "/scan\tä → 日本\n"),
        ("a\x1b]0;owned\x07b", r"a\x1b]0;owned\x07b"),
        ("\x1b[2J\x1bc\x9b1m", r"\x1b[2J\x1bc\x9b1m"),
        ("safe\rWARNING", r"safe\rWARNING"),
        ("a\u061cb\u200bc\ufeffd\udcffe", r"a\u061cb\u200bc\ufeffd\udcffe"),
        ("می\u200cخواهم", "می\u200cخواهم"),
        ("abc\u202etxt.exe\u2028", r"abc\u202etxt.exe\u2028"),
    ],
)
def test_control_characters_become_visible(text, shown):
    assert visible(text) == shown and visible(shown) == shown


def test_only_colours_are_kept_where_they_are_wanted():
    assert visible("\x1b[1;31mred\x1b[0m\x1b[2J", colours=True) == "\x1b[1;31mred\x1b[0m" + r"\x1b[2J"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("open rtsp://me:secret@10.0.0.7:554/live now", "open rtsp://me:***@10.0.0.7:554/live now"),
        ("http://me:sec:ret@secret@host/", "http://me:***@host/"),
        ("http://:secret@host", "http://:***@host"),
        ("rtsp://me@corp:secret@host/live", "rtsp://me@corp:***@host/live"),
        ("rtsp://me:sec/secret@host/live", "rtsp://me:***@host/live"),
        ("rtsp://me%40x:%2Fsecret%40@host", "rtsp://me%40x:***@host"),
        ("http://h/v?user=me&PWD=secret&x=1;password=secret", "http://h/v?user=me&PWD=***&x=1;password=***"),
        ('["http://h:8080","a@b"] http://[::1]:80/a@b', '["http://h:8080","a@b"] http://[::1]:80/a@b'),
        ("http://h:80/?a=1&token=secret&b=2", "http://h:80/?a=1&token=***&b=2"),
        ("http://host:8080/a@b tcp/10.0.0.1:7447 mail@x", "http://host:8080/a@b tcp/10.0.0.1:7447 mail@x"),
    ],
)
def test_passwords_and_tokens_of_addresses_are_masked(text, shown):
    assert masked(text) == shown and "secret" not in masked(text)


def test_values_are_masked_at_any_depth():
    values = {"url": "rtsp://a:b@c", "more": ["x://a:b@c", 1], "pair": ("x://a:b@c",), "n": None}
    shown = {"url": "rtsp://a:***@c", "more": ["x://a:***@c", 1], "pair": ("x://a:***@c",), "n": None}
    assert masked_values(values) == shown
    assert holds_password("rtsp://a:b@c") and not holds_password("rtsp://a@c:554/b@d")


def test_a_stream_shows_controls_and_hides_passwords_and_gives_way_for_the_programs_own():
    below = io.StringIO()
    stream = VisibleStream(below)
    print("\x1bc", "rtsp://a:b@c", file=stream)
    stream.writelines(["\x07\n"])
    direct(stream).write("\x1b[0m")
    assert below.getvalue() == "\\x1bc rtsp://a:***@c\n\\x07\n\x1b[0m" and direct(below) is below
    assert not stream.isatty()
