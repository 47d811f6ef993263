// Linear algebra: block-CSR, conjugate gradients, sparse and dense Cholesky. Every solution is
// judged by its backward error; factors and products against plain dense loops written here.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>
#include <stdio.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "fem.h"

// ---- hosts ----------------------------------------------------------------------------------

static uint64_t rng_state = 88172645463325252ull;
static double rnd(void) {  // xorshift64, in (−1, 1)
    rng_state ^= rng_state << 13, rng_state ^= rng_state >> 7, rng_state ^= rng_state << 17;
    return (double)(rng_state >> 11) / 4503599627370496.0 - 1;
}

// Runs blocks in a shuffled (mode 2) or reversed (mode 1) order on pretended workers.
typedef struct shuffler {
    int mode, workers;
} shuffler;

static void shuffled_for(int blocks, tss_task *task, void *arg, void *ctx) {
    shuffler *s = (shuffler *)ctx;
    int step = 7919;
    while (blocks % step == 0) step += 2;
    for (int b = 0; b < blocks; b++) {
        int shuffled = (int)((int64_t)b * step % blocks);
        int k = s->mode == 1 ? blocks - 1 - b : s->mode == 2 ? shuffled : b;
        task(k, (k * 5 + b) % s->workers, arg);
    }
}

static tss_host host_with(shuffler *s) {
    tss_host h = tss_host_default();
    h.parallel_for = shuffled_for, h.parallel_ctx = s, h.workers = s->workers;
    return h;
}

static tss_host plain(void) {
    tss_host h = tss_host_default();
    h.workers = 1;
    return h;
}

// An allocator that fails at allocation number fail_at and counts what is out.
typedef struct counter {
    int64_t calls, fail_at, live, bytes;
} counter;

static void *counted_alloc(size_t bytes, size_t align, void *ctx) {
    counter *c = (counter *)ctx;
    if (++c->calls == c->fail_at) return NULL;
    void *p = aligned_alloc(align, (bytes + align - 1) / align * align);
    assert_non_null(p);
    memset(p, 0xa5, bytes);
    c->live++, c->bytes += (int64_t)bytes;
    return p;
}

static void counted_free(void *p, size_t bytes, void *ctx) {
    counter *c = (counter *)ctx;
    c->live--, c->bytes -= (int64_t)bytes;
    free(p);
}

static tss_host host_counting(counter *c) {
    tss_host h = plain();
    h.alloc = counted_alloc, h.free = counted_free, h.memory_ctx = c;
    return h;
}

// ---- matrices -------------------------------------------------------------------------------

static tss_bcsr zero_matrix(void) {
    tss_bcsr A;
    memset(&A, 0, sizeof A);
    return A;
}

// From a dense 0/1 pattern of nodes: random symmetric blocks, diagonally dominant by dominance.
static void from_pattern(const tss_host *h, tss_bcsr *A, int n, int d, const char *has,
                         double dominance) {
    int64_t count = 0;
    for (int i = 0; i < n * n; i++) count += has[i] != 0;
    assert_int_equal(tss_bcsr_reserve(h, A, n, d, count), TSS_OK);
    int64_t e = 0;
    for (int i = 0; i < n; i++) {
        A->row[i] = e;
        for (int j = 0; j < n; j++)
            if (has[i * n + j]) A->col[e++] = j;
    }
    A->row[n] = e;
    for (int i = 0; i < n; i++)
        for (int64_t k = A->row[i]; k < A->row[i + 1]; k++)
            for (int a = 0; a < d; a++)
                for (int b = 0; b < d; b++) {
                    int j = A->col[k];
                    double v = rnd();
                    if (j < i || (j == i && b < a)) continue;
                    A->val[k * d * d + a * d + b] = v;
                    tss_bcsr_block(A, j, i)[b * d + a] = v;
                }
    double *sum = (double *)calloc((size_t)(n * d) + 1, sizeof *sum);
    for (int i = 0; i < n; i++)
        for (int64_t k = A->row[i]; k < A->row[i + 1]; k++)
            for (int a = 0; a < d; a++)
                for (int b = 0; b < d; b++) sum[i * d + a] += fabs(A->val[k * d * d + a * d + b]);
    for (int i = 0; i < n; i++)
        for (int a = 0; a < d; a++) {
            double *m = tss_bcsr_block(A, i, i);
            if (m) m[a * d + a] = dominance * (sum[i * d + a] + 0.1);
        }
    free(sum);
}

// Random pattern with about degree neighbours a node.
static void random_matrix(const tss_host *h, tss_bcsr *A, int n, int d, double degree) {
    char *has = (char *)calloc((size_t)(n * n) + 1, 1);
    for (int i = 0; i < n; i++) {
        has[i * n + i] = 1;
        for (int j = 0; j < i; j++)
            if ((rnd() + 1) / 2 < degree / n) has[i * n + j] = has[j * n + i] = 1;
    }
    from_pattern(h, A, n, d, has, 1.0);
    free(has);
}

// Dense column-major copy of A + B with identity rows where fixed.
static double *dense_of(const tss_bcsr *A, const tss_bcsr *B, const uint8_t *fixed) {
    int n = A->n, d = A->d, N = n * d;
    double *m = (double *)calloc((size_t)N * (size_t)N + 1, sizeof *m);
    for (int w = 0; w < 2; w++) {
        const tss_bcsr *M = w ? B : A;
        for (int i = 0; M && i < n; i++)
            for (int64_t e = M->row[i]; e < M->row[i + 1]; e++)
                for (int a = 0; a < d; a++)
                    for (int b = 0; b < d; b++)
                        m[i * d + a + (M->col[e] * d + b) * N] += M->val[e * d * d + a * d + b];
    }
    for (int i = 0; fixed && i < N; i++) {
        if (!fixed[i]) continue;
        for (int j = 0; j < N; j++) m[i + j * N] = m[j + i * N] = 0;
        m[i + i * N] = 1;
    }
    return m;
}

