#!/bin/sh
# The claims of paper A's figures on small meshes. tests/figures.sh BUILD
# Prints a line of numbers and `ok name` or `FAILED name` for each claim; exit code 1 if one failed.
# Reference: the full-space solver, or the adaptive one with one key changed (bench/bench_figures.c).
set -u
export OMP_WAIT_POLICY=passive
build=$1
cc=${CC:-cc}
bad=0
mkdir -p "$build"

# The sweeps of stencil descent grow as the square of the resolution, Newton's iterates do not.
$cc -std=c11 -O2 bench/bench_stencil.c -o "$build/bench_stencil" -lm || exit 1
if "$build/bench_stencil" 20 40 80 | awk -F, 'NR == 2 {n = $2; s = $3} END {exit !(NR == 4 && $2 <= n + 1 && $3 >= 10 * s)}'
then echo "ok      fig3: stencil descent needs more sweeps on finer meshes, Newton does not"
else echo "FAILED  fig3: stencil descent needs more sweeps on finer meshes, Newton does not"; bad=1; fi

$cc -std=c11 -O3 -march=native -fopenmp -I. -Iexamples -D_POSIX_C_SOURCE=200809L bench/bench_figures.c \
    -o "$build/bench_figures_small" -lcjson -lmetis -lm || { echo "FAILED  figures: bench_figures.c does not build"; exit 1; }
"$build/bench_figures_small" examples/scenes --small fig2 fig4 fig5 fig9 fig10 fig11 fig12 fig13 fig14 fig15 fig17 fig18 || bad=1
exit $bad
