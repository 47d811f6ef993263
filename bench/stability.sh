#!/bin/sh
# Stiff and extreme cases in every mode (docs/stability.md). Rows that are there are not run again.
#   bench/stability.sh                     everything, into bench/results/
#   bench/stability.sh NAME...             these cases (or those that begin so), `stiffness`, `fine_stiffness`, `rigid`
#   OUT=folder bench/stability.sh ...      elsewhere
set -eu
export OMP_WAIT_POLICY=passive
out=${OUT:-bench/results}
build=${BUILD:-build}
mkdir -p "$build" "$out"
${CC:-cc} -std=c11 -O3 -march=native -fopenmp -I. -Iexamples -Itests -Wall -Wextra -D_POSIX_C_SOURCE=200809L \
    bench/bench_stability.c -o "$build/bench_stability" -lcjson -lmetis -lm
exec "$build/bench_stability" "$out" "${@:-all}"