// max |b − Mx| / (‖M‖∞ ‖x‖∞ + ‖b‖∞): the normwise backward error.
static double backward_error(int N, const double *m, const double *x, const double *b) {
    double worst = 0, norm = 0, xs = 0, bs = 0;
    for (int i = 0; i < N; i++) {
        double s = 0, row = 0;
        for (int j = 0; j < N; j++) s += m[i + j * N] * x[j], row += fabs(m[i + j * N]);
        worst = fmax(worst, fabs(b[i] - s)), norm = fmax(norm, row);
        xs = fmax(xs, fabs(x[i])), bs = fmax(bs, fabs(b[i]));
        if (x[i] != x[i]) return INFINITY;
    }
    return worst == 0 ? 0 : worst / (norm * xs + bs);
}

// Plain Gaussian elimination with partial pivoting: the independent solution.
static void gauss(int N, const double *m, const double *b, double *x) {
    double *a = (double *)malloc(sizeof(double) * (size_t)N * (size_t)N + 8);
    memcpy(a, m, sizeof(double) * (size_t)N * (size_t)N), memcpy(x, b, sizeof(double) * (size_t)N);
    for (int k = 0; k < N; k++) {
        int p = k;
        for (int i = k; i < N; i++)
            if (fabs(a[i + k * N]) > fabs(a[p + k * N])) p = i;
        for (int j = 0; j < N; j++) {
            double t = a[k + j * N];
            a[k + j * N] = a[p + j * N], a[p + j * N] = t;
        }
        double t = x[k];
        x[k] = x[p], x[p] = t;
        for (int i = k + 1; i < N; i++) {
            double f = a[i + k * N] / a[k + k * N];
            for (int j = k; j < N; j++) a[i + j * N] -= f * a[k + j * N];
            x[i] -= f * x[k];
        }
    }
    for (int i = N - 1; i >= 0; i--) {
        for (int j = i + 1; j < N; j++) x[i] -= a[i + j * N] * x[j];
        x[i] /= a[i + i * N];
    }
    free(a);
}

static tss_chol *chol_new(const tss_host *h, int metis) {
    tss_chol_def def = tss_chol_def_default();
    tss_chol *c = NULL;
    def.use_metis = metis;
    assert_int_equal(tss_chol_create(h, &def, &c), TSS_OK);
    return c;
}

static double *random_vector(int N) {
    double *b = (double *)malloc(sizeof(double) * (size_t)N + 8);
    for (int i = 0; i < N; i++) b[i] = rnd();
    return b;
}

// ---- block-CSR ------------------------------------------------------------------------------

static void test_multiply(void **state) {
    (void)state;
    for (int d = 1; d <= 3; d++) {
        for (int n = 1; n < 1400; n = n * 6 + 1) {
            tss_host h = plain();
            tss_bcsr A = zero_matrix();
            random_matrix(&h, &A, n, d, 5);
            assert_int_equal(tss_bcsr_check(&A, 0), TSS_OK);
            int N = n * d;
            double *x = random_vector(N), *y = random_vector(N), *z = random_vector(N);
            double *m = n < 300 ? dense_of(&A, NULL, NULL) : NULL;
            tss_bcsr_multiply(&h, &A, x, y, 0);
            memcpy(z, y, sizeof(double) * (size_t)N);
            tss_bcsr_multiply(&h, &A, x, z, 1);
            for (int i = 0; i < N; i++) {
                double s = 0;
                assert_true(z[i] == y[i] + y[i]);
                for (int j = 0; m && j < N; j++) s += m[i + j * N] * x[j];
                if (m) assert_true(fabs(s - y[i]) < 1e-13 * N);
            }
            double *diag = random_vector(N * d);
            tss_bcsr_diagonal(&h, &A, diag, 0);
            for (int i = 0; i < n; i++)
                assert_memory_equal(diag + i * d * d, tss_bcsr_block(&A, i, i),
                                    sizeof(double) * (size_t)(d * d));
            free(diag), free(x), free(y), free(z), free(m);
            tss_bcsr_free(&h, &A);
        }
    }
}

static void test_check(void **state) {
    (void)state;
    tss_host h = plain();
    tss_bcsr A = zero_matrix();
    random_matrix(&h, &A, 20, 2, 4);
    assert_int_equal(tss_bcsr_check(&A, 0), TSS_OK);
    double keep = A.val[1];
    A.val[1] += 1e-6;  // (0,1) of a diagonal block
    assert_int_equal(tss_bcsr_check(&A, 1e-12), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_bcsr_check(&A, -1), TSS_OK);
    A.val[1] = keep;
    int col = A.col[A.row[20] - 1];
    A.col[A.row[20] - 1] = 20;
    assert_int_equal(tss_bcsr_check(&A, -1), TSS_ERROR_BAD_ARGUMENT);
    A.col[A.row[20] - 1] = col;
    assert_null(tss_bcsr_block(&A, 0, 0) == NULL ? &A : NULL);
    assert_int_equal(tss_bcsr_reserve(&h, &A, -1, 2, 4), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_bcsr_reserve(&h, &A, 3, 4, 4), TSS_ERROR_BAD_ARGUMENT);
    tss_bcsr_free(&h, &A);
}

// ---- products -------------------------------------------------------------------------------

// Every kernel and every edge of one, against plain loops; nothing outside C is touched.
static void test_products(void **state) {
    (void)state;
    for (int round = 0; round < 4000; round++) {
        int m = 1 + (int)((rnd() + 1) * 30), n = 1 + (int)((rnd() + 1) * 30), k = 1 + round % 9;
        if (round % 50 == 0) m *= 5, n *= 2, k += 230;
        int kind = round % 3, pad = round % 7, lda = (kind == 2 ? k : m) + pad;
        int ldb = (kind == 0 ? n : k) + pad, ldc = m + pad;
        double beta = round % 2, alpha = round % 5 ? -1 : 1;
        double *a = random_vector(lda * (kind == 2 ? m : k) + 8);
        double *b = random_vector(ldb * (kind == 0 ? k : n)), *c = random_vector(ldc * n);
        double *before = random_vector(ldc * n), *A = a + round % 8;
        memcpy(before, c, sizeof(double) * (size_t)(ldc * n));
        for (int j = 0; j < n; j++)
            for (int i = 0; beta == 0 && i < m; i++) c[i + j * ldc] = NAN;
        if (kind == 0) tss__gemm_nt(m, n, k, alpha, A, lda, b, ldb, beta, c, ldc);
        if (kind == 1) tss__gemm_nn(m, n, k, alpha, A, lda, b, ldb, beta, c, ldc);
        if (kind == 2) tss__gemm_tn(m, n, k, alpha, A, lda, b, ldb, beta, c, ldc);
        for (int j = 0; j < n; j++)
            for (int i = 0; i < ldc; i++) {
                double s = 0, was = before[i + j * ldc];
                if (i >= m) {
                    assert_true(c[i + j * ldc] == was);
                    continue;
                }
                for (int p = 0; p < k; p++)
                    s += (kind == 2 ? A[p + i * lda] : A[i + p * lda]) *
                         (kind == 0 ? b[j + p * ldb] : b[p + j * ldb]);
                assert_true(fabs(c[i + j * ldc] - alpha * s - beta * was) <= 1e-15 * (k + 4));
            }
        free(a), free(b), free(c), free(before);
    }
}

