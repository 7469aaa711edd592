#!/usr/bin/env bash
# Installs the CPU build of torch, never the CUDA build of several gigabytes. The dependencies of torch are in
# requirements.lock, which is installed first.
#   install_torch.sh PYTHON [SPEC]    default: the pinned version
# A CUDA build of that version that is already there stays.
set -euo pipefail
python=$1
spec=${2:-$(grep -E '^torch==' "$(dirname "$0")/../constraints.txt")}
if "$python" - "${spec#torch==}" <<'PY'
import importlib.metadata as metadata, sys
try:
    have = metadata.version("torch")
except metadata.PackageNotFoundError:
    sys.exit(1)
want = sys.argv[1]
sys.exit(0 if have == want or have.split("+")[0] == want else 1)
PY
then exit 0; fi
pip=("$python" -m pip install -q --disable-pip-version-check --progress-bar off)
# A dry run shows which build the index offers; only a CPU build is installed from it.
report=$("$python" -m pip install -q --disable-pip-version-check --dry-run --no-deps --report - "$spec" 2>/dev/null || true)
if printf '%s' "$report" | grep -q '%2Bcpu\|+cpu'; then exec "${pip[@]}" --no-deps "$spec"; fi
exec "${pip[@]}" --no-deps --retries 1 --index-url https://download.pytorch.org/whl/cpu "$spec"
