#!/bin/sh
# The pages of `make report`. bench/report.sh [-b BUILD] [-o OUT] [PART...]
# Parts: error stability leave_out pages; none: all, in this order. Under 30 minutes in all: a part
# that runs out of its time is stopped, and the next call goes on where it was. A part that is done
# is not run again until the program or its script changes (or OUT/.done_PART is removed). A part
# that fails or has no script is said so and left out of the pages; the exit code is then 1.
set -u
build=build; out=out/report
while [ $# -gt 0 ]; do
    case $1 in
    -b) build=$2; shift 2 ;;
    -o) out=$2; shift 2 ;;
    *) break ;;
    esac
done
parts=${*:-error stability leave_out pages}
failed=
mkdir -p "$out" || exit 1

fail() { echo "report: $1" >&2; failed=1; }

# Not every system has timeout.
limit() {
    seconds=$1; shift
    if command -v timeout >/dev/null 2>&1; then timeout "$seconds" "$@"; else "$@"; fi
}

# part NAME SECONDS ARG...: runs bench/NAME.sh ARG... unless it is done.
part() {
    name=$1 seconds=$2 script=bench/$1.sh stamp=$out/.done_$1; shift 2
    [ -f "$script" ] || { fail "$name: $script is not there; the page is made without it"; return; }
    if [ "$stamp" -nt "$script" ] && [ "$stamp" -nt "$build/tss" ]; then
        echo "report: $name is done ($stamp)"
        return
    fi
    echo "report: $name, at most $seconds s"
    limit "$seconds" env BUILD="$build" OUT="$out" sh "$script" "$@"
    case $? in
    0) : >"$stamp" ;;
    124) fail "$name: stopped after $seconds s; the next \`make report\` goes on from here" ;;
    *) fail "$name: $script failed; the page shows what there is" ;;
    esac
}

for p in $parts; do
    case $p in
    error) part error 540 -b "$build" small "$out" ;;
    stability) part stability 900 ;;
    leave_out) part leave_out 300 "$build" "$out" ;;
    pages) "$build/report" bench/results "$out" || fail "pages: see above" ;;
    *) fail "$p: no such part (error stability leave_out pages)" ;;
    esac
done
[ -z "$failed" ]