// ---- dense Cholesky -------------------------------------------------------------------------

static void test_dense(void **state) {
    (void)state;
    int sizes[] = {0, 1, 2, 3, 7, 8, 9, 16, 31, 47, 48, 49, 50, 96, 97, 191, 192, 193, 250, 401};
    for (size_t s = 0; s < sizeof sizes / sizeof sizes[0]; s++) {
        int n = sizes[s], lda = n + 3, bad = 7, k = 5;
        double *g = random_vector(n * n), *a = random_vector(lda * n);
        double *m = (double *)calloc((size_t)(n * n) + 1, sizeof *m);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                for (int p = 0; p < n; p++) m[i + j * n] += g[i + p * n] * g[j + p * n];
                if (i == j) m[i + j * n] += 0.1;
                a[i + j * lda] = i >= j ? m[i + j * n] : NAN;  // the upper triangle is not read
            }
        assert_int_equal(tss_dense_chol_factor(n, a, lda, &bad), TSS_OK);
        assert_int_equal(bad, -1);
        // L Lᵀ = A to rounding, entry by entry.
        for (int i = 0; i < n; i++)
            for (int j = 0; j <= i; j++) {
                double t = 0;
                for (int p = 0; p <= j; p++) t += a[i + p * lda] * a[j + p * lda];
                assert_true(fabs(t - m[i + j * n]) <=
                            4e-16 * (n + 8) * sqrt(m[i + i * n] * m[j + j * n]));
            }
        double *b = random_vector(n * k), *x = random_vector(n * k);
        memcpy(x, b, sizeof(double) * (size_t)(n * k));
        tss_dense_chol_solve(n, a, lda, x, n, k);
        for (int q = 0; q < k; q++)
            assert_true(backward_error(n, m, x + q * n, b + q * n) < 1e-15 * (n + 10));
        memcpy(x, b, sizeof(double) * (size_t)n);
        tss_dense_chol_solve(n, a, lda, x, n, 1);
        assert_true(backward_error(n, m, x, b) < 1e-15 * (n + 10));
        free(g), free(a), free(m), free(b), free(x);
    }
}

static void test_dense_bad(void **state) {
    (void)state;
    // A failing pivot anywhere is reported where it is: zero, negative, NaN, infinity.
    double poison[] = {0, -1, NAN, INFINITY};
    for (int n = 1; n < 300; n += 37)
        for (int at = 0; at < n; at += 1 + n / 5)
            for (int p = 0; p < 4; p++) {
                double *a = (double *)calloc((size_t)(n * n), sizeof *a);
                int bad = -5;
                for (int i = 0; i < n; i++) a[i + i * n] = 2;
                a[at + at * n] = poison[p];
                assert_int_equal(tss_dense_chol_factor(n, a, n, &bad), TSS_ERROR_SINGULAR);
                assert_int_equal(bad, at);
                free(a);
            }
    assert_int_equal(tss_dense_chol_factor(3, NULL, 2, NULL), TSS_ERROR_BAD_ARGUMENT);
}

static void test_dense_pivoted(void **state) {
    (void)state;
    // G Gᵀ of a known rank: the rank, and L Lᵀ = P A Pᵀ to the drop tolerance.
    int cases[][2] = {{1, 1}, {5, 0}, {6, 3}, {60, 60}, {60, 17}, {150, 49}, {150, 101}, {0, 0}};
    for (size_t s = 0; s < sizeof cases / sizeof cases[0]; s++) {
        int n = cases[s][0], r = cases[s][1], rank = -1;
        double *g = random_vector(n * r), *a = random_vector(n * n), *w = random_vector(n);
        double *m = (double *)calloc((size_t)(n * n) + 1, sizeof *m), top = 0;
        int *perm = (int *)malloc(sizeof(int) * (size_t)n + 4);
        char *seen = (char *)calloc((size_t)n + 1, 1);
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                for (int p = 0; p < r; p++) m[i + j * n] += g[i + p * n] * g[j + p * n];
                a[i + j * n] = i >= j ? m[i + j * n] : NAN;
            }
        for (int i = 0; i < n; i++) top = fmax(top, m[i + i * n]);
        tss_dense_chol_pivoted(n, a, n, 1e-10, perm, &rank, w);
        assert_int_equal(rank, r);
        for (int i = 0; i < n; i++) {
            assert_false(seen[perm[i]]++);
            if (i && i < rank) assert_true(a[i + i * n] <= a[i - 1 + (i - 1) * n] * (1 + 1e-12));
            for (int j = 0; j <= i; j++) {
                double t = 0;
                for (int p = 0; p < rank && p <= j; p++) t += a[i + p * n] * a[j + p * n];
                assert_true(fabs(t - m[perm[i] + perm[j] * n]) <= 2e-10 * top);
            }
        }
        free(g), free(a), free(m), free(w), free(perm), free(seen);
    }
}

// ---- sparse Cholesky ------------------------------------------------------------------------

