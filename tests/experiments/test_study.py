"""``ic study``: orders, checks of study.yaml and of answers, scores and statistics by hand, the pages."""

import asyncio
import json
import math
import stat
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import aiohttp
import numpy as np
import playwright.sync_api as playwright
import pytest
import yaml
from study_pages import FakeTrial, fake_console, filled, finished_study, served

from instant_ic.bag import BagReader, BagWriter
from instant_ic.bus import LATCHED
from instant_ic.cli.main import main
from instant_ic.experiments.study import forms, stats, trial
from instant_ic.experiments.study.plan import CONDITIONS, Study, StudyError, balanced_square, create, load, orders, save
from instant_ic.experiments.study.record import DONE, OPEN, WITHDRAWN, Record
from instant_ic.experiments.study.report import rows, values_of
from instant_ic.experiments.study.server import StudyServer, drive_page, from_page, to_page
from instant_ic.experiments.study.simulate import Participant
from instant_ic.experiments.study.trial import Drive, ahead_m, measures
from instant_ic.msg import (
    Bool,
    ControlState,
    String,
    deserialize,
    header,
    pose2_message,
    scan_message,
    serialize,
    twist_message,
)


@pytest.fixture
def study(tmp_path: Path) -> Study:
    return create(tmp_path / "study", 8, 3)


# ---- the plan


def test_the_square_for_four_is_that_of_williams():
    assert balanced_square(4) == [[0, 1, 3, 2], [1, 2, 0, 3], [2, 3, 1, 0], [3, 0, 2, 1]]


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7])
def test_each_condition_has_each_place_and_follows_each_other_equally_often(count):
    square = np.array(balanced_square(count))
    times = len(square) // count
    for column in square.T:
        assert np.bincount(column).tolist() == [times] * count
    after = np.zeros((count, count), int)
    np.add.at(after, (square[:, :-1].ravel(), square[:, 1:].ravel()), 1)
    assert (after == times * (1 - np.eye(count, dtype=int))).all()


def test_every_four_participants_are_a_whole_square():
    found = list(orders(10, CONDITIONS, 1).values())
    for first in (0, 4):
        assert all({*column} == {*CONDITIONS} for column in zip(*found[first : first + 4], strict=True))
    assert orders(10, CONDITIONS, 1) == orders(10, CONDITIONS, 1) != orders(10, CONDITIONS, 2)


def test_a_new_study_is_private_and_reads_back(study):
    assert stat.S_IMODE(study.folder.stat().st_mode) == 0o700
    assert stat.S_IMODE((study.folder / "study.yaml").stat().st_mode) == 0o600
    assert load(study.folder) == study
    with pytest.raises(StudyError, match="exists: choose a new folder"):
        create(study.folder, 8, 3)


WRONG = [
    (lambda raw: raw.pop("goal_m"), "study.yaml: goal_m is missing"),
    (lambda raw: raw.update(goal_m=math.nan), "goal_m must be a finite number"),
    (lambda raw: raw.update(starts_m=[1, "x"]), r"starts_m\[1\] must be float \(got \'x\'\)"),
    (lambda raw: raw["participants"].update(P01=["ic", "ic"]), "participants.P01 must list 4 conditions"),
    (lambda raw: raw["participants"].update({"../x": ["ic"] * 4}), "a code is a letter and two or three digits"),
    (lambda raw: raw["texts"].pop("withdraw"), "texts.withdraw is missing"),
    (lambda raw: raw["questionnaires"][3]["items"].pop(), "score sus needs ten scales"),
    (lambda raw: raw["questionnaires"][1]["items"][0].update(kind="slider"), r"\[1\].items\[0\]: kind must be one of"),
    (lambda raw: raw["questionnaires"][1].update(id="drive"), "needs an id of its own"),
    (lambda raw: raw["arguments"].update(params="mine.yaml"), "arguments.params is set by the study itself"),
    (lambda raw: raw.update(questionnaires="none"), "questionnaires must be a list"),
    (lambda raw: raw.update(goal_m=0.1), r"goal_m must lie in 0.5..1000"),
    (lambda raw: raw["participants"].update(P01=5), r"participants.P01 must be a list of conditions \(got 5\)"),
    (lambda raw: raw["questionnaires"][2]["items"][3].update(revers=True), "'revers'; did you mean 'reverse'"),
    (lambda raw: raw["questionnaires"][0]["items"][0].update(options=[[1], "b"]), r"options\[0\] must be str"),
    (lambda raw: raw["questionnaires"][0]["items"][0].update(id="step"), "not step or action"),
    (lambda raw: raw["questionnaires"][0].update(id="withdraw"), "needs an id of its own"),
    (lambda raw: raw["questionnaires"][4]["items"][0].update(truth="driven"), "truth is for numbers, one of driven_m"),
    (lambda raw: raw["questionnaires"][1]["items"][0].update(step=0.5), "a scale has at most 101 points"),
]


