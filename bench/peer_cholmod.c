// Times CHOLMOD (supernodal, METIS) on a matrix written by bench_cholesky; a process of its own so
// that it may use a threaded BLAS. Usage: peer_cholmod FILE REPEATS; prints
// "analyze_s factor_s factor_cpu_s solve_s flops nonzeros residual".
#include <suitesparse/cholmod.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/resource.h>
#include <time.h>

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

static cholmod_sparse *read_matrix(const char *path, cholmod_common *cm) {
    FILE *f = fopen(path, "rb");
    int64_t size[2];
    if (!f || fread(size, sizeof size, 1, f) != 1) return NULL;
    size_t n = (size_t)size[0], m = (size_t)size[1];
    cholmod_sparse *A = cholmod_l_allocate_sparse(n, n, m, 1, 1, -1, CHOLMOD_REAL, cm);
    size_t got = fread(A->p, sizeof(int64_t), n + 1, f);
    got += fread(A->i, sizeof(int64_t), m, f);
    got += fread(A->x, sizeof(double), m, f);
    fclose(f);
    return got == n + 1 + 2 * m ? A : NULL;
}

int main(int argc, char **argv) {
    cholmod_common cm;
    if (argc < 3) return 2;
    cholmod_l_start(&cm);
    cm.supernodal = CHOLMOD_SUPERNODAL;
    cm.nmethods = 1;
    cm.method[0].ordering = CHOLMOD_METIS;
    cm.postorder = 1;
    cholmod_sparse *A = read_matrix(argv[1], &cm);
    if (!A) return fprintf(stderr, "peer_cholmod: cannot read %s\n", argv[1]), 2;
    double t = now();
    cholmod_factor *L = cholmod_l_analyze(A, &cm);
    double analyze = now() - t, factor = 1e300, used = 1e300;
    for (int r = 0; r < atoi(argv[2]); r++) {
        double c = cpu();
        t = now();
        cholmod_l_factorize(A, L, &cm);
        t = now() - t, c = cpu() - c;
        if (t < factor) factor = t;
        if (c < used) used = c;
    }
    cholmod_dense *b = cholmod_l_ones(A->nrow, 1, CHOLMOD_REAL, &cm);
    t = now();
    cholmod_dense *x = cholmod_l_solve(CHOLMOD_A, L, b, &cm);
    double solve = now() - t, one[2] = {1, 0}, minus[2] = {-1, 0};
    double norm = cholmod_l_norm_dense(b, 2, &cm);
    cholmod_l_sdmult(A, 0, minus, one, x, b, &cm);
    printf("%.4f %.4f %.4f %.4f %.4g %.4g %.2g\n", analyze, factor, used, solve, cm.fl, cm.lnz,
           cholmod_l_norm_dense(b, 2, &cm) / norm);
    cholmod_l_free_dense(&b, &cm), cholmod_l_free_dense(&x, &cm);
    cholmod_l_free_factor(&L, &cm), cholmod_l_free_sparse(&A, &cm);
    cholmod_l_finish(&cm);
    return 0;
}
