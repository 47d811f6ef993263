/* tss_io.h: meshes in, frames out (optional sibling of tss.h)

   #include "tss.h"
   #include "tss_io.h"      // and in one .c file: #define TSS_IMPLEMENTATION before both

   tss_mesh mesh;
   tss_io_error why;
   if (tss_mesh_read(NULL, "bar.msh", &mesh, &why) != TSS_OK)
       fprintf(stderr, "%s:%lld: %s\n", why.file, why.line, why.message);
   ...
   tss_mesh_free(&mesh);

   Reads   .msh   Gmsh 2.0-2.2 and 4.1, ASCII and binary of either byte order; unknown sections
                  ($Surface, $Periodic, ...) are skipped
           .mesh  Medit, ASCII (.meshb is refused with a message)
           .node  TetGen and Triangle, with the .ele beside it if there is one; .ele, .node likewise
           .obj   Wavefront: v, f (polygons are cut into fans), l, p; v/vt/vn, negative indices
           .ply   ASCII, binary of either byte order; vertex, face (fans), edge; others skipped
           .seg   lines "v x y z" and "s i j", 1-based: polylines as collision obstacles
   Writes  .vtu (ASCII or base64), .pvd (a series of .vtu with their times), .obj, .ply

   CONVENTIONS  Nodes are 0-based here whatever the file says; x is nodes × 3, z = 0 in 2D.
   Orientation is that of the file: tss_mesh_check counts inverted tets, tss_mesh_flip_inverted
   mends them. Positive: det(x1-x0, x2-x0, x3-x0) > 0; triangles of a surface turn
   counter-clockwise seen from outside. Region ids: Gmsh's first physical group, else its entity;
   Medit's reference; TetGen's first attribute, rounded; else 0. A file with nodes and no cells is
   a point set: each node becomes a point.
   Elements of higher order, quads of Gmsh and Medit, hexahedra, prisms and pyramids are refused,
   not dropped: a mesh with a hole in it helps nobody.

   NUMBERS  Text numbers are converted here, correctly rounded, whatever LC_NUMERIC says; inf and
   nan are refused. Written ASCII numbers read back to the same bits.

   ERRORS  A malformed file gives TSS_ERROR_FORMAT, the line (text) or byte (binary) of the first
   offence, what was expected and what was found; the mesh is then empty, never half filled. Counts
   in headers are checked against the file's size before anything is allocated.

   MEMORY  All from the host's allocator: the file, the result, and little else. No globals.
   THREADS  Every function may run at the same time as any other on different meshes.
   LIMITS  Fewer than 2^31 / 4 nodes and cells; a whole file is held in memory while it is read. */
#ifndef TSS_IO_H
#define TSS_IO_H

#ifndef TSS_H
#error "include tss.h before tss_io.h"
#endif

#ifdef __cplusplus
extern "C" {
#endif

// ---------------------------------------------------------------------------------------------
// >>mesh (public)
// ---------------------------------------------------------------------------------------------

// A mesh that owns its arrays. {0} is an empty mesh. An array whose count is 0 is NULL.
typedef struct tss_mesh {
    tss_host host;                              // whose memory the arrays are
    int dim;                                    // 2 (all z are 0) or 3
    int nodes, tets, triangles, edges, points;  // counts
    double *x;                                  // nodes × 3
    int *tet, *triangle, *edge, *point;         // × 4, × 3, × 2, × 1 nodes, 0-based
    int *tet_region, *triangle_region, *edge_region, *point_region;
    int *node_marker;  // TetGen's markers, Medit's references; or 0
} tss_mesh;

// Where and why. line: 1-based, 0 when it has no meaning; byte: offset from 0, −1 likewise.
typedef struct tss_io_error {
    char file[256];
    long long line, byte;
    char message[256];
} tss_io_error;

// host may be NULL (the C library's memory); it is copied into the mesh. Arrays are zeroed. *out is
// overwritten, not freed. Counts >= 0. BAD_ARGUMENT, NO_MEMORY (*out is then empty).
TSS_API tss_result tss_mesh_alloc(const tss_host *host, int dim, int nodes, int tets, int triangles,
                                  int edges, int points, tss_mesh *out);
// Leaves an empty mesh. NULL and empty meshes are allowed.
TSS_API void tss_mesh_free(tss_mesh *mesh);

// ---------------------------------------------------------------------------------------------
// >>mesh_read (public)
// host and error may be NULL; *out is overwritten, not freed, and empty unless TSS_OK. Errors: FILE
// (cannot be opened or read), FORMAT, NO_MEMORY, BAD_ARGUMENT. Cost: one pass over the file.
// ---------------------------------------------------------------------------------------------

typedef enum tss_mesh_format {
    TSS_MESH_AUTO,  // by the name's suffix, else by the contents
    TSS_MESH_GMSH,
    TSS_MESH_MEDIT,
    TSS_MESH_TETGEN,
    TSS_MESH_OBJ,
    TSS_MESH_PLY,
    TSS_MESH_SEG
} tss_mesh_format;

TSS_API tss_result tss_mesh_read(const tss_host *host, const char *path, tss_mesh *out,
                                 tss_io_error *error);
// From memory; name serves AUTO and the messages. For TETGEN data is the .node file alone.
TSS_API tss_result tss_mesh_parse(const tss_host *host, tss_mesh_format format, const char *name,
                                  const void *data, size_t size, tss_mesh *out,
                                  tss_io_error *error);
// A .node file and its .ele (NULL: none).
TSS_API tss_result tss_mesh_parse_tetgen(const tss_host *host, const char *node_name,
                                         const void *node, size_t node_size, const char *ele_name,
                                         const void *ele, size_t ele_size, tss_mesh *out,
                                         tss_io_error *error);
// The correctly rounded double of text[0..size-1]: [+-] digits [. digits] [e [+-] digits], nothing
// before or after. FORMAT for anything else (inf, nan, hexadecimal) and for overflow.
TSS_API tss_result tss_parse_double(const char *text, size_t size, double *value);
// The shortest of 15, 16 and 17 digits that reads back to the same bits, with a point. Returns the
// length written; text needs 32 bytes.
TSS_API int tss_format_double(double value, char *text);

// ---------------------------------------------------------------------------------------------
// >>mesh_check (public)
// What is wrong with a mesh, by name; and two repairs.
// ---------------------------------------------------------------------------------------------

#define TSS_MESH_ISSUES(X)                                                         \
    X(TSS_MESH_BAD_INDEX_TET, "tet", "names a node that does not exist")           \
    X(TSS_MESH_BAD_INDEX_TRIANGLE, "triangle", "names a node that does not exist") \
    X(TSS_MESH_BAD_INDEX_EDGE, "edge", "names a node that does not exist")         \
    X(TSS_MESH_BAD_INDEX_POINT, "point", "names a node that does not exist")       \
    X(TSS_MESH_NOT_FINITE, "node", "has a coordinate that is not a finite number") \
    X(TSS_MESH_INVERTED_TET, "tet", "is inverted (negative volume)")               \
    X(TSS_MESH_INVERTED_TRIANGLE, "triangle", "turns clockwise (2D)")              \
    X(TSS_MESH_DEGENERATE_TET, "tet", "is degenerate (no volume)")                 \
    X(TSS_MESH_DEGENERATE_TRIANGLE, "triangle", "is degenerate (no area)")         \
    X(TSS_MESH_DEGENERATE_EDGE, "edge", "is degenerate (no length)")               \
    X(TSS_MESH_DUPLICATE_TET, "tet", "has the nodes of an earlier one")            \
    X(TSS_MESH_DUPLICATE_TRIANGLE, "triangle", "has the nodes of an earlier one")  \
    X(TSS_MESH_DUPLICATE_EDGE, "edge", "has the nodes of an earlier one")          \
    X(TSS_MESH_DUPLICATE_POINT, "point", "has the node of an earlier one")         \
    X(TSS_MESH_DUPLICATE_NODE, "node", "is where an earlier one is")               \
    X(TSS_MESH_UNREFERENCED_NODE, "node", "belongs to no cell")

typedef enum tss_mesh_issue {
#define TSS__ENUM(id, thing, text) id,
    TSS_MESH_ISSUES(TSS__ENUM)
#undef TSS__ENUM
        TSS_MESH_ISSUE_COUNT
} tss_mesh_issue;

#define TSS_MESH_OFFENDERS 4  // the first ones of each kind are kept

typedef struct tss_mesh_report {
    int problems;  // sum of all counts
    int count[TSS_MESH_ISSUE_COUNT];
    int first[TSS_MESH_ISSUE_COUNT][TSS_MESH_OFFENDERS];  // min(count, 4) numbers, ascending
    double volume;              // signed, of the tets (3D) or triangles (2D: area)
    double lower[3], upper[3];  // bounding box of the finite nodes; lower > upper if none
} tss_mesh_report;

// NO_MEMORY is the only error. Cost: O(n log n). Nothing else is checked for cells with bad
// indices.
TSS_API tss_result tss_mesh_check(const tss_mesh *mesh, tss_mesh_report *report);
// "3 tets: is inverted (negative volume): 5, 17, 18": one line about one kind; "" if it has none.
TSS_API void tss_mesh_issue_text(const tss_mesh_report *report, tss_mesh_issue issue, char *text,
                                 size_t size);
// Swaps two nodes of every inverted tet (2D: triangle); returns how many.
TSS_API int tss_mesh_flip_inverted(tss_mesh *mesh);
// Drops nodes that no cell names, keeping the order of the others. The mesh must have no bad
// indices (BAD_MESH). NO_MEMORY leaves it as it was. *dropped may be NULL.
TSS_API tss_result tss_mesh_drop_unreferenced(tss_mesh *mesh, int *dropped);
// Boundary triangles of the tets (faces of exactly one), outward if the tets are positive, in the
// order of the tets. out has the same nodes and nothing else; BAD_MESH on a bad index.
TSS_API tss_result tss_mesh_surface(const tss_mesh *mesh, tss_mesh *out);

// ---------------------------------------------------------------------------------------------
// >>mesh_write (public)
// A file is written beside its place as PATH.part and renamed when complete: a reader never sees
// half a frame, and a full disk leaves the old file. Errors: FILE, NO_MEMORY, BAD_ARGUMENT.
// ---------------------------------------------------------------------------------------------

typedef struct tss_field {
    const char *name;
    const double *values;  // rows × components, row-major
    int components;        // 1: scalar; 2 is padded to 3 (viewers want three)
    int on_cells;          // 0: a row a node; 1: a row a cell: tets, triangles, edges, points
} tss_field;

// VTK's unstructured grid: all cells, their regions as cell data "region", and the fields.
// ascii 0: base64, exact and compact. fields may be NULL if count is 0. x: nodes × 3 positions
// instead of the mesh's, or NULL.
TSS_API tss_result tss_mesh_write_vtu(const tss_mesh *mesh, const double *x, const char *path,
                                      const tss_field *fields, int count, int ascii,
                                      tss_io_error *error);
// Series of frames; the files' names are relative to the .pvd.
TSS_API tss_result tss_write_pvd(const tss_host *host, const char *path, const char *const *files,
                                 const double *times, int count, tss_io_error *error);
// Triangles, edges and points (tets: tss_mesh_surface first; a mesh with tets only is refused).
TSS_API tss_result tss_mesh_write_obj(const tss_mesh *mesh, const double *x, const char *path,
                                      tss_io_error *error);
// Triangles and edges, coordinates as doubles. ascii 0: binary little-endian.
TSS_API tss_result tss_mesh_write_ply(const tss_mesh *mesh, const double *x, const char *path,
                                      int ascii, tss_io_error *error);

#ifdef __cplusplus
}
#endif
#endif  // TSS_IO_H

#if defined(TSS_IMPLEMENTATION) && !defined(TSS_IO_IMPLEMENTATION_DONE)
#define TSS_IO_IMPLEMENTATION_DONE

#include <errno.h>
#include <limits.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#if defined(__unix__) || defined(__APPLE__)
#include <sys/stat.h>
#endif

#if defined(__clang__)
#pragma clang fp contract(off)
#elif defined(__GNUC__)
#pragma GCC push_options
#pragma GCC optimize("fp-contract=off")
#endif

#if defined(__GNUC__)
#define TSS__IO_FORMAT(f, a) __attribute__((format(printf, f, a)))
#else
#define TSS__IO_FORMAT(f, a)
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define TSS__IO_MESH_MAX (INT_MAX / 4)  // so that 4 × count is an int

// ---------------------------------------------------------------------------------------------
// >>mesh (private)
// Cells of k + 1 nodes are "kind k": 0 points, 1 edges, 2 triangles, 3 tets; most code runs over
// the four kinds instead of being written four times.
// ---------------------------------------------------------------------------------------------

typedef struct tss__io_cells {
    int count;
    int **node, **region;
} tss__io_cells;

static tss__io_cells tss__io_mesh_cells(tss_mesh *m, int kind) {
    tss__io_cells c;
    c.count = kind == 3 ? m->tets : kind == 2 ? m->triangles : kind == 1 ? m->edges : m->points;
    c.node = kind == 3 ? &m->tet : kind == 2 ? &m->triangle : kind == 1 ? &m->edge : &m->point;
    c.region = kind == 3   ? &m->tet_region
               : kind == 2 ? &m->triangle_region
               : kind == 1 ? &m->edge_region
                           : &m->point_region;
    return c;
}

// The same for reading only.
static tss__io_cells tss__io_mesh_view(const tss_mesh *m, int kind) {
    return tss__io_mesh_cells((tss_mesh *)(uintptr_t)m, kind);
}

static void *tss__io_zeros(const tss_host *host, size_t bytes) {
    void *p = tss_alloc(host, bytes);
    if (p) memset(p, 0, bytes);
    return p;
}

void tss_mesh_free(tss_mesh *m) {
    if (!m) return;
    size_t n = (size_t)m->nodes;
    tss_free(&m->host, m->x, n * 3 * sizeof *m->x);
    tss_free(&m->host, m->node_marker, n * sizeof(int));
    for (int k = 0; k < 4; k++) {
        tss__io_cells c = tss__io_mesh_cells(m, k);
        tss_free(&m->host, *c.node, (size_t)c.count * (size_t)(k + 1) * sizeof(int));
        tss_free(&m->host, *c.region, (size_t)c.count * sizeof(int));
    }
    memset(m, 0, sizeof *m);
}

tss_result tss_mesh_alloc(const tss_host *host, int dim, int nodes, int tets, int triangles,
                          int edges, int points, tss_mesh *out) {
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    int count[5] = {points, edges, triangles, tets, nodes};
    if (dim != 2 && dim != 3) return TSS_ERROR_BAD_ARGUMENT;
    for (int k = 0; k < 5; k++)
        if (count[k] < 0 || count[k] > TSS__IO_MESH_MAX) return TSS_ERROR_BAD_ARGUMENT;
    out->host = host ? *host : tss_host_default();
    out->dim = dim;
    out->nodes = nodes, out->tets = tets, out->triangles = triangles;
    out->edges = edges, out->points = points;
    size_t n = (size_t)nodes;
    out->x = (double *)tss__io_zeros(&out->host, n * 3 * sizeof(double));
    out->node_marker = (int *)tss__io_zeros(&out->host, n * sizeof(int));
    int ok = !n || (out->x && out->node_marker);
    for (int k = 0; k < 4; k++) {
        tss__io_cells c = tss__io_mesh_cells(out, k);
        size_t m = (size_t)c.count;
        *c.node = (int *)tss__io_zeros(&out->host, m * (size_t)(k + 1) * sizeof(int));
        *c.region = (int *)tss__io_zeros(&out->host, m * sizeof(int));
        ok = ok && (!m || (*c.node && *c.region));
    }
    if (ok) return TSS_OK;
    tss_mesh_free(out);
    return TSS_ERROR_NO_MEMORY;
}

