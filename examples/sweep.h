/* sweep.h: `tss compare --sweep`, error against run time (a part of tss.c, of its own for length)

   Solvers and tolerances are run on the same steps of one scene. What is swept:

       subspace   all modes of the bases, no nodes (error_modes empty), and modes that come by the
                  oracle: a row for each of --modes
       adaptive   a row for each of --nodes and --tols at the first of --modes; the other --modes
                  at the middle one of --nodes and the scene's tol
       direct pcg auto    full space, a row for each of --tols

   The reference is full space at a ten-thousandth of the scene's tol. Each step of
   each solver starts from it, and
       error = max ‖x − x_ref‖ / max ‖x_ref − x_t‖,    over the nodes that are free to move,
   so that no solver pays for the errors of its earlier steps; what the adaptive one activated in
   them it keeps. Seconds are the sum over the steps;
   with --repeat K all steps are taken K times, the solvers in turn at each, and a step's shortest
   time counts. With --from N >= 1 step N is taken by all and not timed: what is set up once, a
   partition or an ordering, is in it. Then
   each solver goes its own way for --free-steps; error_final is how far its farthest node is from
   the reference's, over the diagonal.

   DIR/error_vs_time.csv has a row a solver and tolerance, DIR/error_steps.csv a row for each of their
   steps, DIR/report.html the curves. SCENE_subspace.png and SCENE_adaptive.png show the error on the
   bodies in the step in which the subspace alone is worst, SCENE_enriched.png the nodes added.  */

#define SWEEP_MOST 32

typedef struct sweep_entry {
    const char *method;
    int linear, mode;                      // TSS_LINEAR_*, TSS_MODE_*
    double error_nodes, error_modes, tol;  // negative: empty
    tss_world *w;
    void *kept;  // checkpoint from before the first step
    size_t kept_bytes;
    tss_step_info info;
    double step_error, step_mean;
    double *best, *phase;  // seconds of each step: the shortest of the passes; × TSS_PHASE_COUNT
    // Over the steps:
    double seconds, error_max, error_sum, error_final, residual, enriched, modes;
    int failed;
} sweep_entry;

typedef struct sweep {
    sweep_entry e[SWEEP_MOST], ref;
    int entries, steps, free_steps, failed;
    void *motions;
    double *x_t;
    double tol;  // the scene's, m/s
    FILE *rows;
    // The step in which the subspace alone is worst, for the pictures: step, positions and errors.
    int shown_step, subspace, adaptive;  // entries drawn; -1: none
    double shown_error, *shown_x[2], *shown_off[2], *shown_enriched;
    tss_step_info shown_info;
} sweep;

static const char *sweep_name(const run *r, char text[120]) {
    const char *name = strrchr(r->o.scene, '/');
    name = r->o.name ? r->o.name : name ? name + 1 : r->o.scene;
    snprintf(text, 120, "%.*s", (int)strcspn(name, "."), name);
    return text;
}

// A list of numbers > 0, as "1,0.3,0.1"; returns how many, 0: not a list.
static int sweep_list(const char *text, double *out) {
    int n = 0;
    for (const char *c = text; n < SWEEP_MOST; c++) {
        size_t size = strcspn(c, ",");
        if (tss_parse_double(c, size, &out[n]) != TSS_OK || !(out[n] > 0)) return 0;
        n++, c += size;
        if (!*c) return n;
    }
    return 0;
}

static int sweep_add(run *r, sweep *s, const char *method, int linear, int mode, double nodes,
                     double modes, double tol) {
    if (s->entries == SWEEP_MOST)
        return fail(r, "%s: more than %d solvers and tolerances to sweep; shorten --nodes, --modes or "
                       "--tols", r->o.scene, SWEEP_MOST);
    sweep_entry *e = &s->e[s->entries++];
    e->method = method, e->linear = linear, e->mode = mode;
    e->error_nodes = nodes, e->error_modes = modes, e->tol = tol;
    return 1;
}

