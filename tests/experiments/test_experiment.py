"""``ic experiment``: scans against exact rooms, units that resume, the report, and a quick run of the command."""

import dataclasses
import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_ic.bag.writer import BagWriter
from instant_ic.bus import LATCHED
from instant_ic.cli.main import main
from instant_ic.experiments import (
    ablation,
    compared,
    environments,
    lab,
    operators,
    reconstruction,
    report,
    teleoperation,
    training_time,
    vspace,
)
from instant_ic.experiments.depth_lidar import measure_world
from instant_ic.experiments.lab import Options, Result, Unit
from instant_ic.experiments.plots import curves_svg, image_strip
from instant_ic.experiments.recorded_drive import still_times
from instant_ic.experiments.scan import (
    ScanQuality,
    Station,
    aged,
    best_stations,
    fuse,
    scan_world,
    station_places,
)
from instant_ic.experiments.teleop_figures import DriveLog
from instant_ic.experiments.vspace_sources import VspaceSettings
from instant_ic.experiments.worlds import moved_by, named_world, things
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import (
    ControlState,
    Keyframe,
    compressed_image_message,
    header,
    image_message,
    pose_message,
    serialize,
    twist_message,
)
from instant_ic.sim.building import Building, Zone
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.world import Material
from instant_ic.vspace import VirtualSpaceConfig
from instant_ic.vspace.mesh_space import MeshSpace
from tests import box_room

FINE = ScanQuality(0.0, 0.0, 0.0, 0.06, 3.0, 1024, 0.0, 0.0)


def station(pose: np.ndarray, height: int = 256) -> Station:
    room = box_room.panorama(pose, height)
    return Station(pose, room.depth_m, room.rgb)


def box_world(x: float, poster: str = "poster:1"):
    building = Building()
    room = building.add(Zone(-2.0, -1.5, 3.0, 1.5, 2.5))
    building.picture(room, "north", 2.5, 1.4, (0.5, 0.7), Material(poster))
    building.picture(room, "south", 2.5, 1.4, (0.5, 0.7), Material("poster:2"))
    building.builder.box((x, 0.0), (0.5, 0.5, 0.7))
    return building.world("room", (0.0, 0.0, 0.0), light_cell_m=1.0, rays=1)


def test_the_mesh_of_exact_ranges_lies_on_the_walls() -> None:
    vertices, faces = fuse([station(np.eye(4))], 0.1)
    vertices = vertices[np.unique(faces)]
    low, high = box_room.ROOM_LOW, box_room.ROOM_HIGH
    to_wall = np.abs(np.concatenate([vertices - low, vertices - high], axis=1)).min(axis=1)
    outside_box = np.maximum(box_room.BOX_LOW - vertices, vertices - box_room.BOX_HIGH).max(axis=1)
    error = np.minimum(to_wall, np.abs(outside_box))
    assert len(faces) > 5000 and np.quantile(error, 0.95) < 0.03 and np.median(error) < 0.01
    # Behind the box nothing was measured: a hole in the far wall, at its height and bearing.
    behind = (vertices[:, 0] > 3.9) & (np.abs(vertices[:, 1] - 1.6) < 0.1) & (np.abs(vertices[:, 2] + 0.9) < 0.1)
    assert not behind.any()


def test_a_triangle_gets_the_nearest_station_that_sees_it() -> None:
    near, far = station(pose_matrix(2.8)), station(pose_matrix(-1.0))
    corner = np.array([[4.0, -1.0, 0.0], [4.0, -0.9, 0.0], [4.0, -1.0, 0.1]])
    hidden = corner + [0.0, 0.0, 5.0]
    assert best_stations(np.stack([corner, hidden]), [far, near], 0.1).tolist() == [1, -1]


def test_an_object_moves_with_its_looks() -> None:
    world, there = box_world(1.5), box_world(1.9)
    owner, _, _ = things(world)
    assert set(np.unique(owner)) == {0, 1} and (owner == 1).sum() == 5
    moved = moved_by(world, owner == 1, np.array([0.4, 0.0, 0.0]))
    pose = pose_matrix(0.0, 0.0, 1.2)
    ours, theirs = (EquirectRenderer(one).render(pose, 128, 64) for one in (moved, there))
    assert np.abs(ours.depth_m - theirs.depth_m).max() < 1e-3


