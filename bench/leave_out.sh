#!/bin/sh
# What a feature costs that a scene does not use. bench/leave_out.sh BUILD OUT → OUT/leave_out.csv
# Each row: the library's object code (text, -O2) with everything and with the feature left out; the
# memory a small world holds, and the instructions of three of its steps (callgrind, one thread), in
# the full build with the feature absent at run time and in a build without it. Both builds must end
# in the same state, bit for bit, and no ratio may pass 1.02: else a line FAILED, and the exit says so.
# Features without a switch are left out by hand (sed on a copy of the headers), or compared with
# what the note says; they save no object code. OUT/leave_out_sizes.csv: object code by header and
# option. Needs valgrind; takes four minutes, and goes on where it was stopped.
set -u
build=$1; out=$2
cc=${CC:-cc}
flags="-std=c11 -O2 -DTSS_NO_OPENMP"
most=1.02
dir=$build/leave_out
for f in tss*.h bench/bench_leave_out.c bench/leave_out.sh; do [ "$dir/stamp" -nt "$f" ] || rm -rf "$dir"; done
mkdir -p "$dir" "$out"
[ -f "$dir/stamp" ] || touch "$dir/stamp"
command -v valgrind >/dev/null 2>&1 || { echo "leave_out: needs valgrind"; exit 1; }
export OMP_NUM_THREADS=1

# built NAME HEADERS FLAGS: the object of the headers alone, and the program with it.
built() {
    { [ -x "$dir/$1" ] || { [ -s "$dir/$1.o" ] && [ "${1#only_}" != "$1" ]; }; } && return 0
    { echo '#define TSS_IMPLEMENTATION'; echo '#include "tss.h"'
      case "$3" in *WITHOUT_IPC*) ;; *) echo '#include "tss_ipc.h"';; esac
      case "$3" in *WITHOUT_SUBSPACE*) ;; *) echo '#include "tss_subspace.h"';; esac; } >"$dir/$1.c"
    # shellcheck disable=SC2086
    $cc $flags $3 -I"$2" -c "$dir/$1.c" -o "$dir/$1.o" || return 1
    case $1 in only_*) return 0;; esac
    # shellcheck disable=SC2086
    $cc $flags $3 -I"$2" bench/bench_leave_out.c "$dir/$1.o" -o "$dir/$1" -lmetis -lm
}

text() { size "$dir/$1.o" | awk 'NR == 2 {print $1}'; }

# steps PROGRAM SCENE: `hash memory instructions`.
steps() {
    [ -s "$dir/$1.$2" ] && { cat "$dir/$1.$2"; return; }
    valgrind --tool=callgrind --toggle-collect=measured_steps --callgrind-out-file=/dev/null \
        "$dir/$1" "$2" >"$dir/$1.$2.out" 2>"$dir/$1.$2.err" &&
        echo "$(cat "$dir/$1.$2.out") $(sed -n 's/.*Collected : \([0-9]*\).*/\1/p' "$dir/$1.$2.err")" >"$dir/$1.$2"
    cat "$dir/$1.$2"
}

failed=0
# row FEATURE SCENE PROGRAM SCENE2 NOTE: the full build at SCENE against PROGRAM at SCENE2.
row() {
    object=$3; case $5 in "no switch"*) object=full;; esac
    # shellcheck disable=SC2046
    set -- "$1" "$(text full)" "$(text $object)" "$5" $(steps full "$2") $(steps "$3" "$4")
    [ $# = 10 ] || { echo "FAILED $1: a build or a run broke"; failed=1; return; }
    awk -v f="$1" -v o="$2" -v p="$3" -v note="$4" -v m="$6" -v i="$7" -v n="$9" -v j="${10}" \
        'BEGIN {printf "%s,%d,%d,%d,%d,%d,%d,%.4f,%s\n", f, o, p, m, n, i, j, i / j, note}' >>"$csv"
    [ "$5" = "$8" ] || { echo "FAILED $1: states differ: $5 $8"; failed=1; }
    awk -v i="$7" -v j="${10}" -v most=$most 'BEGIN {exit !(i <= most * j)}' || { echo "FAILED $1: more than $most"; failed=1; }
}

# A copy of the headers without what has no switch: a sed script for each header.
without() {
    mkdir -p "$dir/$1.h"; cp tss*.h "$dir/$1.h"
    sed -i "$3" "$dir/$1.h/$2"
    if cmp -s "$2" "$dir/$1.h/$2"; then  # without a program the row below fails
        echo "FAILED $1: the header has changed, nothing was left out"; rm -f "$dir/$1"; return 1
    fi
    built "$1" "$dir/$1.h" ""
}