// ---------------------------------------------------------------------------------------------
// >>io_sort (private)
// Heapsort: in place, no memory, O(n log n) always; ties are told apart by the comparison, so that
// the result does not depend on the method. compare is "a before b".
// ---------------------------------------------------------------------------------------------

typedef int tss__io_before(const void *a, const void *b);

static void tss__io_swap(char *a, char *b, size_t size) {
    char t[64];
    memcpy(t, a, size);
    memcpy(a, b, size);
    memcpy(b, t, size);
}

static void tss__io_sift(char *p, size_t i, size_t n, size_t size, tss__io_before *before) {
    for (size_t c; (c = 2 * i + 1) < n; i = c) {
        if (c + 1 < n && before(p + c * size, p + (c + 1) * size)) c++;
        if (!before(p + i * size, p + c * size)) return;
        tss__io_swap(p + i * size, p + c * size, size);
    }
}

// size <= 64. Input that is in order already (the usual case) costs one pass.
static void tss__io_sort(void *array, size_t n, size_t size, tss__io_before *before) {
    char *p = (char *)array;
    size_t i = 1;
    while (i < n && !before(p + i * size, p + (i - 1) * size)) i++;
    if (i >= n) return;
    for (i = n / 2; i-- > 0;) tss__io_sift(p, i, n, size, before);
    for (i = n; i-- > 1;) {
        tss__io_swap(p, p + i * size, size);
        tss__io_sift(p, 0, i, size, before);
    }
}

// ---------------------------------------------------------------------------------------------
// >>io_number (private)
// Decimal to double, correctly rounded, without strtod (which obeys LC_NUMERIC).
// Fast: at most 2^53 as integer and |e| <= 22: one exact product or quotient (Clinger 1990).
// Else: a guess in floating point, within a few units, is walked to the answer by comparing the
// decimal N·10^e with the midpoint (2m+1)·2^(q-1) between neighbours in exact integers.
// Past 768 digits a decimal cannot be nearer to a midpoint than its prefix: the tail is replaced by
// one digit that says "more".
// ---------------------------------------------------------------------------------------------

#define TSS__IO_BIG_WORDS 160  // 5120 bits: 10^800 shifted by 1075, with room
#define TSS__IO_DIGITS 800     // significant digits kept, > 768

typedef struct tss__io_big {
    int n;
    uint32_t w[TSS__IO_BIG_WORDS];  // little-endian
} tss__io_big;

// b = b·m + a
static void tss__io_big_muladd(tss__io_big *b, uint32_t m, uint32_t a) {
    uint64_t carry = a;
    for (int i = 0; i < b->n; i++) {
        carry += (uint64_t)b->w[i] * m;
        b->w[i] = (uint32_t)carry;
        carry >>= 32;
    }
    if (carry && b->n < TSS__IO_BIG_WORDS) b->w[b->n++] = (uint32_t)carry;
}

static void tss__io_big_pow5(tss__io_big *b, int e) {
    for (; e >= 13; e -= 13) tss__io_big_muladd(b, 1220703125u, 0);
    for (; e > 0; e--) tss__io_big_muladd(b, 5, 0);
}

static void tss__io_big_shift(tss__io_big *b, int bits) {
    int words = bits / 32;
    if (!b->n || b->n + words > TSS__IO_BIG_WORDS) return;
    memmove(b->w + words, b->w, (size_t)b->n * sizeof b->w[0]);
    memset(b->w, 0, (size_t)words * sizeof b->w[0]);
    b->n += words;
    tss__io_big_muladd(b, (uint32_t)1 << (bits % 32), 0);
}

static int tss__io_big_compare(const tss__io_big *a, const tss__io_big *b) {
    if (a->n != b->n) return a->n < b->n ? -1 : 1;
    for (int i = a->n - 1; i >= 0; i--)
        if (a->w[i] != b->w[i]) return a->w[i] < b->w[i] ? -1 : 1;
    return 0;
}

typedef struct tss__io_decimal {
    int negative, count;
    int64_t exponent;  // value = digits · 10^exponent
    unsigned char digit[TSS__IO_DIGITS + 1];
} tss__io_decimal;

// Sign of N·10^e − (2m+1)·2^(q-1), where z = m·2^q has the given bits (z >= 0).
static int tss__decimal_vs_midpoint(const tss__io_big *N, int e, uint64_t bits) {
    uint64_t m = bits & (((uint64_t)1 << 52) - 1);
    int q = (int)(bits >> 52);
    if (q) m |= (uint64_t)1 << 52;
    q = (q ? q : 1) - 1075;
    m = 2 * m + 1;
    tss__io_big a = *N, b;
    b.n = 2;
    b.w[0] = (uint32_t)m, b.w[1] = (uint32_t)(m >> 32);
    if (!b.w[1]) b.n = 1;
    if (e >= 0)
        tss__io_big_pow5(&a, e);
    else
        tss__io_big_pow5(&b, -e);
    int shift = q - 1 - e;
    if (shift >= 0)
        tss__io_big_shift(&b, shift);
    else
        tss__io_big_shift(&a, -shift);
    return tss__io_big_compare(&a, &b);
}

// 10^e by steps of an exact power; off by a few units, or inf, or 0.
static double tss__io_scale10(double v, int e) {
    static const double p[23] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,
                                 1e8,  1e9,  1e10, 1e11, 1e12, 1e13, 1e14, 1e15,
                                 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};
    for (; e > 22; e -= 22) v *= p[22];
    for (; e < -22; e += 22) v /= p[22];
    return e < 0 ? v / p[-e] : v * p[e];
}

// A nonzero decimal between 1e-330 and 1e310 to its nearest double >= 0 (inf: overflow).
static double tss__decimal_round(const tss__io_decimal *d) {
    uint64_t lead = 0, bits;
    int used = 0, e = (int)d->exponent;
    for (; used < d->count && used < 18; used++) lead = lead * 10 + d->digit[used];
    double z = tss__io_scale10((double)lead, e + d->count - used);
    if (d->count <= 18 && lead <= ((uint64_t)1 << 53) && e >= -22 && e <= 22) return z;
    tss__io_big N;
    N.n = 0;
    for (int i = 0; i < d->count; i++) tss__io_big_muladd(&N, 10, d->digit[i]);
    const uint64_t infinity = (uint64_t)0x7ff << 52;
    memcpy(&bits, &z, sizeof bits);
    if (bits >= infinity) bits = infinity - 1;
    for (;;) {
        int above = tss__decimal_vs_midpoint(&N, e, bits);
        if (above > 0 || (above == 0 && (bits & 1))) {
            if (++bits == infinity) break;
            continue;
        }
        if (!bits) break;
        int below = tss__decimal_vs_midpoint(&N, e, bits - 1);
        if (below > 0 || (below == 0 && !(bits & 1))) break;
        bits--;
    }
    memcpy(&z, &bits, sizeof z);
    return z;
}

// One digit of the significand; leading zeros are not kept, what is past the room is summarised.
static void tss__decimal_add(tss__io_decimal *d, unsigned char digit, int fraction) {
    if (fraction) d->exponent--;
    if (!d->count && !digit) return;
    if (d->count < TSS__IO_DIGITS) {
        d->digit[d->count++] = digit;
        return;
    }
    d->exponent++;
    if (digit) d->digit[TSS__IO_DIGITS] = 1;
}

static int tss__io_is_digit(char c) { return c >= '0' && c <= '9'; }

// Splits the text; 0 unless all of it is a number.
static int tss__decimal_scan(tss__io_decimal *d, const char *s, const char *end) {
    int any = 0;
    d->negative = d->count = 0;
    d->exponent = 0;
    d->digit[TSS__IO_DIGITS] = 0;
    if (s < end && (*s == '-' || *s == '+')) d->negative = *s++ == '-';
    for (; s < end && tss__io_is_digit(*s); s++, any = 1)
        tss__decimal_add(d, (unsigned char)(*s - '0'), 0);
    if (s < end && *s == '.')
        for (s++; s < end && tss__io_is_digit(*s); s++, any = 1)
            tss__decimal_add(d, (unsigned char)(*s - '0'), 1);
    if (!any) return 0;
    // d and D are Fortran's exponents
    if (s < end && (*s == 'e' || *s == 'E' || *s == 'd' || *s == 'D')) {
        int64_t e = 0;
        int minus = 0;
        if (++s < end && (*s == '-' || *s == '+')) minus = *s++ == '-';
        if (s >= end) return 0;
        for (; s < end && tss__io_is_digit(*s); s++)
            if (e < ((int64_t)1 << 40)) e = e * 10 + (*s - '0');
        d->exponent += minus ? -e : e;
    }
    if (d->count == TSS__IO_DIGITS && d->digit[TSS__IO_DIGITS]) {
        d->count++;
        d->exponent--;
    }
    return s == end;
}

tss_result tss_parse_double(const char *text, size_t size, double *value) {
    tss__io_decimal d;
    if (!text || !value || !tss__decimal_scan(&d, text, text + size)) return TSS_ERROR_FORMAT;
    double z = 0;
    // 10^330 and 10^-330 are far outside the range of a double
    if (d.count && d.exponent + d.count > 330) return TSS_ERROR_FORMAT;
    if (d.count && d.exponent + d.count > -330) z = tss__decimal_round(&d);
    if (z > 1.7976931348623157e308) return TSS_ERROR_FORMAT;
    *value = d.negative ? -z : z;
    return TSS_OK;
}

int tss_format_double(double value, char *text) {
    for (int digits = 15;; digits++) {
        // snprintf writes the locale's decimal mark, possibly several bytes: make it one point
        char raw[64];
        snprintf(raw, sizeof raw, "%.*g", digits, value);
        int n = 0, mark = 0;
        for (const char *c = raw; *c && n < 31; c++) {
            int plain = tss__io_is_digit(*c) || *c == '-' || *c == '+' || (*c >= 'a' && *c <= 'z');
            if (plain)
                text[n++] = *c, mark = 0;
            else if (!mark)
                text[n++] = '.', mark = 1;
        }
        text[n] = 0;
        double back;
        if (digits == 17 || value - value != 0 ||
            (tss_parse_double(text, (size_t)n, &back) == TSS_OK && back == value))
            return n;
    }
}

// ---------------------------------------------------------------------------------------------
// >>io_input (private)
// A cursor over a file in memory, with the line it is on, and the mesh being built. Readers return
// 1, or 0 after the first failure, whose place and reason are in the error.
// ---------------------------------------------------------------------------------------------

typedef struct tss__io_grow {
    char *p;
    size_t used, room;  // bytes
} tss__io_grow;

typedef struct tss__io {
    tss_host host;
    const char *name;
    const unsigned char *begin, *at, *end;
    long long line;
    int comments;   // '#' to the end of the line is a blank
    int by_line;    // numbers do not cross line ends (OBJ, TetGen)
    int continues;  // a backslash at the end of a line joins the next one (OBJ)
    int binary;     // numbers are raw bytes just now
    int no_lines;   // the file has binary parts: lines mean nothing
    int swap;       // raw numbers are in the other byte order
    int dim;
    tss_result status;
    tss_io_error *error;
    tss__io_grow x, marker, cell[4], region[4];
} tss__io;

static void tss__io_error_set(tss_io_error *e, const char *file, long long line, long long byte,
                              const char *message) {
    if (!e) return;
    size_t n = file ? strlen(file) : 0;
    // of a long path the end tells more than the beginning
    if (n >= sizeof e->file) file += n - (sizeof e->file - 1), n = sizeof e->file - 1;
    if (n) memcpy(e->file, file, n);
    e->file[n] = 0;
    e->line = line;
    e->byte = byte;
    snprintf(e->message, sizeof e->message, "%s", message);
}

static int tss__io_fail(tss__io *in, const char *format, ...) TSS__IO_FORMAT(2, 3);
static int tss__io_fail(tss__io *in, const char *format, ...) {
    if (in->status != TSS_OK) return 0;
    char text[256];
    va_list args;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    in->status = TSS_ERROR_FORMAT;
    tss__io_error_set(in->error, in->name, in->no_lines ? 0 : in->line, in->at - in->begin, text);
    return 0;
}

static int tss__io_no_memory(tss__io *in) {
    if (in->status != TSS_OK) return 0;
    in->status = TSS_ERROR_NO_MEMORY;
    tss__io_error_set(in->error, in->name, 0, -1, "out of memory");
    return 0;
}

static int tss__io_grow_add(tss__io *in, tss__io_grow *g, const void *data, size_t bytes) {
    if (g->room - g->used < bytes) {
        size_t room = g->room + g->room / 2 + bytes + 256;
        char *p = (char *)tss_alloc(&in->host, room);
        if (!p) return tss__io_no_memory(in);
        if (g->used) memcpy(p, g->p, g->used);
        tss_free(&in->host, g->p, g->room);
        g->p = p;
        g->room = room;
    }
    memcpy(g->p + g->used, data, bytes);
    g->used += bytes;
    return 1;
}

static void tss__io_grow_free(tss__io *in, tss__io_grow *g) {
    tss_free(&in->host, g->p, g->room);
    memset(g, 0, sizeof *g);
}

static int tss__io_nodes(const tss__io *in) { return (int)(in->x.used / (3 * sizeof(double))); }

static int tss__io_add_node(tss__io *in, const double x[3], int marker) {
    if (tss__io_nodes(in) >= TSS__IO_MESH_MAX) return tss__io_fail(in, "too many nodes");
    return tss__io_grow_add(in, &in->x, x, 3 * sizeof *x) &&
           tss__io_grow_add(in, &in->marker, &marker, sizeof marker);
}

static int tss__io_add_cell(tss__io *in, int kind, const int *node, int region) {
    if (in->region[kind].used / sizeof(int) >= TSS__IO_MESH_MAX)
        return tss__io_fail(in, "too many cells");
    return tss__io_grow_add(in, &in->cell[kind], node, (size_t)(kind + 1) * sizeof *node) &&
           tss__io_grow_add(in, &in->region[kind], &region, sizeof region);
}

static size_t tss__io_left(const tss__io *in) { return (size_t)(in->end - in->at); }

static void tss__io_skip_line(tss__io *in) {
    while (in->at < in->end && *in->at != '\n') in->at++;
}

// Blanks inside a line; 1 when nothing but a comment is left of it.
static int tss__io_blank(tss__io *in) {
    for (; in->at < in->end; in->at++) {
        if (in->continues && *in->at == '\\') {
            const unsigned char *p = in->at + 1;
            if (p < in->end && *p == '\r') p++;
            if (p == in->end || *p != '\n') break;
            in->at = p;
            in->line++;
        } else if (*in->at == '\n' || *in->at > ' ') {
            break;
        }
    }
    if (in->comments && in->at < in->end && *in->at == '#') tss__io_skip_line(in);
    return in->at == in->end || *in->at == '\n';
}

// All blanks; 1 at the end of the file.
static int tss__io_space(tss__io *in) {
    while (tss__io_blank(in)) {
        if (in->at == in->end) return 1;
        in->at++;
        in->line++;
    }
    return 0;
}

static size_t tss__io_token(const tss__io *in) {
    const unsigned char *p = in->at;
    while (p<in->end && * p> ' ') p++;
    return (size_t)(p - in->at);
}

static int tss__io_is(const tss__io *in, const char *word) {
    size_t n = strlen(word);
    return tss__io_token(in) == n && !memcmp(in->at, word, n);
}

// "expected X, found 'Y'": Y is cut to 40 bytes and its odd bytes are shown as ?.
static int tss__io_expected(tss__io *in, const char *what) {
    char found[48];
    size_t n = tss__io_token(in);
    if (in->at == in->end) return tss__io_fail(in, "expected %s, found end of file", what);
    if (*in->at == '\n') return tss__io_fail(in, "expected %s, found end of line", what);
    n = n < 40 ? n : 40;
    for (size_t i = 0; i < n; i++)
        found[i] = in->at[i] < 127 && in->at[i] >= ' ' ? (char)in->at[i] : '?';
    found[n] = 0;
    return tss__io_fail(in, "expected %s, found '%s'", what, found);
}