def test_an_older_world_has_other_colours_and_objects_elsewhere() -> None:
    world = box_world(1.5)
    same = aged(world, FINE, np.random.default_rng(0))
    assert np.array_equal(same.vertices, world.vertices) and np.allclose(same.tint, world.tint)
    older = aged(world, dataclasses.replace(FINE, older=1.0, colour=0.1), np.random.default_rng(1))
    shift = np.abs(older.vertices - world.vertices).max(axis=0)
    assert 0 < shift[:2].max() <= 0.4 and shift[2] == 0
    assert not np.allclose(older.tint, world.tint)


def test_stations_keep_their_distance() -> None:
    places = station_places(box_world(1.5), (0.0, 0.0, 0.0), 1.0, np.random.default_rng(0))
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)[~np.eye(len(places), dtype=bool)]
    assert len(places) >= 4 and apart.min() >= 1.0
    with pytest.raises(ValueError, match="no free floor"):
        station_places(box_world(1.5), (50.0, 0.0, 0.0), 1.0, np.random.default_rng(0))


def test_a_good_scan_shows_the_room_and_a_bad_one_less(tmp_path) -> None:
    world, pose = box_world(1.5), pose_matrix(-0.5, 0.2, 1.2)
    truth = EquirectRenderer(world).render_perspective(pose, 96, 54, math.pi / 2, supersample=2).rgb
    seen = {}
    for name, quality in (("fine", FINE), ("bad", ScanQuality(0.02, 0.06, 1.0, 0.08, width=512))):
        made = scan_world(world, (0.0, 0.0, 0.0), quality, 0, tmp_path / f"{name}.glb")
        assert made["stations"] >= 1 and made["triangles"] > 1000
        space = MeshSpace(VirtualSpaceConfig(source="mesh", mesh=str(tmp_path / f"{name}.glb"), mesh_fit_colours=False))
        seen[name] = psnr_db(space.render(pose, 96, 54, math.pi / 2).rgb, truth)
    assert seen["fine"] > 22 and seen["fine"] > seen["bad"] + 3


def test_a_scan_in_the_frame_of_a_start_shows_the_same(tmp_path) -> None:
    coarse = dataclasses.replace(FINE, cell_m=0.2, width=256)
    origin, pose = (0.5, 0.3, 1.0), pose_matrix(-0.5, 0.2, 1.2)
    views = []
    for name, start in (("map", (0.0, 0.0, 0.0)), ("start", origin)):
        scan_world(box_world(1.5), (0.0, 0.0, 0.0), coarse, 0, tmp_path / f"{name}.glb", start)
        mesh = str(tmp_path / f"{name}.glb")
        space = MeshSpace(VirtualSpaceConfig(source="mesh", mesh=mesh, mesh_fit_colours=False))
        map_from_start = pose_matrix(start[0], start[1], yaw=start[2])
        views.append(space.render(np.linalg.inv(map_from_start) @ pose, 64, 36, math.pi / 2).rgb)
    assert psnr_db(*views) > 35


def test_cases_of_worlds_and_seeds() -> None:
    assert Options(2, ("corridor", "random:7", "house.glb")).cases() == [
        ("corridor:0", 0), ("corridor:1", 0), ("random:7", 0), ("house.glb", 0), ("house.glb", 1),
    ]  # fmt: skip
    assert Options(2, ("random:0", "random")).cases() == [("random:0", 0), ("random:1", 0)]


def test_finished_units_are_kept_and_failed_ones_tried_again(tmp_path, monkeypatch) -> None:
    calls = []

    def measure(arguments):
        calls.append(arguments["n"])
        if arguments["n"] == 2 and calls.count(2) == 1:
            raise ValueError("no floor here")
        return {"rows": [{"value": math.nan}], "n": arguments["n"]}

    monkeypatch.setattr(reconstruction, "measure", measure)
    units = [Unit("reconstruction", {"n": n}) for n in (1, 2)]
    first = lab.run(units, tmp_path, 1, unit_timeout_s=None)
    assert [one.error for one in first] == ["", "no floor here"] and first[0].data["rows"] == [{"value": None}]
    second = lab.run(units, tmp_path, 1, unit_timeout_s=None)
    assert calls == [1, 2, 2] and [one.data["n"] for one in second] == [1, 2]
    (tmp_path / f"{units[0].key}.json").write_text("{")
    lab.run(units, tmp_path, 1, unit_timeout_s=None)
    assert calls == [1, 2, 2, 1]
    late = lab.run([Unit("reconstruction", {"n": n}) for n in (2, 3)], tmp_path, 1, timeout_s=-1.0)
    assert calls == [1, 2, 2, 1]
    assert [one.error for one in late] == ["", "not measured: the time limit of -1 s has passed"]


