"""``python -m tests.fuzz``: the whole run, all parsers with a million inputs each unless told otherwise."""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from tests.fuzz.harness import Finding
from tests.fuzz.targets import TARGETS
from tests.fuzz.worker import run_chunk

_CHUNK = 2000
_REPORT_S = 15.0


def main() -> int:
    """Run; the exit status is 1 where something was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--target", action="append", choices=sorted(TARGETS), help="only this one; may be repeated")
    parser.add_argument("--count", type=int, default=1_000_000, help="inputs of each target (default 1000000)")
    parser.add_argument("--start", type=int, default=0, help="number of the first input")
    parser.add_argument("--seed", type=int, default=0, help="another seed gives other inputs")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--out", type=Path, default=Path("runs/fuzz"), help="folder of findings (default runs/fuzz)")
    parser.add_argument("--replay", type=Path, help="parse this file alone, by --target")
    args = parser.parse_args()
    names = args.target or sorted(TARGETS)
    if args.replay:
        TARGETS[names[0]].make()(args.replay.read_bytes())
        return 0
    total = 0
    for name in names:
        total += len(_run_target(name, args))
    _say(f"{len(names)} targets, {args.count} inputs each, seed {args.seed}: {total} findings")
    return 1 if total else 0


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _run_target(name: str, args: argparse.Namespace) -> dict[tuple[str, str], Finding]:
    found: dict[tuple[str, str], Finding] = {}
    end = args.start + args.count
    starts = iter(range(args.start, end, _CHUNK))
    done, began, told = 0, time.monotonic(), time.monotonic()
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(args.jobs, mp_context=context)
    waiting: dict[Future[list[Finding]], int] = {}
    try:
        while True:
            while len(waiting) < 2 * args.jobs and (start := next(starts, None)) is not None:
                waiting[pool.submit(run_chunk, name, args.seed, start, min(_CHUNK, end - start))] = start
            if not waiting:
                break
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                start = waiting.pop(future)
                try:
                    findings = future.result()
                except BrokenProcessPool:
                    # The parser ended its process. Only its range is known; --start and --count 1 find the input.
                    text = f"died: a worker ended while it parsed inputs from {start} on"
                    findings = [Finding(name, args.seed, start, text, "process", "", b"")]
                    pool = ProcessPoolExecutor(args.jobs, mp_context=context)
                    waiting.clear()
                for finding in findings:
                    if finding.key not in found:
                        found[finding.key] = finding
                        _say(f"{name}: input {finding.index}: {finding.what} ({finding.where})")
                        _say(f"  saved as {finding.save(args.out)}")
                done += min(_CHUNK, end - start)
            if time.monotonic() - told > _REPORT_S:
                told = time.monotonic()
                _say(f"{name}: {done} of {args.count}, {done / (told - began):.0f} a second")
    finally:
        pool.shutdown(cancel_futures=True)
    _say(f"{name}: {done} inputs in {time.monotonic() - began:.0f} s, {len(found)} findings")
    return found


if __name__ == "__main__":
    sys.exit(main())