@pytest.mark.parametrize(("change", "text"), WRONG, ids=[text for _, text in WRONG])
def test_a_wrong_study_is_refused_with_its_place(study, change, text):
    raw = yaml.safe_load((study.folder / "study.yaml").read_text())
    change(raw)
    save(study.folder / "study.yaml", yaml.safe_dump(raw))
    with pytest.raises(StudyError, match=text):
        load(study.folder)


def test_a_number_may_have_a_large_range(study):
    raw = yaml.safe_load((study.folder / "study.yaml").read_text())
    raw["questionnaires"][0]["items"].append({"id": "km", "kind": "number", "text": "?", "low": 0, "high": 1e9})
    save(study.folder / "study.yaml", yaml.safe_dump(raw))
    assert load(study.folder).questionnaires[0].items[-1].high == 1e9


# ---- scores and statistics


def test_sus_by_hand(study):
    sus = study.questionnaire("sus.1")
    # odd items 4, 5, 4, 4, 5: 3+4+3+3+4 = 17; even items 2, 1, 2, 3, 2: 3+4+3+2+3 = 15; 2.5 * 32 = 80
    answers = dict(zip([f"s{n}" for n in range(1, 11)], [4, 2, 5, 1, 4, 2, 4, 3, 5, 2], strict=True))
    assert stats.score(sus, answers) == 80.0
    assert stats.score(sus, dict.fromkeys(answers, 3)) == 50.0


def test_tlx_and_agency_by_hand(study):
    tlx = {"mental": 70, "physical": 10, "temporal": 40, "performance": 25, "effort": 55, "frustration": 40}
    assert stats.score(study.questionnaire("tlx.1"), tlx) == 40.0  # 240 / 6
    agency = {"command": 6, "cause": 7, "control": 5, "other": 2, "ignored": 1}  # reversed on 1..7: 6 and 7
    assert stats.score(study.questionnaire("agency.1"), agency) == pytest.approx((6 + 7 + 5 + 6 + 7) / 5)


def test_friedman_by_hand():
    # Ranks of three participants: (1, 2, 3), (1, 3, 2), (1, 2, 3); sums 3, 7, 8.
    # chi2 = 12 / (3 * 3 * 4) * (9 + 49 + 64) - 3 * 3 * 4 = 4.667; W = chi2 / (3 * 2) = 0.778.
    # Of the 216 equally likely rankings, 42 give this sum of squares or more (Friedman's table: p = 0.194).
    found = stats.friedman(np.array([[1.0, 2, 3], [10, 30, 20], [5, 6, 7]]))
    assert found is not None
    assert (found.chi2, found.w) == (pytest.approx(14 / 3), pytest.approx(7 / 9))
    assert found.p == pytest.approx(math.exp(-7 / 3))  # chi-square with two degrees of freedom
    assert found.p_exact == pytest.approx(42 / 216, abs=0.02)
    assert found.w_low <= found.w <= found.w_high


def test_friedman_agrees_with_scipy_where_there_are_ties():
    from scipy.stats import friedmanchisquare

    values = np.random.default_rng(3).integers(1, 6, (14, 4)).astype(float)
    found, oracle = stats.friedman(values), friedmanchisquare(*values.T)
    assert found is not None
    assert (found.chi2, found.p) == (pytest.approx(oracle.statistic), pytest.approx(oracle.pvalue))
    assert found.p_exact == pytest.approx(found.p, abs=0.05)


