// Broad phase and pair filters against brute force and long double references.
// Data of the large test: $TSS_DATA/broad_phase, or ../shared/data/broad_phase; skipped without.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <cmocka.h>

// ---- random numbers: splitmix64, seeded per test ----

static uint64_t seed;
static uint64_t rnd(void) {
    uint64_t z = (seed += 0x9e3779b97f4a7c15u);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}
static int below(int n) { return (int)(rnd() % (uint64_t)n); }
// Multiples of 2^-12 in [-s, s]: sums and differences are exact.
static double grid(int s) { return (double)(below(s * 8192 + 1) - s * 4096) / 4096.0; }
static double uniform(double a, double b) {
    return a + (b - a) * (double)(rnd() >> 11) / 9007199254740992.0;
}

// ---- scenes ----

typedef struct scene {
    tss__broad_mesh m;
    int *point, *edge, *tri, *body;
    uint8_t *kin, *self_off;
    double *x, *d;
} scene;

static void *get(size_t n) {
    void *p = calloc(n + 1, 1);
    assert_non_null(p);
    return p;
}

static void scene_free(scene *s) {
    free(s->point), free(s->edge), free(s->tri), free(s->body), free(s->kin), free(s->self_off);
    free(s->x), free(s->d);
}

// tris triangles of three fresh nodes each (with their edges), segs segments, dots single points.
static scene scene_make(int dim, int tris, int segs, int dots) {
    scene s;
    memset(&s, 0, sizeof s);
    int n = 3 * tris + 2 * segs + dots, e = 0;
    s.point = (int *)get(sizeof(int) * (size_t)n), s.body = (int *)get(sizeof(int) * (size_t)n);
    s.edge = (int *)get(sizeof(int) * (size_t)(6 * tris + 2 * segs));
    s.tri = (int *)get(sizeof(int) * (size_t)(3 * tris));
    s.kin = (uint8_t *)get((size_t)n), s.self_off = (uint8_t *)get((size_t)n);
    s.x = (double *)get(sizeof(double) * (size_t)(dim * n));
    s.d = (double *)get(sizeof(double) * (size_t)(dim * n));
    for (int i = 0; i < n; i++) s.point[i] = i;
    for (int i = 0; i < tris; i++)
        for (int k = 0; k < 3; k++) {
            s.tri[3 * i + k] = 3 * i + k;
            s.edge[2 * e] = 3 * i + k, s.edge[2 * e + 1] = 3 * i + (k + 1) % 3, e++;
        }
    for (int i = 0; i < segs; i++, e++)
        s.edge[2 * e] = 3 * tris + 2 * i, s.edge[2 * e + 1] = 3 * tris + 2 * i + 1;
    s.m.dim = dim, s.m.nodes = n, s.m.points = n, s.m.edges = e, s.m.tris = dim == 3 ? tris : 0;
    s.m.point = s.point, s.m.edge = s.edge, s.m.tri = s.tri;
    return s;
}

// Primitives of a given size around random centres; node order within a primitive is that of scene_make.
static void scene_scatter(scene *s, int tris, int segs, int room, double size) {
    int dim = s->m.dim;
    double c[3] = {0, 0, 0};
    for (int i = 0; i < s->m.nodes; i++) {
        int fresh = i < 3 * tris ? i % 3 == 0 : i < 3 * tris + 2 * segs ? (i - 3 * tris) % 2 == 0 : 1;
        for (int k = 0; k < dim; k++) {
            if (fresh) c[k] = grid(room);
            s->x[dim * i + k] = c[k] + size * grid(1);
            s->d[dim * i + k] = size * grid(1);
        }
    }
}

// ---- brute force ----

static int nodes_of(const tss__broad_mesh *m, int type, int i, int *node) {
    switch (type) {
        case 0: node[0] = m->point[i]; return 1;
        case 1: node[0] = m->edge[2 * i], node[1] = m->edge[2 * i + 1]; return 2;
        default: for (int k = 0; k < 3; k++) node[k] = m->tri[3 * i + k]; return 3;
    }
}

// Do the boxes meet, each grown by r? In exact arithmetic up to long double.
static int boxes_meet(const scene *s, int ta, int a, int tb, int b, double t, int moving, double r) {
    int na[3], nb[3], ka = nodes_of(&s->m, ta, a, na), kb = nodes_of(&s->m, tb, b, nb);
    for (int c = 0; c < s->m.dim; c++) {
        long double lo[2] = {1e300L, 1e300L}, hi[2] = {-1e300L, -1e300L};
        for (int side = 0; side < 2; side++)
            for (int k = 0; k < (side ? kb : ka); k++) {
                int at = s->m.dim * (side ? nb[k] : na[k]) + c;
                long double p = s->x[at], q = moving ? p + (long double)t * s->d[at] : p;
                if (p < lo[side]) lo[side] = p;
                if (q < lo[side]) lo[side] = q;
                if (p > hi[side]) hi[side] = p;
                if (q > hi[side]) hi[side] = q;
            }
        if (lo[0] - r > hi[1] + r || lo[1] - r > hi[0] + r) return 0;
    }
    return 1;
}

static int excluded(const scene *s, int ta, int a, int tb, int b) {
    int na[3], nb[3], ka = nodes_of(&s->m, ta, a, na), kb = nodes_of(&s->m, tb, b, nb), all = 1;
    for (int i = 0; i < ka; i++)
        for (int k = 0; k < kb; k++)
            if (na[i] == nb[k]) return 1;
    for (int i = 0; i < ka; i++) all &= s->m.kinematic && s->m.kinematic[na[i]];
    for (int k = 0; k < kb; k++) all &= s->m.kinematic && s->m.kinematic[nb[k]];
    if (all) return 1;
    int ba = s->m.body ? s->m.body[na[0]] : 0, bb = s->m.body ? s->m.body[nb[0]] : 0;
    return s->m.self_off && ba == bb && s->m.self_off[ba];
}

