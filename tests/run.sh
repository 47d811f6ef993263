#!/bin/sh
# Runs the tests and ends with `N passed, N failed`.
#   tests/run.sh BUILD             everything
#   tests/run.sh BUILD nodeps|compat|sanitize|fuzz|scenes|figures|sweep|stability|neural|unit   one part
# Public test data is used where it lies beside the checkout (or at $TSS_DATA); nothing needs it.
set -u
export OMP_WAIT_POLICY=passive  # tests may share the machine: threads that wait shall not spin
build=$1
part=${2:-all}
cc=${CC:-cc}
data=${TSS_DATA:-../shared/data}
passed=0
failed=0
log=$build/log
mkdir -p "$build" "$log"

warn="-Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wsign-conversion"
inc="-I. -Iexamples -Itests"
none="-DTSS_NO_OPENMP -DTSS_NO_LAPACK -DTSS_NO_METIS -DTSS_NO_SIMD"

if [ -d "$data" ]; then
    export TSS_DATA="$data" TSS_TEST_DATA="$data" TSS_CCD_DATA="$data/ccd"
fi

ok()  { passed=$((passed + 1)); printf 'ok      %s\n' "$1"; }
bad() { failed=$((failed + 1)); printf 'FAILED  %s\n' "$1"; [ -z "${2:-}" ] || tail -n 15 "$2" | sed 's/^/        /'; }

# check NAME COMMAND...: one test that passes if the command does.
check() {
    name=$1; shift
    out="$log/$(echo "$name" | tr -c 'A-Za-z0-9_\n' _).log"
    if "$@" >"$out" 2>&1; then ok "$name"; else bad "$name" "$out"; fi
}

# suite NAME PROGRAM [ARG...]: a cmocka program; its tests are counted one by one.
suite() {
    name=$1; shift
    out="$log/$(echo "$name" | tr -c 'A-Za-z0-9_\n' _).log"
    CMOCKA_MESSAGE_OUTPUT=TAP "$@" >"$out" 2>&1
    code=$?
    p=$(grep -c '^ok ' "$out"); f=$(grep -c '^not ok ' "$out")
    [ "$code" = 0 ] || [ "$f" -gt 0 ] || f=1
    [ "$((p + f))" -gt 0 ] || f=1
    passed=$((passed + p)); failed=$((failed + f))
    if [ "$f" = 0 ]; then printf 'ok      %s (%d)\n' "$name" "$p"
    else printf 'FAILED  %s (%d of %d)\n' "$name" "$f" "$((p + f))"; grep -v '^ok ' "$out" | tail -n 15 | sed 's/^/        /'; fi
}

libs() { case "$1" in *NO_METIS*) ;; *) printf -- '-lmetis ';; esac; printf -- '-lm'; }

# variant NAME FLAGS TEST...: builds and runs test programs with other flags.
variant() {
    config=$1; flags=$2; shift 2
    for t in "$@"; do
        exe="$build/${t}_$config"
        # shellcheck disable=SC2086
        if $cc -std=c11 -O1 -g $warn $inc $flags "tests/$t.c" -o "$exe" -lcmocka -lcjson -lpng $(libs "$flags") -lpthread \
            >"$log/${t}_$config.build" 2>&1 && [ ! -s "$log/${t}_$config.build" ]
        then suite "$t [$config]" "$exe"; else bad "$t [$config] does not build without a warning" "$log/${t}_$config.build"; fi
    done
}

core_tests="test_core test_linalg test_ipcworld"
features="MATERIALS DAMPING THIN FRICTION EIGEN"

unit() {
    for exe in "$build"/test_*; do
        case $(basename "$exe") in *\[*|*_no_*|*_asan|*_tsan|*_serial|*_nothing) continue;; esac
        [ -x "$exe" ] && suite "$(basename "$exe")" "$exe"
    done
}

