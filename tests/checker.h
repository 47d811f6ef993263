/* checker.h: an independent judge of what tss promises about a motion

   It shares no code and no method with tss_ipc.h. It is handed the mesh and every accepted iterate
   and says whether any state intersects or inverts and whether anything meets, passes through or
   inverts on the straight segments between the states.

       check *c = check_begin(&mesh, x_start);      // mesh: see check_mesh; x: dim x nodes doubles
       check_segment(c, x_prev, x_next);            // from on_iterate, for each accepted iterate
       check_report r = check_end(c);               // r.ok, counts, the first offender by name

   check_state and check_path judge one state and one segment. A report that is not ok describes
   its first offender with check_describe.

   What the verdicts mean
   - state: exact. Touching counts as intersecting: IPC promises strictly positive distances.
   - path clear: proven. Nothing meets at any real t in [0, 1] of x0 + t(x1 - x0), taken in exact
     arithmetic from the doubles given.
   - path collides: proven, by a sign change of the exact orientation while the projections
     cross, or by an exact touch at a time whose positions are doubles.
   - undecided: neither proof was found within the budget; the remaining interval is named.
     A test takes it for a failure (r.ok is 0).

   Limits: coordinates are 0 or 1e-120 <= |x| <= 1e30 (else counted in r.range and not judged).
   Pairs that share a node, wholly kinematic pairs and, without self_contact, pairs of one body are
   ignored. Not for -ffast-math. Memory by malloc. Uses OpenMP for the pairs when compiled
   with it; the report does not depend on the number of threads.

   >>report  >>expansions  >>predicates  >>pairs  >>separation  >>crossing  >>search
   >>inversion  >>tree  >>scene  >>passes  >>recorder                                             */
#ifndef CHECKER_H
#define CHECKER_H

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(__FAST_MATH__)
#error "checker.h proves by rounding errors: compile it without -ffast-math"
#endif
#if defined(FLT_EVAL_METHOD) && FLT_EVAL_METHOD != 0
#error "checker.h needs double arithmetic without extended precision"
#endif
#if defined(__GNUC__) && !defined(__clang__)
#define CHECK__API static __attribute__((unused))
#else
#define CHECK__API static inline
#endif

// ---------------------------------------------------------------------------------------------
// >>report
// ---------------------------------------------------------------------------------------------

#define CHECK_KINDS(X)                                                                            \
    X(CHECK_NOTHING, "nothing")                                                                   \
    X(CHECK_EDGE_TRIANGLE, "edge through triangle")                                               \
    X(CHECK_EDGE_EDGE, "edge on edge")                                                            \
    X(CHECK_POINT_TRIANGLE, "point on triangle")                                                  \
    X(CHECK_POINT_EDGE, "point on edge")                                                          \
    X(CHECK_POINT_HALFSPACE, "point not inside half-space")                                       \
    X(CHECK_INVERSION, "inverted cell")                                                           \
    X(CHECK_BREAK, "segment does not start where the last one ended")                             \
    X(CHECK_RANGE, "coordinate not finite or out of range")

typedef enum check_kind {
#define CHECK__ENUM(id, text) id,
    CHECK_KINDS(CHECK__ENUM)
#undef CHECK__ENUM
        CHECK_KIND_COUNT
} check_kind;

typedef enum check_verdict { CHECK_CLEAR, CHECK_UNDECIDED, CHECK_COLLIDES } check_verdict;

// Return nonzero to leave a pair of primitives out of all judgements.
typedef int check_ignore(const int *a, int na, const int *b, int nb, void *ctx);

// Borrowed until check_end, but for the arrays of points, edges and triangles: those are copied.
typedef struct check_mesh {
    int dim, nodes;
    const double *rest;              // dim x nodes, or NULL: J is then det(edges) itself
    const int *cells;                // dim + 1 nodes a cell: judged for inversion
    const int *triangles;            // 3D: surface and obstacle triangles (their edges are derived)
    const int *edges;                // 2D: the boundary; 3D: loose segments
    const int *points;               // loose points
    int n_cells, n_triangles, n_edges, n_points;
    const double *halfspaces;        // origin, normal (2 dim doubles each); inside is n.(x - o) > 0
    int n_halfspaces;
    const int *body;                 // per node, or NULL: all one body
    const unsigned char *kinematic;  // per node: 1 = moves as told, or NULL: none
    int self_contact;                // 0: pairs within one body are ignored
    check_ignore *ignore;            // or NULL
    void *ignore_ctx;
    double reach;                    // closer pairs are measured; 0: only overlapping boxes
} check_mesh;

typedef struct check_offender {
    check_kind kind;
    check_verdict verdict;
    int on_path;                     // 0: in a state; 1: between two states
    long segment;                    // states: number of segments before it
    int index;                       // cell, half-space or node for the kinds that have one
    int n_nodes, nodes[6];           // first primitive's nodes, then the second's
    int first_nodes;                 // how many belong to the first primitive
    int body[2];                     // -1: none
    double t0, t1;                   // it happens for some t in [t0, t1]
} check_offender;

typedef struct check_report {
    int ok;                          // nothing below was violated and nothing was undecided
    long segments, states;
    long pairs;                      // pairs judged along paths
    long state_pairs;                // pairs judged in states
    long intersections;              // pairs that intersect in a state
    long collisions;                 // pairs proven to meet along a path
    long undecided;
    long halfspaces;                 // points not strictly inside, counted a state
    long inversions;                 // cells with J <= 0, counted a state and a path
    long breaks, range;
    double min_J;                    // smallest over all states (its sign is exact)
    double min_J_path;               // a lower bound of J over all paths
    double distance_low;             // no judged pair came closer along a path (proven), and no
                                     // pair at all came closer than min(distance_low, reach)
    double distance_high;            // some pair did come this close (up to rounding)
    int no_memory;
    check_offender first;
} check_report;

CHECK__API check_report check__report_empty(void) {
    check_report r;
    memset(&r, 0, sizeof r);
    r.min_J = r.min_J_path = r.distance_low = r.distance_high = INFINITY;
    return r;
}

CHECK__API void check__report_close(check_report *r) {
    r->ok = !(r->intersections || r->collisions || r->undecided || r->halfspaces ||
              r->inversions || r->breaks || r->range || r->no_memory);
}

// Adds counts; keeps the first offender of a, else that of b.
CHECK__API void check__report_add(check_report *a, const check_report *b) {
    a->segments += b->segments;
    a->states += b->states;
    a->pairs += b->pairs;
    a->state_pairs += b->state_pairs;
    a->intersections += b->intersections;
    a->collisions += b->collisions;
    a->undecided += b->undecided;
    a->halfspaces += b->halfspaces;
    a->inversions += b->inversions;
    a->breaks += b->breaks;
    a->range += b->range;
    a->min_J = fmin(a->min_J, b->min_J);
    a->min_J_path = fmin(a->min_J_path, b->min_J_path);
    a->distance_low = fmin(a->distance_low, b->distance_low);
    a->distance_high = fmin(a->distance_high, b->distance_high);
    a->no_memory |= b->no_memory;
    if (a->first.kind == CHECK_NOTHING) a->first = b->first;
}

CHECK__API const char *check_kind_text(check_kind k) {
    static const char *const text[] = {
#define CHECK__TEXT(id, words) words,
        CHECK_KINDS(CHECK__TEXT)
#undef CHECK__TEXT
    };
    return (int)k >= 0 && k < CHECK_KIND_COUNT ? text[k] : "?";
}

// One line: what, which nodes of which bodies, in which segment, when. Returns buf.
CHECK__API char *check_describe(const check_report *r, char *buf, size_t size) {
    const check_offender *o = &r->first;
    int used = 0, i;
    if (size == 0) return buf;
    used = snprintf(buf, size, "%s%s", check_kind_text(o->kind),
                    o->verdict == CHECK_UNDECIDED ? " (undecided)" : "");
    for (i = 0; i < o->n_nodes && used > 0 && (size_t)used < size; i++)
        used += snprintf(buf + used, size - (size_t)used, "%s%d", i == 0 ? ": nodes " :
                         i == o->first_nodes ? " | " : " ", o->nodes[i]);
    if (o->kind == CHECK_NOTHING) return buf;
    if (o->body[0] >= 0 && used > 0 && (size_t)used < size)
        used += snprintf(buf + used, size - (size_t)used, o->body[1] >= 0 ? ", bodies %d and %d"
                         : ", body %d", o->body[0], o->body[1]);
    if ((o->kind == CHECK_POINT_HALFSPACE || o->kind == CHECK_INVERSION) && used > 0 &&
        (size_t)used < size)
        used += snprintf(buf + used, size - (size_t)used, ", number %d", o->index);
    if (used > 0 && (size_t)used < size)
        (void)snprintf(buf + used, size - (size_t)used, o->on_path ?
                       ", segment %ld, t in [%.17g, %.17g]" : ", state after %ld segments",
                       o->segment, o->t0, o->t1);
    return buf;
}

// ---------------------------------------------------------------------------------------------
// >>expansions
// A number is the exact sum of nonoverlapping doubles in increasing magnitude (Shewchuk 1997:
// grow-expansion, theorem 10; compress, theorem 23). Its sign is that of its last component.
// Coordinates enter scaled by 2^200, so that no product of three of them under- or overflows
// within the stated range; a number that would not fit sets `bad`, and nothing is concluded.
// ---------------------------------------------------------------------------------------------

