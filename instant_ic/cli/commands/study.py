"""``ic study``: a blind user study in the operator's page, from the plan to the table."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import group, not_negative, positive_int, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import use_one_thread_for_matrices


def add_parser(subparsers: Any) -> None:
    verbs = group(
        subparsers, "study", "run a blind user study in the operator's page (the paper's V.E with people)",
        "Drives in balanced order with illusory control, with a scanned mesh and with a robot that stops; the "
        "paper's two questions; one bag a drive. All data stay in the study's folder.",
        "ic study new runs/study --participants 12",
    )  # fmt: skip
    new = verb(verbs, "new", "write a study's folder", _new, "ic study new runs/study --participants 12 --seed 1")
    new.add_argument("--participants", type=positive_int, default=12, metavar="N", help="best a multiple of 6")
    new.add_argument("--seed", type=not_negative, default=0, help="seed of orders and noise (default: %(default)s)")
    run = verb(verbs, "run", "serve the pages of one participant", _run, "ic study run runs/study P01")
    run.add_argument("--port", type=not_negative, default=0, help="port of the pages (default: a free one)")
    table = verb(verbs, "table", "print drives and votes by condition", _table, "ic study table runs/study")
    for parser in (new, run, table):
        parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the study")
    run.add_argument("participant", metavar="PARTICIPANT", help="code, such as P01")


def _new(args: argparse.Namespace) -> int:
    from instant_ic.experiments.study.plan import StudyPlan, create

    create(args.folder, StudyPlan(participants=args.participants, seed=args.seed))
    print(f"{args.folder / 'study.yaml'}: edit worlds, distance and time limit there")
    return 0


def _run(args: argparse.Namespace) -> int:
    use_one_thread_for_matrices()
    import asyncio

    from instant_ic.cli.kernels import compile_all
    from instant_ic.experiments.study.pages import StudyPages, serve
    from instant_ic.experiments.study.plan import Participant, load
    from instant_ic.experiments.study.trial import Trial, arguments, make_scan

    plan = load(args.folder)
    participant = Participant.load(args.folder, plan, args.participant)
    if participant.answers:
        raise UserError(f"{args.participant} has finished: take another code", 2)
    print("preparing programs and worlds (up to some minutes, once) ...", flush=True)
    compile_all(lambda share: None)
    make_scan(args.folder, plan.worlds[participant.order.index("mesh")], plan.seed)

    def make_trial(number: int, condition: str, bag: Path) -> Trial:
        return Trial(arguments(args.folder, plan, number, condition, bag), plan.goal_m, plan.limit_s)

    async def pages() -> None:
        def tell(url: str) -> None:
            print(f"open {url} for {args.participant} in a browser; Ctrl-C interrupts", flush=True)

        await serve(StudyPages(participant, make_trial), args.port, tell)

    asyncio.run(pages())
    print(f"{args.participant} has finished")
    return 0


def _table(args: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table

    from instant_ic.experiments.study.plan import Participant, load
    from instant_ic.experiments.study.table import rows

    plan = load(args.folder)
    participants = {code: Participant.load(args.folder, plan, code) for code in plan.orders()}
    found = rows(list(participants.values()))
    table = Table("", *(row["condition"] for row in found))
    for measure in list(found[0])[1:]:
        table.add_row(measure, *("–" if row[measure] is None else f"{row[measure]}" for row in found))
    Console().print(table)
    for code, one in participants.items():
        if one.answers.get("text"):
            print(f"{code}: {one.answers['text']}")
    return 0