// Factors and solves; judged by the backward error and against Gaussian elimination.
static void check_solve(const tss_host *h, const tss_bcsr *A, const tss_bcsr *B,
                        const uint8_t *fixed, int metis) {
    int N = A->n * A->d, k = 18;
    tss_chol *c = chol_new(h, metis);
    assert_int_equal(tss_chol_analyze(c, A, B), TSS_OK);
    assert_int_equal(tss_chol_factor(c, A, B, fixed), TSS_OK);
    double *m = dense_of(A, B, fixed), *b = random_vector(N * k), *x = random_vector(N * k);
    double *ref = random_vector(N), scale = 0, residual = -1;
    memcpy(x, b, sizeof(double) * (size_t)(N * k));
    assert_int_equal(tss_chol_solve(c, x, k), TSS_OK);
    for (int q = 0; q < k; q++)
        assert_true(backward_error(N, m, x + q * N, b + q * N) < 1e-14);
    gauss(N, m, b, ref);
    for (int i = 0; i < N; i++) scale = fmax(scale, fabs(ref[i]));
    for (int i = 0; i < N; i++) assert_true(fabs(x[i] - ref[i]) <= 1e-9 * scale);
    assert_int_equal(tss_chol_solve_refined(c, A, B, fixed, b, x, 1, &residual), TSS_OK);
    assert_true(backward_error(N, m, x, b) < 1e-15);
    for (int i = 0; i < N; i++)
        if (fixed && fixed[i]) assert_true(x[i] == b[i]);
    free(m), free(b), free(x), free(ref);
    tss_chol_destroy(c);
}

static void test_random(void **state) {
    (void)state;
    tss_host h = plain();
    int sizes[] = {1, 2, 3, 10, 63, 64, 65, 130, 200};
    for (int d = 1; d <= 3; d++)
        for (size_t s = 0; s < sizeof sizes / sizeof sizes[0]; s++)
            for (int degree = 0; degree < 40; degree = degree * 5 + 2) {
                tss_bcsr A = zero_matrix(), B = zero_matrix();
                int n = sizes[s];
                random_matrix(&h, &A, n, d, degree);
                random_matrix(&h, &B, n, d, 1);
                uint8_t *fixed = (uint8_t *)calloc((size_t)(n * d), 1);
                for (int i = 0; i < n * d; i++) fixed[i] = rnd() > 0.5;
                check_solve(&h, &A, NULL, NULL, 1);
                check_solve(&h, &A, &B, fixed, 1);
                check_solve(&h, &A, &B, NULL, 0);
                memset(fixed, 1, (size_t)(n * d));
                check_solve(&h, &A, &B, fixed, 1);
                free(fixed);
                tss_bcsr_free(&h, &A), tss_bcsr_free(&h, &B);
            }
}

static void test_shapes(void **state) {
    (void)state;
    tss_host h = plain();
    enum { N = 150 };
    static char has[N * N];
    for (int shape = 0; shape < 5; shape++) {
        tss_bcsr A = zero_matrix();
        for (int i = 0; i < N; i++)
            for (int j = 0; j < N; j++) {
                int e = i == j;
                if (shape == 0) e |= 1;                                   // dense
                if (shape == 1) e |= i == 70 || j == 70;                  // a dense row
                if (shape == 2) e |= i / 50 == j / 50 && abs(i - j) < 4;  // disconnected bands
                if (shape == 3) e |= abs(i - j) == 1;                     // a chain
                if (shape == 4) e |= (i < 80) == (j < 80) && (i < 80 || j < 90);
                if (shape == 4) e |= (i == 85 || j == 85) && i >= 80 && j >= 80;
                has[i * N + j] = (char)e;
            }
        for (int i = 0; i < N; i++)
            for (int j = 0; j < i; j++) {
                char either = (char)(has[i * N + j] | has[j * N + i]);
                has[i * N + j] = has[j * N + i] = either;
            }
        from_pattern(&h, &A, N, 2, has, 1.0);
        check_solve(&h, &A, NULL, NULL, 1);
        check_solve(&h, &A, NULL, NULL, 0);
        tss_bcsr_free(&h, &A);
    }
    // No nodes at all.
    tss_bcsr A = zero_matrix();
    assert_int_equal(tss_bcsr_reserve(&h, &A, 0, 3, 0), TSS_OK);
    A.row[0] = 0;
    tss_chol *c = chol_new(&h, 1);
    double none = 0, residual = -1;
    assert_int_equal(tss_chol_analyze(c, &A, NULL), TSS_OK);
    assert_int_equal(tss_chol_factor(c, &A, NULL, NULL), TSS_OK);
    assert_int_equal(tss_chol_solve(c, &none, 3), TSS_OK);
    double other = 0;
    tss_result r = tss_chol_solve_refined(c, &A, NULL, NULL, &none, &other, 1, &residual);
    assert_int_equal(r, TSS_OK);
    assert_true(residual == 0);
    tss_chol_destroy(c);
    tss_bcsr_free(&h, &A);
}

// The elastic cube: large enough for tasks, panels and fronts above. Residual by the product.
static double cube_residual(const tss_host *h, int s, double young, double mass, int metis,
                            tss_chol_info *info, double **out) {
    tss_bcsr A = zero_matrix();
    fem_cube(h, &A, s, young, 0.45, mass);
    int N = A.n * 3;
    tss_chol *c = chol_new(h, metis);
    double *b = random_vector(N), *x = random_vector(N), residual = 1;
    assert_int_equal(tss_chol_analyze(c, &A, NULL), TSS_OK);
    assert_int_equal(tss_chol_factor(c, &A, NULL, NULL), TSS_OK);
    assert_int_equal(tss_chol_solve_refined(c, &A, NULL, NULL, b, x, 0, &residual), TSS_OK);
    tss_chol_get_info(c, info);
    tss_chol_destroy(c);
    tss_bcsr_free(h, &A);
    free(b);
    if (out) *out = x;
    else free(x);
    return residual;
}

