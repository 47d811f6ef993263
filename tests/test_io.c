// tss_io.h: every format and every way it can be malformed, writers, checks, repairs.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_io.h"

#include <locale.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

// An allocator that counts, and fails the n-th request.
typedef struct counter {
    long calls, live, fail_at;
    size_t most;
} counter;

static void *counting_alloc(size_t bytes, size_t align, void *ctx) {
    counter *c = (counter *)ctx;
    (void)align;
    if (bytes > c->most) c->most = bytes;
    if (++c->calls == c->fail_at) return NULL;
    c->live++;
    return malloc(bytes);
}

static void counting_free(void *p, size_t bytes, void *ctx) {
    (void)bytes;
    ((counter *)ctx)->live--;
    free(p);
}

static tss_host counting_host(counter *c) {
    tss_host h = tss_host_default();
    memset(c, 0, sizeof *c);
    h.alloc = counting_alloc;
    h.free = counting_free;
    h.memory_ctx = c;
    return h;
}

static void test_number_exact(void **state) {
    (void)state;
    // values whose correct rounding is known from the IEEE definition; midpoints from exact powers
    static const struct { const char *text; double value; } row[] = {
        {"0", 0}, {"-0.0", -0.0}, {"1", 1}, {".5", 0.5}, {"5.", 5}, {"+1e2", 100}, {"1D-1", 0.1},
        {"9007199254740993", 9007199254740992.0},              // 2^53 + 1: tie, to even
        {"9007199254740993.0000000000000000000000001", 9007199254740994.0},
        {"9007199254740995", 9007199254740996.0},              // tie, to even (up)
        {"2.2250738585072011e-308", 0x0.fffffffffffffp-1022},  // the value that hung PHP and Java
        {"2.2250738585072012e-308", 0x1p-1022},
        {"4.9406564584124654e-324", 0x1p-1074},
        {"2.4703282292062327e-324", 0},                        // below half the smallest
        {"2.4703282292062328e-324", 0x1p-1074},
        {"1.7976931348623157e308", 0x1.fffffffffffffp1023},
        {"1.7976931348623158e308", 0x1.fffffffffffffp1023},
        {"6.02214076e23", 6.02214076e23}, {"1e23", 1e23}, {"8.5e-300", 8.5e-300},
        {"1e-400", 0}, {"0e999999999999999999999", 0},
        {"0.000000000000000000000000000000000000000000001e45", 1},
    };
    for (size_t i = 0; i < sizeof row / sizeof *row; i++) {
        double v = 7;
        assert_int_equal(tss_parse_double(row[i].text, strlen(row[i].text), &v), TSS_OK);
        if (memcmp(&v, &row[i].value, sizeof v)) fail_msg("%s: %a", row[i].text, v);
    }
    static const char *const bad[] = {"", "-", ".", "e5", "1e", "1e+", "nan", "inf", "-Infinity",
                                      "0x10", "1,5", "1.2.3", "1e400", "1.7976931348623159e308",
                                      " 1", "1 ", "--1", "1f"};
    for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
        double v;
        if (tss_parse_double(bad[i], strlen(bad[i]), &v) != TSS_ERROR_FORMAT)
            fail_msg("'%s' was accepted", bad[i]);
    }
}

static void test_number_long_tie(void **state) {
    (void)state;
    // 1 + 2^-53 written out in full is a tie (down to even); one more digit 1 far behind breaks it
    char text[1200] = "1.00000000000000011102230246251565404236316680908203125";
    double v;
    size_t n = strlen(text);
    assert_int_equal(tss_parse_double(text, n, &v), TSS_OK);
    assert_true(v == 1.0);
    memset(text + n, '0', 1100);
    text[n + 1100] = '1';
    assert_int_equal(tss_parse_double(text, n + 1101, &v), TSS_OK);
    assert_true(v == 0x1.0000000000001p0);
}

// xorshift64*, so that a failure can be repeated from the printed seed
static uint64_t next_random(uint64_t *s) {
    *s ^= *s >> 12, *s ^= *s << 25, *s ^= *s >> 27;
    return *s * 2685821657736338717ull;
}

static void test_number_round_trip(void **state) {
    (void)state;
    uint64_t seed = 20240607;
    print_message("seed %llu\n", (unsigned long long)seed);
    for (int i = 0; i < 100000; i++) {
        uint64_t bits = next_random(&seed);
        double v, w, libc;
        char text[64];
        memcpy(&v, &bits, sizeof v);
        if (v - v != 0) continue;
        int n = tss_format_double(v, text);
        assert_true(n > 0 && n < 32 && text[n] == 0);
        assert_int_equal(tss_parse_double(text, (size_t)n, &w), TSS_OK);
        if (memcmp(&v, &w, sizeof v)) fail_msg("%a -> %s -> %a", v, text, w);
        // independent: the C library's conversion of a number of 1 to 25 digits
        snprintf(text, sizeof text, "%.*e", i % 25, v);
        assert_int_equal(tss_parse_double(text, strlen(text), &w) == TSS_OK,
                         fabs(strtod(text, NULL)) <= 1.7976931348623157e308);
        libc = strtod(text, NULL);
        if (libc - libc == 0 && libc != w) fail_msg("%s: %a, C library %a", text, w, libc);
    }
}

static void test_locale(void **state) {
    (void)state;
    static const char *const names[] = {"de_DE.UTF-8", "de_DE", "fr_FR.UTF-8", "ps_AF"};
    int found = 0;
    for (size_t i = 0; i < 4 && !found; i++) found = setlocale(LC_NUMERIC, names[i]) != NULL;
    char text[32];
    double v;
    assert_int_equal(tss_parse_double("1.25", 4, &v), TSS_OK);
    assert_true(v == 1.25);
    assert_true(tss_format_double(1.25, text) == 4);
    assert_string_equal(text, "1.25");
    setlocale(LC_NUMERIC, "C");
    if (!found) print_message("no locale with a decimal comma here: tested in C only\n");
}

// ---- small files -----------------------------------------------------------------------------

static const char msh22[] =
    "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Comments\nx $Nodes\n$EndComments\n"
    "$Nodes\n4\n10 0 0 0\n20 1 0 0\n5 0 1 0\n7 0 0 1\n$EndNodes\n"
    "$Elements\n4\n1 15 2 0 9 10\n2 1 2 3 1 10 20\n3 2 3 4 1 0 10 5 20\n4 4 2 8 1 10 20 5 7\n"
    "$EndElements\n";
static const char msh41[] =
    "$MeshFormat\r\n4.1 0 8\r\n$EndMeshFormat\r\n$PhysicalNames\n1\n3 6 \"x\"\n$EndPhysicalNames\n"
    "$Entities\n1 1 0 1\n1 0 0 0 0\n2 0 0 0 1 1 1 0 1 -1\n3 0 0 0 1 1 1 1 6 0\n$EndEntities\n"
    "$Nodes\n2 4 3 9\n0 1 0 1\n9\n0 0 0\n3 3 1 3\n3\n4\n8\n1 0 0 .1 .2 .3\n0 1 0 .1 .2 .3\n"
    "0 0 1 .1 .2 .3\n$EndNodes\n$Elements\n2 2 1 2\n1 2 1 1\n1 9 3\n3 3 4 1\n2 9 3 4 8\n"
    "$EndElements\n$Surface\n1\n1 2 3\n$EndSurface\n";
