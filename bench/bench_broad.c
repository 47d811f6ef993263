// Broad phase: time and counts on two states of one triangle mesh, beside a plain sweep and prune.
// usage: bench_broad t0.ply t1.ply [repeats]      (binary PLY, float or double x y z, one topology)
#define _POSIX_C_SOURCE 200809L
#define TSS_IMPLEMENTATION
#include "tss.h"
#ifdef TSS_IPC_H  // ipcmath.h: also times the scalar CCD
#include TSS_IPC_H
#endif
#include "tss_ipc.h"

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void die(const char *path, const char *what) {
    fprintf(stderr, "%s: %s\n", path, what);
    exit(2);
}

// ---- reader ----

typedef struct mesh {
    int n, nt, ne;
    double *x;
    int *tri, *edge, *point;
} mesh;

static void get(FILE *f, void *to, size_t size, int swap, const char *path) {
    unsigned char raw[8];
    if (fread(raw, 1, size, f) != size) die(path, "ends too early");
    for (size_t i = 0; i < size; i++) ((unsigned char *)to)[i] = raw[swap ? size - 1 - i : i];
}

static mesh read_ply(const char *path) {
    mesh m = {0, 0, 0, NULL, NULL, NULL, NULL};
    char line[256];
    int swap = 0, wide = 0, one = 1, little = *(char *)&one;
    FILE *f = fopen(path, "rb");
    if (!f) die(path, "cannot be opened");
    while (fgets(line, sizeof line, f)) {
        if (!strncmp(line, "format binary_big", 17)) swap = little;
        if (!strncmp(line, "format binary_little", 20)) swap = !little;
        if (!strncmp(line, "format ascii", 12)) die(path, "is not binary");
        sscanf(line, "element vertex %d", &m.n);
        sscanf(line, "element face %d", &m.nt);
        if (!strncmp(line, "property double x", 17)) wide = 1;
        if (!strncmp(line, "end_header", 10)) break;
    }
    m.x = (double *)malloc(sizeof(double) * 3 * (size_t)m.n);
    m.tri = (int *)malloc(sizeof(int) * 3 * (size_t)m.nt);
    for (int i = 0; i < 3 * m.n; i++) {
        float v;
        if (wide) get(f, &m.x[i], 8, swap, path);
        else get(f, &v, 4, swap, path), m.x[i] = (double)v;
    }
    for (int i = 0; i < m.nt; i++) {
        unsigned char k;
        get(f, &k, 1, 0, path);
        if (k != 3) die(path, "has a face that is no triangle");
        for (int c = 0; c < 3; c++) get(f, &m.tri[3 * i + c], 4, swap, path);
    }
    fclose(f);
    return m;
}

static int by_nodes(const void *a, const void *b) {
    const int *p = (const int *)a, *q = (const int *)b;
    return p[0] != q[0] ? (p[0] < q[0] ? -1 : 1) : p[1] != q[1] ? (p[1] < q[1] ? -1 : 1) : 0;
}

static void find_edges(mesh *m) {
    int n = 0;
    m->edge = (int *)malloc(sizeof(int) * 6 * (size_t)m->nt);
    m->point = (int *)malloc(sizeof(int) * (size_t)m->n);
    for (int i = 0; i < m->n; i++) m->point[i] = i;
    for (int i = 0; i < 3 * m->nt; i++) {
        int a = m->tri[i], b = m->tri[i % 3 == 2 ? i - 2 : i + 1];
        m->edge[2 * i] = a < b ? a : b, m->edge[2 * i + 1] = a < b ? b : a;
    }
    qsort(m->edge, 3 * (size_t)m->nt, 2 * sizeof(int), by_nodes);
    for (int i = 0; i < 3 * m->nt; i++) {
        if (n && !by_nodes(m->edge + 2 * i, m->edge + 2 * (n - 1))) continue;
        m->edge[2 * n] = m->edge[2 * i], m->edge[2 * n + 1] = m->edge[2 * i + 1];
        n++;
    }
    m->ne = n;
}

// ---- peer: sweep and prune along x, one thread ----

typedef struct box {
    double lo[3], hi[3];
    int id, kind;
} box;

static int sweep_axis;

static int by_low(const void *a, const void *b) {
    double p = ((const box *)a)->lo[sweep_axis], q = ((const box *)b)->lo[sweep_axis];
    return p < q ? -1 : p > q;
}

