/* report.c: the pages of `make report`

   report [-o OUT] RESULTS_DIR OUT_DIR
   report --text RESULTS_DIR            // the table of docs/error.md

   Writes OUT/index.html (error against run time), OUT/stability.html, OUT/leave_out.html and
   OUT/neural.html; OUT is OUT_DIR unless given. RESULTS_DIR holds the committed large measurements (bench/results), OUT_DIR
   the small rerun: error_vs_time.csv, error_steps.csv and SCENE_*.png in either; stability.csv,
   stiffness.csv, leave_out.csv and neural*.csv in OUT_DIR, or else in RESULTS_DIR. Of a file that is not there
   the page says which command makes it. A file that is broken is named with its line, on the page
   and on stderr, and the exit code is 1; the other parts are written all the same.

   Another page is a function and a row in `pages`; the links among the pages follow. */
#define REPORT_IMPLEMENTATION
#include "../examples/report.h"
#define CURVES_IMPLEMENTATION
#include "../examples/curves.h"

typedef struct source {
    const char *results, *out;
    int failed;
} source;

static const char *join(char path[700], const char *folder, const char *file) {
    snprintf(path, 700, "%.500s/%.150s", folder, file);
    return path;
}

static void complain(source *s, report *r, const char *message) {
    fprintf(stderr, "report: %s\n", message);
    report_note(r, message, REPORT_BAD);
    s->failed = 1;
}

static void missing(report *r, const char *what, const char *command) {
    char text[200];
    snprintf(text, sizeof text, "%.100s: not there. This command makes it:", what);
    report_text(r, text);
    report_code(r, command);
}

// A table of OUT_DIR, or else of RESULTS_DIR. 1, or 0 and the page says why.
static int open_table(source *s, report *r, const char *file, const char *header,
                      const char *command, curves_table *t, char path[700]) {
    curves_error why;
    if (!curves__there(join(path, s->out, file)) && !curves__there(join(path, s->results, file))) {
        missing(r, file, command);
        return 0;
    }
    if (curves_table_read(t, path, header, &why)) return 1;
    complain(s, r, why.message);
    return 0;
}

// A cell's number; NAN where it is empty or a word.
static double number(const curves_table *t, int row, int column) {
    char *end = NULL;
    const char *s = curves_cell(t, row, column);
    double v = strtod(s, &end);
    return *s && !*end ? v : NAN;
}

// 1040350780 as 1 040 350 780, with narrow spaces that do not break.
static void grouped(const char *digits, char text[64]) {
    size_t n = strlen(digits), used = 0;
    for (size_t i = 0; i < n && used < 56; i++) {
        if (i > 0 && (n - i) % 3 == 0) memcpy(text + used, "\xe2\x80\xaf", 3), used += 3;
        text[used++] = digits[i];
    }
    text[used] = 0;
}

// As written where that is short, or else grouped or to four digits.
static const char *shown(const curves_table *t, int row, int column, char text[64]) {
    const char *s = curves_cell(t, row, column);
    double v = number(t, row, column);
    if (v != v) return s;
    if (strlen(s) > 4 && strlen(s) < 20 && strspn(s, "0123456789") == strlen(s))
        grouped(s, text);
    else if (fabs(v) > 0 && fabs(v) < 1e-4)
        curves__g(v, text);
    else if (strlen(s) > 6)
        snprintf(text, 64, "%.4g", v);
    else
        return s;
    return text;
}

// ---------------------------------------------------------------------------------------------
// >>index
// ---------------------------------------------------------------------------------------------

// 1: read, 0: not there, -1: broken.
static int read_curves(source *s, report *r, const char *folder, curves *c) {
    char rows[700], steps[700];
    curves_error why;
    join(rows, folder, "error_vs_time.csv"), join(steps, folder, "error_steps.csv");
    if (!curves__there(rows)) return 0;
    if (curves_read(c, rows, curves__there(steps) ? steps : NULL, &why)) return 1;
    complain(s, r, why.message);
    return -1;
}

static int scene_of(const curves *c, const char *name) {
    for (int k = 0; k < c->scenes; k++)
        if (!strcmp(c->scene[k], name)) return k;
    return -1;
}

// The large measurement and the small rerun of one scene.
static void both(report *r, const source *s, const curves *large, int a, const curves *small,
                 int b) {
    static const curves_measure m[2] = {CURVES_MAX, CURVES_FINAL};
    static const char *const title[2] = {"Largest error of a step",
                                         "Distance at the end of the free trajectory"};
    char text[120];
    curves_draw_verdict(r, large, a, CURVES_MAX, "Large, largest error of a step");
    curves_draw_verdict(r, large, a, CURVES_FINAL, "Large, distance at the end");
    curves_draw_verdict(r, small, b, CURVES_MAX, "Small rerun, largest error of a step");
    report_columns_begin(r);
    for (int k = 0; k < 2; k++) {
        snprintf(text, sizeof text, "%s: large", title[k]);
        curves_draw_errors(r, large, a, m[k], text);
        snprintf(text, sizeof text, "%s: small rerun", title[k]);
        curves_draw_errors(r, small, b, m[k], text);
    }
    report_columns_end(r);
    curves_draw_pictures(r, large, a, s->results);
    curves_draw_pictures(r, small, b, s->out);
    curves_draw_advice(r, large, a);
    curves_draw_steps(r, large, a);
}

static const char *small_heading(const curves *small, int scene, char text[200]) {
    snprintf(text, 200, "%.150s, small", small->scene[scene]);
    return text;
}

static void draw_scenes(report *r, const source *s, const curves *large, const curves *small) {
    for (int k = 0; k < large->scenes; k++) {
        int b = scene_of(small, large->scene[k]);
        report_heading(r, large->scene[k]);
        if (b >= 0)
            both(r, s, large, k, small, b);
        else
            curves_draw_scene(r, large, k, s->results);
    }
    for (int k = 0; k < small->scenes; k++) {
        char text[200];
        if (scene_of(large, small->scene[k]) >= 0) continue;
        report_heading(r, small_heading(small, k, text));
        curves_draw_scene(r, small, k, s->out);
    }
}