static void test_cube(void **state) {
    (void)state;
    tss_host h = plain();
    tss_chol_info info;
    assert_true(cube_residual(&h, 4, 1, 1, 1, &info, NULL) < 1e-14);
    assert_true(cube_residual(&h, 13, 1, 1, 1, &info, NULL) < 1e-13);
    assert_true(info.tasks > 4 && info.fronts > info.tasks);
    assert_true(cube_residual(&h, 13, 1, 1, 0, &info, NULL) < 1e-13);
    // Nearly floating: cond ≈ E h / (mass / nodes) ≈ 1e8, so ‖r‖ ≈ ε cond ‖b‖ ≈ 2e-8 ‖b‖.
    assert_true(cube_residual(&h, 9, 1e6, 1, 1, &info, NULL) < 1e-6);
}

static void test_same_bits(void **state) {
    (void)state;
    uint64_t seed = rng_state;
    double *ref = NULL;
    int N = 14 * 14 * 14 * 3;
    for (int workers = 1; workers <= 3; workers++)
        for (int mode = 0; mode < 3; mode++) {
            shuffler s = {mode, workers};
            tss_host h = host_with(&s);
            tss_chol_info info;
            double *x;
            rng_state = seed;
            cube_residual(&h, 13, 1, 1, 1, &info, &x);
            if (ref) assert_memory_equal(x, ref, sizeof(double) * (size_t)N);
            if (ref) free(x);
            else ref = x;
        }
    // And the library's own threads.
    for (int workers = 1; workers <= 3; workers++) {
        tss_host h = tss_host_default();
        h.workers = workers;
        tss_chol_info info;
        double *x;
        rng_state = seed;
        cube_residual(&h, 13, 1, 1, 1, &info, &x);
        assert_memory_equal(x, ref, sizeof(double) * (size_t)N);
        free(x);
    }
    free(ref);
}

static void test_singular(void **state) {
    (void)state;
    tss_host h = plain();
    tss_bcsr A = zero_matrix();
    tss_chol_info info;
    // A floating body without mass is singular to rounding.
    fem_cube(&h, &A, 5, 1, 0.3, 0);
    tss_chol *c = chol_new(&h, 1);
    assert_int_equal(tss_chol_solve(c, A.val, 1), TSS_ERROR_NOT_PREPARED);
    assert_int_equal(tss_chol_factor(c, &A, NULL, NULL), TSS_ERROR_NOT_PREPARED);
    assert_int_equal(tss_chol_analyze(c, &A, NULL), TSS_OK);
    assert_int_equal(tss_chol_factor(c, &A, NULL, NULL), TSS_ERROR_SINGULAR);
    tss_chol_get_info(c, &info);
    assert_in_range(info.bad_row, 0, A.n * 3 - 1);
    assert_int_equal(tss_chol_solve(c, A.val, 1), TSS_ERROR_NOT_PREPARED);
    // Three nodes fixed: regular again, with the same object.
    uint8_t *fixed = (uint8_t *)calloc((size_t)A.n * 3, 1);
    memset(fixed, 1, 6);
    memset(fixed + 3 * 40, 1, 3);
    assert_int_equal(tss_chol_factor(c, &A, NULL, fixed), TSS_OK);
    double *b = random_vector(A.n * 3), *x = random_vector(A.n * 3), residual;
    assert_int_equal(tss_chol_solve_refined(c, &A, NULL, fixed, b, x, 1, &residual), TSS_OK);
    assert_true(residual < 1e-11);  // three nodes hold the body: cond ≈ 1e5
    // One indefinite entry: an isolated one is named exactly; NaN as well.
    double poison[] = {-1, 0, NAN};
    for (int p = 0; p < 3; p++) {
        uint8_t *all = (uint8_t *)malloc((size_t)A.n * 3);
        memset(all, 1, (size_t)A.n * 3);
        all[100] = 0;
        double *m = tss_bcsr_block(&A, 33, 33), keep = m[4];
        m[4] = poison[p];
        assert_int_equal(tss_chol_factor(c, &A, NULL, all), TSS_ERROR_SINGULAR);
        tss_chol_get_info(c, &info);
        assert_int_equal(info.bad_row, 100);
        m[4] = keep;
        assert_int_equal(tss_chol_factor(c, &A, NULL, all), TSS_OK);
        free(all);
    }
    free(fixed), free(b), free(x);
    tss_chol_destroy(c);
    tss_bcsr_free(&h, &A);
}

static void test_scaled(void **state) {
    (void)state;
    // D A D with D from 1e-8 to 1e8: the factor must not care (pivots are judged against a_jj).
    tss_host h = plain();
    tss_bcsr A = zero_matrix();
    random_matrix(&h, &A, 120, 3, 6);
    double *s = random_vector(360), *b = random_vector(360), *x = random_vector(360);
    for (int i = 0; i < 360; i++) s[i] = pow(10, 8 * s[i]);
    for (int i = 0; i < 120; i++)
        for (int64_t e = A.row[i]; e < A.row[i + 1]; e++)
            for (int a = 0; a < 3; a++)
                for (int c = 0; c < 3; c++)
                    A.val[e * 9 + a * 3 + c] *= s[3 * i + a] * s[3 * A.col[e] + c];
    tss_chol *c = chol_new(&h, 1);
    assert_int_equal(tss_chol_analyze(c, &A, NULL), TSS_OK);
    assert_int_equal(tss_chol_factor(c, &A, NULL, NULL), TSS_OK);
    memcpy(x, b, sizeof(double) * 360);
    assert_int_equal(tss_chol_solve(c, x, 1), TSS_OK);
    // Componentwise: |b − Ax|ᵢ against (|A||x| + |b|)ᵢ.
    double *m = dense_of(&A, NULL, NULL);
    for (int i = 0; i < 360; i++) {
        double r = b[i], w = fabs(b[i]);
        for (int j = 0; j < 360; j++) r -= m[i + j * 360] * x[j], w += fabs(m[i + j * 360] * x[j]);
        assert_true(fabs(r) <= 1e-12 * w);
    }
    free(s), free(b), free(x), free(m);
    tss_chol_destroy(c);
    tss_bcsr_free(&h, &A);
}