def test_results_of_another_program_or_another_file_are_not_used(tmp_path, monkeypatch) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "a.mcap").write_bytes(b"1")
    unit, world = Unit("reconstruction", {"bag": str(bag)}), Unit("reconstruction", {"world": "corridor:0"})
    first = unit.key, world.key
    assert (unit.key, world.key) == first and Unit("reconstruction", {"world": "corridor:0"}).key == first[1]
    (bag / "a.mcap").write_bytes(b"12")
    assert unit.key != first[0] and world.key == first[1]
    monkeypatch.setattr(lab, "program_hash", lambda: "other")
    assert world.key != first[1]


def test_an_unexpected_error_ends_its_unit_only(tmp_path, monkeypatch) -> None:
    def measure(arguments):
        return {"share": 1 / arguments["n"]}

    monkeypatch.setattr(reconstruction, "measure", measure)
    found = lab.run([Unit("reconstruction", {"n": n}) for n in (0, 1)], tmp_path, 1, unit_timeout_s=None)
    assert [one.error for one in found] == ["ZeroDivisionError: division by zero", ""]


def test_two_meshes_of_one_name_are_not_averaged_and_each_kind_of_world_shows_images() -> None:
    options = Options(2, ("a/house.glb", "b/house.glb", "random:7", "random:9"))
    units = compared.view_units("ablation", options, ("ours",), ())
    shown = [compared.family(Result(unit, {}, 0.0, 0.0)) for unit in units if unit.arguments["images"]]
    assert shown == ["a/house.glb", "b/house.glb", "random"]
    worlds = "--world a/house.glb --world b/house.glb --world random:7 --world random:9"
    command = f"ic experiment ablation {worlds} --seeds 2 -o REPORT"
    assert compared.command_of(options, "ablation") == command
    recording = Options(2, bag=Path("my {drive}"))
    assert compared.command_of(recording, "ablation") == "ic experiment ablation --bag 'my {drive}' --seeds 2 -o REPORT"


def test_the_report_needs_no_other_file(tmp_path) -> None:
    assert report.spread([1.0, 3.0, None]) == "2.00 ± 1.41" and report.spread([]) == "–"
    tile = np.zeros((9, 16, 3), np.uint8)
    strip = image_strip(["truth", "ours"], [("1 m", [tile, tile])], 32)
    assert strip.shape == (24 + 18, 64 + 2 * 32, 3)
    svg = curves_svg([("m", "dB", {"ours": {0.0: [1.0, 2.0], 1.0: [3.0]}})])
    assert svg.startswith("<svg") and "currentColor" in svg and "#010203" not in svg
    table = report.Table("PSNR <dB>", ("source", "1 m"), [["ours", [0.5, 0.7]]], "ic experiment ablation")
    section = report.Section("Title", [report.Text("a & b"), table, report.Figure("curves", svg)])
    result = Result(Unit("ablation", {"world": "corridor:0"}), {}, 1.0, 1.0, "it broke")
    report.write(tmp_path, {"ablation": section}, [result], {"cpu": "one"})
    page = (tmp_path / "report.html").read_text()
    assert "PSNR &lt;dB&gt;" in page and "0.600 ± 0.141" in page and "it broke" in page
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", page.replace("http://www.w3.org", ""))
    kept = json.loads((tmp_path / "report.json").read_text())
    assert list(kept["paper"]) == list(report.PAPER) and kept["paper"]["flow"]["held"] is None


def view_result(world: str, values: dict[str, float], path: str = "straight") -> Result:
    """A result with PSNR and SSIM (a hundredth) of each source, at 1 m."""
    rows = [
        {"path": path, "source": name, "distance_m": 1.0, "psnr_db": value, "ssim": value / 100}
        for name, value in values.items()
    ]
    data = {"rows": rows, "depth": {"mean_relative_error": 0.1}, "slam_error_m": {path: 0.02}, "images": {}}
    return Result(Unit("environments", {"world": world, "seed": 0, "start_seed": 0}), data, 1.0, 1.0)


