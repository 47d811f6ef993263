// One small scene, a few time steps; bench/leave_out.sh builds this program with and without parts
// of the library (an object of its own) and counts the instructions of its steps.
//     bench_leave_out SCENE [STEPS]
// prints `hash bytes` : the state's hash and the memory that the world holds. Callgrind collects
// inside measured_steps alone (--toggle-collect=measured_steps); two steps before it reach the
// high-water marks of memory.
//   solid    3D, a Neo-Hookean block pinned at one end: no contact
//   contact  3D, two blocks, one falling on the other, on a plane; mu = 0
//   alone    3D, one block above nothing: contact without self-contact and without a plane
//   flat     the same as contact in 2D
//   modes    contact, and both blocks have a quadratic basis; adaptive, nothing needs enriching
//   fixed    the same in mode subspace
//   bare     contact with a subspace solver, and no body has a basis
#include "tss.h"
#ifndef WITHOUT_IPC
#include "tss_ipc.h"
#endif
#ifndef WITHOUT_SUBSPACE
#include "tss_subspace.h"
#else
typedef enum tss_mode { TSS_MODE_ADAPTIVE, TSS_MODE_SUBSPACE } tss_mode;
#endif

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void need(tss_result r, tss_world *w) {
    if (r == TSS_OK) return;
    fprintf(stderr, "%s: %s\n", tss_result_text(r), w ? tss_world_error(w) : "");
    exit(1);
}

enum { MOST = 4000 };  // nodes of a block

// Cells of a cube's corners: Kuhn's six tets, or two triangles; corner bits x, y, z.
static const int cube[6][4] = {{0, 1, 3, 7}, {0, 5, 1, 7}, {0, 3, 2, 7}, {0, 2, 6, 7}, {0, 4, 5, 7}, {0, 6, 4, 7}};
static const int square[2][3] = {{0, 1, 3}, {0, 3, 2}};

// A block of side `side`, its lower side at height y, falling at 1 m/s; or with its left end pinned.
static void block(tss_world *w, double side, double y, int cells, int pin) {
    static double X[3 * MOST];
    static int cell[6 * 4 * MOST], pins[MOST];
    const int dim = tss_world_dim(w), m = cells + 1, deep = dim == 3 ? m : 1, size = dim + 1;
    tss_body_def d = tss_body_def_default();
    for (int n = 0; n < m * m * deep; n++) {
        const int at[3] = {n % m, n / m % m, n / m / m};
        for (int c = 0; c < dim; c++)
            X[dim * n + c] = side * at[c] / cells + (c == 1 ? y : -0.5 * side);
        if (pin && at[0] == 0) pins[d.pins++] = n;
        if (at[0] == cells || at[1] == cells || (dim == 3 && at[2] == cells)) continue;
        for (int k = 0; k < (dim == 3 ? 6 : 2); k++, d.cells++)
            for (int i = 0; i < size; i++) {
                const int corner = dim == 3 ? cube[k][i] : square[k][i];
                cell[d.cells * size + i] = n + (corner & 1) + (corner >> 1 & 1) * m + (corner >> 2) * m * m;
            }
    }
    d.nodes = m * m * deep, d.X = X, d.cell = cell, d.pin = pins;
    if (!pin) d.velocity[1] = -1;
    need(tss_body_add(w, &d, NULL), w);
}

static void touch(tss_world *w, int self, int planes) {
#ifndef WITHOUT_IPC
    const tss_ipc_plane ground = {{0, -0.002, 0}, {0, 1, 0}, 0};
    tss_ipc_def d = tss_ipc_def_default();
    d.self_contact = self, d.planes = planes, d.plane = &ground;
    need(tss_ipc_add(w, &d, NULL), w);
#else
    (void)w, (void)self, (void)planes;
#endif
}

// bases: how many bodies get a quadratic basis, all of whose blocks are active.
static void modes(tss_world *w, tss_mode mode, int bases) {
#ifndef WITHOUT_SUBSPACE
    tss_subspace_def d = tss_subspace_def_default();
    tss_basis_def b = tss_basis_quadratic();
    d.mode = mode, d.error_nodes = 1e9;  // nothing is so wrong as to be enriched
    need(tss_subspace_add(w, &d, NULL), w);
    for (int k = 0; k < bases; k++) need(tss_basis_add(w, k, &b, NULL), w);
#else
    (void)w, (void)mode, (void)bases;
#endif
}

#if defined(__GNUC__)
__attribute__((noinline))
#endif
void measured_steps(tss_world *w, int steps, tss_step_info *info);
void measured_steps(tss_world *w, int steps, tss_step_info *info) {
    for (int k = 0; k < steps; k++) need(tss_world_step(w, info), w);
}

int main(int argc, char **argv) {
    const char *scene = argc > 1 ? argv[1] : "contact";
    int steps = argc > 2 ? atoi(argv[2]) : 3, solid = !strcmp(scene, "solid"), alone = !strcmp(scene, "alone");
    tss_world_def wd = tss_world_def_default();
    tss_step_info info;
    tss_world *w;
    wd.dim = strcmp(scene, "flat") ? 3 : 2, wd.linear = TSS_LINEAR_DIRECT;
    need(tss_world_create(&wd, &w), NULL);
    block(w, 0.5, 0, wd.dim == 2 ? 16 : 6, solid);
    if (!solid && !alone) block(w, 0.3, 0.501, wd.dim == 2 ? 12 : 5, 0);
    if (!solid) touch(w, !alone, !alone);
    if (!strcmp(scene, "modes")) modes(w, TSS_MODE_ADAPTIVE, 2);
    if (!strcmp(scene, "fixed")) modes(w, TSS_MODE_SUBSPACE, 2);
    if (!strcmp(scene, "bare")) modes(w, TSS_MODE_ADAPTIVE, 0);
    for (int k = 0; k < 2; k++) need(tss_world_step(w, &info), w);
    measured_steps(w, steps, &info);
    printf("%016llx %llu\n", (unsigned long long)tss_world_hash(w), (unsigned long long)info.bytes);
    tss_world_destroy(w);
    return 0;
}