// Links to the headings of draw_scenes.
static void draw_contents(report *r, const curves *large, const curves *small) {
    size_t most = (size_t)(large->scenes + small->scenes) + 1;
    const char **heading = (const char **)calloc(most, sizeof *heading);
    char(*text)[200] = (char(*)[200])calloc(most, sizeof *text);
    int n = 0;
    for (int k = 0; heading && text && k < large->scenes; k++) heading[n++] = large->scene[k];
    for (int k = 0; heading && text && k < small->scenes; k++)
        if (scene_of(large, small->scene[k]) < 0)
            heading[n] = small_heading(small, k, text[n]), n++;
    if (n > 1) report_contents(r, heading, n);
    free((void *)heading), free(text);
}

static void page_index(source *s, report *r) {
    curves large, small;
    memset(&large, 0, sizeof large), memset(&small, 0, sizeof small);
    int same = !strcmp(s->results, s->out);
    int a = same ? 0 : read_curves(s, r, s->results, &large), b = read_curves(s, r, s->out, &small);
    curves_draw_tiles(r, a > 0 ? &large : &small);
    report_text(
        r,
        "The same steps by the subspace alone, by the adaptive subspace and by full-space "
        "solvers, each over its tolerance: how far the result is from a tight full-space "
        "solution, and how long it took. Lower left is better. A step's error is the "
        "largest distance of a node from that solution, over the largest displacement of the "
        "step.");
    report_heading(r, "Large measurements");
    if (a > 0) curves_draw_summary(r, &large), curves_draw_comment(r, &large);
    if (a == 0 && !same) missing(r, "Large measurements (error_vs_time.csv)", "make bench-error");
    report_heading(r, "Small rerun on this machine");
    if (b > 0) curves_draw_summary(r, &small), curves_draw_comment(r, &small);
    if (b == 0) missing(r, "Small rerun (error_vs_time.csv)", "make report");
    if (a > 0 || b > 0) curves_draw_key(r);
    draw_contents(r, &large, &small);
    draw_scenes(r, s, &large, &small);
    curves_free(&large), curves_free(&small);
}

// ---------------------------------------------------------------------------------------------
// >>stability
// ---------------------------------------------------------------------------------------------

enum { CASE, MODE, STEPS, STATUS, NEWTON_MEDIAN, NEWTON_MAX, LINEAR_MAX, MIN_J, MIN_DISTANCE };
enum { PATH_OK = MIN_DISTANCE + 1, FINITE, ENERGY_DRIFT, MOMENTUM_DRIFT, SECONDS, STABILITY };

static const char *const stability_header =
    "case,mode,steps,status,newton_median,newton_max,linear_max,min_J,min_distance,path_ok,finite,"
    "energy_drift,momentum_drift,seconds";

// A solver's own words for an end short of its tolerance are honest; other words are failures.
static report_level status_level(const char *status) {
    static const char *const honest[] = {"iterations", "budget", "stalled", "targets", "linear"};
    if (!strncmp(status, "converged", 9)) return REPORT_GOOD;
    for (int k = 0; k < 5; k++)
        if (!strncmp(status, honest[k], strlen(honest[k]))) return REPORT_WARN;
    return REPORT_BAD;
}

static report_level yes_level(const char *s) {
    static const char *const yes[] = {"1", "yes", "ok", "true"}, *const none[] = {"", "-", "n/a"};
    for (int k = 0; k < 4; k++)
        if (!strcmp(s, yes[k])) return REPORT_GOOD;
    for (int k = 0; k < 3; k++)
        if (!strcmp(s, none[k])) return REPORT_INFO;
    return REPORT_BAD;
}

static report_level stability_level(const curves_table *t, int row, int column) {
    const char *s = curves_cell(t, row, column);
    double v = number(t, row, column);
    if (column == STATUS) return status_level(s);
    if (column == PATH_OK || column == FINITE) return yes_level(s);
    if (column == MIN_DISTANCE) return v <= 0 ? REPORT_BAD : REPORT_INFO;
    if (column == MIN_J) return v <= 0 ? REPORT_WARN : REPORT_INFO;
    return REPORT_INFO;
}

static void stability_tiles(report *r, const curves_table *t) {
    int converged = 0, honest = 0, path = 0, finite = 0;
    char text[80];
    for (int i = 0; i < t->rows; i++) {
        report_level level = stability_level(t, i, STATUS);
        converged += level == REPORT_GOOD, honest += level == REPORT_WARN;
        path += stability_level(t, i, PATH_OK) == REPORT_BAD;
        finite += stability_level(t, i, FINITE) == REPORT_BAD;
    }
    int failed = t->rows - converged - honest;
    snprintf(text, sizeof text, "%d of %d runs", converged, t->rows);
    report_status(r, "Tolerance met", text, converged == t->rows ? REPORT_GOOD : REPORT_WARN);
    snprintf(text, sizeof text, "%d", honest);
    report_status(r, "Stopped short and said so", text, honest ? REPORT_WARN : REPORT_GOOD);
    snprintf(text, sizeof text, "%d", failed);
    report_status(r, "Failed otherwise", text, failed ? REPORT_BAD : REPORT_GOOD);
    snprintf(text, sizeof text, "%d", path);
    report_status(r, "Intersections or inversions", text, path ? REPORT_BAD : REPORT_GOOD);
    snprintf(text, sizeof text, "%d", finite);
    report_status(r, "Numbers that are not finite", text, finite ? REPORT_BAD : REPORT_GOOD);
}

static void stability_faults(report *r, const curves_table *t) {
    for (int i = 0; i < t->rows; i++) {
        char text[400];
        int path = stability_level(t, i, PATH_OK) == REPORT_BAD;
        int finite = stability_level(t, i, FINITE) == REPORT_BAD;
        int status = stability_level(t, i, STATUS) == REPORT_BAD;
        if (!path && !finite && !status) continue;
        snprintf(text, sizeof text, "%.120s, %.40s:%s%s%s%.60s", curves_cell(t, i, CASE),
                 curves_cell(t, i, MODE), path ? " the path is not free of intersections." : "",
                 finite ? " a number is not finite." : "", status ? " status " : "",
                 status ? curves_cell(t, i, STATUS) : "");
        report_note(r, text, REPORT_BAD);
    }
}

