/* tss_ipc.h: contact and friction for tss.h, after Incremental Potential Contact
 *
 * What it is: surfaces of a world's bodies repel each other within a distance d̂ by a logarithmic
 * barrier, so strongly that they never meet; every Newton step is shortened by conservative
 * continuous collision detection. Friction is Coulomb's, smoothed and lagged. Paper A, §3.1 and §4,
 * uses this model; Li et al. 2020 introduced it.
 *
 *     #define TSS_IMPLEMENTATION            // in one .c or .cpp file
 *     #include "tss.h"
 *     #include "tss_ipc.h"
 *
 *     tss_ipc_def d = tss_ipc_def_default();
 *     d.mu = 0.3;
 *     tss_ipc_add(world, &d, NULL);         // before the first step; the world owns it
 *
 * Contact is two energies (barrier, friction) on the public hook of tss.h; the distances, the
 * barrier and the collision detection below can be called on their own.
 *
 * Options:
 *     TSS_NO_FRICTION  no friction (4 kB); tss_ipc_add refuses mu > 0.
 *     TSS_NO_3D        no edge–edge and point–triangle pairs: the queries of single pairs below
 *                      answer NaN to them, and the CCD 0.
 *     TSS_NO_SIMD      no intrinsics: plain loops, a slower search.
 * Memory, threads, determinism, errors: as in tss.h. License: MIT (at the end).
 */
#ifndef TSS_IPC_H
#define TSS_IPC_H

#ifndef TSS_H
#error "include tss.h before tss_ipc.h"
#endif

#ifdef __cplusplus
extern "C" {
#endif

// ---------------------------------------------------------------------------------------------
// >>contact_math (public)
// Distances, barrier, friction and continuous collision detection of single pairs. The contact
// energies are built on them; they are public because a researcher wants them alone as well.
// All are pure: no state, any thread, no memory.
//
// CONVENTIONS. Distances are squared (m²) unless a name says otherwise, and so is d̂ where it is
// set against them. Points are packed: node after node, d = dim coordinates each.
// ---------------------------------------------------------------------------------------------

// The pairs of primitives, and the order of their nodes.
typedef enum tss_ipc_kind {
    TSS_IPC_EDGE_EDGE = 0,       // a0 a1 b0 b1; 3D only
    TSS_IPC_POINT_TRIANGLE = 1,  // p t0 t1 t2; 3D only
    TSS_IPC_POINT_EDGE = 2,      // p e0 e1
    TSS_IPC_POINT_POINT = 3,     // p q
} tss_ipc_kind;

// Which parts of the two primitives are closest ("feature"). Numbers as in the public tool kit:
//   POINT_POINT     0
//   POINT_EDGE      0, 1: ends of the edge · 2: inside of the edge
//   POINT_TRIANGLE  0..2: corners · 3: edge t0t1 · 4: t1t2 · 5: t2t0 · 6: inside
//   EDGE_EDGE       0: a0,b0 · 1: a0,b1 · 2: a1,b0 · 3: a1,b1 · 4: edge a, b0 · 5: edge a, b1 ·
//                   6: a0, edge b · 7: a1, edge b · 8: insides
#define TSS_IPC_CLOSEST (-1)  // where a feature is asked for: the closest one at x

// Nodes of a pair: 4, 4, 3, 2.
TSS_API int tss_ipc_pair_nodes(tss_ipc_kind kind);

// The closest feature at x (nodes × dim). Degenerate input is fine: parallel edges, edges without
// length, flat triangles give a feature whose distance is the smallest to rounding.
TSS_API int tss_ipc_closest(tss_ipc_kind kind, int dim, const double *x);

// Squared distance between the two primitives at x; coef (4, may be NULL) receives the numbers c
// with r = Σ c_i x_i the shortest vector between them (0 for nodes that do not take part).
TSS_API double tss_ipc_distance(tss_ipc_kind kind, int dim, const double *x, double *coef);

// Squared distance of one feature, of unlimited lines and planes (inside the feature's own region
// the same as above), with gradient (m = nodes·dim) and Hessian (m × m); both may be NULL.
// feature TSS_IPC_CLOSEST: the closest one. Features without meaning at x (the line through two
// equal points, the plane of a flat triangle) count as their first point.
TSS_API double tss_ipc_feature_distance(tss_ipc_kind kind, int dim, int feature, const double *x,
                                        double *gradient, double *hessian);

// Barrier b = −(d − d̂)² ln(d/d̂) for d < d̂, else 0 (IPC, Eq. 6, on squared distances): C² at d̂,
// +inf at d <= 0. b1, b2 (may be NULL): derivatives by d.
TSS_API double tss_ipc_barrier(double d, double dhat, double *b1, double *b2);

// Mollifier of an edge–edge pair (IPC, Eq. 24): m = (2 − c/ε) c/ε for c = ‖ea × eb‖² < ε, else 1:
// takes the kink out of nearly parallel edges. x: 4 × 3. gradient (12), hessian (144): may be NULL.
TSS_API double tss_ipc_mollifier(const double *x, double eps, double *gradient, double *hessian);
// ε = 1e-3 ‖ea‖²‖eb‖² at the rest positions X (4 × 3).
TSS_API double tss_ipc_mollifier_eps(const double *X);

// Smoothed Coulomb friction at a tangential displacement of length y >= 0 with threshold eps
// (= ε_v h, m): out = f0 (the potential, f0' = f1), f1 (0..1), f2 = f1', f1/y (finite at 0).
TSS_API void tss_ipc_friction(double y, double eps, double out[4]);

// Tangents of the contact plane to the unit normal n: t (dim − 1 rows of dim), orthonormal,
// (n, t1, t2) right-handed. The same bits for the same n; not continuous in n.
TSS_API void tss_ipc_tangents(int dim, const double *n, double *t);

// Continuous collision detection. The pair moves from x to x + d (nodes × dim each) in t = 0..1.
// Returns the largest t ∈ [0, t_max] it can prove safe: everywhere on [0, t] the two primitives
// stay apart by at least slack times their distance at t = 0. slack ∈ [0, 1): 0.1..0.2 in a
// simulation, so that the barrier finds room at x + t·d. t_max is returned only if all of the way
// is proven; never too late, even with rounding. 0: touching at the start, or input not finite.
// Method: additive CCD with separating directions; the proof does not rest on the accuracy of
// distances. Stops within 10 % of the slack, or after max_iterations (<= 0: 256) with the time
// reached. iterations (may be NULL): how many it took.
TSS_API double tss_ipc_ccd(tss_ipc_kind kind, int dim, const double *x, const double *d,
                           double slack, double t_max, int max_iterations, int *iterations);
// The same for a point against the half-space n·(x − o) >= 0; n need not have unit length.
TSS_API double tss_ipc_ccd_plane(int dim, const double *x, const double *d, const double *o,
                                 const double *n, double slack, double t_max);

// ---------------------------------------------------------------------------------------------
// >>contact (public)
// Contact between all surfaces of a world: barrier and friction as two energies.
//   tss_ipc_def d = tss_ipc_def_default();
//   d.mu = 0.3;
//   tss_ipc *contact;
//   tss_ipc_add(world, &d, &contact);     // any time before tss_world_prepare or between steps
// The world owns the object from then on; it lives until the world is destroyed or
// tss_ipc_remove. Nothing intersects at the start, or tss_world_check says what does.
//
// Energy: κ Σ m b(d, d̂²) over all point–triangle and edge–edge pairs (3D) or point–edge pairs (2D)
// nearer than d̂ that share no node, plus free points against free points and segments, plus
// points against planes. A pair whose closest parts are a corner or an edge keeps its stencil, so
// the same two points may count several times (once a pair of primitives): the plain sum is C¹,
// and every weight is 1. IPC's merged lists with multiplicities have the same sum.
// Friction: Σ μ λ f0(‖u‖), λ and the contact planes frozen ("lagged") at the start of a solve.
// ---------------------------------------------------------------------------------------------

typedef struct tss_ipc tss_ipc;

// A half-space n·(x − o) >= 0 in which all surface points stay.
typedef struct tss_ipc_plane {
    double origin[3];
    double normal[3];  // any length > 0, out of the solid
    double mu;         // friction coefficient, >= 0
} tss_ipc_plane;

// What differs for one body.
typedef struct tss_ipc_body {
    tss_body body;
    double mu;         // friction against anything; < 0: the default
    int self_contact;  // 0: no contact of the body with itself; −1: the default
} tss_ipc_body;

// What differs for one pair of bodies (a == b: the body with itself). Goes before tss_ipc_body.
typedef struct tss_ipc_pair {
    tss_body a, b;
    int exclude;  // 1: they pass through each other
    double mu;    // < 0: as without this entry
} tss_ipc_pair;

typedef struct tss_ipc_def {
    double dhat;      // d̂, m: surfaces nearer than this repel; 0: from dhat_rel. Default 0
    double dhat_rel;  // d̂ = dhat_rel × diagonal, > 0; default 1e-3
    double dhat_edge;  // with dhat_rel: d̂ <= dhat_edge × the shortest edge of a deformable surface,
                       // so that neighbours in the mesh do not repel; 0: no bound. Default 0.5
    double kappa;  // κ, J/m⁴ (b is in m⁴); 0: adaptive (the banner of the private part). Default 0
    double mu;     // friction coefficient between bodies, >= 0; default 0
    double eps_v;  // speed, m/s, below which friction is smoothed; 0: 1e-3 × diagonal / s
    int friction_iterations;  // solves a step with friction updated in between, >= 1; default 1
    int self_contact;         // default 1
    double slack;        // a step leaves each pair at least this share of its distance, (0, 1);
                         // default 0.2
    int max_candidates;  // pairs kept at most (12 to 60 bytes each); a sweep that would have more
                         // is shortened instead. >= 1; default 2^25
    int planes;
    const tss_ipc_plane *plane;  // copied
    int bodies;
    const tss_ipc_body *body;  // copied
    int pairs;
    const tss_ipc_pair *pair;  // copied
    int cookie;
} tss_ipc_def;

TSS_API tss_ipc_def tss_ipc_def_default(void);
// Errors: BAD_ARGUMENT (nothing is added), NO_MEMORY. out may be NULL.
TSS_API tss_result tss_ipc_add(tss_world *w, const tss_ipc_def *def, tss_ipc **out);
// Takes contact out of its world and frees it.
TSS_API tss_result tss_ipc_remove(tss_ipc *p);

// The values in use and what the last step cost. Before the first step (or tss_world_check) the
// values that come from the scene are 0.
typedef struct tss_ipc_info {
    double dhat;            // m
    const char *dhat_from;  // "given", "diagonal" or "shortest edge"
    double kappa;           // κ, J/m⁴
    double kappa_min, kappa_max;
    double eps_v;         // m/s
    int candidates;       // pairs of the last sweep whose boxes meet
    int kept;             // of these, may come nearer than d̂
    int active;           // pairs nearer than d̂ at the last state
    int frictional;       // pairs with friction
    double min_distance;  // at the last state, m; +inf: nothing nearer than d̂
    int shortened;        // sweeps cut short by max_candidates since the start
    int doubled;          // times κ was doubled since the start
    size_t bytes;         // memory, the broad phase's trees not counted
} tss_ipc_info;
TSS_API void tss_ipc_get_info(const tss_ipc *p, tss_ipc_info *out);

// One pair in contact at the world's current state. Forces are those of the last step: on the
// first primitive; the second takes the opposite. A pair's node i takes coef[i] times them.
typedef struct tss_ipc_contact {
    int kind;            // tss_ipc_kind, or −1: a point and a plane
    int node[4];         // world nodes, −1: none
    int plane;           // kind −1: which, else −1
    tss_body a, b;       // bodies of the two; b = −1 for a plane
    double coef[4];      // closest points: Σ coef[i] x[node[i]] = distance · normal
    double distance;     // m
    double normal[3];    // from second to first
    double force;        // along the normal, N, >= 0
    double friction[3];  // N
} tss_ipc_contact;
// Writes at most max contacts and returns in *count how many there are (out NULL: only that).
// Valid after a step. Errors: NOT_PREPARED, NO_MEMORY.
TSS_API tss_result tss_ipc_contacts(tss_ipc *p, int max, tss_ipc_contact *out, int *count);
// Force of contact and friction on each node, N (out: nodes × dim). The same state and errors.
TSS_API tss_result tss_ipc_forces(tss_ipc *p, double *out);
// Contact pressure on each node, Pa (out: nodes): the size of the barrier's force over the node's
// share of the surface as it is now (a third of its triangles; 2D: half of its edges, 1 m deep). 0
// where nothing touches and for nodes without area (free points and segments).
TSS_API tss_result tss_ipc_pressures(tss_ipc *p, double *out);

// Bodies that touch (nearer than d̂) and since when.
typedef struct tss_ipc_touch {
    tss_body a, b;  // a <= b; b = −1 − plane for a plane, listed with a the body
    int began;      // 1: not yet so before the last step
    int ended;      // 1: so before the last step and no more (force and distance are 0 then)
    double force;   // sum of normal forces, N
    double distance;
} tss_ipc_touch;
TSS_API tss_result tss_ipc_touches(tss_ipc *p, int max, tss_ipc_touch *out, int *count);

#ifdef __cplusplus
}
#endif
#endif  // TSS_IPC_H

#if defined(TSS_IMPLEMENTATION) && !defined(TSS_IPC_IMPLEMENTATION_DONE)
#define TSS_IPC_IMPLEMENTATION_DONE

#include <float.h>
#include <math.h>
#include <string.h>

// No contraction (same bits everywhere). Without traps both sides of a choice may be computed: gcc
// then makes vectors of the loops over lanes. No result changes by it.
#if defined(__clang__)
#pragma clang fp contract(off)
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("O3", "fp-contract=off", "no-trapping-math")
#endif

#if defined(__GNUC__)
#define TSS__INLINE static inline __attribute__((always_inline))
#define TSS__RESTRICT __restrict__
#elif defined(_MSC_VER)
#define TSS__INLINE static __forceinline
#define TSS__RESTRICT __restrict
#else
#define TSS__INLINE static inline
#define TSS__RESTRICT
#endif

// gcc unrolls short inner loops before it looks for vectors, and then finds none.
#if defined(__GNUC__) && !defined(__clang__)
#define TSS__KEEP_LOOP _Pragma("GCC unroll 1")
#else
#define TSS__KEEP_LOOP
#endif

#if defined(__SSE2__) || defined(__AVX__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#ifdef __cplusplus
extern "C" {
#endif

// ---------------------------------------------------------------------------------------------
// >>contact_features (private)
// What a TSS_NO_* leaves out hangs on a condition that is a constant here, as in tss.h, >>features.
// ---------------------------------------------------------------------------------------------

#ifdef TSS_NO_FRICTION
#define TSS__FRICTION 0
#else
#define TSS__FRICTION 1
#endif

// The kinds of pairs that there are: two in 2D.
#ifdef TSS_NO_3D
#define TSS__IPC_3D 0
#define TSS__IPC_KIND(kind) \
    ((kind) == TSS_IPC_POINT_POINT ? TSS_IPC_POINT_POINT : TSS_IPC_POINT_EDGE)
#else
#define TSS__IPC_3D 1
#define TSS__IPC_KIND(kind) (kind)
#endif

// ---------------------------------------------------------------------------------------------
// >>contact_vectors (private)
// Three numbers by value: the compiler keeps them in registers, and in lanes of vectors.
// ---------------------------------------------------------------------------------------------

typedef struct tss__v3 {
    double x, y, z;
} tss__v3;

TSS__INLINE tss__v3 tss__v3_of(double x, double y, double z) {
    tss__v3 v = {x, y, z};
    return v;
}
TSS__INLINE tss__v3 tss__v3_sub(tss__v3 a, tss__v3 b) {
    return tss__v3_of(a.x - b.x, a.y - b.y, a.z - b.z);
}
// a + s b
TSS__INLINE tss__v3 tss__v3_add(tss__v3 a, double s, tss__v3 b) {
    return tss__v3_of(a.x + s * b.x, a.y + s * b.y, a.z + s * b.z);
}
TSS__INLINE tss__v3 tss__v3_scale(double s, tss__v3 a) {
    return tss__v3_of(s * a.x, s * a.y, s * a.z);
}
TSS__INLINE double tss__v3_dot(tss__v3 a, tss__v3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
TSS__INLINE tss__v3 tss__v3_cross(tss__v3 a, tss__v3 b) {
    return tss__v3_of(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
TSS__INLINE tss__v3 tss__v3_pick(int first, tss__v3 a, tss__v3 b) {
    return tss__v3_of(first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z);
}

// ---------------------------------------------------------------------------------------------
// >>closest_points (private)
// Method: d = min over the parameters of ‖r‖², r = Σ c_i x_i. Borders are tried first, each by a
// clamped projection; the inside wins if its stationary point lies inside. Every candidate is the
// distance of two actual points (an inside by the plane's normal where that is well determined),
// so a wrong decision near a tie or at a degenerate pair costs nothing to first order.
// Branch-free, so that eight pairs run in vector lanes; about 150 flops a pair.
// ---------------------------------------------------------------------------------------------

// Closest points of one pair: coefficients, r from second to first primitive, d = ‖r‖², feature.
typedef struct tss__near {
    double c0, c1, c2, c3;
    tss__v3 r;
    double d, feature;
} tss__near;

// The normal n = N/‖N‖ has a relative error of about 1e-16/sin; below sin² = this the shortest
// vector is taken between the two points instead, whose error does not grow with 1/sin.
#define TSS__SIN2_NORMAL 1e-4

TSS__INLINE double tss__clamp_ratio(double num, double den) {
    double s = den > 0 ? num / den : 0;
    s = s > 0 ? s : 0;
    return s < 1 ? s : 1;
}

TSS__INLINE tss__near tss__near_pick(int first, tss__near a, tss__near b) {
    tss__near o;
    o.c0 = first ? a.c0 : b.c0;
    o.c1 = first ? a.c1 : b.c1;
    o.c2 = first ? a.c2 : b.c2;
    o.c3 = first ? a.c3 : b.c3;
    o.r = tss__v3_pick(first, a.r, b.r);
    o.d = first ? a.d : b.d;
    o.feature = first ? a.feature : b.feature;
    return o;
}

// Feature of a parameter s on a border: its ends if clamped, else its inside.
TSS__INLINE double tss__border_feature(double s, double end0, double end1, double inside) {
    return s <= 0 ? end0 : s >= 1 ? end1 : inside;
}

TSS__INLINE tss__near tss__near_pp(tss__v3 p, tss__v3 q) {
    tss__v3 r = tss__v3_sub(p, q);
    tss__near o = {1, -1, 0, 0, r, tss__v3_dot(r, r), 0};
    return o;
}

TSS__INLINE tss__near tss__near_pe(tss__v3 p, tss__v3 e0, tss__v3 e1) {
    tss__v3 e = tss__v3_sub(e1, e0), q = tss__v3_sub(p, e0);
    double s = tss__clamp_ratio(tss__v3_dot(q, e), tss__v3_dot(e, e));
    // From the nearer end, so that s = 1 gives p − e1 exactly.
    tss__v3 r = s > 0.5 ? tss__v3_add(tss__v3_sub(p, e1), 1 - s, e) : tss__v3_add(q, -s, e);
    tss__near o = {1, s - 1, -s, 0, r, tss__v3_dot(r, r), tss__border_feature(s, 0, 1, 2)};
    return o;
}

// Stationary point of ‖w + s e + t f‖² and its r. Returns 0 (and garbage) if e and f are parallel.
TSS__INLINE int tss__inside_point(tss__v3 w, tss__v3 e, tss__v3 f, double *s, double *t,
                                  tss__v3 *r) {
    tss__v3 n = tss__v3_cross(e, f);
    double nn = tss__v3_dot(n, n), inv = nn > 0 ? 1 / nn : 0;
    *s = -tss__v3_dot(tss__v3_cross(w, f), n) * inv;
    *t = tss__v3_dot(tss__v3_cross(w, e), n) * inv;
    tss__v3 by_normal = tss__v3_scale(tss__v3_dot(w, n) * inv, n);
    tss__v3 by_points = tss__v3_add(tss__v3_add(w, *s, e), *t, f);
    int well = nn > TSS__SIN2_NORMAL * tss__v3_dot(e, e) * tss__v3_dot(f, f);
    *r = tss__v3_pick(well, by_normal, by_points);
    return nn > 0;
}

TSS__INLINE tss__near tss__near_pt(tss__v3 p, tss__v3 a, tss__v3 b, tss__v3 c) {
    tss__near ab = tss__near_pe(p, a, b);
    tss__near bc = tss__near_pe(p, b, c);
    tss__near ca = tss__near_pe(p, c, a);
    ab.feature = ab.feature < 2 ? ab.feature : 3;
    tss__near bc4 = {1, 0, bc.c1, bc.c2, bc.r, bc.d, bc.feature < 2 ? bc.feature + 1 : 4};
    tss__near ca4 = {
        1, ca.c2, 0, ca.c1, ca.r, ca.d, ca.feature < 1 ? 2.0 : ca.feature < 2 ? 0.0 : 5.0};
    tss__near o = tss__near_pick(bc4.d < ab.d, bc4, ab);
    o = tss__near_pick(ca4.d < o.d, ca4, o);
    // Inside: r = (p − a) − s (b − a) − t (c − a).
    double s, t;
    tss__v3 r;
    int ok = tss__inside_point(tss__v3_sub(p, a), tss__v3_sub(a, b), tss__v3_sub(a, c), &s, &t, &r);
    tss__near in = {1, s + t - 1, -s, -t, r, tss__v3_dot(r, r), 6};
    ok = ok & (s > 0) & (t > 0) & (s + t < 1) & (in.d <= o.d);
    return tss__near_pick(ok, in, o);
}

TSS__INLINE tss__near tss__near_ee(tss__v3 a0, tss__v3 a1, tss__v3 b0, tss__v3 b1) {
    tss__near k6 = tss__near_pe(a0, b0, b1), k7 = tss__near_pe(a1, b0, b1);
    tss__near k4 = tss__near_pe(b0, a0, a1), k5 = tss__near_pe(b1, a0, a1);
    k6.feature = k6.feature < 2 ? k6.feature : 6;
    k7.feature = k7.feature < 2 ? k7.feature + 2 : 7;
    k4.feature = k4.feature < 2 ? 2 * k4.feature : 4;
    k5.feature = k5.feature < 2 ? 2 * k5.feature + 1 : 5;
    // Bring all to the order a0 a1 b0 b1 and to r from b to a.
    tss__near n6 = {1, 0, k6.c1, k6.c2, k6.r, k6.d, k6.feature};
    tss__near n7 = {0, 1, k7.c1, k7.c2, k7.r, k7.d, k7.feature};
    tss__near n4 = {-k4.c1, -k4.c2, -1, 0, tss__v3_scale(-1, k4.r), k4.d, k4.feature};
    tss__near n5 = {-k5.c1, -k5.c2, 0, -1, tss__v3_scale(-1, k5.r), k5.d, k5.feature};
    tss__near o = tss__near_pick(n7.d < n6.d, n7, n6);
    tss__near m = tss__near_pick(n5.d < n4.d, n5, n4);
    o = tss__near_pick(m.d < o.d, m, o);
    // Insides: r = (a0 − b0) + s (a1 − a0) + t (b0 − b1).
    double s, t;
    tss__v3 r;
    int ok = tss__inside_point(tss__v3_sub(a0, b0), tss__v3_sub(a1, a0), tss__v3_sub(b0, b1), &s,
                               &t, &r);
    tss__near in = {1 - s, s, t - 1, -t, r, tss__v3_dot(r, r), 8};
    ok = ok & (s > 0) & (s < 1) & (t > 0) & (t < 1) & (in.d <= o.d);
    return tss__near_pick(ok, in, o);
}

// The four points of a pair in space (z = 0 in 2D; the places a pair does not have repeat its
// last). Not a number for what TSS_NO_3D leaves out: the public queries answer with that.
static void tss__pair_load(tss_ipc_kind kind, int dim, const double *x, tss__v3 v[4]) {
    int m = tss_ipc_pair_nodes(kind);
    if (!TSS__IPC_3D && (dim == 3 || m == 4)) {
        v[0] = v[1] = v[2] = v[3] = tss__v3_of(NAN, NAN, NAN);
        return;
    }
    for (int i = 0; i < 4; i++) {
        const double *p = x + (i < m ? i : m - 1) * dim;
        v[i] = tss__v3_of(p[0], p[1], dim == 3 ? p[2] : 0);
    }
}

static tss__near tss__near_of(tss_ipc_kind kind, const tss__v3 v[4]) {
    switch (TSS__IPC_KIND(kind)) {
        case TSS_IPC_EDGE_EDGE:
            return tss__near_ee(v[0], v[1], v[2], v[3]);
        case TSS_IPC_POINT_TRIANGLE:
            return tss__near_pt(v[0], v[1], v[2], v[3]);
        case TSS_IPC_POINT_EDGE:
            return tss__near_pe(v[0], v[1], v[2]);
        default:
            return tss__near_pp(v[0], v[1]);
    }
}

int tss_ipc_pair_nodes(tss_ipc_kind kind) {
    return kind == TSS_IPC_POINT_POINT ? 2 : kind == TSS_IPC_POINT_EDGE ? 3 : 4;
}

int tss_ipc_closest(tss_ipc_kind kind, int dim, const double *x) {
    tss__v3 v[4];
    tss__pair_load(kind, dim, x, v);
    return (int)tss__near_of(kind, v).feature;
}

double tss_ipc_distance(tss_ipc_kind kind, int dim, const double *x, double *coef) {
    tss__v3 v[4];
    tss__pair_load(kind, dim, x, v);
    tss__near o = tss__near_of(kind, v);
    if (coef) coef[0] = o.c0, coef[1] = o.c1, coef[2] = o.c2, coef[3] = o.c3;
    return o.d;
}

// ---------------------------------------------------------------------------------------------
// >>feature_distance (private)
// d(x) = min_s ‖r(x, s)‖², r = Σ_i (c⁰_i + s_1 D¹_i + s_2 D²_i) x_i with 0, 1 or 2 parameters.
// With e_k = ∂r/∂s_k = Σ D^k_i x_i and w = Σ c_i δx_i at the minimiser, the envelope theorem gives
//   ∂d = 2 r·w,    ∂²d = 2‖w‖² − 2 aᵀM⁻¹a,   M_kl = e_k·e_l,   a_k = e_k·w + r·δe_k.
// With e = t R (t orthonormal, R upper triangular): ∂²d = 2‖w‖² − 2 Σ_k (t_k·w + r·Σ_i G^k_i
// δx_i)², G = R⁻ᵀD. One formula for point–point, point–line, point–plane and line–line.
// ---------------------------------------------------------------------------------------------

typedef struct tss__feature {
    signed char params, c[4], D[2][4];
} tss__feature;

static const tss__feature tss__features[4][9] = {
    {{0, {1, 0, -1, 0}, {{0}, {0}}},  // edge–edge
     {0, {1, 0, 0, -1}, {{0}, {0}}},
     {0, {0, 1, -1, 0}, {{0}, {0}}},
     {0, {0, 1, 0, -1}, {{0}, {0}}},
     {1, {1, 0, -1, 0}, {{-1, 1, 0, 0}, {0}}},
     {1, {1, 0, 0, -1}, {{-1, 1, 0, 0}, {0}}},
     {1, {1, 0, -1, 0}, {{0, 0, 1, -1}, {0}}},
     {1, {0, 1, -1, 0}, {{0, 0, 1, -1}, {0}}},
     {2, {1, 0, -1, 0}, {{-1, 1, 0, 0}, {0, 0, 1, -1}}}},
    {{0, {1, -1, 0, 0}, {{0}, {0}}},  // point–triangle
     {0, {1, 0, -1, 0}, {{0}, {0}}},
     {0, {1, 0, 0, -1}, {{0}, {0}}},
     {1, {1, -1, 0, 0}, {{0, 1, -1, 0}, {0}}},
     {1, {1, 0, -1, 0}, {{0, 0, 1, -1}, {0}}},
     {1, {1, 0, 0, -1}, {{0, -1, 0, 1}, {0}}},
     {2, {1, -1, 0, 0}, {{0, 1, -1, 0}, {0, 1, 0, -1}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}}},
    {{0, {1, -1, 0, 0}, {{0}, {0}}},  // point–edge
     {0, {1, 0, -1, 0}, {{0}, {0}}},
     {1, {1, -1, 0, 0}, {{0, 1, -1, 0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}}},
    {{0, {1, -1, 0, 0}, {{0}, {0}}},  // point–point
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}},
     {0, {0}, {{0}, {0}}}},
};

static int tss__feature_count(tss_ipc_kind kind) {
    static const int count[4] = {9, 7, 3, 1};
    return count[kind];
}

// Σ k_i v_i
static tss__v3 tss__v3_sum(const double k[4], const tss__v3 v[4]) {
    tss__v3 s = tss__v3_scale(k[0], v[0]);
    for (int i = 1; i < 4; i++) s = tss__v3_add(s, k[i], v[i]);
    return s;
}

// What first and second derivatives of one feature's distance need.
typedef struct tss__frame {
    double c[4];     // r = Σ c_i x_i
    double G[2][4];  // R⁻ᵀD; 0 beyond the parameters
    tss__v3 r, t[2];
    double d;
} tss__frame;

// Orthonormal tangents of e (t_k = 0 where e_k depends on those before) and G = R⁻ᵀD.
static void tss__frame_tangents(tss__frame *f, double D[2][4], const tss__v3 e[2]) {
    double R11 = sqrt(tss__v3_dot(e[0], e[0])), i11 = R11 > 0 ? 1 / R11 : 0;
    f->t[0] = tss__v3_scale(i11, e[0]);
    double R12 = tss__v3_dot(f->t[0], e[1]);
    // Twice is enough: the second pass removes what rounding left along t_1.
    tss__v3 u = tss__v3_add(e[1], -R12, f->t[0]);
    u = tss__v3_add(u, -tss__v3_dot(u, f->t[0]), f->t[0]);
    double R22 = sqrt(tss__v3_dot(u, u)), i22 = R22 > 0 ? 1 / R22 : 0;
    f->t[1] = tss__v3_scale(i22, u);
    for (int i = 0; i < 4; i++) {
        f->G[0][i] = i11 * D[0][i];
        f->G[1][i] = i22 * (D[1][i] - R12 * f->G[0][i]);
    }
}

static tss__frame tss__frame_of(tss_ipc_kind kind, int feature, const tss__v3 v[4]) {
    const tss__feature *row = &tss__features[kind][feature];
    tss__frame f;
    double D[2][4];
    for (int i = 0; i < 4; i++) f.c[i] = row->c[i], D[0][i] = row->D[0][i], D[1][i] = row->D[1][i];
    tss__v3 e[2] = {tss__v3_sum(D[0], v), tss__v3_sum(D[1], v)};
    tss__v3 w = tss__v3_sum(f.c, v);
    double s = 0, t = 0;
    f.r = w;
    if (row->params == 1) {
        double ee = tss__v3_dot(e[0], e[0]);
        s = ee > 0 ? -tss__v3_dot(w, e[0]) / ee : 0;
        f.r = tss__v3_add(w, s, e[0]);
    } else if (row->params == 2 && !tss__inside_point(w, e[0], e[1], &s, &t, &f.r)) {
        s = t = 0;
        f.r = w;
    }
    for (int i = 0; i < 4; i++) f.c[i] += s * D[0][i] + t * D[1][i];
    f.d = tss__v3_dot(f.r, f.r);
    tss__frame_tangents(&f, D, e);
    return f;
}

static void tss__v3_store(tss__v3 a, double *out) { out[0] = a.x, out[1] = a.y, out[2] = a.z; }

// ∇d = 2 c ⊗ r, 12 numbers (4 nodes × 3)
static void tss__frame_gradient(const tss__frame *f, double g[12]) {
    for (int i = 0; i < 4; i++) tss__v3_store(tss__v3_scale(2 * f->c[i], f->r), g + 3 * i);
}

// H += k g gᵀ for m numbers g; symmetric to the last bit.
static void tss__rank_one(int m, double k, const double *g, double *H) {
    for (int i = 0; i < m; i++)
        for (int j = 0; j < m; j++) H[i * m + j] += k * (g[i] * g[j]);
}

// H (12 × 12) += k ∇²d
static void tss__frame_hessian(const tss__frame *f, double k, double *H) {
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++)
            for (int a = 0; a < 3; a++)
                H[(3 * i + a) * 12 + 3 * j + a] += 2 * k * (f->c[i] * f->c[j]);
    for (int p = 0; p < 2; p++) {
        double g[12];
        for (int i = 0; i < 4; i++)
            tss__v3_store(tss__v3_add(tss__v3_scale(f->c[i], f->t[p]), f->G[p][i], f->r),
                          g + 3 * i);
        tss__rank_one(12, -2 * k, g, H);
    }
}

// Cuts a 12-vector or 12 × 12 matrix of four points in space down to m nodes in d dimensions.
static void tss__cut_vector(int m, int dim, const double *in, double *out) {
    for (int i = 0; i < m; i++)
        for (int a = 0; a < dim; a++) out[i * dim + a] = in[3 * i + a];
}
static void tss__cut_matrix(int m, int dim, const double *in, double *out) {
    for (int i = 0; i < m * dim; i++)
        tss__cut_vector(m, dim, in + 12 * (3 * (i / dim) + i % dim), out + i * m * dim);
}

double tss_ipc_feature_distance(tss_ipc_kind kind, int dim, int feature, const double *x,
                                double *gradient, double *hessian) {
    tss__v3 v[4];
    tss__pair_load(kind, dim, x, v);
    if (feature < 0 || feature >= tss__feature_count(kind))
        feature = (int)tss__near_of(kind, v).feature;
    tss__frame f = tss__frame_of(kind, feature, v);
    int m = tss_ipc_pair_nodes(kind);
    if (gradient) {
        double g[12];
        tss__frame_gradient(&f, g);
        tss__cut_vector(m, dim, g, gradient);
    }
    if (hessian) {
        double H[144];
        memset(H, 0, sizeof H);
        tss__frame_hessian(&f, 1, H);
        tss__cut_matrix(m, dim, H, hessian);
    }
    return f.d;
}

// ---------------------------------------------------------------------------------------------
// >>barrier (private)
// ---------------------------------------------------------------------------------------------

TSS__INLINE uint64_t tss__ipc_bits(double a) {
    uint64_t u;
    memcpy(&u, &a, 8);
    return u;
}
TSS__INLINE double tss__ipc_from_bits(uint64_t u) {
    double a;
    memcpy(&a, &u, 8);
    return a;
}

// ln z for normal z > 0, below 1 ulp: z = 2^k (1 + f), 1 + f ∈ [√½, √2), and with s = f/(2 + f)
// ln(1 + f) = 2 artanh s (minimax coefficients of the usual C libraries). No branch, no call:
// the same bits on every platform, and a vector of them where libm's log gives one.
TSS__INLINE double tss__ipc_log(double z) {
    const uint64_t sqrt_half = 0x3fe6a09e667f3bcdULL, one = 0x3ff0000000000000ULL;
    uint64_t u = tss__ipc_bits(z) - sqrt_half + one;  // its exponent field is k + 1023
    // An integer below 2^52 in the mantissa of 2^52 becomes a double by one subtraction.
    double k = tss__ipc_from_bits((u >> 52) | 0x4330000000000000ULL) - (4503599627370496.0 + 1023);
    double f = tss__ipc_from_bits((u & 0x000fffffffffffffULL) + sqrt_half) - 1;
    double s = f / (2 + f), z2 = s * s, w = z2 * z2, half = 0.5 * f * f;
    double t1 = w * (3.999999999940941908e-01 +
                     w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01));
    double t2 = z2 * (6.666666666666735130e-01 +
                      w * (2.857142874366239149e-01 +
                           w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01)));
    double ln2_high = 6.93147180369123816490e-01, ln2_low = 1.90821492927058770002e-10;
    return k * ln2_high - ((half - (s * (half + t1 + t2) + k * ln2_low)) - f);
}

