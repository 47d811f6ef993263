#!/bin/sh
# Error against run time: bench/error.sh [-b BUILD] small|large OUT [NAME...]
# One `tss compare --sweep` a scene: small ones of some seconds (make report), large ones of 50,000
# tets and more, minutes each (make bench-error). A scene that OUT has already is left out, so a run
# that was stopped goes on where it was: OUT/NAME/ holds each scene's files, and
# OUT/error_vs_time.csv, OUT/error_steps.csv and the pictures are put together from those.
set -u
build=build
[ "${1:-}" != -b ] || { build=$2; shift 2; }
size=${1:-small}; out=${2:-out/report}; shift; [ $# -eq 0 ] || shift
names=${*:-jello spikes cone ramp cube beam roller boat city fist}
mkdir -p "$out"

# sweep NAME SCENE OPTION...: unless it is there.
sweep() {
    name=$1; scene=$2; shift 2
    [ ! -s "$out/$name/error_vs_time.csv" ] || { echo "$name: there already"; return 0; }
    echo "$name: $scene $*"
    "$build/tss" compare --sweep "examples/scenes/$scene.json" --name "$name" -o "$out/$name" "$@" \
        >"$out/$name.log" 2>"$out/$name.err"
    code=$?  # 3: some step of some solver did not converge; its row says so
    [ "$code" = 0 ] || [ "$code" = 3 ] || { tail -n 1 "$out/$name.err"; rm -rf "${out:?}/$name"; return 1; }
    tail -n +2 "$out/$name.log"
}

# NAME: scene, then the steps (the hard ones: in contact), then sizes small and large.
run() {
    n=$1; scene=$2; from=$3; steps=$4; small=$5; large=$6
    if [ "$size" = large ]; then sets=$large; grid="--repeat 2"
    else sets=$small; grid="--repeat 3"; fi
    # shellcheck disable=SC2086
    sweep "$n" "$scene" --from "$from" --steps "$steps" $grid $sets
}

scene() {
    b0='--set bodies.0.shape.cells'; b1='--set bodies.1.shape.cells'
    case $1 in
    jello) run jello jello_rubber 2 5 "$b0=[14,7,14] $b1=12" "" ;;
    spikes) run spikes fig2_spikes 3 5 "$b0=16" "$b0=32" ;;
    cone) run cone fig4_cone 2 5 "$b0=10" "$b0=20" ;;
    ramp) run ramp fig5_ramp 20 5 "$b0=[8,8,8]" "$b0=[22,22,22]" ;;
    # (off the axis: with a vertex right over the tip, which side it slips to is chance)
    cube) t="--set bodies.0.translate=[0.013,0.22,0.007]"
          run cube fig9_cube 2 5 "$b0=[11,11,11] $t" "$b0=[22,22,22] $t" ;;
    beam) run beam fig10_beam 3 5 "$b0=[50,5,5]" "$b0=[102,10,10]" ;;
    roller) run roller fig11_roller 3 5 "$b0=[16,3,8] $b1=14" "$b0=[40,8,20] $b1=20" ;;
    boat) run boat fig12_boat 2 5 "$b0=22" "$b0=46" ;;
    city) run city fig13_city 3 5 "$b0=14 $b1=12" "$b0=22 $b1=18" ;;
    fist) run fist fig15_fist 1 4 "$b0=9 $b1=9" "$b0=19 $b1=19" ;;
    *) echo "$1: no such scene" >&2; return 1 ;;
    esac
}

bad=0
for n in $names; do scene "$n" || bad=1; done
for csv in error_vs_time error_steps; do
    ls "$out"/*/"$csv".csv >/dev/null 2>&1 || continue
    { cat "$out"/*/"$csv".csv | grep '^#'
      cat "$out"/*/"$csv".csv | grep -m1 '^scene,'
      cat "$out"/*/"$csv".csv | grep -v -e '^#' -e '^scene,'; } >"$out/$csv.csv"
done
for f in "$out"/*/*_subspace.png "$out"/*/*_adaptive.png "$out"/*/*_enriched.png; do
    [ ! -f "$f" ] || cp "$f" "$out/"
done
exit $bad
