/* neural.h: `tss neural`, neural subspaces after paper B (a part of tss.c, of its own for length)

   tss neural train    SCENE [-o DIR] [--seed N] [--minutes M] [--method vanilla|lipschitz] ...
   tss neural run      SCENE [-o DIR] [--seed N] ...
   tss neural evaluate SCENE [-o DIR] [--seed N] ...
   tss neural measure  SCENE [-o DIR] [--seed N] ...
   tss neural bridge   SCENE [-o DIR] [--seed N] ...

   The scene's section "neural" (scene.h) says what is learned of its first body, and what happens to
   it, at random: handles (nodes that are told where to be) and pulls (forces). Full space and
   subspace have one energy, tss_neural_density; a shell and the penalty of a ball come into full space
   through the energy hook (neural_shell).

   train   1. supervised: sequences of frames in full space → DIR/frames.bin
           2. a linear basis of the frames (SVD in the mass norm) around both networks
           3. base_N.tssn: Eq. 3 or 4 alone, train.steps steps
           4. the cells that stand for all of them in L_LS (Eq. 11), by the subspace of 3
           5. vanilla_N.tssn and lipschitz_N.tssn: lipschitz.steps more steps from 3, without and with
              L_LS (Eq. 10)
           N is --seed. What is in DIR is gone on with: a run that was killed, or that --minutes
           stopped, is resumed by the same command. train_N.csv has what the curves need, and the
           seconds spent.
   run     the test sequences in full space and in each subspace: steps_N.csv, pictures, report.html
   evaluate the same, and Eq. 7 and projections of the test's states: a row a method is appended to
           DIR/evaluate.csv. --steps N: the first N of each sequence. --no-full: full space is what
           frames.bin has, not run and timed again

   measure what the cubature misses on the base, and what a training step costs: a row to
           DIR/measure.csv
   bridge  the test sequences by the adaptive simulator, with the decoder's tangent and other bases:
           rows to DIR/bridge.csv

   Eq. 3 costs only as much as the networks: x = x0 + B c with BᵀMB = s² I, so that ‖Δx‖²_M is s²‖Δc‖²
   but for what B does not reach, which no θ alters. Training sees c. s² is the mean of ‖x − x0‖²_M,
   and L_C therefore the share of the motion that is missed.                                       */

#define NEURAL_SNAPSHOTS 400  // frames whose Gram matrix is taken apart
#define NEURAL_SAMPLES 48     // frames of the estimate of Eq. 7 while training
#define NEURAL_FEW 8          // the same with more than NEURAL_MANY cells: at 50,000 and r 65 the
#define NEURAL_MANY 10000     // exact Hessian of one frame takes two seconds
#define NEURAL_SHARE 0.1      // none while estimates have taken more than this share of a phase

typedef enum neural_phase { NEURAL_BASE, NEURAL_VANILLA, NEURAL_LIPSCHITZ } neural_phase;
static const char *const neural_phases[] = {"base", "vanilla", "lipschitz"};

typedef struct neural {
    run *r;
    scene_neural *d;
    int dim, nodes, cells, n;  // n: coordinates
    double h, size;            // s, 0: quasi-static; longest side of the rest shape
    double *X, *x0, *mass;     // n each: rest, start, kg
    int *cell;
    double lame[2];
    int shell;            // the cells are triangles in space
    tss_elements **one;   // shell: an object a cell, for full space
    double *area;         // shell: of each node, m²
    int *every;           // node i: i
    tss_ball ball;        // where it is in the step at hand; radius 0: none
    double ball_stiffness, ball_margin;
    unsigned char *held;  // of each coordinate: not free
    int handles, *handle;  // nodes of all handles
    int pinned, *pin;      // their coordinates if L_LS and Eq. 7 see them where frames have them, else 0
    tss_elements *elements, *cubature;
    tss_work *work;
    // Frames, coordinate after coordinate: sequences of d->script.length.
    double *train, *test;
    int trains, tests;
    // x = x0 + B c, c = Aᵀ(x − x0): n × p, row-major. code: of the training frames, trains × p.
    // D: the decoder's last map, B diag(unit). unit: 1, or with pca.scale the root mean square of c's.
    int p;
    double *B, *A, *D, *unit, *code, *code_test;
    double prepared; // s of this run for the whitening and the cubature: of the Lipschitz phase's time
    double *T, *S;   // lipschitz.whiten: z = T y, y = S z; r × r
    double *before;  // n: full space one step ago, for a first guess of the next
    double left;    // largest distance of a node in what B misses, over size
    double deadline;  // of now()
    int terminal, stopped;  // stopped: by the deadline
    double shown;     // when progress was last shown
} neural;

// ---------------------------------------------------------------------------------------------
// >>neural_system: the body as the learner sees it
// ---------------------------------------------------------------------------------------------

// A bar on a terminal, else a line every ten seconds.
static void neural_progress(neural *v, double done, const char *format, ...) {
    char text[240], bar[31];
    va_list args;
    double t = now(NULL);
    if (done < 1 && t < v->shown + (v->terminal ? 0.2 : 10)) return;
    v->shown = t;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    for (int k = 0; k < 30; k++) bar[k] = 30 * done > k ? '#' : '.';
    bar[30] = 0;
    if (v->terminal)
        fprintf(stderr, "\r[%s] %s\033[K%s", bar, text, done >= 1 ? "\n" : "");
    else
        fprintf(stderr, "%5.1f%% %s\n", 100 * done, text);
}

static int neural_late(neural *v) {
    v->stopped |= now(NULL) >= v->deadline;
    return v->stopped;
}

static int neural_check(run *r) {
    const scene *s = &r->s;
    if (!s->neural.given)
        return fail(r, "%s: expected a section \"neural\" (docs/neural.md)", r->o.scene);
    if (s->bodies != 1 || s->body[0].obstacle || s->body[0].E || s->planes)
        return fail(r, "%s: neural: expected one soft body of one material, and no planes", r->o.scene);
    if (s->world.integrator != TSS_QUASISTATIC && s->world.integrator != TSS_IMPLICIT_EULER)
        return fail(r, "%s: world.integrator is \"%s\", expected \"quasistatic\" or \"euler\" with neural",
                    r->o.scene, scene__integrators[s->world.integrator]);
    if (s->contact.enabled)
        return fail(r, "%s: contact.enabled is true, expected false with neural", r->o.scene);
    if (s->body[0].bases || s->body[0].forces || s->body[0].motion.moves)
        return fail(r, "%s: bodies[0]: expected no basis, forces or motion with neural; its script "
                       "has handles and pulls", r->o.scene);
    for (int k = 0; k < s->body[0].pins; k++)
        if (s->body[0].pin[k].motion.moves)
            return fail(r, "%s: bodies[0].pins[%d].motion: expected neural.script.handles", r->o.scene, k);
    return 1;
}

static void neural_take_body(neural *v) {
    const scene_body *b = &v->r->s.body[0];
    const tss_mesh *m = &b->mesh;
    double lo[3], hi[3];
    v->dim = v->r->s.world.dim, v->nodes = m->nodes, v->n = v->nodes * v->dim;
    v->shell = b->shell > 0;
    v->cells = v->dim == 3 && !v->shell ? m->tets : m->triangles;
    v->h = v->r->s.world.integrator == TSS_QUASISTATIC ? 0 : v->r->s.world.dt;
    size_t n = (size_t)v->n, corners = (size_t)v->cells * (size_t)(v->dim + !v->shell);
    v->X = (double *)need(n, sizeof(double)), v->x0 = (double *)need(n, sizeof(double));
    v->mass = (double *)need(n, sizeof(double)), v->cell = (int *)need(corners, sizeof(int));
    v->before = (double *)need(n, sizeof(double)), v->held = (unsigned char *)need(n, 1), v->handle = (int *)need((size_t)v->nodes, sizeof(int));
    const double *rest = b->rest ? b->rest : m->x;
    for (int i = 0; i < v->n; i++) {
        v->X[i] = rest[3 * (i / v->dim) + i % v->dim];
        v->x0[i] = m->x[3 * (i / v->dim) + i % v->dim];
    }
    memcpy(v->cell, v->dim == 3 && !v->shell ? m->tet : m->triangle, corners * sizeof(int));
    scene__box_empty(lo, hi);
    scene__box(rest, m->nodes, lo, hi);
    for (int c = 0; c < 3; c++) v->size = fmax(v->size, hi[c] - lo[c]);
    for (int k = 0; k < b->pins; k++)
        for (int i = 0; i < b->pin[k].nodes; i++)
            for (int c = 0; c < v->dim; c++)
                v->held[b->pin[k].node[i] * v->dim + c] |= b->pin[k].axes >> c & 1;
}

static int neural_take_handles(neural *v) {
    unsigned char *of = (unsigned char *)need((size_t)v->nodes, 1);
    int ok = 1;
    for (int k = 0; ok && k < v->d->script.handles; k++) {
        const scene_handle *h = &v->d->script.handle[k];
        for (int i = 0; ok && i < h->nodes; i++) {
            if (of[h->node[i]])
                ok = fail(v->r, "%s: neural.script.handles[%d]: node %d is in handles[%d] too", v->r->o.scene,
                          k, h->node[i], of[h->node[i]] - 1);
            of[h->node[i]] = (unsigned char)(k + 1);
            v->handle[v->handles++] = h->node[i];
            for (int c = 0; c < v->dim; c++) v->held[h->node[i] * v->dim + c] = 1;
        }
    }
    free(of);
    return ok;
}

static tss_elements_def neural_elements(const neural *v) {
    const tss_material *m = &v->r->s.body[0].material;
    tss_elements_def d = tss_elements_def_default();
    d.dim = v->dim, d.nodes = v->nodes, d.X = v->X, d.cells = v->cells, d.cell = v->cell;
    d.E = m->E, d.nu = m->nu, d.shell = v->r->s.body[0].shell, d.bending = v->r->s.body[0].bending;
    return d;
}

// ---------------------------------------------------------------------------------------------
// >>neural_shell: tss.h has no membrane of this density, so that full space gets it through the energy
// hook, a stencil a triangle, evaluated by the learner's own elements of that triangle; hinges are
// tss_hinge_energy's (½ k there, k here); contact is the penalty of tss_reduced, a stencil a node.
// ---------------------------------------------------------------------------------------------

static tss_result neural_cell_lists(void *user, const tss_ctx *c, const double *x, const double *d, double t, tss_stencils *out) {
    const neural *v = (const neural *)user;
    (void)c, (void)x, (void)d, (void)t;
    out->count = v->cells, out->node = v->cell, out->pattern = 1;
    return TSS_OK;
}

static int neural_id(tss_ids ids, int k) { return ids.list ? ids.list[k] : ids.first + k; }

static void neural_corners(const neural *v, int cell, const double *x, double y[9]) {
    for (int i = 0; i < 9; i++) y[i] = x[3 * v->cell[3 * cell + i / 3] + i % 3];
}

static void neural_cell_value(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const neural *v = (const neural *)user;
    double y[9];
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        neural_corners(v, neural_id(ids, k), x, y);
        out[k] = tss_elements_potential(v->one[neural_id(ids, k)], y, NULL);
    }
}

static void neural_cell_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const neural *v = (const neural *)user;
    double y[9];
    (void)c;
    memset(out, 0, 9 * (size_t)ids.count * sizeof *out);
    for (int k = 0; k < ids.count; k++) {
        neural_corners(v, neural_id(ids, k), x, y);
        (void)tss_elements_potential(v->one[neural_id(ids, k)], y, out + 9 * k);
    }
}

static void neural_jacobi(int m, double *a, double *e);

// H (9 × 9) with its negative eigenvalues put to 0.
static void neural_project_psd(double *H) {
    double a[81], e[81];
    memcpy(a, H, sizeof a);
    neural_jacobi(9, a, e);
    memset(H, 0, sizeof a);
    for (int k = 0; k < 9; k++)
        for (int i = 0; i < 81 && a[10 * k] > 0; i++) H[i] += a[10 * k] * e[9 * k + i / 9] * e[9 * k + i % 9];
}

// P2 = ½ Σ_a ∂_a²P along x1 = I, and its gradient in x1_a is H e_a.
static void neural_cell_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids, int psd, double *out) {
    const neural *v = (const neural *)user;
    double y[9], I[81], half[81];
    (void)c;
    for (int i = 0; i < 81; i++) I[i] = i % 10 == 0, half[i] = 0.5 * I[i];
    memset(out, 0, 81 * (size_t)ids.count * sizeof *out);
    for (int k = 0; k < ids.count; k++) {
        double zero[9] = {0}, P, P1[9], P2;
        neural_corners(v, neural_id(ids, k), x, y);
        (void)tss_elements_jets(v->one[neural_id(ids, k)], 9, y, I, half, zero, &P, P1, &P2, 0, NULL, 1, NULL, out + 81 * k, NULL);
        if (psd) neural_project_psd(out + 81 * k);
    }
}

static tss_result neural_ball_lists(void *user, const tss_ctx *c, const double *x, const double *d, double t, tss_stencils *out) {
    const neural *v = (const neural *)user;
    (void)c, (void)x, (void)d, (void)t;
    out->count = v->nodes, out->node = v->every, out->pattern = 1;
    return TSS_OK;
}

// How far node i is inside of the margin, <= 0, and the direction out.
static double neural_inside(const neural *v, int i, const double *x, double n[3]) {
    tss_ball ball = v->ball;
    return fmin(0, tss_sdf_ball(&ball, x + 3 * i, n) - v->ball_margin);
}

static void neural_ball_value(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const neural *v = (const neural *)user;
    double n[3];
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        double d = neural_inside(v, neural_id(ids, k), x, n);
        out[k] = 0.5 * v->ball_stiffness * v->area[neural_id(ids, k)] * d * d;
    }
}

static void neural_ball_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const neural *v = (const neural *)user;
    double n[3];
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        double d = neural_inside(v, neural_id(ids, k), x, n);
        for (int i = 0; i < 3; i++) out[3 * k + i] = v->ball_stiffness * v->area[neural_id(ids, k)] * d * n[i];
    }
}

// With ∇²φ = (I − n nᵀ)/‖x − center‖ unless it is to be positive: d < 0.
static void neural_ball_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids, int psd, double *out) {
    const neural *v = (const neural *)user;
    double n[3];
    (void)c;
    for (int k = 0; k < ids.count; k++) {
        double d = neural_inside(v, neural_id(ids, k), x, n), a = v->ball_stiffness * v->area[neural_id(ids, k)];
        double bend = psd || d == 0 ? 0 : d / (d + v->ball_margin + v->ball.radius);
        for (int i = 0; i < 9; i++)
            out[9 * k + i] = d < 0 ? a * (n[i / 3] * n[i % 3] + bend * ((i % 4 == 0) - n[i / 3] * n[i % 3])) : 0;
    }
}

// Each edge of two cells: (a, b), the third node of the cell that has a → b, and of the other. -1: two
// cells go along an edge the same way.
static int neural_hinges(const neural *v, int *hinge) {
    int *next = (int *)need((size_t)(3 * v->cells), sizeof *next), *first = (int *)need((size_t)v->nodes, sizeof *first), n = 0;
    for (int i = 0; i < v->nodes; i++) first[i] = -1;
    for (int k = 0; k < 3 * v->cells && n >= 0; k++) {  // corner k starts the edge to the next corner
        int t = k - k % 3, a = v->cell[k], b = v->cell[t + (k + 1) % 3];
        for (int q = first[b]; q >= 0; q = next[q])
            if (v->cell[q - q % 3 + (q + 1) % 3] == a) {
                int h[4] = {b, a, v->cell[q - q % 3 + (q + 2) % 3], v->cell[t + (k + 2) % 3]};
                memcpy(hinge + 4 * n++, h, sizeof h);
            }
        for (int q = first[a]; q >= 0; q = next[q])
            if (v->cell[q - q % 3 + (q + 1) % 3] == b) n = -1;
        next[k] = first[a], first[a] = k;
    }
    free(next), free(first);
    return n;
}

static int neural_add(neural *v, tss_world *w, const tss_energy_def *d) {
    return tss_energy_add(w, d, NULL) == TSS_OK ? 1 : fail(v->r, "%s: %s", v->r->o.scene, tss_world_error(w));
}

static int neural_add_bending(neural *v, tss_world *w) {
    tss_hinge_def h = tss_hinge_def_default();
    tss_energy_def d = tss_energy_def_default();
    int *hinge = (int *)need((size_t)(12 * v->cells), sizeof *hinge);
    h.hinges = neural_hinges(v, hinge), h.node = hinge, h.X = v->X, h.stiffness = 2 * v->r->s.body[0].bending;
    int ok = h.hinges >= 0 || fail(v->r, "%s: bodies[0].shell: two triangles go along an edge the same way", v->r->o.scene);
    tss_host host = tss_host_default();
    host.log = print_log;
    if (ok && h.hinges > 0 && tss_hinge_energy(&host, &h, &d) != TSS_OK) ok = fail(v->r, "%s: bodies[0].shell.bending is refused", v->r->o.scene);
    ok = ok && (h.hinges == 0 || neural_add(v, w, &d));
    free(hinge);
    return ok;
}

static int neural_add_membranes(neural *v, tss_world *w) {
    tss_energy_def d = tss_energy_def_default();
    tss_elements_def ed = neural_elements(v);
    static const int corner[3] = {0, 1, 2};
    double y[9];
    ed.nodes = 3, ed.X = y, ed.cells = 1, ed.cell = corner, ed.bending = 0;
    v->one = (tss_elements **)need((size_t)v->cells, sizeof *v->one);
    for (int k = 0; k < v->cells; k++) {
        neural_corners(v, k, v->X, y);
        if (tss_elements_create(NULL, &ed, &v->one[k]) != TSS_OK) return fail(v->r, "%s: triangle %d of the first body has no area", v->r->o.scene, k);
    }
    d.name = "membrane", d.arity = 3, d.flags = TSS_ENERGY_TIMES_AH2, d.user = v;
    d.lists = neural_cell_lists, d.value = neural_cell_value, d.gradient = neural_cell_gradient, d.hessian = neural_cell_hessian;
    return neural_add(v, w, &d);
}

// The world's masses are there.
static int neural_shell(neural *v, tss_world *w) {
    const scene_body *b = &v->r->s.body[0];
    tss_energy_def d = tss_energy_def_default();
    v->area = (double *)need((size_t)v->nodes, sizeof *v->area), v->every = (int *)need((size_t)v->nodes, sizeof *v->every);
    for (int i = 0; i < v->nodes; i++) v->area[i] = v->mass[3 * i] / (b->material.rho * b->shell), v->every[i] = i;
    if (!neural_add_membranes(v, w) || (b->bending > 0 && !neural_add_bending(v, w))) return 0;
    d.name = "ball", d.arity = 1, d.flags = TSS_ENERGY_TIMES_AH2, d.user = v;
    d.lists = neural_ball_lists, d.value = neural_ball_value, d.gradient = neural_ball_gradient, d.hessian = neural_ball_hessian;
    return v->ball.radius == 0 || neural_add(v, w, &d);
}