#define CHECK__COMPONENTS 192
#define CHECK__SCALE 1.606938044258990275541962092341162602522e60 /* 2^200 */
#define CHECK__TINY 1e-120
#define CHECK__HUGE 1e30

typedef struct check__exp {
    int n, bad;
    double c[CHECK__COMPONENTS];
} check__exp;

CHECK__API double check__two_sum(double a, double b, double *tail) {
    double s = a + b, bv = s - a;
    *tail = (a - (s - bv)) + (b - bv);
    return s;
}

CHECK__API double check__two_product(double a, double b, double *tail) {
    double p = a * b;
    *tail = fma(a, b, -p);
    return p;
}

CHECK__API void check__grow(check__exp *e, double b) {
    double q = b, tail;
    int i, n = 0;
    for (i = 0; i < e->n; i++) {
        q = check__two_sum(q, e->c[i], &tail);
        if (tail != 0) e->c[n++] = tail;
    }
    if (q != 0) {
        if (n < CHECK__COMPONENTS) e->c[n++] = q;
        else e->bad = 1;
    }
    e->n = n;
}

// Fewest components, the largest an approximation of the whole to one ulp.
CHECK__API void check__compress(check__exp *e) {
    double q, tail;
    int i, bottom = e->n - 1, top = 0;
    if (e->n < 2) return;
    q = e->c[bottom];
    for (i = e->n - 2; i >= 0; i--) {
        q = check__two_sum(q, e->c[i], &tail);
        if (tail != 0) {
            e->c[bottom--] = q;
            q = tail;
        }
    }
    e->c[bottom] = q;
    for (i = bottom + 1; i < e->n; i++) {
        q = check__two_sum(e->c[i], q, &tail);
        if (tail != 0) e->c[top++] = tail;
    }
    if (q != 0) e->c[top++] = q;
    e->n = top;
}

CHECK__API void check__exp_set(check__exp *e, double a) {
    e->bad = 0;
    e->n = a != 0;
    e->c[0] = a;
}

// r += s·a
CHECK__API void check__exp_add(check__exp *r, const check__exp *a, double s) {
    double hi, lo;
    int i;
    for (i = 0; i < a->n; i++) {
        hi = check__two_product(a->c[i], s, &lo);
        check__grow(r, lo);
        check__grow(r, hi);
    }
    r->bad |= a->bad;
    check__compress(r);
}

// r += s·a·b, s = ±1
CHECK__API void check__exp_mul_add(check__exp *r, const check__exp *a, const check__exp *b,
                                   double s) {
    double hi, lo;
    int i, j;
    for (i = 0; i < a->n; i++)
        for (j = 0; j < b->n; j++) {
            hi = check__two_product(s * a->c[i], b->c[j], &lo);
            check__grow(r, lo);
            check__grow(r, hi);
        }
    r->bad |= a->bad | b->bad;
    check__compress(r);
}

CHECK__API int check__exp_sign(const check__exp *e) {
    if (e->n == 0) return 0;
    return e->c[e->n - 1] > 0 ? 1 : -1;
}

// The determinant of three rows of expansions, by the first row.
CHECK__API void check__exp_det(check__exp *r, const check__exp *a, const check__exp *b,
                               const check__exp *c) {
    int k;
    check__exp_set(r, 0);
    for (k = 0; k < 3; k++) {
        int i = (k + 1) % 3, j = (k + 2) % 3;
        check__exp m;
        check__exp_set(&m, 0);
        check__exp_mul_add(&m, &b[i], &c[j], 1);
        check__exp_mul_add(&m, &b[j], &c[i], -1);
        check__exp_mul_add(r, &a[k], &m, 1);
    }
}

// ---------------------------------------------------------------------------------------------
// >>predicates
// Exact signs and closed intersection tests. A filter with a forward error bound decides almost
// always (Shewchuk's constants A); else expansions. Coplanar cases: a plane is mapped injectively
// by at least one of the three coordinate projections and no projection loses an intersection,
// so coplanar sets meet in space if and only if they meet in all three projections. A degenerate
// triangle is the union of its edges.
// ---------------------------------------------------------------------------------------------

#define CHECK__U (DBL_EPSILON / 2) /* unit roundoff */

CHECK__API void check__exp_diff(check__exp *r, double a, double b) {
    check__exp_set(r, a * CHECK__SCALE);
    check__grow(r, -b * CHECK__SCALE);
}

// Sign of the area of a, b, c: +1 anticlockwise, 0 collinear.
CHECK__API int check_orient2d(const double *a, const double *b, const double *c) {
    double l = (a[0] - c[0]) * (b[1] - c[1]), r = (a[1] - c[1]) * (b[0] - c[0]);
    double bound = (3 + 16 * CHECK__U) * CHECK__U * (fabs(l) + fabs(r));
    check__exp e[5];
    // Below 1e-250 a product may have lost digits to underflow, which the bound does not cover.
    if (fabs(l) + fabs(r) > 1e-250 && fabs(l - r) > bound) return l > r ? 1 : -1;
    check__exp_diff(&e[0], a[0], c[0]);
    check__exp_diff(&e[1], b[1], c[1]);
    check__exp_diff(&e[2], a[1], c[1]);
    check__exp_diff(&e[3], b[0], c[0]);
    check__exp_set(&e[4], 0);
    check__exp_mul_add(&e[4], &e[0], &e[1], 1);
    check__exp_mul_add(&e[4], &e[2], &e[3], -1);
    return check__exp_sign(&e[4]);
}

CHECK__API int check__orient3d_exact(const double *a, const double *b, const double *c,
                                     const double *d) {
    check__exp u[3], v[3], w[3], r;
    int k;
    for (k = 0; k < 3; k++) {
        check__exp_diff(&u[k], b[k], a[k]);
        check__exp_diff(&v[k], c[k], a[k]);
        check__exp_diff(&w[k], d[k], a[k]);
    }
    check__exp_det(&r, u, v, w);
    return check__exp_sign(&r);
}

// Sign of det(b - a, c - a, d - a): +1 for a tet of positive volume, 0 coplanar.
CHECK__API int check_orient3d(const double *a, const double *b, const double *c, const double *d) {
    double u[3], v[3], w[3], det = 0, size = 0;
    int k;
    for (k = 0; k < 3; k++) u[k] = b[k] - a[k], v[k] = c[k] - a[k], w[k] = d[k] - a[k];
    for (k = 0; k < 3; k++) {
        int i = (k + 1) % 3, j = (k + 2) % 3;
        double p = v[i] * w[j], q = v[j] * w[i];
        det += u[k] * (p - q);
        size += fabs(u[k]) * (fabs(p) + fabs(q));
    }
    // (7 + 56u)u is the bound for this order of operations; 8u leaves room for `size` itself.
    if (size > 1e-250 && fabs(det) > 8 * CHECK__U * size) return det > 0 ? 1 : -1;
    return check__orient3d_exact(a, b, c, d);
}

CHECK__API int check__between(double a, double b, double p) {
    return (a <= p && p <= b) || (b <= p && p <= a);
}

CHECK__API int check_point_on_segment2d(const double *p, const double *a, const double *b) {
    return check__between(a[0], b[0], p[0]) && check__between(a[1], b[1], p[1]) &&
           check_orient2d(a, b, p) == 0;
}

CHECK__API int check_segments_meet2d(const double *a, const double *b, const double *c,
                                     const double *d) {
    if (check_orient2d(a, b, c) * check_orient2d(a, b, d) < 0 &&
        check_orient2d(c, d, a) * check_orient2d(c, d, b) < 0)
        return 1;
    // Otherwise they meet only if an end of one lies on the other.
    return check_point_on_segment2d(a, c, d) || check_point_on_segment2d(b, c, d) ||
           check_point_on_segment2d(c, a, b) || check_point_on_segment2d(d, a, b);
}

CHECK__API int check__point_in_triangle2d(const double *p, const double *a, const double *b,
                                          const double *c) {
    int s = check_orient2d(a, b, p);
    if (s != 0 && check_orient2d(b, c, p) == s && check_orient2d(c, a, p) == s) return 1;
    return check_point_on_segment2d(p, a, b) || check_point_on_segment2d(p, b, c) ||
           check_point_on_segment2d(p, c, a);
}

// Drops coordinate k of n points in space.
CHECK__API void check__project(const double *const *x, int n, int k, double (*y)[2]) {
    int i;
    for (i = 0; i < n; i++) {
        y[i][0] = x[i][(k + 1) % 3];
        y[i][1] = x[i][(k + 2) % 3];
    }
}

CHECK__API int check_segments_meet3d(const double *a, const double *b, const double *c,
                                     const double *d) {
    const double *x[4];
    double y[4][2];
    int k;
    if (check_orient3d(a, b, c, d) != 0) return 0;
    x[0] = a, x[1] = b, x[2] = c, x[3] = d;
    for (k = 0; k < 3; k++) {
        check__project(x, 4, k, y);
        if (!check_segments_meet2d(y[0], y[1], y[2], y[3])) return 0;
    }
    return 1;
}

