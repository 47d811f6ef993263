// The pages of `make report` and what they conclude: CSVs read or refused by name and line, the
// recommendation, the verdict and the rank correlation against values worked out by hand, and the
// pages' tags, escapes and links from a small synthetic sweep.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#define REPORT_NO_MAIN
#include "../bench/report.c"
#include "page.h"

#define OUT "test_report_out"

static void write_file(const char *name, const char *header, const char *lines) {
    char path[300];
    snprintf(path, sizeof path, OUT "/%.200s", name);
    FILE *f = fopen(path, "wb");
    assert_non_null(f);
    fprintf(f, "%s%s%s", header, *header ? "\n" : "", lines);
    fclose(f);
}

static int set_up(void **state) {
    (void)state;
    return system("rm -rf " OUT " && mkdir -p " OUT "/small " OUT "/pages");
}

static int tear_down(void **state) {
    (void)state;
    return system("rm -rf " OUT);
}

// Scene "good": by hand, adaptive is the cheapest from 0.1 % to 10 %. Scene "bad": from 2 % to 10
// %.
static const char *const rows =
    "good,subspace,,0.1,0.001,1,0.2,0.1,0.02,0.3,,0.5\n"
    "good,subspace,,0.01,0.001,4,0.05,0.02,0.01,0.1,,0.7\n"
    "good,subspace,,0.001,0.001,10,0.02,0.01,0.008,0.1,,1\n"
    "good,adaptive,0.1,0.01,0.001,2,0.1,0.05,0.01,0.1,0.01,0.5\n"
    "good,adaptive,0.01,0.001,0.001,3,0.01,0.005,0.001,0.01,0.05,0.6\n"
    "good,adaptive,0.001,0.0001,0.001,6,0.001,0.0005,0.0001,0.001,0.2,0.8\n"
    "good,direct,,,0.1,5,0.03,0.01,0.003,0.01,,\n"
    "good,direct,,,0.001,8,1e-5,1e-6,1e-6,1e-5,,\n"
    "good,pcg,,,0.001,7,1e-5,1e-6,1e-6,1e-5,,\n"
    "bad,subspace,,0.1,0.001,1,0.2,0.1,0.02,0.3,,0.5\n"
    "bad,adaptive,0.1,0.01,0.001,2,0.1,0.05,0.01,0.1,0.01,0.5\n"
    "bad,adaptive,0.01,0.001,0.001,3,0.02,0.005,0.001,0.01,0.05,0.6\n"
    "bad,adaptive,0.001,0.0001,0.001,6,0.001,0.0005,0.0001,0.001,0.2,0.8\n"
    "bad,adaptive,0.0001,0.0001,0.001,7,nan,nan,,,0.2,0.8\n"
    "bad,auto,,,0.001,5,1e-5,1e-6,1e-6,1e-5,,\n";

#define REST ",0.1,0.5,4,0,7,converged,.1,.1,.1,,.1,.2,.1,.1\n"
static const char *const steps =
    "good,adaptive,0.1,0.01,0.001,1,1,0.1,0.05,4,1,0.4" REST
    "good,adaptive,0.1,0.01,0.001,2,1,0.05,0.02,3,2,0.3" REST
    "good,adaptive,0.01,0.001,0.001,1,1.5,0.01,0.005,1,4,0.1" REST
    "good,adaptive,0.01,0.001,0.001,2,1.5,0.02,0.005,2,3,0.2" REST
    "good,subspace,,0.1,0.001,1,0.5,0.2,0.1,9,0.1," REST
    "good,subspace,,0.1,0.001,2,0.5,0.15,0.1,8,0.2," REST
    "good,direct,,,0.001,1,4,1e-5,1e-6,10,0.01," REST
    "good,direct,,,0.5,1,4,1e-5,1e-6,10,0.01," REST;  // not in the other file: left out

static void read_both(curves *c) {
    curves_error why;
    char header[600];
    snprintf(header, sizeof header, "# machine: <two> cores\n# command & sizes\n%s",
             curves_rows_header);
    write_file("error_vs_time.csv", header, rows);
    write_file("error_steps.csv", curves_steps_header, steps);
    if (!curves_read(c, OUT "/error_vs_time.csv", OUT "/error_steps.csv", &why))
        fail_msg("%s", why.message);
}