def test_a_place_fails_for_its_largest_measured_loss() -> None:
    corridor = view_result("corridor:0", {"ours": 26, "fill": 29, "exact-fill": 30, "slam-pose": 25.5, "panorama": 15})
    windows = view_result("windows:0", {"ours": 20, "fill": 21, "exact-fill": 25, "slam-pose": 19, "panorama": 18})
    assert environments.losses(windows, "ours") == {"depth": 4.0, "unseen": 1.0, "pose": 1.0}
    assert [environments.reason(environments.losses(one, "ours")) for one in (corridor, windows)] == [
        "unseen", "depth",
    ]  # fmt: skip
    assert environments.reason({"depth": 0.1, "unseen": None}) == "resolution"
    section = environments.section([corridor, windows], Options())
    kinds = section.parts[1]
    assert isinstance(kinds, report.Table)
    assert [(line[0], line[3], line[4]) for line in kinds.rows] == [
        ("corridor with windows side by side", "1 of 1", "depth (1)"),
        ("corridor with side rooms", "0 of 1", "unseen (1)"),
    ]
    assert section.answers["places"].held is True
    assert environments.section([corridor], Options()).answers == {}


def test_the_papers_claims_follow_from_the_rows() -> None:
    def along(ours: list[float], scan: list[float]) -> Result:
        rows = [
            {"path": path, "source": name, "distance_m": 0.5 * k, "psnr_db": 100 * value, "ssim": value}
            for path in ("straight", "curve")
            for name, values in (("ours", ours), ("tripod", scan))
            for k, value in enumerate(values)
        ]
        arguments = {"world": "corridor:0", "seed": 0}
        return Result(Unit("reconstruction", arguments), {"rows": rows, "images": {}}, 1.0, 1.0)

    # Above at 0.5, 1 and 1.5 m, below at 2 m: enough for the curve, not for the straight way.
    answers = reconstruction.section([along([0.9] * 5, [0.8, 0.8, 0.8, 0.8, 0.95])], Options()).answers
    assert (answers["straight"].held, answers["curve"].held) == (False, True)
    assert "up to 1.5 (1) m" in answers["straight"].figures
    assert reconstruction.section([], Options()).answers["straight"].held is None
    one = view_result("corridor:0", {"ours": 26, "no-depth": 17, "no-scale": 27, "paper": 18, "paper-no-scale": 17})
    answers = ablation.section([one], Options()).answers
    assert (answers["depth"].held, answers["scaling"].held) == (True, False)
    assert answers["scaling"].figures == (
        "ours against no-scale: -1.0 dB, -0.010 SSIM; paper against paper-no-scale: +1.0 dB, +0.010 SSIM"
    )
    assert ablation.section([one], Options(method="paper")).answers["scaling"].held is True


def test_every_section_is_written_without_results(tmp_path) -> None:
    options = Options()
    sections = {name: lab.module(name).section([], options) for name in lab.EXPERIMENTS}
    report.write(tmp_path, sections, [], {})
    assert (tmp_path / "report.html").read_text().count("not measured") >= len(report.PAPER)
    assert {unit.experiment for name in lab.EXPERIMENTS for unit in lab.module(name).units(options)} == {*sections}


def test_places_have_what_they_are_named_for() -> None:
    glass = named_world("windows:0")
    upright = (glass.emission > 0) & (np.abs(glass.normal[:, 2]) < 0.5)
    assert upright.sum() >= 6
    points, through = (
        measure_world(EquirectRenderer(glass), pose_matrix(0.0, 0.0, 1.2), 1.3, 1.2, None, through)
        for through in (False, True)
    )
    assert len(through) < 0.95 * len(points)
    with pytest.raises(ValueError, match="must be an integer"):
        named_world("hall:big")


def test_a_path_is_driven_with_the_poses_of_slam(monkeypatch) -> None:
    world = box_world(1.5)

    class Found:
        online = np.zeros((50, 4))

    def run_log(entries):
        found = Found()
        found.online = np.column_stack([np.zeros(len(entries)), np.zeros((len(entries), 3))])
        return found

    monkeypatch.setattr("instant_ic.experiments.slam.run_log", run_log)
    poses = [pose_matrix(x, 1.0, 1.2) for x in (-1.0, -0.5, 0.0)]
    errors = vspace.slam_errors(world, poses, VspaceSettings())
    # An estimate that never moves is wrong by the way, backwards.
    assert errors is not None and errors[:, 0] == pytest.approx([0.0, -0.5, -0.9], abs=0.12)
    assert vspace.slam_errors(world, poses[:1], VspaceSettings()) is None