static int is_lone(const tss__broad_mesh *m, int p) {
    for (int k = 0; k < 2 * m->edges; k++)
        if (m->edge[k] == m->point[p]) return 0;
    for (int k = 0; k < 3 * m->tris; k++)
        if (m->tri[k] == m->point[p]) return 0;
    return 1;
}

static int is_strut(const tss__broad_mesh *m, int e) {
    for (int i = 0; i < m->tris; i++) {
        int has = 0;
        for (int k = 0; k < 3; k++)
            has += m->tri[3 * i + k] == m->edge[2 * e] || m->tri[3 * i + k] == m->edge[2 * e + 1];
        if (has == 2) return 0;
    }
    return 1;
}

static int brute(const scene *s, int kind, double t, int moving, double r, tss__pair *out) {
    const tss__broad_mesh *m = &s->m;
    static const int type[4][2] = {{1, 1}, {0, 2}, {0, 1}, {0, 0}};
    int count[3] = {m->points, m->edges, m->tris}, n = 0, ta = type[kind][0], tb = type[kind][1];
    if (m->dim == 2 && kind < 2) return 0;
    for (int a = 0; a < count[ta]; a++) {
        if (kind == TSS__BROAD_PP && !is_lone(m, a)) continue;
        if (kind == TSS__BROAD_PE && m->dim == 3 && !is_lone(m, a)) continue;
        for (int b = ta == tb ? a + 1 : 0; b < count[tb]; b++) {
            if (kind == TSS__BROAD_PP && !is_lone(m, b)) continue;
            if (!boxes_meet(s, ta, a, tb, b, t, moving, r)) continue;
            if (excluded(s, ta, a, tb, b)) continue;
            if (kind == TSS__BROAD_PE && m->dim == 3 && !is_strut(m, b)) continue;
            out[n].a = a, out[n].b = b, n++;
        }
    }
    return n;
}

static long compared;

static void check_scene_with(tss__broad *b, const scene *s, double t, int moving, double r) {
    int over = 7;
    size_t most = (size_t)(s->m.points + s->m.edges) * (size_t)(s->m.points + s->m.edges + s->m.tris);
    tss__pair *want = (tss__pair *)get(sizeof(tss__pair) * most);
    assert_int_equal(tss__broad_search(b, s->x, moving ? s->d : NULL, t, r, INT_MAX, &over), TSS_OK);
    assert_int_equal(over, 0);
    for (int k = 0; k < TSS__BROAD_KINDS; k++) {
        int n = brute(s, k, t, moving, r, want);
        compared += n;
        assert_int_equal(b->list[k].count, n);
        if (n) assert_memory_equal(b->list[k].pair, want, sizeof(tss__pair) * (size_t)n);
    }
    free(want);
}

static void check_scene(const scene *s, double t, int moving, double r) {
    tss_host host = tss_host_default();
    tss__broad *b = (tss__broad *)get(sizeof *b);
    tss__broad_init(b, &host);
    assert_int_equal(tss__broad_set_mesh(b, &s->m), TSS_OK);
    check_scene_with(b, s, t, moving, r);
    tss__broad_free(b);
    free(b);
}

static void test_random_scenes(void **state) {
    (void)state;
    compared = 0;
    for (seed = 1; seed < 60;) {
        uint64_t keep = seed;
        int dim = 2 + below(2), tris = below(40), segs = below(20), dots = below(20);
        scene s = scene_make(dim, tris, segs, dots);
        scene_scatter(&s, tris, segs, 1 + below(2), (double[]){0.0625, 0.25, 1}[below(3)]);
        int moving = below(2);
        check_scene(&s, (double[]){1, 0.5, 0}[below(3)], moving, (double[]){0, 0.125}[below(2)]);
        scene_free(&s);
        seed = keep + 1;
    }
    assert_true(compared > 5000);
}

// Triangles sharing nodes: a grid of quads, crumpled.
static scene scene_sheet(int n) {
    scene s = scene_make(3, 0, 0, (n + 1) * (n + 1));
    int t = 0, e = 0, w = n + 1;
    free(s.tri), free(s.edge);
    s.tri = (int *)get(sizeof(int) * (size_t)(6 * n * n));
    s.edge = (int *)get(sizeof(int) * (size_t)(6 * w * w));
    for (int j = 0; j < w; j++)
        for (int i = 0; i < w; i++) {
            int v = j * w + i;
            if (i < n) s.edge[2 * e] = v, s.edge[2 * e + 1] = v + 1, e++;
            if (j < n) s.edge[2 * e] = v, s.edge[2 * e + 1] = v + w, e++;
            if (i == n || j == n) continue;
            s.edge[2 * e] = v, s.edge[2 * e + 1] = v + w + 1, e++;
            int q[6] = {v, v + 1, v + w + 1, v, v + w + 1, v + w};
            memcpy(s.tri + 3 * t, q, sizeof q), t += 2;
        }
    s.m.tris = t, s.m.edges = e, s.m.tri = s.tri, s.m.edge = s.edge;
    for (int i = 0; i < w * w; i++) {
        double q[3] = {(double)(i % w) / 8, (double)(i / w) / 8, 0};
        for (int c = 0; c < 3; c++) s.x[3 * i + c] = q[c] + 0.125 * grid(1), s.d[3 * i + c] = 0.125 * grid(1);
    }
    return s;
}

static void test_shared_nodes(void **state) {
    (void)state;
    seed = 5;
    for (int n = 1; n < 15; n += 2) {
        scene s = scene_sheet(n);
        check_scene(&s, 1, 1, 0);
        check_scene(&s, 1, 0, 0.0625);
        scene_free(&s);
    }
}

