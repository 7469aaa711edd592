"""Schedule of a virtual space's worker: it takes keyframes, renders requested views, and trains in idle time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from instant_ic.util.diagnosis import Diagnosis, Level
from instant_ic.vspace.config import VirtualSpaceConfig
from instant_ic.vspace.jobs import IncomingKeyframe, Job, JobKind, JobOutcome, ViewOrder
from instant_ic.vspace.space import SpaceState, SpaceStatus

LEAST_SHARE = 0.25
"""Least training time as a share of a view's rendering time, also where views alone take longer than their period."""
_LASTING = (JobKind.WARM_UP, JobKind.LEARN, JobKind.TRAIN)
"""Jobs that would fail again at once: after an error nothing is trained until the next keyframe."""
_NOTHING_SEEN = 0.98
"""A view with a larger share of unseen pixels shows nothing that is known."""


class Turns:
    """Shares one device between rendering and training so that a frame rate is held.

    Args:
        render_fps: target frame rate of requested views; training gets the remaining time.
        train_ms_per_frame: longest uninterrupted training in ms, and so the longest wait of a requested view.
    """

    def __init__(self, render_fps: float, train_ms_per_frame: float) -> None:
        self.render_fps = render_fps
        self.train_ms_per_frame = train_ms_per_frame
        self._rendered_last = False
        self._render_ms = 0.0

    def renders_next(self, works: bool) -> bool:
        """Return whether a requested view is next: after each view comes other work, if there is any (``works``)."""
        return not (works and self._rendered_last)

    def rendered(self, render_ms: float) -> None:
        """Note the rendering time of a view."""
        self._rendered_last, self._render_ms = True, render_ms

    def worked(self) -> None:
        """Note other work than rendering."""
        self._rendered_last = False

    def budget_ms(self) -> float:
        """Return the length of training's turn, which starts now: the rest of the view's period, within the limits."""
        left = 1e3 / self.render_fps - self._render_ms if self._rendered_last else self.train_ms_per_frame
        self._rendered_last = False
        return min(self.train_ms_per_frame, max(left, LEAST_SHARE * self._render_ms))


