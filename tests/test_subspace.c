// The adaptive solver against references that share nothing with it: dense matrices assembled
// stencil by stencil, the full-space solver, exact scaling, and a judge of whole paths.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>
#include <pthread.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_io.h"
#include "tss_shapes.h"
#include "tss_subspace.h"
#include "checker.h"

// ---- scenes -----------------------------------------------------------------------------------

typedef struct plan {
    const char *name;
    int dim, n, bodies;  // cells along an edge of a block; blocks above each other
    int contact;         // with a plane under them and with each other
    double mu, kappa;    // kappa 0: adaptive
    tss_integrator integrator;
    tss_material_kind material;
    double E, h, tol, speed;  // Pa; s; m/s; m/s downwards; 0: 1e5, 0.01, 1e-3, 0
    int lower, upper;         // basis kind of the lowest block and of those above; −1: none
    int count, initial;       // handles or modes; active blocks (0: as the kind has it)
    int second;               // EIGEN modes besides, for the lowest block
    unsigned pins;            // axes of the lowest block's nodes at x = 0
    int steps;
    void (*change)(tss_world *w, const struct plan *p, int step);  // before each step; or NULL
    tss_host *host;                                                // or NULL
    void (*custom)(tss_world *w, tss_body lowest);                 // adds bases of its own; or NULL
} plan;

typedef struct scene {
    tss_world *w;
    tss_ipc *ipc;
    check *judge;
    int *body, *cells;
    unsigned char *kinematic;
    double floor[6];
    int iterates;
} scene;

static void ok(tss_world *w, tss_result r) {
    if (r != TSS_OK) print_error("%s: %s\n", tss_result_text(r), tss_world_error(w));
    assert_int_equal(r, TSS_OK);
}

static void on_iterate(const double *x0, const double *x1, void *ctx) {
    scene *s = (scene *)ctx;
    s->iterates++;
    if (s->judge) (void)check_segment(s->judge, x0, x1);
}

// A block of cubes in five tets (2D: squares in two triangles) of 0.2 m at height y.
static tss_body add_block(tss_world *w, const plan *p, int dim, double y, double turn) {
    tss_mesh m;
    const double lo[3] = {-0.1, 0, -0.1}, hi[3] = {0.1, 0.2, 0.1};
    const int n[3] = {p->n, p->n, p->n};
    if (dim == 3)
        assert_int_equal(tss_shape_box(NULL, lo, hi, n, 5, NULL, &m), TSS_OK);
    else
        assert_int_equal(tss_shape_rectangle(NULL, lo, hi, p->n, p->n, &m), TSS_OK);
    for (int i = 0; i < m.nodes; i++) {
        double *x = m.x + 3 * i, a = x[0], b = dim == 3 ? x[2] : 0;
        x[0] = cos(turn) * a - sin(turn) * b, x[1] += y, x[2] = sin(turn) * a + cos(turn) * b;
        if (dim == 2) m.x[2 * i] = a, m.x[2 * i + 1] = x[1];
    }
    tss_body_def d = tss_body_def_default();
    tss_body b = -1;
    d.nodes = m.nodes, d.X = m.x, d.cells = dim == 3 ? m.tets : m.triangles;
    d.cell = dim == 3 ? m.tet : m.triangle;
    d.material.kind = p->material, d.material.E = p->E > 0 ? p->E : 1e5;
    d.velocity[1] = -p->speed;
    ok(w, tss_body_add(w, &d, &b));
    tss_mesh_free(&m);
    return b;
}

static tss_basis_def basis_of(int kind, int count, int initial) {
    tss_basis_def d = kind == TSS_BASIS_AFFINE       ? tss_basis_affine()
                      : kind == TSS_BASIS_QUADRATIC  ? tss_basis_quadratic()
                      : kind == TSS_BASIS_SKINNING   ? tss_basis_skinning(count)
                      : kind == TSS_BASIS_BIHARMONIC ? tss_basis_biharmonic(count)
                                                     : tss_basis_eigen(count);
    if (initial != 0) d.initial = initial;
    return d;
}

static void add_contact(scene *s, const plan *p) {
    tss_ipc_plane plane = {{0, 0, 0}, {0, 1, 0}, p->mu};
    tss_ipc_def c = tss_ipc_def_default();
    c.mu = p->mu, c.kappa = p->kappa, c.planes = 1, c.plane = &plane;
    ok(s->w, tss_ipc_add(s->w, &c, &s->ipc));
}

static void make(scene *s, const plan *p, const tss_subspace_def *sub) {
    tss_world_def d = tss_world_def_default();
    memset(s, 0, sizeof *s);
    if (p->host) d.host = *p->host;
    d.dim = p->dim, d.integrator = p->integrator, d.dt = p->h > 0 ? p->h : 0.01;
    d.tol = p->tol > 0 ? p->tol : 1e-3, d.pcg_tol = 1e-8;
    d.on_iterate = on_iterate, d.on_iterate_ctx = s;
    assert_int_equal(tss_world_create(&d, &s->w), TSS_OK);
    for (int k = 0; k < p->bodies; k++) add_block(s->w, p, p->dim, 0.0015 + 0.2015 * k, 0.3 * k);
    if (p->contact) add_contact(s, p);
    tss_body_info info;
    ok(s->w, tss_body_get(s->w, 0, &info));
    for (int i = 0; p->pins && i < info.nodes; i++)
        if (tss_world_rest(s->w)[i * p->dim] < -0.0999) ok(s->w, tss_node_pin(s->w, i, p->pins));
    ok(s->w, tss_subspace_add(s->w, sub, NULL));
    for (int k = 0; k < p->bodies; k++) {
        tss_basis_def b = basis_of(k ? p->upper : p->lower, p->count, p->initial);
        if ((k ? p->upper : p->lower) >= 0) ok(s->w, tss_basis_add(s->w, k, &b, NULL));
        b = tss_basis_eigen(p->second);
        if (k == 0 && p->second > 0) ok(s->w, tss_basis_add(s->w, k, &b, NULL));
    }
    if (p->custom) p->custom(s->w, 0);
    ok(s->w, tss_world_prepare(s->w));
}

static void refresh_kinds(scene *s) {
    for (int i = 0; s->kinematic && i < tss_world_nodes(s->w); i++)
        s->kinematic[i] = tss_world_kinds(s->w)[i] != TSS_NODE_FREE;
}

// The judge of all iterates to come. Cells count only where the material forbids inversion.
static void watch(scene *s, const plan *p) {
    tss_surface f;
    check_mesh m;
    int n = tss_world_nodes(s->w), cells = 0;
    memset(&m, 0, sizeof m);
    ok(s->w, tss_world_surface(s->w, &f));
    s->body = (int *)calloc((size_t)n, sizeof(int));
    s->kinematic = (unsigned char *)calloc((size_t)n, 1);
    s->cells = (int *)malloc((size_t)n * 30 * 4 * sizeof(int));
    assert_true(s->body && s->kinematic && s->cells);
    for (int b = 0; b < tss_world_bodies(s->w); b++) {
        tss_body_info info;
        ok(s->w, tss_body_get(s->w, b, &info));
        for (int i = 0; i < info.nodes; i++) s->body[info.first_node + i] = b;
        if (info.cells == 0 || p->material != TSS_NEO_HOOKEAN) continue;
        memcpy(s->cells + cells * (p->dim + 1), tss_body_cells(s->w, b),
               (size_t)(info.cells * (p->dim + 1)) * sizeof(int));
        cells += info.cells;
    }
    refresh_kinds(s);
    m.dim = p->dim, m.nodes = n, m.rest = tss_world_rest(s->w), m.cells = s->cells,
    m.n_cells = cells;
    m.body = s->body, m.kinematic = s->kinematic, m.self_contact = 1;
    if (p->contact) {
        s->floor[p->dim + 1] = 1;
        m.halfspaces = s->floor, m.n_halfspaces = 1;
        m.triangles = f.triangle, m.n_triangles = f.triangles;
        if (p->dim == 2) m.edges = f.edge, m.n_edges = f.edges;
    }
    m.points = f.point, m.n_points = f.points;
    s->judge = check_begin(&m, tss_world_positions(s->w));
    assert_non_null(s->judge);
}

static void unwatch(scene *s) {
    char text[256];
    if (s->judge) {
        check_report r = check_end(s->judge);
        if (!r.ok) print_error("%s\n", check_describe(&r, text, sizeof text));
        assert_true(r.ok);
        assert_true(r.segments > 0);
    }
    s->judge = NULL;
}

static void drop(scene *s) {
    unwatch(s);
    tss_world_destroy(s->w);
    free(s->body), free(s->cells), free(s->kinematic);
}

static tss_step_info step(scene *s) {
    tss_step_info info;
    ok(s->w, tss_world_step(s->w, &info));
    if (info.status != TSS_STEP_CONVERGED)
        print_error("%s: %s\n", tss_status_text(info.status), info.message);
    assert_int_equal(info.status, TSS_STEP_CONVERGED);
    for (int k = 0; k < tss_world_nodes(s->w) * tss_world_dim(s->w); k++)
        assert_true(isfinite(tss_world_positions(s->w)[k]) &&
                    isfinite(tss_world_velocities(s->w)[k]));
    return info;
}

static double apart(const double *a, const double *b, int count) {
    double worst = 0;
    for (int k = 0; k < count; k++) worst = fmax(worst, fabs(a[k] - b[k]));
    return worst;
}

static int unknowns(const scene *s) { return tss_world_nodes(s->w) * tss_world_dim(s->w); }

static double *doubles(size_t count) {
    double *p = (double *)calloc(count ? count : 1, sizeof(double));
    assert_non_null(p);
    return p;
}

static void near(double a, double b, double tol) {
    if (!(fabs(a - b) <= tol)) print_error("%.17g is not within %.3g of %.17g\n", a, tol, b);
    assert_true(fabs(a - b) <= tol);
}

// ---- a spy on the direction finder --------------------------------------------------------------
// Takes the finder's place, lets it work, and compares what it left with dense algebra: the Hessian
// stencil by stencil, modes column by column through tss_basis_mode, Eq. (19) by Cholesky.

typedef struct spy {
    tss_subspace *s;
    void (*look)(struct spy *y, tss_world *w, const tss_iterate *it);
    void (*before)(struct spy *y, tss_world *w, const tss_iterate *it);
    int looks, crosses, some, coupled,
        moved;                         // iterates; with bodies in touch; partly enriched; with J
    double H, Q, X, J, d;              // largest relative deviations
    double tol;                        // allowed to d
    double *part_H, *part_g, *part_s;  // before the call: secants, gradients, steps by part
    int updates, skips;
} spy;

static spy *spying;

static tss_result spy_direction(void *user, tss_world *w, tss_iterate *it) {
    if (spying->before) spying->before(spying, w, it);
    tss_result r = tss__sub_direction(user, w, it);
    if (r == TSS_OK && it->handled && spying->look) spying->look(spying, w, it);
    return r;
}

static void spy_on(spy *y, scene *s) {
    y->s = tss_subspace_of(s->w);
    assert_non_null(y->s);
    s->w->finder.direction = spy_direction;
    spying = y;
}

// Dense Hessian of all energies at x, N × N over all nodes, projected stencil by stencil.
static double *dense_hessian(tss_world *w, const tss_iterate *it) {
    static double out[TSS_BATCH * 24 * 24];
    int dim = it->ctx->dim, N = it->ctx->nodes * dim;
    double *H = doubles((size_t)N * (size_t)N);
    for (int e = 0; e < tss_world_energies(w); e++) {
        tss_energy_view v;
        if (tss_energy_get(w, e, &v) != TSS_OK) continue;
        int A = v.def->arity, S = A * dim;
        for (int k = 0; k < v.list.count; k++) {
            tss_ids ids = {k, 1, NULL};
            v.def->hessian(v.def->user, it->ctx, it->x, ids, 1, out);
            for (int i = 0; i < S * S; i++) {
                int r = v.list.node[k * A + i / S / dim], c = v.list.node[k * A + i % S / dim];
                if (r < 0 || c < 0) continue;
                H[(size_t)(r * dim + i / S % dim) * (size_t)N + (size_t)(c * dim + i % S % dim)] +=
                    v.scale * out[i];
            }
        }
    }
    return H;
}

// Active mode j of modal body k as a field over all nodes; rows outside its modal nodes are 0.
static void dense_mode(const spy *y, tss_world *w, int k, int j, int mask, double *u) {
    tss_subspace *s = y->s;
    const tss__modal *m = tss__sub_modal(s, k);
    int d = s->dim, place = tss__sub_i(&m->map)[j], vector = place >= d * m->functions;
    int f = vector ? place - d * m->functions : place % m->functions,
        p = vector ? 0 : place / m->functions;
    memset(u, 0, (size_t)(s->n * d) * sizeof(double));
    w->finder.direction = tss__sub_direction;  // or tss_basis_mode finds no solver
    for (int b = 0; b < tss_world_bases(w); b++) {
        tss_basis_info info;
        if (tss_basis_get(w, b, &info) != TSS_OK || info.body != m->body) continue;
        if ((info.modes == info.functions) != vector) continue;
        if (f < info.functions) {
            ok(w, tss_basis_mode(w, b, vector ? f : f * d + p, u + m->first * d));
            break;
        }
        f -= info.functions;
    }
    w->finder.direction = spy_direction;
    for (int i = 0; i < s->n; i++)
        if (tss__sub_i(&s->body_of)[i] != k || (mask && tss__sub_u(&s->on)[i]))
            memset(u + i * d, 0, (size_t)d * sizeof(double));
}

// All active modes of all bodies as columns, N × Σa, column-major.
static double *dense_modes(const spy *y, tss_world *w, int mask) {
    int N = y->s->n * y->s->dim;
    double *U = doubles((size_t)N * y->s->modes);
    for (int k = 0; k < y->s->modal_count; k++)
        for (int j = 0; j < tss__sub_modal(y->s, k)->a; j++)
            dense_mode(y, w, k, j, mask, U + (tss__sub_modal(y->s, k)->at + (size_t)j) * (size_t)N);
    return U;
}

