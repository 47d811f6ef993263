/* tss_shapes.h: meshes without files (optional sibling of tss.h; needs tss_io.h for tss_mesh)

   #include "tss.h"
   #include "tss_io.h"
   #include "tss_shapes.h"    // and in one .c file: #define TSS_IMPLEMENTATION before all

   tss_shape_def d = tss_shape_def_default(TSS_SHAPE_TORUS);
   d.cells = 24;
   tss_mesh torus;
   if (tss_shape_make(NULL, &d, &torus) == TSS_OK) { ...; tss_mesh_free(&torus); }

   Solids (tets): tss_shape_make (by kind or name), tss_shape_implicit (any field of your own),
   tss_shape_box, tss_shape_terrain_block. Surfaces: tss_shape_grid, _spike_sheet, _ball_surface,
   _box_surface, _cone_surface. 2D: tss_shape_rectangle, _disc. Segments, points. Transforms.

   CONVENTIONS  y is up. Tets are positive, triangles of closed surfaces and of sheets
   counter-clockwise from outside (above). Shapes by kind are centred near the origin and about 1 m
   across: scale them. Every function overwrites *out (does not free it) and leaves it empty unless
   TSS_OK. Errors: BAD_ARGUMENT (a parameter outside its range, named below), NO_MEMORY, and EMPTY
   (no tet left). host may be NULL. Same arguments, same bits. No globals; safe from several
   threads. */
#ifndef TSS_SHAPES_H
#define TSS_SHAPES_H

#if !defined(TSS_H) || !defined(TSS_IO_H)
#error "include tss.h and tss_io.h before tss_shapes.h"
#endif

#ifdef __cplusplus
extern "C" {
#endif

// ---------------------------------------------------------------------------------------------
// >>shape_solid (public)
// ---------------------------------------------------------------------------------------------

// Negative inside, positive outside, continuous. Only the place of its zero matters, but features
// thinner than the lattice's spacing may be missed.
typedef double tss_shape_field(const double x[3], void *ctx);

// Fills {field < 0} with tets by isosurface stuffing (Labelle & Shewchuk 2007) on a body-centred
// cubic lattice of the given spacing, m. Dihedral angles stay between 10° and 165° whatever the
// field (the smallest met on random fields: 10.5°; inner tets have 60° and 90°). Sharp edges
// come out bevelled by about spacing / 2, and where a gap or wall is thinner than the spacing the
// surface may touch itself (an edge of four faces). The shape must lie inside lower..upper (else
// BAD_ARGUMENT). Cost: one evaluation a lattice node, about 15 more a cut edge; 250 bytes a
// lattice node while it works; at most 2^24 lattice cells.
TSS_API tss_result tss_shape_implicit(const tss_host *host, tss_shape_field *field, void *ctx,
                                      const double lower[3], const double upper[3], double spacing,
                                      tss_mesh *out);

// Kind, name, cells, count, ratio (0: unused). What count and ratio mean:
//   cylinder, capsule: ratio = radius / length    torus: tube radius / overall diameter
//   cone: radius / height    ellipsoid: shortest / longest axis
//   koosh: spikes, their radius    roller: spikes around, their radius    spikes: a side, radius
//   spring: turns, wire radius     peak: ridges, their depth    hull: wall thickness
#define TSS_SHAPES(X)                               \
    X(TSS_SHAPE_BALL, "ball", 16, 0, 0)             \
    X(TSS_SHAPE_ELLIPSOID, "ellipsoid", 20, 0, 0.5) \
    X(TSS_SHAPE_CYLINDER, "cylinder", 20, 0, 0.25)  \
    X(TSS_SHAPE_CAPSULE, "capsule", 24, 0, 0.2)     \
    X(TSS_SHAPE_TORUS, "torus", 24, 0, 0.15)        \
    X(TSS_SHAPE_CONE, "cone", 20, 0, 0.4)           \
    X(TSS_SHAPE_KOOSH, "koosh", 40, 24, 0.06)       \
    X(TSS_SHAPE_ROLLER, "roller", 40, 10, 0.07)     \
    X(TSS_SHAPE_SPIKES, "spikes", 40, 4, 0.08)      \
    X(TSS_SHAPE_SPRING, "spring", 40, 4, 0.06)      \
    X(TSS_SHAPE_ANVIL, "anvil", 30, 0, 0)           \
    X(TSS_SHAPE_MUSHROOM, "mushroom", 24, 0, 0)     \
    X(TSS_SHAPE_FIST, "fist", 24, 0, 0)             \
    X(TSS_SHAPE_HAND, "hand", 40, 0, 0)             \
    X(TSS_SHAPE_PEAK, "peak", 24, 5, 0.08)          \
    X(TSS_SHAPE_HULL, "hull", 40, 0, 0.06)          \
    X(TSS_SHAPE_DINOSAUR, "dinosaur", 40, 0, 0)     \
    X(TSS_SHAPE_ELEPHANT, "elephant", 38, 0, 0)     \
    X(TSS_SHAPE_BUNNY, "bunny", 32, 0, 0)

typedef enum tss_shape_kind {
#define TSS__ENUM(id, name, cells, count, ratio) id,
    TSS_SHAPES(TSS__ENUM)
#undef TSS__ENUM
        TSS_SHAPE_COUNT
} tss_shape_kind;

typedef struct tss_shape_def {
    tss_shape_kind kind;
    int cells;     // lattice cells over 1 m, 4..200; features need about two over their thickness
    int count;     // see the table; 1..200 where used
    double ratio;  // see the table; between 0 and 0.5, ends excluded, where used
    int cookie;    // set by tss_shape_def_default
} tss_shape_def;

TSS_API tss_shape_def tss_shape_def_default(tss_shape_kind kind);
// "ball", "torus", ...; NULL for no kind.
TSS_API const char *tss_shape_name(tss_shape_kind kind);
// The kind of that name, or TSS_SHAPE_COUNT.
TSS_API tss_shape_kind tss_shape_find(const char *name);
// The largest connected piece of the shape's stuffing (tips thinner than the lattice may come off).
TSS_API tss_result tss_shape_make(const tss_host *host, const tss_shape_def *def, tss_mesh *out);

// n[0] × n[1] × n[2] cells of 5 tets (alternating, no direction preferred) or 6 (Kuhn's).
// grade[i] > 0: last cell's size / first's along axis i, geometric; NULL: uniform.
TSS_API tss_result tss_shape_box(const tss_host *host, const double lower[3], const double upper[3],
                                 const int n[3], int split, const double *grade, tss_mesh *out);

// Height, m, above (x, z).
typedef double tss_shape_height(double x, double z, void *ctx);

// A box of 6-tet cells whose top follows height; height must stay above lower[1].
TSS_API tss_result tss_shape_terrain_block(const tss_host *host, const double lower[3],
                                           const double upper[3], const int n[3],
                                           tss_shape_height *height, void *ctx, tss_mesh *out);
// Smooth hills between −1 and 1 with a wave length of about 1: a tss_shape_height without ctx.
TSS_API double tss_shape_hills(double x, double z, void *ctx);

// ---------------------------------------------------------------------------------------------
// >>shape_surface (public)
// Triangles, segments, points: obstacles. Counts >= 1.
// ---------------------------------------------------------------------------------------------

// nx × nz squares over lower..upper (x, z) at y = height(x, z) (NULL: y = 0); diagonals alternate.
TSS_API tss_result tss_shape_grid(const tss_host *host, const double lower[2],
                                  const double upper[2], int nx, int nz, tss_shape_height *height,
                                  void *ctx, tss_mesh *out);
// The same grid at y = 0 with a four-sided spike of the given height over every square.
TSS_API tss_result tss_shape_spike_sheet(const tss_host *host, const double lower[2],
                                         const double upper[2], int nx, int nz, double height,
                                         tss_mesh *out);
// Octahedron with n edges a side on the sphere: 8n² triangles.
TSS_API tss_result tss_shape_ball_surface(const tss_host *host, double radius, int n,
                                          tss_mesh *out);
TSS_API tss_result tss_shape_box_surface(const tss_host *host, const double lower[3],
                                         const double upper[3], const int n[3], tss_mesh *out);
// Closed, base at y = 0, apex at y = height, n >= 3 sides.
TSS_API tss_result tss_shape_cone_surface(const tss_host *host, double radius, double height, int n,
                                          tss_mesh *out);
// rows parallel lines along z, spread over x in lower[0]..upper[0], each of `pieces` segments.
TSS_API tss_result tss_shape_segments(const tss_host *host, const double lower[3],
                                      const double upper[3], int rows, int pieces, tss_mesh *out);
// n[0] × n[1] × n[2] points from lower to upper, ends included (1: in the middle).
TSS_API tss_result tss_shape_points(const tss_host *host, const double lower[3],
                                    const double upper[3], const int n[3], tss_mesh *out);
// 2D: triangles with alternating diagonals; and a disc of n rings of 6, 12, 18, ... nodes.
TSS_API tss_result tss_shape_rectangle(const tss_host *host, const double lower[2],
                                       const double upper[2], int nx, int ny, tss_mesh *out);
TSS_API tss_result tss_shape_disc(const tss_host *host, double radius, int n, tss_mesh *out);

// ---------------------------------------------------------------------------------------------
// >>mesh_transform (public)
// ---------------------------------------------------------------------------------------------

// x ← A x + b, A row-major; a reflection (det A < 0) also turns tets (2D: triangles too) and closed
// surfaces, so that they stay positive.
TSS_API void tss_mesh_transform(tss_mesh *mesh, const double A[9], const double b[3]);
TSS_API void tss_mesh_translate(tss_mesh *mesh, double x, double y, double z);
TSS_API void tss_mesh_scale(tss_mesh *mesh, double x, double y, double z);
// Degrees; R = Rx·Ry·Rz, z first.
TSS_API void tss_mesh_rotate(tss_mesh *mesh, double x, double y, double z);
// All of a, then all of b with its nodes renumbered. a and b stay. BAD_ARGUMENT: different dim.
TSS_API tss_result tss_mesh_merge(const tss_mesh *a, const tss_mesh *b, tss_mesh *out);
// lower > upper without nodes.
TSS_API void tss_mesh_bounds(const tss_mesh *mesh, double lower[3], double upper[3]);
// Smallest and largest angle between two faces of a tet, degrees (0 and 180 for a flat one;
// 180 and 0 without tets).
TSS_API void tss_mesh_dihedral(const tss_mesh *mesh, double *smallest, double *largest);

#ifdef __cplusplus
}
#endif
#endif  // TSS_SHAPES_H

