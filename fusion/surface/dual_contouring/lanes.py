"""C++ that works on several cells or quads at once: the same source is vector instructions on the CPU, not on CUDA.

``V`` are floats and ``I`` ints, one in each lane; ``to_floats`` and ``truncate`` convert them, ``load`` reads floats
that lie side by side, ``root`` is the square root, ``any`` tells whether a comparison holds in any lane, and
``lanes_of`` gives their lanes.
"""

ONE_LANE_IN_CPP = "using V = float;\n"
"""C++ for the top of a native function: numbers ``V`` of a single cell."""

LANES = 8

LANES_IN_CPP = f"""
#ifdef __CUDA_ARCH__
    constexpr int LANES = 1;
    using V = float;
    using I = int;
    auto to_floats = [](I x) {{ return (float)x; }};
    auto truncate = [](V x) {{ return (int)x; }};
    auto load = [](const float *x) {{ return *x; }};
    auto root = [](V x) {{ return sqrtf(x); }};
    auto any = [](bool x) {{ return x; }};
#else
    constexpr int LANES = {LANES};
    typedef float V __attribute__((ext_vector_type(LANES)));
    typedef int I __attribute__((ext_vector_type(LANES)));
    auto to_floats = [](I x) {{ return __builtin_convertvector(x, V); }};
    auto truncate = [](V x) {{ return __builtin_convertvector(x, I); }};
    auto load = [](const float *x) {{ V all; __builtin_memcpy(&all, x, sizeof all); return all; }};
    auto root = [](V x) {{ return __builtin_elementwise_sqrt(x); }};
    auto any = [](I x) {{ return __builtin_reduce_or(x) != 0; }};
#endif
    struct {{
        float *operator()(V &x) const {{ return (float *)&x; }}
        const float *operator()(const V &x) const {{ return (const float *)&x; }}
        int *operator()(I &x) const {{ return (int *)&x; }}
        const int *operator()(const I &x) const {{ return (const int *)&x; }}
    }} lanes_of;
"""
"""C++ for the top of a native function: as many lanes as a vector instruction has, on CUDA one."""


def lanes_for(count: int) -> int:
    """Return a count, rounded up to whole vectors."""
    return -(-count // LANES) * LANES