// C (a × b, column-major) = Pᵀ H Q.
static double *dense_sandwich(int N, const double *H, int a, const double *P, int b,
                              const double *Q) {
    double *HQ = doubles((size_t)N * (size_t)b), *C = doubles((size_t)a * (size_t)b);
    for (int j = 0; j < b; j++)
        for (int i = 0; i < N; i++) {
            double t = 0;
            for (int k = 0; k < N; k++)
                t += H[(size_t)i * (size_t)N + (size_t)k] * Q[(size_t)j * (size_t)N + (size_t)k];
            HQ[(size_t)j * (size_t)N + (size_t)i] = t;
        }
    for (int j = 0; j < b; j++)
        for (int i = 0; i < a; i++) {
            double t = 0;
            for (int k = 0; k < N; k++)
                t += P[(size_t)i * (size_t)N + (size_t)k] * HQ[(size_t)j * (size_t)N + (size_t)k];
            C[(size_t)j * (size_t)a + (size_t)i] = t;
        }
    free(HQ);
    return C;
}

// Cholesky A = L Lᵀ in place, lower, row i column j at i·n + j; 0: not positive definite.
static int dense_cholesky(int n, double *A) {
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) {
            double t = A[(size_t)i * (size_t)n + (size_t)j];
            for (int k = 0; k < j; k++)
                t -= A[(size_t)i * (size_t)n + (size_t)k] * A[(size_t)j * (size_t)n + (size_t)k];
            if (i == j && !(t > 0)) return 0;
            A[(size_t)i * (size_t)n + (size_t)j] =
                i == j ? sqrt(t) : t / A[(size_t)j * (size_t)n + (size_t)j];
        }
    return 1;
}

static void dense_solve(int n, const double *L, double *x) {
    for (int i = 0; i < n; i++) {
        for (int k = 0; k < i; k++) x[i] -= L[(size_t)i * (size_t)n + (size_t)k] * x[k];
        x[i] /= L[(size_t)i * (size_t)n + (size_t)i];
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++) x[i] -= L[(size_t)k * (size_t)n + (size_t)i] * x[k];
        x[i] /= L[(size_t)i * (size_t)n + (size_t)i];
    }
}

static double largest(const double *a, size_t count) {
    double t = 0;
    for (size_t k = 0; k < count; k++) t = fmax(t, fabs(a[k]));
    return t;
}

// Deviation of the solver's modal matrix from UᵀHU, relative to its largest entry.
static double compare_H(const spy *y, int mask, const double *H, const double *U) {
    const tss_subspace *s = y->s;
    int N = s->n * s->dim, a = (int)s->modes;
    (void)mask;
    double *D = dense_sandwich(N, H, a, U, a, U), worst = 0,
           size = largest(D, (size_t)a * (size_t)a);
    uint8_t *seen = (uint8_t *)calloc((size_t)a * (size_t)a + 1, 1);
    assert_non_null(seen);
    for (int k = -s->crosses; k < s->modal_count; k++) {
        const tss__sub_cross *x =
            k < 0 ? (const tss__sub_cross *)s->cross.p + (k + s->crosses) : NULL;
        const tss__modal *b = tss__sub_modal(s, x ? x->b : k), *c = tss__sub_modal(s, x ? x->c : k);
        const double *V = x ? tss__sub_f(&s->cross_val) + x->at : tss__sub_f(&s->H) + b->hat;
        for (int j = 0; j < b->a; j++)
            for (int i = 0; i < c->a; i++) {
                size_t at = (b->at + (size_t)j) * (size_t)a + c->at + (size_t)i;
                worst = fmax(worst, fabs(V[j * c->a + i] - D[at]));
                seen[at] = seen[(c->at + (size_t)i) * (size_t)a + b->at + (size_t)j] = 1;
            }
    }
    for (size_t k = 0; k < (size_t)a * (size_t)a; k++)  // pairs the solver left out
        if (!seen[k]) worst = fmax(worst, fabs(D[k]));
    free(D), free(seen);
    return size > 0 ? worst / size : worst;
}

// J row by row: Jᵀ of unit vectors.
static void rows_of_J(tss_subspace *s, double *J) {
    int nx = s->xrows * s->dim;
    double *e = doubles((size_t)nx);
    for (int i = 0; i < nx; i++) {
        e[i] = 1;
        assert_int_equal(tss__sub_Jt(s, e, J + (size_t)i * s->modes), TSS_OK);
        e[i] = 0;
    }
    free(e);
}

// H_x and J against the rows of enriched nodes.
static void compare_rows(spy *y, const double *H, const double *B) {
    const tss_subspace *s = y->s;
    int d = s->dim, N = s->n * d, a = (int)s->modes;
    const int *node = tss__sub_i(&s->xnode);
    double size = 0, worst = 0, worst_J = 0, size_J = 0;
    double *J = doubles((size_t)(s->xrows * d) * (size_t)a);
    for (int i = 0; i < s->xrows * d; i++)
        for (int j = 0; j < s->xrows * d; j++) {
            double v = H[(size_t)(node[i / d] * d + i % d) * (size_t)N +
                         (size_t)(node[j / d] * d + j % d)],
                   got = 0;
            for (int part = 0; part < 2; part++) {
                const tss_bcsr *M = part ? &s->Cx : &s->Ax;
                for (int64_t k = M->row[i / d]; k < M->row[i / d + 1]; k++)
                    if (M->col[k] == j / d) got += M->val[k * d * d + (i % d) * d + j % d];
            }
            size = fmax(size, fabs(v)), worst = fmax(worst, fabs(got - v));
        }
    rows_of_J(y->s, J);
    for (int i = 0; i < s->xrows * d; i++)
        for (int j = 0; j < a; j++) {
            const double *row = H + (size_t)(node[i / d] * d + i % d) * (size_t)N;
            double v = 0;
            for (int k = 0; k < N; k++) v += row[k] * B[(size_t)j * (size_t)N + (size_t)k];
            size_J = fmax(size_J, fabs(v)),
            worst_J = fmax(worst_J, fabs(J[(size_t)i * (size_t)a + (size_t)j] - v));
        }
    free(J);
    if (size > 0) y->X = fmax(y->X, worst / size);
    if (size_J > 0) y->J = fmax(y->J, worst_J / size_J), y->coupled++;
}

// Coordinates of Eq. (19): the columns of B_a that the solver kept (which it drops is its choice),
// then the free axes of enriched nodes. N × width columns.
static double *dense_coordinates(const spy *y, const tss_unknowns *u, const double *B, int *width) {
    const tss_subspace *s = y->s;
    int d = s->dim, N = s->n * d, at = 0;
    double *P = doubles((size_t)N * ((size_t)N + s->modes));
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        for (int c = 0; c < m->thin_rank; c++, at++)
            memcpy(P + (size_t)at * (size_t)N,
                   B + (m->at + (size_t)tss__sub_i(&m->thin)[c]) * (size_t)N,
                   (size_t)N * sizeof(double));
    }
    for (int r = 0; r < u->rows; r++)
        for (int c = 0; tss__sub_u(&s->on)[u->node[r]] && c < d; c++)
            if (!u->fixed || !u->fixed[r * d + c])
                P[(size_t)at++ * (size_t)N + (size_t)(u->node[r] * d + c)] = 1;
    *width = at;
    return P;
}

// The direction against Eq. (19) in double; its matrix must be positive definite.
static void compare_direction(spy *y, tss_world *w, const tss_iterate *it, const double *H,
                              const double *B) {
    tss_unknowns u;
    tss_world_unknowns(w, &u);
    int d = y->s->dim, N = y->s->n * d, width;
    double *P = dense_coordinates(y, &u, B, &width), *K = dense_sandwich(N, H, width, P, width, P);
    double *r = doubles((size_t)N), *x = doubles((size_t)width), *dir = doubles((size_t)N),
           worst = 0, size = 0;
    for (int i = 0; i < N; i++) {
        r[i] = u.row[i / d] < 0 ? 0 : -it->g[i];
        for (int k = 0; it->moves && u.row[i / d] >= 0 && k < N; k++)
            if (u.row[k / d] < 0) r[i] -= H[(size_t)i * (size_t)N + (size_t)k] * it->d[k];
        if (u.row[i / d] >= 0 && u.fixed && u.fixed[u.row[i / d] * d + i % d]) r[i] = 0;
    }
    for (int j = 0; j < width; j++)
        for (int i = 0; i < N; i++) x[j] += P[(size_t)j * (size_t)N + (size_t)i] * r[i];
    assert_true(dense_cholesky(width, K));
    dense_solve(width, K, x);
    for (int j = 0; j < width; j++)
        for (int i = 0; i < N; i++) dir[i] += P[(size_t)j * (size_t)N + (size_t)i] * x[j];
    for (int i = 0; i < N; i++)
        if (u.row[i / d] >= 0)
            worst = fmax(worst, fabs(dir[i] - it->d[i])), size = fmax(size, fabs(dir[i]));
    if (size > 1e-12) y->d = fmax(y->d, worst / size);
    free(P), free(K), free(r), free(x), free(dir);
}

// Everything Eq. (18) and (19) are made of. For iterates whose secants are exact.
static void look_at_system(spy *y, tss_world *w, const tss_iterate *it) {
    tss_unknowns u;
    tss_world_unknowns(w, &u);
    ok(w, tss_world_list_along(w, it->x, NULL, 0));  // the oracle left longer ones
    double *H = dense_hessian(w, it), *U = dense_modes(y, w, 0), *B = dense_modes(y, w, 1);
    y->looks++, y->crosses += y->s->crosses > 0;
    y->some += y->s->xrows > 0 && y->s->xrows < u.rows, y->moved += it->moves;
    y->Q = fmax(y->Q, compare_H(y, 1, H, B));
    if (y->s->xrows > 0) compare_rows(y, H, B);
    compare_direction(y, w, it, H, B);
    ok(w, tss__sub_build_H(y->s, &u, it->ctx, 0));
    y->H = fmax(y->H, compare_H(y, 0, H, U));
    free(H), free(U), free(B);
}

static void report(const char *name, const spy *y) {
    print_message(
        "    %-28s %3d iterates, %d in touch, %d partly enriched, %d coupled: H_a %.1e H_q %.1e "
        "H_x %.1e "
        "J %.1e d %.1e\n",
        name, y->looks, y->crosses, y->some, y->coupled, y->H, y->Q, y->X, y->J, y->d);
}

static void twist(tss_world *w, const plan *p, int k) {
    tss_body_info info;
    ok(w, tss_body_get(w, 0, &info));
    for (int i = info.first_node; i < info.first_node + info.nodes; i++) {
        const double *X = tss_world_rest(w) + i * p->dim;
        double a = 0.1 * (k + 1), y = X[1] - 0.1, z = p->dim == 3 ? X[2] : 0, t[3];
        if (X[0] < 0.0999) continue;
        t[0] = X[0] + 0.002 * (k + 1), t[1] = 0.1015 + cos(a) * (y - 0.0015) - sin(a) * z;
        t[2] = sin(a) * (y - 0.0015) + cos(a) * z;
        if (p->dim == 2) t[1] = X[1] + 0.004 * (k + 1);
        ok(w, tss_node_target(w, i, t));
    }
}

static void spy_scene(const plan *p, tss_schur schur, double tol, spy *y) {
    tss_subspace_def d = tss_subspace_def_default();
    scene s;
    memset(y, 0, sizeof *y);
    d.secant = TSS_SECANT_EXACT, d.schur = schur, d.pcg_tol = 1e-7, d.error_nodes = 0.2,
    d.partitions = 12, d.downdate = 1;
    d.keep = 1;
    make(&s, p, &d);
    y->look = look_at_system;
    spy_on(y, &s);
    for (int k = 0; k < p->steps; k++) {
        if (p->change) p->change(s.w, p, k);
        step(&s);
    }
    report(p->name, y);
    assert_true(y->looks > 0 && (y->some || y->H < 1e-10));
    assert_true(y->Q < 1e-10 && y->X < 1e-12 && y->J < 1e-10 && y->d < tol);
    drop(&s);
}

// H_a, H_q, J, H_x and the direction, with contact between two bodies, functions and columns in one
// body, a body without modes, nodes scripted and nodes pinned along some axes.
static void test_system(void **state) {
    static const plan plans[] = {
        {.name = "skinning, free",
         .dim = 3,
         .n = 3,
         .bodies = 1,
         .speed = 1,
         .E = 1e4,
         .upper = -1,
         .lower = TSS_BASIS_SKINNING,
         .count = 5,
         .steps = 3},
        {.name = "two in touch, friction",
         .dim = 3,
         .n = 2,
         .bodies = 2,
         .contact = 1,
         .mu = 0.4,
         .speed = 2,
         .E = 3e4,
         .lower = TSS_BASIS_SKINNING,
         .upper = TSS_BASIS_AFFINE,
         .count = 3,
         .steps = 5},
        {.name = "functions and columns",
         .dim = 3,
         .n = 2,
         .bodies = 2,
         .contact = 1,
         .speed = 2,
         .E = 3e4,
         .lower = TSS_BASIS_AFFINE,
         .second = 9,
         .upper = -1,
         .steps = 4},
        {.name = "symmetry plane, 2D",
         .dim = 2,
         .n = 5,
         .bodies = 2,
         .contact = 1,
         .mu = 0.2,
         .speed = 2,
         .E = 3e4,
         .lower = TSS_BASIS_SKINNING,
         .upper = TSS_BASIS_QUADRATIC,
         .count = 4,
         .pins = 1,
         .steps = 5},
        {.name = "twisting end",
         .dim = 3,
         .n = 3,
         .bodies = 1,
         .E = 1e5,
         .lower = TSS_BASIS_SKINNING,
         .count = 4,
         .upper = -1,
         .pins = 7,
         .steps = 3,
         .change = twist},
        {.name = "quasi-static",
         .dim = 2,
         .n = 4,
         .bodies = 1,
         .E = 1e4,
         .lower = TSS_BASIS_QUADRATIC,
         .upper = -1,
         .integrator = TSS_QUASISTATIC,
         .pins = 3,
         .steps = 2,
         .change = twist},
    };
    int crosses = 0, some = 0, coupled = 0, moved = 0;
    (void)state;
    for (size_t k = 0; k < sizeof plans / sizeof *plans; k++)
        for (int direct = 0; direct < 2; direct++) {
            spy y;
            spy_scene(plans + k, direct ? TSS_SCHUR_DIRECT : TSS_SCHUR_PCG, direct ? 1e-9 : 1e-4,
                      &y);
            crosses += y.crosses, some += y.some, coupled += y.coupled, moved += y.moved;
        }
    assert_true(crosses > 4 && some > 10 && coupled > 10 && moved > 3);
}

