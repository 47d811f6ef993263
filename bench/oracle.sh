#!/bin/sh
# Both readings of the oracle side by side. bench/oracle.sh [BUILD [OUT]]
# A row a scene, reading and threshold: largest share of enriched nodes and active modes over the
# steps, mean Newton iterates. docs/oracle.md quotes it.
set -u
build=${1:-build}; out=${2:-out/oracle}
mkdir -p "$out"
printf '%-22s %-8s %6s %9s %6s %7s\n' scene reading eps_G enriched modes newton
row() {
    name=$1 reading=$2 eps=$3 scene=$4 steps=$5; shift 5
    dir=$out/$name-$reading-$eps
    "$build/tss" run "examples/scenes/$scene.json" --steps "$steps" --every 1000 -o "$dir" --mode adaptive \
        --set "solver.oracle=$reading" --set "solver.error_nodes=$eps" "$@" >"$dir.log" 2>&1 ||
        { tail -n 1 "$dir.log"; return; }
    awk -F, -v n="$name" -v r="$reading" -v e="$eps" '
        NR == 1 {for (i = 1; i <= NF; i++) c[$i] = i; next}
        {s = $c["enriched_nodes"] / $c["nodes"]; if (s > most) most = s
         if ($c["active_modes"] > m) m = $c["active_modes"]; k += $c["newton"]}
        END {printf "%-22s %-8s %6s %8.1f%% %6d %7.1f\n", n, r, e, 100 * most, m, k / (NR - 1)}' "$dir/stats.csv"
}
for reading in ring literal; do
    for eps in 0.5 0.1 0.01; do
        for E in 1e5 1e6 1e9; do
            row "jello_$E" $reading $eps fig14_jello 6 --set 'bodies.0.shape.cells=[16,8,16]' --set bodies.1.shape.cells=12 \
                --set "bodies.0.material.E=$E"
        done
        row ramp $reading $eps fig5_ramp 60 --set 'bodies.0.shape.cells=[6,6,6]'
        row cone $reading $eps fig4_cone 6 --set bodies.0.shape.cells=12
    done
done