// A world of the scene with the learner's energy.
static int neural_world(neural *v, tss_world **w) {
    tss_material *m = &v->r->s.body[0].material;
    tss_ipc *ipc;
    if (!v->shell) m->kind = TSS_CUSTOM_MATERIAL, m->density = tss_neural_density;
    if (!v->shell) m->user = v->lame, m->has_C = 1, m->barrier = 0;
    return build_world(v->r, w, &ipc);
}

static int neural_open(run *r, neural *v) {
    memset(v, 0, sizeof *v);
    v->r = r, v->d = &r->s.neural, v->terminal = isatty(2);
    v->deadline = r->o.minutes > 0 ? now(NULL) + 60 * r->o.minutes : INFINITY;
    if (!read_scene(r) || !neural_check(r) || !make_folder(r, out_folder(r))) return 0;
    tss_material *m = &r->s.body[0].material;
    m->damping = 0;
    v->lame[0] = m->E / (2 * (1 + m->nu)), v->lame[1] = m->E * m->nu / ((1 + m->nu) * (1 - 2 * m->nu));
    neural_take_body(v);
    if (!neural_take_handles(v) || !neural_world(v, &r->w)) return 0;
    for (int i = 0; i < v->n; i++) v->mass[i] = tss_world_masses(r->w)[i / v->dim];
    v->pinned = v->d->unsupervised || !v->d->lipschitz.handles ? 0 : v->dim * v->handles;
    v->pin = (int *)need((size_t)(v->dim * v->handles), sizeof(int));
    for (int i = 0; i < v->dim * v->handles; i++) v->pin[i] = v->dim * v->handle[i / v->dim] + i % v->dim;
    v->ball.dim = 3, v->ball.radius = v->d->script.ball.radius;
    v->ball_stiffness = v->d->script.ball.stiffness, v->ball_margin = v->d->script.ball.margin;
    memcpy(v->ball.center, v->d->script.ball.center[0], sizeof v->ball.center);
    if (v->ball.radius > 0 && !v->shell)
        return fail(r, "%s: neural.script.ball: expected a first body with \"shell\"", r->o.scene);
    if (v->shell && !neural_shell(v, r->w)) return 0;
    tss_elements_def d = neural_elements(v);
    tss_host host = tss_host_default();
    host.log = print_log, host.workers = r->o.threads;
    if (tss_elements_create(&host, &d, &v->elements) != TSS_OK || tss_work_create(&host, &v->work) != TSS_OK)
        return fail(r, "%s: the first body's mesh or material is not for neural.system", r->o.scene);
    if (v->d->lipschitz.probes > v->d->r)
        return fail(r, "%s: neural.lipschitz.probes is %d, expected at most neural.r (%d)", r->o.scene,
                    v->d->lipschitz.probes, v->d->r);
    if (v->d->train.start && v->d->unsupervised)
        return fail(r, "%s: neural.train.start is \"linear\", expected \"random\" where nothing is supervised", r->o.scene);
    if (v->d->lipschitz.whiten_end && v->d->unsupervised)
        return fail(r, "%s: neural.lipschitz.whiten_end is true, expected false where nothing is supervised", r->o.scene);
    if (v->d->lipschitz.unit != 1 && !v->d->lipschitz.whiten)
        return fail(r, "%s: neural.lipschitz.unit is %g, expected 1 without whiten", r->o.scene, v->d->lipschitz.unit);
    for (int k = 0; v->d->train.start && k < v->d->layers; k++)
        if (v->d->hidden[k] < v->d->r)
            return fail(r, "%s: neural.hidden[%d] is %d, expected at least neural.r (%d) with train.start \"linear\"", r->o.scene, k,
                        v->d->hidden[k], v->d->r);
    if (v->d->lipschitz.window && v->d->lipschitz.batch % 4)
        return fail(v->r, "%s: neural.lipschitz.batch is %d, expected a multiple of 4 with window", v->r->o.scene,
                    v->d->lipschitz.batch);
    return 1;
}

static void neural_close(neural *v) {
    free(v->X), free(v->x0), free(v->mass), free(v->cell), free(v->held), free(v->handle), free(v->pin), free(v->before);
    for (int k = 0; v->one && k < v->cells; k++) tss_elements_destroy(v->one[k]);
    free(v->one), free(v->area), free(v->every);
    free(v->train), free(v->test), free(v->B), free(v->A), free(v->D), free(v->unit), free(v->code), free(v->code_test);
    free(v->T), free(v->S);
    tss_elements_destroy(v->elements), tss_elements_destroy(v->cubature), tss_work_destroy(v->work);
}

// ---------------------------------------------------------------------------------------------
// >>neural_script: what happens, at random. A sequence depends on its number and script.seed alone.
// ---------------------------------------------------------------------------------------------

typedef struct neural_script {
    int length;
    double *pose;  // length × handles × 6: translation, rotation
    double *force;  // length × pulls × 3
    double *center;  // length × 3: of the ball
} neural_script;

static int neural_hold(const neural *v, tss_rng *rng) {
    int lo = (int)v->d->script.hold[0], hi = (int)v->d->script.hold[1];
    return lo + (int)((hi - lo + 1) * tss_rng_uniform(rng));
}

static void neural_ball_path(const neural *v, tss_rng *rng, neural_script *s) {
    double(*box)[3] = v->d->script.ball.center;
    double from[3], to[3];
    s->center = (double *)need(3 * (size_t)s->length, sizeof *s->center);
    memcpy(from, box[0], sizeof from);
    for (int at = 0; at < s->length && v->ball.radius > 0; memcpy(from, to, sizeof from)) {
        int steps = neural_hold(v, rng);
        for (int c = 0; c < 3; c++) to[c] = box[0][c] + (box[1][c] - box[0][c]) * tss_rng_uniform(rng);
        for (int j = 1; j <= steps && at < s->length; j++, at++)
            for (int c = 0; c < 3; c++) s->center[3 * at + c] = from[c] + (to[c] - from[c]) * j / steps;
    }
}

// Handles walk from target to target on straight lines, all at once. Pulls come and go, each of its own.
static neural_script neural_script_of(const neural *v, int sequence) {
    const scene_neural *d = v->d;
    int handles = d->script.handles, pulls = d->script.pulls, length = d->script.length;
    tss_rng rng = tss_rng_seed((uint64_t)d->script.seed * 1000003u + (uint64_t)sequence);
    neural_script s = {length, NULL, NULL, NULL};
    s.pose = (double *)need((size_t)length * (size_t)handles * 6, sizeof(double));
    s.force = (double *)need((size_t)length * (size_t)pulls * 3, sizeof(double));
    double *from = (double *)need((size_t)handles * 12, sizeof(double)), *to = from + 6 * handles;
    for (int at = 0; at < length && handles > 0;) {
        int steps = neural_hold(v, &rng);
        for (int k = 0; k < 6 * handles; k++) {
            const scene_handle *h = &d->script.handle[k / 6];
            const double(*box)[3] = k % 6 < 3 ? h->translate : h->rotate;
            to[k] = box[0][k % 3] + (box[1][k % 3] - box[0][k % 3]) * tss_rng_uniform(&rng);
        }
        for (int j = 1; j <= steps && at < length; j++, at++)
            for (int k = 0; k < 6 * handles; k++)
                s.pose[6 * handles * at + k] = from[k] + (to[k] - from[k]) * j / steps;
        memcpy(from, to, 6 * (size_t)handles * sizeof *to);
    }
    for (int k = 0; k < pulls; k++)
        for (int at = 0, on = 1; at < length; on = !on) {
            int steps = neural_hold(v, &rng);
            double f[3];
            for (int c = 0; c < 3; c++)
                f[c] = on * d->script.pull[k].force[c] * (2 * tss_rng_uniform(&rng) - 1);
            for (int j = 0; j < steps && at < length; j++, at++)
                memcpy(s.force + 3 * (pulls * at + k), f, sizeof f);
        }
    neural_ball_path(v, &rng, &s);
    free(from);
    return s;
}

static void neural_script_free(neural_script *s) { free(s->pose), free(s->force), free(s->center); }

// Where the handles' nodes are at step k: handles × dim, in the order of v->handle.
static void neural_targets(const neural *v, const neural_script *s, int k, double *out) {
    for (int q = 0, at = 0; q < v->d->script.handles; q++) {
        const scene_handle *h = &v->d->script.handle[q];
        const double *p = s->pose + 6 * (v->d->script.handles * k + q);
        double mid[3] = {0, 0, 0}, lo[3], hi[3], R[9], from[3], to;
        scene__turn(p + 3, R);
        scene__box_empty(lo, hi);
        for (int i = 0; i < h->nodes; i++)
            for (int c = 0; c < v->dim; c++) {
                lo[c] = fmin(lo[c], v->x0[v->dim * h->node[i] + c]);
                hi[c] = fmax(hi[c], v->x0[v->dim * h->node[i] + c]);
            }
        for (int c = 0; c < v->dim; c++) mid[c] = 0.5 * (lo[c] + hi[c]);
        for (int i = 0; i < h->nodes; i++, at++) {
            for (int c = 0; c < 3; c++) from[c] = c < v->dim ? v->x0[v->dim * h->node[i] + c] - mid[c] : 0;
            for (int c = 0; c < v->dim; c++) {
                to = R[3 * c] * from[0] + R[3 * c + 1] * from[1] + R[3 * c + 2] * from[2];
                out[v->dim * at + c] = mid[c] + to + p[c];
            }
        }
    }
}

// Forces on the coordinates at step k, gravity among them if asked for: the world has its own.
static void neural_forces(const neural *v, const neural_script *s, int k, int gravity, double *out) {
    for (int i = 0; i < v->n; i++) out[i] = gravity ? v->mass[i] * v->r->s.world.gravity[i % v->dim] : 0;
    for (int q = 0; q < v->d->script.pulls; q++) {
        const scene_pull *p = &v->d->script.pull[q];
        const double *f = s->force + 3 * (v->d->script.pulls * k + q);
        for (int i = 0; i < p->nodes; i++)
            for (int c = 0; c < v->dim; c++) out[v->dim * p->node[i] + c] += f[c] / p->nodes;
    }
}

// Whether steps k − 2, k − 1, k go on evenly: Newton's method then starts from 2 x_t − x_{t−1}.
static int neural_even(const neural *v, const neural_script *s, int k) {
    int n = 6 * v->d->script.handles;
    const double *p = s->pose + n * k;
    for (int i = 0; i < n && k >= 2; i++)
        if (fabs(p[i] - 2 * p[i - n] + p[i - 2 * n]) > 1e-9) return 0;
    return k >= 2 && n > 0 && v->h == 0;
}

// Before step k: where the script goes on evenly, the world starts from 2x_t − x_{t−1}. before: x_{t−1},
// then x_t. room: n.
static int neural_predict(neural *v, tss_world *w, double *before, const neural_script *s, int k, double *room) {
    const double *x = tss_world_positions(w);
    for (int i = 0; i < v->n; i++) {
        room[i] = 2 * x[i] - before[i];
        before[i] = x[i];
    }
    if (!neural_even(v, s, k) || tss_body_teleport(w, 0, room, NULL) == TSS_OK) return 1;
    return fail(v->r, "%s: step %d: %s", v->r->o.scene, k + 1, tss_world_error(w));
}

// Step k in a world; who: for messages. room: n.
static int neural_world_step(neural *v, tss_world *w, const char *who, const neural_script *s, int k, double *room, tss_step_info *info) {
    tss_result e = TSS_OK;
    neural_targets(v, s, k, room);
    for (int i = 0; i < v->handles && e == TSS_OK; i++)
        e = tss_node_target(w, v->handle[i], room + v->dim * i);
    neural_forces(v, s, k, 0, room);
    for (int q = 0; q < v->d->script.pulls; q++)
        for (int i = 0; i < v->d->script.pull[q].nodes && e == TSS_OK; i++) {
            int node = v->d->script.pull[q].node[i];
            e = tss_node_force(w, node, room + v->dim * node);
        }
    if (e == TSS_OK) e = tss_world_step(w, info);
    return e == TSS_OK ? 1 : fail(v->r, "%s: %s, step %d: %s", v->r->o.scene, who, k + 1, tss_world_error(w));
}

static int neural_full_step(neural *v, const neural_script *s, int k, double *room, tss_step_info *info) {
    memcpy(v->ball.center, s->center + 3 * k, sizeof v->ball.center);
    return neural_predict(v, v->r->w, v->before, s, k, room) && neural_world_step(v, v->r->w, "full space", s, k, room, info);
}

// ---------------------------------------------------------------------------------------------
// >>neural_frames: DIR/frames.bin, 4 64-bit numbers (magic, hash of what the frames follow from,
// coordinates, frames a sequence), then doubles. Sequence 0 .. test − 1 are tests, the rest trains.
// ---------------------------------------------------------------------------------------------

static uint64_t neural_hash(uint64_t h, const void *data, size_t bytes) {  // FNV-1a
    const unsigned char *c = (const unsigned char *)data;
    for (size_t i = 0; i < bytes; i++) h = (h ^ c[i]) * 1099511628211u;
    return h;
}

static uint64_t neural_signature(const neural *v) {
    const scene *s = &v->r->s;
    uint64_t h = 14695981039346656037u;
    size_t n = (size_t)v->n * sizeof(double);
    h = neural_hash(neural_hash(neural_hash(h, v->X, n), v->x0, n), v->mass, n);
    h = neural_hash(neural_hash(h, v->lame, sizeof v->lame), &v->h, sizeof v->h);
    h = neural_hash(neural_hash(h, s->world.gravity, sizeof s->world.gravity), v->held, (size_t)v->n);
    if (v->shell) {
        const double thin[] = {s->body[0].shell, s->body[0].bending, v->ball.radius, v->ball_stiffness, v->ball_margin};
        h = neural_hash(h, thin, sizeof thin);
    }
    for (int k = 0; k < v->d->script.test; k += k ? k : 1) {  // the scripts themselves, of a few
        neural_script q = neural_script_of(v, k);
        h = neural_hash(h, q.pose, (size_t)q.length * (size_t)v->d->script.handles * 6 * sizeof(double));
        if (v->shell) h = neural_hash(h, q.center, 3 * (size_t)q.length * sizeof(double));
        h = neural_hash(h, q.force, (size_t)q.length * (size_t)v->d->script.pulls * 3 * sizeof(double));
        neural_script_free(&q);
    }
    return h;
}

// Opens the file to append to; *done: whole sequences in it.
static FILE *neural_frames_open(neural *v, int *done) {
    char path[700];
    uint64_t head[4] = {0x31534d4152465354u, neural_signature(v), (uint64_t)v->n, (uint64_t)v->d->script.length}, got[4];
    size_t each = (size_t)v->n * (size_t)v->d->script.length * sizeof(double);
    snprintf(path, sizeof path, "%s/frames.bin", v->r->o.out);
    FILE *f = fopen(path, "r+b");
    *done = 0;
    if (f && fread(got, sizeof got, 1, f) == 1) {
        if (memcmp(got, head, sizeof got) != 0) {
            fail(v->r, "%s: frames of another scene or script; expected those of %s (choose another -o, or "
                       "remove the file)", path, v->r->o.scene);
            return fclose(f), (FILE *)NULL;
        }
        fseek(f, 0, SEEK_END);
        *done = (int)(((size_t)ftell(f) - sizeof head) / each);
        fseek(f, (long)(sizeof head + (size_t)*done * each), SEEK_SET);
        return f;
    }
    if (f) fclose(f);
    f = fopen(path, "w+b");
    if (!f || fwrite(head, sizeof head, 1, f) != 1) {
        fail(v->r, "%s: cannot be written: %s", path, strerror(errno));
        if (f) fclose(f);
        return NULL;
    }
    return f;
}

// The world's state before the first step of each sequence.
typedef struct neural_start {
    void *data;
    size_t size;
} neural_start;

static int neural_sequence(neural *v, const neural_start *start, int number, double *out, int *failed) {
    neural_script s = neural_script_of(v, number);
    double *room = (double *)need((size_t)v->n, sizeof *room);
    tss_step_info info;
    int ok = load_world(v->r, v->r->w, start->data, start->size);
    for (int k = 0; ok && k < s.length; k++) {
        ok = neural_full_step(v, &s, k, room, &info);
        if (ok) memcpy(out + (size_t)v->n * (size_t)k, tss_world_positions(v->r->w), (size_t)v->n * sizeof *out);
        *failed += ok && info.status != TSS_STEP_CONVERGED;
    }
    free(room), neural_script_free(&s);
    return ok;
}

// Frames of `test` and, if supervised, `train` sequences; 1 and v->stopped if the time is up before.
static int neural_frames(neural *v) {
    const scene_neural *d = v->d;
    int done, failed = 0, wanted = d->script.test + (d->unsupervised ? 0 : d->script.train), ok = 1;
    size_t each = (size_t)v->n * (size_t)d->script.length;
    neural_start start = {NULL, 0};
    FILE *f = neural_frames_open(v, &done);
    if (!f) return 0;
    double *room = (double *)need(each, sizeof *room), began = now(NULL);
    int had = done;
    start.data = save_world(v->r->w, &start.size);
    for (; ok && done < wanted && !neural_late(v); done++) {
        ok = neural_sequence(v, &start, done, room, &failed);
        if (ok && (fwrite(room, sizeof *room, each, f) != each || fflush(f) != 0))
            ok = fail(v->r, "%s/frames.bin: cannot be written: %s", v->r->o.out, strerror(errno));
        double left = (now(NULL) - began) * (wanted - done - 1) / (done + 1 - had);
        neural_progress(v, (done + 1.0) / wanted, "frames %d of %d, %d steps not converged, %.0f s left",
                        (done + 1) * d->script.length, wanted * d->script.length, failed, left);
    }
    if (ok && done > had)
        printf("frames: %d in %.1f s, %d steps not converged\n", (done - had) * d->script.length,
               now(NULL) - began, failed);
    if (ok && !v->stopped) {
        v->tests = d->script.test * d->script.length, v->trains = (wanted - d->script.test) * d->script.length;
        v->test = (double *)need((size_t)v->tests * (size_t)v->n, sizeof(double));
        v->train = (double *)need((size_t)v->trains * (size_t)v->n, sizeof(double));
        ok = fseek(f, 4 * (long)sizeof(uint64_t), SEEK_SET) == 0 &&
             fread(v->test, sizeof(double) * (size_t)v->n, (size_t)v->tests, f) == (size_t)v->tests &&
             fread(v->train, sizeof(double) * (size_t)v->n, (size_t)v->trains, f) == (size_t)v->trains;
        if (!ok) fail(v->r, "%s/frames.bin: cannot be read", v->r->o.out);
    }
    fclose(f), free(room), free(start.data);
    return ok;
}