// The scene's own tolerance as a speed.
static double sweep_tolerance(const run *r, const tss_world *w) {
    double tol = r->s.solver.tol > 0 ? r->s.solver.tol
                                     : r->s.solver.tol_rel * tss_world_diagonal(w);
    int still = r->s.world.integrator == TSS_QUASISTATIC;
    return still && r->s.solver.tol <= 0 ? 1e-3 / r->s.world.dt * tol : tol;
}

// Whether some block waits for the oracle: else error_modes changes nothing.
static int sweep_modes_come(const run *r) {
    for (int b = 0; b < r->s.bodies; b++)
        for (int k = 0; k < r->s.body[b].bases; k++) {
            const scene_basis *p = &r->s.body[b].basis[k];
            if (p->kind != TSS_BASIS_AFFINE && p->initial >= 0) return 1;
        }
    return 0;
}

static int sweep_plan(run *r, sweep *s) {
    static const struct {
        const char *name;
        int linear;
    } full[] = {{"direct", TSS_LINEAR_DIRECT}, {"pcg", TSS_LINEAR_PCG}, {"auto", TSS_LINEAR_AUTO}};
    double nodes[SWEEP_MOST], modes[SWEEP_MOST], tols[SWEEP_MOST];
    int n = sweep_list(r->o.nodes, nodes), m = sweep_list(r->o.modes, modes), ok = 1;
    int t = r->o.tols ? sweep_list(r->o.tols, tols) : 0;
    if (n == 0) return fail(r, "--nodes %s: expected numbers > 0 joined by commas", r->o.nodes);
    if (m == 0) return fail(r, "--modes %s: expected numbers > 0 joined by commas", r->o.modes);
    if (r->o.tols && t == 0)
        return fail(r, "--tols %s: expected speeds > 0, m/s, joined by commas", r->o.tols);
    if (t == 0) tols[0] = 10 * s->tol, tols[1] = s->tol, t = 2;
    int own = r->s.solver.linear, come = sweep_modes_come(r);
    if (!come) m = 1;
    ok = sweep_add(r, s, "subspace", own, TSS_MODE_SUBSPACE, -1, -1, s->tol);
    for (int k = 0; ok && come && k < m; k++)  // no node is asked for
        ok = sweep_add(r, s, "subspace", own, TSS_MODE_ADAPTIVE, -1, modes[k], s->tol);
    for (int k = 0; ok && k < n; k++)
        ok = sweep_add(r, s, "adaptive", own, TSS_MODE_ADAPTIVE, nodes[k], modes[0], s->tol);
    for (int k = 1; ok && k < m; k++)
        ok = sweep_add(r, s, "adaptive", own, TSS_MODE_ADAPTIVE, nodes[n / 2], modes[k], s->tol);
    for (int q = 0; q < t; q++)
        for (int k = 0; ok && tols[q] != s->tol && k < n; k++)
            ok = sweep_add(r, s, "adaptive", own, TSS_MODE_ADAPTIVE, nodes[k], modes[0], tols[q]);
    for (int f = 0; f < 3; f++)
        for (int k = 0; ok && k < t; k++)
            ok = sweep_add(r, s, full[f].name, full[f].linear, TSS_MODE_FULL, -1, -1, tols[k]);
    s->subspace = 0, s->adaptive = come ? 1 + m : 1;  // of these the one nearest to 0.1
    for (int k = s->adaptive + n - 1; k > 0 && !strcmp(s->e[k].method, "adaptive"); k--)
        if (fabs(log(s->e[k].error_nodes / 0.1)) < fabs(log(s->e[s->adaptive].error_nodes / 0.1)))
            s->adaptive = k;
    return ok;
}

static int sweep_world(run *r, sweep_entry *e) {
    tss_ipc *ipc;
    r->s.solver.linear = e->linear, r->s.solver.mode = e->mode;
    if (e->mode == TSS_MODE_ADAPTIVE) r->s.solver.error_nodes = e->error_nodes >= 0 ? e->error_nodes : 1e30;
    if (e->mode == TSS_MODE_ADAPTIVE) r->s.solver.error_modes = e->error_modes;
    if (!build_world(r, &e->w, &ipc)) return 0;
    tss_result t = e->tol > 0 ? tss_world_set_tol(e->w, e->tol) : TSS_OK;
    return t == TSS_OK ? 1 : fail(r, "%s: %s", r->o.scene, tss_world_error(e->w));
}