// H_a where some nodes are enriched: their inertia is in A and must not be in the Gram matrix too.
static void test_own_matrix(void **state) {
    const plan p = {.name = "own direction's matrix",
                    .dim = 3,
                    .n = 2,
                    .bodies = 2,
                    .contact = 1,
                    .speed = 2,
                    .E = 3e4,
                    .lower = TSS_BASIS_SKINNING,
                    .upper = TSS_BASIS_AFFINE,
                    .count = 3,
                    .steps = 4};
    spy y;
    (void)state;
    spy_scene(&p, TSS_SCHUR_DIRECT, 1e-9, &y);
    assert_true(y.some > 0 && y.H < 1e-10);
}

// ---- errors of blocks ----------------------------------------------------------------------------

// From moments (all blocks of a factored basis at once) and from the rows of Φ, one by one.
static void look_at_blocks(spy *y, tss_world *w, const tss_iterate *it) {
    tss_subspace *s = y->s;
    double *U = doubles(200000);
    (void)w;
    s->query = 1;  // what was measured, not what persists over two iterates
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        for (int j = 0; j < s->basis_count; j++)
            if (tss__sub_base(s, j)->body == k) ok(w, tss__sub_factored_errors(s, it, k, j));
        for (int j = 0; j < m->blocks; j++) {
            tss__sub_block q = tss__sub_blocks(m)[j];
            int f;
            if (!tss__sub_candidate(m, &q) || !tss__sub_is_factored(s, &q)) continue;
            assert_true(tss__sub_block_room(s, k, &q, &f) + (size_t)(3 * f) < 200000);
            tss__sub_block_error(s, it, k, &q, U);
            // in free flight both are rounding; the thresholds are tenths
            y->H = fmax(y->H, fabs(q.error - tss__sub_blocks(m)[j].error) / fmax(q.error, 1e-4));
            y->some += q.error > 1e-3;
        }
    }
    s->query = 0;
    free(U);
}

static void test_block_errors(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int literal = 0; literal < 2; literal++) {
            const plan p = {.dim = dim,
                            .n = 4,
                            .bodies = 2,
                            .contact = 1,
                            .speed = 1,
                            .E = 3e4,
                            .count = 12,
                            .lower = TSS_BASIS_SKINNING,
                            .upper = TSS_BASIS_SKINNING};
            tss_subspace_def d = tss_subspace_def_default();
            scene s;
            spy y;
            memset(&y, 0, sizeof y);
            d.partitions = 12, d.oracle = literal ? TSS_ORACLE_LITERAL : TSS_ORACLE_RING, d.error_modes = 1e3;
            make(&s, &p, &d);
            y.look = look_at_blocks;
            spy_on(&y, &s);
            for (int k = 0; k < 6; k++) step(&s);
            print_message("    %dD%s: %d blocks, deviation %.1e\n", dim, literal ? " literal" : "", y.some, y.H);
            assert_true(y.some > 10 && y.H < 1e-10);
            drop(&s);
        }
}

// ---- secants ----------------------------------------------------------------------------------

// The solver's own coupled matrix (secants and all) in its coordinates; must be positive definite.
static void look_at_definite(spy *y, tss_world *w, const tss_iterate *it) {
    const tss_subspace *s = y->s;
    int d = s->dim, a = (int)s->modes, nx = s->xrows * d, N = a + nx, width = 0;
    double *H = doubles((size_t)N * (size_t)N), *P = doubles((size_t)N * (size_t)N);
    (void)w, (void)it;
    for (int k = -s->crosses; k < s->modal_count; k++) {
        const tss__sub_cross *x =
            k < 0 ? (const tss__sub_cross *)s->cross.p + (k + s->crosses) : NULL;
        const tss__modal *b = tss__sub_modal(s, x ? x->b : k), *c = tss__sub_modal(s, x ? x->c : k);
        const double *V = x ? tss__sub_f(&s->cross_val) + x->at : tss__sub_f(&s->H) + b->hat;
        for (int j = 0; j < b->a * c->a; j++) {
            size_t r = c->at + (size_t)(j % c->a), q = b->at + (size_t)(j / c->a);
            H[r * (size_t)N + q] = H[q * (size_t)N + r] = V[j];
        }
    }
    for (int part = 0; part < 2; part++)
        for (int i = 0; i < s->xrows; i++) {
            const tss_bcsr *M = part ? &s->Cx : &s->Ax;
            for (int64_t k = M->row[i]; k < M->row[i + 1]; k++)
                for (int q = 0; q < d * d; q++)
                    H[(size_t)(a + i * d + q / d) * (size_t)N +
                      (size_t)(a + M->col[k] * d + q % d)] += M->val[k * d * d + q];
        }
    double *J = doubles((size_t)nx * (size_t)a);
    if (nx > 0) rows_of_J(y->s, J);
    for (int i = 0; i < nx * a; i++) {
        size_t row = (size_t)(a + i / a), col = (size_t)(i % a);
        H[row * (size_t)N + col] = H[col * (size_t)N + row] = J[i];
    }
    free(J);
    for (int k = 0; k < s->modal_count; k++) {
        const tss__modal *m = tss__sub_modal(s, k);
        for (int c = 0; c < m->thin_rank; c++)
            P[(size_t)width++ * (size_t)N + m->at + (size_t)tss__sub_i(&m->thin)[c]] = 1;
    }
    for (int i = 0; i < nx; i++)
        if (!s->masked || !tss__sub_u(&s->xmask)[i])
            P[(size_t)width++ * (size_t)N + (size_t)(a + i)] = 1;
    double *K = dense_sandwich(N, H, width, P, width, P);
    assert_true(dense_cholesky(width, K));
    y->looks++, y->some += nx > 0;
    free(H), free(P), free(K);
}

static void remember_secants(spy *y, tss_world *w, const tss_iterate *it) {
    const tss_subspace *s = y->s;
    (void)w, (void)it;
    free(y->part_H), free(y->part_g), free(y->part_s);
    y->part_H = y->part_g = y->part_s = NULL;
    if (!s->built || !(s->moved > 0)) return;
    y->part_H = doubles(s->secant.bytes / 8), y->part_g = doubles(s->secant_g.bytes / 8);
    memcpy(y->part_H, s->secant.p, s->secant.bytes / 8 * 8);
    memcpy(y->part_g, s->secant_g.p, s->secant_g.bytes / 8 * 8);
    y->part_s = doubles(s->modes);
    for (int k = 0; k < s->modal_count; k++)
        memcpy(y->part_s + tss__sub_modal(s, k)->at, tss__sub_modal(s, k)->s.p,
               (size_t)tss__sub_modal(s, k)->a * 8);
}

// H s = y where a part was updated, H untouched where it was not; semi-definite. The solver keeps
// the lower triangle.
static void look_at_secants(spy *y, tss_world *w, const tss_iterate *it) {
    const tss_subspace *s = y->s;
    look_at_definite(y, w, it);
    int updated = y->part_H && s->added == 0 && !(s->moved > 0);  // short steps wait for the next
    for (int p = 0; updated && p < s->groups; p++) {
        const tss__sub_part *t = tss__sub_parts(s, p);
        size_t a = (size_t)tss__sub_modal(s, t->modal)->a;
        const double *H = tss__sub_f(&s->secant) + t->h, *g1 = tss__sub_f(&s->secant_g) + t->g,
                     *g0 = y->part_g + t->g;
        const double *q = y->part_s + tss__sub_modal(s, t->modal)->at;
        double *L = doubles(a * a), trace = 0, worst = 0, size = 0;
        if (t->valid && t->nodes > 0) {
            for (size_t i = 0; i < a; i++) {
                double Hs = 0;
                for (size_t j = 0; j < a; j++) Hs += (i > j ? H[j * a + i] : H[i * a + j]) * q[j];
                worst = fmax(worst, fabs(Hs - (g1[i] - g0[i]))), size = fmax(size, fabs(Hs));
                trace += H[i * a + i];
            }
            // The update sums terms of the size of g: what is left of their difference is rounding.
            if (t->skipped)
                assert_memory_equal(H, y->part_H + t->h, a * a * sizeof(double)), y->skips++;
            else
                y->d = fmax(y->d, worst / fmax(size, 1e-6 * largest(g0, a))), y->updates++;
            for (size_t i = 0; i < a; i++)
                for (size_t j = 0; j <= i; j++)
                    L[i * a + j] = H[j * a + i] + (i == j ? 1e-12 * trace : 0);
            if (trace == 0)
                assert_true(largest(H, a * a) == 0);  // every stencil has an enriched node
            else
                assert_true(dense_cholesky((int)a, L));
        }
        free(L);
    }
}

// BFGS in a fall onto a plane: the secant equation, definiteness of every subdomain and
// of the whole coupled matrix in every iterate.
static void test_secants(void **state) {
    const plan p = {.dim = 3,
                    .n = 3,
                    .bodies = 2,
                    .contact = 1,
                    .speed = 2,
                    .E = 1e5,
                    .mu = 0.3,
                    .count = 4,
                    .lower = TSS_BASIS_SKINNING,
                    .upper = TSS_BASIS_AFFINE,
                    .steps = 5};
    tss_subspace_def d = tss_subspace_def_default();
    scene s;
    spy y;
    (void)state;
    memset(&y, 0, sizeof y);
    d.partitions = 8;
    make(&s, &p, &d);
    y.look = look_at_secants, y.before = remember_secants;
    spy_on(&y, &s);
    for (int k = 0; k < p.steps; k++) step(&s);
    print_message("    %d updates, %d skipped, %d iterates (%d partly enriched), H s = y to %.1e\n",
                  y.updates, y.skips, y.looks, y.some, y.d);
    assert_true(y.updates > 20 && y.some > 0 && y.d < 1e-8);
    free(y.part_H), free(y.part_g), free(y.part_s);
    drop(&s);
}

// Σ_ℓ U_ℓᵀ∇Ψ_ℓ = Uᵀ∇Ψ, the right-hand side from a plain sum over all elastic stencils.
static void look_at_gradients(spy *y, tss_world *w, const tss_iterate *it) {
    static double out[24];
    const tss_subspace *s = y->s;
    int d = s->dim, N = s->n * d;
    if (s->moved > 0) return;  // the gradients kept are those of an iterate close by
    double *g = doubles((size_t)N), *sum = doubles(s->modes), *U = dense_modes(y, w, 0);
    for (int e = 0; e < tss_world_energies(w); e++) {
        tss_energy_view v;
        if (tss_energy_get(w, e, &v) != TSS_OK || !(v.def->flags & TSS_ENERGY_SECANT_OK)) continue;
        for (int k = 0; k < v.list.count; k++) {
            tss_ids ids = {k, 1, NULL};
            v.def->gradient(v.def->user, it->ctx, it->x, ids, out);
            for (int i = 0; i < v.def->arity * d; i++)
                g[v.list.node[k * v.def->arity + i / d] * d + i % d] += v.scale * out[i];
        }
    }
    for (int p = 0; p < s->groups; p++) {
        const tss__sub_part *t = tss__sub_parts(s, p);
        assert_true(t->valid);
        for (int i = 0; i < tss__sub_modal(s, t->modal)->a; i++)
            sum[tss__sub_modal(s, t->modal)->at + (size_t)i] +=
                tss__sub_f(&s->secant_g)[t->g + (size_t)i];
    }
    double size = largest(sum, s->modes);
    for (size_t j = 0; j < s->modes; j++) {
        for (int i = 0; i < N; i++) sum[j] -= U[j * (size_t)N + (size_t)i] * g[i];
        y->d = fmax(y->d, fabs(sum[j]) / fmax(size, 1e-9));
    }
    y->looks++;
    free(g), free(sum), free(U);
}

static void test_modal_gradients(void **state) {
    const plan p = {.dim = 3,
                    .n = 4,
                    .bodies = 2,
                    .contact = 1,
                    .speed = 2,
                    .E = 1e5,
                    .count = 4,
                    .second = 8,
                    .lower = TSS_BASIS_SKINNING,
                    .upper = TSS_BASIS_QUADRATIC,
                    .steps = 4};
    tss_subspace_def d = tss_subspace_def_default();
    scene s;
    spy y;
    (void)state;
    memset(&y, 0, sizeof y);
    d.mode = TSS_MODE_SUBSPACE, d.partitions = 8;
    make(&s, &p, &d);
    y.look = look_at_gradients;
    spy_on(&y, &s);
    for (int k = 0; k < p.steps; k++) assert_int_equal(step(&s).enriched_nodes, 0);
    print_message("    %d iterates, largest deviation %.1e\n", y.looks, y.d);
    assert_true(y.looks > 6 && y.d < 1e-11);
    drop(&s);
}

// Negative curvature, none at all and NaN leave H as it is; a healthy pair does not.
static void test_skip_rule(void **state) {
    const plan p = {.dim = 3,
                    .n = 2,
                    .bodies = 1,
                    .speed = 1,
                    .upper = -1,
                    .lower = TSS_BASIS_AFFINE,
                    .steps = 1};
    tss_subspace_def d = tss_subspace_def_default();
    scene s;
    (void)state;
    d.mode = TSS_MODE_SUBSPACE;
    make(&s, &p, &d);
    step(&s);
    tss_subspace *sub = tss_subspace_of(s.w);
    tss__sub_part *t = tss__sub_parts(sub, 0);
    const tss__modal *m = tss__sub_modal(sub, 0);
    const double curvature[4] = {-1, 0, NAN, 1};
    double *H = tss__sub_f(&sub->secant) + t->h, *g0 = tss__sub_f(&sub->secant_g) + t->g,
           *g1 = g0 + sub->modal_g;
    double work[256], before[144];
    assert_int_equal(m->a, 12);
    for (int k = 0; k < 4; k++) {
        tss__sub_run run;
        memset(&run, 0, sizeof run);
        run.s = sub, run.work = work, run.each = 64;
        t->valid = t->fresh = 1;
        memset(H, 0, 144 * sizeof(double));
        for (int i = 0; i < 12; i++)
            H[13 * i] = 2 + i, tss__sub_f(&m->s)[i] = i == 5, g0[i] = 7,
                   g1[i] = 7 + (i == 5) * curvature[k];
        memcpy(before, H, sizeof before);
        tss__sub_bfgs_task(0, 0, &run);
        assert_int_equal(t->skipped, k < 3);
        assert_true((memcmp(before, H, sizeof before) == 0) == (k < 3));
        if (k == 3) near(H[13 * 5], 1, 1e-14);
    }
    drop(&s);
}

