/* report.h: one self-contained HTML page about a run (for the example programs)

   #define REPORT_IMPLEMENTATION      // in one .c file; needs nothing but the C library
   #include "report.h"

   report *r = report_begin("Armadillo on spikes", "100 steps of 25 ms, adaptive");
   report_status(r, "Result", "all 100 steps converged", REPORT_GOOD);
   report_frames(r, paths, labels, count, 8);         // PNG files, embedded
   report_series s[2] = {{"Newton", time, newton, 100}, {"contacts", time, contacts, 100}};
   report_plot p = report_plot_default("Work per step", "time, s", "count");
   report_add_plot(r, &p, s, 2);
   report_table(r, "Scene", names, values, rows);
   report_error why;
   if (!report_end(r, "out/demo", &why)) fprintf(stderr, "%s\n", why.message);   // frees r

   WHAT IT WRITES  DIR/report.html, or the name given to report_end_as: no script, no other file, no
   network. Pictures are base64 PNG, plots inline SVG: lines, stacked areas or bars, linear or
   logarithmic axes, round tick labels, a legend, points' values as tooltips, labels beside points.
   Light or dark as the reader's system is; wide tables and plots scroll sideways on a phone.

   CONVENTIONS  All text is UTF-8 and escaped here. Values that are not finite, and values <= 0 on
   a logarithmic axis, break the line; how many were left out is said below the plot.
   Lines of more than 900 points keep the least and the greatest of each group, areas the mean.

   ERRORS  Functions may be called whatever happened before: the first failure (no memory, a frame
   that cannot be read) is remembered. report_end writes the page if there was memory for it, to a
   temporary name first, and returns 0 with a sentence naming the file if anything failed.
   MEMORY  malloc: the page, held until report_end. THREADS  One report, one thread.

   >>api  >>text  >>base64  >>parts  >>ticks  >>points  >>plot  >>page                            */
#ifndef REPORT_H
#define REPORT_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef REPORT_API
#define REPORT_API extern
#endif

// ---------------------------------------------------------------------------------------------
// >>api (public)
// ---------------------------------------------------------------------------------------------

typedef struct report report;

typedef struct report_error {
    char message[512];
} report_error;

typedef enum report_level { REPORT_INFO, REPORT_GOOD, REPORT_WARN, REPORT_BAD } report_level;

typedef enum report_style {
    REPORT_SOLID,
    REPORT_DASHED,
    REPORT_DOTTED,
    REPORT_POINTS  // no line, dots only
} report_style;

// A named column. x NULL: 0, 1, 2, ...
typedef struct report_series {
    const char *name;
    const double *x, *y;
    int count;
    const char *const *label;  // beside the points, where there is room; NULL, or NULLs in it: none
    report_style style;
    int colour;  // 1 to 10; 0: the series' place among the others
} report_series;

// REPORT_INFO: no colour.
typedef struct report_cell {
    const char *text;
    report_level level;
} report_cell;

typedef struct report_link {
    const char *file, *text;  // file NULL: this page
} report_link;

typedef struct report_plot {
    const char *title, *x_label, *y_label;  // NULL: none
    const char *note;                       // a line below the plot; NULL: none
    int log_x, log_y;
    int stacked;  // areas on top of each other (same x; log_y is ignored)
    int markers;  // dots at the points
    int zero;     // a linear y axis starts at 0 (if nothing is negative)
    int height;   // of a width of 720; 0: 300
} report_plot;

// subtitle may be NULL. NULL: no memory; every function then does nothing.
REPORT_API report *report_begin(const char *title, const char *subtitle);
// A tile in the summary at the top.
REPORT_API void report_status(report *r, const char *name, const char *value, report_level level);
REPORT_API void report_heading(report *r, const char *text);
// Links to headings of this page, by their text.
REPORT_API void report_contents(report *r, const char *const *headings, int count);
REPORT_API void report_text(report *r, const char *text);
// A paragraph that stands out, with the colour of its level.
REPORT_API void report_note(report *r, const char *text, report_level level);
// Lines as they are: commands, comments of a file.
REPORT_API void report_code(report *r, const char *text);
// Other pages, at the top.
REPORT_API void report_links(report *r, const report_link *links, int count);
// What is added between the two stands side by side where the page is wide enough.
REPORT_API void report_columns_begin(report *r);
REPORT_API void report_columns_end(report *r);
// Two columns; caption may be NULL.
REPORT_API void report_table(report *r, const char *caption, const char *const *names,
                             const char *const *values, int rows);
// A table of many columns under their heads; cells row after row. Columns of numbers (units may
// follow) are aligned on the right. caption may be NULL.
REPORT_API void report_grid(report *r, const char *caption, const char *const *heads,
                            const report_cell *cells, int columns, int rows);
// A film strip of at most `most` of the PNG files, first and last among them, evenly picked.
// labels may be NULL, or have NULLs. A file that is missing or no PNG is an error (see top).
REPORT_API void report_frames(report *r, const char *const *paths, const char *const *labels,
                              int count, int most);
// All of the PNG files side by side, to be compared. As report_frames otherwise.
REPORT_API void report_pictures(report *r, const char *const *paths, const char *const *labels,
                                int count);
REPORT_API report_plot report_plot_default(const char *title, const char *x_label,
                                           const char *y_label);
// Arrays are read at once. More than 10 series share colours.
REPORT_API void report_add_plot(report *r, const report_plot *plot, const report_series *series,
                                int count);
// A horizontal bar a name, made of the series' values side by side: series[k].y[i] is part k of bar
// i. Of the plot title, x_label and note are used.
REPORT_API void report_add_bars(report *r, const report_plot *plot, const char *const *names,
                                const report_series *series, int count);
// Writes directory/report.html and frees r. error may be NULL. 1, or 0 and a message.
REPORT_API int report_end(report *r, const char *directory, report_error *error);
REPORT_API int report_end_as(report *r, const char *directory, const char *file,
                             report_error *error);

#ifdef __cplusplus
}
#endif
#endif  // REPORT_H

#if defined(REPORT_IMPLEMENTATION) && !defined(REPORT_IMPLEMENTATION_DONE)
#define REPORT_IMPLEMENTATION_DONE

#include <errno.h>
#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct report__text {
    char *at;
    size_t size, cap;
} report__text;

struct report {
    report__text tiles, links, body;
    char *title, *subtitle;
    int no_memory;
    char failure[512];
};

// ---------------------------------------------------------------------------------------------
// >>text (private)
// ---------------------------------------------------------------------------------------------

static char *report__room(report *r, report__text *t, size_t more) {
    if (r->no_memory || more > SIZE_MAX / 4 - t->size) return NULL;
    if (t->size + more + 1 > t->cap) {
        size_t cap = 2 * (t->size + more) + 4096;
        char *p = (char *)realloc(t->at, cap);
        if (!p) {
            r->no_memory = 1;
            return NULL;
        }
        t->at = p, t->cap = cap;
    }
    return t->at + t->size;
}