// ---------------------------------------------------------------------------------------------
// >>neural_basis: SVD of x − x0 in the mass norm, not centred, by the Gram matrix of some frames
// ---------------------------------------------------------------------------------------------

// Eigenvalues of symmetric a (m × m, destroyed) to its diagonal, vectors to the columns of e: Jacobi.
static void neural_jacobi(int m, double *a, double *e) {
    for (int i = 0; i < m * m; i++) e[i] = i % (m + 1) == 0;
    for (int pass = 0; pass < 30; pass++) {
        double off = 0, all = 0;
        for (int i = 0; i < m * m; i++) all += a[i] * a[i], off += i % (m + 1) ? a[i] * a[i] : 0;
        if (off <= 1e-28 * all) return;
        for (int p = 0; p < m; p++)
            for (int q = p + 1; q < m; q++) {
                double g = a[p * m + q];
                if (g * g <= 1e-34 * fabs(a[p * m + p] * a[q * m + q])) continue;
                double tau = (a[q * m + q] - a[p * m + p]) / (2 * g);
                double t = (tau >= 0 ? 1 : -1) / (fabs(tau) + sqrt(1 + tau * tau)), c = 1 / sqrt(1 + t * t), s = t * c;
                double *ap = a + p * m, *aq = a + q * m, *ep = e + p * m, *eq = e + q * m;
                for (int k = 0; k < m; k++) {  // rows; e holds vectors as rows
                    double u = ap[k], w = aq[k], x = ep[k], y = eq[k];
                    ap[k] = c * u - s * w, aq[k] = s * u + c * w;
                    ep[k] = c * x - s * y, eq[k] = s * x + c * y;
                }
                for (int k = 0; k < m; k++) {
                    double u = a[k * m + p], w = a[k * m + q];
                    a[k * m + p] = c * u - s * w, a[k * m + q] = s * u + c * w;
                }
            }
    }
}

// Mode k of the chosen frames, M-orthonormal, to u (n); 0: there is none.
static int neural_mode(const neural *v, int m, const double *value, const double *vector, const int *order,
                       int k, double *u) {
    double l = k < m ? value[order[k] * (m + 1)] : 0;
    if (!(l > 1e-14 * value[order[0] * (m + 1)])) return 0;
    memset(u, 0, (size_t)v->n * sizeof *u);
    for (int i = 0; i < m; i++) {
        const double *x = v->train + (size_t)v->n * (size_t)((long)i * v->trains / m);
        double w = vector[order[k] * m + i] / sqrt(l);
        for (int j = 0; j < v->n; j++) u[j] += w * (x[j] - v->x0[j]);
    }
    return 1;
}

// What is left of each frame without its part along u; returns the farthest node's distance.
static double neural_deflate(const neural *v, const double *u, double *rest) {
    double most = 0;
    for (int f = 0; f < v->trains; f++) {
        double *x = rest + (size_t)v->n * (size_t)f, c = 0;
        for (int j = 0; j < v->n; j++) c += v->mass[j] * u[j] * x[j];
        for (int i = 0; i < v->nodes; i++) {
            double s = 0;
            for (int j = v->dim * i; j < v->dim * (i + 1); j++) x[j] -= c * u[j], s += x[j] * x[j];
            most = fmax(most, s);
        }
    }
    return sqrt(most);
}

static double *neural_encode_frames(const neural *v, const double *x, int count) {
    double *c = (double *)need((size_t)count * (size_t)v->p, sizeof *c);
    double *off = (double *)need((size_t)v->n, sizeof *off);
    for (int f = 0; f < count; f++) {
        for (int j = 0; j < v->n; j++) off[j] = x[(size_t)v->n * (size_t)f + (size_t)j] - v->x0[j];
        for (int j = 0; j < v->n; j++)
            for (int k = 0; k < v->p; k++) c[(size_t)f * (size_t)v->p + (size_t)k] += off[j] * v->A[(size_t)j * (size_t)v->p + (size_t)k];
    }
    free(off);
    return c;
}

// What the decoder's MLP gives is multiplied by this: with one unit for all modes, each error of a
// weight moves the stiffest modes, which hardly occur, as far as the softest (neural_settings.md, pca.scale).
static void neural_units(neural *v) {
    v->unit = (double *)need((size_t)v->p, sizeof(double));
    v->D = (double *)need((size_t)v->n * (size_t)v->p, sizeof(double));
    for (int k = 0; k < v->p; k++) {
        double s = 0;
        for (int f = 0; f < v->trains; f++) s += pow(v->code[(size_t)f * (size_t)v->p + (size_t)k], 2) / v->trains;
        v->unit[k] = v->d->pca.scale && s > 0 ? sqrt(s) : 1;
    }
    for (size_t i = 0; i < (size_t)v->n * (size_t)v->p; i++) v->D[i] = v->B[i] * v->unit[i % (size_t)v->p];
}

// u (modes × n) → B and A, with the unit in which frames have a mean square of 1.
static void neural_basis_take(neural *v, const double *u) {
    double s = 0;
    for (int f = 0; f < v->trains; f++)
        for (int j = 0; j < v->n; j++) {
            double d = v->train[(size_t)v->n * (size_t)f + (size_t)j] - v->x0[j];
            s += v->mass[j] * d * d / v->trains;
        }
    s = sqrt(s);
    v->B = (double *)need((size_t)v->n * (size_t)v->p, sizeof(double));
    v->A = (double *)need((size_t)v->n * (size_t)v->p, sizeof(double));
    for (int j = 0; j < v->n; j++)
        for (int k = 0; k < v->p; k++) {
            double b = u[(size_t)k * (size_t)v->n + (size_t)j];
            v->B[(size_t)j * (size_t)v->p + (size_t)k] = s * b;
            v->A[(size_t)j * (size_t)v->p + (size_t)k] = v->mass[j] * b / s;
        }
}

static int neural_value_order(int m, const double *value, int *order) {
    for (int i = 0; i < m; i++) {
        int at = i;
        for (; at > 0 && value[order[at - 1] * (m + 1)] < value[i * (m + 1)]; at--) order[at] = order[at - 1];
        order[at] = i;
    }
    return m;
}

