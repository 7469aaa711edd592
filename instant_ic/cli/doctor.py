"""The checks of ``ic doctor``. Each one examines one thing and says what to do if it is wrong."""

from __future__ import annotations

import argparse
import grp
import importlib.util
import os
import pwd
import shutil
import socket
import stat
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from instant_ic.config.params import ParameterError, load_file
from instant_ic.util import paths
from instant_ic.util.safe_text import direct, masked, visible

OK, WARN, FAIL = "ok", "warn", "fail"
MIN_CORES = 2
MIN_MEMORY_GB = 4.0
MIN_DISK_GB = 2.0
MIN_SHM_MB = 64.0
TCP_PORTS = {8080: "operator's page", 8089: "simulated Theta"}
UDP_PORTS = {2368: "VLP-16 data", 8308: "VLP-16 position"}
_LONGEST_SOCKET_NAME = 107


@dataclass(frozen=True)
class Finding:
    """Result of a check.

    Attributes:
        level: OK, WARN (a function will be missing or slow) or FAIL (the stack will not work).
        subject: the checked device, file or setting.
        text: result of the check.
        advice: remedy; empty if nothing is wrong.
    """

    level: str
    subject: str
    text: str
    advice: str = ""


def run(args: argparse.Namespace) -> int:
    """Run the checks and print their findings."""
    colours = {OK: "32", WARN: "33", FAIL: "31"} if sys.stdout.isatty() else {}
    counts = {OK: 0, WARN: 0, FAIL: 0}
    serial_port = Path(args.serial_port or _configured("crawler_base", "roboclaw.port", "/dev/ttyACM0"))
    camera_url = args.camera_url or _configured("theta_camera", "url", "http://192.168.1.1")
    lidar_port = args.lidar_port or _configured("vlp16_driver", "port", 2368)
    missing = FAIL if args.robot else WARN
    checks = run_checks(paths.run_dir(), serial_port, camera_url, lidar_port, args.listen, missing)
    for finding in checks:
        counts[finding.level] += 1
        level = f"{finding.level:<4}"
        if finding.level in colours:
            level = f"\033[{colours[finding.level]}m{level}\033[0m"
        text = visible(masked(f"{finding.subject}: {finding.text}"))
        print(f"{level}  {text}", file=direct(sys.stdout), flush=True)
        if finding.advice and finding.level != OK:
            print(f"      → {finding.advice}", flush=True)
    print(f"{counts[OK]} ok, {counts[WARN]} warnings, {counts[FAIL]} failures")
    return 1 if counts[FAIL] else 0


def _configured(node: str, key: str, default: Any) -> Any:
    """Return a parameter of the shipped config/robot.yaml."""
    try:
        found = load_file(paths.shipped_file("config", "robot.yaml"), node).get(key)
    except (ParameterError, FileNotFoundError):
        return default  # the fault in the file is reported by check_configuration
    return default if found is None else found.value


def run_checks(
    run_dir: Path, serial_port: Path, camera_url: str, lidar_port: int, listen_s: float, missing: str
) -> Iterator[Finding]:
    """Run every check, the slow ones last.

    Args:
        run_dir: run directory of the stack.
        serial_port: port of the RoboClaw.
        camera_url: URL of the Theta.
        lidar_port: UDP port of the VLP-16's data.
        listen_s: longest wait for LiDAR packets.
        missing: level of a missing device: FAIL or WARN.
    """
    yield from check_machine(run_dir)
    yield from check_configuration()
    yield from check_models()
    yield from check_ports(TCP_PORTS, UDP_PORTS)
    yield from check_gpu()
    yield from check_network_filter()
    yield from check_serial(serial_port, missing)
    yield from check_camera(camera_url, missing)
    yield from check_lidar(lidar_port, listen_s, missing)


def check_machine(run_dir: Path) -> Iterator[Finding]:
    """Check Python, cores, memory, disk, shared memory and run directory."""
    import psutil

    yield Finding(OK, "python", ".".join(map(str, sys.version_info[:3])))
    cores = len(os.sched_getaffinity(0))
    yield _at_least("cores", cores, MIN_CORES, "", "the stack will run at lower rates")
    memory_gb = psutil.virtual_memory().total / 1e9
    yield _at_least("memory", memory_gb, MIN_MEMORY_GB, " GB", "run station.yaml on another machine")
    disk_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    yield _at_least("disk", disk_gb, MIN_DISK_GB, " GB free here", "free disk space before recording bags")
    if Path("/dev/shm").is_dir():
        shm_mb = shutil.disk_usage("/dev/shm").free / 1e6
        yield _at_least("/dev/shm", shm_mb, MIN_SHM_MB, " MB free", "in a container: --shm-size=256m")
    else:
        yield Finding(WARN, "/dev/shm", "is missing", "mount a tmpfs there")
    yield _check_run_dir(run_dir)