static void close_to(double a, double b) {
    if (!(fabs(a - b) <= 1e-9 * (1 + fabs(b)))) fail_msg("%.12g is not %.12g", a, b);
}

static void test_read(void **state) {
    (void)state;
    curves c;
    read_both(&c);
    assert_int_equal(c.scenes, 2);
    assert_int_equal(c.rows, 15);
    assert_int_equal(c.steps, 8);
    assert_string_equal(c.scene[1], "bad");
    assert_string_equal(c.comment, "machine: <two> cores\ncommand & sizes\n");
    assert_true(c.row[0].error_nodes != c.row[0].error_nodes);  // empty
    assert_int_equal(c.row[0].line, 4);
    close_to(c.row[4].error_final, 0.001);
    assert_int_equal(c.step[2].row, 4);
    assert_int_equal(c.step[7].row, -1);
    close_to(c.step[0].phase[5], 0.2);
    assert_string_equal(c.step[0].status, "converged");
    char name[80];
    curves_name(&c.row[4], name, sizeof name);
    assert_string_equal(name, "adaptive, error_nodes 0.01, error_modes 0.001, tol 0.001");
    curves_name(&c.row[7], name, sizeof name);
    assert_string_equal(name, "direct, tol 0.001");
    curves_free(&c);
}

// Each is refused with the file, the line and the column.
static void refused(const char *header, const char *lines, const char *words) {
    curves c;
    curves_error why;
    write_file("broken.csv", header, lines);
    assert_false(curves_read(&c, OUT "/broken.csv", NULL, &why));
    if (!strstr(why.message, words) || !strstr(why.message, OUT "/broken.csv: "))
        fail_msg("\"%s\" does not say \"%s\"", why.message, words);
    assert_int_equal(c.rows, 0);
    assert_false(curves_read(&c, OUT "/broken.csv", NULL, NULL));
}

static void test_refused(void **state) {
    (void)state;
    const char *h = curves_rows_header;
    refused(h, "a,direct,,,0.1,5,x1,0,0,0,,\n", "line 2, column 7 (error_max): expected a number");
    refused(h, "a,direct,,,0.1,5,0.1,0,0,0,,\n\na,direct,,,0.2,,0.1,0,0,0,,\n",
            "line 4, column 6 (seconds): expected a number");
    refused(h, "a,direct,,,0.1,-5,0.1,0,0,0,,\n", "line 2, column 6 (seconds)");
    refused(h, "a,newton,,,0.1,5,0.1,0,0,0,,\n", "line 2, column 2 (method): expected subspace");
    refused(h, ",direct,,,0.1,5,0.1,0,0,0,,\n", "line 2, column 1 (scene)");
    refused(h, "a,direct,,,0.1\n", "line 2, column 6 (seconds): the line ends after 5 of 12");
    refused(h, "a,direct,,,0.1,5,0.1,0,0,0,,,\n", "line 2: more columns");
    refused(h, "a,direct,,,0.1,5,0.1,0,0,0,\"1,\n", "a quote without its end");
    refused(h, "a,direct,,,0.1,5,0.1,0,0,0,,\na,direct,,,0.1,6,0.1,0,0,0,,\n",
            "line 3: the same configuration as line 2");
    refused("# note\nscene,method,nodes", "",
            "line 2, column 3 (error_nodes): the header has \"nodes\"");
    refused("# only a comment", "", "no header line");
    refused("", "", "no header line");
    curves c;
    curves_error why;
    assert_false(curves_read(&c, OUT "/none.csv", NULL, &why));
    assert_non_null(strstr(why.message, OUT "/none.csv: "));
    write_file("good.csv", h, rows);
    write_file("broken.csv", curves_steps_header, "good,direct,,,0.1,1,1,oops\n");
    assert_false(curves_read(&c, OUT "/good.csv", OUT "/broken.csv", &why));
    assert_non_null(
        strstr(why.message, "broken.csv: line 2, column 9 (error_mean): the line ends"));
}