all="-DTSS_NO_MATERIALS -DTSS_NO_DAMPING -DTSS_NO_THIN -DTSS_NO_FRICTION -DTSS_NO_EIGEN"
built full . "" & built no_2d . -DTSS_NO_2D; wait
built no_3d . -DTSS_NO_3D & built no_materials . -DTSS_NO_MATERIALS; wait
built no_damping . -DTSS_NO_DAMPING & built no_thin . -DTSS_NO_THIN; wait
built no_friction . -DTSS_NO_FRICTION & built no_eigen . -DTSS_NO_EIGEN; wait
built no_ipc . "-DWITHOUT_IPC" & built no_subspace . -DWITHOUT_SUBSPACE; wait
built all_3d . "-DTSS_NO_2D $all" & built all_2d . "-DTSS_NO_3D $all"; wait
without one_material tss.h 's/e->per_cell ? b : 0/0/; s/e->per_cell ? t->copy\[1[01]\] : //; s/if (e->per_cell) t->copy/if (0) t->copy/' &
without scripted tss.h '/^static int tss__find_moving/,/^}/ s/int any = 0, changed = 0;/int any = 0, changed = 0; return 0;/'; wait
without candidates tss_subspace.h '/^static tss_result tss__sub_mode_errors/,/^}/ s/int \*open) {/int *open) { (void)s, (void)it, (void)open; return TSS_OK;/' &
without enriched tss_subspace.h 's/^    if (s->xrows == 0)$/    if (1)/'; wait

csv=$out/leave_out.csv
echo "feature,object_bytes,object_bytes_without,memory_bytes,memory_bytes_without,instructions_absent,instructions_without,ratio,note" >"$csv"
row "contact" solid no_ipc solid "tss_ipc.h not included; a pinned block"
row "friction" contact no_friction contact "TSS_NO_FRICTION; two blocks and a plane with mu = 0"
row "self-contact" alone no_ipc alone "no switch: one block with self-contact off against tss_ipc.h not included. What is left is the gradient that chooses kappa"
row "subspace" bare no_subspace contact "tss_subspace.h not included; a subspace solver without any basis against none"
row "eigenbases" modes no_eigen modes "TSS_NO_EIGEN; quadratic bases"
row "modal candidates" modes candidates modes "no switch: the query of inactive modes cut out; all modes active"
row "enriched nodes" modes enriched modes "no switch: the coupled system cut out; nothing enriched"
row "oracle" modes full fixed "no switch: mode adaptive in which the oracle finds nothing to enrich against mode subspace which does not ask"
row "2D" contact no_2d contact "TSS_NO_2D; a scene in 3D"
row "3D" flat no_3d flat "TSS_NO_3D; a scene in 2D"
row "other materials" contact no_materials contact "TSS_NO_MATERIALS; Neo-Hookean alone"
row "damping" contact no_damping contact "TSS_NO_DAMPING"
row "membranes hinges springs" contact no_thin contact "TSS_NO_THIN"
row "materials by cell" contact one_material contact "no switch: the fetch by cell cut out; one material"
row "scripted nodes" contact scripted contact "no switch: the search for moving nodes cut out; none is scripted"
row "all of it in 3D" contact all_3d contact "TSS_NO_2D and all other switches"
row "all of it in 2D" flat all_2d flat "TSS_NO_3D and all other switches"
cat "$csv"

built only_core . "-DWITHOUT_IPC -DWITHOUT_SUBSPACE" & built only_no_simd . -DTSS_NO_SIMD; wait
built only_no_metis . -DTSS_NO_METIS & built only_no_lapack . -DTSS_NO_LAPACK; wait
flags="-std=c11 -O2 -fopenmp"
built only_openmp . "" & built only_no_openmp . -DTSS_NO_OPENMP; wait
sizes=$out/leave_out_sizes.csv
{ echo "headers,options,object_bytes"
  echo "tss.h,,$(text only_core)"
  echo "tss.h tss_ipc.h,,$(text no_subspace)"
  echo "tss.h tss_subspace.h,,$(text no_ipc)"
  echo "tss.h tss_ipc.h tss_subspace.h,,$(text full)"
  echo "tss.h tss_ipc.h tss_subspace.h,TSS_NO_METIS,$(text only_no_metis)"
  echo "tss.h tss_ipc.h tss_subspace.h,TSS_NO_SIMD,$(text only_no_simd)"
  echo "tss.h tss_ipc.h tss_subspace.h,TSS_NO_LAPACK,$(text only_no_lapack)"
  echo "tss.h tss_ipc.h tss_subspace.h,-fopenmp,$(text only_openmp)"
  echo "tss.h tss_ipc.h tss_subspace.h,-fopenmp TSS_NO_OPENMP,$(text only_no_openmp)"; } | tee "$sizes"
[ $failed = 0 ]
