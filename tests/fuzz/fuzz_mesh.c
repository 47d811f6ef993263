// libFuzzer: any bytes as any mesh format. The first byte chooses the format (and, for TetGen, the
// second where the .ele begins). What is accepted must survive the checks, repairs and surface.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_io.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static size_t most;  // largest single request

static void *limited_alloc(size_t bytes, size_t align, void *ctx) {
    (void)align, (void)ctx;
    if (bytes > most) most = bytes;
    return malloc(bytes);
}

static void limited_free(void *p, size_t bytes, void *ctx) {
    (void)bytes, (void)ctx;
    free(p);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    tss_host host = tss_host_default();
    tss_mesh m, surface;
    tss_io_error e;
    tss_mesh_report report;
    if (size < 2) return 0;
    host.alloc = limited_alloc;
    host.free = limited_free;
    most = 0;
    tss_mesh_format format = (tss_mesh_format)(data[0] % 7);
    const uint8_t *text = data + 2;
    size_t n = size - 2, cut = (size_t)data[1] * n / 255;
    tss_result r = format == TSS_MESH_TETGEN
                       ? tss_mesh_parse_tetgen(&host, "n", text, cut, "e", text + cut, n - cut, &m, &e)
                       : tss_mesh_parse(&host, format, "f", text, n, &m, &e);
    // no allocation is out of proportion to the file
    if (most > 4096 + 64 * size) abort();
    if (r == TSS_OK) {
        if (tss_mesh_check(&m, &report) != TSS_OK) abort();
        for (int i = TSS_MESH_BAD_INDEX_TET; i <= TSS_MESH_NOT_FINITE; i++)
            if (report.count[i]) abort();
        tss_mesh_flip_inverted(&m);
        if (tss_mesh_drop_unreferenced(&m, NULL) != TSS_OK) abort();
        if (tss_mesh_surface(&m, &surface) != TSS_OK) abort();
        tss_mesh_free(&surface);
    } else if (r != TSS_ERROR_FORMAT || !e.message[0] || m.nodes || m.x) {
        abort();
    }
    tss_mesh_free(&m);
    return 0;
}
