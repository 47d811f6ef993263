// A scene with contact on a pool of pthreads behind parallel_for: the same bits as serial, and a
// program that ThreadSanitizer can follow (it cannot follow libgomp).
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>
#include <pthread.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"

enum { THREADS = 4 };

typedef struct pool {
    pthread_t thread[THREADS];
    pthread_mutex_t lock;
    pthread_cond_t wake, done;
    tss_task *task;
    void *arg;
    int blocks, next, busy, stop;
    uint64_t round;
} pool;

typedef struct helper {
    pool *p;
    int worker;
} helper;

// Takes blocks until none are left; called with the lock held.
static void drain(pool *p, int worker) {
    while (p->next < p->blocks) {
        int b = p->next++;
        pthread_mutex_unlock(&p->lock);
        p->task(b, worker, p->arg);
        pthread_mutex_lock(&p->lock);
    }
}

static void *work(void *arg) {
    helper *h = (helper *)arg;
    pool *p = h->p;
    uint64_t seen = 0;
    pthread_mutex_lock(&p->lock);
    for (;;) {
        while (p->round == seen && !p->stop) pthread_cond_wait(&p->wake, &p->lock);
        if (p->stop) break;
        seen = p->round;
        p->busy++;
        drain(p, h->worker);
        if (--p->busy == 0) pthread_cond_signal(&p->done);
    }
    pthread_mutex_unlock(&p->lock);
    return NULL;
}

static void pool_run(int blocks, tss_task *task, void *arg, void *ctx) {
    pool *p = (pool *)ctx;
    pthread_mutex_lock(&p->lock);
    p->task = task, p->arg = arg, p->blocks = blocks, p->next = 0, p->round++;
    pthread_cond_broadcast(&p->wake);
    drain(p, 0);
    while (p->busy > 0) pthread_cond_wait(&p->done, &p->lock);
    p->blocks = p->next = 0;
    pthread_mutex_unlock(&p->lock);
}

// Two boxes of n³ cubes fall onto a plane and onto each other.
static uint64_t fall(const tss_host *host, int n, int steps) {
    static const int kuhn[6][4] = {{0, 1, 2, 6}, {0, 2, 3, 6}, {0, 3, 7, 6},
                                   {0, 7, 4, 6}, {0, 4, 5, 6}, {0, 5, 1, 6}};
    static const int corner[8][3] = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0},
                                     {0, 0, 1}, {1, 0, 1}, {1, 1, 1}, {0, 1, 1}};
    int side = n + 1, nodes = side * side * side, cells = 0;
    double *X = (double *)malloc((size_t)nodes * 3 * sizeof(double));
    int *cell = (int *)malloc((size_t)(n * n * n * 24) * sizeof(int));
    assert_true(X && cell);
    for (int i = 0; i < nodes; i++) {
        int at[3] = {i % side, i / side % side, i / side / side};
        for (int c = 0; c < 3; c++) X[3 * i + c] = 0.2 * at[c] / n + (c == 1 ? 0.003 : 0);
        if (at[0] == n || at[1] == n || at[2] == n) continue;
        for (int t = 0; t < 6; t++)
            for (int a = 0; a < 4; a++) {
                const int *v = corner[kuhn[t][a]];
                cell[cells++] = i + v[0] + side * (v[1] + side * v[2]);
            }
    }
    tss_world_def d = tss_world_def_default();
    d.host = *host;
    tss_world *w = NULL;
    assert_int_equal(tss_world_create(&d, &w), TSS_OK);
    tss_body_def b = tss_body_def_default();
    b.nodes = nodes, b.X = X, b.cells = cells / 4, b.cell = cell, b.material.damping = 1e-3;
    assert_int_equal(tss_body_add(w, &b, NULL), TSS_OK);
    for (int i = 0; i < nodes; i++) X[3 * i + 1] += 0.205, X[3 * i] += 0.03;
    assert_int_equal(tss_body_add(w, &b, NULL), TSS_OK);
    tss_ipc_plane floor_plane = {{0, 0, 0}, {0, 1, 0}, 0.3};
    tss_ipc_def c = tss_ipc_def_default();
    c.mu = 0.3, c.planes = 1, c.plane = &floor_plane;
    assert_int_equal(tss_ipc_add(w, &c, NULL), TSS_OK);
    int contacts = 0;
    for (int s = 0; s < steps; s++) {
        tss_step_info info;
        assert_int_equal(tss_world_step(w, &info), TSS_OK);
        assert_int_equal(info.status, TSS_STEP_CONVERGED);
        contacts += info.contacts;
    }
    assert_true(contacts > 0);
    uint64_t hash = tss_world_hash(w);
    tss_world_destroy(w);
    free(X), free(cell);
    return hash;
}

static void test_pool(void **state) {
    (void)state;
    static pool p;
    static helper h[THREADS];
    pthread_mutex_init(&p.lock, NULL);
    pthread_cond_init(&p.wake, NULL), pthread_cond_init(&p.done, NULL);
    for (int k = 1; k < THREADS; k++) {
        h[k].p = &p, h[k].worker = k;
        assert_int_equal(pthread_create(&p.thread[k], NULL, work, &h[k]), 0);
    }
    tss_host serial = tss_host_default(), pooled = tss_host_default();
    serial.workers = 1;
    pooled.parallel_for = pool_run, pooled.parallel_ctx = &p, pooled.workers = THREADS;
    assert_true(fall(&serial, 5, 8) == fall(&pooled, 5, 8));
    pthread_mutex_lock(&p.lock);
    p.stop = 1;
    pthread_cond_broadcast(&p.wake);
    pthread_mutex_unlock(&p.lock);
    for (int k = 1; k < THREADS; k++) pthread_join(p.thread[k], NULL);
}

int main(void) {
    const struct CMUnitTest tests[] = {cmocka_unit_test(test_pool)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