static int neural_basis(neural *v) {
    int m = v->trains < NEURAL_SNAPSHOTS ? v->trains : NEURAL_SNAPSHOTS;
    size_t n = (size_t)v->n, mm = (size_t)m * (size_t)m;
    double *D = (double *)need((size_t)m * n, sizeof *D), *K = (double *)need(mm, sizeof *K), *E = (double *)need(mm, sizeof *E);
    double *rest = (double *)need((size_t)v->trains * n, sizeof *rest), *u = (double *)need((size_t)v->d->pca.most * n, sizeof *u);
    int *order = (int *)need((size_t)m, sizeof *order);
    double began = now(NULL);
    for (size_t i = 0; i < (size_t)v->trains * n; i++) rest[i] = v->train[i] - v->x0[i % n];
    for (int i = 0; i < m; i++)
        for (size_t j = 0; j < n; j++)
            D[(size_t)i * n + j] = sqrt(v->mass[j]) * rest[(size_t)((long)i * v->trains / m) * n + j];
    tss_dense_product(1, 0, m, m, v->n, 1, D, v->n, D, v->n, 0, K, m);
    neural_jacobi(m, K, E);
    neural_value_order(m, K, order);
    v->left = INFINITY;
    while (v->p < v->d->pca.most && v->left > v->d->pca.tol && neural_mode(v, m, K, E, order, v->p, u + (size_t)v->p * n)) {
        v->left = neural_deflate(v, u + (size_t)v->p * n, rest) / v->size;
        v->p++;
    }
    if (v->p >= v->d->r) neural_basis_take(v, u);
    free(D), free(K), free(E), free(rest), free(u), free(order);
    if (v->p < v->d->r)
        return fail(v->r, "%s: the frames span %d modes, expected at least neural.r (%d)", v->r->o.scene, v->p, v->d->r);
    v->code = neural_encode_frames(v, v->train, v->trains), v->code_test = neural_encode_frames(v, v->test, v->tests);
    neural_units(v);
    printf("basis: %d modes of %d frames, farthest node %.3g of the size, %.1f s\n", v->p, v->trains, v->left, now(NULL) - began);
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>neural_networks
// ---------------------------------------------------------------------------------------------

static int neural_net(neural *v, int in, int out, uint64_t seed, const tss_net_def *maps, tss_net **net) {
    int width[SCENE_HIDDEN + 2];
    tss_net_def d = *maps;
    width[0] = in, width[v->d->layers + 1] = out;
    memcpy(width + 1, v->d->hidden, (size_t)v->d->layers * sizeof *width);
    d.layers = v->d->layers + 1, d.width = width, d.activation = (tss_activation)v->d->activation, d.seed = seed;
    return tss_net_create(NULL, &d, net) == TSS_OK ? 1 : fail(v->r, "%s: neural.hidden: out of memory", v->r->o.scene);
}

#define NEURAL_BIAS 6  // spreads of z within which a unit that passes it on stays on its straight side

// train.start linear: units k < r of every layer pass on number k, plus NEURAL_BIAS between the layers,
// where σ(s) = s (ELU; the smooth ones nearly); the others begin at random and go to no output yet.
// unit: what the first layer divides by; NULL: 1.
static void neural_pass_on(int r, tss_net *net, const double *unit) {
    tss_net_info info;
    tss_net_get_info(net, &info);
    double *W = tss_net_parameters(net);
    for (int l = 0; l < info.layers; l++) {
        int in = info.width[l], out = info.width[l + 1], last = l + 1 == info.layers;
        double *b = W + (size_t)in * (size_t)out;
        for (int o = 0; o < out; o++) {
            int passed = o < r || last;
            for (int k = 0; k < in; k++) {
                double *w = W + (size_t)k * (size_t)out + o;
                if (passed)
                    *w = k == o && o < r ? (unit && l == 0 ? 1 / unit[k] : 1) : 0;
                else if (l > 0 && k < r)
                    b[o] -= NEURAL_BIAS * *w;
            }
            if (passed) b[o] = o < r ? NEURAL_BIAS * ((l == 0) - last) : 0;
        }
        W = b + out;
    }
}

// The free coordinates that an unsupervised decoder moves. Returns how many.
static int neural_free(const neural *v, int *index) {
    int n = 0;
    for (int i = 0; i < v->n; i++)
        if (!v->held[i]) index[n++] = i;
    return n;
}

static int neural_fresh(neural *v, tss_model *m) {
    uint64_t seed = 2 * (uint64_t)v->r->o.seed;
    tss_net_def d = tss_net_def_default();
    int ok = 1;
    d.outputs = v->n, d.out_base = v->x0;
    m->rng = tss_rng_seed(seed + 1000);
    if (v->d->unsupervised) {
        int *index = (int *)need((size_t)v->n, sizeof *index), free_count = neural_free(v, index);
        d.out_index = index;
        ok = neural_net(v, v->d->r, free_count, seed, &d, &m->decoder);
        free(index);
        return ok;
    }
    d.out_matrix = v->D;
    if (!neural_net(v, v->d->r, v->p, seed, &d, &m->decoder)) return 0;
    d = tss_net_def_default();
    d.inputs = v->n, d.in_base = v->x0, d.in_matrix = v->A;
    if (!neural_net(v, v->p, v->d->r, seed + 1, &d, &m->encoder)) return 0;
    if (v->d->train.start) neural_pass_on(v->d->r, m->decoder, NULL), neural_pass_on(v->d->r, m->encoder, v->unit);
    return 1;
}

static size_t neural_parameters(const tss_net *net) {
    tss_net_info i;
    if (!net) return 0;
    tss_net_get_info(net, &i);
    return i.parameters;
}

static void neural_path(const neural *v, neural_phase phase, char path[700]) {
    snprintf(path, 700, "%s/%s_%d.tssn", v->r->o.out, neural_phases[phase], v->r->o.seed);
}

// A model of this scene; *there = 0: no file.
static int neural_missing(const neural *v, neural_phase phase) {
    return fail(v->r, "%s/%s_%d.tssn: not there; `tss neural train %s -o %s --seed %d` makes it", v->r->o.out, neural_phases[phase], v->r->o.seed,
                v->r->o.scene, v->r->o.out, v->r->o.seed);
}

// Whether the file is there, before anything long is begun. 0: fails.
static int neural_expect(const neural *v, neural_phase phase) {
    char path[700];
    neural_path(v, phase, path);
    FILE *f = fopen(path, "rb");
    return f ? fclose(f), 1 : neural_missing(v, phase);
}

static int neural_read(neural *v, neural_phase phase, tss_model *m, int *there) {
    char path[700], why[300] = "";
    tss_net_info i;
    neural_path(v, phase, path);
    memset(m, 0, sizeof *m);
    *there = access(path, F_OK) == 0;
    if (!*there) return 1;
    if (tss_model_read(NULL, path, m, why, sizeof why) != TSS_OK) return fail(v->r, "%s: %s", path, why);
    tss_net_get_info(m->decoder, &i);
    int same = i.inputs == v->d->r && i.outputs == v->n && i.layers == v->d->layers + 1 &&
               i.activation == (tss_activation)v->d->activation && (m->encoder == NULL) == v->d->unsupervised &&
               (v->d->unsupervised || v->p == 0 || i.width[i.layers] == v->p);
    for (int k = 0; same && k < v->d->layers; k++) same = i.width[k + 1] == v->d->hidden[k];
    if (same) return 1;
    tss_model_free(m);
    return fail(v->r, "%s: a network of another scene; expected that of %s (choose another -o, or remove the file)",
                path, v->r->o.scene);
}

// The phase is over, and its z was changed at its end, when Adam began anew.
static int neural_changed(const neural *v, neural_phase phase, const tss_model *m) {
    return phase == NEURAL_LIPSCHITZ && m->adam && m->step > (uint64_t)v->d->train.steps && tss_adam_steps(m->adam) == 0;
}

// z of frames (count × n): encoded; unsupervised: N(0, I), times S where z has been whitened.
static double *neural_z(neural *v, const tss_model *m, neural_phase phase, const double *x, int count) {
    double unit = neural_changed(v, phase, m) ? 1 / sqrt(v->d->lipschitz.unit) : 1;
    const double *S = phase == NEURAL_LIPSCHITZ && v->d->lipschitz.whiten ? v->S : NULL;
    int r = v->d->r;
    double *z = (double *)need((size_t)count * (size_t)v->d->r, sizeof *z);
    tss_rng rng = tss_rng_seed(12345);
    if (m->encoder) {
        (void)tss_net_forward(m->encoder, v->work, count, x, z);
        return z;
    }
    for (int i = 0; i < count * r; i++) z[i] = tss_rng_normal(&rng);
    for (int k = 0; S && k < count; k++) {
        double n[1000];
        memcpy(n, z + k * r, (size_t)r * sizeof *n);
        for (int i = 0; i < r * r; i++) z[k * r + i / r] = (i % r ? z[k * r + i / r] : 0) + unit * S[i] * n[i % r];
    }
    return z;
}

// Every so many frames, count of them.
static double *neural_spread(const neural *v, const double *x, int frames, int count) {
    double *out = (double *)need((size_t)count * (size_t)v->n, sizeof *out);
    for (int k = 0; k < count && frames > 0; k++)
        memcpy(out + (size_t)k * (size_t)v->n, x + (size_t)((long)k * frames / count) * (size_t)v->n, (size_t)v->n * sizeof *out);
    return out;
}

// Where frames (count × n) have the handles; value: count × v->pinned.
static void neural_pinned(const neural *v, const double *x, int count, double *value) {
    for (int i = 0; i < count * v->pinned; i++)
        value[i] = x[(size_t)v->n * (size_t)(i / v->pinned) + (size_t)v->pin[i % v->pinned]];
}

// Eq. 7, of order o; pinned: with the handles where the frames have them.
static tss_result neural_eq7(neural *v, const tss_model *m, const tss_elements *e, int pinned, int o, int count, const double *x, const double *z,
                             double *lip) {
    double *value = (double *)need((size_t)count * (size_t)v->pinned, sizeof *value);
    tss_held held = {v->pinned, v->pin, value};
    if (pinned) neural_pinned(v, x, count, value);
    tss_result r = tss_lipschitz_estimate_held(m->decoder, e, v->work, o, pinned && v->pinned ? &held : NULL, count, z, lip);
    free(value);
    return r;
}

typedef struct neural_selection {
    int cells;             // chosen
    double error, seconds; // relative, of the samples' gradients
} neural_selection;

// At most `most` cells that stand for all of them in the subspace of a model; 0 or all: *out stays.
static int neural_cubature(neural *v, const tss_model *base, neural_phase phase, int most, tss_elements **out, neural_selection *s) {
    const scene_neural *d = v->d;
    double began = now(NULL);
    int ok;
    s->cells = v->cells, s->error = s->seconds = 0;
    if (most == 0 || most >= v->cells) return 1;
    double *x = neural_spread(v, v->train, v->trains, d->lipschitz.samples);
    double *z = neural_z(v, base, phase, x, d->lipschitz.samples);
    int *subset = (int *)need((size_t)most, sizeof *subset);
    double *weight = (double *)need((size_t)most, sizeof *weight);
    tss_cubature_def c = tss_cubature_def_default();
    double *value = (double *)need((size_t)d->lipschitz.samples * (size_t)v->pinned, sizeof *value);
    tss_held held = {v->pinned, v->pin, value};
    neural_pinned(v, x, d->lipschitz.samples, value);
    c.count = most, c.seed = (uint64_t)v->r->o.seed, c.held = v->pinned ? &held : NULL;
    tss_result e = tss_cubature_select(base->decoder, v->elements, v->work, &c, d->lipschitz.samples, z, subset, weight, &s->cells, &s->error);
    tss_elements_def ed = neural_elements(v);
    ed.count = s->cells, ed.subset = subset, ed.weight = weight;
    s->seconds = now(NULL) - began;
    if (e == TSS_OK) e = tss_elements_create(NULL, &ed, out);
    ok = e == TSS_OK ? 1 : fail(v->r, "%s: cubature: %s", v->r->o.scene, tss_result_text(e));
    if (ok) printf("cubature: %d of %d cells, error %.3g, %.1f s\n", s->cells, v->cells, s->error, s->seconds);
    free(x), free(z), free(subset), free(weight), free(value);
    return ok;
}

// The reduced solver of the scene with a decoder; cells NULL: all.
static tss_reduced_def neural_solver(neural *v, const tss_net *decoder, const tss_elements *cells) {
    const scene_neural *d = v->d;
    tss_reduced_def rd = tss_reduced_def_default();
    rd.decoder = decoder, rd.elements = cells ? cells : v->elements, rd.mass = v->mass, rd.h = v->h;
    if (v->ball.radius > 0) {
        rd.sdf = tss_sdf_ball, rd.sdf_user = &v->ball, rd.contact_stiffness = v->ball_stiffness;
        rd.contact_margin = v->ball_margin, rd.contact_weight = v->area;
    }
    rd.tol = d->solver.tol, rd.eps = d->solver.eps, rd.ftol = d->solver.ftol, rd.memory = d->solver.memory, rd.max_line = d->solver.max_line;
    rd.max_iterations = d->solver.max_iterations, rd.solver = (tss_reduced_method)d->solver.kind;
    return rd;
}

// ---------------------------------------------------------------------------------------------
// >>neural_whitening: z = T y, in which the mean of |∇²P| + JᵀMJ/h² over states of the base is the unit
// matrix (J per unit of y²). The iterations of L-BFGS follow that matrix's condition, which L_LS does not
// see, and its first line search, from a step of −∇E, follows its size. In y, L_LS weighs a change of the
// Hessian by the Hessian itself, as the affine-invariant theory of Newton's method does.
// ---------------------------------------------------------------------------------------------

#define NEURAL_WHITEN_STATES 200
#define NEURAL_WHITEN_FEW 48     // the same with more than NEURAL_MANY cells
#define NEURAL_SOLVED 8         // training sequences, and steps of each, whose every other state stands for the solver's
#define NEURAL_SOLVED_STEPS 6
#define NEURAL_WHITEN_LEAST 1e-6  // of the largest eigenvalue: directions that move nothing stay finite

// JᵀKJ of the elements at f(z), handles at value, and J (r × n, 0 at handles); room: 2 n.
static tss_result neural_tangent_stiffness(neural *v, const tss_model *m, const double *z, const double *value, const double *I, double *J,
                                           double *room, double *H) {
    int r = v->d->r;
    size_t n = (size_t)v->n;
    double *x = room, *force = room + n, one = 1, slope;
    tss_result e = tss_net_jets(m->decoder, v->work, 1, r, z, I, NULL, x, J, NULL);
    for (int i = 0; i < v->pinned; i++) {
        x[v->pin[i]] = value[i];
        for (int a = 0; a < r; a++) J[(size_t)a * n + (size_t)v->pin[i]] = 0;
    }
    for (int a = 0; a < r && e == TSS_OK; a++) {
        memset(force, 0, n * sizeof *force);  // K J_a, as the gradient of ∇P·J_a
        e = tss_elements_jets(v->elements, 1, x, J + (size_t)a * n, NULL, NULL, NULL, &slope, NULL, 0, &one, 0, force, NULL, NULL);
        for (int b = 0; b < r; b++) {
            H[a * r + b] = 0;
            for (size_t j = 0; j < n; j++) H[a * r + b] += J[(size_t)b * n + j] * force[j];
        }
    }
    return e;
}

// A ← A⁻¹, symmetric and positive, by eigenvalues; W: 2 r².
static void neural_inverse(int r, double *A, double *W) {
    double *E = W + r * r;
    memcpy(W, A, (size_t)(r * r) * sizeof *W), memset(A, 0, (size_t)(r * r) * sizeof *A);
    neural_jacobi(r, W, E);
    for (int q = 0; q < r; q++)
        for (int i = 0; i < r * r; i++) A[i] += E[q * r + i / r] * E[q * r + i % r] / fmax(W[q * (r + 1)], 1e-300);
}

// The mean over states z (count × r), r × r, symmetric. tangent: without the curvature of f, which at a
// solution counts for little: there forces and inertia nearly balance. harmonic: of the inverses, inverted,
// which the softest states decide and not the stiffest (NULL: not wanted).
static int neural_mean_hessian(neural *v, const tss_model *m, int tangent, double *harmonic, int count, const double *x, const double *z, double *mean) {
    int r = v->d->r, rr = r * r;
    size_t n = (size_t)v->n;
    double *H = (double *)need((size_t)(2 * rr + 2 * r), sizeof *H), *E = H + rr, *g = E + rr, *P = g + r;
    double *J = (double *)need((size_t)r * n, sizeof *J), *value = (double *)need((size_t)v->pinned, sizeof *value);
    double *I = (double *)need((size_t)rr, sizeof *I), *room = (double *)need(2 * n, sizeof *room), *one = (double *)need((size_t)rr, sizeof *one);
    tss_held held = {v->pinned, v->pin, value};
    tss_result e = TSS_OK;
    memset(mean, 0, (size_t)rr * sizeof *mean);
    if (harmonic) memset(harmonic, 0, (size_t)rr * sizeof *harmonic);
    for (int i = 0; i < r; i++) I[i * (r + 1)] = 1;
    for (int k = 0; k < count && e == TSS_OK; k++) {
        neural_progress(v, (k + 1.0) / count, "whitening: Hessian %d of %d", k + 1, count);
        if (v->pinned) neural_pinned(v, x + (size_t)k * n, 1, value);
        e = tangent ? neural_tangent_stiffness(v, m, z + k * r, value, I, J, room, H)
                    : tss_reduced_potential_held(m->decoder, v->elements, v->work, v->pinned ? &held : NULL, 1, z + k * r, P, g, H);
        neural_jacobi(r, H, E);
        memset(one, 0, (size_t)rr * sizeof *one);
        for (int i = 0; i < r * rr; i++) {
            int q = i / rr, a = i % rr;
            one[a] += fabs(H[q * (r + 1)]) * E[q * r + a / r] * E[q * r + a % r];
        }
        if (e == TSS_OK && v->h > 0 && !tangent) e = tss_net_jets(m->decoder, v->work, 1, r, z + k * r, I, NULL, NULL, J, NULL);
        for (int a = 0; a < rr && v->h > 0; a++)
            for (size_t j = 0; j < n; j++)
                one[a] += v->mass[j] * J[(size_t)(a / r) * n + j] * J[(size_t)(a % r) * n + j] / (v->h * v->h);
        for (int a = 0; a < rr; a++) mean[a] += one[a] / count;
        if (harmonic) neural_inverse(r, one, H);
        for (int a = 0; harmonic && a < rr; a++) harmonic[a] += one[a] / count;
    }
    if (harmonic) neural_inverse(r, harmonic, H);
    free(H), free(J), free(value), free(I), free(room), free(one);
    return e == TSS_OK ? 1 : fail(v->r, "%s: whiten: %s", v->r->o.scene, tss_result_text(e));
}

// T and S (r × r, symmetric) of a mean Hessian A, which is destroyed: Tᵀ A T = 1, S = T⁻¹.
static void neural_roots(int r, double *A, double *T, double *S) {
    double *E = (double *)need((size_t)(r * r), sizeof *E), most = 0;
    memset(T, 0, (size_t)(r * r) * sizeof *T), memset(S, 0, (size_t)(r * r) * sizeof *S);
    neural_jacobi(r, A, E);
    for (int q = 0; q < r; q++) most = fmax(most, A[q * (r + 1)]);
    for (int q = 0; q < r; q++)
        for (int i = 0; i < r * r; i++) {
            double l = sqrt(fmax(A[q * (r + 1)], NEURAL_WHITEN_LEAST * most)), ee = E[q * r + i / r] * E[q * r + i % r];
            T[i] += ee / l, S[i] += ee * l;
        }
    free(E);
}

// C ← A B, r × r.
static void neural_times(int r, const double *A, const double *B, double *C) {
    for (int i = 0; i < r * r; i++) {
        C[i] = 0;
        for (int k = 0; k < r; k++) C[i] += A[i - i % r + k] * B[k * r + i % r];
    }
}

// A sequence begins at rest, as near to x as the decoder comes from g(x), or from 0 without an encoder: from
// the end of the sequence before a projection may end on another branch.
static tss_result neural_rest(neural *v, const tss_model *m, tss_reduced *s, const double *x) {
    double *z = m->encoder ? neural_z(v, m, NEURAL_VANILLA, x, 1) : (double *)need((size_t)v->d->r, sizeof *z);
    (void)tss_reduced_set(s, z);
    free(z);
    return tss_reduced_project(s, x, NULL);
}

// States in which the solver ends: the first steps of some training sequences. Returns how many, 0: failed.
static int neural_solved(neural *v, const tss_model *m, double *x, double *z) {
    tss_reduced_def rd = neural_solver(v, m->decoder, NULL);
    tss_host host = tss_host_default();
    tss_reduced *s;
    size_t n = (size_t)v->n, r = (size_t)v->d->r;
    double *target = (double *)need((size_t)(v->handles * v->dim), sizeof *target), *force = (double *)need(n, sizeof *force);
    int steps = v->d->script.length / v->d->script.stride, count = 0, ok = 1;
    if (steps > NEURAL_SOLVED_STEPS) steps = NEURAL_SOLVED_STEPS;
    host.log = print_log, host.workers = v->r->o.threads;
    rd.solver = TSS_LBFGS;
    if (tss_reduced_create(&host, &rd, &s) != TSS_OK) return free(target), free(force), fail(v->r, "%s: neural.solver is refused", v->r->o.scene);
    for (int q = 0; ok && q < NEURAL_SOLVED && q < v->d->script.train; q++) {
        neural_script script = neural_script_of(v, v->d->script.test + q);
        (void)tss_reduced_set_handles(s, 0, NULL, NULL);
        ok = neural_rest(v, m, s, v->x0) == TSS_OK;
        for (int k = 0; ok && k < steps; k++) {
            int at = v->d->script.stride * (k + 1) - 1;
            memcpy(v->ball.center, script.center + 3 * at, sizeof v->ball.center);
            neural_targets(v, &script, at, target), neural_forces(v, &script, at, 1, force);
            ok = tss_reduced_set_handles(s, v->handles, v->handle, target) == TSS_OK;
            tss_reduced_set_force(s, force);
            ok = ok && tss_reduced_step(s, NULL) == TSS_OK;
            if (!ok || k % 2 == 0) continue;  // every other one
            memcpy(x + (size_t)count * n, tss_reduced_x(s), n * sizeof *x);
            memcpy(z + (size_t)count++ * r, tss_reduced_z(s), r * sizeof *z);
        }
        neural_script_free(&script);
    }
    tss_reduced_destroy(s), free(target), free(force);
    return ok ? count : fail(v->r, "%s: whiten: the solver cannot step", v->r->o.scene);
}

static int neural_whiten_states(const neural *v) { return v->cells > NEURAL_MANY ? NEURAL_WHITEN_FEW : NEURAL_WHITEN_STATES; }

// v->T and v->S from a base, if they are asked for and not there. whiten_at solver: after the whitening by
// frames, in whose coordinates the base is solved for, another by the states that this ends in.
static int neural_whitening(neural *v, tss_model *base) {
    int r = v->d->r, count = neural_whiten_states(v), ok = 1;
    size_t rr = (size_t)(r * r);
    if (!v->d->lipschitz.whiten || v->T) return 1;
    double *x = neural_spread(v, v->train, v->trains, count), *z = neural_z(v, base, NEURAL_BASE, x, count);
    double *A = (double *)need(4 * rr, sizeof *A), *T = A + rr, *S = T + rr, *swap = S + rr, began = now(NULL);
    double *T0 = (double *)need(rr, sizeof *T0), *S0 = (double *)need(rr, sizeof *S0);
    ok = neural_mean_hessian(v, base, 0, NULL, count, x, z, A);
    if (ok) neural_roots(r, A, T0, S0);
    if (ok && v->d->lipschitz.whiten_at) {
        ok = tss_model_change_z(base, T0) == TSS_OK || fail(v->r, "%s: neural.lipschitz.whiten: the mean Hessian is singular", v->r->o.scene);
        ok = ok && (count = neural_solved(v, base, x, z)) > 0 && neural_mean_hessian(v, base, 1, NULL, count, x, z, A);
        if (ok) {
            neural_roots(r, A, T, S);
            neural_times(r, T0, T, swap), memcpy(T0, swap, rr * sizeof *T0);
            neural_times(r, S, S0, swap), memcpy(S0, swap, rr * sizeof *S0);
        }
    }
    if (ok) printf("whitening: %d states%s, %.1f s\n", count, v->d->lipschitz.whiten_at ? " of the solver" : "", now(NULL) - began);
    v->prepared += now(NULL) - began;
    if (ok) v->T = T0, v->S = S0;
    else free(T0), free(S0);
    free(x), free(z), free(A);
    return ok;
}

// The whitening, from base_N.tssn.
static int neural_whitening_read(neural *v) {
    tss_model base;
    int there, ok = 1;
    if (!v->d->lipschitz.whiten || v->T) return 1;
    if (!neural_read(v, NEURAL_BASE, &base, &there)) return 0;
    if (there) ok = neural_whitening(v, &base), tss_model_free(&base);
    return ok && (there || neural_missing(v, NEURAL_BASE));
}

// ---------------------------------------------------------------------------------------------
// >>neural_training
// ---------------------------------------------------------------------------------------------

typedef struct neural_trainer {
    neural *v;
    neural_phase phase;
    tss_model m;
    uint64_t first, last;  // steps of the phase: from, to
    tss_net *decoder, *encoder;  // the MLPs alone: c of z, z of c. Supervised
    tss_training *t;             // unsupervised
    double *g, *c, *c2, *z, *z_bar, *z_mean, *probe, *z_test, *pin;
    int *drawn;  // frames of c2
    double loss, lipschitz, lip, rate;  // running means of the losses
    double loss_test;                   // L_C of the test frames at the last checkpoint
    double seconds, estimating;  // of the phase; of this run, in estimates
    int skipped;
    FILE *rows;
} neural_trainer;

static tss_adam_def neural_adam(const neural_trainer *t) {
    const scene_neural *d = t->v->d;
    int base = t->phase == NEURAL_BASE, steps = base ? d->train.steps : d->lipschitz.steps;
    double end = base ? d->train.rate_end : d->lipschitz.rate_end;
    tss_adam_def a = tss_adam_def_default();
    a.rate = base ? d->train.rate : d->lipschitz.rate, a.warmup = (uint64_t)(base ? d->train.warmup : d->lipschitz.warmup);
    a.decay_every = steps >= 200 ? (uint64_t)steps / 200 : 1;
    a.decay = pow(end / a.rate, (double)a.decay_every / steps);
    return a;
}

static tss_lipschitz_def neural_lipschitz(const neural *v) {
    tss_lipschitz_def d = tss_lipschitz_def_default();
    d.order = v->d->lipschitz.order, d.undivided = v->d->lipschitz.undivided;
    d.estimator = d.order == 2 ? (tss_estimator)v->d->lipschitz.estimator : TSS_LIPSCHITZ_EXACT;
    d.probes = v->d->lipschitz.probes;
    return d;
}

static void neural_draw(const neural *v, tss_rng *rng, int count, double *c, int *drawn) {
    for (int k = 0; k < count; k++) {
        int f = (int)(tss_rng_uniform(rng) * v->trains);
        if (drawn) drawn[k] = f;
        memcpy(c + (size_t)k * (size_t)v->p, v->code + (size_t)f * (size_t)v->p, (size_t)v->p * sizeof *c);
    }
}

// Root mean square of z about its mean: the unit that Eq. 7 is in.
static double neural_z_scale(const double *z, int count, int r, double *mean) {
    double s = 0;
    for (int k = 0; k < r; k++) {
        mean[k] = 0;
        for (int i = 0; i < count; i++) mean[k] += z[i * r + k] / count;
        for (int i = 0; i < count; i++) s += (z[i * r + k] - mean[k]) * (z[i * r + k] - mean[k]) / ((double)count * r);
    }
    return sqrt(s);
}

// Frames of a batch and where their handles are. lipschitz.window W > 0: groups of NEURAL_GROUP frames,
// those of a group within W of its first and with its handles: all states of the one E of a step.
#define NEURAL_GROUP 4
static void neural_draw_lipschitz(neural_trainer *t) {
    neural *v = t->v;
    int batch = v->d->lipschitz.batch, W = v->d->lipschitz.window, length = v->d->script.length;
    neural_draw(v, &t->m.rng, batch, t->c2, t->drawn);
    for (int i = 0; i < batch; i++) {
        int lead = W > 0 ? t->drawn[i - i % NEURAL_GROUP] : t->drawn[i];
        if (W > 0 && i % NEURAL_GROUP) {
            int first = lead - lead % length, lo = lead - W > first ? lead - W : first;
            int hi = lead + W < first + length ? lead + W : first + length - 1;
            t->drawn[i] = lo + (int)((hi - lo + 1) * tss_rng_uniform(&t->m.rng));
            memcpy(t->c2 + (size_t)i * (size_t)v->p, v->code + (size_t)t->drawn[i] * (size_t)v->p, (size_t)v->p * sizeof *t->c2);
        }
        neural_pinned(v, v->train + (size_t)v->n * (size_t)lead, 1, t->pin + i * v->pinned);
    }
}

// L_LS of a batch of frames of their own; its gradient is added to g. lipschitz.relative: L_LS is
// multiplied by s^(2(o + 1)), s the spread of the batch's z: else it falls when z is but stretched.
static tss_result neural_step_lipschitz(neural_trainer *t, double weight, double *loss) {
    neural *v = t->v;
    const scene_neural *d = v->d;
    size_t dec = neural_parameters(t->decoder);
    tss_lipschitz_def ld = neural_lipschitz(v);
    int batch = d->lipschitz.batch, r = d->r, each = d->lipschitz.window ? NEURAL_GROUP : batch, groups = batch / each;
    neural_draw_lipschitz(t);
    for (int i = 0; i < 2 * r * ld.probes && ld.estimator != TSS_LIPSCHITZ_EXACT; i++) t->probe[i] = tss_rng_normal(&t->m.rng);
    memset(t->z_bar, 0, (size_t)batch * (size_t)r * sizeof *t->z_bar);
    tss_result e = tss_net_forward(t->encoder, v->work, batch, t->c2, t->z);
    double spread = d->lipschitz.relative ? neural_z_scale(t->z, batch, r, t->z_mean) : 1;
    double power = 2 * (ld.order + 1), unit = pow(spread, power), part;
    weight *= unit, *loss = 0;
    for (int g = 0; g < groups && e == TSS_OK; g++) {
        tss_held held = {v->pinned, v->pin, t->pin + g * each * v->pinned};
        ld.held = v->pinned ? &held : NULL;
        e = tss_loss_lipschitz(t->m.decoder, v->cubature ? v->cubature : v->elements, v->work, &ld, each, t->z + g * each * r,
                               ld.estimator == TSS_LIPSCHITZ_EXACT ? NULL : t->probe, weight / groups, &part, t->g,
                               d->lipschitz.through_encoder ? t->z_bar + g * each * r : NULL);
        *loss += part / groups;
    }
    for (int i = 0; d->lipschitz.relative && i < batch * r; i++)
        t->z_bar[i] += weight * *loss * power * (t->z[i] - t->z_mean[i % r]) / (batch * r * spread * spread);
    *loss *= unit;
    if (e == TSS_OK && d->lipschitz.through_encoder)
        e = tss_net_backward(t->encoder, v->work, batch, t->c2, t->z_bar, t->g + dec, NULL);
    return e;
}

static void neural_sync(neural_trainer *t) {
    memcpy(tss_net_parameters(t->decoder), tss_net_parameters(t->m.decoder), neural_parameters(t->decoder) * sizeof(double));
    memcpy(tss_net_parameters(t->encoder), tss_net_parameters(t->m.encoder), neural_parameters(t->encoder) * sizeof(double));
}

// One step of Eq. 10 on frames. The model holds whole maps; Eq. 3 is taken in c.
static tss_result neural_step(neural_trainer *t, tss_training_info *info) {
    neural *v = t->v;
    size_t dec = neural_parameters(t->decoder), enc = neural_parameters(t->encoder);
    double weight = t->phase == NEURAL_LIPSCHITZ ? v->d->lipschitz.weight : 0;
    memset(info, 0, sizeof *info);
    memset(t->g, 0, (dec + enc) * sizeof *t->g);
    neural_draw(v, &t->m.rng, v->d->train.batch, t->c, NULL);
    tss_result e = tss_loss_reconstruction(t->decoder, t->encoder, v->work, NULL, v->d->train.batch, t->c, 1, &info->loss, t->g, t->g + dec);
    if (e == TSS_OK && weight > 0) e = neural_step_lipschitz(t, weight, &info->lipschitz);
    for (size_t i = 0; i < dec + enc; i++) info->skipped |= !isfinite(t->g[i]);
    info->rate = tss_adam_rate(t->m.adam);
    t->m.step++;
    if (e != TSS_OK || info->skipped) return e;
    tss_adam_update(t->m.adam, 0, dec, tss_net_parameters(t->m.decoder), t->g);
    tss_adam_update(t->m.adam, dec, enc, tss_net_parameters(t->m.encoder), t->g + dec);
    tss_adam_advance(t->m.adam);
    neural_sync(t);
    return e;
}

static int neural_trainer_supervised(neural_trainer *t) {
    neural *v = t->v;
    tss_net_def plain = tss_net_def_default();
    size_t r = (size_t)v->d->r, p = (size_t)v->p, batch = (size_t)v->d->lipschitz.batch;
    double *unit = (double *)need(p * p, sizeof *unit);
    tss_net_def scaled = plain;
    for (size_t k = 0; k < p; k++) unit[(p + 1) * k] = v->unit[k];
    if (v->d->pca.scale) scaled.outputs = v->p, scaled.out_matrix = unit;
    int ok = neural_net(v, v->d->r, v->p, 0, &scaled, &t->decoder) && neural_net(v, v->p, v->d->r, 0, &plain, &t->encoder);
    free(unit);
    if (!ok) return 0;
    neural_sync(t);
    t->g = (double *)need(neural_parameters(t->decoder) + neural_parameters(t->encoder), sizeof(double));
    t->c = (double *)need((size_t)v->d->train.batch * p, sizeof(double)), t->c2 = (double *)need(batch * p, sizeof(double));
    t->z = (double *)need(batch * r, sizeof(double)), t->z_bar = (double *)need(batch * r, sizeof(double));
    t->z_mean = (double *)need(r, sizeof(double));
    t->pin = (double *)need(batch * (size_t)v->pinned, sizeof(double)), t->drawn = (int *)need(batch, sizeof(int));
    t->probe = (double *)need(2 * r * (size_t)v->d->lipschitz.probes, sizeof(double));
    return 1;
}

static int neural_trainer_unsupervised(neural_trainer *t) {
    neural *v = t->v;
    const scene_neural *d = v->d;
    tss_training_def td = tss_training_def_default();
    td.model = &t->m, td.elements = v->elements, td.cubature = v->cubature, td.mass = v->mass;
    td.batch = d->train.batch, td.lambda = d->train.lambda, td.sigma = d->train.sigma, td.eps = d->train.eps;
    td.ramp = (uint64_t)d->train.ramp, td.lipschitz_from = t->first, td.lipschitz_batch = d->lipschitz.batch;
    td.lipschitz_weight = t->phase == NEURAL_LIPSCHITZ ? d->lipschitz.weight : 0, td.lipschitz = neural_lipschitz(v);
    td.adam = neural_adam(t);
    if (t->phase == NEURAL_LIPSCHITZ && d->lipschitz.whiten) td.spread = v->S;
    tss_host host = tss_host_default();
    host.log = print_log, host.workers = v->r->o.threads;
    return tss_training_create(&host, &td, &t->t) == TSS_OK ? 1 : fail(v->r, "%s: neural.train: the library refuses it", v->r->o.scene);
}

// Seconds that earlier runs spent up to this step.
static double neural_spent(const neural *v, neural_phase phase, uint64_t step) {
    char path[700], line[300], name[32];
    double seconds = 0, s;
    unsigned long long at;
    snprintf(path, sizeof path, "%s/train_%d.csv", v->r->o.out, v->r->o.seed);
    FILE *f = fopen(path, "r");
    while (f && fgets(line, sizeof line, f))
        if (sscanf(line, "%31[^,],%llu,%lf", name, &at, &s) == 3 && strcmp(name, neural_phases[phase]) == 0 && at <= step)
            seconds = s;
    if (f) fclose(f);
    return seconds;
}

static int neural_rows_open(neural_trainer *t) {
    char path[700];
    snprintf(path, sizeof path, "%s/train_%d.csv", t->v->r->o.out, t->v->r->o.seed);
    int old = access(path, F_OK) == 0;
    t->rows = fopen(path, "a");
    if (!t->rows) return fail(t->v->r, "%s: cannot be written: %s", path, strerror(errno));
    if (!old) fputs("phase,step,seconds,loss,loss_lipschitz,lip,z_scale,rate,skipped,loss_test\n", t->rows);
    return 1;
}

// The phase's model: its own file; else a new one, or the base with an optimiser at its start.
static int neural_trainer_open(neural *v, neural_phase phase, neural_trainer *t) {
    int there;
    memset(t, 0, sizeof *t);
    t->v = v, t->phase = phase;
    t->first = phase == NEURAL_BASE ? 0 : (uint64_t)v->d->train.steps;
    t->last = t->first + (uint64_t)(phase == NEURAL_BASE ? v->d->train.steps : v->d->lipschitz.steps);
    tss_adam_def a = neural_adam(t);
    if (!neural_read(v, phase, &t->m, &there)) return 0;
    if (there && t->m.step < t->last && neural_changed(v, phase, &t->m))
        return fail(v->r, "%s/lipschitz_%d.tssn: ended after %llu steps, and its z was changed then; expected neural.lipschitz.steps %llu, or no such file",
                    v->r->o.out, v->r->o.seed, (unsigned long long)(t->m.step - t->first), (unsigned long long)(t->m.step - t->first));
    // its model's z is y already; how y is spread is asked for where there is no encoder
    if (phase == NEURAL_LIPSCHITZ && (!there || v->d->unsupervised) && !neural_whitening_read(v)) return 0;
    if (!there && phase == NEURAL_BASE && !neural_fresh(v, &t->m)) return 0;
    if (!there && phase != NEURAL_BASE) {
        if (!neural_read(v, NEURAL_BASE, &t->m, &there)) return 0;
        if (tss_adam_set(t->m.adam, &a, 1) != TSS_OK) return fail(v->r, "%s: neural.lipschitz: bad rates", v->r->o.scene);
        if (phase == NEURAL_LIPSCHITZ && v->T && tss_model_change_z(&t->m, v->T) != TSS_OK)
            return fail(v->r, "%s: neural.lipschitz.whiten: the mean Hessian is singular", v->r->o.scene);
    }
    size_t all = neural_parameters(t->m.decoder) + neural_parameters(t->m.encoder);
    if (!t->m.adam && tss_adam_create(NULL, &a, all, &t->m.adam) != TSS_OK) return fail(v->r, "out of memory");
    t->seconds = neural_spent(v, phase, t->m.step) + (phase == NEURAL_LIPSCHITZ && t->m.step == t->first ? v->prepared : 0);
    t->z_test = neural_spread(v, v->test, v->tests, NEURAL_SAMPLES);
    return (v->d->unsupervised ? neural_trainer_unsupervised(t) : neural_trainer_supervised(t)) && neural_rows_open(t);
}

static void neural_trainer_close(neural_trainer *t) {
    tss_model_free(&t->m);
    tss_training_destroy(t->t), tss_net_destroy(t->decoder), tss_net_destroy(t->encoder);
    free(t->g), free(t->c), free(t->c2), free(t->z), free(t->z_bar), free(t->z_mean), free(t->probe), free(t->z_test), free(t->pin), free(t->drawn);
    if (t->rows) fclose(t->rows);
}

// L_C of the test frames; unsupervised: 0, its samples are never the same ones.
static double neural_test_loss(const neural_trainer *t) {
    double loss = 0;
    if (t->encoder && tss_loss_reconstruction(t->decoder, t->encoder, t->v->work, NULL, t->v->tests, t->v->code_test, 1, &loss, NULL, NULL) != TSS_OK)
        loss = 0;
    return loss;
}

// The model to its file, and a row of the curves.
static int neural_checkpoint(neural_trainer *t) {
    neural *v = t->v;
    char path[700];
    double *z = neural_z(v, &t->m, t->phase, t->z_test, NEURAL_SAMPLES), *mean = (double *)need((size_t)v->d->r, sizeof *mean);
    const tss_elements *e = v->cubature ? v->cubature : v->elements;
    int count = !v->cubature && v->cells > NEURAL_MANY ? NEURAL_FEW : NEURAL_SAMPLES;
    double began = now(NULL);
    if (t->m.step == t->last || t->estimating <= NEURAL_SHARE * t->seconds)
        (void)neural_eq7(v, &t->m, e, 1, 2, count, t->z_test, z, &t->lip);
    t->estimating += now(NULL) - began;
    t->loss_test = neural_test_loss(t);
    fprintf(t->rows, "%s,%llu,%.1f,%.6g,%.6g,%.6g,%.6g,%.6g,%d,%.6g\n", neural_phases[t->phase], (unsigned long long)t->m.step,
            t->seconds, t->loss, t->lipschitz, t->lip, neural_z_scale(z, NEURAL_SAMPLES, v->d->r, mean), t->rate, t->skipped, t->loss_test);
    fflush(t->rows), free(z), free(mean);
    neural_path(v, t->phase, path);
    tss_result r = tss_model_write(NULL, &t->m, path);
    return r == TSS_OK ? 1 : fail(v->r, "%s: cannot be written: %s", path, tss_result_text(r));
}

// The phase is over but for the change of z at its end, which has no checkpoint before it: one that is killed
// in it takes its last steps again.
static int neural_unchanged(const neural_trainer *t) {
    const scene_neural *d = t->v->d;
    return t->phase == NEURAL_LIPSCHITZ && (d->lipschitz.whiten_end || d->lipschitz.unit != 1) && t->m.step == t->last;
}

static int neural_train_loop(neural_trainer *t) {
    neural *v = t->v;
    tss_training_info i;
    uint64_t every = (t->last - t->first) / 40 + 1, begun = t->m.step;
    double start = now(NULL), before = t->seconds, saved = start;
    while (t->m.step < t->last && !neural_late(v)) {
        tss_result e = t->t ? tss_training_step(t->t, &i) : neural_step(t, &i);
        if (e != TSS_OK) return fail(v->r, "%s: training: %s", v->r->o.scene, tss_result_text(e));
        double share = t->m.step == begun + 1 ? 1 : 0.01;
        t->loss += share * (i.loss - t->loss), t->lipschitz += share * (i.lipschitz - t->lipschitz);
        t->rate = i.rate, t->skipped += i.skipped;
        double spent = now(NULL) - start;
        t->seconds = before + spent;
        if (((t->m.step - t->first) % every == 0 || now(NULL) > saved + 60) && !neural_unchanged(t)) {
            if (!neural_checkpoint(t)) return 0;
            saved = now(NULL);
        }
        neural_progress(v, (double)(t->m.step - t->first) / (double)(t->last - t->first),
                        "%s (phase %d of 3) %llu of %llu: loss %.4g, L_LS %.4g, Lip %.4g, %.0f s left in it", neural_phases[t->phase], t->phase + 1,
                        (unsigned long long)(t->m.step - t->first), (unsigned long long)(t->last - t->first), t->loss,
                        t->lipschitz, t->lip, spent / (double)(t->m.step - begun) * (double)(t->last - t->m.step));
    }
    return t->m.step == begun || neural_unchanged(t) || neural_checkpoint(t);
}

// lipschitz.whiten_end: z = T y, in which the harmonic mean of the trained decoder's Hessians is a multiple of
// 1, and the largest eigenvalue of their mean is 1: a first step of −∇E is not too long.
static int neural_whiten_end(neural_trainer *t, double *T) {
    neural *v = t->v;
    int r = v->d->r, count = neural_whiten_states(v);
    size_t rr = (size_t)(r * r);
    double *x = neural_spread(v, v->train, v->trains, count), *z = neural_z(v, &t->m, NEURAL_VANILLA, x, count);
    double *A = (double *)need(4 * rr, sizeof *A), *S = A + rr, *mean = S + rr, *E = mean + rr, most = 0, began = now(NULL);
    int ok = neural_mean_hessian(v, &t->m, 1, A, count, x, z, mean);
    if (ok) {
        neural_roots(r, A, T, S);
        neural_times(r, mean, T, E), neural_times(r, T, E, mean), neural_jacobi(r, mean, E);
        for (int q = 0; q < r; q++) most = fmax(most, mean[q * (r + 1)]);
        for (size_t i = 0; i < rr; i++) T[i] /= sqrt(most);
        printf("whitened at the end: %d states, %.1f s\n", count, now(NULL) - began);
    }
    free(x), free(z), free(A);
    return ok;
}

// The change of z at the end: that, and lipschitz.unit, in which L-BFGS's first step of −∇E is shorter, and
// |∇E| per unit smaller, where it is below 1.
static int neural_change_end(neural_trainer *t) {
    neural *v = t->v;
    int r = v->d->r;
    double *T = (double *)need((size_t)(r * r), sizeof *T), began = now(NULL);
    tss_adam_def adam = neural_adam(t);
    for (int i = 0; i < r; i++) T[i * (r + 1)] = 1;
    int ok = !v->d->lipschitz.whiten_end || neural_whiten_end(t, T);
    for (int i = 0; i < r * r; i++) T[i] *= sqrt(v->d->lipschitz.unit);
    ok = ok && (tss_model_change_z(&t->m, T) == TSS_OK || fail(v->r, "%s: neural.lipschitz.whiten_end: the mean Hessian is singular", v->r->o.scene));
    if (ok && tss_adam_set(t->m.adam, &adam, 1) != TSS_OK) ok = fail(v->r, "%s: neural.lipschitz: bad rates", v->r->o.scene);
    free(T);
    if (ok && t->decoder) neural_sync(t);
    t->seconds += now(NULL) - began;
    return ok && neural_checkpoint(t);
}

static int neural_train_phase(neural *v, neural_phase phase) {
    neural_trainer t;
    int ok = neural_trainer_open(v, phase, &t);
    uint64_t begun = t.m.step;
    ok = ok && neural_train_loop(&t);
    if (ok && neural_unchanged(&t) && t.m.step > begun) ok = neural_change_end(&t);
    if (ok && t.loss > 0)
        printf("%s: step %llu, %.1f s, loss %.6g, Lip %.6g\n", neural_phases[phase], (unsigned long long)t.m.step, t.seconds, t.loss, t.lip);
    if (ok && t.loss > 0 && t.m.encoder) printf("%s: loss of the test frames %.6g\n", neural_phases[phase], t.loss_test);
    fflush(stdout);
    neural_trainer_close(&t);
    return ok;
}

static int neural_train(neural *v) {
    const char *only = v->r->o.method;
    neural_selection chosen;
    tss_model base;
    int there;
    if (!neural_frames(v) || v->stopped) return !v->r->why.text[0];
    if (!v->d->unsupervised && !neural_basis(v)) return 0;
    if (!neural_train_phase(v, NEURAL_BASE) || v->stopped) return !v->r->why.text[0];
    if (!neural_read(v, NEURAL_BASE, &base, &there)) return 0;
    int ok = neural_cubature(v, &base, NEURAL_BASE, v->d->lipschitz.cubature, &v->cubature, &chosen);
    tss_model_free(&base);
    v->prepared = chosen.seconds;
    if (ok && (!only || strcmp(only, "vanilla") == 0)) ok = neural_train_phase(v, NEURAL_VANILLA);
    if (ok && !v->stopped && (!only || strcmp(only, "lipschitz") == 0)) ok = neural_train_phase(v, NEURAL_LIPSCHITZ);
    if (ok && !v->stopped && !only)  // evaluate wants both
        printf("trained. What comes of it: `tss neural evaluate %s -o %s --seed %d`; with pictures: `run`\n", v->r->o.scene, v->r->o.out,
               v->r->o.seed);
    return ok;
}

// ---------------------------------------------------------------------------------------------
// >>neural_trial: the test sequences in full space and in the subspaces, side by side
// ---------------------------------------------------------------------------------------------

enum { NEURAL_TRIAL_VANILLA, NEURAL_TRIAL_LIPSCHITZ, NEURAL_TRIAL_LINEAR, NEURAL_TRIAL_FULL, NEURAL_TRIALS };
static const char *const neural_trial_names[] = {"vanilla", "lipschitz", "linear", "full"};

typedef struct neural_entry {
    int used;
    tss_model m;
    tss_reduced *s;
    tss_elements *cells;  // solver.cubature; NULL: all
    // Of each step of the tests: s (the shortest of --repeat), counts, exit, and what remains of the
    // gradient, J; distance from full space over the diagonal, of all nodes and the farthest.
    double *seconds, *gradient, *energy, *mean, *farthest;
    int *iterations, *evaluations, *exit;
    // Distance of the tests' states from the nearest that the decoder reaches, over the diagonal.
    double projection_mean, projection_farthest;
    double *projected, *projected_farthest;  // of each such state
    int projections;
    double lip[3], lip_decoder, z_scale, train_seconds;  // Eq. 7 and its orders 0 and 1 (Eq. 12), with handles; without; spread of z: lip · spread³ does not see z stretched
} neural_entry;

typedef struct neural_trial {
    neural *v;
    neural_entry e[NEURAL_TRIALS];
    int steps, first;  // first sequence: 0, or behind those of training (validate)
    int each;          // steps of a sequence: all, or --steps of them
    double diagonal, *room, *force, *target;
    struct neural_bridges *bridges;  // NULL: none
} neural_trial;

// The best r modes of the frames, n × r.
static double *neural_best_modes(const neural *v) {
    size_t r = (size_t)v->d->r, n = (size_t)v->n;
    double *B = (double *)need(n * r, sizeof *B);
    for (size_t j = 0; j < n; j++) memcpy(B + j * r, v->B + j * (size_t)v->p, r * sizeof *B);
    return B;
}

static int neural_linear(neural *v, tss_model *m) {
    int r = v->d->r, width[2] = {r, r};
    double *B = neural_best_modes(v);
    tss_net_def d = tss_net_def_default();
    d.layers = 1, d.width = width, d.outputs = v->n, d.out_base = v->x0, d.out_matrix = B;
    tss_result e = tss_net_create(NULL, &d, &m->decoder);
    free(B);
    if (e != TSS_OK) return fail(v->r, "out of memory");
    double *theta = tss_net_parameters(m->decoder);
    for (int i = 0; i < r * r + r; i++) theta[i] = i < r * r && i % (r + 1) == 0;
    return 1;
}

// solver.stretch: what vanilla and the linear subspace gain in another unit of z. Their states stay.
static int neural_stretch(neural *v, tss_model *m) {
    int r = v->d->r;
    double *T = (double *)need((size_t)(r * r), sizeof *T);
    for (int i = 0; i < r; i++) T[i * (r + 1)] = 1 / v->d->solver.stretch;
    tss_result e = v->d->solver.stretch == 1 ? TSS_OK : tss_model_change_z(m, T);
    free(T);
    return e == TSS_OK ? 1 : fail(v->r, "%s: neural.solver.stretch: %s", v->r->o.scene, tss_result_text(e));
}

static int neural_entry_open(neural_trial *t, int which) {
    neural *v = t->v;
    neural_entry *e = &t->e[which];
    const scene_neural *d = v->d;
    size_t steps = (size_t)t->steps;
    int there = 1;
    e->seconds = (double *)need(5 * steps, sizeof(double)), e->gradient = e->seconds + steps;
    e->energy = e->gradient + steps, e->mean = e->energy + steps, e->farthest = e->mean + steps;
    e->iterations = (int *)need(3 * steps, sizeof(int)), e->evaluations = e->iterations + steps, e->exit = e->evaluations + steps;
    for (size_t k = 0; k < steps; k++) e->seconds[k] = INFINITY;
    if (which == NEURAL_TRIAL_FULL) {
        e->used = !v->r->o.no_full;
        return 1;
    }
    if (which == NEURAL_TRIAL_LINEAR && d->unsupervised) return 1;
    neural_phase phase = which == NEURAL_TRIAL_VANILLA ? NEURAL_VANILLA : NEURAL_LIPSCHITZ;
    if (which == NEURAL_TRIAL_LINEAR ? !neural_linear(v, &e->m) : !neural_read(v, phase, &e->m, &there)) return 0;
    if (!there) return neural_missing(v, phase);
    neural_selection chosen;
    if (which == NEURAL_TRIAL_LIPSCHITZ && d->unsupervised && !neural_whitening_read(v)) return 0;
    if (!neural_cubature(v, &e->m, which == NEURAL_TRIAL_LIPSCHITZ ? NEURAL_LIPSCHITZ : NEURAL_VANILLA, d->solver.cubature, &e->cells, &chosen)) return 0;
    if (which != NEURAL_TRIAL_LIPSCHITZ && !neural_stretch(v, &e->m)) return 0;
    tss_reduced_def rd = neural_solver(v, e->m.decoder, e->cells);
    tss_host host = tss_host_default();
    host.log = print_log, host.workers = v->r->o.threads;
    e->used = 1;
    if (which != NEURAL_TRIAL_LINEAR)
        e->train_seconds = neural_spent(v, NEURAL_BASE, (uint64_t)d->train.steps) + neural_spent(v, phase, e->m.step);
    return tss_reduced_create(&host, &rd, &e->s) == TSS_OK ? 1 : fail(v->r, "%s: neural.solver is refused", v->r->o.scene);
}

static int neural_trial_open(neural *v, neural_trial *t) {
    double lo[3], hi[3];
    memset(t, 0, sizeof *t);
    t->v = v;
    if (!neural_expect(v, NEURAL_VANILLA) || !neural_expect(v, NEURAL_LIPSCHITZ) || !neural_frames(v)) return 0;
    if (v->stopped) return fail(v->r, "%s/frames.bin: not all frames are there yet", v->r->o.out);
    if (v->d->script.validate) {
        neural_start start;
        int failed = 0;
        size_t each = (size_t)v->n * (size_t)v->d->script.length;
        start.data = save_world(v->r->w, &start.size);
        t->first = v->d->script.test + v->d->script.train;
        for (int k = 0, ok = 1; ok && k < v->d->script.test; k++) ok = neural_sequence(v, &start, t->first + k, v->test + (size_t)k * each, &failed);
        int ok = load_world(v->r, v->r->w, start.data, start.size);
        free(start.data);
        if (!ok || v->r->why.text[0]) return 0;
    }
    if (!v->d->unsupervised && !neural_basis(v)) return 0;
    t->each = (v->d->script.length - v->d->script.settle) / v->d->script.stride;
    if (v->r->o.steps > 0 && v->r->o.steps < t->each) t->each = v->r->o.steps;
    t->steps = v->d->script.test * t->each;
    if (t->steps < 1)
        return fail(v->r, "%s: neural.script.settle is %d, expected at least a stride below length (%d)", v->r->o.scene, v->d->script.settle,
                    v->d->script.length);
    if (v->d->script.stride > v->d->script.length || (v->h > 0 && v->d->script.stride > 1))
        return fail(v->r, "%s: neural.script.stride is %d, expected at most length (%d), and 1 unless quasi-static", v->r->o.scene,
                    v->d->script.stride, v->d->script.length);
    t->room = (double *)need(3 * (size_t)v->n, sizeof(double)), t->force = t->room + v->n, t->target = t->force + v->n;
    scene__box_empty(lo, hi);
    for (int i = 0; i < v->n; i++)
        lo[i % v->dim] = fmin(lo[i % v->dim], v->X[i]), hi[i % v->dim] = fmax(hi[i % v->dim], v->X[i]);
    for (int c = 0; c < v->dim; c++) t->diagonal += (hi[c] - lo[c]) * (hi[c] - lo[c]);
    t->diagonal = sqrt(t->diagonal);
    for (int k = 0; k < NEURAL_TRIALS; k++)
        if (!neural_entry_open(t, k)) return 0;
    return 1;
}

static void neural_trial_close(neural_trial *t) {
    for (int k = 0; k < NEURAL_TRIALS; k++) {
        tss_reduced_destroy(t->e[k].s), tss_model_free(&t->e[k].m), tss_elements_destroy(t->e[k].cells);
        free(t->e[k].seconds), free(t->e[k].iterations), free(t->e[k].projected);
    }
    free(t->room);
}

// ‖x − y‖ of the nodes over the diagonal: the mean, and the farthest.
static void neural_distance(const neural_trial *t, const double *x, const double *y, double *mean, double *farthest_) {
    const neural *v = t->v;
    *mean = *farthest_ = 0;
    for (int i = 0; i < v->nodes; i++) {
        double s = 0;
        for (int j = v->dim * i; j < v->dim * (i + 1); j++) s += (x[j] - y[j]) * (x[j] - y[j]);
        *mean += sqrt(s) / (v->nodes * t->diagonal), *farthest_ = fmax(*farthest_, sqrt(s) / t->diagonal);
    }
}

static double neural_cpu(void) {
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// With one thread the time that it ran: what else the machine does then counts little.
static double neural_clock(const neural *v) { return v->r->o.threads == 1 ? neural_cpu() : now(NULL); }

// Where full space has step k of a test sequence.
static const double *neural_truth(const neural_trial *t, int sequence, int k) {
    return t->v->test + ((size_t)sequence * (size_t)t->v->d->script.length + (size_t)k) * (size_t)t->v->n;
}

// A step of the tests by one subspace; `at`: of all. Seconds include decoding.
static int neural_trial_step(neural_trial *t, neural_entry *e, int at, const double *truth) {
    neural *v = t->v;
    tss_reduced_info i;
    double began = neural_clock(v);
    tss_result r = tss_reduced_set_handles(e->s, v->handles, v->handle, t->target);
    tss_reduced_set_force(e->s, t->force);
    if (r == TSS_OK) r = tss_reduced_step(e->s, &i);
    if (r != TSS_OK) return fail(v->r, "%s: test step %d: %s", v->r->o.scene, at + 1, tss_result_text(r));
    const double *x = tss_reduced_x(e->s);
    e->seconds[at] = fmin(e->seconds[at], neural_clock(v) - began);
    e->iterations[at] = i.iterations, e->evaluations[at] = i.evaluations, e->exit[at] = (int)i.exit;
    e->gradient[at] = i.gradient, e->energy[at] = i.energy;
    neural_distance(t, x, truth, &e->mean[at], &e->farthest[at]);
    return 1;
}

// Full space takes the script's steps one by one, up to and with step k.
static int neural_trial_full(neural_trial *t, const neural_script *s, int k, int at) {
    neural_entry *e = &t->e[NEURAL_TRIAL_FULL];
    tss_step_info i;
    double began = neural_clock(t->v);
    e->iterations[at] = 0, e->exit[at] = TSS_EXIT_CONVERGED;
    for (int q = k - t->v->d->script.stride + 1; q <= k; q++) {
        if (!neural_full_step(t->v, s, q, t->room, &i)) return 0;
        e->iterations[at] += i.newton;
        if (i.status != TSS_STEP_CONVERGED) e->exit[at] = TSS_EXIT_ITERATIONS;
    }
    e->seconds[at] = fmin(e->seconds[at], neural_clock(t->v) - began), e->evaluations[at] = e->iterations[at];
    e->energy[at] = tss_elements_potential(t->v->elements, tss_world_positions(t->v->r->w), NULL);
    return 1;
}

typedef int neural_watch(neural_trial *t, int sequence, int k, void *ctx);  // 0: fails

static int neural_bridges_begin(neural_trial *t);
static int neural_bridges_step(neural_trial *t, const neural_script *s, int k, int at);

static int neural_trial_sequence(neural_trial *t, int number, const neural_start *start, neural_watch *watch, void *ctx) {
    neural *v = t->v;
    neural_script s = neural_script_of(v, t->first + number);
    int ok = load_world(v->r, v->r->w, start->data, start->size), stride = v->d->script.stride, settle = v->d->script.settle;
    int full = t->e[NEURAL_TRIAL_FULL].used;
    tss_step_info first;
    for (int k = 0; ok && full && k < settle; k++) ok = neural_full_step(v, &s, k, t->room, &first);
    for (int q = 0; ok && q < NEURAL_TRIAL_FULL; q++) {
        if (!t->e[q].used) continue;
        const double *from = settle ? neural_truth(t, number, settle - 1) : v->x0;
        (void)tss_reduced_set_handles(t->e[q].s, 0, NULL, NULL);
        tss_result r = neural_rest(v, &t->e[q].m, t->e[q].s, from);
        if (r != TSS_OK) ok = fail(v->r, "%s: the start cannot be projected: %s", v->r->o.scene, tss_result_text(r));
    }
    if (ok && t->bridges) ok = neural_bridges_begin(t);
    for (int step = 0; ok && step < t->each; step++) {
        int k = settle + stride * (step + 1) - 1, at = number * t->each + step;
        ok = !full || neural_trial_full(t, &s, k, at);
        memcpy(v->ball.center, s.center + 3 * k, sizeof v->ball.center);
        neural_targets(v, &s, k, t->target), neural_forces(v, &s, k, 1, t->force);
        for (int q = 0; ok && q < NEURAL_TRIAL_FULL; q++) {  // who is first takes turns
            neural_entry *e = &t->e[(q + at) % NEURAL_TRIAL_FULL];
            if (e->used) ok = neural_trial_step(t, e, at, neural_truth(t, number, k));
        }
        if (ok && t->bridges) ok = neural_bridges_step(t, &s, k, at);
        if (ok && watch) ok = watch(t, number, k, ctx);
        neural_progress(v, (at + 1.0) / t->steps, "test step %d of %d", at + 1, t->steps);
    }
    neural_script_free(&s);
    return ok;
}

static int neural_trial_run(neural_trial *t, neural_watch *watch, void *ctx) {
    neural_start start;
    int ok = 1;
    start.data = save_world(t->v->r->w, &start.size);
    for (int pass = 0; ok && pass < t->v->r->o.repeat; pass++)
        for (int q = 0; ok && q < t->v->d->script.test; q++)
            ok = neural_trial_sequence(t, q, &start, pass == 0 ? watch : NULL, ctx);
    free(start.data);
    return ok;
}

static double neural_mean(const double *v, int n) {
    double s = 0;
    for (int i = 0; i < n; i++) s += v[i] / n;
    return s;
}
static double neural_mean_of(const int *v, int n) {
    double s = 0;
    for (int i = 0; i < n; i++) s += (double)v[i] / n;
    return s;
}
static double neural_most(const double *v, int n) {
    double s = 0;
    for (int i = 0; i < n; i++) s = fmax(s, v[i]);
    return s;
}
static int neural_exits(const neural_entry *e, int n, tss_exit x) {
    int s = 0;
    for (int i = 0; i < n; i++) s += e->exit[i] == (int)x;
    return s;
}

static void neural_table(const neural_trial *t) {
    printf("%-10s %9s %7s %7s %24s %10s %10s %10s %10s %10s %9s\n", "method", "ms/step", "iter.", "eval.",
           "converged/saddle/line/it", "gradient", "energy", "error", "farthest", "projection", "Lip");
    for (int k = 0; k < NEURAL_TRIALS; k++) {
        const neural_entry *e = &t->e[k];
        char exits[60], projection[32], lip[32];
        int n = t->steps;
        if (!e->used) continue;
        snprintf(exits, sizeof exits, "%d/%d/%d/%d", neural_exits(e, n, TSS_EXIT_CONVERGED), neural_exits(e, n, TSS_EXIT_SADDLE),
                 neural_exits(e, n, TSS_EXIT_LINE_SEARCH), neural_exits(e, n, TSS_EXIT_ITERATIONS));
        snprintf(projection, sizeof projection, e->projection_mean > 0 ? "%.3g" : "-", e->projection_mean);
        snprintf(lip, sizeof lip, e->lip[2] > 0 ? "%.4g" : "-", e->lip[2]);  // by `run` neither is measured
        printf("%-10s %9.3f %7.1f %7.1f %24s %10.3g %10.5g %10.3g %10.3g %10s %9s\n", neural_trial_names[k],
               1e3 * neural_mean(e->seconds, n), neural_mean_of(e->iterations, n), neural_mean_of(e->evaluations, n), exits,
               neural_mean(e->gradient, n), neural_mean(e->energy, n), neural_mean(e->mean, n), neural_most(e->farthest, n), projection, lip);
    }
}

// ---------------------------------------------------------------------------------------------
// >>neural_evaluate
// ---------------------------------------------------------------------------------------------

// Every fourth state of the tests.
static int neural_project(neural_trial *t, neural_entry *e) {
    neural *v = t->v;
    int *count = &e->projections;
    e->projected = (double *)need(2 * (size_t)v->tests, sizeof(double)), e->projected_farthest = e->projected + v->tests;
    (void)tss_reduced_set_handles(e->s, 0, NULL, NULL);
    for (int f = 0; f < v->tests; f += 4, ++*count) {
        double *mean = &e->projected[*count], *most = &e->projected_farthest[*count];
        const double *x = v->test + (size_t)f * (size_t)v->n;
        double *z = e->m.encoder ? neural_z(v, &e->m, NEURAL_VANILLA, x, 1) : NULL;
        if (z) (void)tss_reduced_set(e->s, z);
        free(z);
        if (tss_reduced_project(e->s, x, NULL) != TSS_OK) return fail(v->r, "%s: test state %d cannot be projected", v->r->o.scene, f);
        neural_distance(t, tss_reduced_x(e->s), x, mean, most);
        e->projection_mean += *mean, e->projection_farthest = fmax(e->projection_farthest, *most);
    }
    e->projection_mean /= *count;
    return 1;
}

// Eq. 7 with all cells, in the unit of z and of the spread of z.
static int neural_lip(neural_trial *t, neural_entry *e) {
    neural *v = t->v;
    int count = v->d->samples;
    double *x = neural_spread(v, v->test, v->tests, count < v->tests || v->d->unsupervised ? count : v->tests);
    if (!v->d->unsupervised && count > v->tests) count = v->tests;
    double *z = neural_z(v, &e->m, e == &t->e[NEURAL_TRIAL_LIPSCHITZ] ? NEURAL_LIPSCHITZ : NEURAL_VANILLA, x, count);
    tss_result r = TSS_OK;
    for (int i = 0; i < count * v->d->r && !e->m.encoder && e == &t->e[NEURAL_TRIAL_VANILLA]; i++) z[i] *= v->d->solver.stretch;
    for (int o = 0; o < 3 && r == TSS_OK; o++) r = neural_eq7(v, &e->m, v->elements, 1, o, count, x, z, &e->lip[o]);
    e->lip_decoder = e->lip[2];
    if (v->pinned && r == TSS_OK) r = neural_eq7(v, &e->m, v->elements, 0, 2, count, x, z, &e->lip_decoder);
    double *mean = (double *)need((size_t)v->d->r, sizeof *mean);
    e->z_scale = neural_z_scale(z, count, v->d->r, mean);
    free(x), free(z), free(mean);
    return r == TSS_OK ? 1 : fail(v->r, "%s: Eq. 7: %s", v->r->o.scene, tss_result_text(r));
}

static void neural_machine(char text[160]) {
    char line[200];
    FILE *f = fopen("/proc/cpuinfo", "r");
    snprintf(text, 160, "unknown processor");
    while (f && fgets(line, sizeof line, f))
        if (strncmp(line, "model name", 10) == 0 && strchr(line, ':')) {
            line[strcspn(line, "\n")] = 0;
            snprintf(text, 160, "%.150s", strchr(line, ':') + 2);
            break;
        }
    if (f) fclose(f);
}

static int neural_rows(neural_trial *t) {
    neural *v = t->v;
    char path[700], name[120], machine[160];
    snprintf(path, sizeof path, "%s/evaluate.csv", v->r->o.out);
    int old = access(path, F_OK) == 0, n = t->steps;
    FILE *f = fopen(path, "a");
    if (!f) return fail(v->r, "%s: cannot be written: %s", path, strerror(errno));
    neural_machine(machine);
    fprintf(f, "# %s, threads %d, test steps %d, best of %d", machine, v->r->o.threads, n, v->r->o.repeat);
    for (int k = 0; k < v->r->o.sets; k++) fprintf(f, "%s %s", k ? "" : ", with", v->r->o.set[k]);
    fputc('\n', f);
    if (!old)
        fputs("system,method,seed,dof,elements,r,step_ms,iterations,evaluations,exit_converged,exit_saddle,exit_line,"
              "exit_iterations,gradient,lip,projection_error,simulation_error,train_seconds,projection_max,simulation_max,"
              "energy,z_scale,lip_relative,lipschitz_weight,solver,lip_0,lip_1,order,eps,runtime_cells,lip_decoder\n", f);
    for (int k = 0; k < NEURAL_TRIALS; k++) {
        const neural_entry *e = &t->e[k];
        if (!e->used) continue;
        fprintf(f, "%s,%s,%d,%d,%d,%d,%.6g,%.6g,%.6g,%d,%d,%d,%d,%.6g,%.6g,%.6g,%.6g,%.6g,%.6g,%.6g,%.8g,%.6g,%.6g,%.6g,%s,%.6g,%.6g,%d,%g,%d,%.6g\n",
                sweep_name(v->r, name), neural_trial_names[k], v->r->o.seed, v->n, v->cells, k == NEURAL_TRIAL_FULL ? v->n : v->d->r,
                1e3 * neural_mean(e->seconds, n), neural_mean_of(e->iterations, n), neural_mean_of(e->evaluations, n),
                neural_exits(e, n, TSS_EXIT_CONVERGED), neural_exits(e, n, TSS_EXIT_SADDLE), neural_exits(e, n, TSS_EXIT_LINE_SEARCH),
                neural_exits(e, n, TSS_EXIT_ITERATIONS), neural_mean(e->gradient, n), e->lip[2], e->projection_mean,
                neural_mean(e->mean, n), e->train_seconds, e->projection_farthest, neural_most(e->farthest, n),
                neural_mean(e->energy, n), e->z_scale, e->lip[2] * pow(e->z_scale, 3), k == NEURAL_TRIAL_LIPSCHITZ ? v->d->lipschitz.weight : 0,
                k == NEURAL_TRIAL_FULL ? "newton" : scene__reduced_solvers[v->d->solver.kind], e->lip[0], e->lip[1],
                v->d->lipschitz.order, v->d->solver.eps, e->cells ? v->d->solver.cubature : v->cells, e->lip_decoder);
    }
    return fclose(f) == 0 ? 1 : fail(v->r, "%s: cannot be written", path);
}

static int neural_ascending(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// Value q of 10 of n numbers in ascending order, linear between them (0: the least, 10: the largest).
static double neural_decile(const double *x, int n, int q) {
    double at = q * (n - 1) / 10.0;
    int k = at >= n - 1 ? n - 1 : (int)at;
    return x[k] + (k < n - 1 ? (at - k) * (x[k + 1] - x[k]) : 0);
}

// DIR/errors.csv: the distributions of what evaluate.csv has the means of, over states.
static int neural_errors(neural_trial *t) {
    neural *v = t->v;
    char path[700], name[120];
    snprintf(path, sizeof path, "%s/errors.csv", v->r->o.out);
    int old = access(path, F_OK) == 0;
    FILE *f = fopen(path, "a");
    if (!f) return fail(v->r, "%s: cannot be written: %s", path, strerror(errno));
    if (!old) fputs("system,method,seed,percent,simulation,simulation_farthest,projection,projection_farthest\n", f);
    for (int k = 0; k < NEURAL_TRIAL_FULL; k++) {
        neural_entry *e = &t->e[k];
        double *of[] = {e->mean, e->farthest, e->projected, e->projected_farthest};
        int n[] = {t->steps, t->steps, e->projections, e->projections};
        for (int i = 0; e->used && i < 4; i++) qsort(of[i], (size_t)n[i], sizeof(double), neural_ascending);
        for (int q = 0; e->used && q <= 10; q++) {
            fprintf(f, "%s,%s,%d,%d", sweep_name(v->r, name), neural_trial_names[k], v->r->o.seed, 10 * q);
            for (int i = 0; i < 4; i++) fprintf(f, ",%.6g", neural_decile(of[i], n[i], q));
            fputc('\n', f);
        }
    }
    return fclose(f) == 0 ? 1 : fail(v->r, "%s: cannot be written", path);
}

static int neural_evaluate(neural *v) {
    neural_trial t;
    int ok = neural_trial_open(v, &t) && neural_trial_run(&t, NULL, NULL);
    for (int k = 0; ok && k < NEURAL_TRIAL_FULL; k++)
        if (t.e[k].used) ok = neural_project(&t, &t.e[k]) && (k == NEURAL_TRIAL_LINEAR || neural_lip(&t, &t.e[k]));
    if (ok) neural_table(&t);
    if (ok) {
        const neural_entry *a = &t.e[NEURAL_TRIAL_VANILLA], *b = &t.e[NEURAL_TRIAL_LIPSCHITZ];
        printf("speedup %.3f evaluations %.3f lip %.3f (relative to the spread of z %.3f, without handles %.3f) projection %.3f simulation %.3f "
               "(vanilla over lipschitz, the last two the other way)\n",
               neural_mean(a->seconds, t.steps) / neural_mean(b->seconds, t.steps),
               neural_mean_of(a->evaluations, t.steps) / neural_mean_of(b->evaluations, t.steps), a->lip[2] / b->lip[2],
               a->lip[2] * pow(a->z_scale, 3) / (b->lip[2] * pow(b->z_scale, 3)), a->lip_decoder / b->lip_decoder,
               b->projection_mean / a->projection_mean, neural_mean(b->mean, t.steps) / neural_mean(a->mean, t.steps));
        ok = neural_rows(&t) && neural_errors(&t);
    }
    neural_trial_close(&t);
    return ok;
}

// ---------------------------------------------------------------------------------------------
// >>neural_bridge: the tests by the adaptive simulator (tss_subspace.h), beside full space: the tangent
// of each decoder at the state at hand, and fixed bases of as many columns, each with and without the
// oracle. All have full space's energy, script and solver tolerance; all columns are active, so that
// what the oracle adds are nodes. Fixed bases start where full space does. A tangent starts from x_t as
// it is: what 2x_t − x_{t−1} adds across the manifold, no later tangent takes back (neural_settings.md). If quasi-
// static, where the start is a guess and no more, it is tried too with the start moved onto the manifold
// ("retracted"). The decoders' own solver runs along.
// ---------------------------------------------------------------------------------------------

typedef enum neural_bridge_kind { NEURAL_BRIDGE_TANGENT, NEURAL_BRIDGE_LINEAR, NEURAL_BRIDGE_EIGEN, NEURAL_BRIDGE_SKINNING } neural_bridge_kind;

static const struct {
    const char *name;
    neural_bridge_kind kind;
    int model, retract;  // model: of a tangent, of the trial's
} neural_bridge_bases[] = {
    {"vanilla", NEURAL_BRIDGE_TANGENT, NEURAL_TRIAL_VANILLA, 0}, {"vanilla_retracted", NEURAL_BRIDGE_TANGENT, NEURAL_TRIAL_VANILLA, 1},
    {"lipschitz", NEURAL_BRIDGE_TANGENT, NEURAL_TRIAL_LIPSCHITZ, 0}, {"lipschitz_retracted", NEURAL_BRIDGE_TANGENT, NEURAL_TRIAL_LIPSCHITZ, 1},
    {"linear", NEURAL_BRIDGE_LINEAR, 0, 0}, {"eigen", NEURAL_BRIDGE_EIGEN, 0, 0}, {"skinning", NEURAL_BRIDGE_SKINNING, 0, 0},
};
enum { NEURAL_BRIDGES = sizeof neural_bridge_bases / sizeof *neural_bridge_bases };

typedef struct neural_bridge_entry {
    neural_trial *t;
    int basis, oracle, columns, fresh;  // fresh: no step of the sequence yet
    tss_world *w;
    neural_start start;
    double *before, *room;       // n, n × (r + 1)
    tss_decoder_basis *tangent;  // NULL: a fixed basis
    const tss_net *decoder;
    double refresh, off;  // of the step at hand: s; distance of its start from f(z)
    double *seconds, *refreshes, *offs, *mean, *farthest;  // of each step, as of neural_entry
    int *iterates, *added, *enriched, *failed;
} neural_bridge_entry;

typedef struct neural_bridges {
    neural_bridge_entry e[2 * NEURAL_BRIDGES];
    int count, nodes;  // nodes: unknown ones
} neural_bridges;

// tss_decoder_basis_refresh, timed.
static void neural_bridge_refresh(void *user, const tss_ctx *c, int first, int nodes, double *columns) {
    neural_bridge_entry *e = (neural_bridge_entry *)user;
    double began = neural_clock(e->t->v), farthest_;
    tss_decoder_basis_refresh(e->tangent, c, first, nodes, columns);
    e->refresh += neural_clock(e->t->v) - began;
    (void)tss_net_forward(e->decoder, e->t->v->work, 1, tss_decoder_basis_z(e->tangent), e->room);
    neural_distance(e->t, e->room, c->x_t + first * e->t->v->dim, &e->off, &farthest_);
}

// The world to the nearest f(z), but for what is held.
static int neural_bridge_retract(neural_bridge_entry *e) {
    neural *v = e->t->v;
    tss_ctx c;
    memset(&c, 0, sizeof c);
    c.dim = v->dim, c.nodes = v->nodes, c.x_t = tss_world_positions(e->w);
    neural_bridge_refresh(e, &c, 0, v->nodes, e->room + v->n);
    for (int i = 0; i < v->n; i++) e->room[i] = v->held[i] ? c.x_t[i] : e->room[i];
    return tss_body_teleport(e->w, 0, e->room, NULL) == TSS_OK ? 1 : fail(v->r, "%s: bridge: %s", v->r->o.scene, tss_world_error(e->w));
}

// Skinning modes come in blocks of d(d + 1) columns: as many as have at least r. Where nothing is held
// the constant is a block that is not counted.
static int neural_bridge_handles(const neural *v) {
    int block = v->dim * (v->dim + 1), handles = (v->d->r + block - 1) / block, held = 0;
    for (int i = 0; i < v->n; i++) held |= v->held[i];
    return held || handles == 1 ? handles : handles - 1;
}

static int neural_bridge_basis(neural_bridge_entry *e) {
    neural_trial *t = e->t;
    neural *v = t->v;
    int r = v->d->r;
    double *B = NULL;
    tss_basis_def d = tss_basis_eigen(r);
    tss_basis_info info;
    tss_basis id;
    tss_result ok = TSS_OK;
    neural_bridge_kind kind = neural_bridge_bases[e->basis].kind;
    if (kind == NEURAL_BRIDGE_SKINNING) {
        d = tss_basis_skinning(neural_bridge_handles(v)), d.initial = -1;
    } else if (kind == NEURAL_BRIDGE_LINEAR) {
        B = neural_best_modes(v);
        d = tss_basis_arrays(r, NULL, B, NULL);
    } else if (kind == NEURAL_BRIDGE_TANGENT) {
        const tss_model *m = &t->e[neural_bridge_bases[e->basis].model].m;
        e->decoder = m->decoder;
        ok = tss_decoder_basis_create(tss_world_host(e->w), v->dim, m->decoder, m->encoder, v->mass, NULL, &e->tangent);
        d = tss_basis_custom(r, NULL, neural_bridge_refresh, e);
    }
    if (ok == TSS_OK) ok = tss_basis_add(e->w, 0, &d, &id);
    if (ok == TSS_OK) ok = tss_basis_get(e->w, id, &info);
    free(B);
    if (ok != TSS_OK)
        return fail(v->r, "%s: bridge: %s: %s", v->r->o.scene, neural_bridge_bases[e->basis].name,
                    tss_world_error(e->w)[0] ? tss_world_error(e->w) : tss_result_text(ok));
    e->columns = info.modes;
    return 1;
}

static int neural_bridge_open(neural_bridge_entry *e) {
    neural *v = e->t->v;
    size_t steps = (size_t)e->t->steps;
    tss_subspace_def d = scene__subspace_def(&v->r->s);
    tss_result ok;
    e->seconds = (double *)need(5 * steps, sizeof(double)), e->refreshes = e->seconds + steps, e->offs = e->refreshes + steps;
    e->mean = e->offs + steps, e->farthest = e->mean + steps;
    e->iterates = (int *)need(4 * steps, sizeof(int)), e->added = e->iterates + steps, e->enriched = e->added + steps;
    e->failed = e->enriched + steps, e->before = (double *)need((size_t)v->n * (size_t)(v->d->r + 2), sizeof(double)), e->room = e->before + v->n;
    for (size_t k = 0; k < steps; k++) e->seconds[k] = INFINITY;
    if (!neural_world(v, &e->w)) return 0;
    d.mode = e->oracle ? TSS_MODE_ADAPTIVE : TSS_MODE_SUBSPACE;
    ok = tss_subspace_add(e->w, &d, NULL);
    for (int i = 0; i < v->handles && ok == TSS_OK; i++)  // a basis must find them scripted
        ok = tss_node_target(e->w, v->handle[i], v->x0 + v->dim * v->handle[i]);
    if (ok != TSS_OK) return fail(v->r, "%s: bridge: %s", v->r->o.scene, tss_world_error(e->w));
    if (!neural_bridge_basis(e)) return 0;
    if (tss_world_ready(e->w) != TSS_OK) return fail(v->r, "%s: bridge: %s", v->r->o.scene, tss_world_error(e->w));
    e->start.data = save_world(e->w, &e->start.size);
    return 1;
}

static void neural_bridge_close(neural_bridge_entry *e) {
    tss_world_destroy(e->w), tss_decoder_basis_destroy(e->tangent);
    free(e->start.data), free(e->before), free(e->seconds), free(e->iterates);
}

// Before the first step of a sequence; what settled is taken from full space.
static int neural_bridges_begin(neural_trial *t) {
    neural *v = t->v;
    int ok = 1;
    for (int q = 0; ok && q < t->bridges->count; q++) {
        neural_bridge_entry *e = &t->bridges->e[q];
        ok = load_world(v->r, e->w, e->start.data, e->start.size);
        e->fresh = 1;
        memcpy(e->before, v->before, (size_t)v->n * sizeof *e->before);
        if (ok && v->d->script.settle && tss_world_copy_state(e->w, v->r->w) != TSS_OK)
            ok = fail(v->r, "%s: bridge: %s", v->r->o.scene, tss_world_error(e->w));
        double *z = (double *)need((size_t)v->d->r, sizeof *z);
        if (e->tangent) (void)tss_decoder_basis_set(e->tangent, z);
        free(z);
    }
    return ok;
}

static int neural_bridge_enriched(const neural_bridge_entry *e) {
    tss_subspace_info info;
    int count = 0;
    tss_subspace_get_info(tss_subspace_of(e->w), &info);
    for (int i = 0; info.enriched && !e->fresh && i < e->t->v->nodes; i++) count += info.enriched[i] != 0;
    return count;
}

static int neural_bridges_step(neural_trial *t, const neural_script *s, int k, int at) {
    neural *v = t->v;
    neural_bridges *b = t->bridges;
    for (int q = 0; q < b->count; q++) {  // who is first takes turns
        neural_bridge_entry *e = &b->e[(q + at) % b->count];
        tss_step_info i;
        int before = neural_bridge_enriched(e), retract = neural_bridge_bases[e->basis].retract;
        double began = neural_clock(v);
        e->refresh = e->off = 0;
        if ((!e->tangent || retract) && !neural_predict(v, e->w, e->before, s, k, t->room)) return 0;
        if (retract && !neural_bridge_retract(e)) return 0;
        if (!neural_world_step(v, e->w, neural_bridge_bases[e->basis].name, s, k, t->room, &i)) return 0;
        double spent = neural_clock(v) - began;
        if (spent < e->seconds[at]) e->seconds[at] = spent, e->refreshes[at] = e->refresh;
        e->iterates[at] = i.newton, e->enriched[at] = i.enriched_nodes, e->added[at] = i.enriched_nodes - before;
        e->failed[at] = i.status != TSS_STEP_CONVERGED, e->offs[at] = e->off, e->fresh = 0, b->nodes = i.nodes;
        neural_distance(t, tss_world_positions(e->w), tss_world_positions(v->r->w), &e->mean[at], &e->farthest[at]);
    }
    return 1;
}

static const char neural_bridge_head[] =
    "system,basis,seed,r,oracle,step_ms,iterates,added,enriched,nodes,refresh_ms,failed,simulation_error,simulation_max,"
    "start_error,dof,elements,steps,error_nodes,progress,tol_rel\n";

static void neural_bridge_row(const neural_trial *t, FILE *f, const char *basis, int columns, const char *oracle, const double value[10]) {
    const neural *v = t->v;
    char name[120];
    fprintf(f, "%s,%s,%d,%d,%s", sweep_name(v->r, name), basis, v->r->o.seed, columns, oracle);
    for (int k = 0; k < 10; k++) fprintf(f, ",%.6g", value[k]);
    fprintf(f, ",%d,%d,%d,%g,%g,%g\n", v->n, v->cells, t->steps, v->r->s.solver.error_nodes, v->r->s.solver.progress, v->r->s.solver.tol_rel);
    printf("%-19s %5d %-8s %9.3f %9.3f %7.1f %8.2f %9.1f %7g %10.3g %10.3g %10.3g\n", basis, columns, oracle, value[0], value[5],
           value[1], value[2], value[3], value[6], value[7], value[8], value[9]);
}

static void neural_bridge_write(neural_trial *t, FILE *f) {
    int n = t->steps;
    printf("%-19s %5s %-8s %9s %9s %7s %8s %9s %7s %10s %10s %10s\n", "basis", "r", "oracle", "ms/step", "refresh", "iter.", "added",
           "enriched", "failed", "error", "farthest", "start");
    for (int k = 0; k < t->bridges->count; k++) {
        const neural_bridge_entry *e = &t->bridges->e[k];
        double value[10] = {1e3 * neural_mean(e->seconds, n), neural_mean_of(e->iterates, n), neural_mean_of(e->added, n),
                            neural_mean_of(e->enriched, n), t->bridges->nodes, 1e3 * neural_mean(e->refreshes, n), n * neural_mean_of(e->failed, n),
                            neural_mean(e->mean, n), neural_most(e->farthest, n), neural_mean(e->offs, n)};
        neural_bridge_row(t, f, neural_bridge_bases[e->basis].name, e->columns, e->oracle ? "on" : "off", value);
    }
    for (int k = 0; k < NEURAL_TRIALS; k++) {
        const neural_entry *e = &t->e[k];
        int full = k == NEURAL_TRIAL_FULL, nodes = t->bridges->nodes, late = neural_exits(e, n, TSS_EXIT_ITERATIONS);
        double value[10] = {1e3 * neural_mean(e->seconds, n), neural_mean_of(e->iterations, n), 0, full * nodes, nodes, 0, late,
                            neural_mean(e->mean, n), neural_most(e->farthest, n), 0};
        if (e->used) neural_bridge_row(t, f, neural_trial_names[k], full ? t->v->n : t->v->d->r, full ? "none" : "manifold", value);
    }
}

static int neural_bridge_rows(neural_trial *t) {
    const run *r = t->v->r;
    char path[700], machine[160];
    snprintf(path, sizeof path, "%s/bridge.csv", r->o.out);
    int old = access(path, F_OK) == 0;
    FILE *f = fopen(path, "a");
    if (!f) return fail(t->v->r, "%s: cannot be written: %s", path, strerror(errno));
    neural_machine(machine);
    fprintf(f, "# %s, threads %d, best of %d", machine, r->o.threads, r->o.repeat);
    for (int k = 0; k < r->o.sets; k++) fprintf(f, "%s %s", k ? "" : ", with", r->o.set[k]);
    fputc('\n', f);
    if (!old) fputs(neural_bridge_head, f);
    neural_bridge_write(t, f);
    return fclose(f) == 0 ? 1 : fail(t->v->r, "%s: cannot be written", path);
}

// Every step of the script is a step of all.
static int neural_bridge(neural *v) {
    static neural_bridges b;
    neural_trial t;
    memset(&t, 0, sizeof t), memset(&b, 0, sizeof b);
    if (v->shell) return fail(v->r, "%s: bridge: bodies[0].shell: expected a body of tetrahedra or plane triangles", v->r->o.scene);
    v->d->script.stride = 1;
    int ok = neural_trial_open(v, &t);
    t.bridges = &b;
    for (int k = 0; ok && k < 2 * NEURAL_BRIDGES; k++) {
        neural_bridge_entry *e = &b.e[b.count];
        if (neural_bridge_bases[k / 2].kind == NEURAL_BRIDGE_LINEAR && v->d->unsupervised) continue;
        if (neural_bridge_bases[k / 2].retract && v->h > 0) continue;
        e->t = &t, e->basis = k / 2, e->oracle = k % 2, b.count++;
        ok = neural_bridge_open(e);
    }
    ok = ok && neural_trial_run(&t, NULL, NULL) && neural_bridge_rows(&t);
    for (int k = 0; k < b.count; k++) neural_bridge_close(&b.e[k]);
    neural_trial_close(&t);
    return ok;
}

// ---------------------------------------------------------------------------------------------
// >>neural_measure: the cubature against all cells on the base, at states that did not choose it, and
// what a step of training costs without L_LS, with it, and with it on the cubature. CPU seconds of
// this thread, the three in turns, the shortest of each: others on the machine count little.
// ---------------------------------------------------------------------------------------------

#define NEURAL_TURNS 12  // of training steps

// ‖a − b‖ / ‖b‖ of a vector a state, the mean.
static double neural_relative(int count, int width, const double *a, const double *b) {
    double mean = 0;
    for (int k = 0; k < count; k++) {
        double d = 0, n = 0;
        for (int i = k * width; i < (k + 1) * width; i++) d += (a[i] - b[i]) * (a[i] - b[i]), n += b[i] * b[i];
        mean += n > 0 ? sqrt(d / n) / count : 0;
    }
    return mean;
}

// States for errors: encoded tests; unsupervised: N(0, I), behind those that chose the cells.
static double *neural_other_states(neural *v, const tss_model *m, int count) {
    size_t r = (size_t)v->d->r, skip = (size_t)v->d->lipschitz.samples;
    double *x = neural_spread(v, v->test, v->tests, count);
    double *z = neural_z(v, m, NEURAL_BASE, x, v->d->unsupervised ? count + (int)skip : count);
    if (v->d->unsupervised) memmove(z, z + skip * r, (size_t)count * r * sizeof *z);
    free(x);
    return z;
}

// error: relative, of ∇P, of ∇²P, of L_LS.
static int neural_cubature_errors(neural *v, const tss_model *m, double error[3]) {
    int r = v->d->r, count = NEURAL_SAMPLES;
    size_t n = (size_t)count * (size_t)r;
    double *z = neural_other_states(v, m, count), *g[2], *H[2], loss[2];
    const tss_elements *e[2] = {v->cubature ? v->cubature : v->elements, v->elements};
    tss_lipschitz_def d = neural_lipschitz(v);
    tss_result ok = TSS_OK;
    d.estimator = TSS_LIPSCHITZ_EXACT;
    for (int k = 0; k < 2; k++) {
        g[k] = (double *)need(n * (size_t)(r + 1), sizeof(double)), H[k] = g[k] + n;
        if (ok == TSS_OK) ok = tss_reduced_potential(m->decoder, e[k], v->work, count, z, NULL, g[k], H[k]);
        if (ok == TSS_OK) ok = tss_loss_lipschitz(m->decoder, e[k], v->work, &d, count, z, NULL, 1, &loss[k], NULL, NULL);
    }
    if (ok == TSS_OK) {
        error[0] = neural_relative(count, r, g[0], g[1]), error[1] = neural_relative(count, r * r, H[0], H[1]);
        error[2] = fabs(loss[0] - loss[1]) / loss[1];
    }
    free(z), free(g[0]), free(g[1]);
    return ok == TSS_OK ? 1 : fail(v->r, "%s: measure: %s", v->r->o.scene, tss_result_text(ok));
}

// seconds[0..2]: vanilla; L_LS on all cells; L_LS on the cubature. Nothing is written.
static int neural_step_costs(neural *v, double seconds[3]) {
    neural_trainer t[3];
    tss_elements *cubature = v->cubature;
    int ok = 1;
    memset(t, 0, sizeof t);
    for (int k = 0; ok && k < 3; k++) {
        v->cubature = k == 1 ? NULL : cubature;
        seconds[k] = INFINITY;
        ok = neural_trainer_open(v, k == 0 ? NEURAL_VANILLA : NEURAL_LIPSCHITZ, &t[k]);
    }
    for (int turn = 0; ok && turn < 3 * NEURAL_TURNS; turn++) {
        int k = turn % 3;
        tss_training_info i;
        v->cubature = k == 1 ? NULL : cubature;
        double began = neural_cpu();
        tss_result e = t[k].t ? tss_training_step(t[k].t, &i) : neural_step(&t[k], &i);
        seconds[k] = fmin(seconds[k], neural_cpu() - began);
        if (e != TSS_OK) ok = fail(v->r, "%s: training: %s", v->r->o.scene, tss_result_text(e));
    }
    v->cubature = cubature;
    for (int k = 0; k < 3; k++)
        if (t[k].v) neural_trainer_close(&t[k]);
    return ok;
}

static int neural_measure_row(neural *v, const neural_selection *s, const double error[3], const double seconds[3]) {
    char path[700], name[120], machine[160];
    snprintf(path, sizeof path, "%s/measure.csv", v->r->o.out);
    int old = access(path, F_OK) == 0;
    FILE *f = fopen(path, "a");
    if (!f) return fail(v->r, "%s: cannot be written: %s", path, strerror(errno));
    neural_machine(machine);
    fprintf(f, "# %s, one thread, best of %d\n", machine, NEURAL_TURNS);
    if (!old)
        fputs("system,seed,dof,elements,r,wanted,cells,select_seconds,select_error,gradient_error,hessian_error,loss_error,"
              "vanilla_ms,all_ms,cubature_ms,estimator,batch,lipschitz_batch\n", f);
    fprintf(f, "%s,%d,%d,%d,%d,%d,%d,%.6g,%.6g,%.6g,%.6g,%.6g,%.6g,%.6g,%.6g,%s,%d,%d\n", sweep_name(v->r, name), v->r->o.seed, v->n,
            v->cells, v->d->r, v->d->lipschitz.cubature, s->cells, s->seconds, s->error, error[0], error[1], error[2], 1e3 * seconds[0], 1e3 * seconds[1],
            1e3 * seconds[2], scene__estimators[v->d->lipschitz.estimator], v->d->train.batch, v->d->lipschitz.batch);
    return fclose(f) == 0 ? 1 : fail(v->r, "%s: cannot be written", path);
}

static int neural_measure(neural *v) {
    tss_model base;
    neural_selection s;
    double error[3] = {0, 0, 0}, seconds[3];
    int there;
    if (v->r->o.threads != 1) return fail(v->r, "tss neural measure: expected --threads 1 (it counts the CPU time of one)");
    if (v->d->lipschitz.order != 2 || !(v->d->lipschitz.weight > 0))
        return fail(v->r, "%s: neural.lipschitz: expected order 2 and a weight above 0 for measure", v->r->o.scene);
    if (!neural_expect(v, NEURAL_BASE)) return 0;
    if (!neural_frames(v) || v->stopped) return !v->r->why.text[0];
    if (!v->d->unsupervised && !neural_basis(v)) return 0;
    if (!neural_read(v, NEURAL_BASE, &base, &there)) return 0;
    if (!there) return neural_missing(v, NEURAL_BASE);
    int ok = neural_cubature(v, &base, NEURAL_BASE, v->d->lipschitz.cubature, &v->cubature, &s) && neural_cubature_errors(v, &base, error);
    tss_model_free(&base);
    ok = ok && neural_step_costs(v, seconds) && neural_measure_row(v, &s, error, seconds);
    if (ok)
        printf("%d of %d cells, r %d: error of the gradient %.3g, Hessian %.3g, L_LS %.3g; a step %.3g ms, with L_LS %.3g, on the cubature %.3g\n",
               s.cells, v->cells, v->d->r, error[0], error[1], error[2], 1e3 * seconds[0], 1e3 * seconds[1], 1e3 * seconds[2]);
    return ok;
}

// ---------------------------------------------------------------------------------------------
// >>neural_run: what it looks like
// ---------------------------------------------------------------------------------------------

#define NEURAL_SHOTS 4  // pictures a method

typedef struct neural_album {
    view_image shot[NEURAL_SHOTS * NEURAL_TRIAL_FULL];
    const char *label[NEURAL_SHOTS * NEURAL_TRIAL_FULL];
    int shots;
    FILE *rows;
} neural_album;

static void neural_draw_state(run *r, const double *x, const float color[3]) {
    int dim = r->s.world.dim;
    for (int i = 0; i < tss_world_nodes(r->w); i++)
        for (int c = 0; c < 3; c++) r->x3[3 * i + c] = c < dim ? x[dim * i + c] : 0;
    memcpy(r->s.body[0].color, color, 3 * sizeof *color);
    draw_body(r, 0);
}

static void neural_draw_ball(const neural *v) {
    tss_mesh m;
    view_style style = view_style_default();
    if (v->ball.radius == 0 || tss_shape_ball_surface(NULL, v->ball.radius, 24, &m) != TSS_OK) return;
    tss_mesh_translate(&m, v->ball.center[0], v->ball.center[1], v->ball.center[2]);
    memcpy(style.colour, obstacle_color, sizeof style.colour);
    view_add_mesh(v->r->view, m.x, m.nodes, m.triangle, m.triangles, &style);
    tss_mesh_free(&m);
}

// The subspace's state in blue over full space in purple.
static int neural_shoot(neural_trial *t, neural_album *a) {
    static const float blue[3] = {0.25f, 0.55f, 0.85f}, purple[3] = {0.62f, 0.40f, 0.72f};
    run *r = t->v->r;
    for (int q = 0; q < NEURAL_TRIAL_FULL; q++) {
        view_look look = scene_look(r);
        if (!t->e[q].used) continue;
        view_begin(r->view, &r->camera, &look);
        neural_draw_state(r, tss_world_positions(r->w), purple);
        neural_draw_state(r, tss_reduced_x(t->e[q].s), blue);
        neural_draw_ball(t->v);
        view_image im = view_render(r->view);
        if (!im.rgb) return fail(r, "out of memory for a picture");
        a->label[a->shots] = neural_trial_names[q];
        a->shot[a->shots++] = view_image_shrink(&im, im.width);
    }
    return 1;
}

static int neural_watch_step(neural_trial *t, int sequence, int k, void *ctx) {
    neural_album *a = (neural_album *)ctx;
    int stride = t->v->d->script.stride, tests = t->steps;
    int settle = t->v->d->script.settle, at = sequence * t->each + (k - settle) / stride;
    for (int q = 0; q < NEURAL_TRIALS; q++) {
        const neural_entry *e = &t->e[q];
        if (e->used)
            fprintf(a->rows, "%d,%d,%s,%.6g,%d,%d,%d,%.6g,%.8g,%.6g,%.6g\n", sequence, k + 1, neural_trial_names[q], 1e3 * e->seconds[at],
                    e->iterations[at], e->evaluations[at], e->exit[at], e->gradient[at], e->energy[at], e->mean[at], e->farthest[at]);
    }
    for (int s = 0; s < NEURAL_SHOTS; s++)
        if (at == (int)((s + 0.5) * tests / NEURAL_SHOTS)) return neural_shoot(t, a);
    return 1;
}

static double *neural_as_double(const int *v, int n) {
    double *out = (double *)need((size_t)n, sizeof *out);
    for (int i = 0; i < n; i++) out[i] = v[i];
    return out;
}

static void neural_plots(report *p, neural_trial *t) {
    report_series s[NEURAL_TRIALS], it[NEURAL_TRIALS], er[NEURAL_TRIALS];
    int n = 0, subspaces = 0;
    memset(s, 0, sizeof s), memset(it, 0, sizeof it), memset(er, 0, sizeof er);
    for (int q = 0; q < NEURAL_TRIALS; q++) {
        neural_entry *e = &t->e[q];
        if (!e->used) continue;
        s[n].name = it[n].name = er[n].name = neural_trial_names[q], s[n].count = it[n].count = er[n].count = t->steps;
        s[n].y = e->seconds, it[n].y = neural_as_double(e->iterations, t->steps), er[n].y = e->mean;
        n++, subspaces += q != NEURAL_TRIAL_FULL;
    }
    report_plot a = report_plot_default("Time of a step", "test step", "s");
    a.log_y = 1;
    report_add_plot(p, &a, s, n);
    a = report_plot_default("Iterations of a step", "test step", "iterations"), a.log_y = 1;
    report_add_plot(p, &a, it, n);
    a = report_plot_default("Distance from full space, mean of the nodes", "test step", "over the diagonal"), a.log_y = 1;
    report_add_plot(p, &a, er, subspaces);
    for (int k = 0; k < n; k++) free((void *)it[k].y);
}

static int neural_page(neural_trial *t, neural_album *a) {
    run *r = t->v->r;
    char path[700], name[120], text[80];
    const char *paths[1] = {path};
    int used = t->e[NEURAL_TRIAL_LINEAR].used ? 3 : 2;
    view_error why;
    report_error bad;
    view_image sheet = view_image_sheet(a->shot, a->shots, used, 6, a->label);
    snprintf(path, sizeof path, "%s/states_%d.png", r->o.out, r->o.seed);
    int ok = sheet.rgb && view_write_png(path, &sheet, &why);
    view_image_free(&sheet);
    if (!ok) return fail(r, "%s", sheet.rgb ? why.message : "out of memory for a picture");
    report *p = report_begin(sweep_name(r, name), "neural subspaces against full space (purple)");
    snprintf(text, sizeof text, "%.2f times vanilla's speed", neural_mean(t->e[0].seconds, t->steps) / neural_mean(t->e[1].seconds, t->steps));
    report_status(p, "lipschitz", text, REPORT_INFO);
    report_pictures(p, paths, NULL, 1);
    neural_plots(p, t);
    return report_end(p, r->o.out, &bad) ? 1 : fail(r, "%s", bad.message);
}

static int neural_run(neural *v) {
    neural_trial t;
    neural_album a;
    char path[700];
    run *r = v->r;
    memset(&a, 0, sizeof a);
    r->png = 1, r->vtu = r->obj = 0, r->s.frames.field = SCENE_FIELD_NONE;
    int ok = neural_trial_open(v, &t) && open_frames(r);
    snprintf(path, sizeof path, "%s/steps_%d.csv", r->o.out, r->o.seed);
    a.rows = ok ? fopen(path, "w") : NULL;
    if (ok && !a.rows) ok = fail(r, "%s: cannot be written: %s", path, strerror(errno));
    if (ok) fputs("sequence,step,method,ms,iterations,evaluations,exit,gradient,energy,error_mean,error_farthest\n", a.rows);
    ok = ok && neural_trial_run(&t, neural_watch_step, &a);
    if (a.rows) fclose(a.rows);
    if (ok) neural_table(&t);
    ok = ok && neural_page(&t, &a);
    for (int k = 0; k < a.shots; k++) view_image_free(&a.shot[k]);
    neural_trial_close(&t);
    return ok;
}

static int command_neural(run *r) {
    static neural v;
    int ok = neural_open(r, &v);
    if (ok) ok = strcmp(r->o.action, "train") == 0 ? neural_train(&v) : strcmp(r->o.action, "run") == 0 ? neural_run(&v)
                  : strcmp(r->o.action, "measure") == 0 ? neural_measure(&v)
                  : strcmp(r->o.action, "bridge") == 0 ? neural_bridge(&v) : neural_evaluate(&v);
    if (ok && v.stopped) printf("out of --minutes; what was done is kept, and the same command goes on from there\n");
    neural_close(&v);
    return !ok ? 2 : v.stopped ? 3 : 0;
}