// A world with bases last: it leaves their numbers in the scene.
static int sweep_worlds(run *r, sweep *s) {
    s->ref.method = "reference", s->ref.linear = TSS_LINEAR_AUTO, s->ref.mode = TSS_MODE_FULL;
    if (!sweep_world(r, &s->ref)) return 0;
    s->tol = sweep_tolerance(r, s->ref.w);
    if (tss_world_set_tol(s->ref.w, 1e-4 * s->tol) != TSS_OK)
        return fail(r, "%s: %s", r->o.scene, tss_world_error(s->ref.w));
    if (!sweep_plan(r, s)) return 0;
    for (int k = s->entries - 1; k >= 0; k--) {
        fprintf(stderr, "sweep: preparing %d of %d\n", s->entries - k, s->entries);
        if (!sweep_world(r, &s->e[k])) return 0;
    }
    return 1;
}

// ‖x − y‖ of the nodes that are free to move: the largest, and the mean.
static double sweep_distance(const tss_world *w, const double *x, const double *y, double *mean) {
    int dim = tss_world_dim(w), count = 0;
    const uint8_t *kind = tss_world_kinds(w);
    double most = 0, sum = 0;
    for (int i = 0; i < tss_world_nodes(w); i++) {
        double s = 0;
        if (kind[i] != TSS_NODE_FREE) continue;
        for (int c = 0; c < dim; c++)
            s += (x[dim * i + c] - y[dim * i + c]) * (x[dim * i + c] - y[dim * i + c]);
        most = fmax(most, s), sum += sqrt(s), count++;
    }
    *mean = count ? sum / count : 0;
    return sqrt(most);
}

// One step of all solvers from the reference's state, which then goes on. k: of the steps, from 0; −1:
// the one before them, which is not timed: it sets up what a solver sets up once.
static int sweep_step(run *r, sweep *s, int k) {
    size_t wide = (size_t)tss_world_nodes(s->ref.w) * (size_t)tss_world_dim(s->ref.w);
    memcpy(s->x_t, tss_world_positions(s->ref.w), wide * sizeof(double));
    free(s->motions), s->motions = save_motions(r);
    for (int q = 0; q < s->entries; q++) {
        sweep_entry *e = &s->e[q];
        tss_result c = tss_world_copy_state(e->w, s->ref.w);
        if (c != TSS_OK) return fail(r, "%s: %s", r->o.scene, tss_result_text(c));
        load_motions(r, s->motions);
        if (!step_world(r, e->w, r->o.from + k + 1, &e->info)) return 0;
        if (k < 0 || e->info.seconds >= e->best[k]) continue;
        e->best[k] = e->info.seconds;
        memcpy(e->phase + k * TSS_PHASE_COUNT, e->info.phase_seconds, sizeof e->info.phase_seconds);
    }
    load_motions(r, s->motions);
    return step_world(r, s->ref.w, r->o.from + k + 1, &s->ref.info);
}

// All worlds back to where the steps begin: what the solvers activated is forgotten.
static int sweep_rewind(run *r, sweep *s, const void *start, size_t size, void *motions) {
    int ok = load_world(r, s->ref.w, start, size);
    for (int k = 0; ok && k < s->entries; k++)
        ok = load_world(r, s->e[k].w, s->e[k].kept, s->e[k].kept_bytes);
    load_motions(r, motions);
    return ok;
}

static void sweep_number(FILE *f, double v) {
    if (v >= 0) fprintf(f, "%.10g", v);
    fputc(',', f);
}

static void sweep_key(const run *r, const sweep_entry *e, FILE *f) {
    char name[120];
    fprintf(f, "%s,%s,", sweep_name(r, name), e->method);
    sweep_number(f, e->error_nodes), sweep_number(f, e->error_modes), sweep_number(f, e->tol);
}