static box box_of(const double *x0, const double *x1, const int *node, int k, int id, int kind) {
    box b;
    b.id = id, b.kind = kind;
    for (int c = 0; c < 3; c++) {
        b.lo[c] = INFINITY, b.hi[c] = -INFINITY;
        for (int i = 0; i < k; i++) {
            double p = x0[3 * node[i] + c], q = x1[3 * node[i] + c];
            b.lo[c] = fmin(b.lo[c], fmin(p, q)), b.hi[c] = fmax(b.hi[c], fmax(p, q));
        }
    }
    return b;
}

static int meets(const box *p, const box *q) {
    for (int c = 0; c < 3; c++)
        if (p->lo[c] > q->hi[c] || q->lo[c] > p->hi[c]) return 0;
    return 1;
}

static uint64_t mix(uint64_t a, uint64_t b);

static long sweep(box *b, int n, const mesh *m, int pt, uint64_t *sum) {
    long found = 0;
    qsort(b, (size_t)n, sizeof *b, by_low);
    for (int i = 0; i < n; i++)
        for (int k = i + 1; k < n && b[k].lo[sweep_axis] <= b[i].hi[sweep_axis]; k++) {
            if (pt && b[i].kind == b[k].kind) continue;
            if (!meets(&b[i], &b[k])) continue;
            const box *p = b[i].kind ? &b[k] : &b[i], *q = b[i].kind ? &b[i] : &b[k];
            const int *s, *t = pt ? m->tri + 3 * q->id : m->edge + 2 * q->id;
            s = pt ? m->point + p->id : m->edge + 2 * p->id;
            int shared = 0;
            for (int u = 0; u < (pt ? 1 : 2); u++)
                for (int v = 0; v < (pt ? 3 : 2); v++) shared |= s[u] == t[v];
            if (shared) continue;
            found++;
            *sum += pt || p->id < q->id ? mix((uint64_t)p->id, (uint64_t)q->id)
                                        : mix((uint64_t)q->id, (uint64_t)p->id);
        }
    return found;
}

static long peer(const mesh *m, const double *x0, const double *x1, int pt, uint64_t *sum) {
    *sum = 0;
    box *b = (box *)malloc(sizeof(box) * (size_t)(m->ne + m->nt + m->n));
    int n = 0;
    if (pt) {
        for (int i = 0; i < m->n; i++) b[n++] = box_of(x0, x1, &m->point[i], 1, i, 0);
        for (int i = 0; i < m->nt; i++) b[n++] = box_of(x0, x1, m->tri + 3 * i, 3, i, 1);
    } else {
        for (int i = 0; i < m->ne; i++) b[n++] = box_of(x0, x1, m->edge + 2 * i, 2, i, 0);
    }
    long found = sweep(b, n, m, pt, sum);
    free(b);
    return found;
}

// ---- measurements ----

static double diagonal(const mesh *m) {
    double s = 0;
    for (int c = 0; c < 3; c++) {
        double lo = INFINITY, hi = -INFINITY;
        for (int i = 0; i < m->n; i++) lo = fmin(lo, m->x[3 * i + c]), hi = fmax(hi, m->x[3 * i + c]);
        s += (hi - lo) * (hi - lo);
    }
    return sqrt(s);
}

