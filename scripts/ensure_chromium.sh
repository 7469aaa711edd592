#!/usr/bin/env bash
# Installs Debian's Chromium for the browser tests if it is missing and the user may install packages.
set -euo pipefail
command -v chromium >/dev/null && exit 0
if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
  echo "Installing Chromium for the browser tests"
  apt-get update -qq
  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium fonts-dejavu-core >/dev/null
else
  echo "Chromium is missing: the browser tests will be skipped. Install it with: apt-get install chromium" >&2
fi