// Odd shapes: one huge triangle among small ones, needles, everything equal, a cluster and an
// outlier, one primitive, none.
static void test_odd_scenes(void **state) {
    (void)state;
    seed = 11;
    for (int shape = 0; shape < 7; shape++) {
        int tris = shape == 5 ? 1 : shape == 6 ? 0 : 50, dim = 3;
        scene s = scene_make(dim, tris, shape == 6 ? 0 : 8, shape == 6 ? 0 : 7);
        scene_scatter(&s, tris, s.m.points ? 8 : 0, 1, 0.0625);
        int n = 3 * s.m.nodes;
        if (shape == 0)
            for (int k = 0; k < 9; k++) s.x[k] = (double)((k * 7) % 9 - 4) * 1024;
        if (shape == 1)
            for (int k = 0; k < n; k += 3) s.x[k] *= 1 << 20;
        if (shape == 2)
            for (int k = 0; k < n; k++) s.x[k] = 0.5, s.d[k] = 0;
        if (shape == 3) {
            for (int k = 0; k < n; k++) s.x[k] *= 0x1p-36, s.d[k] *= 0x1p-36;
            for (int k = n - 3; k < n; k++) s.x[k] = 0x1p15;
        }
        if (shape == 4)  // beyond the range of floats, and below it
            for (int k = 0; k < n; k++) s.x[k] *= k < 9 || k & 1 ? 0x1p900 : 0x1p-900, s.d[k] = 0;
        if (shape == 4)  // one box around everything: reaches empty lanes if it is infinite
            for (int k = 0; k < 9; k++) s.x[k] = (k / 3 ? 1 : -1) * 0x1p900;
        check_scene(&s, 1, 1, 0);
        check_scene(&s, 1, 0, 0);
        scene_free(&s);
    }
}

static void test_filters(void **state) {
    (void)state;
    compared = 0;
    for (seed = 100; seed < 140;) {
        uint64_t keep = seed;
        int dim = 2 + below(2), tris = 30, segs = 8, dots = 10, mode = below(4), last = -1;
        scene s = scene_make(dim, tris, segs, dots);
        scene_scatter(&s, tris, segs, 1, 0.5);
        if (mode & 1) s.m.kinematic = s.kin;
        if (mode & 2) s.m.self_off = s.self_off;
        s.m.body = s.body;
        for (int i = 0; i < s.m.nodes; i++) {
            int fresh = i < 3 * tris ? i % 3 == 0
                                     : i < 3 * tris + 2 * segs ? (i - 3 * tris) % 2 == 0 : 1;
            if (fresh) last = below(4);
            s.body[i] = last, s.kin[i] = (uint8_t)(last == 1 || below(5) == 0);
        }
        for (int i = 0; i < 4; i++) s.self_off[i] = (uint8_t)below(2);
        check_scene(&s, 1, 1, 0.125);
        scene_free(&s);
        seed = keep + 1;
    }
    assert_true(compared > 5000);
}

// Two bodies that are apart but for a seam, enough of them for several levels of the tree: whole
// branches belong to one body, some to both.
static void test_clustered_bodies(void **state) {
    (void)state;
    compared = 0;
    for (int round = 0; round < 8; round++) {
        seed = (uint64_t)(150 + round);
        scene s = scene_make(3, 120, 0, 0);
        scene_scatter(&s, 120, 0, 1, 0.125);
        s.m.body = s.body, s.m.self_off = s.self_off;
        for (int i = 0; i < s.m.nodes; i++) {
            s.x[3 * i] *= 4;
            s.body[i] = s.x[9 * (i / 9)] > 0;  // three triangles at a time
        }
        s.self_off[0] = 1, s.self_off[1] = (uint8_t)(round & 1);
        check_scene(&s, 1, 1, 0.125);
        scene_free(&s);
    }
    assert_true(compared > 500);
}

// Boxes off the grid: all that strictly overlap are there, and all that are there overlap within
// a few roundings.
static void test_rounding(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    tss__broad_init(&b, &host);
    for (seed = 200; seed < 240;) {
        uint64_t keep = seed;
        int over;
        scene s = scene_make(3, 40, 0, 0);
        scene_scatter(&s, 40, 0, 1, 0.5);
        double t = uniform(0.1, 1.9), r = below(2) ? uniform(0, 0.1) : 0;
        for (int k = 0; k < 3 * s.m.nodes; k++)
            s.x[k] += uniform(-0.1, 0.1), s.d[k] += uniform(-0.1, 0.1);
        // twins: boxes that touch but for rounding
        for (int k = 9; k < 18; k++) s.x[k] = s.x[k - 9] + t * s.d[k - 9], s.d[k] = s.d[k - 9];
        assert_int_equal(tss__broad_set_mesh(&b, &s.m), TSS_OK);
        assert_int_equal(tss__broad_search(&b, s.x, s.d, t, r, INT_MAX, &over), TSS_OK);
        size_t most = (size_t)s.m.edges * (size_t)s.m.edges;
        tss__pair *want = (tss__pair *)get(sizeof(tss__pair) * most);
        for (int k = 0; k < 2; k++) {
            int n = brute(&s, k, t, 1, r, want), i = 0;
            for (int q = 0; q < n; q++) {
                while (i < b.list[k].count && (b.list[k].pair[i].a != want[q].a ||
                                               b.list[k].pair[i].b != want[q].b)) i++;
                assert_true(i < b.list[k].count);
            }
            assert_true(b.list[k].count <= brute(&s, k, t, 1, r + 1e-14, want));
        }
        free(want);
        scene_free(&s);
        seed = keep + 1;
    }
    tss__broad_free(&b);
}

// The tree is kept while things move a little, sorted anew when they have mixed; always right.
static void test_refit(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    tss__broad_init(&b, &host);
    seed = 300;
    scene s = scene_make(3, 60, 0, 0);
    scene_scatter(&s, 60, 0, 2, 0.25);
    assert_int_equal(tss__broad_set_mesh(&b, &s.m), TSS_OK);
    check_scene_with(&b, &s, 1, 1, 0);
    int first = b.rebuilds;
    for (int k = 0; k < 3 * s.m.nodes; k++) s.x[k] += 0x1p-6;
    check_scene_with(&b, &s, 1, 1, 0);
    assert_int_equal(b.rebuilds, first);
    scene_scatter(&s, 60, 0, 4, 0.25);
    check_scene_with(&b, &s, 1, 1, 0);
    assert_true(b.rebuilds > first);
    tss__broad_free(&b);
    scene_free(&s);
}

