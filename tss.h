/* tss.h: soft bodies that bend, squash and touch; a C library in a single header
 *
 * What it is: a simulator of contacting elastodynamics. Bodies are meshes of tetrahedra (3D) or
 * triangles (2D); each time step minimises an incremental potential (paper A: "Trading Spaces",
 * Trusty et al. 2024, §3.1, Eq. 1-4) with Newton's method to a tolerance you set. With tss_ipc.h
 * bodies never pass through each other, and with the default material elements never invert.
 *
 * Set-up, in one .c or .cpp file of your program:
 *     #define TSS_IMPLEMENTATION
 *     #include "tss.h"
 * and #include "tss.h" wherever you call it. Link -lm, and -lmetis unless TSS_NO_METIS.
 *
 * The smallest program:
 *     #define TSS_IMPLEMENTATION
 *     #include "tss.h"
 *     int main(void) {
 *         const double X[12] = {0, 0, 0,  1, 0, 0,  0, 1, 0,  0, 0, 1};
 *         const int tet[4] = {0, 1, 2, 3};
 *         tss_world_def wd = tss_world_def_default();
 *         tss_world *w;
 *         if (tss_world_create(&wd, &w) != TSS_OK) return 1;
 *         tss_body_def bd = tss_body_def_default();
 *         bd.nodes = 4, bd.X = X, bd.cells = 1, bd.cell = tet;
 *         if (tss_body_add(w, &bd, NULL) != TSS_OK) return puts(tss_world_error(w)), 1;
 *         for (int step = 0; step < 10; step++) tss_world_step(w, NULL);
 *         printf("fell to y = %g m\n", tss_world_positions(w)[1]);
 *         tss_world_destroy(w);
 *     }
 *
 * Options, defined before the implementation:
 *     TSS_NO_OPENMP  no OpenMP even if the compiler has it on; saves libgomp. host.parallel_for
 *                    brings your own threads in either case.
 *     TSS_NO_METIS   a built-in ordering in place of METIS; saves the library, costs fill in the
 *                    factor and so time.
 *     TSS_NO_SIMD    no intrinsics: plain loops. Slower factorisation (docs/performance.md).
 *     TSS_NO_LAPACK  accepted and without effect: the dense kernels are built in. Debian's serial
 *                    OpenBLAS returned wrong products when called from several threads at once,
 *                    and a threaded BLAS changes bits with the number of threads.
 * Features, left out in the same way. They save object code (of 598 kB with all three headers, -O2,
 * x86-64) and no time: what a scene does not use costs none (docs/leave_out.md). What is left keeps
 * its bits. `tss check SCENE` names those that a scene can do without.
 *     TSS_NO_2D         23 kB  worlds of 3D only; tss_world_create refuses dim = 2, and logs why.
 *     TSS_NO_3D        101 kB  worlds of 2D only; likewise, and no membranes and hinges.
 *     TSS_NO_MATERIALS  20 kB  Neo-Hookean only; tss_body_add refuses other densities, yours too.
 *     TSS_NO_DAMPING    15 kB  no stiffness-proportional damping; tss_body_add refuses damping > 0.
 *     TSS_NO_THIN       29 kB  no membranes, hinges and springs; their functions refuse and log why.
 *     TSS_NO_FRICTION    4 kB  tss_ipc_add refuses mu > 0.
 *     TSS_NO_EIGEN      37 kB  tss_basis_add refuses bases that solve for their modes.
 *     A header not included: tss_ipc.h 179 kB, tss_subspace.h 136 kB.
 *
 * And:
 *     TSS_ALLOW_FAST_MATH  compile under -ffast-math all the same; nothing is promised then.
 *     TSS_ASSERT(c)  what to do about a caller's bug; default assert.
 *     TSS_API        linkage of public functions; default extern.
 *
 * Memory: all through tss_host.alloc. A step allocates only when some array reaches a new
 * high-water mark. METIS has no allocator hook: it uses malloc, inside the first solve after a
 * change of the scene or of the contacts' pattern, one caller at a time.
 * Threads: a world belongs to one thread at a time; different worlds are independent (except for
 * METIS, see above). Work inside is spread by OpenMP or tss_host.parallel_for.
 * Determinism: the same bits for any number of threads, on the same machine and build. Work is cut
 * into fixed blocks and summed in fixed order; nothing that alters a result reads a clock, except
 * tss_world_step_for.
 * Errors: three kinds. A caller's bug trips TSS_ASSERT; bad input and lack of memory return a
 * tss_result, say why in tss_world_error and change nothing; a step that could not be solved to
 * its tolerance is a tss_status in tss_step_info, and its state is still feasible.
 * Limits: linear elements; 2^31 matrix blocks; one step length for the whole world.
 *
 * CONVENTIONS
 *     Units are SI: metre, kilogram, second, newton, pascal. 2D is plane strain, 1 m deep.
 *     Positions are n × d, node by node. Small matrices are row-major. Indices start at 0.
 *     Tets (v0 v1 v2 v3) have det[x1 − x0, x2 − x0, x3 − x0] > 0; 2D triangles run anti-clockwise;
 *     surface triangles run anti-clockwise seen from outside.
 *     Energies are sums w_s W_s(x) over stencils; a force is minus a gradient.
 *     Names are the field's and the papers': x̃ predicted positions, h step, αh² the integrator's
 *     factor on forces, F deformation gradient, J = det F, d̂ reach of the barrier, κ its stiffness.
 */
#ifndef TSS_H
#define TSS_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef TSS_API
#define TSS_API extern
#endif

// ---------------------------------------------------------------------------------------------
// >>results (public)
// Bad input and no memory are tss_result; numerical outcomes are statuses in tss_step_info.
// ---------------------------------------------------------------------------------------------

#define TSS_RESULTS(X)                                                                            \
    X(TSS_OK, "success")                                                                          \
    X(TSS_ERROR_NO_MEMORY, "the allocator returned NULL")                                         \
    X(TSS_ERROR_BAD_ARGUMENT, "an argument is outside its documented range")                      \
    X(TSS_ERROR_BAD_MESH, "the mesh is malformed")                                                \
    X(TSS_ERROR_BAD_MATERIAL, "a material parameter is outside its range")                        \
    X(TSS_ERROR_BAD_STATE, "a position or velocity is not a finite number")                       \
    X(TSS_ERROR_INTERSECTION, "bodies intersect at the start")                                    \
    X(TSS_ERROR_NOT_PREPARED, "tss_world_prepare has not been called since the scene changed")    \
    X(TSS_ERROR_EMPTY, "the scene has nothing to simulate")                                       \
    X(TSS_ERROR_NOT_FOUND, "no such body, energy or node")                                        \
    X(TSS_ERROR_SINGULAR, "the matrix is not positive definite")                                  \
    X(TSS_ERROR_FILE, "a file cannot be opened, read or written")                                 \
    X(TSS_ERROR_FORMAT, "a file's contents are malformed")                                        \
    X(TSS_ERROR_MISMATCH, "a checkpoint does not fit this scene")

typedef enum tss_result {
#define TSS__ENUM(id, text) id,
    TSS_RESULTS(TSS__ENUM)
#undef TSS__ENUM
        TSS_RESULT_COUNT
} tss_result;

// One sentence for a result code; never NULL.
TSS_API const char *tss_result_text(tss_result r);

// ---------------------------------------------------------------------------------------------
// >>host (public)
// What the library asks of the program around it: memory, threads, a clock, a place for messages.
// ---------------------------------------------------------------------------------------------

// Called for each block 0 <= block < blocks, in any order, on any thread; worker is unique among
// the calls running at one time, 0 <= worker < tss_host.workers. Results must not depend on it.
typedef void tss_task(int block, int worker, void *arg);

typedef enum tss_log_level { TSS_LOG_ERROR, TSS_LOG_WARNING, TSS_LOG_INFO } tss_log_level;

typedef struct tss_host {
    void *(*alloc)(size_t bytes, size_t align, void *ctx);  // NULL: the C library
    void (*free)(void *ptr, size_t bytes, void *ctx);       // bytes as given to alloc
    void *memory_ctx;
    // Runs task for every block and returns when all are done. NULL: OpenMP, or serial without it.
    void (*parallel_for)(int blocks, tss_task *task, void *arg, void *ctx);
    void *parallel_ctx;
    int workers;  // threads parallel_for may use; 0: OpenMP's default. Never changes a result.
    double (*clock)(void *ctx);  // seconds, monotonic; NULL: no timings, step_for cannot stop
    void *clock_ctx;
    void (*log)(tss_log_level level, const char *message, void *ctx);  // NULL: silent
    void *log_ctx;
} tss_host;

// The C library's memory, OpenMP's threads (if compiled in), no clock, no log.
TSS_API tss_host tss_host_default(void);
// Memory aligned to 64 bytes, not cleared; NULL when the allocator gives none (or bytes == 0).
TSS_API void *tss_alloc(const tss_host *host, size_t bytes);
// ptr may be NULL; bytes as given to tss_alloc.
TSS_API void tss_free(const tss_host *host, void *ptr, size_t bytes);
// Runs task(0..blocks-1); the calling thread takes part. Not reentrant from inside a task.
TSS_API void tss_parallel(const tss_host *host, int blocks, tss_task *task, void *arg);
// Threads that tss_parallel may use: the number of per-worker scratch buffers to provide, >= 1.
TSS_API int tss_workers(const tss_host *host);
TSS_API void tss_log(const tss_host *host, tss_log_level level, const char *format, ...);

// ---------------------------------------------------------------------------------------------
// >>energies (public)
// Every energy is a weighted sum over small stencils of nodes (paper A, Eq. 4). Elasticity,
// inertia, contact and friction use this hook; so can you.
// ---------------------------------------------------------------------------------------------

typedef enum tss_node_kind {
    TSS_NODE_FREE = 0,       // an unknown
    TSS_NODE_PINNED = 1,     // stays where it is
    TSS_NODE_SCRIPTED = 2,   // follows its target (tss_node_target)
    TSS_NODE_OBSTACLE = 3,   // node of a body without elasticity; follows its target if it has one
} tss_node_kind;             // everything but FREE is kinematic

// What an energy may read about the step being solved. Valid during the call only.
typedef struct tss_ctx {
    const tss_host *host;
    int dim;             // d: 2 or 3
    int nodes;           // n: of all bodies, obstacles included
    double h;            // time step, s
    double ah2;          // αh² of the integrator, s² (1 when quasi-static)
    int quasistatic;
    double diagonal;     // l: of the rest bounding box of all deformable bodies, m
    const double *X;       // rest positions, n × d, m
    const double *x_t;     // positions at the start of the step, n × d
    const double *x_tilde; // inertial prediction x̃ (Eq. 3 and footnote 9), n × d
    const double *v_t;     // velocities at the start of the step, n × d, m/s
    const double *mass;    // lumped masses, n, kg (0 for nodes without volume)
    const uint8_t *kind;   // tss_node_kind, n
    const int *body;       // body of each node, n
    uint64_t step;         // steps taken so far
    uint64_t topology;     // changes whenever bodies, nodes or kinds change
    // ∇E at x_t of all energies that are not DYNAMIC, n × d, αh² and inertia included; only during
    // begin_step, and only if some energy has WANTS_GRADIENT (else NULL).
    const double *g;
    // Only during check: look at these nodes (n, 1: set free since the last check); NULL: at all.
    const uint8_t *fresh;
} tss_ctx;

// Which stencils a batch call is about: list[0..count-1], or first..first+count-1 if list is NULL.
typedef struct tss_ids {
    int first, count;
    const int *list;
} tss_ids;

// A list of stencils. node: count × arity node numbers, −1 = none (such a place's rows are 0).
// pattern changes only when node (or count) changes. Owned by the energy, valid until the next
// call of lists.
typedef struct tss_stencils {
    int count;
    const int *node;
    uint64_t pattern;
} tss_stencils;

enum {                             // tss_energy_def.flags
    TSS_ENERGY_TIMES_AH2 = 1,      // the sum is multiplied by αh² (forces); inertia is not
    TSS_ENERGY_SECANT_OK = 2,      // may be replaced by secant matrices inside a subdomain (§3.9)
    TSS_ENERGY_CONST_HESSIAN = 4,  // the Hessian does not depend on x
    TSS_ENERGY_J_BARRIER = 8,      // value is +inf at and beyond some states: max_step guards them
    TSS_ENERGY_DYNAMIC = 16,       // stencils change within a step: kept in a matrix of their own
    TSS_ENERGY_WANTS_GRADIENT = 32,  // begin_step needs ctx->g (contact stiffness)
};

typedef enum tss_severity { TSS_SEVERITY_NOTE, TSS_SEVERITY_WARNING, TSS_SEVERITY_ERROR } tss_severity;
typedef void tss_issue_fn(tss_severity severity, const char *text, void *arg);

typedef struct tss_energy_def {
    const char *name;  // for messages; copied
    int arity;         // nodes a stencil, 1..8
    unsigned flags;
    void *user;        // handed to every call; see destroy
    // Stencils that may be active anywhere on x + t·d, t ∈ [0, t_max]: one list serves the line
    // search and the step filter. d NULL: at x alone. Required.
    tss_result (*lists)(void *user, const tss_ctx *c, const double *x, const double *d,
                        double t_max, tss_stencils *out);
    // Weighted value, gradient and Hessian of each stencil, in batches of at most
    // TSS_BATCH ids, called from several threads at once. a = arity, d = dim.
    //   value: out[k];  gradient: out[k·ad + ...];  hessian: out[k·(ad)² + row·ad + col], symmetric;
    //   psd != 0: projected to the nearest positive semi-definite matrix. Required, all three.
    void (*value)(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out);
    void (*gradient)(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out);
    void (*hessian)(void *user, const tss_ctx *c, const double *x, tss_ids ids, int psd,
                    double *out);
    // The rest may be NULL.
    tss_result (*begin_step)(void *user, const tss_ctx *c);  // a new step from c->x_t
    // Largest t ∈ [0, t_max] such that x + s·d is feasible for all s ∈ [0, t]; the stencil that
    // limits it (index in the list last handed out) goes to *culprit (−1: none).
    // The list last handed out covers x + t·d for t ∈ [0, t_max].
    double (*max_step)(void *user, const tss_ctx *c, const double *x, const double *d, double t_max,
                       int *culprit);
    // After an accepted iterate x0 → x1. Returns 1 if the energy changed itself (barrier stiffness).
    int (*after_iterate)(void *user, const tss_ctx *c, const double *x0, const double *x1);
    // After a converged solve at x. Returns 1 to ask for another solve (friction lagging).
    int (*after_solve)(void *user, const tss_ctx *c, const double *x);
    // One line that names stencil id, e.g. "tet 12 of body 0 (nodes 3 8 1 9)".
    void (*describe)(void *user, const tss_ctx *c, int id, char *text, size_t size);
    // What must survive a checkpoint. save == 0: reads. Returns the bytes the state takes, or 0 on
    // a mismatch; with data NULL only the size.
    size_t (*state)(void *user, void *data, size_t size, int save);
    // The doctor asks, and a step that starts from a state no step has passed: report what is wrong
    // at x (intersections by name), and the values chosen.
    void (*check)(void *user, const tss_ctx *c, const double *x, tss_issue_fn *add, void *arg);
    // Smallest distance to the edge of the feasible set at x, m (contact: between surfaces; +inf
    // when nothing is near). Called at the end of a step.
    double (*clearance)(void *user, const tss_ctx *c, const double *x);
    // What a subspace's oracle measures with (paper A, Eq. 5 and 8). For each node i of each cell:
    // W[i] += smallest non-zero eigenvalue of the rest Hessian of the density, Pa; cells[i] += 1;
    // v[i] += its share of the volume, m³; a[i] += the face opposite i, m² (in 2D m², m).
    void (*node_scale)(void *user, const tss_ctx *c, double *W, double *cells, double *v, double *a);
    void (*destroy)(void *user, const tss_host *host);
    int cookie;
} tss_energy_def;

// All zero but for the cookie: start from it.
TSS_API tss_energy_def tss_energy_def_default(void);

#define TSS_BATCH 64  // most stencils in one batch call; multiples of 8 start at multiples of 8

// ---------------------------------------------------------------------------------------------
// >>materials (public)
// Energy densities psi(F) in J/m³ of the undeformed body, F = ∂x/∂X; J = det F.
// With Young's modulus E and Poisson's ratio nu:
//     mu = E / (2 (1 + nu)),    lambda = E nu / ((1 + nu) (1 − 2 nu)).
// Every density below has psi(I) = 0, no stress at rest, and linear elasticity with this E and nu
// as its limit for small strain. 2D is plane strain, thickness 1 m: F with a third stretch of 1.
// ---------------------------------------------------------------------------------------------

typedef enum tss_material_kind {
    // mu/2 (‖F‖² − d) − mu ln J + lambda/2 ln² J. Infinite at J → 0: elements never invert. With nu < 0
    // (lambda < 0) psi falls again below J = exp(mu/lambda): squashed that far, elements collapse
    // towards J = 0 and steps stall; they still do not invert.
    TSS_NEO_HOOKEAN = 0,
    // Smith, De Goes, Kim 2018: m/2 (I_C − 3) + l/2 (J − 1 − 3m/4l)² − m/2 ln(I_C + 1), less its
    // value at rest; I_C = ‖F‖² (+ 1 in 2D), m = 4/3 mu, l = lambda + 5/6 mu make it agree with
    // linear elasticity. Smooth and finite everywhere: elements may invert, and come back.
    TSS_STABLE_NEO_HOOKEAN,
    // mu ‖F − R‖² + lambda/2 (J − 1)², R the rotation nearest to F. Elements may invert.
    TSS_FIXED_COROTATED,
    // mu E:E + lambda/2 (tr E)², E = (FᵀF − I)/2. Weak in compression: it gives way at a stretch of
    // 0.58 and has no stress at 0. For thin bodies that bend more than they squash.
    TSS_STVK,
    // mu e:e + lambda/2 (tr e)², e = (F + Fᵀ)/2 − I. Constant Hessian; rotation costs energy.
    TSS_LINEAR,
    TSS_CUSTOM_MATERIAL,  // your density, see tss_density
    TSS_MATERIAL_KINDS
} tss_material_kind;

// A density of your own. For count deformation gradients F (row-major d × d each; F[r·d + m] =
// ∂x_r/∂X_m) writes what is asked for, the rest is NULL: psi[k], J/m³; P[k·d² + ...] = ∂psi/∂F, Pa;
// C[k·d⁴ + row·d² + col] = ∂P/∂F, Pa, row and col as in F, symmetric. cell[k]: the cell each F
// belongs to, for parameters of your own. Called from several threads at once.
typedef void tss_density(void *user, int dim, int count, const int *cell, const double *F,
                         double *psi, double *P, double *C);

typedef struct tss_material {
    tss_material_kind kind;  // default TSS_NEO_HOOKEAN
    double E;                // Young's modulus, Pa, > 0; default 1e5
    double nu;               // Poisson's ratio, −1 < nu < 0.5; default 0.4
    double rho;              // density of mass, kg/m³, > 0; default 1000
    // TSS_CUSTOM_MATERIAL only; E and nu still set the scales of the oracle and of contact.
    tss_density *density;
    void *user;   // handed to density; must outlive the world
    int has_C;    // density can give C; 0: C by central differences of P (error about 1e-9)
    int barrier;  // psi is infinite where J <= 0: steps are cut short of it
    // Stiffness-proportional damping, s, >= 0; default 0: none. Force −damping · H(x_t) v with the
    // projected Hessian H of the start of the step. A mode of frequency w (rad/s) loses the share
    // damping · w / 2 of critical. Not for TSS_CUSTOM_MATERIAL.
    double damping;
} tss_material;

TSS_API tss_material tss_material_default(void);
// The Lamé parameters of E and nu, Pa (formulas above); lambda or mu may be NULL.
TSS_API void tss_lame(double E, double nu, double *mu, double *lambda);

// ---------------------------------------------------------------------------------------------
// >>thin_energies (public)
// Membranes, hinges and springs between nodes of a 3D scene (springs: 2D as well). Each function
// fills an energy for tss_energy_add; all arrays are copied, the energy's destroy frees them. On an
// error *out is untouched. Errors: TSS_ERROR_BAD_ARGUMENT, _BAD_MESH (a triangle or edge without
// extent), _BAD_MATERIAL, _NO_MEMORY. Node numbers are checked to be >= 0, not against the scene.
// ---------------------------------------------------------------------------------------------

// Stretching of triangles in 3D: thickness · area · psi(F), F = ∂x/∂(rest plane), 3 × 2, in plane
// stress (lambda replaced by E nu / (1 − nu²)), C = FᵀF:
//   TSS_STVK          mu E:E + lambda/2 (tr E)², E = (C − I)/2
//   TSS_NEO_HOOKEAN   mu/2 (tr C − 2) − mu ln J + lambda/2 ln² J, J = √det C (area ratio)
typedef struct tss_membrane_def {
    int triangles;
    const int *node;        // triangles × 3, from 0
    const double *X;        // rest positions, nodes × 3, m; read only for the nodes named
    double thickness;       // m, > 0; default 1e-3
    tss_material material;  // kind TSS_STVK or TSS_NEO_HOOKEAN (default), E, nu
} tss_membrane_def;
TSS_API tss_membrane_def tss_membrane_def_default(void);
TSS_API tss_result tss_membrane_energy(const tss_host *host, const tss_membrane_def *def,
                                       tss_energy_def *out);

// Bending of a surface at its inner edges (discrete shells, Grinspun et al. 2003):
//   ½ k · 3‖e‖²/(A_1 + A_2) · (theta − theta_rest)²,
// e the rest edge, A the rest areas, theta the angle between the normals, 0 when flat, positive
// when the surface bends towards the side its normals point to. k in N·m is then the bending
// modulus of the plate, E thickness³ / (12 (1 − nu²)): theta/(height of the edge's dual cell) is
// its curvature. Projected Hessian: Gauss–Newton, k_e ∇theta ∇thetaᵀ.
typedef struct tss_hinge_def {
    int hinges;
    const int *node;   // hinges × 4: edge (a, b), then the third nodes of triangle (a, b, ·)
                       // and of triangle (b, a, ·), both counter-clockwise seen from outside
    const double *X;   // rest positions, nodes × 3, m
    double stiffness;  // k, N·m, > 0; default 1e-4
    const double *rest_angle;  // hinges, rad; NULL: the angles of X. Default NULL
} tss_hinge_def;
TSS_API tss_hinge_def tss_hinge_def_default(void);
TSS_API tss_result tss_hinge_energy(const tss_host *host, const tss_hinge_def *def,
                                    tss_energy_def *out);

// Springs ½ k (‖x_b − x_a‖ − L)².
typedef struct tss_spring_def {
    int springs;
    const int *node;   // springs × 2
    const double *X;   // rest positions, nodes × dim, m; may be NULL if rest_length is given
    int dim;           // 2 or 3, default 3
    double stiffness;  // k, N/m, > 0; default 1
    const double *stiffnesses;  // one a spring, or NULL (default)
    const double *rest_length;  // L, m, >= 0, one a spring; NULL (default): from X
} tss_spring_def;
TSS_API tss_spring_def tss_spring_def_default(void);
TSS_API tss_result tss_spring_energy(const tss_host *host, const tss_spring_def *def,
                                     tss_energy_def *out);


// ---------------------------------------------------------------------------------------------
// >>bcsr (public)
// Symmetric sparse matrices of d × d blocks, both triangles stored: rows are nodes, blocks are
// row-major, columns ascend within a row. Scalar row i of node a is a·d + i.
// ---------------------------------------------------------------------------------------------

typedef struct tss_bcsr {
    int n;             // nodes (block rows)
    int d;             // block size: 1, 2 or 3
    int64_t *row;      // n + 1: blocks of row a are row[a] .. row[a+1]-1
    int *col;          // node of each block, ascending within a row
    double *val;       // d·d numbers a block
    uint64_t pattern;  // changes whenever row or col change; 0: unknown (always compared);
                       // UINT64_MAX is not to be used
    size_t row_bytes, col_bytes, val_bytes;  // what the arrays hold; 0: not owned
} tss_bcsr;

// Makes room for n rows and blocks blocks; contents are kept only if nothing had to grow. Start
// from a zeroed struct. TSS_ERROR_NO_MEMORY leaves the matrix as it was.
TSS_API tss_result tss_bcsr_reserve(const tss_host *host, tss_bcsr *A, int n, int d,
                                    int64_t blocks);
// Frees what tss_bcsr_reserve gave and zeroes the struct.
TSS_API void tss_bcsr_free(const tss_host *host, tss_bcsr *A);
// Column order, column range, row pointers, structural and numerical symmetry to the relative
// tolerance tol (< 0: structure alone). TSS_ERROR_BAD_ARGUMENT if not. O(blocks · log row).
TSS_API tss_result tss_bcsr_check(const tss_bcsr *A, double tol);
// Address of block (a, b), or NULL when it is not in the pattern. O(log row).
TSS_API double *tss_bcsr_block(const tss_bcsr *A, int a, int b);
// y = A x, or y += A x if add. x and y: n·d, different arrays. Same bits for any thread count.
TSS_API void tss_bcsr_multiply(const tss_host *host, const tss_bcsr *A, const double *x, double *y,
                               int add);
// The diagonal blocks: n·d·d, row-major, 0 where the pattern has none. add: added to out.
TSS_API void tss_bcsr_diagonal(const tss_host *host, const tss_bcsr *A, double *out, int add);

// ---------------------------------------------------------------------------------------------
// >>pcg (public)
// Preconditioned conjugate gradients on A + B, or on an operator given as a callback.
// ---------------------------------------------------------------------------------------------

typedef struct tss_pcg tss_pcg;  // the workspace; grows only

typedef enum tss_pcg_status {
    TSS_PCG_CONVERGED,       // ‖b − (A + B) x‖ ≤ tol ‖b‖ (by recurrence)
    TSS_PCG_MAX_ITERATIONS,  // the iterations ran out; x is the last iterate
    TSS_PCG_INDEFINITE,      // pᵀ A p ≤ 0: x is the iterate before (the preconditioned b if first)
    TSS_PCG_BREAKDOWN,       // a NaN or an infinity, or rᵀ M⁻¹ r ≤ 0; x is the iterate before
} tss_pcg_status;

typedef struct tss_pcg_def {
    int n, d;                  // nodes and block size; unknowns: n·d
    const tss_bcsr *A, *B;     // either may be NULL
    const uint8_t *fixed;      // n·d, 1: row and column act as the identity; NULL: none
    // With apply: y = operator(x), for all n·d unknowns (A and B are then used only for the
    // preconditioner). Rows and columns of fixed unknowns are masked by the solver.
    void (*apply)(void *user, const double *x, double *y);
    // z = M⁻¹ r; NULL: block-Jacobi from diagonal, or from A and B. Must be symmetric positive.
    void (*precondition)(void *user, const double *r, double *z);
    void *user;
    const double *diagonal;    // n·d·d blocks for block-Jacobi; NULL: those of A + B
    double tol;                // relative to ‖b‖₂; default 1e-5 (paper A)
    int max_iterations;        // default 1000
    int warm;                  // 1: start from the x handed in; default 0: from zero
    int cookie;
} tss_pcg_def;

typedef struct tss_pcg_info {
    tss_pcg_status status;
    int iterations;
    double residual;   // ‖b − A x‖ / ‖b‖ by recurrence; 0 if b = 0
    double curvature;  // the last pᵀ A p / pᵀ p (a sample of the spectrum)
    int repaired;      // diagonal blocks that were not positive definite (their diagonal is used)
} tss_pcg_info;

TSS_API tss_pcg_def tss_pcg_def_default(void);
TSS_API tss_result tss_pcg_create(const tss_host *host, tss_pcg **out);
TSS_API void tss_pcg_destroy(tss_pcg *p);  // NULL allowed
// Room for n nodes of d unknowns: 4·n·d + n·d·d doubles. Optional: solve calls it.
TSS_API tss_result tss_pcg_reserve(tss_pcg *p, int n, int d);
// Solves for x (n·d); fixed unknowns get x = b. Cost an iteration: one product, three passes over
// vectors. Dot products are summed in fixed blocks: same bits for any thread count.
TSS_API tss_result tss_pcg_solve(tss_pcg *p, const tss_pcg_def *def, const double *b, double *x,
                                 tss_pcg_info *info);

// ---------------------------------------------------------------------------------------------
// >>cholesky (public)
// Sparse Cholesky P (A + B) Pᵀ = L Lᵀ: analyze (pattern) → factor (numbers) → solve. A's pattern
// is fixed, B's (contact) may change before every factorisation.
// ---------------------------------------------------------------------------------------------

typedef struct tss_chol tss_chol;

typedef enum tss_chol_reuse {  // what the last tss_chol_analyze had to do
    TSS_CHOL_KEPT,             // nothing: every block lies in L's structure
    TSS_CHOL_RESTRUCTURED,     // new structure with the ordering kept
    TSS_CHOL_REORDERED,        // new ordering
} tss_chol_reuse;

typedef struct tss_chol_def {
    double pivot_tol;    // a pivot ≤ pivot_tol · a_jj is rounding noise: default 7e-15 (32 ε)
    double reorder_at;   // reorder at this many times the flops of the last ordering: default 1.5
    int seed;            // of METIS; default 1
    int use_metis;       // default 1; 0: the built-in ordering (always under TSS_NO_METIS)
    int cookie;
} tss_chol_def;

typedef struct tss_chol_info {
    tss_chol_reuse reuse;
    int orderings, analyses;  // so far: fresh orderings, structures computed
    int fronts, tasks;        // supernodes; independent subtrees
    double flops;             // of one factorisation, as stored (with the zeros of amalgamation)
    double flops_ordered;     // the same right after the last ordering
    int64_t nonzeros;         // of L, as stored
    size_t bytes;             // held in all: L, the stack of update matrices, structure
    int bad_row;              // TSS_ERROR_SINGULAR: the unknown whose pivot failed; −1 otherwise
} tss_chol_info;

TSS_API tss_chol_def tss_chol_def_default(void);
TSS_API tss_result tss_chol_create(const tss_host *host, const tss_chol_def *def, tss_chol **out);
TSS_API void tss_chol_destroy(tss_chol *c);  // NULL allowed
// Ordering and structure for A + B; B may be NULL. Does only what the patterns make necessary,
// decided by counted work. On an error the structure before is kept. METIS is not thread-safe:
// one analyze at a time in a process.
TSS_API tss_result tss_chol_analyze(tss_chol *c, const tss_bcsr *A, const tss_bcsr *B);
// Numbers; patterns must lie inside the analysed structure (TSS_ERROR_BAD_ARGUMENT if not).
// fixed: n·d, 1: row and column of the identity; NULL: none. TSS_ERROR_SINGULAR: see bad_row; the
// structure stays, the factor is void. Same bits for any thread count.
TSS_API tss_result tss_chol_factor(tss_chol *c, const tss_bcsr *A, const tss_bcsr *B,
                                   const uint8_t *fixed);
// X := (A + B)⁻¹ X for k right-hand sides: n·d × k, column-major. TSS_ERROR_NOT_PREPARED without
// a factor.
TSS_API tss_result tss_chol_solve(tss_chol *c, double *X, int k);
// x := (A + B)⁻¹ b with steps of iterative refinement (one is enough unless near singular), with
// the matrices last factored. residual (NULL allowed): ‖b − (A+B) x‖₂ / ‖b‖₂ of the result.
TSS_API tss_result tss_chol_solve_refined(tss_chol *c, const tss_bcsr *A, const tss_bcsr *B,
                                          const uint8_t *fixed, const double *b, double *x,
                                          int steps, double *residual);
TSS_API void tss_chol_get_info(const tss_chol *c, tss_chol_info *info);
// Makes the next analyze start from the ordering alone, so that what follows depends on the matrices
// given from here on and not on those before.
TSS_API void tss_chol_forget(tss_chol *c);
// The kept ordering for a checkpoint: its size (0: none); order (NULL: only the size) gets n node
// numbers, *flops what a factorisation took right after it was made.
TSS_API int tss_chol_get_order(const tss_chol *c, int *order, double *flops);
// Takes an ordering back: n nodes of d unknowns; n = 0: none. order must be a permutation of 0..n−1
// (TSS_ERROR_BAD_ARGUMENT if not).
TSS_API tss_result tss_chol_set_order(tss_chol *c, int n, int d, const int *order, double flops);

// ---------------------------------------------------------------------------------------------
// >>dense_cholesky (public)
// Column-major, lower triangle; the strict upper triangle is never used but may be overwritten.
// ---------------------------------------------------------------------------------------------

// C (m × n) = β C + α op(A) op(B), inner dimension k > 0, β 0 or 1; trans: op(A) = Aᵀ. Serial; safe to
// call from several threads. An entry's sum runs over k in order.
TSS_API void tss_dense_product(int trans_a, int trans_b, int m, int n, int k, double alpha,
                               const double *a, int lda, const double *b, int ldb, double beta,
                               double *c, int ldc);
// A = L Lᵀ in place (n × n, leading dimension lda ≥ n). TSS_ERROR_SINGULAR and the failing column
// in *bad (NULL allowed) when a pivot is ≤ 7e-15 · a_jj. n³/3 flops. bad: −1 on success.
// Serial; safe to call from several threads on different matrices.
TSS_API tss_result tss_dense_chol_factor(int n, double *a, int lda, int *bad);
// X := L⁻ᵀ L⁻¹ X, n × k column-major.
TSS_API void tss_dense_chol_solve(int n, const double *l, int lda, double *x, int ldx, int k);
// Pivoted, rank-revealing: A(perm,perm) = L Lᵀ with L n × rank. Stops when the largest remaining
// diagonal is ≤ drop · max a_jj (drop ≥ 0); scale A to a unit diagonal first for a relative test.
// perm (n): row perm[i] of A became row i. Columns ≥ rank of a are rubbish. work: n doubles.
TSS_API void tss_dense_chol_pivoted(int n, double *a, int lda, double drop, int *perm, int *rank,
                                    double *work);

// ---------------------------------------------------------------------------------------------
// >>worlds (public)
// A world holds bodies, energies and the state (x, v). Bodies and energies are small ids; node
// numbers run through all bodies in the order they were added and never change.
// ---------------------------------------------------------------------------------------------

typedef struct tss_world tss_world;
typedef int tss_body;    // 0, 1, ... in the order of tss_body_add
typedef int tss_energy;  // 0, 1, ... in the order of tss_energy_add

typedef enum tss_integrator {
    TSS_BDF2,            // second order; the first step after a start or a jump is implicit Euler
    TSS_IMPLICIT_EULER,  // first order, strongly damping (Eq. 3)
    TSS_NEWMARK,         // average acceleration (β = 1/4, γ = 1/2), second order, undamped
    TSS_QUASISTATIC,     // no inertia: each step finds a static equilibrium
} tss_integrator;

typedef enum tss_linear {
    TSS_LINEAR_AUTO,    // whichever needs less counted work, given the iterations seen so far
    TSS_LINEAR_DIRECT,  // sparse Cholesky
    TSS_LINEAR_PCG,     // conjugate gradients, block-Jacobi
} tss_linear;

typedef struct tss_world_def {
    tss_host host;       // default: C library, OpenMP, no clock, no log
    int dim;             // 2 or 3; default 3
    double dt;           // h, s, > 0; default 0.01
    double gravity[3];   // m/s²; default (0, −9.80665, 0)
    tss_integrator integrator;  // default TSS_BDF2
    double tol;          // ε: converged when ‖d‖∞/h ≤ tol, m/s; 0: use tol_rel; default 0
    double tol_rel;      // tol = tol_rel × diagonal of the rest bounding box, 1/s; default 1e-2.
                         // Quasi-static: converged when ‖d‖∞ ≤ 1e-3 · tol_rel × diagonal.
    int max_iterations;  // Newton iterates a step may take in all; default 2000
    tss_linear linear;   // default TSS_LINEAR_AUTO
    double pcg_tol;      // relative residual of the linear solve; default 1e-5
    int pcg_iterations;  // bound on the iterations of one linear solve; default 10000
    int newton_residual;  // 1: info.residual_newton is measured, at the cost of a full-space solve
                          // a step; default 0
    // Every accepted iterate, also those of a step that does not converge; x_prev of the first is
    // the state before the step and the x_next of one call is the x_prev of the next. n × dim.
    void (*on_iterate)(const double *x_prev, const double *x_next, void *ctx);
    void *on_iterate_ctx;
    int cookie;
} tss_world_def;

TSS_API tss_world_def tss_world_def_default(void);
// Creates an empty world. *out is NULL on error. Release with tss_world_destroy (NULL allowed).
TSS_API tss_result tss_world_create(const tss_world_def *def, tss_world **out);
TSS_API void tss_world_destroy(tss_world *w);
// One sentence about the last call that failed on this world: names body, node, element, value.
TSS_API const char *tss_world_error(const tss_world *w);
// For extensions: sets that sentence (printf format), logs it and returns r.
TSS_API tss_result tss_world_fail(tss_world *w, tss_result r, const char *format, ...);

// ---------------------------------------------------------------------------------------------
// >>bodies (public)
// ---------------------------------------------------------------------------------------------

typedef enum tss_body_kind {
    TSS_BODY_SOFT,      // cells (tets in 3D, triangles in 2D) with a material, or a shell of triangles
    TSS_BODY_OBSTACLE,  // a surface without elasticity: stands still or follows tss_body_target
} tss_body_kind;

// All arrays are copied. Node numbers in them are local to the body, from 0.
typedef struct tss_body_def {
    const char *name;     // for messages; NULL: "body N"
    tss_body_kind kind;   // default TSS_BODY_SOFT
    int nodes;
    const double *X;      // rest positions, nodes × dim, m
    int cells;            // tets (4 nodes, 3D) or triangles (3 nodes, 2D)
    const int *cell;      // cells × (dim + 1), positive volume
    int triangles;        // 3D: an obstacle's or shell's faces (a solid's surface is extracted)
    const int *triangle;  // triangles × 3
    int segments;         // obstacle's segments (2D: its whole surface)
    const int *segment;   // segments × 2
    int points;           // obstacle's isolated points
    const int *point;     // points
    tss_material material;   // of all cells, unless one of the arrays below is given
    const double *E;         // Young's modulus of each cell, Pa, or NULL
    const double *nu;        // Poisson's ratio of each cell, or NULL
    const double *rho;       // density of each cell, kg/m³, or NULL
    double thickness;        // of a shell, m (its mass: area · thickness · ρ); default 1e-3
    const double *x0;        // initial positions, nodes × dim; NULL: X
    const double *v0;        // initial velocities, nodes × dim, m/s; NULL: velocity below
    double velocity[3];      // of every node where v0 is NULL, m/s
    int pins;                // nodes that stay where they start
    const int *pin;
    int cookie;
} tss_body_def;

TSS_API tss_body_def tss_body_def_default(void);
// Adds a body; call tss_world_prepare before the next step. Errors: BAD_MESH, BAD_MATERIAL,
// BAD_STATE, NO_MEMORY: nothing is added and tss_world_error names the place.
TSS_API tss_result tss_body_add(tss_world *w, const tss_body_def *def, tss_body *out);
// Takes a body out of the simulation; its nodes keep their numbers and stay where they are.
TSS_API tss_result tss_body_remove(tss_world *w, tss_body b);

typedef struct tss_body_info {
    const char *name;
    tss_body_kind kind;
    int first_node, nodes;  // world node numbers first_node .. first_node + nodes − 1
    int cells;
    int removed;
} tss_body_info;
TSS_API int tss_world_bodies(const tss_world *w);
TSS_API tss_result tss_body_get(const tss_world *w, tss_body b, tss_body_info *out);

// Collision primitives of all bodies, in world node numbers. Owned by the world; changes with
// prepare. 3D: triangles, their edges and free segments, and their nodes and free points.
// 2D: no triangles.
typedef struct tss_surface {
    int points, edges, triangles;
    const int *point;     // points
    const int *edge;      // edges × 2
    const int *triangle;  // triangles × 3, counter-clockwise seen from outside
    uint64_t topology;    // changes when any of it does
} tss_surface;
TSS_API tss_result tss_world_surface(const tss_world *w, tss_surface *out);
// Cells of a body, cells × (dim + 1), in world node numbers; owned by the world.
TSS_API const int *tss_body_cells(const tss_world *w, tss_body b);

// ---------------------------------------------------------------------------------------------
// >>setters (public)
// All may be called before and after prepare, between steps. Node numbers are the world's.
// ---------------------------------------------------------------------------------------------

// Fixes the axes (bit c = coordinate c; 7 = all) of a node where they are; axes 0 sets it free. The
// next step refuses to start (INTERSECTION) if what is set free intersects. Errors: BAD_ARGUMENT for
// nodes of obstacles and of removed bodies.
TSS_API tss_result tss_node_pin(tss_world *w, int node, unsigned axes);
// Scripts a node: it moves to target (dim) within the next step and stays until told otherwise.
TSS_API tss_result tss_node_target(tss_world *w, int node, const double *target);
// Targets of all nodes of an obstacle, nodes × dim; NULL: stop where it is.
TSS_API tss_result tss_body_target(tss_world *w, tss_body b, const double *x);
// A force on a node, N (dim), that acts until changed. In 2D: N per metre of depth.
TSS_API tss_result tss_node_force(tss_world *w, int node, const double *force);
// Pulls a node towards a point with a spring of the given stiffness, N/m; 0 lets go. The mouse.
TSS_API tss_result tss_node_drag(tss_world *w, int node, const double *target, double stiffness);
// Sets positions and velocities of a body (nodes × dim; v NULL: 0). The integrator starts anew.
TSS_API tss_result tss_body_teleport(tss_world *w, tss_body b, const double *x, const double *v);
TSS_API tss_result tss_world_set_gravity(tss_world *w, const double *gravity);
TSS_API tss_result tss_world_set_dt(tss_world *w, double dt);    // the integrator starts anew
TSS_API tss_result tss_world_set_tol(tss_world *w, double tol);  // m/s, > 0

// ---------------------------------------------------------------------------------------------
// >>stepping (public)
// ---------------------------------------------------------------------------------------------

#define TSS_STATUSES(X)                                                                           \
    X(TSS_STEP_CONVERGED, "converged")                                                            \
    X(TSS_STEP_ITERATIONS, "iterations")  /* max_iterations reached */                            \
    X(TSS_STEP_BUDGET, "budget")          /* the time given to step_for ran out */                \
    X(TSS_STEP_STALLED, "stalled")        /* no feasible descent along the Newton direction */    \
    X(TSS_STEP_TARGETS, "targets")        /* max_iterations reached, scripted nodes on their way */      \
    X(TSS_STEP_LINEAR, "linear")          /* the linear solver failed */
typedef enum tss_status {
#define TSS__ENUM(id, text) id,
    TSS_STATUSES(TSS__ENUM)
#undef TSS__ENUM
        TSS_STATUS_COUNT
} tss_status;
TSS_API const char *tss_status_text(tss_status s);

typedef enum tss_phase {
    TSS_PHASE_ENERGY, TSS_PHASE_GRADIENT, TSS_PHASE_HESSIAN, TSS_PHASE_ASSEMBLE,
    TSS_PHASE_LINEAR, TSS_PHASE_COLLISION, TSS_PHASE_ORACLE, TSS_PHASE_OTHER, TSS_PHASE_COUNT
} tss_phase;
TSS_API const char *tss_phase_text(tss_phase p);

typedef struct tss_step_info {
    tss_status status;
    char message[256];     // when not converged: the reason and the worst element, pair or node
    double time;           // at the end of the step, s
    int newton;            // Newton iterates
    int linear_iterations; // of PCG, all solves; 0 for direct solves
    int factorizations;    // numeric Cholesky factorisations
    int enriched_nodes, nodes;       // unknown nodes solved for one by one / all unknown nodes
    int active_modes, modes;         // subspace modes in use / available
    int contacts;          // active stencils of energies whose lists change, at the end
    double residual_max;   // max_i ‖D_i⁻¹ ∇_{x_i}E‖/h, m/s; D_i the node's Hessian block
    double residual_mean;
    double decrement;      // ‖d‖∞/h of the last Newton direction, m/s
    double residual_newton;  // ‖full-space Newton step‖∞/h at the end, m/s, with def.newton_residual
    double oracle_error;   // largest 𝒢_i of a node that is not enriched (deformation, not error)
    double target_left;    // largest distance of a scripted node from its target, m
    double min_J;          // over all cells, at the end of the step
    double min_distance;   // between surfaces, m; +inf when nothing is near
    double min_alpha;      // shortest accepted line-search step
    double seconds, phase_seconds[TSS_PHASE_COUNT];  // 0 without a clock
    size_t bytes;          // allocated by this world
    uint64_t allocations;  // made during this step
} tss_step_info;

// Partition, masses, symbolic work; then steps may be taken. Errors: EMPTY, NO_MEMORY and those of
// the energies. Cheap when nothing changed.
TSS_API tss_result tss_world_prepare(tss_world *w);
// Optional, after everything was added: prepare, and what the solver makes once (a subspace its
// groups, tables and Gram matrices), so that the first step takes no longer than others. Same
// errors; it changes no bit of any step.
TSS_API tss_result tss_world_ready(tss_world *w);
// One time step of length dt, to tolerance. A numerical failure is a status, not an error: time
// goes on and the state is the last accepted iterate, always feasible. info may be NULL. On an error the
// state is that before the call.
TSS_API tss_result tss_world_step(tss_world *w, tss_step_info *info);
// The same, but returns after about `seconds` (host.clock is needed) with the best state so far.
TSS_API tss_result tss_world_step_for(tss_world *w, double seconds, tss_step_info *info);

// The host as the world uses it: memory taken through it is counted in info.bytes.
TSS_API const tss_host *tss_world_host(const tss_world *w);
TSS_API int tss_world_dim(const tss_world *w);
TSS_API int tss_world_nodes(const tss_world *w);
TSS_API double tss_world_time(const tss_world *w);
TSS_API double tss_world_diagonal(const tss_world *w);
TSS_API const double *tss_world_positions(const tss_world *w);   // n × dim, always feasible
TSS_API const double *tss_world_velocities(const tss_world *w);  // n × dim
TSS_API const double *tss_world_rest(const tss_world *w);        // X, n × dim
TSS_API const double *tss_world_masses(const tss_world *w);      // n
TSS_API const uint8_t *tss_world_kinds(const tss_world *w);      // tss_node_kind, n
// Sum of the gradients of all energies that are forces at the current state, n × dim, N: minus
// what elasticity, contact and your own energies do. Gravity and nodal forces are not in it.
TSS_API tss_result tss_world_gradient(tss_world *w, double *out);
// Total energy by kind, J: kinetic, potential of all energies that are forces, gravity excluded.
TSS_API tss_result tss_world_energy(tss_world *w, double *kinetic, double *potential);
// 64-bit hash of the bits of x and v.
TSS_API uint64_t tss_world_hash(const tss_world *w);

// Checkpoints: bit-exact resume into a world built by the same calls. save returns the bytes
// needed (data NULL: only that) or 0 on too small a size; load refuses anything that does not fit
// or is not finite, and then changes nothing (FORMAT, MISMATCH, NO_MEMORY).
TSS_API size_t tss_world_save(const tss_world *w, void *data, size_t size);
TSS_API tss_result tss_world_load(tss_world *w, const void *data, size_t size);

// ---------------------------------------------------------------------------------------------
// >>directions (public)
// Who finds the direction of a Newton iterate. Without a finder the world solves its full-space
// system; tss_subspace.h plugs a finder in here, and so can you. The world keeps the loop: lists,
// gradient, step filters, line search, convergence. The functions below marked "inside" may be
// called from a finder's begin_step and direction only.
// ---------------------------------------------------------------------------------------------

typedef struct tss_iterate {
    const tss_ctx *ctx;
    int number;       // 0: the first of the step
    const double *x;  // where it stands, n × d
    const double *g;  // ∇E at x, n × d; 0 at fixed axes
    int moves;        // kinematic nodes have a way to go: d holds their displacement
    double tol;       // ‖d‖∞ that counts as converged, m
    double *d;        // n × d, to be filled at the unknown nodes (0 there on entry)
    int handled;      // out: 1: d is the direction; 0: the world solves in full space
    int more;         // out: 1: not converged, however short d is
} tss_iterate;

typedef struct tss_direction_def {
    const char *name;  // for messages; a string that outlives the world
    void *user;
    // All but direction may be NULL. w's current state is x at the start of the step.
    // Called by tss_world_ready, with the fixed lists in use: what needs to be made once.
    tss_result (*prepare)(void *user, tss_world *w, const tss_ctx *c);
    tss_result (*begin_step)(void *user, tss_world *w, const tss_ctx *c);
    tss_result (*direction)(void *user, tss_world *w, tss_iterate *it);
    // After the line search took x0 → x1 = x0 + α·d.
    void (*accepted)(void *user, const tss_ctx *c, const double *x0, const double *x1, double alpha);
    // After the last iterate, before velocities are updated: may fill the counts in info.
    tss_result (*end_step)(void *user, tss_world *w, const double *x, tss_step_info *info);
    // Blocks of the Hessian's diagonal (unknown by unknown, d × d) for info.residual_max, of all
    // energies that are not DYNAMIC. Returns 0 if the world's own matrix has them.
    int (*diagonal)(void *user, const tss_ctx *c, double *D);
    // What must survive a checkpoint, as in tss_energy_def.
    size_t (*state)(void *user, void *data, size_t size, int save);
    void (*destroy)(void *user, const tss_host *host);
    int cookie;
} tss_direction_def;

TSS_API tss_direction_def tss_direction_def_default(void);
// Sets the world's finder (def NULL: none); the one before is destroyed. Between steps only.
TSS_API tss_result tss_world_set_direction(tss_world *w, const tss_direction_def *def);
// The finder's def (NULL: none), owned by the world.
TSS_API const tss_direction_def *tss_world_direction(const tss_world *w);

// Unknown nodes. Owned by the world, valid until the next prepare.
typedef struct tss_unknowns {
    int rows;              // unknown nodes
    const int *row;        // n: its number among them, −1 for a kinematic node
    const int *node;       // rows
    const uint8_t *fixed;  // rows × d: 1 for an axis that is pinned; NULL: none is
} tss_unknowns;
TSS_API void tss_world_unknowns(const tss_world *w, tss_unknowns *out);

typedef struct tss_energy_view {
    const char *name;
    const tss_energy_def *def;
    tss_stencils list;  // the one in use
    double scale;       // αh² or 1
    int inertia;        // 1: Σ m/2 ‖x − x̃‖², its Hessian is the lumped mass
} tss_energy_view;
// Energies have ids 0 .. count − 1; get returns NOT_FOUND where one was removed.
TSS_API int tss_world_energies(const tss_world *w);
TSS_API tss_result tss_energy_get(const tss_world *w, tss_energy e, tss_energy_view *out);

// The world's matrices, one row an unknown node, patterns brought up to date with the lists in use
// (inside). Fixed stencils add to A, DYNAMIC ones to C. Values are the caller's to clear and fill.
TSS_API tss_result tss_world_matrices(tss_world *w, tss_bcsr *A, tss_bcsr *C);
// Adds the projected Hessian of energy e at x to its matrix (inside). want: a byte a stencil, 0:
// left out; NULL: all. d_k and rhs (rows × d), both or neither: rhs −= H_fk d_k for the moving
// kinematic nodes.
TSS_API tss_result tss_world_add_hessian(tss_world *w, tss_energy e, const double *x,
                                         const uint8_t *want, const double *d_k, double *rhs);
// All lists anew, for x + t·d with t ∈ [0, t_max], d NULL: for x alone (inside).
TSS_API tss_result tss_world_list_along(tss_world *w, const double *x, const double *d, double t_max);
// Largest t ≤ 1 that every energy's step filter allows from x along d; the lists then cover x + t·d
// (inside). The same as the world does with the direction it is given.
TSS_API tss_result tss_world_step_limit(tss_world *w, const double *x, const double *d, double *t);
// ring[i] += E_i(x0) − E_i(x1), E_i the sum of the stencils that hold node i (paper A, Eq. 7), for
// unknown nodes; *drop += E(x0) − E(x1). Over the lists in use (inside).
TSS_API tss_result tss_world_ring_drop(tss_world *w, const double *x0, const double *x1,
                                       double *ring, double *drop);
// The full-space Newton direction at the iterate, into d (n × d; kinematic nodes as they are in d);
// *ok 0 if the linear solve failed (inside). Changes the matrices.
TSS_API tss_result tss_world_full_direction(tss_world *w, double *d, int *ok);
// Asks the finder for the first direction of the step to come, and takes no step: nothing changes.
TSS_API tss_result tss_world_probe(tss_world *w);
// Adds the time since the last call to a phase.
TSS_API void tss_world_clock_phase(tss_world *w, tss_phase p);

// Takes x, v, the integrator's memory, time, targets and what energies remember from a world built by the same
// calls (contact stiffness, lagged friction); tolerance, direction finder and linear solver stay as they are.
TSS_API tss_result tss_world_copy_state(tss_world *to, const tss_world *from);

// Lamé parameters (Pa) and density (kg/m³) of a body's cell; any of them may be NULL.
TSS_API tss_result tss_body_cell_material(const tss_world *w, tss_body b, int cell, double *mu,
                                          double *lambda, double *rho);

// ---------------------------------------------------------------------------------------------
// >>doctor (public)
// ---------------------------------------------------------------------------------------------

#define TSS_CHECK_MAX 32
typedef struct tss_check_report {
    int errors, warnings, notes;  // counts of all issues, also of those not kept below
    int count;                    // issues kept
    struct { tss_severity severity; char text[240]; } issue[TSS_CHECK_MAX];
} tss_check_report;
// What is wrong with this scene, by name, and how to mend it. Takes no step and changes nothing
// but prepares the world. Returns TSS_OK also when issues were found.
TSS_API tss_result tss_world_check(tss_world *w, tss_check_report *out);

// Adds an energy (see the hook above). user must live until destroy is called.
TSS_API tss_result tss_energy_add(tss_world *w, const tss_energy_def *def, tss_energy *out);
TSS_API tss_result tss_energy_remove(tss_world *w, tss_energy e);

typedef struct tss_energy_report {
    double gradient_error, hessian_error;  // largest deviation from central differences, relative
                                           // to the stencil or 1/1000 of the largest one
    int gradient_stencil, hessian_stencil;
    double psd_min;                        // smallest eigenvalue of a projected Hessian / its norm
} tss_energy_report;
// Compares an energy's gradient and Hessian at the current state with central differences. For
// authors of energies; slow.
TSS_API tss_result tss_energy_check(tss_world *w, tss_energy e, tss_energy_report *out);

// ---------------------------------------------------------------------------------------------
// >>embedding (public)
// A render mesh carried by the cells of a body: barycentric weights, single precision out.
// ---------------------------------------------------------------------------------------------

typedef struct tss_embedding tss_embedding;
// points: count × dim in rest space. Points outside the body use the nearest cell (extrapolated).
TSS_API tss_result tss_embedding_create(tss_world *w, tss_body b, const double *points, int count,
                                        tss_embedding **out);
TSS_API void tss_embedding_destroy(tss_embedding *e);
// Writes count × dim floats.
TSS_API void tss_embedding_update(const tss_embedding *e, const tss_world *w, float *out);

#ifdef __cplusplus
}
#endif
#endif  // TSS_H

#if defined(TSS_IMPLEMENTATION) && !defined(TSS_IMPLEMENTATION_DONE)
#define TSS_IMPLEMENTATION_DONE

#if defined(__FAST_MATH__) && !defined(TSS_ALLOW_FAST_MATH)
#error "-ffast-math breaks infinities, the order of sums and collision bounds; TSS_ALLOW_FAST_MATH to try"
#endif

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// (gcc for Windows misaligns vectors on the stack, bug 54412.)
#if defined(__GNUC__) && defined(__x86_64__) && !defined(TSS_NO_SIMD) &&                          \
    (defined(__clang__) || !defined(_WIN32))
#include <immintrin.h>
#define TSS__X86 1
#endif
#ifndef TSS_NO_METIS
#include <metis.h>
#endif
#if !defined(TSS_NO_OPENMP) && defined(_OPENMP)
#include <omp.h>
#define TSS__OPENMP 1
#endif

#ifndef TSS_ASSERT
#include <assert.h>
#define TSS_ASSERT(c) assert(c)
#endif

// Contraction to fused multiply-adds would make the bits depend on the compiler's mood.
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
// >>features (private)
// What a TSS_NO_* leaves out hangs on a condition that is a constant here: the compiler drops the
// code behind it, no #if stands inside the sections, and every line is compiled in every build.
// What is asked for all the same is refused by name, in tss_world_create and tss_body_add.
// ---------------------------------------------------------------------------------------------

#if defined(TSS_NO_2D) && defined(TSS_NO_3D)
#error "TSS_NO_2D and TSS_NO_3D together leave nothing to simulate"
#endif

#if defined(TSS_NO_2D)
#define TSS__DIM(dim) ((void)(dim), 3)
#elif defined(TSS_NO_3D)
#define TSS__DIM(dim) ((void)(dim), 2)
#else
#define TSS__DIM(dim) (dim)
#endif

#ifdef TSS_NO_MATERIALS
#define TSS__KIND(kind) ((void)(kind), TSS_NEO_HOOKEAN)
#else
#define TSS__KIND(kind) (kind)
#endif

#ifdef TSS_NO_DAMPING
#define TSS__DAMPING(seconds) ((void)(seconds), 0.0)
#else
#define TSS__DAMPING(seconds) (seconds)
#endif

#ifdef TSS_NO_THIN
#define TSS__THIN 0
#else
#define TSS__THIN 1
#endif
#define TSS__THIN_3D (TSS__THIN && TSS__DIM(3) == 3)

// The switch that leaves out worlds of this dimension, this material, or thin energies of this
// dimension; NULL: none does.
static const char *tss__dim_left_out(int dim) {
    const int kept = TSS__DIM(dim);
    return kept == dim ? NULL : dim == 2 ? "TSS_NO_2D" : "TSS_NO_3D";
}

static const char *tss__material_left_out(const tss_material *m) {
    if (TSS__KIND(m->kind) == TSS_NEO_HOOKEAN && m->kind != TSS_NEO_HOOKEAN) return "TSS_NO_MATERIALS";
    return m->damping > 0 && !(TSS__DAMPING(m->damping) > 0) ? "TSS_NO_DAMPING" : NULL;
}

static const char *tss__thin_left_out(int dim) {
    return TSS__THIN ? tss__dim_left_out(dim) : "TSS_NO_THIN";
}

static tss_result tss__refuse(const tss_host *host, const char *what, const char *left_out_by) {
    tss_log(host, TSS_LOG_ERROR, "%s: left out of this build by %s", what, left_out_by);
    return TSS_ERROR_BAD_ARGUMENT;
}

// ---------------------------------------------------------------------------------------------
// >>host (private)
// ---------------------------------------------------------------------------------------------

const char *tss_result_text(tss_result r) {
    static const char *const text[] = {
#define TSS__TEXT(id, text) text,
        TSS_RESULTS(TSS__TEXT)
#undef TSS__TEXT
    };
    return (unsigned)r < TSS_RESULT_COUNT ? text[r] : "unknown result";
}

// Aligned memory from malloc alone: the pointer malloc gave is kept just below the block.
static void *tss__libc_alloc(size_t bytes, size_t align, void *ctx) {
    (void)ctx;
    if (bytes > SIZE_MAX - align - sizeof(void *)) return NULL;
    char *raw = (char *)malloc(bytes + align + sizeof(void *));
    if (!raw) return NULL;
    uintptr_t at = ((uintptr_t)raw + sizeof(void *) + align - 1) & ~(uintptr_t)(align - 1);
    ((void **)at)[-1] = raw;
    return (void *)at;
}

static void tss__libc_free(void *ptr, size_t bytes, void *ctx) {
    (void)bytes, (void)ctx;
    if (ptr) free(((void **)ptr)[-1]);
}

tss_host tss_host_default(void) {
    tss_host h;
    memset(&h, 0, sizeof h);
    h.alloc = tss__libc_alloc;
    h.free = tss__libc_free;
    return h;
}

void *tss_alloc(const tss_host *host, size_t bytes) {
    if (!bytes) return NULL;
    return host->alloc ? host->alloc(bytes, 64, host->memory_ctx)
                       : tss__libc_alloc(bytes, 64, NULL);
}

void tss_free(const tss_host *host, void *ptr, size_t bytes) {
    if (!ptr) return;
    if (host->alloc) {
        if (host->free) host->free(ptr, bytes, host->memory_ctx);
    } else {
        tss__libc_free(ptr, bytes, NULL);
    }
}

int tss_workers(const tss_host *host) {
    if (host->parallel_for) return host->workers > 0 ? host->workers : 1;
#ifdef TSS__OPENMP
    return host->workers > 0 ? host->workers : omp_get_max_threads();
#else
    return 1;
#endif
}

void tss_parallel(const tss_host *host, int blocks, tss_task *task, void *arg) {
    if (host->parallel_for && blocks > 1) {
        host->parallel_for(blocks, task, arg, host->parallel_ctx);
        return;
    }
#ifdef TSS__OPENMP
    if (blocks > 1 && tss_workers(host) > 1) {
#pragma omp parallel for schedule(dynamic, 1) num_threads(tss_workers(host))
        for (int b = 0; b < blocks; b++) task(b, omp_get_thread_num(), arg);
        return;
    }
#endif
    for (int b = 0; b < blocks; b++) task(b, 0, arg);
}

// tss_parallel for blocks of equal work that pass after pass touch the same memory: a thread takes the
// same blocks every time, so that they stay in its cache.
static void tss__parallel_even(const tss_host *host, int blocks, tss_task *task, void *arg) {
#ifdef TSS__OPENMP
    if (!host->parallel_for && blocks > 1 && tss_workers(host) > 1) {
#pragma omp parallel for schedule(static) num_threads(tss_workers(host))
        for (int b = 0; b < blocks; b++) task(b, omp_get_thread_num(), arg);
        return;
    }
#endif
    tss_parallel(host, blocks, task, arg);
}

void tss_log(const tss_host *host, tss_log_level level, const char *format, ...) {
    if (!host->log) return;
    char line[1024];
    va_list args;
    va_start(args, format);
    vsnprintf(line, sizeof line, format, args);
    va_end(args);
    host->log(level, line, host->log_ctx);
}


// ---------------------------------------------------------------------------------------------
// >>lanes (private)
// Eight cells at a time, structure of arrays: every loop over lanes is a straight line of
// arithmetic without branches or library calls, so any compiler turns it into vector code of
// whatever width there is, with the same bits as scalar code (no contraction, no libm: sqrt and
// log below are our own). What one lane computes never depends on the other lanes.
// ---------------------------------------------------------------------------------------------

#define TSS_LANES 8
typedef double tss__lanes[TSS_LANES];  // inputs are not const: C11 cannot add const to arrays

// These loops pay at -O2 as well: the compilers are asked for their vectoriser, and not to unroll
// them before it has run.
// clang-format off
#if defined(__clang__)
#define TSS__EACH_LANE(l) \
    _Pragma("clang loop vectorize(assume_safety) interleave(disable)")                             \
    for (int l = 0; l < TSS_LANES; l++)
#elif defined(__GNUC__)
#define TSS__EACH_LANE(l) _Pragma("GCC unroll 1") for (int l = 0; l < TSS_LANES; l++)
#else
#define TSS__EACH_LANE(l) for (int l = 0; l < TSS_LANES; l++)
#endif
// clang-format on
#if defined(__clang__)
#pragma clang diagnostic push
#pragma clang diagnostic ignored "-Wpass-failed"  // below -O2 there is no vectoriser to obey
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("O3", "fp-contract=off")
#endif
#if defined(__GNUC__) || defined(__clang__)
#define TSS__INLINE static inline __attribute__((always_inline))
#define TSS__STAGE static __attribute__((noinline))  // long stages once each: they compile faster
#define TSS__RESTRICT __restrict__
#elif defined(_MSC_VER)
#define TSS__INLINE static __forceinline
#define TSS__STAGE static
#define TSS__RESTRICT __restrict
#else
#define TSS__INLINE static inline
#define TSS__STAGE static
#define TSS__RESTRICT
#endif
#ifdef __cplusplus
#define TSS__ALIGN alignas(64)
#else
#define TSS__ALIGN _Alignas(64)
#endif

TSS__INLINE uint64_t tss__bits(double x) {
    uint64_t i;
    memcpy(&i, &x, sizeof i);
    return i;
}

TSS__INLINE double tss__from_bits(uint64_t i) {
    double x;
    memcpy(&x, &i, sizeof x);
    return x;
}

// 1/√x by a first guess from the exponent (error 3.5 %) and Newton steps that square the error:
// three leave 3e-11, four leave rounding. A large finite number at x = 0, so that x·rsqrt(x) = 0.
TSS__INLINE double tss__rsqrt3(double x) {
    double y = tss__from_bits(0x5FE6EB50C7B537A9u - (tss__bits(x) >> 1)), h = 0.5 * x;
    y = y * (1.5 - (h * y) * y);
    y = y * (1.5 - (h * y) * y);
    return y * (1.5 - (h * y) * y);
}

TSS__INLINE double tss__rsqrt(double x) {
    double y = tss__rsqrt3(x);
    return y * (1.5 - ((0.5 * x) * y) * y);
}

// With 1 + f in [√½, √2]: f − log(1 + f), by the classic minimax series of FDLIBM (error below
// 2^-58) in s = f/(2 + f): log(1 + f) = f − (f²/2 − s (f²/2 + R(s²))). No cancellation: the result
// is of the order of f².
TSS__INLINE double tss__log_tail(double f) {
    double s = f / (2.0 + f), z = s * s, half = 0.5 * f * f;
    double r = 1.531383769920937332e-01 + z * 1.479819860511658591e-01;
    r = 2.222219843214978396e-01 + z * (1.818357216161805012e-01 + z * r);
    r = 3.999999999940941908e-01 + z * (2.857142874366239149e-01 + z * r);
    r = z * (6.666666666666735130e-01 + z * r);
    return half - s * (half + r);
}

TSS__INLINE double tss__abs(double x) { return x < 0 ? -x : x; }

// x = 2^k (1 + f), x > 0 and normal, 1 + f in [√½, √2).
TSS__INLINE void tss__split(double x, double *k, double *f) {
    const uint64_t root_half = 0x3FE6A09E667F3BCDu, one = 0x3FF0000000000000u;
    uint64_t i = tss__bits(x) + (one - root_half);
    *f = tss__from_bits((i & 0x000FFFFFFFFFFFFFu) + root_half) - 1.0;
    *k = tss__from_bits((i >> 52) | 0x4330000000000000u) - (4503599627370496.0 + 1023.0);
}

// k ln 2 + log(1 + f); ln 2 in two parts, the first with trailing zeros, so that k·hi is exact.
TSS__INLINE double tss__log_join(double k, double f, double tail) {
    const double hi = 6.93147180369123816490e-01, lo = 1.90821492927058770002e-10;
    return k * hi - ((tail - k * lo) - f);
}

// log x for normal x > 0, error below 1 ulp.
TSS__INLINE double tss__log(double x) {
    double k, f;
    tss__split(x, &k, &f);
    return tss__log_join(k, f, tss__log_tail(f));
}

// log(1 + x) for x > −1; *tail = x − log(1 + x), to the last digits where |x| is small.
TSS__INLINE double tss__log1p(double x, double *tail) {
    double u = 1.0 + x, k, f;
    tss__split(u, &k, &f);
    // Near 0 take x itself; elsewhere make up for what rounding 1 + x lost, to first order.
    int near = k == 0.0;
    double lost = u > 2.0 ? 1.0 - (u - x) : x - (u - 1.0);
    f = near ? x : f;
    double t = tss__log_tail(f), c = near ? 0.0 : lost / u;
    double y = tss__log_join(k, f, t - c);
    *tail = near ? t : x - y;
    return y;
}

// The entries of d × d lanes: product of a matrix and a symmetric one (xx yy zz yz xz xy, or
// xx yy xy).
TSS__INLINE void tss__mul_sym(int d, tss__lanes *TSS__RESTRICT A, tss__lanes *TSS__RESTRICT S,
                              tss__lanes *TSS__RESTRICT P) {
    for (int r = 0; r < d; r++) {
        tss__lanes *a = A + r * d;
        tss__lanes *p = P + r * d;
        if (d == 2) {
            TSS__EACH_LANE (l) {
                double a0 = a[0][l], a1 = a[1][l];
                p[0][l] = a0 * S[0][l] + a1 * S[2][l];
                p[1][l] = a0 * S[2][l] + a1 * S[1][l];
            }
        } else {
            TSS__EACH_LANE (l) {
                double a0 = a[0][l], a1 = a[1][l], a2 = a[2][l];
                double yz = S[3][l], xz = S[4][l], xy = S[5][l];
                p[0][l] = a0 * S[0][l] + a1 * xy + a2 * xz;
                p[1][l] = a0 * xy + a1 * S[1][l] + a2 * yz;
                p[2][l] = a0 * xz + a1 * yz + a2 * S[2][l];
            }
        }
    }
}

// C = A B, or A Bᵀ; rows of C are n apart.
TSS__INLINE void tss__mul_rows(int d, int n, tss__lanes *TSS__RESTRICT A,
                               tss__lanes *TSS__RESTRICT B, int transposed,
                               tss__lanes *TSS__RESTRICT C) {
    const int s = transposed ? 1 : d, c = transposed ? d : 1;
    for (int r = 0; r < d; r++) {
        tss__lanes *a = A + r * d;
        tss__lanes *o = C + r * n;
        if (d == 2) {
            TSS__EACH_LANE (l) {
                double a0 = a[0][l], a1 = a[1][l];
                o[0][l] = a0 * B[0][l] + a1 * B[s][l];
                o[1][l] = a0 * B[c][l] + a1 * B[c + s][l];
            }
        } else {
            TSS__EACH_LANE (l) {
                double a0 = a[0][l], a1 = a[1][l], a2 = a[2][l];
                o[0][l] = a0 * B[0][l] + a1 * B[s][l] + a2 * B[2 * s][l];
                o[1][l] = a0 * B[c][l] + a1 * B[c + s][l] + a2 * B[c + 2 * s][l];
                o[2][l] = a0 * B[2 * c][l] + a1 * B[2 * c + s][l] + a2 * B[2 * c + 2 * s][l];
            }
        }
    }
}

TSS__INLINE void tss__mul(int d, tss__lanes *TSS__RESTRICT A, tss__lanes *TSS__RESTRICT B,
                          int transposed, tss__lanes *TSS__RESTRICT C) {
    tss__mul_rows(d, d, A, B, transposed, C);
}

// Cofactors ∂J/∂F and J.
TSS__INLINE void tss__cofactor(int d, tss__lanes *TSS__RESTRICT F, tss__lanes *TSS__RESTRICT C,
                               double *TSS__RESTRICT J) {
    if (d == 2) {
        TSS__EACH_LANE (l) {
            double a = F[0][l], b = F[1][l], c = F[2][l], e = F[3][l];
            C[0][l] = e, C[1][l] = -c, C[2][l] = -b, C[3][l] = a;
            J[l] = a * e - b * c;
        }
        return;
    }
    TSS__EACH_LANE (l) {
        double a = F[0][l], b = F[1][l], c = F[2][l];
        double p = F[3][l], q = F[4][l], r = F[5][l];
        double u = F[6][l], v = F[7][l], w = F[8][l];
        double c0 = q * w - r * v, c1 = r * u - p * w, c2 = p * v - q * u;
        C[0][l] = c0, C[1][l] = c1, C[2][l] = c2;
        C[3][l] = c * v - b * w, C[4][l] = a * w - c * u, C[5][l] = b * u - a * v;
        C[6][l] = b * r - c * q, C[7][l] = c * p - a * r, C[8][l] = a * q - b * p;
        J[l] = a * c0 + b * c1 + c * c2;
    }
}

// ---------------------------------------------------------------------------------------------
// >>materials (private)
// psi and P = ∂psi/∂F of eight cells. Strain is delta = FᵀF − I, built from G = F − I as
// G + Gᵀ + GᵀG, with invariants tr, II, III: det(I + delta) = J² = 1 + e, e = tr + II + III.
// Densities are written in it, so that at small strain their rounding is that of mu |delta| and
// not that of mu (a stiff body's energy would drown in it):
//   Neo-Hookean     mu/2 (tr − log1p e) + lambda/8 log1p² e,
//                   tr − log1p e = (e − log1p e) − II − III,  P = F⁻ᵀ (mu delta + lambda ln J I)
//   stable NH       m/2 (q − log1p q) + 3m/8 (j² − II − III) + l/2 j²,  q = tr/4, j = J − 1
//                   P = m (3 + tr)/(4 + tr) F + (l j − 3m/4) cof F
//   StVK            mu/4 delta:delta + lambda/8 tr²,  P = F (mu delta + lambda/2 tr I)
//   fixed corot.    mu Σ (sigma − 1)² + lambda/2 j²,  P = 2 mu (F − UVᵀ) + lambda j cof F
// At strains above ‖delta‖ = 1/8 the plain forms with J = det F are the accurate ones.
// ---------------------------------------------------------------------------------------------

tss_material tss_material_default(void) {
    tss_material m;
    memset(&m, 0, sizeof m);
    m.kind = TSS_NEO_HOOKEAN;
    m.E = 1e5, m.nu = 0.4, m.rho = 1000;
    return m;
}

void tss_lame(double E, double nu, double *mu, double *lambda) {
    if (mu) *mu = E / (2 * (1 + nu));
    if (lambda) *lambda = E * nu / ((1 + nu) * (1 - 2 * nu));
}

typedef struct tss__strain {
    tss__lanes delta[6];          // FᵀF − I: xx yy zz yz xz xy, or xx yy xy
    tss__lanes tr, rest, delta2;  // trace; II + III; delta:delta
} tss__strain;

TSS__INLINE void tss__strain_of(int d, tss__lanes *TSS__RESTRICT F, tss__strain *TSS__RESTRICT s) {
    if (d == 2) {
        TSS__EACH_LANE (l) {
            double a = F[0][l] - 1, b = F[1][l], c = F[2][l], e = F[3][l] - 1;
            double xx = 2 * a + (a * a + c * c), yy = 2 * e + (b * b + e * e);
            double xy = (b + c) + (a * b + c * e);
            s->delta[0][l] = xx, s->delta[1][l] = yy, s->delta[2][l] = xy;
            s->tr[l] = xx + yy, s->rest[l] = xx * yy - xy * xy;
            s->delta2[l] = xx * xx + yy * yy + 2 * (xy * xy);
        }
        return;
    }
    TSS__EACH_LANE (l) {
        double a = F[0][l] - 1, b = F[1][l], c = F[2][l];
        double p = F[3][l], q = F[4][l] - 1, r = F[5][l];
        double u = F[6][l], v = F[7][l], w = F[8][l] - 1;
        double xx = 2 * a + (a * a + p * p + u * u), yy = 2 * q + (b * b + q * q + v * v);
        double zz = 2 * w + (c * c + r * r + w * w), yz = (r + v) + (b * c + q * r + v * w);
        double xz = (c + u) + (a * c + p * r + u * w), xy = (b + p) + (a * b + p * q + u * v);
        double mx = yy * zz - yz * yz, my = xz * yz - xy * zz, mz = xy * yz - xz * yy;
        s->delta[0][l] = xx, s->delta[1][l] = yy, s->delta[2][l] = zz;
        s->delta[3][l] = yz, s->delta[4][l] = xz, s->delta[5][l] = xy;
        s->tr[l] = xx + yy + zz;
        s->rest[l] = mx + (xx * zz - xz * xz) + (xx * yy - xy * xy) + (xx * mx + xy * my + xz * mz);
        s->delta2[l] = xx * xx + yy * yy + zz * zz + 2 * (yz * yz + xz * xz + xy * xy);
    }
}

#define TSS__SMALL_STRAIN (1.0 / 64)  // ‖delta‖² up to which −0.24 < e < 0.24: log1p needs no split

// 2 ln J and tr − 2 ln J. J <= 0 gives a meaningless finite number.
TSS__INLINE double tss__log_J2(double tr, double rest, double delta2, double J, double *gap) {
    double k, f, e = tr + rest;
    int small = delta2 <= TSS__SMALL_STRAIN;
    tss__split(J, &k, &f);
    k = small ? 0.0 : k;
    f = small ? e : f;
    double tail = tss__log_tail(f), y = tss__log_join(k, f, tail);
    y = small ? y : 2 * y;
    *gap = small ? tail - rest : tr - y;
    return y;
}

// J − 1 and tr − 2 (J − 1).
TSS__INLINE double tss__J_minus_1(double tr, double rest, double delta2, double J, double *gap) {
    int small = delta2 <= TSS__SMALL_STRAIN;
    // Where F is a reflection times a small strain J is about −1, and e says nothing about J − 1.
    small = small & (J > 0);
    double j = small ? (tr + rest) / (1 + J) : J - 1;
    *gap = small ? j * j - rest : tr - 2 * j;
    return j;
}

TSS__INLINE void tss__psi_neo_hookean(const tss__strain *TSS__RESTRICT s, const double *J,
                                      const double *mu, const double *lambda,
                                      double *TSS__RESTRICT psi) {
    TSS__EACH_LANE (l) {
        double gap, y = tss__log_J2(s->tr[l], s->rest[l], s->delta2[l], J[l], &gap);
        double v = 0.5 * mu[l] * gap + 0.125 * lambda[l] * (y * y);
        psi[l] = J[l] > 0 ? v : HUGE_VAL;
    }
}

TSS__INLINE void tss__psi_stable(const tss__strain *TSS__RESTRICT s, const double *J,
                                 const double *mu, const double *lambda,
                                 double *TSS__RESTRICT psi) {
    TSS__EACH_LANE (l) {
        double gap, tail, j = tss__J_minus_1(s->tr[l], s->rest[l], s->delta2[l], J[l], &gap);
        tss__log1p(0.25 * s->tr[l], &tail);
        psi[l] = mu[l] * (0.5 * tail + 0.375 * gap) + 0.5 * lambda[l] * (j * j);
    }
}

TSS__INLINE void tss__psi_stvk(const tss__strain *TSS__RESTRICT s, const double *mu,
                               const double *lambda, double *TSS__RESTRICT psi) {
    TSS__EACH_LANE (l)
        psi[l] = 0.25 * mu[l] * s->delta2[l] + 0.125 * lambda[l] * (s->tr[l] * s->tr[l]);
}

// 2 mu e + lambda tr(e) I, e the symmetric part of F − I.
TSS__INLINE void tss__P_linear(int d, tss__lanes *TSS__RESTRICT F, const double *mu,
                               const double *lambda, tss__lanes *TSS__RESTRICT P) {
    tss__lanes t;
    TSS__EACH_LANE (l) t[l] = (F[0][l] - 1) + (F[d + 1][l] - 1);
    if (d == 3)
        TSS__EACH_LANE (l) t[l] += F[8][l] - 1;
    for (int r = 0; r < d; r++)
        for (int m = 0; m < d; m++) {
            const double *a = F[r * d + m], *b = F[m * d + r];
            double *p = P[r * d + m];
            if (r == m)
                TSS__EACH_LANE (l) p[l] = 2 * mu[l] * (a[l] - 1) + lambda[l] * t[l];
            else
                TSS__EACH_LANE (l) p[l] = mu[l] * (a[l] + b[l]);
        }
}

// psi = ½ P : (F − I), being quadratic.
TSS__INLINE void tss__psi_linear(int d, tss__lanes *F, const double *mu, const double *lambda,
                                 double *TSS__RESTRICT psi) {
    TSS__ALIGN tss__lanes P[9];
    tss__P_linear(d, F, mu, lambda, P);
    TSS__EACH_LANE (l) psi[l] = 0;
    for (int i = 0; i < d * d; i++) {
        const double id = i % (d + 1) ? 0.0 : 1.0;
        TSS__EACH_LANE (l) psi[l] += 0.5 * P[i][l] * (F[i][l] - id);
    }
}

// (mu delta + lambda ln J I)/J and mu delta + lambda/2 tr I: the symmetric factors of P.
TSS__INLINE void tss__S_neo_hookean(int d, const tss__strain *TSS__RESTRICT s, const double *J,
                                    const double *mu, const double *lambda,
                                    tss__lanes *TSS__RESTRICT S) {
    tss__lanes m, y;
    TSS__EACH_LANE (l) {
        double gap, v = 1.0 / J[l];
        y[l] = 0.5 * lambda[l] * v * tss__log_J2(s->tr[l], s->rest[l], s->delta2[l], J[l], &gap);
        m[l] = mu[l] * v;
    }
    for (int i = 0; i < d; i++)
        TSS__EACH_LANE (l) S[i][l] = m[l] * s->delta[i][l] + y[l];
    for (int i = d; i < 3 * (d - 1); i++)
        TSS__EACH_LANE (l) S[i][l] = m[l] * s->delta[i][l];
}

TSS__INLINE void tss__S_stvk(int d, const tss__strain *TSS__RESTRICT s, const double *mu,
                             const double *lambda, tss__lanes *TSS__RESTRICT S) {
    for (int i = 0; i < d; i++)
        TSS__EACH_LANE (l) S[i][l] = mu[l] * s->delta[i][l] + 0.5 * lambda[l] * s->tr[l];
    for (int i = d; i < 3 * (d - 1); i++)
        TSS__EACH_LANE (l) S[i][l] = mu[l] * s->delta[i][l];
}

TSS__INLINE void tss__P_stable(int d, tss__lanes *TSS__RESTRICT F, tss__lanes *TSS__RESTRICT C,
                               const tss__strain *s, const double *J, const double *mu,
                               const double *lambda, tss__lanes *TSS__RESTRICT P) {
    tss__lanes a, b;
    TSS__EACH_LANE (l) {
        double gap, j = tss__J_minus_1(s->tr[l], s->rest[l], s->delta2[l], J[l], &gap);
        a[l] = mu[l] * (3 + s->tr[l]) / (4 + s->tr[l]);
        b[l] = lambda[l] * j - 0.75 * mu[l];
    }
    for (int i = 0; i < d * d; i++)
        TSS__EACH_LANE (l) P[i][l] = a[l] * F[i][l] + b[l] * C[i][l];
}

// ---------------------------------------------------------------------------------------------
// >>svd (private)
// F = U Σ Vᵀ of eight 3 × 3 (2 × 2) matrices, U and V rotations (det +1), |sigma_1| >= |sigma_2| >=
// |sigma_3|, only the last may be negative. One-sided Jacobi: columns of A = FV are made orthogonal
// by plane rotations of F itself, so small singular values have error eps·‖F‖, not √eps·‖F‖ as from
// FᵀF. A lane that has converged is left alone, bit for bit, in the sweeps that others still need.
// 4 to 5 sweeps.
// ---------------------------------------------------------------------------------------------

#define TSS__JACOBI_COS2 1e-30  // (cosine 1e-15)²: a few roundings of a dot product
#define TSS__JACOBI_LAST 1e-14  // (cosine 1e-7)² and (angle 1e-8)² of a sweep that needs no other:
#define TSS__JACOBI_ANGLE2 1e-16  // what it leaves is their product
#define TSS__JACOBI_SWEEPS 10     // never seen above 6

#define TSS__SVD_TILES 4

// Columns of some tiles turned by Jacobi rotations. A rotation is a long chain of dependent
// operations, so each phase of it is done for all tiles: several chains run side by side.
typedef struct tss__jacobi {
    TSS__ALIGN tss__lanes A[TSS__SVD_TILES][9];
    TSS__ALIGN tss__lanes V[TSS__SVD_TILES][9];
    TSS__ALIGN tss__lanes active[TSS__SVD_TILES], again[TSS__SVD_TILES];  // 1 or 0
    TSS__ALIGN tss__lanes ab[TSS__SVD_TILES], g[TSS__SVD_TILES], h[TSS__SVD_TILES];
    TSS__ALIGN tss__lanes c[TSS__SVD_TILES], s[TSS__SVD_TILES];
} tss__jacobi;

// With squared lengths a, b of the columns and their product g: h = b − a, and
// tan = 2g/(h ± √(h² + 4g²)) of the smaller angle that makes them orthogonal, into s.
TSS__INLINE void tss__jacobi_tan(int d, int tiles, int p, int q, tss__jacobi *j) {
    for (int i = 0; i < tiles; i++) {
        tss__lanes *A = j->A[i];
        TSS__EACH_LANE (l) {
            double x = A[p][l], y = A[q][l], u = A[d + p][l], v = A[d + q][l];
            double a = x * x + u * u, b = y * y + v * v, g = x * y + u * v;
            if (d == 3) {
                x = A[6 + p][l], y = A[6 + q][l];
                a += x * x, b += y * y, g += x * y;
            }
            j->ab[i][l] = a * b, j->g[i][l] = g, j->h[i][l] = b - a;
        }
    }
    for (int i = 0; i < tiles; i++)
        TSS__EACH_LANE (l) {
            double h = j->h[i][l], g2 = 2 * j->g[i][l], n = h * h + g2 * g2;
            j->s[i][l] = n * tss__rsqrt3(n);
        }
    for (int i = 0; i < tiles; i++)
        TSS__EACH_LANE (l) {
            // 1e-300 keeps 0/0 away.
            double h = j->h[i][l], t = 2 * j->g[i][l] / (tss__abs(h) + j->s[i][l] + 1e-300);
            j->s[i][l] = h < 0 ? -t : t;
        }
}

// One rotation of columns p and q in the active lanes; marks those that need another sweep.
TSS__INLINE void tss__jacobi_turn(int d, int tiles, int p, int q, tss__jacobi *j) {
    tss__jacobi_tan(d, tiles, p, q, j);
    for (int i = 0; i < tiles; i++)
        TSS__EACH_LANE (l) {
            double t = j->s[i][l], n = 1 + t * t;
            j->c[i][l] = tss__rsqrt(n);
        }
    for (int i = 0; i < tiles; i++)
        TSS__EACH_LANE (l) {
            double t = j->s[i][l], cc = j->c[i][l], gg = j->g[i][l] * j->g[i][l], ab = j->ab[i][l];
            double turn = gg > TSS__JACOBI_COS2 * ab ? j->active[i][l] : 0.0;
            double steep = t * t > TSS__JACOBI_ANGLE2 ? turn : 0.0;
            double wide = gg > TSS__JACOBI_LAST * ab ? turn : 0.0, more = j->again[i][l];
            more = more > steep ? more : steep;
            j->again[i][l] = more > wide ? more : wide;
            j->c[i][l] = turn > 0 ? cc : 1.0;
            j->s[i][l] = turn > 0 ? cc * t : 0.0;
        }
    for (int r = 0; r < d; r++)
        for (int i = 0; i < tiles; i++) {
            double *ap = j->A[i][r * d + p], *aq = j->A[i][r * d + q];
            double *vp = j->V[i][r * d + p], *vq = j->V[i][r * d + q];
            const double *cc = j->c[i], *ss = j->s[i];
            TSS__EACH_LANE (l) {
                double x = ap[l], y = aq[l], z = vp[l], w = vq[l], c = cc[l], s = ss[l];
                ap[l] = c * x - s * y, aq[l] = s * x + c * y;
                vp[l] = c * z - s * w, vq[l] = s * z + c * w;
            }
        }
}

static int tss__any(const double *flag) {
    double sum = 0;
    for (int l = 0; l < TSS_LANES; l++) sum += flag[l];
    return sum > 0;
}

TSS__INLINE void tss__identity(int d, tss__lanes *V) {
    for (int i = 0; i < d * d; i++) {
        const double v = i % (d + 1) ? 0.0 : 1.0;
        TSS__EACH_LANE (l) V[i][l] = v;
    }
}

// The longer column first; the other changes its sign, so that V stays a rotation.
TSS__INLINE void tss__order_columns(int d, int p, int q, tss__lanes *TSS__RESTRICT A,
                                    tss__lanes *TSS__RESTRICT V) {
    tss__lanes swap;
    TSS__EACH_LANE (l) {
        double a = A[p][l] * A[p][l] + A[d + p][l] * A[d + p][l];
        double b = A[q][l] * A[q][l] + A[d + q][l] * A[d + q][l];
        if (d == 3) a += A[6 + p][l] * A[6 + p][l], b += A[6 + q][l] * A[6 + q][l];
        swap[l] = a < b ? 1.0 : 0.0;
    }
    for (int r = 0; r < d; r++) {
        double *ap = A[r * d + p], *aq = A[r * d + q], *vp = V[r * d + p], *vq = V[r * d + q];
        TSS__EACH_LANE (l) {
            double x = ap[l], y = aq[l], z = vp[l], w = vq[l];
            int turn = swap[l] > 0;
            ap[l] = turn ? y : x, aq[l] = turn ? -x : y;
            vp[l] = turn ? w : z, vq[l] = turn ? -z : w;
        }
    }
}

// U of the ordered orthogonal columns; a direction without length gets any perpendicular one
// (Duff et al. 2017). The last column is the cross product: det U = +1, sigma takes the sign.
TSS__INLINE void tss__svd_left3(tss__lanes *TSS__RESTRICT A, tss__lanes *TSS__RESTRICT U,
                                tss__lanes *TSS__RESTRICT sigma) {
    TSS__EACH_LANE (l) {
        double ax = A[0][l], ay = A[3][l], az = A[6][l];
        double bx = A[1][l], by = A[4][l], bz = A[7][l];
        double n = ax * ax + ay * ay + az * az, i = tss__rsqrt(n);
        int ok = n > 1e-290;
        double x = ok ? ax * i : 1.0, y = ok ? ay * i : 0.0, z = ok ? az * i : 0.0;
        double t = x * bx + y * by + z * bz;
        double px = bx - t * x, py = by - t * y, pz = bz - t * z;
        double m = px * px + py * py + pz * pz, k = tss__rsqrt(m);
        double g = z < 0 ? -1.0 : 1.0, q = -1 / (g + z), h = x * y * q;
        int two = m > 1e-290;
        px = two ? px * k : 1 + g * x * x * q;
        py = two ? py * k : g * h;
        pz = two ? pz * k : -g * x;
        double rx = y * pz - z * py, ry = z * px - x * pz, rz = x * py - y * px;
        U[0][l] = x, U[3][l] = y, U[6][l] = z;
        U[1][l] = px, U[4][l] = py, U[7][l] = pz;
        U[2][l] = rx, U[5][l] = ry, U[8][l] = rz;
        sigma[0][l] = x * ax + y * ay + z * az;
        sigma[1][l] = px * bx + py * by + pz * bz;
        sigma[2][l] = rx * A[2][l] + ry * A[5][l] + rz * A[8][l];
    }
}

TSS__INLINE void tss__svd_left2(tss__lanes *TSS__RESTRICT A, tss__lanes *TSS__RESTRICT U,
                                tss__lanes *TSS__RESTRICT sigma) {
    TSS__EACH_LANE (l) {
        double ax = A[0][l], ay = A[2][l], n = ax * ax + ay * ay, i = tss__rsqrt(n);
        int ok = n > 1e-290;
        double x = ok ? ax * i : 1.0, y = ok ? ay * i : 0.0;
        U[0][l] = x, U[2][l] = y, U[1][l] = -y, U[3][l] = x;
        sigma[0][l] = x * ax + y * ay;
        sigma[1][l] = x * A[3][l] - y * A[1][l];
        sigma[2][l] = 1;
    }
}

typedef struct tss__svd_parts {
    tss__lanes U[9], V[9], sigma[3];
} tss__svd_parts;

// Sweeps until every lane has converged.
TSS__INLINE void tss__jacobi_sweeps(int d, int tiles, tss__jacobi *j) {
    for (int i = 0; i < tiles; i++)
        TSS__EACH_LANE (l) j->active[i][l] = 1;
    for (int k = 0; k < TSS__JACOBI_SWEEPS; k++) {
        int left = 0;
        for (int i = 0; i < tiles; i++)
            TSS__EACH_LANE (l) j->again[i][l] = 0;
        tss__jacobi_turn(d, tiles, 0, 1, j);
        if (d == 3) tss__jacobi_turn(d, tiles, 0, 2, j);
        if (d == 3) tss__jacobi_turn(d, tiles, 1, 2, j);
        for (int i = 0; i < tiles; i++) left |= tss__any(j->again[i]);
        if (!left) break;
        memcpy(j->active, j->again, sizeof j->active);
    }
}

TSS__STAGE void tss__jacobi_run(int d, int tiles, tss__jacobi *j) {
    if (TSS__DIM(d) == 2)
        tss__jacobi_sweeps(2, tiles, j);
    else if (tiles == TSS__SVD_TILES)
        tss__jacobi_sweeps(3, TSS__SVD_TILES, j);
    else
        tss__jacobi_sweeps(3, tiles, j);
}

TSS__INLINE void tss__svd_finish(int d, tss__lanes *A, tss__svd_parts *o) {
    tss__order_columns(d, 0, 1, A, o->V);
    if (d == 3) tss__order_columns(d, 0, 2, A, o->V);
    if (d == 3) tss__order_columns(d, 1, 2, A, o->V);
    if (d == 3)
        tss__svd_left3(A, o->U, o->sigma);
    else
        tss__svd_left2(A, o->U, o->sigma);
}

// Of 1..TSS__SVD_TILES tiles. sigma[2] = 1 in 2D: the stretch out of the plane.
TSS__STAGE void tss__svd(int d, int tiles, tss__lanes *const *F, tss__svd_parts *const *o) {
    tss__jacobi j;
    for (int i = 0; i < tiles; i++) {
        memcpy(j.A[i], F[i], (size_t)(d * d) * sizeof(tss__lanes));
        tss__identity(d, j.V[i]);
    }
    tss__jacobi_run(d, tiles, &j);
    for (int i = 0; i < tiles; i++) {
        memcpy(o[i]->V, j.V[i], (size_t)(d * d) * sizeof(tss__lanes));
        if (TSS__DIM(d) == 3)
            tss__svd_finish(3, j.A[i], o[i]);
        else
            tss__svd_finish(2, j.A[i], o[i]);
    }
}

TSS__INLINE void tss__svd_one(int d, tss__lanes *F, tss__svd_parts *o) {
    tss__lanes *f[1] = {F};
    tss__svd_parts *p[1] = {o};
    tss__svd(d, 1, f, p);
}

TSS__INLINE void tss__psi_corotated(tss__lanes *TSS__RESTRICT sigma, const double *J,
                                    const double *mu, const double *lambda,
                                    double *TSS__RESTRICT psi) {
    TSS__EACH_LANE (l) {
        double a = sigma[0][l] - 1, b = sigma[1][l] - 1, c = sigma[2][l] - 1, j = J[l] - 1;
        psi[l] = mu[l] * (a * a + b * b + c * c) + 0.5 * lambda[l] * (j * j);
    }
}

TSS__INLINE void tss__P_corotated(int d, tss__lanes *TSS__RESTRICT F, tss__lanes *TSS__RESTRICT C,
                                  tss__lanes *TSS__RESTRICT R, const double *J, const double *mu,
                                  const double *lambda, tss__lanes *TSS__RESTRICT P) {
    for (int i = 0; i < d * d; i++)
        TSS__EACH_LANE (l)
            P[i][l] = 2 * mu[l] * (F[i][l] - R[i][l]) + lambda[l] * (J[l] - 1) * C[i][l];
}

// ---------------------------------------------------------------------------------------------
// >>stretch_hessian (private)
// ∂²psi/∂F² of an isotropic density in the principal frame, dF = U G Vᵀ: the diagonal of G sees the
// stretch Hessian S_ab = ∂²psi/∂sigma_a∂sigma_b; each pair (G_ab, G_ba) sees a 2 × 2 block with
//     flip  = (psi_a − psi_b)/(sigma_a − sigma_b)   for G_ab =  G_ba,
//     twist = (psi_a + psi_b)/(sigma_a + sigma_b)   for G_ab = −G_ba,
// psi_a = ∂psi/∂sigma_a. Both quotients are divided out by hand, so equal stretches are no special
// case. The nearest PSD matrix clamps S, flip and twist at 0. Below a, b are the two stretches of
// an entry, k the third, w_a the product of all but a; c = mu − lambda ln J, j = J − 1, s = Σ
// sigma² − 3, t = l j − 3m/4, p = m (3 + s)/(4 + s), q = 2m/(4 + s)².
//                S_aa                             S_ab                     flip, twist
//   NH           mu + (c + lambda)/a²             lambda/(ab)              mu ± c/(ab)
//   stable NH    p + q a² + l w_a²                q ab + l w_a w_b + t k   p ∓ t k
//   StVK         mu (3a² − 1) + lambda (s/2 + a²) lambda ab                mu (a² ± ab + b² − 1)
//                                                                          + lambda s/2
//   fixed cor.   2mu + lambda w_a²                lambda (w_a w_b + j k)   2mu − lambda j k,
//                                                          2mu − 4mu/(a + b) + lambda j k
//   linear       2mu + lambda                     lambda                   2mu, 0  (U = V = I)
// ---------------------------------------------------------------------------------------------

typedef struct tss__stretch {
    tss__svd_parts f;
    tss__lanes S[6];      // 00 11 22 12 02 01
    tss__lanes flip[3];   // pairs 12 02 01; later (flip + twist)/2: G_ab with itself
    tss__lanes twist[3];  // later (flip − twist)/2: G_ab with G_ba
} tss__stretch;

// Index of the two stretches of a pair, and of the third.
TSS__INLINE int tss__pair_a(int k) { return k == 0 ? 1 : 0; }
TSS__INLINE int tss__pair_b(int k) { return k == 2 ? 1 : 2; }

TSS__INLINE void tss__stretch_neo_hookean(const double *J, const double *mu, const double *lambda,
                                          tss__stretch *TSS__RESTRICT h) {
    tss__lanes c;
    TSS__EACH_LANE (l) c[l] = mu[l] - lambda[l] * tss__log(J[l]);
    for (int k = 0; k < 3; k++) {
        const double *a = h->f.sigma[tss__pair_a(k)], *b = h->f.sigma[tss__pair_b(k)];
        const double *s = h->f.sigma[k];
        TSS__EACH_LANE (l) {
            double i = 1 / (a[l] * b[l]), n = 1 / (s[l] * s[l]);
            h->S[k][l] = mu[l] + (c[l] + lambda[l]) * n;
            h->S[3 + k][l] = lambda[l] * i;
            h->flip[k][l] = mu[l] + c[l] * i;
            h->twist[k][l] = mu[l] - c[l] * i;
        }
    }
}

TSS__INLINE void tss__stretch_stable(const double *J, const double *mu, const double *lambda,
                                     tss__stretch *TSS__RESTRICT h) {
    tss__lanes n, p, t;
    TSS__EACH_LANE (l) {
        double a = h->f.sigma[0][l], b = h->f.sigma[1][l], c = h->f.sigma[2][l];
        n[l] = 1 / (1 + (a * a + b * b + c * c));
        p[l] = mu[l] * (1 - n[l]);
        t[l] = lambda[l] * (J[l] - 1) - 0.75 * mu[l];
    }
    for (int k = 0; k < 3; k++) {
        const double *a = h->f.sigma[tss__pair_a(k)], *b = h->f.sigma[tss__pair_b(k)];
        const double *s = h->f.sigma[k];
        TSS__EACH_LANE (l) {
            double m = 2 * mu[l] * (n[l] * n[l]), ab = a[l] * b[l], tk = t[l] * s[l];
            h->S[k][l] = p[l] + m * (s[l] * s[l]) + lambda[l] * (ab * ab);
            h->S[3 + k][l] = m * ab + lambda[l] * (s[l] * s[l]) * ab + tk;
            h->flip[k][l] = p[l] - tk;
            h->twist[k][l] = p[l] + tk;
        }
    }
}

TSS__INLINE void tss__stretch_stvk(const double *mu, const double *lambda,
                                   tss__stretch *TSS__RESTRICT h) {
    tss__lanes half;
    TSS__EACH_LANE (l) {
        double a = h->f.sigma[0][l], b = h->f.sigma[1][l], c = h->f.sigma[2][l];
        half[l] = 0.5 * lambda[l] * (a * a + b * b + c * c - 3);
    }
    for (int k = 0; k < 3; k++) {
        const double *a = h->f.sigma[tss__pair_a(k)], *b = h->f.sigma[tss__pair_b(k)];
        const double *s = h->f.sigma[k];
        TSS__EACH_LANE (l) {
            double q = a[l] * a[l] + b[l] * b[l] - 1, ab = a[l] * b[l], s2 = s[l] * s[l];
            h->S[k][l] = mu[l] * (3 * s2 - 1) + half[l] + lambda[l] * s2;
            h->S[3 + k][l] = lambda[l] * ab;
            h->flip[k][l] = mu[l] * (q + ab) + half[l];
            h->twist[k][l] = mu[l] * (q - ab) + half[l];
        }
    }
}

TSS__INLINE void tss__stretch_corotated(const double *J, const double *mu, const double *lambda,
                                        tss__stretch *TSS__RESTRICT h) {
    for (int k = 0; k < 3; k++) {
        const double *a = h->f.sigma[tss__pair_a(k)], *b = h->f.sigma[tss__pair_b(k)];
        const double *s = h->f.sigma[k];
        TSS__EACH_LANE (l) {
            // a + b >= 0 by the order of sigma; at 0 R is not unique and twist is −inf.
            double ab = a[l] * b[l], sum = a[l] + b[l], jk = lambda[l] * (J[l] - 1) * s[l];
            sum = sum > 1e-12 ? sum : 1e-12;
            h->S[k][l] = 2 * mu[l] + lambda[l] * (ab * ab);
            h->S[3 + k][l] = lambda[l] * (s[l] * s[l]) * ab + jk;
            h->flip[k][l] = 2 * mu[l] - jk;
            h->twist[k][l] = 2 * mu[l] - 4 * mu[l] / sum + jk;
        }
    }
}

TSS__INLINE void tss__stretch_linear(int d, const double *mu, const double *lambda,
                                     tss__stretch *TSS__RESTRICT h) {
    tss__identity(d, h->f.U);
    tss__identity(d, h->f.V);
    for (int k = 0; k < 3; k++)
        TSS__EACH_LANE (l) {
            h->S[k][l] = 2 * mu[l] + lambda[l];
            h->S[3 + k][l] = lambda[l];
            h->flip[k][l] = 2 * mu[l];
            h->twist[k][l] = 0;
        }
}

// One two-sided rotation of symmetric S (00 11 22 12 02 01) in plane (p, q), r the third index.
TSS__INLINE void tss__jacobi_sym(int p, int q, int r, tss__lanes *TSS__RESTRICT S,
                                 tss__lanes *TSS__RESTRICT Q) {
    double *pp = S[p], *qq = S[q], *pq = S[3 + r], *pr = S[3 + q], *qr = S[3 + p];
    TSS__EACH_LANE (l) {
        double h = qq[l] - pp[l], g = 2 * pq[l], n = h * h + g * g;
        double t = g / ((h < 0 ? -h : h) + n * tss__rsqrt(n) + 1e-300);
        t = h < 0 ? -t : t;
        double c = tss__rsqrt(1 + t * t), s = c * t, x = pr[l], y = qr[l], m = t * pq[l];
        pp[l] -= m, qq[l] += m, pq[l] = 0;
        pr[l] = c * x - s * y, qr[l] = s * x + c * y;
        for (int i = 0; i < 3; i++) {
            double u = Q[i * 3 + p][l], v = Q[i * 3 + q][l];
            Q[i * 3 + p][l] = c * u - s * v, Q[i * 3 + q][l] = s * u + c * v;
        }
    }
}

// Nearest PSD matrix to S in the lanes where it has a negative eigenvalue (a principal
// minor is negative). 3 × 3 Jacobi is at rounding after 5 sweeps.
TSS__STAGE void tss__clamp_stretch(tss__lanes *TSS__RESTRICT S) {
    TSS__ALIGN tss__lanes bad;
    TSS__EACH_LANE (l) {
        double a = S[0][l], b = S[1][l], c = S[2][l], x = S[3][l], y = S[4][l], z = S[5][l];
        double m0 = b * c - x * x, m1 = a * c - y * y, m2 = a * b - z * z;
        double det = a * m0 - z * (z * c - x * y) + y * (z * x - b * y);
        int ok = (a >= 0) & (b >= 0) & (c >= 0) & (m0 >= 0) & (m1 >= 0) & (m2 >= 0) & (det >= 0);
        bad[l] = ok ? 0.0 : 1.0;
    }
    if (!tss__any(bad)) return;
    TSS__ALIGN tss__lanes T[6];
    TSS__ALIGN tss__lanes Q[9];
    memcpy(T, S, sizeof T);
    tss__identity(3, Q);
    for (int k = 0; k < 6; k++) {
        tss__jacobi_sym(0, 1, 2, T, Q);
        tss__jacobi_sym(0, 2, 1, T, Q);
        tss__jacobi_sym(1, 2, 0, T, Q);
    }
    for (int k = 0; k < 3; k++)
        TSS__EACH_LANE (l) T[k][l] = T[k][l] > 0 ? T[k][l] : 0;
    for (int k = 0; k < 6; k++) {
        const int a = k < 3 ? k : tss__pair_a(k - 3), b = k < 3 ? k : tss__pair_b(k - 3);
        TSS__EACH_LANE (l) {
            double v = T[0][l] * Q[a * 3][l] * Q[b * 3][l] +
                       T[1][l] * Q[a * 3 + 1][l] * Q[b * 3 + 1][l] +
                       T[2][l] * Q[a * 3 + 2][l] * Q[b * 3 + 2][l];
            S[k][l] = bad[l] > 0 ? v : S[k][l];
        }
    }
}

// From eigenvalues to matrix entries, projected if asked for, times the cell's volume.
TSS__INLINE void tss__stretch_finish(int d, int psd, const double *vol,
                                     tss__stretch *TSS__RESTRICT h) {
    // In 2D the third stretch does not vary: give it a harmless block of its own.
    if (d == 2)
        TSS__EACH_LANE (l) h->S[2][l] = 1, h->S[3][l] = 0, h->S[4][l] = 0;
    if (psd) tss__clamp_stretch(h->S);
    for (int k = 0; k < 6; k++)
        TSS__EACH_LANE (l) h->S[k][l] *= vol[l];
    for (int k = 0; k < 3; k++)
        TSS__EACH_LANE (l) {
            double f = h->flip[k][l], t = h->twist[k][l];
            f = psd && f < 0 ? 0 : f;
            t = psd && t < 0 ? 0 : t;
            h->flip[k][l] = 0.5 * vol[l] * (f + t);
            h->twist[k][l] = 0.5 * vol[l] * (f - t);
        }
}

// ---------------------------------------------------------------------------------------------
// >>elastic (private)
// E = Σ_cells volume · psi(F) as stencils: stencil id = cell, arity d + 1. F = [x_k − x_0] Dm⁻¹,
// the rows of Dm⁻¹ are the gradients of the shape functions of nodes 1..d. Per cell d² + 1 numbers
// (and mu, lambda where they differ by cell) in blocks of eight; a range that starts at a multiple
// of 8 reads them in place, any other list of ids copies them lane by lane into the same kernels,
// so both give the same bits. A cell in 3D costs about 190 flops for a value, 320 for a gradient,
// 2,700 for a projected Hessian, of which 1,500 are the SVD. The node blocks of the Hessian are
// H_ij = U Ĥ_ij Uᵀ, Ĥ_ij built from b̂ = Vᵀ∇N:
//                  Ĥ_ij,aa = S_aa b̂_ia b̂_ja + Σ_m≠a A_am b̂_im b̂_jm,
//                  Ĥ_ij,ab = S_ab b̂_ia b̂_jb + B_ab b̂_ib b̂_ja,   A, B = (flip ± twist)/2.
// ---------------------------------------------------------------------------------------------

typedef struct tss__elastic {
    int dim, cells, blocks;  // blocks of TSS_LANES cells, the last one filled up with its last cell
    int per_cell;            // mu and lambda have one entry a cell
    tss_material material;
    int *node;                // cells × (d + 1)
    const int *label;         // the caller's cell numbers for messages, or NULL
    tss__lanes *inv;          // blocks × d²: Dm⁻¹, row k = ∇N of node k + 1
    tss__lanes *vol;          // blocks
    tss__lanes *mu, *lambda;  // blocks, or 1 when all cells share them; m and l for the stable NH
    double *limit;            // max_step, min J: results of the tasks
    int *culprit;
} tss__elastic;

// Eight cells at work. inv … lambda point into the object or to the copies.
typedef struct tss__tile {
    TSS__ALIGN tss__lanes D[9];  // D[k·d + r]: edge k of x
    TSS__ALIGN tss__lanes F[9];
    TSS__ALIGN tss__lanes copy[12];
    tss__lanes *inv;
    const double *vol, *mu, *lambda;
    int id[TSS_LANES], used;
} tss__tile;

TSS__INLINE void tss__tile_edges(int d, const int *node, const double *x, const int *id,
                                 tss__lanes *TSS__RESTRICT D) {
    for (int l = 0; l < TSS_LANES; l++) {
        const int *n = node + (size_t)id[l] * (size_t)(d + 1);
        const double *o = x + (size_t)n[0] * (size_t)d;
        for (int k = 0; k < d; k++) {
            const double *p = x + (size_t)n[k + 1] * (size_t)d;
            for (int r = 0; r < d; r++) D[k * d + r][l] = p[r] - o[r];
        }
    }
}

static void tss__tile_copy(const tss__elastic *e, tss__tile *t) {
    const int d2 = e->dim * e->dim;
    for (int l = 0; l < TSS_LANES; l++) {
        const int b = t->id[l] / TSS_LANES, at = t->id[l] % TSS_LANES;
        for (int i = 0; i < d2; i++) t->copy[i][l] = e->inv[(size_t)b * (size_t)d2 + (size_t)i][at];
        t->copy[9][l] = e->vol[b][at];
        if (e->per_cell) t->copy[10][l] = e->mu[b][at], t->copy[11][l] = e->lambda[b][at];
    }
    t->inv = t->copy, t->vol = t->copy[9];
    t->mu = e->per_cell ? t->copy[10] : *e->mu;
    t->lambda = e->per_cell ? t->copy[11] : *e->lambda;
}

// The cells at..at + 7 of the list; lanes past its end repeat the last one.
static void tss__tile_cells(const tss__elastic *e, const tss_ids *ids, int at, tss__tile *t) {
    t->used = ids->count - at < TSS_LANES ? ids->count - at : TSS_LANES;
    for (int l = 0; l < TSS_LANES; l++) {
        const int k = at + (l < t->used ? l : t->used - 1);
        t->id[l] = ids->list ? ids->list[k] : ids->first + k;
    }
    const int b = t->id[0] / TSS_LANES;
    if (ids->list || t->id[0] % TSS_LANES) {
        tss__tile_copy(e, t);
        return;
    }
    t->inv = e->inv + (size_t)b * (size_t)(e->dim * e->dim);
    t->vol = e->vol[b];
    t->mu = e->mu[e->per_cell ? b : 0], t->lambda = e->lambda[e->per_cell ? b : 0];
}

// F = D Dm⁻¹.
TSS__INLINE void tss__tile_F_in(int d, const tss__elastic *e, const double *x, tss__tile *t) {
    tss__lanes *TSS__RESTRICT D = t->D, *TSS__RESTRICT B = t->inv;
    tss__lanes *TSS__RESTRICT F = t->F;
    tss__tile_edges(d, e->node, x, t->id, t->D);
    for (int r = 0; r < d; r++) {
        if (d == 2) {
            TSS__EACH_LANE (l) {
                double a = D[r][l], b = D[2 + r][l];
                F[r * 2][l] = a * B[0][l] + b * B[2][l];
                F[r * 2 + 1][l] = a * B[1][l] + b * B[3][l];
            }
        } else {
            TSS__EACH_LANE (l) {
                double a = D[r][l], b = D[3 + r][l], c = D[6 + r][l];
                F[r * 3][l] = a * B[0][l] + b * B[3][l] + c * B[6][l];
                F[r * 3 + 1][l] = a * B[1][l] + b * B[4][l] + c * B[7][l];
                F[r * 3 + 2][l] = a * B[2][l] + b * B[5][l] + c * B[8][l];
            }
        }
    }
}

TSS__STAGE void tss__tile_F(int d, const tss__elastic *e, const double *x, tss__tile *t) {
    if (TSS__DIM(d) == 3)
        tss__tile_F_in(3, e, x, t);
    else
        tss__tile_F_in(2, e, x, t);
}

// Volume × psi of a tile, from F.
TSS__INLINE void tss__tile_psi(int d, tss_material_kind kind, tss__tile *t, double *psi) {
    TSS__ALIGN tss__lanes C[9];
    TSS__ALIGN tss__lanes J;
    TSS__ALIGN tss__strain s;
    TSS__ALIGN tss__svd_parts f;
    tss__cofactor(d, t->F, C, J);
    if (kind != TSS_LINEAR && kind != TSS_FIXED_COROTATED) tss__strain_of(d, t->F, &s);
    if (kind == TSS_NEO_HOOKEAN) tss__psi_neo_hookean(&s, J, t->mu, t->lambda, psi);
    if (kind == TSS_STABLE_NEO_HOOKEAN) tss__psi_stable(&s, J, t->mu, t->lambda, psi);
    if (kind == TSS_STVK) tss__psi_stvk(&s, t->mu, t->lambda, psi);
    if (kind == TSS_LINEAR) tss__psi_linear(d, t->F, t->mu, t->lambda, psi);
    if (kind == TSS_FIXED_COROTATED) {
        tss__svd_one(d, t->F, &f);
        tss__psi_corotated(f.sigma, J, t->mu, t->lambda, psi);
    }
    TSS__EACH_LANE (l) psi[l] *= t->vol[l];
}

TSS__INLINE void tss__tile_P(int d, tss_material_kind kind, tss__tile *t, tss__lanes *P) {
    TSS__ALIGN tss__lanes C[9];
    TSS__ALIGN tss__lanes S[6];
    TSS__ALIGN tss__lanes J;
    TSS__ALIGN tss__strain s;
    TSS__ALIGN tss__svd_parts f;
    tss__cofactor(d, t->F, C, J);
    if (kind != TSS_LINEAR && kind != TSS_FIXED_COROTATED) tss__strain_of(d, t->F, &s);
    if (kind == TSS_NEO_HOOKEAN) {
        tss__S_neo_hookean(d, &s, J, t->mu, t->lambda, S);
        tss__mul_sym(d, C, S, P);
    }
    if (kind == TSS_STVK) {
        tss__S_stvk(d, &s, t->mu, t->lambda, S);
        tss__mul_sym(d, t->F, S, P);
    }
    if (kind == TSS_STABLE_NEO_HOOKEAN) tss__P_stable(d, t->F, C, &s, J, t->mu, t->lambda, P);
    if (kind == TSS_LINEAR) tss__P_linear(d, t->F, t->mu, t->lambda, P);
    if (kind == TSS_FIXED_COROTATED) {
        TSS__ALIGN tss__lanes R[9];
        tss__svd_one(d, t->F, &f);
        tss__mul(d, f.U, f.V, 1, R);
        tss__P_corotated(d, t->F, C, R, J, t->mu, t->lambda, P);
    }
}

// out[l·n + i] = W[i][l], two by two: four loads and stores become two of twice the width.
TSS__STAGE void tss__tile_scatter(int n, int used, tss__lanes *TSS__RESTRICT W,
                                  double *TSS__RESTRICT out) {
    int i = 0;
    for (; used == TSS_LANES && i + 1 < n; i += 2)
        for (int l = 0; l < TSS_LANES; l += 2) {
            double *o = out + l * n + i;
            const double a = W[i][l], b = W[i][l + 1], c = W[i + 1][l], e = W[i + 1][l + 1];
            o[0] = a, o[1] = c, o[n] = b, o[n + 1] = e;
        }
    for (; i < n; i++)
        for (int l = 0; l < used; l++) out[l * n + i] = W[i][l];
}

// Rows of the gradient: volume · P ∇N for nodes 1..d, minus their sum for node 0.
TSS__INLINE void tss__tile_forces(int d, tss__tile *t, tss__lanes *TSS__RESTRICT P,
                                  tss__lanes *TSS__RESTRICT G) {
    tss__lanes *TSS__RESTRICT B = t->inv;
    const double *TSS__RESTRICT vol = t->vol;
    for (int r = 0; r < d; r++) {
        if (d == 2) {
            TSS__EACH_LANE (l) {
                double a = P[r * 2][l] * vol[l], b = P[r * 2 + 1][l] * vol[l];
                double g1 = a * B[0][l] + b * B[1][l], g2 = a * B[2][l] + b * B[3][l];
                G[r][l] = -(g1 + g2), G[2 + r][l] = g1, G[4 + r][l] = g2;
            }
        } else {
            TSS__EACH_LANE (l) {
                double a = P[r * 3][l] * vol[l], b = P[r * 3 + 1][l] * vol[l];
                double c = P[r * 3 + 2][l] * vol[l];
                double g1 = a * B[0][l] + b * B[1][l] + c * B[2][l];
                double g2 = a * B[3][l] + b * B[4][l] + c * B[5][l];
                double g3 = a * B[6][l] + b * B[7][l] + c * B[8][l];
                G[r][l] = -(g1 + g2 + g3), G[3 + r][l] = g1, G[6 + r][l] = g2, G[9 + r][l] = g3;
            }
        }
    }
}

// ∂²psi/∂F² in the principal frame, U, sigma, V being there already.
TSS__STAGE void tss__tile_stretch(int d, tss_material_kind kind, int psd, tss__tile *t,
                                  tss__stretch *h) {
    TSS__ALIGN tss__lanes J;
    if (kind == TSS_LINEAR)
        tss__stretch_linear(d, t->mu, t->lambda, h);
    else
        TSS__EACH_LANE (l) J[l] = h->f.sigma[0][l] * h->f.sigma[1][l] * h->f.sigma[2][l];
    if (kind == TSS_NEO_HOOKEAN) tss__stretch_neo_hookean(J, t->mu, t->lambda, h);
    if (kind == TSS_STABLE_NEO_HOOKEAN) tss__stretch_stable(J, t->mu, t->lambda, h);
    if (kind == TSS_STVK) tss__stretch_stvk(t->mu, t->lambda, h);
    if (kind == TSS_FIXED_COROTATED) tss__stretch_corotated(J, t->mu, t->lambda, h);
    tss__stretch_finish(d, psd, t->vol, h);
}

// Cells at.. of the list, up to TSS__SVD_TILES tiles of them, with their stretch Hessians; the
// number of tiles.
static int tss__some_tiles(const tss__elastic *e, const double *x, const tss_ids *ids, int at,
                           int psd, tss__tile *t, tss__stretch *h) {
    const int all = (ids->count - at + TSS_LANES - 1) / TSS_LANES;
    const int tiles = all < TSS__SVD_TILES ? all : TSS__SVD_TILES;
    tss__lanes *F[TSS__SVD_TILES] = {NULL};
    tss__svd_parts *parts[TSS__SVD_TILES] = {NULL};
    for (int g = 0; g < tiles; g++) {
        tss__tile_cells(e, ids, at + g * TSS_LANES, t + g);
        tss__tile_F(e->dim, e, x, t + g);
        F[g] = t[g].F, parts[g] = &h[g].f;
    }
    const tss_material_kind kind = TSS__KIND(e->material.kind);
    if (kind != TSS_LINEAR) tss__svd(e->dim, tiles, F, parts);
    for (int g = 0; g < tiles; g++) tss__tile_stretch(e->dim, kind, psd, t + g, h + g);
    return tiles;
}

// U Ĥ_ij Uᵀ for the nodes with rotated shape gradients b and c, into rows of n lanes.
TSS__STAGE void tss__node_block3(tss__stretch *TSS__RESTRICT h, tss__lanes *TSS__RESTRICT b,
                                 tss__lanes *TSS__RESTRICT c, int n, tss__lanes *TSS__RESTRICT H) {
    TSS__ALIGN tss__lanes K[9];
    TSS__ALIGN tss__lanes T[9];
    tss__lanes *S = h->S, *A = h->flip, *B = h->twist;
    TSS__EACH_LANE (l) {
        double b0 = b[0][l], b1 = b[1][l], b2 = b[2][l], c0 = c[0][l], c1 = c[1][l], c2 = c[2][l];
        double m0 = b0 * c0, m1 = b1 * c1, m2 = b2 * c2;
        K[0][l] = S[0][l] * m0 + A[2][l] * m1 + A[1][l] * m2;
        K[4][l] = S[1][l] * m1 + A[2][l] * m0 + A[0][l] * m2;
        K[8][l] = S[2][l] * m2 + A[1][l] * m0 + A[0][l] * m1;
        K[1][l] = S[5][l] * (b0 * c1) + B[2][l] * (b1 * c0);
        K[3][l] = S[5][l] * (b1 * c0) + B[2][l] * (b0 * c1);
        K[2][l] = S[4][l] * (b0 * c2) + B[1][l] * (b2 * c0);
        K[6][l] = S[4][l] * (b2 * c0) + B[1][l] * (b0 * c2);
        K[5][l] = S[3][l] * (b1 * c2) + B[0][l] * (b2 * c1);
        K[7][l] = S[3][l] * (b2 * c1) + B[0][l] * (b1 * c2);
    }
    tss__mul(3, h->f.U, K, 0, T);
    tss__mul_rows(3, n, T, h->f.U, 1, H);
}

TSS__STAGE void tss__node_block2(tss__stretch *TSS__RESTRICT h, tss__lanes *TSS__RESTRICT b,
                                 tss__lanes *TSS__RESTRICT c, int n, tss__lanes *TSS__RESTRICT H) {
    TSS__ALIGN tss__lanes K[4];
    TSS__ALIGN tss__lanes T[4];
    tss__lanes *S = h->S;
    const double *A = h->flip[2], *B = h->twist[2];
    TSS__EACH_LANE (l) {
        double b0 = b[0][l], b1 = b[1][l], c0 = c[0][l], c1 = c[1][l];
        K[0][l] = S[0][l] * (b0 * c0) + A[l] * (b1 * c1);
        K[3][l] = S[1][l] * (b1 * c1) + A[l] * (b0 * c0);
        K[1][l] = S[5][l] * (b0 * c1) + B[l] * (b1 * c0);
        K[2][l] = S[5][l] * (b1 * c0) + B[l] * (b0 * c1);
    }
    tss__mul(2, h->f.U, K, 0, T);
    tss__mul_rows(2, n, T, h->f.U, 1, H);
}

// Node 0 moves F by minus the sum of the others: H_0j = −Σ_i H_ij, H_00 = −Σ_j H_0j. The blocks
// (i, j), 1 <= i <= j, are in place; the lower ones are read from their mirror.
TSS__INLINE void tss__first_node(int d, int edges, tss__lanes *W) {
    const int n = d * (edges + 1);
    for (int r = 0; r < d; r++) {
        for (int c = d; c < n; c++) {
            const double *p = W[(d + r) * n + c], *q = W[(2 * d + r) * n + c];
            const double *s = W[(n - d + r) * n + c];
            double *o = W[r * n + c];
            if (edges == 3)
                TSS__EACH_LANE (l) o[l] = -(p[l] + q[l] + s[l]);
            else
                TSS__EACH_LANE (l) o[l] = -(p[l] + q[l]);
        }
        for (int c = r; c < d; c++) {
            const double *p = W[r * n + d + c], *q = W[r * n + 2 * d + c],
                         *s = W[r * n + n - d + c];
            double *o = W[r * n + c];
            if (edges == 3)
                TSS__EACH_LANE (l) o[l] = -(p[l] + q[l] + s[l]);
            else
                TSS__EACH_LANE (l) o[l] = -(p[l] + q[l]);
        }
    }
}

// Entries below the diagonal in columns first.. are those above it.
TSS__INLINE void tss__mirror(int n, int first, int last, tss__lanes *W) {
    for (int r = first + 1; r < n; r++)
        for (int c = first; c < r && c < last; c++) memcpy(W[r * n + c], W[c * n + r], sizeof *W);
}

// All node blocks, n × n rows of lanes, from the stretch Hessian and the rotated shape gradients b
// of nodes 1..edges, d each.
TSS__INLINE void tss__assemble_in(int d, int edges, tss__lanes *b, tss__stretch *h, tss__lanes *W) {
    const int n = d * (edges + 1);
    for (int i = 0; i < edges; i++)
        for (int j = i; j < edges; j++) {
            tss__lanes *H = W + ((i + 1) * n + j + 1) * d;
            if (d == 3)
                tss__node_block3(h, b + i * 3, b + j * 3, n, H);
            else
                tss__node_block2(h, b + i * 2, b + j * 2, n, H);
        }
    tss__mirror(n, d, n, W);
    tss__first_node(d, edges, W);
    tss__mirror(n, 0, d, W);
}

TSS__STAGE void tss__assemble(int d, int edges, tss__lanes *b, tss__stretch *h, tss__lanes *W) {
    if (TSS__DIM(d) == 2)
        tss__assemble_in(2, 2, b, h, W);
    else if (edges == 3)
        tss__assemble_in(3, 3, b, h, W);
    else
        tss__assemble_in(3, 2, b, h, W);
}

// b̂ = Vᵀ∇N, then all blocks.
TSS__STAGE void tss__tile_assemble(int d, tss__tile *t, tss__stretch *h, tss__lanes *W) {
    TSS__ALIGN tss__lanes b[9];
    if (TSS__DIM(d) == 3)
        tss__mul(3, t->inv, h->f.V, 0, b);
    else
        tss__mul(2, t->inv, h->f.V, 0, b);
    tss__assemble(d, d, b, h, W);
}

// --- custom densities: one call of the user's function a batch, matrices one after another ---

typedef struct tss__custom_batch {
    int count, cell[TSS_BATCH];
    double F[TSS_BATCH * 9], psi[TSS_BATCH], P[TSS_BATCH * 9];
} tss__custom_batch;

static double tss__vol_of(const tss__elastic *e, int id) {
    return e->vol[id / TSS_LANES][id % TSS_LANES];
}

static void tss__custom_F(const tss__elastic *e, const double *x, tss_ids ids,
                          tss__custom_batch *b) {
    const int d2 = e->dim * e->dim;
    TSS_ASSERT(ids.count <= TSS_BATCH);
    b->count = ids.count;
    for (int at = 0; at < ids.count; at += TSS_LANES) {
        tss__tile t;
        tss__tile_cells(e, &ids, at, &t);
        if (e->dim == 3)
            tss__tile_F(3, e, x, &t);
        else
            tss__tile_F(2, e, x, &t);
        for (int l = 0; l < t.used; l++) b->cell[at + l] = t.id[l];
        tss__tile_scatter(d2, t.used, t.F, b->F + at * d2);
    }
}

static double tss__det_small(int d, const double *F) {
    if (d == 2) return F[0] * F[3] - F[1] * F[2];
    return F[0] * (F[4] * F[8] - F[5] * F[7]) + F[1] * (F[5] * F[6] - F[3] * F[8]) +
           F[2] * (F[3] * F[7] - F[4] * F[6]);
}

static void tss__custom_value(const tss__elastic *e, const double *x, tss_ids ids, double *out) {
    tss__custom_batch b;
    const tss_material *m = &e->material;
    tss__custom_F(e, x, ids, &b);
    m->density(m->user, e->dim, b.count, b.cell, b.F, b.psi, NULL, NULL);
    for (int k = 0; k < b.count; k++) {
        out[k] = b.psi[k] * tss__vol_of(e, b.cell[k]);
        if (m->barrier && !(tss__det_small(e->dim, b.F + k * e->dim * e->dim) > 0))
            out[k] = HUGE_VAL;
    }
}

// Shape gradients of all nodes of a cell, (d + 1) × d.
static void tss__shape_gradients(const tss__elastic *e, int id, double *N) {
    const int d = e->dim;
    tss__lanes *inv = e->inv + (size_t)(id / TSS_LANES) * (size_t)(d * d);
    for (int m = 0; m < d; m++) {
        N[m] = 0;
        for (int k = 0; k < d; k++) {
            N[(k + 1) * d + m] = inv[k * d + m][id % TSS_LANES];
            N[m] -= N[(k + 1) * d + m];
        }
    }
}

static void tss__custom_gradient(const tss__elastic *e, const double *x, tss_ids ids, double *out) {
    const int d = e->dim, a = d + 1;
    tss__custom_batch b;
    double N[12];
    tss__custom_F(e, x, ids, &b);
    e->material.density(e->material.user, d, b.count, b.cell, b.F, NULL, b.P, NULL);
    for (int k = 0; k < b.count; k++) {
        const double *P = b.P + k * d * d, vol = tss__vol_of(e, b.cell[k]);
        tss__shape_gradients(e, b.cell[k], N);
        for (int i = 0; i < a; i++)
            for (int r = 0; r < d; r++) {
                double s = 0;
                for (int m = 0; m < d; m++) s += P[r * d + m] * N[i * d + m];
                out[(k * a + i) * d + r] = vol * s;
            }
    }
}

// ∂P/∂F of one F by central differences; step ∛eps, so the errors of truncation and of rounding
// are alike. Made symmetric.
static void tss__custom_differences(const tss__elastic *e, int cell, const double *F, double *C) {
    const int n = e->dim * e->dim;
    double G[9], plus[9], minus[9];
    memcpy(G, F, (size_t)n * sizeof *F);
    for (int j = 0; j < n; j++) {
        const double step = 6e-6 * (fabs(F[j]) > 1 ? fabs(F[j]) : 1);
        G[j] = F[j] + step;
        e->material.density(e->material.user, e->dim, 1, &cell, G, NULL, plus, NULL);
        G[j] = F[j] - step;
        e->material.density(e->material.user, e->dim, 1, &cell, G, NULL, minus, NULL);
        G[j] = F[j];
        for (int i = 0; i < n; i++) C[i * n + j] = (plus[i] - minus[i]) / (2 * step);
    }
    for (int i = 0; i < n; i++)
        for (int j = 0; j < i; j++)
            C[i * n + j] = C[j * n + i] = 0.5 * (C[i * n + j] + C[j * n + i]);
}

// One Jacobi rotation in plane (p, q) of symmetric n × n A, A ← JᵀAJ, Q ← QJ.
static void tss__jacobi_dense(int n, int p, int q, double *A, double *Q) {
    const double h = A[q * n + q] - A[p * n + p], g = 2 * A[p * n + q];
    if (g == 0) return;
    double t = g / (fabs(h) + sqrt(h * h + g * g));
    if (h < 0) t = -t;
    const double c = 1 / sqrt(1 + t * t), s = c * t;
    for (int i = 0; i < n; i++) {
        double x = A[i * n + p], y = A[i * n + q];
        A[i * n + p] = c * x - s * y, A[i * n + q] = s * x + c * y;
        x = Q[i * n + p], y = Q[i * n + q];
        Q[i * n + p] = c * x - s * y, Q[i * n + q] = s * x + c * y;
    }
    for (int i = 0; i < n; i++) {
        const double x = A[p * n + i], y = A[q * n + i];
        A[p * n + i] = c * x - s * y, A[q * n + i] = s * x + c * y;
    }
    A[p * n + q] = A[q * n + p] = 0;
}

// Symmetric T to QᵀTQ, diagonal to rounding, by cyclic Jacobi; Q: the eigenvectors, by columns.
static void tss__eigen_dense(int n, double *T, double *Q) {
    double all = 0;
    for (int i = 0; i < n * n; i++) Q[i] = i % (n + 1) ? 0 : 1, all += T[i] * T[i];
    // what is within the rounding of T is left where it is
    for (int sweep = 0, turns = 1; sweep < 12 && turns > 0; sweep++) {
        turns = 0;
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++)
                if (T[p * n + q] * T[p * n + q] > 1e-31 * all) {
                    tss__jacobi_dense(n, p, q, T, Q);
                    turns++;
                }
    }
}

// A ← A − λ q qᵀ
static void tss__take_eigenvector(int n, double lambda, const double *q, double *A) {
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) A[j * n + i] = A[i * n + j] -= lambda * q[i] * q[j];
}

// out_abcd = Σ_m R_ma in_mbcd, ... for each index of a 3 × 3 × 3 × 3 tensor in turn: R of indices 0
// and 2 is U, of 1 and 3 is V.
static void tss__turn_tensor(const double *U, const double *V, double *C) {
    double T[81];
    for (int axis = 0; axis < 4; axis++) {
        const double *R = axis & 1 ? V : U;
        // indices are turned round: what is summed is always the first, and goes last
        for (int j = 0; j < 27; j++)
            for (int a = 0; a < 3; a++) {
                double s = 0;
                for (int m = 0; m < 3; m++) s += R[3 * m + a] * C[27 * m + j];
                T[3 * j + a] = s;
            }
        memcpy(C, T, sizeof T);
    }
}

// Orthogonal U, V (by columns) with F = U diag V ᵀ to rounding, or nearly so if F is nearly singular.
static void tss__principal_axes(const double *F, double *U, double *V) {
    double S[9];
    for (int i = 0; i < 9; i++) {
        V[i] = i % 4 ? 0 : 1, S[i] = 0;
        for (int m = 0; m < 3; m++) S[i] += F[3 * m + i / 3] * F[3 * m + i % 3];
    }
    for (int sweep = 0; sweep < 6; sweep++)
        for (int p = 0; p < 3; p++)
            for (int q = p + 1; q < 3; q++)
                if (fabs(S[3 * p + q]) > 1e-17 * (S[0] + S[4] + S[8]))
                    tss__jacobi_dense(3, p, q, S, V);
    // columns of F V made orthonormal, the longest first; what has no length takes any direction
    int order[3] = {0, 1, 2};
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++)
            if (S[4 * order[j]] < S[4 * order[j + 1]]) {
                const int t = order[j];
                order[j] = order[j + 1], order[j + 1] = t;
            }
    for (int k = 0; k < 3; k++) {
        double u[3], most = 0;
        for (int attempt = -1; attempt < 3 && !(most > 0); attempt++) {
            double norm = 0, size = attempt < 0 ? sqrt(S[0] + S[4] + S[8]) : 1;
            for (int i = 0; i < 3; i++) {
                u[i] = attempt == i;
                for (int m = 0; m < 3 && attempt < 0; m++) u[i] += F[3 * i + m] * V[3 * m + order[k]];
            }
            for (int pass = 0; pass < 2; pass++)
                for (int j = 0; j < k; j++) {
                    double dot = 0;
                    for (int i = 0; i < 3; i++) dot += u[i] * U[3 * i + order[j]];
                    for (int i = 0; i < 3; i++) u[i] -= dot * U[3 * i + order[j]];
                }
            for (int i = 0; i < 3; i++) norm += u[i] * u[i];
            if (sqrt(norm) > (attempt < 0 ? 1e-8 : 0.5) * size && norm < HUGE_VAL) most = sqrt(norm);
        }
        for (int i = 0; i < 3; i++) U[3 * i + order[k]] = most > 0 ? u[i] / most : i == order[k];
    }
}

// C to the nearest PSD matrix: without its negative eigenvalues. Orthogonal changes of basis alter
// nothing of that, and between F's principal axes an isotropic density has but one 3 × 3 and three
// 2 × 2 blocks: Jacobi then has next to nothing left to do. Any other density is as right, for a
// little more. What has no negative eigenvalue, rounding included, stays as it is, to the bit.
static void tss__custom_clamp(int d, const double *F, double *C) {
    const int n = d * d;
    double U[9], V[9], T[81], Q[81];
    memcpy(T, C, (size_t)(n * n) * sizeof *T);
    if (d == 3) {
        tss__principal_axes(F, U, V);
        tss__turn_tensor(U, V, T);
    }
    tss__eigen_dense(n, T, Q);
    for (int k = 0; k < n; k++) {
        double q[9], UQ[9];
        if (!(T[k * n + k] < 0)) continue;
        for (int i = 0; i < n; i++) q[i] = Q[i * n + k];
        if (d == 3) {  // back from the axes: U q Vᵀ
            for (int i = 0; i < 9; i++) {
                const double *u = U + i - i % 3, *c = q + i % 3;
                UQ[i] = u[0] * c[0] + u[1] * c[3] + u[2] * c[6];
            }
            for (int i = 0; i < 9; i++) {
                const double *u = UQ + i - i % 3, *v = V + i % 3 * 3;
                q[i] = u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
            }
        }
        tss__take_eigenvector(n, T[k * n + k], q, C);
    }
}

// H = vol Gᵀ C G, G the constant map from node positions to F: C G first.
static void tss__custom_node_blocks(int d, const double *N, double vol, const double *C,
                                    double *out) {
    const int a = d + 1, n = a * d, dd = d * d;
    double CG[108];
    for (int i = 0; i < dd; i++)
        for (int j = 0; j < n; j++) {
            double s = 0;
            for (int k = 0; k < d; k++) s += C[i * dd + j % d * d + k] * N[j / d * d + k];
            CG[i * n + j] = vol * s;
        }
    for (int i = 0; i < n; i++)
        for (int j = i; j < n; j++) {
            double s = 0;
            for (int m = 0; m < d; m++) s += N[i / d * d + m] * CG[(i % d * d + m) * n + j];
            out[i * n + j] = out[j * n + i] = s;
        }
}

static void tss__custom_hessian(const tss__elastic *e, const double *x, tss_ids ids, int psd,
                                double *out) {
    const int d = e->dim, dd = d * d, n = d * (d + 1);
    tss__custom_batch b;
    double N[12], C[81];
    tss__custom_F(e, x, ids, &b);
    for (int k = 0; k < b.count; k++) {
        const double *F = b.F + k * dd;
        if (e->material.has_C)
            e->material.density(e->material.user, d, 1, b.cell + k, F, NULL, NULL, C);
        else
            tss__custom_differences(e, b.cell[k], F, C);
        if (psd) tss__custom_clamp(d, F, C);
        tss__shape_gradients(e, b.cell[k], N);
        tss__custom_node_blocks(d, N, tss__vol_of(e, b.cell[k]), C, out + k * n * n);
    }
}

// --- the callbacks of the hook; one body of code a dimension and material ---

TSS__INLINE void tss__value_tiles(int d, const tss__elastic *e, const double *x, const tss_ids *ids,
                                  double *out) {
    for (int at = 0; at < ids->count; at += TSS_LANES) {
        tss__tile t;
        TSS__ALIGN tss__lanes psi;
        tss__tile_cells(e, ids, at, &t);
        tss__tile_F(d, e, x, &t);
        tss__tile_psi(d, TSS__KIND(e->material.kind), &t, psi);
        for (int l = 0; l < t.used; l++) out[at + l] = psi[l];
    }
}

TSS__INLINE void tss__gradient_tiles(int d, const tss__elastic *e, const double *x,
                                     const tss_ids *ids, double *out) {
    for (int at = 0; at < ids->count; at += TSS_LANES) {
        tss__tile t;
        TSS__ALIGN tss__lanes P[9];
        TSS__ALIGN tss__lanes G[12];
        tss__tile_cells(e, ids, at, &t);
        tss__tile_F(d, e, x, &t);
        tss__tile_P(d, TSS__KIND(e->material.kind), &t, P);
        tss__tile_forces(d, &t, P, G);
        tss__tile_scatter(d * (d + 1), t.used, G, out + at * d * (d + 1));
    }
}

static void tss__hessian_tiles(const tss__elastic *e, const double *x, const tss_ids *ids, int psd,
                               double *out) {
    const int d = e->dim, nn = d * (d + 1) * d * (d + 1);
    for (int at = 0; at < ids->count; at += TSS__SVD_TILES * TSS_LANES) {
        tss__tile t[TSS__SVD_TILES];
        TSS__ALIGN tss__stretch h[TSS__SVD_TILES];
        TSS__ALIGN tss__lanes W[144];
        const int tiles = tss__some_tiles(e, x, ids, at, psd, t, h);
        for (int g = 0; g < tiles; g++) {
            tss__tile_assemble(d, t + g, h + g, W);
            tss__tile_scatter(nn, t[g].used, W, out + (size_t)(at + g * TSS_LANES) * (size_t)nn);
        }
    }
}

// One body of code a dimension; the material is a jump a tile.
static void tss__value_2(const tss__elastic *e, const double *x, const tss_ids *i, double *out) {
    tss__value_tiles(2, e, x, i, out);
}
static void tss__value_3(const tss__elastic *e, const double *x, const tss_ids *i, double *out) {
    tss__value_tiles(3, e, x, i, out);
}
static void tss__gradient_2(const tss__elastic *e, const double *x, const tss_ids *i, double *out) {
    tss__gradient_tiles(2, e, x, i, out);
}
static void tss__gradient_3(const tss__elastic *e, const double *x, const tss_ids *i, double *out) {
    tss__gradient_tiles(3, e, x, i, out);
}

static void tss__elastic_value(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                               double *out) {
    const tss__elastic *e = (const tss__elastic *)user;
    (void)c;
    if (TSS__KIND(e->material.kind) == TSS_CUSTOM_MATERIAL)
        tss__custom_value(e, x, ids, out);
    else if (TSS__DIM(e->dim) == 3)
        tss__value_3(e, x, &ids, out);
    else
        tss__value_2(e, x, &ids, out);
}

static void tss__elastic_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                  double *out) {
    const tss__elastic *e = (const tss__elastic *)user;
    (void)c;
    if (TSS__KIND(e->material.kind) == TSS_CUSTOM_MATERIAL)
        tss__custom_gradient(e, x, ids, out);
    else if (TSS__DIM(e->dim) == 3)
        tss__gradient_3(e, x, &ids, out);
    else
        tss__gradient_2(e, x, &ids, out);
}

static void tss__elastic_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                 int psd, double *out) {
    const tss__elastic *e = (const tss__elastic *)user;
    (void)c;
    if (TSS__KIND(e->material.kind) == TSS_CUSTOM_MATERIAL)
        tss__custom_hessian(e, x, ids, psd, out);
    else
        tss__hessian_tiles(e, x, &ids, psd, out);
}

static tss_result tss__elastic_lists(void *user, const tss_ctx *c, const double *x, const double *d,
                                     double t_max, tss_stencils *out) {
    const tss__elastic *e = (const tss__elastic *)user;
    (void)c, (void)x, (void)d, (void)t_max;
    out->count = e->cells;
    out->node = e->node;
    out->pattern = 1;
    return TSS_OK;
}

static void tss__elastic_describe(void *user, const tss_ctx *c, int id, char *text, size_t size) {
    const tss__elastic *e = (const tss__elastic *)user;
    const int *n = e->node + (size_t)id * (size_t)(e->dim + 1);
    const int label = e->label ? e->label[id] : id, body = c && c->body ? c->body[n[0]] : 0;
    if (e->dim == 3)
        snprintf(text, size, "tet %d of body %d (nodes %d %d %d %d)", label, body, n[0], n[1], n[2],
                 n[3]);
    else
        snprintf(text, size, "triangle %d of body %d (nodes %d %d %d)", label, body, n[0], n[1],
                 n[2]);
}

// ---------------------------------------------------------------------------------------------
// >>inversion_filter (private)
// Largest t with det(A + sB) > f det A for s ∈ [0, t], A the edges of x, B those of d: a cubic (2D:
// quadratic) in s, first root on [0, t_max]. In the Bernstein basis the coefficients bound the
// polynomial: all positive (above their rounding) means no root, which settles nearly every cell
// eight at a time. The rest are walked from the left: the convex hull of the control points crosses
// zero no later than the curve, so t comes up to the root from below and never passes it, whatever
// its multiplicity.
// ---------------------------------------------------------------------------------------------

#define TSS__FILTER_CELLS 1024  // cells a task; fixed, so results do not depend on threads
#define TSS__KEEP_3D 0.2        // f: share of J a step may leave; IPC's values
#define TSS__KEEP_2D 0.1

typedef struct tss__cubic {
    tss__lanes c[4], err;  // power basis of det(A + sB) − f det A; rounding of c1..c3 up to s = T
} tss__cubic;

// |A|, |B| sums of absolute entries: det and its mixed terms are below (|A|/3)³ …, rounded eight
// times; eps·(…)³ without the part of A alone bounds the error of c1 T + c2 T² + c3 T³. It is
// convex in T, so a share t/T of it bounds the error at t: it is taken off c1.
TSS__INLINE double tss__cubic_error(double a, double b) {
    return 2.3e-16 * b * (3 * a * (a + b) + b * b);
}

TSS__INLINE void tss__cubic3(tss__lanes *TSS__RESTRICT A, tss__lanes *TSS__RESTRICT B, double T,
                             tss__cubic *TSS__RESTRICT p) {
    TSS__ALIGN tss__lanes CA[9];
    TSS__ALIGN tss__lanes CB[9];
    TSS__ALIGN tss__lanes c1, c2, a, b;
    tss__cofactor(3, A, CA, p->c[0]);
    tss__cofactor(3, B, CB, p->c[3]);
    TSS__EACH_LANE (l) c1[l] = 0, c2[l] = 0, a[l] = 0, b[l] = 0;
    for (int i = 0; i < 9; i++)
        TSS__EACH_LANE (l) {
            c1[l] += CA[i][l] * B[i][l], c2[l] += CB[i][l] * A[i][l];
            a[l] += tss__abs(A[i][l]), b[l] += tss__abs(B[i][l]);
        }
    TSS__EACH_LANE (l) {
        p->c[0][l] *= 1 - TSS__KEEP_3D;
        p->c[1][l] = c1[l], p->c[2][l] = c2[l];
        p->err[l] = tss__cubic_error(a[l], T * b[l]);
    }
}

TSS__INLINE void tss__cubic2(tss__lanes *TSS__RESTRICT A, tss__lanes *TSS__RESTRICT B, double T,
                             tss__cubic *TSS__RESTRICT p) {
    TSS__EACH_LANE (l) {
        double a = A[0][l], b = A[1][l], c = A[2][l], d = A[3][l];
        double u = B[0][l], v = B[1][l], w = B[2][l], z = B[3][l];
        double m = tss__abs(a) + tss__abs(b) + tss__abs(c) + tss__abs(d);
        double n = T * (tss__abs(u) + tss__abs(v) + tss__abs(w) + tss__abs(z));
        p->c[0][l] = (1 - TSS__KEEP_2D) * (a * d - b * c);
        p->c[1][l] = (a * z - b * w) + (u * d - v * c);
        p->c[2][l] = u * z - v * w;
        p->c[3][l] = 0;
        p->err[l] = 4.5e-16 * n * (2 * m + n);
    }
}

// Signs of the Bernstein coefficients on [0, T], less the error: marks lanes that may have a root.
TSS__INLINE int tss__bernstein(const tss__cubic *TSS__RESTRICT p, double T,
                               double *TSS__RESTRICT maybe) {
    TSS__EACH_LANE (l) {
        double c0 = p->c[0][l], c1 = p->c[1][l] * T - p->err[l], c2 = p->c[2][l] * (T * T);
        double b1 = c0 + c1 * (1.0 / 3), b2 = c0 + c1 * (2.0 / 3) + c2 * (1.0 / 3);
        double b3 = c0 + c1 + c2 + p->c[3][l] * (T * T * T);
        int ok = (c0 > 0) & (b1 > 0) & (b2 > 0) & (b3 > 0);
        maybe[l] = ok ? 0.0 : 1.0;
    }
    return tss__any(maybe);
}

// Where the convex hull of the control points (i/3, b_i) first reaches zero, b_0 > 0; 1 if nowhere.
static double tss__hull_zero(const double *b) {
    double first = 1;
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++)
            if (b[i] > 0 && b[j] <= 0) {
                const double t = (i * -b[j] + j * b[i]) / (3 * (b[i] - b[j]));
                if (t < first) first = t;
            }
    return first;
}

// Lower bound of the first root on [0, 1] of c0 + c1 t + c2 t² + c3 t³; 1 if there is none. Walks
// from the left over intervals of length h: an interval without a root doubles h, one with a
// possible root is entered up to its hull's zero and h shrinks to twice that.
static double tss__first_root(const double *c) {
    double at = 0, h = 1;
    for (int step = 0; step < 200; step++) {
        const double q0 = c[0] + at * (c[1] + at * (c[2] + at * c[3]));
        const double q1 = h * (c[1] + at * (2 * c[2] + at * 3 * c[3]));
        const double q2 = h * h * (c[2] + 3 * at * c[3]), q3 = h * h * h * c[3];
        const double b[4] = {q0, q0 + q1 / 3, q0 + (2 * q1 + q2) / 3, q0 + q1 + q2 + q3};
        if (!(q0 > 0)) break;
        const double z = tss__hull_zero(b);
        if (z >= 1) {
            at += h;
            if (at >= 1) return 1;
            h *= 2;
        } else {
            at += z * h;
            if (h <= 1e-9 * at) break;  // as close as the step length needs to be known
            if (z < 0.5) h *= 2 * z;
            if (h < 1e-300) break;
        }
        if (h > 1 - at) h = 1 - at;
    }
    return at * (1 - 1e-12);
}

static double tss__cell_det(const tss__elastic *e, int id, const double *x, const double *d,
                            double t) {
    double A[9];
    const int n = e->dim, *node = e->node + (size_t)id * (size_t)(n + 1);
    for (int k = 0; k < n; k++)
        for (int r = 0; r < n; r++) {
            const size_t i = (size_t)node[k + 1] * (size_t)n + (size_t)r;
            const size_t o = (size_t)node[0] * (size_t)n + (size_t)r;
            A[k * n + r] = (x[i] + t * d[i]) - (x[o] + t * d[o]);
        }
    return tss__det_small(n, A);
}

typedef struct tss__filter_task {
    const tss__elastic *e;
    const double *x, *d;
    double t_max;
} tss__filter_task;

// The lanes the quick test left open, in order. Positions are rounded when the step is taken, so
// the end of a limited step is evaluated as well.
static void tss__filter_lanes(const tss__filter_task *f, const tss__tile *t, const tss__cubic *p,
                              const double *maybe, double T, double *limit, int *culprit) {
    for (int l = 0; l < t->used; l++) {
        if (maybe[l] == 0) continue;
        const double own[4] = {p->c[0][l], p->c[1][l] * T - p->err[l], p->c[2][l] * (T * T),
                               p->c[3][l] * (T * T * T)};
        double s = T * tss__first_root(own);
        for (int k = 0; k < 60 && s > 0 && !(tss__cell_det(f->e, t->id[l], f->x, f->d, s) > 0); k++)
            s *= 0.5;
        if (s < *limit) *limit = s, *culprit = t->id[l];
    }
}

static void tss__filter_run(int block, int worker, void *arg) {
    const tss__filter_task *f = (const tss__filter_task *)arg;
    const tss__elastic *e = f->e;
    const int first = block * TSS__FILTER_CELLS, left = e->cells - first;
    const int count = left < TSS__FILTER_CELLS ? left : TSS__FILTER_CELLS;
    const tss_ids ids = {first, count, NULL};
    double limit = f->t_max;
    int culprit = -1;
    (void)worker;
    for (int at = 0; at < count; at += TSS_LANES) {
        tss__tile t;
        TSS__ALIGN tss__lanes B[9];
        TSS__ALIGN tss__lanes maybe;
        TSS__ALIGN tss__cubic p;
        const double T = limit;
        tss__tile_cells(e, &ids, at, &t);
        if (TSS__DIM(e->dim) == 3) {
            tss__tile_edges(3, e->node, f->x, t.id, t.D);
            tss__tile_edges(3, e->node, f->d, t.id, B);
            tss__cubic3(t.D, B, T, &p);
        } else {
            tss__tile_edges(2, e->node, f->x, t.id, t.D);
            tss__tile_edges(2, e->node, f->d, t.id, B);
            tss__cubic2(t.D, B, T, &p);
        }
        if (tss__bernstein(&p, T, maybe)) tss__filter_lanes(f, &t, &p, maybe, T, &limit, &culprit);
    }
    e->limit[block] = limit;
    e->culprit[block] = culprit;
}

static int tss__filter_tasks(const tss__elastic *e) {
    return (e->cells + TSS__FILTER_CELLS - 1) / TSS__FILTER_CELLS;
}

// Least of the tasks' results; the first cell in order of blocks wins a tie.
static double tss__elastic_least(const tss__elastic *e, double least, int *culprit) {
    int who = -1;
    for (int b = 0; b < tss__filter_tasks(e); b++)
        if (e->limit[b] < least) least = e->limit[b], who = e->culprit[b];
    if (culprit) *culprit = who;
    return least;
}

static double tss__elastic_max_step(void *user, const tss_ctx *c, const double *x, const double *d,
                                    double t_max, int *culprit) {
    const tss__elastic *e = (const tss__elastic *)user;
    tss__filter_task f = {e, x, d, t_max};
    tss_parallel(c->host, tss__filter_tasks(e), tss__filter_run, &f);
    return tss__elastic_least(e, t_max, culprit);
}

static void tss__min_J_run(int block, int worker, void *arg) {
    const tss__filter_task *f = (const tss__filter_task *)arg;
    const tss__elastic *e = f->e;
    const int first = block * TSS__FILTER_CELLS, left = e->cells - first;
    const tss_ids ids = {first, left < TSS__FILTER_CELLS ? left : TSS__FILTER_CELLS, NULL};
    double least = HUGE_VAL;
    int who = -1;
    (void)worker;
    for (int at = 0; at < ids.count; at += TSS_LANES) {
        tss__tile t;
        TSS__ALIGN tss__lanes C[9];
        TSS__ALIGN tss__lanes J;
        tss__tile_cells(e, &ids, at, &t);
        if (TSS__DIM(e->dim) == 3)
            tss__tile_F(3, e, f->x, &t), tss__cofactor(3, t.F, C, J);
        else
            tss__tile_F(2, e, f->x, &t), tss__cofactor(2, t.F, C, J);
        for (int l = 0; l < t.used; l++)
            if (J[l] < least) least = J[l], who = t.id[l];
    }
    e->limit[block] = least;
    e->culprit[block] = who;
}

// The smallest J of all cells at x and its cell; +inf and −1 without cells.
static double tss__elastic_min_J(const tss__elastic *e, const tss_host *host, const double *x,
                                 int *cell) {
    tss__filter_task f = {e, x, NULL, 0};
    tss_parallel(host, tss__filter_tasks(e), tss__min_J_run, &f);
    return tss__elastic_least(e, HUGE_VAL, cell);
}

// ---------------------------------------------------------------------------------------------
// >>elastic_create (private)
// ---------------------------------------------------------------------------------------------

static int tss__material_ok(double E, double nu, double rho) {
    return E > 0 && E <= 1e300 && nu > -1 && nu < 0.5 && rho > 0 && rho <= 1e300;
}

static tss_result tss__elastic_validate(int dim, int cells, const int *node, const double *X,
                                        const tss_material *m, const double *E, const double *nu,
                                        const double *rho) {
    if ((dim != 2 && dim != 3) || cells < 1 || !node || !X || !m) return TSS_ERROR_BAD_ARGUMENT;
    if ((unsigned)m->kind >= TSS_MATERIAL_KINDS) return TSS_ERROR_BAD_MATERIAL;
    if (m->kind == TSS_CUSTOM_MATERIAL && !m->density) return TSS_ERROR_BAD_MATERIAL;
    if (!(m->damping >= 0) || m->damping > 1e300) return TSS_ERROR_BAD_MATERIAL;
    if (m->kind == TSS_CUSTOM_MATERIAL && m->damping > 0) return TSS_ERROR_BAD_MATERIAL;
    const int n = E || nu || rho ? cells : 1;
    for (int i = 0; i < n; i++)
        if (!tss__material_ok(E ? E[i] : m->E, nu ? nu[i] : m->nu, rho ? rho[i] : m->rho))
            return TSS_ERROR_BAD_MATERIAL;
    return TSS_OK;
}

// mu and lambda as the kernels take them.
static void tss__kernel_lame(tss_material_kind kind, double E, double nu, double *mu,
                             double *lambda) {
    tss_lame(E, nu, mu, lambda);
    if (kind != TSS_STABLE_NEO_HOOKEAN) return;
    *lambda += *mu * 5 / 6;
    *mu *= 4.0 / 3;
}

// Dm⁻¹ and volume of one cell, into lane l of its block; 0 if the cell is flat or inside out.
static int tss__elastic_rest(tss__elastic *e, int cell, int slot, const double *X) {
    const int d = e->dim, *n = e->node + (size_t)cell * (size_t)(d + 1);
    double D[9], inv[9];
    for (int k = 0; k < d; k++)
        for (int r = 0; r < d; r++)
            D[r * d + k] = X[(size_t)n[k + 1] * (size_t)d + (size_t)r] -
                           X[(size_t)n[0] * (size_t)d + (size_t)r];
    const double det = tss__det_small(d, D), v = 1 / det;
    if (!(det > 0) || !(v <= 1e300)) return 0;
    if (d == 2) {
        inv[0] = D[3] * v, inv[1] = -D[1] * v, inv[2] = -D[2] * v, inv[3] = D[0] * v;
    } else {
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) {
                const int a = (c + 1) % 3, b = (c + 2) % 3, p = (r + 1) % 3, q = (r + 2) % 3;
                inv[r * 3 + c] = (D[a * 3 + p] * D[b * 3 + q] - D[a * 3 + q] * D[b * 3 + p]) * v;
            }
    }
    const size_t block = (size_t)(slot / TSS_LANES);
    for (int i = 0; i < d * d; i++)
        e->inv[block * (size_t)(d * d) + (size_t)i][slot % TSS_LANES] = inv[i];
    e->vol[block][slot % TSS_LANES] = det / (d == 3 ? 6 : 2);
    return 1;
}

static void tss__elastic_destroy(void *user, const tss_host *host) {
    tss__elastic *e = (tss__elastic *)user;
    if (!e) return;
    const size_t blocks = (size_t)e->blocks, d = (size_t)e->dim, own = e->per_cell ? blocks : 1;
    const size_t tasks = (size_t)tss__filter_tasks(e);
    tss_free(host, e->node, (size_t)e->cells * (d + 1) * sizeof *e->node);
    tss_free(host, e->inv, blocks * d * d * sizeof *e->inv);
    tss_free(host, e->vol, blocks * sizeof *e->vol);
    tss_free(host, e->mu, own * sizeof *e->mu);
    tss_free(host, e->lambda, own * sizeof *e->lambda);
    tss_free(host, e->limit, tasks * sizeof *e->limit);
    tss_free(host, e->culprit, tasks * sizeof *e->culprit);
    tss_free(host, e, sizeof *e);
}

static tss__elastic *tss__elastic_alloc(const tss_host *host, int dim, int cells, int per_cell) {
    tss__elastic *e = (tss__elastic *)tss_alloc(host, sizeof *e);
    if (!e) return NULL;
    memset(e, 0, sizeof *e);
    e->dim = dim, e->cells = cells, e->blocks = (cells - 1) / TSS_LANES + 1, e->per_cell = per_cell;
    const size_t blocks = (size_t)e->blocks, d = (size_t)dim, own = per_cell ? blocks : 1;
    const size_t tasks = (size_t)tss__filter_tasks(e);
    e->node = (int *)tss_alloc(host, (size_t)cells * (d + 1) * sizeof *e->node);
    e->inv = (tss__lanes *)tss_alloc(host, blocks * d * d * sizeof *e->inv);
    e->vol = (tss__lanes *)tss_alloc(host, blocks * sizeof *e->vol);
    e->mu = (tss__lanes *)tss_alloc(host, own * sizeof *e->mu);
    e->lambda = (tss__lanes *)tss_alloc(host, own * sizeof *e->lambda);
    e->limit = (double *)tss_alloc(host, tasks * sizeof *e->limit);
    e->culprit = (int *)tss_alloc(host, tasks * sizeof *e->culprit);
    if (e->node && e->inv && e->vol && e->mu && e->lambda && e->limit && e->culprit) return e;
    tss__elastic_destroy(e, host);
    return NULL;
}

// Elastic energy of cells (node: cells × (d + 1), positively oriented, numbers into X). E, nu, rho:
// one a cell, or NULL for the material's. All input is copied. TSS_ERROR_BAD_MESH: a cell without
// positive volume (*bad_cell, may be NULL).
static tss_result tss__elastic_create(const tss_host *host, int dim, int cells, const int *node,
                                      const double *X, const tss_material *material,
                                      const double *E, const double *nu, const double *rho,
                                      tss__elastic **out, int *bad_cell) {
    *out = NULL;
    if (bad_cell) *bad_cell = -1;
    tss_result r = tss__elastic_validate(dim, cells, node, X, material, E, nu, rho);
    if (r != TSS_OK) return r;
    tss__elastic *e = tss__elastic_alloc(host, dim, cells, E || nu);
    if (!e) return TSS_ERROR_NO_MEMORY;
    e->material = *material;
    memcpy(e->node, node, (size_t)cells * (size_t)(dim + 1) * sizeof *node);
    for (int s = 0; s < e->blocks * TSS_LANES; s++) {
        const int cell = s < cells ? s : cells - 1;
        if (!tss__elastic_rest(e, cell, s, X)) {
            if (bad_cell) *bad_cell = cell;
            tss__elastic_destroy(e, host);
            return TSS_ERROR_BAD_MESH;
        }
        if (!e->per_cell && s >= TSS_LANES) continue;
        tss__kernel_lame(material->kind, E ? E[cell] : material->E, nu ? nu[cell] : material->nu,
                         &e->mu[s / TSS_LANES][s % TSS_LANES],
                         &e->lambda[s / TSS_LANES][s % TSS_LANES]);
    }
    *out = e;
    return TSS_OK;
}

static int tss__elastic_has_barrier(const tss__elastic *e) {
    return e->material.kind == TSS_NEO_HOOKEAN ||
           (e->material.kind == TSS_CUSTOM_MATERIAL && e->material.barrier);
}

// The hook; the energy takes e over (destroy frees it).
// Smallest non-zero eigenvalue of ∇²psi at rest: 2 mu (traceless stretches and shears). The face
// opposite node i has d · volume · ‖∇N_i‖.
static void tss__elastic_node_scale(void *user, const tss_ctx *c, double *W, double *cells, double *v,
                                    double *a) {
    const tss__elastic *e = (const tss__elastic *)user;
    const int d = e->dim;
    const double share = e->material.kind == TSS_STABLE_NEO_HOOKEAN ? 0.75 : 1;  // it stores 4/3 mu
    (void)c;
    for (int k = 0; k < e->cells; k++) {
        const int b = k / TSS_LANES, l = k % TSS_LANES, *node = e->node + (size_t)k * (size_t)(d + 1);
        tss__lanes *inv = e->inv + (size_t)b * (size_t)(d * d);
        double vol = e->vol[b][l], mu = share * e->mu[e->per_cell ? b : 0][l], first[3] = {0, 0, 0};
        for (int i = d; i >= 0; i--) {
            double s = 0;
            for (int r = 0; r < d; r++) {
                double g = i > 0 ? inv[(i - 1) * d + r][l] : first[r];
                first[r] -= g;
                s += g * g;
            }
            W[node[i]] += 2 * mu, cells[node[i]] += 1;
            v[node[i]] += vol / (d + 1), a[node[i]] += d * vol * sqrt(s);
        }
    }
}

static tss_energy_def tss__elastic_def(tss__elastic *e) {
    tss_energy_def d = tss_energy_def_default();
    d.name = "elasticity";
    d.arity = e->dim + 1;
    d.flags = TSS_ENERGY_TIMES_AH2 | TSS_ENERGY_SECANT_OK;
    if (e->material.kind == TSS_LINEAR) d.flags |= TSS_ENERGY_CONST_HESSIAN;
    d.user = e;
    d.lists = tss__elastic_lists;
    d.value = tss__elastic_value;
    d.gradient = tss__elastic_gradient;
    d.hessian = tss__elastic_hessian;
    if (tss__elastic_has_barrier(e)) {
        d.flags |= TSS_ENERGY_J_BARRIER;
        d.max_step = tss__elastic_max_step;
    }
    d.describe = tss__elastic_describe;
    d.node_scale = tss__elastic_node_scale;
    d.destroy = tss__elastic_destroy;
    return d;
}

// ---------------------------------------------------------------------------------------------
// >>damping (private)
// D = damping/h · ½ (x − x_t)ᵀ H (x − x_t), H the projected elastic Hessian at x_t, kept for the
// step as its principal frames and stretch blocks (33 numbers a cell in place of 144): the energy
// is ½ G:C:G with G = F(x) − F(x_t) turned into the frame. Convex and quadratic; zero, with its
// gradient, at x_t.
// ---------------------------------------------------------------------------------------------

typedef struct tss__damping {
    tss__elastic *e;  // not owned; outlives all calls but destroy
    int blocks;
    tss__stretch *frozen;  // blocks: U, V, S, A, B with the volume in
} tss__damping;

#define TSS__STRETCH_LANES (int)(sizeof(tss__stretch) / sizeof(tss__lanes))

typedef struct tss__freeze_task {
    tss__damping *m;
    const double *x;
} tss__freeze_task;

static void tss__freeze_run(int block, int worker, void *arg) {
    const tss__freeze_task *f = (const tss__freeze_task *)arg;
    const tss__elastic *e = f->m->e;
    const int first = block * TSS__FILTER_CELLS, left = e->cells - first;
    const tss_ids ids = {first, left < TSS__FILTER_CELLS ? left : TSS__FILTER_CELLS, NULL};
    (void)worker;
    for (int at = 0; at < ids.count; at += TSS__SVD_TILES * TSS_LANES) {
        tss__tile t[TSS__SVD_TILES];
        tss__some_tiles(e, f->x, &ids, at, 1, t, f->m->frozen + (first + at) / TSS_LANES);
    }
}

static tss_result tss__damping_begin(void *user, const tss_ctx *c) {
    tss__damping *m = (tss__damping *)user;
    tss__freeze_task f = {m, c->x_t};
    tss_parallel(c->host, tss__filter_tasks(m->e), tss__freeze_run, &f);
    return TSS_OK;
}

// The frozen blocks of a tile: in place for a whole block, else lane by lane into *copy.
static tss__stretch *tss__frozen_of(const tss__damping *m, const tss_ids *ids, const tss__tile *t,
                                    tss__stretch *copy) {
    if (!ids->list && t->id[0] % TSS_LANES == 0) return m->frozen + t->id[0] / TSS_LANES;
    double *to = copy->f.U[0];
    for (int l = 0; l < TSS_LANES; l++) {
        const double *from = m->frozen[t->id[l] / TSS_LANES].f.U[0];
        for (int i = 0; i < TSS__STRETCH_LANES; i++)
            to[i * TSS_LANES + l] = from[i * TSS_LANES + t->id[l] % TSS_LANES];
    }
    return copy;
}

// P̂ = C Ĝ in the frame: stretches through S, each pair through A and B. d × d lanes.
TSS__INLINE void tss__stretch_apply(int d, tss__stretch *TSS__RESTRICT h,
                                    tss__lanes *TSS__RESTRICT G, tss__lanes *TSS__RESTRICT P) {
    for (int a = 0; a < d; a++) {
        double *p = P[a * (d + 1)];
        TSS__EACH_LANE (l) p[l] = h->S[a][l] * G[a * (d + 1)][l];
        for (int b = 0; b < d; b++) {
            if (b == a) continue;
            const double *s = h->S[3 + (3 - a - b)], *g = G[b * (d + 1)];
            TSS__EACH_LANE (l) p[l] += s[l] * g[l];
            const double *A = h->flip[3 - a - b], *B = h->twist[3 - a - b];
            const double *ab = G[a * d + b], *ba = G[b * d + a];
            double *o = P[a * d + b];
            TSS__EACH_LANE (l) o[l] = A[l] * ab[l] + B[l] * ba[l];
        }
    }
}

// U B Vᵀ (or UᵀBV).
TSS__INLINE void tss__turn(int d, tss__stretch *h, int back, tss__lanes *B, tss__lanes *out) {
    TSS__ALIGN tss__lanes T[9];
    TSS__ALIGN tss__lanes Ut[9];
    if (!back) {
        tss__mul(d, h->f.U, B, 0, T);
        tss__mul(d, T, h->f.V, 1, out);
        return;
    }
    for (int i = 0; i < d * d; i++) memcpy(Ut[i], h->f.U[i % d * d + i / d], sizeof *Ut);
    tss__mul(d, Ut, B, 0, T);
    tss__mul(d, T, h->f.V, 0, out);
}

// Ĝ of x − x_t and P̂ of a tile.
TSS__INLINE void tss__damping_tile(int d, const tss__elastic *e, const tss_ctx *c, const double *x,
                                   tss__stretch *h, tss__tile *t, tss__lanes *G, tss__lanes *P) {
    TSS__ALIGN tss__lanes D[9];
    TSS__ALIGN tss__lanes dF[9];
    tss__tile_edges(d, e->node, x, t->id, t->D);
    tss__tile_edges(d, e->node, c->x_t, t->id, D);
    for (int i = 0; i < d * d; i++)
        TSS__EACH_LANE (l) D[i][l] = t->D[i][l] - D[i][l];
    // D[k·d + r] is the transposed edge matrix: dF = Dᵀ Dm⁻¹.
    for (int i = 0; i < d * d; i++) memcpy(t->D[i], D[i % d * d + i / d], sizeof *D);
    tss__mul(d, t->D, t->inv, 0, dF);
    tss__turn(d, h, 1, dF, G);
    tss__stretch_apply(d, h, G, P);
}

static double tss__damping_scale(const tss__damping *m, const tss_ctx *c) {
    return c->quasistatic ? 0 : m->e->material.damping / c->h;
}

TSS__INLINE void tss__damping_value_tiles(int d, const tss__damping *m, const tss_ctx *c,
                                          const double *x, const tss_ids *ids, double *out) {
    const double scale = 0.5 * tss__damping_scale(m, c);
    for (int at = 0; at < ids->count; at += TSS_LANES) {
        tss__tile t;
        TSS__ALIGN tss__stretch copy;
        TSS__ALIGN tss__lanes G[9];
        TSS__ALIGN tss__lanes P[9];
        TSS__ALIGN tss__lanes v;
        tss__tile_cells(m->e, ids, at, &t);
        tss__damping_tile(d, m->e, c, x, tss__frozen_of(m, ids, &t, &copy), &t, G, P);
        TSS__EACH_LANE (l) v[l] = 0;
        for (int i = 0; i < d * d; i++)
            TSS__EACH_LANE (l) v[l] += G[i][l] * P[i][l];
        for (int l = 0; l < t.used; l++) out[at + l] = scale * v[l];
    }
}

TSS__INLINE void tss__damping_gradient_tiles(int d, const tss__damping *m, const tss_ctx *c,
                                             const double *x, const tss_ids *ids, double *out) {
    const int n = d * (d + 1);
    for (int at = 0; at < ids->count; at += TSS_LANES) {
        tss__tile t;
        TSS__ALIGN tss__stretch copy;
        TSS__ALIGN tss__lanes G[9];
        TSS__ALIGN tss__lanes P[9];
        TSS__ALIGN tss__lanes g[12];
        TSS__ALIGN tss__lanes scale;
        tss__tile_cells(m->e, ids, at, &t);
        tss__stretch *h = tss__frozen_of(m, ids, &t, &copy);
        tss__damping_tile(d, m->e, c, x, h, &t, G, P);
        tss__turn(d, h, 0, P, G);
        const double s = tss__damping_scale(m, c);
        TSS__EACH_LANE (l) scale[l] = s;
        t.vol = scale;  // the volume is in the frozen blocks
        tss__tile_forces(d, &t, G, g);
        tss__tile_scatter(n, t.used, g, out + at * n);
    }
}

static void tss__damping_value(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                               double *out) {
    const tss__damping *m = (const tss__damping *)user;
    if (TSS__DIM(m->e->dim) == 3)
        tss__damping_value_tiles(3, m, c, x, &ids, out);
    else
        tss__damping_value_tiles(2, m, c, x, &ids, out);
}

static void tss__damping_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                  double *out) {
    const tss__damping *m = (const tss__damping *)user;
    if (TSS__DIM(m->e->dim) == 3)
        tss__damping_gradient_tiles(3, m, c, x, &ids, out);
    else
        tss__damping_gradient_tiles(2, m, c, x, &ids, out);
}

static void tss__damping_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                 int psd, double *out) {
    const tss__damping *m = (const tss__damping *)user;
    const int d = m->e->dim, n = d * (d + 1);
    const double scale = tss__damping_scale(m, c);
    (void)x, (void)psd;
    for (int at = 0; at < ids.count; at += TSS_LANES) {
        tss__tile t;
        TSS__ALIGN tss__stretch copy;
        TSS__ALIGN tss__lanes W[144];
        double *o = out + (size_t)at * (size_t)(n * n);
        tss__tile_cells(m->e, &ids, at, &t);
        tss__tile_assemble(d, &t, tss__frozen_of(m, &ids, &t, &copy), W);
        tss__tile_scatter(n * n, t.used, W, o);
        for (int i = 0; i < t.used * n * n; i++) o[i] *= scale;
    }
}

static tss_result tss__damping_lists(void *user, const tss_ctx *c, const double *x, const double *d,
                                     double t_max, tss_stencils *out) {
    const tss__elastic *e = ((const tss__damping *)user)->e;
    (void)c, (void)x, (void)d, (void)t_max;
    out->count = e->cells, out->node = e->node, out->pattern = 1;
    return TSS_OK;
}

static void tss__damping_describe(void *user, const tss_ctx *c, int id, char *text, size_t size) {
    tss__elastic_describe(((tss__damping *)user)->e, c, id, text, size);
}

static void tss__damping_destroy(void *user, const tss_host *host) {
    tss__damping *m = (tss__damping *)user;
    if (!m) return;
    tss_free(host, m->frozen, (size_t)m->blocks * sizeof *m->frozen);
    tss_free(host, m, sizeof *m);
}

// Damping of e (material.damping > 0, not custom), which it reads and which must outlive it.
static tss_result tss__damping_create(const tss_host *host, tss__elastic *e, tss_energy_def *out) {
    if (!(e->material.damping >= 0) || e->material.kind == TSS_CUSTOM_MATERIAL)
        return TSS_ERROR_BAD_MATERIAL;
    tss__damping *m = (tss__damping *)tss_alloc(host, sizeof *m);
    if (!m) return TSS_ERROR_NO_MEMORY;
    m->e = e, m->blocks = e->blocks;
    m->frozen = (tss__stretch *)tss_alloc(host, (size_t)e->blocks * sizeof *m->frozen);
    if (!m->frozen) {
        tss_free(host, m, sizeof *m);
        return TSS_ERROR_NO_MEMORY;
    }
    memset(m->frozen, 0, (size_t)e->blocks * sizeof *m->frozen);
    *out = tss_energy_def_default();
    out->name = "damping";
    out->arity = e->dim + 1;
    out->flags = TSS_ENERGY_TIMES_AH2 | TSS_ENERGY_SECANT_OK;
    out->user = m;
    out->lists = tss__damping_lists;
    out->value = tss__damping_value;
    out->gradient = tss__damping_gradient;
    out->hessian = tss__damping_hessian;
    out->begin_step = tss__damping_begin;
    out->describe = tss__damping_describe;
    out->destroy = tss__damping_destroy;
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>membranes (private)
// Triangles in 3D, eight at a time. F = [x_1 − x_0, x_2 − x_0] Dm⁻¹ is 3 × 2; strain
// delta = FᵀF − I. P = F S with S = mu delta + lambda/2 tr I (StVK), or
// S = C⁻¹ (mu delta + lambda ln J I) (Neo-Hookean). For the Hessian F gets a third column of zeros:
// its SVD gives U with the normal as third column, and the frame of >>stretch_hessian holds with a
// 2 × 2 stretch block, one flip and twist pair, and for dF out of the plane psi_a/sigma_a.
// ---------------------------------------------------------------------------------------------

typedef struct tss__membrane {
    int triangles, blocks;
    tss_material_kind kind;
    double mu, lambda;   // lambda of plane stress
    int *node;           // triangles × 3
    tss__lanes *inv;     // blocks × 4
    tss__lanes *weight;  // blocks: area × thickness
} tss__membrane;

typedef struct tss__sheet {
    TSS__ALIGN tss__lanes F[6];  // 3 × 2
    TSS__ALIGN tss__lanes inv[4];
    TSS__ALIGN tss__lanes weight, tr, det, delta2, J2;
    TSS__ALIGN tss__lanes delta[3];  // xx yy xy; det = det delta, J2 = det C
    int used;
} tss__sheet;

static void tss__sheet_load(const tss__membrane *m, const double *x, const tss_ids *ids, int at,
                            tss__sheet *s) {
    TSS__ALIGN tss__lanes D[6];
    s->used = ids->count - at < TSS_LANES ? ids->count - at : TSS_LANES;
    for (int l = 0; l < TSS_LANES; l++) {
        const int k = at + (l < s->used ? l : s->used - 1),
                  id = ids->list ? ids->list[k] : ids->first + k;
        const int *n = m->node + (size_t)id * 3, b = id / TSS_LANES, lane = id % TSS_LANES;
        for (int e = 0; e < 2; e++)
            for (int r = 0; r < 3; r++)
                D[r * 2 + e][l] =
                    x[(size_t)n[e + 1] * 3 + (size_t)r] - x[(size_t)n[0] * 3 + (size_t)r];
        for (int i = 0; i < 4; i++) s->inv[i][l] = m->inv[(size_t)b * 4 + (size_t)i][lane];
        s->weight[l] = m->weight[b][lane];
    }
    for (int r = 0; r < 3; r++)
        TSS__EACH_LANE (l) {
            double a = D[r * 2][l], b = D[r * 2 + 1][l];
            s->F[r * 2][l] = a * s->inv[0][l] + b * s->inv[2][l];
            s->F[r * 2 + 1][l] = a * s->inv[1][l] + b * s->inv[3][l];
        }
}

static void tss__sheet_strain(tss__sheet *s) {
    TSS__EACH_LANE (l) {
        double a = s->F[0][l], b = s->F[1][l], c = s->F[2][l], d = s->F[3][l];
        double e = s->F[4][l], f = s->F[5][l];
        double xx = a * a + c * c + e * e - 1, yy = b * b + d * d + f * f - 1,
               xy = a * b + c * d + e * f;
        // det C as the squared area: no cancellation where the triangle is thin.
        double nx = c * f - e * d, ny = e * b - a * f, nz = a * d - c * b;
        s->delta[0][l] = xx, s->delta[1][l] = yy, s->delta[2][l] = xy;
        s->tr[l] = xx + yy, s->det[l] = xx * yy - xy * xy;
        s->delta2[l] = xx * xx + yy * yy + 2 * (xy * xy);
        s->J2[l] = nx * nx + ny * ny + nz * nz;
    }
}

// ln det C = 2 ln J and tr − ln det C, as tss__log_J2 but from J².
TSS__INLINE double tss__log_det_C(double tr, double det, double delta2, double J2, double *gap) {
    double k, f, e = tr + det;
    int small = delta2 <= TSS__SMALL_STRAIN;
    tss__split(J2, &k, &f);
    k = small ? 0.0 : k;
    f = small ? e : f;
    double tail = tss__log_tail(f), y = tss__log_join(k, f, tail);
    *gap = small ? tail - det : tr - y;
    return y;
}

static void tss__membrane_value(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                double *out) {
    const tss__membrane *m = (const tss__membrane *)user;
    const double mu = m->mu, lambda = m->lambda;
    (void)c;
    for (int at = 0; at < ids.count; at += TSS_LANES) {
        tss__sheet s;
        TSS__ALIGN tss__lanes v;
        tss__sheet_load(m, x, &ids, at, &s);
        tss__sheet_strain(&s);
        if (m->kind == TSS_STVK)
            TSS__EACH_LANE (l)
                v[l] = 0.25 * mu * s.delta2[l] + 0.125 * lambda * (s.tr[l] * s.tr[l]);
        else
            TSS__EACH_LANE (l) {
                double gap, y = tss__log_det_C(s.tr[l], s.det[l], s.delta2[l], s.J2[l], &gap);
                double psi = 0.5 * mu * gap + 0.125 * lambda * (y * y);
                v[l] = s.J2[l] > 0 ? psi : HUGE_VAL;
            }
        for (int l = 0; l < s.used; l++) out[at + l] = s.weight[l] * v[l];
    }
}

// The symmetric factor S of P = F S, xx yy xy.
static void tss__sheet_stress(const tss__membrane *m, tss__sheet *s, tss__lanes *S) {
    const double mu = m->mu, lambda = m->lambda;
    if (m->kind == TSS_STVK) {
        TSS__EACH_LANE (l) {
            double t = 0.5 * lambda * s->tr[l];
            S[0][l] = mu * s->delta[0][l] + t, S[1][l] = mu * s->delta[1][l] + t;
            S[2][l] = mu * s->delta[2][l];
        }
        return;
    }
    TSS__EACH_LANE (l) {
        double gap, y = tss__log_det_C(s->tr[l], s->det[l], s->delta2[l], s->J2[l], &gap);
        double xx = s->delta[0][l], yy = s->delta[1][l], xy = s->delta[2][l];
        // adj(C) (mu delta + t I)/det C; adj(C) delta = adj(I + delta) delta = delta + det delta I.
        double i = 1 / s->J2[l], a = mu * i, t = 0.5 * lambda * y * i;
        S[0][l] = a * (xx + s->det[l]) + t * (1 + yy);
        S[1][l] = a * (yy + s->det[l]) + t * (1 + xx);
        S[2][l] = (a - t) * xy;
    }
}

static void tss__membrane_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                   double *out) {
    const tss__membrane *m = (const tss__membrane *)user;
    (void)c;
    for (int at = 0; at < ids.count; at += TSS_LANES) {
        tss__sheet s;
        TSS__ALIGN tss__lanes S[3];
        TSS__ALIGN tss__lanes G[9];
        tss__sheet_load(m, x, &ids, at, &s);
        tss__sheet_strain(&s);
        tss__sheet_stress(m, &s, S);
        for (int r = 0; r < 3; r++)
            TSS__EACH_LANE (l) {
                double a = s.F[r * 2][l], b = s.F[r * 2 + 1][l], w = s.weight[l];
                double p = w * (a * S[0][l] + b * S[2][l]), q = w * (a * S[2][l] + b * S[1][l]);
                double g1 = p * s.inv[0][l] + q * s.inv[1][l];
                double g2 = p * s.inv[2][l] + q * s.inv[3][l];
                G[r][l] = -(g1 + g2), G[3 + r][l] = g1, G[6 + r][l] = g2;
            }
        tss__tile_scatter(9, s.used, G, out + at * 9);
    }
}

// Eigenvalues in the frame; the pairs (a, normal) as flip = twist = psi_a/sigma_a.
static void tss__sheet_stretch(const tss__membrane *m, tss__stretch *h) {
    const double mu = m->mu, lambda = m->lambda;
    const int stvk = m->kind == TSS_STVK;
    TSS__EACH_LANE (l) {
        double a = h->f.sigma[0][l], b = h->f.sigma[1][l], a2 = a * a, b2 = b * b, ab = a * b;
        double half = 0.5 * lambda * (a2 + b2 - 2), c = mu - lambda * tss__log(ab), i = 1 / ab;
        double ia = 1 / a2, ib = 1 / b2;
        h->S[0][l] = stvk ? mu * (3 * a2 - 1) + half + lambda * a2 : mu + (c + lambda) * ia;
        h->S[1][l] = stvk ? mu * (3 * b2 - 1) + half + lambda * b2 : mu + (c + lambda) * ib;
        h->S[5][l] = stvk ? lambda * ab : lambda * i;
        h->flip[2][l] = stvk ? mu * (a2 + ab + b2 - 1) + half : mu + c * i;
        h->twist[2][l] = stvk ? mu * (a2 - ab + b2 - 1) + half : mu - c * i;
        double na = stvk ? mu * (a2 - 1) + half : mu - c * ia;
        double nb = stvk ? mu * (b2 - 1) + half : mu - c * ib;
        h->flip[1][l] = na, h->twist[1][l] = na;
        h->flip[0][l] = nb, h->twist[0][l] = nb;
    }
}

static void tss__membrane_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                  int psd, double *out) {
    const tss__membrane *m = (const tss__membrane *)user;
    (void)c;
    for (int at = 0; at < ids.count; at += TSS_LANES) {
        tss__sheet s;
        TSS__ALIGN tss__lanes F[9];
        TSS__ALIGN tss__lanes b[6];
        TSS__ALIGN tss__lanes W[81];
        TSS__ALIGN tss__stretch h;
        tss__sheet_load(m, x, &ids, at, &s);
        for (int r = 0; r < 3; r++)
            TSS__EACH_LANE (l)
                F[r * 3][l] = s.F[r * 2][l], F[r * 3 + 1][l] = s.F[r * 2 + 1][l],
                      F[r * 3 + 2][l] = 0;
        tss__svd_one(3, F, &h.f);
        tss__sheet_stretch(m, &h);
        tss__stretch_finish(2, psd, s.weight, &h);
        for (int k = 0; k < 2; k++)
            TSS__EACH_LANE (l) {
                double p = s.inv[k * 2][l], q = s.inv[k * 2 + 1][l];
                b[k * 3][l] = p * h.f.V[0][l] + q * h.f.V[3][l];
                b[k * 3 + 1][l] = p * h.f.V[1][l] + q * h.f.V[4][l];
                b[k * 3 + 2][l] = 0;
            }
        tss__assemble(3, 2, b, &h, W);
        tss__tile_scatter(81, s.used, W, out + (size_t)at * 81);
    }
}

static tss_result tss__membrane_lists(void *user, const tss_ctx *c, const double *x,
                                      const double *d, double t_max, tss_stencils *out) {
    const tss__membrane *m = (const tss__membrane *)user;
    (void)c, (void)x, (void)d, (void)t_max;
    out->count = m->triangles, out->node = m->node, out->pattern = 1;
    return TSS_OK;
}

static void tss__membrane_describe(void *user, const tss_ctx *c, int id, char *text, size_t size) {
    const int *n = ((const tss__membrane *)user)->node + (size_t)id * 3;
    (void)c;
    snprintf(text, size, "membrane triangle %d (nodes %d %d %d)", id, n[0], n[1], n[2]);
}

static void tss__membrane_destroy(void *user, const tss_host *host) {
    tss__membrane *m = (tss__membrane *)user;
    if (!m) return;
    tss_free(host, m->node, (size_t)m->triangles * 3 * sizeof *m->node);
    tss_free(host, m->inv, (size_t)m->blocks * 4 * sizeof *m->inv);
    tss_free(host, m->weight, (size_t)m->blocks * sizeof *m->weight);
    tss_free(host, m, sizeof *m);
}

// Rest triangle in its own plane: Dm = [|a|, a·b/|a|; 0, |a × b|/|a|]. 0 if it has no area.
static int tss__membrane_rest(tss__membrane *m, int slot, const double *X, double thickness) {
    const int t = slot < m->triangles ? slot : m->triangles - 1, *n = m->node + (size_t)t * 3;
    const size_t b = (size_t)(slot / TSS_LANES), l = (size_t)(slot % TSS_LANES);
    const double *p = X + (size_t)n[0] * 3, *q = X + (size_t)n[1] * 3, *r = X + (size_t)n[2] * 3;
    const double u[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]};
    const double v[3] = {r[0] - p[0], r[1] - p[1], r[2] - p[2]};
    const double x = u[1] * v[2] - u[2] * v[1], y = u[2] * v[0] - u[0] * v[2];
    const double z = u[0] * v[1] - u[1] * v[0], area2 = sqrt(x * x + y * y + z * z);
    const double length = sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
    const double along = (u[0] * v[0] + u[1] * v[1] + u[2] * v[2]) / length, high = area2 / length;
    if (!(area2 > 0) || !(high > 0) || !(area2 <= 1e300)) return 0;
    m->inv[b * 4][l] = 1 / length, m->inv[b * 4 + 1][l] = -along / (length * high);
    m->inv[b * 4 + 2][l] = 0, m->inv[b * 4 + 3][l] = 1 / high;
    m->weight[b][l] = 0.5 * area2 * thickness;
    return 1;
}

static int tss__nodes_ok(const int *node, size_t count) {
    if (!node) return 0;
    for (size_t i = 0; i < count; i++)
        if (node[i] < 0) return 0;
    return 1;
}

tss_membrane_def tss_membrane_def_default(void) {
    tss_membrane_def d;
    memset(&d, 0, sizeof d);
    d.thickness = 1e-3;
    d.material = tss_material_default();
    return d;
}

static tss__membrane *tss__membrane_alloc(const tss_host *host, const tss_membrane_def *def) {
    tss__membrane *m = (tss__membrane *)tss_alloc(host, sizeof *m);
    if (!m) return NULL;
    memset(m, 0, sizeof *m);
    m->triangles = def->triangles, m->blocks = (def->triangles - 1) / TSS_LANES + 1;
    m->node = (int *)tss_alloc(host, (size_t)m->triangles * 3 * sizeof *m->node);
    m->inv = (tss__lanes *)tss_alloc(host, (size_t)m->blocks * 4 * sizeof *m->inv);
    m->weight = (tss__lanes *)tss_alloc(host, (size_t)m->blocks * sizeof *m->weight);
    if (m->node && m->inv && m->weight) return m;
    tss__membrane_destroy(m, host);
    return NULL;
}

// An energy of forces: times αh², the pattern fixed.
static tss_energy_def tss__thin_energy(const char *name, int arity, void *user) {
    tss_energy_def d = tss_energy_def_default();
    d.name = name, d.arity = arity, d.user = user, d.flags = TSS_ENERGY_TIMES_AH2;
    return d;
}

tss_result tss_membrane_energy(const tss_host *host, const tss_membrane_def *def,
                               tss_energy_def *out) {
    if (!def || !out || !host || def->triangles < 1 || !def->X || !(def->thickness > 0) ||
        !tss__nodes_ok(def->node, (size_t)def->triangles * 3))
        return TSS_ERROR_BAD_ARGUMENT;
    if (!TSS__THIN_3D) return tss__refuse(host, "membranes", tss__thin_left_out(3));
    const tss_material *mat = &def->material;
    if ((mat->kind != TSS_STVK && mat->kind != TSS_NEO_HOOKEAN) ||
        !tss__material_ok(mat->E, mat->nu, mat->rho))
        return TSS_ERROR_BAD_MATERIAL;
    tss__membrane *m = tss__membrane_alloc(host, def);
    if (!m) return TSS_ERROR_NO_MEMORY;
    m->kind = mat->kind;
    tss_lame(mat->E, mat->nu, &m->mu, NULL);
    m->lambda = mat->E * mat->nu / (1 - mat->nu * mat->nu);
    memcpy(m->node, def->node, (size_t)m->triangles * 3 * sizeof *m->node);
    for (int s = 0; s < m->blocks * TSS_LANES; s++)
        if (!tss__membrane_rest(m, s, def->X, def->thickness)) {
            tss__membrane_destroy(m, host);
            return TSS_ERROR_BAD_MESH;
        }
    *out = tss__thin_energy("membrane", 3, m);
    out->lists = tss__membrane_lists;
    out->value = tss__membrane_value;
    out->gradient = tss__membrane_gradient;
    out->hessian = tss__membrane_hessian;
    out->describe = tss__membrane_describe;
    out->destroy = tss__membrane_destroy;
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>hinges (private)
// e = x_1 − x_0, a = x_2 − x_0, b = x_3 − x_0; normals m = e × a of (0, 1, 2), n = b × e of
// (1, 0, 3).
// theta = atan2(−(m × n)·ê, m·n) with derivatives
//     g_2 = |e| m/|m|²,  g_3 = |e| n/|n|²,  g_1 = −s_a g_2 − s_b g_3,  g_0 = −g_1 − g_2 − g_3,
// s_a = a·e/|e|² the foot of x_2 on the edge; their derivatives give ∇²theta row by row. A triangle
// without area has no normal: its terms are cut off (1e-290); the gradient grows as 1/height.
// ---------------------------------------------------------------------------------------------

typedef struct tss__hinges {
    int count;
    int *node;              // count × 4
    double *weight, *rest;  // 3 k ‖e‖²/(A_1 + A_2); angle
} tss__hinges;

typedef struct tss__hinge {
    double e[3], a[3], b[3], m[3], n[3];
    double length, ee, mm, nn, sa, sb;  // |e|, squares, feet
} tss__hinge;

static void tss__cross(const double *a, const double *b, double *c) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static double tss__dot(const double *a, const double *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void tss__hinge_load(const int *node, const double *x, tss__hinge *h) {
    const double *o = x + (size_t)node[0] * 3;
    for (int r = 0; r < 3; r++) {
        h->e[r] = x[(size_t)node[1] * 3 + (size_t)r] - o[r];
        h->a[r] = x[(size_t)node[2] * 3 + (size_t)r] - o[r];
        h->b[r] = x[(size_t)node[3] * 3 + (size_t)r] - o[r];
    }
    tss__cross(h->e, h->a, h->m);
    tss__cross(h->b, h->e, h->n);
    h->ee = tss__dot(h->e, h->e), h->mm = tss__dot(h->m, h->m), h->nn = tss__dot(h->n, h->n);
    if (h->ee < 1e-290) h->ee = 1e-290;
    if (h->mm < 1e-290) h->mm = 1e-290;
    if (h->nn < 1e-290) h->nn = 1e-290;
    h->length = sqrt(h->ee);
    h->sa = tss__dot(h->a, h->e) / h->ee, h->sb = tss__dot(h->b, h->e) / h->ee;
}

static double tss__hinge_angle(const tss__hinge *h) {
    double c[3];
    tss__cross(h->m, h->n, c);
    return atan2(-tss__dot(c, h->e) / h->length, tss__dot(h->m, h->n));
}

// theta − rest on the shorter way round.
static double tss__hinge_bend(const tss__hinge *h, double rest) {
    const double pi = 3.14159265358979323846, t = tss__hinge_angle(h) - rest;
    return t > pi ? t - 2 * pi : t < -pi ? t + 2 * pi : t;
}

static void tss__hinge_gradient(const tss__hinge *h, double *g) {
    for (int r = 0; r < 3; r++) {
        const double p = h->length * h->m[r] / h->mm, q = h->length * h->n[r] / h->nn;
        g[6 + r] = p, g[9 + r] = q;
        g[3 + r] = -h->sa * p - h->sb * q;
        g[r] = -(g[3 + r] + p + q);
    }
}

// Derivative of g = |e| m/|m|² (m = e × a; 'sign' −1: m = a × e) by e and by a, 3 × 3 each:
// m/|m|² ⊗ ê + |e|/|m|² (I − 2 m̂m̂ᵀ) ∂m.
static void tss__wing_derivative(const tss__hinge *h, const double *a, const double *m, double mm,
                                 double sign, double *by_e, double *by_a) {
    for (int c = 0; c < 3; c++) {
        double unit[3] = {0, 0, 0}, de[3], da[3];
        unit[c] = sign;
        tss__cross(unit, a, de);     // ∂m/∂e_c
        tss__cross(h->e, unit, da);  // ∂m/∂a_c
        const double te = 2 * tss__dot(m, de) / mm, ta = 2 * tss__dot(m, da) / mm;
        for (int r = 0; r < 3; r++) {
            by_e[r * 3 + c] = (m[r] * h->e[c] / h->length + h->length * (de[r] - te * m[r])) / mm;
            by_a[r * 3 + c] = h->length * (da[r] - ta * m[r]) / mm;
        }
    }
}

// Adds s·B to the block (i, j) of H, for derivatives by an edge vector x_j − x_0.
static void tss__add_edge_block(double *H, int i, int j, double s, const double *B) {
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) {
            H[(i * 3 + r) * 12 + j * 3 + c] += s * B[r * 3 + c];
            H[(i * 3 + r) * 12 + c] -= s * B[r * 3 + c];
        }
}

// Rows of ∇²theta that wing w (node 2 or 3) gives: those of g_w, and −s g_w in row 1.
static void tss__wing_rows(const tss__hinge *h, int w, double *H) {
    const double *a = w == 2 ? h->a : h->b, *m = w == 2 ? h->m : h->n;
    const double mm = w == 2 ? h->mm : h->nn, s = w == 2 ? h->sa : h->sb;
    double by_e[9], by_a[9], foot_e[9], foot_a[9];
    tss__wing_derivative(h, a, m, mm, w == 2 ? 1 : -1, by_e, by_a);
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 3; c++) {
            const double g = h->length * m[r] / mm;
            foot_e[r * 3 + c] = g * (a[c] - 2 * s * h->e[c]) / h->ee;
            foot_a[r * 3 + c] = g * h->e[c] / h->ee;
        }
    tss__add_edge_block(H, w, 1, 1, by_e), tss__add_edge_block(H, w, w, 1, by_a);
    tss__add_edge_block(H, 1, 1, -s, by_e), tss__add_edge_block(H, 1, w, -s, by_a);
    tss__add_edge_block(H, 1, 1, -1, foot_e), tss__add_edge_block(H, 1, w, -1, foot_a);
}

static void tss__hinge_hessian(const tss__hinge *h, double *H) {
    memset(H, 0, 144 * sizeof *H);
    tss__wing_rows(h, 2, H);
    tss__wing_rows(h, 3, H);
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 12; c++)
            H[r * 12 + c] = -(H[(3 + r) * 12 + c] + H[(6 + r) * 12 + c] + H[(9 + r) * 12 + c]);
    for (int r = 0; r < 12; r++)
        for (int c = 0; c < r; c++)
            H[r * 12 + c] = H[c * 12 + r] = 0.5 * (H[r * 12 + c] + H[c * 12 + r]);
}

static void tss__hinges_value(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                              double *out) {
    const tss__hinges *e = (const tss__hinges *)user;
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        const int id = ids.list ? ids.list[k] : ids.first + k;
        tss__hinge h;
        tss__hinge_load(e->node + (size_t)id * 4, x, &h);
        const double t = tss__hinge_bend(&h, e->rest[id]);
        out[k] = 0.5 * e->weight[id] * (t * t);
    }
}

static void tss__hinges_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                 double *out) {
    const tss__hinges *e = (const tss__hinges *)user;
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        const int id = ids.list ? ids.list[k] : ids.first + k;
        tss__hinge h;
        tss__hinge_load(e->node + (size_t)id * 4, x, &h);
        const double f = e->weight[id] * tss__hinge_bend(&h, e->rest[id]);
        tss__hinge_gradient(&h, out + k * 12);
        for (int i = 0; i < 12; i++) out[k * 12 + i] *= f;
    }
}

static void tss__hinges_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids, int psd,
                                double *out) {
    const tss__hinges *e = (const tss__hinges *)user;
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        const int id = ids.list ? ids.list[k] : ids.first + k;
        double g[12], *H = out + (size_t)k * 144, bend = 0;
        tss__hinge h;
        tss__hinge_load(e->node + (size_t)id * 4, x, &h);
        tss__hinge_gradient(&h, g);
        if (psd)
            memset(H, 0, 144 * sizeof *H);
        else
            tss__hinge_hessian(&h, H), bend = tss__hinge_bend(&h, e->rest[id]);
        for (int r = 0; r < 12; r++)
            for (int j = 0; j < 12; j++)
                H[r * 12 + j] = e->weight[id] * (g[r] * g[j] + bend * H[r * 12 + j]);
    }
}

static tss_result tss__hinges_lists(void *user, const tss_ctx *c, const double *x, const double *d,
                                    double t_max, tss_stencils *out) {
    const tss__hinges *e = (const tss__hinges *)user;
    (void)c, (void)x, (void)d, (void)t_max;
    out->count = e->count, out->node = e->node, out->pattern = 1;
    return TSS_OK;
}

static void tss__hinges_describe(void *user, const tss_ctx *c, int id, char *text, size_t size) {
    const int *n = ((const tss__hinges *)user)->node + (size_t)id * 4;
    (void)c;
    snprintf(text, size, "hinge %d (edge %d %d, wings %d %d)", id, n[0], n[1], n[2], n[3]);
}

static void tss__hinges_destroy(void *user, const tss_host *host) {
    tss__hinges *e = (tss__hinges *)user;
    if (!e) return;
    tss_free(host, e->node, (size_t)e->count * 4 * sizeof *e->node);
    tss_free(host, e->weight, (size_t)e->count * sizeof *e->weight);
    tss_free(host, e->rest, (size_t)e->count * sizeof *e->rest);
    tss_free(host, e, sizeof *e);
}

tss_hinge_def tss_hinge_def_default(void) {
    tss_hinge_def d;
    memset(&d, 0, sizeof d);
    d.stiffness = 1e-4;
    return d;
}

static tss__hinges *tss__hinges_alloc(const tss_host *host, int count) {
    tss__hinges *e = (tss__hinges *)tss_alloc(host, sizeof *e);
    if (!e) return NULL;
    memset(e, 0, sizeof *e);
    e->count = count;
    e->node = (int *)tss_alloc(host, (size_t)count * 4 * sizeof *e->node);
    e->weight = (double *)tss_alloc(host, (size_t)count * sizeof *e->weight);
    e->rest = (double *)tss_alloc(host, (size_t)count * sizeof *e->rest);
    if (e->node && e->weight && e->rest) return e;
    tss__hinges_destroy(e, host);
    return NULL;
}

tss_result tss_hinge_energy(const tss_host *host, const tss_hinge_def *def, tss_energy_def *out) {
    if (!host || !def || !out || def->hinges < 1 || !def->X || !(def->stiffness > 0) ||
        !tss__nodes_ok(def->node, (size_t)def->hinges * 4))
        return TSS_ERROR_BAD_ARGUMENT;
    if (!TSS__THIN_3D) return tss__refuse(host, "hinges", tss__thin_left_out(3));
    tss__hinges *e = tss__hinges_alloc(host, def->hinges);
    if (!e) return TSS_ERROR_NO_MEMORY;
    memcpy(e->node, def->node, (size_t)def->hinges * 4 * sizeof *e->node);
    for (int i = 0; i < def->hinges; i++) {
        tss__hinge h;
        tss__hinge_load(e->node + (size_t)i * 4, def->X, &h);
        if (!(h.mm > 1e-290) || !(h.nn > 1e-290)) {
            tss__hinges_destroy(e, host);
            return TSS_ERROR_BAD_MESH;
        }
        e->weight[i] = 6 * def->stiffness * h.ee / (sqrt(h.mm) + sqrt(h.nn));
        e->rest[i] = def->rest_angle ? def->rest_angle[i] : tss__hinge_angle(&h);
    }
    *out = tss__thin_energy("hinges", 4, e);
    out->lists = tss__hinges_lists;
    out->value = tss__hinges_value;
    out->gradient = tss__hinges_gradient;
    out->hessian = tss__hinges_hessian;
    out->describe = tss__hinges_describe;
    out->destroy = tss__hinges_destroy;
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>springs (private)
// With u = (x_b − x_a)/l: gradient k (l − L) u, Hessian k (uuᵀ + (1 − L/l)(I − uuᵀ)); the second
// factor is what the projection clamps. At l = 0 the direction is lost: no force then.
// ---------------------------------------------------------------------------------------------

typedef struct tss__springs {
    int count, dim;
    int *node;  // count × 2
    double *k, *rest;
} tss__springs;

// Unit direction and length.
static double tss__spring_load(const tss__springs *e, int id, const double *x, double *u) {
    const size_t d = (size_t)e->dim;
    const double *p = x + (size_t)e->node[2 * id] * d, *q = x + (size_t)e->node[2 * id + 1] * d;
    u[2] = 0;
    for (size_t r = 0; r < d; r++) u[r] = q[r] - p[r];
    const double l = sqrt(tss__dot(u, u));
    for (size_t r = 0; r < d; r++) u[r] = l > 0 ? u[r] / l : 0;
    return l;
}

static void tss__springs_value(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                               double *out) {
    const tss__springs *e = (const tss__springs *)user;
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        const int id = ids.list ? ids.list[k] : ids.first + k;
        double u[3];
        const double s = tss__spring_load(e, id, x, u) - e->rest[id];
        out[k] = 0.5 * e->k[id] * (s * s);
    }
}

static void tss__springs_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                  double *out) {
    const tss__springs *e = (const tss__springs *)user;
    const int d = e->dim;
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        const int id = ids.list ? ids.list[k] : ids.first + k;
        double u[3], *g = out + k * 2 * d;
        const double f = e->k[id] * (tss__spring_load(e, id, x, u) - e->rest[id]);
        for (int r = 0; r < d; r++) g[r] = -f * u[r], g[d + r] = f * u[r];
    }
}

static void tss__springs_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids,
                                 int psd, double *out) {
    const tss__springs *e = (const tss__springs *)user;
    const int d = e->dim, n = 2 * d;
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        const int id = ids.list ? ids.list[k] : ids.first + k;
        double u[3], *H = out + k * n * n;
        const double l = tss__spring_load(e, id, x, u), L = e->rest[id];
        double across = L > 0 ? 1 - L / (l > 1e-290 ? l : 1e-290) : 1;
        if (psd && across < 0) across = 0;
        for (int r = 0; r < d; r++)
            for (int j = 0; j < d; j++) {
                const double v = e->k[id] * (u[r] * u[j] + across * ((r == j) - u[r] * u[j]));
                H[r * n + j] = H[(d + r) * n + d + j] = v;
                H[r * n + d + j] = H[(d + r) * n + j] = -v;
            }
    }
}

static tss_result tss__springs_lists(void *user, const tss_ctx *c, const double *x, const double *d,
                                     double t_max, tss_stencils *out) {
    const tss__springs *e = (const tss__springs *)user;
    (void)c, (void)x, (void)d, (void)t_max;
    out->count = e->count, out->node = e->node, out->pattern = 1;
    return TSS_OK;
}

static void tss__springs_describe(void *user, const tss_ctx *c, int id, char *text, size_t size) {
    const int *n = ((const tss__springs *)user)->node + (size_t)id * 2;
    (void)c;
    snprintf(text, size, "spring %d (nodes %d %d)", id, n[0], n[1]);
}

static void tss__springs_destroy(void *user, const tss_host *host) {
    tss__springs *e = (tss__springs *)user;
    if (!e) return;
    tss_free(host, e->node, (size_t)e->count * 2 * sizeof *e->node);
    tss_free(host, e->k, (size_t)e->count * sizeof *e->k);
    tss_free(host, e->rest, (size_t)e->count * sizeof *e->rest);
    tss_free(host, e, sizeof *e);
}

tss_spring_def tss_spring_def_default(void) {
    tss_spring_def d;
    memset(&d, 0, sizeof d);
    d.dim = 3;
    d.stiffness = 1;
    return d;
}

static tss__springs *tss__springs_alloc(const tss_host *host, int count, int dim) {
    tss__springs *e = (tss__springs *)tss_alloc(host, sizeof *e);
    if (!e) return NULL;
    memset(e, 0, sizeof *e);
    e->count = count, e->dim = dim;
    e->node = (int *)tss_alloc(host, (size_t)count * 2 * sizeof *e->node);
    e->k = (double *)tss_alloc(host, (size_t)count * sizeof *e->k);
    e->rest = (double *)tss_alloc(host, (size_t)count * sizeof *e->rest);
    if (e->node && e->k && e->rest) return e;
    tss__springs_destroy(e, host);
    return NULL;
}

// Stiffness and rest length of each spring.
static tss_result tss__springs_fill(tss__springs *e, const tss_spring_def *def) {
    for (int i = 0; i < e->count; i++) {
        double u[3];
        e->k[i] = def->stiffnesses ? def->stiffnesses[i] : def->stiffness;
        e->rest[i] = def->rest_length ? def->rest_length[i] : tss__spring_load(e, i, def->X, u);
        if (!(e->k[i] > 0) || !(e->k[i] <= 1e300)) return TSS_ERROR_BAD_MATERIAL;
        if (!(e->rest[i] >= 0) || !(e->rest[i] <= 1e300)) return TSS_ERROR_BAD_ARGUMENT;
        if (e->node[2 * i] == e->node[2 * i + 1]) return TSS_ERROR_BAD_MESH;
    }
    return TSS_OK;
}

tss_result tss_spring_energy(const tss_host *host, const tss_spring_def *def, tss_energy_def *out) {
    if (!host || !def || !out || def->springs < 1 || (def->dim != 2 && def->dim != 3) ||
        (!def->X && !def->rest_length) || !tss__nodes_ok(def->node, (size_t)def->springs * 2))
        return TSS_ERROR_BAD_ARGUMENT;
    if (!TSS__THIN || tss__thin_left_out(def->dim))
        return tss__refuse(host, "springs", tss__thin_left_out(def->dim));
    tss__springs *e = tss__springs_alloc(host, def->springs, def->dim);
    if (!e) return TSS_ERROR_NO_MEMORY;
    memcpy(e->node, def->node, (size_t)def->springs * 2 * sizeof *e->node);
    const tss_result r = tss__springs_fill(e, def);
    if (r != TSS_OK) {
        tss__springs_destroy(e, host);
        return r;
    }
    *out = tss__thin_energy("springs", 2, e);
    out->lists = tss__springs_lists;
    out->value = tss__springs_value;
    out->gradient = tss__springs_gradient;
    out->hessian = tss__springs_hessian;
    out->describe = tss__springs_describe;
    out->destroy = tss__springs_destroy;
    return TSS_OK;
}

#if defined(__clang__)
#pragma clang diagnostic pop
#elif defined(__GNUC__)
#pragma GCC pop_options
#endif

// ---------------------------------------------------------------------------------------------
// >>arrays (private)
// Grow-only arrays: a step allocates only when a high-water mark rises.
// ---------------------------------------------------------------------------------------------

typedef struct tss__buf {
    void *p;
    size_t bytes;
} tss__buf;

// Room for bytes; contents are lost when it grows. 0: no memory, the buffer is then empty. The old
// array goes first, so that two of the large ones are never held at once.
static int tss__buf_need(const tss_host *host, tss__buf *b, size_t bytes) {
    if (bytes <= b->bytes) return 1;
    // A quarter more for what creeps upwards (contacts); nothing more for what is huge.
    size_t want = bytes < ((size_t)1 << 26) ? bytes + bytes / 4 : bytes;
    tss_free(host, b->p, b->bytes);
    b->bytes = 0;
    b->p = tss_alloc(host, want);
    if (!b->p) return 0;
    b->bytes = want;
    return 1;
}

static void tss__buf_free(const tss_host *host, tss__buf *b) {
    tss_free(host, b->p, b->bytes);
    b->p = NULL;
    b->bytes = 0;
}

static int *tss__need_ints(const tss_host *host, tss__buf *b, size_t count) {
    return tss__buf_need(host, b, (count + 1) * sizeof(int)) ? (int *)b->p : NULL;
}

static int64_t *tss__need_longs(const tss_host *host, tss__buf *b, size_t count) {
    return tss__buf_need(host, b, (count + 1) * sizeof(int64_t)) ? (int64_t *)b->p : NULL;
}

static double *tss__need_doubles(const tss_host *host, tss__buf *b, size_t count) {
    if (count > (SIZE_MAX >> 4)) return NULL;
    return tss__buf_need(host, b, (count + 8) * sizeof(double)) ? (double *)b->p : NULL;
}

static int tss__min_int(int a, int b) { return a < b ? a : b; }
static int tss__max_int(int a, int b) { return a > b ? a : b; }

// ---------------------------------------------------------------------------------------------
// >>dense_kernels (private)
// Column-major products and triangular solves of fixed shape, the ground of both Cholesky
// factorisations. The product C = β C + α A Bᵀ packs B in panels of NR columns, takes A in strips of
// MR rows and runs a register kernel over them (Goto and van de Geijn 2008): AVX-512 or AVX2 with
// fused multiply-adds where the processor has them (asked at run time), else whatever vectors the
// target has. The triangular parts are recursions over the product. An entry's sum runs over k in
// order, so tiles, strips and alignment do not change bits; the processor's kind does.
// Serial, no state, no memory but the stack (120 kB): threads work on different tiles. A BLAS was
// tried and dropped: Debian's serial OpenBLAS 0.3.21 returned wrong products in 2 of 1,000
// concurrent calls (its buffers are handed out without a lock), threaded ones change bits with the
// number of threads, and none was faster in the factorisation as a whole.
// ---------------------------------------------------------------------------------------------

enum { TSS__KC = 192, TSS__NC = 48, TSS__MR_MAX = 24, TSS__NR_MAX = 8 };

// One tile: C (w × v, w ≤ MR, v ≤ NR) = β C + α Â B̂; step p of Â is at a + p·as (MR rows; of a strip
// read in place only w), of B̂ at b + p·NR. β is 0 or 1.
typedef void tss__micro(int k, const double *a, ptrdiff_t as, const double *b, double alpha,
                        double beta, double *c, int ldc, int w, int v);

typedef struct tss__kernel {
    tss__micro *run;
    int mr, nr;
    int direct;  // strips are read in place (the kernel masks its loads)
} tss__kernel;

// C (w × v) = β C + α T, T the whole tile with leading dimension mr.
static void tss__store_tile(const double *t, int mr, double alpha, double beta, double *c, int ldc,
                            int w, int v) {
    for (int j = 0; j < v; j++, t += mr, c += ldc) {
        if (beta == 0) {
            for (int i = 0; i < w; i++) c[i] = alpha * t[i];
        } else {
            for (int i = 0; i < w; i++) c[i] += alpha * t[i];
        }
    }
}

// A vector as wide as the target's registers; a plain double elsewhere: the same code.
#if defined(__GNUC__) && defined(__AVX__)
#define TSS__VEC 4
#elif defined(__GNUC__)
#define TSS__VEC 2
#else
#define TSS__VEC 1
#endif
#if TSS__VEC > 1
typedef double tss__vec __attribute__((vector_size(TSS__VEC * 8)));
#else
typedef double tss__vec;
#endif

// 2 vectors × 4 columns: eight sums in registers.
static void tss__micro_any(int k, const double *a, ptrdiff_t as, const double *b, double alpha,
                           double beta, double *c, int ldc, int w, int v) {
    enum { MR = 2 * TSS__VEC };
    tss__vec s[8], a0, a1;
    double t[4 * MR];
    memset(s, 0, sizeof s);
    for (int p = 0; p < k; p++, a += as, b += 4) {
        memcpy(&a0, a, sizeof a0);
        memcpy(&a1, a + TSS__VEC, sizeof a1);
        s[0] += a0 * b[0], s[1] += a1 * b[0];
        s[2] += a0 * b[1], s[3] += a1 * b[1];
        s[4] += a0 * b[2], s[5] += a1 * b[2];
        s[6] += a0 * b[3], s[7] += a1 * b[3];
    }
    memcpy(t, s, sizeof t);
    tss__store_tile(t, MR, alpha, beta, c, ldc, w, v);
}

#ifdef TSS__X86

// What the processor has; tests define these as 0 to reach the other kernels.
#ifndef TSS__HAS_AVX512
#define TSS__HAS_AVX512 __builtin_cpu_supports("avx512f")
#endif
#ifndef TSS__HAS_AVX2
#define TSS__HAS_AVX2 (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
#endif

#define TSS__COLUMNS4(X) X(0) X(1) X(2) X(3)
#define TSS__COLUMNS8(X) TSS__COLUMNS4(X) X(4) X(5) X(6) X(7)

// 12 × 4 in twelve registers of four doubles.
__attribute__((target("avx2,fma"))) static void tss__micro_avx2(
    int k, const double *a, ptrdiff_t as, const double *b, double alpha, double beta, double *c,
    int ldc, int w, int v) {
    double t[48];
#define TSS__ZERO(j) __m256d s##j##0 = _mm256_setzero_pd(), s##j##1 = s##j##0, s##j##2 = s##j##0;
    TSS__COLUMNS4(TSS__ZERO)
    for (int p = 0; p < k; p++, a += as, b += 4) {
        __m256d a0 = _mm256_loadu_pd(a), a1 = _mm256_loadu_pd(a + 4), a2 = _mm256_loadu_pd(a + 8);
        __m256d f;
#define TSS__STEP(j)                                                                              \
    f = _mm256_broadcast_sd(b + (j));                                                             \
    s##j##0 = _mm256_fmadd_pd(a0, f, s##j##0);                                                    \
    s##j##1 = _mm256_fmadd_pd(a1, f, s##j##1);                                                    \
    s##j##2 = _mm256_fmadd_pd(a2, f, s##j##2);
        TSS__COLUMNS4(TSS__STEP)
    }
#define TSS__STORE(j)                                                                             \
    _mm256_storeu_pd(t + 12 * (j), s##j##0), _mm256_storeu_pd(t + 12 * (j) + 4, s##j##1);         \
    _mm256_storeu_pd(t + 12 * (j) + 8, s##j##2);
    TSS__COLUMNS4(TSS__STORE)
#undef TSS__ZERO
#undef TSS__STEP
#undef TSS__STORE
    tss__store_tile(t, 12, alpha, beta, c, ldc, w, v);
}

// 24 × 8 in twenty-four registers of eight doubles; 16 × 8 and 8 × 8 for what is left at the end
// of a column. Masks cut the last vector. C's lines are asked for before they are needed.
#define TSS__ZERO3(j) __m512d s##j##0 = _mm512_setzero_pd(), s##j##1 = s##j##0, s##j##2 = s##j##0;
#define TSS__ZERO2(j) __m512d s##j##0 = _mm512_setzero_pd(), s##j##1 = s##j##0;
#define TSS__ZERO1(j) __m512d s##j##0 = _mm512_setzero_pd();
#define TSS__LOAD1 __m512d f, a0 = _mm512_maskz_loadu_pd(m0, a);
#define TSS__LOAD2 TSS__LOAD1 __m512d a1 = _mm512_maskz_loadu_pd(m1, a + 8);
#define TSS__LOAD3 TSS__LOAD2 __m512d a2 = _mm512_maskz_loadu_pd(m2, a + 16);
#define TSS__STEP1(j) f = _mm512_set1_pd(b[j]), s##j##0 = _mm512_fmadd_pd(a0, f, s##j##0);
#define TSS__STEP2(j) TSS__STEP1(j) s##j##1 = _mm512_fmadd_pd(a1, f, s##j##1);
#define TSS__STEP3(j) TSS__STEP2(j) s##j##2 = _mm512_fmadd_pd(a2, f, s##j##2);
#define TSS__PART(m, s, at)                                                                       \
    _mm512_mask_storeu_pd(                                                                        \
        at, m,                                                                                    \
        beta == 0 ? _mm512_mul_pd(x, s) : _mm512_fmadd_pd(x, s, _mm512_maskz_loadu_pd(m, at)));
#define TSS__STORE1(j)                                                                            \
    if ((j) >= v) return;                                                                         \
    TSS__PART(m0, s##j##0, c + (ptrdiff_t)(j) * ldc)
#define TSS__STORE2(j) TSS__STORE1(j) TSS__PART(m1, s##j##1, c + (ptrdiff_t)(j) * ldc + 8)
#define TSS__STORE3(j) TSS__STORE2(j) TSS__PART(m2, s##j##2, c + (ptrdiff_t)(j) * ldc + 16)
#define TSS__MICRO512(name, V)                                                                    \
    __attribute__((target("avx512f"))) static void name(                                          \
        int k, const double *a, ptrdiff_t as, const double *b, double alpha, double beta,         \
        double *c, int ldc, int w, int v) {                                                       \
        unsigned rows = (1u << w) - 1;                                                            \
        __mmask8 m0 = (__mmask8)rows, m1 = (__mmask8)(rows >> 8), m2 = (__mmask8)(rows >> 16);    \
        __m512d x = _mm512_set1_pd(alpha);                                                        \
        (void)m1, (void)m2;                                                                       \
        for (int j = 0; j < v; j++) {                                                             \
            const char *line = (const char *)(c + (ptrdiff_t)j * ldc);                            \
            for (int i = 0; i < (V); i++) _mm_prefetch(line + 64 * i, _MM_HINT_T0);               \
        }                                                                                         \
        TSS__COLUMNS8(TSS__ZERO##V)                                                               \
        for (int p = 0; p < k; p++, a += as, b += 8) {                                            \
            TSS__LOAD##V TSS__COLUMNS8(TSS__STEP##V)                                              \
        }                                                                                         \
        TSS__COLUMNS8(TSS__STORE##V)                                                              \
    }
TSS__MICRO512(tss__micro512_24, 3)
TSS__MICRO512(tss__micro512_16, 2)
TSS__MICRO512(tss__micro512_8, 1)

static void tss__micro_avx512(int k, const double *a, ptrdiff_t as, const double *b, double alpha,
                              double beta, double *c, int ldc, int w, int v) {
    tss__micro *run = w > 16 ? tss__micro512_24 : w > 8 ? tss__micro512_16 : tss__micro512_8;
    run(k, a, as, b, alpha, beta, c, ldc, w, v);
}

#endif  // TSS__X86

static tss__kernel tss__kernel_here(void) {
    tss__kernel r;
    r.run = tss__micro_any, r.mr = 2 * TSS__VEC, r.nr = 4, r.direct = 0;
#ifdef TSS__X86
    if (TSS__HAS_AVX512) {
        r.run = tss__micro_avx512, r.mr = 24, r.nr = 8, r.direct = 1;
    } else if (TSS__HAS_AVX2) {
        r.run = tss__micro_avx2, r.mr = 12, r.nr = 4;
    }
#endif
    return r;
}

// w of the width rows of a k-step slab, the rest zeros; (rs, ps): strides of row and step.
static void tss__pack(int w, int width, int k, const double *a, ptrdiff_t rs, ptrdiff_t ps,
                      double *out) {
    if (rs == 1 && w == width && width % 4 == 0) {
        for (int p = 0; p < k; p++, a += ps)
            for (int i = 0; i < width; i += 4, out += 4) memcpy(out, a + i, 4 * sizeof(double));
        return;
    }
    for (int p = 0; p < k; p++, out += width, a += ps) {
        for (int i = 0; i < w; i++) out[i] = a[i * rs];
        for (int i = w; i < width; i++) out[i] = 0;
    }
}

// All rows of a block of B (n × k) in panels of nr: whole columns are read in order, so that the
// hardware sees streams.
static void tss__pack_panels(int nr, int n, int k, const double *b, ptrdiff_t rs, ptrdiff_t ps,
                             double *out) {
    int whole = rs == 1 ? n / nr * nr : 0;
    for (int p = 0; whole && p < k; p++) {
        const double *from = b + p * ps;
        for (int j = 0; j < whole; j += nr) {
            double *to = out + (ptrdiff_t)j * k + (ptrdiff_t)p * nr;
            for (int i = 0; i < nr; i += 4) memcpy(to + i, from + j + i, 4 * sizeof(double));
        }
    }
    for (int j = whole; j < n; j += nr)
        tss__pack(tss__min_int(nr, n - j), nr, k, b + j * rs, rs, ps, out + (ptrdiff_t)j * k);
}

// Doubles by which the columns of A lie off a cache line, where strips are read in place.
static int tss__misaligned(const tss__kernel *q, const double *a, ptrdiff_t ars, ptrdiff_t aps) {
    if (!q->direct || ars != 1 || aps % 8) return 0;
    return (int)((uintptr_t)a / sizeof(double) % 8);
}

// One slab of at most KC steps.
static void tss__gemm_slab(const tss__kernel *q, int m, int n, int k, double alpha, const double *a,
                           ptrdiff_t ars, ptrdiff_t aps, const double *b, ptrdiff_t brs,
                           ptrdiff_t bps, double beta, double *c, int ldc) {
    double as[TSS__MR_MAX * TSS__KC], bs[TSS__NC * TSS__KC];
    for (int j0 = 0; j0 < n; j0 += TSS__NC) {
        int nc = tss__min_int(TSS__NC, n - j0);
        tss__pack_panels(q->nr, nc, k, b + j0 * brs, brs, bps, bs);
        // The first strip ends where the others begin on a cache line.
        for (int i = 0, w = q->mr - tss__misaligned(q, a, ars, aps); i < m; i += w, w = q->mr) {
            w = tss__min_int(w, m - i);
            const double *strip = a + i * ars;
            ptrdiff_t step = aps;
            // A strip read in place is as fast where partial ones can be masked; packing pays
            // elsewhere from three panels of B on.
            if (ars != 1 || (!q->direct && (w < q->mr || nc > 2 * q->nr))) {
                tss__pack(w, q->mr, k, strip, ars, aps, as);
                strip = as, step = q->mr;
            }
            for (int j = 0; j < nc; j += q->nr)
                q->run(k, strip, step, bs + (ptrdiff_t)j * k, alpha, beta,
                       c + i + (ptrdiff_t)(j0 + j) * ldc, ldc, w, tss__min_int(q->nr, nc - j));
        }
    }
}

static void tss__gemm_any(int m, int n, int k, double alpha, const double *a, ptrdiff_t ars,
                          ptrdiff_t aps, const double *b, ptrdiff_t brs, ptrdiff_t bps,
                          double beta, double *c, int ldc) {
    tss__kernel q = tss__kernel_here();
    for (int p = 0; p < k; p += TSS__KC)
        tss__gemm_slab(&q, m, n, tss__min_int(TSS__KC, k - p), alpha, a + p * aps, ars, aps,
                       b + p * bps, brs, bps, p ? 1.0 : beta, c, ldc);
}

// C (m × n) = β C + α A Bᵀ, β 0 or 1; A m × k, B n × k, k > 0.
static void tss__gemm_nt(int m, int n, int k, double alpha, const double *a, int lda,
                         const double *b, int ldb, double beta, double *c, int ldc) {
    tss__gemm_any(m, n, k, alpha, a, 1, lda, b, 1, ldb, beta, c, ldc);
}
// C = β C + α A B; A m × k, B k × n.
static void tss__gemm_nn(int m, int n, int k, double alpha, const double *a, int lda,
                         const double *b, int ldb, double beta, double *c, int ldc) {
    tss__gemm_any(m, n, k, alpha, a, 1, lda, b, ldb, 1, beta, c, ldc);
}
void tss_dense_product(int ta, int tb, int m, int n, int k, double alpha, const double *a, int lda,
                       const double *b, int ldb, double beta, double *c, int ldc) {
    if (m <= 0 || n <= 0 || k <= 0) return;
    tss__gemm_any(m, n, k, alpha, a, ta ? lda : 1, ta ? 1 : lda, b, tb ? 1 : ldb, tb ? ldb : 1, beta, c, ldc);
}
// C = β C + α Aᵀ B; A k × m, B k × n.
static void tss__gemm_tn(int m, int n, int k, double alpha, const double *a, int lda,
                         const double *b, int ldb, double beta, double *c, int ldc) {
    tss__gemm_any(m, n, k, alpha, a, lda, 1, b, ldb, 1, beta, c, ldc);
}

// y += x.
static void tss__add_to(int m, const double *x, double *y) {
    int i = 0;
    for (; i + 4 <= m; i += 4) {
        double s[4], t[4];
        memcpy(s, x + i, sizeof s), memcpy(t, y + i, sizeof t);
        for (int k = 0; k < 4; k++) t[k] += s[k];
        memcpy(y + i, t, sizeof t);
    }
    for (; i < m; i++) y[i] += x[i];
}

enum { TSS__TRI = 8 };     // order of the triangles solved by hand
enum { TSS__DIAG = 48 };   // squares on the diagonal computed whole: a multiple of 1, 2, 3 and 8

// Where to cut a triangle of order n in two: near the middle, at a multiple of unit.
static int tss__half(int n, int unit) { return (n / 2 + unit - 1) / unit * unit; }

// Lower triangle of C (n × n) = beta C − A Aᵀ, A n × k. Diagonal squares are computed whole.
static void tss__syrk(int n, int k, const double *a, int lda, double beta, double *c, int ldc) {
    if (n <= TSS__DIAG) {
        tss__gemm_nt(n, n, k, -1, a, lda, a, lda, beta, c, ldc);
        return;
    }
    int h = tss__half(n, TSS__DIAG);
    tss__syrk(h, k, a, lda, beta, c, ldc);
    tss__gemm_nt(n - h, h, k, -1, a + h, lda, a, lda, beta, c + h, ldc);
    tss__syrk(n - h, k, a + h, lda, beta, c + h + (ptrdiff_t)h * ldc, ldc);
}

// Eight rows of B := B L⁻ᵀ in registers, n ≤ 8: forward substitution over the columns.
static void tss__trsm_rows8(int n, const double *l, int ldl, const double *inv, double *b,
                            int ldb) {
    double x[TSS__TRI][8];
    for (int j = 0; j < n; j++) {
        double s[8];
        memcpy(s, b + (ptrdiff_t)j * ldb, sizeof s);
        for (int i = 0; i < j; i++) {
            double f = l[j + (ptrdiff_t)i * ldl];
            for (int r = 0; r < 8; r++) s[r] -= x[i][r] * f;
        }
        for (int r = 0; r < 8; r++) x[j][r] = s[r] * inv[j];
        memcpy(b + (ptrdiff_t)j * ldb, x[j], sizeof s);
    }
}

#ifdef TSS__X86
// Rows [0, m) in vectors of eight, two at a time so that their chains overlap.
__attribute__((target("avx512f"))) static void tss__trsm_rows_avx512(int m, int n, const double *l,
                                                                     int ldl, const double *inv,
                                                                     double *b, int ldb) {
    for (int r = 0; r < m; r += 16) {
        __m512d x[TSS__TRI], y[TSS__TRI];
        int left = m - r;
        __mmask8 mx = (__mmask8)(left >= 8 ? 255 : (1 << left) - 1);
        __mmask8 my = (__mmask8)(left >= 16 ? 255 : left > 8 ? (1 << (left - 8)) - 1 : 0);
        for (int j = 0; j < n; j++) {
            double *at = b + r + (ptrdiff_t)j * ldb;
            __m512d s = _mm512_maskz_loadu_pd(mx, at), t = _mm512_maskz_loadu_pd(my, at + 8);
            for (int i = 0; i < j; i++) {
                __m512d f = _mm512_set1_pd(l[j + (ptrdiff_t)i * ldl]);
                s = _mm512_fnmadd_pd(x[i], f, s);
                t = _mm512_fnmadd_pd(y[i], f, t);
            }
            x[j] = _mm512_mul_pd(s, _mm512_set1_pd(inv[j]));
            y[j] = _mm512_mul_pd(t, _mm512_set1_pd(inv[j]));
            _mm512_mask_storeu_pd(at, mx, x[j]);
            _mm512_mask_storeu_pd(at + 8, my, y[j]);
        }
    }
}
#endif

// B (m × n) := B L⁻ᵀ, n ≤ 8.
static void tss__trsm_base(int m, int n, const double *l, int ldl, double *b, int ldb) {
    int r = 0;
    double inv[TSS__TRI];
    for (int j = 0; j < n; j++) inv[j] = 1 / l[j + (ptrdiff_t)j * ldl];
#ifdef TSS__X86
    if (TSS__HAS_AVX512) {
        tss__trsm_rows_avx512(m, n, l, ldl, inv, b, ldb);
        return;
    }
#endif
    for (; r + 8 <= m; r += 8) tss__trsm_rows8(n, l, ldl, inv, b + r, ldb);
    for (; r < m; r++) {
        for (int j = 0; j < n; j++) {
            double s = b[r + (ptrdiff_t)j * ldb];
            for (int i = 0; i < j; i++)
                s -= b[r + (ptrdiff_t)i * ldb] * l[j + (ptrdiff_t)i * ldl];
            b[r + (ptrdiff_t)j * ldb] = s * inv[j];
        }
    }
}

// B (m × n) := B L⁻ᵀ with L n × n lower.
static void tss__trsm(int m, int n, const double *l, int ldl, double *b, int ldb) {
    if (m <= 0 || n <= 0) return;
    if (n <= TSS__TRI) {
        tss__trsm_base(m, n, l, ldl, b, ldb);
        return;
    }
    int h = tss__half(n, TSS__TRI);
    tss__trsm(m, h, l, ldl, b, ldb);
    tss__gemm_nt(m, n - h, h, -1, b, ldb, l + h, ldl, 1, b + (ptrdiff_t)h * ldb, ldb);
    tss__trsm(m, n - h, l + h + (ptrdiff_t)h * ldl, ldl, b + (ptrdiff_t)h * ldb, ldb);
}

// A pivot is taken if it is a finite number above what rounding alone could leave of diag.
static int tss__pivot_ok(double pivot, double diag, double tol) {
    return pivot > 0 && pivot > tol * diag && pivot <= 1.7976931348623157e308;
}

// Lower Cholesky of an n ≤ 8 block. diag: the diagonal before any elimination; a pivot not above
// tol · diag (a NaN included) fails. Returns −1 or the failing column.
static int tss__potrf_base(int n, double *a, int lda, const double *diag, double tol) {
    for (int j = 0; j < n; j++) {
        double *aj = a + (ptrdiff_t)j * lda;
        if (!tss__pivot_ok(aj[j], diag[j], tol)) return j;
        double p = sqrt(aj[j]), inv = 1 / p;
        aj[j] = p;
        for (int i = j + 1; i < n; i++) aj[i] *= inv;
        for (int k = j + 1; k < n; k++) {
            double f = aj[k];
            for (int i = k; i < n; i++) a[i + (ptrdiff_t)k * lda] -= aj[i] * f;
        }
    }
    return -1;
}

// The same for any n.
static int tss__potrf(int n, double *a, int lda, const double *diag, double tol) {
    if (n <= TSS__TRI) return tss__potrf_base(n, a, lda, diag, tol);
    int h = tss__half(n, TSS__TRI);
    int bad = tss__potrf(h, a, lda, diag, tol);
    if (bad >= 0) return bad;
    double *a22 = a + h + (ptrdiff_t)h * lda;
    tss__trsm(n - h, h, a, lda, a + h, lda);
    tss__syrk(n - h, h, a + h, lda, 1, a22, lda);
    bad = tss__potrf(n - h, a22, lda, diag + h, tol);
    return bad >= 0 ? bad + h : -1;
}

// X (n × k) := L⁻¹ X, n of a tile.
static void tss__solve_lower(int n, int k, const double *l, int ldl, double *x, int ldx) {
    if (n > 32 && k > 1) {
        int h = tss__half(n, TSS__TRI);
        tss__solve_lower(h, k, l, ldl, x, ldx);
        tss__gemm_nn(n - h, k, h, -1, l + h, ldl, x, ldx, 1, x + h, ldx);
        tss__solve_lower(n - h, k, l + h + (ptrdiff_t)h * ldl, ldl, x + h, ldx);
        return;
    }
    for (int c = 0; c < k; c++) {
        double *y = x + (ptrdiff_t)c * ldx;
        for (int j = 0; j < n; j++) {
            const double *lj = l + (ptrdiff_t)j * ldl;
            double f = y[j] /= lj[j];
            for (int i = j + 1; i < n; i++) y[i] -= lj[i] * f;
        }
    }
}

// X (n × k) := L⁻ᵀ X.
static void tss__solve_upper(int n, int k, const double *l, int ldl, double *x, int ldx) {
    if (n > 32 && k > 1) {
        int h = tss__half(n, TSS__TRI);
        tss__solve_upper(n - h, k, l + h + (ptrdiff_t)h * ldl, ldl, x + h, ldx);
        tss__gemm_tn(h, k, n - h, -1, l + h, ldl, x + h, ldx, 1, x, ldx);
        tss__solve_upper(h, k, l, ldl, x, ldx);
        return;
    }
    for (int c = 0; c < k; c++) {
        double *y = x + (ptrdiff_t)c * ldx;
        for (int j = n - 1; j >= 0; j--) {
            const double *lj = l + (ptrdiff_t)j * ldl;
            double s = y[j];
            for (int i = j + 1; i < n; i++) s -= lj[i] * y[i];
            y[j] = s / lj[j];
        }
    }
}

// y (m) = A x, A m × n: columns in fours, so that y passes through once for each four.
static void tss__gemv_n(int m, int n, const double *a, int lda, const double *x, double *y) {
    int j = 0;
    for (int i = 0; i < m; i++) y[i] = 0;
    for (; j + 4 <= n; j += 4) {
        const double *a0 = a + (ptrdiff_t)j * lda, *a1 = a0 + lda, *a2 = a1 + lda, *a3 = a2 + lda;
        double x0 = x[j], x1 = x[j + 1], x2 = x[j + 2], x3 = x[j + 3];
        for (int i = 0; i < m; i++)
            y[i] += (a0[i] * x0 + a1[i] * x1) + (a2[i] * x2 + a3[i] * x3);
    }
    for (; j < n; j++)
        for (int i = 0; i < m; i++) y[i] += a[i + (ptrdiff_t)j * lda] * x[j];
}

// Σ a_i b_i in eight interleaved sums: the order is fixed and vectorises.
static double tss__dot_short(int n, const double *a, const double *b) {
    double s[8] = {0, 0, 0, 0, 0, 0, 0, 0};
    int i = 0;
    for (; i + 8 <= n; i += 8)
        for (int r = 0; r < 8; r++) s[r] += a[i + r] * b[i + r];
    for (int r = 0; i < n; i++, r++) s[r] += a[i] * b[i];
    return ((s[0] + s[1]) + (s[2] + s[3])) + ((s[4] + s[5]) + (s[6] + s[7]));
}

// y (n) = Aᵀ x, A m × n.
static void tss__gemv_t(int m, int n, const double *a, int lda, const double *x, double *y) {
    for (int j = 0; j < n; j++) y[j] = tss__dot_short(m, a + (ptrdiff_t)j * lda, x);
}

// ---------------------------------------------------------------------------------------------
// >>bcsr (private)
// The product reads 8 d² + 4 bytes a block and does 2 d² flops: bound by memory. One kernel for
// each d keeps the row's sums in registers. Rows are cut into fixed blocks.
// ---------------------------------------------------------------------------------------------

enum { TSS__ROWS = 512 };  // rows of a parallel block: some 10⁴ blocks of 3 × 3, 0.1 ms

static int tss__blocks(int n, int size) { return n / size + (n % size != 0); }

tss_result tss_bcsr_reserve(const tss_host *host, tss_bcsr *A, int n, int d, int64_t blocks) {
    if (n < 0 || d < 1 || d > 3 || blocks < 0) return TSS_ERROR_BAD_ARGUMENT;
    if ((uint64_t)blocks > (SIZE_MAX >> 8)) return TSS_ERROR_NO_MEMORY;
    size_t want[3] = {((size_t)n + 1) * sizeof(int64_t), (size_t)(blocks + 1) * sizeof(int),
                      (size_t)(blocks + 1) * (size_t)(d * d) * sizeof(double)};
    size_t have[3] = {A->row_bytes, A->col_bytes, A->val_bytes};
    void *old[3] = {A->row, A->col, A->val}, *p[3];
    // All new arrays first: either all of them grow or nothing changes.
    for (int i = 0; i < 3; i++) {
        p[i] = old[i];
        if (want[i] <= have[i]) continue;
        want[i] += want[i] / 4;
        p[i] = tss_alloc(host, want[i]);
        if (p[i]) continue;
        for (int j = 0; j < i; j++)
            if (p[j] != old[j]) tss_free(host, p[j], want[j]);
        return TSS_ERROR_NO_MEMORY;
    }
    for (int i = 0; i < 3; i++) {
        if (p[i] == old[i]) continue;
        if (have[i]) tss_free(host, old[i], have[i]);
        have[i] = want[i];
    }
    A->n = n, A->d = d;
    A->row = (int64_t *)p[0], A->col = (int *)p[1], A->val = (double *)p[2];
    A->row_bytes = have[0], A->col_bytes = have[1], A->val_bytes = have[2];
    return TSS_OK;
}

void tss_bcsr_free(const tss_host *host, tss_bcsr *A) {
    if (A->row_bytes) tss_free(host, A->row, A->row_bytes);
    if (A->col_bytes) tss_free(host, A->col, A->col_bytes);
    if (A->val_bytes) tss_free(host, A->val, A->val_bytes);
    memset(A, 0, sizeof *A);
}

// Index of block (a, b) or −1: binary search in row a.
static int64_t tss__bcsr_find(const tss_bcsr *A, int a, int b) {
    int64_t lo = A->row[a], hi = A->row[a + 1];
    while (lo < hi) {
        int64_t mid = lo + (hi - lo) / 2;
        if (A->col[mid] < b) lo = mid + 1;
        else hi = mid;
    }
    return lo < A->row[a + 1] && A->col[lo] == b ? lo : -1;
}

double *tss_bcsr_block(const tss_bcsr *A, int a, int b) {
    int64_t at = tss__bcsr_find(A, a, b);
    return at < 0 ? NULL : A->val + at * A->d * A->d;
}

// Block e = (a, b) and its mirror agree to tol, relative to the larger of the two entries.
static int tss__bcsr_mirrored(const tss_bcsr *A, int a, int64_t e, double tol) {
    int64_t t = tss__bcsr_find(A, A->col[e], a);
    if (t < 0) return 0;
    int d = A->d;
    for (int i = 0; tol >= 0 && i < d * d; i++) {
        double x = A->val[e * d * d + i], y = A->val[t * d * d + (i % d) * d + i / d];
        if (!(fabs(x - y) <= tol * fmax(fabs(x), fabs(y)))) return 0;
    }
    return 1;
}

tss_result tss_bcsr_check(const tss_bcsr *A, double tol) {
    if (A->n < 0 || A->d < 1 || A->d > 3 || !A->row || A->row[0] != 0)
        return TSS_ERROR_BAD_ARGUMENT;
    for (int a = 0; a < A->n; a++) {
        if (A->row[a + 1] < A->row[a]) return TSS_ERROR_BAD_ARGUMENT;
        for (int64_t e = A->row[a]; e < A->row[a + 1]; e++) {
            if (A->col[e] < 0 || A->col[e] >= A->n) return TSS_ERROR_BAD_ARGUMENT;
            if (e > A->row[a] && A->col[e] <= A->col[e - 1]) return TSS_ERROR_BAD_ARGUMENT;
        }
    }
    for (int a = 0; a < A->n; a++)
        for (int64_t e = A->row[a]; e < A->row[a + 1]; e++)
            if (!tss__bcsr_mirrored(A, a, e, tol)) return TSS_ERROR_BAD_ARGUMENT;
    return TSS_OK;
}

// Rows [lo, hi) of y = (add ? y : 0) + A x.
static void tss__spmv1(const tss_bcsr *A, int lo, int hi, const double *x, double *y, int add) {
    for (int a = lo; a < hi; a++) {
        double s = 0;
        for (int64_t e = A->row[a]; e < A->row[a + 1]; e++) s += A->val[e] * x[A->col[e]];
        y[a] = add ? y[a] + s : s;
    }
}

static void tss__spmv2(const tss_bcsr *A, int lo, int hi, const double *x, double *y, int add) {
    for (int a = lo; a < hi; a++) {
        double s0 = 0, s1 = 0;
        const double *v = A->val + A->row[a] * 4;
        for (int64_t e = A->row[a]; e < A->row[a + 1]; e++, v += 4) {
            const double *p = x + (ptrdiff_t)A->col[e] * 2;
            s0 += v[0] * p[0] + v[1] * p[1];
            s1 += v[2] * p[0] + v[3] * p[1];
        }
        y[2 * a] = add ? y[2 * a] + s0 : s0;
        y[2 * a + 1] = add ? y[2 * a + 1] + s1 : s1;
    }
}

// Nine running sums, one an entry of the block, added up at the end of the row: no chain of
// dependent additions is longer than the row, and the nine products vectorise.
static void tss__spmv3(const tss_bcsr *A, int lo, int hi, const double *x, double *y, int add) {
    for (int a = lo; a < hi; a++) {
        double s[3] = {0, 0, 0};
        const double *v = A->val + A->row[a] * 9;
        for (int64_t e = A->row[a]; e < A->row[a + 1]; e++, v += 9) {
            const double *p = x + (ptrdiff_t)A->col[e] * 3;
            double p0 = p[0], p1 = p[1], p2 = p[2];
            s[0] += v[0] * p0 + v[1] * p1 + v[2] * p2;
            s[1] += v[3] * p0 + v[4] * p1 + v[5] * p2;
            s[2] += v[6] * p0 + v[7] * p1 + v[8] * p2;
        }
        double *q = y + (ptrdiff_t)a * 3;
        for (int i = 0; i < 3; i++) q[i] = add ? q[i] + s[i] : s[i];
    }
}

static void tss__spmv(const tss_bcsr *A, int lo, int hi, const double *x, double *y, int add) {
    if (A->d == 3) tss__spmv3(A, lo, hi, x, y, add);
    else if (A->d == 2) tss__spmv2(A, lo, hi, x, y, add);
    else tss__spmv1(A, lo, hi, x, y, add);
}

typedef struct tss__spmv_job {
    const tss_bcsr *A;
    const double *x;
    double *y;
    int add;
} tss__spmv_job;

static void tss__spmv_task(int block, int worker, void *arg) {
    tss__spmv_job *j = (tss__spmv_job *)arg;
    (void)worker;
    int lo = block * TSS__ROWS, hi = tss__min_int(j->A->n, lo + TSS__ROWS);
    tss__spmv(j->A, lo, hi, j->x, j->y, j->add);
}

void tss_bcsr_multiply(const tss_host *host, const tss_bcsr *A, const double *x, double *y,
                       int add) {
    tss__spmv_job j;
    j.A = A, j.x = x, j.y = y, j.add = add;
    TSS_ASSERT(x != y || !A->n);
    tss__parallel_even(host, tss__blocks(A->n, TSS__ROWS), tss__spmv_task, &j);
}

static void tss__diagonal_task(int block, int worker, void *arg) {
    tss__spmv_job *j = (tss__spmv_job *)arg;
    (void)worker;
    int lo = block * TSS__ROWS, hi = tss__min_int(j->A->n, lo + TSS__ROWS), dd = j->A->d * j->A->d;
    for (int a = lo; a < hi; a++) {
        const double *v = tss_bcsr_block(j->A, a, a);
        double *q = j->y + (ptrdiff_t)a * dd;
        for (int i = 0; i < dd; i++) q[i] = (j->add ? q[i] : 0) + (v ? v[i] : 0);
    }
}

void tss_bcsr_diagonal(const tss_host *host, const tss_bcsr *A, double *out, int add) {
    tss__spmv_job j;
    j.A = A, j.x = NULL, j.y = out, j.add = add;
    tss_parallel(host, tss__blocks(A->n, TSS__ROWS), tss__diagonal_task, &j);
}

// ---------------------------------------------------------------------------------------------
// >>pcg (private)
// Conjugate gradients with three passes an iteration, each with its sums fused in:
//   q = A p and pᵀq, pᵀp  |  x += α p, r −= α q, z = M⁻¹ r and rᵀz, rᵀr  |  p = z + β p.
// A block's sums go to its own place and are added in block order. Fixed unknowns: x = b, r = 0.
// ---------------------------------------------------------------------------------------------

enum { TSS__SUMS = 8 };  // doubles a block has for its sums: a cache line

struct tss_pcg {
    tss_host host;
    tss__buf vectors, inverse, sums;
};

typedef struct tss__pcg_job {
    const tss_pcg_def *def;
    int n, d, first, repaired;
    double alpha, beta;
    const double *b;
    double *x, *r, *z, *p, *q, *inverse, *sums;
} tss__pcg_job;

tss_pcg_def tss_pcg_def_default(void) {
    tss_pcg_def def;
    memset(&def, 0, sizeof def);
    def.tol = 1e-5;
    def.max_iterations = 1000;
    def.cookie = 0x70636731;
    return def;
}

tss_result tss_pcg_create(const tss_host *host, tss_pcg **out) {
    *out = NULL;
    tss_pcg *p = (tss_pcg *)tss_alloc(host, sizeof *p);
    if (!p) return TSS_ERROR_NO_MEMORY;
    memset(p, 0, sizeof *p);
    p->host = *host;
    *out = p;
    return TSS_OK;
}

void tss_pcg_destroy(tss_pcg *p) {
    if (!p) return;
    tss_host host = p->host;
    tss__buf_free(&host, &p->vectors);
    tss__buf_free(&host, &p->inverse);
    tss__buf_free(&host, &p->sums);
    tss_free(&host, p, sizeof *p);
}

tss_result tss_pcg_reserve(tss_pcg *p, int n, int d) {
    if (n < 0 || d < 1 || d > 3) return TSS_ERROR_BAD_ARGUMENT;
    size_t N = (size_t)n * (size_t)d;
    if (!tss__need_doubles(&p->host, &p->vectors, 4 * N) ||
        !tss__need_doubles(&p->host, &p->inverse, N * (size_t)d) ||
        !tss__need_doubles(&p->host, &p->sums, (size_t)tss__blocks(n, TSS__ROWS) * TSS__SUMS))
        return TSS_ERROR_NO_MEMORY;
    return TSS_OK;
}

// Fixed unknowns out of a d × d block: identity rows.
static void tss__mask_block(int d, const uint8_t *fixed, double *m) {
    for (int i = 0; fixed && i < d; i++) {
        if (!fixed[i]) continue;
        for (int j = 0; j < d; j++) m[i * d + j] = m[j * d + i] = 0;
        m[i * d + i] = 1;
    }
}

// In-place inverse of a symmetric positive definite d × d block by its Cholesky factor; 0 if it is
// not positive definite.
static int tss__invert_spd(int d, double *m) {
    double l[9], x[9];
    for (int j = 0; j < d; j++) {
        for (int i = j; i < d; i++) {
            double s = m[i * d + j];
            for (int k = 0; k < j; k++) s -= l[i * 3 + k] * l[j * 3 + k];
            if (i == j && !(s > 7e-15 * m[j * d + j])) return 0;
            l[i * 3 + j] = i == j ? sqrt(s) : s / l[j * 3 + j];
        }
    }
    for (int c = 0; c < d; c++) {
        double *y = x + 3 * c;
        for (int i = 0; i < d; i++) {
            double s = i == c;
            for (int k = 0; k < i; k++) s -= l[i * 3 + k] * y[k];
            y[i] = s / l[i * 3 + i];
        }
        for (int i = d - 1; i >= 0; i--) {
            double s = y[i];
            for (int k = i + 1; k < d; k++) s -= l[k * 3 + i] * y[k];
            y[i] = s / l[i * 3 + i];
        }
    }
    // Symmetrised, so that the preconditioner is symmetric to the last bit.
    for (int i = 0; i < d; i++)
        for (int j = 0; j < d; j++) m[i * d + j] = 0.5 * (x[3 * i + j] + x[3 * j + i]);
    return 1;
}

// Block-Jacobi: inverses of the diagonal blocks; an indefinite one falls back to 1/|m_ii| (or 1).
static void tss__pcg_invert_task(int block, int worker, void *arg) {
    tss__pcg_job *j = (tss__pcg_job *)arg;
    (void)worker;
    int d = j->d, lo = block * TSS__ROWS, hi = tss__min_int(j->n, lo + TSS__ROWS), bad = 0;
    for (int a = lo; a < hi; a++) {
        double *m = j->inverse + (ptrdiff_t)a * d * d;
        tss__mask_block(d, j->def->fixed ? j->def->fixed + (ptrdiff_t)a * d : NULL, m);
        if (tss__invert_spd(d, m)) continue;
        bad++;
        for (int i = 0; i < d * d; i++) {
            double v = fabs(m[i]);
            m[i] = i % (d + 1) ? 0 : v > 0 && v < 1e300 ? 1 / v : 1;
        }
    }
    j->sums[(ptrdiff_t)block * TSS__SUMS] = bad;
}

// z = M⁻¹ r for the nodes [lo, hi).
static void tss__pcg_jacobi(const tss__pcg_job *j, int lo, int hi) {
    int d = j->d;
    for (int a = lo; a < hi; a++) {
        const double *m = j->inverse + (ptrdiff_t)a * d * d, *r = j->r + (ptrdiff_t)a * d;
        double *z = j->z + (ptrdiff_t)a * d;
        if (d == 3) {
            z[0] = m[0] * r[0] + m[1] * r[1] + m[2] * r[2];
            z[1] = m[3] * r[0] + m[4] * r[1] + m[5] * r[2];
            z[2] = m[6] * r[0] + m[7] * r[1] + m[8] * r[2];
        } else if (d == 2) {
            z[0] = m[0] * r[0] + m[1] * r[1];
            z[1] = m[2] * r[0] + m[3] * r[1];
        } else {
            z[0] = m[0] * r[0];
        }
    }
}

// q = A p on fixed-free rows (or what apply left in q), and the sums pᵀq, pᵀp.
static void tss__pcg_product_task(int block, int worker, void *arg) {
    tss__pcg_job *j = (tss__pcg_job *)arg;
    const tss_pcg_def *def = j->def;
    (void)worker;
    int d = j->d, lo = block * TSS__ROWS, hi = tss__min_int(j->n, lo + TSS__ROWS);
    ptrdiff_t at = (ptrdiff_t)lo * d;
    int m = (hi - lo) * d;
    if (!def->apply) {
        if (def->A) tss__spmv(def->A, lo, hi, j->p, j->q, 0);
        else memset(j->q + at, 0, (size_t)m * sizeof(double));
        if (def->B) tss__spmv(def->B, lo, hi, j->p, j->q, 1);
    }
    for (int i = 0; def->fixed && i < m; i++)
        if (def->fixed[at + i]) j->q[at + i] = 0;
    double *s = j->sums + (ptrdiff_t)block * TSS__SUMS;
    s[0] = tss__dot_short(m, j->p + at, j->q + at);
    s[1] = tss__dot_short(m, j->p + at, j->p + at);
}

// x += α p, r −= α q; z = M⁻¹ r (unless a callback follows); sums rᵀr, rᵀz.
static void tss__pcg_update_task(int block, int worker, void *arg) {
    tss__pcg_job *j = (tss__pcg_job *)arg;
    (void)worker;
    int lo = block * TSS__ROWS, hi = tss__min_int(j->n, lo + TSS__ROWS);
    ptrdiff_t at = (ptrdiff_t)lo * j->d;
    int m = (hi - lo) * j->d;
    double *x = j->x + at, *r = j->r + at, *p = j->p + at, *q = j->q + at;
    if (j->alpha != 0) {
        for (int i = 0; i < m; i++) x[i] += j->alpha * p[i];
        for (int i = 0; i < m; i++) r[i] -= j->alpha * q[i];
    }
    double *s = j->sums + (ptrdiff_t)block * TSS__SUMS;
    s[0] = tss__dot_short(m, r, r);
    if (j->def->precondition) return;
    tss__pcg_jacobi(j, lo, hi);
    s[1] = tss__dot_short(m, r, j->z + at);
}

// After a preconditioner of the caller's: mask z, sum rᵀz.
static void tss__pcg_masked_task(int block, int worker, void *arg) {
    tss__pcg_job *j = (tss__pcg_job *)arg;
    (void)worker;
    int lo = block * TSS__ROWS, hi = tss__min_int(j->n, lo + TSS__ROWS);
    ptrdiff_t at = (ptrdiff_t)lo * j->d;
    int m = (hi - lo) * j->d;
    for (int i = 0; j->def->fixed && i < m; i++)
        if (j->def->fixed[at + i]) j->z[at + i] = 0;
    j->sums[(ptrdiff_t)block * TSS__SUMS + 1] = tss__dot_short(m, j->r + at, j->z + at);
}

static void tss__pcg_direction_task(int block, int worker, void *arg) {
    tss__pcg_job *j = (tss__pcg_job *)arg;
    (void)worker;
    int lo = block * TSS__ROWS, hi = tss__min_int(j->n, lo + TSS__ROWS);
    ptrdiff_t end = (ptrdiff_t)hi * j->d;
    for (ptrdiff_t i = (ptrdiff_t)lo * j->d; i < end; i++) j->p[i] = j->z[i] + j->beta * j->p[i];
}

// Start: fixed unknowns x = b; the rest of x is 0 or the guess. r = b here, p = x masked, so that
// the first product gives A x; sums ‖b‖² over the free unknowns.
static void tss__pcg_start_task(int block, int worker, void *arg) {
    tss__pcg_job *j = (tss__pcg_job *)arg;
    const uint8_t *fixed = j->def->fixed;
    (void)worker;
    int lo = block * TSS__ROWS, hi = tss__min_int(j->n, lo + TSS__ROWS);
    ptrdiff_t at = (ptrdiff_t)lo * j->d, end = (ptrdiff_t)hi * j->d;
    for (ptrdiff_t i = at; i < end; i++) {
        int f = fixed && fixed[i];
        double guess = j->def->warm ? j->x[i] : 0;
        j->x[i] = f ? j->b[i] : guess;
        j->r[i] = f ? 0 : j->b[i];
        j->p[i] = f ? 0 : guess;
    }
    j->sums[(ptrdiff_t)block * TSS__SUMS] =
        tss__dot_short((int)(end - at), j->r + at, j->r + at);
}

// Runs a pass and returns its sum number which, added in block order.
static void tss__pcg_pass(tss_pcg *p, tss__pcg_job *j, tss_task *task, double out[2]) {
    int blocks = tss__blocks(j->n, TSS__ROWS);
    tss__parallel_even(&p->host, blocks, task, j);
    out[0] = out[1] = 0;
    for (int b = 0; b < blocks; b++) {
        out[0] += j->sums[(ptrdiff_t)b * TSS__SUMS];
        out[1] += j->sums[(ptrdiff_t)b * TSS__SUMS + 1];
    }
}

// rr = rᵀr and rz = rᵀz after moving by α.
static void tss__pcg_residual(tss_pcg *p, tss__pcg_job *j, double alpha, double sums[2]) {
    j->alpha = alpha;
    tss__pcg_pass(p, j, tss__pcg_update_task, sums);
    if (!j->def->precondition) return;
    double rr = sums[0];
    j->def->precondition(j->def->user, j->r, j->z);
    tss__pcg_pass(p, j, tss__pcg_masked_task, sums);
    sums[0] = rr;
}

static void tss__pcg_multiply(tss_pcg *p, tss__pcg_job *j, double sums[2]) {
    if (j->def->apply) j->def->apply(j->def->user, j->p, j->q);
    tss__pcg_pass(p, j, tss__pcg_product_task, sums);
}

static tss_pcg_status tss__pcg_iterate(tss_pcg *p, tss__pcg_job *j, double bb,
                                       tss_pcg_info *info) {
    const tss_pcg_def *def = j->def;
    double pq[2], rr[2], goal = def->tol * def->tol * bb, before = 0;
    // r = b − A x of the guess.
    if (def->warm) {
        tss__pcg_multiply(p, j, pq);
        double *x = j->x;
        j->x = j->p;  // the pass moves x too: let it move what is about to be overwritten
        tss__pcg_residual(p, j, 1, rr);
        j->x = x;
    } else {
        tss__pcg_residual(p, j, 0, rr);
    }
    for (int it = 0;; it++) {
        info->iterations = it;
        info->residual = sqrt(rr[0] / bb);
        if (rr[0] <= goal) return TSS_PCG_CONVERGED;
        if (!(rr[1] > 0) || !(rr[0] <= 1.7976931348623157e308)) return TSS_PCG_BREAKDOWN;
        if (it == def->max_iterations) return TSS_PCG_MAX_ITERATIONS;
        j->beta = it ? rr[1] / before : 0;
        if (!it) memset(j->p, 0, (size_t)j->n * (size_t)j->d * sizeof(double));
        tss__pcg_pass(p, j, tss__pcg_direction_task, pq);
        tss__pcg_multiply(p, j, pq);
        info->curvature = pq[0] / pq[1];
        if (!(pq[0] == pq[0])) return TSS_PCG_BREAKDOWN;
        if (pq[0] <= 0) {
            // No step yet: hand back the preconditioned right-hand side, a descent direction.
            for (ptrdiff_t i = 0; !it && !def->warm && i < (ptrdiff_t)j->n * j->d; i++)
                if (!def->fixed || !def->fixed[i]) j->x[i] = j->p[i];
            return TSS_PCG_INDEFINITE;
        }
        before = rr[1];
        tss__pcg_residual(p, j, rr[1] / pq[0], rr);
    }
}

// The diagonal blocks, inverted.
static int tss__pcg_prepare(tss_pcg *p, tss__pcg_job *j) {
    const tss_pcg_def *def = j->def;
    size_t size = (size_t)j->n * (size_t)(j->d * j->d) * sizeof(double);
    double sums[2];
    if (def->precondition) return 0;
    if (def->diagonal) {
        memcpy(j->inverse, def->diagonal, size);
    } else {
        if (def->A) tss_bcsr_diagonal(&p->host, def->A, j->inverse, 0);
        else memset(j->inverse, 0, size);
        if (def->B) tss_bcsr_diagonal(&p->host, def->B, j->inverse, 1);
    }
    tss__pcg_pass(p, j, tss__pcg_invert_task, sums);
    return (int)sums[0];
}

static int tss__pcg_def_ok(const tss_pcg_def *def) {
    const tss_bcsr *A = def->A, *B = def->B;
    if (def->cookie != 0x70636731 || def->n < 0 || def->d < 1 || def->d > 3) return 0;
    if (!def->apply && !A && !B) return 0;
    if (def->apply && !def->precondition && !def->diagonal && !A && !B) return 0;
    if ((A && (A->n != def->n || A->d != def->d)) || (B && (B->n != def->n || B->d != def->d)))
        return 0;
    return def->tol >= 0 && def->max_iterations >= 0;
}

tss_result tss_pcg_solve(tss_pcg *p, const tss_pcg_def *def, const double *b, double *x,
                         tss_pcg_info *info) {
    tss__pcg_job j;
    memset(info, 0, sizeof *info);
    if (!tss__pcg_def_ok(def)) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_pcg_reserve(p, def->n, def->d);
    if (r || !def->n) return r;
    size_t N = (size_t)def->n * (size_t)def->d;
    memset(&j, 0, sizeof j);
    j.def = def, j.n = def->n, j.d = def->d, j.b = b, j.x = x;
    j.r = (double *)p->vectors.p, j.z = j.r + N, j.p = j.z + N, j.q = j.p + N;
    j.inverse = (double *)p->inverse.p, j.sums = (double *)p->sums.p;
    double bb[2];
    info->repaired = tss__pcg_prepare(p, &j);
    tss__pcg_pass(p, &j, tss__pcg_start_task, bb);
    // b = 0: the answer is 0 even from a guess.
    if (bb[0] == 0) {
        for (size_t i = 0; i < N; i++) x[i] = def->fixed && def->fixed[i] ? b[i] : 0;
        return TSS_OK;
    }
    info->status = tss__pcg_iterate(p, &j, bb[0], info);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>cholesky_symbolic (private)
// Everything about L but its numbers, on the graph of nodes (scalars are 4-27 times dearer):
//   nested dissection → elimination tree (Liu) → postorder → column counts (Gilbert, Ng, Peyton
//   1994) → supernodes, merged upwards where that is cheap → structure of every front → schedule.
// The method is multifrontal (Duff and Reid 1983): a front is a supernode's columns over its rows
// and an update matrix for its parent, so all arithmetic is in large dense products.
// Fronts are cut into panels of TSS__PANEL columns; a panel keeps its rows from the diagonal down
// (a trapezoid), which halves the memory of update matrices.
// Schedule: subtrees of bounded work are tasks of their own; fronts above them are done one by one
// with their tiles in parallel. It depends on the structure alone, so the bits never depend on the
// number of threads. Update matrices live in arenas whose offsets are fixed here, by replaying the
// schedule through a first-fit allocator.
// Cost: about 1 µs a node of the graph and 10 ns a row of L; memory: see tss_chol_info.
// ---------------------------------------------------------------------------------------------

enum {
    TSS__PANEL = 192,  // a multiple of 1, 2, 3 and of TSS__DIAG: blocks never straddle panels
    TSS__BATCH_TASKS = 16,  // subtrees between two passes over the fronts above: bounds the arena
    TSS__CUT = 48           // a subtree larger than 1/48 of all work is not a task
};

typedef struct tss__step {  // a batch of tasks, or one front
    int task_begin, task_end;  // empty: front
    int front;
} tss__step;

// Buffers of one structure.
enum {
    TSS__S_PERM, TSS__S_IPERM, TSS__S_FIRST, TSS__S_PARENT, TSS__S_CHILD, TSS__S_NEXT,
    TSS__S_ROWPTR, TSS__S_ROWS, TSS__S_REL, TSS__S_LOFF, TSS__S_UOFF, TSS__S_FRONT, TSS__S_TASK,
    TSS__S_TASKBEGIN, TSS__S_ABOVE, TSS__S_STEPS, TSS__S_COUNT
};

typedef struct tss__sym {
    int n, d, fronts, tasks, steps;
    int *perm, *iperm;     // new → old, old → new node
    int *first;            // fronts + 1: first column (node) of each front
    int *parent;           // fronts; −1: root
    int *child, *next;     // lists of children, ascending
    int *front;            // n: front of each column
    int64_t *rowptr;       // fronts + 1: rows below each front, into rows and rel
    int *rows, *rel;       // row (node), and where it lies in the parent's front
    int64_t *loff, *uoff;  // L of each front; update matrix in its arena (doubles)
    int64_t *aoff;         // of the root of a subtree: its rows above, among those of all (nodes)
    int64_t above;         // their sum
    int *task_begin;       // 2 a task: fronts [begin, end), closed under children
    int *task_order;       // order of tasks inside a batch: dearest first
    tss__step *step;
    int64_t arena, task_arena;  // doubles: the shared one; the largest of a task
    int64_t nonzeros;
    double flops;
    int max_rows;          // of a front, nodes
    tss__buf buf[TSS__S_COUNT];
} tss__sym;

// Rows as stored: whole cache lines, so that all columns of a panel are aligned alike.
static int64_t tss__padded(int64_t rows) { return (rows + 7) & ~(int64_t)7; }

// Doubles before panel column c (a multiple of TSS__PANEL) of a trapezoid with rows rows.
static int64_t tss__panel_at(int64_t rows, int64_t c) {
    return c * tss__padded(rows) - c * (c - TSS__PANEL) / 2;
}

// Leading dimension of that panel.
static int tss__panel_ld(int rows, int c) { return (int)tss__padded(rows) - c; }

// Doubles of a trapezoid of rows rows and cols columns.
static int64_t tss__panel_size(int64_t rows, int64_t cols) {
    int64_t last = cols / TSS__PANEL * TSS__PANEL;
    return tss__panel_at(rows, last) + (cols - last) * (tss__padded(rows) - last);
}

// Flops of a front with K columns over M more rows: Σ (r_j)² over its columns' lengths.
static double tss__front_flops(double K, double M) {
    double R = K + M;
    return K * R * R - K * K * R + K * K * K / 3;
}

// The graphs of A and B together: a node's neighbours, one matrix after the other.
typedef struct tss__graph {
    const tss_bcsr *m[2];
    int n, d;
} tss__graph;

// Elimination tree of the permuted graph, with path compression (Liu 1990).
static void tss__etree(const tss__graph *g, const int *perm, const int *iperm, int *parent,
                       int *ancestor) {
    for (int j = 0; j < g->n; j++) {
        parent[j] = ancestor[j] = -1;
        for (int w = 0; w < 2 && g->m[w]; w++) {
            const tss_bcsr *m = g->m[w];
            for (int64_t e = m->row[perm[j]]; e < m->row[perm[j] + 1]; e++) {
                int i = iperm[m->col[e]];
                while (i < j) {
                    int up = ancestor[i];
                    ancestor[i] = j;
                    if (up == j) break;
                    if (up < 0) parent[i] = j;
                    if (up < 0) break;
                    i = up;
                }
            }
        }
    }
}

// Postorder of a forest given by parent (children before parents, ascending); post[k]: k-th node.
static void tss__postorder(int n, const int *parent, int *head, int *next, int *stack, int *post) {
    for (int i = 0; i < n; i++) head[i] = -1;
    for (int i = n - 1; i >= 0; i--) {
        if (parent[i] < 0) continue;
        next[i] = head[parent[i]];
        head[parent[i]] = i;
    }
    int k = 0;
    for (int root = 0; root < n; root++) {
        if (parent[root] >= 0) continue;
        int top = 0;
        stack[0] = root;
        while (top >= 0) {
            int i = stack[top];
            if (head[i] >= 0) {
                stack[++top] = head[i];
                head[i] = next[head[i]];
            } else {
                post[k++] = i;
                top--;
            }
        }
    }
}

// Root of i's set, with path halving.
static int tss__find_set(int *set, int i) {
    while (set[i] != i) {
        set[i] = set[set[i]];
        i = set[i];
    }
    return i;
}

// Column counts (the diagonal included) of a postordered graph: counts[j] = leaves of the row
// subtrees at j minus their lowest common ancestors, summed up the tree. work: 4 n ints.
static void tss__column_counts(const tss__graph *g, const int *perm, const int *iperm,
                               const int *parent, int *counts, int *work) {
    int n = g->n, *desc = work, *max_first = work + n, *prev_leaf = work + 2 * n,
        *set = work + 3 * n;
    // First descendant of every node; a leaf of the tree starts with one.
    for (int j = 0; j < n; j++) desc[j] = max_first[j] = prev_leaf[j] = -1, set[j] = j;
    for (int j = 0; j < n; j++) {
        counts[j] = desc[j] < 0;
        for (int i = j; i >= 0 && desc[i] < 0; i = parent[i]) desc[i] = j;
    }
    for (int j = 0; j < n; j++) {
        if (parent[j] >= 0) counts[parent[j]]--;
        for (int w = 0; w < 2 && g->m[w]; w++) {
            const tss_bcsr *m = g->m[w];
            for (int64_t e = m->row[perm[j]]; e < m->row[perm[j] + 1]; e++) {
                // j is a leaf of row i's subtree if no earlier leaf lies below it.
                int i = iperm[m->col[e]];
                if (i <= j || desc[j] <= max_first[i]) continue;
                max_first[i] = desc[j];
                int before = prev_leaf[i];
                prev_leaf[i] = j;
                counts[j]++;
                if (before >= 0) counts[tss__find_set(set, before)]--;
            }
        }
        if (parent[j] >= 0) set[j] = parent[j];
    }
    for (int j = 0; j < n; j++)
        if (parent[j] >= 0) counts[parent[j]] += counts[j];
}

// A supernode while supernodes are being merged.
typedef struct tss__node {
    int parent, into;      // front above; the front this one was merged into, or −1
    int cols, rows;        // columns; rows below
    int head, tail, next;  // its columns' runs: a list of the supernodes merged into it
    int begin;             // first column of its own run
    int own;               // columns of its own run
    int order;
    double zeros;          // stored zeros so far (nodes²)
} tss__node;

// Fundamental supernodes of the postordered tree: chains in which each column has one entry less.
static int tss__fundamental(int n, const int *parent, const int *counts, int *children,
                            int *front, tss__node *s) {
    int m = 0;
    for (int j = 0; j < n; j++) children[j] = 0;
    for (int j = 0; j < n; j++)
        if (parent[j] >= 0) children[parent[j]]++;
    for (int j = 0; j < n; j++) {
        int chain = j && parent[j - 1] == j && counts[j - 1] == counts[j] + 1 && children[j] == 1;
        if (!chain) {
            memset(&s[m], 0, sizeof s[m]);
            s[m].begin = j, s[m].into = -1, s[m].head = s[m].tail = m, s[m].next = -1;
            m++;
        }
        s[m - 1].own = s[m - 1].cols = s[m - 1].cols + 1;
        s[m - 1].rows = counts[j] - 1;
        front[j] = m - 1;
    }
    for (int k = 0; k < m; k++) {
        int up = parent[s[k].begin + s[k].cols - 1];
        s[k].parent = up < 0 ? -1 : front[up];
    }
    return m;
}

// Seconds a front costs, in flops: its arithmetic, the traffic of its update matrix, and a call's
// fixed cost. Measured on the whole: a product of small sizes runs at half speed, a double moved
// through memory costs some 8 flops, a front 20,000.
static double tss__front_cost(double K, double M) {
    return tss__front_flops(K, M) + 8 * (M * M + K * (K + M)) + 20000;
}

// Merges a child into its parent where the stored zeros cost less than the front saved.
static void tss__merge_fronts(int m, int d, tss__node *s) {
    for (int k = 0; k < m; k++) {
        int p = s[k].parent;
        if (p < 0) continue;
        while (s[p].into >= 0) p = s[p].into;
        double kc = s[k].cols, mc = s[k].rows, kp = s[p].cols, mp = s[p].rows;
        double zeros = s[k].zeros + s[p].zeros + kc * (kp + mp - mc);
        double size = (kc + kp) * (kc + kp + 1) / 2 + (kc + kp) * mp;
        double saved = tss__front_cost(kc * d, mc * d) + tss__front_cost(kp * d, mp * d) -
                       tss__front_cost((kc + kp) * d, mp * d);
        // A tenth of zeros at most in larger fronts: they also cost memory and every solve.
        if (saved <= 0 && zeros > 0) continue;
        if (zeros > 0.1 * size && kc + kp > 16) continue;
        s[k].into = p;
        s[p].cols += s[k].cols;
        s[p].zeros = zeros;
        s[s[k].tail].next = s[p].head;
        s[p].head = s[k].head;
    }
}

// Fronts from merged supernodes: numbering, parents, columns (perm relabelled) and row counts.
static void tss__number_fronts(tss__sym *y, int m, tss__node *s, const int *perm) {
    int f = 0, at = 0;
    y->rowptr[0] = 0;
    for (int k = 0; k < m; k++) {
        if (s[k].into >= 0) continue;
        s[k].order = f;
        y->first[f] = at;
        y->rowptr[f + 1] = y->rowptr[f] + s[k].rows;
        for (int r = s[k].head; r >= 0; r = s[r].next)
            for (int j = s[r].begin; j < s[r].begin + s[r].own; j++) {
                y->front[at] = f;
                y->perm[at++] = perm[j];
            }
        f++;
    }
    y->first[f] = at;
    y->fronts = f;
    for (int i = 0; i < y->n; i++) y->iperm[y->perm[i]] = i;
    for (int i = 0; i < f; i++) y->child[i] = y->parent[i] = -1;
    for (int k = 0; k < m; k++) {
        int p = s[k].parent;
        if (s[k].into >= 0) continue;
        while (p >= 0 && s[p].into >= 0) p = s[p].into;
        y->parent[s[k].order] = p < 0 ? -1 : s[p].order;
    }
    for (int i = f - 1; i >= 0; i--) {
        if (y->parent[i] < 0) continue;
        y->next[i] = y->child[y->parent[i]];
        y->child[y->parent[i]] = i;
    }
}

// Rows below front f, unsorted: those of its columns' blocks and of its children. mark: n, holds
// the last front that saw a row.
static void tss__front_rows(const tss__graph *g, tss__sym *y, int f, int *mark) {
    int64_t at = y->rowptr[f];
    int end = y->first[f + 1];
    for (int j = y->first[f]; j < end; j++) {
        int v = y->perm[j];
        for (int w = 0; w < 2 && g->m[w]; w++) {
            const tss_bcsr *m = g->m[w];
            for (int64_t e = m->row[v]; e < m->row[v + 1]; e++) {
                int i = y->iperm[m->col[e]];
                if (i < end || mark[i] == f) continue;
                mark[i] = f;
                y->rows[at++] = i;
            }
        }
    }
    for (int c = y->child[f]; c >= 0; c = y->next[c]) {
        for (int64_t e = y->rowptr[c]; e < y->rowptr[c + 1]; e++) {
            int i = y->rows[e];
            if (i < end || mark[i] == f) continue;
            mark[i] = f;
            y->rows[at++] = i;
        }
    }
    TSS_ASSERT(at == y->rowptr[f + 1]);
}

// Sorts every front's rows by transposing twice: linear in all rows. count: n + 1 longs;
// place: fronts longs; y->rel is scratch.
static void tss__sort_rows(tss__sym *y, int64_t *count, int64_t *place) {
    int64_t total = y->rowptr[y->fronts];
    for (int i = 0; i <= y->n; i++) count[i] = 0;
    for (int64_t e = 0; e < total; e++) count[y->rows[e] + 1]++;
    for (int i = 0; i < y->n; i++) count[i + 1] += count[i];
    for (int f = 0; f < y->fronts; f++) {
        place[f] = y->rowptr[f];
        for (int64_t e = y->rowptr[f]; e < y->rowptr[f + 1]; e++) y->rel[count[y->rows[e]]++] = f;
    }
    int64_t e = 0;
    for (int i = 0; i < y->n; i++)
        for (; e < count[i]; e++) y->rows[place[y->rel[e]]++] = i;
}

// Where each row of a front lies in its parent's front: columns first, then rows.
static void tss__relative_rows(tss__sym *y) {
    for (int f = 0; f < y->fronts; f++) {
        int p = y->parent[f];
        if (p < 0) continue;
        int first = y->first[p], cols = y->first[p + 1] - first;
        int64_t q = y->rowptr[p];
        for (int64_t e = y->rowptr[f]; e < y->rowptr[f + 1]; e++) {
            int r = y->rows[e];
            if (r < first + cols) {
                y->rel[e] = r - first;
                continue;
            }
            while (y->rows[q] < r) q++;
            y->rel[e] = cols + (int)(q - y->rowptr[p]);
        }
    }
}

// First fit over live blocks, in order of offset.
typedef struct tss__live {
    int64_t at, size;
} tss__live;

typedef struct tss__fit {
    tss__live *live;
    int count;
    int64_t used, peak;
} tss__fit;

static int64_t tss__fit_alloc(tss__fit *a, int64_t size) {
    int64_t at = 0, end = a->count ? a->live[a->count - 1].at + a->live[a->count - 1].size : 0;
    int k = a->count;
    if (!size) return 0;
    size = (size + 7) & ~(int64_t)7;
    // Without holes large enough in sum there is none to look for.
    if (end - a->used >= size) {
        for (k = 0; k < a->count && a->live[k].at - at < size; k++)
            at = a->live[k].at + a->live[k].size;
    } else {
        at = end;
    }
    for (int i = a->count; i > k; i--) a->live[i] = a->live[i - 1];
    a->live[k].at = at, a->live[k].size = size;
    a->count++;
    a->used += size;
    if (at + size > a->peak) a->peak = at + size;
    return at;
}

// Marks the block at offset at as free; tss__fit_sweep removes what is marked.
static void tss__fit_free(tss__fit *a, int64_t at) {
    int lo = 0, hi = a->count;
    while (lo < hi) {
        int mid = (lo + hi) / 2;
        if (a->live[mid].at < at) lo = mid + 1;
        else hi = mid;
    }
    a->used -= a->live[lo].size;
    a->live[lo].size = -a->live[lo].size;
}

static void tss__fit_sweep(tss__fit *a) {
    int k = 0;
    for (int i = 0; i < a->count; i++)
        if (a->live[i].size > 0) a->live[k++] = a->live[i];
    a->count = k;
}

static int64_t tss__update_size(const tss__sym *y, int f) {
    int64_t M = (y->rowptr[f + 1] - y->rowptr[f]) * y->d;
    return tss__panel_size(M, M);
}

// The update matrices of f's children leave the arena (after f's own has entered it).
static void tss__fit_free_children(tss__sym *y, tss__fit *a, int f) {
    int any = 0;
    for (int c = y->child[f]; c >= 0; c = y->next[c]) {
        if (!tss__update_size(y, c)) continue;
        tss__fit_free(a, y->uoff[c]);
        any = 1;
    }
    if (any) tss__fit_sweep(a);
}

// Replays the subtrees of one task: roots go to the shared arena (placed by the caller).
static int64_t tss__replay_task(tss__sym *y, int t, tss__live *live) {
    tss__fit a;
    memset(&a, 0, sizeof a);
    a.live = live;
    int begin = y->task_begin[2 * t], end = y->task_begin[2 * t + 1];
    for (int f = begin; f < end; f++) {
        int root = y->parent[f] < 0 || y->parent[f] >= end;
        if (!root) y->uoff[f] = tss__fit_alloc(&a, tss__update_size(y, f));
        tss__fit_free_children(y, &a, f);
    }
    return a.peak;
}

// Offsets of all update matrices by replaying the schedule.
static void tss__replay(tss__sym *y, tss__live *live, tss__live *task_live) {
    tss__fit a;
    memset(&a, 0, sizeof a);
    a.live = live;
    y->task_arena = y->above = 0;
    for (int k = 0; k < y->steps; k++) {
        const tss__step *s = &y->step[k];
        for (int t = s->task_begin; t < s->task_end; t++) {
            int64_t peak = tss__replay_task(y, t, task_live);
            if (peak > y->task_arena) y->task_arena = peak;
            for (int f = y->task_begin[2 * t]; f < y->task_begin[2 * t + 1]; f++) {
                if (y->parent[f] >= 0 && y->parent[f] < y->task_begin[2 * t + 1]) continue;
                y->uoff[f] = tss__fit_alloc(&a, tss__update_size(y, f));
                y->aoff[f] = y->above;
                y->above += y->rowptr[f + 1] - y->rowptr[f];
            }
        }
        if (s->task_begin < s->task_end) continue;
        y->uoff[s->front] = tss__fit_alloc(&a, tss__update_size(y, s->front));
        tss__fit_free_children(y, &a, s->front);
    }
    y->arena = a.peak;
}

// Totals and the cost of every subtree (cost: fronts doubles; lo: first front of each subtree).
static double tss__front_totals(tss__sym *y, double *cost, int *lo) {
    int64_t at = 0;
    double all = 0;
    y->flops = 0, y->max_rows = 0, y->nonzeros = 0;
    for (int f = 0; f < y->fronts; f++) cost[f] = 0, lo[f] = f;
    for (int f = 0; f < y->fronts; f++) {
        int64_t k = y->first[f + 1] - y->first[f], m = y->rowptr[f + 1] - y->rowptr[f];
        double K = (double)(k * y->d), M = (double)(m * y->d), own = tss__front_cost(K, M);
        y->loff[f] = at;
        at += (tss__panel_size((k + m) * y->d, k * y->d) + 7) & ~(int64_t)7;
        y->flops += tss__front_flops(K, M);
        y->nonzeros += (int64_t)(K * (K + 1) / 2 + K * M);
        y->max_rows = tss__max_int(y->max_rows, (int)(k + m));
        all += own;
        cost[f] += own;
        if (y->parent[f] < 0) continue;
        cost[y->parent[f]] += cost[f];
        lo[y->parent[f]] = tss__min_int(lo[y->parent[f]], lo[f]);
    }
    y->loff[y->fronts] = at;
    return all;
}

// Adds the tasks [begin, end) as one batch, dearest first (task_cost by insertion: few), then the
// fronts above that wait.
static void tss__flush_steps(tss__sym *y, int begin, int end, const double *task_cost,
                             const int *top, int tops) {
    if (begin < end) {
        tss__step *s = &y->step[y->steps++];
        s->task_begin = begin, s->task_end = end, s->front = -1;
        for (int t = begin; t < end; t++) {
            int i = t;
            for (; i > begin && task_cost[y->task_order[i - 1]] < task_cost[t]; i--)
                y->task_order[i] = y->task_order[i - 1];
            y->task_order[i] = t;
        }
    }
    for (int i = 0; i < tops; i++) {
        tss__step *s = &y->step[y->steps++];
        s->task_begin = s->task_end = 0, s->front = top[i];
    }
}

// Cuts the forest into tasks and fronts above, and both into steps. A front is "above" if its
// subtree is more than 1/TSS__CUT of all work (and worth the threads' wake-up: 10⁷ flops).
static void tss__schedule(tss__sym *y, double all, const double *cost, const int *lo,
                          double *task_cost, int *top) {
    double limit = fmax(all / (double)TSS__CUT, 1e7);
    int tops = 0, flushed = 0;
    y->tasks = y->steps = 0;
    for (int f = 0; f < y->fronts; f++) {
        if (cost[f] > limit) {
            top[tops++] = f;
            continue;
        }
        if (y->parent[f] >= 0 && cost[y->parent[f]] <= limit) continue;
        // A maximal small subtree: joins the task before it if that ends here and has room.
        int t = y->tasks - 1;
        if (t >= flushed && y->task_begin[2 * t + 1] == lo[f] && task_cost[t] + cost[f] <= limit) {
            y->task_begin[2 * t + 1] = f + 1;
            task_cost[t] += cost[f];
            continue;
        }
        if (y->tasks - flushed == TSS__BATCH_TASKS) {
            tss__flush_steps(y, flushed, y->tasks, task_cost, top, tops);
            flushed = y->tasks, tops = 0;
        }
        t = y->tasks++;
        y->task_begin[2 * t] = lo[f], y->task_begin[2 * t + 1] = f + 1;
        task_cost[t] = cost[f];
    }
    tss__flush_steps(y, flushed, y->tasks, task_cost, top, tops);
}

// ---------------------------------------------------------------------------------------------
// >>ordering (private)
// Fill-reducing order of the nodes: METIS's nested dissection, or (TSS_NO_METIS) our own: breadth
// first levels halve the set, the halves' border becomes the separator and is thinned by moving
// nodes out of it where that pulls fewer in; sets of up to 64 nodes by minimum degree on bit masks.
// METIS calls rand(), srand(), malloc() and, out of memory, longjmp or exit(); it runs here only,
// with its seed set, and its own checks of the input are satisfied beforehand.
// ---------------------------------------------------------------------------------------------

typedef struct tss__adj {  // neighbours of every node without itself, each once
    int n;
    int *ptr, *list;  // ints: METIS's index type in its usual build
} tss__adj;

// Both matrices' rows merged (columns ascend); list NULL: counts only.
static int64_t tss__adj_row(const tss__graph *g, int a, int *list) {
    int64_t e[2] = {0, 0}, end[2] = {0, 0}, k = 0;
    for (int w = 0; w < 2 && g->m[w]; w++) e[w] = g->m[w]->row[a], end[w] = g->m[w]->row[a + 1];
    while (e[0] < end[0] || e[1] < end[1]) {
        int c0 = e[0] < end[0] ? g->m[0]->col[e[0]] : g->n;
        int c1 = e[1] < end[1] ? g->m[1]->col[e[1]] : g->n;
        int c = tss__min_int(c0, c1);
        e[0] += c0 == c, e[1] += c1 == c;
        if (c == a) continue;
        if (list) list[k] = c;
        k++;
    }
    return k;
}

// Eliminates up to 64 nodes set[] in order of minimum degree; the result replaces set.
static void tss__order_leaf(const tss__adj *g, int m, int *set, int *local) {
    uint64_t near[64], left = m == 64 ? ~(uint64_t)0 : ((uint64_t)1 << m) - 1;
    int out[64];
    for (int i = 0; i < m; i++) local[set[i]] = i;
    for (int i = 0; i < m; i++) {
        near[i] = 0;
        for (int e = g->ptr[set[i]]; e < g->ptr[set[i] + 1]; e++) {
            int j = local[g->list[e]];
            if (j >= 0) near[i] |= (uint64_t)1 << j;
        }
    }
    for (int k = 0; k < m; k++) {
        int best = -1, least = 65;
        for (int i = 0; i < m; i++) {
            int degree = 0;
            if (!(left >> i & 1)) continue;
            for (uint64_t b = near[i] & left; b; b &= b - 1) degree++;
            if (degree < least) least = degree, best = i;
        }
        left &= ~((uint64_t)1 << best);
        out[k] = set[best];
        for (int i = 0; i < m; i++)
            if ((left & near[best]) >> i & 1) near[i] |= near[best] & ~((uint64_t)1 << i);
    }
    for (int i = 0; i < m; i++) local[set[i]] = -1;
    memcpy(set, out, (size_t)m * sizeof(int));
}

// A set being cut: its nodes in set[0..m-1]; side: 0, 1, 2 = separator; −1 = not in the set.
typedef struct tss__cut {
    const tss__adj *g;
    int m;
    int *set, *side, *queue;
} tss__cut;

// Breadth first over the set from start, then from whatever is left; returns the size of the first
// component. side must be 0 on the set; it is left at 3 there. The order goes to queue.
static int tss__cut_search(tss__cut *c, int start, int *boundary, int *largest) {
    int head = 0, tail = 0, first = 0, begin = 0, next = 0;
    boundary[0] = boundary[1] = 0, *largest = 0;
    while (tail < c->m) {
        int seed = start;
        if (tail) {
            while (c->side[c->set[next]] == 3) next++;
            seed = c->set[next];
        }
        begin = tail;
        c->queue[tail++] = seed, c->side[seed] = 3;
        for (; head < tail; head++) {
            int v = c->queue[head];
            for (int e = c->g->ptr[v]; e < c->g->ptr[v + 1]; e++) {
                int u = c->g->list[e];
                if (c->side[u]) continue;
                c->side[u] = 3, c->queue[tail++] = u;
            }
        }
        if (!begin) first = tail;
        // The component boundary nearest the middle, and the largest component.
        if (abs(2 * tail - c->m) < abs(2 * boundary[0] - c->m)) boundary[0] = tail;
        if (tail - begin > *largest) *largest = tail - begin, boundary[1] = begin;
    }
    return first;
}

static void tss__cut_clear(tss__cut *c) {
    for (int i = 0; i < c->m; i++) c->side[c->set[i]] = 0;
}

// Moves separator nodes to the side where they pull fewer than one node in; count: sizes of sides.
static int tss__cut_pass(tss__cut *c, int *count) {
    int moved = 0;
    for (int i = 0; i < c->m; i++) {
        int v = c->set[i], pull[2] = {0, 0};
        if (c->side[v] != 2) continue;
        for (int e = c->g->ptr[v]; e < c->g->ptr[v + 1]; e++) {
            int s = c->side[c->g->list[e]];
            if (s == 0 || s == 1) pull[!s]++;
        }
        // To side s it pulls its neighbours of the other side in: pull[s].
        int s = pull[0] != pull[1] ? pull[1] < pull[0] : count[1] < count[0];
        int even = count[s] < count[!s];
        if (pull[s] > 1 || (pull[s] == 1 && !even)) continue;
        if (count[s] > 3 * (c->m / 5)) continue;
        c->side[v] = s, count[s]++, count[2]--, moved += 1 - pull[s];
        for (int e = c->g->ptr[v]; pull[s] && e < c->g->ptr[v + 1]; e++) {
            int u = c->g->list[e];
            if (c->side[u] != !s) continue;
            c->side[u] = 2, count[!s]--, count[2]++;
        }
    }
    return moved;
}

// Rearranges the set as side 0 | side 1 | separator; sizes to count. A set of several components
// is cut between them.
static void tss__cut_set(tss__cut *c, int *count) {
    int boundary[2], largest;
    int first = tss__cut_search(c, c->set[0], boundary, &largest);
    count[0] = count[1] = count[2] = 0;
    if (first < c->m) {
        // The largest component alone if it is most of the set, else the middlemost boundary.
        int giant = 2 * largest > c->m;
        for (int i = 0; i < c->m; i++) {
            int in = giant ? i >= boundary[1] && i < boundary[1] + largest : i < boundary[0];
            c->side[c->queue[i]] = !in;
        }
    } else {
        // From a node far away, twice; the half nearest to it is one side.
        for (int k = 0; k < 2; k++) {
            int far = c->queue[c->m - 1];
            tss__cut_clear(c);
            tss__cut_search(c, far, boundary, &largest);
        }
        for (int i = 0; i < c->m; i++) c->side[c->queue[i]] = 2 * i >= c->m;
        for (int i = c->m / 2; i < c->m; i++) {
            int v = c->queue[i];
            for (int e = c->g->ptr[v]; c->side[v] == 1 && e < c->g->ptr[v + 1]; e++)
                if (c->side[c->g->list[e]] == 0) c->side[v] = 2;
        }
        for (int i = 0; i < c->m; i++) count[c->side[c->set[i]]]++;
        for (int k = 0; k < 8; k++) tss__cut_pass(c, count);
    }
    count[0] = count[1] = count[2] = 0;
    for (int i = 0; i < c->m; i++) count[c->side[c->set[i]]]++;
    int at[3] = {0, count[0], count[0] + count[1]};
    for (int i = 0; i < c->m; i++) c->queue[at[c->side[c->set[i]]]++] = c->set[i];
    for (int i = 0; i < c->m; i++) c->side[c->queue[i]] = -1;
    memcpy(c->set, c->queue, (size_t)c->m * sizeof(int));
}

// Nested dissection of all nodes. work: 4 n + 4 ints.
static void tss__order_builtin(const tss__adj *g, int *order, int *work) {
    int n = g->n, top = 0, *stack = work + 2 * n;
    tss__cut c;
    c.g = g, c.side = work, c.queue = work + n;
    for (int i = 0; i < n; i++) order[i] = i, c.side[i] = -1;
    stack[0] = 0, stack[1] = n;
    // Sets wait as [begin, size); a separator is final where it lies.
    while (top >= 0) {
        int begin = stack[2 * top], m = stack[2 * top + 1], count[3];
        top--;
        c.set = order + begin, c.m = m;
        if (m <= 64) {
            tss__order_leaf(g, m, c.set, c.side);
            continue;
        }
        tss__cut_clear(&c);
        tss__cut_set(&c, count);
        for (int s = 0; s < 2; s++) {
            int size = count[s], at = begin + (s ? count[0] : 0);
            if (!size) continue;
            top++;
            stack[2 * top] = at, stack[2 * top + 1] = size;
        }
    }
}

#ifndef TSS_NO_METIS
// METIS's nested dissection into order; work: 2 n idx_t. Nonzero: METIS gave up.
static int tss__order_metis(tss__adj *g, int seed, int *order, idx_t *work) {
    idx_t options[METIS_NOPTIONS], n = g->n, *perm = work, *iperm = work + g->n;
    METIS_SetDefaultOptions(options);
    options[METIS_OPTION_NUMBERING] = 0;
    options[METIS_OPTION_SEED] = seed;
    if (sizeof(idx_t) != sizeof(int)) return 1;
    if (METIS_NodeND(&n, (idx_t *)g->ptr, (idx_t *)g->list, NULL, options, perm, iperm) !=
        METIS_OK)
        return 1;
    for (int i = 0; i < g->n; i++) order[i] = (int)perm[i];
    return 0;
}
#endif

static tss_result tss__order_nodes(const tss_host *host, const tss__graph *g, int use_metis,
                                   int seed, int *order) {
    int n = g->n;
    int64_t edges = 0;
    for (int a = 0; a < n; a++) edges += tss__adj_row(g, a, NULL);
    // METIS and our cuts index edges with ints.
    if (edges > 0x7fffffff - 64) return TSS_ERROR_BAD_ARGUMENT;
    size_t bytes = ((size_t)5 * (size_t)n + (size_t)edges + 16) * sizeof(int) +
                   2 * (size_t)n * sizeof(int64_t);
    int *mem = (int *)tss_alloc(host, bytes);
    if (!mem) return TSS_ERROR_NO_MEMORY;
    tss__adj adj;
    adj.n = n, adj.ptr = mem, adj.list = mem + n + 1;
    int *work = adj.list + edges, done = 0;
    adj.ptr[0] = 0;
    for (int a = 0; a < n; a++)
        adj.ptr[a + 1] = adj.ptr[a] + (int)tss__adj_row(g, a, adj.list + adj.ptr[a]);
#ifndef TSS_NO_METIS
    // METIS fails on graphs without edges; small sets need no dissection.
    if (use_metis && edges && n > 64) done = !tss__order_metis(&adj, seed, order, (idx_t *)work);
#else
    (void)use_metis, (void)seed;
#endif
    if (!done) tss__order_builtin(&adj, order, work);
    tss_free(host, mem, bytes);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>cholesky (private)
// ---------------------------------------------------------------------------------------------

#define TSS__NO_MATRIX UINT64_MAX  // the stamp of a B that is NULL

struct tss_chol {
    tss_host host;
    tss_chol_def def;
    tss__sym sym[2];          // the structure in use and the one being made
    int now, analyzed, factored;
    int order_n, order_d;     // the kept ordering's size; 0: none
    int stale;                // the structure is not to be used again
    uint64_t pattern[2];      // stamps of A and B that are known to lie in the structure
    double flops_ordered;     // right after the last ordering
    int64_t contacts;         // B's blocks when the structure was made
    int orderings, analyses, bad_row;
    tss_chol_reuse reuse;
    tss__buf order, work, L, arena, task_arena, map, diag, rhs, part, bad, refine;
    tss__buf kept;  // the ordering at the last mark
    int kept_n, kept_d, kept_orderings;
    double kept_flops;
};

tss_chol_def tss_chol_def_default(void) {
    tss_chol_def def;
    memset(&def, 0, sizeof def);
    def.pivot_tol = 7e-15;
    def.reorder_at = 1.5;
    def.seed = 1;
    def.use_metis = 1;
    def.cookie = 0x63686f31;
    return def;
}

tss_result tss_chol_create(const tss_host *host, const tss_chol_def *def, tss_chol **out) {
    *out = NULL;
    if (def->cookie != 0x63686f31 || !(def->pivot_tol >= 0) || !(def->reorder_at >= 1))
        return TSS_ERROR_BAD_ARGUMENT;
    tss_chol *c = (tss_chol *)tss_alloc(host, sizeof *c);
    if (!c) return TSS_ERROR_NO_MEMORY;
    memset(c, 0, sizeof *c);
    c->host = *host;
    c->def = *def;
    c->bad_row = -1;
    *out = c;
    return TSS_OK;
}

// All buffers of a factorisation, for freeing and counting.
static int tss__chol_buffers(tss_chol *c, tss__buf **list) {
    tss__buf *own[] = {&c->order, &c->work, &c->L,    &c->arena, &c->task_arena, &c->map,
                       &c->diag,  &c->rhs,  &c->part, &c->bad,   &c->refine, &c->kept};
    int k = 0;
    for (size_t i = 0; i < sizeof own / sizeof own[0]; i++) list[k++] = own[i];
    for (int s = 0; s < 2; s++)
        for (int i = 0; i < TSS__S_COUNT; i++) list[k++] = &c->sym[s].buf[i];
    return k;
}

enum { TSS__CHOL_BUFFERS = 12 + 2 * TSS__S_COUNT };

void tss_chol_destroy(tss_chol *c) {
    if (!c) return;
    tss_host host = c->host;
    tss__buf *list[TSS__CHOL_BUFFERS];
    int k = tss__chol_buffers(c, list);
    for (int i = 0; i < k; i++) tss__buf_free(&host, list[i]);
    tss_free(&host, c, sizeof *c);
}

void tss_chol_get_info(const tss_chol *c, tss_chol_info *info) {
    const tss__sym *y = &c->sym[c->now];
    tss__buf *list[TSS__CHOL_BUFFERS];
    tss_chol copy = *c;
    memset(info, 0, sizeof *info);
    info->bad_row = c->bad_row;
    info->reuse = c->reuse;
    info->orderings = c->orderings;
    info->analyses = c->analyses;
    info->flops_ordered = c->flops_ordered;
    info->bytes = sizeof *c;
    int k = tss__chol_buffers(&copy, list);
    for (int i = 0; i < k; i++) info->bytes += list[i]->bytes;
    if (!c->analyzed) return;
    info->fronts = y->fronts;
    info->tasks = y->tasks;
    info->flops = y->flops;
    info->nonzeros = y->nonzeros;
}

// Room for n columns; the arrays of n nodes and of at most n fronts.
static int tss__sym_need(const tss_host *h, tss__sym *y, int n) {
    size_t N = (size_t)n;
    y->perm = tss__need_ints(h, &y->buf[TSS__S_PERM], N);
    y->iperm = tss__need_ints(h, &y->buf[TSS__S_IPERM], N);
    y->first = tss__need_ints(h, &y->buf[TSS__S_FIRST], N + 1);
    y->parent = tss__need_ints(h, &y->buf[TSS__S_PARENT], N);
    y->child = tss__need_ints(h, &y->buf[TSS__S_CHILD], N);
    y->next = tss__need_ints(h, &y->buf[TSS__S_NEXT], N);
    y->front = tss__need_ints(h, &y->buf[TSS__S_FRONT], N);
    y->rowptr = tss__need_longs(h, &y->buf[TSS__S_ROWPTR], N + 1);
    y->loff = tss__need_longs(h, &y->buf[TSS__S_LOFF], N + 1);
    y->uoff = tss__need_longs(h, &y->buf[TSS__S_UOFF], N);
    y->aoff = tss__need_longs(h, &y->buf[TSS__S_ABOVE], N);
    y->task_order = tss__need_ints(h, &y->buf[TSS__S_TASK], N);
    y->task_begin = tss__need_ints(h, &y->buf[TSS__S_TASKBEGIN], 2 * N);
    return y->perm && y->iperm && y->first && y->parent && y->child && y->next && y->front &&
           y->rowptr && y->loff && y->uoff && y->aoff && y->task_order && y->task_begin;
}

// Bytes of scratch a structure of n nodes needs: the largest of its stages.
static size_t tss__sym_work_bytes(int n) {
    size_t N = (size_t)n + 2;
    return N * (9 * sizeof(int) + sizeof(tss__node) + 2 * sizeof(double) + 2 * sizeof(tss__live));
}

// Tree, counts and supernodes of the graph under the ordering c->order; the fronts' sizes come out
// in y. False: no memory.
static void tss__sym_fronts(tss_chol *c, const tss__graph *g, tss__sym *y) {
    size_t N = (size_t)g->n + 2;
    int n = g->n, *order = (int *)c->order.p;
    tss__node *nodes = (tss__node *)c->work.p;
    int *w0 = (int *)(nodes + N), *parent = w0, *post = w0 + N, *perm = w0 + 2 * N,
        *counts = w0 + 3 * N, *work = w0 + 4 * N;
    // The tree of the ordering as given, then the same in postorder.
    for (int i = 0; i < n; i++) y->iperm[order[i]] = i;
    tss__etree(g, order, y->iperm, parent, work);
    tss__postorder(n, parent, work, work + N, work + 2 * N, post);
    for (int k = 0; k < n; k++) work[post[k]] = k, perm[k] = order[post[k]];
    for (int k = 0; k < n; k++) {
        y->iperm[perm[k]] = k;
        counts[k] = parent[post[k]] < 0 ? -1 : work[parent[post[k]]];
    }
    for (int k = 0; k < n; k++) parent[k] = counts[k];
    tss__column_counts(g, perm, y->iperm, parent, counts, work);
    int m = tss__fundamental(n, parent, counts, work, work + N, nodes);
    tss__merge_fronts(m, g->d, nodes);
    tss__number_fronts(y, m, nodes, perm);
}

// The whole structure for the ordering c->order.
static tss_result tss__sym_build(tss_chol *c, const tss__graph *g, tss__sym *y) {
    const tss_host *h = &c->host;
    size_t N = (size_t)g->n + 2;
    y->n = g->n, y->d = g->d;
    if (!tss__sym_need(h, y, g->n) || !tss__buf_need(h, &c->work, tss__sym_work_bytes(g->n)))
        return TSS_ERROR_NO_MEMORY;
    tss__sym_fronts(c, g, y);
    y->rows = tss__need_ints(h, &y->buf[TSS__S_ROWS], (size_t)y->rowptr[y->fronts]);
    y->rel = tss__need_ints(h, &y->buf[TSS__S_REL], (size_t)y->rowptr[y->fronts]);
    if (!y->rows || !y->rel) return TSS_ERROR_NO_MEMORY;
    int *mark = (int *)c->work.p;
    for (int i = 0; i < g->n; i++) mark[i] = -1;
    for (int f = 0; f < y->fronts; f++) tss__front_rows(g, y, f, mark);
    int64_t *count = (int64_t *)c->work.p;
    tss__sort_rows(y, count, count + N);
    tss__relative_rows(y);
    // Schedule and memory.
    double *cost = (double *)c->work.p, *task_cost = cost + N;
    int *lo = (int *)(task_cost + N), *top = lo + N;
    double all = tss__front_totals(y, cost, lo);
    y->step = tss__buf_need(h, &y->buf[TSS__S_STEPS], 2 * N * sizeof(tss__step))
                  ? (tss__step *)y->buf[TSS__S_STEPS].p
                  : NULL;
    if (!y->step) return TSS_ERROR_NO_MEMORY;
    tss__schedule(y, all, cost, lo, task_cost, top);
    tss__replay(y, (tss__live *)c->work.p, (tss__live *)c->work.p + N);
    c->analyses++;
    return TSS_OK;
}

// Whether block (i, j) has a place in the structure.
static int tss__sym_has(const tss__sym *y, int i, int j) {
    int a = y->iperm[i], b = y->iperm[j];
    if (a < b) {
        int t = a;
        a = b, b = t;
    }
    int f = y->front[b];
    if (a < y->first[f + 1]) return 1;
    int64_t lo = y->rowptr[f], hi = y->rowptr[f + 1];
    while (lo < hi) {
        int64_t mid = lo + (hi - lo) / 2;
        if (y->rows[mid] < a) lo = mid + 1;
        else hi = mid;
    }
    return lo < y->rowptr[f + 1] && y->rows[lo] == a;
}

typedef struct tss__contains_job {
    const tss__sym *y;
    const tss_bcsr *m;
    int *missing;
} tss__contains_job;

static void tss__contains_task(int block, int worker, void *arg) {
    tss__contains_job *j = (tss__contains_job *)arg;
    (void)worker;
    int lo = block * TSS__ROWS, hi = tss__min_int(j->m->n, lo + TSS__ROWS);
    j->missing[block] = 0;
    for (int a = lo; a < hi && !j->missing[block]; a++)
        for (int64_t e = j->m->row[a]; e < j->m->row[a + 1]; e++)
            if (j->m->col[e] < a && !tss__sym_has(j->y, a, j->m->col[e])) j->missing[block] = 1;
}

// 1 if all of m's blocks lie in the structure, 0 if not, −1 without memory to look.
static int tss__sym_contains(tss_chol *c, const tss__sym *y, const tss_bcsr *m) {
    int blocks = tss__blocks(m->n, TSS__ROWS), all = 1;
    tss__contains_job j;
    j.y = y, j.m = m, j.missing = tss__need_ints(&c->host, &c->bad, (size_t)blocks);
    if (!j.missing) return -1;
    tss_parallel(&c->host, blocks, tss__contains_task, &j);
    for (int b = 0; b < blocks; b++) all &= !j.missing[b];
    return all;
}

// A fresh ordering into c->order (old node of each place).
static tss_result tss__chol_reorder(tss_chol *c, const tss__graph *g) {
    int *order = tss__need_ints(&c->host, &c->order, (size_t)g->n);
    c->order_n = 0;
    if (!order) return TSS_ERROR_NO_MEMORY;
    tss_result r = tss__order_nodes(&c->host, g, c->def.use_metis, c->def.seed, order);
    if (r) return r;
    c->order_n = g->n, c->order_d = g->d;
    c->orderings++;
    return TSS_OK;
}

static int64_t tss__contact_blocks(const tss__graph *g) {
    return g->m[1] ? g->m[1]->row[g->n] : 0;
}

// A new structure in the spare place, with the kept ordering or (where that has become too dear,
// by predicted flops) a fresh one.
static tss_result tss__chol_restructure(tss_chol *c, const tss__graph *g) {
    int fresh = !c->analyzed || c->stale;  // nothing to keep: its memory is used again
    tss__sym *y = &c->sym[fresh ? c->now : !c->now];
    c->analyzed &= !fresh;
    int keep = c->order_n > 0 && c->order_n == g->n && c->order_d == g->d;
    tss_result r;
    if (keep) {
        if ((r = tss__sym_build(c, g, y)) != TSS_OK) return r;
        keep = y->flops <= c->def.reorder_at * c->flops_ordered;
    }
    c->reuse = keep ? TSS_CHOL_RESTRUCTURED : TSS_CHOL_REORDERED;
    if (!keep) {
        if ((r = tss__chol_reorder(c, g)) != TSS_OK) return r;
        if ((r = tss__sym_build(c, g, y)) != TSS_OK) return r;
        c->flops_ordered = y->flops;
    }
    c->contacts = tss__contact_blocks(g);
    if (!fresh) c->now = !c->now;
    c->stale = 0;
    c->analyzed = 1;
    c->factored = 0;
    return TSS_OK;
}

// 1 if the structure at hand serves, 0 if not, −1 without memory to look. It is given up, too, when
// half the contacts it was made for have gone and a new one is cheap: a structure takes as long as
// about 1,000 flops a row of L and node.
static int tss__chol_serves(tss_chol *c, const tss__graph *g) {
    const tss__sym *y = &c->sym[c->now];
    if (!c->analyzed || y->n != g->n || y->d != g->d) return 0;
    // Forgotten; without contacts then and now a new one would be the same.
    if (c->stale && (c->contacts > 0 || tss__contact_blocks(g) > 0)) return 0;
    uint64_t b = g->m[1] ? g->m[1]->pattern : TSS__NO_MATRIX;
    if (g->m[0]->pattern && b && g->m[0]->pattern == c->pattern[0] && b == c->pattern[1]) return 1;
    double work = 1000.0 * ((double)y->rowptr[y->fronts] + y->n);
    if (2 * tss__contact_blocks(g) < c->contacts && work < 0.1 * y->flops) return 0;
    for (int w = 0; w < 2 && g->m[w]; w++) {
        if (w == 0 && g->m[0]->pattern && g->m[0]->pattern == c->pattern[0]) continue;
        int in = tss__sym_contains(c, y, g->m[w]);
        if (in <= 0) return in;
    }
    return 1;
}

static int tss__graph_ok(const tss_bcsr *A, const tss_bcsr *B) {
    if (!A || A->n < 0 || A->d < 1 || A->d > 3 || A->n > 0x7fffffff / 3 - 64) return 0;
    return !B || (B->n == A->n && B->d == A->d);
}

tss_result tss_chol_analyze(tss_chol *c, const tss_bcsr *A, const tss_bcsr *B) {
    if (!tss__graph_ok(A, B)) return TSS_ERROR_BAD_ARGUMENT;
    tss__graph g;
    g.m[0] = A, g.m[1] = B, g.n = A->n, g.d = A->d;
    int serves = tss__chol_serves(c, &g);
    if (serves < 0) return TSS_ERROR_NO_MEMORY;
    if (serves) {
        c->stale = 0;
        c->reuse = TSS_CHOL_KEPT;
    } else {
        tss_result r = tss__chol_restructure(c, &g);
        if (r) return r;
    }
    c->pattern[0] = A->pattern;
    c->pattern[1] = B ? B->pattern : TSS__NO_MATRIX;
    return TSS_OK;
}

void tss_chol_forget(tss_chol *c) { c->stale = 1; }

int tss_chol_get_order(const tss_chol *c, int *order, double *flops) {
    if (order && c->order_n > 0) memcpy(order, c->order.p, (size_t)c->order_n * sizeof(int));
    if (flops) *flops = c->flops_ordered;
    return c->order_n;
}

tss_result tss_chol_set_order(tss_chol *c, int n, int d, const int *order, double flops) {
    if (n < 0 || d < 1 || d > 3 || (n > 0 && !order)) return TSS_ERROR_BAD_ARGUMENT;
    int *seen = tss__need_ints(&c->host, &c->bad, (size_t)n);
    if (!seen) return TSS_ERROR_NO_MEMORY;
    memset(seen, 0, (size_t)n * sizeof(int));
    for (int i = 0; i < n; i++)
        if (order[i] < 0 || order[i] >= n || seen[order[i]]++) return TSS_ERROR_BAD_ARGUMENT;
    c->order_n = 0, c->analyzed = 0, c->factored = 0;
    int *to = tss__need_ints(&c->host, &c->order, (size_t)n);
    if (!to) return TSS_ERROR_NO_MEMORY;
    if (n > 0) memcpy(to, order, (size_t)n * sizeof(int));
    c->order_n = n, c->order_d = d, c->flops_ordered = flops, c->orderings++;
    return TSS_OK;
}

// Keeps the ordering, so that tss__chol_rewind can take it back without memory.
static tss_result tss__chol_mark(tss_chol *c) {
    int *to = tss__need_ints(&c->host, &c->kept, (size_t)c->order_n);
    if (!to) return TSS_ERROR_NO_MEMORY;
    if (c->order_n > 0) memcpy(to, c->order.p, (size_t)c->order_n * sizeof(int));
    c->kept_n = c->order_n, c->kept_d = c->order_d, c->kept_orderings = c->orderings;
    c->kept_flops = c->flops_ordered;
    return TSS_OK;
}

static void tss__chol_rewind(tss_chol *c) {
    if (c->orderings == c->kept_orderings && c->order_n == c->kept_n) return;
    tss__buf spare = c->order;
    c->order = c->kept, c->kept = spare;
    c->order_n = c->kept_n, c->order_d = c->kept_d, c->flops_ordered = c->kept_flops;
    c->kept_orderings = c->orderings;
    c->analyzed = c->factored = 0;
}

// ---------------------------------------------------------------------------------------------
// >>cholesky_numeric (private)
// A front of K columns and M rows below, in scalars. Its L is a trapezoid of K + M rows, its
// update matrix U = (children's) − L₂₁ L₂₁ᵀ one of M rows. For each front:
//   strips of columns: A's entries and the children's updates are added into L;
//   panels, left to right: − (panels before), then Cholesky of the diagonal, then rows below;
//   tiles of U: − L₂₁ L₂₁ᵀ, then the children's updates while the tile is in the cache.
// A task does this serially for the fronts of its subtrees, the fronts above do each line in
// parallel. All sums are in an order fixed by the structure.
// ---------------------------------------------------------------------------------------------

enum {
    TSS__STRIP = 48,      // columns assembled at a time
    TSS__TILE_ROWS = 384  // rows of a tile of U or of a panel
};

typedef struct tss__numeric {
    tss_chol *c;
    const tss__sym *y;
    const tss_bcsr *m[2];
    const uint8_t *fixed;
    int d;
    int batch;    // first task of the running batch
    // The front that all threads work on, and where they are in it.
    struct tss__view *view;
    int panel;
} tss__numeric;

typedef struct tss__view {
    int f, K, M;
    double *L, *U;
    const int *map;   // node → row index below the front
    double *local;    // arena of the task; NULL above
} tss__view;

// U of front f, seen from a front whose arena for its own subtree is local.
static double *tss__update_of(const tss__numeric *w, int f, double *local) {
    const tss__sym *y = w->y;
    return (local ? local : (double *)w->c->arena.p) + y->uoff[f];
}

static void tss__view_open(const tss__numeric *w, int f, double *local, int root, int *map,
                           tss__view *v) {
    const tss__sym *y = w->y;
    v->f = f;
    v->K = (y->first[f + 1] - y->first[f]) * w->d;
    v->M = (int)(y->rowptr[f + 1] - y->rowptr[f]) * w->d;
    v->L = (double *)w->c->L.p + y->loff[f];
    v->U = tss__update_of(w, f, root ? NULL : local);
    v->local = local;
    v->map = map;
    for (int64_t e = y->rowptr[f]; e < y->rowptr[f + 1]; e++)
        map[y->rows[e]] = (int)(e - y->rowptr[f]);
}

// Panel of a trapezoid of R rows that holds column c (a multiple of TSS__PANEL); entry (i, c + j)
// is p[i − c + j·ld] with ld = R − c.
static double *tss__panel(double *t, int R, int c) { return t + tss__panel_at(R, c); }

// Adds block (row i, column j of the front, nodes): m is block (column, row) of A, row-major.
static void tss__add_block(const tss__numeric *w, const tss__view *v, int i, int j,
                           const double *m, const uint8_t *fi, const uint8_t *fj) {
    int d = w->d, c = j * d / TSS__PANEL * TSS__PANEL, R = v->K + v->M;
    int ld = tss__panel_ld(R, c);
    double *p = tss__panel(v->L, R, c) + (i * d - c) + (ptrdiff_t)(j * d - c) * ld;
    for (int a = 0; a < d; a++, p += ld) {
        for (int b = 0; b < d; b++) {
            if (fi && (fi[b] || fj[a])) continue;
            p[b] += m[a * d + b];
        }
    }
}

// A's and B's entries of column j of the front, and the identity of fixed unknowns.
static void tss__add_column(const tss__numeric *w, const tss__view *v, int j) {
    const tss__sym *y = w->y;
    int first = y->first[v->f], end = y->first[v->f + 1], d = w->d, node = y->perm[first + j];
    const uint8_t *fixed = w->fixed, *fj = fixed ? fixed + (ptrdiff_t)node * d : NULL;
    double *diag = (double *)w->c->diag.p + (ptrdiff_t)(first + j) * d;
    for (int s = 0; s < 2 && w->m[s]; s++) {
        const tss_bcsr *m = w->m[s];
        for (int64_t e = m->row[node]; e < m->row[node + 1]; e++) {
            int i = y->iperm[m->col[e]];
            if (i < first + j) continue;
            i = i < end ? i - first : end - first + v->map[i];
            tss__add_block(w, v, i, j, m->val + e * d * d,
                           fixed ? fixed + (ptrdiff_t)m->col[e] * d : NULL, fj);
        }
    }
    int c = j * d / TSS__PANEL * TSS__PANEL, R = v->K + v->M;
    int ld = tss__panel_ld(R, c);
    double *p = tss__panel(v->L, R, c) + (ptrdiff_t)(j * d - c) * (ld + 1);
    for (int a = 0; a < d; a++, p += ld + 1) {
        if (fj && fj[a]) *p = 1;
        diag[a] = *p;
    }
}

// First index in the ascending rel[lo..hi) that is ≥ at.
static int tss__lower_bound(const int *rel, int lo, int hi, int at) {
    while (lo < hi) {
        int mid = (lo + hi) / 2;
        if (rel[mid] < at) lo = mid + 1;
        else hi = mid;
    }
    return lo;
}

// dst += src for the d columns of one node of a child's U: its row i (a node) goes to rel[i].
static void tss__add_runs(const int *rel, int i, int end, int d, const double *src, int src_ld,
                          double *dst, int dst_ld) {
    while (i < end) {
        int t = rel[i], run = 1;
        while (i + run < end && rel[i + run] == t + run) run++;
        const double *s = src + (ptrdiff_t)i * d;
        double *q = dst + (ptrdiff_t)t * d;
        for (int a = 0; a < d; a++, s += src_ld, q += dst_ld) tss__add_to(run * d, s, q);
        i += run;
    }
}

// Adds the children's updates into rows [r0, r1) × columns [c0, c1) of the front (nodes of the
// front: columns, then rows below); t: panel holding them, its first entry at (row, column) = (o,o)
// of the front in nodes, leading dimension ld.
static void tss__add_children(const tss__numeric *w, const tss__view *v, int r0, int r1, int c0,
                              int c1, int o, double *t, int ld) {
    const tss__sym *y = w->y;
    int d = w->d;
    for (int ch = y->child[v->f]; ch >= 0; ch = y->next[ch]) {
        const int *rel = y->rel + y->rowptr[ch];
        int m = (int)(y->rowptr[ch + 1] - y->rowptr[ch]);
        int j = tss__lower_bound(rel, 0, m, c0), jend = tss__lower_bound(rel, j, m, c1);
        if (j == jend) continue;
        int lo = tss__lower_bound(rel, 0, m, r0), hi = tss__lower_bound(rel, lo, m, r1), M = m * d;
        const double *U = tss__update_of(w, ch, v->local);
        for (; j < jend; j++) {
            int c = j * d / TSS__PANEL * TSS__PANEL, i = tss__max_int(lo, j);
            int sld = tss__panel_ld(M, c);
            const double *src = U + tss__panel_at(M, c) - c + (ptrdiff_t)(j * d - c) * sld;
            double *dst = t + (ptrdiff_t)((rel[j] - o) * d) * ld - (ptrdiff_t)o * d;
            tss__add_runs(rel, i, hi, d, src, sld, dst, ld);
        }
    }
}

// Columns [c, c + STRIP) of L before elimination.
static void tss__assemble_strip(const tss__numeric *w, const tss__view *v, int c) {
    int R = v->K + v->M, d = w->d, end = tss__min_int(v->K, c + TSS__STRIP);
    int pc = c / TSS__PANEL * TSS__PANEL, ld = tss__panel_ld(R, pc);
    double *p = tss__panel(v->L, R, pc);
    memset(p + (ptrdiff_t)(c - pc) * ld, 0, (size_t)(end - c) * (size_t)ld * sizeof(double));
    for (int j = c / d; j < end / d; j++) tss__add_column(w, v, j);
    tss__add_children(w, v, c / d, R / d, c / d, end / d, pc / d, p, ld);
}

// Rows [r, r + rows) of panel c: minus the panels to the left.
static void tss__update_panel(const tss__view *v, int c, int r, int rows) {
    int R = v->K + v->M, width = tss__min_int(TSS__PANEL, v->K - c);
    double *p = tss__panel(v->L, R, c) + (r - c);
    for (int q = 0; q < c; q += TSS__PANEL) {
        const double *l = tss__panel(v->L, R, q);
        int ld = tss__panel_ld(R, q);
        tss__gemm_nt(rows, width, TSS__PANEL, -1, l + (r - q), ld, l + (c - q), ld, 1, p,
                     tss__panel_ld(R, c));
    }
}

// Rows [r, r + rows) below the diagonal of panel c: times its inverse transposed.
static void tss__finish_panel(const tss__view *v, int c, int r, int rows) {
    int R = v->K + v->M;
    double *p = tss__panel(v->L, R, c);
    int ld = tss__panel_ld(R, c);
    tss__trsm(rows, tss__min_int(TSS__PANEL, v->K - c), p, ld, p + (r - c), ld);
}

// Cholesky of the diagonal of panel c; −1 or the failing unknown (in the order of L).
static int tss__factor_diagonal(const tss__numeric *w, const tss__view *v, int c) {
    int at = w->y->first[v->f] * w->d + c, R = v->K + v->M;
    int bad = tss__potrf(tss__min_int(TSS__PANEL, v->K - c), tss__panel(v->L, R, c),
                         tss__panel_ld(R, c), (double *)w->c->diag.p + at, w->c->def.pivot_tol);
    return bad < 0 ? -1 : at + bad;
}

// Tile of U: rows [r, r + rows) of its panel c; r == c: the tile on the diagonal.
static void tss__update_tile(const tss__numeric *w, const tss__view *v, int c, int r, int rows) {
    int R = v->K + v->M, width = tss__min_int(TSS__PANEL, v->M - c), d = w->d;
    int ld = tss__panel_ld(v->M, c);
    double *panel = tss__panel(v->U, v->M, c), *t = panel + (r - c);
    for (int q = 0; q < v->K; q += TSS__PANEL) {
        const double *l = tss__panel(v->L, R, q) + (v->K - q);
        int depth = tss__min_int(TSS__PANEL, v->K - q), skip = 0, lq = tss__panel_ld(R, q);
        if (r == c) {
            skip = width;
            tss__syrk(width, depth, l + c, lq, q ? 1 : 0, t, ld);
        }
        if (rows > skip)
            tss__gemm_nt(rows - skip, width, depth, -1, l + r + skip, lq, l + c, lq, q ? 1 : 0,
                         t + skip, ld);
    }
    int o = (v->K + c) / d;
    tss__add_children(w, v, (v->K + r) / d, (v->K + r + rows) / d, o, o + width / d, o, panel, ld);
}

// One front of a subtree, serially; −1 or the failing unknown.
static int tss__factor_front(const tss__numeric *w, const tss__view *v) {
    int R = v->K + v->M;
    for (int c = 0; c < v->K; c += TSS__STRIP) tss__assemble_strip(w, v, c);
    for (int c = 0; c < v->K; c += TSS__PANEL) {
        if (c) tss__update_panel(v, c, c, R - c);
        int bad = tss__factor_diagonal(w, v, c), r = tss__min_int(v->K, c + TSS__PANEL);
        if (bad >= 0) return bad;
        for (; r < R; r += TSS__TILE_ROWS)
            tss__finish_panel(v, c, r, tss__min_int(TSS__TILE_ROWS, R - r));
    }
    for (int c = 0; c < v->M; c += TSS__PANEL)
        for (int r = c; r < v->M; r += TSS__TILE_ROWS)
            tss__update_tile(w, v, c, r, tss__min_int(TSS__TILE_ROWS, v->M - r));
    return -1;
}

static void tss__factor_task(int block, int worker, void *arg) {
    tss__numeric *w = (tss__numeric *)arg;
    const tss__sym *y = w->y;
    int t = y->task_order[w->batch + block], end = y->task_begin[2 * t + 1], bad = -1;
    double *local = (double *)w->c->task_arena.p + (ptrdiff_t)worker * y->task_arena;
    int *map = (int *)w->c->map.p + (ptrdiff_t)worker * y->n;
    for (int f = y->task_begin[2 * t]; f < end && bad < 0; f++) {
        tss__view v;
        tss__view_open(w, f, local, y->parent[f] < 0 || y->parent[f] >= end, map, &v);
        bad = tss__factor_front(w, &v);
    }
    ((int *)w->c->bad.p)[t] = bad;
}

static void tss__strip_task(int block, int worker, void *arg) {
    tss__numeric *w = (tss__numeric *)arg;
    (void)worker;
    tss__assemble_strip(w, w->view, block * TSS__STRIP);
}

static void tss__panel_task(int block, int worker, void *arg) {
    tss__numeric *w = (tss__numeric *)arg;
    int R = w->view->K + w->view->M, r = w->panel + block * TSS__TILE_ROWS;
    (void)worker;
    tss__update_panel(w->view, w->panel, r, tss__min_int(TSS__TILE_ROWS, R - r));
}

static void tss__finish_task(int block, int worker, void *arg) {
    tss__numeric *w = (tss__numeric *)arg;
    const tss__view *v = w->view;
    int R = v->K + v->M;
    int r = tss__min_int(v->K, w->panel + TSS__PANEL) + block * TSS__TILE_ROWS;
    (void)worker;
    tss__finish_panel(v, w->panel, r, tss__min_int(TSS__TILE_ROWS, R - r));
}

// Tiles of U are numbered down the panels, left to right.
static int tss__tiles_of(int M, int c) { return tss__blocks(M - c, TSS__TILE_ROWS); }

static void tss__tile_task(int block, int worker, void *arg) {
    tss__numeric *w = (tss__numeric *)arg;
    int M = w->view->M, c = 0;
    (void)worker;
    while (block >= tss__tiles_of(M, c)) block -= tss__tiles_of(M, c), c += TSS__PANEL;
    int r = c + block * TSS__TILE_ROWS;
    tss__update_tile(w, w->view, c, r, tss__min_int(TSS__TILE_ROWS, M - r));
}

// One front above the subtrees, its tiles in parallel; −1 or the failing unknown.
static int tss__factor_large(tss__numeric *w, int f) {
    const tss_host *h = &w->c->host;
    tss__view v;
    tss__view_open(w, f, NULL, 1, (int *)w->c->map.p, &v);
    int R = v.K + v.M, tiles = 0;
    w->view = &v;
    tss_parallel(h, tss__blocks(v.K, TSS__STRIP), tss__strip_task, w);
    for (int c = 0; c < v.K; c += TSS__PANEL) {
        w->panel = c;
        if (c) tss_parallel(h, tss__blocks(R - c, TSS__TILE_ROWS), tss__panel_task, w);
        int bad = tss__factor_diagonal(w, &v, c), r = tss__min_int(v.K, c + TSS__PANEL);
        if (bad >= 0) return bad;
        tss_parallel(h, tss__blocks(R - r, TSS__TILE_ROWS), tss__finish_task, w);
    }
    for (int c = 0; c < v.M; c += TSS__PANEL) tiles += tss__tiles_of(v.M, c);
    tss_parallel(h, tiles, tss__tile_task, w);
    return -1;
}

// All memory of the numbers.
static tss_result tss__factor_reserve(tss_chol *c) {
    const tss__sym *y = &c->sym[c->now];
    size_t workers = (size_t)tss_workers(&c->host), n = (size_t)y->n;
    if (!tss__need_doubles(&c->host, &c->L, (size_t)y->loff[y->fronts]) ||
        !tss__need_doubles(&c->host, &c->arena, (size_t)y->arena) ||
        !tss__need_doubles(&c->host, &c->task_arena, workers * (size_t)y->task_arena) ||
        !tss__need_doubles(&c->host, &c->diag, n * (size_t)y->d) ||
        !tss__need_ints(&c->host, &c->map, workers * n) ||
        !tss__need_ints(&c->host, &c->bad, (size_t)y->tasks))
        return TSS_ERROR_NO_MEMORY;
    return TSS_OK;
}

// Runs the schedule; −1 or the failing unknown in the order of L.
static int tss__factor_run(tss__numeric *w) {
    const tss__sym *y = w->y;
    const int *bad = (const int *)w->c->bad.p;
    for (int k = 0; k < y->steps; k++) {
        const tss__step *s = &y->step[k];
        if (s->task_begin == s->task_end) {
            int b = tss__factor_large(w, s->front);
            if (b >= 0) return b;
            continue;
        }
        w->batch = s->task_begin;
        tss_parallel(&w->c->host, s->task_end - s->task_begin, tss__factor_task, w);
        for (int t = s->task_begin; t < s->task_end; t++)
            if (bad[t] >= 0) return bad[t];
    }
    return -1;
}

tss_result tss_chol_factor(tss_chol *c, const tss_bcsr *A, const tss_bcsr *B,
                           const uint8_t *fixed) {
    const tss__sym *y = &c->sym[c->now];
    c->bad_row = -1;
    c->factored = 0;
    if (!c->analyzed) return TSS_ERROR_NOT_PREPARED;
    if (!tss__graph_ok(A, B) || A->n != y->n || A->d != y->d) return TSS_ERROR_BAD_ARGUMENT;
    for (int s = 0; s < 2; s++) {
        const tss_bcsr *m = s ? B : A;
        if (!m || (m->pattern && m->pattern == c->pattern[s])) continue;
        int in = tss__sym_contains(c, y, m);
        if (in <= 0) return in ? TSS_ERROR_NO_MEMORY : TSS_ERROR_BAD_ARGUMENT;
    }
    tss_result r = tss__factor_reserve(c);
    if (r) return r;
    tss__numeric w;
    memset(&w, 0, sizeof w);
    w.c = c, w.y = y, w.m[0] = A, w.m[1] = B, w.fixed = fixed, w.d = y->d;
    int bad = tss__factor_run(&w);
    if (bad >= 0) {
        c->bad_row = y->perm[bad / y->d] * y->d + bad % y->d;
        return TSS_ERROR_SINGULAR;
    }
    c->factored = 1;
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>cholesky_solve (private)
// L y = P b, then Lᵀ z = y, x = Pᵀ z, for up to TSS__RHS right-hand sides at a time: L is read once
// forwards and once backwards, so the cost of few columns is that of the memory. A subtree writes
// its own unknowns in place and collects what it subtracts from those above in a buffer of its own
// (its roots' rows); the buffers are subtracted in order of the tasks. Fronts above: row tiles.
// ---------------------------------------------------------------------------------------------

enum { TSS__RHS = 16, TSS__SOLVE_ROWS = 480 };  // whole nodes for d = 1, 2, 3

typedef struct tss__solver {
    tss_chol *c;
    const tss__sym *y;
    double *x, *given;  // n·d × k: in the order of L; the caller's
    double *scratch;    // of each worker: a row tile × k
    double *part;       // of each row tile (tasks: of each worker): PANEL × k
    double *above;      // rows above the roots of tasks × k
    ptrdiff_t ld;       // of x and given
    int k, f, panel, batch;
} tss__solver;

// A row tile of a panel: entries (r .. r + rows, c .. c + width) of front f.
typedef struct tss__slab {
    int f, K, R, c, width, r, rows;
    const double *l;
    int ld;
} tss__slab;

static void tss__slab_open(const tss__solver *w, int f, int c, int r, tss__slab *s) {
    const tss__sym *y = w->y;
    s->f = f, s->c = c, s->r = r;
    s->K = (y->first[f + 1] - y->first[f]) * y->d;
    s->R = s->K + (int)(y->rowptr[f + 1] - y->rowptr[f]) * y->d;
    s->width = tss__min_int(TSS__PANEL, s->K - c);
    s->rows = tss__min_int(TSS__SOLVE_ROWS, s->R - r);
    s->ld = tss__panel_ld(s->R, c);
    s->l = tss__panel((double *)w->c->L.p + y->loff[f], s->R, c) + (r - c);
}

// Y (rows × k) = slab · x_panel.
static void tss__slab_times(const tss__solver *w, const tss__slab *s, double *Y) {
    const double *x = w->x + (ptrdiff_t)w->y->first[s->f] * w->y->d + s->c;
    if (w->k == 1) tss__gemv_n(s->rows, s->width, s->l, s->ld, x, Y);
    else tss__gemm_nn(s->rows, w->k, s->width, 1, s->l, s->ld, x, (int)w->ld, 0, Y, s->rows);
}

// Place of the slab's row i (a whole node's first) in x.
static ptrdiff_t tss__slab_row(const tss__solver *w, const tss__slab *s, int i) {
    const tss__sym *y = w->y;
    if (i < s->K) return (ptrdiff_t)y->first[s->f] * y->d + i;
    return (ptrdiff_t)y->rows[y->rowptr[s->f] + (i - s->K) / y->d] * y->d;
}

// x −= Y at the slab's rows; rows from node limit on go to above by map (tasks only).
static void tss__slab_scatter(const tss__solver *w, const tss__slab *s, const double *Y,
                              int limit, double *above, ptrdiff_t above_ld, const int *map) {
    int d = w->y->d, step;
    for (int i = s->r; i < s->r + s->rows; i += step) {
        ptrdiff_t at = tss__slab_row(w, s, i), ld = w->ld;
        double *x = w->x + at;
        step = i < s->K ? tss__min_int(s->K, s->r + s->rows) - i : d;
        if (at >= (ptrdiff_t)limit * d) x = above + (ptrdiff_t)map[at / d] * d, ld = above_ld;
        for (int q = 0; q < w->k; q++)
            for (int a = 0; a < step; a++)
                x[q * ld + a] -= Y[(ptrdiff_t)q * s->rows + (i - s->r) + a];
    }
}

// G (rows × k) = x at the slab's rows.
static void tss__slab_gather(const tss__solver *w, const tss__slab *s, double *G) {
    int d = w->y->d, step;
    for (int i = s->r; i < s->r + s->rows; i += step) {
        const double *x = w->x + tss__slab_row(w, s, i);
        step = i < s->K ? tss__min_int(s->K, s->r + s->rows) - i : d;
        for (int q = 0; q < w->k; q++)
            for (int a = 0; a < step; a++)
                G[(ptrdiff_t)q * s->rows + (i - s->r) + a] = x[q * w->ld + a];
    }
}

// part (PANEL × k) = slabᵀ · x at its rows.
static void tss__slab_transposed(const tss__solver *w, const tss__slab *s, double *G,
                                 double *part) {
    tss__slab_gather(w, s, G);
    if (w->k == 1) tss__gemv_t(s->rows, s->width, s->l, s->ld, G, part);
    else
        tss__gemm_tn(s->width, w->k, s->rows, 1, s->l, s->ld, G, s->rows, 0, part, TSS__PANEL);
}

// The triangle of panel c of front f: x := L⁻¹ x, or L⁻ᵀ x.
static void tss__solve_diagonal(const tss__solver *w, int f, int c, int transposed) {
    tss__slab s;
    tss__slab_open(w, f, c, c, &s);
    double *x = w->x + (ptrdiff_t)w->y->first[f] * w->y->d + c;
    if (transposed) tss__solve_upper(s.width, w->k, s.l, s.ld, x, (int)w->ld);
    else tss__solve_lower(s.width, w->k, s.l, s.ld, x, (int)w->ld);
}

// x_panel −= part.
static void tss__subtract_part(const tss__solver *w, int f, int c, int width, const double *part) {
    double *x = w->x + (ptrdiff_t)w->y->first[f] * w->y->d + c;
    for (int q = 0; q < w->k; q++)
        for (int i = 0; i < width; i++) x[q * w->ld + i] -= part[(ptrdiff_t)q * TSS__PANEL + i];
}

// Root of f's subtree within a task that ends at end.
static int tss__task_root(const tss__sym *y, int f, int end) {
    while (y->parent[f] >= 0 && y->parent[f] < end) f = y->parent[f];
    return f;
}

static double *tss__worker_scratch(const tss__solver *w, int worker) {
    return w->scratch + (ptrdiff_t)worker * (TSS__SOLVE_ROWS + TSS__PANEL) * w->k;
}

static void tss__forward_front(const tss__solver *w, int f, int root, double *Y, const int *map) {
    const tss__sym *y = w->y;
    double *above = w->above + y->aoff[root] * y->d * w->k;
    ptrdiff_t ld = (ptrdiff_t)(y->rowptr[root + 1] - y->rowptr[root]) * y->d;
    tss__slab s;
    tss__slab_open(w, f, 0, 0, &s);
    for (int c = 0, K = s.K, R = s.R; c < K; c += TSS__PANEL) {
        tss__solve_diagonal(w, f, c, 0);
        for (int r = tss__min_int(K, c + TSS__PANEL); r < R; r += TSS__SOLVE_ROWS) {
            tss__slab_open(w, f, c, r, &s);
            tss__slab_times(w, &s, Y);
            tss__slab_scatter(w, &s, Y, y->first[root + 1], above, ld, map);
        }
    }
}

static void tss__forward_task(int block, int worker, void *arg) {
    tss__solver *w = (tss__solver *)arg;
    const tss__sym *y = w->y;
    int t = y->task_order[w->batch + block], end = y->task_begin[2 * t + 1], root = -1;
    int *map = (int *)w->c->map.p + (ptrdiff_t)worker * y->n;
    for (int f = y->task_begin[2 * t]; f < end; f++) {
        if (f > root) {
            root = tss__task_root(y, f, end);
            int64_t lo = y->rowptr[root], m = y->rowptr[root + 1] - lo;
            for (int64_t e = 0; e < m; e++) map[y->rows[lo + e]] = (int)e;
            double *above = w->above + y->aoff[root] * y->d * w->k;
            for (int64_t i = 0; i < m * y->d * w->k; i++) above[i] = 0;
        }
        tss__forward_front(w, f, root, tss__worker_scratch(w, worker), map);
    }
}

static void tss__backward_task(int block, int worker, void *arg) {
    tss__solver *w = (tss__solver *)arg;
    const tss__sym *y = w->y;
    int t = y->task_order[w->batch + block];
    double *G = tss__worker_scratch(w, worker), *part = G + (ptrdiff_t)TSS__SOLVE_ROWS * w->k;
    for (int f = y->task_begin[2 * t + 1] - 1; f >= y->task_begin[2 * t]; f--) {
        tss__slab s;
        tss__slab_open(w, f, 0, 0, &s);
        int K = s.K, R = s.R;
        for (int c = (K - 1) / TSS__PANEL * TSS__PANEL; c >= 0; c -= TSS__PANEL) {
            for (int r = tss__min_int(K, c + TSS__PANEL); r < R; r += TSS__SOLVE_ROWS) {
                tss__slab_open(w, f, c, r, &s);
                tss__slab_transposed(w, &s, G, part);
                tss__subtract_part(w, f, c, s.width, part);
            }
            tss__solve_diagonal(w, f, c, 1);
        }
    }
}

// x += what the subtrees of a task collected (already negative).
static void tss__add_above(const tss__solver *w, int t) {
    const tss__sym *y = w->y;
    int end = y->task_begin[2 * t + 1], d = y->d;
    for (int f = y->task_begin[2 * t]; f < end; f++) {
        if (y->parent[f] < 0 || y->parent[f] < end) continue;
        int64_t lo = y->rowptr[f], m = y->rowptr[f + 1] - lo;
        const double *above = w->above + y->aoff[f] * d * w->k;
        for (int q = 0; q < w->k; q++)
            for (int64_t e = 0; e < m; e++)
                for (int a = 0; a < d; a++)
                    w->x[q * w->ld + (ptrdiff_t)y->rows[lo + e] * d + a] += *above++;
    }
}

static void tss__forward_tile(int block, int worker, void *arg) {
    tss__solver *w = (tss__solver *)arg;
    tss__slab s;
    double *Y = tss__worker_scratch(w, worker);
    tss__slab_open(w, w->f, w->panel, 0, &s);
    int r = tss__min_int(s.K, w->panel + TSS__PANEL) + block * TSS__SOLVE_ROWS;
    tss__slab_open(w, w->f, w->panel, r, &s);
    tss__slab_times(w, &s, Y);
    tss__slab_scatter(w, &s, Y, w->y->n, NULL, 0, NULL);
}

static void tss__backward_tile(int block, int worker, void *arg) {
    tss__solver *w = (tss__solver *)arg;
    tss__slab s;
    tss__slab_open(w, w->f, w->panel, 0, &s);
    int r = tss__min_int(s.K, w->panel + TSS__PANEL) + block * TSS__SOLVE_ROWS;
    tss__slab_open(w, w->f, w->panel, r, &s);
    tss__slab_transposed(w, &s, tss__worker_scratch(w, worker),
                         w->part + (ptrdiff_t)block * TSS__PANEL * w->k);
}

static void tss__forward_large(tss__solver *w, int f) {
    tss__slab s;
    tss__slab_open(w, f, 0, 0, &s);
    w->f = f;
    for (int c = 0; c < s.K; c += TSS__PANEL) {
        w->panel = c;
        tss__solve_diagonal(w, f, c, 0);
        tss_parallel(&w->c->host,
                     tss__blocks(s.R - tss__min_int(s.K, c + TSS__PANEL), TSS__SOLVE_ROWS),
                     tss__forward_tile, w);
    }
}

static void tss__backward_large(tss__solver *w, int f) {
    tss__slab s;
    tss__slab_open(w, f, 0, 0, &s);
    w->f = f;
    for (int c = (s.K - 1) / TSS__PANEL * TSS__PANEL; c >= 0; c -= TSS__PANEL) {
        int tiles = tss__blocks(s.R - tss__min_int(s.K, c + TSS__PANEL), TSS__SOLVE_ROWS);
        w->panel = c;
        tss_parallel(&w->c->host, tiles, tss__backward_tile, w);
        for (int b = 0; b < tiles; b++)
            tss__subtract_part(w, f, c, tss__min_int(TSS__PANEL, s.K - c),
                               w->part + (ptrdiff_t)b * TSS__PANEL * w->k);
        tss__solve_diagonal(w, f, c, 1);
    }
}

// Both substitutions along the schedule, forwards and then back.
static void tss__solve_run(tss__solver *w) {
    const tss__sym *y = w->y;
    const tss_host *h = &w->c->host;
    for (int i = 0; i < y->steps; i++) {
        const tss__step *s = &y->step[i];
        if (s->task_begin == s->task_end) {
            tss__forward_large(w, s->front);
            continue;
        }
        w->batch = s->task_begin;
        tss_parallel(h, s->task_end - s->task_begin, tss__forward_task, w);
        for (int t = s->task_begin; t < s->task_end; t++) tss__add_above(w, t);
    }
    for (int i = y->steps - 1; i >= 0; i--) {
        const tss__step *s = &y->step[i];
        w->batch = s->task_begin;
        if (s->task_begin == s->task_end) tss__backward_large(w, s->front);
        else tss_parallel(h, s->task_end - s->task_begin, tss__backward_task, w);
    }
}

// x = P given, or given = Pᵀ x, for the nodes of one block.
static void tss__permute(const tss__solver *w, int block, int back) {
    const tss__sym *y = w->y;
    int d = y->d, lo = block * TSS__ROWS, hi = tss__min_int(y->n, lo + TSS__ROWS);
    for (int q = 0; q < w->k; q++) {
        for (int i = lo; i < hi; i++) {
            double *x = w->x + q * w->ld + (ptrdiff_t)i * d;
            double *g = w->given + q * w->ld + (ptrdiff_t)y->perm[i] * d;
            for (int a = 0; a < d; a++) {
                if (back) g[a] = x[a];
                else x[a] = g[a];
            }
        }
    }
}

static void tss__permute_task(int block, int worker, void *arg) {
    (void)worker;
    tss__permute((tss__solver *)arg, block, 0);
}

static void tss__permute_back_task(int block, int worker, void *arg) {
    (void)worker;
    tss__permute((tss__solver *)arg, block, 1);
}

// Memory for k columns at a time.
static tss_result tss__solve_reserve(tss_chol *c, int k, tss__solver *w) {
    const tss__sym *y = w->y;
    size_t workers = (size_t)tss_workers(&c->host), K = (size_t)k, n = (size_t)y->n,
           d = (size_t)y->d;
    size_t tiles = (size_t)tss__blocks(y->max_rows * y->d, TSS__SOLVE_ROWS) + 1;
    w->x = tss__need_doubles(&c->host, &c->rhs, (n + (size_t)y->above) * d * K);
    w->part = tss__need_doubles(&c->host, &c->part,
                                (tiles * TSS__PANEL +
                                 workers * (TSS__SOLVE_ROWS + TSS__PANEL)) * K);
    if (!w->x || !w->part || !tss__need_ints(&c->host, &c->map, workers * n))
        return TSS_ERROR_NO_MEMORY;
    w->above = w->x + n * d * K;
    w->scratch = w->part + tiles * TSS__PANEL * K;
    return TSS_OK;
}

tss_result tss_chol_solve(tss_chol *c, double *X, int k) {
    if (!c->factored) return TSS_ERROR_NOT_PREPARED;
    if (k < 0) return TSS_ERROR_BAD_ARGUMENT;
    tss__solver w;
    memset(&w, 0, sizeof w);
    w.c = c, w.y = &c->sym[c->now];
    w.ld = (ptrdiff_t)w.y->n * w.y->d;
    if (!k || !w.ld) return TSS_OK;
    tss_result r = tss__solve_reserve(c, tss__min_int(k, TSS__RHS), &w);
    if (r) return r;
    int blocks = tss__blocks(w.y->n, TSS__ROWS);
    for (int q = 0; q < k; q += TSS__RHS) {
        w.given = X + q * w.ld;
        w.k = tss__min_int(TSS__RHS, k - q);
        tss_parallel(&c->host, blocks, tss__permute_task, &w);
        tss__solve_run(&w);
        tss_parallel(&c->host, blocks, tss__permute_back_task, &w);
    }
    return TSS_OK;
}

// r = b − (A + B) x with identity rows where fixed; ‖r‖² to sums[0], ‖b‖² to sums[1] of the block.
typedef struct tss__residual_job {
    const tss_bcsr *A, *B;
    const uint8_t *fixed;
    const double *b, *x;
    double *masked, *r, *sums;
} tss__residual_job;

static void tss__masked_task(int block, int worker, void *arg) {
    tss__residual_job *j = (tss__residual_job *)arg;
    (void)worker;
    int d = j->A->d, lo = block * TSS__ROWS, hi = tss__min_int(j->A->n, lo + TSS__ROWS);
    for (ptrdiff_t i = (ptrdiff_t)lo * d; i < (ptrdiff_t)hi * d; i++)
        j->masked[i] = j->fixed && j->fixed[i] ? 0 : j->x[i];
}

static void tss__residual_task(int block, int worker, void *arg) {
    tss__residual_job *j = (tss__residual_job *)arg;
    (void)worker;
    int d = j->A->d, lo = block * TSS__ROWS, hi = tss__min_int(j->A->n, lo + TSS__ROWS);
    tss__spmv(j->A, lo, hi, j->masked, j->r, 0);
    if (j->B) tss__spmv(j->B, lo, hi, j->masked, j->r, 1);
    for (ptrdiff_t i = (ptrdiff_t)lo * d; i < (ptrdiff_t)hi * d; i++)
        j->r[i] = j->b[i] - (j->fixed && j->fixed[i] ? j->x[i] : j->r[i]);
    ptrdiff_t at = (ptrdiff_t)lo * d;
    int m = (hi - lo) * d;
    j->sums[2 * block] = tss__dot_short(m, j->r + at, j->r + at);
    j->sums[2 * block + 1] = tss__dot_short(m, j->b + at, j->b + at);
}

static double tss__residual(const tss_host *h, tss__residual_job *j) {
    int blocks = tss__blocks(j->A->n, TSS__ROWS);
    double rr = 0, bb = 0;
    tss_parallel(h, blocks, tss__masked_task, j);
    tss_parallel(h, blocks, tss__residual_task, j);
    for (int b = 0; b < blocks; b++) rr += j->sums[2 * b], bb += j->sums[2 * b + 1];
    return bb > 0 ? sqrt(rr / bb) : sqrt(rr);
}

tss_result tss_chol_solve_refined(tss_chol *c, const tss_bcsr *A, const tss_bcsr *B,
                                  const uint8_t *fixed, const double *b, double *x, int steps,
                                  double *residual) {
    const tss__sym *y = &c->sym[c->now];
    if (!c->factored) return TSS_ERROR_NOT_PREPARED;
    if (!tss__graph_ok(A, B) || A->n != y->n || A->d != y->d || steps < 0 || b == x)
        return TSS_ERROR_BAD_ARGUMENT;
    size_t N = (size_t)y->n * (size_t)y->d;
    double *mem = tss__need_doubles(&c->host, &c->refine,
                                    2 * N + 2 * (size_t)tss__blocks(y->n, TSS__ROWS));
    if (!mem) return TSS_ERROR_NO_MEMORY;
    tss__residual_job j;
    j.A = A, j.B = B, j.fixed = fixed, j.b = b, j.x = x;
    j.r = mem, j.masked = mem + N, j.sums = mem + 2 * N;
    if (N) memcpy(x, b, N * sizeof(double));
    tss_result r = tss_chol_solve(c, x, 1);
    for (int s = 0; !r && s < steps; s++) {
        tss__residual(&c->host, &j);
        r = tss_chol_solve(c, j.r, 1);
        for (size_t i = 0; !r && i < N; i++) x[i] += j.r[i];
    }
    if (!r && residual) *residual = tss__residual(&c->host, &j);
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>dense_cholesky (private)
// The recursions of >>dense_kernels on a whole matrix.
// ---------------------------------------------------------------------------------------------

static double tss__dense_diag_max(int n, const double *a, int lda) {
    double m = 0;
    for (int i = 0; i < n; i++) m = fmax(m, a[i + (ptrdiff_t)i * lda]);
    return m;
}

// Panels of TSS__PANEL columns, left to right: Cholesky of the diagonal block, rows below, then
// the update of what is left.
tss_result tss_dense_chol_factor(int n, double *a, int lda, int *bad) {
    double diag[TSS__PANEL];
    if (bad) *bad = -1;
    if (n < 0 || lda < n) return TSS_ERROR_BAD_ARGUMENT;
    for (int c = 0; c < n; c += TSS__PANEL) {
        int w = tss__min_int(TSS__PANEL, n - c), m = n - c - w;
        double *p = a + c + (ptrdiff_t)c * lda, *below = p + w;
        // Left-looking, so that each panel's diagonal is read before it is touched.
        for (int i = 0; i < w; i++) diag[i] = p[i + (ptrdiff_t)i * lda];
        if (c) {
            tss__syrk(w, c, a + c, lda, 1, p, lda);
            if (m) tss__gemm_nt(m, w, c, -1, a + c + w, lda, a + c, lda, 1, below, lda);
        }
        int b = tss__potrf(w, p, lda, diag, 7e-15);
        if (b >= 0) {
            if (bad) *bad = c + b;
            return TSS_ERROR_SINGULAR;
        }
        tss__trsm(m, w, p, lda, below, lda);
    }
    return TSS_OK;
}

void tss_dense_chol_solve(int n, const double *l, int lda, double *x, int ldx, int k) {
    for (int c = 0; c < n; c += TSS__PANEL) {
        int w = tss__min_int(TSS__PANEL, n - c), m = n - c - w;
        const double *p = l + c + (ptrdiff_t)c * lda;
        tss__solve_lower(w, k, p, lda, x + c, ldx);
        if (m && k) tss__gemm_nn(m, k, w, -1, p + w, lda, x + c, ldx, 1, x + c + w, ldx);
    }
    for (int c = (n - 1) / TSS__PANEL * TSS__PANEL; n && c >= 0; c -= TSS__PANEL) {
        int w = tss__min_int(TSS__PANEL, n - c), m = n - c - w;
        const double *p = l + c + (ptrdiff_t)c * lda;
        if (m && k) tss__gemm_tn(w, k, m, -1, p + w, lda, x + c + w, ldx, 1, x + c, ldx);
        tss__solve_upper(w, k, p, lda, x + c, ldx);
    }
}

static void tss__swap(double *a, double *b) {
    double t = *a;
    *a = *b, *b = t;
}

// Exchanges rows and columns i < j of the lower triangle, the columns of L already there included.
static void tss__dense_swap(int n, double *a, int lda, int i, int j) {
    ptrdiff_t s = lda;
    for (int k = 0; k < i; k++) tss__swap(&a[i + k * s], &a[j + k * s]);
    tss__swap(&a[i + i * s], &a[j + j * s]);
    for (int k = i + 1; k < j; k++) tss__swap(&a[k + i * s], &a[j + k * s]);
    for (int k = j + 1; k < n; k++) tss__swap(&a[k + i * s], &a[k + j * s]);
}

// One block of columns [c, c + w) of the pivoted factorisation, left-looking inside the block
// (Lucas 2004): left[i] is what remains of a_ii. Returns the columns done.
static int tss__pivoted_block(int n, double *a, int lda, int c, int w, double stop, int *perm,
                              double *left) {
    for (int j = c; j < c + w; j++) {
        int best = j;
        for (int i = j; i < n; i++)
            if (left[i] > left[best]) best = i;
        if (!(left[best] > stop)) return j - c;
        if (best != j) {
            tss__dense_swap(n, a, lda, j, best);
            tss__swap(&left[j], &left[best]);
            int t = perm[j];
            perm[j] = perm[best], perm[best] = t;
        }
        double *aj = a + (ptrdiff_t)j * lda, pivot = sqrt(left[j]), inv = 1 / pivot;
        for (int k = c; k < j; k++) {
            const double *ak = a + (ptrdiff_t)k * lda;
            double f = ak[j];
            for (int i = j + 1; i < n; i++) aj[i] -= ak[i] * f;
        }
        aj[j] = pivot;
        for (int i = j + 1; i < n; i++) {
            aj[i] *= inv;
            left[i] -= aj[i] * aj[i];
        }
    }
    return w;
}

void tss_dense_chol_pivoted(int n, double *a, int lda, double drop, int *perm, int *rank,
                            double *work) {
    enum { W = TSS__DIAG };
    double stop = fmax(drop, 0) * tss__dense_diag_max(n, a, lda);
    for (int i = 0; i < n; i++) perm[i] = i;
    *rank = 0;
    for (int c = 0; c < n; c += W) {
        int w = tss__min_int(W, n - c);
        for (int i = c; i < n; i++) work[i] = a[i + (ptrdiff_t)i * lda];
        int done = tss__pivoted_block(n, a, lda, c, w, stop, perm, work);
        *rank = c + done;
        if (done < w) return;
        int m = n - c - w;
        double *below = a + c + w + (ptrdiff_t)c * lda;
        if (m) tss__syrk(m, w, below, lda, 1, below + (ptrdiff_t)w * lda, lda);
    }
}


// ---------------------------------------------------------------------------------------------
// >>buffers (private)
// tss__buf arrays that keep their contents when they grow.
// ---------------------------------------------------------------------------------------------

// Room for count items of the given size, contents kept; NULL without memory (buf unchanged).
static void *tss__need(const tss_host *host, tss__buf *buf, size_t count, size_t item) {
    if (count == 0) count = 1;
    if (count > (SIZE_MAX / 4) / item) return NULL;
    size_t want = count * item;
    if (want <= buf->bytes) return buf->p;
    if (buf->bytes > 0) want += want / 4;  // growth: few reallocations while a scene settles
    void *at = tss_alloc(host, want);
    if (!at) return NULL;
    if (buf->bytes > 0) memcpy(at, buf->p, buf->bytes);
    tss_free(host, buf->p, buf->bytes);
    buf->p = at;
    buf->bytes = want;
    return at;
}

static double *tss__f64(const tss__buf *b) { return (double *)b->p; }
static int *tss__i32(const tss__buf *b) { return (int *)b->p; }
static uint8_t *tss__u8(const tss__buf *b) { return (uint8_t *)b->p; }

static double tss__max(double a, double b) { return a > b ? a : b; }
static double tss__min(double a, double b) { return a < b ? a : b; }

// ---------------------------------------------------------------------------------------------
// >>world (private)
// Everything a world owns. Sections below name the fields they read and write in their banners.
// ---------------------------------------------------------------------------------------------

#define TSS__COOKIE 0x745353  // proves that a def came from its default function
#define TSS__MAX_ARITY 8

// Blocks of TSS_BATCH stencils, coloured so that two blocks of one colour share no written node.
typedef struct tss__plan {
    int valid, count, blocks, colors;
    uint64_t pattern, stamp;
    tss__buf order;  // int, blocks in colour order
    tss__buf start;  // int, colors + 1
    int serial;      // 1: the last colour's blocks conflict and run one at a time
} tss__plan;

typedef struct tss__entry {  // one energy of the world
    tss_energy_def def;
    char name[48];
    int live, internal;
    tss_stencils list;  // active at the current iterate
    tss__plan plan;
    int slots_valid;
    uint64_t slots_pattern;
    tss__buf slot;     // int, count × arity², block of the matrix or −1
    tss__buf partial;  // double, sums of each block
} tss__entry;

typedef struct tss__bodydata {
    char name[48];
    tss_body_kind kind;
    int removed;
    int first, nodes;
    int cells;
    double thickness;
    tss_material material;
    tss__buf cell;           // int, cells × (dim + 1), world nodes
    tss__buf E, nu, rho;     // double, cells, empty if uniform
    tss__buf triangle, edge, point;  // int, surface in world nodes
    int triangles, edges, points;
} tss__bodydata;

typedef struct tss__matrix {  // a block-CSR matrix with its storage
    tss_bcsr m;
    tss__buf ptr, col, val;
} tss__matrix;

struct tss_world {
    tss_world_def def;
    tss_host host;  // counts what it hands out
    size_t bytes;
    uint64_t allocations, refused;  // calls of the allocator: served, and not
    char error[256];
    int prepared, dim, n;
    double time, diagonal;
    uint64_t steps, topology;
    int history;  // 0: the next step starts the integrator anew
    int unchecked;  // no step has passed this state: 1: at the fresh nodes, 2: anywhere
    tss__buf fresh;  // n: 1: set free since the last check

    // state and node data, n × dim or n
    tss__buf x, v, x_prev, v_prev, a;             // state at t, and what BDF2 and Newmark remember
    tss__buf X, mass, kind, axes, body, target, force;
    tss__buf drag_node, drag_at, drag_k;
    int drags;

    tss__buf bodies;  // tss__bodydata
    int body_count;
    tss__buf entries;  // tss__entry
    int entry_count;
    tss__buf surf_point, surf_edge, surf_triangle;
    tss_surface surface;
    tss__buf elastics;  // tss__elastic_ref
    int elastic_count, elastic_bodies, elastic_alive;
    int inertia_energy, drag_energy;  // entries, −1
    tss__buf inertia_node, drag_list;
    int inertia_count;
    uint64_t inertia_pattern, drag_pattern;

    // the step
    tss_ctx ctx;
    tss__buf x_k, x_t, v_t, x_tilde, x_trial, d, g, g_trial, rhs, moving, row, mask, colormask;
    tss__buf node_of_row, scratch, sys_d, diag;
    int masked;  // some unknown node has fixed axes
    int rows;
    int matrix_valid;
    tss__matrix A, C;  // fixed pattern; stencils that change
    tss__buf pair_count, pair_col;
    uint64_t pattern_stamp, write_stamp;
    tss_chol *chol;
    tss_pcg *pcg;
    double pcg_iterations;  // what recent PCG solves needed (0: none yet)
    int pcg_rest;           // solves to go before PCG is tried again
    tss__buf kept;          // what energies remember, as it was before the step
    tss_step_info info;
    double deadline;
    double phase_from;
    tss_direction_def finder;  // direction NULL: none
    int solved_full;           // the last iterate's direction is the world's own
};

#define TSS__BODY(w, b) (&((tss__bodydata *)(w)->bodies.p)[b])
#define TSS__ENTRY(w, e) (&((tss__entry *)(w)->entries.p)[e])

tss_result tss_world_fail(tss_world *w, tss_result r, const char *format, ...) {
    va_list args;
    va_start(args, format);
    vsnprintf(w->error, sizeof w->error, format, args);
    va_end(args);
    tss_log(&w->host, TSS_LOG_ERROR, "%s", w->error);
    return r;
}

static tss_result tss__no_memory(tss_world *w) {
    return tss_world_fail(w, TSS_ERROR_NO_MEMORY, "out of memory (%zu bytes in use)", w->bytes);
}

// How a solve ended, and why.
static void tss__stop(tss_world *w, tss_status status, const char *format, ...) {
    va_list args;
    va_start(args, format);
    w->info.status = status;
    vsnprintf(w->info.message, sizeof w->info.message, format, args);
    va_end(args);
}

static double tss__clock(const tss_world *w) {
    return w->def.host.clock ? w->def.host.clock(w->def.host.clock_ctx) : 0.0;
}

// Adds the time since the last call to a phase.
static void tss__phase(tss_world *w, tss_phase p) {
    double now = tss__clock(w);
    w->info.phase_seconds[p] += now - w->phase_from;
    w->phase_from = now;
}

// The world's own host: the caller's allocator behind a count of bytes and calls.
static void *tss__count_alloc(size_t bytes, size_t align, void *ctx) {
    tss_world *w = (tss_world *)ctx;
    const tss_host *h = &w->def.host;
    void *p = h->alloc ? h->alloc(bytes, align, h->memory_ctx) : tss__libc_alloc(bytes, align, NULL);
    if (p) {
        w->bytes += bytes;
        w->allocations++;
    } else {
        w->refused++;
    }
    return p;
}

static void tss__count_free(void *ptr, size_t bytes, void *ctx) {
    tss_world *w = (tss_world *)ctx;
    w->bytes -= bytes;
    tss_free(&w->def.host, ptr, bytes);
}

// ---------------------------------------------------------------------------------------------
// >>plan (private)
// Stencils are visited in blocks of TSS_BATCH. Blocks are coloured greedily in index order, so the
// sums into a node happen in an order that depends on the stencils alone, not on the threads.
// Nodes that never receive a sum (w->moving[i] == 0 and no row) do not count as conflicts: many
// points may touch one obstacle triangle. Cost: O(stencils · arity).
// ---------------------------------------------------------------------------------------------

// Nodes into which gradients and Hessians are summed: unknowns, and kinematic nodes that move.
static int tss__written(const tss_world *w, int node) {
    return node >= 0 && (tss__i32(&w->row)[node] >= 0 || tss__u8(&w->moving)[node]);
}

static tss_result tss__plan_build(tss_world *w, tss__plan *p, const tss_stencils *s, int arity) {
    if (p->valid && p->pattern == s->pattern && p->stamp == w->write_stamp && p->count == s->count)
        return TSS_OK;
    p->valid = 0;
    int blocks = (s->count + TSS_BATCH - 1) / TSS_BATCH;
    int *order = (int *)tss__need(&w->host, &p->order, (size_t)blocks * 2, sizeof(int));
    int *start = (int *)tss__need(&w->host, &p->start, 66, sizeof(int));
    uint64_t *mask = (uint64_t *)tss__need(&w->host, &w->colormask, (size_t)w->n, sizeof(uint64_t));
    if (!order || !start || !mask) return tss__no_memory(w);
    memset(mask, 0, (size_t)w->n * sizeof *mask);
    int *color = order + blocks, used = 0, overflow = 0;
    for (int b = 0; b < blocks; b++) {
        int from = b * TSS_BATCH * arity;
        int to = (b + 1 < blocks ? (b + 1) * TSS_BATCH : s->count) * arity;
        uint64_t taken = 0;
        for (int k = from; k < to; k++)
            if (tss__written(w, s->node[k])) taken |= mask[s->node[k]];
        int c = 0;
        while (c < 62 && (taken >> c & 1)) c++;
        if (c == 62) overflow = 1;  // more conflicts than colours: these run one at a time
        color[b] = c;
        if (c < 62 && c + 1 > used) used = c + 1;
        if (c < 62)
            for (int k = from; k < to; k++)
                if (tss__written(w, s->node[k])) mask[s->node[k]] |= (uint64_t)1 << c;
    }
    int at = 0, colors = used + overflow;
    for (int c = 0; c < colors; c++) {
        int want = c < used ? c : 62;
        start[c] = at;
        for (int b = 0; b < blocks; b++)
            if (color[b] == want) order[at++] = b;
    }
    start[colors] = at;
    p->count = s->count, p->blocks = blocks, p->colors = colors, p->serial = overflow;
    p->pattern = s->pattern, p->stamp = w->write_stamp, p->valid = 1;
    return TSS_OK;
}

typedef struct tss__plan_run {
    const int *order;
    tss_task *task;
    void *arg;
} tss__plan_run;

static void tss__plan_task(int k, int worker, void *arg) {
    const tss__plan_run *r = (const tss__plan_run *)arg;
    r->task(r->order[k], worker, r->arg);
}

// Runs task on every block, colour by colour.
static void tss__plan_execute(const tss_host *host, const tss__plan *p, tss_task *task, void *arg) {
    const int *start = tss__i32(&p->start);
    for (int c = 0; c < p->colors; c++) {
        int count = start[c + 1] - start[c];
        tss__plan_run run;
        run.order = tss__i32(&p->order) + start[c], run.task = task, run.arg = arg;
        if (count <= 2 || (p->serial && c == p->colors - 1))  // not worth a fork, or not allowed
            for (int k = 0; k < count; k++) tss__plan_task(k, 0, &run);
        else
            tss_parallel(host, count, tss__plan_task, &run);
    }
}

// ---------------------------------------------------------------------------------------------
// >>evaluate (private)
// E, ∇E and ∇²E summed over all energies. Each is a pass over batches of the hook.
// ---------------------------------------------------------------------------------------------

typedef struct tss__pass {
    tss_world *w;
    tss__entry *e;
    const tss_stencils *list;
    const double *x;
    double scale;
    double *out;        // values: block sums, 2 a block; gradient: n × dim
    const double *d_k;  // Hessian: displacement of the kinematic nodes, or NULL
    double *rhs;
    tss__matrix *m;
    double *scratch;
    size_t scratch_each;
    const uint8_t *want;  // Hessian: stencils to add, or NULL for all
    const double *x1;     // ring drop: where the energy is taken the second time
} tss__pass;

static int tss__id(tss_ids ids, int k) { return ids.list ? ids.list[k] : ids.first + k; }

static tss_ids tss__block_ids(const tss_stencils *s, int b) {
    tss_ids ids;
    ids.first = b * TSS_BATCH;
    ids.count = s->count - ids.first < TSS_BATCH ? s->count - ids.first : TSS_BATCH;
    ids.list = NULL;
    return ids;
}

static double tss__scale(const tss_world *w, const tss__entry *e) {
    return e->def.flags & TSS_ENERGY_TIMES_AH2 ? w->ctx.ah2 : 1.0;
}

static void tss__value_task(int b, int worker, void *arg) {
    const tss__pass *p = (const tss__pass *)arg;
    (void)worker;
    double out[TSS_BATCH], sum = 0, size = 0;
    tss_ids ids = tss__block_ids(p->list, b);
    p->e->def.value(p->e->def.user, &p->w->ctx, p->x, ids, out);
    for (int k = 0; k < ids.count; k++) sum += out[k], size += fabs(out[k]);
    p->out[2 * b] = sum, p->out[2 * b + 1] = size;
}

// Adds an energy's value at x over the given list to *sum, and its magnitude to *size.
static tss_result tss__add_value(tss_world *w, tss__entry *e, const tss_stencils *list,
                                 const double *x, double *sum, double *size) {
    int blocks = (list->count + TSS_BATCH - 1) / TSS_BATCH;
    double *out = (double *)tss__need(&w->host, &e->partial, (size_t)blocks * 2, sizeof(double));
    if (!out) return tss__no_memory(w);
    tss__pass p;
    memset(&p, 0, sizeof p);
    p.w = w, p.e = e, p.list = list, p.x = x, p.out = out;
    if (blocks <= 2)
        for (int b = 0; b < blocks; b++) tss__value_task(b, 0, &p);
    else
        tss_parallel(&w->host, blocks, tss__value_task, &p);
    double s = 0, a = 0;
    for (int b = 0; b < blocks; b++) s += out[2 * b], a += out[2 * b + 1];
    *sum += tss__scale(w, e) * s, *size += tss__scale(w, e) * a;
    return TSS_OK;
}

static void tss__gradient_task(int b, int worker, void *arg) {
    const tss__pass *p = (const tss__pass *)arg;
    (void)worker;
    int A = p->e->def.arity, dim = p->w->dim;
    double out[TSS_BATCH * TSS__MAX_ARITY * 3];
    tss_ids ids = tss__block_ids(p->list, b);
    p->e->def.gradient(p->e->def.user, &p->w->ctx, p->x, ids, out);
    const int *node = p->list->node + (size_t)ids.first * (size_t)A;
    for (int k = 0; k < ids.count * A; k++) {
        if (!tss__written(p->w, node[k])) continue;
        for (int c = 0; c < dim; c++)
            p->out[node[k] * dim + c] += p->scale * out[k * dim + c];
    }
}

// Adds an energy's gradient over the given list to g (n × dim).
static tss_result tss__add_gradient(tss_world *w, tss__entry *e, const tss_stencils *list,
                                    const double *x, double *g) {
    tss_result r = tss__plan_build(w, &e->plan, list, e->def.arity);
    if (r != TSS_OK) return r;
    tss__pass p;
    memset(&p, 0, sizeof p);
    p.w = w, p.e = e, p.list = list, p.x = x, p.out = g, p.scale = tss__scale(w, e);
    tss__plan_execute(&w->host, &e->plan, tss__gradient_task, &p);
    return TSS_OK;
}

// Sums an energy's stencils one by one, into all nodes, obstacles too: for queries, not for steps.
static void tss__gradient_serial(tss_world *w, tss__entry *e, const double *x, double *g) {
    double out[TSS_BATCH * TSS__MAX_ARITY * 3];
    int A = e->def.arity, dim = w->dim;
    for (int b = 0; b * TSS_BATCH < e->list.count; b++) {
        tss_ids ids = tss__block_ids(&e->list, b);
        e->def.gradient(e->def.user, &w->ctx, x, ids, out);
        const int *node = e->list.node + (size_t)ids.first * (size_t)A;
        for (int k = 0; k < ids.count * A; k++)
            for (int c = 0; node[k] >= 0 && c < dim; c++) g[node[k] * dim + c] += out[k * dim + c];
    }
}

// Adds H_ab (dim × dim inside a row-major stencil matrix) to a block of the system matrix.
static void tss__scatter_block(double *to, const double *from, int dim, int stride, double scale) {
    for (int r = 0; dim == 3 && r < 3; r++) {  // the same sums, unrolled
        const double *row = from + r * stride;
        double a = to[3 * r] + scale * row[0], b = to[3 * r + 1] + scale * row[1];
        double c = to[3 * r + 2] + scale * row[2];
        to[3 * r] = a, to[3 * r + 1] = b, to[3 * r + 2] = c;
    }
    for (int r = 0; dim != 3 && r < dim; r++)
        for (int c = 0; c < dim; c++) to[r * dim + c] += scale * from[r * stride + c];
}

// rhs of node a's row −= H_ab · (displacement of the kinematic node b)
static void tss__couple(const tss__pass *p, const double *H, int stride, int row, int node_b) {
    int dim = p->w->dim;
    if (!p->d_k || !tss__u8(&p->w->moving)[node_b]) return;
    for (int r = 0; r < dim; r++)
        for (int c = 0; c < dim; c++)
            p->rhs[row * dim + r] -= p->scale * H[r * stride + c] * p->d_k[node_b * dim + c];
}

// Those of a block that are wanted.
static tss_ids tss__wanted(tss_ids ids, const uint8_t *want, int *chosen) {
    int m = 0;
    for (int k = 0; k < ids.count; k++)
        if (want[ids.first + k]) chosen[m++] = ids.first + k;
    if (m < ids.count) ids.list = chosen, ids.count = m;
    return ids;
}

static void tss__hessian_task(int b, int worker, void *arg) {
    const tss__pass *p = (const tss__pass *)arg;
    const int A = p->e->def.arity, dim = p->w->dim, S = A * dim;
    double *out = p->scratch + (size_t)worker * p->scratch_each;
    int chosen[TSS_BATCH];
    tss_ids ids = tss__block_ids(p->list, b);
    if (p->want) ids = tss__wanted(ids, p->want, chosen);
    if (ids.count == 0) return;
    p->e->def.hessian(p->e->def.user, &p->w->ctx, p->x, ids, 1, out);
    const int *row = tss__i32(&p->w->row);
    double *val = tss__f64(&p->m->val);
    for (int k = 0; k < ids.count; k++, out += S * S) {
        const int *node = p->list->node + (size_t)tss__id(ids, k) * (size_t)A;
        const int *slot = tss__i32(&p->e->slot) + (size_t)tss__id(ids, k) * (size_t)(A * A);
        for (int i = 0; i < A; i++) {
            if (node[i] < 0 || row[node[i]] < 0) continue;
            for (int j = 0; j < A; j++) {
                const double *H = out + i * dim * S + j * dim;
                if (node[j] < 0) continue;
                if (slot[i * A + j] >= 0)
                    tss__scatter_block(val + (size_t)slot[i * A + j] * (size_t)(dim * dim), H, dim, S,
                                   p->scale);
                else
                    tss__couple(p, H, S, row[node[i]], node[j]);
            }
        }
    }
}

// Adds an energy's projected Hessian at x to its matrix, and the pull of moving kinematic nodes
// (displacement d_k, may be NULL) to the right-hand side.
static tss_result tss__add_hessian(tss_world *w, tss__entry *e, const double *x, const uint8_t *want,
                                   const double *d_k, double *rhs) {
    size_t S = (size_t)(e->def.arity * w->dim);
    tss__pass p;
    memset(&p, 0, sizeof p);
    p.scratch_each = TSS_BATCH * S * S;
    p.scratch = (double *)tss__need(&w->host, &w->scratch,
                                    p.scratch_each * (size_t)tss_workers(&w->host), sizeof(double));
    if (!p.scratch) return tss__no_memory(w);
    p.w = w, p.e = e, p.list = &e->list, p.x = x, p.want = want, p.d_k = d_k, p.rhs = rhs;
    p.scale = tss__scale(w, e);
    p.m = e->def.flags & TSS_ENERGY_DYNAMIC ? &w->C : &w->A;
    tss_result r = tss__plan_build(w, &e->plan, &e->list, e->def.arity);
    if (r != TSS_OK) return r;
    tss__plan_execute(&w->host, &e->plan, tss__hessian_task, &p);
    return TSS_OK;
}

static void tss__drop_task(int b, int worker, void *arg) {
    const tss__pass *p = (const tss__pass *)arg;
    (void)worker;
    double from[TSS_BATCH], to[TSS_BATCH], sum = 0;
    int A = p->e->def.arity;
    tss_ids ids = tss__block_ids(p->list, b);
    p->e->def.value(p->e->def.user, &p->w->ctx, p->x, ids, from);
    p->e->def.value(p->e->def.user, &p->w->ctx, p->x1, ids, to);
    const int *node = p->list->node + (size_t)ids.first * (size_t)A;
    for (int k = 0; k < ids.count; k++) {
        double drop = p->scale * (from[k] - to[k]);
        sum += drop;
        for (int i = k * A; i < (k + 1) * A; i++)
            if (node[i] >= 0 && tss__i32(&p->w->row)[node[i]] >= 0) p->out[node[i]] += drop;
    }
    p->rhs[b] = sum;
}

// Eq. (7), stencil by stencil, so that the difference does not drown in the sum.
static tss_result tss__add_drop(tss_world *w, tss__entry *e, const double *x0, const double *x1,
                                double *ring, double *drop) {
    int blocks = (e->list.count + TSS_BATCH - 1) / TSS_BATCH;
    tss_result r = tss__plan_build(w, &e->plan, &e->list, e->def.arity);
    double *sum = (double *)tss__need(&w->host, &e->partial, (size_t)blocks * 2, sizeof(double));
    if (r != TSS_OK || !sum) return r != TSS_OK ? r : tss__no_memory(w);
    tss__pass p;
    memset(&p, 0, sizeof p);
    p.w = w, p.e = e, p.list = &e->list, p.x = x0, p.x1 = x1, p.out = ring, p.rhs = sum;
    p.scale = tss__scale(w, e);
    tss__plan_execute(&w->host, &e->plan, tss__drop_task, &p);
    for (int b = 0; b < blocks; b++) *drop += sum[b];
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>pattern (private)
// Block-CSR patterns from stencil lists: count the pairs of each row, fill, sort, drop doubles.
// ---------------------------------------------------------------------------------------------

// Shell sort: rows are short (15 on average in a tet mesh), a few in contact are long.
static void tss__sort_ints(int *a, int n) {
    static const int gaps[] = {701, 301, 132, 57, 23, 10, 4, 1};
    for (int g = 0; g < 8; g++)
        for (int i = gaps[g], gap = gaps[g]; i < n; i++) {
            int v = a[i], j = i;
            for (; j >= gap && a[j - gap] > v; j -= gap) a[j] = a[j - gap];
            a[j] = v;
        }
}

static int tss__in_matrix(const tss__entry *e, int dynamic) {
    return e->live && !!(e->def.flags & TSS_ENERGY_DYNAMIC) == dynamic;
}

// Visits all (row, col) pairs of the lists of one matrix: counts them, or fills cursor lists.
static void tss__pairs(const tss_world *w, int dynamic, int64_t *cursor, int *col) {
    const int *row = tss__i32(&w->row);
    for (int k = 0; k < w->entry_count; k++) {
        const tss__entry *e = TSS__ENTRY(w, k);
        if (!tss__in_matrix(e, dynamic)) continue;
        int A = e->def.arity;
        for (int s = 0; s < e->list.count; s++) {
            const int *node = e->list.node + (size_t)s * (size_t)A;
            for (int i = 0; i < A; i++) {
                int r = node[i] < 0 ? -1 : row[node[i]];
                if (r < 0) continue;
                for (int j = 0; j < A; j++) {
                    int c = node[j] < 0 ? -1 : row[node[j]];
                    if (c < 0) continue;
                    if (col) col[cursor[r]] = c;
                    cursor[r]++;
                }
            }
        }
    }
}

typedef struct tss__rowsort {
    int rows;
    const int64_t *from;  // rows + 1
    int *col;
    int64_t *unique;
} tss__rowsort;

#define TSS__ROW_BLOCK 1024  // rows a task sorts

static void tss__rowsort_task(int b, int worker, void *arg) {
    const tss__rowsort *s = (const tss__rowsort *)arg;
    (void)worker;
    int to = (b + 1) * TSS__ROW_BLOCK < s->rows ? (b + 1) * TSS__ROW_BLOCK : s->rows;
    for (int r = b * TSS__ROW_BLOCK; r < to; r++) {
        int *c = s->col + s->from[r], n = (int)(s->from[r + 1] - s->from[r]), m = 0;
        tss__sort_ints(c, n);
        for (int k = 0; k < n; k++)
            if (k == 0 || c[k] != c[k - 1]) c[m++] = c[k];
        s->unique[r] = m;
    }
}

// Rebuilds the pattern of A (dynamic = 0) or C (dynamic = 1) from the current lists. A always has
// its diagonal, through the inertia or by an extra pair a row.
static tss_result tss__pattern_build(tss_world *w, tss__matrix *m, int dynamic) {
    size_t rows = (size_t)w->rows;
    int64_t *ptr = (int64_t *)tss__need(&w->host, &m->ptr, rows + 1, sizeof(int64_t));
    int64_t *from = (int64_t *)tss__need(&w->host, &w->pair_count, 2 * rows + 2, sizeof(int64_t));
    if (!ptr || !from) return tss__no_memory(w);
    int64_t *cursor = from + rows + 1;
    memset(cursor, 0, (rows + 1) * sizeof *cursor);
    tss__pairs(w, dynamic, cursor, NULL);
    from[0] = 0;
    for (size_t r = 0; r < rows; r++) from[r + 1] = from[r] + cursor[r] + !dynamic;
    int *pair = (int *)tss__need(&w->host, &w->pair_col, (size_t)from[rows], sizeof(int));
    if (!pair) return tss__no_memory(w);
    memcpy(cursor, from, rows * sizeof *cursor);
    if (!dynamic)
        for (size_t r = 0; r < rows; r++) pair[cursor[r]++] = (int)r;
    tss__pairs(w, dynamic, cursor, pair);
    tss__rowsort sort;
    sort.rows = w->rows, sort.from = from, sort.col = pair, sort.unique = cursor;
    tss_parallel(&w->host, (w->rows + TSS__ROW_BLOCK - 1) / TSS__ROW_BLOCK, tss__rowsort_task, &sort);
    ptr[0] = 0;
    for (size_t r = 0; r < rows; r++) ptr[r + 1] = ptr[r] + cursor[r];
    size_t blocks = (size_t)ptr[rows], dd = (size_t)(w->dim * w->dim);
    if (blocks > INT32_MAX) return tss_world_fail(w, TSS_ERROR_NO_MEMORY, "matrix of %zu blocks", blocks);
    int *col = (int *)tss__need(&w->host, &m->col, blocks, sizeof(int));
    double *val = (double *)tss__need(&w->host, &m->val, blocks * dd, sizeof(double));
    if (!col || !val) return tss__no_memory(w);
    for (size_t r = 0; r < rows; r++)
        memcpy(col + ptr[r], pair + from[r], (size_t)cursor[r] * sizeof(int));
    m->m.n = w->rows, m->m.d = w->dim, m->m.row = ptr, m->m.col = col, m->m.val = val;
    m->m.pattern = ++w->pattern_stamp;
    return TSS_OK;
}

// Block of (row, col), or −1: binary search in the row.
static int tss__find_block(const tss_bcsr *m, int row, int col) {
    int64_t lo = m->row[row], hi = m->row[row + 1];
    while (lo < hi) {
        int64_t mid = lo + (hi - lo) / 2;
        if (m->col[mid] < col)
            lo = mid + 1;
        else
            hi = mid;
    }
    return lo < m->row[row + 1] && m->col[lo] == col ? (int)lo : -1;
}

typedef struct tss__slots {
    const tss_world *w;
    tss__entry *e;
    const tss_bcsr *m;
} tss__slots;

static void tss__slots_task(int b, int worker, void *arg) {
    const tss__slots *s = (const tss__slots *)arg;
    (void)worker;
    const int A = s->e->def.arity;
    const int *row = tss__i32(&s->w->row);
    tss_ids ids = tss__block_ids(&s->e->list, b);
    for (int k = ids.first; k < ids.first + ids.count; k++) {
        const int *node = s->e->list.node + (size_t)k * (size_t)A;
        int *slot = tss__i32(&s->e->slot) + (size_t)k * (size_t)(A * A);
        for (int i = 0; i < A; i++)
            for (int j = 0; j < A; j++) {
                int r = node[i] < 0 ? -1 : row[node[i]], c = node[j] < 0 ? -1 : row[node[j]];
                slot[i * A + j] = r < 0 || c < 0 ? -1 : tss__find_block(s->m, r, c);
            }
    }
}

// Where each stencil's blocks go in its matrix.
static tss_result tss__slots_build(tss_world *w, tss__entry *e) {
    size_t A = (size_t)e->def.arity;
    if (!tss__need(&w->host, &e->slot, (size_t)e->list.count * A * A, sizeof(int)))
        return tss__no_memory(w);
    tss__slots s;
    s.w = w, s.e = e, s.m = e->def.flags & TSS_ENERGY_DYNAMIC ? &w->C.m : &w->A.m;
    tss_parallel(&w->host, (e->list.count + TSS_BATCH - 1) / TSS_BATCH, tss__slots_task, &s);
    e->slots_valid = 1, e->slots_pattern = e->list.pattern;
    return TSS_OK;
}

// Brings one matrix's pattern and slots up to date with the lists; nothing to do in most iterates
// for A, and for C while the set of contacts does not change.
static tss_result tss__pattern_update(tss_world *w, int dynamic) {
    tss__matrix *m = dynamic ? &w->C : &w->A;
    int stale = !w->matrix_valid;
    for (int k = 0; k < w->entry_count; k++) {
        const tss__entry *e = TSS__ENTRY(w, k);
        if (tss__in_matrix(e, dynamic))
            stale |= !e->slots_valid || e->slots_pattern != e->list.pattern;
    }
    if (!stale) return TSS_OK;
    tss_result r = tss__pattern_build(w, m, dynamic);
    for (int k = 0; k < w->entry_count && r == TSS_OK; k++)
        if (tss__in_matrix(TSS__ENTRY(w, k), dynamic)) r = tss__slots_build(w, TSS__ENTRY(w, k));
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>mesh (private)
// Validity of cells, surface extraction, lumped masses. Faces and edges are matched by counting
// on their smallest node and sorting the short rest: O(cells), no hashing, no allocation in qsort.
// ---------------------------------------------------------------------------------------------

typedef struct tss__facet {  // a face or edge: sorted key, and its nodes in orientation order
    int key[3], node[3];
} tss__facet;

static int tss__facet_less(const tss__facet *a, const tss__facet *b) {
    for (int k = 0; k < 3; k++)
        if (a->key[k] != b->key[k]) return a->key[k] < b->key[k];
    return 0;
}

static tss__facet tss__facet_of(int count, const int *node) {
    tss__facet f;
    for (int k = 0; k < 3; k++) f.key[k] = f.node[k] = k < count ? node[k] : -1;
    for (int i = 1; i < count; i++)
        for (int j = i; j > 0 && f.key[j - 1] > f.key[j]; j--) {
            int t = f.key[j];
            f.key[j] = f.key[j - 1], f.key[j - 1] = t;
        }
    return f;
}

// Sorts facets by key: counting sort on the smallest node, insertion inside (valence is small).
static tss_result tss__facet_sort(tss_world *w, tss__facet *f, size_t count, int nodes,
                                  tss__buf *space) {
    size_t head = ((size_t)nodes + 2) * sizeof(int64_t);
    char *at = (char *)tss__need(&w->host, space, head + count * sizeof(tss__facet), 1);
    if (!at) return tss__no_memory(w);
    int64_t *start = (int64_t *)(void *)at;
    tss__facet *sorted = (tss__facet *)(void *)(at + head);
    memset(start, 0, head);
    for (size_t k = 0; k < count; k++) start[f[k].key[0] + 1]++;
    for (int i = 0; i < nodes; i++) start[i + 1] += start[i];
    for (size_t k = 0; k < count; k++) sorted[start[f[k].key[0]]++] = f[k];
    for (size_t k = 1; k < count; k++) {
        tss__facet v = sorted[k];
        size_t j = k;
        for (; j > 0 && tss__facet_less(&v, &sorted[j - 1]); j--) sorted[j] = sorted[j - 1];
        sorted[j] = v;
    }
    memcpy(f, sorted, count * sizeof *f);
    return TSS_OK;
}

static int tss__facet_same(const tss__facet *a, const tss__facet *b) {
    return a->key[0] == b->key[0] && a->key[1] == b->key[1] && a->key[2] == b->key[2];
}

// Signed volume (area in 2D) of a cell.
static double tss__cell_volume(int dim, const double *X, const int *c) {
    const double *p = X + c[0] * dim, *q = X + c[1] * dim, *r = X + c[2] * dim;
    if (dim == 2)
        return 0.5 * ((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]));
    const double *s = X + c[3] * dim;
    double u[3], v[3], t[3];
    for (int k = 0; k < 3; k++) u[k] = q[k] - p[k], v[k] = r[k] - p[k], t[k] = s[k] - p[k];
    return (u[0] * (v[1] * t[2] - v[2] * t[1]) + u[1] * (v[2] * t[0] - v[0] * t[2]) +
            u[2] * (v[0] * t[1] - v[1] * t[0])) / 6.0;
}

static double tss__triangle_area(const double *a, const double *b, const double *c) {
    double u[3], v[3];
    for (int k = 0; k < 3; k++) u[k] = b[k] - a[k], v[k] = c[k] - a[k];
    double x = u[1] * v[2] - u[2] * v[1], y = u[2] * v[0] - u[0] * v[2], z = u[0] * v[1] - u[1] * v[0];
    return 0.5 * sqrt(x * x + y * y + z * z);
}

// A list of cells, triangles, segments or points: every node in range, none twice in one.
static tss_result tss__check_nodes(tss_world *w, const char *body, const char *what, int count,
                                   int size, const int *list, int nodes) {
    if (count < 0 || (count > 0 && !list))
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "%s: %d %ss but no array of them", body, count, what);
    for (int k = 0; k < count; k++)
        for (int i = 0; i < size; i++) {
            int n = list[k * size + i];
            if (n < 0 || n >= nodes)
                return tss_world_fail(w, TSS_ERROR_BAD_MESH, "%s: %s %d names node %d, expected 0..%d",
                                 body, what, k, n, nodes - 1);
            for (int j = 0; j < i; j++)
                if (list[k * size + j] == n)
                    return tss_world_fail(w, TSS_ERROR_BAD_MESH, "%s: %s %d names node %d twice", body,
                                     what, k, n);
        }
    return TSS_OK;
}

static tss_result tss__check_finite(tss_world *w, const char *body, const char *what,
                                    const double *a, int nodes) {
    for (int i = 0; a && i < nodes * w->dim; i++)
        if (!isfinite(a[i]))
            return tss_world_fail(w, TSS_ERROR_BAD_STATE, "%s: %s of node %d is %g, expected a finite number",
                             body, what, i / w->dim, a[i]);
    return TSS_OK;
}

static tss_result tss__check_material(tss_world *w, const char *body, int cell, double E, double nu,
                                      double rho) {
    char where[80];
    snprintf(where, sizeof where, cell < 0 ? "%s" : "%s, cell %d", body, cell);
    if (!(E > 0) || !isfinite(E))
        return tss_world_fail(w, TSS_ERROR_BAD_MATERIAL, "%s: E = %g Pa, expected a positive number", where, E);
    if (!(nu > -1 && nu < 0.5))
        return tss_world_fail(w, TSS_ERROR_BAD_MATERIAL,
                         "%s: nu = %g, expected -1 < nu < 0.5 (0.49 is nearly incompressible)", where, nu);
    if (!(rho > 0) || !isfinite(rho))
        return tss_world_fail(w, TSS_ERROR_BAD_MATERIAL, "%s: rho = %g kg/m^3, expected a positive number",
                         where, rho);
    return TSS_OK;
}

static tss_result tss__check_materials(tss_world *w, const char *body, const tss_body_def *d) {
    int per_cell = d->E || d->nu || d->rho;
    for (int c = per_cell ? 0 : -1; c < (per_cell ? d->cells : 0); c++) {
        tss_result r = tss__check_material(w, body, c, d->E ? d->E[c] : d->material.E,
                                           d->nu ? d->nu[c] : d->material.nu,
                                           d->rho ? d->rho[c] : d->material.rho);
        if (r != TSS_OK) return r;
    }
    return TSS_OK;
}

// Positive volumes; a cell flatter than 1e-12 of its longest edge cubed has no usable gradient.
static tss_result tss__check_volumes(tss_world *w, const char *body, const tss_body_def *d) {
    int dim = w->dim;
    for (int c = 0; c < d->cells; c++) {
        const int *n = d->cell + c * (dim + 1);
        double vol = tss__cell_volume(dim, d->X, n), longest = 0;
        for (int i = 1; i <= dim; i++)
            for (int j = 0; j < i; j++) {
                double l = 0;
                for (int k = 0; k < dim; k++) {
                    double e = d->X[n[i] * dim + k] - d->X[n[j] * dim + k];
                    l += e * e;
                }
                longest = tss__max(longest, sqrt(l));
            }
        double flat = 1e-12 * (dim == 3 ? longest * longest * longest : longest * longest);
        if (fabs(vol) <= flat)
            return tss_world_fail(w, TSS_ERROR_BAD_MESH, "%s: cell %d is degenerate (volume %g)", body, c, vol);
        if (vol < 0)
            return tss_world_fail(w, TSS_ERROR_BAD_MESH,
                             "%s: cell %d is inverted (volume %g); swap two of its nodes", body, c, vol);
    }
    return TSS_OK;
}

static tss_result tss__check_referenced(tss_world *w, const char *body, const tss_body_def *d) {
    if (!tss__need(&w->host, &w->scratch, (size_t)d->nodes, 1)) return tss__no_memory(w);
    uint8_t *used = tss__u8(&w->scratch);
    memset(used, 0, (size_t)d->nodes);
    for (int k = 0; k < d->cells * (w->dim + 1); k++) used[d->cell[k]] = 1;
    for (int k = 0; k < d->triangles * 3; k++) used[d->triangle[k]] = 1;
    for (int k = 0; k < d->segments * 2; k++) used[d->segment[k]] = 1;
    for (int k = 0; k < d->points; k++) used[d->point[k]] = 1;
    for (int i = 0; i < d->nodes; i++)
        if (!used[i])
            return tss_world_fail(w, TSS_ERROR_BAD_MESH, "%s: node %d belongs to no cell, face or segment",
                             body, i);
    return TSS_OK;
}

// What prepare would find out too late: the body is in the world by then.
static tss_result tss__check_kind(tss_world *w, const char *name, const tss_body_def *d) {
    const tss_material *m = &d->material;
    if ((unsigned)m->kind >= TSS_MATERIAL_KINDS)
        return tss_world_fail(w, TSS_ERROR_BAD_MATERIAL, "%s: no material of kind %d", name, (int)m->kind);
    if (m->kind == TSS_CUSTOM_MATERIAL && !m->density)
        return tss_world_fail(w, TSS_ERROR_BAD_MATERIAL, "%s: a custom material needs a density", name);
    if (m->kind == TSS_CUSTOM_MATERIAL && m->damping > 0)
        return tss_world_fail(w, TSS_ERROR_BAD_MATERIAL, "%s: a custom material cannot be damped", name);
    if (d->cells == 0 && (!(d->thickness > 0) || !isfinite(d->thickness)))
        return tss_world_fail(w, TSS_ERROR_BAD_MATERIAL, "%s: thickness = %g m, expected a positive number",
                              name, d->thickness);
    return TSS_OK;
}

static tss_result tss__check_body(tss_world *w, const char *name, const tss_body_def *d) {
    tss_result r;
    if (d->cookie != TSS__COOKIE)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "%s: start from tss_body_def_default()", name);
    if (d->nodes <= 0 || !d->X)
        return tss_world_fail(w, TSS_ERROR_EMPTY, "%s: has no nodes", name);
    if (d->nodes > INT32_MAX / 16 - w->n)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "%s: %d nodes are too many", name, d->nodes);
    if (d->kind == TSS_BODY_SOFT && d->cells == 0 && !(w->dim == 3 && d->triangles > 0))
        return tss_world_fail(w, TSS_ERROR_BAD_MESH, "%s: a soft body needs cells (or triangles: a shell)", name);
    if (d->kind == TSS_BODY_OBSTACLE && d->cells > 0)
        return tss_world_fail(w, TSS_ERROR_BAD_MESH, "%s: an obstacle has a surface, not cells", name);
    if ((r = tss__check_finite(w, name, "rest position", d->X, d->nodes)) != TSS_OK) return r;
    if ((r = tss__check_finite(w, name, "position", d->x0, d->nodes)) != TSS_OK) return r;
    if ((r = tss__check_finite(w, name, "velocity", d->v0, d->nodes)) != TSS_OK) return r;
    if (!d->v0 && (r = tss__check_finite(w, name, "velocity", d->velocity, 1)) != TSS_OK) return r;
    if ((r = tss__check_nodes(w, name, "cell", d->cells, w->dim + 1, d->cell, d->nodes)) != TSS_OK)
        return r;
    if ((r = tss__check_nodes(w, name, "triangle", d->triangles, 3, d->triangle, d->nodes)) != TSS_OK)
        return r;
    if ((r = tss__check_nodes(w, name, "segment", d->segments, 2, d->segment, d->nodes)) != TSS_OK)
        return r;
    if ((r = tss__check_nodes(w, name, "point", d->points, 1, d->point, d->nodes)) != TSS_OK) return r;
    if ((r = tss__check_nodes(w, name, "pin", d->pins, 1, d->pin, d->nodes)) != TSS_OK) return r;
    if (w->dim == 2 && d->triangles > 0)
        return tss_world_fail(w, TSS_ERROR_BAD_MESH, "%s: in 2D, triangles are cells and surfaces segments", name);
    if (d->kind == TSS_BODY_SOFT && (r = tss__check_kind(w, name, d)) != TSS_OK) return r;
    double damping = d->material.damping;
    if (!(damping >= 0) || !isfinite(damping))
        return tss_world_fail(w, TSS_ERROR_BAD_MATERIAL, "%s: damping = %g s, expected >= 0", name, damping);
    const char *left_out = d->cells > 0 ? tss__material_left_out(&d->material) : NULL;
    if (left_out)
        return tss_world_fail(w, TSS_ERROR_BAD_MATERIAL, "%s: its material is left out of this build by %s", name, left_out);
    if ((r = tss__check_volumes(w, name, d)) != TSS_OK) return r;
    if (d->kind == TSS_BODY_SOFT && (r = tss__check_materials(w, name, d)) != TSS_OK) return r;
    return tss__check_referenced(w, name, d);
}

// Facets of all cells, or of given faces; sorted.
static tss_result tss__facets(tss_world *w, int items, int size, const int *item, const int (*pick)[3],
                              int picks, int pick_size, int nodes, tss__buf *out, size_t *count) {
    size_t total = (size_t)items * (size_t)picks;
    tss__facet *f = (tss__facet *)tss__need(&w->host, out, total, sizeof *f);
    if (!f) return tss__no_memory(w);
    for (int k = 0; k < items; k++)
        for (int p = 0; p < picks; p++) {
            int node[3] = {-1, -1, -1};
            for (int i = 0; i < pick_size; i++) node[i] = item[k * size + pick[p][i]];
            f[(size_t)k * (size_t)picks + (size_t)p] = tss__facet_of(pick_size, node);
        }
    *count = total;
    return tss__facet_sort(w, f, total, nodes, &w->scratch);
}

static const int tss__tet_faces[4][3] = {{0, 2, 1}, {0, 1, 3}, {0, 3, 2}, {1, 2, 3}};
static const int tss__triangle_edges[3][3] = {{0, 1, -1}, {1, 2, -1}, {2, 0, -1}};
static const int tss__whole[1][3] = {{0, 1, 2}};

// Facets that occur once, in orientation order; more than two of one is not a manifold mesh.
static tss_result tss__boundary(tss_world *w, const char *name, const tss__facet *f, size_t count,
                                int size, tss__buf *out, int *out_count) {
    size_t m = 0;
    int *to = (int *)tss__need(&w->host, out, count * (size_t)size, sizeof(int));
    if (!to) return tss__no_memory(w);
    for (size_t k = 0, next; k < count; k = next) {
        for (next = k + 1; next < count && tss__facet_same(&f[k], &f[next]);) next++;
        if (next - k > 2)
            return tss_world_fail(w, TSS_ERROR_BAD_MESH, "%s: nodes %d %d %d are a face of %zu cells, expected 1 or 2",
                             name, f[k].key[0], f[k].key[1], f[k].key[2], next - k);
        if (next - k == 1)
            for (int i = 0; i < size; i++) to[m++] = f[k].node[i];
    }
    *out_count = (int)(m / (size_t)size);
    return TSS_OK;
}

// The edges of a body's triangles and its free segments, each once.
static tss_result tss__edges(tss_world *w, tss__bodydata *b, const tss_body_def *d) {
    tss__buf all = {NULL, 0};
    size_t count = 0, m = 0, extra = (size_t)d->segments;
    tss_result r = tss__facets(w, b->triangles, 3, tss__i32(&b->triangle), tss__triangle_edges, 3, 2,
                               d->nodes, &all, &count);
    tss__facet *f = r == TSS_OK ? (tss__facet *)tss__need(&w->host, &all, count + extra, sizeof *f) : NULL;
    if (f) {
        for (size_t k = 0; k < extra; k++) f[count + k] = tss__facet_of(2, d->segment + 2 * k);
        count += extra;
        r = tss__facet_sort(w, f, count, d->nodes, &w->scratch);
    }
    int *to = f ? (int *)tss__need(&w->host, &b->edge, 2 * count, sizeof(int)) : NULL;
    for (size_t k = 0; to && r == TSS_OK && k < count; k++)
        if (k == 0 || !tss__facet_same(&f[k], &f[k - 1])) to[m++] = f[k].key[0], to[m++] = f[k].key[1];
    b->edges = (int)(m / 2);
    tss__buf_free(&w->host, &all);
    return r != TSS_OK ? r : to ? TSS_OK : tss__no_memory(w);
}

// Every node of a triangle, edge or isolated point, ascending.
static tss_result tss__points(tss_world *w, tss__bodydata *b, const tss_body_def *d) {
    int *to = (int *)tss__need(&w->host, &b->point, (size_t)d->nodes, sizeof(int));
    uint8_t *used = (uint8_t *)tss__need(&w->host, &w->scratch, (size_t)d->nodes, 1);
    if (!to || !used) return tss__no_memory(w);
    memset(used, 0, (size_t)d->nodes);
    for (int k = 0; k < 3 * b->triangles; k++) used[tss__i32(&b->triangle)[k]] = 1;
    for (int k = 0; k < 2 * b->edges; k++) used[tss__i32(&b->edge)[k]] = 1;
    for (int k = 0; k < d->points; k++) used[d->point[k]] = 1;
    for (int i = 0; i < d->nodes; i++)
        if (used[i]) to[b->points++] = i;
    return TSS_OK;
}

static tss_result tss__check_duplicates(tss_world *w, const char *name, const tss_body_def *d) {
    // Cells that share all nodes share all faces; a cell twice makes some face occur 2 + 2 times or
    // leaves no boundary at all, so look for equal node sets among cells of equal smallest face.
    int size = w->dim + 1;
    tss__buf all = {NULL, 0};
    size_t count = 0;
    tss__facet *f = (tss__facet *)tss__need(&w->host, &all, (size_t)d->cells, sizeof *f);
    tss_result r = f ? TSS_OK : tss__no_memory(w);
    for (int c = 0; f && c < d->cells; c++) {
        const int *n = d->cell + c * size;
        int s[4], m = size;
        for (int i = 0; i < m; i++) s[i] = n[i];
        tss__sort_ints(s, m);
        f[c] = tss__facet_of(3, s);
        f[c].node[0] = size == 4 ? s[3] : -1, f[c].node[1] = c;
        count++;
    }
    if (r == TSS_OK) r = tss__facet_sort(w, f, count, d->nodes, &w->scratch);
    for (size_t k = 0; r == TSS_OK && k < count; k++)
        for (size_t j = k + 1; j < count && tss__facet_same(&f[j], &f[k]); j++)
            if (f[j].node[0] == f[k].node[0])
                r = tss_world_fail(w, TSS_ERROR_BAD_MESH, "%s: cells %d and %d have the same nodes", name,
                              f[k].node[1], f[j].node[1]);
    tss__buf_free(&w->host, &all);
    return r;
}

// Fills a body's surface (local node numbers).
static tss_result tss__surface(tss_world *w, tss__bodydata *b, const tss_body_def *d) {
    tss__buf all = {NULL, 0};
    size_t count = 0;
    tss_result r = tss__check_duplicates(w, b->name, d);
    if (r != TSS_OK) return r;
    if (w->dim == 3 && d->cells > 0) {
        r = tss__facets(w, d->cells, 4, d->cell, tss__tet_faces, 4, 3, d->nodes, &all, &count);
        if (r == TSS_OK)
            r = tss__boundary(w, b->name, (const tss__facet *)all.p, count, 3, &b->triangle, &b->triangles);
    } else if (w->dim == 3) {
        r = tss__facets(w, d->triangles, 3, d->triangle, tss__whole, 1, 3, d->nodes, &all, &count);
        int *to = r == TSS_OK ? (int *)tss__need(&w->host, &b->triangle, 3 * count, sizeof(int)) : NULL;
        if (to && d->triangles > 0) memcpy(to, d->triangle, 3 * count * sizeof(int));
        if (r == TSS_OK && !to) r = tss__no_memory(w);
        b->triangles = d->triangles;
    }
    if (r == TSS_OK && w->dim == 3) r = tss__edges(w, b, d);
    if (r == TSS_OK && w->dim == 2) {
        r = tss__facets(w, d->cells, 3, d->cell, tss__triangle_edges, 3, 2, d->nodes, &all, &count);
        if (r == TSS_OK)
            r = tss__boundary(w, b->name, (const tss__facet *)all.p, count, 2, &b->edge, &b->edges);
        int *to = r == TSS_OK ? (int *)tss__need(&w->host, &b->edge, 2 * (size_t)(b->edges + d->segments),
                                                 sizeof(int)) : NULL;
        if (r == TSS_OK && !to) r = tss__no_memory(w);
        if (r == TSS_OK && d->segments > 0)
            memcpy(to + 2 * b->edges, d->segment, 2 * (size_t)d->segments * sizeof(int));
        if (r == TSS_OK) b->edges += d->segments;
    }
    tss__buf_free(&w->host, &all);
    return r == TSS_OK ? tss__points(w, b, d) : r;
}

static void tss__shift(tss__buf *list, int count, int by) {
    for (int k = 0; k < count; k++) tss__i32(list)[k] += by;
}

// Lumped masses: each cell's (shell triangle's) mass in equal parts to its nodes.
static void tss__masses(tss_world *w, const tss_body_def *d, double *mass) {
    int size = w->dim + 1;
    for (int i = 0; i < d->nodes; i++) mass[i] = 0;
    if (d->kind == TSS_BODY_OBSTACLE) return;
    for (int c = 0; c < d->cells; c++) {
        double rho = d->rho ? d->rho[c] : d->material.rho;
        double m = rho * tss__cell_volume(w->dim, d->X, d->cell + c * size) / size;
        for (int i = 0; i < size; i++) mass[d->cell[c * size + i]] += m;
    }
    for (int t = 0; t < (d->cells == 0 ? d->triangles : 0); t++) {
        const int *n = d->triangle + 3 * t;
        double a = tss__triangle_area(d->X + 3 * n[0], d->X + 3 * n[1], d->X + 3 * n[2]);
        for (int i = 0; i < 3; i++) mass[n[i]] += d->material.rho * d->thickness * a / 3;
    }
}

// ---------------------------------------------------------------------------------------------
// >>bodies (private)
// ---------------------------------------------------------------------------------------------

tss_body_def tss_body_def_default(void) {
    tss_body_def d;
    memset(&d, 0, sizeof d);
    d.material = tss_material_default();
    d.thickness = 1e-3;
    d.cookie = TSS__COOKIE;
    return d;
}

static void tss__body_free(const tss_host *h, tss__bodydata *b) {
    tss__buf_free(h, &b->cell), tss__buf_free(h, &b->E), tss__buf_free(h, &b->nu), tss__buf_free(h, &b->rho);
    tss__buf_free(h, &b->triangle), tss__buf_free(h, &b->edge), tss__buf_free(h, &b->point);
}

static tss_result tss__copy_cells(tss_world *w, tss__bodydata *b, const tss_body_def *d) {
    size_t cells = (size_t)d->cells, size = (size_t)(w->dim + 1);
    const double *from[3] = {d->E, d->nu, d->rho};
    tss__buf *to[3] = {&b->E, &b->nu, &b->rho};
    if (!tss__need(&w->host, &b->cell, cells * size, sizeof(int))) return tss__no_memory(w);
    if (cells > 0) memcpy(b->cell.p, d->cell, cells * size * sizeof(int));
    for (int k = 0; k < 3; k++) {
        if (!from[k] || cells == 0) continue;
        if (!tss__need(&w->host, to[k], cells, sizeof(double))) return tss__no_memory(w);
        memcpy(to[k]->p, from[k], cells * sizeof(double));
    }
    b->cells = d->cells;
    return TSS_OK;
}

// Room for n nodes in every node array, before anything is changed.
static tss_result tss__nodes_reserve(tss_world *w, size_t n) {
    size_t nd = n * (size_t)w->dim;
    tss__buf *wide[] = {&w->x, &w->v, &w->x_prev, &w->v_prev, &w->a, &w->X, &w->target, &w->force};
    for (size_t k = 0; k < sizeof wide / sizeof *wide; k++)
        if (!tss__need(&w->host, wide[k], nd, sizeof(double))) return tss__no_memory(w);
    if (!tss__need(&w->host, &w->mass, n, sizeof(double)) || !tss__need(&w->host, &w->kind, n, 1) ||
        !tss__need(&w->host, &w->axes, n, 1) || !tss__need(&w->host, &w->fresh, n, 1) ||
        !tss__need(&w->host, &w->body, n, sizeof(int)))
        return tss__no_memory(w);
    return TSS_OK;
}

static void tss__nodes_append(tss_world *w, const tss_body_def *d, int id) {
    int dim = w->dim, first = w->n;
    size_t at = (size_t)(first * dim), len = (size_t)(d->nodes * dim);
    double *X = tss__f64(&w->X) + at, *x = tss__f64(&w->x) + at, *v = tss__f64(&w->v) + at;
    memcpy(X, d->X, len * sizeof(double));
    memcpy(x, d->x0 ? d->x0 : d->X, len * sizeof(double));
    for (size_t k = 0; k < len; k++) v[k] = d->v0 ? d->v0[k] : d->velocity[k % (size_t)dim];
    memcpy(tss__f64(&w->x_prev) + at, x, len * sizeof(double));
    memcpy(tss__f64(&w->v_prev) + at, v, len * sizeof(double));
    memcpy(tss__f64(&w->target) + at, x, len * sizeof(double));
    memset(tss__f64(&w->a) + at, 0, len * sizeof(double));
    memset(tss__f64(&w->force) + at, 0, len * sizeof(double));
    tss__masses(w, d, tss__f64(&w->mass) + first);
    for (int i = 0; i < d->nodes; i++) {
        tss__i32(&w->body)[first + i] = id;
        tss__u8(&w->axes)[first + i] = tss__u8(&w->fresh)[first + i] = 0;
        tss__u8(&w->kind)[first + i] = d->kind == TSS_BODY_OBSTACLE ? TSS_NODE_OBSTACLE : TSS_NODE_FREE;
    }
    for (int k = 0; k < d->pins; k++) {
        tss__u8(&w->kind)[first + d->pin[k]] = TSS_NODE_PINNED;
        for (int c = 0; c < dim; c++) v[d->pin[k] * dim + c] = 0;
    }
    w->n += d->nodes;
}

tss_result tss_body_add(tss_world *w, const tss_body_def *d, tss_body *out) {
    if (!w || !d) return TSS_ERROR_BAD_ARGUMENT;
    if (out) *out = -1;
    tss__bodydata b;
    memset(&b, 0, sizeof b);
    if (d->cookie == TSS__COOKIE && d->name)
        snprintf(b.name, sizeof b.name, "%s", d->name);
    else
        snprintf(b.name, sizeof b.name, "body %d", w->body_count);
    tss_result r = tss__check_body(w, b.name, d);
    if (r != TSS_OK) return r;
    b.kind = d->kind, b.first = w->n, b.nodes = d->nodes;
    b.thickness = d->thickness, b.material = d->material;
    r = tss__surface(w, &b, d);
    if (r == TSS_OK) r = tss__copy_cells(w, &b, d);
    if (r == TSS_OK) r = tss__nodes_reserve(w, (size_t)(w->n + d->nodes));
    if (r == TSS_OK && !tss__need(&w->host, &w->bodies, (size_t)w->body_count + 1, sizeof b))
        r = tss__no_memory(w);
    if (r != TSS_OK) {
        tss__body_free(&w->host, &b);
        return r;
    }
    tss__shift(&b.cell, b.cells * (w->dim + 1), b.first);
    tss__shift(&b.triangle, 3 * b.triangles, b.first);
    tss__shift(&b.edge, 2 * b.edges, b.first);
    tss__shift(&b.point, b.points, b.first);
    tss__nodes_append(w, d, w->body_count);
    *TSS__BODY(w, w->body_count) = b;
    if (out) *out = w->body_count;
    w->body_count++;
    w->prepared = 0, w->history = 0, w->unchecked = 2;
    return TSS_OK;
}

static int tss__has_body(const tss_world *w, tss_body b) {
    return w && b >= 0 && b < w->body_count && !TSS__BODY(w, b)->removed;
}

tss_result tss_body_remove(tss_world *w, tss_body id) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (!tss__has_body(w, id)) return tss_world_fail(w, TSS_ERROR_NOT_FOUND, "no body %d", id);
    tss__bodydata *b = TSS__BODY(w, id);
    b->removed = 1;
    b->cells = b->triangles = b->edges = b->points = 0;
    for (int i = b->first; i < b->first + b->nodes; i++) {
        tss__u8(&w->kind)[i] = TSS_NODE_OBSTACLE;
        tss__f64(&w->mass)[i] = 0;
        for (int c = 0; c < w->dim; c++) {
            tss__f64(&w->target)[i * w->dim + c] = tss__f64(&w->x)[i * w->dim + c];
            tss__f64(&w->v)[i * w->dim + c] = 0;
        }
    }
    w->prepared = 0;
    return TSS_OK;
}

int tss_world_bodies(const tss_world *w) { return w->body_count; }

tss_result tss_body_get(const tss_world *w, tss_body b, tss_body_info *out) {
    if (!w || !out || b < 0 || b >= w->body_count) return TSS_ERROR_NOT_FOUND;
    const tss__bodydata *d = TSS__BODY(w, b);
    out->name = d->name, out->kind = d->kind, out->first_node = d->first, out->nodes = d->nodes;
    out->cells = d->cells, out->removed = d->removed;
    return TSS_OK;
}

const int *tss_body_cells(const tss_world *w, tss_body b) {
    return b >= 0 && b < w->body_count ? tss__i32(&TSS__BODY(w, b)->cell) : NULL;
}

// ---------------------------------------------------------------------------------------------
// >>setters (private)
// A change of node kinds makes the next prepare renumber the unknowns; targets and forces do not.
// ---------------------------------------------------------------------------------------------

static tss_result tss__has_node(tss_world *w, int node) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (node < 0 || node >= w->n)
        return tss_world_fail(w, TSS_ERROR_NOT_FOUND, "no node %d, expected 0..%d", node, w->n - 1);
    return TSS_OK;
}

static tss_result tss__finite(tss_world *w, const char *what, const double *a, int count) {
    for (int k = 0; k < count; k++)
        if (!isfinite(a[k]))
            return tss_world_fail(w, TSS_ERROR_BAD_STATE, "%s: component %d is %g, expected a finite number",
                             what, k, a[k]);
    return TSS_OK;
}

// A kinematic node may lie where no free one could be: setting it free asks for a check of the start,
// at the nodes concerned only, so that pins that come and go do not pay for the whole scene.
static void tss__set_kind(tss_world *w, int node, uint8_t kind, uint8_t axes) {
    uint8_t *k = tss__u8(&w->kind) + node, *a = tss__u8(&w->axes) + node;
    if (*k == kind && *a == axes) return;
    if (*k != TSS_NODE_FREE && kind == TSS_NODE_FREE) {
        tss__u8(&w->fresh)[node] = 1;
        w->unchecked = w->unchecked ? w->unchecked : 1;
    }
    *k = kind, *a = axes;
    w->prepared = 0;
}

tss_result tss_node_pin(tss_world *w, int node, unsigned axes) {
    tss_result r = tss__has_node(w, node);
    if (r != TSS_OK) return r;
    unsigned all = w->dim == 3 ? 7u : 3u;
    const tss__bodydata *b = TSS__BODY(w, tss__i32(&w->body)[node]);
    if (b->kind == TSS_BODY_OBSTACLE || b->removed)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "node %d belongs to %s", node,
                              b->removed ? "a removed body" : "an obstacle");
    axes &= all;
    tss__set_kind(w, node, axes == all ? TSS_NODE_PINNED : TSS_NODE_FREE,
                  (uint8_t)(axes == all ? 0 : axes));
    for (int k = node * w->dim, c = 0; c < w->dim; k++, c++) {
        tss__f64(&w->target)[k] = tss__f64(&w->x)[k];
        if (!(axes >> c & 1)) continue;
        // at rest, also for the integrator: the speed it had must not come back
        tss__f64(&w->x_prev)[k] = tss__f64(&w->x)[k];
        tss__f64(&w->v)[k] = tss__f64(&w->v_prev)[k] = tss__f64(&w->a)[k] = 0;
    }
    return TSS_OK;
}

tss_result tss_node_target(tss_world *w, int node, const double *target) {
    tss_result r = tss__has_node(w, node);
    if (r == TSS_OK && !target) r = tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "node %d: target is NULL", node);
    if (r == TSS_OK) r = tss__finite(w, "target", target, w->dim);
    if (r == TSS_OK && TSS__BODY(w, tss__i32(&w->body)[node])->removed)
        r = tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "node %d belongs to a removed body", node);
    if (r != TSS_OK) return r;
    if (tss__u8(&w->kind)[node] != TSS_NODE_OBSTACLE) tss__set_kind(w, node, TSS_NODE_SCRIPTED, 0);
    memcpy(tss__f64(&w->target) + node * w->dim, target, (size_t)w->dim * sizeof(double));
    return TSS_OK;
}

tss_result tss_body_target(tss_world *w, tss_body id, const double *x) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (!tss__has_body(w, id)) return tss_world_fail(w, TSS_ERROR_NOT_FOUND, "no body %d", id);
    const tss__bodydata *b = TSS__BODY(w, id);
    size_t at = (size_t)(b->first * w->dim), len = (size_t)(b->nodes * w->dim);
    tss_result r = x ? tss__finite(w, b->name, x, (int)len) : TSS_OK;
    if (r != TSS_OK) return r;
    memcpy(tss__f64(&w->target) + at, x ? x : tss__f64(&w->x) + at, len * sizeof(double));
    for (int i = b->first; i < b->first + b->nodes; i++)
        if (b->kind != TSS_BODY_OBSTACLE) tss__set_kind(w, i, TSS_NODE_SCRIPTED, 0);
    return TSS_OK;
}

tss_result tss_node_force(tss_world *w, int node, const double *force) {
    tss_result r = tss__has_node(w, node);
    if (r == TSS_OK && !force) r = tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "node %d: force is NULL", node);
    if (r == TSS_OK) r = tss__finite(w, "force", force, w->dim);
    if (r != TSS_OK) return r;
    memcpy(tss__f64(&w->force) + node * w->dim, force, (size_t)w->dim * sizeof(double));
    return TSS_OK;
}

static tss_result tss__drags_reserve(tss_world *w, size_t n) {
    if (!tss__need(&w->host, &w->drag_node, n, sizeof(int)) ||
        !tss__need(&w->host, &w->drag_at, n * (size_t)w->dim, sizeof(double)) ||
        !tss__need(&w->host, &w->drag_k, n, sizeof(double)))
        return tss__no_memory(w);
    return TSS_OK;
}

tss_result tss_node_drag(tss_world *w, int node, const double *target, double stiffness) {
    tss_result r = tss__has_node(w, node);
    if (r == TSS_OK && (!target || !(stiffness >= 0) || !isfinite(stiffness)))
        r = tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "drag of node %d: stiffness %g N/m, expected >= 0 and a target",
                      node, stiffness);
    if (r == TSS_OK) r = tss__finite(w, "drag target", target, w->dim);
    if (r != TSS_OK) return r;
    int k = 0;
    while (k < w->drags && tss__i32(&w->drag_node)[k] != node) k++;
    if (stiffness == 0 && k == w->drags) return TSS_OK;
    if ((r = tss__drags_reserve(w, (size_t)k + 1)) != TSS_OK) return r;
    if (k == w->drags) w->drags++, w->drag_pattern++;
    tss__i32(&w->drag_node)[k] = node;
    tss__f64(&w->drag_k)[k] = stiffness;
    memcpy(tss__f64(&w->drag_at) + k * w->dim, target, (size_t)w->dim * sizeof(double));
    if (stiffness == 0) {  // let go: the last one takes the place
        int last = --w->drags;
        tss__i32(&w->drag_node)[k] = tss__i32(&w->drag_node)[last];
        tss__f64(&w->drag_k)[k] = tss__f64(&w->drag_k)[last];
        memmove(tss__f64(&w->drag_at) + k * w->dim, tss__f64(&w->drag_at) + last * w->dim,
                (size_t)w->dim * sizeof(double));
        w->drag_pattern++;
    }
    return TSS_OK;
}

tss_result tss_body_teleport(tss_world *w, tss_body id, const double *x, const double *v) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (!tss__has_body(w, id)) return tss_world_fail(w, TSS_ERROR_NOT_FOUND, "no body %d", id);
    const tss__bodydata *b = TSS__BODY(w, id);
    size_t at = (size_t)(b->first * w->dim), len = (size_t)(b->nodes * w->dim);
    if (!x) return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "%s: no positions", b->name);
    tss_result r = tss__finite(w, b->name, x, (int)len);
    if (r == TSS_OK && v) r = tss__finite(w, b->name, v, (int)len);
    if (r != TSS_OK) return r;
    memcpy(tss__f64(&w->x) + at, x, len * sizeof(double));
    memcpy(tss__f64(&w->target) + at, x, len * sizeof(double));
    for (size_t k = 0; k < len; k++) tss__f64(&w->v)[at + k] = v ? v[k] : 0;
    w->history = 0, w->unchecked = 2;
    return TSS_OK;
}

tss_result tss_world_set_gravity(tss_world *w, const double *gravity) {
    if (!w || !gravity) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss__finite(w, "gravity", gravity, w->dim);
    for (int c = 0; r == TSS_OK && c < w->dim; c++) w->def.gravity[c] = gravity[c];
    return r;
}

tss_result tss_world_set_dt(tss_world *w, double dt) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (!(dt > 0) || !isfinite(dt))
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "dt = %g s, expected a positive number", dt);
    if (dt != w->def.dt) w->history = 0;
    w->def.dt = dt;
    return TSS_OK;
}

tss_result tss_world_set_tol(tss_world *w, double tol) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (!(tol > 0)) return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "tol = %g m/s, expected > 0", tol);
    w->def.tol = tol;
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>inertia (private)
// K = ½ Σ m_i ‖x_i − x̃_i‖² (Eq. 2) over the free nodes with mass, and the springs of
// tss_node_drag. Both are stencil energies of arity 1 on the public hook; user is the world.
// Quasi-static steps have no inertia; the loads that x̃ carries otherwise stand in its place:
// −(m g + f)·(x − x_t).
// ---------------------------------------------------------------------------------------------

static tss_result tss__inertia_lists(void *user, const tss_ctx *c, const double *x, const double *d,
                                     double t_max, tss_stencils *out) {
    const tss_world *w = (const tss_world *)user;
    (void)x, (void)d, (void)t_max;
    (void)c;
    out->count = w->inertia_count;
    out->node = tss__i32(&w->inertia_node), out->pattern = w->inertia_pattern;
    return TSS_OK;
}


static double tss__load(const tss_world *w, int node, int axis) {
    return tss__f64(&w->mass)[node] * w->def.gravity[axis] + tss__f64(&w->force)[node * w->dim + axis];
}

static void tss__inertia_value(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const tss_world *w = (const tss_world *)user;
    for (int k = 0; k < ids.count; k++) {
        int i = tss__i32(&w->inertia_node)[tss__id(ids, k)];
        double s = 0;
        for (int a = 0; a < c->dim; a++) {
            double u = x[i * c->dim + a] - c->x_tilde[i * c->dim + a];
            s += c->quasistatic ? -tss__load(w, i, a) * u : 0.5 * c->mass[i] * u * u;
        }
        out[k] = s;
    }
}

static void tss__inertia_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const tss_world *w = (const tss_world *)user;
    for (int k = 0; k < ids.count; k++) {
        int i = tss__i32(&w->inertia_node)[tss__id(ids, k)];
        for (int a = 0; a < c->dim; a++)
            out[k * c->dim + a] = c->quasistatic
                                      ? -tss__load(w, i, a)
                                      : c->mass[i] * (x[i * c->dim + a] - c->x_tilde[i * c->dim + a]);
    }
}

static void tss__scaled_identity(double *out, int dim, double s) {
    for (int a = 0; a < dim * dim; a++) out[a] = a % (dim + 1) == 0 ? s : 0;
}

static void tss__inertia_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids, int psd,
                                 double *out) {
    const tss_world *w = (const tss_world *)user;
    (void)x, (void)psd;
    for (int k = 0; k < ids.count; k++) {
        double m = c->mass[tss__i32(&w->inertia_node)[tss__id(ids, k)]];
        tss__scaled_identity(out + k * c->dim * c->dim, c->dim, c->quasistatic ? 0 : m);
    }
}

static void tss__inertia_describe(void *user, const tss_ctx *c, int id, char *text, size_t size) {
    const tss_world *w = (const tss_world *)user;
    int i = tss__i32(&w->inertia_node)[id];
    snprintf(text, size, "node %d of %s", i, TSS__BODY(w, c->body[i])->name);
}

static tss_result tss__drag_lists(void *user, const tss_ctx *c, const double *x, const double *d,
                                  double t_max, tss_stencils *out) {
    const tss_world *w = (const tss_world *)user;
    (void)c, (void)x, (void)d, (void)t_max;
    out->count = w->drags, out->node = tss__i32(&w->drag_node), out->pattern = w->drag_pattern;
    return TSS_OK;
}

static void tss__drag_value(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const tss_world *w = (const tss_world *)user;
    for (int k = 0; k < ids.count; k++) {
        int s = tss__id(ids, k), i = tss__i32(&w->drag_node)[s];
        double sum = 0;
        for (int a = 0; a < c->dim; a++) {
            double u = x[i * c->dim + a] - tss__f64(&w->drag_at)[s * c->dim + a];
            sum += u * u;
        }
        out[k] = 0.5 * tss__f64(&w->drag_k)[s] * sum;
    }
}

static void tss__drag_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const tss_world *w = (const tss_world *)user;
    for (int k = 0; k < ids.count; k++) {
        int s = tss__id(ids, k), i = tss__i32(&w->drag_node)[s];
        for (int a = 0; a < c->dim; a++)
            out[k * c->dim + a] = tss__f64(&w->drag_k)[s] *
                                  (x[i * c->dim + a] - tss__f64(&w->drag_at)[s * c->dim + a]);
    }
}

static void tss__drag_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids, int psd,
                              double *out) {
    const tss_world *w = (const tss_world *)user;
    (void)x, (void)psd;
    for (int k = 0; k < ids.count; k++)
        tss__scaled_identity(out + k * c->dim * c->dim, c->dim, tss__f64(&w->drag_k)[tss__id(ids, k)]);
}

// ---------------------------------------------------------------------------------------------
// >>registry (private)
// The world's list of energies. A removed one leaves its place; ids never change.
// ---------------------------------------------------------------------------------------------

tss_energy_def tss_energy_def_default(void) {
    tss_energy_def d;
    memset(&d, 0, sizeof d);
    d.cookie = TSS__COOKIE;
    return d;
}

tss_result tss_energy_add(tss_world *w, const tss_energy_def *d, tss_energy *out) {
    if (!w || !d) return TSS_ERROR_BAD_ARGUMENT;
    if (out) *out = -1;
    const char *name = d->cookie == TSS__COOKIE && d->name ? d->name : "energy";
    if (d->cookie != TSS__COOKIE)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "energy: start from tss_energy_def_default()");
    if (d->arity < 1 || d->arity > TSS__MAX_ARITY)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "%s: arity %d, expected 1..%d", name, d->arity,
                         TSS__MAX_ARITY);
    if (!d->lists || !d->value || !d->gradient || !d->hessian)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT,
                         "%s: lists, value, gradient and hessian are required", name);
    int id = w->entry_count;
    for (int k = w->entry_count - 1; k >= 0; k--)  // the first place of a replaced internal energy
        if (!TSS__ENTRY(w, k)->live && TSS__ENTRY(w, k)->internal) id = k;
    if (!tss__need(&w->host, &w->entries, (size_t)id + 1, sizeof(tss__entry))) return tss__no_memory(w);
    tss__entry *e = TSS__ENTRY(w, id);
    if (id == w->entry_count) {
        memset(e, 0, sizeof *e);
        w->entry_count++;
    }
    e->def = *d;
    e->live = 1, e->internal = 0, e->slots_valid = 0, e->plan.valid = 0;
    memset(&e->list, 0, sizeof e->list);
    snprintf(e->name, sizeof e->name, "%s", name);
    e->def.name = NULL;  // e->name is the copy
    if (d->check) w->unchecked = 2;
    w->prepared = 0, w->matrix_valid = 0;
    if (out) *out = id;
    return TSS_OK;
}

tss_result tss_energy_remove(tss_world *w, tss_energy id) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (id < 0 || id >= w->entry_count || !TSS__ENTRY(w, id)->live)
        return tss_world_fail(w, TSS_ERROR_NOT_FOUND, "no energy %d", id);
    tss__entry *e = TSS__ENTRY(w, id);
    if (e->def.destroy) e->def.destroy(e->def.user, &w->host);
    e->live = 0;
    w->prepared = 0, w->matrix_valid = 0;
    return TSS_OK;
}

static tss_result tss__internal_energies(tss_world *w) {
    tss_energy_def d = tss_energy_def_default();
    tss_result r = TSS_OK;
    d.name = "inertia", d.arity = 1, d.user = w, d.flags = TSS_ENERGY_CONST_HESSIAN;
    d.lists = tss__inertia_lists, d.value = tss__inertia_value, d.gradient = tss__inertia_gradient;
    d.hessian = tss__inertia_hessian, d.describe = tss__inertia_describe;
    if ((r = tss_energy_add(w, &d, &w->inertia_energy)) != TSS_OK) return r;
    d.name = "drag", d.flags = TSS_ENERGY_CONST_HESSIAN | TSS_ENERGY_TIMES_AH2;
    d.lists = tss__drag_lists, d.value = tss__drag_value, d.gradient = tss__drag_gradient;
    d.hessian = tss__drag_hessian, d.describe = NULL;
    return tss_energy_add(w, &d, &w->drag_energy);
}

// ---------------------------------------------------------------------------------------------
// >>elastic_groups (private)
// One elastic energy for all cells of one kind of density, whatever their bodies: a pile of five
// hundred bodies is one batch. Cells are sorted along a Morton curve within each body, so that a
// block of TSS_BATCH cells shares nodes and few blocks conflict.
// ---------------------------------------------------------------------------------------------

typedef struct tss__elastic_ref {
    tss_energy energy, damping;  // entries, −1: none
    tss__elastic *e;
    tss__buf label;  // int: the body's own cell numbers
} tss__elastic_ref;

typedef struct tss__cellkey {
    uint64_t key;
    int body, cell;
} tss__cellkey;

static int tss__same_density(const tss__bodydata *a, const tss__bodydata *b) {
    return a->material.kind == b->material.kind && a->material.damping == b->material.damping &&
           (a->material.kind != TSS_CUSTOM_MATERIAL ||
            (a->material.density == b->material.density && a->material.user == b->material.user));
}

// 20 bits an axis, interleaved.
static uint64_t tss__morton(const double *p, const double *lo, double scale, int dim) {
    uint64_t key = 0, q[3] = {0, 0, 0};
    for (int a = 0; a < dim; a++) {
        double v = (p[a] - lo[a]) * scale;
        q[a] = v <= 0 ? 0 : v >= 1048575 ? 1048575 : (uint64_t)v;
    }
    for (int bit = 19; bit >= 0; bit--)
        for (int a = 0; a < dim; a++) key = key << 1 | (q[a] >> bit & 1);
    return key;
}

// Stable merge sort by key.
static void tss__sort_keys(tss__cellkey *a, tss__cellkey *space, size_t n) {
    tss__cellkey *from = a, *to = space;
    for (size_t run = 1; run < n; run *= 2) {
        for (size_t lo = 0; lo < n; lo += 2 * run) {
            size_t mid = lo + run < n ? lo + run : n, hi = lo + 2 * run < n ? lo + 2 * run : n;
            size_t i = lo, j = mid;
            for (size_t k = lo; k < hi; k++)
                to[k] = i < mid && (j >= hi || from[i].key <= from[j].key) ? from[i++] : from[j++];
        }
        tss__cellkey *t = from;
        from = to, to = t;
    }
    if (from != a) memcpy(a, from, n * sizeof *a);
}

// The cells of one body, keyed.
static void tss__body_keys(const tss_world *w, int id, tss__cellkey *out) {
    const tss__bodydata *b = TSS__BODY(w, id);
    const double *X = tss__f64(&w->X);
    double lo[3] = {INFINITY, INFINITY, INFINITY}, extent = 0;
    int dim = w->dim, size = dim + 1;
    for (int a = 0; a < dim; a++) {
        double hi = -INFINITY;
        for (int i = b->first; i < b->first + b->nodes; i++) {
            lo[a] = tss__min(lo[a], X[i * dim + a]);
            hi = tss__max(hi, X[i * dim + a]);
        }
        extent = tss__max(extent, hi - lo[a]);
    }
    for (int k = 0; k < b->cells; k++) {
        double p[3] = {0, 0, 0};
        for (int i = 0; i < size; i++)
            for (int a = 0; a < dim; a++) p[a] += X[tss__i32(&b->cell)[k * size + i] * dim + a] / size;
        out[k].key = tss__morton(p, lo, extent > 0 ? 1048575 / extent : 0, dim);
        out[k].body = id, out[k].cell = k;
    }
}

static void tss__elastic_clear(tss_world *w) {
    for (int k = 0; k < w->elastic_count; k++) {
        tss__elastic_ref *r = &((tss__elastic_ref *)w->elastics.p)[k];
        tss_energy *ids[2] = {&r->damping, &r->energy};  // damping reads the other
        for (int i = 0; i < 2; i++) {
            if (*ids[i] < 0) continue;
            tss_energy_remove(w, *ids[i]);
            TSS__ENTRY(w, *ids[i])->internal = 1;
        }
        tss__buf_free(&w->host, &r->label);
    }
    w->elastic_count = 0;
}

// Node lists, labels and per-cell parameters of a sorted group, then its energy.
static tss_result tss__elastic_make(tss_world *w, const tss__bodydata *lead, const tss__cellkey *key,
                                    size_t cells, tss__buf *space) {
    size_t size = (size_t)w->dim + 1;
    if (!tss__need(&w->host, &w->elastics, (size_t)w->elastic_count + 1, sizeof(tss__elastic_ref)))
        return tss__no_memory(w);
    tss__elastic_ref *ref = &((tss__elastic_ref *)w->elastics.p)[w->elastic_count];
    memset(ref, 0, sizeof *ref);
    ref->energy = ref->damping = -1;
    int *label = (int *)tss__need(&w->host, &ref->label, cells, sizeof(int));
    double *par = (double *)tss__need(&w->host, space, cells * (2 * sizeof(double) + size * sizeof(int)), 1);
    if (!label || !par) {
        tss__buf_free(&w->host, &ref->label);
        return tss__no_memory(w);
    }
    double *E = par, *nu = par + cells;
    int *node = (int *)(void *)(par + 2 * cells), differ = 0;
    for (size_t k = 0; k < cells; k++) {
        const tss__bodydata *b = TSS__BODY(w, key[k].body);
        size_t c = (size_t)key[k].cell;
        label[k] = key[k].cell;
        E[k] = b->E.p ? tss__f64(&b->E)[c] : b->material.E;
        nu[k] = b->nu.p ? tss__f64(&b->nu)[c] : b->material.nu;
        differ |= E[k] != E[0] || nu[k] != nu[0];
        memcpy(node + k * size, tss__i32(&b->cell) + c * size, size * sizeof(int));
    }
    tss_material m = lead->material;
    m.E = E[0], m.nu = nu[0];
    tss_result r = tss__elastic_create(&w->host, w->dim, (int)cells, node, tss__f64(&w->X), &m,
                                       differ ? E : NULL, differ ? nu : NULL, NULL, &ref->e, NULL);
    if (r != TSS_OK) {
        tss__buf_free(&w->host, &ref->label);
        return tss_world_fail(w, r, "elasticity of %s: %s", lead->name, tss_result_text(r));
    }
    ref->e->label = label;
    w->elastic_count++;
    tss_energy_def d = tss__elastic_def(ref->e);
    r = tss_energy_add(w, &d, &ref->energy);
    if (r != TSS_OK) {
        tss__elastic_destroy(ref->e, &w->host);
        return r;
    }
    if (TSS__DAMPING(lead->material.damping) <= 0) return TSS_OK;
    r = tss__damping_create(&w->host, ref->e, &d);
    if (r != TSS_OK) return tss_world_fail(w, r, "damping of %s: %s", lead->name, tss_result_text(r));
    r = tss_energy_add(w, &d, &ref->damping);
    if (r != TSS_OK && d.destroy) d.destroy(d.user, &w->host);
    return r;
}

// Builds the groups anew when bodies came or went.
static tss_result tss__prepare_elastic(tss_world *w) {
    int alive = 0;
    size_t most = 0;
    for (int k = 0; k < w->body_count; k++) {
        alive += !TSS__BODY(w, k)->removed;
        most += (size_t)TSS__BODY(w, k)->cells;
    }
    if (w->elastic_bodies == w->body_count && w->elastic_alive == alive) return TSS_OK;
    w->elastic_bodies = -1;
    tss__elastic_clear(w);
    tss__buf keys = {NULL, 0}, space = {NULL, 0};
    tss__cellkey *key = (tss__cellkey *)tss__need(&w->host, &keys, 2 * most, sizeof *key);
    tss_result r = key ? TSS_OK : tss__no_memory(w);
    for (int lead = 0; r == TSS_OK && lead < w->body_count; lead++) {
        const tss__bodydata *b = TSS__BODY(w, lead);
        int seen = b->cells == 0;
        for (int k = 0; k < lead; k++)
            seen |= TSS__BODY(w, k)->cells > 0 && tss__same_density(TSS__BODY(w, k), b);
        size_t cells = 0;
        for (int k = lead; !seen && k < w->body_count; k++) {
            if (TSS__BODY(w, k)->cells == 0 || !tss__same_density(TSS__BODY(w, k), b)) continue;
            tss__body_keys(w, k, key + cells);
            tss__sort_keys(key + cells, key + most, (size_t)TSS__BODY(w, k)->cells);
            cells += (size_t)TSS__BODY(w, k)->cells;
        }
        if (cells > 0) r = tss__elastic_make(w, b, key, cells, &space);
    }
    tss__buf_free(&w->host, &keys), tss__buf_free(&w->host, &space);
    if (r == TSS_OK) w->elastic_bodies = w->body_count, w->elastic_alive = alive;
    if (r != TSS_OK) tss__elastic_clear(w);
    return r;
}

static double tss__min_J(const tss_world *w, const double *x) {
    double least = INFINITY;
    for (int k = 0; k < w->elastic_count; k++)
        least = tss__min(least, tss__elastic_min_J(((const tss__elastic_ref *)w->elastics.p)[k].e, &w->host,
                                                   x, NULL));
    return least;
}

// ---------------------------------------------------------------------------------------------
// >>linear (private)
// (A + C) y = b by sparse Cholesky or PCG. The choice is by counted work alone: a factorisation's
// flops against the products that recent PCG solves needed, one flop of a sparse product taken as
// eight of a BLAS-3 kernel (memory against arithmetic). A matrix that is not positive definite (no
// inertia and nothing pinned) gets a growing multiple of its diagonal added.
// ---------------------------------------------------------------------------------------------

#define TSS__PCG_FLOP 8.0  // cost of a flop in a sparse product, in flops of a dense kernel
#define TSS__PCG_REST 40   // solves between two trials of PCG where Cholesky is preferred

static void tss__linear_free(tss_world *w) {
    tss_chol_destroy(w->chol);
    tss_pcg_destroy(w->pcg);
    w->chol = NULL, w->pcg = NULL;
}

static tss_result tss__pcg_run(tss_world *w, const double *b, double *y, int bound, tss_pcg_info *info) {
    tss_result r = w->pcg ? TSS_OK : tss_pcg_create(&w->host, &w->pcg);
    if (r != TSS_OK) return tss__no_memory(w);
    tss_pcg_def d = tss_pcg_def_default();
    d.n = w->rows, d.d = w->dim, d.A = &w->A.m, d.B = &w->C.m;
    d.fixed = w->masked ? tss__u8(&w->mask) : NULL;
    d.tol = w->def.pcg_tol, d.max_iterations = bound;
    r = tss_pcg_solve(w->pcg, &d, b, y, info);
    w->info.linear_iterations += info->iterations;
    return r == TSS_OK ? r : tss_world_fail(w, r, "pcg: %s", tss_result_text(r));
}

// Adds shift · (mean of the diagonal) to A's diagonal.
static void tss__shift_diagonal(tss_world *w, double shift) {
    int dd = w->dim * w->dim;
    double mean = 0;
    for (int pass = 0; pass < 2; pass++)
        for (int r = 0; r < w->rows; r++) {
            double *block = tss_bcsr_block(&w->A.m, r, r);
            for (int c = 0; c < dd; c += w->dim + 1) {
                if (pass == 0)
                    mean += fabs(block[c]) / (w->rows * w->dim);
                else
                    block[c] += shift * mean;
            }
        }
}

static tss_result tss__chol_prepare(tss_world *w, tss_chol_info *info) {
    tss_result r = TSS_OK;
    if (!w->chol) {
        tss_chol_def d = tss_chol_def_default();
        r = tss_chol_create(&w->host, &d, &w->chol);
    }
    if (r == TSS_OK) r = tss_chol_analyze(w->chol, &w->A.m, &w->C.m);
    if (r != TSS_OK) return tss_world_fail(w, r, "cholesky: %s", tss_result_text(r));
    tss_chol_get_info(w->chol, info);
    return TSS_OK;
}

static tss_result tss__chol_run(tss_world *w, const double *b, double *y, tss_status *failed) {
    const uint8_t *fixed = w->masked ? tss__u8(&w->mask) : NULL;
    double shift = 1e-10;
    for (;;) {
        w->info.factorizations++;
        tss_result r = tss_chol_factor(w->chol, &w->A.m, &w->C.m, fixed);
        if (r == TSS_OK) break;
        tss_chol_info info;
        tss_chol_get_info(w->chol, &info);
        if (r != TSS_ERROR_SINGULAR) return tss_world_fail(w, r, "cholesky: %s", tss_result_text(r));
        int node = tss__i32(&w->node_of_row)[info.bad_row / w->dim];
        if (shift > 1) {
            tss__stop(w, TSS_STEP_LINEAR, "the matrix is not positive definite at node %d of %s", node,
                      TSS__BODY(w, tss__i32(&w->body)[node])->name);
            *failed = TSS_STEP_LINEAR;
            return TSS_OK;
        }
        tss__shift_diagonal(w, shift);
        shift *= 100;
    }
    memcpy(y, b, (size_t)(w->rows * w->dim) * sizeof(double));
    tss_result r = tss_chol_solve(w->chol, y, 1);
    return r == TSS_OK ? r : tss_world_fail(w, r, "cholesky: %s", tss_result_text(r));
}

// Cost of one PCG iteration in dense flops.
static double tss__pcg_cost(const tss_world *w) {
    double blocks = (double)(w->A.m.row[w->rows] + w->C.m.row[w->rows]);
    return TSS__PCG_FLOP * (2.0 * blocks * w->dim * w->dim + 20.0 * w->rows * w->dim);
}

static tss_result tss__linear_solve(tss_world *w, const double *b, double *y, tss_status *failed) {
    tss_linear want = w->def.linear;
    tss_chol_info chol;
    tss_pcg_info pcg;
    int bound = w->def.pcg_iterations;
    if (w->rows == 0) return TSS_OK;
    if (want != TSS_LINEAR_PCG) {
        tss_result r = tss__chol_prepare(w, &chol);
        if (r != TSS_OK) return r;
        double affordable = (chol.flops + 4.0 * (double)chol.nonzeros) / tss__pcg_cost(w);
        if (want == TSS_LINEAR_AUTO && affordable > w->pcg_iterations && w->pcg_rest == 0) {
            want = TSS_LINEAR_PCG;
            if (affordable < bound) bound = (int)affordable + 1;
        } else if (w->pcg_rest > 0 && --w->pcg_rest == 0)
            w->pcg_iterations = 0;  // conditions may have changed: try again
    }
    if (want == TSS_LINEAR_PCG) {
        tss_result r = tss__pcg_run(w, b, y, bound, &pcg);
        if (r != TSS_OK) return r;
        w->pcg_iterations = tss__max(pcg.iterations, 0.8 * w->pcg_iterations);
        if (pcg.status == TSS_PCG_CONVERGED) return TSS_OK;
        if (w->def.linear == TSS_LINEAR_PCG) {
            // A truncated solve is still a descent direction unless the matrix was indefinite.
            if (pcg.status == TSS_PCG_MAX_ITERATIONS) return TSS_OK;
            tss__stop(w, TSS_STEP_LINEAR, "pcg stopped after %d iterations at residual %.3g", pcg.iterations,
                      pcg.residual);
            *failed = TSS_STEP_LINEAR;
            return TSS_OK;
        }
        w->pcg_rest = TSS__PCG_REST;
    }
    return tss__chol_run(w, b, y, failed);
}

// ---------------------------------------------------------------------------------------------
// >>worlds (private)
// ---------------------------------------------------------------------------------------------

tss_world_def tss_world_def_default(void) {
    tss_world_def d;
    memset(&d, 0, sizeof d);
    d.host = tss_host_default();
    d.dim = 3;
    d.dt = 0.01;
    d.gravity[1] = -9.80665;
    d.tol_rel = 1e-2;
    d.max_iterations = 2000;
    d.pcg_tol = 1e-5;
    d.pcg_iterations = 10000;
    d.cookie = TSS__COOKIE;
    return d;
}

static int tss__world_def_ok(const tss_world_def *d) {
    return d->cookie == TSS__COOKIE && (d->dim == 2 || d->dim == 3) && d->dt > 0 && isfinite(d->dt) &&
           d->tol >= 0 && d->tol_rel >= 0 && d->tol + d->tol_rel > 0 && d->max_iterations > 0 &&
           d->pcg_tol > 0 && d->pcg_tol < 1 && d->pcg_iterations > 0 && isfinite(d->gravity[0]) &&
           isfinite(d->gravity[1]) && isfinite(d->gravity[2]);
}

tss_result tss_world_create(const tss_world_def *def, tss_world **out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    *out = NULL;
    if (!def || !tss__world_def_ok(def)) return TSS_ERROR_BAD_ARGUMENT;
    const char *left_out = tss__dim_left_out(def->dim);
    if (left_out) return tss__refuse(&def->host, def->dim == 2 ? "dim = 2" : "dim = 3", left_out);
    tss_world *w = (tss_world *)tss_alloc(&def->host, sizeof *w);
    if (!w) return TSS_ERROR_NO_MEMORY;
    memset(w, 0, sizeof *w);
    w->def = *def;
    w->host = def->host;
    w->host.alloc = tss__count_alloc, w->host.free = tss__count_free, w->host.memory_ctx = w;
    w->dim = def->dim;
    w->bytes = sizeof *w;
    tss_result r = tss__internal_energies(w);
    if (r != TSS_OK) {
        tss_world_destroy(w);
        return r;
    }
    *out = w;
    return TSS_OK;
}

static void tss__matrix_free(const tss_host *h, tss__matrix *m) {
    tss__buf_free(h, &m->ptr), tss__buf_free(h, &m->col), tss__buf_free(h, &m->val);
}

static void tss__entry_free(const tss_host *h, tss__entry *e) {
    if (e->live && e->def.destroy) e->def.destroy(e->def.user, h);
    tss__buf_free(h, &e->plan.order), tss__buf_free(h, &e->plan.start);
    tss__buf_free(h, &e->slot), tss__buf_free(h, &e->partial);
}

void tss_world_destroy(tss_world *w) {
    if (!w) return;
    const tss_host *h = &w->host;
    if (w->finder.destroy) w->finder.destroy(w->finder.user, h);
    for (int k = 0; k < w->elastic_count; k++) {  // damping before the elasticity it reads
        tss_energy e = ((tss__elastic_ref *)w->elastics.p)[k].damping;
        if (e >= 0) tss_energy_remove(w, e);
    }
    for (int k = 0; k < w->entry_count; k++) tss__entry_free(h, TSS__ENTRY(w, k));
    for (int k = 0; k < w->elastic_count; k++)
        tss__buf_free(h, &((tss__elastic_ref *)w->elastics.p)[k].label);
    for (int k = 0; k < w->body_count; k++) tss__body_free(h, TSS__BODY(w, k));
    tss__buf *all[] = {&w->x, &w->v, &w->x_prev, &w->v_prev, &w->a, &w->X, &w->mass, &w->kind,
                       &w->axes, &w->body, &w->target, &w->force, &w->drag_node, &w->drag_at,
                       &w->drag_k, &w->bodies, &w->entries, &w->surf_point, &w->surf_edge,
                       &w->surf_triangle, &w->elastics, &w->inertia_node, &w->x_k,
                       &w->x_t, &w->v_t, &w->x_tilde, &w->x_trial, &w->d, &w->g, &w->g_trial, &w->rhs,
                       &w->moving, &w->row, &w->mask, &w->colormask, &w->node_of_row, &w->scratch,
                       &w->sys_d, &w->diag, &w->pair_count, &w->pair_col, &w->fresh, &w->kept};
    for (size_t k = 0; k < sizeof all / sizeof *all; k++) tss__buf_free(h, all[k]);
    tss__matrix_free(h, &w->A), tss__matrix_free(h, &w->C);
    tss__linear_free(w);
    tss_host host = w->def.host;
    tss_free(&host, w, sizeof *w);
}

const char *tss_world_error(const tss_world *w) { return w ? w->error : "no world"; }
const tss_host *tss_world_host(const tss_world *w) { return &w->host; }
int tss_world_dim(const tss_world *w) { return w->dim; }
int tss_world_nodes(const tss_world *w) { return w->n; }
double tss_world_time(const tss_world *w) { return w->time; }
double tss_world_diagonal(const tss_world *w) { return w->diagonal; }
const double *tss_world_positions(const tss_world *w) { return tss__f64(&w->x); }
const double *tss_world_velocities(const tss_world *w) { return tss__f64(&w->v); }
const double *tss_world_rest(const tss_world *w) { return tss__f64(&w->X); }
const double *tss_world_masses(const tss_world *w) { return tss__f64(&w->mass); }
const uint8_t *tss_world_kinds(const tss_world *w) { return tss__u8(&w->kind); }

const char *tss_status_text(tss_status s) {
    static const char *const text[] = {
#define TSS__TEXT(id, text) text,
        TSS_STATUSES(TSS__TEXT)
#undef TSS__TEXT
    };
    return (unsigned)s < TSS_STATUS_COUNT ? text[s] : "unknown";
}

const char *tss_phase_text(tss_phase p) {
    static const char *const text[] = {"energy", "gradient", "hessian", "assemble",
                                       "linear", "collision", "oracle", "other"};
    return (unsigned)p < TSS_PHASE_COUNT ? text[p] : "unknown";
}

// FNV-1a over 8-byte words: one bit of difference anywhere changes it.
uint64_t tss_world_hash(const tss_world *w) {
    uint64_t h = 14695981039346656037u;
    const tss__buf *part[2] = {&w->x, &w->v};
    for (int p = 0; p < 2; p++)
        for (int k = 0; k < w->n * w->dim; k++) {
            uint64_t bits;
            memcpy(&bits, tss__f64(part[p]) + k, sizeof bits);
            for (int s = 0; s < 64; s += 8) h = (h ^ (bits >> s & 255)) * 1099511628211u;
        }
    return h;
}

// ---------------------------------------------------------------------------------------------
// >>prepare (private)
// Everything that depends on the scene and not on the state.
// ---------------------------------------------------------------------------------------------

static void tss__find_diagonal(tss_world *w) {
    double lo[3] = {INFINITY, INFINITY, INFINITY}, hi[3] = {-INFINITY, -INFINITY, -INFINITY}, s = 0;
    for (int i = 0; i < w->n; i++) {
        const tss__bodydata *b = TSS__BODY(w, tss__i32(&w->body)[i]);
        if (b->removed || b->kind != TSS_BODY_SOFT) continue;
        for (int c = 0; c < w->dim; c++) {
            lo[c] = tss__min(lo[c], tss__f64(&w->X)[i * w->dim + c]);
            hi[c] = tss__max(hi[c], tss__f64(&w->X)[i * w->dim + c]);
        }
    }
    for (int c = 0; c < w->dim; c++) s += (hi[c] - lo[c]) * (hi[c] - lo[c]);
    w->diagonal = sqrt(s);
}

static tss_result tss__prepare_surface(tss_world *w) {
    size_t count[3] = {0, 0, 0}, at[3] = {0, 0, 0};
    for (int k = 0; k < w->body_count; k++) {
        const tss__bodydata *b = TSS__BODY(w, k);
        count[0] += (size_t)b->points, count[1] += 2 * (size_t)b->edges, count[2] += 3 * (size_t)b->triangles;
    }
    int *to[3];
    to[0] = (int *)tss__need(&w->host, &w->surf_point, count[0], sizeof(int));
    to[1] = (int *)tss__need(&w->host, &w->surf_edge, count[1], sizeof(int));
    to[2] = (int *)tss__need(&w->host, &w->surf_triangle, count[2], sizeof(int));
    if (!to[0] || !to[1] || !to[2]) return tss__no_memory(w);
    for (int k = 0; k < w->body_count; k++) {
        const tss__bodydata *b = TSS__BODY(w, k);
        const tss__buf *from[3] = {&b->point, &b->edge, &b->triangle};
        size_t len[3] = {(size_t)b->points, 2 * (size_t)b->edges, 3 * (size_t)b->triangles};
        for (int p = 0; p < 3; p++) {
            if (len[p] > 0) memcpy(to[p] + at[p], from[p]->p, len[p] * sizeof(int));
            at[p] += len[p];
        }
    }
    w->surface.points = (int)count[0], w->surface.edges = (int)(count[1] / 2);
    w->surface.triangles = (int)(count[2] / 3);
    w->surface.point = to[0], w->surface.edge = to[1], w->surface.triangle = to[2];
    w->surface.topology = w->topology;
    return TSS_OK;
}

tss_result tss_world_surface(const tss_world *w, tss_surface *out) {
    if (!w || !out) return TSS_ERROR_BAD_ARGUMENT;
    *out = w->surface;
    return w->topology > 0 ? TSS_OK : TSS_ERROR_NOT_PREPARED;
}

// Numbers the unknown nodes; lists the nodes with inertia.
static tss_result tss__prepare_rows(tss_world *w) {
    size_t n = (size_t)w->n;
    int *row = (int *)tss__need(&w->host, &w->row, n, sizeof(int));
    int *node = (int *)tss__need(&w->host, &w->node_of_row, n, sizeof(int));
    int *heavy = (int *)tss__need(&w->host, &w->inertia_node, n, sizeof(int));
    uint8_t *moving = (uint8_t *)tss__need(&w->host, &w->moving, n, 1);
    uint8_t *mask = (uint8_t *)tss__need(&w->host, &w->mask, n * (size_t)w->dim, 1);
    if (!row || !node || !heavy || !moving || !mask) return tss__no_memory(w);
    w->rows = w->inertia_count = w->masked = 0;
    for (int i = 0; i < w->n; i++) {
        moving[i] = 0;
        row[i] = -1;
        if (tss__u8(&w->kind)[i] != TSS_NODE_FREE) continue;
        for (int c = 0; c < w->dim; c++)
            w->masked |= mask[w->rows * w->dim + c] = tss__u8(&w->axes)[i] >> c & 1;
        row[i] = w->rows, node[w->rows++] = i;
        if (tss__f64(&w->mass)[i] > 0) heavy[w->inertia_count++] = i;
    }
    w->inertia_pattern++;
    return TSS_OK;
}

static tss_result tss__prepare_step_arrays(tss_world *w) {
    size_t nd = (size_t)w->n * (size_t)w->dim;
    tss__buf *wide[] = {&w->x_k, &w->x_t, &w->v_t, &w->x_tilde, &w->x_trial, &w->d, &w->g, &w->g_trial,
                        &w->rhs, &w->sys_d};
    for (size_t k = 0; k < sizeof wide / sizeof *wide; k++)
        if (!tss__need(&w->host, wide[k], nd, sizeof(double))) return tss__no_memory(w);
    if (!tss__need(&w->host, &w->diag, nd * (size_t)w->dim, sizeof(double))) return tss__no_memory(w);
    return TSS_OK;
}

static void tss__fill_ctx(tss_world *w) {
    tss_ctx *c = &w->ctx;
    c->host = &w->host, c->dim = w->dim, c->nodes = w->n;
    c->quasistatic = w->def.integrator == TSS_QUASISTATIC;
    c->h = w->def.dt, c->diagonal = w->diagonal;
    if (!(c->ah2 > 0)) c->ah2 = c->quasistatic ? 1 : c->h * c->h;
    c->X = tss__f64(&w->X), c->x_t = tss__f64(&w->x_t), c->x_tilde = tss__f64(&w->x_tilde);
    c->v_t = tss__f64(&w->v_t), c->mass = tss__f64(&w->mass), c->kind = tss__u8(&w->kind);
    c->body = tss__i32(&w->body);
    c->step = w->steps, c->topology = w->topology;
}

tss_result tss_world_prepare(tss_world *w) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (w->prepared) return TSS_OK;
    int soft = 0;
    for (int k = 0; k < w->body_count; k++)
        soft |= !TSS__BODY(w, k)->removed && TSS__BODY(w, k)->kind == TSS_BODY_SOFT;
    if (!soft) return tss_world_fail(w, TSS_ERROR_EMPTY, "the scene has no soft body");
    tss_result r;
    w->topology++;
    w->matrix_valid = 0;
    tss__find_diagonal(w);
    if ((r = tss__prepare_surface(w)) != TSS_OK) return r;
    if ((r = tss__prepare_rows(w)) != TSS_OK) return r;
    if ((r = tss__prepare_step_arrays(w)) != TSS_OK) return r;
    if ((r = tss__prepare_elastic(w)) != TSS_OK) return r;
    memcpy(w->x_t.p, w->x.p, (size_t)(w->n * w->dim) * sizeof(double));
    memcpy(w->v_t.p, w->v.p, (size_t)(w->n * w->dim) * sizeof(double));
    memcpy(w->x_tilde.p, w->x.p, (size_t)(w->n * w->dim) * sizeof(double));
    tss__fill_ctx(w);
    w->write_stamp++;
    w->prepared = 1;
    return TSS_OK;
}

tss_result tss_world_ready(tss_world *w) {
    tss_result r = tss_world_prepare(w);
    if (r != TSS_OK || !w->finder.prepare) return r;
    for (int k = 0; k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (!tss__in_matrix(e, 0)) continue;
        r = e->def.lists(e->def.user, &w->ctx, tss__f64(&w->x), NULL, 0, &e->list);
        if (r != TSS_OK) return tss_world_fail(w, r, "%s: %s", e->name, tss_result_text(r));
    }
    return w->finder.prepare(w->finder.user, w, &w->ctx);
}

// ---------------------------------------------------------------------------------------------
// >>iterate (private)
// One Newton iterate at x_k: lists → ∇E → projected ∇²E → direction d → step filters → line search.
//
// Scripted nodes and moving obstacles (kinematic nodes) are part of d with their remaining
// displacement, and the unknowns' right-hand side carries −H_fk d_k, so that bodies give way in the
// same iterate. All kinematic nodes stand at the same fraction s of their way; an accepted step
// α leaves s(1 − αθ). That is sequential quadratic programming with linear constraints: while
// s > 0 the energy may rise by as much as the motion's own quadratic model predicts; once s = 0
// it is a plain descent. θ < 1 shortens the prescribed motion while the filters cut steps short.
// ---------------------------------------------------------------------------------------------

#define TSS__LIMIT_TEXT 128

typedef struct tss__iter {
    double E, size;      // energy at x_k and the magnitude of its terms
    int E_known;
    double s, theta;     // fraction of the prescribed motion left; share of it tried at once
    double gd;           // ∇E·d
    double dnorm;        // ‖d‖∞ over the unknowns
    double t_max;        // what the step filters allow
    double alpha;        // accepted
    char limit[TSS__LIMIT_TEXT];  // who limited the step
    double tol;          // ‖d‖∞ that counts as converged
    int small_steps;     // iterates in a row with tiny steps
    int more;            // the finder has something to add: not converged
} tss__iter;

static double tss__dot_blocks(const double *a, const double *b, int count) {
    double total = 0;  // blocks of 4096 summed in order: the same on any number of threads
    for (int from = 0; from < count; from += 4096) {
        int to = from + 4096 < count ? from + 4096 : count;
        double s = 0;
        for (int k = from; k < to; k++) s += a[k] * b[k];
        total += s;
    }
    return total;
}

static void tss__describe(tss_world *w, const tss__entry *e, int id, char *text, size_t size) {
    if (e->def.describe && id >= 0)
        e->def.describe(e->def.user, &w->ctx, id, text, size);
    else
        snprintf(text, size, "%s stencil %d", e->name, id);
}

// Lists of all energies at x, or along x + t·d.
static tss_result tss__lists(tss_world *w, int dynamic_only, const double *x, const double *d, double t) {
    for (int k = 0; k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (!e->live || (dynamic_only && !(e->def.flags & TSS_ENERGY_DYNAMIC))) continue;
        tss_result r = e->def.lists(e->def.user, &w->ctx, x, d, t, &e->list);
        if (r != TSS_OK) return tss_world_fail(w, r, "%s: %s", e->name, tss_result_text(r));
    }
    return TSS_OK;
}

static tss_result tss__energy_at(tss_world *w, const double *x, double *E, double *size) {
    *E = *size = 0;
    for (int k = 0; k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (!e->live || e->list.count == 0) continue;
        tss_result r = tss__add_value(w, e, &e->list, x, E, size);
        if (r != TSS_OK) return r;
    }
    return TSS_OK;
}

// ∇E at x over the current lists. Masked axes of unknown nodes are 0.
static tss_result tss__gradient_at(tss_world *w, const double *x, double *g, int with_dynamic) {
    memset(g, 0, (size_t)(w->n * w->dim) * sizeof(double));
    for (int k = 0; k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (!e->live || e->list.count == 0) continue;
        if (!with_dynamic && (e->def.flags & TSS_ENERGY_DYNAMIC)) continue;
        tss_result r = tss__add_gradient(w, e, &e->list, x, g);
        if (r != TSS_OK) return r;
    }
    const int *node = tss__i32(&w->node_of_row);
    const uint8_t *mask = tss__u8(&w->mask);
    for (int r = 0; r < w->rows; r++)
        for (int c = 0; c < w->dim; c++)
            if (mask[r * w->dim + c]) g[node[r] * w->dim + c] = 0;
    return TSS_OK;
}

// Prescribed displacement of this iterate into d (0 elsewhere). Returns 1 if anything moves.
static int tss__kinematic_direction(tss_world *w, const tss__iter *it) {
    double *d = tss__f64(&w->d);
    const double *x = tss__f64(&w->x_k), *target = tss__f64(&w->target);
    memset(d, 0, (size_t)(w->n * w->dim) * sizeof(double));
    if (it->s == 0) return 0;
    for (int i = 0; i < w->n; i++)
        for (int c = i * w->dim; tss__u8(&w->moving)[i] && c < (i + 1) * w->dim; c++)
            d[c] = it->theta * (target[c] - x[c]);
    return 1;
}

// The full-space Newton direction at x from the gradient g, into d.
static tss_result tss__full_direction(tss_world *w, const double *x, const double *g, int moves, double *d,
                                      tss_status *failed) {
    double *rhs = tss__f64(&w->rhs), *y = tss__f64(&w->sys_d);
    const int *node = tss__i32(&w->node_of_row);
    int dim = w->dim;
    tss_result r = tss__pattern_update(w, 0);
    if (r == TSS_OK) r = tss__pattern_update(w, 1);
    if (r != TSS_OK) return r;
    w->matrix_valid = 1;
    memset(w->A.val.p, 0, (size_t)w->A.m.row[w->rows] * (size_t)(dim * dim) * sizeof(double));
    memset(w->C.val.p, 0, (size_t)w->C.m.row[w->rows] * (size_t)(dim * dim) * sizeof(double));
    tss__phase(w, TSS_PHASE_ASSEMBLE);
    for (int k = 0; k < w->rows; k++)
        for (int c = 0; c < dim; c++) rhs[k * dim + c] = -g[node[k] * dim + c];
    for (int k = 0; k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (!e->live || e->list.count == 0) continue;
        if ((r = tss__add_hessian(w, e, x, NULL, moves ? d : NULL, rhs)) != TSS_OK) return r;
    }
    for (int k = 0; k < w->rows * dim; k++)
        if (tss__u8(&w->mask)[k]) rhs[k] = 0;
    tss__phase(w, TSS_PHASE_HESSIAN);
    r = tss__linear_solve(w, rhs, y, failed);
    if (r != TSS_OK || *failed != TSS_STEP_CONVERGED) return r;
    for (int k = 0; k < w->rows; k++)
        for (int c = 0; c < dim; c++) d[node[k] * dim + c] = y[k * dim + c];
    tss__phase(w, TSS_PHASE_LINEAR);
    return TSS_OK;
}

// The gradient and the direction d of this iterate, the finder's or the full-space one.
static tss_result tss__direction(tss_world *w, tss__iter *it, tss_status *failed) {
    double *g = tss__f64(&w->g), *d = tss__f64(&w->d);
    const double *x = tss__f64(&w->x_k);
    int moves = tss__kinematic_direction(w, it);
    tss_result r = tss__gradient_at(w, x, g, 1);
    if (r != TSS_OK) return r;
    tss__phase(w, TSS_PHASE_GRADIENT);
    it->more = 0, w->solved_full = 1;
    if (w->finder.direction) {
        tss_iterate v;
        memset(&v, 0, sizeof v);
        v.ctx = &w->ctx, v.number = w->info.newton, v.x = x, v.g = g, v.d = d, v.moves = moves, v.tol = it->tol;
        r = w->finder.direction(w->finder.user, w, &v);
        if (r != TSS_OK) return r;
        it->more = v.more, w->solved_full = !v.handled;
        tss__phase(w, TSS_PHASE_LINEAR);
    }
    if (w->solved_full) r = tss__full_direction(w, x, g, moves, d, failed);
    if (r != TSS_OK || *failed != TSS_STEP_CONVERGED) return r;
    it->dnorm = 0;
    for (int k = 0; k < w->rows; k++)
        for (int c = 0; c < w->dim; c++)
            it->dnorm = tss__max(it->dnorm, fabs(d[tss__i32(&w->node_of_row)[k] * w->dim + c]));
    it->gd = tss__dot_blocks(g, d, w->n * w->dim);
    // A NaN passes every comparison that could find it later, convergence first.
    if (!isfinite(it->gd) || !isfinite(it->dnorm) || !isfinite(it->E))
        tss__stop(w, *failed = TSS_STEP_LINEAR,
                  "energy %g, slope %g: a force or a stiffness is not finite", it->E, it->gd);
    return TSS_OK;
}

// The step filters: fixed stencils first (cheap), then lists along the shortened sweep.
static tss_result tss__filter(tss_world *w, const double *x, const double *d, double *t_max, char *limit) {
    *t_max = 1;
    for (int dynamic = 0; dynamic < 2; dynamic++) {
        if (dynamic) {
            tss_result r = tss__lists(w, 1, x, d, *t_max);
            if (r != TSS_OK) return r;
        }
        for (int k = 0; k < w->entry_count; k++) {
            tss__entry *e = TSS__ENTRY(w, k);
            if (!tss__in_matrix(e, dynamic) || !e->def.max_step) continue;
            int culprit = -1;
            double t = e->def.max_step(e->def.user, &w->ctx, x, d, *t_max, &culprit);
            if (t >= *t_max) continue;
            *t_max = tss__max(t, 0);
            if (limit) tss__describe(w, e, culprit, limit, TSS__LIMIT_TEXT);
        }
    }
    return TSS_OK;
}

static void tss__trial(tss_world *w, const tss__iter *it, double alpha) {
    const double *x = tss__f64(&w->x_k), *d = tss__f64(&w->d), *target = tss__f64(&w->target);
    double *y = tss__f64(&w->x_trial);
    int last = it->s > 0 && alpha * it->theta >= 1;  // arrive exactly, not within rounding
    for (int i = 0; i < w->n; i++)
        for (int c = i * w->dim; c < (i + 1) * w->dim; c++)
            y[c] = last && tss__u8(&w->moving)[i] ? target[c] : x[c] + alpha * d[c];
}

// How much the energy may rise over a step α while prescribed motion does work: 1.5 times the
// quadratic model along d, its curvature from a difference of gradients.
typedef struct tss__allowance {
    double slope, curvature;
} tss__allowance;

static tss_result tss__allow(tss_world *w, const tss__iter *it, tss__allowance *a) {
    a->slope = it->gd, a->curvature = 0;
    if (it->s == 0) return TSS_OK;
    double eps = 1e-6 * it->t_max;  // small against the step, large against rounding
    if (!(eps > 0)) return TSS_OK;
    tss__trial(w, it, eps);
    tss_result r = tss__gradient_at(w, tss__f64(&w->x_trial), tss__f64(&w->g_trial), 1);
    if (r != TSS_OK) return r;
    a->curvature = (tss__dot_blocks(tss__f64(&w->g_trial), tss__f64(&w->d), w->n * w->dim) - it->gd) / eps;
    return TSS_OK;
}

// A change of E that rounding may hide: its terms carry a few eps each, and inertia and forces,
// which cancel at the solution, the rounding of positions times their own size. Below it a step is
// judged by the slope at its end, as in Hager and Zhang's approximate Wolfe condition.
static double tss__noise(const tss__iter *it) { return 1e-9 * it->size; }

// Armijo backtracking on E; below the noise of E by the slope (approximate Wolfe condition).
static tss_result tss__line_search(tss_world *w, tss__iter *it, int *found) {
    tss__allowance allow;
    tss_result r = tss__allow(w, it, &allow);
    double noise = tss__noise(it);
    *found = 0;
    double alpha = it->t_max;
    for (int k = 0; r == TSS_OK && k < 50 && alpha > 0; k++, alpha *= 0.5) {
        double E, size;
        tss__trial(w, it, alpha);
        if ((r = tss__energy_at(w, tss__f64(&w->x_trial), &E, &size)) != TSS_OK) return r;
        double rise = 0;
        if (it->s > 0)
            rise = 1.5 * tss__max(0, alpha * allow.slope + 0.5 * alpha * alpha * allow.curvature);
        // Where the unknowns have nothing left to do, only prescribed motion changes E.
        int idle = it->s > 0 && it->dnorm <= it->tol;
        int ok = isfinite(E) && (idle || E <= it->E + rise + 1e-4 * alpha * tss__min(it->gd, 0));
        if (!ok && isfinite(E) && E <= it->E + noise) {
            r = tss__gradient_at(w, tss__f64(&w->x_trial), tss__f64(&w->g_trial), 1);
            double slope = tss__dot_blocks(tss__f64(&w->g_trial), tss__f64(&w->d), w->n * w->dim);
            // Far below the noise the slope is noise too: x is as good as doubles allow.
            ok = fabs(slope) <= 0.9998 * fabs(it->gd) || fabs(it->gd) <= 1e-16 * it->size;
        }
        if (!ok) continue;
        it->alpha = alpha, it->E = E, it->size = size, it->E_known = 1;
        *found = 1;
        return r;
    }
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>parts (private)
// What energies and the direction finder remember between steps, one part after the other: its
// length, its bytes. For checkpoints, and to take back what a step that failed has changed.
// ---------------------------------------------------------------------------------------------

// Part k: energy k, or after the last of them the direction finder.
static size_t tss__part_state(const tss_world *w, int k, void *data, size_t size, int save) {
    if (k == w->entry_count)
        return w->finder.state ? w->finder.state(w->finder.user, data, size, save) : 0;
    const tss__entry *e = TSS__ENTRY(w, k);
    return e->live && e->def.state ? e->def.state(e->def.user, data, size, save) : 0;
}

// Removed energies have no part: where they lay depends on what was added and removed when.
static int tss__is_part(const tss_world *w, int k) {
    return k == w->entry_count || TSS__ENTRY(w, k)->live;
}

static int tss__part_has_state(const tss_world *w, int k) {
    if (k == w->entry_count) return w->finder.state != NULL;
    return TSS__ENTRY(w, k)->live && TSS__ENTRY(w, k)->def.state != NULL;
}

// Writes the first `parts` of them to data (NULL: nothing); returns the bytes.
static size_t tss__save_parts(const tss_world *w, int parts, char *data) {
    size_t all = 0;
    for (int k = 0; k < parts; k++) {
        if (!tss__is_part(w, k)) continue;
        uint64_t len = tss__part_state(w, k, NULL, 0, 1);
        if (data) memcpy(data + all, &len, sizeof len);
        all += sizeof len;
        if (data) tss__part_state(w, k, data + all, (size_t)len, 1);
        all += (size_t)len;
    }
    return all;
}

// Walks them: restore 0 only measures. 0 where something does not fit.
static int tss__load_parts(tss_world *w, int parts, const char *from, size_t left, int restore) {
    for (int k = 0; k < parts; k++) {
        uint64_t len;
        if (!tss__is_part(w, k)) continue;
        if (left < sizeof len) return 0;
        memcpy(&len, from, sizeof len), from += sizeof len, left -= sizeof len;
        if (len > left) return 0;
        if (len > 0 && !tss__part_has_state(w, k)) return 0;
        void *part = (void *)(uintptr_t)from;
        if (restore && len > 0 && tss__part_state(w, k, part, (size_t)len, 0) != len) return 0;
        from += len, left -= (size_t)len;
    }
    return left == 0;
}

// ---------------------------------------------------------------------------------------------
// >>step (private)
// Prediction, Newton iterates until ‖d‖∞/h ≤ ε, velocities (Eq. 1–3, footnote 9).
// ---------------------------------------------------------------------------------------------

// ‖d‖∞ at which a solve has converged, m: never below what positions can be rounded to.
static double tss__tolerance(const tss_world *w) {
    double most = 0, tol = w->def.tol > 0 ? w->def.tol : w->def.tol_rel * w->diagonal;
    for (int k = 0; k < w->n * w->dim; k++) most = tss__max(most, fabs(tss__f64(&w->x_t)[k]));
    if (w->ctx.quasistatic && w->def.tol <= 0) tol *= 1e-3 / w->def.dt;  // there is no velocity
    return tss__max(tol * w->def.dt, 8 * 2.2e-16 * most);
}

// Newmark remembers accelerations; at a start those of the forces inside the bodies and of loads.
static tss_result tss__start_newmark(tss_world *w) {
    double *a = tss__f64(&w->a), *g = tss__f64(&w->g);
    memset(g, 0, (size_t)(w->n * w->dim) * sizeof(double));
    for (int k = 0; k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (!tss__in_matrix(e, 0) || !(e->def.flags & TSS_ENERGY_TIMES_AH2)) continue;
        tss_result r = e->def.lists(e->def.user, &w->ctx, tss__f64(&w->x_t), NULL, 0, &e->list);
        if (r != TSS_OK) return tss_world_fail(w, r, "%s: %s", e->name, tss_result_text(r));
        tss__gradient_serial(w, e, tss__f64(&w->x_t), g);
    }
    for (int k = 0; k < w->n * w->dim; k++) {
        double m = tss__f64(&w->mass)[k / w->dim];
        int free = tss__u8(&w->kind)[k / w->dim] == TSS_NODE_FREE && m > 0;
        a[k] = free ? w->def.gravity[k % w->dim] + (tss__f64(&w->force)[k] - g[k]) / m : 0;
    }
    return TSS_OK;
}

// αh² and x̃ of the integrator. Gravity and nodal forces enter x̃ as αh² M⁻¹f.
static void tss__predict(tss_world *w) {
    double h = w->def.dt, *xt = tss__f64(&w->x_tilde);
    const double *x = tss__f64(&w->x_t), *v = tss__f64(&w->v_t), *xp = tss__f64(&w->x_prev);
    const double *vp = tss__f64(&w->v_prev), *a = tss__f64(&w->a), *f = tss__f64(&w->force);
    int first = w->history == 0;
    tss_integrator in = w->def.integrator;
    w->ctx.ah2 = in == TSS_QUASISTATIC ? 1 : in == TSS_NEWMARK ? h * h / 4
                 : in == TSS_BDF2 && !first ? 4 * h * h / 9 : h * h;
    for (int i = 0; i < w->n; i++) {
        double m = tss__f64(&w->mass)[i];
        for (int c = 0; c < w->dim; c++) {
            int k = i * w->dim + c;
            if (tss__u8(&w->kind)[i] != TSS_NODE_FREE || in == TSS_QUASISTATIC)
                xt[k] = x[k];
            else if (in == TSS_NEWMARK)
                xt[k] = x[k] + h * v[k] + h * h / 4 * a[k];
            else if (in == TSS_BDF2 && !first)
                xt[k] = (4 * x[k] - xp[k]) / 3 + 2 * h / 9 * (4 * v[k] - vp[k]);
            else
                xt[k] = x[k] + h * v[k];
            if (tss__u8(&w->kind)[i] == TSS_NODE_FREE && m > 0 && in != TSS_QUASISTATIC)
                xt[k] += w->ctx.ah2 * (w->def.gravity[c] + f[k] / m);
        }
    }
}

// Velocities and the integrator's memory after a step to x.
static void tss__advance(tss_world *w) {
    double h = w->def.dt, *x = tss__f64(&w->x), *v = tss__f64(&w->v), *xp = tss__f64(&w->x_prev);
    double *vp = tss__f64(&w->v_prev), *a = tss__f64(&w->a);
    const double *xn = tss__f64(&w->x_k), *xt = tss__f64(&w->x_t), *vt = tss__f64(&w->v_t);
    tss_integrator in = w->def.integrator;
    for (int k = 0; k < w->n * w->dim; k++) {
        double vn = (xn[k] - xt[k]) / h;  // implicit Euler; also a kinematic node's own speed
        int free = tss__u8(&w->kind)[k / w->dim] == TSS_NODE_FREE;
        if (in == TSS_QUASISTATIC)
            vn = 0;
        else if (in == TSS_BDF2 && w->history > 0 && free)
            vn = (3 * xn[k] - 4 * xt[k] + xp[k]) / (2 * h);
        else if (in == TSS_NEWMARK && free) {
            double a1 = 4 / (h * h) * (xn[k] - xt[k] - h * vt[k]) - a[k];
            vn = vt[k] + 0.5 * h * (a[k] + a1);
            a[k] = a1;
        } else if (in == TSS_NEWMARK)
            a[k] = 0;  // set free later, the node starts without a force of long ago
        xp[k] = xt[k], vp[k] = vt[k];
        x[k] = xn[k], v[k] = vn;
    }
    w->unchecked = 0;
    memset(w->fresh.p, 0, (size_t)w->n);
    w->history++;
    w->steps++;
    w->time += h;
}

// Which kinematic nodes move in this step; the plans depend on it.
static int tss__find_moving(tss_world *w) {
    int any = 0, changed = 0;
    const double *x = tss__f64(&w->x), *t = tss__f64(&w->target);
    for (int i = 0; i < w->n; i++) {
        uint8_t m = 0;
        if (tss__u8(&w->kind)[i] >= TSS_NODE_SCRIPTED)
            for (int c = i * w->dim; c < (i + 1) * w->dim; c++) m |= x[c] != t[c];
        changed |= m != tss__u8(&w->moving)[i];
        tss__u8(&w->moving)[i] = m;
        any |= m;
    }
    if (changed) w->write_stamp++;
    return any;
}

static double tss__target_left(const tss_world *w, const double *x) {
    double worst = 0;
    for (int i = 0; i < w->n; i++) {
        if (!tss__u8(&w->moving)[i]) continue;
        double s = 0;
        for (int c = i * w->dim; c < (i + 1) * w->dim; c++)
            s += (x[c] - tss__f64(&w->target)[c]) * (x[c] - tss__f64(&w->target)[c]);
        worst = tss__max(worst, s);
    }
    return sqrt(worst);
}

static void tss__first_error(tss_severity severity, const char *text, void *arg) {
    char *first = (char *)arg;
    if (severity == TSS_SEVERITY_ERROR && !first[0]) snprintf(first, 240, "%.239s", text);
}

// No step can start from an intersection or an inverted cell that a barrier forbids: say which.
// Steps keep what they start from free of both, so only states that no step has passed are looked
// at: a new start, a loaded one, one with a new energy to mind, nodes just set free.
static tss_result tss__check_start(tss_world *w) {
    char first[240] = "";
    uint64_t refused = w->refused;
    if (!w->unchecked) return TSS_OK;
    w->ctx.fresh = w->unchecked == 1 ? tss__u8(&w->fresh) : NULL;
    for (int k = 0; k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (e->live && e->def.check)
            e->def.check(e->def.user, &w->ctx, tss__f64(&w->x), tss__first_error, first);
    }
    w->ctx.fresh = NULL;
    if (w->refused != refused) return tss__no_memory(w);  // what was found is not all
    if (first[0]) return tss_world_fail(w, TSS_ERROR_INTERSECTION, "%s", first);
    for (int k = 0; k < w->elastic_count; k++) {
        const tss__elastic_ref *r = &((const tss__elastic_ref *)w->elastics.p)[k];
        int cell = -1;
        if (!tss__elastic_has_barrier(r->e)) continue;
        double J = tss__elastic_min_J(r->e, &w->host, tss__f64(&w->x), &cell);
        if (J > 0) continue;
        tss__elastic_describe(r->e, &w->ctx, cell, first, sizeof first);
        return tss_world_fail(w, TSS_ERROR_BAD_STATE, "%s has J = %g at the start, expected > 0", first, J);
    }
    return TSS_OK;
}

static tss_result tss__begin_step(tss_world *w) {
    size_t bytes = (size_t)(w->n * w->dim) * sizeof(double);
    memcpy(w->x_t.p, w->x.p, bytes);
    memcpy(w->v_t.p, w->v.p, bytes);
    memcpy(w->x_k.p, w->x.p, bytes);
    tss__fill_ctx(w);
    tss_result r = tss__check_start(w);
    if (r != TSS_OK) return r;
    if (w->chol) tss_chol_forget(w->chol);  // a resumed run takes the same path
    if (w->def.integrator == TSS_NEWMARK && w->history == 0) r = tss__start_newmark(w);
    if (r != TSS_OK) return r;
    tss__predict(w);
    int wants = 0;
    for (int k = 0; k < w->entry_count; k++)
        wants |= TSS__ENTRY(w, k)->live && (TSS__ENTRY(w, k)->def.flags & TSS_ENERGY_WANTS_GRADIENT);
    w->ctx.g = NULL;
    for (int wanting = 0; wanting < 2; wanting++) {
        if (wanting && wants) {
            for (int k = 0; k < w->entry_count; k++) {  // fixed lists; the others are not asked
                tss__entry *e = TSS__ENTRY(w, k);
                if (!tss__in_matrix(e, 0)) continue;
                r = e->def.lists(e->def.user, &w->ctx, tss__f64(&w->x_t), NULL, 0, &e->list);
                if (r != TSS_OK) return tss_world_fail(w, r, "%s: %s", e->name, tss_result_text(r));
            }
            r = tss__gradient_at(w, tss__f64(&w->x_t), tss__f64(&w->g), 0);
            if (r != TSS_OK) return r;
            w->ctx.g = tss__f64(&w->g);
        }
        for (int k = 0; k < w->entry_count; k++) {
            tss__entry *e = TSS__ENTRY(w, k);
            if (!e->live || !e->def.begin_step) continue;
            if (!!(e->def.flags & TSS_ENERGY_WANTS_GRADIENT) != wanting) continue;
            r = e->def.begin_step(e->def.user, &w->ctx);
            if (r != TSS_OK) return tss_world_fail(w, r, "%s: %s", e->name, tss_result_text(r));
        }
    }
    w->ctx.g = NULL;
    return w->finder.begin_step ? w->finder.begin_step(w->finder.user, w, &w->ctx) : TSS_OK;
}

static void tss__accept(tss_world *w, tss__iter *it) {
    size_t bytes = (size_t)(w->n * w->dim) * sizeof(double);
    double *x = tss__f64(&w->x_k), *y = tss__f64(&w->x_trial);
    int changed = 0;
    if (it->s > 0) it->s = it->alpha * it->theta >= 1 ? 0 : it->s * (1 - it->alpha * it->theta);
    if (w->def.on_iterate) w->def.on_iterate(x, y, w->def.on_iterate_ctx);
    for (int k = 0; k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (e->live && e->def.after_iterate)
            changed |= e->def.after_iterate(e->def.user, &w->ctx, x, y);
    }
    if (w->finder.accepted) w->finder.accepted(w->finder.user, &w->ctx, x, y, it->alpha);
    memcpy(x, y, bytes);
    if (changed) it->E_known = 0;
    w->info.min_alpha = tss__min(w->info.min_alpha, it->alpha);
}

// Shortens or lengthens the share of the prescribed motion that is tried at once.
static void tss__adapt_theta(tss__iter *it) {
    if (it->alpha < 0.1)
        it->theta = tss__max(it->theta * 0.25, 1e-4);
    else if (it->alpha > 0.5)
        it->theta = tss__min(it->theta * 4, 1);
}

// One solve: iterates until converged or stopped (w->info.status says which).
static tss_result tss__solve(tss_world *w, tss__iter *it) {
    double tol = it->tol = tss__tolerance(w);
    w->info.status = TSS_STEP_CONVERGED;
    for (;;) {
        if (w->info.newton >= w->def.max_iterations) {
            tss__stop(w, it->s > 0 ? TSS_STEP_TARGETS : TSS_STEP_ITERATIONS,
                      "%d iterates taken, |d|/h = %.3g m/s, tolerance %.3g; last limited by %s",
                      w->info.newton, w->info.decrement, tol / w->def.dt, it->limit);
            return TSS_OK;
        }
        if (w->deadline > 0 && tss__clock(w) > w->deadline) {
            tss__stop(w, TSS_STEP_BUDGET, "time is up after %d iterates", w->info.newton);
            return TSS_OK;
        }
        tss_status failed = TSS_STEP_CONVERGED;
        tss_result r = tss__lists(w, 0, tss__f64(&w->x_k), NULL, 0);
        if (r == TSS_OK && !it->E_known) {
            r = tss__energy_at(w, tss__f64(&w->x_k), &it->E, &it->size);
            it->E_known = 1;
        }
        tss__phase(w, TSS_PHASE_ENERGY);
        if (r == TSS_OK) r = tss__direction(w, it, &failed);
        if (r != TSS_OK) return r;
        if (failed != TSS_STEP_CONVERGED) return TSS_OK;
        w->info.newton++;
        w->info.decrement = it->dnorm / w->def.dt;
        snprintf(it->limit, sizeof it->limit, "nothing");
        r = tss__filter(w, tss__f64(&w->x_k), tss__f64(&w->d), &it->t_max, it->limit);
        if (r != TSS_OK) return r;
        tss__phase(w, TSS_PHASE_COLLISION);
        int found = 0, was_moving = it->s > 0;
        if ((r = tss__line_search(w, it, &found)) != TSS_OK) return r;
        tss__phase(w, TSS_PHASE_ENERGY);
        if (!found) {
            if (it->dnorm <= tol && it->s == 0 && !it->more) return TSS_OK;  // noise floor, close enough
            if (was_moving && it->theta > 1e-4) {  // the prescribed motion was too bold
                it->theta = tss__max(it->theta * 0.25, 1e-4);
                it->E_known = 0;
                continue;
            }
            tss__stop(w, TSS_STEP_STALLED, "no decrease along d, |d|/h = %.3g m/s, step limited to %.3g by %s",
                      w->info.decrement, it->t_max, it->limit);
            return TSS_OK;
        }
        tss__accept(w, it);
        if (was_moving) tss__adapt_theta(it);
        if (it->dnorm <= tol && it->s == 0 && !it->more) return TSS_OK;
        it->small_steps = it->alpha * tss__max(it->dnorm, 0) < 1e-8 * tol && !was_moving ? it->small_steps + 1 : 0;
        if (it->small_steps >= 10) {  // ten steps a hundred-millionth of the tolerance long
            tss__stop(w, TSS_STEP_STALLED, "steps limited to %.3g by %s", it->alpha, it->limit);
            return TSS_OK;
        }
    }
}

// ‖D_i⁻¹ ∇_{x_i}E‖/h, D_i the node's block of the last Hessian.
static double tss__node_residual(const double *D, const double *g, int dim) {
    double L[9], y[3];
    for (int i = 0; i < dim; i++)
        for (int j = 0; j <= i; j++) {
            double s = D[i * dim + j];
            for (int k = 0; k < j; k++) s -= L[i * 3 + k] * L[j * 3 + k];
            if (i == j && !(s > 0)) {  // nothing holds the node: is anything pulling?
                double pull = 0;
                for (int c = 0; c < dim; c++) pull += fabs(g[c]);
                return pull == 0 ? 0 : INFINITY;
            }
            L[i * 3 + j] = i == j ? sqrt(s) : s / L[j * 3 + j];
        }
    for (int i = 0; i < dim; i++) {
        y[i] = g[i];
        for (int k = 0; k < i; k++) y[i] -= L[i * 3 + k] * y[k];
        y[i] /= L[i * 3 + i];
    }
    double s = 0;
    for (int i = dim - 1; i >= 0; i--) {
        for (int k = i + 1; k < dim; k++) y[i] -= L[k * 3 + i] * y[k];
        y[i] /= L[i * 3 + i];
        s += y[i] * y[i];
    }
    return sqrt(s);
}

static tss_result tss__measure_residual(tss_world *w) {
    double *g = tss__f64(&w->g), *D = tss__f64(&w->diag), sum = 0, worst = 0;
    tss_result r = tss__lists(w, 0, tss__f64(&w->x_k), NULL, 0);
    if (r == TSS_OK) r = tss__gradient_at(w, tss__f64(&w->x_k), g, 1);
    if (r != TSS_OK) return r;
    if (w->solved_full || !w->finder.diagonal || !w->finder.diagonal(w->finder.user, &w->ctx, D))
        tss_bcsr_diagonal(&w->host, &w->A.m, D, 0);
    tss_bcsr_diagonal(&w->host, &w->C.m, D, 1);
    for (int k = 0; k < w->rows; k++) {
        double e = tss__node_residual(D + k * w->dim * w->dim,
                                      g + tss__i32(&w->node_of_row)[k] * w->dim, w->dim) / w->def.dt;
        sum += e, worst = tss__max(worst, e);
    }
    w->info.residual_max = worst, w->info.residual_mean = w->rows > 0 ? sum / w->rows : 0;
    return TSS_OK;
}

// ‖full-space Newton step‖∞/h at the accepted state.
static tss_result tss__newton_residual(tss_world *w) {
    tss_status failed = TSS_STEP_CONVERGED;
    double *d = tss__f64(&w->d), most = 0;
    memset(d, 0, (size_t)(w->n * w->dim) * sizeof(double));
    tss_result r = tss__full_direction(w, tss__f64(&w->x_k), tss__f64(&w->g), 0, d, &failed);
    for (int k = 0; k < w->n * w->dim; k++) most = tss__max(most, fabs(d[k]));
    w->info.residual_newton = failed == TSS_STEP_CONVERGED ? most / w->def.dt : INFINITY;
    return r;
}

static tss_result tss__finish(tss_world *w, int full) {
    tss_result r = full && w->info.newton > 0 ? tss__measure_residual(w) : TSS_OK;
    tss_step_info *s = &w->info;
    if (r == TSS_OK && full && w->def.newton_residual && s->newton > 0) r = tss__newton_residual(w);
    s->target_left = tss__target_left(w, tss__f64(&w->x_k));
    s->nodes = s->enriched_nodes = w->rows;
    s->min_distance = INFINITY, s->contacts = 0;
    for (int k = 0; full && k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (!e->live) continue;
        if (e->def.flags & TSS_ENERGY_DYNAMIC) s->contacts += e->list.count;
        if (e->def.clearance)
            s->min_distance = tss__min(s->min_distance,
                                       e->def.clearance(e->def.user, &w->ctx, tss__f64(&w->x_k)));
    }
    if (full) s->min_J = tss__min_J(w, tss__f64(&w->x_k));
    if (r == TSS_OK && w->finder.end_step)
        r = w->finder.end_step(w->finder.user, w, tss__f64(&w->x_k), s);
    return r;
}

static tss_result tss__step_solves(tss_world *w) {
    tss__iter it;
    memset(&it, 0, sizeof it);
    it.s = tss__find_moving(w) ? 1 : 0, it.theta = 1;
    tss_result r = tss__begin_step(w);
    for (int again = 1; r == TSS_OK && again;) {
        it.E_known = 0, again = 0;
        r = tss__solve(w, &it);
        if (r != TSS_OK || w->info.status != TSS_STEP_CONVERGED) break;
        for (int k = 0; k < w->entry_count; k++) {
            tss__entry *e = TSS__ENTRY(w, k);
            if (e->live && e->def.after_solve)
                again |= e->def.after_solve(e->def.user, &w->ctx, tss__f64(&w->x_k));
        }
    }
    return r;
}

// The step, from prediction to measurements, on x_k. If it fails, energies, the ordering of the
// factorisation and the choice of solvers forget it too: the next one starts as it would have.
static tss_result tss__attempt(tss_world *w, int full) {
    size_t bytes = tss__save_parts(w, w->entry_count, NULL);
    char *kept = (char *)tss__need(&w->host, &w->kept, bytes, 1);
    if (!kept || (w->chol && tss__chol_mark(w->chol) != TSS_OK)) return tss__no_memory(w);
    tss__save_parts(w, w->entry_count, kept);
    double iterations = w->pcg_iterations, ah2 = w->ctx.ah2;
    int rest = w->pcg_rest, had_chol = w->chol != NULL;
    uint64_t refused = w->refused;
    tss_result r = tss__step_solves(w);
    if (r == TSS_OK) r = tss__finish(w, full);
    if (r == TSS_OK && w->refused != refused) r = tss__no_memory(w);  // in a hook that returns none
    if (r == TSS_OK) return r;
    tss__load_parts(w, w->entry_count, kept, bytes, 1);
    if (had_chol) tss__chol_rewind(w->chol);
    else tss_chol_destroy(w->chol), w->chol = NULL;
    w->pcg_iterations = iterations, w->pcg_rest = rest, w->ctx.ah2 = ah2;
    return r;
}

static tss_result tss__take_step(tss_world *w, double budget, tss_step_info *info) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_world_prepare(w);
    if (r != TSS_OK) return r;
    double from = tss__clock(w);
    uint64_t allocations = w->allocations;
    memset(&w->info, 0, sizeof w->info);
    w->info.min_alpha = 1;
    w->phase_from = from;
    w->deadline = budget > 0 ? from + budget : 0;
    r = tss__attempt(w, info != NULL);
    if (r != TSS_OK) return r;  // x and v are untouched
    tss__advance(w);
    tss__phase(w, TSS_PHASE_OTHER);
    w->info.time = w->time;
    w->info.seconds = tss__clock(w) - from;
    w->info.bytes = w->bytes, w->info.allocations = w->allocations - allocations;
    if (w->info.status != TSS_STEP_CONVERGED)
        tss_log(&w->host, TSS_LOG_WARNING, "step %llu: %s: %s", (unsigned long long)w->steps,
                tss_status_text(w->info.status), w->info.message);
    if (info) *info = w->info;
    return TSS_OK;
}

tss_result tss_world_step(tss_world *w, tss_step_info *info) { return tss__take_step(w, 0, info); }

tss_result tss_world_step_for(tss_world *w, double seconds, tss_step_info *info) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (!(seconds > 0) || !w->def.host.clock)
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "step_for: %g s, expected > 0 and a clock in the host",
                         seconds);
    return tss__take_step(w, seconds, info);
}

// ---------------------------------------------------------------------------------------------
// >>directions (private)
// What a direction finder may ask of the world: thin doors to the sections above.
// ---------------------------------------------------------------------------------------------

tss_direction_def tss_direction_def_default(void) {
    tss_direction_def d;
    memset(&d, 0, sizeof d);
    d.cookie = TSS__COOKIE;
    return d;
}

tss_result tss_world_set_direction(tss_world *w, const tss_direction_def *def) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    if (def && (def->cookie != TSS__COOKIE || !def->direction))
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT,
                              "direction: start from tss_direction_def_default() and set direction");
    if (w->finder.destroy) w->finder.destroy(w->finder.user, &w->host);
    memset(&w->finder, 0, sizeof w->finder);
    if (def) w->finder = *def;
    return TSS_OK;
}

const tss_direction_def *tss_world_direction(const tss_world *w) {
    return w->finder.direction ? &w->finder : NULL;
}

void tss_world_unknowns(const tss_world *w, tss_unknowns *out) {
    out->rows = w->rows, out->row = tss__i32(&w->row), out->node = tss__i32(&w->node_of_row);
    out->fixed = w->masked ? tss__u8(&w->mask) : NULL;
}

int tss_world_energies(const tss_world *w) { return w->entry_count; }

tss_result tss_energy_get(const tss_world *w, tss_energy id, tss_energy_view *out) {
    if (!w || !out) return TSS_ERROR_BAD_ARGUMENT;
    if (id < 0 || id >= w->entry_count || !TSS__ENTRY(w, id)->live) return TSS_ERROR_NOT_FOUND;
    const tss__entry *e = TSS__ENTRY(w, id);
    out->name = e->name, out->def = &e->def, out->list = e->list, out->scale = tss__scale(w, e);
    out->inertia = id == w->inertia_energy;
    return TSS_OK;
}

tss_result tss_world_matrices(tss_world *w, tss_bcsr *A, tss_bcsr *C) {
    tss_result r = tss__pattern_update(w, 0);
    if (r == TSS_OK) r = tss__pattern_update(w, 1);
    if (r != TSS_OK) return r;
    w->matrix_valid = 1;
    *A = w->A.m, *C = w->C.m;
    return TSS_OK;
}

tss_result tss_world_add_hessian(tss_world *w, tss_energy id, const double *x, const uint8_t *want,
                                 const double *d_k, double *rhs) {
    tss__entry *e = TSS__ENTRY(w, id);
    return e->list.count == 0 ? TSS_OK : tss__add_hessian(w, e, x, want, d_k, rhs);
}

tss_result tss_world_list_along(tss_world *w, const double *x, const double *d, double t_max) {
    return tss__lists(w, 0, x, d, t_max);
}

tss_result tss_world_step_limit(tss_world *w, const double *x, const double *d, double *t) {
    return tss__filter(w, x, d, t, NULL);
}

tss_result tss_world_ring_drop(tss_world *w, const double *x0, const double *x1, double *ring,
                               double *drop) {
    tss_result r = TSS_OK;
    for (int k = 0; k < w->entry_count && r == TSS_OK; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (e->live && e->list.count > 0) r = tss__add_drop(w, e, x0, x1, ring, drop);
    }
    return r;
}

tss_result tss_world_full_direction(tss_world *w, double *d, int *ok) {
    tss_status failed = TSS_STEP_CONVERGED;
    tss_result r = tss__full_direction(w, tss__f64(&w->x_k), tss__f64(&w->g), 1, d, &failed);
    *ok = r == TSS_OK && failed == TSS_STEP_CONVERGED;
    return r;
}

static tss_result tss__probe_step(tss_world *w) {
    tss__iter it;
    tss_status failed = TSS_STEP_CONVERGED;
    memset(&it, 0, sizeof it);
    it.s = tss__find_moving(w) ? 1 : 0, it.theta = 1, it.tol = tss__tolerance(w);
    tss_result r = tss__begin_step(w);
    if (r == TSS_OK) r = tss__lists(w, 0, tss__f64(&w->x_k), NULL, 0);
    return r == TSS_OK ? tss__direction(w, &it, &failed) : r;
}

static tss_result tss__load_apply(tss_world *w, const char *data, size_t size);

tss_result tss_world_probe(tss_world *w) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_world_prepare(w);
    if (r != TSS_OK) return r;
    size_t bytes = tss_world_save(w, NULL, 0);
    void *state = tss_alloc(&w->host, bytes);
    if (!state) return tss__no_memory(w);
    tss_world_save(w, state, bytes);
    tss_step_info info = w->info;
    memset(&w->info, 0, sizeof w->info);
    r = tss__probe_step(w);
    tss_result back = tss__load_apply(w, (const char *)state, bytes);
    tss_free(&w->host, state, bytes);
    w->info = info;
    return r != TSS_OK ? r : back;
}

void tss_world_clock_phase(tss_world *w, tss_phase p) { tss__phase(w, p); }

tss_result tss_body_cell_material(const tss_world *w, tss_body id, int cell, double *mu, double *lambda,
                                  double *rho) {
    if (!w || id < 0 || id >= w->body_count) return TSS_ERROR_BAD_ARGUMENT;
    const tss__bodydata *b = TSS__BODY(w, id);
    if (cell < 0 || cell >= b->cells) return TSS_ERROR_BAD_ARGUMENT;
    tss_lame(b->E.p ? tss__f64(&b->E)[cell] : b->material.E, b->nu.p ? tss__f64(&b->nu)[cell] : b->material.nu,
             mu, lambda);
    if (rho) *rho = b->rho.p ? tss__f64(&b->rho)[cell] : b->material.rho;
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>queries (private)
// ---------------------------------------------------------------------------------------------

tss_result tss_world_gradient(tss_world *w, double *out) {
    if (!w || !out) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_world_prepare(w);
    if (r == TSS_OK) r = tss__lists(w, 0, tss__f64(&w->x), NULL, 0);
    if (r != TSS_OK) return r;
    memset(out, 0, (size_t)(w->n * w->dim) * sizeof(double));
    for (int k = 0; k < w->entry_count; k++)
        if (TSS__ENTRY(w, k)->live && (TSS__ENTRY(w, k)->def.flags & TSS_ENERGY_TIMES_AH2))
            tss__gradient_serial(w, TSS__ENTRY(w, k), tss__f64(&w->x), out);
    return TSS_OK;
}

tss_result tss_world_energy(tss_world *w, double *kinetic, double *potential) {
    if (!w) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_world_prepare(w);
    if (r == TSS_OK) r = tss__lists(w, 0, tss__f64(&w->x), NULL, 0);
    if (r != TSS_OK) return r;
    double K = 0, P = 0;
    for (int k = 0; k < w->n * w->dim; k++)
        K += 0.5 * tss__f64(&w->mass)[k / w->dim] * tss__f64(&w->v)[k] * tss__f64(&w->v)[k];
    for (int k = 0; k < w->entry_count && r == TSS_OK; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        double sum = 0, size = 0;
        if (!e->live || !(e->def.flags & TSS_ENERGY_TIMES_AH2)) continue;
        r = tss__add_value(w, e, &e->list, tss__f64(&w->x), &sum, &size);
        P += sum / w->ctx.ah2;
    }
    if (kinetic) *kinetic = K;
    if (potential) *potential = P;
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>checkpoint (private)
// magic, version, dim, n, counts | time, history, ah2, dt, gravity | node arrays | what each energy
// wants kept. Same build and machine: bits are copied as they are.
// ---------------------------------------------------------------------------------------------

#define TSS__MAGIC 0x3143305f737374u  // "tss_0C1"

typedef struct tss__head {
    uint64_t magic, version, dim, n, energies, steps;
    int64_t history;
    double time, ah2, dt, gravity[3], pcg_iterations;
    int64_t pcg_rest, order;  // order: nodes of the Cholesky ordering that follows the arrays
    double order_flops, tol;
    int64_t drags;  // node, stiffness, target of each
    int64_t integrator;
} tss__head;

// The node arrays a checkpoint holds.
static int tss__saved(const tss_world *w, const tss__buf **list, size_t *bytes) {
    size_t wide = (size_t)(w->n * w->dim) * sizeof(double), n = (size_t)w->n;
    const tss__buf *all[] = {&w->x, &w->v, &w->x_prev, &w->v_prev, &w->a, &w->target, &w->force,
                             &w->kind, &w->axes};
    for (int k = 0; k < 9; k++) list[k] = all[k], bytes[k] = k < 7 ? wide : n;
    return 9;
}

static size_t tss__drag_bytes(const tss_world *w) { return sizeof(int) + (size_t)(w->dim + 1) * sizeof(double); }

// The springs of tss_node_drag to (save) or from a checkpoint; returns the bytes.
static size_t tss__copy_drags(const tss_world *w, char *at, int drags, int save) {
    const tss__buf *part[3] = {&w->drag_node, &w->drag_k, &w->drag_at};
    size_t n = (size_t)drags, len[3], all = 0;
    len[0] = n * sizeof(int), len[1] = n * sizeof(double), len[2] = n * (size_t)w->dim * sizeof(double);
    for (int k = 0; k < 3; all += len[k], k++) {
        if (len[k] == 0) continue;
        if (save)
            memcpy(at + all, part[k]->p, len[k]);
        else
            memcpy(part[k]->p, at + all, len[k]);
    }
    return all;
}

static int tss__live_energies(const tss_world *w) {
    int live = 0;
    for (int k = 0; k < w->entry_count; k++) live += TSS__ENTRY(w, k)->live;
    return live;
}

size_t tss_world_save(const tss_world *w, void *data, size_t size) {
    const tss__buf *list[9];
    size_t bytes[9], need = sizeof(tss__head);
    int count = tss__saved(w, list, bytes);
    for (int k = 0; k < count; k++) need += bytes[k];
    int order = w->chol ? tss_chol_get_order(w->chol, NULL, NULL) : 0;
    need += (size_t)order * sizeof(int) + (size_t)w->drags * tss__drag_bytes(w);
    need += tss__save_parts(w, w->entry_count + 1, NULL);
    if (!data) return need;
    if (size < need) return 0;
    tss__head h;
    memset(&h, 0, sizeof h);
    h.magic = TSS__MAGIC, h.version = 3, h.dim = (uint64_t)w->dim, h.n = (uint64_t)w->n;
    h.energies = (uint64_t)tss__live_energies(w), h.steps = w->steps, h.history = w->history;
    h.time = w->time, h.ah2 = w->ctx.ah2, h.dt = w->def.dt;
    h.pcg_iterations = w->pcg_iterations, h.pcg_rest = w->pcg_rest;
    memcpy(h.gravity, w->def.gravity, sizeof h.gravity);
    h.order = order, h.drags = w->drags, h.tol = w->def.tol, h.integrator = w->def.integrator;
    if (w->chol) tss_chol_get_order(w->chol, NULL, &h.order_flops);
    char *to = (char *)data;
    memcpy(to, &h, sizeof h), to += sizeof h;
    for (int k = 0; k < count; k++, to += bytes[k - 1])
        if (bytes[k] > 0) memcpy(to, list[k]->p, bytes[k]);
    if (order > 0) tss_chol_get_order(w->chol, (int *)(void *)to, NULL);
    to += (size_t)order * sizeof(int);
    to += tss__copy_drags(w, to, w->drags, 1);
    tss__save_parts(w, w->entry_count + 1, to);
    return need;
}

// The ordering is what a Cholesky factorisation's bits depend on besides the matrix.
static tss_result tss__load_order(tss_world *w, const char *from, int n, double flops) {
    if (!w->chol && n == 0) return TSS_OK;
    if (!w->chol) {
        tss_chol_def d = tss_chol_def_default();
        if (tss_chol_create(&w->host, &d, &w->chol) != TSS_OK) return TSS_ERROR_NO_MEMORY;
    }
    int *order = (int *)tss__need(&w->host, &w->scratch, (size_t)n, sizeof(int));
    if (!order) return TSS_ERROR_NO_MEMORY;
    memcpy(order, from, (size_t)n * sizeof(int));
    return tss_chol_set_order(w->chol, n, w->dim, order, flops);
}

// Where the parts of a checkpoint lie.
typedef struct tss__layout {
    size_t arrays, order, drags, parts;
} tss__layout;

static tss__layout tss__layout_of(const tss_world *w, const tss__head *h) {
    tss__layout l;
    const tss__buf *list[9];
    size_t bytes[9];
    int count = tss__saved(w, list, bytes);
    l.arrays = l.order = sizeof *h;
    for (int k = 0; k < count; k++) l.order += bytes[k];
    l.drags = l.order + (size_t)h->order * sizeof(int);
    l.parts = l.drags + (size_t)h->drags * tss__drag_bytes(w);
    return l;
}

// Does a checkpoint's head belong to this world?
static tss_result tss__head_fits(tss_world *w, const tss__head *h) {
    int live = tss__live_energies(w);
    if (h->magic != TSS__MAGIC || h->version != 3)
        return tss_world_fail(w, TSS_ERROR_FORMAT, "checkpoint: not one of this version");
    if (h->dim != (uint64_t)w->dim || h->n != (uint64_t)w->n || h->energies != (uint64_t)live)
        return tss_world_fail(w, TSS_ERROR_MISMATCH,
                              "checkpoint: %llu nodes in %llu dimensions, %llu energies; the scene "
                              "has %d, %d, %d",
                              (unsigned long long)h->n, (unsigned long long)h->dim,
                              (unsigned long long)h->energies, w->n, w->dim, live);
    if (h->integrator != (int64_t)w->def.integrator)
        return tss_world_fail(w, TSS_ERROR_MISMATCH,
                              "checkpoint: integrator %lld; the scene has %d",
                              (long long)h->integrator, (int)w->def.integrator);
    if (h->order < 0 || h->order > w->n)
        return tss_world_fail(w, TSS_ERROR_FORMAT, "checkpoint: an ordering of %lld nodes",
                              (long long)h->order);
    if (h->drags < 0 || h->drags > w->n)
        return tss_world_fail(w, TSS_ERROR_FORMAT, "checkpoint: %lld dragged nodes",
                              (long long)h->drags);
    return TSS_OK;
}

// A number of the head that no world can have, or NULL.
static const char *tss__head_fault(const tss_world *w, const tss__head *h) {
    if (!(h->dt > 0) || !isfinite(h->dt)) return "dt";
    if (!(h->ah2 > 0) || !isfinite(h->ah2)) return "the integrator's factor";
    if (!isfinite(h->time)) return "time";
    if (!isfinite(h->gravity[0] + h->gravity[1] + h->gravity[2])) return "gravity";
    if (!(h->tol >= 0) || !(h->tol + w->def.tol_rel > 0)) return "tol";
    if (h->history < 0 || h->history > INT32_MAX) return "history";
    if (!(h->pcg_iterations >= 0) || !isfinite(h->pcg_iterations)) return "pcg_iterations";
    if (h->pcg_rest < 0 || h->pcg_rest > TSS__PCG_REST) return "pcg_rest";
    if (!(h->order_flops >= 0) || !isfinite(h->order_flops)) return "the ordering's flops";
    return NULL;
}

static int tss__all_finite(const char *from, size_t count) {
    for (size_t k = 0; k < count; k++) {
        double v;
        memcpy(&v, from + k * sizeof v, sizeof v);
        if (!isfinite(v)) return 0;
    }
    return 1;
}

// A node that cannot be of this kind or pinned along these axes, or −1.
static int tss__bad_kind(const tss_world *w, const uint8_t *kind, const uint8_t *axes) {
    for (int i = 0; i < w->n; i++) {
        const tss__bodydata *b = TSS__BODY(w, tss__i32(&w->body)[i]);
        int fixed = b->kind == TSS_BODY_OBSTACLE || b->removed;
        if (kind[i] > TSS_NODE_OBSTACLE || (kind[i] == TSS_NODE_OBSTACLE) != fixed) return i;
        if (axes[i] >= (1 << w->dim) - 1 || (axes[i] && kind[i] != TSS_NODE_FREE)) return i;
    }
    return -1;
}

static int tss__drags_ok(const tss_world *w, const char *from, size_t drags) {
    const char *k = from + drags * sizeof(int);
    for (size_t i = 0; i < drags; i++) {
        int node;
        double stiffness;
        memcpy(&node, from + i * sizeof node, sizeof node);
        memcpy(&stiffness, k + i * sizeof stiffness, sizeof stiffness);
        if (node < 0 || node >= w->n || !(stiffness > 0)) return 0;
    }
    return tss__all_finite(k, drags * (size_t)(w->dim + 1));
}

// 1: a permutation, 0: not, −1: no memory.
static int tss__order_ok(tss_world *w, const char *from, int n) {
    uint8_t *seen = (uint8_t *)tss__need(&w->host, &w->scratch, (size_t)n, 1);
    if (!seen) return -1;
    memset(seen, 0, (size_t)n);
    for (int i = 0; i < n; i++) {
        int v;
        memcpy(&v, from + (size_t)i * sizeof v, sizeof v);
        if (v < 0 || v >= n || seen[v]++) return 0;
    }
    return 1;
}

// What is out of range in the arrays of a checkpoint whose lengths are right, or NULL.
static const char *tss__arrays_fault(const tss_world *w, const char *data, const tss__head *h) {
    tss__layout l = tss__layout_of(w, h);
    size_t n = (size_t)w->n;
    const uint8_t *kind = (const uint8_t *)data + l.order - 2 * n;
    if (tss__bad_kind(w, kind, kind + n) >= 0) return "a node's kind or pinned axes";
    if (!tss__all_finite(data + l.arrays, 7 * n * (size_t)w->dim))
        return "a position, velocity, target or force";
    if (!tss__drags_ok(w, data + l.drags, (size_t)h->drags))
        return "a dragged node, its stiffness or target";
    return NULL;
}

// Everything that can be known of a checkpoint before anything of the world is written.
static tss_result tss__load_check(tss_world *w, const char *data, size_t size) {
    tss__head h;
    if (size < sizeof h)
        return tss_world_fail(w, TSS_ERROR_FORMAT, "checkpoint: %zu bytes are too few", size);
    memcpy(&h, data, sizeof h);
    tss_result r = tss__head_fits(w, &h);
    if (r != TSS_OK) return r;
    tss__layout l = tss__layout_of(w, &h);
    int parts = w->entry_count + 1;
    if (size < l.parts || !tss__load_parts(w, parts, data + l.parts, size - l.parts, 0))
        return tss_world_fail(w, TSS_ERROR_FORMAT, "checkpoint: cut short or of another scene");
    const char *fault = tss__head_fault(w, &h);
    if (!fault) fault = tss__arrays_fault(w, data, &h);
    int permutes = tss__order_ok(w, data + l.order, (int)h.order);
    if (permutes < 0) return tss__no_memory(w);
    if (!fault && !permutes) fault = "the ordering";
    if (!fault) return TSS_OK;
    return tss_world_fail(w, TSS_ERROR_FORMAT, "checkpoint: %s is out of range", fault);
}

// Takes a checkpoint that fits. Fails without memory, or where an energy refuses its part.
static tss_result tss__load_apply(tss_world *w, const char *data, size_t size) {
    tss__head h;
    const tss__buf *list[9];
    size_t bytes[9];
    memcpy(&h, data, sizeof h);
    tss__layout l = tss__layout_of(w, &h);
    int count = tss__saved(w, list, bytes);
    const char *from = data + l.arrays, *kinds = data + l.order - 2 * bytes[7];
    if (memcmp(kinds, w->kind.p, bytes[7]) || memcmp(kinds + bytes[7], w->axes.p, bytes[8]))
        w->prepared = 0;
    for (int k = 0; k < count; k++) memcpy(list[k]->p, from, bytes[k]), from += bytes[k];
    w->steps = h.steps, w->history = (int)h.history, w->time = h.time;
    w->def.dt = h.dt, w->def.tol = h.tol;
    w->ctx.ah2 = h.ah2, w->pcg_iterations = h.pcg_iterations, w->pcg_rest = (int)h.pcg_rest;
    memcpy(w->def.gravity, h.gravity, sizeof h.gravity);
    tss_result r = tss__drags_reserve(w, (size_t)h.drags);
    if (r != TSS_OK) return r;
    if (w->drags > 0 || h.drags > 0) w->drag_pattern++;
    tss__copy_drags(w, (char *)(uintptr_t)(data + l.drags), (int)h.drags, 0);
    w->drags = (int)h.drags;
    r = tss__load_order(w, data + l.order, (int)h.order, h.order_flops);
    if (r != TSS_OK) return tss_world_fail(w, r, "checkpoint: ordering: %s", tss_result_text(r));
    if ((r = tss_world_prepare(w)) != TSS_OK) return r;
    tss__fill_ctx(w);
    if (!tss__load_parts(w, w->entry_count + 1, data + l.parts, size - l.parts, 1))
        return tss_world_fail(w, TSS_ERROR_MISMATCH, "checkpoint: an energy refused its state");
    return TSS_OK;
}

tss_result tss_world_load(tss_world *w, const void *data, size_t size) {
    if (!w || !data) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_world_prepare(w);
    if (r == TSS_OK) r = tss__load_check(w, (const char *)data, size);
    if (r != TSS_OK) return r;
    // What only an energy can refuse: from a copy of the present state back to it.
    size_t bytes = tss_world_save(w, NULL, 0);
    char *before = (char *)tss_alloc(&w->host, bytes);
    if (!before) return tss__no_memory(w);
    tss_world_save(w, before, bytes);
    r = tss__load_apply(w, (const char *)data, size);
    if (r != TSS_OK) {
        char why[sizeof w->error];
        memcpy(why, w->error, sizeof why);
        tss__load_apply(w, before, bytes);
        memcpy(w->error, why, sizeof why);
    } else
        w->unchecked = 2;
    tss_free(&w->host, before, bytes);
    return r;
}

// The states of all energies, one after the other, through a buffer.
static tss_result tss__copy_energies(tss_world *to, const tss_world *from) {
    for (int k = 0; k < to->entry_count; k++) {
        size_t bytes = tss__part_state(from, k, NULL, 0, 1);
        if (bytes == 0) continue;
        void *data = tss__need(&to->host, &to->scratch, bytes, 1);
        if (!data) return tss__no_memory(to);
        tss__part_state(from, k, data, bytes, 1);
        if (!tss__part_has_state(to, k) || tss__part_state(to, k, data, bytes, 0) != bytes)
            return tss_world_fail(to, TSS_ERROR_MISMATCH, "copy_state: energy %d is another one there", k);
    }
    return TSS_OK;
}

tss_result tss_world_copy_state(tss_world *to, const tss_world *from) {
    const tss__buf *out[9], *in[9];
    size_t bytes[9];
    if (!to || !from) return TSS_ERROR_BAD_ARGUMENT;
    tss_result r = tss_world_prepare(to);
    if (r != TSS_OK) return r;
    if (!from->prepared || to->n != from->n || to->dim != from->dim || to->entry_count != from->entry_count)
        return tss_world_fail(to, TSS_ERROR_MISMATCH, "copy_state: the worlds were not built by the same calls");
    int count = tss__saved(to, out, bytes);
    tss__saved(from, in, bytes);
    if (memcmp(out[7]->p, in[7]->p, bytes[7]) || memcmp(out[8]->p, in[8]->p, bytes[8]))
        return tss_world_fail(to, TSS_ERROR_MISMATCH, "copy_state: other nodes are pinned or scripted there");
    if ((r = tss__copy_energies(to, from)) != TSS_OK) return r;
    for (int k = 0; k < count; k++) memcpy(out[k]->p, in[k]->p, bytes[k]);
    to->steps = from->steps, to->history = from->history, to->time = from->time;
    to->ctx.ah2 = from->ctx.ah2, to->def.dt = from->def.dt;
    memcpy(to->def.gravity, from->def.gravity, sizeof to->def.gravity);
    to->unchecked = from->unchecked ? 2 : 0;
    tss__fill_ctx(to);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>doctor (private)
// ---------------------------------------------------------------------------------------------

static void tss__report(tss_severity severity, const char *text, void *arg) {
    tss_check_report *r = (tss_check_report *)arg;
    *(severity == TSS_SEVERITY_ERROR ? &r->errors : severity == TSS_SEVERITY_WARNING ? &r->warnings
                                                                                     : &r->notes) += 1;
    if (r->count >= TSS_CHECK_MAX) return;
    r->issue[r->count].severity = severity;
    snprintf(r->issue[r->count].text, sizeof r->issue[r->count].text, "%.239s", text);
    r->count++;
}

static double tss__body_size(const tss_world *w, const tss__bodydata *b) {
    double s = 0;
    for (int c = 0; c < w->dim; c++) {
        double lo = INFINITY, hi = -INFINITY;
        for (int i = b->first; i < b->first + b->nodes; i++) {
            lo = tss__min(lo, tss__f64(&w->X)[i * w->dim + c]);
            hi = tss__max(hi, tss__f64(&w->X)[i * w->dim + c]);
        }
        s += (hi - lo) * (hi - lo);
    }
    return sqrt(s);
}

// A body that would squash under its own weight is more often in millimetres than that soft.
static void tss__check_units(const tss_world *w, const tss__bodydata *b, tss_check_report *r) {
    double g = 0, size = tss__body_size(w, b), E = b->material.E, rho = b->material.rho;
    char text[240];
    for (int c = 0; c < w->dim; c++) g += w->def.gravity[c] * w->def.gravity[c];
    for (int c = 0; b->E.p && c < b->cells; c++) E = tss__max(c ? E : 0, tss__f64(&b->E)[c]);
    for (int c = 0; b->rho.p && c < b->cells; c++) rho = tss__max(c ? rho : 0, tss__f64(&b->rho)[c]);
    double sag = rho * sqrt(g) * size / E;
    if (size > 50 || (sag > 1 && size > 10)) {
        snprintf(text, sizeof text,
                 "%s is %.4g m long%s; units are metres, kilograms, seconds: a mesh in millimetres wants "
                 "a scale of 0.001", b->name, size, sag > 1 ? " and would collapse under its own weight" : "");
        tss__report(TSS_SEVERITY_WARNING, text, r);
    } else if (sag > 1) {
        snprintf(text, sizeof text, "%s (E = %.3g Pa, %.3g m) is too soft to carry its own weight", b->name,
                 E, size);
        tss__report(TSS_SEVERITY_WARNING, text, r);
    }
}

// Slivers make every solve worse: height against longest edge of the flattest cell.
static void tss__check_quality(const tss_world *w, const tss__bodydata *b, tss_check_report *r) {
    double worst = INFINITY;
    int at = -1, size = w->dim + 1;
    for (int k = 0; k < b->cells; k++) {
        const int *c = tss__i32(&b->cell) + k * size;
        double longest = 0, vol = tss__cell_volume(w->dim, tss__f64(&w->X), c);
        for (int i = 1; i < size; i++)
            for (int j = 0; j < i; j++) {
                double l = 0;
                for (int a = 0; a < w->dim; a++) {
                    double e = tss__f64(&w->X)[c[i] * w->dim + a] - tss__f64(&w->X)[c[j] * w->dim + a];
                    l += e * e;
                }
                longest = tss__max(longest, sqrt(l));
            }
        double q = w->dim == 3 ? 8.49 * vol / (longest * longest * longest) : 2.31 * vol / (longest * longest);
        if (q < worst) worst = q, at = k;
    }
    if (worst > 1e-3) return;
    char text[240];
    snprintf(text, sizeof text, "%s: cell %d is a sliver (quality %.2g, 1 is regular); steps will be slow",
             b->name, at, worst);
    tss__report(TSS_SEVERITY_WARNING, text, r);
}

// x0 may differ from X: a barrier material needs J > 0 there too.
static void tss__check_inversion(const tss_world *w, const tss__bodydata *b, tss_check_report *r) {
    int bad = 0, first = -1, size = w->dim + 1;
    for (int k = 0; k < b->cells; k++) {
        if (tss__cell_volume(w->dim, tss__f64(&w->x), tss__i32(&b->cell) + k * size) > 0) continue;
        if (bad++ == 0) first = k;
    }
    if (bad == 0) return;
    char text[240];
    snprintf(text, sizeof text, "%s: %d cells are inverted at the start, the first is cell %d", b->name, bad, first);
    int barrier = b->material.kind == TSS_NEO_HOOKEAN ||
                  (b->material.kind == TSS_CUSTOM_MATERIAL && b->material.barrier);
    tss__report(barrier ? TSS_SEVERITY_ERROR : TSS_SEVERITY_WARNING, text, r);
}

tss_result tss_world_check(tss_world *w, tss_check_report *out) {
    if (!w || !out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    tss_result r = tss_world_prepare(w);
    uint64_t refused = w->refused;
    if (r != TSS_OK) {
        char text[240];
        snprintf(text, sizeof text, "%.200s", w->error);
        tss__report(TSS_SEVERITY_ERROR, text, out);
        return r == TSS_ERROR_EMPTY ? TSS_OK : r;
    }
    for (int k = 0; k < w->body_count; k++) {
        const tss__bodydata *b = TSS__BODY(w, k);
        if (b->removed || b->kind != TSS_BODY_SOFT) continue;
        tss__check_units(w, b, out);
        tss__check_quality(w, b, out);
        tss__check_inversion(w, b, out);
    }
    for (int k = 0; k < w->entry_count; k++) {
        tss__entry *e = TSS__ENTRY(w, k);
        if (e->live && e->def.check) e->def.check(e->def.user, &w->ctx, tss__f64(&w->x), tss__report, out);
    }
    if (w->refused != refused) return tss__no_memory(w);
    return TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>energy_check (private)
// Central differences of one stencil's value and gradient over three steps a decade apart, the best
// of which counts: too long truncates, too short drowns in rounding.
// ---------------------------------------------------------------------------------------------

typedef struct tss__fd {
    tss_world *w;
    tss__entry *e;
    double *x;
    int id, S;
    double g_floor, h_floor;  // deviations are relative to at least these
} tss__fd;

static void tss__fd_batch(const tss__fd *f, double *value, double *gradient) {
    tss_ids ids;
    ids.first = f->id, ids.count = 1, ids.list = NULL;
    if (value) f->e->def.value(f->e->def.user, &f->w->ctx, f->x, ids, value);
    if (gradient) f->e->def.gradient(f->e->def.user, &f->w->ctx, f->x, ids, gradient);
}

// Relative errors of one stencil for one step length.
static void tss__fd_stencil(const tss__fd *f, double step, const double *g, const double *H, double *eg,
                            double *eh) {
    const int *node = f->e->list.node + (size_t)f->id * (size_t)f->e->def.arity;
    double gn = 0, hn = 0, dg = 0, dh = 0, gp[24], gm[24];
    for (int k = 0; k < f->S; k++) {
        int i = node[k / f->w->dim];
        if (i < 0) continue;
        double *x = f->x + i * f->w->dim + k % f->w->dim, keep = *x, vp, vm;
        *x = keep + step;
        tss__fd_batch(f, &vp, gp);
        *x = keep - step;
        tss__fd_batch(f, &vm, gm);
        *x = keep;
        double e = (vp - vm) / (2 * step) - g[k];
        dg += e * e, gn += g[k] * g[k];
        for (int l = 0; l < f->S; l++) {
            double c = (gp[l] - gm[l]) / (2 * step) - H[k * f->S + l];
            dh += c * c, hn += H[k * f->S + l] * H[k * f->S + l];
        }
    }
    double gs = tss__max(sqrt(gn), f->g_floor), hs = tss__max(sqrt(hn), f->h_floor);
    *eg = gs > 0 ? sqrt(dg) / gs : sqrt(dg);
    *eh = hs > 0 ? sqrt(dh) / hs : sqrt(dh);
}

// A thousandth of the largest gradient and Hessian of all stencils: below it a stencil hardly
// counts, and differences of its value only show their own truncation. Springs at rest have no
// gradient at all: then 1e-8 of the Hessian times the scene's size.
static void tss__fd_floors(tss__fd *f) {
    double g[24], H[24 * 24], gm = 0, hm = 0;
    for (f->id = 0; f->id < f->e->list.count; f->id++) {
        double gn = 0, hn = 0;
        tss_ids ids;
        ids.first = f->id, ids.count = 1, ids.list = NULL;
        f->e->def.gradient(f->e->def.user, &f->w->ctx, f->x, ids, g);
        f->e->def.hessian(f->e->def.user, &f->w->ctx, f->x, ids, 0, H);
        for (int k = 0; k < f->S; k++) gn += g[k] * g[k];
        for (int k = 0; k < f->S * f->S; k++) hn += H[k] * H[k];
        gm = tss__max(gm, gn), hm = tss__max(hm, hn);
    }
    f->h_floor = 1e-3 * sqrt(hm);
    f->g_floor = tss__max(1e-3 * sqrt(gm), 1e-8 * sqrt(hm) * f->w->diagonal);
}

// Smallest eigenvalue of a symmetric matrix over its norm: −1e-k means it fails to be PSD by that.
// Cholesky with a growing shift brackets it to a factor of 10.
static double tss__psd_defect(const double *H, int S) {
    double norm = 0, L[24 * 24];
    for (int k = 0; k < S * S; k++) norm = tss__max(norm, fabs(H[k]));
    if (norm == 0) return 0;
    for (double shift = 1e-14; shift < 10; shift *= 10) {
        int ok = 1;
        for (int i = 0; ok && i < S; i++)
            for (int j = 0; ok && j <= i; j++) {
                double s = H[i * S + j] + (i == j ? shift * norm : 0);
                for (int k = 0; k < j; k++) s -= L[i * S + k] * L[j * S + k];
                if (i == j) {
                    ok = s > 0;
                    L[i * S + i] = sqrt(s > 0 ? s : 1);
                } else
                    L[i * S + j] = s / L[j * S + j];
            }
        if (ok) return -shift;
    }
    return -INFINITY;
}

tss_result tss_energy_check(tss_world *w, tss_energy id, tss_energy_report *out) {
    if (!w || !out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    out->gradient_stencil = out->hessian_stencil = -1;
    tss_result r = tss_world_prepare(w);
    if (r != TSS_OK) return r;
    if (id < 0 || id >= w->entry_count || !TSS__ENTRY(w, id)->live)
        return tss_world_fail(w, TSS_ERROR_NOT_FOUND, "no energy %d", id);
    size_t bytes = (size_t)(w->n * w->dim) * sizeof(double);
    memcpy(w->x_trial.p, w->x.p, bytes);
    tss__fd f;
    f.w = w, f.e = TSS__ENTRY(w, id), f.x = tss__f64(&w->x_trial), f.S = f.e->def.arity * w->dim;
    r = f.e->def.lists(f.e->def.user, &w->ctx, f.x, NULL, 0, &f.e->list);
    if (r != TSS_OK) return tss_world_fail(w, r, "%s: %s", f.e->name, tss_result_text(r));
    tss__fd_floors(&f);
    for (f.id = 0; r == TSS_OK && f.id < f.e->list.count; f.id++) {
        double g[24], H[24 * 24], eg = INFINITY, eh = INFINITY;
        tss_ids ids;
        ids.first = f.id, ids.count = 1, ids.list = NULL;
        tss__fd_batch(&f, NULL, g);
        f.e->def.hessian(f.e->def.user, &w->ctx, f.x, ids, 1, H);
        out->psd_min = tss__min(out->psd_min, tss__psd_defect(H, f.S));
        f.e->def.hessian(f.e->def.user, &w->ctx, f.x, ids, 0, H);
        for (double step = 1e-7; step < 1e-4; step *= 10) {
            double a, b;
            tss__fd_stencil(&f, step * w->diagonal, g, H, &a, &b);
            eg = tss__min(eg, a), eh = tss__min(eh, b);
        }
        if (eg > out->gradient_error) out->gradient_error = eg, out->gradient_stencil = f.id;
        if (eh > out->hessian_error) out->hessian_error = eh, out->hessian_stencil = f.id;
    }
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>embedding (private)
// Each point keeps the cell that contains it at rest (or whose barycentric coordinates are least
// negative) and its weights. Cells are found by a uniform grid over their boxes.
// ---------------------------------------------------------------------------------------------

struct tss_embedding {
    tss_host host;  // the caller's, so that it may outlive the world
    int dim, count;
    tss__buf node;    // int, count × (dim + 1)
    tss__buf weight;  // double, count × (dim + 1)
};

// Barycentric coordinates of p in a cell; returns the smallest.
static double tss__barycentric(int dim, const double *X, const int *c, const double *p, double *w) {
    double whole = tss__cell_volume(dim, X, c), least = INFINITY, Y[12] = {0};
    int id[4] = {0, 1, 2, 3};
    for (int k = 0; k <= dim; k++) {
        for (int i = 0; i <= dim; i++)
            for (int a = 0; a < dim; a++) Y[i * dim + a] = i == k ? p[a] : X[c[i] * dim + a];
        w[k] = tss__cell_volume(dim, Y, id) / whole;
        least = tss__min(least, w[k]);
    }
    return least;
}

typedef struct tss__grid {
    double lo[3], step;
    int size[3];
    tss__buf start, cell;
} tss__grid;

static int tss__grid_at(const tss__grid *g, int a, double p) {
    double k = floor((p - g->lo[a]) / g->step);
    return k < 0 ? 0 : k >= g->size[a] ? g->size[a] - 1 : (int)k;
}

static void tss__grid_box(const tss_world *w, const int *c, const tss__grid *g, int *from, int *to) {
    for (int a = 0; a < 3; a++) {
        double lo = INFINITY, hi = -INFINITY;
        for (int i = 0; i <= w->dim && a < w->dim; i++) {
            lo = tss__min(lo, tss__f64(&w->X)[c[i] * w->dim + a]);
            hi = tss__max(hi, tss__f64(&w->X)[c[i] * w->dim + a]);
        }
        from[a] = a < w->dim ? tss__grid_at(g, a, lo) : 0;
        to[a] = a < w->dim ? tss__grid_at(g, a, hi) : 0;
    }
}

static tss_result tss__grid_build(tss_world *w, const tss__bodydata *b, tss__grid *g) {
    double hi[3] = {0, 0, 0}, volume = 1;
    for (int a = 0; a < w->dim; a++) {
        g->lo[a] = INFINITY, hi[a] = -INFINITY;
        for (int i = b->first; i < b->first + b->nodes; i++) {
            g->lo[a] = tss__min(g->lo[a], tss__f64(&w->X)[i * w->dim + a]);
            hi[a] = tss__max(hi[a], tss__f64(&w->X)[i * w->dim + a]);
        }
        volume *= hi[a] - g->lo[a];
    }
    g->step = pow(volume / b->cells, 1.0 / w->dim);
    int total = 1;
    for (int a = 0; a < 3; a++) {
        double k = a < w->dim ? ceil((hi[a] - g->lo[a]) / g->step) : 1;
        g->size[a] = k < 1 ? 1 : k > 256 ? 256 : (int)k;
        if (a < w->dim) g->step = tss__max(g->step, (hi[a] - g->lo[a]) / 256);
        total *= g->size[a];
    }
    int *start = (int *)tss__need(&w->host, &g->start, (size_t)total + 2, sizeof(int));
    if (!start) return tss__no_memory(w);
    memset(start, 0, ((size_t)total + 2) * sizeof(int));
    int *cell = NULL, from[3], to[3];
    for (int pass = 0; pass < 2; pass++) {
        for (int k = 0; k < b->cells; k++) {
            tss__grid_box(w, tss__i32(&b->cell) + k * (w->dim + 1), g, from, to);
            for (int z = from[2]; z <= to[2]; z++)
                for (int y = from[1]; y <= to[1]; y++)
                    for (int x = from[0]; x <= to[0]; x++) {
                        int at = (z * g->size[1] + y) * g->size[0] + x;
                        if (pass == 0)
                            start[at + 2]++;
                        else
                            cell[start[at + 1]++] = k;
                    }
        }
        if (pass == 0) {
            for (int k = 0; k < total; k++) start[k + 2] += start[k + 1];
            cell = (int *)tss__need(&w->host, &g->cell, (size_t)start[total + 1], sizeof(int));
            if (!cell) return tss__no_memory(w);
        }
    }
    return TSS_OK;
}

// Best cell for p: among those of its grid box, else among all (a point outside the body).
static void tss__embed_point(const tss_world *w, const tss__bodydata *b, const tss__grid *g,
                             const double *p, int *node, double *weight) {
    int at = 0, size = w->dim + 1, best = -1;
    for (int a = w->dim - 1; a >= 0; a--) at = at * g->size[a] + tss__grid_at(g, a, p[a]);
    double least = -INFINITY, try_w[4];
    for (int all = 0; all < 2 && least < -1e-9; all++) {
        int from = all ? 0 : tss__i32(&g->start)[at], to = all ? b->cells : tss__i32(&g->start)[at + 1];
        for (int k = from; k < to; k++) {
            int c = all ? k : tss__i32(&g->cell)[k];
            double m = tss__barycentric(w->dim, tss__f64(&w->X), tss__i32(&b->cell) + c * size, p, try_w);
            if (m <= least) continue;
            least = m, best = c;
        }
    }
    const int *c = tss__i32(&b->cell) + best * size;
    tss__barycentric(w->dim, tss__f64(&w->X), c, p, weight);
    for (int i = 0; i < size; i++) node[i] = c[i];
}

tss_result tss_embedding_create(tss_world *w, tss_body id, const double *points, int count,
                                tss_embedding **out) {
    if (!w || !out) return TSS_ERROR_BAD_ARGUMENT;
    *out = NULL;
    if (!tss__has_body(w, id) || TSS__BODY(w, id)->cells == 0)
        return tss_world_fail(w, TSS_ERROR_NOT_FOUND, "no body %d with cells to carry points", id);
    if (count < 0 || (count > 0 && !points))
        return tss_world_fail(w, TSS_ERROR_BAD_ARGUMENT, "embedding: %d points but no array of them", count);
    tss_result r = tss__finite(w, "embedded point", points, count * w->dim);
    if (r != TSS_OK) return r;
    const tss_host *host = &w->def.host;
    tss_embedding *e = (tss_embedding *)tss_alloc(host, sizeof *e);
    if (!e) return tss__no_memory(w);
    memset(e, 0, sizeof *e);
    e->host = *host, e->dim = w->dim, e->count = count;
    size_t size = (size_t)count * (size_t)(w->dim + 1);
    tss__grid g;
    memset(&g, 0, sizeof g);
    int *node = (int *)tss__need(host, &e->node, size, sizeof(int));
    double *weight = (double *)tss__need(host, &e->weight, size, sizeof(double));
    r = node && weight ? tss__grid_build(w, TSS__BODY(w, id), &g) : tss__no_memory(w);
    for (int k = 0; r == TSS_OK && k < count; k++)
        tss__embed_point(w, TSS__BODY(w, id), &g, points + k * w->dim, node + k * (w->dim + 1),
                         weight + k * (w->dim + 1));
    tss__buf_free(&w->host, &g.start), tss__buf_free(&w->host, &g.cell);
    if (r != TSS_OK) {
        tss_embedding_destroy(e);
        return r;
    }
    *out = e;
    return TSS_OK;
}

void tss_embedding_destroy(tss_embedding *e) {
    if (!e) return;
    tss_host host = e->host;
    tss__buf_free(&host, &e->node), tss__buf_free(&host, &e->weight);
    tss_free(&host, e, sizeof *e);
}

void tss_embedding_update(const tss_embedding *e, const tss_world *w, float *out) {
    const double *x = tss__f64(&w->x);
    for (int k = 0; k < e->count; k++)
        for (int a = 0; a < e->dim; a++) {
            double s = 0;
            for (int i = 0; i <= e->dim; i++)
                s += tss__f64(&e->weight)[k * (e->dim + 1) + i] *
                     x[tss__i32(&e->node)[k * (e->dim + 1) + i] * e->dim + a];
            out[k * e->dim + a] = (float)s;
        }
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
