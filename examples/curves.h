/* curves.h: the sweep of error against run time, read from its CSVs and judged (example programs)

   #define REPORT_IMPLEMENTATION      // in one .c file; needs report.h, included first
   #include "report.h"
   #define CURVES_IMPLEMENTATION
   #include "curves.h"

   curves c;
   curves_error why;
   if (!curves_read(&c, "out/error_vs_time.csv", "out/error_steps.csv", &why))
       fprintf(stderr, "%s\n", why.message);            // "FILE: line 7, column 6 (seconds): ..."
   curves_advice a = curves_recommend(&c, 0, CURVES_MAX, 0.01);   // for 1 % error take ...
   if (a.kind[CURVES_ADAPTIVE_KIND].row >= 0) printf("%g s\n",
   a.kind[CURVES_ADAPTIVE_KIND].seconds); curves_verdict v = curves_dominates(&c, 0, CURVES_MAX);
   report *r = report_begin("Error against run time", NULL);
   curves_draw(r, &c, "out");         // tiles, summary, each scene; pictures out/SCENE_*.png
   report_end(r, "out", NULL);
   curves_free(&c);

   THE FILES  error_vs_time.csv has a row a configuration (a method and its tolerances), and
   error_steps.csv a row a configuration and step; the columns are curves_rows_header and
   curves_steps_header, exactly. Lines that start with # come first: machine, command, sizes. A
   field may be quoted; empty: not defined for the method (NAN here). "nan" and "inf" are numbers.

   ERROR  A fraction. error_max and error_mean: of the steps' errors, each the largest distance of a
   node from the tight full-space solution of the same step over that step's largest displacement.
   error_final: the distance at the end of the free trajectory over the scene's diagonal.
   SECONDS  Sum over the steps, best of the repeats. residual: m/s.

   WHAT A CONFIGURATION IS COMPARED WITH  The scene's own tolerance is that of its adaptive and
   subspace runs, which change error_nodes and error_modes only. `direct` is the row of the direct
   solver at it, `full` the cheapest of the full-space solvers at it: what a user has without a
   subspace. The verdict is stricter: at an error e, each kind's cheapest row of error <= e, with
   the full-space solvers free to take the loosest tolerance that gives it.

   MEMORY  malloc, until curves_free. THREADS  A curves may be read by many.

   >>api  >>csv  >>read  >>judge  >>words  >>draw                                                 */
#ifndef CURVES_H
#define CURVES_H

#ifndef REPORT_H
#error "include report.h before curves.h"
#endif

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef CURVES_API
#define CURVES_API extern
#endif

// ---------------------------------------------------------------------------------------------
// >>api (public)
// ---------------------------------------------------------------------------------------------

typedef struct curves_error {
    char message[512];
} curves_error;

// A CSV file: `columns` cells a row, row after row.
typedef struct curves_table {
    char *text;     // the file; cells point into it
    char *comment;  // the # lines without the #, each with its \n
    const char **cell;
    int *line;  // of each row, from 1
    int columns, rows;
    const char *header, *path;  // as given
} curves_table;

typedef enum curves_method {
    CURVES_SUBSPACE,
    CURVES_ADAPTIVE,
    CURVES_DIRECT,  // this and the next: full-space solvers
    CURVES_PCG,
    CURVES_AUTO,
    CURVES_METHODS
} curves_method;

typedef enum curves_kind {
    CURVES_SUBSPACE_KIND,
    CURVES_ADAPTIVE_KIND,
    CURVES_FULL_KIND,
    CURVES_KINDS
} curves_kind;

typedef enum curves_measure { CURVES_MAX, CURVES_MEAN, CURVES_FINAL } curves_measure;

typedef struct curves_row {
    int scene, line;
    curves_method method;
    double error_nodes, error_modes, tol, seconds, error_max, error_mean, error_final, residual,
        enriched_share, modes_share;
} curves_row;

enum {
    CURVES_PHASES = 8
};  // energy, gradient, hessian, oracle, assemble, linear, collision, other

typedef struct curves_step {
    int row;  // of the configuration; -1: error_vs_time.csv does not have it (yet)
    int scene, step;
    curves_method method;
    double error_nodes, error_modes, tol, seconds, error, error_mean, residual_max, residual_mean,
        oracle_error, enriched_share, modes_share, newton, linear_iters, contacts;
    double phase[CURVES_PHASES];
    const char *status;
} curves_step;

typedef struct curves {
    const char **scene;  // in the order of the file
    curves_row *row;
    curves_step *step;
    int scenes, rows, steps;
    const char *comment;               // error_vs_time.csv's
    curves_table rows_csv, steps_csv;  // own the text
} curves;

extern const char *const curves_rows_header, *const curves_steps_header;
extern const char *const curves_methods[CURVES_METHODS];  // "subspace", ...
extern const char *const curves_kinds[CURVES_KINDS];      // "subspace only", ...

// Reads a CSV whose first line after the comments is `header`. If the last column is `note`, it
// takes the rest of the line, commas included. 1, or 0 and a message; then *t is empty.
CURVES_API int curves_table_read(curves_table *t, const char *path, const char *header,
                                 curves_error *error);
CURVES_API void curves_table_free(curves_table *t);
CURVES_API const char *curves_cell(const curves_table *t, int row, int column);
// The number of a cell; empty: NAN if `optional`. 1, or 0 and a message.
CURVES_API int curves_number(const curves_table *t, int row, int column, int optional,
                             double *value, curves_error *error);

// steps_path NULL: no steps. 1, or 0 and a message that names file, line and column; *c is then
// empty. A configuration that is there twice is an error.
CURVES_API int curves_read(curves *c, const char *rows_path, const char *steps_path,
                           curves_error *error);
CURVES_API void curves_free(curves *c);

CURVES_API curves_kind curves_kind_of(curves_method m);
CURVES_API double curves_error_of(const curves_row *row, curves_measure m);
// "adaptive, error_nodes 0.01"; "direct, tol 1e-3".
CURVES_API void curves_name(const curves_row *row, char *text, size_t size);

typedef struct curves_choice {
    int row;  // -1: none reaches the error
    double seconds, error;
    double over_direct, over_full;  // their seconds over these: above 1 is faster. NAN: no such row
} curves_choice;

typedef struct curves_advice {
    double error;                      // asked for
    double own_tol;                    // the scene's own tolerance (see top); NAN: unknown
    int direct, full;                  // rows it is compared with; -1: none
    curves_choice kind[CURVES_KINDS];  // the cheapest of each kind with an error <= `error`
} curves_advice;

CURVES_API curves_advice curves_recommend(const curves *c, int scene, curves_measure m,
                                          double error);

// A stretch of errors [lo, hi) and its length in powers of ten (0: none).
typedef struct curves_span {
    double lo, hi, decades;
} curves_span;

typedef struct curves_verdict {
    int rows[CURVES_KINDS];  // finite ones: without a kind, nothing is said against it
    curves_span adaptive;    // from the least to the largest error of adaptive rows, at most 1
    // The longest stretches of it in which adaptive is cheaper than subspace only, than full space,
    // than both.
    curves_span subspace, full, both;
    int dominates;  // all three kinds measured and both.decades >= 1
} curves_verdict;

CURVES_API curves_verdict curves_dominates(const curves *c, int scene, curves_measure m);
// A sentence or a few that say what the verdict says, and where it is not so.
CURVES_API void curves_verdict_text(const curves *c, int scene, curves_measure m, char *text,
                                    size_t size);

// Spearman's rank correlation: Pearson's of the ranks, ties sharing their mean rank. Pairs with a
// value that is not finite are left out. NAN: fewer than 3 pairs, or all of one side equal.
CURVES_API double curves_spearman(const double *a, const double *b, int count);

// Of residual_max, residual_mean and oracle_error (in this order) with the true error: over the
// (configuration, step) pairs, and of the configurations' largest values over the steps.
typedef struct curves_rank {
    double step[3], config[3];
    int steps[3], configs[3];  // pairs used
} curves_rank;

// Of subspace and adaptive runs, and of full space too if `full`. They must have their row.
CURVES_API curves_rank curves_rank_of(const curves *c, int scene, int full);

