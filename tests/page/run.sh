#!/usr/bin/env bash
# Tries the page in a browser: run.sh [PROGRAM] [more arguments of page.py], or run.sh --install for what it
# needs alone. Installs Playwright and axe under target/page; the browser is the system's Chromium. Without Python, npm or Chromium nothing is tried, aloud.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)
only_install=''
if [ "${1:-}" = --install ]; then
  only_install=yes
else
  program=$(realpath "${1:-$root/target/debug/intarsia}")
  shift || true
  [ -x "$program" ] || { echo "there is no $program: cargo build first" >&2; exit 2; }
fi
work=$root/target/page
mkdir -p "$work"

browser=$(command -v chromium || command -v chromium-browser || command -v google-chrome || true)
if [ -z "$browser" ] || ! command -v npm >/dev/null || ! python3 -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
  echo "SKIPPED: the page (no Chromium, no npm, or no python3 of 3.10 or later with venv)" >&2
  exit 0
fi
python=$work/python/bin/python
if ! cmp -s "$here/requirements.txt" "$work/python/installed"; then
  python3 -m venv --clear "$work/python"
  "$python" -m pip install --quiet --disable-pip-version-check -r "$here/requirements.txt"
  cp "$here/requirements.txt" "$work/python/installed"
fi
if [ ! -f "$work/node/node_modules/axe-core/axe.min.js" ]; then
  mkdir -p "$work/node"
  (cd "$work/node" && npm install --silent --no-audit --no-fund --prefix . axe-core@4)
fi
[ -z "$only_install" ] || exit 0
exec "$python" "$here/page.py" "$program" --browser "$browser" --axe "$work/node/node_modules/axe-core/axe.min.js" --work "$work" "$@"
