"""V.D, Fig. 9: the whole flow with numbered stills, the state over time, and both trajectories on the map."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2

from instant_ic.experiments import illusion
from instant_ic.experiments.compared import command_of
from instant_ic.experiments.illusion_stack import SOURCES, FilmedStack
from instant_ic.experiments.lab import Options, Result, Unit
from instant_ic.experiments.plots import jpeg
from instant_ic.experiments.recorded_drive import SIZE, Moment, read_drive, still_times
from instant_ic.experiments.report import Answer, Figure, Part, Section, Table, Text, image_address
from instant_ic.experiments.teleop import TeleopSettings, photograph, run_episode
from instant_ic.experiments.teleop_plot import save_plot
from instant_ic.util.limits import decode_rgb

_FRAME_S = 0.25


class _Recorded(FilmedStack):
    """A stack that keeps the operator's screen."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.frames: list[Moment] = []
        self._next_still_s = 0.0

    def step(self, operate: Callable[[], tuple[float, float]] | None = None) -> None:
        """Advance the stack, then keep the shown image if one is due."""
        super().step(operate)
        if self.time_s < self._next_still_s or not self.log.pictures:
            return
        self._next_still_s = self.time_s + _FRAME_S - 1e-6
        shown = self.log.pictures[-1]
        rgb = decode_rgb(shown.jpeg) if shown.virtual else photograph(self, shown, *SIZE, math.pi / 2)
        self.frames.append(Moment(self.time_s, shown.virtual, cv2.resize(rgb, SIZE, interpolation=cv2.INTER_AREA)))


def units(options: Options) -> list[Unit]:
    """Return a drive through the corridor's obstacle for each seed, or a recorded drive; images are of the first."""
    if options.bag is not None:
        return [Unit("teleoperation", {"bag": str(options.bag)})]
    cases = options.cases()[: 1 if options.quick else None]
    return [
        Unit("teleoperation", {"world": world, "seed": number, "images": number == 0})
        for number, (world, _) in enumerate(cases)
    ]


def measure(arguments: dict[str, Any]) -> dict[str, Any]:
    """Drive one course and compare the operator's views with the truth, or show a recorded drive."""
    if "bag" in arguments:
        return _recorded(Path(arguments["bag"]))
    settings = TeleopSettings(1, arguments["seed"], arguments["world"], ("ic",))
    film, course = illusion.Film(0), settings.course(0)
    stacks: list[_Recorded] = []

    def make_stack(world: Any, config: Any) -> _Recorded:
        stacks.append(_Recorded(world, config, course, 0, film.take))
        return stacks[-1]

    (drive,) = run_episode(settings, 0, methods=("ic",), make_stack=make_stack)
    film.completed = drive.completed
    images = {}
    frames = stacks[0].frames
    if arguments["images"] and frames:
        times = still_times(stacks[0].log)
        images = _numbered([min(frames, key=lambda frame: abs(frame.time_s - at)) for at in times])
        plot = io.BytesIO()
        save_plot(plot, [drive], settings)
        images["Trajectories of r-bot and v-bot, state over time"] = image_address(plot.getvalue(), "image/png")
    row = {key: value for key, value in asdict(drive).items() if key != "tracks"}
    views = {source: illusion.figures(film.frames, source) for source in SOURCES} if film.frames else {}
    return {"drive": row, "views": views, "images": images}


def _recorded(bag: Path) -> dict[str, Any]:
    found = read_drive(bag)
    images = _numbered(found.moments)
    images["Trajectories of r-bot and v-bot"] = image_address(found.plot, "image/png")
    images["State over time"] = image_address(found.modes, "image/png")
    row = {key: value for key, value in asdict(found.drive).items() if key != "tracks"}
    return {"drive": row | {"contacts": None}, "views": {}, "images": images}


def _numbered(stills: Sequence[Moment]) -> dict[str, str]:
    """Return the images of numbered stills."""
    images = {}
    for number, frame in enumerate(stills, 1):
        what = "virtual" if frame.virtual else "real"
        images[f"{number}: {frame.time_s:.1f} s, {what}"] = image_address(jpeg(frame.image))
    return images


def section(results: Sequence[Result], options: Options) -> Section:
    """Return the figures of the shown drive, and a table over all drives."""
    command = command_of(options, "teleoperation")
    text = "All nodes in one process in simulated time; the operator drives straight on. Poses are those of its SLAM."
    if options.bag is not None:
        text = (
            "A recorded drive. The images around the first passage through the virtual space are the camera's, and "
            "views that are rendered again from the recorded keyframes at the v-bot's poses. Poses are those of the "
            "robot's SLAM. Figures that need a ground truth are unknown, contacts included."
        )
    parts: list[Part] = [Text(text)]
    for one in results:
        images = one.data.get("images", {})
        # Only the last still and the plot show the command below them.
        parts += [Figure(name, images[name], "" if name[0] in "1234" else command) for name in images]
    done = [one for one in results if one.data]
    lines: list[list[Any]] = [
        ["time, s", [one.data["drive"]["seconds"] for one in done]],
        ["obedience", [one.data["drive"]["obedience"] for one in done]],
        ["contacts", [one.data["drive"]["contacts"] for one in done]],
        ["largest gap of v-bot and r-bot, m", [one.data["drive"]["gap_max_m"] for one in done]],
    ]
    for source in SOURCES if options.bag is None else ():
        for key, label in (("psnr_mean_db", "PSNR, dB"), ("ssim_mean", "SSIM")):
            lines.append([f"{source}: {label}", [one.data["views"].get(source, {}).get(key) for one in done]])
    parts.append(Table("Drives", ("figure", "value"), lines, command))
    flow = [
        bool(one.data["drive"]["completed"])
        and [s["to_virtual"] for s in one.data["drive"]["switches"]][:2] == [True, False]
        and not one.data["drive"]["contacts"]
        for one in done
    ]
    where = "recorded" if options.bag is not None else "simulated, without contact"
    answer = Answer(
        all(flow) if flow else None, f"{sum(flow)} of {len(flow)} drives, {where}" if flow else "", len(flow)
    )
    return Section("Teleoperation (V.D, Fig. 9)", parts, answers={"flow": answer})