static void grid_of(report *r, const curves_table *t, const char *caption, const char *const *heads,
                    report_level (*level)(const curves_table *, int, int)) {
    size_t n = (size_t)t->rows * (size_t)t->columns;
    report_cell *cell = (report_cell *)calloc(n + 1, sizeof *cell);
    char(*text)[64] = (char(*)[64])calloc(n + 1, sizeof *text);
    for (int i = 0; cell && text && i < t->rows; i++)
        for (int j = 0; j < t->columns; j++) {
            size_t k = (size_t)i * (size_t)t->columns + (size_t)j;
            cell[k].text = shown(t, i, j, text[k]), cell[k].level = level(t, i, j);
            if (level == stability_level && (j == PATH_OK || j == FINITE))
                cell[k].text = cell[k].level == REPORT_GOOD  ? "yes"
                               : cell[k].level == REPORT_BAD ? "no"
                                                             : "\xe2\x80\x93";
        }
    if (cell && text) report_grid(r, caption, heads, cell, t->columns, t->rows);
    free(cell), free(text);
}

static void draw_stability(source *s, report *r) {
    static const char *const heads[STABILITY] = {
        "case",        "mode",         "steps",          "status",       "Newton, median",
        "Newton, max", "linear, max",  "min J",          "min distance", "path ok",
        "finite",      "energy drift", "momentum drift", "seconds"};
    char path[700];
    curves_table t;
    if (!open_table(s, r, "stability.csv", stability_header, "OUT=out/report sh bench/stability.sh", &t,
                    path))
        return;
    stability_tiles(r, &t);
    report_text(r,
                "Each case in full space, adaptive, and in the subspace alone. Every run must end "
                "without intersection, inversion or a number that is not finite, and with its "
                "tolerance met or a status that says it is not.");
    if (*t.comment) report_code(r, t.comment);
    stability_faults(r, &t);
    grid_of(r, &t, NULL, heads, stability_level);
    curves_table_free(&t);
}

enum { YOUNG, SOLVER, NEWTON, ITERATIONS, LINEAR_SECONDS, TOTAL_SECONDS, STIFFNESS_STATUS };
enum { SOLVERS = 8 };

static const char *const stiffness_header =
    "E,solver,newton,linear_iters,linear_seconds,total_seconds,status";

static int solvers_of(const curves_table *t, const char **name) {
    int n = 0;
    for (int i = 0; i < t->rows; i++) {
        int k = 0;
        while (k < n && strcmp(name[k], curves_cell(t, i, SOLVER)) != 0) k++;
        if (k == n && n < SOLVERS) name[n++] = curves_cell(t, i, SOLVER);
    }
    return n;
}

static void stiffness_plot(report *r, const curves_table *t, int column, const char *title,
                           const char *unit) {
    const char *name[SOLVERS];
    double *x = (double *)calloc(2 * (size_t)t->rows + 1, sizeof *x), *y = x ? x + t->rows : NULL;
    report_series s[SOLVERS];
    memset(s, 0, sizeof s);
    int solvers = solvers_of(t, name), series = 0, used = 0;
    for (int k = 0; x && k < solvers; k++) {
        int first = used, some = 0;
        for (int i = 0; i < t->rows; i++)
            if (!strcmp(name[k], curves_cell(t, i, SOLVER))) {
                x[used] = number(t, i, YOUNG), y[used] = number(t, i, column);
                some |= y[used++] > 0;
            }
        if (!some) continue;  // a direct solver has no iterations
        s[series].name = name[k], s[series].x = x + first, s[series].y = y + first;
        s[series].style = strcmp(name[k], "adaptive") ? REPORT_DASHED : REPORT_SOLID;
        s[series].count = used - first, s[series].colour = k + 1, series++;
    }
    report_plot p = report_plot_default(title, "E, Pa", unit);
    p.log_x = p.log_y = p.markers = 1;
    report_add_plot(r, &p, s, series);
    free(x);
}

static int stiffness_row(const curves_table *t, double E, const char *solver) {
    for (int i = 0; i < t->rows; i++)
        if (!strcmp(curves_cell(t, i, SOLVER), solver) && number(t, i, YOUNG) == E) return i;
    return -1;
}

// The two promises for 1e4 to 1e12 Pa. A direct solve of no iterations counts as one.
typedef struct stiffness_check {
    double growth, growth_at, time, time_at, from, to;  // worst ratios and their E; NAN: no data
} stiffness_check;

static stiffness_check check_stiffness(const curves_table *t) {
    stiffness_check c = {NAN, NAN, NAN, NAN, INFINITY, 0};
    double first = NAN;
    for (int i = 0; i < t->rows; i++) {
        double E = number(t, i, YOUNG);
        if (strcmp(curves_cell(t, i, SOLVER), "adaptive") != 0) continue;
        if (!(E >= 0.999e4 && E <= 1.001e12)) continue;
        c.to = fmax(c.to, E);
        if (E < c.from) c.from = E, first = fmax(number(t, i, ITERATIONS), 1);
    }
    for (int i = 0; i < t->rows; i++) {
        double E = number(t, i, YOUNG);
        if (strcmp(curves_cell(t, i, SOLVER), "adaptive") != 0) continue;
        if (!(E >= c.from && E <= c.to)) continue;
        double growth = fmax(number(t, i, ITERATIONS), 1) / first;
        if (!(growth <= c.growth)) c.growth = growth, c.growth_at = E;
        int direct = stiffness_row(t, E, "direct");
        double time =
            direct < 0 ? NAN : number(t, i, LINEAR_SECONDS) / number(t, direct, LINEAR_SECONDS);
        if (curves__finite(time) && !(time <= c.time)) c.time = time, c.time_at = E;
    }
    return c;
}