typedef struct tss__barrier {
    double b, b1, b2;
} tss__barrier;

// b, b′, b″ for d > 0, all written in z = d̂/d and ln(d/d̂); 0 beyond d̂, +inf at d <= 0.
TSS__INLINE tss__barrier tss__barrier_of(double d, double dhat) {
    // Below this ln has no exponent left; nothing that is feasible comes there.
    int touch = !(d > DBL_MIN), in = d < dhat;
    double dd = touch ? 1 : d, z = dhat / dd, gap = dhat - dd, ln = tss__ipc_log(dd / dhat);
    tss__barrier o;
    o.b = -gap * gap * ln;
    o.b1 = gap * (2 * ln - z + 1);
    o.b2 = (z + 2) * z - 2 * ln - 3;
    o.b = touch ? HUGE_VAL : in ? o.b : 0;
    o.b1 = touch ? -HUGE_VAL : in ? o.b1 : 0;
    o.b2 = touch ? HUGE_VAL : in ? o.b2 : 0;
    return o;
}

double tss_ipc_barrier(double d, double dhat, double *b1, double *b2) {
    tss__barrier o = tss__barrier_of(d, dhat);
    if (b1) *b1 = o.b1;
    if (b2) *b2 = o.b2;
    return o.b;
}

// ---------------------------------------------------------------------------------------------
// >>mollifier (private)
// c = ‖ea × eb‖² = ‖ea‖²‖eb‖² − (ea·eb)², as a function of the two edge vectors:
//   c_a = 2 (‖eb‖² ea − (ea·eb) eb),    c_aa = 2 (‖eb‖² I − eb ebᵀ),
//   c_ab = 4 ea ebᵀ − 2 eb eaᵀ − 2 (ea·eb) I;   b likewise.
// ---------------------------------------------------------------------------------------------

TSS__INLINE double tss__mollifier_of(double c, double eps) {
    double q = c / eps;
    return c < eps ? (2 - q) * q : 1;
}

TSS__INLINE double tss__edges_cross2(tss__v3 ea, tss__v3 eb) {
    tss__v3 n = tss__v3_cross(ea, eb);
    return tss__v3_dot(n, n);
}

TSS__INLINE double tss__mollifier_eps(tss__v3 ea, tss__v3 eb) {
    return 1e-3 * tss__v3_dot(ea, ea) * tss__v3_dot(eb, eb);
}

// Gradient of c by nodes, 12 numbers.
static void tss__cross2_gradient(tss__v3 ea, tss__v3 eb, double g[12]) {
    double ab = tss__v3_dot(ea, eb);
    tss__v3 ca = tss__v3_add(tss__v3_scale(2 * tss__v3_dot(eb, eb), ea), -2 * ab, eb);
    tss__v3 cb = tss__v3_add(tss__v3_scale(2 * tss__v3_dot(ea, ea), eb), -2 * ab, ea);
    tss__v3_store(tss__v3_scale(-1, ca), g);
    tss__v3_store(ca, g + 3);
    tss__v3_store(tss__v3_scale(-1, cb), g + 6);
    tss__v3_store(cb, g + 9);
}

// H (12 × 12) += k ∇²c
static void tss__cross2_hessian(tss__v3 va, tss__v3 vb, double k, double *H) {
    double a[3], b[3];
    tss__v3_store(va, a), tss__v3_store(vb, b);
    double aa = tss__v3_dot(va, va), bb = tss__v3_dot(vb, vb), ab = tss__v3_dot(va, vb);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double one = i == j ? 1 : 0;
            double haa = 2 * k * (bb * one - b[i] * b[j]), hbb = 2 * k * (aa * one - a[i] * a[j]);
            double hab = k * (4 * a[i] * b[j] - 2 * b[i] * a[j] - 2 * ab * one);
            for (int p = 0; p < 2; p++)
                for (int q = 0; q < 2; q++) {
                    double sign = p == q ? 1 : -1;
                    H[(3 * p + i) * 12 + 3 * q + j] += sign * haa;
                    H[(6 + 3 * p + i) * 12 + 6 + 3 * q + j] += sign * hbb;
                    H[(3 * p + i) * 12 + 6 + 3 * q + j] += sign * hab;
                    H[(6 + 3 * q + j) * 12 + 3 * p + i] += sign * hab;
                }
        }
}

double tss_ipc_mollifier(const double *x, double eps, double *gradient, double *hessian) {
    tss__v3 v[4];
    tss__pair_load(TSS_IPC_EDGE_EDGE, 3, x, v);
    tss__v3 ea = tss__v3_sub(v[1], v[0]), eb = tss__v3_sub(v[3], v[2]);
    double c = tss__edges_cross2(ea, eb), g[12];
    // m′ = 2 (1 − c/ε)/ε, m″ = −2/ε²
    double m1 = c < eps ? 2 * (1 - c / eps) / eps : 0, m2 = c < eps ? -2 / (eps * eps) : 0;
    tss__cross2_gradient(ea, eb, g);
    if (gradient)
        for (int i = 0; i < 12; i++) gradient[i] = m1 * g[i];
    if (hessian) {
        memset(hessian, 0, 144 * sizeof *hessian);
        tss__cross2_hessian(ea, eb, m1, hessian);
        tss__rank_one(12, m2, g, hessian);
    }
    return tss__mollifier_of(c, eps);
}

double tss_ipc_mollifier_eps(const double *X) {
    tss__v3 v[4];
    tss__pair_load(TSS_IPC_EDGE_EDGE, 3, X, v);
    return tss__mollifier_eps(tss__v3_sub(v[1], v[0]), tss__v3_sub(v[3], v[2]));
}

// ---------------------------------------------------------------------------------------------
// >>friction_math (private)
// ---------------------------------------------------------------------------------------------

void tss_ipc_friction(double y, double eps, double out[4]) {
    double q = y / eps;
    if (y < eps) {
        out[0] = y * q * (1 - q / 3) + eps / 3;
        out[1] = q * (2 - q);
        out[2] = 2 * (1 - q) / eps;
        out[3] = (2 - q) / eps;
    } else {
        out[0] = y;
        out[1] = 1;
        out[2] = 0;
        out[3] = 1 / y;
    }
}

// Two unit vectors orthogonal to the unit vector n (Duff et al. 2017): no branch, no square root.
TSS__INLINE void tss__tangents_of(tss__v3 n, tss__v3 *t1, tss__v3 *t2) {
    double sign = copysign(1.0, n.z), a = -1 / (sign + n.z), b = n.x * n.y * a;
    *t1 = tss__v3_of(1 + sign * n.x * n.x * a, sign * b, -sign * n.x);
    *t2 = tss__v3_of(b, sign + n.y * n.y * a, -n.y);
}

void tss_ipc_tangents(int dim, const double *n, double *t) {
    if (dim == 2) {
        t[0] = -n[1], t[1] = n[0];
        return;
    }
    tss__v3 t1, t2;
    tss__tangents_of(tss__v3_of(n[0], n[1], n[2]), &t1, &t2);
    tss__v3_store(t1, t);
    tss__v3_store(t2, t + 3);
}

// ---------------------------------------------------------------------------------------------
// >>additive_ccd (private)
// Method: conservative advancement. For any unit vector n the distance of two convex primitives is
// at least min over their vertices a, b of n·(a − b), and each of these moves linearly: with n
// along the shortest vector at time t, the two stay g apart until the first of at most four linear
// functions falls to g. Advance there, take a new n, repeat (Mirtich 1996; Li et al. 2021, whose
// step is (distance − g) / (bound of the relative speed): this one is never shorter). Common motion
// drops out of a − b. A poor n makes a step shorter, never wrong.
// Rounding: the functions are built from x and d themselves, not from advanced positions, and each
// is lowered by 8 eps of its terms' sizes (differences 1, products and sum 3, ‖n‖ 3, evaluation 1).
// Limit: states are rounded to about eps · |coordinate| when stored; slack · distance must exceed it
// (contact in a world sees to that: >>collision_free_step).
// Cost: one closest-point evaluation a step; most pairs need one step.
// ---------------------------------------------------------------------------------------------

#define TSS__CCD_ROUNDING (8 * DBL_EPSILON)

// The up to four vertex pairs a − b of two primitives: q + t u.
typedef struct tss__sweep {
    int pairs;
    tss__v3 q[4], u[4];
} tss__sweep;

static void tss__sweep_of(tss_ipc_kind kind, const tss__v3 v[4], const tss__v3 d[4],
                          tss__sweep *s) {
    int first = kind == TSS_IPC_EDGE_EDGE ? 2 : 1, all = tss_ipc_pair_nodes(kind);
    s->pairs = 0;
    for (int a = 0; a < first; a++)
        for (int b = first; b < all; b++) {
            s->q[s->pairs] = tss__v3_sub(v[a], v[b]);
            s->u[s->pairs++] = tss__v3_sub(d[a], d[b]);
        }
}

TSS__INLINE double tss__v3_sum_abs(tss__v3 a) { return fabs(a.x) + fabs(a.y) + fabs(a.z); }

// Lower bound of n·(a − b) at t over all vertex pairs.
static double tss__sweep_gap(const tss__sweep *s, tss__v3 n, double t) {
    double low = HUGE_VAL;
    for (int j = 0; j < s->pairs; j++) {
        double size = tss__v3_sum_abs(s->q[j]) + t * tss__v3_sum_abs(s->u[j]);
        double gap = tss__v3_dot(n, s->q[j]) + t * tss__v3_dot(n, s->u[j]);
        gap -= TSS__CCD_ROUNDING * size;
        // Not a number counts as touching.
        low = gap >= low ? low : gap == gap ? gap : -HUGE_VAL;
    }
    return low;
}

// The time at which the first lower bound falls to g (+inf: never).
static double tss__sweep_time(const tss__sweep *s, tss__v3 n, double g) {
    double first = HUGE_VAL;
    for (int j = 0; j < s->pairs; j++) {
        double speed = tss__v3_dot(n, s->u[j]) - TSS__CCD_ROUNDING * tss__v3_sum_abs(s->u[j]);
        double gap = tss__v3_dot(n, s->q[j]) - TSS__CCD_ROUNDING * tss__v3_sum_abs(s->q[j]) - g;
        double t = speed < 0 ? gap / -speed * (1 - 4 * DBL_EPSILON) : HUGE_VAL;
        if (t < first) first = t;
    }
    return first;
}

// A direction to separate the pair along: r, made orthogonal to what it leaves. The rounding of far
// ends turns a short r, and the same far ends magnify that. So: the normal of both edges, or of the
// triangle, where r is as good as parallel to it (squared lengths to 1e-5, as in the lanes below);
// else r without its part along the longer of the edges on whose inside a closest point lies.
#define TSS__AS_NORMAL (1 - 1e-5)

static tss__v3 tss__near_direction(tss_ipc_kind kind, const tss__v3 v[4], tss__near near) {
    const tss__feature *all = tss__features[kind], *row = &all[(int)near.feature];
    const tss__feature *inside = &all[tss__feature_count(kind) - 1];
    tss__v3 e[2] = {{0, 0, 0}, {0, 0, 0}}, along = {0, 0, 0};
    for (int k = 0; k < inside->params; k++) {
        double D[4];
        for (int i = 0; i < 4; i++) D[i] = inside->D[k][i];
        e[k] = tss__v3_sum(D, v);
    }
    tss__v3 n = tss__v3_cross(e[0], e[1]);
    double nn = tss__v3_dot(n, n), rn = tss__v3_dot(near.r, n);
    if (nn > TSS__SIN2_NORMAL * tss__v3_dot(e[0], e[0]) * tss__v3_dot(e[1], e[1]) &&
        rn * rn >= TSS__AS_NORMAL * nn * near.d)
        return rn > 0 ? n : tss__v3_scale(-1, n);
    for (int k = 0; k < row->params; k++) {
        double D[4];
        for (int i = 0; i < 4; i++) D[i] = row->D[k][i];
        tss__v3 edge = tss__v3_sum(D, v);
        if (tss__v3_dot(edge, edge) > tss__v3_dot(along, along)) along = edge;
    }
    double ee = tss__v3_dot(along, along);
    return ee > 0 ? tss__v3_add(near.r, -tss__v3_dot(near.r, along) / ee, along) : near.r;
}

double tss_ipc_ccd(tss_ipc_kind kind, int dim, const double *x, const double *d, double slack,
                   double t_max, int max_iterations, int *iterations) {
    tss__v3 v[4], u[4], now[4];
    tss__sweep s;
    double t = 0, g = 0;
    int limit = max_iterations > 0 ? max_iterations : 256, i;
    tss__pair_load(kind, dim, x, v);
    tss__pair_load(kind, dim, d, u);
    tss__sweep_of(kind, v, u, &s);
    for (i = 0; i < limit; i++) {
        for (int k = 0; k < 4; k++) now[k] = tss__v3_add(v[k], t, u[k]);
        tss__near near = tss__near_of(kind, now);
        tss__v3 n = tss__near_direction(kind, now, near);
        double nn = tss__v3_dot(n, n);
        if (!(near.d > 0 && nn > 0)) break;
        n = tss__v3_scale(1 / sqrt(nn), n);
        double gap = tss__sweep_gap(&s, n, t);
        if (i == 0) g = slack * gap;
        if (!(gap > 0 && gap >= g)) break;
        // Close enough to the slack, unless the whole way is free.
        double next = tss__sweep_time(&s, n, g);
        if (next >= t_max) {
            t = t_max;
            break;
        }
        if (gap <= 1.1 * g || !(next > t)) break;
        t = next;
    }
    if (iterations) *iterations = i < limit ? i + 1 : limit;
    return t < t_max ? t : t_max;
}

// As in public; the point stops at the distance least (‖n‖ = 1), or does not come nearer.
static double tss__ccd_plane(int dim, const double *x, const double *d, const double *o,
                             const double *n, double slack, double least, double t_max) {
    double gap = 0, speed = 0, size = 0, rate = 0;
    for (int i = 0; i < dim; i++) {
        gap += n[i] * (x[i] - o[i]), size += fabs(n[i] * (x[i] - o[i]));
        speed += n[i] * d[i], rate += fabs(n[i] * d[i]);
    }
    gap -= TSS__CCD_ROUNDING * size;
    speed -= TSS__CCD_ROUNDING * rate;
    if (!(gap > 0) || !(speed > -HUGE_VAL)) return 0;
    double way = gap - least < (1 - slack) * gap ? gap - least : (1 - slack) * gap;
    double t = speed < 0 ? (way > 0 ? way : 0) / -speed * (1 - 4 * DBL_EPSILON) : HUGE_VAL;
    return t < t_max ? t : t_max;
}

double tss_ipc_ccd_plane(int dim, const double *x, const double *d, const double *o,
                         const double *n, double slack, double t_max) {
    return tss__ccd_plane(dim, x, d, o, n, slack, 0, t_max);
}

// ---------------------------------------------------------------------------------------------
// >>contact_lanes (private)
// Value, gradient and Hessian of scale · m · b(d) for eight pairs of one kind at a time: arrays of
// eight, loops over lanes, no branch inside, so that the compiler makes vectors of them.
// ---------------------------------------------------------------------------------------------

enum { TSS__LANES = 8 };
typedef double tss__lane[TSS__LANES];

// Square roots of eight numbers. A loop of sqrt stays scalar unless the program is compiled with
// -fno-math-errno, which a header cannot ask for; all of these round correctly: the same bits.
TSS__INLINE void tss__lanes_sqrt(double *a) {
#if defined(__AVX512F__)
    _mm512_storeu_pd(a, _mm512_sqrt_pd(_mm512_loadu_pd(a)));
#elif defined(__AVX__)
    for (int l = 0; l < TSS__LANES; l += 4)
        _mm256_storeu_pd(a + l, _mm256_sqrt_pd(_mm256_loadu_pd(a + l)));
#elif defined(__SSE2__)
    for (int l = 0; l < TSS__LANES; l += 2) _mm_storeu_pd(a + l, _mm_sqrt_pd(_mm_loadu_pd(a + l)));
#elif defined(__aarch64__)
    for (int l = 0; l < TSS__LANES; l += 2) vst1q_f64(a + l, vsqrtq_f64(vld1q_f64(a + l)));
#else
    for (int l = 0; l < TSS__LANES; l++) a[l] = sqrt(a[l]);
#endif
}

// A job: up to eight pairs of one kind.
typedef struct tss__eight {
    tss_ipc_kind kind;
    int dim, arity, count;  // arity: nodes a stencil of the caller's, >= the pair's
    const double *x, *X;    // positions now and at rest, of all nodes
    double dhat;            // squared
    const int *node[TSS__LANES];
    double scale[TSS__LANES];  // κ · w
    double *out[TSS__LANES];   // 1, arity·dim or (arity·dim)² numbers
} tss__eight;

typedef struct tss__eight_near {
    tss__lane c[4], r[3], d, feature;
} tss__eight_near;

// Coordinates by lane; unused lanes repeat lane 0, missing nodes the pair's last.
static void tss__eight_load(const tss__eight *e, const double *x, tss__lane v[12]) {
    int m = tss_ipc_pair_nodes(e->kind);
    for (int l = 0; l < TSS__LANES; l++) {
        const int *node = e->node[l < e->count ? l : 0];
        for (int i = 0; i < 4; i++) {
            const double *p = x + (size_t)node[i < m ? i : m - 1] * (size_t)e->dim;
            v[3 * i][l] = p[0];
            v[3 * i + 1][l] = p[1];
            v[3 * i + 2][l] = e->dim == 3 ? p[2] : 0;
        }
    }
}

TSS__INLINE tss__v3 tss__lane_v3(tss__lane *v, int i, int l) {
    return tss__v3_of(v[3 * i][l], v[3 * i + 1][l], v[3 * i + 2][l]);
}

TSS__INLINE tss__near tss__lane_near(int kind, tss__lane *v, int l) {
    tss__v3 a = tss__lane_v3(v, 0, l), b = tss__lane_v3(v, 1, l);
    if (kind == TSS_IPC_POINT_POINT) return tss__near_pp(a, b);
    tss__v3 c = tss__lane_v3(v, 2, l);
    if (kind == TSS_IPC_POINT_EDGE) return tss__near_pe(a, b, c);
    tss__v3 d = tss__lane_v3(v, 3, l);
    return kind == TSS_IPC_EDGE_EDGE ? tss__near_ee(a, b, c, d) : tss__near_pt(a, b, c, d);
}

// Instantiated once a kind, so that kind is a constant in the loop.
TSS__INLINE void tss__lanes_near(int kind, tss__lane *TSS__RESTRICT v,
                                 tss__eight_near *TSS__RESTRICT o) {
    for (int l = 0; l < TSS__LANES; l++) {
        tss__near k = tss__lane_near(kind, v, l);
        o->c[0][l] = k.c0, o->c[1][l] = k.c1, o->c[2][l] = k.c2, o->c[3][l] = k.c3;
        o->r[0][l] = k.r.x, o->r[1][l] = k.r.y, o->r[2][l] = k.r.z;
        o->d[l] = k.d, o->feature[l] = k.feature;
    }
}

static void tss__eight_closest(tss_ipc_kind kind, tss__lane *TSS__RESTRICT v,
                               tss__eight_near *TSS__RESTRICT o) {
    switch (TSS__IPC_KIND(kind)) {
        case TSS_IPC_EDGE_EDGE:
            tss__lanes_near(TSS_IPC_EDGE_EDGE, v, o);
            break;
        case TSS_IPC_POINT_TRIANGLE:
            tss__lanes_near(TSS_IPC_POINT_TRIANGLE, v, o);
            break;
        case TSS_IPC_POINT_EDGE:
            tss__lanes_near(TSS_IPC_POINT_EDGE, v, o);
            break;
        default:
            tss__lanes_near(TSS_IPC_POINT_POINT, v, o);
            break;
    }
}

TSS__INLINE void tss__lanes_distance(int kind, tss__lane *TSS__RESTRICT v,
                                     double *TSS__RESTRICT d) {
    for (int l = 0; l < TSS__LANES; l++) d[l] = tss__lane_near(kind, v, l).d;
}

// Squared distances alone: what value and the search for active pairs need.
static void tss__eight_distance(tss_ipc_kind kind, tss__lane *TSS__RESTRICT v,
                                double *TSS__RESTRICT d) {
    switch (TSS__IPC_KIND(kind)) {
        case TSS_IPC_EDGE_EDGE:
            tss__lanes_distance(TSS_IPC_EDGE_EDGE, v, d);
            break;
        case TSS_IPC_POINT_TRIANGLE:
            tss__lanes_distance(TSS_IPC_POINT_TRIANGLE, v, d);
            break;
        case TSS_IPC_POINT_EDGE:
            tss__lanes_distance(TSS_IPC_POINT_EDGE, v, d);
            break;
        default:
            tss__lanes_distance(TSS_IPC_POINT_POINT, v, d);
            break;
    }
}

// Any lane nearer than d̂? Trial states of a line search are mostly far: they cost a distance only.
static int tss__eight_active(const tss__eight *e, const double *d) {
    int any = 0;
    for (int l = 0; l < TSS__LANES; l++) any |= d[l] < e->dhat;
    return any;
}

// Mollifier of edge–edge lanes: m and m′ by c (1 and 0 for the other kinds).
static void tss__eight_mollify(const tss__eight *e, tss__lane *v, double *m, double *m1) {
    tss__lane V[12];
    if (TSS__IPC_KIND(e->kind) != TSS_IPC_EDGE_EDGE) {
        for (int l = 0; l < TSS__LANES; l++) m[l] = 1, m1[l] = 0;
        return;
    }
    tss__eight_load(e, e->X, V);
    for (int l = 0; l < TSS__LANES; l++) {
        double eps = tss__mollifier_eps(tss__v3_sub(tss__lane_v3(V, 1, l), tss__lane_v3(V, 0, l)),
                                        tss__v3_sub(tss__lane_v3(V, 3, l), tss__lane_v3(V, 2, l)));
        double c = tss__edges_cross2(tss__v3_sub(tss__lane_v3(v, 1, l), tss__lane_v3(v, 0, l)),
                                     tss__v3_sub(tss__lane_v3(v, 3, l), tss__lane_v3(v, 2, l)));
        double q = c / eps, s = 2 * (1 - q) / eps;
        m[l] = c < eps ? (2 - q) * q : 1;
        m1[l] = c < eps ? s : 0;
    }
}

// out[l][0] = scale · m · b; dist (may be NULL) receives the squared distances.
static void tss__eight_value(const tss__eight *e, double *dist) {
    tss__lane v[12], d, m, m1, b;
    tss__eight_load(e, e->x, v);
    tss__eight_distance(e->kind, v, d);
    if (dist) memcpy(dist, d, sizeof d);
    if (!tss__eight_active(e, d)) {
        for (int l = 0; l < e->count; l++) e->out[l][0] = 0;
        return;
    }
    tss__eight_mollify(e, v, m, m1);
    for (int l = 0; l < TSS__LANES; l++) b[l] = tss__barrier_of(d[l], e->dhat).b;
    // Touching parallel edges would be 0 · inf; they touch.
    for (int l = 0; l < e->count; l++)
        e->out[l][0] = b[l] == HUGE_VAL ? HUGE_VAL : e->scale[l] * (m[l] * b[l]);
}

// ∇(m b) = m b′ 2 c ⊗ r + b m′ ∇c, by lane: 12 rows.
static void tss__lanes_gradient(tss__lane *TSS__RESTRICT v, const tss__eight_near *TSS__RESTRICT n,
                                double dhat, const double *TSS__RESTRICT m,
                                const double *TSS__RESTRICT m1, tss__lane *TSS__RESTRICT g) {
    for (int l = 0; l < TSS__LANES; l++) {
        tss__barrier b = tss__barrier_of(n->d[l], dhat);
        double k = 2 * m[l] * b.b1;
        for (int i = 0; i < 12; i++) g[i][l] = k * n->c[i / 3][l] * n->r[i % 3][l];
        tss__v3 ea = tss__v3_sub(tss__lane_v3(v, 1, l), tss__lane_v3(v, 0, l));
        tss__v3 eb = tss__v3_sub(tss__lane_v3(v, 3, l), tss__lane_v3(v, 2, l));
        double f = 2 * b.b * m1[l], ab = tss__v3_dot(ea, eb);
        tss__v3 ga = tss__v3_add(tss__v3_scale(f * tss__v3_dot(eb, eb), ea), -f * ab, eb);
        tss__v3 gb = tss__v3_add(tss__v3_scale(f * tss__v3_dot(ea, ea), eb), -f * ab, ea);
        g[0][l] -= ga.x, g[1][l] -= ga.y, g[2][l] -= ga.z;
        g[3][l] += ga.x, g[4][l] += ga.y, g[5][l] += ga.z;
        g[6][l] -= gb.x, g[7][l] -= gb.y, g[8][l] -= gb.z;
        g[9][l] += gb.x, g[10][l] += gb.y, g[11][l] += gb.z;
    }
}

static void tss__eight_gradient(const tss__eight *e) {
    tss__lane v[12], m, m1, g[12];
    tss__eight_near n;
    int all = e->arity * e->dim, used = tss_ipc_pair_nodes(e->kind) * e->dim;
    tss__eight_load(e, e->x, v);
    tss__eight_closest(e->kind, v, &n);
    int any = tss__eight_active(e, n.d);
    if (any) {
        tss__eight_mollify(e, v, m, m1);
        tss__lanes_gradient(v, &n, e->dhat, m, m1, g);
    }
    for (int l = 0; l < e->count; l++) {
        double *out = e->out[l], k = e->scale[l];
        int filled = any && n.d[l] < e->dhat ? used : 0;
        if (e->dim == 3)
            for (int i = 0; i < filled; i++) out[i] = k * g[i][l];
        else
            for (int i = 0; i < filled; i++) out[i] = k * g[i + i / 2][l];
        for (int i = filled; i < all; i++) out[i] = 0;
    }
}

// ---------------------------------------------------------------------------------------------
// >>jacobi_lanes (private)
// Eigenpairs of eight symmetric n × n matrices at once by cyclic Jacobi rotations. A (upper
// triangle used) becomes diagonal, the columns of V the eigenvectors.
// The projection to the positive semi-definite cone does not expand distances, so what is left off
// the diagonal bounds the error of the projected matrix: stop at 1e-12 of the norm.
// ---------------------------------------------------------------------------------------------

// (u, w) ← (c u − s w, s u + c w)
TSS__INLINE void tss__rotate(double *TSS__RESTRICT u, double *TSS__RESTRICT w,
                             const double *TSS__RESTRICT c, const double *TSS__RESTRICT s) {
    TSS__KEEP_LOOP
    for (int l = 0; l < TSS__LANES; l++) {
        double a = u[l], b = w[l];
        u[l] = c[l] * a - s[l] * b;
        w[l] = s[l] * a + c[l] * b;
    }
}

// The rotation that makes a_pq zero: t = tan is the smaller root of t² + 2 t (a_qq − a_pp)/(2 a_pq)
// = 1. Lanes with on = 0 get the identity: a matrix's bits do not depend on its neighbours' number
// of sweeps.
TSS__INLINE void tss__rotation(double *TSS__RESTRICT pp, double *TSS__RESTRICT qq,
                               double *TSS__RESTRICT pq, const double *TSS__RESTRICT on,
                               double *TSS__RESTRICT c, double *TSS__RESTRICT s) {
    tss__lane root, tan;
    TSS__KEEP_LOOP
    for (int l = 0; l < TSS__LANES; l++) {
        double half = 0.5 * (qq[l] - pp[l]), a = on[l] * pq[l];
        root[l] = half * half + a * a;
    }
    tss__lanes_sqrt(root);
    TSS__KEEP_LOOP
    for (int l = 0; l < TSS__LANES; l++) {
        double half = 0.5 * (qq[l] - pp[l]), a = on[l] * pq[l];
        double t = (half < 0 ? -a : a) / (fabs(half) + root[l] + DBL_MIN);
        pp[l] -= t * a, qq[l] += t * a, pq[l] -= a;
        tan[l] = t, root[l] = 1 + t * t;
    }
    tss__lanes_sqrt(root);
    TSS__KEEP_LOOP
    for (int l = 0; l < TSS__LANES; l++) c[l] = 1 / root[l], s[l] = tan[l] / root[l];
}

// on = 1 for lanes whose sum of squares off the diagonal is not yet negligible. Returns whether
// any.
static int tss__jacobi_open(int n, tss__lane *A, double *on) {
    tss__lane off = {0}, all = {0};
    double any = 0;
    for (int i = 0; i < n; i++)
        for (int j = i; j < n; j++) TSS__KEEP_LOOP
    for (int l = 0; l < TSS__LANES; l++) {
        double a2 = A[i * n + j][l] * A[i * n + j][l];
        off[l] += i == j ? 0 : a2;
        all[l] += a2;
    }
    TSS__KEEP_LOOP
    for (int l = 0; l < TSS__LANES; l++) on[l] = off[l] > 1e-24 * all[l] ? 1 : 0;
    TSS__KEEP_LOOP
    for (int l = 0; l < TSS__LANES; l++) any += on[l];
    return any > 0;
}

TSS__INLINE void tss__jacobi_lanes(int n, tss__lane *A, tss__lane *V) {
    tss__lane on, c, s;
    for (int i = 0; i < n * n; i++) TSS__KEEP_LOOP
    for (int l = 0; l < TSS__LANES; l++) V[i][l] = i / n == i % n ? 1 : 0;
    // Convergence is quadratic: 3 to 6 sweeps; 12 is never reached with finite numbers.
    for (int sweep = 0; sweep < 12 && tss__jacobi_open(n, A, on); sweep++)
        for (int p = 0; p < n - 1; p++)
            for (int q = p + 1; q < n; q++) {
                tss__rotation(A[p * n + p], A[q * n + q], A[p * n + q], on, c, s);
                for (int k = 0; k < n; k++) {
                    if (k != p && k != q)
                        tss__rotate(A[k < p ? k * n + p : p * n + k],
                                    A[k < q ? k * n + q : q * n + k], c, s);
                    tss__rotate(V[k * n + p], V[k * n + q], c, s);
                }
            }
}

static void tss__jacobi5(tss__lane *A, tss__lane *V) { tss__jacobi_lanes(5, A, V); }
static void tss__jacobi9(tss__lane *A, tss__lane *V) { tss__jacobi_lanes(9, A, V); }

// ---------------------------------------------------------------------------------------------
// >>contact_hessian (private)
// With n = r/ρ, w = Σ c_i δx_i and γ^k = ρ G^k (see feature_distance) the Hessian of b(d) is
//   α (n·w)² + β Σ_k [(t_k·w + n·γ^kδx)² − (t_k·w)²],   α = 2 b′ + 4 d b″,   β = −2 b′ > 0.
// c and γ^k sum to zero over the nodes, so it lives on five directions of the twelve: (three
// translation-free combinations of nodes) ⊗ n, ĉ ⊗ t_1, ĉ ⊗ t_2. A 5 × 5 eigenproblem therefore
// gives the nearest positive semi-definite matrix exactly; at most three eigenvalues are positive.
// With one parameter the term −β (t_2·w)² is an eigenvector of its own and negative: it and, with
// none, both such terms are left out from the start. 2D is the same with z = 0.
// Mollified pairs: all of m b's Hessian on the nine translation-free directions, 9 × 9, the same
// way.
// ---------------------------------------------------------------------------------------------

// The basis of the five directions and the 5 × 5 matrix, by lane.
typedef struct tss__reduced {
    tss__lane D[8], S[25], V[25];
    tss__lane n[3], t1[3], t2[3];   // frame in space
    tss__lane c[4], cn;             // c and its length
    tss__lane q1[3], q2[3], q3[3];  // basis of node combinations, in the coordinates of tss__haar
} tss__reduced;

// Node weights (4, sum 0) ↔ coordinates in the orthonormal rows (1 1 −1 −1)/2, (1 −1 1 −1)/2,
// (1 −1 −1 1)/2.
TSS__INLINE tss__v3 tss__haar(double a, double b, double c, double d) {
    return tss__v3_of(0.5 * (a + b - c - d), 0.5 * (a - b + c - d), 0.5 * (a - b - c + d));
}
TSS__INLINE void tss__haar_back(tss__v3 h, double w[4]) {
    w[0] = 0.5 * (h.x + h.y + h.z);
    w[1] = 0.5 * (h.x - h.y - h.z);
    w[2] = 0.5 * (-h.x + h.y - h.z);
    w[3] = 0.5 * (-h.x - h.y + h.z);
}

TSS__INLINE void tss__lane_store(tss__lane *out, int l, tss__v3 a) {
    out[0][l] = a.x, out[1][l] = a.y, out[2][l] = a.z;
}

TSS__INLINE tss__v3 tss__lane_sum(tss__lane *D, tss__lane *v, int l) {
    tss__v3 s = tss__v3_scale(D[0][l], tss__lane_v3(v, 0, l));
    for (int i = 1; i < 4; i++) s = tss__v3_add(s, D[i][l], tss__lane_v3(v, i, l));
    return s;
}