static double sweep_share(int part, int all) { return all > 0 ? (double)part / all : 0; }

static void sweep_row(const run *r, const sweep *s, const sweep_entry *e, int k) {
    static const tss_phase phases[] = {TSS_PHASE_ENERGY,    TSS_PHASE_GRADIENT, TSS_PHASE_HESSIAN,
                                       TSS_PHASE_ORACLE,    TSS_PHASE_ASSEMBLE, TSS_PHASE_LINEAR,
                                       TSS_PHASE_COLLISION, TSS_PHASE_OTHER};
    const tss_step_info *i = &e->info;
    sweep_key(r, e, s->rows);
    fprintf(s->rows, "%d,%.6g,%.6g,%.6g,%.6g,%.6g,%.6g,%.6g,%.6g,%d,%d,%d,%s", r->o.from + k + 1, e->best[k],
            e->step_error, e->step_mean, i->residual_max, i->residual_mean, i->oracle_error,
            sweep_share(i->enriched_nodes, i->nodes), sweep_share(i->active_modes, i->modes), i->newton,
            i->linear_iterations, i->contacts, tss_status_text(i->status));
    for (size_t q = 0; q < sizeof phases / sizeof *phases; q++)
        fprintf(s->rows, ",%.6g", e->phase[k * TSS_PHASE_COUNT + (int)phases[q]]);
    fputc('\n', s->rows);
}

// Keeps what the pictures show, if the subspace alone was never as bad as in this step.
static void sweep_remember(sweep *s, int step, double way) {
    const tss_world *w = s->ref.w;
    const double *ref = tss_world_positions(w);
    const int which[2] = {s->subspace, s->adaptive};
    int n = tss_world_nodes(w), dim = tss_world_dim(w);
    if (s->shown_step > 0 && s->e[s->subspace].step_error <= s->shown_error) return;
    s->shown_step = step, s->shown_error = s->e[s->subspace].step_error;
    s->shown_info = s->e[s->adaptive].info;
    for (int q = 0; q < 2; q++) {
        const double *x = tss_world_positions(s->e[which[q]].w);
        memcpy(s->shown_x[q], x, (size_t)n * (size_t)dim * sizeof *x);
        for (int i = 0; i < n; i++) {
            double d = 0;
            for (int c = 0; c < dim; c++)
                d += (x[dim * i + c] - ref[dim * i + c]) * (x[dim * i + c] - ref[dim * i + c]);
            s->shown_off[q][i] = way > 0 ? sqrt(d) / way : 0;
        }
    }
    tss_subspace_info sub;
    tss_subspace_get_info(tss_subspace_of(s->e[s->adaptive].w), &sub);
    for (int i = 0; i < n; i++) s->shown_enriched[i] = sub.enriched && sub.enriched[i];
}

static void sweep_judge(run *r, sweep *s, int q) {
    double mean, way = sweep_distance(s->ref.w, tss_world_positions(s->ref.w), s->x_t, &mean);
    for (int k = 0; k < s->entries; k++) {
        sweep_entry *e = &s->e[k];
        double off = sweep_distance(e->w, tss_world_positions(e->w), tss_world_positions(s->ref.w), &mean);
        e->step_error = off > 0 ? off / way : 0, e->step_mean = mean > 0 ? mean / way : 0;
        e->seconds += e->best[q];
        e->error_max = fmax(e->error_max, e->step_error), e->error_sum += e->step_error;
        e->residual = fmax(e->residual, e->info.residual_max);
        e->enriched += sweep_share(e->info.enriched_nodes, e->info.nodes);
        e->modes += sweep_share(e->info.active_modes, e->info.modes);
        e->failed += e->info.status != TSS_STEP_CONVERGED;
        s->failed += e->info.status != TSS_STEP_CONVERGED;
        sweep_row(r, s, e, q);
    }
    fflush(s->rows);
    s->failed += s->ref.info.status != TSS_STEP_CONVERGED;
    sweep_remember(s, r->o.from + q + 1, way);
}

