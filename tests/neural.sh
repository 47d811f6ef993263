#!/bin/sh
# `tss neural` on a bar of 80 tets: a line `ok` or `FAILED` a claim. tests/neural.sh BUILD
export OMP_WAIT_POLICY=passive  # the slices of seconds below are for work, also on a shared machine
build=$1; out=$build/neural_out; scene=examples/scenes/neural_twist_bar_small.json
rm -rf "$out"
claim() { if eval "$2"; then echo "ok $1"; else echo "FAILED $1"; fi; }
tiny="--set bodies.0.shape.cells=[4,2,2] --set neural.r=4 --set neural.hidden=[16] --set neural.script.length=20
    --set neural.script.hold=[5,10] --set neural.script.train=6 --set neural.script.test=1 --set neural.script.stride=1 --set neural.train.steps=400
    --set neural.lipschitz.steps=200 --set neural.lipschitz.cubature=20 --set neural.samples=8 --set frames.size=[160,96]"
# shellcheck disable=SC2086
tss() { action=$1; to=$2; shift 2; "$build/tss" neural "$action" $scene $tiny -o "$to" "$@"; }
# value METHOD COLUMN of evaluate.csv, by the column's name
value() { awk -F, -v m="$1" -v c="$2" '/^system,/ {for (i = 1; i <= NF; i++) if ($i == c) k = i} $2 == m {print $k}' "$out/a/evaluate.csv"; }
# near A B D: within a share D of each other
near() { awk -v a="$1" -v b="$2" -v d="$3" 'BEGIN {exit !(a > 0 && a < (1 + d) * b && b < (1 + d) * a)}'; }
less() { awk -v a="$1" -v b="$2" 'BEGIN {exit !(a + 0 == a && b + 0 == b && a < b)}'; }