static void test_cap(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    int over;
    seed = 400;
    scene s = scene_make(3, 60, 0, 0);
    scene_scatter(&s, 60, 0, 1, 1);
    tss__broad_init(&b, &host);
    assert_int_equal(tss__broad_set_mesh(&b, &s.m), TSS_OK);
    tss__broad_search(&b, s.x, s.d, 1, 0, INT_MAX, &over);
    int total = b.list[0].count + b.list[1].count;
    for (int k = 0; k < 3; k++) {
        int cap = (int[]){total, total - 1, 0}[k];
        assert_int_equal(tss__broad_search(&b, s.x, s.d, 1, 0, cap, &over), TSS_OK);
        assert_int_equal(over, cap < total);
        assert_int_equal(b.list[0].count + b.list[1].count, over ? 0 : total);
    }
    tss__broad_free(&b);
    scene_free(&s);
}

static void test_bad_state(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    int over;
    scene s = scene_make(3, 10, 0, 0);
    scene_scatter(&s, 10, 0, 1, 1);
    tss__broad_init(&b, &host);
    assert_int_equal(tss__broad_search(&b, s.x, s.d, 1, 0, 9, &over), TSS_OK);  // no mesh yet
    assert_int_equal(tss__broad_set_mesh(&b, &s.m), TSS_OK);
    for (int k = 0; k < 3; k++) {
        double keep = s.x[17];
        s.x[17] = k == 0 ? NAN : k == 1 ? INFINITY : 1.7e308;
        if (k == 2) s.d[17] = 1.7e308;
        assert_int_equal(tss__broad_search(&b, s.x, s.d, 1, 0, INT_MAX, &over), TSS_ERROR_BAD_STATE);
        s.x[17] = keep;
    }
    tss__broad_free(&b);
    scene_free(&s);
}

// ---- same bits for any workers and any order of blocks ----

typedef struct pool {
    int workers, shuffle;
    long budget, live;  // allocations before the first failure; < 0: none fails
} pool;

static void shuffled(int blocks, tss_task *task, void *arg, void *ctx) {
    const pool *p = (const pool *)ctx;
    int *order = (int *)get(sizeof(int) * (size_t)blocks);
    for (int i = 0; i < blocks; i++) {
        int k = p->shuffle ? below(i + 1) : i;
        order[i] = order[k], order[k] = i;
    }
    for (int i = 0; i < blocks; i++) task(order[i], below(p->workers), arg);
    free(order);
}

static uint64_t hash(uint64_t h, const void *data, size_t n) {
    for (size_t i = 0; i < n; i++) h = (h ^ ((const unsigned char *)data)[i]) * 1099511628211u;
    return h;
}

// Search, filters and step over a scene in motion: everything that comes out.
static uint64_t fingerprint(const tss_host *host, const scene *s) {
    tss__broad *b = (tss__broad *)get(sizeof *b);
    tss__broad_pairs out = {NULL, 0, 0};
    uint64_t h = 14695981039346656037u;
    int over;
    tss__broad_init(b, host);
    assert_int_equal(tss__broad_set_mesh(b, &s->m), TSS_OK);
    for (int turn = 0; turn < 2; turn++) {
        assert_int_equal(tss__broad_search(b, s->x, s->d, 1, 0.01, INT_MAX, &over), TSS_OK);
        for (int k = 0; k < 2; k++) {
            h = hash(h, b->list[k].pair, sizeof(tss__pair) * (size_t)b->list[k].count);
            assert_int_equal(tss__broad_near(b, k, &b->list[k], s->x, 0.05, &out), TSS_OK);
            h = hash(h, out.pair, sizeof(tss__pair) * (size_t)out.count);
            assert_int_equal(tss__broad_reach(b, k, &b->list[k], s->x, s->d, 1, 0, 0.1, &out),
                             TSS_OK);
            h = hash(h, out.pair, sizeof(tss__pair) * (size_t)out.count);
        }
    }
    tss__broad_pairs_free(host, &out);
    tss__broad_free(b);
    free(b);
    return h;
}

static void test_same_bits(void **state) {
    (void)state;
    seed = 500;
    scene s = scene_sheet(40);
    tss_host host = tss_host_default();
    host.workers = 1;
    uint64_t want = fingerprint(&host, &s);
    for (int w = 2; w < 5; w++) {
        host.workers = w;
        assert_true(fingerprint(&host, &s) == want);
    }
    for (int w = 1; w < 4; w++)
        for (int k = 0; k < 3; k++) {
            pool p = {w, k, -1, 0};
            host.workers = w, host.parallel_for = shuffled, host.parallel_ctx = &p;
            assert_true(fingerprint(&host, &s) == want);
        }
    scene_free(&s);
}

// ---- memory ----

static void *failing_alloc(size_t bytes, size_t align, void *ctx) {
    pool *p = (pool *)ctx;
    if (p->budget == 0) return NULL;
    if (p->budget > 0) p->budget--;
    p->live++;
    return tss__libc_alloc(bytes, align, NULL);
}
static void failing_free(void *ptr, size_t bytes, void *ctx) {
    ((pool *)ctx)->live--;
    memset(ptr, 0xdd, bytes);  // finds wrong sizes under a sanitizer
    tss__libc_free(ptr, bytes, NULL);
}