static int tss__io_word(tss__io *in, const char *word) {
    tss__io_space(in);
    if (!tss__io_is(in, word)) return tss__io_expected(in, word);
    in->at += strlen(word);
    return 1;
}

// Before a number in text.
static int tss__io_next(tss__io *in, const char *what) {
    if (in->by_line ? tss__io_blank(in) : tss__io_space(in)) return tss__io_expected(in, what);
    return 1;
}

// Digits with a sign, up to stop (a byte that may end the number besides a blank).
static int tss__io_int_text(tss__io *in, const char *what, int stop, long long *v) {
    const unsigned char *p = in->at;
    int minus = 0, digits = 0;
    long long n = 0;
    if (p < in->end && (*p == '-' || *p == '+')) minus = *p++ == '-';
    for (; p < in->end && tss__io_is_digit((char)*p); p++, digits++) {
        if (n > (LLONG_MAX - 9) / 10) return tss__io_expected(in, what);
        n = n * 10 + (*p - '0');
    }
    if (!digits || (p<in->end && * p> ' ' && *p != stop)) return tss__io_expected(in, what);
    in->at = p;
    *v = minus ? -n : n;
    return 1;
}

// Turns the bytes of one number (1, 2, 4 or 8 of them) around.
static void tss__io_turn(unsigned char *p, size_t bytes) {
    uint64_t v = 0;
    for (size_t i = 0; i < bytes; i++) v = v << 8 | p[i];
    for (size_t i = 0; i < bytes; i++, v >>= 8) p[i] = (unsigned char)(v & 255);
}

// bytes raw bytes, in this machine's order, to `to`.
static int tss__io_raw(tss__io *in, const char *what, size_t bytes, void *to) {
    unsigned char *out = (unsigned char *)to;
    if (tss__io_left(in) < bytes)
        return tss__io_fail(in, "expected %s (%d bytes), found end of file", what, (int)bytes);
    memcpy(out, in->at, bytes);
    if (in->swap) tss__io_turn(out, bytes);
    in->at += bytes;
    return 1;
}

// An integer: a token, or bytes (4 or 8) raw ones.
static int tss__io_int(tss__io *in, const char *what, int bytes, long long *v) {
    if (!in->binary) return tss__io_next(in, what) && tss__io_int_text(in, what, 0, v);
    if (bytes == 4) {
        int32_t i = 0;
        if (!tss__io_raw(in, what, 4, &i)) return 0;
        *v = i;
        return 1;
    }
    int64_t i = 0;
    if (!tss__io_raw(in, what, 8, &i)) return 0;
    *v = i;
    return 1;
}

// An integer that must fit an int and lie in [low, high].
static int tss__io_int_in(tss__io *in, const char *what, long long low, long long high, int *v) {
    const unsigned char *start;
    long long n;
    if (!in->binary && !tss__io_next(in, what)) return 0;
    start = in->at;
    if (!tss__io_int(in, what, 4, &n)) return 0;
    if (n < low || n > high) {
        in->at = start;
        return tss__io_fail(in, "expected %s from %lld to %lld, found %lld", what, low, high, n);
    }
    *v = (int)n;
    return 1;
}

static int tss__io_finite(tss__io *in, const char *what, double v) {
    return v - v == 0 || tss__io_fail(in, "expected %s, found inf or nan", what);
}

static int tss__io_real(tss__io *in, const char *what, double *v) {
    if (in->binary) return tss__io_raw(in, what, 8, v) && tss__io_finite(in, what, *v);
    if (!tss__io_next(in, what)) return 0;
    size_t n = tss__io_token(in);
    if (tss_parse_double((const char *)in->at, n, v) != TSS_OK) return tss__io_expected(in, what);
    in->at += n;
    return 1;
}

// n records of at least `bytes` bytes each must fit into what is left of the file.
static int tss__io_count(tss__io *in, const char *what, long long n, size_t bytes) {
    size_t left = tss__io_left(in) + (in->binary ? 0 : 1);
    if (n < 0) return tss__io_fail(in, "expected a number of %s, found %lld", what, n);
    if (n > TSS__IO_MESH_MAX)
        return tss__io_fail(in, "%lld %s are more than an int counts", n, what);
    if (bytes && (size_t)n > left / bytes)
        return tss__io_fail(in, "%lld %s announced, but only %lld bytes follow", n, what,
                            (long long)tss__io_left(in));
    return 1;
}

// The parts become a mesh with arrays of exact size.
static tss_result tss__io_finish(tss__io *in, tss_mesh *out) {
    if (in->status != TSS_OK) return in->status;
    int n[4], nodes = tss__io_nodes(in);
    for (int k = 0; k < 4; k++) n[k] = (int)(in->region[k].used / sizeof(int));
    int only_nodes = !n[0] && !n[1] && !n[2] && !n[3];
    if (only_nodes) n[0] = nodes;
    tss_result r = tss_mesh_alloc(&in->host, in->dim, nodes, n[3], n[2], n[1], n[0], out);
    if (r != TSS_OK) {
        tss__io_no_memory(in);
        return r;
    }
    if (nodes) {
        memcpy(out->x, in->x.p, in->x.used);
        memcpy(out->node_marker, in->marker.p, in->marker.used);
    }
    for (int k = only_nodes ? 4 : 0; k < 4; k++) {
        tss__io_cells c = tss__io_mesh_cells(out, k);
        if (!c.count) continue;
        memcpy(*c.node, in->cell[k].p, in->cell[k].used);
        memcpy(*c.region, in->region[k].p, in->region[k].used);
    }
    for (int i = 0; only_nodes && i < nodes; i++) out->point[i] = i;
    return TSS_OK;
}

static void tss__io_close(tss__io *in) {
    tss__io_grow_free(in, &in->x);
    tss__io_grow_free(in, &in->marker);
    for (int k = 0; k < 4; k++) {
        tss__io_grow_free(in, &in->cell[k]);
        tss__io_grow_free(in, &in->region[k]);
    }
}

static void tss__io_open(tss__io *in, const char *name, const void *data, size_t size) {
    in->name = name;
    in->begin = in->at = (const unsigned char *)data;
    in->end = in->begin + size;
    in->line = 1;
}

// ---------------------------------------------------------------------------------------------
// >>io_gmsh (private)
// Gmsh reference manual, "MSH file format" (4.1) and "MSH file format version 2 (Legacy)". Text and
// binary files differ only in how a number is read, so one reader serves both.
// Node tags may be sparse and in any order: (tag, index) pairs, sorted unless they are already.
// ---------------------------------------------------------------------------------------------

typedef struct tss__io_tag {
    int64_t tag;
    int index;
} tss__io_tag;

typedef struct tss__io_entity {
    int dim, tag, physical;
} tss__io_entity;

typedef struct tss__gmsh {
    int version;  // 2 or 4
    int binary;
    int word;  // bytes of a size_t in a 4.1 file
    int has_nodes, has_elements;
    tss__io_grow tag, entity;
} tss__gmsh;

static int tss__tag_before(const void *a, const void *b) {
    const tss__io_tag *p = (const tss__io_tag *)a, *q = (const tss__io_tag *)b;
    return p->tag != q->tag ? p->tag < q->tag : p->index < q->index;
}

static int tss__entity_before(const void *a, const void *b) {
    const tss__io_entity *p = (const tss__io_entity *)a, *q = (const tss__io_entity *)b;
    return p->dim != q->dim ? p->dim < q->dim : p->tag < q->tag;
}

static int tss__gmsh_format(tss__io *in, tss__gmsh *g) {
    double version;
    long long binary, word;
    if (!tss__io_next(in, "the format's version")) return 0;
    const unsigned char *start = in->at;
    if (!tss__io_real(in, "the format's version", &version)) return 0;
    if (!(version >= 2 && version < 2.3) && !(version > 4.05 && version < 4.15)) {
        in->at = start;
        return tss__io_expected(in, "Gmsh format 2.2 or 4.1");
    }
    g->version = version < 3 ? 2 : 4;
    if (!tss__io_int(in, "the file type (0 or 1)", 4, &binary)) return 0;
    if (binary != 0 && binary != 1)
        return tss__io_fail(in, "expected the file type (0 or 1), found %lld", binary);
    if (!tss__io_int(in, "the data size", 4, &word)) return 0;
    if (word != 8 && (word != 4 || g->version == 2))
        return tss__io_fail(in, "expected data size 8, found %lld", word);
    g->word = (int)word;
    g->binary = (int)binary;
    return 1;
}

// What follows the line of a section's name is raw bytes in a binary file.
static int tss__gmsh_begin(tss__io *in, const tss__gmsh *g) {
    if (!g->binary) return 1;
    if (!tss__io_blank(in)) return tss__io_expected(in, "the end of the line");
    if (in->at == in->end) return tss__io_expected(in, "binary data");
    in->at++;
    in->binary = in->no_lines = 1;
    return 1;
}

// The byte order shows in the number 1 after the format.
static int tss__gmsh_endian(tss__io *in, const tss__gmsh *g) {
    int32_t one = 0;
    if (!g->binary) return 1;
    if (!tss__gmsh_begin(in, g) || !tss__io_raw(in, "the number 1", 4, &one)) return 0;
    if (one == 0x01000000)
        in->swap = 1;
    else if (one != 1)
        return tss__io_fail(in, "expected the number 1, found %d", (int)one);
    in->binary = 0;
    return 1;
}

// First physical group of an entity's list, and the list skipped.
static int tss__gmsh_physicals(tss__io *in, const tss__gmsh *g, int *physical) {
    long long n, tag;
    if (!tss__io_int(in, "a number of physical groups", g->word, &n) ||
        !tss__io_count(in, "physical groups", n, in->binary ? 4 : 2))
        return 0;
    for (long long i = 0; i < n; i++) {
        if (!tss__io_int(in, "a physical group", 4, &tag)) return 0;
        if (i == 0 && tag >= INT_MIN && tag <= INT_MAX) *physical = (int)tag;
    }
    return 1;
}

static int tss__gmsh_entity(tss__io *in, tss__gmsh *g, int dim) {
    tss__io_entity e;
    long long tag, n;
    double box;
    memset(&e, 0, sizeof e);
    if (!tss__io_int_in(in, "an entity's tag", INT_MIN, INT_MAX, &e.tag)) return 0;
    e.dim = dim;
    for (int i = 0; i < (dim ? 6 : 3); i++)
        if (!tss__io_real(in, "an entity's bounding box", &box)) return 0;
    if (!tss__gmsh_physicals(in, g, &e.physical)) return 0;
    if (dim) {
        if (!tss__io_int(in, "a number of bounding entities", g->word, &n) ||
            !tss__io_count(in, "bounding entities", n, in->binary ? 4 : 2))
            return 0;
        for (long long i = 0; i < n; i++)
            if (!tss__io_int(in, "a bounding entity", 4, &tag)) return 0;
    }
    return tss__io_grow_add(in, &g->entity, &e, sizeof e);
}

static int tss__gmsh_entities(tss__io *in, tss__gmsh *g) {
    long long n[4];
    for (int d = 0; d < 4; d++)
        if (!tss__io_int(in, "a number of entities", g->word, &n[d]) ||
            !tss__io_count(in, "entities", n[d], in->binary ? 32 : 10))
            return 0;
    for (int d = 0; d < 4; d++)
        for (long long i = 0; i < n[d]; i++)
            if (!tss__gmsh_entity(in, g, d)) return 0;
    tss__io_sort(g->entity.p, g->entity.used / sizeof(tss__io_entity), sizeof(tss__io_entity),
                 tss__entity_before);
    return 1;
}

// The region of an entity: its physical group, else its own tag.
static int tss__gmsh_region(const tss__gmsh *g, int dim, int tag) {
    const tss__io_entity *e = (const tss__io_entity *)(const void *)g->entity.p;
    tss__io_entity key = {dim, tag, 0};
    size_t a = 0, b = g->entity.used / sizeof *e;
    while (a < b) {
        size_t m = (a + b) / 2;
        if (tss__entity_before(&e[m], &key))
            a = m + 1;
        else
            b = m;
    }
    if (a < g->entity.used / sizeof *e && e[a].dim == dim && e[a].tag == tag && e[a].physical)
        return e[a].physical;
    return tag;
}

static int tss__gmsh_add_tag(tss__io *in, tss__gmsh *g, long long tag) {
    tss__io_tag t;
    memset(&t, 0, sizeof t);
    t.tag = tag;
    t.index = (int)(g->tag.used / sizeof t);
    return tss__io_grow_add(in, &g->tag, &t, sizeof t);
}

static int tss__gmsh_node(tss__io *in, int parameters) {
    double x[3], unused;
    for (int c = 0; c < 3; c++)
        if (!tss__io_real(in, "a coordinate", &x[c])) return 0;
    for (int c = 0; c < parameters; c++)
        if (!tss__io_real(in, "a parametric coordinate", &unused)) return 0;
    return tss__io_add_node(in, x, 0);
}

static int tss__gmsh_nodes2(tss__io *in, tss__gmsh *g) {
    long long n, tag;
    in->binary = 0;  // the count is text in either case
    if (!tss__io_int(in, "the number of nodes", 4, &n)) return 0;
    if (!tss__gmsh_begin(in, g) || !tss__io_count(in, "nodes", n, g->binary ? 28 : 8)) return 0;
    for (long long i = 0; i < n; i++)
        if (!tss__io_int(in, "a node's number", 4, &tag) || !tss__gmsh_add_tag(in, g, tag) ||
            !tss__gmsh_node(in, 0))
            return 0;
    return 1;
}

// A 4.1 block header: dimension and tag of the entity, a third number, the count.
static int tss__gmsh_block(tss__io *in, const tss__gmsh *g, const char *what, int *dim, int *tag,
                           int *third, long long *n) {
    return tss__io_int_in(in, "an entity's dimension", 0, 3, dim) &&
           tss__io_int_in(in, "an entity's tag", INT_MIN, INT_MAX, tag) &&
           tss__io_int_in(in, what, 0, 1000, third) &&
           tss__io_int(in, "a block's count", g->word, n);
}

// The four numbers that open $Nodes and $Elements of 4.1; the tags' range is not needed.
static int tss__gmsh_totals(tss__io *in, const tss__gmsh *g, const char *what, long long *blocks,
                            long long *total) {
    long long low, high;
    return tss__io_int(in, "a number of blocks", g->word, blocks) &&
           tss__io_int(in, "a total", g->word, total) &&
           tss__io_int(in, "the smallest tag", g->word, &low) &&
           tss__io_int(in, "the largest tag", g->word, &high) &&
           tss__io_count(in, "blocks", *blocks, in->binary ? 16 : 8) &&
           tss__io_count(in, what, *total, in->binary ? 8 : 4);
}

static int tss__gmsh_nodes4(tss__io *in, tss__gmsh *g) {
    long long blocks, total, n, tag;
    int dim = 0, entity, parametric;
    if (!tss__gmsh_totals(in, g, "nodes", &blocks, &total)) return 0;
    for (long long b = 0; b < blocks; b++) {
        if (!tss__gmsh_block(in, g, "the flag 'parametric'", &dim, &entity, &parametric, &n) ||
            !tss__io_count(in, "nodes", n, in->binary ? 24u + (size_t)g->word : 8))
            return 0;
        if (n > total - tss__io_nodes(in))
            return tss__io_fail(in, "more nodes in the blocks than the %lld announced", total);
        for (long long i = 0; i < n; i++)
            if (!tss__io_int(in, "a node's tag", g->word, &tag) || !tss__gmsh_add_tag(in, g, tag))
                return 0;
        for (long long i = 0; i < n; i++)
            if (!tss__gmsh_node(in, parametric ? dim : 0)) return 0;
    }
    if (tss__io_nodes(in) != total)
        return tss__io_fail(in, "expected %lld nodes, found %d", total, tss__io_nodes(in));
    return 1;
}

