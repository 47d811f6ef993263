#!/bin/sh
# Runs the examples and checks the number each is known by.
set -u
build=$1
bad=0
expect() {  # name, pattern, command...
    name=$1 pattern=$2; shift 2
    if "$@" 2>&1 | grep -q "$pattern"; then echo "ok      $name"; else echo "FAILED  $name: expected '$pattern'"; bad=1; fi
}
expect 01_hello 'middle at 0.24' "$build/01_hello"
for s in flat press slope twist spiky_terrain; do
    expect "$s" '0 intersections, 0 undecided, 0 inversions' \
        "$build/tss" run "examples/scenes/$s.json" --check --steps 20 -o "$build/example_$s"
done
exit $bad