// Sum of mixed pairs: equal sets have equal sums, whatever their order.
static uint64_t mix(uint64_t a, uint64_t b) {
    uint64_t z = (a << 32 | b) * 0x9e3779b97f4a7c15u;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

static uint64_t mix_list(const tss__broad_pairs *p) {
    uint64_t s = 0;
    for (int i = 0; i < p->count; i++) s += mix((uint64_t)p->pair[i].a, (uint64_t)p->pair[i].b);
    return s;
}

typedef struct best {
    double build_search, search, active_search, near, reach, step;
} best;

static double least(double a, double b) { return b < a ? b : a; }

// Everything once; times go into t where they are lower.
static void run(tss__broad *b, const tss__broad_mesh *bm, const mesh *m, const double *d, double dhat,
                tss__broad_pairs *out, best *t, double *step, int *culprit) {
    int over;
    double s = now();
    tss__broad_set_mesh(b, bm);
    tss__broad_search(b, m->x, NULL, 0, dhat / 2, INT_MAX, &over);
    t->active_search = least(t->active_search, now() - s), s = now();
    for (int i = 0; i < 2; i++) tss__broad_near(b, i, &b->list[i], m->x, dhat, &out[i]);
    t->near = least(t->near, now() - s), s = now();
    tss__broad_set_mesh(b, bm);
    tss__broad_search(b, m->x, d, 1, 0, INT_MAX, &over);
    t->build_search = least(t->build_search, now() - s), s = now();
    tss__broad_search(b, m->x, d, 1, 0, INT_MAX, &over);
    t->search = least(t->search, now() - s), s = now();
    *step = 1;
    for (int i = 0; i < 2; i++) {
        double before = *step;
        int c;
        *step = tss__broad_step(b, i, &b->list[i], m->x, d, 0.1, 0, before, &c);
        if (*step < before) culprit[0] = i, culprit[1] = c;
    }
    t->step = least(t->step, now() - s), s = now();
    for (int i = 0; i < 2; i++) tss__broad_reach(b, i, &b->list[i], m->x, d, 1, dhat, 0, &out[2 + i]);
    t->reach = least(t->reach, now() - s);
}

#ifdef TSS_IPC_H
// The scalar CCD of every pair, one thread: peer and check of the step.
static double scalar_step(const tss__broad *b, const mesh *m, const double *d) {
    double t = 1;
    for (int kind = 0; kind < 2; kind++)
        for (int i = 0; i < b->list[kind].count; i++) {
            int n[4];
            double x[12], v[12];
            tss__broad_nodes(&b->mesh, kind, b->list[kind].pair[i], n);
            for (int k = 0; k < 12; k++) x[k] = m->x[3 * n[k / 3] + k % 3], v[k] = d[3 * n[k / 3] + k % 3];
            t = tss_ipc_ccd((tss_ipc_kind)kind, 3, x, v, 0.1, t, 0, NULL);
        }
    return t;
}
#endif

static void row(const char *what, long count, double ours, double peer) {
    printf("%s,%ld,%.4f,", what, count, ours);
    if (peer > 0) printf("%.4f,%.1f", peer, peer / ours);
    else printf(",");
    printf("\n");
}

int main(int argc, char **argv) {
    if (argc < 3) die("bench_broad", "usage: bench_broad t0.ply t1.ply [repeats]");
    mesh m = read_ply(argv[1]), m1 = read_ply(argv[2]);
    int repeats = argc > 3 ? atoi(argv[3]) : 5, culprit[2] = {-1, -1};
    if (m.n != m1.n || m.nt != m1.nt) die(argv[2], "is not the same mesh");
    find_edges(&m);
    double *d = (double *)malloc(sizeof(double) * 3 * (size_t)m.n), dhat = 1e-3 * diagonal(&m), step = 1;
    for (int i = 0; i < 3 * m.n; i++) d[i] = m1.x[i] - m.x[i];
    tss_host host = tss_host_default();
    static tss__broad b;
    static tss__broad_pairs out[4];
    tss__broad_mesh bm = {3, m.n, m.n, m.ne, m.nt, m.point, m.edge, m.tri, NULL, NULL, NULL};
    best t = {1e9, 1e9, 1e9, 1e9, 1e9, 1e9};
    tss__broad_init(&b, &host);
    for (int k = 0; k < repeats; k++) run(&b, &bm, &m, d, dhat, out, &t, &step, culprit);

    double s = now();
    uint64_t sum[2];
    long ee = peer(&m, m.x, m1.x, 0, &sum[0]), pt = peer(&m, m.x, m1.x, 1, &sum[1]);
    double sweep_time = now() - s, ccd_time = 0;
    int same = ee == b.list[0].count && pt == b.list[1].count && sum[0] == mix_list(&b.list[0]) &&
               sum[1] == mix_list(&b.list[1]);
    long pairs = (long)b.list[0].count + b.list[1].count;
    fprintf(stderr, "%d threads; peer: sweep and prune, one thread; same pairs: %s\n",
            tss_workers(&host), same ? "yes" : "NO");
    fprintf(stderr, "edge-edge %d, vertex-face %d; step %.6g (kind %d, pair %d)\n", b.list[0].count,
            b.list[1].count, step, culprit[0], culprit[1]);
#ifdef TSS_IPC_H
    s = now();
    double scalar = scalar_step(&b, &m, d);
    ccd_time = now() - s;
    fprintf(stderr, "scalar CCD of every pair, one thread: step %.6g\n", scalar);
#endif
    printf("work,count,seconds,peer_seconds,ratio\n");
    row("build and search (swept)", pairs, t.build_search, sweep_time);
    row("refit and search (swept)", pairs, t.search, sweep_time);
    row("build and search (dhat)", 0, t.active_search, 0);
    row("distance filter (dhat)", (long)out[0].count + out[1].count, t.near, 0);
    row("swept filter (dhat)", (long)out[2].count + out[3].count, t.reach, 0);
    row("collision-free step", pairs, t.step, ccd_time);
    tss__broad_free(&b);
    for (int i = 0; i < 4; i++) tss__broad_pairs_free(&host, &out[i]);
    return same ? 0 : 1;
}
