"""Machine code on disk that is older than the kernels is not used."""

import os
from pathlib import Path

from instant_ic.vspace.nerf.numba_cache import forget_stale


def placed(path: Path, age_s: float) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.touch()
    os.utime(path, (1e9 - age_s, 1e9 - age_s))
    return path


def test_code_older_than_any_kernel_is_forgotten(tmp_path: Path) -> None:
    placed(tmp_path / "march.py", 100)
    placed(tmp_path / "space.py", 0)  # no kernel
    old = placed(tmp_path / "__pycache__" / "march.trace-1.py311.nbi", 50)
    assert forget_stale(tmp_path) == []
    placed(tmp_path / "kernels.py", 10)  # inlined into march's
    new = placed(tmp_path / "__pycache__" / "kernels.encode-1.py311.nbi", 5)
    assert forget_stale(tmp_path) == [old]
    assert new.exists() and not old.exists()


def test_a_folder_without_code_is_left_alone(tmp_path: Path) -> None:
    assert forget_stale(tmp_path) == []