#if defined(TSS_IMPLEMENTATION) && !defined(TSS_SHAPES_IMPLEMENTATION_DONE)
#define TSS_SHAPES_IMPLEMENTATION_DONE

#include <limits.h>
#include <math.h>
#include <string.h>

#if defined(__clang__)
#pragma clang fp contract(off)
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define TSS__SHAPE_PI 3.14159265358979323846
#define TSS__SHAPE_COOKIE 0x7368

// ---------------------------------------------------------------------------------------------
// >>shape_tools (private)
// ---------------------------------------------------------------------------------------------

static double tss__shape_det(const double *a, const double *b, const double *c, const double *d) {
    double u[3], v[3], w[3];
    for (int i = 0; i < 3; i++) u[i] = b[i] - a[i], v[i] = c[i] - a[i], w[i] = d[i] - a[i];
    return u[0] * (v[1] * w[2] - v[2] * w[1]) + u[1] * (v[2] * w[0] - v[0] * w[2]) +
           u[2] * (v[0] * w[1] - v[1] * w[0]);
}

// Makes tet i positive.
static void tss__shape_orient(tss_mesh *m, int i) {
    int *t = m->tet + 4 * (size_t)i;
    const double *x = m->x;
    if (tss__shape_det(x + 3 * (size_t)t[0], x + 3 * (size_t)t[1], x + 3 * (size_t)t[2],
                       x + 3 * (size_t)t[3]) >= 0)
        return;
    int s = t[2];
    t[2] = t[3];
    t[3] = s;
}

static int tss__shape_box_ok(const double *lower, const double *upper, int n) {
    for (int i = 0; i < n; i++)
        if (!(lower[i] < upper[i]) || !(upper[i] - lower[i] < 1e300)) return 0;
    return 1;
}

// Products of counts stay far below 2^29 (a mesh's largest count, four integers a tet).
static int tss__shape_counts_ok(double a, double b, double c, double tets) {
    return a >= 1 && b >= 1 && c >= 1 && a * b * c * tets < 4e8;
}

// ---------------------------------------------------------------------------------------------
// >>stuffing (private)
// Labelle & Shewchuk, "Isosurface stuffing", SIGGRAPH 2007. The BCC lattice has corners (lattice 0)
// and centres (lattice 1); long edges join equals (length h), short ones a centre and a corner
// (√3/2 h); each long edge with the four around it makes 4 tets.
//  1 sign at each lattice node; the zero on each edge whose ends have opposite signs ("cut");
//  2 a node with a cut nearer than alpha·length is moved onto it and counts as zero;
//  3 each tet with something inside is filled by the stencil of its signs.
// The quadrilaterals a stencil leaves on shared faces are split by a rule of the face alone: the
// diagonal ends in the cut of the long edge; if both cut edges are short, in the inner node that is
// even along its long edge (the paper's parity rule).
// ---------------------------------------------------------------------------------------------

// The paper's choice for the uniform lattice, found there by search; smaller values leave short
// edges, larger ones flat tets.
#define TSS__SHAPE_ALPHA_LONG 0.24999
#define TSS__SHAPE_ALPHA_SHORT 0.41189

typedef struct tss__bcc_at {
    int s, i[3];  // lattice and indices
} tss__bcc_at;

typedef struct tss__bcc {
    tss_host host;
    tss_shape_field *field;
    void *ctx;
    int n[3];  // nodes of one lattice along each axis
    size_t N;  // of one lattice
    double h, lower[3];
    double *value;  // 2N; 0 for moved nodes
    double *x;      // 2N × 3
    double *cut;    // 14N: place of the zero on each edge, from its first end
    int *node;      // 2N + 14N: number in the mesh of lattice nodes and cuts, −1: none
    int nodes, tets;
    tss_mesh *out;  // NULL while counting
} tss__bcc;

static size_t tss__bcc_id(const tss__bcc *b, const tss__bcc_at *p) {
    return (size_t)p->s * b->N +
           ((size_t)p->i[2] * (size_t)b->n[1] + (size_t)p->i[1]) * (size_t)b->n[0] +
           (size_t)p->i[0];
}

static tss__bcc_at tss__bcc_at_id(const tss__bcc *b, size_t id) {
    tss__bcc_at p;
    p.s = id >= b->N;
    if (p.s) id -= b->N;
    p.i[0] = (int)(id % (size_t)b->n[0]);
    id /= (size_t)b->n[0];
    p.i[1] = (int)(id % (size_t)b->n[1]);
    p.i[2] = (int)(id / (size_t)b->n[1]);
    return p;
}

// The d-th of 14 neighbours: 6 along the axes, 8 of the other lattice. 0 if there is none.
static int tss__bcc_neighbour(const tss__bcc *b, const tss__bcc_at *p, int d, tss__bcc_at *q) {
    *q = *p;
    if (d < 6) {
        q->i[d / 2] += d % 2 ? -1 : 1;
    } else {
        q->s = !p->s;
        for (int c = 0; c < 3; c++) q->i[c] += (((d - 6) >> c) & 1) - (p->s ? 0 : 1);
    }
    for (int c = 0; c < 3; c++)
        if (q->i[c] < 0 || q->i[c] >= b->n[c]) return 0;
    return 1;
}

static int tss__bcc_long(const tss__bcc *b, size_t p, size_t q) { return (p < b->N) == (q < b->N); }

// An edge's number (0..14N-1) from its ends: long ones belong to the smaller end (3 a node), short
// ones to the centre (8 a centre).
static size_t tss__bcc_edge(const tss__bcc *b, size_t p, size_t q) {
    if (p > q) {
        size_t t = p;
        p = q;
        q = t;
    }
    if (tss__bcc_long(b, p, q)) {
        int axis = q - p == 1 ? 0 : q - p == (size_t)b->n[0] ? 1 : 2;
        return 3 * p + (size_t)axis;
    }
    tss__bcc_at u = tss__bcc_at_id(b, p), v = tss__bcc_at_id(b, q);
    int d = 0;
    for (int c = 0; c < 3; c++) d |= (u.i[c] - v.i[c]) << c;
    return 6 * b->N + 8 * (q - b->N) + (size_t)d;
}

static void tss__bcc_place(const tss__bcc *b, size_t id, double x[3]) {
    tss__bcc_at p = tss__bcc_at_id(b, id);
    for (int c = 0; c < 3; c++) x[c] = b->lower[c] + b->h * (p.i[c] + 0.5 * p.s);
}

// Zero of the field between lattice nodes p < q of opposite signs, as a fraction from p: false
// position (Illinois), and bisection where that is slow. 1e-10 of an edge is far below what a mesh
// shows.
static double tss__bcc_root(const tss__bcc *b, size_t p, size_t q) {
    double xp[3], xq[3], lo = 0, hi = 1, flo = b->value[p], fhi = b->value[q];
    int inside = flo < 0, side = 0;
    tss__bcc_place(b, p, xp);
    tss__bcc_place(b, q, xq);
    for (int k = 0; k < 60 && hi - lo > 1e-10; k++) {
        double t = k % 3 == 2 ? 0.5 * (lo + hi) : lo + (hi - lo) * (flo / (flo - fhi)), x[3];
        if (!(t > lo && t < hi)) t = 0.5 * (lo + hi);
        for (int c = 0; c < 3; c++) x[c] = (1 - t) * xp[c] + t * xq[c];
        double f = b->field(x, b->ctx);
        if (f == 0) return t;
        if ((f < 0) == inside) {
            lo = t, flo = f;
            if (side == 1) fhi *= 0.5;
            side = 1;
        } else {
            hi = t, fhi = f;
            if (side == 2) flo *= 0.5;
            side = 2;
        }
    }
    return 0.5 * (lo + hi);
}

static int tss__bcc_opposite(const tss__bcc *b, size_t p, size_t q) {
    return (b->value[p] < 0 && b->value[q] > 0) || (b->value[p] > 0 && b->value[q] < 0);
}

// Values and places; 0 if the outermost nodes are not all outside.
static int tss__bcc_sample(tss__bcc *b) {
    for (size_t id = 0; id < 2 * b->N; id++) {
        tss__bcc_at p = tss__bcc_at_id(b, id);
        tss__bcc_place(b, id, b->x + 3 * id);
        double v = b->field(b->x + 3 * id, b->ctx);
        if (v - v != 0) v = v < 0 ? -1 : 1;  // inf and nan: only the sign can be used
        b->value[id] = v;
        for (int c = 0; c < 3; c++)
            if (v <= 0 && (p.i[c] == 0 || p.i[c] + 1 + p.s >= b->n[c])) return 0;
    }
    return 1;
}

static void tss__bcc_cuts(tss__bcc *b) {
    for (size_t id = 0; id < 2 * b->N; id++) {
        tss__bcc_at p = tss__bcc_at_id(b, id), q;
        for (int d = 0; d < 14; d++) {
            if (!tss__bcc_neighbour(b, &p, d, &q)) continue;
            size_t other = tss__bcc_id(b, &q);
            if (other > id && tss__bcc_opposite(b, id, other))
                b->cut[tss__bcc_edge(b, id, other)] = tss__bcc_root(b, id, other);
        }
    }
}