static const char medit[] =
    "MeshVersionFormatted 2\n# a comment\nDimension\n3\nVertices 4\n0 0 0 1\n1 0 0 2\n0 1 0 3\n"
    "0 0 1 4\nCorners\n2\n1 2\nEdges 1\n1 2 5\nTriangles 1\n1 3 2 6\nTetrahedra 1\n1 2 3 4 7\nEnd\n";
static const char obj[] =
    "# x\nmtllib a.mtl\nv 0 0 0\nv 1 0 0 1.0\nv 1 1 0 .5 .5 .5\nv 0 1 0\nvt 0 0\nvn 0 0 1\n"
    "f 1/1/1 2//1 3/1 \\\n 4\nf -4 -3 -1\nl 1 2 3\np 4\n";
static const char ply_text[] =
    "ply\nformat ascii 1.0\ncomment x\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property float z\nproperty uchar red\nelement face 1\nproperty list uchar int vertex_indices\n"
    "element edge 1\nproperty int vertex1\nproperty int vertex2\nelement odd 2\n"
    "property list int float w\nend_header\n0 0 0 255\n1 0 0 1\n1 1 0 2\n0 1 0 3\n4 0 1 2 3\n1 3\n"
    "2 0.5 0.25\n0\n";
static const char node1[] = "# n\n4 3 1 1\n1 0 0 0 .5 7\n2 1 0 0 .5 7\n3 0 1 0 .5 7 # c\n4 0 0 1 .5 8\n";
static const char ele1[] = "1 4 1\n1 1 2 3 4 2\n# end\n";
static const char node2d[] = "3 2 0 0\n0 0 0\n1 1 0\n2 0 1\n";
static const char ele2d[] = "1 3 0\n0 0 1 2\n";
static const char seg[] = "v 0 0 0\nv 1 0 0\ns 1 2";

static tss_mesh parse(tss_mesh_format f, const void *data, size_t size) {
    tss_mesh m;
    tss_io_error e;
    tss_result r = tss_mesh_parse(NULL, f, "t", data, size, &m, &e);
    if (r != TSS_OK) fail_msg("%lld/%lld: %s", e.line, e.byte, e.message);
    return m;
}

// The right-angled unit tet with positive orientation.
static void assert_unit_tet(const tss_mesh *m) {
    static const double x[12] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1};
    static const int t[4] = {0, 1, 2, 3};
    assert_int_equal(m->dim, 3);
    assert_int_equal(m->nodes, 4);
    assert_int_equal(m->tets, 1);
    assert_memory_equal(m->x, x, sizeof x);
    assert_memory_equal(m->tet, t, sizeof t);
}

static void test_gmsh_text(void **state) {
    (void)state;
    tss_mesh m = parse(TSS_MESH_GMSH, msh22, strlen(msh22));
    assert_unit_tet(&m);
    assert_int_equal(m.tet_region[0], 8);
    assert_int_equal(m.points, 1);
    assert_int_equal(m.point_region[0], 9);
    assert_int_equal(m.edge_region[0], 3);
    assert_int_equal(m.triangle_region[0], 4);
    assert_true(m.triangle[0] == 0 && m.triangle[1] == 2 && m.triangle[2] == 1);
    tss_mesh_free(&m);
    m = parse(TSS_MESH_AUTO, msh41, strlen(msh41));
    assert_unit_tet(&m);
    assert_int_equal(m.tet_region[0], 6);   // physical group of volume 3
    assert_int_equal(m.edge_region[0], 2);  // curve 2 has none: the entity
    tss_mesh_free(&m);
}

// Bytes of a binary file, in either order.
typedef struct bytes {
    unsigned char p[4096];
    size_t n;
    int big;
} bytes;

static void add_raw(bytes *b, const void *v, size_t n) {
    const uint16_t probe = 1;
    int little = *(const unsigned char *)(const void *)&probe;
    for (size_t i = 0; i < n; i++)
        b->p[b->n++] = ((const unsigned char *)v)[b->big == little ? n - 1 - i : i];
}
static void add_i4(bytes *b, int32_t v) { add_raw(b, &v, 4); }
static void add_i8(bytes *b, int64_t v) { add_raw(b, &v, 8); }
static void add_f8(bytes *b, double v) { add_raw(b, &v, 8); }
static void add_text(bytes *b, const char *s) {
    memcpy(b->p + b->n, s, strlen(s));
    b->n += strlen(s);
}
static const double corner[4][3] = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}};

static void make_msh22(bytes *b, int big) {
    memset(b, 0, sizeof *b);
    b->big = big;
    add_text(b, "$MeshFormat\n2.2 1 8\n");
    add_i4(b, 1);
    add_text(b, "\n$EndMeshFormat\n$Odd\n");
    add_i4(b, 77);
    add_text(b, "\n$EndOdd\n$Nodes\n4\n");
    for (int i = 0; i < 4; i++) {
        add_i4(b, 40 - i);
        for (int c = 0; c < 3; c++) add_f8(b, corner[i][c]);
    }
    add_text(b, "\n$EndNodes\n$Elements\n3\n");
    const int head[3] = {2, 2, 1}, tets[3] = {4, 1, 2};
    for (int i = 0; i < 3; i++) add_i4(b, head[i]);
    for (int e = 0; e < 2; e++) {
        add_i4(b, e + 1), add_i4(b, 11 + e);
        for (int c = 0; c < 3; c++) add_i4(b, 40 - c - e);
    }
    for (int i = 0; i < 3; i++) add_i4(b, tets[i]);
    add_i4(b, 3), add_i4(b, 0), add_i4(b, 5);
    for (int c = 0; c < 4; c++) add_i4(b, 40 - c);
    add_text(b, "\n$EndElements\n");
}

static void make_msh41(bytes *b, int big) {
    memset(b, 0, sizeof *b);
    b->big = big;
    add_text(b, "$MeshFormat\n4.1 1 8\n");
    add_i4(b, 1);
    add_text(b, "\n$EndMeshFormat\n$Entities\n");
    for (int d = 0; d < 4; d++) add_i8(b, d == 3 ? 1 : 0);
    add_i4(b, 5);
    for (int i = 0; i < 6; i++) add_f8(b, i);
    add_i8(b, 2), add_i4(b, 21), add_i4(b, 22), add_i8(b, 1), add_i4(b, -3);
    add_text(b, "\n$EndEntities\n$Nodes\n");
    add_i8(b, 1), add_i8(b, 4), add_i8(b, 100), add_i8(b, 103);
    add_i4(b, 3), add_i4(b, 5), add_i4(b, 0), add_i8(b, 4);
    for (int i = 0; i < 4; i++) add_i8(b, 100 + i);
    for (int i = 0; i < 12; i++) add_f8(b, corner[i / 3][i % 3]);
    add_text(b, "\n$EndNodes\n$Elements\n");
    add_i8(b, 1), add_i8(b, 1), add_i8(b, 1), add_i8(b, 1);
    add_i4(b, 3), add_i4(b, 5), add_i4(b, 4), add_i8(b, 1);
    add_i8(b, 1);
    for (int i = 0; i < 4; i++) add_i8(b, 100 + i);
    add_text(b, "\n$EndElements\n");
}

