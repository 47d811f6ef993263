// ns per cell and share of the machine's peak for value, gradient, Hessian and step filter, one and
// two threads. cc -O3 -march=native -ffp-contract=off -fopenmp bench_elastic.c -lm
#define _POSIX_C_SOURCE 200809L
#include <math.h>
#if defined(__AVX512F__)
#include <immintrin.h>
#endif
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define TSS_IMPLEMENTATION
#include "tss.h"

static int cpu_clock;  // one thread on a busy machine: its own time

static double now(void) {
    struct timespec t;
    clock_gettime(cpu_clock ? CLOCK_PROCESS_CPUTIME_ID : CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

typedef struct job {
    tss__elastic *e;
    tss_ctx ctx;
    const double *x;
    double *out;  // workers × TSS_BATCH × 144
    double sink[64 * 16];
    int what, blocks;
} job;

enum { VALUE, GRADIENT, HESSIAN, HESSIAN_PSD, FMA, ADDMUL, STREAM };

// Independent chains of multiply-adds: peak with and without fusing.
static double chains(int fused) {
    typedef double v8 __attribute__((vector_size(64)));
    v8 a[12];
    for (int k = 0; k < 12; k++)
        for (int l = 0; l < 8; l++) a[k][l] = 1 + k + l;
    const v8 m = a[0] * 0 + 0.999, c = a[0] * 0 + 0.001;
    for (int i = 0; i < 2000000; i++)
        for (int k = 0; k < 12; k++) {
#if defined(__AVX512F__)
            if (fused)
                a[k] = (v8)_mm512_fmadd_pd((__m512d)a[k], (__m512d)m, (__m512d)c);
            else
#endif
                a[k] = a[k] * m + c;
        }
    double s = 0;
    for (int k = 0; k < 12; k++) s += a[k][0];
    return s;
}

static void run(int block, int worker, void *arg) {
    job *j = (job *)arg;
    const int chunk = 64 * TSS_BATCH, first = block * chunk;
    double *out = j->out + (size_t)worker * TSS_BATCH * 144;
    if (j->what == FMA || j->what == ADDMUL) {
        j->sink[worker * 16] += chains(j->what == FMA);
        return;
    }
    for (int at = first; at < first + chunk && at < j->e->cells; at += TSS_BATCH) {
        tss_ids ids = {at, j->e->cells - at < TSS_BATCH ? j->e->cells - at : TSS_BATCH, NULL};
        if (j->what == VALUE) tss__elastic_value(j->e, &j->ctx, j->x, ids, out);
        if (j->what == GRADIENT) tss__elastic_gradient(j->e, &j->ctx, j->x, ids, out);
        if (j->what >= HESSIAN)
            tss__elastic_hessian(j->e, &j->ctx, j->x, ids, j->what == HESSIAN_PSD, out);
        j->sink[worker * 16] += out[0];
    }
}

static double best(tss_host *h, job *j, int blocks) {
    double b = 1e300;
    for (int k = 0; k < 5; k++) {
        double t = now();
        tss_parallel(h, blocks, run, j);
        t = now() - t;
        if (t < b) b = t;
    }
    return b;
}

static double triad(void) {
    const size_t n = 8u << 20;
    double *a = (double *)malloc(n * 8), *b = (double *)malloc(n * 8), *c = (double *)malloc(n * 8);
    double best_t = 1e300;
    for (size_t i = 0; i < n; i++) a[i] = 0, b[i] = (double)i, c[i] = 1;
    for (int k = 0; k < 5; k++) {
        double t = now();
        for (size_t i = 0; i < n; i++) a[i] = b[i] + 0.5 * c[i];
        t = now() - t;
        if (t < best_t) best_t = t;
    }
    if (a[n / 2] < 0) puts("");
    free(a), free(b), free(c);
    return 24.0 * (double)n / best_t * 1e-9;
}

// A block of N³ cubes, six tetrahedra (2D: N² squares, two triangles) each, slightly deformed.
static int mesh(int d, int N, int **node, double **X, double **x, int *cells) {
    const int n1 = N + 1, n = d == 3 ? n1 * n1 * n1 : n1 * n1;
    static const int perm[6][3] = {{0, 1, 2}, {1, 2, 0}, {2, 0, 1},
                                   {0, 2, 1}, {2, 1, 0}, {1, 0, 2}};
    *cells = d == 3 ? 6 * N * N * N : 2 * N * N;
    *node = (int *)malloc((size_t)(*cells) * (size_t)(d + 1) * sizeof(int));
    *X = (double *)malloc((size_t)(n * d) * 8), *x = (double *)malloc((size_t)(n * d) * 8);
    for (int i = 0; i < n; i++)
        for (int r = 0, v = i; r < d; r++, v /= n1) {
            (*X)[i * d + r] = 0.01 * (v % n1);
            (*x)[i * d + r] = (*X)[i * d + r] * (1.1 - 0.15 * r) + 1e-3 * sin(12.9 * i + 78.2 * r);
        }
    const int stride[3] = {1, n1, n1 * n1};
    int *o = *node;
    for (int i = 0; i < n; i++) {
        int inside = 1;
        for (int r = 0, v = i; r < d; r++, v /= n1) inside &= v % n1 < N;
        for (int p = 0; inside && p < (d == 3 ? 6 : 2); p++) {
            int v = i, first = d == 3 ? p : p * 3;
            int *t = o;
            *o++ = v;
            for (int r = 0; r < d; r++) *o++ = v += stride[d == 3 ? perm[first][r] : p ? 1 - r : r];
            if (p >= d * (d - 1) / 2) {
                int s = t[1];
                t[1] = t[2], t[2] = s;
            }
        }
    }
    return n;
}

int main(int argc, char **argv) {
    const int threads = argc > 1 ? atoi(argv[1]) : 2, N = argc > 2 ? atoi(argv[2]) : 32;
    static const char *const names[] = {"neo-hookean", "stable nh", "corotated", "stvk", "linear"};
    // Operations a cell (+ − × ÷, no gather), counted in the source; Jacobi at 5 sweeps.
    static const double flops3[4] = {190, 320, 2670, 2690}, flops2[4] = {80, 120, 460, 470};
    double peak[3];
    for (int w = 1; w <= threads; w++) {
        tss_host h = tss_host_default();
        h.workers = w;
        cpu_clock = w == 1;
        static job j;
        j.what = FMA, peak[0] = w * 2000000.0 * 12 * 16 / best(&h, &j, w) * 1e-9;
        j.what = ADDMUL, peak[1] = w * 2000000.0 * 12 * 16 / best(&h, &j, w) * 1e-9;
        printf(
            "%d thread(s): peak %.0f GFlop/s fused, %.0f not fused; triad %.1f GB/s (1 thread)\n",
            w, peak[0], peak[1], peak[2] = triad());
        for (int d = 3; d >= 2; d--) {
            int *node, cells;
            double *X, *x;
            mesh(d, d == 3 ? N : 5 * N, &node, &X, &x, &cells);
            double *zero = (double *)calloc((size_t)(cells * 4), 24), *dir = x;
            printf("%dD, %d cells, ns a cell (GFlop/s, %% of unfused peak)\n", d, cells);
            for (int kind = 0; kind < TSS_CUSTOM_MATERIAL; kind++) {
                tss_material m = tss_material_default();
                m.kind = (tss_material_kind)kind;
                memset(&j, 0, sizeof j);
                int bad;
                if (tss__elastic_create(&h, d, cells, node, X, &m, NULL, NULL, NULL, &j.e, &bad)) {
                    printf("cell %d is bad\n", bad);
                    return 1;
                }
                j.ctx.host = &h, j.x = x;
                j.out = (double *)malloc((size_t)w * TSS_BATCH * 144 * 8);
                const int blocks = (cells + 64 * TSS_BATCH - 1) / (64 * TSS_BATCH);
                printf("%12s", names[kind]);
                for (j.what = VALUE; j.what <= HESSIAN_PSD; j.what++) {
                    double ns = best(&h, &j, blocks) / cells * 1e9;
                    printf("  %s %6.1f",
                           j.what == VALUE      ? "v"
                           : j.what == GRADIENT ? "g"
                           : j.what == HESSIAN  ? "H"
                                                : "H+",
                           ns);
                    if (kind == 0) {
                        double f = (d == 3 ? flops3 : flops2)[j.what] / ns;
                        printf(" (%.1f, %.0f%%)", f, 100 * f / peak[1]);
                    }
                }
                if (kind == 0) {
                    double b = 1e300;
                    int culprit;
                    for (int k = 0; k < 5; k++) {
                        double t = now();
                        tss__elastic_max_step(j.e, &j.ctx, x, dir, 1, &culprit);
                        t = now() - t;
                        if (t < b) b = t;
                    }
                    printf("  filter %.1f", b / cells * 1e9);
                }
                puts("");
                free(j.out);
                tss__elastic_destroy(j.e, &h);
            }
            free(zero), free(node), free(X), free(x);
        }
    }
    return 0;
}