static void test_table(void **state) {
    (void)state;
    curves_table t;
    curves_error why;
    double v;
    write_file("t.csv", "a,b,note", " x y , 1e-3 ,one, two\r\n\"q\"\"u,o\",,\"n,m\"\n");
    if (!curves_table_read(&t, OUT "/t.csv", "a,b,note", &why)) fail_msg("%s", why.message);
    assert_int_equal(t.rows, 2);
    assert_string_equal(curves_cell(&t, 0, 0), "x y");
    assert_string_equal(curves_cell(&t, 0, 2), "one, two");
    assert_string_equal(curves_cell(&t, 1, 0), "q\"u,o");
    assert_string_equal(curves_cell(&t, 1, 2), "n,m");
    assert_true(curves_number(&t, 0, 1, 0, &v, &why));
    close_to(v, 1e-3);
    assert_true(curves_number(&t, 1, 1, 1, &v, &why) && v != v);
    assert_false(curves_number(&t, 1, 1, 0, &v, &why));
    assert_non_null(strstr(why.message, "t.csv: line 3, column 2 (b): expected a number"));
    curves_table_free(&t);
}

static void test_recommend(void **state) {
    (void)state;
    curves c;
    read_both(&c);
    curves_advice a = curves_recommend(&c, 0, CURVES_MAX, 0.1);
    close_to(a.own_tol, 0.001);
    assert_int_equal(a.direct, 7);
    assert_int_equal(a.full, 8);  // PCG: 7 s
    assert_int_equal(a.kind[CURVES_SUBSPACE_KIND].row, 1);
    assert_int_equal(a.kind[CURVES_ADAPTIVE_KIND].row, 3);
    assert_int_equal(a.kind[CURVES_FULL_KIND].row, 6);  // the loose one keeps 10 %
    close_to(a.kind[CURVES_ADAPTIVE_KIND].over_direct, 4);
    close_to(a.kind[CURVES_ADAPTIVE_KIND].over_full, 3.5);
    close_to(a.kind[CURVES_SUBSPACE_KIND].over_direct, 2);
    a = curves_recommend(&c, 0, CURVES_MAX, 0.01);
    assert_int_equal(a.kind[CURVES_SUBSPACE_KIND].row, -1);
    assert_int_equal(a.kind[CURVES_ADAPTIVE_KIND].row, 4);
    assert_int_equal(a.kind[CURVES_FULL_KIND].row, 8);
    close_to(a.kind[CURVES_ADAPTIVE_KIND].error, 0.01);
    close_to(a.kind[CURVES_ADAPTIVE_KIND].over_direct, 8.0 / 3);
    a = curves_recommend(&c, 0, CURVES_FINAL, 0.01);
    assert_int_equal(a.kind[CURVES_ADAPTIVE_KIND].row, 3);
    a = curves_recommend(&c, 0, CURVES_MEAN, 0.0005);
    assert_int_equal(a.kind[CURVES_ADAPTIVE_KIND].row, 5);
    a = curves_recommend(&c, 1, CURVES_MAX, 0.01);  // a run that failed (nan) reaches nothing
    assert_int_equal(a.kind[CURVES_ADAPTIVE_KIND].row, 12);
    assert_int_equal(a.direct, -1);
    assert_true(a.kind[CURVES_ADAPTIVE_KIND].over_direct !=
                a.kind[CURVES_ADAPTIVE_KIND].over_direct);
    curves_free(&c);
}

static void test_dominates(void **state) {
    (void)state;
    curves c;
    char text[1000];
    read_both(&c);
    curves_verdict v = curves_dominates(&c, 0, CURVES_MAX);
    assert_true(v.dominates);
    close_to(v.both.lo, 0.001), close_to(v.both.hi, 0.1), close_to(v.both.decades, 2);
    assert_int_equal(v.rows[CURVES_FULL_KIND], 3);
    curves_verdict_text(&c, 0, CURVES_MAX, text, sizeof text);
    assert_string_equal(text,
                        "Adaptive dominates: cheaper than subspace only and than full space from "
                        "0.1 % to 10 % (2.0 decades).");
    v = curves_dominates(&c, 1, CURVES_MAX);
    assert_false(v.dominates);
    assert_int_equal(v.rows[CURVES_ADAPTIVE_KIND], 3);
    close_to(v.adaptive.decades, 2);
    close_to(v.subspace.decades, 2);  // subspace only never gets to 10 %
    close_to(v.full.lo, 0.02), close_to(v.full.hi, 0.1);
    close_to(v.both.decades, 0.69897000433602);  // log10(5)
    curves_verdict_text(&c, 1, CURVES_MAX, text, sizeof text);
    assert_non_null(strstr(text,
                           "does not dominate over a decade of error: it is the cheapest only from "
                           "2 % to 10 % (0.7 decades)."));
    assert_non_null(strstr(text, "At 1 % full space is cheaper: 5 s against 6 s."));
    assert_null(strstr(text, "At 3 %"));
    curves_free(&c);
    // Without the other kinds nothing is dominated.
    curves_error why;
    write_file("alone.csv", curves_rows_header,
               "s,adaptive,1,1,1,2,0.1,0,0,0,,\ns,adaptive,2,1,1,3,0.001,0,0,0,,\n");
    assert_true(curves_read(&c, OUT "/alone.csv", NULL, &why));
    assert_false(curves_dominates(&c, 0, CURVES_MAX).dominates);
    curves_verdict_text(&c, 0, CURVES_MAX, text, sizeof text);
    assert_non_null(strstr(text, "Full space was not measured."));
    curves_free(&c);
}