static void test_gmsh_binary(void **state) {
    (void)state;
    bytes b;
    for (int big = 0; big < 2; big++) {
        make_msh22(&b, big);
        tss_mesh m = parse(TSS_MESH_GMSH, b.p, b.n);
        assert_unit_tet(&m);
        assert_int_equal(m.tet_region[0], 5);
        assert_int_equal(m.triangles, 2);
        assert_int_equal(m.triangle_region[1], 12);
        assert_true(m.triangle[3] == 1 && m.triangle[5] == 3);
        tss_mesh_free(&m);
        make_msh41(&b, big);
        m = parse(TSS_MESH_GMSH, b.p, b.n);
        assert_unit_tet(&m);
        assert_int_equal(m.tet_region[0], 21);
        tss_mesh_free(&m);
    }
}

static void test_medit(void **state) {
    (void)state;
    tss_mesh m = parse(TSS_MESH_MEDIT, medit, strlen(medit));
    assert_unit_tet(&m);
    assert_true(m.tet_region[0] == 7 && m.triangle_region[0] == 6 && m.edge_region[0] == 5);
    assert_int_equal(m.node_marker[3], 4);
    tss_mesh_free(&m);
}

static void test_tetgen(void **state) {
    (void)state;
    tss_mesh m;
    tss_io_error e;
    assert_int_equal(tss_mesh_parse_tetgen(NULL, "n", node1, strlen(node1), "e", ele1,
                                           strlen(ele1), &m, &e), TSS_OK);
    assert_unit_tet(&m);
    assert_true(m.tet_region[0] == 2 && m.node_marker[3] == 8);
    tss_mesh_free(&m);
    assert_int_equal(tss_mesh_parse_tetgen(NULL, "n", node2d, strlen(node2d), "e", ele2d,
                                           strlen(ele2d), &m, &e), TSS_OK);
    assert_true(m.dim == 2 && m.triangles == 1 && m.triangle[2] == 2 && m.x[7] == 1);
    tss_mesh_free(&m);
    m = parse(TSS_MESH_TETGEN, node1, strlen(node1));  // alone: a set of points
    assert_true(m.points == 4 && m.point[3] == 3 && m.tets == 0);
    tss_mesh_free(&m);
}

static void test_obj_seg(void **state) {
    (void)state;
    static const int fan[9] = {0, 1, 2, 0, 2, 3, 0, 1, 3};
    tss_mesh m = parse(TSS_MESH_OBJ, obj, strlen(obj));
    assert_true(m.nodes == 4 && m.triangles == 3 && m.edges == 2 && m.points == 1);
    assert_memory_equal(m.triangle, fan, sizeof fan);
    assert_true(m.edge[2] == 1 && m.edge[3] == 2 && m.point[0] == 3);
    tss_mesh_free(&m);
    m = parse(TSS_MESH_SEG, seg, strlen(seg));
    assert_true(m.edges == 1 && m.edge[1] == 1 && m.nodes == 2);
    tss_mesh_free(&m);
}

static void make_ply(bytes *b, int big) {
    memset(b, 0, sizeof *b);
    b->big = big;
    add_text(b, big ? "ply\nformat binary_big_endian 1.0\n" : "ply\r\nformat binary_little_endian 1.0\r\n");
    add_text(b, "element vertex 4\nproperty float x\nproperty double y\nproperty short z\n"
             "element face 1\nproperty uchar q\nproperty list ushort uint vertex_index\nend_header\n");
    for (int i = 0; i < 4; i++) {
        float x = i == 1 || i == 2 ? 1.5f : 0;
        int16_t z = -300;
        add_raw(b, &x, 4), add_f8(b, i > 1 ? 2.5 : 0), add_raw(b, &z, 2);
    }
    b->p[b->n++] = 9;
    uint16_t n = 4;
    add_raw(b, &n, 2);
    for (int i = 0; i < 4; i++) add_i4(b, i);
}

static void test_ply(void **state) {
    (void)state;
    static const int fan[6] = {0, 1, 2, 0, 2, 3};
    tss_mesh m = parse(TSS_MESH_PLY, ply_text, strlen(ply_text));
    assert_true(m.nodes == 4 && m.triangles == 2 && m.edges == 1 && m.edge[1] == 3);
    assert_memory_equal(m.triangle, fan, sizeof fan);
    tss_mesh_free(&m);
    for (int big = 0; big < 2; big++) {
        bytes b;
        make_ply(&b, big);
        m = parse(TSS_MESH_PLY, b.p, b.n);
        assert_memory_equal(m.triangle, fan, sizeof fan);
        assert_true(m.x[3] == 1.5 && m.x[7] == 2.5 && m.x[2] == -300);
        tss_mesh_free(&m);
    }
}

// ---- malformed -------------------------------------------------------------------------------

typedef struct wrong {
    tss_mesh_format format;
    const char *text;
    long long line;
    const char *says;  // must occur in the message
} wrong;

#define G "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
#define N G "$Nodes\n3\n1 0 0 0\n2 1 0 0\n3 0 1 0\n$EndNodes\n"
#define G4 "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n"
#define N4 G4 "$Nodes\n1 2 1 2\n3 1 0 2\n1\n2\n0 0 0\n1 0 0\n$EndNodes\n"
#define M "MeshVersionFormatted 1\nDimension 3\n"
#define MV M "Vertices 2\n0 0 0 0\n1 0 0 0\n"
#define P "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
#define PF P "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0\n"