// Frame (n, t_1, t_2) and γ^1, γ^2 (as node weights g).
TSS__INLINE void tss__lanes_frame(tss__lane *TSS__RESTRICT v,
                                  const tss__eight_near *TSS__RESTRICT o,
                                  tss__reduced *TSS__RESTRICT R, tss__lane *TSS__RESTRICT g) {
    tss__lane e[6], u[3], len1, len2, len;
    for (int l = 0; l < TSS__LANES; l++) {
        tss__v3 e1 = tss__lane_sum(R->D, v, l), e2 = tss__lane_sum(R->D + 4, v, l);
        tss__lane_store(e, l, e1);
        tss__lane_store(e + 3, l, e2);
        len1[l] = tss__v3_dot(e1, e1), len2[l] = tss__v3_dot(e2, e2);
    }
    memcpy(len, len1, sizeof len);
    tss__lanes_sqrt(len1);
    for (int l = 0; l < TSS__LANES; l++) {
        tss__v3 e1 = tss__lane_v3(e, 0, l), e2 = tss__lane_v3(e, 1, l);
        tss__v3 r = tss__v3_of(o->r[0][l], o->r[1][l], o->r[2][l]), N = tss__v3_cross(e1, e2);
        tss__v3 t1 = tss__v3_scale(len[l] > 0 ? 1 / len1[l] : 0, e1);
        int plane = tss__v3_dot(N, N) > TSS__SIN2_NORMAL * len[l] * len2[l];
        // r is orthogonal to t_1 but for its rounding, which a short r magnifies.
        tss__v3 n = tss__v3_pick(plane, N, tss__v3_add(r, -tss__v3_dot(r, t1), t1));
        tss__lane_store(u, l, n);
        tss__lane_store(R->t1, l, t1);
        len[l] = tss__v3_dot(n, n) + DBL_MIN, len1[l] = len[l] > 0 ? len1[l] : 0;
    }
    tss__lanes_sqrt(len);
    for (int l = 0; l < TSS__LANES; l++) {
        tss__v3 n = tss__v3_scale(1 / len[l], tss__lane_v3(u, 0, l));
        tss__v3 t1 = tss__lane_v3(R->t1, 0, l), t2 = tss__v3_cross(n, t1);
        tss__v3 e2 = tss__lane_v3(e, 1, l);
        double R12 = tss__v3_dot(t1, e2), R22 = tss__v3_dot(t2, e2), size = R22 * R22;
        double i11 = len1[l] > 0 ? 1 / len1[l] : 0, i22 = size > 0 ? R22 / size : 0;
        double rho = o->r[0][l] * n.x + o->r[1][l] * n.y + o->r[2][l] * n.z;
        for (int i = 0; i < 4; i++) {
            double g1 = rho * i11 * R->D[i][l];
            g[i][l] = g1;
            g[4 + i][l] = i22 * (rho * R->D[4 + i][l] - R12 * g1);
        }
        tss__lane_store(R->n, l, n);
        tss__lane_store(R->t2, l, t2);
    }
}

// The 5 × 5 matrix on q1 n, q2 n, q3 n, ĉ t_1, ĉ t_2 with q1 = ĉ.
TSS__INLINE void tss__lanes_matrix(const tss__eight_near *TSS__RESTRICT o,
                                   tss__lane *TSS__RESTRICT g, double dhat,
                                   tss__reduced *TSS__RESTRICT R) {
    for (int l = 0; l < TSS__LANES; l++) {
        tss__v3 c = tss__haar(o->c[0][l], o->c[1][l], o->c[2][l], o->c[3][l]);
        R->cn[l] = tss__v3_dot(c, c);
    }
    tss__lanes_sqrt(R->cn);
    for (int l = 0; l < TSS__LANES; l++) {
        double cn = R->cn[l];
        tss__v3 c = tss__haar(o->c[0][l], o->c[1][l], o->c[2][l], o->c[3][l]), q2, q3;
        tss__v3 q1 = tss__v3_scale(1 / cn, c);
        tss__tangents_of(q1, &q2, &q3);
        tss__v3 h1 = tss__haar(g[0][l], g[1][l], g[2][l], g[3][l]);
        tss__v3 h2 = tss__haar(g[4][l], g[5][l], g[6][l], g[7][l]);
        tss__v3 a = tss__v3_of(tss__v3_dot(h1, q1), tss__v3_dot(h1, q2), tss__v3_dot(h1, q3));
        tss__v3 b = tss__v3_of(tss__v3_dot(h2, q1), tss__v3_dot(h2, q2), tss__v3_dot(h2, q3));
        tss__barrier k = tss__barrier_of(o->d[l], dhat);
        double alpha = 2 * k.b1 + 4 * o->d[l] * k.b2, beta = -2 * k.b1, bc = beta * cn;
        tss__lane *S = R->S;
        S[0][l] = alpha * cn * cn + beta * (a.x * a.x + b.x * b.x);
        S[1][l] = beta * (a.x * a.y + b.x * b.y);
        S[2][l] = beta * (a.x * a.z + b.x * b.z);
        S[3][l] = bc * a.x, S[4][l] = bc * b.x;
        S[6][l] = beta * (a.y * a.y + b.y * b.y);
        S[7][l] = beta * (a.y * a.z + b.y * b.z);
        S[8][l] = bc * a.y, S[9][l] = bc * b.y;
        S[12][l] = beta * (a.z * a.z + b.z * b.z);
        S[13][l] = bc * a.z, S[14][l] = bc * b.z;
        S[18][l] = 0, S[19][l] = 0, S[24][l] = 0;
        tss__lane_store(R->q1, l, q1);
        tss__lane_store(R->q2, l, q2);
        tss__lane_store(R->q3, l, q3);
    }
}

// out += k y yᵀ (k > 0) for y of 12 numbers (4 nodes × 3), cut to the caller's nodes and dimension.
static void tss__eight_rank_one(const tss__eight *e, double k, const double y[12], double *out) {
    int ad = e->arity * e->dim;
    double z[12], root = sqrt(k);
    if (ad == 12)
        memcpy(z, y, sizeof z);
    else
        tss__cut_vector(e->arity, e->dim, y, z);
    for (int i = 0; i < ad; i++) z[i] *= root;
    for (int i = 0; i < ad; i++)
        for (int j = 0; j < ad; j++) out[i * ad + j] += z[i] * z[j];
}

// Sum of the positive eigenvalues' rank-one matrices of lane l.
static void tss__reduced_expand(const tss__eight *e, tss__reduced *R, int l, double *out) {
    int m = tss_ipc_pair_nodes(e->kind);
    tss__v3 n = tss__lane_v3(R->n, 0, l), t1 = tss__lane_v3(R->t1, 0, l),
            t2 = tss__lane_v3(R->t2, 0, l);
    tss__v3 q1 = tss__lane_v3(R->q1, 0, l), q2 = tss__lane_v3(R->q2, 0, l),
            q3 = tss__lane_v3(R->q3, 0, l);
    for (int k = 0; k < 5; k++) {
        double lambda = R->S[6 * k][l], w[4], y[12] = {0};
        if (!(lambda > 0)) continue;
        tss__v3 h = tss__v3_scale(R->V[k][l], q1);
        h = tss__v3_add(tss__v3_add(h, R->V[5 + k][l], q2), R->V[10 + k][l], q3);
        tss__haar_back(h, w);
        tss__v3 t = tss__v3_add(tss__v3_scale(R->V[15 + k][l], t1), R->V[20 + k][l], t2);
        t = tss__v3_scale(1 / R->cn[l], t);
        for (int i = 0; i < m; i++)
            tss__v3_store(tss__v3_add(tss__v3_scale(w[i], n), R->c[i][l], t), y + 3 * i);
        tss__eight_rank_one(e, e->scale[l] * lambda, y, out);
    }
}

// Exact Hessian of m b for lane l, 12 × 12.
static void tss__lane_exact(const tss__eight *e, tss__lane *v, int feature, int l, double *H) {
    tss__v3 p[4];
    double g[12], gm[12], m1 = 0, m2 = 0, m = 1;
    for (int i = 0; i < 4; i++) p[i] = tss__lane_v3(v, i, l);
    tss__frame f = tss__frame_of(e->kind, feature, p);
    tss__barrier b = tss__barrier_of(f.d, e->dhat);
    memset(H, 0, 144 * sizeof *H);
    tss__frame_gradient(&f, g);
    if (TSS__IPC_KIND(e->kind) == TSS_IPC_EDGE_EDGE) {
        const int *node = e->node[l];
        tss__v3 V[4];
        for (int i = 0; i < 4; i++) {
            const double *X = e->X + 3 * (size_t)node[i];
            V[i] = tss__v3_of(X[0], X[1], X[2]);
        }
        double eps = tss__mollifier_eps(tss__v3_sub(V[1], V[0]), tss__v3_sub(V[3], V[2]));
        tss__v3 ea = tss__v3_sub(p[1], p[0]), eb = tss__v3_sub(p[3], p[2]);
        double c = tss__edges_cross2(ea, eb);
        if (c < eps) {
            m = tss__mollifier_of(c, eps), m1 = 2 * (1 - c / eps) / eps, m2 = -2 / (eps * eps);
            tss__cross2_gradient(ea, eb, gm);
            tss__cross2_hessian(ea, eb, b.b * m1, H);
            tss__rank_one(12, b.b * m2, gm, H);
            // m′ b′ (∇c ∇dᵀ + ∇d ∇cᵀ)
            for (int i = 0; i < 12; i++)
                for (int j = 0; j < 12; j++)
                    H[12 * i + j] += m1 * b.b1 * (gm[i] * g[j] + g[i] * gm[j]);
        }
    }
    tss__rank_one(12, m * b.b2, g, H);
    tss__frame_hessian(&f, m * b.b1, H);
}

// Rows p of the 3 × 4 matrix of tss__haar.
static const double tss__haar_row[3][4] = {
    {0.5, 0.5, -0.5, -0.5}, {0.5, -0.5, 0.5, -0.5}, {0.5, -0.5, -0.5, 0.5}};

// S = QᵀHQ on the nine translation-free directions (haar rows ⊗ axes), into lane l.
static void tss__lane_reduce9(const double *H, int l, tss__lane *S) {
    double half[9][12];
    for (int p = 0; p < 3; p++)
        for (int a = 0; a < 3; a++)
            for (int j = 0; j < 12; j++) {
                double s = 0;
                for (int i = 0; i < 4; i++) s += tss__haar_row[p][i] * H[(3 * i + a) * 12 + j];
                half[3 * p + a][j] = s;
            }
    for (int r = 0; r < 9; r++)
        for (int p = 0; p < 3; p++)
            for (int a = 0; a < 3; a++) {
                double s = 0;
                for (int i = 0; i < 4; i++) s += tss__haar_row[p][i] * half[r][3 * i + a];
                S[9 * r + 3 * p + a][l] = s;
            }
}

// Projected Hessians of the mollified lanes (mask), all in one 9 × 9 eigenproblem.
static void tss__eight_mollified(const tss__eight *e, tss__lane *v, const tss__eight_near *o,
                                 const int *mask) {
    tss__lane S[81], V[81];
    double H[144];
    memset(S, 0, sizeof S);
    for (int l = 0; l < e->count; l++)
        if (mask[l]) {
            tss__lane_exact(e, v, (int)o->feature[l], l, H);
            tss__lane_reduce9(H, l, S);
        }
    tss__jacobi9(S, V);
    for (int l = 0; l < e->count; l++)
        for (int k = 0; mask[l] && k < 9; k++) {
            double y[12] = {0};
            if (!(S[10 * k][l] > 0)) continue;
            for (int i = 0; i < 12; i++)
                for (int p = 0; p < 3; p++)
                    y[i] += tss__haar_row[p][i / 3] * V[9 * (3 * p + i % 3) + k][l];
            tss__eight_rank_one(e, e->scale[l] * S[10 * k][l], y, e->out[l]);
        }
}

// Projected Hessians of the lanes that are active and not mollified (mask).
static void tss__eight_projected(const tss__eight *e, tss__lane *v, const tss__eight_near *o,
                                 const int *mask) {
    tss__reduced R;
    tss__lane g[8];
    for (int l = 0; l < TSS__LANES; l++) {
        const tss__feature *row = &tss__features[e->kind][(int)o->feature[l]];
        for (int i = 0; i < 4; i++) R.D[i][l] = row->D[0][i], R.D[4 + i][l] = row->D[1][i];
    }
    memcpy(R.c, o->c, sizeof R.c);
    tss__lanes_frame(v, o, &R, g);
    tss__lanes_matrix(o, g, e->dhat, &R);
    tss__jacobi5(R.S, R.V);
    for (int l = 0; l < e->count; l++)
        if (mask[l]) tss__reduced_expand(e, &R, l, e->out[l]);
}

static void tss__eight_hessian(const tss__eight *e, int psd) {
    tss__lane v[12], m, m1;
    tss__eight_near n;
    int plain[TSS__LANES], mollified[TSS__LANES], plains = 0, mollifieds = 0,
                                                  ad = e->arity * e->dim;
    tss__eight_load(e, e->x, v);
    tss__eight_closest(e->kind, v, &n);
    for (int l = 0; l < e->count; l++) memset(e->out[l], 0, (size_t)(ad * ad) * sizeof(double));
    if (!tss__eight_active(e, n.d)) return;
    tss__eight_mollify(e, v, m, m1);
    for (int l = 0; l < e->count; l++) {
        int active = n.d[l] < e->dhat;
        plain[l] = active && m1[l] == 0, mollified[l] = active && m1[l] != 0;
        plains += plain[l], mollifieds += mollified[l];
        if (active && !psd) {
            double H[144], cut[144];
            tss__lane_exact(e, v, (int)n.feature[l], l, H);
            tss__cut_matrix(e->arity, e->dim, H, cut);
            for (int i = 0; i < ad * ad; i++) e->out[l][i] = e->scale[l] * cut[i];
        }
    }
    if (!psd) return;
    if (plains) tss__eight_projected(e, v, &n, plain);
    if (TSS__IPC_3D && mollifieds) tss__eight_mollified(e, v, &n, mollified);
}

#ifdef __cplusplus
}
#endif
#if !defined(__clang__) && defined(__GNUC__)
#pragma GCC pop_options
#endif

#include <float.h>
#include <limits.h>
#include <math.h>
#include <string.h>

// Intrinsics where the compiler was told the machine has them; TSS_NO_SIMD leaves them out.
#if !defined(TSS_NO_SIMD) && (defined(__SSE2__) || defined(_M_X64))
#include <immintrin.h>
#define TSS__BROAD_SSE2 1
#if defined(__AVX__)
#define TSS__BROAD_AVX 1
#endif
#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__)
#define TSS__BROAD_AVX512 1
#endif
#endif

// No contraction: the same bits everywhere. The rest lets gcc make vectors of the loops over
// lanes at -O2 too; none of it changes a result. clang: give -fno-math-errno.
#if defined(__clang__)
#pragma clang fp contract(off)
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("O3", "fp-contract=off", "no-math-errno", "no-trapping-math")
#endif

// ---------------------------------------------------------------------------------------------
// >>broad_phase (private)
// Which pairs of primitives may touch: boxes of the segments x → x + t·d, found through trees.
//
// Lists, each sorted by a, then b, so the same for any number of threads and any tree:
//   TSS__BROAD_EE  a, b: edges, a < b      3D
//   TSS__BROAD_PT  a: point, b: triangle   3D
//   TSS__BROAD_PE  a: point, b: edge       2D: all. 3D: points in no edge and no triangle against
//                                          edges of no triangle
//   TSS__BROAD_PP  a, b: points, a < b     points in no edge and no triangle
// a and b are places in the mesh's primitive lists. Everything else that can touch is an end or a
// border of one of these (a segment against a surface is EE and PT, two segments are EE).
// Left out: pairs sharing a node, pairs whose nodes are all kinematic, pairs inside a body whose
// self_off is set.
//
// Method: one box a node (exact or rounded outward), a tree with eight boxes a node and eight
// primitives a leaf. Its shape depends on the number of primitives only; which primitive lies in
// which leaf comes from median splits along the longest side of the centroids' box, so clusters,
// outliers and equal boxes cannot unbalance it. Later calls only recompute the boxes, until the
// sum of their sizes has decayed. Upper boxes are floats, leaves are doubles: the pairs are exactly
// those whose double boxes meet. Eight queries of a leaf share a descent.
// Cost: build n log n, refit n, search about n log n + pairs. Memory: 12 bytes a pair and a
// quarter to spare at the high-water mark, below 300 bytes a primitive.
// Limits: fewer than 2^28 primitives of a kind; all nodes of a primitive belong to one body.
// ---------------------------------------------------------------------------------------------

enum { TSS__BROAD_EE, TSS__BROAD_PT, TSS__BROAD_PE, TSS__BROAD_PP, TSS__BROAD_KINDS };

typedef struct tss__pair {
    int a, b;
} tss__pair;

// A grow-only list of pairs; zeros to start with, tss__broad_pairs_free to end.
typedef struct tss__broad_pairs {
    tss__pair *pair;
    int count, room;
} tss__broad_pairs;

// The caller's arrays: valid and unchanged until the next set_mesh or free.
typedef struct tss__broad_mesh {
    int dim, nodes;            // d: 2 or 3
    int points, edges, tris;   // tris: 0 in 2D
    const int *point;          // points: node
    const int *edge;           // 2 × edges: nodes
    const int *tri;            // 3 × tris: nodes
    const uint8_t *kinematic;  // nodes: not 0 = moves as told; NULL: all free
    const int *body;           // nodes: body >= 0; NULL: all in body 0
    const uint8_t *self_off;   // bodies: not 0 = no contact with itself; NULL: all on
} tss__broad_mesh;

enum { TSS__BROAD_EDGES, TSS__BROAD_TRIS, TSS__BROAD_POINTS, TSS__BROAD_LONE, TSS__BROAD_STRUTS,
       TSS__BROAD_TREES };

// Eight primitives: boxes (lower x y z, upper x y z), places in the primitive list, nodes.
typedef struct tss__broad_leaf {
    double box[6][8];
    int id[8];       // −1: empty lane, with an empty box
    int node[3][8];  // unused rows repeat row 0
} tss__broad_leaf;

// Eight children's boxes.
typedef struct tss__broad_node {
    float box[6][8];
    int child[8];  // a node, or ~leaf
    int top[8];    // the largest place in the primitive list below
    int group[8];  // the group all primitives below have, or −1
} tss__broad_node;

// What the splits move: a centroid and the primitive it belongs to.
typedef struct tss__broad_item {
    float c[3];
    int id;
} tss__broad_item;

// part[0] holds the primitives with a free node, part[1] those without.
typedef struct tss__broad_part {
    int first, leaves, count, root;  // leaves [first, first + leaves); root −1: empty
} tss__broad_part;

typedef struct tss__broad_tree {
    int arity, count;   // nodes a primitive, primitives
    const int *nodes;   // arity × (primitives of the mesh's list)
    int *prim;          // count: places in the mesh's list, parts in order; NULL while count is 0
    int grouped;        // some primitive is in a group
    int built;          // slot and the order of the leaves are valid
    int leaves, wide;   // leaves, nodes in use
    tss__broad_part part[2];
    tss__broad_leaf *leaf;
    tss__broad_node *node;
    tss__broad_item *item;  // 8 × leaves
    int *group;             // 8 × leaves
    double decay;           // (sum of node box sizes) / (sum of primitive box sizes) when built
    size_t prim_bytes, leaf_bytes, node_bytes, item_bytes, group_bytes;
} tss__broad_tree;

// A list of ranges that build splits and then finishes, one task each.
typedef struct tss__broad_range {
    int tree, first, leaves, end;  // end: one past the last item
} tss__broad_range;

#define TSS__BROAD_BLOCKS 256  // most blocks a loop is cut into; part of no result
#define TSS__BROAD_RANGES 256
#define TSS__BROAD_STACK 128   // 7 a level, 10 levels for 2^28 primitives, 2 roots

// Rows found by one block of queries.
typedef struct tss__broad_block {
    int *found;
    size_t bytes, need;  // need: numbers found, stored or not
    int done;
} tss__broad_block;

typedef struct tss__broad {
    const tss_host *host;
    tss__broad_mesh mesh;
    tss__broad_tree tree[TSS__BROAD_TREES];
    tss__broad_pairs list[TSS__BROAD_KINDS];  // what the last search found
    double *node_box;                         // nodes × 8: lower x y z, 0, upper x y z, 0
    int *mark;                                // set_mesh: nodes + 1 + 3 tris
    int *row_first, *row_count, *row_start;   // by query: place in its block, size, place in list
    uint8_t *row_block;
    int *scratch;                             // workers × scratch_each
    uint8_t *chosen;                          // points + edges: lone points, struts
    uint8_t *mask;                            // near, reach: one bit a pair
    size_t node_box_bytes, mark_bytes, row_first_bytes, row_count_bytes, scratch_bytes, mask_bytes;
    size_t chosen_bytes, row_start_bytes, row_block_bytes;
    size_t scratch_each;
    int rebuilds;  // trees built since init
    tss__broad_block block[TSS__BROAD_BLOCKS];
    double sum[TSS__BROAD_BLOCKS][2];
    int flag[TSS__BROAD_BLOCKS];
    tss__broad_range range[TSS__BROAD_RANGES];
} tss__broad;

// ---- memory ----

// old if it holds want bytes, else a larger copy of it; NULL: no memory, old stays as it was.
static void *tss__broad_fit(const tss_host *host, void *old, size_t *bytes, size_t want) {
    if (old && *bytes >= want) return old;
    if (want < 64) want = 64;
    void *p = tss_alloc(host, want);
    if (!p) return NULL;
    if (old) memcpy(p, old, *bytes);
    tss_free(host, old, *bytes);
    *bytes = want;
    return p;
}