// Where nodes have hardly moved H_x is that of an iterate before, elsewhere it is exact at x.
static int lagged;
static double lag_X, exact_X;

static void look_at_lag(spy *y, tss_world *w, const tss_iterate *it) {
    y->X = 0;
    look_at_system(y, w, it);
    if (y->s->drift > 0) lagged++, lag_X = fmax(lag_X, y->X);
    else exact_X = fmax(exact_X, y->X);
    assert_true(y->s->drift <= TSS__SUB_LAG * it->tol);
}

static void test_lag(void **state) {
    static const plan p = {.dim = 3, .n = 4, .bodies = 2, .contact = 1, .speed = 1.5, .E = 1e5, .h = 0.005, .count = 4,
                           .lower = TSS_BASIS_SKINNING, .upper = TSS_BASIS_AFFINE, .kappa = 3e8, .tol = 2e-3, .steps = 8};
    tss_subspace_def d = tss_subspace_def_default();
    const tss_secant kinds[] = {TSS_SECANT_FROZEN, TSS_SECANT_BFGS, TSS_SECANT_EXACT};
    (void)state;
    d.error_nodes = 0.2, d.partitions = 12;
    for (int k = 0; k < 3; k++) {
        spy y;
        scene s;
        memset(&y, 0, sizeof y);
        lagged = 0, lag_X = exact_X = 0, d.secant = kinds[k];
        make(&s, &p, &d);
        watch(&s, &p);
        y.look = look_at_lag;
        spy_on(&y, &s);
        for (int i = 0; i < p.steps; i++) step(&s);
        print_message("    %d of %d iterates lag, H_x within %.1e; elsewhere %.1e\n", lagged, y.looks, lag_X, exact_X);
        assert_true(y.some > 0 && exact_X < 1e-12);
        assert_true(kinds[k] == TSS_SECANT_EXACT ? lagged == 0 : lagged > 0 && lag_X > 0 && lag_X < 0.1);
        drop(&s);
    }
}

// ---- against the full space -------------------------------------------------------------------

// Thresholds at 0 against the world's own Newton method, step by step from the same state; the yard
// stick is how far full-space solves at ε and at ε/100 are apart. Fixed barrier stiffness.
static void test_full_limit(void **state) {
    const plan p = {.dim = 3,
                    .n = 4,
                    .bodies = 2,
                    .contact = 1,
                    .speed = 0.3,
                    .E = 1e5,
                    .mu = 0.3,
                    .count = 4,
                    .lower = TSS_BASIS_SKINNING,
                    .upper = TSS_BASIS_AFFINE,
                    .kappa = 3e8,
                    .tol = 1e-3,
                    .steps = 8};
    plan fine = p;
    tss_subspace_def zero = tss_subspace_def_default(), full = zero;
    scene a, b, c;
    double worst = 0, moved = 0;
    int contacts = 0;
    (void)state;
    zero.error_nodes = zero.error_modes = 0, full.mode = TSS_MODE_FULL, fine.tol = p.tol / 100;
    make(&a, &p, &zero), make(&b, &p, &full), make(&c, &fine, &full);
    for (int k = 0; k < p.steps; k++) {
        ok(a.w, tss_world_copy_state(a.w, b.w));
        ok(c.w, tss_world_copy_state(c.w, b.w));
        ok(a.w, tss_world_set_tol(a.w, p.tol)), ok(c.w, tss_world_set_tol(c.w, fine.tol));
        tss_step_info ia = step(&a), ib = step(&b);
        step(&c);
        int N = unknowns(&a);
        double da = apart(tss_world_positions(a.w), tss_world_positions(b.w), N);
        double db = apart(tss_world_positions(b.w), tss_world_positions(c.w), N);
        if (ia.contacts != ib.contacts)
            print_message("    step %d: %d and %d contacts\n", k, ia.contacts, ib.contacts);
        // Both Newton methods stop by ‖d‖ <= ε h; quadratic convergence may leave db at rounding.
        if (da > 2 * db)
            print_message(
                "    step %d: %.2e m, full-space tolerances %.2e m apart, %d of %d enriched\n", k,
                da, db, ia.enriched_nodes, ia.nodes);
        worst = fmax(worst, da / fmax(db, 0.01 * p.tol * 0.01)), contacts += ib.contacts;
        moved = fmax(moved, da);
    }
    print_message("    at most %.2f of the distance between two tolerances, %.1e m, %d contacts\n",
                  worst, moved, contacts);
    assert_true(contacts > 50 && worst <= 2);
    drop(&a), drop(&b), drop(&c);
}

// Positions are the state: bases and solver may change between steps, no bit of x and v does.
static void test_state_is_x(void **state) {
    const plan p = {.dim = 3,
                    .n = 4,
                    .bodies = 2,
                    .contact = 1,
                    .speed = 2,
                    .E = 3e4,
                    .mu = 0.3,
                    .count = 4,
                    .lower = TSS_BASIS_SKINNING,
                    .upper = -1,
                    .steps = 4};
    tss_subspace_def d = tss_subspace_def_default();
    tss_basis_def more = tss_basis_quadratic(), eigen = tss_basis_eigen(8);
    tss_basis id[2];
    scene s;
    (void)state;
    make(&s, &p, &d);
    for (int k = 0; k < 8; k++) {
        tss_subspace *sub = tss_subspace_of(s.w);
        step(&s);
        uint64_t hash = tss_world_hash(s.w);
        double *x = doubles((size_t)unknowns(&s));
        memcpy(x, tss_world_positions(s.w), (size_t)unknowns(&s) * sizeof(double));
        if (k == 0) ok(s.w, tss_basis_add(s.w, 1, &more, id));
        if (k == 1) ok(s.w, tss_basis_add(s.w, 0, &eigen, id + 1));
        if (k == 2) ok(s.w, tss_basis_remove(s.w, 0));
        if (k == 3) d.mode = TSS_MODE_SUBSPACE, ok(s.w, tss_subspace_set(sub, &d));
        if (k == 4) d.mode = TSS_MODE_FULL, ok(s.w, tss_subspace_set(sub, &d));
        if (k == 5)
            d.mode = TSS_MODE_ADAPTIVE, d.error_nodes = 0.01, ok(s.w, tss_subspace_set(sub, &d));
        if (k == 6) ok(s.w, tss_basis_remove(s.w, id[0])), ok(s.w, tss_basis_remove(s.w, id[1]));
        ok(s.w, tss_subspace_query(s.w));
        assert_true(hash == tss_world_hash(s.w));
        assert_memory_equal(x, tss_world_positions(s.w), (size_t)unknowns(&s) * sizeof(double));
        free(x);
    }
    tss_step_info info = step(&s);  // no basis is left: every node is an unknown
    assert_int_equal(info.enriched_nodes, info.nodes);
    drop(&s);
}

// ---- threads ----------------------------------------------------------------------------------

enum { THREADS = 4 };

typedef struct pool {
    pthread_t thread[THREADS];
    pthread_mutex_t lock;
    pthread_cond_t wake, done;
    tss_task *task;
    void *arg;
    int blocks, next, busy, stop, threads;
    uint64_t round;
} pool;

typedef struct helper {
    pool *p;
    int worker;
} helper;

// Takes blocks until none are left; called with the lock held.
static void drain(pool *p, int worker) {
    while (p->next < p->blocks) {
        int b = p->next++;
        pthread_mutex_unlock(&p->lock);
        p->task(b, worker, p->arg);
        pthread_mutex_lock(&p->lock);
    }
}

static void *work(void *arg) {
    helper *h = (helper *)arg;
    pool *p = h->p;
    uint64_t seen = 0;
    pthread_mutex_lock(&p->lock);
    for (;;) {
        while (p->round == seen && !p->stop) pthread_cond_wait(&p->wake, &p->lock);
        if (p->stop) break;
        seen = p->round;
        p->busy++;
        drain(p, h->worker);
        if (--p->busy == 0) pthread_cond_signal(&p->done);
    }
    pthread_mutex_unlock(&p->lock);
    return NULL;
}

static void pool_run(int blocks, tss_task *task, void *arg, void *ctx) {
    pool *p = (pool *)ctx;
    pthread_mutex_lock(&p->lock);
    p->task = task, p->arg = arg, p->blocks = blocks, p->next = 0, p->round++;
    pthread_cond_broadcast(&p->wake);
    drain(p, 0);
    while (p->busy > 0) pthread_cond_wait(&p->done, &p->lock);
    p->blocks = p->next = 0;
    pthread_mutex_unlock(&p->lock);
}

static void pool_open(pool *p, helper *h, int threads) {
    memset(p, 0, sizeof *p);
    p->threads = threads;
    pthread_mutex_init(&p->lock, NULL);
    pthread_cond_init(&p->wake, NULL), pthread_cond_init(&p->done, NULL);
    for (int k = 1; k < threads; k++) {
        h[k].p = p, h[k].worker = k;
        assert_int_equal(pthread_create(&p->thread[k], NULL, work, h + k), 0);
    }
}

static void pool_close(pool *p) {
    pthread_mutex_lock(&p->lock);
    p->stop = 1;
    pthread_cond_broadcast(&p->wake);
    pthread_mutex_unlock(&p->lock);
    for (int k = 1; k < p->threads; k++) pthread_join(p->thread[k], NULL);
    pthread_cond_destroy(&p->wake), pthread_cond_destroy(&p->done), pthread_mutex_destroy(&p->lock);
}

typedef struct trail {  // what a run decided, step by step
    uint64_t hash;
    int grown, shrunk, modes_grown, enriched;
    double decisions;
} trail;

static void follow(trail *t, const tss_step_info *i, int *nodes, int *modes) {
    t->grown += i->enriched_nodes > *nodes, t->shrunk += i->enriched_nodes < *nodes;
    t->modes_grown += i->active_modes > *modes,
        t->enriched += i->enriched_nodes > 0 && i->enriched_nodes < i->nodes;
    *nodes = i->enriched_nodes, *modes = i->active_modes;
    t->decisions = t->decisions * 1.25 + i->enriched_nodes + 0.5 * i->active_modes + i->newton;
}

// A scene in which nodes and modes come and nodes go.
static const plan busy_plan = {.dim = 3,
                               .n = 4,
                               .bodies = 2,
                               .contact = 1,
                               .speed = 1.5,
                               .E = 1e5,
                               .mu = 0.3,
                               .h = 0.005,
                               .count = 6,
                               .initial = 2,
                               .lower = TSS_BASIS_SKINNING,
                               .upper = TSS_BASIS_SKINNING,
                               .steps = 12};

static tss_subspace_def busy_def(void) {
    tss_subspace_def d = tss_subspace_def_default();
    d.partitions = 24, d.downdate = 0.5, d.keep = 1, d.error_modes = 0.05;
    return d;
}

static trail run_busy_ready(const tss_host *host, int steps, int ready) {
    plan p = busy_plan;
    tss_subspace_def d = busy_def();
    tss_host h = *host;
    scene s;
    trail t;
    int nodes = 0, modes = 0;
    memset(&t, 0, sizeof t);
    p.host = &h;
    make(&s, &p, &d);
    for (int k = 0; k < ready; k++) ok(s.w, tss_world_ready(s.w));
    for (int k = 0; k < steps; k++) {
        tss_step_info info = step(&s);
        follow(&t, &info, &nodes, &modes);
    }
    t.hash = tss_world_hash(s.w);
    drop(&s);
    return t;
}

static trail run_busy(const tss_host *host, int steps) { return run_busy_ready(host, steps, 0); }

// tss_world_ready, once or twice, changes no bit and no decision; what it makes is not made again.
static void test_ready(void **state) {
    tss_host host = tss_host_default();
    trail one = run_busy(&host, busy_plan.steps);
    (void)state;
    for (int k = 1; k < 3; k++) {
        trail t = run_busy_ready(&host, busy_plan.steps, k);
        assert_true(memcmp(&one, &t, sizeof t) == 0);
    }
    plan p = busy_plan;
    tss_subspace_def d = busy_def();
    scene s;
    make(&s, &p, &d);
    assert_false(tss_subspace_of(s.w)->built);
    ok(s.w, tss_world_ready(s.w));
    assert_true(tss_subspace_of(s.w)->built && tss_subspace_of(s.w)->modes > 0);
    drop(&s);
}

// One to four threads of a pool, and OpenMP: the same bits.
static void test_threads(void **state) {
    tss_host host = tss_host_default();
    host.workers = 1;
    trail one = run_busy(&host, busy_plan.steps);
    (void)state;
    print_message("    nodes came in %d steps and went in %d, modes came in %d\n", one.grown,
                  one.shrunk, one.modes_grown);
    assert_true(one.grown > 0 && one.shrunk > 0 && one.modes_grown > 0);
    for (int n = 2; n <= THREADS; n++) {
        pool p;
        helper h[THREADS];
        pool_open(&p, h, n);
        tss_host pooled = tss_host_default();
        pooled.parallel_for = pool_run, pooled.parallel_ctx = &p, pooled.workers = n;
        trail t = run_busy(&pooled, busy_plan.steps);
        pool_close(&p);
        assert_true(t.hash == one.hash && t.decisions == one.decisions);
    }
    host.workers = 3;
    assert_true(run_busy(&host, busy_plan.steps).hash == one.hash);
}

// ---- units ------------------------------------------------------------------------------------

typedef struct units {
    double L, M, T;  // of a metre, a kilogram, a second in the units of the run
} units;

typedef struct record {  // the decisions of a run
    int steps, nodes, blocks;
    uint8_t on[24][700], block[24][64];
    int group[700];
    int newton[24], contacts[24];
    double x[2100], v[2100];
} record;

static void record_step(record *r, scene *s, const tss_step_info *i) {
    tss_subspace *sub = tss_subspace_of(s->w);
    tss_subspace_info info;
    int at = 0, k = r->steps++;
    tss_subspace_get_info(sub, &info);
    r->nodes = tss_world_nodes(s->w), r->newton[k] = i->newton, r->contacts[k] = i->contacts;
    assert_true(r->nodes <= 700 && k < 24);
    memcpy(r->on[k], info.enriched, (size_t)r->nodes);
    memcpy(r->group, info.group, (size_t)r->nodes * sizeof(int));
    for (int b = 0; b < sub->modal_count; b++)
        for (int j = 0; j < tss__sub_modal(sub, b)->blocks; j++)
            r->block[k][at++] = (uint8_t)tss__sub_blocks(tss__sub_modal(sub, b))[j].active;
    r->blocks = at;
    memcpy(r->x, tss_world_positions(s->w), (size_t)unknowns(s) * sizeof(double));
    memcpy(r->v, tss_world_velocities(s->w), (size_t)unknowns(s) * sizeof(double));
}