static void stiffness_verdict(report *r, const curves_table *t) {
    stiffness_check c = check_stiffness(t);
    char text[400] = "", a[32], b[32];
    if (c.growth != c.growth) {
        report_note(r, "No rows of `adaptive` from 1e4 to 1e12 Pa.", REPORT_WARN);
        return;
    }
    int wide = c.from <= 1.001e4 && c.to >= 0.999e12;
    snprintf(
        text, sizeof text,
        "Iterations of adaptive: at most %.2f times those at %s Pa (at %s Pa); the bound is 5.%s",
        c.growth, curves__g(c.from, a), curves__g(c.growth_at, b),
        wide ? "" : " Not all of 1e4 to 1e12 Pa was measured.");
    report_note(r, text, c.growth > 5 ? REPORT_BAD : wide ? REPORT_GOOD : REPORT_WARN);
    if (c.time == c.time)
        snprintf(
            text, sizeof text,
            "Linear-solve time of adaptive: at most %.2f times the direct solver's (at %s Pa); "
            "the bound is 1.10.",
            c.time, curves__g(c.time_at, a));
    else
        snprintf(text, sizeof text, "Linear-solve time: no rows of `direct` to compare with.");
    report_note(r, text, c.time > 1.1 ? REPORT_BAD : c.time == c.time ? REPORT_GOOD : REPORT_WARN);
}

static report_level stiffness_level(const curves_table *t, int row, int column) {
    return column == STIFFNESS_STATUS ? status_level(curves_cell(t, row, column)) : REPORT_INFO;
}

static void draw_stiffness(source *s, report *r) {
    static const char *const heads[7] = {
        "E, Pa",           "solver",   "Newton iterates", "linear iterations",
        "linear solve, s", "total, s", "status"};
    char path[700];
    curves_table t;
    report_heading(r, "Stiffness: a hand on spikes, E from 100 Pa to 1 TPa");
    if (!open_table(s, r, "stiffness.csv", stiffness_header, "OUT=out/report sh bench/stability.sh", &t,
                    path))
        return;
    stiffness_verdict(r, &t);
    report_columns_begin(r);
    stiffness_plot(r, &t, ITERATIONS, "Iterations of the linear solver", "iterations");
    stiffness_plot(r, &t, LINEAR_SECONDS, "Time of the linear solves", "seconds");
    stiffness_plot(r, &t, NEWTON, "Newton iterates", "iterates");
    stiffness_plot(r, &t, TOTAL_SECONDS, "Time in all", "seconds");
    report_columns_end(r);
    if (*t.comment) report_code(r, t.comment);
    grid_of(r, &t, NULL, heads, stiffness_level);
    curves_table_free(&t);
}

static void page_stability(source *s, report *r) {
    draw_stability(s, r);
    draw_stiffness(s, r);
}

// ---------------------------------------------------------------------------------------------
// >>leave_out
// ---------------------------------------------------------------------------------------------

enum { FEATURE, OBJECT, OBJECT_WITHOUT, MEMORY, MEMORY_WITHOUT, ABSENT, WITHOUT, RATIO, NOTE };

static const char *const leave_out_header =
    "feature,object_bytes,object_bytes_without,memory_bytes,memory_bytes_without,"
    "instructions_absent,instructions_without,ratio,note";

// Absent at run time may cost 2 % more than compiled out.
static report_level leave_out_level(const curves_table *t, int row, int column) {
    double v = number(t, row, RATIO);
    if (column != RATIO || v != v) return REPORT_INFO;
    return v <= 1.02 ? REPORT_GOOD : REPORT_BAD;
}

static void leave_out_bars(report *r, const curves_table *t) {
    double *v = (double *)calloc((size_t)t->rows + 1, sizeof *v);
    const char **name = (const char **)calloc((size_t)t->rows + 1, sizeof *name);
    int n = 0;
    for (int i = 0; v && name && i < t->rows; i++) {
        double saved = 1e-3 * (number(t, i, OBJECT) - number(t, i, OBJECT_WITHOUT));
        if (saved > 0) name[n] = curves_cell(t, i, FEATURE), v[n++] = saved;
    }
    report_series s;
    memset(&s, 0, sizeof s);
    s.name = "saved", s.y = v, s.count = n;
    report_plot p = report_plot_default("Object code that leaving it out saves", "kB", NULL);
    if (n) report_add_bars(r, &p, name, &s, 1);
    free(v), free((void *)name);
}

static void page_leave_out(source *s, report *r) {
    static const char *const heads[9] = {"feature",      "object code, bytes",
                                         "compiled out", "memory, bytes",
                                         "compiled out", "instructions a step, absent at run time",
                                         "compiled out", "ratio",
                                         "note"};
    char path[700], text[100];
    curves_table t;
    int over = 0, measured = 0;
    double worst = 0;
    if (!open_table(s, r, "leave_out.csv", leave_out_header, "sh bench/leave_out.sh build out/report", &t,
                    path))
        return;
    for (int i = 0; i < t.rows; i++) {
        double ratio = number(&t, i, RATIO);
        if (ratio != ratio) continue;
        worst = fmax(worst, ratio), measured++, over += ratio > 1.02;
    }
    snprintf(text, sizeof text, "%d", t.rows);
    report_status(r, "Features", text, REPORT_INFO);
    snprintf(text, sizeof text, "%d of %d", measured - over, measured);
    report_status(r, "Cost nothing when absent (ratio at most 1.02)", text,
                  !measured ? REPORT_WARN
                  : over    ? REPORT_BAD
                            : REPORT_GOOD);
    snprintf(text, sizeof text, "%.4f", worst);
    if (measured) report_status(r, "Worst ratio", text, over ? REPORT_BAD : REPORT_GOOD);
    report_text(
        r,
        "What a scene does not use costs nothing: the step without the feature, the feature's "
        "code there but unused, over the same step with its code compiled out. The ratio must "
        "be at most 1.02.");
    if (*t.comment) report_code(r, t.comment);
    grid_of(r, &t, NULL, heads, leave_out_level);
    leave_out_bars(r, &t);
    curves_table_free(&t);
}

// ---------------------------------------------------------------------------------------------
// >>neural: paper B's tables and figures from the files of bench/neural.sh. Seeds are averaged.
// ---------------------------------------------------------------------------------------------

enum { SYSTEM, METHOD, SEED, DOF, ELEMENTS, DIMENSION, STEP_MS, NEURAL_ITERATIONS, EVALUATIONS };
enum { EXIT_CONVERGED = EVALUATIONS + 1, EXIT_SADDLE, EXIT_LINE, EXIT_ITERATIONS, GRADIENT, LIP };
enum { PROJECTION = LIP + 1, SIMULATION, TRAIN_SECONDS, PROJECTION_MAX, SIMULATION_MAX, ENERGY };
enum { Z_SCALE = ENERGY + 1, LIP_RELATIVE, WEIGHT, NEURAL_SOLVER, LIP_0, LIP_1, ORDER, EPS, CELLS };

