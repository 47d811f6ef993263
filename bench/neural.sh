#!/bin/sh
# Neural subspaces (docs/neural.md): bench/neural.sh [-b BUILD] [-w WORK] [-m MINUTES] [-s SYSTEM]...
#                                                    [-n SEED]... [-r REPEAT] [-t STEPS] [-c CELLS]... [-F] [OUT] [PART...]
# Trains the scenes examples/scenes/neural_SYSTEM.json in WORK (build/neural_bench) and adds rows to
# OUT (bench/results). A part whose rows are in its CSV already is not run again, and training goes on
# where it stopped: call it until it ends with 0 (3: MINUTES are over; 1: something failed). For the large
# systems, whose steps take seconds: -t: of each test sequence only the first STEPS; -F: full space is what
# the frames have, not timed once more; -c: CELLS of part runtime (0, all, and those of the scene's training) and bfgs (0).
#   part     file                  system (unless -s)    paper B
#   methods  neural.csv            all small; also -s twist_bar, cloth, dinosaur, elephant, bunny   Table 1: vanilla, lipschitz, linear, full
#            neural_errors.csv     as neural.csv         deciles of the errors (also by the part errors, from trained models)
#   bfgs     neural_bfgs.csv       as neural.csv         none: the default solver, TSS_BFGS; all other parts take the paper's L-BFGS
#   newton   neural_newton.csv     all small             Table 4: projected Newton
#   eps      neural_eps.csv        twist, pulled, bist.  Table 2: eps 1e-4, 1e-5, 1e-6
#   order    neural_order.csv      twist, pulled         Table 3: L_LS of order 0, 1, 2
#   runtime  neural_runtime.csv    twist, pulled         Table 5: cubature at run time or not
#   cubature neural_cubature.csv   twist, pulled         Fig. 10: cells of the cubature
#   cost     neural_cost.csv       twist, pulled         Fig. 3: a step of training over r
#   r        neural_r.csv          pulled                Fig. 11: r
#   bridge   neural_bridge.csv     twist, pulled, dinosaur_small   none: tangents as bases of the adaptive simulator
# The weight of an order o is λ (Lip_2 / Lip_o)² with the scene's λ for order 2 and vanilla's Eq. 7:
# then λ Lip² is the same for all.
set -u
build=build work= minutes=600 systems= seeds= repeat=3 steps= cells= full=
while [ $# -gt 0 ]; do
    case $1 in
    -b) build=$2; shift 2 ;;
    -w) work=$2; shift 2 ;;
    -m) minutes=$2; shift 2 ;;
    -s) systems="$systems $2"; shift 2 ;;
    -n) seeds="$seeds $2"; shift 2 ;;
    -r) repeat=$2; shift 2 ;;
    -t) steps=$2; shift 2 ;;
    -c) cells="$cells $2"; shift 2 ;;
    -F) full=--no-full; shift ;;
    *) break ;;
    esac