def _at_least(subject: str, value: float, least: float, unit: str, advice: str) -> Finding:
    text = f"{value:.0f}{unit}" if value >= 10 or float(value).is_integer() else f"{value:.1f}{unit}"
    if value >= least:
        return Finding(OK, subject, text)
    return Finding(WARN, subject, f"{text}, at least {least:g} recommended", advice)


def _check_run_dir(run_dir: Path) -> Finding:
    from instant_ic.bus import RegistryError, registry

    try:
        registry.prepare(run_dir)
        longest = registry.topic_dir(run_dir, "/camera/image/compressed") / "depth_estimator.sock"
    except RegistryError as error:
        advice = "set INSTANT_IC_RUN_DIR to a folder that only you can write to"
        return Finding(FAIL, "run directory", str(error), advice)
    if len(os.fsencode(longest)) > _LONGEST_SOCKET_NAME:
        advice = "set INSTANT_IC_RUN_DIR to a shorter path"
        return Finding(FAIL, "run directory", f"{run_dir} is too long for sockets", advice)
    nodes = registry.list_nodes(run_dir)
    return Finding(OK, "run directory", f"{run_dir}, {len(nodes)} nodes running")


def check_configuration() -> Iterator[Finding]:
    """Check every shipped launch file and the parameters of its nodes."""
    from instant_ic.launch import LaunchFileError, read_arguments, read_launch_file
    from instant_ic.launch.parameters import check_parameters

    for file in _shipped("launch", "*.yaml"):
        problems: Sequence[object]
        try:
            needed = {a.name: "placeholder" for a in read_arguments(file) if a.default is None}
            problems = check_parameters(read_launch_file(file, needed).nodes)
        except LaunchFileError as error:
            problems = error.problems
        if problems:
            more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
            yield Finding(FAIL, f"launch/{file.name}", f"{problems[0]}{more}", f"ic launch {file.stem} --check")
        else:
            yield Finding(OK, f"launch/{file.name}", "no errors")


def check_models() -> Iterator[Finding]:
    """Check that every model file loads."""
    import onnxruntime

    models = _shipped("models", "*.onnx")
    if not models:
        yield Finding(FAIL, "models", "no model file found", "install the package again")
    for model in models:
        try:
            session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001 - onnxruntime's errors share no base class
            yield Finding(FAIL, f"models/{model.name}", str(error).splitlines()[0], "install the package again")
            continue
        shape = "x".join(str(size) for size in session.get_inputs()[0].shape)
        yield Finding(OK, f"models/{model.name}", f"{model.stat().st_size / 1e6:.1f} MB, input {shape}")


def _shipped(folder: str, pattern: str) -> list[Path]:
    return sorted(paths.share_dir(folder).glob(pattern))


def check_ports(tcp: Mapping[int, str], udp: Mapping[int, str]) -> Iterator[Finding]:
    """Check that ports are free. ``tcp`` and ``udp`` map each port to the name of its user."""
    for kind, word, ports in ((socket.SOCK_STREAM, "tcp", tcp), (socket.SOCK_DGRAM, "udp", udp)):
        for port, need in ports.items():
            try:
                with socket.socket(socket.AF_INET, kind) as probe:
                    if kind == socket.SOCK_STREAM:
                        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    probe.bind(("127.0.0.1", port))
            except OSError as error:
                advice = "a stack is already running; stop it, or set another port (ic launch sim --show-args)"
                yield Finding(WARN, f"{word} port {port}", f"{need}: {error.strerror}", advice)
            else:
                yield Finding(OK, f"{word} port {port}", f"free for the {need}")


def check_gpu() -> Iterator[Finding]:
    """Check whether torch can use a CUDA device."""
    if importlib.util.find_spec("torch") is None:
        yield Finding(FAIL, "gpu", "torch is not installed", "pip install torch")
        return
    import torch

    if torch.cuda.is_available():
        yield Finding(OK, "gpu", torch.cuda.get_device_name(0))
    elif Path("/proc/driver/nvidia/version").exists():
        yield Finding(WARN, "gpu", f"torch {torch.__version__} cannot use the GPU", "install a CUDA build of torch")
    else:
        yield Finding(OK, "gpu", "none: the virtual space is trained on the CPU")