static const char *const neural_header =
    "system,method,seed,dof,elements,r,step_ms,iterations,evaluations,exit_converged,exit_saddle,"
    "exit_line,exit_iterations,gradient,lip,projection_error,simulation_error,train_seconds,"
    "projection_max,simulation_max,energy,z_scale,lip_relative,lipschitz_weight,solver,lip_0,lip_1,"
    "order,eps,runtime_cells,lip_decoder";
static const char *const neural_command = "sh bench/neural.sh";

typedef struct neural_column {
    const char *head;
    int column, percent;  // percent: of the four exits
} neural_column;

// Rows of the same system, method and key (a column; -1: none) as the row.
static int neural_alike(const curves_table *t, int a, int b, int key) {
    return !strcmp(curves_cell(t, a, SYSTEM), curves_cell(t, b, SYSTEM)) &&
           !strcmp(curves_cell(t, a, METHOD), curves_cell(t, b, METHOD)) &&
           (key < 0 || !strcmp(curves_cell(t, a, key), curves_cell(t, b, key)));
}

static int neural_first(const curves_table *t, int row, int key) {
    for (int i = 0; i < row; i++)
        if (neural_alike(t, i, row, key)) return 0;
    return 1;
}

static double neural_number(const curves_table *t, int row, neural_column c) {
    double all = 0;
    for (int k = EXIT_CONVERGED; c.percent && k <= EXIT_ITERATIONS; k++) all += number(t, row, k);
    double v = number(t, row, c.column);
    int lip = c.column == LIP || c.column == LIP_RELATIVE || c.column == LIP_0 || c.column == LIP_1;
    if (lip && v == 0) return NAN;  // not asked of this method
    return v * (c.percent ? 100 / all : 1);
}

// The mean over the rows alike; *runs (NULL allowed): how many.
static double neural_average(const curves_table *t, int row, int key, neural_column c, int *runs) {
    double sum = 0;
    int n = 0;
    for (int i = 0; i < t->rows; i++)
        if (neural_alike(t, i, row, key)) sum += neural_number(t, i, c), n++;
    if (runs) *runs = n;
    return sum / n;
}

// The row of the same system and key by a method; -1: none.
static int neural_partner(const curves_table *t, int row, int key, const char *method) {
    for (int i = 0; i < t->rows; i++)
        if (!strcmp(curves_cell(t, i, SYSTEM), curves_cell(t, row, SYSTEM)) &&
            !strcmp(curves_cell(t, i, METHOD), method) &&
            (key < 0 || !strcmp(curves_cell(t, i, key), curves_cell(t, row, key))))
            return i;
    return -1;
}

// How many times faster than vanilla; NAN: there is none.
static double neural_speed(const curves_table *t, int row, int key) {
    static const neural_column ms = {"", STEP_MS, 0};
    int vanilla = neural_partner(t, row, key, "vanilla");
    if (vanilla < 0) return NAN;
    return neural_average(t, vanilla, key, ms, NULL) / neural_average(t, row, key, ms, NULL);
}

static const char *neural_text(double v, char text[64]) {
    if (v != v) return "\xe2\x80\x93";
    if (v == 0 || (fabs(v) >= 1e-3 && fabs(v) < 1e5))
        snprintf(text, 64, "%.4g", v);
    else
        snprintf(text, 64, "%.2e", v);
    return text;
}

// A line a system, method and key: runs, speed against vanilla, and the columns' means. Methods that
// the solver of a subspace does not concern are left out where there is a key.
static void neural_means(report *r, const curves_table *t, int key, const char *key_head,
                         const neural_column *column, int columns) {
    enum { MOST = 20 };
    const char *heads[MOST] = {"system", "method", key_head};
    int n = key < 0 ? 2 : 3, width = n + 2 + columns, rows = 0;
    heads[n] = "seeds", heads[n + 1] = "speed over vanilla";
    for (int k = 0; k < columns; k++) heads[n + 2 + k] = column[k].head;
    report_cell *cell = (report_cell *)calloc((size_t)(t->rows * width + 1), sizeof *cell);
    char(*text)[64] = (char(*)[64])calloc((size_t)(t->rows * width + 1), sizeof *text);
    for (int i = 0; cell && text && i < t->rows; i++) {
        const char *method = curves_cell(t, i, METHOD);
        int runs = 0, k = rows * width, subspace = !strcmp(method, "vanilla") || !strcmp(method, "lipschitz");
        if (!neural_first(t, i, key) || (key >= 0 && !subspace)) continue;
        cell[k].text = curves_cell(t, i, SYSTEM), cell[k + 1].text = method;
        if (key >= 0) cell[k + 2].text = curves_cell(t, i, key);
        for (int j = 0; j < columns; j++)
            cell[k + n + 2 + j].text = neural_text(neural_average(t, i, key, column[j], &runs), text[k + n + 2 + j]);
        snprintf(text[k + n], 64, "%d", runs);
        double speed = neural_speed(t, i, key);
        cell[k + n].text = text[k + n], cell[k + n + 1].text = neural_text(speed, text[k + n + 1]);
        if (!strcmp(method, "lipschitz")) cell[k + n + 1].level = speed > 1 ? REPORT_GOOD : REPORT_WARN;
        rows++;
    }
    if (cell && text) report_grid(r, NULL, heads, cell, width, rows);
    free(cell), free(text);
}

// One file's table under a heading.
static void neural_section(source *s, report *r, const char *heading, const char *words, const char *file, int key,
                           const char *key_head, const neural_column *column, int columns) {
    char path[700];
    curves_table t;
    report_heading(r, heading);
    if (!open_table(s, r, file, neural_header, neural_command, &t, path)) return;
    report_text(r, words);
    if (*t.comment) report_code(r, t.comment);
    neural_means(r, &t, key, key_head, column, columns);
    curves_table_free(&t);
}

