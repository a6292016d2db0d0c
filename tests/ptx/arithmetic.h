/* What PTX's instructions compute, in C. */
#include <fenv.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

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