CHECK__API int check_point_on_triangle(const double *p, const double *a, const double *b,
                                       const double *c) {
    const double *x[4];
    double y[4][2];
    int k;
    if (check_orient3d(a, b, c, p) != 0) return 0;
    x[0] = p, x[1] = a, x[2] = b, x[3] = c;
    for (k = 0; k < 3; k++) {
        check__project(x, 4, k, y);
        if (!check__point_in_triangle2d(y[0], y[1], y[2], y[3])) return 0;
    }
    return 1;
}

CHECK__API int check_segment_meets_triangle(const double *p, const double *q, const double *a,
                                            const double *b, const double *c) {
    int sp = check_orient3d(a, b, c, p), sq = check_orient3d(a, b, c, q), s0, s1, s2;
    if (sp * sq > 0) return 0;
    // All five in one plane, or a degenerate triangle.
    if (sp == 0 && sq == 0)
        return check_segments_meet3d(p, q, a, b) || check_segments_meet3d(p, q, b, c) ||
               check_segments_meet3d(p, q, c, a) || check_point_on_triangle(p, a, b, c);
    // The line meets the plane in one point: on which side of the three edges does it pass?
    s0 = check_orient3d(p, q, a, b);
    s1 = check_orient3d(p, q, b, c);
    s2 = check_orient3d(p, q, c, a);
    return (s0 >= 0 && s1 >= 0 && s2 >= 0) || (s0 <= 0 && s1 <= 0 && s2 <= 0);
}

// Sign of n·(x - o).
CHECK__API int check_side(int dim, const double *x, const double *o, const double *n) {
    check__exp r, d;
    double h = 0, m = 0;
    int k;
    for (k = 0; k < dim; k++) {
        double s = n[k] * (x[k] - o[k]);
        h += s;
        m += fabs(s);
    }
    // Difference, product, two sums: 4u.
    if (fabs(h) > 6 * CHECK__U * m + 1e-300) return h > 0 ? 1 : -1;
    check__exp_set(&r, 0);
    for (k = 0; k < dim; k++) {
        check__exp_diff(&d, x[k], o[k]);
        check__exp_add(&r, &d, n[k]);
    }
    return check__exp_sign(&r);
}

// ---------------------------------------------------------------------------------------------
// >>pairs
// Two primitives with linear motion: vertices 0 … na-1 are the first's, the rest the second's.
// 2D lives in the plane z = 0. x[0] and x[1] are the positions at t = 0 and t = 1.
// ---------------------------------------------------------------------------------------------

typedef struct check__pair {
    int dim, na, nb;
    double x[2][5][3];
} check__pair;

typedef struct check__answer {
    check_verdict verdict;
    double t0, t1;      // where, if not clear
    double low, high;   // the distance along the path is >= low and somewhere <= high
} check__answer;

typedef struct check__bernstein { check__exp c[4]; } check__bernstein;

// Signed heights at t of vertex i over vertex j along n, ends first; m bounds the summands.
CHECK__API void check__heights(const check__pair *p, const double *n, int i, int j, double *h,
                               double *m) {
    int e, k;
    for (e = 0; e < 2; e++) {
        h[e] = m[e] = 0;
        for (k = 0; k < 3; k++) {
            double s = n[k] * (p->x[e][i][k] - p->x[e][j][k]);
            h[e] += s;
            m[e] += fabs(s);
        }
    }
}

// Positions at t, exactly: (1 - t)·(x_i - x_j)(0) + t·(x_i - x_j)(1). t and 1 - t are doubles.
CHECK__API void check__row_exact(check__exp *r, const check__pair *p, int i, int j, double t) {
    check__exp d;
    int e, k;
    for (k = 0; k < 3; k++) {
        check__exp_set(&r[k], 0);
        for (e = 0; e < 2; e++) {
            check__exp_diff(&d, p->x[e][i][k], p->x[e][j][k]);
            check__exp_add(&r[k], &d, e ? t : 1 - t);
        }
    }
}

// Three rows whose determinant vanishes where the pair is coplanar (2D: collinear).
CHECK__API void check__rows_exact(check__exp (*r)[3], const check__pair *p, double t) {
    int k;
    if (p->dim == 3) {
        for (k = 0; k < 3; k++) check__row_exact(r[k], p, k + 1, 0, t);
        return;
    }
    check__row_exact(r[0], p, 1, 0, t);
    check__row_exact(r[1], p, 2, 0, t);
    for (k = 0; k < 3; k++) check__exp_set(&r[2][k], k == 2);
}

// The same rows in double, and a bound of the determinant's rounding error: three rows of at most
// 4u relative to their 1-norms w (difference, two products, sum), 7u for the determinant.
CHECK__API double check__rows(double (*r)[3], const check__pair *p, double t) {
    double bound = 32 * CHECK__U;
    int i, k;
    // The 2D row e_z stays.
    memset(r, 0, 9 * sizeof(double));
    r[2][2] = 1;
    for (i = 0; i < p->dim; i++) {
        double w = 0;
        for (k = 0; k < 3; k++) {
            double a = (1 - t) * (p->x[0][i + 1][k] - p->x[0][0][k]);
            double b = t * (p->x[1][i + 1][k] - p->x[1][0][k]);
            r[i][k] = a + b;
            w += fabs(a) + fabs(b);
        }
        bound *= w;
    }
    return bound + 1e-290;
}

CHECK__API double check__det(const double *a, const double *b, const double *c) {
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) +
           a[2] * (b[0] * c[1] - b[1] * c[0]);
}

CHECK__API int check__pair_orient(const check__pair *p, double t) {
    double r[3][3], bound = check__rows(r, p, t), det = check__det(r[0], r[1], r[2]);
    check__exp e[3][3], d;
    if (fabs(det) > bound) return det > 0 ? 1 : -1;
    check__rows_exact(e, p, t);
    check__exp_det(&d, e[0], e[1], e[2]);
    return check__exp_sign(&d);
}

// Three times the Bernstein coefficients on [t0, t1] of the determinant of linear rows: c0 and c3
// at the ends, c1 and c2 the sums over which row is taken at the other end.
CHECK__API void check__bernstein_exact(check__bernstein *b, check__exp (*u)[3],
                                       check__exp (*v)[3]) {
    check__exp d;
    int m, k;
    for (k = 0; k < 4; k++) check__exp_set(&b->c[k], 0);
    for (m = 0; m < 8; m++) {
        int ends = (m & 1) + (m >> 1 & 1) + (m >> 2 & 1);
        check__exp_det(&d, m & 1 ? v[0] : u[0], m & 2 ? v[1] : u[1], m & 4 ? v[2] : u[2]);
        check__exp_add(&b->c[ends], &d, ends == 0 || ends == 3 ? 3 : 1);
    }
}

// ---------------------------------------------------------------------------------------------
// >>separation
// Proof of "clear" on [t0, t1]: along a fixed direction n, every vertex of the first primitive
// stays above every vertex of the second. Heights are linear in t, so both ends suffice; the
// hulls stay separated by the smallest height over |n|. Any n is sound: it is only a guess.
// ---------------------------------------------------------------------------------------------

// 1 and a lower bound of the distance, if the rounding errors cannot hide a contact.
CHECK__API int check__separated(const check__pair *p, const double *n, double t0, double t1,
                                double *low) {
    double least = INFINITY, h[2], m[2], norm;
    int i, j, e;
    for (i = 0; i < p->na; i++)
        for (j = p->na; j < p->na + p->nb; j++) {
            check__heights(p, n, i, j, h, m);
            for (e = 0; e < 2; e++) {
                double t = e ? t1 : t0, v = (1 - t) * h[0] + t * h[1];
                // 5u for a height (difference, product, two sums), 2u to interpolate, 1u spare.
                v -= 8 * CHECK__U * ((1 - t) * m[0] + t * m[1]) + 1e-300;
                if (!(v > 0)) return 0;
                least = fmin(least, v);
            }
        }
    norm = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) * (1 + 8 * CHECK__U);
    *low = least / norm * (1 - 4 * CHECK__U);
    return 1;
}

CHECK__API int check__separated_exact(const check__pair *p, const double *n, double t0, double t1) {
    check__exp r[3], s;
    double g[3];
    int i, j, e, k;
    // Any direction will do: one without entries whose products could underflow.
    for (k = 0; k < 3; k++) g[k] = fabs(n[k]) < 1e-100 ? 0 : n[k];
    for (i = 0; i < p->na; i++)
        for (j = p->na; j < p->na + p->nb; j++)
            for (e = 0; e < 2; e++) {
                check__row_exact(r, p, i, j, e ? t1 : t0);
                check__exp_set(&s, 0);
                for (k = 0; k < 3; k++) check__exp_add(&s, &r[k], g[k]);
                if (s.bad || check__exp_sign(&s) <= 0) return 0;
            }
    return 1;
}

// Never coplanar on [t0, t1]: all exact Bernstein coefficients have one strict sign.
CHECK__API int check__never_coplanar(const check__pair *p, double t0, double t1) {
    check__exp u[3][3], v[3][3];
    check__bernstein b;
    int k, s;
    check__rows_exact(u, p, t0);
    check__rows_exact(v, p, t1);
    check__bernstein_exact(&b, u, v);
    s = check__exp_sign(&b.c[0]);
    for (k = 0; k < 4; k++)
        if (b.c[k].bad || s == 0 || check__exp_sign(&b.c[k]) != s) return 0;
    return 1;
}