// The busy scene in other units: every quantity with a unit is converted.
static void run_units(const units *u, int steps, record *r) {
    const plan *p = &busy_plan;
    tss_world_def d = tss_world_def_default();
    tss_subspace_def sub = busy_def();
    scene s;
    memset(&s, 0, sizeof s), memset(r, 0, sizeof *r);
    double accel = u->L / (u->T * u->T), force = u->M * accel;
    d.dt = p->h * u->T, d.tol = 1e-3 * u->L / u->T, d.gravity[1] = -9.8125 * accel,
    d.pcg_tol = 1e-8;
    d.on_iterate = on_iterate, d.on_iterate_ctx = &s;
    assert_int_equal(tss_world_create(&d, &s.w), TSS_OK);
    for (int k = 0; k < p->bodies; k++) {
        tss_mesh m;
        // three different sides: a cube's modes come in clusters, which rounding turns
        const double y = 0.001953125 + 0.201953125 * k, lo[3] = {-0.125 + 0.03 * k, y, -0.15};
        const double hi[3] = {0.125 + 0.03 * k, y + 0.2, 0.17};
        const int n[3] = {p->n, p->n - 1, p->n};
        assert_int_equal(tss_shape_box(NULL, lo, hi, n, 6, NULL, &m), TSS_OK);
        for (int i = 0; i < 3 * m.nodes; i++) m.x[i] *= u->L;
        tss_body_def b = tss_body_def_default();
        b.nodes = m.nodes, b.X = m.x, b.cells = m.tets, b.cell = m.tet;
        b.material.E = p->E * force / (u->L * u->L),
        b.material.rho = 1000 * u->M / (u->L * u->L * u->L);
        b.velocity[1] = -p->speed * u->L / u->T;
        ok(s.w, tss_body_add(s.w, &b, NULL));
        tss_mesh_free(&m);
    }
    tss_ipc_plane plane = {{0, 0, 0}, {0, 1, 0}, p->mu};
    tss_ipc_def c = tss_ipc_def_default();
    c.mu = p->mu, c.eps_v = 4e-4 * u->L / u->T, c.planes = 1, c.plane = &plane;
    ok(s.w, tss_ipc_add(s.w, &c, NULL));
    sub.downdate /= u->T;
    ok(s.w, tss_subspace_add(s.w, &sub, NULL));
    for (int k = 0; k < p->bodies; k++) {
        tss_basis_def b = basis_of(TSS_BASIS_SKINNING, p->count, p->initial);
        ok(s.w, tss_basis_add(s.w, k, &b, NULL));
    }
    for (int k = 0; k < steps; k++) {
        tss_step_info i = step(&s);
        record_step(r, &s, &i);
    }
    drop(&s);
}

static int count_changes(const record *a, const record *b, int *all) {
    int changes = 0;
    *all = 0;
    for (int k = 0; k < a->steps; k++) {
        for (int i = 0; i < a->nodes; i++) changes += !a->on[k][i] != !b->on[k][i], ++*all;
        for (int i = 0; i < a->blocks; i++) changes += a->block[k][i] != b->block[k][i], ++*all;
    }
    return changes;
}

// Powers of two in the unit of length, of mass (of four: its root enters factorisations) and of
// time: the same bits, scaled, and the same decisions. Millimetre–tonne–second and
// centimetre–gram–second round differently: 99 % of the decisions.
static void test_units(void **state) {
    static record one, other;
    const units same = {1, 1, 1},
                two[4] = {{8, 1, 1}, {1, 64, 1}, {1, 1, 0.25}, {0.125, 1.0 / 16, 32}};
    const units real[2] = {{1e3, 1e-3, 1}, {1e2, 1e3, 1}};
    int all;
    (void)state;
    run_units(&same, 10, &one);
    for (int k = 0; k < 4; k++) {
        double wrong = 0, speed = two[k].L / two[k].T;
        run_units(two + k, 10, &other);
        for (int i = 0; i < 3 * one.nodes; i++)
            wrong += one.x[i] * two[k].L != other.x[i] || one.v[i] * speed != other.v[i];
        int changes = count_changes(&one, &other, &all);
        print_message("    L %g M %g T %g: %g of %d coordinates and %d of %d decisions differ\n",
                      two[k].L, two[k].M, two[k].T, wrong, 3 * one.nodes, changes, all);
        assert_true(wrong == 0 && changes == 0);
        assert_memory_equal(one.newton, other.newton, sizeof one.newton);
        assert_memory_equal(one.contacts, other.contacts, sizeof one.contacts);
    }
    run_units(&same, 20, &one);
    for (int k = 0; k < 2; k++) {
        run_units(real + k, 20, &other);
        int changes = count_changes(&one, &other, &all);
        print_message("    L %g M %g T %g: %d of %d decisions differ\n", real[k].L, real[k].M,
                      real[k].T, changes, all);
        assert_true(changes <= all / 100);
    }
}

// ---- checkpoints ------------------------------------------------------------------------------

static void *save(scene *s, size_t *size) {
    *size = tss_world_save(s->w, NULL, 0);
    void *data = malloc(*size);
    assert_non_null(data);
    assert_true(tss_world_save(s->w, data, *size) == *size);
    return data;
}

// Saved after k steps (before the first too), resumed in a fresh world and in one that went elsewhere.
static void test_resume(void **state) {
    (void)state;
    for (int schur = TSS_SCHUR_AUTO; schur <= TSS_SCHUR_DIRECT; schur++)
        for (int at = 0; at < 6; at += 5) {
            tss_subspace_def d = busy_def();
            scene s[3];
            size_t size;
            d.schur = (tss_schur)schur;
            for (int k = 0; k < 3; k++) make(s + k, &busy_plan, &d);
            for (int k = 0; k < at; k++) step(s);
            void *data = save(s, &size);
            for (int k = 0; k < 4; k++) step(s);
            for (int k = 0; k < 3; k++) step(s + 2);  // another state, other active nodes
            for (int k = 1; k < 3; k++) {
                ok(s[k].w, tss_world_load(s[k].w, data, size));
                for (int i = 0; i < 4; i++) step(s + k);
                if (tss_world_hash(s[0].w) != tss_world_hash(s[k].w))
                    print_error("schur %d, saved after %d steps, world %d\n", schur, at, k);
                assert_true(tss_world_hash(s[0].w) == tss_world_hash(s[k].w));
            }
            free(data);
            for (int k = 0; k < 3; k++) drop(s + k);
        }
}

// A checkpoint, then another mode: subspace alone has no enriched nodes, those of the
// checkpoint neither.
static void test_resume_and_set(void **state) {
    tss_subspace_def d = busy_def();
    scene s[2];
    size_t size;
    (void)state;
    for (int k = 0; k < 2; k++) make(s + k, &busy_plan, &d);
    for (int k = 0; k < 5; k++) step(s);
    void *data = save(s, &size);
    step(s + 1);
    d.mode = TSS_MODE_SUBSPACE;
    for (int k = 0; k < 2; k++) {
        ok(s[k].w, tss_world_load(s[k].w, data, size));
        ok(s[k].w, tss_subspace_set(tss_subspace_of(s[k].w), &d));
        assert_int_equal(step(s + k).enriched_nodes, 0);
        drop(s + k);
    }
    free(data);
}

// Nodes pinned along one axis are always enriched: also after a return to the state before the first
// step, and after a query there. BUG: loading clears them, and nobody marks them again.
static void test_rewind(void **state) {
    const plan p = {.dim = 3, .n = 3, .bodies = 1, .contact = 1, .speed = 0.5, .kappa = 3e8,
                    .pins = 1, .lower = TSS_BASIS_SKINNING, .upper = -1, .count = 5};
    tss_subspace_def d = tss_subspace_def_default();
    scene s[3];
    size_t size;
    (void)state;
    for (int k = 0; k < 3; k++) make(s + k, &p, &d);
    void *data = save(s, &size);
    step(s + 1), step(s + 1);
    ok(s[1].w, tss_world_load(s[1].w, data, size));
    ok(s[2].w, tss_subspace_query(s[2].w));
    for (int k = 0; k < 3; k++) {
        tss_step_info a = step(s), b = step(s + 1), c = step(s + 2);
        if (k == 0) print_message("    enriched: %d, %d after a return, %d after a query\n",
                                  a.enriched_nodes, b.enriched_nodes, c.enriched_nodes);
        assert_true(a.enriched_nodes >= 16);
        assert_true(tss_world_hash(s[0].w) == tss_world_hash(s[1].w));
        assert_true(tss_world_hash(s[0].w) == tss_world_hash(s[2].w));
    }
    free(data);
    for (int k = 0; k < 3; k++) drop(s + k);
}

// Damage of every kind is refused or harmless, never a crash; cut short it is always refused.
static void test_damaged(void **state) {
    tss_subspace_def d = busy_def();
    scene s, t;
    size_t size;
    uint64_t seed = 12345;
    int refused = 0;
    (void)state;
    make(&s, &busy_plan, &d), make(&t, &busy_plan, &d);
    for (int k = 0; k < 5; k++) step(&s);
    unsigned char *data = (unsigned char *)save(&s, &size), *copy = (unsigned char *)malloc(size);
    size_t own = tss__sub_state(tss_subspace_of(s.w), NULL, 0, 1);
    assert_non_null(copy);
    for (size_t cut = 1; cut < own; cut += 1 + cut / 4)
        assert_true(tss_world_load(t.w, data, size - cut) != TSS_OK);
    for (int k = 0; k < 200; k++) {
        memcpy(copy, data, size);
        seed = seed * 6364136223846793005u + 1442695040888963407u;
        size_t from = size - own,
               place = k < 100 ? from + (size_t)k % 64 : from + (size_t)(seed >> 20) % own;
        copy[place] = (unsigned char)(copy[place] ^ (1u << (seed >> 60 & 7)));
        if (tss_world_load(t.w, copy, size) != TSS_OK) {
            refused++;
            continue;
        }
        if (k % 20 == 0) {
            tss_step_info info;
            (void)tss_world_step(t.w, &info);
        }
    }
    ok(t.w, tss_world_load(t.w, data, size));
    step(&s), step(&t);
    print_message("    seed 12345: %d of 200 damaged states refused\n", refused);
    assert_true(refused > 0 && tss_world_hash(s.w) == tss_world_hash(t.w));
    free(data), free(copy);
    drop(&s), drop(&t);
}

// ---- cases ------------------------------------------------------------------------------------

static void pin_and_free(tss_world *w, const plan *p, int k) {
    for (int i = 0; i < tss_world_nodes(w) && k > 0; i++)
        if (tss_world_rest(w)[i * p->dim] > 0.0999)
            ok(w, tss_node_pin(w, i, k % 2 ? (1u << p->dim) - 1 : 0));
}

static void remove_upper(tss_world *w, const plan *p, int k) {
    if (k == 2) ok(w, tss_body_remove(w, p->bodies - 1));
}

static void remove_basis(tss_world *w, const plan *p, int k) {
    (void)p;
    if (k == 2) ok(w, tss_basis_remove(w, 0));
}

// The end opposite the pins is pressed down to the floor (2D).
static void press(tss_world *w, const plan *p, int k) {
    for (int i = 0; i < tss_world_nodes(w); i++) {
        const double *X = tss_world_rest(w) + i * p->dim, t[2] = {X[0], X[1] - 0.00023 * (k + 1)};
        if (X[0] > 0.0999) ok(w, tss_node_target(w, i, t));
    }
}

// An obstacle under the block goes up and sideways.
static void add_table(tss_world *w, tss_body lowest) {
    static const double X[12] = {-0.3, -0.01, -0.3, 0.3,  -0.01, -0.3,
                                 0.3,  -0.01, 0.3,  -0.3, -0.01, 0.3};
    static const int face[6] = {0, 2, 1, 0, 3, 2};
    tss_body_def d = tss_body_def_default();
    (void)lowest;
    d.kind = TSS_BODY_OBSTACLE, d.nodes = 4, d.X = X, d.triangles = 2, d.triangle = face;
    ok(w, tss_body_add(w, &d, NULL));
    tss_ipc_def c = tss_ipc_def_default();
    c.mu = 0.4, c.kappa = 3e8;
    ok(w, tss_ipc_add(w, &c, NULL));
}

static void lift(tss_world *w, const plan *p, int k) {
    double x[12];
    (void)p;
    const int table = tss_world_bodies(w) - 1;
    tss_body_info info;
    ok(w, tss_body_get(w, table, &info));
    for (int i = 0; i < 12; i++)
        x[i] = tss_world_rest(w)[3 * info.first_node + i] + (i % 3 == 1   ? 0.004 * (k + 1)
                                                             : i % 3 == 0 ? 0.002 * (k + 1)
                                                                          : 0);
    ok(w, tss_body_target(w, table, x));
}

// Columns that turn with the body: the rotations about its middle as it is now, and translations.
static void moving_columns(void *user, const tss_ctx *c, int first, int nodes, double *out) {
    double m[3] = {0, 0, 0};
    (void)user;
    for (int i = 0; i < nodes * 3; i++) m[i % 3] += c->x_t[first * 3 + i] / nodes;
    for (int i = 0; i < nodes; i++)
        for (int a = 0; a < 3; a++) {
            const double *x = c->x_t + (first + i) * 3;
            double *row = out + (i * 3 + a) * 12;
            for (int k = 0; k < 3; k++) {
                int b = (a + 1) % 3, e = (a + 2) % 3;
                row[k] = a == k;
                row[3 + k] = k == b ? x[e] - m[e] : k == e ? m[b] - x[b] : 0;
                row[6 + k] = a == k ? x[a] - m[a] : 0;
                row[9 + k] = a == k ? (x[a] - m[a]) * (x[b] - m[b]) : 0;
            }
        }
}

static void add_custom(tss_world *w, tss_body lowest) {
    tss_basis_def d = tss_basis_custom(12, NULL, moving_columns, NULL);
    ok(w, tss_basis_add(w, lowest, &d, NULL));
}