// A contact matrix: pairs of nodes coupled with kappa [1 −1; −1 1] ⊗ I.
static void contact(const tss_host *h, tss_bcsr *B, int n, int pairs, const int (*pair)[2]) {
    char *has = (char *)calloc((size_t)n * (size_t)n, 1);
    for (int p = 0; p < pairs; p++)
        for (int a = 0; a < 2; a++)
            for (int b = 0; b < 2; b++) has[pair[p][a] * n + pair[p][b]] = 1;
    int64_t count = 0, e = 0;
    for (int i = 0; i < n * n; i++) count += has[i];
    assert_int_equal(tss_bcsr_reserve(h, B, n, 3, count), TSS_OK);
    for (int i = 0; i < n; i++) {
        B->row[i] = e;
        for (int j = 0; j < n; j++)
            if (has[i * n + j]) B->col[e++] = j;
    }
    B->row[n] = e;
    memset(B->val, 0, sizeof(double) * (size_t)(9 * e));
    for (int p = 0; p < pairs; p++)
        for (int a = 0; a < 2; a++)
            for (int b = 0; b < 2; b++)
                for (int i = 0; i < 3; i++)
                    tss_bcsr_block(B, pair[p][a], pair[p][b])[4 * i] += a == b ? 10 : -10;
    free(has);
}

static void expect_reuse(tss_chol *c, const tss_bcsr *A, const tss_bcsr *B, tss_chol_reuse reuse) {
    tss_chol_info info;
    double residual, *b = random_vector(A->n * 3), *x = random_vector(A->n * 3);
    assert_int_equal(tss_chol_analyze(c, A, B), TSS_OK);
    tss_chol_get_info(c, &info);
    assert_int_equal(info.reuse, reuse);
    assert_int_equal(tss_chol_factor(c, A, B, NULL), TSS_OK);
    assert_int_equal(tss_chol_solve_refined(c, A, B, NULL, b, x, 0, &residual), TSS_OK);
    assert_true(residual < 1e-12);
    free(b), free(x);
}

static void test_contact(void **state) {
    (void)state;
    tss_host h = plain();
    tss_bcsr A = zero_matrix(), B = zero_matrix();
    fem_cube(&h, &A, 9, 1, 0.3, 1);  // 1000 nodes
    A.pattern = 17;
    tss_chol *c = chol_new(&h, 1);
    tss_chol_info info;
    expect_reuse(c, &A, NULL, TSS_CHOL_REORDERED);
    expect_reuse(c, &A, NULL, TSS_CHOL_KEPT);
    // Neighbours of the mesh: nothing new.
    int near[][2] = {{0, 1}, {0, 10}, {555, 556}};
    contact(&h, &B, A.n, 3, (const int(*)[2])near);
    expect_reuse(c, &A, &B, TSS_CHOL_KEPT);
    // Opposite corners: a new structure, the ordering kept.
    int far[][2] = {{0, 999}};
    contact(&h, &B, A.n, 1, (const int(*)[2])far);
    // A pattern that was not analysed is refused, not mangled.
    assert_int_equal(tss_chol_factor(c, &A, &B, NULL), TSS_ERROR_BAD_ARGUMENT);
    expect_reuse(c, &A, &B, TSS_CHOL_RESTRUCTURED);
    expect_reuse(c, &A, &B, TSS_CHOL_KEPT);
    tss_chol_get_info(c, &info);
    assert_int_equal(info.orderings, 1);
    // Hundreds of random pairs: too dear for the old ordering.
    static int many[800][2];
    for (int p = 0; p < 800; p++) {
        many[p][0] = (int)((rnd() + 1) * 499), many[p][1] = (int)((rnd() + 1) * 499);
        if (many[p][0] == many[p][1]) many[p][1]++;
    }
    contact(&h, &B, A.n, 800, (const int(*)[2])many);
    expect_reuse(c, &A, &B, TSS_CHOL_REORDERED);
    tss_chol_get_info(c, &info);
    double heavy = info.flops;
    // They part: less work must be seen, and once.
    expect_reuse(c, &A, NULL, TSS_CHOL_RESTRUCTURED);
    tss_chol_get_info(c, &info);
    assert_true(info.flops < 0.8 * heavy);
    expect_reuse(c, &A, NULL, TSS_CHOL_KEPT);
    tss_chol_destroy(c);
    tss_bcsr_free(&h, &A), tss_bcsr_free(&h, &B);
}

