#!/usr/bin/env bash
# Writes requirements.lock: every package in its version from constraints.txt, with the hashes of all its files; and
# requirements-test.lock: triton, for `make test` alone.
# torch is excluded: scripts/install_torch.sh installs its CPU build. Needs network access; `make lock` runs this script.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install -q --disable-pip-version-check -c constraints.txt uv
# Settings of a mirror or of the user must not reach the lock file: uv reads no pip configuration and records no index.
# pip is locked too, because it installs the other packages.
compile=("$folder/venv/bin/uv" pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate
  --custom-compile-command 'make lock' --constraint constraints.txt)
echo pip | "${compile[@]}" --extra dev --no-emit-package torch --output-file "$folder/requirements.lock" \
  pyproject.toml -
echo triton | "${compile[@]}" --output-file "$folder/requirements-test.lock" -
mv "$folder"/requirements*.lock .
