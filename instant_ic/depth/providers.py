"""Choice of onnxruntime's execution provider: TensorRT, CUDA or the CPU."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from instant_ic.util.paths import cache_dir

PROVIDERS = {
    "tensorrt": "TensorrtExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "cpu": "CPUExecutionProvider",
}
"""Short name → onnxruntime's name, the fastest first."""
CHOICES = ("auto", *PROVIDERS)


@dataclass(frozen=True)
class OpenSession:
    """A session, its provider, and why a faster one is not used.

    Attributes:
        session: ``onnxruntime.InferenceSession``.
        provider: key of :data:`PROVIDERS` that runs it.
        notes: why each one that was wished for before it was not taken.
    """

    session: Any
    provider: str
    notes: tuple[str, ...] = ()


def open_session(model_file: Path, threads: int, provider: str = "auto") -> OpenSession:
    """Open a model on the first provider that works; the CPU is always last.

    Args:
        model_file: ONNX file; weights in a file beside it (``external data``) are found.
        threads: CPU threads of one inference.
        provider: ``auto`` tries all of :data:`PROVIDERS`, a name that one and those after it.

    Raises:
        ValueError: no such provider, or ``threads`` < 1.
        Exception: onnxruntime's own, when not even the CPU can run the model.
    """
    import onnxruntime

    if provider not in CHOICES:
        raise ValueError(f"provider must be one of {', '.join(CHOICES)} (got {provider!r})")
    if threads < 1:
        raise ValueError(f"threads must be 1 or more (got {threads})")
    names = list(PROVIDERS)
    available = onnxruntime.get_available_providers()
    notes: list[str] = []
    for name in names[names.index(provider) if provider in names else 0 :]:
        full = PROVIDERS[name]
        if full not in available:
            notes.append(f"{name}: not in this onnxruntime (pip install onnxruntime-gpu instead of onnxruntime)")
            continue
        # onnxruntime falls back by itself and prints to stdout; here each one is tried alone and the caller reports it.
        wanted: list[Any] = [(full, _options(name))] if name != "cpu" else []
        if name == "tensorrt" and PROVIDERS["cuda"] in available:
            wanted.append(PROVIDERS["cuda"])  # for layers that TensorRT does not know
        try:
            if wanted and hasattr(onnxruntime, "preload_dlls"):
                onnxruntime.preload_dlls()  # CUDA and cuDNN from pip's packages
            session = onnxruntime.InferenceSession(
                str(model_file), _session_options(threads), [*wanted, PROVIDERS["cpu"]], enable_fallback=0
            )
        except Exception as error:  # onnxruntime's exceptions share no public base
            if name == "cpu":
                raise
            notes.append(f"{name}: {_first_line(error)}")
            continue
        if session.get_providers()[0] == full:
            return OpenSession(session, name, tuple(notes))
        notes.append(f"{name}: its libraries or its GPU are missing")
    raise RuntimeError("this onnxruntime has no CPU provider")


def _session_options(threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    # Idle workers sleep: the rest of the stack runs on the same cores.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    return options


def _options(name: str) -> dict[str, str]:
    if name != "tensorrt":
        return {}
    cache = cache_dir() / "tensorrt"  # an engine takes minutes to build
    cache.mkdir(parents=True, exist_ok=True)
    return {
        "trt_engine_cache_enable": "True", "trt_engine_cache_path": str(cache),
        "trt_timing_cache_enable": "True", "trt_timing_cache_path": str(cache),
    }  # fmt: skip


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