def test_nothing_is_tested_with_one_participant_or_equal_values():
    assert stats.friedman(np.ones((5, 4))) is None
    assert stats.friedman(np.array([[1.0, 2, 3, 4]])) is None
    assert stats.pairs({"a": np.ones(1), "b": np.ones(1)}) == []


def test_pairs_by_hand():
    # Differences 1, 2, 3, 4, 5, -6: rank sums 15 and 6 of 21, r = 9 / 21. W = 6 of 6: p = 0.4375 (exact).
    a, b = np.array([1.0, 2, 3, 4, 5, 0]), np.array([0.0, 0, 0, 0, 0, 6])
    (found,) = stats.pairs({"a": a, "b": b})
    assert found.r == pytest.approx(9 / 21)
    assert found.p == found.p_holm == pytest.approx(0.4375)
    assert stats.hodges_lehmann(np.array([1.0, 2, 6])) == 2.75  # of 1, 1.5, 2, 3.5, 4, 6
    assert found.low <= found.shift <= found.high


def test_holm_and_the_least_number_of_participants_by_hand():
    assert stats.holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])
    assert stats.least_participants(1) == 6  # 2 / 2**6 = 0.031
    assert stats.least_participants(6) == 8  # 6 * 2 / 2**8 = 0.047
    assert stats.mean_interval(np.array([1.0, 2, 3])) == pytest.approx((2.0, 2 - 2.4841, 2 + 2.4841), abs=1e-3)
    assert stats.share_interval(3, 5) == pytest.approx((0.2307, 0.8824), abs=1e-3)  # Wilson


# ---- answers


def test_what_a_browser_sends_is_checked(study):
    distance = study.questionnaire("distance.1")
    right, faults = forms.answers(distance, 4, {"driven": " 6,5 ", "ahead": "3"})
    assert (right, faults) == ({"driven": 6.5, "ahead": 3.0, "noticed": None}, {})
    for wrong in ("nan", "inf", "-1", "1e9", "six", "9" * 400, b"6", ["6"]):
        assert forms.answers(distance, 4, {"driven": wrong, "ahead": "3"})[1] == {"driven": "wrong"}
    assert forms.answers(distance, 4, {})[1] == {"driven": "missing", "ahead": "missing"}
    long = {"driven": "1", "ahead": "1", "noticed": "x" * 2001}
    assert forms.answers(distance, 4, long)[1] == {"noticed": "wrong"}
    tlx = study.questionnaire("tlx.1")
    assert forms.answers(tlx, 4, dict.fromkeys([i.id for i in tlx.items], "35"))[1] == {}
    assert forms.answers(tlx, 4, dict.fromkeys([i.id for i in tlx.items], "36"))[1]["mental"] == "wrong"
    compare = study.questionnaire("compare")
    assert forms.answers(compare, 4, {"appearance": "5", "usability": "0"})[1] == {"appearance": "wrong"}


@pytest.mark.parametrize("text", ["\N{WOMAN}\u200d\N{PERSONAL COMPUTER}", "\u0645\u06cc\u200c\u062e", "two\nlines"])
def test_text_of_every_language_is_kept(study, text):
    given = {"driven": "1", "ahead": "1", "noticed": f" {text}\0 "}
    right, faults = forms.answers(study.questionnaire("distance.1"), 4, given)
    assert (right["noticed"], faults) == (text, {})


def test_text_of_a_participant_is_no_html(study):
    found = study.questionnaire("distance.1")
    page = forms.questions(found, 4, study.texts, {"noticed": "<script>x</script>"}, {})
    assert "<script>" not in page and "&lt;script&gt;" in page


# ---- the measures