static void test_no_memory(void **state) {
    (void)state;
    seed = 600;
    scene s = scene_make(3, 30, 5, 10), old = scene_make(3, 8, 0, 0);
    scene_scatter(&s, 30, 5, 1, 0.5), scene_scatter(&old, 8, 0, 1, 0.5);
    pool p = {1, 0, -1, 0};
    tss_host host = tss_host_default();
    host.alloc = failing_alloc, host.free = failing_free, host.memory_ctx = &p;
    static tss__broad b;
    int failed = 0;
    for (long budget = 0;; budget++) {
        tss__broad_pairs out = {NULL, 0, 0};
        int over;
        p.budget = -1;
        tss__broad_init(&b, &host);
        assert_int_equal(tss__broad_set_mesh(&b, &old.m), TSS_OK);
        p.budget = budget;
        tss_result r = tss__broad_set_mesh(&b, &s.m);
        if (r) {
            assert_int_equal(r, TSS_ERROR_NO_MEMORY);
            p.budget = -1;
            check_scene_with(&b, &old, 1, 1, 0);  // unchanged
        } else {
            r = tss__broad_search(&b, s.x, s.d, 1, 0.125, INT_MAX, &over);
            if (!r) r = tss__broad_near(&b, 0, &b.list[0], s.x, 0.1, &out);
            if (r) {
                assert_int_equal(r, TSS_ERROR_NO_MEMORY);
                p.budget = -1;
                check_scene_with(&b, &s, 1, 1, 0.125);
            }
        }
        failed += r != TSS_OK;
        tss__broad_pairs_free(&host, &out);
        tss__broad_free(&b);
        assert_int_equal(p.live, 0);
        if (!r) break;
    }
    assert_true(failed > 20);
    scene_free(&s), scene_free(&old);
}

static void test_no_growth(void **state) {
    (void)state;
    seed = 700;
    scene s = scene_sheet(20);
    pool p = {1, 0, -1, 0};
    tss_host host = tss_host_default();
    host.alloc = failing_alloc, host.free = failing_free, host.memory_ctx = &p;
    static tss__broad b;
    int over;
    tss__broad_init(&b, &host);
    assert_int_equal(tss__broad_set_mesh(&b, &s.m), TSS_OK);
    assert_int_equal(tss__broad_search(&b, s.x, s.d, 1, 0.01, INT_MAX, &over), TSS_OK);
    p.budget = 0;  // from here on nothing is allocated
    for (int k = 0; k < 5; k++) {
        assert_int_equal(tss__broad_search(&b, s.x, s.d, 1 - 0.1 * k, 0.01, INT_MAX, &over), TSS_OK);
        assert_int_equal(tss__broad_set_mesh(&b, &s.m), TSS_OK);
    }
    tss__broad_free(&b);
    scene_free(&s);
}

// ---- near, reach, step against long double ----