checkers() {
    [ -d "$data" ] || return 0
    check "contact reference" "$build/contact_reference" "$data/contact/reference.csv"
    check "ccd queries" "$build/ccd_queries" "$data"/ccd/*.csv
}

nodeps() {
    variant no_openmp "-fno-openmp -DTSS_NO_OPENMP" test_core
    variant no_lapack "-fopenmp -DTSS_NO_LAPACK" test_linalg
    variant no_metis "-fopenmp -DTSS_NO_METIS" test_linalg
    # shellcheck disable=SC2086
    variant nothing "$none" $core_tests
    # Each feature alone, then all: what is left out is refused by name, what is left works.
    every=""
    for f in 2D 3D $features; do variant "no_$(echo "$f" | tr A-Z a-z)" "$none -DTSS_NO_$f" test_leave_out; done
    for f in $features; do every="$every -DTSS_NO_$f"; done
    variant no_2d_nothing "$none -DTSS_NO_2D$every" test_leave_out
    variant no_3d_nothing "$none -DTSS_NO_3D$every" test_leave_out
    scene_alone "$build/slope.json" 3
    scene_alone examples/scenes/flat.json 3
}

# scene_alone SCENE STEPS: the flags that `tss check` prints for a scene build a runner that ends in
# the same state, and that refuses a scene with a feature left out. slope.json: without friction.
scene_alone() {
    name=$(basename "$1" .json)
    [ -f "$1" ] || sed 's/"mu": *[0-9.]*/"mu": 0/g' "examples/scenes/$name.json" >"$1"
    make -s "$build/tss" || { bad "scene $name alone: the runner does not build"; return; }
    defs=$("$build/tss" check "$1" 2>/dev/null | sed -n 's/^this scene needs: //p' | grep -o -- '-DTSS_NO_[A-Z0-9_]*' | tr '\n' ' ')
    [ -n "$defs" ] || { bad "scene $name alone: no flags"; return; }
    make -s BUILD="$build/alone_$name" CFLAGS="-O1 -march=native" DEFS="$defs" "$build/alone_$name/tss" \
        >"$log/alone_$name.build" 2>&1 && [ ! -s "$log/alone_$name.build" ] ||
        { bad "scene $name alone does not build without a warning" "$log/alone_$name.build"; return; }
    for b in "$build" "$build/alone_$name"; do
        "$b/tss" run "$1" --steps "$2" -o "$build/scene_out_$part" 2>/dev/null | grep '^state ' >"$b/state_$name"
    done
    if [ -s "$build/state_$name" ] && cmp -s "$build/state_$name" "$build/alone_$name/state_$name"
    then ok "scene $name alone: the same state with $defs"; else bad "scene $name alone: another state"; fi
    if "$build/alone_$name/tss" run "$1" --set bodies.0.material.kind=stvk --steps 1 -o "$build/scene_out_$part" \
        >"$log/refused_$name.log" 2>&1 || ! grep -q "left out of this build by TSS_NO_MATERIALS" "$log/refused_$name.log"
    then bad "scene $name alone: stvk is not refused" "$log/refused_$name.log"; else ok "scene $name alone refuses stvk"; fi
}

# What someone does who copies the headers into an empty folder.
compat() {
    dir=$build/empty
    rm -rf "$dir"; mkdir -p "$dir"
    cp tss.h tss_ipc.h examples/01_hello.c "$dir"
    bare="-DTSS_NO_OPENMP -DTSS_NO_LAPACK -DTSS_NO_METIS"
    # shellcheck disable=SC2086
    (cd "$dir" && $cc $bare 01_hello.c -lm -o hello) >"$log/hello.build" 2>&1 && ok "hello in an empty folder" ||
        bad "hello in an empty folder" "$log/hello.build"
    check "hello runs" "$dir/hello"
    cp examples/01_hello.c "$dir/hello.cpp"
    # shellcheck disable=SC2086
    (cd "$dir" && c++ -std=c++17 $bare hello.cpp -lm -o hellopp) >"$log/hellopp.build" 2>&1 && ok "hello as C++" ||
        bad "hello as C++" "$log/hellopp.build"
    # The programs in README and manual compile and run as printed.
    for doc in README.md docs/manual.md; do
        awk -v d="$dir" -v n="$(basename $doc .md)" '/^```c$/ {k++; f=d "/" n k ".c"; next} /^```/ {f=""} f {print > f}' $doc
    done
    for f in "$dir"/README*.c "$dir"/manual*.c; do
        grep -q 'int main' "$f" 2>/dev/null || continue
        grep -q TSS_IMPLEMENTATION "$f" || { { printf '#define TSS_IMPLEMENTATION\n#include "tss.h"\n#include <stdio.h>\n'; cat "$f"; } >"$f.c"; f=$f.c; }
        # shellcheck disable=SC2086
        if $cc $bare -I. "$f" -lm -o "$f.exe" >"$log/doc.build" 2>&1 && "$f.exe" >"$log/doc.run" 2>&1
        then ok "documentation: $(basename "$f")"; else bad "documentation: $(basename "$f")" "$log/doc.build"; fi
    done
    for comp in gcc clang g++ clang++; do
        command -v $comp >/dev/null 2>&1 || continue
        case $comp in *++) std="-std=c++17 -x c++" ;; *) std=-std=c11 ;; esac
        # shellcheck disable=SC2086
        if $comp $std -O1 $warn -Werror $inc -fsyntax-only tests/compile/all.c >"$log/compile_$comp.log" 2>&1
        then ok "all headers, $comp, no warning"; else bad "all headers, $comp, no warning" "$log/compile_$comp.log"; fi
    done
    # Two translation units, one implementation; nothing unprefixed leaves it.
    # shellcheck disable=SC2086
    if $cc -std=c11 -O1 $inc $none -c tests/compile/all.c -o "$build/tu_impl.o" 2>"$log/tu.log" &&
       $cc -std=c11 -O1 $inc $none -c tests/compile/user.c -o "$build/tu_user.o" 2>>"$log/tu.log" &&
       $cc "$build/tu_impl.o" "$build/tu_user.o" -lm -o "$build/tu" 2>>"$log/tu.log" && "$build/tu" >>"$log/tu.log"
    then ok "two translation units"; else bad "two translation units" "$log/tu.log"; fi
    nm --defined-only --extern-only "$build/tu_impl.o" | awk '{print $3}' | grep -v '^tss_' >"$log/nm.log"
    if [ -s "$log/nm.log" ]; then bad "only tss_ symbols are exported" "$log/nm.log"; else ok "only tss_ symbols are exported"; fi
}