// Member m of *o grows to n elements of type T, or the function returns.
#define TSS__BROAD_FIT(host, o, m, T, n)                                                          \
    do {                                                                                          \
        void *fit_ = tss__broad_fit(host, (o)->m, &(o)->m##_bytes, sizeof(T) * (size_t)(n));      \
        if (!fit_) return TSS_ERROR_NO_MEMORY;                                                    \
        (o)->m = (T *)fit_;                                                                       \
    } while (0)

static void tss__broad_pairs_free(const tss_host *host, tss__broad_pairs *p) {
    tss_free(host, p->pair, sizeof(tss__pair) * (size_t)p->room);
    memset(p, 0, sizeof *p);
}

static tss_result tss__broad_pairs_reserve(const tss_host *host, tss__broad_pairs *p, int room) {
    if (p->room >= room && p->pair) return TSS_OK;
    // a quarter more, so that a slowly growing contact does not allocate each time
    int more = room < INT_MAX - room / 4 - 16 ? room + room / 4 + 16 : INT_MAX;
    size_t bytes = sizeof(tss__pair) * (size_t)p->room;
    void *q = tss__broad_fit(host, p->pair, &bytes, sizeof(tss__pair) * (size_t)more);
    if (!q) return TSS_ERROR_NO_MEMORY;
    p->pair = (tss__pair *)q;
    p->room = more;
    return TSS_OK;
}

static void tss__broad_init(tss__broad *b, const tss_host *host) {
    memset(b, 0, sizeof *b);
    b->host = host;
}

static void tss__broad_free(tss__broad *b) {
    const tss_host *h = b->host;
    for (int i = 0; i < TSS__BROAD_TREES; i++) {
        tss__broad_tree *t = &b->tree[i];
        tss_free(h, t->prim, t->prim_bytes);
        tss_free(h, t->leaf, t->leaf_bytes);
        tss_free(h, t->node, t->node_bytes);
        tss_free(h, t->item, t->item_bytes);
        tss_free(h, t->group, t->group_bytes);
    }
    for (int i = 0; i < TSS__BROAD_BLOCKS; i++)
        tss_free(h, b->block[i].found, b->block[i].bytes);
    for (int i = 0; i < TSS__BROAD_KINDS; i++) tss__broad_pairs_free(h, &b->list[i]);
    tss_free(h, b->node_box, b->node_box_bytes);
    tss_free(h, b->mark, b->mark_bytes);
    tss_free(h, b->row_first, b->row_first_bytes);
    tss_free(h, b->row_count, b->row_count_bytes);
    tss_free(h, b->scratch, b->scratch_bytes);
    tss_free(h, b->row_start, b->row_start_bytes);
    tss_free(h, b->row_block, b->row_block_bytes);
    tss_free(h, b->mask, b->mask_bytes);
    tss_free(h, b->chosen, b->chosen_bytes);
    memset(b, 0, sizeof *b);
}

// ---- blocks ----

// Cuts n things into blocks of at least grain; the cut depends on n alone.
static int tss__broad_blocks(int n, int grain) {
    int64_t blocks = ((int64_t)n + grain - 1) / grain;
    return blocks > TSS__BROAD_BLOCKS ? TSS__BROAD_BLOCKS : (int)blocks;
}

static int tss__broad_cut(int n, int blocks, int k) {
    return (int)((int64_t)n * k / blocks);
}

// ---- eight lanes at a time: bit k of a result belongs to lane k ----

static int tss__broad_lowest(unsigned m) {  // m != 0
#if defined(__GNUC__)
    return __builtin_ctz(m);
#else
    int k = 0;
    while (!(m >> k & 1u)) k++;
    return k;
#endif
}

// Lanes whose box (lower x y z, upper x y z) meets q; touching boxes meet.
static inline unsigned tss__broad_meet_f(const float (*box)[8], const float *q) {
#if defined(TSS__BROAD_AVX512)
    __mmask8 m = _mm256_cmp_ps_mask(_mm256_loadu_ps(box[0]), _mm256_set1_ps(q[3]), _CMP_LE_OQ);
    m = _mm256_mask_cmp_ps_mask(m, _mm256_loadu_ps(box[1]), _mm256_set1_ps(q[4]), _CMP_LE_OQ);
    m = _mm256_mask_cmp_ps_mask(m, _mm256_loadu_ps(box[2]), _mm256_set1_ps(q[5]), _CMP_LE_OQ);
    m = _mm256_mask_cmp_ps_mask(m, _mm256_loadu_ps(box[3]), _mm256_set1_ps(q[0]), _CMP_GE_OQ);
    m = _mm256_mask_cmp_ps_mask(m, _mm256_loadu_ps(box[4]), _mm256_set1_ps(q[1]), _CMP_GE_OQ);
    return _mm256_mask_cmp_ps_mask(m, _mm256_loadu_ps(box[5]), _mm256_set1_ps(q[2]), _CMP_GE_OQ);
#elif defined(TSS__BROAD_SSE2)
    unsigned r = 0;
    for (int h = 0; h < 2; h++) {
        __m128 m = _mm_cmple_ps(_mm_loadu_ps(box[0] + 4 * h), _mm_set1_ps(q[3]));
        m = _mm_and_ps(m, _mm_cmple_ps(_mm_loadu_ps(box[1] + 4 * h), _mm_set1_ps(q[4])));
        m = _mm_and_ps(m, _mm_cmple_ps(_mm_loadu_ps(box[2] + 4 * h), _mm_set1_ps(q[5])));
        m = _mm_and_ps(m, _mm_cmpge_ps(_mm_loadu_ps(box[3] + 4 * h), _mm_set1_ps(q[0])));
        m = _mm_and_ps(m, _mm_cmpge_ps(_mm_loadu_ps(box[4] + 4 * h), _mm_set1_ps(q[1])));
        m = _mm_and_ps(m, _mm_cmpge_ps(_mm_loadu_ps(box[5] + 4 * h), _mm_set1_ps(q[2])));
        r |= (unsigned)_mm_movemask_ps(m) << (4 * h);
    }
    return r;
#else
    unsigned r = 0;
    for (int k = 0; k < 8; k++) {
        int m = (box[0][k] <= q[3]) & (box[1][k] <= q[4]) & (box[2][k] <= q[5]) &
                (box[3][k] >= q[0]) & (box[4][k] >= q[1]) & (box[5][k] >= q[2]);
        r |= (unsigned)m << k;
    }
    return r;
#endif
}

static inline unsigned tss__broad_meet_d(const double (*box)[8], const double *q) {
#if defined(TSS__BROAD_AVX512)
    __mmask8 m = _mm512_cmp_pd_mask(_mm512_loadu_pd(box[0]), _mm512_set1_pd(q[3]), _CMP_LE_OQ);
    m = _mm512_mask_cmp_pd_mask(m, _mm512_loadu_pd(box[1]), _mm512_set1_pd(q[4]), _CMP_LE_OQ);
    m = _mm512_mask_cmp_pd_mask(m, _mm512_loadu_pd(box[2]), _mm512_set1_pd(q[5]), _CMP_LE_OQ);
    m = _mm512_mask_cmp_pd_mask(m, _mm512_loadu_pd(box[3]), _mm512_set1_pd(q[0]), _CMP_GE_OQ);
    m = _mm512_mask_cmp_pd_mask(m, _mm512_loadu_pd(box[4]), _mm512_set1_pd(q[1]), _CMP_GE_OQ);
    return _mm512_mask_cmp_pd_mask(m, _mm512_loadu_pd(box[5]), _mm512_set1_pd(q[2]), _CMP_GE_OQ);
#elif defined(TSS__BROAD_SSE2)
    unsigned r = 0;
    for (int h = 0; h < 4; h++) {
        __m128d m = _mm_cmple_pd(_mm_loadu_pd(box[0] + 2 * h), _mm_set1_pd(q[3]));
        m = _mm_and_pd(m, _mm_cmple_pd(_mm_loadu_pd(box[1] + 2 * h), _mm_set1_pd(q[4])));
        m = _mm_and_pd(m, _mm_cmple_pd(_mm_loadu_pd(box[2] + 2 * h), _mm_set1_pd(q[5])));
        m = _mm_and_pd(m, _mm_cmpge_pd(_mm_loadu_pd(box[3] + 2 * h), _mm_set1_pd(q[0])));
        m = _mm_and_pd(m, _mm_cmpge_pd(_mm_loadu_pd(box[4] + 2 * h), _mm_set1_pd(q[1])));
        m = _mm_and_pd(m, _mm_cmpge_pd(_mm_loadu_pd(box[5] + 2 * h), _mm_set1_pd(q[2])));
        r |= (unsigned)_mm_movemask_pd(m) << (2 * h);
    }
    return r;
#else
    unsigned r = 0;
    for (int k = 0; k < 8; k++) {
        int m = (box[0][k] <= q[3]) & (box[1][k] <= q[4]) & (box[2][k] <= q[5]) &
                (box[3][k] >= q[0]) & (box[4][k] >= q[1]) & (box[5][k] >= q[2]);
        r |= (unsigned)m << k;
    }
    return r;
#endif
}

static inline int tss__broad_ones(unsigned m) {  // of eight bits
#if defined(__GNUC__) && defined(__POPCNT__)
    return __builtin_popcount(m);
#else
    m = m - (m >> 1 & 0x55u);
    m = (m & 0x33u) + (m >> 2 & 0x33u);
    return (int)((m + (m >> 4)) & 15u);
#endif
}

// Appends the chosen lanes of a at out and returns their number; writes eight places. No branches:
// the masks are as good as random.
static inline int tss__broad_pack(const int *a, unsigned m, int *out) {
#if defined(TSS__BROAD_AVX512)
    __m256i v = _mm256_loadu_si256((const __m256i *)(const void *)a);
    _mm256_storeu_si256((__m256i *)(void *)out, _mm256_maskz_compress_epi32((__mmask8)m, v));
    return tss__broad_ones(m);
#else
    int n = 0;
    for (int k = 0; k < 8; k++) out[n] = a[k], n += (int)(m >> k & 1u);
    return n;
#endif
}

// Lanes greater than v.
static inline unsigned tss__broad_above(const int *a, int v) {
#if defined(TSS__BROAD_SSE2)
    __m128i x = _mm_cmpgt_epi32(_mm_loadu_si128((const __m128i *)(const void *)a),
                                _mm_set1_epi32(v));
    __m128i y = _mm_cmpgt_epi32(_mm_loadu_si128((const __m128i *)(const void *)(a + 4)),
                                _mm_set1_epi32(v));
    return (unsigned)_mm_movemask_ps(_mm_castsi128_ps(x)) |
           (unsigned)_mm_movemask_ps(_mm_castsi128_ps(y)) << 4;
#else
    unsigned r = 0;
    for (int k = 0; k < 8; k++) r |= (unsigned)(a[k] > v) << k;
    return r;
#endif
}

// Lanes equal to v.
static inline unsigned tss__broad_equal(const int *a, int v) {
#if defined(TSS__BROAD_SSE2)
    __m128i x = _mm_cmpeq_epi32(_mm_loadu_si128((const __m128i *)(const void *)a),
                                _mm_set1_epi32(v));
    __m128i y = _mm_cmpeq_epi32(_mm_loadu_si128((const __m128i *)(const void *)(a + 4)),
                                _mm_set1_epi32(v));
    return (unsigned)_mm_movemask_ps(_mm_castsi128_ps(x)) |
           (unsigned)_mm_movemask_ps(_mm_castsi128_ps(y)) << 4;
#else
    unsigned r = 0;
    for (int k = 0; k < 8; k++) r |= (unsigned)(a[k] == v) << k;
    return r;
#endif
}

// To float. Rounding keeps order: boxes that meet as doubles meet as floats too, so that rounding
// outward would only make them larger. The clamp, in order as well, keeps huge values finite.
static inline float tss__broad_float(double v) {
    return (float)(v < -3e38 ? -3e38 : v > 3e38 ? 3e38 : v);
}

// ---- topology ----

// Nodes of primitive p of a tree: row of the mesh's list.
static inline const int *tss__broad_prim_nodes(const tss__broad_tree *t, int p) {
    return t->nodes + (size_t)t->arity * (size_t)p;
}

// Kinematic when all nodes are.
static int tss__broad_fixed(const tss__broad_mesh *m, const int *node, int arity) {
    if (!m->kinematic) return 0;
    for (int k = 0; k < arity; k++)
        if (!m->kinematic[node[k]]) return 0;
    return 1;
}

// The body whose primitives must not meet each other, or −1.
static int tss__broad_group(const tss__broad_mesh *m, int node) {
    int body = m->body ? m->body[node] : 0;
    return m->self_off && m->self_off[body] ? body : -1;
}

// Leaves and nodes that count primitives in two parts can need.
static int tss__broad_leaves_of(int count) {
    return count / 8 + 2;
}

// Wide nodes over leaves [first, first + m), in preorder; returns the node. Up to eight leaves
// hang under one node; larger ranges are halved one to three times, as the splits halve them.
static int tss__broad_link(tss__broad_tree *t, int first, int m) {
    int self = t->wide++;
    tss__broad_node *n = &t->node[self];
    int begin[9] = {first}, size[8] = {m}, k = 1;
    for (int i = 0; i < 8; i++) n->child[i] = INT_MAX;
    if (m <= 8) {
        for (int i = 0; i < m; i++) n->child[i] = ~(first + i);
        return self;
    }
    while (k < 8 && size[0] > 8) {
        for (int i = k - 1; i >= 0; i--) {
            int s = size[i], left = (s + 1) / 2, at = begin[i];
            size[2 * i] = left, begin[2 * i] = at;
            size[2 * i + 1] = s - left, begin[2 * i + 1] = at + left;
        }
        k *= 2;
    }
    for (int i = 0; i < k; i++) {
        int c = tss__broad_link(t, begin[i], size[i]);
        t->node[self].child[i] = c;
    }
    return self;
}

// The chosen primitives, those with a free node first, and the shape of the tree over them.
static void tss__broad_plant(tss__broad_tree *t, const tss__broad_mesh *m, int total,
                             const uint8_t *chosen) {
    int n = 0;
    t->grouped = 0, t->built = 0, t->leaves = 0, t->wide = 0;
    for (int side = 0; side < 2; side++) {
        tss__broad_part *part = &t->part[side];
        int begin = n;
        for (int p = 0; p < total; p++) {
            const int *node = tss__broad_prim_nodes(t, p);
            if (chosen && !chosen[p]) continue;
            if (tss__broad_fixed(m, node, t->arity) != side) continue;
            t->grouped |= tss__broad_group(m, node[0]) >= 0;
            t->prim[n++] = p;
        }
        part->count = n - begin;
        part->first = t->leaves;
        part->leaves = (part->count + 7) / 8;
        t->leaves += part->leaves;
        part->root = part->leaves ? tss__broad_link(t, part->first, part->leaves) : -1;
    }
    t->count = n;
}

// 1 for an edge whose two nodes share no triangle. start: nodes + 1, then the triangles by node.
static void tss__broad_find_struts(const tss__broad_mesh *m, int *start, uint8_t *strut) {
    int *list = start + m->nodes + 1;
    memset(start, 0, sizeof(int) * ((size_t)m->nodes + 1));
    for (int k = 0; k < 3 * m->tris; k++) start[m->tri[k] + 1]++;
    for (int i = 0; i < m->nodes; i++) start[i + 1] += start[i];
    for (int k = 3 * m->tris - 1; k >= 0; k--) list[--start[m->tri[k] + 1]] = k / 3;
    // start[i + 1] is now the first of node i; the next node's first ends it
    for (int e = 0; e < m->edges; e++) {
        int i = m->edge[2 * e], j = m->edge[2 * e + 1];
        int end = i + 2 <= m->nodes ? start[i + 2] : 3 * m->tris, shared = 0;
        for (int k = start[i + 1]; k < end && !shared; k++) {
            const int *t = m->tri + 3 * list[k];
            shared = t[0] == j || t[1] == j || t[2] == j;
        }
        strut[e] = (uint8_t)!shared;
    }
}

// 1 for a point whose node is in no edge and no triangle.
static void tss__broad_find_lone(const tss__broad_mesh *m, int *used, uint8_t *lone) {
    memset(used, 0, sizeof(int) * ((size_t)m->nodes + 1));
    for (int k = 0; k < 2 * m->edges; k++) used[m->edge[k]] = 1;
    for (int k = 0; k < 3 * m->tris; k++) used[m->tri[k]] = 1;
    for (int p = 0; p < m->points; p++) lone[p] = (uint8_t)!used[m->point[p]];
}

static int tss__broad_chosen(const uint8_t *chosen, int n) {
    int count = 0;
    for (int i = 0; i < n; i++) count += chosen[i];
    return count;
}

static tss_result tss__broad_reserve_tree(const tss_host *host, tss__broad_tree *t, int count) {
    if (!count) return TSS_OK;
    int leaves = tss__broad_leaves_of(count);
    TSS__BROAD_FIT(host, t, prim, int, count);
    TSS__BROAD_FIT(host, t, leaf, tss__broad_leaf, leaves);
    TSS__BROAD_FIT(host, t, node, tss__broad_node, leaves / 2 + 8);
    TSS__BROAD_FIT(host, t, item, tss__broad_item, 8 * (size_t)leaves);
    TSS__BROAD_FIT(host, t, group, int, 8 * (size_t)leaves);
    return TSS_OK;
}

// Takes over the primitives, nodes' kinds and bodies. No memory: b stays as it was.
static tss_result tss__broad_set_mesh(tss__broad *b, const tss__broad_mesh *m) {
    const tss_host *h = b->host;
    int total[TSS__BROAD_TREES] = {m->edges, m->tris, m->points, m->points, m->edges};
    int count[TSS__BROAD_TREES] = {m->edges, m->tris, m->points, 0, 0};
    const int *nodes[TSS__BROAD_TREES] = {m->edge, m->tri, m->point, m->point, m->edge};
    static const int arity[TSS__BROAD_TREES] = {2, 3, 1, 1, 2};
    TSS_ASSERT((m->dim == 2 && !m->tris) || m->dim == 3);
    int most = m->edges > m->points ? m->edges : m->points;
    TSS__BROAD_FIT(h, b, mark, int, (size_t)m->nodes + 1 + 3 * (size_t)m->tris);
    TSS__BROAD_FIT(h, b, chosen, uint8_t, (size_t)m->points + (size_t)m->edges);
    TSS__BROAD_FIT(h, b, node_box, double, 8 * (size_t)m->nodes);
    TSS__BROAD_FIT(h, b, row_first, int, most);
    TSS__BROAD_FIT(h, b, row_count, int, most);
    TSS__BROAD_FIT(h, b, row_start, int, most);
    TSS__BROAD_FIT(h, b, row_block, uint8_t, most);
    uint8_t *lone = b->chosen, *strut = b->chosen + m->points;
    tss__broad_find_lone(m, b->mark, lone);
    count[TSS__BROAD_LONE] = tss__broad_chosen(lone, m->points);
    if (m->dim == 3 && count[TSS__BROAD_LONE]) {
        tss__broad_find_struts(m, b->mark, strut);
        count[TSS__BROAD_STRUTS] = tss__broad_chosen(strut, m->edges);
    }
    for (int i = 0; i < TSS__BROAD_TREES; i++) {
        tss_result r = tss__broad_reserve_tree(h, &b->tree[i], count[i]);
        if (r) return r;
    }
    // nothing can fail any more
    b->mesh = *m;
    for (int i = 0; i < TSS__BROAD_TREES; i++) {
        tss__broad_tree *t = &b->tree[i];
        t->arity = arity[i], t->nodes = nodes[i];
        const uint8_t *chosen = i == TSS__BROAD_LONE ? lone : i == TSS__BROAD_STRUTS ? strut : NULL;
        tss__broad_plant(t, m, count[i] ? total[i] : 0, chosen);
    }
    for (int i = 0; i < TSS__BROAD_KINDS; i++) b->list[i].count = 0;
    return TSS_OK;
}

// ---- boxes ----

// What a parallel loop over boxes needs.
typedef struct tss__broad_job {
    tss__broad *b;
    const double *x, *d;
    double t, r;
    int blocks, first_block, ranges, rows;
    tss__broad_tree *tree;                  // refit
    const tss__broad_tree *query, *target;  // join
    int kind, cap;
    tss__pair *out;
} tss__broad_job;

// Bounds of one coordinate over the sweep. Where x + t·d and the inflation are exact, so is the
// box; where they are rounded it is widened by at least that error (half a unit in the last place
// of the product and of the sum: eps · (|sum| + |product|) is more than both).
static int tss__broad_range_of(double x, double d, double t, double r, double *lo, double *hi) {
    const double eps = 2.3e-16;  // a little above 2^-52
    double td = t * d, s = x + td, y = s - x;
    double lost = (x - (s - y)) + (td - y);  // x + td = s + lost, exactly (two-sum)
    double a = x < s ? x : s, z = x < s ? s : x;
    if (lost != 0 || (t != 1 && td != 0)) {
        double w = eps * ((s < 0 ? -s : s) + (td < 0 ? -td : td));
        a -= w, z += w;
    }
    if (r != 0) {
        a -= r, z += r;
        a -= eps * (a < 0 ? -a : a) , z += eps * (z < 0 ? -z : z);
    }
    *lo = a, *hi = z;
    return z - a < DBL_MAX;  // not for infinities and not-a-numbers
}

static void tss__broad_box_task(int k, int worker, void *arg) {
    const tss__broad_job *j = (const tss__broad_job *)arg;
    const tss__broad_mesh *m = &j->b->mesh;
    int end = tss__broad_cut(m->nodes, j->blocks, k + 1), ok = 1, dim = m->dim;
    (void)worker;
    for (int i = tss__broad_cut(m->nodes, j->blocks, k); i < end; i++) {
        double *box = j->b->node_box + 8 * (size_t)i;
        for (int c = 0; c < dim; c++) {
            size_t at = (size_t)i * (size_t)dim + (size_t)c;
            ok &= tss__broad_range_of(j->x[at], j->d ? j->d[at] : 0, j->t, j->r, box + c,
                                      box + 4 + c);
        }
        for (int c = dim; c < 4; c++) box[c] = box[4 + c] = 0;
    }
    j->b->flag[k] = !ok;
}

// Box of a primitive: of its nodes' boxes.
static inline void tss__broad_prim_box(const double *node_box, const int *node, int arity,
                                       double *box) {
    const double *q = node_box + 8 * (size_t)node[0];
    for (int c = 0; c < 3; c++) box[c] = q[c], box[3 + c] = q[4 + c];
    for (int k = 1; k < arity; k++) {
        q = node_box + 8 * (size_t)node[k];
        for (int c = 0; c < 3; c++) {
            box[c] = q[c] < box[c] ? q[c] : box[c];
            box[3 + c] = q[4 + c] > box[3 + c] ? q[4 + c] : box[3 + c];
        }
    }
}

// ---- build: which primitive lies in which leaf ----

// Centroids of a block of a tree's primitives, in the order of its parts.
static void tss__broad_item_task(int block, int worker, void *arg) {
    const tss__broad_job *j = (const tss__broad_job *)arg;
    const tss__broad_tree *t = j->tree;
    int end = tss__broad_cut(t->count, j->blocks, block + 1);
    (void)worker;
    for (int n = tss__broad_cut(t->count, j->blocks, block); n < end; n++) {
        const tss__broad_part *p = &t->part[n >= t->part[0].count];
        int at = 8 * p->first + n - (p == t->part ? 0 : t->part[0].count);
        tss__broad_item *it = &t->item[at];
        double box[6];
        it->id = t->prim[n];
        tss__broad_prim_box(j->b->node_box, tss__broad_prim_nodes(t, it->id), t->arity, box);
        for (int c = 0; c < 3; c++) it->c[c] = tss__broad_float(0.5 * box[c] + 0.5 * box[3 + c]);
    }
}

// Moves the items below v (or not above v, if `equal`) to the front, without branches on the
// data; returns their number.
static int tss__broad_divide(tss__broad_item *it, int n, int axis, float v, int equal) {
    int k = 0;
    for (int i = 0; i < n; i++) {
        tss__broad_item s = it[i];
        int front = equal ? s.c[axis] <= v : s.c[axis] < v;
        it[i] = it[k], it[k] = s;
        k += front;
    }
    return k;
}

// The middle of the values, by value or, where they span decades, by exponent: halves what floats
// are left, and so bounds the passes whatever the data.
static float tss__broad_middle(const tss__broad_item *it, int n, int axis) {
    float lo = it[0].c[axis], hi = lo;
    for (int i = 1; i < n; i++) {
        float v = it[i].c[axis];
        lo = v < lo ? v : lo, hi = v > hi ? v : hi;
    }
    if (lo < 0 && hi > 0) return 0;
    float p = lo < 0 ? -lo : lo, q = hi < 0 ? -hi : hi, s = hi > 0 ? 1.0f : -1.0f;
    if (p <= 4 * q && q <= 4 * p) return 0.5f * lo + 0.5f * hi;
    return s * sqrtf(p > 1e-30f ? p : 1e-30f) * sqrtf(q > 1e-30f ? q : 1e-30f);
}

// A pivot near rank k, from a sample: on large ranges a little to the far side of k, so that the
// smaller part is the one kept.
static float tss__broad_pivot(const tss__broad_item *it, int n, int k, int axis) {
    float s[33];
    int m = n > 512 ? 33 : n > 64 ? 9 : 3;
    for (int i = 0; i < m; i++) {
        float v = it[(int)((int64_t)(n - 1) * i / (m - 1))].c[axis];
        int at = i;
        for (; at > 0 && s[at - 1] > v; at--) s[at] = s[at - 1];
        s[at] = v;
    }
    int rank = (int)((int64_t)k * m / n), off = m == 33 ? 3 : 0;
    rank += 2 * (int64_t)k < n ? off : -off;
    return s[rank < 0 ? 0 : rank > m - 1 ? m - 1 : rank];
}

// Afterwards the first k of n items are not above the rest along axis.
static void tss__broad_select(tss__broad_item *it, int n, int k, int axis) {
    for (int turn = 1; k > 0 && k < n; turn++) {
        // every eighth pivot is the one with a guarantee
        float v = turn % 8 ? tss__broad_pivot(it, n, k, axis) : tss__broad_middle(it, n, axis);
        int m = tss__broad_divide(it, n, axis, v, 0);
        if (k < m) {
            n = m;
            continue;
        }
        // none below: those equal to the smallest are where they belong
        if (m == 0) m = tss__broad_divide(it, n, axis, v, 1);
        else if (m == n) continue;
        it += m, n -= m, k -= m;
    }
}

// Halves a range as tss__broad_link does; returns the leaves of the first half.
static int tss__broad_split(const tss__broad_tree *t, const tss__broad_range *g) {
    int left = (g->leaves + 1) / 2, n = g->end - 8 * g->first, axis = 0;
    tss__broad_item *it = t->item + 8 * (size_t)g->first;
    float lo[3], hi[3];
    memcpy(lo, it->c, sizeof lo), memcpy(hi, it->c, sizeof hi);
    for (int i = 1; i < n; i++)
        for (int c = 0; c < 3; c++) {
            float v = it[i].c[c];
            lo[c] = v < lo[c] ? v : lo[c], hi[c] = v > hi[c] ? v : hi[c];
        }
    for (int c = 1; c < 3; c++)
        if (hi[c] - lo[c] > hi[axis] - lo[axis]) axis = c;
    tss__broad_select(it, n, 8 * left, axis);
    return left;
}

static void tss__broad_halves(const tss__broad_range *g, int left, tss__broad_range *a,
                              tss__broad_range *b) {
    tss__broad_range whole = *g;
    *a = whole, *b = whole;
    a->leaves = left, a->end = 8 * (whole.first + left);
    b->first = whole.first + left, b->leaves = whole.leaves - left;
}

// Splits a range down to leaves. Depth: 28.
static void tss__broad_sort(const tss__broad_tree *t, tss__broad_range g) {
    while (g.leaves > 1) {
        tss__broad_range a, rest;
        tss__broad_halves(&g, tss__broad_split(t, &g), &a, &rest);
        tss__broad_sort(t, a);
        g = rest;
    }
}

// One split of one range: the second half goes to the end of the list.
static void tss__broad_split_task(int k, int worker, void *arg) {
    tss__broad_job *j = (tss__broad_job *)arg;
    tss__broad_range *g = &j->b->range[j->b->flag[k]];
    (void)worker;
    tss__broad_range a, c;
    int left = tss__broad_split(&j->b->tree[g->tree], g);
    tss__broad_halves(g, left, &a, &c);
    *g = a, j->b->range[j->ranges + k] = c;
}

static void tss__broad_sort_task(int k, int worker, void *arg) {
    tss__broad_job *j = (tss__broad_job *)arg;
    (void)worker;
    tss__broad_sort(&j->b->tree[j->b->range[k].tree], j->b->range[k]);
}

// Sorts the trees that are not built: a few common rounds of halving, then one task a range.
static void tss__broad_build(tss__broad *b, tss__broad_job *j) {
    int n = 0, total = 0;
    for (int i = 0; i < TSS__BROAD_TREES; i++) {
        tss__broad_tree *t = &b->tree[i];
        if (!t->count || t->built) continue;
        j->tree = t, j->blocks = tss__broad_blocks(t->count, 1024);
        tss_parallel(b->host, j->blocks, tss__broad_item_task, j);
        for (int s = 0; s < 2; s++) {
            const tss__broad_part *p = &t->part[s];
            tss__broad_range g = {i, p->first, p->leaves, 8 * p->first + p->count};
            if (p->leaves) b->range[n++] = g;
            total += p->leaves;
        }
        b->rebuilds++;
    }
    for (;;) {
        // large: above a 32nd of all, and worth a task
        int m = 0, large = total / 32 > 64 ? total / 32 : 64;
        for (int i = 0; i < n; i++)
            if (b->range[i].leaves > large) b->flag[m++] = i;
        if (!m || n + m > TSS__BROAD_RANGES) break;
        j->ranges = n;
        tss_parallel(b->host, m, tss__broad_split_task, j);
        n += m;
    }
    tss_parallel(b->host, n, tss__broad_sort_task, j);
}

// ---- refit: boxes and groups of the leaves and nodes ----

// One leaf from the items the splits put there, or from the primitives it held before.
static void tss__broad_fill_leaf(const tss__broad *b, tss__broad_tree *t, int leaf, int count) {
    tss__broad_leaf *l = &t->leaf[leaf];
    int *group = t->group + 8 * (size_t)leaf;
    for (int k = 0; k < 8; k++) {
        double box[6] = {DBL_MAX, DBL_MAX, DBL_MAX, -DBL_MAX, -DBL_MAX, -DBL_MAX};
        if (!t->built) {
            l->id[k] = k < count ? t->item[8 * (size_t)leaf + (size_t)k].id : -1;
            for (int a = 0; a < 3; a++)
                l->node[a][k] = l->id[k] < 0 ? -1
                                             : tss__broad_prim_nodes(t, l->id[k])[a < t->arity ? a : 0];
            group[k] = l->id[k] < 0 ? -2 : tss__broad_group(&b->mesh, l->node[0][k]);
        }
        if (l->id[k] >= 0) {
            int node[3] = {l->node[0][k], l->node[1][k], l->node[2][k]};
            tss__broad_prim_box(b->node_box, node, t->arity, box);
        }
        for (int c = 0; c < 6; c++) l->box[c][k] = box[c];
    }
}

// Box, largest id and common group of a leaf as lane k of the node above it. Returns the sum of
// the primitives' extents.
static double tss__broad_lift_leaf(tss__broad_tree *t, int leaf, tss__broad_node *n, int k) {
    const tss__broad_leaf *l = &t->leaf[leaf];
    const int *group = t->group + 8 * (size_t)leaf;
    double sum = 0;
    int top = -1, same = group[0];
    for (int i = 0; i < 8; i++) {
        top = l->id[i] > top ? l->id[i] : top;
        same = group[i] == same || group[i] == -2 ? same : -1;
    }
    for (int c = 0; c < 3; c++) {
        double lo = DBL_MAX, hi = -DBL_MAX;
        for (int i = 0; i < 8; i++) {
            double p = l->box[c][i], q = l->box[3 + c][i];
            lo = p < lo ? p : lo, hi = q > hi ? q : hi;
            sum += l->id[i] < 0 ? 0 : q - p;
        }
        n->box[c][k] = tss__broad_float(lo), n->box[3 + c][k] = tss__broad_float(hi);
    }
    n->top[k] = top, n->group[k] = same;
    return sum;
}

static void tss__broad_lift_node(const tss__broad_node *from, tss__broad_node *n, int k) {
    for (int c = 0; c < 3; c++) {
        float lo = FLT_MAX, hi = -FLT_MAX;
        for (int i = 0; i < 8; i++) {
            lo = from->box[c][i] < lo ? from->box[c][i] : lo;
            hi = from->box[3 + c][i] > hi ? from->box[3 + c][i] : hi;
        }
        n->box[c][k] = lo, n->box[3 + c][k] = hi;
    }
    n->top[k] = -1, n->group[k] = from->group[0];
    for (int i = 0; i < 8; i++) {
        if (from->child[i] == INT_MAX) continue;
        n->top[k] = from->top[i] > n->top[k] ? from->top[i] : n->top[k];
        n->group[k] = from->group[i] == n->group[k] ? n->group[k] : -1;
    }
}

// An empty lane: a box nothing meets.
static void tss__broad_lift_none(tss__broad_node *n, int k) {
    for (int c = 0; c < 3; c++) n->box[c][k] = FLT_MAX, n->box[3 + c][k] = -FLT_MAX;
    n->top[k] = -1, n->group[k] = -1;
}

static double tss__broad_extent(const tss__broad_node *n) {
    double sum = 0;
    for (int k = 0; k < 8; k++)
        for (int c = 0; c < 3 && n->child[k] != INT_MAX; c++)
            sum += (double)n->box[3 + c][k] - (double)n->box[c][k];
    return sum;
}

// Nodes over leaves, and those leaves.
static void tss__broad_refit_task(int block, int worker, void *arg) {
    tss__broad_job *j = (tss__broad_job *)arg;
    tss__broad_tree *t = j->tree;
    int end = tss__broad_cut(t->wide, j->blocks, block + 1);
    double nodes = 0, prims = 0;
    (void)worker;
    for (int i = tss__broad_cut(t->wide, j->blocks, block); i < end; i++) {
        tss__broad_node *n = &t->node[i];
        if (n->child[0] >= 0) continue;
        for (int k = 0; k < 8; k++) {
            int leaf = ~n->child[k];
            tss__broad_lift_none(n, k);
            if (n->child[k] == INT_MAX) continue;
            const tss__broad_part *p = &t->part[leaf >= t->part[1].first];
            tss__broad_fill_leaf(j->b, t, leaf, p->count - 8 * (leaf - p->first));
            prims += tss__broad_lift_leaf(t, leaf, n, k);
        }
        nodes += tss__broad_extent(n);
    }
    j->b->sum[block][0] = nodes, j->b->sum[block][1] = prims;
}

// All boxes of a tree; returns how large the nodes are beside what they hold.
static double tss__broad_refit(tss__broad *b, tss__broad_tree *t, tss__broad_job *j) {
    double nodes = 0, prims = 0;
    j->blocks = tss__broad_blocks(t->wide, 16);
    j->tree = t;
    tss_parallel(b->host, j->blocks, tss__broad_refit_task, j);
    for (int k = 0; k < j->blocks; k++) nodes += b->sum[k][0], prims += b->sum[k][1];
    // children come after their parents
    for (int i = t->wide - 1; i >= 0; i--) {
        tss__broad_node *n = &t->node[i];
        if (n->child[0] < 0) continue;
        for (int k = 0; k < 8; k++) {
            tss__broad_lift_none(n, k);
            if (n->child[k] != INT_MAX) tss__broad_lift_node(&t->node[n->child[k]], n, k);
        }
        nodes += tss__broad_extent(n);
    }
    return prims > 0 ? nodes / prims : 0;
}

// Trees at the node boxes just computed. A tree whose nodes have grown by half beside their
// primitives is sorted anew: by then a search has lost more than sorting costs.
static void tss__broad_update(tss__broad *b, tss__broad_job *j) {
    const double worn = 1.5;
    for (int i = 0; i < TSS__BROAD_TREES; i++) {
        tss__broad_tree *t = &b->tree[i];
        if (t->count && t->built && tss__broad_refit(b, t, j) > worn * t->decay) t->built = 0;
    }
    tss__broad_build(b, j);
    for (int i = 0; i < TSS__BROAD_TREES; i++) {
        tss__broad_tree *t = &b->tree[i];
        if (!t->count || t->built) continue;
        t->decay = tss__broad_refit(b, t, j);
        t->built = 1;
    }
}

// ---- sorting a row ----

// A row of distinct numbers: ranks by counting in runs of 64, then merges. padded: room for 16
// more than n; tmp: n numbers. The result is in out.
static void tss__broad_rank(int *v, int n, int *out) {
    for (int k = n; k < (n + 15) / 16 * 16; k++) v[k] = INT_MAX;
    for (int i = 0; i < n; i += 16) {
        int rank[16] = {0};
        for (int k = 0; k < n; k++) {
            int x = v[k];
            for (int l = 0; l < 16; l++) rank[l] += x < v[i + l];
        }
        for (int l = 0; l < 16 && i + l < n; l++) out[rank[l]] = v[i + l];
    }
}

static void tss__broad_merge(const int *a, int na, const int *b, int nb, int *out) {
    int i = 0, k = 0;
    while (i < na && k < nb) {
        int x = a[i], y = b[k], first = x < y;
        *out++ = first ? x : y;
        i += first, k += !first;
    }
    memcpy(out, a + i, sizeof(int) * (size_t)(na - i));
    memcpy(out + (na - i), b + k, sizeof(int) * (size_t)(nb - k));
}

static void tss__broad_sort_row(int *v, int n, int *tmp, int *out) {
    const int run = 64;
    if (n <= run) {
        tss__broad_rank(v, n, out);
        return;
    }
    // runs of 64 need a padded copy: the padding would overwrite the next run
    int buffer[64];
    for (int i = 0; i < n; i += run) {
        int m = n - i < run ? n - i : run;
        memcpy(buffer, v + i, sizeof(int) * (size_t)m);
        tss__broad_rank(buffer, m, tmp + i);
    }
    int *from = tmp, *to = v;
    for (int w = run; w < n; w *= 2) {
        for (int i = 0; i < n; i += 2 * w) {
            int na = n - i < w ? n - i : w, nb = n - i - na < w ? n - i - na : w;
            tss__broad_merge(from + i, na, from + i + na, nb, to + i);
        }
        int *s = from;
        from = to, to = s;
    }
    memcpy(out, from, sizeof(int) * (size_t)n);
}

// ---- join: queries of one tree against another ----

// The nodes over leaves whose box may meet that of query leaf q, into list; returns their number.
static int tss__broad_descend(const tss__broad_tree *t, const float *box, int fixed, int least,
                              int group, int *list) {
    int stack[TSS__BROAD_STACK], n = 0, found = 0;
    for (int s = 0; s < (fixed ? 1 : 2); s++)
        if (t->part[s].root >= 0) stack[n++] = t->part[s].root;
    while (n) {
        int at = stack[--n];
        const tss__broad_node *w = &t->node[at];
        if (w->child[0] < 0) {
            list[found++] = at;
            continue;
        }
        unsigned m = tss__broad_meet_f(w->box, box) & tss__broad_above(w->top, least);
        if (group >= 0) m &= ~tss__broad_equal(w->group, group);
        TSS_ASSERT(n + 8 <= TSS__BROAD_STACK);
        for (; m; m &= m - 1) stack[n++] = w->child[tss__broad_lowest(m)];
    }
    return found;
}

// What one query lane meets in one leaf: everything but the box test.
static inline unsigned tss__broad_allowed(const tss__broad_leaf *l, const int *node, int qa,
                                          int ta) {
    unsigned shared = 0;
    for (int i = 0; i < qa; i++)
        for (int k = 0; k < ta; k++) shared |= tss__broad_equal(l->node[k], node[i]);
    return ~shared;
}

typedef struct tss__broad_query {
    double d[6];
    float f[6];
    int node[3], least, group;
} tss__broad_query;

// The row of one query: ids of all it may touch, unsorted. First all leaves its box meets, then
// what they hold: two loops without a branch to mispredict. Constant qa, ta make this four
// functions after inlining.
static inline int tss__broad_row(const tss__broad_tree *t, const int *list, int count,
                                 const tss__broad_query *q, int qa, int ta, int *leaves,
                                 int *row) {
    int n = 0, found = 0;
    for (int i = 0; i < count; i++) {
        const tss__broad_node *w = &t->node[list[i]];
        unsigned m = tss__broad_meet_f(w->box, q->f) & tss__broad_above(w->top, q->least);
        if (q->group >= 0) m &= ~tss__broad_equal(w->group, q->group);
        found += tss__broad_pack(w->child, m, leaves + found);
    }
    for (int i = 0; i < found; i++) {
        int leaf = ~leaves[i];
        const tss__broad_leaf *l = &t->leaf[leaf];
        unsigned hit = tss__broad_meet_d(l->box, q->d) & tss__broad_above(l->id, q->least);
        hit &= tss__broad_allowed(l, q->node, qa, ta);
        if (q->group >= 0) hit &= ~tss__broad_equal(t->group + 8 * (size_t)leaf, q->group);
        n += tss__broad_pack(l->id, hit, row + n);
    }
    return n;
}

static int tss__broad_row_of(int kind, const tss__broad_tree *t, const int *list, int count,
                             const tss__broad_query *q, int *leaves, int *row) {
    switch (TSS__IPC_3D || kind == TSS__BROAD_PP ? kind : TSS__BROAD_PE) {
        case TSS__BROAD_EE: return tss__broad_row(t, list, count, q, 2, 2, leaves, row);
        case TSS__BROAD_PT: return tss__broad_row(t, list, count, q, 1, 3, leaves, row);
        case TSS__BROAD_PE: return tss__broad_row(t, list, count, q, 1, 2, leaves, row);
        default: return tss__broad_row(t, list, count, q, 1, 1, leaves, row);
    }
}

// What the eight queries of a leaf have in common: box, smallest id, group (−1: several).
static void tss__broad_leaf_query(const tss__broad_tree *t, int leaf, tss__broad_query *q) {
    const tss__broad_leaf *l = &t->leaf[leaf];
    const int *group = t->group + 8 * (size_t)leaf;
    q->least = INT_MAX, q->group = group[0];
    for (int k = 0; k < 8; k++) {
        if (l->id[k] < 0) continue;
        q->least = l->id[k] < q->least ? l->id[k] : q->least;
        q->group = group[k] == q->group ? q->group : -1;
    }
    for (int c = 0; c < 3; c++) {
        double lo = DBL_MAX, hi = -DBL_MAX;
        for (int k = 0; k < 8; k++) {
            lo = l->box[c][k] < lo ? l->box[c][k] : lo;
            hi = l->box[3 + c][k] > hi ? l->box[3 + c][k] : hi;
        }
        q->f[c] = tss__broad_float(lo), q->f[3 + c] = tss__broad_float(hi);
    }
}

static void tss__broad_lane_query(const tss__broad_tree *t, int leaf, int k, int same,
                                  tss__broad_query *q) {
    const tss__broad_leaf *l = &t->leaf[leaf];
    for (int c = 0; c < 6; c++) {
        q->d[c] = l->box[c][k];
        q->f[c] = tss__broad_float(q->d[c]);
    }
    for (int a = 0; a < 3; a++) q->node[a] = l->node[a][k];
    q->least = same ? l->id[k] : -1;
    q->group = t->group[8 * leaf + k];
}

// A block of query leaves. Rows that do not fit are counted only; above the cap not even that.
static void tss__broad_join_task(int task, int worker, void *arg) {
    tss__broad_job *j = (tss__broad_job *)arg;
    tss__broad *b = j->b;
    const tss__broad_tree *q = j->query, *t = j->target;
    int k = j->first_block + task, same = q == t;
    tss__broad_block *out = &b->block[k];
    int *list = b->scratch + b->scratch_each * (size_t)worker;
    int *leaves = list + t->wide, *row = leaves + t->leaves + 8, *tmp = row + t->count + 16;
    size_t room = out->bytes / sizeof(int);
    if (out->done) return;
    out->need = 0;
    int end = tss__broad_cut(q->leaves, j->blocks, k + 1);
    for (int leaf = tss__broad_cut(q->leaves, j->blocks, k); leaf < end; leaf++) {
        tss__broad_query u;
        tss__broad_leaf_query(q, leaf, &u);
        int count = tss__broad_descend(t, u.f, leaf >= q->part[1].first, same ? u.least : -1,
                                       u.group, list);
        for (int l = 0; l < 8; l++) {
            int id = q->leaf[leaf].id[l];
            if (id < 0) continue;
            tss__broad_lane_query(q, leaf, l, same, &u);
            int n = tss__broad_row_of(j->kind, t, list, count, &u, leaves, row);
            if (out->need + (size_t)n <= room)
                tss__broad_sort_row(row, n, tmp, out->found + out->need);
            b->row_first[id] = (int)out->need, b->row_count[id] = n, b->row_block[id] = (uint8_t)k;
            out->need += (size_t)n;
        }
        if (out->need > (size_t)j->cap) return;
    }
    out->done = out->need <= room;
}

// Rows of the primitives [first, end) to their places in the list.
static void tss__broad_copy_task(int task, int worker, void *arg) {
    const tss__broad_job *j = (const tss__broad_job *)arg;
    const tss__broad *b = j->b;
    int end = tss__broad_cut(j->rows, j->blocks, task + 1);
    (void)worker;
    for (int i = tss__broad_cut(j->rows, j->blocks, task); i < end; i++) {
        tss__pair *p = j->out + b->row_start[i];
        int n = b->row_count[i];
        if (!n) continue;
        const int *found = b->block[b->row_block[i]].found + b->row_first[i];
        for (int k = 0; k < n; k++) p[k].a = i, p[k].b = found[k];
    }
}

static tss_result tss__broad_grow_block(tss__broad *b, int k, size_t numbers) {
    tss__broad_block *o = &b->block[k];
    size_t want = sizeof(int) * (numbers + numbers / 4 + 16);
    int *p = (int *)tss_alloc(b->host, want);
    if (!p) return TSS_ERROR_NO_MEMORY;
    tss_free(b->host, o->found, o->bytes);
    o->found = p, o->bytes = want;
    return TSS_OK;
}

// Room for the blocks that ran out of it; for those never used, what the others took on average.
static tss_result tss__broad_grow_blocks(tss__broad *b, int first, int end, size_t guess) {
    tss_result r = TSS_OK;
    for (int k = first; k < end && !r; k++) {
        const tss__broad_block *o = &b->block[k];
        if (guess ? !o->bytes : !o->done) r = tss__broad_grow_block(b, k, guess ? guess : o->need);
    }
    return r;
}

// One wave of blocks from k on; *sum grows by what it found, *done falls if one ran out of room.
static int tss__broad_join_wave(tss__broad *b, tss__broad_job *j, int k, int64_t *sum, int *done) {
    const int wave = 32;
    int n = j->blocks - k < wave ? j->blocks - k : wave;
    j->first_block = k;
    tss_parallel(b->host, n, tss__broad_join_task, j);
    for (int i = k; i < k + n; i++) *sum += (int64_t)b->block[i].need, *done &= b->block[i].done;
    return n;
}

// All rows of a join into the blocks; *total: pairs, or more than j->cap. In waves, so that
// hopeless cases end soon; twice where a block ran out of room.
static tss_result tss__broad_find(tss__broad *b, tss__broad_job *j, int64_t *total) {
    j->blocks = tss__broad_blocks(j->query->leaves, 8);
    for (int k = 0; k < j->blocks; k++) b->block[k].done = 0, b->block[k].need = 0;
    for (int done = 0; !done;) {
        done = 1, *total = 0;
        for (int k = 0; k < j->blocks;) {
            tss_result r = TSS_OK;
            k += tss__broad_join_wave(b, j, k, total, &done);
            if (*total > j->cap) return TSS_OK;
            if (*total) r = tss__broad_grow_blocks(b, k, j->blocks, (size_t)(*total / k) + 1);
            if (r) return r;
        }
        tss_result r = done ? TSS_OK : tss__broad_grow_blocks(b, 0, j->blocks, 0);
        if (r) return r;
    }
    return TSS_OK;
}

// One list: *cap goes down by its pairs, or to −1 when there are more.
static tss_result tss__broad_join(tss__broad *b, tss__broad_job *j, int kind, int query, int target,
                                  int *cap) {
    tss__broad_pairs *out = &b->list[kind];
    int64_t total = 0;
    j->query = &b->tree[query], j->target = &b->tree[target];
    j->kind = kind, j->cap = *cap;
    if (!j->query->count || !j->target->count) return TSS_OK;
    int rows = kind == TSS__BROAD_EE ? b->mesh.edges : b->mesh.points;
    memset(b->row_count, 0, sizeof(int) * (size_t)rows);
    tss_result r = tss__broad_find(b, j, &total);
    if (r) return r;
    if (total > *cap) {
        *cap = -1;
        return TSS_OK;
    }
    r = tss__broad_pairs_reserve(b->host, out, (int)total);
    if (r) return r;
    int at = 0;
    for (int i = 0; i < rows; i++) b->row_start[i] = at, at += b->row_count[i];
    TSS_ASSERT(at == total);
    j->rows = rows, j->out = out->pair;
    j->blocks = tss__broad_blocks(rows, 256);
    tss_parallel(b->host, j->blocks, tss__broad_copy_task, j);
    out->count = at;
    *cap -= at;
    return TSS_OK;
}

static tss_result tss__broad_search_lists(tss__broad *b, tss__broad_job *j, int *cap) {
    static const int side[4][3] = {{TSS__BROAD_EE, TSS__BROAD_EDGES, TSS__BROAD_EDGES},
                                   {TSS__BROAD_PT, TSS__BROAD_POINTS, TSS__BROAD_TRIS},
                                   {TSS__BROAD_PE, TSS__BROAD_LONE, TSS__BROAD_STRUTS},
                                   {TSS__BROAD_PP, TSS__BROAD_LONE, TSS__BROAD_LONE}};
    int flat = b->mesh.dim == 2;
    for (int i = 0; i < 4; i++) {
        int kind = side[i][0], query = side[i][1], target = side[i][2];
        if (flat && (kind == TSS__BROAD_EE || kind == TSS__BROAD_PT)) continue;
        if (flat && kind == TSS__BROAD_PE) query = TSS__BROAD_POINTS, target = TSS__BROAD_EDGES;
        tss_result r = tss__broad_join(b, j, kind, query, target, cap);
        if (r || *cap < 0) return r;
    }
    return TSS_OK;
}

// Fills b->list with all pairs whose boxes, each grown by r, meet over x + t·d, t ∈ [0, t_max]
// (d NULL: at x): every pair that comes to a distance of 2 r or less is among them; for a reach
// dhat pass r = dhat/2. More than cap pairs in all: *over = 1 and empty lists; shorten the sweep.
// Errors: no memory, or TSS_ERROR_BAD_STATE if a box is not finite; lists are then empty.
static tss_result tss__broad_search(tss__broad *b, const double *x, const double *d, double t_max,
                                    double r, int cap, int *over) {
    tss__broad_job j;
    memset(&j, 0, sizeof j);
    j.b = b, j.x = x, j.d = d, j.t = t_max, j.r = r;
    *over = 0;
    for (int i = 0; i < TSS__BROAD_KINDS; i++) b->list[i].count = 0;
    int most = 0;
    for (int i = 0; i < TSS__BROAD_TREES; i++)
        most = b->tree[i].count > most ? b->tree[i].count : most;
    if (!most) return TSS_OK;
    // of a join: nodes, leaves, and twice a row, padded
    b->scratch_each = ((size_t)most / 16 + (size_t)most / 8 + 2 * (size_t)most + 95) / 16 * 16;
    TSS__BROAD_FIT(b->host, b, scratch, int, b->scratch_each * (size_t)tss_workers(b->host));
    j.blocks = tss__broad_blocks(b->mesh.nodes, 512);
    tss_parallel(b->host, j.blocks, tss__broad_box_task, &j);
    for (int k = 0; k < j.blocks; k++)
        if (b->flag[k]) return TSS_ERROR_BAD_STATE;
    tss__broad_update(b, &j);
    tss_result res = tss__broad_search_lists(b, &j, &cap);
    *over = !res && cap < 0;
    if (res || *over)
        for (int i = 0; i < TSS__BROAD_KINDS; i++) b->list[i].count = 0;
    return res;
}

// ---------------------------------------------------------------------------------------------
// >>pair_filter (private)
// Eight pairs at a time through branch-free distances. All kinds are two kernels: segment–segment
// (a point is a segment of length zero) and point–triangle. Both give the vector u from the
// closest point of a to that of b, which is
//   near:  d = |u| < r (rounding aside: the narrow phase decides), and
//   reach: a direction to separate the pair along. gap(s) = min_b u·x_b(s) − max_a u·x_a(s) is a
//          minimum of linear functions of s, so concave: larger than g at both ends means larger
//          than g in between, for any u, however inaccurate; |u| ≥ the true distance (to 1e-5)
//          makes g = |u| · reach + eta · u·u large enough. Only the rounding of gap itself counts.
// Cost: about 10 ns a pair. Near parallel segments may be taken for up to 1e-8 of their length
// farther than they are; the narrow phase decides.
// ---------------------------------------------------------------------------------------------

typedef struct tss__broad_lanes {
    double p[3][3][8];  // places 1, 2, 3 relative to place 0: place, coordinate, lane
    double v[3][3][8];  // the same of d
    double u[3][8];     // closest vector
} tss__broad_lanes;

// Nodes of a pair. EE: a0 a1 b0 b1; PT: p t0 t1 t2; PE: p e0 e1 −1; PP: p q −1 −1.
static void tss__broad_nodes(const tss__broad_mesh *m, int kind, tss__pair p, int *node) {
    const int *s, *t;
    node[3] = -1;
    switch (kind) {
        case TSS__BROAD_EE:
            s = m->edge + 2 * (size_t)p.a, t = m->edge + 2 * (size_t)p.b;
            node[0] = s[0], node[1] = s[1], node[2] = t[0], node[3] = t[1];
            break;
        case TSS__BROAD_PT:
            t = m->tri + 3 * (size_t)p.b;
            node[0] = m->point[p.a], node[1] = t[0], node[2] = t[1], node[3] = t[2];
            break;
        case TSS__BROAD_PE:
            t = m->edge + 2 * (size_t)p.b;
            node[0] = m->point[p.a], node[1] = t[0], node[2] = t[1];
            break;
        default: node[0] = m->point[p.a], node[1] = m->point[p.b], node[2] = -1;
    }
}

// The same with degenerate segments written out, for the kernels: always four nodes.
static inline void tss__broad_four(const tss__broad_mesh *m, int kind, tss__pair p, int *node) {
    tss__broad_nodes(m, kind, p, node);
    if (kind == TSS__BROAD_PE) {
        node[3] = node[2], node[2] = node[1], node[1] = node[0];
    } else if (kind == TSS__BROAD_PP) {
        node[2] = node[3] = node[1], node[1] = node[0];
    }
}

// Places 1..3 minus place 0 of up to eight pairs; missing lanes repeat the last.
static inline void tss__broad_gather(int dim, int (*node)[4], const double *x,
                                     double (*p)[3][8]) {
#if defined(TSS__BROAD_AVX)
    // three (two) coordinates a load, then 4 × 4 transposes
    __m256i take = _mm256_set_epi64x(0, dim == 3 ? -1 : 0, -1, -1);
    for (int h = 0; h < 8; h += 4) {
        __m256d o[4], q[4];
        for (int k = 0; k < 4; k++)
            o[k] = _mm256_maskload_pd(x + (ptrdiff_t)node[h + k][0] * dim, take);
        for (int i = 0; i < 3; i++) {
            for (int k = 0; k < 4; k++)
                q[k] = _mm256_sub_pd(
                    _mm256_maskload_pd(x + (ptrdiff_t)node[h + k][i + 1] * dim, take), o[k]);
            __m256d a = _mm256_unpacklo_pd(q[0], q[1]), b = _mm256_unpackhi_pd(q[0], q[1]);
            __m256d c = _mm256_unpacklo_pd(q[2], q[3]), d = _mm256_unpackhi_pd(q[2], q[3]);
            _mm256_storeu_pd(p[i][0] + h, _mm256_permute2f128_pd(a, c, 0x20));
            _mm256_storeu_pd(p[i][1] + h, _mm256_permute2f128_pd(b, d, 0x20));
            _mm256_storeu_pd(p[i][2] + h, _mm256_permute2f128_pd(a, c, 0x31));
        }
    }
#else
    for (int k = 0; k < 8; k++) {
        const double *o = x + (size_t)node[k][0] * (size_t)dim;
        for (int i = 0; i < 3; i++) {
            const double *q = x + (size_t)node[k][i + 1] * (size_t)dim;
            p[i][0][k] = q[0] - o[0], p[i][1][k] = q[1] - o[1];
            p[i][2][k] = dim == 3 ? q[2] - o[2] : 0;
        }
    }
#endif
}

// Lanes of up to eight pairs at x, and their motion unless d is NULL.
static void tss__broad_lanes_of(const tss__broad_mesh *m, int kind, const tss__pair *pair, int n,
                                const double *x, const double *d, tss__broad_lanes *g) {
    int node[8][4];
    for (int k = 0; k < 8; k++) tss__broad_four(m, kind, pair[k < n ? k : n - 1], node[k]);
    tss__broad_gather(m->dim, node, x, g->p);
    if (d) tss__broad_gather(m->dim, node, d, g->v);
}

static inline double tss__broad_clamp(double v) {
    v = v > 0 ? v : 0;  // also for not-a-number
    return v < 1 ? v : 1;
}

// Segments a = 0 → p[0], b = p[1] → p[2]. With n = e_a × e_b and w = b0 − a0 the lines are nearest
// at s = (w × e_b)·n / n·n; then the nearest point of b, clamped, and of a, clamped: exact unless
// parallel, where any s serves. Tiny denominators are those of zero-length or parallel segments.
static void tss__broad_segments(tss__broad_lanes *g) {
    const double tiny = DBL_MIN;
    for (int k = 0; k < 8; k++) {
        double ax = g->p[0][0][k], ay = g->p[0][1][k], az = g->p[0][2][k];
        double wx = g->p[1][0][k], wy = g->p[1][1][k], wz = g->p[1][2][k];
        double bx = g->p[2][0][k] - wx, by = g->p[2][1][k] - wy, bz = g->p[2][2][k] - wz;
        double nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
        double cx = wy * bz - wz * by, cy = wz * bx - wx * bz, cz = wx * by - wy * bx;
        double nn = nx * nx + ny * ny + nz * nz, aa = ax * ax + ay * ay + az * az;
        double bb = bx * bx + by * by + bz * bz, ab = ax * bx + ay * by + az * bz;
        double wa = wx * ax + wy * ay + wz * az, wb = wx * bx + wy * by + wz * bz;
        double s = tss__broad_clamp((cx * nx + cy * ny + cz * nz) / (nn > tiny ? nn : 1));
        double t = tss__broad_clamp((s * ab - wb) / (bb > tiny ? bb : 1));
        s = tss__broad_clamp((wa + t * ab) / (aa > tiny ? aa : 1));
        double ux = wx + t * bx - s * ax, uy = wy + t * by - s * ay, uz = wz + t * bz - s * az;
        // As in tss__near_direction. s (1 − s) > 0: inside a.
        double h = (wx * nx + wy * ny + wz * nz) / (nn > tiny ? nn : 1);
        double uu = ux * ux + uy * uy + uz * uz, in_a = s * (1 - s), in_b = t * (1 - t);
        double la = in_a > 0 ? aa : 0, lb = in_b > 0 ? bb : 0, ee = la > lb ? la : lb;
        double ex = la > lb ? ax : bx, ey = la > lb ? ay : by, ez = la > lb ? az : bz;
        double f = (ux * ex + uy * ey + uz * ez) / (ee > tiny ? ee : HUGE_VAL);
        double enough = in_a * in_b > 0 ? 0 : TSS__AS_NORMAL * uu;
        enough = nn > TSS__SIN2_NORMAL * aa * bb ? enough : DBL_MAX;
        double hh = h * h * nn;
        g->u[0][k] = hh >= enough ? h * nx : ux - f * ex;
        g->u[1][k] = hh >= enough ? h * ny : uy - f * ey;
        g->u[2][k] = hh >= enough ? h * nz : uz - f * ez;
    }
}

// Point 0 against triangle p[0], p[1], p[2]: u to the plane if the foot lies inside (or outside by
// next to nothing beside u), else the shortest of those to the three sides.
static void tss__broad_triangles(tss__broad_lanes *g) {
    const double tiny = DBL_MIN;
    double best[8];
    for (int i = 0; i < 3; i++) {
        double (*o)[8] = g->p[i], (*q)[8] = g->p[i == 2 ? 0 : i + 1];
        for (int k = 0; k < 8; k++) {
            double ex = q[0][k] - o[0][k], ey = q[1][k] - o[1][k], ez = q[2][k] - o[2][k];
            double ee = ex * ex + ey * ey + ez * ez;
            double oe = o[0][k] * ex + o[1][k] * ey + o[2][k] * ez;
            double s = tss__broad_clamp(-oe / (ee > tiny ? ee : 1));
            double ux = o[0][k] + s * ex, uy = o[1][k] + s * ey, uz = o[2][k] + s * ez;
            double along = ee > tiny ? ee : HUGE_VAL;
            double f = (ux * ex + uy * ey + uz * ez) / (s * (1 - s) > 0 ? along : HUGE_VAL);
            ux -= f * ex, uy -= f * ey, uz -= f * ez;
            double d = ux * ux + uy * uy + uz * uz;
            int take = i == 0 || d < best[k];
            best[k] = take ? d : best[k];
            g->u[0][k] = take ? ux : g->u[0][k];
            g->u[1][k] = take ? uy : g->u[1][k];
            g->u[2][k] = take ? uz : g->u[2][k];
        }
    }
    for (int k = 0; k < 8; k++) {
        double ox = g->p[0][0][k], oy = g->p[0][1][k], oz = g->p[0][2][k];
        double ex = g->p[1][0][k] - ox, ey = g->p[1][1][k] - oy, ez = g->p[1][2][k] - oz;
        double fx = g->p[2][0][k] - ox, fy = g->p[2][1][k] - oy, fz = g->p[2][2][k] - oz;
        double nx = ey * fz - ez * fy, ny = ez * fx - ex * fz, nz = ex * fy - ey * fx;
        double nn = nx * nx + ny * ny + nz * nz;
        // barycentric coordinates of the foot times n·n, with w = −o
        double s = -((oy * fz - oz * fy) * nx + (oz * fx - ox * fz) * ny +
                     (ox * fy - oy * fx) * nz);
        double t = -((ey * oz - ez * oy) * nx + (ez * ox - ex * oz) * ny +
                     (ex * oy - ey * ox) * nz);
        double h = (ox * nx + oy * ny + oz * nz) / (nn > tiny ? nn : 1);
        int in = (nn > tiny) & (s >= 0) & (t >= 0) & (s + t <= nn);
        double ee = ex * ex + ey * ey + ez * ez, ff = fx * fx + fy * fy + fz * fz;
        in |= (nn > TSS__SIN2_NORMAL * ee * ff) & (h * h * nn >= TSS__AS_NORMAL * best[k]);
        g->u[0][k] = in ? h * nx : g->u[0][k];
        g->u[1][k] = in ? h * ny : g->u[1][k];
        g->u[2][k] = in ? h * nz : g->u[2][k];
    }
}

static inline void tss__broad_closest(int kind, tss__broad_lanes *g) {
    if (TSS__IPC_3D && kind == TSS__BROAD_PT) tss__broad_triangles(g);
    else tss__broad_segments(g);
}

// Lanes with |u|² < r².
static unsigned tss__broad_lanes_near(const tss__broad_lanes *g, double r2) {
    unsigned m = 0;
    double d2[8];
    for (int k = 0; k < 8; k++)
        d2[k] = g->u[0][k] * g->u[0][k] + g->u[1][k] * g->u[1][k] + g->u[2][k] * g->u[2][k];
    for (int k = 0; k < 8; k++) m |= (unsigned)(d2[k] < r2) << k;
    return m;
}

// Lanes not proved apart along u over [0, t]. The rounding of one projection is below
// 8 · 2^-53 · Σ|u_c| · Σ(|p_c| + t |v_c|): differences, product, two sums; 1e-14 is ten times that.
static unsigned tss__broad_lanes_reach(const tss__broad_lanes *g, int kind, double t, double reach,
                                       double eta) {
    double need[8], lo0[8], lo1[8], hi0[8], hi1[8];
    int first = kind != TSS__BROAD_PT;  // places 1.. of this number belong to a
    unsigned m = 0;
    for (int k = 0; k < 8; k++) {
        double ux = g->u[0][k], uy = g->u[1][k], uz = g->u[2][k];
        double uu = ux * ux + uy * uy + uz * uz;
        need[k] = sqrt(uu) * reach + eta * uu;
        hi0[k] = hi1[k] = 0, lo0[k] = lo1[k] = DBL_MAX;
    }
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 8; k++) {
            double ux = g->u[0][k], uy = g->u[1][k], uz = g->u[2][k];
            double px = g->p[i][0][k], py = g->p[i][1][k], pz = g->p[i][2][k];
            double vx = t * g->v[i][0][k], vy = t * g->v[i][1][k], vz = t * g->v[i][2][k];
            double at = ux * px + uy * py + uz * pz;
            double then = ux * (px + vx) + uy * (py + vy) + uz * (pz + vz);
            double size = fabs(px) + fabs(py) + fabs(pz) + fabs(vx) + fabs(vy) + fabs(vz);
            double slack = 1e-14 * size * (fabs(ux) + fabs(uy) + fabs(uz));
            int of_a = i < first;
            double up0 = at + slack, up1 = then + slack, dn0 = at - slack, dn1 = then - slack;
            hi0[k] = of_a && up0 > hi0[k] ? up0 : hi0[k];
            hi1[k] = of_a && up1 > hi1[k] ? up1 : hi1[k];
            lo0[k] = !of_a && dn0 < lo0[k] ? dn0 : lo0[k];
            lo1[k] = !of_a && dn1 < lo1[k] ? dn1 : lo1[k];
        }
    for (int k = 0; k < 8; k++)
        m |= (unsigned)!((lo0[k] - hi0[k] > need[k]) & (lo1[k] - hi1[k] > need[k])) << k;
    return m;
}