static void report__put(report *r, report__text *t, const char *s) {
    size_t n = strlen(s);
    char *p = report__room(r, t, n);
    if (!p) return;
    memcpy(p, s, n + 1);
    t->size += n;
}

// Escaped for text and for quoted attributes; control characters, which HTML forbids, become
// spaces; no line breaks before a % sign.
static void report__escape(report *r, report__text *t, const char *s) {
    for (; s && *s; s++) {
        char one[2] = {*s, 0};
        if ((unsigned char)*s < 32 || *s == 127) one[0] = ' ';
        report__put(r, t,
                    *s == ' ' && s[1] == '%' ? "\xc2\xa0"
                    : *s == '<'              ? "&lt;"
                    : *s == '>'              ? "&gt;"
                    : *s == '&'              ? "&amp;"
                    : *s == '"'              ? "&quot;"
                    : *s == '\''             ? "&#39;"
                                             : one);
    }
}

// %s escaped text, %r text as it is, %d int, %f number with two decimals and a point.
static void report__format(report *r, report__text *t, const char *format, ...) {
    va_list args;
    va_start(args, format);
    for (const char *f = format; *f; f++) {
        char one[64] = {*f, 0};
        if (*f != '%') {
            report__put(r, t, one);
            continue;
        }
        f++;
        if (*f == 's') report__escape(r, t, va_arg(args, const char *));
        if (*f == 'r') report__put(r, t, va_arg(args, const char *));
        if (*f == 'd') snprintf(one, sizeof one, "%d", va_arg(args, int));
        if (*f == 'f') {
            // Hundredths as an integer: no locale writes a comma into the drawing.
            double v = va_arg(args, double);
            long long h = v > -1e12 && v < 1e12 ? (long long)floor(100 * v + 0.5) : 0;
            long long a = h < 0 ? -h : h;
            snprintf(one, sizeof one, "%s%lld.%02lld", h < 0 ? "-" : "", a / 100, a % 100);
        }
        if (*f == 'd' || *f == 'f') report__put(r, t, one);
    }
    va_end(args);
}

static void report__number(double v, char text[40]) {
    snprintf(text, 40, "%.4g", fabs(v) < 1e-300 ? 0.0 : v);
    for (char *c = text; *c; c++)
        if (*c == ',') *c = '.';
    // 1e-05 and 1e+06 as 1e-5 and 1e6
    char *e = strchr(text, 'e');
    if (!e) return;
    char *from = e + 1, *to = e + 1;
    if (*from == '-') to++;
    from += strspn(from, "+-0");
    memmove(to, from, strlen(from) + 1);
}

static char *report__copy(const char *s) {
    size_t n = s ? strlen(s) + 1 : 1;
    char *p = (char *)malloc(n);
    if (p) memcpy(p, s ? s : "", n);
    return p;
}

// ---------------------------------------------------------------------------------------------
// >>base64 (private)
// ---------------------------------------------------------------------------------------------

