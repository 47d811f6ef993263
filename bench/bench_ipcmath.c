// bench_ipcmath FILE.ply: active pairs of a cloth (d̂ = 1e-3 of the diagonal), then the seconds that
// value, gradient and projected Hessian of all of them take. The pairs come from a plain grid.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static double now(void) {
    return (double)clock() / CLOCKS_PER_SEC;  // of this process: other programs run here as well
}

typedef struct mesh {
    int n, tris, edges;
    double *x;
    int *tri, *edge;
} mesh;
typedef struct pairs {
    int count[2];
    int (*node[2])[4];
} pairs;

static uint32_t big(FILE *f) {
    unsigned char b[4];
    if (fread(b, 1, 4, f) != 4) exit(1);
    return (uint32_t)b[0] << 24 | (uint32_t)b[1] << 16 | (uint32_t)b[2] << 8 | b[3];
}
static int by_edge(const void *a, const void *b) {
    return memcmp(a, b, 8) ? (((const int *)a)[0] != ((const int *)b)[0]
                                  ? (((const int *)a)[0] > ((const int *)b)[0] ? 1 : -1)
                                  : (((const int *)a)[1] > ((const int *)b)[1] ? 1 : -1))
                           : 0;
}

static mesh read_ply(const char *name) {
    mesh m;
    char line[256];
    FILE *f = fopen(name, "rb");
    memset(&m, 0, sizeof m);
    if (!f) exit(1);
    while (fgets(line, sizeof line, f) && strncmp(line, "end_header", 10)) {
        sscanf(line, "element vertex %d", &m.n);
        sscanf(line, "element face %d", &m.tris);
    }
    m.x = (double *)malloc(sizeof(double) * 3 * (size_t)m.n);
    m.tri = (int *)malloc(sizeof(int) * 3 * (size_t)m.tris);
    m.edge = (int *)malloc(sizeof(int) * 6 * (size_t)m.tris);
    for (int i = 0; i < 3 * m.n; i++) {
        uint32_t u = big(f);
        float v;
        memcpy(&v, &u, 4);
        m.x[i] = v;
    }
    for (int i = 0; i < m.tris; i++) {
        fgetc(f);
        for (int k = 0; k < 3; k++) m.tri[3 * i + k] = (int)big(f);
    }
    fclose(f);
    for (int i = 0; i < 3 * m.tris; i++) {
        int a = m.tri[i], b = m.tri[i / 3 * 3 + (i + 1) % 3];
        m.edge[2 * i] = a < b ? a : b, m.edge[2 * i + 1] = a < b ? b : a;
    }
    qsort(m.edge, (size_t)(3 * m.tris), 8, by_edge);
    for (int i = 0; i < 3 * m.tris; i++)
        if (!i || memcmp(m.edge + 2 * i, m.edge + 2 * i - 2, 8)) {
            m.edge[2 * m.edges] = m.edge[2 * i], m.edge[2 * m.edges + 1] = m.edge[2 * i + 1];
            m.edges++;
        }
    return m;
}

enum { HASH = 1 << 20 };
static uint32_t cell_hash(int x, int y, int z) {
    return ((uint32_t)x * 73856093u ^ (uint32_t)y * 19349663u ^ (uint32_t)z * 83492791u) % HASH;
}