static void test_spearman(void **state) {
    (void)state;
    // Ranks of b: 1, 2, 3.5, 5, 3.5; 8 / sqrt(10 * 9.5).
    double a[6] = {1, 2, 3, 4, 5, 6}, b[6] = {5, 6, 7, 8, 7, NAN}, down[5] = {9, 3, 2, 1, -4},
           flat[5] = {2, 2, 2, 2, 2};
    close_to(curves_spearman(a, b, 6), 8 / sqrt(95));
    close_to(curves_spearman(b, a, 6), 8 / sqrt(95));
    close_to(curves_spearman(a, down, 5), -1);
    double all = curves_spearman(a, flat, 5), few = curves_spearman(a, b, 2);
    assert_true(all != all && few != few);
    double p[4] = {1, 1, 2, 2}, q[4] = {1, 2, 2, 1};  // independent
    close_to(curves_spearman(p, q, 4), 0);
}

static void test_ranks(void **state) {
    (void)state;
    curves c;
    read_both(&c);
    curves_rank r = curves_rank_of(&c, 0, 0);
    close_to(r.step[0], 1), close_to(r.step[1], -1), close_to(r.step[2], 1);
    assert_int_equal(r.steps[0], 6);
    assert_int_equal(r.steps[2], 4);
    close_to(r.config[0], 1);
    assert_int_equal(r.configs[0], 3);
    assert_true(r.config[2] != r.config[2]);  // two configurations have no rank correlation
    // The full-space step has the least error and the largest residual: 1 - 6 * 42 / (7 * 48).
    close_to(curves_rank_of(&c, 0, 1).step[0], 0.25);
    curves_free(&c);
}

// 2 to 3 to 12 times the iterations: the largest counts, and only from 1e4 to 1e12 Pa.
static void test_stiffness(void **state) {
    (void)state;
    curves_table t;
    curves_error why;
    write_file("stiffness.csv", stiffness_header,
               "1e2,adaptive,5,1,9,9,converged\n1e4,adaptive,5,10,1,2,converged\n"
               "1e8,adaptive,5,40,2,3,converged\n1e12,adaptive,5,30,2,3,converged\n"
               "1e4,direct,5,0,2,3,converged\n1e8,direct,5,0,1.6,3,converged\n1e2,direct,5,0,1,1,"
               "converged\n");
    assert_true(curves_table_read(&t, OUT "/stiffness.csv", stiffness_header, &why));
    stiffness_check k = check_stiffness(&t);
    close_to(k.growth, 4), close_to(k.growth_at, 1e8);
    close_to(k.time, 1.25), close_to(k.time_at, 1e8);
    close_to(k.from, 1e4), close_to(k.to, 1e12);
    curves_table_free(&t);
}

static char *page(const char *name) {
    char path[100];
    snprintf(path, sizeof path, OUT "/pages/%.60s", name);
    char *h = slurp(path);
    check_tags(h);
    assert_null(strstr(h, "http"));
    assert_null(strstr(h, "<script"));
    assert_null(strstr(h, "url("));
    assert_null(strstr(h, "@import"));
    assert_null(strstr(h, ">nan<"));
    return h;
}

static void has(const char *h, const char *words) {
    if (!strstr(h, words)) fail_msg("the page does not have: %s", words);
}

