#!/bin/sh
# Speed against peers and reference figures. bench/run.sh BUILD OUT [PART...]
# Parts: scenes cholesky elastic broad contact. Needs the public test data beside the checkout (or at
# $TSS_DATA) for scenes and broad; cholesky's peer needs libsuitesparse-dev and libopenblas-dev.
set -u
build=$1; out=$2; shift 2
parts=${*:-scenes cholesky elastic broad contact}
data=${TSS_DATA:-../shared/data}
cc=${CC:-cc}
flags="-std=c11 -O3 -march=native -fopenmp -I. -Itests -D_POSIX_C_SOURCE=200809L"
mkdir -p "$build" "$out"

# Seconds a step of the IPC reference code (2 threads, CHOLMOD), measured on a machine of this kind.
scene() {  # name, steps, reference s a step, reference Newton iterates a step
    f="$data/ipc/scenes/$1.txt"
    [ -f "$f" ] || return 0
    "$build/tss" run "$f" --assets "$data/ipc" --steps "$2" --threads 2 -o "$out/scene_$1" >"$out/scene_$1.log" 2>&1
    awk -F, -v n="$1" -v ref="$3" -v rn="$4" 'NR > 1 {s += $15; k += $4; if ($15 > m) m = $15; c++; bad += $3 != "converged"}
        END {printf "%s,%d,%d,%.4f,%.4f,%.2f,%s,%s,%.1f\n", n, c, bad, s / c, m, k / c, ref, rn, ref / (s / c)}' \
        "$out/scene_$1/stats.csv"
}

scenes() {
    make -s "$build/tss"
    { echo "scene,steps,not converged,s a step,max,newton a step,reference s a step,reference newton,ratio"
      scene 2_matKnives 25 7.26 25.9
      scene 12_sphereOnMat 30 1.27 4.1
      scene 17_pinCushionBall 9 9.87 20.4
      scene 4_rodsTwist 5 10.3 3.0
    } | tee "$out/scenes.csv"
}

cholesky() {
    # shellcheck disable=SC2086
    $cc $flags bench/bench_cholesky.c -o "$build/bench_cholesky" -lmetis -lm || return 1
    p=$(ls -d /usr/lib/*/openblas-pthread 2>/dev/null | head -1)
    peer=-
    if $cc -O2 bench/peer_cholmod.c -o "$build/peer_cholmod" -lcholmod ${p:+-L$p -Wl,-rpath,$p} -lopenblas 2>/dev/null
    then peer="env ${p:+LD_LIBRARY_PATH=$p} OPENBLAS_NUM_THREADS=2 OMP_NUM_THREADS=2 $build/peer_cholmod"; fi
    # 17 → 5,832 nodes, 36 → 50,653, 52 → 148,877 (9 GB: BENCH_LARGE=1)
    # shellcheck disable=SC2086
    "$build/bench_cholesky" "$peer" "$out/matrix.bin" 3 2 17 36 ${BENCH_LARGE:+52} | tee "$out/cholesky.csv"
    rm -f "$out/matrix.bin"
}

elastic() {
    # shellcheck disable=SC2086
    $cc $flags bench/bench_elastic.c -o "$build/bench_elastic" -lmetis -lm || return 1
    for t in 1 2; do "$build/bench_elastic" $t 24; done | tee "$out/elastic.csv"
}

broad() {
    [ -d "$data/broad_phase" ] || return 0
    # shellcheck disable=SC2086
    $cc $flags bench/bench_broad.c -o "$build/bench_broad" -lmetis -lm || return 1
    "$build/bench_broad" "$data/broad_phase/cloth_ball92.ply" "$data/broad_phase/cloth_ball93.ply" | tee "$out/broad.csv"
}

contact() {
    for b in bench_ipcmath bench_ipcenergy; do
        # shellcheck disable=SC2086
        $cc $flags bench/$b.c -o "$build/$b" -lmetis -lm || return 1
    done
    [ -d "$data/broad_phase" ] || return 0
    "$build/bench_ipcmath" "$data/broad_phase/cloth_ball92.ply" 2>&1 | tee "$out/contact.csv"
    "$build/bench_ipcenergy" "$data/broad_phase/cloth_ball92.ply" "$data/broad_phase/cloth_ball93.ply" 2>&1 | tee "$out/contact_hook.csv"
}

for p in $parts; do echo "== $p" >&2; $p; done
