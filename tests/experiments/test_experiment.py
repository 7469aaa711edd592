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
from instant_ic.experiments import box_room, compared, lab, reconstruction, report
from instant_ic.experiments.illusion_truth import moved_by, things
from instant_ic.experiments.lab import Options, Result, Unit
from instant_ic.experiments.pictures import curves_svg, image_strip
from instant_ic.experiments.scan import (
    QUALITIES,
    ScanQuality,
    Station,
    aged,
    best_stations,
    fuse,
    scan_world,
    station_places,
)
from instant_ic.experiments.teleop_operator import MANNERS, ManneredOperator, Sight
from instant_ic.experiments.teleoperation import _Frame, stills
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import Keyframe, compressed_image_message, header, image_message, pose_message, serialize
from instant_ic.sim.building import Building, Zone
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.world import Material
from instant_ic.vspace import VirtualSpaceConfig
from instant_ic.vspace.mesh_space import MeshSpace

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


def test_an_older_world_has_other_posters_and_objects_elsewhere() -> None:
    world = box_world(1.5)
    same = aged(world, FINE, np.random.default_rng(0))
    assert np.array_equal(same.vertices, world.vertices) and np.allclose(same.tint, world.tint)
    older = aged(world, dataclasses.replace(FINE, older=1.0, colour=0.1), np.random.default_rng(1))
    shift = np.abs(older.vertices - world.vertices).max(axis=0)
    assert 0 < shift[:2].max() <= 0.4 and shift[2] == 0
    assert not np.allclose(older.tint, world.tint)
    assert sorted(older.texture) == sorted(world.texture)


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
    for name, quality in (("fine", FINE), ("phone", dataclasses.replace(QUALITIES["phone"], width=512))):
        made = scan_world(world, (0.0, 0.0, 0.0), quality, 0, tmp_path / f"{name}.glb")
        assert made["stations"] >= 1 and made["triangles"] > 1000
        space = MeshSpace(VirtualSpaceConfig(source="mesh", mesh=str(tmp_path / f"{name}.glb"), mesh_fit_colours=False))
        seen[name] = psnr_db(space.render(pose, 96, 54, math.pi / 2).rgb, truth)
    assert seen["fine"] > 22 and seen["fine"] > seen["phone"] + 3


def test_cases_of_worlds_and_seeds() -> None:
    assert Options(2, ("corridor", "random:7", "house.glb")).cases() == [
        ("corridor:0", 0), ("corridor:1", 0), ("random:7", 0), ("house.glb", 0), ("house.glb", 1),
    ]  # fmt: skip
    assert Options(2, ("random:0", "random")).cases() == [("random:0", 0), ("random:1", 0)]
    for wrong in ({"seeds": 0}, {"method": "theirs"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Options(**wrong)


def test_finished_units_are_kept_and_failed_ones_tried_again(tmp_path, monkeypatch) -> None:
    calls = []

    def measure(arguments):
        calls.append(arguments["n"])
        if arguments["n"] == 2 and calls.count(2) == 1:
            raise ValueError("no floor here")
        return {"rows": [{"value": math.nan}], "n": arguments["n"]}

    monkeypatch.setattr(reconstruction, "measure", measure)
    units = [Unit("reconstruction", {"n": n}) for n in (1, 2)]
    first = lab.run(units, tmp_path, 1)
    assert [one.error for one in first] == ["", "no floor here"] and first[0].data["rows"] == [{"value": None}]
    second = lab.run(units, tmp_path, 1)
    assert calls == [1, 2, 2] and [one.data["n"] for one in second] == [1, 2]
    (tmp_path / f"{units[0].key}.json").write_text("{")
    lab.run(units, tmp_path, 1)
    assert calls == [1, 2, 2, 1]


def test_an_unexpected_error_ends_its_unit_only(tmp_path, monkeypatch) -> None:
    def measure(arguments):
        return {"share": 1 / arguments["n"]}

    monkeypatch.setattr(reconstruction, "measure", measure)
    found = lab.run([Unit("reconstruction", {"n": n}) for n in (0, 1)], tmp_path, 1)
    assert [one.error for one in found] == ["ZeroDivisionError: division by zero", ""]


def test_two_meshes_of_one_name_are_not_averaged_and_each_kind_of_world_shows_images() -> None:
    options = Options(2, ("a/house.glb", "b/house.glb", "random:7", "random:9"), size=(64, 32))
    units = compared.view_units("ablation", options, ("ours",), ())
    shown = [compared.family(Result(unit, {}, 0.0, 0.0)) for unit in units if unit.arguments["images"]]
    assert shown == ["a/house.glb", "b/house.glb", "random"]
    worlds = "--world a/house.glb --world b/house.glb --world random:7 --world random:9"
    command = f"ic experiment ablation {worlds} --seeds 2 --size 64x32 -o REPORT"
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
    section = report.Section("Title", [report.Text("a & b"), table, report.Figure("curves", svg)], {"claim": False})
    result = Result(Unit("ablation", {"world": "corridor:0"}), {}, 1.0, 1.0, "it broke")
    report.write(tmp_path, {"ablation": section}, [result], {"cpu": "one"})
    page = (tmp_path / "report.html").read_text()
    assert "PSNR &lt;dB&gt;" in page and "0.600 ± 0.141" in page and "does not hold" in page and "it broke" in page
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", page.replace("http://www.w3.org", ""))
    assert json.loads((tmp_path / "report.json").read_text())["verdict"] == {"ablation": {"claim": False}}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "0"], "--seeds: must be > 0"),
        (["--size", "big"], "--size: must look like 640x360"),
        (["--size", "8x640"], "at least 16 pixels"),
        (["--jobs", "0"], "--jobs: must be > 0"),
        (["--timeout", "nan"], "--timeout: must be > 0"),
        (["--timeout", "inf"], "--timeout: must be finite"),
        (["--bag", "drive", "--world", "random"], "leave out --world"),
        (["--bag", "drive", "--method", "paper"], "in ablation only"),
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