sanitize() {
    # shellcheck disable=SC2086
    variant asan "-fsanitize=address,undefined -fno-sanitize-recover=undefined $none" $core_tests test_elastic test_neural test_reduced test_shell
    variant tsan "-fsanitize=thread -DTSS_NO_OPENMP -DTSS_NO_LAPACK -DTSS_NO_METIS -DTSS_NO_SIMD" test_threads
}

fuzz() {
    command -v clang >/dev/null 2>&1 || { echo "fuzz: needs clang"; return 0; }
    for f in tests/fuzz/*.c; do
        name=$(basename "$f" .c)
        # shellcheck disable=SC2086
        if clang -g -O1 -fsanitize=fuzzer,address,undefined $inc $none "$f" -o "$build/$name" -lm >"$log/$name.build" 2>&1
        then mkdir -p "$build/corpus_$name"; check "fuzz $name 60 s" "$build/$name" -max_total_time=60 "$build/corpus_$name"
        else bad "fuzz $name does not build" "$log/$name.build"; fi
    done
}

# Scenes from start to end under the independent checker: no intersection, no inversion, targets met.
scenes() {
    for s in tests/data/*.json; do
        [ -f "$s" ] && check "scene $(basename "$s" .json)" "$build/tss" run "$s" -o "$build/scene_out_$part" --check
    done
    [ -d "$data/ipc/scenes" ] || return 0
    for s in 10_tetTet 10_cubeStack 12_largeMassRatio sqp_04_pointTriangle sqp_05_edgeEdge sqp_09_tetCube \
             sqp_10_alignedTetCube sqp_12_alignedCubes sqp_14_fiveCubeStack erleben_cubeCliffCO \
             erleben_spikeSpikeCO erleben_wedgeCrackCO rodsTwist_E1e4_dt2; do
        [ -f "$data/ipc/scenes/$s.txt" ] || continue
        steps=30
        [ "$s" != rodsTwist_E1e4_dt2 ] || steps=1  # an end turns by 144 degrees a step
        check "scene $s" "$build/tss" run "$data/ipc/scenes/$s.txt" --assets "$data/ipc" --steps $steps \
            -o "$build/scene_out_$part" --check
    done
}

# claims NAME: tests/NAME.sh prints a line `ok` or `FAILED` a claim.
claims() {
    out="$log/$1.log"
    sh "tests/$1.sh" "$build" >"$out" 2>&1
    grep -E '^(ok|FAILED) ' "$out"
    p=$(grep -c '^ok ' "$out"); f=$(grep -c '^FAILED ' "$out")
    [ "$((p + f))" -gt 0 ] || { f=1; tail -n 15 "$out"; }
    passed=$((passed + p)); failed=$((failed + f))
}

# Paper A's figures on small meshes.
figures() { claims figures; }
# Error against run time.
sweep() { claims sweep; }
# Neural subspaces: training, its resumption, evaluation.
neural() { claims neural; }
# Stiff and extreme cases, judged on every iterate.
stability() { claims stability; }

# Parts one after the other, each in a process of its own; what they print comes part by part.
lane() {
    for p in "$@"; do
        began=$(date +%s)
        sh "$0" "$build" "$p" >"$log/part_$p.txt" 2>&1
        { sed '$d' "$log/part_$p.txt"; echo "        part $p: $(tail -n 1 "$log/part_$p.txt"), $(($(date +%s) - began)) s"; } >"$log/part_$p.out"
        cat "$log/part_$p.out"
    done
}

# Two lanes: half the time goes into compilers, which use one core.
all() {
    lane nodeps sanitize compat &
    lane unit checkers scenes figures sweep stability neural
    wait
    for p in unit checkers scenes figures sweep stability neural nodeps compat sanitize; do
        last=$(tail -n 1 "$log/part_$p.txt")
        case $last in
        *" passed, "*" failed") passed=$((passed + ${last%% *})); last=${last#*, }; failed=$((failed + ${last%% *})) ;;
        *) bad "part $p did not end" "$log/part_$p.txt" ;;
        esac
    done
}

$part
printf '%d passed, %d failed\n' "$passed" "$failed"
[ "$failed" = 0 ]