CHECK__API double check__dot(const double *a, const double *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

CHECK__API void check__cross(const double *a, const double *b, double *c) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

CHECK__API double check__clamp(double t) { return t > 0 ? t < 1 ? t : 1 : 0; }

// From the nearest point of segment a b to p.
CHECK__API void check__near_segment(const double *p, const double *a, const double *b, double *n) {
    double d[3], r[3], l, s;
    int k;
    for (k = 0; k < 3; k++) d[k] = b[k] - a[k], r[k] = p[k] - a[k];
    l = check__dot(d, d);
    s = l > 0 ? check__clamp(check__dot(r, d) / l) : 0;
    for (k = 0; k < 3; k++) n[k] = r[k] - s * d[k];
}

// Keeps the shorter of two vectors.
CHECK__API void check__shorter(double *n, const double *m) {
    if (check__dot(m, m) < check__dot(n, n)) memcpy(n, m, 3 * sizeof *n);
}

CHECK__API void check__near_triangle(const double *p, const double *a, const double *b,
                                     const double *c, double *n) {
    double u[3], v[3], r[3], w[3], q[3], ww, s, t;
    int k;
    for (k = 0; k < 3; k++) u[k] = b[k] - a[k], v[k] = c[k] - a[k], r[k] = p[k] - a[k];
    check__cross(u, v, w);
    ww = check__dot(w, w);
    check__cross(r, v, q);
    s = check__dot(q, w);
    check__cross(u, r, q);
    t = check__dot(q, w);
    // Over the face: the normal component; else the nearest of the three edges.
    if (ww > 0 && s >= 0 && t >= 0 && s + t <= ww) {
        double h = check__dot(r, w) / ww;
        for (k = 0; k < 3; k++) n[k] = h * w[k];
        return;
    }
    check__near_segment(p, a, b, n);
    check__near_segment(p, b, c, q);
    check__shorter(n, q);
    check__near_segment(p, c, a, q);
    check__shorter(n, q);
}

// From the nearest point of segment c d to that of a b: inner solution, else the four ends.
CHECK__API void check__near_segments(const double *a, const double *b, const double *c,
                                     const double *d, double *n) {
    double u[3], v[3], r[3], m[3], uu, uv, vv, ur, vr, det;
    int k;
    for (k = 0; k < 3; k++) u[k] = b[k] - a[k], v[k] = d[k] - c[k], r[k] = a[k] - c[k];
    uu = check__dot(u, u), uv = check__dot(u, v), vv = check__dot(v, v);
    ur = check__dot(u, r), vr = check__dot(v, r);
    det = uu * vv - uv * uv;
    n[0] = n[1] = n[2] = INFINITY;
    if (det > 0) {
        double s = uv * vr - vv * ur, t = uu * vr - uv * ur;
        if (s >= 0 && s <= det && t >= 0 && t <= det) {
            for (k = 0; k < 3; k++) n[k] = r[k] + s / det * u[k] - t / det * v[k];
            // Near parallel (sine below 1e-4) s and t lose half their digits: try the ends too.
            if (det > 1e-8 * uu * vv) return;
        }
    }
    check__near_segment(a, c, d, m);
    check__shorter(n, m);
    check__near_segment(b, c, d, m);
    check__shorter(n, m);
    check__near_segment(c, a, b, m);
    for (k = 0; k < 3; k++) m[k] = -m[k];
    check__shorter(n, m);
    check__near_segment(d, a, b, m);
    for (k = 0; k < 3; k++) m[k] = -m[k];
    check__shorter(n, m);
}

// Guesses at t: n[0] along the shortest connection, n[1] normal to both, turned to the first.
// Returns the distance.
CHECK__API double check__directions(const check__pair *p, double t, double (*n)[3]) {
    double y[4][3], u[3], v[3];
    int i, k, count = p->na + p->nb, tri = p->nb == 3;
    for (i = 0; i < count; i++)
        for (k = 0; k < 3; k++)
            y[i][k] = (1 - t) * (p->x[0][i][k] - p->x[0][0][k]) +
                      t * (p->x[1][i][k] - p->x[1][0][k]);
    if (tri) check__near_triangle(y[0], y[1], y[2], y[3], n[0]);
    else if (p->na == 2) check__near_segments(y[0], y[1], y[2], y[3], n[0]);
    else check__near_segment(y[0], y[1], y[2], n[0]);
    if (count == 4) {
        for (k = 0; k < 3; k++) u[k] = tri ? y[2][k] - y[1][k] : y[1][k] - y[0][k];
        for (k = 0; k < 3; k++) v[k] = tri ? y[3][k] - y[1][k] : y[3][k] - y[2][k];
        check__cross(u, v, n[1]);
    } else {
        n[1][0] = y[1][1] - y[2][1], n[1][1] = y[2][0] - y[1][0], n[1][2] = 0;
    }
    if (check__dot(n[1], y[p->na]) > 0)
        for (k = 0; k < 3; k++) n[1][k] = -n[1][k];
    return sqrt(check__dot(n[0], n[0]));
}

// ---------------------------------------------------------------------------------------------
// >>crossing
// Proof of "collides" on [t0, t1]: seen along a fixed n, the projections cross properly for all
// t (every side test is a quadratic with Bernstein coefficients of one sign). Then the height
// of one over the other at the crossing is continuous in t and has the sign of the orientation,
// up to a fixed factor: a change of its exact sign, or a zero, is a contact.
// ---------------------------------------------------------------------------------------------

// The sign on [t0, t1] of det(n, x_j - x_i, x_k - x_i); 0: mixed or not certain.
CHECK__API int check__side_sign(const check__pair *p, const double *n, int i, int j, int k,
                                double t0, double t1) {
    double r[2][2][3], b[3], w[2] = {0, 0}, bound, size_n;
    int e, c, q;
    for (q = 0; q < 2; q++)
        for (e = 0; e < 2; e++) {
            double t = e ? t1 : t0, size = 0;
            for (c = 0; c < 3; c++) {
                double lo = (1 - t) * (p->x[0][q ? k : j][c] - p->x[0][i][c]);
                double hi = t * (p->x[1][q ? k : j][c] - p->x[1][i][c]);
                r[q][e][c] = lo + hi;
                size += fabs(lo) + fabs(hi);
            }
            w[q] = fmax(w[q], size);
        }
    b[0] = check__det(n, r[0][0], r[1][0]);
    b[1] = check__det(n, r[0][0], r[1][1]) + check__det(n, r[0][1], r[1][0]);
    b[2] = check__det(n, r[0][1], r[1][1]);
    // As for check__rows; b[1] is the sum of two.
    size_n = fabs(n[0]) + fabs(n[1]) + fabs(n[2]);
    bound = 64 * CHECK__U * size_n * w[0] * w[1] + 1e-290 * (1 + size_n);
    if (b[0] > bound && b[1] > bound && b[2] > bound) return 1;
    if (b[0] < -bound && b[1] < -bound && b[2] < -bound) return -1;
    return 0;
}

// The sign on [t0, t1] of m·(x_i - x_0).
CHECK__API int check__line_sign(const check__pair *p, const double *m, int i, double t0,
                                double t1) {
    double h[2], w[2], v[2], bound[2];
    int e;
    check__heights(p, m, i, 0, h, w);
    for (e = 0; e < 2; e++) {
        double t = e ? t1 : t0;
        v[e] = (1 - t) * h[0] + t * h[1];
        bound[e] = 8 * CHECK__U * ((1 - t) * w[0] + t * w[1]) + 1e-300;
    }
    if (v[0] > bound[0] && v[1] > bound[1]) return 1;
    return v[0] < -bound[0] && v[1] < -bound[1] ? -1 : 0;
}

CHECK__API int check__projections_cross(const check__pair *p, const double *n, double t0,
                                        double t1) {
    int s;
    if (p->dim == 2) {
        double m[3];
        m[0] = -n[1], m[1] = n[0], m[2] = 0;
        return check__line_sign(p, m, 1, t0, t1) * check__line_sign(p, m, 2, t0, t1) < 0;
    }
    if (p->na == 1) {
        s = check__side_sign(p, n, 0, 1, 2, t0, t1);
        return s != 0 && check__side_sign(p, n, 0, 2, 3, t0, t1) == s &&
               check__side_sign(p, n, 0, 3, 1, t0, t1) == s;
    }
    return check__side_sign(p, n, 0, 1, 2, t0, t1) * check__side_sign(p, n, 0, 1, 3, t0, t1) < 0 &&
           check__side_sign(p, n, 2, 3, 0, t0, t1) * check__side_sign(p, n, 2, 3, 1, t0, t1) < 0;
}

CHECK__API int check__crosses(const check__pair *p, const double *n, double t0, double t1) {
    return check__projections_cross(p, n, t0, t1) &&
           check__pair_orient(p, t0) * check__pair_orient(p, t1) <= 0;
}

// Do they touch in fixed positions?
CHECK__API int check__touching(int dim, int na, int nb, double (*y)[3]) {
    if (dim == 2 && na == 1) return check_point_on_segment2d(y[0], y[1], y[2]);
    if (dim == 2) return check_segments_meet2d(y[0], y[1], y[2], y[3]);
    if (na == 1) return check_point_on_triangle(y[0], y[1], y[2], y[3]);
    if (nb == 2) return check_segments_meet3d(y[0], y[1], y[2], y[3]);
    return check_segment_meets_triangle(y[0], y[1], y[2], y[3], y[4]);
}

// Do they touch at t? Answers only where all positions at t are doubles, else 0.
CHECK__API int check__touching_at(const check__pair *p, double t) {
    double y[5][3];
    check__exp s, d;
    int i, k, e;
    for (i = 0; i < p->na + p->nb; i++)
        for (k = 0; k < 3; k++) {
            check__exp_set(&s, 0);
            for (e = 0; e < 2; e++) {
                check__exp_diff(&d, p->x[e][i][k], 0);
                check__exp_add(&s, &d, e ? t : 1 - t);
            }
            if (s.n > 1) return 0;
            y[i][k] = s.n ? s.c[0] / CHECK__SCALE : 0;
        }
    return check__touching(p->dim, p->na, p->nb, y);
}

// ---------------------------------------------------------------------------------------------
// >>search
// Bisection of [0, 1]: each interval is separated, or proven to hold a collision, or halved.
// Halving doubles the relative gap near a transversal contact and turns a rotating pair into a
// fixed one (the direction errs by the square of the interval), so depth grows by the logarithm
// of speed over distance. First in doubles; what stays open is searched once more with exact
// tests at every interval.
// ---------------------------------------------------------------------------------------------

#define CHECK__DEPTH 44   /* t and 1 - t stay doubles; 6e-14 of the motion is below all rounding */
#define CHECK__VISITS 512 /* an open pair costs at most this many intervals; clear ones need < 50 */
#define CHECK__TIGHTEN 128 /* intervals spent on a sharper distance, which proves nothing more */

CHECK__API int check__clear_exact(const check__pair *p, double (*n)[3], double t0, double t1) {
    double axis[3];
    int k, s;
    if (check__never_coplanar(p, t0, t1)) return 1;
    for (k = 0; k < 2; k++)
        if (check__separated_exact(p, n[k], t0, t1)) return 1;
    for (k = 0; k < 3; k++)
        for (s = -1; s <= 1; s += 2) {
            axis[0] = axis[1] = axis[2] = 0;
            axis[k] = s;
            if (check__separated_exact(p, axis, t0, t1)) return 1;
        }
    return 0;
}

// One interval. In doubles (exact = 0) contact is sought only where the bisection is deep enough.
CHECK__API check_verdict check__interval(const check__pair *p, double t0, double t1, int exact,
                                         check__answer *a, double *low) {
    double n[2][3];
    int k;
    *low = 0;
    a->high = fmin(a->high, check__directions(p, 0.5 * (t0 + t1), n));
    for (k = 0; k < 2; k++)
        if (check__separated(p, n[k], t0, t1, low)) return CHECK_CLEAR;
    if (exact && check__clear_exact(p, n, t0, t1)) return CHECK_CLEAR;
    for (k = 1; k >= 0; k--)
        if (check__crosses(p, n[k], t0, t1)) return CHECK_COLLIDES;
    if (exact && (check__touching_at(p, t0) || check__touching_at(p, t1))) return CHECK_COLLIDES;
    return CHECK_UNDECIDED;
}

// A clear interval is halved on while its bound is below the goal and 5 % below the distances seen.
CHECK__API int check__loose(const check__pair *p, double t0, double t1, double low, double goal,
                            check__answer *a) {
    double n[2][3];
    if (low >= goal) return 0;
    a->high = fmin(a->high, check__directions(p, t0, n));
    a->high = fmin(a->high, check__directions(p, t1, n));
    return low < 0.95 * a->high;
}

CHECK__API check__answer check__search(const check__pair *p, int exact, double goal) {
    double start[CHECK__DEPTH + 2];
    int depth[CHECK__DEPTH + 2], top = 1, visits = 0, extra = 0;
    check__answer a;
    a.verdict = CHECK_CLEAR;
    a.t0 = a.t1 = 0;
    a.low = a.high = INFINITY;
    start[0] = 0, depth[0] = 0;
    while (top > 0) {
        double t0 = start[--top], width = ldexp(1, -depth[top]), t1 = t0 + width;
        int level = depth[top];
        double low;
        check_verdict v = check__interval(p, t0, t1, exact, &a, &low);
        if (v == CHECK_CLEAR &&
            (exact || level == CHECK__DEPTH || ++extra > CHECK__TIGHTEN ||
             !check__loose(p, t0, t1, low, goal, &a))) {
            a.low = fmin(a.low, low);
            continue;
        }
        if (v == CHECK_COLLIDES || level == CHECK__DEPTH ||
            (v != CHECK_CLEAR && ++visits > CHECK__VISITS)) {
            // An open interval does not hide a later contact, unless the budget ends here.
            int stop = v == CHECK_COLLIDES || visits > CHECK__VISITS || !exact;
            if (v == CHECK_COLLIDES || a.verdict == CHECK_CLEAR) a.t0 = t0, a.t1 = t1;
            if (v != CHECK_COLLIDES && visits > CHECK__VISITS) a.t1 = 1;
            a.verdict = v;
            a.low = 0;
            if (stop) return a;
            continue;
        }
        start[top] = t0 + 0.5 * width, depth[top++] = level + 1;
        start[top] = t0, depth[top++] = level + 1;
    }
    return a;
}

// Names the time of a proven crossing better: the half in which the orientation changes.
CHECK__API void check__sharpen(const check__pair *p, check__answer *a) {
    int s0 = check__pair_orient(p, a->t0), k;
    // 1e-7 of the segment is enough to look at; s0 = 0 is the contact itself, or no crossing.
    for (k = 0; k < 24 && s0 * check__pair_orient(p, a->t1) < 0; k++) {
        double mid = 0.5 * (a->t0 + a->t1);
        if (mid <= a->t0 || mid >= a->t1) return;
        if (s0 * check__pair_orient(p, mid) <= 0) a->t1 = mid;
        else a->t0 = mid;
    }
}

// The verdict on one pair over [0, 1]. Distances above the goal need not be sharp.
CHECK__API check__answer check__pair_path(const check__pair *p, double goal) {
    check__answer a = check__search(p, 0, goal);
    return a.verdict == CHECK_UNDECIDED ? check__search(p, 1, goal) : a;
}

CHECK__API void check__pair_load(check__pair *p, int dim, int na, int nb, const double *x0,
                                 const double *x1, const int *nodes) {
    int i, k;
    memset(p, 0, sizeof *p);
    p->dim = dim, p->na = na, p->nb = nb;
    for (i = 0; i < na + nb; i++)
        for (k = 0; k < dim; k++) {
            p->x[0][i][k] = x0[(size_t)dim * (size_t)nodes[i] + (size_t)k];
            p->x[1][i][k] = x1[(size_t)dim * (size_t)nodes[i] + (size_t)k];
        }
}

// ---------------------------------------------------------------------------------------------
// >>inversion
// The determinant of a cell's edge vectors is a cubic in t (2D: a third edge e_z makes it the
// quadratic). Positive Bernstein coefficients prove it positive; a coefficient at an end of an
// interval is a value. De Casteljau in doubles with a running bound, then in expansions.
// ---------------------------------------------------------------------------------------------

#define CHECK__CELL_DEPTH 40

typedef struct check__cubic { double c[4], t0, width; int depth; } check__cubic;

// Verdict for sign·cubic > 0 from doubles whose error is at most `bound`.
CHECK__API check__answer check__cubic_positive(const double *c, double bound) {
    check__cubic stack[CHECK__CELL_DEPTH + 2];
    int top = 1, k;
    check__answer a;
    a.verdict = CHECK_CLEAR;
    a.t0 = a.t1 = 0;
    a.low = a.high = INFINITY;
    memcpy(stack[0].c, c, sizeof stack[0].c);
    stack[0].t0 = 0, stack[0].width = 1, stack[0].depth = 0;
    while (top > 0) {
        check__cubic q = stack[--top], l = q, r = q;
        double *b = q.c, least = fmin(fmin(b[0], b[1]), fmin(b[2], b[3]));
        double slack = bound * (1 + q.depth);
        if (least > slack) {
            a.low = fmin(a.low, least - slack);
            continue;
        }
        a.t0 = q.t0, a.t1 = q.t0 + q.width;
        if (b[0] < -slack || b[3] < -slack || q.depth == CHECK__CELL_DEPTH) {
            a.verdict = q.depth == CHECK__CELL_DEPTH ? CHECK_UNDECIDED : CHECK_COLLIDES;
            a.low = -INFINITY;
            return a;
        }
        for (k = 0; k < 3; k++) {
            int i;
            l.c[k] = b[0], r.c[3 - k] = b[3 - k];
            for (i = 0; i < 3 - k; i++) b[i] = 0.5 * (b[i] + b[i + 1]);
        }
        l.c[3] = r.c[0] = b[0];
        l.depth = r.depth = q.depth + 1;
        l.width = r.width = 0.5 * q.width;
        r.t0 = q.t0 + l.width;
        stack[top++] = r;
        stack[top++] = l;
    }
    return a;
}

// Exact: the smallest t first; stops at a value <= 0. Recursion, for the expansions are large.
CHECK__API check_verdict check__cubic_exact(const check__bernstein *b, int sign, double t0,
                                            double width, int depth, check__answer *a) {
    int k, i, bad = 0, least = 1, end0 = sign * check__exp_sign(&b->c[0]),
        end1 = sign * check__exp_sign(&b->c[3]);
    check_verdict v;
    check__bernstein *s;
    for (k = 0; k < 4; k++) {
        int e = sign * check__exp_sign(&b->c[k]);
        bad |= b->c[k].bad;
        if (e < least) least = e;
    }
    a->t0 = t0, a->t1 = t0 + width;
    if (bad || depth == 0) return CHECK_UNDECIDED;
    if (end0 <= 0 || end1 <= 0) return CHECK_COLLIDES;
    if (least > 0) return CHECK_CLEAR;
    s = (check__bernstein *)malloc(2 * sizeof *s);
    if (s == NULL) return CHECK_UNDECIDED;
    s[1] = *b;
    for (k = 0; k < 3; k++) {
        s[0].c[k] = s[1].c[0];
        for (i = 0; i < 3 - k; i++) {
            check__exp e;
            check__exp_set(&e, 0);
            check__exp_add(&e, &s[1].c[i], 0.5);
            check__exp_add(&e, &s[1].c[i + 1], 0.5);
            s[1].c[i] = e;
        }
    }
    s[0].c[3] = s[1].c[0];
    v = check__cubic_exact(&s[0], sign, t0, 0.5 * width, depth - 1, a);
    if (v == CHECK_CLEAR)
        v = check__cubic_exact(&s[1], sign, t0 + 0.5 * width, 0.5 * width, depth - 1, a);
    free(s);
    return v;
}

// A cell is held as a pair whose vertex 0 is the origin of its edges; low bounds the determinant.
CHECK__API check__answer check__cell_path(const check__pair *p, int sign) {
    double u[3][3], v[3][3], c[4], bound = fmax(check__rows(u, p, 0), check__rows(v, p, 1));
    check__exp eu[3][3], ev[3][3];
    check__bernstein b;
    check__answer a;
    int k;
    double w[3], size = 1;
    for (k = 0; k < 3; k++) {
        w[k] = fmax(fabs(u[k][0]) + fabs(u[k][1]) + fabs(u[k][2]),
                    fabs(v[k][0]) + fabs(v[k][1]) + fabs(v[k][2]));
        size *= w[k];
    }
    c[0] = sign * check__det(u[0], u[1], u[2]);
    c[1] = sign * (check__det(v[0], u[1], u[2]) + check__det(u[0], v[1], u[2]) +
                   check__det(u[0], u[1], v[2])) / 3;
    c[2] = sign * (check__det(u[0], v[1], v[2]) + check__det(v[0], u[1], v[2]) +
                   check__det(v[0], v[1], u[2])) / 3;
    c[3] = sign * check__det(v[0], v[1], v[2]);
    // Mixed rows are bounded by the larger end of each; every halving adds 3 roundings.
    bound = fmax(bound, 32 * CHECK__U * size + 1e-290);
    a = check__cubic_positive(c, bound);
    if (a.verdict == CHECK_CLEAR) return a;
    check__rows_exact(eu, p, 0);
    check__rows_exact(ev, p, 1);
    check__bernstein_exact(&b, eu, ev);
    a.low = fmin(fmin(c[0], c[1]), fmin(c[2], c[3])) - bound;
    a.verdict = check__cubic_exact(&b, sign, 0, 1, CHECK__CELL_DEPTH, &a);
    return a;
}

// ---------------------------------------------------------------------------------------------
// >>tree
// Pairs of overlapping boxes: a binary tree over the second set, halved at the median of the
// longest axis, leaves of four; O(n log n) to build, one walk a query.
// ---------------------------------------------------------------------------------------------

typedef struct check__set {
    int arity, count;
    int *nodes;            // arity x count
} check__set;

typedef struct check__tree {
    int count, used;
    int *item, *right, *size;  // right child of an inner node; a leaf's size, else 0
    int *first;
    double (*box)[6];          // per item: lower corner, upper corner
    double (*bound)[6];        // per tree node
} check__tree;

// Boxes grow by reach, and by more than its rounding.
CHECK__API void check__box(const int *nodes, int n, int dim, const double *x0, const double *x1,
                           double reach, double *box) {
    int i, k;
    for (k = 0; k < 3; k++) {
        double lo = INFINITY, hi = -INFINITY, pad;
        for (i = 0; i < n && k < dim; i++) {
            size_t at = (size_t)dim * (size_t)nodes[i] + (size_t)k;
            lo = fmin(lo, fmin(x0[at], x1[at]));
            hi = fmax(hi, fmax(x0[at], x1[at]));
        }
        if (k >= dim) lo = hi = 0;
        pad = reach > 0 ? reach * (1 + 8 * CHECK__U) + 4 * CHECK__U * fmax(fabs(lo), fabs(hi)) : 0;
        box[k] = lo - pad;
        box[3 + k] = hi + pad;
    }
}

CHECK__API int check__overlap(const double *a, const double *b) {
    return a[0] <= b[3] && b[0] <= a[3] && a[1] <= b[4] && b[1] <= a[4] && a[2] <= b[5] &&
           b[2] <= a[5];
}

CHECK__API void check__tree_free(check__tree *t) {
    free(t->item);
    free(t->right);
    free(t->size);
    free(t->first);
    free(t->box);
    free(t->bound);
    memset(t, 0, sizeof *t);
}

// Quickselect by box centre: after it, items before mid are not above those from mid on.
CHECK__API void check__median(check__tree *t, int lo, int hi, int mid, int axis) {
    while (hi - lo > 1) {
        const double *pb = t->box[t->item[lo + (hi - lo) / 2]];
        double pivot = pb[axis] + pb[3 + axis];
        int i = lo, j = hi - 1, swap;
        while (i <= j) {
            while (t->box[t->item[i]][axis] + t->box[t->item[i]][3 + axis] < pivot) i++;
            while (t->box[t->item[j]][axis] + t->box[t->item[j]][3 + axis] > pivot) j--;
            if (i > j) break;
            swap = t->item[i], t->item[i] = t->item[j], t->item[j] = swap;
            i++, j--;
        }
        if (mid <= j) hi = j + 1;
        else if (mid >= i) lo = i;
        else return;
    }
}

CHECK__API int check__tree_split(check__tree *t, int lo, int hi) {
    int id = t->used++, i, k, axis = 0, mid = lo + (hi - lo) / 2;
    double *b = t->bound[id];
    for (k = 0; k < 3; k++) b[k] = INFINITY, b[3 + k] = -INFINITY;
    for (i = lo; i < hi; i++)
        for (k = 0; k < 3; k++) {
            b[k] = fmin(b[k], t->box[t->item[i]][k]);
            b[3 + k] = fmax(b[3 + k], t->box[t->item[i]][3 + k]);
        }
    t->first[id] = lo;
    t->size[id] = hi - lo <= 4 ? hi - lo : 0;
    if (t->size[id]) return id;
    for (k = 1; k < 3; k++)
        if (b[3 + k] - b[k] > b[3 + axis] - b[axis]) axis = k;
    check__median(t, lo, hi, mid, axis);
    (void)check__tree_split(t, lo, mid);
    t->right[id] = check__tree_split(t, mid, hi);
    return id;
}

// Takes over nothing; returns 0 without memory.
CHECK__API int check__tree_build(check__tree *t, const check__set *s, int dim, const double *x0,
                                 const double *x1, double reach) {
    size_t n = (size_t)s->count + 1;
    int i;
    memset(t, 0, sizeof *t);
    t->count = s->count;
    t->item = (int *)malloc(n * sizeof(int));
    t->right = (int *)malloc(n * sizeof(int));
    t->size = (int *)malloc(n * sizeof(int));
    t->first = (int *)malloc(n * sizeof(int));
    t->box = (double(*)[6])malloc(n * sizeof *t->box);
    t->bound = (double(*)[6])malloc(n * sizeof *t->bound);
    if (!t->item || !t->right || !t->size || !t->first || !t->box || !t->bound) {
        check__tree_free(t);
        return 0;
    }
    for (i = 0; i < s->count; i++) {
        t->item[i] = i;
        check__box(s->nodes + (size_t)s->arity * (size_t)i, s->arity, dim, x0, x1, reach,
                   t->box[i]);
    }
    if (s->count > 0) (void)check__tree_split(t, 0, s->count);
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>scene
// Edges are those of the triangles and the loose ones, each once, the loose ones last.
// ---------------------------------------------------------------------------------------------

typedef struct check {
    check_mesh mesh;
    check__set triangles, edges, points, loose_edges, loose_points;
    double *last;      // where the polyline has come to
    check_report report;
} check;

CHECK__API int check__edge_order(const void *a, const void *b) {
    const int *p = (const int *)a, *q = (const int *)b;
    int k;
    for (k = 0; k < 3; k++)
        if (p[k] != q[k]) return p[k] < q[k] ? -1 : 1;
    return 0;
}

// e: count triples (low node, high node, loose). Fills the sets; returns 0 without memory.
CHECK__API int check__edges_unique(check *c, int *e, int count) {
    int i, pass, n = 0, loose;
    int *out = (int *)malloc((size_t)(count + 1) * 2 * sizeof(int));
    if (out == NULL) return 0;
    qsort(e, (size_t)count, 3 * sizeof(int), check__edge_order);
    c->edges.nodes = out;
    for (pass = 0; pass < 2; pass++) {
        if (pass == 1) c->loose_edges.nodes = out + 2 * n, c->loose_edges.count = -n;
        for (i = 0; i < count; i++) {
            // Loose sorts after not loose: the first of equal edges decides.
            if (i > 0 && e[3 * i] == e[3 * i - 3] && e[3 * i + 1] == e[3 * i - 2]) continue;
            loose = e[3 * i + 2];
            if (loose != pass || e[3 * i] == e[3 * i + 1]) continue;
            out[2 * n] = e[3 * i], out[2 * n + 1] = e[3 * i + 1];
            n++;
        }
    }
    c->edges.arity = c->loose_edges.arity = 2;
    c->edges.count = n;
    c->loose_edges.count += n;
    return 1;
}

CHECK__API int check__collect_edges(check *c) {
    const check_mesh *m = &c->mesh;
    int i, k, n = 0, ok, count = 3 * c->triangles.count + m->n_edges;
    int *e = (int *)malloc((size_t)(count + 1) * 3 * sizeof(int));
    if (e == NULL) return 0;
    for (i = 0; i < count; i++) {
        int t = i / 3, tri = i < 3 * c->triangles.count, l = i - 3 * c->triangles.count;
        int a = tri ? m->triangles[i] : m->edges[2 * l];
        int b = tri ? m->triangles[3 * t + (i + 1) % 3] : m->edges[2 * l + 1];
        k = 3 * n++;
        e[k] = a < b ? a : b;
        e[k + 1] = a < b ? b : a;
        e[k + 2] = !tri;
    }
    ok = check__edges_unique(c, e, count);
    free(e);
    return ok;
}

// Points: loose ones last, of which none is on an edge.
CHECK__API int check__collect_points(check *c) {
    const check_mesh *m = &c->mesh;
    int i, n = 0;
    unsigned char *mark = (unsigned char *)calloc((size_t)m->nodes + 1, 1);
    int *out = (int *)malloc(((size_t)m->nodes + 1) * sizeof(int));
    c->points.nodes = out;
    if (mark == NULL || out == NULL) {
        free(mark);
        return 0;
    }
    for (i = 0; i < m->n_points; i++) mark[m->points[i]] = 1;
    for (i = 0; i < 2 * c->edges.count; i++) mark[c->edges.nodes[i]] = 2;
    for (i = 0; i < m->nodes; i++)
        if (mark[i] == 2) out[n++] = i;
    c->loose_points.nodes = out + n;
    c->loose_points.count = -n;
    for (i = 0; i < m->nodes; i++)
        if (mark[i] == 1) out[n++] = i;
    c->points.arity = c->loose_points.arity = 1;
    c->points.count = n;
    c->loose_points.count += n;
    free(mark);
    return 1;
}

CHECK__API int check__body(const check *c, int node) {
    return c->mesh.body ? c->mesh.body[node] : 0;
}

CHECK__API int check__ignored(const check *c, const int *v, int na, int nb) {
    const check_mesh *m = &c->mesh;
    int i, j, all = m->kinematic != NULL;
    for (i = 0; i < na + nb && all; i++) all = m->kinematic[v[i]] != 0;
    if (all) return 1;
    for (i = 0; i < na; i++)
        for (j = na; j < na + nb; j++)
            if (v[i] == v[j]) return 1;
    if (!m->self_contact && check__body(c, v[0]) == check__body(c, v[na])) return 1;
    return m->ignore && m->ignore(v, na, v + na, nb, m->ignore_ctx);
}

// ---------------------------------------------------------------------------------------------
// >>passes
// Every pair of two sets whose (swept) boxes overlap. Queries are cut into fixed blocks, each with
// its own report, added in order of the blocks: the same for any number of threads.
// ---------------------------------------------------------------------------------------------

#define CHECK__BLOCK 256

typedef struct check__pass {
    const check *c;
    const check__set *a, *b;
    const check__tree *tree;
    int twice;              // both sets are the same: each pair once
    const double *x0, *x1;  // equal: a state
} check__pass;

CHECK__API check_kind check__pair_kind(int na, int nb) {
    if (na == 1) return nb == 3 ? CHECK_POINT_TRIANGLE : CHECK_POINT_EDGE;
    return nb == 3 ? CHECK_EDGE_TRIANGLE : CHECK_EDGE_EDGE;
}

CHECK__API void check__blame(check_report *r, const check *c, check_kind kind, check_verdict v,
                             int on_path, int index, const int *nodes, int na, int nb) {
    check_offender *o = &r->first;
    if (o->kind != CHECK_NOTHING) return;
    memset(o, 0, sizeof *o);
    o->kind = kind;
    o->verdict = v;
    o->on_path = on_path;
    o->segment = c->report.segments;
    o->index = index;
    o->n_nodes = na + nb;
    o->first_nodes = na;
    if (na + nb > 0) memcpy(o->nodes, nodes, (size_t)(na + nb) * sizeof(int));
    o->body[0] = na > 0 ? check__body(c, nodes[0]) : -1;
    o->body[1] = nb > 0 ? check__body(c, nodes[na]) : -1;
    o->t0 = 0, o->t1 = 1;
}

CHECK__API void check__judge(const check__pass *s, const int *v, check_report *r) {
    int na = s->a->arity, nb = s->b->arity, fresh = r->first.kind == CHECK_NOTHING;
    double goal = r->distance_low;
    check_kind kind = check__pair_kind(na, nb);
    check__pair p;
    check__answer a;
    check__pair_load(&p, s->c->mesh.dim, na, nb, s->x0, s->x1, v);
    if (s->x0 == s->x1) {
        r->state_pairs++;
        if (!check__touching(p.dim, na, nb, p.x[0])) return;
        r->intersections++;
        check__blame(r, s->c, kind, CHECK_COLLIDES, 0, 0, v, na, nb);
        return;
    }
    r->pairs++;
    // Beyond reach the pairs found are not all there are: no need to measure those sharply.
    if (s->c->mesh.reach > 0) goal = fmin(goal, s->c->mesh.reach);
    a = check__pair_path(&p, goal);
    r->distance_low = fmin(r->distance_low, a.low);
    r->distance_high = fmin(r->distance_high, a.high);
    if (a.verdict == CHECK_CLEAR) return;
    if (fresh && a.verdict == CHECK_COLLIDES) check__sharpen(&p, &a);
    r->collisions += a.verdict == CHECK_COLLIDES;
    r->undecided += a.verdict == CHECK_UNDECIDED;
    check__blame(r, s->c, kind, a.verdict, 1, 0, v, na, nb);
    if (fresh) r->first.t0 = a.t0, r->first.t1 = a.t1;
}

// All items whose box meets that of query q.
CHECK__API void check__query(const check__pass *s, int q, check_report *r) {
    const check__tree *t = s->tree;
    int stack[64], top = 1, i, v[6], na = s->a->arity, nb = s->b->arity;
    double box[6];
    memcpy(v, s->a->nodes + (size_t)na * (size_t)q, (size_t)na * sizeof(int));
    check__box(v, na, s->c->mesh.dim, s->x0, s->x1, 0, box);
    stack[0] = 0;
    while (top > 0) {
        int id = stack[--top];
        if (!check__overlap(box, t->bound[id])) continue;
        if (t->size[id] == 0) {
            stack[top++] = t->right[id];
            stack[top++] = id + 1;
            continue;
        }
        for (i = 0; i < t->size[id]; i++) {
            int item = t->item[t->first[id] + i];
            if ((s->twice && item <= q) || !check__overlap(box, t->box[item])) continue;
            memcpy(v + na, s->b->nodes + (size_t)nb * (size_t)item, (size_t)nb * sizeof(int));
            if (!check__ignored(s->c, v, na, nb)) check__judge(s, v, r);
        }
    }
}

CHECK__API void check__run(const check *c, const check__set *a, const check__set *b,
                           const double *x0, const double *x1, check_report *r) {
    int blocks = (a->count + CHECK__BLOCK - 1) / CHECK__BLOCK, i;
    check_report *part;
    check__tree tree;
    check__pass s;
    if (a->count == 0 || b->count == 0) return;
    part = (check_report *)malloc((size_t)blocks * sizeof *part);
    if (part == NULL || !check__tree_build(&tree, b, c->mesh.dim, x0, x1, c->mesh.reach)) {
        free(part);
        r->no_memory = 1;
        return;
    }
    s.c = c, s.a = a, s.b = b, s.tree = &tree, s.x0 = x0, s.x1 = x1;
    s.twice = a == b;
#if defined(_OPENMP)
#pragma omp parallel for schedule(dynamic)
#endif
    for (i = 0; i < blocks; i++) {
        int q, end = (i + 1) * CHECK__BLOCK < a->count ? (i + 1) * CHECK__BLOCK : a->count;
        part[i] = check__report_empty();
        for (q = i * CHECK__BLOCK; q < end; q++) check__query(&s, q, &part[i]);
    }
    for (i = 0; i < blocks; i++) check__report_add(r, &part[i]);
    check__tree_free(&tree);
    free(part);
}

// 1 if all coordinates are in the range in which the arithmetic is exact.
CHECK__API int check__range(const check *c, const double *x, check_report *r) {
    int i, k, n = c->mesh.nodes, dim = c->mesh.dim;
    long before = r->range;
    for (i = 0; i < n; i++)
        for (k = 0; k < dim; k++) {
            double v = fabs(x[(size_t)dim * (size_t)i + (size_t)k]);
            if (v == 0 || (v >= CHECK__TINY && v <= CHECK__HUGE)) continue;
            r->range++;
            check__blame(r, c, CHECK_RANGE, CHECK_COLLIDES, 0, i, &i, 1, 0);
        }
    return r->range == before;
}

CHECK__API void check__halfspaces(const check *c, const double *x, check_report *r) {
    const check_mesh *m = &c->mesh;
    int i, h;
    for (h = 0; h < m->n_halfspaces; h++)
        for (i = 0; i < c->points.count; i++) {
            int v = c->points.nodes[i];
            const double *o = m->halfspaces + 2 * m->dim * h;
            if (m->kinematic && m->kinematic[v]) continue;
            if (check_side(m->dim, x + (size_t)m->dim * (size_t)v, o, o + m->dim) > 0) continue;
            r->halfspaces++;
            check__blame(r, c, CHECK_POINT_HALFSPACE, CHECK_COLLIDES, 0, h, &v, 1, 0);
        }
}

// Loads cell i; 0 if it is wholly kinematic and so not judged.
CHECK__API int check__cell_load(const check *c, int i, const double *x0, const double *x1,
                                check__pair *p, const int **v) {
    const check_mesh *m = &c->mesh;
    int k, n = m->dim + 1, all = m->kinematic != NULL;
    *v = m->cells + (size_t)n * (size_t)i;
    for (k = 0; k < n && all; k++) all = m->kinematic[(*v)[k]] != 0;
    check__pair_load(p, m->dim, 1, m->dim, x0, x1, *v);
    return !all;
}

// The sign and size the cell has at rest.
CHECK__API int check__cell_rest(const check *c, int i, double *volume) {
    double r[3][3];
    check__pair p;
    const int *v;
    *volume = 1;
    if (c->mesh.rest == NULL) return 1;
    (void)check__cell_load(c, i, c->mesh.rest, c->mesh.rest, &p, &v);
    (void)check__rows(r, &p, 0);
    *volume = fabs(check__det(r[0], r[1], r[2]));
    return check__pair_orient(&p, 0);
}

CHECK__API void check__cells(const check *c, const double *x0, const double *x1, check_report *r) {
    int i, sign, s, path = x0 != x1, n = c->mesh.dim + 1;
    double rows[3][3], volume, J;
    check__pair p;
    check__answer a;
    const int *v;
    for (i = 0; i < c->mesh.n_cells; i++) {
        int fresh = r->first.kind == CHECK_NOTHING;
        if (!check__cell_load(c, i, x0, x1, &p, &v)) continue;
        sign = check__cell_rest(c, i, &volume);
        if (path) {
            a = check__cell_path(&p, sign);
            r->min_J_path = fmin(r->min_J_path, a.low / volume);
        } else {
            s = sign * check__pair_orient(&p, 0);
            (void)check__rows(rows, &p, 0);
            J = fabs(check__det(rows[0], rows[1], rows[2])) / volume;
            r->min_J = fmin(r->min_J, s > 0 ? J : s < 0 ? -J : 0);
            a.verdict = s > 0 ? CHECK_CLEAR : CHECK_COLLIDES;
            a.t0 = a.t1 = 0;
        }
        if (a.verdict == CHECK_CLEAR) continue;
        r->inversions += a.verdict == CHECK_COLLIDES;
        r->undecided += a.verdict == CHECK_UNDECIDED;
        check__blame(r, c, CHECK_INVERSION, a.verdict, path, i, v, n, 0);
        if (fresh) r->first.t0 = a.t0, r->first.t1 = a.t1;
    }
}

CHECK__API void check__state(const check *c, const double *x, check_report *r) {
    r->states++;
    if (!check__range(c, x, r)) return;
    check__cells(c, x, x, r);
    check__halfspaces(c, x, r);
    if (c->mesh.dim == 2) {
        check__run(c, &c->edges, &c->edges, x, x, r);
        check__run(c, &c->loose_points, &c->edges, x, x, r);
        return;
    }
    check__run(c, &c->edges, &c->triangles, x, x, r);
    check__run(c, &c->loose_points, &c->triangles, x, x, r);
    check__run(c, &c->loose_edges, &c->loose_edges, x, x, r);
}

CHECK__API void check__path(const check *c, const double *x0, const double *x1, check_report *r) {
    if (!check__range(c, x0, r) || !check__range(c, x1, r)) return;
    check__cells(c, x0, x1, r);
    if (c->mesh.dim == 2) {
        check__run(c, &c->points, &c->edges, x0, x1, r);
        return;
    }
    check__run(c, &c->points, &c->triangles, x0, x1, r);
    check__run(c, &c->edges, &c->edges, x0, x1, r);
}

// ---------------------------------------------------------------------------------------------
// >>recorder
// ---------------------------------------------------------------------------------------------

// Judges one state by itself. Returns 1 if it is sound; adds to the report.
CHECK__API int check_state(check *c, const double *x) {
    check_report r = check__report_empty();
    check__state(c, x, &r);
    check__report_close(&r);
    check__report_add(&c->report, &r);
    return r.ok;
}

// Judges one segment by itself, ends included in what is judged along it (not their states).
CHECK__API int check_path(check *c, const double *x0, const double *x1) {
    check_report r = check__report_empty();
    double *copy = NULL;
    if (x0 == x1) {
        // A path is told from a state by its two arrays.
        size_t bytes = (size_t)c->mesh.dim * (size_t)c->mesh.nodes * sizeof(double);
        copy = (double *)malloc(bytes + 1);
        r.no_memory = copy == NULL;
        if (copy) memcpy(copy, x0, bytes);
    }
    if (!r.no_memory) check__path(c, x0, copy ? copy : x1, &r);
    // Heights over a plane are linear in t: both ends suffice.
    if (!r.range) check__halfspaces(c, x0, &r);
    if (!r.range) check__halfspaces(c, x1, &r);
    free(copy);
    check__report_close(&r);
    check__report_add(&c->report, &r);
    c->report.segments++;
    return r.ok;
}

// Frees it all and returns the verdict. NULL (no memory) gives a report that is not ok.
CHECK__API check_report check_end(check *c) {
    check_report r = check__report_empty();
    if (c == NULL) {
        r.no_memory = 1;
        return r;
    }
    r = c->report;
    check__report_close(&r);
    free(c->triangles.nodes);
    free(c->edges.nodes);
    free(c->points.nodes);
    free(c->last);
    free(c);
    return r;
}

// A jump (teleport): a new polyline starts at x, whose state is judged.
CHECK__API int check_jump(check *c, const double *x) {
    memcpy(c->last, x, (size_t)c->mesh.dim * (size_t)c->mesh.nodes * sizeof(double));
    return check_state(c, x);
}

// x0 = NULL: nothing is judged yet, and the first segment may start anywhere. NULL: no memory.
CHECK__API check *check_begin(const check_mesh *mesh, const double *x0) {
    check *c = (check *)calloc(1, sizeof *c);
    size_t n = (size_t)mesh->dim * (size_t)mesh->nodes;
    size_t tris = mesh->dim == 3 ? (size_t)mesh->n_triangles : 0;
    if (c == NULL) return NULL;
    c->mesh = *mesh;
    c->report = check__report_empty();
    c->triangles.arity = 3;
    c->triangles.count = (int)tris;
    c->triangles.nodes = (int *)malloc((3 * tris + 1) * sizeof(int));
    c->last = (double *)malloc((n + 1) * sizeof(double));
    if (!c->triangles.nodes || !c->last || !check__collect_edges(c) || !check__collect_points(c)) {
        (void)check_end(c);
        return NULL;
    }
    if (tris > 0) memcpy(c->triangles.nodes, mesh->triangles, 3 * tris * sizeof(int));
    if (x0) (void)check_jump(c, x0);
    return c;
}

// One accepted iterate: joins, the path to it, its state. Returns 1 if all is well.
CHECK__API int check_segment(check *c, const double *x_prev, const double *x_next) {
    size_t bytes = (size_t)c->mesh.dim * (size_t)c->mesh.nodes * sizeof(double);
    int ok = 1, path, started = c->report.states + c->report.segments > 0;
    if (started && memcmp(c->last, x_prev, bytes) != 0) {
        c->report.breaks++;
        check__blame(&c->report, c, CHECK_BREAK, CHECK_COLLIDES, 0, 0, NULL, 0, 0);
        ok = 0;
    }
    path = check_path(c, x_prev, x_next);
    memcpy(c->last, x_next, bytes);
    return check_state(c, x_next) && path && ok;
}

#endif