def test_a_recording_shows_what_later_panoramas_saw(tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for number, x in enumerate((0.0, 0.5, 1.0)):
            pose = pose_matrix(x)
            room = box_room.panorama(pose, 128)
            message = Keyframe(
                header=header("map", 7),
                id=number,
                pose=pose_message(pose),
                panorama=compressed_image_message(cv2.imencode(".png", room.rgb[..., ::-1])[1].tobytes(), "camera", 7),
                depth=image_message(room.depth_m, "32FC1", "camera", 7),
                sigma=image_message(np.empty((0, 0), np.uint8), "mono8", "camera", 7),
                source="network",
                scale=1.0,
                quality=0.9,
                relative_sigma=0.03,
                fit=True,
                message="",
            )
            kind = "instant_ic_msgs/msg/Keyframe"
            writer.write("/keyframe", kind, bytes(serialize(message)), 10**9 * (number + 1), LATCHED)
    options = Options(5, bag=tmp_path / "bag", size=(48, 32))
    units = reconstruction.units(options)
    assert [unit.arguments["number"] for unit in units] == [0, 1]
    arguments = {**units[0].arguments, "sources": ["panorama", "depth-warp"], "panorama_width": 256}
    found = reconstruction.measure(arguments)
    psnr = {(row["source"], row["distance_m"]): row["psnr_db"] for row in found["rows"]}
    assert set(psnr) == {(source, at) for source in ("panorama", "depth-warp") for at in (0.5, 1.0)}
    assert psnr["depth-warp", 0.5] > psnr["panorama", 0.5] + 3
    assert found["images"]["recorded"].startswith("data:image/jpeg")
    results = [Result(units[0], found, 1.0, 1.0)]
    assert "recorded" in str(reconstruction.section(results, options).parts)
    with pytest.raises(ValueError, match="/keyframe is missing"):
        with BagWriter(tmp_path / "empty"):
            pass
        reconstruction.units(Options(5, bag=tmp_path / "empty"))


def sight(time_s: float) -> Sight:
    return Sight(time_s, np.zeros(3), False, False, (0.4, 0.0), np.zeros(3))


def test_operators_differ_as_their_manners_say() -> None:
    ahead = np.array([[10.0, 0.0]])

    def commands(manner: str, seed: int = 0) -> list[tuple[float, float]]:
        operator = ManneredOperator(ahead, None, MANNERS[manner], seed)
        return [operator.command(sight(0.05 * step)) for step in range(20)]

    assert commands("plain") == [(0.4, 0.0)] * 20
    assert commands("cautious") == [(0.2, 0.0)] * 20
    assert commands("late") == [(0.0, 0.0)] * 10 + [(0.4, 0.0)] * 10
    noisy = np.array(commands("noisy"))
    assert noisy[:, 1].std() > 0.01 and noisy.tolist() == np.array(commands("noisy")).tolist()
    assert noisy.tolist() != np.array(commands("noisy", 1)).tolist()


def test_stills_are_before_first_middle_last_and_after() -> None:
    shown = [False] * 10 + [True] * 21 + [False] * 3
    frames = [_Frame(0.25 * k, virtual, np.zeros((2, 2, 3), np.uint8)) for k, virtual in enumerate(shown)]
    assert [frame.time_s / 0.25 for frame in stills(frames)] == [6, 10, 20, 30, 33]
    assert stills(frames[:3]) == frames[:1]
