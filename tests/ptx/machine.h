/* How a grid of threads runs, and what memory it may touch. */
#define _GNU_SOURCE
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <ucontext.h>

#include "arithmetic.h"

/* Memory that the device may touch: [begin, end), ascending. It lies `moved` bytes on: no host code can read it. */
typedef struct { u64 begin, end, moved; } Range;
typedef struct { u64 begin, room, age, moved; } Site;

typedef struct {
    u32 grid[3], block, shared_bytes, order;
    u64 age, ranges_count, device_begin, device_end;
    const Range *ranges;
    char fault[256];
} Launch;

enum { RUNNING, AT_BARRIER, AT_VOTE, DONE };

typedef struct {
    u32 tid, ctaid[3], index;
    u32 state, mask, told, site, answer;
    u64 local, local_end, param, param_end;
    unsigned char *shared;
    Launch *launch;
    ucontext_t context;
    jmp_buf *broken;
} Thread;

static ucontext_t scheduler;

/* Whether n bytes lie in a variable of the module itself. */
static int is_modules_own(u64 a, unsigned n);

static _Noreturn void fault(Thread *t, const char *what, u64 address, unsigned size, int line) {
    snprintf(t->launch->fault, sizeof t->launch->fault, "%s: %u bytes at 0x%llx, PTX line %d, block %u, thread %u", what,
             size, (unsigned long long)address, line, t->ctaid[0], t->tid);
    longjmp(*t->broken, 1);
}

/* An address in global memory: it must lie in an allocation, and on its size's boundary. */
static __attribute__((noinline)) void *find(Thread *t, Site *s, u64 a, unsigned n, int line) {
    if (a & (n - 1)) fault(t, "misaligned address", a, n, line);
    u64 low = 0, high = t->launch->ranges_count;
    while (low < high) {
        const u64 middle = (low + high) / 2;
        if (t->launch->ranges[middle].end <= a) low = middle + 1; else high = middle;
    }
    const Range *held = &t->launch->ranges[low];
    if (low == t->launch->ranges_count || held->begin > a || held->end - a < n) {
        if (is_modules_own(a, n)) return (void *)a;
        // What Warp's own host code has made, as a mesh's hierarchy, is where the host has put it, if it may be.
        if (t->launch->device_end == 0 || (a >= t->launch->device_begin && a < t->launch->device_end) || a < 4096)
            fault(t, "illegal address", a, n, line);
        return (void *)a;
    }
    *s = (Site){held->begin, held->end - held->begin, t->launch->age, held->moved};
    return (void *)(a + s->moved);
}
static inline void *at_global(Thread *t, Site *s, u64 a, unsigned n, int line) {
    const u64 inside = a - s->begin;
    if (inside < s->room && s->room - inside >= n && s->age == t->launch->age && !(a & (n - 1))) return (void *)(a + s->moved);
    return find(t, s, a, n, line);
}
static inline void *at_shared(Thread *t, u32 a, unsigned n, int line) {
    if (a & (n - 1)) fault(t, "misaligned shared address", a, n, line);
    if ((u64)a + n > t->launch->shared_bytes) fault(t, "illegal shared address", a, n, line);
    return t->shared + a;
}
static inline void *at_own(Thread *t, u64 begin, u64 end, u64 a, unsigned n, int line) {
    if (a & (n - 1)) fault(t, "misaligned local address", a, n, line);
    if (a < begin || a + n > end) fault(t, "illegal local address", a, n, line);
    return (void *)a;
}
static inline void *at_local(Thread *t, u64 a, unsigned n, int line) {
    return at_own(t, t->local, t->local_end, a, n, line);
}
static inline void *at_param(Thread *t, u64 a, unsigned n, int line) {
    return at_own(t, t->param, t->param_end, a, n, line);
}
static inline void *at_generic(Thread *t, Site *s, u64 a, unsigned n, int line) {
    if (a >= t->local && a < t->local_end) return at_local(t, a, n, line);
    if (a >= t->param && a < t->param_end) return at_param(t, a, n, line);
    const u64 offset = a - (u64)t->shared;
    if (offset < t->launch->shared_bytes) return at_shared(t, (u32)offset, n, line);
    return at_global(t, s, a, n, line);
}

/* Threads that wait for each other are coroutines. */
static void wait_as(Thread *t, int state) { t->state = state; swapcontext(&t->context, &scheduler); }
static inline void barrier(Thread *t, int site) { t->site = site; wait_as(t, AT_BARRIER); }
static inline u32 ballot(Thread *t, int value, u32 mask, int site) {
    t->mask = mask; t->told = value != 0; t->site = site;
    if (!(mask >> (t->tid & 31) & 1)) fault(t, "a vote without the voter", mask, 4, site);
    wait_as(t, AT_VOTE);
    return t->answer;
}

typedef void Body(Thread *);
static Body *body_now;
static void enter(unsigned low, unsigned high) {
    Thread *t = (Thread *)((u64)high << 32 | low);
    body_now(t);
    t->state = DONE;
    swapcontext(&t->context, &scheduler);
}

