// Test matrices: a cube of s³ hexahedra cut into six tetrahedra each, linear elasticity (E, nu)
// plus lumped mass, d = 3; and Laplacians for d = 1, 2.
#include <stdlib.h>
#include <string.h>
#include <math.h>

static int fem_cmp(const void *a, const void *b) {
    int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

// Pattern from tets: all pairs of nodes of a tet.
static void fem_pattern(const tss_host *h, tss_bcsr *A, int n, int d, int m, const int *tet) {
    int64_t *key = (int64_t *)malloc(sizeof(int64_t) * (size_t)(16 * (int64_t)m + n + 1)), k = 0, u = 0;
    for (int i = 0; i < n; i++) key[k++] = (int64_t)i * n + i;
    for (int t = 0; t < m; t++)
        for (int a = 0; a < 4; a++)
            for (int b = 0; b < 4; b++)
                if (a != b) key[k++] = (int64_t)tet[4 * t + a] * n + tet[4 * t + b];
    qsort(key, (size_t)k, sizeof *key, fem_cmp);
    for (int64_t i = 0; i < k; i++)
        if (!i || key[i] != key[i - 1]) key[u++] = key[i];
    if (tss_bcsr_reserve(h, A, n, d, u)) abort();
    int64_t e = 0;
    for (int i = 0; i < n; i++) {
        A->row[i] = e;
        for (; e < u && key[e] / n == i; e++) A->col[e] = (int)(key[e] % n);
    }
    A->row[n] = u;
    memset(A->val, 0, (size_t)(u * d * d) * sizeof(double));
    free(key);
}

static void fem_gradients(const double *x, const int *t, double g[4][3], double *vol) {
    double m[3][3], c[3][3];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) m[i][j] = x[3 * t[j + 1] + i] - x[3 * t[0] + i];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            c[i][j] = m[(i + 1) % 3][(j + 1) % 3] * m[(i + 2) % 3][(j + 2) % 3] -
                      m[(i + 1) % 3][(j + 2) % 3] * m[(i + 2) % 3][(j + 1) % 3];
    double det = m[0][0] * c[0][0] + m[1][0] * c[1][0] + m[2][0] * c[2][0];
    *vol = fabs(det) / 6;
    for (int i = 0; i < 3; i++) {
        g[0][i] = 0;
        for (int j = 0; j < 3; j++) g[j + 1][i] = c[i][j] / det, g[0][i] -= c[i][j] / det;
    }
}

// s cells a side; scale: weight of the elastic part against mass ρ·vol/4 on the diagonal.
static void fem_cube(const tss_host *h, tss_bcsr *A, int s, double young, double nu, double mass) {
    static const int path[6][3] = {{0, 1, 2}, {0, 2, 1}, {1, 0, 2}, {1, 2, 0}, {2, 0, 1}, {2, 1, 0}};
    int p = s + 1, n = p * p * p, m = 6 * s * s * s, k = 0;
    double *x = (double *)malloc(sizeof(double) * 3 * (size_t)n);
    int *tet = (int *)malloc(sizeof(int) * 4 * (size_t)m);
    for (int i = 0; i < n; i++) {
        x[3 * i] = (double)(i % p) / s, x[3 * i + 1] = (double)(i / p % p) / s;
        x[3 * i + 2] = (double)(i / p / p) / s;
    }
    int stride[3] = {1, p, p * p};
    for (int c = 0; c < s * s * s; c++) {
        int base = c % s + c / s % s * p + c / s / s * p * p;
        for (int q = 0; q < 6; q++, k++) {
            int v = base;
            for (int a = 0; a < 4; a++) {
                tet[4 * k + a] = v;
                if (a < 3) v += stride[path[q][a]];
            }
        }
    }
    fem_pattern(h, A, n, 3, m, tet);
    double mu = young / (2 * (1 + nu)), la = young * nu / ((1 + nu) * (1 - 2 * nu));
    for (int t = 0; t < m; t++) {
        double g[4][3], vol;
        fem_gradients(x, tet + 4 * t, g, &vol);
        for (int a = 0; a < 4; a++)
            for (int b = 0; b < 4; b++) {
                double *blk = tss_bcsr_block(A, tet[4 * t + a], tet[4 * t + b]);
                double gg = g[a][0] * g[b][0] + g[a][1] * g[b][1] + g[a][2] * g[b][2];
                for (int i = 0; i < 3; i++)
                    for (int j = 0; j < 3; j++)
                        blk[3 * i + j] += vol * (la * g[a][i] * g[b][j] + mu * g[a][j] * g[b][i] +
                                                 (i == j ? mu * gg : 0));
                if (a == b)
                    for (int i = 0; i < 3; i++) blk[4 * i] += mass * vol / 4;
            }
    }
    free(x);
    free(tet);
}
