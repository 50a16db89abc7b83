#!/usr/bin/env bash
# Holds the OpenAPI document against its readers: run.sh [PROGRAM], or run.sh --install for what it needs alone. Checks it and its examples,
# generates a Python and a TypeScript client and runs both against a service of PROGRAM (target/debug/intarsia), then lets schemathesis try every call. Without Python or Node.js that part is
# skipped, aloud.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)
only_install=''
if [ "${1:-}" = --install ]; then
  only_install=yes
else
  program=$(realpath "${1:-$root/target/debug/intarsia}")
  [ -x "$program" ] || { echo "there is no $program: cargo build first" >&2; exit 2; }
fi
work=$root/target/clients
mkdir -p "$work"
work=$(cd "$work" && pwd)
document=$root/api/openapi.json

say() { printf -- '-- %s (%ss)\n' "$1" "$SECONDS"; }

python=''
if python3 -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
  python=$work/python/bin/python
  if ! cmp -s "$here/requirements.txt" "$work/python/installed"; then
    say "installing Python packages"
    python3 -m venv --clear "$work/python"
    "$python" -m pip install --quiet --disable-pip-version-check -r "$here/requirements.txt"
    cp "$here/requirements.txt" "$work/python/installed"
  fi
else
  echo "SKIPPED: the Python client, the examples and schemathesis (no python3 of 3.10 or later with venv)" >&2
fi

node=''
if command -v npm >/dev/null && node -e 'process.exit(+(parseInt(process.versions.node) < 20))' 2>/dev/null; then
  node=yes
  mkdir -p "$work/node"
  if ! cmp -s "$here/package-lock.json" "$work/node/installed"; then
    say "installing npm packages"
    cp "$here/package.json" "$here/package-lock.json" "$work/node/"
    (cd "$work/node" && npm ci --silent --no-audit --no-fund)
    cp "$here/package-lock.json" "$work/node/installed"
  fi
  cp "$here"/{package.json,tsconfig.json,generate.mjs,client.ts,redocly.yaml} "$work/node/"
else
  echo "SKIPPED: the TypeScript client and redocly (no Node.js of 20 or later with npm)" >&2
fi

[ -z "$only_install" ] || exit 0

service=''
trap '[ -z "$service" ] || kill "$service"; rm -rf "$work/data"' EXIT
rm -rf "$work/data"
"$program" serve --listen 127.0.0.1:0 --data-dir "$work/data" --list-jobs --max-queued 100000 --log-level warn >"$work/address" &
service=$!
for _ in $(seq 300); do
  base=$(sed -n 's/^listening on //p' "$work/address")
  [ -z "$base" ] || break
  kill -0 "$service"
  sleep 0.1
done
"$program" sample textured -o "$work/sample.glb" 2>/dev/null

if [ -n "$node" ]; then
  cd "$work/node"
  say "redocly"
  REDOCLY_TELEMETRY=off REDOCLY_SUPPRESS_UPDATE_NOTICE=true npx redocly lint --config redocly.yaml "$document" 2>"$work/redocly" || { cat "$work/redocly"; exit 1; }
  say "TypeScript client"
  node generate.mjs "$document" intarsia.ts
  npx tsc
  node built/client.js "$base" "$work/sample.glb"
fi

if [ -n "$python" ]; then
  cd "$work"
  export PATH=$work/python/bin:$PATH PYTHONPATH=$work/client:$here PYTHONDONTWRITEBYTECODE=1
  say "validator, examples"
  openapi-spec-validator "$document"
  python "$here/examples.py"
  say "manifests"
  python "$here/manifests.py" "$base" "$program"
  say "Python client"
  openapi-python-client generate --path "$document" --config "$here/python.yaml" --output-path "$work/client" --overwrite --fail-on-warning
  python "$here/client.py" "$base" "$work/sample.glb"
  say "schemathesis"
  # What an earlier run found would be tried first.
  rm -rf .schemathesis
  INTARSIA_SAMPLE=$work/sample.glb SCHEMATHESIS_HOOKS=hooks schemathesis --config-file "$here/schemathesis.toml" run "$document" --url "$base"
fi
say "done"