def test_a_recorded_drive_is_shown(tmp_path) -> None:
    kinds = {"state": "instant_ic_msgs/msg/ControlState", "key": "instant_ic_msgs/msg/Keyframe"}
    with BagWriter(tmp_path / "bag") as writer:
        start, room = 10**9, box_room.panorama(np.eye(4), 128)
        photo = cv2.imencode(".png", room.rgb[..., ::-1])[1].tobytes()
        picture = compressed_image_message(photo, "camera", start)
        for number in range(120):  # 6 s at 20 Hz, in the virtual space from 2 to 4 s
            stamp, virtual = start + number * 50_000_000, 40 <= number < 80
            x = 0.01 * number
            state = ControlState(
                header=header("map", stamp), mode=int(virtual), reason="", estop=False, blocked=False, transitions=0,
                robot_pose=pose_message(pose_matrix(x)), vbot_start=pose_message(np.eye(4)),
                vbot_pose=pose_message(pose_matrix(x, 0.3)), operator_command=twist_message(0.2, 0.0),
                applied_command=twist_message(0.2, 0.0), pose_gap_m=0.3, yaw_gap_rad=0.0, time_to_obstacle_s=1.0,
                shown=int(virtual), vbot_action=0, vbot_target=pose_message(np.eye(4)),
                robot_twist=twist_message(0.2, 0.0), vbot_limit_m_s=0.4, reason_code=0, holder="",
            )  # fmt: skip
            writer.write("/ic/state", kinds["state"], bytes(serialize(state)), stamp)
            if number % 4 == 0:
                kind = "sensor_msgs/msg/CompressedImage"
                writer.write("/camera/image/compressed", kind, bytes(serialize(picture)), stamp)
        key = keyframe(0, 0.0, room, start)
        writer.write("/keyframe", kinds["key"], bytes(serialize(key)), start + 10_000_000, LATCHED)
    options = Options(bag=tmp_path / "bag")
    (unit,) = teleoperation.units(options)
    found = teleoperation.measure(unit.arguments)
    drive = found["drive"]
    assert [one["to_virtual"] for one in drive["switches"]] == [True, False]
    assert drive["gap_max_m"] == pytest.approx(0.3) and drive["obedience"] > 0.95
    assert drive["mode_seconds"]["virtual"] == pytest.approx(2.0, abs=0.06)
    stills = [name for name in found["images"] if name[0].isdigit()]
    assert [name.split()[-1] for name in stills] == ["real", "virtual", "virtual", "virtual", "real"]
    assert {"Trajectories of r-bot and v-bot", "State over time"} < {*found["images"]}
    section = teleoperation.section([Result(unit, found, 1.0, 1.0)], options)
    assert section.answers["flow"].held is True
    with pytest.raises(ValueError, match="does not react"):
        operators.units(options)
    with pytest.raises(ValueError, match="/ic/state is missing"):
        with BagWriter(tmp_path / "other") as writer:
            writer.write("/keyframe", kinds["key"], bytes(serialize(key)), start, LATCHED)
        teleoperation.measure({"bag": str(tmp_path / "other")})
    with pytest.raises(ValueError, match="/ic/state has the type Keyframe, not ControlState"):
        with BagWriter(tmp_path / "wrong") as writer:
            for topic in ("/ic/state", "/camera/image/compressed", "/keyframe"):
                writer.write(topic, kinds["key"], bytes(serialize(key)), start, LATCHED)
        teleoperation.measure({"bag": str(tmp_path / "wrong")})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "0"], "--seeds: must be > 0"),
        (["--jobs", "0"], "--jobs: must be > 0"),
        (["--timeout", "nan"], "--timeout: must be > 0"),
        (["--timeout", "inf"], "--timeout: must be finite"),
        (["--bag", "drive", "--world", "random"], "leave out --world"),
        (["--bag", "drive", "--method", "paper"], "Leave out --method"),
        (["--bag", "drive", "--meshes", "."], "leave out --world and --meshes"),
        (["--meshes", "/nowhere"], "has no mesh"),
        (["--unit-timeout", "0"], "--unit-timeout: must be > 0"),
    ],
)
def test_wrong_options_are_reported_before_anything_is_measured(arguments, words, tmp_path, capsys) -> None:
    try:
        status = main(["experiment", "reconstruction", "-o", str(tmp_path), *arguments])
    except SystemExit as end:
        status = end.code
    assert status == 2 and words in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_world_that_is_not_there_is_reported_with_the_rest(tmp_path, capsys) -> None:
    assert main(["experiment", "ablation", "--quick", "--jobs", "1", "--world", "no.glb", "-o", str(tmp_path)]) == 1
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ic: ")]
    assert len(errors) == 1 and "no.glb" in errors[0] and "no.glb" in (tmp_path / "report.html").read_text()


