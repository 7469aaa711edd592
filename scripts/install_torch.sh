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
pip=("$python" -m pip install -q --disable-pip-version-check --progress-bar off --no-deps --only-binary :all:)
# A dry run shows which build would come; only a CPU build is installed. Torch's own index is asked too, but pip also looks
# at the extra indexes of its configuration, which may offer a CUDA build.
for index in "" "--retries 1 --index-url https://download.pytorch.org/whl/cpu"; do
  report=$("${pip[@]}" $index --dry-run --report - "$spec" 2>/dev/null || true)
  if grep -qE '"version": "[^"]+\+cpu' <<<"$report"; then exec "${pip[@]}" $index "$spec"; fi
done
echo "no index offers a CPU build of $spec for this Python" >&2
exit 1
