#!/bin/sh
# `tss compare --sweep` on a small scene: a line `ok` or `FAILED` a claim. tests/sweep.sh BUILD
build=$1; out=$build/sweep_out
rm -rf "$out"
claim() { if eval "$2"; then echo "ok $1"; else echo "FAILED $1"; fi; }
tss() { "$build/tss" compare --sweep examples/scenes/fig4_cone.json --set bodies.0.shape.cells=7 --name c -o "$out" "$@"; }

claim "sweep: runs" 'tss --from 2 --steps 3 --nodes 1,0.05 --modes 0.5,0.05 --tols 2e-3,2e-2 >"$build/sweep.log" 2>&1'
# value METHOD NODES MODES TOL COLUMN: of the one row with these tolerances
value() { awk -F, -v m="$1" -v n="$2" -v s="$3" -v t="$4" -v c="$5" '$2 == m && $3 == n && $4 == s && $5 == t {print $c; k++}
    END {if (k != 1) print "rows:" k + 0}' "$out/error_vs_time.csv"; }
less() { awk -v a="$1" -v b="$2" 'BEGIN {exit !(a + 0 == a && b + 0 == b && a < b)}'; }
claim "sweep: the header is the documented one" \
    'grep -qx "scene,method,error_nodes,error_modes,tol,seconds,error_max,error_mean,error_final,residual,enriched_share,modes_share" "$out/error_vs_time.csv"'
claim "sweep: a row a step and solver" '[ "$(grep -c "^c," "$out/error_steps.csv")" = $((3 * $(grep -c "^c," "$out/error_vs_time.csv"))) ]'
claim "sweep: 14 solvers and tolerances" '[ "$(grep -c "^c," "$out/error_vs_time.csv")" = 14 ]'
claim "sweep: lower error_nodes, less error" 'less "$(value adaptive 0.05 0.5 0.002 7)" "$(value adaptive 1 0.5 0.002 7)"'
claim "sweep: nodes help the modes" 'less "$(value adaptive 1 0.5 0.002 7)" "$(value subspace "" "" 0.002 7)"'
claim "sweep: full space is closest to the tight solution" 'less "$(value direct "" "" 0.002 7)" "$(value adaptive 0.05 0.5 0.002 7)"'
claim "sweep: a lower tol of full space, less error" 'less "$(value pcg "" "" 0.002 7)" "$(value pcg "" "" 0.02 7)"'
claim "sweep: the same at the end of the free steps" 'less "$(value direct "" "" 0.002 9)" "$(value subspace "" "" 0.002 9)"'
claim "sweep: pictures and a page" '[ -s "$out/c_subspace.png" ] && [ -s "$out/c_adaptive.png" ] && [ -s "$out/c_enriched.png" ] && [ -s "$out/report.html" ]'
for bad in "--nodes 1,,2" "--nodes -1" "--modes x" "--tols 0" "--nodes 1,2,"; do
    # shellcheck disable=SC2086
    claim "sweep: refused: $bad" 'tss $bad >"$build/sweep_bad.log" 2>&1; [ $? = 2 ] && grep -q -e "${bad%% *} .*expected" "$build/sweep_bad.log"'
done