class JobSchedule:
    """Decides which job is next; knows neither threads nor messages. All calls come from one thread.

    A keyframe is shown first, then its layers are encoded, then the field learns from it. Of waiting keyframes and of
    waiting views only the newest is kept.

    Args:
        config: parameters of the space.
        turns: shares of rendering and other work.
        start: starts a job on the worker; ``take`` gets its outcome.
        lockstep: no measured time counts, and training runs in ``train`` only; otherwise it fills idle time.
    """

    def __init__(self, config: VirtualSpaceConfig, turns: Turns, start: Callable[[Job], None], lockstep: bool) -> None:
        self.config, self.turns = config, turns
        self.keyframe: IncomingKeyframe | None = None  # newest one that views show
        self.status: SpaceStatus | None = None
        self.failure = ""
        self._start_job, self._lockstep = start, lockstep
        self._waiting_keyframe: IncomingKeyframe | None = None
        self._waiting_view: ViewOrder | None = None
        self._busy = False
        self._todo: deque[Job] = deque()  # what the shown keyframe still needs
        self._learns = False  # the field has something to learn
        self._is_ready, self._ready_seconds = False, 0.0
        self._warned = False  # about the device
        self._rendered_ns: deque[int] = deque(maxlen=20)
        # Figures of the last rendered view; 0 = unknown.
        self._render_ms = self._expected_psnr_db = self._unseen_share = 0.0

    def start(self) -> None:
        """Start with the warm-up."""
        self._start(Job(JobKind.WARM_UP))

    def offer_keyframe(self, keyframe: IncomingKeyframe) -> None:
        """Prepare and show a keyframe; it replaces one that still waits."""
        self._waiting_keyframe = keyframe
        self.next()

    def request_view(self, order: ViewOrder) -> None:
        """Render a view; it replaces one that still waits."""
        self._waiting_view = order
        self.next()

    def next(self) -> None:
        """Start the next job, unless one runs or there is nothing to do."""
        if self._busy or self.status is None:
            return
        trains = self._trains and not self._lockstep
        works = trains or bool(self._todo) or self._waiting_keyframe is not None
        if self._waiting_view is not None and self.turns.renders_next(works):
            order, self._waiting_view = self._waiting_view, None
            self._start(Job(JobKind.RENDER, view=order))
        elif self._todo:
            self.turns.worked()
            self._start(self._todo.popleft())
        elif self._waiting_keyframe is not None:
            self.turns.worked()
            keyframe, self._waiting_keyframe = self._waiting_keyframe, None
            self._start(Job(JobKind.KEYFRAME, keyframe))
        elif trains:
            self._start(Job(JobKind.TRAIN, budget_ms=self.turns.budget_ms()))

    def train(self, iterations: int) -> None:
        """Train now, unless a job runs or nothing is left to train."""
        if not self._busy and self._trains:
            self._start(Job(JobKind.TRAIN, iterations=iterations))

    def _start(self, job: Job) -> None:
        self._busy = True
        self._start_job(job)

    @property
    def _trains(self) -> bool:
        """True while something is left to train."""
        return self._learns and not self.failure and self.status is not None and not self.status.converged

    def take(self, outcome: JobOutcome, now_ns: int) -> bool:
        """Take the result of a job; return whether the state, the text or the keyframe has changed."""
        self._busy = False
        job, self.status = outcome.job, outcome.status
        failed = outcome.error is not None
        changed = failed and job.kind in _LASTING
        if changed:
            self.failure = f"{job.kind.value}: {type(outcome.error).__name__}: {outcome.error}"
        elif job.kind is JobKind.LEARN:
            self._learns = True
        elif job.kind is JobKind.KEYFRAME and not failed and not outcome.refused:
            self._shown(job.keyframe)
            changed = True
        elif outcome.encoded is not None:
            view = outcome.encoded.view
            self._render_ms = 0.0 if self._lockstep else outcome.encoded.render_ms
            self._expected_psnr_db = 0.0 if math.isnan(view.expected_psnr_db) else view.expected_psnr_db
            self._unseen_share = view.unseen_share
            self.turns.rendered(self._render_ms)
            self._rendered_ns.append(now_ns)
        if self.keyframe is not None and not self._is_ready and self.state == SpaceState.READY:
            self._is_ready = changed = True
            self._ready_seconds = (now_ns - self.keyframe.arrival_ns) / 1e9
        return changed

    def _shown(self, keyframe: IncomingKeyframe | None) -> None:
        """Note that a keyframe is shown, and what it still needs."""
        self.keyframe, self.failure, self._is_ready = keyframe, "", False
        source = "" if self.status is None else self.status.source
        kinds = {"warp": (JobKind.LAYERS,), "field": (JobKind.LAYERS, JobKind.LEARN)}.get(source, ())
        self._todo = deque(Job(kind, keyframe) for kind in kinds)

    @property
    def state(self) -> SpaceState:
        """State of the space."""
        if self.failure:
            return SpaceState.FAILED
        if self.status is None or (self.keyframe is None and self.config.source != "mesh"):
            return SpaceState.EMPTY
        return self.status.state

    def text(self) -> str:
        """Describe the state for an operator."""
        status = self.status
        if self.failure:
            return self.failure
        if status is None:
            return "warming up: kernels are being compiled"
        if status.source == "mesh":
            return f"the scanned place {Path(self.config.mesh).name}; nothing is trained (source: mesh)"
        if self.keyframe is None:
            return "waiting for the first keyframe"
        if status.source == "warp":
            return "the panorama warped by its depth; nothing is trained (source: warp)"
        if status.converged:
            text = f"trained, {status.psnr_db:.1f} dB; idle"
        else:
            text = f"training, {status.psnr_db:.1f} dB" if status.iterations else "training"
        if status.refreshing:
            text += f"; learning keyframe {self.keyframe.id}"
        text += f"; shown: the {'field' if status.shows_field else 'warped panorama'}"
        if not math.isnan(status.gain_db):
            text += f" (older keyframes by the field: {status.gain_db:+.1f} dB against the warp)"
        return text

    def findings(self, outcome: JobOutcome) -> list[Diagnosis]:
        """Return the diagnoses that follow from a job's outcome, after it was taken."""
        kind, status, keyframe, view = outcome.job.kind, outcome.status, outcome.job.keyframe, outcome.job.view
        found = []
        if status is not None and (status.warning or self._warned):
            self._warned = bool(status.warning)
            found.append(Diagnosis("device", Level.WARN if self._warned else Level.OK, status.warning or status.device))
        if outcome.error is not None:
            name = "vspace" if kind in _LASTING else "keyframe" if view is None else "view"
            text = f"{kind.value}: {type(outcome.error).__name__}: {outcome.error}"
            found.append(Diagnosis(name, Level.ERROR, text))
        elif keyframe is not None and outcome.refused:
            text = f"Keyframe {keyframe.id} refused: {outcome.refused}"
            found.append(Diagnosis("keyframe", Level.ERROR, text, {"id": keyframe.id}))
        elif keyframe is not None and kind is JobKind.KEYFRAME:
            found.append(Diagnosis("keyframe", Level.OK, f"keyframe {keyframe.id} in use", {"id": keyframe.id}))
        elif view is not None:
            found.append(self._view_finding(view, outcome.refused))
        elif kind is JobKind.TRAIN:
            found.append(Diagnosis("vspace", Level.OK, self.text()))
        return found

    def _view_finding(self, view: ViewOrder, refused: str) -> Diagnosis:
        if refused:
            return Diagnosis("view", Level.WARN, f"Request {view.id} refused: {refused}", {"id": view.id})
        text, empty = f"{view.width} x {view.height} in {self._render_ms:.0f} ms", self._unseen_share > _NOTHING_SEEN
        if empty:
            text += ": no keyframe shows anything from that pose. Is it far away?"
        return Diagnosis("view", Level.WARN if empty else Level.OK, text, {"id": view.id})

    def _render_fps(self, now_ns: int) -> float:
        """Return the views per second over the last 20; 0 if none was rendered for 2 s."""
        rendered = self._rendered_ns
        if len(rendered) < 2 or now_ns - rendered[-1] > 2_000_000_000 or rendered[-1] == rendered[0]:
            return 0.0
        return (len(rendered) - 1) * 1e9 / (rendered[-1] - rendered[0])

    def figures(self, now_ns: int) -> dict[str, Any]:
        """Return the fields of VspaceStatus.msg, 0 or empty where unknown."""
        status, keyframe, state = self.status, self.keyframe, self.state
        shown = status if keyframe is not None or self.config.source == "mesh" else None
        of_keyframe = status if keyframe is not None else None
        return {
            "state": state,
            "keyframe_id": 0 if status is None or keyframe is None else keyframe.id,
            "ready_radius_m": 0.0 if shown is None else shown.ready_radius_m,
            "psnr_db": of_keyframe.psnr_db if of_keyframe is not None and of_keyframe.iterations else 0.0,
            "expected_psnr_db": self._expected_psnr_db,
            "unseen_share": self._unseen_share,
            "train_seconds": 0.0 if keyframe is None else (now_ns - keyframe.arrival_ns) / 1e9,
            "ready_seconds": self._ready_seconds if keyframe is not None and state == SpaceState.READY else 0.0,
            "iterations": 0 if of_keyframe is None else of_keyframe.iterations,
            "ms_per_iteration": 0.0 if of_keyframe is None or self._lockstep else of_keyframe.ms_per_iteration,
            "render_ms": self._render_ms,
            "render_fps": self._render_fps(now_ns),
            "device": "" if status is None else status.device,
            "message": self.text(),
        }