def control_state(pose, speed, stamp_ns):
    poses = dict.fromkeys(("robot_pose", "vbot_start", "vbot_pose", "vbot_target"), pose2_message(pose))
    twists = dict.fromkeys(("applied_command", "robot_twist"), twist_message(speed, 0.0))
    numbers = dict.fromkeys(("transitions", "vbot_action", "reason_code"), 0)
    numbers |= dict.fromkeys(("pose_gap_m", "yaw_gap_rad", "time_to_obstacle_s", "vbot_limit_m_s"), 0.0)
    return ControlState(
        header=header("map", stamp_ns), mode=ControlState.REAL, shown=ControlState.SHOWN_REAL, reason="", estop=False,
        blocked=False, holder="", operator_command=twist_message(speed, 0.0), **poses, **twists, **numbers,
    )  # fmt: skip


def test_measures_of_a_drive_by_hand(tmp_path):
    """Ten seconds of commands at 0.4 m/s; the robot stands in the fifth to the seventh second. One contact."""
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:

        def put(topic, message, at_s):
            kind = message.__msgtype__
            writer.write(topic, kind, serialize(message), round(at_s * 1e9) + 10**18, LATCHED)

        for n in range(240):
            at = n / 20  # a second without a command before
            driving = min(max(at - 1, 0), 10)
            x = 0.4 * (driving - min(max(driving - 4, 0), 2))
            command, stamp_ns = 0.4 if 1 <= at < 11 else 0.0, round(at * 1e9) + 10**18
            put("/ic/state", control_state((x, 0.0, 0.0), command, stamp_ns), at)
        for at_s, touching in ((0.1, False), (5.0, True), (5.5, False)):
            put("/ground_truth/contact", Bool(data=touching), at_s)
        put("/scan", scan_message(np.full(360, 2.5), -math.pi, math.pi / 180, 0.1, 30.0, "velodyne", 10**18), 10.9)
        put("/study/event", String(data="begin"), 0.2)
        put("/study/event", String(data="arrived"), 11.0)
        put("/ground_truth/contact", Bool(data=True), 11.5)  # after the end
    found = measures(bag)
    assert found["contacts"] == 1
    assert found["time_s"] == pytest.approx(10.0, abs=0.11)
    assert found["driven_m"] == pytest.approx(3.2, abs=0.02)
    assert found["longest_stall_s"] == pytest.approx(2.0, abs=0.2)
    assert found["ahead_m"] == pytest.approx(2.5)
    assert (found["switches"], found["virtual_s"]) == (0, 0.0)
    assert 0.7 < found["obedience"] < 0.9


@pytest.mark.parametrize("virtual", [False, True])
def test_states_at_uneven_times_do_not_look_like_disobedience(tmp_path, virtual):
    """A robot at a steady 0.4 m/s obeys all the time but for the start; a virtual one has no range ahead."""
    late_s = np.random.default_rng(1).uniform(0.0, 0.02, 200)
    with BagWriter(tmp_path / "bag") as writer:
        for n, late in enumerate(late_s):
            at = n / 20 + late
            stamp_ns = round(at * 1e9) + 10**18
            state = control_state((0.4 * at, 0.0, 0.0), 0.4, stamp_ns)
            state.shown = ControlState.SHOWN_VIRTUAL if virtual else ControlState.SHOWN_REAL
            writer.write("/ic/state", state.__msgtype__, serialize(state), stamp_ns, LATCHED)
        scan = scan_message(np.full(360, 2.5), -math.pi, math.pi / 180, 0.1, 30.0, "velodyne", 10**18)
        writer.write("/scan", scan.__msgtype__, serialize(scan), 10**18, LATCHED)
    found = measures(tmp_path / "bag")
    assert found["obedience"] > 0.95 and found["driven_m"] == pytest.approx(4.0, abs=0.05)
    assert found["ahead_m"] is None if virtual else found["ahead_m"] == pytest.approx(2.5)