/* Lets those of a warp who vote together go on; 1 where any went on. */
static int count_votes(Thread *warp, u32 lanes) {
    int moved = 0;
    for (u32 i = 0; i < lanes; ++i) {
        if (warp[i].state != AT_VOTE) continue;
        u32 votes = 0, complete = 1;
        for (u32 k = 0; k < 32; ++k) {
            if (!(warp[i].mask >> k & 1)) continue;
            if (k >= lanes || warp[k].state == DONE)
                fault(&warp[i], "a vote waits for a thread that is not there", warp[i].mask, 4, (int)warp[i].site);
            if (warp[k].state != AT_VOTE || warp[k].site != warp[i].site || warp[k].mask != warp[i].mask) {
                complete = 0;
                break;
            }
            votes |= warp[k].told << k;
        }
        if (!complete) continue;
        const u32 mask = warp[i].mask;
        for (u32 k = 0; k < 32; ++k)
            if (mask >> k & 1) { warp[k].answer = votes; warp[k].state = RUNNING; }
        moved = 1;
    }
    return moved;
}

static u32 common_divisor(u32 a, u32 b) { return b ? common_divisor(b, a % b) : a; }

/* Threads and blocks one after the other: ascending (order 0), descending (1), or scattered (any other number). */
static u32 place(u32 i, u32 count, u32 order) {
    if (order < 2) return order ? count - 1 - i : i;
    u32 step = order % count;
    while (step == 0 || common_divisor(step, count) != 1) step = step + 1 >= count ? 1 : step + 1;
    return (u32)(((u64)i * step + order) % count);
}

#define STACK (1u << 16)
static void run_together(Thread *threads, u32 count, unsigned char *stacks) {
    for (u32 i = 0; i < count; ++i) {
        getcontext(&threads[i].context);
        threads[i].context.uc_stack.ss_sp = stacks + (size_t)STACK * i;
        threads[i].context.uc_stack.ss_size = STACK;
        threads[i].state = RUNNING;
        makecontext(&threads[i].context, (void (*)(void))enter, 2, (unsigned)(u64)&threads[i],
                    (unsigned)((u64)&threads[i] >> 32));
    }
    for (u32 done = 0; done < count;) {
        int moved = 0;
        for (u32 i = 0; i < count; ++i) {
            Thread *t = &threads[place(i, count, threads[i].launch->order)];
            if (t->state != RUNNING) continue;
            moved = 1;
            swapcontext(&scheduler, &t->context);
        }
        u32 waiting = 0, site = 0;
        done = 0;
        for (u32 i = 0; i < count; ++i) {
            done += threads[i].state == DONE;
            if (threads[i].state == AT_BARRIER) { ++waiting; site = threads[i].site; }
        }
        for (u32 first = 0; first < count; first += 32)
            moved |= count_votes(threads + first, count - first < 32 ? count - first : 32);
        if (waiting && waiting + done == count) {
            for (u32 i = 0; i < count; ++i) {
                if (threads[i].state != AT_BARRIER) continue;
                if (threads[i].site != site) fault(&threads[i], "threads at different barriers", site, 0, (int)site);
                threads[i].state = RUNNING;
            }
            moved = 1;
        }
        if (!moved && done < count) fault(&threads[0], "threads wait for each other for ever", 0, 0, 0);
    }
}

static int run_grid(Launch *launch, Body *body, int together, u64 param, u64 param_end, u32 static_shared) {
    jmp_buf broken;
    const u32 count = launch->block, together_count = together ? count : 1;
    launch->shared_bytes += static_shared;
    Thread *threads = calloc(together_count, sizeof *threads);
    unsigned char *stacks = together ? malloc((size_t)STACK * count) : NULL;
    unsigned char *shared = aligned_alloc(128, (launch->shared_bytes + 255) & ~127u);
    const u64 blocks = (u64)launch->grid[0] * launch->grid[1] * launch->grid[2];
    body_now = body;
    if (!setjmp(broken)) {
        for (u64 n = 0; n < blocks; ++n) {
            const u64 number = blocks < ~0u ? place((u32)n, (u32)blocks, launch->order) : n;
            memset(shared, 0xA5, launch->shared_bytes);
            for (u32 i = 0; i < count; ++i) {
                Thread *t = &threads[together ? i : 0];
                t->tid = together ? i : place(i, count, launch->order);
                t->ctaid[0] = (u32)(number % launch->grid[0]);
                t->ctaid[1] = (u32)(number / launch->grid[0] % launch->grid[1]);
                t->ctaid[2] = (u32)(number / launch->grid[0] / launch->grid[1]);
                t->param = param; t->param_end = param_end;
                t->shared = shared; t->launch = launch; t->broken = &broken;
                if (!together) body(t);
            }
            if (together) run_together(threads, count, stacks);
        }
    }
    free(threads); free(stacks); free(shared);
    return launch->fault[0] != 0;
}
