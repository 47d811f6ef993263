#!/bin/sh
# Stiff and extreme cases in every mode, small. tests/stability.sh BUILD
# A line `ok name` or `FAILED name: why` a case; exit code 1 if one failed. Judge: tests/checker.h on
# every accepted iterate, closed forms for the rigid body (bench/bench_stability.c).
set -u
export OMP_WAIT_POLICY=passive
build=$1
cc=${CC:-cc}
mkdir -p "$build"
rm -rf "$build/stability_small"
$cc -std=c11 -O3 -march=native -fopenmp -I. -Iexamples -Itests -D_POSIX_C_SOURCE=200809L bench/bench_stability.c \
    -o "$build/bench_stability_small" -lcjson -lmetis -lm || { echo "FAILED  stability: bench_stability.c does not build"; exit 1; }
"$build/bench_stability_small" "$build/stability_small" --small all