def test_answers_join_the_bag_of_their_drive(study):
    """The page after a drive adds its answers; the drive's own messages and what the recorder noted stay."""
    record = Record(study, "P01")
    for step in study.steps()[: study.steps().index("distance.1")]:
        record.finish(step, filled(study, step))
    bag = record.folder / "drive1"
    with BagWriter(bag) as writer:
        writer.set_custom("instant_ic.note", "kept")
        writer.write(trial.EVENTS, String.__msgtype__, serialize(String(data="begin")), 10**18, LATCHED)
    with served(record) as server:

        async def go():
            async with aiohttp.ClientSession() as http:
                await _post(http, server.url, step="distance.1", driven="6.5", ahead="3", noticed="é")

        asyncio.run(go())
    with BagReader(bag) as reader:
        assert reader.custom["instant_ic.note"] == "kept" and not reader.unlisted
        texts = [deserialize(one.payload, one.type_name).data for one in reader.messages()]
    assert texts[0] == "begin" and len(texts) == 2
    expected = {"driven": 6.5, "ahead": 3.0, "noticed": "é"}
    assert json.loads(texts[1]) == {"questionnaire": "distance.1", "answers": expected}
    assert record.steps["distance.1"]["answers"] == expected


@pytest.mark.parametrize("key", ["worlds", "practice_world"])
def test_a_world_that_does_not_exist_is_found_before_the_participant_comes(study, key):
    wrong = replace(study, **{key: "corridr" if key == "practice_world" else (*study.worlds[:3], "corridr")})
    wrong = replace(wrong, participants={"P01": ("ic", "stop", "shared", "ic")})
    with pytest.raises(StudyError, match=r"study.yaml: world corridr: "):
        trial.make_scans(wrong, "P01")


def test_nothing_ahead_is_unknown():
    nothing = scan_message(np.full(360, np.inf), -math.pi, math.pi / 180, 0.1, 30.0, "velodyne", 10**18)
    assert ahead_m(nothing) is None


def test_each_condition_has_its_arguments_and_no_other_difference(study, tmp_path):
    found = {}
    for number in range(1, 5):
        drive = Drive(study, "P01", number)
        found[drive.method] = drive.arguments(tmp_path / "bag", tmp_path)
    own = {"arbiter", "vspace_source", "vspace_mesh", "vspace_mesh_pose"}
    assert {name: {*arguments} & own for name, arguments in found.items()} == {
        "ic": set(),
        "stop": {"arbiter"},
        "shared": {"arbiter"},
        "mesh": {"vspace_source", "vspace_mesh", "vspace_mesh_pose"},
    }
    start_m = study.start_x_m("P01", study.participants["P01"].index("mesh") + 1)
    assert found["mesh"]["vspace_mesh_pose"] == f"{-start_m},0,0,0"
    assert all(file.is_file() for file in trial.ARBITERS.values())
    assert Drive(study, "P01", 0).method == "stop"


# ---- blindness


def test_the_page_of_a_drive_is_the_same_in_all_conditions(study):
    """It is made of the step and the study's texts alone; no name of a condition is in it or in its address."""
    texts = study.texts
    page = drive_page("drive1", texts["bar_drive"], texts["finish"], texts["title"])
    assert "<title>Driving a robot</title>" in page and "Instant IC" not in page
    words = {*page.lower().replace("-", " ").split()}
    assert not words & {"ic", "shared", "mesh"}
    steps = " ".join(study.steps())
    assert not any(name in steps.replace("distance", "").replace("practice", "") for name in CONDITIONS)


def test_messages_to_the_page_name_no_mode_of_control():
    state = {"type": "state", "at_ms": 1, "mode": "real", "shown": "real", "robot": [0, 0, 0], "vbot": None}
    state |= {"twist": [0, 0], "reason": "the robot goes round by itself", "blocked": True, "transitions": 3}
    passed = json.loads(to_page(json.dumps(state)) or "")
    assert not passed.keys() & {"reason", "blocked", "transitions"} and passed["mode"] == "real"
    plan = {"type": "plan", "trajectory": [[0, 0]], "path": [[1, 1]], "subgoal": [1, 2, 3]}
    assert json.loads(to_page(json.dumps(plan)) or "") == {
        "type": "plan",
        "trajectory": [],
        "path": [],
        "subgoal": None,
    }
    health = {"type": "health", "vspace": {"state": "ready"}, "faults": [{"text": "nerf"}], "nodes": [1], "pace": "x"}
    assert json.loads(to_page(json.dumps(health)) or "")["vspace"] is None
    assert to_page('{"type": "recording", "path": "x"}') is None