// Where the reference is after the free steps.
static int sweep_goal(run *r, sweep *s, const void *start, size_t size, void *motions, double *end) {
    size_t wide = (size_t)tss_world_nodes(s->ref.w) * (size_t)tss_world_dim(s->ref.w);
    int there = s->free_steps == s->steps;
    if (!there && !load_world(r, s->ref.w, start, size)) return 0;
    load_motions(r, motions);
    for (int k = 1; !there && k <= s->free_steps; k++)
        if (!step_world(r, s->ref.w, r->o.from + k, &s->ref.info)) return 0;
    memcpy(end, tss_world_positions(s->ref.w), wide * sizeof *end);
    return load_world(r, s->ref.w, start, size);
}

// Each solver goes its own way from where the steps began.
static int sweep_free(run *r, sweep *s, void *motions, const double *end) {
    double mean;
    for (int k = 0; k < s->entries; k++) {
        sweep_entry *e = &s->e[k];
        tss_result c = tss_world_copy_state(e->w, s->ref.w);
        if (c != TSS_OK) return fail(r, "%s: %s", r->o.scene, tss_result_text(c));
        load_motions(r, motions);
        for (int q = 1; q <= s->free_steps; q++) {
            if (!step_world(r, e->w, r->o.from + q, &e->info)) return 0;
            s->failed += e->info.status != TSS_STEP_CONVERGED;
        }
        e->error_final = sweep_distance(e->w, tss_world_positions(e->w), end, &mean) / tss_world_diagonal(e->w);
        fprintf(stderr, "sweep: free steps of %d of %d\n", k + 1, s->entries);
    }
    return 1;
}

static int sweep_open(run *r, sweep *s) {
    char path[700];
    size_t n = (size_t)tss_world_nodes(s->ref.w), wide = n * (size_t)tss_world_dim(s->ref.w);
    s->x_t = (double *)need(wide, sizeof(double));
    for (int q = 0; q < 2; q++) {
        s->shown_x[q] = (double *)need(wide, sizeof(double));
        s->shown_off[q] = (double *)need(n, sizeof(double));
    }
    s->shown_enriched = (double *)need(n, sizeof(double));
    for (int k = 0; k < s->entries; k++) {
        sweep_entry *e = &s->e[k];
        e->kept = save_world(e->w, &e->kept_bytes);
        e->best = (double *)need((size_t)s->steps, sizeof(double));
        e->phase = (double *)need((size_t)s->steps * TSS_PHASE_COUNT, sizeof(double));
        for (int q = 0; q < s->steps; q++) e->best[q] = INFINITY;
    }
    snprintf(path, sizeof path, "%s/error_steps.csv", r->o.out);
    s->rows = fopen(path, "w");
    if (!s->rows) return fail(r, "%s: cannot be written: %s", path, strerror(errno));
    fputs("scene,method,error_nodes,error_modes,tol,step,seconds,error,error_mean,residual_max,"
          "residual_mean,oracle_error,enriched_share,modes_share,newton,linear_iters,contacts,status,"
          "energy_s,gradient_s,hessian_s,oracle_s,assemble_s,linear_s,collision_s,other_s\n", s->rows);
    return 1;
}

