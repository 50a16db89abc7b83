#!/usr/bin/env bash
# Refines a model with a running Intarsia service: posts it, follows the job, fetches the model and the report.
#
#   refine.sh MODEL [FILE…] [-r RECIPE] [-o OUT.glb] [--options FILE] [--require JSON] [--server URL] [--timeout SECONDS]
#
# FILEs are those that the model names (.bin, images, .mtl), in its folder or below. The report comes to lie beside OUT as
# OUT.report.json. Exit codes are those of `intarsia refine`: 0 done; 1 internal, or the service cannot be reached;
# 2 usage; 3 the input is at fault; 4 a requirement is not met, or there is a warning that
# `strict` names (the output is written all the same).
# Needs bash, curl and jq.
set -u

server=${INTARSIA_URL:-http://127.0.0.1:8080}
recipe='' out='' options='' require='' patience=3600
inputs=()

say() { printf '%s\n' "$*" >&2; }
die() { local code=$1; shift; say "error: $*"; exit "$code"; }
usage() { sed -n '2,/^# Needs/s/^# \{0,1\}//p' "$0"; }

while [ $# -gt 0 ]; do
  case $1 in
    -h | --help) usage; exit 0 ;;
    -r | --recipe | -o | --output | --options | --require | --server | --timeout)
      [ $# -ge 2 ] || die 2 "$1 needs a value"
      case $1 in
        -r | --recipe) recipe=$2 ;;
        -o | --output) out=$2 ;;
        --options) options=$2 ;;
        --require) require=$2 ;;
        --server) server=$2 ;;
        --timeout) patience=$2 ;;
      esac
      shift 2 ;;
    --) shift; inputs+=("$@"); break ;;
    -*) die 2 "unknown option $1; see --help" ;;
    *) inputs+=("$1"); shift ;;
  esac
done
[ ${#inputs[@]} -gt 0 ] || { usage >&2; exit 2; }
model=${inputs[0]}
case $patience in '' | *[!0-9]*) die 2 "--timeout is a number of seconds" ;; esac
for tool in curl jq; do command -v "$tool" >/dev/null || die 2 "$tool is missing"; done
for file in "${inputs[@]}"; do if ! [ -f "$file" ] || ! [ -r "$file" ]; then die 3 "cannot read $file"; fi; done
[ -z "$options" ] || [ -r "$options" ] || die 2 "cannot read $options"
server=${server%/}
[ -n "$out" ] || out=${model%.*}.refined.glb
[ -d "$(dirname -- "$out")" ] || die 2 "there is no folder $(dirname -- "$out")"

# The options: those of the file, and on top what the command line says.
body=$({ [ -n "$options" ] && cat -- "$options" || echo '{}'; } | jq -c . 2>/dev/null) || die 2 "the options are not JSON"
if [ -n "$recipe" ]; then body=$(jq -c --arg r "$recipe" '.recipe = $r' <<<"$body") || die 2 "the options are no object"; fi
if [ -n "$require" ]; then
  body=$(jq -c --argjson r "$require" '.require = (.require // {}) + $r' <<<"$body" 2>/dev/null) \
    || die 2 "--require is no JSON object"
fi

work=$(mktemp -d) || die 1 "no temporary folder"
job=''
trap 'rm -rf -- "$work"' EXIT
stop() {
  [ -z "$job" ] || curl -s -o /dev/null -m 5 -X POST "$server/v1/jobs/$job/cancel"
  die 1 "stopped; the job was told to stop too"
}
trap stop INT TERM HUP

# call ARG…: one request. Sets $status (000 when there was no answer); the body is in $work/body, the headers in $work/headers.
call() {
  : >"$work/headers"; : >"$work/body"
  status=$(curl -sS --connect-timeout 10 -m "$patience" -D "$work/headers" -o "$work/body" -w '%{http_code}' "$@" 2>"$work/said") || status=000
}
# header NAME: its value in the final answer (before it there may be a 100 Continue).
header() { tr -d '\r' <"$work/headers" | awk -v name="$1" 'BEGIN { FS = ": *" } /^HTTP\// { value = "" }
  tolower($1) == name { value = substr($0, length($1) + 2); sub(/^ +/, "", value) } END { print value }'; }
# pause [SECONDS]: as long as Retry-After says, else SECONDS; dies when patience ends.
pause() {
  local wait; wait=$(header retry-after)
  case $wait in '' | *[!0-9]*) wait=${1:-2} ;; esac
  [ $((SECONDS + wait)) -le "$patience" ] || die 1 "gave up after $SECONDS s${job:+; the job is $job}"
  sleep "$wait"
}
# exit_code CODE: what the command line makes of an error's code.
exit_code() {
  case $1 in
    invalid_options | invalid_request) echo 2 ;;
    requirement_not_met | strict_warning) echo 4 ;;
    internal | canceled | queue_full | insufficient_storage | unavailable | forbidden | not_found | gone | conflict | '') echo 1 ;;
    *) echo 3 ;;
  esac
}
# refused: dies with the words of a problem (RFC 9457).
refused() {
  local code words
  code=$(jq -r '.code // ""' "$work/body" 2>/dev/null)
  words=$(jq -r '.detail, (.errors // [] | .[] | "  \(.pointer): \(.message)")' "$work/body" 2>/dev/null)
  die "$(exit_code "$code")" "${words:-the service answered $status}"
}
# quoted PATH: a path as curl -F wants it between double quotes.
quoted() { printf '%s' "$1" | sed 's/[\\"]/\\&/g'; }

