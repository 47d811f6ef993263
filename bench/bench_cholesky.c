// Sparse Cholesky against CHOLMOD on elastic cubes (tetrahedra, E, nu and lumped mass: a Newton
// matrix of a time step), and the block-CSR product. CSV on stdout, one row a size.
// Usage: bench_cholesky "PEER COMMAND" FILE REPEATS THREADS CELLS...
// The peer is run as COMMAND FILE REPEATS in a process of its own, before and after ours; the
// better of both counts. An empty command leaves it out.
#include <stdio.h>
#include <sys/resource.h>
#include <time.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "fem.h"

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static double cpu(void) {
    struct rusage u;
    getrusage(RUSAGE_SELF, &u);
    return (double)(u.ru_utime.tv_sec + u.ru_stime.tv_sec) +
           1e-6 * (double)(u.ru_utime.tv_usec + u.ru_stime.tv_usec);
}

// Lower triangle, compressed columns: n, nonzeros, pointers, rows, values (all 8 bytes).
static int write_matrix(const tss_bcsr *A, const char *path) {
    FILE *f = fopen(path, "wb");
    int64_t size[2] = {(int64_t)A->n * 3, 0}, at = 0;
    if (!f) return 0;
    for (int pass = 0; pass < 4; pass++) {
        if (pass == 1) fwrite(size, sizeof size, 1, f), fwrite(&at, sizeof at, 1, f);
        for (int j = 0; j < A->n * 3; j++) {
            for (int64_t e = A->row[j / 3]; e < A->row[j / 3 + 1]; e++)
                for (int a = 0; a < 3; a++) {
                    int64_t i = (int64_t)A->col[e] * 3 + a;
                    if (i < j) continue;
                    if (pass == 0) size[1]++;
                    if (pass == 1) at++;
                    if (pass == 2) fwrite(&i, sizeof i, 1, f);
                    if (pass == 3) fwrite(A->val + 9 * e + 3 * (j % 3) + a, sizeof(double), 1, f);
                }
            if (pass == 1) fwrite(&at, sizeof at, 1, f);
        }
    }
    return fclose(f) == 0;
}

typedef struct row {
    double analyze, factor, used, solve, flops, nonzeros, residual;
} row;

static int run_peer(const char *command, const char *file, int repeats, row *best) {
    char line[1024];
    row r;
    snprintf(line, sizeof line, "%s %s %d", command, file, repeats);
    FILE *f = popen(line, "r");
    int got = f ? fscanf(f, "%lf %lf %lf %lf %lf %lf %lf", &r.analyze, &r.factor, &r.used, &r.solve,
                         &r.flops, &r.nonzeros, &r.residual)
                : 0;
    if (f) pclose(f);
    if (got != 7) return 0;
    double factor = best->factor, used = best->used;
    *best = r;
    if (factor > 0 && factor < r.factor) best->factor = factor;
    if (used > 0 && used < r.used) best->used = used;
    return 1;
}

static double time_multiply(const tss_host *h, const tss_bcsr *A) {
    size_t N = (size_t)A->n * 3;
    double *x = (double *)calloc(N, 8), *y = (double *)calloc(N, 8), best = 1e300;
    for (int r = 0; r < 20; r++) {
        double t = now();
        tss_bcsr_multiply(h, A, x, y, 0);
        best = fmin(best, now() - t);
    }
    free(x), free(y);
    return ((double)A->row[A->n] * (9 * 8 + 4) + (double)N * 16) / best * 1e-9;
}