@pytest.mark.parametrize("text", ["", "[]", "{", '{"type": "record", "on": true}', '{"type": ["drive"]}', "[" * 9000])
def test_only_driving_messages_go_to_the_robot(text):
    assert not from_page(text)
    assert from_page('{"type": "drive", "linear": 0.1}')


# ---- the pages over a socket


async def _post(http, url, **fields):
    async with http.post(url, data=fields, headers={"Origin": url.rstrip("/")}) as answer:
        return answer.status, await answer.text()


def test_consent_can_be_refused_and_nothing_is_kept(study):
    record = Record(study, "P01")
    with served(record) as server:

        async def go():
            async with aiohttp.ClientSession() as http:
                assert "Welcome" in (await _post(http, server.url, step="consent", action="maybe"))[1]
                return await _post(http, server.url, step="consent", action="refuse")

        assert "nothing was stored" in asyncio.run(go())[1]
        assert server.over.wait(10)
    assert not record.folder.exists()


def test_old_pages_wrong_origins_and_wrong_answers_change_nothing(study):
    record = Record(study, "P01")
    record.finish("consent", {"agreed": True})
    with served(record) as server:

        async def go():
            async with aiohttp.ClientSession() as http:
                elsewhere = {"Origin": "http://evil.example"}
                async with http.post(server.url, data={"step": "background"}, headers=elsewhere) as answer:
                    assert answer.status == 403
                async with http.get(server.url, headers={"Host": "evil.example"}) as answer:
                    assert answer.status == 403
                await _post(http, server.url, step="compare", appearance="1", usability="1")
                await _post(http, server.url, step="drive1", action="start")
                status, text = await _post(http, server.url, step="background", age="<b>", robots="never")
                assert status == 422 and "This answer is not possible." in text
                assert [*record.steps] == ["consent"]
                await _post(http, server.url, step="background", robots="never")
                async with http.get(f"{server.url}ws") as answer:
                    assert answer.status == 503  # no drive

        asyncio.run(go())
    kept = json.loads(record.path.read_text())
    assert kept["steps"]["background"]["answers"] == {"age": None, "robots": "never", "games": None}
    assert stat.S_IMODE(record.path.stat().st_mode) == 0o600


@pytest.mark.parametrize(("action", "left"), [("keep", True), ("delete", False)])
def test_a_participant_can_leave_in_the_middle_of_a_drive(study, action, left):
    record = Record(study, "P02")
    for step in study.steps()[: study.steps().index("drive1")]:
        record.finish(step, filled(study, step))
    with served(record) as server:

        async def go():
            async with aiohttp.ClientSession() as http:
                await _post(http, server.url, step="drive1", action="start")
                return await _post(http, server.url, step="withdraw", action=action)

        assert "Thank you" in asyncio.run(go())[1]
    assert record.folder.exists() is left
    assert Record(study, "P02").state == (WITHDRAWN if left else OPEN)


def test_nobody_reads_that_data_are_deleted_which_are_not(study, monkeypatch):
    record = Record(study, "P02")
    record.finish("consent", {"agreed": True})

    def busy(folder):
        raise OSError(39, "Directory not empty")

    monkeypatch.setattr("instant_ic.experiments.study.record.shutil.rmtree", busy)
    with served(record) as server:

        async def go():
            async with aiohttp.ClientSession() as http:
                return await _post(http, server.url, step="withdraw", action="delete")

        status, text = asyncio.run(go())
    assert status == 200 and "Please call the experimenter" in text and "deleted" not in text


class Unhurried(FakeTrial):
    """Keeps its first reason, as ``Trial``."""

    def end(self, why="participant", wait_s=0.0):
        if self.status != "done":
            super().end(why, wait_s)