// A pass over a list: d NULL = near with radius reach.
typedef struct tss__broad_pass {
    tss__broad *b;
    int kind, blocks, count, first_block, stride;
    const double *x, *d;
    double t, reach, eta;
    const tss__pair *in;
    tss__pair *out;
} tss__broad_pass;

// Groups of eight that are loaded before any is worked on: what was stored lane by lane is then
// not waited for when it is read as vectors.
#define TSS__BROAD_CHUNK 8

// Loads the groups from i on, at most up to `end`; returns the number of pairs.
static int tss__broad_load(const tss__broad_pass *s, int i, int end, tss__broad_lanes *g) {
    const tss__broad_mesh *m = &s->b->mesh;
    int groups = end - i < TSS__BROAD_CHUNK ? end - i : TSS__BROAD_CHUNK;
    int n = s->count - 8 * i < 8 * groups ? s->count - 8 * i : 8 * groups;
    for (int j = 0; j < groups; j++)
        tss__broad_lanes_of(m, s->kind, s->in + 8 * (size_t)(i + j), n - 8 * j, s->x, s->d, &g[j]);
    return n;
}

// Blocks are cut at multiples of eight pairs: one byte of the mask each.
static void tss__broad_mask_task(int k, int worker, void *arg) {
    const tss__broad_pass *s = (const tss__broad_pass *)arg;
    int groups = (s->count - 1) / 8 + 1, end = tss__broad_cut(groups, s->blocks, k + 1), kept = 0;
    (void)worker;
    for (int i = tss__broad_cut(groups, s->blocks, k); i < end; i += TSS__BROAD_CHUNK) {
        tss__broad_lanes g[TSS__BROAD_CHUNK];
        int n = tss__broad_load(s, i, end, g);
        for (int j = 0; n > 8 * j; j++) {
            int left = n - 8 * j;
            tss__broad_closest(s->kind, &g[j]);
            unsigned m = s->d ? tss__broad_lanes_reach(&g[j], s->kind, s->t, s->reach, s->eta)
                              : tss__broad_lanes_near(&g[j], s->reach * s->reach);
            if (left < 8) m &= (1u << left) - 1u;
            s->b->mask[i + j] = (uint8_t)m;
            kept += tss__broad_ones(m);
        }
    }
    s->b->flag[k] = kept;
}

static void tss__broad_pack_task(int k, int worker, void *arg) {
    const tss__broad_pass *s = (const tss__broad_pass *)arg;
    int groups = (s->count - 1) / 8 + 1, end = tss__broad_cut(groups, s->blocks, k + 1);
    tss__pair *to = s->out + s->b->flag[k];
    (void)worker;
    for (int i = tss__broad_cut(groups, s->blocks, k); i < end; i++)
        for (unsigned m = s->b->mask[i]; m; m &= m - 1)
            *to++ = s->in[8 * (size_t)i + (size_t)tss__broad_lowest(m)];
}

static tss_result tss__broad_run(tss__broad_pass *s, const tss__broad_pairs *in,
                                 tss__broad_pairs *out) {
    tss__broad *b = s->b;
    int count = 0;
    s->count = in->count;
    if (!in->count) {
        out->count = 0;
        return TSS_OK;
    }
    int groups = (in->count - 1) / 8 + 1;
    TSS__BROAD_FIT(b->host, b, mask, uint8_t, groups);
    s->in = in->pair;
    s->blocks = tss__broad_blocks(groups, 64);
    tss_parallel(b->host, s->blocks, tss__broad_mask_task, s);
    for (int k = 0; k < s->blocks; k++) {
        int n = b->flag[k];
        b->flag[k] = count, count += n;
    }
    tss_result r = tss__broad_pairs_reserve(b->host, out, count);
    if (r) return r;
    s->in = in->pair, s->out = out->pair;
    // in place, a block would write where an earlier one still reads: then in order
    if (in != out) tss_parallel(b->host, s->blocks, tss__broad_pack_task, s);
    for (int k = 0; k < s->blocks && in == out; k++) tss__broad_pack_task(k, 0, s);
    out->count = count;
    return TSS_OK;
}

// out = the pairs of in (all of one kind) nearer than r at x, in order. out may be in. No memory:
// out as it was.
static tss_result tss__broad_near(tss__broad *b, int kind, const tss__broad_pairs *in,
                                  const double *x, double r, tss__broad_pairs *out) {
    tss__broad_pass s = {b, kind, 0, 0, 0, 1, x, NULL, 0, r, 0, NULL, NULL};
    return tss__broad_run(&s, in, out);
}

// out = in without the pairs proved to stay farther apart than reach + eta · (distance at x) on
// all of x + s·d, s ∈ [0, t]; otherwise as above. reach = dhat, eta = 0: what a barrier may see;
// reach = least distance, eta = the share of the distance that additive CCD leaves: what may
// limit the step.
static tss_result tss__broad_reach(tss__broad *b, int kind, const tss__broad_pairs *in,
                                   const double *x, const double *d, double t, double reach,
                                   double eta, tss__broad_pairs *out) {
    tss__broad_pass s = {b, kind, 0, 0, 0, 1, x, d, t, reach, eta, NULL, NULL};
    return tss__broad_run(&s, in, out);
}

// ---------------------------------------------------------------------------------------------
// >>collision_free_step (private)
// The largest t such that no pair of a list comes nearer than slack · (its distance at x) on
// x + s·d, s ∈ [0, t], nor than `least`: a pair nearer already may only part. Least is what the
// rounding of stored positions may take away. tss_ipc_ccd eight pairs at a time (its banner has the
// proof). Each pair is
// first advanced once; four in five are done then. The others are gathered into full lanes.
// A pair that is safe up to the best t so far is dropped, so the result is the minimum over all
// pairs whatever the order. Blocks run in waves of fixed size that hand on the best t.
// ---------------------------------------------------------------------------------------------

typedef struct tss__broad_front {
    double t[8], next[8], gap[8], floor[8];  // reached, provably safe, bound of the distance now
} tss__broad_front;

// One vertex along the direction n: place and speed, and the sizes their rounding goes with.
typedef struct tss__broad_spot {
    double at, rate, size, fast;
} tss__broad_spot;

static inline double tss__broad_min(double a, double b) {
    return a < b ? a : b;
}

static inline tss__broad_spot tss__broad_spot_of(const tss__broad_lanes *g, int i, int k, double nx,
                                                 double ny, double nz) {
    double px = g->p[i][0][k], py = g->p[i][1][k], pz = g->p[i][2][k];
    double vx = g->v[i][0][k], vy = g->v[i][1][k], vz = g->v[i][2][k];
    tss__broad_spot s;
    s.at = nx * px + ny * py + nz * pz, s.size = fabs(px) + fabs(py) + fabs(pz);
    s.rate = nx * vx + ny * vy + nz * vz, s.fast = fabs(vx) + fabs(vy) + fabs(vz);
    return s;
}

// From vertex a to vertex b: gap(t) >= at + t · rate for all t, whatever the rounding. As in
// tss_ipc_ccd: 8 eps of the size of the terms, once more for the evaluation.
static inline tss__broad_spot tss__broad_between(tss__broad_spot a, tss__broad_spot b) {
    const double eps = 8 * DBL_EPSILON;
    tss__broad_spot s;
    s.size = eps * (a.size + b.size), s.fast = eps * (a.fast + b.fast);
    s.at = (b.at - a.at) - s.size, s.rate = (b.rate - a.rate) - s.fast;
    return s;
}

static inline double tss__broad_bound(tss__broad_spot s, double t) {
    return s.at + t * s.rate - t * s.fast;
}

// When the bound falls to the floor; DBL_MAX: never.
static inline double tss__broad_fall(tss__broad_spot s, double floor) {
    double t = (s.at - floor) / (fabs(s.rate) + DBL_MIN) * (1 - 4 * DBL_EPSILON);
    return s.rate < 0 ? t : DBL_MAX;
}

// Lower bound of the distance at f->t along the closest vector there, and the time to which it
// stays above the floor: each vertex of a against each of b, all moving linearly. At the start
// the floor is −DBL_MAX and becomes slack times the bound, or least; later both are 0. Four short
// loops over arrays of their own: in a longer one gcc threads the choices into branches and makes
// no vectors.
static inline void tss__broad_advance_as(int triangle, const tss__broad_lanes *g, double slack,
                                         double least, tss__broad_front *f) {
    tss__broad_spot of[4];
    tss__broad_front out;
    double nx[8], ny[8], nz[8], at[4][8], rate[4][8], fall[4][8];
    for (int k = 0; k < 8; k++) {
        double x = g->u[0][k], y = g->u[1][k], z = g->u[2][k];
        // touching: a direction shorter than 1, even 0, only lowers the bounds
        double r = 1 / sqrt(x * x + y * y + z * z + DBL_MIN);
        nx[k] = r * x, ny[k] = r * y, nz[k] = r * z;
    }
    for (int k = 0; k < 8; k++) {
        tss__broad_spot o = {0, 0, 0, 0};
        tss__broad_spot p = tss__broad_spot_of(g, 0, k, nx[k], ny[k], nz[k]);
        tss__broad_spot q = tss__broad_spot_of(g, 1, k, nx[k], ny[k], nz[k]);
        tss__broad_spot w = tss__broad_spot_of(g, 2, k, nx[k], ny[k], nz[k]);
        // point o, triangle p q w; or segments o p, q w
        of[0] = triangle ? tss__broad_between(o, p) : tss__broad_between(p, q);
        of[1] = triangle ? of[0] : tss__broad_between(p, w);
        of[2] = tss__broad_between(o, q), of[3] = tss__broad_between(o, w);
        double t = f->t[k];
        out.gap[k] = tss__broad_min(
            tss__broad_min(tss__broad_bound(of[0], t), tss__broad_bound(of[1], t)),
            tss__broad_min(tss__broad_bound(of[2], t), tss__broad_bound(of[3], t)));
        at[0][k] = of[0].at, at[1][k] = of[1].at, at[2][k] = of[2].at, at[3][k] = of[3].at;
        rate[0][k] = of[0].rate, rate[1][k] = of[1].rate;
        rate[2][k] = of[2].rate, rate[3][k] = of[3].rate;
    }
    for (int k = 0; k < 8; k++) {
        double low = slack * out.gap[k], room = tss__broad_min(least, out.gap[k]);
        low = low > room ? low : room;
        out.floor[k] = low > f->floor[k] ? low : f->floor[k];
    }
    for (int k = 0; k < 8; k++) {
        tss__broad_spot s0 = {at[0][k], rate[0][k], 0, 0}, s1 = {at[1][k], rate[1][k], 0, 0};
        tss__broad_spot s2 = {at[2][k], rate[2][k], 0, 0}, s3 = {at[3][k], rate[3][k], 0, 0};
        fall[0][k] = tss__broad_fall(s0, out.floor[k]), fall[1][k] = tss__broad_fall(s1, out.floor[k]);
        fall[2][k] = tss__broad_fall(s2, out.floor[k]), fall[3][k] = tss__broad_fall(s3, out.floor[k]);
    }
    for (int k = 0; k < 8; k++) {
        double next = tss__broad_min(tss__broad_min(fall[0][k], fall[1][k]),
                                     tss__broad_min(fall[2][k], fall[3][k]));
        // a bound below the floor, or not a number, proves nothing
        int good = (out.gap[k] > 0) & (out.gap[k] >= out.floor[k]);
        out.t[k] = f->t[k];
        out.next[k] = good ? next : f->t[k];
    }
    *f = out;
}

static void tss__broad_advance(const tss__broad_lanes *g, int kind, double slack, double least,
                               tss__broad_front *f) {
    if (TSS__IPC_3D && kind == TSS__BROAD_PT) tss__broad_advance_as(1, g, slack, least, f);
    else tss__broad_advance_as(0, g, slack, least, f);
}

// Pairs waiting for full lanes, and the best so far of one block.
typedef struct tss__broad_queue {
    tss__pair pair[16];
    int id[16], count;
    double t[16], floor[16];
    double best;
    int culprit;  // place in the list, −1: none
} tss__broad_queue;

// Relative positions at the times of f.
static void tss__broad_move(double (*p)[3][8], double (*v)[3][8], const double *t,
                            double (*out)[3][8]) {
    for (int i = 0; i < 3; i++)
        for (int c = 0; c < 3; c++)
            for (int k = 0; k < 8; k++) out[i][c][k] = p[i][c][k] + t[k] * v[i][c][k];
}

// Advances the first n (≤ 8) of the queue to their ends and takes them out.
static void tss__broad_finish(const tss__broad_pass *s, tss__broad_queue *q, int n) {
    const int most = 64;  // doublings of accuracy; where it is not enough, the time reached is safe
    tss__broad_lanes g, now;
    tss__broad_front f;
    int open = (1 << n) - 1;
    tss__broad_lanes_of(&s->b->mesh, s->kind, q->pair, n, s->x, s->d, &g);
    for (int k = 0; k < 8; k++) f.t[k] = q->t[k < n ? k : 0], f.floor[k] = q->floor[k < n ? k : 0];
    for (int turn = 0; turn < most && open; turn++) {
        tss__broad_move(g.p, g.v, f.t, now.p);
        tss__broad_closest(s->kind, &now);
        memcpy(g.u, now.u, sizeof g.u);
        tss__broad_advance(&g, s->kind, 0, 0, &f);
        for (int k = 0; k < n; k++) {
            if (!(open >> k & 1)) continue;
            // near the floor further steps gain nothing, unless the whole way is free
            int stop = !(f.next[k] > f.t[k]) ||
                       (f.gap[k] <= 1.1 * f.floor[k] && f.next[k] < q->best);
            if (!stop) f.t[k] = f.next[k];
            if (stop || f.t[k] >= q->best) open &= ~(1 << k);
        }
    }
    for (int k = 0; k < n; k++)
        if (f.t[k] < q->best) q->best = f.t[k], q->culprit = q->id[k];
    q->count -= n;
    memmove(q->pair, q->pair + n, sizeof(tss__pair) * (size_t)q->count);
    memmove(q->id, q->id + n, sizeof(int) * (size_t)q->count);
    memmove(q->t, q->t + n, sizeof(double) * (size_t)q->count);
    memmove(q->floor, q->floor + n, sizeof(double) * (size_t)q->count);
}

// Queues those of n pairs from place `first` on that are not safe up to the best time.
static void tss__broad_enqueue(const tss__broad_pass *s, int first, int n,
                               const tss__broad_front *f, tss__broad_queue *q) {
    for (int k = 0; k < n; k++) {
        if (f->next[k] >= q->best) continue;
        int at = q->count++;
        q->pair[at] = s->in[first + k], q->id[at] = first + k;
        q->t[at] = f->next[k], q->floor[at] = f->floor[k];
    }
    if (q->count >= 8) tss__broad_finish(s, q, 8);
}

// One block: first advance of all, full treatment of those it does not settle.
static void tss__broad_step_task(int task, int worker, void *arg) {
    tss__broad_pass *s = (tss__broad_pass *)arg;
    int block = s->first_block + task, groups = (s->count - 1) / 8 + 1;
    int end = tss__broad_cut(groups, s->blocks, block + 1);
    tss__broad_queue q;
    (void)worker;
    q.count = 0, q.best = s->t, q.culprit = -1;
    for (int i = tss__broad_cut(groups, s->blocks, block); i < end;
         i += TSS__BROAD_CHUNK * s->stride) {
        tss__broad_lanes g[TSS__BROAD_CHUNK];
        int n = tss__broad_load(s, i, end, g);
        for (int j = 0; n > 8 * j; j++) {
            tss__broad_front f;
            for (int k = 0; k < 8; k++) f.t[k] = 0, f.floor[k] = -DBL_MAX;
            tss__broad_closest(s->kind, &g[j]);
            tss__broad_advance(&g[j], s->kind, s->eta, s->reach, &f);
            tss__broad_enqueue(s, 8 * (i + j), n - 8 * j < 8 ? n - 8 * j : 8, &f, &q);
        }
    }
    if (q.count) tss__broad_finish(s, &q, q.count);
    s->b->sum[block][0] = q.best, s->b->flag[block] = q.culprit;
}

// Blocks first..first + n − 1, and what they found.
static void tss__broad_wave(tss__broad_pass *s, int first, int n, int *culprit) {
    tss__broad *b = s->b;
    s->first_block = first;
    tss_parallel(b->host, n, tss__broad_step_task, s);
    for (int i = first; i < first + n; i++) {
        if (b->flag[i] < 0 || !(b->sum[i][0] < s->t)) continue;
        s->t = b->sum[i][0];
        if (culprit) *culprit = b->flag[i];
    }
}