static void report__base64(report *r, report__text *t, const unsigned char *data, size_t size) {
    static const char digit[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    char *p = report__room(r, t, (size + 2) / 3 * 4);
    if (!p) return;
    for (size_t i = 0; i < size; i += 3) {
        unsigned b = (unsigned)data[i] << 16, left = (unsigned)(size - i);
        if (left > 1) b |= (unsigned)data[i + 1] << 8;
        if (left > 2) b |= data[i + 2];
        *p++ = digit[b >> 18], *p++ = digit[b >> 12 & 63];
        *p++ = left > 1 ? digit[b >> 6 & 63] : '=';
        *p++ = left > 2 ? digit[b & 63] : '=';
    }
    *p = 0;
    t->size += (size + 2) / 3 * 4;
}

static void report__fail(report *r, const char *path, const char *why) {
    if (!r->failure[0]) snprintf(r->failure, sizeof r->failure, "%.350s: %.100s", path, why);
}

// The whole of a PNG file; NULL and a remembered reason otherwise. Free with free().
static unsigned char *report__png(report *r, const char *path, size_t *size) {
    static const unsigned char magic[8] = {0x89, 'P', 'N', 'G', 13, 10, 26, 10};
    FILE *f = fopen(path, "rb");
    if (!f) {
        report__fail(r, path, strerror(errno));
        return NULL;
    }
    unsigned char *data = NULL;
    size_t n = 0, cap = 0, got = 1;
    while (got > 0) {
        if (n == cap) {
            cap = cap ? 2 * cap : 1 << 18;
            unsigned char *p = (unsigned char *)realloc(data, cap);
            if (!p) r->no_memory = 1;
            if (!p) break;
            data = p;
        }
        got = fread(data + n, 1, cap - n, f);
        n += got;
    }
    int bad = ferror(f) || r->no_memory, png = n > 8 && memcmp(data, magic, 8) == 0;
    fclose(f);
    if (bad)
        report__fail(r, path, "cannot be read");
    else if (!png)
        report__fail(r, path, "expected a PNG picture");
    if (bad || !png) free(data), data = NULL;
    *size = n;
    return data;
}

// ---------------------------------------------------------------------------------------------
// >>parts (private)
// ---------------------------------------------------------------------------------------------

report *report_begin(const char *title, const char *subtitle) {
    report *r = (report *)calloc(1, sizeof(report));
    if (!r) return NULL;
    r->title = report__copy(title), r->subtitle = report__copy(subtitle);
    if (!r->title || !r->subtitle) r->no_memory = 1;
    return r;
}

static const char *report__level(report_level level) {
    static const char *const kind[] = {"info", "good", "warn", "bad"};
    return (unsigned)level < 4 ? kind[level] : kind[0];
}

void report_status(report *r, const char *name, const char *value, report_level level) {
    if (r)
        report__format(r, &r->tiles, "<div class=\"tile %r\"><dt>%s</dt><dd>%s</dd></div>\n",
                       report__level(level), name, value);
}

// The name of a heading within the page: letters and digits, a dash for each other byte.
static void report__anchor(const char *text, char name[64]) {
    size_t n = 0;
    for (; *text && n < 62; text++) {
        int c = (unsigned char)*text;
        int plain = (c >= '0' && c <= '9') || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
        name[n++] = (char)(plain || c == '_' ? c : '-');
    }
    name[n] = 0;
}

void report_heading(report *r, const char *text) {
    char name[64];
    report__anchor(text, name);
    if (r) report__format(r, &r->body, "<h2 id=\"at-%s\">%s</h2>\n", name, text);
}

void report_contents(report *r, const char *const *headings, int count) {
    char name[64];
    if (!r || count <= 0) return;
    report__put(r, &r->body, "<p class=\"contents\">");
    for (int i = 0; i < count; i++) {
        report__anchor(headings[i], name);
        report__format(r, &r->body, "<a href=\"#at-%s\">%s</a>\n", name, headings[i]);
    }
    report__put(r, &r->body, "</p>\n");
}

void report_text(report *r, const char *text) {
    if (r) report__format(r, &r->body, "<p>%s</p>\n", text);
}

void report_note(report *r, const char *text, report_level level) {
    if (r)
        report__format(r, &r->body, "<p class=\"callout %r\">%s</p>\n", report__level(level), text);
}

// Line breaks stay; everything else is escaped.
void report_code(report *r, const char *text) {
    if (!r) return;
    report__put(r, &r->body, "<pre>");
    while (*text) {
        char line[512];
        size_t n = strcspn(text, "\n");
        if (n > sizeof line - 1) n = sizeof line - 1;
        memcpy(line, text, n), line[n] = 0;
        report__escape(r, &r->body, line);
        text += n;
        if (*text == '\n') report__put(r, &r->body, "\n"), text++;
    }
    report__put(r, &r->body, "</pre>\n");
}

void report_links(report *r, const report_link *links, int count) {
    for (int i = 0; r && i < count; i++)
        if (links[i].file)
            report__format(r, &r->links, "<a href=\"%s\">%s</a>\n", links[i].file, links[i].text);
        else
            report__format(r, &r->links, "<b>%s</b>\n", links[i].text);
}

void report_columns_begin(report *r) {
    if (r) report__put(r, &r->body, "<div class=\"columns\">\n");
}

void report_columns_end(report *r) {
    if (r) report__put(r, &r->body, "</div>\n");
}

// A digit first, after a sign or a comparison; or a dash for nothing.
static int report__is_number(const char *s) {
    if (!*s || !strcmp(s, "-") || !strcmp(s, "\xe2\x80\x93") || !strcmp(s, "nan")) return 1;
    s += strspn(s, "<>=+-. ");
    return *s >= '0' && *s <= '9';
}

static int report__is_numeric(const report_cell *cells, int column, int columns, int rows) {
    int some = 0;
    for (int i = 0; i < rows; i++) {
        const char *s = cells[i * columns + column].text;
        if (!s || !*s) continue;
        if (!report__is_number(s)) return 0;
        some = 1;
    }
    return some;
}

void report_grid(report *r, const char *caption, const char *const *heads, const report_cell *cells,
                 int columns, int rows) {
    if (!r || columns <= 0) return;
    if (caption) report__format(r, &r->body, "<p class=\"caption\">%s</p>\n", caption);
    // A focus for the keyboard, which scrolls it.
    report__put(r, &r->body,
                "<div class=\"scroll\" tabindex=\"0\"><table class=\"cells\">\n<thead><tr>");
    int right[64] = {0};
    for (int j = 0; j < columns; j++) {
        if (j < 64) right[j] = report__is_numeric(cells, j, columns, rows);
        report__format(r, &r->body, "<th scope=\"col\"%r>%s</th>",
                       j < 64 && right[j] ? " class=\"n\"" : "", heads[j]);
    }
    report__put(r, &r->body, "</tr></thead>\n<tbody>\n");
    for (int i = 0; i < rows; i++) {
        report__put(r, &r->body, "<tr>");
        for (int j = 0; j < columns; j++) {
            const report_cell *c = &cells[i * columns + j];
            report__format(r, &r->body, "<td class=\"%r %r\">%s</td>",
                           j < 64 && right[j] ? "n" : "t",
                           c->level == REPORT_INFO ? "plain" : report__level(c->level),
                           c->text ? c->text : "");
        }
        report__put(r, &r->body, "</tr>\n");
    }
    report__put(r, &r->body, "</tbody></table></div>\n");
}

void report_table(report *r, const char *caption, const char *const *names,
                  const char *const *values, int rows) {
    if (!r) return;
    report__put(r, &r->body, "<table>\n");
    if (caption) report__format(r, &r->body, "<caption>%s</caption>\n", caption);
    for (int i = 0; i < rows; i++)
        report__format(r, &r->body, "<tr><th scope=\"row\">%s</th><td>%s</td></tr>\n", names[i],
                       values[i]);
    report__put(r, &r->body, "</table>\n");
}

// A click (or the space bar) on a picture shows it at full size: a hidden check box does it.
static void report__frame(report *r, const char *path, const char *label) {
    size_t size = 0;
    unsigned char *data = report__png(r, path, &size);
    if (!data) return;
    report__format(
        r, &r->body,
        "<figure><label><input type=\"checkbox\"><img alt=\"%s\" src=\"data:image/png;base64,",
        label ? label : "frame");
    report__base64(r, &r->body, data, size);
    report__format(r, &r->body, "\"></label>");
    if (label) report__format(r, &r->body, "<figcaption>%s</figcaption>", label);
    report__put(r, &r->body, "</figure>\n");
    free(data);
}

void report_frames(report *r, const char *const *paths, const char *const *labels, int count,
                   int most) {
    if (!r || count <= 0 || most <= 0) return;
    int n = count < most ? count : most;
    report__put(r, &r->body, "<div class=\"film\">\n");
    for (int k = 0; k < n; k++) {
        // Round k (count - 1) / (n - 1): the ends are always there; a single one is the last.
        long long at = n > 1 ? (2LL * k * (count - 1) + n - 1) / (2LL * (n - 1)) : count - 1;
        report__frame(r, paths[at], labels ? labels[at] : NULL);
    }
    report__put(r, &r->body, "</div>\n");
}

void report_pictures(report *r, const char *const *paths, const char *const *labels, int count) {
    if (!r || count <= 0) return;
    report__put(r, &r->body, "<div class=\"film side\">\n");
    for (int k = 0; k < count; k++) report__frame(r, paths[k], labels ? labels[k] : NULL);
    report__put(r, &r->body, "</div>\n");
}

// ---------------------------------------------------------------------------------------------
// >>ticks (private)
// An axis maps lo..hi (logarithms to base ten on a logarithmic axis) to pixels.
// ---------------------------------------------------------------------------------------------

typedef struct report__axis {
    double lo, hi, at_lo, at_hi;
    int log;
} report__axis;

static double report__value(const report__axis *a, double v) { return a->log ? log10(v) : v; }

static int report__usable(const report__axis *a, double v) {
    return v - v == 0 && (!a->log || v > 0);
}

static double report__pixel(const report__axis *a, double v) {
    return a->at_lo + (report__value(a, v) - a->lo) / (a->hi - a->lo) * (a->at_hi - a->at_lo);
}

// 1, 2 or 5 times a power of ten, not below x.
static double report__nice(double x) {
    double p = pow(10, floor(log10(x))), m = x / p;
    return p * (m <= 1.0001 ? 1 : m <= 2.0001 ? 2 : m <= 5.0001 ? 5 : 10);
}

// Extends the range so that flat data has a middle and nothing touches the frame.
static void report__open_range(report__axis *a, int zero, int tight) {
    if (!(a->lo <= a->hi)) a->lo = 0, a->hi = 1;
    double size = fmax(fabs(a->lo), fabs(a->hi)), gap = a->hi - a->lo;
    int from_zero = !a->log && zero && a->lo >= 0;
    if (from_zero) a->lo = 0, gap = a->hi;
    if (!(gap > 1e-9 * size)) {
        double half = a->log ? 0.5 : size > 0 ? 0.1 * size : 0.5;
        a->hi += half;
        if (!from_zero) a->lo -= half;
        return;
    }
    if (tight) return;
    a->hi += 0.05 * gap;
    if (!from_zero) a->lo -= 0.05 * gap;
}

// At most 12 values: round numbers, or powers of ten (with 2 and 5 in short ranges).
static int report__ticks(const report__axis *a, int wish, double *tick) {
    static const double part[3] = {1, 2, 5};
    int n = 0;
    if (a->log && a->hi - a->lo > 0.7) {
        int skip = (int)ceil((a->hi - a->lo) / 7), parts = a->hi - a->lo < 2.2 ? 3 : 1;
        for (int e = (int)floor(a->lo); e <= (int)ceil(a->hi); e++)
            for (int k = 0; k < parts && n < 12; k++) {
                double v = part[k] * pow(10, e);
                if (((e % skip) + skip) % skip == 0 && log10(v) >= a->lo - 1e-9 &&
                    log10(v) <= a->hi + 1e-9)
                    tick[n++] = v;
            }
        return n;
    }
    double lo = a->log ? pow(10, a->lo) : a->lo, hi = a->log ? pow(10, a->hi) : a->hi;
    double step = report__nice((hi - lo) / wish);
    for (double k = ceil(lo / step - 1e-9); k * step <= hi + 1e-9 * step && n < 12; k++)
        tick[n++] = k * step;
    return n;
}

// ---------------------------------------------------------------------------------------------
// >>points (private)
// ---------------------------------------------------------------------------------------------

enum { REPORT__MOST = 900 };

static double report__x(const report_series *s, int i) { return s->x ? s->x[i] : i; }

// Indices to draw: all, or of each of 450 groups the least and the greatest, in their order.
static int report__thin(const report_series *s, const report__axis *y, int *keep) {
    int n = 0, groups = REPORT__MOST / 2;
    if (s->count <= REPORT__MOST) {
        for (int i = 0; i < s->count; i++) keep[n++] = i;
        return n;
    }
    for (int g = 0; g < groups; g++) {
        int i0 = (int)((long long)s->count * g / groups),
            i1 = (int)((long long)s->count * (g + 1) / groups);
        int low = -1, high = -1;
        for (int i = i0; i < i1; i++) {
            if (!report__usable(y, s->y[i])) continue;
            if (low < 0 || s->y[i] < s->y[low]) low = i;
            if (high < 0 || s->y[i] > s->y[high]) high = i;
        }
        if (low < 0) low = high = i0;
        keep[n++] = low < high ? low : high;
        if (low != high) keep[n++] = low < high ? high : low;
    }
    return n;
}

// Mean of group g of `groups`; values that are not finite or negative count as nothing.
static double report__mean(const report_series *s, int g, int groups) {
    int i0 = (int)((long long)s->count * g / groups),
        i1 = (int)((long long)s->count * (g + 1) / groups);
    double sum = 0;
    for (int i = i0; i < i1; i++)
        if (s->y[i] - s->y[i] == 0 && s->y[i] > 0) sum += s->y[i];
    return i1 > i0 ? sum / (i1 - i0) : 0;
}

static int report__shortest(const report_series *s, int count) {
    int n = count > 0 ? s[0].count : 0;
    for (int k = 1; k < count; k++) n = s[k].count < n ? s[k].count : n;
    return n;
}

static void report__ranges(const report_plot *p, const report_series *s, int count, report__axis *x,
                           report__axis *y, int *dropped) {
    int shared = report__shortest(s, count);
    x->lo = y->lo = DBL_MAX, x->hi = y->hi = -DBL_MAX, *dropped = 0;
    for (int k = 0; k < count; k++)
        for (int i = 0; i < (p->stacked ? shared : s[k].count); i++) {
            double a = report__x(&s[k], i), b = s[k].y[i];
            if (p->stacked) {
                b = 0;
                for (int j = 0; j <= k; j++)
                    if (s[j].y[i] - s[j].y[i] == 0 && s[j].y[i] > 0) b += s[j].y[i];
            }
            if (!report__usable(x, a) || !report__usable(y, b)) {
                ++*dropped;
                continue;
            }
            a = report__value(x, a), b = report__value(y, b);
            x->lo = fmin(x->lo, a), x->hi = fmax(x->hi, a);
            y->lo = fmin(y->lo, b), y->hi = fmax(y->hi, b);
        }
    report__open_range(x, 0, !p->markers);
    report__open_range(y, p->zero || p->stacked, 0);
}

// ---------------------------------------------------------------------------------------------
// >>plot (private)
// ---------------------------------------------------------------------------------------------

enum {
    REPORT__W = 720,
    REPORT__H = 300,
    REPORT__LEFT = 64,
    REPORT__RIGHT = 14,
    REPORT__TOP = 12,
    REPORT__BOTTOM = 44,
    REPORT__BAR_LEFT = 205
};

report_plot report_plot_default(const char *title, const char *x_label, const char *y_label) {
    report_plot p;
    memset(&p, 0, sizeof p);
    p.title = title, p.x_label = x_label, p.y_label = y_label, p.zero = 1;
    return p;
}

// 2 to 9 times the powers of ten, where they are not too many to tell apart.
static void report__minor(report *r, const report__axis *a, const report__axis *other,
                          int vertical) {
    if (!a->log || a->hi - a->lo > 5) return;
    report__put(r, &r->body, "<path class=\"minor\" d=\"");
    for (int e = (int)floor(a->lo); e <= (int)ceil(a->hi); e++)
        for (int k = 2; k < 10; k++) {
            double v = k * pow(10, e), at = report__pixel(a, v);
            if (log10(v) < a->lo || log10(v) > a->hi) continue;
            if (vertical)
                report__format(r, &r->body, "M%f %fV%f", at, other->at_lo, other->at_hi);
            else
                report__format(r, &r->body, "M%f %fH%f", other->at_lo, at, other->at_hi);
        }
    report__put(r, &r->body, "\"/>\n");
}

static void report__grid(report *r, const report_plot *p, const report__axis *x,
                         const report__axis *y) {
    report__text *t = &r->body;
    double tick[12], foot = y->at_lo + (double)REPORT__BOTTOM;
    char text[40];
    int n = report__ticks(y, 6, tick);
    report__minor(r, y, x, 0);
    if (y->log) report__minor(r, x, y, 1);
    for (int i = 0; i < n; i++) {
        double at = report__pixel(y, tick[i]);
        report__number(tick[i], text);
        report__format(r, t,
                       "<path class=\"grid\" d=\"M%f %fH%f\"/><text x=\"%f\" y=\"%f\" "
                       "class=\"ytick\">%s</text>\n",
                       x->at_lo, at, x->at_hi, x->at_lo - 8, at + 4, text);
    }
    n = report__ticks(x, 8, tick);
    for (int i = 0; i < n; i++) {
        double at = report__pixel(x, tick[i]);
        report__number(tick[i], text);
        report__format(r, t,
                       "<path class=\"tick\" d=\"M%f %fv5\"/><text x=\"%f\" y=\"%f\" "
                       "class=\"xtick\">%s</text>\n",
                       at, y->at_lo, at, y->at_lo + 18, text);
    }
    report__format(r, t, "<path class=\"axis\" d=\"M%f %fH%f\"/>\n", x->at_lo, y->at_lo, x->at_hi);
    if (p->x_label)
        report__format(r, t, "<text x=\"%f\" y=\"%f\" class=\"label\">%s</text>\n",
                       0.5 * (x->at_lo + x->at_hi), foot - 6, p->x_label);
    if (p->y_label)
        report__format(
            r, t, "<text transform=\"translate(13 %f) rotate(-90)\" class=\"label\">%s</text>\n",
            0.5 * (y->at_lo + y->at_hi), p->y_label);
}

static void report__dot(report *r, const report_series *s, int i, int colour, double px,
                        double py) {
    char a[40], b[40];
    const char *label = s->label ? s->label[i] : NULL;
    report__number(report__x(s, i), a);
    report__number(s->y[i], b);
    report__format(r, &r->body,
                   "<circle class=\"dot c%d\" cx=\"%f\" cy=\"%f\" r=\"%r\"><title>%s%r%s: %s, "
                   "%s</title></circle>\n",
                   colour, px, py, s->style == REPORT_POINTS && !label ? "2.4" : "3.6", s->name,
                   label ? " " : "", label ? label : "", a, b);
}

static int report__colour(const report_series *s, int k) {
    return (s->colour > 0 ? s->colour - 1 : k) % 10;
}

static const char *report__dash(const report_series *s) {
    return s->style == REPORT_DASHED ? " dashed" : s->style == REPORT_DOTTED ? " dotted" : "";
}

static void report__line(report *r, const report_plot *p, const report_series *s, int colour,
                         const report__axis *x, const report__axis *y) {
    int keep[REPORT__MOST + 2], n = report__thin(s, y, keep), down = 0, run = 0;
    report__format(r, &r->body, "<path class=\"line c%d%r\" d=\"", colour, report__dash(s));
    for (int k = 0; k < n && s->style != REPORT_POINTS; k++) {
        double a = report__x(s, keep[k]), b = s->y[keep[k]];
        int ok = report__usable(x, a) && report__usable(y, b);
        // A lone point between gaps is a line of no length: round caps make it a dot.
        if (!ok && run == 1) report__put(r, &r->body, "h0");
        if (ok)
            report__format(r, &r->body, "%r%f %f", down ? "L" : "M", report__pixel(x, a),
                           report__pixel(y, b));
        down = ok, run = ok ? run + 1 : 0;
    }
    if (run == 1) report__put(r, &r->body, "h0");
    report__put(r, &r->body, "\"/>\n");
    for (int k = 0; k < n && (p->markers || s->style == REPORT_POINTS); k++) {
        double a = report__x(s, keep[k]), b = s->y[keep[k]];
        if (report__usable(x, a) && report__usable(y, b))
            report__dot(r, s, keep[k], colour, report__pixel(x, a), report__pixel(y, b));
    }
}

// Areas from the top one down, each to the axis: what is painted later covers what lies below.
static void report__areas(report *r, const report_series *s, int count, const report__axis *x,
                          const report__axis *y) {
    int n = report__shortest(s, count), groups = n < REPORT__MOST ? n : REPORT__MOST / 2;
    for (int k = count - 1; k >= 0 && groups > 0; k--) {
        report__format(r, &r->body, "<path class=\"area c%d\" d=\"", report__colour(&s[k], k));
        double first = 0, last = 0;
        int down = 0;
        for (int g = 0; g < groups; g++) {
            double sum = 0, a = report__x(&s[0], (int)((long long)n * g / groups));
            for (int j = 0; j <= k; j++) {
                report_series cut = s[j];
                cut.count = n;
                sum += report__mean(&cut, g, groups);
            }
            if (!report__usable(x, a)) continue;
            last = report__pixel(x, a);
            if (!down) first = last;
            report__format(r, &r->body, "%r%f %f", down ? "L" : "M", last, report__pixel(y, sum));
            down = 1;
        }
        if (down) report__format(r, &r->body, "V%fH%fZ", y->at_lo, first);
        report__format(r, &r->body, "\"><title>%s</title></path>\n", s[k].name);
    }
}

// Labels take, one after the other, the place around their dot that covers the least of the dots,
// lines and labels that are there; one that would cover much of another label is left out (the
// dot's tooltip has it).
typedef struct report__box {
    double x0, y0, x1, y1, weight;
} report__box;

enum { REPORT__BOXES = 1200 };

typedef struct report__crowd {
    report__box box[REPORT__BOXES];
    int count;
} report__crowd;

static void report__stand(report__crowd *c, double x, double y, double w, double h, double weight) {
    report__box b = {x - w / 2, y - h / 2, x + w / 2, y + h / 2, weight};
    if (c->count < REPORT__BOXES) c->box[c->count++] = b;
}

static double report__covered(const report__box *a, const report__box *b) {
    double w = fmin(a->x1, b->x1) - fmax(a->x0, b->x0), h = fmin(a->y1, b->y1) - fmax(a->y0, b->y0);
    return w > 0 && h > 0 ? w * h : 0;
}

// Dots, and points along the lines.
static void report__obstacles(report__crowd *c, const report_series *s, const report__axis *x,
                              const report__axis *y) {
    double px = 0, py = 0;
    int down = 0;
    for (int i = 0; i < s->count; i++) {
        double a = report__x(s, i), b = s->y[i];
        int ok = report__usable(x, a) && report__usable(y, b);
        if (!ok) {
            down = 0;
            continue;
        }
        double qx = report__pixel(x, a), qy = report__pixel(y, b);
        int n = down && s->style != REPORT_POINTS ? (int)(hypot(qx - px, qy - py) / 6) : 0;
        for (int k = 1; k < n && n < 200; k++)
            report__stand(c, px + (qx - px) * k / n, py + (qy - py) * k / n, 5, 5, 0.7);
        report__stand(c, qx, qy, 9, 9, 2);
        px = qx, py = qy, down = 1;
    }
}

static double report__cost(const report__crowd *c, const report__box *b, const report__axis *x,
                           const report__axis *y, double *labels) {
    double area = (b->x1 - b->x0) * (b->y1 - b->y0), cost = 0;
    report__box frame = {x->at_lo, y->at_hi, x->at_hi, y->at_lo, 0};
    *labels = 0;
    for (int i = 0; i < c->count; i++) {
        double covered = report__covered(&c->box[i], b);
        cost += covered * c->box[i].weight;
        if (c->box[i].weight > 3) *labels += covered / area;
    }
    return cost + 8 * (area - report__covered(&frame, b));
}

static void report__label(report *r, report__crowd *c, const char *label, double px, double py,
                          const report__axis *x, const report__axis *y) {
    static const double side[8][2] = {{1, -.7}, {1, 0},    {1, .7}, {0, -1},
                                      {0, 1},   {-1, -.7}, {-1, 0}, {-1, .7}};
    double w = 3, h = 12, best = DBL_MAX, over = 0;
    report__box at = {0, 0, 0, 0, 4};
    for (const char *p = label; *p; p++) w += ((unsigned char)*p & 0xc0) != 0x80 ? 6.3 : 0;
    for (int k = 0; k < 8; k++) {
        double cx = px + side[k][0] * (w / 2 + 6), cy = py + side[k][1] * 13, on;
        report__box b = {cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2, 4};
        double cost = report__cost(c, &b, x, y, &on) + 2 * k;
        if (cost < best) best = cost, at = b, over = on;
    }
    if (over > 0.3) return;
    if (c->count < REPORT__BOXES) c->box[c->count++] = at;
    report__format(r, &r->body, "<text class=\"at\" x=\"%f\" y=\"%f\">%s</text>\n", at.x0 + 1.5,
                   at.y1 - 2, label);
}

static void report__labels(report *r, const report_series *s, int count, const report__axis *x,
                           const report__axis *y) {
    int some = 0;
    for (int k = 0; k < count; k++) some |= s[k].label != NULL;
    report__crowd *c = some ? (report__crowd *)calloc(1, sizeof *c) : NULL;
    if (some && !c) r->no_memory = 1;
    for (int k = 0; k < count && c; k++) report__obstacles(c, &s[k], x, y);
    for (int k = 0; k < count && c; k++)
        for (int i = 0; s[k].label && i < s[k].count; i++) {
            double a = report__x(&s[k], i), b = s[k].y[i];
            if (s[k].label[i] && report__usable(x, a) && report__usable(y, b))
                report__label(r, c, s[k].label[i], report__pixel(x, a), report__pixel(y, b), x, y);
        }
    free(c);
}

static void report__legend(report *r, const report_plot *p, const report_series *s, int count,
                           int dropped) {
    report__put(r, &r->body, "<ul class=\"legend\">");
    for (int k = 0; k < count; k++)
        report__format(r, &r->body, "<li><i class=\"c%d%r\"></i>%s</li>", report__colour(&s[k], k),
                       report__dash(&s[k]), s[k].name);
    report__put(r, &r->body, "</ul>");
    if (p->note) report__format(r, &r->body, "<p class=\"note\">%s</p>", p->note);
    if (dropped)
        report__format(r, &r->body, "<p class=\"note\">%d value%r not drawn: not finite%r.</p>",
                       dropped, dropped > 1 ? "s" : "",
                       p->log_x || p->log_y ? ", or not positive on a logarithmic axis" : "");
}

void report_add_plot(report *r, const report_plot *plot, const report_series *series, int count) {
    if (!r || count <= 0) return;
    report_plot p = *plot;
    report__axis x = {0, 0, REPORT__LEFT, REPORT__W - REPORT__RIGHT, p.log_x};
    int dropped = 0, height = p.height > 100 ? p.height : REPORT__H;
    report__axis y = {0, 0, (double)(height - REPORT__BOTTOM), REPORT__TOP, p.log_y && !p.stacked};
    report__ranges(&p, series, count, &x, &y, &dropped);
    report__put(r, &r->body, "<figure class=\"plot\">");
    if (p.title) report__format(r, &r->body, "<figcaption>%s</figcaption>", p.title);
    report__format(
        r, &r->body,
        "<div class=\"scroll\"><svg viewBox=\"0 0 %d %d\" role=\"img\" aria-label=\"%s\">\n",
        REPORT__W, height, p.title ? p.title : "plot");
    // Areas would hide the grid: it is drawn after them.
    if (p.stacked) report__areas(r, series, count, &x, &y);
    report__grid(r, &p, &x, &y);
    for (int k = 0; k < count && !p.stacked; k++)
        report__line(r, &p, &series[k], report__colour(&series[k], k), &x, &y);
    if (!p.stacked) report__labels(r, series, count, &x, &y);
    report__put(r, &r->body, "</svg></div>");
    report__legend(r, &p, series, count, dropped);
    report__put(r, &r->body, "</figure>\n");
}

static double report__part(const report_series *s, int i) {
    return i < s->count && s->y[i] - s->y[i] == 0 && s->y[i] > 0 ? s->y[i] : 0;
}

static void report__bar(report *r, const report_series *s, int count, int i, double y,
                        const report__axis *x) {
    double sum = 0;
    char text[40];
    for (int k = 0; k < count; k++) {
        double v = report__part(&s[k], i), from = report__pixel(x, sum);
        if (!(v > 0)) continue;
        sum += v;
        report__number(v, text);
        report__format(r, &r->body,
                       "<rect class=\"area c%d\" x=\"%f\" y=\"%f\" width=\"%f\" "
                       "height=\"18\"><title>%s: %s</title></rect>\n",
                       report__colour(&s[k], k), from, y, report__pixel(x, sum) - from, s[k].name,
                       text);
    }
    snprintf(text, sizeof text, "%.3g", sum);
    report__format(r, &r->body, "<text class=\"at\" x=\"%f\" y=\"%f\">%s</text>\n",
                   report__pixel(x, sum) + 5, y + 13, text);
}

void report_add_bars(report *r, const report_plot *plot, const char *const *names,
                     const report_series *series, int count) {
    if (!r || count <= 0) return;
    int bars = 0;
    double most = 0, tick[12], bottom;
    char text[40];
    for (int k = 0; k < count; k++) bars = series[k].count > bars ? series[k].count : bars;
    for (int i = 0; i < bars; i++) {
        double sum = 0;
        for (int k = 0; k < count; k++) sum += report__part(&series[k], i);
        most = fmax(most, sum);
    }
    report__axis x = {0, most > 0 ? most : 1, REPORT__BAR_LEFT, REPORT__W - 60, 0};
    bottom = 8.0 + 26 * bars;
    report__put(r, &r->body, "<figure class=\"plot bars\">");
    if (plot->title) report__format(r, &r->body, "<figcaption>%s</figcaption>", plot->title);
    report__format(r, &r->body,
                   "<div class=\"scroll\"><svg viewBox=\"0 0 %d %d\" role=\"img\" "
                   "aria-label=\"%s\">\n",
                   REPORT__W, (int)bottom + 42, plot->title ? plot->title : "bars");
    int n = report__ticks(&x, 6, tick);
    for (int i = 0; i < n; i++) {
        report__number(tick[i], text);
        report__format(r, &r->body,
                       "<path class=\"grid\" d=\"M%f 4V%f\"/><text x=\"%f\" y=\"%f\" "
                       "class=\"xtick\">%s</text>\n",
                       report__pixel(&x, tick[i]), bottom, report__pixel(&x, tick[i]), bottom + 16,
                       text);
    }
    for (int i = 0; i < bars; i++) {
        report__format(r, &r->body, "<text x=\"%f\" y=\"%f\" class=\"ytick\">%s</text>\n",
                       x.at_lo - 8, 26.0 * i + 21, names[i]);
        report__bar(r, series, count, i, 26.0 * i + 8, &x);
    }
    if (plot->x_label)
        report__format(r, &r->body, "<text x=\"%f\" y=\"%f\" class=\"label\">%s</text>\n",
                       0.5 * (x.at_lo + x.at_hi), bottom + 36, plot->x_label);
    report__put(r, &r->body, "</svg></div>");
    report__legend(r, plot, series, count, 0);
    report__put(r, &r->body, "</figure>\n");
}

// ---------------------------------------------------------------------------------------------
// >>page (private)
// Ten hues of like lightness, told apart also by the colour-blind in their first six; lighter in
// the dark.
// ---------------------------------------------------------------------------------------------

static const char *const report__style =
    ":root{color-scheme:light "
    "dark;--bg:#fbfbfc;--card:#fff;--ink:#1b222c;--soft:#5a6675;--rule:#e2e6eb;"
    "--good:#1a7f4b;--warn:#a76400;--bad:#c22f2f;--info:#2a66b5;"
    "--c0:#2f6fb7;--c1:#e07b1f;--c2:#1f9d76;--c3:#b4458f;--c4:#c9a400;--c5:#4bb0d6;--c6:#c8443c;"
    "--c7:#6d62c4;--c8:#7f8c3a;--c9:#7b6a58}\n"
    "@media(prefers-color-scheme:dark){:root{--bg:#14181e;--card:#1c222a;--ink:#e7ebf0;--soft:#"
    "9aa7b6;"
    "--rule:#303945;--good:#4ecb8d;--warn:#e5a84b;--bad:#f27d72;--info:#7db0ef;"
    "--c0:#6aa5e8;--c1:#f0a052;--c2:#4cc79f;--c3:#d980b8;--c4:#e2c84a;--c5:#84d0ee;--c6:#ef8077;"
    "--c7:#a59bec;--c8:#b3c069;--c9:#b8a48f}}\n"
    "*{box-sizing:border-box}body{margin:0 auto;max-width:1180px;padding:32px 24px "
    "64px;background:var(--bg);"
    "color:var(--ink);font:15px/1.5 system-ui,-apple-system,'Segoe UI',Roboto,sans-serif}\n"
    "h1{font-size:28px;line-height:1.2;margin:0}h2{font-size:19px;margin:36px 0 12px}p{margin:8px "
    "0;max-width:75ch}"
    ".sub{color:var(--soft);margin:6px 0 0}\n"
    ".tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:12px;margin:"
    "24px 0}"
    ".tile{background:var(--card);border:1px solid var(--rule);border-left:4px solid "
    "var(--info);border-radius:6px;"
    "padding:10px 14px}.tile dt{color:var(--soft);font-size:13px}.tile "
    "dd{margin:0;font-size:19px;font-weight:600;"
    "font-variant-numeric:tabular-nums}.good{border-left-color:var(--good)}.warn{border-left-color:"
    "var(--warn)}"
    ".bad{border-left-color:var(--bad)}.bad dd{color:var(--bad)}\n"
    ".film{display:flex;gap:14px;overflow-x:auto;scroll-snap-type:x proximity;padding:4px 0 12px}"
    ".film figure{flex:0 0 min(540px,86%);margin:0;scroll-snap-align:start}.film "
    "img{display:block;width:100%;"
    "border-radius:6px;border:1px solid var(--rule);cursor:zoom-in}.film "
    "input{position:absolute;opacity:0}"
    ".film figcaption{color:var(--soft);font-size:13px;padding-top:4px}"
    ".film input:focus-visible~img{outline:3px solid var(--info)}"
    ".film "
    "input:checked~img{position:fixed;inset:0;width:100vw;height:100vh;object-fit:contain;z-index:"
    "9;"
    "background:#000c;border:0;border-radius:0;cursor:zoom-out}\n"
    ".plots{display:block}.plot{margin:18px 0;background:var(--card);border:1px solid "
    "var(--rule);border-radius:6px;"
    "padding:14px 16px}.plot figcaption{font-weight:600;margin-bottom:6px}.plot "
    "svg{display:block;width:100%;height:auto;"
    "overflow:visible}\n"
    ".plot "
    "text{font-size:12px;fill:var(--soft);font-variant-numeric:tabular-nums}.ytick{text-anchor:end}"
    ".xtick,.label{text-anchor:middle}.grid{stroke:var(--soft);stroke-opacity:.22;fill:none}"
    ".axis,.tick{stroke:var(--soft);fill:none}.line{fill:none;stroke-width:1.8;stroke-linejoin:"
    "round;"
    "stroke-linecap:round}.area{stroke:var(--card);stroke-width:.7}.dot{stroke:var(--card);stroke-"
    "width:1}\n";

static const char *const report__style_of_parts =
    ".minor{stroke:var(--soft);stroke-opacity:.09;fill:none}.dashed{stroke-dasharray:7 5}"
    ".dotted{stroke-dasharray:1 5}.plot .at{font-size:11.5px;fill:var(--ink);paint-order:stroke;"
    "stroke:var(--card);stroke-width:3px;stroke-linejoin:round}.scroll{overflow-x:auto}\n"
    ".legend{list-style:none;display:flex;flex-wrap:wrap;gap:4px 18px;margin:6px 0 "
    "0;padding:0;font-size:13px}"
    ".legend "
    "i{display:inline-block;width:12px;height:12px;border-radius:3px;margin-right:6px;vertical-"
    "align:-1px}"
    ".legend i.dashed,.legend i.dotted{height:4px;vertical-align:3px;opacity:.75}\n"
    "nav{display:flex;flex-wrap:wrap;gap:4px 22px;margin:12px 0 20px;padding-bottom:10px;"
    "border-bottom:1px solid var(--rule)}.contents{display:flex;flex-wrap:wrap;gap:4px "
    "18px;max-width:none}a{color:var(--info)}\n"
    ".callout{background:var(--card);border:1px solid var(--rule);border-left:4px solid "
    "var(--info);border-radius:6px;padding:10px 14px;margin:12px 0;max-width:none}"
    ".callout.good{border-left-color:var(--good)}.callout.warn{border-left-color:var(--warn)}"
    ".callout.bad{border-left-color:var(--bad)}\n"
    "pre{font:12.5px/1.5 ui-monospace,Menlo,Consolas,monospace;white-space:pre-wrap;overflow-wrap:"
    "anywhere;background:var(--card);border:1px solid var(--rule);border-radius:6px;padding:8px "
    "12px;margin:10px 0;color:var(--soft)}\n"
    ".columns{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(500px,100%),1fr));gap:"
    "0 18px}.columns>*{min-width:0}.columns .plot{margin:9px 0}.columns .plot text{font-size:14px}"
    ".columns .plot .at{font-size:13px}\n"
    ".bars svg{max-width:860px}\n"
    ".side{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(240px,100%),1fr));"
    "overflow:visible}\n"
    ".note{color:var(--soft);font-size:13px;margin:4px 0 0}\n"
    "table{border-collapse:collapse;margin:12px 0;background:var(--card);border:1px solid "
    "var(--rule)}"
    "caption{text-align:left;font-weight:600;padding-bottom:6px}th,td{text-align:left;padding:5px "
    "14px;"
    "border-bottom:1px solid "
    "var(--rule);font-weight:400;overflow-wrap:anywhere}th{color:var(--soft)}"
    "td{font-variant-numeric:tabular-nums}\n"
    ".caption{font-weight:600;margin:18px 0 6px}.cells{margin:0;font-size:14px;min-width:100%}"
    ".cells th{font-size:13px;line-height:1.3;vertical-align:bottom;background:var(--card)}.cells "
    "td,.cells "
    "th{padding:4px 10px;overflow-wrap:normal}.cells .n{text-align:right}.cells "
    "td.n{white-space:nowrap}"
    ".cells td.t:first-child{min-width:14em}.cells td.t:last-child{min-width:8em}"
    ".cells tbody tr:last-child td{border-bottom:0}.cells .good{color:var(--good);font-weight:600}"
    ".cells .warn{color:var(--warn);font-weight:600}.cells .bad{color:var(--bad);font-weight:600}"
    ".scroll{margin:4px 0}.cells+*{margin-top:10px}\n"
    "@media(max-width:640px){body{padding:20px 14px "
    "40px}h1{font-size:23px}.plot{padding:10px}.plot text,.columns .plot text{font-size:19px}.plot "
    ".at,.columns .plot .at{font-size:16px}.bars svg{min-width:480px}.bars.plot text,.bars.plot "
    ".at{font-size:14px}.cells td,.cells th{padding:4px 8px}.cells "
    "td.t:first-child{min-width:8em}}\n@media "
    "print{body{max-width:none;padding:0;background:#fff}.columns{grid-template-columns:1fr "
    "1fr}.columns .plot text{font-size:17px}.film{flex-wrap:wrap;overflow:visible}.film "
    "figure{flex-basis:48%}.scroll{overflow:visible}.cells{font-size:9.5px}.cells th{font-size:"
    "9.5px}.cells td,.cells th{padding:2px 5px}figure,.callout,tr{break-inside:avoid}h2{break-"
    "after:avoid}nav,.contents{display:none}}\n";

static void report__head(report *r, report__text *t) {
    report__format(r, t,
                   "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n"
                   "<meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\n"
                   "<title>%s</title>\n<style>\n",
                   r->title);
    report__put(r, t, report__style);
    report__put(r, t, report__style_of_parts);
    for (int i = 0; i < 10; i++)
        report__format(r, t,
                       ".line.c%d{stroke:var(--c%d)}.area.c%d,.dot.c%d{fill:var(--c%d)}i.c%d{"
                       "background:var(--c%d)}\n",
                       i, i, i, i, i, i, i);
    report__format(r, t, "</style>\n</head>\n<body>\n<h1>%s</h1>\n", r->title);
    if (r->subtitle[0]) report__format(r, t, "<p class=\"sub\">%s</p>\n", r->subtitle);
    if (r->links.size) report__format(r, t, "<nav>\n%r</nav>\n", r->links.at);
    if (r->tiles.size) report__format(r, t, "<dl class=\"tiles\">\n%r</dl>\n", r->tiles.at);
}

// To a temporary name, then renamed: a reader sees the old page or the new one.
static int report__write(report *r, const report__text *head, const char *directory,
                         const char *file) {
    static const char end[] = "</body>\n</html>\n";
    char path[1024], temporary[1040];
    int fits = snprintf(path, sizeof path, "%s/%s", directory, file);
    if (fits < 0 || fits > (int)sizeof path - 32) {
        report__fail(r, directory, "the name is too long");
        return 0;
    }
    snprintf(temporary, sizeof temporary, "%s.part", path);
    FILE *f = fopen(temporary, "wb");
    if (!f) {
        snprintf(r->failure, sizeof r->failure, "%.400s: cannot write: %s", path, strerror(errno));
        return 0;
    }
    int ok = fwrite(head->at, 1, head->size, f) == head->size;
    if (r->body.size) ok &= fwrite(r->body.at, 1, r->body.size, f) == r->body.size;
    ok &= fwrite(end, 1, sizeof end - 1, f) == sizeof end - 1;
    ok &= fclose(f) == 0;
    // Windows does not rename onto a file that is there.
    if (ok && rename(temporary, path) != 0) ok = remove(path) == 0 && rename(temporary, path) == 0;
    if (!ok) {
        snprintf(r->failure, sizeof r->failure, "%.400s: cannot write: %s", path, strerror(errno));
        remove(temporary);
    }
    return ok;
}

int report_end_as(report *r, const char *directory, const char *file, report_error *error) {
    report__text head = {NULL, 0, 0};
    if (error) error->message[0] = 0;
    if (r && !r->no_memory) report__head(r, &head);
    if (r && r->no_memory)
        snprintf(r->failure, sizeof r->failure, "%.350s/%.100s: no memory", directory, file);
    else if (r)
        report__write(r, &head, directory, file);
    int ok = r && !r->failure[0];
    if (error && !ok)
        snprintf(error->message, sizeof error->message, "%.400s%s", r ? r->failure : file,
                 r ? "" : ": no memory");
    free(head.at);
    if (r)
        free(r->tiles.at), free(r->links.at), free(r->body.at), free(r->title), free(r->subtitle);
    free(r);
    return ok;
}

int report_end(report *r, const char *directory, report_error *error) {
    return report_end_as(r, directory, "report.html", error);
}

#ifdef __cplusplus
}
#endif
#endif  // REPORT_IMPLEMENTATION