// Parts of a page. pictures: the folder of SCENE_subspace.png, SCENE_adaptive.png (the error on the
// bodies) and SCENE_enriched.png; what is not there is left out; NULL: none.
CURVES_API void curves_draw(report *r, const curves *c, const char *pictures);  // all below
CURVES_API void curves_draw_tiles(report *r, const curves *c);
CURVES_API void curves_draw_comment(report *r, const curves *c);
CURVES_API void curves_draw_summary(report *r, const curves *c);
CURVES_API void curves_draw_key(report *r);  // what the summary's columns mean
CURVES_API void curves_draw_scene(report *r, const curves *c, int scene, const char *pictures);
CURVES_API void curves_draw_errors(report *r, const curves *c, int scene, curves_measure m,
                                   const char *title);
CURVES_API void curves_draw_verdict(report *r, const curves *c, int scene, curves_measure m,
                                    const char *lead);
CURVES_API void curves_draw_advice(report *r, const curves *c, int scene);
CURVES_API void curves_draw_pictures(report *r, const curves *c, int scene, const char *folder);
CURVES_API void curves_draw_steps(report *r, const curves *c, int scene);

#ifdef __cplusplus
}
#endif
#endif  // CURVES_H

#if defined(CURVES_IMPLEMENTATION) && !defined(CURVES_IMPLEMENTATION_DONE)
#define CURVES_IMPLEMENTATION_DONE

#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

const char *const curves_rows_header =
    "scene,method,error_nodes,error_modes,tol,seconds,error_max,error_mean,error_final,residual,"
    "enriched_share,modes_share";
const char *const curves_steps_header =
    "scene,method,error_nodes,error_modes,tol,step,seconds,error,error_mean,residual_max,"
    "residual_mean,oracle_error,enriched_share,modes_share,newton,linear_iters,contacts,status,"
    "energy_s,gradient_s,hessian_s,oracle_s,assemble_s,linear_s,collision_s,other_s";
const char *const curves_methods[CURVES_METHODS] = {"subspace", "adaptive", "direct", "pcg",
                                                    "auto"};
const char *const curves_kinds[CURVES_KINDS] = {"subspace only", "adaptive", "full space"};

// ---------------------------------------------------------------------------------------------
// >>csv (private)
// The file is read whole; separators become ends of strings, and cells point into it.
// ---------------------------------------------------------------------------------------------

static int curves__fail(curves_error *e, const char *path, int line, int column, const char *name,
                        const char *what) {
    char at[160] = "";
    if (line > 0 && column > 0)
        snprintf(at, sizeof at, "line %d, column %d (%.100s): ", line, column, name);
    else if (line > 0)
        snprintf(at, sizeof at, "line %d: ", line);
    if (e) snprintf(e->message, sizeof e->message, "%.200s: %s%.140s", path, at, what);
    return 0;
}

static char *curves__slurp(const char *path, curves_error *e) {
    FILE *f = fopen(path, "rb");
    if (!f) return curves__fail(e, path, 0, 0, "", strerror(errno)), (char *)NULL;
    size_t n = 0, cap = 1 << 16, got = 1;
    char *s = (char *)malloc(cap);
    while (s && got > 0) {
        if (n + 1 >= cap) {
            char *p = (char *)realloc(s, cap *= 2);
            if (!p) free(s);
            s = p;
            if (!s) break;
        }
        got = fread(s + n, 1, cap - 1 - n, f), n += got;
    }
    int bad = ferror(f);
    fclose(f);
    if (!s) return curves__fail(e, path, 0, 0, "", "no memory"), s;
    s[n] = 0;
    if (!bad && memchr(s, 0, n) == NULL) return s;
    curves__fail(e, path, 0, 0, "", bad ? "cannot be read" : "expected text");
    free(s);
    return NULL;
}

static int curves__count(const char *header) {
    int n = 1;
    for (; *header; header++) n += *header == ',';
    return n;
}

// Up to the comma.
static const char *curves__word(const char *s, char text[64]) {
    size_t n = strcspn(s, ",");
    if (n > 63) n = 63;
    memcpy(text, s, n), text[n] = 0;
    return text;
}

// The name of a column of the header, into text.
static const char *curves__column(const char *header, int column, char text[64]) {
    for (; column > 0; column--) header += strcspn(header, ",") + 1;
    return curves__word(header, text);
}

// Unquotes in place; *s moves behind the cell, *more: a comma ended it. 0: a quote without its end.
static int curves__cut(char **s, char **cell, int *more) {
    char *p = *s, *to = *s + (**s == '"');
    *cell = to;
    if (*p == '"') {
        for (p++; *p && (*p != '"' || p[1] == '"'); *to++ = *p++) p += *p == '"';
        if (*p != '"' || (p[1] && p[1] != ',')) return 0;
        p++;
    } else {
        *cell += strspn(p, " \t"), p += strcspn(p, ",");
        for (to = p; to > *cell && (to[-1] == ' ' || to[-1] == '\t');) to--;
    }
    *more = *p == ',', *s = p + *more, *to = 0;
    return 1;
}

static int curves__cells(curves_table *t, char *p, int number, curves_error *e) {
    char name[64], what[100];
    const char **cell = t->cell + (size_t)t->rows * (size_t)t->columns;
    int more = 1;
    for (int j = 0; j < t->columns; j++) {
        char *c = p;
        curves__column(t->header, j, name);
        if (!more) {
            snprintf(what, sizeof what, "the line ends after %d of %d columns", j, t->columns);
            return curves__fail(e, t->path, number, j + 1, name, what);
        }
        more = 0;
        int rest = j == t->columns - 1 && !strcmp(name, "note") && *p != '"';
        if (!rest && !curves__cut(&p, &c, &more))
            return curves__fail(e, t->path, number, j + 1, name, "a quote without its end");
        cell[j] = c;
    }
    if (more) return curves__fail(e, t->path, number, 0, "", "more columns than the header has");
    t->line[t->rows++] = number;
    return 1;
}

static int curves__check_header(const curves_table *t, const char *line, int number,
                                curves_error *e) {
    char want[64], found[64], what[140];
    if (!strcmp(line, t->header)) return 1;
    for (int j = 0; j < t->columns; j++) {
        curves__column(t->header, j, want);
        curves__word(line, found);
        if (strcmp(want, found) != 0) {
            snprintf(what, sizeof what, "the header has \"%.40s\" here", found);
            return curves__fail(e, t->path, number, j + 1, want, what);
        }
        line += strcspn(line, ","), line += *line == ',';
    }
    return curves__fail(e, t->path, number, 0, "", "more columns than expected");
}

static int curves__lines(curves_table *t, curves_error *e) {
    int number = 0, header = 0;
    size_t kept = 0;
    for (char *s = t->text, *next; *s; s = next) {
        char *end = s + strcspn(s, "\n");
        next = end + (*end == '\n');
        *end = 0;
        if (end > s && end[-1] == '\r') end[-1] = 0;
        number++;
        if (*s == '#') {
            s += 1 + (s[1] == ' ');
            size_t n = strlen(s);
            memcpy(t->comment + kept, s, n), kept += n;
            t->comment[kept++] = '\n', t->comment[kept] = 0;
        } else if (*s && !header) {
            header = 1;
            if (!curves__check_header(t, s, number, e)) return 0;
        } else if (*s && !curves__cells(t, s, number, e))
            return 0;
    }
    return header || curves__fail(e, t->path, number + 1, 0, "", "no header line");
}

int curves_table_read(curves_table *t, const char *path, const char *header, curves_error *e) {
    memset(t, 0, sizeof *t);
    if (e) e->message[0] = 0;
    t->header = header, t->path = path, t->columns = curves__count(header);
    t->text = curves__slurp(path, e);
    if (!t->text) return 0;
    size_t lines = 1, size = strlen(t->text);
    for (const char *s = t->text; *s; s++) lines += *s == '\n';
    t->comment = (char *)calloc(size + lines + 1, 1);
    t->cell = (const char **)calloc(lines * (size_t)t->columns, sizeof *t->cell);
    t->line = (int *)calloc(lines, sizeof *t->line);
    int ok = t->comment && t->cell && t->line;
    if (!ok) curves__fail(e, path, 0, 0, "", "no memory");
    if (ok) ok = curves__lines(t, e);
    if (!ok) curves_table_free(t);
    return ok;
}

