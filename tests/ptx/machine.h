/* What PTX's instructions do, in C, and how a grid of threads runs: see translate.py and instructions.py. */
#define _GNU_SOURCE
#include <fenv.h>
#include <math.h>
#include <setjmp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ucontext.h>

typedef uint8_t pred;
typedef uint8_t b8, u8;
typedef uint16_t b16, u16;
typedef uint32_t b32, u32;
typedef uint64_t b64, u64;
typedef int8_t s8;
typedef int16_t s16;
typedef int32_t s32;
typedef int64_t s64;
typedef float f32;
typedef double f64;

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

#define BITS(TO, FROM, NAME) static inline TO NAME(FROM x) { TO y; memcpy(&y, &x, sizeof y); return y; }
BITS(u32, f32, f32_bits)
BITS(f32, u32, bits_f32)
BITS(u64, f64, f64_bits)
BITS(f64, u64, bits_f64)

/* Integers: shifts beyond the width clear, division by zero gives all ones, nothing traps. */
#define INTEGERS(W, WIDE, SWIDE) \
    static inline u##W shl_##W(u##W a, u32 n) { return n >= W ? 0 : (u##W)(a << n); } \
    static inline u##W shr_u##W(u##W a, u32 n) { return n >= W ? 0 : (u##W)(a >> n); } \
    static inline s##W shr_s##W(s##W a, u32 n) { return (s##W)(a >> (n >= W ? W - 1 : n)); } \
    static inline u##W div_u##W(u##W a, u##W b) { return b ? a / b : (u##W)~(u##W)0; } \
    static inline u##W rem_u##W(u##W a, u##W b) { return b ? a % b : a; } \
    static inline s##W div_s##W(s##W a, s##W b) { return b == 0 ? -1 : b == -1 ? (s##W)(0 - (u##W)a) : a / b; } \
    static inline s##W rem_s##W(s##W a, s##W b) { return b == 0 ? a : b == -1 ? 0 : a % b; } \
    static inline u##W min_u##W(u##W a, u##W b) { return a < b ? a : b; } \
    static inline u##W max_u##W(u##W a, u##W b) { return a > b ? a : b; } \
    static inline s##W min_s##W(s##W a, s##W b) { return a < b ? a : b; } \
    static inline s##W max_s##W(s##W a, s##W b) { return a > b ? a : b; } \
    static inline u##W mulhi_u##W(u##W a, u##W b) { return (u##W)(((WIDE)a * b) >> W); } \
    static inline s##W mulhi_s##W(s##W a, s##W b) { return (s##W)(((SWIDE)a * b) >> W); }
INTEGERS(16, u32, s32)
INTEGERS(32, u64, s64)
INTEGERS(64, unsigned __int128, __int128)