static int sweep_table(run *r, const sweep *s) {
    char path[700], name[120];
    snprintf(path, sizeof path, "%s/error_vs_time.csv", r->o.out);
    FILE *f = fopen(path, "w");
    if (!f) return fail(r, "%s: cannot be written: %s", path, strerror(errno));
    fprintf(f, "# %s: %d nodes, %d steps from step %d, free steps %d, best of %d, threads %d, tol %g m/s",
            sweep_name(r, name), tss_world_nodes(s->ref.w), s->steps, r->o.from + 1, s->free_steps,
            r->o.repeat, r->o.threads, s->tol);
    for (int k = 0; k < r->o.sets; k++) fprintf(f, "%s %s", k ? "" : ", with", r->o.set[k]);
    fputs("\nscene,method,error_nodes,error_modes,tol,seconds,error_max,error_mean,error_final,residual,"
          "enriched_share,modes_share\n", f);
    printf("%-9s %8s %8s %9s %9s %10s %10s %10s %10s %8s %8s\n", "method", "nodes", "modes", "tol",
           "seconds", "error max", "mean", "final", "residual", "enriched", "modes");
    for (int k = 0; k < s->entries; k++) {
        const sweep_entry *e = &s->e[k];
        double mean = e->error_sum / s->steps;
        sweep_key(r, e, f);
        fprintf(f, "%.6g,%.6g,%.6g,%.6g,%.6g,%.6g,%.6g\n", e->seconds, e->error_max, mean,
                e->error_final, e->residual, e->enriched / s->steps, e->modes / s->steps);
        printf("%-9s %8.3g %8.3g %9.3g %9.3f %10.3e %10.3e %10.3e %10.3e %7.2f%% %7.2f%%%s\n", e->method,
               e->error_nodes, e->error_modes, e->tol, e->seconds, e->error_max, mean, e->error_final,
               e->residual, 100 * e->enriched / s->steps, 100 * e->modes / s->steps,
               e->failed ? " not converged" : "");
    }
    return fclose(f) == 0 ? 1 : fail(r, "%s: cannot be written", path);
}

// (the view owns the image)
// One picture of remembered positions; value: n, on a logarithmic scale unless field is enriched.
static int sweep_picture(run *r, const double *x, const double *value, int field,
                         const char *what, const char *label) {
    int n = tss_world_nodes(r->w), dim = r->s.world.dim;
    char path[700], name[120];
    view_error why;
    for (int i = 0; i < n; i++) {
        for (int c = 0; c < 3; c++) r->x3[3 * i + c] = c < dim ? x[dim * i + c] : 0;
        r->field[i] = field == SCENE_FIELD_ENRICHED ? value[i] : log10(fmax(value[i], 1e-12));
    }
    r->s.frames.field = field, r->s.frames.has_range = 1;
    r->s.frames.range[0] = 1e-4, r->s.frames.range[1] = 1;
    view_image im = render_scene(r);
    if (!im.rgb) return fail(r, "out of memory for a picture");
    view_label(&im, sweep_name(r, name), label);
    if (field == SCENE_FIELD_ERROR) view_colour_bar(&im, VIEW_MAP_EMBER, -4, 0, "log10 error");
    snprintf(path, sizeof path, "%s/%s_%s.png", r->o.out, name, what);
    return view_write_png(path, &im, &why) ? 1 : fail(r, "%s", why.message);
}

static int sweep_pictures(run *r, sweep *s) {
    char label[200];
    const sweep_entry *a = &s->e[s->adaptive];
    const tss_step_info *i = &s->shown_info;
    double worst[2] = {0, 0};
    r->w = s->ref.w, r->png = 1, r->vtu = r->obj = 0;
    int ok = open_frames(r);
    for (int q = 0; q < 2; q++)
        for (int k = 0; k < tss_world_nodes(r->w); k++) worst[q] = fmax(worst[q], s->shown_off[q][k]);
    snprintf(label, sizeof label, "all modes, no nodes   step %d   error %.2e", s->shown_step, worst[0]);
    ok = ok && sweep_picture(r, s->shown_x[0], s->shown_off[0], SCENE_FIELD_ERROR, "subspace", label);
    snprintf(label, sizeof label, "adaptive, error_nodes %g   step %d   error %.2e", a->error_nodes,
             s->shown_step, worst[1]);
    ok = ok && sweep_picture(r, s->shown_x[1], s->shown_off[1], SCENE_FIELD_ERROR, "adaptive", label);
    snprintf(label, sizeof label, "enriched (dark) %d of %d nodes, %d of %d modes", i->enriched_nodes,
             i->nodes, i->active_modes, i->modes);
    ok = ok && sweep_picture(r, s->shown_x[1], s->shown_enriched, SCENE_FIELD_ENRICHED, "enriched", label);
    r->w = NULL;  // the sweep owns it
    return ok;
}

