"""``ic study``: a blind user study in the operator's page, from the plan to the report."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import group, not_negative, positive, positive_int, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import use_one_thread_for_matrices


def add_parser(subparsers: Any) -> None:
    verbs = group(
        subparsers, "study", "run a blind user study in the operator's page (the paper's V.E with people)",
        "A laboratory in a box: counterbalanced drives with illusory control, stopping, shared control and a scanned "
        "mesh, questionnaires, one bag a drive, statistics. All data stay in the study's folder.",
        "ic study new runs/study --participants 12",
    )  # fmt: skip
    new = verb(verbs, "new", "write a study's folder", _new, "ic study new runs/study --participants 12 --seed 1")
    new.add_argument("folder", type=Path, metavar="FOLDER")
    new.add_argument("--participants", type=positive_int, required=True, metavar="N", help="best a multiple of 4")
    new.add_argument("--seed", type=not_negative, default=0, help="of orders and starts (default: %(default)s)")
    run = verb(
        verbs, "run", "serve the pages of one participant, who may have begun before", _run,
        "ic study run runs/study P01",
    )  # fmt: skip
    simulate = verb(
        verbs, "simulate", "let programs take part, through the real pages in Chromium", _simulate,
        "ic study simulate runs/study P01 P02",
    )  # fmt: skip
    delete = verb(verbs, "delete", "delete all data of a participant", _delete, "ic study delete runs/study P01")
    report = verb(verbs, "report", "write the statistics", _report, "ic study report runs/study -o runs/report")
    for parser in (run, simulate, delete, report):
        parser.add_argument("folder", type=Path, metavar="FOLDER", help="of the study")
    for parser in (run, delete):
        parser.add_argument("participant", metavar="PARTICIPANT", help="code, such as P01")
    simulate.add_argument("participants", nargs="*", metavar="PARTICIPANT", help="codes (default: all)")
    run.add_argument("--port", type=not_negative, default=0, help="of the pages (default: a free one)")
    limit = "longest time of one participant (default: %(default)g s)"
    simulate.add_argument("--timeout", type=positive, default=7200.0, metavar="S", help=limit)
    report.add_argument("-o", "--out", type=Path, required=True, metavar="REPORT", help="output folder")


def _new(args: argparse.Namespace) -> int:
    from instant_ic.experiments.study.plan import create

    study = create(args.folder, args.participants, args.seed)
    print(f"{study.folder / 'study.yaml'}: {len(study.participants)} participants; edit or translate its texts")
    return 0


def _run(args: argparse.Namespace) -> int:
    use_one_thread_for_matrices()
    from instant_ic.experiments.study.plan import load
    from instant_ic.experiments.study.record import OPEN, Record, only_one
    from instant_ic.experiments.study.server import StudyServer

    study = load(args.folder)
    record = Record(study, args.participant)
    if record.state != OPEN or record.simulated:
        raise UserError(f"{record.code} is {'simulated' if record.simulated else record.state}: take another code", 2)
    with only_one(study, "start the next participant"):
        _prepare(record)
        server = StudyServer(record, args.port)
        server.start()
        try:
            print(f"open {server.url} for {record.code} in a browser, full screen; Ctrl-C interrupts", flush=True)
            while not server.over.wait(0.5):
                pass
        finally:
            server.stop()
    print(f"{record.code}: {record.state}")
    return 0


def _prepare(record: Any) -> None:
    """Compile kernels and scan worlds: not while the participant waits, and not in the time that a drive may take."""
    from instant_ic.cli.kernels import compile_all
    from instant_ic.experiments.study.trial import make_scans

    print("preparing programs and worlds (up to some minutes, once) ...", flush=True)
    compile_all(lambda share: None)
    make_scans(record.study, record.code)


def _simulate(args: argparse.Namespace) -> int:
    use_one_thread_for_matrices()
    from instant_ic.experiments.study.plan import load
    from instant_ic.experiments.study.record import DONE, Record, only_one
    from instant_ic.experiments.study.simulate import simulate

    study = load(args.folder)
    with only_one(study, "simulate"):
        for code in args.participants or list(study.participants):
            record = Record(study, code)
            if record.state == DONE:
                continue
            _prepare(record)
            simulate(record, args.timeout)
            print(f"{code}: {record.state}", flush=True)
    return 0


def _delete(args: argparse.Namespace) -> int:
    from instant_ic.experiments.study.plan import load
    from instant_ic.experiments.study.record import Record, only_one

    study = load(args.folder)
    if args.participant not in study.participants:
        raise UserError(f"{args.folder}: study.yaml has no participant {args.participant!r}", 2)
    with only_one(study, "delete"):
        folder = study.folder / "participants" / args.participant
        existed = folder.exists()
        Record.delete_folder(folder)
    print(f"{args.participant}: {'everything is deleted' if existed else 'there are no data'}")
    return 0


def _report(args: argparse.Namespace) -> int:
    from instant_ic.experiments.study.plan import load
    from instant_ic.experiments.study.report import build

    counts = build(load(args.folder), args.out, shlex.join(["ic", *sys.argv[1:]]))
    print(args.out / "report.html")
    print("; ".join(f"{name}: {count}" for name, count in counts.items()))
    return 0