void curves_table_free(curves_table *t) {
    free(t->text), free(t->comment), free((void *)t->cell), free(t->line);
    memset(t, 0, sizeof *t);
}

const char *curves_cell(const curves_table *t, int row, int column) {
    return t->cell[(size_t)row * (size_t)t->columns + (size_t)column];
}

static int curves__bad(const curves_table *t, int row, int column, const char *why,
                       curves_error *e) {
    char name[64], what[140];
    snprintf(what, sizeof what, "%s, found \"%.60s\"", why, curves_cell(t, row, column));
    return curves__fail(e, t->path, t->line[row], column + 1,
                        curves__column(t->header, column, name), what);
}

int curves_number(const curves_table *t, int row, int column, int optional, double *value,
                  curves_error *e) {
    const char *s = curves_cell(t, row, column);
    char *end = NULL;
    *value = NAN;
    if (!*s && optional) return 1;
    *value = strtod(s, &end);
    return (*s && !*end) || curves__bad(t, row, column, "expected a number", e);
}

// ---------------------------------------------------------------------------------------------
// >>read (private)
// ---------------------------------------------------------------------------------------------

static int curves__method(const curves_table *t, int row, curves_method *m, curves_error *e) {
    for (int k = 0; k < CURVES_METHODS; k++)
        if (!strcmp(curves_cell(t, row, 1), curves_methods[k])) {
            *m = (curves_method)k;
            return 1;
        }
    return curves__bad(t, row, 1, "expected subspace, adaptive, direct, pcg or auto", e);
}

static int curves__scene(curves *c, const char *name) {
    for (int k = 0; k < c->scenes; k++)
        if (!strcmp(c->scene[k], name)) return k;
    c->scene[c->scenes] = name;
    return c->scenes++;
}

static int curves__same(double a, double b) { return a == b || (a != a && b != b); }

static int curves__find(const curves *c, int scene, curves_method m, double nodes, double modes,
                        double tol) {
    for (int k = 0; k < c->rows; k++) {
        const curves_row *r = &c->row[k];
        if (r->scene == scene && r->method == m && curves__same(r->error_nodes, nodes) &&
            curves__same(r->error_modes, modes) && curves__same(r->tol, tol))
            return k;
    }
    return -1;
}

static int curves__numbers(const curves_table *t, int row, int first, double *const *to, int count,
                           unsigned optional, curves_error *e) {
    for (int k = 0; k < count; k++)
        if (!curves_number(t, row, first + k, (int)(optional >> k & 1), to[k], e)) return 0;
    return 1;
}

static int curves__read_row(curves *c, int i, curves_error *e) {
    const curves_table *t = &c->rows_csv;
    curves_row r;
    memset(&r, 0, sizeof r);
    double *const to[] = {&r.error_nodes,    &r.error_modes, &r.tol,         &r.seconds,
                          &r.error_max,      &r.error_mean,  &r.error_final, &r.residual,
                          &r.enriched_share, &r.modes_share};
    char what[80];
    if (!*curves_cell(t, i, 0)) return curves__bad(t, i, 0, "expected a scene", e);
    if (!curves__method(t, i, &r.method, e) || !curves__numbers(t, i, 2, to, 10, 0x3c7, e))
        return 0;
    if (!(r.seconds >= 0)) return curves__bad(t, i, 5, "expected seconds", e);
    r.scene = curves__scene(c, curves_cell(t, i, 0)), r.line = t->line[i];
    int twin = curves__find(c, r.scene, r.method, r.error_nodes, r.error_modes, r.tol);
    if (twin >= 0) {
        snprintf(what, sizeof what, "the same configuration as line %d", c->row[twin].line);
        return curves__fail(e, t->path, r.line, 0, "", what);
    }
    c->row[c->rows++] = r;
    return 1;
}

static int curves__read_step(curves *c, int i, curves_error *e) {
    const curves_table *t = &c->steps_csv;
    curves_step s;
    double step = 0;
    memset(&s, 0, sizeof s);
    double *const to[] = {&s.error_nodes,  &s.error_modes,    &s.tol,
                          &step,           &s.seconds,        &s.error,
                          &s.error_mean,   &s.residual_max,   &s.residual_mean,
                          &s.oracle_error, &s.enriched_share, &s.modes_share,
                          &s.newton,       &s.linear_iters,   &s.contacts};
    double *phase[CURVES_PHASES];
    for (int k = 0; k < CURVES_PHASES; k++) phase[k] = &s.phase[k];
    if (!*curves_cell(t, i, 0)) return curves__bad(t, i, 0, "expected a scene", e);
    if (!curves__method(t, i, &s.method, e) || !curves__numbers(t, i, 2, to, 15, 0x7fc7, e) ||
        !curves__numbers(t, i, 18, phase, CURVES_PHASES, 0xff, e))
        return 0;
    if (!(step >= 0 && step < 1e9)) return curves__bad(t, i, 5, "expected a step", e);
    s.step = (int)step, s.status = curves_cell(t, i, 17);
    s.scene = curves__scene(c, curves_cell(t, i, 0));
    s.row = curves__find(c, s.scene, s.method, s.error_nodes, s.error_modes, s.tol);
    c->step[c->steps++] = s;
    return 1;
}

int curves_read(curves *c, const char *rows_path, const char *steps_path, curves_error *e) {
    memset(c, 0, sizeof *c);
    int ok = curves_table_read(&c->rows_csv, rows_path, curves_rows_header, e);
    if (ok && steps_path) ok = curves_table_read(&c->steps_csv, steps_path, curves_steps_header, e);
    if (!ok) {
        curves_free(c);
        return 0;
    }
    size_t rows = (size_t)c->rows_csv.rows, steps = (size_t)c->steps_csv.rows;
    c->comment = c->rows_csv.comment;
    c->scene = (const char **)calloc(rows + steps + 1, sizeof *c->scene);
    c->row = (curves_row *)calloc(rows + 1, sizeof *c->row);
    c->step = (curves_step *)calloc(steps + 1, sizeof *c->step);
    ok = c->scene && c->row && c->step;
    if (!ok) curves__fail(e, rows_path, 0, 0, "", "no memory");
    for (int i = 0; ok && i < c->rows_csv.rows; i++) ok = curves__read_row(c, i, e);
    for (int i = 0; ok && i < c->steps_csv.rows; i++) ok = curves__read_step(c, i, e);
    if (!ok) curves_free(c);
    return ok;
}

void curves_free(curves *c) {
    curves_table_free(&c->rows_csv), curves_table_free(&c->steps_csv);
    free((void *)c->scene), free(c->row), free(c->step);
    memset(c, 0, sizeof *c);
}

// ---------------------------------------------------------------------------------------------
// >>judge (private)
// ---------------------------------------------------------------------------------------------

curves_kind curves_kind_of(curves_method m) {
    return m == CURVES_SUBSPACE   ? CURVES_SUBSPACE_KIND
           : m == CURVES_ADAPTIVE ? CURVES_ADAPTIVE_KIND
                                  : CURVES_FULL_KIND;
}

double curves_error_of(const curves_row *r, curves_measure m) {
    return m == CURVES_MAX ? r->error_max : m == CURVES_MEAN ? r->error_mean : r->error_final;
}

static int curves__finite(double v) { return v - v == 0; }

static int curves__valid(const curves_row *r, curves_measure m) {
    return curves__finite(curves_error_of(r, m)) && curves__finite(r->seconds);
}

// The cheapest row of a kind with an error <= `error`; -1: none.
static int curves__cheapest(const curves *c, int scene, curves_measure m, curves_kind kind,
                            double error) {
    int best = -1;
    for (int k = 0; k < c->rows; k++) {
        const curves_row *r = &c->row[k];
        if (r->scene == scene && curves_kind_of(r->method) == kind && curves__valid(r, m) &&
            curves_error_of(r, m) <= error && (best < 0 || r->seconds < c->row[best].seconds))
            best = k;
    }
    return best;
}

// The most frequent tolerance of the reduced runs (they have one, but for a mended sweep).
static double curves__own_tol(const curves *c, int scene) {
    double own = NAN;
    int most = 0;
    for (int k = 0; k < c->rows; k++) {
        int same = 0;
        for (int j = 0; j < c->rows; j++)
            same += c->row[j].scene == scene && c->row[j].tol == c->row[k].tol &&
                    curves_kind_of(c->row[j].method) != CURVES_FULL_KIND;
        if (c->row[k].scene == scene && same > most) most = same, own = c->row[k].tol;
    }
    return own;
}

