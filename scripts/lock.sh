#!/usr/bin/env bash
# Writes requirements.lock: every package of the versions in constraints.txt, with the hashes of all its files.
# torch is left out: scripts/install_torch.sh installs its CPU build. Needs network; `make lock` runs it.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q --disable-pip-version-check -c constraints.txt uv
# The mirror's or the user's own settings must not reach the lock: uv reads no pip configuration, and names no index.
# pip itself is locked too: it installs all the others.
echo pip | "$folder/venv/bin/uv" pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
  --custom-compile-command 'make lock' --extra dev --extra train --constraint constraints.txt --no-emit-package torch \
  --output-file "$folder/requirements.lock" pyproject.toml -
mv "$folder/requirements.lock" requirements.lock