// One tetrahedron beside the block, with all the modes it can have.
static void add_tet(tss_world *w, tss_body lowest) {
    static const double X[12] = {0.3, 0.01, 0, 0.4, 0.01, 0, 0.3, 0.11, 0, 0.3, 0.01, 0.1};
    static const int cell[4] = {0, 1, 2, 3};
    tss_body_def d = tss_body_def_default();
    tss_basis_def b = tss_basis_affine();
    tss_body id;
    (void)lowest;
    d.nodes = 4, d.X = X, d.cells = 1, d.cell = cell;
    ok(w, tss_body_add(w, &d, &id));
    ok(w, tss_basis_add(w, id, &b, NULL));
}

static const plan case_plans[] = {
    {.name = "no contact, one end held",
     .dim = 3,
     .n = 4,
     .bodies = 1,
     .E = 2e4,
     .lower = TSS_BASIS_SKINNING,
     .count = 6,
     .upper = -1,
     .pins = 7},
    {.name = "one without a basis",
     .dim = 3,
     .n = 3,
     .bodies = 2,
     .contact = 1,
     .mu = 0.3,
     .speed = 0.5,
     .kappa = 3e8,
     .lower = TSS_BASIS_SKINNING,
     .count = 4,
     .upper = -1},
    {.name = "basis removed",
     .dim = 3,
     .n = 3,
     .bodies = 2,
     .contact = 1,
     .speed = 0.5,
     .kappa = 3e8,
     .lower = TSS_BASIS_SKINNING,
     .count = 4,
     .upper = TSS_BASIS_AFFINE,
     .change = remove_basis},
    {.name = "body removed",
     .dim = 3,
     .n = 3,
     .bodies = 2,
     .contact = 1,
     .speed = 0.5,
     .kappa = 3e8,
     .lower = TSS_BASIS_SKINNING,
     .count = 4,
     .upper = TSS_BASIS_AFFINE,
     .change = remove_upper},
    {.name = "single tet",
     .dim = 3,
     .n = 2,
     .bodies = 1,
     .contact = 1,
     .mu = 0.2,
     .speed = 0.5,
     .kappa = 3e8,
     .lower = TSS_BASIS_AFFINE,
     .upper = -1,
     .custom = add_tet},
    {.name = "2D pile",
     .dim = 2,
     .n = 6,
     .bodies = 3,
     .contact = 1,
     .mu = 0.3,
     .speed = 0.5,
     .kappa = 1e9,
     .lower = TSS_BASIS_SKINNING,
     .upper = TSS_BASIS_SKINNING,
     .count = 5},
    {.name = "pins on and off",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .contact = 1,
     .speed = 0.5,
     .kappa = 3e8,
     .lower = TSS_BASIS_SKINNING,
     .upper = -1,
     .count = 5,
     .change = pin_and_free},
    {.name = "twisting end",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .lower = TSS_BASIS_SKINNING,
     .upper = -1,
     .count = 5,
     .pins = 7,
     .change = twist},
    {.name = "moving obstacle",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .lower = TSS_BASIS_SKINNING,
     .upper = -1,
     .count = 5,
     .custom = add_table,
     .change = lift},
    {.name = "quasi-static twist",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .integrator = TSS_QUASISTATIC,
     .pins = 7,
     .change = twist,
     .lower = TSS_BASIS_SKINNING,
     .upper = -1,
     .count = 5},
    {.name = "quasi-static, pressed",
     .dim = 2,
     .n = 6,
     .bodies = 1,
     .contact = 1,
     .integrator = TSS_QUASISTATIC,
     .pins = 3,
     .change = press,
     .kappa = 1e9,
     .lower = TSS_BASIS_QUADRATIC,
     .upper = -1,
     .E = 2e4},
    {.name = "implicit Euler",
     .dim = 3,
     .n = 3,
     .bodies = 2,
     .contact = 1,
     .speed = 0.5,
     .kappa = 3e8,
     .integrator = TSS_IMPLICIT_EULER,
     .lower = TSS_BASIS_SKINNING,
     .upper = TSS_BASIS_EIGEN,
     .count = 12},
    {.name = "Newmark",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .integrator = TSS_NEWMARK,
     .pins = 7,
     .E = 2e4,
     .lower = TSS_BASIS_BIHARMONIC,
     .upper = -1,
     .count = 5},
    {.name = "stable Neo-Hookean",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .contact = 1,
     .speed = 1,
     .kappa = 3e8,
     .E = 2e4,
     .material = TSS_STABLE_NEO_HOOKEAN,
     .lower = TSS_BASIS_SKINNING,
     .upper = -1,
     .count = 5},
    {.name = "StVK",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .contact = 1,
     .speed = 0.5,
     .kappa = 3e8,
     .material = TSS_STVK,
     .lower = TSS_BASIS_SKINNING,
     .upper = -1,
     .count = 5},
    {.name = "linear",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .contact = 1,
     .speed = 0.5,
     .kappa = 3e8,
     .material = TSS_LINEAR,
     .lower = TSS_BASIS_SKINNING,
     .upper = -1,
     .count = 5},
    {.name = "symmetry plane",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .contact = 1,
     .mu = 0.3,
     .speed = 0.5,
     .kappa = 3e8,
     .pins = 1,
     .lower = TSS_BASIS_SKINNING,
     .upper = -1,
     .count = 5},
    {.name = "two bases",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .contact = 1,
     .speed = 0.5,
     .kappa = 3e8,
     .second = 12,
     .lower = TSS_BASIS_QUADRATIC,
     .upper = -1},
    {.name = "custom columns",
     .dim = 3,
     .n = 3,
     .bodies = 1,
     .contact = 1,
     .mu = 0.3,
     .speed = 0.5,
     .kappa = 3e8,
     .lower = -1,
     .upper = -1,
     .custom = add_custom},
};

// Steps of one case at the default thresholds, judged on their whole path.
static void judge_case(const plan *p, double *share) {
    tss_subspace_def d = tss_subspace_def_default();
    scene s;
    double nodes = 0, all = 0;
    d.partitions = 8;
    make(&s, p, &d);
    watch(&s, p);
    for (int k = 0; k < 6; k++) {
        if (p->change) p->change(s.w, p, k);
        ok(s.w, tss_world_prepare(s.w));
        if (k > 0 && p->change == remove_upper && k == 2) unwatch(&s);  // its nodes no longer count
        refresh_kinds(&s);
        tss_step_info i = step(&s);
        nodes += i.enriched_nodes, all += i.nodes;
        if (p->material == TSS_NEO_HOOKEAN) assert_true(i.min_J > 0);
    }
    *share = nodes / all;
    drop(&s);
}

// The same steps with thresholds at 0, from the states of the full-space solver.
static double compare_case(const plan *p) {
    tss_subspace_def zero = tss_subspace_def_default(), full = zero;
    plan fine = *p;
    scene a, b;
    double worst = 0, moved = 0;
    fine.tol = 1e-5;
    zero.error_nodes = zero.error_modes = 0, zero.partitions = 8, full.mode = TSS_MODE_FULL;
    make(&a, &fine, &zero), make(&b, &fine, &full);
    for (int k = 0; k < 6; k++) {
        if (p->change) p->change(a.w, p, k), p->change(b.w, p, k);
        ok(a.w, tss_world_prepare(a.w)), ok(b.w, tss_world_prepare(b.w));
        ok(a.w, tss_world_copy_state(a.w, b.w));
        double *x = doubles((size_t)unknowns(&b));
        memcpy(x, tss_world_positions(b.w), (size_t)unknowns(&b) * sizeof(double));
        step(&a), step(&b);
        worst =
            fmax(worst, apart(tss_world_positions(a.w), tss_world_positions(b.w), unknowns(&b)));
        moved = fmax(moved, apart(x, tss_world_positions(b.w), unknowns(&b)));
        free(x);
    }
    drop(&a), drop(&b);
    return worst / moved;
}

// Every case converges, its path is clear, and thresholds at 0 give the full-space solution.
static void test_cases(void **state) {
    (void)state;
    for (size_t k = 0; k < sizeof case_plans / sizeof *case_plans; k++) {
        double share;
        judge_case(case_plans + k, &share);
        double error = compare_case(case_plans + k);
        print_message("    %-26s %3.0f %% enriched; thresholds at 0: error %.1e of the motion\n",
                      case_plans[k].name, 100 * share, error);
        assert_true(error < 1e-3);
    }
}

// A basis none of whose blocks is active at first, and one whose modes all join: no worse than
// none.
static void test_initial_zero(void **state) {
    plan p = {.dim = 3, .n = 3, .bodies = 1, .contact = 1, .speed = 1, .lower = -1, .upper = -1};
    tss_subspace_def d = tss_subspace_def_default();
    tss_basis_def b = tss_basis_skinning(4);
    scene s;
    (void)state;
    make(&s, &p, &d);
    b.initial = 0;
    ok(s.w, tss_basis_add(s.w, 0, &b, NULL));
    watch(&s, &p);
    for (int k = 0; k < 4; k++) {
        tss_step_info i = step(&s);
        assert_int_equal(i.modes, 60);
    }
    drop(&s);
}

// ---- a pile -----------------------------------------------------------------------------------

// Columns of cubes of one cell, each column a chain of bodies in touch.
static void make_pile(scene *s, int columns, int high, double gap) {
    tss_world_def d = tss_world_def_default();
    memset(s, 0, sizeof *s);
    d.tol = 1e-2, d.on_iterate = on_iterate, d.on_iterate_ctx = s;
    assert_int_equal(tss_world_create(&d, &s->w), TSS_OK);
    plan p = {.dim = 3, .mu = 0.3, .kappa = 1e8};
    add_contact(s, &p);
    for (int k = 0; k < columns * high; k++) {
        tss_mesh m;
        double x = 0.25 * (k / high), y = 0.0002 + (0.1 + gap) * (k % high);
        const double lo[3] = {x, y, 0}, hi[3] = {x + 0.1, y + 0.1, 0.1};
        const int n[3] = {1, 1, 1};
        assert_int_equal(tss_shape_box(NULL, lo, hi, n, 5, NULL, &m), TSS_OK);
        tss_body_def b = tss_body_def_default();
        b.nodes = m.nodes, b.X = m.x, b.cells = m.tets, b.cell = m.tet, b.velocity[1] = -0.1;
        ok(s->w, tss_body_add(s->w, &b, NULL));
        tss_mesh_free(&m);
    }
    tss_subspace_def sub = tss_subspace_def_default();
    sub.mode = TSS_MODE_SUBSPACE;
    ok(s->w, tss_subspace_add(s->w, &sub, NULL));
    for (int k = 0; k < columns * high; k++) {
        tss_basis_def b = tss_basis_affine();
        ok(s->w, tss_basis_add(s->w, k, &b, NULL));
    }
}

// The modal system of a pile, dense from its blocks: the solver's direction must solve it.
static void look_at_pile(spy *y, tss_world *w, const tss_iterate *it) {
    tss_subspace *s = y->s;
    int a = (int)s->modes;
    double *H = doubles((size_t)a * (size_t)a), *r = doubles((size_t)a), size = 0, worst = 0;
    y->looks++, y->crosses = s->crosses > y->crosses ? s->crosses : y->crosses;
    for (int k = -s->crosses; k < s->modal_count; k++) {
        const tss__sub_cross *c =
            k < 0 ? (const tss__sub_cross *)s->cross.p + (k + s->crosses) : NULL;
        const tss__modal *m = tss__sub_modal(s, c ? c->b : k), *n = tss__sub_modal(s, c ? c->c : k);
        const double *V = c ? tss__sub_f(&s->cross_val) + c->at : tss__sub_f(&s->H) + m->hat;
        for (int j = 0; j < m->a * n->a; j++) {
            size_t i = n->at + (size_t)(j % n->a), t = m->at + (size_t)(j / n->a);
            H[i * (size_t)a + t] = H[t * (size_t)a + i] = V[j];
        }
        if (!c && m->component == k && m->width > y->updates) y->updates = m->width;
    }
    ok(w, tss__sub_restrict(s, it->g, 0, r));
    size = largest(r, (size_t)a);
    for (int i = 0; i < a; i++) {
        for (int j = 0; j < a; j++)
            r[i] += H[(size_t)i * (size_t)a + (size_t)j] * tss__sub_f(&s->dq)[j];
        worst = fmax(worst, fabs(r[i]));
    }
    if (size > 1e-10) y->d = fmax(y->d, worst / size);
    free(H), free(r);
}

// 100 small bodies: far below a dense matrix of all modes; and a chain wide enough for the sparse
// factorisation. Both directions against their residual in the matrix of the blocks.
static void test_pile(void **state) {
    tss_subspace_info info;
    scene s;
    spy y;
    (void)state;
    for (int sparse = 0; sparse < 2; sparse++) {
        memset(&y, 0, sizeof y);
        make_pile(&s, sparse ? 1 : 10, sparse ? 130 : 10, 0.0002);
        y.look = look_at_pile;
        spy_on(&y, &s);
        for (int k = 0; k < 2; k++) step(&s);
        s.w->finder.direction = tss__sub_direction;
        tss_subspace_get_info(tss_subspace_of(s.w), &info);
        print_message(
            "    %d bodies, %d modes, component of %d, %d pairs: %.1f MB, %d iterates, residual "
            "%.1e\n",
            info.bodies, info.modes, y.updates, y.crosses, 1e-6 * (double)info.bytes, y.looks, y.d);
        assert_true(y.d < 1e-8 && y.crosses >= 90);
        if (sparse)
            assert_true(y.updates > TSS__SUB_DENSE);
        else
            assert_true(info.bytes < 1200u * 1200u * 8u);
        drop(&s);
    }
}

// Weights of a skinning basis: nodes × blocks doubles and little else.
static void test_memory(void **state) {
    plan p = {.dim = 3, .n = 8, .bodies = 1, .lower = TSS_BASIS_SKINNING, .count = 16, .upper = -1};
    tss_subspace_def d = tss_subspace_def_default();
    tss_basis_info b;
    scene s;
    (void)state;
    make(&s, &p, &d);
    ok(s.w, tss_basis_get(s.w, 0, &b));
    assert_int_equal(b.blocks, 17);
    assert_true((double)b.bytes <= 1.3 * 729 * 17 * sizeof(double));
    drop(&s);
}