static void run_ours(const tss_host *h, const tss_bcsr *A, int repeats, row *r,
                     tss_chol_info *info, double *restructure) {
    tss_chol_def def = tss_chol_def_default();
    tss_chol *c;
    if (tss_chol_create(h, &def, &c)) exit(1);
    double t = now();
    if (tss_chol_analyze(c, A, NULL)) exit(1);
    r->analyze = now() - t;
    // One far contact: what a new structure with the kept ordering costs.
    tss_bcsr B;
    memset(&B, 0, sizeof B);
    if (tss_bcsr_reserve(h, &B, A->n, 3, 4)) exit(1);
    memset(B.val, 0, 36 * sizeof(double));
    for (int i = 0; i <= A->n; i++) B.row[i] = i == 0 ? 0 : i == A->n ? 4 : 2;
    B.col[0] = B.col[2] = 0, B.col[1] = B.col[3] = A->n - 1;
    *restructure = 1e300;
    r->factor = r->used = 1e300;
    for (int k = 0; k < 3; k++) {
        t = now();
        if (tss_chol_analyze(c, A, &B)) exit(1);
        tss_chol_get_info(c, info);
        if (info->reuse == TSS_CHOL_RESTRUCTURED) *restructure = fmin(*restructure, now() - t);
        if (tss_chol_analyze(c, A, NULL)) exit(1);
    }
    for (int k = 0; k < repeats; k++) {
        double u = cpu();
        t = now();
        if (tss_chol_factor(c, A, NULL, NULL)) exit(1);
        r->factor = fmin(r->factor, now() - t);
        r->used = fmin(r->used, cpu() - u);
    }
    size_t N = (size_t)A->n * 3;
    double *b = (double *)malloc(N * 8), *x = (double *)malloc(N * 8);
    for (size_t i = 0; i < N; i++) b[i] = 1;
    r->solve = 1e300;
    for (int k = 0; k < 3; k++) {
        memcpy(x, b, N * 8);
        t = now();
        tss_chol_solve(c, x, 1);
        r->solve = fmin(r->solve, now() - t);
    }
    tss_chol_solve_refined(c, A, NULL, NULL, b, x, 0, &r->residual);
    tss_chol_get_info(c, info);
    free(b), free(x);
    tss_bcsr_free(h, &B);
    tss_chol_destroy(c);
}

int main(int argc, char **argv) {
    if (argc < 6) return fprintf(stderr, "see the top of bench_cholesky.c\n"), 2;
    const char *peer = argv[1], *file = argv[2];
    int repeats = atoi(argv[3]);
    tss_host h = tss_host_default();
    h.workers = atoi(argv[4]);
    printf("nodes,threads,ours_s,peer_s,ratio,ours_cpu_s,peer_cpu_s,ours_flops,peer_flops,"
           "ours_gflops,ours_analyze_s,peer_analyze_s,ours_restructure_s,ours_solve_s,peer_solve_s,"
           "ours_residual,peer_residual,ours_mb,multiply_gb_s\n");
    for (int i = 5; i < argc; i++) {
        tss_bcsr A;
        row ours, other;
        tss_chol_info info;
        double restructure;
        memset(&A, 0, sizeof A), memset(&ours, 0, sizeof ours), memset(&other, 0, sizeof other);
        fem_cube(&h, &A, atoi(argv[i]), 1e5, 0.4, 1e7);
        int with = *peer && write_matrix(&A, file) && run_peer(peer, file, repeats, &other);
        run_ours(&h, &A, repeats, &ours, &info, &restructure);
        if (with && repeats > 1) run_peer(peer, file, repeats, &other);
        printf("%d,%d,%.4f,%.4f,%.3f,%.4f,%.4f,%.4g,%.4g,%.1f,%.3f,%.3f,%.4f,%.4f,%.4f,%.2g,"
               "%.2g,%.0f,%.1f\n",
               A.n, h.workers, ours.factor, other.factor, with ? ours.factor / other.factor : 0,
               ours.used, other.used, info.flops, other.flops, info.flops / ours.factor * 1e-9,
               ours.analyze, other.analyze, restructure, ours.solve, other.solve, ours.residual,
               other.residual, (double)info.bytes * 1e-6, time_multiply(&h, &A));
        fflush(stdout);
        tss_bcsr_free(&h, &A);
        if (with) remove(file);
    }
    return 0;
}