// The largest time in [0, t] as above for the pairs of in (all of one kind); *culprit (may be
// NULL): the place in the list of the pair that limits it, −1: none. 0: a pair touches at x.
static double tss__broad_step(tss__broad *b, int kind, const tss__broad_pairs *in, const double *x,
                              const double *d, double slack, double least, double t, int *culprit) {
    const int wave = 32;
    tss__broad_pass s = {b, kind, 0, in->count, 0, 1, x, d, t, least, slack, in->pair, NULL};
    if (culprit) *culprit = -1;
    if (!in->count) return t;
    s.blocks = tss__broad_blocks((in->count - 1) / 8 + 1, 64);
    // a sample of all first: with its best time most pairs are settled at once
    s.stride = 32;
    tss__broad_wave(&s, 0, s.blocks, culprit);
    s.stride = 1;
    for (int k = 0; k < s.blocks; k += wave)
        tss__broad_wave(&s, k, s.blocks - k < wave ? s.blocks - k : wave, culprit);
    return s.t;
}

#if !defined(__clang__) && defined(__GNUC__)
#pragma GCC pop_options
#endif

#include <stdio.h>

#if defined(__clang__)
#pragma clang fp contract(off)
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
#endif

#ifdef __cplusplus
extern "C" {
#endif

// ---------------------------------------------------------------------------------------------
// >>contact_state (private)
// Data flow of a Newton iterate:
//   lists(x)        active pairs at x: filtered from the last sweep's if x lies on it, else found
//   lists(x, d, t)  sweep of the broad phase; pairs that may come nearer than d̂ on it ("kept");
//                   additive CCD over them, and over pairs without a free node that move against
//                   each other ("fixed"); again those kept on the part of the path that is free
//   max_step        the step found there: nothing may be evaluated beyond it
//   after_iterate   active pairs at the new state, their least distance, κ
// A stencil keeps its nodes; which parts are closest is decided at each evaluation, so the energy
// over any list that holds all pairs nearer than d̂ is the same sum.
// Ids: EE, PT, PE, PP in the order of the broad phase, then points against planes.
//
// κ (adaptive). IPC minimises ½‖x − x̃‖² + h²Ψ + κB, we ½‖x − x̃‖² + αh²(Ψ + κB): its rules hold for
// αh²κ.
//   κ_min = 1e11 m̄ / (4e-16 l² b″(1e-16 l²)) / αh², κ_max = 100 κ_min,
//   at the start of a step with contacts κ = −(g_c·g_E)/‖g_c‖² / αh² clamped to [κ_min, κ_max], g_c
//   = ∇B and g_E the gradient of everything else; × 2 when a pair's distance stays below 1e-9 l and
//   shrinks.
// Quasi-static: αh² = 1 and no inertia, so masses say nothing: forces bound κ, and it never falls.
// ---------------------------------------------------------------------------------------------

#define TSS__IPC_COOKIE 0x69706331
// after the broad phase's four kinds
enum { TSS__IPC_PLANE = 4, TSS__IPC_KINDS = 5, TSS__IPC_FIXED = 5 };

// A grow-only array; the content is lost when it grows.
typedef struct tss__ipc_array {
    void *p;
    size_t bytes;
} tss__ipc_array;

typedef struct tss__ipc_touch_key {
    int a, b;
    double force, distance;
} tss__ipc_touch_key;

// A list of stencils by kind.
typedef struct tss__ipc_list {
    tss__broad_pairs pair[4];
    tss__ipc_array plane;  // int pairs: point (a node), plane
    int planes;
    int start[TSS__IPC_KINDS + 1];
} tss__ipc_list;

struct tss_ipc {
    tss_world *world;
    const tss_host *host;
    tss_ipc_def def;
    tss_ipc_plane *plane;
    tss_ipc_body *body;
    tss_ipc_pair *pair;
    int references;  // energies that still point here
    tss_energy barrier, friction;
    int failed;  // out of memory where no error can be returned

    // the scene, refreshed when its topology changes
    uint64_t topology;
    tss_surface surface;
    tss__broad broad;
    tss__ipc_array kinematic, self_off, body_of;
    int bodies;
    tss__broad fixed;  // primitives without a free node; their pairs only limit steps
    tss__ipc_array fixed_node, fixed_body, fixed_off;
    int fixed_pairs;   // some of them may meet
    double dhat, mass, diagonal, eps_v;
    const char *dhat_from;

    // stencils handed out
    tss__ipc_list active, kept;
    tss__ipc_list *current;  // which of the two
    tss__ipc_array node, node_old;
    int count_old;
    uint64_t pattern;
    double t_cover;           // the sweep covers [0, t_cover] of what was asked
    double t_step;            // largest collision-free step on it
    int culprit[4];           // the pair that limits it: kind (−1: none), its two numbers, and the
                              // kind in `fixed` if kind is TSS__IPC_FIXED
    int swept;                // kept is valid on the path of the last sweep
    tss__ipc_array x_active;  // state that active belongs to
    int active_known;
    int candidates, shortened, doubled;

    // per active stencil
    tss__ipc_array distance;  // squared
    double min_distance;

    // κ
    double kappa, kappa_min, kappa_max;
    int thin;                     // iterates in a row with a pair far inside d̂
    tss__ipc_array close_old;
    tss__ipc_array close;  // pairs below 1e-9 l at the last iterate: 5 ints and a distance
    int closes;
    tss__ipc_array work;

    // lagged friction
    int frictions, passes;
    tss__ipc_array f_node, f_data;  // arity ints; 8 doubles: c (4), n (3), μ λ
    tss__ipc_array f_key;           // 3 ints: kind, and the pair as in the lists
    tss__ipc_array x_start;         // x_t of the last step, for queries after it
    uint64_t f_pattern;
    double h, ah2;         // of the last step
    tss__ipc_array touch;  // tss__ipc_touch_key at the start of the step
    int touches;
};

static void *tss__ipc_fit(const tss_host *host, tss__ipc_array *a, size_t bytes) {
    if (bytes <= a->bytes) return a->p ? a->p : a;  // never NULL on success
    size_t room = bytes + bytes / 4 + 64;
    void *p = tss_alloc(host, room);
    if (!p) return NULL;
    tss_free(host, a->p, a->bytes);
    a->p = p, a->bytes = room;
    return p;
}

static void tss__ipc_drop(const tss_host *host, tss__ipc_array *a) {
    tss_free(host, a->p, a->bytes);
    a->p = NULL, a->bytes = 0;
}

static int tss__ipc_arity(int dim) { return dim + 1; }

// ---------------------------------------------------------------------------------------------
// >>contact_scene (private)
// ---------------------------------------------------------------------------------------------

// Shortest edge at rest among the edges with a node that is not of an obstacle; +inf: none.
static double tss__ipc_shortest(const tss_ipc *p, const tss_ctx *c) {
    double best = HUGE_VAL;
    for (int e = 0; e < p->surface.edges; e++) {
        const int *v = p->surface.edge + 2 * e;
        double s = 0;
        if (c->kind[v[0]] == TSS_NODE_OBSTACLE && c->kind[v[1]] == TSS_NODE_OBSTACLE) continue;
        for (int i = 0; i < c->dim; i++) {
            double d = c->X[v[0] * c->dim + i] - c->X[v[1] * c->dim + i];
            s += d * d;
        }
        if (s > 0 && s < best) best = s;
    }
    return sqrt(best);
}

static void tss__ipc_choose_dhat(tss_ipc *p, const tss_ctx *c) {
    p->dhat = p->def.dhat, p->dhat_from = "given";
    if (p->dhat > 0) return;
    p->dhat = p->def.dhat_rel * c->diagonal, p->dhat_from = "diagonal";
    double bound = p->def.dhat_edge > 0 ? p->def.dhat_edge * tss__ipc_shortest(p, c) : HUGE_VAL;
    if (p->dhat > bound) p->dhat = bound, p->dhat_from = "shortest edge";
}

// Mean mass of the nodes that have one.
static double tss__ipc_mean_mass(const tss_ctx *c) {
    double sum = 0;
    int count = 0;
    for (int i = 0; i < c->nodes; i++)
        if (c->mass[i] > 0) sum += c->mass[i], count++;
    return count ? sum / count : 0;
}

static const tss_ipc_body *tss__ipc_body_of(const tss_ipc *p, int body) {
    for (int i = 0; i < p->def.bodies; i++)
        if (p->body[i].body == body) return &p->body[i];
    return NULL;
}

static const tss_ipc_pair *tss__ipc_pair_of(const tss_ipc *p, int a, int b) {
    for (int i = 0; i < p->def.pairs; i++) {
        const tss_ipc_pair *q = &p->pair[i];
        if ((q->a == a && q->b == b) || (q->a == b && q->b == a)) return q;
    }
    return NULL;
}

// Friction of two bodies: the pair's own; else that of the one body that has its own; both have:
// the geometric mean; none: the default.
static double tss__ipc_mu(const tss_ipc *p, int a, int b) {
    const tss_ipc_pair *q = tss__ipc_pair_of(p, a, b);
    if (q && q->mu >= 0) return q->mu;
    const tss_ipc_body *s = tss__ipc_body_of(p, a), *t = tss__ipc_body_of(p, b);
    double mu_a = s && s->mu >= 0 ? s->mu : -1, mu_b = t && t->mu >= 0 ? t->mu : -1;
    if (mu_a >= 0 && mu_b >= 0) return sqrt(mu_a * mu_b);
    return mu_a >= 0 ? mu_a : mu_b >= 0 ? mu_b : p->def.mu;
}

static int tss__ipc_self_off(const tss_ipc *p, int body) {
    const tss_ipc_pair *q = tss__ipc_pair_of(p, body, body);
    const tss_ipc_body *s = tss__ipc_body_of(p, body);
    if (q && q->exclude) return 1;
    return s && s->self_contact >= 0 ? !s->self_contact : !p->def.self_contact;
}

static int tss__ipc_excludes(const tss_ipc *p) {
    for (int i = 0; i < p->def.pairs; i++)
        if (p->pair[i].exclude && p->pair[i].a != p->pair[i].b) return 1;
    return 0;
}

// Are there two primitives that may meet? Not where one body is alone and does not meet itself: the
// broad phase then gets nothing to do.
static int tss__ipc_any_pair(const tss_ipc *p) {
    const int *body = (const int *)p->body_of.p, *point = p->surface.point;
    for (int i = 1; i < p->surface.points; i++)
        if (body[point[i]] != body[point[0]]) return 1;
    return p->surface.points > 0 && !((const uint8_t *)p->self_off.p)[body[point[0]]];
}

// The surface as the broad phase wants it. Its arrays are copies where they must outlive a call.
static tss_result tss__ipc_set_mesh(tss_ipc *p, const tss_ctx *c) {
    tss__broad_mesh m;
    size_t n = (size_t)c->nodes;
    uint8_t *kinematic = (uint8_t *)tss__ipc_fit(p->host, &p->kinematic, n);
    int *body = (int *)tss__ipc_fit(p->host, &p->body_of, n * sizeof(int));
    if (!kinematic || !body) return TSS_ERROR_NO_MEMORY;
    p->bodies = 0;
    for (int i = 0; i < c->nodes; i++) {
        kinematic[i] = c->kind[i] != TSS_NODE_FREE, body[i] = c->body[i];
        if (body[i] >= p->bodies) p->bodies = body[i] + 1;
    }
    uint8_t *self_off = (uint8_t *)tss__ipc_fit(p->host, &p->self_off, (size_t)p->bodies + 1);
    if (!self_off) return TSS_ERROR_NO_MEMORY;
    for (int b = 0; b < p->bodies; b++) self_off[b] = (uint8_t)tss__ipc_self_off(p, b);
    memset(&m, 0, sizeof m);
    m.dim = c->dim, m.nodes = c->nodes;
    if (tss__ipc_any_pair(p)) {
        m.points = p->surface.points, m.point = p->surface.point;
        m.edges = p->surface.edges, m.edge = p->surface.edge;
        m.tris = p->surface.triangles, m.tri = p->surface.triangle;
    }
    m.kinematic = kinematic, m.body = body, m.self_off = self_off;
    return tss__broad_set_mesh(&p->broad, &m);
}

// The primitives of count × arity nodes all of which are kinematic, to `to`; returns their number.
static int tss__ipc_pick_fixed(const tss_ipc *p, const int *node, int count, int arity, int *to) {
    const uint8_t *fixed = (const uint8_t *)p->kinematic.p;
    int kept = 0;
    for (int i = 0; i < count; i++) {
        int all = 1;
        for (int k = 0; k < arity; k++) all = all && fixed[node[i * arity + k]];
        for (int k = 0; all && k < arity; k++) to[kept * arity + k] = node[i * arity + k];
        kept += all;
    }
    return kept;
}

// Bodies of kinematic nodes only become one body that does not meet itself: they pass through each
// other. loose: of them, which have a free node.
static tss_result tss__ipc_fixed_bodies(tss_ipc *p, const tss_ctx *c) {
    const int *body = (const int *)p->body_of.p;
    const uint8_t *kinematic = (const uint8_t *)p->kinematic.p;
    size_t n = (size_t)c->nodes, all = (size_t)p->bodies + 1;
    int *to = (int *)tss__ipc_fit(p->host, &p->fixed_body, n * sizeof(int));
    uint8_t *off = (uint8_t *)tss__ipc_fit(p->host, &p->fixed_off, 2 * all), *loose = off + all;
    if (!to || !off) return TSS_ERROR_NO_MEMORY;
    memset(loose, 0, all);
    p->fixed_pairs = 0;
    for (int i = 0; i < c->nodes; i++) loose[body[i]] |= !kinematic[i];
    for (int i = 0; i < c->nodes; i++) {
        to[i] = loose[body[i]] ? body[i] : p->bodies;
        p->fixed_pairs |= kinematic[i] && loose[body[i]];
    }
    memcpy(off, p->self_off.p, (size_t)p->bodies);
    off[p->bodies] = 1;
    return TSS_OK;
}

// The mesh of `fixed`. Where every kinematic node belongs to a wholly kinematic body there is none.
static tss_result tss__ipc_set_fixed(tss_ipc *p, const tss_ctx *c) {
    const tss_surface *s = &p->surface;
    tss__broad_mesh m;
    tss_result r = tss__ipc_fixed_bodies(p, c);
    if (r != TSS_OK || !p->fixed_pairs) return r;
    size_t most = (size_t)s->points + 2 * (size_t)s->edges + 3 * (size_t)s->triangles;
    int *point = (int *)tss__ipc_fit(p->host, &p->fixed_node, most * sizeof(int));
    if (!point) return TSS_ERROR_NO_MEMORY;
    int *edge = point + s->points, *tri = edge + 2 * (size_t)s->edges;
    memset(&m, 0, sizeof m);
    m.dim = c->dim, m.nodes = c->nodes, m.point = point, m.edge = edge, m.tri = tri;
    m.points = tss__ipc_pick_fixed(p, s->point, s->points, 1, point);
    m.edges = tss__ipc_pick_fixed(p, s->edge, s->edges, 2, edge);
    m.tris = tss__ipc_pick_fixed(p, s->triangle, s->triangles, 3, tri);
    m.body = (const int *)p->fixed_body.p, m.self_off = (const uint8_t *)p->fixed_off.p;
    return tss__broad_set_mesh(&p->fixed, &m);
}

static tss_result tss__ipc_refresh(tss_ipc *p, const tss_ctx *c) {
    if (p->failed) {
        p->failed = 0;
        return TSS_ERROR_NO_MEMORY;
    }
    if (p->topology == c->topology && p->dhat > 0) return TSS_OK;
    p->active_known = p->swept = 0, p->closes = 0, p->h = 0;  // queries wait for a step
    tss_result r = tss_world_surface(p->world, &p->surface);
    if (r == TSS_OK) r = tss__ipc_set_mesh(p, c);
    if (r == TSS_OK) r = tss__ipc_set_fixed(p, c);
    if (r != TSS_OK) return r;
    tss__ipc_choose_dhat(p, c);
    p->mass = tss__ipc_mean_mass(c), p->diagonal = c->diagonal;
    p->eps_v = p->def.eps_v > 0 ? p->def.eps_v : 1e-3 * c->diagonal;
    p->topology = c->topology;
    return p->dhat > 0 ? TSS_OK : TSS_ERROR_EMPTY;
}

// ---------------------------------------------------------------------------------------------
// >>contact_lists (private)
// ---------------------------------------------------------------------------------------------

static double tss__ipc_plane_distance(const tss_ipc_plane *q, int dim, const double *x) {
    double s = 0;
    for (int i = 0; i < dim; i++) s += q->normal[i] * (x[i] - q->origin[i]);
    return s;
}

// Points that come nearer than d̂ to a plane on x + t·d (d NULL: at x). The distance is linear in t.
static tss_result tss__ipc_list_planes(tss_ipc *p, const tss_ctx *c, const double *x,
                                       const double *d, double t, tss__ipc_list *out) {
    const uint8_t *kinematic = (const uint8_t *)p->kinematic.p;
    size_t most = (size_t)p->def.planes * (size_t)p->surface.points;
    out->planes = 0;
    if (!most) return TSS_OK;
    int *to = (int *)tss__ipc_fit(p->host, &out->plane, most * 2 * sizeof(int));
    if (!to) return TSS_ERROR_NO_MEMORY;
    for (int k = 0; k < p->def.planes; k++)
        for (int i = 0; i < p->surface.points; i++) {
            int node = p->surface.point[i];
            double end[3] = {0, 0, 0};
            if (kinematic[node]) continue;
            const double *at = x + (size_t)node * (size_t)c->dim;
            for (int a = 0; d && a < c->dim; a++)
                end[a] = at[a] + t * d[(size_t)node * (size_t)c->dim + (size_t)a];
            double s = tss__ipc_plane_distance(&p->plane[k], c->dim, at);
            double e = d ? tss__ipc_plane_distance(&p->plane[k], c->dim, end) : s;
            if (s < p->dhat || e < p->dhat) {
                to[2 * out->planes] = node, to[2 * out->planes + 1] = k;
                out->planes++;
            }
        }
    return TSS_OK;
}

// Removes pairs of bodies that pass through each other.
static int tss__ipc_excluded(const tss_ipc *p, int kind, const int v[4]) {
    const int *body = (const int *)p->body_of.p;
    const tss_ipc_pair *q = tss__ipc_pair_of(p, body[v[0]], body[v[kind == TSS__BROAD_EE ? 2 : 1]]);
    return q && q->exclude;
}

static void tss__ipc_exclude(tss_ipc *p, int kind, tss__broad_pairs *list) {
    int kept = 0;
    for (int i = 0; i < list->count; i++) {
        int v[4];
        tss__broad_nodes(&p->broad.mesh, kind, list->pair[i], v);
        if (!tss__ipc_excluded(p, kind, v)) list->pair[kept++] = list->pair[i];
    }
    list->count = kept;
}

// Node list of a list and its stamp: a new one only when the nodes differ from those before.
static tss_result tss__ipc_hand_out(tss_ipc *p, const tss_ctx *c, tss__ipc_list *l,
                                    tss_stencils *out) {
    int arity = tss__ipc_arity(c->dim), count = 0, at = 0;
    for (int k = 0; k < TSS__IPC_KINDS; k++) {
        l->start[k] = count;
        count += k < TSS__IPC_PLANE ? l->pair[k].count : l->planes;
    }
    l->start[TSS__IPC_KINDS] = count;
    size_t bytes = (size_t)count * (size_t)arity * sizeof(int);
    tss__ipc_array spare = p->node_old;
    p->node_old = p->node, p->node = spare;
    int *node = (int *)tss__ipc_fit(p->host, &p->node, bytes);
    if (!node) {  // what was handed out last stays what the next is compared with
        spare = p->node, p->node = p->node_old, p->node_old = spare;
        return TSS_ERROR_NO_MEMORY;
    }
    for (int k = 0; k < TSS__IPC_PLANE; k++)
        for (int i = 0; i < l->pair[k].count; i++, at += arity) {
            int v[4];
            tss__broad_nodes(&p->broad.mesh, k, l->pair[k].pair[i], v);
            memcpy(node + at, v, (size_t)arity * sizeof(int));
        }
    for (int i = 0; i < l->planes; i++, at += arity) {
        for (int a = 1; a < arity; a++) node[at + a] = -1;
        node[at] = ((const int *)l->plane.p)[2 * i];
    }
    if (count != p->count_old || (bytes && memcmp(node, p->node_old.p, bytes) != 0) || !p->pattern)
        p->pattern++;
    p->count_old = count, p->current = l;
    out->count = count, out->node = node, out->pattern = p->pattern;
    return TSS_OK;
}

// Broad phase over x + t·d, boxes grown. More pairs than allowed: the sweep is halved until they
// fit; a sweep of a millionth (or a single state) takes what it needs.
static tss_result tss__ipc_cover(tss_ipc *p, tss__broad *b, const double *x, const double *d,
                                 double grow, double *t) {
    int over = 1, cut = 0;
    tss_result r = TSS_OK;
    for (int k = 0; over && r == TSS_OK; k++) {
        int free_run = !d || k >= 20;
        r = tss__broad_search(b, x, d, *t, grow, free_run ? INT_MAX : p->def.max_candidates, &over);
        if (over && !free_run) *t *= 0.5, cut = 1;
        if (over && free_run) return TSS_ERROR_NO_MEMORY;
    }
    p->shortened += cut;
    return r;
}

static tss_result tss__ipc_search(tss_ipc *p, const double *x, const double *d, double *t) {
    tss_result r = tss__ipc_cover(p, &p->broad, x, d, 0.5 * p->dhat, t);
    p->candidates = 0;
    for (int k = 0; k < 4; k++) p->candidates += p->broad.list[k].count;
    return r;
}

// Room for rounding where the filters of the broad phase decide: the evaluation decides exactly.
#define TSS__IPC_REACH(p) ((p)->dhat * (1 + 1e-6))

// Numbers of entry i of kind k: what the broad phase calls it, or plane and point.
static void tss__ipc_entry(const tss__ipc_list *l, int k, int i, int key[3]) {
    const int *q = (const int *)l->plane.p + 2 * (k == TSS__IPC_PLANE ? i : 0);
    key[0] = k;
    key[1] = k == TSS__IPC_PLANE ? q[1] : l->pair[k].pair[i].a;
    key[2] = k == TSS__IPC_PLANE ? q[0] : l->pair[k].pair[i].b;
}

// More than two primitives can lose of their distance when x + t·d is rounded to be stored: half a
// unit in the last place of the product and of the sum, in three coordinates of both.
static double tss__ipc_rounding(const tss_ctx *c, const double *x, const double *d, double t) {
    double most = 0;
    for (int i = 0; i < c->nodes * c->dim; i++) {
        double s = fabs(x[i]) + t * fabs(d[i]);
        most = s > most ? s : most;
    }
    return 8 * DBL_EPSILON * most;
}

// The largest step up to t that leaves every kept pair its slack and every point its side.
static double tss__ipc_limit(tss_ipc *p, const tss_ctx *c, const double *x, const double *d,
                             double t) {
    const tss__ipc_list *l = &p->kept;
    double least = tss__ipc_rounding(c, x, d, t);
    p->culprit[0] = -1;
    for (int k = 0; k < 4; k++) {
        int who = -1;
        double s = tss__broad_step(&p->broad, k, &l->pair[k], x, d, p->def.slack, least, t, &who);
        if (s < t && who >= 0) tss__ipc_entry(l, k, who, p->culprit);
        t = s < t ? s : t;
    }
    for (int i = 0; i < l->planes; i++) {
        const int *v = (const int *)l->plane.p + 2 * i;
        const tss_ipc_plane *q = &p->plane[v[1]];
        size_t at = (size_t)v[0] * (size_t)c->dim;
        double s = tss__ccd_plane(c->dim, x + at, d + at, q->origin, q->normal, p->def.slack, least,
                                  t);
        if (s < t) t = s, tss__ipc_entry(l, TSS__IPC_PLANE, i, p->culprit);
    }
    return t;
}

// Do the two parts of a kinematic pair move against each other? Rounding of common motion does not
// count. Pairs that lay nearer than `least` at the start of the step are glued: left alone.
static int tss__ipc_parts(const tss_ipc *p, const tss_ctx *c, int kind, const int v[4],
                          const double *x, const double *d, double least) {
    double y[12], size = 0, apart = 0;
    for (int i = 0; i < tss_ipc_pair_nodes((tss_ipc_kind)kind); i++)
        for (int a = 0; a < c->dim; a++) {
            double s = d[v[i] * c->dim + a], o = d[v[0] * c->dim + a];
            double at = fabs(x[v[i] * c->dim + a]);
            y[i * c->dim + a] = c->x_t[v[i] * c->dim + a];
            apart = fabs(s - o) > apart ? fabs(s - o) : apart;
            size = at + fabs(s) > size ? at + fabs(s) : size;
        }
    if (!(apart > 8 * DBL_EPSILON * size) || tss__ipc_excluded(p, kind, v)) return 0;
    return tss_ipc_distance((tss_ipc_kind)kind, c->dim, y, NULL) >= least * least;
}

// Steps are also limited by pairs without a free node, unless both bodies are wholly kinematic: what
// hangs on a pinned node would be run through with it. They have no energy, so they stop where
// d̂/1000 is left, and are glued if half of that was missing at the start of the step.
static tss_result tss__ipc_limit_fixed(tss_ipc *p, const tss_ctx *c, const double *x,
                                       const double *d) {
    const uint8_t *kinematic = (const uint8_t *)p->kinematic.p;
    double fastest = 0;
    for (int i = 0; p->fixed_pairs && i < c->nodes * c->dim; i++)
        if (kinematic[i / c->dim] && fabs(d[i]) > fastest) fastest = fabs(d[i]);
    if (!(fastest > 0) || !(p->t_step > 0)) return TSS_OK;
    double round = tss__ipc_rounding(c, x, d, p->t_step), least = 1e-3 * p->dhat;
    least = least > 4 * round ? least : 4 * round;
    tss_result r = tss__ipc_cover(p, &p->fixed, x, d, 0.5 * least, &p->t_step);
    // Free points meet surfaces only: a body with free nodes has no other primitives.
    for (int k = 0; k < TSS__BROAD_PP && r == TSS_OK; k++) {
        tss__broad_pairs *l = &p->fixed.list[k];
        int kept = 0, who = -1;
        for (int i = 0; i < l->count; i++) {
            int v[4];
            tss__broad_nodes(&p->fixed.mesh, k, l->pair[i], v);
            if ((k != TSS__BROAD_PE || c->dim == 2) &&
                tss__ipc_parts(p, c, k, v, x, d, 0.5 * least))
                l->pair[kept++] = l->pair[i];
        }
        l->count = kept;
        double s = tss__broad_step(&p->fixed, k, l, x, d, 0, least, p->t_step, &who);
        if (!(s < p->t_step)) continue;
        if (s * fastest < 0.01 * least) s = 0;  // as near as it gets: no creeping up
        p->t_step = s, p->culprit[0] = TSS__IPC_FIXED, p->culprit[3] = k;
        p->culprit[1] = l->pair[who].a, p->culprit[2] = l->pair[who].b;
    }
    return r;
}

// kept = the pairs of in that may come nearer than d̂ on x + s·d, s ∈ [0, t].
static tss_result tss__ipc_keep(tss_ipc *p, const tss_ctx *c, const double *x, const double *d,
                                double t, int again) {
    tss_result r = TSS_OK;
    for (int k = 0; k < 4 && r == TSS_OK; k++) {
        tss__broad_pairs *in = again ? &p->kept.pair[k] : &p->broad.list[k];
        r = tss__broad_reach(&p->broad, k, in, x, d, t, TSS__IPC_REACH(p), 0, &p->kept.pair[k]);
        if (r == TSS_OK && !again && tss__ipc_excludes(p)) tss__ipc_exclude(p, k, &p->kept.pair[k]);
    }
    return r == TSS_OK ? tss__ipc_list_planes(p, c, x, d, t, &p->kept) : r;
}

// The sweep, the step it allows, and the stencils on the part of the path that can be taken: a step
// cut short needs far fewer of them.
static tss_result tss__ipc_sweep(tss_ipc *p, const tss_ctx *c, const double *x, const double *d,
                                 double t_max) {
    p->t_cover = t_max, p->swept = 0;
    tss_result r = tss__ipc_search(p, x, d, &p->t_cover);
    if (r == TSS_OK) r = tss__ipc_keep(p, c, x, d, p->t_cover, 0);
    if (r != TSS_OK) return r;
    p->t_step = tss__ipc_limit(p, c, x, d, p->t_cover);
    r = tss__ipc_limit_fixed(p, c, x, d);
    if (r == TSS_OK && p->t_step < 0.5 * p->t_cover) r = tss__ipc_keep(p, c, x, d, p->t_step, 1);
    p->swept = r == TSS_OK;
    return r;
}

// Squared distance of stencil id of list l at x (a plane's as it is: not squared there).
static double tss__ipc_stencil_distance(const tss_ipc *p, const tss_ctx *c, const tss__ipc_list *l,
                                        int k, int i, const double *x) {
    double y[12];
    int v[4];
    if (k == TSS__IPC_PLANE) {
        const int *q = (const int *)l->plane.p + 2 * i;
        return tss__ipc_plane_distance(&p->plane[q[1]], c->dim, x + (size_t)q[0] * (size_t)c->dim);
    }
    tss__broad_nodes(&p->broad.mesh, k, l->pair[k].pair[i], v);
    for (int a = 0; a < tss_ipc_pair_nodes((tss_ipc_kind)k); a++)
        memcpy(y + a * c->dim, x + (size_t)v[a] * (size_t)c->dim, (size_t)c->dim * sizeof *y);
    return tss_ipc_distance((tss_ipc_kind)k, c->dim, y, NULL);
}

typedef struct tss__ipc_near_task_arg {
    const tss_ipc *p;
    const tss_ctx *c;
    const double *x;
    double *out;
    int count;
} tss__ipc_near_task_arg;

enum { TSS__IPC_BLOCK = 1024 };

static void tss__ipc_near_task(int block, int worker, void *arg) {
    tss__ipc_near_task_arg *t = (tss__ipc_near_task_arg *)arg;
    const tss__ipc_list *l = &t->p->active;
    int end = (block + 1) * TSS__IPC_BLOCK < t->count ? (block + 1) * TSS__IPC_BLOCK : t->count,
        k = 0;
    (void)worker;
    for (int i = block * TSS__IPC_BLOCK; i < end; i++) {
        while (i >= l->start[k + 1]) k++;
        double d = tss__ipc_stencil_distance(t->p, t->c, l, k, i - l->start[k], t->x);
        t->out[i] = k == TSS__IPC_PLANE ? (d > 0 ? d * d : 0) : d;
    }
}

// Distances of all active stencils at x (after their ranges are known) and the least of them.
static tss_result tss__ipc_measure(tss_ipc *p, const tss_ctx *c, const double *x) {
    tss__ipc_list *l = &p->active;
    int count = 0;
    for (int k = 0; k < TSS__IPC_KINDS; k++) {
        l->start[k] = count;
        count += k < TSS__IPC_PLANE ? l->pair[k].count : l->planes;
    }
    l->start[TSS__IPC_KINDS] = count;
    double *d = (double *)tss__ipc_fit(p->host, &p->distance, (size_t)count * sizeof(double)),
           least = HUGE_VAL;
    if (!d) return TSS_ERROR_NO_MEMORY;
    tss__ipc_near_task_arg t = {p, c, x, d, count};
    tss_parallel(p->host, (count + TSS__IPC_BLOCK - 1) / TSS__IPC_BLOCK, tss__ipc_near_task, &t);
    for (int i = 0; i < count; i++) least = d[i] < least ? d[i] : least;
    p->min_distance = sqrt(least);
    return TSS_OK;
}

// active = pairs nearer than d̂ at x. on_path: x lies on the last sweep.
static tss_result tss__ipc_find_active(tss_ipc *p, const tss_ctx *c, const double *x, int on_path) {
    size_t bytes = (size_t)(c->nodes * c->dim) * sizeof(double);
    if (p->active_known && memcmp(p->x_active.p, x, bytes) == 0) return TSS_OK;
    p->active_known = 0;
    double t = 0;
    tss_result r = on_path && p->swept ? TSS_OK : tss__ipc_search(p, x, NULL, &t);
    if (!(on_path && p->swept)) p->swept = 0;
    for (int k = 0; k < 4 && r == TSS_OK; k++) {
        r = tss__broad_near(&p->broad, k,
                            on_path && p->swept ? &p->kept.pair[k] : &p->broad.list[k], x,
                            TSS__IPC_REACH(p), &p->active.pair[k]);
        if (r == TSS_OK && tss__ipc_excludes(p)) tss__ipc_exclude(p, k, &p->active.pair[k]);
    }
    if (r == TSS_OK) r = tss__ipc_list_planes(p, c, x, NULL, 0, &p->active);
    if (r == TSS_OK) r = tss__ipc_measure(p, c, x);
    if (r != TSS_OK) return r;
    if (!tss__ipc_fit(p->host, &p->x_active, bytes)) return TSS_ERROR_NO_MEMORY;
    memcpy(p->x_active.p, x, bytes);
    p->active_known = 1;
    return TSS_OK;
}

static tss_result tss__ipc_lists(void *user, const tss_ctx *c, const double *x, const double *d,
                                 double t_max, tss_stencils *out) {
    tss_ipc *p = (tss_ipc *)user;
    tss_result r = tss__ipc_refresh(p, c);
    if (r != TSS_OK) return r;
    if (d) {
        r = tss__ipc_sweep(p, c, x, d, t_max);
        return r == TSS_OK ? tss__ipc_hand_out(p, c, &p->kept, out) : r;
    }
    r = tss__ipc_find_active(p, c, x, 0);
    return r == TSS_OK ? tss__ipc_hand_out(p, c, &p->active, out) : r;
}

// ---------------------------------------------------------------------------------------------
// >>contact_barrier (private)
// ---------------------------------------------------------------------------------------------

static int tss__ipc_kind_of(const tss__ipc_list *l, int id) {
    int k = 0;
    while (id >= l->start[k + 1]) k++;
    return k;
}

enum { TSS__IPC_VALUE, TSS__IPC_GRADIENT, TSS__IPC_HESSIAN };

// Numbers a stencil gives.
static size_t tss__ipc_width(const tss_ctx *c, int what) {
    size_t ad = (size_t)(tss__ipc_arity(c->dim) * c->dim);
    return what == TSS__IPC_VALUE ? 1 : what == TSS__IPC_GRADIENT ? ad : ad * ad;
}

// b((n·(x − o))²): gradient 2 s b′ n, Hessian (2 b′ + 4 s² b″) n nᵀ, never negative.
static void tss__ipc_plane_stencil(const tss_ipc *p, const tss_ctx *c, const double *x,
                                   const tss__ipc_list *l, int i, int what, double scale,
                                   double *out) {
    const int *v = (const int *)l->plane.p + 2 * i;
    const tss_ipc_plane *q = &p->plane[v[1]];
    int dim = c->dim, ad = tss__ipc_arity(dim) * dim;
    double s = tss__ipc_plane_distance(q, dim, x + (size_t)v[0] * (size_t)dim);
    tss__barrier b = tss__barrier_of(s > 0 ? s * s : 0, p->dhat * p->dhat);
    memset(out, 0, tss__ipc_width(c, what) * sizeof *out);
    if (what == TSS__IPC_VALUE) out[0] = scale * b.b;
    if (what == TSS__IPC_GRADIENT)
        for (int a = 0; a < dim; a++) out[a] = scale * 2 * s * b.b1 * q->normal[a];
    if (what == TSS__IPC_HESSIAN)
        for (int a = 0; a < dim; a++)
            for (int e = 0; e < dim; e++)
                out[a * ad + e] =
                    scale * (2 * b.b1 + 4 * s * s * b.b2) * q->normal[a] * q->normal[e];
}

// A batch, cut into runs of up to eight stencils of one kind.
static void tss__ipc_batch(const tss_ipc *p, const tss_ctx *c, const double *x, tss_ids ids,
                           int what, int psd, double scale, double *out) {
    const tss__ipc_list *l = p->current;
    size_t width = tss__ipc_width(c, what);
    tss__eight e;
    memset(&e, 0, sizeof e);
    e.dim = c->dim, e.arity = tss__ipc_arity(c->dim), e.x = x, e.X = c->X,
    e.dhat = p->dhat * p->dhat;
    for (int i = 0; i < ids.count; i += e.count) {
        int first = ids.list ? ids.list[i] : ids.first + i, kind = tss__ipc_kind_of(l, first);
        if (kind == TSS__IPC_PLANE) {
            tss__ipc_plane_stencil(p, c, x, l, first - l->start[kind], what, scale,
                                   out + (size_t)i * width);
            e.count = 1;
            continue;
        }
        e.kind = (tss_ipc_kind)kind;
        for (e.count = 0; e.count < TSS__LANES && i + e.count < ids.count; e.count++) {
            int id = ids.list ? ids.list[i + e.count] : ids.first + i + e.count;
            if (id < l->start[kind] || id >= l->start[kind + 1]) break;
            e.node[e.count] = (const int *)p->node.p + (size_t)id * (size_t)e.arity;
            e.scale[e.count] = scale, e.out[e.count] = out + (size_t)(i + e.count) * width;
        }
        if (what == TSS__IPC_VALUE)
            tss__eight_value(&e, NULL);
        else if (what == TSS__IPC_GRADIENT)
            tss__eight_gradient(&e);
        else
            tss__eight_hessian(&e, psd);
    }
}

static void tss__ipc_value(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                           double *out) {
    const tss_ipc *p = (const tss_ipc *)user;
    tss__ipc_batch(p, c, x, ids, TSS__IPC_VALUE, 0, p->kappa, out);
}
static void tss__ipc_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                              double *out) {
    const tss_ipc *p = (const tss_ipc *)user;
    tss__ipc_batch(p, c, x, ids, TSS__IPC_GRADIENT, 0, p->kappa, out);
}
static void tss__ipc_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids, int psd,
                             double *out) {
    const tss_ipc *p = (const tss_ipc *)user;
    tss__ipc_batch(p, c, x, ids, TSS__IPC_HESSIAN, psd, p->kappa, out);
}