// Step 2, in the order of the nodes: the nearest cut that is too near takes the node. Its other
// cuts then vanish, so no cut moves two nodes.
static void tss__bcc_warp(tss__bcc *b) {
    const double edge[2] = {0.5 * sqrt(3.0), 1},
                 alpha[2] = {TSS__SHAPE_ALPHA_SHORT, TSS__SHAPE_ALPHA_LONG};
    for (size_t id = 0; id < 2 * b->N; id++) {
        tss__bcc_at p = tss__bcc_at_id(b, id), q;
        double best = 2, t_best = 0;
        size_t to = 0;
        for (int d = 0; d < 14; d++) {
            if (!tss__bcc_neighbour(b, &p, d, &q)) continue;
            size_t other = tss__bcc_id(b, &q);
            if (!tss__bcc_opposite(b, id, other)) continue;
            double t = b->cut[tss__bcc_edge(b, id, other)];
            int is_long = d < 6;
            if (other < id) t = 1 - t;
            if (t >= alpha[is_long] || t * edge[is_long] >= best) continue;
            best = t * edge[is_long];
            t_best = t;
            to = other;
        }
        if (best > 1) continue;
        double x[3], y[3];
        tss__bcc_place(b, id, x);
        tss__bcc_place(b, to, y);
        for (int c = 0; c < 3; c++) b->x[3 * id + (size_t)c] = (1 - t_best) * x[c] + t_best * y[c];
        b->value[id] = 0;
    }
}

// Numbers are given in the order of first use, while counting; both passes visit alike.
static int tss__bcc_number(tss__bcc *b, size_t slot) {
    if (b->node[slot] < 0) b->node[slot] = b->nodes++;
    return b->node[slot];
}

static int tss__bcc_node(tss__bcc *b, size_t id) { return tss__bcc_number(b, id); }

static int tss__bcc_cut(tss__bcc *b, size_t p, size_t q) {
    return tss__bcc_number(b, 2 * b->N + tss__bcc_edge(b, p, q));
}

static void tss__bcc_emit(tss__bcc *b, int n0, int n1, int n2, int n3) {
    int i = b->tets++;
    if (!b->out) return;
    int *t = b->out->tet + 4 * (size_t)i;
    t[0] = n0, t[1] = n1, t[2] = n2, t[3] = n3;
    tss__shape_orient(b->out, i);
}

// Face with p, q inside and o outside: 1 if the diagonal joins p and the cut q–o, 0 for q and p–o.
static int tss__bcc_diagonal(const tss__bcc *b, size_t p, size_t q, size_t o) {
    int lp = tss__bcc_long(b, p, o), lq = tss__bcc_long(b, q, o);
    if (lp != lq) return lq;
    tss__bcc_at u = tss__bcc_at_id(b, p), v = tss__bcc_at_id(b, q);
    for (int c = 0; c < 3; c++)
        if (u.i[c] != v.i[c]) return u.i[c] % 2 == 0;
    return 1;
}

// A prism with columns (p[i], q[i]); before[i][j]: the diagonal of quad ij is p[i]–q[j]. Without a
// cycle this orders the columns, and three tets fill the prism.
static void tss__bcc_prism(tss__bcc *b, const int p[3], const int q[3], int before[3][3]) {
    int at[3] = {0, 1, 2};
    for (int i = 0; i < 3; i++) {
        int later = 0;
        for (int j = 0; j < 3; j++) later += j != i && before[j][i];
        at[later] = i;
    }
    int i = at[0], j = at[1], k = at[2];
    tss__bcc_emit(b, p[i], p[j], p[k], q[k]);
    tss__bcc_emit(b, p[i], p[j], q[j], q[k]);
    tss__bcc_emit(b, p[i], q[i], q[j], q[k]);
}

static void tss__bcc_set(int before[3][3], int i, int j, int value) {
    before[i][j] = value;
    before[j][i] = !value;
}

static void tss__bcc_three_inside(tss__bcc *b, const size_t in[3], size_t o) {
    int p[3], q[3], before[3][3];
    for (int i = 0; i < 3; i++) {
        p[i] = tss__bcc_node(b, in[i]);
        q[i] = tss__bcc_cut(b, in[i], o);
        for (int j = i + 1; j < 3; j++)
            tss__bcc_set(before, i, j, tss__bcc_diagonal(b, in[i], in[j], o));
    }
    tss__bcc_prism(b, p, q, before);
}

// 1 if nodes i, j are nearer than k, l. While counting, places are not known and do not matter.
static int tss__bcc_shorter(const tss__bcc *b, int i, int j, int k, int l) {
    double ij = 0, kl = 0;
    if (!b->out) return 1;
    const double *x = b->out->x;
    for (int c = 0; c < 3; c++) {
        double u = x[3 * i + c] - x[3 * j + c], v = x[3 * k + c] - x[3 * l + c];
        ij += u * u, kl += v * v;
    }
    return ij <= kl;
}

// a, c inside, o[0], o[1] outside: columns (a, c) and the two pairs of cuts. The quad between the
// cuts lies on the surface: where no cycle forbids it, its shorter diagonal.
static void tss__bcc_two_inside(tss__bcc *b, size_t a, size_t c, const size_t o[2]) {
    int p[3], q[3], before[3][3];
    p[0] = tss__bcc_node(b, a), q[0] = tss__bcc_node(b, c);
    for (int i = 0; i < 2; i++) {
        p[i + 1] = tss__bcc_cut(b, a, o[i]);
        q[i + 1] = tss__bcc_cut(b, c, o[i]);
        tss__bcc_set(before, 0, i + 1, tss__bcc_diagonal(b, a, c, o[i]));
    }
    int free_choice = before[0][1] == before[0][2];
    tss__bcc_set(before, 1, 2,
                 free_choice ? tss__bcc_shorter(b, p[1], q[2], q[1], p[2]) : before[1][0]);
    tss__bcc_prism(b, p, q, before);
}

// One tet of the lattice by the signs of its corners.
static void tss__bcc_tet(tss__bcc *b, const size_t v[4]) {
    size_t in[4], out[4], zero[4];
    int ins = 0, outs = 0, zeros = 0;
    for (int i = 0; i < 4; i++) {
        if (b->value[v[i]] < 0)
            in[ins++] = v[i];
        else if (b->value[v[i]] > 0)
            out[outs++] = v[i];
        else
            zero[zeros++] = v[i];
    }
    if (!ins) return;
    if (!outs) {
        int n[4];
        for (int i = 0; i < 4; i++) n[i] = tss__bcc_node(b, v[i]);
        tss__bcc_emit(b, n[0], n[1], n[2], n[3]);
    } else if (ins == 1) {
        int n[4], k = 0;
        n[k++] = tss__bcc_node(b, in[0]);
        for (int i = 0; i < zeros; i++) n[k++] = tss__bcc_node(b, zero[i]);
        for (int i = 0; i < outs; i++) n[k++] = tss__bcc_cut(b, in[0], out[i]);
        tss__bcc_emit(b, n[0], n[1], n[2], n[3]);
    } else if (ins == 2 && outs == 1) {
        // a pyramid over the quad, its apex the zero node
        int turn = !tss__bcc_diagonal(b, in[0], in[1], out[0]);
        size_t p = in[turn], q = in[!turn];
        int np = tss__bcc_node(b, p), nq = tss__bcc_node(b, q), nz = tss__bcc_node(b, zero[0]);
        int cp = tss__bcc_cut(b, p, out[0]), cq = tss__bcc_cut(b, q, out[0]);
        tss__bcc_emit(b, np, nq, cq, nz);
        tss__bcc_emit(b, np, cq, cp, nz);
    } else if (ins == 2) {
        tss__bcc_two_inside(b, in[0], in[1], out);
    } else {
        tss__bcc_three_inside(b, in, out[0]);
    }
}

// The 4 tets around the long edge from a centre along an axis.
static void tss__bcc_edge_tets(tss__bcc *b, const tss__bcc_at *p, int axis) {
    static const int ring[5][2] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}, {0, 0}};
    size_t v[4];
    tss__bcc_at q = *p;
    v[0] = tss__bcc_id(b, p);
    q.i[axis]++;
    v[1] = tss__bcc_id(b, &q);
    for (int k = 0; k < 4; k++) {
        for (int e = 0; e < 2; e++) {
            q = *p;
            q.s = 0;
            q.i[axis]++;
            q.i[(axis + 1) % 3] += ring[k + e][0];
            q.i[(axis + 2) % 3] += ring[k + e][1];
            v[2 + e] = tss__bcc_id(b, &q);
        }
        tss__bcc_tet(b, v);
    }
}

static void tss__bcc_fill(tss__bcc *b) {
    tss__bcc_at p;
    p.s = 1;
    b->tets = 0;
    for (p.i[2] = 0; p.i[2] + 1 < b->n[2]; p.i[2]++)
        for (p.i[1] = 0; p.i[1] + 1 < b->n[1]; p.i[1]++)
            for (p.i[0] = 0; p.i[0] + 1 < b->n[0]; p.i[0]++)
                for (int axis = 0; axis < 3; axis++) tss__bcc_edge_tets(b, &p, axis);
}

static void tss__bcc_write_nodes(const tss__bcc *b) {
    for (size_t id = 0; id < 2 * b->N; id++) {
        if (b->node[id] >= 0)
            memcpy(b->out->x + 3 * (size_t)b->node[id], b->x + 3 * id, 3 * sizeof(double));
        tss__bcc_at p = tss__bcc_at_id(b, id), q;
        for (int d = 0; d < 14; d++) {
            if (!tss__bcc_neighbour(b, &p, d, &q)) continue;
            size_t other = tss__bcc_id(b, &q);
            if (other < id) continue;
            size_t e = tss__bcc_edge(b, id, other);
            int n = b->node[2 * b->N + e];
            if (n < 0) continue;
            double x[3], y[3], t = b->cut[e];
            tss__bcc_place(b, id, x);
            tss__bcc_place(b, other, y);
            for (int c = 0; c < 3; c++)
                b->out->x[3 * (size_t)n + (size_t)c] = (1 - t) * x[c] + t * y[c];
        }
    }
}

