"""``ic study``: balanced orders, the plan's file, the measures of a bag by hand, the pages, and the table."""

import asyncio
import json
import math
import stat
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from aiohttp.test_utils import TestClient, TestServer

from instant_ic.bag import BagWriter
from instant_ic.bus import LATCHED
from instant_ic.cli.main import main
from instant_ic.experiments.study.pages import StudyPages
from instant_ic.experiments.study.plan import CONDITIONS, Participant, StudyError, StudyPlan, create, load
from instant_ic.experiments.study.table import rows
from instant_ic.experiments.study.trial import arguments, make_scan, measures
from instant_ic.msg import Bool, ControlState, header, pose2_message, serialize, twist_message

DRIVE = {"end": "arrived", "bag": "drive1", "contacts": 0, "time_s": 30.0, "driven_m": 7.0, "obedience": 0.9}


@pytest.fixture
def study(tmp_path: Path) -> Path:
    create(tmp_path / "study", StudyPlan(participants=8, seed=3))
    return tmp_path / "study"


# ---- the plan


def test_every_six_participants_have_all_orders() -> None:
    found = list(StudyPlan(participants=14, seed=1).orders().values())
    assert all(count == 1 for block in (found[:6], found[6:12]) for count in Counter(block).values())
    for place in range(3):  # each condition has each place equally often
        assert Counter(order[place] for order in found[:6]) == dict.fromkeys(CONDITIONS, 2)
    assert StudyPlan(seed=1).orders() == StudyPlan(seed=1).orders() != StudyPlan(seed=2).orders()


def test_a_new_study_is_private_and_reads_back(study: Path) -> None:
    assert stat.S_IMODE(study.stat().st_mode) == 0o700
    assert load(study) == StudyPlan(participants=8, seed=3)
    with pytest.raises(StudyError, match="exists: choose a new folder"):
        create(study, StudyPlan())


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"goal_m": math.nan}, "goal_m"),
        ({"goal_m": 0.1}, "goal_m must lie in 0.5..1000"),
        ({"worlds": ["corridor:1"]}, "worlds must be 3, one a condition"),
        ({"gaol_m": 3.0}, "did you mean 'goal_m'"),
    ],
)
def test_a_wrong_study_is_refused_with_its_place(study: Path, change: dict[str, object], text: str) -> None:
    values = yaml.safe_load((study / "study.yaml").read_text())
    (study / "study.yaml").write_text(yaml.safe_dump(values | change))
    with pytest.raises(StudyError, match=text):
        load(study)


def test_a_code_that_is_not_planned_is_refused(study: Path) -> None:
    with pytest.raises(StudyError, match="no participant 'P09'; the codes are P01 to P08"):
        Participant.load(study, load(study), "P09")


# ---- the drives


def test_each_condition_has_its_arguments_and_no_other_difference(study: Path) -> None:
    plan = load(study)
    scan = study / "scans" / "corridor_1.glb"
    scan.parent.mkdir()
    scan.touch()
    found = {name: arguments(study, plan, 0, name, study / "bag") for name in CONDITIONS}
    own = {"vspace", "vspace_source", "vspace_mesh"}
    assert {name: {*given} & own for name, given in found.items()} == {
        "ic": set(),
        "mesh": {"vspace_source", "vspace_mesh"},
        "stop": {"vspace"},
    }
    assert found["mesh"]["vspace_mesh"] == scan.absolute()


def test_a_world_that_does_not_exist_is_found_before_the_participant_comes(study: Path) -> None:
    with pytest.raises(StudyError, match=r"study.yaml: world corridr: "):
        make_scan(study, "corridr", 0)


def control_state(x: float, speed: float, stamp_ns: int, virtual: bool = False) -> ControlState:
    poses = dict.fromkeys(("robot_pose", "vbot_start", "vbot_pose", "vbot_target"), pose2_message((x, 0.0, 0.0)))
    twists = dict.fromkeys(("applied_command", "robot_twist"), twist_message(speed, 0.0))
    numbers = dict.fromkeys(("transitions", "vbot_action", "reason_code"), 0)
    numbers |= dict.fromkeys(("pose_gap_m", "yaw_gap_rad", "time_to_obstacle_s", "vbot_limit_m_s"), 0.0)
    shown = ControlState.SHOWN_VIRTUAL if virtual else ControlState.SHOWN_REAL
    return ControlState(
        header=header("map", stamp_ns), mode=ControlState.REAL, shown=shown, reason="", estop=False,
        blocked=False, holder="", operator_command=twist_message(speed, 0.0), **poses, **twists, **numbers,
    )  # fmt: skip


def test_measures_of_a_drive_by_hand(tmp_path: Path) -> None:
    """Ten seconds of commands at 0.4 m/s; the robot stands in the fifth to the seventh second. One contact."""
    with BagWriter(tmp_path / "bag") as writer:

        def put(topic: str, message: object, at_s: float) -> None:
            writer.write(topic, message.__msgtype__, serialize(message), round(at_s * 1e9) + 10**18, LATCHED)

        for n in range(240):
            at = n / 20  # a second without a command before
            driving = min(max(at - 1, 0), 10)
            x = 0.4 * (driving - min(max(driving - 4, 0), 2))
            command, stamp_ns = 0.4 if 1 <= at < 11 else 0.0, round(at * 1e9) + 10**18
            put("/ic/state", control_state(x, command, stamp_ns), at)
        for at_s, touching in ((0.1, False), (5.0, True), (5.5, False)):
            put("/ground_truth/contact", Bool(data=touching), at_s)
    found = measures(tmp_path / "bag")
    assert found["contacts"] == 1
    assert found["time_s"] == pytest.approx(10.0, abs=0.11)
    assert found["driven_m"] == pytest.approx(3.2, abs=0.03)
    assert 0.7 < found["obedience"] < 0.9