static void neural_tiles(report *r, const curves_table *t) {
    for (int i = 0; i < t->rows; i++) {
        char text[80];
        double speed = neural_speed(t, i, -1);
        if (strcmp(curves_cell(t, i, METHOD), "lipschitz") != 0 || !neural_first(t, i, -1) || speed != speed) continue;
        snprintf(text, sizeof text, "%.2f times vanilla's speed", speed);
        report_status(r, curves_cell(t, i, SYSTEM), text, speed > 1 ? REPORT_GOOD : REPORT_WARN);
    }
}

static void neural_methods(source *s, report *r) {
    static const neural_column c[] = {{"DOF", DOF, 0}, {"elements", ELEMENTS, 0}, {"r", DIMENSION, 0},
        {"step, ms", STEP_MS, 0}, {"iterations", NEURAL_ITERATIONS, 0}, {"evaluations", EVALUATIONS, 0},
        {"Lip (Eq. 7)", LIP, 0}, {"Lip relative to the spread of z", LIP_RELATIVE, 0},
        {"projection error", PROJECTION, 0}, {"simulation error", SIMULATION, 0}, {"training, s", TRAIN_SECONDS, 0}};
    char path[700];
    curves_table t;
    if (!open_table(s, r, "neural.csv", neural_header, neural_command, &t, path)) return;
    neural_tiles(r, &t);
    report_text(r,
                "Table 1: a step in the subspace of a decoder trained without L_LS (vanilla), with it (lipschitz), in "
                "the best linear subspace of the same r, and in full space. Errors are distances over the diagonal of "
                "the rest shape, the mean of nodes and states: from the nearest state that the decoder reaches, and "
                "from the full-space run beside it. Numbers are means over seeds. All lipschitz rows but pulled_bar's have "
                "lipschitz.whiten and lipschitz.unit too, departures from the paper that most of the gain comes from (Lip has the unit of z: its relative column has not); the networks of dinosaur, dinosaur_small, elephant and bunny, "
                "vanilla's too, began as the linear subspace (docs/neural.md).");
    if (*t.comment) report_code(r, t.comment);
    neural_means(r, &t, -1, NULL, c, (int)(sizeof c / sizeof *c));
    curves_table_free(&t);
}

// >>neural_curves: lines over a column, one a measure; points of the same x are averaged

typedef struct neural_line {
    const char *name;
    int column, filter;  // rows whose cell of column `filter` is `word`; -1: all
    const char *word;
} neural_line;

static int neural_passes(const curves_table *t, int row, const char *system, const neural_line *l) {
    return !strcmp(curves_cell(t, row, SYSTEM), system) &&
           (l->filter < 0 || !strcmp(curves_cell(t, row, l->filter), l->word));
}

// Points by ascending x; returns how many.
static int neural_points(const curves_table *t, const char *system, const neural_line *l, int over, double *x, double *y) {
    int n = 0;
    for (double last = -INFINITY;; n++) {
        double next = INFINITY, sum = 0;
        int count = 0;
        for (int i = 0; i < t->rows; i++)
            if (neural_passes(t, i, system, l) && number(t, i, over) > last) next = fmin(next, number(t, i, over));
        if (!curves__finite(next)) return n;
        for (int i = 0; i < t->rows; i++)
            if (neural_passes(t, i, system, l) && number(t, i, over) == next) sum += number(t, i, l->column), count++;
        x[n] = next, y[n] = sum / count, last = next;
    }
}

static void neural_plot(report *r, const curves_table *t, const char *system, const char *title, int over,
                        const char *x_unit, const char *y_unit, const neural_line *line, int lines) {
    enum { MOST = 8 };
    char text[160];
    size_t rows = (size_t)t->rows + 1;
    double *room = (double *)calloc(2 * MOST * rows, sizeof *room);
    report_series s[MOST];
    memset(s, 0, sizeof s);
    for (int k = 0; room && k < lines; k++) {
        double *x = room + 2 * (size_t)k * rows;
        s[k].name = line[k].name, s[k].x = x, s[k].y = x + rows, s[k].colour = k + 1, s[k].style = REPORT_SOLID;
        s[k].count = neural_points(t, system, &line[k], over, x, x + rows);
    }
    snprintf(text, sizeof text, "%.60s: %.80s", system, title);
    report_plot p = report_plot_default(text, x_unit, y_unit);
    p.log_y = p.markers = 1;
    if (room) report_add_plot(r, &p, s, lines);
    free(room);
}

static int neural_new_system(const curves_table *t, int row) {
    for (int i = 0; i < row; i++)
        if (!strcmp(curves_cell(t, i, SYSTEM), curves_cell(t, row, SYSTEM))) return 0;
    return 1;
}

enum { PERCENT = SEED + 1, E_SIMULATION, E_SIMULATION_FARTHEST, E_PROJECTION, E_PROJECTION_FARTHEST };

static const char *const errors_header =
    "system,method,seed,percent,simulation,simulation_farthest,projection,projection_farthest";

static void neural_distributions(source *s, report *r) {
    static const char *const title[4] = {"simulation error", "simulation error, farthest node", "projection error", "projection error, farthest node"};
    static const char *const method[3] = {"vanilla", "lipschitz", "linear"};
    char path[700];
    curves_table t;
    report_heading(r, "Distributions of the errors");
    if (!open_table(s, r, "neural_errors.csv", errors_header, neural_command, &t, path)) return;
    report_text(r, "Below which error a share of the states are: of each test step, and of every fourth test state's projection. "
                   "Means over seeds of their deciles, over the diagonal of the rest shape.");
    report_columns_begin(r);
    for (int i = 0; i < t.rows; i++)
        for (int k = 0; neural_new_system(&t, i) && k < 4; k++) {
            neural_line line[3];
            int lines = neural_partner(&t, i, -1, "linear") < 0 ? 2 : 3;  // unsupervised: no such subspace
            for (int m = 0; m < lines; m++) line[m].name = line[m].word = method[m], line[m].column = E_SIMULATION + k, line[m].filter = METHOD;
            neural_plot(r, &t, curves_cell(&t, i, SYSTEM), title[k], PERCENT, "% of states", "over the diagonal", line, lines);
        }
    report_columns_end(r);
    curves_table_free(&t);
}