static const wrong wrongs[] = {
    {TSS_MESH_GMSH, "", 1, "expected $MeshFormat, found end of file"},
    {TSS_MESH_GMSH, "\nhello\n", 2, "expected a section ($Nodes, $Elements, ...), found 'hello'"},
    {TSS_MESH_GMSH, "$Nodes\n1\n", 1, "expected $MeshFormat, found '$Nodes'"},
    {TSS_MESH_GMSH, "$MeshFormat\n3.0 0 8\n", 2, "expected Gmsh format 2.2 or 4.1, found '3.0'"},
    {TSS_MESH_GMSH, "$MeshFormat\n4 0 8\n", 2, "expected Gmsh format 2.2 or 4.1, found '4'"},
    {TSS_MESH_GMSH, "$MeshFormat\n2.2 2 8\n", 2, "expected the file type (0 or 1), found 2"},
    {TSS_MESH_GMSH, "$MeshFormat\n2.2 0 4\n", 2, "expected data size 8, found 4"},
    {TSS_MESH_GMSH, "$MeshFormat\n2.2 0 8\n$Foo\n", 3, "expected $EndMeshFormat, found '$Foo'"},
    {TSS_MESH_GMSH, G "$MeshFormat\n", 4, "$MeshFormat occurs twice"},
    {TSS_MESH_GMSH, G "$Odd\n1\n2\n", 4, "expected $EndOdd, found end of file"},
    {TSS_MESH_GMSH, G, 4, "expected $Nodes, found end of file"},
    {TSS_MESH_GMSH, G "$Nodes\nx\n", 5, "expected the number of nodes, found 'x'"},
    {TSS_MESH_GMSH, G "$Nodes\n-1\n", 5, "expected a number of nodes, found -1"},
    {TSS_MESH_GMSH, G "$Nodes\n1000000\n1 0 0 0\n", 5, "1000000 nodes announced, but only 9 bytes"},
    {TSS_MESH_GMSH, G "$Nodes\n1\n1 0 0 nan\n", 6, "expected a coordinate, found 'nan'"},
    {TSS_MESH_GMSH, G "$Nodes\n1\n1 0 0 1e999\n", 6, "expected a coordinate, found '1e999'"},
    {TSS_MESH_GMSH, G "$Nodes\n1\n1 0 0,0 0\n", 6, "expected a coordinate, found '0,0'"},
    {TSS_MESH_GMSH, G "$Nodes\n2\n1 0 0 0\n1 0 0 0\n$EndNodes\n", 7, "node 1 is defined twice"},
    {TSS_MESH_GMSH, N, 10, "expected $Elements, found end of file"},
    {TSS_MESH_GMSH, N "$Nodes\n", 10, "$Nodes occurs twice"},
    {TSS_MESH_GMSH, G "$Elements\n", 4, "expected $Nodes before $Elements"},
    {TSS_MESH_GMSH, N "$Elements\n1\n1 2 1 0 1 2 9\n", 12, "names node 9, which is not in $Nodes"},
    {TSS_MESH_GMSH, N "$Elements\n1\n1 3 1 0 1 2 3\n", 12, "element type 3 (quadrangle)"},
    {TSS_MESH_GMSH, N "$Elements\n1\n1 11 1 0 1 2 3\n", 12, "type 11 (10-node tetrahedron)"},
    {TSS_MESH_GMSH, N "$Elements\n1\n1 2 1 0 1 2\n", 13, "expected an element's node, found end"},
    {TSS_MESH_GMSH, N "$Elements\n1\n1 2 1 0 1 2 3\n4\n", 13, "expected $EndElements, found '4'"},
    {TSS_MESH_GMSH, N "$Elements\n1\n1 2 -1 0 1 2 3\n", 12, "expected a number of tags from 0 to"},
    {TSS_MESH_GMSH, G4 "$Nodes\n1 2 1 2\n3 1 0 3\n1\n2\n3\n0 0 0 0 0 0 0 0 0\n", 6, "more nodes in"},
    {TSS_MESH_GMSH, G4 "$Nodes\n1 2 1 2\n3 1 0 1\n1\n0 0 0\n$EndNodes\n", 8, "expected 2 nodes"},
    {TSS_MESH_GMSH, G4 "$Nodes\n1 1 1 1\n4 1 0 1\n1\n0 0 0\n", 6, "dimension from 0 to 3, found 4"},
    {TSS_MESH_GMSH, N4 "$Elements\n1 1 1 1\n1 1 1 2\n1 1 2\n2 2 1\n", 14, "more elements in"},
    {TSS_MESH_GMSH, N4 "$Elements\n1 3 1 1\n1 1 1 1\n1 1 2\n$EndElements\n", 15, "expected 3 elem"},
    {TSS_MESH_GMSH, G4 "$Entities\n-1 0 0 0\n", 5, "expected a number of entities, found -1"},
    {TSS_MESH_MEDIT, "", 1, "expected MeshVersionFormatted, found end of file"},
    {TSS_MESH_MEDIT, "MeshVersionFormatted 9\n", 1, "version from 1 to 4, found 9"},
    {TSS_MESH_MEDIT, "MeshVersionFormatted 1\nDimension 4\n", 2, "dimension from 2 to 3, found 4"},
    {TSS_MESH_MEDIT, "MeshVersionFormatted 1\nVertices 1\n", 2, "expected Dimension before"},
    {TSS_MESH_MEDIT, M "Dimension 3\n", 3, "Dimension occurs twice"},
    {TSS_MESH_MEDIT, M "End\n", 3, "expected Vertices"},
    {TSS_MESH_MEDIT, "MeshVersionFormatted 1\nEnd\n", 2, "expected Dimension"},
    {TSS_MESH_MEDIT, M "Vertices 1\n0 0 inf 0\nEnd\n", 4, "expected a coordinate, found 'inf'"},
    {TSS_MESH_MEDIT, M "Vertices 1\n0 0 0 0.5\n", 4, "expected a vertex's reference, found '0.5'"},
    {TSS_MESH_MEDIT, MV "Vertices 1\n", 6, "Vertices occurs twice"},
    {TSS_MESH_MEDIT, MV "Edges 1\n1 3 0\n", 7, "vertex's number from 1 to 2, found 3"},
    {TSS_MESH_MEDIT, MV "Hexahedra 1\n1\n", 6, "Hexahedra are not supported"},
    {TSS_MESH_MEDIT, MV "7\n", 6, "expected a keyword, found '7'"},
    {TSS_MESH_MEDIT, "MeshVersionFormatted 1\nDimension 2\nTetrahedra 1\n", 3, "in 2 dimensions"},
    {TSS_MESH_TETGEN, "", 1, "expected the number of nodes, found end of file"},
    {TSS_MESH_TETGEN, "1 4 0 0\n", 1, "dimension from 2 to 3, found 4"},
    {TSS_MESH_TETGEN, "1 3 0 0 5\n", 1, "expected the end of the line, found '5'"},
    {TSS_MESH_TETGEN, "1 3 0 0\n2 0 0 0\n", 2, "first node's number from 0 to 1, found 2"},
    {TSS_MESH_TETGEN, "2 3 0 0\n1 0 0 0\n3 0 0 0\n", 3, "next node's number from 2 to 2, found 3"},
    {TSS_MESH_TETGEN, "1 3 0 0\n1 0 0\n0 0\n", 2, "expected a coordinate, found end of line"},
    {TSS_MESH_TETGEN, "1 3 0 0\n1 0 0 0 7\n", 2, "expected the end of the line, found '7'"},
    {TSS_MESH_TETGEN, "1 3 0 0\n1 0 0 0\n2 0 0 0\n", 3, "expected the end of the file, found '2'"},
    {TSS_MESH_TETGEN, "99 3 0 0\n1 0 0 0\n", 1, "99 nodes announced, but only"},
    {TSS_MESH_OBJ, "", 1, "expected vertices, found none"},
    {TSS_MESH_OBJ, "v 0 0\nv 1 0 0\n", 1, "expected a coordinate, found end of line"},
    {TSS_MESH_OBJ, "v 0 0 1x\n", 1, "expected a coordinate, found '1x'"},
    {TSS_MESH_OBJ, "v 0 0 0\nhello 1\n", 2, "expected v, f, l, p or another OBJ keyword"},
    {TSS_MESH_OBJ, "v 0 0 0\nf 1 1\n", 2, "expected at least 3 vertex indices, found 2"},
    {TSS_MESH_OBJ, "v 0 0 0\nf 1 0 1\n", 2, "expected a vertex index from 1 (or negative), found 0"},
    {TSS_MESH_OBJ, "v 0 0 0\nf 1 1 -2\n", 2, "vertex index -2, but there are 1 vertices"},
    {TSS_MESH_OBJ, "v 0 0 0\n\nf 1 1 4\nv 1 0 0\n", 3, "vertex index 4, but there are 2 vertices"},
    {TSS_MESH_OBJ, "v 0 0 0\nf 1/x 1 1\n", 2, "expected a texture or normal index, found 'x'"},
    {TSS_MESH_OBJ, "v 0 0 0\nf 1/1/1/1 1 1\n", 2, "expected a texture or normal index, found '1/1'"},
    {TSS_MESH_SEG, "v 0 0 0\nv 0 0 1\ns 1\n", 3, "expected at least 2 vertex indices, found 1"},
    {TSS_MESH_PLY, "plx\n", 1, "expected ply, found 'plx'"},
    {TSS_MESH_PLY, "ply\nend_header\n", 2, "expected a format line before end_header"},
    {TSS_MESH_PLY, "ply\nformat ascii 2.0\n", 2, "expected 1.0, found '2.0'"},
    {TSS_MESH_PLY, "ply\nformat odd 1.0\n", 2, "expected ascii, binary_little_endian or"},
    {TSS_MESH_PLY, "ply\nformat ascii 1.0\nproperty int x\n", 3, "an element before its properties"},
    {TSS_MESH_PLY, "ply\nformat ascii 1.0\nelement vertex\n", 3, "expected an element's count"},
    {TSS_MESH_PLY, "ply\nformat ascii 1.0\nfoo\n", 3, "expected element, property or end_header"},
    {TSS_MESH_PLY, "ply\nformat ascii 1.0\nend_header\n", 4, "expected an element vertex"},
    {TSS_MESH_PLY, P "property quad z\n", 6, "expected a type (char ... double), found 'quad'"},
    {TSS_MESH_PLY, P "property float x\n", 6, "a property that has not occurred yet, found 'x'"},
    {TSS_MESH_PLY, P "element vertex 1\n", 6, "an element that has not occurred yet"},
    {TSS_MESH_PLY, P "property list float int q\n", 6, "expected an integer type"},
    {TSS_MESH_PLY, P "element face 1\nend_header\n0 0\n", 8, "expected the list vertex_indices"},
    {TSS_MESH_PLY, P "element edge 1\nproperty int vertex1\nend_header\n0 0\n", 9, "vertex1 and vertex2"},
    {TSS_MESH_PLY, P "end_header\n0 nan\n", 7, "expected a number, found 'nan'"},
    {TSS_MESH_PLY, P "end_header\n0 0\n5\n", 8, "expected the end of the file, found '5'"},
    {TSS_MESH_PLY, PF "2 0 0\n", 10, "a list of at least 3 numbers, found 2"},
    {TSS_MESH_PLY, PF "3 0 0 1\n", 10, "a vertex index from 0 to 0, found 1"},
    {TSS_MESH_PLY, PF "200 0 0 0\n", 10, "a list of 200 numbers, but only"},
    {TSS_MESH_AUTO, "hello", 1, "not a mesh file by its name or contents"},
};