static int tss__gmsh_sort_tags(tss__io *in, tss__gmsh *g) {
    tss__io_tag *t = (tss__io_tag *)(void *)g->tag.p;
    size_t n = g->tag.used / sizeof *t;
    tss__io_sort(t, n, sizeof *t, tss__tag_before);
    for (size_t i = 1; i < n; i++)
        if (t[i].tag == t[i - 1].tag)
            return tss__io_fail(in, "node %lld is defined twice", (long long)t[i].tag);
    return 1;
}

static int tss__gmsh_find(const tss__gmsh *g, long long tag) {
    const tss__io_tag *t = (const tss__io_tag *)(const void *)g->tag.p;
    size_t n = g->tag.used / sizeof *t, a = 0, b = n;
    if (!n || tag < t[0].tag || tag > t[n - 1].tag) return -1;
    // consecutive tags, the usual case; the difference cannot overflow inside the range if unsigned
    uint64_t guess = (uint64_t)tag - (uint64_t)t[0].tag;
    if (guess < n && t[guess].tag == tag) return t[guess].index;
    while (a < b) {
        size_t m = (a + b) / 2;
        if (t[m].tag < tag)
            a = m + 1;
        else
            b = m;
    }
    return a < n && t[a].tag == tag ? t[a].index : -1;
}

// The kind of cell of a Gmsh element type, or −1 with a message.
static int tss__gmsh_kind(tss__io *in, int type) {
    switch (type) {
        case 15:
            return 0;
        case 1:
            return 1;
        case 2:
            return 2;
        case 4:
            return 3;
        default:
            break;
    }
    const char *name = type == 3    ? " (quadrangle)"
                       : type == 5  ? " (hexahedron)"
                       : type == 6  ? " (prism)"
                       : type == 7  ? " (pyramid)"
                       : type == 9  ? " (6-node triangle)"
                       : type == 11 ? " (10-node tetrahedron)"
                                    : "";
    tss__io_fail(in,
                 "element type %d%s is not supported: points, lines, triangles and tetrahedra "
                 "of first order are",
                 type, name);
    return -1;
}

static int tss__gmsh_cell(tss__io *in, const tss__gmsh *g, int kind, int bytes, int region) {
    int node[4];
    for (int c = 0; c <= kind; c++) {
        long long tag;
        if (!in->binary && !tss__io_next(in, "an element's node")) return 0;
        const unsigned char *start = in->at;
        if (!tss__io_int(in, "an element's node", bytes, &tag)) return 0;
        node[c] = tss__gmsh_find(g, tag);
        if (node[c] < 0) {
            in->at = start;
            return tss__io_fail(in, "an element names node %lld, which is not in $Nodes", tag);
        }
    }
    return tss__io_add_cell(in, kind, node, region);
}

// Tags of a 2.2 element: the physical group, the entity, then partitions.
static int tss__gmsh_tags2(tss__io *in, int n, int *region) {
    *region = 0;
    for (int i = 0; i < n; i++) {
        long long tag;
        if (!tss__io_int(in, "an element's tag", 4, &tag)) return 0;
        if (i < 2 && !*region && tag >= INT_MIN && tag <= INT_MAX) *region = (int)tag;
    }
    return 1;
}

// Text: number, type, tags, nodes. Binary: (type, how many, number of tags), then the elements.
static int tss__gmsh_elements2(tss__io *in, tss__gmsh *g) {
    long long n, number;
    in->binary = 0;
    if (!tss__io_int(in, "the number of elements", 4, &n)) return 0;
    if (!tss__gmsh_begin(in, g) || !tss__io_count(in, "elements", n, 8)) return 0;
    while (n > 0) {
        int type, run = 1, tags, kind, region;
        if (!in->binary && !tss__io_int(in, "an element's number", 4, &number)) return 0;
        if (!tss__io_int_in(in, "an element's type", 1, 1000, &type) ||
            (kind = tss__gmsh_kind(in, type)) < 0)
            return 0;
        if (in->binary && !tss__io_int_in(in, "a run of elements", 1, n, &run)) return 0;
        if (!tss__io_int_in(in, "a number of tags", 0, 10000, &tags)) return 0;
        for (int i = 0; i < run; i++, n--)
            if ((in->binary && !tss__io_int(in, "an element's number", 4, &number)) ||
                !tss__gmsh_tags2(in, tags, &region) || !tss__gmsh_cell(in, g, kind, 4, region))
                return 0;
    }
    return 1;
}

static int tss__gmsh_elements4(tss__io *in, tss__gmsh *g) {
    long long blocks, total, n, number, done = 0;
    int dim = 0, entity, type, kind;
    if (!tss__gmsh_totals(in, g, "elements", &blocks, &total)) return 0;
    for (long long b = 0; b < blocks; b++) {
        if (!tss__gmsh_block(in, g, "an element's type", &dim, &entity, &type, &n) ||
            !tss__io_count(in, "elements", n, in->binary ? 2u * (size_t)g->word : 4))
            return 0;
        if (!n) continue;
        if ((kind = tss__gmsh_kind(in, type)) < 0) return 0;
        if ((done += n) > total)
            return tss__io_fail(in, "more elements in the blocks than the %lld announced", total);
        int region = tss__gmsh_region(g, dim, entity);
        for (long long i = 0; i < n; i++)
            if (!tss__io_int(in, "an element's tag", g->word, &number) ||
                !tss__gmsh_cell(in, g, kind, g->word, region))
                return 0;
    }
    if (done != total) return tss__io_fail(in, "expected %lld elements, found %lld", total, done);
    return 1;
}

// To behind the line "$End..." of a section we do not read. In a binary file its bytes may contain
// anything, so the search is for the whole word.
static int tss__gmsh_skip(tss__io *in, const char *end) {
    size_t n = strlen(end);
    const unsigned char *start = in->at;
    long long line = in->line;
    for (; tss__io_left(in) >= n; in->at++) {
        if (*in->at == '$' && !memcmp(in->at, end, n) && tss__io_token(in) == n) {
            in->at += n;
            return 1;
        }
        if (*in->at == '\n') in->line++;
    }
    in->at = start;
    in->line = line;
    return tss__io_fail(in, "expected %s, found end of file", end);
}

static int tss__gmsh_known(tss__io *in, tss__gmsh *g, const char *section) {
    if (!strcmp(section, "$MeshFormat"))
        return g->version ? tss__io_fail(in, "$MeshFormat occurs twice")
                          : tss__gmsh_format(in, g) && tss__gmsh_endian(in, g);
    if (!g->version) return tss__io_fail(in, "expected $MeshFormat, found '%s'", section);
    if (!strcmp(section, "$Nodes")) {
        if (g->has_nodes++) return tss__io_fail(in, "$Nodes occurs twice");
        if (g->version == 2) return tss__gmsh_nodes2(in, g) && tss__gmsh_sort_tags(in, g);
        return tss__gmsh_begin(in, g) && tss__gmsh_nodes4(in, g) && tss__gmsh_sort_tags(in, g);
    }
    if (!strcmp(section, "$Elements")) {
        if (!g->has_nodes) return tss__io_fail(in, "expected $Nodes before $Elements");
        if (g->has_elements++) return tss__io_fail(in, "$Elements occurs twice");
        if (g->version == 2) return tss__gmsh_elements2(in, g);
        return tss__gmsh_begin(in, g) && tss__gmsh_elements4(in, g);
    }
    return tss__gmsh_begin(in, g) && tss__gmsh_entities(in, g);
}

static int tss__gmsh_section(tss__io *in, tss__gmsh *g) {
    char name[64], end[72];
    size_t n = tss__io_token(in);
    if (*in->at != '$' || n < 2 || n >= sizeof name || !memcmp(in->at, "$End", n < 4 ? n : 4))
        return tss__io_expected(in, "a section ($Nodes, $Elements, ...)");
    memcpy(name, in->at, n);
    name[n] = 0;
    in->at += n;
    snprintf(end, sizeof end, "$End%s", name + 1);
    int known = !strcmp(name, "$MeshFormat") || !strcmp(name, "$Nodes") ||
                !strcmp(name, "$Elements") || (!strcmp(name, "$Entities") && g->version == 4);
    if (!known) return tss__gmsh_skip(in, end);
    if (!tss__gmsh_known(in, g, name)) return 0;
    in->binary = 0;
    return tss__io_word(in, end);
}

// A flat mesh without tets is two-dimensional.
static int tss__gmsh_dim(const tss__io *in) {
    const double *x = (const double *)(const void *)in->x.p;
    int n = tss__io_nodes(in);
    if (in->region[3].used || !in->region[2].used) return 3;
    for (int i = 0; i < n; i++)
        if (x[3 * i + 2] != 0) return 3;
    return 2;
}

static int tss__read_gmsh(tss__io *in) {
    tss__gmsh g;
    memset(&g, 0, sizeof g);
    int ok = 1;
    while (ok && !tss__io_space(in)) ok = tss__gmsh_section(in, &g);
    if (ok && !g.version) tss__io_fail(in, "expected $MeshFormat, found end of file");
    if (ok && !g.has_nodes) tss__io_fail(in, "expected $Nodes, found end of file");
    // a mesh cut off between the sections must not pass for a set of points
    if (ok && !g.has_elements) tss__io_fail(in, "expected $Elements, found end of file");
    in->dim = tss__gmsh_dim(in);
    tss__io_grow_free(in, &g.tag);
    tss__io_grow_free(in, &g.entity);
    return in->status == TSS_OK;
}

// ---------------------------------------------------------------------------------------------
// >>io_medit (private)
// Keywords and numbers, '#' comments (Frey, INRIA RT-0253). Sections we do not know are skipped up
// to the next word, since all they hold is numbers.
// ---------------------------------------------------------------------------------------------