@pytest.mark.parametrize("finished", [True, False])
def test_a_drive_that_has_ended_is_stored_at_an_interruption(study, finished):
    """The participant's page has not asked again; a drive in the middle is made again."""
    record = Record(study, "P02")
    for step in study.steps()[: study.steps().index("drive1")]:
        record.finish(step, filled(study, step))
    server = StudyServer(record, make_trial=Unhurried)
    server.start()
    try:

        async def go():
            async with aiohttp.ClientSession() as http:
                await _post(http, server.url, step="drive1", action="start")
                if finished:
                    fields = {"step": "drive1", "action": "finish"}
                    origin = {"Origin": server.url.rstrip("/")}
                    async with http.post(server.url, data=fields, headers=origin, allow_redirects=False):
                        pass

        asyncio.run(go())
    finally:
        server.stop()
    assert ("drive1" in Record(study, "P02").steps) is finished


def test_a_participant_continues_where_the_computer_went_off(study):
    record = Record(study, "P03")
    for step in study.steps()[:6]:
        record.finish(step, filled(study, step))
    assert Record(study, "P03").step == study.steps()[6]
    record.path.write_text("{")
    with pytest.raises(StudyError, match="is damaged"):
        Record(study, "P03")
    assert main(["study", "delete", str(study.folder), "P03"]) == 0
    assert not record.folder.exists()


def test_the_operators_page_goes_through_the_server(study):
    """Commands arrive at the console, and its messages come back without what names a condition."""
    record = Record(study, "P01")
    for step in study.steps()[: study.steps().index("drive1")]:
        record.finish(step, filled(study, step))

    async def go():
        async with fake_console() as (address, heard):
            FakeTrial.console = address
            with served(record) as server:
                async with aiohttp.ClientSession() as http:
                    await _post(http, server.url, step="drive1", action="start")
                    async with http.ws_connect(f"{server.url}ws", origin=server.url.rstrip("/")) as page:
                        await page.send_str('{"type": "record", "on": true}')
                        await page.send_str('{"type": "drive", "linear": 0.1}')
                        state = await page.receive_json(timeout=20)
                        image = await page.receive_bytes(timeout=20)
                    async with http.post(f"{server.url}estop", headers={"Origin": server.url.rstrip("/")}) as answer:
                        assert answer.status == 204
                    await _post(http, server.url, step="drive1", action="finish")
            return state, image, heard

    state, image, heard = asyncio.run(go())
    assert "reason" not in state and image == b"image"
    assert heard == ['{"type": "drive", "linear": 0.1}', "estop"]
    assert record.steps["drive1"]["end"] == "participant"


# ---- the report


def test_rows_join_answers_with_the_condition(study):
    finished_study(study, ["P01"])
    record = Record(study, "P01")
    found = rows(study, [record])
    assert [row["condition"] for row in found] == list(study.participants["P01"])
    assert found[0]["sus"] == 50.0  # all in the middle
    assert found[0]["distance.driven.error"] == pytest.approx(abs(5 - 7) / 7)
    codes, values = values_of(found, "sus", CONDITIONS)
    assert (codes, values.tolist()) == (["P01"], [[50.0] * 4])


def test_the_report_of_few_says_so_and_of_none_is_written(study, tmp_path):
    assert main(["study", "report", str(study.folder), "-o", str(tmp_path / "none")]) == 0
    finished_study(study, ["P01", "P02", "P03"])
    out = tmp_path / "report"
    assert main(["study", "report", str(study.folder), "-o", str(out)]) == 0
    page = (out / "report.html").read_text()
    assert "Too few participants: with 3" in page and "At least 8 are needed" in page
    assert "are programs that answer at random" in page
    data = json.loads((out / "report.json").read_text())
    assert data["participants"]["finished"] == 3 and len(data["drives"]) == 12
    assert page.count("<svg") == 2  # of tlx and agency: all others are equal here
    assert stat.S_IMODE(out.stat().st_mode) == 0o700
    assert stat.S_IMODE((out / "report.json").stat().st_mode) == 0o600


