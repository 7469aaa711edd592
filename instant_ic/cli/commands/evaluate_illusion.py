"""``ic evaluate illusion``: comparison of the operator's views inside and behind an obstacle with the truth."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli.arguments import verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import (
    add_options,
    add_stack_options,
    check_outputs,
    counted,
    errors_for_the_user,
    print_figures,
    use_one_thread_for_matrices,
)


def add_kind(kinds: Any) -> None:
    parser = verb(
        kinds, "illusion", "compare the operator's view inside and behind obstacles with the truth", run,
        "ic evaluate illusion --episodes 4 --json illusion.json --plot strip.png",
        "The drive of ic evaluate teleop with illusory control. Every frame in which the page shows the virtual "
        "space is rendered by the CPU and compared with the simulator's image from the same pose, which contains the "
        "obstacle only until the camera reaches its near face. The same frames are also rendered with true "
        "depth. Reports PSNR, SSIM and the share that no keyframe has seen. The same seed gives the same figures.",
    )  # fmt: skip
    add_options(parser, 20, 1, 7200.0, "rows of frames by distance")
    worlds = "as ic evaluate teleop: corridors (random), or one where the operator drives straight on"
    add_stack_options(parser, worlds, "nerf.space.keyframes:=1")


def run(args: argparse.Namespace) -> int:
    use_one_thread_for_matrices()
    check_outputs(args, plot=".png")
    try:
        with errors_for_the_user():
            return _evaluate(args)
    except KeyboardInterrupt:
        raise UserError("interrupted; nothing was written", 130) from None


def _evaluate(args: argparse.Namespace) -> int:
    from instant_ic.experiments import illusion
    from instant_ic.experiments.results import save_json

    settings = illusion.TeleopSettings(
        args.episodes, args.seed, args.world, ("ic",), pictures=False, overrides=tuple(args.param)
    )
    with counted("filming", settings.episodes) as advance:

        def show_progress(film: illusion.Film) -> None:
            advance("filming", f"episode {film.index}: {len(film.frames)} frames")

        films = illusion.evaluate(settings, args.jobs, show_progress, args.timeout)
    figures = illusion.report(films, settings)
    if args.json:
        save_json(args.json, figures)
    figures.pop("each")
    print_figures(figures)
    if args.plot:  # last, because this fails if no drive met an obstacle
        illusion.save_strip(args.plot, films)
    return 0
