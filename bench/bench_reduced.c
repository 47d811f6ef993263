// What a step of the reduced solver costs: a bar of 22,032 coordinates and 36,300 tets, a made-up
// (untrained) decoder of either kind of the paper, pushed to and fro; all cells or 300 of them.
// Prints CSV: CPU time of this thread, ms.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_neural.h"
#include <stdio.h>
#include <time.h>

enum { NX = 50, NY = 11, NODES = (NX + 1) * (NY + 1) * (NY + 1), N = 3 * NODES, FEW = 300 };

static double cpu_ms(void) { return 1e3 * (double)clock() / CLOCKS_PER_SEC; }

static double X[N], mass[N], force[N], B[N * 80];
static int cell[4 * 6 * NX * NY * NY], cells;

static void mesh(void) {
    static const int six[6][4] = {{0, 1, 3, 7}, {0, 3, 2, 7}, {0, 2, 6, 7},
                                  {0, 6, 4, 7}, {0, 4, 5, 7}, {0, 5, 1, 7}};
    int sx = NX + 1, sy = NY + 1;
    for (int i = 0; i < NODES; i++) {
        X[3 * i] = 0.02 * (i % sx), X[3 * i + 1] = 0.02 * (i / sx % sy);
        X[3 * i + 2] = 0.02 * (i / sx / sy);
    }
    for (int b = 0; b < NX * NY * NY; b++)
        for (int k = 0; k < 6; k++, cells++)
            for (int c = 0; c < 4; c++) {
                int at = (b / NX / NY * sy + b / NX % NY) * sx + b % NX, v = six[k][c];
                cell[4 * cells + c] = at + (v & 1) + (v >> 1 & 1) * sx + (v >> 2) * sx * sy;
            }
}

static const char *const names[] = {"BFGS", "L-BFGS", "projected Newton"};

static void run(const tss_net *net, const tss_elements *e, tss_reduced_method method,
                const char *name) {
    tss_reduced_def d = tss_reduced_def_default();
    tss_reduced *s;
    double t = cpu_ms(), created, stepping = 0, decoding = 0;
    int iterations = 0, evaluations = 0, steps = 0;
    d.decoder = net, d.elements = e, d.mass = mass, d.solver = method, d.eps = 1e-6, d.ftol = 0;
    d.tol = 1e-6;
    if (tss_reduced_create(NULL, &d, &s) != TSS_OK) return;
    created = cpu_ms() - t;
    for (; steps < 100 && stepping < 5000; steps++) {
        tss_reduced_info info;
        for (int i = 0; i < N; i++)
            force[i] = i % 3 == steps % 3 ? (steps & 1 ? 4 : -4) * mass[i] : 0;
        tss_reduced_set_force(s, force);
        t = cpu_ms(), tss_reduced_step(s, &info), stepping += cpu_ms() - t;
        t = cpu_ms(), (void)tss_reduced_x(s), decoding += cpu_ms() - t;
        iterations += info.iterations, evaluations += info.evaluations;
    }
    printf("%s,%s,%d,%.2f,%.2f,%.3f,%.3f,%.3f,%.1f\n", name, names[method], steps,
           1.0 * iterations / steps, 1.0 * evaluations / steps, stepping / steps,
           stepping / iterations, decoding / steps, created);
    tss_reduced_destroy(s);
}

int main(void) {
    tss_elements_def ed = tss_elements_def_default();
    tss_elements *all, *few;
    int subset[FEW];
    double weight[FEW];
    tss_rng rng = tss_rng_seed(1);
    mesh();
    for (int i = 0; i < N; i++) mass[i] = 1e-3;
    for (int i = 0; i < N * 80; i++) B[i] = 0.02 * tss_rng_normal(&rng);
    for (int k = 0; k < FEW; k++) subset[k] = k * (cells / FEW), weight[k] = 1.0 * cells / FEW;
    ed.nodes = NODES, ed.X = X, ed.cells = cells, ed.cell = cell, ed.E = 1e4;
    if (tss_elements_create(NULL, &ed, &all) != TSS_OK) return 1;
    ed.subset = subset, ed.count = FEW, ed.weight = weight;
    if (tss_elements_create(NULL, &ed, &few) != TSS_OK) return 1;
    printf("scene,solver,steps,iterations,evaluations,ms_step,ms_iteration,ms_decode,ms_create\n");
    for (int kind = 0; kind < 2; kind++) {
        // Unsupervised: 8 → 64 × 4 → coordinates. Supervised: 40 → 200 × 2 → 80 columns.
        int free_[6] = {8, 64, 64, 64, 64, N}, pca[4] = {40, 200, 200, 80};
        tss_net_def nd = tss_net_def_default();
        tss_net *net;
        nd.outputs = N, nd.out_base = X, nd.layers = kind ? 3 : 5, nd.width = kind ? pca : free_;
        if (kind)
            nd.out_matrix = B;
        else
            nd.out_scale = 0.05;
        if (tss_net_create(NULL, &nd, &net) != TSS_OK) return 1;
        for (int m = 0; m < 3; m++) {
            run(net, all, (tss_reduced_method)m, kind ? "r 40 all" : "r 8 all");
            run(net, few, (tss_reduced_method)m, kind ? "r 40 cubature" : "r 8 cubature");
        }
        tss_net_destroy(net);
    }
    tss_elements_destroy(all), tss_elements_destroy(few);
    return 0;
}