@pytest.mark.parametrize("virtual", [False, True])
def test_states_at_uneven_times_do_not_look_like_disobedience(tmp_path: Path, virtual: bool) -> None:
    """A robot at a steady 0.4 m/s obeys all the time but for the start."""
    late_s = np.random.default_rng(1).uniform(0.0, 0.02, 200)
    with BagWriter(tmp_path / "bag") as writer:
        for n, late in enumerate(late_s):
            at = n / 20 + late
            stamp_ns = round(at * 1e9) + 10**18
            state = control_state(0.4 * at, 0.4, stamp_ns, virtual)
            writer.write("/ic/state", state.__msgtype__, serialize(state), stamp_ns, LATCHED)
    found = measures(tmp_path / "bag")
    assert found["obedience"] > 0.95 and found["driven_m"] == pytest.approx(4.0, abs=0.05)


# ---- the pages


class ReadyTrial:
    """A drive that is ready at once."""

    console = "http://127.0.0.1:9/"

    def __init__(self, number: int, condition: str, bag: Path) -> None:
        self.condition, self.bag, self.status, self.result = condition, bag, "ready", {}
        bag.mkdir(parents=True)

    def end(self, wait_s: float = 0.0) -> None:
        self.status, self.result = "done", {**DRIVE, "bag": self.bag.name}


def test_a_participant_from_the_first_page_to_the_last(study: Path) -> None:
    """No page names a condition, old pages and wrong answers change nothing, and an interrupted drive is repeated."""
    participant = Participant.load(study, load(study), "P01")

    async def go() -> str:
        pages = StudyPages(participant, ReadyTrial)
        async with TestClient(TestServer(pages.app())) as http:

            async def post(expected: int = 200, **fields: str) -> str:
                async with http.post("/", data=fields) as answer:
                    assert answer.status == expected
                    return await answer.text()

            seen = ""
            for number in ("1", "2", "3"):
                seen += await post(step=number, action="start")
                assert ReadyTrial.console in seen
                await post(step="9", action="end")
                seen += await post(step=number, action="end")
            text = {"text": "<script>é"}
            assert "answer both questions" in await post(422, step="4", appearance="4", usability="0", **text)
            assert "shorten the text" in await post(422, step="4", appearance="2", usability="0", text="x" * 2001)
            seen += await post(step="4", appearance="2", usability="0", **text)
            assert pages.finished.is_set()
            await post(step="4", appearance="1", usability="1")  # a second answer does not count
        return seen

    seen = asyncio.run(go())
    assert "Thank you" in seen and not {*seen.lower().split()} & {"ic", "mesh", "stop", "virtual"}
    kept = Participant.load(study, load(study), "P01")
    assert [drive["bag"] for drive in kept.drives] == ["drive1", "drive2", "drive3"]
    assert kept.answers == {"appearance": 2, "usability": 0, "text": "<script>é"}


def test_an_interrupted_drive_keeps_its_bag_and_is_driven_again(study: Path) -> None:
    participant = Participant.load(study, load(study), "P01")
    (participant.folder / "drive1").mkdir(parents=True)

    async def go() -> None:
        async with TestClient(TestServer(StudyPages(participant, ReadyTrial).app())) as http:
            await http.post("/", data={"step": "1", "action": "start"})
            await http.post("/", data={"step": "1", "action": "end"})

    asyncio.run(go())
    assert participant.drives[0]["bag"] == "drive1-attempt2"


@pytest.mark.parametrize("headers", [{"Origin": "http://evil.example"}, {"Host": "evil.example"}])
def test_other_sites_are_refused(study: Path, headers: dict[str, str]) -> None:
    async def go() -> int:
        pages = StudyPages(Participant.load(study, load(study), "P01"), ReadyTrial)
        async with TestClient(TestServer(pages.app())) as http:
            return (await http.post("/", data={"step": "1", "action": "start"}, headers=headers)).status

    assert asyncio.run(go()) == 403


# ---- the table


def test_drives_and_votes_by_condition(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two participants vote for the drive with the scan, one of them sees no difference in use; a third goes on."""
    plan = load(study)
    done = [Participant.load(study, plan, code) for code in ("P01", "P02", "P03")]
    for number, one in enumerate(done):
        one.drives = [{**DRIVE, "time_s": 30.0 + 10.0 * number, "contacts": number} for _ in one.order]
        if number < 2:
            one.answers = {"appearance": one.order.index("mesh") + 1, "usability": number, "text": "smooth"}
        one.save()
    found = {row["condition"]: row for row in rows(done)}
    assert {name: row["appearance"] for name, row in found.items()} == {
        "ic": 0,
        "mesh": 2,
        "stop": 0,
        "no difference": 0,
    }
    assert found["no difference"]["usability"] == 1
    assert (found["ic"]["drives"], found["ic"]["arrived"], found["ic"]["contacts"]) == (2, 2, 0.5)
    assert found["ic"]["time_s"] == 35.0
    assert main(["study", "table", str(study)]) == 0
    assert "P01: smooth" in capsys.readouterr().out


def test_a_damaged_record_is_named(study: Path) -> None:
    participant = Participant.load(study, load(study), "P01")
    participant.save()
    (participant.folder / "answers.json").write_text(json.dumps({"order": []}))
    with pytest.raises(StudyError, match=r"P01/answers.json is damaged"):
        Participant.load(study, load(study), "P01")