// ---- memory -----------------------------------------------------------------------------------

typedef struct ledger {
    long calls, fail_at, live;  // the allocation that fails, counted from 0; −1: none
    size_t bytes;
} ledger;

static void *ledger_alloc(size_t bytes, size_t align, void *ctx) {
    ledger *l = (ledger *)ctx;
    if (l->calls++ == l->fail_at) return NULL;
    l->live++, l->bytes += bytes;
    return aligned_alloc(align, (bytes + align - 1) / align * align);
}

static void ledger_free(void *ptr, size_t bytes, void *ctx) {
    ledger *l = (ledger *)ctx;
    if (ptr) l->live--, l->bytes -= bytes;
    free(ptr);
}

// A call that runs out of memory once succeeds the second time.
static long failing;

static int again(tss_result r, int *failed) {
    if (r != TSS_OK && r != TSS_ERROR_NO_MEMORY)
        print_error("allocation %ld fails: %s\n", failing, tss_result_text(r));
    assert_true(r == TSS_OK || r == TSS_ERROR_NO_MEMORY);
    if (r == TSS_ERROR_NO_MEMORY) assert_int_equal(++*failed, 1);
    return r != TSS_OK;
}

// Two blocks, three steps with enrichment, a query, a basis removed. failed: calls that ran out.
static uint64_t short_run(ledger *l, int *failed) {
    tss_world_def d = tss_world_def_default();
    tss_subspace_def sub = tss_subspace_def_default();
    tss_world *w = NULL;
    plan p = {.dim = 3, .n = 2, .E = 2e4, .speed = 2, .mu = 0.3};
    tss_basis_def b[3] = {tss_basis_skinning(3), tss_basis_affine(), tss_basis_eigen(8)};
    *failed = 0;
    d.host.alloc = ledger_alloc, d.host.free = ledger_free, d.host.memory_ctx = l, d.tol = 1e-3,
    d.pcg_tol = 1e-8;
    while (again(tss_world_create(&d, &w), failed)) assert_null(w);
    for (int k = 0; k < 2; k++) {
        tss_mesh m;
        const double lo[3] = {0.01 * k, 0.001 + 0.202 * k, 0},
                     hi[3] = {0.01 * k + 0.2, 0.201 + 0.202 * k, 0.2};
        const int n[3] = {2, 2, 2};
        assert_int_equal(tss_shape_box(NULL, lo, hi, n, 5, NULL, &m), TSS_OK);
        tss_body_def body = tss_body_def_default();
        body.nodes = m.nodes, body.X = m.x, body.cells = m.tets, body.cell = m.tet,
        body.material.E = p.E;
        body.velocity[1] = -p.speed;
        while (again(tss_body_add(w, &body, NULL), failed)) {
        }
        tss_mesh_free(&m);
    }
    tss_ipc_plane plane = {{0, 0, 0}, {0, 1, 0}, p.mu};
    tss_ipc_def c = tss_ipc_def_default();
    c.mu = p.mu, c.planes = 1, c.plane = &plane;
    while (again(tss_ipc_add(w, &c, NULL), failed)) {
    }
    sub.partitions = 6, sub.error_nodes = 0.2;
    while (again(tss_subspace_add(w, &sub, NULL), failed)) {
    }
    for (int k = 0; k < 3; k++)
        while (again(tss_basis_add(w, k == 1, b + k, NULL), failed))
            assert_int_equal(tss_world_bases(w), k);
    for (int k = 0; k < 3; k++) {
        if (k == 2) ok(w, tss_basis_remove(w, 2));
        while (again(tss_world_step(w, NULL), failed)) {
        }
        for (tss_result r = TSS_ERROR_NO_MEMORY; k == 0 && r != TSS_OK;) {
            r = tss_subspace_query(w);
            // BUG: a finder whose state finds no memory cannot say so; the probe then reports a
            // mismatch.
            if (r != TSS_OK) again(r == TSS_ERROR_MISMATCH ? TSS_ERROR_NO_MEMORY : r, failed);
        }
    }
    uint64_t hash = tss_world_hash(w);
    tss_world_destroy(w);
    assert_int_equal(l->live, 0);
    assert_int_equal(l->bytes, 0);
    return hash;
}

// Every allocation fails in turn: NO_MEMORY, nothing leaked, and the call succeeds when repeated.
// (What a failed step had enriched stays so: a repeated step may then round differently.)
static void test_no_memory(void **state) {
    ledger l = {0, -1, 0, 0};
    int failed, differ = 0;
    uint64_t hash = short_run(&l, &failed);
    long calls = l.calls, first = -1;
    (void)state;
    assert_int_equal(failed, 0);
    for (long k = 0; k < calls; k++) {
        ledger m = {0, k, 0, 0};
        failing = k;
        uint64_t got = short_run(&m, &failed);
        if (got == hash) continue;
        differ++;
        if (first < 0) first = k;
    }
    print_message(
        "    %ld allocations; %d runs came out different, first with the failure of number %ld\n",
        calls, differ, first);
    assert_true(calls > 100);
}

// ---- the oracle -------------------------------------------------------------------------------

typedef struct fields {
    int calls, n, dim, iterate;
    double error[2000], progress[2000], force[2000], d_a[6000], most;
    uint8_t enriched[2000];
    int worst;
} fields;

static void keep_fields(const tss_oracle_fields *f, void *ctx) {
    fields *k = (fields *)ctx;
    k->calls++, k->iterate = f->iterate;
    if (f->iterate > 0) return;
    assert_true(k->n <= 2000);
    memcpy(k->error, f->error, (size_t)k->n * sizeof(double));
    memcpy(k->progress, f->progress, (size_t)k->n * sizeof(double));
    memcpy(k->force, f->force, (size_t)k->n * sizeof(double));
    memcpy(k->d_a, f->d_a, (size_t)(k->n * k->dim) * sizeof(double));
    memcpy(k->enriched, f->enriched, (size_t)k->n);
    k->worst = 0;
    for (int i = 1; i < k->n; i++)
        if (f->error[i] > f->error[k->worst]) k->worst = i;
    k->most = fmax(k->most, f->error[k->worst]);
}

// A query sees what the next step sees first, and that step is the same with and without it.
static void test_query(void **state) {
    const plan p = {.dim = 3,
                    .n = 3,
                    .bodies = 2,
                    .contact = 1,
                    .speed = 1,
                    .E = 3e4,
                    .mu = 0.3,
                    .count = 4,
                    .lower = TSS_BASIS_SKINNING,
                    .upper = TSS_BASIS_AFFINE};
    static fields asked, seen;
    tss_subspace_def d = tss_subspace_def_default();
    scene s, t;
    (void)state;
    d.partitions = 12, d.on_oracle = keep_fields, d.on_oracle_ctx = &seen;
    make(&s, &p, &d), make(&t, &p, &d);
    for (int k = 0; k < 6; k++) {
        tss_subspace *sub = tss_subspace_of(s.w);
        tss_subspace_info info;
        memset(&asked, 0, sizeof asked), memset(&seen, 0, sizeof seen);
        asked.n = seen.n = tss_world_nodes(s.w), asked.dim = seen.dim = 3;
        uint64_t hash = tss_world_hash(s.w);
        d.on_oracle_ctx = &asked;
        ok(s.w, tss_subspace_set(sub, &d));
        ok(s.w, tss_subspace_query(s.w));
        assert_true(asked.calls == 1 && asked.iterate == 0 && tss_world_hash(s.w) == hash);
        tss_subspace_get_info(sub, &info);
        assert_memory_equal(info.error, asked.error, (size_t)asked.n * sizeof(double));
        assert_memory_equal(info.progress, asked.progress, (size_t)asked.n * sizeof(double));
        d.on_oracle_ctx = &seen;
        ok(s.w, tss_subspace_set(sub, &d));
        step(&s), step(&t);
        assert_true(tss_world_hash(s.w) == tss_world_hash(t.w));
        assert_memory_equal(seen.error, asked.error, sizeof seen.error);
        assert_memory_equal(seen.progress, asked.progress, sizeof seen.progress);
        assert_memory_equal(seen.force, asked.force, sizeof seen.force);
        assert_memory_equal(seen.d_a, asked.d_a, sizeof seen.d_a);
    }
    drop(&s), drop(&t);
}

static tss_body add_mesh(tss_world *w, const tss_mesh *m, double E, double speed) {
    tss_body_def d = tss_body_def_default();
    tss_body b = -1;
    d.nodes = m->nodes, d.X = m->x, d.cells = m->tets, d.cell = m->tet;
    d.kind = m->tets > 0 ? TSS_BODY_SOFT : TSS_BODY_OBSTACLE;
    if (m->tets == 0) d.triangles = m->triangles, d.triangle = m->triangle;
    d.material.E = E, d.velocity[1] = -speed;
    ok(w, tss_body_add(w, &d, &b));
    return b;
}

// Fig. 4 in small: a soft ball falls on the tip of a cone. The largest error is near the tip, and
// so is what is enriched.
static void test_tip(void **state) {
    static fields seen;
    tss_world_def wd = tss_world_def_default();
    tss_subspace_def d = tss_subspace_def_default();
    tss_shape_def ball = tss_shape_def_default(TSS_SHAPE_BALL);
    tss_basis_def basis = tss_basis_skinning(10);
    tss_ipc_def c = tss_ipc_def_default();
    tss_mesh m, cone;
    scene s;
    double lo[3], hi[3], near_tip = 0, all = 0, mean = 0;
    (void)state;
    memset(&s, 0, sizeof s), memset(&seen, 0, sizeof seen);
    wd.dt = 0.005, wd.tol = 5e-3;
    assert_int_equal(tss_world_create(&wd, &s.w), TSS_OK);
    ball.cells = 9;
    assert_int_equal(tss_shape_make(NULL, &ball, &m), TSS_OK);
    tss_mesh_bounds(&m, lo, hi);
    tss_mesh_translate(&m, -(lo[0] + hi[0]) / 2, -lo[1] + 0.005, -(lo[2] + hi[2]) / 2);
    assert_int_equal(tss_shape_cone_surface(NULL, 0.3, 0.5, 12, &cone), TSS_OK);
    tss_mesh_translate(&cone, 0.01, -0.5, 0.005);
    add_mesh(s.w, &m, 2e5, 1.5), add_mesh(s.w, &cone, 0, 0);
    ok(s.w, tss_ipc_add(s.w, &c, NULL));
    seen.n = tss_world_nodes(s.w), seen.dim = 3;
    d.on_oracle = keep_fields, d.on_oracle_ctx = &seen, d.partitions = 40;
    ok(s.w, tss_subspace_add(s.w, &d, NULL));
    ok(s.w, tss_basis_add(s.w, 0, &basis, NULL));
    for (int k = 0; k < 6; k++) {
        tss_subspace_info info;
        tss_step_info i = step(&s);
        tss_subspace_get_info(tss_subspace_of(s.w), &info);
        const double *x = tss_world_positions(s.w);
        if (k < 2) continue;
        double r = hypot(hypot(x[3 * seen.worst] - 0.01, x[3 * seen.worst + 1]),
                         x[3 * seen.worst + 2] - 0.005);
        print_message("    step %d: %d of %d enriched, largest error %.2f at %.2f m from the tip\n",
                      k, i.enriched_nodes, i.nodes, seen.error[seen.worst], r);
        assert_true(r < 0.25);
        for (int n = 0; n < m.nodes; n++) {
            double away = hypot(hypot(x[3 * n] - 0.01, x[3 * n + 1]), x[3 * n + 2] - 0.005);
            mean += away / m.nodes / 4;
            if (info.enriched[n]) near_tip += away, all += 1;
        }
    }
    print_message("    enriched nodes %.2f m from the tip, all nodes %.2f m\n",
                  near_tip / fmax(all, 1), mean);
    assert_true(all > 0 && near_tip / all < 0.6 * mean);
    tss_mesh_free(&m), tss_mesh_free(&cone);
    drop(&s);
}

// Fig. 14 in small: a heavy block falls on a block of 1e5, 1e6 and 1e9 Pa: the stiffer, the fewer
// nodes.
static void test_stiffness(void **state) {
    const double E[3] = {1e5, 1e6, 1e9};
    double share[3];
    (void)state;
    for (int k = 0; k < 3; k++) {
        tss_world_def wd = tss_world_def_default();
        tss_subspace_def d = tss_subspace_def_default();
        tss_basis_def basis = tss_basis_skinning(16), affine = tss_basis_affine();
        tss_ipc_def c = tss_ipc_def_default();
        const double lo[3] = {-0.5, 0, -0.5}, hi[3] = {0.5, 0.5, 0.5},
                     lo2[3] = {-0.2, 0.505, -0.15}, hi2[3] = {0.2, 0.8, 0.15};
        const int n[3] = {8, 4, 8}, n2[3] = {2, 2, 2};
        tss_mesh m, heavy;
        scene s;
        double nodes = 0, all = 0;
        memset(&s, 0, sizeof s);
        wd.dt = 0.005, wd.tol = 5e-3;
        assert_int_equal(tss_world_create(&wd, &s.w), TSS_OK);
        assert_int_equal(tss_shape_box(NULL, lo, hi, n, 5, NULL, &m), TSS_OK);
        assert_int_equal(tss_shape_box(NULL, lo2, hi2, n2, 5, NULL, &heavy), TSS_OK);
        tss_body low = add_mesh(s.w, &m, E[k], 0);
        for (int i = 0; i < m.nodes; i++)
            if (m.x[3 * i + 1] < 1e-9) ok(s.w, tss_node_pin(s.w, i, 7));
        tss_body_def b = tss_body_def_default();
        b.nodes = heavy.nodes, b.X = heavy.x, b.cells = heavy.tets, b.cell = heavy.tet;
        b.material.E = 1e9, b.material.rho = 7000, b.velocity[1] = -3;
        ok(s.w, tss_body_add(s.w, &b, NULL));
        ok(s.w, tss_ipc_add(s.w, &c, NULL));
        d.partitions = 20;
        ok(s.w, tss_subspace_add(s.w, &d, NULL));
        ok(s.w, tss_basis_add(s.w, low, &basis, NULL)),
            ok(s.w, tss_basis_add(s.w, 1, &affine, NULL));
        for (int j = 0; j < 6; j++) {
            tss_step_info i = step(&s);
            nodes += i.enriched_nodes, all += i.nodes;
        }
        share[k] = nodes / all;
        tss_mesh_free(&m), tss_mesh_free(&heavy);
        drop(&s);
    }
    print_message("    enriched: %.0f %% at 1e5 Pa, %.0f %% at 1e6 Pa, %.0f %% at 1e9 Pa\n",
                  100 * share[0], 100 * share[1], 100 * share[2]);
    assert_true(share[0] > share[1] && share[1] > share[2] && share[2] == 0);
}

