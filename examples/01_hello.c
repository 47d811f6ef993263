/* 01_hello: a soft cube falls on the ground. Needs no package:
   cc -O2 -DTSS_NO_METIS -I. examples/01_hello.c -o hello -lm
   Prints the height at which its middle comes to rest; it is known by "middle at 0.244 m". */
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"

#include <stdio.h>

enum { N = 4, NODES = (N + 1) * (N + 1) * (N + 1), CELLS = 6 * N * N * N };

static double X[NODES * 3];
static int cell[CELLS * 4];

static int node(int i, int j, int k) { return (i * (N + 1) + j) * (N + 1) + k; }

// A cube of side 0.5 m, 0.3 m up: N³ small cubes of six tets, each a way along their edges.
static void build_cube(void) {
    static const int way[6][3] = {{0, 1, 2}, {1, 2, 0}, {2, 0, 1}, {1, 0, 2}, {0, 2, 1}, {2, 1, 0}};
    for (int k = 0; k < NODES; k++) {
        int at[3] = {k / ((N + 1) * (N + 1)), k / (N + 1) % (N + 1), k % (N + 1)};
        for (int c = 0; c < 3; c++) X[3 * k + c] = 0.5 * at[c] / N + (c == 1 ? 0.3 : 0);
    }
    for (int k = 0; k < CELLS; k++) {
        int p[3] = {k / 6 / (N * N), k / 6 / N % N, k / 6 % N}, *to = &cell[4 * k];
        to[0] = node(p[0], p[1], p[2]);
        for (int s = 0; s < 3; s++) p[way[k % 6][s]]++, to[s + 1] = node(p[0], p[1], p[2]);
        if (k % 6 > 2) to[2] ^= to[3], to[3] ^= to[2], to[2] ^= to[3];  // odd ways turn left-handed
    }
}

int main(void) {
    tss_world_def wd = tss_world_def_default();
    tss_body_def bd = tss_body_def_default();
    tss_ipc_def cd = tss_ipc_def_default();
    tss_ipc_plane ground = {{0, 0, 0}, {0, 1, 0}, 0.5};
    tss_world *w = NULL;
    double middle = 0;
    build_cube();
    bd.nodes = NODES, bd.X = X, bd.cells = CELLS, bd.cell = cell;
    bd.material.damping = 0.02;  // Pa and kg/m³ are those of soft rubber
    wd.integrator = TSS_IMPLICIT_EULER;
    cd.planes = 1, cd.plane = &ground;
    if (tss_world_create(&wd, &w) != TSS_OK || tss_body_add(w, &bd, NULL) != TSS_OK ||
        tss_ipc_add(w, &cd, NULL) != TSS_OK || tss_world_prepare(w) != TSS_OK)
        return printf("%s\n", w ? tss_world_error(w) : "no world: a bad tss_world_def, or no memory"), 1;
    for (int step = 0; step < 200; step++) {
        tss_step_info info;
        if (tss_world_step(w, &info) != TSS_OK) return printf("%s\n", tss_world_error(w)), 1;
        if (info.status != TSS_STEP_CONVERGED) return printf("step %d: %s\n", step, info.message), 1;
    }
    for (int k = 0; k < NODES; k++) middle += tss_world_positions(w)[3 * k + 1] / NODES;
    printf("middle at %.3f m\n", middle);
    tss_world_destroy(w);
    return 0;
}