static void test_pages(void **state) {
    (void)state;
    curves c;
    read_both(&c), curves_free(&c);
    write_file("small/error_vs_time.csv", curves_rows_header,
               "good,direct,,,0.1,5,0.03,0.01,0.003,0.01,,\n"
               "\"<i>x & \"\"y\"\"\",direct,,,0.1,5,0.03,0.01,0.003,0.01,,\n");
    write_file("small/stability.csv", stability_header,
               "a <case> & more,full,10,converged,3,5,0,0.5,1e-3,1,1,0.01,1e-9,2.5\n"
               "other,adaptive,10,iterations,3,5,0,0.5,1e-3,0,1,0.01,1e-9,2.5\n"
               "third,subspace,10,exploded,3,5,0,0.5,1e-3,1,0,,,2.5\n");
    write_file("small/stiffness.csv", stiffness_header,
               "1e4,adaptive,5,10,1,2,converged\n1e12,adaptive,5,60,2,3,converged\n"
               "1e4,direct,5,0,1,2,converged\n1e12,direct,5,0,2,2,converged\n");
    write_file("small/leave_out.csv", leave_out_header,
               "FRICTION,800000,700000,100,100,1040350780,1000000000,1.0404,counted, twice <b>\n"
               "TWO_D,800000,790000,100,100,1000,1000,1.0000,\n");
    assert_true(write_pages(OUT, OUT "/small", OUT "/pages"));
    char *h = page("index.html");
    has(h, "machine: &lt;two&gt; cores\ncommand &amp; sizes");
    has(h, "error take error_nodes = 0.01, error_modes = 0.001: 3 s");
    has(h, "the direct solver takes 2.67 times as long, the best full-space solver 2.33 times");
    has(h, "Adaptive does not dominate over a decade of error");
    has(h, "<h2 id=\"at-good\">"), has(h, "<a href=\"#at-bad\">bad</a>");
    has(h, "1 of 2 scenes"), has(h, "&lt;i&gt;x &amp; &quot;y&quot;, small");
    has(h, "<a href=\"stability.html\">"), has(h, "<a href=\"leave_out.html\">");
    has(h, "Largest error of a step: small rerun"), has(h, "line c2 dashed"),
        has(h, "class=\"at\"");
    free(h), h = page("stability.html");
    has(h, "a &lt;case&gt; &amp; more"), has(h, "1 of 3 runs"), has(h, "third, subspace:");
    has(h, "<td class=\"t warn\">iterations</td>"), has(h, "<td class=\"t bad\">exploded</td>");
    has(h, "<td class=\"t bad\">no</td>"), has(h, "at most 6.00 times those at 1e4 Pa");
    has(h, "<a href=\"index.html\">");
    free(h), h = page("leave_out.html");
    has(h, "<td class=\"n bad\">1.0404</td>"), has(h, "<td class=\"n good\">1.0000</td>");
    has(h, "counted, twice &lt;b&gt;"), has(h,
                                            "1\xe2\x80\xaf"
                                            "040\xe2\x80\xaf"
                                            "350\xe2\x80\xaf"
                                            "780");
    free(h);
}

// Speeds over vanilla, means over seeds and percentages of exits, of numbers chosen so that they are
// known: vanilla 4 and 8 ms, lipschitz 2 and 4.
#define NEURAL_ROW(system, method, seed, ms, solver, order, eps, cells) \
    system "," method "," seed ",567,400,10," ms ",30,40,3,1,0,0,1e-5,120,0.01,0.02,9,0.03,0.04,-1,0.5,15,1e-8," \
        solver ",1,2," order "," eps "," cells ",120\n"
#define MEASURE_ROW(system, r, cells, estimator) \
    system ",0,567,400," r "," cells "," cells ",0.5,0.1,0.2,0.3,0.4,1,50,5," estimator ",64,16\n"

