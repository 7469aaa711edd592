"""Limits on names, sizes and docstrings of the code (CONTRIBUTING.md).

``KNOWN`` lists the violations that remain, by rule. An entry that is no violation any more may stay for now.
"""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("instant_ic", "nodes", "benchmarks", "scripts")
FUNCTION_LINES, CLASS_LINES, METHODS, PARAMETERS = 60, 400, 30, 10
OPENINGS = {"Of", "That", "As", "What", "Where", "Whether", "So"}
"""First words that a docstring must not have."""

KNOWN: dict[str, str] = {
    "class name": """
        Backend
        Clock
        Cloud
        Command
        CommandGate
        Connection
        Drive
        Encoder
        FieldConfig
        Frame
        Host
        Incoming
        Item
        Keyframe
        Layer
        LinkError
        LogFile
        Memory
        Notice
        Observer
        Outcome
        Pair
        Peer
        Place
        Problem
        Progress
        ProtocolError
        Reader
        Received
        Record
        Revolution
        Row
        Sample
        Scan
        Scene
        Screen
        ServerConfig
        Session
        Snapshot
        State
        Status
        Surface
        ThetaConfig
        Trial
        Value
        View
        Window
        _Body
        _Drive
        _Level
        _Step
    """,
    "function lines": """
        DepthSource.estimate
        _compose
        _decode
        _evaluate
        _experiment
        _functions
        _project
        _watch
        adapt
        add_parser
        add_revolution
        blend
        cast_rays
        composite
        continue_walls
        convert
        corridor_world
        draw
        drive
        evaluate_depth
        evaluate_faults
        export_onnx
        flood
        load_world
        look_up
        make_source
        replay
        run_all
        run_log
        sample_rays
        section
        solid_columns
        tidy
        trace
        volume_gradient
    """,
    "class lines": """
        ConsoleServer
        FoxgloveServer
        Node
        Recorder
        VirtualSpace
    """,
    "methods": """
        ConsoleServer
        FoxgloveServer
        Node
        Recorder
        VirtualSpace
    """,
    "parameters": """
        _compose
    """,
    "docstring opening": """
        Answer
        Arbiter._jumps
        Arbiter._leads_back
        Arbiter._vbot_jumps
        ArbiterInbox._counts
        ArbiterInbox.operator_gone
        ArbiterInbox.rests
        ArbiterInputs.blind
        BadLines
        BagWriter.part_is_empty
        BaseController._near_zero
        BaseController._sure
        BaseReport.tracks
        CommandGate.admit
        CommandGate.admit_publisher
        ConsoleClient.closed
        ConsoleServer._holds
        ConsoleServer._may_drive
        ConsoleServer.needs_views
        ConsoleServer.plain_http
        Context
        ConvertOptions
        Costmap.contains
        DepthChain.due
        DepthChain.request_due
        DepthRequests.due
        Display.changes_mode
        Display.with_vbot
        DriveGate.driver_alive
        DriveGate.moving
        DriveRecorder.ready
        EstopLatch.button
        EstopLatch.diagnosis
        EstopLatch.stopped
        Figure.wide
        FilmedStack.step
        FrontEnd._doubtful
        FrontEnd._first_was_poor
        FrontEnd.in_known_map
        GridSlam._recognized
        GridSlam.localized
        Heartbeat.silent
        Heartbeat.up
        Incoming._same_type
        Incoming.wants
        Integrity.trusted
        IntegrityMonitor.doubts
        IntegrityMonitor.lost
        JobKind
        JobSchedule._trains
        JobSchedule.state
        KEY_COPY
        KeyframeSelector.due
        KeyframeSelector.take
        KeyframeSet.priors
        Lattice
        Lattice.suits
        LaunchDescription.simulated
        LidarReport._view
        LidarReport.covers
        LidarReport.source
        LidarReport.trusts
        LocalPublisher._has_room
        Log.virtual
        LogFolder.has
        LogRate.filter
        LoopClosure._consistent
        MARKED
        MILESTONES
        ManagedProcess.flooding
        ManagedProcess.has_ended
        ManagedProcess.out_of_means
        Mode.shows_vbot
        Moment
        MonitoredCommand.time_to_collision_s
        Node.due
        Node.starting
        Node.stopping
        OccupancyMask.at
        Options
        Outgoing._came_in
        Outgoing._early
        Pace.real
        PageReport.view_age_s
        PanoramaPrior.sees
        PanoramaWarp.__init__
        PathFollower._is_free
        PlannerConfig
        Pyramid.of
        REFERENCE
        RayCaster.occluded
        Reason.holds
        RepeatWatch.is_new
        Result
        Rig.ready
        SavedMap._confirmed
        SavedMap.extends
        SavedMap.unchanged
        Scan.usable
        ScanQueue._worth_waiting
        ScanQueue.waiting
        Sector.contains
        Sector.resembles
        Session._is_held
        Session._shares
        Setup.slow_s
        Sight
        SimulatedStack._worth_drawing
        SlamResult.trusted
        SlamStatus.matched
        Snapshot.must_be_slow
        Snapshot.obstacle_ahead
        Snapshot.pose_doubtful
        Snapshot.prediction
        Snapshot.vbot_jumped
        SourceGuard.admit
        SourceMonitor.command_is_fresh
        SourceMonitor.is_lost
        Status.estop
        Status.source
        StepGap.settles
        StepTimes.command_steps
        StepTimes.costmap_due
        StepTimes.timer_steps
        SubgoalConfig
        Surroundings._blind
        Surroundings.publish_due
        Texture.of
        ThetaServer.authorised
        ThetaServer.watched
        Tolerance.exact
        TopicDifference.same
        TopicRate.alive
        TopicRate.freq_ok
        TorchDevice._directions
        TrackedRobot.touches
        TrainState
        Trial._arrived
        Trial.of
        Turns.renders_next
        Value.is_quoted
        ViewOrder.same_view
        ViewRequests._due
        VirtualSpace._done
        VirtualSpace.dissolving
        Vspace.expected_psnr_db
        WithBox.cast
        WithBox.render
        _Accuracy
        _Adapter.init_poolmanager
        _Adapter.send
        _BEYOND
        _Body.stands
        _Digest.build_digest_header
        _Episode._there
        _Look.free_at
        _MOST_BITS
        _Map
        _NICE
        _Node.own_programs
        _Outgoing.queued
        _QUEUE_BYTES
        _Recorded.step
        _SILENT
        _Silence.busy
        _Socket.recv_into
        _WALL_BELOW
        _YAW_MARGIN_RAD
        _alive
        _anew
        _answer
        _any_corner
        _chunks_fit
        _confirmed
        _contradicts
        _fits
        _hangs
        _in_sight
        _is_at
        _is_edge
        _is_launch_file
        _is_runnable
        _is_traced
        _may_have_cuda
        _meet
        _names
        _passable
        _runs_along
        _settled
        _torn
        _torn_pairs
        _turn_is_free
        alive
        apart
        are_compiled
        benchmarks/depth_ablations.py
        benchmarks/depth_adapt.py
        benchmarks/reporting.py
        cells_block
        contains
        converge_on
        converge_recorded
        decode_sigma
        from_page
        grid_span
        has_substitution
        holds
        host_allowed
        images_agree
        images_too_rare
        instant_ic/bus/host.py
        instant_ic/cli/finding.py
        instant_ic/console/display.py
        instant_ic/console/faults.py
        instant_ic/control/operator_view.py
        instant_ic/control/passage.py
        instant_ic/control/progress.py
        instant_ic/control/subgoal.py
        instant_ic/experiments/compared.py
        instant_ic/experiments/study/record.py
        instant_ic/slam/map_updates.py
        instant_ic/vspace/schedule.py
        is_bag
        is_clamped
        is_client
        is_device_fault
        is_file
        is_live
        is_loopback
        is_multipart
        is_out_of_memory
        is_passage
        is_y_up
        losses
        moves
        never_set
        operator_image
        origin_allowed
        prior_agrees
        prior_known
        releases
        robot_region
        running
        serves
        settled
        sign_in_needed
        takes
        targets
    """,
}
"""Names of today's violations, by rule, separated by white space."""

