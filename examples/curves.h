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
   if (a.kind[CURVES_ADAPTIVE_KIND].row >= 0) printf("%g s\n", a.kind[CURVES_ADAPTIVE_KIND].seconds);
   curves_verdict v = curves_dominates(&c, 0, CURVES_MAX);
   report *r = report_begin("Error against run time", NULL);
   curves_draw(r, &c, "out");         // tiles, summary, each scene; pictures out/SCENE_*.png
   report_end(r, "out", NULL);
   curves_free(&c);

   THE FILES  error_vs_time.csv has a row a configuration (a method and its tolerances), and
   error_steps.csv a row a configuration and step; the columns are curves_rows_header and
   curves_steps_header, exactly. Lines that start with # come first: machine, command, sizes. A field
   may be quoted; empty: not defined for the method (NAN here). "nan" and "inf" are numbers.

   ERROR  A fraction. error_max and error_mean: of the steps' errors, each the largest distance of a
   node from the tight full-space solution of the same step over that step's largest displacement.
   error_final: the distance at the end of the free trajectory over the scene's diagonal.
   SECONDS  Sum over the steps, best of the repeats. residual: m/s.

   WHAT A CONFIGURATION IS COMPARED WITH  The scene's own tolerance is that of its adaptive and
   subspace runs, which change error_nodes and error_modes only. `direct` is the row of the direct
   solver at it, `full` the cheapest of the full-space solvers at it: what a user has without a
   subspace. The verdict is stricter: at an error e, each kind's cheapest row of error <= e, with the
   full-space solvers free to take the loosest tolerance that gives it.

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

enum { CURVES_PHASES = 8 };  // energy, gradient, hessian, oracle, assemble, linear, collision, other

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
    const char *comment;             // error_vs_time.csv's
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
CURVES_API void curves_draw_scene(report *r, const curves *c, int scene, const char *pictures);
CURVES_API void curves_draw_errors(report *r, const curves *c, int scene, curves_measure m,
                                   const char *title);
CURVES_API void curves_draw_advice(report *r, const curves *c, int scene);
CURVES_API void curves_draw_pictures(report *r, const curves *c, int scene, const char *folder);
CURVES_API void curves_draw_steps(report *r, const curves *c, int scene);

#ifdef __cplusplus
}
#endif
#endif  // CURVES_H