static inline u32 brev_32(u32 a) {
    u32 r = 0;
    for (int i = 0; i < 32; ++i) r |= (a >> i & 1u) << (31 - i);
    return r;
}
static inline u64 brev_64(u64 a) { return (u64)brev_32((u32)a) << 32 | brev_32((u32)(a >> 32)); }
static inline u32 clz_32(u32 a) { return a ? (u32)__builtin_clz(a) : 32; }
static inline u32 clz_64(u64 a) { return a ? (u32)__builtin_clzll(a) : 64; }
static inline u32 bfind_u32(u32 a) { return a ? 31 - clz_32(a) : ~0u; }
static inline u32 bfind_u64(u64 a) { return a ? 63 - clz_64(a) : ~0u; }
static inline u32 bfind_s32(s32 a) { return bfind_u32((u32)(a < 0 ? ~a : a)); }
static inline u32 bfind_s64(s64 a) { return bfind_u64((u64)(a < 0 ? ~a : a)); }
static inline u32 shifted(u32 found, u32 width) { return found == ~0u ? found : width - 1 - found; }
#define FIELDS(W) \
    static inline u##W bfi_##W(u##W a, u##W b, u32 pos, u32 len) { \
        pos &= 255; len &= 255; \
        if (pos >= W || len == 0) return b; \
        const u##W ones = len >= W ? (u##W)~(u##W)0 : ((u##W)1 << len) - 1, mask = ones << pos; \
        return (b & ~mask) | ((a << pos) & mask); \
    } \
    static inline u##W bfe_u##W(u##W a, u32 pos, u32 len) { \
        pos &= 255; len &= 255; \
        if (pos >= W || len == 0) return 0; \
        return (a >> pos) & (len >= W ? (u##W)~(u##W)0 : ((u##W)1 << len) - 1); \
    } \
    static inline s##W bfe_s##W(s##W a, u32 pos, u32 len) { \
        pos &= 255; len &= 255; \
        if (len == 0) return 0; \
        const u32 last = pos + len - 1 < W - 1 ? pos + len - 1 : W - 1; \
        const u##W sign = (u##W)a >> last & 1; \
        u##W r = 0; \
        for (u32 i = 0; i < W; ++i) r |= (i < len && pos + i < W ? (u##W)a >> (pos + i) & 1 : sign) << i; \
        return (s##W)r; \
    }
FIELDS(32)
FIELDS(64)
static inline u32 prmt(u32 a, u32 b, u32 selector) {
    const u64 both = (u64)b << 32 | a;
    u32 r = 0;
    for (int i = 0; i < 4; ++i) {
        const u32 s = selector >> (4 * i) & 15, byte = (u32)(both >> (8 * (s & 7))) & 255;
        r |= (s & 8 ? (byte & 128 ? 255u : 0u) : byte) << (8 * i);
    }
    return r;
}
static inline u32 lop3(u32 a, u32 b, u32 c, u32 table) {
    u32 r = 0;
    for (int i = 0; i < 8; ++i)
        if (table >> i & 1) r |= (i & 4 ? a : ~a) & (i & 2 ? b : ~b) & (i & 1 ? c : ~c);
    return r;
}
static inline u32 dot(int count, int first, int a_signed, int b_signed, u32 a, u32 b, u32 c) {
    const int width = 32 / count;
    for (int i = 0; i < count; ++i) {
        const u32 part = a << (32 - width * (i + 1)), byte = b << (24 - 8 * (first + i));
        const s64 x = a_signed ? (s64)((s32)part >> (32 - width)) : (s64)(part >> (32 - width));
        c += (u32)(x * (b_signed ? (s64)((s32)byte >> 24) : (s64)(byte >> 24)));
    }
    return c;
}
static inline u32 shf_l_wrap(u32 a, u32 b, u32 n) { n &= 31; return (u32)((((u64)b << 32 | a) << n) >> 32); }
static inline u32 shf_r_wrap(u32 a, u32 b, u32 n) { n &= 31; return (u32)(((u64)b << 32 | a) >> n); }
static inline u32 shf_l_clamp(u32 a, u32 b, u32 n) { return n >= 32 ? a : shf_l_wrap(a, b, n); }
static inline u32 shf_r_clamp(u32 a, u32 b, u32 n) { return n >= 32 ? b : shf_r_wrap(a, b, n); }

/* Numbers: IEEE 754, rounded to nearest unless said; the approximate instructions give the exact value, rounded. */
#define NUMBERS(T, SUFFIX, NAN_BITS, MIN_NORMAL) \
    static inline T min_##T(T a, T b) { \
        if (a != a && b != b) return NAN_BITS; \
        return a != a ? b : b != b ? a : a == b ? (signbit(a) ? a : b) : a < b ? a : b; \
    } \
    static inline T max_##T(T a, T b) { \
        if (a != a && b != b) return NAN_BITS; \
        return a != a ? b : b != b ? a : a == b ? (signbit(a) ? b : a) : a > b ? a : b; \
    } \
    static inline T sat_##T(T a) { return a > 0 ? (a < 1 ? a : 1) : 0; } \
    static inline T ftz_##T(T a) { return fabs##SUFFIX(a) < MIN_NORMAL ? copysign##SUFFIX(0, a) : a; } \
    static inline T fma_##T(T a, T b, T c) { return fma##SUFFIX(a, b, c); } \
    static inline T sqrt_##T(T a) { return sqrt##SUFFIX(a); } \
    static inline T copysign_##T(T a, T b) { return copysign##SUFFIX(b, a); } /* a's sign, b's size */ \
    static inline T abs_##T(T a) { return fabs##SUFFIX(a); } \
    static inline T rni_##T(T a) { return rint##SUFFIX(a); } \
    static inline T rzi_##T(T a) { return trunc##SUFFIX(a); } \
    static inline T rmi_##T(T a) { return floor##SUFFIX(a); } \
    static inline T rpi_##T(T a) { return ceil##SUFFIX(a); } \
    static __attribute__((noinline)) T directed_##T(int mode, int op, volatile T a, volatile T b, volatile T c) { \
        fesetround(mode); \
        volatile T r = op == 0 ? a + b : op == 1 ? a * b : op == 2 ? fma##SUFFIX(a, b, c) \
                     : op == 3 ? a / b : sqrt##SUFFIX(a); \
        fesetround(FE_TONEAREST); \
        return r; \
    }
NUMBERS(f32, f, bits_f32(0x7fffffffu), 0x1p-126f)
NUMBERS(f64, , bits_f64(0x7fffffffffffffffull), 0x1p-1022)
/* NaN gives 0, or the lowest number where either side has 64 bits; what is out of range, the nearest limit. */
#define TO_INTEGER(FROM, TO, LOWEST, HIGHEST, BEYOND, OF_NAN) \
    static inline TO TO##_of_##FROM(FROM a) { \
        return a != a ? (TO)(OF_NAN) : a >= BEYOND ? HIGHEST : a < LOWEST ? LOWEST : (TO)a; \
    }
TO_INTEGER(f32, s8, INT8_MIN, INT8_MAX, 0x1p7f, 0)
TO_INTEGER(f32, u8, 0, UINT8_MAX, 0x1p8f, 0)
TO_INTEGER(f32, s16, INT16_MIN, INT16_MAX, 0x1p15f, 0)
TO_INTEGER(f32, u16, 0, UINT16_MAX, 0x1p16f, 0)
TO_INTEGER(f32, s32, INT32_MIN, INT32_MAX, 0x1p31f, 0)
TO_INTEGER(f32, u32, 0, UINT32_MAX, 0x1p32f, 0)
TO_INTEGER(f32, s64, INT64_MIN, INT64_MAX, 0x1p63f, 1ull << 63)
TO_INTEGER(f32, u64, 0, UINT64_MAX, 0x1p64f, 1ull << 63)
TO_INTEGER(f64, s32, INT32_MIN, INT32_MAX, 0x1p31, 1u << 31)
TO_INTEGER(f64, u32, 0, UINT32_MAX, 0x1p32, 1u << 31)
TO_INTEGER(f64, s64, INT64_MIN, INT64_MAX, 0x1p63, 1ull << 63)
TO_INTEGER(f64, u64, 0, UINT64_MAX, 0x1p64, 1ull << 63)

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