def check_network_filter(root: Path = Path("/proc/sys/net/ipv4/conf")) -> Iterator[Finding]:
    """Check reverse-path filtering, which silently drops packets of a sensor in another subnet if it is strict."""
    strict = []
    for file in sorted(root.glob("*/rp_filter")):
        try:
            if file.read_text().strip() == "1" and file.parent.name not in ("lo", "default"):
                strict.append(file.parent.name)
        except OSError:
            continue
    if strict:
        text = f"strict on {', '.join(strict)}: packets of a VLP-16 in another subnet are dropped"
        advice = f"sysctl -w net.ipv4.conf.{strict[-1]}.rp_filter=2, or give the interface an address in its subnet"
        yield Finding(WARN, "rp_filter", text, advice)
    else:
        yield Finding(OK, "rp_filter", "not strict")


def check_serial(port: Path, missing: str, devices: Callable[[], list[Any]] | None = None) -> Iterator[Finding]:
    """Check that the RoboClaw's serial port exists and may be opened."""
    if devices is None:
        from serial.tools.list_ports import comports as devices
    assert devices is not None
    if not port.exists():
        others = ", ".join(device.device for device in devices()) or "none"
        advice = "connect the RoboClaw, or set serial_port:=... (not needed for sim.yaml)"
        yield Finding(missing, f"serial {port}", f"does not exist (available: {others})", advice)
        return
    if os.access(port, os.R_OK | os.W_OK):
        yield Finding(OK, f"serial {port}", "can be opened")
        return
    info = port.stat()
    try:
        group = grp.getgrgid(info.st_gid).gr_name
    except KeyError:
        group = str(info.st_gid)
    user = pwd.getpwuid(os.getuid()).pw_name
    advice = f"sudo usermod -aG {group} {user}, then log in again"
    yield Finding(missing, f"serial {port}", f"no permission ({stat.filemode(info.st_mode)} {group})", advice)


def check_camera(url: str, missing: str) -> Iterator[Finding]:
    """Check that the Theta answers on its Web API."""
    import requests

    url = url.rstrip("/")
    try:
        with requests.Session() as session:
            session.trust_env = False  # a proxy cannot reach a camera in the local network
            reply = session.get(f"{url}/osc/info", timeout=2.0)
        info = reply.json() if reply.status_code == 200 else {}
    except (requests.RequestException, ValueError) as error:
        unreachable = isinstance(error, requests.Timeout | requests.ConnectionError)
        text = "is unreachable" if unreachable else f"no Web API at this address ({type(error).__name__})"
        advice = "join the camera's wireless network, or set camera_url:=... (not needed for sim.yaml)"
        yield Finding(missing, f"camera {url}", text, advice)
        return
    if reply.status_code != 200:
        advice = "something else answers there: set camera_url:=... to the camera's address"
        if reply.status_code in (401, 403):
            advice = "in client mode the camera needs user and password (docs/devices.md)"
        yield Finding(missing, f"camera {url}", f"HTTP status {reply.status_code}", advice)
        return
    model, firmware = info.get("model", "unknown model"), info.get("firmwareVersion", "?")
    yield Finding(OK, f"camera {url}", f"{model}, firmware {firmware}")


def check_lidar(port: int, listen_s: float, missing: str) -> Iterator[Finding]:
    """Check that packets of a VLP-16 arrive."""
    subject = f"lidar udp {port}"
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(("", port))
            receiver.settimeout(listen_s)
            packet, sender = receiver.recvfrom(2048)
    except TimeoutError:
        advice = "check the sensor's cable and address (default 192.168.1.201; not needed for sim.yaml)"
        yield Finding(missing, subject, f"no packet in {listen_s:g} s", advice)
    except OSError as error:
        advice = "another driver already uses the port; stop it"
        yield Finding(missing, subject, f"cannot listen: {error.strerror}", advice)
    else:
        if len(packet) == 1206:
            yield Finding(OK, subject, f"packets from {sender[0]}")
        else:
            advice = "another device sends to this port; stop it, or set another port"
            yield Finding(missing, subject, f"{len(packet)} bytes from {sender[0]} are not a VLP-16 packet", advice)