static void find(const mesh *m, double dhat, pairs *out) {
    double len = 0;
    int count = 0, cap = 1 << 26;
    int *head = (int *)malloc(4 * HASH), *next = (int *)malloc(4 * (size_t)cap),
        *item = (int *)malloc(4 * (size_t)cap);
    for (int e = 0; e < m->edges; e++) {
        double l = 0;
        for (int k = 0; k < 3; k++) {
            double d = m->x[3 * m->edge[2 * e] + k] - m->x[3 * m->edge[2 * e + 1] + k];
            l += d * d;
        }
        len += sqrt(l);
    }
    double cell = 2 * len / m->edges;
    memset(head, -1, 4 * HASH);
    for (int e = 0; e < m->edges; e++) {
        int lo[3], hi[3];
        for (int k = 0; k < 3; k++) {
            double a = m->x[3 * m->edge[2 * e] + k], b = m->x[3 * m->edge[2 * e + 1] + k];
            lo[k] = (int)floor((fmin(a, b) - dhat / 2) / cell),
            hi[k] = (int)floor((fmax(a, b) + dhat / 2) / cell);
        }
        for (int i = lo[0]; i <= hi[0]; i++)
            for (int j = lo[1]; j <= hi[1]; j++)
                for (int k = lo[2]; k <= hi[2]; k++) {
                    uint32_t h = cell_hash(i, j, k);
                    item[count] = e, next[count] = head[h], head[h] = count++;
                }
    }
    int *seen = (int *)malloc(4 * (size_t)m->edges);
    memset(seen, -1, 4 * (size_t)m->edges);
    for (int kind = 0; kind < 2; kind++)
        out->node[kind] = (int(*)[4])malloc(16 << 20), out->count[kind] = 0;
    for (int q = 0; q < m->edges + m->n; q++) {
        int edge = q < m->edges, lo[3], hi[3];
        double x[12];
        const int *a = edge ? m->edge + 2 * q : NULL;
        int p = q - m->edges;
        for (int k = 0; k < 3; k++) {
            double u = edge ? m->x[3 * a[0] + k] : m->x[3 * p + k],
                   v = edge ? m->x[3 * a[1] + k] : u;
            x[k] = u, x[3 + k] = v;
            lo[k] = (int)floor((fmin(u, v) - dhat) / cell),
            hi[k] = (int)floor((fmax(u, v) + dhat) / cell);
        }
        if (!edge) continue;
        for (int i = lo[0]; i <= hi[0]; i++)
            for (int j = lo[1]; j <= hi[1]; j++)
                for (int k = lo[2]; k <= hi[2]; k++)
                    for (int c = head[cell_hash(i, j, k)]; c >= 0; c = next[c]) {
                        int e = item[c];
                        const int *b = m->edge + 2 * e;
                        if (e <= q || seen[e] == q || a[0] == b[0] || a[0] == b[1] ||
                            a[1] == b[0] || a[1] == b[1])
                            continue;
                        seen[e] = q;
                        memcpy(x + 6, m->x + 3 * b[0], 24);
                        memcpy(x + 9, m->x + 3 * b[1], 24);
                        if (tss_ipc_distance(TSS_IPC_EDGE_EDGE, 3, x, NULL) < dhat * dhat) {
                            int *o = out->node[0][out->count[0]++];
                            o[0] = a[0], o[1] = a[1], o[2] = b[0], o[3] = b[1];
                        }
                    }
    }
    // Points against triangles: points into the grid, triangles as queries.
    memset(head, -1, 4 * HASH), count = 0;
    for (int p = 0; p < m->n; p++) {
        uint32_t h = cell_hash((int)floor(m->x[3 * p] / cell), (int)floor(m->x[3 * p + 1] / cell),
                               (int)floor(m->x[3 * p + 2] / cell));
        item[count] = p, next[count] = head[h], head[h] = count++;
    }
    int *mark = (int *)malloc(4 * (size_t)m->n);
    memset(mark, -1, 4 * (size_t)m->n);
    for (int t = 0; t < m->tris; t++) {
        int lo[3], hi[3];
        const int *v = m->tri + 3 * t;
        double x[12];
        for (int k = 0; k < 3; k++) {
            double a = m->x[3 * v[0] + k], b = m->x[3 * v[1] + k], c = m->x[3 * v[2] + k];
            lo[k] = (int)floor((fmin(a, fmin(b, c)) - dhat) / cell),
            hi[k] = (int)floor((fmax(a, fmax(b, c)) + dhat) / cell);
            x[3 + k] = a, x[6 + k] = b, x[9 + k] = c;
        }
        for (int i = lo[0]; i <= hi[0]; i++)
            for (int j = lo[1]; j <= hi[1]; j++)
                for (int k = lo[2]; k <= hi[2]; k++)
                    for (int c = head[cell_hash(i, j, k)]; c >= 0; c = next[c]) {
                        int p = item[c];
                        if (mark[p] == t || p == v[0] || p == v[1] || p == v[2]) continue;
                        mark[p] = t;
                        memcpy(x, m->x + 3 * p, 24);
                        if (tss_ipc_distance(TSS_IPC_POINT_TRIANGLE, 3, x, NULL) < dhat * dhat) {
                            int *o = out->node[1][out->count[1]++];
                            o[0] = p, o[1] = v[0], o[2] = v[1], o[3] = v[2];
                        }
                    }
    }
    free(head), free(next), free(item), free(seen), free(mark);
}