static void neural_files(void) {
    static const char *const name[] = {"", "_newton", "_eps", "_order", "_runtime", "_r"};
    static const char lines[] =
        NEURAL_ROW("bar <1>", "vanilla", "0", "4", "lbfgs", "2", "1e-5", "400")
        NEURAL_ROW("bar <1>", "vanilla", "1", "8", "lbfgs", "2", "1e-5", "400")
        NEURAL_ROW("bar <1>", "lipschitz", "0", "2", "lbfgs", "2", "1e-5", "400")
        NEURAL_ROW("bar <1>", "lipschitz", "1", "4", "lbfgs", "2", "1e-5", "400")
        NEURAL_ROW("bar <1>", "full", "0", "24", "newton", "2", "1e-5", "400");
    for (int k = 0; k < 6; k++) {
        char file[60];
        snprintf(file, sizeof file, "small/neural%s.csv", name[k]);
        write_file(file, neural_header, lines);
    }
    write_file("small/neural_cubature.csv", measure_header, MEASURE_ROW("bar <1>", "10", "20", "u") MEASURE_ROW("bar <1>", "10", "40", "u"));
    write_file("small/neural_cost.csv", measure_header,
               MEASURE_ROW("bar <1>", "4", "150", "u") MEASURE_ROW("bar <1>", "8", "150", "u")
               MEASURE_ROW("bar <1>", "4", "150", "exact") MEASURE_ROW("bar <1>", "8", "150", "exact"));
    write_file("small/neural_errors.csv", errors_header, "bar <1>,vanilla,0,0,0.01,0.1,0.002,0.02\nbar <1>,vanilla,0,100,0.04,0.4,0.008,0.08\n");
    write_file("small/neural_bridge.csv", bridge_header, "bar <1>,skinning,0,12,on,7.5,5.6,18.6,55.6,171,0,0,0.00287,0.0369,0,567,400,300,0.5,1e-4,0.01\n");
}

static void test_neural(void **state) {
    (void)state;
    curves_table t;
    curves_error why;
    neural_files();
    assert_true(curves_table_read(&t, OUT "/small/neural.csv", neural_header, &why));
    close_to(neural_speed(&t, 2, -1), 2), close_to(neural_speed(&t, 4, -1), 0.25);
    close_to(neural_speed(&t, 2, SEED), 2);
    neural_column part = {"", EXIT_CONVERGED, 1}, ms = {"", STEP_MS, 0};
    int runs;
    close_to(neural_average(&t, 0, -1, part, NULL), 75), close_to(neural_average(&t, 0, -1, ms, &runs), 6);
    assert_int_equal(runs, 2);
    curves_table_free(&t);
    assert_true(write_pages(OUT "/no", OUT "/small", OUT "/pages"));
    char *h = page("neural.html");
    has(h, "2.00 times vanilla&#39;s speed"), has(h, "bar &lt;1&gt;"), has(h, "<td class=\"n good\">2</td>");
    has(h, "mean exit gradient"), has(h, ">75</td>"), has(h, "a step of training"), has(h, "relative errors");
    has(h, "Distributions of the errors"), has(h, "projection error, farthest node"), has(h, "% of states");
    has(h, "projection error"), has(h, "exact L_LS, cubature"), has(h, "nodes added a step"), has(h, ">skinning<");
    free(h);
    write_file("small/neural.csv", neural_header, "bar,vanilla,0\n");
    assert_false(write_pages(OUT "/no", OUT "/small", OUT "/pages"));
    h = page("neural.html"), has(h, "neural.csv: line 2"), free(h);
    assert_int_equal(remove(OUT "/small/neural.csv"), 0);
    assert_true(write_pages(OUT "/no", OUT "/none", OUT "/pages"));
    h = page("neural.html"), has(h, "sh bench/neural.sh"), has(h, "neural_r.csv: not there"), free(h);
}

static void test_missing_and_broken(void **state) {
    (void)state;
    assert_true(write_pages(OUT "/no", OUT "/none", OUT "/pages"));
    char *h = page("index.html");
    has(h, "make bench-error"), has(h, "make report");
    free(h), h = page("stability.html");
    has(h, "sh bench/stability.sh"), has(h, "stiffness.csv: not there");
    free(h), h = page("leave_out.html");
    has(h, "sh bench/leave_out.sh");
    free(h);
    write_file("small/leave_out.csv", leave_out_header, "a,1,2\n");
    write_file("small/error_vs_time.csv", curves_rows_header, "s,direct,,,0.1,5,much,0,0,0,,\n");
    assert_false(write_pages(OUT "/no", OUT "/small", OUT "/pages"));
    h = page("leave_out.html"), has(h, "leave_out.csv: line 2, column 4");
    free(h), h = page("index.html");
    has(h, OUT "/small/error_vs_time.csv: line 2, column 7 (error_max)");
    free(h);
    assert_false(write_pages(OUT, OUT "/small", OUT "/no/such/folder"));
}