static void test_malformed(void **state) {
    (void)state;
    for (size_t i = 0; i < sizeof wrongs / sizeof *wrongs; i++) {
        const wrong *w = &wrongs[i];
        counter c;
        tss_host h = counting_host(&c);
        tss_mesh m;
        tss_io_error e;
        tss_result r = tss_mesh_parse(&h, w->format, "dir/name", w->text, strlen(w->text), &m, &e);
        if (r != TSS_ERROR_FORMAT || e.line != w->line || !strstr(e.message, w->says))
            fail_msg("case %d: %d, line %lld: %s\nwanted line %lld: %s", (int)i, (int)r, e.line,
                     e.message, w->line, w->says);
        assert_string_equal(e.file, "dir/name");
        assert_true(m.nodes == 0 && m.x == NULL && m.tet == NULL);
        assert_int_equal(c.live, 0);
        assert_true(c.most < 100000);  // lying counts allocate nothing
    }
}

static void test_malformed_ele(void **state) {
    (void)state;
    static const struct { const char *ele; long long line; const char *says; } row[] = {
        {"", 1, "expected the number of cells, found end of file"},
        {"1 10 0\n", 1, "expected 4 nodes a cell in 3 dimensions, found 10"},
        {"1 4 0\n1 1 2 3 5\n", 2, "a node's number from 1 to 4, found 5"},
        {"1 4 0\n1 0 1 2 3\n", 2, "a node's number from 1 to 4, found 0"},
        {"1 4 0\n2 1 2 3 4\n", 2, "next cell's number from 1 to 1, found 2"},
        {"1 4 0\n1 1 2 3 4 9\n", 2, "expected the end of the line, found '9'"},
    };
    for (size_t i = 0; i < sizeof row / sizeof *row; i++) {
        tss_mesh m;
        tss_io_error e;
        assert_int_equal(tss_mesh_parse_tetgen(NULL, "a.node", node1, strlen(node1), "a.ele",
                                               row[i].ele, strlen(row[i].ele), &m, &e),
                         TSS_ERROR_FORMAT);
        assert_string_equal(e.file, "a.ele");
        if (e.line != row[i].line || !strstr(e.message, row[i].says))
            fail_msg("%lld: %s", e.line, e.message);
    }
}

// A cut file is an error or a mesh the checks accept, and never leaks; so is a file with one odd
// byte. Both copies are exactly as long as they say, so that ASan sees a read past the end.
static void cut_and_spoil(tss_mesh_format f, const void *data, size_t size) {
    uint64_t seed = size + 1;
    int refused = 0;
    for (size_t i = 0; i < 3 * size; i++) {
        size_t n = i < size ? i : size;
        unsigned char *copy = (unsigned char *)malloc(n ? n : 1);
        memcpy(copy, data, n);
        if (i >= size) copy[i % size] = (unsigned char)next_random(&seed);
        counter c;
        tss_host h = counting_host(&c);
        tss_mesh m;
        tss_io_error e;
        tss_mesh_report rep;
        tss_result r = tss_mesh_parse(&h, f, "cut", copy, n, &m, &e);
        assert_true(r == TSS_OK || r == TSS_ERROR_FORMAT);
        assert_true(c.most < 100000);
        if (r == TSS_OK) {
            assert_int_equal(tss_mesh_check(&m, &rep), TSS_OK);
            assert_int_equal(rep.count[TSS_MESH_BAD_INDEX_TET], 0);
            assert_int_equal(rep.count[TSS_MESH_BAD_INDEX_TRIANGLE], 0);
            assert_int_equal(rep.count[TSS_MESH_NOT_FINITE], 0);
        } else {
            refused++;
            assert_true(e.message[0] && m.nodes == 0 && (e.line > 0 || e.byte >= 0));
        }
        tss_mesh_free(&m);
        assert_int_equal(c.live, 0);
        free(copy);
    }
    assert_true(refused > (int)size / 2);
}

static void test_cut(void **state) {
    (void)state;
    bytes b;
    cut_and_spoil(TSS_MESH_GMSH, msh22, strlen(msh22));
    cut_and_spoil(TSS_MESH_GMSH, msh41, strlen(msh41));
    cut_and_spoil(TSS_MESH_MEDIT, medit, strlen(medit));
    cut_and_spoil(TSS_MESH_PLY, ply_text, strlen(ply_text));
    cut_and_spoil(TSS_MESH_TETGEN, node1, strlen(node1));
    for (int big = 0; big < 2; big++) {
        make_msh22(&b, big);
        cut_and_spoil(TSS_MESH_GMSH, b.p, b.n);
        make_msh41(&b, big);
        cut_and_spoil(TSS_MESH_GMSH, b.p, b.n);
        make_ply(&b, big);
        cut_and_spoil(TSS_MESH_PLY, b.p, b.n);
    }
}

static void test_binary_nan(void **state) {
    (void)state;
    bytes b;
    tss_mesh m;
    tss_io_error e;
    make_msh41(&b, 0);
    double nan_value = NAN;
    size_t at = 0;
    while (memcmp(b.p + at, "$Nodes", 6)) at++;
    at += 7 + 32 + 20 + 32;
    memcpy(b.p + at, &nan_value, 8);
    const uint16_t probe = 1;
    if (!*(const unsigned char *)(const void *)&probe) return;
    assert_int_equal(tss_mesh_parse(NULL, TSS_MESH_GMSH, "b", b.p, b.n, &m, &e), TSS_ERROR_FORMAT);
    assert_true(e.line == 0 && e.byte == (long long)at + 8);
    assert_non_null(strstr(e.message, "found inf or nan"));
    make_ply(&b, 0);
    float inf = INFINITY;
    for (at = 0; memcmp(b.p + at, "end_header\n", 11); at++) {}
    memcpy(b.p + at + 11, &inf, 4);
    assert_int_equal(tss_mesh_parse(NULL, TSS_MESH_PLY, "b", b.p, b.n, &m, &e), TSS_ERROR_FORMAT);
    assert_true(e.line == 0 && e.byte == (long long)at + 11);
}