// The curves, from the files just written.
static int sweep_report(run *r, sweep *s) {
    char rows[700], steps[700], name[120];
    curves c;
    curves_error why;
    report_error bad;
    fclose(s->rows), s->rows = NULL;
    snprintf(rows, sizeof rows, "%s/error_vs_time.csv", r->o.out);
    snprintf(steps, sizeof steps, "%s/error_steps.csv", r->o.out);
    if (!curves_read(&c, rows, steps, &why)) return fail(r, "%s", why.message);
    report *p = report_begin(sweep_name(r, name), "error against run time");
    curves_draw(p, &c, r->o.out);
    curves_free(&c);
    return report_end(p, r->o.out, &bad) ? 1 : fail(r, "%s", bad.message);
}

// Bases are made once and read by the other worlds; the reference and full space have none.
static void sweep_cache(run *r) {
    for (int b = 0; b < r->s.bodies; b++)
        for (int k = 0; k < r->s.body[b].bases; k++) {
            scene_basis *p = &r->s.body[b].basis[k];
            if (!p->cache[0])
                snprintf(p->cache, sizeof p->cache, "%.400s/basis_%d_%d.bin", r->o.out, b, k);
        }
}

static int sweep_run(run *r, sweep *s) {
    size_t size, size_first = 0;
    double started;
    s->steps = r->o.steps >= 0 ? r->o.steps : r->s.world.steps - r->o.from;
    s->free_steps = r->o.free_steps >= 0 ? r->o.free_steps : s->steps;
    if (!has_bases(&r->s)) return fail(r, "%s: no body has a basis: nothing to compare", r->o.scene);
    if (s->steps < 1)
        return fail(r, "%s: --from %d leaves no step to compare (the scene has %d)", r->o.scene,
                    r->o.from, r->s.world.steps);
    if (!make_folder(r, out_folder(r))) return 0;
    sweep_cache(r);
    if (!sweep_worlds(r, s) || !sweep_open(r, s)) return 0;
    for (int k = 1; k < r->o.from; k++)
        if (!step_world(r, s->ref.w, k, &s->ref.info)) return 0;
    void *start = save_world(s->ref.w, &size), *motions = save_motions(r), *first = NULL, *first_motions = NULL;
    int ok = 1;
    started = now(NULL);
    for (int pass = 1; ok && pass <= r->o.repeat; pass++) {
        ok = sweep_rewind(r, s, start, size, motions) && (r->o.from == 0 || sweep_step(r, s, -1));
        if (pass == 1) first = save_world(s->ref.w, &size_first), first_motions = save_motions(r);
        for (int k = 0; ok && k < s->steps; k++) {
            ok = sweep_step(r, s, k);
            if (ok && pass == r->o.repeat) sweep_judge(r, s, k);
            fprintf(stderr, "sweep: pass %d of %d, step %d of %d, %.0f s\n", pass, r->o.repeat, k + 1, s->steps,
                    now(NULL) - started);
        }
    }
    double *end = (double *)need((size_t)tss_world_nodes(s->ref.w) * (size_t)tss_world_dim(s->ref.w), sizeof *end);
    ok = ok && sweep_goal(r, s, first, size_first, first_motions, end) && sweep_free(r, s, first_motions, end);
    free(first), free(first_motions);
    free(start), free(motions), free(end);
    return ok && sweep_table(r, s) && sweep_pictures(r, s) && sweep_report(r, s);
}

static int command_sweep(run *r) {
    static sweep s;
    int ok = read_scene(r) && sweep_run(r, &s);
    for (int k = 0; k < s.entries; k++) tss_world_destroy(s.e[k].w), free(s.e[k].kept), free(s.e[k].best), free(s.e[k].phase);
    tss_world_destroy(s.ref.w);
    if (s.rows) fclose(s.rows);
    free(s.x_t), free(s.motions), free(s.shown_enriched);
    for (int q = 0; q < 2; q++) free(s.shown_x[q]), free(s.shown_off[q]);
    return !ok ? 2 : s.failed ? 3 : 0;
}