// The row of a method whose tolerance is the nearest to `tol` by its logarithm; without a tolerance
// to be near to, the cheapest.
static int curves__at_tol(const curves *c, int scene, curves_method method, double tol) {
    int best = -1;
    double least = INFINITY;
    for (int k = 0; k < c->rows; k++) {
        const curves_row *r = &c->row[k];
        if (r->scene != scene || r->method != method || !curves__finite(r->seconds)) continue;
        double far = fabs(log(r->tol / tol));
        if (far != far) far = 1e3 + r->seconds;
        if (far < least) least = far, best = k;
    }
    return best;
}

curves_advice curves_recommend(const curves *c, int scene, curves_measure m, double error) {
    curves_advice a;
    memset(&a, 0, sizeof a);
    a.error = error, a.own_tol = curves__own_tol(c, scene);
    a.direct = curves__at_tol(c, scene, CURVES_DIRECT, a.own_tol), a.full = a.direct;
    for (int k = CURVES_PCG; k <= CURVES_AUTO; k++) {
        int row = curves__at_tol(c, scene, (curves_method)k, a.own_tol);
        if (row >= 0 && (a.full < 0 || c->row[row].seconds < c->row[a.full].seconds)) a.full = row;
    }
    for (int k = 0; k < CURVES_KINDS; k++) {
        curves_choice *h = &a.kind[k];
        h->row = curves__cheapest(c, scene, m, (curves_kind)k, error);
        h->seconds = h->error = h->over_direct = h->over_full = NAN;
        if (h->row < 0) continue;
        h->seconds = c->row[h->row].seconds, h->error = curves_error_of(&c->row[h->row], m);
        if (a.direct >= 0) h->over_direct = c->row[a.direct].seconds / h->seconds;
        if (a.full >= 0) h->over_full = c->row[a.full].seconds / h->seconds;
    }
    return a;
}