static void test_meshb(void **state) {
    (void)state;
    static const unsigned char head[8] = {1, 0, 0, 0, 2, 0, 0, 0};
    tss_mesh m;
    tss_io_error e;
    assert_int_equal(tss_mesh_parse(NULL, TSS_MESH_AUTO, "a.MESHB", head, 8, &m, &e),
                     TSS_ERROR_FORMAT);
    assert_non_null(strstr(e.message, "save as ASCII"));
}

// ---- files, writers --------------------------------------------------------------------------

static char folder[200];

static const char *in_folder(const char *name) {
    static char path[400];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    return path;
}

static void write_text(const char *name, const void *data, size_t n) {
    FILE *f = fopen(in_folder(name), "wb");
    assert_non_null(f);
    assert_int_equal(fwrite(data, 1, n, f), n);
    fclose(f);
}

static char *slurp(const char *path, size_t *n) {
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    char *p = (char *)malloc(1 << 20);
    *n = fread(p, 1, (1 << 20) - 1, f);
    p[*n] = 0;
    fclose(f);
    return p;
}

static tss_mesh mixed_mesh(const tss_host *h) {
    tss_mesh m;
    assert_int_equal(tss_mesh_alloc(h, 3, 5, 1, 2, 1, 1, &m), TSS_OK);
    static const int tet[4] = {0, 1, 2, 3}, tri[6] = {0, 2, 1, 1, 2, 4}, edge[2] = {3, 4};
    for (int i = 0; i < 15; i++) m.x[i] = 0.1 * i * i - 1.0 / (i + 3);
    memcpy(m.tet, tet, sizeof tet);
    memcpy(m.triangle, tri, sizeof tri);
    memcpy(m.edge, edge, sizeof edge);
    m.point[0] = 4;
    m.tet_region[0] = 42;
    return m;
}

static void assert_same_surface(const tss_mesh *a, const tss_mesh *b) {
    assert_true(a->nodes == b->nodes && a->triangles == b->triangles && a->edges == b->edges);
    assert_memory_equal(a->x, b->x, (size_t)a->nodes * 24);
    assert_memory_equal(a->triangle, b->triangle, (size_t)a->triangles * 12);
    assert_memory_equal(a->edge, b->edge, (size_t)a->edges * 8);
}

static void test_write_surface(void **state) {
    (void)state;
    tss_mesh m = mixed_mesh(NULL), back;
    tss_io_error e;
    for (int k = 0; k < 3; k++) {
        const char *path = in_folder(k ? "t.ply" : "t.obj");
        tss_result r = k ? tss_mesh_write_ply(&m, NULL, path, k == 1, &e)
                         : tss_mesh_write_obj(&m, NULL, path, &e);
        assert_int_equal(r, TSS_OK);
        assert_int_equal(tss_mesh_read(NULL, path, &back, &e), TSS_OK);
        assert_same_surface(&m, &back);
        tss_mesh_free(&back);
    }
    m.triangles = 0;
    assert_int_equal(tss_mesh_write_obj(&m, NULL, in_folder("t.obj"), &e), TSS_ERROR_BAD_ARGUMENT);
    assert_non_null(strstr(e.message, "tss_mesh_surface"));
    assert_int_equal(tss_mesh_write_ply(&m, NULL, in_folder("t.ply"), 1, &e),
                     TSS_ERROR_BAD_ARGUMENT);
    m.triangles = 2;
    tss_mesh_free(&m);
}