// Fig. 5 in small: a soft block slides down a frictionless ramp (gravity tilted) from the
// equilibrium it has while it slides. It is strained far beyond the threshold, and nothing is
// enriched.
static void test_ramp(void **state) {
    const double tilt = 0.4, g = 9.80665;
    static fields seen;
    plan p = {.dim = 3,
              .n = 4,
              .bodies = 1,
              .contact = 1,
              .E = 4e3,
              .kappa = 1e7,
              .h = 0.01,
              .tol = 1e-6,
              .lower = -1,
              .upper = -1,
              .integrator = TSS_IMPLICIT_EULER};
    tss_subspace_def d = tss_subspace_def_default();
    tss_basis_def basis = tss_basis_skinning(8);
    const double still[3] = {0, -g * cos(tilt), 0}, sliding[3] = {g * sin(tilt), -g * cos(tilt), 0};
    scene a, b;
    double strain = 0;
    (void)state;
    make(&a, &p, &d);  // no basis: full space
    ok(a.w, tss_world_set_gravity(a.w, still));
    for (int k = 0; k < 150; k++) step(&a);
    for (int k = 0; k < 5; k++) ok(a.w, tss_world_set_dt(a.w, 0.1)), step(&a);
    p.integrator = TSS_BDF2, p.tol = 1e-3;
    d.on_oracle = keep_fields, d.on_oracle_ctx = &seen, d.partitions = 12, d.downdate = 0;
    make(&b, &p, &d);
    memset(&seen, 0, sizeof seen);
    seen.n = tss_world_nodes(b.w), seen.dim = 3;
    ok(b.w, tss_world_set_gravity(b.w, sliding));
    ok(b.w, tss_basis_add(b.w, 0, &basis, NULL));
    ok(b.w, tss_body_teleport(b.w, 0, tss_world_positions(a.w), NULL));
    for (int i = 0; i < seen.n; i++) {
        const double *x = tss_world_positions(b.w) + 3 * i, *X = tss_world_rest(b.w) + 3 * i;
        strain = fmax(strain, fabs(x[1] - X[1]) / 0.2);
    }
    for (int k = 0; k < 8; k++) {
        tss_step_info i = step(&b);
        if (k == 0) continue;
        assert_int_equal(i.enriched_nodes, 0);
    }
    double way = tss_world_positions(b.w)[0] - tss_world_positions(a.w)[0];
    print_message("    settled by %.0f %% of its height, slid %.3f m, largest error seen %.2f\n",
                  100 * strain, way, seen.most);
    near(way, g * sin(tilt) * 0.5 * 0.08 * 0.08, 0.15 * way);
    assert_true(strain > 0.1 && seen.most > d.error_nodes);
    drop(&a), drop(&b);
}

// ---- bad arguments ----------------------------------------------------------------------------

static void refused(tss_world *w, tss_result r, tss_result want, const char *word) {
    if (r != want || !strstr(tss_world_error(w), word))
        print_error("%s, expected %s: \"%s\" does not say \"%s\"\n", tss_result_text(r),
                    tss_result_text(want), tss_world_error(w), word);
    assert_int_equal(r, want);
    assert_non_null(strstr(tss_world_error(w), word));
}

static void test_bad_def(void **state) {
    const plan p = {.dim = 3, .n = 2, .bodies = 1, .lower = -1, .upper = -1};
    const tss_subspace_def good = tss_subspace_def_default();
    scene s;
    (void)state;
    make(&s, &p, &good);
    tss_subspace *sub = tss_subspace_of(s.w);
    assert_int_equal(tss_subspace_add(NULL, &good, NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_subspace_add(s.w, NULL, NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_subspace_set(NULL, &good), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_subspace_set(sub, NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_subspace_query(NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_null(tss_subspace_of(NULL));
    for (int k = 0; k < 16; k++) {
        static const char *const word[16] = {
            "default", "error_nodes", "error_nodes", "error_modes", "progress", "downdate",
            "mode",    "oracle",      "secant",      "schur",       "pcg_tol",  "pcg_tol",
            "pcg_tol", "keep",        "partitions",  "downdate"};
        tss_subspace_def d = good;
        if (k == 0) memset(&d, 0, sizeof d);
        if (k == 1) d.error_nodes = NAN;
        if (k == 2) d.error_nodes = -1;
        if (k == 3) d.error_modes = NAN;
        if (k == 4) d.progress = NAN;
        if (k == 5) d.downdate = NAN;
        if (k == 6) d.mode = (tss_mode)3;
        if (k == 7) d.oracle = (tss_oracle)-1;
        if (k == 8) d.secant = (tss_secant)7;
        if (k == 9) d.schur = (tss_schur)7;
        if (k == 10) d.pcg_tol = NAN;
        if (k == 11) d.pcg_tol = 0;
        if (k == 12) d.pcg_tol = 1;
        if (k == 13) d.keep = -1;
        if (k == 14) d.partitions = -1;
        if (k == 15) d.downdate = -1;
        refused(s.w, tss_subspace_set(sub, &d), TSS_ERROR_BAD_ARGUMENT, word[k]);
        refused(s.w, tss_subspace_add(s.w, &d, NULL), TSS_ERROR_BAD_ARGUMENT, word[k]);
        assert_ptr_equal(tss_subspace_of(s.w), sub);
    }
    drop(&s);
}

static void test_bad_basis(void **state) {
    const plan p = {.dim = 3, .n = 2, .bodies = 2, .lower = -1, .upper = -1, .custom = add_table};
    tss_subspace_def d = tss_subspace_def_default();
    tss_basis_def good = tss_basis_affine(), b;
    tss_basis_info info;
    tss_basis id = 7;
    double mode[3 * 27];
    scene s;
    (void)state;
    make(&s, &p, &d);
    ok(s.w, tss_body_remove(s.w, 1));
    assert_int_equal(tss_basis_add(NULL, 0, &good, NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_basis_add(s.w, 0, NULL, NULL), TSS_ERROR_BAD_ARGUMENT);
    refused(s.w, tss_basis_add(s.w, 9, &good, &id), TSS_ERROR_NOT_FOUND, "9");
    assert_int_equal(id, -1);
    refused(s.w, tss_basis_add(s.w, -1, &good, NULL), TSS_ERROR_NOT_FOUND, "-1");
    refused(s.w, tss_basis_add(s.w, 1, &good, NULL), TSS_ERROR_NOT_FOUND, "1");  // removed
    refused(s.w, tss_basis_add(s.w, 2, &good, NULL), TSS_ERROR_BAD_ARGUMENT,
            "cells");  // an obstacle
    memset(&b, 0, sizeof b);
    refused(s.w, tss_basis_add(s.w, 0, &b, NULL), TSS_ERROR_BAD_ARGUMENT, "cookie");
    b = tss_basis_skinning(0);
    refused(s.w, tss_basis_add(s.w, 0, &b, NULL), TSS_ERROR_BAD_ARGUMENT, "count");
    b = tss_basis_skinning(500);
    assert_true(tss_basis_add(s.w, 0, &b, NULL) != TSS_OK && tss_world_error(s.w)[0]);
    b = tss_basis_skinning(3), b.tol = NAN;
    refused(s.w, tss_basis_add(s.w, 0, &b, NULL), TSS_ERROR_BAD_ARGUMENT, "tol");
    b = tss_basis_affine(), b.initial = -2;
    refused(s.w, tss_basis_add(s.w, 0, &b, NULL), TSS_ERROR_BAD_ARGUMENT, "initial");
    b = tss_basis_custom(3, NULL, NULL, NULL);
    refused(s.w, tss_basis_add(s.w, 0, &b, NULL), TSS_ERROR_BAD_ARGUMENT, "refresh");
    b = tss_basis_pod(NULL, 3, 2);
    refused(s.w, tss_basis_add(s.w, 0, &b, NULL), TSS_ERROR_BAD_ARGUMENT, "snapshots");
    assert_int_equal(tss_world_bases(s.w), 0);
    ok(s.w, tss_basis_add(s.w, 0, &good, &id));
    assert_int_equal(id, 0);
    refused(s.w, tss_basis_remove(s.w, 1), TSS_ERROR_NOT_FOUND, "1");
    refused(s.w, tss_basis_remove(s.w, -1), TSS_ERROR_NOT_FOUND, "-1");
    assert_int_equal(tss_basis_remove(NULL, 0), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_basis_get(s.w, 1, &info), TSS_ERROR_NOT_FOUND);
    assert_int_equal(tss_basis_get(s.w, 0, NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_basis_mode(s.w, 0, 12, mode), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_basis_mode(s.w, 0, -1, mode), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_basis_mode(s.w, 0, 0, NULL), TSS_ERROR_BAD_ARGUMENT);
    ok(s.w, tss_basis_mode(s.w, 0, 11, mode));
    ok(s.w, tss_basis_remove(s.w, 0));
    refused(s.w, tss_basis_remove(s.w, 0), TSS_ERROR_NOT_FOUND, "0");
    assert_int_equal(tss_basis_get(s.w, 0, &info), TSS_ERROR_NOT_FOUND);
    drop(&s);
}

// A world without a solver: queries say so.
static void test_no_solver(void **state) {
    tss_world_def d = tss_world_def_default();
    tss_world *w;
    (void)state;
    assert_int_equal(tss_world_create(&d, &w), TSS_OK);
    assert_null(tss_subspace_of(w));
    assert_int_equal(tss_world_bases(w), 0);
    refused(w, tss_subspace_query(w), TSS_ERROR_NOT_FOUND, "basis");
    refused(w, tss_basis_remove(w, 0), TSS_ERROR_NOT_FOUND, "0");
    tss_world_destroy(w);
}

// A block of many functions: one column of it.
static void test_wide_block(void **state) {
    const plan p = {.dim = 3, .n = 4, .bodies = 1, .lower = -1, .upper = -1};
    enum { WIDE = 100, NODES = 125 };
    static double value[NODES * WIDE], mode[3 * NODES];
    static int block[WIDE];
    tss_subspace_def d = tss_subspace_def_default();
    scene s;
    (void)state;
    for (int k = 0; k < NODES * WIDE; k++) value[k] = k / WIDE == k % WIDE;
    make(&s, &p, &d);
    tss_basis_def b = tss_basis_arrays(WIDE, value, NULL, block);
    ok(s.w, tss_basis_add(s.w, 0, &b, NULL));
    ok(s.w, tss_basis_mode(s.w, 0, 3 * 99 + 1, mode));
    for (int i = 0; i < 3 * NODES; i++) near(mode[i], i == 3 * 99 + 1, 0);
    step(&s);
    drop(&s);
}

static void not_a_number(void *user, const tss_ctx *c, int first, int nodes, double *out) {
    (void)user, (void)c, (void)first;
    for (int k = 0; k < nodes * 3 * 2; k++) out[k] = k == 40 ? NAN : 1;
}

// Columns that are no numbers: an error or a status, and positions stay numbers.
static void test_bad_columns(void **state) {
    const plan p = {.dim = 3, .n = 3, .bodies = 1, .lower = -1, .upper = -1};
    tss_subspace_def d = tss_subspace_def_default();
    tss_basis_def b = tss_basis_custom(2, NULL, not_a_number, NULL);
    tss_step_info info;
    scene s;
    (void)state;
    make(&s, &p, &d);
    ok(s.w, tss_basis_add(s.w, 0, &b, NULL));
    tss_result r = tss_world_step(s.w, &info);
    print_message("    %s, %s\n", tss_result_text(r),
                  r == TSS_OK ? tss_status_text(info.status) : tss_world_error(s.w));
    for (int k = 0; k < unknowns(&s); k++) assert_true(isfinite(tss_world_positions(s.w)[k]));
    assert_true(r != TSS_OK || info.status != TSS_STEP_CONVERGED);
    drop(&s);
}

// A second solver must not take the bases of the first with it in silence.
static void test_second_solver(void **state) {
    const plan p = {.dim = 3, .n = 2, .bodies = 1, .lower = TSS_BASIS_AFFINE, .upper = -1};
    tss_subspace_def d = tss_subspace_def_default();
    scene s;
    (void)state;
    make(&s, &p, &d);
    tss_result r = tss_subspace_add(s.w, &d, NULL);
    assert_true(r == TSS_ERROR_BAD_ARGUMENT || tss_world_bases(s.w) == 1);
    assert_int_equal(tss_world_bases(s.w), 1);
    drop(&s);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_system),
        cmocka_unit_test(test_own_matrix),
        cmocka_unit_test(test_secants),
        cmocka_unit_test(test_block_errors),
        cmocka_unit_test(test_modal_gradients),
        cmocka_unit_test(test_skip_rule),
        cmocka_unit_test(test_full_limit),
        cmocka_unit_test(test_state_is_x),
        cmocka_unit_test(test_lag),
        cmocka_unit_test(test_ready),
        cmocka_unit_test(test_threads),
        cmocka_unit_test(test_units),
        cmocka_unit_test(test_resume),
        cmocka_unit_test(test_resume_and_set),
        cmocka_unit_test(test_rewind),
        cmocka_unit_test(test_damaged),
        cmocka_unit_test(test_cases),
        cmocka_unit_test(test_initial_zero),
        cmocka_unit_test(test_pile),
        cmocka_unit_test(test_memory),
        cmocka_unit_test(test_no_memory),
        cmocka_unit_test(test_query),
        cmocka_unit_test(test_tip),
        cmocka_unit_test(test_stiffness),
        cmocka_unit_test(test_ramp),
        cmocka_unit_test(test_bad_def),
        cmocka_unit_test(test_bad_basis),
        cmocka_unit_test(test_no_solver),
        cmocka_unit_test(test_wide_block),
        cmocka_unit_test(test_bad_columns),
        cmocka_unit_test(test_second_solver),
    };
    if (getenv("ONLY")) cmocka_set_test_filter(getenv("ONLY"));
    return cmocka_run_group_tests(tests, NULL, NULL);
}
