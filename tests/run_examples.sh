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
# What a newcomer mistypes.
expect 'a command that is not there' 'no such command: rn; did you mean "run"' "$build/tss" rn x
expect 'an option that is not there' 'no such option: --stepz; did you mean "--steps"' "$build/tss" run --stepz 3 x
expect 'help after a command' '^usage: tss run' "$build/tss" run --help
expect 'an option without its value' '^tss: --steps: expected a value' "$build/tss" run --steps
expect 'a value that is not one' '^tss: --steps q: expected a whole number' "$build/tss" run --steps=q x
expect 'a flag with a value' '^tss: --check: expected no value' "$build/tss" run --check= x
expect 'an option of another command' '^tss: --minutes: `tss neural run` does not take it; expected `tss neural train`$' "$build/tss" neural run x --minutes 3
expect 'a list without --sweep' 'expected --sweep' "$build/tss" compare x --nodes 1
expect 'a scene that is not there' 'nowhere.json: cannot be read: No such file or directory, expected a scene' "$build/tss" run nowhere.json
expect 'a folder as a scene' 'examples: cannot be read: Is a directory, expected a scene' "$build/tss" run examples
expect 'a value after an equals sign' 'flat.json: 3 bodies' "$build/tss" check examples/scenes/flat.json --threads=1
exit $bad