static int tss__medit_letter(const tss__io *in) {
    unsigned char c = *in->at;
    return (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z');
}

static int tss__medit_vertices(tss__io *in) {
    long long n;
    if (!in->dim) return tss__io_fail(in, "expected Dimension before Vertices");
    if (in->x.used) return tss__io_fail(in, "Vertices occurs twice");
    if (!tss__io_int(in, "the number of vertices", 4, &n) ||
        !tss__io_count(in, "vertices", n, (size_t)in->dim * 2 + 2))
        return 0;
    for (long long i = 0; i < n; i++) {
        double x[3] = {0, 0, 0};
        int reference;
        for (int c = 0; c < in->dim; c++)
            if (!tss__io_real(in, "a coordinate", &x[c])) return 0;
        if (!tss__io_int_in(in, "a vertex's reference", INT_MIN, INT_MAX, &reference) ||
            !tss__io_add_node(in, x, reference))
            return 0;
    }
    return 1;
}

static int tss__medit_cells(tss__io *in, int kind) {
    long long n;
    if (!tss__io_int(in, "a number of cells", 4, &n) ||
        !tss__io_count(in, "cells", n, (size_t)(kind + 2) * 2))
        return 0;
    for (long long i = 0; i < n; i++) {
        int node[4], reference;
        for (int c = 0; c <= kind; c++, node[c - 1]--)
            if (!tss__io_int_in(in, "a vertex's number", 1, tss__io_nodes(in), &node[c])) return 0;
        if (!tss__io_int_in(in, "a cell's reference", INT_MIN, INT_MAX, &reference) ||
            !tss__io_add_cell(in, kind, node, reference))
            return 0;
    }
    return 1;
}

// A section whose cells would be lost is an error unless it is empty.
static int tss__medit_refused(tss__io *in) {
    static const char *const refused[] = {"Quadrilaterals", "Hexahedra",   "Hexaedra",
                                          "Prisms",         "Pyramids",    "EdgesP2",
                                          "TrianglesP2",    "TetrahedraP2"};
    for (size_t i = 0; i < sizeof refused / sizeof *refused; i++) {
        long long n;
        if (!tss__io_is(in, refused[i])) continue;
        in->at += strlen(refused[i]);
        if (!tss__io_int(in, "a number of cells", 4, &n)) return 1;
        if (n) tss__io_fail(in, "%s are not supported", refused[i]);
        return 1;
    }
    return 0;
}

static int tss__medit_section(tss__io *in) {
    static const char *const cells[] = {"", "Edges", "Triangles", "Tetrahedra"};
    if (tss__io_is(in, "Dimension")) {
        if (in->dim) return tss__io_fail(in, "Dimension occurs twice");
        in->at += 9;
        return tss__io_int_in(in, "the dimension", 2, 3, &in->dim);
    }
    if (tss__io_is(in, "Vertices")) {
        in->at += 8;
        return tss__medit_vertices(in);
    }
    for (int k = 1; k < 4; k++)
        if (tss__io_is(in, cells[k])) {
            if (k > in->dim) return tss__io_fail(in, "%s in %d dimensions", cells[k], in->dim);
            in->at += strlen(cells[k]);
            return tss__medit_cells(in, k);
        }
    if (tss__medit_refused(in)) return in->status == TSS_OK;
    if (!tss__medit_letter(in)) return tss__io_expected(in, "a keyword");
    do in->at += tss__io_token(in);
    while (!tss__io_space(in) && !tss__medit_letter(in));
    return 1;
}

static int tss__read_medit(tss__io *in) {
    int version;
    in->comments = 1;
    if (tss__io_left(in) >= 4 && (!memcmp(in->at, "\1\0\0\0", 4) || !memcmp(in->at, "\0\0\0\1", 4)))
        return tss__io_fail(in, "binary Medit (.meshb) is not supported: save as ASCII .mesh");
    if (!tss__io_word(in, "MeshVersionFormatted") ||
        !tss__io_int_in(in, "the format's version", 1, 4, &version))
        return 0;
    int ended = 0;
    while (!tss__io_space(in) && !ended) {
        if (tss__io_is(in, "End"))
            ended = 1;
        else if (!tss__medit_section(in))
            return 0;
    }
    if (!in->dim) return tss__io_fail(in, "expected Dimension, found end of file");
    if (!in->x.used) return tss__io_fail(in, "expected Vertices, found end of file");
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>io_tetgen (private)
// TetGen's and Triangle's .node and .ele: a header line, then a line a record, '#' comments. The
// first node's number, 0 or 1, is the index base of both files.
// ---------------------------------------------------------------------------------------------

// To the next line that holds something.
static int tss__io_record(tss__io *in, const char *what) {
    if (tss__io_space(in)) return tss__io_expected(in, what);
    return 1;
}

static int tss__io_line_end(tss__io *in) {
    return tss__io_blank(in) || tss__io_expected(in, "the end of the line");
}

static int tss__tetgen_nodes(tss__io *in, int *base) {
    int n, attributes, markers = 0;
    if (!tss__io_record(in, "the number of nodes") ||
        !tss__io_int_in(in, "the number of nodes", 0, TSS__IO_MESH_MAX, &n) ||
        !tss__io_int_in(in, "the dimension", 2, 3, &in->dim) ||
        !tss__io_int_in(in, "the number of attributes", 0, 10000, &attributes))
        return 0;
    if (!tss__io_blank(in) && !tss__io_int_in(in, "the number of markers", 0, 1, &markers))
        return 0;
    if (!tss__io_line_end(in)) return 0;
    if (!tss__io_count(in, "nodes", n, (size_t)(2 + 2 * (in->dim + attributes + markers))))
        return 0;
    for (int i = 0; i < n; i++) {
        double x[3] = {0, 0, 0}, unused;
        int number, marker = 0;
        if (!tss__io_record(in, "a node's number")) return 0;
        if (!tss__io_int_in(in, i ? "the next node's number" : "the first node's number",
                            i ? i + *base : 0, i ? i + *base : 1, &number))
            return 0;
        if (!i) *base = number;
        for (int c = 0; c < in->dim; c++)
            if (!tss__io_real(in, "a coordinate", &x[c])) return 0;
        for (int c = 0; c < attributes; c++)
            if (!tss__io_real(in, "an attribute", &unused)) return 0;
        if (markers && !tss__io_int_in(in, "a marker", INT_MIN, INT_MAX, &marker)) return 0;
        if (!tss__io_line_end(in) || !tss__io_add_node(in, x, marker)) return 0;
    }
    return tss__io_space(in) || tss__io_expected(in, "the end of the file");
}

// Region attributes are reals in the format; anything but a small integer is rare.
static int tss__tetgen_region(double a) {
    a = floor(a + 0.5);
    return a >= INT_MAX ? INT_MAX : a <= INT_MIN ? INT_MIN : (int)a;
}

static int tss__tetgen_cells(tss__io *in, int base) {
    int n, corners, attributes, number, kind = in->dim;
    if (!tss__io_record(in, "the number of cells") ||
        !tss__io_int_in(in, "the number of cells", 0, TSS__IO_MESH_MAX, &n) ||
        !tss__io_int_in(in, "the nodes of a cell", 1, 10, &corners))
        return 0;
    if (corners != kind + 1)
        return tss__io_fail(in, "expected %d nodes a cell in %d dimensions, found %d", kind + 1,
                            in->dim, corners);
    if (!tss__io_int_in(in, "the number of attributes", 0, 10000, &attributes) ||
        !tss__io_line_end(in) ||
        !tss__io_count(in, "cells", n, (size_t)(2 + 2 * (corners + attributes))))
        return 0;
    for (int i = 0; i < n; i++) {
        int node[4];
        double a, first = 0;
        if (!tss__io_record(in, "a cell's number") ||
            !tss__io_int_in(in, "the next cell's number", i + base, i + base, &number))
            return 0;
        for (int c = 0; c < corners; c++) {
            if (!tss__io_int_in(in, "a node's number", base, base + tss__io_nodes(in) - 1,
                                &node[c]))
                return 0;
            node[c] -= base;
        }
        for (int c = 0; c < attributes; c++) {
            if (!tss__io_real(in, "an attribute", &a)) return 0;
            if (!c) first = a;
        }
        if (!tss__io_line_end(in) || !tss__io_add_cell(in, kind, node, tss__tetgen_region(first)))
            return 0;
    }
    return tss__io_space(in) || tss__io_expected(in, "the end of the file");
}

tss_result tss_mesh_parse_tetgen(const tss_host *host, const char *node_name, const void *node,
                                 size_t node_size, const char *ele_name, const void *ele,
                                 size_t ele_size, tss_mesh *out, tss_io_error *error) {
    tss__io in;
    int base = 0;
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    tss__io_error_set(error, node_name, 0, -1, "");
    if (!node) return TSS_ERROR_BAD_ARGUMENT;
    memset(&in, 0, sizeof in);
    in.host = host ? *host : tss_host_default();
    in.error = error;
    in.comments = in.by_line = 1;
    tss__io_open(&in, node_name, node, node_size);
    if (tss__tetgen_nodes(&in, &base) && ele) {
        tss__io_open(&in, ele_name, ele, ele_size);
        tss__tetgen_cells(&in, base);
    }
    tss_result r = tss__io_finish(&in, out);
    tss__io_close(&in);
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>io_obj (private)
// Wavefront OBJ, and .seg (the same with s for segments). Positive indices may point forward: the
// largest one and its line are remembered and checked at the end.
// ---------------------------------------------------------------------------------------------

typedef struct tss__obj {
    int segments;  // .seg
    int most;      // largest node index named, and the line that names it
    long long most_line;
} tss__obj;

static int tss__obj_vertex(tss__io *in) {
    double x[3], w;
    for (int c = 0; c < 3; c++)
        if (!tss__io_real(in, "a coordinate", &x[c])) return 0;
    // a weight, or a colour: checked, not used
    while (!tss__io_blank(in))
        if (!tss__io_real(in, "a number", &w)) return 0;
    return tss__io_add_node(in, x, 0);
}

// v, v/vt, v//vn or v/vt/vn: the node, 0-based.
static int tss__obj_index(tss__io *in, tss__obj *o, int *node) {
    long long v, unused;
    const char *what = "a vertex index";
    if (!tss__io_next(in, what)) return 0;
    const unsigned char *start = in->at;
    if (!tss__io_int_text(in, what, '/', &v)) return 0;
    for (int i = 0; i < 2 && in->at < in->end && *in->at == '/'; i++) {
        in->at++;
        int empty = in->at < in->end && *in->at == '/' && i == 0;
        if (!empty && !tss__io_int_text(in, "a texture or normal index", i ? 0 : '/', &unused))
            return 0;
    }
    if (in->at<in->end && * in->at> ' ') return tss__io_expected(in, "a blank");
    int nodes = tss__io_nodes(in);
    in->at = v == 0 || v > TSS__IO_MESH_MAX || v < -nodes ? start : in->at;
    if (v == 0) return tss__io_fail(in, "expected a vertex index from 1 (or negative), found 0");
    if (v > TSS__IO_MESH_MAX || v < -nodes)
        return tss__io_fail(in, "vertex index %lld, but there are %d vertices", v, nodes);
    *node = (int)(v > 0 ? v - 1 : nodes + v);
    if (*node > o->most || o->most < 0) o->most = *node, o->most_line = in->line;
    return 1;
}

// n >= least indices on the rest of the line: points, a polyline, or a polygon as a fan.
static int tss__obj_cells(tss__io *in, tss__obj *o, int kind) {
    int node[3] = {0, 0, 0}, last = 0, n = 0;
    for (; !tss__io_blank(in); n++) {
        if (!tss__obj_index(in, o, &last)) return 0;
        int add = n >= kind;
        node[n < kind ? n : kind] = last;
        if (add && !tss__io_add_cell(in, kind, node, 0)) return 0;
        if (add && kind) node[kind - 1] = last;
    }
    if (n <= kind)
        return tss__io_fail(in, "expected at least %d vertex indices, found %d", kind + 1, n);
    return 1;
}

static int tss__obj_ignored(const tss__io *in) {
    static const char *const words[] = {"vt",       "vn",       "vp",     "g",          "o",
                                        "s",        "mg",       "usemtl", "mtllib",     "lod",
                                        "usemap",   "cstype",   "maplib", "shadow_obj", "trace_obj",
                                        "c_interp", "d_interp", "bevel"};
    for (size_t i = 0; i < sizeof words / sizeof *words; i++)
        if (tss__io_is(in, words[i])) return 1;
    return 0;
}

static int tss__obj_line(tss__io *in, tss__obj *o) {
    static const char *const cells[] = {"p", "l", "f"};
    if (tss__io_is(in, "v")) {
        in->at++;
        return tss__obj_vertex(in);
    }
    for (int k = 0; k < 3; k++)
        if (tss__io_is(in, cells[k]) || (o->segments && k == 1 && tss__io_is(in, "s"))) {
            in->at++;
            return tss__obj_cells(in, o, k);
        }
    if (!tss__obj_ignored(in)) return tss__io_expected(in, "v, f, l, p or another OBJ keyword");
    tss__io_skip_line(in);
    return 1;
}

static int tss__read_obj(tss__io *in, int segments) {
    tss__obj o = {segments, -1, 0};
    in->comments = in->by_line = in->continues = 1;
    in->dim = 3;
    while (!tss__io_space(in))
        if (!tss__obj_line(in, &o)) return 0;
    if (o.most >= tss__io_nodes(in)) {
        in->line = o.most_line;
        return tss__io_fail(in, "vertex index %d, but there are %d vertices", o.most + 1,
                            tss__io_nodes(in));
    }
    return tss__io_nodes(in) || tss__io_fail(in, "expected vertices, found none");
}

// ---------------------------------------------------------------------------------------------
// >>io_ply (private)
// Stanford PLY 1.0: the header names elements and their properties; every value is read as a
// double, which holds all of PLY's types exactly.
// ---------------------------------------------------------------------------------------------

#define TSS__PLY_PROPERTIES 256
#define TSS__PLY_ELEMENTS 32

enum { TSS__PLY_OTHER, TSS__PLY_X, TSS__PLY_Y, TSS__PLY_Z, TSS__PLY_FAN, TSS__PLY_A, TSS__PLY_B };

typedef struct tss__ply_property {
    int type, list;  // list: type of the count, −1 if it is a scalar
    int role;
} tss__ply_property;

typedef struct tss__ply {
    int elements, properties, nodes;
    int kind[TSS__PLY_ELEMENTS];  // 'v', 'f', 'e' or 0
    int first[TSS__PLY_ELEMENTS + 1];
    long long count[TSS__PLY_ELEMENTS];
    tss__ply_property property[TSS__PLY_PROPERTIES];
} tss__ply;

static const char *const tss__ply_types[] = {
    "char", "int8",  "uchar", "uint8",  "short", "int16",   "ushort", "uint16",
    "int",  "int32", "uint",  "uint32", "float", "float32", "double", "float64"};
static const int tss__ply_bytes[] = {1, 1, 2, 2, 4, 4, 4, 8};

static int tss__ply_type(tss__io *in, int *type) {
    if (!tss__io_next(in, "a type")) return 0;
    for (int i = 0; i < 16; i++)
        if (tss__io_is(in, tss__ply_types[i])) {
            in->at += strlen(tss__ply_types[i]);
            *type = i / 2;
            return 1;
        }
    return tss__io_expected(in, "a type (char ... double)");
}

static int tss__ply_element(tss__io *in, tss__ply *p) {
    if (p->elements == TSS__PLY_ELEMENTS) return tss__io_fail(in, "too many elements");
    if (!tss__io_next(in, "an element's name")) return 0;
    int e = p->elements++;
    p->kind[e] = tss__io_is(in, "vertex") ? 'v'
                 : tss__io_is(in, "face") ? 'f'
                 : tss__io_is(in, "edge") ? 'e'
                                          : 0;
    for (int i = 0; i < e; i++)
        if (p->kind[e] && p->kind[i] == p->kind[e])
            return tss__io_expected(in, "an element that has not occurred yet");
    in->at += tss__io_token(in);
    p->first[e] = p->first[e + 1] = p->properties;
    if (!tss__io_int(in, "an element's count", 4, &p->count[e])) return 0;
    if (p->count[e] < 0) return tss__io_fail(in, "expected a count, found %lld", p->count[e]);
    return 1;
}

static int tss__ply_role(const tss__io *in, int kind, int list) {
    if (kind == 'v' && !list) {
        if (tss__io_is(in, "x")) return TSS__PLY_X;
        if (tss__io_is(in, "y")) return TSS__PLY_Y;
        if (tss__io_is(in, "z")) return TSS__PLY_Z;
    }
    if (kind == 'f' && list && (tss__io_is(in, "vertex_indices") || tss__io_is(in, "vertex_index")))
        return TSS__PLY_FAN;
    if (kind == 'e' && !list && tss__io_is(in, "vertex1")) return TSS__PLY_A;
    if (kind == 'e' && !list && tss__io_is(in, "vertex2")) return TSS__PLY_B;
    return TSS__PLY_OTHER;
}

static int tss__ply_add_property(tss__io *in, tss__ply *p) {
    if (!p->elements) return tss__io_fail(in, "expected an element before its properties");
    if (p->properties == TSS__PLY_PROPERTIES) return tss__io_fail(in, "too many properties");
    tss__ply_property *q = &p->property[p->properties];
    int e = p->elements - 1;
    q->list = -1;
    if (!tss__io_next(in, "a type")) return 0;
    if (tss__io_is(in, "list")) {
        in->at += 4;
        if (!tss__ply_type(in, &q->list)) return 0;
        if (q->list > 5) return tss__io_fail(in, "expected an integer type for a list's count");
    }
    if (!tss__ply_type(in, &q->type) || !tss__io_next(in, "a property's name")) return 0;
    q->role = tss__ply_role(in, p->kind[e], q->list >= 0);
    for (int i = p->first[e]; q->role && i < p->properties; i++)
        if (p->property[i].role == q->role)
            return tss__io_expected(in, "a property that has not occurred yet");
    in->at += tss__io_token(in);
    p->first[e + 1] = ++p->properties;
    return 1;
}

static int tss__ply_format(tss__io *in, int *binary) {
    static const char *const names[] = {"ascii", "binary_little_endian", "binary_big_endian"};
    const uint16_t probe = 1;
    int little = *(const unsigned char *)(const void *)&probe, i = 0;
    if (!tss__io_next(in, "a format")) return 0;
    while (i < 3 && !tss__io_is(in, names[i])) i++;
    if (i == 3) return tss__io_expected(in, "ascii, binary_little_endian or binary_big_endian");
    in->at += strlen(names[i]);
    in->swap = i && (i == 1) != little;
    *binary = i > 0;
    if (!tss__io_next(in, "version 1.0")) return 0;
    return tss__io_word(in, "1.0");
}

// Lines up to end_header. *binary is −1 until the format is known.
static int tss__ply_header(tss__io *in, tss__ply *p, int *binary) {
    *binary = -1;
    if (!tss__io_word(in, "ply") || !tss__io_line_end(in)) return 0;
    for (;;) {
        if (tss__io_space(in)) return tss__io_expected(in, "end_header");
        int ok = 1;
        if (tss__io_is(in, "end_header")) break;
        if (tss__io_is(in, "comment") || tss__io_is(in, "obj_info")) {
            tss__io_skip_line(in);
        } else if (tss__io_is(in, "format")) {
            in->at += 6;
            ok = tss__ply_format(in, binary);
        } else if (tss__io_is(in, "element")) {
            in->at += 7;
            ok = tss__ply_element(in, p);
        } else if (tss__io_is(in, "property")) {
            in->at += 8;
            ok = tss__ply_add_property(in, p);
        } else {
            ok = tss__io_expected(in, "element, property or end_header");
        }
        if (!ok || !tss__io_line_end(in)) return 0;
    }
    in->at += strlen("end_header");
    if (*binary < 0) return tss__io_fail(in, "expected a format line before end_header");
    if (!tss__io_line_end(in)) return 0;
    if (in->at < in->end) in->at++, in->line++;
    return 1;
}

static int tss__ply_value(tss__io *in, int type, double *v) {
    if (!in->binary) return tss__io_real(in, "a number", v);
    union {
        int8_t c;
        uint8_t C;
        int16_t s;
        uint16_t S;
        int32_t i;
        uint32_t I;
        float f;
        double d;
    } u;
    if (!tss__io_raw(in, "a number", (size_t)tss__ply_bytes[type], &u)) return 0;
    switch (type) {
        case 0:
            *v = u.c;
            break;
        case 1:
            *v = u.C;
            break;
        case 2:
            *v = u.s;
            break;
        case 3:
            *v = u.S;
            break;
        case 4:
            *v = u.i;
            break;
        case 5:
            *v = u.I;
            break;
        case 6:
            *v = (double)u.f;
            break;
        default:
            *v = u.d;
            break;
    }
    return 1;
}

// A coordinate must be finite; a property nobody reads (a quality, say) need not.
static int tss__ply_coordinate(tss__io *in, int type, double *v) {
    const unsigned char *start = in->at;
    if (!tss__ply_value(in, type, v)) return 0;
    if (*v - *v == 0) return 1;
    in->at = start;
    return tss__io_finite(in, "a coordinate", *v);
}

static int tss__ply_index(tss__io *in, const tss__ply *p, int type, int *node) {
    double v;
    if (!in->binary && tss__io_space(in)) return tss__io_expected(in, "a vertex index");
    const unsigned char *start = in->at;
    if (!tss__ply_value(in, type, &v)) return 0;
    if (v >= 0 && v < p->nodes && v == floor(v)) {
        *node = (int)v;
        return 1;
    }
    in->at = start;
    return tss__io_fail(in, "expected a vertex index from 0 to %d, found %.17g", p->nodes - 1, v);
}

static int tss__ply_list(tss__io *in, const tss__ply *p, const tss__ply_property *q) {
    double n, unused;
    int node[3] = {0, 0, 0};
    if (!in->binary && tss__io_space(in)) return tss__io_expected(in, "a list's length");
    const unsigned char *start = in->at;
    if (!tss__ply_value(in, q->list, &n)) return 0;
    int bytes = in->binary ? tss__ply_bytes[q->type] : 2;
    double least = q->role == TSS__PLY_FAN ? 3 : 0;
    if (!(n >= least && n == floor(n))) {
        in->at = start;
        return tss__io_fail(in, "expected a list of at least %g numbers, found %g", least, n);
    }
    if (n > (double)(tss__io_left(in) + 1) / bytes)
        return tss__io_fail(in, "a list of %.0f numbers, but only %lld bytes follow", n,
                            (long long)tss__io_left(in));
    for (int64_t i = 0; i < (int64_t)n; i++) {
        if (q->role != TSS__PLY_FAN) {
            if (!tss__ply_value(in, q->type, &unused)) return 0;
            continue;
        }
        if (!tss__ply_index(in, p, q->type, &node[i < 2 ? i : 2])) return 0;
        if (i < 2) continue;
        if (!tss__io_add_cell(in, 2, node, 0)) return 0;
        node[1] = node[2];
    }
    return 1;
}

static int tss__ply_row(tss__io *in, const tss__ply *p, int e) {
    double x[3] = {0, 0, 0}, unused;
    int ends[2] = {0, 0};
    for (int i = p->first[e]; i < p->first[e + 1]; i++) {
        const tss__ply_property *q = &p->property[i];
        int ok;
        if (q->list >= 0)
            ok = tss__ply_list(in, p, q);
        else if (q->role == TSS__PLY_A || q->role == TSS__PLY_B)
            ok = tss__ply_index(in, p, q->type, &ends[q->role - TSS__PLY_A]);
        else if (q->role >= TSS__PLY_X && q->role <= TSS__PLY_Z)
            ok = tss__ply_coordinate(in, q->type, &x[q->role - TSS__PLY_X]);
        else
            ok = tss__ply_value(in, q->type, &unused);
        if (!ok) return 0;
    }
    if (p->kind[e] == 'v') return tss__io_add_node(in, x, 0);
    if (p->kind[e] == 'e') return tss__io_add_cell(in, 1, ends, 0);
    return 1;
}

// Every element has the properties we need, and its announced rows can fit the file.
static int tss__ply_check(tss__io *in, tss__ply *p, int e) {
    unsigned roles = 0;
    size_t bytes = 0;
    for (int i = p->first[e]; i < p->first[e + 1]; i++) {
        const tss__ply_property *q = &p->property[i];
        roles |= 1u << q->role;
        bytes += !in->binary ? 2 : (size_t)tss__ply_bytes[q->list >= 0 ? q->list : q->type];
    }
    if (p->kind[e] == 'v') {
        in->dim = roles & (1u << TSS__PLY_Z) ? 3 : 2;
        if (!(roles & (1u << TSS__PLY_X)) || !(roles & (1u << TSS__PLY_Y)))
            return tss__io_fail(in, "expected the properties x and y of element vertex");
        p->nodes = p->count[e] > TSS__IO_MESH_MAX ? 0 : (int)p->count[e];
    }
    if (p->kind[e] == 'f' && !(roles & (1u << TSS__PLY_FAN)))
        return tss__io_fail(in, "expected the list vertex_indices of element face");
    if (p->kind[e] == 'e' && (roles & (3u << TSS__PLY_A)) != (3u << TSS__PLY_A))
        return tss__io_fail(in, "expected the properties vertex1 and vertex2 of element edge");
    if (!bytes) p->count[e] = 0;
    return tss__io_count(in, "rows", p->count[e], bytes);
}

static int tss__read_ply(tss__io *in) {
    tss__ply p;
    int binary;
    memset(&p, 0, sizeof p);
    in->by_line = 1;
    if (!tss__ply_header(in, &p, &binary)) return 0;
    in->by_line = 0;
    in->binary = in->no_lines = binary;
    for (int e = 0; e < p.elements; e++)
        if (!tss__ply_check(in, &p, e)) return 0;
    for (int e = 0; e < p.elements; e++)
        for (long long i = 0; i < p.count[e]; i++)
            if (!tss__ply_row(in, &p, e)) return 0;
    if (!in->dim) return tss__io_fail(in, "expected an element vertex, found none");
    if (!binary && !tss__io_space(in)) return tss__io_expected(in, "the end of the file");
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>io_read (private)
// ---------------------------------------------------------------------------------------------

static int tss__io_has_suffix(const char *name, const char *suffix) {
    size_t n = strlen(name), m = strlen(suffix);
    if (n < m) return 0;
    for (size_t i = 0; i < m; i++) {
        char c = name[n - m + i];
        if (c >= 'A' && c <= 'Z') c = (char)(c - 'A' + 'a');
        if (c != suffix[i]) return 0;
    }
    return 1;
}

static int tss__io_starts(const void *data, size_t size, const char *word) {
    return size >= strlen(word) && !memcmp(data, word, strlen(word));
}

static tss_mesh_format tss__io_guess(const char *name, const void *data, size_t size) {
    if (name) {
        if (tss__io_has_suffix(name, ".msh")) return TSS_MESH_GMSH;
        if (tss__io_has_suffix(name, ".mesh") || tss__io_has_suffix(name, ".meshb"))
            return TSS_MESH_MEDIT;
        if (tss__io_has_suffix(name, ".node") || tss__io_has_suffix(name, ".ele"))
            return TSS_MESH_TETGEN;
        if (tss__io_has_suffix(name, ".obj")) return TSS_MESH_OBJ;
        if (tss__io_has_suffix(name, ".ply")) return TSS_MESH_PLY;
        if (tss__io_has_suffix(name, ".seg")) return TSS_MESH_SEG;
    }
    if (tss__io_starts(data, size, "$MeshFormat")) return TSS_MESH_GMSH;
    if (tss__io_starts(data, size, "MeshVersionFormatted")) return TSS_MESH_MEDIT;
    if (tss__io_starts(data, size, "ply\n") || tss__io_starts(data, size, "ply\r"))
        return TSS_MESH_PLY;
    return TSS_MESH_AUTO;
}

tss_result tss_mesh_parse(const tss_host *host, tss_mesh_format format, const char *name,
                          const void *data, size_t size, tss_mesh *out, tss_io_error *error) {
    tss__io in;
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    tss__io_error_set(error, name, 0, -1, "");
    if (!data && size) return TSS_ERROR_BAD_ARGUMENT;
    if (!data) data = "";
    if (format == TSS_MESH_AUTO) format = tss__io_guess(name, data, size);
    if (format == TSS_MESH_TETGEN)
        return tss_mesh_parse_tetgen(host, name, data, size, NULL, NULL, 0, out, error);
    memset(&in, 0, sizeof in);
    in.host = host ? *host : tss_host_default();
    in.error = error;
    tss__io_open(&in, name, data, size);
    switch (format) {
        case TSS_MESH_GMSH:
            tss__read_gmsh(&in);
            break;
        case TSS_MESH_MEDIT:
            tss__read_medit(&in);
            break;
        case TSS_MESH_OBJ:
            tss__read_obj(&in, 0);
            break;
        case TSS_MESH_SEG:
            tss__read_obj(&in, 1);
            break;
        case TSS_MESH_PLY:
            tss__read_ply(&in);
            break;
        default:
            tss__io_fail(&in,
                         "not a mesh file by its name or contents: expected .msh, .mesh, "
                         ".node, .ele, .obj, .ply or .seg");
    }
    tss_result r = tss__io_finish(&in, out);
    tss__io_close(&in);
    return r;
}

static tss_result tss__io_file_error(tss_io_error *error, const char *path, const char *what,
                                     int code) {
    char text[256];
    snprintf(text, sizeof text, "%s: %s", what, code ? strerror(code) : "unknown reason");
    tss__io_error_set(error, path, 0, -1, text);
    return TSS_ERROR_FILE;
}

// A whole file: *data has *room bytes of which *size are the file's.
static tss_result tss__io_load(const tss_host *host, const char *path, char **data, size_t *size,
                               size_t *room, tss_io_error *error) {
    *data = NULL;
    *size = *room = 0;
    errno = 0;
    FILE *f = fopen(path, "rb");
    if (!f) return tss__io_file_error(error, path, "cannot open", errno);
    tss_result r = TSS_OK;
    for (;;) {
        if (*size == *room) {
            size_t bigger = *room ? 2 * *room : (size_t)1 << 16;
            char *p = (char *)tss_alloc(host, bigger);
            if (!p) {
                tss__io_error_set(error, path, 0, -1, "out of memory");
                r = TSS_ERROR_NO_MEMORY;
                break;
            }
            if (*size) memcpy(p, *data, *size);
            tss_free(host, *data, *room);
            *data = p;
            *room = bigger;
        }
        size_t got = fread(*data + *size, 1, *room - *size, f);
        *size += got;
        if (!got) break;
    }
    if (r == TSS_OK && ferror(f)) r = tss__io_file_error(error, path, "cannot read", errno);
    fclose(f);
    if (r != TSS_OK) {
        tss_free(host, *data, *room);
        *data = NULL;
        *size = *room = 0;
    }
    return r;
}

// .node and .ele beside each other. The .ele may be missing if the .node was asked for.
static tss_result tss__io_read_tetgen(const tss_host *host, const char *path, tss_mesh *out,
                                      tss_io_error *error) {
    size_t n = strlen(path), size[2], room[2], stem = n;
    char *name[2] = {NULL, NULL}, *data[2] = {NULL, NULL};
    int need = tss__io_has_suffix(path, ".ele") ? 2 : 1;
    tss_result r = TSS_OK;
    memset(size, 0, sizeof size);
    memset(room, 0, sizeof room);
    while (path[stem - 1] != '.') stem--;
    for (int i = 0; i < 2; i++) {
        name[i] = (char *)tss_alloc(host, n + 6);
        if (!name[i]) {
            tss__io_error_set(error, path, 0, -1, "out of memory");
            r = TSS_ERROR_NO_MEMORY;
            continue;
        }
        memcpy(name[i], path, stem);
        strcpy(name[i] + stem, i ? "ele" : "node");
    }
    // the suffix the caller wrote, in the caller's letters
    if (name[need - 1]) memcpy(name[need - 1], path, n + 1);
    for (int i = 0; i < 2 && r == TSS_OK; i++) {
        r = tss__io_load(host, name[i], &data[i], &size[i], &room[i], error);
        if (i == 1 && need == 1 && r == TSS_ERROR_FILE && errno == ENOENT) r = TSS_OK;
    }
    if (r == TSS_OK)
        r = tss_mesh_parse_tetgen(host, name[0], data[0], size[0], name[1], data[1], size[1], out,
                                  error);
    for (int i = 0; i < 2; i++) {
        tss_free(host, data[i], room[i]);
        tss_free(host, name[i], n + 6);
    }
    return r;
}

tss_result tss_mesh_read(const tss_host *host, const char *path, tss_mesh *out,
                         tss_io_error *error) {
    tss_host h = host ? *host : tss_host_default();
    char *data;
    size_t size, room;
    if (!out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    tss__io_error_set(error, path, 0, -1, "");
    if (!path) return TSS_ERROR_BAD_ARGUMENT;
    if (tss__io_guess(path, "", 0) == TSS_MESH_TETGEN)
        return tss__io_read_tetgen(&h, path, out, error);
    tss_result r = tss__io_load(&h, path, &data, &size, &room, error);
    if (r == TSS_OK) r = tss_mesh_parse(&h, TSS_MESH_AUTO, path, data, size, out, error);
    tss_free(&h, data, room);
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>mesh_check (private)
// Degenerate means that the sign of the determinant is lost in the rounding of the coordinates:
// with edges up to L and coordinates up to M a determinant is uncertain by about eps·M·L² (area:
// eps·M·L); 16 covers the constants. Duplicates: cells sorted by their sorted nodes, nodes by
// their coordinates.
// ---------------------------------------------------------------------------------------------

#define TSS__IO_EPS 2.220446049250313e-16

static void tss__io_report_add(tss_mesh_report *r, int issue, int number) {
    int n = r->count[issue]++;
    if (n < TSS_MESH_OFFENDERS) r->first[issue][n] = number;
    r->problems++;
}

static int tss__io_cell_in_range(const tss_mesh *m, const int *node, int corners) {
    for (int c = 0; c < corners; c++)
        if (node[c] < 0 || node[c] >= m->nodes) return 0;
    return 1;
}

// Edge vectors from the first corner, the longest of them L and the largest coordinate M.
static void tss__io_cell_edges(const tss_mesh *m, const int *node, int corners, double e[3][3],
                               double *L, double *M) {
    *L = *M = 0;
    for (int c = 0; c < corners; c++) {
        const double *x = m->x + 3 * (size_t)node[c], *x0 = m->x + 3 * (size_t)node[0];
        double square = 0;
        for (int i = 0; i < 3; i++) {
            double d = x[i] - x0[i];
            if (c) e[c - 1][i] = d;
            square += d * d;
            if (fabs(x[i]) > *M) *M = fabs(x[i]);
        }
        if (square > *L * *L) *L = sqrt(square);
    }
}

static void tss__io_cross(const double a[3], const double b[3], double c[3]) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static double tss__io_tet_det(double e[3][3]) {
    double n[3];
    tss__io_cross(e[0], e[1], n);
    return n[0] * e[2][0] + n[1] * e[2][1] + n[2] * e[2][2];
}

// One cell with good indices and finite nodes: sign and size.
static void tss__io_check_shape(const tss_mesh *m, const int *node, int kind, int i,
                                tss_mesh_report *r) {
    double e[3][3], n[3], L, M;
    tss__io_cell_edges(m, node, kind + 1, e, &L, &M);
    double tol = 16 * TSS__IO_EPS * (M + L) * L;
    if (kind == 3) {
        double det = tss__io_tet_det(e);
        if (fabs(det) <= tol * L)
            tss__io_report_add(r, TSS_MESH_DEGENERATE_TET, i);
        else if (det < 0)
            tss__io_report_add(r, TSS_MESH_INVERTED_TET, i);
        r->volume += det / 6;
    } else if (kind == 2) {
        tss__io_cross(e[0], e[1], n);
        if (sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) <= tol)
            tss__io_report_add(r, TSS_MESH_DEGENERATE_TRIANGLE, i);
        else if (m->dim == 2 && n[2] < 0)
            tss__io_report_add(r, TSS_MESH_INVERTED_TRIANGLE, i);
        if (m->dim == 2) r->volume += n[2] / 2;
    } else if (kind == 1 && L == 0) {
        tss__io_report_add(r, TSS_MESH_DEGENERATE_EDGE, i);
    }
}

typedef struct tss__io_cell_key {
    int node[4], index;
} tss__io_cell_key;

static int tss__io_cell_same(const tss__io_cell_key *p, const tss__io_cell_key *q) {
    return p->node[0] == q->node[0] && p->node[1] == q->node[1] && p->node[2] == q->node[2] &&
           p->node[3] == q->node[3];
}

static int tss__io_cell_before(const void *a, const void *b) {
    const tss__io_cell_key *p = (const tss__io_cell_key *)a, *q = (const tss__io_cell_key *)b;
    for (int c = 0; c < 4; c++)
        if (p->node[c] != q->node[c]) return p->node[c] < q->node[c];
    return p->index < q->index;
}

static tss__io_cell_key tss__io_cell_key_of(const int *node, int corners, int index) {
    tss__io_cell_key k;
    for (int c = 0; c < 4; c++) k.node[c] = c < corners ? node[c] : -1;
    for (int c = 1; c < corners; c++)
        for (int i = c; i > 0 && k.node[i] < k.node[i - 1]; i--) {
            int t = k.node[i];
            k.node[i] = k.node[i - 1];
            k.node[i - 1] = t;
        }
    k.index = index;
    return k;
}

// Numbers of the marked items, in order.
static void tss__io_report_marked(tss_mesh_report *r, int issue, const unsigned char *mark, int n) {
    for (int i = 0; i < n; i++)
        if (mark[i]) tss__io_report_add(r, issue, i);
}

static int tss__io_check_cells(const tss_mesh *m, int kind, const unsigned char *bad_node,
                               unsigned char *used, tss_mesh_report *r) {
    static const int bad[] = {TSS_MESH_BAD_INDEX_POINT, TSS_MESH_BAD_INDEX_EDGE,
                              TSS_MESH_BAD_INDEX_TRIANGLE, TSS_MESH_BAD_INDEX_TET};
    static const int duplicate[] = {TSS_MESH_DUPLICATE_POINT, TSS_MESH_DUPLICATE_EDGE,
                                    TSS_MESH_DUPLICATE_TRIANGLE, TSS_MESH_DUPLICATE_TET};
    tss__io_cells cells = tss__io_mesh_view(m, kind);
    int n = cells.count, corners = kind + 1;
    if (!n) return 1;
    size_t key_bytes = (size_t)n * sizeof(tss__io_cell_key);
    tss__io_cell_key *key = (tss__io_cell_key *)tss_alloc(&m->host, key_bytes);
    unsigned char *mark = (unsigned char *)tss__io_zeros(&m->host, (size_t)n);
    for (int i = 0; key && mark && i < n; i++) {
        const int *node = *cells.node + (size_t)i * (size_t)corners;
        int finite = 1;
        key[i] = tss__io_cell_key_of(node, corners, i);
        if (!tss__io_cell_in_range(m, node, corners)) {
            tss__io_report_add(r, bad[kind], i);
            continue;
        }
        for (int c = 0; c < corners; c++) used[node[c]] = 1, finite = finite && !bad_node[node[c]];
        if (finite) tss__io_check_shape(m, node, kind, i, r);
    }
    if (key && mark) {
        tss__io_sort(key, (size_t)n, sizeof *key, tss__io_cell_before);
        for (int i = 1; i < n; i++)
            if (tss__io_cell_same(&key[i], &key[i - 1])) mark[key[i].index] = 1;
        tss__io_report_marked(r, duplicate[kind], mark, n);
    }
    int ok = key && mark;
    tss_free(&m->host, key, key_bytes);
    tss_free(&m->host, mark, (size_t)n);
    return ok;
}

typedef struct tss__io_place {
    double x[3];
    int index;
} tss__io_place;

static int tss__io_place_before(const void *a, const void *b) {
    const tss__io_place *p = (const tss__io_place *)a, *q = (const tss__io_place *)b;
    for (int c = 0; c < 3; c++)
        if (p->x[c] != q->x[c]) return p->x[c] < q->x[c];
    return p->index < q->index;
}

// Nodes that are not finite are marked in bad; coincident ones are reported.
static int tss__io_check_nodes(const tss_mesh *m, unsigned char *bad, tss_mesh_report *r) {
    size_t n = (size_t)m->nodes, count = 0;
    tss__io_place *p = (tss__io_place *)tss__io_zeros(&m->host, n * sizeof *p);
    unsigned char *mark = (unsigned char *)tss__io_zeros(&m->host, n);
    for (size_t i = 0; p && mark && i < n; i++) {
        const double *x = m->x + 3 * i;
        if (x[0] - x[0] != 0 || x[1] - x[1] != 0 || x[2] - x[2] != 0) {
            bad[i] = 1;
            continue;
        }
        for (int c = 0; c < 3; c++) {
            p[count].x[c] = x[c];
            if (x[c] < r->lower[c]) r->lower[c] = x[c];
            if (x[c] > r->upper[c]) r->upper[c] = x[c];
        }
        p[count++].index = (int)i;
    }
    int ok = p && mark;
    if (ok) {
        tss__io_report_marked(r, TSS_MESH_NOT_FINITE, bad, m->nodes);
        tss__io_sort(p, count, sizeof *p, tss__io_place_before);
        for (size_t i = 1; i < count; i++)
            if (p[i].x[0] == p[i - 1].x[0] && p[i].x[1] == p[i - 1].x[1] &&
                p[i].x[2] == p[i - 1].x[2])
                mark[p[i].index] = 1;
        tss__io_report_marked(r, TSS_MESH_DUPLICATE_NODE, mark, m->nodes);
    }
    tss_free(&m->host, p, n * sizeof *p);
    tss_free(&m->host, mark, n);
    return ok;
}

tss_result tss_mesh_check(const tss_mesh *m, tss_mesh_report *r) {
    if (!m || !r) return TSS_ERROR_BAD_ARGUMENT;
    memset(r, 0, sizeof *r);
    for (int c = 0; c < 3; c++) r->lower[c] = INFINITY, r->upper[c] = -INFINITY;
    size_t n = (size_t)m->nodes;
    unsigned char *bad = (unsigned char *)tss__io_zeros(&m->host, n);
    unsigned char *used = (unsigned char *)tss__io_zeros(&m->host, n);
    int ok = !n || (bad && used && tss__io_check_nodes(m, bad, r));
    for (int k = 3; ok && k >= 0; k--) ok = tss__io_check_cells(m, k, bad, used, r);
    for (int i = 0; ok && i < m->nodes; i++)
        if (!used[i]) tss__io_report_add(r, TSS_MESH_UNREFERENCED_NODE, i);
    tss_free(&m->host, bad, n);
    tss_free(&m->host, used, n);
    return ok ? TSS_OK : TSS_ERROR_NO_MEMORY;
}

void tss_mesh_issue_text(const tss_mesh_report *r, tss_mesh_issue issue, char *text, size_t size) {
    static const char *const thing[] = {
#define TSS__TEXT(id, noun, fault) noun,
        TSS_MESH_ISSUES(TSS__TEXT)
#undef TSS__TEXT
    };
    static const char *const wrong[] = {
#define TSS__TEXT(id, noun, fault) fault,
        TSS_MESH_ISSUES(TSS__TEXT)
#undef TSS__TEXT
    };
    if (!size) return;
    text[0] = 0;
    if ((unsigned)issue >= TSS_MESH_ISSUE_COUNT || !r->count[issue]) return;
    int n = r->count[issue], shown = n < TSS_MESH_OFFENDERS ? n : TSS_MESH_OFFENDERS;
    int at = snprintf(text, size, "%d %s%s: %s:", n, thing[issue], n > 1 ? "s" : "", wrong[issue]);
    for (int i = 0; i < shown && at >= 0 && (size_t)at < size; i++)
        at += snprintf(text + at, size - (size_t)at, "%s %d", i ? "," : "", r->first[issue][i]);
    if (n > shown && at >= 0 && (size_t)at < size) snprintf(text + at, size - (size_t)at, ", ...");
}

int tss_mesh_flip_inverted(tss_mesh *m) {
    int flipped = 0;
    if (!m) return 0;
    for (int kind = m->dim == 2 ? 2 : 3; kind <= 3; kind++) {
        tss__io_cells c = tss__io_mesh_cells(m, kind);
        for (int i = 0; i < c.count; i++) {
            int *node = *c.node + (size_t)i * (size_t)(kind + 1);
            double e[3][3], n[3], L, M;
            if (!tss__io_cell_in_range(m, node, kind + 1)) continue;
            tss__io_cell_edges(m, node, kind + 1, e, &L, &M);
            tss__io_cross(e[0], e[1], n);
            if (!((kind == 3 ? tss__io_tet_det(e) : n[2]) < 0)) continue;
            int t = node[kind];
            node[kind] = node[kind - 1];
            node[kind - 1] = t;
            flipped++;
        }
    }
    return flipped;
}

// New numbers of the used nodes in map (−1: unused); returns how many, or −1 on a bad index.
static int tss__io_used_nodes(const tss_mesh *m, int *map) {
    int n = 0;
    for (int i = 0; i < m->nodes; i++) map[i] = -1;
    for (int k = 0; k < 4; k++) {
        tss__io_cells c = tss__io_mesh_view(m, k);
        for (int i = 0; i < c.count; i++) {
            const int *node = *c.node + (size_t)i * (size_t)(k + 1);
            if (!tss__io_cell_in_range(m, node, k + 1)) return -1;
            for (int j = 0; j <= k; j++) map[node[j]] = 0;
        }
    }
    for (int i = 0; i < m->nodes; i++)
        if (!map[i]) map[i] = n++;
    return n;
}

tss_result tss_mesh_drop_unreferenced(tss_mesh *m, int *dropped) {
    if (dropped) *dropped = 0;
    if (!m) return TSS_ERROR_BAD_ARGUMENT;
    if (!m->nodes) return TSS_OK;
    size_t old = (size_t)m->nodes;
    int *map = (int *)tss_alloc(&m->host, old * sizeof *map);
    if (!map) return TSS_ERROR_NO_MEMORY;
    int n = tss__io_used_nodes(m, map);
    tss_result r = n < 0 ? TSS_ERROR_BAD_MESH : TSS_OK;
    if (n >= 0 && n < m->nodes) {
        size_t keep = (size_t)n;
        double *x = (double *)tss_alloc(&m->host, keep * 3 * sizeof *x);
        int *marker = (int *)tss_alloc(&m->host, keep * sizeof *marker);
        if (n && (!x || !marker)) {
            tss_free(&m->host, x, keep * 3 * sizeof *x);
            tss_free(&m->host, marker, keep * sizeof *marker);
            tss_free(&m->host, map, old * sizeof *map);
            return TSS_ERROR_NO_MEMORY;
        }
        for (size_t i = 0; i < old; i++) {
            if (map[i] < 0) continue;
            memcpy(x + 3 * (size_t)map[i], m->x + 3 * i, 3 * sizeof *x);
            marker[map[i]] = m->node_marker[i];
        }
        for (int k = 0; k < 4; k++) {
            tss__io_cells c = tss__io_mesh_cells(m, k);
            size_t ends = (size_t)c.count * (size_t)(k + 1);
            for (size_t i = 0; i < ends; i++) (*c.node)[i] = map[(*c.node)[i]];
        }
        tss_free(&m->host, m->x, old * 3 * sizeof *x);
        tss_free(&m->host, m->node_marker, old * sizeof *marker);
        m->x = x;
        m->node_marker = marker;
        m->nodes = n;
        if (dropped) *dropped = (int)old - n;
    }
    tss_free(&m->host, map, old * sizeof *map);
    return r;
}

// Corners of the faces of a positive tet, outward.
static const int tss__io_tet_face[4][3] = {{1, 2, 3}, {0, 3, 2}, {0, 1, 3}, {0, 2, 1}};

// Marks the faces (4·tet + face) that occur once; returns how many, or −1 without memory.
static int tss__io_boundary_faces(const tss_mesh *m, unsigned char *single) {
    size_t faces = 4 * (size_t)m->tets, bytes = faces * sizeof(tss__io_cell_key);
    tss__io_cell_key *key = (tss__io_cell_key *)tss_alloc(&m->host, bytes);
    int n = 0;
    if (!key) return -1;
    for (size_t i = 0; i < faces; i++) {
        const int *tet = m->tet + (i & ~(size_t)3), *f = tss__io_tet_face[i & 3];
        int node[3] = {tet[f[0]], tet[f[1]], tet[f[2]]};
        key[i] = tss__io_cell_key_of(node, 3, (int)i);
    }
    tss__io_sort(key, faces, sizeof *key, tss__io_cell_before);
    for (size_t i = 0; i < faces;) {
        size_t j = i + 1;
        while (j < faces && tss__io_cell_same(&key[j], &key[i])) j++;
        if (j == i + 1) single[key[i].index] = 1, n++;
        i = j;
    }
    tss_free(&m->host, key, bytes);
    return n;
}

tss_result tss_mesh_surface(const tss_mesh *m, tss_mesh *out) {
    if (!m || !out) return TSS_ERROR_BAD_ARGUMENT;
    memset(out, 0, sizeof *out);
    for (int i = 0; i < m->tets; i++)
        if (!tss__io_cell_in_range(m, m->tet + 4 * (size_t)i, 4)) return TSS_ERROR_BAD_MESH;
    size_t faces = 4 * (size_t)m->tets;
    unsigned char *single = (unsigned char *)tss__io_zeros(&m->host, faces);
    int n = faces ? single ? tss__io_boundary_faces(m, single) : -1 : 0, at = 0;
    // the caller may have made m by hand: nothing says that its dim is set
    tss_result r =
        n < 0 ? TSS_ERROR_NO_MEMORY : tss_mesh_alloc(&m->host, 3, m->nodes, 0, n, 0, 0, out);
    if (r == TSS_OK && m->nodes) {
        memcpy(out->x, m->x, (size_t)m->nodes * 3 * sizeof *m->x);
        if (m->node_marker)
            memcpy(out->node_marker, m->node_marker, (size_t)m->nodes * sizeof(int));
    }
    for (size_t i = 0; r == TSS_OK && i < faces; i++) {
        if (!single[i]) continue;
        for (int c = 0; c < 3; c++)
            out->triangle[3 * at + c] =
                m->tet[(i & ~(size_t)3) + (size_t)tss__io_tet_face[i & 3][c]];
        if (m->tet_region) out->triangle_region[at] = m->tet_region[i / 4];
        at++;
    }
    tss_free(&m->host, single, faces);
    return r;
}

// ---------------------------------------------------------------------------------------------
// >>mesh_write (private)
// A file is composed in memory, then written in one go: what can fail is in one place.
// ---------------------------------------------------------------------------------------------

typedef struct tss__io_out {
    tss_host host;
    char *p;
    size_t used, room;
    int failed;  // no memory
    int ascii;
    uint32_t bits;  // of base64, not yet written
    int pending;    // bytes in bits
} tss__io_out;

static void tss__io_put_bytes(tss__io_out *o, const void *data, size_t n) {
    if (o->failed) return;
    if (o->room - o->used < n) {
        size_t room = 2 * o->room + n + 4096;
        char *p = (char *)tss_alloc(&o->host, room);
        if (!p) {
            o->failed = 1;
            return;
        }
        if (o->used) memcpy(p, o->p, o->used);
        tss_free(&o->host, o->p, o->room);
        o->p = p;
        o->room = room;
    }
    memcpy(o->p + o->used, data, n);
    o->used += n;
}

static void tss__io_put(tss__io_out *o, const char *text) {
    tss__io_put_bytes(o, text, strlen(text));
}

static void tss__io_put_int(tss__io_out *o, long long v) {
    char text[32];
    int n = snprintf(text, sizeof text, "%lld", v);
    tss__io_put_bytes(o, text, (size_t)n);
}

static void tss__io_put_double(tss__io_out *o, double v) {
    char text[32];
    tss__io_put_bytes(o, text, (size_t)tss_format_double(v, text));
}

// Little-endian whatever this machine is.
static void tss__io_put_little(tss__io_out *o, uint64_t v, int bytes) {
    unsigned char b[8];
    for (int i = 0; i < bytes; i++) b[i] = (unsigned char)(v >> (8 * i));
    tss__io_put_bytes(o, b, (size_t)bytes);
}

static void tss__io_put_xml(tss__io_out *o, const char *s) {
    for (; *s; s++) {
        if (*s == '&')
            tss__io_put(o, "&amp;");
        else if (*s == '<')
            tss__io_put(o, "&lt;");
        else if (*s == '>')
            tss__io_put(o, "&gt;");
        else if (*s == '"')
            tss__io_put(o, "&quot;");
        else if ((unsigned char)*s < ' ')
            tss__io_put(o, " ");
        else
            tss__io_put_bytes(o, s, 1);
    }
}

// RENAME over what is there, unless that is not a plain file (a device, say): then written
// directly.
static int tss__io_replaceable(const char *path) {
#if defined(__unix__) || defined(__APPLE__)
    struct stat s;
    return stat(path, &s) != 0 || S_ISREG(s.st_mode);
#else
    (void)path;
    return 1;
#endif
}

static int tss__io_write_all(const char *path, const char *data, size_t size) {
    FILE *f = fopen(path, "wb");
    if (!f) return 0;
    int ok = fwrite(data, 1, size, f) == size;
    ok = fflush(f) == 0 && ok;
    int code = errno;
    ok = fclose(f) == 0 && ok;
    if (code) errno = code;
    return ok;
}

static tss_result tss__io_out_save(tss__io_out *o, const char *path, tss_io_error *error) {
    size_t n = strlen(path) + 6;
    char *part = o->failed ? NULL : (char *)tss_alloc(&o->host, n);
    if (!part) {
        tss__io_error_set(error, path, 0, -1, "out of memory");
        return TSS_ERROR_NO_MEMORY;
    }
    int direct = !tss__io_replaceable(path);
    snprintf(part, n, "%s%s", path, direct ? "" : ".part");
    errno = 0;
    tss_result r = TSS_OK;
    if (!tss__io_write_all(part, o->p, o->used)) {
        r = tss__io_file_error(error, path, "cannot write", errno);
        if (!direct) remove(part);
    } else if (!direct) {
#ifdef _WIN32
        remove(path);  // rename does not replace there
#endif
        if (rename(part, path)) {
            r = tss__io_file_error(error, path, "cannot rename the finished file", errno);
            remove(part);
        }
    }
    tss_free(&o->host, part, n);
    return r;
}

static void tss__io_out_open(tss__io_out *o, const tss_host *host) {
    memset(o, 0, sizeof *o);
    o->host = host ? *host : tss_host_default();
}

static void tss__io_out_close(tss__io_out *o) { tss_free(&o->host, o->p, o->room); }

static tss_result tss__io_write_refuse(tss_io_error *error, const char *path, const char *why) {
    tss__io_error_set(error, path, 0, -1, why);
    return TSS_ERROR_BAD_ARGUMENT;
}

// >>vtu (private)
// Inline base64: the length (UInt64) and the data in one base64 stream, little-endian.

static void tss__io_put_sextets(tss__io_out *o, int count) {
    static const char digit[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    char text[4] = {'=', '=', '=', '='};
    for (int i = 0; i < count; i++) text[i] = digit[(o->bits >> (18 - 6 * i)) & 63];
    tss__io_put_bytes(o, text, 4);
    o->bits = 0;
    o->pending = 0;
}

static void tss__io_base64(tss__io_out *o, uint64_t v, int bytes) {
    for (int i = 0; i < bytes; i++) {
        o->bits |= (uint32_t)((v >> (8 * i)) & 255) << (16 - 8 * o->pending);
        if (++o->pending == 3) tss__io_put_sextets(o, 4);
    }
}

// n values of `bytes` bytes follow.
static void tss__io_array_begin(tss__io_out *o, const char *type, const char *name, int components,
                                uint64_t n, int bytes) {
    tss__io_put(o, "<DataArray type=\"");
    tss__io_put(o, type);
    tss__io_put(o, "\" Name=\"");
    tss__io_put_xml(o, name);
    tss__io_put(o, "\" NumberOfComponents=\"");
    tss__io_put_int(o, components);
    tss__io_put(o, o->ascii ? "\" format=\"ascii\">\n" : "\" format=\"binary\">\n");
    if (!o->ascii) tss__io_base64(o, n * (uint64_t)bytes, 8);
}

static void tss__io_array_int(tss__io_out *o, int64_t v, int bytes) {
    if (!o->ascii) {
        tss__io_base64(o, (uint64_t)v, bytes);
        return;
    }
    tss__io_put_int(o, v);
    tss__io_put(o, "\n");
}

static void tss__io_array_double(tss__io_out *o, double v) {
    uint64_t bits;
    memcpy(&bits, &v, sizeof bits);
    if (!o->ascii) {
        tss__io_base64(o, bits, 8);
        return;
    }
    tss__io_put_double(o, v);
    tss__io_put(o, "\n");
}

static void tss__io_array_end(tss__io_out *o) {
    if (o->pending) tss__io_put_sextets(o, o->pending + 1);
    tss__io_put(o, o->ascii ? "</DataArray>\n" : "\n</DataArray>\n");
}

static void tss__vtu_cells(tss__io_out *o, const tss_mesh *m) {
    static const int vtk_type[] = {1, 3, 5, 10};  // vertex, line, triangle, tetra
    uint64_t cells = 0, ends = 0;
    for (int k = 0; k < 4; k++) {
        uint64_t n = (uint64_t)tss__io_mesh_view(m, k).count;
        cells += n;
        ends += n * (uint64_t)(k + 1);
    }
    tss__io_put(o, "<Cells>\n");
    tss__io_array_begin(o, "Int32", "connectivity", 1, ends, 4);
    for (int k = 3; k >= 0; k--) {
        tss__io_cells c = tss__io_mesh_view(m, k);
        size_t n = (size_t)c.count * (size_t)(k + 1);
        for (size_t i = 0; i < n; i++) tss__io_array_int(o, (*c.node)[i], 4);
    }
    tss__io_array_end(o);
    tss__io_array_begin(o, "Int64", "offsets", 1, cells, 8);
    int64_t offset = 0;
    for (int k = 3; k >= 0; k--)
        for (int i = 0, n = tss__io_mesh_view(m, k).count; i < n; i++)
            tss__io_array_int(o, offset += k + 1, 8);
    tss__io_array_end(o);
    tss__io_array_begin(o, "UInt8", "types", 1, cells, 1);
    for (int k = 3; k >= 0; k--)
        for (int i = 0, n = tss__io_mesh_view(m, k).count; i < n; i++)
            tss__io_array_int(o, vtk_type[k], 1);
    tss__io_array_end(o);
    tss__io_put(o, "</Cells>\n");
}

static void tss__vtu_field(tss__io_out *o, const tss_field *f, size_t rows) {
    int wide = f->components == 2 ? 3 : f->components;
    tss__io_array_begin(o, "Float64", f->name, wide, (uint64_t)rows * (uint64_t)wide, 8);
    for (size_t i = 0; i < rows; i++)
        for (int c = 0; c < wide; c++)
            tss__io_array_double(
                o, c < f->components ? f->values[i * (size_t)f->components + (size_t)c] : 0);
    tss__io_array_end(o);
}

static void tss__vtu_body(tss__io_out *o, const tss_mesh *m, const double *x,
                          const tss_field *fields, int count) {
    size_t n = (size_t)m->nodes;
    size_t cells = (size_t)m->tets + (size_t)m->triangles + (size_t)m->edges + (size_t)m->points;
    tss__io_put(o,
                "<?xml version=\"1.0\"?>\n<VTKFile type=\"UnstructuredGrid\" version=\"1.0\" "
                "byte_order=\"LittleEndian\" header_type=\"UInt64\">\n<UnstructuredGrid>\n"
                "<Piece NumberOfPoints=\"");
    tss__io_put_int(o, m->nodes);
    tss__io_put(o, "\" NumberOfCells=\"");
    tss__io_put_int(o, (long long)cells);
    tss__io_put(o, "\">\n<Points>\n");
    tss__io_array_begin(o, "Float64", "Points", 3, 3 * n, 8);
    for (size_t i = 0; i < 3 * n; i++) tss__io_array_double(o, x[i]);
    tss__io_array_end(o);
    tss__io_put(o, "</Points>\n");
    tss__vtu_cells(o, m);
    tss__io_put(o, "<PointData>\n");
    for (int i = 0; i < count; i++)
        if (!fields[i].on_cells) tss__vtu_field(o, &fields[i], n);
    tss__io_put(o, "</PointData>\n<CellData>\n");
    tss__io_array_begin(o, "Int32", "region", 1, cells, 4);
    for (int k = 3; k >= 0; k--) {
        tss__io_cells c = tss__io_mesh_view(m, k);
        for (int i = 0; i < c.count; i++) tss__io_array_int(o, *c.region ? (*c.region)[i] : 0, 4);
    }
    tss__io_array_end(o);
    for (int i = 0; i < count; i++)
        if (fields[i].on_cells) tss__vtu_field(o, &fields[i], cells);
    tss__io_put(o, "</CellData>\n</Piece>\n</UnstructuredGrid>\n</VTKFile>\n");
}

tss_result tss_mesh_write_vtu(const tss_mesh *m, const double *x, const char *path,
                              const tss_field *fields, int count, int ascii, tss_io_error *error) {
    tss__io_out o;
    tss__io_error_set(error, path, 0, -1, "");
    if (!m || !path || count < 0 || (count && !fields)) return TSS_ERROR_BAD_ARGUMENT;
    for (int i = 0; i < count; i++) {
        size_t rows = fields[i].on_cells ? (size_t)m->tets + (size_t)m->triangles +
                                               (size_t)m->edges + (size_t)m->points
                                         : (size_t)m->nodes;
        if (!fields[i].name || (rows && !fields[i].values) || fields[i].components < 1)
            return tss__io_write_refuse(error, path, "a field needs a name, values and components");
    }
    tss__io_out_open(&o, &m->host);
    o.ascii = ascii;
    tss__vtu_body(&o, m, x ? x : m->x, fields, count);
    tss_result r = tss__io_out_save(&o, path, error);
    tss__io_out_close(&o);
    return r;
}

tss_result tss_write_pvd(const tss_host *host, const char *path, const char *const *files,
                         const double *times, int count, tss_io_error *error) {
    tss__io_out o;
    tss__io_error_set(error, path, 0, -1, "");
    if (!path || count < 0 || (count && (!files || !times))) return TSS_ERROR_BAD_ARGUMENT;
    tss__io_out_open(&o, host);
    tss__io_put(&o,
                "<?xml version=\"1.0\"?>\n<VTKFile type=\"Collection\" version=\"1.0\" "
                "byte_order=\"LittleEndian\">\n<Collection>\n");
    for (int i = 0; i < count; i++) {
        tss__io_put(&o, "<DataSet timestep=\"");
        tss__io_put_double(&o, times[i]);
        tss__io_put(&o, "\" part=\"0\" file=\"");
        tss__io_put_xml(&o, files[i]);
        tss__io_put(&o, "\"/>\n");
    }
    tss__io_put(&o, "</Collection>\n</VTKFile>\n");
    tss_result r = tss__io_out_save(&o, path, error);
    tss__io_out_close(&o);
    return r;
}

// >>obj_ply (private)

static void tss__io_put_row(tss__io_out *o, const char *head, const double *x, int n) {
    tss__io_put(o, head);
    for (int c = 0; c < n; c++) {
        if (c) tss__io_put(o, " ");
        tss__io_put_double(o, x[c]);
    }
    tss__io_put(o, "\n");
}

static void tss__io_put_ints(tss__io_out *o, const char *head, const int *v, int n, int base) {
    tss__io_put(o, head);
    for (int c = 0; c < n; c++) {
        if (c) tss__io_put(o, " ");
        tss__io_put_int(o, v[c] + base);
    }
    tss__io_put(o, "\n");
}

static const char tss__only_tets[] =
    "the mesh has tets and no triangles: write tss_mesh_surface of it";

tss_result tss_mesh_write_obj(const tss_mesh *m, const double *x, const char *path,
                              tss_io_error *error) {
    static const char *const head[] = {"p ", "l ", "f "};
    tss__io_out o;
    tss__io_error_set(error, path, 0, -1, "");
    if (!m || !path) return TSS_ERROR_BAD_ARGUMENT;
    if (m->tets && !m->triangles) return tss__io_write_refuse(error, path, tss__only_tets);
    if (!x) x = m->x;
    tss__io_out_open(&o, &m->host);
    for (size_t i = 0; i < (size_t)m->nodes; i++) tss__io_put_row(&o, "v ", x + 3 * i, 3);
    for (int k = 2; k >= 0; k--) {
        tss__io_cells c = tss__io_mesh_view(m, k);
        for (size_t i = 0; i < (size_t)c.count; i++)
            tss__io_put_ints(&o, head[k], *c.node + i * (size_t)(k + 1), k + 1, 1);
    }
    tss_result r = tss__io_out_save(&o, path, error);
    tss__io_out_close(&o);
    return r;
}

static void tss__ply_text(tss__io_out *o, const tss_mesh *m, const double *x) {
    for (size_t i = 0; i < (size_t)m->nodes; i++) tss__io_put_row(o, "", x + 3 * i, 3);
    for (size_t i = 0; i < (size_t)m->triangles; i++)
        tss__io_put_ints(o, "3 ", m->triangle + 3 * i, 3, 0);
    for (size_t i = 0; i < (size_t)m->edges; i++) tss__io_put_ints(o, "", m->edge + 2 * i, 2, 0);
}

static void tss__ply_binary(tss__io_out *o, const tss_mesh *m, const double *x) {
    for (size_t i = 0; i < 3 * (size_t)m->nodes; i++) {
        uint64_t bits;
        memcpy(&bits, &x[i], sizeof bits);
        tss__io_put_little(o, bits, 8);
    }
    for (size_t i = 0; i < (size_t)m->triangles; i++) {
        tss__io_put_little(o, 3, 1);
        for (size_t c = 0; c < 3; c++) tss__io_put_little(o, (uint64_t)m->triangle[3 * i + c], 4);
    }
    for (size_t i = 0; i < 2 * (size_t)m->edges; i++)
        tss__io_put_little(o, (uint64_t)m->edge[i], 4);
}

tss_result tss_mesh_write_ply(const tss_mesh *m, const double *x, const char *path, int ascii,
                              tss_io_error *error) {
    tss__io_out o;
    tss__io_error_set(error, path, 0, -1, "");
    if (!m || !path) return TSS_ERROR_BAD_ARGUMENT;
    if (m->tets && !m->triangles) return tss__io_write_refuse(error, path, tss__only_tets);
    if (!x) x = m->x;
    tss__io_out_open(&o, &m->host);
    tss__io_put(&o, ascii ? "ply\nformat ascii 1.0\nelement vertex "
                          : "ply\nformat binary_little_endian 1.0\nelement vertex ");
    tss__io_put_int(&o, m->nodes);
    tss__io_put(&o, "\nproperty double x\nproperty double y\nproperty double z\nelement face ");
    tss__io_put_int(&o, m->triangles);
    tss__io_put(&o, "\nproperty list uchar int vertex_indices\n");
    if (m->edges) {
        tss__io_put(&o, "element edge ");
        tss__io_put_int(&o, m->edges);
        tss__io_put(&o, "\nproperty int vertex1\nproperty int vertex2\n");
    }
    tss__io_put(&o, "end_header\n");
    if (ascii)
        tss__ply_text(&o, m, x);
    else
        tss__ply_binary(&o, m, x);
    tss_result r = tss__io_out_save(&o, path, error);
    tss__io_out_close(&o);
    return r;
}

#ifdef __cplusplus
}
#endif
#undef TSS__IO_FORMAT
#if !defined(__clang__) && defined(__GNUC__)
#pragma GCC pop_options
#endif
#endif  // TSS_IMPLEMENTATION