typedef struct v3 {
    long double x, y, z;
} v3;
static v3 sub(v3 a, v3 b) { v3 r = {a.x - b.x, a.y - b.y, a.z - b.z}; return r; }
static v3 mad(v3 a, long double s, v3 b) { v3 r = {a.x + s * b.x, a.y + s * b.y, a.z + s * b.z}; return r; }
static long double dot(v3 a, v3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static v3 cross(v3 a, v3 b) {
    v3 r = {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
    return r;
}

// Each feature on its own, then the smallest: nothing in common with the kernels' clamping.
static long double ref_pe(v3 p, v3 a, v3 b) {
    v3 e = sub(b, a), w = sub(p, a), z = sub(p, b);
    long double ee = dot(e, e), s = ee > 0 ? dot(w, e) / ee : -1;
    long double best = fminl(dot(w, w), dot(z, z));
    if (s > 0 && s < 1) {
        v3 u = mad(w, -s, e);
        best = fminl(best, dot(u, u));
    }
    return best;
}
static long double ref_pt(v3 p, v3 a, v3 b, v3 c) {
    long double best = fminl(ref_pe(p, a, b), fminl(ref_pe(p, b, c), ref_pe(p, c, a)));
    v3 n = cross(sub(b, a), sub(c, a)), w = sub(p, a);
    long double nn = dot(n, n), h = dot(w, n);
    if (!(nn > 0)) return best;
    int in = dot(cross(sub(b, a), sub(p, a)), n) >= 0 && dot(cross(sub(c, b), sub(p, b)), n) >= 0 &&
             dot(cross(sub(a, c), sub(p, c)), n) >= 0;
    return in ? fminl(best, h * h / nn) : best;
}
static long double ref_ee(v3 a, v3 b, v3 c, v3 d) {
    long double best = fminl(fminl(ref_pe(a, c, d), ref_pe(b, c, d)),
                             fminl(ref_pe(c, a, b), ref_pe(d, a, b)));
    v3 e = sub(b, a), f = sub(d, c), w = sub(c, a), n = cross(e, f);
    long double nn = dot(n, n);
    if (!(nn > 0)) return best;
    long double s = dot(cross(w, f), n) / nn, t = dot(cross(w, e), n) / nn, h = dot(w, n);
    return s >= 0 && s <= 1 && t >= 0 && t <= 1 ? fminl(best, h * h / nn) : best;
}

static v3 at_time(const scene *s, int node, long double t) {
    int dim = s->m.dim;
    const double *x = s->x + dim * node, *d = s->d + dim * node;
    v3 r = {x[0] + t * d[0], x[1] + t * d[1], dim == 3 ? x[2] + t * d[2] : 0};
    return r;
}

static long double ref_distance(const scene *s, int kind, tss__pair p, long double t) {
    int n[4];
    tss__broad_nodes(&s->m, kind, p, n);
    v3 v[4];
    for (int k = 0; k < 4; k++) v[k] = at_time(s, n[k] < 0 ? n[0] : n[k], t);
    switch (kind) {
        case TSS__BROAD_EE: return sqrtl(ref_ee(v[0], v[1], v[2], v[3]));
        case TSS__BROAD_PT: return sqrtl(ref_pt(v[0], v[1], v[2], v[3]));
        case TSS__BROAD_PE: return sqrtl(ref_pe(v[0], v[1], v[2]));
        default: return sqrtl(dot(sub(v[0], v[1]), sub(v[0], v[1])));
    }
}

// Random scenes with everything that is degenerate: zero-length edges, flat triangles, parallel
// edges, touching pairs, offsets that cost digits.
static scene scene_degenerate(int round) {
    int dim = round % 4 == 3 ? 2 : 3;
    scene s = scene_make(dim, 24, 10, 10);
    int n = dim * s.m.nodes;
    scene_scatter(&s, 24, 10, 1, 0.5);
    if (round % 3 == 1)
        for (int k = 0; k < n; k++) s.x[k] = floor(2 * s.x[k]) / 2;
    for (int k = 0; k < n; k++) {
        if (round % 3 != 1) s.x[k] += uniform(-0.1, 0.1);
        s.d[k] = uniform(-1, 1);
    }
    if (round % 5 == 2)
        for (int k = 0; k < n; k++) s.x[k] += 1000;
    return s;
}

static int find_pair(const tss__broad_pairs *list, tss__pair p, int *from) {
    while (*from < list->count && (list->pair[*from].a < p.a || (list->pair[*from].a == p.a &&
                                                               list->pair[*from].b < p.b)))
        ++*from;
    return *from < list->count && list->pair[*from].a == p.a && list->pair[*from].b == p.b;
}

static void test_near(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    tss__broad_pairs out = {NULL, 0, 0};
    long kept = 0, dropped = 0;
    int over;
    tss__broad_init(&b, &host);
    for (int round = 0; round < 40; round++) {
        seed = (uint64_t)(1000 + round);
        scene s = scene_degenerate(round);
        double r = uniform(0.05, 0.5);
        assert_int_equal(tss__broad_set_mesh(&b, &s.m), TSS_OK);
        assert_int_equal(tss__broad_search(&b, s.x, NULL, 0, 2, INT_MAX, &over), TSS_OK);
        for (int kind = 0; kind < TSS__BROAD_KINDS; kind++) {
            int from = 0;
            assert_int_equal(tss__broad_near(&b, kind, &b.list[kind], s.x, r, &out), TSS_OK);
            for (int i = 0; i < b.list[kind].count; i++) {
                long double d = ref_distance(&s, kind, b.list[kind].pair[i], 0);
                int has = find_pair(&out, b.list[kind].pair[i], &from);
                if (d < r - 1e-9) assert_true(has);  // 1e-8 of the length for parallel edges
                if (d > r + 1e-12) assert_false(has);
                kept += has, dropped += !has;
            }
            // in place: the same
            tss__broad_pairs *own = &b.list[kind];
            assert_int_equal(tss__broad_near(&b, kind, own, s.x, r, own), TSS_OK);
            assert_int_equal(own->count, out.count);
            if (out.count)
                assert_memory_equal(own->pair, out.pair, sizeof(tss__pair) * (size_t)out.count);
        }
        scene_free(&s);
    }
    assert_true(kept > 3000 && dropped > 3000);
    tss__broad_pairs_free(&host, &out);
    tss__broad_free(&b);
}

// Distances that are exact: r itself is not nearer than r, the next number is.
static void test_near_exact(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    tss__broad_pairs out = {NULL, 0, 0};
    int over;
    // a point over a triangle, two crossed segments, each 1/2 apart; two points 1/2 from each other
    static const double x[] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0.25, 0.25, 0.5, 5,   0, 0,  6, 0, 0,
                               5.5, -1, 0.5, 5.5, 1, 0.5, 9, 9, 9, 9, 9, 9.5};
    static const int point[] = {3, 8, 9}, edge[] = {4, 5, 6, 7}, tri[] = {0, 1, 2};
    tss__broad_mesh m = {3, 10, 3, 2, 1, point, edge, tri, NULL, NULL, NULL};
    tss__broad_init(&b, &host);
    assert_int_equal(tss__broad_set_mesh(&b, &m), TSS_OK);
    assert_int_equal(tss__broad_search(&b, x, NULL, 0, 1, INT_MAX, &over), TSS_OK);
    for (int k = 0; k < TSS__BROAD_KINDS; k++) {
        if (k == TSS__BROAD_PE) continue;
        assert_true(b.list[k].count >= 1);
        assert_int_equal(tss__broad_near(&b, k, &b.list[k], x, 0.5, &out), TSS_OK);
        assert_int_equal(out.count, 0);
        assert_int_equal(tss__broad_near(&b, k, &b.list[k], x, 0.5 + 0x1p-50, &out), TSS_OK);
        assert_int_equal(out.count, 1);
    }
    tss__broad_pairs_free(&host, &out);
    tss__broad_free(&b);
}

static void test_reach(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    tss__broad_pairs out = {NULL, 0, 0};
    long kept = 0, dropped = 0, spare = 0;
    int over;
    tss__broad_init(&b, &host);
    for (int round = 0; round < 40; round++) {
        seed = (uint64_t)(2000 + round);
        scene s = scene_degenerate(round);
        double reach = round & 1 ? uniform(0.01, 0.2) : 0, eta = round & 2 ? 0.2 : 0;
        double t = uniform(0.05, 1);
        assert_int_equal(tss__broad_set_mesh(&b, &s.m), TSS_OK);
        assert_int_equal(tss__broad_search(&b, s.x, NULL, 0, 2, INT_MAX, &over), TSS_OK);
        for (int kind = 0; kind < TSS__BROAD_KINDS; kind++) {
            int from = 0;
            assert_int_equal(tss__broad_reach(&b, kind, &b.list[kind], s.x, s.d, t, reach, eta, &out),
                             TSS_OK);
            for (int i = 0; i < b.list[kind].count; i++) {
                tss__pair p = b.list[kind].pair[i];
                int has = find_pair(&out, p, &from), near = 0;
                long double need = reach + eta * ref_distance(&s, kind, p, 0);
                for (int k = 0; k <= 16; k++)
                    near |= ref_distance(&s, kind, p, (long double)t * k / 16) <= need;
                // a dropped pair never comes near
                if (!has) assert_false(near);
                kept += has, dropped += !has, spare += has && !near;
            }
        }
        scene_free(&s);
    }
    assert_true(kept > 3000 && dropped > 3000);
    assert_true(spare < dropped / 4);  // and most of those that never come near are dropped
    tss__broad_pairs_free(&host, &out);
    tss__broad_free(&b);
}

// The step is safe for every pair by sampling, is the largest such to 15 % of the slack, and its
// culprit is the pair that limits it.
static void test_step(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    int over, limited = 0, whole = 0;
    tss__broad_init(&b, &host);
    for (int round = 0; round < 400; round++) {
        seed = (uint64_t)(3000 + round);
        scene s = scene_degenerate(round % 3 == 1 ? round + 1 : round);
        const double slack = 0.1;
        for (int k = 0; k < s.m.dim * s.m.nodes; k++) s.d[k] *= round % 2 ? 0.02 : 0.5;
        assert_int_equal(tss__broad_set_mesh(&b, &s.m), TSS_OK);
        assert_int_equal(tss__broad_search(&b, s.x, s.d, 1, 0, INT_MAX, &over), TSS_OK);
        for (int kind = 0; kind < TSS__BROAD_KINDS; kind++) {
            int culprit = 7;
            const tss__broad_pairs *in = &b.list[kind];
            double t = tss__broad_step(&b, kind, in, s.x, s.d, slack, 0, 1, &culprit);
            assert_true(t >= 0 && t <= 1 && culprit < in->count && (culprit >= 0) == (t < 1));
            for (int i = 0; i < in->count; i++) {
                long double d0 = ref_distance(&s, kind, in->pair[i], 0);
                for (int k = 0; k <= 8; k++) {
                    long double d = ref_distance(&s, kind, in->pair[i], (long double)t * k / 8);
                    assert_true(d >= slack * d0 * (1 - 1e-9L) - 1e-15L);
                    if (t > 0) assert_true(d > 0);
                }
            }
            limited += culprit >= 0, whole += culprit < 0 && in->count > 0;
            if (culprit < 0) continue;
            long double d0 = ref_distance(&s, kind, in->pair[culprit], 0);
            long double d = ref_distance(&s, kind, in->pair[culprit], t);
            assert_true(d <= 1.15L * slack * d0 + 1e-12L);
        }
        scene_free(&s);
    }
    assert_true(limited > 50 && whole > 50);
    tss__broad_free(&b);
}

// A least distance: no pair comes below it (by sampling), pairs already below only part, and a pair above
// it that is not asked to come nearer is not held.
static void test_step_least(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    int edge[4] = {0, 1, 2, 3}, tri[3] = {1, 2, 3}, point[1] = {0}, one[2] = {1, 2}, held = 0, parted = 0;
    seed = 77;
    tss__broad_init(&b, &host);
    for (int i = 0; i < 20000; i++) {
        int kind = i % 3, who;
        double x[12], d[12], least = i % 5 ? uniform(0, .05) : 0;
        for (int k = 0; k < 12; k++) x[k] = uniform(-1, 1), d[k] = uniform(-1, 1);
        tss__broad_mesh m = {3, 4, 1, kind == TSS__BROAD_PE ? 1 : 2, 1, point, kind == TSS__BROAD_PE ? one : edge, tri,
                             NULL, NULL, NULL};
        b.mesh = m;
        tss__pair p = {0, kind == TSS__BROAD_EE};
        tss__broad_pairs in = {&p, 1, 1};
        double d0 = sqrt(tss_ipc_distance((tss_ipc_kind)kind, 3, x, NULL));
        if (i % 7 == 0) least = 2 * d0;
        double t = tss__broad_step(&b, kind, &in, x, d, 0.2, least, 1, &who);
        double floor = fmax(.2 * d0, fmin(least, d0));
        held += t < 1, parted += t > 0 && least > d0;
        for (int k = 0; k <= 32; k++) {
            double y[12];
            for (int q = 0; q < 12; q++) y[q] = x[q] + t * k / 32 * d[q];
            assert_true(sqrt(tss_ipc_distance((tss_ipc_kind)kind, 3, y, NULL)) >= floor * (1 - 1e-6));
        }
    }
    assert_true(held > 2000 && held < 18000 && parted > 200);
    tss__broad_free(&b);
}

// The lanes on the pairs that are hard for them: ends far away, at small distances, moving apart.
static void test_step_apart(void **state) {
    (void)state;
    tss_host host = tss_host_default();
    static tss__broad b;
    int edge[4] = {0, 1, 2, 3}, tri[3] = {1, 2, 3}, point[1] = {0}, one[2] = {1, 2}, stuck = 0, cases = 0;
    seed = 78;
    tss__broad_init(&b, &host);
    for (int i = 0; i < 12000; i++) {
        int kind = i % 3, who, border = i / 3 % 2;
        double c = cos(uniform(0, 6)), s = sin(uniform(0, 6)), x[12], d[12] = {0}, dist = pow(10, uniform(-11, -6));
        double l = sqrt(c * c + s * s + 1), n[3] = {c / l, s / l, 1 / l}, u[3], v[3], un = 0, vn = 0;
        for (int a = 0; a < 3; a++) u[a] = uniform(-1, 1), v[a] = uniform(-1, 1);
        for (int a = 0; a < 3; a++) un += u[a] * n[a], vn += v[a] * n[a];
        for (int a = 0; a < 3; a++) u[a] -= un * n[a], v[a] -= vn * n[a];
        for (int a = 0; a < 3; a++) {
            x[a] = dist * n[a], d[a] = n[a];
            x[3 + a] = -.3 * u[a] - (border ? 0 : .3) * v[a], x[6 + a] = .7 * u[a] - (border ? 0 : .3) * v[a];
            x[9 + a] = border ? .2 * u[a] + v[a] : -.3 * u[a] + .7 * v[a];
            if (kind != TSS__BROAD_EE) continue;
            x[a] -= .4 * u[a], x[3 + a] = dist * n[a] + .6 * u[a], d[3 + a] = n[a];
            x[6 + a] = -.3 * v[a], x[9 + a] = .7 * v[a];
        }
        tss__broad_mesh m = {3, 4, 1, kind == TSS__BROAD_PE ? 1 : 2, 1, point, kind == TSS__BROAD_PE ? one : edge, tri,
                             NULL, NULL, NULL};
        b.mesh = m;
        tss__pair p = {0, kind == TSS__BROAD_EE};
        tss__broad_pairs in = {&p, 1, 1};
        if (!(tss_ipc_distance((tss_ipc_kind)kind, 3, x, NULL) > 0.01 * dist * dist)) continue;
        cases++, stuck += tss__broad_step(&b, kind, &in, x, d, 0.2, 0, 1, &who) == 0;
    }
    print_message("    %d of %d held\n", stuck, cases);
    assert_true(cases > 10000 && stuck < cases / 200);
    tss__broad_free(&b);
}

// ---- the large case ----

static FILE *open_data(const char *name) {
    char path[1024];
    const char *root = getenv("TSS_DATA");
    snprintf(path, sizeof path, "%s/broad_phase/%s", root ? root : "../shared/data", name);
    return fopen(path, "rb");
}

static uint32_t big(const unsigned char *p) {
    return (uint32_t)p[0] << 24 | (uint32_t)p[1] << 16 | (uint32_t)p[2] << 8 | p[3];
}

// Big-endian PLY with float x y z and triangles, as the data is.
static int read_state(const char *name, double **x, int **tri, int *n, int *nt) {
    char line[256];
    unsigned char raw[13];
    FILE *f = open_data(name);
    if (!f) return 0;
    while (fgets(line, sizeof line, f) && strncmp(line, "end_header", 10)) {
        sscanf(line, "element vertex %d", n);
        sscanf(line, "element face %d", nt);
    }
    *x = (double *)get(sizeof(double) * 3 * (size_t)*n), *tri = (int *)get(sizeof(int) * 3 * (size_t)*nt);
    for (int i = 0; i < 3 * *n; i++) {
        float v;
        assert_int_equal(fread(raw, 1, 4, f), 4);
        uint32_t bits = big(raw);
        memcpy(&v, &bits, 4);
        (*x)[i] = (double)v;
    }
    for (int i = 0; i < *nt; i++) {
        assert_int_equal(fread(raw, 1, 13, f), 13);
        for (int c = 0; c < 3; c++) (*tri)[3 * i + c] = (int)big(raw + 1 + 4 * c);
    }
    fclose(f);
    return 1;
}

static int by_edge(const void *a, const void *b) {
    const int *p = (const int *)a, *q = (const int *)b;
    return p[0] != q[0] ? (p[0] < q[0] ? -1 : 1) : (p[1] > q[1]) - (p[1] < q[1]);
}

// Counts of ipc-toolkit (double boxes, no inflation): 5,197,332 edge–edge, 1,655,541 vertex–face.
static void test_large(void **state) {
    (void)state;
    int n, nt, n1, nt1, ne = 0, over;
    double *x, *x1;
    int *tri, *tri1;
    if (!read_state("cloth_ball92.ply", &x, &tri, &n, &nt)) skip();
    if (!read_state("cloth_ball93.ply", &x1, &tri1, &n1, &nt1)) skip();
    assert_int_equal(n, n1);
    int *edge = (int *)get(sizeof(int) * 6 * (size_t)nt), *point = (int *)get(sizeof(int) * (size_t)n);
    for (int i = 0; i < n; i++) point[i] = i;
    for (int i = 0; i < 3 * nt; i++) {
        int a = tri[i], b = tri[i % 3 == 2 ? i - 2 : i + 1];
        edge[2 * i] = a < b ? a : b, edge[2 * i + 1] = a < b ? b : a;
    }
    qsort(edge, 3 * (size_t)nt, 2 * sizeof(int), by_edge);
    for (int i = 0; i < 3 * nt; i++)
        if (!ne || by_edge(edge + 2 * i, edge + 2 * ne - 2)) {
            edge[2 * ne] = edge[2 * i], edge[2 * ne + 1] = edge[2 * i + 1], ne++;
        }
    for (int i = 0; i < 3 * n; i++) x1[i] -= x[i];
    tss_host host = tss_host_default();
    tss__broad *b = (tss__broad *)get(sizeof *b);
    tss__broad_mesh m = {3, n, n, ne, nt, point, edge, tri, NULL, NULL, NULL};
    tss__broad_init(b, &host);
    assert_int_equal(tss__broad_set_mesh(b, &m), TSS_OK);
    for (int turn = 0; turn < 2; turn++) {
        assert_int_equal(tss__broad_search(b, x, x1, 1, 0, INT_MAX, &over), TSS_OK);
        assert_int_equal(b->list[TSS__BROAD_EE].count, 5197332);
        assert_int_equal(b->list[TSS__BROAD_PT].count, 1655541);
    }
    tss__broad_free(b);
    free(b), free(x), free(x1), free(tri), free(tri1), free(edge), free(point);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_random_scenes), cmocka_unit_test(test_shared_nodes),
        cmocka_unit_test(test_odd_scenes),    cmocka_unit_test(test_filters),
        cmocka_unit_test(test_rounding),
        cmocka_unit_test(test_clustered_bodies), cmocka_unit_test(test_near_exact),      cmocka_unit_test(test_refit),
        cmocka_unit_test(test_cap),           cmocka_unit_test(test_bad_state),
        cmocka_unit_test(test_same_bits),     cmocka_unit_test(test_no_memory),
        cmocka_unit_test(test_no_growth),     cmocka_unit_test(test_near),
        cmocka_unit_test(test_reach),         cmocka_unit_test(test_step),
        cmocka_unit_test(test_step_least),    cmocka_unit_test(test_step_apart),
        cmocka_unit_test(test_large),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
