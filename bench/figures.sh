#!/bin/sh
# The claims of paper A's figures, measured. bench/figures.sh [-b BUILD] [-o OUT] [NAME...]
# Names: fig2 fig3 fig4 fig5 fig9 fig10 fig11 fig12 fig13 fig14 fig15 fig17 fig18 pile; none: all but
# fig15 and fig18, which take minutes. Each prints `NAME key value ...`. With --pictures also
# OUT/NAME.png. Scenes: examples/scenes/; larger meshes by `build/tss run SCENE --set KEY=VALUE`.
set -u
build=build; out=out/figures; pictures=0
while [ $# -gt 0 ]; do
    case $1 in
    -b) build=$2; shift 2 ;;
    -o) out=$2; shift 2 ;;
    --pictures) pictures=1; shift ;;
    *) break ;;
    esac
done
names=${*:-fig2 fig3 fig4 fig5 fig9 fig10 fig11 fig12 fig13 fig14 fig17 pile}
cc=${CC:-cc}
flags="-std=c11 -O3 -march=native -fopenmp -I. -Iexamples -D_POSIX_C_SOURCE=200809L"
mkdir -p "$build" "$out"

program() {
    [ "$build/bench_figures" -nt bench/bench_figures.c ] && [ "$build/bench_figures" -nt tss_subspace.h ] &&
        [ "$build/bench_figures" -nt tss.h ] && [ "$build/bench_figures" -nt tss_ipc.h ] && return 0
    # shellcheck disable=SC2086
    $cc $flags bench/bench_figures.c -o "$build/bench_figures" -lcjson -lmetis -lm
}

fig3() {
    $cc -std=c11 -O2 bench/bench_stencil.c -o "$build/bench_stencil" -lm && "$build/bench_stencil" |
        awk -F, 'NR > 1 {print "fig3 cells " $1 " newton " $2 " stencil_sweeps " $3}'
}

# picture NAME SCENE STEP OPTION...: the frame of one step.
picture() {
    n=$1 s=$2 k=$3; shift 3
    make -s "$build/tss"
    "$build/tss" run "examples/scenes/$s.json" --steps "$k" --every "$k" --frames png -o "$out/run_$n" "$@" \
        >"$out/$n.log" 2>&1
    cp "$out/run_$n/frames/$(printf %04d "$k").png" "$out/$n.png"
}

draw() {
    case $1 in
    fig2) picture fig2 fig2_spikes 12 --set bodies.0.shape.cells=20 --set "frames.size=[480,400]" ;;
    fig4)
        picture fig4 fig4_cone 7 --color error --set camera.elevation=-25 --set "frames.size=[480,400]"
        picture fig4_progress fig4_cone 7 --color progress --set camera.elevation=-25 --set "frames.size=[480,400]" ;;
    fig5) picture fig5 fig5_ramp 60 --set "frames.size=[480,320]" --set "camera.target=[0.55,-0.1,0]" --set camera.distance=2.2 ;;
    fig9) picture fig9 fig9_cube 8 ;;
    fig10) picture fig10 fig10_beam 8 ;;
    fig11) picture fig11 fig11_roller 9 --set "frames.size=[600,400]" ;;
    fig12) picture fig12 fig12_boat 8 --set "frames.size=[480,480]" ;;
    fig13) picture fig13 fig13_city 8 --set bodies.0.shape.cells=18 --set "frames.size=[600,400]" ;;
    fig14) picture fig14 fig14_jello 22 --set bodies.0.material.E=1e5 --set 'bodies.0.shape.cells=[16,8,16]' --set "frames.size=[600,400]" ;;
    fig15) picture fig15 fig15_fist 5 --set "frames.size=[600,400]" ;;
    fig17) picture fig17 fig10_beam 8 --set 'bodies.0.basis={"kind": "eigen", "count": 48, "initial": -1}' ;;
    fig18) picture fig18 fig18_koosh 11 ;;
    pile) picture pile pile 8 --set "frames.size=[480,400]" --set camera.elevation=65 --set camera.distance=6 ;;
    esac
}

for f in $names; do
    case $f in
    fig3) fig3 ;;
    *) program && "$build/bench_figures" examples/scenes "$f" ;;
    esac
    [ "$pictures" = 0 ] || draw "$f"
done