typedef struct run {
    const mesh *m;
    const pairs *p;
    double dhat;
    int what;
    double *sum;
    int blocks;
} run;

// One block: 64 pairs of one kind into a buffer that stays in the cache, as the core does it.
static void block(int b, int worker, void *arg) {
    run *r = (run *)arg;
    (void)worker;
    int first = (r->p->count[0] + 63) / 64, kind = b >= first;
    int at = 64 * (kind ? b - first : b), size = r->what == 0 ? 1 : r->what == 1 ? 12 : 144;
    double buffer[8 * 144], sum = 0;
    tss__eight e;
    memset(&e, 0, sizeof e);
    e.kind = (tss_ipc_kind)kind, e.dim = 3, e.arity = 4, e.x = e.X = r->m->x,
    e.dhat = r->dhat * r->dhat;
    for (int g = 0; g < 8; g++) {
        e.count = r->p->count[kind] - at - 8 * g;
        if (e.count > 8) e.count = 8;
        if (e.count <= 0) break;
        for (int l = 0; l < e.count; l++)
            e.node[l] = r->p->node[kind][at + 8 * g + l], e.scale[l] = 1,
            e.out[l] = buffer + size * l;
        r->what == 0   ? tss__eight_value(&e, NULL)
        : r->what == 1 ? tss__eight_gradient(&e)
                       : tss__eight_hessian(&e, 1);
        for (int i = 0; i < e.count * size; i += 7) sum += buffer[i];
    }
    r->sum[b] = sum;
}

int main(int argc, char **argv) {
    if (argc < 2) return 1;
    mesh m = read_ply(argv[1]);
    pairs p;
    double lo[3], hi[3], diag = 0;
    for (int k = 0; k < 3; k++) {
        lo[k] = hi[k] = m.x[k];
        for (int i = 0; i < m.n; i++)
            lo[k] = fmin(lo[k], m.x[3 * i + k]), hi[k] = fmax(hi[k], m.x[3 * i + k]);
        diag += (hi[k] - lo[k]) * (hi[k] - lo[k]);
    }
    double dhat = 1e-3 * sqrt(diag);
    find(&m, dhat, &p);
    int moll = 0, feat[2][9] = {{0}};
    for (int k = 0; k < 2; k++)
        for (int i = 0; i < p.count[k]; i++) {
            double x[12];
            for (int c = 0; c < 12; c++) x[c] = m.x[3 * p.node[k][i][c / 3] + c % 3];
            feat[k][tss_ipc_closest((tss_ipc_kind)k, 3, x)]++;
            if (!k) moll += tss_ipc_mollifier(x, tss_ipc_mollifier_eps(x), NULL, NULL) < 1;
        }
    printf("%d edge-edge (%d mollified), %d point-triangle active pairs\n", p.count[0], moll,
           p.count[1]);
    for (int k = 0; k < 2; k++) {
        for (int f = 0; f < 9; f++) printf(" %d", feat[k][f]);
        printf("\n");
    }
    run r = {&m, &p, dhat, 0, NULL, (p.count[0] + 63) / 64 + (p.count[1] + 63) / 64};
    r.sum = (double *)malloc(8 * (size_t)r.blocks);
    for (int threads = 1; threads <= 1; threads++)
        for (r.what = 0; r.what < 3; r.what++) {
            tss_host host = tss_host_default();
            host.workers = threads;
            double best = 1e9, s = 0;
            for (int k = 0; k < 7; k++) {
                double t = now();
                tss_parallel(&host, r.blocks, block, &r);
                t = now() - t;
                if (t < best) best = t;
            }
            for (int b = 0; b < r.blocks; b++) s += r.sum[b];
            printf("%d threads  %s  %.4f s   (%.17g)\n", threads,
                   r.what == 0   ? "value   "
                   : r.what == 1 ? "gradient"
                                 : "hessian ",
                   best, s);
        }
    return 0;
}