// What report.h draws beside lines: labels, bars, wide tables, links, notes.
static void test_parts(void **state) {
    (void)state;
    double x[3] = {1, 10, 100}, y[3] = {1, 1, 1}, close[3] = {1, 1.001, 1.002};
    const char *label[3] = {"first <", NULL, "third"}, *same[3] = {"aaaa", "bbbb", "cccc"};
    report *r = report_begin("Parts", NULL);
    report_series s[2] = {{"lines", x, y, 3, label, REPORT_DOTTED, 5},
                          {"dots", x, x, 3, NULL, REPORT_POINTS, 0}};
    report_plot p = report_plot_default("Plot", "x", "y");
    p.log_x = p.log_y = p.markers = 1, p.height = 400;
    report_columns_begin(r), report_add_plot(r, &p, s, 2), report_columns_end(r);
    // Twelve labels on one spot: there is no room for all.
    report_series crowd[4] = {{"a", close, y, 3, same, REPORT_SOLID, 0},
                              {"b", close, y, 3, same, REPORT_SOLID, 0},
                              {"c", close, y, 3, same, REPORT_SOLID, 0},
                              {"far", x, y, 3, NULL, REPORT_SOLID, 0}};
    report_add_plot(r, &p, crowd, 4);
    const char *bars[3] = {"one", "two & more", "none"};
    double part[3] = {1, 2, 0}, rest[3] = {3, NAN, -1};
    report_series parts[2] = {{"part", NULL, part, 3, NULL, REPORT_SOLID, 0},
                              {"rest", NULL, rest, 3, NULL, REPORT_SOLID, 0}};
    report_add_bars(r, &p, bars, parts, 2);
    const char *heads[3] = {"name", "n <", "mixed"};
    report_cell cell[6] = {{"a", REPORT_INFO},  {"1.5 s", REPORT_GOOD}, {"3", REPORT_BAD},
                           {"b&", REPORT_INFO}, {"-2", REPORT_WARN},    {"word", REPORT_INFO}};
    report_grid(r, "Grid", heads, cell, 3, 2);
    report_link links[2] = {{NULL, "Here"}, {"other.html", "There & back"}};
    report_links(r, links, 2), report_note(r, "mind <this>", REPORT_WARN);
    report_code(r, "line 1 <\nline 2");
    report_error why;
    if (!report_end_as(r, OUT "/pages", "parts.html", &why)) fail_msg("%s", why.message);
    char *h = page("parts.html");
    has(h, ">first &lt;</text>"), has(h, ">third</text>"), has(h, "line c4 dotted");
    has(h, "viewBox=\"0 0 720 400\""), has(h, "two &amp; more"), has(h, "<div class=\"columns\">");
    has(h, "<th scope=\"col\" class=\"n\">n &lt;</th>"), has(h, "<td class=\"n good\">1.5 s</td>");
    has(h, "<td class=\"t bad\">3</td>"), has(h, "<b>Here</b>"), has(h, "There &amp; back</a>");
    has(h, "callout warn"), has(h, "<pre>line 1 &lt;\nline 2</pre>");
    int labels = 0;
    for (const char *q = h; (q = strstr(q, "class=\"at\"")) != NULL; q++) labels++;
    assert_true(labels < 2 + 9 + 3 && labels > 2 + 3);
    free(h);
    assert_false(report_end_as(report_begin("x", NULL), "no/such", "name.html", &why));
    has(why.message, "no/such/name.html");
    assert_false(report_end_as(NULL, ".", "name.html", &why));
    has(why.message, "name.html: no memory");
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_read),      cmocka_unit_test(test_refused),
        cmocka_unit_test(test_table),     cmocka_unit_test(test_recommend),
        cmocka_unit_test(test_dominates), cmocka_unit_test(test_spearman),
        cmocka_unit_test(test_ranks),     cmocka_unit_test(test_stiffness),
        cmocka_unit_test(test_pages),     cmocka_unit_test(test_neural),
        cmocka_unit_test(test_missing_and_broken),
        cmocka_unit_test(test_parts),
    };
    return cmocka_run_group_tests(tests, set_up, tear_down);
}