// Found with the list. The culprit's place in it: lists ascend, and few steps are cut by planes.
static double tss__ipc_max_step(void *user, const tss_ctx *c, const double *x, const double *d,
                                double t_max, int *culprit) {
    tss_ipc *p = (tss_ipc *)user;
    const tss__ipc_list *l = &p->kept;
    (void)c, (void)x, (void)d;
    *culprit = -1;
    if (!p->swept) return 0;
    if (t_max <= p->t_step) return t_max;
    if (p->culprit[0] == TSS__IPC_FIXED) {
        *culprit = l->start[TSS__IPC_KINDS];  // one past the list
        return p->t_step;
    }
    for (int k = p->culprit[0], i = k < 0 ? 0 : l->start[k]; k >= 0 && i < l->start[k + 1]; i++) {
        int key[3];
        tss__ipc_entry(l, k, i - l->start[k], key);
        if (key[1] != p->culprit[1] || key[2] != p->culprit[2]) continue;
        *culprit = i;
        break;
    }
    return p->t_step;
}

// ---------------------------------------------------------------------------------------------
// >>contact_stiffness (private)
// ---------------------------------------------------------------------------------------------

// Squared distance at which IPC's rule sees the barrier: 1e-8 l, but well inside a very small d̂.
static double tss__ipc_small(const tss_ipc *p, const tss_ctx *c) {
    double by_size = 1e-16 * c->diagonal * c->diagonal, by_reach = 1e-2 * p->dhat * p->dhat;
    return by_size < by_reach ? by_size : by_reach;
}

// Barrier force for κ = 1 at a distance.
static double tss__ipc_force_at(const tss_ipc *p, double distance) {
    tss__barrier b = tss__barrier_of(distance * distance, p->dhat * p->dhat);
    return 2 * distance * fabs(b.b1);
}

// Quasi-static: masses do not bound κ, but no force needs more than a thousand times the κ that
// holds the largest load or elastic force on a node at d̂/10.
static double tss__ipc_quasistatic_max(const tss_ipc *p, const tss_ctx *c) {
    double most = 100 * p->kappa_min, f = 0;
    for (int i = 0; c->g && i < c->nodes * c->dim; i++)
        if (c->kind[i / c->dim] == TSS_NODE_FREE) f = fabs(c->g[i]) > f ? fabs(c->g[i]) : f;
    double by_force = 1000 * f / tss__ipc_force_at(p, 0.1 * p->dhat) / c->ah2;
    most = by_force > most ? by_force : most;
    return p->kappa > most ? p->kappa : most;
}

static void tss__ipc_kappa_bounds(tss_ipc *p, const tss_ctx *c) {
    double small = tss__ipc_small(p, c);
    tss__barrier b = tss__barrier_of(small, p->dhat * p->dhat);
    p->kappa_min = 1e11 * p->mass / (4 * small * b.b2) / c->ah2;
    p->kappa_max = c->quasistatic ? tss__ipc_quasistatic_max(p, c) : 100 * p->kappa_min;
}

// ∇B (κ = 1) of the active pairs at x into g, n × dim; in list order: the same bits always.
static void tss__ipc_sum_gradient(const tss_ipc *p, const tss_ctx *c, const double *x, double scale,
                                  double *g) {
    int arity = tss__ipc_arity(c->dim), dim = c->dim, count = p->current->start[TSS__IPC_KINDS];
    const int *node = (const int *)p->node.p;
    for (int first = 0; first < count; first += TSS_BATCH) {
        double out[TSS_BATCH * 12];
        tss_ids ids = {first, count - first < TSS_BATCH ? count - first : TSS_BATCH, NULL};
        tss__ipc_batch(p, c, x, ids, TSS__IPC_GRADIENT, 0, scale, out);
        for (int i = 0; i < ids.count * arity; i++) {
            int v = node[first * arity + i];
            for (int a = 0; v >= 0 && a < dim; a++) g[v * dim + a] += out[i * dim + a];
        }
    }
}

// κ at the start of a step, from the forces that contact must balance.
static tss_result tss__ipc_start_kappa(tss_ipc *p, const tss_ctx *c) {
    if (p->def.kappa > 0) {
        p->kappa = p->kappa_min = p->kappa_max = p->def.kappa;
        return TSS_OK;
    }
    tss__ipc_kappa_bounds(p, c);
    double before = p->kappa, cc = 0, ce = 0;
    p->kappa = p->kappa > p->kappa_min ? p->kappa : p->kappa_min;
    if (!c->quasistatic && p->kappa > p->kappa_max) p->kappa = p->kappa_max;
    if (!p->active.start[TSS__IPC_KINDS] || !c->g) {
        if (!(p->kappa > 0)) p->kappa = 1;
        return TSS_OK;
    }
    size_t n = (size_t)(c->nodes * c->dim);
    double *g = (double *)tss__ipc_fit(p->host, &p->work, n * sizeof *g);
    if (!g) return TSS_ERROR_NO_MEMORY;
    memset(g, 0, n * sizeof *g);
    tss__ipc_sum_gradient(p, c, c->x_t, 1, g);
    for (int i = 0; i < c->nodes; i++)
        for (int a = i * c->dim; c->kind[i] == TSS_NODE_FREE && a < (i + 1) * c->dim; a++)
            cc += g[a] * g[a], ce -= g[a] * c->g[a];
    double k = cc > 0 ? ce / cc / c->ah2 : 0;
    if (!(k > p->kappa_min)) k = p->kappa_min;
    // A κ that changes from step to step changes forces at unchanged distances: resting bodies would be
    // shaken (5 cm/s for a half-metre block) and slide at the limit of friction. So it stays unless
    // it is four times too soft; sixteen times too hard, it fades while nothing is near.
    int near_limit = p->min_distance < 0.2 * p->dhat;
    if (before > 0 && k <= 4 * before) k = before <= 16 * k || near_limit ? before : 0.5 * before;
    if (k > p->kappa_max) k = p->kappa_max;
    if (c->quasistatic && before > k) k = before;
    p->kappa = k > 0 ? k : 1;
    return TSS_OK;
}

// A pair below the distance at which κ is doubled.
typedef struct tss__ipc_close {
    int node[4];
    int kind;
    double d;
} tss__ipc_close;

static int tss__ipc_close_order(const tss__ipc_close *a, const tss__ipc_close *b) {
    if (a->kind != b->kind) return a->kind < b->kind ? -1 : 1;
    for (int i = 0; i < 4; i++)
        if (a->node[i] != b->node[i]) return a->node[i] < b->node[i] ? -1 : 1;
    return 0;
}

static void tss__ipc_stencil_nodes(const tss_ipc *p, const tss__ipc_list *l, int id, int v[4],
                                   int *kind) {
    *kind = tss__ipc_kind_of(l, id);
    if (*kind < TSS__IPC_PLANE) {
        tss__broad_nodes(&p->broad.mesh, *kind, l->pair[*kind].pair[id - l->start[*kind]], v);
        return;
    }
    const int *q = (const int *)l->plane.p + 2 * (id - l->start[TSS__IPC_PLANE]);
    v[0] = q[0], v[1] = q[1], v[2] = v[3] = -1;  // node and plane
}

// Was a pair that is close now close before, and farther? Both lists have few entries.
static int tss__ipc_shrinks(const tss__ipc_close *old, int olds, const tss__ipc_close *now) {
    for (int i = 0; i < olds; i++)
        if (tss__ipc_close_order(&old[i], now) == 0) return now->d < old[i].d;
    return 0;
}

static int tss__ipc_double_kappa(tss_ipc *p, const tss_ctx *c) {
    const double *d = (const double *)p->distance.p;
    double limit = 1e-2 * tss__ipc_small(p, c);
    int count = p->active.start[TSS__IPC_KINDS], closes = 0, shrinks = 0;
    if (p->def.kappa > 0 || !(p->min_distance * p->min_distance < limit)) {
        p->closes = 0;
        return 0;
    }
    for (int i = 0; i < count; i++) closes += d[i] < limit;
    tss__ipc_array old = p->close;
    p->close = p->close_old, p->close_old = old;
    tss__ipc_close *now =
        (tss__ipc_close *)tss__ipc_fit(p->host, &p->close, (size_t)closes * sizeof *now);
    if (!now) p->failed = 1;
    for (int i = 0, k = 0; now && i < count; i++)
        if (d[i] < limit) {
            now[k].d = d[i];
            tss__ipc_stencil_nodes(p, &p->active, i, now[k].node, &now[k].kind);
            shrinks |= tss__ipc_shrinks((const tss__ipc_close *)old.p, p->closes, &now[k++]);
        }
    p->closes = now ? closes : 0;
    if (!shrinks || !(p->kappa < p->kappa_max)) return 0;
    p->kappa = 2 * p->kappa < p->kappa_max ? 2 * p->kappa : p->kappa_max;
    p->doubled++;
    return 1;
}

// Closest points of an active stencil at x: coefficients, normal, force λ per κ.
typedef struct tss__ipc_touching {
    int node[4], kind, plane, a, b;
    double c[4], n[3], distance, force;
} tss__ipc_touching;

static double tss__ipc_mollifier_at(const tss_ctx *c, int kind, const int *v, const double *y) {
    double X[12];
    if (kind != TSS_IPC_EDGE_EDGE) return 1;
    for (int i = 0; i < 4; i++) memcpy(X + 3 * i, c->X + 3 * (size_t)v[i], 3 * sizeof *X);
    return tss_ipc_mollifier(y, tss_ipc_mollifier_eps(X), NULL, NULL);
}

static void tss__ipc_touching_of(const tss_ipc *p, const tss_ctx *c, const double *x, int id,
                                 tss__ipc_touching *o) {
    const tss__ipc_list *l = &p->active;
    const int *body = (const int *)p->body_of.p;
    double y[12], d, b1, m = 1;
    memset(o, 0, sizeof *o);
    tss__ipc_stencil_nodes(p, l, id, o->node, &o->kind);
    o->a = body[o->node[0]];
    if (o->kind == TSS__IPC_PLANE) {
        o->plane = o->node[1], o->node[1] = -1, o->b = -1, o->c[0] = 1;
        o->distance = tss__ipc_plane_distance(&p->plane[o->plane], c->dim,
                                              x + (size_t)o->node[0] * (size_t)c->dim);
        memcpy(o->n, p->plane[o->plane].normal, sizeof o->n);
        d = o->distance * o->distance;
    } else {
        o->plane = -1, o->b = body[o->node[o->kind == TSS_IPC_EDGE_EDGE ? 2 : 1]];
        int count = tss_ipc_pair_nodes((tss_ipc_kind)o->kind);
        for (int i = 0; i < count; i++)
            memcpy(y + i * c->dim, x + (size_t)o->node[i] * (size_t)c->dim,
                   (size_t)c->dim * sizeof *y);
        d = tss_ipc_distance((tss_ipc_kind)o->kind, c->dim, y, o->c);
        o->distance = sqrt(d);
        for (int i = 0; i < count; i++)
            for (int a = 0; a < c->dim; a++)
                o->n[a] += o->distance > 0 ? o->c[i] * y[i * c->dim + a] / o->distance : 0;
        m = tss__ipc_mollifier_at(c, o->kind, o->node, y);
    }
    tss_ipc_barrier(d, p->dhat * p->dhat, &b1, NULL);
    o->force = -2 * o->distance * m * b1;
}

// Pairs that stay far inside d̂ make Newton's method slow: the distance then changes by its own
// size over a step that is tiny for everything else, and one tip can hold a whole body to steps of
// 1 %. Three iterates in a row with a pair nearer than d̂/20 raise κ until the present force would be
// held at d̂/10 (at most eightfold at once, never beyond κ_max). Tried on the mat that falls on
// knives: 114 iterates a step without, 14 with. Doubling at 1e-9 l, IPC's own rule, comes too late.
#define TSS__IPC_THIN 0.05

// Least distance, below the limit, of the active pairs whose closest points move with a free node.
// A pinned tip by a wall stays where it is whatever κ is.
static double tss__ipc_least_free(const tss_ipc *p, const tss_ctx *c, const double *x,
                                  double limit) {
    const double *d = (const double *)p->distance.p;
    double least = limit * limit;
    for (int i = 0; i < p->active.start[TSS__IPC_KINDS]; i++) {
        tss__ipc_touching t;
        double moves = 0;
        if (!(d[i] < least)) continue;
        tss__ipc_touching_of(p, c, x, i, &t);
        for (int k = 0; k < 4; k++)
            if (t.node[k] >= 0 && c->kind[t.node[k]] == TSS_NODE_FREE) moves += fabs(t.c[k]);
        if (moves > 0.01) least = d[i];
    }
    return sqrt(least);
}

static int tss__ipc_stiffen(tss_ipc *p, const tss_ctx *c, const double *x) {
    double limit = TSS__IPC_THIN * p->dhat;
    double least = p->min_distance < limit ? tss__ipc_least_free(p, c, x, limit) : limit;
    p->thin = least >= limit ? 0 : p->thin < 3 ? p->thin + 1 : 3;
    if (p->def.kappa > 0 || p->thin < 3 || !(p->kappa < p->kappa_max)) return 0;
    double ratio = tss__ipc_force_at(p, least) / tss__ipc_force_at(p, 0.1 * p->dhat);
    ratio = ratio < 2 ? 2 : ratio > 8 ? 8 : ratio;
    p->kappa = ratio * p->kappa < p->kappa_max ? ratio * p->kappa : p->kappa_max;
    p->thin = 0, p->doubled++;
    return 1;
}

static int tss__ipc_after_iterate(void *user, const tss_ctx *c, const double *x0,
                                  const double *x1) {
    tss_ipc *p = (tss_ipc *)user;
    (void)x0;
    if (tss__ipc_find_active(p, c, x1, 1) != TSS_OK) {
        p->failed = 1, p->active_known = 0;
        return 0;
    }
    int doubled = tss__ipc_double_kappa(p, c);
    return tss__ipc_stiffen(p, c, x1) || doubled;
}

// ---------------------------------------------------------------------------------------------
// >>contact_friction (private)
// D = Σ μ λ f0(‖u‖), u = (I − n nᵀ) Σ c_i (x_i − x_t,i); λ = κ m |∂b/∂distance|, n and c frozen.
// u is the displacement since the start of the step for every integrator, its threshold ε_v h.
// Hessian: c cᵀ ⊗ [f2 û ûᵀ + f1/‖u‖ (n × û)(n × û)ᵀ]: positive semi-definite as it stands.
// ---------------------------------------------------------------------------------------------

static double tss__ipc_mu_of(const tss_ipc *p, const tss__ipc_touching *t) {
    if (t->kind != TSS__IPC_PLANE) return tss__ipc_mu(p, t->a, t->b);
    const tss_ipc_body *s = tss__ipc_body_of(p, t->a);
    return s && s->mu >= 0 ? s->mu : p->plane[t->plane].mu;
}

static int tss__ipc_any_friction(const tss_ipc_def *d) {
    if (d->mu > 0) return 1;
    for (int i = 0; i < d->planes; i++)
        if (d->plane[i].mu > 0) return 1;
    for (int i = 0; i < d->bodies; i++)
        if (d->body[i].mu > 0) return 1;
    for (int i = 0; i < d->pairs; i++)
        if (d->pair[i].mu > 0) return 1;
    return 0;
}

// Kind and pair of a stencil: ascending along a list, so two lists can be merged.
static void tss__ipc_key(const tss__ipc_list *l, int id, int key[3]) {
    int k = tss__ipc_kind_of(l, id);
    tss__ipc_entry(l, k, id - l->start[k], key);
}

// Freezes contact planes and normal forces at x.
static tss_result tss__ipc_lag(tss_ipc *p, const tss_ctx *c, const double *x) {
    int count = p->active.start[TSS__IPC_KINDS], arity = tss__ipc_arity(c->dim);
    p->frictions = 0, p->f_pattern++;
    if (!tss__ipc_any_friction(&p->def) || !count) return TSS_OK;
    int *node = (int *)tss__ipc_fit(p->host, &p->f_node, (size_t)(count * arity) * sizeof(int));
    int *key = (int *)tss__ipc_fit(p->host, &p->f_key, (size_t)count * 3 * sizeof(int));
    double *data = (double *)tss__ipc_fit(p->host, &p->f_data, (size_t)count * 8 * sizeof(double));
    if (!node || !data || !key) return TSS_ERROR_NO_MEMORY;
    for (int i = 0; i < count; i++) {
        tss__ipc_touching t;
        tss__ipc_touching_of(p, c, x, i, &t);
        double k = tss__ipc_mu_of(p, &t) * p->kappa * t.force;
        if (!(k > 0)) continue;
        double *to = data + 8 * p->frictions;
        memcpy(to, t.c, sizeof t.c);
        memcpy(to + 4, t.n, sizeof t.n);
        to[7] = k;
        tss__ipc_key(&p->active, i, key + 3 * p->frictions);
        memcpy(node + p->frictions++ * arity, t.node, (size_t)arity * sizeof(int));
    }
    return TSS_OK;
}

static tss_result tss__ipc_friction_lists(void *user, const tss_ctx *c, const double *x,
                                          const double *d, double t_max, tss_stencils *out) {
    tss_ipc *p = (tss_ipc *)user;
    (void)c, (void)x, (void)d, (void)t_max;
    out->count = p->frictions, out->node = (const int *)p->f_node.p, out->pattern = p->f_pattern;
    return TSS_OK;
}

// Tangential displacement u of friction stencil id since x_t; returns ‖u‖.
static double tss__ipc_slip(const tss_ipc *p, const tss_ctx *c, const double *x, int id,
                            double u[3]) {
    const int *v = (const int *)p->f_node.p + (size_t)id * (size_t)tss__ipc_arity(c->dim);
    const double *q = (const double *)p->f_data.p + 8 * (size_t)id;
    double along = 0, s = 0;
    u[0] = u[1] = u[2] = 0;
    for (int i = 0; i < tss__ipc_arity(c->dim) && v[i] >= 0; i++)
        for (int a = 0; a < c->dim; a++) {
            size_t at = (size_t)v[i] * (size_t)c->dim + (size_t)a;
            u[a] += q[i] * (x[at] - c->x_t[at]);
        }
    for (int a = 0; a < c->dim; a++) along += q[4 + a] * u[a];
    for (int a = 0; a < c->dim; a++) u[a] -= along * q[4 + a], s += u[a] * u[a];
    return sqrt(s);
}

static int tss__ipc_id(tss_ids ids, int k) { return ids.list ? ids.list[k] : ids.first + k; }

static void tss__ipc_friction_value(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                    double *out) {
    const tss_ipc *p = (const tss_ipc *)user;
    for (int k = 0; k < ids.count; k++) {
        int id = tss__ipc_id(ids, k);
        double u[3], f[4];
        tss_ipc_friction(tss__ipc_slip(p, c, x, id, u), p->eps_v * c->h, f);
        out[k] = ((const double *)p->f_data.p)[8 * id + 7] * f[0];
    }
}

static void tss__ipc_friction_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                       double *out) {
    const tss_ipc *p = (const tss_ipc *)user;
    int arity = tss__ipc_arity(c->dim), dim = c->dim;
    for (int k = 0; k < ids.count; k++) {
        int id = tss__ipc_id(ids, k);
        const double *q = (const double *)p->f_data.p + 8 * (size_t)id;
        double u[3], f[4];
        tss_ipc_friction(tss__ipc_slip(p, c, x, id, u), p->eps_v * c->h, f);
        for (int i = 0; i < arity; i++)
            for (int a = 0; a < dim; a++)
                out[(k * arity + i) * dim + a] = q[7] * f[3] * q[i] * u[a];
    }
}

// f2 û ûᵀ + f1/‖u‖ v vᵀ with v = n × û (2D: no v): a sum of squares, so rounding keeps it positive.
static void tss__ipc_friction_matrix(int dim, const double *n, const double u[3], double y,
                                     const double f[4], double M[9]) {
    double a[3], b[3];
    tss__v3 w = tss__v3_of(n[0], n[1], dim == 3 ? n[2] : 0), t = tss__v3_of(-w.y, w.x, 0), v;
    if (dim == 3) tss__tangents_of(w, &t, &v);
    if (dim == 3 && y > 0) t = tss__v3_of(u[0] / y, u[1] / y, u[2] / y);
    v = tss__v3_cross(w, t);
    tss__v3_store(t, a), tss__v3_store(v, b);
    for (int i = 0; i < dim; i++)
        for (int k = 0; k < dim; k++)
            M[3 * i + k] = f[2] * (a[i] * a[k]) + (dim == 3 ? f[3] * (b[i] * b[k]) : 0);
}

static void tss__ipc_friction_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                      int psd, double *out) {
    const tss_ipc *p = (const tss_ipc *)user;
    int arity = tss__ipc_arity(c->dim), dim = c->dim, ad = arity * dim;
    (void)psd;
    for (int k = 0; k < ids.count; k++, out += ad * ad) {
        int id = tss__ipc_id(ids, k);
        const double *q = (const double *)p->f_data.p + 8 * (size_t)id;
        double u[3], f[4], M[9], y = tss__ipc_slip(p, c, x, id, u);
        tss_ipc_friction(y, p->eps_v * c->h, f);
        tss__ipc_friction_matrix(dim, q + 4, u, y, f, M);
        for (int i = 0; i < ad; i++)
            for (int j = 0; j < ad; j++)
                out[i * ad + j] = q[7] * (q[i / dim] * q[j / dim]) * M[3 * (i % dim) + j % dim];
    }
}

// ---------------------------------------------------------------------------------------------
// >>contact_step (private)
// ---------------------------------------------------------------------------------------------

static int tss__ipc_touch_order(const void *a, const void *b) {
    const tss__ipc_touch_key *s = (const tss__ipc_touch_key *)a, *t = (const tss__ipc_touch_key *)b;
    if (s->a != t->a) return s->a < t->a ? -1 : 1;
    return s->b == t->b ? 0 : s->b < t->b ? -1 : 1;
}

// Touching pairs of bodies at x, sorted and merged (b = −1 − plane for planes). Few bodies touch:
// insertion into a sorted list.
static tss_result tss__ipc_gather_touches(tss_ipc *p, const tss_ctx *c, const double *x,
                                          tss__ipc_array *list, int *count) {
    int all = p->active.start[TSS__IPC_KINDS];
    const double *d = (const double *)p->distance.p;
    *count = 0;
    for (int i = 0; i < all; i++) {
        tss__ipc_touching t;
        tss__ipc_touch_key key;
        if (!(d[i] < p->dhat * p->dhat)) continue;
        tss__ipc_touching_of(p, c, x, i, &t);
        key.a = t.b < 0 || t.a < t.b ? t.a : t.b;
        key.b = t.b < 0 ? -1 - t.plane : t.a < t.b ? t.b : t.a;
        key.force = p->kappa * t.force, key.distance = t.distance;
        tss__ipc_touch_key *q = (tss__ipc_touch_key *)list->p;
        int at = *count;
        while (at > 0 && tss__ipc_touch_order(&q[at - 1], &key) > 0) at--;
        if (at > 0 && tss__ipc_touch_order(&q[at - 1], &key) == 0) {
            q[at - 1].force += key.force;
            if (key.distance < q[at - 1].distance) q[at - 1].distance = key.distance;
            continue;
        }
        size_t bytes = (size_t)*count * sizeof key;
        if (bytes + sizeof key > list->bytes) {
            tss__ipc_array more = {NULL, 0};
            if (!tss__ipc_fit(p->host, &more, 2 * bytes + sizeof key)) return TSS_ERROR_NO_MEMORY;
            if (bytes) memcpy(more.p, q, bytes);
            tss__ipc_drop(p->host, list);
            *list = more, q = (tss__ipc_touch_key *)more.p;
        }
        memmove(q + at + 1, q + at, (size_t)(*count - at) * sizeof key);
        q[at] = key, ++*count;
    }
    return TSS_OK;
}

static tss_result tss__ipc_begin_step(void *user, const tss_ctx *c) {
    tss_ipc *p = (tss_ipc *)user;
    tss_stencils s;
    tss_result r = tss__ipc_refresh(p, c);
    if (r != TSS_OK) return r;
    p->h = c->h, p->ah2 = c->ah2, p->closes = 0, p->passes = 0;
    size_t bytes = (size_t)(c->nodes * c->dim) * sizeof(double);
    if (!tss__ipc_fit(p->host, &p->x_start, bytes)) return TSS_ERROR_NO_MEMORY;
    memcpy(p->x_start.p, c->x_t, bytes);
    r = tss__ipc_find_active(p, c, c->x_t, 0);
    if (r == TSS_OK) r = tss__ipc_hand_out(p, c, &p->active, &s);
    // The forces at x_t were held with the last step's κ: with a new one at the old distances λ would
    // be wrong by the ratio of the two, and a block at the limit of friction would slide.
    int first = !(p->kappa > 0);
    if (r == TSS_OK && first) r = tss__ipc_start_kappa(p, c);
    if (r == TSS_OK && TSS__FRICTION) r = tss__ipc_lag(p, c, c->x_t);
    if (r == TSS_OK) r = tss__ipc_gather_touches(p, c, c->x_t, &p->touch, &p->touches);
    if (r == TSS_OK && !first) r = tss__ipc_start_kappa(p, c);
    return r;
}

static int tss__ipc_after_solve(void *user, const tss_ctx *c, const double *x) {
    tss_ipc *p = (tss_ipc *)user;
    if (!TSS__FRICTION || ++p->passes >= p->def.friction_iterations || !tss__ipc_any_friction(&p->def))
        return 0;
    if (tss__ipc_find_active(p, c, x, 0) != TSS_OK || tss__ipc_lag(p, c, x) != TSS_OK) {
        p->failed = 1;
        return 0;
    }
    return 1;
}

static double tss__ipc_clearance(void *user, const tss_ctx *c, const double *x) {
    tss_ipc *p = (tss_ipc *)user;
    if (tss__ipc_refresh(p, c) != TSS_OK || tss__ipc_find_active(p, c, x, 0) != TSS_OK) return 0;
    return p->min_distance < p->dhat ? p->min_distance : HUGE_VAL;
}

// Node and primitive, or plane, in words.
static void tss__ipc_name_pair(const tss_ctx *c, int kind, const int v[4], char *text,
                               size_t size) {
    const int *b = c->body;
    switch (kind) {
        case TSS__BROAD_EE:
            snprintf(text, size, "edge %d-%d of body %d against edge %d-%d of body %d", v[0], v[1],
                     b[v[0]], v[2], v[3], b[v[2]]);
            break;
        case TSS__BROAD_PT:
            snprintf(text, size, "node %d of body %d against triangle %d-%d-%d of body %d", v[0],
                     b[v[0]], v[1], v[2], v[3], b[v[1]]);
            break;
        case TSS__BROAD_PE:
            snprintf(text, size, "node %d of body %d against edge %d-%d of body %d", v[0], b[v[0]],
                     v[1], v[2], b[v[1]]);
            break;
        case TSS__BROAD_PP:
            snprintf(text, size, "node %d of body %d against node %d of body %d", v[0], b[v[0]],
                     v[1], b[v[1]]);
            break;
        default:
            snprintf(text, size, "node %d of body %d against plane %d", v[0], b[v[0]], v[1]);
            break;
    }
}

static void tss__ipc_describe(void *user, const tss_ctx *c, int id, char *text, size_t size) {
    const tss_ipc *p = (const tss_ipc *)user;
    int v[4], kind;
    if (p->current && p->culprit[0] == TSS__IPC_FIXED && id == p->current->start[TSS__IPC_KINDS]) {
        tss__pair q = {p->culprit[1], p->culprit[2]};
        tss__broad_nodes(&p->fixed.mesh, p->culprit[3], q, v);
        tss__ipc_name_pair(c, p->culprit[3], v, text, size);
        return;
    }
    if (!p->current || id < 0 || id >= p->current->start[TSS__IPC_KINDS]) {
        snprintf(text, size, "contact %d", id);
        return;
    }
    tss__ipc_stencil_nodes(p, p->current, id, v, &kind);
    tss__ipc_name_pair(c, kind, v, text, size);
}

static void tss__ipc_friction_describe(void *user, const tss_ctx *c, int id, char *text,
                                       size_t size) {
    const tss_ipc *p = (const tss_ipc *)user;
    int v = id >= 0 && id < p->frictions
                ? ((const int *)p->f_node.p)[(size_t)id * (size_t)tss__ipc_arity(c->dim)]
                : -1;
    snprintf(text, size, "friction at node %d", v);
}

static int tss__ipc_not_negative(double v) { return v >= 0 && v < HUGE_VAL; }

// κ, and for how long some pair was thin, is all that a step takes over from the one before: lists,
// lagged forces and the rest are made anew from the state at its start.
typedef struct tss__ipc_saved {
    uint64_t magic;
    double kappa;
    int64_t thin;
} tss__ipc_saved;

static size_t tss__ipc_state(void *user, void *data, size_t size, int save) {
    tss_ipc *p = (tss_ipc *)user;
    tss__ipc_saved s = {0x3163706973737432ULL, p->kappa, p->thin};
    if (!data) return sizeof s;
    if (size < sizeof s) return 0;
    if (save) {
        memcpy(data, &s, sizeof s);
        return sizeof s;
    }
    tss__ipc_saved in;
    memcpy(&in, data, sizeof in);
    if (in.magic != s.magic || !tss__ipc_not_negative(in.kappa)) return 0;
    if (in.thin < 0 || in.thin > 3) return 0;
    p->kappa = in.kappa, p->thin = (int)in.thin, p->min_distance = HUGE_VAL;
    p->active_known = p->swept = p->failed = 0;
    // Queries and friction speak of a step that this state has not seen: they wait for the next.
    p->h = 0, p->frictions = p->touches = 0, p->f_pattern++;
    return sizeof s;
}

static void tss__ipc_free(tss_ipc *p, const tss_host *host) {
    tss__ipc_array *all[] = {&p->kinematic, &p->self_off, &p->body_of,      &p->node,
                             &p->node_old,  &p->x_active, &p->distance,     &p->close, &p->close_old,
                             &p->work,      &p->f_node,   &p->f_data,       &p->f_key,
                             &p->x_start,   &p->touch,    &p->active.plane, &p->kept.plane,
                             &p->fixed_node, &p->fixed_body, &p->fixed_off};
    for (size_t i = 0; i < sizeof all / sizeof *all; i++) tss__ipc_drop(host, all[i]);
    for (int k = 0; k < 4; k++) {
        tss__broad_pairs_free(host, &p->active.pair[k]);
        tss__broad_pairs_free(host, &p->kept.pair[k]);
    }
    tss__broad_free(&p->broad);
    tss__broad_free(&p->fixed);
    tss_free(host, p->plane, (size_t)p->def.planes * sizeof *p->plane);
    tss_free(host, p->body, (size_t)p->def.bodies * sizeof *p->body);
    tss_free(host, p->pair, (size_t)p->def.pairs * sizeof *p->pair);
    tss_free(host, p, sizeof *p);
}

static void tss__ipc_destroy(void *user, const tss_host *host) {
    tss_ipc *p = (tss_ipc *)user;
    if (--p->references == 0) tss__ipc_free(p, host);
}

// ---------------------------------------------------------------------------------------------
// >>contact_doctor (private)
// Intersections at x by a sweep along one axis over edges against triangles (3D) or edges against
// edges (2D). Decided in floating point: a pair that only touches, within rounding, is let pass.
// Cost: n log n and the overlaps along the axis; for tss_world_check and the starts of steps that
// may intersect: then n, and the rest only near the nodes that were set free (ctx->fresh).
// ---------------------------------------------------------------------------------------------