static tss_result tss__bcc_run(tss__bcc *b, tss_mesh *out) {
    if (!b->value || !b->x || !b->cut || !b->node) return TSS_ERROR_NO_MEMORY;
    memset(b->node, 0xff, 16 * b->N * sizeof *b->node);
    if (!tss__bcc_sample(b)) return TSS_ERROR_BAD_ARGUMENT;
    tss__bcc_cuts(b);
    tss__bcc_warp(b);
    tss__bcc_fill(b);
    if (!b->tets) return TSS_ERROR_EMPTY;
    tss_result r = tss_mesh_alloc(&b->host, 3, b->nodes, b->tets, 0, 0, 0, out);
    if (r != TSS_OK) return r;
    b->out = out;
    tss__bcc_write_nodes(b);
    tss__bcc_fill(b);
    return TSS_OK;
}

tss_result tss_shape_implicit(const tss_host *host, tss_shape_field *field, void *ctx,
                              const double lower[3], const double upper[3], double spacing,
                              tss_mesh *out) {
    tss__bcc b;
    double cells = 1;
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!field || !lower || !upper || !tss__shape_box_ok(lower, upper, 3) || !(spacing > 0))
        return TSS_ERROR_BAD_ARGUMENT;
    memset(&b, 0, sizeof b);
    b.host = host ? *host : tss_host_default();
    b.field = field;
    b.ctx = ctx;
    b.h = spacing;
    for (int c = 0; c < 3; c++) {
        // one cell of air below, and one and a half above (centres reach half a cell further)
        double n = ceil((upper[c] - lower[c]) / spacing) + 4;
        cells *= n;
        if (!(cells <= (1 << 24))) return TSS_ERROR_BAD_ARGUMENT;
        b.n[c] = (int)n;
        b.lower[c] = 0.5 * (lower[c] + upper[c]) - 0.5 * spacing * (n - 0.5);
    }
    b.N = (size_t)cells;
    b.value = (double *)tss_alloc(&b.host, 2 * b.N * sizeof(double));
    b.x = (double *)tss_alloc(&b.host, 6 * b.N * sizeof(double));
    b.cut = (double *)tss_alloc(&b.host, 14 * b.N * sizeof(double));
    b.node = (int *)tss_alloc(&b.host, 16 * b.N * sizeof(int));
    tss_result r = tss__bcc_run(&b, out);
    tss_free(&b.host, b.value, 2 * b.N * sizeof(double));
    tss_free(&b.host, b.x, 6 * b.N * sizeof(double));
    tss_free(&b.host, b.cut, 14 * b.N * sizeof(double));
    tss_free(&b.host, b.node, 16 * b.N * sizeof(int));
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>shape_fields (private)
// Fields of the named shapes, about 1 m across. Distances where that is easy, else any function
// with the right zero.
// ---------------------------------------------------------------------------------------------

static double tss__shape_clamp(double v, double low, double high) {
    return v < low ? low : v > high ? high : v;
}

static double tss__shape_norm3(double x, double y, double z) { return sqrt(x * x + y * y + z * z); }

// Cylinder (or disc) about y: radius, half height.
static double tss__field_drum(double x, double y, double z, double radius, double half) {
    double a = sqrt(x * x + z * z) - radius, b = fabs(y) - half;
    return a > b ? a : b;
}

// Box with half sizes, rounded by r.
static double tss__field_box(double x, double y, double z, double a, double b, double c, double r) {
    double u = fabs(x) - a + r, v = fabs(y) - b + r, w = fabs(z) - c + r;
    double inside = u > v ? (u > w ? u : w) : (v > w ? v : w);
    u = u > 0 ? u : 0, v = v > 0 ? v : 0, w = w > 0 ? w : 0;
    return tss__shape_norm3(u, v, w) + (inside < 0 ? inside : 0) - r;
}

// A stick from a to b with radii ra, rb: spikes, fingers, horns.
static double tss__field_stick(const double p[3], const double a[3], const double b[3], double ra,
                               double rb) {
    double along = 0, length = 0, square = 0;
    for (int c = 0; c < 3; c++) {
        along += (p[c] - a[c]) * (b[c] - a[c]);
        length += (b[c] - a[c]) * (b[c] - a[c]);
    }
    double t = tss__shape_clamp(along / length, 0, 1);
    for (int c = 0; c < 3; c++) {
        double d = p[c] - a[c] - t * (b[c] - a[c]);
        square += d * d;
    }
    return sqrt(square) - (ra + t * (rb - ra));
}

// Smooth union: rounded by about k where the two meet.
static double tss__field_blend(double a, double b, double k) {
    double t = tss__shape_clamp(0.5 + 0.5 * (b - a) / k, 0, 1);
    return (1 - t) * b + t * a - k * t * (1 - t);
}

static double tss__shape_least(double a, double b) { return a < b ? a : b; }
static double tss__shape_most(double a, double b) { return a > b ? a : b; }

#define TSS__SHAPE_TIP 0.45  // a spike's tip radius / its foot's

static double tss__field_koosh(const double p[3], const tss_shape_def *d) {
    double f = tss__shape_norm3(p[0], p[1], p[2]) - 0.27, zero[3] = {0, 0, 0}, r = d->ratio;
    for (int i = 0; i < d->count; i++) {
        // Fibonacci's spiral spreads the directions evenly
        double y = 1 - (2 * i + 1.0) / d->count, s = sqrt(1 - y * y), a = 2.399963229728653 * i;
        double l = 0.5 - TSS__SHAPE_TIP * r, tip[3] = {l * s * cos(a), l * y, l * s * sin(a)};
        f = tss__shape_least(f, tss__field_stick(p, zero, tip, 1.3 * r, TSS__SHAPE_TIP * r));
    }
    return f;
}

static double tss__field_roller(const double p[3], const tss_shape_def *d) {
    double f = tss__field_drum(p[0], p[2], p[1], 0.3, 0.4), l = 0.5 - TSS__SHAPE_TIP * d->ratio;
    for (int row = -1; row <= 1; row++)
        for (int i = 0; i < d->count; i++) {
            double a = 2 * TSS__SHAPE_PI * (i + 0.5 * (row & 1)) / d->count;
            double foot[3] = {0.2 * cos(a), 0.2 * sin(a), 0.26 * row};
            double tip[3] = {l * cos(a), l * sin(a), 0.26 * row};
            f = tss__shape_least(
                f, tss__field_stick(p, foot, tip, 1.3 * d->ratio, TSS__SHAPE_TIP * d->ratio));
        }
    return f;
}

static double tss__field_spikes(const double p[3], const tss_shape_def *d) {
    double f = tss__field_box(p[0], p[1] + 0.15, p[2], 0.5, 0.1, 0.5, 0.02);
    // only the nearest spike matters
    double pitch = 1.0 / d->count, x[3] = {0, -0.1, 0}, tip[3] = {0, 0.25, 0};
    for (int c = 0; c < 3; c += 2)
        x[c] = tip[c] =
            (tss__shape_clamp(floor((p[c] + 0.5) / pitch), 0, d->count - 1) + 0.5) * pitch - 0.5;
    tip[1] -= TSS__SHAPE_TIP * d->ratio;
    return tss__shape_least(f,
                            tss__field_stick(p, x, tip, 1.2 * d->ratio, TSS__SHAPE_TIP * d->ratio));
}

// Distance to the helix, from its point at the same angle in the turns next to p.
static double tss__field_spring(const double p[3], const tss_shape_def *d) {
    double R = 0.35, wire = d->ratio, pitch = (1 - 2 * wire) / d->count;
    double angle = atan2(p[2], p[0]), turn = angle / (2 * TSS__SHAPE_PI), best = 1e9;
    double rho = sqrt(p[0] * p[0] + p[2] * p[2]) - R, y = p[1] + 0.5 - wire;
    double slope = 1 / sqrt(1 + pow(pitch / (2 * TSS__SHAPE_PI * R), 2));
    double nearest = floor(y / pitch - turn + 0.5);
    for (int k = -1; k <= 1; k++) {
        double t = nearest + k + turn;
        if (t < 0 || t > d->count) continue;
        double v = (y - pitch * t) * slope;
        best = tss__shape_least(best, sqrt(rho * rho + v * v) - wire);
    }
    // whole turns: both ends of the wire lie at angle 0
    best = tss__shape_least(best, tss__shape_norm3(p[0] - R, y, p[2]) - wire);
    return tss__shape_least(best, tss__shape_norm3(p[0] - R, y - pitch * d->count, p[2]) - wire);
}

static double tss__field_anvil(const double p[3]) {
    const double a[3] = {0.1, 0.14, 0}, b[3] = {0.44, 0.17, 0};
    double f = tss__field_box(p[0], p[1] + 0.25, p[2], 0.28, 0.06, 0.17, 0.02);
    f = tss__field_blend(f, tss__field_box(p[0], p[1] + 0.06, p[2], 0.14, 0.18, 0.1, 0.02), 0.08);
    f = tss__field_blend(f, tss__field_box(p[0] + 0.1, p[1] - 0.15, p[2], 0.36, 0.08, 0.14, 0.02),
                         0.05);
    return tss__field_blend(f, tss__field_stick(p, a, b, 0.1, 0.04), 0.03);
}

static double tss__field_mushroom(const double p[3]) {
    const double foot[3] = {0, -0.32, 0}, top[3] = {0, 0.1, 0};
    double cap = 0.34 * (tss__shape_norm3(p[0] / 0.48, p[1] / 0.34, p[2] / 0.48) - 1);
    cap = tss__shape_most(cap, -p[1]);
    // inset under the cap
    return tss__field_blend(cap, tss__field_stick(p, foot, top, 0.16, 0.11), 0.05);
}

static double tss__field_fist(const double p[3]) {
    const double wrist[3] = {0, -0.35, 0}, palm[3] = {0, -0.1, 0};
    const double root[3] = {-0.2, -0.1, 0.12}, thumb[3] = {0.05, -0.02, 0.24};
    double f = tss__field_stick(p, wrist, palm, 0.14, 0.19);
    f = tss__field_blend(f, tss__field_box(p[0], p[1] - 0.02, p[2], 0.27, 0.2, 0.17, 0.1), 0.1);
    for (int i = 0; i < 4; i++) {
        double x = -0.2 + 0.135 * i, a[3] = {x, 0.22, -0.06}, b[3] = {x, 0.16, 0.16};
        f = tss__field_blend(f, tss__field_stick(p, a, b, 0.085, 0.075), 0.03);
    }
    return tss__field_blend(f, tss__field_stick(p, root, thumb, 0.08, 0.06), 0.03);
}