// An independent reader of one data array: finds it by name and decodes its numbers.
static int base64_value(char c) {
    static const char d[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    const char *p = c ? strchr(d, c) : NULL;
    return p ? (int)(p - d) : -1;
}

static size_t decode(const char *s, unsigned char *out) {
    size_t n = 0;
    uint32_t bits = 0;
    int have = 0;
    for (; base64_value(*s) >= 0; s++) {
        bits = bits << 6 | (uint32_t)base64_value(*s);
        have += 6;
        if (have >= 8) have -= 8, out[n++] = (unsigned char)(bits >> have);
    }
    return n;
}

static size_t read_array(const char *xml, const char *name, int width, double *out) {
    char key[80];
    snprintf(key, sizeof key, "Name=\"%s\"", name);
    const char *p = strstr(xml, key);
    assert_non_null(p);
    const char *body = strstr(p, ">\n") + 2, *end = strstr(body, "</DataArray>");
    size_t n = 0;
    if (!strncmp(strstr(p, "format=\"") + 8, "ascii", 5)) {
        char *next;
        for (const char *q = body;; q = next) {
            double v = strtod(q, &next);
            if (next == q || next > end) return n;
            out[n++] = v;
        }
    }
    static unsigned char raw[1 << 16];
    size_t got = decode(body, raw);
    uint64_t length;
    memcpy(&length, raw, 8);
    assert_int_equal(length, got - 8);
    for (size_t i = 8; i < got; i += (size_t)width, n++) {
        int64_t w = 0;
        memcpy(&w, raw + i, (size_t)width);
        if (!strncmp(p - 9, "Float64", 7)) memcpy(&out[n], raw + i, 8);
        else out[n] = (double)w;
    }
    return n;
}

// Tags must nest: a stack of their names.
static void assert_well_formed(const char *s) {
    char open[16][32];
    int depth = 0;
    while ((s = strchr(s, '<')) != NULL) {
        const char *end = strchr(s, '>');
        assert_non_null(end);
        size_t n = strcspn(s + 1, " />\n");
        if (s[1] == '/') {
            n = strcspn(s + 2, ">");
            assert_true(depth > 0 && strlen(open[depth - 1]) == n &&
                        !strncmp(open[depth - 1], s + 2, n));
            depth--;
        } else if (s[1] != '?' && end[-1] != '/') {
            assert_true(depth < 16 && n < 32);
            memcpy(open[depth], s + 1, n);
            open[depth++][n] = 0;
        }
        s = end;
    }
    assert_int_equal(depth, 0);
}

static void test_vtu(void **state) {
    (void)state;
    tss_mesh m = mixed_mesh(NULL);
    double scalar[5] = {1, 0.1, -3e-300, 4, 5}, flat[10], cell[5] = {1, 2, 3, 4, 5}, v[200];
    for (int i = 0; i < 10; i++) flat[i] = i;
    const tss_field f[3] = {{"a<b&\"c", scalar, 1, 0}, {"u", flat, 2, 0}, {"e", cell, 1, 1}};
    for (int ascii = 0; ascii < 2; ascii++) {
        size_t n;
        assert_int_equal(tss_mesh_write_vtu(&m, NULL, in_folder("t.vtu"), f, 3, ascii, NULL),
                         TSS_OK);
        char *s = slurp(in_folder("t.vtu"), &n);
        assert_well_formed(s);
        assert_non_null(strstr(s, "NumberOfPoints=\"5\" NumberOfCells=\"5\""));
        assert_int_equal(read_array(s, "Points", 8, v), 15);
        assert_memory_equal(v, m.x, 15 * 8);
        static const double ends[13] = {0, 1, 2, 3, 0, 2, 1, 1, 2, 4, 3, 4, 4};
        static const double offset[5] = {4, 7, 10, 12, 13}, type[5] = {10, 5, 5, 3, 1};
        assert_int_equal(read_array(s, "connectivity", 4, v), 13);
        assert_memory_equal(v, ends, sizeof ends);
        assert_int_equal(read_array(s, "offsets", 8, v), 5);
        assert_memory_equal(v, offset, sizeof offset);
        assert_int_equal(read_array(s, "types", 1, v), 5);
        assert_memory_equal(v, type, sizeof type);
        assert_int_equal(read_array(s, "region", 4, v), 5);
        assert_true(v[0] == 42 && v[1] == 0);
        assert_int_equal(read_array(s, "a&lt;b&amp;&quot;c", 8, v), 5);
        assert_memory_equal(v, scalar, sizeof scalar);
        assert_int_equal(read_array(s, "u", 8, v), 15);  // padded to three components
        assert_true(v[3] == 2 && v[4] == 3 && v[5] == 0);
        assert_int_equal(read_array(s, "e", 8, v), 5);
        assert_memory_equal(v, cell, sizeof cell);
        free(s);
    }
    tss_mesh_free(&m);
}

static void test_pvd(void **state) {
    (void)state;
    const char *files[2] = {"a.vtu", "b&c.vtu"};
    const double times[2] = {0, 0.025};
    size_t n;
    assert_int_equal(tss_write_pvd(NULL, in_folder("t.pvd"), files, times, 2, NULL), TSS_OK);
    char *s = slurp(in_folder("t.pvd"), &n);
    assert_well_formed(s);
    assert_non_null(strstr(s, "timestep=\"0.025\" part=\"0\" file=\"b&amp;c.vtu\"/>"));
    free(s);
}

static void test_write_fails(void **state) {
    (void)state;
    tss_mesh m = mixed_mesh(NULL);
    tss_io_error e;
    assert_int_equal(tss_mesh_write_obj(&m, NULL, in_folder("none/t.obj"), &e), TSS_ERROR_FILE);
    assert_non_null(strstr(e.file, "none/t.obj"));
    assert_non_null(strstr(e.message, "cannot write"));
    // A device that is always full, where there is one. Never opened by the test itself: that would
    // make a plain file of this name where it is missing.
#if defined(__unix__) || defined(__APPLE__)
    struct stat before, after;
    if (stat("/dev/full", &before) == 0 && S_ISCHR(before.st_mode)) {
        assert_int_equal(tss_mesh_write_obj(&m, NULL, "/dev/full", &e), TSS_ERROR_FILE);
        assert_int_equal(stat("/dev/full", &after), 0);
        assert_true(S_ISCHR(after.st_mode));  // the device is still there
    } else {
        print_message("no device /dev/full here: a full disk is not tested\n");
    }
#endif
    tss_mesh_free(&m);
    assert_int_equal(tss_mesh_read(NULL, in_folder("missing.msh"), &m, &e), TSS_ERROR_FILE);
    assert_non_null(strstr(e.message, "cannot open"));
    assert_int_equal(tss_mesh_read(NULL, folder, &m, &e), TSS_ERROR_FILE);  // a directory
}

static void test_read_pair(void **state) {
    (void)state;
    tss_mesh m;
    tss_io_error e;
    write_text("p.node", node1, strlen(node1));
    remove(in_folder("p.ele"));
    assert_int_equal(tss_mesh_read(NULL, in_folder("p.node"), &m, &e), TSS_OK);
    assert_int_equal(m.points, 4);
    tss_mesh_free(&m);
    assert_int_equal(tss_mesh_read(NULL, in_folder("p.ele"), &m, &e), TSS_ERROR_FILE);
    write_text("p.ele", ele1, strlen(ele1));
    static const char *const names[] = {"p.node", "p.ele"};
    for (int i = 0; i < 2; i++) {
        assert_int_equal(tss_mesh_read(NULL, in_folder(names[i]), &m, &e), TSS_OK);
        assert_unit_tet(&m);
        tss_mesh_free(&m);
    }
    write_text("p.ele", "1 4 0\n1 1 2 3 x\n", 16);
    assert_int_equal(tss_mesh_read(NULL, in_folder("p.node"), &m, &e), TSS_ERROR_FORMAT);
    assert_non_null(strstr(e.file, "p.ele"));
    assert_int_equal(e.line, 2);
}

// ---- memory, checks --------------------------------------------------------------------------

static tss_result everything(const tss_host *h) {
    tss_mesh m, s;
    tss_mesh_report rep;
    tss_result r = tss_mesh_read(h, in_folder("m.msh"), &m, NULL);
    if (r != TSS_OK) return r;
    int dropped;
    r = tss_mesh_check(&m, &rep);
    if (r == TSS_OK) r = tss_mesh_drop_unreferenced(&m, &dropped);
    if (r == TSS_OK) r = tss_mesh_write_vtu(&m, NULL, in_folder("m.vtu"), NULL, 0, 0, NULL);
    if (r == TSS_OK) {
        r = tss_mesh_surface(&m, &s);
        if (r == TSS_OK) r = tss_mesh_write_ply(&s, NULL, in_folder("m.ply"), 0, NULL);
        tss_mesh_free(&s);
    }
    tss_mesh_free(&m);
    if (r == TSS_OK && (r = tss_mesh_read(h, in_folder("q.node"), &m, NULL)) == TSS_OK)
        tss_mesh_free(&m);
    return r;
}

static void test_every_allocation(void **state) {
    (void)state;
    counter c;
    tss_host h = counting_host(&c);
    char text[600];
    snprintf(text, sizeof text, "%s", msh22);
    // one node more than the cells use
    char *n = strstr(text, "$Nodes\n4\n");
    memmove(n + 9 + 9, n + 9, strlen(n + 9) + 1);
    memcpy(n, "$Nodes\n5\n99 9 9 9\n", 18);
    write_text("m.msh", text, strlen(text));
    write_text("q.node", node1, strlen(node1));
    write_text("q.ele", ele1, strlen(ele1));
    assert_int_equal(everything(&h), TSS_OK);
    long total = c.calls;
    assert_true(total > 30);
    for (long k = 1; k <= total; k++) {
        h = counting_host(&c);
        c.fail_at = k;
        assert_int_equal(everything(&h), TSS_ERROR_NO_MEMORY);
        assert_int_equal(c.live, 0);
    }
    print_message("%ld allocations failed in turn\n", total);
}

static void test_check_and_repair(void **state) {
    (void)state;
    tss_mesh m;
    tss_mesh_report r;
    char text[200];
    int dropped;
    assert_int_equal(tss_mesh_alloc(NULL, 3, 8, 5, 1, 1, 0, &m), TSS_OK);
    static const double x[24] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1,
                                 9, 9, 9, 1, 1, 0, 0, 0, 0, NAN, 0, 0};
    static const int tet[20] = {0, 1, 2, 3, 0, 2, 1, 3, 0, 1, 2, 5, 0, 1, 2, 8, 1, 2, 3, 7};
    memcpy(m.x, x, sizeof x);
    memcpy(m.tet, tet, sizeof tet);
    m.triangle[0] = 0, m.triangle[1] = 1, m.triangle[2] = 1;
    m.edge[0] = 0, m.edge[1] = 6;
    assert_int_equal(tss_mesh_check(&m, &r), TSS_OK);
    assert_int_equal(r.count[TSS_MESH_INVERTED_TET], 1);
    assert_int_equal(r.first[TSS_MESH_INVERTED_TET][0], 1);
    assert_int_equal(r.count[TSS_MESH_DEGENERATE_TET], 1);
    assert_int_equal(r.first[TSS_MESH_DEGENERATE_TET][0], 2);
    assert_int_equal(r.count[TSS_MESH_BAD_INDEX_TET], 1);
    assert_int_equal(r.first[TSS_MESH_BAD_INDEX_TET][0], 3);
    assert_int_equal(r.count[TSS_MESH_DUPLICATE_TET], 1);
    assert_int_equal(r.first[TSS_MESH_DUPLICATE_TET][0], 1);
    assert_int_equal(r.count[TSS_MESH_NOT_FINITE], 1);
    assert_int_equal(r.count[TSS_MESH_DUPLICATE_NODE], 1);
    assert_int_equal(r.first[TSS_MESH_DUPLICATE_NODE][0], 6);
    assert_int_equal(r.count[TSS_MESH_UNREFERENCED_NODE], 1);
    assert_int_equal(r.first[TSS_MESH_UNREFERENCED_NODE][0], 4);
    assert_int_equal(r.count[TSS_MESH_DEGENERATE_TRIANGLE], 1);
    assert_int_equal(r.count[TSS_MESH_DEGENERATE_EDGE], 1);
    assert_int_equal(r.problems, 9);
    assert_true(r.upper[0] == 9 && r.lower[1] == 0);
    tss_mesh_issue_text(&r, TSS_MESH_INVERTED_TET, text, sizeof text);
    assert_string_equal(text, "1 tet: is inverted (negative volume): 1");
    tss_mesh_issue_text(&r, TSS_MESH_DUPLICATE_EDGE, text, sizeof text);
    assert_string_equal(text, "");
    assert_int_equal(tss_mesh_drop_unreferenced(&m, &dropped), TSS_ERROR_BAD_MESH);
    m.tet[15] = 5;
    assert_int_equal(tss_mesh_flip_inverted(&m), 1);
    assert_int_equal(tss_mesh_flip_inverted(&m), 0);
    assert_int_equal(tss_mesh_drop_unreferenced(&m, &dropped), TSS_OK);
    assert_true(dropped == 1 && m.nodes == 7 && m.tet[15] == 4 && m.edge[1] == 5);
    assert_true(m.x[12] == 1 && m.x[13] == 1);
    tss_mesh_free(&m);
    tss_mesh_free(&m);
    tss_mesh_free(NULL);
}