static void neural_dimension(source *s, report *r) {
    static const neural_line lines[3][2] = {
        {{"vanilla", PROJECTION, METHOD, "vanilla"}, {"lipschitz", PROJECTION, METHOD, "lipschitz"}},
        {{"vanilla", STEP_MS, METHOD, "vanilla"}, {"lipschitz", STEP_MS, METHOD, "lipschitz"}},
        {{"vanilla", LIP, METHOD, "vanilla"}, {"lipschitz", LIP, METHOD, "lipschitz"}}};
    static const char *const title[3] = {"projection error", "time of a step", "Lip (Eq. 7)"};
    static const char *const unit[3] = {"over the diagonal", "ms", "J"};
    static const neural_column c[] = {{"step, ms", STEP_MS, 0}, {"evaluations", EVALUATIONS, 0},
        {"projection error", PROJECTION, 0}, {"simulation error", SIMULATION, 0}, {"Lip", LIP, 0}};
    char path[700];
    curves_table t;
    report_heading(r, "Dimension of the subspace (Fig. 11)");
    if (!open_table(s, r, "neural_r.csv", neural_header, neural_command, &t, path)) return;
    if (*t.comment) report_code(r, t.comment);
    report_columns_begin(r);
    for (int i = 0; i < t.rows; i++)
        for (int k = 0; neural_new_system(&t, i) && k < 3; k++)
            neural_plot(r, &t, curves_cell(&t, i, SYSTEM), title[k], DIMENSION, "r", unit[k], lines[k], 2);
    report_columns_end(r);
    neural_means(r, &t, DIMENSION, "r", c, (int)(sizeof c / sizeof *c));
    curves_table_free(&t);
}

enum { M_SYSTEM, M_SEED, M_DOF, M_ELEMENTS, M_R, M_WANTED, M_CELLS, SELECT_SECONDS, SELECT_ERROR, GRADIENT_ERROR };
enum { HESSIAN_ERROR = GRADIENT_ERROR + 1, LOSS_ERROR, VANILLA_MS, ALL_MS, CUBATURE_MS, ESTIMATOR };

static const char *const measure_header =
    "system,seed,dof,elements,r,wanted,cells,select_seconds,select_error,gradient_error,hessian_error,loss_error,"
    "vanilla_ms,all_ms,cubature_ms,estimator,batch,lipschitz_batch";

static report_level no_level(const curves_table *t, int row, int column) {
    (void)t, (void)row, (void)column;
    return REPORT_INFO;
}

static void neural_measures(source *s, report *r, const char *file, int cost) {
    static const neural_line errors[] = {{"gradient", GRADIENT_ERROR, -1, NULL}, {"Hessian", HESSIAN_ERROR, -1, NULL},
                                         {"L_LS", LOSS_ERROR, -1, NULL}};
    static const neural_line seconds[] = {{"generation", SELECT_SECONDS, -1, NULL}};
    static const neural_line steps[] = {{"vanilla", VANILLA_MS, -1, NULL},
        {"L_LS, all cells", ALL_MS, ESTIMATOR, "u"}, {"L_LS, cubature", CUBATURE_MS, ESTIMATOR, "u"},
        {"exact L_LS, all cells", ALL_MS, ESTIMATOR, "exact"}, {"exact L_LS, cubature", CUBATURE_MS, ESTIMATOR, "exact"}};
    static const char *const heads[] = {"system", "seed", "DOF", "elements", "r", "cells, at most", "cells",
        "generation, s", "error of the selection", "of the gradient", "of the Hessian", "of L_LS", "vanilla step, ms",
        "with L_LS, all cells, ms", "cubature, ms", "estimator", "batch of L_C", "batch of L_LS"};
    char path[700];
    curves_table t;
    if (!open_table(s, r, file, measure_header, neural_command, &t, path)) return;
    if (*t.comment) report_code(r, t.comment);
    report_columns_begin(r);
    for (int i = 0; i < t.rows; i++) {
        const char *system = curves_cell(&t, i, M_SYSTEM);
        if (!neural_new_system(&t, i)) continue;
        if (cost) {
            neural_plot(r, &t, system, "a step of training", M_R, "r", "CPU ms", steps, 5);
        } else {
            neural_plot(r, &t, system, "relative errors", M_CELLS, "cells", "relative", errors, 3);
            neural_plot(r, &t, system, "time to choose the cells", M_CELLS, "cells", "s", seconds, 1);
        }
    }
    report_columns_end(r);
    grid_of(r, &t, NULL, heads, no_level);
    curves_table_free(&t);
}

static const char *const bridge_header =
    "system,basis,seed,r,oracle,step_ms,iterates,added,enriched,nodes,refresh_ms,failed,simulation_error,simulation_max,"
    "start_error,dof,elements,steps,error_nodes,progress,tol_rel";

static void neural_bridge(source *s, report *r) {
    static const char *const heads[] = {"system", "basis", "seed", "columns", "oracle", "step, ms", "iterates", "nodes added a step",
        "nodes enriched", "nodes", "of the step: z and the tangent, ms", "steps not converged", "simulation error", "farthest node",
        "start of a step from f(z)", "DOF", "elements", "steps", "error_nodes", "progress", "tol_rel"};
    char path[700];
    curves_table t;
    report_heading(r, "A decoder's tangent as a basis of the adaptive simulator");
    if (!open_table(s, r, "neural_bridge.csv", bridge_header, neural_command, &t, path)) return;
    report_text(r, "The test sequences by the adaptive simulator with the tangent of each decoder and with fixed bases of as many "
                   "columns, without nodes (off) and with those that the oracle adds (on); beside them the decoders' own solver "
                   "(manifold). Errors as in Table 1.");
    if (*t.comment) report_code(r, t.comment);
    grid_of(r, &t, NULL, heads, no_level);
    curves_table_free(&t);
}