static double tss__field_hand(const double p[3]) {
    static const double tip[5][3] = {
        {-0.42, 0.0, 0}, {-0.28, 0.3, 0}, {-0.1, 0.44, 0}, {0.1, 0.44, 0}, {0.28, 0.3, 0}};
    double f = tss__field_box(p[0], p[1] + 0.22, p[2], 0.22, 0.22, 0.08, 0.07);
    for (int i = 0; i < 5; i++) {
        double foot[3] = {i ? -0.17 + 0.113 * (i - 1) : -0.1, i ? -0.08 : -0.28, 0};
        f = tss__field_blend(f, tss__field_stick(p, foot, tip[i], 0.05, 0.045), 0.03);
    }
    return f;
}

// An iceberg: a steep cone with ridges, wide under the water line.
static double tss__field_peak(const double p[3], const tss_shape_def *d) {
    double r = sqrt(p[0] * p[0] + p[2] * p[2]), a = atan2(p[2], p[0]), y = p[1] + 0.5;
    double ridge = 1 + d->ratio * (cos(d->count * a) + 0.5 * sin((d->count + 2) * a + 9 * y));
    double width = y < 0.35 ? 0.3 + 0.3 * y : 0.405 * (1 - (y - 0.35) / 0.65);
    return tss__shape_most(tss__shape_most(r - width * ridge, -y), p[1] - 0.42);
}

static double tss__field_hull(const double p[3], const tss_shape_def *d) {
    double t = d->ratio, y = p[1] - 0.1;
    double outer = tss__shape_norm3(p[0] / 0.5, y / 0.3, p[2] / 0.22) - 1;
    double inner = tss__shape_norm3(p[0] / (0.5 - t), y / (0.3 - t), p[2] / (0.22 - t)) - 1;
    return tss__shape_most(tss__shape_most(0.2 * outer, -0.2 * inner), y);
}

static double tss__field_cone(const double p[3], double ratio) {
    double slant = sqrt(p[0] * p[0] + p[2] * p[2]) - ratio * (0.5 - p[1]);
    return tss__shape_most(slant / sqrt(1 + ratio * ratio), -0.5 - p[1]);
}

// Animals look along x and are symmetric in z: p with |z|.

typedef struct tss__limb {
    double a[3], b[3], ra, rb;  // of a stick
    double blend;               // with what was there before
} tss__limb;

static double tss__field_limbs(double f, const double p[3], const tss__limb *limb, int limbs) {
    for (int i = 0; i < limbs; i++) {
        const tss__limb *l = &limb[i];
        f = tss__field_blend(f, tss__field_stick(p, l->a, l->b, l->ra, l->rb), l->blend);
    }
    return f;
}

// Nearly a distance: k0 (k0 - 1) / ‖∇k0²/2‖ with k0² the sum of squares of coordinates over radii.
static double tss__field_egg(const double p[3], const double center[3], const double radius[3]) {
    double k0 = 0, k1 = 0;
    for (int c = 0; c < 3; c++) {
        double u = (p[c] - center[c]) / radius[c];
        k0 += u * u;
        k1 += u * u / (radius[c] * radius[c]);
    }
    k0 = sqrt(k0);
    return k1 > 1e-18 ? k0 * (k0 - 1) / sqrt(k1) : -radius[0];
}

// A sauropod: four legs, a long neck and a longer tail.
static double tss__field_dinosaur(const double p[3]) {
    static const double middle[3] = {-0.01, -0.08, 0}, half[3] = {0.18, 0.125, 0.105};
    static const tss__limb limb[] = {
        {{0.1, -0.04, 0}, {0.235, 0.07, 0}, 0.08, 0.052, 0.06},
        {{0.235, 0.07, 0}, {0.32, 0.26, 0}, 0.052, 0.038, 0.03},
        {{0.32, 0.285, 0}, {0.43, 0.25, 0}, 0.048, 0.034, 0.03},  // head
        {{-0.13, -0.07, 0}, {-0.28, -0.14, 0}, 0.085, 0.05, 0.06},
        {{-0.28, -0.14, 0}, {-0.39, -0.13, 0}, 0.05, 0.035, 0.03},
        {{-0.39, -0.13, 0}, {-0.475, -0.04, 0}, 0.035, 0.024, 0.02},
        {{0.08, -0.12, 0.075}, {0.09, -0.34, 0.085}, 0.053, 0.044, 0.03},
        {{-0.1, -0.12, 0.08}, {-0.1, -0.34, 0.085}, 0.06, 0.046, 0.03}};
    double f = tss__field_egg(p, middle, half);
    f = tss__field_limbs(f, p, limb, (int)(sizeof limb / sizeof *limb));
    return tss__shape_most(f, -0.36 - p[1]);  // flat soles
}

static double tss__field_elephant(const double p[3]) {
    static const double middle[3] = {-0.12, 0.03, 0}, half[3] = {0.25, 0.19, 0.165};
    static const double skull[3] = {0.18, 0.12, 0}, round[3] = {0.125, 0.135, 0.11};
    static const tss__limb limb[] = {
        {{0.25, 0.1, 0}, {0.34, -0.01, 0}, 0.075, 0.055, 0.04},  // trunk
        {{0.34, -0.01, 0}, {0.365, -0.17, 0}, 0.055, 0.045, 0.02},
        {{0.365, -0.17, 0}, {0.4, -0.27, 0}, 0.045, 0.04, 0.02},
        {{0.4, -0.27, 0}, {0.46, -0.29, 0}, 0.04, 0.034, 0.02},
        {{0.22, 0.03, 0.08}, {0.33, -0.09, 0.16}, 0.032, 0.022, 0.015},  // tusk
        {{0.03, -0.05, 0.105}, {0.03, -0.4, 0.11}, 0.08, 0.066, 0.04},
        {{-0.26, -0.05, 0.105}, {-0.26, -0.4, 0.11}, 0.082, 0.068, 0.04},
        {{-0.35, 0.08, 0}, {-0.43, -0.04, 0}, 0.03, 0.024, 0.02},  // tail
        {{-0.43, -0.04, 0}, {-0.44, -0.16, 0}, 0.024, 0.03, 0.01}};
    double f = tss__field_blend(tss__field_egg(p, middle, half), tss__field_egg(p, skull, round), 0.06);
    f = tss__field_limbs(f, p, limb, (int)(sizeof limb / sizeof *limb));
    // The ear: an upright flap that stands off backwards by 35 degrees, in its own axes.
    static const double hinge[3] = {0.12, 0.1, 0.225}, flap[3] = {0.125, 0.15, 0.036}, zero[3] = {0, 0, 0};
    double u = p[0] - hinge[0], w = p[2] - hinge[2];
    double q[3] = {0.57 * u - 0.82 * w, p[1] - hinge[1], 0.82 * u + 0.57 * w};
    f = tss__field_blend(f, tss__field_egg(q, zero, flap), 0.03);
    return tss__shape_most(f, -0.44 - p[1]);
}

// Sitting, ears up.
static double tss__field_bunny(const double p[3]) {
    static const double egg[][2][3] = {{{-0.1, -0.22, 0}, {0.23, 0.21, 0.18}},
                                       {{0.06, -0.15, 0}, {0.13, 0.17, 0.12}},     // chest
                                       {{-0.1, -0.3, 0.13}, {0.15, 0.13, 0.075}},  // haunch
                                       {{0.14, 0.07, 0}, {0.14, 0.12, 0.115}},     // head
                                       {{0.235, 0.045, 0}, {0.07, 0.055, 0.065}}};
    static const tss__limb limb[] = {
        {{0.1, -0.25, 0.085}, {0.18, -0.42, 0.09}, 0.052, 0.048, 0.03},
        {{-0.12, -0.42, 0.15}, {0.03, -0.425, 0.18}, 0.055, 0.045, 0.03},
        {{-0.35, -0.28, 0}, {-0.36, -0.27, 0}, 0.075, 0.075, 0.01}};  // tail
    double f = tss__field_egg(p, egg[0][0], egg[0][1]);
    for (int i = 1; i < 5; i++)
        f = tss__field_blend(f, tss__field_egg(p, egg[i][0], egg[i][1]), i == 2 ? 0.02 : 0.05);
    f = tss__field_limbs(f, p, limb, (int)(sizeof limb / sizeof *limb));
    // The ear: an egg along its own axis, leaning back and out.
    static const double root[3] = {0.03, 0.3, 0.09}, ear[3] = {0.17, 0.038, 0.055}, zero[3] = {0, 0, 0};
    double u = p[0] - root[0], v = p[1] - root[1], w = p[2] - root[2] - 0.25 * v;
    double q[3] = {-0.34 * u + 0.94 * v, 0.94 * u + 0.34 * v, w};
    f = tss__field_blend(f, tss__field_egg(q, zero, ear), 0.03);
    return tss__shape_most(f, -0.45 - p[1]);
}