static void test_arguments(void **state) {
    (void)state;
    tss_host h = plain();
    tss_chol_def def = tss_chol_def_default();
    tss_chol *c = NULL;
    def.cookie = 0;
    assert_int_equal(tss_chol_create(&h, &def, &c), TSS_ERROR_BAD_ARGUMENT);
    assert_null(c);
    c = chol_new(&h, 1);
    tss_bcsr A = zero_matrix(), B = zero_matrix();
    random_matrix(&h, &A, 5, 2, 3), random_matrix(&h, &B, 5, 3, 3);
    assert_int_equal(tss_chol_analyze(c, NULL, NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_chol_analyze(c, &A, &B), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_chol_analyze(c, &A, NULL), TSS_OK);
    assert_int_equal(tss_chol_factor(c, &B, NULL, NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_chol_factor(c, &A, NULL, NULL), TSS_OK);
    assert_int_equal(tss_chol_solve(c, A.val, -1), TSS_ERROR_BAD_ARGUMENT);
    tss_chol_destroy(c);
    tss_chol_destroy(NULL);
    tss_bcsr_free(&h, &A), tss_bcsr_free(&h, &B);
}

// Every allocation fails in turn: no leak, an error code, and the object works afterwards.
static void test_no_memory(void **state) {
    (void)state;
    tss_host ph = plain();
    tss_bcsr A = zero_matrix(), B = zero_matrix(), C = zero_matrix();
    fem_cube(&ph, &A, 7, 1, 0.3, 1);
    int far[][2] = {{0, 511}, {7, 504}};
    contact(&ph, &B, A.n, 2, (const int(*)[2])far);
    double *b = random_vector(A.n * 3), *x = random_vector(A.n * 3), residual;
    int failures = 0;
    for (int64_t at = 1;; at++) {
        counter k = {0, at, 0, 0};
        tss_host h = host_counting(&k);
        tss_chol_def def = tss_chol_def_default();
        tss_chol *c = NULL;
        tss_pcg *p = NULL;
        tss_result r = tss_chol_create(&h, &def, &c);
        if (r) assert_null(c);
        for (int round = 0; c && round < 3; round++) {
            const tss_bcsr *second = round == 1 ? &B : NULL;
            tss_result q;
            if ((q = tss_chol_analyze(c, &A, second)) != TSS_OK) {
                r = q;
                assert_int_equal(q, TSS_ERROR_NO_MEMORY);
                assert_int_equal(tss_chol_analyze(c, &A, second), TSS_OK);
            }
            if ((q = tss_chol_factor(c, &A, second, NULL)) != TSS_OK) {
                r = q;
                assert_int_equal(q, TSS_ERROR_NO_MEMORY);
                assert_int_equal(tss_chol_factor(c, &A, second, NULL), TSS_OK);
            }
            if ((q = tss_chol_solve_refined(c, &A, second, NULL, b, x, 1, &residual)) != TSS_OK) {
                r = q;
                assert_int_equal(
                    tss_chol_solve_refined(c, &A, second, NULL, b, x, 1, &residual), TSS_OK);
            }
            assert_true(residual < 1e-13);
        }
        tss_chol_destroy(c);
        tss_result q = tss_bcsr_reserve(&h, &C, 10, 3, 30);
        if (q) {
            r = q;
            assert_null(C.row);
            assert_int_equal(k.live, 0);
            assert_int_equal(tss_bcsr_reserve(&h, &C, 10, 3, 30), TSS_OK);
        }
        tss_bcsr_free(&h, &C);
        q = tss_pcg_create(&h, &p);
        if (q) r = q;
        if (p) {
            tss_pcg_def pd = tss_pcg_def_default();
            tss_pcg_info pi;
            pd.n = A.n, pd.d = 3, pd.A = &A, pd.tol = 1e-8;
            if ((q = tss_pcg_solve(p, &pd, b, x, &pi)) != TSS_OK) {
                r = q;
                assert_int_equal(tss_pcg_solve(p, &pd, b, x, &pi), TSS_OK);
            }
            assert_int_equal(pi.status, TSS_PCG_CONVERGED);
        }
        tss_pcg_destroy(p);
        assert_int_equal(k.live, 0);
        assert_int_equal(k.bytes, 0);
        if (r == TSS_OK) break;
        assert_int_equal(r, TSS_ERROR_NO_MEMORY);
        failures++;
    }
    assert_true(failures > 30);
    free(b), free(x);
    tss_bcsr_free(&ph, &A), tss_bcsr_free(&ph, &B);
}

// After the first round nothing allocates any more.
static void test_steady(void **state) {
    (void)state;
    counter k = {0, 0, 0, 0};
    tss_host h = host_counting(&k), ph = plain();
    tss_bcsr A = zero_matrix(), B = zero_matrix();
    fem_cube(&ph, &A, 7, 1, 0.3, 1);
    int far[][2] = {{0, 511}, {7, 504}};
    contact(&ph, &B, A.n, 2, (const int(*)[2])far);
    tss_chol *c = chol_new(&h, 1);
    double *x = random_vector(A.n * 3);
    int64_t calls = 0;
    for (int round = 0; round < 6; round++) {
        const tss_bcsr *second = round % 2 ? NULL : &B;
        if (round == 3) calls = k.calls;
        assert_int_equal(tss_chol_analyze(c, &A, second), TSS_OK);
        assert_int_equal(tss_chol_factor(c, &A, second, NULL), TSS_OK);
        assert_int_equal(tss_chol_solve(c, x, 1), TSS_OK);
    }
    assert_int_equal(k.calls, calls);
    tss_chol_info info;
    tss_chol_get_info(c, &info);
    assert_int_equal(info.bytes, k.bytes);
    free(x);
    tss_chol_destroy(c);
    tss_bcsr_free(&ph, &A), tss_bcsr_free(&ph, &B);
}

// ---- conjugate gradients --------------------------------------------------------------------

static void test_pcg(void **state) {
    (void)state;
    tss_host h = plain();
    for (int d = 1; d <= 3; d++) {
        tss_bcsr A = zero_matrix(), B = zero_matrix();
        const int n = 150, N = n * d;
        random_matrix(&h, &A, n, d, 5), random_matrix(&h, &B, n, d, 1);
        uint8_t *fixed = (uint8_t *)calloc((size_t)N, 1);
        for (int i = 0; i < N; i++) fixed[i] = rnd() > 0.6;
        double *b = random_vector(N), *x = random_vector(N), *ref = random_vector(N);
        double *m = dense_of(&A, &B, fixed);
        tss_pcg *p;
        tss_pcg_info info;
        tss_pcg_def def = tss_pcg_def_default();
        assert_int_equal(tss_pcg_create(&h, &p), TSS_OK);
        def.n = n, def.d = d, def.A = &A, def.B = &B, def.fixed = fixed, def.tol = 1e-12;
        assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_OK);
        assert_int_equal(info.status, TSS_PCG_CONVERGED);
        assert_true(info.residual <= 1e-12 && info.iterations > 1);
        // Identity rows decouple: the reference is the masked system itself.
        gauss(N, m, b, ref);
        for (int i = 0; i < N; i++) assert_true(fabs(x[i] - ref[i]) < 1e-10);
        // Started at the answer it has nothing to do; iterations are bounded.
        def.warm = 1, def.tol = 1e-9;
        assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_OK);
        assert_int_equal(info.iterations, 0);
        for (int i = 0; i < N; i++) assert_true(fabs(x[i] - ref[i]) < 1e-10);
        def.warm = 0, def.max_iterations = 2;
        assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_OK);
        assert_int_equal(info.status, TSS_PCG_MAX_ITERATIONS);
        assert_int_equal(info.iterations, 2);
        // b = 0; all fixed.
        memset(ref, 0, sizeof(double) * (size_t)N);
        assert_int_equal(tss_pcg_solve(p, &def, ref, x, &info), TSS_OK);
        for (int i = 0; i < N; i++) assert_true(x[i] == 0);
        for (int i = 0; i < N; i++) fixed[i] = 1;
        assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_OK);
        assert_int_equal(info.status, TSS_PCG_CONVERGED);
        for (int i = 0; i < N; i++) assert_true(x[i] == b[i]);
        tss_pcg_destroy(p);
        free(fixed), free(b), free(x), free(ref), free(m);
        tss_bcsr_free(&h, &A), tss_bcsr_free(&h, &B);
    }
}