Function = ast.FunctionDef | ast.AsyncFunctionDef
Definition = Function | ast.ClassDef


def definitions(tree: ast.AST, prefix: str = "") -> list[tuple[str, Definition]]:
    """Return all classes and functions of a module with their qualified names."""
    found: list[tuple[str, Definition]] = []
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, Definition):
            found.append((prefix + node.name, node))
            found += definitions(node, f"{prefix}{node.name}.")
        else:
            found += definitions(node, prefix)
    return found


def is_compiled(function: Function) -> bool:
    """Return whether numba or Triton compiles the function."""
    names = " ".join(ast.unparse(decorator) for decorator in function.decorator_list)
    return "jit" in names or "triton" in names


def parameters(function: Function) -> int:
    """Count the parameters without ``self`` and ``cls``."""
    names = [a.arg for a in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls")])


def docstrings(tree: ast.AST, name: str) -> list[tuple[str, str]]:
    """Return the docstrings of a module, its classes, functions and attributes with their names."""
    found = []
    for owner, node in [(name, tree), *definitions(tree)]:
        text = ast.get_docstring(node)
        found += [(owner, text)] if text else []
        for before, after in zip(node.body, node.body[1:], strict=False):
            target = before.targets[0] if isinstance(before, ast.Assign) else getattr(before, "target", None)
            if isinstance(target, ast.Name) and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                prefix = f"{owner}." if node is not tree else ""
                found.append((prefix + target.id, str(after.value.value)))
    return found


def violations_of(tree: ast.Module, name: str) -> list[tuple[str, str]]:
    """Return (rule, name) of everything in one module that is too large or begins in the wrong way."""
    found = []
    for owner, node in definitions(tree):
        lines = node.end_lineno - node.lineno + 1
        if isinstance(node, ast.ClassDef):
            methods = sum(isinstance(child, Function) for child in node.body)
            found += [("class lines", owner)] if lines > CLASS_LINES else []
            found += [("methods", owner)] if methods > METHODS else []
        else:
            found += [("function lines", owner)] if lines > FUNCTION_LINES else []
            found += [("parameters", owner)] if parameters(node) > PARAMETERS and not is_compiled(node) else []
    for owner, text in docstrings(tree, name):
        words = text.split(maxsplit=1)
        found += [("docstring opening", owner)] if words and words[0].strip(".,:;") in OPENINGS else []
    return found


@pytest.fixture(scope="module")
def violations() -> dict[str, set[str]]:
    """Names that break a rule, by rule."""
    found: dict[str, set[str]] = {}
    classes: Counter[str] = Counter()
    for folder in FOLDERS:
        for file in sorted((ROOT / folder).rglob("*.py")):
            tree = ast.parse(file.read_text(encoding="utf-8"))
            classes.update(node.name for _, node in definitions(tree) if isinstance(node, ast.ClassDef))
            for rule, name in violations_of(tree, str(file.relative_to(ROOT))):
                found.setdefault(rule, set()).add(name)
    found["class name"] = {name for name, count in classes.items() if count > 1}
    return found


@pytest.mark.parametrize(
    ("rule", "advice"),
    [
        ("class name", "two classes have this name: give one of them a more specific name"),
        ("function lines", f"more than {FUNCTION_LINES} lines: split it along the steps of the algorithm"),
        ("class lines", f"more than {CLASS_LINES} lines: move a part into a class of its own"),
        ("methods", f"more than {METHODS} methods: move a part into a class of its own"),
        ("parameters", f"more than {PARAMETERS} parameters: group them in a dataclass"),
        (
            "docstring opening",
            "write an imperative sentence (functions) or a noun phrase (modules, classes, properties)",
        ),
    ],
)
def test_code_keeps_to_the_limits(rule, advice, violations):
    new = violations.get(rule, set()) - set(KNOWN.get(rule, "").split())
    assert not new, f"{rule}: {advice}: {sorted(new)}"