static void page_neural(source *s, report *r) {
    static const neural_column exits[] = {{"converged, %", EXIT_CONVERGED, 1}, {"saddle, %", EXIT_SADDLE, 1},
        {"line search, %", EXIT_LINE, 1}, {"iterations, %", EXIT_ITERATIONS, 1}, {"mean exit gradient", GRADIENT, 0},
        {"step, ms", STEP_MS, 0}};
    static const neural_column orders[] = {{"\xce\xbb", WEIGHT, 0}, {"step, ms", STEP_MS, 0}, {"evaluations", EVALUATIONS, 0},
        {"Lip of P", LIP_0, 0}, {"Lip of the gradient", LIP_1, 0}, {"Lip of the Hessian", LIP, 0},
        {"spread of z", Z_SCALE, 0}, {"simulation error", SIMULATION, 0}};
    static const neural_column newton[] = {{"step, ms", STEP_MS, 0}, {"iterations", NEURAL_ITERATIONS, 0},
        {"evaluations", EVALUATIONS, 0}, {"simulation error", SIMULATION, 0}};
    static const neural_column runtime[] = {{"step, ms", STEP_MS, 0}, {"evaluations", EVALUATIONS, 0},
        {"simulation error", SIMULATION, 0}};
    neural_methods(s, r);
    neural_distributions(s, r);
    neural_section(s, r, "BFGS that remembers",
                   "The same decoders and tests by the library's default solver, whose inverse Hessian stays from step to step; "
                   "everything else on this page is by the paper's L-BFGS, which begins each step anew, or by projected Newton.",
                   "neural_bfgs.csv", CELLS, "cells at run time", newton, 4);
    neural_section(s, r, "Projected Newton (Table 4)", "The same decoders, each step by projected Newton.",
                   "neural_newton.csv", -1, NULL, newton, 4);
    neural_section(s, r, "When to stop (Table 2)",
                   "How the steps of L-BFGS ended, over the bound eps on the largest component of the gradient.",
                   "neural_eps.csv", EPS, "eps", exits, 6);
    neural_section(s, r, "Order of the loss (Table 3)",
                   "L_LS of Eq. 12. The weight of each order is such that it times Lip squared of that order, vanilla's, "
                   "is the same.", "neural_order.csv", ORDER, "order", orders, 8);
    neural_section(s, r, "Cubature at run time (Table 5)",
                   "The solver's energy on all cells, or on cells chosen for each decoder.", "neural_runtime.csv", CELLS,
                   "cells", runtime, 3);
    report_heading(r, "Cells of the cubature (Fig. 10)");
    neural_measures(s, r, "neural_cubature.csv", 0);
    report_heading(r, "What a step of training costs (Fig. 3)");
    neural_measures(s, r, "neural_cost.csv", 1);
    neural_dimension(s, r);
    neural_bridge(s, r);
}

// ---------------------------------------------------------------------------------------------
// >>pages
// ---------------------------------------------------------------------------------------------

static const struct {
    const char *file, *title;
    void (*draw)(source *, report *);
} pages[] = {
    {"index.html", "Error against run time", page_index},
    {"stability.html", "Stability on stiff and extreme cases", page_stability},
    {"leave_out.html", "Leaving out what a scene does not need", page_leave_out},
    {"neural.html", "Neural subspaces", page_neural},
};

enum { PAGES = sizeof pages / sizeof *pages };

// 1: every page written and every file that is there read.
static int write_pages(const char *results, const char *out, const char *to) {
    source s = {results, out, 0};
    for (int k = 0; k < PAGES; k++) {
        report_link links[PAGES];
        report_error why;
        report *r = report_begin(pages[k].title, NULL);
        for (int j = 0; j < PAGES; j++)
            links[j].file = j == k ? NULL : pages[j].file, links[j].text = pages[j].title;
        report_links(r, links, PAGES);
        pages[k].draw(&s, r);
        if (!report_end_as(r, to, pages[k].file, &why))
            fprintf(stderr, "report: %s\n", why.message), s.failed = 1;
    }
    return !s.failed;
}

#ifndef REPORT_NO_MAIN
// A line a scene for the documentation: the stretch of errors in which adaptive is the cheapest,
// and its cheapest run of at most 10, 3 and 1 % against full space at the scene's tolerance.
static int print_text(const char *results) {
    static const double levels[] = {0.1, 0.03, 0.01};
    char rows[600], steps[600];
    curves c;
    curves_error why;
    snprintf(rows, sizeof rows, "%s/error_vs_time.csv", results);
    snprintf(steps, sizeof steps, "%s/error_steps.csv", results);
    if (!curves_read(&c, rows, steps, &why)) return fprintf(stderr, "report: %s\n", why.message), 0;
    printf("| scene | cheapest for errors of | decades | rank |");
    for (int k = 0; k < 3; k++) printf(" %g %%: error_nodes, direct, best |", 100 * levels[k]);
    printf("\n|---|---|---|---|---|---|---|\n");
    for (int i = 0; i < c.scenes; i++) {
        curves_verdict v = curves_dominates(&c, i, CURVES_MAX);
        if (v.both.decades > 0)
            printf("| %s | %.2g to %.2g %% | %.1f |", c.scene[i], 100 * v.both.lo, 100 * v.both.hi, v.both.decades);
        else
            printf("| %s | none | 0 |", c.scene[i]);
        printf(" %.2f |", curves_rank_of(&c, i, 0).step[0]);
        for (int k = 0; k < 3; k++) {
            curves_choice h = curves_recommend(&c, i, CURVES_MAX, levels[k]).kind[CURVES_ADAPTIVE_KIND];
            if (h.row < 0)
                printf(" - |");
            else
                printf(" %g, %.2f, %.2f |", c.row[h.row].error_nodes, h.over_direct, h.over_full);
        }
        printf("\n");
    }
    curves_free(&c);
    return 1;
}

int main(int argc, char **argv) {
    const char *to = NULL, *folder[2] = {NULL, NULL};
    int n = 0;
    if (argc == 3 && !strcmp(argv[1], "--text")) return print_text(argv[2]) ? 0 : 1;
    for (int i = 1; i < argc; i++)
        if (!strcmp(argv[i], "-o") && i + 1 < argc)
            to = argv[++i];
        else if (argv[i][0] != '-' && n < 2)
            folder[n++] = argv[i];
        else
            n = 3, i = argc;
    if (n != 2) {
        fprintf(stderr, "usage: report [-o OUT] RESULTS_DIR OUT_DIR\n       report --text RESULTS_DIR\n");
        return 2;
    }
    if (!to) to = folder[1];
    int ok = write_pages(folder[0], folder[1], to);
    printf("%s/index.html\n", to);
    return ok ? 0 : 1;
}
#endif