static void test_pcg_broken(void **state) {
    (void)state;
    tss_host h = plain();
    tss_bcsr A = zero_matrix();
    fem_cube(&h, &A, 4, 1, 0.3, 1);
    int N = A.n * 3;
    double *b = random_vector(N), *x = random_vector(N);
    tss_pcg *p;
    tss_pcg_info info;
    tss_pcg_def def = tss_pcg_def_default();
    assert_int_equal(tss_pcg_create(&h, &p), TSS_OK);
    def.n = A.n, def.d = 3, def.A = &A;
    double *m = tss_bcsr_block(&A, 62, 62);
    double keep[9];
    memcpy(keep, m, sizeof keep);
    // Strong negative curvature in one node: seen, the block repaired, x still a descent direction.
    for (int i = 0; i < 3; i++) m[4 * i] -= 100;
    assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_OK);
    assert_int_equal(info.status, TSS_PCG_INDEFINITE);
    assert_int_equal(info.repaired, 1);
    assert_true(info.curvature <= 0);
    double slope = 0;
    for (int i = 0; i < N; i++) slope += x[i] * b[i];
    assert_true(slope > 0);
    memcpy(m, keep, sizeof keep);
    b[5] = NAN;
    assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_OK);
    assert_int_equal(info.status, TSS_PCG_BREAKDOWN);
    def.A = NULL;
    assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_ERROR_BAD_ARGUMENT);
    def.A = &A, def.n = 3;
    assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_ERROR_BAD_ARGUMENT);
    tss_pcg_destroy(p);
    free(b), free(x);
    tss_bcsr_free(&h, &A);
}

typedef struct dense_operator {
    int N, calls;
    const double *m;
} dense_operator;

static void dense_apply(void *user, const double *x, double *y) {
    dense_operator *o = (dense_operator *)user;
    o->calls++;
    for (int i = 0; i < o->N; i++) y[i] = 0;
    for (int j = 0; j < o->N; j++)
        for (int i = 0; i < o->N; i++) y[i] += o->m[i + j * o->N] * x[j];
}

static void dense_jacobi(void *user, const double *r, double *z) {
    dense_operator *o = (dense_operator *)user;
    for (int i = 0; i < o->N; i++) z[i] = r[i] / o->m[i + i * o->N];
}

static void test_pcg_operator(void **state) {
    (void)state;
    tss_host h = plain();
    tss_bcsr A = zero_matrix();
    random_matrix(&h, &A, 60, 2, 6);
    double *m = dense_of(&A, NULL, NULL), *b = random_vector(120), *x = random_vector(120);
    dense_operator o = {120, 0, m};
    tss_pcg *p;
    tss_pcg_info info;
    tss_pcg_def def = tss_pcg_def_default();
    assert_int_equal(tss_pcg_create(&h, &p), TSS_OK);
    def.n = 60, def.d = 2, def.apply = dense_apply, def.user = &o, def.tol = 1e-13;
    assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_ERROR_BAD_ARGUMENT);
    def.precondition = dense_jacobi;
    assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_OK);
    assert_int_equal(info.status, TSS_PCG_CONVERGED);
    assert_int_equal(o.calls, info.iterations);
    assert_true(backward_error(120, m, x, b) < 1e-12);
    double diagonal[240];
    tss_bcsr_diagonal(&h, &A, diagonal, 0);
    def.precondition = NULL, def.diagonal = diagonal;
    assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_OK);
    assert_true(backward_error(120, m, x, b) < 1e-12);
    tss_pcg_destroy(p);
    free(m), free(b), free(x);
    tss_bcsr_free(&h, &A);
}

static void test_pcg_bits(void **state) {
    (void)state;
    tss_host ph = plain();
    tss_bcsr A = zero_matrix();
    fem_cube(&ph, &A, 12, 1, 0.4, 1);
    int N = A.n * 3;
    double *b = random_vector(N), *x = random_vector(N), *ref = random_vector(N);
    for (int workers = 1; workers <= 3; workers++)
        for (int mode = 0; mode < 3; mode++) {
            shuffler s = {mode, workers};
            tss_host h = host_with(&s);
            tss_pcg *p;
            tss_pcg_info info;
            tss_pcg_def def = tss_pcg_def_default();
            def.n = A.n, def.d = 3, def.A = &A;
            assert_int_equal(tss_pcg_create(&h, &p), TSS_OK);
            assert_int_equal(tss_pcg_solve(p, &def, b, x, &info), TSS_OK);
            assert_int_equal(info.status, TSS_PCG_CONVERGED);
            if (workers == 1 && mode == 0) memcpy(ref, x, sizeof(double) * (size_t)N);
            assert_memory_equal(x, ref, sizeof(double) * (size_t)N);
            tss_pcg_destroy(p);
        }
    free(b), free(x), free(ref);
    tss_bcsr_free(&ph, &A);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_multiply),      cmocka_unit_test(test_check),
        cmocka_unit_test(test_products),
        cmocka_unit_test(test_dense),         cmocka_unit_test(test_dense_bad),
        cmocka_unit_test(test_dense_pivoted), cmocka_unit_test(test_random),
        cmocka_unit_test(test_shapes),        cmocka_unit_test(test_cube),
        cmocka_unit_test(test_same_bits),     cmocka_unit_test(test_singular),
        cmocka_unit_test(test_scaled),        cmocka_unit_test(test_contact),
        cmocka_unit_test(test_arguments),     cmocka_unit_test(test_no_memory),
        cmocka_unit_test(test_steady),        cmocka_unit_test(test_pcg),
        cmocka_unit_test(test_pcg_broken),    cmocka_unit_test(test_pcg_operator),
        cmocka_unit_test(test_pcg_bits),
    };
    printf("seed %llu\n", (unsigned long long)rng_state);
    return cmocka_run_group_tests(tests, NULL, NULL);
}