static double tss__field_of(const double p[3], void *ctx) {
    const tss_shape_def *d = (const tss_shape_def *)ctx;
    double x = p[0], y = p[1], z = p[2], r = d->ratio;
    switch (d->kind) {
        case TSS_SHAPE_BALL:
            return tss__shape_norm3(x, y, z) - 0.5;
        case TSS_SHAPE_ELLIPSOID:
            return r * (tss__shape_norm3(x / 0.5, y / (0.5 * r), z / (0.25 + 0.25 * r)) - 1);
        case TSS_SHAPE_CYLINDER:
            return tss__field_drum(x, y, z, r, 0.5);
        case TSS_SHAPE_CAPSULE: {
            double u = fabs(x) - (0.5 - r);
            return tss__shape_norm3(u > 0 ? u : 0, y, z) - r;
        }
        case TSS_SHAPE_TORUS: {
            double u = sqrt(x * x + z * z) - (0.5 - r);
            return sqrt(u * u + y * y) - r;
        }
        case TSS_SHAPE_CONE:
            return tss__field_cone(p, r);
        case TSS_SHAPE_KOOSH:
            return tss__field_koosh(p, d);
        case TSS_SHAPE_ROLLER:
            return tss__field_roller(p, d);
        case TSS_SHAPE_SPIKES:
            return tss__field_spikes(p, d);
        case TSS_SHAPE_SPRING:
            return tss__field_spring(p, d);
        case TSS_SHAPE_ANVIL:
            return tss__field_anvil(p);
        case TSS_SHAPE_MUSHROOM:
            return tss__field_mushroom(p);
        case TSS_SHAPE_FIST:
            return tss__field_fist(p);
        case TSS_SHAPE_HAND:
            return tss__field_hand(p);
        case TSS_SHAPE_PEAK:
            return tss__field_peak(p, d);
        case TSS_SHAPE_HULL:
            return tss__field_hull(p, d);
        case TSS_SHAPE_DINOSAUR:
        case TSS_SHAPE_ELEPHANT:
        case TSS_SHAPE_BUNNY: {
            const double half[3] = {x, y, fabs(z)};
            return d->kind == TSS_SHAPE_DINOSAUR ? tss__field_dinosaur(half)
                   : d->kind == TSS_SHAPE_ELEPHANT ? tss__field_elephant(half)
                                                   : tss__field_bunny(half);
        }
        case TSS_SHAPE_COUNT:
            break;
    }
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>shape_make (private)
// ---------------------------------------------------------------------------------------------

typedef struct tss__shape_row {
    const char *name;
    int cells, count;
    double ratio;
} tss__shape_row;

static const tss__shape_row tss__shape_table[] = {
#define TSS__SHAPE_ROW(id, name, cells, count, ratio) {name, cells, count, ratio},
    TSS_SHAPES(TSS__SHAPE_ROW)
#undef TSS__SHAPE_ROW
};

tss_shape_def tss_shape_def_default(tss_shape_kind kind) {
    tss_shape_def d;
    memset(&d, 0, sizeof d);
    d.kind = kind;
    d.cookie = TSS__SHAPE_COOKIE;
    if ((unsigned)kind >= TSS_SHAPE_COUNT) return d;
    d.cells = tss__shape_table[kind].cells;
    d.count = tss__shape_table[kind].count;
    d.ratio = tss__shape_table[kind].ratio;
    return d;
}

const char *tss_shape_name(tss_shape_kind kind) {
    return (unsigned)kind < TSS_SHAPE_COUNT ? tss__shape_table[kind].name : NULL;
}

tss_shape_kind tss_shape_find(const char *name) {
    for (int k = 0; name && k < TSS_SHAPE_COUNT; k++)
        if (!strcmp(name, tss__shape_table[k].name)) return (tss_shape_kind)k;
    return TSS_SHAPE_COUNT;
}

static int tss__shape_root(int *parent, int i) {
    while (parent[i] != i) i = parent[i] = parent[parent[i]];
    return i;
}

// Keeps the tets of the component (tets sharing nodes) that has most of them.
static tss_result tss__shape_keep_largest(tss_mesh *m) {
    size_t n = (size_t)m->nodes, bytes = 2 * n * sizeof(int);
    int *parent = (int *)tss_alloc(&m->host, bytes), *size = parent + n, best = 0, kept = 0;
    if (!parent) return TSS_ERROR_NO_MEMORY;
    for (int i = 0; i < m->nodes; i++) parent[i] = i, size[i] = 0;
    for (int t = 0; t < m->tets; t++)
        for (int c = 1; c < 4; c++) {
            int a = tss__shape_root(parent, m->tet[4 * t]),
                b = tss__shape_root(parent, m->tet[4 * t + c]);
            if (a < b)
                parent[b] = a;
            else
                parent[a] = b;
        }
    for (int t = 0; t < m->tets; t++) {
        int r = tss__shape_root(parent, m->tet[4 * t]);
        if (++size[r] > size[best] || (size[r] == size[best] && r < best)) best = r;
    }
    // the new arrays are made first, so that no memory leaves m whole
    tss_mesh fewer;
    tss_result result = TSS_OK;
    if (size[best] < m->tets) {
        result = tss_mesh_alloc(&m->host, 3, m->nodes, size[best], 0, 0, 0, &fewer);
        for (int t = 0; result == TSS_OK && t < m->tets; t++)
            if (tss__shape_root(parent, m->tet[4 * t]) == best)
                memcpy(fewer.tet + 4 * (size_t)kept++, m->tet + 4 * (size_t)t, 4 * sizeof(int));
        if (result == TSS_OK) {
            memcpy(fewer.x, m->x, 3 * n * sizeof(double));
            tss_free(&m->host, parent, bytes);
            tss_mesh_free(m);
            *m = fewer;
            return tss_mesh_drop_unreferenced(m, NULL);
        }
    }
    tss_free(&m->host, parent, bytes);
    return result;
}

tss_result tss_shape_make(const tss_host *host, const tss_shape_def *def, tss_mesh *out) {
    const double lower[3] = {-0.55, -0.55, -0.55}, upper[3] = {0.55, 0.55, 0.55};
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!def || def->cookie != TSS__SHAPE_COOKIE || (unsigned)def->kind >= TSS_SHAPE_COUNT)
        return TSS_ERROR_BAD_ARGUMENT;
    const tss__shape_row *row = &tss__shape_table[def->kind];
    if (def->cells < 4 || def->cells > 200) return TSS_ERROR_BAD_ARGUMENT;
    if (row->count && (def->count < 1 || def->count > 200)) return TSS_ERROR_BAD_ARGUMENT;
    double most = def->kind == TSS_SHAPE_ELLIPSOID ? 1.0000001 : 0.5;
    if (def->kind == TSS_SHAPE_HULL) most = 0.2;
    if (row->ratio > 0 && !(def->ratio > 0 && def->ratio < most)) return TSS_ERROR_BAD_ARGUMENT;
    tss_shape_def copy = *def;
    tss_result r =
        tss_shape_implicit(host, tss__field_of, &copy, lower, upper, 1.0 / def->cells, out);
    if (r == TSS_OK) r = tss__shape_keep_largest(out);
    if (r != TSS_OK) tss_mesh_free(out);
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>shape_box (private)
// A cube's corners are numbered by bits: 1 for x, 2 for y, 4 for z.
// ---------------------------------------------------------------------------------------------

// Place of node i of n+1, where the sizes of the cells form a geometric series with last/first = g.
static double tss__shape_graded(int i, int n, double g) {
    if (n < 2 || g == 1) return (double)i / n;
    double q = pow(g, 1.0 / (n - 1));
    return i == n ? 1 : (pow(q, i) - 1) / (pow(q, n) - 1);
}

static void tss__shape_cube_tets(tss_mesh *m, int at, const int corner[8], int split, int odd) {
    static const int five[2][5][4] = {
        {{0, 3, 5, 6}, {1, 0, 3, 5}, {2, 0, 3, 6}, {4, 0, 5, 6}, {7, 3, 5, 6}},
        {{1, 2, 4, 7}, {0, 1, 2, 4}, {3, 1, 2, 7}, {5, 1, 4, 7}, {6, 2, 4, 7}}};
    static const int six[6][4] = {{0, 1, 3, 7}, {0, 1, 5, 7}, {0, 2, 3, 7},
                                  {0, 2, 6, 7}, {0, 4, 5, 7}, {0, 4, 6, 7}};
    for (int t = 0; t < split; t++) {
        for (int c = 0; c < 4; c++)
            m->tet[4 * (at + t) + c] = corner[split == 5 ? five[odd][t][c] : six[t][c]];
        tss__shape_orient(m, at + t);
    }
}

tss_result tss_shape_box(const tss_host *host, const double lower[3], const double upper[3],
                         const int n[3], int split, const double *grade, tss_mesh *out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!lower || !upper || !n || !tss__shape_box_ok(lower, upper, 3) ||
        (split != 5 && split != 6) || !tss__shape_counts_ok(n[0], n[1], n[2], split))
        return TSS_ERROR_BAD_ARGUMENT;
    for (int c = 0; grade && c < 3; c++)
        if (!(grade[c] >= 1e-3 && grade[c] <= 1e3)) return TSS_ERROR_BAD_ARGUMENT;
    int w = n[0] + 1, wh = w * (n[1] + 1), at = 0;
    tss_result r =
        tss_mesh_alloc(host, 3, wh * (n[2] + 1), n[0] * n[1] * n[2] * split, 0, 0, 0, out);
    if (r != TSS_OK) return r;
    for (int i = 0; i < out->nodes; i++) {
        int p[3] = {i % w, i / w % (n[1] + 1), i / wh};
        for (int c = 0; c < 3; c++) {
            double t = tss__shape_graded(p[c], n[c], grade ? grade[c] : 1);
            out->x[3 * i + c] = (1 - t) * lower[c] + t * upper[c];
        }
    }
    for (int k = 0; k < n[2]; k++)
        for (int j = 0; j < n[1]; j++)
            for (int i = 0; i < n[0]; i++, at += split) {
                int corner[8];
                for (int b = 0; b < 8; b++)
                    corner[b] = i + (b & 1) + w * (j + (b >> 1 & 1)) + wh * (k + (b >> 2));
                tss__shape_cube_tets(out, at, corner, split, (i + j + k) & 1);
            }
    return TSS_OK;
}

tss_result tss_shape_terrain_block(const tss_host *host, const double lower[3],
                                   const double upper[3], const int n[3], tss_shape_height *height,
                                   void *ctx, tss_mesh *out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!height) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_shape_box(host, lower, upper, n, 6, NULL, out);
    if (r != TSS_OK) return r;
    for (int i = 0; i < out->nodes; i++) {
        double *x = out->x + 3 * (size_t)i, top = height(x[0], x[2], ctx);
        if (!(top > lower[1]) || !(top - top == 0)) {
            tss_mesh_free(out);
            return TSS_ERROR_BAD_ARGUMENT;
        }
        x[1] = lower[1] + (x[1] - lower[1]) / (upper[1] - lower[1]) * (top - lower[1]);
    }
    return TSS_OK;
}