form=(-F "model=@\"$(quoted "$model")\";filename=\"$(quoted "$(basename -- "$model")")\"" --form-string "options=$body")
folder=$(dirname -- "$model")/
[ "$folder" = ./ ] && folder=''
for file in "${inputs[@]:1}"; do
  name=${file#"$folder"}
  case $name in /* | *../*) name=$(basename -- "$file") ;; esac
  form+=(-F "files=@\"$(quoted "$file")\";filename=\"$(quoted "$name")\"")
done

# The same key with every attempt: a submission whose answer was lost is not computed twice.
key=$(od -An -N16 -tx1 /dev/urandom | tr -d ' \n')
tries=0
while :; do
  call -H "Idempotency-Key: $key" -H 'Expect:' "${form[@]}" "$server/v1/jobs"
  case $status in
    200 | 201 | 202) break ;;
    429 | 502 | 503 | 504 | 507) say "the service is busy ($status)"; pause 5 ;;
    000)
      tries=$((tries + 1))
      [ "$tries" -lt 4 ] || die 1 "cannot reach $server: $(cat "$work/said")"
      pause "$tries" ;;
    *) refused ;;
  esac
done
job=$(jq -r '.id // ""' "$work/body" 2>/dev/null)
[ -n "$job" ] || die 1 "$server does not answer like Intarsia"
say "job $job"

# The job until it is final. While nothing has changed the answer is a 304 without a body.
etag='' shown='' tries=0
cp "$work/body" "$work/job"
while :; do
  state=$(jq -r .state "$work/job")
  line=$(jq -r 'if .state == "queued" then "waits" + (if .queue_position then ", number \(.queue_position)" else "" end)
    elif .state == "running" then "[\(.progress.stage_index + 1)/\(.progress.stage_count)] \(.progress.stage) \(.progress.fraction * 100 | floor) %"
    else .state end' "$work/job")
  [ "$line" = "$shown" ] || { say "$line"; shown=$line; }
  case $state in succeeded | failed | canceled | expired) break ;; esac
  pause 1
  while :; do
    call -m 60 ${etag:+-H "If-None-Match: $etag"} "$server/v1/jobs/$job"
    case $status in
      200) etag=$(header etag); cp "$work/body" "$work/job"; tries=0; break ;;
      304) tries=0; pause 1 ;;
      000 | 429 | 5??)
        tries=$((tries + 1))
        [ "$tries" -lt 10 ] || die 1 "lost the service: $(cat "$work/said"); the job is $job"
        pause 2 ;;
      *) refused ;;
    esac
  done
done

jq -r '.warnings[] | "warning: \(.code): \(.message)" + (if (.pointer // "") == "" then "" else " (at \(.pointer))" end)' "$work/job" >&2
# fetch ROLE FILE: the first artifact of that role, checked, under its name only when it is whole.
fetch() {
  local href want got i
  href=$(jq -r --arg r "$1" 'first(.artifacts[] | select(.role == $r) | .href) // ""' "$work/job")
  [ -n "$href" ] || return 1
  want=$(jq -r --arg r "$1" 'first(.artifacts[] | select(.role == $r) | .sha256)' "$work/job")
  for i in 1 2 3 4; do
    call "$server$href"
    if [ "$status" = 200 ]; then
      got=$({ sha256sum "$work/body" 2>/dev/null || shasum -a 256 "$work/body"; } | cut -d' ' -f1)
      if [ "$got" = "$want" ]; then
        if ! cp -- "$work/body" "$2.part" || ! mv -f -- "$2.part" "$2"; then die 1 "cannot write $2"; fi
        say "wrote $2"
        return 0
      fi
    fi
    case $status in 404 | 410) refused ;; esac
    pause "$i"
  done
  die 1 "cannot fetch $href (last answer: $status)"
}
if fetch model "$out"; then fetch report "$out.report.json"; fi

[ "$state" = succeeded ] && exit 0
jq -r '"error: \(.error.code // .state): \(.error.message // "the job has no result")" + (if (.error.pointer // "") == "" then "" else " (at \(.error.pointer))" end),
  (.error.failures // [] | .[] | "  \(.path): wanted \(.wanted), got \(.got // "nothing")")' "$work/job" >&2
exit "$(exit_code "$(jq -r '.error.code // ""' "$work/job")")"