def keyframe(number: int, x: float, room: box_room.RoomPicture, stamp: int) -> Keyframe:
    return Keyframe(
        header=header("map", stamp),
        id=number,
        pose=pose_message(pose_matrix(x)),
        panorama=compressed_image_message(cv2.imencode(".png", room.rgb[..., ::-1])[1].tobytes(), "camera", stamp),
        depth=image_message(room.depth_m, "32FC1", "camera", stamp),
        sigma=image_message(np.empty((0, 0), np.uint8), "mono8", "camera", stamp),
        source="network",
        scale=1.0,
        quality=0.9,
        relative_sigma=0.03,
        fit=True,
        message="",
    )


def test_a_recording_shows_what_later_panoramas_saw(tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for number, x in enumerate((0.0, 0.5, 1.0)):
            message = keyframe(number, x, box_room.panorama(pose_matrix(x), 128), 7)
            kind = "instant_ic_msgs/msg/Keyframe"
            writer.write("/keyframe", kind, bytes(serialize(message)), 10**9 * (number + 1), LATCHED)
    options = Options(5, bag=tmp_path / "bag")
    units = reconstruction.units(options)
    assert [unit.arguments["number"] for unit in units] == [0, 1]
    small = {"panorama_width": 256, "size": [48, 32], "seconds": 0.1}
    found = reconstruction.measure({**units[0].arguments, **small, "sources": ["panorama", "depth-warp"]})
    psnr = {(row["source"], row["distance_m"]): row["psnr_db"] for row in found["rows"]}
    assert set(psnr) == {(source, at) for source in ("panorama", "depth-warp") for at in (0.5, 1.0)}
    assert psnr["depth-warp", 0.5] > psnr["panorama", 0.5] + 3
    assert found["images"]["recorded"].startswith("data:image/jpeg")
    results = [Result(units[0], found, 1.0, 1.0)]
    assert "recorded" in str(reconstruction.section(results, options).parts)
    (first, _) = environments.units(options)
    assert first.arguments["sources"] == ["ours", "fill", "panorama"]
    place = Result(first, environments.measure({**first.arguments, **small, "images": False}), 1.0, 1.0)
    lost = environments.losses(place, "ours")
    assert lost["unseen"] is not None and lost["unseen"] >= 0 and lost["depth"] is lost["pose"] is None
    (trained, _) = training_time.units(Options(5, bag=tmp_path / "bag", quick=True))
    rows = training_time.measure({**trained.arguments, **small, "times_s": [0.05]})["rows"]
    assert {(row["source"], row["distance_m"]) for row in rows} == {
        (source, at) for source in ("ours", "field", "paper") for at in (0.0, 1.0)
    }
    with pytest.raises(ValueError, match="/keyframe is missing"):
        with BagWriter(tmp_path / "empty"):
            pass
        reconstruction.units(Options(5, bag=tmp_path / "empty"))


def test_stills_are_before_first_middle_last_and_after() -> None:
    shown = [False] * 40 + [True] * 21 + [False] * 10
    log = DriveLog(time_s=[0.05 * k for k in range(len(shown))], virtual=shown)
    assert [round(time_s / 0.05) for time_s in still_times(log)] == [20, 40, 50, 60, 70]
    assert still_times(DriveLog(time_s=[3.0, 3.05], virtual=[False, False])) == [3.0]


def test_a_claim_is_not_decided_by_two_units() -> None:
    def found(units: int) -> report.Answer:
        return report.answers({"x": report.Section("", [], {"depth": report.Answer(True, "+1 dB", units)})})["depth"]

    assert found(3).held is True
    assert (found(2).held, found(2).figures) == (None, "+1 dB; too few to decide: 2 units")