double tss_shape_hills(double x, double z, void *ctx) {
    (void)ctx;
    return 0.5 * sin(6.1 * x + 0.4) * cos(5.3 * z) + 0.3 * sin(3.7 * x - 4.3 * z + 1.1) +
           0.2 * cos(9.7 * z + 2.3 * x);
}

// ---------------------------------------------------------------------------------------------
// >>shape_surface (private)
// ---------------------------------------------------------------------------------------------

static void tss__shape_set3(int *t, int a, int b, int c) { t[0] = a, t[1] = b, t[2] = c; }

// The squares' nodes in rows of nx + 1; turn: the other orientation.
static void tss__shape_grid_triangles(tss_mesh *m, int nx, int ny, int turn) {
    int *t = m->triangle;
    for (int j = 0; j < ny; j++)
        for (int i = 0; i < nx; i++, t += 6) {
            int a = i + (nx + 1) * j, b = a + 1, c = a + nx + 1, d = c + 1;
            int p = turn ? c : b, q = turn ? b : c;
            if ((i + j) & 1)
                tss__shape_set3(t, a, p, q), tss__shape_set3(t + 3, p, d, q);
            else
                tss__shape_set3(t, a, p, d), tss__shape_set3(t + 3, a, d, q);
        }
}

static void tss__shape_grid_nodes(tss_mesh *m, const double *lower, const double *upper, int nx,
                                  int ny, int second) {
    for (int i = 0; i < (nx + 1) * (ny + 1); i++) {
        double s = (double)(i % (nx + 1)) / nx, t = (double)(i / (nx + 1)) / ny;
        m->x[3 * i] = (1 - s) * lower[0] + s * upper[0];
        m->x[3 * i + second] = (1 - t) * lower[1] + t * upper[1];
    }
}

static int tss__shape_grid_ok(const double *lower, const double *upper, int nx, int ny,
                              tss_mesh *out) {
    if (!out) return 0;
    memset(out, 0, sizeof *out);
    return lower && upper && tss__shape_box_ok(lower, upper, 2) &&
           tss__shape_counts_ok(nx, ny, 1, 6);
}

tss_result tss_shape_grid(const tss_host *host, const double lower[2], const double upper[2],
                          int nx, int nz, tss_shape_height *height, void *ctx, tss_mesh *out) {
    if (!tss__shape_grid_ok(lower, upper, nx, nz, out)) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_mesh_alloc(host, 3, (nx + 1) * (nz + 1), 0, 2 * nx * nz, 0, 0, out);
    if (r != TSS_OK) return r;
    tss__shape_grid_nodes(out, lower, upper, nx, nz, 2);
    tss__shape_grid_triangles(out, nx, nz, 1);
    for (int i = 0; height && i < out->nodes; i++)
        out->x[3 * i + 1] = height(out->x[3 * i], out->x[3 * i + 2], ctx);
    return TSS_OK;
}

tss_result tss_shape_rectangle(const tss_host *host, const double lower[2], const double upper[2],
                               int nx, int ny, tss_mesh *out) {
    if (!tss__shape_grid_ok(lower, upper, nx, ny, out)) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_mesh_alloc(host, 2, (nx + 1) * (ny + 1), 0, 2 * nx * ny, 0, 0, out);
    if (r != TSS_OK) return r;
    tss__shape_grid_nodes(out, lower, upper, nx, ny, 1);
    tss__shape_grid_triangles(out, nx, ny, 0);
    return TSS_OK;
}

tss_result tss_shape_spike_sheet(const tss_host *host, const double lower[2], const double upper[2],
                                 int nx, int nz, double height, tss_mesh *out) {
    if (!tss__shape_grid_ok(lower, upper, nx, nz, out) || !(height - height == 0))
        return TSS_ERROR_BAD_ARGUMENT;
    int base = (nx + 1) * (nz + 1);
    tss_result r = tss_mesh_alloc(host, 3, base + nx * nz, 0, 4 * nx * nz, 0, 0, out);
    if (r != TSS_OK) return r;
    tss__shape_grid_nodes(out, lower, upper, nx, nz, 2);
    for (int s = 0; s < nx * nz; s++) {
        int a = s % nx + (nx + 1) * (s / nx), ring[4] = {a, a + nx + 1, a + nx + 2, a + 1};
        double *x = out->x + 3 * (size_t)(base + s);
        x[0] = 0.5 * (out->x[3 * a] + out->x[3 * (a + 1)]);
        x[1] = height;
        x[2] = 0.5 * (out->x[3 * a + 2] + out->x[3 * (a + nx + 1) + 2]);
        for (int k = 0; k < 4; k++)
            tss__shape_set3(out->triangle + 12 * s + 3 * k, ring[k], ring[(k + 1) % 4], base + s);
    }
    return TSS_OK;
}

// Node j of row r of the octahedron's 2n + 1 rows, from the pole at the top: row r has 4r (below
// the equator 4(2n − r)) nodes, the poles 1.
static int tss__octa_node(int n, int r, int j) {
    int last = 4 * n * n + 1;
    if (r == 0) return 0;
    if (r == 2 * n) return last;
    if (r <= n) return 1 + 2 * r * (r - 1) + j % (4 * r);
    int s = 2 * n - r;
    return last - 2 * s * (s + 1) + j % (4 * s);
}

static void tss__octa_nodes(tss_mesh *m, double radius, int n) {
    static const int way[5][2] = {{1, 0}, {0, -1}, {-1, 0}, {0, 1}, {1, 0}};
    for (int r = 0; r <= 2 * n; r++) {
        int s = r <= n ? r : 2 * n - r;
        for (int j = 0; j < (s ? 4 * s : 1); j++) {
            int q = s ? j / s : 0, u = s ? j % s : 0;
            double x = (s - u) * way[q][0] + u * way[q + 1][0], y = n - r;
            double z = (s - u) * way[q][1] + u * way[q + 1][1], l = tss__shape_norm3(x, y, z);
            double *p = m->x + 3 * (size_t)tss__octa_node(n, r, j);
            p[0] = radius * (x / l), p[1] = radius * (y / l), p[2] = radius * (z / l);
        }
    }
}

tss_result tss_shape_ball_surface(const tss_host *host, double radius, int n, tss_mesh *out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!(radius > 0) || !(radius < 1e300) || n < 1 || n > 4000) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_mesh_alloc(host, 3, 4 * n * n + 2, 0, 8 * n * n, 0, 0, out);
    if (r != TSS_OK) return r;
    tss__octa_nodes(out, radius, n);
    int *t = out->triangle;
    // the band between rows s and s + 1 of each half, quadrant by quadrant
    for (int half = 0; half < 2; half++)
        for (int s = 0; s < n; s++)
            for (int q = 0; q < 4; q++)
                for (int u = 0; u <= s; u++) {
                    int in = half ? 2 * n - s : s, o = half ? in - 1 : in + 1;
                    int a = tss__octa_node(n, in, q * s + u);
                    int b = tss__octa_node(n, o, q * (s + 1) + u);
                    int c = tss__octa_node(n, o, q * (s + 1) + u + 1);
                    tss__shape_set3(t, a, half ? c : b, half ? b : c);
                    t += 3;
                    if (u == s) continue;
                    int d = tss__octa_node(n, in, q * s + u + 1);
                    tss__shape_set3(t, a, half ? d : c, half ? c : d);
                    t += 3;
                }
    return TSS_OK;
}

tss_result tss_shape_box_surface(const tss_host *host, const double lower[3], const double upper[3],
                                 const int n[3], tss_mesh *out) {
    tss_mesh box;
    tss_result r = tss_shape_box(host, lower, upper, n, 5, NULL, out ? &box : NULL);
    if (out) memset(out, 0, sizeof *out);
    if (r != TSS_OK) return r;
    r = tss_mesh_surface(&box, out);
    tss_mesh_free(&box);
    if (r == TSS_OK) r = tss_mesh_drop_unreferenced(out, NULL);
    if (r != TSS_OK) tss_mesh_free(out);
    return r;
}

tss_result tss_shape_cone_surface(const tss_host *host, double radius, double height, int n,
                                  tss_mesh *out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!(radius > 0) || !(height > 0) || !(radius < 1e300) || !(height < 1e300) || n < 3 ||
        n > 1 << 24)
        return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_mesh_alloc(host, 3, n + 2, 0, 2 * n, 0, 0, out);
    if (r != TSS_OK) return r;
    for (int i = 0; i < n; i++) {
        double a = 2 * TSS__SHAPE_PI * i / n;
        int j = (i + 1) % n;
        out->x[3 * i] = radius * cos(a);
        out->x[3 * i + 2] = radius * sin(a);
        tss__shape_set3(out->triangle + 6 * i, j, i, n);
        tss__shape_set3(out->triangle + 6 * i + 3, i, j, n + 1);
    }
    out->x[3 * n + 1] = height;
    return TSS_OK;
}

tss_result tss_shape_segments(const tss_host *host, const double lower[3], const double upper[3],
                              int rows, int pieces, tss_mesh *out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!lower || !upper || !tss__shape_counts_ok(rows, pieces, 1, 2))
        return TSS_ERROR_BAD_ARGUMENT;
    int line = pieces + 1;
    tss_result r = tss_mesh_alloc(host, 3, rows * line, 0, 0, rows * pieces, 0, out);
    if (r != TSS_OK) return r;
    for (int i = 0; i < out->nodes; i++) {
        double s = rows > 1 ? (double)(i / line) / (rows - 1) : 0.5;
        double t = (double)(i % line) / pieces;
        const double w[3] = {s, s, t};
        for (int c = 0; c < 3; c++) out->x[3 * i + c] = (1 - w[c]) * lower[c] + w[c] * upper[c];
    }
    for (int e = 0; e < out->edges; e++) {
        out->edge[2 * e] = e / pieces * line + e % pieces;
        out->edge[2 * e + 1] = out->edge[2 * e] + 1;
    }
    return TSS_OK;
}

