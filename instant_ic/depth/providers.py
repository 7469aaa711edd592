"""Sessions of onnxruntime on TensorRT, CUDA or the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from instant_ic.util.paths import cache_dir

PROVIDERS = {
    "tensorrt": "TensorrtExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "cpu": "CPUExecutionProvider",
}
"""Short name → onnxruntime's name, fastest first."""
CHOICES = ("auto", *PROVIDERS)


def open_session(model_file: Path, threads: int, provider: str = "auto") -> Any:
    """Open a model. If a provider fails, onnxruntime uses the next one; the last is the CPU.

    Args:
        model_file: ONNX file; weights in a file beside it (``external data``) are found.
        threads: CPU threads of one inference.
        provider: first provider to try, or ``auto`` for the fastest provider of the installed onnxruntime.

    Returns:
        The ``onnxruntime.InferenceSession``.

    Raises:
        ValueError: the provider is unknown, or ``threads`` < 1.
        Exception: onnxruntime's error if not even the CPU can run the model.
    """
    import onnxruntime

    if provider not in CHOICES:
        raise ValueError(f"provider must be one of {', '.join(CHOICES)} (got {provider!r})")
    if threads < 1:
        raise ValueError(f"threads must be 1 or more (got {threads})")
    names = list(PROVIDERS)
    wanted = [PROVIDERS[name] for name in names[names.index(provider) if provider in names else 0 :]]
    available = [name for name in wanted if name in onnxruntime.get_available_providers()]
    if len(available) > 1 and hasattr(onnxruntime, "preload_dlls"):
        onnxruntime.preload_dlls()  # CUDA and cuDNN from pip's packages
    listed = [(name, _tensorrt_options()) if name == PROVIDERS["tensorrt"] else name for name in available]
    return onnxruntime.InferenceSession(str(model_file), _session_options(threads), listed)


def provider_of(session: Any) -> str:
    """Return the short name of the provider that runs a session."""
    first = session.get_providers()[0]
    return next((name for name, full in PROVIDERS.items() if full == first), first)


def _session_options(threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    # Idle workers must sleep, because the rest of the stack runs on the same cores.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    return options


def _tensorrt_options() -> dict[str, str]:
    cache = cache_dir() / "tensorrt"  # building an engine takes minutes
    cache.mkdir(parents=True, exist_ok=True)
    return {
        "trt_engine_cache_enable": "True", "trt_engine_cache_path": str(cache),
        "trt_timing_cache_enable": "True", "trt_timing_cache_path": str(cache),
    }  # fmt: skip