def test_the_report_counts_the_answers_about_the_group_without_codes(study, tmp_path):
    finished_study(study, ["P01", "P02", "P03"])
    for code, age in (("P01", "18-24"), ("P02", "35-44"), ("P03", "18-24")):
        record = Record(study, code)
        record.steps["background"]["answers"] = {"age": age, "robots": None, "games": "never"}
        record.save()
    assert main(["study", "report", str(study.folder), "-o", str(tmp_path / "report")]) == 0
    tables = json.loads((tmp_path / "report" / "report.json").read_text())["tables"]["participants"]
    found = {one["caption"]: one["rows"] for one in tables}
    assert found["Your age"] == [["18-24", 2], ["25-34", 0], ["35-44", 1], ["45-54", 0], ["55 or more", 0]]
    assert found["How often have you driven a robot or a drone?"][-1] == ["no answer", 3]


def test_random_answers_of_programs_are_not_mixed_with_those_of_people(study, tmp_path):
    finished_study(study, ["P01", "P02"], simulated=False)
    finished_study(study, ["P03"])
    assert main(["study", "report", str(study.folder), "-o", str(tmp_path / "report")]) == 0
    data = json.loads((tmp_path / "report" / "report.json").read_text())
    assert {row["participant"] for row in data["drives"]} == {"P01", "P02"}
    assert (data["participants"]["finished"], data["participants"]["simulated"]) == (3, 1)
    assert "They are left out" in (tmp_path / "report" / "report.html").read_text()


def test_time_of_drives_that_did_not_arrive_is_qualified(study, tmp_path):
    texts = []
    for end in ("arrived", "limit"):
        finished_study(study, ["P01"], simulated=False)
        record = Record(study, "P01")
        record.steps["drive1"]["end"] = end
        record.save()
        assert main(["study", "report", str(study.folder), "-o", str(tmp_path / end)]) == 0
        texts.append((tmp_path / end / "report.html").read_text())
    assert ["before the goal" in text for text in texts] == [False, True]


def test_a_study_of_one_condition_has_a_report(study, tmp_path):
    raw = yaml.safe_load((study.folder / "study.yaml").read_text())
    raw |= {"worlds": ["corridor-free"], "participants": {"P01": ["stop"]}}
    save(study.folder / "study.yaml", yaml.safe_dump(raw))
    finished_study(load(study.folder), ["P01"])
    assert main(["study", "report", str(study.folder), "-o", str(tmp_path / "report")]) == 0
    assert "Too few participants: with 1" in (tmp_path / "report" / "report.html").read_text()


def test_participants_are_known_by_code_only(study):
    with pytest.raises(StudyError, match="has no participant 'Alice'"):
        Record(study, "Alice")
    assert main(["study", "delete", str(study.folder), "../x"]) == 2


def test_a_finished_participant_is_not_run_again(study, capsys):
    finished_study(study, ["P01"], simulated=False)
    assert Record(study, "P01").state == DONE
    assert main(["study", "run", str(study.folder), "P01"]) == 2
    assert "P01 is done: take another code" in capsys.readouterr().err


def test_a_taken_port_is_named(study):
    with served(Record(study, "P01")) as server:
        second = StudyServer(Record(study, "P02"), server.port)
        with pytest.raises(StudyError, match=f"cannot listen on 127.0.0.1:{server.port}"):
            second.start()


class _Page:
    """A page of Playwright whose drive ends as ``fault`` says while it is asked for its pose."""

    keyboard = SimpleNamespace(down=lambda key: None, up=lambda key: None)

    def __init__(self, record, fault):
        self.record, self.fault = record, fault

    def goto(self, url):
        pass

    def locator(self, selector):
        return SimpleNamespace(count=lambda: 1)

    def evaluate(self, script):
        self.record.state = DONE
        raise playwright.Error(self.fault)


def test_a_simulated_participant_goes_on_when_the_page_does(study):
    record = Record(study, "P01")
    server = SimpleNamespace(record=record, url="http://127.0.0.1:9", pace=1.0)
    gone = "Page.evaluate: Execution context was destroyed, most likely because of a navigation"
    shown = []
    Participant(_Page(record, gone), 1, 60.0, lambda page, step: shown.append(step)).take_part(server)
    assert shown == ["end"]
    record.state = OPEN
    with pytest.raises(playwright.Error, match="closed"):
        Participant(_Page(record, "Target page has been closed"), 1, 60.0).take_part(server)