tss_result tss_shape_points(const tss_host *host, const double lower[3], const double upper[3],
                            const int n[3], tss_mesh *out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!lower || !upper || !n || !tss__shape_counts_ok(n[0], n[1], n[2], 1))
        return TSS_ERROR_BAD_ARGUMENT;
    int count = n[0] * n[1] * n[2];
    tss_result r = tss_mesh_alloc(host, 3, count, 0, 0, 0, count, out);
    if (r != TSS_OK) return r;
    for (int i = 0; i < count; i++) {
        int p[3] = {i % n[0], i / n[0] % n[1], i / n[0] / n[1]};
        for (int c = 0; c < 3; c++) {
            double t = n[c] > 1 ? (double)p[c] / (n[c] - 1) : 0.5;
            out->x[3 * i + c] = (1 - t) * lower[c] + t * upper[c];
        }
        out->point[i] = i;
    }
    return TSS_OK;
}

// Node j of ring k (6k nodes; ring 0 is the centre).
static int tss__disc_node(int k, int j) { return k ? 1 + 3 * k * (k - 1) + j % (6 * k) : 0; }

tss_result tss_shape_disc(const tss_host *host, double radius, int n, tss_mesh *out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!(radius > 0) || !(radius < 1e300) || n < 1 || n > 4000) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_mesh_alloc(host, 2, 1 + 3 * n * (n + 1), 0, 6 * n * n, 0, 0, out);
    if (r != TSS_OK) return r;
    int *t = out->triangle;
    for (int k = 1; k <= n; k++)
        for (int j = 0; j < 6 * k; j++) {
            double a = TSS__SHAPE_PI * j / (3 * k), *x = out->x + 3 * tss__disc_node(k, j);
            x[0] = radius * k / n * cos(a);
            x[1] = radius * k / n * sin(a);
            // sector q, place u in it: an outward triangle, and an inward one but for the last
            int q = j / k, u = j % k, in = q * (k - 1) + u;
            tss__shape_set3(t, tss__disc_node(k - 1, in), tss__disc_node(k, j),
                            tss__disc_node(k, j + 1));
            t += 3;
            if (u == k - 1) continue;
            tss__shape_set3(t, tss__disc_node(k - 1, in), tss__disc_node(k, j + 1),
                            tss__disc_node(k - 1, in + 1));
            t += 3;
        }
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>mesh_transform (private)
// ---------------------------------------------------------------------------------------------

void tss_mesh_transform(tss_mesh *m, const double A[9], const double b[3]) {
    const double zero[3] = {0, 0, 0};
    for (size_t i = 0; i < (size_t)m->nodes; i++) {
        double *x = m->x + 3 * i, p[3] = {x[0], x[1], x[2]};
        for (int r = 0; r < 3; r++)
            x[r] = A[3 * r] * p[0] + A[3 * r + 1] * p[1] + A[3 * r + 2] * p[2] + b[r];
    }
    if (!(tss__shape_det(zero, A, A + 3, A + 6) < 0)) return;
    for (size_t i = 0; i < (size_t)m->tets; i++) {
        int *t = m->tet + 4 * i, s = t[2];
        t[2] = t[3], t[3] = s;
    }
    for (size_t i = 0; i < (size_t)m->triangles; i++) {
        int *t = m->triangle + 3 * i, s = t[1];
        t[1] = t[2], t[2] = s;
    }
}

void tss_mesh_translate(tss_mesh *m, double x, double y, double z) {
    const double A[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, b[3] = {x, y, z};
    tss_mesh_transform(m, A, b);
}

void tss_mesh_scale(tss_mesh *m, double x, double y, double z) {
    const double A[9] = {x, 0, 0, 0, y, 0, 0, 0, z}, b[3] = {0, 0, 0};
    tss_mesh_transform(m, A, b);
}

// Multiples of 90° are exact.
static void tss__shape_sincos_degrees(double degrees, double *s, double *c) {
    double r = fmod(degrees, 360);
    if (r < 0) r += 360;
    int quarter = (int)(r / 90);
    double a = (r - 90 * quarter) * (TSS__SHAPE_PI / 180), sa = sin(a), ca = cos(a);
    *s = quarter == 0 ? sa : quarter == 1 ? ca : quarter == 2 ? -sa : -ca;
    *c = quarter == 0 ? ca : quarter == 1 ? -sa : quarter == 2 ? -ca : sa;
}

void tss_mesh_rotate(tss_mesh *m, double x, double y, double z) {
    const double degrees[3] = {x, y, z}, b[3] = {0, 0, 0};
    for (int axis = 2; axis >= 0; axis--) {
        double A[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, s, c;
        int u = (axis + 1) % 3, v = (axis + 2) % 3;
        tss__shape_sincos_degrees(degrees[axis], &s, &c);
        A[4 * u] = A[4 * v] = c;
        A[3 * u + v] = -s;
        A[3 * v + u] = s;
        tss_mesh_transform(m, A, b);
    }
}

static void tss__shape_join(int *to, const int *a, size_t n, const int *b, size_t k, int add) {
    if (n && a) memcpy(to, a, n * sizeof *to);
    for (size_t i = 0; b && i < k; i++) to[n + i] = b[i] + add;
}

tss_result tss_mesh_merge(const tss_mesh *a, const tss_mesh *b, tss_mesh *out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    if (!a || !b || a->dim != b->dim) return TSS_ERROR_BAD_ARGUMENT;
    if ((double)a->nodes + b->nodes > INT_MAX / 4 || (double)a->tets + b->tets > INT_MAX / 4 ||
        (double)a->triangles + b->triangles > INT_MAX / 4 ||
        (double)a->edges + b->edges > INT_MAX / 4 || (double)a->points + b->points > INT_MAX / 4)
        return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_mesh_alloc(&a->host, a->dim, a->nodes + b->nodes, a->tets + b->tets,
                                  a->triangles + b->triangles, a->edges + b->edges,
                                  a->points + b->points, out);
    if (r != TSS_OK) return r;
    size_t an = (size_t)a->nodes, bn = (size_t)b->nodes;
    if (an) memcpy(out->x, a->x, 3 * an * sizeof(double));
    if (bn) memcpy(out->x + 3 * an, b->x, 3 * bn * sizeof(double));
    tss__shape_join(out->node_marker, a->node_marker, an, b->node_marker, bn, 0);
    tss__shape_join(out->tet, a->tet, 4 * (size_t)a->tets, b->tet, 4 * (size_t)b->tets, a->nodes);
    tss__shape_join(out->triangle, a->triangle, 3 * (size_t)a->triangles, b->triangle,
                    3 * (size_t)b->triangles, a->nodes);
    tss__shape_join(out->edge, a->edge, 2 * (size_t)a->edges, b->edge, 2 * (size_t)b->edges,
                    a->nodes);
    tss__shape_join(out->point, a->point, (size_t)a->points, b->point, (size_t)b->points, a->nodes);
    tss__shape_join(out->tet_region, a->tet_region, (size_t)a->tets, b->tet_region, (size_t)b->tets,
                    0);
    tss__shape_join(out->triangle_region, a->triangle_region, (size_t)a->triangles,
                    b->triangle_region, (size_t)b->triangles, 0);
    tss__shape_join(out->edge_region, a->edge_region, (size_t)a->edges, b->edge_region,
                    (size_t)b->edges, 0);
    tss__shape_join(out->point_region, a->point_region, (size_t)a->points, b->point_region,
                    (size_t)b->points, 0);
    return TSS_OK;
}

void tss_mesh_bounds(const tss_mesh *m, double lower[3], double upper[3]) {
    for (int c = 0; c < 3; c++) lower[c] = INFINITY, upper[c] = -INFINITY;
    for (size_t i = 0; i < 3 * (size_t)m->nodes; i++) {
        if (m->x[i] < lower[i % 3]) lower[i % 3] = m->x[i];
        if (m->x[i] > upper[i % 3]) upper[i % 3] = m->x[i];
    }
}

// Angle at the edge a–b between the faces towards c and d.
static double tss__shape_dihedral(const double *a, const double *b, const double *c,
                                  const double *d) {
    double e[3], p[3], q[3], ee = 0, pe = 0, qe = 0, pp = 0, qq = 0, pq = 0;
    for (int i = 0; i < 3; i++) e[i] = b[i] - a[i], p[i] = c[i] - a[i], q[i] = d[i] - a[i];
    for (int i = 0; i < 3; i++) ee += e[i] * e[i], pe += p[i] * e[i], qe += q[i] * e[i];
    if (!(ee > 0)) return 0;
    for (int i = 0; i < 3; i++) p[i] -= pe / ee * e[i], q[i] -= qe / ee * e[i];
    for (int i = 0; i < 3; i++) pp += p[i] * p[i], qq += q[i] * q[i], pq += p[i] * q[i];
    if (!(pp > 0) || !(qq > 0)) return 0;
    return acos(tss__shape_clamp(pq / sqrt(pp * qq), -1, 1)) * (180 / TSS__SHAPE_PI);
}

void tss_mesh_dihedral(const tss_mesh *m, double *smallest, double *largest) {
    static const int pair[6][4] = {{0, 1, 2, 3}, {0, 2, 1, 3}, {0, 3, 1, 2},
                                   {1, 2, 0, 3}, {1, 3, 0, 2}, {2, 3, 0, 1}};
    *smallest = 180;
    *largest = 0;
    for (size_t t = 0; t < (size_t)m->tets; t++)
        for (int k = 0; k < 6; k++) {
            const double *x[4];
            for (int c = 0; c < 4; c++)
                x[c] = m->x + 3 * (size_t)m->tet[4 * t + (size_t)pair[k][c]];
            double a = tss__shape_dihedral(x[0], x[1], x[2], x[3]);
            if (a < *smallest) *smallest = a;
            if (a > *largest) *largest = a;
        }
}

#ifdef __cplusplus
}
#endif
#if !defined(__clang__) && defined(__GNUC__)
#pragma GCC pop_options
#endif
#endif  // TSS_IMPLEMENTATION