static int curves__up(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double curves__seconds(const curves *c, int scene, curves_measure m, curves_kind kind,
                              double error) {
    int k = curves__cheapest(c, scene, m, kind, error);
    return k >= 0 ? c->row[k].seconds : INFINITY;
}

// Extends the open stretch to hi, or ends it; keeps the longest.
static void curves__stretch(curves_span *best, curves_span *open, int holds, double lo, double hi) {
    if (!holds) {
        open->decades = 0;
        return;
    }
    if (!(open->decades > 0)) open->lo = lo;
    open->hi = hi, open->decades = log10(hi / open->lo);
    if (open->decades > best->decades) *best = *open;
}

// Between two neighbouring errors of rows no kind's cheapest time changes, so the pieces are exact.
// An error of exactly 0 counts as 1e-12.
curves_verdict curves_dominates(const curves *c, int scene, curves_measure m) {
    curves_verdict v;
    curves_span none = {NAN, NAN, 0}, open[3] = {{0, 0, 0}, {0, 0, 0}, {0, 0, 0}};
    memset(&v, 0, sizeof v);
    v.adaptive = v.subspace = v.full = v.both = none;
    double *edge = (double *)calloc((size_t)c->rows + 1, sizeof *edge), lo = INFINITY, hi = 0;
    if (!edge) return v;
    int n = 0;
    for (int k = 0; k < c->rows; k++) {
        const curves_row *r = &c->row[k];
        if (r->scene != scene || !curves__valid(r, m)) continue;
        curves_kind kind = curves_kind_of(r->method);
        double error = fmax(curves_error_of(r, m), 1e-12);
        v.rows[kind]++;
        edge[n++] = error;
        if (kind == CURVES_ADAPTIVE_KIND) lo = fmin(lo, error), hi = fmax(hi, fmin(error, 1));
    }
    qsort(edge, (size_t)n, sizeof *edge, curves__up);
    if (hi > lo) v.adaptive.lo = lo, v.adaptive.hi = hi, v.adaptive.decades = log10(hi / lo);
    for (int k = 0; k < n && hi > lo; k++) {
        double from = fmax(edge[k], lo), to = fmin(k + 1 < n ? edge[k + 1] : hi, hi);
        if (!(to > from)) continue;
        double own = curves__seconds(c, scene, m, CURVES_ADAPTIVE_KIND, from);
        int s = own < curves__seconds(c, scene, m, CURVES_SUBSPACE_KIND, from);
        int f = own < curves__seconds(c, scene, m, CURVES_FULL_KIND, from);
        curves__stretch(&v.subspace, &open[0], s, from, to);
        curves__stretch(&v.full, &open[1], f, from, to);
        curves__stretch(&v.both, &open[2], s && f, from, to);
    }
    free(edge);
    // A decade, but for the rounding of 0.01 and 0.1.
    v.dominates = v.rows[0] && v.rows[1] && v.rows[2] && v.both.decades >= 1 - 1e-9;
    return v;
}

typedef struct curves__pair {
    double a, b, rank;
} curves__pair;

static int curves__up_a(const void *x, const void *y) {
    return curves__up(&((const curves__pair *)x)->a, &((const curves__pair *)y)->a);
}

static int curves__up_b(const void *x, const void *y) {
    return curves__up(&((const curves__pair *)x)->b, &((const curves__pair *)y)->b);
}

double curves_spearman(const double *a, const double *b, int count) {
    curves__pair *p = (curves__pair *)calloc((size_t)count + 1, sizeof *p);
    int n = 0;
    for (int i = 0; p && i < count; i++)
        if (curves__finite(a[i]) && curves__finite(b[i])) p[n].a = a[i], p[n++].b = b[i];
    if (n < 3) {
        free(p);
        return NAN;
    }
    // Ranks of a are kept in p.rank; those of b replace it in the second pass.
    double mean = 0.5 * (n + 1), ab = 0, aa = 0, bb = 0;
    qsort(p, (size_t)n, sizeof *p, curves__up_a);
    for (int i = 0, j; i < n; i = j) {
        for (j = i + 1; j < n && p[j].a == p[i].a;) j++;
        for (int k = i; k < j; k++) p[k].rank = 0.5 * (i + j + 1) - mean;
    }
    qsort(p, (size_t)n, sizeof *p, curves__up_b);
    for (int i = 0, j; i < n; i = j) {
        for (j = i + 1; j < n && p[j].b == p[i].b;) j++;
        double rank = 0.5 * (i + j + 1) - mean;
        for (int k = i; k < j; k++)
            ab += p[k].rank * rank, aa += p[k].rank * p[k].rank, bb += rank * rank;
    }
    free(p);
    return aa > 0 && bb > 0 ? ab / sqrt(aa * bb) : NAN;
}

static int curves__pairs(const double *a, const double *b, int n) {
    int pairs = 0;
    for (int i = 0; i < n; i++) pairs += curves__finite(a[i]) && curves__finite(b[i]);
    return pairs;
}

static double curves__estimate(const curves_step *s, int which) {
    return which == 0 ? s->residual_max : which == 1 ? s->residual_mean : s->oracle_error;
}

// fmax takes the number where the other is NAN: a step without an estimate is left out.
curves_rank curves_rank_of(const curves *c, int scene, int full) {
    curves_rank r;
    memset(&r, 0, sizeof r);
    size_t most = (size_t)(c->steps > c->rows ? c->steps : c->rows) + 1;
    double *a = (double *)calloc(2 * most, sizeof *a), *b = (double *)calloc(2 * most, sizeof *b);
    double *a_max = a ? a + most : NULL, *b_max = b ? b + most : NULL;
    for (int w = 0; w < 3; w++) {
        int n = 0;
        r.step[w] = r.config[w] = NAN;
        for (int i = 0; a && b && i < c->rows; i++) a_max[i] = b_max[i] = NAN;
        for (int i = 0; a && b && i < c->steps; i++) {
            const curves_step *s = &c->step[i];
            if (s->scene != scene || s->row < 0) continue;
            if (!full && curves_kind_of(s->method) == CURVES_FULL_KIND) continue;
            a[n] = curves__estimate(s, w), b[n] = s->error;
            a_max[s->row] = fmax(a_max[s->row], a[n]), b_max[s->row] = fmax(b_max[s->row], b[n]);
            n++;
        }
        if (!a || !b) continue;
        r.step[w] = curves_spearman(a, b, n), r.steps[w] = curves__pairs(a, b, n);
        r.config[w] = curves_spearman(a_max, b_max, c->rows);
        r.configs[w] = curves__pairs(a_max, b_max, c->rows);
    }
    free(a), free(b);
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>words (private)
// ---------------------------------------------------------------------------------------------

// A number as one writes it: 0.001, 1e-5.
static const char *curves__g(double v, char text[32]) {
    snprintf(text, 32, "%.3g", v);
    char *e = strchr(text, 'e');
    if (v != v) snprintf(text, 32, "?");
    if (!e || v != v) return text;
    char *to = e + 1, *from = e + 1;
    if (*from == '-') to++;
    from += strspn(from, "+-0");
    memmove(to, from, strlen(from) + 1);
    return text;
}

static void curves__add(char *text, size_t size, const char *format, ...) {
    size_t n = strlen(text);
    va_list args;
    va_start(args, format);
    if (n + 1 < size) vsnprintf(text + n, size - n, format, args);
    va_end(args);
}

// The tolerance that a method's sweep changes.
static double curves__swept(const curves_row *r) {
    return r->method == CURVES_ADAPTIVE   ? r->error_nodes
           : r->method == CURVES_SUBSPACE ? r->error_modes
                                          : r->tol;
}

static const char *curves__sweeps(curves_method m) {
    return m == CURVES_ADAPTIVE ? "error_nodes" : m == CURVES_SUBSPACE ? "error_modes" : "tol";
}

void curves_name(const curves_row *r, char *text, size_t size) {
    char a[32], b[32];
    if (curves__finite(curves__swept(r)))
        snprintf(text, size, "%s, %s %s", curves_methods[r->method], curves__sweeps(r->method),
                 curves__g(curves__swept(r), a));
    else
        snprintf(text, size, "%s, all modes", curves_methods[r->method]);
    if (r->method == CURVES_ADAPTIVE && curves__finite(r->error_modes))
        curves__add(text, size, ", error_modes %s", curves__g(r->error_modes, b));
    if (r->method == CURVES_ADAPTIVE) curves__add(text, size, ", tol %s", curves__g(r->tol, b));
}

static const double curves__levels[4] = {0.1, 0.03, 0.01, 0.003};

static void curves__say_level(const curves *c, int scene, curves_measure m, double level,
                              char *text, size_t size) {
    curves_advice a = curves_recommend(c, scene, m, level);
    const curves_choice *own = &a.kind[CURVES_ADAPTIVE_KIND];
    char p[32], s[32], t[32];
    int best = -1;
    for (int k = 0; k < CURVES_KINDS; k++)
        if (a.kind[k].row >= 0 && (best < 0 || a.kind[k].seconds < a.kind[best].seconds)) best = k;
    curves__g(100 * level, p);
    if (own->row < 0)
        curves__add(text, size, " No adaptive run reaches %s %%.", p);
    else if (best != CURVES_ADAPTIVE_KIND)
        curves__add(text, size, " At %s %% %s is cheaper: %s s against %s s.", p,
                    curves_kinds[best], curves__g(a.kind[best].seconds, s),
                    curves__g(own->seconds, t));
}

static void curves__say_span(const char *before, const curves_span *s, char *text, size_t size) {
    char lo[32], hi[32];
    curves__add(text, size, "%s from %s %% to %s %% (%.1f decades)", before,
                curves__g(100 * s->lo, lo), curves__g(100 * s->hi, hi), s->decades);
}

void curves_verdict_text(const curves *c, int scene, curves_measure m, char *text, size_t size) {
    curves_verdict v = curves_dominates(c, scene, m);
    text[0] = 0;
    if (!v.rows[CURVES_ADAPTIVE_KIND]) {
        curves__add(text, size, "No adaptive run was measured.");
        return;
    }
    if (v.dominates)
        curves__say_span("Adaptive dominates: cheaper than subspace only and than full space",
                         &v.both, text, size);
    else if (v.both.decades > 0)
        curves__say_span(
            "Adaptive does not dominate over a decade of error: it is the cheapest "
            "only",
            &v.both, text, size);
    else
        curves__add(text, size, "Adaptive does not dominate: it is nowhere the cheapest");
    curves__add(text, size, ".");
    if (!v.dominates && v.subspace.decades > v.both.decades)
        curves__say_span(" Cheaper than subspace only", &v.subspace, text, size),
            curves__add(text, size, ".");
    if (!v.dominates && v.full.decades > v.both.decades)
        curves__say_span(" Cheaper than full space", &v.full, text, size),
            curves__add(text, size, ".");
    if (!v.rows[CURVES_SUBSPACE_KIND]) curves__add(text, size, " Subspace only was not measured.");
    if (!v.rows[CURVES_FULL_KIND]) curves__add(text, size, " Full space was not measured.");
    for (int k = 0; k < 4; k++) curves__say_level(c, scene, m, curves__levels[k], text, size);
}

// ---------------------------------------------------------------------------------------------
// >>draw (private)
// Colours belong to methods: the same on every plot.
// ---------------------------------------------------------------------------------------------

static const curves_method curves__order[CURVES_METHODS] = {CURVES_ADAPTIVE, CURVES_SUBSPACE,
                                                            CURVES_DIRECT, CURVES_PCG, CURVES_AUTO};
static const int curves__colour[CURVES_METHODS] = {2, 1, 3, 4, 7};  // by method
static const char *const curves__names[CURVES_METHODS] = {
    "subspace only, by error_modes", "adaptive, by error_nodes", "full space, direct, by tol",
    "full space, PCG, by tol", "full space, automatic, by tol"};

// Rows of a method from the loosest tolerance to the tightest; how many.
static int curves__sorted(const curves *c, int scene, curves_method m, int *row) {
    int n = 0;
    for (int k = 0; k < c->rows; k++) {
        if (c->row[k].scene != scene || c->row[k].method != m) continue;
        int at = n++;
        for (; at > 0 && curves__swept(&c->row[row[at - 1]]) < curves__swept(&c->row[k]); at--)
            row[at] = row[at - 1];
        row[at] = k;
    }
    return n;
}

// The same of one group: of the adaptive runs those with the same tol and error_modes, in the order of
// the file (group 0 is the first there); other methods have one group. 0: no such group.
static int curves__group(const curves *c, int scene, curves_method m, int group, int *row) {
    int all = curves__sorted(c, scene, m, row), n = 0, first = -1;
    if (m != CURVES_ADAPTIVE) return group == 0 ? all : 0;
    for (int k = 0, seen = -1; k < c->rows && seen < group; k++) {
        const curves_row *r = &c->row[k];
        int old = r->scene != scene || r->method != m;
        for (int j = 0; j < k && !old; j++)
            old = c->row[j].scene == scene && c->row[j].method == m && c->row[j].tol == r->tol &&
                  curves__same(c->row[j].error_modes, r->error_modes);
        if (!old && ++seen == group) first = k;
    }
    for (int i = 0; i < all && first >= 0; i++)
        if (c->row[row[i]].tol == c->row[first].tol &&
            curves__same(c->row[row[i]].error_modes, c->row[first].error_modes))
            row[n++] = row[i];
    return n;
}

// What the least error of reduced runs is to the floor of the plot: full space at tight tolerances
// lies decades below and would press the rest together.
static double curves__floor(const curves *c, int scene, curves_measure m) {
    double least = INFINITY;
    for (int k = 0; k < c->rows; k++) {
        const curves_row *r = &c->row[k];
        if (r->scene == scene && curves_kind_of(r->method) != CURVES_FULL_KIND &&
            curves_error_of(r, m) > 0)
            least = fmin(least, curves_error_of(r, m));
    }
    return curves__finite(least) ? 0.1 * least : 0;
}

enum { CURVES__GROUPS = 8 };  // of adaptive runs, at most drawn

// The points of one line; *low: some lie below the lower edge.
static void curves__points(const curves *c, curves_measure m, double least, const int *row, int count,
                           double *x, double *y, char (*text)[32], const char **label, int *low) {
    for (int i = 0; i < count; i++) {
        const curves_row *at = &c->row[row[i]];
        double error = curves_error_of(at, m);
        int under = error < least;
        if (under) error = least, *low = 1;
        x[i] = at->seconds, y[i] = 100 * error;
        // Of those on the lower edge only the first, or they hide each other.
        if (!under || i == 0 || y[i - 1] > y[i])
            label[i] = curves__finite(curves__swept(at)) ? curves__g(curves__swept(at), text[i]) : "all";
    }
}

static void curves__group_name(const curves *c, const int *row, int group, char *text, size_t size) {
    char tol[32], modes[32];
    const curves_row *at = &c->row[row[0]];
    if (group == 0)
        snprintf(text, size, "%s", curves__names[at->method]);
    else
        snprintf(text, size, "adaptive, tol %s m/s, error_modes %s", curves__g(at->tol, tol),
                 curves__g(at->error_modes, modes));
}

void curves_draw_errors(report *r, const curves *c, int scene, curves_measure m,
                        const char *title) {
    size_t n = (size_t)c->rows + 1;
    double *x = (double *)calloc(2 * n, sizeof *x), *y = x ? x + n : NULL;
    int *row = (int *)calloc(n, sizeof *row), series = 0, used = 0, low = 0;
    char(*text)[32] = (char(*)[32])calloc(n, sizeof *text), name[CURVES_METHODS + CURVES__GROUPS][80];
    const char **label = (const char **)calloc(n, sizeof *label);
    double least = curves__floor(c, scene, m);
    report_series s[CURVES_METHODS + CURVES__GROUPS];
    memset(s, 0, sizeof s);
    for (int k = 0; x && row && text && label && k < CURVES_METHODS; k++)
        for (int g = 0; g < CURVES__GROUPS; g++) {
            curves_method method = curves__order[k];
            int count = curves__group(c, scene, method, g, row);
            if (!count) break;
            curves__points(c, m, least, row, count, x + used, y + used, text + used, label + used, &low);
            curves__group_name(c, row, g, name[series], sizeof name[series]);
            s[series].name = name[series], s[series].x = x + used, s[series].y = y + used;
            s[series].count = count, s[series].label = label + used;
            s[series].style = method >= CURVES_DIRECT ? REPORT_DASHED : g ? REPORT_DOTTED : REPORT_SOLID;
            s[series].colour = curves__colour[method];
            used += count, series++;
        }
    report_plot p = report_plot_default(title, "run time, s", "error, %");
    p.log_x = p.log_y = p.markers = 1, p.height = 400;
    if (low) p.note = "Errors below the lower edge are drawn on it.";
    report_add_plot(r, &p, s, series);
    free(x), free(row), free(text), free((void *)label);
}

static report_level curves__faster(double ratio) {
    return ratio != ratio ? REPORT_INFO : ratio >= 1 ? REPORT_GOOD : REPORT_WARN;
}

static void curves__times(double ratio, char *text, size_t size) {
    if (ratio == ratio)
        snprintf(text, size, ratio < 10 ? "%.2f \xc3\x97" : "%.0f \xc3\x97", ratio);
    else
        snprintf(text, size, "\xe2\x80\x93");
}

enum { CURVES__CELLS = 7 };

// A row of the table: the cheapest of one kind at one error.
static void curves__advice_row(const curves *c, const curves_advice *a, int kind, int best,
                               report_cell *cell, char (*text)[120]) {
    const curves_choice *h = &a->kind[kind];
    char g[32];
    memset(cell, 0, CURVES__CELLS * sizeof *cell);
    for (int j = 0; j < CURVES__CELLS; j++) text[j][0] = 0, cell[j].text = text[j];
    snprintf(text[0], 120, "%s %%", curves__g(100 * a->error, g));
    snprintf(text[1], 120, "%s", curves_kinds[kind]);
    if (h->row < 0) {
        snprintf(text[2], 120, "none reaches it");
        cell[2].level = REPORT_WARN;
        return;
    }
    curves_name(&c->row[h->row], text[2], 120);
    snprintf(text[3], 120, "%s %%", curves__g(100 * h->error, g));
    snprintf(text[4], 120, "%s", curves__g(h->seconds, g));
    curves__times(h->over_direct, text[5], 120), curves__times(h->over_full, text[6], 120);
    cell[4].level = kind == best ? REPORT_GOOD : REPORT_INFO;
    cell[5].level = curves__faster(h->over_direct), cell[6].level = curves__faster(h->over_full);
}

static void curves__compared(report *r, const curves *c, const curves_advice *a) {
    char text[500] = "", name[120], g[32];
    if (a->direct < 0 && a->full < 0) return;
    curves__add(
        text, sizeof text,
        "Compared at the scene's own tolerance, that of its adaptive and subspace runs (tol "
        "%s):",
        curves__g(a->own_tol, g));
    for (int k = 0; k < 2; k++) {
        int row = k ? a->full : a->direct;
        if (row < 0) continue;
        curves_name(&c->row[row], name, sizeof name);
        curves__add(text, sizeof text, "%s %s (%s s)", k ? "; best full space:" : " direct:", name,
                    curves__g(c->row[row].seconds, g));
    }
    curves__add(text, sizeof text,
                ". A ratio is their time over the configuration's: above 1 the "
                "configuration is faster. Green: the cheapest at that error.");
    report_text(r, text);
}

static void curves__for_one_percent(report *r, const curves *c, const curves_advice *a) {
    const curves_choice *h = &a->kind[CURVES_ADAPTIVE_KIND];
    char text[300] = "", g[32], s[32];
    if (h->row < 0) {
        report_note(r, "For 1 % error: no adaptive configuration of this sweep reaches it.",
                    REPORT_WARN);
        return;
    }
    curves__add(text, sizeof text, "For 1 %% error take error_nodes = %s",
                curves__g(c->row[h->row].error_nodes, g));
    if (curves__finite(c->row[h->row].error_modes))
        curves__add(text, sizeof text, ", error_modes = %s",
                    curves__g(c->row[h->row].error_modes, g));
    curves__add(text, sizeof text, ": %s s, largest error of a step %s %%",
                curves__g(h->seconds, s), curves__g(100 * h->error, g));
    if (h->over_direct == h->over_direct)
        curves__add(text, sizeof text, "; the direct solver takes %.2f times as long",
                    h->over_direct);
    if (h->over_full == h->over_full)
        curves__add(text, sizeof text, ", the best full-space solver %.2f times", h->over_full);
    curves__add(text, sizeof text, ".");
    report_note(r, text, h->over_full >= 1 ? REPORT_GOOD : REPORT_WARN);
}

void curves_draw_advice(report *r, const curves *c, int scene) {
    static const char *const heads[CURVES__CELLS] = {"error at most",   "kind",    "take",
                                                     "its error",       "seconds", "direct / this",
                                                     "best full / this"};
    report_cell cell[12 * CURVES__CELLS];
    char text[12 * CURVES__CELLS][120];
    curves_advice a;
    memset(&a, 0, sizeof a);
    for (int i = 0; i < 4; i++) {
        a = curves_recommend(c, scene, CURVES_MAX, curves__levels[i]);
        int best = -1;
        for (int k = 0; k < CURVES_KINDS; k++)
            if (a.kind[k].row >= 0 && (best < 0 || a.kind[k].seconds < a.kind[best].seconds))
                best = k;
        for (int k = 0; k < CURVES_KINDS; k++)
            curves__advice_row(c, &a, k, best, cell + (3 * i + k) * CURVES__CELLS,
                               text + (3 * i + k) * CURVES__CELLS);
    }
    a = curves_recommend(c, scene, CURVES_MAX, 0.01);
    curves__for_one_percent(r, c, &a);
    report_grid(r, "The cheapest configuration for an error (largest over the steps)", heads, cell,
                CURVES__CELLS, 12);
    curves__compared(r, c, &a);
}

static int curves__there(const char *path) {
    FILE *f = fopen(path, "rb");
    if (f) fclose(f);
    return f != NULL;
}

void curves_draw_pictures(report *r, const curves *c, int scene, const char *folder) {
    static const char *const end[3] = {"subspace", "adaptive", "enriched"};
    static const char *const words[3] = {"Subspace only: error on the bodies",
                                         "Adaptive: error on the bodies",
                                         "Adaptive: enriched nodes"};
    char path[3][600];
    const char *paths[3], *labels[3];
    int n = 0;
    for (int k = 0; folder && k < 3; k++) {
        snprintf(path[n], sizeof path[n], "%.400s/%.150s_%s.png", folder, c->scene[scene], end[k]);
        if (curves__there(path[n])) paths[n] = path[n], labels[n++] = words[k];
    }
    report_pictures(r, paths, labels, n);
}

// The sum of each phase over the steps of a row; how many steps.
static int curves__phases(const curves *c, int row, double sum[CURVES_PHASES]) {
    int n = 0;
    for (int j = 0; j < CURVES_PHASES; j++) sum[j] = 0;
    for (int i = 0; i < c->steps; i++) {
        if (c->step[i].row != row) continue;
        for (int j = 0; j < CURVES_PHASES; j++)
            if (c->step[i].phase[j] > 0) sum[j] += c->step[i].phase[j];
        n++;
    }
    return n;
}

enum { CURVES__BARS = 14 };

// The bars: the adaptive rows of the first group, the ends of subspace only, full space at the scene's own tolerance.
static int curves__bars(const curves *c, int scene, int *row) {
    curves_advice a = curves_recommend(c, scene, CURVES_MAX, 0.01);
    int n = 0, count = curves__group(c, scene, CURVES_ADAPTIVE, 0, row);
    int *sub = (int *)calloc((size_t)c->rows + 1, sizeof *sub);
    n = count < CURVES__BARS - 5 ? count : CURVES__BARS - 5;
    count = sub ? curves__sorted(c, scene, CURVES_SUBSPACE, sub) : 0;
    if (count > 0) row[n++] = sub[0];
    if (count > 1) row[n++] = sub[count - 1];
    free(sub);
    for (int k = CURVES_DIRECT; k <= CURVES_AUTO; k++) {
        int full = curves__at_tol(c, scene, (curves_method)k, a.own_tol);
        if (full >= 0) row[n++] = full;
    }
    return n;
}

static void curves__draw_phases(report *r, const curves *c, int scene) {
    static const char *const phase[CURVES_PHASES] = {"energy",   "gradient", "hessian",   "oracle",
                                                     "assembly", "linear",   "collision", "other"};
    int *row = (int *)calloc((size_t)c->rows + CURVES__BARS, sizeof *row), n = 0;
    double value[CURVES_PHASES][CURVES__BARS], sum[CURVES_PHASES];
    char text[CURVES__BARS][60], g[32];
    const char *names[CURVES__BARS];
    report_series s[CURVES_PHASES];
    memset(s, 0, sizeof s);
    int count = row ? curves__bars(c, scene, row) : 0;
    for (int i = 0; i < count; i++) {
        const curves_row *at = &c->row[row[i]];
        if (!curves__phases(c, row[i], sum)) continue;
        for (int j = 0; j < CURVES_PHASES; j++) value[j][n] = sum[j];
        if (curves__finite(curves__swept(at)))
            snprintf(text[n], sizeof text[n], "%s, %s %s", curves_methods[at->method],
                     curves__sweeps(at->method), curves__g(curves__swept(at), g));
        else
            snprintf(text[n], sizeof text[n], "%s, all modes", curves_methods[at->method]);
        names[n] = text[n], n++;
    }
    free(row);
    if (!n) return;
    for (int j = 0; j < CURVES_PHASES; j++) s[j].name = phase[j], s[j].y = value[j], s[j].count = n;
    report_plot p = report_plot_default("Cost by phase", "seconds, all steps", NULL);
    report_add_bars(r, &p, names, s, CURVES_PHASES);
}

static double curves__of_step(const curves_step *s, int what) {
    return what == 0 ? 100 * s->error : what == 1 ? 100 * s->enriched_share : 100 * s->modes_share;
}

// One line a configuration of the two reduced methods, over the steps. what: see curves__of_step.
static void curves__draw_over_steps(report *r, const curves *c, int scene, int what,
                                    const char *title, const char *unit) {
    enum { MOST = 9 };
    size_t n = (size_t)c->steps + 1, rows = (size_t)c->rows + 1;
    double *x = (double *)calloc(2 * n, sizeof *x), *y = x ? x + n : NULL;
    int *row = (int *)calloc(rows, sizeof *row), used = 0, series = 0, some = 0;
    char text[MOST][60], g[32];
    report_series s[MOST];
    memset(s, 0, sizeof s);
    for (int k = 0; x && row && k < 2; k++) {
        int count = curves__group(c, scene, k ? CURVES_SUBSPACE : CURVES_ADAPTIVE, 0, row);
        for (int i = 0; i < count && series < (k ? MOST : MOST - 2); i++) {
            // Of subspace only the loosest and the tightest.
            if (k && i > 0 && i < count - 1) continue;
            int first = used;
            for (int j = 0; j < c->steps; j++)
                if (c->step[j].row == row[i]) {
                    x[used] = c->step[j].step, y[used] = curves__of_step(&c->step[j], what);
                    some |= y[used] > 0 || (what == 1 && !k && y[used] >= 0);
                    used++;
                }
            if (used == first || (what == 1 && k)) continue;
            double swept = curves__swept(&c->row[row[i]]);
            snprintf(text[series], sizeof text[series], "%s %s", k ? "subspace only" : "adaptive",
                     curves__finite(swept) ? curves__g(swept, g) : "all modes");
            s[series].name = text[series], s[series].x = x + first, s[series].y = y + first;
            s[series].count = used - first;
            if (k) s[series].style = i ? REPORT_DOTTED : REPORT_DASHED;
            s[series].colour = k ? 2 : series ? series + 2 : 1;
            series++;
        }
    }
    report_plot p = report_plot_default(title, "step", unit);
    p.log_y = what == 0;
    if (some) report_add_plot(r, &p, s, series);
    free(x), free(row);
}

// Residual against true error, a dot a step.
static void curves__draw_scatter(report *r, const curves *c, int scene) {
    size_t n = (size_t)c->steps + 1;
    double *x = (double *)calloc(2 * n, sizeof *x), *y = x ? x + n : NULL;
    int used = 0;
    report_series s[2];
    memset(s, 0, sizeof s);
    for (int k = 0; x && k < 2; k++) {
        int first = used;
        curves_method m = k ? CURVES_SUBSPACE : CURVES_ADAPTIVE;
        for (int j = 0; j < c->steps; j++)
            if (c->step[j].row >= 0 && c->step[j].scene == scene && c->step[j].method == m)
                x[used] = c->step[j].residual_max, y[used++] = 100 * c->step[j].error;
        s[k].name = k ? "subspace only" : "adaptive", s[k].style = REPORT_POINTS;
        s[k].x = x + first, s[k].y = y + first, s[k].count = used - first;
        s[k].colour = curves__colour[m];
    }
    report_plot p = report_plot_default("The step's own residual_max against its true error",
                                        "residual_max, m/s", "error, %");
    p.log_x = p.log_y = p.markers = 1;
    if (used) report_add_plot(r, &p, s, 2);
    free(x);
}

static report_level curves__trust(double rho) {
    return rho != rho   ? REPORT_INFO
           : rho >= 0.8 ? REPORT_GOOD
           : rho >= 0.5 ? REPORT_WARN
                        : REPORT_BAD;
}

static void curves__rho(double rho, int pairs, report_cell *cell, char *text, size_t size) {
    if (rho == rho)
        snprintf(text, size, "%.2f (of %d)", rho, pairs);
    else
        snprintf(text, size, "\xe2\x80\x93");
    cell->text = text, cell->level = curves__trust(rho);
}

static void curves__draw_ranks(report *r, const curves *c, int scene) {
    static const char *const heads[5] = {"estimate", "steps", "configurations",
                                         "steps, with full space",
                                         "configurations, with full space"};
    static const char *const names[3] = {"residual_max", "residual_mean", "oracle_error"};
    curves_rank a = curves_rank_of(c, scene, 0), b = curves_rank_of(c, scene, 1);
    report_cell cell[15];
    char text[15][40];
    memset(cell, 0, sizeof cell);
    for (int w = 0; w < 3; w++) {
        report_cell *row = cell + 5 * w;
        row->text = names[w];
        curves__rho(a.step[w], a.steps[w], row + 1, text[5 * w], 40);
        curves__rho(a.config[w], a.configs[w], row + 2, text[5 * w + 1], 40);
        curves__rho(b.step[w], b.steps[w], row + 3, text[5 * w + 2], 40);
        curves__rho(b.config[w], b.configs[w], row + 4, text[5 * w + 3], 40);
    }
    if (a.steps[0])
        report_grid(r, "Does the step's own estimate rank with the true error? (Spearman)", heads,
                    cell, 5, 3);
}

void curves_draw_steps(report *r, const curves *c, int scene) {
    report_columns_begin(r);
    curves__draw_over_steps(r, c, scene, 0, "Error of each step", "error, %");
    curves__draw_over_steps(r, c, scene, 1, "Enriched nodes", "% of the nodes");
    curves__draw_over_steps(r, c, scene, 2, "Active modes", "% of the modes");
    curves__draw_scatter(r, c, scene);
    report_columns_end(r);
    curves__draw_phases(r, c, scene);
    curves__draw_ranks(r, c, scene);
}

void curves_draw_comment(report *r, const curves *c) {
    if (c->comment && *c->comment) report_code(r, c->comment);
}

static double curves__median(double *v, int n) {
    qsort(v, (size_t)n, sizeof *v, curves__up);
    return n ? 0.5 * (v[(n - 1) / 2] + v[n / 2]) : NAN;
}

void curves_draw_tiles(report *r, const curves *c) {
    double *v = (double *)calloc(3 * (size_t)c->scenes + 1, sizeof *v);
    int n[3] = {0, 0, 0}, wins = 0;
    char text[100];
    for (int s = 0; v && s < c->scenes; s++) {
        curves_advice a = curves_recommend(c, s, CURVES_MAX, 0.01);
        const curves_choice *h = &a.kind[CURVES_ADAPTIVE_KIND];
        double rho = curves_rank_of(c, s, 0).step[0];
        if (h->over_direct == h->over_direct) v[n[0]++] = h->over_direct;
        if (h->over_full == h->over_full) v[c->scenes + n[1]++] = h->over_full;
        if (rho == rho) v[2 * c->scenes + n[2]++] = rho;
        wins += curves_dominates(c, s, CURVES_MAX).dominates;
    }
    snprintf(text, sizeof text, "%d of %d scenes", wins, c->scenes);
    report_status(r, "Adaptive dominates over a decade of error", text,
                  wins == c->scenes ? REPORT_GOOD
                  : wins            ? REPORT_WARN
                                    : REPORT_BAD);
    for (int k = 0; v && k < 2; k++) {
        double m = curves__median(v + k * c->scenes, n[k]);
        if (!n[k]) continue;
        snprintf(text, sizeof text, "%.2f \xc3\x97 (%d scene%s)", m, n[k], n[k] > 1 ? "s" : "");
        report_status(r,
                      k ? "Faster than the best full space at 1 %, median"
                        : "Faster than direct at 1 %, median",
                      text, curves__faster(m));
    }
    if (v && n[2]) {
        double m = curves__median(v + 2 * c->scenes, n[2]);
        snprintf(text, sizeof text, "%.2f", m);
        report_status(r, "Rank of residual_max with the true error, median", text,
                      curves__trust(m));
    }
    free(v);
}

enum { CURVES__SUMMARY = 10 };

static void curves__summary_row(const curves *c, int scene, report_cell *cell, char (*text)[80]) {
    curves_verdict v = curves_dominates(c, scene, CURVES_MAX);
    curves_advice a = curves_recommend(c, scene, CURVES_MAX, 0.01);
    curves_rank rank = curves_rank_of(c, scene, 0);
    const curves_choice *h = &a.kind[CURVES_ADAPTIVE_KIND], *s = &a.kind[CURVES_SUBSPACE_KIND],
                        *f = &a.kind[CURVES_FULL_KIND];
    char g[32], b[32];
    for (int j = 0; j < CURVES__SUMMARY; j++)
        snprintf(text[j], 80, "\xe2\x80\x93"), cell[j].text = text[j], cell[j].level = REPORT_INFO;
    snprintf(text[0], 80, "%.79s", c->scene[scene]);
    snprintf(text[1], 80, "%.1f", v.both.decades);
    cell[1].level = v.dominates ? REPORT_GOOD : v.both.decades > 0 ? REPORT_WARN : REPORT_BAD;
    if (v.both.decades > 0)
        snprintf(text[2], 80, "%s to %s", curves__g(100 * v.both.lo, g),
                 curves__g(100 * v.both.hi, b));
    if (h->row >= 0) {
        snprintf(text[3], 80, "%s", curves__g(c->row[h->row].error_nodes, g));
        snprintf(text[4], 80, "%s", curves__g(h->seconds, g));
    } else
        cell[3].level = REPORT_WARN;
    curves__times(h->over_direct, text[5], 80), cell[5].level = curves__faster(h->over_direct);
    curves__times(h->over_full, text[6], 80), cell[6].level = curves__faster(h->over_full);
    if (s->row >= 0) snprintf(text[7], 80, "%s", curves__g(s->seconds, g));
    if (f->row >= 0) snprintf(text[8], 80, "%s", curves__g(f->seconds, g));
    if (rank.step[0] == rank.step[0]) snprintf(text[9], 80, "%.2f", rank.step[0]);
    cell[9].level = curves__trust(rank.step[0]);
}

void curves_draw_summary(report *r, const curves *c) {
    static const char *const heads[CURVES__SUMMARY] = {"scene",          "cheapest over, decades",
                                                       "from, to, %",    "for 1 %: error_nodes",
                                                       "seconds",        "direct / it",
                                                       "best full / it", "subspace only, s",
                                                       "full space, s",  "rank of residual_max"};
    size_t n = (size_t)c->scenes * CURVES__SUMMARY;
    report_cell *cell = (report_cell *)calloc(n + 1, sizeof *cell);
    char(*text)[80] = (char(*)[80])calloc(n + 1, sizeof *text);
    for (int s = 0; cell && text && s < c->scenes; s++)
        curves__summary_row(c, s, cell + s * CURVES__SUMMARY, text + s * CURVES__SUMMARY);
    if (cell && text)
        report_grid(r, "All scenes, by the largest error of a step", heads, cell, CURVES__SUMMARY,
                    c->scenes);
    free(cell), free(text);
}

void curves_draw_key(report *r) {
    report_text(
        r,
        "Cheapest over: the longest stretch of errors in which an adaptive run that keeps the "
        "error costs less than every subspace-only run and every full-space run (at any "
        "tolerance) that keeps it. Seconds of subspace only and full space: their cheapest "
        "runs with an error of at most 1 %. The ratios are against full space at the scene's "
        "own tolerance; above 1 adaptive is faster.");
}

void curves_draw_verdict(report *r, const curves *c, int scene, curves_measure m,
                         const char *lead) {
    char text[1200], all[1300];
    curves_verdict v = curves_dominates(c, scene, m);
    curves_verdict_text(c, scene, m, text, sizeof text);
    snprintf(all, sizeof all, "%s: %s", lead, text);
    report_note(r, all, v.dominates ? REPORT_GOOD : v.both.decades > 0 ? REPORT_WARN : REPORT_BAD);
}

void curves_draw_scene(report *r, const curves *c, int scene, const char *pictures) {
    curves_draw_verdict(r, c, scene, CURVES_MAX, "Largest error of a step");
    report_columns_begin(r);
    curves_draw_errors(r, c, scene, CURVES_MAX, "Largest error of a step");
    curves_draw_errors(r, c, scene, CURVES_FINAL, "Distance at the end of the free trajectory");
    report_columns_end(r);
    curves_draw_verdict(r, c, scene, CURVES_FINAL, "Distance at the end, of the diagonal");
    curves_draw_pictures(r, c, scene, pictures);
    curves_draw_advice(r, c, scene);
    curves_draw_steps(r, c, scene);
}

void curves_draw(report *r, const curves *c, const char *pictures) {
    curves_draw_tiles(r, c);
    curves_draw_summary(r, c);
    curves_draw_key(r);
    if (c->scenes > 1) report_contents(r, c->scene, c->scenes);
    for (int s = 0; s < c->scenes; s++) {
        report_heading(r, c->scene[s]);
        curves_draw_scene(r, c, s, pictures);
    }
    report_heading(r, "How it was measured");
    curves_draw_comment(r, c);
}

#ifdef __cplusplus
}
#endif
#endif  // CURVES_IMPLEMENTATION
