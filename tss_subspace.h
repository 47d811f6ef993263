/* tss_subspace.h: adaptive subspaces for tss.h, after "Trading Spaces" (Trusty et al. 2024, paper A)
 *
 * What it is: every time step is solved for a few deformation modes a body. An oracle measures, in
 * the middle of the step, where that is not good enough, and adds modes and groups of mesh nodes
 * there. Two tolerances trade error for time, down to the full-space solution. Contact, friction
 * and all guarantees are those of the full-space solver: every iterate is a full-space step.
 *
 *     #define TSS_IMPLEMENTATION            // in one .c or .cpp file
 *     #include "tss.h"
 *     #include "tss_ipc.h"                  // if there is contact
 *     #include "tss_subspace.h"
 *
 *     tss_basis_def b = tss_basis_skinning(16);
 *     tss_basis_add(world, body, &b, NULL);  // before the first step: that is all
 *
 * Bodies without a basis are solved in full space beside the others. Positions are the state:
 * modes are scratch that no vertex notices when it changes (paper A, §3.2).
 *
 * Memory: a skinning basis keeps nodes × handles doubles; every subdomain a secant matrix of
 * (active modes)². Threads, determinism, errors: as in tss.h. Setup (partition, modes) happens in
 * tss_basis_add and the first step. License: MIT (at the end).
 * Options: those of tss.h;
 *     TSS_NO_EIGEN  no bases that solve for their modes: skinning, biharmonic, eigen, POD, and no
 *                   cache files (37 kB); tss_basis_add refuses them.
 *     TSS_SUBSPACE_DEBUG  checks in every iterate that the coupled matrix is positive definite.
 *
 * CONVENTIONS
 *     U: all modes of a body, U_a the active ones, B_a = S'U_a those masked at enriched nodes;
 *     X_a: the enriched nodes. A scalar function φ stands for d modes, φ in each coordinate.
 *     𝒢 error, ℰ progress, γ and η their scales (Eq. 5–17); H_q, J, H_x as in Eq. (19).
 */
#ifndef TSS_SUBSPACE_H
#define TSS_SUBSPACE_H

#ifndef TSS_H
#error "include tss.h before tss_subspace.h"
#endif

#ifdef __cplusplus
extern "C" {
#endif

// ---------------------------------------------------------------------------------------------
// >>bases (public)
// What a body's subspace is made of. A basis is cut into blocks, the units in which the oracle adds
// and removes. Scalar functions give dim columns each (Φ ⊗ I_d); vector columns stand alone. The
// inner product is ⟨f, g⟩ = Σ m_i f_i g_i / Σ m_i over the nodes that are not fixed: functions and
// columns have no unit and a root mean square of 1, whatever the mass, size and place of the body.
// ---------------------------------------------------------------------------------------------

typedef enum tss_basis_kind {
    // One block {1, X − c}: whatever a body does as a whole.
    TSS_BASIS_AFFINE,
    // Affine, and a second block: the d(d+1)/2 products of the coordinates of X − c.
    TSS_BASIS_QUADRATIC,
    // Blocks w_b · {1, X − c}: w_b the constant (if nothing is fixed), then the lowest `count`
    // nontrivial solutions of L w = λ M w, L the Laplacian, w = 0 at fixed nodes (Benchekroun et
    // al. 2023). Kept as nodes × blocks weights and one (d+1)² matrix a block.
    TSS_BASIS_SKINNING,
    // `count` functions, one at each handle: least wᵀ L M⁻¹ L w with w = 1 at its handle, 0 at the
    // others and at fixed nodes; afterwards scaled to unit norm (Weber et al. 2012). Handles are
    // farthest points, at least one in each piece that nothing holds.
    TSS_BASIS_BIHARMONIC,
    // The `count` lowest modes of linear elasticity at rest, K u = λ M u; vector columns. The rigid
    // modes come first where nothing holds a piece.
    TSS_BASIS_EIGEN,
    // The leading `count` left singular vectors of the snapshots' displacements from X, weighted by
    // mass, not centred; fewer if their rank is lower. Vector columns.
    TSS_BASIS_POD,
    TSS_BASIS_ARRAYS,  // functions or columns of your own, taken as they are
    TSS_BASIS_CUSTOM,  // columns that your function fills at the start of every step
    TSS_BASIS_KINDS
} tss_basis_kind;

typedef struct tss_basis_def {
    tss_basis_kind kind;
    int count;          // handles, modes, functions or columns, >= 1; unused by AFFINE, QUADRATIC
    int initial;        // blocks active from the start, >= 0; more than there are, or −1: all.
                        // Default −1, but 6 for SKINNING
    int heterogeneous;  // SKINNING: L weighted by the cells' lambda + 4 mu (2D: + 3 mu); default 0
    const double *scalars;  // ARRAYS: nodes × count, function s at node i: scalars[i·count + s]; or
    const double *vectors;  // (nodes·dim) × count, row-major. One of the two; copied
    const int *block;       // ARRAYS, CUSTOM: block of each function or column, ascending from 0
                            // without gaps; NULL (default): one each. Copied
    const double *snapshots;  // POD: snapshot_count × (nodes·dim) positions, m; read during setup
    int snapshot_count;
    // CUSTOM: fills columns, (nodes·dim) × count row-major, from c->x_t + first_node·dim and the
    // like, at the start of every step. Must depend on what c holds and on user alone.
    void (*refresh)(void *user, const tss_ctx *c, int first_node, int nodes, double *columns);
    void *user;
    // SKINNING, BIHARMONIC, EIGEN, POD: a file that is read if it was written for this mesh and
    // def, and else (over)written after setup; NULL (default): none. A damaged file counts as none,
    // one that cannot be written is a warning in the log.
    const char *cache;
    double tol;  // SKINNING, EIGEN: residual allowed to an eigenpair, 0 < tol < 1: the norm of
                 // (K − σM)⁻¹ (K u − λ M u) relative to u, σ < 0 small; default 1e-8
    int cookie;
} tss_basis_def;

// Defaults for a kind: the cookie, initial and tol set, everything else zero or as given. Pointers
// are kept until the basis is set up, not copied here.
TSS_API tss_basis_def tss_basis_affine(void);
TSS_API tss_basis_def tss_basis_quadratic(void);
TSS_API tss_basis_def tss_basis_skinning(int handles);
TSS_API tss_basis_def tss_basis_biharmonic(int handles);
TSS_API tss_basis_def tss_basis_eigen(int modes);
// snapshots × (nodes·dim) positions.
TSS_API tss_basis_def tss_basis_pod(const double *x, int snapshots, int modes);
// One of scalars and vectors; the other NULL. block may be NULL.
TSS_API tss_basis_def tss_basis_arrays(int count, const double *scalars, const double *vectors,
                                       const int *block);
// block may be NULL.
TSS_API tss_basis_def tss_basis_custom(int count, const int *block,
                                       void (*refresh)(void *user, const tss_ctx *c,
                                                       int first_node, int nodes,
                                                       double *columns),
                                       void *user);

typedef int tss_basis;  // 0, 1, ... in the order of tss_basis_add


// ---------------------------------------------------------------------------------------------
// >>subspace (public)
// The adaptive solver of a world: a direction finder (tss.h, >>directions).
// ---------------------------------------------------------------------------------------------

typedef struct tss_subspace tss_subspace;  // owned by its world

typedef enum tss_mode {
    TSS_MODE_ADAPTIVE,  // modes and nodes come and go by the oracle
    TSS_MODE_SUBSPACE,  // all modes of the bases, no nodes, no oracle
    TSS_MODE_FULL,      // every node: the world's own solver
} tss_mode;

typedef enum tss_oracle {
    TSS_ORACLE_RING,     // 𝒢 = min of strain and unbalanced force over the ring (docs/oracle.md)
    TSS_ORACLE_LITERAL,  // Eq. (5)–(17) as printed
} tss_oracle;

typedef enum tss_secant {
    TSS_SECANT_BFGS,    // §3.9: exact at the start of the step, then BFGS by subdomain
    TSS_SECANT_FROZEN,  // exact at the start of the step, then kept
    TSS_SECANT_EXACT,   // exact in every iterate: for comparison
} tss_secant;

typedef enum tss_schur {
    TSS_SCHUR_AUTO,    // whichever needs less counted work, given the iterations seen so far
    TSS_SCHUR_PCG,     // §3.10: conjugate gradients on Eq. (22), block-Jacobi
    TSS_SCHUR_DIRECT,  // sparse Cholesky of H_x and the dense complement of H_q
} tss_schur;

typedef struct tss_oracle_fields tss_oracle_fields;

typedef struct tss_subspace_def {
    tss_mode mode;       // default TSS_MODE_ADAPTIVE
    double error_nodes;  // ε_G of nodes, no unit: smaller enriches more, 0 everything; default 0.5
    double error_modes;  // ε_G of modes; default 0.5
    double progress;     // ε_E, no unit: more progress than this needs no help; default 1e-4
    double downdate;     // ε_d, 1/s: what moves less than this share of the body's diagonal a second
                         // differently from the modes leaves; 0: nothing leaves; default 0.1
    int keep;            // steps that what was activated stays at least; default 2
    int partitions;      // L, groups of nodes in all; 0: one for each 100 nodes; default 0
    tss_oracle oracle;   // default TSS_ORACLE_RING
    tss_secant secant;   // default TSS_SECANT_BFGS
    tss_schur schur;     // default TSS_SCHUR_AUTO
    double pcg_tol;      // relative residual; default 1e-5
    // After each evaluation of the oracle, for pictures and study; NULL: nothing.
    void (*on_oracle)(const tss_oracle_fields *fields, void *ctx);
    void *on_oracle_ctx;
    int cookie;
} tss_subspace_def;

// What the oracle saw, n entries each (0 where it did not look). Valid during the call only.
struct tss_oracle_fields {
    int iterate;              // of the step
    const double *x;          // where it was asked, n × d
    const double *d_a;        // the subspace's own direction, scaled by its line search (Eq. 18)
    const double *error;      // 𝒢_i
    const double *progress;   // ℰ_i
    const double *force;      // ‖∇_{x_i}E‖ / γ_i
    const uint8_t *enriched;  // 1: enriched by now, those just added included
};

TSS_API tss_subspace_def tss_subspace_def_default(void);
// Gives a world this solver; tss_basis_add does it with the defaults if nobody did. out may be
// NULL. Errors: BAD_ARGUMENT, NO_MEMORY.
TSS_API tss_result tss_subspace_add(tss_world *w, const tss_subspace_def *def, tss_subspace **out);
TSS_API tss_subspace *tss_subspace_of(tss_world *w);  // NULL: none
// Changes mode and tolerances between steps (partitions stay as they were). No vertex moves.
TSS_API tss_result tss_subspace_set(tss_subspace *s, const tss_subspace_def *def);

typedef struct tss_subspace_info {
    int bodies, bases, groups;   // bodies with modes; groups of nodes
    int modes, active_modes;     // columns: available, in use
    int nodes, enriched_nodes;   // unknown nodes
    const int *group;            // of each node of the world, −1: none
    const uint8_t *enriched;     // of each node of the world
    const double *error, *progress;  // 𝒢_i, ℰ_i of the last oracle (0 where it did not look)
    double setup_seconds;        // partition and scales; 0 without a clock
    size_t bytes;                // held by the solver, bases included
    uint64_t oracle_calls, secant_updates, secant_skips, hessians;  // subdomain matrices so far
} tss_subspace_info;
TSS_API void tss_subspace_get_info(const tss_subspace *s, tss_subspace_info *out);

// Asks the oracle about the state between two steps, as the next step would in its first iterate,
// and takes no step: fields go to def.on_oracle and tss_subspace_get_info; nothing is activated.
TSS_API tss_result tss_subspace_query(tss_world *w);

// Adds a basis to a soft body with cells; a body may have several. Setup runs here; the world is
// prepared first. out (NULL allowed): its number. Errors: BAD_ARGUMENT, NO_MEMORY, SINGULAR, with
// a sentence in tss_world_error; nothing is added then.
TSS_API tss_result tss_basis_add(tss_world *w, tss_body body, const tss_basis_def *def, tss_basis *out);
// Takes a basis away between steps; no vertex moves.
TSS_API tss_result tss_basis_remove(tss_world *w, tss_basis basis);

typedef struct tss_basis_info {
    tss_body body;
    tss_basis_kind kind;
    int blocks, active_blocks;
    int functions;           // scalar functions or vector columns
    int modes;               // columns: d × functions for scalar ones
    const double *eigenvalue;  // of each block, or NULL
    double residual;         // largest relative residual of the eigenpairs
    double seconds;          // of setup, 0 without a clock
    size_t bytes;
    int cached;              // 1: read from def.cache
} tss_basis_info;
TSS_API int tss_world_bases(const tss_world *w);
TSS_API tss_result tss_basis_get(const tss_world *w, tss_basis basis, tss_basis_info *out);
// Column `mode` of a basis as a displacement field of its body's nodes, nodes × d, unit mass norm.
TSS_API tss_result tss_basis_mode(const tss_world *w, tss_basis basis, int mode, double *out);

#ifdef __cplusplus
}
#endif
#endif  // TSS_SUBSPACE_H

#if defined(TSS_IMPLEMENTATION) && !defined(TSS_SUBSPACE_IMPLEMENTATION_DONE)
#define TSS_SUBSPACE_IMPLEMENTATION_DONE

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
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

// ---------------------------------------------------------------------------------------------
// >>bases (private)
// Definitions, the mesh a basis is made from, and what comes out. All work is done on a normalised
// mesh: coordinates relative to the centre of mass and divided by a power of two, masses divided by
// their sum, stiffnesses by a power of two. So results do not depend on the place of the body, and
// not in a single bit on powers of two in its size, mass and stiffness.
// ---------------------------------------------------------------------------------------------

#ifdef TSS_NO_EIGEN  // what that leaves out hangs on this constant, as in tss.h, >>features
#define TSS__EIGEN 0
#else
#define TSS__EIGEN 1
#endif

#define TSS__BASIS_COOKIE 0x626173  // proves that a def came from its default function

typedef struct tss__sub_mesh {  // what a basis may depend on, all borrowed; one body, local numbers
    const tss_host *host;
    int dim, nodes, cells;
    const int *cell;            // cells × (dim+1)
    const double *X;            // nodes × dim, m
    const double *mass;         // nodes, kg
    const double *mu, *lambda;  // cells, Pa (Lamé)
    const uint8_t *fixed;       // nodes: 1 = pinned or scripted at setup; NULL: none
} tss__sub_mesh;

typedef struct tss__basis {  // freed by tss__basis_free
    tss_basis_kind kind;
    int nodes, dim;
    int vector;     // 0: scalar functions (each gives dim columns, Φ ⊗ I_d); 1: vector columns
    int blocks, columns;  // columns: functions or vector columns in all
    int initial;    // blocks active from the start, 0..blocks
    int *first;     // blocks + 1: functions/columns of block b are first[b] .. first[b+1]−1
    // Factored scalar basis (AFFINE, SKINNING), d+1 functions a block: function k of block b at
    // node i is weight[i·blocks + b] · Σ_j transform[b][k][j] m_j, m = (1, X_i − center).
    double *weight;     // nodes × blocks, or NULL
    double *transform;  // blocks × (d+1) × (d+1), lower triangles; dropped functions have rows of 0
    double center[3];   // m
    double *value;      // not factored: nodes × columns (scalar) or (nodes·dim) × columns (vector),
                        // row-major; dropped functions are columns of 0
    double *eigenvalue; // blocks, or NULL. EIGEN: rad²/s²; SKINNING: λ of L w = λ M w (L of unit
                        // or given stiffness), 0 first; POD: mean square along the column, m²
    int *handle;        // BIHARMONIC: node of each function; else NULL
    double mass;        // Σ m_i of the inner product, kg: ⟨f, f⟩ = 1 is Σ m_i f_i² = mass
    double residual;    // largest relative residual of the eigenpairs, 0 if none
    int iterations;     // of the eigensolver: applications of the inverse to a block of vectors
    size_t bytes;       // held
    int cached;         // 1 if read from the cache
} tss__basis;

static tss_basis_def tss__basis_def_of(tss_basis_kind kind, int count) {
    tss_basis_def d;
    memset(&d, 0, sizeof d);
    d.kind = kind, d.count = count, d.initial = kind == TSS_BASIS_SKINNING ? 6 : -1;
    d.tol = 1e-8, d.cookie = TSS__BASIS_COOKIE;
    return d;
}

tss_basis_def tss_basis_affine(void) { return tss__basis_def_of(TSS_BASIS_AFFINE, 1); }
tss_basis_def tss_basis_quadratic(void) { return tss__basis_def_of(TSS_BASIS_QUADRATIC, 1); }

tss_basis_def tss_basis_skinning(int handles) {
    return tss__basis_def_of(TSS_BASIS_SKINNING, handles);
}

tss_basis_def tss_basis_biharmonic(int handles) {
    return tss__basis_def_of(TSS_BASIS_BIHARMONIC, handles);
}

tss_basis_def tss_basis_eigen(int modes) { return tss__basis_def_of(TSS_BASIS_EIGEN, modes); }

tss_basis_def tss_basis_pod(const double *x, int snapshots, int modes) {
    tss_basis_def d = tss__basis_def_of(TSS_BASIS_POD, modes);
    d.snapshots = x, d.snapshot_count = snapshots;
    return d;
}

tss_basis_def tss_basis_arrays(int count, const double *scalars, const double *vectors,
                               const int *block) {
    tss_basis_def d = tss__basis_def_of(TSS_BASIS_ARRAYS, count);
    d.scalars = scalars, d.vectors = vectors, d.block = block;
    return d;
}

tss_basis_def tss_basis_custom(int count, const int *block,
                               void (*refresh)(void *user, const tss_ctx *c, int first_node,
                                               int nodes, double *columns),
                               void *user) {
    tss_basis_def d = tss__basis_def_of(TSS_BASIS_CUSTOM, count);
    d.block = block, d.refresh = refresh, d.user = user;
    return d;
}

// ---------------------------------------------------------------------------------------------
// >>basis_work (private)
// The normalised mesh, and every transient array in one list so that one call frees them all.
// ---------------------------------------------------------------------------------------------

enum { TSS__BASIS_ARRAYS = 48 };

typedef struct tss__basis_work {
    const tss__sub_mesh *mesh;
    const tss_basis_def *def;
    const tss_host *host;
    char *error;
    size_t error_size;
    int arrays;
    void *array[TSS__BASIS_ARRAYS];
    size_t array_bytes[TSS__BASIS_ARRAYS];
    int fixed;         // nodes that are fixed
    int active;        // nodes that are not masked
    uint8_t *mask;     // nodes: 1 = fixed, or out of the problem for want of mass or cells
    uint8_t *idle;     // nodes: 1 = in no cell
    double *X;         // nodes × dim: (X − center) / scale
    double *share;     // nodes: mass over the sum of those not masked; 0 where masked
    double center[3];  // m
    double scale;      // m, a power of two
    double diagonal;   // of the bounding box of X as above
    double mass;       // kg, the sum
} tss__basis_work;

static tss_result tss__basis_fail(tss__basis_work *w, tss_result r, const char *format, ...) {
    va_list args;
    if (!w->error || !w->error_size) return r;
    va_start(args, format);
    vsnprintf(w->error, w->error_size, format, args);
    va_end(args);
    return r;
}

static tss_result tss__basis_no_memory(tss__basis_work *w) {
    return tss__basis_fail(w, TSS_ERROR_NO_MEMORY, "no memory for the basis");
}

// Cleared memory that lasts until tss__basis_work_free; NULL: none.
static void *tss__basis_take(tss__basis_work *w, size_t count, size_t item) {
    size_t bytes = (count ? count : 1) * item;
    if (count > (SIZE_MAX / 2) / item || w->arrays == TSS__BASIS_ARRAYS) return NULL;
    void *p = tss_alloc(w->host, bytes);
    if (!p) return NULL;
    memset(p, 0, bytes);
    w->array[w->arrays] = p, w->array_bytes[w->arrays++] = bytes;
    return p;
}

static double *tss__basis_doubles(tss__basis_work *w, size_t count) {
    return (double *)tss__basis_take(w, count, sizeof(double));
}

static int *tss__basis_ints(tss__basis_work *w, size_t count) {
    return (int *)tss__basis_take(w, count, sizeof(int));
}

// Frees what was taken after the first `keep` arrays.
static void tss__basis_release(tss__basis_work *w, int keep) {
    while (w->arrays > keep) {
        w->arrays--;
        tss_free(w->host, w->array[w->arrays], w->array_bytes[w->arrays]);
    }
}

// The largest power of two that is not above v > 0.
static double tss__basis_power(double v) {
    int e;
    frexp(v, &e);
    return ldexp(1.0, e - 1);
}

static void tss__basis_masks(tss__basis_work *w, int cells_needed) {
    const tss__sub_mesh *m = w->mesh;
    memset(w->idle, 1, (size_t)m->nodes);
    for (int k = 0; k < m->cells * (m->dim + 1); k++) w->idle[m->cell[k]] = 0;
    for (int i = 0; i < m->nodes; i++) {
        int fixed = m->fixed && m->fixed[i];
        w->fixed += fixed;
        w->mask[i] = (uint8_t)(fixed || !(m->mass[i] > 0) || (cells_needed && w->idle[i]));
        w->active += !w->mask[i];
    }
}

// Centre of mass of the nodes not masked; sums relative to the first of them, so that a body far
// from the origin loses nothing.
static void tss__basis_center(tss__basis_work *w) {
    const tss__sub_mesh *m = w->mesh;
    double s[3] = {0, 0, 0};
    const double *origin = NULL;
    for (int i = 0; i < m->nodes; i++) {
        if (w->mask[i]) continue;
        if (!origin) origin = m->X + (ptrdiff_t)i * m->dim;
        w->mass += m->mass[i];
        for (int a = 0; a < m->dim; a++)
            s[a] += m->mass[i] * (m->X[(ptrdiff_t)i * m->dim + a] - origin[a]);
    }
    for (int a = 0; a < m->dim; a++) w->center[a] = origin[a] + s[a] / w->mass;
}

static void tss__basis_normalise(tss__basis_work *w) {
    const tss__sub_mesh *m = w->mesh;
    double lo[3] = {0, 0, 0}, hi[3] = {0, 0, 0}, widest = 0, sum = 0;
    for (ptrdiff_t k = 0; k < (ptrdiff_t)m->nodes * m->dim; k++) {
        int a = (int)(k % m->dim);
        w->X[k] = m->X[k] - w->center[a];
        if (k < m->dim || w->X[k] < lo[a]) lo[a] = w->X[k];
        if (k < m->dim || w->X[k] > hi[a]) hi[a] = w->X[k];
    }
    for (int a = 0; a < m->dim; a++) widest = fmax(widest, hi[a] - lo[a]);
    w->scale = widest > 0 ? tss__basis_power(widest) : 1;
    for (ptrdiff_t k = 0; k < (ptrdiff_t)m->nodes * m->dim; k++) w->X[k] /= w->scale;
    for (int a = 0; a < m->dim; a++) {
        double l = (hi[a] - lo[a]) / w->scale;
        sum += l * l;
    }
    w->diagonal = sqrt(sum);
    for (int i = 0; i < m->nodes; i++) w->share[i] = w->mask[i] ? 0 : m->mass[i] / w->mass;
}

// Masks, centre, normalised coordinates and masses.
static tss_result tss__basis_open(tss__basis_work *w, int cells_needed) {
    const tss__sub_mesh *m = w->mesh;
    size_t n = (size_t)m->nodes;
    if (cells_needed && m->cells < 1)
        return tss__basis_fail(w, TSS_ERROR_BAD_MESH, "this basis needs cells, the body has none");
    w->mask = (uint8_t *)tss__basis_take(w, n, 1), w->idle = (uint8_t *)tss__basis_take(w, n, 1);
    w->X = tss__basis_doubles(w, n * (size_t)m->dim), w->share = tss__basis_doubles(w, n);
    if (!w->mask || !w->idle || !w->X || !w->share) return tss__basis_no_memory(w);
    tss__basis_masks(w, cells_needed);
    for (int i = 0; cells_needed && i < m->nodes; i++)
        if (!w->idle[i] && !(m->mass[i] > 0))
            return tss__basis_fail(w, TSS_ERROR_BAD_MATERIAL,
                                   "node %d is in a cell but has no mass", i);
    if (w->active == 0)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT,
                               "nothing is left to move: all %d nodes are fixed or without mass",
                               m->nodes);
    tss__basis_center(w);
    tss__basis_normalise(w);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>basis_tall (private)
// Matrices of many rows and few columns, column-major, one column after the other. Rows are cut
// into fixed blocks; sums over them are added in block order.
// ---------------------------------------------------------------------------------------------

enum { TSS__TALL_ROWS = 512 };

typedef struct tss__tall {
    const tss_host *host;
    int rows, blocks;
    const double *w;   // rows: weights of the inner product
    double *part;      // blocks × (most entries of a Gram matrix)
    double *scratch;   // workers × TSS__TALL_ROWS × (most columns)
    size_t wide;       // most columns
    int a, b;          // of the call that runs: columns of A and B
    const double *A, *C;
    double *B;
} tss__tall;

static tss_result tss__tall_open(tss__basis_work *w, tss__tall *t, int rows, const double *weights,
                                 int wide, int gram) {
    t->host = w->host, t->rows = rows, t->w = weights, t->wide = (size_t)wide;
    t->blocks = (rows + TSS__TALL_ROWS - 1) / TSS__TALL_ROWS;
    t->part = tss__basis_doubles(w, (size_t)t->blocks * (size_t)gram);
    t->scratch = tss__basis_doubles(w, (size_t)tss_workers(w->host) * TSS__TALL_ROWS * t->wide);
    return t->part && t->scratch ? TSS_OK : tss__basis_no_memory(w);
}

static int tss__tall_span(const tss__tall *t, int block, int *lo) {
    *lo = block * TSS__TALL_ROWS;
    return t->rows - *lo < TSS__TALL_ROWS ? t->rows - *lo : TSS__TALL_ROWS;
}

static void tss__tall_gram_task(int block, int worker, void *arg) {
    tss__tall *t = (tss__tall *)arg;
    int lo, rows = tss__tall_span(t, block, &lo);
    double *s = t->scratch + (size_t)worker * TSS__TALL_ROWS * t->wide;
    for (int j = 0; j < t->b; j++)
        for (int i = 0; i < rows; i++)
            s[j * TSS__TALL_ROWS + i] = t->w[lo + i] * t->B[(ptrdiff_t)j * t->rows + lo + i];
    tss_dense_product(1, 0, t->a, t->b, rows, 1, t->A + lo, t->rows, s, TSS__TALL_ROWS, 0,
                      t->part + (size_t)block * (size_t)t->a * (size_t)t->b, t->a);
}

// C (a × b) = Aᵀ diag(w) B.
static void tss__tall_gram(tss__tall *t, int a, const double *A, int b, double *B, double *C) {
    size_t size = (size_t)a * (size_t)b;
    if (!size) return;
    t->a = a, t->b = b, t->A = A, t->B = B;
    tss_parallel(t->host, t->blocks, tss__tall_gram_task, t);
    memcpy(C, t->part, size * sizeof(double));
    for (int k = 1; k < t->blocks; k++)
        for (size_t e = 0; e < size; e++) C[e] += t->part[(size_t)k * size + e];
}

static void tss__tall_subtract_task(int block, int worker, void *arg) {
    tss__tall *t = (tss__tall *)arg;
    int lo, rows = tss__tall_span(t, block, &lo);
    (void)worker;
    tss_dense_product(0, 0, rows, t->b, t->a, -1, t->A + lo, t->rows, t->C, t->a, 1, t->B + lo,
                      t->rows);
}

// B (b columns) −= A C.
static void tss__tall_subtract(tss__tall *t, int a, const double *A, const double *C, int b,
                               double *B) {
    if (!a || !b) return;
    t->a = a, t->b = b, t->A = A, t->B = B, t->C = C;
    tss_parallel(t->host, t->blocks, tss__tall_subtract_task, t);
}

static void tss__tall_rotate_task(int block, int worker, void *arg) {
    tss__tall *t = (tss__tall *)arg;
    int lo, rows = tss__tall_span(t, block, &lo);
    double *s = t->scratch + (size_t)worker * TSS__TALL_ROWS * t->wide;
    for (int j = 0; j < t->a; j++)
        memcpy(s + (size_t)j * TSS__TALL_ROWS, t->A + (ptrdiff_t)j * t->rows + lo,
               (size_t)rows * sizeof(double));
    tss_dense_product(0, 0, rows, t->b, t->a, 1, s, TSS__TALL_ROWS, t->C, t->a, 0, t->B + lo,
                      t->rows);
}

// B (b columns) = A C; B may be A.
static void tss__tall_rotate(tss__tall *t, int a, const double *A, const double *C, int b,
                             double *B) {
    t->a = a, t->b = b, t->A = A, t->B = B, t->C = C;
    tss_parallel(t->host, t->blocks, tss__tall_rotate_task, t);
}

// B (b columns) −= its part in the a columns of V; c (a × b) gets the coefficients.
static void tss__tall_project(tss__tall *t, int a, const double *V, int b, double *B, double *c) {
    tss__tall_gram(t, a, V, b, B, c);
    tss__tall_subtract(t, a, V, c, b, B);
}

static void tss__tall_scale(int rows, double *v, double f) {
    for (int i = 0; i < rows; i++) v[i] *= f;
}

static double tss__tall_norm(tss__tall *t, double *v) {
    double s;
    tss__tall_gram(t, 1, v, 1, v, &s);
    return sqrt(s);
}

// Makes column k of V, already orthogonal to those before `from`, orthonormal to from..k−1; its
// parts and its norm go to r (by column from `from`). 0: it vanished, and is left as it is. c: k
// doubles.
static int tss__tall_join(tss__tall *t, double *V, int from, int k, double *r, double *c) {
    double *F = V + (ptrdiff_t)from * t->rows, *v = V + (ptrdiff_t)k * t->rows;
    double before = tss__tall_norm(t, v), norm = before;
    for (int pass = 0; pass < 2; pass++) {
        tss__tall_project(t, k - from, F, 1, v, c);
        for (int i = 0; i < k - from; i++) r[i] += c[i];
        norm = tss__tall_norm(t, v);
        // What is left of heavy cancellation is no longer orthogonal to the rest.
        if (norm < 0.1 * before) tss__tall_project(t, k, V, 1, v, c);
    }
    norm = tss__tall_norm(t, v);
    if (!(norm > 1e-11 * before)) return 0;
    r[k - from] = norm;
    tss__tall_scale(t->rows, v, 1 / norm);
    return 1;
}

// The sign of a vector is free: the first of the entries within 1e-6 of the largest is positive.
static void tss__tall_sign(int rows, double *v) {
    double largest = 0;
    int i = 0;
    for (int k = 0; k < rows; k++) largest = fmax(largest, fabs(v[k]));
    while (fabs(v[i]) < (1 - 1e-6) * largest) i++;
    if (v[i] < 0) tss__tall_scale(rows, v, -1);
}

// ---------------------------------------------------------------------------------------------
// >>basis_dense (private)
// Symmetric eigenproblems of a few hundred rows: Householder's reduction to tridiagonal form, then
// QR with implicit shifts (Golub and Van Loan, §8.3). Column-major, leading dimension n.
// ---------------------------------------------------------------------------------------------

// Reflector I − tau v vᵀ that takes x to alpha e_1; v overwrites x.
static double tss__reflector(int n, double *x, double *alpha) {
    double s = 0;
    for (int i = 0; i < n; i++) s += x[i] * x[i];
    *alpha = x[0] > 0 ? -sqrt(s) : sqrt(s);
    if (!(s > 0)) return 0;
    x[0] -= *alpha;
    double v = 0;
    for (int i = 0; i < n; i++) v += x[i] * x[i];
    return 2 / v;
}

// A −= v qᵀ + q vᵀ with q = p − (tau/2 vᵀp) v, p = tau A v: both sides of the reflector at once.
static void tss__reflect_both(int n, double *a, int lda, const double *v, double tau, double *q) {
    double vp = 0;
    for (int i = 0; i < n; i++) q[i] = 0;
    for (int j = 0; j < n; j++)
        for (int i = 0; i < n; i++) q[i] += a[i + (ptrdiff_t)j * lda] * (tau * v[j]);
    for (int i = 0; i < n; i++) vp += v[i] * q[i];
    for (int i = 0; i < n; i++) q[i] -= 0.5 * tau * vp * v[i];
    for (int j = 0; j < n; j++)
        for (int i = 0; i < n; i++) a[i + (ptrdiff_t)j * lda] -= v[i] * q[j] + q[i] * v[j];
}

// A = Q T Qᵀ; A becomes Q, T has the diagonal d and e[k] between k and k + 1. tau: n.
static void tss__tridiagonal(int n, double *a, double *d, double *e, double *tau, double *q) {
    for (int k = 0; k + 1 < n; k++) {
        double *v = a + (ptrdiff_t)k * n + k + 1;
        tau[k] = tss__reflector(n - k - 1, v, &e[k]);
        tss__reflect_both(n - k - 1, a + (ptrdiff_t)(k + 1) * n + k + 1, n, v, tau[k], q);
    }
    for (int k = 0; k < n; k++) d[k] = a[(ptrdiff_t)k * n + k];
    // Q from the last reflector to the first, each on the columns behind its own.
    for (int k = n - 1; k >= 0; k--) {
        double *c = a + (ptrdiff_t)k * n;
        const double *v = k ? a + (ptrdiff_t)(k - 1) * n + k : NULL;
        for (int i = 0; i < n; i++) c[i] = i == k;
        for (int j = k; v && j < n; j++) {
            double *x = a + (ptrdiff_t)j * n + k, s = 0;
            for (int i = 0; i < n - k; i++) s += v[i] * x[i];
            for (int i = 0; i < n - k; i++) x[i] -= tau[k - 1] * s * v[i];
        }
    }
}

// One implicit QR step on the rows lo..hi with Wilkinson's shift: a rotation of the first two rows,
// then the bulge it makes is chased down. Rotations go to the columns of Q.
static void tss__qr_step(int n, double *d, double *e, double *q, int lo, int hi) {
    double delta = (d[hi - 1] - d[hi]) / 2, f = e[hi - 1];
    double root = sqrt(delta * delta + f * f);
    double x = d[lo] - d[hi] + f * f / (delta + (delta < 0 ? -root : root)), z = e[lo];
    for (int k = lo; k < hi; k++) {
        double r = sqrt(x * x + z * z), c = r > 0 ? x / r : 1, s = r > 0 ? z / r : 0;
        double top = d[k], low = d[k + 1], off = e[k];
        if (k > lo) e[k - 1] = r;
        d[k] = c * c * top + 2 * c * s * off + s * s * low;
        d[k + 1] = s * s * top - 2 * c * s * off + c * c * low;
        e[k] = c * s * (low - top) + (c * c - s * s) * off;
        x = e[k];
        if (k + 1 < hi) z = s * e[k + 1], e[k + 1] *= c;
        double *u = q + (ptrdiff_t)k * n, *v = u + n;
        for (int i = 0; i < n; i++) {
            double t = u[i];
            u[i] = c * t + s * v[i];
            v[i] = c * v[i] - s * t;
        }
    }
}

// Zeroes off-diagonals that are rounding; the lowest row of the unreduced block that ends at hi.
static int tss__qr_split(const double *d, double *e, int hi) {
    int lo = hi;
    while (lo > 0 && fabs(e[lo - 1]) > 1.1e-16 * (fabs(d[lo - 1]) + fabs(d[lo]))) lo--;
    if (lo > 0) e[lo - 1] = 0;
    return lo;
}

static void tss__swap_columns(int n, double *a, double *b) {
    for (int k = 0; k < n; k++) {
        double t = a[k];
        a[k] = b[k], b[k] = t;
    }
}

// Values descending in d, vectors in the columns of a. work: 3n. 0: no convergence.
static int tss__symmetric_eigen(int n, double *a, double *d, double *work) {
    double *e = work;
    if (n < 1) return 1;
    memset(work, 0, 3 * (size_t)n * sizeof(double));
    tss__tridiagonal(n, a, d, e, work + n, work + 2 * n);
    for (int hi = n - 1; hi > 0; hi--)
        for (int lo = tss__qr_split(d, e, hi), steps = 0; lo < hi; lo = tss__qr_split(d, e, hi)) {
            if (steps++ == 100) return 0;
            tss__qr_step(n, d, e, a, lo, hi);
        }
    for (int i = 0; i < n; i++) {
        int best = i;
        for (int j = i + 1; j < n; j++) best = d[j] > d[best] ? j : best;
        if (best == i) continue;
        tss__swap_columns(1, d + i, d + best);
        tss__swap_columns(n, a + (ptrdiff_t)i * n, a + (ptrdiff_t)best * n);
    }
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>basis_matrix (private)
// Laplacian (d = 1) and linear elasticity (d = dim) of the normalised cells, row by row: the cells
// around a node in ascending order, so that the matrix is symmetric to the last bit.
// ---------------------------------------------------------------------------------------------

typedef struct tss__cell_lists {  // cells of node i: list[start[i]] .. list[start[i + 1] − 1]
    int64_t *start;
    int *list;
} tss__cell_lists;

static tss_result tss__cells_of_nodes(tss__basis_work *w, tss__cell_lists *c) {
    const tss__sub_mesh *m = w->mesh;
    int size = m->dim + 1;
    int64_t total = (int64_t)m->cells * size;
    c->start = (int64_t *)tss__basis_take(w, (size_t)m->nodes + 2, sizeof(int64_t));
    c->list = tss__basis_ints(w, (size_t)total);
    if (!c->start || !c->list) return tss__basis_no_memory(w);
    for (int64_t k = 0; k < total; k++) c->start[m->cell[k] + 2]++;
    for (int i = 0; i < m->nodes; i++) c->start[i + 2] += c->start[i + 1];
    for (int64_t k = 0; k < total; k++) c->list[c->start[m->cell[k] + 1]++] = (int)(k / size);
    return TSS_OK;
}

// Nodes that share a cell with node i, itself included, ascending; seen[j] == i marks them.
static int tss__neighbours(const tss__sub_mesh *m, const tss__cell_lists *c, int i, int *seen,
                           int *out) {
    int size = m->dim + 1, count = 0;
    for (int64_t k = c->start[i]; k < c->start[i + 1]; k++)
        for (int a = 0; a < size; a++) {
            int j = m->cell[c->list[k] * size + a], at;
            if (seen[j] == i + 1) continue;
            seen[j] = i + 1;
            for (at = count++; at > 0 && out[at - 1] > j; at--) out[at] = out[at - 1];
            out[at] = j;
        }
    return count;
}

// The pattern of all pairs of nodes that share a cell; nodes in no cell have an empty row but for
// their own block. A is freed by the caller.
static tss_result tss__basis_pattern(tss__basis_work *w, const tss__cell_lists *c, int d,
                                     tss_bcsr *A) {
    const tss__sub_mesh *m = w->mesh;
    int keep = w->arrays;
    int *seen = tss__basis_ints(w, (size_t)m->nodes);
    int *near = tss__basis_ints(w, (size_t)m->nodes);
    int64_t blocks = 0;
    if (!seen || !near) return tss__basis_no_memory(w);
    for (int i = 0; i < m->nodes; i++) {
        int count = tss__neighbours(m, c, i, seen, near);
        blocks += count ? count : 1;
    }
    if (tss_bcsr_reserve(w->host, A, m->nodes, d, blocks) != TSS_OK) return tss__basis_no_memory(w);
    memset(seen, 0, (size_t)m->nodes * sizeof(int));
    A->row[0] = 0;
    for (int i = 0; i < m->nodes; i++) {
        int *row = A->col + A->row[i], count = tss__neighbours(m, c, i, seen, row);
        if (!count) row[count++] = i;
        A->row[i + 1] = A->row[i] + count;
    }
    memset(A->val, 0, (size_t)(blocks * d * d) * sizeof(double));
    tss__basis_release(w, keep);
    return TSS_OK;
}

// Gradients of the hat functions of cell k, row a of g; returns its volume (area), >= 0.
static double tss__basis_gradients(const tss__basis_work *w, int k, double g[4][3]) {
    const tss__sub_mesh *m = w->mesh;
    const int *c = m->cell + (ptrdiff_t)k * (m->dim + 1);
    double e[3][3], q[3][3], det = 0;
    for (int a = 0; a < m->dim; a++)
        for (int i = 0; i < m->dim; i++)
            e[a][i] = w->X[(ptrdiff_t)c[a + 1] * m->dim + i] - w->X[(ptrdiff_t)c[0] * m->dim + i];
    if (m->dim == 2) {
        q[0][0] = e[1][1], q[0][1] = -e[1][0], q[1][0] = -e[0][1], q[1][1] = e[0][0];
    } else {
        for (int a = 0; a < 3; a++)
            for (int i = 0; i < 3; i++) {
                const double *u = e[(a + 1) % 3], *v = e[(a + 2) % 3];
                q[a][i] = u[(i + 1) % 3] * v[(i + 2) % 3] - u[(i + 2) % 3] * v[(i + 1) % 3];
            }
    }
    for (int i = 0; i < m->dim; i++) det += e[0][i] * q[0][i];
    for (int i = 0; i < m->dim; i++) {
        g[0][i] = 0;
        for (int a = 0; a < m->dim; a++) g[a + 1][i] = q[a][i] / det, g[0][i] -= q[a][i] / det;
    }
    return fabs(det) / (m->dim == 3 ? 6 : 2);
}

// What the cells weigh in the matrix, in units of `unit`: kappa of the Laplacian; else elasticity.
typedef struct tss__stiffness {
    int elastic, weighted;
    double unit;   // Pa or 1, a power of two
    double shift;  // −σ of the eigenproblem, in normalised units
} tss__stiffness;

static double tss__basis_kappa(const tss__basis_work *w, const tss__stiffness *s, int k) {
    const tss__sub_mesh *m = w->mesh;
    if (s->elastic) return m->mu[k] / s->unit;
    if (!s->weighted) return 1;
    return (m->lambda[k] + (m->dim == 3 ? 4 : 3) * m->mu[k]) / s->unit;
}

// The unit, and the shift. A mode of a body of length l in one material has λ of the order of
// κ volume / (mass l²) (Laplacian: π² of it or more; a beam of thickness t bends at 40 (t/l)² of
// it); in a mixture the harmonic mean of κ bounds from below. A thousandth of that leaves λ − σ
// near λ, and the pivots of K − σM far above rounding.
static tss_result tss__stiffness_open(tss__basis_work *w, tss__stiffness *s) {
    const tss__sub_mesh *m = w->mesh;
    double volume = 0, inverse = 0, g[4][3];
    s->unit = 1;
    for (int k = 0; k < m->cells; k++) {
        double kappa = tss__basis_kappa(w, s, k), v = tss__basis_gradients(w, k, g);
        if (!(v > 0) || !isfinite(v))
            return tss__basis_fail(w, TSS_ERROR_BAD_MESH, "cell %d has no volume", k);
        if (!(kappa > 0) || !isfinite(kappa))
            return tss__basis_fail(w, TSS_ERROR_BAD_MATERIAL,
                                   "cell %d has stiffness %g, expected a positive number", k,
                                   kappa);
        volume += v, inverse += v / kappa;
    }
    double mean = volume / inverse;
    s->unit = tss__basis_power(mean);
    s->shift = 1e-3 * (mean / s->unit) * volume / (w->diagonal * w->diagonal);
    return TSS_OK;
}

// Block of nodes a, b of a cell: vol κ ∇a·∇b, or vol (λ ∇a ∇bᵀ + μ ∇b ∇aᵀ + μ ∇a·∇b I).
static void tss__basis_add_pair(const tss__basis_work *w, const tss__stiffness *s, int k,
                                double vol, const double *ga, const double *gb, double *out) {
    int d = w->mesh->dim;
    double dot = 0, kappa = tss__basis_kappa(w, s, k);
    for (int i = 0; i < d; i++) dot += ga[i] * gb[i];
    if (!s->elastic) {
        *out += vol * kappa * dot;
        return;
    }
    double lambda = w->mesh->lambda[k] / s->unit;
    for (int i = 0; i < d; i++)
        for (int j = 0; j < d; j++)
            out[i * d + j] += vol * ((lambda * (ga[i] * gb[j]) + kappa * (ga[j] * gb[i])) +
                                     (i == j ? kappa * dot : 0));
}

static void tss__basis_row(const tss__basis_work *w, const tss__stiffness *s,
                           const tss__cell_lists *c, int i, const int *at, tss_bcsr *K) {
    const tss__sub_mesh *m = w->mesh;
    int size = m->dim + 1;
    for (int64_t e = c->start[i]; e < c->start[i + 1]; e++) {
        int k = c->list[e], here = 0;
        const int *node = m->cell + (ptrdiff_t)k * size;
        double g[4][3], vol = tss__basis_gradients(w, k, g);
        while (node[here] != i) here++;
        for (int b = 0; b < size; b++)
            tss__basis_add_pair(w, s, k, vol, g[here], g[b],
                                K->val + (K->row[i] + at[node[b]]) * K->d * K->d);
    }
}

static tss_result tss__basis_assemble(tss__basis_work *w, const tss__stiffness *s, tss_bcsr *K) {
    tss__cell_lists c;
    int keep = w->arrays;
    int *at = tss__basis_ints(w, (size_t)w->mesh->nodes);
    if (!at) return tss__basis_no_memory(w);
    tss_result r = tss__cells_of_nodes(w, &c);
    if (r == TSS_OK) r = tss__basis_pattern(w, &c, s->elastic ? w->mesh->dim : 1, K);
    for (int i = 0; r == TSS_OK && i < w->mesh->nodes; i++) {
        for (int64_t e = K->row[i]; e < K->row[i + 1]; e++) at[K->col[e]] = (int)(e - K->row[i]);
        tss__basis_row(w, s, &c, i, at, K);
    }
    tss__basis_release(w, keep);
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>basis_kernel (private)
// What costs no energy: constants (d = 1) or rigid motions (d = dim) of each piece that nothing
// holds. Pieces do not overlap, so one array holds them all: q vectors, each on its own piece.
// ---------------------------------------------------------------------------------------------

typedef struct tss__kernel_space {
    int d, q;      // unknowns a node; vectors a piece
    int pieces;    // connected by cells and not held
    int *piece;    // nodes: number of the piece, −1: held, or not part of the problem
    double *value;  // (nodes·d) × q, orthonormal
    double *coef;  // room for (columns at a time) × pieces × q
} tss__kernel_space;

static int tss__piece_root(int *up, int i) {
    while (up[i] != i) i = up[i] = up[up[i]];
    return i;
}

// piece[i] by union of the cells' nodes, numbered by their lowest node.
static tss_result tss__pieces(tss__basis_work *w, tss__kernel_space *z) {
    const tss__sub_mesh *m = w->mesh;
    int keep = w->arrays, n = m->nodes, size = m->dim + 1;
    int *up = tss__basis_ints(w, (size_t)n), *held = tss__basis_ints(w, (size_t)n);
    if (!up || !held) return tss__basis_no_memory(w);
    for (int i = 0; i < n; i++) up[i] = i;
    for (int k = 0; k < m->cells * size; k++) {
        int a = tss__piece_root(up, m->cell[k / size * size]), b = tss__piece_root(up, m->cell[k]);
        if (a < b) up[b] = a;
        else up[a] = b;
    }
    for (int i = 0; i < n; i++)
        if (w->mask[i]) held[tss__piece_root(up, i)] = 1;
    z->pieces = 0;
    for (int i = 0; i < n; i++) {
        int root = tss__piece_root(up, i);
        z->piece[i] = held[root] ? -1 : root == i ? z->pieces++ : z->piece[root];
    }
    tss__basis_release(w, keep);
    return TSS_OK;
}

// Centres of mass (pieces × dim) and masses of the pieces.
static void tss__piece_centers(const tss__basis_work *w, const tss__kernel_space *z,
                               double *center, double *mass) {
    int dim = w->mesh->dim;
    for (int i = 0; i < w->mesh->nodes; i++) {
        int p = z->piece[i];
        if (p < 0) continue;
        mass[p] += w->share[i];
        for (int a = 0; a < dim; a++)
            center[p * dim + a] += w->share[i] * w->X[(ptrdiff_t)i * dim + a];
    }
    for (int k = 0; k < z->pieces * dim; k++) center[k] /= mass[k / dim];
}

// Vector r of a node: 1; or a translation; or a rotation about the piece's centre.
static void tss__kernel_vector(int dim, int d, int r, const double *y, double *v) {
    for (int a = 0; a < d; a++) v[a] = 0;
    if (r < d) {
        v[r] = 1;
        return;
    }
    int a = dim == 2 ? 0 : (r - 3 + 1) % 3, b = dim == 2 ? 1 : (r - 3 + 2) % 3;
    v[a] = -y[b], v[b] = y[a];
}

// Sums over each piece of share · v_r · v_s.
static void tss__kernel_dots(const tss__basis_work *w, const tss__kernel_space *z, int r, int s,
                             double *sum) {
    memset(sum, 0, (size_t)z->pieces * sizeof(double));
    for (int i = 0; i < w->mesh->nodes; i++) {
        const double *v = z->value + (ptrdiff_t)i * z->d * z->q;
        for (int a = 0; z->piece[i] >= 0 && a < z->d; a++)
            sum[z->piece[i]] += w->share[i] * v[a * z->q + r] * v[a * z->q + s];
    }
}

// v_r −= sum · v_s (s < r), or v_r /= √sum (s = r), piece by piece.
static void tss__kernel_apply(const tss__basis_work *w, const tss__kernel_space *z, int r, int s,
                              const double *sum) {
    for (int i = 0; i < w->mesh->nodes; i++) {
        double *v = z->value + (ptrdiff_t)i * z->d * z->q;
        for (int a = 0; z->piece[i] >= 0 && a < z->d; a++) {
            if (s == r) v[a * z->q + r] /= sqrt(sum[z->piece[i]]);
            else v[a * z->q + r] -= sum[z->piece[i]] * v[a * z->q + s];
        }
    }
}

// Gram–Schmidt, twice for rounding.
static void tss__kernel_orthonormal(const tss__basis_work *w, const tss__kernel_space *z, int k,
                                    double *sum) {
    for (int pass = 0; pass < 2; pass++)
        for (int s = 0; s <= k; s++) {
            tss__kernel_dots(w, z, k, s, sum);
            tss__kernel_apply(w, z, k, s, sum);
        }
}

static tss_result tss__kernel_open(tss__basis_work *w, int d, int columns, tss__kernel_space *z) {
    int n = w->mesh->nodes, dim = w->mesh->dim;
    z->d = d, z->q = d == 1 ? 1 : dim == 2 ? 3 : 6;
    z->piece = tss__basis_ints(w, (size_t)n);
    z->value = tss__basis_doubles(w, (size_t)(n * d) * (size_t)z->q);
    if (!z->piece || !z->value) return tss__basis_no_memory(w);
    tss_result r = tss__pieces(w, z);
    if (r != TSS_OK) return r;
    double *center = tss__basis_doubles(w, (size_t)z->pieces * 3);
    double *sum = tss__basis_doubles(w, (size_t)z->pieces);
    z->coef = tss__basis_doubles(w, (size_t)columns * (size_t)z->pieces * (size_t)z->q);
    if (!center || !sum || !z->coef) return tss__basis_no_memory(w);
    tss__piece_centers(w, z, center, sum);
    for (int i = 0; i < n; i++) {
        double y[3], v[3];
        for (int k = 0; z->piece[i] >= 0 && k < z->q; k++) {
            for (int a = 0; a < dim; a++)
                y[a] = w->X[(ptrdiff_t)i * dim + a] - center[z->piece[i] * dim + a];
            tss__kernel_vector(dim, d, k, y, v);
            for (int a = 0; a < d; a++) z->value[((ptrdiff_t)i * d + a) * z->q + k] = v[a];
        }
    }
    for (int k = 0; k < z->q; k++) tss__kernel_orthonormal(w, z, k, sum);
    return TSS_OK;
}

typedef struct tss__deflate_job {
    const tss__basis_work *w;
    const tss__kernel_space *z;
    double *B;
} tss__deflate_job;

static void tss__deflate_task(int column, int worker, void *arg) {
    const tss__deflate_job *j = (const tss__deflate_job *)arg;
    const tss__kernel_space *z = j->z;
    size_t size = (size_t)z->pieces * (size_t)z->q;
    int n = j->w->mesh->nodes;
    double *c = z->coef + (size_t)column * size, *b = j->B + (ptrdiff_t)column * n * z->d;
    (void)worker;
    memset(c, 0, size * sizeof(double));
    for (int i = 0; i < n; i++) {
        if (z->piece[i] < 0) continue;
        for (int a = 0; a < z->d; a++)
            for (int k = 0; k < z->q; k++)
                c[z->piece[i] * z->q + k] += j->w->share[i] * b[(ptrdiff_t)i * z->d + a] *
                                             z->value[((ptrdiff_t)i * z->d + a) * z->q + k];
    }
    for (int i = 0; i < n; i++) {
        if (z->piece[i] < 0) continue;
        for (int a = 0; a < z->d; a++)
            for (int k = 0; k < z->q; k++)
                b[(ptrdiff_t)i * z->d + a] -= c[z->piece[i] * z->q + k] *
                                              z->value[((ptrdiff_t)i * z->d + a) * z->q + k];
    }
}

// B −= its part in the kernel.
static void tss__deflate(const tss__basis_work *w, const tss__kernel_space *z, int columns,
                         double *B) {
    tss__deflate_job j;
    j.w = w, j.z = z, j.B = B;
    if (z->pieces) tss_parallel(w->host, columns, tss__deflate_task, &j);
}

// Orthonormal vectors of the kernel, `count` of at most pieces × q. Constants that span the body
// (nothing fixed) are the constant and, for each further piece, it against all before it.
static void tss__kernel_emit(const tss__basis_work *w, const tss__kernel_space *z, int whole,
                             int count, double *U) {
    int n = w->mesh->nodes, N = n * z->d;
    double *mass = z->coef, before = 0;
    if (whole) {
        memset(mass, 0, (size_t)z->pieces * sizeof(double));
        for (int i = 0; i < n; i++)
            if (z->piece[i] >= 0) mass[z->piece[i]] += w->share[i];
    }
    for (int k = 0; k < count; k++) {
        int p = k / z->q, r = k % z->q;
        double *u = U + (ptrdiff_t)k * N;
        double low = 0, high = 1;
        if (whole && k) {
            before += mass[k - 1];
            high = sqrt(before / (mass[k] * (before + mass[k])));
            low = -high * mass[k] / before;
        }
        for (int i = 0; i < N; i++) {
            int at = z->piece[i / z->d];
            if (whole) u[i] = at < 0 ? 0 : !k ? 1 : at == k ? high : at < k ? low : 0;
            else u[i] = at == p ? z->value[(ptrdiff_t)i * z->q + r] : 0;
        }
    }
}

// ---------------------------------------------------------------------------------------------
// >>basis_eigen (private)
// The lowest pairs of K u = λ M u by block Lanczos with thick restarts on (K − σM)⁻¹ M, σ < 0, in
// the inner product of M, the kernel kept out exactly. Every block is orthogonalised against the
// whole basis, so the projected matrix is known entry by entry and a restart only has to keep the
// best Ritz vectors. A block method sees as many copies of a multiple eigenvalue as it has columns;
// for those beyond, a found set must survive a fresh random block before it is accepted: without,
// thirty equal pieces gave 8 copies of their lowest eigenvalue, then wrong ones. A fresh block takes
// the place of what was left of the residuals, which the estimate then no longer sees: the residuals
// of the pairs themselves decide, and inverse iteration goes on until they meet the tolerance.
// Cost: one factorisation and solves of 8 right-hand sides (on cubes 26 of them for 16 modes, 64
// for 64, 88 for 100); while it works, modes + 64 or 2 modes + 16 vectors, whichever is more.
// ---------------------------------------------------------------------------------------------

enum { TSS__EIG_BLOCK = 8, TSS__EIG_CYCLES = 60, TSS__EIG_POLISH = 4 };

typedef struct tss__eig {
    tss__basis_work *w;
    int d, N;              // unknowns a node and in all
    int want, room;        // pairs asked for outside the kernel; dimension outside the kernel
    int cap, m;            // most columns of the basis; columns that H knows
    int block;             // columns behind those, orthonormal to them
    int fresh;             // random vectors drawn so far
    int solves;
    double *V;             // N × (cap + block)
    double *H, *Y, *theta, *work;  // cap × cap; its vectors, values
    double *old;           // want: values of the set that a fresh block tests
    double *R;             // block × block: OP V_last = V H + V_next R; 0 for a fresh block
    double *h;             // (cap + block) × block
    double *weight;        // N: shares, one an unknown
    double residual;
    tss__tall tall;
    tss__kernel_space kernel;
    tss__stiffness stiffness;
    tss_bcsr K, S;         // S: the shift's diagonal
    uint8_t *fixed;        // N
    tss_chol *chol;
} tss__eig;

// Start vectors from a hash of the index (splitmix64): the same everywhere, of no symmetry.
static double tss__basis_noise(uint64_t seed, uint64_t i) {
    uint64_t z = (seed << 40) + i * 0x9E3779B97F4A7C15u + 0x632BE59BD9B4E019u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return (double)((z ^ (z >> 31)) >> 11) / 4503599627370496.0 - 1;
}

static double *tss__eig_column(const tss__eig *e, int k) { return e->V + (ptrdiff_t)k * e->N; }

// B (b columns) −= its parts in the kernel and in columns 0..a−1; these are added to h (a × b).
static void tss__eig_project(tss__eig *e, int a, int b, double *B, double *h) {
    size_t size = (size_t)a * (size_t)b;
    tss__deflate(e->w, &e->kernel, b, B);
    tss__tall_project(&e->tall, a, e->V, b, B, e->work);
    for (size_t k = 0; h && k < size; k++) h[k] += e->work[k];
}

// A random unit vector orthogonal to all columns before k.
static void tss__eig_draw(tss__eig *e, int k) {
    double *v = tss__eig_column(e, k);
    e->fresh++;
    for (int i = 0; i < e->N; i++)
        v[i] = e->weight[i] > 0 ? tss__basis_noise((uint64_t)e->fresh, (uint64_t)i) : 0;
    for (int pass = 0; pass < 3; pass++) {
        tss__eig_project(e, k, 1, v, NULL);
        tss__tall_scale(e->N, v, 1 / tss__tall_norm(&e->tall, v));
    }
}

// Columns for the next block: those that fit into the basis and into the space.
static int tss__eig_next(const tss__eig *e) {
    int left = e->room - e->m;
    return left < TSS__EIG_BLOCK ? left : TSS__EIG_BLOCK;
}

static void tss__eig_fresh_block(tss__eig *e) {
    e->block = tss__eig_next(e);
    memset(e->R, 0, TSS__EIG_BLOCK * TSS__EIG_BLOCK * sizeof(double));
    for (int k = 0; k < e->block; k++) tss__eig_draw(e, e->m + k);
}

// X := (K − σM)⁻¹ M X in place.
static tss_result tss__eig_apply(tss__eig *e, int columns, double *X) {
    for (int k = 0; k < columns; k++)
        for (int i = 0; i < e->N; i++) X[(ptrdiff_t)k * e->N + i] *= e->weight[i];
    e->solves++;
    return tss_chol_solve(e->chol, X, columns);
}

// Takes the block into the basis: its columns of H, and the block after it.
static tss_result tss__eig_extend(tss__eig *e) {
    int b = e->block, m = e->m + b, next;
    double *X = tss__eig_column(e, e->m), *W = tss__eig_column(e, m);
    memcpy(W, X, (size_t)b * (size_t)e->N * sizeof(double));
    tss_result r = tss__eig_apply(e, b, W);
    if (r != TSS_OK) return r;
    memset(e->h, 0, (size_t)m * (size_t)b * sizeof(double));
    for (int pass = 0; pass < 2; pass++) tss__eig_project(e, m, b, W, e->h);
    for (int j = 0; j < b; j++)
        for (int i = 0; i < m; i++) {
            double v = e->h[(ptrdiff_t)j * m + i];
            if (i >= e->m) v = 0.5 * (v + e->h[(ptrdiff_t)(i - e->m) * m + e->m + j]);
            e->H[(ptrdiff_t)(e->m + j) * e->cap + i] = e->H[(ptrdiff_t)i * e->cap + e->m + j] = v;
        }
    e->m = m, next = tss__eig_next(e), e->block = next < b ? next : b;
    memset(e->R, 0, TSS__EIG_BLOCK * TSS__EIG_BLOCK * sizeof(double));
    // What the block does not reach any more is drawn afresh; its coupling is 0.
    for (int k = 0; k < e->block; k++) {
        double *coupling = e->R + (ptrdiff_t)k * TSS__EIG_BLOCK;
        if (!tss__tall_join(&e->tall, e->V, m, m + k, coupling, e->work)) tss__eig_draw(e, m + k);
    }
    return TSS_OK;
}

static tss_result tss__eig_ritz(tss__eig *e) {
    for (int j = 0; j < e->m; j++)
        memcpy(e->Y + (ptrdiff_t)j * e->m, e->H + (ptrdiff_t)j * e->cap,
               (size_t)e->m * sizeof(double));
    return tss__symmetric_eigen(e->m, e->Y, e->theta, e->work) ? TSS_OK : TSS_ERROR_SINGULAR;
}

// Largest ‖R y_last‖ / θ over the wanted pairs: how far OP u is from θ u. last: columns of V_last.
static double tss__eig_estimate(const tss__eig *e, int last) {
    double worst = 0;
    if (e->block && e->block < last) return 1;  // the last but one of the whole space: R is cut
    for (int j = 0; j < e->want; j++) {
        const double *y = e->Y + (ptrdiff_t)j * e->m + e->m - last;
        double s = 0;
        for (int i = 0; i < e->block; i++) {
            double t = 0;
            for (int k = i; k < last; k++) t += e->R[k * TSS__EIG_BLOCK + i] * y[k];
            s += t * t;
        }
        worst = fmax(worst, sqrt(s) / e->theta[j]);
    }
    return worst;
}

// Keeps the best `keep` Ritz vectors and the block behind the basis.
static void tss__eig_restart(tss__eig *e, int keep) {
    tss__tall_rotate(&e->tall, e->m, e->V, e->Y, keep, e->V);
    memmove(tss__eig_column(e, keep), tss__eig_column(e, e->m),
            (size_t)e->block * (size_t)e->N * sizeof(double));
    for (int j = 0; j < keep; j++)
        for (int i = 0; i < keep; i++) e->H[(ptrdiff_t)j * e->cap + i] = i == j ? e->theta[j] : 0;
    e->m = keep;
}

// Have the wanted values stood still since the last fresh block?
static int tss__eig_steady(tss__eig *e, double tol) {
    int same = 1;
    for (int j = 0; j < e->want; j++) {
        same &= fabs(e->theta[j] - e->old[j]) <= fmax(10 * tol, 1e-12) * e->theta[j];
        e->old[j] = e->theta[j];
    }
    return same;
}

// One cycle: extends the basis until it is full, or (early) the wanted pairs have converged.
static tss_result tss__eig_cycle(tss__eig *e, int early, double tol, double *estimate) {
    for (;;) {
        int last = e->block;
        tss_result r = tss__eig_extend(e);
        if (r != TSS_OK) return r;
        int full = e->m + e->block > e->cap || e->block == 0;
        if (e->m < e->want || (!full && !early)) continue;
        r = tss__eig_ritz(e);
        if (r != TSS_OK) return r;
        *estimate = tss__eig_estimate(e, last);
        if (full || *estimate <= tol) return TSS_OK;
    }
}

static tss_result tss__eig_lanczos(tss__eig *e) {
    double tol = e->w->def->tol, estimate = 1;
    int keep = e->want + TSS__EIG_BLOCK, early = 1;
    tss__eig_fresh_block(e);
    for (int cycle = 0; cycle < TSS__EIG_CYCLES; cycle++) {
        tss_result r = tss__eig_cycle(e, early, 0.1 * tol, &estimate);
        if (r != TSS_OK) return r;
        if (e->block == 0) return TSS_OK;  // the whole space
        int found = estimate <= 0.1 * tol;
        if (found && tss__eig_steady(e, tol)) return TSS_OK;
        tss__eig_restart(e, keep < e->m ? keep : e->m);
        if (found) tss__eig_fresh_block(e);
        early = !found;
    }
    return tss__basis_fail(e->w, TSS_ERROR_SINGULAR,
                           "the eigensolver stopped at a residual of %.2g, asked for %.2g",
                           estimate, 0.1 * tol);
}

// Residual s = (K − σM)⁻¹ (K u − λ M u) of each pair, λ = uᵀ K u; u − s is one step of inverse
// iteration on, and what is kept. W: a block of scratch, outside of U.
static tss_result tss__eig_polish(tss__eig *e, int count, double *U, double *lambda, double *W) {
    for (int k = 0; k < count; k += TSS__EIG_BLOCK) {
        int b = count - k < TSS__EIG_BLOCK ? count - k : TSS__EIG_BLOCK;
        for (int j = 0; j < b; j++) {
            double *u = U + (ptrdiff_t)(k + j) * e->N, *s = W + (ptrdiff_t)j * e->N, rayleigh = 0;
            tss_bcsr_multiply(e->w->host, &e->K, u, s, 0);
            for (int i = 0; i < e->N; i++) rayleigh += e->weight[i] > 0 ? u[i] * s[i] : 0;
            for (int i = 0; i < e->N; i++)
                s[i] = e->weight[i] > 0 ? s[i] - rayleigh * e->weight[i] * u[i] : 0;
            lambda[k + j] = rayleigh;
        }
        tss_result r = tss_chol_solve(e->chol, W, b);
        e->solves++;
        if (r != TSS_OK) return r;
        tss__deflate(e->w, &e->kernel, b, W);
        for (int j = 0; j < b; j++) {
            double *u = U + (ptrdiff_t)(k + j) * e->N, *s = W + (ptrdiff_t)j * e->N;
            e->residual = fmax(e->residual, tss__tall_norm(&e->tall, s));
            for (int i = 0; i < e->N; i++) u[i] -= s[i];
        }
    }
    return TSS_OK;
}

// Order by value (stable). The polished vectors are orthonormal only to the residual: Gram–Schmidt
// makes it exact.
static void tss__eig_finish(tss__eig *e, int count, double *lambda) {
    for (int k = 0; k < count; k++)
        for (int j = k; j > 0 && lambda[j] < lambda[j - 1]; j--) {
            tss__swap_columns(1, lambda + j, lambda + j - 1);
            tss__swap_columns(e->N, tss__eig_column(e, j), tss__eig_column(e, j - 1));
        }
    for (int k = 0; k < count; k++) {
        double *u = tss__eig_column(e, k);
        for (int pass = 0; pass < 2; pass++) {
            tss__eig_project(e, k, 1, u, NULL);
            tss__tall_scale(e->N, u, 1 / tss__tall_norm(&e->tall, u));
        }
        tss__tall_sign(e->N, u);
    }
}

// K − σM = K + S, factored; a shift too small to be seen in the pivots grows until it is.
static tss_result tss__eig_factor(tss__eig *e) {
    tss__basis_work *w = e->w;
    tss_chol_def def = tss_chol_def_default();
    int n = w->mesh->nodes, d = e->d;
    tss_result r = tss_bcsr_reserve(w->host, &e->S, n, d, n);
    if (r != TSS_OK) return tss__basis_no_memory(w);
    memset(e->S.val, 0, (size_t)n * (size_t)(d * d) * sizeof(double));
    for (int i = 0; i <= n; i++) e->S.row[i] = i;
    for (int i = 0; i < n; i++) e->S.col[i] = i;
    r = tss_chol_create(w->host, &def, &e->chol);
    if (r == TSS_OK) r = tss_chol_analyze(e->chol, &e->K, &e->S);
    for (int attempt = 0; r == TSS_OK && attempt < 8; attempt++) {
        for (int i = 0; i < n; i++)
            for (int a = 0; a < d; a++)
                e->S.val[(ptrdiff_t)i * d * d + a * d + a] = e->stiffness.shift * w->share[i];
        r = tss_chol_factor(e->chol, &e->K, &e->S, e->fixed);
        if (r != TSS_ERROR_SINGULAR) break;
        e->stiffness.shift *= 16, r = attempt < 7 ? TSS_OK : r;
    }
    if (r == TSS_ERROR_SINGULAR)
        return tss__basis_fail(w, r, "the stiffness matrix is not positive semi-definite");
    return r == TSS_OK ? r : tss__basis_no_memory(w);
}

static tss_result tss__eig_arrays(tss__eig *e, int count) {
    tss__basis_work *w = e->w;
    int b = TSS__EIG_BLOCK;
    // Twice the wanted vectors, and room for six blocks; no more than there are.
    e->cap = 2 * e->want > e->want + 6 * b ? 2 * e->want : e->want + 6 * b;
    if (e->cap > e->room) e->cap = e->room;
    int most = e->cap + b > count ? e->cap + b : count;
    size_t cap = (size_t)(e->cap > 0 ? e->cap : 1), wide = (size_t)most, N = (size_t)e->N;
    e->V = tss__basis_doubles(w, N * (wide + (size_t)b));
    e->H = tss__basis_doubles(w, cap * cap), e->Y = tss__basis_doubles(w, cap * cap);
    e->theta = tss__basis_doubles(w, cap), e->work = tss__basis_doubles(w, wide * (size_t)b);
    e->old = tss__basis_doubles(w, (size_t)e->want);
    e->R = tss__basis_doubles(w, (size_t)(b * b)), e->h = tss__basis_doubles(w, wide * (size_t)b);
    if (!e->V || !e->H || !e->Y || !e->theta || !e->work || !e->old || !e->R || !e->h)
        return tss__basis_no_memory(w);
    return tss__tall_open(w, &e->tall, e->N, e->weight, most, most * b);
}

static tss_result tss__eig_solve(tss__eig *e, int count, double *lambda) {
    int given = e->kernel.pieces * e->kernel.q;
    if (given > count) given = count;
    e->want = count - given;
    tss_result r = tss__eig_arrays(e, count);
    if (r == TSS_OK && e->want) r = tss__eig_factor(e);
    if (r == TSS_OK && e->want) r = tss__eig_lanczos(e);
    if (r != TSS_OK) return r;
    double *U = tss__eig_column(e, given), *W = tss__eig_column(e, count);
    if (e->want) tss__tall_rotate(&e->tall, e->m, e->V, e->Y, e->want, e->V);
    memmove(U, e->V, (size_t)e->want * (size_t)e->N * sizeof(double));
    // The kernel stays out of the finished vectors by projection, so it is put in last.
    double *V = e->V;
    for (int pass = 0; pass < TSS__EIG_POLISH; pass++) {
        e->residual = 0;
        if ((r = tss__eig_polish(e, e->want, U, lambda + given, W)) != TSS_OK) return r;
        e->V = U;
        tss__eig_finish(e, e->want, lambda + given);
        e->V = V;
        if (e->residual <= e->w->def->tol) break;
    }
    tss__kernel_emit(e->w, &e->kernel, e->d == 1 && !e->w->fixed, given, V);
    return TSS_OK;
}

// The `count` lowest pairs: e->V gets the columns, N × count, e->K and the factor stay until
// tss__eig_close. λ in units of stiffness.unit · scale^(dim−2) / mass.
static tss_result tss__eig_open(tss__eig *e, tss__basis_work *w, int elastic, int count,
                                double *lambda) {
    memset(e, 0, sizeof *e);
    e->w = w, e->d = elastic ? w->mesh->dim : 1, e->N = w->mesh->nodes * e->d;
    e->stiffness.elastic = elastic, e->stiffness.weighted = w->def->heterogeneous;
    tss_result r = tss__stiffness_open(w, &e->stiffness);
    if (r == TSS_OK) r = tss__kernel_open(w, e->d, TSS__EIG_BLOCK, &e->kernel);
    if (r != TSS_OK) return r;
    e->room = w->active * e->d - e->kernel.pieces * e->kernel.q;
    e->weight = tss__basis_doubles(w, (size_t)e->N);
    e->fixed = (uint8_t *)tss__basis_take(w, (size_t)e->N, 1);
    if (!e->weight || !e->fixed) return tss__basis_no_memory(w);
    for (int i = 0; i < e->N; i++)
        e->weight[i] = w->share[i / e->d], e->fixed[i] = w->mask[i / e->d];
    r = tss__basis_assemble(w, &e->stiffness, &e->K);
    if (r == TSS_OK) r = tss__eig_solve(e, count, lambda);
    if (r == TSS_OK && !(e->residual <= w->def->tol))
        r = tss__basis_fail(w, TSS_ERROR_SINGULAR,
                            "an eigenpair has residual %.2g, asked for %.2g", e->residual,
                            w->def->tol);
    return r;
}

static void tss__eig_close(tss__eig *e) {
    tss_chol_destroy(e->chol);
    tss_bcsr_free(e->w->host, &e->K), tss_bcsr_free(e->w->host, &e->S);
}

// One unit of λ as computed: stiffness · length^(dim−2) / mass.
static double tss__eig_unit(const tss__eig *e) {
    double f = e->stiffness.unit / e->w->mass;
    return e->w->mesh->dim == 3 ? f * e->w->scale : f;
}

// ---------------------------------------------------------------------------------------------
// >>basis_result (private)
// ---------------------------------------------------------------------------------------------

static size_t tss__basis_value_count(const tss__basis *b) {
    return (size_t)b->nodes * (size_t)(b->vector ? b->dim : 1) * (size_t)b->columns;
}

static size_t tss__basis_transform_count(const tss__basis *b) {
    return (size_t)b->blocks * (size_t)((b->dim + 1) * (b->dim + 1));
}

static size_t tss__basis_weight_count(const tss__basis *b) {
    return (size_t)b->nodes * (size_t)b->blocks;
}

static void tss__basis_free(const tss_host *host, tss__basis *b) {
    size_t blocks = (size_t)b->blocks;
    tss_free(host, b->first, (blocks + 1) * sizeof(int));
    tss_free(host, b->handle, blocks * sizeof(int));
    tss_free(host, b->eigenvalue, blocks * sizeof(double));
    tss_free(host, b->weight, tss__basis_weight_count(b) * sizeof(double));
    tss_free(host, b->transform, tss__basis_transform_count(b) * sizeof(double));
    tss_free(host, b->value, tss__basis_value_count(b) * sizeof(double));
    memset(b, 0, sizeof *b);
}

// Memory that stays with the basis, cleared.
static void *tss__basis_keep(tss__basis_work *w, tss__basis *b, size_t count, size_t item) {
    if (count > (SIZE_MAX / 2) / item) return NULL;
    void *p = tss_alloc(w->host, count * item);
    if (!p) return NULL;
    memset(p, 0, count * item);
    b->bytes += count * item;
    return p;
}

typedef enum tss__basis_form { TSS__FACTORED, TSS__SCALARS, TSS__VECTORS } tss__basis_form;

// Sizes and arrays; blocks of equal size.
static tss_result tss__basis_shape(tss__basis_work *w, tss__basis *b, tss__basis_form form,
                                   int blocks, int columns, int eigenvalues) {
    b->blocks = blocks, b->columns = columns, b->vector = form == TSS__VECTORS;
    b->mass = w->mass;
    memcpy(b->center, w->center, sizeof b->center);
    size_t n = (size_t)blocks;
    int ok = (b->first = (int *)tss__basis_keep(w, b, n + 1, sizeof(int))) != NULL;
    if (ok && form == TSS__FACTORED) {
        b->weight = (double *)tss__basis_keep(w, b, tss__basis_weight_count(b), sizeof(double));
        b->transform =
            (double *)tss__basis_keep(w, b, tss__basis_transform_count(b), sizeof(double));
        ok = b->weight && b->transform;
    } else if (ok) {
        b->value = (double *)tss__basis_keep(w, b, tss__basis_value_count(b), sizeof(double));
        ok = b->value != NULL;
    }
    if (ok && eigenvalues)
        ok = (b->eigenvalue = (double *)tss__basis_keep(w, b, n, sizeof(double))) != NULL;
    if (!ok) return tss__basis_no_memory(w);
    for (int k = 0; k <= blocks; k++) b->first[k] = columns / blocks * k;
    return TSS_OK;
}

// Row-major columns from column-major vectors.
static void tss__basis_store(const tss__basis *b, int rows, const double *U) {
    for (int i = 0; i < rows; i++)
        for (int k = 0; k < b->columns; k++)
            b->value[(size_t)i * (size_t)b->columns + (size_t)k] = U[(ptrdiff_t)k * rows + i];
}

// ---------------------------------------------------------------------------------------------
// >>basis_blocks (private)
// Orthonormal functions inside a block: Gram–Schmidt on the block's Gram matrix, as a triangular
// factor T on the functions as given. Once more on the result removes what the squared condition
// number of the first pass left. A function is dropped (a row of 0) when less than 1e-6 of it is
// new: below, its square is within a few digits of the Gram matrix' rounding.
// ---------------------------------------------------------------------------------------------

enum { TSS__BLOCK_MAX = 6 };  // functions a block: 4 affine, 6 quadratic in 3D

// T := L⁻¹ T for G = L Lᵀ, both q × q.
static void tss__basis_triangle(int q, double *G, double *T) {
    for (int k = 0; k < q; k++) {
        double whole = G[k * q + k];
        for (int j = 0; j < k; j++) {
            double s = G[k * q + j];
            for (int i = 0; i < j; i++) s -= G[k * q + i] * G[j * q + i];
            G[k * q + j] = G[j * q + j] > 0 ? s / G[j * q + j] : 0;
            G[k * q + k] -= G[k * q + j] * G[k * q + j];
        }
        double pivot = G[k * q + k] > 1e-12 * whole ? sqrt(G[k * q + k]) : 0;
        G[k * q + k] = pivot;
        for (int c = 0; c < q; c++) {
            double s = T[k * q + c];
            for (int j = 0; j < k; j++) s -= G[k * q + j] * T[j * q + c];
            T[k * q + c] = pivot > 0 ? s / pivot : 0;
        }
    }
}

// The functions of node i as given: weight · (1, X), or the products of its coordinates.
static void tss__basis_raw(const tss__basis_work *w, int i, int quadratic, double weight,
                           double *f) {
    int d = w->mesh->dim, at = 0;
    const double *x = w->X + (ptrdiff_t)i * d;
    if (quadratic) {
        for (int a = 0; a < d; a++)
            for (int b = a; b < d; b++) f[at++] = weight * (x[a] * x[b]);
        return;
    }
    f[at++] = weight;
    for (int a = 0; a < d; a++) f[at++] = weight * x[a];
}

static void tss__basis_transform(int q, const double *T, const double *f, double *out) {
    for (int k = 0; k < q; k++) {
        double s = 0;
        for (int j = 0; j <= k; j++) s += T[k * q + j] * f[j];
        out[k] = s;
    }
}

// T (q × q, lower) of the block whose node i has weight[i·stride].
static void tss__basis_block(const tss__basis_work *w, int q, int quadratic, const double *weight,
                             int stride, double *T) {
    double f[TSS__BLOCK_MAX], v[TSS__BLOCK_MAX], G[TSS__BLOCK_MAX * TSS__BLOCK_MAX];
    for (int k = 0; k < q * q; k++) T[k] = k % (q + 1) == 0;
    for (int pass = 0; pass < 2; pass++) {
        memset(G, 0, sizeof G);
        for (int i = 0; i < w->mesh->nodes; i++) {
            if (w->mask[i]) continue;
            tss__basis_raw(w, i, quadratic, weight[(ptrdiff_t)i * stride], f);
            tss__basis_transform(q, T, f, v);
            for (int k = 0; k < q; k++)
                for (int j = 0; j <= k; j++) G[k * q + j] += w->share[i] * (v[k] * v[j]);
        }
        tss__basis_triangle(q, G, T);
    }
}

typedef struct tss__block_job {
    const tss__basis_work *w;
    tss__basis *b;
} tss__block_job;

static void tss__basis_block_task(int block, int worker, void *arg) {
    const tss__block_job *j = (const tss__block_job *)arg;
    int q = j->b->dim + 1;
    double *T = j->b->transform + (ptrdiff_t)block * q * q;
    (void)worker;
    tss__basis_block(j->w, q, 0, j->b->weight + block, j->b->blocks, T);
    // From normalised coordinates to metres.
    for (int k = 0; k < q; k++)
        for (int c = 1; c < q; c++) T[k * q + c] /= j->w->scale;
}

static void tss__basis_factored(tss__basis_work *w, tss__basis *b) {
    tss__block_job j;
    j.w = w, j.b = b;
    tss_parallel(w->host, b->blocks, tss__basis_block_task, &j);
}

// 1 where nothing is fixed (there is nothing to do for nodes without mass, so they go along).
static double tss__basis_one(const tss__basis_work *w, int i) {
    return w->mesh->fixed && w->mesh->fixed[i] ? 0 : 1;
}

static tss_result tss__basis_build_affine(tss__basis_work *w, tss__basis *b) {
    tss_result r = tss__basis_open(w, 0);
    if (r == TSS_OK) r = tss__basis_shape(w, b, TSS__FACTORED, 1, b->dim + 1, 0);
    if (r != TSS_OK) return r;
    for (int i = 0; i < b->nodes; i++) b->weight[i] = tss__basis_one(w, i);
    tss__basis_factored(w, b);
    return TSS_OK;
}

static tss_result tss__basis_build_quadratic(tss__basis_work *w, tss__basis *b) {
    double f[TSS__BLOCK_MAX], T[2][TSS__BLOCK_MAX * TSS__BLOCK_MAX];
    int d = b->dim, q[2] = {d + 1, d * (d + 1) / 2};
    tss_result r = tss__basis_open(w, 0);
    double *one = r == TSS_OK ? tss__basis_doubles(w, (size_t)b->nodes) : NULL;
    if (r == TSS_OK && !one) r = tss__basis_no_memory(w);
    if (r == TSS_OK) r = tss__basis_shape(w, b, TSS__SCALARS, 2, q[0] + q[1], 0);
    if (r != TSS_OK) return r;
    b->first[1] = q[0], b->first[2] = q[0] + q[1];
    for (int i = 0; i < b->nodes; i++) one[i] = tss__basis_one(w, i);
    for (int k = 0; k < 2; k++) tss__basis_block(w, q[k], k, one, 1, T[k]);
    for (int i = 0; i < b->nodes; i++)
        for (int k = 0; k < 2; k++) {
            tss__basis_raw(w, i, k, one[i], f);
            tss__basis_transform(q[k], T[k], f, b->value + (ptrdiff_t)i * b->columns + b->first[k]);
        }
    return TSS_OK;
}

static tss_result tss__basis_build_skinning(tss__basis_work *w, tss__basis *b) {
    tss__eig e;
    tss_result r = tss__basis_open(w, 1);
    int constant = w->fixed == 0, blocks = w->def->count + constant, most = w->active - constant;
    if (r != TSS_OK) return r;
    if (w->def->count > most)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT,
                               "%d handles, but the body has room for %d (%d free nodes%s)",
                               w->def->count, most, w->active,
                               constant ? ", less the constant" : "");
    r = tss__basis_shape(w, b, TSS__FACTORED, blocks, blocks * (b->dim + 1), 1);
    if (r != TSS_OK) return r;
    r = tss__eig_open(&e, w, 0, blocks, b->eigenvalue);
    for (int i = 0; r == TSS_OK && i < b->nodes; i++) {
        double *row = b->weight + (ptrdiff_t)i * blocks;
        for (int k = 0; k < blocks; k++) row[k] = tss__eig_column(&e, k)[i];
        if (constant) row[0] = 1;
    }
    for (int k = 0; r == TSS_OK && k < blocks; k++) b->eigenvalue[k] *= tss__eig_unit(&e);
    b->residual = e.residual, b->iterations = e.solves;
    tss__eig_close(&e);
    if (r == TSS_OK) tss__basis_factored(w, b);
    return r;
}

static tss_result tss__basis_build_eigen(tss__basis_work *w, tss__basis *b) {
    tss__eig e;
    tss_result r = tss__basis_open(w, 1);
    if (r != TSS_OK) return r;
    if (w->def->count > w->active * b->dim)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT, "%d modes, but the body has %d unknowns",
                               w->def->count, w->active * b->dim);
    r = tss__basis_shape(w, b, TSS__VECTORS, w->def->count, w->def->count, 1);
    if (r != TSS_OK) return r;
    r = tss__eig_open(&e, w, 1, b->columns, b->eigenvalue);
    if (r == TSS_OK) tss__basis_store(b, b->nodes * b->dim, e.V);
    for (int k = 0; r == TSS_OK && k < b->blocks; k++) b->eigenvalue[k] *= tss__eig_unit(&e);
    b->residual = e.residual, b->iterations = e.solves;
    tss__eig_close(&e);
    return r;
}

// Columns of your own, or room for them.
static tss_result tss__basis_build_given(tss__basis_work *w, tss__basis *b) {
    const tss_basis_def *d = w->def;
    tss_result r = tss__basis_open(w, 0);
    if (r != TSS_OK) return r;
    int blocks = d->block ? d->block[d->count - 1] + 1 : d->count;
    r = tss__basis_shape(w, b, d->scalars ? TSS__SCALARS : TSS__VECTORS, blocks, d->count, 0);
    if (r != TSS_OK) return r;
    for (int k = 0; d->block && k < d->count; k++) b->first[d->block[k] + 1] = k + 1;
    if (d->kind == TSS_BASIS_ARRAYS)
        memcpy(b->value, d->scalars ? d->scalars : d->vectors,
               tss__basis_value_count(b) * sizeof(double));
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>basis_biharmonic (private)
// Q w = 0 with w = 0 or 1 at handles and 0 at fixed nodes, Q = L M⁻¹ L. cond Q is the square of
// cond L, so the factor of Q only corrects: residuals are taken as −L M⁻¹ (L w), whose rounding is
// that of the smooth L w. The sum of all functions, which is 1 where nothing is fixed, is off by
// 4e-14 after one correction and 2e-15 after two (64 handles, 4,913 nodes).
// ---------------------------------------------------------------------------------------------

enum { TSS__HANDLE_GROUP = 16, TSS__FIXED_SAMPLE = 1024 };

typedef struct tss__biharmonic {
    tss__basis_work *w;
    int n;
    tss__kernel_space kernel;
    double *inverse;  // n: 1 over the share of mass, fixed nodes too
    uint8_t *fixed;   // n: masked, or a handle
    tss_bcsr L, Q;
    tss_chol *chol;
    double *x, *r;    // n × TSS__HANDLE_GROUP
    double *t;        // n
} tss__biharmonic;

// Lowers near[i] to the squared distance from node h, within its own piece (held ones are one).
static void tss__handle_near(const tss__biharmonic *q, int h, double *near) {
    int d = q->w->mesh->dim;
    const double *x = q->w->X;
    for (int i = 0; i < q->n; i++) {
        double s = 0;
        if (q->kernel.piece[i] != q->kernel.piece[h]) continue;
        for (int a = 0; a < d; a++) {
            double e = x[(ptrdiff_t)i * d + a] - x[(ptrdiff_t)h * d + a];
            s += e * e;
        }
        if (s < near[i]) near[i] = s;
    }
}

// The node farthest from all handles; where there are none in its piece, from the centre.
static int tss__handle_next(const tss__biharmonic *q, const double *near) {
    int d = q->w->mesh->dim, best = -1;
    double far = 0, out = 0;
    for (int i = 0; i < q->n; i++) {
        const double *x = q->w->X + (ptrdiff_t)i * d;
        if (q->w->mask[i] || near[i] < 0) continue;
        double r = x[0] * x[0] + x[1] * x[1] + (d == 3 ? x[2] * x[2] : 0);
        if (best < 0 || near[i] > far || (near[i] == far && far == INFINITY && r > out))
            best = i, far = near[i], out = r;
    }
    return best;
}

// Farthest points, kept away from fixed nodes too; of many of those every k-th stands for all.
static tss_result tss__handles(tss__biharmonic *q, int count, int *handle) {
    tss__basis_work *w = q->w;
    double *near = tss__basis_doubles(w, (size_t)q->n);
    int every = w->fixed / TSS__FIXED_SAMPLE + 1, seen = 0;
    if (!near) return tss__basis_no_memory(w);
    if (q->kernel.pieces > count)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT,
                               "%d handles, but the body has %d pieces that need one each", count,
                               q->kernel.pieces);
    for (int i = 0; i < q->n; i++) near[i] = INFINITY;
    for (int i = 0; w->fixed && i < q->n; i++)
        if (w->mesh->fixed[i] && !w->idle[i] && seen++ % every == 0) tss__handle_near(q, i, near);
    for (int k = 0; k < count; k++) {
        handle[k] = tss__handle_next(q, near);
        tss__handle_near(q, handle[k], near);
        near[handle[k]] = -1;
    }
    return TSS_OK;
}

// Columns of row a of L M⁻¹ L, ascending; seen[j] == a + 1 marks them.
static int tss__square_row(const tss_bcsr *L, int a, int *seen, int *out) {
    int count = 0;
    for (int64_t e = L->row[a]; e < L->row[a + 1]; e++)
        for (int64_t f = L->row[L->col[e]]; f < L->row[L->col[e] + 1]; f++) {
            int j = L->col[f], at;
            if (seen[j] == a + 1) continue;
            seen[j] = a + 1;
            for (at = count++; at > 0 && out[at - 1] > j; at--) out[at] = out[at - 1];
            out[at] = j;
        }
    return count;
}

static void tss__square_values(const tss__biharmonic *q, int a, int *at) {
    const tss_bcsr *L = &q->L, *Q = &q->Q;
    for (int64_t e = Q->row[a]; e < Q->row[a + 1]; e++) {
        at[Q->col[e]] = (int)(e - Q->row[a]);
        Q->val[e] = 0;
    }
    for (int64_t e = L->row[a]; e < L->row[a + 1]; e++) {
        int i = L->col[e];
        for (int64_t f = L->row[i]; f < L->row[i + 1]; f++)
            Q->val[Q->row[a] + at[L->col[f]]] += q->inverse[i] * (L->val[e] * L->val[f]);
    }
}

static tss_result tss__square(tss__biharmonic *q) {
    tss__basis_work *w = q->w;
    int keep = w->arrays;
    int *seen = tss__basis_ints(w, (size_t)q->n), *row = tss__basis_ints(w, (size_t)q->n);
    int64_t blocks = 0;
    if (!seen || !row) return tss__basis_no_memory(w);
    for (int a = 0; a < q->n; a++) blocks += tss__square_row(&q->L, a, seen, row);
    if (tss_bcsr_reserve(w->host, &q->Q, q->n, 1, blocks) != TSS_OK) return tss__basis_no_memory(w);
    memset(seen, 0, (size_t)q->n * sizeof(int));
    q->Q.row[0] = 0;
    for (int a = 0; a < q->n; a++)
        q->Q.row[a + 1] =
            q->Q.row[a] + tss__square_row(&q->L, a, seen, q->Q.col + q->Q.row[a]);
    for (int a = 0; a < q->n; a++) tss__square_values(q, a, row);
    tss__basis_release(w, keep);
    return TSS_OK;
}

// r = −L M⁻¹ L x, 0 at handles and fixed nodes.
static void tss__biharmonic_residual(tss__biharmonic *q, const double *x, double *r) {
    tss_bcsr_multiply(q->w->host, &q->L, x, r, 0);
    for (int i = 0; i < q->n; i++) q->t[i] = r[i] * q->inverse[i];
    tss_bcsr_multiply(q->w->host, &q->L, q->t, r, 0);
    for (int i = 0; i < q->n; i++) r[i] = q->fixed[i] ? 0 : -r[i];
}

// The functions of `count` handles, as columns of q->x; unit norm.
static tss_result tss__biharmonic_group(tss__biharmonic *q, const int *handle, int count) {
    memset(q->x, 0, (size_t)count * (size_t)q->n * sizeof(double));
    for (int k = 0; k < count; k++) q->x[(ptrdiff_t)k * q->n + handle[k]] = 1;
    for (int step = 0; step < 2; step++) {
        for (int k = 0; k < count; k++)
            tss__biharmonic_residual(q, q->x + (ptrdiff_t)k * q->n, q->r + (ptrdiff_t)k * q->n);
        tss_result r = tss_chol_solve(q->chol, q->r, count);
        if (r != TSS_OK) return tss__basis_no_memory(q->w);
        for (ptrdiff_t i = 0; i < (ptrdiff_t)count * q->n; i++) q->x[i] += q->r[i];
    }
    for (int k = 0; k < count; k++) {
        double *x = q->x + (ptrdiff_t)k * q->n, s = 0;
        for (int i = 0; i < q->n; i++) s += q->w->share[i] * (x[i] * x[i]);
        tss__tall_scale(q->n, x, 1 / sqrt(s));
    }
    return TSS_OK;
}

static tss_result tss__biharmonic_open(tss__biharmonic *q, tss__basis_work *w) {
    tss__stiffness unit;
    size_t n = (size_t)w->mesh->nodes, group = TSS__HANDLE_GROUP;
    memset(&unit, 0, sizeof unit);
    q->inverse = tss__basis_doubles(w, n), q->t = tss__basis_doubles(w, n);
    q->x = tss__basis_doubles(w, n * group), q->r = tss__basis_doubles(w, n * group);
    q->fixed = (uint8_t *)tss__basis_take(w, n, 1);
    if (!q->inverse || !q->t || !q->x || !q->r || !q->fixed) return tss__basis_no_memory(w);
    for (size_t i = 0; i < n; i++)
        q->inverse[i] = w->idle[i] ? 0 : w->mass / w->mesh->mass[i], q->fixed[i] = w->mask[i];
    tss_result r = tss__stiffness_open(w, &unit);
    if (r == TSS_OK) r = tss__kernel_open(w, 1, 1, &q->kernel);
    if (r == TSS_OK) r = tss__basis_assemble(w, &unit, &q->L);
    return r == TSS_OK ? tss__square(q) : r;
}

static tss_result tss__biharmonic_factor(tss__biharmonic *q, const int *handle, int count) {
    tss_chol_def def = tss_chol_def_default();
    for (int k = 0; k < count; k++) q->fixed[handle[k]] = 1;
    tss_result r = tss_chol_create(q->w->host, &def, &q->chol);
    if (r == TSS_OK) r = tss_chol_analyze(q->chol, &q->Q, NULL);
    if (r == TSS_OK) r = tss_chol_factor(q->chol, &q->Q, NULL, q->fixed);
    if (r == TSS_ERROR_SINGULAR)
        return tss__basis_fail(q->w, r, "the bi-Laplacian of this mesh is singular to rounding");
    return r == TSS_OK ? r : tss__basis_no_memory(q->w);
}

static tss_result tss__biharmonic_solve(tss__biharmonic *q, tss__basis *b) {
    int count = b->columns;
    tss_result r = tss__biharmonic_open(q, q->w);
    if (r == TSS_OK) r = tss__handles(q, count, b->handle);
    if (r == TSS_OK) r = tss__biharmonic_factor(q, b->handle, count);
    for (int k = 0; r == TSS_OK && k < count; k += TSS__HANDLE_GROUP) {
        int g = count - k < TSS__HANDLE_GROUP ? count - k : TSS__HANDLE_GROUP;
        r = tss__biharmonic_group(q, b->handle + k, g);
        for (int i = 0; r == TSS_OK && i < q->n; i++)
            for (int c = 0; c < g; c++)
                b->value[(ptrdiff_t)i * count + k + c] = q->x[(ptrdiff_t)c * q->n + i];
    }
    return r;
}

static tss_result tss__basis_keep_handles(tss__basis_work *w, tss__basis *b) {
    b->handle = (int *)tss__basis_keep(w, b, (size_t)b->blocks, sizeof(int));
    return b->handle ? TSS_OK : tss__basis_no_memory(w);
}

static tss_result tss__basis_build_biharmonic(tss__basis_work *w, tss__basis *b) {
    tss__biharmonic q;
    tss_result r = tss__basis_open(w, 1);
    if (r != TSS_OK) return r;
    if (w->def->count > w->active)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT, "%d handles, but %d free nodes in cells",
                               w->def->count, w->active);
    r = tss__basis_shape(w, b, TSS__SCALARS, w->def->count, w->def->count, 0);
    if (r == TSS_OK) r = tss__basis_keep_handles(w, b);
    if (r != TSS_OK) return r;
    memset(&q, 0, sizeof q);
    q.w = w, q.n = b->nodes;
    r = tss__biharmonic_solve(&q, b);
    tss_chol_destroy(q.chol);
    tss_bcsr_free(w->host, &q.L), tss_bcsr_free(w->host, &q.Q);
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>basis_pod (private)
// D = Q R by block Gram–Schmidt in the inner product of mass, then the singular values of R by
// one-sided Jacobi rotations: accurate to 1e-15 of the largest, where the Gram matrix of the
// snapshots would lose half the digits. Cost: 4 n d s² for s snapshots, and n d s doubles.
// ---------------------------------------------------------------------------------------------

enum { TSS__POD_BLOCK = 8, TSS__POD_SWEEPS = 40 };

typedef struct tss__pod {
    tss__basis_work *w;
    int N, s, rank;
    double *D;         // N × s: displacements in normalised units, then Q
    double *R;         // s × s: R[i + j·s], i < rank
    double *J, *sigma; // s × s, s
    double *c;         // s × TSS__POD_BLOCK
    double noise;      // of the displacements: rounding of the positions
    double *weight;
    tss__tall tall;
} tss__pod;

static void tss__pod_load(tss__pod *p) {
    const tss__sub_mesh *m = p->w->mesh;
    for (int i = 0; i < p->N; i++) {
        p->weight[i] = p->w->share[i / m->dim];
        for (int j = 0; j < p->s; j++) {
            double x = p->w->def->snapshots[(size_t)j * (size_t)p->N + (size_t)i];
            p->noise = fmax(p->noise, 4.4e-16 * (fabs(x) / p->w->scale));
            p->D[(ptrdiff_t)j * p->N + i] =
                m->fixed && m->fixed[i / m->dim] ? 0 : (x - m->X[i]) / p->w->scale;
        }
    }
    p->noise *= sqrt((double)p->s);
}

// Columns j .. j + b − 1 of D against Q and each other; those that are new join Q.
static void tss__pod_block(tss__pod *p, int j, int b) {
    int from = p->rank;
    double *B = p->D + (ptrdiff_t)j * p->N;
    for (int pass = 0; pass < 2; pass++) {
        tss__tall_project(&p->tall, from, p->D, b, B, p->c);
        for (int k = 0; k < b; k++)
            for (int i = 0; i < from; i++)
                p->R[(ptrdiff_t)(j + k) * p->s + i] += p->c[k * from + i];
    }
    for (int k = 0; k < b; k++) {
        double *at = p->D + (ptrdiff_t)p->rank * p->N, *v = B + (ptrdiff_t)k * p->N;
        if (at != v) memcpy(at, v, (size_t)p->N * sizeof(double));
        p->rank += tss__tall_join(&p->tall, p->D, from, p->rank,
                                  p->R + (ptrdiff_t)(j + k) * p->s + from, p->c);
    }
}

// Rotates rows i and k of R (rank × s) to be orthogonal, the columns of J with them; 0: they are.
static int tss__pod_rotate(tss__pod *p, int i, int k) {
    double aa = 0, bb = 0, ab = 0;
    for (int j = 0; j < p->s; j++) {
        double x = p->R[(ptrdiff_t)j * p->s + i], y = p->R[(ptrdiff_t)j * p->s + k];
        aa += x * x, bb += y * y, ab += x * y;
    }
    if (!(fabs(ab) > 1e-15 * sqrt(aa * bb))) return 0;
    double zeta = (bb - aa) / (2 * ab), t = 1 / (fabs(zeta) + sqrt(1 + zeta * zeta));
    double c, s;
    if (zeta < 0) t = -t;
    c = 1 / sqrt(1 + t * t), s = c * t;
    for (int j = 0; j < p->s; j++) {
        double *x = p->R + (ptrdiff_t)j * p->s + i, *y = p->R + (ptrdiff_t)j * p->s + k, v = *x;
        *x = c * v - s * *y, *y = s * v + c * *y;
    }
    for (int j = 0; j < p->rank; j++) {
        double *x = p->J + (ptrdiff_t)i * p->rank + j, *y = p->J + (ptrdiff_t)k * p->rank + j;
        double v = *x;
        *x = c * v - s * *y, *y = s * v + c * *y;
    }
    return 1;
}

// R = J Σ Vᵀ: singular values descending, J's columns with them.
static void tss__pod_svd(tss__pod *p) {
    int r = p->rank, turned = 1;
    for (int i = 0; i < r * r; i++) p->J[i] = i % (r + 1) == 0;
    for (int sweep = 0; turned && sweep < TSS__POD_SWEEPS; sweep++) {
        turned = 0;
        for (int i = 0; i < r; i++)
            for (int k = i + 1; k < r; k++) turned |= tss__pod_rotate(p, i, k);
    }
    for (int i = 0; i < r; i++) {
        double s = 0;
        for (int j = 0; j < p->s; j++)
            s += p->R[(ptrdiff_t)j * p->s + i] * p->R[(ptrdiff_t)j * p->s + i];
        p->sigma[i] = sqrt(s);
        for (int k = i; k > 0 && p->sigma[k] > p->sigma[k - 1]; k--) {
            tss__swap_columns(1, p->sigma + k, p->sigma + k - 1);
            tss__swap_columns(r, p->J + (ptrdiff_t)k * r, p->J + (ptrdiff_t)(k - 1) * r);
        }
    }
}

static tss_result tss__pod_open(tss__pod *p, tss__basis_work *w) {
    size_t N = (size_t)(w->mesh->nodes * w->mesh->dim), s = (size_t)w->def->snapshot_count;
    memset(p, 0, sizeof *p);
    p->w = w, p->N = (int)N, p->s = (int)s;
    if (s > SIZE_MAX / 16 / (N + s)) return tss__basis_no_memory(w);
    p->D = tss__basis_doubles(w, N * s), p->weight = tss__basis_doubles(w, N);
    p->R = tss__basis_doubles(w, s * s), p->J = tss__basis_doubles(w, s * s);
    p->sigma = tss__basis_doubles(w, s);
    p->c = tss__basis_doubles(w, s * TSS__POD_BLOCK);
    if (!p->D || !p->weight || !p->R || !p->J || !p->sigma || !p->c) return tss__basis_no_memory(w);
    return tss__tall_open(w, &p->tall, p->N, p->weight, p->s > 8 ? p->s : 8, p->s * TSS__POD_BLOCK);
}

static tss_result tss__basis_build_pod(tss__basis_work *w, tss__basis *b) {
    tss__pod p;
    int modes = 0;
    tss_result r = tss__basis_open(w, 0);
    if (r == TSS_OK) r = tss__pod_open(&p, w);
    if (r != TSS_OK) return r;
    tss__pod_load(&p);
    for (int j = 0; j < p.s; j += TSS__POD_BLOCK)
        tss__pod_block(&p, j, p.s - j < TSS__POD_BLOCK ? p.s - j : TSS__POD_BLOCK);
    tss__pod_svd(&p);
    while (modes < p.rank && modes < w->def->count && p.sigma[modes] > 1e-10 * p.sigma[0] &&
           p.sigma[modes] > p.noise)
        modes++;
    if (modes == 0)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT,
                               "the snapshots do not move the body: nothing to make modes of");
    r = tss__basis_shape(w, b, TSS__VECTORS, modes, modes, 1);
    if (r != TSS_OK) return r;
    tss__tall_rotate(&p.tall, p.rank, p.D, p.J, modes, p.D);
    for (int k = 0; k < modes; k++) {
        double rms = p.sigma[k] * w->scale;
        tss__tall_sign(p.N, p.D + (ptrdiff_t)k * p.N);
        b->eigenvalue[k] = rms * rms / p.s;
    }
    tss__basis_store(b, p.N, p.D);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>basis_cache (private)
// One file a basis: a head of 64-bit words (magic, version, key of mesh and def, sizes, checksum),
// then the arrays as they lie in memory. Whatever does not fit is no cache. Written beside itself
// and renamed, so that a reader never sees half a file.
// ---------------------------------------------------------------------------------------------

enum { TSS__CACHE_WORDS = 16, TSS__CACHE_PARTS = 6 };
#define TSS__CACHE_MAGIC 0x7369736162737374u  // "tssbasis" on little-endian machines
#define TSS__CACHE_VERSION 1u

static void tss__hash(uint64_t *h, const void *data, size_t bytes) {
    const char *p = (const char *)data;
    for (size_t k = 0; k < bytes; k += 8) {
        uint64_t word = 0;
        memcpy(&word, p + k, bytes - k < 8 ? bytes - k : 8);
        *h = (*h ^ word) * 0x9E3779B97F4A7C15u;
        *h ^= *h >> 29;
    }
}

// All that the basis depends on, except for the processor.
static uint64_t tss__cache_key(const tss__sub_mesh *m, const tss_basis_def *d) {
    size_t n = (size_t)m->nodes, dim = (size_t)m->dim, cells = (size_t)m->cells;
    int head[8] = {m->dim, m->nodes, m->cells, (int)d->kind, d->count, d->heterogeneous,
                   d->snapshot_count, m->fixed != NULL};
    uint64_t h = TSS__CACHE_MAGIC;
    tss__hash(&h, head, sizeof head);
    tss__hash(&h, &d->tol, sizeof d->tol);
    tss__hash(&h, m->X, n * dim * sizeof(double));
    tss__hash(&h, m->mass, n * sizeof(double));
    if (cells) tss__hash(&h, m->cell, cells * (dim + 1) * sizeof(int));
    if (m->fixed) tss__hash(&h, m->fixed, n);
    if (d->kind == TSS_BASIS_EIGEN || d->heterogeneous) {
        if (m->mu) tss__hash(&h, m->mu, cells * sizeof(double));
        if (m->lambda) tss__hash(&h, m->lambda, cells * sizeof(double));
    }
    if (d->kind == TSS_BASIS_POD)
        tss__hash(&h, d->snapshots, (size_t)d->snapshot_count * n * dim * sizeof(double));
    return h;
}

typedef struct tss__cache_part {
    void *p;
    size_t bytes;
} tss__cache_part;

static void tss__cache_parts(const tss__basis *b, tss__cache_part part[TSS__CACHE_PARTS]) {
    size_t blocks = (size_t)b->blocks;
    part[0].p = b->first, part[0].bytes = (blocks + 1) * sizeof(int);
    part[1].p = b->handle, part[1].bytes = blocks * sizeof(int);
    part[2].p = b->eigenvalue, part[2].bytes = blocks * sizeof(double);
    part[3].p = b->weight, part[3].bytes = tss__basis_weight_count(b) * sizeof(double);
    part[4].p = b->transform, part[4].bytes = tss__basis_transform_count(b) * sizeof(double);
    part[5].p = b->value, part[5].bytes = tss__basis_value_count(b) * sizeof(double);
    for (int k = 0; k < TSS__CACHE_PARTS; k++)
        if (!part[k].p) part[k].bytes = 0;
}

static void tss__cache_head(const tss__basis *b, uint64_t key, uint64_t word[TSS__CACHE_WORDS]) {
    tss__cache_part part[TSS__CACHE_PARTS];
    double real[5] = {b->mass, b->residual, b->center[0], b->center[1], b->center[2]};
    memset(word, 0, TSS__CACHE_WORDS * sizeof *word);
    tss__cache_parts(b, part);
    word[0] = TSS__CACHE_MAGIC, word[1] = TSS__CACHE_VERSION << 8 | sizeof(int), word[2] = key;
    word[3] = (uint64_t)b->blocks, word[4] = (uint64_t)b->columns;
    word[5] = (uint64_t)b->iterations;
    memcpy(word + 6, real, sizeof real);
    for (int k = 0; k < TSS__CACHE_PARTS; k++)
        if (part[k].bytes) tss__hash(&word[14], part[k].p, part[k].bytes);
    tss__hash(&word[15], word, 15 * sizeof *word);
}

static int tss__cache_put(FILE *f, const tss__basis *b, uint64_t key) {
    uint64_t word[TSS__CACHE_WORDS];
    tss__cache_part part[TSS__CACHE_PARTS];
    tss__cache_head(b, key, word);
    tss__cache_parts(b, part);
    int ok = fwrite(word, sizeof word, 1, f) == 1;
    for (int k = 0; k < TSS__CACHE_PARTS; k++)
        if (part[k].bytes) ok &= fwrite(part[k].p, part[k].bytes, 1, f) == 1;
    return ok;
}

static void tss__cache_write(tss__basis_work *w, const tss__basis *b, uint64_t key) {
    size_t size = strlen(w->def->cache) + 24;
    char *temp = (char *)tss__basis_take(w, size, 1);
    if (!temp) return;
    snprintf(temp, size, "%s.%016llx", w->def->cache, (unsigned long long)key);
    FILE *f = fopen(temp, "wb");
    int ok = f && tss__cache_put(f, b, key);
    if (f) ok &= fclose(f) == 0;
    // Where a rename does not replace, the old file goes first.
    if (ok && rename(temp, w->def->cache)) remove(w->def->cache), ok = !rename(temp, w->def->cache);
    if (ok) return;
    if (f) remove(temp);
    tss_log(w->host, TSS_LOG_WARNING, "the basis cannot be kept in %s", w->def->cache);
}

// Shapes b after a head that fits; 0 if it does not.
static int tss__cache_shape(tss__basis_work *w, tss__basis *b, uint64_t key, const uint64_t *word) {
    tss_basis_kind kind = w->def->kind;
    int skinning = kind == TSS_BASIS_SKINNING, most = w->def->count + skinning;
    int each = skinning ? b->dim + 1 : 1;
    double real[5];
    uint64_t check = 0;
    tss__hash(&check, word, 15 * sizeof *word);
    if (check != word[15] || word[0] != TSS__CACHE_MAGIC || word[2] != key ||
        word[1] != (TSS__CACHE_VERSION << 8 | sizeof(int)))
        return 0;
    if (word[3] < 1 || word[3] > (uint64_t)most || word[4] != word[3] * (uint64_t)each) return 0;
    tss__basis_form form = skinning ? TSS__FACTORED
                           : kind == TSS_BASIS_BIHARMONIC ? TSS__SCALARS : TSS__VECTORS;
    if (tss__basis_shape(w, b, form, (int)word[3], (int)word[4], kind != TSS_BASIS_BIHARMONIC))
        return 0;
    if (kind == TSS_BASIS_BIHARMONIC && tss__basis_keep_handles(w, b) != TSS_OK) return 0;
    memcpy(real, word + 6, sizeof real);
    b->mass = real[0], b->residual = real[1], b->iterations = (int)word[5];
    for (int a = 0; a < 3; a++) b->center[a] = real[2 + a];
    return 1;
}

// 1 and the basis, or 0 and b as it was.
static int tss__cache_read(tss__basis_work *w, tss__basis *b, uint64_t key) {
    uint64_t word[TSS__CACHE_WORDS], sum = 0;
    tss__cache_part part[TSS__CACHE_PARTS];
    tss__basis before = *b;
    FILE *f = fopen(w->def->cache, "rb");
    if (!f) return 0;
    int ok = fread(word, sizeof word, 1, f) == 1 && tss__cache_shape(w, b, key, word);
    if (ok) tss__cache_parts(b, part);
    for (int k = 0; ok && k < TSS__CACHE_PARTS; k++) {
        if (part[k].bytes) ok = fread(part[k].p, part[k].bytes, 1, f) == 1;
        if (ok && part[k].bytes) tss__hash(&sum, part[k].p, part[k].bytes);
    }
    ok = ok && sum == word[14] && fgetc(f) == EOF;
    fclose(f);
    b->cached = ok;
    if (ok) return 1;
    tss__basis_free(w->host, b);
    *b = before;
    return 0;
}

// ---------------------------------------------------------------------------------------------
// >>basis_build (private)
// ---------------------------------------------------------------------------------------------

static tss_result tss__basis_check_mesh(tss__basis_work *w) {
    const tss__sub_mesh *m = w->mesh;
    if (m->nodes < 1) return tss__basis_fail(w, TSS_ERROR_EMPTY, "the body has no nodes");
    for (ptrdiff_t k = 0; k < (ptrdiff_t)m->nodes * m->dim; k++)
        if (!isfinite(m->X[k]))
            return tss__basis_fail(w, TSS_ERROR_BAD_STATE, "position of node %d is %g",
                                   (int)(k / m->dim), m->X[k]);
    for (int i = 0; i < m->nodes; i++)
        if (!(m->mass[i] >= 0) || !isfinite(m->mass[i]))
            return tss__basis_fail(w, TSS_ERROR_BAD_MATERIAL, "mass of node %d is %g kg", i,
                                   m->mass[i]);
    return TSS_OK;
}

// Kinds whose setup solves for their modes.
static int tss__basis_solves(tss_basis_kind kind) {
    return kind == TSS_BASIS_SKINNING || kind == TSS_BASIS_BIHARMONIC || kind == TSS_BASIS_EIGEN ||
           kind == TSS_BASIS_POD;
}

static tss_result tss__basis_check_def(tss__basis_work *w) {
    const tss_basis_def *d = w->def;
    if (d->cookie != TSS__BASIS_COOKIE)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT,
                               "basis definition without its cookie: start from tss_basis_skinning "
                               "or one of its sisters");
    if ((unsigned)d->kind >= TSS_BASIS_KINDS)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT, "no basis of kind %d", (int)d->kind);
    if (!TSS__EIGEN && tss__basis_solves(d->kind))
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT,
                               "bases of this kind are left out of this build by TSS_NO_EIGEN");
    if (d->count < 1)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT, "count is %d, expected at least 1",
                               d->count);
    if (d->initial < -1)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT,
                               "initial is %d, expected a number of blocks or -1 for all",
                               d->initial);
    if (!(d->tol > 0 && d->tol < 1))
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT, "tol is %g, expected 0 < tol < 1",
                               d->tol);
    return TSS_OK;
}

static tss_result tss__basis_check_numbers(tss__basis_work *w, const char *what, const double *a,
                                           size_t rows, size_t columns) {
    for (size_t k = 0; k < rows * columns; k++)
        if (!isfinite(a[k]))
            return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT, "%s: row %d, column %d is %g", what,
                                   (int)(k / columns), (int)(k % columns), a[k]);
    return TSS_OK;
}

// Numbers from 0 without gaps.
static tss_result tss__basis_check_blocks(tss__basis_work *w) {
    const tss_basis_def *d = w->def;
    for (int k = 0; d->block && k < d->count; k++) {
        int before = k ? d->block[k - 1] : -1;
        if (d->block[k] != before + 1 && (k == 0 || d->block[k] != before))
            return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT,
                                   "column %d is in block %d, expected %d or the one after", k,
                                   d->block[k], k ? before : 0);
    }
    return TSS_OK;
}

// The arrays that a def of its kind needs.
static tss_result tss__basis_check_arrays(tss__basis_work *w) {
    const tss_basis_def *d = w->def;
    size_t n = (size_t)w->mesh->nodes, nd = n * (size_t)w->mesh->dim, count = (size_t)d->count;
    if (d->kind == TSS_BASIS_POD) {
        if (!d->snapshots || d->snapshot_count < 1)
            return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT, "POD without snapshots");
        count = (size_t)d->snapshot_count;
        return tss__basis_check_numbers(w, "snapshots", d->snapshots, count, nd);
    }
    if (d->kind == TSS_BASIS_CUSTOM) {
        if (!d->refresh)
            return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT, "custom basis without refresh");
        if (d->scalars || d->vectors)
            return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT, "custom basis with arrays");
        return tss__basis_check_blocks(w);
    }
    if (d->kind != TSS_BASIS_ARRAYS) return TSS_OK;
    if (!d->scalars == !d->vectors)
        return tss__basis_fail(w, TSS_ERROR_BAD_ARGUMENT,
                               "give scalars or vectors, one of the two");
    tss_result r = tss__basis_check_numbers(w, d->scalars ? "scalars" : "vectors",
                                            d->scalars ? d->scalars : d->vectors,
                                            d->scalars ? n : nd, count);
    return r == TSS_OK ? tss__basis_check_blocks(w) : r;
}

static tss_result tss__basis_build_kind(tss__basis_work *w, tss__basis *b) {
    if (!TSS__EIGEN)
        return w->def->kind == TSS_BASIS_AFFINE      ? tss__basis_build_affine(w, b)
               : w->def->kind == TSS_BASIS_QUADRATIC ? tss__basis_build_quadratic(w, b)
                                                     : tss__basis_build_given(w, b);
    switch (w->def->kind) {
        case TSS_BASIS_AFFINE: return tss__basis_build_affine(w, b);
        case TSS_BASIS_QUADRATIC: return tss__basis_build_quadratic(w, b);
        case TSS_BASIS_SKINNING: return tss__basis_build_skinning(w, b);
        case TSS_BASIS_BIHARMONIC: return tss__basis_build_biharmonic(w, b);
        case TSS_BASIS_EIGEN: return tss__basis_build_eigen(w, b);
        case TSS_BASIS_POD: return tss__basis_build_pod(w, b);
        default: return tss__basis_build_given(w, b);
    }
}

// From the cache, or built and put there.
static tss_result tss__basis_make(tss__basis_work *w, tss__basis *b) {
    int cached = TSS__EIGEN && w->def->cache && tss__basis_solves(w->def->kind);
    if (!cached) return tss__basis_build_kind(w, b);
    uint64_t key = tss__cache_key(w->mesh, w->def);
    if (tss__cache_read(w, b, key)) return TSS_OK;
    tss_result r = tss__basis_build_kind(w, b);
    if (r == TSS_OK) tss__cache_write(w, b, key);
    return r;
}

// The basis of one body. out is overwritten; zero on an error, whose reason goes to error (NULL
// allowed). Errors: BAD_ARGUMENT (def), BAD_MESH, BAD_MATERIAL, BAD_STATE (mesh), SINGULAR (the
// eigensolver did not reach tol), NO_MEMORY. METIS inside: one call at a time in a process.
static tss_result tss__basis_build(const tss__sub_mesh *m, const tss_basis_def *def,
                                   tss__basis *out, char *error, size_t error_size) {
    tss__basis_work w;
    memset(&w, 0, sizeof w), memset(out, 0, sizeof *out);
    w.mesh = m, w.def = def, w.host = m->host, w.error = error, w.error_size = error_size;
    out->kind = def->kind, out->nodes = m->nodes, out->dim = m->dim;
    tss_result r = tss__basis_check_def(&w);
    if (r == TSS_OK) r = tss__basis_check_mesh(&w);
    if (r == TSS_OK) r = tss__basis_check_arrays(&w);
    if (r == TSS_OK) r = tss__basis_make(&w, out);
    tss__basis_release(&w, 0);
    if (r != TSS_OK) tss__basis_free(m->host, out);
    out->initial = def->initial < 0 || def->initial > out->blocks ? out->blocks : def->initial;
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>basis_rows (private)
// ---------------------------------------------------------------------------------------------

static void tss__basis_row_block(const tss__basis *b, const double *m, int node, int block,
                                 double *out) {
    int q = b->dim + 1;
    if (!b->transform) {
        memcpy(out, b->value + (ptrdiff_t)node * b->columns + b->first[block],
               (size_t)(b->first[block + 1] - b->first[block]) * sizeof(double));
        return;
    }
    tss__basis_transform(q, b->transform + (ptrdiff_t)block * q * q, m, out);
    double w = b->weight[(ptrdiff_t)node * b->blocks + block];
    for (int k = 0; k < q; k++) out[k] *= w;
}

// Scalar functions of the blocks active[0..actives−1], in that order, at node[0..count−1] (NULL:
// 0..count−1): count rows of ld doubles. X: rest positions of the body, nodes × dim.
static void tss__basis_rows(const tss__basis *b, const double *X, int dim, const int *node,
                            int count, const int *active, int actives, double *out, int ld) {
    TSS_ASSERT(!b->vector && dim == b->dim);
    for (int k = 0; k < count; k++) {
        int i = node ? node[k] : k, at = 0;
        double m[4] = {1, 0, 0, 0};
        for (int a = 0; a < dim; a++) m[a + 1] = X[(ptrdiff_t)i * dim + a] - b->center[a];
        for (int s = 0; s < actives; s++) {
            tss__basis_row_block(b, m, i, active[s], out + (ptrdiff_t)k * ld + at);
            at += b->first[active[s] + 1] - b->first[active[s]];
        }
    }
}

// ---------------------------------------------------------------------------------------------
// >>subspace_state (private)
// What the solver keeps. Sections below name the fields they read and write in their banners.
// ---------------------------------------------------------------------------------------------

#define TSS__SUB_COOKIE 0x737562
#define TSS__SUB_LANES 8     // accumulators of a sum over rows: fixed, so that threads do not matter
#define TSS__SUB_CHUNK 64    // rows at a time
#define TSS__SUB_DROP 1e-6   // squared length below which a masked mode counts as dependent
enum { TSS__SUB_EXACT, TSS__SUB_HELD, TSS__SUB_ADDED };  // a stencil: to be added to A; in H^ℓ; in A
#define TSS__SUB_DENSE 1500  // modal unknowns up to which H_q of touching bodies is one dense matrix

typedef struct tss__sub_buf {  // keeps its contents when it grows
    void *p;
    size_t bytes;
} tss__sub_buf;

typedef struct tss__sub_basis {  // a basis of a body
    int live, body;              // body: index into modal bodies
    tss_basis_def def;
    tss__basis b;
    tss__sub_buf on;             // int: active blocks, ascending
    tss__sub_buf transposed;     // their transforms, if the basis is factored
    int on_count;
    double seconds;
    double *columns;             // CUSTOM: scratch handed to refresh
} tss__sub_basis;

typedef struct tss__sub_block {  // a candidate of the oracle
    int basis, block;
    int active, age;             // age: steps since it was activated or last useful
    int initial;
    double error, progress;      // 𝒢_s, ℰ_s
    double last;                 // 𝒢_s of the iterate before, as measured
} tss__sub_block;

typedef struct tss__modal {  // a body with modes
    tss_body body;
    int first, nodes;        // world nodes
    double diagonal;         // of its rest box
    tss__sub_buf block;      // tss__sub_block
    int blocks;
    int c, r, a;             // active scalar functions, vector columns, modes a = d·c + r
    int columns;             // modes available
    size_t at;               // offset in vectors over all modes
    int groups, group0;      // its groups of nodes are group0 .. group0 + groups − 1
    int enriched;            // of its nodes
    int modal_nodes;         // nodes that may be modal
    tss__sub_buf gram;       // a × a: U_aᵀ M U_a
    tss__sub_buf thin_gram;  // a × a: B_aᵀ M B_a
    tss__sub_buf wide, thin; // int: independent modes of U_a (wide_rank), of B_a (thin_rank)
    int wide_rank, thin_rank;
    int stale, thin_stale;   // the active modes changed: all must be built anew; the mask did
    size_t hat, factor;      // offsets of H and, in a component's lowest body, of its factor
    int component, tilde, width;  // lowest body of the component, offset in it; width: of all of it
    int offset;              // among the thin ranks of all bodies
    tss__sub_buf live;       // int: its nodes with rows of exact stencils (world numbers)
    int lives;
    tss__sub_buf phi, vec;   // lives × c; (lives · d) × r
    int functions;           // scalar functions available
    tss__sub_buf map, map_block;  // a: place of an active mode among all; its block
    tss__sub_buf q;          // columns: Σ α d_q over the step, by place among all modes
    tss__sub_buf s;          // a: α d_q since the last secant update
    tss__sub_buf sum;        // a × a, lower triangle: Σ H^ℓ over valid parts
    tss__sub_buf exact[2];   // a × a, lower triangle: UᵀAU, of all nodes and of those not enriched
    int sum_stale;
} tss__modal;

typedef struct tss__sub_part {  // a subdomain: the secant stencils of one group of nodes (§3.9)
    int modal;                  // its body
    int nodes;
    int valid, fresh;           // has a secant; H^ℓ is set
    int skipped;                // the last BFGS update was not safe
    int used;                   // nodes of the stencils it holds; 0: H^ℓ = 0
    int64_t node0, row0, col0;  // its nodes, row pointers (from 0) and columns start here
    size_t h, g;                // offsets of H^ℓ (a × a) and of the last modal gradient (a)
} tss__sub_part;

typedef struct tss__sub_cross {  // H between two bodies b < c, a_c × a_b column-major
    int b, c;
    size_t at;
} tss__sub_cross;

typedef struct tss__sub_jlink {  // a block of K between an enriched and a border node
    int other;
    double block[9];  // a copy: read in order, thirty times an iterate
} tss__sub_jlink;

typedef struct tss__sub_counts {
    int linear_iterations, factorizations;
} tss__sub_counts;

struct tss_subspace {
    tss_subspace_def def;
    tss_world *w;
    tss_host host;
    size_t bytes;
    int dim, n;
    uint64_t topology;  // of the world when the tables below were built
    int built, query;   // query: look, but activate nothing
    tss__sub_buf bases, modal;
    int basis_count, modal_count;
    double setup_seconds;

    // nodes (n): modal body or −1, group or −1, state, scales, fields
    tss__sub_buf body_of, group, on, gamma, eta, gamma_print, eta_print, error, progress, force, ring;
    tss__sub_buf group_ptr, group_node, group_age;  // nodes of each group; steps since it was activated
    int groups, nodes, enriched;                    // unknown nodes, enriched ones

    // subdomains
    tss__sub_buf parts;                                 // one a group
    tss__sub_buf part_node, part_row, part_col;         // nodes; block-CSR pattern, local numbers
    tss__sub_buf stencil_ptr, stencil_id;               // by part and entry: ids
    tss__sub_buf stencil_local, stencil_slot;           // local node numbers; blocks of their pairs
    tss__sub_buf stencil_at;                            // where part p, entry e start in these two
    int most_nodes, most_blocks;                        // of a part
    const int *ctx_body;                                // body of each node, the world's
    tss__sub_buf part_of;                               // by entry: part of each stencil
    tss__sub_buf part_of_at;                            // offsets, entries + 1
    tss__sub_buf held;                                  // by entry: which stencils are in secants
    tss__sub_buf secant, secant_g, part_diag;           // H^ℓ; modal gradients; diagonal blocks
    size_t modal_g;                                     // Σ a over the parts
    double moved;                                       // Σ ‖α d‖∞ since the last update of the secants
    double drift;                                       // the same since A was summed
    int kept, kept_H, kept_x;                           // A, m->exact[mask] (a bit each), Ax are those of the iterate before
    uint64_t kept_stamp;                                // x_stamp then
    int entries;                                        // energies when built
    uint64_t patterns;                                  // sum of the secant lists' patterns
    tss__sub_buf near_ptr, near_id;                     // node → fixed stencils (entry, id)

    // one iterate
    tss__sub_buf want, live_row, live_index, row_list, d_a, x_a, rhs;
    tss_bcsr A, C;                                       // the world's, borrowed
    tss__sub_buf H, cross, cross_val, lane;              // H_q or H_a by body; between bodies
    int crosses;
    tss__sub_buf xrow, xnode;                            // enriched nodes: number, list
    int xrows;
    tss_bcsr Ax, Cx;                                     // H_x = Ax + Cx
    uint64_t xpattern, x_stamp, x_from[2];               // pattern numbers; changes of the enriched set
    int masked;                                          // some enriched node has fixed axes
    tss__sub_buf border, border_index, border_ptr, border_link, border_u;  // J: see >>enriched_solve
    tss__sub_buf x_ptr, x_link;
    int borders;
    size_t modes;                                        // Σ a
    tss__sub_buf small, small_work, small_rhs, factors;  // small dense matrices and vectors
    tss__sub_buf modal_work, columns, pair_key;
    tss__sub_buf solution, scratch, xmask;
    tss__sub_counts counts;                              // of this step
    tss_chol *chol_q, *chol_x;
    tss_bcsr Sq;                                         // H_q, sparse, for large components
    tss_pcg *pcg;
    double pcg_iterations;
    int pcg_rest;
    tss_result failed;                                   // inside a PCG callback
    uint64_t oracle_calls, secant_updates, secant_skips, hessians;
    int added;                                           // nodes and blocks the last oracle added
    int solved;                                          // the last direction was ours
    const tss_ctx *ctx;                                  // the world's
    tss__sub_buf dq;                                     // d_q of the last iterate, and room
    tss__sub_buf dyn_ptr, dyn_id;                        // node → stencils that change (entry, id)
    tss__sub_buf activate;                               // by group: the oracle's answer
    tss__sub_buf near_slot, factored;                    // see tss__sub_near; candidates of a basis
    tss__sub_buf pending;                                // from a checkpoint, until groups exist
    int pending_n, pending_groups;
};

static void *tss__sub_need(tss_subspace *s, tss__sub_buf *b, size_t count, size_t item) {
    if (count == 0) count = 1;
    if (count > (SIZE_MAX / 4) / item) return NULL;
    size_t want = count * item;
    if (want <= b->bytes) return b->p;
    if (b->bytes > 0) want += want / 4;
    void *at = tss_alloc(&s->host, want);
    if (!at) return NULL;
    if (b->bytes > 0) memcpy(at, b->p, b->bytes);
    tss_free(&s->host, b->p, b->bytes);
    s->bytes += want - b->bytes;
    b->p = at, b->bytes = want;
    return at;
}

static void tss__sub_drop(tss_subspace *s, tss__sub_buf *b) {
    tss_free(&s->host, b->p, b->bytes);
    s->bytes -= b->bytes;
    b->p = NULL, b->bytes = 0;
}

static double *tss__sub_f(const tss__sub_buf *b) { return (double *)b->p; }
static int *tss__sub_i(const tss__sub_buf *b) { return (int *)b->p; }
static uint8_t *tss__sub_u(const tss__sub_buf *b) { return (uint8_t *)b->p; }
static tss__modal *tss__sub_modal(const tss_subspace *s, int k) { return (tss__modal *)s->modal.p + k; }
static tss__sub_basis *tss__sub_base(const tss_subspace *s, int k) { return (tss__sub_basis *)s->bases.p + k; }
static tss__sub_part *tss__sub_parts(const tss_subspace *s, int k) { return (tss__sub_part *)s->parts.p + k; }
static tss__sub_block *tss__sub_blocks(const tss__modal *m) { return (tss__sub_block *)m->block.p; }

static double tss__sub_clock(const tss_subspace *s) {
    return s->host.clock ? s->host.clock(s->host.clock_ctx) : 0;
}

static tss_result tss__sub_no_memory(const tss_subspace *s) {
    return tss_world_fail(s->w, TSS_ERROR_NO_MEMORY, "subspace: out of memory (%zu bytes in use)", s->bytes);
}

// ---------------------------------------------------------------------------------------------
// >>partition (private)
// Groups of nodes of equal volume (§3.6, footnote 5): METIS on the mesh's graph with the nodes'
// volumes as weights, or recursive bisection along the longest axis. Volumes, not counts: a graded
// mesh then enriches the same region as an even one (Fig. 9).
// ---------------------------------------------------------------------------------------------

typedef struct tss__bisector {
    const double *X, *v;
    int *order, *space, *part, dim;
} tss__bisector;

// Stable merge sort of order[from..to) by coordinate axis, ties by node number.
static void tss__bisect_sort(const tss__bisector *k, int from, int to, int axis) {
    if (to - from < 2) return;
    int mid = from + (to - from) / 2, i = from, j = mid;
    tss__bisect_sort(k, from, mid, axis);
    tss__bisect_sort(k, mid, to, axis);
    for (int at = from; at < to; at++) {
        int left = i < mid && (j >= to || k->X[k->order[i] * k->dim + axis] <= k->X[k->order[j] * k->dim + axis]);
        k->space[at] = k->order[left ? i++ : j++];
    }
    memcpy(k->order + from, k->space + from, (size_t)(to - from) * sizeof(int));
}

// Splits order[from..to) into parts p0 .. p0 + parts − 1.
static void tss__bisect(const tss__bisector *k, int from, int to, int p0, int parts) {
    if (parts == 1) {
        for (int i = from; i < to; i++) k->part[k->order[i]] = p0;
        return;
    }
    double lo[3], hi[3], all = 0, half = 0;
    int axis = 0, at = from, left = parts / 2;
    for (int c = 0; c < k->dim; c++) lo[c] = INFINITY, hi[c] = -INFINITY;
    for (int i = from; i < to; i++) {
        all += k->v[k->order[i]];
        for (int c = 0; c < k->dim; c++) {
            double X = k->X[k->order[i] * k->dim + c];
            lo[c] = X < lo[c] ? X : lo[c], hi[c] = X > hi[c] ? X : hi[c];
        }
    }
    for (int c = 1; c < k->dim; c++)
        if (hi[c] - lo[c] > hi[axis] - lo[axis]) axis = c;
    tss__bisect_sort(k, from, to, axis);
    // every part keeps at least one node
    while (at < to - (parts - left) && (at - from < left || half + k->v[k->order[at]] / 2 < all * left / parts))
        half += k->v[k->order[at++]];
    tss__bisect(k, from, at, p0, left);
    tss__bisect(k, at, to, p0 + left, parts - left);
}

#ifndef TSS_NO_METIS
// Integer weights of mean 100; METIS_ERROR leaves the work to the bisection.
static int tss__bisect_metis(int n, const int64_t *ptr, const int *adj, const double *v, int parts, int *part,
                          idx_t *work) {
    double all = 0;
    idx_t *xadj = work, *weight = work + n + 1, *out = weight + n, *col = out + n;
    for (int i = 0; i < n; i++) all += v[i];
    for (int i = 0; i <= n; i++) xadj[i] = (idx_t)ptr[i];
    for (int64_t k = 0; k < ptr[n]; k++) col[k] = adj[k];
    for (int i = 0; i < n; i++) {
        double share = v[i] / all * n * 100;
        weight[i] = share > 1 ? (idx_t)(share + 0.5) : 1;
    }
    idx_t nv = n, ncon = 1, np = parts, cut = 0, options[METIS_NOPTIONS];
    METIS_SetDefaultOptions(options);
    options[METIS_OPTION_SEED] = 1, options[METIS_OPTION_NUMBERING] = 0, options[METIS_OPTION_UFACTOR] = 30;
    if (METIS_PartGraphKway(&nv, &ncon, xadj, col, weight, NULL, NULL, &np, NULL, NULL, options, &cut, out) !=
        METIS_OK)
        return 0;
    for (int i = 0; i < n; i++) part[i] = (int)out[i];
    return 1;
}

// Graph of nodes that share a cell, both directions, sorted: ptr (n + 1) and adj, in s->scratch.
static tss_result tss__sub_graph(tss_subspace *s, int n, int cells, const int *cell, int first, int64_t **ptr,
                                 int **adj) {
    int size = s->dim + 1;
    size_t most = (size_t)cells * (size_t)(size * (size - 1));
    size_t bytes = (size_t)(2 * n + 2) * sizeof(int64_t) + 2 * most * sizeof(int);
    int64_t *from = (int64_t *)tss__sub_need(s, &s->scratch, bytes, 1);
    if (!from) return tss__sub_no_memory(s);
    int64_t *cursor = from + n + 1;
    int *col = (int *)(void *)(cursor + n + 1), *merged = col + most;
    memset(from, 0, (size_t)(n + 1) * sizeof *from);
    for (int k = 0; k < cells * size; k++) from[cell[k] - first + 1] += size - 1;
    for (int i = 0; i < n; i++) from[i + 1] += from[i];
    memcpy(cursor, from, (size_t)n * sizeof *from);
    for (int k = 0; k < cells; k++)
        for (int i = 0; i < size; i++)
            for (int j = 0; j < size; j++)
                if (i != j) col[cursor[cell[k * size + i] - first]++] = cell[k * size + j] - first;
    int64_t at = 0;
    for (int i = 0; i < n; i++) {
        int *list = col + from[i], count = (int)(from[i + 1] - from[i]);
        for (int a = 1; a < count; a++)  // insertion sort: some seventy entries
            for (int b = a, v = list[a]; b >= 0; b--) {
                if (b > 0 && list[b - 1] > v) { list[b] = list[b - 1]; continue; }
                list[b] = v;
                break;
            }
        int64_t start = at;
        for (int a = 0; a < count; a++)
            if (a == 0 || list[a] != list[a - 1]) merged[at++] = list[a];
        cursor[i] = start;
    }
    memcpy(from, cursor, (size_t)n * sizeof *from);
    from[n] = at;
    *ptr = from, *adj = merged;
    return TSS_OK;
}
#endif

// Numbers the groups of one body's nodes into part (nodes).
static tss_result tss__sub_partition(tss_subspace *s, const tss__modal *m, const double *v, int parts, int *part) {
    tss_body_info info;
    tss_result r = tss_body_get(s->w, m->body, &info);
    if (r != TSS_OK) return r;
    const double *X = tss_world_rest(s->w) + m->first * s->dim;
    if (parts <= 1) {
        memset(part, 0, (size_t)m->nodes * sizeof(int));
        return TSS_OK;
    }
#ifndef TSS_NO_METIS
    int64_t *ptr = NULL;
    int *adj = NULL, done = 0;
    r = tss__sub_graph(s, m->nodes, info.cells, tss_body_cells(s->w, m->body), m->first, &ptr, &adj);
    if (r != TSS_OK) return r;
    if (ptr[m->nodes] < INT32_MAX) {
        size_t bytes = ((size_t)(3 * m->nodes + 1) + (size_t)ptr[m->nodes]) * sizeof(idx_t);
        idx_t *work = (idx_t *)tss_alloc(&s->host, bytes);
        if (!work) return tss__sub_no_memory(s);
        done = tss__bisect_metis(m->nodes, ptr, adj, v, parts, part, work);
        tss_free(&s->host, work, bytes);
    }
    if (done) return TSS_OK;
#endif
    int *order = (int *)tss__sub_need(s, &s->scratch, 2 * (size_t)m->nodes, sizeof(int));
    if (!order) return tss__sub_no_memory(s);
    for (int i = 0; i < m->nodes; i++) order[i] = i;
    tss__bisector k = {X, v, order, order + m->nodes, part, s->dim};
    tss__bisect(&k, 0, m->nodes, 0, parts);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>scales (private)
// γ_i = αh² (a_i/d) W̄_i and η_i = αh² v_i W̄_i (Eq. 5, 8): the parts that do not depend on the step.
// a_i: faces opposite i; the 1/d is exact (‖∇N_i‖ = a_i/(d w)), Eq. (6)'s 1/2 is that of 2D.
// W̄_i: ring mean of 2 mu, the smallest non-zero eigenvalue at rest; as printed 2 mu + d lambda, the
// spectral norm, which starves nearly incompressible bodies of nodes.
// ---------------------------------------------------------------------------------------------

// 2 mu + d lambda in place of 2 mu, for the formulas as printed.
static tss_result tss__sub_spectral(tss_subspace *s, double *W, double *cells) {
    memset(W, 0, (size_t)s->n * sizeof *W), memset(cells, 0, (size_t)s->n * sizeof *cells);
    for (int k = 0; k < s->modal_count; k++) {
        tss_body_info info;
        if (tss_body_get(s->w, tss__sub_modal(s, k)->body, &info) != TSS_OK) continue;
        const int *cell = tss_body_cells(s->w, tss__sub_modal(s, k)->body), size = s->dim + 1;
        for (int c = 0; c < info.cells; c++) {
            double mu, lambda;
            tss_result r = tss_body_cell_material(s->w, tss__sub_modal(s, k)->body, c, &mu, &lambda, NULL);
            if (r != TSS_OK) return r;
            for (int i = c * size; i < (c + 1) * size; i++) W[cell[i]] += 2 * mu + s->dim * lambda, cells[cell[i]] += 1;
        }
    }
    return TSS_OK;
}

static tss_result tss__sub_scales(tss_subspace *s, const tss_ctx *c) {
    size_t n = (size_t)s->n;
    tss__sub_buf *out[4] = {&s->gamma, &s->eta, &s->gamma_print, &s->eta_print};
    for (int k = 0; k < 4; k++)
        if (!tss__sub_need(s, out[k], n, sizeof(double))) return tss__sub_no_memory(s);
    double *W = (double *)tss__sub_need(s, &s->scratch, 4 * n, sizeof(double));
    if (!W) return tss__sub_no_memory(s);
    double *cells = W + n, *v = cells + n, *a = v + n;
    memset(W, 0, 4 * n * sizeof(double));
    for (int e = 0; e < tss_world_energies(s->w); e++) {
        tss_energy_view view;
        if (tss_energy_get(s->w, e, &view) == TSS_OK && view.def->node_scale)
            view.def->node_scale(view.def->user, c, W, cells, v, a);
    }
    for (int i = 0; i < s->n; i++) {
        double mean = cells[i] > 0 ? W[i] / cells[i] : 0;
        tss__sub_f(&s->gamma)[i] = a[i] / s->dim * mean, tss__sub_f(&s->eta)[i] = v[i] * mean;
        tss__sub_f(&s->ring)[i] = v[i];
    }
    tss_result r = tss__sub_spectral(s, W, cells);
    for (int i = 0; i < s->n; i++) {
        double mean = cells[i] > 0 ? W[i] / cells[i] : 0;
        tss__sub_f(&s->gamma_print)[i] = a[i] * mean, tss__sub_f(&s->eta_print)[i] = v[i] * mean;
    }
    return r;
}
// ---------------------------------------------------------------------------------------------
// >>build (private)
// Tables that depend on the scene: which body a node's modes belong to, groups, subdomains with
// their stencils and block patterns, node → stencils. Groups survive pins and targets; the rest is
// built anew whenever the world's topology changes. A stencil belongs to the group that most of its
// nodes are in (the lowest of them), so every one has exactly one subdomain (§3.9) and sums by
// subdomain are exact.
// ---------------------------------------------------------------------------------------------

// A node may be modal if it is an unknown of a body with modes and none of its axes is pinned.
// Others: kinematic (never enriched) or always enriched.
static void tss__sub_node_states(tss_subspace *s, const tss_unknowns *u) {
    uint8_t *on = tss__sub_u(&s->on);
    int *body_of = tss__sub_i(&s->body_of);
    for (int i = 0; i < s->n; i++) {
        int row = u->row[i], fixed = 0;
        for (int c = 0; row >= 0 && u->fixed && c < s->dim; c++) fixed |= u->fixed[row * s->dim + c];
        body_of[i] = -1;
        if (row < 0) on[i] = 0;
        else if (fixed || tss__sub_i(&s->group)[i] < 0) on[i] = 1;
    }
    for (int k = 0; k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        m->modal_nodes = 0;
        for (int i = m->first; i < m->first + m->nodes; i++) {
            int row = u->row[i], fixed = 0;
            for (int c = 0; row >= 0 && u->fixed && c < s->dim; c++) fixed |= u->fixed[row * s->dim + c];
            if (row < 0 || fixed) continue;
            body_of[i] = k;
            m->modal_nodes++;
        }
        m->stale = 1;
    }
}

// Groups of all modal bodies; L is shared out by nodes.
static tss_result tss__sub_build_groups(tss_subspace *s, const tss_ctx *c) {
    size_t n = (size_t)s->n;
    int *group = (int *)tss__sub_need(s, &s->group, n, sizeof(int)), all = 0;
    tss__sub_buf *wide[] = {&s->error, &s->progress, &s->force, &s->ring};
    for (int k = 0; k < 4; k++)
        if (!tss__sub_need(s, wide[k], n, sizeof(double))) return tss__sub_no_memory(s);
    if (!group || !tss__sub_need(s, &s->on, n, 1) || !tss__sub_need(s, &s->body_of, n, sizeof(int)))
        return tss__sub_no_memory(s);
    memset(s->on.p, 0, n);
    tss_result r = tss__sub_scales(s, c);  // leaves the volumes in ring
    if (r != TSS_OK) return r;
    for (int i = 0; i < s->n; i++) group[i] = -1;
    for (int k = 0; k < s->modal_count; k++) all += tss__sub_modal(s, k)->nodes;
    s->groups = 0;
    for (int k = 0; k < s->modal_count && r == TSS_OK; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        double want = s->def.partitions > 0 ? (double)s->def.partitions * m->nodes / all : m->nodes / 100.0;
        int parts = want > 1 ? (int)(want + 0.5) : 1;
        if (parts > m->nodes) parts = m->nodes;
        r = tss__sub_partition(s, m, tss__sub_f(&s->ring) + m->first, parts, group + m->first);
        for (int i = m->first; i < m->first + m->nodes; i++) group[i] += s->groups;
        m->group0 = s->groups, m->groups = parts;
        s->groups += parts;
    }
    if (r != TSS_OK) return r;
    int *ptr = (int *)tss__sub_need(s, &s->group_ptr, (size_t)s->groups + 1, sizeof(int));
    int *list = (int *)tss__sub_need(s, &s->group_node, n, sizeof(int));
    int *age = (int *)tss__sub_need(s, &s->group_age, (size_t)s->groups, sizeof(int));
    if (!ptr || !list || !age) return tss__sub_no_memory(s);
    memset(ptr, 0, (size_t)(s->groups + 1) * sizeof(int));
    for (int g = 0; g < s->groups; g++) age[g] = 0;
    for (int i = 0; i < s->n; i++)
        if (group[i] >= 0) ptr[group[i] + 1]++;
    for (int g = 0; g < s->groups; g++) ptr[g + 1] += ptr[g];
    for (int i = 0; i < s->n; i++)
        if (group[i] >= 0) list[ptr[group[i]]++] = i;
    for (int g = s->groups; g > 0; g--) ptr[g] = ptr[g - 1];
    ptr[0] = 0;
    return TSS_OK;
}

// Group of a stencil: that of most of its nodes, −1 if it leaves its body or has no modal node.
static int tss__sub_vote(const tss_subspace *s, const int *node, int arity) {
    int best = -1, most = 0, body = -2;
    for (int i = 0; i < arity; i++) {
        if (node[i] < 0) continue;
        int g = tss__sub_i(&s->group)[node[i]], votes = 0;
        if (g < 0) return -1;
        int at = s->ctx_body[node[i]];
        if (body == -2) body = at;
        if (at != body) return -1;
        for (int j = 0; j < arity; j++) votes += node[j] >= 0 && tss__sub_i(&s->group)[node[j]] == g;
        if (votes > most || (votes == most && g < best)) best = g, most = votes;
    }
    return best;
}

static int tss__sub_secant_entry(const tss_subspace *s, int e, tss_energy_view *v) {
    return tss_energy_get(s->w, e, v) == TSS_OK && (v->def->flags & TSS_ENERGY_SECANT_OK) &&
           !(v->def->flags & TSS_ENERGY_DYNAMIC) && v->list.count > 0;
}

// part_of and the lists of stencil ids by part and entry.
static tss_result tss__sub_build_lists(tss_subspace *s) {
    int E = s->entries, all = 0;
    int *at = (int *)tss__sub_need(s, &s->part_of_at, (size_t)E + 1, sizeof(int));
    if (!at) return tss__sub_no_memory(s);
    for (int e = 0; e < E; e++) {
        tss_energy_view v;
        at[e] = all;
        if (tss__sub_secant_entry(s, e, &v)) all += v.list.count;
    }
    at[E] = all;
    size_t cells = (size_t)s->groups * (size_t)E;
    int *of = (int *)tss__sub_need(s, &s->part_of, (size_t)all, sizeof(int));
    int *ptr = (int *)tss__sub_need(s, &s->stencil_ptr, cells + 2, sizeof(int));
    int *id = (int *)tss__sub_need(s, &s->stencil_id, (size_t)all, sizeof(int));
    uint8_t *held = (uint8_t *)tss__sub_need(s, &s->held, (size_t)all, 1);
    if (!of || !ptr || !id || !held) return tss__sub_no_memory(s);
    memset(held, TSS__SUB_EXACT, (size_t)all);
    memset(ptr, 0, (cells + 2) * sizeof(int));
    for (int pass = 0; pass < 2; pass++) {
        for (int e = 0; e < E; e++) {
            tss_energy_view v;
            if (!tss__sub_secant_entry(s, e, &v)) continue;
            for (int k = 0; k < v.list.count; k++) {
                int *p = of + at[e] + k;
                if (pass == 0) *p = tss__sub_vote(s, v.list.node + k * v.def->arity, v.def->arity);
                if (*p < 0) continue;
                if (pass == 0) ptr[*p * E + e + 2]++;
                else id[ptr[*p * E + e + 1]++] = k;
            }
        }
        for (size_t k = 1; pass == 0 && k < cells + 2; k++) ptr[k] += ptr[k - 1];
    }
    return TSS_OK;
}

// Room for all parts: what one holds is bounded by its stencils.
static tss_result tss__sub_build_room(tss_subspace *s, int64_t *nodes, int64_t *pairs) {
    const int *ptr = tss__sub_i(&s->stencil_ptr);
    int64_t most = 0, slots = 0;
    *nodes = *pairs = 0;
    int64_t *at = (int64_t *)tss__sub_need(s, &s->stencil_at, (size_t)s->groups * (size_t)s->entries + 1,
                                           2 * sizeof(int64_t));
    if (!at) return tss__sub_no_memory(s);
    for (int p = 0; p < s->groups; p++) {
        int64_t here = 0;
        for (int e = 0; e < s->entries; e++) {
            tss_energy_view v;
            int k = p * s->entries + e, count = ptr[k + 1] - ptr[k];
            at[2 * k] = *nodes, at[2 * k + 1] = slots;
            if (count == 0 || tss_energy_get(s->w, e, &v) != TSS_OK) continue;
            *nodes += (int64_t)count * v.def->arity;
            slots += (int64_t)count * v.def->arity * v.def->arity;
            here += (int64_t)count * v.def->arity;
        }
        most = here > most ? here : most;
    }
    *pairs = slots;
    size_t work = 4 * (size_t)most + 1 + (size_t)s->n;
    if (!tss__sub_need(s, &s->scratch, work, sizeof(int)) ||
        !tss__sub_need(s, &s->parts, (size_t)s->groups, sizeof(tss__sub_part)) ||
        !tss__sub_need(s, &s->stencil_local, (size_t)(*nodes), sizeof(int)) ||
        !tss__sub_need(s, &s->stencil_slot, (size_t)slots, sizeof(int)))
        return tss__sub_no_memory(s);
    return TSS_OK;
}

// Local numbers of part p's nodes in the order they appear; returns how many.
static int tss__sub_part_nodes(tss_subspace *s, int p, int *local, int *list) {
    int count = 0;
    for (int e = 0; e < s->entries; e++) {
        tss_energy_view v;
        int k = p * s->entries + e, from = tss__sub_i(&s->stencil_ptr)[k], to = tss__sub_i(&s->stencil_ptr)[k + 1];
        if (from == to || tss_energy_get(s->w, e, &v) != TSS_OK) continue;
        int A = v.def->arity, *out = tss__sub_i(&s->stencil_local) + ((int64_t *)s->stencil_at.p)[2 * k];
        for (int t = from; t < to; t++)
            for (int i = 0; i < A; i++) {
                int node = v.list.node[tss__sub_i(&s->stencil_id)[t] * A + i];
                if (node >= 0 && local[node] < 0) list[count] = node, local[node] = count++;
                *out++ = node < 0 ? -1 : local[node];
            }
    }
    return count;
}

// The block pattern of part p, from a table of its stencils by local node: row (nodes + 1) and the
// columns of each row, ascending; returns the blocks. work: ints, see tss__sub_build_room.
static int tss__sub_part_pattern(tss_subspace *s, int p, int nodes, int *row, int *col, int *work) {
    int *from = work, *mark = from + nodes + 1, *list = mark + nodes, blocks = 0;
    const int64_t first = ((int64_t *)s->stencil_at.p)[2 * p * s->entries];
    const int *local = tss__sub_i(&s->stencil_local) + first;
    memset(from, 0, (size_t)(nodes + 1) * sizeof(int));
    for (int i = 0; i < nodes; i++) mark[i] = -1;
    for (int pass = 0; pass < 2; pass++) {
        for (int e = 0; e < s->entries; e++) {
            tss_energy_view v;
            int k = p * s->entries + e, m = tss__sub_i(&s->stencil_ptr)[k + 1] - tss__sub_i(&s->stencil_ptr)[k];
            if (m == 0 || tss_energy_get(s->w, e, &v) != TSS_OK) continue;
            const int A = v.def->arity, at = (int)(((int64_t *)s->stencil_at.p)[2 * k] - first);
            for (int t = at; t < at + m * A; t++) {
                if (local[t] < 0) continue;
                if (pass == 0) from[local[t]]++;
                else list[2 * --from[local[t]]] = at + (t - at) / A * A, list[2 * from[local[t]] + 1] = A;
            }
        }
        for (int i = 0; pass == 0 && i < nodes; i++) from[i + 1] += from[i];
    }
    for (int i = 0; i < nodes; i++) {
        row[i] = blocks;
        for (int t = from[i]; t < from[i + 1]; t++)
            for (int j = 0; j < list[2 * t + 1]; j++) {
                int other = local[list[2 * t] + j];
                if (other >= 0 && mark[other] != i) mark[other] = i, col[blocks++] = other;
            }
        tss__sort_ints(col + row[i], blocks - row[i]);
    }
    row[nodes] = blocks;
    return blocks;
}

// Where each pair of each stencil of part p goes.
static void tss__sub_part_slots(tss_subspace *s, int p, const int *row, const int *col) {
    for (int e = 0; e < s->entries; e++) {
        tss_energy_view v;
        int k = p * s->entries + e, m = tss__sub_i(&s->stencil_ptr)[k + 1] - tss__sub_i(&s->stencil_ptr)[k];
        if (m == 0 || tss_energy_get(s->w, e, &v) != TSS_OK) continue;
        const int64_t *at = (int64_t *)s->stencil_at.p + 2 * k;
        const int A = v.def->arity, *l = tss__sub_i(&s->stencil_local) + at[0];
        int *slot = tss__sub_i(&s->stencil_slot) + at[1];
        for (int t = 0; t < m; t++, l += A)
            for (int i = 0; i < A; i++)
                for (int j = 0; j < A; j++) {
                    int found = -1;
                    for (int q = l[i] < 0 ? 0 : row[l[i]]; l[i] >= 0 && l[j] >= 0 && q < row[l[i] + 1]; q++)
                        if (col[q] == l[j]) { found = q; break; }
                    *slot++ = found;
                }
    }
}

static tss_result tss__sub_build_parts(tss_subspace *s) {
    tss_result r = tss__sub_build_lists(s);
    int64_t room, pairs;
    if (r == TSS_OK) r = tss__sub_build_room(s, &room, &pairs);
    if (r != TSS_OK) return r;
    const int64_t *at = (int64_t *)s->stencil_at.p;
    int *local = (int *)s->scratch.p, *work = local + s->n;
    int *list = (int *)tss__sub_need(s, &s->part_node, (size_t)room, sizeof(int));
    int *row = (int *)tss__sub_need(s, &s->part_row, (size_t)(room + s->groups), sizeof(int));
    if (!list || !row) return tss__sub_no_memory(s);
    for (int i = 0; i < s->n; i++) local[i] = -1;
    int64_t node0 = 0, row0 = 0, col0 = 0;
    s->most_nodes = s->most_blocks = 0;
    for (int p = 0; p < s->groups; p++) {
        tss__sub_part *t = tss__sub_parts(s, p);
        memset(t, 0, sizeof *t);
        t->node0 = node0, t->row0 = row0, t->col0 = col0;
        t->nodes = tss__sub_part_nodes(s, p, local, list + node0);
        for (int i = 0; i < t->nodes; i++) local[list[node0 + i]] = -1;
        int64_t most = (p + 1 < s->groups ? at[2 * (p + 1) * s->entries + 1] : pairs) - at[2 * p * s->entries + 1];
        int *col = (int *)tss__sub_need(s, &s->part_col, (size_t)(col0 + most), sizeof(int));
        if (!col) return tss__sub_no_memory(s);
        col += col0;
        int blocks = tss__sub_part_pattern(s, p, t->nodes, row + row0, col, work);
        tss__sub_part_slots(s, p, row + row0, col);
        node0 += t->nodes, row0 += t->nodes + 1, col0 += blocks;
        if (t->nodes > s->most_nodes) s->most_nodes = t->nodes;
        if (blocks > s->most_blocks) s->most_blocks = blocks;
    }
    for (int k = 0; k < s->modal_count; k++)
        for (int g = 0; g < tss__sub_modal(s, k)->groups; g++)
            tss__sub_parts(s, tss__sub_modal(s, k)->group0 + g)->modal = k;
    if (!tss__sub_need(s, &s->part_diag, (size_t)node0 * (size_t)(s->dim * s->dim), sizeof(double)))
        return tss__sub_no_memory(s);
    return TSS_OK;
}

// node → stencils of the energies whose lists stay (dynamic 0) or change: pairs (entry, id).
static tss_result tss__sub_build_near(tss_subspace *s, int dynamic, tss__sub_buf *start, tss__sub_buf *list) {
    size_t n = (size_t)s->n;
    int *ptr = (int *)tss__sub_need(s, start, n + 1, sizeof(int));
    if (!ptr) return tss__sub_no_memory(s);
    memset(ptr, 0, (n + 1) * sizeof(int));
    for (int pass = 0; pass < 2; pass++) {
        int *out = tss__sub_i(list);
        for (int e = 0; e < tss_world_energies(s->w); e++) {
            tss_energy_view v;
            if (tss_energy_get(s->w, e, &v) != TSS_OK || !!(v.def->flags & TSS_ENERGY_DYNAMIC) != dynamic) continue;
            for (int k = 0; k < v.list.count * v.def->arity; k++) {
                int node = v.list.node[k];
                if (node < 0 || tss__sub_i(&s->body_of)[node] < 0) continue;
                if (pass == 0) { ptr[node + 1]++; continue; }
                out[2 * ptr[node]] = e, out[2 * ptr[node]++ + 1] = k / v.def->arity;
            }
        }
        if (pass == 1) break;
        for (size_t i = 0; i < n; i++) ptr[i + 1] += ptr[i];
        if (!tss__sub_need(s, list, 2 * (size_t)ptr[n], sizeof(int))) return tss__sub_no_memory(s);
    }
    for (size_t i = n; i > 0; i--) ptr[i] = ptr[i - 1];
    ptr[0] = 0;
    return TSS_OK;
}

static uint64_t tss__sub_patterns(const tss_subspace *s) {
    uint64_t sum = 0;
    for (int e = 0; e < tss_world_energies(s->w); e++) {
        tss_energy_view v;
        if (tss_energy_get(s->w, e, &v) == TSS_OK && !(v.def->flags & TSS_ENERGY_DYNAMIC))
            sum = sum * 31 + v.list.pattern + (uint64_t)v.list.count;
    }
    return sum;
}

// Brings the tables up to date. Lists must be those of the iterate.
static tss_result tss__sub_build(tss_subspace *s, const tss_ctx *c, const tss_unknowns *u) {
    uint64_t patterns = tss__sub_patterns(s);
    if (s->built && s->topology == c->topology && s->patterns == patterns) return TSS_OK;
    tss_result r = TSS_OK;
    double from = tss__sub_clock(s);
    s->ctx_body = c->body, s->entries = tss_world_energies(s->w);
    if (!s->built || s->n != c->nodes) {
        s->n = c->nodes, s->built = 0;
        if ((r = tss__sub_build_groups(s, c)) != TSS_OK) return r;
    }
    tss__sub_node_states(s, u);
    if ((r = tss__sub_build_parts(s)) == TSS_OK) r = tss__sub_build_near(s, 0, &s->near_ptr, &s->near_id);
    if (r != TSS_OK) return r;
    s->built = 1, s->topology = c->topology, s->patterns = patterns;
    s->setup_seconds += tss__sub_clock(s) - from;
    return TSS_OK;
}
// ---------------------------------------------------------------------------------------------
// >>modes (private)
// Active modes of a body in raw coordinates: the functions of its active blocks, each block
// orthonormal in the mass, component by component (mode p·c + s is φ_s in coordinate p), then the
// vector columns. Systems are solved for an independent choice of them, by a pivoted Cholesky of the
// Gram matrix: of all nodes for d_a ("wide"), of the nodes that are not enriched for B_a ("thin"),
// where modes that masking made dependent drop out. Orthonormal combinations were tried in place
// of a choice: no fewer iterations, and two products of a³ an iterate. Functions are never stored:
// rows are made from weights.
// ---------------------------------------------------------------------------------------------

static const double *tss__sub_X(const tss_subspace *s, const tss__modal *m) {
    return tss_world_rest(s->w) + (size_t)m->first * (size_t)s->dim;
}

// Rows of a factored basis: w_h (T_hᵀ m), four functions at a time in 3D.
static void tss__sub_phi_factored(const tss_subspace *s, const tss__sub_basis *b, const double *X, const int *node,
                                  int count, double *phi, int ld) {
    const int q = s->dim + 1;
    const double *T = tss__sub_f(&b->transposed);
    for (int i = 0; i < count; i++, phi += ld) {
        double m[4] = {1, 0, 0, 0};
        for (int a = 0; a < s->dim; a++) m[a + 1] = X[node[i] * s->dim + a] - b->b.center[a];
        const double *w = b->b.weight + (size_t)node[i] * (size_t)b->b.blocks;
        for (int j = 0; j < b->on_count; j++) {
            const double *t = T + j * q * q, v = w[tss__sub_i(&b->on)[j]];
            double *out = phi + j * q;
            if (q == 4)
                for (int k = 0; k < 4; k++)
                    out[k] = v * (t[k] + (t[4 + k] * m[1] + (t[8 + k] * m[2] + t[12 + k] * m[3])));
            else
                for (int k = 0; k < 3; k++) out[k] = v * (t[k] + (t[3 + k] * m[1] + t[6 + k] * m[2]));
        }
    }
}

// Rows of the active scalar functions at local nodes of a body: phi, count × c.
static void tss__sub_phi(const tss_subspace *s, int body, const int *node, int count, double *phi) {
    const tss__modal *m = tss__sub_modal(s, body);
    int at = 0;
    for (int k = 0; k < s->basis_count; k++) {
        const tss__sub_basis *b = tss__sub_base(s, k);
        if (!b->live || b->body != body || b->b.vector || b->on_count == 0) continue;
        if (b->b.transform)
            tss__sub_phi_factored(s, b, tss__sub_X(s, m), node, count, phi + at, m->c);
        else
            tss__basis_rows(&b->b, tss__sub_X(s, m), s->dim, node, count, tss__sub_i(&b->on), b->on_count, phi + at,
                            m->c);
        for (int j = 0; j < b->on_count; j++)
            at += b->b.first[tss__sub_i(&b->on)[j] + 1] - b->b.first[tss__sub_i(&b->on)[j]];
    }
}

// Rows of the active vector columns at local nodes: vec, (count · d) × r.
static void tss__sub_vec(const tss_subspace *s, int body, const int *node, int count, double *vec) {
    const tss__modal *m = tss__sub_modal(s, body);
    int at = 0;
    for (int k = 0; k < s->basis_count; k++) {
        const tss__sub_basis *b = tss__sub_base(s, k);
        if (!b->live || b->body != body || !b->b.vector) continue;
        for (int j = 0; j < b->on_count; j++)
            for (int f = b->b.first[tss__sub_i(&b->on)[j]]; f < b->b.first[tss__sub_i(&b->on)[j] + 1]; f++, at++)
                for (int i = 0; i < count * s->dim; i++)
                    vec[(size_t)i * (size_t)m->r + (size_t)at] =
                        b->b.value[((size_t)node[i / s->dim] * (size_t)s->dim + (size_t)(i % s->dim)) *
                                       (size_t)b->b.columns + (size_t)f];
    }
}

// Both at world nodes; rows of nodes that cannot be modal are 0, with mask those of enriched ones too.
static void tss__sub_rows(const tss_subspace *s, int body, const int *world, int count, int mask, int *local,
                          double *phi, double *vec) {
    const tss__modal *m = tss__sub_modal(s, body);
    for (int i = 0; i < count; i++) local[i] = world[i] - m->first;
    if (m->c > 0) tss__sub_phi(s, body, local, count, phi);
    if (m->r > 0) tss__sub_vec(s, body, local, count, vec);
    for (int i = 0; i < count; i++) {
        if (tss__sub_i(&s->body_of)[world[i]] == body && !(mask && tss__sub_u(&s->on)[world[i]])) continue;
        memset(phi + (size_t)i * (size_t)m->c, 0, (size_t)m->c * sizeof(double));
        memset(vec + (size_t)i * (size_t)(s->dim * m->r), 0, (size_t)(s->dim * m->r) * sizeof(double));
    }
}

// Transforms of the active blocks of factored bases, transposed for rows of four.
static tss_result tss__sub_transpose(tss_subspace *s, int body) {
    const int q = s->dim + 1;
    for (int k = 0; k < s->basis_count; k++) {
        tss__sub_basis *b = tss__sub_base(s, k);
        if (!b->live || b->body != body || !b->b.transform) continue;
        double *T = (double *)tss__sub_need(s, &b->transposed, (size_t)(b->b.blocks * q * q), sizeof(double));
        if (!T) return tss__sub_no_memory(s);
        for (int j = 0; j < b->on_count; j++)
            for (int r = 0; r < q; r++)
                for (int c = 0; c < q; c++)
                    T[(j * q + c) * q + r] = b->b.transform[(tss__sub_i(&b->on)[j] * q + r) * q + c];
    }
    return TSS_OK;
}

// map and map_block from the lists of active functions and columns.
static tss_result tss__sub_fill_map(tss_subspace *s, tss__modal *m, const int *column, const int *vec) {
    int d = s->dim, c = m->c, r = m->r, *map = tss__sub_i(&m->map), *block = tss__sub_i(&m->map_block);
    m->a = d * c + r;
    int *copy = (int *)tss__sub_need(s, &s->row_list, (size_t)m->columns + 1, sizeof(int));
    if (!copy) return tss__sub_no_memory(s);
    memcpy(copy, block, (size_t)m->columns * sizeof(int));
    for (int p = 0; p < d; p++)
        for (int k = 0; k < c; k++) map[p * c + k] = p * m->functions + column[k], block[p * c + k] = copy[k];
    for (int k = 0; k < r; k++) map[d * c + k] = d * m->functions + vec[k], block[d * c + k] = copy[m->columns - 1 - k];
    return TSS_OK;
}

// Room for the tables by column of one body; m->columns: all its modes.
static tss_result tss__sub_columns(tss_subspace *s, int body) {
    tss__modal *m = tss__sub_modal(s, body);
    m->columns = m->functions = 0;
    for (int k = 0; k < s->basis_count; k++) {
        const tss__sub_basis *b = tss__sub_base(s, k);
        if (!b->live || b->body != body) continue;
        m->columns += b->b.columns * (b->b.vector ? 1 : s->dim);
        if (!b->b.vector) m->functions += b->b.columns;
    }
    size_t before = m->q.bytes, n = (size_t)m->columns;
    if (!tss__sub_need(s, &m->map, n, sizeof(int)) || !tss__sub_need(s, &m->map_block, n, sizeof(int)) ||
        !tss__sub_need(s, &m->q, n, sizeof(double)))
        return tss__sub_no_memory(s);
    if (m->q.bytes > before) memset((char *)m->q.p + before, 0, m->q.bytes - before);
    return TSS_OK;
}

// Lists of active blocks of one body after its flags changed: c, r, a, and for each active mode its
// place among all modes (map) and its block (map_block).
static tss_result tss__sub_count_active(tss_subspace *s, int body) {
    tss__modal *m = tss__sub_modal(s, body);
    tss_result r = tss__sub_columns(s, body);
    int *column = (int *)tss__sub_need(s, &s->small_work, 2 * (size_t)m->columns + 2, sizeof(int));
    if (r != TSS_OK || !column) return r != TSS_OK ? r : tss__sub_no_memory(s);
    int scalars = 0, vectors = 0;  // of all blocks so far
    int *vec = column + m->columns, *at_block = tss__sub_i(&m->map_block);
    m->c = m->r = 0;
    for (int j = 0; j < m->blocks; j++) {  // blocks stand in the order of the bases
        const tss__sub_block *q = tss__sub_blocks(m) + j;
        tss__sub_basis *b = tss__sub_base(s, q->basis);
        int *on = (int *)tss__sub_need(s, &b->on, (size_t)b->b.blocks, sizeof(int));
        if (!on) return tss__sub_no_memory(s);
        if (q->block == 0) b->on_count = 0;
        int f = b->b.first[q->block + 1] - b->b.first[q->block], use = q->active || s->def.mode == TSS_MODE_SUBSPACE;
        if (use) on[b->on_count++] = q->block;
        for (int k = 0; use && k < f; k++) {
            if (b->b.vector) at_block[m->columns - 1 - m->r] = j, vec[m->r++] = vectors + k;
            else at_block[m->c] = j, column[m->c++] = scalars + k;
        }
        if (b->b.vector) vectors += f; else scalars += f;
    }
    r = tss__sub_transpose(s, body);
    return r == TSS_OK ? tss__sub_fill_map(s, m, column, vec) : r;
}

typedef struct tss__sub_gram {
    tss_subspace *s;
    int body, count;
    const int *node;  // world
    double *lane;     // TSS__SUB_LANES × (c + r)² … see the task
    size_t each;
    double *work;     // a worker's
    size_t work_each;
} tss__sub_gram;

// One lane: chunks lane, lane + LANES, …: (c × c) scalar Gram, then for each p (c × r), then r × r.
static void tss__sub_gram_task(int lane, int worker, void *arg) {
    const tss__sub_gram *g = (const tss__sub_gram *)arg;
    const tss_subspace *s = g->s;
    const tss__modal *m = tss__sub_modal(s, g->body);
    const int d = s->dim, c = m->c, r = m->r;
    const double *mass = tss_world_masses(s->w);
    double *phi = g->work + (size_t)worker * g->work_each, *vec = phi + TSS__SUB_CHUNK * c;
    double *mphi = vec + TSS__SUB_CHUNK * d * r, *mvec = mphi + TSS__SUB_CHUNK * c;
    double *cc = g->lane + (size_t)lane * g->each, *cr = cc + c * c, *rr = cr + d * c * r;
    memset(cc, 0, g->each * sizeof(double));
    for (int from = lane * TSS__SUB_CHUNK; from < g->count; from += TSS__SUB_LANES * TSS__SUB_CHUNK) {
        int local[TSS__SUB_CHUNK], n = g->count - from < TSS__SUB_CHUNK ? g->count - from : TSS__SUB_CHUNK;
        tss__sub_rows(s, g->body, g->node + from, n, 0, local, phi, vec);
        for (int i = 0; i < n; i++) {
            for (int k = 0; k < c; k++) mphi[i * c + k] = mass[g->node[from + i]] * phi[i * c + k];
            for (int k = 0; k < d * r; k++) mvec[i * d * r + k] = mass[g->node[from + i]] * vec[i * d * r + k];
        }
        if (c > 0) tss_dense_product(0, 1, c, c, n, 1, phi, c, mphi, c, 1, cc, c);
        for (int p = 0; c > 0 && r > 0 && p < d; p++)
            tss_dense_product(0, 1, c, r, n, 1, phi, c, mvec + p * r, d * r, 1, cr + p * c * r, c);
        if (r > 0) tss_dense_product(0, 1, r, r, n * d, 1, vec, r, mvec, r, 1, rr, r);
    }
}

// out (a × a) = Σ over the given nodes of m U_iᵀ U_i.
static tss_result tss__sub_gram_sum(tss_subspace *s, int body, const int *node, int count, double *out) {
    const tss__modal *m = tss__sub_modal(s, body);
    int d = s->dim, c = m->c, r = m->r, a = m->a;
    tss__sub_gram g;
    g.s = s, g.body = body, g.node = node, g.count = count;
    g.each = (size_t)(c * c + d * c * r + r * r), g.work_each = (size_t)(2 * TSS__SUB_CHUNK * (c + d * r));
    g.lane = (double *)tss__sub_need(s, &s->lane, TSS__SUB_LANES * g.each, sizeof(double));
    g.work = (double *)tss__sub_need(s, &s->scratch, g.work_each * (size_t)tss_workers(&s->host), sizeof(double));
    if (!g.lane || !g.work) return tss__sub_no_memory(s);
    tss_parallel(&s->host, TSS__SUB_LANES, tss__sub_gram_task, &g);
    for (int l = 1; l < TSS__SUB_LANES; l++)
        for (size_t k = 0; k < g.each; k++) g.lane[k] += g.lane[(size_t)l * g.each + k];
    const double *cc = g.lane, *cr = cc + c * c, *rr = cr + d * c * r;
    memset(out, 0, (size_t)a * (size_t)a * sizeof(double));
    for (int p = 0; p < d; p++) {
        for (int j = 0; j < c; j++)
            for (int i = 0; i < c; i++) out[(p * c + j) * a + p * c + i] = cc[j * c + i];
        for (int j = 0; j < r; j++)
            for (int i = 0; i < c; i++)
                out[(d * c + j) * a + p * c + i] = out[(p * c + i) * a + d * c + j] = cr[p * c * r + j * c + i];
    }
    for (int j = 0; j < r; j++)
        for (int i = 0; i < r; i++) out[(d * c + j) * a + d * c + i] = rr[j * r + i];
    return TSS_OK;
}

// Independent modes, ascending, from a Gram matrix (destroyed); lengths measured by `unit`, the
// diagonal of the unmasked one.
static tss_result tss__sub_choose(tss_subspace *s, int a, double *G, const double *unit, tss__sub_buf *chosen, int *rank) {
    int *keep = (int *)tss__sub_need(s, chosen, (size_t)a, sizeof(int)), count = 0;
    double *work = (double *)tss__sub_need(s, &s->small_work, 3 * (size_t)a, sizeof(double)), most = 0;
    if (!keep || !work) return tss__sub_no_memory(s);
    double *scale = work + a;
    int *perm = (int *)(void *)(scale + a);
    for (int i = 0; i < a; i++) scale[i] = unit[i] > 0 ? 1 / sqrt(unit[i]) : 0;
    for (int j = 0; j < a; j++)
        for (int i = 0; i < a; i++) G[j * a + i] *= scale[i] * scale[j];
    for (int i = 0; i < a; i++) most = G[i * a + i] > most ? G[i * a + i] : most;
    *rank = 0;
    if (!(most > TSS__SUB_DROP)) return TSS_OK;
    tss_dense_chol_pivoted(a, G, a, TSS__SUB_DROP / most, perm, rank, work);
    memset(work, 0, (size_t)a * sizeof(double));
    for (int k = 0; k < *rank; k++) work[perm[k]] = 1;
    for (int i = 0; i < a; i++)
        if (work[i] > 0) keep[count++] = i;
    return TSS_OK;
}

// Gram matrix and choice of U_a, room for what depends on a. Secants of the body start anew.
static tss_result tss__sub_refresh_basis(tss_subspace *s, int body) {
    tss__modal *m = tss__sub_modal(s, body);
    tss_result r = tss__sub_count_active(s, body);
    if (r != TSS_OK) return r;
    size_t a = (size_t)m->a;
    double *gram = (double *)tss__sub_need(s, &m->gram, a * a + a, sizeof(double));
    double *copy = (double *)tss__sub_need(s, &s->small, a * a, sizeof(double));
    int *node = (int *)tss__sub_need(s, &m->live, (size_t)m->nodes, sizeof(int));
    if (!gram || !copy || !node || !tss__sub_need(s, &m->s, a, sizeof(double))) return tss__sub_no_memory(s);
    for (int i = 0; i < m->nodes; i++) node[i] = m->first + i;
    if ((r = tss__sub_gram_sum(s, body, node, m->nodes, gram)) != TSS_OK) return r;
    double *unit = gram + a * a;
    for (size_t i = 0; i < a; i++) unit[i] = gram[i * a + i];
    memcpy(copy, gram, a * a * sizeof(double));
    r = tss__sub_choose(s, m->a, copy, unit, &m->wide, &m->wide_rank);
    if (r != TSS_OK) return r;
    for (int g = m->group0; g < m->group0 + m->groups; g++) tss__sub_parts(s, g)->fresh = 0;
    memset(m->s.p, 0, a * sizeof(double));
    m->stale = 0, m->thin_stale = m->sum_stale = 1;
    return TSS_OK;
}

// Choice of the masked modes: Gram of all nodes minus that of the enriched ones.
static tss_result tss__sub_mask(tss_subspace *s, int body) {
    tss__modal *m = tss__sub_modal(s, body);
    size_t a = (size_t)m->a;
    double *G = (double *)tss__sub_need(s, &s->small, 2 * a * a, sizeof(double));
    int *node = (int *)tss__sub_need(s, &m->live, (size_t)m->nodes, sizeof(int)), count = 0;
    if (!G || !node) return tss__sub_no_memory(s);
    const double *gram = tss__sub_f(&m->gram);
    for (int i = m->first; i < m->first + m->nodes; i++)
        if (tss__sub_u(&s->on)[i] && tss__sub_i(&s->body_of)[i] == body) node[count++] = i;
    m->enriched = count;
    tss_result r = tss__sub_gram_sum(s, body, node, count, G + a * a);
    if (r != TSS_OK) return r;
    for (size_t k = 0; k < a * a; k++) G[k] = gram[k] - G[a * a + k];
    double *kept = (double *)tss__sub_need(s, &m->thin_gram, a * a, sizeof(double));
    if (!kept) return tss__sub_no_memory(s);
    memcpy(kept, G, a * a * sizeof(double));
    m->thin_stale = 0;
    if (count == m->modal_nodes) {  // fully enriched: out of the modal system
        m->thin_rank = 0;
        return TSS_OK;
    }
    return tss__sub_choose(s, m->a, G, gram + a * a, &m->thin, &m->thin_rank);
}

// All bodies: bases that changed, masks that changed, offsets of modal vectors. *modes: Σ a.
static tss_result tss__sub_refresh(tss_subspace *s, size_t *modes) {
    size_t at = 0, h = 0, g = 0;
    tss_result r = TSS_OK;
    int moved = 0;
    for (int k = 0; k < s->modal_count && r == TSS_OK; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        moved |= m->stale;
        if (m->stale) r = tss__sub_refresh_basis(s, k);
        if (r == TSS_OK && m->thin_stale) r = tss__sub_mask(s, k);
        m->at = at, at += (size_t)m->a;
        for (int p = m->group0; p < m->group0 + m->groups; p++) {
            tss__sub_parts(s, p)->h = h, h += (size_t)m->a * (size_t)m->a;
            tss__sub_parts(s, p)->g = g, g += (size_t)m->a;
        }
    }
    if (r != TSS_OK) return r;
    for (int p = 0; moved && p < s->groups; p++) tss__sub_parts(s, p)->fresh = 0;  // offsets shift
    *modes = at;
    if (!tss__sub_need(s, &s->secant, h, sizeof(double)) || !tss__sub_need(s, &s->secant_g, 2 * g, sizeof(double)))
        return tss__sub_no_memory(s);
    return TSS_OK;
}
// ---------------------------------------------------------------------------------------------
// >>secant (private)
// Elastic part of H_a by subdomain (§3.9): H^ℓ = U_ℓᵀ (Σ_{stencils of ℓ} ∇²) U_ℓ, exact and
// projected where it starts, then BFGS with pairs s = α d_q, y = U_ℓᵀ(∇Ψ_ℓ(x¹) − ∇Ψ_ℓ(x⁰)). Gradients
// are summed over the subdomain's own stencils, interface nodes are not shared out. A secant holds
// only stencils none of whose nodes is enriched or moving: there the displacement is U s exactly and
// so is the pair. The others are evaluated exactly in every iterate. When a node of a held stencil
// is enriched, the subdomain starts anew at x without it: that costs what one exact evaluation of
// the whole subdomain would, which the paper does in every iterate from there on. Cost of a start:
// the Hessians, then 18 n_ℓ·ring·c + 12 n_ℓ c² flops a subdomain; of an update 4 a² + the gradients.
// ---------------------------------------------------------------------------------------------

typedef struct tss__sub_run {
    tss_subspace *s;
    const tss_iterate *it;
    const tss_ctx *ctx;
    const double *x;
    double *work;
    size_t each;
    int next;      // gradients go to the second half of secant_g
    int only_new;  // of parts whose H^ℓ is not set yet
} tss__sub_run;

#define TSS__SUB_STENCIL (8 * 3)  // widest row of a stencil's Hessian: arity 8 in 3D

static int tss__sub_nonzero(const double *blk, int dd) {
    double size = 0;
    for (int q = 0; q < dd; q++) size += fabs(blk[q]);
    return size > 0;
}

// y[0..n) += v · x[0..n)
static void tss__sub_axpy(int n, double v, const double *x, double *y) {
    for (int k = 0; k < n; k++) y[k] += v * x[k];
}

// Whether a node of the stencil is enriched, or kinematic and on its way.
static int tss__sub_coupled(const tss_subspace *s, const tss_iterate *it, const int *node, int arity) {
    int coupled = 0;
    for (int i = 0; i < arity && !coupled; i++) {
        if (node[i] < 0) continue;
        coupled = tss__sub_u(&s->on)[node[i]] != 0;
        for (int q = 0; !coupled && it->moves && it->ctx->kind[node[i]] != TSS_NODE_FREE && q < s->dim; q++)
            coupled = it->d[node[i] * s->dim + q] != 0;
    }
    return coupled;
}

// The next at most TSS_BATCH held stencils of a list from *at on: their ids and places in the list.
static int tss__sub_next_held(const uint8_t *held, const int *id, int count, int *at, int *ids, int *place) {
    int m = 0;
    for (; *at < count && m < TSS_BATCH; ++*at)
        if (held[id[*at]] == TSS__SUB_HELD) ids[m] = id[*at], place[m++] = *at;
    return m;
}

// Sum of the held stencils' Hessians of part p into K (its block pattern).
static void tss__sub_part_stiffness(const tss__sub_run *run, int p, double *K, double *out) {
    const tss_subspace *s = run->s;
    const int dim = s->dim, dd = dim * dim, *ptr = tss__sub_i(&s->stencil_ptr) + p * s->entries;
    for (int e = 0; e < s->entries; e++) {
        tss_energy_view v;
        if (ptr[e] == ptr[e + 1] || tss_energy_get(s->w, e, &v) != TSS_OK) continue;
        const int A = v.def->arity, S = A * dim, *id = tss__sub_i(&s->stencil_id) + ptr[e];
        const int *slot = tss__sub_i(&s->stencil_slot) + ((int64_t *)s->stencil_at.p)[2 * (p * s->entries + e) + 1];
        const uint8_t *held = tss__sub_u(&s->held) + tss__sub_i(&s->part_of_at)[e];
        int list[TSS_BATCH], place[TSS_BATCH], at = 0, m;
        while ((m = tss__sub_next_held(held, id, ptr[e + 1] - ptr[e], &at, list, place)) > 0) {
            tss_ids ids = {0, m, list};
            v.def->hessian(v.def->user, run->ctx, run->x, ids, 1, out);
            for (int k = 0; k < m; k++)
                for (int ij = 0; ij < A * A; ij++) {
                    int to_slot = slot[place[k] * A * A + ij];
                    if (to_slot < 0) continue;
                    double *to = K + (size_t)to_slot * (size_t)dd;
                    const double *H = out + (size_t)k * (size_t)(S * S) + (size_t)((ij / A) * dim * S + (ij % A) * dim);
                    for (int r = 0; r < dim; r++)
                        for (int c = 0; c < dim; c++) to[r * dim + c] += v.scale * H[r * S + c];
                }
        }
    }
}

// Blocks of one row of K and the rows of U they meet: phi (c) and vec (d × r) of each.
#define TSS__SUB_ROW 64  // taken at a time
typedef struct tss__sub_row {
    int count;
    const double *blk[TSS__SUB_ROW], *phi[TSS__SUB_ROW], *vec[TSS__SUB_ROW];
} tss__sub_row;

// T[p·a + k] (+)= Σ blk[3p] phi[k] for eight k and the three p: the sums stay in registers.
static void tss__sub_row_eight(const tss__sub_row *w, int q, int from, int first, int a, double *T) {
    tss__lanes t0 = {0}, t1 = {0}, t2 = {0};
    if (!first) {
        TSS__EACH_LANE(l) t0[l] = T[l];
        TSS__EACH_LANE(l) t1[l] = T[a + l];
        TSS__EACH_LANE(l) t2[l] = T[2 * a + l];
    }
    for (int n = 0; n < w->count; n++) {
        const double *blk = w->blk[n] + q, *phi = w->phi[n] + from;
        const double v0 = blk[0], v1 = blk[3], v2 = blk[6];
        TSS__EACH_LANE(l) t0[l] += v0 * phi[l];
        TSS__EACH_LANE(l) t1[l] += v1 * phi[l];
        TSS__EACH_LANE(l) t2[l] += v2 * phi[l];
    }
    TSS__EACH_LANE(l) T[l] = t0[l];
    TSS__EACH_LANE(l) T[a + l] = t1[l];
    TSS__EACH_LANE(l) T[2 * a + l] = t2[l];
}

// T (d × a) += K_i U over the blocks of w; first: T = K_i U.
static void tss__sub_row_times(int d, int c, int r, const tss__sub_row *w, int first, double *T) {
    const int a = d * c + r;
    const int eights = d == 3 ? c / 8 * 8 : 0;
    for (int p = 0; first && p < d; p++) {
        for (int q = 0; q < d; q++) memset(T + p * a + q * c + eights, 0, (size_t)(c - eights) * sizeof(double));
        memset(T + p * a + d * c, 0, (size_t)r * sizeof(double));
    }
    for (int q = 0; q < d; q++)
        for (int from = 0; from < eights; from += 8) tss__sub_row_eight(w, q, from, first, a, T + q * c + from);
    for (int n = 0; n < w->count; n++)
        for (int p = 0; p < d; p++)
            for (int q = 0; q < d; q++) {
                double v = w->blk[n][p * d + q];
                if (eights < c) tss__sub_axpy(c - eights, v, w->phi[n] + eights, T + p * a + q * c + eights);
                if (r > 0) tss__sub_axpy(r, v, w->vec[n] + q * r, T + p * a + d * c);
            }
}

// H (a × a_b: rows modes of the T side, columns modes of the row side) = beta H + T for count rows: T
// is count × d × a; phi count × c_b, vec count × d × r_b. lower: a body's own H, blocks above its
// diagonal are left out.
static void tss__sub_gather(int d, int count, int a, const double *T, int cb, int rb, const double *phi,
                            const double *vec, int lower, double beta, double *H) {
    for (int p = 0; p < d; p++) {
        int f = lower ? p * cb : 0, v = lower ? d * cb : 0;  // first row that is wanted
        if (cb > 0)
            tss_dense_product(0, 1, a - f, cb, count, 1, T + p * a + f, d * a, phi, cb, beta,
                              H + (size_t)(p * cb) * (size_t)a + f, a);
        if (rb > 0)
            tss_dense_product(0, 1, a - v, rb, count, 1, T + p * a + v, d * a, vec + p * rb, d * rb, p > 0 ? 1 : beta,
                              H + (size_t)(d * cb) * (size_t)a + v, a);
    }
}

// Decides which stencils a part that starts holds from here on.
static void tss__sub_hold_task(int p, int worker, void *arg) {
    const tss__sub_run *run = (const tss__sub_run *)arg;
    const tss_subspace *s = run->s;
    (void)worker;
    if (!tss__sub_parts(s, p)->valid || tss__sub_parts(s, p)->fresh) return;
    const int *ptr = tss__sub_i(&s->stencil_ptr) + p * s->entries;
    for (int e = 0; e < s->entries; e++) {
        tss_energy_view v;
        if (ptr[e] == ptr[e + 1] || tss_energy_get(s->w, e, &v) != TSS_OK) continue;
        uint8_t *held = tss__sub_u(&s->held) + tss__sub_i(&s->part_of_at)[e];
        for (int k = ptr[e]; k < ptr[e + 1]; k++) {
            int id = tss__sub_i(&s->stencil_id)[k];
            int coupled = tss__sub_coupled(s, run->it, v.list.node + id * v.def->arity, v.def->arity);
            if (!coupled) held[id] = TSS__SUB_HELD;
            else if (held[id] == TSS__SUB_HELD) held[id] = TSS__SUB_EXACT;
        }
    }
}

static void tss__sub_hessian_task(int p, int worker, void *arg) {
    const tss__sub_run *run = (const tss__sub_run *)arg;
    const tss_subspace *s = run->s;
    tss__sub_part *t = tss__sub_parts(s, p);
    if (!t->valid || t->fresh || t->nodes == 0) return;
    const tss__modal *m = tss__sub_modal(s, t->modal);
    const int d = s->dim, dd = d * d, c = m->c, r = m->r, a = m->a;
    const int *row = tss__sub_i(&s->part_row) + t->row0, *col = tss__sub_i(&s->part_col) + t->col0;
    const int *node = tss__sub_i(&s->part_node) + t->node0;
    double *out = run->work + (size_t)worker * run->each, *K = out + TSS_BATCH * TSS__SUB_STENCIL * TSS__SUB_STENCIL;
    double *phi = K + (size_t)row[t->nodes] * (size_t)dd, *vec = phi + (size_t)t->nodes * (size_t)c;
    double *T = vec + (size_t)t->nodes * (size_t)(d * r), *H = tss__sub_f(&s->secant) + t->h;
    int *local = (int *)(void *)(T + (size_t)t->nodes * (size_t)(d * a)), *kept = local + t->nodes, *at = kept + t->nodes;
    memset(K, 0, (size_t)row[t->nodes] * (size_t)dd * sizeof(double));
    tss__sub_part_stiffness(run, p, K, out);
    t->used = 0;  // nodes of held stencils: where much is enriched, few are left
    for (int i = 0; i < t->nodes; i++) {
        at[i] = -1;
        for (int k = row[i]; k < row[i + 1]; k++) {
            const double *blk = K + (size_t)k * (size_t)dd;
            if (col[k] != i) continue;
            memcpy(tss__sub_f(&s->part_diag) + (size_t)(t->node0 + i) * (size_t)dd, blk, (size_t)dd * sizeof(double));
            if (tss__sub_nonzero(blk, dd)) at[i] = t->used;
        }
        if (at[i] >= 0) kept[t->used++] = node[i];
    }
    tss__sub_rows(s, t->modal, kept, t->used, 0, local, phi, vec);
    for (int i = 0; i < t->nodes; i++) {
        tss__sub_row w;
        int first = 1;
        w.count = 0;
        for (int k = row[i]; at[i] >= 0 && k < row[i + 1]; k++) {
            if (at[col[k]] >= 0) {
                w.blk[w.count] = K + (size_t)k * (size_t)dd;
                w.phi[w.count] = phi + (size_t)at[col[k]] * (size_t)c;
                w.vec[w.count++] = vec + (size_t)at[col[k]] * (size_t)(d * r);
            }
            if (w.count < TSS__SUB_ROW && k + 1 < row[i + 1]) continue;
            tss__sub_row_times(d, c, r, &w, first, T + (size_t)at[i] * (size_t)(d * a));
            first = 0, w.count = 0;
        }
    }
    if (t->used > 0) tss__sub_gather(d, t->used, a, T, c, r, phi, vec, 1, 0, H);
    else memset(H, 0, (size_t)a * (size_t)a * sizeof(double));
    t->fresh = 1;
}

// U_ℓᵀ ∇Ψ_ℓ(x) of valid subdomains.
static void tss__sub_gradient_task(int p, int worker, void *arg) {
    const tss__sub_run *run = (const tss__sub_run *)arg;
    const tss_subspace *s = run->s;
    const tss__sub_part *t = tss__sub_parts(s, p);
    if (!t->valid || t->nodes == 0 || run->only_new == t->fresh) return;
    const tss__modal *m = tss__sub_modal(s, t->modal);
    const int d = s->dim, c = m->c, r = m->r, a = m->a, *ptr = tss__sub_i(&s->stencil_ptr) + p * s->entries;
    const int *node = tss__sub_i(&s->part_node) + t->node0;
    double *out = run->work + (size_t)worker * run->each, *g = out + TSS_BATCH * TSS__SUB_STENCIL;
    double *phi = g + (size_t)t->nodes * (size_t)d, *vec = phi + (size_t)t->nodes * (size_t)c;
    int *local = (int *)(void *)(vec + (size_t)t->nodes * (size_t)(d * r));
    double *y = tss__sub_f(&s->secant_g) + (run->next ? s->modal_g : 0) + t->g;
    memset(g, 0, (size_t)t->nodes * (size_t)d * sizeof(double));
    memset(y, 0, (size_t)a * sizeof(double));
    for (int e = 0; e < s->entries; e++) {
        tss_energy_view v;
        if (ptr[e] == ptr[e + 1] || tss_energy_get(s->w, e, &v) != TSS_OK) continue;
        const int A = v.def->arity, *l = tss__sub_i(&s->stencil_local) + ((int64_t *)s->stencil_at.p)[2 * (p * s->entries + e)];
        const int *id = tss__sub_i(&s->stencil_id) + ptr[e];
        const uint8_t *held = tss__sub_u(&s->held) + tss__sub_i(&s->part_of_at)[e];
        int list[TSS_BATCH], place[TSS_BATCH], at = 0, m2;
        while ((m2 = tss__sub_next_held(held, id, ptr[e + 1] - ptr[e], &at, list, place)) > 0) {
            tss_ids ids = {0, m2, list};
            v.def->gradient(v.def->user, run->ctx, run->x, ids, out);
            for (int k = 0; k < m2 * A; k++) {
                int to = l[place[k / A] * A + k % A];
                for (int q = 0; to >= 0 && q < d; q++) g[to * d + q] += v.scale * out[k * d + q];
            }
        }
    }
    tss__sub_rows(s, t->modal, node, t->nodes, 0, local, phi, vec);
    for (int i = 0; i < t->nodes; i++)
        for (int q = 0; q < d; q++) {
            tss__sub_axpy(c, g[i * d + q], phi + (size_t)i * (size_t)c, y + q * c);
            tss__sub_axpy(r, g[i * d + q], vec + (size_t)(i * d + q) * (size_t)r, y + d * c);
        }
}

// H += y yᵀ/yᵀs − (Hs)(Hs)ᵀ/sᵀHs where the curvature is safe; y = g¹ − g⁰.
static void tss__sub_bfgs_task(int p, int worker, void *arg) {
    const tss__sub_run *run = (const tss__sub_run *)arg;
    tss_subspace *s = run->s;
    tss__sub_part *t = tss__sub_parts(s, p);
    t->skipped = 0;
    if (!t->valid || !t->fresh || t->used == 0) return;
    const tss__modal *m = tss__sub_modal(s, t->modal);
    const int a = m->a;
    const double *step = tss__sub_f(&m->s);
    double *g0 = tss__sub_f(&s->secant_g) + t->g, *g1 = g0 + s->modal_g, *H = tss__sub_f(&s->secant) + t->h;
    double *y = run->work + (size_t)worker * run->each, *Hs = y + a;
    double ys = 0, sHs = 0, yy = 0, hh = 0, ss = 0;
    memset(Hs, 0, (size_t)a * sizeof(double));
    for (int j = 0; j < a; j++) {  // the lower triangle is what is kept
        const double *col = H + (size_t)j * (size_t)a;
        double sum[4] = {0, 0, 0, 0};
        int i = j + 1;
        tss__sub_axpy(a - j, step[j], col + j, Hs + j);
        for (; i + 4 <= a; i += 4)
            for (int l = 0; l < 4; l++) sum[l] += col[i + l] * step[i + l];
        for (; i < a; i++) sum[0] += col[i] * step[i];
        Hs[j] += (sum[0] + sum[1]) + (sum[2] + sum[3]);
        y[j] = g1[j] - g0[j];
    }
    for (int i = 0; i < a; i++)
        ys += y[i] * step[i], sHs += step[i] * Hs[i], yy += y[i] * y[i], hh += Hs[i] * Hs[i], ss += step[i] * step[i];
    memcpy(g0, g1, (size_t)a * sizeof(double));
    // Both curvatures well above rounding: 1e-8 of what the two vectors could make of each other.
    t->skipped = !(ys > 1e-8 * sqrt(yy * ss)) || !(sHs > 1e-8 * sqrt(hh * ss));
    if (t->skipped) return;
    for (int j = 0; j < a; j++) {
        double u = y[j] / ys, v = Hs[j] / sHs;
        for (int i = j; i < a; i++) H[(size_t)j * (size_t)a + (size_t)i] += u * y[i] - v * Hs[i];
    }
}

static size_t tss__sub_part_room(const tss_subspace *s) {
    size_t most = 0, n = (size_t)s->most_nodes;
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        size_t here = n * (size_t)(m->c + s->dim * m->r + s->dim * m->a) + 2 * (size_t)m->a;
        most = here > most ? here : most;
    }
    return most + n * (size_t)(s->dim + 1) + (size_t)s->most_blocks * (size_t)(s->dim * s->dim) +
           TSS_BATCH * TSS__SUB_STENCIL * TSS__SUB_STENCIL + 64;
}

// 1 if a stencil that part p holds has come to touch an enriched or moving node.
static int tss__sub_spoiled(const tss_subspace *s, const tss_iterate *it, int p) {
    const int *ptr = tss__sub_i(&s->stencil_ptr) + p * s->entries;
    for (int e = 0; e < s->entries; e++) {
        tss_energy_view v;
        if (ptr[e] == ptr[e + 1] || tss_energy_get(s->w, e, &v) != TSS_OK) continue;
        const uint8_t *held = tss__sub_u(&s->held) + tss__sub_i(&s->part_of_at)[e];
        for (int k = ptr[e]; k < ptr[e + 1]; k++) {
            int id = tss__sub_i(&s->stencil_id)[k];
            if (held[id] == TSS__SUB_HELD && tss__sub_coupled(s, it, v.list.node + id * v.def->arity, v.def->arity))
                return 1;
        }
    }
    return 0;
}

// Which subdomains have a secant in this iterate, and which must start anew.
static void tss__sub_validate(tss_subspace *s, const tss_iterate *it) {
    for (int p = 0; p < s->groups; p++) {
        tss__sub_part *t = tss__sub_parts(s, p);
        int ok = tss__sub_modal(s, t->modal)->a > 0 && t->nodes > 0;
        const int *node = tss__sub_i(&s->part_node) + t->node0;
        if (ok && t->fresh && tss__sub_coupled(s, it, node, t->nodes) && tss__sub_spoiled(s, it, p)) t->fresh = 0;
        if (ok != t->valid) tss__sub_modal(s, t->modal)->sum_stale = 1;
        t->valid = ok;
    }
}

// A secant is worth an update once nodes have moved this many tolerances: shorter moves change
// neither F nor H noticeably, and most iterates of a step are such.
#define TSS__SUB_MOVED 10.0

// Brings all H^ℓ to x: exact where they are new, BFGS elsewhere. All of them stand at one x, so a
// new one makes the others catch up.
static tss_result tss__sub_update_secants(tss_subspace *s, const tss_iterate *it) {
    tss__sub_run run;
    memset(&run, 0, sizeof run);
    run.s = s, run.it = it, run.ctx = it->ctx, run.x = it->x, run.each = tss__sub_part_room(s);
    run.work = (double *)tss__sub_need(s, &s->scratch, run.each * (size_t)tss_workers(&s->host), sizeof(double));
    if (!run.work) return tss__sub_no_memory(s);
    s->modal_g = 0;
    int fresh = 0, stale = 0, update;
    for (int k = 0; k < s->modal_count; k++)
        s->modal_g += (size_t)tss__sub_modal(s, k)->a * (size_t)tss__sub_modal(s, k)->groups;
    for (int p = 0; p < s->groups; p++) {
        tss__sub_part *t = tss__sub_parts(s, p);
        if (s->def.secant == TSS_SECANT_EXACT) t->fresh = 0;
        fresh += t->valid && t->fresh, stale += t->valid && !t->fresh;
    }
    update = s->def.secant == TSS_SECANT_BFGS && fresh > 0 && s->moved > 0 &&
             (stale > 0 || s->moved > TSS__SUB_MOVED * it->tol);
    if (update) {
        run.next = 1;
        tss_parallel(&s->host, s->groups, tss__sub_gradient_task, &run);
        tss_parallel(&s->host, s->groups, tss__sub_bfgs_task, &run);
        for (int p = 0; p < s->groups; p++) {
            tss__sub_part *t = tss__sub_parts(s, p);
            if (t->valid && t->fresh) s->secant_updates++, s->secant_skips += (uint64_t)t->skipped;
        }
    }
    tss_world_clock_phase(s->w, TSS_PHASE_GRADIENT);
    if (stale > 0) {
        s->kept = 0;  // stencils may leave A
        // parts that start here remember where: their gradient at x
        tss_parallel(&s->host, s->groups, tss__sub_hold_task, &run);
        if (s->def.secant == TSS_SECANT_BFGS) {
            run.next = 0, run.only_new = 1;
            tss_parallel(&s->host, s->groups, tss__sub_gradient_task, &run);
        }
        tss_parallel(&s->host, s->groups, tss__sub_hessian_task, &run);
        s->hessians += (uint64_t)stale;
        tss_world_clock_phase(s->w, TSS_PHASE_HESSIAN);
    }
    if (update || fresh == 0) {
        for (int k = 0; k < s->modal_count; k++)
            memset(tss__sub_modal(s, k)->s.p, 0, (size_t)tss__sub_modal(s, k)->a * sizeof(double));
        s->moved = 0;
    }
    for (int k = 0; k < s->modal_count; k++) tss__sub_modal(s, k)->sum_stale |= update || stale > 0;
    return TSS_OK;
}
// ---------------------------------------------------------------------------------------------
// >>exact_part (private)
// Stencils that are not replaced by secants are summed into the world's own matrices, only in the
// rows of their nodes ("live" rows): everything touching an enriched or moving node, contact,
// friction, user energies. Inertia of modal nodes is the Gram matrix instead.
// ---------------------------------------------------------------------------------------------

enum { TSS__SUB_ON = 1, TSS__SUB_NEW = 2 };   // node states: enriched; enriched by this iterate's oracle
enum { TSS__SUB_LIVE = 1, TSS__SUB_MARKED = 2 };  // rows of A: cleared and in use; to be cleared

// Chooses the stencils of a secant energy that join now: those that no secant holds, once.
static int tss__sub_choose_secant(tss_subspace *s, int e, int count, int again, uint8_t *want) {
    uint8_t *held = tss__sub_u(&s->held) + tss__sub_i(&s->part_of_at)[e];
    int any = 0;
    for (int k = 0; k < count; k++) {
        if (!again && held[k] == TSS__SUB_ADDED) held[k] = TSS__SUB_EXACT;
        want[k] = held[k] == TSS__SUB_EXACT;
        if (want[k]) held[k] = TSS__SUB_ADDED, any = 1;
    }
    return any;
}

// Inertia of enriched nodes; later of those just added.
static int tss__sub_choose_inertia(tss_subspace *s, const tss_energy_view *v, int again, uint8_t *want) {
    int any = 0;
    for (int k = 0; k < v->list.count; k++) {
        uint8_t on = tss__sub_u(&s->on)[v->list.node[k]];
        want[k] = (uint8_t)(again ? on == TSS__SUB_NEW : on != 0);
        any |= want[k];
    }
    return any;
}

typedef struct tss__sub_clearing {
    tss_subspace *s;
    int rows;
} tss__sub_clearing;

// Clears the marked rows of A, neighbours in one go.
static void tss__sub_clear_task(int chunk, int worker, void *arg) {
    const tss__sub_clearing *c = (const tss__sub_clearing *)arg;
    const tss_bcsr *A = &c->s->A;
    uint8_t *live = tss__sub_u(&c->s->live_row);
    const int dd = c->s->dim * c->s->dim, to = (chunk + 1) * 512 < c->rows ? (chunk + 1) * 512 : c->rows;
    (void)worker;
    for (int r = chunk * 512; r < to; r++) {
        int first = r;
        for (; r < to && live[r] == TSS__SUB_MARKED; r++) live[r] = TSS__SUB_LIVE;
        memset(A->val + A->row[first] * dd, 0, (size_t)(A->row[r] - A->row[first]) * (size_t)dd * sizeof(double));
    }
}

// Clears the rows of A that the chosen stencils touch for the first time.
static void tss__sub_open_rows(tss_subspace *s, const tss_unknowns *u, const tss_energy_view *v, const uint8_t *want) {
    const int A = v->def->arity;
    uint8_t *live = tss__sub_u(&s->live_row);
    for (int k = 0; k < v->list.count; k++) {
        if (want && !want[k]) continue;
        for (int i = k * A; i < (k + 1) * A; i++) {
            int r = v->list.node[i] < 0 ? -1 : u->row[v->list.node[i]];
            if (r < 0 || live[r]) continue;
            live[r] = TSS__SUB_MARKED;
        }
    }
    tss__sub_clearing c = {s, u->rows};
    tss__parallel_even(&s->host, (u->rows + 511) / 512, tss__sub_clear_task, &c);
}

// ‖Σ α d‖∞ in tolerances within which A is not summed anew. 10 to 80 took the same iterates in
// jello_rubber.json, where a cell is 1,500 tolerances wide.
#define TSS__SUB_LAG 20.0

// Whether A of the iterate before will do: nodes have hardly moved since it was summed, nothing of it
// has joined a secant, and all it holds changes with F alone, or not at all. As for secants, the
// Newton matrix is then an approximation; ∇E, contact and what converges are not.
static int tss__sub_lags(const tss_subspace *s, const tss_iterate *it, const tss_bcsr *A) {
    if (!s->kept || s->kept_stamp != s->x_stamp || s->def.secant == TSS_SECANT_EXACT || it->moves || s->query) return 0;
    if (s->drift > TSS__SUB_LAG * it->tol || A->val != s->A.val || A->pattern != s->A.pattern) return 0;
    for (int e = 0; e < tss_world_energies(s->w); e++) {
        tss_energy_view v;
        if (tss_energy_get(s->w, e, &v) != TSS_OK || (v.def->flags & TSS_ENERGY_DYNAMIC)) continue;
        if (!(v.def->flags & (TSS_ENERGY_SECANT_OK | TSS_ENERGY_CONST_HESSIAN))) return 0;
    }
    return 1;
}

// again 0: a new iterate; 1: what nodes just enriched brought.
static tss_result tss__sub_assemble(tss_subspace *s, const tss_iterate *it, const tss_unknowns *u, int again) {
    tss_result r = TSS_OK;
    const int dd = s->dim * s->dim;
    size_t most = 1;
    for (int e = 0; e < tss_world_energies(s->w); e++) {
        tss_energy_view v;
        if (tss_energy_get(s->w, e, &v) == TSS_OK && (size_t)v.list.count > most) most = (size_t)v.list.count;
    }
    uint8_t *want = (uint8_t *)tss__sub_need(s, &s->want, most, 1);
    uint8_t *live = (uint8_t *)tss__sub_need(s, &s->live_row, (size_t)u->rows, 1);
    if (!want || !live) return tss__sub_no_memory(s);
    int lags = 0;
    if (!again) {
        tss_bcsr A;
        if ((r = tss_world_matrices(s->w, &A, &s->C)) != TSS_OK) return r;
        lags = tss__sub_lags(s, it, &A);
        s->A = A, s->kept = 0;  // until this iterate has its direction
        if (!lags) memset(live, 0, (size_t)u->rows), s->drift = 0;
        memset(s->C.val, 0, (size_t)s->C.row[u->rows] * (size_t)dd * sizeof(double));
        for (int k = 0; k < u->rows; k++)
            for (int c = 0; c < s->dim; c++)
                tss__sub_f(&s->rhs)[k * s->dim + c] = -it->g[u->node[k] * s->dim + c];
    }
    if (!lags) s->kept_H = 0, s->kept_x = 0;
    tss_world_clock_phase(s->w, TSS_PHASE_ASSEMBLE);
    for (int e = 0; e < tss_world_energies(s->w) && r == TSS_OK; e++) {
        tss_energy_view v;
        int all = 0, any;
        if (tss_energy_get(s->w, e, &v) != TSS_OK || v.list.count == 0) continue;
        if (lags && !(v.def->flags & TSS_ENERGY_DYNAMIC)) continue;
        tss_energy_view secant;
        if (tss__sub_secant_entry(s, e, &secant)) any = tss__sub_choose_secant(s, e, v.list.count, again, want);
        else if (v.inertia) any = tss__sub_choose_inertia(s, &v, again, want);
        else any = all = !again;
        if (!any) continue;
        if (!(v.def->flags & TSS_ENERGY_DYNAMIC)) tss__sub_open_rows(s, u, &v, all ? NULL : want);
        r = tss_world_add_hessian(s->w, e, it->x, all ? NULL : want, it->moves ? it->d : NULL, tss__sub_f(&s->rhs));
    }
    for (int k = 0; u->fixed && k < u->rows * s->dim; k++)
        if (u->fixed[k]) tss__sub_f(&s->rhs)[k] = 0;
    tss_world_clock_phase(s->w, TSS_PHASE_HESSIAN);
    return r;
}

// Live nodes of each body and their rows of U.
static void tss__sub_live_task(int chunk, int worker, void *arg);

typedef struct tss__sub_rows_run {
    tss_subspace *s;
    int body;
} tss__sub_rows_run;

static void tss__sub_live_task(int chunk, int worker, void *arg) {
    const tss__sub_rows_run *run = (const tss__sub_rows_run *)arg;
    const tss_subspace *s = run->s;
    const tss__modal *m = tss__sub_modal(s, run->body);
    int local[TSS__SUB_CHUNK], from = chunk * TSS__SUB_CHUNK;
    (void)worker;
    int n = m->lives - from < TSS__SUB_CHUNK ? m->lives - from : TSS__SUB_CHUNK;
    tss__sub_rows(s, run->body, tss__sub_i(&m->live) + from, n, 0, local,
                  tss__sub_f(&m->phi) + (size_t)from * (size_t)m->c,
                  tss__sub_f(&m->vec) + (size_t)from * (size_t)(s->dim * m->r));
}

static tss_result tss__sub_live_rows(tss_subspace *s, const tss_unknowns *u) {
    int *index = (int *)tss__sub_need(s, &s->live_index, (size_t)s->n, sizeof(int));
    if (!index) return tss__sub_no_memory(s);
    for (int k = 0; k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        m->lives = 0;
        for (int i = m->first; i < m->first + m->nodes; i++) {
            int r = u->row[i];
            if (r < 0 || tss__sub_i(&s->body_of)[i] != k) continue;
            if (!tss__sub_u(&s->live_row)[r] && s->C.row[r] == s->C.row[r + 1]) continue;
            index[i] = m->lives;
            tss__sub_i(&m->live)[m->lives++] = i;
        }
        if (!tss__sub_need(s, &m->phi, (size_t)m->lives * (size_t)m->c, sizeof(double)) ||
            !tss__sub_need(s, &m->vec, (size_t)m->lives * (size_t)(s->dim * m->r), sizeof(double)))
            return tss__sub_no_memory(s);
        tss__sub_rows_run run = {s, k};
        tss_parallel(&s->host, (m->lives + TSS__SUB_CHUNK - 1) / TSS__SUB_CHUNK, tss__sub_live_task, &run);
    }
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>modal_vectors (private)
// Uᵀ f and U q over all nodes of all bodies, rows of U made chunk by chunk. mask: enriched nodes
// are left out (B_a in place of U_a).
// ---------------------------------------------------------------------------------------------

typedef struct tss__sub_field {
    tss_subspace *s;
    int body, mask;
    const double *in;
    double *out, *work;
    size_t each;
} tss__sub_field;

static void tss__sub_restrict_task(int lane, int worker, void *arg) {
    const tss__sub_field *f = (const tss__sub_field *)arg;
    const tss_subspace *s = f->s;
    const tss__modal *m = tss__sub_modal(s, f->body);
    const int d = s->dim, c = m->c, r = m->r;
    double *phi = f->work + (size_t)worker * f->each, *vec = phi + TSS__SUB_CHUNK * c;
    double *y = f->out + (size_t)lane * (size_t)m->a;
    memset(y, 0, (size_t)m->a * sizeof(double));
    for (int from = lane * TSS__SUB_CHUNK; from < m->nodes; from += TSS__SUB_LANES * TSS__SUB_CHUNK) {
        int world[TSS__SUB_CHUNK], local[TSS__SUB_CHUNK];
        int n = m->nodes - from < TSS__SUB_CHUNK ? m->nodes - from : TSS__SUB_CHUNK;
        for (int i = 0; i < n; i++) world[i] = m->first + from + i;
        tss__sub_rows(s, f->body, world, n, f->mask, local, phi, vec);
        for (int i = 0; i < n * d; i++) {
            double v = f->in[(m->first + from) * d + i];
            tss__sub_axpy(c, v, phi + (i / d) * c, y + (i % d) * c);
            tss__sub_axpy(r, v, vec + i * r, y + d * c);
        }
    }
}

// out (all modes) = Uᵀ f, f n × d.
static tss_result tss__sub_restrict(tss_subspace *s, const double *f, int mask, double *out) {
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        tss__sub_field run = {s, k, mask, f, NULL, NULL, 0};
        run.each = (size_t)(TSS__SUB_CHUNK * (m->c + s->dim * m->r));
        run.out = (double *)tss__sub_need(s, &s->lane, (size_t)(TSS__SUB_LANES * m->a), sizeof(double));
        run.work = (double *)tss__sub_need(s, &s->scratch, run.each * (size_t)tss_workers(&s->host), sizeof(double));
        if (!run.out || !run.work) return tss__sub_no_memory(s);
        tss_parallel(&s->host, TSS__SUB_LANES, tss__sub_restrict_task, &run);
        for (int i = 0; i < m->a; i++) {
            double sum = 0;
            for (int l = 0; l < TSS__SUB_LANES; l++) sum += run.out[l * m->a + i];
            out[m->at + (size_t)i] = sum;
        }
    }
    return TSS_OK;
}

static void tss__sub_extend_task(int chunk, int worker, void *arg) {
    const tss__sub_field *f = (const tss__sub_field *)arg;
    const tss_subspace *s = f->s;
    const tss__modal *m = tss__sub_modal(s, f->body);
    const int d = s->dim, c = m->c, r = m->r, from = chunk * TSS__SUB_CHUNK;
    double *phi = f->work + (size_t)worker * f->each, *vec = phi + TSS__SUB_CHUNK * c;
    const double *q = f->in + m->at;
    int world[TSS__SUB_CHUNK] = {0}, local[TSS__SUB_CHUNK];
    int n = m->nodes - from < TSS__SUB_CHUNK ? m->nodes - from : TSS__SUB_CHUNK;
    for (int i = 0; i < n; i++) world[i] = m->first + from + i;
    tss__sub_rows(s, f->body, world, n, f->mask, local, phi, vec);
    for (int i = 0; i < n; i++) {
        if (tss__sub_i(&s->body_of)[world[i]] != f->body || (f->mask && tss__sub_u(&s->on)[world[i]])) continue;
        for (int p = 0; p < d; p++) {
            double sum = 0;
            for (int k = 0; k < c; k++) sum += phi[i * c + k] * q[p * c + k];
            for (int k = 0; k < r; k++) sum += vec[(i * d + p) * r + k] * q[d * c + k];
            f->out[world[i] * d + p] = sum;
        }
    }
}

// Writes U q into d (n × d) at the nodes of one body that have modes.
static tss_result tss__sub_extend_body(tss_subspace *s, int body, const double *q, int mask, double *d) {
    const tss__modal *m = tss__sub_modal(s, body);
    tss__sub_field run = {s, body, mask, q, d, NULL, 0};
    run.each = (size_t)(TSS__SUB_CHUNK * (m->c + s->dim * m->r));
    run.work = (double *)tss__sub_need(s, &s->scratch, run.each * (size_t)tss_workers(&s->host), sizeof(double));
    if (!run.work) return tss__sub_no_memory(s);
    tss_parallel(&s->host, (m->nodes + TSS__SUB_CHUNK - 1) / TSS__SUB_CHUNK, tss__sub_extend_task, &run);
    return TSS_OK;
}

static tss_result tss__sub_extend(tss_subspace *s, const double *q, int mask, double *d) {
    tss_result r = TSS_OK;
    for (int k = 0; k < s->modal_count && r == TSS_OK; k++) r = tss__sub_extend_body(s, k, q, mask, d);
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>coupled_system (private)
// H_q, J and H_x of Eq. (19), or the unmasked H_a of Eq. (18). H_q is block-sparse by body: inertia
// (Gram matrix), secants and exact part of each body, and contact between two of them. With
// T = K U for the rows of the exact part K, modal rows give UᵀT to H_q and enriched rows are J.
// Only the blocks b ≤ c of a pair of bodies are kept.
// ---------------------------------------------------------------------------------------------

typedef struct tss__sub_project {
    tss_subspace *s;
    const tss_unknowns *u;
    int row_body, col_body, mask, from;  // from: matrices, 1: A, 2: C
    const int *node;                     // rows: world nodes
    int count;
    double *lane, *work;
    size_t lane_each, each;
} tss__sub_project;

// T (d × a of body) = K_i U over the neighbours in that body.
static void tss__sub_times_row(const tss__sub_project *p, int row, double *T) {
    const tss_subspace *s = p->s;
    const tss__modal *m = tss__sub_modal(s, p->col_body);
    const int d = s->dim, dd = d * d;
    tss__sub_row w;
    int first = 1;
    w.count = 0;
    for (int part = 0; part < 2; part++) {
        const tss_bcsr *K = part ? &s->C : &s->A;
        if (!(p->from & (1 << part)) || (!part && !tss__sub_u(&s->live_row)[row])) continue;
        for (int64_t k = K->row[row]; k < K->row[row + 1]; k++) {
            int j = p->u->node[K->col[k]];
            if (tss__sub_i(&s->body_of)[j] != p->col_body || (p->mask && tss__sub_u(&s->on)[j])) continue;
            const double *blk = K->val + k * dd;
            if (!tss__sub_nonzero(blk, dd)) continue;
            size_t at = (size_t)tss__sub_i(&s->live_index)[j];
            w.blk[w.count] = blk, w.phi[w.count] = tss__sub_f(&m->phi) + at * (size_t)m->c;
            w.vec[w.count++] = tss__sub_f(&m->vec) + at * (size_t)(d * m->r);
            if (w.count < TSS__SUB_ROW) continue;
            tss__sub_row_times(d, m->c, m->r, &w, first, T);
            first = 0, w.count = 0;
        }
    }
    if (first || w.count > 0) tss__sub_row_times(d, m->c, m->r, &w, first, T);
}

static void tss__sub_project_task(int lane, int worker, void *arg) {
    const tss__sub_project *p = (const tss__sub_project *)arg;
    const tss_subspace *s = p->s;
    const tss__modal *mr = tss__sub_modal(s, p->row_body), *mc = tss__sub_modal(s, p->col_body);
    const int d = s->dim, a = mc->a, c = mr->c, r = mr->r;
    double *T = p->work + (size_t)worker * p->each, *phi = T + TSS__SUB_CHUNK * d * a;
    double *vec = phi + TSS__SUB_CHUNK * c, *H = p->lane + (size_t)lane * p->lane_each;
    for (int from = lane * TSS__SUB_CHUNK; from < p->count; from += TSS__SUB_LANES * TSS__SUB_CHUNK) {
        int n = p->count - from < TSS__SUB_CHUNK ? p->count - from : TSS__SUB_CHUNK;
        for (int i = 0; i < n; i++) {
            int node = p->node[from + i];
            size_t at = (size_t)tss__sub_i(&s->live_index)[node];
            tss__sub_times_row(p, p->u->row[node], T + i * d * a);
            memcpy(phi + i * c, tss__sub_f(&mr->phi) + at * (size_t)c, (size_t)c * sizeof(double));
            memcpy(vec + i * d * r, tss__sub_f(&mr->vec) + at * (size_t)(d * r), (size_t)(d * r) * sizeof(double));
        }
        tss__sub_gather(d, n, a, T, c, r, phi, vec, p->row_body == p->col_body, from > lane * TSS__SUB_CHUNK, H);
    }
}

// H (a_c × a_b) += U_cᵀ K U_b over the given rows of body b, K of the given matrices.
static tss_result tss__sub_project_rows(tss_subspace *s, const tss_unknowns *u, int b, int c, int mask, int from,
                                        const int *node, int count, double *H) {
    const tss__modal *mb = tss__sub_modal(s, b), *mc = tss__sub_modal(s, c);
    if (count == 0 || mb->a == 0 || mc->a == 0) return TSS_OK;
    tss__sub_project p = {s, u, b, c, mask, from, node, count, NULL, NULL, 0, 0};
    p.lane_each = (size_t)mb->a * (size_t)mc->a;
    p.each = (size_t)(TSS__SUB_CHUNK * (s->dim * mc->a + mb->c + s->dim * mb->r));
    p.lane = (double *)tss__sub_need(s, &s->lane, TSS__SUB_LANES * p.lane_each, sizeof(double));
    p.work = (double *)tss__sub_need(s, &s->scratch, p.each * (size_t)tss_workers(&s->host), sizeof(double));
    if (!p.lane || !p.work) return tss__sub_no_memory(s);
    int lanes = (count + TSS__SUB_CHUNK - 1) / TSS__SUB_CHUNK;  // those that have rows
    if (lanes > TSS__SUB_LANES) lanes = TSS__SUB_LANES;
    tss_parallel(&s->host, lanes, tss__sub_project_task, &p);
    const size_t height = (size_t)mc->a;
    for (size_t j = 0; j < (size_t)mb->a; j++)  // of a body's own H the lower triangle
        for (int l = 0; l < lanes; l++) {
            const double *sum = p.lane + (size_t)l * p.lane_each + j * height;
            for (size_t i = b == c ? j : 0; i < height; i++) H[j * height + i] += sum[i];
        }
    return TSS_OK;
}

typedef struct tss__sub_sum {
    tss_subspace *s;
    int body;
    double *H;
} tss__sub_sum;

// Column j of the lower triangle of a body's Σ H^ℓ over its valid parts.
static void tss__sub_sum_task(int j, int worker, void *arg) {
    const tss__sub_sum *u = (const tss__sub_sum *)arg;
    const tss__modal *m = tss__sub_modal(u->s, u->body);
    size_t a = (size_t)m->a;
    double *to = u->H + (size_t)j * a;
    (void)worker;
    memset(to, 0, a * sizeof(double));
    for (int p = m->group0; p < m->group0 + m->groups; p++) {
        const tss__sub_part *t = tss__sub_parts(u->s, p);
        if (t->valid && t->fresh && t->used > 0)
            tss__sub_axpy((int)a - j, 1, tss__sub_f(&u->s->secant) + t->h + (size_t)j * a + j, to + j);
    }
}

static int tss__sub_compare_keys(const void *a, const void *b) {
    uint64_t x = *(const uint64_t *)a, y = *(const uint64_t *)b;
    return x < y ? -1 : x > y;
}

// Pairs of bodies that share a block of A or C, as keys b · count + c with b < c, sorted.
static tss_result tss__sub_find_crosses(tss_subspace *s, const tss_unknowns *u) {
    size_t count = 0, at = 0;
    const int *body_of = tss__sub_i(&s->body_of);
    for (int k = 0; s->modal_count > 1 && k < u->rows; k++)
        for (int part = 0; part < 2; part++) {
            const tss_bcsr *K = part ? &s->C : &s->A;
            int b = body_of[u->node[k]];
            if (b < 0 || (!part && !tss__sub_u(&s->live_row)[k])) continue;
            for (int64_t q = K->row[k]; q < K->row[k + 1]; q++) {
                int c = body_of[u->node[K->col[q]]];
                if (c <= b) continue;
                uint64_t *key = (uint64_t *)tss__sub_need(s, &s->pair_key, count + 1, sizeof(uint64_t));
                if (!key) return tss__sub_no_memory(s);
                uint64_t v = (uint64_t)b * (uint64_t)s->modal_count + (uint64_t)c;
                if (count == 0 || key[count - 1] != v) key[count++] = v;
            }
        }
    uint64_t *key = (uint64_t *)s->pair_key.p;
    if (count > 0) qsort(key, count, sizeof *key, tss__sub_compare_keys);
    s->crosses = 0;
    for (size_t k = 0; k < count; k++) {
        if (k > 0 && key[k] == key[k - 1]) continue;
        tss__sub_cross *x = (tss__sub_cross *)tss__sub_need(s, &s->cross, (size_t)s->crosses + 1, sizeof *x);
        if (!x) return tss__sub_no_memory(s);
        x += s->crosses++;
        x->b = (int)(key[k] / (uint64_t)s->modal_count), x->c = (int)(key[k] % (uint64_t)s->modal_count);
        x->at = at;
        at += (size_t)tss__sub_modal(s, x->b)->a * (size_t)tss__sub_modal(s, x->c)->a;
    }
    return tss__sub_need(s, &s->cross_val, at, sizeof(double)) ? TSS_OK : tss__sub_no_memory(s);
}

// Live rows of body b that are wanted: not enriched (mask), in one of the matrices, with a neighbour
// in body c (c ≥ 0).
static int tss__sub_pick_rows(const tss_subspace *s, const tss_unknowns *u, int b, int c, int mask, int from, int *out) {
    const tss__modal *m = tss__sub_modal(s, b);
    int count = 0;
    for (int k = 0; k < m->lives; k++) {
        int node = tss__sub_i(&m->live)[k], row = u->row[node];
        if (mask && tss__sub_u(&s->on)[node]) continue;
        int near = c < 0 && (((from & 1) && tss__sub_u(&s->live_row)[row]) || ((from & 2) && s->C.row[row] < s->C.row[row + 1]));
        for (int part = 0; c >= 0 && !near && part < 2; part++) {
            const tss_bcsr *K = part ? &s->C : &s->A;
            if (!part && !tss__sub_u(&s->live_row)[row]) continue;
            for (int64_t q = K->row[row]; !near && q < K->row[row + 1]; q++)
                near = tss__sub_i(&s->body_of)[u->node[K->col[q]]] == c;
        }
        if (near) out[count++] = node;
    }
    return count;
}

// H_a (mask 0) or H_q (mask 1) in raw coordinates.
static tss_result tss__sub_build_H(tss_subspace *s, const tss_unknowns *u, const tss_ctx *ctx, int mask) {
    size_t at = 0;
    int *list = (int *)tss__sub_need(s, &s->row_list, (size_t)s->n, sizeof(int));
    tss_result r = list ? tss__sub_find_crosses(s, u) : tss__sub_no_memory(s);
    for (int k = 0; k < s->modal_count; k++)
        tss__sub_modal(s, k)->hat = at, at += (size_t)tss__sub_modal(s, k)->a * (size_t)tss__sub_modal(s, k)->a;
    double *H = (double *)tss__sub_need(s, &s->H, at, sizeof(double));
    if (r != TSS_OK || !H) return r != TSS_OK ? r : tss__sub_no_memory(s);
    for (int k = 0; k < s->modal_count && r == TSS_OK; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        size_t aa = (size_t)m->a * (size_t)m->a;
        if (m->a == 0) continue;
        if (ctx->quasistatic) memset(H + m->hat, 0, aa * sizeof(double));
        else memcpy(H + m->hat, m->thin_gram.p, aa * sizeof(double));  // enriched nodes' inertia is in A
        tss__sub_sum sum = {s, k, (double *)tss__sub_need(s, &m->sum, aa, sizeof(double))};
        if (!sum.H) return tss__sub_no_memory(s);
        if (m->sum_stale) tss_parallel(&s->host, m->a, tss__sub_sum_task, &sum);
        m->sum_stale = 0;
        double *E = (double *)tss__sub_need(s, &m->exact[mask], aa, sizeof(double));
        if (!E) return tss__sub_no_memory(s);
        if (!(s->kept_H & (1 << mask))) {
            memset(E, 0, aa * sizeof(double));
            int rows = tss__sub_pick_rows(s, u, k, -1, mask, 1, list);
            r = tss__sub_project_rows(s, u, k, k, mask, 1, list, rows, E);
        }
        for (size_t q = 0; q < aa; q++) H[m->hat + q] += sum.H[q] + E[q];
        int count = tss__sub_pick_rows(s, u, k, -1, mask, 2, list);
        if (r == TSS_OK) r = tss__sub_project_rows(s, u, k, k, mask, 2, list, count, H + m->hat);
        for (int i = 0; i < m->a; i++)  // the two halves differ by rounding
            for (int j = 0; j < i; j++) H[m->hat + (size_t)(i * m->a + j)] = H[m->hat + (size_t)(j * m->a + i)];
    }
    for (int k = 0; k < s->crosses && r == TSS_OK; k++) {
        const tss__sub_cross *x = (const tss__sub_cross *)s->cross.p + k;
        double *val = tss__sub_f(&s->cross_val) + x->at;
        memset(val, 0, (size_t)tss__sub_modal(s, x->b)->a * (size_t)tss__sub_modal(s, x->c)->a * sizeof(double));
        int count = tss__sub_pick_rows(s, u, x->b, x->c, mask, 3, list);
        r = tss__sub_project_rows(s, u, x->b, x->c, mask, 3, list, count, val);
    }
    if (r == TSS_OK) s->kept_H |= 1 << mask;
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>modal_solve (private)
// H⁻¹ on the chosen modes by dense Cholesky, body by body; bodies in touch together, as one dense matrix or, when
// that would be large, by the sparse factorisation. A matrix without inertia may be singular: a
// growing multiple of its diagonal is added.
// ---------------------------------------------------------------------------------------------

static const int *tss__sub_kept(const tss__modal *m, int mask) { return tss__sub_i(mask ? &m->thin : &m->wide); }
static int tss__sub_rank(const tss__modal *m, int mask) { return mask ? m->thin_rank : m->wide_rank; }

// Components of bodies linked by crosses: m->component, the lowest body; m->tilde, offset in it.
static void tss__sub_components(tss_subspace *s, int mask) {
    for (int k = 0; k < s->modal_count; k++) tss__sub_modal(s, k)->component = k;
    for (int again = 1; again;) {
        again = 0;
        for (int k = 0; k < s->crosses; k++) {
            const tss__sub_cross *x = (const tss__sub_cross *)s->cross.p + k;
            int *b = &tss__sub_modal(s, x->b)->component, *c = &tss__sub_modal(s, x->c)->component;
            if (*b == *c) continue;
            *b = *c = *b < *c ? *b : *c;
            again = 1;
        }
    }
    int large = -1;
    for (int pass = 0; pass < 2; pass++) {
        for (int k = 0; k < s->modal_count; k++) tss__sub_modal(s, k)->width = 0;
        for (int k = 0; k < s->modal_count; k++) {
            tss__modal *m = tss__sub_modal(s, k), *lead = tss__sub_modal(s, m->component);
            m->tilde = lead->width, lead->width += tss__sub_rank(m, mask);
        }
        for (int k = 0; pass == 0 && k < s->modal_count; k++) {  // one sparse matrix for all large ones
            if (tss__sub_modal(s, k)->component != k || tss__sub_modal(s, k)->width <= TSS__SUB_DENSE) continue;
            if (large < 0) large = k;
            for (int j = k; j < s->modal_count; j++)
                if (tss__sub_modal(s, j)->component == k) tss__sub_modal(s, j)->component = large;
        }
    }
}

// out (rank_c × rank_b, leading dimension ld): the chosen rows and columns of V, a_c × a_b.
static void tss__sub_pick(const tss__modal *b, const tss__modal *c, int mask, const double *V, double *out, int ld) {
    const int *kb = tss__sub_kept(b, mask), *kc = tss__sub_kept(c, mask);
    for (int j = 0; j < tss__sub_rank(b, mask); j++)
        for (int i = 0; i < tss__sub_rank(c, mask); i++) out[j * ld + i] = V[kb[j] * c->a + kc[i]];
}

// The dense matrix of one component, lower triangle, at `to`.
static void tss__sub_component_matrix(tss_subspace *s, int lead, int mask, double *to) {
    int width = tss__sub_modal(s, lead)->width;
    memset(to, 0, (size_t)width * (size_t)width * sizeof(double));
    for (int k = lead; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        if (m->component == lead)
            tss__sub_pick(m, m, mask, tss__sub_f(&s->H) + m->hat, to + m->tilde * width + m->tilde, width);
    }
    for (int k = 0; k < s->crosses; k++) {
        const tss__sub_cross *x = (const tss__sub_cross *)s->cross.p + k;
        const tss__modal *b = tss__sub_modal(s, x->b), *c = tss__sub_modal(s, x->c);
        if (b->component == lead)  // b < c: the lower triangle
            tss__sub_pick(b, c, mask, tss__sub_f(&s->cross_val) + x->at, to + b->tilde * width + c->tilde, width);
    }
}

// Factors in place; a copy is kept beside while the diagonal may have to grow.
static tss_result tss__sub_factor_dense(tss_subspace *s, int width, double *M, int *shifted) {
    size_t bytes = (size_t)width * (size_t)width * sizeof(double);
    double *keep = (double *)tss__sub_need(s, &s->small, bytes, 1), mean = 0;
    if (!keep) return tss__sub_no_memory(s);
    memcpy(keep, M, bytes);
    for (int i = 0; i < width; i++) mean += fabs(M[i * width + i]) / width;
    for (double shift = 1e-12; tss_dense_chol_factor(width, M, width, NULL) != TSS_OK; shift *= 100) {
        if (shift > 1e6 || !(mean > 0) || !isfinite(mean))
            return tss_world_fail(s->w, TSS_ERROR_SINGULAR, "subspace: H_q is not positive definite");
        memcpy(M, keep, bytes);
        for (int i = 0; i < width; i++) M[i * width + i] += shift * mean;
        *shifted = 1;
    }
    return TSS_OK;
}

// Sparse matrix of a large component: 1 × 1 blocks, both triangles.
static tss_result tss__sub_factor_sparse(tss_subspace *s, int lead, int mask);

static tss_result tss__sub_factor(tss_subspace *s, int mask) {
    size_t at = 0;
    tss__sub_components(s, mask);
    for (int k = 0; k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        if (m->component != k || m->width > TSS__SUB_DENSE) continue;
        m->factor = at, at += (size_t)m->width * (size_t)m->width;
    }
    double *F = (double *)tss__sub_need(s, &s->factors, at, sizeof(double));
    if (!F) return tss__sub_no_memory(s);
    tss_result r = TSS_OK;
    for (int k = 0; k < s->modal_count && r == TSS_OK; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        int shifted = 0;
        if (m->component != k || m->width == 0) continue;
        if (m->width > TSS__SUB_DENSE) { r = tss__sub_factor_sparse(s, k, mask); continue; }
        tss__sub_component_matrix(s, k, mask, F + m->factor);
        r = tss__sub_factor_dense(s, m->width, F + m->factor, &shifted);
    }
    return r;
}

static tss_result tss__sub_factor_sparse(tss_subspace *s, int lead, int mask) {
    int width = tss__sub_modal(s, lead)->width;
    tss_bcsr *S = &s->Sq;
    int64_t blocks = 0;
    // Row i of a body is as long as the widths of the bodies it touches.
    int *order = (int *)tss__sub_need(s, &s->row_list, (size_t)s->n + (size_t)(2 * s->crosses + s->modal_count) * 2, sizeof(int));
    if (!order) return tss__sub_no_memory(s);
    int *pair = order + s->n, pairs = 0;
    for (int k = lead; k < s->modal_count; k++)
        if (tss__sub_modal(s, k)->component == lead) pair[2 * pairs] = k, pair[2 * pairs++ + 1] = k;
    for (int k = 0; k < s->crosses; k++) {
        const tss__sub_cross *x = (const tss__sub_cross *)s->cross.p + k;
        if (tss__sub_modal(s, x->b)->component != lead) continue;
        pair[2 * pairs] = x->b, pair[2 * pairs++ + 1] = x->c;
        pair[2 * pairs] = x->c, pair[2 * pairs++ + 1] = x->b;
    }
    for (int k = 0; k < pairs; k++)
        blocks += (int64_t)tss__sub_rank(tss__sub_modal(s, pair[2 * k]), mask) * tss__sub_rank(tss__sub_modal(s, pair[2 * k + 1]), mask);
    tss_result r = tss_bcsr_reserve(&s->host, S, width, 1, blocks);
    if (r != TSS_OK) return tss__sub_no_memory(s);
    int64_t at = 0;
    for (int b = lead; b < s->modal_count; b++) {
        const tss__modal *m = tss__sub_modal(s, b);
        if (m->component != lead) continue;
        for (int i = 0; i < tss__sub_rank(m, mask); i++) {
            S->row[m->tilde + i] = at;
            for (int c = lead; c < s->modal_count; c++) {  // columns ascend with the bodies
                int linked = 0;
                for (int k = 0; k < pairs; k++) linked |= pair[2 * k] == b && pair[2 * k + 1] == c;
                const tss__modal *mc = tss__sub_modal(s, c);
                for (int j = 0; linked && j < tss__sub_rank(mc, mask); j++) S->col[at++] = mc->tilde + j;
            }
        }
    }
    S->row[width] = at;
    memset(S->val, 0, (size_t)at * sizeof(double));
    for (int k = 0; k < pairs; k++) {
        const tss__modal *b = tss__sub_modal(s, pair[2 * k]), *c = tss__sub_modal(s, pair[2 * k + 1]);
        int rb = tss__sub_rank(b, mask), rc = tss__sub_rank(c, mask);
        double *block = (double *)tss__sub_need(s, &s->small, (size_t)rb * (size_t)rc + 1, sizeof(double));
        if (!block) return tss__sub_no_memory(s);
        const double *V = tss__sub_f(&s->H) + b->hat;
        if (b > c) continue;  // filled with its mirror
        for (int q = 0; b != c && q < s->crosses; q++) {
            const tss__sub_cross *x = (const tss__sub_cross *)s->cross.p + q;
            if (x->b == pair[2 * k] && x->c == pair[2 * k + 1]) V = tss__sub_f(&s->cross_val) + x->at;
        }
        tss__sub_pick(b, c, mask, V, block, rc);
        for (int i = 0; i < rb; i++)
            for (int j = 0; j < rc; j++) {
                *tss_bcsr_block(S, b->tilde + i, c->tilde + j) = block[i * rc + j];
                *tss_bcsr_block(S, c->tilde + j, b->tilde + i) = block[i * rc + j];
            }
    }
    S->pattern = 0;
    if (!s->chol_q) {
        tss_chol_def d = tss_chol_def_default();
        if (tss_chol_create(&s->host, &d, &s->chol_q) != TSS_OK) return tss__sub_no_memory(s);
    }
    r = tss_chol_analyze(s->chol_q, S, NULL);
    if (r == TSS_OK) r = tss_chol_factor(s->chol_q, S, NULL, NULL);
    return r == TSS_OK ? r : tss_world_fail(s->w, r, "subspace: H_q: %s", tss_result_text(r));
}

// out = H⁻¹ r on the chosen modes, 0 on the others; r and out may be the same.
static tss_result tss__sub_modal_apply(tss_subspace *s, int mask, const double *r, double *out) {
    for (int lead = 0; lead < s->modal_count; lead++) {
        const tss__modal *l = tss__sub_modal(s, lead);
        if (l->component != lead) continue;
        double *y = (double *)tss__sub_need(s, &s->small_rhs, (size_t)l->width, sizeof(double));
        if (!y) return tss__sub_no_memory(s);
        for (int k = lead; k < s->modal_count; k++) {
            const tss__modal *m = tss__sub_modal(s, k);
            if (m->component != lead) continue;
            for (int j = 0; j < tss__sub_rank(m, mask); j++)
                y[m->tilde + j] = r[m->at + (size_t)tss__sub_kept(m, mask)[j]];
        }
        if (l->width > TSS__SUB_DENSE) {
            tss_result r2 = tss_chol_solve(s->chol_q, y, 1);
            if (r2 != TSS_OK) return tss_world_fail(s->w, r2, "subspace: H_q: %s", tss_result_text(r2));
        } else if (l->width > 0)
            tss_dense_chol_solve(l->width, tss__sub_f(&s->factors) + l->factor, l->width, y, l->width, 1);
        for (int k = lead; k < s->modal_count; k++) {
            const tss__modal *m = tss__sub_modal(s, k);
            if (m->component != lead) continue;
            memset(out + m->at, 0, (size_t)m->a * sizeof(double));
            for (int j = 0; j < tss__sub_rank(m, mask); j++)
                out[m->at + (size_t)tss__sub_kept(m, mask)[j]] = y[m->tilde + j];
        }
    }
    return TSS_OK;
}
// ---------------------------------------------------------------------------------------------
// >>enriched_solve (private)
// The Schur complement of Eq. (21)–(22), with the right-hand side as elimination gives it:
//     (H_x − J H_q⁻¹Jᵀ) d_x = r_x − J H_q⁻¹ r_q,   d_q = H_q⁻¹ (r_q − Jᵀ d_x),   r = −g,
// J = K_xq U here the rows of enriched nodes (the transpose of the paper's). It is kept as its two
// factors: the blocks of K between enriched nodes and the modal nodes they share a stencil with, and
// those nodes' rows of U. A product costs d · c a modal node in place of d · a an enriched one, and
// the rows stay in the cache. Either conjugate gradients with the
// blocks of H_x's diagonal as preconditioner, or a sparse Cholesky of H_x and the dense complement
// H_q − JᵀH_x⁻¹J; the choice is by counted work, as in >>linear of tss.h. Nothing enriched: no solve.
// ---------------------------------------------------------------------------------------------

#define TSS__SUB_PCG_FLOP 4.0  // a flop of a sparse product in flops of a dense kernel
#define TSS__SUB_PCG_REST 40   // solves between two trials of PCG where the direct solve is preferred

// Numbers the enriched nodes.
static tss_result tss__sub_number_enriched(tss_subspace *s, const tss_unknowns *u) {
    int *xrow = (int *)tss__sub_need(s, &s->xrow, (size_t)u->rows, sizeof(int));
    int *xnode = (int *)tss__sub_need(s, &s->xnode, (size_t)u->rows, sizeof(int));
    uint8_t *mask = (uint8_t *)tss__sub_need(s, &s->xmask, (size_t)(u->rows * s->dim), 1);
    if (!xrow || !xnode || !mask) return tss__sub_no_memory(s);
    s->xrows = 0;
    for (int k = 0; k < u->rows; k++) {
        xrow[k] = -1;
        if (!tss__sub_u(&s->on)[u->node[k]]) continue;
        for (int c = 0; c < s->dim; c++)
            mask[s->xrows * s->dim + c] = (uint8_t)(u->fixed ? u->fixed[k * s->dim + c] : 0);
        xrow[k] = s->xrows, xnode[s->xrows++] = u->node[k];
    }
    return TSS_OK;
}

typedef struct tss__sub_extraction {
    const tss_subspace *s;
    const tss_unknowns *u;
    const tss_bcsr *K;
    tss_bcsr *out;
    int fill;
} tss__sub_extraction;

static void tss__sub_extract_task(int chunk, int worker, void *arg) {
    const tss__sub_extraction *x = (const tss__sub_extraction *)arg;
    const int *xrow = tss__sub_i(&x->s->xrow), *xnode = tss__sub_i(&x->s->xnode), dd = x->s->dim * x->s->dim;
    int to = (chunk + 1) * 512 < x->s->xrows ? (chunk + 1) * 512 : x->s->xrows;
    (void)worker;
    for (int i = chunk * 512; i < to; i++) {
        int r = x->u->row[xnode[i]];
        int64_t at = x->fill ? x->out->row[i] : 0;
        for (int64_t k = x->K->row[r]; k < x->K->row[r + 1]; k++) {
            int c = xrow[x->K->col[k]];
            if (c < 0) continue;
            if (x->fill) {
                x->out->col[at] = c;
                memcpy(x->out->val + at * dd, x->K->val + k * dd, (size_t)dd * sizeof(double));
            }
            at++;
        }
        if (!x->fill) tss__sub_i(&x->s->row_list)[i] = (int)at;
    }
}

// The rows and columns of K at enriched nodes.
static tss_result tss__sub_extract(tss_subspace *s, const tss_unknowns *u, const tss_bcsr *K, uint64_t *from, tss_bcsr *out) {
    tss__sub_extraction x = {s, u, K, out, 0};
    int chunks = (s->xrows + 511) / 512;
    int64_t blocks = 0;
    if (!tss__sub_need(s, &s->row_list, (size_t)s->xrows, sizeof(int))) return tss__sub_no_memory(s);
    tss__parallel_even(&s->host, chunks, tss__sub_extract_task, &x);
    for (int i = 0; i < s->xrows; i++) blocks += tss__sub_i(&s->row_list)[i];
    uint64_t pattern = out->pattern, key = K->pattern * 1000003u + s->x_stamp;
    if (tss_bcsr_reserve(&s->host, out, s->xrows, s->dim, blocks) != TSS_OK) return tss__sub_no_memory(s);
    out->row[0] = 0;
    for (int i = 0; i < s->xrows; i++) out->row[i + 1] = out->row[i] + tss__sub_i(&s->row_list)[i];
    x.fill = 1;
    tss__parallel_even(&s->host, chunks, tss__sub_extract_task, &x);
    out->pattern = *from == key ? pattern : ++s->xpattern;
    *from = key;
    return TSS_OK;
}

// Modal nodes that share a block with an enriched one ("border"), body by body, and the blocks of K
// between the two, by border node (K_qx) and by enriched node (K_xq).
static tss_result tss__sub_link(tss_subspace *s, int *count, tss__sub_buf *list, int other, const double *blk) {
    tss__sub_jlink *l = (tss__sub_jlink *)tss__sub_need(s, list, (size_t)*count + 1, sizeof *l);
    if (!l) return tss__sub_no_memory(s);
    l[*count].other = other;
    memcpy(l[*count].block, blk, (size_t)(s->dim * s->dim) * sizeof(double));
    ++*count;
    return TSS_OK;
}

// Blocks of row `row` towards enriched nodes (border 0: index among them) or towards border nodes.
static tss_result tss__sub_link_row(tss_subspace *s, const tss_unknowns *u, int row, int border, int *count, tss__sub_buf *list) {
    const int dd = s->dim * s->dim;
    tss_result r = TSS_OK;
    for (int part = 0; part < 2; part++) {
        const tss_bcsr *K = part ? &s->C : &s->A;
        if (!part && !tss__sub_u(&s->live_row)[row]) continue;
        for (int64_t k = K->row[row]; k < K->row[row + 1] && r == TSS_OK; k++) {
            int other = border ? tss__sub_i(&s->border_index)[u->node[K->col[k]]] : tss__sub_i(&s->xrow)[K->col[k]];
            if (other < 0 || !tss__sub_nonzero(K->val + k * dd, dd)) continue;
            r = tss__sub_link(s, count, list, other, K->val + k * dd);
        }
    }
    return r;
}

static tss_result tss__sub_build_J(tss_subspace *s, const tss_unknowns *u) {
    size_t n = (size_t)s->n;
    int *index = (int *)tss__sub_need(s, &s->border_index, n, sizeof(int)), links = 0;
    int *node = (int *)tss__sub_need(s, &s->border, n, sizeof(int));
    int *bptr = (int *)tss__sub_need(s, &s->border_ptr, n + 1, sizeof(int));
    int *xptr = (int *)tss__sub_need(s, &s->x_ptr, (size_t)s->xrows + 1, sizeof(int));
    if (!index || !node || !bptr || !xptr) return tss__sub_no_memory(s);
    for (int i = 0; i < s->n; i++) index[i] = -1;
    s->borders = bptr[0] = xptr[0] = 0;
    tss_result r = TSS_OK;
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        for (int i = 0; m->a > 0 && i < m->lives && r == TSS_OK; i++) {
            int at = tss__sub_i(&m->live)[i], before = links;
            if (tss__sub_u(&s->on)[at]) continue;
            r = tss__sub_link_row(s, u, u->row[at], 0, &links, &s->border_link);
            if (links == before) continue;
            index[at] = s->borders, node[s->borders++] = at;
            bptr[s->borders] = links;
        }
    }
    links = 0;
    for (int i = 0; i < s->xrows && r == TSS_OK; i++) {
        r = tss__sub_link_row(s, u, u->row[tss__sub_i(&s->xnode)[i]], 1, &links, &s->x_link);
        xptr[i + 1] = links;
    }
    if (r == TSS_OK && !tss__sub_need(s, &s->border_u, (size_t)s->borders * (size_t)s->dim, sizeof(double)))
        return tss__sub_no_memory(s);
    return r;
}

// y += K x over the links of one node.
static void tss__sub_follow(const tss_subspace *s, const tss__sub_buf *ptr, const tss__sub_buf *list, int i, double sign,
                            const double *x, double *y) {
    const tss__sub_jlink *l = (const tss__sub_jlink *)list->p;
    const int d = s->dim, from = tss__sub_i(ptr)[i], to = tss__sub_i(ptr)[i + 1];
    if (d == 3) {
        double a = 0, b = 0, c = 0;
        for (int k = from; k < to; k++) {
            const double *blk = l[k].block, *v = x + l[k].other * 3;
            a += blk[0] * v[0] + blk[1] * v[1] + blk[2] * v[2];
            b += blk[3] * v[0] + blk[4] * v[1] + blk[5] * v[2];
            c += blk[6] * v[0] + blk[7] * v[1] + blk[8] * v[2];
        }
        y[0] += sign * a, y[1] += sign * b, y[2] += sign * c;
        return;
    }
    for (int k = from; k < to; k++)
        for (int p = 0; p < d; p++)
            for (int q = 0; q < d; q++) y[p] += sign * l[k].block[p * d + q] * x[l[k].other * d + q];
}

// y[p·n + k] += v[p] x[k], p < 3: x is read once.
static void tss__sub_axpy3(int n, const double *v, const double *x, double *y) {
    for (int k = 0; k < n; k++) y[k] += v[0] * x[k], y[n + k] += v[1] * x[k], y[2 * n + k] += v[2] * x[k];
}

// out[p] = Σ x[k] y[p·n + k], p < 3, each in four sums.
static void tss__sub_dot3(int n, const double *x, const double *y, double *out) {
    double sum[3][4] = {{0, 0, 0, 0}, {0, 0, 0, 0}, {0, 0, 0, 0}};
    int i = 0;
    for (; i + 4 <= n; i += 4)
        for (int p = 0; p < 3; p++)
            for (int t = 0; t < 4; t++) sum[p][t] += x[i + t] * y[p * n + i + t];
    for (; i < n; i++)
        for (int p = 0; p < 3; p++) sum[p][0] += x[i] * y[p * n + i];
    for (int p = 0; p < 3; p++) out[p] = (sum[p][0] + sum[p][1]) + (sum[p][2] + sum[p][3]);
}

typedef struct tss__sub_jmul {
    tss_subspace *s;
    const double *in;
    double *out;
} tss__sub_jmul;

static void tss__sub_Jt_task(int lane, int worker, void *arg) {
    const tss__sub_jmul *m = (const tss__sub_jmul *)arg;
    const tss_subspace *s = m->s;
    const int d = s->dim;
    double *q = m->out + (size_t)lane * s->modes;
    (void)worker;
    memset(q, 0, s->modes * sizeof(double));
    int from = (int)((int64_t)s->borders * lane / TSS__SUB_LANES), to = (int)((int64_t)s->borders * (lane + 1) / TSS__SUB_LANES);
    for (int i = from; i < to; i++) {
        int node = tss__sub_i(&s->border)[i];
        const tss__modal *b = tss__sub_modal(s, tss__sub_i(&s->body_of)[node]);
        size_t at = (size_t)tss__sub_i(&s->live_index)[node];
        double v[3] = {0, 0, 0};
        tss__sub_follow(s, &s->border_ptr, &s->border_link, i, 1, m->in, v);
        if (d == 3) tss__sub_axpy3(b->c, v, tss__sub_f(&b->phi) + at * (size_t)b->c, q + b->at);
        for (int p = 0; p < d; p++) {
            if (d != 3) tss__sub_axpy(b->c, v[p], tss__sub_f(&b->phi) + at * (size_t)b->c, q + b->at + p * b->c);
            if (b->r > 0) tss__sub_axpy(b->r, v[p], tss__sub_f(&b->vec) + (at * (size_t)d + (size_t)p) * (size_t)b->r, q + b->at + d * b->c);
        }
    }
}

// q (modes) = Jᵀ x: border nodes in order, in TSS__SUB_LANES sums.
static tss_result tss__sub_Jt(tss_subspace *s, const double *x, double *q) {
    tss__sub_jmul m = {s, x, (double *)tss__sub_need(s, &s->lane, TSS__SUB_LANES * s->modes, sizeof(double))};
    if (!m.out) return tss__sub_no_memory(s);
    if (s->borders < 64)
        for (int l = 0; l < TSS__SUB_LANES; l++) tss__sub_Jt_task(l, 0, &m);
    else
        tss__parallel_even(&s->host, TSS__SUB_LANES, tss__sub_Jt_task, &m);
    memset(q, 0, s->modes * sizeof(double));
    for (int l = 0; l < TSS__SUB_LANES; l++) tss__sub_axpy((int)s->modes, 1, m.out + (size_t)l * s->modes, q);
    return TSS_OK;
}

static double tss__sub_dot(int n, const double *a, const double *b) {
    double sum[4] = {0, 0, 0, 0};
    int i = 0;
    for (; i + 4 <= n; i += 4)
        for (int t = 0; t < 4; t++) sum[t] += a[i + t] * b[i + t];
    for (; i < n; i++) sum[0] += a[i] * b[i];
    return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

// Displacement of border nodes by modes q.
static void tss__sub_border_task(int chunk, int worker, void *arg) {
    const tss__sub_jmul *m = (const tss__sub_jmul *)arg;
    const tss_subspace *s = m->s;
    const int d = s->dim;
    (void)worker;
    int to = (chunk + 1) * TSS__SUB_CHUNK < s->borders ? (chunk + 1) * TSS__SUB_CHUNK : s->borders;
    for (int i = chunk * TSS__SUB_CHUNK; i < to; i++) {
        int node = tss__sub_i(&s->border)[i];
        const tss__modal *b = tss__sub_modal(s, tss__sub_i(&s->body_of)[node]);
        size_t at = (size_t)tss__sub_i(&s->live_index)[node];
        double *out = tss__sub_f(&s->border_u) + i * d;
        if (d == 3) tss__sub_dot3(b->c, tss__sub_f(&b->phi) + at * (size_t)b->c, m->in + b->at, out);
        for (int p = 0; p < d; p++) {
            if (d != 3) out[p] = tss__sub_dot(b->c, tss__sub_f(&b->phi) + at * (size_t)b->c, m->in + b->at + p * b->c);
            out[p] += tss__sub_dot(b->r, tss__sub_f(&b->vec) + (at * (size_t)d + (size_t)p) * (size_t)b->r, m->in + b->at + d * b->c);
        }
    }
}

static void tss__sub_J_task(int chunk, int worker, void *arg) {
    const tss__sub_jmul *m = (const tss__sub_jmul *)arg;
    const tss_subspace *s = m->s;
    (void)worker;
    int to = (chunk + 1) * 512 < s->xrows ? (chunk + 1) * 512 : s->xrows;
    for (int i = chunk * 512; i < to; i++)
        tss__sub_follow(s, &s->x_ptr, &s->x_link, i, -1, tss__sub_f(&s->border_u), m->out + i * s->dim);
}

// x −= J q
static void tss__sub_minus_J(tss_subspace *s, const double *q, double *x) {
    tss__sub_jmul m = {s, q, x};
    int chunks = (s->borders + TSS__SUB_CHUNK - 1) / TSS__SUB_CHUNK;
    if (chunks < 4)
        for (int k = 0; k < chunks; k++) tss__sub_border_task(k, 0, &m);
    else
        tss__parallel_even(&s->host, chunks, tss__sub_border_task, &m);
    tss__parallel_even(&s->host, (s->xrows + 511) / 512, tss__sub_J_task, &m);
}

// y = (H_x − J H_q⁻¹ Jᵀ) x
static void tss__sub_schur_apply(void *user, const double *x, double *y) {
    tss_subspace *s = (tss_subspace *)user;
    tss_bcsr_multiply(&s->host, &s->Ax, x, y, 0);
    tss_bcsr_multiply(&s->host, &s->Cx, x, y, 1);
    if (s->borders == 0) return;
    double *q = tss__sub_f(&s->modal_work);
    tss_result r = tss__sub_Jt(s, x, q);
    if (r == TSS_OK) r = tss__sub_modal_apply(s, 1, q, q);
    if (r == TSS_OK) tss__sub_minus_J(s, q, y);
    if (r != TSS_OK) s->failed = r;
}

// d_x by conjugate gradients, from x if warm; *ok 0: not converged within bound.
static tss_result tss__sub_pcg(tss_subspace *s, const double *b, double *x, int bound, int warm, tss__sub_counts *n, int *ok) {
    tss_result r = s->pcg ? TSS_OK : tss_pcg_create(&s->host, &s->pcg);
    if (r != TSS_OK) return tss__sub_no_memory(s);
    tss_pcg_def d = tss_pcg_def_default();
    tss_pcg_info info;
    d.n = s->xrows, d.d = s->dim, d.A = &s->Ax, d.B = &s->Cx, d.fixed = s->masked ? tss__sub_u(&s->xmask) : NULL;
    d.apply = tss__sub_schur_apply, d.user = s, d.tol = s->def.pcg_tol, d.max_iterations = bound, d.warm = warm;
    s->failed = TSS_OK;
    r = tss_pcg_solve(s->pcg, &d, b, x, &info);
    if (r == TSS_OK) r = s->failed;
    n->linear_iterations += info.iterations;
    s->pcg_iterations = info.iterations > 0.8 * s->pcg_iterations ? info.iterations : 0.8 * s->pcg_iterations;
    *ok = info.status == TSS_PCG_CONVERGED;
    return r;
}

// Work of one PCG iteration, in dense flops.
static double tss__sub_pcg_work(const tss_subspace *s) {
    double jwork = 0, blocks = (double)(s->Ax.row[s->xrows] + s->Cx.row[s->xrows]);
    for (int k = 0; k < s->borders; k++)
        jwork += 4.0 * tss__sub_modal(s, tss__sub_i(&s->body_of)[tss__sub_i(&s->border)[k]])->a;
    jwork += 4.0 * s->dim * s->dim * (s->xrows > 0 ? tss__sub_i(&s->x_ptr)[s->xrows] : 0);
    for (int k = 0; k < s->modal_count; k++) jwork += 2.0 * tss__sub_modal(s, k)->thin_rank * tss__sub_modal(s, k)->thin_rank;
    return TSS__SUB_PCG_FLOP * (2.0 * blocks * s->dim * s->dim + jwork + 20.0 * s->xrows * s->dim);
}

// Dense work of the complement H_q − JᵀH_x⁻¹J: `nonzeros` of L pass for each of its columns.
static double tss__sub_complement_work(const tss_subspace *s, double nonzeros) {
    double width = 0;
    for (int k = 0; k < s->modal_count; k++) width += tss__sub_modal(s, k)->thin_rank;
    if (s->borders == 0) width = 0;
    return 16.0 * nonzeros * (1 + width) + 4.0 * s->xrows * s->dim * width * width + width * width * width;
}

// Less work than any direct solve of this size needs: spares the analysis (an ordering) where PCG is
// far ahead. L has the nonzeros of half of H_x at least.
static double tss__sub_direct_floor(const tss_subspace *s) {
    double n = (double)s->xrows * s->dim, blocks = (double)s->Ax.row[s->xrows];
    return (s->dim == 3 ? 5 * n * n : 5 * n * sqrt(n)) + tss__sub_complement_work(s, blocks * s->dim * s->dim / 2);
}

// Work of a direct solve, in dense flops: the triangular solves with many right-hand sides run at a
// quarter of a factorisation's speed.
static tss_result tss__sub_analyze_x(tss_subspace *s, double *direct) {
    if (!s->chol_x) {
        tss_chol_def d = tss_chol_def_default();
        if (tss_chol_create(&s->host, &d, &s->chol_x) != TSS_OK) return tss__sub_no_memory(s);
    }
    tss_chol_info info;
    tss_result r = tss_chol_analyze(s->chol_x, &s->Ax, &s->Cx);
    if (r != TSS_OK) return tss_world_fail(s->w, r, "subspace: H_x: %s", tss_result_text(r));
    tss_chol_get_info(s->chol_x, &info);
    *direct = info.flops + tss__sub_complement_work(s, (double)info.nonzeros);
    return TSS_OK;
}

// H_x = L Lᵀ; a matrix without inertia may need a larger diagonal.
static tss_result tss__sub_factor_x(tss_subspace *s) {
    const uint8_t *fixed = s->masked ? tss__sub_u(&s->xmask) : NULL;
    for (double shift = 1e-10;; shift *= 100) {
        tss_result r = tss_chol_factor(s->chol_x, &s->Ax, &s->Cx, fixed);
        if (r == TSS_OK) return r;
        if (r != TSS_ERROR_SINGULAR || shift > 1)
            return tss_world_fail(s->w, r, "subspace: H_x: %s", tss_result_text(r));
        for (int i = 0; i < s->xrows; i++)
            for (int c = 0; c < s->dim; c++) {
                double *v = tss_bcsr_block(&s->Ax, i, i) + c * s->dim + c;
                *v += shift * fabs(*v);
            }
        s->kept_x = 0;
    }
}

// Columns of J at the chosen modes, nx × width column-major, fixed axes 0.
static void tss__sub_J_columns(tss_subspace *s, int width, double *X) {
    size_t nx = (size_t)(s->xrows * s->dim);
    memset(X, 0, nx * (size_t)width * sizeof(double));
    const tss__sub_jlink *l = (const tss__sub_jlink *)s->x_link.p;
    const int d = s->dim;
    for (int i = 0; i < s->xrows; i++)
        for (int k = tss__sub_i(&s->x_ptr)[i]; k < tss__sub_i(&s->x_ptr)[i + 1]; k++) {
            int node = tss__sub_i(&s->border)[l[k].other];
            const tss__modal *b = tss__sub_modal(s, tss__sub_i(&s->body_of)[node]);
            size_t at = (size_t)tss__sub_i(&s->live_index)[node];
            const double *phi = tss__sub_f(&b->phi) + at * (size_t)b->c, *vec = tss__sub_f(&b->vec) + at * (size_t)(d * b->r);
            for (int c = 0; c < b->thin_rank; c++) {
                int mode = tss__sub_kept(b, 1)[c];
                for (int p = 0; p < d; p++) {
                    double sum = 0;
                    if (mode < d * b->c) sum = l[k].block[p * d + mode / b->c] * phi[mode % b->c];
                    for (int q = 0; mode >= d * b->c && q < d; q++) sum += l[k].block[p * d + q] * vec[q * b->r + mode - d * b->c];
                    X[(size_t)(b->offset + c) * nx + (size_t)(i * d + p)] += sum;
                }
            }
        }
    for (size_t k = 0; s->masked && k < nx; k++)
        for (int c = 0; c < width && tss__sub_u(&s->xmask)[k]; c++) X[(size_t)c * nx + k] = 0;
}

// Dense H_q of all bodies at once, chosen modes, lower triangle.
static void tss__sub_dense_H(tss_subspace *s, int width, double *S) {
    memset(S, 0, (size_t)width * (size_t)width * sizeof(double));
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        tss__sub_pick(m, m, 1, tss__sub_f(&s->H) + m->hat, S + m->offset * width + m->offset, width);
    }
    for (int k = 0; k < s->crosses; k++) {
        const tss__sub_cross *x = (const tss__sub_cross *)s->cross.p + k;
        const tss__modal *b = tss__sub_modal(s, x->b), *c = tss__sub_modal(s, x->c);
        tss__sub_pick(b, c, 1, tss__sub_f(&s->cross_val) + x->at, S + b->offset * width + c->offset, width);
    }
}

// Both d_x and d_q by L of H_x and the complement S = H_q − Jᵀ H_x⁻¹ J on the chosen modes.
static tss_result tss__sub_direct(tss_subspace *s, const double *rx, const double *rq, double *dx, double *dq) {
    size_t nx = (size_t)(s->xrows * s->dim);
    int width = 0;
    for (int k = 0; k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        m->offset = width, width += m->thin_rank;
    }
    size_t w = (size_t)width;
    double *X = (double *)tss__sub_need(s, &s->columns, 2 * nx * w + w * w + w, sizeof(double));
    if (!X) return tss__sub_no_memory(s);
    double *Y = X + nx * w, *S = Y + nx * w, *y = S + w * w;
    tss_result r = tss__sub_factor_x(s);
    if (r != TSS_OK) return r;
    tss__sub_dense_H(s, width, S);
    memcpy(dx, rx, nx * sizeof(double));
    tss__sub_J_columns(s, width, X);
    memcpy(Y, X, nx * w * sizeof(double));
    r = tss_chol_solve(s->chol_x, dx, 1);
    if (r == TSS_OK) r = tss_chol_solve(s->chol_x, Y, width);
    if (r != TSS_OK) return tss_world_fail(s->w, r, "subspace: H_x: %s", tss_result_text(r));
    tss_dense_product(1, 0, width, width, (int)nx, -1, X, (int)nx, Y, (int)nx, 1, S, width);
    int shifted = 0;
    if (width > 0 && (r = tss__sub_factor_dense(s, width, S, &shifted)) != TSS_OK) return r;
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        for (int c = 0; c < m->thin_rank; c++) {
            const double *xc = X + (size_t)(m->offset + c) * nx;
            double sum = rq[m->at + (size_t)tss__sub_kept(m, 1)[c]];
            for (size_t i = 0; i < nx; i++) sum -= xc[i] * dx[i];
            y[m->offset + c] = sum;
        }
    }
    if (width > 0) tss_dense_chol_solve(width, S, width, y, width, 1);
    for (int c = 0; c < width; c++) tss__sub_axpy((int)nx, -y[c], Y + (size_t)c * nx, dx);
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        memset(dq + m->at, 0, (size_t)m->a * sizeof(double));
        for (int c = 0; c < m->thin_rank; c++) dq[m->at + (size_t)tss__sub_kept(m, 1)[c]] = y[m->offset + c];
    }
    return TSS_OK;
}

#ifdef TSS_SUBSPACE_DEBUG
// The coupled matrix is positive definite: H_x is, and so is its complement, without any shift.
static tss_result tss__sub_check_definite(tss_subspace *s) {
    size_t nx = (size_t)(s->xrows * s->dim), w = 0;
    double work;
    for (int k = 0; k < s->modal_count; k++)
        tss__sub_modal(s, k)->offset = (int)w, w += (size_t)tss__sub_modal(s, k)->thin_rank;
    double *X = (double *)tss__sub_need(s, &s->columns, 2 * nx * w + w * w + w, sizeof(double));
    tss_result r = X ? tss__sub_analyze_x(s, &work) : tss__sub_no_memory(s);
    if (r != TSS_OK) return r;
    r = tss_chol_factor(s->chol_x, &s->Ax, &s->Cx, s->masked ? tss__sub_u(&s->xmask) : NULL);
    TSS_ASSERT(r == TSS_OK && "H_x is not positive definite");
    double *Y = X + nx * w, *S = Y + nx * w;
    tss__sub_dense_H(s, (int)w, S);
    tss__sub_J_columns(s, (int)w, X);
    memcpy(Y, X, nx * w * sizeof(double));
    r = tss_chol_solve(s->chol_x, Y, (int)w);
    tss_dense_product(1, 0, (int)w, (int)w, (int)nx, -1, X, (int)nx, Y, (int)nx, 1, S, (int)w);
    if (w > 0) r = tss_dense_chol_factor((int)w, S, (int)w, NULL);
    TSS_ASSERT(r == TSS_OK && "the Schur complement is not positive definite");
    return TSS_OK;
}
#endif

// The choice between the two, then the solution: d at enriched nodes and d_q.
static tss_result tss__sub_solve_enriched(tss_subspace *s, const tss_unknowns *u, const double *rq, double *dq, double *d) {
    size_t nx = (size_t)(s->xrows * s->dim);
    double *rx = (double *)tss__sub_need(s, &s->solution, 3 * nx, sizeof(double)), direct = 0;
    double *mw = (double *)tss__sub_need(s, &s->modal_work, 2 * s->modes, sizeof(double));
    if (!rx || !mw) return tss__sub_no_memory(s);
    double *dx = rx + nx, *b = dx + nx;
    for (int i = 0; i < s->xrows; i++)
        for (int c = 0; c < s->dim; c++)
            rx[i * s->dim + c] = tss__sub_f(&s->rhs)[u->row[tss__sub_i(&s->xnode)[i]] * s->dim + c];
    int want_pcg = s->def.schur == TSS_SCHUR_PCG, ok = 0, bound = 10000, analyzed = 0;
    tss_result r = TSS_OK;
    if (s->def.schur == TSS_SCHUR_AUTO) {
        double iteration = tss__sub_pcg_work(s);
        direct = tss__sub_direct_floor(s);
        // PCG with room to spare needs no analysis of the other.
        analyzed = !(direct > 2 * iteration * s->pcg_iterations && s->pcg_rest == 0);
        if (analyzed && (r = tss__sub_analyze_x(s, &direct)) != TSS_OK) return r;
        double affordable = direct / iteration;
        if (affordable > s->pcg_iterations && s->pcg_rest == 0)
            want_pcg = 1, bound = affordable < bound ? (int)affordable + 1 : bound;
        else if (s->pcg_rest > 0 && --s->pcg_rest == 0)
            s->pcg_iterations = 0;  // conditions may have changed: try again
    }
    if (want_pcg) {
        double *q = mw + s->modes;
        memcpy(b, rx, nx * sizeof(double));
        if ((r = tss__sub_modal_apply(s, 1, rq, q)) != TSS_OK) return r;
        tss__sub_minus_J(s, q, b);
        for (size_t k = 0; s->masked && k < nx; k++)
            if (tss__sub_u(&s->xmask)[k]) b[k] = 0;
        int before = s->counts.linear_iterations;
        if ((r = tss__sub_pcg(s, b, dx, bound, 0, &s->counts, &ok)) != TSS_OK) return r;
        if (!ok && !analyzed && s->def.schur == TSS_SCHUR_AUTO && s->counts.linear_iterations - before == bound) {
            // the bound was that of the floor: what a direct solve really costs allows more
            if ((r = tss__sub_analyze_x(s, &direct)) != TSS_OK) return r;
            double left = direct / tss__sub_pcg_work(s) - bound;
            analyzed = 1, bound = left < 10000 ? (int)left + 1 : 10000;
            if (left > 0 && (r = tss__sub_pcg(s, b, dx, bound, 1, &s->counts, &ok)) != TSS_OK) return r;
            double all = s->counts.linear_iterations - before;
            if (all > s->pcg_iterations) s->pcg_iterations = all;
        }
        if (ok || s->def.schur == TSS_SCHUR_PCG) {
            if ((r = tss__sub_Jt(s, dx, q)) != TSS_OK) return r;
            for (size_t k = 0; k < s->modes; k++) q[k] = rq[k] - q[k];
            r = tss__sub_modal_apply(s, 1, q, dq);
            ok = 1;
        } else
            s->pcg_rest = TSS__SUB_PCG_REST;
    }
    if (!ok && r == TSS_OK) {
        s->counts.factorizations++;
        if (!analyzed) r = tss__sub_analyze_x(s, &direct);
        if (r == TSS_OK) r = tss__sub_direct(s, rx, rq, dx, dq);
    }
    for (int i = 0; r == TSS_OK && i < s->xrows; i++)
        for (int c = 0; c < s->dim; c++) d[tss__sub_i(&s->xnode)[i] * s->dim + c] = dx[i * s->dim + c];
    return r;
}
// ---------------------------------------------------------------------------------------------
// >>oracle (private)
// §3.3–3.7: from the subspace's own direction d_a (Eq. 18), scaled by a line search, the progress
// ℰ_i = ΔE_i/η_i (Eq. 7, 11) that the modes make around each node; and the error
//     𝒢_i = min(R_i, F_i),  R_i = Σ_j ‖(g^i)_j‖/γ_i (Eq. 9, 10),  F_i = Σ_{j ∈ ring} ‖∇_{x_j}E‖/γ_i.
// R is a strain, F a force out of balance; either alone enriches where nothing is to be gained
// (docs/oracle.md has the figures of both readings). Activated is what has 𝒢 > ε_G and ℰ < ε_E: a
// group of nodes if any of its nodes has, a block of modes likewise (Eq. 12–17). Only added, never
// taken away, within a step. R is evaluated where F and ℰ pass, so that most iterates need none.
// ---------------------------------------------------------------------------------------------

// Error of a block relative to 𝒢 of nodes, such that 0.5 adds about as many modes as Table 1 of the
// paper has (jello: rubber 72 → 84, soft 120; roller 72). A block's error counts only as far as it
// persists over two iterates: the first one after the step filter let a contact in carries a barrier
// force that grows with 1/mesh width and is gone in the next.
#define TSS__SUB_MODE_ERROR 0.3

typedef struct tss__sub_near {  // what R needs: the gradient of all stencils around one node
    double g[TSS_BATCH * TSS__SUB_STENCIL];
    int j[512];
    double sum[512][3];
    int count;
    int *slot;  // by node: its place in sum, or −1
} tss__sub_near;

static double tss__sub_norm(const double *v, int d) {
    double s = 0;
    for (int c = 0; c < d; c++) s += v[c] * v[c];
    return sqrt(s);
}

// Adds the gradients of stencils ids of energy e to the sums by node.
static void tss__sub_near_add(const tss_subspace *s, const tss_iterate *it, const tss_unknowns *u,
                              const tss_energy_view *v, const int *id, int count, tss__sub_near *n) {
    const int A = v->def->arity, d = s->dim;
    tss_ids ids = {0, count, id};
    v->def->gradient(v->def->user, it->ctx, it->x, ids, n->g);
    for (int k = 0; k < count; k++)
        for (int i = 0; i < A; i++) {
            int node = v->list.node[id[k] * A + i];
            if (node < 0 || u->row[node] < 0) continue;
            int at = n->slot[node];
            if (at < 0) {
                if (n->count == 512) continue;  // a ring of more than 512 nodes: enough has been seen
                at = n->slot[node] = n->count;
                n->j[n->count++] = node, n->sum[at][0] = n->sum[at][1] = n->sum[at][2] = 0;
            }
            for (int c = 0; c < d; c++) n->sum[at][c] += v->scale * n->g[(k * A + i) * d + c];
        }
}

// ‖(g^i)_j‖ of one node: summed (ours), or the root of the sum of squares (literal).
static double tss__sub_ring_gradient(const tss_subspace *s, const tss_iterate *it, const tss_unknowns *u, int node,
                                     tss__sub_near *n) {
    int list[TSS_BATCH];
    n->count = 0;
    for (int dynamic = 0; dynamic < 2; dynamic++) {
        const int *ptr = tss__sub_i(dynamic ? &s->dyn_ptr : &s->near_ptr);
        const int *id = tss__sub_i(dynamic ? &s->dyn_id : &s->near_id);
        for (int k = ptr[node]; k < ptr[node + 1];) {
            tss_energy_view v;
            int e = id[2 * k], m = 0;
            while (k < ptr[node + 1] && id[2 * k] == e && m < TSS_BATCH) list[m++] = id[2 * k++ + 1];
            if (tss_energy_get(s->w, e, &v) == TSS_OK) tss__sub_near_add(s, it, u, &v, list, m, n);
        }
    }
    double sum = 0, squares = 0;
    for (int k = 0; k < n->count; k++) {
        double l = tss__sub_norm(n->sum[k], s->dim);
        sum += l, squares += l * l;
        n->slot[n->j[k]] = -1;
    }
    return s->def.oracle == TSS_ORACLE_LITERAL ? sqrt(squares) : sum;
}

typedef struct tss__sub_ask {
    tss_subspace *s;
    const tss_iterate *it;
    const tss_unknowns *u;
    double *gamma, *eta;  // of this step, by node
    tss__sub_near *near;
    uint8_t *activate;    // by group
    int all;              // fill the fields everywhere: for pictures
} tss__sub_ask;

static double tss__sub_ah2(const tss_subspace *s, const tss_ctx *c) {
    if (s->def.oracle == TSS_ORACLE_LITERAL && !c->quasistatic) return c->h * c->h;  // as printed
    return c->ah2;
}

// F_i over the ring; fields start at 0.
static void tss__sub_force_task(int chunk, int worker, void *arg) {
    const tss__sub_ask *q = (const tss__sub_ask *)arg;
    const tss_subspace *s = q->s;
    double ah2 = tss__sub_ah2(s, q->it->ctx);
    const double *gamma = tss__sub_f(s->def.oracle == TSS_ORACLE_LITERAL ? &s->gamma_print : &s->gamma);
    (void)worker;
    int to = (chunk + 1) * 1024 < s->n ? (chunk + 1) * 1024 : s->n;
    for (int i = chunk * 1024; i < to; i++) {
        tss__sub_f(&s->error)[i] = tss__sub_f(&s->progress)[i] = tss__sub_f(&s->force)[i] = 0;
        if (tss__sub_i(&s->body_of)[i] < 0 || !(gamma[i] > 0)) continue;
        int r = q->u->row[i];
        double F = 0;
        for (int64_t k = s->A.row[r]; k < s->A.row[r + 1]; k++)
            F += tss__sub_norm(q->it->g + q->u->node[s->A.col[k]] * s->dim, s->dim);
        tss__sub_f(&s->force)[i] = F / (ah2 * gamma[i]);
    }
}

// 𝒢_i where F_i lets it pass; activate[g] 1: some node of the group has 𝒢 > ε_G.
static void tss__sub_error_task(int g, int worker, void *arg) {
    const tss__sub_ask *q = (const tss__sub_ask *)arg;
    const tss_subspace *s = q->s;
    const int literal = s->def.oracle == TSS_ORACLE_LITERAL;
    const double ah2 = tss__sub_ah2(s, q->it->ctx), *scale = tss__sub_f(literal ? &s->gamma_print : &s->gamma);
    q->activate[g] = 0;
    for (int k = tss__sub_i(&s->group_ptr)[g]; k < tss__sub_i(&s->group_ptr)[g + 1]; k++) {
        int i = tss__sub_i(&s->group_node)[k];
        double F = tss__sub_f(&s->force)[i], *G = tss__sub_f(&s->error) + i;
        if (tss__sub_i(&s->body_of)[i] < 0 || !(scale[i] > 0)) continue;
        if (!q->all && (tss__sub_u(&s->on)[i] || (!literal && F <= s->def.error_nodes))) continue;
        *G = tss__sub_ring_gradient(s, q->it, q->u, i, q->near + worker) / (ah2 * scale[i]);
        if (!literal && F < *G) *G = F;
        if (!tss__sub_u(&s->on)[i] && *G > s->def.error_nodes) q->activate[g] = 1;
    }
}

// ℰ_i, and which of the groups lack progress where their error is large.
static void tss__sub_progress_task(int g, int worker, void *arg) {
    const tss__sub_ask *q = (const tss__sub_ask *)arg;
    const tss_subspace *s = q->s;
    const double *scale = tss__sub_f(s->def.oracle == TSS_ORACLE_LITERAL ? &s->eta_print : &s->eta);
    const double ah2 = tss__sub_ah2(s, q->it->ctx);
    int activate = 0;
    (void)worker;
    for (int k = tss__sub_i(&s->group_ptr)[g]; k < tss__sub_i(&s->group_ptr)[g + 1]; k++) {
        int i = tss__sub_i(&s->group_node)[k];
        if (tss__sub_i(&s->body_of)[i] < 0 || !(scale[i] > 0)) continue;
        double E = tss__sub_f(&s->progress)[i] = tss__sub_f(&s->ring)[i] / (ah2 * scale[i]);
        activate |= !tss__sub_u(&s->on)[i] && tss__sub_f(&s->error)[i] > s->def.error_nodes && E < s->def.progress;
    }
    q->activate[g] = (uint8_t)activate;
}

// Nodes of one group, those that can be; returns how many are new.
static int tss__sub_enrich(tss_subspace *s, int g) {
    int count = 0;
    for (int k = tss__sub_i(&s->group_ptr)[g]; k < tss__sub_i(&s->group_ptr)[g + 1]; k++) {
        int i = tss__sub_i(&s->group_node)[k], b = tss__sub_i(&s->body_of)[i];
        if (b < 0 || tss__sub_u(&s->on)[i]) continue;
        tss__sub_u(&s->on)[i] = TSS__SUB_NEW;
        tss__sub_modal(s, b)->thin_stale = 1;
        count++;
    }
    tss__sub_i(&s->group_age)[g] = 0;
    return count;
}

// Doubles that the functions of one block take at all nodes of its body; *width: their number f.
static size_t tss__sub_block_room(const tss_subspace *s, int body, const tss__sub_block *q, int *width) {
    const tss__sub_basis *b = tss__sub_base(s, q->basis);
    *width = b->b.first[q->block + 1] - b->b.first[q->block];
    return (size_t)tss__sub_modal(s, body)->nodes * (size_t)(b->b.vector ? s->dim : 1) * (size_t)*width;
}

// U: (nodes × f), or (nodes · d) × f columns.
static void tss__sub_block_rows(const tss_subspace *s, int body, const tss__sub_block *q, double *U) {
    const tss__modal *m = tss__sub_modal(s, body);
    const tss__sub_basis *b = tss__sub_base(s, q->basis);
    int f = 0;
    size_t rows = tss__sub_block_room(s, body, q, &f);
    rows /= (size_t)f;
    if (b->b.vector)
        for (size_t i = 0; i < rows; i++)
            for (int k = 0; k < f; k++)
                U[i * (size_t)f + (size_t)k] = b->b.value[i * (size_t)b->b.columns + (size_t)(b->b.first[q->block] + k)];
    else
        tss__basis_rows(&b->b, tss__sub_X(s, m), s->dim, NULL, m->nodes, &q->block, 1, U, f);
}

// What was measured becomes 𝒢_s (see TSS__SUB_MODE_ERROR).
static void tss__sub_block_judge(const tss_subspace *s, const tss_iterate *it, tss__sub_block *q, double error) {
    q->error = error;
    if (s->query) return;
    double now = q->error, last = it->number == 0 ? 0 : q->last;
    if (s->def.oracle != TSS_ORACLE_LITERAL && last < now) q->error = last;
    q->last = now;
}

// 𝒢_s (Eq. 12, 14, 16): g^s = M Φ Φᵀ∇E, Φ the block's functions, orthonormal in the mass; max over
// the nodes of ‖g_j^s‖ l/η_j, which meshes agree on; as printed ‖g_j^s‖/γ_j.
// U: room for the block's rows and 3 f sums behind them.
static void tss__sub_block_error(const tss_subspace *s, const tss_iterate *it, int body, tss__sub_block *q, double *U) {
    const tss__modal *m = tss__sub_modal(s, body);
    const int d = s->dim, vector = tss__sub_base(s, q->basis)->b.vector, literal = s->def.oracle == TSS_ORACLE_LITERAL;
    double ah2 = tss__sub_ah2(s, it->ctx), all = 0;
    int f = 0;
    double *sum = U + tss__sub_block_room(s, body, q, &f);
    tss__sub_block_rows(s, body, q, U);
    const double *mass = tss_world_masses(s->w) + m->first, *g = it->g + m->first * d;
    memset(sum, 0, (size_t)(3 * f) * sizeof(double));
    for (int i = 0; i < m->nodes; i++) {
        if (tss__sub_i(&s->body_of)[m->first + i] != body) continue;
        all += mass[i];
        for (int p = 0; p < d; p++)
            for (int k = 0; k < f; k++)
                sum[vector ? k : p * f + k] += U[vector ? (i * d + p) * f + k : i * f + k] * g[i * d + p];
    }
    double most = 0;
    for (int i = 0; i < m->nodes; i++) {
        double v[3] = {0, 0, 0}, eta = tss__sub_f(&s->eta)[m->first + i];
        if (tss__sub_i(&s->body_of)[m->first + i] != body || !(eta > 0)) continue;
        for (int p = 0; p < d; p++)
            for (int k = 0; k < f; k++)
                v[p] += U[vector ? (i * d + p) * f + k : i * f + k] * sum[vector ? k : p * f + k];
        double scale = literal ? tss__sub_f(&s->gamma_print)[m->first + i] : eta / m->diagonal / TSS__SUB_MODE_ERROR;
        double e = mass[i] / all * tss__sub_norm(v, d) / (ah2 * scale);
        most = e > most ? e : most;
    }
    tss__sub_block_judge(s, it, q, most);
}

// The same of all candidate blocks of a factored basis at once, Φ = w (T m), m = (1, X − centre):
// Φᵀg = T Σ w m gᵀ and ΦΦᵀg = w (TᵀTΣ) m, so that no row of Φ is formed and a node is read twice.
// Chunks of nodes are summed in their order.
typedef struct tss__sub_moments {
    const tss_subspace *s;
    const tss_iterate *it;
    const tss__basis *b;
    int body, count;
    const int *block;          // the candidates' numbers in the basis
    double *S, *C, *mass, *top;  // chunks × count × 12; count × 12; chunks; chunks × count
} tss__sub_moments;

enum { TSS__SUB_NODES = 512 };  // a chunk

// m of node i; 0: the node is not modal.
static int tss__sub_moment_row(const tss__sub_moments *q, const tss__modal *m, const double *X, int i, double *row) {
    if (tss__sub_i(&q->s->body_of)[m->first + i] != q->body) return 0;
    row[0] = 1, row[3] = 0;
    for (int a = 0; a < q->s->dim; a++) row[a + 1] = X[i * q->s->dim + a] - q->b->center[a];
    return 1;
}

static void tss__sub_moment_task(int chunk, int worker, void *arg) {
    const tss__sub_moments *q = (const tss__sub_moments *)arg;
    const tss__modal *m = tss__sub_modal(q->s, q->body);
    const int d = q->s->dim, from = chunk * TSS__SUB_NODES;
    const int to = from + TSS__SUB_NODES < m->nodes ? from + TSS__SUB_NODES : m->nodes;
    const double *X = tss__sub_X(q->s, m), *g = q->it->g + m->first * d, *mass = tss_world_masses(q->s->w) + m->first;
    double *S = q->S + (size_t)chunk * (size_t)q->count * 12, row[4], own[12], all = 0;
    (void)worker;
    memset(S, 0, (size_t)q->count * 12 * sizeof *S);
    for (int i = from; i < to; i++) {
        if (!tss__sub_moment_row(q, m, X, i, row)) continue;
        const double *w = q->b->weight + (size_t)i * (size_t)q->b->blocks;
        all += mass[i];
        for (int p = 0; p < 3; p++)
            for (int a = 0; a < 4; a++) own[4 * p + a] = p < d ? g[i * d + p] * row[a] : 0;
        for (int j = 0; j < q->count; j++)
            for (int k = 0; k < 12; k++) S[12 * j + k] += w[q->block[j]] * own[k];
    }
    q->mass[chunk] = all;
}

// C = TᵀT Σ of each block.
static void tss__sub_moment_sums(const tss__sub_moments *q, int chunks) {
    const int f = q->s->dim + 1;
    for (int j = 0; j < q->count; j++) {
        const double *T = q->b->transform + (size_t)q->block[j] * (size_t)(f * f);
        double *C = q->C + 12 * j, S[12] = {0};
        for (int k = 0; k < chunks; k++)
            for (int e = 0; e < 12; e++) S[e] += q->S[((size_t)k * (size_t)q->count + (size_t)j) * 12 + (size_t)e];
        memset(C, 0, 12 * sizeof *C);
        for (int p = 0; p < q->s->dim; p++)
            for (int k = 0; k < f; k++) {
                double sum = 0;
                for (int a = 0; a <= k; a++) sum += T[k * f + a] * S[4 * p + a];
                for (int a = 0; a <= k; a++) C[4 * p + a] += T[k * f + a] * sum;
            }
    }
}

// Largest squared (mass ‖w C m‖ / scale) of a chunk.
static void tss__sub_reach_task(int chunk, int worker, void *arg) {
    const tss__sub_moments *q = (const tss__sub_moments *)arg;
    const tss_subspace *s = q->s;
    const tss__modal *m = tss__sub_modal(s, q->body);
    const int from = chunk * TSS__SUB_NODES, literal = s->def.oracle == TSS_ORACLE_LITERAL;
    const int to = from + TSS__SUB_NODES < m->nodes ? from + TSS__SUB_NODES : m->nodes;
    const double *X = tss__sub_X(s, m), *mass = tss_world_masses(s->w) + m->first;
    double *top = q->top + (size_t)chunk * (size_t)q->count, row[4];
    (void)worker;
    for (int j = 0; j < q->count; j++) top[j] = 0;
    for (int i = from; i < to; i++) {
        double eta = tss__sub_f(&s->eta)[m->first + i];
        if (!(eta > 0) || !tss__sub_moment_row(q, m, X, i, row)) continue;
        const double *w = q->b->weight + (size_t)i * (size_t)q->b->blocks;
        double r = mass[i] / (literal ? tss__sub_f(&s->gamma_print)[m->first + i] : eta / m->diagonal / TSS__SUB_MODE_ERROR);
        for (int j = 0; j < q->count; j++) {
            const double *C = q->C + 12 * j;
            double v, e = 0, by = r * w[q->block[j]];
            for (int p = 0; p < 3; p++) {
                v = C[4 * p] + C[4 * p + 1] * row[1] + C[4 * p + 2] * row[2] + C[4 * p + 3] * row[3];
                e += v * v;
            }
            e *= by * by;
            top[j] = e > top[j] ? e : top[j];
        }
    }
}

// ℰ_s (Eq. 13, 15, 17): c^s = M Φ̄ Φ̄ᵀ ΔE, Φ̄ the functions averaged over coordinates;
// Σ c_j / Σ η_j, as printed Σ c_j²/η_j.
static tss_result tss__sub_block_progress(tss_subspace *s, const tss_iterate *it, int body, tss__sub_block *q) {
    const tss__modal *m = tss__sub_modal(s, body);
    const int d = tss__sub_base(s, q->basis)->b.vector ? s->dim : 1, literal = s->def.oracle == TSS_ORACLE_LITERAL;
    double ah2 = tss__sub_ah2(s, it->ctx), all = 0, sum = 0, total = 0;
    int f = 0;
    size_t room = tss__sub_block_room(s, body, q, &f);
    double *U = (double *)tss__sub_need(s, &s->columns, room + (size_t)f, sizeof(double));
    if (!U) return tss__sub_no_memory(s);
    double *c = U + room;
    tss__sub_block_rows(s, body, q, U);
    const double *mass = tss_world_masses(s->w) + m->first;
    memset(c, 0, (size_t)f * sizeof(double));
    for (int i = 0; i < m->nodes; i++) {
        if (tss__sub_i(&s->body_of)[m->first + i] != body) continue;
        all += mass[i];
        for (int p = 0; p < d; p++)
            for (int k = 0; k < f; k++) c[k] += U[(i * d + p) * f + k] / d * tss__sub_f(&s->ring)[m->first + i];
    }
    for (int i = 0; i < m->nodes; i++) {
        double v = 0, eta = ah2 * tss__sub_f(literal ? &s->eta_print : &s->eta)[m->first + i];
        if (tss__sub_i(&s->body_of)[m->first + i] != body || !(eta > 0)) continue;
        for (int p = 0; p < d; p++)
            for (int k = 0; k < f; k++) v += U[(i * d + p) * f + k] / d * c[k];
        v *= mass[i] / all;
        sum += literal ? v * v / eta : v, total += eta;
    }
    q->progress = literal ? sum : total > 0 ? sum / total : 0;
    return TSS_OK;
}

// Whether block j of a body is a candidate at all.
static int tss__sub_candidate(const tss__modal *m, const tss__sub_block *q) {
    return !q->active && m->enriched < m->modal_nodes;
}

// Whether the block's error is found with those of its whole basis.
static int tss__sub_is_factored(const tss_subspace *s, const tss__sub_block *q) {
    const tss__sub_basis *b = tss__sub_base(s, q->basis);
    return !b->b.vector && b->b.transform != NULL;
}

typedef struct tss__sub_modes {
    const tss_subspace *s;
    const tss_iterate *it;
    int body;
    double *work;
    size_t each;
} tss__sub_modes;

static void tss__sub_mode_task(int j, int worker, void *arg) {
    const tss__sub_modes *run = (const tss__sub_modes *)arg;
    const tss__modal *m = tss__sub_modal(run->s, run->body);
    tss__sub_block *q = tss__sub_blocks(m) + j;
    if (tss__sub_candidate(m, q) && !tss__sub_is_factored(run->s, q))
        tss__sub_block_error(run->s, run->it, run->body, q, run->work + (size_t)worker * run->each);
}

// Candidates of a factored basis; their numbers in the basis go to block, in the body's to of.
static int tss__sub_factored_candidates(const tss_subspace *s, const tss__modal *m, int basis, int *block, int *of) {
    const tss__sub_basis *b = tss__sub_base(s, basis);
    int n = 0;
    for (int j = 0; j < m->blocks && !b->b.vector && b->b.transform; j++) {
        const tss__sub_block *q = tss__sub_blocks(m) + j;
        if (q->basis == basis && tss__sub_candidate(m, q)) block[n] = q->block, of[n++] = j;
    }
    return n;
}

static tss_result tss__sub_factored_errors(tss_subspace *s, const tss_iterate *it, int body, int basis) {
    const tss__modal *m = tss__sub_modal(s, body);
    const int chunks = (m->nodes + TSS__SUB_NODES - 1) / TSS__SUB_NODES;
    int *block = (int *)tss__sub_need(s, &s->factored, 2 * (size_t)m->blocks, sizeof(int));
    if (!block) return tss__sub_no_memory(s);
    tss__sub_moments q;
    memset(&q, 0, sizeof q);
    q.s = s, q.it = it, q.b = &tss__sub_base(s, basis)->b, q.body = body, q.block = block;
    q.count = tss__sub_factored_candidates(s, m, basis, block, block + m->blocks);
    if (q.count == 0) return TSS_OK;
    size_t n = (size_t)q.count, c = (size_t)chunks;
    q.S = (double *)tss__sub_need(s, &s->columns, c * n * 12 + n * 12 + c + c * n, sizeof(double));
    if (!q.S) return tss__sub_no_memory(s);
    q.C = q.S + c * n * 12, q.mass = q.C + n * 12, q.top = q.mass + c;
    tss_parallel(&s->host, chunks, tss__sub_moment_task, &q);
    tss__sub_moment_sums(&q, chunks);
    tss_parallel(&s->host, chunks, tss__sub_reach_task, &q);
    double all = 0;
    for (int k = 0; k < chunks; k++) all += q.mass[k];
    for (int j = 0; j < q.count; j++) {
        double most = 0;
        for (int k = 0; k < chunks; k++) {
            double e = q.top[(size_t)k * n + (size_t)j];
            most = e > most ? e : most;
        }
        double error = all > 0 ? sqrt(most) / (all * tss__sub_ah2(s, it->ctx)) : 0;
        tss__sub_block_judge(s, it, tss__sub_blocks(m) + block[m->blocks + j], error);
    }
    return TSS_OK;
}

// Errors of all inactive blocks; *open: some are above ε_G.
static tss_result tss__sub_mode_errors(tss_subspace *s, const tss_iterate *it, int *open) {
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        tss__sub_modes run = {s, it, k, NULL, 0};
        int candidates = 0;
        for (int j = 0; j < m->blocks; j++) {
            int f;
            if (!tss__sub_candidate(m, tss__sub_blocks(m) + j)) continue;
            candidates++;
            if (tss__sub_is_factored(s, tss__sub_blocks(m) + j)) continue;
            size_t room = tss__sub_block_room(s, k, tss__sub_blocks(m) + j, &f) + (size_t)(3 * f);
            run.each = room > run.each ? room : run.each;
        }
        if (candidates == 0) continue;
        for (int j = 0; j < s->basis_count; j++) {
            const tss__sub_basis *b = tss__sub_base(s, j);
            tss_result r = b->live && b->body == k ? tss__sub_factored_errors(s, it, k, j) : TSS_OK;
            if (r != TSS_OK) return r;
        }
        if (run.each > 0) {
            run.work = (double *)tss__sub_need(s, &s->columns, run.each * (size_t)tss_workers(&s->host), sizeof(double));
            if (!run.work) return tss__sub_no_memory(s);
            tss_parallel(&s->host, m->blocks, tss__sub_mode_task, &run);
        }
        for (int j = 0; j < m->blocks; j++)
            *open |= tss__sub_candidate(m, tss__sub_blocks(m) + j) && tss__sub_blocks(m)[j].error > s->def.error_modes;
    }
    return TSS_OK;
}

// Those of them that lack progress join; returns in *added how many.
static tss_result tss__sub_join_modes(tss_subspace *s, const tss_iterate *it, int *added) {
    tss_result r = TSS_OK;
    for (int k = 0; k < s->modal_count; k++)
        for (int j = 0; j < tss__sub_modal(s, k)->blocks && r == TSS_OK; j++) {
            tss__sub_block *q = tss__sub_blocks(tss__sub_modal(s, k)) + j;
            if (!tss__sub_candidate(tss__sub_modal(s, k), q) || (!s->query && q->error <= s->def.error_modes)) continue;
            r = tss__sub_block_progress(s, it, k, q);
            if (s->query || r != TSS_OK || q->progress >= s->def.progress) continue;
            q->active = 1, q->age = 0, tss__sub_modal(s, k)->stale = 1;
            ++*added;
        }
    return r;
}

// d_a = −H_a⁻¹ U_aᵀ∇E, by the step filters and a line search on E; ring gets ΔE_i. (Eq. 18, 7)
static tss_result tss__sub_own_direction(tss_subspace *s, const tss_iterate *it, const tss_unknowns *u) {
    size_t nd = (size_t)(s->n * s->dim), m = s->modes;
    double *d = (double *)tss__sub_need(s, &s->d_a, nd, sizeof(double));
    double *x1 = (double *)tss__sub_need(s, &s->x_a, nd, sizeof(double));
    double *q = (double *)tss__sub_need(s, &s->modal_work, 2 * m, sizeof(double));
    if (!d || !x1 || !q) return tss__sub_no_memory(s);
    memset(x1, 0, nd * sizeof(double));
    for (int k = 0; k < u->rows; k++)
        for (int c = 0; c < s->dim; c++) x1[u->node[k] * s->dim + c] = tss__sub_f(&s->rhs)[k * s->dim + c];
    tss_result r = tss__sub_restrict(s, x1, 0, q);
    if (r == TSS_OK) r = tss__sub_build_H(s, u, it->ctx, 0);
    tss_world_clock_phase(s->w, TSS_PHASE_ASSEMBLE);
    if (r == TSS_OK) r = tss__sub_factor(s, 0);
    if (r == TSS_OK) r = tss__sub_modal_apply(s, 0, q, q);
    if (r != TSS_OK) return r;
    memcpy(d, it->d, nd * sizeof(double));
    if ((r = tss__sub_extend(s, q, 0, d)) != TSS_OK) return r;
    tss_world_clock_phase(s->w, TSS_PHASE_ORACLE);
    double alpha, slope = 0;
    if ((r = tss_world_step_limit(s->w, it->x, d, &alpha)) != TSS_OK) return r;
    tss_world_clock_phase(s->w, TSS_PHASE_COLLISION);
    for (size_t k = 0; k < nd; k++) slope += it->g[k] * d[k];
    for (int tries = 0;; tries++, alpha *= 0.5) {
        double drop = 0;
        if (tries == 20) alpha = 0;  // nothing to be gained along d_a
        for (size_t k = 0; k < nd; k++) x1[k] = it->x[k] + alpha * d[k];
        memset(s->ring.p, 0, (size_t)s->n * sizeof(double));
        if ((r = tss_world_ring_drop(s->w, it->x, x1, tss__sub_f(&s->ring), &drop)) != TSS_OK) return r;
        if (tries == 20 || it->moves || (isfinite(drop) && drop >= -1e-4 * alpha * slope)) break;
    }
    for (size_t k = 0; k < nd; k++) d[k] *= alpha;
    return TSS_OK;
}

// One call of the oracle. s->added: nodes and blocks that joined. Errors come first: where none is
// above its ε_G nothing can join, whatever the progress, and d_a is not needed.
static tss_result tss__sub_ask_oracle(tss_subspace *s, const tss_iterate *it, const tss_unknowns *u) {
    int open = 0, blocks = 0;
    s->added = 0;
    tss_result r = tss__sub_build_near(s, 1, &s->dyn_ptr, &s->dyn_id);
    if (r != TSS_OK) return r;
    tss__sub_ask q;
    memset(&q, 0, sizeof q);
    q.s = s, q.it = it, q.u = u, q.all = s->query || s->def.on_oracle != NULL;
    q.near = (tss__sub_near *)tss__sub_need(s, &s->scratch, (size_t)tss_workers(&s->host), sizeof(tss__sub_near));
    q.activate = (uint8_t *)tss__sub_need(s, &s->activate, (size_t)s->groups, 1);
    int workers = tss_workers(&s->host);
    int *slot = (int *)tss__sub_need(s, &s->near_slot, (size_t)workers * (size_t)s->n, sizeof(int));
    if (!q.near || !q.activate || !slot) return tss__sub_no_memory(s);
    memset(slot, 0xff, (size_t)workers * (size_t)s->n * sizeof(int));
    for (int k = 0; k < workers; k++) q.near[k].slot = slot + (size_t)k * (size_t)s->n;
    tss_parallel(&s->host, (s->n + 1023) / 1024, tss__sub_force_task, &q);
    tss_parallel(&s->host, s->groups, tss__sub_error_task, &q);
    for (int g = 0; g < s->groups; g++) open |= q.activate[g];
    if ((r = tss__sub_mode_errors(s, it, &open)) != TSS_OK) return r;
    s->oracle_calls++;
    tss_world_clock_phase(s->w, TSS_PHASE_ORACLE);
    if (!open && !q.all) return TSS_OK;
    if ((r = tss__sub_own_direction(s, it, u)) != TSS_OK) return r;
    tss_parallel(&s->host, s->groups, tss__sub_progress_task, &q);
    for (int g = 0; g < s->groups && !s->query; g++)
        if (q.activate[g]) s->added += tss__sub_enrich(s, g);
    r = tss__sub_join_modes(s, it, &blocks);
    s->added += blocks;
    if (s->def.on_oracle) {
        tss_oracle_fields f = {it->number, it->x, tss__sub_f(&s->d_a), tss__sub_f(&s->error), tss__sub_f(&s->progress),
                               tss__sub_f(&s->force), tss__sub_u(&s->on)};
        s->def.on_oracle(&f, s->def.on_oracle_ctx);
    }
    tss_world_clock_phase(s->w, TSS_PHASE_ORACLE);
    return r;
}
// ---------------------------------------------------------------------------------------------
// >>adaptive_step (private)
// One Newton iterate of §3.10: secants → exact part → oracle → masked system → direction. The world
// does the step filters and the line search, so that every iterate is one of full space. An iterate
// in which the oracle added something is not the last. With all nodes enriched the iterate is left
// to the world: the full-space Newton method, to its tolerance.
// ---------------------------------------------------------------------------------------------

static void tss__sub_apply_pending(tss_subspace *s);

static void tss__sub_count(tss_subspace *s, const tss_unknowns *u) {
    s->nodes = u->rows, s->enriched = s->masked = 0;
    for (int k = 0; k < u->rows; k++) {
        if (!tss__sub_u(&s->on)[u->node[k]]) continue;
        s->enriched++;
        for (int c = 0; u->fixed && c < s->dim; c++) s->masked |= u->fixed[k * s->dim + c];
    }
}

// Bodies whose modes are none at all are solved node by node.
static void tss__sub_enrich_bare(tss_subspace *s) {
    for (int k = 0; k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        if (m->a > 0 || m->enriched == m->modal_nodes) continue;
        for (int g = m->group0; g < m->group0 + m->groups; g++) tss__sub_enrich(s, g);
        s->x_stamp++;
    }
}

static void tss__sub_settle(tss_subspace *s) {
    for (int i = 0; i < s->n; i++)
        if (tss__sub_u(&s->on)[i]) tss__sub_u(&s->on)[i] = TSS__SUB_ON;
}

// What the oracle added: masks, parts that are no longer valid, their stencils; new modes restart
// the secants of their body.
static tss_result tss__sub_take_in(tss_subspace *s, const tss_iterate *it, const tss_unknowns *u) {
    s->x_stamp++;
    tss_result r = tss__sub_refresh(s, &s->modes);
    if (r != TSS_OK) return r;
    tss__sub_validate(s, it);
    if ((r = tss__sub_update_secants(s, it)) != TSS_OK) return r;
    if ((r = tss__sub_assemble(s, it, u, 1)) != TSS_OK) return r;
    tss__sub_settle(s);
    tss__sub_count(s, u);
    return tss__sub_live_rows(s, u);
}

// d from the masked system; dq kept for the secants.
static tss_result tss__sub_masked_solve(tss_subspace *s, const tss_iterate *it, const tss_unknowns *u) {
    double *dq = tss__sub_f(&s->dq), *rq = dq + s->modes;
    double *field = (double *)tss__sub_need(s, &s->x_a, (size_t)(s->n * s->dim), sizeof(double));
    if (!field) return tss__sub_no_memory(s);
    memset(field, 0, (size_t)(s->n * s->dim) * sizeof(double));
    for (int k = 0; k < u->rows; k++)
        for (int c = 0; c < s->dim; c++) field[u->node[k] * s->dim + c] = tss__sub_f(&s->rhs)[k * s->dim + c];
    tss_result r = tss__sub_restrict(s, field, 1, rq);
    if (r == TSS_OK) r = tss__sub_build_H(s, u, it->ctx, 1);
    tss_world_clock_phase(s->w, TSS_PHASE_ASSEMBLE);
    if (r == TSS_OK) r = tss__sub_factor(s, 1);
    if (r == TSS_OK) r = tss__sub_number_enriched(s, u);
    if (r != TSS_OK) return r;
    if (s->xrows == 0)
        r = tss__sub_modal_apply(s, 1, rq, dq);
    else {
        if (!s->kept_x) r = tss__sub_extract(s, u, &s->A, s->x_from, &s->Ax);
        s->kept_x = r == TSS_OK;
        if (r == TSS_OK) r = tss__sub_extract(s, u, &s->C, s->x_from + 1, &s->Cx);
        if (r == TSS_OK) r = tss__sub_build_J(s, u);
#ifdef TSS_SUBSPACE_DEBUG
        if (r == TSS_OK && !it->ctx->quasistatic) r = tss__sub_check_definite(s);
#endif
        if (r == TSS_OK) r = tss__sub_solve_enriched(s, u, rq, dq, it->d);
    }
    return r == TSS_OK ? tss__sub_extend(s, dq, 1, it->d) : r;
}

static tss_result tss__sub_direction(void *user, tss_world *w, tss_iterate *it) {
    tss_subspace *s = (tss_subspace *)user;
    tss_unknowns u;
    tss_world_unknowns(w, &u);
    s->solved = 0, s->added = 0;
    if (s->def.mode == TSS_MODE_FULL || s->modal_count == 0) return TSS_OK;
    s->dim = it->ctx->dim;
    tss_result r = tss__sub_build(s, it->ctx, &u);
    if (r == TSS_OK && s->pending_n > 0) tss__sub_apply_pending(s);
    if (r == TSS_OK) r = tss__sub_refresh(s, &s->modes);
    if (r != TSS_OK) return r;
    tss__sub_enrich_bare(s);
    tss__sub_settle(s);
    tss__sub_count(s, &u);
    if (s->enriched == u.rows) return TSS_OK;
    size_t wide = 3 * s->modes;
    if (!tss__sub_need(s, &s->dq, wide, sizeof(double)) ||
        !tss__sub_need(s, &s->rhs, (size_t)(u.rows * s->dim), sizeof(double)))
        return tss__sub_no_memory(s);
    tss_world_clock_phase(w, TSS_PHASE_OTHER);
    tss__sub_validate(s, it);
    if ((r = tss__sub_update_secants(s, it)) != TSS_OK) return r;
    if ((r = tss__sub_assemble(s, it, &u, 0)) != TSS_OK) return r;
    if ((r = tss__sub_live_rows(s, &u)) != TSS_OK) return r;
    if (s->def.mode == TSS_MODE_ADAPTIVE || s->query) {
        if ((r = tss__sub_ask_oracle(s, it, &u)) != TSS_OK) return r;
        it->more = s->added > 0;
        if (s->query) {
            it->handled = 1;
            return TSS_OK;
        }
        if (s->added > 0 && (r = tss__sub_take_in(s, it, &u)) != TSS_OK) return r;
        if (s->enriched == u.rows) return TSS_OK;
    }
    if (!tss__sub_need(s, &s->dq, 3 * s->modes, sizeof(double))) return tss__sub_no_memory(s);
    if ((r = tss__sub_refresh(s, &s->modes)) == TSS_OK) r = tss__sub_masked_solve(s, it, &u);
    it->handled = s->solved = s->kept = r == TSS_OK;
    s->kept_stamp = s->x_stamp;
    return r;
}

static void tss__sub_accepted(void *user, const tss_ctx *c, const double *x0, const double *x1, double alpha) {
    tss_subspace *s = (tss_subspace *)user;
    (void)c;
    double most = 0;
    for (int k = 0; k < s->n * s->dim; k++) most = fabs(x1[k] - x0[k]) > most ? fabs(x1[k] - x0[k]) : most;
    s->moved += most, s->drift += most;
    for (int k = 0; s->solved && k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        const double *dq = tss__sub_f(&s->dq) + m->at;
        for (int i = 0; i < m->a; i++) {
            tss__sub_f(&m->s)[i] += alpha * dq[i];
            tss__sub_f(&m->q)[tss__sub_i(&m->map)[i]] += alpha * dq[i];
        }
    }
}

// The room of a secant that has not begun: its pages are there when the first step asks for them.
static void tss__sub_touch_task(int p, int worker, void *arg) {
    tss_subspace *s = (tss_subspace *)arg;
    const tss__sub_part *t = tss__sub_parts(s, p);
    size_t a = (size_t)tss__sub_modal(s, t->modal)->a;
    (void)worker;
    if (!t->fresh) memset(tss__sub_f(&s->secant) + t->h, 0, a * a * sizeof(double));
}

// Tables, and the modes unless they wait for a refresh callback.
static tss_result tss__sub_prepare(void *user, tss_world *w, const tss_ctx *c) {
    tss_subspace *s = (tss_subspace *)user;
    tss_unknowns u;
    tss_world_unknowns(w, &u);
    if (s->def.mode == TSS_MODE_FULL || s->modal_count == 0) return TSS_OK;
    s->dim = c->dim;
    tss_result r = tss__sub_build(s, c, &u);
    for (int k = 0; k < s->basis_count; k++)
        if (tss__sub_base(s, k)->live && tss__sub_base(s, k)->def.refresh) return r;
    if (r == TSS_OK) r = tss__sub_refresh(s, &s->modes);
    if (r == TSS_OK) tss_parallel(&s->host, s->groups, tss__sub_touch_task, s);
    return r;
}

// Columns of CUSTOM bases for the step to come.
static void tss__sub_refresh_custom(tss_subspace *s, const tss_ctx *c) {
    for (int k = 0; k < s->basis_count; k++) {
        tss__sub_basis *b = tss__sub_base(s, k);
        if (!b->live || b->def.kind != TSS_BASIS_CUSTOM || !b->def.refresh) continue;
        tss__modal *m = tss__sub_modal(s, b->body);
        b->def.refresh(b->def.user, c, m->first, m->nodes, b->b.value);
        m->stale = 1;
    }
}

static tss_result tss__sub_begin_step(void *user, tss_world *w, const tss_ctx *c) {
    tss_subspace *s = (tss_subspace *)user;
    (void)w;
    s->ctx = c;
    s->counts.linear_iterations = s->counts.factorizations = 0;
    s->moved = 0, s->kept = 0;
    tss__sub_refresh_custom(s, c);
    for (int p = 0; s->built && p < s->groups; p++) tss__sub_parts(s, p)->fresh = 0;
    for (int k = 0; k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        if (m->q.p) memset(m->q.p, 0, m->q.bytes);
        if (m->s.p) memset(m->s.p, 0, m->s.bytes);
    }
    if (s->chol_x) tss_chol_forget(s->chol_x);  // a resumed run takes the same path
    tss_chol_destroy(s->chol_q);
    s->chol_q = NULL;
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>downdate (private)
// §3.11, after the step: a block whose modes moved no node by ε_d l h leaves, an enriched node
// leaves where the modes' own displacement is within ε_d l h of its own. Never what joined within
// the last `keep` steps, never the initial blocks. Where masking made modes dependent, or most
// nodes are enriched, d_q says little: the step's displacement is projected on U_a instead.
// ---------------------------------------------------------------------------------------------

// Coefficients of the step's modal displacement in raw coordinates of the active modes, into out.
static tss_result tss__sub_step_modes(tss_subspace *s, const double *step, double *out) {
    size_t nd = (size_t)(s->n * s->dim);
    double *f = (double *)tss__sub_need(s, &s->x_a, nd, sizeof(double));
    double *fit = (double *)tss__sub_need(s, &s->modal_work, 2 * s->modes, sizeof(double));
    if (!f || !fit) return tss__sub_no_memory(s);
    for (size_t k = 0; k < nd; k++) f[k] = tss_world_masses(s->w)[k / (size_t)s->dim] * step[k];
    tss_result r = tss__sub_restrict(s, f, 0, fit);
    if (r != TSS_OK) return r;
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        double *q = out + m->at, *y = fit + m->at;
        if (m->thin_rank == m->wide_rank && 2 * m->enriched <= m->modal_nodes) {
            for (int i = 0; i < m->a; i++) q[i] = tss__sub_f(&m->q)[tss__sub_i(&m->map)[i]];
            continue;
        }
        int w = m->wide_rank, *kept = tss__sub_i(&m->wide);
        double *G = (double *)tss__sub_need(s, &s->small, (size_t)w * (size_t)(w + 1), sizeof(double));
        if (!G) return tss__sub_no_memory(s);
        double *z = G + w * w;
        tss__sub_pick(m, m, 0, tss__sub_f(&m->gram), G, w);
        for (int i = 0; i < w; i++) z[i] = y[kept[i]];
        memset(q, 0, (size_t)m->a * sizeof(double));
        if (w == 0 || tss_dense_chol_factor(w, G, w, NULL) != TSS_OK) continue;
        tss_dense_chol_solve(w, G, w, z, w, 1);
        for (int i = 0; i < w; i++) q[kept[i]] = z[i];
    }
    return TSS_OK;
}

// Largest displacement that one block's share of q makes in its body.
static tss_result tss__sub_block_reach(tss_subspace *s, int body, const tss__sub_block *b, const double *q, double *reach) {
    const tss__modal *m = tss__sub_modal(s, body);
    size_t nd = (size_t)(s->n * s->dim);
    double *only = (double *)tss__sub_need(s, &s->modal_work, 2 * s->modes, sizeof(double));
    double *d = (double *)tss__sub_need(s, &s->x_a, nd, sizeof(double));
    if (!only || !d) return tss__sub_no_memory(s);
    memset(only, 0, s->modes * sizeof(double));
    for (int i = 0; i < m->a; i++)
        if (tss__sub_i(&m->map_block)[i] == (int)(b - tss__sub_blocks(m))) only[m->at + (size_t)i] = q[m->at + (size_t)i];
    memset(d + m->first * s->dim, 0, (size_t)(m->nodes * s->dim) * sizeof(double));
    tss_result r = tss__sub_extend_body(s, body, only, 0, d);
    *reach = 0;
    for (int i = m->first; i < m->first + m->nodes; i++) {
        double l = tss__sub_norm(d + i * s->dim, s->dim);
        *reach = l > *reach ? l : *reach;
    }
    return r;
}

static tss_result tss__sub_downdate_modes(tss_subspace *s, const double *q, double lh) {
    for (int k = 0; k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        for (int j = 0; j < m->blocks; j++) {
            tss__sub_block *b = tss__sub_blocks(m) + j;
            double reach = 0;
            if (!b->active || b->initial || b->age++ < s->def.keep) continue;
            tss_result r = tss__sub_block_reach(s, k, b, q, &reach);
            if (r != TSS_OK) return r;
            if (reach < s->def.downdate * m->diagonal * lh) b->active = 0, m->stale = 1;
        }
    }
    return TSS_OK;
}

static void tss__sub_downdate_nodes(tss_subspace *s, const double *step, const double *modal, double h) {
    for (int k = 0; k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        if (m->a == 0) continue;
        for (int i = m->first; i < m->first + m->nodes; i++) {
            double e[3] = {0, 0, 0};
            if (tss__sub_i(&s->body_of)[i] != k || !tss__sub_u(&s->on)[i]) continue;
            if (tss__sub_i(&s->group_age)[tss__sub_i(&s->group)[i]] < s->def.keep) continue;
            for (int c = 0; c < s->dim; c++) e[c] = step[i * s->dim + c] - modal[i * s->dim + c];
            if (tss__sub_norm(e, s->dim) >= s->def.downdate * m->diagonal * h) continue;
            tss__sub_u(&s->on)[i] = 0;
            m->thin_stale = 1, s->x_stamp++;
        }
    }
    for (int g = 0; g < s->groups; g++)
        if (tss__sub_i(&s->group_age)[g] < INT32_MAX) tss__sub_i(&s->group_age)[g]++;
}

static tss_result tss__sub_downdate(tss_subspace *s, const double *x, const tss_ctx *c) {
    size_t nd = (size_t)(s->n * s->dim);
    double *step = (double *)tss__sub_need(s, &s->d_a, 2 * nd, sizeof(double));
    double *q = (double *)tss__sub_need(s, &s->dq, 3 * s->modes, sizeof(double));
    if (!step || !q) return tss__sub_no_memory(s);
    double *modal = step + nd;
    for (size_t k = 0; k < nd; k++) step[k] = x[k] - c->x_t[k], modal[k] = 0;
    tss_result r = tss__sub_step_modes(s, step, q);
    if (r == TSS_OK) r = tss__sub_extend(s, q, 0, modal);
    if (r == TSS_OK) r = tss__sub_downdate_modes(s, q, c->h);
    if (r == TSS_OK) tss__sub_downdate_nodes(s, step, modal, c->h);
    return r;
}

static tss_result tss__sub_end_step(void *user, tss_world *w, const double *x, tss_step_info *info) {
    tss_subspace *s = (tss_subspace *)user;
    int active = 0, modes = 0;
    for (int k = 0; k < s->modal_count; k++) active += tss__sub_modal(s, k)->a, modes += tss__sub_modal(s, k)->columns;
    info->modes = modes;
    if (s->def.mode == TSS_MODE_FULL || s->modal_count == 0 || !s->built) return TSS_OK;
    info->active_modes = active;
    info->enriched_nodes = s->enriched;
    info->linear_iterations += s->counts.linear_iterations, info->factorizations += s->counts.factorizations;
    for (int i = 0; i < s->n; i++)
        if (!tss__sub_u(&s->on)[i] && tss__sub_f(&s->error)[i] > info->oracle_error) info->oracle_error = tss__sub_f(&s->error)[i];
    (void)w;
    return s->def.mode == TSS_MODE_ADAPTIVE && s->def.downdate > 0 ? tss__sub_downdate(s, x, s->ctx) : TSS_OK;
}

// Diagonal blocks of the Hessian: those of the exact rows from A, the rest as the secants began.
static int tss__sub_diagonal(void *user, const tss_ctx *c, double *D) {
    tss_subspace *s = (tss_subspace *)user;
    const int dd = s->dim * s->dim;
    tss_unknowns u;
    if (!s->built || !s->solved) return 0;
    tss_world_unknowns(s->w, &u);
    memset(D, 0, (size_t)u.rows * (size_t)dd * sizeof(double));
    for (int k = 0; k < u.rows; k++) {
        const double *blk = tss__sub_u(&s->live_row)[k] ? tss_bcsr_block(&s->A, k, k) : NULL;
        int on = tss__sub_u(&s->on)[u.node[k]];
        for (int q = 0; blk && q < dd; q++) D[k * dd + q] = blk[q];
        for (int q = 0; !on && !c->quasistatic && q < dd; q += s->dim + 1) D[k * dd + q] += c->mass[u.node[k]];
    }
    for (int p = 0; p < s->groups; p++) {
        const tss__sub_part *t = tss__sub_parts(s, p);
        for (int i = 0; t->valid && t->fresh && i < t->nodes; i++) {
            int r = u.row[tss__sub_i(&s->part_node)[t->node0 + i]];
            for (int q = 0; r >= 0 && q < dd; q++) D[r * dd + q] += tss__sub_f(&s->part_diag)[(t->node0 + i) * dd + q];
        }
    }
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>subspace_checkpoint (private)
// The kinematic state is the world's. What else the next step depends on: which nodes and blocks
// are active and since when, what the linear solver learnt, its ordering.
// ---------------------------------------------------------------------------------------------

typedef struct tss__sub_head {
    uint64_t n, groups, blocks, built;
    double pcg_iterations, flops;
    int64_t pcg_rest, order;
} tss__sub_head;

static size_t tss__sub_save(const tss_subspace *s, const tss__sub_head *h, char *data, size_t on, size_t ages, size_t need) {
    char *at = data + sizeof *h;
    memcpy(data, h, sizeof *h);
    if (on > 0) memcpy(at, s->on.p, on), memcpy(at + on, s->group_age.p, ages);
    at += on + ages;
    for (int k = 0; k < s->modal_count; k++)
        for (int j = 0; j < tss__sub_modal(s, k)->blocks; j++, at += 2 * sizeof(int)) {
            const tss__sub_block *b = tss__sub_blocks(tss__sub_modal(s, k)) + j;
            int v[2] = {b->active, b->age};
            memcpy(at, v, sizeof v);
        }
    if (h->order > 0) tss_chol_get_order(s->chol_x, (int *)(void *)at, NULL);
    return need;
}

static size_t tss__sub_load(tss_subspace *s, const tss__sub_head *h, const char *at, size_t on, size_t ages, size_t need) {
    // Before the first step there are no groups yet: kept until there are.
    char *pending = (char *)tss__sub_need(s, &s->pending, on + ages, 1);
    if (!pending) return 0;
    if (on > 0) memcpy(pending, at, on + ages);
    s->pending_n = (int)on, s->pending_groups = (int)(ages / sizeof(int));
    int reset = s->built && on == 0;  // saved before there were groups: nothing was enriched
    for (int i = 0; reset && i < s->n; i++)
        if (tss__sub_i(&s->group)[i] >= 0) tss__sub_u(&s->on)[i] = 0;
    for (int g = 0; reset && g < s->groups; g++) tss__sub_i(&s->group_age)[g] = 0;
    if (reset) s->topology = ~s->topology;  // node states anew: partly pinned nodes are enriched
    if (s->built && on > 0) tss__sub_apply_pending(s);
    s->x_stamp++;
    at += on + ages;
    for (int k = 0; k < s->modal_count; k++) {
        tss__modal *m = tss__sub_modal(s, k);
        for (int j = 0; j < m->blocks; j++, at += 2 * sizeof(int)) {
            int v[2];
            memcpy(v, at, sizeof v);
            tss__sub_blocks(m)[j].active = v[0] != 0, tss__sub_blocks(m)[j].age = v[1];
        }
        m->stale = 1;
    }
    s->pcg_iterations = h->pcg_iterations, s->pcg_rest = (int)h->pcg_rest;
    tss_chol_destroy(s->chol_x);
    s->chol_x = NULL;
    if (h->order > 0) {
        tss_chol_def d = tss_chol_def_default();
        int *order = (int *)tss__sub_need(s, &s->row_list, (size_t)h->order, sizeof(int));
        if (!order || tss_chol_create(&s->host, &d, &s->chol_x) != TSS_OK) return 0;
        memcpy(order, at, (size_t)h->order * sizeof(int));
        if (tss_chol_set_order(s->chol_x, (int)h->order, tss_world_dim(s->w), order, h->flops) != TSS_OK) return 0;
    }
    return need;
}

// Puts what a checkpoint said about nodes in force, once there are groups.
static void tss__sub_apply_pending(tss_subspace *s) {
    const char *at = (const char *)s->pending.p;
    if (s->pending_n == s->n && s->pending_groups == s->groups && s->n > 0) {
        memcpy(s->on.p, at, (size_t)s->n);
        memcpy(s->group_age.p, at + s->n, (size_t)s->groups * sizeof(int));
        for (int k = 0; k < s->modal_count; k++) tss__sub_modal(s, k)->thin_stale = 1;
        s->x_stamp++;
    }
    s->pending_n = 0;
}

static size_t tss__sub_state(void *user, void *data, size_t size, int save) {
    tss_subspace *s = (tss_subspace *)user;
    tss__sub_head h;
    memset(&h, 0, sizeof h);
    h.n = (uint64_t)s->n, h.groups = (uint64_t)s->groups, h.built = (uint64_t)s->built;
    for (int k = 0; k < s->modal_count; k++) h.blocks += (uint64_t)tss__sub_modal(s, k)->blocks;
    h.pcg_iterations = s->pcg_iterations, h.pcg_rest = s->pcg_rest;
    h.order = s->chol_x ? tss_chol_get_order(s->chol_x, NULL, &h.flops) : 0;
    if (!save) {
        tss__sub_head old = h;
        if (size < sizeof h) return 0;
        memcpy(&h, data, sizeof h);
        if (h.blocks != old.blocks || (s->built && h.built && (h.n != old.n || h.groups != old.groups))) return 0;
    }
    size_t on = h.built ? (size_t)h.n : 0, ages = h.built ? (size_t)h.groups * sizeof(int) : 0;
    size_t need = sizeof h + on + ages + (size_t)h.blocks * 2 * sizeof(int) + (size_t)h.order * sizeof(int);
    if (!data) return need;
    if (size < need) return 0;
    char *at = (char *)data + sizeof h;
    return save ? tss__sub_save(s, &h, (char *)data, on, ages, need) : tss__sub_load(s, &h, at, on, ages, need);
}
// ---------------------------------------------------------------------------------------------
// >>subspace_api (private)
// ---------------------------------------------------------------------------------------------

tss_subspace_def tss_subspace_def_default(void) {
    tss_subspace_def d;
    memset(&d, 0, sizeof d);
    d.error_nodes = 0.5, d.error_modes = 0.5, d.progress = 1e-4, d.downdate = 0.1;
    d.keep = 2, d.pcg_tol = 1e-5;
    d.cookie = TSS__SUB_COOKIE;
    return d;
}

static tss_result tss__sub_def_ok(tss_world *w, const tss_subspace_def *d) {
    if (d->cookie != TSS__SUB_COOKIE)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "subspace: start from tss_subspace_def_default()");
    const double value[4] = {d->error_nodes, d->error_modes, d->progress, d->downdate};
    const char *name[4] = {"error_nodes", "error_modes", "progress", "downdate"};
    for (int k = 0; k < 4; k++)
        if (!(value[k] >= 0))
            return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "subspace: %s is %g, expected >= 0", name[k], value[k]);
    if ((unsigned)d->mode > TSS_MODE_FULL || (unsigned)d->oracle > TSS_ORACLE_LITERAL ||
        (unsigned)d->secant > TSS_SECANT_EXACT || (unsigned)d->schur > TSS_SCHUR_DIRECT)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "subspace: mode, oracle, secant or schur is not one of its values");
    if (!(d->pcg_tol > 0 && d->pcg_tol < 1) || d->keep < 0 || d->partitions < 0)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT,
                              "subspace: pcg_tol %g, keep %d, partitions %d; expected 0 < pcg_tol < 1, the others >= 0",
                              d->pcg_tol, d->keep, d->partitions);
    return TSS_OK;
}

static void tss__sub_free_modal(tss_subspace *s, tss__modal *m) {
    tss__sub_buf *all[] = {&m->block, &m->gram, &m->thin_gram, &m->wide, &m->thin, &m->live, &m->phi, &m->vec,
                           &m->map, &m->map_block, &m->q, &m->s, &m->sum, m->exact, m->exact + 1};
    for (size_t k = 0; k < sizeof all / sizeof *all; k++) tss__sub_drop(s, all[k]);
}

static void tss__sub_free_basis(tss_subspace *s, tss__sub_basis *b) {
    if (!b->live) return;
    s->bytes -= b->b.bytes;
    tss__basis_free(&s->host, &b->b);
    tss__sub_drop(s, &b->on), tss__sub_drop(s, &b->transposed);
    b->live = 0;
}

static void tss__sub_destroy(void *user, const tss_host *host) {
    tss_subspace *s = (tss_subspace *)user;
    tss_host h = *host;
    s->host = h;
    for (int k = 0; k < s->basis_count; k++) tss__sub_free_basis(s, tss__sub_base(s, k));
    for (int k = 0; k < s->modal_count; k++) tss__sub_free_modal(s, tss__sub_modal(s, k));
    tss__sub_buf *all[] = {
        &s->bases, &s->modal, &s->body_of, &s->group, &s->on, &s->gamma, &s->eta, &s->gamma_print, &s->eta_print,
        &s->error, &s->progress, &s->force, &s->ring, &s->group_ptr, &s->group_node, &s->group_age, &s->parts,
        &s->part_node, &s->part_row, &s->part_col, &s->stencil_ptr, &s->stencil_id, &s->stencil_local,
        &s->stencil_slot, &s->stencil_at, &s->part_of, &s->part_of_at, &s->secant, &s->secant_g, &s->part_diag,
        &s->near_ptr, &s->near_id, &s->want, &s->live_row, &s->live_index, &s->row_list, &s->d_a, &s->x_a, &s->rhs,
        &s->H, &s->cross, &s->cross_val, &s->lane, &s->xrow, &s->xnode, &s->border, &s->border_index,
        &s->border_ptr, &s->border_link, &s->border_u, &s->x_ptr, &s->x_link, &s->small,
        &s->small_work, &s->small_rhs, &s->factors, &s->modal_work, &s->columns, &s->pair_key, &s->solution,
        &s->scratch, &s->xmask, &s->dq, &s->dyn_ptr, &s->dyn_id, &s->pending, &s->activate, &s->near_slot, &s->factored, &s->held};
    for (size_t k = 0; k < sizeof all / sizeof *all; k++) tss__sub_drop(s, all[k]);
    tss_bcsr_free(&h, &s->Ax), tss_bcsr_free(&h, &s->Cx), tss_bcsr_free(&h, &s->Sq);
    tss_chol_destroy(s->chol_q), tss_chol_destroy(s->chol_x);
    tss_pcg_destroy(s->pcg);
    tss_free(&h, s, sizeof *s);
}

tss_subspace *tss_subspace_of(tss_world *w) {
    const tss_direction_def *d = w ? tss_world_direction(w) : NULL;
    return d && d->direction == tss__sub_direction ? (tss_subspace *)d->user : NULL;
}

tss_result tss_subspace_add(tss_world *w, const tss_subspace_def *def, tss_subspace **out) {
    if (out) *out = NULL;
    if (!w || !def) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss__sub_def_ok(w, def);
    if (r != TSS_OK) return r;
    if (tss_subspace_of(w))
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "subspace: this world has one; tss_subspace_set changes it");
    tss_subspace *s = (tss_subspace *)tss_alloc(tss_world_host(w), sizeof *s);
    if (!s) return tss_world_fail(w, TSS_ERROR_NO_MEMORY, "subspace: out of memory");
    memset(s, 0, sizeof *s);
    s->def = *def, s->w = w, s->host = *tss_world_host(w), s->dim = tss_world_dim(w);
    tss_direction_def d = tss_direction_def_default();
    d.name = "subspace", d.user = s, d.prepare = tss__sub_prepare;
    d.begin_step = tss__sub_begin_step, d.direction = tss__sub_direction, d.accepted = tss__sub_accepted;
    d.end_step = tss__sub_end_step, d.diagonal = tss__sub_diagonal, d.state = tss__sub_state;
    d.destroy = tss__sub_destroy;
    r = tss_world_set_direction(w, &d);
    if (out) *out = s;
    return r;
}

tss_result tss_subspace_set(tss_subspace *s, const tss_subspace_def *def) {
    if (!s || !def) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss__sub_def_ok(s->w, def);
    if (r != TSS_OK) return r;
    int partitions = s->def.partitions, modes_change = def->mode != s->def.mode;
    s->def = *def, s->def.partitions = partitions;
    if (modes_change) s->pending_n = 0;
    for (int k = 0; modes_change && k < s->modal_count; k++) tss__sub_modal(s, k)->stale = 1;
    if (!modes_change || !s->built) return TSS_OK;
    for (int i = 0; i < s->n; i++)  // subspace alone: no nodes; others find what they need
        if (tss__sub_i(&s->body_of)[i] >= 0) tss__sub_u(&s->on)[i] = 0;
    s->x_stamp++;
    return TSS_OK;
}

void tss_subspace_get_info(const tss_subspace *s, tss_subspace_info *out) {
    memset(out, 0, sizeof *out);
    for (int k = 0; k < s->modal_count; k++) {
        out->bodies += tss__sub_modal(s, k)->columns > 0;
        out->modes += tss__sub_modal(s, k)->columns, out->active_modes += tss__sub_modal(s, k)->a;
    }
    for (int k = 0; k < s->basis_count; k++) out->bases += tss__sub_base(s, k)->live;
    out->setup_seconds = s->setup_seconds, out->bytes = s->bytes;
    out->oracle_calls = s->oracle_calls, out->hessians = s->hessians;
    out->secant_updates = s->secant_updates, out->secant_skips = s->secant_skips;
    if (!s->built) return;
    out->groups = s->groups, out->nodes = s->nodes, out->enriched_nodes = s->enriched;
    out->group = tss__sub_i(&s->group), out->enriched = tss__sub_u(&s->on);
    out->error = tss__sub_f(&s->error), out->progress = tss__sub_f(&s->progress);
}

tss_result tss_subspace_query(tss_world *w) {
    tss_subspace *s = tss_subspace_of(w);
    if (!s) return w ? tss_world_fail(w, TSS_ERROR_NOT_FOUND, "subspace: this world has no basis") : TSS_ERROR_BAD_ARGUMENT;
    s->query = 1;
    tss_result r = tss_world_probe(w);
    s->query = 0;
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>basis_api (private)
// ---------------------------------------------------------------------------------------------

// The body's entry among those with modes; a new one where there is none.
static tss_result tss__sub_find_body(tss_subspace *s, const tss_body_info *info, tss_body body, int *out) {
    for (*out = 0; *out < s->modal_count; ++*out)
        if (tss__sub_modal(s, *out)->body == body) return TSS_OK;
    if (!tss__sub_need(s, &s->modal, (size_t)s->modal_count + 1, sizeof(tss__modal))) return tss__sub_no_memory(s);
    tss__modal *m = tss__sub_modal(s, s->modal_count);
    memset(m, 0, sizeof *m);
    m->body = body, m->first = info->first_node, m->nodes = info->nodes, m->stale = 1;
    double lo[3], hi[3], sum = 0;
    for (int c = 0; c < s->dim; c++) lo[c] = INFINITY, hi[c] = -INFINITY;
    for (int i = 0; i < m->nodes * s->dim; i++) {
        double X = tss__sub_X(s, m)[i];
        lo[i % s->dim] = X < lo[i % s->dim] ? X : lo[i % s->dim];
        hi[i % s->dim] = X > hi[i % s->dim] ? X : hi[i % s->dim];
    }
    for (int c = 0; c < s->dim; c++) sum += (hi[c] - lo[c]) * (hi[c] - lo[c]);
    m->diagonal = sqrt(sum);
    s->modal_count++;
    s->built = 0;
    return TSS_OK;
}

// The body's mesh in local numbers, as bases read it; arrays in one allocation.
static tss_result tss__sub_mesh_of(tss_subspace *s, const tss_body_info *info, tss_body body, tss__sub_mesh *m, void **room,
                                   size_t *bytes) {
    size_t cells = (size_t)info->cells, n = (size_t)info->nodes, size = (size_t)s->dim + 1;
    *bytes = 2 * cells * sizeof(double) + cells * size * sizeof(int) + n;
    *room = tss_alloc(&s->host, *bytes);
    if (!*room) return tss__sub_no_memory(s);
    double *mu = (double *)*room, *lambda = mu + cells;
    int *cell = (int *)(void *)(lambda + cells);
    uint8_t *fixed = (uint8_t *)(cell + cells * size);
    for (size_t k = 0; k < cells * size; k++) cell[k] = tss_body_cells(s->w, body)[k] - info->first_node;
    for (size_t k = 0; k < cells; k++) tss_body_cell_material(s->w, body, (int)k, mu + k, lambda + k, NULL);
    for (size_t i = 0; i < n; i++) fixed[i] = tss_world_kinds(s->w)[info->first_node + (int)i] != TSS_NODE_FREE;
    m->host = &s->host, m->dim = s->dim, m->nodes = info->nodes, m->cells = info->cells, m->cell = cell;
    m->X = tss_world_rest(s->w) + info->first_node * s->dim, m->mass = tss_world_masses(s->w) + info->first_node;
    m->mu = mu, m->lambda = lambda, m->fixed = fixed;
    return TSS_OK;
}

// Candidates of the oracle for a new basis, at the end of its body's list.
static tss_result tss__sub_add_blocks(tss_subspace *s, int body, int basis, const tss__sub_basis *b) {
    tss__modal *m = tss__sub_modal(s, body);
    tss__sub_block *q = (tss__sub_block *)tss__sub_need(s, &m->block, (size_t)(m->blocks + b->b.blocks), sizeof *q);
    if (!q) return tss__sub_no_memory(s);
    for (int k = 0; k < b->b.blocks; k++) {
        tss__sub_block *n = q + m->blocks + k;
        memset(n, 0, sizeof *n);
        n->basis = basis, n->block = k;
        n->initial = n->active = b->def.initial < 0 || k < b->def.initial;
    }
    m->blocks += b->b.blocks;
    m->stale = 1;
    return TSS_OK;
}

tss_result tss_basis_add(tss_world *w, tss_body body, const tss_basis_def *def, tss_basis *out) {
    tss_body_info info;
    tss__sub_mesh mesh;
    void *room;
    size_t bytes;
    char why[240] = "";
    if (out) *out = -1;
    if (!w || !def) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_world_prepare(w);
    if (r != TSS_OK) return r;
    if (tss_body_get(w, body, &info) != TSS_OK || info.removed)
        return tss_world_fail(w, TSS_ERROR_NOT_FOUND, "basis: there is no body %d", body);
    if (info.kind != TSS_BODY_SOFT || info.cells == 0)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "basis: %s has no cells; a basis needs a soft body with cells", info.name);
    tss_subspace *s = tss_subspace_of(w);
    if (!s) {
        tss_subspace_def d = tss_subspace_def_default();
        if ((r = tss_subspace_add(w, &d, &s)) != TSS_OK) return r;
    }
    tss__sub_basis b;
    memset(&b, 0, sizeof b);
    b.live = 1, b.def = *def;
    double from = tss__sub_clock(s);
    if ((r = tss__sub_mesh_of(s, &info, body, &mesh, &room, &bytes)) != TSS_OK) return r;
    r = tss__basis_build(&mesh, def, &b.b, why, sizeof why);
    tss_free(&s->host, room, bytes);
    if (r != TSS_OK) return tss_world_fail(w, r, "basis of %s: %s", info.name, why);
    b.seconds = tss__sub_clock(s) - from;
    s->bytes += b.b.bytes;
    if (!tss__sub_need(s, &s->bases, (size_t)s->basis_count + 1, sizeof b)) r = tss__sub_no_memory(s);
    if (r == TSS_OK) r = tss__sub_find_body(s, &info, body, &b.body);
    if (r == TSS_OK) r = tss__sub_add_blocks(s, b.body, s->basis_count, &b);
    if (r != TSS_OK) {
        tss__sub_free_basis(s, &b);
        return r;
    }
    *tss__sub_base(s, s->basis_count) = b;
    if (out) *out = s->basis_count;
    s->basis_count++;
    return TSS_OK;
}

tss_result tss_basis_remove(tss_world *w, tss_basis id) {
    tss_subspace *s = tss_subspace_of(w);
    if (!s || id < 0 || id >= s->basis_count || !tss__sub_base(s, id)->live)
        return w ? tss_world_fail(w, TSS_ERROR_NOT_FOUND, "there is no basis %d", id) : TSS_ERROR_BAD_ARGUMENT;
    tss__modal *m = tss__sub_modal(s, tss__sub_base(s, id)->body);
    int kept = 0;
    for (int k = 0; k < m->blocks; k++)
        if (tss__sub_blocks(m)[k].basis != id) tss__sub_blocks(m)[kept++] = tss__sub_blocks(m)[k];
    m->blocks = kept, m->stale = 1;
    tss__sub_free_basis(s, tss__sub_base(s, id));
    return TSS_OK;
}

int tss_world_bases(const tss_world *w) {
    const tss_subspace *s = tss_subspace_of((tss_world *)(uintptr_t)w);
    return s ? s->basis_count : 0;
}

tss_result tss_basis_get(const tss_world *w, tss_basis id, tss_basis_info *out) {
    const tss_subspace *s = tss_subspace_of((tss_world *)(uintptr_t)w);
    if (!s || !out) return TSS_ERROR_BAD_ARGUMENT;
    if (id < 0 || id >= s->basis_count || !tss__sub_base(s, id)->live) return TSS_ERROR_NOT_FOUND;
    const tss__sub_basis *b = tss__sub_base(s, id);
    const tss__modal *m = tss__sub_modal(s, b->body);
    memset(out, 0, sizeof *out);
    out->body = m->body, out->kind = b->def.kind, out->blocks = b->b.blocks;
    for (int k = 0; k < m->blocks; k++)
        out->active_blocks += tss__sub_blocks(m)[k].basis == id && tss__sub_blocks(m)[k].active;
    out->functions = b->b.columns, out->modes = b->b.columns * (b->b.vector ? 1 : s->dim);
    out->eigenvalue = b->b.eigenvalue, out->residual = b->b.residual, out->seconds = b->seconds;
    out->bytes = b->b.bytes, out->cached = b->b.cached;
    return TSS_OK;
}

tss_result tss_basis_mode(const tss_world *w, tss_basis id, int mode, double *out) {
    tss_basis_info info;
    tss_result r = tss_basis_get(w, id, &info);
    if (r != TSS_OK || !out || mode < 0 || mode >= info.modes) return r != TSS_OK ? r : TSS_ERROR_BAD_ARGUMENT;
    const tss_subspace *s = tss_subspace_of((tss_world *)(uintptr_t)w);
    const tss__basis *b = &tss__sub_base(s, id)->b;
    const tss__modal *m = tss__sub_modal(s, tss__sub_base(s, id)->body);
    int block = 0, f = b->vector ? mode : mode / s->dim;
    while (b->first[block + 1] <= f) block++;
    memset(out, 0, (size_t)(m->nodes * s->dim) * sizeof(double));
    int wide = b->first[block + 1] - b->first[block];
    double *row = (double *)tss_alloc(&s->host, (size_t)wide * sizeof(double));
    if (!row) return TSS_ERROR_NO_MEMORY;
    for (int i = 0; i < m->nodes; i++) {
        if (b->vector) {
            for (int c = 0; c < s->dim; c++) out[i * s->dim + c] = b->value[(i * s->dim + c) * b->columns + f];
            continue;
        }
        tss__basis_rows(b, tss__sub_X(s, m), s->dim, &i, 1, &block, 1, row, wide);
        out[i * s->dim + mode % s->dim] = row[f - b->first[block]];
    }
    tss_free(&s->host, row, (size_t)wide * sizeof(double));
    return TSS_OK;
}

#ifdef __cplusplus
}
#endif
#if defined(__GNUC__) && !defined(__clang__)
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