done
work=${work:-$build/neural_bench}; out=${1:-bench/results}; [ $# -eq 0 ] || shift
parts=${*:-methods bfgs newton eps order runtime cubature cost r bridge}
seeds=${seeds:-0 1 2}
export OMP_NUM_THREADS=1
mkdir -p "$out" "$work" || exit 1
ends=$(($(date +%s) + minutes * 60)); bad=0

# left: minutes that remain; the script ends with 3 where there are none.
left() {
    seconds=$((ends - $(date +%s)))
    [ $seconds -gt 0 ] || { echo "neural: $minutes minutes are over; the same command goes on from here" >&2; exit 3; }
    awk -v s=$seconds 'BEGIN {print s / 60}'
}

# there FILE COLUMN=VALUE...: a row of OUT/FILE has all of these; numbers are compared as numbers. A VALUE that
# names a column is what that has.
there() {
    [ -s "$out/$1" ] || return 1
    file=$out/$1; shift
    awk -F, -v want="$*" '
        BEGIN {n = split(want, w, " ")}
        /^#/ {next}
        /^system,/ {for (i = 1; i <= NF; i++) at[$i] = i; next}
        {ok = 1
         for (k = 1; k <= n; k++) {split(w[k], p, "="); ok = ok && $(at[p[1]]) == (p[2] in at ? $(at[p[2]]) : p[2])}
         if (ok) {found = 1; exit}}
        END {exit !found}' "$file"
}

# cells_of C: what a row with solver.cubature C has as runtime_cells
cells_of() { [ "$1" = 0 ] && echo elements || echo "$1"; }

# value FILE METHOD COLUMN
value() { awk -F, -v m="$2" -v c="$3" '/^system,/ {for (i = 1; i <= NF; i++) if ($i == c) k = i} $2 == m {print $k}' "$1"; }

# add FROM FILE: comments that are new, then one header, then all rows.
add() {
    touch "$out/$2"
    { grep -h '^#' "$out/$2" "$1" | awk '!seen[$0]++'
      grep -h '^system,' "$1" | head -n 1
      grep -v -e '^#' -e '^system,' "$out/$2"
      grep -v -e '^#' -e '^system,' "$1"; } >"$out/$2.new" && mv "$out/$2.new" "$out/$2"
}

# tss ACTION SYSTEM DIR SEED OPTION...: the log is DIR/log. 3: out of time.
tss() {
    action=$1 system=$2 dir=$3 seed=$4; shift 4
    time=; [ "$action" != train ] || time="--minutes $(left)" || exit 3
    # shellcheck disable=SC2086
    "$build/tss" neural "$action" "examples/scenes/neural_$system.json" -o "$dir" --seed "$seed" --threads 1 --name "$system" \
        --set neural.solver.kind=lbfgs $time "$@" >>"$dir/log" 2>&1
    code=$?
    [ $code != 3 ] || exit 3
    [ $code = 0 ] || { echo "neural: $system $seed: $action: $(tail -n 1 "$dir/log")"; bad=1; return 1; }
}

# train SYSTEM SEED: in WORK/SYSTEM, of which trained takes copies.
train() {
    mkdir -p "$work/$1"; left >/dev/null || exit 3
    [ -f "$work/$1/.done_$2" ] || { echo "$1, seed $2: training"; tss train "$1" "$work/$1" "$2" && : >"$work/$1/.done_$2"; }
}

# variant SYSTEM SEED NAME WHAT OPTION...: WORK/NAME, trained with these options from the frames (and, WHAT =
# base, from both vanilla models) of WORK/SYSTEM.
variant() {
    system=$1 seed=$2 dir=$work/$3 what=$4; shift 4
    [ ! -f "$dir/.done_$seed" ] || return 0
    mkdir -p "$dir"
    [ -f "$dir/frames.bin" ] || cp "$work/$system/frames.bin" "$dir/"
    if [ "$what" = base ] && [ ! -f "$dir/train_$seed.csv" ]; then
        cp "$work/$system/base_$seed.tssn" "$work/$system/vanilla_$seed.tssn" "$dir/"
        grep -v '^lipschitz,' "$work/$system/train_$seed.csv" >"$dir/train_$seed.csv"
    fi
    echo "$system, seed $seed: training with $*"
    tss train "$system" "$dir" "$seed" "$@" && : >"$dir/.done_$seed"
}

# rows ACTION FILE SYSTEM DIR SEED OPTION...: what the action appends, put into OUT/FILE.
rows() {
    action=$1 file=$2 system=$3 dir=$4 seed=$5; shift 5
    left >/dev/null || exit 3
    csv=$dir/$action.csv; rm -f "$csv" "$dir/errors.csv"
    again="--repeat $repeat ${steps:+--steps $steps} $full"; [ "$action" != measure ] || again=
    # shellcheck disable=SC2086
    tss "$action" "$system" "$dir" "$seed" $again "$@" && add "$csv" "$file" && echo "$system, seed $seed: $file $*"
}

methods() {
    there neural.csv system="$1" seed="$2" && return
    train "$1" "$2" && rows evaluate neural.csv "$1" "$work/$1" "$2" && add "$work/$1/errors.csv" neural_errors.csv
}

errors() {
    there neural_errors.csv system="$1" seed="$2" && return
    train "$1" "$2" || return
    rm -f "$work/$1/errors.csv"
    # shellcheck disable=SC2086
    tss evaluate "$1" "$work/$1" "$2" --no-full ${steps:+--steps $steps} && add "$work/$1/errors.csv" neural_errors.csv && echo "$1, seed $2: neural_errors.csv"
}

newton() {
    there neural_newton.csv system="$1" seed="$2" && return
    train "$1" "$2" && rows evaluate neural_newton.csv "$1" "$work/$1" "$2" --set neural.solver.kind=newton
}

bfgs() {
    for c in ${cells:-0}; do
        there neural_bfgs.csv system="$1" seed="$2" runtime_cells="$(cells_of "$c")" && continue
        train "$1" "$2" && rows evaluate neural_bfgs.csv "$1" "$work/$1" "$2" --set neural.solver.kind=bfgs --set "neural.solver.cubature=$c"
    done
}

eps() {
    for e in 1e-4 1e-5 1e-6; do
        there neural_eps.csv system="$1" seed="$2" eps=$e && continue
        train "$1" "$2" && rows evaluate neural_eps.csv "$1" "$work/$1" "$2" --set neural.solver.eps=$e
    done
}

order() {
    for o in 2 1 0; do
        there neural_order.csv system="$1" seed="$2" order=$o && continue
        train "$1" "$2" || return
        if [ $o = 2 ]; then
            rows evaluate neural_order.csv "$1" "$work/$1" "$2"
        else
            if ! [ -s "$work/$1/lip_$2.csv" ]; then
                rm -f "$work/$1/evaluate.csv"
                tss evaluate "$1" "$work/$1" "$2" && cp "$work/$1/evaluate.csv" "$work/$1/lip_$2.csv" || return
            fi
            from=$work/$1/lip_$2.csv
            weight=$(awk -v w="$(value "$from" lipschitz lipschitz_weight)" -v a="$(value "$from" vanilla lip)" \
                -v b="$(value "$from" vanilla lip_$o)" 'BEGIN {printf "%.3e", w * (a / b) ^ 2}')
            set -- "$1" "$2" --set neural.lipschitz.order=$o --set neural.lipschitz.estimator=exact --set "neural.lipschitz.weight=$weight"
            system=$1 seed=$2; shift 2
            variant "$system" "$seed" "${system}_order$o" base "$@" && rows evaluate neural_order.csv "$system" "$dir" "$seed" "$@"
            set -- "$system" "$seed"
        fi
    done
}

runtime() {
    trained=$(awk 'match($0, /"cubature": [0-9]+/) {print substr($0, RSTART + 12, RLENGTH - 12)}' "examples/scenes/neural_$1.json")
    for c in ${cells:-0 "$trained"}; do
        train "$1" "$2" || return
        there neural_runtime.csv system="$1" seed="$2" runtime_cells="$(cells_of "$c")" && continue
        rows evaluate neural_runtime.csv "$1" "$work/$1" "$2" --set "neural.solver.cubature=$c"
    done
}

cubature() {
    for c in 20 40 80 120 160 200 300; do
        there neural_cubature.csv system="$1" seed="$2" wanted=$c && continue
        train "$1" "$2" && rows measure neural_cubature.csv "$1" "$work/$1" "$2" --set neural.lipschitz.cubature=$c
    done
}

# (the base need not be good for its cost; a tighter linear basis has as many modes as the largest r)
cost() {
    for k in 4 8 16 24 32; do
        for e in u exact; do
            there neural_cost.csv system="$1" seed="$2" r=$k estimator=$e && continue
            train "$1" "$2" || return
            variant "$1" "$2" "$1_cost$k" frames --set neural.r=$k --set neural.pca.tol=1e-6 --set neural.train.steps=300 --set neural.lipschitz.steps=1 &&
                rows measure neural_cost.csv "$1" "$work/$1_cost$k" "$2" --set neural.r=$k --set neural.pca.tol=1e-6 --set neural.train.steps=300 \
                    --set neural.lipschitz.steps=1 --set neural.lipschitz.estimator=$e
        done
    done
}

r() {
    for k in 4 6 8 10 12; do
        there neural_r.csv system="$1" seed="$2" r=$k && continue
        train "$1" "$2" || return
        variant "$1" "$2" "$1_r$k" frames --set neural.r=$k && rows evaluate neural_r.csv "$1" "$work/$1_r$k" "$2" --set neural.r=$k
    done
}

bridge() {
    for e in 0.5 0.05; do
        there neural_bridge.csv system="$1" seed="$2" error_nodes=$e && continue
        train "$1" "$2" && rows bridge neural_bridge.csv "$1" "$work/$1" "$2" --set solver.error_nodes=$e
    done
}

for part in $parts; do
    case $part in
    methods | bfgs | newton | errors) these=${systems:-twist_bar_small pulled_bar bistable dinosaur_small} ;;
    eps) these=${systems:-twist_bar_small pulled_bar bistable} ;;
    order | runtime | cubature | cost) these=${systems:-twist_bar_small pulled_bar} ;;
    r) these=${systems:-pulled_bar} ;;
    bridge) these=${systems:-twist_bar_small pulled_bar dinosaur_small} ;;
    *) echo "$part: no such part (methods bfgs errors newton eps order runtime cubature cost r bridge)" >&2; exit 2 ;;
    esac
    for n in $seeds; do for s in $these; do $part "$s" "$n"; done; done
done
exit $bad