static void test_surface(void **state) {
    (void)state;
    tss_mesh m = parse(TSS_MESH_GMSH, msh22, strlen(msh22)), s;
    assert_int_equal(tss_mesh_surface(&m, &s), TSS_OK);
    assert_int_equal(s.triangles, 4);
    double volume = 0;  // by the divergence theorem: positive if the faces look outward
    for (int t = 0; t < 4; t++) {
        const double *a = s.x + 3 * s.triangle[3 * t], *b = s.x + 3 * s.triangle[3 * t + 1],
                     *c = s.x + 3 * s.triangle[3 * t + 2];
        volume += (a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) +
                   a[2] * (b[0] * c[1] - b[1] * c[0])) / 6;
    }
    assert_true(fabs(volume - 1.0 / 6) < 1e-15);
    tss_mesh_free(&s);
    tss_mesh_free(&m);
}

// ---- files of other programs, where the tester has them ---------------------------------------

typedef struct known {
    const char *path;
    int dim, nodes, tets, triangles, edges;
    double volume;  // < 0: unknown
} known;

static void test_real_files(void **state) {
    (void)state;
    // counts as in the files' own headers; volumes: closed forms of the boxes
    static const known row[] = {
        {"ipc/input/tetMeshes/cube.msh", 3, 8, 6, 0, 0, 1},
        {"ipc/input/tetMeshes/tet.msh", 3, 4, 1, 0, 0, 1.0 / 6},
        {"ipc/input/tetMeshes/bar-186.msh", 3, 86, 186, 0, 0, 5},
        {"ipc/input/tetMeshes/bar-2523.msh", 3, 886, 2523, 0, 0, 5},
        {"ipc/input/tetMeshes/mat40x40.msh", 3, 3200, 9126, 0, 0, -1},
        {"ipc/input/tetMeshes/sphere5K.msh", 3, 7034, 27792, 0, 0, -1},
        {"ipc/input/triMeshes/cone.obj", 3, 1152, 0, 2176, 0, -1},
        {"ipc/input/triMeshes/erleben/cliff.obj", 3, 8, 0, 12, 0, -1},
        {"ipc/input/segMeshes/edge.seg", 3, 2, 0, 0, 1, -1},
        {"neural/beam365.mesh", 3, 365, 1343, 0, 0, -1},
        {"neural/heterobeam.ele", 3, 536, 1726, 0, 0, -1},
        {"neural/longerCantileverP2.node", 2, 431, 0, 738, 0, 8},
        {"broad_phase/cloth_ball92.ply", 3, 46598, 0, 92230, 0, -1},
    };
    const char *root = getenv("TSS_TEST_DATA");
    if (!root) {
        print_message("TSS_TEST_DATA is not set: no files of other programs\n");
        skip();
    }
    for (size_t i = 0; i < sizeof row / sizeof *row; i++) {
        char path[600];
        tss_mesh m;
        tss_io_error e;
        tss_mesh_report r;
        snprintf(path, sizeof path, "%s/%s", root, row[i].path);
        if (tss_mesh_read(NULL, path, &m, &e) != TSS_OK)
            fail_msg("%s:%lld: %s", e.file, e.line, e.message);
        assert_true(m.dim == row[i].dim && m.nodes == row[i].nodes && m.tets == row[i].tets);
        assert_true(m.triangles == row[i].triangles && m.edges == row[i].edges);
        assert_int_equal(tss_mesh_check(&m, &r), TSS_OK);
        assert_int_equal(r.problems, 0);
        if (row[i].volume >= 0) assert_true(fabs(r.volume - row[i].volume) < 1e-6 * r.volume);
        tss_mesh_free(&m);
    }
}

int main(void) {
    const char *tmp = getenv("TMPDIR");
    snprintf(folder, sizeof folder, "%s", tmp ? tmp : "/tmp");
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_number_exact), cmocka_unit_test(test_number_long_tie),
        cmocka_unit_test(test_number_round_trip), cmocka_unit_test(test_locale),
        cmocka_unit_test(test_gmsh_text), cmocka_unit_test(test_gmsh_binary),
        cmocka_unit_test(test_medit), cmocka_unit_test(test_tetgen),
        cmocka_unit_test(test_obj_seg), cmocka_unit_test(test_ply),
        cmocka_unit_test(test_malformed), cmocka_unit_test(test_malformed_ele),
        cmocka_unit_test(test_cut), cmocka_unit_test(test_binary_nan),
        cmocka_unit_test(test_meshb), cmocka_unit_test(test_write_surface),
        cmocka_unit_test(test_vtu), cmocka_unit_test(test_pvd),
        cmocka_unit_test(test_write_fails), cmocka_unit_test(test_read_pair),
        cmocka_unit_test(test_every_allocation), cmocka_unit_test(test_check_and_repair),
        cmocka_unit_test(test_surface), cmocka_unit_test(test_real_files),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