// Side of the plane through a, b, c on which d lies: ±1, or 0 within the rounding of the volume
// (three differences, products and sums: below 16 eps of the product of the sizes).
static int tss__ipc_side(tss__v3 a, tss__v3 b, tss__v3 c, tss__v3 d) {
    tss__v3 u = tss__v3_sub(b, a), v = tss__v3_sub(c, a), w = tss__v3_sub(d, a);
    double volume = tss__v3_dot(tss__v3_cross(u, v), w);
    double noise = 16 * DBL_EPSILON * tss__v3_sum_abs(u) * tss__v3_sum_abs(v) * tss__v3_sum_abs(w);
    return volume > noise ? 1 : volume < -noise ? -1 : 0;
}

static tss__v3 tss__ipc_at(const tss_ctx *c, const double *x, int node) {
    const double *p = x + (size_t)node * (size_t)c->dim;
    return tss__v3_of(p[0], p[1], c->dim == 3 ? p[2] : 0);
}

static int tss__ipc_pierces(const tss_ctx *c, const double *x, const int *e, const int *t) {
    tss__v3 p = tss__ipc_at(c, x, e[0]), q = tss__ipc_at(c, x, e[1]);
    tss__v3 u = tss__ipc_at(c, x, t[0]), v = tss__ipc_at(c, x, t[1]), w = tss__ipc_at(c, x, t[2]);
    if (tss__ipc_side(u, v, w, p) * tss__ipc_side(u, v, w, q) >= 0) return 0;
    int a = tss__ipc_side(p, q, u, v), b = tss__ipc_side(p, q, v, w);
    return a != 0 && a == b && a == tss__ipc_side(p, q, w, u);
}

static int tss__ipc_crosses(const tss_ctx *c, const double *x, const int *e, const int *f) {
    tss__v3 a = tss__ipc_at(c, x, e[0]), b = tss__ipc_at(c, x, e[1]), up = {0, 0, 1};
    tss__v3 p = tss__ipc_at(c, x, f[0]), q = tss__ipc_at(c, x, f[1]);
    tss__v3 over_a = tss__v3_add(a, 1, up), over_p = tss__v3_add(p, 1, up);
    return tss__ipc_side(a, b, over_a, p) * tss__ipc_side(a, b, over_a, q) < 0 &&
           tss__ipc_side(p, q, over_p, a) * tss__ipc_side(p, q, over_p, b) < 0;
}

typedef struct tss__ipc_span {
    double box[6];  // lower, upper
    int id;
} tss__ipc_span;

static int tss__ipc_is_fresh(const tss_ctx *c, const int *v, int arity) {
    int fresh = !c->fresh;
    for (int k = 0; !fresh && k < arity; k++) fresh = c->fresh[v[k]];
    return fresh;
}

// Grows box (lower, upper) to hold a primitive.
static void tss__ipc_grow(const tss_ctx *c, const double *x, const int *v, int arity,
                          double box[6]) {
    for (int k = 0; k < arity; k++)
        for (int a = 0; a < c->dim; a++) {
            double s = x[(size_t)v[k] * (size_t)c->dim + (size_t)a];
            if (s < box[a]) box[a] = s;
            if (s > box[3 + a]) box[3 + a] = s;
        }
}

static void tss__ipc_empty(double box[6]) {
    for (int a = 0; a < 3; a++) box[a] = HUGE_VAL, box[3 + a] = -HUGE_VAL;
}

// Box of the primitives with a fresh node.
static void tss__ipc_fresh_box(const tss_ipc *p, const tss_ctx *c, const double *x, double box[6]) {
    const tss_surface *s = &p->surface;
    tss__ipc_empty(box);
    for (int i = 0; i < s->edges; i++)
        if (tss__ipc_is_fresh(c, s->edge + 2 * i, 2)) tss__ipc_grow(c, x, s->edge + 2 * i, 2, box);
    for (int i = 0; i < s->triangles; i++) {
        const int *v = s->triangle + 3 * i;
        if (tss__ipc_is_fresh(c, v, 3)) tss__ipc_grow(c, x, v, 3, box);
    }
}

// 1 if two boxes share a point.
static int tss__ipc_boxes_meet(const double a[6], const double b[6], int dim) {
    int meet = 1;
    for (int k = 0; k < dim; k++) meet = meet && a[k] <= b[3 + k] && a[3 + k] >= b[k];
    return meet;
}

// Boxes of the primitives that meet `box`; returns their number.
static int tss__ipc_spans(const tss_ctx *c, const double *x, const double box[6], int count,
                          int arity, const int *node, tss__ipc_span *out) {
    int kept = 0;
    for (int i = 0; i < count; i++) {
        tss__ipc_empty(out[kept].box);
        tss__ipc_grow(c, x, node + i * arity, arity, out[kept].box);
        out[kept].id = i;
        kept += tss__ipc_boxes_meet(out[kept].box, box, c->dim);
    }
    return kept;
}

#define TSS__IPC_SPAN_LEAF 8

// A tree over spans, in place: span[from..to) is halved along the axis in which the middles spread
// most until TSS__IPC_SPAN_LEAF are left. Node k has children 2k + 1 and 2k + 2; `box` holds theirs.
static void tss__ipc_span_tree(tss__ipc_span *span, int from, int to, int k, double (*box)[6]) {
    double mid[6];
    tss__ipc_empty(box[k]), tss__ipc_empty(mid);
    for (int i = from; i < to; i++)
        for (int a = 0; a < 3; a++) {
            const double *b = span[i].box;
            double m = b[a] + b[3 + a];
            box[k][a] = fmin(box[k][a], b[a]), box[k][3 + a] = fmax(box[k][3 + a], b[3 + a]);
            mid[a] = fmin(mid[a], m), mid[3 + a] = fmax(mid[3 + a], m);
        }
    if (to - from <= TSS__IPC_SPAN_LEAF) return;
    int axis = 0, half = from + (to - from) / 2;
    for (int a = 1; a < 3; a++)
        if (mid[3 + a] - mid[a] > mid[3 + axis] - mid[axis]) axis = a;
    for (int low = from, high = to - 1; low < high;) {  // quickselect (Hoare) of the middle one
        double pivot = span[low + (high - low) / 2].box[axis] + span[low + (high - low) / 2].box[3 + axis];
        int i = low, j = high;
        while (i <= j) {
            while (span[i].box[axis] + span[i].box[3 + axis] < pivot) i++;
            while (span[j].box[axis] + span[j].box[3 + axis] > pivot) j--;
            if (i <= j) {
                tss__ipc_span swap = span[i];
                span[i++] = span[j], span[j--] = swap;
            }
        }
        if (half <= j) high = j;
        else if (half >= i) low = i;
        else break;
    }
    tss__ipc_span_tree(span, from, half, 2 * k + 1, box);
    tss__ipc_span_tree(span, half, to, 2 * k + 2, box);
}

// Ids of the spans whose boxes meet e's into `out` (room for all); returns their number.
static int tss__ipc_span_search(const tss__ipc_span *span, int from, int to, int k, double (*box)[6],
                                const double e[6], int dim, int *out) {
    if (!tss__ipc_boxes_meet(box[k], e, dim)) return 0;
    if (to - from <= TSS__IPC_SPAN_LEAF) {
        int n = 0;
        for (int i = from; i < to; i++)
            if (tss__ipc_boxes_meet(span[i].box, e, dim)) out[n++] = span[i].id;
        return n;
    }
    int half = from + (to - from) / 2;
    int n = tss__ipc_span_search(span, from, half, 2 * k + 1, box, e, dim, out);
    return n + tss__ipc_span_search(span, half, to, 2 * k + 2, box, e, dim, out + n);
}

static int tss__ipc_may_meet(const tss_ipc *p, const tss_ctx *c, const int *e, const int *f,
                             int arity) {
    const uint8_t *fixed = (const uint8_t *)p->kinematic.p,
                  *self_off = (const uint8_t *)p->self_off.p;
    int all = fixed[e[0]] && fixed[e[1]];
    for (int k = 0; k < arity; k++) {
        if (f[k] == e[0] || f[k] == e[1]) return 0;
        all = all && fixed[f[k]];
    }
    int a = c->body[e[0]], b = c->body[f[0]];
    if (!tss__ipc_is_fresh(c, e, 2) && !tss__ipc_is_fresh(c, f, arity)) return 0;
    const tss_ipc_pair *q = tss__ipc_pair_of(p, a, b);
    return !all && !(a == b && self_off[a]) && !(q && q->exclude);
}

typedef struct tss__ipc_crossing {
    int e, f;  // edge; triangle, or edge in 2D
} tss__ipc_crossing;

typedef struct tss__ipc_hunt {
    const tss_ipc *p;
    const tss_ctx *c;
    const double *x;
    const tss__ipc_span *edge, *span;
    double (*box)[6];
    int edges, count, arity;
    const int *other;
    int *hit;                   // a worker's ids, `count` each
    tss__ipc_crossing *first;  // 8 of each block
    int *found;                 // of each block
} tss__ipc_hunt;

#define TSS__IPC_HUNT 256  // edges in a block

static void tss__ipc_hunt_task(int block, int worker, void *arg) {
    const tss__ipc_hunt *h = (const tss__ipc_hunt *)arg;
    int *hit = h->hit + (size_t)worker * (size_t)h->count, found = 0;
    int to = (block + 1) * TSS__IPC_HUNT < h->edges ? (block + 1) * TSS__IPC_HUNT : h->edges;
    for (int i = block * TSS__IPC_HUNT; i < to; i++) {
        const tss__ipc_span *e = h->edge + i;
        const int *v = h->p->surface.edge + 2 * e->id;
        int n = tss__ipc_span_search(h->span, 0, h->count, 0, h->box, e->box, h->c->dim, hit);
        for (int k = 0; k < n; k++) {
            const int *t = h->other + h->arity * hit[k];
            if ((h->c->dim == 2 && hit[k] <= e->id) || !tss__ipc_may_meet(h->p, h->c, v, t, h->arity)) continue;
            if (!(h->c->dim == 3 ? tss__ipc_pierces(h->c, h->x, v, t) : tss__ipc_crosses(h->c, h->x, v, t))) continue;
            if (found < 8) h->first[block * 8 + found].e = e->id, h->first[block * 8 + found].f = hit[k];
            found++;
        }
    }
    h->found[block] = found;
}

static void tss__ipc_report_crossing(const tss__ipc_hunt *h, const tss__ipc_crossing *k, tss_issue_fn *add, void *arg) {
    const int *v = h->p->surface.edge + 2 * k->e, *t = h->other + h->arity * k->f, *body = h->c->body;
    char text[200];
    if (h->c->dim == 3)
        snprintf(text, sizeof text, "edge %d-%d of body %d pierces triangle %d-%d-%d of body %d: move the bodies apart",
                 v[0], v[1], body[v[0]], t[0], t[1], t[2], body[t[0]]);
    else
        snprintf(text, sizeof text, "edge %d-%d of body %d crosses edge %d-%d of body %d: move the bodies apart", v[0],
                 v[1], body[v[0]], t[0], t[1], body[t[0]]);
    add(TSS_SEVERITY_ERROR, text, arg);
}

// Reports the first 8, by edge, and returns how many there are (−1: no memory).
static int tss__ipc_intersections(tss_ipc *p, const tss_ctx *c, const double *x, tss_issue_fn *add,
                                  void *arg) {
    const tss_surface *s = &p->surface;
    int arity = c->dim, count = c->dim == 3 ? s->triangles : s->edges, found = 0, nodes = 1;
    const int *other = c->dim == 3 ? s->triangle : s->edge;
    int blocks = (s->edges + TSS__IPC_HUNT - 1) / TSS__IPC_HUNT;
    if (s->edges == 0 || count == 0) return 0;
    for (int most = count; most > TSS__IPC_SPAN_LEAF; most = (most + 1) / 2) nodes = 2 * nodes + 1;
    size_t spans = (size_t)(s->edges + count), hits = (size_t)tss_workers(p->host) * (size_t)count;
    size_t bytes = spans * sizeof(tss__ipc_span) + (size_t)nodes * 6 * sizeof(double) +
                   (size_t)blocks * 8 * sizeof(tss__ipc_crossing) + ((size_t)blocks + hits) * sizeof(int);
    tss__ipc_array memory = {NULL, 0};
    tss__ipc_span *e = (tss__ipc_span *)tss__ipc_fit(p->host, &memory, bytes);
    if (!e) return -1;
    tss__ipc_span *f = e + s->edges;
    double(*tree)[6] = (double(*)[6])(void *)(f + count), box[6];
    tss__ipc_fresh_box(p, c, x, box);
    tss__ipc_hunt h = {p, c, x, e, f, tree, 0, 0, arity, other, NULL, NULL, NULL};
    h.edges = tss__ipc_spans(c, x, box, s->edges, 2, s->edge, e);
    h.count = tss__ipc_spans(c, x, box, count, arity, other, f);
    h.first = (tss__ipc_crossing *)(void *)(tree + nodes);
    h.found = (int *)(void *)(h.first + blocks * 8), h.hit = h.found + blocks;
    tss__ipc_span_tree(f, 0, h.count, 0, tree);
    blocks = (h.edges + TSS__IPC_HUNT - 1) / TSS__IPC_HUNT;
    tss_parallel(p->host, blocks, tss__ipc_hunt_task, &h);
    for (int k = 0; k < blocks; k++) {
        for (int i = 0; add && i < 8 && i < h.found[k] && found + i < 8; i++)
            tss__ipc_report_crossing(&h, h.first + k * 8 + i, add, arg);
        found += h.found[k];
    }
    tss__ipc_drop(p->host, &memory);
    return found;
}

// Points on the wrong side of planes.
static int tss__ipc_below_planes(tss_ipc *p, const tss_ctx *c, const double *x, tss_issue_fn *add,
                                 void *arg) {
    const uint8_t *fixed = (const uint8_t *)p->kinematic.p;
    int found = 0;
    for (int k = 0; k < p->def.planes; k++) {
        double worst = 0;
        int who = -1;
        for (int i = 0; i < p->surface.points; i++) {
            int v = p->surface.point[i];
            double s =
                tss__ipc_plane_distance(&p->plane[k], c->dim, x + (size_t)v * (size_t)c->dim);
            if (!fixed[v] && (who < 0 ? s <= 0 : s < worst)) worst = s, who = v;
        }
        if (who < 0) continue;
        char text[200];
        snprintf(text, sizeof text,
                 "node %d of body %d lies %.3g m behind plane %d: move the body out", who,
                 c->body[who], -worst, k);
        add(TSS_SEVERITY_ERROR, text, arg);
        found++;
    }
    return found;
}

static void tss__ipc_check(void *user, const tss_ctx *c, const double *x, tss_issue_fn *add,
                           void *arg) {
    tss_ipc *p = (tss_ipc *)user;
    char text[200];
    tss_result r = tss__ipc_refresh(p, c);
    if (r != TSS_OK) {
        snprintf(text, sizeof text, "contact: %s", tss_result_text(r));
        add(TSS_SEVERITY_ERROR, text, arg);
        return;
    }
    double edge = tss__ipc_shortest(p, c);
    snprintf(text, sizeof text, "contact: dhat = %.4g m (%s), friction below %.3g m/s is smoothed",
             p->dhat, p->dhat_from, p->eps_v);
    add(TSS_SEVERITY_NOTE, text, arg);
    if (p->dhat > 0.5 * edge) {
        snprintf(text, sizeof text,
                 "contact: dhat = %.3g m exceeds half the shortest surface edge (%.3g m): "
                 "neighbours in the mesh may repel",
                 p->dhat, edge);
        add(TSS_SEVERITY_WARNING, text, arg);
    }
    int n = tss__ipc_intersections(p, c, x, add, arg);
    if (n > 8 || n < 0) {
        snprintf(text, sizeof text,
                 n < 0 ? "contact: no memory to look for intersections"
                       : "contact: %d intersections in all",
                 n);
        add(TSS_SEVERITY_ERROR, text, arg);
    }
    tss__ipc_below_planes(p, c, x, add, arg);
    if (tss__ipc_find_active(p, c, x, 0) == TSS_OK && p->min_distance < 1e-9 * c->diagonal) {
        snprintf(
            text, sizeof text,
            "contact: the least distance is %.3g m: surfaces touch; leave a gap of about %.2g m",
            p->min_distance, p->dhat);
        add(p->min_distance > 0 ? TSS_SEVERITY_WARNING : TSS_SEVERITY_ERROR, text, arg);
    }
}

// ---------------------------------------------------------------------------------------------
// >>contact_world (private)
// ---------------------------------------------------------------------------------------------

tss_ipc_def tss_ipc_def_default(void) {
    tss_ipc_def d;
    memset(&d, 0, sizeof d);
    d.dhat_rel = 1e-3, d.dhat_edge = 0.5, d.friction_iterations = 1, d.self_contact = 1;
    d.slack = 0.2, d.max_candidates = 1 << 25, d.cookie = TSS__IPC_COOKIE;
    return d;
}

// What is wrong with a def, or NULL.
static const char *tss__ipc_def_fault(const tss_ipc_def *d, int dim) {
    if (d->cookie != TSS__IPC_COOKIE) return "start from tss_ipc_def_default()";
    if (!tss__ipc_not_negative(d->dhat)) return "dhat, expected >= 0";
    if (!(d->dhat > 0) && !(d->dhat_rel > 0 && d->dhat_rel < HUGE_VAL)) return "dhat_rel, expected > 0";
    if (!tss__ipc_not_negative(d->dhat_edge)) return "dhat_edge, expected >= 0";
    if (!tss__ipc_not_negative(d->kappa)) return "kappa, expected >= 0";
    if (!tss__ipc_not_negative(d->mu)) return "mu, expected >= 0";
    if (!tss__ipc_not_negative(d->eps_v)) return "eps_v, expected >= 0";
    if (d->friction_iterations < 1) return "friction_iterations, expected >= 1";
    if (!(d->slack > 0 && d->slack < 1)) return "slack, expected between 0 and 1";
    if (d->max_candidates < 1) return "max_candidates, expected >= 1";
    if (d->planes < 0 || (d->planes && !d->plane)) return "planes without an array of them";
    if (d->bodies < 0 || (d->bodies && !d->body)) return "bodies without an array of them";
    if (d->pairs < 0 || (d->pairs && !d->pair)) return "pairs without an array of them";
    for (int k = 0; k < d->planes; k++) {
        double s = 0;
        for (int a = 0; a < dim; a++) s += d->plane[k].normal[a] * d->plane[k].normal[a];
        if (!(s > 0 && s < HUGE_VAL)) return "a plane's normal, expected finite and not 0";
        if (!tss__ipc_not_negative(d->plane[k].mu)) return "a plane's mu, expected >= 0";
        for (int a = 0; a < dim; a++)
            if (!(fabs(d->plane[k].origin[a]) < HUGE_VAL)) return "a plane's origin, expected finite";
    }
    return NULL;
}

static int tss__ipc_copy(const tss_host *host, void **to, const void *from, int count,
                         size_t size) {
    if (!count) return 1;
    *to = tss_alloc(host, (size_t)count * size);
    if (*to) memcpy(*to, from, (size_t)count * size);
    return *to != NULL;
}

static tss_result tss__ipc_create(tss_world *w, const tss_ipc_def *d, int dim, tss_ipc **out) {
    const tss_host *host = tss_world_host(w);
    tss_ipc *p = (tss_ipc *)tss_alloc(host, sizeof *p);
    if (!p) return TSS_ERROR_NO_MEMORY;
    memset(p, 0, sizeof *p);
    p->world = w, p->host = host, p->def = *d, p->min_distance = HUGE_VAL;
    p->dhat_from = "", p->current = &p->active;
    tss__broad_init(&p->broad, host), tss__broad_init(&p->fixed, host);
    int ok = tss__ipc_copy(host, (void **)&p->plane, d->plane, d->planes, sizeof *d->plane) &&
             tss__ipc_copy(host, (void **)&p->body, d->body, d->bodies, sizeof *d->body) &&
             tss__ipc_copy(host, (void **)&p->pair, d->pair, d->pairs, sizeof *d->pair);
    if (!ok) {
        if (!p->plane) p->def.planes = 0;
        if (!p->body) p->def.bodies = 0;
        if (!p->pair) p->def.pairs = 0;
        tss__ipc_free(p, host);
        return TSS_ERROR_NO_MEMORY;
    }
    p->def.plane = p->plane, p->def.body = p->body, p->def.pair = p->pair;
    for (int k = 0; k < d->planes; k++) {
        double s = 0, *n = p->plane[k].normal;
        if (dim == 2) n[2] = 0;
        for (int a = 0; a < dim; a++) s += n[a] * n[a];
        for (int a = 0; a < dim; a++) n[a] /= sqrt(s);
    }
    *out = p;
    return TSS_OK;
}

static tss_energy_def tss__ipc_barrier_def(tss_ipc *p, int dim) {
    tss_energy_def e = tss_energy_def_default();
    e.name = "contact", e.user = p, e.arity = tss__ipc_arity(dim);
    e.flags = TSS_ENERGY_TIMES_AH2 | TSS_ENERGY_DYNAMIC | TSS_ENERGY_WANTS_GRADIENT;
    e.lists = tss__ipc_lists, e.value = tss__ipc_value, e.gradient = tss__ipc_gradient;
    e.hessian = tss__ipc_hessian, e.begin_step = tss__ipc_begin_step,
    e.max_step = tss__ipc_max_step;
    e.after_iterate = tss__ipc_after_iterate, e.after_solve = tss__ipc_after_solve;
    e.describe = tss__ipc_describe, e.state = tss__ipc_state, e.check = tss__ipc_check;
    e.clearance = tss__ipc_clearance, e.destroy = tss__ipc_destroy;
    return e;
}

static tss_energy_def tss__ipc_friction_def(tss_ipc *p, int dim) {
    tss_energy_def e = tss_energy_def_default();
    e.name = "friction", e.user = p, e.arity = tss__ipc_arity(dim);
    e.flags = TSS_ENERGY_TIMES_AH2 | TSS_ENERGY_DYNAMIC;
    e.lists = tss__ipc_friction_lists, e.value = tss__ipc_friction_value;
    e.gradient = tss__ipc_friction_gradient, e.hessian = tss__ipc_friction_hessian;
    e.describe = tss__ipc_friction_describe, e.destroy = tss__ipc_destroy;
    return e;
}

tss_result tss_ipc_add(tss_world *w, const tss_ipc_def *def, tss_ipc **out) {
    if (out) *out = NULL;
    if (!w || !def) return TSS_ERROR_BAD_ARGUMENT;
    int dim = tss_world_dim(w);
    const char *fault = tss__ipc_def_fault(def, dim);
    if (fault) return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "contact: %s", fault);
    int friction = tss__ipc_any_friction(def);
    if (friction && !TSS__FRICTION)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT,
                              "contact: mu > 0, but friction is left out of this build by TSS_NO_FRICTION");
    tss_ipc *p;
    tss_result r = tss__ipc_create(w, def, dim, &p);
    if (r != TSS_OK) return tss_world_fail(w, r, "contact: %s", tss_result_text(r));
    const tss_host *host = p->host;
    tss_energy_def e = tss__ipc_barrier_def(p, dim);
    p->barrier = p->friction = -1;
    r = tss_energy_add(w, &e, &p->barrier);
    if (r != TSS_OK) {
        tss__ipc_free(p, host);
        return r;
    }
    p->references = 1;
    if (TSS__FRICTION && friction) {
        e = tss__ipc_friction_def(p, dim);
        r = tss_energy_add(w, &e, &p->friction);
    }
    if (r != TSS_OK) {
        tss_energy_remove(w, p->barrier);
        return r;
    }
    p->references += p->friction >= 0;
    if (out) *out = p;
    return TSS_OK;
}

tss_result tss_ipc_remove(tss_ipc *p) {
    if (!p) return TSS_ERROR_BAD_ARGUMENT;
    tss_world *w = p->world;
    tss_energy barrier = p->barrier, friction = p->friction;
    tss_result r = friction >= 0 ? tss_energy_remove(w, friction) : TSS_OK;
    return r == TSS_OK ? tss_energy_remove(w, barrier) : r;
}

static size_t tss__ipc_bytes(const tss_ipc *p) {
    const tss__ipc_array *all[] = {&p->kinematic, &p->self_off, &p->body_of,      &p->node,
                                   &p->node_old,  &p->x_active, &p->distance,     &p->close, &p->close_old,
                                   &p->work,      &p->f_node,   &p->f_data,       &p->f_key,
                                   &p->x_start,   &p->touch,    &p->active.plane, &p->kept.plane,
                                   &p->fixed_node, &p->fixed_body, &p->fixed_off};
    size_t sum = sizeof *p;
    for (size_t i = 0; i < sizeof all / sizeof *all; i++) sum += all[i]->bytes;
    for (int k = 0; k < 4; k++)
        sum += (size_t)(p->active.pair[k].room + p->kept.pair[k].room + p->broad.list[k].room +
                        p->fixed.list[k].room) * sizeof(tss__pair);
    return sum;
}

void tss_ipc_get_info(const tss_ipc *p, tss_ipc_info *out) {
    memset(out, 0, sizeof *out);
    out->dhat = p->dhat, out->dhat_from = p->dhat_from, out->eps_v = p->eps_v;
    out->kappa = p->kappa, out->kappa_min = p->kappa_min, out->kappa_max = p->kappa_max;
    out->candidates = p->candidates, out->kept = p->kept.start[TSS__IPC_KINDS];
    for (int i = 0; p->active_known && i < p->active.start[TSS__IPC_KINDS]; i++)
        out->active += ((const double *)p->distance.p)[i] < p->dhat * p->dhat;
    out->frictional = p->frictions;
    out->min_distance = p->min_distance < p->dhat ? p->min_distance : HUGE_VAL;
    out->shortened = p->shortened, out->doubled = p->doubled, out->bytes = tss__ipc_bytes(p);
}

// The result of a query, said to the world if it is an error.
static tss_result tss__ipc_say(tss_ipc *p, tss_result r) {
    return r == TSS_OK ? r : tss_world_fail(p->world, r, "contact: %s", tss_result_text(r));
}

// What the queries need of the world at its current state.
static tss_result tss__ipc_query(tss_ipc *p, tss_ctx *c) {
    memset(c, 0, sizeof *c);
    c->host = p->host, c->dim = tss_world_dim(p->world), c->nodes = tss_world_nodes(p->world);
    c->X = tss_world_rest(p->world), c->kind = tss_world_kinds(p->world);
    c->body = (const int *)p->body_of.p, c->h = p->h, c->ah2 = p->ah2;
    c->x_t = (const double *)p->x_start.p;
    if (!(p->dhat > 0) || !(p->h > 0)) return tss__ipc_say(p, TSS_ERROR_NOT_PREPARED);
    tss_surface s;
    tss_result r = tss_world_surface(p->world, &s);
    if (r != TSS_OK || s.topology != p->surface.topology || p->broad.mesh.nodes != c->nodes)
        return tss__ipc_say(p, TSS_ERROR_NOT_PREPARED);
    return tss__ipc_say(p, tss__ipc_find_active(p, c, tss_world_positions(p->world), 0));
}

// Friction stencil of active stencil id, looked for from *at on (both lists ascend); −1: none.
static int tss__ipc_friction_of(const tss_ipc *p, int id, int *at) {
    const int *keys = (const int *)p->f_key.p;
    int key[3];
    tss__ipc_key(&p->active, id, key);
    for (; *at < p->frictions; ++*at) {
        const int *k = keys + 3 * (size_t)*at;
        int order = 0;
        for (int i = 0; i < 3 && !order; i++) order = k[i] < key[i] ? -1 : k[i] > key[i];
        if (order >= 0) return order == 0 ? *at : -1;
    }
    return -1;
}

static void tss__ipc_fill_contact(const tss_ipc *p, const tss_ctx *c, const double *x, int id,
                                  int friction, tss_ipc_contact *o) {
    tss__ipc_touching t;
    tss__ipc_touching_of(p, c, x, id, &t);
    memset(o, 0, sizeof *o);
    o->kind = t.kind == TSS__IPC_PLANE ? -1 : t.kind;
    o->plane = t.plane, o->a = t.a, o->b = t.b;
    memcpy(o->node, t.node, sizeof o->node);
    memcpy(o->coef, t.c, sizeof o->coef);
    memcpy(o->normal, t.n, sizeof o->normal);
    o->distance = t.distance, o->force = p->kappa * t.force;
    if (friction < 0) return;
    double u[3], f[4];
    tss_ipc_friction(tss__ipc_slip(p, c, x, friction, u), p->eps_v * c->h, f);
    double k = -((const double *)p->f_data.p)[8 * (size_t)friction + 7] * f[3];
    for (int a = 0; a < 3; a++) o->friction[a] = k * u[a];
}

tss_result tss_ipc_contacts(tss_ipc *p, int max, tss_ipc_contact *out, int *count) {
    tss_ctx c;
    int at = 0;
    *count = 0;
    tss_result r = tss__ipc_query(p, &c);
    if (r != TSS_OK) return r;
    const double *x = tss_world_positions(p->world), *d = (const double *)p->distance.p;
    for (int i = 0; i < p->active.start[TSS__IPC_KINDS]; i++) {
        if (!(d[i] < p->dhat * p->dhat)) continue;
        if (out && *count < max)
            tss__ipc_fill_contact(p, &c, x, i, tss__ipc_friction_of(p, i, &at), &out[*count]);
        ++*count;
    }
    return TSS_OK;
}

tss_result tss_ipc_forces(tss_ipc *p, double *out) {
    tss_ctx c;
    tss_stencils s;
    tss_result r = tss__ipc_query(p, &c);
    if (r == TSS_OK) r = tss__ipc_say(p, tss__ipc_hand_out(p, &c, &p->active, &s));
    if (r != TSS_OK) return r;
    const double *x = tss_world_positions(p->world);
    int arity = tss__ipc_arity(c.dim);
    memset(out, 0, (size_t)(c.nodes * c.dim) * sizeof *out);
    tss__ipc_sum_gradient(p, &c, x, -p->kappa, out);
    for (int i = 0; i < p->frictions; i++) {
        double g[12];
        tss_ids one = {i, 1, NULL};
        const int *v = (const int *)p->f_node.p + (size_t)i * (size_t)arity;
        tss__ipc_friction_gradient(p, &c, x, one, g);
        for (int k = 0; k < arity * c.dim; k++)
            if (v[k / c.dim] >= 0) out[v[k / c.dim] * c.dim + k % c.dim] -= g[k];
    }
    return TSS_OK;
}

// Twice the area (2D: the length) of a primitive of dim nodes at x.
static double tss__ipc_measure_of(int dim, const double *x, const int *v) {
    double u[3] = {0, 0, 0}, w[3] = {0, 0, 0}, n[3];
    for (int a = 0; a < dim; a++) {
        u[a] = x[v[1] * dim + a] - x[v[0] * dim + a];
        if (dim == 3) w[a] = x[v[2] * dim + a] - x[v[0] * dim + a];
    }
    if (dim == 2) return 2 * sqrt(u[0] * u[0] + u[1] * u[1]);
    n[0] = u[1] * w[2] - u[2] * w[1], n[1] = u[2] * w[0] - u[0] * w[2], n[2] = u[0] * w[1] - u[1] * w[0];
    return sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
}

tss_result tss_ipc_pressures(tss_ipc *p, double *out) {
    tss_ctx c;
    tss_stencils s;
    tss_result r = tss__ipc_query(p, &c);
    if (r == TSS_OK) r = tss__ipc_say(p, tss__ipc_hand_out(p, &c, &p->active, &s));
    if (r != TSS_OK) return r;
    const double *x = tss_world_positions(p->world);
    int dim = c.dim, items = dim == 3 ? p->surface.triangles : p->surface.edges;
    const int *item = dim == 3 ? p->surface.triangle : p->surface.edge;
    size_t n = (size_t)c.nodes, need = n * (size_t)dim * sizeof(double);
    double *g = (double *)tss__ipc_fit(p->host, &p->work, need);
    if (!g) return tss__ipc_say(p, TSS_ERROR_NO_MEMORY);
    memset(g, 0, need);
    memset(out, 0, n * sizeof *out);
    tss__ipc_sum_gradient(p, &c, x, p->kappa, g);
    for (int k = 0; k < items; k++)
        for (int i = 0; i < dim; i++)
            out[item[k * dim + i]] += tss__ipc_measure_of(dim, x, item + k * dim) / (2 * dim);
    for (int i = 0; i < c.nodes; i++) {
        double f = 0;
        for (int a = 0; a < dim; a++) f += g[i * dim + a] * g[i * dim + a];
        out[i] = out[i] > 0 ? sqrt(f) / out[i] : 0;
    }
    return TSS_OK;
}

// Merges what touched at the start of the step with what touches now; both are sorted.
static int tss__ipc_merge_touches(const tss__ipc_touch_key *was, int wases,
                                  const tss__ipc_touch_key *is, int ises, int max,
                                  tss_ipc_touch *out) {
    int i = 0, k = 0, count = 0;
    while (i < wases || k < ises) {
        int order = i >= wases ? 1 : k >= ises ? -1 : tss__ipc_touch_order(&was[i], &is[k]);
        const tss__ipc_touch_key *q = order < 0 ? &was[i] : &is[k];
        tss_ipc_touch t = {q->a,
                           q->b,
                           order > 0,
                           order < 0,
                           order < 0 ? 0 : q->force,
                           order < 0 ? 0 : q->distance};
        if (out && count < max) out[count] = t;
        count++, i += order <= 0, k += order >= 0;
    }
    return count;
}

tss_result tss_ipc_touches(tss_ipc *p, int max, tss_ipc_touch *out, int *count) {
    tss_ctx c;
    tss__ipc_array now = {NULL, 0};
    int n = 0;
    *count = 0;
    tss_result r = tss__ipc_query(p, &c);
    if (r == TSS_OK)
        r = tss__ipc_gather_touches(p, &c, tss_world_positions(p->world), &now, &n);
    if (r == TSS_OK)
        *count = tss__ipc_merge_touches((const tss__ipc_touch_key *)p->touch.p, p->touches,
                                        (const tss__ipc_touch_key *)now.p, n, max, out);
    tss__ipc_drop(p->host, &now);
    return tss__ipc_say(p, r);
}

#ifdef __cplusplus
}
#endif
#if !defined(__clang__) && defined(__GNUC__)
#pragma GCC pop_options
#endif
#endif  // TSS_IMPLEMENTATION

/*
MIT License

Copyright (c) 2026 The tss authors

Permission is hereby granted, free of charge, to any person obtaining a copy
of this software and associated documentation files (the "Software"), to deal
in the Software without restriction, including without limitation the rights
to use, copy, modify, merge, publish, distribute, sublicense, and/or sell
copies of the Software, and to permit persons to whom the Software is
furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all
copies or substantial portions of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR
IMPLIED, INCLUDING BUT NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY,
FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE
AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER
LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM,
OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE
SOFTWARE.
*/