claim "neural: trains" 'tss train "$out/a" >"$build/neural.log" 2>&1'
claim "neural: evaluates" 'tss evaluate "$out/a" >>"$build/neural.log" 2>&1'
# The errors against what frames.bin has are those against full space run again, and full space has no row.
claim "neural: evaluates without full space" 'e=$(value lipschitz simulation_error); tss evaluate "$out/a" --no-full >>"$build/neural.log" 2>&1 &&
    [ "$(value lipschitz simulation_error)" = "$e
$e" ] && [ "$(grep -c ",full," "$out/a/evaluate.csv")" = 1 ] && sed -i "7,\$d" "$out/a/evaluate.csv"'
# The same minima by the paper's solver, whose exits are of another kind, in more evaluations.
claim "neural: BFGS takes fewer evaluations than L-BFGS for the same states" 'n=$(value vanilla evaluations) e=$(value vanilla energy) sim=$(value vanilla simulation_error)
    tss evaluate "$out/a" --no-full --set neural.solver.kind=lbfgs >>"$build/neural.log" 2>&1 && last() { value vanilla "$1" | tail -n 1; } && less "$n" "$(last evaluations)" &&
    near "$e" "$(last energy)" 1e-3 && near "$sim" "$(last simulation_error)" 1e-2 && [ "$(last solver)" = lbfgs ] && sed -i "7,\$d" "$out/a/evaluate.csv"'
claim "neural: the first steps of the tests" 'tss evaluate "$out/a" --no-full --steps 3 >>"$build/neural.log" 2>&1 &&
    sed -n 7p "$out/a/evaluate.csv" | grep -q "test steps 3," && sed -i "7,\$d" "$out/a/evaluate.csv"'
claim "neural: refused: --no-full elsewhere" '! tss run "$out/a" --no-full 2>"$build/neural_bad.log" && grep -q "no-full.*evaluate" "$build/neural_bad.log"'
claim "neural: runs" 'tss run "$out/a" >>"$build/neural.log" 2>&1'
claim "neural: the header is the documented one" \
    'grep -q "^system,method,seed,dof,elements,r,step_ms,iterations,evaluations,exit_converged,exit_saddle,exit_line,exit_iterations,gradient,lip,projection_error,simulation_error,train_seconds" "$out/a/evaluate.csv"'
claim "neural: the machine is named" 'head -1 "$out/a/evaluate.csv" | grep -q "^# .*, threads "'
claim "neural: a row a method" '[ "$(grep -c "^neural_twist_bar_small," "$out/a/evaluate.csv")" = 4 ]'
claim "neural: L_LS lowers Eq. 7" 'less "$(value lipschitz lip)" "$(value vanilla lip)"'
# errors METHOD PERCENT COLUMN
errors() { awk -F, -v m="$1" -v p="$2" -v c="$3" '/^system,/ {for (i = 1; i <= NF; i++) if ($i == c) k = i} $2 == m && $4 == p {print $k; exit}' "$out/a/errors.csv"; }
claim "neural: distributions: the farthest node of evaluate.csv is the last decile" '[ "$(errors lipschitz 100 simulation_farthest)" = "$(value lipschitz simulation_max)" ] &&
    [ "$(errors vanilla 100 projection_farthest)" = "$(value vanilla projection_max)" ] && less "$(errors linear 0 simulation)" "$(value linear simulation_error)" &&
    less "$(value linear simulation_error)" "$(errors linear 100 simulation)"'
claim "neural: full space is its own reference" '[ "$(value full simulation_error)" = 0 ]'
claim "neural: a row a step and method" '[ "$(grep -c "^0," "$out/a/steps_0.csv")" = 80 ]'
claim "neural: pictures and a page" '[ -s "$out/a/states_0.png" ] && [ -s "$out/a/report.html" ]'
# Stopped again and again it ends in the same bits.
claim "neural: stops when its time is up" 'tss train "$out/b" --minutes 0.002 >"$build/neural_b.log" 2>&1; [ $? = 3 ] && grep -q "out of --minutes" "$build/neural_b.log"'
claim "neural: goes on where it stopped" \
    'k=0; while ! tss train "$out/b" --minutes 0.01 >/dev/null 2>&1 && [ $k -lt 200 ]; do k=$((k + 1)); done; [ $k -lt 200 ]'
for f in frames.bin base_0.tssn vanilla_0.tssn lipschitz_0.tssn; do
    claim "neural: the same bits after stops: $f" 'cmp -s "$out/a/$f" "$out/b/$f"'
done
# pca.scale: at the start a decoder of one unit for all modes is far rougher.
lip() { awk -F, '$1 == "base" {print $6; exit}' "$out/$1/train_0.csv"; }
claim "neural: modes in units of their own" 'tss train "$out/scaled" --set neural.pca.scale=true --method vanilla >"$build/neural_scaled.log" 2>&1 &&
    less "$(lip scaled)" "$(lip a)"'
# (1e-3 below: sums over steps that each end at a gradient of 1e-7)
# train.start linear: a decoder that has not been trained is the linear subspace, which tss_reduced has without a network.
still="--set neural.train.start=linear --set neural.pca.scale=true --set neural.train.steps=1 --set neural.train.rate=1e-12 --set neural.train.rate_end=1e-12
    --set neural.lipschitz.steps=1 --set neural.lipschitz.rate=1e-12 --set neural.lipschitz.rate_end=1e-12 --set neural.solver.kind=lbfgs --set neural.solver.ftol=0 --set neural.solver.eps=1e-7"
of() { awk -F, -v m="$1" -v c="$2" '/^system,/ {for (i = 1; i <= NF; i++) if ($i == c) k = i} $2 == m {print $k}' "$out/l/evaluate.csv"; }
# shellcheck disable=SC2086
claim "neural: networks begin as the linear subspace" 'tss train "$out/l" $still >"$build/neural_l.log" 2>&1 && tss evaluate "$out/l" $still --no-full >>"$build/neural_l.log" 2>&1 &&
    near "$(of vanilla projection_error)" "$(of linear projection_error)" 1e-4 && near "$(of vanilla simulation_error)" "$(of linear simulation_error)" 1e-3 &&
    near "$(of vanilla energy)" "$(of linear energy)" 1e-4'
# Other coordinates, by the Hessians where the solver ends: the same states in fewer evaluations.
of2() { awk -F, -v m="$1" -v c="$2" '/^system,/ {for (i = 1; i <= NF; i++) if ($i == c) k = i} $2 == m {print $k}' "$out/m/evaluate.csv"; }
# shellcheck disable=SC2086
claim "neural: whitened where the solver ends" 'solver="$still --set neural.lipschitz.whiten=true --set neural.lipschitz.whiten_at=solver"
    tss train "$out/m" $solver >"$build/neural_m.log" 2>&1 && tss evaluate "$out/m" $solver --no-full >>"$build/neural_m.log" 2>&1 &&
    grep -q "^whitening: 18 states of the solver" "$build/neural_m.log" && less "$(of2 lipschitz evaluations)" "$(of2 vanilla evaluations)" &&
    near "$(of2 lipschitz simulation_error)" "$(of2 vanilla simulation_error)" 1e-3 && near "$(of2 lipschitz projection_error)" "$(of2 vanilla projection_error)" 1e-4'
# shellcheck disable=SC2086
claim "neural: whitened at the end" 'solver="$still --set neural.lipschitz.whiten=true --set neural.lipschitz.whiten_end=true --set neural.lipschitz.unit=1"; rm "$out/m/evaluate.csv" "$out/m/lipschitz_0.tssn"
    tss train "$out/m" $solver >"$build/neural_m.log" 2>&1 && tss evaluate "$out/m" $solver --no-full >>"$build/neural_m.log" 2>&1 &&
    grep -q "^whitened at the end: 200 states" "$build/neural_m.log" && less "$(of2 lipschitz evaluations)" "$(of2 vanilla evaluations)" &&
    near "$(of2 lipschitz simulation_error)" "$(of2 vanilla simulation_error)" 1e-3 && near "$(of2 lipschitz projection_error)" "$(of2 vanilla projection_error)" 1e-4'
# A unit of z: |∇E| and E's Hessian per unit change, no state does; Lip is per unit cubed.
share() { awk -v a="$1" -v b="$2" -v q="$3" 'BEGIN {exit !(a > 0 && b > 0 && a / b > q * (1 - 1e-3) && a / b < q * (1 + 1e-3))}'; }
# shellcheck disable=SC2086
claim "neural: the unit of z" 'lip=$(of2 lipschitz lip) spread=$(of2 lipschitz z_scale) sim=$(of2 lipschitz simulation_error); rm "$out/m/evaluate.csv" "$out/m/lipschitz_0.tssn"
    solver="$still --set neural.lipschitz.whiten=true --set neural.lipschitz.whiten_end=true --set neural.lipschitz.unit=0.01"
    tss train "$out/m" $solver >"$build/neural_m.log" 2>&1 && tss evaluate "$out/m" $solver --no-full >>"$build/neural_m.log" 2>&1 &&
    share "$lip" "$(of2 lipschitz lip)" 1000 && share "$spread" "$(of2 lipschitz z_scale)" 0.1 && near "$(of2 lipschitz simulation_error)" "$sim" 1e-3'
# shellcheck disable=SC2086
claim "neural: vanilla in another unit" 'lip=$(of2 vanilla lip) spread=$(of2 vanilla z_scale) sim=$(of2 vanilla simulation_error) lin=$(of2 linear simulation_error); rm "$out/m/evaluate.csv"
    tss evaluate "$out/m" $solver --no-full --set neural.solver.stretch=10 >"$build/neural_m.log" 2>&1 && share "$lip" "$(of2 vanilla lip)" 1000 &&
    share "$spread" "$(of2 vanilla z_scale)" 0.1 && near "$(of2 vanilla simulation_error)" "$sim" 1e-3 && near "$(of2 linear simulation_error)" "$lin" 1e-3'
# shellcheck disable=SC2086
claim "neural: refused: longer than its end" '! tss train "$out/m" $solver --set neural.lipschitz.steps=100000 >"$build/neural_bad.log" 2>&1 && grep -q "lipschitz_0.tssn: ended after .* or no such file" "$build/neural_bad.log"'
claim "neural: unsupervised" '"$build/tss" neural train examples/scenes/neural_bistable.json -o "$out/c" --set bodies.0.shape.cells=[8,2] \
    --set neural.script.length=20 --set neural.train.steps=200 --set neural.lipschitz.steps=50 >"$build/neural_c.log" 2>&1 &&
    "$build/tss" neural evaluate examples/scenes/neural_bistable.json -o "$out/c" --set bodies.0.shape.cells=[8,2] \
    --set neural.script.length=20 --set neural.train.steps=200 --set neural.lipschitz.steps=50 >>"$build/neural_c.log" 2>&1'
# On this strip the nearest state from where another test has ended is not the nearest from z = 0.
second() {
    "$build/tss" neural run examples/scenes/neural_bistable.json -o "$out/c" --steps "$1" --set bodies.0.shape.cells=[8,2] --set neural.script.length=20 \
        --set neural.train.steps=200 --set neural.lipschitz.steps=50 >>"$build/neural_c.log" 2>&1 && grep "^1," "$out/c/steps_0.csv" | head -n 6 | cut -d, -f1-3,5-
}
claim "neural: a test begins at the same state however long the one before was" 'a=$(second 2) && b=$(second 5) && [ "$(echo "$a" | wc -l)" = 6 ] && [ "$a" = "$b" ]'
# refused WORDS ARGUMENTS: exit 2 and these words
refused() { words=$1; shift; tss "$@" >"$build/neural_bad.log" 2>&1; [ $? = 2 ] && grep -q -e "$words" "$build/neural_bad.log"; }
claim "neural: measures" 'tss measure "$out/a" --threads 1 >>"$build/neural.log" 2>&1 && grep -q "^neural_twist_bar_small,0,135,80,4,20,20," "$out/a/measure.csv"'
claim "neural: a cubature at run time" 'tss evaluate "$out/a" --set neural.solver.cubature=20 >>"$build/neural.log" 2>&1 &&
    [ "$(awk -F, "\$2 == \"lipschitz\" {c = \$(NF - 1)} END {print c}" "$out/a/evaluate.csv")" = 20 ]'
# bridge BASIS ORACLE COLUMN of bridge.csv; 7 bases with and without the oracle, 3 manifolds, full space
bridge() { awk -F, -v b="$1" -v o="$2" -v c="$3" '/^system,/ {for (i = 1; i <= NF; i++) if ($i == c) k = i} $2 == b && $5 == o {print $k}' "$out/a/bridge.csv"; }
claim "neural: bridge" 'tss bridge "$out/a" --threads 1 >>"$build/neural.log" 2>&1 && [ "$(grep -c "^neural_twist_bar_small," "$out/a/bridge.csv")" = 18 ]'
claim "neural: bridge: the header is the documented one" 'grep -q "^system,basis,seed,r,oracle,step_ms,iterates,added,enriched,nodes,refresh_ms,failed,simulation_error,simulation_max,start_error," "$out/a/bridge.csv"'
claim "neural: bridge: a linear basis is the reduced solver's subspace" 'less "$(bridge linear off simulation_error)" 1 &&
    awk -v a="$(bridge linear off simulation_error)" -v b="$(bridge linear manifold simulation_error)" "BEGIN {exit !(a > 0 && a < 1.1 * b && b < 1.1 * a)}"'
claim "neural: bridge: r is rounded up to blocks of 12 skinning modes" '[ "$(bridge skinning off r)" = 12 ] && [ "$(bridge eigen off r)" = 4 ]'
claim "neural: bridge: no nodes without the oracle, and with it less error" '[ "$(bridge vanilla off enriched)" = 0 ] && less 0 "$(bridge vanilla on added)" &&
    less "$(bridge vanilla on simulation_error)" "$(bridge vanilla off simulation_error)"'
claim "neural: bridge: everything converges" '[ "$(for b in vanilla vanilla_retracted lipschitz linear eigen skinning; do bridge $b off failed; bridge $b on failed; done | sort -u)" = 0 ]'
# cloth ACTION OPTION...
cloth() {
    action=$1; shift
    "$build/tss" neural "$action" examples/scenes/neural_cloth_small.json -o "$out/d" --set bodies.0.shape.cells=[6,1,6] \
        --set neural.script.length=15 --set neural.script.test=1 --set neural.script.hold=[5,8] --set neural.train.steps=60 \
        --set neural.lipschitz.steps=20 --set neural.lipschitz.cubature=20 --set neural.samples=8 --set frames.size=[160,96] "$@" >"$build/neural_d.log" 2>&1
}
claim "neural: cloth and a ball" 'cloth train && cloth evaluate && cloth run && [ -s "$out/d/states_0.png" ]'
claim "neural: cloth: full space converges" '[ "$(awk -F, "\$2 == \"full\" {print \$10, \$13}" "$out/d/evaluate.csv")" = "15 0" ]'
# of4 COLUMN of the Lipschitz row of a cloth trained with such a unit
of4() { awk -F, -v c="$1" '/^system,/ {for (i = 1; i <= NF; i++) if ($i == c) k = i} $2 == "lipschitz" {print $k}' "$out/d/evaluate.csv"; }
again() { rm "$out/d/evaluate.csv" "$out/d/lipschitz_0.tssn"; cloth train --set neural.lipschitz.unit="$1" && cloth evaluate --no-full --set neural.lipschitz.unit="$1"; }
claim "neural: the unit of z without an encoder" 'again 1 && lip=$(of4 lip) spread=$(of4 z_scale) && again 0.01 && share "$lip" "$(of4 lip)" 1000 && share "$spread" "$(of4 z_scale)" 0.1'
claim "neural: vanilla in another unit, without an encoder" 'of4v() { awk -F, -v c="$1" "/^system,/ {for (i = 1; i <= NF; i++) if (\$i == c) k = i} \$2 == \"vanilla\" {print \$k}" "$out/d/evaluate.csv"; }
    lip=$(of4v lip); rm "$out/d/evaluate.csv"; cloth evaluate --no-full --set neural.lipschitz.unit=0.01 --set neural.solver.stretch=10 && share "$lip" "$(of4v lip)" 1000'
claim "neural: refused: the bridge of a shell" '! cloth bridge && grep -q "bridge: bodies\[0\].shell: expected a body of tetrahedra" "$build/neural_d.log"'
bad_cloth() { words=$1; shift; cloth train "$@"; [ $? = 2 ] && grep -q -e "$words" "$build/neural_d.log"; }
claim "neural: refused: a shell of tets" 'bad_cloth "expected a soft surface of triangles" --set bodies.0.shape.kind=box --set bodies.0.shape.upper=[1,1,1]'
claim "neural: refused: a unit without whitening" 'bad_cloth "unit is 0.5, expected 1 without whiten" --set neural.lipschitz.whiten=false --set neural.lipschitz.unit=0.5'
claim "neural: refused: a ball without a radius" 'bad_cloth "radius" --set neural.script.ball.radius=0'
claim "neural: refused: a ball that meets no shell" 'refused "expected a first body with \"shell\"" train "$out/a" --set neural.script.ball.radius=1 --set neural.script.ball.stiffness=1'
claim "neural: refused: another action" 'refused "expected train, run, evaluate, measure or bridge" walk "$out/a"'
claim "neural: refused: a key" 'refused "neural.lipschitz.weigth: no such key; did you mean \"weight\"" train "$out/a" --set neural.lipschitz.weigth=1'
claim "neural: refused: a value" 'refused "neural.r is 0, expected a whole number" train "$out/a" --set neural.r=0'
claim "neural: refused: too narrow to begin linear" 'refused "neural.hidden\[0\] is 3, expected at least neural.r (4)" train "$out/a" --set neural.train.start=linear --set neural.hidden=[3]'
claim "neural: refused: low above high" 'refused "low <= high" train "$out/a" --set "neural.script.handles.0.rotate=[[1,0,0],[0,0,0]]"'
claim "neural: refused: contact" 'refused "contact.enabled is true, expected false" train "$out/a" --set contact.enabled=true'
claim "neural: refused: an integrator" 'refused "expected \"quasistatic\" or \"euler\"" train "$out/a" --set world.integrator=bdf2'
claim "neural: refused: frames of another script" 'refused "frames of another scene" train "$out/a" --set neural.script.seed=2'
claim "neural: refused: another network" 'refused "a network of another scene" evaluate "$out/a" --set neural.hidden=[17]'
claim "neural: what is not trained is said before anything is made" 'rm -rf "$out/e"; refused "tss neural train .* -o $out/e --seed 3" evaluate "$out/e" --seed 3 && [ ! -e "$out/e/frames.bin" ]'
claim "neural: refused: a bridge from nothing" 'refused "tss neural train" bridge "$out/a" --seed 7'
claim "neural: refused: not trained" 'refused "tss neural train" evaluate "$out/a" --seed 7'
